# SPDX-License-Identifier: Apache-2.0
"""Write `ageing.parquet`, `ageing.md`, `ageing.svg` of one place, and a table of several places."""

import math
from collections import Counter
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Final

import pandas as pd

from sasgeo_bench.ageing.causes import CAUSES
from sasgeo_bench.ageing.compare import MATCH_IOU, NEAR_M, REDRAWN_M
from sasgeo_bench.ageing.measure import DTYPES, LEAST_DAYS, Ageing, by_country
from sasgeo_bench.ageing.plots import draw_ageing
from sasgeo_bench.ageing.ratebook import VERSION
from sasgeo_bench.core.errors import ConfigError, StoreError
from sasgeo_bench.core.folders import fresh_file
from sasgeo_bench.core.parquet import read_frame, write_frame
from sasgeo_bench.core.texts import markdown, markdown_item, quoted
from sasgeo_bench.osm.taxonomy import load_taxonomy
from sasgeo_bench.regions.region import ATTRIBUTION, LICENCE

TABLE: Final = "ageing.parquet"

_READING: Final = f"""\
Things are paired by geometry, never by id: areas by an IoU above {MATCH_IOU:g}, or by the ground they share if split or
merged; lines by the length within {NEAR_M:g} m of a line of the other map. Rates are those of an exponential life whose
end is known only to lie between two dates, by amount (ground or length), with 95 % intervals from 1,000 draws of blocks
of 1 km. "The world" is what changed on the ground: at least what there is evidence for, at most that and what cannot be
told; in brackets the lower end of the one interval and the upper end of the other. A dash: nothing to measure, or dates
less than {LEAST_DAYS} days apart; "all": no bound."""
_READING_SHARES: Final = f"""\
Rates are over all intervals, shares of the first map against the last: vanished of the older, appeared of the newer, by
amount and by number (each thing of which more than half did). Ground lost and gained is what the class no longer, or
newly, covers, with things that were redrawn, and lines in their drawn width. Re-drawn was kept and moved by more than
{REDRAWN_M:g} m (areas: their centroid). Causes are shares of what vanished or appeared in all intervals: the world,
mapping, redrawing out of reach of a pair, retagging, and untold. Every pair of dates: `{TABLE}`."""

_BOTH_WAYS: Final = ("vanished", "vanished_number", "appeared", "appeared_number")
_COUNTRIES: Final = """\
Amounts of all places of a country together. Intervals come from draws of its places where there are three or more; of
two places they reach from the lowest end of their own to the highest, and of one they are its own, from its blocks."""
_CONTROLS: Final = """\
Pairs of maps so close in time that almost nothing can have changed. The shares of the amount that vanished, appeared
are the noise floor of the method: mostly things that only one of the two extracts was cut to hold."""


def write_ageing(folder: Path, ageing: Ageing) -> tuple[Path, ...]:
    """Write table, text and plot into a folder, each replaced whole; raise `StoreError` if one cannot be written."""
    attrs = {
        "attribution": ATTRIBUTION,
        "licence": LICENCE,
        "place": ageing.place,
        "country": ageing.country,
        "sources": list(ageing.sources),
        "area_km2": ageing.area_km2,
    }
    writers: dict[str, Callable[[Path], object]] = {
        TABLE: lambda path: write_frame(ageing.table, path, attrs=attrs),
        "ageing.md": lambda path: path.write_text(ageing_text(ageing), encoding="utf-8"),
        "ageing.svg": lambda path: draw_ageing(path, ageing),
    }
    return tuple(replace_file(folder / name, write) for name, write in writers.items())


def replace_file(target: Path, write: Callable[[Path], object]) -> Path:
    """Let `write` fill a scratch file, then move it to the target; raise `StoreError` if it cannot be written."""
    with fresh_file(target, mend="check the free space and the rights of its folder") as scratch:
        write(scratch)
    return target


def read_ageing(folder: Path) -> Ageing:
    """Read the output of `write_ageing`; raise `StoreError` if there is none or it is damaged.

    >>> read_ageing(Path("nowhere"))
    Traceback (most recent call last):
        ...
    sasgeo_bench.core.errors.StoreError: nowhere holds no ageing.parquet: run measure-ageing with --out nowhere first
    """
    path = folder / TABLE
    if not path.is_file():
        raise StoreError(f"{folder} holds no {TABLE}: run measure-ageing with --out {folder} first")
    try:
        table = read_frame(path, mend="measure it again")
        facts = table.attrs
        ageing = Ageing(
            place=facts["place"],
            country=facts["country"],
            sources=tuple(facts["sources"]),
            area_km2=facts["area_km2"],
            table=table[list(DTYPES)],
        )
    except (ValueError, KeyError, TypeError) as error:
        raise StoreError(
            f"{path} cannot be read as a table of ageing ({' '.join(str(error).split())[:120]}): measure it again"
        ) from error
    return ageing


def ageing_text(ageing: Ageing) -> str:
    """Format one place as Markdown: rates and shares, class by class; pairs of dates are in the table alone."""
    sources = "\n".join(f"- {markdown_item(source)}" for source in ageing.sources)
    return "\n\n".join(
        (
            f"# {markdown(ageing.place)}: how the map aged",
            _READING,
            f"{ageing.area_km2:,.1f} km2 that all of these map:\n\n{sources}",
            _READING_SHARES,
            grid(("class", *_RATE_HEAD, *_SHARE_HEAD), _rate_rows(ageing.table, by="class", has_shares=True)),
            f"{ATTRIBUTION}\n",
        )
    )


def summary_text(
    places: Sequence[Ageing], controls: Sequence[Ageing] = (), *, countries: Sequence[Ageing] | None = None
) -> str:
    """Format several places as Markdown: the rates of each class, then the result of controls.

    `countries` are the places that figures of countries are made of: all, if it is left out.

    Raise `ConfigError` if two places have one name.
    """
    check_names((*places, *controls))
    rows = [_place_cells(place) for place in (*places, *controls)]
    parts = ["# How maps aged", _READING, grid(_PLACE_HEAD, rows)]
    together_by = by_country(places if countries is None else countries)
    if len(together_by):
        parts += [
            "## By country",
            _COUNTRIES,
            grid(
                ("class", "country", "places", *_RATE_HEAD[2:]),
                [
                    [row["class"], row["country"], str(row["places"]), *rate_cells(row)]
                    for _, row in together_by.iterrows()
                ],
            ),
        ]
    together = _together(places)
    for name in _classes_of(together):
        handset = load_taxonomy()[name].persistence
        rates = (100 * handset.vanish_per_year, 100 * handset.appear_per_year)
        note = f"The taxonomy has, set by hand: vanishes {rates[0]:.2f}, appears {rates[1]:.2f} %/year."
        rows = _rate_rows(together[together["class"] == name], by="place")
        parts += [f"## {name}", note, grid(("place", *_RATE_HEAD), rows)]
    if controls:
        parts += ["## Controls", _CONTROLS, _control_table(controls)]
    return "\n\n".join((*parts, f"{ATTRIBUTION}\n"))


def check_names(places: Sequence[Ageing]) -> None:
    """Raise `ConfigError` if two places have one name."""
    twice = [name for name, count in Counter(place.place for place in places).items() if count > 1]
    if twice:
        raise ConfigError(f"two tables are of {twice[0]!r}: measure one of them with another --place")


def _together(places: Sequence[Ageing]) -> pd.DataFrame:
    tables = [place.table.assign(place=place.place) for place in places]
    return pd.concat(tables, ignore_index=True) if tables else pd.DataFrame(columns=list(DTYPES))


def _classes_of(table: pd.DataFrame) -> list[str]:
    found = set(table["class"])
    return [name for name in load_taxonomy().names if name in found]


def _control_table(controls: Sequence[Ageing]) -> str:
    tables = {control.place: control.table.set_index(["span", "class"]) for control in controls}
    lines = [
        [name, *(_control_cell(table, name) for table in tables.values())] for name in _classes_of(_together(controls))
    ]
    return grid(("class", *tables), lines)


def _control_cell(table: pd.DataFrame, name: str) -> str:
    shares = (table[f"{what}_share"].get(("whole", name)) for what in ("vanished", "appeared"))
    return ", ".join("-" if share is None else _percent(share) for share in shares)


def write_summary(
    path: Path,
    places: Sequence[Ageing],
    controls: Sequence[Ageing] = (),
    *,
    countries: Sequence[Ageing] | None = None,
) -> Path:
    """Write `summary_text` into a file, replaced whole; raise `StoreError` if it cannot be written."""
    text = summary_text(places, controls, countries=countries)
    return replace_file(path, lambda scratch: scratch.write_text(text, encoding="utf-8"))


_PLACE_HEAD: Final = ("place", "km2", "maps", "first", "last")


def _place_cells(ageing: Ageing) -> list[str]:
    first, last = ageing.table["date_from"].min(), ageing.table["date_to"].max()
    return [ageing.place, f"{ageing.area_km2:,.1f}", str(len(ageing.sources)), f"{first:%Y-%m-%d}", f"{last:%Y-%m-%d}"]


_RATE_HEAD: Final = (
    *("first amount", "last amount", "vanishes, %/year", "of it the world, %/year"),
    *("appears, %/year", "of it the world, %/year"),
)
_SHARE_HEAD: Final = (
    *("ground lost, %/year", "ground gained, %/year"),
    *("vanished, amount", "vanished, number", "appeared, amount", "appeared, number"),
    *("re-drawn, amount", "ids gone, number"),
    *(f"of {what}: {', '.join(CAUSES)}" for what in ("vanished", "appeared")),
)


def _rate_rows(table: pd.DataFrame, *, by: str, has_shares: bool = False) -> list[list[str]]:
    """Format a row for each class (or place): pooled rates, and shares of the first map against the last."""
    rows = []
    pooled, whole = (table[table["span"] == span].set_index(by) for span in ("pooled", "whole"))
    for name in pooled.index:
        rate, share = pooled.loc[name], whole.loc[name]
        row = [
            str(name),
            _amount(share["amount_from"], share["unit"]),
            _amount(share["amount_to"], share["unit"]),
            *rate_cells(rate),
        ]
        if has_shares:
            row += [_rate(rate, f"{what}_per_year") for what in ("ground_lost", "ground_gained")]
            row += [_percent(share[f"{what}_share"]) for what in (*_BOTH_WAYS, "redrawn", "id_vanished")]
            row += [_shares(rate, what, CAUSES) for what in ("vanished", "appeared")]
        rows.append(row)
    return rows


def rate_cells(rate: pd.Series) -> list[str]:
    """Format what vanishes, what of it is the world, and the same of what appears, in percent a year."""
    return [
        cell
        for what in ("vanish", "appear")
        for cell in (_rate(rate, f"{what}_per_year"), _between(rate, f"{what}_least_per_year", f"{what}_most_per_year"))
    ]


def _between(row: pd.Series, least: str, most: str) -> str:
    """Format `0.14 to 0.26 (0.10 to 0.35)`, in percent."""
    low, high, lo, hi = (100 * row[name] for name in (least, most, f"{least}_lo", f"{most}_hi"))
    if pd.isna(low) or pd.isna(high):
        return "-"
    known = "" if pd.isna(lo) or pd.isna(hi) else f" ({lo:.2f} to {_bounded(hi)})"
    return f"{_bounded(low)} to {_bounded(high)}{known}"


def _amount(value: float, unit: str) -> str:
    return f"{value / 1e6:,.3f} km2" if unit == "m2" else f"{value / 1e3:,.1f} km"


def _shares(row: pd.Series, what: str, reasons: Sequence[str]) -> str:
    return ", ".join(_percent(row[f"{what}_{reason}_share"]) for reason in reasons)


def _percent(share: float) -> str:
    return "-" if pd.isna(share) else f"{100 * share:.1f} %"


def _rate(row: pd.Series, name: str) -> str:
    """Format `0.30 (0.25 to 0.36)`, in percent."""
    value, lo, hi = (100 * row[f"{name}{end}"] for end in ("", "_lo", "_hi"))
    if pd.isna(value):
        return "-"
    known = "" if pd.isna(lo) or math.isinf(lo) else f" ({lo:.2f} to {_bounded(hi)})"
    return f"{_bounded(value)}{known}"


def _bounded(percent: float) -> str:
    """Format a rate; an infinite one belongs to a class of which nothing remained."""
    return "all" if math.isinf(percent) else f"{percent:.2f}"


def grid(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """Format a Markdown table."""
    lines = [map(markdown, head), ["---"] * len(head), *(map(markdown, row) for row in rows)]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


_RATEBOOK_HEAD: Final = f"""\
# Yearly rates by place and class, written by `sasgeo-bench measure-ageing --compare --rates`; not to be edited.
# {ATTRIBUTION}
version = {VERSION}
attribution = {quoted(ATTRIBUTION)}
licence = {quoted(LICENCE)}
"""
_RATEBOOK_COUNTS: Final = ("n_from", "n_to")
_RATEBOOK_RATES: Final = tuple(
    f"{what}{of}_per_year" for what in ("vanish", "appear") for of in ("", "_least", "_most")
)
_RATEBOOK_SHARES: Final = ("redrawn_share", "shift_median_m")


def ratebook_text(places: Sequence[Ageing]) -> str:
    """Format several places as TOML; raise `ConfigError` if two have one name, or one has no country."""
    check_names(places)
    homeless = [place.place for place in places if not place.country]
    if homeless:
        raise ConfigError(f"the country of {homeless[0]!r} is unknown: measure it again with --country")
    parts = [_RATEBOOK_HEAD if places else f"{_RATEBOOK_HEAD}place = []\n"]
    for place in places:
        files = dict.fromkeys(source.rpartition(" of ")[0] for source in place.sources)
        lines = [
            "[[place]]",
            f"name = {quoted(place.place)}",
            f"country = {quoted(place.country)}",
            f"area_km2 = {place.area_km2!r}",
            f"extracts = [{', '.join(map(quoted, files))}]",
        ]
        pooled, whole = (place.table[place.table["span"] == span].set_index("class") for span in ("pooled", "whole"))
        parts.append("\n".join(lines) + "\n")
        parts += [_ratebook_class(name, pooled.loc[name], whole.loc[name]) for name in pooled.index]
    return "\n".join(parts)


def _ratebook_class(name: str, pooled: pd.Series, whole: pd.Series) -> str:
    lines = [f"[place.class.{name}]", f"years = {round(float(pooled['years']), 2)!r}"]
    lines += [f"{column} = {int(pooled[column])}" for column in _RATEBOOK_COUNTS]
    for column in _RATEBOOK_RATES:
        ends = {"best": pooled[column], "lo": pooled[f"{column}_lo"], "hi": pooled[f"{column}_hi"]}
        known = [f"{end} = {_short(value)}" for end, value in ends.items() if not pd.isna(value)]
        if known:
            lines.append(f"{column} = {{ {', '.join(known)} }}")
    for what in ("vanished", "appeared"):
        shares = {cause: pooled[f"{what}_{cause}_share"] for cause in CAUSES}
        if not any(map(pd.isna, shares.values())):
            told = ", ".join(f"{cause} = {_short(share)}" for cause, share in shares.items())
            lines.append(f"{what} = {{ {told} }}")
    lines += [f"{column} = {_short(whole[column])}" for column in _RATEBOOK_SHARES if not pd.isna(whole[column])]
    return "\n".join(lines) + "\n"


def _short(value: float) -> str:
    return repr(round(float(value), 5))


def write_ratebook(path: Path, places: Sequence[Ageing]) -> Path:
    """Write `ratebook_text` into a file, replaced whole; raise `StoreError` if it cannot be written."""
    text = ratebook_text(places)
    return replace_file(path, lambda scratch: scratch.write_text(text, encoding="utf-8"))
