# SPDX-License-Identifier: Apache-2.0
"""RegionFile: the definition of a place in `regions/*.toml`."""

import datetime as dt
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, ClassVar, Final, Literal, Self

import numpy as np
import pyproj
import shapely
from pydantic import ConfigDict, Field, StringConstraints, field_validator, model_validator

from sasgeo_bench.core.config import (
    Line,
    NamedDocument,
    find_document,
    list_documents,
    read_document,
    shipped_dir,
    toml_value,
)
from sasgeo_bench.core.errors import ConfigError, GridError
from sasgeo_bench.geometry.grid import Grid, utm_epsg
from sasgeo_bench.geometry.projection import from_lonlat, to_lonlat
from sasgeo_bench.osm.locate import ClassTable, Extract, PlainName, Sha256
from sasgeo_bench.osm.taxonomy import load_taxonomy
from sasgeo_bench.regions.imagery import ImageryEntry
from sasgeo_bench.regions.region import LICENCE, Provenance

OWN_FOLDER: Final = Path("my-regions")  # where new-region writes
MAX_LATITUDE_DEG: Final = 84.0  # where UTM ends
MAX_LONGITUDE_DEG: Final = 180.0
MAX_AREA_KM2: Final = 100_000.0
MAX_CELLS: Final = 4e9
_EDGE_POINTS: Final = 21
_M_PER_DEG: Final = 111_320.0
_MOST_STRETCH: Final = 0.01  # of a CRS: a metre of its map is one on the ground, to 1 %

Scene = Literal[
    "urban",
    "suburban",
    "rural",
    "industrial",
    "riverside",
    "agricultural",
    "alpine",
    "coastal",
    "forest",
    "desert",
    "shore",
    "sparse",
]
Corner = Annotated[tuple[float, float], Field(strict=False)]
Identifier = Annotated[str, StringConstraints(pattern=r"^[a-z0-9]+(-[a-z0-9]+)*$")]


class StatedProvenance(Provenance):
    """The table `[provenance]` of a region file: a misspelt line is refused."""

    model_config = ConfigDict(extra="forbid")


class OwnMap(ClassTable):
    """One `[[own_map]]` of a region file: a file of another source than OpenStreetMap, and the classes that it gives.

    Such classes are from no extract: those that `class`, or `column` and `values`, name. A GeoJSON of tags of
    OpenStreetMap has `classes` instead, and `tags` that all its features have. Its mapped ground is that of the region
    file. `date` is None where it is not known. `publish` says whether the map, and what is made of it, may be passed
    on.

    >>> from sasgeo_bench.core.config import parse_toml
    >>> text = '''
    ... file = "houses.gpkg"
    ... sha256 = ["0000000000000000000000000000000000000000000000000000000000000000"]
    ... class = "building"
    ... licence = "CC0-1.0"
    ... attribution = "the land survey"
    ... publish = true
    ... '''
    >>> parse_toml(text, OwnMap, source="[[own_map]]").credit
    'building: the land survey (CC0-1.0)'
    """

    without_empty: ClassVar = frozenset(ClassTable.model_fields)

    file: PlainName
    sha256: Annotated[tuple[Sha256, ...], Field(strict=False, min_length=1)]
    date: dt.date | None = None
    classes: list[str] = []
    tags: dict[str, Line] = {}
    licence: Line
    attribution: Line
    publish: bool
    source: Line | None = None

    @field_validator("classes")
    @classmethod
    def _classes_are_known(cls, names: list[str]) -> list[str]:
        return _checked_classes(names)

    @model_validator(mode="before")
    @classmethod
    def _classes_of_table(cls, given: Any) -> Any:  # noqa: ANN401 - what a file holds
        """State `classes` of a table, so that they stand where those of tags do."""
        if not isinstance(given, dict) or "classes" in given:
            return given
        values = given.get("values")
        named = {given.get("class"), *(values.values() if isinstance(values, dict) else ())}
        return given | {"classes": [name for name in load_taxonomy().names if name in named]}

    @model_validator(mode="after")
    def _says_classes_once_or_tags(self) -> Self:
        if self.named_classes and (self.tags or tuple(self.classes) != self.named_classes):
            raise ValueError("classes and tags are of a GeoJSON of tags: leave them out beside class or column")
        is_json = self.file.lower().endswith((".geojson", ".json"))
        if not self.classes or not (self.named_classes or is_json):
            raise ValueError(
                f"say what the features of {self.file!r} are: class = '...', or column and values; a GeoJSON of tags "
                "has classes instead"
            )
        return self

    @property
    def credit(self) -> str:
        """Return which classes are from it, whose it is, and its licence."""
        return f"{', '.join(self.classes)}: {self.attribution} ({self.licence})"

    def beside(self, extract: Extract) -> Extract:
        """Return it as an extract, to be found as such; of the day of the one beside it if it states none."""
        date = self.date or extract.date
        return Extract(file=self.file, date=date, sha256=self.sha256, format="own_map")


class RegionFile(NamedDocument):
    """Definition of one region: identity, place, cell size and dated extracts.

    >>> from sasgeo_bench.core.config import parse_toml
    >>> text = '''
    ... id = "mine"
    ... title = "My place"
    ... scenes = ["urban"]
    ... center_lonlat = [9.0, 47.0]
    ... size_m = [512, 512]
    ... cell_size_m = 2.0
    ... [[extract]]
    ... file = "mine.osm.pbf"
    ... date = 2024-01-01
    ... sha256 = ["0000000000000000000000000000000000000000000000000000000000000000"]
    ... '''
    >>> parse_toml(text, RegionFile, source="mine.toml").grid().shape
    (256, 256)
    """

    without_empty: ClassVar = frozenset(
        {"coverage_parts_lonlat", "classes", "largest_view_m", "imagery", "provenance", "own_map"}
    )

    id: Identifier
    title: Line
    scenes: Annotated[list[Scene], Field(min_length=1)]
    center_lonlat: tuple[float, float] | None = Field(default=None, strict=False)
    size_m: tuple[float, float] | None = Field(default=None, strict=False)
    bounds_lonlat: tuple[float, float, float, float] | None = Field(default=None, strict=False)
    cell_size_m: float
    epsg: int | None = None
    coverage_lonlat: list[Corner] | None = None
    coverage_parts_lonlat: Annotated[list[list[Corner]], Field(min_length=1)] | None = None
    classes: Annotated[list[str], Field(min_length=1)] | None = None
    largest_view_m: Annotated[float, Field(gt=0)] | None = None
    extract: Annotated[list[Extract], Field(min_length=1)]
    own_map: list[OwnMap] = []
    imagery: list[ImageryEntry] = []
    provenance: StatedProvenance = StatedProvenance()

    @model_validator(mode="before")
    @classmethod
    def _own_map_alone(cls, given: Any) -> Any:  # noqa: ANN401 - what a file holds
        """Let the first own map stand for the extract of a file that has none."""
        own = given.get("own_map") if isinstance(given, dict) else None
        if not isinstance(given, dict) or "extract" in given or not own or not isinstance(own, list):
            return given
        first = own[0] if isinstance(own[0], dict) else {}
        if first.get("date") is None:
            raise ValueError("without an [[extract]] the first [[own_map]] needs a date: add the day that it is of")
        return given | {
            "extract": [{key: first.get(key) for key in ("file", "date", "sha256")} | {"format": "own_map"}]
        }

    @field_validator("cell_size_m")
    @classmethod
    def _cell_size_is_sane(cls, cell_size_m: float) -> float:
        low, high = 0.1, 100.0
        if not (math.isfinite(cell_size_m) and low <= cell_size_m <= high):
            raise ValueError(f"cell_size_m must lie between {low} and {high} metres, got {cell_size_m!r}")
        return cell_size_m

    @field_validator("epsg")
    @classmethod
    def _epsg_is_metric(cls, epsg: int | None) -> int | None:
        if epsg is None:
            return None
        try:
            crs = pyproj.CRS.from_epsg(epsg)
        except pyproj.exceptions.CRSError as error:
            raise ValueError(f"epsg {epsg!r} is unknown: leave it out for the UTM zone of the centre") from error
        if not crs.is_projected or {axis.unit_name for axis in crs.axis_info} != {"metre"}:
            raise ValueError(
                f"epsg {epsg!r} ({crs.name}) is not a projected CRS in metres: leave it out for the UTM zone"
            )
        return epsg

    @field_validator("coverage_lonlat")
    @classmethod
    def _coverage_is_a_ring(cls, ring: list[Corner] | None) -> list[Corner] | None:
        return ring if ring is None else _checked_ring(ring, "coverage_lonlat")

    @field_validator("coverage_parts_lonlat")
    @classmethod
    def _coverage_parts_are_rings(cls, rings: list[list[Corner]] | None) -> list[list[Corner]] | None:
        return rings if rings is None else [_checked_ring(ring, "each of coverage_parts_lonlat") for ring in rings]

    @field_validator("classes")
    @classmethod
    def _classes_are_known(cls, names: list[str] | None) -> list[str] | None:
        return names if names is None else _checked_classes(names)

    @model_validator(mode="after")
    def _coverage_is_stated_once(self) -> Self:
        if self.coverage_lonlat is not None and self.coverage_parts_lonlat is not None:
            raise ValueError("the mapped area is given twice: keep coverage_lonlat or coverage_parts_lonlat")
        is_labelled = any(item.format == "geojson" for item in self.extract)
        if is_labelled and (self.stated_coverage() is None or self.classes is None):
            raise ValueError(
                "an extract of format 'geojson' holds some classes in some places: say which by classes and by "
                "coverage_lonlat or coverage_parts_lonlat, above [[extract]]; all else is unknown"
            )
        return self

    @model_validator(mode="after")
    def _has_one_source_of_a_class(self) -> Self:
        names = [name for one in self.own_map for name in one.classes]
        if any(
            item.format == "own_map" and item.file not in {one.file for one in self.own_map} for item in self.extract
        ):
            raise ValueError("format 'own_map' is of no [[extract]]: write [[own_map]] without one")
        twice = next((name for name in names if names.count(name) > 1), None)
        if twice is not None:
            raise ValueError(f"[[own_map]] gives {twice!r} twice: a class is from one source")
        strange = next((name for name in names if name not in self.class_names), None)
        if strange is not None:
            raise ValueError(f"[[own_map]] gives {strange!r}, which `classes` lacks: add it there")
        if names and self.stated_coverage() is None:
            raise ValueError(
                "[[own_map]] holds some classes in some places: say where they and the extract are complete by "
                "coverage_lonlat or coverage_parts_lonlat, above [[extract]]; all else is unknown"
            )
        if names and bool(self.extract_classes) == self.is_own_alone:
            known = ", ".join(self.extract_classes)
            raise ValueError(
                f"no [[own_map]] gives {known}: leave it out of `classes`, or add an [[extract]]"
                if known
                else "[[own_map]] gives every class: leave one to [[extract]], or leave [[extract]] out"
            )
        return self

    @model_validator(mode="after")
    def _is_placed_once(self) -> Self:
        has_box = self.bounds_lonlat is not None
        has_centre = self.center_lonlat is not None and self.size_m is not None
        has_half = (self.center_lonlat is None) != (self.size_m is None)
        if has_box == has_centre or has_half or (has_box and self.size_m is not None):
            raise ValueError("say where the region lies either by center_lonlat and size_m, or by bounds_lonlat")
        _check_lonlat(self.lonlat_box())
        if self.size_m is not None and not all(math.isfinite(side) and side > 0 for side in self.size_m):
            raise ValueError(f"size_m must be two positive lengths, got {list(self.size_m)!r}")
        _check_size(*self._size_estimate_m(), self.cell_size_m)
        self._check_scale()
        self._check_antimeridian()
        return self

    def _check_scale(self) -> None:
        """Refuse a CRS whose metres are not those of the ground here, as those of web maps: sizes would be wrong."""
        if self.epsg is None:
            return
        west, south, east, north = self.lonlat_box()
        factors = pyproj.Proj(self.epsg).get_factors([west, west, east, east], [south, north, south, north])
        scales = np.concatenate([factors.meridional_scale, factors.parallel_scale])
        worst = float(scales[np.argmax(np.abs(scales - 1))])
        if abs(worst - 1) > _MOST_STRETCH:  # not so where it is no number: `grid` says that
            raise ValueError(
                f"epsg {self.epsg} stretches this place by {worst:.2f}: its metres are not those of the ground; leave "
                "epsg out for the UTM zone"
            )

    def _check_antimeridian(self) -> None:
        """Refuse a region across 180 degrees of longitude, before anything is read: ways and boxes end there."""
        west, south, east, north = self.lonlat_box()
        width_m, _ = self._size_estimate_m()
        reach_deg = width_m / _M_PER_DEG / math.cos(math.radians(max(abs(south), abs(north))))
        if max(abs(west), abs(east)) + reach_deg < MAX_LONGITUDE_DEG or self.size_m is None:
            return  # far from it, or a box, whose edge may lie on it
        try:
            grid = self.grid()
        except ConfigError:
            return  # reported when the region is built
        grid_west, _, grid_east, _ = to_lonlat(grid.epsg).transform_bounds(*grid.bounds_m, densify_pts=_EDGE_POINTS)
        if grid_west > grid_east:
            raise ValueError(
                f"the region around {[west, south]!r} reaches over the antimeridian, from {grid_west:.4f} to "
                f"{grid_east:.4f} degrees: a box over the antimeridian must be split in two"
            )

    @model_validator(mode="after")
    def _dates_differ(self) -> Self:
        dates = [item.date for item in self.extract]
        twice = sorted({date.isoformat() for date in dates if dates.count(date) > 1})
        if twice:
            raise ValueError(f"two extracts have the date {twice[0]}: keep one of them")
        return self

    @property
    def class_names(self) -> tuple[str, ...]:
        """Return the classes of the map, in the order of their ids: those of `classes`, or all that it may have."""
        known = self._own_classes if self.classes is None and self.is_own_alone else self.classes
        return tuple(name for name in load_taxonomy().names if known is None or name in known)

    @property
    def is_own_alone(self) -> bool:
        """Return whether nothing of it is from OpenStreetMap."""
        return all(item.format == "own_map" for item in self.extract)

    @property
    def _own_classes(self) -> set[str]:
        return {name for one in self.own_map for name in one.classes}

    @property
    def extract_classes(self) -> tuple[str, ...]:
        """Return the classes that are from the extract: all but those of `own_map`."""
        return tuple(name for name in self.class_names if name not in self._own_classes)

    @property
    def origin(self) -> Provenance:
        """Return the lines of provenance, with those sources that are no extract."""
        further = [*filter(None, [self.provenance.further_sources]), *(one.credit for one in self.own_map)]
        # In the order of the fields: a set has another one in each process, and so would the file
        given = [name for name in Provenance.model_fields if name in self.provenance.model_fields_set]
        stated = {name: getattr(self.provenance, name) for name in given}
        return Provenance(**stated | ({"further_sources": "; ".join(further)} if further else {}))

    @property
    def credit(self) -> str:
        """Return whom to name beside what shows the map: OpenStreetMap, unless nothing is from there, and others."""
        return self.origin.further_sources or "" if self.is_own_alone else self.origin.credit

    @property
    def licence(self) -> str:
        """Return the licence of the map: ODbL, or those of its sources where nothing is from OpenStreetMap."""
        return " AND ".join(dict.fromkeys(one.licence for one in self.own_map)) if self.is_own_alone else LICENCE

    def stated_coverage(self) -> shapely.Geometry | None:
        """Return the mapped area as stated, in longitude and latitude; None if it is to be estimated."""
        if self.coverage_lonlat is not None:
            return shapely.Polygon(self.coverage_lonlat)
        rings = self.coverage_parts_lonlat
        return None if rings is None else shapely.union_all([shapely.Polygon(ring) for ring in rings])

    def lonlat_box(self) -> tuple[float, float, float, float]:
        """Return west, south, east, north as written, degrees; for a centre, that point twice."""
        if self.bounds_lonlat is not None:
            return self.bounds_lonlat
        longitude_deg, latitude_deg = self.center_lonlat or (math.nan, math.nan)
        return (longitude_deg, latitude_deg, longitude_deg, latitude_deg)

    def _size_estimate_m(self) -> tuple[float, float]:
        if self.size_m is not None:
            return self.size_m
        west, south, east, north = self.lonlat_box()
        width = (east - west) * _M_PER_DEG * math.cos(math.radians((south + north) / 2))
        return (width, (north - south) * _M_PER_DEG)

    def grid(self) -> Grid:
        """Return the region's lattice; raise `ConfigError` if the place cannot be projected into the CRS.

        Its edges are whole multiples of the cell size, so that regions of one zone share their lines.
        """
        west, south, east, north = self.lonlat_box()
        epsg = self.epsg or utm_epsg((west + east) / 2, (south + north) / 2)
        to_grid = from_lonlat(epsg)
        try:
            if self.size_m is not None:
                easting_m, northing_m = to_grid.transform(west, south, errcheck=True)
                return Grid.around(easting_m, northing_m, size_m=self.size_m, cell_size_m=self.cell_size_m, epsg=epsg)
            bounds_m = to_grid.transform_bounds(west, south, east, north, densify_pts=_EDGE_POINTS, errcheck=True)
            return Grid.from_bounds(*bounds_m, cell_size_m=self.cell_size_m, epsg=epsg)
        except (pyproj.exceptions.ProjError, GridError) as error:
            raise ConfigError(
                f"{self.id}: the place cannot be projected to EPSG:{epsg} ({error}): leave epsg out, or fix it"
            ) from error

    def pick(self, date: dt.date | None) -> Extract:
        """Return the extract of a date, or the newest; raise `ConfigError`, which lists the dates, if there is none."""
        newest = max(self.extract, key=lambda item: item.date)
        if date is None:
            return newest
        found = next((item for item in self.extract if item.date == date), None)
        if found is None:
            known = ", ".join(sorted(item.date.isoformat() for item in self.extract))
            raise ConfigError(f"{self.id} has no extract of {date.isoformat()}; there are {known}")
        return found


def _checked_classes(names: list[str]) -> list[str]:
    known = load_taxonomy().names
    strange = next((name for name in names if name not in known), None)
    if strange is not None:
        raise ValueError(f"classes has {strange!r}, which is no class: there are {', '.join(known)}")
    return names


def _checked_ring(ring: list[Corner], key: str) -> list[Corner]:
    least = 3
    if len(set(ring)) < least:
        raise ValueError(f"{key} needs at least {least} different corners [lon, lat], got {len(set(ring))}")
    return ring


def _check_lonlat(box: tuple[float, float, float, float]) -> None:
    west, south, east, north = box
    written = list(box)
    if not all(math.isfinite(value) for value in box) or max(abs(west), abs(east)) > MAX_LONGITUDE_DEG:
        raise ValueError(f"longitudes lie within -180..180 and latitudes within -90..90, got {written!r}")
    if max(abs(south), abs(north)) > MAX_LATITUDE_DEG:
        raise ValueError(
            f"UTM ends at {MAX_LATITUDE_DEG:g} degrees of latitude, got {written!r}: choose a place nearer the equator"
        )
    if west > east:
        raise ValueError(
            f"bounds_lonlat is [west, south, east, north], got west {west} > east {east}: swap them; "
            "a box over the antimeridian must be split in two"
        )
    if south > north:
        raise ValueError(f"bounds_lonlat is [west, south, east, north], got south {south} > north {north}: swap them")


def _check_size(width_m: float, height_m: float, cell_size_m: float) -> None:
    """Refuse a region that is empty or too large, before anything is allocated."""
    if width_m <= 0 or height_m <= 0:
        raise ValueError(f"the region is {width_m:.0f} m by {height_m:.0f} m: give it a positive size")
    area_km2, cells = width_m * height_m / 1e6, width_m * height_m / cell_size_m**2
    if area_km2 > MAX_AREA_KM2 or cells > MAX_CELLS:
        raise ValueError(
            f"the region has {area_km2:,.0f} km2 or {cells:,.0f} cells a class, {cells / 1e9:,.1f} GB each; "
            f"the most is {MAX_AREA_KM2:,.0f} km2 and {MAX_CELLS:,.0f} cells: make it smaller or its cells larger"
        )


def read_region_file(path: Path) -> RegionFile:
    """Read one region file; raise `ConfigError` with all faults on one line."""
    return read_document(path, RegionFile, "regions")


def list_region_files(*, folders: Sequence[Path] = ()) -> dict[str, Path]:
    """Return region id -> file, from the given folders and the package; raise as `list_documents` does."""
    return list_documents("regions", RegionFile, folders)


def find_region_file(id_or_path: str, *, folders: Sequence[Path] = ()) -> Path:
    """Find a region file by its id, or return the path of one; raise as `find_document` does.

    Of ids that are in none of the folders, nor in the package, that in `OWN_FOLDER` is taken.

    >>> find_region_file("vadus")
    Traceback (most recent call last):
        ...
    sasgeo_bench.core.errors.ConfigError: there is no region 'vadus', did you mean 'vaduz'? (list regions or new-region)
    """
    # A file that ships is named by its id, so that the hundreds of others need not be read.
    shipped = shipped_dir("regions") / f"{id_or_path}.toml"
    if not folders and shipped.name == f"{id_or_path}.toml" and shipped.is_file():
        return shipped

    def known() -> dict[str, Path]:
        return {path.stem: path for path in sorted(OWN_FOLDER.glob("*.toml"))} | list_region_files(folders=folders)

    return find_document(id_or_path, "region", "list regions or new-region", known)


def region_text(
    fields: Mapping[str, object], *, provenance: Mapping[str, str | None], extracts: Sequence[Extract]
) -> str:
    """Return the text of a region file: its keys in their order, lines of provenance that are known, and extracts.

    >>> extract = Extract(file="mine.osm.pbf", date=dt.date(2024, 1, 1), sha256=("0" * 64,))
    >>> text = region_text({"id": "mine", "size_m": [512, 512]}, provenance={"country": None}, extracts=[extract])
    >>> text.splitlines()[1:5]
    ['id = "mine"', 'size_m = [512, 512]', '', '[[extract]]']
    """
    stated = {name: text for name, text in provenance.items() if text}
    lines = [
        "# Extract (c) OpenStreetMap contributors, ODbL 1.0.",
        *(f"{key} = {toml_value(fields[key])}" for key in fields),
    ]
    lines += ["", "[provenance]", *(f"{name} = {toml_value(text)}" for name, text in stated.items())] if stated else []
    for extract in extracts:
        hashes = "".join(f"  {toml_value(each)},\n" for each in extract.sha256)
        lines += ["", "[[extract]]", f"file = {toml_value(extract.file)}", f"date = {extract.date.isoformat()}"]
        lines += [f"sha256 = [\n{hashes}]", *([f"urls = [{toml_value(extract.urls[0])}]"] if extract.urls else [])]
    return "\n".join(lines) + "\n"
