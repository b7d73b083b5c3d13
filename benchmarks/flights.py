# SPDX-License-Identifier: Apache-2.0
"""Draw the five kinds of flights, and print their attitudes beside those measured on real drones.

    .venv/bin/python benchmarks/flights.py --out out --picture docs/figures/flights.webp

Builds an embedded town and a real region where they are not in `--out`; without the extract of the real one
(SASGEO_EXTRACTS, --extracts) the town alone is drawn. Percentiles are over all poses of the flights of a row.
"""

import argparse
import os
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from tempfile import TemporaryDirectory

import cv2
import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.colors import Normalize
from matplotlib.lines import Line2D
from numpy.typing import NDArray

from sasgeo_bench.core.canvas import Page, page
from sasgeo_bench.core.errors import FlightError, SasgeoError
from sasgeo_bench.flights.kinematics import crab_deg, fly, tilt_deg, yaw_rate_deg_s
from sasgeo_bench.flights.plans import KINDS, PlanKind, Ways, plan_flight
from sasgeo_bench.flights.trajectory import Trajectory
from sasgeo_bench.regions.build import build_region, plan_build
from sasgeo_bench.regions.painting import paint_overview
from sasgeo_bench.regions.region import ATTRIBUTION, Region
from sasgeo_bench.regions.region_files import read_region
from sasgeo_bench.regions.region_spec import find_region_file, read_region_file

TOWN, PLACE = "town-industrial", "vaduz"
LENGTHS_M = {TOWN: 1500.0, PLACE: 4000.0}
SEEDS = {TOWN: 5, PLACE: 8}  # under which the flights of the picture lie apart
DRAWN: tuple[tuple[str, PlanKind, Ways, str], ...] = (
    ("survey", "survey", "road", "#d62728"),
    ("corridor along roads", "corridor", "road", "#1f3fbf"),
    ("corridor along a waterway", "corridor", "water", "#008fa8"),
    ("transit", "transit", "road", "#7b2fa0"),
    ("loiter", "loiter", "road", "#111111"),
    ("waypoints", "waypoints", "road", "#d06a00"),
)
HEIGHT_M = 90.0
SPEEDS_MPS = (2.0, 12.0)  # of the colours
QUALITY = 72
# Real drones at 80 to 91 m, cameras fixed to the body; and one gimbal (docs/concepts/flights.md).
MEASURED = (("tilt, deg", (9.6, 21.5, 24.0)), ("yaw rate, deg/s", (0.24, 18.0, 59.0)), ("crab, deg", (-5.0, 2.5)))
LEGS = ((500.0, 6), (600.0, 8))  # metres and number, of surveys as the measured ones may have been


def main() -> None:
    """Print the tables, and write the picture if asked to."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--extracts", type=Path, default=Path(os.environ.get("SASGEO_EXTRACTS", ".")))
    parser.add_argument("--flights", type=int, default=20, help="flights of each row")
    parser.add_argument("--picture", type=Path, help="where to write the picture (.webp)")
    said = parser.parse_args()
    regions = [region for name in (TOWN, PLACE) if (region := _region(name, said.out, said.extracts))]
    print("| Flights | tilt p50, p95, p99, deg | yaw rate p50, p95, p99, deg/s | course less heading p5, p95, deg |")
    print("|---|---:|---:|---:|")
    print(f"| measured, body | {' | '.join(', '.join(f'{one:g}' for one in values) for _, values in MEASURED)} |")
    print(
        _row("survey, legs of 500 and 600 m", [fly(_survey(*LEGS[at % 2]), **_air(at)) for at in range(said.flights)])
    )
    for kind in KINDS:
        print(_row(kind, list(_flights(regions, kind, said.flights))))
    print("| measured, gimbal | 5, 8 | | |")
    gimbal = [fly(_survey(*LEGS[at % 2]), carriage="gimbal", **_air(at)) for at in range(said.flights)]
    print(_row("survey, gimbal", gimbal))
    if said.picture:
        _draw(regions, said.picture)


def _air(seed: int) -> dict:
    return {"height_m": HEIGHT_M, "rng": np.random.default_rng((1, seed))}


def _survey(leg_m: float, legs: int, spacing_m: float = 60.0) -> NDArray[np.float64]:
    across = np.repeat(np.arange(legs) * spacing_m, 2)
    return np.column_stack([across, np.resize([0.0, leg_m, leg_m, 0.0], 2 * legs)])


def _flights(regions: Sequence[Region], kind: PlanKind, count: int) -> Iterator[Trajectory]:
    for seed in range(count):
        region = regions[seed % len(regions)]
        path = plan_flight(region, kind, length_m=LENGTHS_M[region.manifest.id], rng=np.random.default_rng((2, seed)))
        yield fly(path, **_air(seed))


def _row(name: str, flights: Sequence[Trajectory]) -> str:
    def _figures(measure: Callable[[Trajectory], NDArray[np.float64]], at: Sequence[float], digits: int) -> str:
        found = np.percentile(np.concatenate([measure(flown) for flown in flights]), at)
        return ", ".join(f"{one:.{digits}f}" for one in found)

    three = (50, 95, 99)
    cells = (_figures(tilt_deg, three, 1), _figures(yaw_rate_deg_s, three, 2), _figures(crab_deg, (5, 95), 1))
    return f"| {name} | {' | '.join(cells)} |"


def _region(name: str, out: Path, extracts: Path) -> Region | None:
    folder = out / "regions" / name
    if not folder.is_dir():
        try:
            plan = plan_build(read_region_file(find_region_file(name)), out=out, extract_folders=[extracts])
            build_region(plan)
        except SasgeoError as error:
            print(f"without {name}: {error}")
            return None
    return read_region(folder)


def _draw(regions: Sequence[Region], target: Path) -> None:
    keys = [Line2D([], [], color=colour, lw=2.5, label=name) for name, _, _, colour in DRAWN]
    about = Page(
        title="Flights over an embedded town and over a real place, and a turn of a survey",
        facts=f"Dot: start; arrow: end. {_lengths(regions)} each. Hatched ground is not mapped: no flight crosses it.",
        note=f"Right: colours are the speed over ground, {SPEEDS_MPS[0]:g} m/s dark to {SPEEDS_MPS[1]:g} m/s yellow.",
        data=ATTRIBUTION,
        columns=len(regions) + 1,
        panel_inches=(4.2, 4.2),
        keys=keys,
    )
    with TemporaryDirectory() as folder:
        drawn = Path(folder) / "flights.png"
        with page(drawn, about) as ((*maps, turn),):
            for chart, region in zip(maps, regions, strict=True):
                _map_panel(chart, region)
            _turn_panel(turn)
        cv2.imwrite(str(target), cv2.imread(str(drawn)), [cv2.IMWRITE_WEBP_QUALITY, QUALITY])
    print(f"wrote {target}")


def _lengths(regions: Sequence[Region]) -> str:
    return " and ".join(f"{LENGTHS_M[region.manifest.id]:g} m" for region in regions)


def _map_panel(chart: Axes, region: Region) -> None:
    west, south, east, north = region.grid.bounds_m
    step = max(1, region.grid.rows // 800)
    pale = 0.55 + 0.45 * (paint_overview(region.manifest, region.layers[:, ::step, ::step]) / 255)
    chart.imshow(pale, extent=(west, east, south, north), interpolation="antialiased")
    for seed, (name, kind, along, colour) in enumerate(DRAWN):
        rng = np.random.default_rng((SEEDS[region.manifest.id], seed))
        length_m = LENGTHS_M[region.manifest.id]
        try:
            path = plan_flight(region, kind, length_m=length_m, rng=rng, along=along)
        except FlightError as error:
            print(f"not drawn, {name}: {error}")
            continue
        places = fly(path, **_air(seed)).position_m[:, :2]
        chart.plot(*places.T, color="white", lw=4.5, solid_capstyle="round")
        chart.plot(*places.T, color=colour, lw=2.3, solid_capstyle="round")
        chart.plot(*places[0], "o", ms=7, mfc=colour, mec="white", mew=1.2, zorder=5)
        ahead = {"arrowstyle": "-|>", "color": colour, "lw": 2.3, "mutation_scale": 16}
        chart.annotate("", places[-1], places[-15], arrowprops=ahead, zorder=5)
    chart.set(xticks=[], yticks=[], xlim=(west, east), ylim=(south, north), aspect="equal")
    chart.set_title(f"{region.manifest.title}, {(east - west) / 1000:.1f} km wide")


def _turn_panel(chart: Axes) -> None:
    """Draw the turn between two legs: path, speed, and the body's heading each second."""
    flown = fly(_survey(160.0, 2), **_air(3))
    places, speeds = flown.position_m[:, :2], np.diff(flown.distance_m) / np.diff(flown.time_s)
    sides = np.stack([places[:-1], places[1:]], axis=1)
    lines = LineCollection(list(sides), cmap="plasma", norm=Normalize(*SPEEDS_MPS), linewidths=5, capstyle="round")
    lines.set_array(speeds)
    chart.add_collection(lines)
    at, yaw = places[::5], np.radians(flown.yaw_deg[::5])
    chart.quiver(*at.T, np.sin(yaw), np.cos(yaw), color="black", width=0.004, scale=18, zorder=4)
    for second in range(0, len(at), 4):
        tilt = tilt_deg(flown)[5 * second]
        chart.annotate(f"{tilt:.0f}\N{DEGREE SIGN}", at[second], xytext=(8, 7), textcoords="offset points", fontsize=8)
    chart.set(xlim=(-15, 75), ylim=(100, 190), aspect="equal", xlabel="east, m", ylabel="north, m")
    chart.set_title("A turn: heading each second, tilt each fourth")


if __name__ == "__main__":
    main()
