# SPDX-License-Identifier: Apache-2.0
"""Flights as their tests have them: a task that was drawn, and a run whose answers the tests invent."""

import dataclasses
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

from sasgeo_bench.geometry.pose import Pose
from sasgeo_bench.matching.matcher import Prediction
from sasgeo_bench.observing.fix_files import NS, PlacedFix
from sasgeo_bench.observing.flight_fixes import FlightFixes
from sasgeo_bench.running.prediction_files import RunManifest, write_part
from sasgeo_bench.tasks.query import Truth
from sasgeo_bench.tasks.task_files import Task

START_NS = 1_777_629_600 * NS + 250_000_000  # 2026-05-01 10:00:00.25 UTC
SPREAD = ((16.0, 6.0, 1.5), (6.0, 9.0, -2.0), (1.5, -2.0, 4.0))  # east, north, yaw; m2, m deg, deg2
OFF_M = (3.0, -4.0)


def answer(truth: Truth, **changes: object) -> Prediction:
    """An answer that is off by `OFF_M` and 2 degrees."""
    pose = truth.pose
    found = Pose(easting_m=pose.easting_m + OFF_M[0], northing_m=pose.northing_m + OFF_M[1], yaw_deg=pose.yaw_deg + 2.0)
    usual = {
        "query_id": truth.query_id,
        "candidates": ((found, 1.0),),
        "confidence": 0.9,
        "latency_s": 0.5,
        "is_accepted": True,
        "covariance": tuple(np.ravel(SPREAD).tolist()),
    }
    return Prediction(**usual | changes)


def run_of(out: Path, task: Path, answers: Callable[[int, Truth], Prediction | None], name: str = "made-up") -> Path:
    """Write a run of a task: by the number of the view in its flight and the truth, its answer or None."""
    opened = Task.open(task)
    folder = out / "runs" / name / "0123456789ab" / opened.manifest.suite / opened.manifest.region
    folder.mkdir(parents=True)
    frames = {head.query_id: head.frame or 0 for head in opened.heads()}
    made = [answers(frames[truth.query_id], truth) for truth in opened.truths]
    RunManifest(suite=opened.manifest.suite, region=opened.manifest.region, hash="0123456789ab").save(folder)
    write_part(folder, [one for one in made if one is not None], asked=opened.asked)
    return folder


def flights_of(task: Path) -> dict[str, list[Truth]]:
    """Truths of each flight of a task, in the order of time."""
    opened = Task.open(task)
    found: dict[str, list[Truth]] = {}
    for head, truth in zip(opened.heads(), opened.truths, strict=True):
        found.setdefault(head.sequence_id, []).append(truth)
    return found


def invented(count: int = 5, **changes: Sequence[object] | object) -> FlightFixes:
    """A flight of fixes a second apart, to the north-east; a list holds what each fix has."""
    fixes = []
    for at in range(count):
        fix = PlacedFix(
            name=f"view-{at}",
            lon_deg=9.52 + at * 2e-4,
            lat_deg=47.14 + at * 1e-4,
            east_m=539_000.0 + 15 * at,
            north_m=5_221_000.0 + 11 * at,
            heading_deg=(350.0 + 10.0 * at) % 360,
            yaw_deg=(350.4 + 10.0 * at) % 360,
            is_accepted=True,
            p_false=0.01,
            covariance=tuple(np.ravel(SPREAD).tolist()),
            time_ns=START_NS + at * NS,
            delay_s=0.25,
        )
        own = {name: value[at] if isinstance(value, list) else value for name, value in changes.items()}
        fixes.append(dataclasses.replace(fix, **own))
    return FlightFixes(
        flight="00ff", fixes=tuple(fixes), views=count, begin_ns=START_NS, clock="utc", epsg=32632, credit="(c) a & b"
    )
