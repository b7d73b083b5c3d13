# SPDX-License-Identifier: Apache-2.0
"""Measure every place of `places.toml`, and write the pages of this folder and the rates of the package.

What is measured lies in OUT and is not measured again: remove a folder there, or all of OUT, to do so.
"""

import argparse
import datetime as dt
import sys
import tomllib
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Annotated, Final

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.patches import Patch
from pydantic import Field
from statsmodels.stats.power import TTestPower

from sasgeo_bench.ageing.causes import CAUSES, causes_of_appeared, tagged
from sasgeo_bench.ageing.files import (
    TABLE,
    grid,
    rate_cells,
    read_ageing,
    replace_file,
    write_ageing,
    write_ratebook,
    write_summary,
)
from sasgeo_bench.ageing.measure import DTYPES, Ageing, measure_ageing, pairs_of
from sasgeo_bench.core.canvas import Page, page
from sasgeo_bench.core.config import Document, Line, parse_toml
from sasgeo_bench.core.errors import StoreError
from sasgeo_bench.core.parquet import read_frame, write_frame
from sasgeo_bench.core.progress import reporting
from sasgeo_bench.osm.history import MARGIN_M, History, date_extracts, read_history
from sasgeo_bench.osm.taxonomy import load_taxonomy
from sasgeo_bench.regions.region import ATTRIBUTION, LICENCE
from sasgeo_bench.regions.region_spec import RegionFile, list_region_files, read_region_file
from sasgeo_bench.tasks.split import Split, find_split
from sasgeo_bench.tasks.suites.ages import DAYS_PER_YEAR

HERE: Final = Path(__file__).parent
RATES: Final = HERE.parents[1] / "sasgeo_bench" / "ageing" / "ratebook.toml"
LEAST_YEARS: Final = (8.0, 5.0, 2.0)
_DRAWN: Final = ("building", "road_minor", "path_track", "green")
_COLOURS: Final = ("#d55e00", "#0072b2", "#56b4e9", "#cc79a7", "#bbbbbb")  # as CAUSES
_PLACES: Final = """\
Made by `make ageing`. Places of the split `world` of which a region has more than one date, with their half of the
split `places`, which stored boards of real ageing were drawn from. What the maps hold is in [the
summary](summary.md)."""
_POWER: Final = """\
The smallest difference between two methods that a paired test finds with 80 % probability (5 %, two sides), in standard
deviations of the difference between places, or between countries, since places of one country are alike. Places are
those with maps so many years apart."""
_BEFORE: Final = """\
Yearly rates in percent, with 95 % intervals: those of the rate book before (version 2, which drew all that vanishes and
appears), those measured anew, and what of them is the world, from what there is evidence for to that and what cannot be
told. A dash: not measured. Made by

```bash
git show b92bad11:sasgeo_bench/ageing/ratebook.toml > out/before.toml
.venv/bin/python docs/ageing/measure.py "$SASGEO_EXTRACTS" --before out/before.toml
```"""


class Place(Document):
    """A place, its extracts, and how they are cut."""

    name: Line
    country: Line
    files: Annotated[list[Line], Field(min_length=1)]
    at: list[dt.date] = []
    bounds: tuple[float, float, float, float] | None = Field(default=None, strict=False)
    margin_m: Annotated[float, Field(ge=0, strict=False)] = MARGIN_M
    is_whole: bool = False


class Places(Document):
    """`places.toml`."""

    place: list[Place]
    control: list[Place]


def list_places() -> Places:
    """Return the places of the table."""
    return parse_toml((HERE / "places.toml").read_text(encoding="utf-8"), Places, source="places.toml")


def history_of(place: Place, extracts: Path) -> History:
    """Read the dated maps of a place."""
    dated = date_extracts([extracts / file for file in place.files], at=place.at)
    return read_history(dated, bounds=place.bounds, margin_m=place.margin_m)


def measured(place: Place, extracts: Path, out: Path) -> Ageing:
    """Return the measurements of a place, taken from OUT if they are there."""
    folder = out / "".join(
        letter for letter in place.name.lower().replace(" ", "-") if letter.isalnum() or letter == "-"
    )
    try:
        return read_ageing(folder)
    except StoreError:
        ageing = measure_ageing(history_of(place, extracts), place=place.name, country=place.country)
        write_ageing(folder, ageing)
        return ageing


def write_all(path: Path, places: Sequence[Ageing]) -> None:
    """Write the tables of all places and controls into one file."""
    facts = {
        item.place: {"country": item.country, "sources": list(item.sources), "area_km2": item.area_km2}
        for item in places
    }
    table = pd.concat([item.table for item in places], ignore_index=True)
    attrs = {"attribution": ATTRIBUTION, "licence": LICENCE, "places": facts}
    replace_file(path, lambda scratch: write_frame(table, scratch, attrs=attrs))


def read_all() -> dict[str, Ageing]:
    """Return the stored measurements by name."""
    table = read_frame(HERE / TABLE, mend="run make ageing")
    return {
        name: Ageing(
            place=name,
            country=facts["country"],
            sources=tuple(facts["sources"]),
            area_km2=facts["area_km2"],
            table=table.loc[table["place"] == name, list(DTYPES)].reset_index(drop=True),
        )
        for name, facts in table.attrs["places"].items()
    }


def of_countries(places: Sequence[Ageing]) -> list[Ageing]:
    """Return the places without those that hold others of them."""
    whole = {place.name for place in list_places().place if place.is_whole}
    return [place for place in places if place.place not in whole]


# Places of the splits


def dated_places(split: Split) -> Iterator[tuple[str, RegionFile]]:
    """Yield the real places with several dates, in the order of the split, with their first region that has them."""
    files = {name: read_region_file(path) for name, path in list_region_files().items()}
    for place in split.spec.place:
        dated = [files[name] for name in place.region_ids if len(files[name].extract) > 1]
        if dated and dated[0].extract[0].town is None:
            yield place.name, dated[0]


def years_of(spec: RegionFile) -> float:
    """Years between the first and the last map of a region."""
    dates = [item.date for item in spec.extract]
    return (max(dates) - min(dates)).days / DAYS_PER_YEAR


def places_text() -> str:
    """Format the page of the places whose older maps suite `real-age` searches, and what they can decide."""
    world, halves = find_split("world"), find_split("places").half_of
    part_of = {place.name: place.part for place in world.spec.place}
    rows = []
    for place, spec in dated_places(world):
        dates = sorted(item.date for item in spec.extract)
        ends = [dates[0].isoformat(), dates[-1].isoformat()]
        facts = [place, world.country_of[place], str(part_of[place]), halves.get(place, "-"), str(len(dates))]
        rows.append([*facts, *ends, f"{years_of(spec):.1f}"])
    return "\n\n".join(
        (
            "# Places with maps of several dates",
            _PLACES,
            grid(("place", "country", "part", "half", "dates", "first", "last", "years"), rows),
            "## What they can decide",
            _POWER,
            grid(
                ("part", "maps apart by at least", "places", "countries", "over places", "over countries"), power(world)
            ),
            "Of the split `places`:",
            counts(find_split("places")),
            f"{ATTRIBUTION}\n",
        )
    )


def power(split: Split) -> list[list[str]]:
    """Count places and countries by part of a split, with the smallest difference each can show."""
    part_of = {place.name: place.part for place in split.spec.place}
    rows = []
    for part in dict.fromkeys(part_of.values()):
        for least in LEAST_YEARS:
            found = [place for place, spec in dated_places(split) if part_of[place] == part and years_of(spec) >= least]
            countries = {split.country_of[place] for place in found}
            if found:
                sizes = [len(found), len(countries)]
                rows.append([str(part), f"{least:g} years", *map(str, sizes), *map(_smallest, sizes)])
    return rows


def _smallest(number: int) -> str:
    """Return the effect that so many pairs show; a dash for fewer than three, which show nothing."""
    return "-" if number < 3 else f"{TTestPower().solve_power(nobs=number, alpha=0.05, power=0.8):.2f}"


def counts(split: Split) -> str:
    """Count the places, and their countries, whose maps lie so many years apart."""
    rows = []
    for least in LEAST_YEARS:
        found = [place for place, spec in dated_places(split) if years_of(spec) >= least]
        rows.append([f"{least:g} years", str(len(found)), str(len({split.country_of[place] for place in found}))])
    return grid(("maps apart by at least", "places", "countries"), rows)


# Pages


def before_text(book: Path, places: Sequence[Ageing]) -> str:
    """Put the rates of an older rate book beside those of today."""
    old = {place["name"]: place["class"] for place in tomllib.loads(book.read_text(encoding="utf-8"))["place"]}
    rows = []
    for name in load_taxonomy().names:
        for place in places:
            pooled = place.table[(place.table["span"] == "pooled") & (place.table["class"] == name)]
            for _, row in pooled.iterrows():
                known = old.get(place.place, {}).get(name, {})
                was = [known.get(f"{what}_per_year", {}).get("best") for what in ("vanish", "appear")]
                cells = ["-" if rate is None else f"{100 * rate:.2f}" for rate in was]
                now = rate_cells(row)
                rows.append([name, place.place, cells[0], *now[:2], cells[1], *now[2:]])
    return "\n\n".join(
        (
            "# Rates before and after",
            _BEFORE,
            grid(
                (
                    *("class", "place", "vanishes, before", "vanishes, after", "of it the world"),
                    *("appears, before", "appears, after", "of it the world"),
                ),
                rows,
            ),
            f"{ATTRIBUTION}\n",
        )
    )


def draw_causes(path: Path, places: Sequence[Ageing]) -> None:
    """Draw the causes of what appeared and vanished, place by place, for a few classes."""
    titles = {item.name: item.title for item in load_taxonomy().classes}
    about = Page(
        title="Why things vanished from maps and appeared on them",
        facts=f"{len(places)} places, all intervals of each; shares of the ground or length that vanished or appeared",
        note="Empty: nothing changed. At the right of a bar: all that vanishes or appears, % a year.",
        data=ATTRIBUTION,
        rows=len(_DRAWN),
        columns=2,
        panel_inches=(3.6, 0.16 * len(places) + 0.2),
        keys=[Patch(color=colour, label=cause) for cause, colour in zip(CAUSES, _COLOURS, strict=True)],
    )
    with page(path, about) as charts:
        for name, (left, right) in zip(_DRAWN, charts, strict=True):
            for chart, what in ((left, "vanished"), (right, "appeared")):
                _draw_shares(chart, places, name, what)
                chart.set_title(f"{titles[name]}: {what}")
            right.tick_params(labelleft=False)


def _draw_shares(chart: Axes, places: Sequence[Ageing], name: str, what: str) -> None:
    for at, place in enumerate(places):
        rows = place.table[(place.table["span"] == "pooled") & (place.table["class"] == name)]
        for _, row in rows.iterrows():
            shares = 100 * row[[f"{what}_{cause}_share" for cause in CAUSES]].to_numpy(dtype=np.float64)
            if np.isnan(shares).any():
                continue
            chart.barh(at, shares, left=np.cumsum(shares) - shares, color=_COLOURS, height=0.8)
            rate = 100 * row[{"vanished": "vanish_per_year", "appeared": "appear_per_year"}[what]]
            text = "all" if np.isinf(rate) else f"{rate:.2f}" if rate < 10 else f"{rate:.0f}"
            chart.text(102, at, text, va="center", fontsize=6.5)
    chart.set_xlim(0, 114)
    chart.set_xticks([0, 25, 50, 75, 100], ["0", "25", "50", "75", "100 %"])
    chart.set_ylim(len(places) - 0.4, -0.6)
    chart.set_yticks(range(len(places)), [place.place for place in places], fontsize=7)
    chart.tick_params(axis="y", length=0)
    chart.spines["left"].set_visible(False)


# How the rules agree with the tags


def agreement(places: Sequence[Place], extracts: Path) -> str:
    """Hold the other rules against what tags say of the buildings that appeared: amounts by cause, km2."""
    sums = {"new": np.zeros(len(CAUSES)), "old": np.zeros(len(CAUSES))}
    for place in places:
        for pairs in pairs_of(history_of(place, extracts)):
            pair = pairs["building"]
            is_new, is_old, is_site = tagged(pair)
            given = causes_of_appeared(pair, has_tags=False)
            sums["new"] += given[(is_new | is_site) & ~is_old].sum(axis=0) / 1e6
            sums["old"] += given[is_old].sum(axis=0) / 1e6
    rows = [[what, *(f"{amount:.4f}" for amount in sums[what])] for what in sums]
    return grid(("tags say", *CAUSES), rows)


def main() -> None:
    """Measure what is not measured yet, then write the pages."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("extracts", type=Path, help="folder of the dated extracts")
    parser.add_argument("--out", type=Path, default=Path("out/ageing"), help="folder of the measurements (out/ageing)")
    parser.add_argument("--before", type=Path, help="an older rate book: also write before.md")
    parser.add_argument("--tags", nargs="+", metavar="PLACE", help="only print how the other rules agree with tags")
    given = parser.parse_args()
    table = list_places()
    with reporting(lambda line: sys.stderr.write(f"{line}\n")):
        if given.tags:
            chosen = [item for item in table.place if item.name in given.tags]
            sys.stdout.write(f"{agreement(chosen, given.extracts)}\n")
            return
        places, controls = (
            [measured(place, given.extracts, given.out) for place in rows] for rows in (table.place, table.control)
        )
    own = of_countries(places)
    write_all(HERE / TABLE, [*places, *controls])
    write_summary(HERE / "summary.md", places, controls, countries=own)
    write_ratebook(RATES, own)
    replace_file(HERE / "causes.svg", lambda path: draw_causes(path, own))
    pages = {"places.md": places_text()}
    if given.before:
        pages["before.md"] = before_text(given.before, places)
    for name, text in pages.items():
        (HERE / name).write_text(text, encoding="utf-8")


if __name__ == "__main__":
    main()
