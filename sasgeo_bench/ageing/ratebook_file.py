# SPDX-License-Identifier: Apache-2.0
"""Read and write `ratebook.toml`: measured yearly rates of all places; the package holds one."""

from collections.abc import Sequence
from functools import cache
from importlib import resources
from pathlib import Path
from typing import Final

import pandas as pd

from sasgeo_bench.ageing.files import check_names, replace_file
from sasgeo_bench.ageing.measure import Ageing
from sasgeo_bench.ageing.ratebook import RateBook
from sasgeo_bench.config import parse_toml
from sasgeo_bench.regions.region import ATTRIBUTION, LICENCE
from sasgeo_bench.texts import quoted

PACKAGED: Final = "ratebook.toml"
_HEAD: Final = f"""\
# Yearly rates by place and class, written by `sasgeo-bench compare-ageing --rates`; not to be edited.
# {ATTRIBUTION}
attribution = {quoted(ATTRIBUTION)}
licence = {quoted(LICENCE)}
"""
_COUNTS: Final = ("n_from", "n_to")
_RATES: Final = ("vanish_per_year", "appear_per_year")
_SHARES: Final = ("redrawn_share", "shift_median_m", "shift_p90_m")


def ratebook_text(places: Sequence[Ageing]) -> str:
    """Format several places as TOML; raise `ConfigError` if two have one name."""
    check_names(places)
    parts = [_HEAD if places else f"{_HEAD}place = []\n"]
    for place in places:
        files = dict.fromkeys(source.rpartition(" of ")[0] for source in place.sources)
        lines = [
            "[[place]]",
            f"name = {quoted(place.place)}",
            f"area_km2 = {place.area_km2!r}",
            f"extracts = [{', '.join(map(quoted, files))}]",
        ]
        pooled, whole = (place.table[place.table["span"] == span].set_index("class") for span in ("pooled", "whole"))
        parts.append("\n".join(lines) + "\n")
        parts += [_class_text(name, pooled.loc[name], whole.loc[name]) for name in pooled.index]
    return "\n".join(parts)


def _class_text(name: str, pooled: pd.Series, whole: pd.Series) -> str:
    lines = [f"[place.class.{name}]", f"years = {round(float(pooled['years']), 2)!r}"]
    lines += [f"{column} = {int(pooled[column])}" for column in _COUNTS]
    for column in _RATES:
        ends = {"best": pooled[column], "lo": pooled[f"{column}_lo"], "hi": pooled[f"{column}_hi"]}
        known = [f"{end} = {float(value)!r}" for end, value in ends.items() if not pd.isna(value)]
        if known:
            lines.append(f"{column} = {{ {', '.join(known)} }}")
    lines += [f"{column} = {float(whole[column])!r}" for column in _SHARES if not pd.isna(whole[column])]
    return "\n".join(lines) + "\n"


def write_ratebook(path: Path, places: Sequence[Ageing]) -> Path:
    """Write `ratebook_text` into a file, replaced whole; raise `StoreError` if it cannot be written."""
    text = ratebook_text(places)
    return replace_file(path, lambda scratch: scratch.write_text(text, encoding="utf-8"))


@cache
def load_ratebook() -> RateBook:
    """Return the rates of the package, those of `docs/ageing`."""
    text = resources.files("sasgeo_bench.ageing").joinpath(PACKAGED).read_text(encoding="utf-8")
    return parse_toml(text, RateBook, source=PACKAGED)
