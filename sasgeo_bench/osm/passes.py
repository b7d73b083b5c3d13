# SPDX-License-Identifier: Apache-2.0
"""The passes over an OSM file: a survey of what should become an area, all ways and areas, and what osmium lost."""

from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Final

import numpy as np
import osmium
import shapely

from sasgeo_bench.files.garbage import uncollected
from sasgeo_bench.osm.coverage import find_gaps
from sasgeo_bench.osm.multipolygons import (
    Member,
    Relation,
    Tags,
    adopt_tags,
    area_relation,
    mended_area,
    mended_ring,
    polygons_of,
    roles_by_place,
)
from sasgeo_bench.osm.scan import (
    BUILT_UP,
    SEVERAL_LINES,
    Box,
    Classifier,
    Scan,
    ScanRow,
    Tally,
    Traits,
    area_wkb,
    line_wkb,
    reaches,
)
from sasgeo_bench.osm.snapshot import elements
from sasgeo_bench.osm.taxonomy import Label, Taxonomy

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
        for item in _ways_and_areas(path, taxonomy):
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


def _ways_and_areas(path: Path, taxonomy: Taxonomy) -> Iterator[Any]:
    """Yield ways with a key of lines and all areas, in one pass; filters and assembly of areas run in C++."""
    with_key = osmium.filter.KeyFilter(*taxonomy.keys)
    processor = osmium.FileProcessor(str(path)).with_locations().with_areas(with_key)
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
        for item in _ways_and_relations(path, everything, bare):
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
            # Line through the nodes that are there, closed if the way is: an area goes on across a gap
            places = [(node.lon, node.lat) for node in way.nodes if node.location.valid()]
            places += places[:1] if way.is_closed() and places and places[0] != places[-1] else []
            wkb = bytes(shapely.to_wkb(shapely.linestrings(places))) if len(set(places)) > 1 else None
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


def _ways_and_relations(path: Path, ways: set[int], relations: set[int]) -> Iterator[Any]:
    """Yield ways by id, and the areas of relations by id: osmium assembles areas only if there are any."""
    processor = osmium.FileProcessor(str(path)).with_locations()
    if relations:
        processor = processor.with_areas(_of_ids("relation", relations))
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
