# SPDX-License-Identifier: Apache-2.0
"""Rules that explain where two readings of an OSM file differ, each by the area or length that it says itself.

A rule looks at what the file holds of an object and works out its size from nodes, ways and members alone. It explains
a difference only where our reader came to that very size.
"""

from collections import defaultdict
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from itertools import groupby
from pathlib import Path
from typing import Final

import osmium
import shapely

from benchmarks.other_readings import Frame, Tags

SMALL: Final = 1.0  # m2 or m: rounding of coordinates
SHARE: Final = 1e-3  # of an object: a ring that crosses itself is split in several ways
BARE: Final = {"type", "created_by"}  # a relation without other tags is of the old style
AREAS: Final = ("multipolygon", "boundary")
TAGS: Final = Tags.load()
Place = tuple[float, float]


@dataclass(frozen=True)
class Way:
    """A way of the file: node ids, and places in metres, None of a node that is missing."""

    tags: dict[str, str]
    refs: list[int]
    places: list[Place | None]

    @property
    def lacks_nodes(self) -> bool:
        """Whether a node is missing."""
        return None in self.places

    def runs(self) -> Iterator[list[Place]]:
        """Pieces of nodes that are there, between gaps."""
        for is_there, run in groupby(self.places, key=lambda place: place is not None):
            if is_there:
                yield [place for place in run if place is not None]


@dataclass(frozen=True)
class Relation:
    """A relation of the file: its member ways by id and role."""

    tags: dict[str, str]
    members: list[tuple[int, str]]


@dataclass(frozen=True)
class Facts:
    """What a file holds of some ways and relations, and of the members of the latter."""

    ways: dict[int, Way]
    relations: dict[int, Relation]

    @classmethod
    def read(cls, path: Path, frame: Frame, *, ways: Iterable[int], relations: Iterable[int]) -> "Facts":
        """Read them by id."""
        wanted = set(relations)
        source = osmium.FileProcessor(str(path), osmium.osm.RELATION)
        found = {
            item.id: Relation(dict(item.tags), [(each.ref, each.role) for each in item.members if each.type == "w"])
            for item in source
            if item.id in wanted
        }
        ids = set(ways) | {ref for each in found.values() for ref, _ in each.members}
        lines = osmium.FileProcessor(str(path)).with_locations().with_filter(osmium.filter.EntityFilter(osmium.osm.WAY))
        held = {}
        for way in lines.with_filter(osmium.filter.IdFilter(ids)) if ids else ():
            places = [(node.lon, node.lat) if node.location.valid() else None for node in way.nodes]
            held[way.id] = Way(dict(way.tags), [node.ref for node in way.nodes], _metres(places, frame))
        return cls(held, found)


def _metres(places: list[Place | None], frame: Frame) -> list[Place | None]:
    known = [place for place in places if place is not None]
    if not known:
        return places
    moved = iter(shapely.get_coordinates(frame.project(shapely.multipoints(known))).tolist())
    return [None if place is None else tuple(next(moved)) for place in places]


def rings(ways: list[Way]) -> list[shapely.Geometry]:
    """Join ways end to end by the ids of their nodes; areas of the rings that close."""
    open_ends: dict[int, list[int]] = defaultdict(list)
    closed, left = [], {}
    for index, way in enumerate(ways):
        if len(way.refs) < 2:  # no line
            continue
        if way.refs[0] == way.refs[-1]:
            closed.append(way.places)
        else:
            left[index] = way
            for end in (way.refs[0], way.refs[-1]):
                open_ends[end].append(index)
    while left:
        _, way = left.popitem()
        start, end, places = way.refs[0], way.refs[-1], list(way.places)
        while end != start:
            index = next((each for each in open_ends[end] if each in left), None)
            if index is None:
                break
            other = left.pop(index)
            ahead = other.refs[0] == end
            places += (other.places if ahead else other.places[::-1])[1:]
            end = other.refs[-1] if ahead else other.refs[0]
        if end == start:
            closed.append(places)
    return [_filled([place for place in places if place is not None]) for places in closed]


def _filled(places: list[Place]) -> shapely.Geometry:
    return shapely.make_valid(shapely.Polygon(places)) if len(set(places)) > 2 else shapely.Polygon()


def by_role(relation: Relation, facts: Facts) -> shapely.Geometry:
    """Rings of outer ways less rings of inner ways; a way without a role is inner if it lies in an outer ring."""
    found: dict[str, list[Way]] = defaultdict(list)
    for ref, role in relation.members:
        if ref in facts.ways:
            found[role if role in ("inner", "") else "outer"].append(facts.ways[ref])
    outer, inner, unsaid = (rings(found[role]) for role in ("outer", "inner", ""))
    around = shapely.union_all(outer)
    for ring in unsaid:
        is_within = shapely.area(shapely.intersection(ring, around)) > shapely.area(ring) / 2
        (inner if is_within else outer).append(ring)
    return shapely.difference(shapely.union_all(outer), shapely.union_all(inner))


def by_nesting(relation: Relation, facts: Facts) -> shapely.Geometry:
    """All rings, each a hole in the one around it, whatever their roles."""
    found = rings([facts.ways[ref] for ref, _ in relation.members if ref in facts.ways])
    area = shapely.Polygon()
    for ring in found:
        area = shapely.symmetric_difference(area, ring)
    return area


@dataclass(frozen=True)
class Case:
    """One object, class and form that two readings differ on.

    `is_reported` says that it is an outer way of a relation which has the class in our reading.
    """

    kind: str
    identifier: int
    name: str
    form: str
    ours: float
    gdal: float
    is_reported: bool
    facts: Facts

    @property
    def way(self) -> Way | None:
        """The way, if it is one."""
        return self.facts.ways.get(self.identifier) if self.kind == "w" else None

    @property
    def relation(self) -> Relation | None:
        """The relation, if it is one."""
        return self.facts.relations.get(self.identifier) if self.kind == "r" else None

    def size(self, area: shapely.Geometry) -> float:
        """Area, or length of the outline."""
        return float(shapely.area(area) if self.form == "area" else shapely.length(shapely.boundary(area)))


Rule = Callable[[Case], float | None]


def no_line_across_a_gap(case: Case) -> float | None:
    """A way that lacks nodes: a line ends at the gap, an area is closed across it, and so is its outline."""
    way = case.way
    if way is None or not way.lacks_nodes:
        return None
    if case.form == "area" or case.name not in TAGS.rules(way.tags, "line"):
        return case.size(_filled([place for run in way.runs() for place in run]))
    return float(sum(shapely.length(shapely.LineString(run)) for run in way.runs() if len(run) > 1))


def ring_of_two_places(case: Case) -> float | None:
    """A closed way that goes there and back: a line, and no area."""
    way = case.way
    if way is None or way.lacks_nodes or len(set(way.places)) > 2:  # no ring
        return None
    return 0.0 if case.form == "area" else float(shapely.length(shapely.LineString(way.places)))


def rings_that_close(case: Case) -> float | None:
    """A relation that lacks member ways or their nodes: the rings that close are kept, by their roles."""
    relation = case.relation
    if relation is None or relation.tags.get("type") not in AREAS:
        return None
    ways = [case.facts.ways.get(ref) for ref, _ in relation.members]
    return case.size(by_role(relation, case.facts)) if any(way is None or way.lacks_nodes for way in ways) else None


def holes_by_role(case: Case) -> float | None:
    """A relation of which rings cross, touch or lie elsewhere than their roles say: outer rings less inner ones."""
    relation = case.relation
    if relation is None or relation.tags.get("type") not in AREAS:
        return None
    return case.size(by_role(relation, case.facts))


def holes_by_nesting(case: Case) -> float | None:
    """A relation of which roles and rings do not agree, and whose rings are sound: each ring is a hole in the next."""
    relation = case.relation
    if relation is None or relation.tags.get("type") not in AREAS:
        return None
    return case.size(by_nesting(relation, case.facts))


def building_relation(case: Case) -> float | None:
    """A relation of type=building without an outline that is a building: its outer ways are."""
    relation = case.relation
    if relation is None or relation.tags.get("type") != "building":
        return None
    members = [(ref, "outer") for ref, role in relation.members if role in ("outer", "outline", "")]
    return case.size(by_role(Relation(relation.tags, members), case.facts))


def lines_lie_on_their_way(case: Case) -> float | None:
    """A relation without tags whose outer way is a fence, say, and an area: the fence lies along that way alone."""
    relation = case.relation
    if relation is None or case.form != "line":
        return None
    outer = [case.facts.ways[ref] for ref, role in relation.members if role in ("outer", "") and ref in case.facts.ways]
    drawn = [way for way in outer if case.name in TAGS.rules(way.tags, "line")]
    return float(sum(shapely.length(shapely.LineString(run)) for way in drawn for run in way.runs() if len(run) > 1))


def tags_of_open_ways(case: Case) -> float | None:
    """A relation without tags whose outer ways are open: an area by their tags (GDAL keeps those of rings alone)."""
    relation = case.relation
    if relation is None or relation.tags.keys() - BARE:
        return None
    outer = [case.facts.ways[ref] for ref, role in relation.members if role in ("outer", "") and ref in case.facts.ways]
    if any(way.refs[0] == way.refs[-1] for way in outer):
        return None
    return case.size(by_role(relation, case.facts))


def outer_ways_that_disagree(case: Case) -> float | None:
    """A relation without tags whose outer ways are of different classes: each is its own (GDAL goes by the first)."""
    relation = case.relation
    if relation is None or relation.tags.keys() - BARE:
        return None
    outer = [case.facts.ways[ref] for ref, role in relation.members if role in ("outer", "") and ref in case.facts.ways]
    forms = [TAGS.forms(way.tags, "closed") for way in outer]
    if len({tuple(each) for each in forms}) < 2:  # they agree
        return None
    own = [way for way, each in zip(outer, forms, strict=True) if (case.name, case.form) in each]
    return float(sum(case.size(area) for area in rings(own)))


def hole_told_as_its_area(case: Case) -> float | None:
    """An inner way, whose tags are all on an outer way of a relation without a class: a hole, as osm2pgsql had it."""
    way = case.way
    for relation in case.facts.relations.values() if way is not None else ():
        roles = dict(relation.members)
        outer = [case.facts.ways[ref] for ref, role in roles.items() if role == "outer" and ref in case.facts.ways]
        told = {item for each in outer for item in each.tags.items()}
        if way is not None and roles.get(case.identifier) == "inner" and way.tags.items() <= told:
            return 0.0
    return None


def class_of_the_relation(case: Case) -> float | None:
    """An outer way with a class that its relation has: counted once, with the relation."""
    return 0.0 if case.is_reported else None


GDAL_RULES: Final[tuple[Rule, ...]] = (
    no_line_across_a_gap,
    ring_of_two_places,
    rings_that_close,
    building_relation,
    class_of_the_relation,
    hole_told_as_its_area,
    lines_lie_on_their_way,
    tags_of_open_ways,
    outer_ways_that_disagree,
    holes_by_role,
    holes_by_nesting,
)


def ring_that_crosses_itself(case: Case) -> float | None:
    """A closed way that crosses or touches itself: all that it encloses (`osmium export` leaves it out)."""
    if case.way is None:
        return None
    points = [place for run in case.way.runs() for place in run]
    if len(points) < 4 or shapely.is_valid(shapely.Polygon(points)):  # no ring
        return None
    return case.size(_filled(points))


def tags_on_outer_ways(case: Case) -> float | None:
    """A relation without tags: an area by the tags of its outer ways (`osmium export` makes none)."""
    relation = case.relation
    if relation is None or relation.tags.keys() - BARE:
        return None
    return case.gdal if case.gdal > 0 else None


def line_of_an_area(case: Case) -> float | None:
    """A closed way with area=yes that is a hedge or a bridge too: a line along it (`osmium export` makes the area)."""
    way = case.way
    if way is None or case.form != "line" or way.tags.get("area") != "yes" or way.lacks_nodes:
        return None
    return float(shapely.length(shapely.LineString(way.places)))


OSMIUM_RULES: Final[tuple[Rule, ...]] = (
    line_of_an_area,
    tags_on_outer_ways,
    ring_that_crosses_itself,
    *GDAL_RULES,
)


def is_near(first: float, second: float) -> bool:
    """Whether two sizes are the same but for rounding."""
    return abs(first - second) <= SMALL + SHARE * max(first, second)


def explain(case: Case, rules: tuple[Rule, ...]) -> str | None:
    """Return the name of the first rule that comes to our size, or None."""
    for rule in rules:
        size = rule(case)
        if size is not None and is_near(size, case.ours):
            return rule.__name__
    return None
