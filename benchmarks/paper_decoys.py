# SPDX-License-Identifier: Apache-2.0
"""What the choice of decoys does to the paper's first variant: no speed, and no figure of any board.

The paper says that decoys have the nearest descriptors; it does not say of how many windows they are the nearest, nor
nearest to what. This asks `global_descriptor` the same number of trials for other answers to both. Needs the region:
`make leaderboard PIPELINE=paper-poc` builds it. Some seconds a line.
"""

import argparse
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
from sasgeo_baselines.global_descriptor import GlobalDescriptor

from sasgeo_bench.experiments.paper.task import SUITE, TRIALS, VERSION, PaperDrawer, region_name
from sasgeo_bench.experiments.paper.tiles import Windows
from sasgeo_bench.geometry.pose import Pose
from sasgeo_bench.regions.region_files import read_region
from sasgeo_bench.tasks.query import Query
from sasgeo_bench.tasks.suites.base import Seeds

WINDOWS_A_TILE = (1, 2, 5, 49)


def thinned(windows: Windows, of_each_tile: int) -> Windows:
    """Some windows of each tile, by lot."""
    rng = np.random.default_rng(0)
    mine = [np.flatnonzero(windows.tile == tile) for tile in np.unique(windows.tile)]
    kept = np.concatenate([np.sort(rng.permutation(found)[:of_each_tile]) for found in mine])
    return replace(windows, points_m=windows.points_m[kept], tile=windows.tile[kept], counts=windows.counts[kept])


def asked(drawer: PaperDrawer, trials: int) -> Iterator[tuple[Query, int]]:
    """Trials with the number of the true candidate."""
    for index in range(trials):
        query, truth = drawer.draw(index)
        yield query, truth.candidate


def around_the_truth(drawer: PaperDrawer, trials: int) -> Iterator[tuple[Query, int]]:
    """The same views, their decoys the nearest to the true window itself."""
    points_m = drawer.windows.points_m
    for query, true in asked(drawer, trials):
        place_m = (query.candidates[true].easting_m, query.candidates[true].northing_m)
        alike = drawer.windows.alike(int(np.flatnonzero((points_m == place_m).all(axis=1))[0]))
        poses = [Pose(easting_m=float(x), northing_m=float(y), yaw_deg=0.0) for x, y in points_m[alike]]
        yield replace(query, candidates=tuple(poses)), 0


def ranks(matcher: GlobalDescriptor, trials: Iterator[tuple[Query, int]]) -> np.ndarray:
    """Rank of the true candidate in each trial."""
    found = [matcher.match(query, top_k=10).poses.index(query.candidates[true]) + 1 for query, true in trials]
    return np.array(found)


def main() -> None:
    """Print a line for each choice."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seed", type=int, default=42)
    parser.add_argument("--trials", type=int, default=TRIALS)
    parser.add_argument("--out", type=Path, default=Path("out"))
    words = parser.parse_args()
    region = read_region(words.out / "regions" / region_name(words.seed))
    drawer = PaperDrawer.of(region, Seeds(root=words.seed, names=(SUITE, str(VERSION))))
    matcher = GlobalDescriptor()
    matcher.prepare(region, None)
    print("decoys                                      Recall@1  Recall@5    MRR")
    for count in WINDOWS_A_TILE:
        pool = thinned(drawer.windows, count)
        line = f"an anchor's nearest of {len(pool.tile):4} windows"
        show(line, ranks(matcher, asked(replace(drawer, windows=pool), words.trials)))
    line = f"the truth's nearest of {len(drawer.windows.tile):4} windows"
    show(line, ranks(matcher, around_the_truth(drawer, words.trials)))


def show(line: str, rank: np.ndarray) -> None:
    """Print one line."""
    print(f"{line:44}{(rank == 1).mean():8.3f}  {(rank <= 5).mean():8.3f}  {(1 / rank).mean():.3f}")  # noqa: PLR2004 - Recall@5


if __name__ == "__main__":
    main()
