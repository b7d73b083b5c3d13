# SPDX-License-Identifier: Apache-2.0
"""Search whole countries: time and memory against area, with the levels of the map on disk and in memory.

    .venv/bin/python -m benchmarks.search_countries --out out

Builds the regions (cells of 2 m) that are not in `--out`, from extracts in a folder that --extracts or SASGEO_EXTRACTS
names, and stores their levels in `--out`/levels. Heading and place are unknown, scale is known, weights are set by
hand; a view has 256 x 256 cells of 2 m with the errors of a detector, and lies where at least 3 % of its cells hold a
class. Each row is a process of its own: it opens the map ("ready": seconds and memory before the first search, imports
included), and searches once for each view; medians. Memory is the resident size, mapped pages included (Linux).

"by tiles" (--tiles N) says in how many of the first N views a search of each 4 km of the map for itself, within a disc
around its middle, finds the same best pose, and in how many one of a higher score.

--beams prints instead, for each view, the best score and how far it is from the true place, with so many times the beam
of a town.

The last table is of what a map takes on disk: levels (of mapped ground), layers of one byte a cell packed by zstd, and
vectors; and the seconds of processor that it takes to make the cells of 1 km2 of each. All give the same cells.
"""

import argparse
import json
import math
import os
import statistics
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import product
from pathlib import Path

os.environ.setdefault("OMP_NUM_THREADS", "1")

import cv2
import numpy as np

from benchmarks.growth import draw
from benchmarks.search import ANYWHERE, LEAST_DENSITY, LISTED, THREADS, Look, peak_mb, read, seconds
from sasgeo_bench.geometry.grid import Grid
from sasgeo_bench.geometry.pose import Pose, Prior
from sasgeo_bench.regions.build import build_region, plan_build
from sasgeo_bench.regions.layers import burn_layers, make_paint
from sasgeo_bench.regions.region import Region
from sasgeo_bench.regions.region_files import FEATURES, LAYERS, read_manifest, read_region
from sasgeo_bench.regions.region_spec import find_region_file, read_region_file
from sasgeo_bench.sasgeo.raster import likeness_by_hand, read_field, store_field
from sasgeo_bench.search.field import Levels, Template
from sasgeo_bench.search.find import Search, search
from sasgeo_bench.search.plan import Mode, Plan
from sasgeo_bench.search.stored import StoredField
from sasgeo_bench.tasks.state import State

PLACES = ("vaduz", "liechtenstein", "andorra")
CELLS, CELL_M = 256, 2.0  # of a view
SIDE_M = CELLS * CELL_M
TILE_M = 4000.0
WAYS = ("stored", "memory")
SAME_M, HIGHER = 2.0, 1e-6


def region_of(name: str, given: argparse.Namespace) -> Path:
    """Return the folder of a region, built first if it is missing."""
    plan = plan_build(read_region_file(find_region_file(name)), out=given.out, extract_folders=given.extracts)
    build_region(plan)
    return plan.folder


def levels_of(name: str, given: argparse.Namespace) -> Path:
    """Return where the levels of a region lie."""
    return Path(given.out) / "levels" / name


def map_of(way: str, name: str, given: argparse.Namespace) -> Levels:
    """Open the levels of a map, or make them in memory."""
    if way == "stored":
        return StoredField.open(levels_of(name, given))
    folder = region_of(name, given)
    region = read_region(folder, with_layers=False)
    field = read_field(region, likeness_by_hand(region.classes))
    for factor in (1, 2, 4, 8, 16):
        field.level(factor)
    return field


def around(center_m: Sequence[float], side_m: float) -> tuple[float, float, float, float]:
    """Return bounds around a place."""
    east_m, north_m = center_m
    return east_m - side_m / 2, north_m - side_m / 2, east_m + side_m / 2, north_m + side_m / 2


def views(folder: Path, count: int) -> Iterator[tuple[Pose, Template]]:
    """Draw views anywhere on a map; only the part under each is read."""
    rng, noise = np.random.default_rng(0), np.random.default_rng(1)
    west, south, east, north = read_manifest(folder).bounds_m
    reach_m = SIDE_M * math.sqrt(0.5) + 2 * CELL_M
    while count:
        at = rng.uniform((west + reach_m, south + reach_m), (east - reach_m, north - reach_m))
        pose = Pose(easting_m=at[0], northing_m=at[1], yaw_deg=float(rng.uniform(0, 360)))
        part = read_region(folder, bounds_m=around(at, 2 * reach_m))
        state = State.of(part)
        if not part.known().all() or state.drawn.mean() < LEAST_DENSITY:
            continue
        look = Look(world=state, reader=read(part), is_noisy=True, cells=CELLS, cell_m=CELL_M)
        yield pose, look.template(pose, noise)
        count -= 1


def tiles(grid: Grid) -> list[Prior]:
    """Return discs that cover a map, one for each square of 4 km."""
    west, south, east, north = grid.bounds_m
    middles = product(np.arange(west, east, TILE_M) + TILE_M / 2, np.arange(south, north, TILE_M) + TILE_M / 2)
    radius_m = TILE_M * math.sqrt(0.5)
    return [
        Prior(center_m=(float(x), float(y)), radius_m=radius_m, yaw_deg=None, yaw_sigma_deg=None, scale_sigma=0.0)
        for x, y in middles
    ]


def best_of(found: Levels, look: Template, prior: Prior, plan: Plan) -> Mode:
    """Return the best mode of a search; one of no score where there is none."""
    modes = search(found, look, prior, plan, count=LISTED).modes
    return modes[0] if modes else Mode(pose=Pose(easting_m=0.0, northing_m=0.0, yaw_deg=0.0), score=-math.inf)


@dataclass(frozen=True, kw_only=True)
class OfBeam(Search):
    """A search with so many times the beam of a town, whatever its area."""

    times: int

    @property
    def patches(self) -> int:
        """Return how many times the beam is kept."""
        return self.times


def beams(name: str, given: argparse.Namespace) -> None:
    """Print the best of each view for several beams."""
    found = StoredField.open(levels_of(name, given))
    print(f"| {name}, view | {' | '.join(f'{times} beams: score | off, m | CPU s' for times in given.beams)} |")
    print(f"|---:|{'---:|' * 3 * len(given.beams)}")
    for at, (place, look) in enumerate(views_of(name, given)):
        cells = []
        for times in given.beams:
            wide = OfBeam(field=found, template=look, prior=ANYWHERE, plan=Plan(threads=THREADS[-1]), times=times)
            kept: list[Mode] = []
            _, cpu_s = seconds(lambda wide=wide, kept=kept: kept.append(wide.places(LISTED, ()).modes[0]))
            off_m = math.dist(place, (kept[0].pose.easting_m, kept[0].pose.northing_m))
            cells.append(f"{kept[0].score:.2f} | {off_m:.0f} | {cpu_s:.1f}")
        print(f"| {at} | {' | '.join(cells)} |", flush=True)


def views_of(name: str, given: argparse.Namespace) -> list[tuple[tuple[float, float], Template]]:
    """Read the views that were drawn on a region, and where each was taken."""
    with np.load(levels_of(name, given).with_suffix(".views.npz")) as held:
        rows = zip(held["poses"], held["weights"], held["known"], strict=True)
        return [
            ((float(place[0]), float(place[1])), Template(weights=weights, known=known, cell_size_m=CELL_M))
            for place, weights, known in rows
        ]


def measure(way: str, name: str, threads: int, given: argparse.Namespace) -> dict[str, float]:
    """Return time and memory of this process, and how often it finds the place, or one that a tile finds."""
    start = time.perf_counter()
    found: Levels = map_of(way, name, given)
    ready_s, ready_mb = time.perf_counter() - start, peak_mb()
    poses, looks = zip(*views_of(name, given), strict=True)
    plan = Plan(threads=threads)
    costs, right, modes = [], 0, []
    for at, look in zip(poses, looks, strict=True):
        costs.append(seconds(lambda look=look: modes.append(best_of(found, look, ANYWHERE, plan))))
        right += math.dist(at, (modes[-1].pose.easting_m, modes[-1].pose.northing_m)) <= 10.0
    wall_s, cpu_s = (statistics.median(column) for column in zip(*costs, strict=True))
    row = {"ready_s": ready_s, "ready_mb": ready_mb, "wall_s": wall_s, "cpu_s": cpu_s, "peak_mb": peak_mb()}
    same = higher = 0
    if threads == 1 and way == "stored":
        for look, mode in zip(looks[: given.tiles], modes, strict=False):
            best = max((best_of(found, look, disc, plan) for disc in tiles(found.grid)), key=lambda one: one.score)
            apart_m = math.dist(
                (best.pose.easting_m, best.pose.northing_m), (mode.pose.easting_m, mode.pose.northing_m)
            )
            same += apart_m <= SAME_M
            higher += apart_m > SAME_M and best.score > mode.score + HIGHER
    return row | {"right": right, "same": same, "higher": higher}


def bytes_of(folder: Path) -> int:
    """Return the bytes that files take on disk; holes take none."""
    return sum(path.stat().st_blocks * 512 for path in folder.glob("*.npy"))


def made(folder: Path, levels: Path) -> list[float]:
    """Return the processor seconds that 1 km2 takes from levels, layers and vectors: the median of some places."""
    rng, spent, manifest = np.random.default_rng(2), [], read_manifest(folder)
    west, south, east, north = manifest.bounds_m
    stored = StoredField.open(levels)
    while len(spent) < 7:
        bounds_m = around(rng.uniform((west + 500, south + 500), (east - 500, north - 500)), 1000.0)
        part = read_region(folder, bounds_m=bounds_m, with_layers=False)
        if not part.known().all():
            continue
        near = likeness_by_hand(part.classes)
        cells = read_region(folder, bounds_m=bounds_m, with_layers=False)

        def from_levels(part: Region = part) -> None:
            """Copy the cells."""
            row, col = stored.grid.to_cells(np.array([[part.grid.west_m, part.grid.north_m]]))[0].tolist()
            np.array(stored.level(1).cells.cut(row, col, part.grid.shape).fours)

        def from_vectors(part: Region = part) -> None:
            """Burn the layers."""
            burn_layers(make_paint(part.features, part.classes, part.coverage), part.grid)

        spent.append(
            [
                seconds(from_levels)[1],
                seconds(lambda cells=cells, near=near: read_field(cells, near))[1],
                seconds(from_vectors)[1],
            ]
        )
    return [statistics.median(column) for column in zip(*spent, strict=True)]


def in_a_process(way: str, name: str, threads: int, given: argparse.Namespace) -> dict[str, float]:
    """Run `measure` in a process of its own."""
    folders = [word for folder in given.extracts for word in ("--extracts", str(folder))]
    command = [sys.executable, "-m", "benchmarks.search_countries", "--out", str(given.out), *folders]
    command += ["--tiles", str(given.tiles)]
    done = subprocess.run(  # noqa: S603 - our own program
        [*command, "--measure", way, name, str(threads)], check=True, stdout=subprocess.PIPE, text=True
    )
    return dict(json.loads(done.stdout))


def print_sizes(sizes: list[tuple[str, float, float, float, tuple[int, ...], tuple[float, ...]]]) -> None:
    """Print what maps take on disk, and the cells of a km2."""
    columns = ("stored in s", "CPU s", "kB/km2: levels", "layers", "vectors", "ms/km2: levels", "layers", "vectors")
    print(f"\n| region | {' | '.join(columns)} |\n|---|{'---:|' * len(columns)}")
    for name, km2, wall_s, cpu_s, files, spent in sizes:
        taken = " | ".join(f"{count / 1e3 / km2:.1f}" for count in files)
        print(
            f"| {name} | {wall_s:.1f} | {cpu_s:.1f} | {taken} | {' | '.join(f'{1e3 * each:.1f}' for each in spent)} |"
        )


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("out"))
    parser.add_argument("--extracts", type=Path, action="append", default=[])
    parser.add_argument("--regions", nargs="+", default=PLACES)
    parser.add_argument("--runs", type=int, default=7, help="views of each row")
    parser.add_argument("--tiles", type=int, default=0, help="views to search for by tiles, too: minutes each")
    parser.add_argument("--ways", nargs="+", choices=WAYS, default=WAYS, help="where the levels of the map lie")
    parser.add_argument("--beams", nargs="+", type=int, default=(), help="times the beam of a town to compare")
    parser.add_argument("--plot", type=Path, help="file to draw fixes and memory against area to, as SVG")
    parser.add_argument("--measure", nargs=3, help=argparse.SUPPRESS)
    given = parser.parse_args()
    cv2.setNumThreads(1)
    if given.measure:
        way, name, threads = given.measure
        print(json.dumps(measure(way, name, int(threads), given)))
        return
    sizes, charts = [], dict[str, dict[str, list[tuple[float, float]]]]()
    if not given.beams:
        names = "region | km2 | map | cores | ready, s | MB | fix, s | CPU s | peak MB | right | by tiles | higher"
        print(f"| {names} |\n|---|---:|---|{'---:|' * 9}")
    for name in given.regions:
        folder, levels = region_of(name, given), levels_of(name, given)
        manifest = read_manifest(folder)
        km2 = manifest.coverage.share * math.prod(manifest.grid.shape) * manifest.cell_size_m**2 / 1e6
        wall_s, cpu_s = seconds(lambda: store_field(folder, levels, likeness_by_hand(manifest.classes)))  # noqa: B023
        drawn = list(views(folder, given.runs))
        np.savez(
            levels.with_suffix(".views.npz"),
            poses=np.array([(pose.easting_m, pose.northing_m, pose.yaw_deg) for pose, _ in drawn]),
            weights=np.stack([look.weights for _, look in drawn]),
            known=np.stack([look.known for _, look in drawn]),
        )
        if given.beams:
            beams(name, given)
            continue
        for way, threads in ((way, threads) for way in given.ways for threads in THREADS):
            row = in_a_process(way, name, threads, given)
            line = f"{way}, {threads} core{'s' * (threads > 1)}"
            for title, column in (("a fix (s)", "wall_s"), ("peak memory (MB)", "peak_mb")):
                charts.setdefault(title, {}).setdefault(line, []).append((km2, row[column]))
            tiled = f"{row['same']} | {row['higher']}" if threads == 1 and given.tiles and way == "stored" else " | "
            print(
                f"| {name} | {km2:.0f} | {way} | {threads} | {row['ready_s']:.2f} | {row['ready_mb']:.0f} | "
                f"{row['wall_s']:.2f} | {row['cpu_s']:.2f} | {row['peak_mb']:.0f} | {row['right']} of {given.runs} | "
                f"{tiled} |",
                flush=True,
            )
        files = (bytes_of(levels), *((folder / file).stat().st_size for file in (LAYERS, FEATURES)))
        sizes.append((name, km2, wall_s, cpu_s, files, made(folder, levels)))
    if given.beams:
        return
    if given.plot:
        draw(given.plot, charts, xlabel="mapped area (km²), cells of 2 m")
    print_sizes(sizes)


if __name__ == "__main__":
    main()
