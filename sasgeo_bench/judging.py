# SPDX-License-Identifier: Apache-2.0
"""What rejectors say of the answers of many contestants, and the figures of it, by several processes."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field

import pandas as pd

from sasgeo_bench.processes import spread
from sasgeo_bench.report.integrity import integrity_rows
from sasgeo_bench.report.rejection import OWN, Rule, judge, own_word, why_not
from sasgeo_bench.report.rows import to_frame
from sasgeo_bench.results import Prediction
from sasgeo_bench.split import Split


@dataclass(frozen=True, kw_only=True)
class Judging:
    """Answers of one contestant that rejectors are to judge.

    Parameters
    ----------
    matcher : str
        Its name on the board.
    scores : pandas.DataFrame
        Its scored rows.
    predictions : mapping of str to Prediction
        Its answers, by query.
    rules : mapping of str to Rule
        Rejectors by name; its own word is always among them.
    split : Split, optional
        Says which places calibrate.
    is_taught : bool
        Whether it has learnt from other places of the split.
    """

    matcher: str
    scores: pd.DataFrame
    predictions: Mapping[str, Prediction]
    rules: Mapping[str, Rule]
    split: Split | None
    is_taught: bool


@dataclass(frozen=True, kw_only=True)
class Judged:
    """What came of it: by rejector what it says (`judge`), rows of the board, and why some were not applied."""

    matcher: str
    said: Mapping[str, pd.DataFrame]
    rows: tuple[pd.DataFrame, ...] = ()
    lines: tuple[str, ...] = field(default=())


def carry_out(judgings: Sequence[Judging], *, jobs: int = 1) -> Iterator[Judged]:
    """Have all of them judged, by several processes if there are several jobs; no figure hangs on how many there are.

    Parameters
    ----------
    judgings : sequence of Judging
        One for each contestant.
    jobs : int
        Processes.

    Yields
    ------
    Judged
        One for each, in their order.

    Raises
    ------
    MatchError
        If a rejector fails.

    Examples
    --------
    >>> list(carry_out([], jobs=2))
    []
    """
    yield from spread(judged, judgings, jobs=jobs)


def judged(judging: Judging) -> Judged:
    """What the rejectors say of one contestant, its own word among them; no row where one is not applied."""
    own = own_word(judging.scores, judging.split, is_taught=judging.is_taught)
    said = {OWN: own} if len(own) else {}
    lines = []
    for name, rule in judging.rules.items():
        said[name] = judge(judging.scores, judging.predictions, rule.make, rule.split, is_taught=judging.is_taught)
        if not len(said[name]):
            why = why_not(judging.scores, is_taught=judging.is_taught)
            lines.append(f"{name} on {judging.matcher}: not applied, {why}")
    rows = tuple(_figures(judging, name, frame) for name, frame in said.items() if len(frame))
    return Judged(matcher=judging.matcher, said=said, rows=rows, lines=tuple(lines))


def _figures(judging: Judging, name: str, frame: pd.DataFrame) -> pd.DataFrame:
    """Rows of the board; its own word is taken for a probability."""
    is_calibrated = name == OWN or judging.rules[name].card.is_calibrated
    return to_frame(list(integrity_rows(judging.matcher, name, frame, is_calibrated=is_calibrated)))
