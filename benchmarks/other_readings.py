# SPDX-License-Identifier: Apache-2.0
"""OSM files as other software reads them: GDAL's OSM driver, and `osmium export`, classified by rules of their own.

Only the tables of `taxonomy.toml` and the projection are shared with the package; rings, relations, classes of an
object and sums are not. `cross_check_osm.py` holds our reader against what comes out here.
"""

import json
import math
import subprocess
import tomllib
import warnings
from collections.abc import Iterator
from dataclasses import dataclass, field
from functools import cached_property
from importlib import resources
from pathlib import Path
from typing import Any, Final

import numpy as np
import osmium
import pandas as pd
import pyogrio
import pyproj
import shapely

KEY: Final = ["kind", "id", "class", "form"]
MEASURES: Final = ["size", "holes"]  # size: m2 of an area, m of a line; holes: m2 of its inner rings
MORE_KEYS: Final = ["area", "name", "type"]  # which decide what an object is, besides the keys of the taxonomy
YARD_KEYS: Final = {"landuse", "amenity", "leisure", "name"}  # of what a barrier goes around
HISTORY: Final = (".osh.pbf", ".osh", ".osh.gz", ".osh.bz2")
COPY: Final = 10**15  # added to the id of a way that is handed to GDAL a second time
REACH_M: Final = 100_000.0


@dataclass(frozen=True)
class Tags:
    """The tag tables of the taxonomy, and which class an object of some tags has as a line and as an area."""

    classes: list[dict[str, Any]]

    @classmethod
    def load(cls) -> "Tags":
        """Read the taxonomy of the package as plain TOML."""
        text = resources.files("sasgeo_bench.osm").joinpath("taxonomy.toml").read_text(encoding="utf-8")
        return cls(tomllib.loads(text)["class"])

    @cached_property
    def keys(self) -> list[str]:
        """Every key that a rule reads."""
        return sorted({rule["key"] for each in self.classes for rule in each["rules"]})

    @cached_property
    def area_keys(self) -> set[str]:
        """Keys that make a closed way an area."""
        keys = {rule["key"] for each in self.classes for rule in each["rules"] if rule["geometry"] == "area"}
        return keys | {each["outline_of"]["key"] for each in self.classes if "outline_of" in each}

    def is_polygon(self, tags: dict[str, str]) -> bool:
        """Whether GDAL takes a closed way of these tags for a polygon."""
        return tags.get("area") != "no" and (tags.get("area") == "yes" or not self.area_keys.isdisjoint(tags))

    def rules(self, tags: dict[str, str], geometry: str) -> dict[str, dict[str, Any]]:
        """Class -> the first rule of a geometry that takes the tags."""
        found: dict[str, dict[str, Any]] = {}
        for each in self.classes:
            for rule in each["rules"]:
                value = tags.get(rule["key"])
                named = {*rule.get("values", ()), *rule.get("widths", ())}
                takes = value in named or ("*" in named and value not in rule.get("besides", ()))
                if value is not None and takes and rule["geometry"] == geometry:
                    found.setdefault(each["name"], rule)
        return found

    def edges(self, tags: dict[str, str]) -> set[str]:
        """Classes that the outline of an area of these tags belongs to."""
        listed = ((each["name"], each["outline_of"]) for each in self.classes if "outline_of" in each)
        return {name for name, outline in listed if tags.get(outline["key"]) in outline["values"]}

    def widest_m(self, tags: dict[str, str], name: str) -> float:
        """How wide an area of a line rule may be anywhere; a wider one is an outline."""
        rule = {} if name in self.rules(tags, "area") else self.rules(tags, "line").get(name, {})
        return rule["fills_to"] * rule["widths"][tags[rule["key"]]] if "fills_to" in rule else math.inf

    def forms(self, tags: dict[str, str], shape: str) -> list[tuple[str, str]]:
        """List (class, "area" or "line") of an object; `shape` is "open" or "closed" for a way, or "relation".

        `osmium export` gives a closed way twice: what is asked of its "ring" and of what is "filled" comes apart.
        """
        if shape in ("ring", "filled"):
            wanted = "line" if shape == "ring" else "area"
            return [each for each in self.forms(tags, "closed") if each[1] == wanted]
        lines, areas, edges = self.rules(tags, "line"), self.rules(tags, "area"), self.edges(tags)
        drawn = [(name, "line") for name in lines]
        if shape == "open" or (shape == "closed" and tags.get("area") == "no"):
            return drawn
        filled = [(name, "area") for name in areas]
        if not filled and not edges and tags.get("area") == "yes":
            is_yard = not YARD_KEYS.isdisjoint(tags)
            return [(name, "line" if is_yard and rule.get("fills_to") else "area") for name, rule in lines.items()]
        if shape == "closed":
            return [*drawn, *filled, *((name, "line") for name in edges - set(lines))]
        squares = {name for name, rule in lines.items() if rule.get("multipolygon") == "filled"}
        rings = (set(lines) - squares) | edges
        has_area = bool(filled or edges)
        return [*filled, *((name, "line") for name in rings), *((name, "area") for name in squares if not has_area)]


@dataclass(frozen=True)
class Objects:
    """Objects as a reader gives them: tags, geometry in longitude and latitude, shape (of `Tags.forms`) and id."""

    tags: list[dict[str, str]]
    geometry: Any
    shape: Any
    identifier: Any

    def __post_init__(self) -> None:
        """Check that all have one length."""
        if not len(self.tags) == len(self.geometry) == len(self.shape) == len(self.identifier):
            raise ValueError("tags, geometries, shapes and ids are not of one length")


@dataclass(frozen=True)
class Frame:
    """Where a file is measured: a UTM zone, and a square of 200 km around the median of its vertices."""

    epsg: int
    middle_m: tuple[float, float]

    @classmethod
    def around(cls, lonlat: Any) -> "Frame":  # noqa: ANN401 - an array of N points
        """Return the frame of vertices, degrees."""
        lon, lat = np.median(lonlat, axis=0)
        epsg = (32600 if lat >= 0 else 32700) + int((lon + 180) // 6) % 60 + 1
        return cls(epsg, pyproj.Transformer.from_crs(4326, epsg, always_xy=True).transform(lon, lat))

    @property
    def bounds_m(self) -> tuple[float, float, float, float]:
        """West, south, east, north."""
        east, north = self.middle_m
        return (east - REACH_M, north - REACH_M, east + REACH_M, north + REACH_M)

    def project(self, geometry: Any) -> Any:  # noqa: ANN401 - an array of geometries
        """Project longitude and latitude to metres."""
        into = pyproj.Transformer.from_crs(4326, self.epsg, always_xy=True)
        return shapely.transform(geometry, lambda points: np.column_stack(into.transform(points[:, 0], points[:, 1])))


@dataclass(frozen=True)
class Plain:
    """A file that other software reads as we read ours.

    `source` is the same file without the changes for GDAL. `copies` are ways that are in it twice, and the classes that
    do not count the second time. `owners` are closed outer ways of relations without a class of their own, and their
    relation: an area is either's. `above` are the area relations of outer ways, `around` those without a class of ways
    that are inner ones.
    """

    path: Path
    source: Path
    copies: dict[int, set[str]] = field(default_factory=dict)
    owners: dict[int, int] = field(default_factory=dict)
    above: dict[int, list[int]] = field(default_factory=dict)
    around: dict[int, list[int]] = field(default_factory=dict)


def make_plain(path: Path, tags: Tags, scratch: Path, *, at: str) -> Plain:
    """Write a file as GDAL can read it, and so that its known habits do not hide others.

    A history is cut at the end of a day, bz2 unpacked, and all is sorted. GDAL leaves out a relation as soon as one
    member is missing, which is most of those at the edge of an extract: members that are not in the file are taken out.
    GDAL leaves out a closed way that is the outer ring of a relation with tags, even if its class is another (a wood in
    a park): such ways are given a second time under an id of their own.
    """
    source = _one_state(path, scratch, at=at)
    relations = list(_relations(source, tags))
    owners = {ref: each.identifier for each in relations if not each.classes for ref in each.outer}
    plain = Plain(path=scratch / "plain.osm.pbf", source=source, owners=owners)
    above = {ref: each for each in relations if each.has_tags for ref in each.said_outer}
    for each in relations:
        for ref in each.said_outer or each.outer:
            plain.above.setdefault(ref, []).append(each.identifier)
        for ref in set(each.members).difference(each.outer) if not each.classes else ():
            plain.around.setdefault(ref, []).append(each.identifier)
    ways = {ref for each in relations for ref in each.members}
    present: set[int] = set()
    copies: list[Any] = []
    kinds = osmium.filter.EntityFilter(osmium.osm.WAY | osmium.osm.RELATION)
    with osmium.SimpleWriter(str(plain.path), overwrite=True) as writer:
        for item in osmium.FileProcessor(str(source)).with_filter(kinds).handler_for_filtered(writer):
            if item.is_relation():
                while copies:  # their ids are the highest
                    writer.add(copies.pop(0))
                writer.add(_with_members(item, present))
                continue
            writer.add(item)
            if item.id in ways:
                present.add(item.id)
            if not item.is_closed():
                owners.pop(item.id, None)  # a line by itself
            own = dict(item.tags)
            is_lost = item.id in above and item.is_closed() and tags.is_polygon(own)
            told = above[item.id].told(own) if is_lost else set()
            if is_lost and not {name for name, _ in tags.forms(own, "closed")} <= told:
                plain.copies[item.id + COPY] = told
                nodes = [node.ref for node in item.nodes]
                copies.append(osmium.osm.mutable.Way(id=item.id + COPY, tags=own, nodes=nodes))
    return plain


def _with_members(relation: Any, present: set[int]) -> Any:  # noqa: ANN401 - osmium relations
    """Return an area relation with the member ways that are present, without any if holes alone are left."""
    there = [each for each in relation.members if each.type != "w" or each.ref in present]
    if relation.tags.get("type") not in _AREAS or len(there) == len(relation.members):
        return relation
    has_ring = any(each.type == "w" and each.role != "inner" for each in there)
    return relation.replace(members=[(each.type, each.ref, each.role) for each in there] if has_ring else [])


def _one_state(path: Path, scratch: Path, *, at: str) -> Path:
    """Return a sorted file with one state of the world: headers that promise the order do not always keep it."""
    source, target = path, scratch / "sorted.osm.pbf"
    if path.name.endswith(HISTORY):
        source = scratch / "state.osm.pbf"
        _run("osmium", "time-filter", "--overwrite", "-o", source, path, f"{at}T23:59:59Z")
    merger = osmium.MergeInputReader()
    merger.add_file(str(source))
    with osmium.SimpleWriter(str(target), overwrite=True) as writer:
        merger.apply(writer, simplify=True)
    return target


def _run(*command: str | Path) -> None:
    subprocess.run([str(part) for part in command], check=True, capture_output=True)  # noqa: S603 - our own words


_AREAS: Final = ("multipolygon", "boundary")
_NO_TAGS: Final = {"type", "created_by"}
_HIDING: Final = ("tunnel", "layer", "location")  # what is below ground is not what lies above it


@dataclass(frozen=True)
class _Relation:
    identifier: int
    tags: dict[str, str]
    classes: set[str]
    has_tags: bool
    members: list[int]
    outer: list[int]
    said_outer: list[int]

    def told(self, tags: dict[str, str]) -> set[str]:
        """Classes of an outer way that are the relation's, of which they are counted."""
        is_alike = all(self.tags.get(key) == tags.get(key) for key in _HIDING)
        return self.classes if is_alike else set()


def _relations(source: Path, tags: Tags) -> Iterator[_Relation]:
    for item in osmium.FileProcessor(str(source), osmium.osm.RELATION):
        own = dict(item.tags)
        if own.get("type") in _AREAS:
            ways = [each for each in item.members if each.type == "w"]
            yield _Relation(
                identifier=item.id,
                tags=own,
                classes={name for name, _ in tags.forms(own, "relation")},
                has_tags=bool(own.keys() - _NO_TAGS),
                members=[each.ref for each in ways],
                outer=[each.ref for each in ways if each.role in ("outer", "")],
                said_outer=[each.ref for each in ways if each.role == "outer"],
            )


def _gdal_conf(tags: Tags) -> str:
    layers = ("lines", "multilinestrings", "multipolygons", "other_relations")
    listed = ",".join([*tags.keys, *MORE_KEYS])
    return "\n".join(
        [
            f"closed_ways_are_polygons={','.join(sorted(tags.area_keys))}",
            "attribute_name_laundering=no",
            "[points]\nosm_id=no\nother_tags=no",
            *(f"[{layer}]\nosm_id=yes\nattributes={listed}\nother_tags=no" for layer in layers),
        ]
    )


def read_gdal(path: Path, tags: Tags, scratch: Path) -> list[Objects]:
    """Read lines and areas with GDAL's OSM driver."""
    conf = scratch / "osmconf.ini"
    conf.write_text(_gdal_conf(tags), encoding="utf-8")
    pyogrio.set_gdal_config_options({"OSM_CONFIG_FILE": str(conf), "OGR_INTERLEAVED_READING": "YES"})
    keys = [*tags.keys, *MORE_KEYS]
    found = []
    for layer in ("lines", "multipolygons"):
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", RuntimeWarning)  # rings that are no rings: they count for nothing here too
            meta, _, wkb, data = pyogrio.raw.read(path, layer=layer)
        columns = dict(zip(meta["fields"], data, strict=True))
        geometry, identifier = _from_wkb(wkb), columns["osm_id"]
        shape = np.where(shapely.is_closed(geometry), "closed", "open")
        if layer == "multipolygons":
            is_way = np.array([each is not None for each in columns["osm_way_id"]], dtype=bool)
            identifier = np.where(is_way, columns["osm_way_id"], identifier)
            shape = np.where(is_way, "closed", "relation")
        values = zip(*(columns[key] for key in keys), strict=True)
        said = [{key: value for key, value in zip(keys, each, strict=True) if value is not None} for each in values]
        found.append(Objects(said, geometry, shape, identifier.astype(np.int64)))
    return found


def _from_wkb(wkb: Any) -> Any:  # noqa: ANN401 - arrays
    """Geometries; a ring of two points, which GDAL gives for a way of two nodes there and back, is empty."""
    geometry = shapely.from_wkb(wkb, on_invalid="ignore")
    geometry[shapely.is_missing(geometry)] = shapely.Polygon()
    return geometry


def read_osmium(path: Path, tags: Tags, scratch: Path) -> list[Objects]:
    """Read lines and areas with `osmium export`: an open way comes as a line, a closed one as both."""
    conf, target = scratch / "export.json", scratch / "export.tsv"
    conf.write_text(json.dumps({"linear_tags": True, "area_tags": True, "include_tags": [*tags.keys, *MORE_KEYS]}))
    _run(
        "osmium", "export", "-c", conf, "-f", "pg", "-u", "type_id", "--geometry-types=linestring,polygon",
        "--overwrite", "-o", target, path,
    )  # fmt: skip
    lines = target.read_text(encoding="utf-8").splitlines()
    parts = [line.split("\t") for line in lines]
    kind = np.array([part[0][0] for part in parts])
    number = np.array([int(part[0][1:]) for part in parts], dtype=np.int64)
    geometry = _from_wkb(np.array([part[1] for part in parts], dtype=object))
    said = [json.loads(part[2].replace("\\\\", "\\")) for part in parts]
    is_area, is_way = kind == "a", (kind == "w") | (number % 2 == 0)
    as_line = np.where(shapely.is_closed(geometry), "ring", "open")
    shape = np.where(is_way, np.where(is_area, "filled", as_line), "relation")
    identifier = np.where(is_area, number // 2, number)
    once = np.flatnonzero(identifier < COPY)
    return [Objects([said[at] for at in once], geometry[once], shape[once], identifier[once])]


def measured(objects: list[Objects], tags: Tags, frame: Frame, copies: dict[int, set[str]]) -> pd.DataFrame:
    """Classify objects and measure them: one row an object, class and form."""
    return gathered([_measured(each, tags, frame, copies) for each in objects])


def _measured(objects: Objects, tags: Tags, frame: Frame, copies: dict[int, set[str]]) -> pd.DataFrame:
    known: dict[Any, list[tuple[str, str]]] = {}
    rows = []
    identifier = objects.identifier.tolist()
    for index, (said, shape) in enumerate(zip(objects.tags, objects.shape.tolist(), strict=True)):
        signature = (shape, *sorted(said.items()))
        if signature not in known:
            known[signature] = tags.forms(said, shape)
        apart = copies.get(identifier[index], ())
        rows += [(index, name, form) for name, form in known[signature] if name not in apart]
    at = np.array([row[0] for row in rows], dtype=np.int64)
    form = np.array([row[2] for row in rows], dtype=object)
    shapes = frame.project(objects.geometry[at])
    most_m = np.array(
        [tags.widest_m(objects.tags[index], name) if form == "area" else math.inf for index, name, form in rows]
    )
    for index in np.flatnonzero(most_m < math.inf):
        radius = shapely.maximum_inscribed_circle(_area(shapes[index]), 0.01)
        form[index] = "line" if shapely.length(radius) > most_m[index] / 2 else "area"
    size, holes, meets = sizes(shapes, form == "area", frame)
    table = pd.DataFrame(
        {
            "kind": np.where(objects.shape[at] == "relation", "r", "w"),
            "id": objects.identifier[at] % COPY,
            "class": [row[1] for row in rows],
            "form": form,
            "size": size,
            "holes": holes,
        }
    )
    return table[meets]


def sizes(geometry: Any, is_area: Any, frame: Frame) -> tuple[Any, Any, Any]:  # noqa: ANN401 - arrays
    """Area or length, area of holes, and whether they meet the frame; edges that two rings share are no outline."""
    is_ring = shapely.get_dimensions(geometry) == 1
    filled = geometry.copy()
    for index in np.flatnonzero(is_area & is_ring):
        filled[index] = _area(geometry[index])
    filled[~is_ring | is_area] = shapely.make_valid(filled[~is_ring | is_area])
    parts, owner = _polygons(filled)
    area = shapely.area(parts)
    outer = shapely.area(shapely.polygons(shapely.get_exterior_ring(parts)))
    length = np.where(is_ring, shapely.length(geometry), np.bincount(owner, shapely.length(parts), len(geometry)))
    size = np.where(is_area, np.bincount(owner, area, len(geometry)), length)
    holes = np.where(is_area, np.bincount(owner, outer - area, len(geometry)), 0.0)
    return size, holes, shapely.intersects(geometry, shapely.box(*frame.bounds_m))


def _area(geometry: Any) -> Any:  # noqa: ANN401 - a geometry
    """Return an area, or what a line encloses."""
    if shapely.get_dimensions(geometry) != 1:
        return geometry
    points = shapely.get_coordinates(geometry)
    return shapely.Polygon(points) if len(points) > 3 else shapely.Polygon()  # a triangle


def _polygons(geometry: Any) -> tuple[Any, Any]:  # noqa: ANN401 - arrays
    """All polygons in geometries, and which of them each belongs to."""
    parts, first = shapely.get_parts(geometry, return_index=True)
    parts, second = shapely.get_parts(parts, return_index=True)
    is_polygon = shapely.get_dimensions(parts) == 2
    return parts[is_polygon], first[second][is_polygon]


def gathered(tables: list[pd.DataFrame]) -> pd.DataFrame:
    """One row for each object, class and form."""
    return pd.concat(tables).groupby(KEY, as_index=False)[MEASURES].sum()
