# SPDX-License-Identifier: Apache-2.0
"""Interfaces of plugins: a matcher, its card and its answers; a rejector, fitted on calibration blocks."""

import hashlib
import math
import re
from collections.abc import Iterable, Mapping, Sequence, Sized
from dataclasses import asdict, dataclass, field
from itertools import islice
from numbers import Real
from typing import Final, Literal, Protocol, get_args, runtime_checkable

import numpy as np
from numpy.typing import NDArray
from pydantic import ConfigDict

from sasgeo_bench.core.errors import MatchError
from sasgeo_bench.core.texts import (
    BOUNDS,
    MOST_CANDIDATES,
    MOST_DIAGNOSTICS,
    MOST_NAME,
    NAME,
    VERSION,
    bounds_text,
    is_line,
    one_line,
    typed,
)
from sasgeo_bench.geometry.pose import Pose
from sasgeo_bench.regions.region import Region
from sasgeo_bench.tasks.query import Head, Query, Track, Truth

FORBID_MORE: Final = ConfigDict(extra="forbid")  # of what a process sends

Status = Literal["ok", "timeout", "crash", "invalid", "refused", "not applicable"]
STATUSES: Final[tuple[Status, ...]] = get_args(Status)
SOUND: Final[frozenset[Status]] = frozenset({"ok", "refused", "not applicable"})  # of a matcher that works


@dataclass(frozen=True, slots=True, kw_only=True)
class Prediction:
    """One row of the predictions of a task; the contract of a submission.

    Parameters
    ----------
    query_id : str
        Of the query.
    candidates : tuple of (Pose, float)
        Poses with scores, best first; empty where the answer was withheld or there is none.
    confidence : float, optional
        Probability that the first pose is right.
    diagnostics : mapping of str to float
        Further numbers of the matcher.
    status : str
        "ok"; "timeout", "crash", "invalid" or "refused" where there is no answer; "not applicable" where the matcher's
        card excludes the query.
    message : str
        The reason, in one line, if there is no answer.
    latency_s : float, optional
        By the runner's clock, from when the query was sent until the answer was read; None where there is no answer,
        and in files whose author gives none. Rows of older programs have the matcher's own clock here.
    matcher_s : float, optional
        Of `match` alone by the clock of the matcher's own process; no metric uses it.
    is_accepted : bool, optional
        Of a tracker: whether its estimate, the first pose, may be relied on.
    covariance : tuple of float, optional
        Of a tracker's estimate: 3 x 3, row by row, in the order east, north, yaw; m2, m deg and deg2.
    """

    query_id: str
    candidates: tuple[tuple[Pose, float], ...] = ()
    confidence: float | None = None
    diagnostics: Mapping[str, float] = field(default_factory=dict)
    status: Status = "ok"
    message: str = ""
    latency_s: float | None = None
    matcher_s: float | None = None
    is_accepted: bool | None = None
    covariance: tuple[float, ...] | None = None

    __pydantic_config__ = FORBID_MORE


def matcher_hash(spec: str, version: str, code: bytes, settings: str) -> str:
    """Return 12 hex digits that identify a run: by the name, version and code of its matcher, and its settings."""
    digest = hashlib.sha256()
    for part in (spec.encode(), version.encode(), code, settings.encode()):
        digest.update(len(part).to_bytes(8, "big") + part)
    return digest.hexdigest()[:12]


Need = Literal["position", "yaw", "scale", "vectors", "image", "imagery", "training"]
NEEDS: Final[tuple[Need, ...]] = get_args(Need)
MOST_CARD_TEXT: Final = 4000  # characters of a field of a card
MOST_LISTED: Final = 1000  # items of a field
MOST_SHOWN: Final = 80  # of a wrong one
MOST_LEARNED_BYTES: Final = 2**20  # of a learned text, as UTF-8
SAME_PLACE_M: Final = 0.05  # a candidate is returned unchanged, except for rounding


@dataclass(frozen=True, slots=True, kw_only=True)
class MatcherCard:
    """Description of a matcher, printed on the board with its row.

    Parameters
    ----------
    name : str
        Lower-case letters, digits, hyphens and underscores.
    version : str
        Letters, digits, dots, hyphens, underscores and plus signs; raised whenever answers change.
    title : str
        One line for people.
    source : str
        Paper, page or "original": where the method comes from.
    ours : str
        The implementer's own part of it.
    licence : str
        SPDX name of the code's licence.
    tracks : tuple of {"retrieval", "localization", "sequence"}
        Tracks that it answers; on others its row is "not applicable". A matcher with "localization" and without
        "sequence" is asked about flights by way of a `Follower`.
    needs : tuple of str
        Of `NEEDS`: what a query must hold, or its map: "image" is a picture of the query, "imagery" that of the map;
        without it the row is "not applicable".
    limits : str
        Known limits.
    trained_on : tuple of str
        Places its parameters come from; a row that was trained on a test place is set apart.
    uses : tuple of str
        What it looks at besides query and map, as in "imagery".
    authors, contact, code : tuple of str, str, str
        Of a submission: who made it, how to reach them, and the https address of the code.

    Raises
    ------
    MatchError
        If a field is empty, too long or not printable, or has an unknown value.
    """

    name: str
    version: str
    title: str
    source: str
    ours: str
    licence: str
    tracks: tuple[Track, ...]
    needs: tuple[Need, ...] = ()
    limits: str = ""
    trained_on: tuple[str, ...] = ()
    uses: tuple[str, ...] = ()
    authors: tuple[str, ...] = ()
    contact: str = ""
    code: str = ""

    __pydantic_config__ = FORBID_MORE

    def __post_init__(self) -> None:
        """Refuse a card without the facts that a reader of the board needs."""
        check_card(asdict(self), tracks=get_args(Track), needs=NEEDS)
        if not self.tracks:
            raise MatchError("card: tracks is empty, name retrieval, localization or both")


def check_card(card: Mapping[str, object], **known: Sequence[str]) -> None:
    """Refuse a card of any kind, by its fields, that lacks a fact, or holds no lines, or none of the `known` values."""
    for name in ("name", "version", "title", "source", "ours", "licence"):
        value = card[name]
        if not isinstance(value, str) or not value.strip():
            raise MatchError(f"card: {name} is empty, say it in one line")
    for name, value in card.items():
        items = value if isinstance(value, tuple | list) else () if isinstance(value, bool) else (value,)
        wrong = next((item for item in items if item not in known[name]), None) if name in known else None
        if wrong is not None:
            raise MatchError(f"card: {name} holds {wrong!r}, known are {', '.join(known[name])}")
        if len(items) > MOST_LISTED:
            raise MatchError(f"card: {name} holds {len(items)} lines, expected at most {MOST_LISTED}")
        if not all(isinstance(item, str) and is_line(item, MOST_CARD_TEXT) for item in items):
            raise MatchError(f"card: {name} must be one line of at most {MOST_CARD_TEXT} printable characters")
    check_identity(str(card["name"]), str(card["version"]))


def check_identity(name: str, version: str) -> None:
    """Raise `MatchError` for a name or version that cannot be part of a folder's name, a flag or any table.

    >>> check_identity("graph", "1.0.0rc1+cpu")
    >>> check_identity("graph", "=1+1")
    Traceback (most recent call last):
        ...
    sasgeo_bench.core.errors.MatchError: card: version '=1+1' may hold letters, digits, dots, hyphens, underscores and
    plus signs only, a letter or digit first, 60 at most
    """
    for what, value, pattern, letters in (
        ("name", name, NAME, "lower-case letters, digits, hyphens and underscores"),
        ("version", version, VERSION, "letters, digits, dots, hyphens, underscores and plus signs"),
    ):
        if not re.fullmatch(pattern, value):
            raise MatchError(
                f"card: {what} {value[:MOST_SHOWN]!r} may hold {letters} only, a letter or digit first, 60 at most"
            )


@dataclass(frozen=True, slots=True, kw_only=True)
class Match:
    """An answer to one query: places with scores, best first; an answer without a place is withheld.

    Parameters
    ----------
    poses : sequence of Pose
        For retrieval, candidates of the query; for localization, any poses.
    scores : sequence of float
        As many as poses, none greater than the one before it; any scale.
    confidence : float, optional
        Probability, 0..1, that the first pose is right; None if the matcher gives none.
    diagnostics : mapping of str to float
        Further numbers for a rejector or a reader, as in "margin".
    """

    poses: Sequence[Pose]
    scores: Sequence[float]
    confidence: float | None = None
    diagnostics: Mapping[str, float] = field(default_factory=dict)


WITHHELD: Final = Match(poses=(), scores=(), confidence=0.0)


@dataclass(frozen=True, slots=True, kw_only=True)
class Training:
    """Training data of a matcher: maps, queries and truths of places that it is not asked about.

    Parameters
    ----------
    regions : mapping of str to Region
        Maps by the name that queries have in `region`. In a run each is read when it is asked for and only a few are
        kept: take the pairs in their order, which leaves those on one map together.
    pairs : sequence of (Query, Truth)
        Both tracks, and queries whose place is absent (`truth.is_present` is False, or there is no pose) among them.
    """

    regions: Mapping[str, Region]
    pairs: Sequence[tuple[Query, Truth]]


@runtime_checkable
class Matcher(Protocol):
    """A method under test. It is made without arguments, in a process of its own, and sees no truth."""

    card: MatcherCard

    def prepare(self, region: Region, learned: str | None) -> None:
        """Index a map; called and timed once for each map. `learned` is the text of `learn`, None without one."""
        ...

    def match(self, query: Query, *, top_k: int) -> Match:
        """Answer a query on the map prepared last, with at most `top_k` poses."""
        ...


@runtime_checkable
class Learner(Protocol):
    """A matcher or a tracker that learns, once for each set of training places and in a process of its own.

    The result is a text, which the runner stores and passes to every `prepare`; the same training gives the same text.
    After a failed training `prepare` gets None: a matcher that then cannot answer needs "training" on its card.
    """

    card: MatcherCard

    def prepare(self, region: Region, learned: str | None) -> None:
        """Index a map; `learned` is the text of `learn`."""
        ...

    def learn(self, training: Training) -> str:
        """Return the result as JSON or any other text of at most `MOST_LEARNED_BYTES`."""
        ...


def check_learned(learned: object, *, most_bytes: int = MOST_LEARNED_BYTES) -> str:
    """Return a learned text, if it is one that can be stored; raise `MatchError` otherwise."""
    if not isinstance(learned, str):
        raise MatchError(f"learn() returned {type(learned).__name__}, expected a text: write it as JSON, say")
    try:
        size = len(learned.encode())
    except UnicodeEncodeError as error:
        raise MatchError(
            "learn() returned a text that is no UTF-8, expected characters alone: write bytes as base64, say"
        ) from error
    if not 0 < size <= most_bytes:  # a stored file of no bytes was emptied by somebody
        raise MatchError(f"learn() returned {size} bytes, expected {f'at most {most_bytes}' if size else 'a text'}")
    return learned


def check_match(match: object, query: Query | Head | None, *, top_k: int) -> Match:
    """Check an answer to a query of at most `top_k` poses, and return it with floats for numbers.

    Without a query, the poses of a retrieval answer are not compared with its candidates.

    Raises
    ------
    MatchError
        If it is not a Match, has more than `top_k` poses, another number of scores, a number out of `texts.BOUNDS`,
        scores out of order, a pose twice or one that is no candidate of a retrieval query, or a diagnostic whose name
        is no line of at most `texts.MOST_NAME` characters.
    """
    if not isinstance(match, Match):
        raise MatchError(f"match() returned {type(match).__name__}, expected sasgeo_bench.matching.matcher.Match")
    count = _count(match.poses)
    if count > min(top_k, MOST_CANDIDATES):
        raise MatchError(f"match() returned {count} poses, expected at most top_k = {min(top_k, MOST_CANDIDATES)}")
    # An object of some length may still yield more or fewer items.
    if not isinstance(match.scores, Iterable):
        raise MatchError(f"scores is {typed(match.scores)}, expected a sequence of as many numbers as poses")
    scores = [_number(score, "score") for score in islice(match.scores, MOST_CANDIDATES + 1)]
    poses = [_pose(pose) for pose in islice(match.poses, count)]
    if len(poses) != count or len(scores) != count:
        raise MatchError(f"match() returned {len(scores)} scores for {len(poses)} poses, expected one each")
    fallen = next((at for at in range(1, count) if scores[at] > scores[at - 1]), None)
    if fallen is not None:
        raise MatchError(
            f"scores rise from {scores[fallen - 1]:g} to {scores[fallen]:g} at place {fallen}, expected best first"
        )
    confidence = None if match.confidence is None else _number(match.confidence, "confidence")
    if query is not None and query.track == "retrieval":
        _check_candidates(poses, query.candidates)
    diagnostics = _diagnostics(match.diagnostics)
    return Match(poses=poses, scores=scores, confidence=confidence, diagnostics=diagnostics)


def _count(poses: object) -> int:
    if not isinstance(poses, Iterable) or not isinstance(poses, Sized):
        raise MatchError(f"poses is {typed(poses)}, expected a sequence, which is empty if the answer is withheld")
    return len(poses)


def _number(value: object, name: str, *, shown: str = "") -> float:
    try:
        if isinstance(value, str | bytes):
            raise TypeError(value)  # noqa: TRY301 - Python reads "0.5" as a number, the door does not
        number = float(value)  # type: ignore[arg-type]
    except OverflowError as error:
        raise MatchError(f"{shown or name} is too large, expected a number within {bounds_text(name)}") from error
    except (TypeError, ValueError) as error:
        raise MatchError(f"{shown or name} is {typed(value)}, expected a number") from error
    least, most = BOUNDS[name]
    if not least <= number <= most:
        raise MatchError(f"{shown or name} is {number:g}, expected a finite number within {bounds_text(name)}")
    return number


def _pose(pose: object) -> Pose:
    if not isinstance(pose, Pose):
        raise MatchError(f"a pose is {typed(pose)}, expected sasgeo_bench.geometry.pose.Pose")
    numbers = {name: _number(getattr(pose, name), name) for name in ("easting_m", "northing_m", "yaw_deg", "scale")}
    return Pose(**numbers)


def _check_candidates(poses: Sequence[Pose], candidates: Sequence[Pose]) -> None:
    """Check that every pose of a retrieval answer is one of the candidates, and none is given twice."""
    given: set[int] = set()
    for pose in poses:
        near = candidates_at(pose, candidates)
        at = next((index for index in near if index not in given), near[0] if near else None)
        if at is None:
            place = f"({pose.easting_m:.2f}, {pose.northing_m:.2f})"
            raise MatchError(
                f"pose {place} is none of the {len(candidates)} candidates, expected one of query.candidates"
            )
        if at in given:
            raise MatchError(f"candidate {at} is given twice, expected each at most once")
        given.add(at)


def candidates_at(pose: Pose, candidates: Sequence[Pose], within_m: float = SAME_PLACE_M) -> list[int]:
    """Return the candidates at a pose, the nearest first; heading and scale may have been refined."""
    gaps_m = [math.hypot(pose.easting_m - item.easting_m, pose.northing_m - item.northing_m) for item in candidates]
    near = [index for index, gap_m in enumerate(gaps_m) if gap_m <= within_m]
    return sorted(near, key=gaps_m.__getitem__)


def _diagnostics(given: object) -> dict[str, float]:
    if not isinstance(given, Mapping):
        raise MatchError(f"diagnostics is {typed(given)}, expected a mapping of name to number")
    if len(given) > MOST_DIAGNOSTICS:
        raise MatchError(f"diagnostics holds {len(given)} entries, expected at most {MOST_DIAGNOSTICS}")
    pairs = [(str(name), value) for name, value in islice(given.items(), MOST_DIAGNOSTICS + 1)]
    wrong = next((name for name, _ in pairs if not name or not is_line(name, MOST_NAME)), None)
    if wrong is not None:
        raise MatchError(
            f"diagnostics holds the name {wrong[:MOST_NAME]!r}, expected 1..{MOST_NAME} printable characters"
        )
    found = {name: _number(value, "diagnostics", shown=f"diagnostics[{name!r}]") for name, value in pairs}
    if len(found) != len(given):
        raise MatchError(f"diagnostics holds {len(given)} entries under {len(found)} names, expected each name once")
    return found


def is_followed(card: MatcherCard) -> bool:
    """Return whether a matcher finds single views alone, and so follows flights by `follower.Follower`."""
    return "localization" in card.tracks and "sequence" not in card.tracks


def lacks(card: MatcherCard, query: Query, *, is_taught: bool = False, is_pictured: bool = False) -> str | None:
    """Return why a query is not applicable to a matcher, or None: its track, or a need of the card that it lacks.

    `is_taught` says whether the matcher was trained, `is_pictured` whether the searched map has imagery. A matcher of
    single views that is asked about a flight (`is_followed`) gets place and heading for each view.
    """
    gets_belief = query.track == "sequence" and is_followed(card)
    if query.track not in card.tracks and not gets_belief:
        return f"track {query.track}"
    has = {
        "position": gets_belief or query.prior.center_m is not None or bool(query.candidates),
        "yaw": gets_belief or query.prior.yaw_deg is not None,
        "scale": True,
        "vectors": query.vectors is not None,
        "image": bool(query.frames),
        "imagery": is_pictured,
        "training": is_taught,
    }
    return next((f"no {need}" for need in card.needs if not has[need]), None)


@dataclass(frozen=True, slots=True, kw_only=True)
class RejectorCard:
    """Description of a rejector: the fields of a `MatcherCard`, and `is_calibrated`.

    It is False where `p_false` only orders answers and is no probability. A board then reports neither Brier score nor
    calibration error nor costs by Eq. 14. Raise `MatchError` if a field is empty or the name is not allowed.
    """

    name: str
    version: str
    title: str
    source: str
    ours: str
    licence: str
    limits: str = ""
    is_calibrated: bool = True

    def __post_init__(self) -> None:
        """Refuse a card without the facts that a reader of the board needs."""
        check_card(asdict(self))


@runtime_checkable
class Rejector(Protocol):
    """A rule over the answers of one matcher; it is made without arguments and sees no query, map or truth.

    Of each answer it sees the matcher's output: candidates with scores, confidence, diagnostics. After a fit it may
    have a `remark`, a text about that fit for the board, for instance that there was too little calibration data.
    """

    card: RejectorCard

    def fit(self, predictions: Sequence[Prediction], is_false: NDArray[np.bool_]) -> None:
        """Fit to answers of calibration blocks; `is_false`, shape (N,), marks false fixes."""
        ...

    def p_false(self, predictions: Sequence[Prediction]) -> NDArray[np.float64]:
        """Probability, shape (N,), 0..1, that each answer is a false fix."""
        ...


def remark_of(rejector: Rejector) -> str:
    """Return a rejector's remark on its last fit in one line; empty where it has no `remark`."""
    return one_line(str(getattr(rejector, "remark", "") or ""))


def numbers_of(given: object) -> NDArray[np.float64]:
    """Return numbers as an array of floats; raise TypeError, ValueError or OverflowError where they are none.

    Texts, complex numbers and masks are none: NumPy would convert the first two, and lose part of the others.

    >>> numbers_of([[1, True], [0.5, 2]]).tolist()
    [[1.0, 1.0], [0.5, 2.0]]
    """
    found = np.asanyarray(given)
    if isinstance(found, np.ma.MaskedArray):
        raise TypeError("the mask of a masked array would be lost")
    is_mixed = found.dtype.kind == "O" and all(isinstance(one, Real | np.bool_) for one in found.flat)
    if found.dtype.kind not in "biuf" and not is_mixed:
        raise TypeError("they are no numbers")
    return np.asarray(found, dtype=np.float64)


def check_p_false(found: object, count: int) -> NDArray[np.float64]:
    """Return the result of `p_false` as float64, shape (count,); raise `MatchError` if it is not `count` numbers, 0..1.

    >>> check_p_false([0.25, 1.0], 2)
    array([0.25, 1.  ])
    """
    try:
        values = numbers_of(found)
    except (TypeError, ValueError, OverflowError) as error:
        raise MatchError(f"p_false() returned {type(found).__name__}, expected {count} numbers") from error
    if values.shape != (count,):
        raise MatchError(f"p_false() returned shape {values.shape}, expected ({count},): one number for each answer")
    wrong = np.flatnonzero(~((values >= 0) & (values <= 1)))
    if len(wrong):
        raise MatchError(f"p_false() returned {values[wrong[0]]:g} in place {wrong[0]}, expected 0..1")
    return values
