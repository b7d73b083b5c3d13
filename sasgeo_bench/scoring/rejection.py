# SPDX-License-Identifier: Apache-2.0
"""Rejectors on the answers of a matcher: fitted and given thresholds on calibration places, evaluated on test places.

A matcher's own confidence is treated as a rejector that needs no fit.
"""

import math
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from pathlib import Path
from typing import Annotated, Final, TypeVar

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from sasgeo_bench.core.errors import ConfigError, MatchError, counted
from sasgeo_bench.core.folders import uncollected
from sasgeo_bench.core.progress import spread, tell
from sasgeo_bench.core.texts import message_of
from sasgeo_bench.matching.matcher import Prediction, Rejector, RejectorCard, check_p_false, remark_of
from sasgeo_bench.matching.plugins import rejector_maker
from sasgeo_bench.running.failures import Failures
from sasgeo_bench.running.prediction_files import StoredAnswers
from sasgeo_bench.scoring.base import Bools, Floats, codes_of
from sasgeo_bench.scoring.controls import EVERY
from sasgeo_bench.scoring.decisions import (
    COST_RATIOS,
    PRESENT_SHARES,
    Fixes,
    accept,
    accept_by_cost,
    at_share,
    choose_absent_threshold,
    choose_threshold,
)
from sasgeo_bench.scoring.frames import MATCHER, PRIOR_GROUP, REJECTOR, TRACK, Schema, Shown, row_columns
from sasgeo_bench.scoring.intervals import BoardDraws, BoardInterval, seed_of_text
from sasgeo_bench.scoring.kept_rejection import Judgement, KeptJudgements
from sasgeo_bench.scoring.metrics import THRESHOLDS
from sasgeo_bench.scoring.rejection_rows import (
    SLOW_DRAWS,
    Share,
    answers_of,
    integrity_rows,
    mixtures_of,
    share_intervals,
    shifted_column,
)
from sasgeo_bench.scoring.rows import FIGURE_SCHEMA
from sasgeo_bench.scoring.score import NOT_APPLICABLE, some_rows
from sasgeo_bench.tasks.split import Split


@dataclass(frozen=True, slots=True, kw_only=True)
class Accepted:
    """What Eq. 14 accepts of a matcher's answers at one kind of absence, mixture and cost ratio."""

    matcher: Annotated[str, MATCHER]
    rejector: Annotated[str, REJECTOR]
    track: Annotated[str, TRACK]
    prior_group: Annotated[str, PRIOR_GROUP]
    mixture: Annotated[str, "Share of present places, as drawn or as declared"]
    absence: Annotated[str, Shown("Kind of absent places, suite: kind; all: all of them")]
    cost_ratio: Annotated[float, "Cost of a false fix, in costs of a place without an accepted fix"]
    n: Annotated[int, "Queries"]
    absent: Annotated[int, Shown("Absent places among the queries")]
    places: Annotated[int, "Places of the queries"]
    coverage: Annotated[
        BoardInterval, Shown("Share of queries with an accepted fix, where absent places have the share named")
    ]
    risk: Annotated[
        BoardInterval,
        Shown(
            "Share of false fixes among the accepted ones, where absent places have the share named", "risk of fixes"
        ),
    ]
    right_present: Annotated[BoardInterval, "Share of present places that are rightly accepted"]
    absent_accepted: Annotated[BoardInterval, "Share of absent places with an accepted fix"]


ACCEPTANCE_SCHEMA: Final = Schema("acceptance", row_columns(Accepted))


def acceptance_frame(matcher: str, rejector: str, judged: pd.DataFrame) -> pd.DataFrame:
    """Return what Eq. 14 accepts of a matcher's answers, a row for each kind of absence, mixture and cost ratio.

    `judged` are rows of `rejection.judge` or `own_confidence` with chances, all suites together. The kinds of absence
    are "all" and each "suite: kind" with absent places; each is mixed with all present places of its track and prior
    group, as drawn and at the declared shares. Without present or absent places there is no row, nor where the
    calibration cannot correct chances for a share.

    Shares are in [0, 1], each with its 95 % interval by places. `risk` is NaN where nothing is accepted.

    The SASGeo paper, Eqs. (12)-(14).
    """
    return ACCEPTANCE_SCHEMA.frame(
        row
        for (track, prior_group), part in judged.groupby(["track", "prior_group"], sort=True)
        for pool in _pools(part)
        for row in _acceptance_rows(
            pool, matcher=matcher, rejector=rejector, track=str(track), prior_group=str(prior_group)
        )
    )


@dataclass(frozen=True, slots=True, kw_only=True)
class _Pool:
    """Present places, and the absent ones of a kind."""

    absence: str
    rows: pd.DataFrame


def _pools(part: pd.DataFrame) -> Iterator[_Pool]:
    """Yield all absent places, then each kind of them, with all present ones."""
    present: Bools = part["is_present"].to_numpy(bool)
    if present.all() or not present.any():
        return
    kinds = (part["suite"].astype(str) + ": " + part["kind"].astype(str)).to_numpy()
    yield _Pool(absence=EVERY, rows=part)
    for kind in sorted(set(kinds[~present])):
        yield _Pool(absence=kind, rows=part[present | (kinds == kind)])


def _acceptance_rows(pool: _Pool, *, matcher: str, rejector: str, track: str, prior_group: str) -> Iterator[Accepted]:
    part = pool.rows
    place, block, site = (codes_of(part[name]) for name in ("place", "block", "pair_id"))
    drawn = BoardDraws.of(
        place, block, site, seed=seed_of_text(f"{track}/{prior_group}/{pool.absence}"), draws=SLOW_DRAWS
    )
    plain = answers_of(part)
    cases = [
        (mixture, cost_ratio, _acceptance_shares(answers, mass, cost_ratio))
        for mixture, mass in mixtures_of(plain, is_pooled=True)
        if _is_complete(plain, answers := answers_of(part, mixture))
        for cost_ratio in COST_RATIOS
    ]
    intervals = iter(share_intervals([share for *_, shares in cases for share in shares], site, drawn))
    for mixture, cost_ratio, _ in cases:
        yield Accepted(
            matcher=matcher,
            rejector=rejector,
            track=track,
            prior_group=prior_group,
            mixture=mixture,
            absence=pool.absence,
            cost_ratio=cost_ratio,
            n=len(part),
            absent=int((~part["is_present"].astype(bool)).sum()),
            places=len(set(place)),
            coverage=next(intervals),  # in the order of `_shares`
            risk=next(intervals),
            right_present=next(intervals),
            absent_accepted=next(intervals),
        )


def _is_complete(plain: Fixes, shifted: Fixes) -> bool:
    """Return whether no answer lost its chance to the correction, as where one calibration place lacks absent ones."""
    lost = np.isnan(shifted.confidence) & ~np.isnan(plain.confidence)
    return not lost.any() and not np.isnan(plain.confidence[plain.is_answered]).all()


def _acceptance_shares(answers: Fixes, mass: Floats, cost_ratio: float) -> list[Share]:
    """Return coverage, risk, and what is accepted of present and of absent places."""
    accepted = accept_by_cost(answers, cost_ratio).astype(float)
    right, present = answers.is_right.astype(float), answers.is_present.astype(float)
    return [
        Share(counted=accepted, mass=mass),
        Share(counted=1.0 - right, mass=mass * accepted),
        Share(counted=accepted * right, mass=mass * present),
        Share(counted=accepted, mass=mass * (1.0 - present)),
    ]


JUDGED: Final = "rejectors"  # what progress is shown of
OWN: Final = "own"  # name of a matcher's own confidence on a board; reserved
_NUMBER: Final = r"\d+(?:\.\d+)?"
_PARTS: Final = 5  # folds of the calibration places: thresholds need answers that the rejector was not fitted on

Make = Callable[[], Rejector]
Found = TypeVar("Found")


@dataclass(frozen=True, kw_only=True)
class Rule:
    """A rejector to fit: its card, a function that makes a new one, and the split that names calibration places.

    `code` is its module:Class, where that is known.
    """

    card: RejectorCard
    make: Make
    split: Split
    code: str = ""


def rules_of(specs: Sequence[str], split: Split | None) -> dict[str, Rule]:
    """Return rejectors by name from names or module:Class, after making each once.

    Raise ConfigError if there is no split, two share a name, or one has that of a matcher's own confidence.
    """
    found: dict[str, Rule] = {}
    named: dict[str, str] = {}
    for spec in specs:
        if split is None:
            raise ConfigError("rejectors are fitted on the calibration places of a split: name one with --split")
        make = rejector_maker(spec)
        rejector = make()
        card, kind = rejector.card, type(rejector)
        if named.setdefault(card.name, spec) != spec:
            raise ConfigError(
                f"{named[card.name]} and {spec} are both named {card.name!r}: rename one, or leave it out"
            )
        if card.name == OWN:
            raise ConfigError(f"{spec}: {OWN!r} is what a board calls a matcher's own confidence: rename the rejector")
        # A function may make something else of a class: its name says nothing of what it does
        code = f"{kind.__module__}:{kind.__qualname__}" if make.args[-1] is kind else ""
        found[card.name] = Rule(card=card, make=make, split=split, code=code)
    return found


@dataclass(frozen=True, slots=True, kw_only=True)
class Turn:
    """One use of a split: masks of the rows to score and of those that calibrate, shape (N,).

    `is_own` is False if none of the fold's own calibration places is on the board, so that all other places calibrate.
    This fallback is not for matchers with training: their answers on other places were trained on the test place.
    """

    test: Bools
    calibration: Bools
    is_own: bool


def turns(scores: pd.DataFrame, split: Split, *, is_taught: bool = False) -> Iterator[Turn]:
    """Yield every use of a split for scored rows; each row is tested at most once, and no place calibrates itself.

    A hold-out split has one turn, by the part of each query; a cross-fit one for each place on the board. A sealed
    place calibrates no other. With `is_taught`, for a matcher that was trained on other places, only the fold's own
    calibration places calibrate.
    """
    place, part = scores["place"].to_numpy(), scores["part"].to_numpy()
    if split.spec.kind == "holdout":
        yield Turn(test=part == "test", calibration=part == "calibration", is_own=True)
        return
    is_sealed = np.isin(place, split.sealed)
    for fold in split.folds:
        test = place == fold.held_out
        if not test.any():
            continue
        own = np.isin(place, [name for name, kind in fold.part_of.items() if kind == "calibration"])
        is_own = is_taught or bool(own.any())
        yield Turn(test=test, calibration=own if is_own else ~(test | is_sealed), is_own=is_own)


@dataclass(frozen=True, slots=True, kw_only=True)
class _Alike:
    """Turns with the same calibration, of which one fit serves all; `test` masks the rows that they score together."""

    turns: tuple[Turn, ...]
    test: Bools


def _by_calibration(every: Iterable[Turn]) -> Iterator[_Alike]:
    """Yield the turns that share their calibration: many places do."""
    found: dict[bytes, list[Turn]] = {}
    for turn in every:
        found.setdefault(turn.calibration.tobytes(), []).append(turn)
    for listed in found.values():
        yield _Alike(turns=tuple(listed), test=np.any([turn.test for turn in listed], axis=0))


def judge(
    scores: pd.DataFrame, predictions: Mapping[str, Prediction], make: Make, split: Split, *, is_taught: bool = False
) -> pd.DataFrame:
    """Return a rejector's output for the answers of one matcher, each from a fit on other places.

    Each track and prior group has its own fit, over all suites. `make` makes a new rejector; `is_taught` is as in
    `turns`. The result holds the tested rows, with the columns `p_right` (NaN without an answer), `is_calibrated`
    (False if `p_right` is only an order), `accepted_<risk>` for each of `RISKS`, `is_own_calibration`, and `remark`,
    the rejector's remark on its fit.
    """
    usable = some_rows(scores, (scores["status"] != NOT_APPLICABLE).to_numpy(bool))
    needed = usable[[*_NEEDED]].astype(dict.fromkeys(_NAMES, object))
    columns: dict[str, np.ndarray] = {
        **{name: np.full(len(usable), np.nan) for name in ("p_right", *_DECIDED)},
        "remark": np.full(len(usable), "", dtype=object),
        **{name: np.zeros(len(usable), dtype=bool) for name in ("is_calibrated", "is_own_calibration")},
    }
    is_judged = np.zeros(len(usable), dtype=bool)
    for rows in usable.groupby(["track", "prior_group"], sort=True).indices.values():
        group = needed.iloc[rows]
        fits = _Fits(rows=group, answers=_answers_to(group, predictions), make=make)
        for alike in _by_calibration(turns(group, split, is_taught=is_taught)):
            test, calibration = alike.test, alike.turns[0].calibration
            if not test.any() or not (calibration & fits.is_answered).any():
                continue
            rejector = fits.on(calibration)
            for turn in alike.turns:
                p_false, remark = fits.applied(rejector, turn.test)
                found = {"p_right": 1.0 - p_false, "remark": remark, "is_own_calibration": turn.is_own}
                for name, values in found.items():
                    columns[name][rows[turn.test]] = values
            is_judged[rows[test]] = True
            columns["is_calibrated"][rows[test]] = rejector.card.is_calibrated
            known = group[calibration].assign(p_right=1.0 - fits.held_back(calibration))
            asked = group[test].assign(p_right=columns["p_right"][rows[test]])
            for name, values in _decided(known, asked).items():
                columns[name][rows[test]] = values
    return some_rows(usable.assign(**columns), is_judged)


def remarks_of(judged: pd.DataFrame) -> list[str]:
    """Return a rejector's remarks on its fits with the number of answers; remarks that differ in numbers are one.

    >>> remarks_of(pd.DataFrame({"remark": ["", "2 too few", "2 too few"], "is_answered": [True, True, False]}))
    ['2 too few (1 answer judged so)']
    >>> remarks_of(pd.DataFrame({"remark": ["2 too few", "9 too few", "9 too few"], "is_answered": True}))
    ['9 too few (and alike in 1 fit more: 3 answers judged so)']
    """
    remarks = judged.loc[judged["is_answered"].astype(bool) & (judged["remark"] != ""), "remark"]
    found = []
    for _, alike in remarks.groupby(remarks.str.replace(_NUMBER, "#", regex=True), sort=True):
        counts = alike.value_counts()
        most = min(counts.index[counts == counts.max()])
        others = f"and alike in {counted(len(counts) - 1, 'fit')} more: " if len(counts) > 1 else ""
        found.append(f"{most} ({others}{counted(len(alike), 'answer')} judged so)")
    return sorted(found)


def why_not(scores: pd.DataFrame, *, is_taught: bool = False) -> str:
    """Return why `judge` has no row for a matcher; `is_taught` as there."""
    if not scores["is_answered"].any():
        return "it has no answers to judge"
    if is_taught:
        return "no other place of the board is in the half of one that it answered"
    if len(set(scores["place"])) > 1:
        return "no place that may calibrate another one has an answer"
    return "no other place of the board calibrates"


def own_confidence(scores: pd.DataFrame, split: Split | None = None, *, is_taught: bool = False) -> pd.DataFrame:
    """Return a matcher's own confidences in the form of `judge`, as a rejector without a fit.

    The columns are `p_right`, always a probability, and `accepted_<risk>`, NaN where no place calibrates. Only tracks
    and prior groups with some confidence count; an answer without one is trusted least. Of a hold-out split only the
    test part counts. Without a split there are no thresholds.
    """
    usable = some_rows(scores, (scores["status"] != NOT_APPLICABLE).to_numpy(bool))
    p_right = np.where(usable["is_answered"].to_numpy(bool), usable["confidence"].to_numpy(float), np.nan)
    needed = usable[[*_NEEDED]].astype(dict.fromkeys(_NAMES, object)).assign(p_right=p_right)
    accepted = {name: np.full(len(usable), np.nan) for name in _DECIDED}
    is_given = np.zeros(len(usable), dtype=bool)
    for rows in usable.groupby(["track", "prior_group"], sort=True).indices.values():
        is_given[rows] = not np.isnan(p_right[rows]).all()
        group = needed.iloc[rows]
        if split is None or not is_given[rows].any():
            continue
        for alike in _by_calibration(turns(group, split, is_taught=is_taught)):
            known = group[alike.turns[0].calibration]
            if known["is_answered"].any():
                for name, taken in _decided(known, group[alike.test]).items():
                    accepted[name][rows[alike.test]] = taken
    if split is not None and split.spec.kind == "holdout":
        is_given &= (usable["part"] == "test").to_numpy(bool)
    return some_rows(usable.assign(p_right=p_right, **accepted), is_given)


_NAMES: Final = ("query_id", "place", "part", "country", "block")  # of objects, which are chosen faster than texts
_NEEDED: Final = (*_NAMES, "is_answered", "is_right", "is_present")
# What is decided about rows from the calibration places: acceptance by each threshold, chances at each declared share.
_DECIDED: Final = (*dict.fromkeys(metric.accepted for metric in THRESHOLDS), *map(shifted_column, PRESENT_SHARES))


def _decided(known: pd.DataFrame, asked: pd.DataFrame) -> dict[str, Floats]:
    """Return the fixes that thresholds chosen on some rows accept, and chances at declared shares, by column name.

    NaN where a threshold or a share needs absent places and the calibration has none.
    """
    calibration, test = answers_of(known), answers_of(asked)
    found = {}
    for metric in THRESHOLDS:
        choose = choose_absent_threshold if metric.is_of_absent else choose_threshold
        threshold = choose(calibration, metric.limit)
        taken = accept(test, threshold).astype(float)
        found[metric.accepted] = np.full(len(test), np.nan) if math.isnan(threshold) else taken
    are_chances = _are_chances(calibration) and _are_chances(test)
    for share in PRESENT_SHARES:
        nothing = np.full(len(test), np.nan)
        found[shifted_column(share)] = at_share(calibration, share, test.confidence) if are_chances else nothing
    return found


def _are_chances(answers: Fixes) -> bool:
    """Return whether all confidences lie in [0, 1]; a margin is only an order."""
    given = answers.confidence[~np.isnan(answers.confidence)]
    return bool(((given >= 0) & (given <= 1)).all())


@dataclass(frozen=True, kw_only=True)
class _Fits:
    """Fits of a rejector on some of N rows, by masks of shape (N,); `answers` are those to them, None without one.

    One fit serves all that ask for the same rows: what is left out of two calibrations often leaves the same.
    """

    rows: pd.DataFrame
    answers: NDArray[np.object_]
    make: Make
    found: dict[bytes, Rejector] = field(default_factory=dict)

    @cached_property
    def is_answered(self) -> Bools:
        return self.rows["is_answered"].to_numpy(bool)

    def on(self, known: Bools) -> Rejector:
        """Return a rejector that is fitted on the answers of some rows."""
        chosen = known & self.is_answered
        if (rejector := self.found.get(chosen.tobytes())) is None:
            rejector = self.make()
            with _blamed(rejector):
                rejector.fit(self.answers[chosen].tolist(), ~self.rows["is_right"].to_numpy(bool)[chosen])
            self.found[chosen.tobytes()] = rejector
        return rejector

    def applied(self, rejector: Rejector, asked: Bools) -> tuple[Floats, str]:
        """Return P(false) of some rows, NaN without an answer, and the rejector's remark on its fit."""
        is_answered = self.is_answered[asked]
        found = np.full(len(is_answered), np.nan)
        some = self.answers[asked & self.is_answered].tolist()
        with _blamed(rejector):
            if some:
                count = len(some)  # whatever becomes of the list
                found[is_answered] = check_p_false(rejector.p_false(some), count)
            return found, remark_of(rejector)

    def held_back(self, known: Bools) -> Floats:
        """Return P(false) of calibration rows, each from a fit on others: a tested place is in no fit, either.

        What is left out is a country, as that of a tested place is; of a single country a place, of a single place a
        block. A single block uses its own fit.
        """
        calibration = self.rows[known]
        unit = next((name for name in ("country", "place") if len(set(calibration[name])) > 1), "block")
        names = sorted(set(calibration[unit]))
        if len(names) < 2:  # one block cannot be left out
            return self.applied(self.on(known), known)[0]
        fold = np.full(len(known), -1)
        fold[known] = calibration[unit].map({name: at % _PARTS for at, name in enumerate(names)})
        found = np.full(len(known), np.nan)
        for part in range(min(_PARTS, len(names))):
            rest, mine = known & (fold != part), fold == part
            if (rest & self.is_answered).any():
                found[mine] = self.applied(self.on(rest), mine)[0]
        return found[known]


@contextmanager
def _blamed(rejector: Rejector) -> Iterator[None]:
    """Turn an error of a rejector into one line that names it: a plugin must not end the program."""
    try:
        yield
    except (Exception, SystemExit) as error:
        raise MatchError(
            f"rejector {rejector.card.name!r} failed ({message_of(error)}): mend it, or leave it out"
        ) from error


def _answers_to(rows: pd.DataFrame, predictions: Mapping[str, Prediction]) -> NDArray[np.object_]:
    """Return the answer to each row, shape (N,); None without one."""
    found = np.full(len(rows), None, dtype=object)
    for at, (name, is_answered) in enumerate(zip(rows["query_id"], rows["is_answered"], strict=True)):
        found[at] = predictions[name] if is_answered else None
    return found


@dataclass(frozen=True, kw_only=True)
class RejectionTask:
    """Answers of one entry to evaluate with rejectors, by name; its own confidence is always added.

    `split` assigns calibration places. `is_taught` is True if the entry was trained on other places of the split.
    Results are kept in the folder `kept`, and taken from there, where one is named.
    """

    matcher: str
    scores: pd.DataFrame
    predictions: StoredAnswers
    rules: Mapping[str, Rule]
    split: Split | None
    is_taught: bool
    kept: Path | None = None


@dataclass(frozen=True, kw_only=True)
class RejectionResult:
    """Rows of `judge` by matcher and rejector, rows of the board, and remarks on fits and on what is not applied.

    `acceptance` are rows of `rejection.acceptance_frame`, of rejectors that give chances.
    """

    judged: Mapping[tuple[str, str], pd.DataFrame]
    rows: Sequence[pd.DataFrame]
    acceptance: pd.DataFrame
    remarks: tuple[str, ...]


def evaluate_rejectors(
    tasks: Sequence[RejectionTask],
    *,
    is_whole: bool = True,
    jobs: int,
    dask: str | None = None,
    failures: Failures,
) -> RejectionResult:
    """Evaluate all rejectors on the answers of each entry; the number of processes does not affect the result.

    Record rejectors that fail on an entry; those that do not apply to it are among the remarks. Raise the error of a
    rejector that fails on every entry of a board (`is_whole`): it is at fault, not the answers.
    """
    judged: dict[tuple[str, str], pd.DataFrame] = {}
    rows: list[pd.DataFrame] = []
    accepted: list[pd.DataFrame] = []
    errors: dict[str, list[Exception]] = {}
    remarks: list[str] = []
    found_by_task = spread(_evaluated, tasks, jobs=jobs, dask=dask, label=JUDGED)
    for task, results in zip(tasks, found_by_task, strict=True):
        for name, found in results.items():
            if isinstance(found, Exception):
                failures.note(f"{task.matcher} x {name}", found)
                errors.setdefault(name, []).append(found)
                continue
            frame, figures, taken = found
            if name == OWN and not len(frame):
                continue
            judged[task.matcher, name] = frame
            rows.append(figures)
            accepted += [taken] if len(taken) else []  # columns of an empty one have no type
            if name != OWN and len(frame):
                remarks += [f"{name} on {task.matcher}: {remark}" for remark in remarks_of(frame)]
        idle = [name for name in task.rules if (task.matcher, name) in judged and not len(judged[task.matcher, name])]
        if idle:
            why = why_not(task.scores, is_taught=task.is_taught)
            remarks.append(f"{', '.join(idle)} on {task.matcher}: not applied, {why}")
    for name, listed in errors.items():
        if is_whole and name != OWN and len(listed) == len(tasks):
            raise listed[0]
    for remark in remarks:
        tell(remark)
    acceptance = pd.concat(accepted, ignore_index=True) if accepted else ACCEPTANCE_SCHEMA.empty()
    return RejectionResult(judged=judged, rows=rows, acceptance=acceptance, remarks=tuple(remarks))


def _evaluated(task: RejectionTask) -> dict[str, Judgement | Exception]:
    """Return what each rejector makes of the answers, or the error; own confidence comes first."""
    codes = {OWN: __name__, **{name: rule.code for name, rule in task.rules.items()}}
    kept = _kept(task)
    known = {name: old for name, code in codes.items() if kept and (old := kept.read(name, code)) is not None}
    new = _new(replace(task, rules={name: rule for name, rule in task.rules.items() if name not in known}), known)
    for name, found in new.items():
        if kept and isinstance(found, Judgement):
            kept.write(name, codes[name], found)
    return {name: known[name] if name in known else new[name] for name in codes}


def _kept(task: RejectionTask) -> KeptJudgements | None:
    """Return what is kept of an entry; None where nothing is, as where its answers cannot be read."""
    if task.kept is None:
        return None
    of = partial(KeptJudgements.of, task.kept, task.matcher, task.scores, task.predictions, task.split)
    found = _tried(partial(of, is_taught=task.is_taught))
    return found if isinstance(found, KeptJudgements) else None


def _new(task: RejectionTask, known: Collection[str]) -> dict[str, Judgement | Exception]:
    """Return what is not known yet: of a matcher's own confidence, and of the rejectors of a task."""
    own = partial(own_confidence, task.scores, task.split, is_taught=task.is_taught)
    frames = {} if OWN in known else {OWN: _tried(own)}
    frames |= _judged_by_all(task)  # of the answers none is in memory any more
    return {
        name: frame if isinstance(frame, Exception) else _tried(partial(_with_figures, task, name, frame))
        for name, frame in frames.items()
    }


def _judged_by_all(task: RejectionTask) -> dict[str, pd.DataFrame | Exception]:
    """Return by rejector rows of `judge`, or the error; the answers of a track are in memory at once."""
    if not task.rules:
        return {}
    groups = [*task.scores.groupby(["track", "prior_group"], sort=True).indices.values()]
    parts = [_judged_group(task, task.scores.iloc[rows]) for rows in groups or [[]]]
    return {name: _tried(partial(_joined, [part[name] for part in parts])) for name in task.rules}


def _judged_group(task: RejectionTask, scores: pd.DataFrame) -> dict[str, pd.DataFrame | Exception]:
    """Return by rejector rows of `judge` of one track and prior group, or the error; answers are read once for all."""
    with uncollected():  # the collector would look through all answers over and over
        answers = _tried(partial(task.predictions.some, scores["query_id"][scores["is_answered"].to_numpy(bool)]))
        if isinstance(answers, Exception):
            return dict.fromkeys(task.rules, answers)
        return {
            name: _tried(partial(judge, scores, answers, rule.make, rule.split, is_taught=task.is_taught))
            for name, rule in task.rules.items()
        }


def _joined(parts: Sequence[pd.DataFrame | Exception]) -> pd.DataFrame:
    """Return the rows of all parts; raise the first error."""
    frames = []
    for part in parts:
        if isinstance(part, Exception):
            raise part
        frames.append(part)
    return frames[0] if len(frames) == 1 else pd.concat(frames, ignore_index=True)


def _with_figures(task: RejectionTask, name: str, frame: pd.DataFrame) -> Judgement:
    """Return rows of `judge` with those of the board and of acceptance."""
    is_calibrated = name == OWN or task.rules[name].card.is_calibrated  # own confidence counts as a probability
    figures = FIGURE_SCHEMA.frame(integrity_rows(task.matcher, name, frame, is_calibrated=is_calibrated))
    return Judgement(frame, figures, acceptance_frame(task.matcher, name, frame if is_calibrated else frame[:0]))


def _tried(work: Callable[[], Found]) -> Found | Exception:
    """Return a result, or the error: only this entry with this rejector is skipped."""
    try:
        return work()
    except Exception as error:  # noqa: BLE001
        return error
