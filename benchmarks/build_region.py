# SPDX-License-Identifier: Apache-2.0
"""Time and memory of a region at five sizes: layers, features, graph and manifest, without the preview.

Every run has a process of its own, which builds 1 km2 first (libraries load themselves on first use) and then the size
that is measured. The table gives the medians of the runs: seconds and CPU seconds of the build, and the largest
resident memory of the process, imports included. Run it with `make bench`; it needs the 2025 extract of Liechtenstein
in a folder that SASGEO_EXTRACTS or --extracts names.
"""

import argparse
import json
import resource
import shutil
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from sasgeo_bench.regions.build import build_region, plan_build
from sasgeo_bench.regions.region_spec import find_region_file, read_region_file

SIDES_KM = (1, 2, 4, 8, 12)
CENTER_LONLAT = (9.522, 47.15)


def build_once(side_km: int, extracts: list[Path]) -> tuple[float, float]:
    """Build one size; wall and CPU seconds."""
    spec = read_region_file(find_region_file("vaduz")).model_copy(
        update={"center_lonlat": CENTER_LONLAT, "size_m": (side_km * 1000.0, side_km * 1000.0)}
    )
    out = Path(tempfile.mkdtemp(prefix="sasgeo-bench-"))
    try:
        start, start_cpu = time.perf_counter(), time.process_time()
        build_region(plan_build(spec, out=out, extract_folders=extracts), tell=lambda _: None)
        return time.perf_counter() - start, time.process_time() - start_cpu
    finally:
        shutil.rmtree(out)


def measure(side_km: int, extracts: list[Path]) -> dict[str, float]:
    """One warm-up, one build: what this process took."""
    build_once(1, extracts)
    seconds, cpu_s = build_once(side_km, extracts)
    peak_mb = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024 / 1e6
    return {"seconds": seconds, "cpu_s": cpu_s, "peak_mb": peak_mb}


def main() -> None:
    """Print one row for each size."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--runs", type=int, default=5)
    parser.add_argument("--extracts", type=Path, action="append", default=[])
    parser.add_argument("--side-km", type=int, help=argparse.SUPPRESS)
    given = parser.parse_args()
    if given.side_km:
        print(json.dumps(measure(given.side_km, given.extracts)))
        return
    print(f"medians of {given.runs} runs; Liechtenstein 2025-09-19, 1 m cells, 13 classes")
    print(f"{'km2':>5} {'s':>7} {'CPU s':>7} {'km2/s':>7} {'peak MB':>8}")
    folders = [word for folder in given.extracts for word in ("--extracts", str(folder))]
    for side_km in SIDES_KM:
        command = [sys.executable, __file__, "--side-km", str(side_km), *folders]
        rows = [
            json.loads(subprocess.run(command, check=True, capture_output=True, text=True).stdout)  # noqa: S603
            for _ in range(given.runs)
        ]
        seconds, cpu_s, peak_mb = (
            statistics.median(row[name] for row in rows) for name in ("seconds", "cpu_s", "peak_mb")
        )
        print(f"{side_km**2:5d} {seconds:7.2f} {cpu_s:7.2f} {side_km**2 / seconds:7.1f} {peak_mb:8.0f}", flush=True)


if __name__ == "__main__":
    main()
