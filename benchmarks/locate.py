# SPDX-License-Identifier: Apache-2.0
"""Time and memory of `locate` as a user types it: one photo from nothing, and a folder.

    .venv/bin/python benchmarks/own_photos.py out chateaugiron-ortho --into photos --count 20
    .venv/bin/python benchmarks/locate.py photos/chateaugiron-ortho/photos --out out --region chateaugiron-ortho

Whole processes; medians of `--runs`. Memory is the most that all processes hold at a time, each shared page counted
once (PSS), looked at every 50 ms. Goals: 10 s for the first photo over 4 km2, 2 s for each further one, 800 MB.
"""

import argparse
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path

import psutil


def watched(command: Sequence[str]) -> tuple[float, float]:
    """Run a command; return its seconds and the most megabytes that it and all it started held."""
    begun, most = time.perf_counter(), 0
    process = psutil.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    while process.poll() is None:
        held = 0
        for one in [process, *_children(process)]:
            try:
                held += one.memory_full_info().pss
            except psutil.Error:
                continue
        most = max(most, held)
        time.sleep(0.05)
    if process.returncode:
        raise SystemExit(f"{' '.join(command)} ended with {process.returncode}")
    return time.perf_counter() - begun, most / 1e6


def _children(process: psutil.Process) -> list[psutil.Process]:
    try:
        return process.children(recursive=True)
    except psutil.Error:
        return []


def main() -> None:
    """Print seconds and megabytes of one photo, and of a folder."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("photos", type=Path, help="folder of photos that can be located")
    parser.add_argument("--out", default="out")
    parser.add_argument("--region", required=True)
    parser.add_argument("--runs", type=int, default=3)
    given = parser.parse_args()
    names = sorted(given.photos.glob("*.jpg"))
    print("| | photos | s | s a further photo | peak MB |\n|---|---:|---:|---:|---:|")
    first_s = 0.0
    for title, pictures, count in (("one", names[0], 1), ("folder", given.photos, len(names))):
        found = []
        for _ in range(given.runs):
            with tempfile.TemporaryDirectory() as folder:
                words = ["locate", str(pictures), "--out", given.out, "--region", given.region, "--into", f"{folder}/a"]
                found.append(watched([sys.executable, "-m", "sasgeo_bench", *words]))
        seconds, megabytes = (statistics.median(column) for column in zip(*found, strict=True))
        more = f"{(seconds - first_s) / (count - 1):.2f}" if count > 1 else "-"
        first_s = seconds
        print(f"| {title} | {count} | {seconds:.1f} | {more} | {megabytes:.0f} |")


if __name__ == "__main__":
    main()
