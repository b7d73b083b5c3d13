# SPDX-License-Identifier: Apache-2.0
"""The embedded towns: procedural places written as real .osm.pbf files, at any date of a simulated history."""

import datetime as dt
import hashlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import lru_cache
from itertools import zip_longest
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np
import osmium
import pyproj
from osmium.osm.mutable import Node as OsmNode
from osmium.osm.mutable import Relation as OsmRelation
from osmium.osm.mutable import Way as OsmWay

from sasgeo_bench.core.errors import ExtractError, SasgeoError
from sasgeo_bench.geometry.projection import WGS84
from sasgeo_bench.osm.synthetic.morphology import Morphology, draw
from sasgeo_bench.osm.synthetic.sketch import Line, Sketch, Tags, join_streets

FIRST_DATE: Final = dt.date(2012, 1, 1)
LAST_DATE: Final = dt.date(2026, 1, 1)
BULK_REDRAW: Final = dt.date(2021, 7, 1)  # many buildings get new ids and nodes; the ground stays as it is

_BORN_BEFORE: Final = {"highway": 0.93, "building": 0.75, "waterway": 0.97, "natural": 0.95, "railway": 0.99}
_DIES: Final = 0.06
_MOVES: Final = 0.12
_RETAGGED: Final = {"residential": "living_street", "house": "yes", "unclassified": "residential", "farmland": "meadow"}
_RETAGS: Final = 0.08
_BULK_SHARE: Final = 0.35
_FIRST_NODE, _FIRST_WAY, _FIRST_RELATION = 1_000_001, 100_001, 10_001
_NEW_IDS: Final = 5_000_000


@dataclass(frozen=True, slots=True, kw_only=True)
class TownPlan:
    """Identity of a town: its kind, random seed, side of its square, and position of its centre."""

    morphology: Morphology
    seed: int
    size_m: float = 1024.0
    center_lonlat: tuple[float, float]


class _Change(NamedTuple):
    """One edit of an object: moved by metres, retagged, or given new ids."""

    on: dt.date
    dx_m: float = 0.0
    dy_m: float = 0.0
    tags: tuple[tuple[str, str], ...] = ()
    is_renewed: bool = False


@dataclass(frozen=True, slots=True, kw_only=True)
class _Thing:
    """One mapped object and its life. One ring makes a way; several rings or a kind make a relation."""

    number: int
    rings: tuple[Line, ...]
    tags: Tags
    relation: str | None
    born: dt.date
    died: dt.date | None
    changes: tuple[_Change, ...]

    def alive(self, on: dt.date) -> bool:
        return self.born <= on and (self.died is None or on < self.died)


class _Element(NamedTuple):
    """One element to write: a node by its place, a way by its nodes, a relation by its (way id, role) members."""

    rank: int
    osm_id: int
    version: int
    on: dt.date
    tags: Tags
    nodes: tuple[int, ...] = ()
    members: tuple[tuple[int, str], ...] = ()
    xy_m: tuple[float, float] = (0.0, 0.0)


def write_town(plan: TownPlan, path: Path, *, on: dt.date | None = None) -> None:
    """Write the state of a town at a date as an .osm.pbf file, replaced whole; by default at the end of its history.

    The same plan and date give the same bytes: coordinates come from seeded random numbers, times from the simulated
    history, and the file is stored without compression, so that no version of zlib can change it. Raise `ExtractError`
    if the date lies outside the history, or the file cannot be written.
    """
    day = LAST_DATE if on is None else on
    if not FIRST_DATE <= day <= LAST_DATE:
        raise ExtractError(f"the embedded towns have a history from {FIRST_DATE} to {LAST_DATE}, got {day}")
    elements = sorted(_elements(_things(plan), day), key=lambda element: element[:2])
    temporary = path.with_name(f".{path.name}.partial.osm.pbf")
    try:
        _write(elements, plan, temporary)
        temporary.replace(path)
    except SasgeoError:  # an error with a cause of its own, though it may be an `OSError`
        raise
    except (OSError, RuntimeError) as error:
        raise ExtractError(
            f"{path} cannot be written ({error}): check the free space and the rights of its folder"
        ) from error
    finally:
        temporary.unlink(missing_ok=True)


def _rng(plan: TownPlan, *purpose: object) -> np.random.Generator:
    """Return a random generator for one purpose, so that one object does not change the others."""
    text = "/".join(str(part) for part in (plan.morphology, plan.seed, *purpose))
    return np.random.default_rng(int.from_bytes(hashlib.sha256(text.encode()).digest()[:16], "big"))


@lru_cache(maxsize=8)  # several states of one town are written in a row
def _things(plan: TownPlan) -> tuple[_Thing, ...]:
    sketch = Sketch(half_m=plan.size_m / 2, rng=_rng(plan, "sketch"))
    draw(plan.morphology, sketch)
    drawn: list[tuple[tuple[Line, ...], Tags, str | None]] = [
        ((way.line,), way.tags, None) for way in join_streets(sketch.ways)
    ]
    drawn += [((area.outer, *area.inner), area.tags, area.kind) for area in sketch.areas]
    return tuple(_lived(plan, number, *shape) for number, shape in enumerate(drawn))


def _lived(plan: TownPlan, number: int, rings: tuple[Line, ...], tags: Tags, relation: str | None) -> _Thing:
    """Draw birth, death and edits of one object. Streets, water and parcels do not move: others share their nodes."""
    rng = _rng(plan, "life", number)
    key = next((key for key in _BORN_BEFORE if key in tags), "")
    before, after = (dt.date(2008, 1, 1), FIRST_DATE), (FIRST_DATE, LAST_DATE)
    born = _day(rng, *(before if rng.random() < _BORN_BEFORE.get(key, 0.7) else after))
    changes: list[_Change] = []
    stays = any(name in tags for name in ("highway", "railway", "waterway", "landuse", "barrier"))
    if not stays and rng.random() < _MOVES:
        angle, shift_m = rng.uniform(0, 2 * np.pi), rng.uniform(0.5, 3.0)
        changes.append(
            _Change(_day(rng, born, LAST_DATE), float(shift_m * np.cos(angle)), float(shift_m * np.sin(angle)))
        )
    retag = next(((name, _RETAGGED[value]) for name, value in tags.items() if value in _RETAGGED), None)
    if retag is not None and rng.random() < _RETAGS:
        changes.append(_Change(_day(rng, born, LAST_DATE), tags=(retag,)))
    if key == "building" and born < BULK_REDRAW and relation is None and rng.random() < _BULK_SHARE:
        changes.append(_Change(BULK_REDRAW, is_renewed=True))
    died = _day(rng, born, LAST_DATE) if key not in ("railway", "waterway") and rng.random() < _DIES else None
    if died is not None and died < FIRST_DATE:
        died = None
    return _Thing(
        number=number,
        rings=rings,
        tags=tags,
        relation=relation,
        born=born,
        died=died,
        changes=tuple(sorted(changes, key=lambda change: change.on)),
    )


def _day(rng: np.random.Generator, first: dt.date, last: dt.date) -> dt.date:
    return first + dt.timedelta(days=int(rng.integers(1, max(2, (last - first).days))))


def _elements(things: Sequence[_Thing], on: dt.date) -> Iterator[_Element]:
    """Yield everything alive on a day. Objects of one network share nodes of equal coordinates."""
    shared: dict[tuple[float, float], int] = {}
    for thing in things:
        own_base = _FIRST_NODE + 10_000 * (thing.number + 1)
        is_network = any(key in thing.tags for key in ("highway", "railway", "barrier", "landuse"))
        network_ids = [
            shared.setdefault((float(x), float(y)), _FIRST_NODE + 100_000_000 + len(shared))
            for x, y in np.vstack(thing.rings).round(2) + 0.0
            if is_network
        ]
        if thing.alive(on):
            yield from _thing_elements(thing, on, own_base, network_ids if is_network else None)


def _thing_elements(thing: _Thing, on: dt.date, own_base: int, network_ids: list[int] | None) -> Iterator[_Element]:
    done = [change for change in thing.changes if change.on <= on]
    renewed = next((change.on for change in done if change.is_renewed), None)
    since = thing.born if renewed is None else renewed
    counted = [change for change in done if not change.is_renewed and change.on >= since]
    version, last = 1 + len(counted), max([since, *(change.on for change in counted)])
    id_shift = 0 if renewed is None else _NEW_IDS
    tags = dict(thing.tags)
    for change in done:
        tags.update(change.tags)
    offset = np.array([sum(change.dx_m for change in done), sum(change.dy_m for change in done)])
    moves = [change.on for change in counted if change.dx_m or change.dy_m]
    ring_refs, count = [], 0
    for ring in thing.rings:
        is_closed = len(ring) > 3 and bool((ring[0] == ring[-1]).all())  # a triangle has four points
        corners = ring[:-1] if is_closed else ring
        if network_ids is None:
            refs = [own_base + id_shift + 200_000_000 * bool(id_shift) + count + i for i in range(len(corners))]
            for ref, point in zip(refs, corners + offset, strict=True):
                xy_m = (float(point[0]), float(point[1]))
                yield _Element(0, ref, 1 + len(moves), max([since, *moves]), {}, xy_m=xy_m)
        else:
            refs = network_ids[count : count + len(corners)]
            for ref, point in zip(refs, corners, strict=True):
                yield _Element(0, ref, 1, dt.date(2008, 1, 1), {}, xy_m=(float(point[0]), float(point[1])))
        count += len(ring)
        ring_refs.append(tuple([*refs, refs[0]] if is_closed else refs))
    way_id = _FIRST_WAY + 10 * thing.number + id_shift
    if thing.relation is None:
        yield _Element(1, way_id, version, last, tags, ring_refs[0])
        return
    roles = ["outline" if thing.relation == "building" else "outer", *["inner"] * (len(ring_refs) - 1)]
    for number, ring_nodes in enumerate(ring_refs):
        yield _Element(1, way_id + number, 1, thing.born, {}, ring_nodes)
    members = tuple((way_id + number, role) for number, role in enumerate(roles))
    yield _Element(2, _FIRST_RELATION + thing.number, version, last, tags | {"type": thing.relation}, members=members)


def _write(elements: list[_Element], plan: TownPlan, path: Path) -> None:
    """Write sorted elements, each once: a shared node comes with every way that uses it."""
    half_m = plan.size_m / 2
    unique = list({element[:2]: element for element in reversed(elements)}.values())[::-1]
    corners = [(-half_m, -half_m), (half_m, half_m)]
    (west, south), (east, north), *places = _lonlat(plan, [*corners, *(one.xy_m for one in unique if one.rank == 0)])
    header = osmium.io.Header()
    header.set("generator", "sasgeo-bench embedded town")
    header.set("sorting", "Type_then_ID")
    header.add_box(osmium.osm.Box(west, south, east, north))
    path.unlink(missing_ok=True)
    target = osmium.io.File(str(path), "pbf,pbf_compression=none")
    with osmium.SimpleWriter(target, header=header) as writer:
        for element, place in zip_longest(unique, places):  # nodes come first
            _add(writer, element, place)


def _lonlat(plan: TownPlan, places_m: Sequence[tuple[float, float]]) -> list[tuple[float, float]]:
    """Return longitude and latitude of places in metres from the centre, rounded as OSM stores them."""
    longitude_deg, latitude_deg = plan.center_lonlat
    crs = pyproj.CRS.from_proj4(
        f"+proj=tmerc +lat_0={latitude_deg} +lon_0={longitude_deg} +k=1 +x_0=0 +y_0=0 +datum=WGS84"
    )
    to_degrees = pyproj.Transformer.from_crs(crs, WGS84, always_xy=True)
    lon_deg, lat_deg = to_degrees.transform(*np.array(places_m).T)
    return [(round(lon, 7), round(lat, 7)) for lon, lat in zip(lon_deg.tolist(), lat_deg.tolist(), strict=True)]


def _add(writer: osmium.SimpleWriter, element: _Element, place: tuple[float, float] | None) -> None:
    common: dict[str, Any] = {
        "id": element.osm_id,
        "version": element.version,
        "timestamp": dt.datetime.combine(element.on, dt.time(12), tzinfo=dt.UTC),
        "tags": element.tags,
        "visible": True,
    }
    if element.rank == 0:
        writer.add_node(OsmNode(location=place, **common))
    elif element.rank == 1:
        writer.add_way(OsmWay(nodes=list(element.nodes), **common))
    else:
        members = [("w", ref, role) for ref, role in element.members]
        writer.add_relation(OsmRelation(members=members, **common))
