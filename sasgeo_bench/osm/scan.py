# SPDX-License-Identifier: Apache-2.0
"""One pass over an OSM file: ways and areas with a key of the taxonomy, and their classes by the rules."""

import datetime as dt
import struct
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from itertools import groupby
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np
import osmium
import shapely

from sasgeo_bench.files.garbage import uncollected
from sasgeo_bench.osm.coverage import find_gaps
from sasgeo_bench.osm.snapshot import elements
from sasgeo_bench.osm.taxonomy import Classification, Label, Taxonomy, classify

LANE_WIDTH_M: Final = 3.25  # between the 2.75 m and 3.75 m lanes of the German RAS-Q 96 cross sections
DEFAULT_BRIDGE_WIDTH_M: Final = 4.0
WIDTH_RANGE_M: Final = (0.3, 80.0)
MIN_RING_POINTS: Final = 3
_NO: Final = (None, "no", "false", "0")
_AREA_MODIFIERS: Final = ("tunnel", "layer", "location", "parking", "width")
_LINE_MODIFIERS: Final = ("tunnel", "layer", "location", "width", "lanes")

# Where the first point lies in the WKB of a line and of a multipolygon's first ring, and readers of N points.
_FIRST_POINT: Final = {2: 9, 6: 22}
_POINT_BYTES: Final = 16
_SEVERAL_LINES: Final = 5  # the type in the WKB of a way that lacks nodes
_COAST: Final = ("natural", "coastline")
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
    every coastline of the file, `gaps` the gaps of ways of a class, by way id.
    """

    rows: list[ScanRow] = field(default_factory=list)
    far: list[bytes] = field(default_factory=list)
    coast: list[bytes] = field(default_factory=list)
    gaps: dict[int, list[shapely.Geometry]] = field(default_factory=dict)
    traits: list[Traits] = field(default_factory=list)
    tally: Tally = field(default_factory=Tally)


class Classifier:
    """Apply the rules to the tags of one object; rules run once for each distinct set of values."""

    def __init__(self, taxonomy: Taxonomy, scan: Scan) -> None:
        self._taxonomy = taxonomy
        self._scan = scan
        self._line_keys, self._area_keys = taxonomy.keys_of("line"), taxonomy.keys_of("area")
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
            return self.as_line(get).line
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
        hidden_by=_hidden_by(tags, level=level, is_tunnel=is_tunnel),
        width_m=tagged_width_m(tags.get("width"), tags.get("lanes")),
    )


def _hidden_by(tags: dict[str, str], *, level: int, is_tunnel: bool) -> str | None:
    """Return the reason why an object is not visible from above, or None."""
    if is_tunnel:
        return f"tunnel={tags['tunnel']}"
    if level < 0:
        return "layer < 0"
    return next((f"{key}=underground" for key in ("location", "parking") if tags.get(key) == "underground"), None)


def _integer(text: str | None) -> int:
    """Parse the OSM layer; a value that is no whole number within -20..20 counts as 0, as in renderers."""
    try:
        value = int(text or 0)
    except ValueError:
        return 0
    return value if abs(value) <= 20 else 0  # noqa: PLR2004 - far beyond the -5..5 that the OSM wiki allows


def tagged_width_m(width: str | None, lanes: str | None) -> float | None:
    """Return the width in metres from the tags `width` ("6", "6.5 m", "6,5") and `lanes`, or None.

    >>> tagged_width_m("6.5 m", "2"), tagged_width_m(None, "2"), tagged_width_m("wide", None)
    (6.5, 6.5, None)
    """
    low, high = WIDTH_RANGE_M
    for text, unit_m in ((width, 1.0), (lanes, LANE_WIDTH_M)):
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


def scan_file(path: Path, taxonomy: Taxonomy, *, box: Box) -> Scan:
    """Read every way and area that carries a key of the taxonomy and may reach into a box.

    `path` is a sorted OSM file with one state of the world (`open_snapshot`); `box` is west, south, east, north,
    degrees. Objects certainly outside it are neither classified nor counted; `Scan.tally` counts all others that are
    not used, by reason. osmium raises `RuntimeError` on a damaged file, which `open_snapshot` turns into an
    `ExtractError`.
    """
    scan = Scan()
    classifier = Classifier(taxonomy, scan)
    expected = _survey(path, taxonomy, classifier, scan.tally)
    assembled: set[int] = set()
    with uncollected():
        for item in _ways_and_areas(path, taxonomy):
            if not item.is_area():
                _scan_way(item, scan, classifier, expected.ways, box)
            elif _scan_area(item, scan, classifier, box):  # an area without a ring stays among the lost
                if item.from_way():
                    assembled.add(item.orig_id())
                else:
                    expected.relations.pop(item.orig_id(), None)
    for identifier in [key for key, item in expected.relations.items() if item.is_building]:
        if assembled.intersection(expected.relations[identifier].outer):
            del expected.relations[identifier]
            scan.tally.drops["building relation whose outline is a building itself"] += 1
    lost = expected.ways - assembled
    if lost or expected.relations:
        _scan_lost(path, lost, expected.relations, scan, classifier)
    return scan


def _ways_and_areas(path: Path, taxonomy: Taxonomy) -> Iterator[Any]:
    """Yield ways with a key of lines and all areas, in one pass; filters and assembly of areas run in C++."""
    with_key = osmium.filter.KeyFilter(*taxonomy.keys)
    processor = osmium.FileProcessor(str(path)).with_locations().with_areas(with_key)
    kinds = osmium.filter.EntityFilter(osmium.osm.WAY | osmium.osm.AREA)
    lines = osmium.filter.KeyFilter(*taxonomy.keys_of("line"))
    lines.enable_for(osmium.osm.WAY)
    return elements(processor.with_filter(kinds).with_filter(with_key).with_filter(lines))


@dataclass(frozen=True, slots=True, kw_only=True)
class _Relation:
    """An area relation before it is assembled: its labels and its member ways by role."""

    labels: tuple[Label, ...]
    tags: dict[str, str]
    version: int
    timestamp: Any
    outer: tuple[int, ...]
    inner: tuple[int, ...]
    is_building: bool


@dataclass(slots=True)
class _Expected:
    """Closed ways and relations that carry an area class; what osmium assembles is removed again."""

    ways: set[int] = field(default_factory=set)
    relations: dict[int, _Relation] = field(default_factory=dict)


def _survey(path: Path, taxonomy: Taxonomy, classifier: Classifier, tally: Tally) -> _Expected:
    """List the objects that should become areas: the main pass sees only those that did."""
    line_keys = taxonomy.keys_of("line")
    area_keys = tuple(key for key in taxonomy.keys_of("area") if key not in line_keys)
    keyed, typed = osmium.filter.KeyFilter(*area_keys), osmium.filter.KeyFilter("type")
    keyed.enable_for(osmium.osm.WAY)
    typed.enable_for(osmium.osm.RELATION)
    expected = _Expected()
    source = osmium.FileProcessor(str(path), osmium.osm.WAY | osmium.osm.RELATION)
    for item in elements(source.with_filter(keyed).with_filter(typed)):
        if item.is_relation():
            relation = _area_relation(item, classifier)
            if relation is not None:
                expected.relations[item.id] = relation
        elif item.is_closed():
            expected.ways.add(item.id)
        elif not any(key in item.tags for key in line_keys):
            key = next(key for key in area_keys if key in item.tags)
            tally.drops[f"open way with the area key {key!r}, anywhere in the extract"] += 1
    return expected


def _scan_way(way: Any, scan: Scan, classifier: Classifier, closed: set[int], box: Box) -> None:  # noqa: ANN401
    """Take a way as a line if a line rule holds; remember it if an area of it must follow."""
    get, wkb = way.tags.get, line_wkb(way, scan.tally)
    if (wkb is None or wkb[1] == _SEVERAL_LINES) and classifier.as_line(get).line:
        scan.gaps[way.id] = find_gaps(way)
    if wkb is None:
        return
    if get(_COAST[0]) == _COAST[1]:
        scan.coast.append(wkb)
    if not reaches(wkb, box):
        scan.far.append(wkb)
        return
    found = classifier.as_line(get)
    if way.is_closed():
        area_tag = get("area")
        has_area_class = bool(classifier.as_area(get).area)
        if area_tag != "no" and (has_area_class or (area_tag == "yes" and found.line)):
            closed.add(way.id)
        if area_tag == "yes" and not has_area_class:
            return  # filled, not drawn along its outline
    elif not found.line:
        reasons = [f"no rule for {text}" for text in found.unknown] or ["open way with an area class"]
        scan.tally.drops.update(reasons)
    if found.line:
        kind = classifier.kind(get, found.line, is_area=False)
        scan.rows.append(ScanRow(wkb, kind, way.id, False, way.version, way.timestamp))  # noqa: FBT003
    else:
        scan.far.append(wkb)


def _scan_area(area: Any, scan: Scan, classifier: Classifier, box: Box) -> bool:  # noqa: ANN401
    """Take an assembled area; return False if osmium gives one without a ring."""
    try:
        wkb = bytes.fromhex(_FACTORY.create_multipolygon(area))
    except RuntimeError:  # osmium's geometry_error: the rings were too broken to assemble
        return False
    if not reaches(wkb, box):
        scan.far.append(wkb)
        return True
    get = area.tags.get
    is_relation = not area.from_way()
    labels = classifier.area_labels(get, is_relation=is_relation)
    if labels:
        kind = classifier.kind(get, labels, is_area=True)
        scan.rows.append(ScanRow(wkb, kind, area.orig_id(), is_relation, area.version, area.timestamp))
        return True
    scan.far.append(wkb)
    if not classifier.as_line(get).line:
        scan.tally.drops.update(f"no rule for {text}" for text in classifier.as_area(get).unknown)
    return True


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


def _area_relation(item: Any, classifier: Classifier) -> _Relation | None:  # noqa: ANN401
    """Return a relation that should become an area: a multipolygon, or type=building, which osmium ignores."""
    kind = item.tags.get("type")
    if kind not in ("multipolygon", "building"):
        return None
    tags = dict(item.tags)
    if kind == "building":
        tags.setdefault("building", "yes")
    labels = classifier.area_labels(tags.get, is_relation=True)
    if not labels:
        return None
    ways = [(member.role, member.ref) for member in item.members if member.type == "w"]
    return _Relation(
        labels=labels,
        tags=tags,
        version=item.version,
        timestamp=item.timestamp,
        outer=tuple(ref for role, ref in ways if role in ("outer", "outline", "")),
        inner=tuple(ref for role, ref in ways if role == "inner"),
        is_building=kind == "building",
    )


def _scan_lost(
    path: Path, closed: set[int], relations: dict[int, _Relation], scan: Scan, classifier: Classifier
) -> None:
    """Repair what osmium could not assemble: rings that lack nodes or cross themselves, relations cut at an edge."""
    members = {ref for relation in relations.values() for ref in (*relation.outer, *relation.inner)}
    lines: dict[int, shapely.Geometry] = {}
    ways = osmium.FileProcessor(str(path)).with_locations().with_filter(osmium.filter.EntityFilter(osmium.osm.WAY))
    for way in elements(ways.with_filter(osmium.filter.IdFilter(closed | members))):
        wkb = line_wkb(way, scan.tally)
        get = way.tags.get
        labels = classifier.area_labels(get, is_relation=False)
        if (wkb is None or wkb[1] == _SEVERAL_LINES) and (labels or way.id in members):
            scan.gaps[way.id] = find_gaps(way)
        if wkb is None:
            continue
        lines[way.id] = shapely.from_wkb(wkb)
        if way.id in closed and get("area") == "no":
            scan.tally.drops["area=no on an area class"] += 1
        elif way.id in closed and labels:
            area = _ring_area(lines[way.id])
            _add_mended(
                scan, way, area, classifier.kind(get, labels, is_area=True), what="closed way", identifier=way.id
            )
    for identifier, relation in sorted(relations.items()):
        area = _relation_area(relation, lines)
        kind = classifier.kind(relation.tags.get, relation.labels, is_area=True)
        _add_mended(scan, relation, area, kind, what="relation", identifier=identifier)


def _add_mended(
    scan: Scan,
    item: Any,  # noqa: ANN401 - an osmium way or a _Relation: what has a version and a timestamp
    area: shapely.Geometry,
    kind: int,
    *,
    what: str,
    identifier: int,
) -> None:
    is_relation = what == "relation"
    if shapely.area(area) == 0.0:
        scan.tally.drops[f"{what} with no closed ring left"] += 1
        return
    if not (is_relation and item.is_building):
        scan.tally.notes[f"{what} broken or cut at the clip edge: its closed rings were kept"] += 1
    scan.rows.append(ScanRow(bytes(shapely.to_wkb(area)), kind, identifier, is_relation, item.version, item.timestamp))


def _ring_area(line: shapely.Geometry) -> shapely.Geometry:
    """Return the area within a closed way; missing nodes are bridged, a ring that crosses itself is split."""
    coordinates = shapely.get_coordinates(line)
    if len(np.unique(coordinates, axis=0)) < MIN_RING_POINTS:
        return shapely.Polygon()
    return _polygons_of(shapely.make_valid(shapely.polygons(shapely.linearrings(coordinates))))


def _relation_area(relation: _Relation, lines: dict[int, shapely.Geometry]) -> shapely.Geometry:
    """Return closed outer rings less closed inner rings, from the member ways that are present."""
    outer, inner = (
        shapely.union_all(shapely.get_parts(shapely.polygonize([lines[ref] for ref in refs if ref in lines])))
        for refs in (relation.outer, relation.inner)
    )
    return _polygons_of(shapely.make_valid(shapely.difference(outer, inner)))


def _polygons_of(geometry: shapely.Geometry) -> shapely.Geometry:
    parts = shapely.get_parts(shapely.get_parts(geometry))
    return shapely.MultiPolygon([part for part in parts if part.geom_type == "Polygon"])
