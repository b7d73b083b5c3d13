# SPDX-License-Identifier: Apache-2.0
"""Content of the other pages of a site: suites, matchers, rejection, costs, places and measured ageing."""

import json
import math
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from importlib import resources
from pathlib import Path
from typing import Any, Final

import numpy as np
import pandas as pd
from matplotlib.axes import Axes

from sasgeo_bench.ageing.ratebook import ClassAgeing, Estimate, RateBook
from sasgeo_bench.canvas import GREY, page
from sasgeo_bench.errors import StoreError, counted
from sasgeo_bench.leaderboard.board_tables import SHOWN_COSTS, Book, rejection_of, strata_tables, suite_table
from sasgeo_bench.leaderboard.cases import FAILURES, MEANINGS
from sasgeo_bench.leaderboard.manifests import BoardEntry, BoardTask, Picture, RegionMap
from sasgeo_bench.leaderboard.plots import FAINT, BoardPage, line_keys, look_of
from sasgeo_bench.leaderboard.tables import (
    Cell,
    Key,
    Row,
    Table,
    column,
    figure_cell,
    file_stem,
    interval_text,
    number_cell,
    plain_cell,
    prior_words,
    rank_cell,
    suite_card,
)
from sasgeo_bench.matching.cards import Learned
from sasgeo_bench.osm.taxonomy import load_taxonomy
from sasgeo_bench.publishing.site_source import SiteFigure, SiteSource, Spot
from sasgeo_bench.running.prediction_files import CardRecord
from sasgeo_bench.scoring.intervals import seed_of_text
from sasgeo_bench.scoring.metrics import primary_of
from sasgeo_bench.scoring.rows import ALL_SUITES
from sasgeo_bench.scoring.score import FIX_M
from sasgeo_bench.tasks.query import base_of
from sasgeo_bench.tasks.suites.base import SuiteCard
from sasgeo_bench.texts import plain

MAPS: Final = "maps"
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
    content: dict[str, Any] = {
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
                    for row in part.to_dict("records")
                ],
            ]
            for name, part in answers.groupby("matcher", sort=True)
        ],
    }
    text = json.dumps(content, separators=(",", ":"), allow_nan=False)  # ASCII alone
    return f"showPlace({json.dumps(place.file)}, {text});\n"


def _queries(rows: pd.DataFrame, west_m: float, south_m: float) -> Iterator[list[Any]]:
    """Yield id, suite, map, what was done to it, whether its place is on the map, side of its view, and true pose."""
    for row in rows.to_dict("records"):
        words = [plain(str(row[name])) for name in ("query_id", "suite", "region", "kind")]
        yield [*words, int(row["is_present"]), round(float(row["view_m"]), 1), *_point(row, "true", west_m, south_m)]


def _outcome(row: Mapping[Any, Any]) -> int:
    """Return the number of an outcome in `OUTCOMES`, -1 for a class that this version does not know."""
    is_asked = row["status"] != NOT_ASKED
    return _NUMBERS.get(row["failure"] or SOUND, -1) if is_asked else _NUMBERS[NOT_ASKED]


def _point(row: Mapping[Any, Any], what: str, west_m: float, south_m: float) -> list[float | None]:
    """Return easting, northing and yaw in metres and degrees from the corner; nothing where there is no pose."""
    easting_m, northing_m, yaw_deg = (float(row[f"{what}_{name}"]) for name in _POSE)
    if math.isnan(easting_m):
        return []
    return [round(easting_m - west_m, 1), round(northing_m - south_m, 1), round(yaw_deg, 1)]


_AREAS: Final = ("available", "misleading", "hazardous", "exceeded")
KINDS: Final = {  # of figures, by how their names begin, in the order they are shown
    "contrast": "Registered contrasts, place by place",
    "stress": "Success under stress",
    "age": "Success against the age of the map",
    "strength": "Success against strength",
    "distance": "Error along the way",
    "interval": "How far the odometer carries a fix",
    "risk": "Risk against coverage",
    "reliability": "Reliability",
    "stanford": "Protection levels against errors",
}


def figures_by_kind(figures: Sequence[SiteFigure]) -> dict[str, list[SiteFigure]]:
    """Return figures under the titles of their kinds."""
    found: dict[str, list[SiteFigure]] = {title: [] for title in (*KINDS.values(), "Other figures")}
    for item in figures:
        found[KINDS.get(item.file.partition("-")[0], "Other figures")].append(item)
    return {title: items for title, items in found.items() if items}


def _groups(book: Book) -> dict[tuple[str, str], list[Key]]:
    """Return keys of the board by track and prior group."""
    found: dict[tuple[str, str], list[Key]] = {}
    for key in book.matchers:
        found.setdefault(key[1:], []).append(key)
    return dict(sorted(found.items()))


# --- suites -----------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, kw_only=True)
class SuitePage:
    """A suite: its card where this version knows it, results, figures and example pictures."""

    name: str
    page: str
    card: SuiteCard | None
    tables: tuple[Table, ...]
    figures: tuple[SiteFigure, ...]
    pictures: tuple[Picture, ...]
    regions: tuple[str, ...]


def suites_of(source: SiteSource, book: Book) -> tuple[SuitePage, ...]:
    """Return a page for each suite on the board."""
    return tuple(_suite(name, page, source, book) for name, page in book.suite_pages.items())


def _suite(name: str, page: str, source: SiteSource, book: Book) -> SuitePage:
    keys = [key for key in book.matchers if key[0] == name]
    starts = tuple(f"{file_stem(kind, name, track)}-" for kind in KINDS for _, track, _ in keys)
    regions = sorted({base_of(task.region) for task in source.board.about.tasks if task.suite == name})
    return SuitePage(
        name=name,
        page=page,
        card=suite_card(name),
        tables=tuple(
            table for key in keys for table in (suite_table(book, key, book.matchers[key]), *strata_tables(book, key))
        ),
        figures=tuple(item for item in source.figures if item.file.startswith(starts)),
        pictures=tuple(
            item
            for item in (*source.pictures.suites, *source.pictures.strips, *source.pictures.flights)
            if item.suite == name
        ),
        regions=tuple(regions),
    )


# --- matchers ---------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, kw_only=True)
class MatcherPage:
    """A contestant: its card, results, limits and costs."""

    name: str
    page: str
    entry: BoardEntry
    cell: Cell
    card: CardRecord | None
    trained: str
    training: tuple[str, ...]
    cannot: tuple[str, ...]
    results: tuple[Table, ...]
    rejection: Table | None
    costs: tuple[tuple[str, str, str], ...]


def matchers_of(source: SiteSource, book: Book) -> tuple[MatcherPage, ...]:
    """Return a page for each entry of the board."""
    return tuple(_matcher(name, book, source.board.leaderboard) for name in book.matcher_pages)


def _matcher(name: str, book: Book, board: pd.DataFrame) -> MatcherPage:
    entry = book.entries.get(name) or BoardEntry(name=name)
    card = entry.card or CardRecord()
    results = [_results_table(book, name, group, keys) for group, keys in _groups(book).items()]
    return MatcherPage(
        name=name,
        page=book.matcher_pages[name],
        entry=entry,
        cell=book.name_cell(name),
        card=entry.card,
        trained=_trained(card.trained_on, entry.learned),
        training=tuple(_training(entry)),
        cannot=tuple(_cannot(book, name, card)),
        results=tuple(table for table in results if table.rows),
        rejection=rejection_of(board, name),
        costs=tuple(_costs_of(book, name)),
    )


_NO_PLACE: Final = "no place that its card names"


def _trained(stated: object, learned: Sequence[Learned]) -> str:
    """Return where an entry was trained: by its author on the places that its card names, and by the runner."""
    named = _stated(stated)
    if not learned:
        return named
    runner = f"by the runner, in {counted(len(learned), 'training')} listed below"
    return runner if named == _NO_PLACE else f"{named}; {runner}"


def _stated(places: object) -> str:
    """Return the training places that a card names: "none", some, or some for each half."""
    if isinstance(places, Mapping):
        return "; ".join(f"half {half}: {_stated(some)}" for half, some in places.items())
    named = [] if isinstance(places, str) or not isinstance(places, Sequence) else list(map(str, places))
    return ", ".join(named) or _NO_PLACE


def _training(entry: BoardEntry) -> Iterator[str]:
    """Yield the training of an entry by the runner, and the regions it was then tested on: tasks are hundreds."""
    for one in entry.learned:
        verb = "Trained on" if one.file else "Could not be trained on"
        regions = sorted({base_of(task.partition("/")[2]) for task in one.asked})
        yield (
            f"{verb} {counted(one.pairs, 'query', 'queries')} of {', '.join(one.trained_on)}; then tested in "
            f"{counted(len(one.asked), 'task')} on {', '.join(regions)}."
        )


def _cannot(book: Book, name: str, card: CardRecord) -> Iterator[str]:
    """Yield the limits that an entry states, and those that the board shows."""
    if card.limits:
        yield card.limits
    if card.needs:
        yield f"Needs {', '.join(card.needs)}; where a query lacks that it is not applicable"
    tracks = card.tracks
    yield from (f"Does not answer {track}" for track in ("localization", "retrieval") if tracks and track not in tracks)
    rows = [(key, book.main(key, name, primary_of(key[1]).name)) for key in book.matchers if name in book.matchers[key]]
    out = [f"{key[0]} ({key[1]})" for key, row in rows if row is not None and not row["is_applicable"]]
    if out:
        yield f"Not applicable to {', '.join(out)}"
    unasked = [suite for suite in book.suite_pages if not any(key[0] == suite for key, _ in rows)]
    if unasked:
        yield f"Not asked on {', '.join(unasked)}"


def _results_table(book: Book, name: str, group: tuple[str, str], keys: Sequence[Key]) -> Table:
    track, prior_group = group
    primary = primary_of(track).name
    rows = []
    for key in keys:
        main = book.main(key, name, primary) if name in book.matchers[key] else None
        if main is None:
            continue
        ranked = sum(
            row is not None and not pd.isna(row["rank_best"])
            for row in (book.main(key, other, primary) for other in book.matchers[key])
        )
        rows.append(
            Row(
                cells=(
                    book.suite_cell(key[0]),
                    figure_cell(main, has_bar=True),
                    rank_cell(main, ranked=ranked),
                    figure_cell(book.pick(key, name, primary, "control")),
                    figure_cell(book.pick(key, name, "answered_absent")),
                    plain_cell(int(main["n"])),
                    plain_cell(int(main["missing"])),
                    plain_cell(int(main["blocks"])),
                )
            )
        )
    titles = (primary, "rank", "control", "false fixes", "n", "missing", "blocks")
    return Table(
        name=file_stem("results", track, prior_group),
        title=f"{track}, {prior_words(prior_group)}",
        columns=(column("suite", is_number=False), *map(column, titles)),
        rows=tuple(rows),
    ).without_empty("control", "false fixes")


def _costs_of(book: Book, name: str) -> Iterator[tuple[str, str, str]]:
    """Yield the costs of answers: metric, value with unit, meaning."""
    for key, row in book.figures.items():
        suite, track, _, matcher, _, metric = key
        if suite == ALL_SUITES and matcher == name and metric in SHOWN_COSTS:
            cell = number_cell(float(row["value"]), str(row["unit"]))
            yield (metric if track == "all" else f"{metric}, {track}", cell.text, column(metric).meaning)


# --- protection ------------------------------------------------------------------------------------------------------


def protection_tables(protection: pd.DataFrame) -> tuple[Table, ...]:
    """Return the results of protection levels at one alert limit, a table for each prior group."""
    if not len(protection):
        return ()
    limits = sorted(set(protection["alert_limit_m"]))
    shown_m = FIX_M if FIX_M in limits else limits[0]
    others = " and ".join(f"{limit:g}" for limit in limits if limit != shown_m)
    notes = (f"Alert limits of {others} m: protection.parquet holds them.",) if others else ()
    found = []
    for key, part in protection[protection["alert_limit_m"] == shown_m].groupby("prior_group", sort=True):
        prior_group = str(key)
        rows = []
        order = ["risk", "available", "matcher", "method"]
        for row in part.sort_values(order, ascending=[True, False, True, True]).to_dict("records"):
            shares = [_share_cell(row, area) for area in _AREAS]
            names = (Cell(text=str(row["matcher"])), Cell(text=str(row["method"])))
            rest = (plain_cell(int(row["n"])), Cell(text=str(row["supports"])))
            rows.append(Row(cells=(*names, number_cell(float(row["risk"])), *shares, *rest)))
        words = (column("matcher", is_number=False), column("method", is_number=False))
        figures = (column("risk", order="ascending"), *map(column, (*_AREAS, "n")))
        columns = (*words, *figures, column("supports", is_number=False))
        title = f"Alert limit {shown_m:g} m, {prior_words(prior_group)}"
        name = file_stem("protection", prior_group)
        found.append(Table(name=name, title=title, columns=columns, rows=tuple(rows), notes=notes))
    return tuple(found)


def _share_cell(row: Mapping[Any, Any], area: str) -> Cell:
    value, lo, hi = (float(row[f"{area}{end}"]) for end in ("", "_lo", "_hi"))
    return figure_cell({"value": value, "lo": lo, "hi": hi, "unit": "1", "interval": "", "is_applicable": True})


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
    rows = []
    lines = dict.fromkeys(title for task in source.board.about.tasks for title in task.provenance.titled())
    for region, tasks in regions_of(source.board.about.tasks).items():
        place, part = source.parts.get(region, (region, "-"))
        spot = source.spots.get(region)
        dates = sorted({task.map_date for task in tasks if task.map_date})
        suites = sorted({task.suite for task in tasks})
        stated = [task.provenance.titled() for task in tasks]
        rows.append(
            Row(
                cells=(
                    Cell(text=region if spot is None else f"{spot.title} ({region})"),
                    plain_cell(numbers.get(place)),
                    Cell(text=place),
                    Cell(text=part or "-"),
                    Cell(text="-" if spot is None else ", ".join(spot.scenes)),
                    Cell(text=", ".join(dates) or "-"),
                    Cell(text=", ".join(suites)),
                    *(
                        Cell(text="; ".join(sorted({one[title] for one in stated if title in one})) or "-")
                        for title in lines
                    ),
                )
            )
        )
    columns = [
        column(name, is_number=name == "no.", order="ascending" if name == "regions" else "none")
        for name in ("regions", "no.", "place", "half or part", "scenes", "dates", "suites", *lines)
    ]
    return Table(name="regions", title="Regions of this board", columns=tuple(columns), rows=tuple(rows))


# --- measured ageing --------------------------------------------------------------------------------------------------


def rate_table(book: RateBook) -> Table:
    """Return measured yearly rates with their intervals, a row for each class of a place."""
    titles = {item.name: item.title for item in load_taxonomy().classes}
    rows = [
        Row(
            cells=(
                Cell(text=titles.get(name, name)),
                Cell(text=place.name),
                _short_cell(found.years),
                Cell(text=f"{found.n_from} to {found.n_to}", key=float(found.n_from)),
                _rate_cell(found.vanish_per_year),
                _rate_cell(found.appear_per_year),
                *_drawn_cells(found),
            )
        )
        for name in titles
        for place in book.places
        if (found := place.classes.get(name)) is not None
    ]
    names = ("things", "vanishes", "appears", "re-drawn", "moved")
    units = {"vanishes": "%/year", "appears": "%/year", "re-drawn": "%", "moved": "m"}
    return Table(
        name="rates",
        title="Yearly rates by class and place",
        columns=(
            column("class", is_number=False),
            column("compared at", is_number=False, title="place"),
            column("years"),
            *(column(name, title=f"{name} ({units[name]})" if name in units else name) for name in names),
        ),
        rows=tuple(rows),
        notes=("Of few things a rate says little. What appears is mostly mapping that catches up, not new building.",),
    )


def _rate_cell(rate: Estimate | None) -> Cell:
    if rate is None:
        return Cell(text="-")
    ends = [math.nan if end is None else 100 * end for end in (rate.lo, rate.hi)]
    return Cell(text=interval_text(100 * rate.best, *ends), key=rate.best)


def _drawn_cells(found: ClassAgeing) -> tuple[Cell, Cell]:
    share, shift_m = found.redrawn_share, found.shift_median_m
    return (_short_cell(None if share is None else 100 * share), _short_cell(shift_m))


def _short_cell(value: float | None) -> Cell:
    return Cell(text="-") if value is None else Cell(text=f"{value:.1f}", key=value)


_FEATURE: Final = json.loads(resources.files("sasgeo_bench.publishing").joinpath("coast.geojson").read_text("utf-8"))
# Longitude and latitude of each line, shape (N, 2), degrees.
COASTS: Final = tuple(np.array(line, dtype=float) for line in _FEATURE["geometry"]["coordinates"])


_EUROPE: Final = (-25.0, 45.0, 34.0, 72.0)  # west, east, south, north; degrees
_MARGIN_DEG: Final = 3.0
_RATES: Final = (0.05, 100.0)  # % a year; what lies beyond is drawn at the edge
_STEP: Final = 0.13  # between two places of a class
_LABEL_POINTS: Final = 6.5


def draw_places(path: Path, places: Sequence[PlaceOnMap]) -> None:
    """Draw the places of a board on a map into a .svg or .png; Europe also alone where some lie elsewhere."""
    parts = sorted({item.part for item in places})
    near = [item for item in places if _is_near(item)]
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
        keys=line_keys([_part_name(part) for part in parts]),
    )
    with page(path, about) as charts:
        for chart, (title, some) in zip(charts[0], panels, strict=True):
            chart.set_title(f"{title} (n = {len(some)})")
            _draw_spots(chart, some, parts)
        charts[0][0].set_ylabel("latitude (deg)")


def _is_near(place: PlaceOnMap) -> bool:
    west, east, south, north = _EUROPE
    return west <= place.longitude_deg <= east and south <= place.latitude_deg <= north


def _part_name(part: str) -> str:
    if not part:
        return "no part"
    return f"half {part}" if len(part) == 1 else part


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


def draw_rates(path: Path, book: RateBook) -> None:
    """Draw into a .svg or .png what vanishes and what appears in a year, by class, a mark for each measured place."""
    titles = {item.name: item.title for item in load_taxonomy().classes}
    names = [name for name in titles if any(name in place.classes for place in book.places)]
    about = BoardPage(
        title=f"How fast maps grow old: {len(book.places)} places",
        note="Bars: 95 % intervals, from blocks of 1 km. Rates beyond the scale lie at its edge. What appears is "
        "mostly mapping that catches up. How many things each rate is of stands in the table.",
        below="per cent a year",
        columns=2,
        panel_inches=(3.1, 0.3 + 0.29 * len(names)),
        keys=line_keys(book.names),
    )
    with page(path, about) as charts:
        for chart, (column, title) in zip(
            charts[0],
            (("vanish_per_year", "vanishes, of the older map"), ("appear_per_year", "appears, of the newer map")),
            strict=True,
        ):
            for at, name in enumerate(names):
                for number, place in enumerate(book.places):
                    found = place.classes.get(name)
                    rate = None if found is None else getattr(found, column)
                    if rate is not None:
                        _draw_rate(chart, rate, at + _STEP * (number - (len(book.places) - 1) / 2), number)
            chart.set_title(title)
            chart.set_xscale("log")
            chart.set_xlim(_RATES[0] * 0.8, _RATES[1] * 1.2)
            chart.set_xticks([0.1, 1.0, 10.0, 100.0], ["0.1", "1", "10", "100"])
            chart.set_ylim(len(names) - 0.5, -0.5)
            chart.set_yticks(range(len(names)), [titles[name] for name in names])
            chart.tick_params(axis="y", length=0)
            chart.grid(visible=True, axis="x", color=FAINT, lw=0.6)
        charts[0][1].set_yticklabels([])


def _draw_rate(chart: Axes, rate: Estimate, at: float, number: int) -> None:
    look = look_of(number)
    if rate.lo is not None and rate.hi is not None:
        chart.hlines(at, _within(rate.lo), _within(rate.hi), color=look.colour, lw=0.9)
    chart.plot(_within(rate.best), at, marker=look.mark, ms=3.2, color=look.colour, ls="")


def _within(per_year: float) -> float:
    """Return a rate in per cent, clipped to the axis."""
    return float(np.clip(100 * per_year, *_RATES))
