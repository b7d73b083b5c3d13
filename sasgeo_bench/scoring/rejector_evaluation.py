# SPDX-License-Identifier: Apache-2.0
"""Outputs of rejectors for the answers of many entries, with their metrics, in parallel processes."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field

import pandas as pd

from sasgeo_bench.matching.results import Prediction
from sasgeo_bench.parallel import spread
from sasgeo_bench.scoring.integrity import integrity_rows
from sasgeo_bench.scoring.rejection import OWN, Rule, judge, own_word, why_not
from sasgeo_bench.scoring.rows import to_frame
from sasgeo_bench.tasks.split import Split


@dataclass(frozen=True, kw_only=True)
class Judging:
    """Answers of one entry to evaluate with rejectors.

    Parameters
    ----------
    matcher : str
        Its name on the board.
    scores : pandas.DataFrame
        Its scored rows.
    predictions : mapping of str to Prediction
        Its answers, by query.
    rules : mapping of str to Rule
        Rejectors by name; its own confidence is always added.
    split : Split, optional
        Assigns calibration places.
    is_taught : bool
        True if it was trained on other places of the split.
    """

    matcher: str
    scores: pd.DataFrame
    predictions: Mapping[str, Prediction]
    rules: Mapping[str, Rule]
    split: Split | None
    is_taught: bool


@dataclass(frozen=True, kw_only=True)
class Judged:
    """Result for one entry.

    By rejector: the rows of `judge`, and the errors of those that failed. Then rows of the board, and lines that say
    why rejectors were not applied.
    """

    matcher: str
    said: Mapping[str, pd.DataFrame]
    rows: tuple[pd.DataFrame, ...] = ()
    lines: tuple[str, ...] = field(default=())
    failed: Mapping[str, Exception] = field(default_factory=dict)


def carry_out(judgings: Sequence[Judging], *, jobs: int = 1) -> Iterator[Judged]:
    """Yield the result of each task in order; the number of processes does not affect it."""
    yield from spread(judged, judgings, jobs=jobs)


def judged(judging: Judging) -> Judged:
    """Apply all rejectors to one entry, and its own confidence; a rejector that is not applied has no rows."""
    said, rows, lines, failed = {}, [], [], {}
    for name in (OWN, *judging.rules):
        try:
            frame = _said(judging, name)
            rows += [_figures(judging, name, frame)] if len(frame) else []
        except Exception as error:  # noqa: BLE001 - these answers and this rejector alone do without a figure
            failed[name] = error
            continue
        if len(frame) or name != OWN:
            said[name] = frame
        if not len(frame) and name != OWN:
            why = why_not(judging.scores, is_taught=judging.is_taught)
            lines.append(f"{name} on {judging.matcher}: not applied, {why}")
    return Judged(matcher=judging.matcher, said=said, rows=tuple(rows), lines=tuple(lines), failed=failed)


def _said(judging: Judging, name: str) -> pd.DataFrame:
    """Return the rows of a rejector, or of the matcher's own confidence."""
    if name == OWN:
        return own_word(judging.scores, judging.split, is_taught=judging.is_taught)
    rule = judging.rules[name]
    return judge(judging.scores, judging.predictions, rule.make, rule.split, is_taught=judging.is_taught)


def _figures(judging: Judging, name: str, frame: pd.DataFrame) -> pd.DataFrame:
    """Return rows of the board; a matcher's own confidence counts as a probability."""
    is_calibrated = name == OWN or judging.rules[name].card.is_calibrated
    return to_frame(list(integrity_rows(judging.matcher, name, frame, is_calibrated=is_calibrated)))
