# SPDX-License-Identifier: Apache-2.0
"""Region: grid, layers, graph, features, coverage and provenance; immutable."""

import datetime as dt
import hashlib
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Final, Generic, Self, TypeVar, cast

import numpy as np
import shapely
from numpy.typing import NDArray
from pydantic import Field

from sasgeo_bench.core.config import JsonDocument, Line, Record
from sasgeo_bench.core.folders import FileRecord
from sasgeo_bench.core.texts import FOLDER, html_facts
from sasgeo_bench.geometry.grid import Grid
from sasgeo_bench.osm.locate import CoverageSource
from sasgeo_bench.regions.evidence import PRESENT
from sasgeo_bench.regions.imagery import Imagery, OrthoRecord

if TYPE_CHECKING:
    import geopandas as gpd
    import pandas as pd
    from matplotlib.figure import Figure

SCHEMA_VERSION: Final = 1  # of region.json and its tables
DATA_VERSION: Final = 3  # of regions: raised whenever the same input gives another region
OLD_STYLE_DATA_VERSION: Final = 3  # from this one on multipolygons of the old style are assembled (`osm.multipolygons`)
MADE_UP: Final = ("town-", "demo-")  # how the names of regions begin that a program made up
ATTRIBUTION: Final = "(c) OpenStreetMap contributors, ODbL"
LICENCE: Final = "ODbL-1.0"

Count = Annotated[int, Field(ge=0)]
Value = TypeVar("Value")


class Provenance(Record):
    """Lines on the origin of a place, as `[provenance]` of its region file states them.

    Each goes whole to `region.json`, `task.json`, `board.json`, archives and releases, and is a column of a board's
    table of maps, as soon as it is a field here: text, a number, or None where the file states nothing.

    >>> Provenance(surveyed_by="the village school").titled()
    {'surveyed by': 'the village school'}
    """

    surveyed_by: Annotated[
        Line | None, Field(title="surveyed by", description="Who surveyed the place, as its region file says")
    ] = None
    country: Annotated[
        Line | None, Field(title="country", description="Country or territory that the place lies in")
    ] = None
    dated_by: Annotated[Line | None, Field(title="dated by", description="How the date of the extract is known")] = None
    source: Annotated[
        Line | None, Field(title="source", description="Where an extract without an address to load it from comes from")
    ] = None

    further_sources: Annotated[
        Line | None,
        Field(
            title="further sources",
            description="Sources of the map beside OpenStreetMap: classes, whose, and licence; to be named with it",
        ),
    ] = None

    @property
    def credit(self) -> str:
        """Return whom to name beside what shows the map.

        >>> Provenance(further_sources="building: a land survey (CC0-1.0)").credit
        '(c) OpenStreetMap contributors, ODbL; building: a land survey (CC0-1.0)'
        """
        return "; ".join(filter(None, (ATTRIBUTION, self.further_sources)))

    def titled(self) -> dict[str, str]:
        """Return what is stated, by the titles of the lines."""
        stated = {line.title or name: getattr(self, name) for name, line in Provenance.model_fields.items()}
        return {title: str(value) for title, value in stated.items() if value is not None}


def credit_of(maps: Iterable[Provenance]) -> str:
    """Return whom to name beside what shows several maps, each once."""
    return "; ".join(dict.fromkeys((ATTRIBUTION, *(one.further_sources for one in maps if one.further_sources))))


class ExtractRecord(JsonDocument):
    """The extract a region was built from; `also` are its further files with their SHA-256."""

    without_empty: ClassVar = frozenset({"also"})

    file: str
    sha256: str
    bytes: Count
    date: dt.date
    osm_timestamp: dt.datetime | None
    also: dict[str, str] = {}


class OwnMapRecord(JsonDocument):
    """A source of some classes beside the extract; `publish`: it, and what is made of it, may be passed on."""

    file: str
    sha256: str
    bytes: Count
    date: dt.date | None
    classes: tuple[str, ...]
    licence: str
    attribution: str
    publish: bool
    source: str | None


class CoverageRecord(JsonDocument):
    """The mapped area: its source, its share of the grid, and its outline as WKT in the region's CRS.

    `unknown_m2` is the ground removed from it, by reason (one place may have two); `cuts` counts what an extract lost
    where it was cut out of a larger one. Both are empty in regions of data version 1, which did not record them.
    """

    source: CoverageSource
    share: Annotated[float, Field(ge=0, le=1)]
    wkt: str
    unknown_m2: dict[str, Annotated[float, Field(ge=0)]] = {}
    cuts: dict[str, Count] = {}

    def to_text(self) -> str:
        """Describe in one line how much is mapped, and what is not and why."""
        cuts = ", ".join(f"{what} {count}" for what, count in self.cuts.items())
        reasons = [f"{area_m2:,.0f} m2 unknown {reason}" for reason, area_m2 in self.unknown_m2.items()]
        about = f"; cut out of a larger extract: {cuts}" if cuts else ""
        return "; ".join((f"{self.share:.1%} of the grid ({self.source}){about}", *reasons))


class Manifest(JsonDocument):
    """`region.json`: identity and provenance of a region, and the hashes of its files.

    `counts` are objects by class within the grid; `hidden`, `drops` and `notes` are objects in and around the grid by
    reason: not visible from above, not used, repaired. `classes` are those that the map knows of: whatever is of
    another class is unknown everywhere. Those of `own_maps` are from there, all others from the extract. `imagery` is
    None in a region without.
    """

    without_empty: ClassVar = frozenset({"imagery", "provenance", "own_maps"})

    schema_version: int
    data_version: int
    package_version: str
    id: Annotated[str, Field(pattern=FOLDER)]
    title: str
    scenes: tuple[str, ...]
    epsg: int
    bounds_m: tuple[float, float, float, float]
    bounds_lonlat: tuple[float, float, float, float]
    cell_size_m: float
    rows: int
    cols: int
    classes: tuple[str, ...]
    extract: ExtractRecord
    coverage: CoverageRecord
    counts: dict[str, Count]
    graph_counts: dict[str, Count]
    hidden: dict[str, Count]
    drops: dict[str, Count]
    notes: dict[str, Count]
    warnings: tuple[str, ...]
    fingerprint: str
    inputs_sha256: str
    files: dict[str, FileRecord]
    licence: str
    attribution: str
    imagery: OrthoRecord | None = None
    provenance: Provenance = Provenance()
    own_maps: tuple[OwnMapRecord, ...] = ()

    @property
    def grid(self) -> Grid:
        """Return the region's lattice."""
        return Grid(
            epsg=self.epsg,
            west_m=self.bounds_m[0],
            north_m=self.bounds_m[3],
            cell_size_m=self.cell_size_m,
            rows=self.rows,
            cols=self.cols,
        )

    @property
    def digest(self) -> str:
        """Return the SHA-256 of all that it states, the hashes of the files included."""
        return hashlib.sha256(self.model_dump_json().encode()).hexdigest()

    def of_part(self, grid: Grid) -> Self:
        """Return what describes a part of the map with the grid of that part; all else is about the whole map."""
        return self.model_copy(update={"bounds_m": grid.bounds_m, "rows": grid.rows, "cols": grid.cols})


@dataclass(frozen=True, slots=True, kw_only=True)
class MapGraph:
    """Landmarks of a map and their relations.

    Parameters
    ----------
    nodes : geopandas.GeoDataFrame
        One row per node with the columns of `graph.NODE_DTYPES` and `geometry`, sorted by kind and coordinates, so that
        `id` does not depend on the order of the features. `degree` counts the road ends that meet (and the rail ends at
        a level crossing), 0 elsewhere. `class` and `osm_id` name the feature that carries the node: the upper way at a
        crossing, the way of highest class at a junction; -1 if several do. `level_difference` is the upper level less
        the lower one. `bearing_deg` is the long side of a building in [0, 180), and towards the inside of a bend.
    edges : pandas.DataFrame
        One row per edge with the columns of `graph.EDGE_DTYPES`. Connectivity (along roads, railways and waterways) and
        adjacency have no direction and occur once, from the smaller id; a crossing points to the junctions at the ends
        of its roads, a membership from the building to its cluster. `distance_m` is straight, `length_m` along the way.
    """

    nodes: "gpd.GeoDataFrame"
    edges: "pd.DataFrame"


class Lazy(Generic[Value]):
    """A field of a frozen dataclass that may be given as a function, which is called when the field is first read.

    Examples
    --------
    >>> @dataclass(frozen=True)
    ... class Place:
    ...     height_m: Lazy[float] = Lazy()
    >>> place = Place(lambda: print("reading") or 2.5)
    >>> place.height_m + place.height_m
    reading
    5.0
    """

    def __set_name__(self, owner: type, name: str) -> None:
        self._name = name

    def __get__(self, instance: Any, owner: type) -> Value:  # noqa: ANN401 - of any class
        """Return the value, read now if it was not read before."""
        if instance is None:  # a dataclass asks for the default: there is none
            raise AttributeError(self._name)
        value = vars(instance)[self._name]
        if callable(value):
            value = vars(instance)[self._name] = value()
        return cast("Value", value)

    def __set__(self, instance: Any, value: Value | Callable[[], Value]) -> None:  # noqa: ANN401 - of any class
        vars(instance)[self._name] = value


@dataclass(frozen=True, kw_only=True)
class Region:
    """One mapped place.

    `layers` is uint8 of shape (C, rows, cols), PRESENT, ABSENT or OUTSIDE, bands in the order of `classes`, read-only;
    `coverage` is the mapped area in the region's CRS. `features` and `graph` of a stored region are read when they are
    first asked for, and so may `layers` be: until then `read_layer`, given the number of a class, reads it alone.
    `imagery` reads windows of the aerial imagery; None if there is none. `keep` is asked by `kept`; a region that was
    made of another one, as a part of it, has none.
    """

    manifest: Manifest
    layers: Lazy[NDArray[np.uint8]] = Lazy()
    features: Lazy["gpd.GeoDataFrame"] = Lazy()
    graph: Lazy[MapGraph] = Lazy()
    coverage: shapely.Geometry
    imagery: Imagery | None = None
    read_layer: Callable[[int], NDArray[np.uint8]] | None = None
    keep: Callable[[str, Mapping[str, Any]], Path | None] | None = field(default=None, init=False, compare=False)

    @property
    def grid(self) -> Grid:
        """Return the region's lattice."""
        return self.manifest.grid

    @property
    def classes(self) -> tuple[str, ...]:
        """Return class names in band order."""
        return self.manifest.classes

    def _repr_html_(self) -> str:
        """Return what a notebook shows of a region; nothing more of it is read. `plot` draws it."""
        about = self.manifest
        facts = {
            "map of": about.extract.date,
            "scenes": ", ".join(about.scenes),
            "grid": f"{about.rows} x {about.cols} cells of {about.cell_size_m:g} m, EPSG:{about.epsg}",
            "mapped": about.coverage.to_text(),
            "objects": ", ".join(f"{name} {count:,}" for name, count in about.counts.items() if count),
            "imagery": "none" if about.imagery is None else about.imagery.attribution,
            "data": about.attribution,
            **about.provenance.titled(),
        }
        return html_facts(f"{about.title} ({about.id})", facts)

    def plot(self) -> "Figure":
        """Draw the region in one call; see `sgb.plot_region`."""
        # By its public name: the drawing stands below in the order of files
        return cast("Figure", import_module("sasgeo_bench").plot_region(self))

    def within(self, area: shapely.Geometry) -> "Region":
        """Return the region with no mapped ground beyond an area in its CRS; its layers stay what they are, unread."""
        own = {name: value for name, value in vars(self).items() if name != "keep"}
        return Region(**own | {"coverage": self.coverage.intersection(area)})

    def kept(self, what: str, **settings: Any) -> Path | None:  # noqa: ANN401 - of JSON, as each kind needs
        """Return the folder of what the program itself makes of this map by some settings, and keeps; None without one.

        Whoever is given None makes it.
        """
        return None if self.keep is None else self.keep(what, settings)

    def layer(self, class_name: str) -> NDArray[np.uint8]:
        """Return the raster of one class, shape (rows, cols); no other is read, for a country's take a gigabyte."""
        at = self.classes.index(class_name)
        if self.read_layer is not None and callable(vars(self)["layers"]):  # not read yet
            return self.read_layer(at)
        return np.asarray(self.layers[at])

    def cuts(self, boxes: Sequence[tuple[int, int, int, int]]) -> "list[Region]":
        """Return parts of the map: first row and column, rows and columns of each, which is cut at the map's edge.

        Each has its layers, in memory, and the features, graph and coverage of the whole map. Layers are read one after
        the other, so that a large map is never held whole.

        Parameters
        ----------
        boxes : sequence of tuple of int
            Row, column, rows and columns.
        """
        grid = self.grid
        spans = [
            (max(row, 0), max(col, 0), min(row + rows, grid.rows), min(col + cols, grid.cols))
            for row, col, rows, cols in boxes
        ]
        parts = [np.empty((len(self.classes), end - top, last - left), np.uint8) for top, left, end, last in spans]
        for band, name in enumerate(self.classes):
            layer = self.layer(name)
            for part, (top, left, end, last) in zip(parts, spans, strict=True):
                part[band] = layer[top:end, left:last]
        found = []
        for part, (top, left, end, last) in zip(parts, spans, strict=True):
            part.flags.writeable = False
            manifest = self.manifest.of_part(grid.window(top, left, end - top, last - left))
            found.append(replace(self, manifest=manifest, layers=part, read_layer=None))
        return found

    def known(self) -> NDArray[np.bool_]:
        """Return which cells are mapped in all classes, shape (rows, cols)."""
        known = np.ones(self.grid.shape, dtype=bool)
        for name in self.classes:
            known &= self.layer(name) <= PRESENT
        return known
