# SPDX-License-Identifier: Apache-2.0
"""How long tables of poses take to read, and what is left out of each.

python benchmarks/pose_tables.py TABLE [TABLE ...]
"""

import argparse
import sys
import time
from pathlib import Path

from sasgeo_bench.core.errors import SasgeoError
from sasgeo_bench.observing.pose_tables import read_pose_table


def main() -> int:
    """Read each table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("tables", type=Path, nargs="+", metavar="TABLE")
    failed = 0
    for path in parser.parse_args().tables:
        begun = time.perf_counter()
        try:
            table = read_pose_table(path)
        except SasgeoError as error:
            failed += 1
            print(error, file=sys.stderr)
            continue
        seconds = time.perf_counter() - begun
        lines = table.lines()
        print(f"{lines[0]} in {seconds:.2f} s", *lines[1:], sep="\n  ")
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
