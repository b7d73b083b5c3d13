# SPDX-License-Identifier: Apache-2.0
"""The graph of a real region: milliseconds for 20 candidates of a view of 256 m, and what junctions alone propose.

    .venv/bin/python benchmarks/graph.py --region vaduz --out out

Needs the region: `make build-region REGION=vaduz`. Times are processor seconds of one core, medians over the views.
"""

import argparse
import os
import statistics
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path

os.environ.setdefault("OMP_NUM_THREADS", "1")

import numpy as np

from sasgeo_bench.geometry.pose import Pose, wrap_deg
from sasgeo_bench.regions.region_files import read_region
from sasgeo_bench.sasgeo.graph import verify
from sasgeo_bench.sasgeo.mapped import MappedGraph
from sasgeo_bench.sasgeo.observed import ObservedGraph
from sasgeo_bench.sasgeo.reading import proposals
from sasgeo_bench.tasks.perturbations.perception import Perception
from sasgeo_bench.tasks.state import State
from sasgeo_bench.tasks.suites.vectors import VectorNoise, perceive_vectors

SIDE_M = 256
CANDIDATES = 20
NEAR_M, NEAR_DEG = 10.0, 10.0
EXACT = VectorNoise(missed_share=0.0, gap_share=0.0, shift_m=0.0)


@dataclass(frozen=True)
class Look:
    """How views are taken."""

    name: str
    has_vectors: bool
    is_noisy: bool

    def view(self, state: State, pose: Pose, rng: np.random.Generator) -> ObservedGraph:
        """The graph of a view."""
        seen = state.view(pose, size_cells=SIDE_M, cell_size_m=1.0)
        seen = Perception()(seen, rng) if self.is_noisy else seen
        if not self.has_vectors:
            return ObservedGraph.make(seen)
        noise = VectorNoise() if self.is_noisy else EXACT
        return ObservedGraph.make(seen, perceive_vectors(state, pose, side_m=float(SIDE_M), noise=noise, rng=rng))


LOOKS = (
    Look("vectors, noise-free", has_vectors=True, is_noisy=False),
    Look("masks, noise-free", has_vectors=False, is_noisy=False),
    Look("vectors, perceived", has_vectors=True, is_noisy=True),
    Look("masks, perceived", has_vectors=False, is_noisy=True),
)


def places(state: State, rng: np.random.Generator, *, least_density: float) -> Iterator[Pose]:
    """Poses anywhere on the map where so much is drawn, with any heading."""
    west, south, east, north = state.grid.bounds_m
    half = SIDE_M // 2
    while True:
        at = rng.uniform((west + SIDE_M, south + SIDE_M), (east - SIDE_M, north - SIDE_M))
        row, col = state.grid.to_cells(at[None])[0].tolist()
        if state.drawn[row - half : row + half, col - half : col + half].mean() >= least_density:
            yield Pose(easting_m=at[0], northing_m=at[1], yaw_deg=float(rng.uniform(0, 360)))


def timed(call: Callable[[], object]) -> float:
    """Processor milliseconds of the best of three calls."""
    found = []
    for _ in range(3):
        begin = time.process_time()
        call()
        found.append(time.process_time() - begin)
    return 1e3 * min(found)


def measure(mapped: MappedGraph, state: State, look: Look, *, views: int, least_density: float) -> str:
    """A line of the table."""
    rng = np.random.default_rng(0)
    verify_ms, view_ms, propose_ms, ranks, junctions = [], [], [], [], []
    for _, pose in zip(range(views), places(state, rng, least_density=least_density), strict=False):
        begin = time.process_time()
        seen = look.view(state, pose, rng)
        view_ms.append(1e3 * (time.process_time() - begin))
        candidates = [
            replace(pose, easting_m=pose.easting_m + east_m, northing_m=pose.northing_m + north_m)
            for east_m, north_m in rng.normal(0.0, 100.0, (CANDIDATES, 2)).tolist()
        ]
        verify_ms.append(timed(lambda seen=seen, candidates=candidates: verify(seen, mapped, candidates)))
        begin = time.process_time()
        found = proposals(seen, mapped, count=CANDIDATES)
        propose_ms.append(1e3 * (time.process_time() - begin))
        near = (at for at, (one, _) in enumerate(found) if is_near(one, pose))
        ranks.append(next(near, CANDIDATES))
        junctions.append(int(np.isfinite(seen.nodes.arms_deg[:, 2]).sum()))
    rank, enough = np.array(ranks), np.array(junctions) > 2  # at least three pairs
    shares = [float((rank < least).mean()) for least in (1, 10, CANDIDATES)]
    with_pairs = float((rank < CANDIDATES)[enough].mean()) if enough.any() else float("nan")
    columns = [statistics.median(view_ms), statistics.median(verify_ms), max(verify_ms), statistics.median(propose_ms)]
    return (
        f"| {look.name} | {' | '.join(f'{value:.0f}' for value in columns)} | "
        f"{' | '.join(f'{share:.2f}' for share in shares)} | {with_pairs:.2f} ({int(enough.sum())}) |"
    )


def is_near(one: Pose, pose: Pose) -> bool:
    """Whether a pose counts as found."""
    apart_m = np.hypot(one.easting_m - pose.easting_m, one.northing_m - pose.northing_m)
    return bool(apart_m <= NEAR_M and abs(wrap_deg(one.yaw_deg - pose.yaw_deg)) <= NEAR_DEG)


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--region", default="vaduz")
    parser.add_argument("--views", type=int, default=20)
    parser.add_argument("--density", type=float, default=0.05, help="least share of cells with something drawn")
    parser.add_argument("--out", type=Path, default=Path("out"))
    words = parser.parse_args()
    region = read_region(words.out / "regions" / words.region)
    state, mapped = State.of(region), MappedGraph.of(region)
    mapped.junction_pairs, mapped.links, mapped.plan  # noqa: B018 - made once a map, before anything is timed
    print(
        "| View | made, ms | 20 verified, ms | most | proposed, ms | found 1st | in 10 | in 20 | with 3 junctions (n) |"
    )
    print("|---|---:|---:|---:|---:|---:|---:|---:|---:|")
    for look in LOOKS:
        print(measure(mapped, state, look, views=words.views, least_density=words.density))


if __name__ == "__main__":
    main()
