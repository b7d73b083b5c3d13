# SPDX-License-Identifier: Apache-2.0
"""A region file for one place: which extract at hand covers it, of which day that is, and the kinds of its ground."""

import calendar
import datetime as dt
import math
import re
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from shutil import copyfile
from typing import Final, Self

import numpy as np
import shapely
from numpy.typing import NDArray

from sasgeo_bench.core.config import parse_toml, shipped_dir
from sasgeo_bench.core.errors import ConfigError, CoverageError, ExtractError, counted
from sasgeo_bench.core.folders import check_free, fresh_file, scratch_folder, sha256_of
from sasgeo_bench.core.progress import tell
from sasgeo_bench.core.texts import one_line
from sasgeo_bench.geometry.grid import Grid, utm_epsg
from sasgeo_bench.geometry.projection import from_lonlat, to_lonlat
from sasgeo_bench.osm.coverage import M_PER_DEG
from sasgeo_bench.osm.cut import cut_extract
from sasgeo_bench.osm.locate import Extract, extract_folders
from sasgeo_bench.osm.mapped import box_text, lonlat_box
from sasgeo_bench.osm.read import Reading, read_extract
from sasgeo_bench.osm.regional import address_of, download_regional, regional_extracts_of
from sasgeo_bench.osm.snapshot import SUFFIXES, Header, read_extent, read_header
from sasgeo_bench.osm.xml_text import Box
from sasgeo_bench.regions.region_spec import RegionFile, region_text
from sasgeo_bench.regions.scenes import ground_of

MARGIN_M: Final = 500.0  # around photos, and of a cut around the place
APART_M: Final = 10_000.0  # photos farther apart than this are of two places
LARGE_BYTES: Final = 100_000_000  # of an extract that is cut before it is read: reading looks at all its objects
LARGE_MARGIN_M: Final = 5_000.0  # of that cut: wide enough to show where the extract itself ends
WHOLE: Final = 0.99  # share of a place that an extract that covers it maps: ground by a cut way may be unknown
_EARTH_M: Final = 6_371_000.0
_POLE_DEG: Final = 90.0
_MEND: Final = "name another folder by --into, or check your rights"
_NAME: Final = re.compile(r"[a-z0-9]+(-[a-z0-9]+)*")
_SIZE: Final = re.compile(r"(?P<width>\d+(?:\.\d+)?)(?:x(?P<height>\d+(?:\.\d+)?))?(?P<unit>km|m)")
_DAY: Final = re.compile(
    r"(?<!\d)((?:19|20)\d\d)-?([01]\d)-?([0-3]\d)(?!\d)|(?<=-)(\d\d)([01]\d)([0-3]\d)(?=\.os[mh]\b)"
)


@dataclass(frozen=True, slots=True, kw_only=True)
class Place:
    """Where a region lies: a centre (degrees) and a size (width and height, metres), or bounds, degrees.

    `country` is the name of its country, if it is known; `source` is what it was read out of, such as "log", if any.
    """

    country: str | None = None
    source: str = ""
    center_lonlat: tuple[float, float] | None = None
    size_m: tuple[float, float] | None = None
    bounds_lonlat: Box | None = None

    @classmethod
    def around(cls, center: str, size: str) -> Self:
        """Return the place around "LON,LAT" of a size such as "2km", "800m" or "2x3km" (width x height).

        Raise `ConfigError` if one of the texts is none.

        >>> Place.around("9.52,47.15", "2x3km").size_m
        (2000.0, 3000.0)
        """
        lon_deg, lat_deg = _degrees(center, "LON,LAT", "9.52,47.15")
        found = _SIZE.fullmatch(size.replace(" ", ""))
        if found is None:
            raise ConfigError(f"size is such as 2km, 800m or 2x3km (width x height), got {one_line(repr(size))}")
        unit_m = 1000.0 if found["unit"] == "km" else 1.0
        width_m = float(found["width"]) * unit_m
        return cls(
            center_lonlat=(lon_deg, lat_deg),
            size_m=(width_m, float(found["height"]) * unit_m if found["height"] else width_m),
        )

    @classmethod
    def within(cls, bounds: str) -> Self:
        """Return the place within "W,S,E,N", degrees; raise `ConfigError` if the text is none.

        >>> Place.within("9.50,47.13,9.54,47.17").bounds_lonlat
        (9.5, 47.13, 9.54, 47.17)
        """
        west, south, east, north = _degrees(bounds, "W,S,E,N", "9.50,47.13,9.54,47.17")
        return cls(bounds_lonlat=(west, south, east, north))

    @classmethod
    def of_points(cls, lonlat: NDArray[np.float64], *, noun: str = "photo") -> Self:
        """Return the place of points, longitude and latitude of shape (N, 2) in degrees, with `MARGIN_M` around them.

        Raise `ConfigError` if there is no point, or some lie more than `APART_M` from all others; `noun` says what
        they are of.

        >>> Place.of_points(np.array([[9.52, 47.15], [9.53, 47.15]])).size_m
        (1759.0, 1006.0)
        """
        if not len(lonlat):
            raise ConfigError(f"no {noun} says where it was taken: name the place by --center or --bounds")
        groups = _groups(lonlat)
        if len(groups) > 1:
            middles = [np.median(one, axis=0).round(3).tolist() for one in groups]
            listed = [f"{counted(len(one), noun)} near {at}" for one, at in zip(groups, middles, strict=True)]
            raise ConfigError(
                f"the {noun}s lie in {len(groups)} places more than {APART_M / 1000:.0f} km apart, "
                f"{'; '.join(listed)}: make a region of each"
            )
        epsg = utm_epsg(*np.median(lonlat, axis=0).tolist())
        points_m = np.column_stack(from_lonlat(epsg).transform(lonlat[:, 0], lonlat[:, 1]))
        low_m, high_m = points_m.min(axis=0), points_m.max(axis=0)
        lon_deg, lat_deg = to_lonlat(epsg).transform(*((low_m + high_m) / 2))
        width_m, height_m = np.ceil(high_m - low_m + 2 * MARGIN_M).tolist()
        return cls(center_lonlat=(round(lon_deg, 5), round(lat_deg, 5)), size_m=(width_m, height_m))

    def fields(self) -> dict[str, object]:
        """Return the keys of a region file that say where it lies."""
        if self.bounds_lonlat is not None:
            return {"bounds_lonlat": list(self.bounds_lonlat)}
        sides = [int(side) if side.is_integer() else side for side in self.size_m or ()]
        return {"center_lonlat": list(self.center_lonlat or ()), "size_m": sides}


@dataclass(frozen=True, slots=True, kw_only=True)
class Days:
    """A day, a month or a year, as its first and last day."""

    first: dt.date
    last: dt.date

    @classmethod
    def read(cls, text: str) -> Self:
        """Read "YYYY", "YYYY-MM" or "YYYY-MM-DD"; raise `ConfigError` if it is none of them.

        >>> Days.read("2020-02").last
        datetime.date(2020, 2, 29)
        """
        try:
            if not re.fullmatch(r"\d{4}(-\d\d){0,2}", text):
                raise ValueError(text)  # noqa: TRY301 - answered below, as a day that is none
            year, month, day = (*map(int, text.split("-")), 0, 0)[:3]
            first = dt.date(year, month or 1, day or 1)
            last = dt.date(year, month or 12, day or calendar.monthrange(year, month or 12)[1])
        except ValueError as error:
            raise ConfigError(f"date is YYYY, YYYY-MM or YYYY-MM-DD, got {one_line(repr(text))}") from error
        return cls(first=first, last=last)

    def away(self, day: dt.date) -> int:
        """Return the number of days from a day to the nearest one of these."""
        return max((self.first - day).days, (day - self.last).days, 0)


@dataclass(frozen=True, kw_only=True)
class AtHand:
    """An extract in one of the folders; `date` is the day of the map, of a full history the one to cut it at."""

    path: Path
    date: dt.date
    date_known_by: str
    is_history: bool
    header: Header

    @cached_property
    def boxes(self) -> tuple[Box, ...]:
        """Return the boxes of its header, or that of its nodes."""
        return self.header.boxes_lonlat or read_extent(self.path).boxes_lonlat

    @cached_property
    def sha256(self) -> str:
        """Return the hash of the file."""
        return sha256_of(self.path)

    def to_text(self) -> str:
        """Return file, bounds, date and hash, in a line."""
        bounds = ", ".join(map(box_text, self.boxes))
        return (
            f"{self.path}: bounds {bounds}, map of {self.date} (known by: {self.date_known_by}), SHA-256 {self.sha256}"
        )


@dataclass(frozen=True, slots=True, kw_only=True)
class Covering:
    """The extract of a place, the file that was read (itself, or a cut out of it), and the share that it maps."""

    extract: AtHand
    path: Path
    reading: Reading
    share: float


def list_at_hand(folders: Sequence[Path], *, days: Days | None = None) -> list[AtHand]:
    """List the extracts in folders, those first that are nearest to some days, and the newest of these.

    A full history is of all days until its last one. What cannot be read is passed over, with a line.
    """
    found = []
    for folder in folders:
        for path in sorted(folder.iterdir()) if folder.is_dir() else ():
            if not path.name.endswith(SUFFIXES):
                continue
            try:
                found.append(_at_hand(path, days))
            except (ExtractError, OSError) as error:
                tell(f"passed over: {error}")
    return sorted(
        found, key=lambda item: (days.away(item.date) if days else 0, -item.date.toordinal(), item.is_history)
    )


def find_covering(grid: Grid, extracts: Sequence[AtHand], *, scratch: Path) -> Covering | None:
    """Return the first extract that maps the whole of a grid, else the one that maps most of it, with a line, or None.

    An extract is read only if its bounds meet the grid, and none of the same bounds was before it. Of one of more than
    `LARGE_BYTES` what lies around the grid is cut into the folder `scratch`, and the cut is read.
    """
    area = shapely.box(*lonlat_box(grid))
    best: Covering | None = None
    outlines: set[tuple[Box, ...]] = set()
    for item in extracts:
        try:
            outline = tuple((round(w, 2), round(s, 2), round(e, 2), round(n, 2)) for w, s, e, n in item.boxes)
            bounds = shapely.union_all([shapely.box(*box) for box in item.boxes])
            most = bounds.intersection(area).area / area.area
            if outline in outlines or most <= (best.share if best else 0.0):
                continue
            path = item.path
            if path.stat().st_size > LARGE_BYTES:
                tell(f"{path.name} is large ({path.stat().st_size / 1e6:,.0f} MB): cutting the place out of it")
                path = scratch / f"around-{path.name.partition('.')[0]}.osm.pbf"
                cut_extract(item.path, path, _grown(lonlat_box(grid), LARGE_MARGIN_M), at=item.date)
            reading = read_extract(path, grid, at=item.date)
        except CoverageError:
            continue
        except ExtractError as error:
            tell(f"passed over: {error}")
            continue
        outlines.add(outline)
        west, south, east, north = grid.bounds_m
        share = reading.coverage.area / (east - west) / (north - south)
        found = Covering(extract=item, path=path, reading=reading, share=share)
        if found.share >= WHOLE:
            return found
        best = found if best is None or found.share > best.share else best
    if best is not None:
        tell(f"no extract maps the whole place; {best.extract.path.name} maps {best.share:.0%} of it")
    return best


def new_region(
    name: str,
    place: Place,
    *,
    into: Path,
    folders: Sequence[Path] = (),
    days: Days | None = None,
    keep_cut: bool = False,
    most_mb: float = 0.0,
) -> Path:
    """Write the region file of a place, `<into>/<name>.toml`, and return its path.

    Its extract is the newest that covers the place, or the one nearest to `days`, in `folders`, those of
    `SASGEO_EXTRACTS` and the user's cache; where none does, and no days are asked for, a regional extract of at most
    `most_mb` megabytes is downloaded. `keep_cut` cuts the place out of it, with `MARGIN_M` around, and writes the cut
    beside the file, which names it. A file that is there already stays as it is.

    Raises
    ------
    ConfigError
        If the name or the place cannot be that of a region.
    ExtractError
        If no extract covers the place; the line names the regional extracts to get.
    StoreError
        If a file cannot be written, or is there and is of another region.
    """
    if not _NAME.fullmatch(name):
        raise ConfigError(
            f"a name of a region has small letters, digits and hyphens between them, got {one_line(repr(name))}"
        )
    if (shipped_dir("regions") / f"{name}.toml").exists():
        raise ConfigError(f"region {name!r} comes with the program: choose another name")
    fields: dict[str, object] = {"id": name, "title": name.replace("-", " ").title(), "scenes": ["sparse"]}
    fields |= place.fields() | {"cell_size_m": 1.0}
    nothing = Extract(file="none.osm.pbf", date=dt.date(2000, 1, 1), sha256=("0" * 64,))
    grid = parse_toml(
        region_text(fields, provenance={}, extracts=[nothing]), RegionFile, source=f"region {name}"
    ).grid()
    with scratch_folder("cut") as scratch:
        found = _covering(grid, folders, days, most_mb=most_mb, scratch=scratch, source=place.source)
        item = found.extract
        tell(item.to_text())
        fields["scenes"] = list(ground_of(found.reading, found.path, grid, at=item.date).scenes())
        extract = Extract(file=item.path.name, date=item.date, sha256=(item.sha256,))
        cut, source = scratch / f"{name}-{item.date}.osm.pbf", None
        if keep_cut:
            cut_extract(found.path, cut, _grown(lonlat_box(grid), MARGIN_M), at=item.date)
            extract = Extract(file=cut.name, date=item.date, sha256=(sha256_of(cut),))
            source = f"cut out of {item.path.name}, SHA-256 {item.sha256}"
            fields |= _stated(found, grid)
        elif found.path != item.path:
            tell(f"build-region will read the whole of {item.path.name}: --keep-cut spares that")
        provenance = {"country": place.country, "dated_by": item.date_known_by, "source": source}
        path, text = into / f"{name}.toml", region_text(fields, provenance=provenance, extracts=[extract])
        is_new = check_free(path, text)
        if keep_cut:
            with fresh_file(into / cut.name, mend=_MEND) as target:
                copyfile(cut, target)
            tell(f"{into / cut.name}: the place, cut out of {item.path.name}, SHA-256 {extract.sha256[0]}")
    if is_new:
        with fresh_file(path, mend=_MEND) as target:
            target.write_text(text, encoding="utf-8")
    return path


def _grown(box: Box, margin_m: float) -> Box:
    west, south, east, north = box
    up_deg = margin_m / M_PER_DEG
    side_deg = up_deg / math.cos(math.radians(max(abs(south), abs(north))))
    return (west - side_deg, south - up_deg, east + side_deg, north + up_deg)


def _stated(found: Covering, grid: Grid) -> dict[str, object]:
    """Return the mapped area as keys of a region file: a cut no longer shows where the whole extract ended."""
    if found.share >= WHOLE:
        # 10 m: the edge of the place lies inside
        west, south, east, north = (round(side, 6) for side in _grown(lonlat_box(grid), 10.0))
        return {"coverage_lonlat": [[west, south], [east, south], [east, north], [west, north]]}
    parts = shapely.get_parts(found.reading.coverage)
    rings = [shapely.get_coordinates(shapely.get_exterior_ring(part)) for part in parts if part.geom_type == "Polygon"]
    change = to_lonlat(grid.epsg)
    return {"coverage_parts_lonlat": [np.column_stack(change.transform(*ring.T)).round(6).tolist() for ring in rings]}


def _covering(
    grid: Grid, folders: Sequence[Path], days: Days | None, *, most_mb: float, scratch: Path, source: str
) -> Covering:
    """Return what covers a grid, at hand or downloaded; raise `ExtractError` if nothing does."""
    places = extract_folders(folders)
    at_hand = list_at_hand(places, days=days)
    found = find_covering(grid, at_hand, scratch=scratch)
    if found is not None:
        return found
    area = shapely.box(*lonlat_box(grid))
    lack = f"no extract in {', '.join(map(str, places))} covers {box_text(area.bounds)} (west, south, east, north)"
    turned = shapely.transform(area, lambda lonlat: lonlat[:, ::-1])
    other = next(
        (item for item in at_hand if any(shapely.box(*box).covers(turned) for box in item.header.boxes_lonlat)), None
    )
    if other is not None:
        mend = f"latitude and longitude look swapped in the {source}" if source else "longitude comes first"
        raise ExtractError(f"{lack}, and {other.path.name} covers {box_text(turned.bounds)}: {mend}")
    if days is None and most_mb > 0:
        try:
            path = download_regional(area, most_mb=most_mb)
            found = find_covering(grid, [_at_hand(path, None)], scratch=scratch)
        except ExtractError as error:
            lack += f"; {error}"
        if found is not None:
            return found
    regional = list(dict.fromkeys(item.name for item in regional_extracts_of(area)))
    if not regional:
        raise ExtractError(f"{lack}: no regional extract is known of it")
    smallest, others = regional[0], [name for name in regional[1:] if not regional[0].startswith(f"{name}/")]
    more = f" (or {address_of(others[0])}, if it lies there)" if others else ""
    raise ExtractError(f"{lack}: get {address_of(smallest)}{more}, and name its folder with --extracts")


def _at_hand(path: Path, days: Days | None) -> AtHand:
    header = read_header(path)
    if header.replicated_at is not None:
        date, known_by = header.replicated_at.date(), "header of the file"
    elif (named_day := _day_of(path.name)) is not None:
        date, known_by = named_day, "name of the file"
    else:
        content = read_extent(path)
        if content.replicated_at is None:
            raise ExtractError(f"{path} has no date in its header, its name or its objects: name it NAME-YYYY-MM-DD...")
        date, known_by = content.replicated_at.date(), "newest object"
        header = replace(header, boxes_lonlat=header.boxes_lonlat or content.boxes_lonlat)
    is_history = header.is_history or ".osh" in path.name
    if is_history and days is not None and date > days.last:
        date, known_by = days.last, "full history, cut at that day"
    return AtHand(path=path, date=date, date_known_by=known_by, is_history=is_history, header=header)


def _day_of(name: str) -> dt.date | None:
    """Return the day in the name of a file, as YYYY-MM-DD, YYYYMMDD or, before the suffix, YYMMDD; None if none is.

    >>> _day_of("andorra-2025-01-19.osm.pbf"), _day_of("andorra-250119.osm.pbf"), _day_of("andorra-latest.osm.pbf")
    (datetime.date(2025, 1, 19), datetime.date(2025, 1, 19), None)
    """
    for found in _DAY.finditer(name):
        year, month, day, short, *rest = found.groups()
        with suppress(ValueError):
            return dt.date(int(year), int(month), int(day)) if year else dt.date(2000 + int(short), *map(int, rest))
    return None


def _degrees(text: str, form: str, example: str) -> tuple[float, ...]:
    """Read numbers that commas part: longitudes and latitudes in turn."""
    try:
        values = tuple(float(part) for part in text.split(","))
    except ValueError:
        values = ()
    if len(values) != len(form.split(",")) or not all(map(math.isfinite, values)):
        raise ConfigError(f"{form} are degrees, such as {example}, got {one_line(repr(text))}")
    if any(abs(latitude) > _POLE_DEG for latitude in values[1::2]):
        raise ConfigError(f"{form} are degrees, and no latitude lies beyond 90, got {text!r}: longitude comes first")
    return values


def _groups(lonlat: NDArray[np.float64]) -> list[NDArray[np.float64]]:
    """Part points into groups that lie more than `APART_M` from each other."""
    from sklearn.cluster import DBSCAN  # type: ignore[import-untyped, unused-ignore]  # noqa: PLC0415 - takes a second

    cells, member = np.unique(lonlat.round(3), axis=0, return_inverse=True)  # of 100 m: photos are many
    search = DBSCAN(eps=APART_M / _EARTH_M, min_samples=1, metric="haversine", algorithm="ball_tree")
    labels = search.fit_predict(np.radians(cells[:, ::-1]))[member.ravel()]
    return [lonlat[labels == label] for label in np.unique(labels)]
