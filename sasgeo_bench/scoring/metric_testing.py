# SPDX-License-Identifier: Apache-2.0
"""Metrics of one's own: a new package, and what each promises, checked on answers worked by hand."""

import math
from collections.abc import Iterator, Mapping
from contextlib import nullcontext
from dataclasses import dataclass, replace
from functools import partial
from itertools import cycle
from pathlib import Path
from typing import Final

import numpy as np
import pandas as pd

from sasgeo_bench.core.errors import ConfigError, MatchError, MetricError
from sasgeo_bench.core.folders import scratch_folder
from sasgeo_bench.core.plugins import METRICS
from sasgeo_bench.matching.matcher import Prediction
from sasgeo_bench.matching.scaffold import Package, files_of
from sasgeo_bench.running.testing import Check, tiny_place, tried
from sasgeo_bench.running.tracker_testing import tiny_flights
from sasgeo_bench.scoring.base import Floats
from sasgeo_bench.scoring.flights import score_flights
from sasgeo_bench.scoring.metric import MeanMetric
from sasgeo_bench.scoring.metric_plugins import COLUMNS, SHIPPED, find_metric, unequal, values_of
from sasgeo_bench.scoring.metrics import means_of
from sasgeo_bench.scoring.score import score_task
from sasgeo_bench.tasks.query import SEQUENCE, Head, Truth
from sasgeo_bench.tasks.task_files import Task

_OFF_M: Final = 400.0  # of an answer that is wrong by any measure
# Who answers: how far off each answer is, in turn; None for no answer
_WAYS: Final[Mapping[str, tuple[float | None, ...]]] = {
    "right": (0.0,),
    "far": (_OFF_M,),
    "silent": (None,),
    "mixed": (0.0, _OFF_M, None),
}
_SURE: Final = (25.0, 0.0, 0.0, 0.0, 25.0, 0.0, 0.0, 0.0, 9.0)  # covariance of an estimate on a flight: 5 m, 3 deg
_SLACK: Final = 1e-9


def check_metric(spec: str, *, out: Path | None = None) -> Iterator[Check]:
    """Try a metric, by name or "module:NAME", on answers that are worked by hand; yield a row for each rule.

    It runs in this process, as it does when a board is scored: name only code that you trust. `out` is where the small
    towns are kept from one metric to the next; by default a scratch folder.

    Examples
    --------
    >>> {check.outcome for check in check_metric("within_25m")}
    {'pass'}
    """
    name = "loads, and says what it is"
    try:
        metric = find_metric(spec)
    except MatchError as error:
        yield Check(name=name, outcome="fail", found=str(error))
        return
    low, high = metric.bounds
    summary = f"{metric.name}: {metric.better} is better, {low:g} to {high:g}, unit {metric.unit}"
    yield Check(name=name, outcome="pass", found=summary)
    if not isinstance(metric, MeanMetric):
        yield Check(name="a mean over queries", outcome="not applicable", found="it is a metric of another kind")
        return
    with nullcontext(out) if out else scratch_folder("check") as folder:
        for track in metric.tracks:
            yield from _Kit(metric, track, worked_answers(folder, track)).checks()


def worked_answers(folder: Path, track: str) -> dict[str, pd.DataFrame]:
    """Return scored rows of a small town by who answered: right, 400 m off, nothing, and of these in turn.

    The last place of single views is taken for absent. The town is built in the folder.
    """
    is_flown = track == SEQUENCE
    root = folder / track
    (tiny_flights if is_flown else tiny_place)(root)
    tasks = [Task.open(path, root) for path in sorted((root / "tasks").glob("*/*"))]
    heads = [head for task in tasks for head in task.heads() if head.track == track]
    truths = {truth.query_id: truth for task in tasks for truth in task.truths}
    if not is_flown:
        lost = heads[-1].query_id
        truths[lost] = replace(truths[lost], is_present=False, candidate=-1)
    known = [truths[head.query_id] for head in heads]
    found = {}
    for name, ways in _WAYS.items():
        answers = {
            head.query_id: _answer(head, truth, off_m)
            for head, truth, off_m in zip(heads, known, cycle(ways), strict=False)
            if off_m is not None and (truth.is_present or off_m > 0)
        }
        found[name] = score_flights(heads, known, answers).flights if is_flown else score_task(heads, known, answers)
    return found


def _answer(head: Head, truth: Truth, off_m: float) -> Prediction:
    """Return the true pose, or one that is off; of candidates all, the right one first, or last."""
    if head.candidates:
        ranked = sorted(range(len(head.candidates)), key=lambda at: (at == truth.candidate) == (off_m > 0))
        given = tuple((head.candidates[at], -float(place)) for place, at in enumerate(ranked))
        return Prediction(query_id=head.query_id, candidates=given, confidence=0.5, latency_s=0.1)
    if truth.pose is None:
        raise MetricError(f"{head.query_id} has no true pose")
    pose = replace(truth.pose, easting_m=truth.pose.easting_m + off_m)
    answer = Prediction(query_id=head.query_id, candidates=((pose, 1.0),), confidence=0.5, latency_s=0.1)
    return replace(answer, is_accepted=True, covariance=_SURE) if head.track == SEQUENCE else answer


_MISSES: Final = "no answer is the worst there is"
_MEND: Final = ": let it be the worst, or name in read_with the metric that counts it"


@dataclass(frozen=True)
class _Kit:
    """Checks of one metric on one track; each returns a fault in words, or None."""

    metric: MeanMetric
    track: str
    scores: Mapping[str, pd.DataFrame]

    def checks(self) -> Iterator[Check]:
        first = f"{self.track}: a number, or NaN, for each query"
        try:
            values = {name: values_of(self.metric, frame) for name, frame in self.scores.items()}
        except MetricError as error:
            yield Check(name=first, outcome="fail", found=str(error))
            return
        means = {name: float(np.nanmean(one)) if np.isfinite(one).any() else math.nan for name, one in values.items()}
        worked = f"right {means['right']:g}, {_OFF_M:g} m off {means['far']:g}, no answer {means['silent']:g}"
        counted = int(np.isfinite(values["right"]).sum())
        found = f"{counted} of {len(values['right'])} queries count"
        if not counted:
            found = "no query of the small town counts, so nothing is checked: see that a board has figures of it"
            yield Check(name=first, outcome="not applicable", found=found)
            return
        yield Check(name=first, outcome="pass", found=worked)
        for rule in tried(
            (
                ("the same queries count for every method", partial(unequal, values, self.scores), found),
                ("the given scores are not changed", self.changes_nothing, f"{len(self.scores)} tables"),
                ("each query by itself, in any order", partial(self.ignores_others, values), "backwards, and a half"),
                (_MISSES, partial(self.misses, values), f"worst: {self.metric.worst:g}"),
            )
        ):
            named = replace(rule, name=f"{self.track}: {rule.name}")
            is_excused = rule.name == _MISSES and rule.outcome == "pass" and self.metric.read_with
            other = f"read with {self.metric.read_with}"
            yield replace(named, outcome="not applicable", found=other) if is_excused else named

    def changes_nothing(self) -> str | None:
        for name, frame in self.scores.items():
            given = frame.copy()
            self.metric.values(given)
            self.metric.counts(given)
            if not given.equals(frame):
                return f"it changes the scores of the answers that are {name}: work on a copy"
        return None

    def ignores_others(self, values: Mapping[str, Floats]) -> str | None:
        for name, frame in self.scores.items():
            for rows in (np.arange(len(frame))[::-1], np.arange(0, len(frame), 2)):
                again = values_of(self.metric, frame.iloc[rows])
                if not np.array_equal(again, values[name][rows], equal_nan=True):
                    return "a query has another value beside other queries, or in another order"
        return None

    def misses(self, values: Mapping[str, Floats]) -> str | None:
        """Compare places on the map without an answer with the same places answered, rightly and 400 m off."""
        other = self.metric.read_with
        if other:
            others = sorted(metric.name for metric in means_of(self.track) if not metric.read_with)
            return None if other in others else f"read_with is {other!r}, expected one of {', '.join(others)}"
        if all(np.array_equal(one, values["silent"], equal_nan=True) for one in values.values()):
            return None  # it is of the queries alone, as chance is
        sign = 1.0 if self.metric.better == "higher" else -1.0
        present = self.scores["silent"]["is_present"].to_numpy(bool) & np.isfinite(values["silent"])
        silent = values["silent"][present]
        for name in ("right", "far"):
            if (sign * silent > sign * values[name][present] + _SLACK).any():
                return f"a place on the map without an answer is better than an answer that is {name}{_MEND}"
        return None


_METRIC: Final = '''\
"""The metric {name}: here is where your measure goes."""

import numpy as np
import pandas as pd
from sasgeo_bench import MeanMetric

NEAR_M, FAR_M = 5.0, 50.0


def values(scores: pd.DataFrame) -> np.ndarray:
    """Return a number for each row of scores.parquet; NaN leaves a query out, whichever method answered it."""
    error_m = scores["position_error_m"].to_numpy(float)  # infinite without an answer, which so scores 0
    near = np.clip((FAR_M - error_m) / (FAR_M - NEAR_M), 0.0, 1.0)
    return np.where(scores["is_present"], near, np.nan)


METRIC = MeanMetric(
    name="{name}",
    meaning="Nearness of the fix: 1 within 5 m of the place, 0 beyond 50 m or without an answer, even between",
    unit="1",
    better="higher",
    bounds=(0.0, 1.0),
    tracks=("localization",),
    values=values,
)
'''

_README: Final = """\
# {title}

A metric for sasgeo-bench: one more column of every table of suites.

```bash
pip install -e .
sasgeo-bench check {name}
sasgeo-bench score --predictions out/runs --metric {name} --name with-{name}
```

The metric is a mean over queries of what `values` in `src/{module}/metric.py` returns. A pipeline file takes it as
`metrics = ["{name}"]`. It runs inside the program, without a sandbox; a board names it with the hash of its code.
"""


def metric_files(name: str) -> dict[str, str]:
    """Return the text of every file of a new package with a metric, by its path.

    `name` is that of the metric; raise `ConfigError` if it is not allowed, or taken.

    >>> sorted(metric_files("my-metric"))[-1]
    'tests/test_conforms.py'
    """
    if name in SHIPPED or name in COLUMNS:
        raise ConfigError(f"{name!r} is a metric or a column of sasgeo-bench itself; choose another name")
    return files_of(Package(METRICS, _METRIC, _README, attribute="METRIC"), name)
