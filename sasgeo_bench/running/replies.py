# SPDX-License-Identifier: Apache-2.0
"""Parse the answers of a plugin's process against one schema: the process is not trusted."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, Any, Final, Literal, TypeVar

from pydantic import AfterValidator, BaseModel, ConfigDict, Field, Strict, ValidationError

from sasgeo_bench.errors import MatchError
from sasgeo_bench.geometry.pose import Pose
from sasgeo_bench.matching.matcher import MOST_SAID, Match, MatcherCard, Need, check_learned
from sasgeo_bench.matching.results import Status
from sasgeo_bench.matching.tracker import MOST_VARIANCE, SIDE
from sasgeo_bench.running.wire import Message
from sasgeo_bench.tasks.query import Track
from sasgeo_bench.texts import (
    BOUNDS,
    MOST_CANDIDATES,
    MOST_DIAGNOSTICS,
    MOST_MESSAGE,
    MOST_NAME,
    MOST_S,
    is_line,
    one_line,
)

_MOST_BYTES: Final = 2**50  # of memory


@dataclass(frozen=True, slots=True, kw_only=True)
class PluginReply:
    """Reply of any plugin to a question, with its status, and its cause in one line.

    `seconds` is by the runner's clock, `own_s` and `cpu_s` are those that the process reports. Loading returns whether
    the plugin `learns`; training, the `learned` text.
    """

    status: Status
    message: str = ""
    seconds: float | None = None
    own_s: float | None = None
    cpu_s: float = 0.0
    learns: bool = False
    learned: str | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class Reply(PluginReply):
    """Reply of a matcher: loading returns its `card` too; preparing, by how much memory grew; a query, the `match`.

    A tracker's says whether its estimate is accepted, and its covariance, 3 x 3 row by row.
    """

    match: Match | None = None
    is_accepted: bool | None = None
    covariance: tuple[float, ...] | None = None
    card: MatcherCard | None = None
    grown_bytes: int | None = None


def _line(text: str) -> str:
    if not is_line(text, MOST_SAID):
        raise ValueError(f"must be one line of at most {MOST_SAID} printable characters")
    return text


def _bounded(name: str) -> Any:  # noqa: ANN401 - a field of pydantic
    least, most = BOUNDS[name]
    return Field(ge=least, le=most)


Model = TypeVar("Model", bound=BaseModel)

Line = Annotated[str, AfterValidator(_line)]
Metres = Annotated[float, _bounded("easting_m")]
Candidate = Annotated[  # JSON has no tuples: a list of just as many is one
    tuple[
        Metres,
        Metres,
        Annotated[float, _bounded("yaw_deg")],
        Annotated[float, _bounded("scale")],
        Annotated[float, _bounded("score")],
    ],
    Strict(strict=False),
]
Diagnostic = Annotated[
    tuple[Annotated[Line, Field(min_length=1, max_length=MOST_NAME)], Annotated[float, _bounded("diagnostics")]],
    Strict(strict=False),
]
Variance = Annotated[float, Field(ge=-MOST_VARIANCE, le=MOST_VARIANCE)]
Seconds = Annotated[float, Field(ge=0, le=MOST_S)]


def _once(pairs: list[tuple[str, float]]) -> list[tuple[str, float]]:
    if len(dict(pairs)) != len(pairs):
        raise ValueError("a name is there twice")
    return pairs


class Strictly(BaseModel):
    """No silent conversion, nothing that is not known, no number that is none."""

    model_config = ConfigDict(frozen=True, extra="forbid", strict=True, allow_inf_nan=False)


class Failed(Strictly):
    """A failure, and its cause."""

    status: Literal["crash", "invalid", "refused"]
    message: Annotated[Line, Field(max_length=MOST_MESSAGE)]


class SentCard(Strictly):
    """Fields of every plugin's card."""

    name: Line
    version: Line
    title: Line
    source: Line
    ours: Line
    licence: Line
    limits: Line
    trained_on: Annotated[list[Line], Field(max_length=1000)]

    def fields(self) -> dict[str, Any]:
        """Return the arguments of a card, which has tuples for lists."""
        return {name: tuple(value) if isinstance(value, list) else value for name, value in self}


class _Card(SentCard):
    tracks: list[Track]
    needs: list[Need]
    uses: list[Line]
    authors: list[Line]
    contact: Line
    code: Line


class _Loaded(Strictly):
    status: Literal["ok"]
    card: _Card
    learns: bool

    def reply(self) -> Reply:
        return Reply(status="ok", card=MatcherCard(**self.card.fields()), learns=self.learns)


class _Trained(Strictly):
    status: Literal["ok"]
    seconds: Seconds
    learned: str

    def reply(self) -> Reply:
        return Reply(status="ok", own_s=self.seconds, learned=check_learned(self.learned))


class _Prepared(Strictly):
    status: Literal["ok"]
    seconds: Seconds
    grown_bytes: Annotated[int, Field(ge=0, le=_MOST_BYTES)]

    def reply(self) -> Reply:
        return Reply(status="ok", own_s=self.seconds, grown_bytes=self.grown_bytes)


class _Row(Strictly):
    candidates: Annotated[list[Candidate], Field(max_length=MOST_CANDIDATES)]
    confidence: Annotated[float, _bounded("confidence")] | None
    diagnostics: Annotated[list[Diagnostic], Field(max_length=MOST_DIAGNOSTICS), AfterValidator(_once)]
    is_accepted: bool | None = None
    covariance: Annotated[list[Variance], Field(min_length=SIDE**2, max_length=SIDE**2)] | None = None


class _Matched(Strictly):
    status: Literal["ok"]
    seconds: Seconds
    cpu_s: Annotated[float, Field(ge=0)]
    match: _Row

    def reply(self) -> Reply:
        row = self.match
        match = Match(
            poses=[Pose(easting_m=x, northing_m=y, yaw_deg=yaw, scale=scale) for x, y, yaw, scale, _ in row.candidates],
            scores=[candidate[-1] for candidate in row.candidates],
            confidence=row.confidence,
            diagnostics=dict(row.diagnostics),
        )
        return Reply(
            status="ok",
            own_s=self.seconds,
            cpu_s=self.cpu_s,
            match=match,
            is_accepted=row.is_accepted,
            covariance=None if row.covariance is None else tuple(row.covariance),
        )


_KINDS: Final[Mapping[str, type[_Loaded | _Trained | _Prepared | _Matched]]] = {
    "load": _Loaded,
    "learn": _Trained,
    "prepare": _Prepared,
    "match": _Matched,
}


def read_reply(kind: str, given: Message, *, nonce: str) -> Reply:
    """Read a JSON message as the reply to a question of a kind: "load", "learn", "prepare" or "match".

    `nonce` is that of the question, so that no answer can be made before it. Raise `MatchError`, in one line, if the
    message is no answer to the question.

    >>> given = {"nonce": "7", "status": "crash", "message": "ValueError: no index today"}
    >>> read_reply("match", given, nonce="7").message
    'ValueError: no index today'
    """
    answer = read_answer(_KINDS[kind], given, nonce=nonce)
    return Reply(status=answer.status, message=answer.message) if isinstance(answer, Failed) else answer.reply()


def read_answer(model: type[Model], given: Message, *, nonce: str) -> Model | Failed:
    """Read a JSON message as an answer of a model, or as a failure.

    Raise `MatchError`, in one line, if it was made for another question or is neither.
    """
    content = dict(given)
    if content.pop("nonce", None) != nonce:
        raise MatchError("it was not made for this question")
    try:
        return Failed.model_validate(content) if content.get("status") != "ok" else model.model_validate(content)
    except ValidationError as error:
        first = error.errors(include_url=False, include_input=False, include_context=False)[0]
        where = ".".join(map(str, first["loc"]))[:60]  # characters of where a fault is
        raise MatchError(one_line(f"{where}: {first['msg']}" if where else first["msg"])) from error
