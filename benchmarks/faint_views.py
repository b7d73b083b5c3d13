# SPDX-License-Identifier: Apache-2.0
"""Say what ranks the modes of views with probabilities: what the map explains of each class, and heading and scale.

    sasgeo-bench leaderboard pictures --out out
    .venv/bin/python benchmarks/faint_views.py out andorra-la-vella-ortho andorra-la-vella-ortho@2020-05-01
    .venv/bin/python benchmarks/faint_views.py out --flights andorra-la-vella-ortho

Searches the views of `real-image` that `osm_unet_held_out` segmented at the named regions, as `sasgeo` does, and ranks
the modes of each search in several ways. Found is within 25 m and 5 deg; *listed* is the share of views of which any
mode is right. `cells` is the number of independent cells, `INDEPENDENT`; 0 leaves that term out.

`--flights` segments the views of `flight-real-image` and follows each flight, falsifiers apart, by `sasgeo_track`: with
each cell alone, and with errors that hang together in faint views, for several shares of the exponents.
"""

import argparse
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

import sasgeo_bench as sgb
from sasgeo_bench.core.errors import SasgeoError
from sasgeo_bench.geometry.pose import wrap_deg
from sasgeo_bench.regions.evidence import UNKNOWN
from sasgeo_bench.sasgeo.overlap import INDEPENDENT
from sasgeo_bench.sasgeo.reading import Reader
from sasgeo_bench.sasgeo.scorer_model import ScorerModel
from sasgeo_bench.sasgeo.trackers import SasgeoTrack
from sasgeo_bench.sasgeo.variants import LISTED, Sasgeo
from sasgeo_bench.search.find import search
from sasgeo_bench.search.plan import Plan
from sasgeo_bench.tasks.frame_evidence import evidence_of
from sasgeo_bench.tasks.query import Query
from sasgeo_bench.tasks.task_files import read_queries, read_truths

SUITE: Final = "real-image+osm_unet_held_out"
CELLS: Final = (0.0, 5.0, 10.0, 20.0, 40.0, 80.0)
FLIGHTS: Final = "flight-real-image"
CLOSE_M, CLOSE_DEG = 25.0, 5.0
EXPONENTS: Final = (0.25, 0.5, 1.0)

Ranked = tuple[NDArray[np.float64], NDArray[np.bool_]]  # terms of the modes of a view, and which modes are right


def ranked(out: Path, name: str) -> Iterator[Ranked]:
    """Yield the modes of each single view of a region."""
    region = sgb.read_region(out / "regions" / name)
    reader = Reader.of(region, ScorerModel.by_hand(region.classes), Sasgeo.switches)
    truths = {truth.query_id: truth for truth in read_truths(out / "truth" / SUITE / name)}
    for query in read_queries(out / "tasks" / SUITE / name):
        truth = truths[query.query_id]
        is_single = truth.kind.startswith(("R1", "R3")) and truth.role != "falsifier"
        if not is_single or truth.pose is None or (query.evidence.cells == UNKNOWN).all():
            continue
        reading = reader.read(query)
        modes = search(reader.field, reading.template, query.prior, reading.plan(Plan()), count=LISTED).modes
        if modes:
            poses = [mode.pose for mode in modes]
            yield (
                reading.terms(poses, reading.verified(poses)),
                np.array([is_close(pose, truth.pose) for pose in poses]),
            )


def is_close(pose: sgb.Pose, truth: sgb.Pose) -> bool:
    """Return whether a pose is right."""
    far_m = np.hypot(pose.easting_m - truth.easting_m, pose.northing_m - truth.northing_m)
    return bool(far_m <= CLOSE_M and abs(wrap_deg(pose.yaw_deg - truth.yaw_deg)) <= CLOSE_DEG)


def found(views: list[Ranked], cells: float, *, with_prior: bool) -> float:
    """Return the share of views whose best mode is right."""
    hits = []
    for terms, is_right in views:
        count = (terms.shape[1] - 2) // 2  # classes; raster, explained, then heading and scale
        scores = terms[:, :count].sum(axis=1) + cells / INDEPENDENT * terms[:, count:-2].sum(axis=1)
        hits.append(is_right[np.argmax(scores + with_prior * terms[:, -2:].sum(axis=1))])
    return float(np.mean(hits))


def flights_of(out: Path, name: str) -> Iterator[list[tuple[Query, sgb.Pose]]]:
    """Yield the segmented views of each flight over a region, with their poses."""
    truths = {truth.query_id: truth for truth in read_truths(out / "truth" / FLIGHTS / name)}
    segmenter, flights = sgb.load_segmenter("osm_unet_held_out"), {}
    for query in read_queries(out / "tasks" / FLIGHTS / name):
        truth = truths[query.query_id]
        if truth.role == "falsifier" or truth.pose is None or query.step is None:
            continue
        seen = [segmenter.segment(frame.image(), learned=None) for frame in query.frames]
        size = {"size_cells": query.evidence.shape[0], "cell_size_m": query.evidence.cell_size_m}
        evidence = evidence_of(query.frames, seen, **size) or query.evidence
        flights.setdefault(query.step.sequence_id, []).append((replace(query, evidence=evidence), truth.pose))
    for views in flights.values():
        yield sorted(views, key=lambda view: view[0].step.frame)


def followed(tracker: SasgeoTrack, views: list[tuple[Query, sgb.Pose]]) -> tuple[float, int, int]:
    """Return the share of views within 25 m, how many fixes are accepted, and how many of these are false."""
    tracker.start(views[0][0].prior)
    is_near, is_accepted = [], []
    for query, truth in views:
        fix = tracker.step(query)
        off_m = np.inf
        if fix.pose is not None:
            off_m = np.hypot(fix.pose.easting_m - truth.easting_m, fix.pose.northing_m - truth.northing_m)
        is_near.append(off_m <= CLOSE_M)
        is_accepted.append(fix.is_accepted)
    near, accepted = np.array(is_near), np.array(is_accepted)
    return float(near.mean()), int(accepted.sum()), int((accepted & ~near).sum())


class CellsAlone(SasgeoTrack):
    """The tracker for which each cell counts alone in faint views, too."""

    switches = replace(SasgeoTrack.switches, correlates="never")


def print_flights(out: Path, name: str) -> None:
    """Print a row for each way to follow the flights over a region."""
    flights, region = list(flights_of(out, name)), sgb.read_region(out / "regions" / name)
    print("| Region | Errors | Exponents | Flights | Within 25 m, % | Accepted | False |")
    print(f"|---|---|{'---:|' * 5}")
    for words, make in (("each cell alone", CellsAlone), ("hang together", SasgeoTrack)):
        for exponent_scale in EXPONENTS:
            tracker = make()
            tracker.exponent_scale = exponent_scale
            tracker.prepare(region, None)
            near, accepted, false = zip(*(followed(tracker, views) for views in flights), strict=True)
            cells = (f"{exponent_scale:g}", len(flights), f"{100 * np.mean(near):.0f}", sum(accepted), sum(false))
            print(f"| {name} | {words} | {' | '.join(map(str, cells))} |", flush=True)


def main() -> None:
    """Print a row for each way to rank."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("out", type=Path, help="of the run")
    parser.add_argument("regions", nargs="+")
    parser.add_argument("--flights", action="store_true", help="follow flights instead")
    given = parser.parse_args()
    suite = FLIGHTS if given.flights else SUITE
    for name in given.regions:
        if not (given.out / "tasks" / suite / name).is_dir():
            raise SystemExit(f"{given.out} holds no views of {suite} on {name}: sasgeo-bench leaderboard pictures")
    if given.flights:
        for name in given.regions:
            print_flights(given.out, name)
        return
    views = {name: list(ranked(given.out, name)) for name in given.regions}
    print(f"| Cells | Heading and scale | {' | '.join(views)} |\n|---:|---|{'---:|' * len(views)}")
    print(f"| n | | {' | '.join(str(len(some)) for some in views.values())} |")
    for cells in CELLS:
        for with_prior in (False, True):
            shares = [f"{100 * found(some, cells, with_prior=with_prior):.1f}" for some in views.values()]
            print(f"| {cells:g} | {'yes' if with_prior else 'no'} | {' | '.join(shares)} |")
    listed = [f"{100 * np.mean([is_right.any() for _, is_right in some]):.1f}" for some in views.values()]
    print(f"| listed | | {' | '.join(listed)} |")


if __name__ == "__main__":
    try:
        main()
    except SasgeoError as error:
        raise SystemExit(str(error)) from error
