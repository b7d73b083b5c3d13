# SPDX-License-Identifier: Apache-2.0
"""Score stored boards again from their answers, and say where a figure is no longer the stored one.

    python -m benchmarks.rescored                       # each board of docs/results; minutes each
    python -m benchmarks.rescored docs/results/towns --draws 1000

Figures, not intervals, are compared: so few draws do. Figures that were added since a board was stored are passed over.
A workflow does so with all boards every month, a test of `make test` with the smallest. Exits with 1 if any differs.
"""

import argparse
import sys
import tempfile
from pathlib import Path
from typing import Final

import pandas as pd

from sasgeo_bench.cli.boards import score
from sasgeo_bench.core.errors import SasgeoError

RESULTS: Final = Path(__file__).parents[1] / "docs" / "results"
# Of contrasts: ends and verdicts hang on draws
FOUND: Final = ["name", "n", "places", "first_value", "second_value", "difference", "first_only", "second_only"]
KEYS: Final = ["matcher", "rejector", "suite", "track", "prior_group", "stratum", "metric"]


def rescored(stored: Path, out: Path, *, draws: int = 100) -> list[str]:
    """Return a line for each figure of a stored board that is another, or missing, when it is scored again."""
    return differences(stored, score(predictions=stored, out=out, name=stored.name, draws=draws, cases=False).folder)


def differences(stored: Path, again: Path) -> list[str]:
    """Return a line for each figure, and each column of answers and contrasts, that a board lacks or has otherwise."""
    old, new = (pd.read_parquet(folder / "leaderboard.parquet").set_index(KEYS)["value"] for folder in (stored, again))
    both = pd.concat({"old": old, "new": new.reindex(old.index)}, axis=1)
    differs = (both["old"] - both["new"]).abs().gt(1e-9) | (both["old"].isna() != both["new"].isna())
    figures = [
        f"{', '.join(map(str, key))}: {row['old']:.6g}, now {row['new']:.6g}" for key, row in both[differs].iterrows()
    ]
    found = []
    for table, compared in (("scores", None), ("contrasts", FOUND)):
        was, now = (pd.read_parquet(folder / f"{table}.parquet") for folder in (stored, again))
        names = list(was.columns) if compared is None else compared
        found += [
            f"column {name} of {table}.parquet" for name in names if name not in now or not was[name].equals(now[name])
        ]
    return figures + found


def main() -> int:
    """Score boards again and print what differs."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("boards", type=Path, nargs="*", help="folders of stored results; default: each of docs/results")
    parser.add_argument("--draws", type=int, default=100, help="draws of the bootstrap, which no compared figure needs")
    asked = parser.parse_args()
    found = 0
    for stored in asked.boards or sorted(path.parent for path in RESULTS.glob("*/pack.json")):
        try:
            with tempfile.TemporaryDirectory() as scratch:
                lines = rescored(stored, Path(scratch), draws=asked.draws)
        except SasgeoError as error:
            parser.error(str(error))
        print(f"{stored.name}: {f'{len(lines)} differ' if lines else 'as stored'}", *lines[:20], sep="\n  ", flush=True)
        found += len(lines)
    return 1 if found else 0


if __name__ == "__main__":
    sys.exit(main())
