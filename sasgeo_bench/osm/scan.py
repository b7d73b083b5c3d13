# SPDX-License-Identifier: Apache-2.0
"""What a pass over map data finds: rows of ways and areas, their classes by the rules, and their geometry."""

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

from sasgeo_bench.core.folders import uncollected
from sasgeo_bench.osm.coverage import find_gaps
from sasgeo_bench.osm.multipolygons import (
    Kind,
    Member,
    Relation,
    Tags,
    adopt_tags,
    area_relation,
    kind_keys,
    mended_area,
    mended_ring,
    polygons_of,
    roles_by_place,
)
from sasgeo_bench.osm.snapshot import elements
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
    landuse says that people live or work there. `nodes` holds the places of the nodes of an OSM file.
    """

    rows: list[ScanRow] = field(default_factory=list)
    far: list[bytes] = field(default_factory=list)
    coast: list[bytes] = field(default_factory=list)
    gaps: dict[int, list[shapely.Geometry]] = field(default_factory=dict)
    built_up: list[bytes] = field(default_factory=list)
    traits: list[Traits] = field(default_factory=list)
    tally: Tally = field(default_factory=Tally)
    nodes: osmium.index.LocationTable = field(default_factory=lambda: osmium.index.create_map("flex_mem"))

    def locator(self) -> osmium.NodeLocationsForWays:
        """Return what gives ways the places of their nodes, which are read once: they are most of a file."""
        locator = osmium.NodeLocationsForWays(self.nodes)
        locator.ignore_errors()  # of nodes that the file lacks
        return locator


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


def joined_wkb(way: Any) -> bytes | None:  # noqa: ANN401
    """Return the WKB of a way straight over its gaps, closed if the way is; None of fewer than two different nodes."""
    try:
        return bytes.fromhex(_FACTORY.create_linestring(way))
    except osmium.InvalidLocationError:
        places = [(node.lon, node.lat) for node in way.nodes if node.location.valid()]
    except RuntimeError:  # osmium's geometry_error: fewer than two different points
        return None
    places += places[:1] if way.is_closed() and places and places[0] != places[-1] else []
    return bytes(shapely.to_wkb(shapely.linestrings(places))) if len(set(places)) > 1 else None


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


_COAST: Final = ("natural", "coastline")


def scan_file(path: Path, taxonomy: Taxonomy, *, box: Box) -> Scan:
    """Read every way and area that carries a key of the taxonomy and may reach into a box.

    `path` is a sorted OSM file with one state of the world (`open_snapshot`); `box` is west, south, east, north,
    degrees. Objects certainly outside it are neither classified nor counted; `Scan.tally` counts all others that are
    not used, by reason. Multipolygons of the old style take the tags of their outer ways (`multipolygons`). osmium
    raises `RuntimeError` on a damaged file, which `open_snapshot` turns into an `ExtractError`.
    """
    scan = Scan()
    classifier = Classifier(taxonomy, scan)
    expected = _survey(path, taxonomy, classifier)
    ways: set[int] = set()
    relations: set[int] = set()
    with uncollected():
        for item in _ways_and_areas(path, taxonomy, scan.nodes):
            if not item.is_area():
                _scan_way(item, scan, classifier, expected, box)
            elif _scan_area(item, scan, classifier, box):  # an area without a ring stays among the lost
                (ways if item.from_way() else relations).add(item.orig_id())
    lost = _lost(expected, ways, relations, scan.tally)
    if lost.ways or lost.relations:
        _LostPass(scan=scan, classifier=classifier, lost=lost, box=box).read(path)
    taken = _count_once(scan, {**expected.relations, **lost.relations})
    scan.tally.drops.update(reason for ref, reasons in expected.open.items() if ref not in taken for reason in reasons)
    return scan


def _ways_and_areas(path: Path, taxonomy: Taxonomy, nodes: osmium.index.LocationTable) -> Iterator[Any]:
    """Yield ways with a key of lines and all areas, in one pass; filters and assembly of areas run in C++."""
    with_key = osmium.filter.KeyFilter(*taxonomy.keys)
    processor = osmium.FileProcessor(str(path)).with_locations(nodes).with_areas(with_key)  # type: ignore[arg-type] # it takes a table, too
    kinds = osmium.filter.EntityFilter(osmium.osm.WAY | osmium.osm.AREA)
    lines = osmium.filter.KeyFilter(*taxonomy.keys_of("line"))
    lines.enable_for(osmium.osm.WAY)
    return elements(processor.with_filter(kinds).with_filter(with_key).with_filter(lines))


@dataclass(slots=True)
class _Expected:
    """Closed ways and relations that should become areas; why open ways with a key of areas are none.

    `bare` are the outer ways of relations of the old style; `open` holds those with a class too.
    """

    ways: set[int] = field(default_factory=set)
    relations: dict[int, Relation] = field(default_factory=dict)
    open: dict[int, tuple[str, ...]] = field(default_factory=dict)
    bare: set[int] = field(default_factory=set)


def _survey(path: Path, taxonomy: Taxonomy, classifier: Classifier) -> _Expected:
    """List the objects that should become areas: the main pass sees only those that did."""
    line_keys = taxonomy.keys_of("line")
    area_keys = tuple(key for key in taxonomy.keys_of("area") if key not in line_keys)
    keyed, typed = osmium.filter.KeyFilter(*area_keys), osmium.filter.KeyFilter("type")
    keyed.enable_for(osmium.osm.WAY)
    typed.enable_for(osmium.osm.RELATION)
    expected = _Expected()

    def labels_of(tags: Tags) -> tuple[Label, ...]:
        return classifier.area_labels(tags.get, is_relation=True)

    source = osmium.FileProcessor(str(path), osmium.osm.WAY | osmium.osm.RELATION)
    for item in elements(source.with_filter(keyed).with_filter(typed)):
        if item.is_relation():
            relation = area_relation(item, labels_of, classifier.kind_keys)
            if relation is not None:
                expected.relations[item.id] = relation
                if relation.is_old_style:
                    expected.bare.update(relation.outer)
        elif item.is_closed():
            expected.ways.add(item.id)
        elif not any(key in item.tags for key in line_keys):
            key = next(key for key in area_keys if key in item.tags)
            expected.open[item.id] = (f"open way with the area key {key!r}, anywhere in the extract",)
    return expected


def _lost(expected: _Expected, ways: set[int], relations: set[int], tally: Tally) -> _Expected:
    """Return what osmium did not assemble, and relations of the old style of which an outer way may have a class."""
    lost = _Expected(ways=expected.ways - ways)
    for identifier, relation in expected.relations.items():
        if identifier in relations:
            continue
        if relation.is_building and not ways.isdisjoint(relation.outer):
            tally.drops["building relation whose outline is a building itself"] += 1
        elif relation.labels or any(ref in ways or ref in lost.ways or ref in expected.open for ref in relation.outer):
            lost.relations[identifier] = relation
    return lost


def _scan_way(way: Any, scan: Scan, classifier: Classifier, expected: _Expected, box: Box) -> None:  # noqa: ANN401
    """Take a way as a line if a line rule holds; remember it if an area of it must follow."""
    get, wkb = way.tags.get, line_wkb(way, scan.tally)
    if way.id in expected.bare and classifier.area_labels(get, is_relation=False):
        expected.open[way.id] = ()
    if (wkb is None or wkb[1] == SEVERAL_LINES) and classifier.as_line(get).line:
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
        if _is_filled(way, bool(found.line), classifier, expected):
            return
    elif not found.line:
        reasons = [f"no rule for {text}" for text in found.unknown] or ["open way with an area class"]
        expected.open[way.id] = tuple(reasons)
    if found.line:
        kind = classifier.kind(get, found.line, is_area=False)
        scan.rows.append(ScanRow(wkb, kind, way.id, False, way.version, way.timestamp))  # noqa: FBT003
    else:
        scan.far.append(wkb)


def _is_filled(way: Any, has_line_class: bool, classifier: Classifier, expected: _Expected) -> bool:  # noqa: ANN401, FBT001
    """Return whether a closed way is filled and not drawn along its outline; remember it if an area must follow."""
    area_tag = way.tags.get("area")
    has_area_class = bool(classifier.as_area(way.tags.get).area)
    if area_tag != "no" and (has_area_class or (area_tag == "yes" and has_line_class)):
        expected.ways.add(way.id)
    return area_tag == "yes" and not has_area_class


def _scan_area(area: Any, scan: Scan, classifier: Classifier, box: Box) -> bool:  # noqa: ANN401
    """Take an assembled area; return False if osmium gives one without a ring."""
    wkb = area_wkb(area)
    if wkb is None:
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
    if get("landuse") in BUILT_UP:
        scan.built_up.append(wkb)
    if not classifier.as_line(get).line:
        scan.tally.drops.update(f"no rule for {text}" for text in classifier.as_area(get).unknown)
    return True


@dataclass(kw_only=True)
class _LostPass:
    """Read again what osmium did not make areas: cut at an edge, broken, or of the old style."""

    scan: Scan
    classifier: Classifier
    lost: _Expected
    box: Box
    members: dict[int, Member] = field(default_factory=dict)
    lines: dict[int, shapely.Geometry] = field(default_factory=dict)
    gaps: dict[int, list[shapely.Geometry]] = field(default_factory=dict)
    areas: dict[int, bytes | None] = field(default_factory=dict)

    def read(self, path: Path) -> None:
        """Read the file once, and add what can be mended or takes its tags from outer ways."""
        relations = self.lost.relations
        bare = {identifier for identifier, relation in relations.items() if not relation.labels}
        cut = {ref for key in relations.keys() - bare for ref in relations[key].ways}
        everything = self.lost.ways | cut | {ref for key in bare for ref in relations[key].ways}
        for item in _ways_and_relations(path, everything, bare, self.scan):
            if not item.is_area():
                self._read_way(item, is_cut=item.id in cut)
            else:
                self.areas[item.orig_id()] = area_wkb(item)
        relations.update({identifier: self._adopt(relations[identifier], identifier) for identifier in bare})
        self._join(sorted(bare))
        for identifier, relation in sorted(relations.items()):
            self._add(identifier, relation)

    def _read_way(self, way: Any, *, is_cut: bool) -> None:  # noqa: ANN401
        scan, get, is_lost = self.scan, way.tags.get, way.id in self.lost.ways
        wkb = line_wkb(way, scan.tally if is_cut or is_lost else Tally())
        labels = self.classifier.area_labels(get, is_relation=False)
        self.members[way.id] = Member(tags=dict(way.tags), is_closed=way.is_closed())
        if wkb is None or wkb[1] == SEVERAL_LINES:
            marks = scan.gaps if is_cut or (is_lost and labels) else self.gaps
            marks[way.id] = find_gaps(way)
            wkb = joined_wkb(way)  # an area goes on across a gap
        if wkb is None:
            return
        line = self.lines[way.id] = shapely.from_wkb(wkb)
        if is_lost and get("area") == "no":
            scan.tally.drops["area=no on an area class"] += 1
        elif is_lost and labels:
            kind = self.classifier.kind(get, labels, is_area=True)
            _add_mended(scan, way, mended_ring(line), kind, what="closed way", identifier=way.id)

    def _adopt(self, relation: Relation, identifier: int) -> Relation:
        """Return a relation of the old style with the tags of its outer ways; without labels if they do not agree."""
        wkb = self.areas.get(identifier)
        if wkb is not None:
            relation = roles_by_place(relation, shapely.from_wkb(wkb), self.lines)
        return adopt_tags(relation, self.members, self.classifier.as_outer_way, self.classifier.kind_keys)

    def _join(self, bare: list[int]) -> None:
        """Make one area of relations of the old style that cut different holes out of the same outer ways."""
        firsts: dict[frozenset[int], int] = {}
        for identifier in bare:
            relation, wkb = self.lost.relations[identifier], self.areas.get(identifier)
            first = firsts.setdefault(frozenset(relation.outer), identifier) if relation.labels else identifier
            whole = self.areas.get(first)
            if first == identifier or wkb is None or whole is None:
                continue
            self.areas[first] = bytes(
                shapely.to_wkb(polygons_of(shapely.intersection(*shapely.from_wkb([whole, wkb]))))
            )
            joined = self.lost.relations[first]
            self.lost.relations[first] = replace(joined, taken=(*joined.taken, *relation.taken))
            self.lost.relations[identifier] = replace(relation, labels=())

    def _add(self, identifier: int, relation: Relation) -> None:
        scan, wkb = self.scan, self.areas.get(identifier)
        if not relation.labels:
            return
        if wkb is not None and not reaches(wkb, self.box):
            scan.far.append(wkb)
            return
        scan.gaps.update({ref: self.gaps[ref] for ref in relation.ways if ref in self.gaps})
        kind = self.classifier.kind(relation.tags.get, relation.labels, is_area=True)
        if wkb is None:
            area = mended_area(relation, self.lines)
            _add_mended(scan, relation, area, kind, what="relation", identifier=identifier)
        else:
            scan.rows.append(ScanRow(wkb, kind, identifier, True, relation.version, relation.timestamp))  # noqa: FBT003
        if relation.is_old_style:
            scan.tally.notes["multipolygon of the old style: it has the tags of its outer ways"] += 1


def _ways_and_relations(path: Path, ways: set[int], relations: set[int], scan: Scan) -> Iterator[Any]:
    """Yield ways by id, and the areas of relations by id: osmium assembles areas only if there are any."""
    if not relations:
        processor = osmium.FileProcessor(str(path), osmium.osm.WAY)
        return elements(processor.with_filter(_of_ids("way", ways)).with_filter(scan.locator()))
    processor = osmium.FileProcessor(str(path)).with_locations().with_areas(_of_ids("relation", relations))
    kinds = osmium.filter.EntityFilter(osmium.osm.WAY | osmium.osm.AREA)
    areas = {(2 * abs(identifier) + 1) * (1 if identifier > 0 else -1) for identifier in relations}
    return elements(processor.with_filter(kinds).with_filter(_of_ids("way", ways)).with_filter(_of_ids("area", areas)))


def _of_ids(kind: str, ids: set[int]) -> Any:  # noqa: ANN401
    of_ids = osmium.filter.IdFilter(ids)
    of_ids.enable_for(getattr(osmium.osm, kind.upper()))
    return of_ids


def _add_mended(
    scan: Scan,
    item: Any,  # noqa: ANN401 - an osmium way or a Relation: what has a version and a timestamp
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


def _count_once(scan: Scan, relations: dict[int, Relation]) -> frozenset[int]:
    """Take from ways the classes that they gave to areas of relations; return the ways that are in such an area."""
    areas: dict[int, list[ScanRow]] = {}
    for row in scan.rows:
        if row.is_relation and row.osm_id in relations:
            for ref in relations[row.osm_id].taken:
                areas.setdefault(ref, []).append(row)
    kinds: dict[tuple[int, tuple[Label, ...]], int] = {}
    for index in [index for index, row in enumerate(scan.rows) if row.osm_id in areas and not row.is_relation]:
        row, traits = scan.rows[index], scan.traits[scan.rows[index].kind]
        labels = _not_given(row, areas[row.osm_id], relations, scan.traits)
        if labels == traits.labels:
            continue
        kind = kinds.get((row.kind, labels))
        if kind is None:
            kind = kinds[row.kind, labels] = len(scan.traits)
            scan.traits.append(replace(traits, labels=labels))
        scan.rows[index] = row._replace(kind=kind)
        if not labels and traits.hidden_by is not None:
            scan.tally.hidden[traits.hidden_by] -= 1
    scan.rows = [row for row in scan.rows if scan.traits[row.kind].labels]
    return frozenset(areas)


def _not_given(
    way: ScanRow, areas: list[ScanRow], relations: dict[int, Relation], traits: list[Traits]
) -> tuple[Label, ...]:
    """Return the labels of a way less those of areas that it is an outer ring of, or runs along the edge of."""
    own = traits[way.kind]
    if own.is_area:
        given = [traits[area.kind] for area in areas if _shares_ground(way, area, relations[area.osm_id])]
        drawn = {key for item in given for key in _drawn(item)}
        return tuple(label for label, key in zip(own.labels, _drawn(own), strict=True) if key not in drawn)
    outlines = {replace(label, is_outline=True) for label in own.labels}
    edges = [area for area in areas if not outlines.isdisjoint(traits[area.kind].labels)]
    line = shapely.from_wkb(way.wkb)
    given = [traits[area.kind] for area in edges if shapely.covers(shapely.boundary(shapely.from_wkb(area.wkb)), line)]
    along = {label for item in given for label in item.labels}
    return tuple(label for label in own.labels if replace(label, is_outline=True) not in along)


def _shares_ground(way: ScanRow, area: ScanRow, relation: Relation) -> bool:
    """Return whether a closed way is an outer ring of an area: by its role, or by its place where that says nothing."""
    if way.osm_id not in relation.unsure:
        return True
    pair = shapely.make_valid(shapely.from_wkb(np.array([way.wkb, area.wkb], dtype=object)))
    return bool(shapely.area(shapely.intersection(*pair)) > 0)


def _drawn(traits: Traits) -> list[tuple[str, bool, bool]]:
    return [(label.class_name, label.is_outline, traits.hidden_by is None) for label in traits.labels]
