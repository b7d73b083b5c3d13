# SPDX-License-Identifier: Apache-2.0
"""Time how long the program and a matcher's process take to start: the median of five whole processes each."""

import resource
import statistics
import subprocess
import sys
import time
from collections.abc import Sequence
from typing import Final

REPEATS: Final = 5
PROGRAM: Final = "from sasgeo_bench.cli import main; main()"
STARTS: Final = {
    "import sasgeo_bench": ["import sasgeo_bench"],
    "a matcher's process": ["import sasgeo_bench.running.serve"],
    **{words: [PROGRAM, words] for words in ("--help", "list-matchers", "list-regions", "list-suites")},
}


def measure(command: Sequence[str]) -> tuple[float, float]:
    """Return the seconds of processor and by the clock that one process takes."""
    before, start = resource.getrusage(resource.RUSAGE_CHILDREN), time.perf_counter()
    subprocess.run([sys.executable, "-c", *command], stdout=subprocess.DEVNULL, check=True)  # noqa: S603 - our own program
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    return after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime, time.perf_counter() - start


def main() -> None:
    """Print the table."""
    print("| start | processor, s | clock, s |\n|---|---:|---:|")
    for name, command in STARTS.items():
        processor_s, clock_s = zip(*(measure(command) for _ in range(REPEATS)), strict=True)
        print(f"| {name} | {statistics.median(processor_s):.2f} | {statistics.median(clock_s):.2f} |")


if __name__ == "__main__":
    main()
