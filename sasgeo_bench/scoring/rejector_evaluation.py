# SPDX-License-Identifier: Apache-2.0
"""Outputs of rejectors for the answers of many entries, with their metrics, in parallel processes."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field

import pandas as pd

from sasgeo_bench.matching.results import Prediction
from sasgeo_bench.parallel import spread
from sasgeo_bench.scoring.integrity import integrity_rows
from sasgeo_bench.scoring.rejection import OWN, Rule, judge, own_confidence, why_not
from sasgeo_bench.scoring.rows import to_frame
from sasgeo_bench.tasks.split import Split


@dataclass(frozen=True, kw_only=True)
class RejectionTask:
    """Answers of one entry to evaluate with rejectors, by name; its own confidence is always added.

    `split` assigns calibration places. `is_taught` is True if the entry was trained on other places of the split.
    """

    matcher: str
    scores: pd.DataFrame
    predictions: Mapping[str, Prediction]
    rules: Mapping[str, Rule]
    split: Split | None
    is_taught: bool


@dataclass(frozen=True, kw_only=True)
class RejectionResult:
    """Result for one entry.

    By rejector: the rows of `judge`, and the errors of those that failed. Then rows of the board, and lines that say
    why rejectors were not applied.
    """

    matcher: str
    by_rejector: Mapping[str, pd.DataFrame]
    rows: tuple[pd.DataFrame, ...] = ()
    skipped: tuple[str, ...] = field(default=())
    failed: Mapping[str, Exception] = field(default_factory=dict)


def apply_rejectors(tasks: Sequence[RejectionTask], *, jobs: int = 1) -> Iterator[RejectionResult]:
    """Yield the result of each task in order; the number of processes does not affect it."""
    yield from spread(_evaluated, tasks, jobs=jobs)


def _evaluated(task: RejectionTask) -> RejectionResult:
    """Apply all rejectors to one entry, and its own confidence; a rejector that is not applied has no rows."""
    by_rejector, rows, skipped, failed = {}, [], [], {}
    for name in (OWN, *task.rules):
        try:
            frame = _rows_of(task, name)
            rows += [_metrics(task, name, frame)] if len(frame) else []
        except Exception as error:  # noqa: BLE001 - only this entry with this rejector is skipped
            failed[name] = error
            continue
        if len(frame) or name != OWN:
            by_rejector[name] = frame
        if not len(frame) and name != OWN:
            why = why_not(task.scores, is_taught=task.is_taught)
            skipped.append(f"{name} on {task.matcher}: not applied, {why}")
    return RejectionResult(
        matcher=task.matcher, by_rejector=by_rejector, rows=tuple(rows), skipped=tuple(skipped), failed=failed
    )


def _rows_of(task: RejectionTask, name: str) -> pd.DataFrame:
    """Return the rows of a rejector, or of the matcher's own confidence."""
    if name == OWN:
        return own_confidence(task.scores, task.split, is_taught=task.is_taught)
    rule = task.rules[name]
    return judge(task.scores, task.predictions, rule.make, rule.split, is_taught=task.is_taught)


def _metrics(task: RejectionTask, name: str, frame: pd.DataFrame) -> pd.DataFrame:
    """Return rows of the board; a matcher's own confidence counts as a probability."""
    is_calibrated = name == OWN or task.rules[name].card.is_calibrated
    return to_frame(list(integrity_rows(task.matcher, name, frame, is_calibrated=is_calibrated)))
