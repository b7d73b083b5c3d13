# SPDX-License-Identifier: Apache-2.0
"""Write `old-style.md`: rates of ageing before and after multipolygons of the old style were assembled."""

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Final

import pandas as pd

from sasgeo_bench.regions.region import ATTRIBUTION

HERE: Final = Path(__file__).parent
BEFORE: Final = HERE / "before.csv"  # rates as this page had them until then, of data version 2
PLACES: Final = ("liechtenstein", "andorra", "monaco", "dreieich", "faroe")
RATES: Final = ("vanish_per_year", "appear_per_year", "ground_lost_per_year", "ground_gained_per_year")
FIGURES: Final = ("amount_from", *RATES)
HEAD: Final = """\
# Before and after old-style multipolygons

Made by `.venv/bin/python docs/ageing/old_style.py` from the tables of this folder and from `before.csv`, which holds
the rates as they were measured by data version 2. `amount` is what the first map holds (m2, or m of lines), the others
are rates over all intervals, % a year; each before and after. Maps of data version 3 differ in more than multipolygons:
barriers around yards are outlines, water with a negative layer is seen, covered and indoor things are not, and `bare`
is new. A dash: not measured.

| place | class | amount | vanishes | appears | ground lost | ground gained |
| --- | --- | --- | --- | --- | --- | --- |"""


def pooled(folder: Path) -> pd.DataFrame:
    """Read the pooled rates of each place, one row for each class."""
    tables = [pd.read_parquet(folder / place / "ageing.parquet") for place in PLACES]
    table = pd.concat(tables, ignore_index=True)
    table = table[table["span"] == "pooled"]
    return table[["place", "class", *FIGURES]].reset_index(drop=True)


def write(table: pd.DataFrame, before: pd.DataFrame) -> str:
    """Format both tables side by side, in the order of the newer one."""
    both = table.merge(before, on=["place", "class"], how="left", suffixes=("", " before"))
    lines = [HEAD]
    for row in both.to_dict("records"):
        cells = [_pair(row["amount_from before"], row["amount_from"], "{:,.0f}")]
        cells += [_pair(100 * row[f"{name} before"], 100 * row[name], "{:.2f}") for name in RATES]
        lines.append(f"| {row['place']} | {row['class']} | {' | '.join(cells)} |")
    return "\n".join([*lines, "", f"{ATTRIBUTION}.", ""])


def _pair(before: float, after: float, form: str) -> str:
    first, second = ("-" if pd.isna(value) else form.format(value) for value in (before, after))
    return first if first == second else f"{first} -> {second}"


def main(arguments: Sequence[str] | None = None) -> None:
    """Write the page, or with --keep the rates of today as those before."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--keep", type=Path, help="folder of tables whose rates become those before")
    given = parser.parse_args(arguments)
    if given.keep is not None:
        pooled(given.keep).to_csv(BEFORE, index=False, float_format="%.6g")
    (HERE / "old-style.md").write_text(write(pooled(HERE), pd.read_csv(BEFORE)), encoding="utf-8")
    sys.stderr.write(f"{HERE / 'old-style.md'}\n")


if __name__ == "__main__":
    main()
