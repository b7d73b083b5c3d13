# SPDX-License-Identifier: Apache-2.0
"""Time a place from its centre to a built region: new-region, then build-region with its preview, in whole processes.

The places have 4 km2, in extracts of whole countries among all others in a folder that SASGEO_EXTRACTS or --extracts
names: Andorra (2025), Liechtenstein (2025) and the Faroes (a full history, 2017). Medians of --runs.
"""

import argparse
import os
import resource
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Final

PROGRAM: Final = "from sasgeo_bench.cli import main; main()"
PLACES: Final = {"Andorra": "1.5218,42.5075", "Liechtenstein": "9.530,47.145", "Faroes": "-6.774,62.011"}


def run(words: list[str], folder: Path) -> tuple[float, float]:
    """Run the program in a folder; seconds by the clock and of processor."""
    before, start = resource.getrusage(resource.RUSAGE_CHILDREN), time.perf_counter()
    subprocess.run([sys.executable, "-c", PROGRAM, *words], cwd=folder, check=True, capture_output=True)  # noqa: S603 - our own program
    clock_s, after = time.perf_counter() - start, resource.getrusage(resource.RUSAGE_CHILDREN)
    return clock_s, after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime


def main() -> None:
    """Print one row for each place."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--runs", type=int, default=3)
    parser.add_argument("--extracts", default=os.environ.get("SASGEO_EXTRACTS", ""))
    given = parser.parse_args()
    os.environ["SASGEO_EXTRACTS"] = given.extracts
    print("| place | new-region, s | build-region, s | both, s | CPU s |\n|---|---:|---:|---:|---:|")
    for name, center in PLACES.items():
        rows = []
        for _ in range(given.runs):
            with tempfile.TemporaryDirectory(prefix="sasgeo-bench-") as scratch:
                words = ["new-region", "place", "--center", center, "--size", "2km", "--most-mb", "0"]
                (first_s, first_cpu_s), (second_s, second_cpu_s) = (
                    run(each, Path(scratch)) for each in (words, ["build-region", "my-regions/place.toml"])
                )
                rows.append((first_s, second_s, first_s + second_s, first_cpu_s + second_cpu_s))
        figures = " | ".join(f"{statistics.median(column):.1f}" for column in zip(*rows, strict=True))
        print(f"| {name} | {figures} |", flush=True)


if __name__ == "__main__":
    main()
