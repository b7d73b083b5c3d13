# SPDX-License-Identifier: Apache-2.0
"""Region files for the extracts of a manifest: one to three windows for each place, where it is built."""

import datetime as dt
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Annotated, Final

import numpy as np
import shapely
from numpy.typing import NDArray
from pydantic import BeforeValidator, ConfigDict, Field

from sasgeo_bench.core.config import LONGEST_LINE, Document, Line, check_document, parse_toml
from sasgeo_bench.core.errors import ConfigError, CoverageError, SasgeoError, named
from sasgeo_bench.core.folders import sha256_of
from sasgeo_bench.core.paths import plain_file
from sasgeo_bench.core.progress import reported, spread, tell
from sasgeo_bench.geometry.grid import Grid, utm_epsg
from sasgeo_bench.geometry.projection import from_lonlat, to_lonlat
from sasgeo_bench.osm.locate import Extract, PlainName, Sha256, extract_folders, find_extract
from sasgeo_bench.osm.read import read_extract
from sasgeo_bench.osm.scan import scan_file
from sasgeo_bench.osm.snapshot import open_snapshot
from sasgeo_bench.osm.taxonomy import load_taxonomy
from sasgeo_bench.regions.region_spec import Identifier, RegionFile, region_text
from sasgeo_bench.regions.scenes import measure_ground

STEP_M: Final = 128.0  # of the lattice on which windows lie
SHORTEST_M: Final = 1536.0  # side of one of several windows of a place
LEAST_M: Final = 768.0  # side of the only one
LONGEST_M: Final = 4096.0
MOST_KM2: Final = 16.0
MOST_WINDOWS: Final = 3  # of a place
LEAST_BUILT_KM2: Final = 2.0  # in a second or third window
_WORTH: Final = 0.15  # a window grows where this share of what it gains is built
_REACH_M: Final = 60_000.0  # from the middle of the buildings: what lies farther away is a stray object
_WORLD: Final = (-180.0, -90.0, 180.0, 90.0)
_ADDRESS: Final = re.compile(r"https?://\S+")
_COMMIT: Final = re.compile(r"\b([0-9a-f]{12})[0-9a-f]{28}\b")

Cells = NDArray[np.int64]


def _as_day(given: object) -> object:
    """Refuse a text that is no day; whatever else is wrong the model tells."""
    if isinstance(given, str):
        try:
            dt.date.fromisoformat(given)
        except ValueError as error:
            raise ValueError(f"'date' is a day, YYYY-MM-DD, got {given!r}") from error
    return given


def _as_name(given: object) -> object:
    """Refuse a text that cannot be the id of a region."""
    if isinstance(given, str) and not re.fullmatch(r"[a-z0-9]+(-[a-z0-9]+)*", given):
        raise ValueError(f"'place' has small letters, digits and hyphens between them, got {given!r}")
    return given


class ListedExtract(Document):
    """One `[[extract]]` of a manifest; keys that are not read here are its owner's.

    `title` names the place in the titles of its regions; without it they take the id.

    Without `sha256` the file is taken as it lies there. `source` says where it comes from: an address is one to
    download it from where `source_sha256` is the hash of what lies there; any other text is stated and no more.
    """

    model_config = ConfigDict(extra="ignore", strict=False)

    file: PlainName
    place: Annotated[Identifier, BeforeValidator(_as_name)]
    country: Line
    what: Line
    date: Annotated[dt.date, BeforeValidator(_as_day)]
    title: Line | None = None
    date_known_by: Line | None = None
    sha256: Sha256 | None = None
    source: Line | None = None
    source_sha256: Sha256 | None = None


class ExtractManifest(Document):
    """A list of dated extracts of places, as it was written."""

    model_config = ConfigDict(extra="ignore")

    extract: Annotated[list[dict[str, object]], Field(min_length=1)]


def read_places(path: Path) -> dict[str, list[ListedExtract]]:
    """Read the extracts of each place of a manifest, by date.

    Raise `ConfigError`, which names the block, if the file is no manifest, two extracts of a place are of one day, in
    one file or of two countries, or a place has the name of another one's second region.
    """
    try:
        text = plain_file(path).read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigError(f"{path} cannot be read: name a manifest of extracts (*.toml)") from error
    blocks = parse_toml(text, ExtractManifest, source=str(path)).extract
    listed = [
        check_document(block, ListedExtract, source=f"{path}: extract {number} ({block.get('file', 'without a file')})")
        for number, block in enumerate(blocks, start=1)
    ]
    found: dict[str, list[ListedExtract]] = {}
    for item in sorted(listed, key=lambda one: one.date):
        found.setdefault(item.place, []).append(item)
    for place, items in found.items():
        dates, countries = [item.date for item in items], {item.country for item in items}
        if len(set(dates)) < len(dates):
            raise ConfigError(f"{place}: two extracts are of one day: keep one of them")
        files = [item.file for item in items if ".osh" not in item.file]
        twice = next((file for file in files if files.count(file) > 1), None)
        if twice is not None:
            raise ConfigError(
                f"{place}: {twice} is of two days: name one, for only a full history (*.osh.pbf) has several"
            )
        if len(countries) > 1:
            raise ConfigError(f"{place} lies in {' and in '.join(sorted(countries))}: give each its own name")
        other = next((name for name in names_of(place)[1:] if name in found), None)
        if other is not None:
            raise ConfigError(f"{other} may be the name of a second region of {place}: rename one of the places")
    return found


def names_of(place: str) -> list[str]:
    """Return the names that the regions of a place may have.

    >>> names_of("nis")
    ['nis', 'nis-2', 'nis-3']
    """
    return [place, *(f"{place}-{number}" for number in range(2, MOST_WINDOWS + 1))]


@dataclass(frozen=True, slots=True, kw_only=True)
class Window:
    """A rectangle on the lattice of a UTM zone, from its south-western corner; `built` steps have a house."""

    epsg: int
    col: int
    row: int
    cols: int
    rows: int
    built: int

    @property
    def size_m(self) -> tuple[float, float]:
        """Return width and height, metres."""
        return (self.cols * STEP_M, self.rows * STEP_M)

    @property
    def center_lonlat(self) -> tuple[float, float]:
        """Return longitude and latitude of the middle, degrees to 1 m."""
        width_m, height_m = self.size_m
        lon, lat = to_lonlat(self.epsg).transform(self.col * STEP_M + width_m / 2, self.row * STEP_M + height_m / 2)
        return (round(lon, 5), round(lat, 5))

    @property
    def built_km2(self) -> float:
        """Return the ground of the steps with a house, km2."""
        return self.built * STEP_M**2 / 1e6


def find_windows(houses_lonlat: NDArray[np.float64], *, most: int = MOST_WINDOWS) -> list[Window]:
    """Return the windows of a place in which most is built, the best first; none without a house.

    Parameters
    ----------
    houses_lonlat : ndarray of float, shape (N, 2)
        A point of each building, degrees.
    most : int
        How many windows there are at most; the second and all others have `LEAST_BUILT_KM2` of their own.

    Notes
    -----
    A step of the lattice is built if a building lies in it. If all of them fit into one window, it is that, with a step
    around; else each window is the one with the largest count of built steps less 15 % of all its steps, so that it
    grows into what is built. Windows do not overlap. Houses farther than 60 km from their median are left out.

    Examples
    --------
    >>> east, north = np.meshgrid(np.arange(9.50, 9.53, 0.001), np.arange(47.10, 47.12, 0.001))
    >>> (town,) = find_windows(np.column_stack([east.ravel(), north.ravel()]))
    >>> town.size_m, town.built_km2 > 3
    ((2560.0, 2432.0), True)
    """
    if not len(houses_lonlat):
        return []
    middle = np.median(houses_lonlat, axis=0)
    epsg = utm_epsg(*map(float, middle))
    to_grid = from_lonlat(epsg)
    points_m = np.column_stack(to_grid.transform(houses_lonlat[:, 0], houses_lonlat[:, 1]))
    near = np.abs(points_m - np.array(to_grid.transform(*middle))).max(axis=1) < _REACH_M
    steps = np.unique(np.floor(points_m[near] / STEP_M).astype(np.int64), axis=0)
    low, high = int(SHORTEST_M / STEP_M), int(LONGEST_M / STEP_M)
    first, extent = steps.min(axis=0), np.ptp(steps, axis=0) + 1
    if extent.max() <= high and extent.prod() * STEP_M**2 <= MOST_KM2 * 1e6:
        sides = np.clip(extent + 2, int(LEAST_M / STEP_M), high)
        col, row = (first - (sides - extent) // 2).tolist()
        return [Window(epsg=epsg, col=col, row=row, cols=int(sides[0]), rows=int(sides[1]), built=len(steps))]
    corner = first - high
    built = np.zeros(tuple((extent + 2 * high)[::-1]), dtype=bool)
    built[steps[:, 1] - corner[1], steps[:, 0] - corner[0]] = True
    found: list[Window] = []
    is_taken = np.zeros_like(built)
    while len(found) < most:
        row, col, rows, cols = _best(np.where(is_taken, -float(built.size), built - _WORTH), low, high)
        chosen = (slice(row, row + rows), slice(col, col + cols))
        window = Window(
            epsg=epsg,
            col=col + int(corner[0]),
            row=row + int(corner[1]),
            cols=cols,
            rows=rows,
            built=int(built[chosen].sum()),
        )
        if found and window.built_km2 < LEAST_BUILT_KM2:
            break
        found.append(window)
        is_taken[chosen], built[chosen] = True, False
    return found


def _best(gain: NDArray[np.float64], low: int, high: int) -> tuple[int, int, int, int]:
    """Return row, column, rows and columns of the window with the largest sum."""
    sums = np.zeros((gain.shape[0] + 1, gain.shape[1] + 1))
    sums[1:, 1:] = gain.cumsum(axis=0).cumsum(axis=1)
    best, found = -np.inf, (0, 0, low, low)
    for rows in range(low, high + 1):
        strips = sums[rows:] - sums[:-rows]
        for cols in range(low, min(high, int(MOST_KM2 * 1e6 / STEP_M**2) // rows) + 1):
            totals = strips[:, cols:] - strips[:, :-cols]
            at = int(totals.argmax())
            if totals.flat[at] > best:
                row, col = divmod(at, totals.shape[1])
                best, found = float(totals.flat[at]), (row, col, rows, cols)
    return found


def propose_regions(
    manifest: Path,
    *,
    folders: Sequence[Path] = (),
    known: Iterable[RegionFile] = (),
    written: Mapping[str, RegionFile] | None = None,
    jobs: int = 1,
) -> Iterator[tuple[str, str]]:
    """Yield id and text of a region file for each window of each place of a manifest.

    Files are looked for as `build_region` does, in `folders` and beside the manifest first. A place is left out if a
    region of `known` has its name or one of its extracts, or if its newest extract cannot be read, or has no building:
    a line says which. A place of whose extracts the regions of `written`, by id, were made is not read again. An older
    map that lies on other ground is left out of a region, with a line. Raise `ConfigError` if the manifest is wrong,
    and once all others are done if a place is left out for a fault.
    """
    places = read_places(manifest)
    taken = {name: spec.id for spec in known for name in (spec.id, *(extract.file for extract in spec.extract))}
    jobs_of = []
    for place, listed in places.items():
        found = next((name for name in (*names_of(place), *(item.file for item in listed)) if name in taken), None)
        if found is None:
            jobs_of.append(
                _Place(name=place, listed=tuple(listed), folders=(*folders, manifest.parent), written=written or {})
            )
        else:
            holds = "" if found == taken[found] else f" holds {found}"
            tell(f"{place}: has regions already: region {taken[found]}{holds}")
    left = []
    for one, texts in zip(jobs_of, spread(reported(_proposed), jobs_of, jobs=jobs, label="places read"), strict=True):
        yield from texts
        left += [] if texts else [one.name]
    if left:
        raise ConfigError(f"no region of {named(left, 'place')} of {len(places)}; the lines above say why")


@dataclass(frozen=True, slots=True, kw_only=True)
class _Place:
    name: str
    listed: tuple[ListedExtract, ...]
    folders: tuple[Path, ...]
    written: Mapping[str, RegionFile]


def _proposed(place: _Place) -> list[tuple[str, str]]:
    """Return id and text of each region of a place; none, and a line, if that cannot be."""
    try:
        extracts = [_extract(item, place.folders) for item in place.listed]
        there = _there(place, extracts)
        if there:
            return there
        path = find_extract(extracts[-1], folders=place.folders)
        windows = find_windows(_houses(path, place.listed[-1].date))
        found = []
        for name, window in zip(names_of(place.name), windows, strict=False):
            write = partial(_text, name, centre=window.center_lonlat, size_m=window.size_m)
            text = write(place.listed, extracts, scenes=["sparse"])  # of any scene, to read the ground
            grid = parse_toml(text, RegionFile, source=f"its region {name}").grid()
            scenes = measure_ground(path, grid, at=place.listed[-1].date).scenes()
            dates = [number for number in range(len(extracts)) if _holds(place, extracts[number], grid, name)]
            found.append(
                (name, write([place.listed[at] for at in dates], [extracts[at] for at in dates], scenes=scenes))
            )
    except SasgeoError as error:
        tell(f"{place.name}: left out: {error}")
        return []
    if not found:
        tell(f"{place.name}: left out: {path.name} has no building")
    return found


def _there(place: _Place, extracts: Sequence[Extract]) -> list[tuple[str, str]]:
    """Return the regions of a place that were made of the same extracts before, with what the manifest says now."""
    found = []
    for name in names_of(place.name):
        spec = place.written.get(name)
        if spec is None or spec.center_lonlat is None or spec.size_m is None:
            continue
        hashes = {item.file: set(item.sha256) for item in spec.extract}
        kept = [at for at, item in enumerate(extracts) if not hashes.get(item.file, set()).isdisjoint(item.sha256)]
        if len(kept) < len(hashes) or kept[-1:] != [len(extracts) - 1]:
            return []  # a file is new, or another: the windows may lie elsewhere
        listed = [place.listed[at] for at in kept]
        text = _text(
            name,
            listed,
            [extracts[at] for at in kept],
            centre=spec.center_lonlat,
            size_m=spec.size_m,
            scenes=spec.scenes,
        )
        found.append((name, text))
    return found


def _holds(place: _Place, extract: Extract, grid: Grid, name: str) -> bool:
    """Return whether an older map that is on this machine holds the ground of a region; a line says if it does not."""
    files = (folder / extract.file for folder in extract_folders(place.folders))
    if extract.date == place.listed[-1].date or not any(path.is_file() for path in files):
        return True
    try:
        read_extract(find_extract(extract, folders=place.folders), grid, at=extract.date)
    except CoverageError as error:
        tell(f"{name}: without its map of {extract.date}: {error}")
        return False
    return True


def _extract(item: ListedExtract, folders: Sequence[Path]) -> Extract:
    """Return the extract of a region file; the file itself gives a hash that is missing."""
    places = (folder / item.file for folder in extract_folders(folders))
    path = next((path for path in places if path.is_file()), None)
    if item.sha256 is None and path is None:
        raise ConfigError(f"{item.file} has no sha256, and is in none of the folders: add one, or put the file there")
    first = item.sha256 or sha256_of(path or Path(item.file))
    if item.source is None or item.source_sha256 is None or not _ADDRESS.fullmatch(item.source):
        return Extract(file=item.file, date=item.date, sha256=(first,))
    return Extract(
        file=item.file,
        date=item.date,
        sha256=tuple(dict.fromkeys([first, item.source_sha256])),
        urls=(item.source,),
    )


def _houses(path: Path, date: dt.date) -> NDArray[np.float64]:
    """Return a point of each building of an extract, longitude and latitude."""
    with open_snapshot(path, at=date) as snapshot:
        scan = scan_file(snapshot.path, load_taxonomy(), box=_WORLD)
    wanted = [any(label.class_name == "building" for label in traits.labels) for traits in scan.traits]
    shapes = shapely.from_wkb([row.wkb for row in scan.rows if wanted[row.kind]])
    points: NDArray[np.float64] = shapely.get_coordinates(shapely.centroid(shapes))
    return points


def _text(
    name: str,
    listed: Sequence[ListedExtract],
    extracts: Sequence[Extract],
    *,
    centre: tuple[float, float],
    size_m: tuple[float, float],
    scenes: Iterable[str],
) -> str:
    newest = listed[-1]
    number = name.removeprefix(newest.place).removeprefix("-")
    titled = (newest.title or newest.place.replace("-", " ").title()) + (f" ({number})" if number else "")
    dated_by = _of_dates({item.date: item.date_known_by for item in listed})
    stated = zip(listed, extracts, strict=True)
    origin = _of_dates({item.date: item.source for item, extract in stated if not extract.urls})
    fields = {
        "id": name,
        "title": f"{titled}, {newest.country}: {newest.what}",
        "scenes": list(scenes),
        "center_lonlat": list(centre),
        "size_m": [round(side) for side in size_m],
        "cell_size_m": 1.0,
    }
    provenance = {"country": newest.country, "dated_by": dated_by, "source": origin}
    return region_text(fields, provenance=provenance, extracts=extracts)


def _of_dates(texts: Mapping[dt.date, str | None]) -> str | None:
    """Return a text that all dates share, or each after its date; commits are cut to 12 digits if it would be too long.

    What is too long even so loses its first dates.

    >>> _of_dates({dt.date(2014, 1, 1): "header", dt.date(2018, 1, 1): "name"})
    '2014-01-01: header; 2018-01-01: name'
    """
    if len(set(texts.values())) <= 1:
        return next(iter(texts.values()), None)
    lines = [f"{date.isoformat()}: {text}" for date, text in texts.items() if text]
    if len("; ".join(lines)) > LONGEST_LINE:
        lines = [_COMMIT.sub(r"\1", line) for line in lines]
    while len("; ".join(lines)) > LONGEST_LINE:
        del lines[0]
    return "; ".join(lines) or None
