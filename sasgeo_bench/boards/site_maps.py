# SPDX-License-Identifier: Apache-2.0
"""Where a board's queries lie, how fast such maps grow old, and the scripts of the page with the answers."""

import json
import math
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from importlib import resources
from pathlib import Path
from typing import Final

import numpy as np
import pandas as pd
from matplotlib.axes import Axes

from sasgeo_bench.ageing.ratebook import ClassAgeing, Estimate, RateBook
from sasgeo_bench.boards.cases import FAILURES, MEANINGS
from sasgeo_bench.boards.manifests import BoardTask, RegionMap
from sasgeo_bench.boards.plots import FAINT, BoardPage, Look, line_keys, look_of
from sasgeo_bench.boards.site_files import MAPS, SiteSource, Spot
from sasgeo_bench.boards.tables import (
    Cell,
    Field,
    Record,
    Table,
    column,
    file_stem,
    interval_text,
    plain_cell,
    records_of,
    table_of,
    word,
)
from sasgeo_bench.core.canvas import GREY, page
from sasgeo_bench.core.errors import StoreError
from sasgeo_bench.core.texts import plain
from sasgeo_bench.osm.taxonomy import load_taxonomy
from sasgeo_bench.scoring.intervals import seed_of_text
from sasgeo_bench.tasks.query import base_of

# --- places -----------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True, kw_only=True)
class PlaceOnMap:
    """A place of the board: its number on the map, its position, and the half or part that it belongs to."""

    number: int
    name: str
    part: str
    longitude_deg: float
    latitude_deg: float
    is_made_up: bool


def regions_of(tasks: Sequence[BoardTask]) -> dict[str, list[BoardTask]]:
    """Return the tasks of a board by region, whatever date or copy of it they search.

    >>> list(regions_of([BoardTask(suite="clean", region=name) for name in ("vaduz@2015-07-27", "vaduz+alias")]))
    ['vaduz']
    """
    found: dict[str, list[BoardTask]] = {}
    for task in tasks:
        found.setdefault(base_of(task.region), []).append(task)
    return dict(sorted(found.items()))


def places_on_map(
    tasks: Sequence[BoardTask], spots: Mapping[str, Spot], parts: Mapping[str, tuple[str, str]]
) -> tuple[PlaceOnMap, ...]:
    """Return the places of a board with known positions, numbered; the middle of several regions."""
    by_place: dict[str, list[Spot]] = {}
    for region in (name for name in regions_of(tasks) if name in spots):
        by_place.setdefault(parts.get(region, (region, ""))[0], []).append(spots[region])
    halves = dict(parts.values())
    return tuple(
        PlaceOnMap(
            number=number,
            name=name,
            part=halves.get(name, ""),
            longitude_deg=sum(spot.longitude_deg for spot in found) / len(found),
            latitude_deg=sum(spot.latitude_deg for spot in found) / len(found),
            is_made_up=all(spot.is_made_up for spot in found),
        )
        for number, (name, found) in enumerate(sorted(by_place.items()), start=1)
    )


def region_table(source: SiteSource) -> Table:
    """Return a table of every region of the board, its position and what was drawn there."""
    numbers = {item.name: item.number for item in places_on_map(source.board.about.tasks, source.spots, source.parts)}
    listed = regions_of(source.board.about.tasks)

    def _part(region: str) -> tuple[str, str]:
        return source.parts.get(region, (region, "-"))

    def _title(region: str) -> str:
        return f"{source.spots[region].title} ({region})" if region in source.spots else region

    def _scenes(region: str) -> str:
        return ", ".join(source.spots[region].scenes) if region in source.spots else "-"

    def _stated(title: str, region: str) -> str:  # of the provenance of its maps
        stated = [task.provenance.titled() for task in listed[region]]
        return "; ".join(sorted({one[title] for one in stated if title in one})) or "-"

    lines = dict.fromkeys(title for task in source.board.about.tasks for title in task.provenance.titled())
    fields: tuple[Field[str], ...] = (
        (word("regions", order="ascending"), _title),
        (column("no."), lambda region: plain_cell(numbers.get(_part(region)[0]))),
        (word("place"), lambda region: _part(region)[0]),
        (word("half or part"), lambda region: _part(region)[1] or "-"),
        (word("scenes"), _scenes),
        (
            word("dates"),
            lambda region: ", ".join(sorted({one.map_date for one in listed[region] if one.map_date})) or "-",
        ),
        (word("suites"), lambda region: ", ".join(sorted({one.suite for one in listed[region]}))),
        *((word(title), partial(_stated, title)) for title in lines),
    )
    return table_of("regions", "Regions of this board", listed, fields)


_FEATURE: Final = json.loads(resources.files("sasgeo_bench.boards").joinpath("coast.geojson").read_text("utf-8"))
# Longitude and latitude of each line, shape (N, 2), degrees.
COASTS: Final = tuple(np.array(line, dtype=float) for line in _FEATURE["geometry"]["coordinates"])


_EUROPE: Final = (-25.0, 45.0, 34.0, 72.0)  # west, east, south, north; degrees
_MARGIN_DEG: Final = 3.0
_LABEL_POINTS: Final = 6.5


def draw_places(path: Path, places: Sequence[PlaceOnMap]) -> None:
    """Draw the places of a board on a map into a .svg or .png; Europe also alone where some lie elsewhere."""
    parts = sorted({item.part for item in places})
    west, east, south, north = _EUROPE
    near = [item for item in places if west <= item.longitude_deg <= east and south <= item.latitude_deg <= north]
    panels = [("all places", list(places))]
    if 1 < len(near) < len(places):
        panels.append(("those in Europe", near))
    about = BoardPage(
        title="Places of this board",
        note="Numbers: as in the table. Hollow: made-up towns, which lie where they lie only so that they have "
        "coordinates. Plain longitude and latitude; coasts: Natural Earth.",
        below="longitude (deg)",
        columns=len(panels),
        panel_inches=(3.6, 2.9) if len(panels) > 1 else (5.4, 3.2),
        keys=line_keys([f"half {part}" if len(part) == 1 else part or "no part" for part in parts]),
    )
    with page(path, about) as charts:
        for chart, (title, some) in zip(charts[0], panels, strict=True):
            chart.set_title(f"{title} (n = {len(some)})")
            _draw_spots(chart, some, parts)
        charts[0][0].set_ylabel("latitude (deg)")


def _draw_spots(chart: Axes, places: Sequence[PlaceOnMap], parts: Sequence[str]) -> None:
    lon, lat = (np.array([getattr(item, name) for item in places]) for name in ("longitude_deg", "latitude_deg"))
    for item in places:
        look = look_of(parts.index(item.part))
        fill = "white" if item.is_made_up else look.colour
        at = (item.longitude_deg, item.latitude_deg)
        chart.plot(*at, marker=look.mark, ms=5, mec=look.colour, mfc=fill, ls="")
        chart.annotate(
            str(item.number), at, xytext=(3.5, 3.0), textcoords="offset points", fontsize=_LABEL_POINTS, color=GREY
        )
    for line in COASTS:
        chart.plot(line[:, 0], line[:, 1], color=GREY, lw=0.5, alpha=0.6, zorder=1)
    for values, limits in ((lon, chart.set_xlim), (lat, chart.set_ylim)):
        limits(float(values.min()) - _MARGIN_DEG, float(values.max()) + _MARGIN_DEG)
    chart.grid(visible=True, color=FAINT, lw=0.6)


# --- measured ageing --------------------------------------------------------------------------------------------------


def rate_table(book: RateBook) -> Table:
    """Return measured yearly rates with their intervals, a row for each class of a place."""
    titles = {item.name: item.title for item in load_taxonomy().classes}
    found = [
        (titles[name], place.name, place.classes[name])
        for name in titles
        for place in book.places
        if name in place.classes
    ]
    fields: tuple[Field[tuple[str, str, ClassAgeing]], ...] = (
        (word("class"), lambda row: row[0]),
        (word("compared at", title="place"), lambda row: row[1]),
        (column("years"), lambda row: _short_cell(row[2].years)),
        (column("things"), lambda row: Cell(text=f"{row[2].n_from} to {row[2].n_to}", key=float(row[2].n_from))),
        (column("vanishes", title="vanishes (%/year)"), lambda row: _rate_cell(row[2].vanish_per_year)),
        (column("world", title="of it the world, at most"), lambda row: _rate_cell(row[2].vanish_most_per_year)),
        (column("appears", title="appears (%/year)"), lambda row: _rate_cell(row[2].appear_per_year)),
        (column("world", title="of it the world, at most"), lambda row: _rate_cell(row[2].appear_most_per_year)),
        (column("re-drawn", title="re-drawn (%)"), lambda row: _short_cell(row[2].redrawn_share, per=100)),
        (column("moved", title="moved (m)"), lambda row: _short_cell(row[2].shift_median_m)),
    )
    note = "Of few things a rate says little. What appears is mostly mapping that catches up, not new building."
    return table_of("rates", "Yearly rates by class and place", found, fields, notes=[note])


def _rate_cell(rate: Estimate | None) -> Cell:
    if rate is None:
        return Cell(text="-")
    ends = [math.nan if end is None else 100 * end for end in (rate.lo, rate.hi)]
    return Cell(text=interval_text(100 * rate.best, *ends), key=rate.best)


def _short_cell(value: float | None, *, per: int = 1) -> Cell:
    return Cell(text="-") if value is None else Cell(text=f"{per * value:.1f}", key=per * value)


_RATES: Final = (0.05, 100.0)  # % a year; what lies beyond is drawn at the edge
_STEP: Final = 0.12  # between two countries of a class


def draw_rates(path: Path, book: RateBook) -> None:
    """Draw into a .svg or .png how fast the world changes at most, by class, with a mark for each country."""
    titles = {item.name: item.title for item in load_taxonomy().classes}
    names = [name for name in titles if any(name in place.classes for place in book.places)]
    about = BoardPage(
        title=f"How fast the world changes at most: {len(book.places)} places in {len(book.countries)} countries",
        note="What is told to be the world's, and what cannot be told; late mapping, redrawing and retagging left out. "
        "Marks: medians of a country's places. Bars: from the lowest to the highest place. Rates beyond the scale lie "
        "at its edge.",
        below="per cent a year",
        columns=2,
        panel_inches=(3.1, 0.3 + 0.35 * len(names)),
        keys=line_keys(book.countries),
    )
    with page(path, about) as charts:
        for chart, (column, title) in zip(
            charts[0],
            (
                ("vanish_most_per_year", "vanishes, of the older map"),
                ("appear_most_per_year", "appears, of the newer map"),
            ),
            strict=True,
        ):
            for at, name in enumerate(names):
                for number, country in enumerate(book.countries):
                    y = at + _STEP * (number - (len(book.countries) - 1) / 2)
                    found = [place.classes.get(name) for place in book.places if place.country == country]
                    _draw_rate(chart, [getattr(item, column, None) for item in found], y=y, look=look_of(number))
            chart.set_title(title)
            chart.set_xscale("log")
            chart.set_xlim(_RATES[0] * 0.8, _RATES[1] * 1.2)
            chart.set_xticks([0.1, 1.0, 10.0, 100.0], ["0.1", "1", "10", "100"])
            chart.set_ylim(len(names) - 0.5, -0.5)
            chart.set_yticks(range(len(names)), [titles[name] for name in names])
            chart.tick_params(axis="y", length=0)
            chart.grid(visible=True, axis="x", color=FAINT, lw=0.6)
        charts[0][1].set_yticklabels([])


def _draw_rate(chart: Axes, rates: Sequence[Estimate | None], *, y: float, look: Look) -> None:
    known = np.clip([100 * rate.best for rate in rates if rate is not None], *_RATES)
    if len(known) == 0:
        return
    chart.hlines(y, known.min(), known.max(), color=look.colour, lw=0.9)
    chart.plot(float(np.median(known)), y, marker=look.mark, ms=3.2, color=look.colour, ls="")


# --- the page with the answers ---

_POSE: Final = ("easting_m", "northing_m", "yaw_deg")
_MOST_M: Final = 1e8  # of any coordinate on Earth
MOST_BYTES: Final = 1_000_000  # of all scripts, nearly
_QUERY_BYTES: Final = 95  # as of the board `modules`
_ANSWER_BYTES: Final = 27
SOUND: Final = "as it should be"  # neither a failure nor a crash
NOT_ASKED: Final = "not applicable"
OUTCOMES: Final = {
    SOUND: "right, or rightly none",
    **{name: MEANINGS[name] for name in FAILURES},
    NOT_ASKED: "not asked: the card of the matcher excludes the query",
}
_NUMBERS: Final = {name: at for at, name in enumerate(OUTCOMES)}


@dataclass(frozen=True, slots=True, kw_only=True)
class PlaceMap:
    """A place with a map and answers: its script in `maps/`, its title, and its queries, of which some are drawn."""

    region: str
    file: str
    title: str
    queries: int
    drawn: int


def place_maps(source: SiteSource) -> dict[PlaceMap, str]:
    """Return the places of a board that have a map and answers, with the text of the script of each.

    Coordinates in a script are metres from the south-western corner of its map. Where all scripts together would be
    larger than `MOST_BYTES`, the same share of each place's queries is drawn: those with a picture, then others by a
    hash of their ids.
    """
    if not len(source.board.answers):
        return {}
    _check(source.board.answers)
    answers = source.board.answers.assign(base=source.board.answers["region"].map(base_of))
    pictures = {plain(case.query_id): at for at, case in enumerate(source.pictures.cases, start=1)}
    share = MOST_BYTES / (_QUERY_BYTES * answers["query_id"].nunique() + _ANSWER_BYTES * len(answers))
    found = {}
    for at, item in enumerate(one for one in source.pictures.regions if one.bounds_m is not None):
        whole = answers[answers["base"] == item.region]
        if not len(whole):
            continue
        part = _sampled(whole, share, pictures)
        spot = source.spots.get(item.region)
        title = item.region if spot is None else spot.title
        place = PlaceMap(
            region=item.region,
            file=f"{MAPS}/{file_stem(item.region)}-{at}.js",
            title=plain(title),
            queries=int(whole["query_id"].nunique()),
            drawn=int(part["query_id"].nunique()),
        )
        found[place] = _script(place, item, part, pictures)
    return found


def _sampled(answers: pd.DataFrame, share: float, first: Collection[str]) -> pd.DataFrame:
    """Return the answers to a share of the queries: the `first`, then others by a hash of their ids; one at least."""
    if share >= 1:
        return answers
    ids = sorted(set(answers["query_id"]), key=lambda name: (name not in first, seed_of_text(name)))
    return answers[answers["query_id"].isin(ids[: max(1, int(share * len(ids)))])]


def _check(answers: pd.DataFrame) -> None:
    """Refuse poses that lie nowhere on Earth or lack a part, and views without a side."""
    poses = [answers[[f"{what}_{name}" for name in _POSE]].to_numpy(float) for what in ("true", "fix")]
    view_m = answers["view_m"].to_numpy(float)
    is_sound = (view_m > 0) & (view_m < _MOST_M)
    for pose in poses:
        is_sound &= np.isnan(pose).all(axis=1) | (np.abs(pose) < _MOST_M).all(axis=1)
    if not is_sound.all():
        row = int(np.argmin(is_sound))
        raise StoreError(f"answers.parquet holds a view or a pose that lies nowhere, in row {row}: score it again")


def _script(place: PlaceMap, item: RegionMap, answers: pd.DataFrame, cases: Mapping[str, int]) -> str:
    west_m, south_m, east_m, north_m = item.bounds_m or (0.0,) * 4
    queries = answers.drop_duplicates("query_id").sort_values("query_id", ignore_index=True)
    number = {query_id: at for at, query_id in enumerate(queries["query_id"])}
    content = {
        "picture": f"pictures/{item.file}",
        "size_m": [east_m - west_m, north_m - south_m],
        "corner_m": [west_m, south_m],
        "blocks": [
            [plain(name), left - west_m, low - south_m, right - west_m, high - south_m]
            for name, (left, low, right, high) in {block.name: block.bounds_m for block in item.blocks}.items()
        ],
        "queries": list(_queries(queries, west_m, south_m)),
        "cases": {str(number[name]): at for name, at in cases.items() if name in number},
        "answers": [  # pairs: no name of a matcher means anything to the language of the script
            [
                plain(str(name)),
                [
                    [number[row["query_id"]], _outcome(row), *_point(row, "fix", west_m, south_m)]
                    for row in records_of(part)
                ],
            ]
            for name, part in answers.groupby("matcher", sort=True)
        ],
    }
    text = json.dumps(content, separators=(",", ":"), allow_nan=False)  # ASCII alone
    return f"showPlace({json.dumps(place.file)}, {text});\n"


def _queries(rows: pd.DataFrame, west_m: float, south_m: float) -> Iterator[list[object]]:
    """Yield id, suite, map, what was done to it, whether its place is on the map, side of its view, and true pose."""
    for row in records_of(rows):
        words = [plain(str(row[name])) for name in ("query_id", "suite", "region", "kind")]
        yield [*words, int(row["is_present"]), round(float(row["view_m"]), 1), *_point(row, "true", west_m, south_m)]


def _outcome(row: Record) -> int:
    """Return the number of an outcome in `OUTCOMES`, -1 for a class that this version does not know."""
    is_asked = row["status"] != NOT_ASKED
    return _NUMBERS.get(row["failure"] or SOUND, -1) if is_asked else _NUMBERS[NOT_ASKED]


def _point(row: Record, what: str, west_m: float, south_m: float) -> list[float | None]:
    """Return easting, northing and yaw in metres and degrees from the corner; nothing where there is no pose."""
    easting_m, northing_m, yaw_deg = (float(row[f"{what}_{name}"]) for name in _POSE)
    if math.isnan(easting_m):
        return []
    return [round(easting_m - west_m, 1), round(northing_m - south_m, 1), round(yaw_deg, 1)]
