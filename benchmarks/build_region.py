# SPDX-License-Identifier: Apache-2.0
"""Time and memory of a region at many sizes: layers, features, graph and manifest, without the preview.

Every run has a process of its own. The first table is of squares around Vaduz: the process builds 1 km2 first
(libraries load themselves on first use) and then the size that is measured. The second, with --countries, is of whole
extracts with cells of 1 m, from the start of the process to its end. The tables give the medians of the runs: seconds
and CPU seconds, and the largest resident memory of the process, imports included. --plot draws time and memory of the
second table against the mapped area. Run it with `make bench`; it needs the extracts of Liechtenstein (2025), of
Andorra (2025) and of the Faroes (2017) in a folder that SASGEO_EXTRACTS or --extracts names.
"""

import argparse
import json
import os
import resource
import shutil
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import psutil

from benchmarks.growth import draw
from sasgeo_bench.regions.build import build_region, plan_build
from sasgeo_bench.regions.region_spec import RegionFile, find_region_file, read_region_file

SIDES_KM = (1, 2, 4, 8, 12)
CENTER_LONLAT = (9.522, 47.15)
FAROES = {"center_lonlat": (-6.97, 61.895), "size_m": (81920.0, 120832.0)}  # no region of their own is shipped
COUNTRIES = {  # name -> region, share of its width and height around its middle
    "Liechtenstein": ("liechtenstein", 1.0),
    "Andorra, a quarter": ("andorra", 0.5),
    "Andorra": ("andorra", 1.0),
    "Faroes, a sixteenth": ("torshavn", 0.25),
    "Faroes, a quarter": ("torshavn", 0.5),
    "Faroes": ("torshavn", 1.0),
}


def square(side_km: float) -> RegionFile:
    """A square around Vaduz."""
    changes = {"center_lonlat": CENTER_LONLAT, "size_m": (side_km * 1000.0, side_km * 1000.0)}
    return read_region_file(find_region_file("vaduz")).model_copy(update=changes)


def country(name: str) -> RegionFile:
    """A whole extract, or the middle of it, with cells of 1 m."""
    region, share = COUNTRIES[name]
    spec = read_region_file(find_region_file(region))
    spec = spec.model_copy(update=FAROES if region == "torshavn" else {})
    size_m = tuple(1024.0 * round(share * side / 1024) for side in spec.size_m or ())
    return spec.model_copy(update={"size_m": size_m, "cell_size_m": 1.0})


def build_once(spec: RegionFile, extracts: list[Path]) -> tuple[float, float, float]:
    """Build a region; wall and CPU seconds, and the mapped area in km2."""
    out = Path(tempfile.mkdtemp(prefix="sasgeo-bench-"))
    try:
        start, start_cpu = time.perf_counter(), time.process_time()
        made = build_region(plan_build(spec, out=out, extract_folders=extracts))
        mapped_km2 = made.coverage.share * made.rows * made.cols * made.cell_size_m**2 / 1e6
        return time.perf_counter() - start, time.process_time() - start_cpu, mapped_km2
    finally:
        shutil.rmtree(out)


def measure(of: str, extracts: list[Path]) -> dict[str, float]:
    """Build a square after a warm-up, or a country: what this process took."""
    if of in COUNTRIES:
        *_, mapped_km2 = build_once(country(of), extracts)
        seconds, cpu_s = time.time() - psutil.Process().create_time(), time.process_time()
    else:
        build_once(square(1), extracts)
        seconds, cpu_s, mapped_km2 = build_once(square(float(of)), extracts)
    peak_mb = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024 / 1e6
    return {"seconds": seconds, "cpu_s": cpu_s, "peak_mb": peak_mb, "mapped_km2": mapped_km2}


def medians(of: str, runs: int, extracts: list[Path]) -> dict[str, float]:
    """Medians of several processes."""
    folders = [word for folder in extracts for word in ("--extracts", str(folder))]
    command = [sys.executable, __file__, "--of", of, *folders]
    environment = os.environ | {"ARROW_DEFAULT_MEMORY_POOL": "system"}  # as the program itself does
    rows = [
        json.loads(subprocess.run(command, check=True, capture_output=True, text=True, env=environment).stdout)  # noqa: S603
        for _ in range(runs)
    ]
    return {name: statistics.median(row[name] for row in rows) for name in rows[0]}


def draw_countries(rows: dict[str, dict[str, float]], path: Path) -> None:
    """Draw time and memory against the mapped area."""
    charts: dict[str, dict[str, list[tuple[float, float]]]] = {}
    for column, title in (("cpu_s", "processor time (s)"), ("peak_mb", "peak memory (MB)")):
        lines = charts[title] = {}
        for name, row in rows.items():
            lines.setdefault(name.partition(",")[0], []).append((row["mapped_km2"], row[column]))
    draw(path, charts, xlabel="mapped area (km²), cells of 1 m")


def main() -> None:
    """Print one row for each size."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--runs", type=int, default=5)
    parser.add_argument("--extracts", type=Path, action="append", default=[])
    parser.add_argument("--countries", action="store_true", help="whole extracts in place of squares")
    parser.add_argument("--plot", type=Path, help="file to draw the table of --countries to, as SVG")
    parser.add_argument("--of", help=argparse.SUPPRESS)
    given = parser.parse_args()
    if given.of:
        print(json.dumps(measure(given.of, given.extracts)))
        return
    if given.countries:
        print(f"medians of {given.runs} runs; cells of 1 m, 13 classes; whole processes")
        print(f"{'':22} {'mapped km2':>10} {'s':>7} {'CPU s':>7} {'peak MB':>8}")
        found = {}
        for name in COUNTRIES:
            row = found[name] = medians(name, given.runs, given.extracts)
            figures = f"{row['mapped_km2']:10.0f} {row['seconds']:7.1f} {row['cpu_s']:7.1f} {row['peak_mb']:8.0f}"
            print(f"{name:22} {figures}", flush=True)
        if given.plot:
            draw_countries(found, given.plot)
        return
    print(f"medians of {given.runs} runs; Liechtenstein 2025-09-19, 1 m cells, 13 classes")
    print(f"{'km2':>5} {'s':>7} {'CPU s':>7} {'km2/s':>7} {'peak MB':>8}")
    for side_km in SIDES_KM:
        row = medians(str(side_km), given.runs, given.extracts)
        speed = side_km**2 / row["seconds"]
        figures = f"{row['seconds']:7.2f} {row['cpu_s']:7.2f} {speed:7.1f} {row['peak_mb']:8.0f}"
        print(f"{side_km**2:5d} {figures}", flush=True)


if __name__ == "__main__":
    main()
