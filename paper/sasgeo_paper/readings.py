# SPDX-License-Identifier: Apache-2.0
"""Readings of the crop next to each other: the same trials with cropped cells unknown, absent, or not in the view."""

import math
from collections.abc import Iterator, Mapping
from typing import Final, get_args

import pandas as pd

from sasgeo_bench.boards.pipeline_spec import Crop, paper_suite
from sasgeo_bench.scoring.contrasts import Contrast, mean_finding
from sasgeo_bench.scoring.intervals import DRAWS
from sasgeo_paper.tables import METRICS, PUBLISHED

CROPS: Final[dict[str, Crop]] = {paper_suite(crop): crop for crop in get_args(Crop)}
TITLES: Final[dict[str, str]] = {
    "unknown": "unknown",
    "absent": "absent",
    "smaller": "not in the view, which is smaller",
}
_NO_GAP: Final = {"gap": math.nan, "gap_lo": math.nan, "gap_hi": math.nan, "won": 0, "lost": 0}


def with_gaps(
    summary: pd.DataFrame,
    crop: Crop,
    rows: Mapping[str, pd.DataFrame],
    first: Mapping[str, pd.DataFrame],
    *,
    draws: int = DRAWS,
) -> pd.DataFrame:
    """Return the summary of one reading with its paired difference in Recall@1 from the experiment's own reading.

    `rows` and `first` are scored rows by matcher under this reading and under "unknown"; trials pair by `pair_id`.
    `gap` comes with its 95 % interval over clusters, `won` and `lost` count the trials that are right under one
    reading alone. They are NaN and 0 for "unknown" and for other metrics.
    """
    gaps = [
        _gap(crop, rows[row["matcher"]], first[row["matcher"]], draws)
        if crop != "unknown" and row["metric"] == "recall_1" and row["matcher"] in first
        else _NO_GAP
        for row in summary.to_dict("records")
    ]
    return pd.concat([summary.assign(crop=crop), pd.DataFrame(gaps, index=summary.index)], axis=1)


def _gap(crop: Crop, rows: pd.DataFrame, first: pd.DataFrame, draws: int) -> dict[str, float]:
    """Return the paired difference of one matcher."""
    shared = sorted(set(rows["pair_id"]) & set(first["pair_id"]))
    here, there = (frame.set_index("pair_id", drop=False).loc[shared] for frame in (rows, first))
    contrast = Contrast(name=f"crop {crop}", first=crop, second="unknown", suites=tuple(CROPS), track="retrieval")
    found = mean_finding(contrast, here, there, draws)
    return {
        "gap": found.difference,
        "gap_lo": found.lo,
        "gap_hi": found.hi,
        "won": found.first_only,
        "lost": found.second_only,
    }


def held_lines(summary: pd.DataFrame) -> Iterator[str]:
    """Yield for each reading which of the paper's figures lie outside our intervals."""
    known = summary[summary["matcher"].isin([item.matcher for item in PUBLISHED]) & summary["paper"].notna()]
    for crop, rows in known.groupby("crop", sort=False):
        outside = rows[~rows["is_within"]]
        named = "; ".join(
            f"{row['title']}, {METRICS[row['metric']]} {row['value']:.3f} (paper {row['paper']:.3f})"
            for row in outside.to_dict("records")
        )
        held = f"{len(rows) - len(outside)} of the paper's {len(rows)} figures lie inside our intervals"
        yield f"cropped cells {TITLES[str(crop)]}: {held}" + (f"; outside: {named}." if named else ".")
