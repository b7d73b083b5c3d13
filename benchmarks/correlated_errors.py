# SPDX-License-Identifier: Apache-2.0
"""How far errors of a class hang together: the untaught scorer with other widths of a level, and other bounds.

    python benchmarks/correlated_errors.py --out out [--every 3]

Needs the views that `sasgeo-bench leaderboard scorer-trials` draws into `--out`. Prints the share of stressed
localization views of 192 m that are found within 25 m and 5 deg, by suite, with each cell alone, and for each width and
bound. `raster.LEVEL_M` and `raster.REPEATED` were chosen by such a table, on other sites of the same towns.
"""

import argparse
from collections import defaultdict
from collections.abc import Iterator
from dataclasses import replace
from itertools import product
from pathlib import Path

import numpy as np

import sasgeo_bench as sgb
from sasgeo_bench.sasgeo import raster
from sasgeo_bench.sasgeo.variants import SasgeoPrior
from sasgeo_bench.tasks.query import base_of

# Widths, metres, with bounds: both are changed about the values that ship, one at a time.
PAIRS = [*product((24.0,), (1e3, 3e3, 1e4, 3e4)), *product((12.0, 48.0, 96.0), (3e3,))]
NEAR_M, NEAR_DEG, SIDE_M = 25.0, 5.0, 192.0

TOWNS = ("krems", "porto", "london", "vaduz")  # of `scorer-trials`: the scorer is chosen nowhere else

Asked = list[tuple[sgb.Query, sgb.Truth]]


class Alone(SasgeoPrior):
    """The untaught scorer with independent cells."""

    switches = replace(SasgeoPrior.switches, correlates=False)


def views(out: Path, *, every: int) -> Iterator[tuple[str, Asked]]:
    """Yield the folder of each task on a town of the trials and every so many of its views."""
    for folder in sorted((out / "tasks").glob("*/*")):
        if folder.name.startswith("."):
            continue
        truths = {one.query_id: one for one in sgb.read_truths(out / "truth" / folder.parent.name / folder.name)}
        asked = [
            (query, truths[query.query_id])
            for query in sgb.read_queries(folder)
            if query.track == "localization"
            and round(max(query.evidence.size_m)) == SIDE_M
            and base_of(query.region).partition("+")[0] in TOWNS
        ]
        asked = [(query, truth) for query, truth in asked if truth.is_present and truth.role == "stress"]
        if asked:
            yield folder.parent.name, sorted(asked, key=lambda pair: pair[0].query_id)[::every]


def is_found(matcher: SasgeoPrior, query: sgb.Query, truth: sgb.Truth) -> bool:
    """Whether the first pose is right."""
    poses = matcher.match(query, top_k=1).poses
    if not poses or truth.pose is None:
        return False
    east_m, north_m = poses[0].easting_m - truth.pose.easting_m, poses[0].northing_m - truth.pose.northing_m
    turned_deg = abs(sgb.wrap_deg(poses[0].yaw_deg - truth.pose.yaw_deg))
    return bool(np.hypot(east_m, north_m) <= NEAR_M and turned_deg <= NEAR_DEG)


def line(name: str, kind: type[SasgeoPrior], asked: list[tuple[str, Asked]], regions: dict[str, sgb.Region]) -> str:
    """A line of the table."""
    found: dict[str, list[bool]] = defaultdict(list)
    for suite, some in asked:
        matcher = kind()
        matcher.prepare(regions[some[0][0].region], None)
        found[suite] += [is_found(matcher, query, truth) for query, truth in some]
    every = [one for some in found.values() for one in some]
    cells = [np.mean(every), *(np.mean(found[suite]) for suite in sorted(found))]
    return f"| {name} | {' | '.join(f'{cell:.3f}' for cell in cells)} |"


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument(
        "--out", type=Path, default=Path("out"), help="where sasgeo-bench leaderboard scorer-trials drew its views"
    )
    parser.add_argument("--every", type=int, default=1, help="asks one view in so many of each task")
    words = parser.parse_args()
    if words.every < 1:
        parser.error(f"--every is at least 1, got {words.every}")
    asked = list(views(words.out, every=words.every))
    if not asked:
        parser.error(
            f"{words.out} holds no such views: sasgeo-bench leaderboard scorer-trials --out {words.out} draws some"
        )
    names = {some[0][0].region for _, some in asked}
    regions = {name: sgb.read_region(words.out / "regions" / name, with_layers=False) for name in names}
    suites = sorted({suite for suite, _ in asked})
    counts = [sum(len(some) for name, some in asked if name == suite) for suite in suites]
    print(
        f"| level, bound | all ({sum(counts)}) | "
        + " | ".join(f"{s} ({n})" for s, n in zip(suites, counts, strict=True))
        + " |"
    )
    print("|---|" + "---:|" * (len(suites) + 1))
    print(line("each cell alone", Alone, asked, regions), flush=True)
    for width_m, bound in PAIRS:
        raster.LEVEL_M, raster.REPEATED = width_m, bound  # type: ignore[misc] # constants, but for this program
        print(line(f"{width_m:g} m, {bound:g}", SasgeoPrior, asked, regions), flush=True)


if __name__ == "__main__":
    main()
