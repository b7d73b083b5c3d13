# SPDX-License-Identifier: Apache-2.0
"""Measure the dense search: time and memory of a fix, and its agreement with the exhaustive search.

    .venv/bin/python benchmarks/search.py --out out                     # speed, against area and against views
    .venv/bin/python benchmarks/search.py --out out --agree 100         # agreement; hours at full size
    .venv/bin/python benchmarks/search.py --out out --agree 20 --size 1024 --view 128 --step 2     # much less

Builds the region (for `--agree`, at two dates) where it is not in `--out`, from extracts in a folder that --extracts or
SASGEO_EXTRACTS names. The map is searched as the scorer does: cells of 2 m, weights set by hand, all headings, all
places, scale known. A view has `--view` cells a side of `--view-cell` metres, by default as large as the map's. Views
lie where at least 3 % of the cells hold a class: `noise-free`, `perceived` with the errors of a detector, and `aged`,
perceived today and searched for on the old map.

Speed: each row is a process of its own that holds the map, searches once to make the pyramid of the map ("first"), and
then once for each view; medians. Memory is the peak resident size, with imports and map (Linux). Beyond the region the
map is mirrored. The exhaustive search scores every cell of the map at every step of heading, for one view.

Agreement: within one cell in easting and in northing and one step of heading. For the rest each line gives both scores
on the map's own cells and the cause: `better` where the place of the search, between cells, scores at least as much as
the best one on them; `tie` where it is at most 0.5 % below; `not proposed` where the search would refine the place if
the coarsest level proposed it; `left behind` where it would drop it even then. "right" is the share within
10 m and 10 degrees of where the view was taken; the last columns are medians of the search and the reference.
"""

import argparse
import datetime as dt
import json
import math
import os
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

os.environ.setdefault("OMP_NUM_THREADS", "1")

import cv2
import numpy as np

from sasgeo_bench.geometry.grid import Grid
from sasgeo_bench.geometry.pose import Pose, Prior, wrap_deg
from sasgeo_bench.regions.build import build_region, plan_build
from sasgeo_bench.regions.region import Region
from sasgeo_bench.regions.region_files import read_region
from sasgeo_bench.regions.region_spec import find_region_file, read_region_file
from sasgeo_bench.sasgeo.ablations import Switches
from sasgeo_bench.sasgeo.reading import Reader
from sasgeo_bench.sasgeo.scorer_model import ScorerModel
from sasgeo_bench.search.field import Field, Template
from sasgeo_bench.search.find import exhaustive, score_at, search
from sasgeo_bench.search.plan import Mode, Plan
from sasgeo_bench.tasks.perturbations.perception import Perception
from sasgeo_bench.tasks.query import Query
from sasgeo_bench.tasks.state import State

SIDES_CELLS = (512, 1024, 2048, 4096)  # 1 to 67 km2
VIEWS_CELLS = (96, 192, 256, 384)
SIDE_CELLS, VIEW_CELLS = 2048, 256
THREADS = (1, 2)
LISTED = 20
LEAST_DENSITY = 0.03
CAUSES = ("better", "tie", "not proposed", "left behind")
TIE = 0.005  # of a score
ANYWHERE = Prior(center_m=None, radius_m=None, yaw_deg=None, yaw_sigma_deg=None, scale_sigma=0.0)


@dataclass(frozen=True)
class Kind:
    """A kind of views, and the map that they are searched on."""

    name: str
    is_noisy: bool
    is_aged: bool


KINDS = (
    Kind("noise-free", is_noisy=False, is_aged=False),
    Kind("perceived", is_noisy=True, is_aged=False),
    Kind("aged", is_noisy=True, is_aged=True),
)


def region_of(name: str, date: dt.date | None, given: argparse.Namespace) -> Region:
    """Read a region, built first if it is missing."""
    folder = given.out / "regions" / (f"{name}@{date}" if date else name)
    if not folder.exists():
        spec = read_region_file(find_region_file(name))
        plan = plan_build(spec, out=given.out, date=date, extract_folders=given.extracts)
        build_region(plan)
    return read_region(folder)


def read(region: Region) -> Reader:
    """Prepare a map as the scorer does, without graph."""
    return Reader.of(region, ScorerModel.by_hand(region.classes), Switches(has_graph=False))


def resized(field: Field, side: int) -> Field:
    """Return the middle of a map, mirrored beyond its edges."""
    top, left = (field.grid.rows - side) // 2, (field.grid.cols - side) // 2
    more = max(0, -top, -left)
    rows, cols = slice(top + more, top + more + side), slice(left + more, left + more + side)
    around = ((more, more), (more, more))
    return Field.of(
        grid=field.grid.window(top, left, side, side),
        layers=np.pad(field.layers, ((0, 0), *around), mode="symmetric")[:, rows, cols].copy(),
        known=np.pad(field.known, around, mode="symmetric")[rows, cols].copy(),
    )


def places(state: State, ground: Grid, side_m: float, rng: np.random.Generator) -> Iterator[Pose]:
    """Yield random poses on a part of the map with enough content and the whole view on it."""
    west, south, east, north = ground.bounds_m
    half, reach_m = int(side_m) // 2, side_m * math.sqrt(0.5) + ground.cell_size_m
    if min(east - west, north - south) <= 2 * reach_m:
        raise SystemExit(f"a view of {side_m:g} m does not fit a map of {east - west:g} m: give a larger --size")
    while True:
        at = rng.uniform((west + reach_m, south + reach_m), (east - reach_m, north - reach_m))
        row, col = state.grid.to_cells(at[None])[0].tolist()
        if state.drawn[row - half : row + half, col - half : col + half].mean() >= LEAST_DENSITY:
            yield Pose(easting_m=at[0], northing_m=at[1], yaw_deg=float(rng.uniform(0, 360)))


@dataclass(frozen=True, kw_only=True)
class Look:
    """Views of a world, weighed for one map of it."""

    world: State
    reader: Reader
    is_noisy: bool
    cells: int
    cell_m: float

    def template(self, pose: Pose, rng: np.random.Generator) -> Template:
        """Return the template of a view, as the matcher makes it of a query."""
        seen = self.world.view(pose, size_cells=self.cells, cell_size_m=self.cell_m)
        query = Query(
            query_id="",
            track="localization",
            suite="",
            suite_version=1,
            part="",
            region=self.world.region,
            evidence=Perception()(seen, rng) if self.is_noisy else seen,
            observed_on=self.world.date,
            season="",
            prior=ANYWHERE,
            prior_group="",
        )
        return self.reader.read(query).template

    def templates(self, ground: Grid, count: int) -> list[tuple[Pose, Template]]:
        """Return poses and templates; the poses depend on the size of views alone."""
        where, rng = np.random.default_rng(0), np.random.default_rng(1)
        some = zip(range(count), places(self.world, ground, self.cells * self.cell_m, where), strict=False)
        return [(pose, self.template(pose, rng)) for _, pose in some]


def save(path: Path, field: Field, templates: Sequence[Template]) -> None:
    """Write the input of a measured process."""
    grid = field.grid
    arrays = {f"weights{at}": template.weights for at, template in enumerate(templates)}
    arrays |= {f"known{at}": template.known for at, template in enumerate(templates)}
    lattice = [grid.epsg, grid.west_m, grid.north_m, grid.cell_size_m, templates[0].cell_size_m]
    np.savez(path, layers=field.layers, known=field.known, lattice=np.array(lattice), **arrays)


def load(path: Path) -> tuple[Field, list[Template]]:
    """Read the input of a measured process."""
    with np.load(path) as held:
        epsg, west_m, north_m, cell_m, view_cell_m = held["lattice"].tolist()
        layers, known = held["layers"], held["known"]
        rows, cols = known.shape
        grid = Grid(epsg=int(epsg), west_m=west_m, north_m=north_m, cell_size_m=cell_m, rows=rows, cols=cols)
        count = sum(name.startswith("weights") for name in held.files)
        templates = [
            Template(weights=held[f"weights{at}"], known=held[f"known{at}"], cell_size_m=view_cell_m)
            for at in range(count)
        ]
    return Field.of(grid=grid, layers=layers, known=known), templates


def seconds(call: Callable[[], object]) -> tuple[float, float]:
    """Return wall and processor seconds of a call."""
    wall, cpu = time.perf_counter(), time.process_time()
    call()
    return time.perf_counter() - wall, time.process_time() - cpu


def measured(path: Path, threads: int, step_deg: float) -> dict[str, float]:
    """Return time and memory of this process for its views; with a step, of one exhaustive search."""
    field, templates = load(path)
    if step_deg:
        whole = seconds(lambda: exhaustive(field, templates[0], yaw_step_deg=step_deg, threads=threads))
        first, each = whole, [whole]
    else:
        plan = Plan(threads=threads)
        first = seconds(lambda: search(field, templates[0], ANYWHERE, plan, count=LISTED))
        each = [
            seconds(lambda template=template: search(field, template, ANYWHERE, plan, count=LISTED))
            for template in templates
        ]
    wall_s, cpu_s = (statistics.median(column) for column in zip(*each, strict=True))
    return {"first_s": first[0], "wall_s": wall_s, "cpu_s": cpu_s, "peak_mb": peak_mb()}


def peak_mb() -> float:
    """Return the peak resident size; `getrusage` would include that of the parent at the start."""
    lines = Path("/proc/self/status").read_text().splitlines()
    return next(int(line.split()[1]) for line in lines if line.startswith("VmHWM")) * 1024 / 1e6


def in_a_process(path: Path, threads: int, step_deg: float = 0.0) -> dict[str, float]:
    """Run `measured` in a process of its own."""
    command = [sys.executable, __file__, "--measure", str(path), str(threads), str(step_deg)]
    return dict(json.loads(subprocess.run(command, check=True, capture_output=True, text=True).stdout))  # noqa: S603


@dataclass(frozen=True, kw_only=True)
class Bench:
    """Measurements on one region."""

    world: State
    reader: Reader
    given: argparse.Namespace

    def prepared(self, folder: Path, *, side: int, view: int) -> Path:
        """Write a map and views of one size; return the file."""
        cell_m = self.given.view_cell
        look = Look(world=self.world, reader=self.reader, is_noisy=True, cells=view, cell_m=cell_m)
        inner = min(side, self.reader.field.grid.rows)
        least = math.ceil(2 * (view * cell_m * math.sqrt(0.5) / self.reader.field.grid.cell_size_m + 2))
        ground = resized(self.reader.field, max(inner, least)).grid  # a view may be larger than a small map
        views = look.templates(ground, self.given.runs)
        path = folder / f"{side}-{view}.npz"
        save(path, resized(self.reader.field, side), [template for _, template in views])
        return path

    def speed(self, folder: Path) -> None:
        """Print the costs of a fix and of the exhaustive search."""
        path = self.prepared(folder, side=self.given.size, view=self.given.view)
        self._head(f"map {self.given.size} x {self.given.size} cells, view {self.given.view} x {self.given.view}")
        print("| | cores | s | CPU s | first, s | peak MB |")
        print("|---|---:|---:|---:|---:|---:|")
        for threads in THREADS:
            mine = in_a_process(path, threads)
            print(f"| search | {threads} | {_row(mine)} |", flush=True)
        whole = in_a_process(path, threads, self.given.step)
        print(f"| exhaustive, {self.given.step:g} deg | {threads} | {_row(whole)} |")
        ratio, of_cpu = (whole[name] / mine[name] for name in ("wall_s", "cpu_s"))
        print(f"\non {threads} cores {ratio:.0f} times faster, with {of_cpu:.0f} times less processor time", flush=True)

    def costs(self, folder: Path) -> None:
        """Print the cost of a fix against area, and against the size of the view."""
        sizes = [(side, self.given.view) for side in SIDES_CELLS] + [(self.given.size, view) for view in VIEWS_CELLS]
        self._head("cost of a fix")
        print("| km2 | map, cells | view, cells | cores | fix, s | CPU s | first, s | peak MB |")
        print("|---:|---:|---:|---:|---:|---:|---:|---:|")
        for side, view in dict.fromkeys(sizes):
            path = self.prepared(folder, side=side, view=view)
            km2 = (side * self.reader.field.grid.cell_size_m / 1000) ** 2
            for threads in THREADS:
                print(f"| {km2:.1f} | {side} | {view} | {threads} | {_row(in_a_process(path, threads))} |", flush=True)
            path.unlink()

    def agreement(self, kind: Kind, reader: Reader) -> str:
        """Print each query in which both differ; return a line of the table."""
        given = self.given
        field = resized(reader.field, given.size)
        look = Look(world=self.world, reader=reader, is_noisy=kind.is_noisy, cells=given.view, cell_m=given.view_cell)
        causes: list[str] = []
        rights: list[tuple[bool, bool]] = []
        spent: list[tuple[float, float]] = []
        for at, (pose, template) in enumerate(look.templates(field.grid, given.agree)):
            begun = time.process_time()
            found = search(field, template, ANYWHERE, Plan(threads=given.threads), count=LISTED).modes[0]
            between = time.process_time()
            best = exhaustive(field, template, yaw_step_deg=given.step, threads=given.threads)
            spent.append((between - begun, time.process_time() - between))
            near_m, near_deg = field.grid.cell_size_m, given.step
            rights.append((is_near(found.pose, pose, 10.0, 10.0), is_near(best.pose, pose, 10.0, 10.0)))
            if is_near(found.pose, best.pose, near_m, near_deg):
                continue
            causes.append(cause(field, template, found, best))
            scores = (score_at(field, template, one.pose) for one in (found, best))
            print(
                f"{kind.name} {at}: {_apart(found.pose, best.pose)}, scores {_words(scores)}: {causes[-1]}",
                file=sys.stderr,
                flush=True,
            )
        total, differ = given.agree, len(causes)
        named = (causes.count(name) for name in CAUSES)
        right = (sum(column) / total for column in zip(*rights, strict=True))
        cpu_s = (statistics.median(column) for column in zip(*spent, strict=True))
        shares = " | ".join(f"{share:.2f}" for share in right)
        return (
            f"| {kind.name} | {total} | {(total - differ) / total:.3f} | {' | '.join(map(str, named))} | {shares} | "
            f"{' | '.join(f'{value:.2f}' for value in cpu_s)} |"
        )

    def agreements(self) -> None:
        """Print the table of agreement."""
        given = self.given
        self._head(f"agreement, map {given.size} cells, view {given.view} cells, step {given.step:g} deg")
        head = f"queries | n | agree | {' | '.join(CAUSES)} | search right | exhaustive right"
        lines = [f"| {head} | CPU s | CPU s |", f"|---{'|---:' * 10}|"]
        chosen = [kind for kind in KINDS if kind.name in given.kinds]
        is_aged = any(kind.is_aged for kind in chosen)
        aged = read(region_of(given.region, given.old, given)) if is_aged else self.reader
        lines += [self.agreement(kind, aged if kind.is_aged else self.reader) for kind in chosen]
        print("\n".join(lines), flush=True)

    def _head(self, what: str) -> None:
        load = " ".join(f"{value:.1f}" for value in os.getloadavg())
        cell_m, view_cell_m = self.reader.field.grid.cell_size_m, self.given.view_cell
        print(f"\n{what} (cells of {cell_m:g} m, views of {view_cell_m:g} m; load {load})\n", flush=True)


def is_near(one: Pose, other: Pose, near_m: float, near_deg: float) -> bool:
    """Tell if two poses lie within a distance along both axes and an angle."""
    apart_m = max(abs(one.easting_m - other.easting_m), abs(one.northing_m - other.northing_m))
    return bool(apart_m <= near_m and abs(wrap_deg(one.yaw_deg - other.yaw_deg)) <= near_deg)


def cause(field: Field, template: Template, found: Mode, best: Mode) -> str:
    """Return why the search found another place."""
    mine, theirs = (score_at(field, template, one.pose) for one in (found, best))
    if mine >= theirs:
        return "better"
    if mine >= theirs - TIE * abs(theirs):
        return "tie"
    led = search(field, template, ANYWHERE, Plan(), count=LISTED, starts=[best.pose]).modes[0]
    return "not proposed" if score_at(field, template, led.pose) > found.score else "left behind"


def _apart(one: Pose, other: Pose) -> str:
    apart_m = math.dist((one.easting_m, one.northing_m), (other.easting_m, other.northing_m))
    return f"{apart_m:.1f} m and {abs(float(wrap_deg(one.yaw_deg - other.yaw_deg))):.1f} deg apart"


def _words(scores: Iterator[float]) -> str:
    mine, theirs = scores
    return f"{mine:.1f} and {theirs:.1f} ({(mine - theirs) / max(abs(theirs), 1.0):+.1%})"


def _row(found: dict[str, float]) -> str:
    return f"{found['wall_s']:.2f} | {found['cpu_s']:.2f} | {found['first_s']:.2f} | {found['peak_mb']:.0f}"


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("out"))
    parser.add_argument("--region", default="vaduz")
    parser.add_argument("--old", type=dt.date.fromisoformat, default=dt.date(2015, 7, 27), help="date of the older map")
    parser.add_argument("--extracts", type=Path, action="append", default=[])
    parser.add_argument("--runs", type=int, default=7, help="views of each row of the tables of cost")
    parser.add_argument("--tables", nargs="+", choices=("speed", "costs"), default=("speed", "costs"))
    parser.add_argument("--agree", type=int, default=0, help="views of each kind to compare with the exhaustive search")
    parser.add_argument("--kinds", nargs="+", choices=[kind.name for kind in KINDS], default=[k.name for k in KINDS])
    parser.add_argument("--size", type=int, default=SIDE_CELLS, help="cells of the map a side: its middle")
    parser.add_argument("--view", type=int, default=VIEW_CELLS, help="cells of the view a side")
    parser.add_argument("--view-cell", type=float, default=2.0, help="metres a side of a cell of the view")
    parser.add_argument("--step", type=float, default=1.0, help="degrees of heading of the exhaustive search")
    parser.add_argument("--threads", type=int, default=2, help="of both searches, for --agree")
    parser.add_argument("--measure", nargs=3, help=argparse.SUPPRESS)
    given = parser.parse_args()
    cv2.setNumThreads(1)
    if given.measure:
        path, threads, step_deg = given.measure
        print(json.dumps(measured(Path(path), int(threads), float(step_deg))))
        return
    region = region_of(given.region, None, given)
    bench = Bench(world=State.of(region), reader=read(region), given=given)
    date = region.manifest.extract.date
    print(f"{given.region} of {date}, {len(region.classes)} classes, medians of {given.runs} views")
    if given.agree:
        bench.agreements()
        return
    with tempfile.TemporaryDirectory(prefix="sasgeo-bench-") as folder:
        if "speed" in given.tables:
            bench.speed(Path(folder))
        if "costs" in given.tables:
            bench.costs(Path(folder))


if __name__ == "__main__":
    main()
