# SPDX-License-Identifier: Apache-2.0
"""Say what ranks the modes of views with probabilities: what the map explains of each class, and heading and scale.

    sasgeo-bench leaderboard pictures --out out
    .venv/bin/python benchmarks/faint_views.py out andorra-la-vella-ortho andorra-la-vella-ortho@2020-05-01

Searches the views of `real-image` that `osm_unet_held_out` segmented at the named regions, as `sasgeo` does, and ranks
the modes of each search in several ways. Found is within 25 m and 5 deg; *listed* is the share of views of which any
mode is right. `cells` is the number of independent cells, `INDEPENDENT`; 0 leaves that term out.
"""

import argparse
from collections.abc import Iterator
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

import sasgeo_bench as sgb
from sasgeo_bench.core.errors import SasgeoError
from sasgeo_bench.geometry.pose import wrap_deg
from sasgeo_bench.regions.evidence import UNKNOWN
from sasgeo_bench.sasgeo.raster import INDEPENDENT
from sasgeo_bench.sasgeo.reading import Reader
from sasgeo_bench.sasgeo.scorer_model import ScorerModel
from sasgeo_bench.sasgeo.variants import LISTED, Sasgeo
from sasgeo_bench.search.find import search
from sasgeo_bench.search.plan import Plan
from sasgeo_bench.tasks.task_files import read_queries, read_truths

SUITE: Final = "real-image+osm_unet_held_out"
CELLS: Final = (0.0, 5.0, 10.0, 20.0, 40.0, 80.0)
CLOSE_M, CLOSE_DEG = 25.0, 5.0

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


def main() -> None:
    """Print a row for each way to rank."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("out", type=Path, help="of the run")
    parser.add_argument("regions", nargs="+")
    given = parser.parse_args()
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
