# SPDX-License-Identifier: Apache-2.0
"""What a pass over map data finds: rows of ways and areas, their classes by the rules, and their geometry."""

import datetime as dt
import struct
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from itertools import groupby
from typing import Any, Final, NamedTuple

import osmium
import shapely

from sasgeo_bench.osm.multipolygons import Kind, Tags, kind_keys
from sasgeo_bench.osm.taxonomy import Classification, Label, Taxonomy, classify, load_taxonomy

DEFAULT_BRIDGE_WIDTH_M: Final = 4.0
WIDTH_RANGE_M: Final = (0.3, 80.0)
_OF_YARDS: Final = ("landuse", "amenity", "leisure", "name")  # a barrier that has one of these goes around something
_NO: Final = (None, "no", "false", "0")
_HIDING: Final = ("tunnel", "layer", "location", "covered", "indoor", "cutting")
_AREA_MODIFIERS: Final = (*_HIDING, "parking", "width")
_LINE_MODIFIERS: Final = (*_HIDING, "width", "lanes")
BUILT_UP: Final = ("residential", "commercial", "retail", "industrial", "garages")  # values of landuse without a class
_ROOFED: Final = load_taxonomy().having("roofed")
_OPEN: Final = load_taxonomy().having("open")  # with layer=-1 they lie below bridges, in the open

# Where the first point lies in the WKB of a line and of a multipolygon's first ring, and readers of N points.
_FIRST_POINT: Final = {2: 9, 6: 22}
_POINT_BYTES: Final = 16
SEVERAL_LINES: Final = 5  # the type in the WKB of a way that lacks nodes
_POINTS: Final = tuple(struct.Struct(f"<{2 * count}d") for count in range(40))

Get = Callable[[str], str | None]
Box = tuple[float, float, float, float]
_NOWHERE: Final = 2**31 - 1  # coordinate of a missing node in osmium
_FACTORY: Final = osmium.geom.WKBFactory()


@dataclass(frozen=True, slots=True, kw_only=True)
class Traits:
    """Properties from an object's tags; `width_m` is a tagged width, None if only the class default is known."""

    labels: tuple[Label, ...]
    is_area: bool
    level: int
    is_bridge: bool
    is_tunnel: bool
    hidden_by: str | None
    width_m: float | None


@dataclass(slots=True)
class Tally:
    """Counts by reason: objects not used, objects not visible from above, values not understood."""

    drops: Counter[str] = field(default_factory=Counter)
    hidden: Counter[str] = field(default_factory=Counter)
    notes: Counter[str] = field(default_factory=Counter)


class ScanRow(NamedTuple):
    """One object and geometry: WKB (lon/lat), its index into `Scan.traits`, and its OSM identity."""

    wkb: bytes
    kind: int
    osm_id: int
    is_relation: bool
    version: int
    timestamp: dt.datetime


@dataclass(slots=True)
class Scan:
    """Result of one pass: a row for each object, the distinct traits they share, and what was not used.

    `far` holds geometry outside the requested box or without a class: it still shows what is mapped. `coast` holds
    every coastline of the file, `gaps` the gaps of ways of a class, by way id, `built_up` the areas near the box whose
    landuse says that people live or work there.
    """

    rows: list[ScanRow] = field(default_factory=list)
    far: list[bytes] = field(default_factory=list)
    coast: list[bytes] = field(default_factory=list)
    gaps: dict[int, list[shapely.Geometry]] = field(default_factory=dict)
    built_up: list[bytes] = field(default_factory=list)
    traits: list[Traits] = field(default_factory=list)
    tally: Tally = field(default_factory=Tally)


class Classifier:
    """Apply the rules to the tags of one object; rules run once for each distinct set of values."""

    def __init__(self, taxonomy: Taxonomy, scan: Scan) -> None:
        self._taxonomy = taxonomy
        self._scan = scan
        self._line_keys, self._area_keys = taxonomy.keys_of("line"), taxonomy.keys_of("area")
        self.kind_keys = kind_keys(taxonomy.keys)
        self._lines: dict[tuple[str | None, ...], Classification] = {}
        self._areas: dict[tuple[str | None, ...], Classification] = {}
        self._kinds: dict[tuple[object, ...], int] = {}

    def as_line(self, get: Get) -> Classification:
        """Classify by the keys that line rules read."""
        values = tuple(map(get, self._line_keys))
        return self._lines.get(values) or self._classify(self._line_keys, values, self._lines)

    def as_area(self, get: Get) -> Classification:
        """Classify by the keys that area rules read."""
        values = tuple(map(get, self._area_keys))
        return self._areas.get(values) or self._classify(self._area_keys, values, self._areas)

    def _classify(
        self, keys: tuple[str, ...], values: tuple[str | None, ...], known: dict[tuple[str | None, ...], Classification]
    ) -> Classification:
        tags = {key: value for key, value in zip(keys, values, strict=True) if value is not None}
        return known.setdefault(values, classify(tags, self._taxonomy))

    def area_labels(self, get: Get, *, is_relation: bool) -> tuple[Label, ...]:
        """Return the labels of an area by area rules and by line rules, filled if the rule says so, else outlines."""
        labels = self.as_area(get).area
        if not labels and get("area") == "yes":
            is_yard = any(get(key) for key in _OF_YARDS)
            line = self.as_line(get).line
            return tuple(replace(label, is_outline=is_yard and label.fills_to_m is not None) for label in line)
        if not is_relation and not any(label.is_outline for label in labels):
            return labels
        line = self.as_line(get).line
        # A fenced field: the fence is the boundary, its outline is not drawn a second time.
        drawn = {label.class_name for label in line if not (is_relation and label.is_filled)}
        kept = tuple(label for label in labels if not (label.is_outline and label.class_name in drawn))
        if not is_relation:
            return kept  # a closed way is read as a line too; of a relation there is no other line
        along = (replace(label, is_outline=not label.is_filled) for label in line)
        return (*kept, *(label for label in along if label.is_outline or not labels))

    def as_outer_way(self, tags: Tags) -> Kind:
        """Return what an outer way of a multipolygon would be as a closed way by itself."""
        labels = () if tags.get("area") == "no" else self.area_labels(tags.get, is_relation=False)
        return Kind(labels, _traits(tags, labels, is_area=True).hidden_by)

    def kind(self, get: Get, labels: tuple[Label, ...], *, is_area: bool) -> int:
        """Return the index of the object's traits in `Scan.traits`; count objects hidden from above."""
        keys = _AREA_MODIFIERS if is_area else _LINE_MODIFIERS
        modifiers = tuple(map(get, keys))
        signature = (labels, is_area, modifiers)
        index = self._kinds.get(signature)
        if index is None:
            index = self._kinds[signature] = len(self._scan.traits)
            tags = {key: value for key, value in zip(keys, modifiers, strict=True) if value is not None}
            self._scan.traits.append(_traits(tags, labels, is_area=is_area))
        hidden_by = self._scan.traits[index].hidden_by
        if hidden_by is not None:
            self._scan.tally.hidden[hidden_by] += 1
        return index


def _traits(tags: dict[str, str], labels: tuple[Label, ...], *, is_area: bool) -> Traits:
    level = _integer(tags.get("layer"))
    is_tunnel = tags.get("tunnel") not in _NO
    return Traits(
        labels=labels,
        is_area=is_area,
        level=level,
        is_bridge=any(label.class_name == "bridge" for label in labels),
        is_tunnel=is_tunnel,
        hidden_by=_hidden_by(tags, {label.class_name for label in labels}, level=level),
        width_m=tagged_width_m(tags.get("width"), tags.get("lanes")),
    )


def _hidden_by(tags: dict[str, str], classes: set[str], *, level: int) -> str | None:
    """Return the reason why an object is not visible from above, or None."""
    # Water below the level of the ground is open to the sky, and so is what lies in a cutting. A building or a
    # bridge is not hidden by its own roof.
    if tags.get("tunnel") not in _NO:
        return f"tunnel={tags['tunnel']}"
    for key in ("location", "parking"):
        if tags.get(key) == "underground":
            return f"{key}=underground"
    for key in ("covered", "indoor"):
        if tags.get(key) not in _NO and classes.isdisjoint(_ROOFED):
            return f"{key}={tags[key]}"
    if tags.get("location") == "indoor":
        return "location=indoor"
    is_open = not classes.isdisjoint(_OPEN) or tags.get("cutting") not in _NO
    return "layer < 0" if level < 0 and not is_open else None


def _integer(text: str | None) -> int:
    """Parse the OSM layer; a value that is no whole number within -20..20 counts as 0, as in renderers."""
    try:
        value = int(text or 0)
    except ValueError:
        return 0
    return value if abs(value) <= 20 else 0  # far beyond the -5..5 that the OSM wiki allows


def tagged_width_m(width: str | None, lanes: str | None) -> float | None:
    """Return the width in metres from the tags `width` ("6", "6.5 m", "6,5") and `lanes`, or None.

    >>> tagged_width_m("6.5 m", "2"), tagged_width_m(None, "2"), tagged_width_m("wide", None)
    (6.5, 6.5, None)
    """
    low, high = WIDTH_RANGE_M
    # 3.25 m: lane width between the 2.75 m and 3.75 m lanes of the German RAS-Q 96 cross sections
    for text, unit_m in ((width, 1.0), (lanes, 3.25)):
        try:
            value = float((text or "").removesuffix("m").strip().replace(",", ".")) * unit_m
        except ValueError:
            continue
        if low <= value <= high:
            return value
    return None


def reaches(wkb: bytes, box: Box) -> bool:
    """Return whether a geometry may reach into a box: exact for short lines and polygons of one ring, else True.

    Most objects of an extract are short and lie far from the region; their tags need not be read.

    >>> line = bytes(shapely.to_wkb(shapely.linestrings([(9.0, 47.0), (9.1, 47.1)])))
    >>> reaches(line, (9.05, 47.0, 9.2, 47.2)), reaches(line, (9.2, 47.0, 9.3, 47.2))
    (True, False)
    """
    start = _FIRST_POINT.get(wkb[1])
    count, rest = divmod(len(wkb) - (start or 0), _POINT_BYTES)
    if start is None or rest or not 0 < count < len(_POINTS):
        return True  # long, or with the headers of further rings between the points
    values: tuple[float, ...] = _POINTS[count].unpack_from(wkb, start)
    west, south, east, north = box
    longitudes, latitudes = values[0::2], values[1::2]
    return max(longitudes) >= west and min(longitudes) <= east and max(latitudes) >= south and min(latitudes) <= north


def line_wkb(way: Any, tally: Tally) -> bytes | None:  # noqa: ANN401
    """Return the WKB of a way; of the remaining pieces if nodes are missing, None if nothing remains."""
    try:
        return bytes.fromhex(_FACTORY.create_linestring(way))
    except osmium.InvalidLocationError:
        pieces = _pieces(way, tally)
    except RuntimeError:  # osmium's geometry_error: fewer than two different points
        tally.drops["way with fewer than two different nodes"] += 1
        return None
    if not pieces:
        tally.drops["way whose nodes are missing from the extract"] += 1
        return None
    tally.notes["way with nodes missing: the rest was kept"] += 1
    return bytes(shapely.to_wkb(shapely.multilinestrings([shapely.linestrings(piece) for piece in pieces])))


def _pieces(way: Any, tally: Tally) -> list[list[tuple[float, float]]]:  # noqa: ANN401
    """Return runs of at least two present nodes, as longitude and latitude; count nodes at impossible places."""
    impossible = sum(not node.location.valid() and node.location.x != _NOWHERE for node in way.nodes)
    if impossible:
        tally.drops["node beyond 180 degrees east or 90 degrees north, taken out of a way"] += impossible
    nodes = [(node.lon, node.lat) if node.location.valid() else None for node in way.nodes]
    runs = (list(run) for is_there, run in groupby(nodes, key=lambda node: node is not None) if is_there)
    return [[node for node in run if node is not None] for run in runs if len(set(run)) > 1]


def area_wkb(area: Any) -> bytes | None:  # noqa: ANN401
    """Return the WKB of an area, None if its rings were too broken to assemble."""
    try:
        return bytes.fromhex(_FACTORY.create_multipolygon(area))
    except RuntimeError:  # osmium's geometry_error
        return None
