# SPDX-License-Identifier: Apache-2.0
"""Relations that should become areas: by their own tags, or in the old style by those of their outer ways; mending.

Until about 2017 the tags of a multipolygon stood on its outer ways, and the relation had `type` alone. Such a relation
is read as osm2pgsql read it in those years (`tagtransform.cpp` of 2014):

- It has no key of its own that says what it is (`KIND_KEYS`, and the keys of the taxonomy); then it takes the tags of
  its outer ways, which are all its ways but those of role "inner". A `name`, `note` or `source` does not count. GDAL
  passes over `created_by` alone, libosmium's old assembler over `created_by`, `source` and `note`: a courtyard whose
  relation has a name is lost to both.
- Outer ways that say what they are must agree: the area has the classes that all of them have. osm2pgsql took the tags
  that all have, so that `natural=wood` beside `landuse=forest` was no wood; GDAL takes those of the first outer way
  with tags. An outer way with no such key says nothing and disagrees with nothing, but for a ring without a role: what
  it is part of is not known.
- An inner way whose tags all stand on the area too is a hole; one with other tags is an area of its own.
- No class counts twice: neither on a relation and its outer ways, nor on an area and an inner way that is its hole.

The area has the id of its relation, as in GDAL: where the tags were moved to the relation later, the id stays.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any, Final, NamedTuple

import numpy as np
import shapely

from sasgeo_bench.osm.taxonomy import Label

MIN_RING_POINTS: Final = 3
# The keys with the flag `polygon` in osm2pgsql's default.style of 2015, less those that the taxonomy reads. In front
# of them what may stand on a relation whose outer way is something else: a boundary, a part of a building.
KIND_KEYS: Final = (
    *("boundary", "building:part", "indoor"),
    *("aeroway", "area:highway", "amenity", "building", "harbour", "historic", "landuse", "leisure", "man_made"),
    *("military", "natural", "office", "place", "power", "public_transport", "shop", "sport", "tourism", "water"),
    *("waterway", "wetland"),
)
_ABOUT_THE_MAP: Final = ("attribution", "comment", "created_by", "fixme", "note", "odbl", "source", "source_ref")
_INNER: Final = ("inner", "enclave")
_BUILDING_OUTLINE: Final = ("outer", "outline", "")

Tags = dict[str, str]


class Kind(NamedTuple):
    """The classes of an outer way as a closed way, and why it is not visible from above, or None."""

    labels: tuple[Label, ...]
    hidden_by: str | None


@dataclass(frozen=True, slots=True, kw_only=True)
class Relation:
    """An area relation: its labels (none in the old style, before the ways are read) and its member ways by role.

    `unsure` are those outer ways that do not say so. `taken` are the ways that are no areas of their own as far as they
    are of the relation's classes.
    """

    labels: tuple[Label, ...]
    tags: Tags
    version: int
    timestamp: Any
    outer: tuple[int, ...]
    inner: tuple[int, ...]
    unsure: frozenset[int]
    taken: tuple[int, ...]
    is_building: bool
    is_old_style: bool

    @property
    def ways(self) -> tuple[int, ...]:
        """Return the ids of all member ways that bound it."""
        return (*self.outer, *self.inner)


@dataclass(frozen=True, slots=True, kw_only=True)
class Member:
    """A member way as read: its tags, and whether it is a ring by itself."""

    tags: Tags
    is_closed: bool


def area_relation(item: Any, labels_of: Callable[[Tags], tuple[Label, ...]], keys: frozenset[str]) -> Relation | None:  # noqa: ANN401
    """Return an osmium relation that should become an area, else None; one of the old style has no labels.

    `keys` are those of `kind_keys`. type=building, which osmium ignores, is a building.
    """
    kind = item.tags.get("type")
    if kind not in ("multipolygon", "boundary", "building"):
        return None
    tags = dict(item.tags)
    is_building = kind == "building"
    if is_building:
        tags.setdefault("building", "yes")
    labels = labels_of(tags)
    if not labels and not keys.isdisjoint(tags):
        return None
    ways = [(member.role, member.ref) for member in item.members if member.type == "w"]
    inner = tuple(ref for role, ref in ways if role in _INNER)
    outer = tuple(
        ref for role, ref in ways if (role in _BUILDING_OUTLINE if is_building else role not in (*_INNER, "subarea"))
    )
    if not labels and not outer:
        return None
    return Relation(
        labels=labels,
        tags=tags,
        version=item.version,
        timestamp=item.timestamp,
        outer=outer,
        inner=inner,
        unsure=frozenset(ref for role, ref in ways if role not in ("outer", *_INNER)),
        taken=outer,
        is_building=is_building,
        is_old_style=not labels,
    )


def kind_keys(taxonomy_keys: tuple[str, ...]) -> frozenset[str]:
    """Return the keys that say what an object is: a relation with one of them is not of the old style."""
    return frozenset((*KIND_KEYS, *taxonomy_keys))


def adopt_tags(
    relation: Relation, members: Mapping[int, Member], kind_of: Callable[[Tags], Kind], keys: frozenset[str]
) -> Relation:
    """Return an old-style relation with the tags and classes of its outer ways; unchanged if they do not agree.

    Ways that are missing from the extract say nothing. Unchanged too where nothing is to be joined or cut out: each
    outer way is then the area that it is without the relation.
    """
    outer = {ref: members[ref] for ref in relation.outer if ref in members}
    inner = {ref: members[ref] for ref in relation.inner if ref in members}
    speaking = {ref: way for ref, way in outer.items() if not keys.isdisjoint(way.tags)}
    kinds = [kind_of(way.tags) for way in speaking.values()]
    if not kinds or len({kind.hidden_by is None for kind in kinds}) > 1:
        return relation
    shared = set.intersection(*({_drawn(label) for label in kind.labels} for kind in kinds))
    labels = tuple(label for label in kinds[0].labels if _drawn(label) in shared)
    silent = outer.keys() - speaking.keys()
    if not labels or any(outer[ref].is_closed for ref in silent & relation.unsure):
        return relation
    if not (silent or relation.inner) and all(way.is_closed for way in outer.values()):
        return relation
    common = frozenset.intersection(*(frozenset(way.tags.items()) for way in speaking.values()))
    tags = {**dict(common), **relation.tags}
    holes = tuple(ref for ref, way in inner.items() if _is_described_by(way.tags, tags))
    return replace(relation, labels=labels, tags=tags, taken=(*relation.outer, *holes))


def _drawn(label: Label) -> tuple[str, bool]:
    return label.class_name, label.is_outline


def _is_described_by(tags: Tags, others: Tags) -> bool:
    own = {key: value for key, value in tags.items() if key.lower().split(":")[0] not in _ABOUT_THE_MAP}
    return own.items() <= others.items()


def roles_by_place(relation: Relation, area: shapely.Geometry, lines: Mapping[int, shapely.Geometry]) -> Relation:
    """Return a relation in which ways that do not say whether they are inner are so where they edge holes alone."""
    if not relation.unsure:
        return relation
    parts = shapely.get_parts(area)
    holes = shapely.difference(shapely.boundary(area), shapely.union_all(shapely.get_exterior_ring(parts)))
    inner = {ref for ref in relation.unsure if ref in lines and shapely.covers(holes, lines[ref])}
    outer = tuple(ref for ref in relation.outer if ref not in inner)
    return replace(relation, outer=outer, inner=(*relation.inner, *sorted(inner)), unsure=relation.unsure - inner)


def mended_ring(line: shapely.Geometry) -> shapely.Geometry:
    """Return the area within a closed way; missing nodes are bridged, a ring that crosses itself is split."""
    coordinates = shapely.get_coordinates(line)
    if len(np.unique(coordinates, axis=0)) < MIN_RING_POINTS:
        return shapely.Polygon()
    return polygons_of(shapely.make_valid(shapely.polygons(shapely.linearrings(coordinates))))


def mended_area(relation: Relation, lines: Mapping[int, shapely.Geometry]) -> shapely.Geometry:
    """Return closed outer rings less closed inner rings, from the member ways that are present."""
    outer, inner = (
        _closed_rings([lines[ref] for ref in refs if ref in lines]) for refs in (relation.outer, relation.inner)
    )
    return polygons_of(shapely.make_valid(shapely.difference(outer, inner)))


def _closed_rings(lines: list[shapely.Geometry]) -> shapely.Geometry:
    """Return the area of rings that close; one that crosses itself is split, as a closed way is."""
    rings, _, _, crossed = shapely.polygonize_full(lines)
    return shapely.union_all([*shapely.get_parts(rings), *map(mended_ring, shapely.get_parts(crossed))])


def polygons_of(geometry: shapely.Geometry) -> shapely.Geometry:
    """Return the polygons among the parts of a geometry, as one multipolygon."""
    parts = shapely.get_parts(shapely.get_parts(geometry))
    return shapely.MultiPolygon([part for part in parts if part.geom_type == "Polygon"])
