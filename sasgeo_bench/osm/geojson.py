# SPDX-License-Identifier: Apache-2.0
"""Read features of OpenStreetMap that come as GeoJSON, such as the building labels of a mosaic."""

import datetime as dt
import json
import re
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Final, NamedTuple

import shapely

from sasgeo_bench.core.errors import ExtractError, counted, named
from sasgeo_bench.core.json import MOST_BYTES, parse_json
from sasgeo_bench.core.paths import plain_file
from sasgeo_bench.geometry.projection import WGS84
from sasgeo_bench.osm.multipolygons import MIN_RING_POINTS
from sasgeo_bench.osm.scan import BUILT_UP, Box, Classifier, Get, Scan, ScanRow
from sasgeo_bench.osm.taxonomy import Label, Taxonomy
from sasgeo_bench.osm.xml_text import NEW_IDS

NO_TIME: Final = dt.datetime(1970, 1, 1, tzinfo=dt.UTC)
_LONLAT: Final = re.compile(r"(.*[:/])?(CRS84h?|4326|WGS ?84)", re.IGNORECASE)  # names in files before RFC 7946
_MORE_TAGS: Final = ("all_tags", "other_tags", "tags")
_NO_TAGS: Final = (*_MORE_TAGS, "osm_id", "osm_way_id", "osm_type", "version", "timestamp", "type", "id", "@id")
_NUMBERS: Final = ("layer", "level", "width", "lanes", "height")  # of which 0 and 1 are values
# Keys that say yes or no; not `oneway`, whose F and T in shapefiles of OpenStreetMap are forward and backward.
_SWITCHES: Final = (
    "bridge",
    "tunnel",
    "building",
    "building:part",
    "area",
    "covered",
    "indoor",
    "cutting",
    "embankment",
)
_YES: Final = ("yes", "true", "t", "y", "1")
_NO: Final = ("no", "false", "f", "n", "0")
_WHOLE: Final = re.compile(r"([-+]?[0-9]+)\.0*")
_HSTORE: Final = re.compile(r'"((?:[^"\\]|\\.)*)"\s*=>\s*"((?:[^"\\]|\\.)*)"')
_NAMED_ID: Final = re.compile(r"(n|w|r|a|node|way|relation)/?([0-9]{1,12})")
_TYPES: Final = ("osm_type", "@type", "element", "element_type", "type")
_OBJECTS: Final = {"n": "node", "w": "way", "r": "relation", "node": "node", "way": "way", "relation": "relation"}
_EXACT: Final = 2**53  # whole numbers below it are exact as floats
_CLASSLESS: Final = " without a class"
_CLOSED: Final = "closed line that is no polygon"
_OTHER: Final = " with the tags of a line or an area"
_UNREAD: Final = (_CLASSLESS, _CLOSED, _OTHER)  # how the reasons end for which a feature in the region is no object
_ASK: Final = "are they tags of OpenStreetMap, are areas polygons, and does `tags` say what all of them have?"
_MOST_NAMED: Final = 8
_LEAST_CLASSED: Final = 0.05
_AREAS: Final = ("Polygon", "MultiPolygon")
_LINES: Final = ("LineString", "MultiLineString")
_MOST_LATITUDE_DEG: Final = 90.0
_MOST_LONGITUDE_DEG: Final = 180.0


def scan_geojson(files: Sequence[Path], taxonomy: Taxonomy, *, tags: Mapping[str, str], box: Box) -> Scan:
    """Read the features of GeoJSON files as `scan_file` reads an OSM file.

    Properties are tags (`tags_of`); `tags` are added where a feature lacks them. Properties or the id of a feature say
    which object of OpenStreetMap it is (`identity_of`); without them it gets a negative id. Features of one object are
    its parts, and one that stands there twice is taken once. A closed way that comes as a line and as an area, as from
    `osmium export`, is what it is in an OSM file. `box` is west, south, east, north, degrees; features outside it are
    neither classified nor counted.

    Raise `ExtractError`, which names the file and the feature, if a file is no GeoJSON in longitude and latitude, or a
    geometry is broken, or there are features in the box and none has a class.
    """
    scan, keys = Scan(), Counter[str]()
    classifier = Classifier(taxonomy, scan)
    frame = shapely.box(*box)
    found: list[_Found] = []
    for path in files:
        features = list(features_of(path))
        is_ogr = any("osm_way_id" in _properties(feature) for feature in features)
        for number, feature in enumerate(features):
            shape = _shape(feature, path, number)
            if shape is None:
                scan.tally.drops["feature without a geometry"] += 1
            elif not shapely.intersects(shape, frame):
                scan.far.append(bytes(shapely.to_wkb(shape)))
            else:
                found.append(_Found({**tags, **tags_of(feature)}, identity_of(feature, is_ogr=is_ogr), shape))
                keys.update(list(_properties(feature)))
    parts: dict[tuple[Identity, int], int] = {}
    rings = {_ring(each) for each in found if each.shape.geom_type in _LINES} - {None}
    twins = rings & {_ring(each) for each in found if rings and each.shape.geom_type in _AREAS}
    for each in found:
        _take(each, scan, classifier, parts, is_twin=bool(twins) and _ring(each) in twins)
    _check_classed(scan, files, keys)
    return scan


class _Found(NamedTuple):
    """A feature in the region: its tags, the object that it is of, its geometry."""

    tags: Mapping[str, str]
    identity: "Identity | None"
    shape: shapely.Geometry


def _ring(found: _Found) -> tuple[bytes, frozenset[tuple[str, str]]] | None:
    """Return the ring and the tags of what may be a closed way, as a line or as an area; None of what is none."""
    parts = shapely.get_parts(found.shape)
    if len(parts) != 1 or shapely.get_num_interior_rings(parts[0]) > 0:
        return None
    points = shapely.get_coordinates(parts[0])
    if len(points) <= MIN_RING_POINTS or (points[0] != points[-1]).any():
        return None
    return bytes(shapely.to_wkb(shapely.normalize(shapely.polygons(points)))), frozenset(found.tags.items())


def _check_classed(scan: Scan, files: Sequence[Path], keys: Counter[str]) -> None:
    """Refuse files with features in the region of which none has a class; `keys` are those of their properties."""
    unread = _unread(scan)
    if scan.rows or not unread:
        return
    names = ", ".join(key[:40] for key, _ in keys.most_common(_MOST_NAMED)) or "none"  # characters
    more = ", ..." if len(keys) > _MOST_NAMED else ""
    raise ExtractError(
        f"{named([path.name for path in files], 'file')}: none of {counted(unread.total(), 'feature')} in the region "
        f"has a class ({_reasons(unread)}); their properties are {names}{more}: {_ASK}"
    )


def _unread(scan: Scan) -> Counter[str]:
    return Counter({reason: count for reason, count in scan.tally.drops.items() if reason.endswith(_UNREAD)})


def _reasons(unread: Counter[str]) -> str:
    return ", ".join(f"{count} x {reason}" for reason, count in unread.most_common())


def classless(scan: Scan) -> str:
    """Return a warning if fewer than 5 % of the features have a class, else an empty text.

    Then the tags most likely stand where they were not looked for.
    """
    unread = _unread(scan)
    features = unread.total() + len(scan.rows)
    if len(scan.rows) >= _LEAST_CLASSED * features:
        return ""
    return (
        f"{len(scan.rows)} of {counted(features, 'feature')} became objects of a class ({_reasons(unread)}). "
        f"Their properties: {_ASK}"
    )


def features_of(path: Path, *, epsg: int | None = None) -> Iterator[Any]:
    """Yield the features of a file, after a check of its form and its coordinate reference system.

    It is longitude and latitude (RFC 7946), unless the user says which one by `epsg`. Raise `ExtractError` if the file
    is no FeatureCollection, or says another one.
    """
    if path.stat().st_size > MOST_BYTES:
        raise ExtractError(f"{path} has more than {MOST_BYTES / 1e6:.0f} MB: cut it to the region")
    text = b""
    try:
        text = plain_file(path).read_bytes().removeprefix(b"\xef\xbb\xbf")
        content = parse_json(text)
    except (OSError, ValueError) as error:
        message = f"{path} cannot be read as GeoJSON ({str(error)[:200]}): get it again"
        if _is_sequence(text):
            message = f"{path} is a sequence of features: make one FeatureCollection of them (ogr2ogr -f GeoJSON)"
        raise ExtractError(message) from error
    features = content.get("features") if isinstance(content, dict) else None
    if not isinstance(features, list) or content.get("type") != "FeatureCollection":
        raise ExtractError(f"{path} is no GeoJSON FeatureCollection: export the features of OpenStreetMap as one")
    crs = content.get("crs")
    if crs is not None and not _is_of(crs, epsg):
        what = "GeoJSON is in longitude and latitude" if epsg is None else f"its [[own_map]] says epsg = {epsg}"
        raise ExtractError(f"{path} is in {json.dumps(crs)[:100]}, {what}: reproject it to EPSG:{epsg or WGS84}")
    for number, feature in enumerate(features):
        properties = feature.get("properties") if isinstance(feature, dict) else None
        if not isinstance(properties, dict | None):
            raise ExtractError(
                f"{path}: the properties of feature {number} are {json.dumps(properties)[:60]}, and no object "
                "of keys and values: mend or remove it"
            )
        yield feature


def _is_sequence(text: bytes) -> bool:
    """Return whether a text is a sequence of features: after RFC 8142, or one a line."""
    first, _, rest = text.lstrip().partition(b"\n")
    is_line = first.rstrip().endswith(b"}") and b'"Feature"' in first
    return first.startswith(b"\x1e") or (is_line and rest.lstrip().startswith(b"{"))


def _is_of(crs: Any, epsg: int | None) -> bool:  # noqa: ANN401 - what a file holds
    """Return whether the member `crs` of a file names a CRS; None is longitude and latitude."""
    members = crs.get("properties", crs) if isinstance(crs, dict) else {"name": crs}
    name = members.get("name", members.get("code")) if isinstance(members, dict) else None
    if epsg in (None, WGS84):
        return _LONLAT.fullmatch(str(name)) is not None
    return re.search(rf"(^|\D){epsg}$", str(name)) is not None


def _properties(feature: object) -> Mapping[str, object]:
    return (feature.get("properties") if isinstance(feature, dict) else None) or {}


def _shape(feature: Any, path: Path, number: int) -> shapely.Geometry | None:  # noqa: ANN401 - what a file holds
    """Return the geometry of a feature, mended where its rings cross; None if it has none."""
    shape = shape_of(feature, path, number)
    if shape is None or shape.is_valid:
        return shape
    return shapely.make_valid(shape, method="structure", keep_collapsed=False)


def shape_of(feature: Any, path: Path, number: int, *, is_lonlat: bool = True) -> shapely.Geometry | None:  # noqa: ANN401 - what a file holds
    """Return the geometry of a feature as it is; None if it has none.

    Raise `ExtractError`, which names the feature by its number, if it is broken, or not in longitude and latitude.
    """
    geometry = feature.get("geometry") if isinstance(feature, dict) else None
    if geometry is None and isinstance(feature, dict):
        return None
    try:
        shape = shapely.geometry.shape(geometry)
        fault = _fault(shape) if is_lonlat else ""
    except (ValueError, TypeError, AttributeError, KeyError, IndexError, shapely.errors.ShapelyError) as error:
        fault = str(error)[:200] or "no geometry"
    if fault:
        raise ExtractError(f"{path}: feature {number} has a broken geometry ({fault}): remove or mend it")
    return None if shape.is_empty else shape


def _fault(shape: shapely.Geometry) -> str:
    """Describe coordinates that are no longitudes and latitudes, or return an empty text."""
    if shape.is_empty:
        return ""
    west, south, east, north = shape.bounds
    is_across = -_MOST_LONGITUDE_DEG <= west <= east <= _MOST_LONGITUDE_DEG
    is_up = -_MOST_LATITUDE_DEG <= south <= north <= _MOST_LATITUDE_DEG
    return "" if is_across and is_up else f"its bounds {shape.bounds} are no longitudes and latitudes"


def tags_of(feature: object) -> dict[str, str]:
    """Return the tags of a feature, from properties, and from what they hold of further tags.

    osmtogeojson has an object `tags`, ogr2ogr a text `other_tags` ("key"=>"value" or JSON); own properties come first.
    No value and an empty text are no tag. True, false and numbers become what a mapper writes: yes, no, and whole
    numbers without a fraction. Of keys that say yes or no, such as `bridge`, so do 1, "t", "Y" or "0.0"; texts of other
    keys stay as they are.

    >>> tags_of({"properties": {"bridge": False, "layer": -1.0, "name": "", "other_tags": '"highway"=>"path"'}})
    {'highway': 'path', 'bridge': 'no', 'layer': '-1'}
    """
    properties, found = _properties(feature), dict[str, str]()
    for name in _MORE_TAGS:
        found |= _texts(_parsed(properties.get(name)))
    return found | _texts({key: value for key, value in properties.items() if key not in _NO_TAGS})


def _parsed(value: object) -> Mapping[str, object]:
    """Return tags from an object, or a text of JSON or of PostgreSQL's hstore."""
    if isinstance(value, str) and value.lstrip().startswith("{"):
        try:
            value = parse_json(value)
        except ValueError:
            return {}
    if isinstance(value, str):
        return {_unescaped(key): _unescaped(text) for key, text in _HSTORE.findall(value)}
    return value if isinstance(value, dict) else {}


def _unescaped(text: str) -> str:
    return re.sub(r"\\(.)", r"\1", text)


def _texts(values: Mapping[str, object]) -> dict[str, str]:
    return {key: text for key, value in values.items() if (text := _text(key, value))}


def _text(key: str, value: object) -> str:
    """Return a value as a mapper writes it; empty for none."""
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, float) and value.is_integer():
        value = int(value)
    if not isinstance(value, str | int | float):
        return ""
    text = str(value).strip()
    if text.lower() in ("", "none", "null", "<null>", "nan"):  # how tables write that there is no value
        return ""
    if key not in _NUMBERS and key not in _SWITCHES:
        return text
    whole = _WHOLE.fullmatch(text)
    text = str(int(whole[1])) if whole is not None else text
    if key in _NUMBERS:
        return text
    return "yes" if text.lower() in _YES else "no" if text.lower() in _NO else text


class Identity(NamedTuple):
    """An object of OpenStreetMap; the type of one that is not known to be a relation counts as way."""

    is_relation: bool
    osm_id: int


def identity_of(feature: Mapping[str, object], *, is_ogr: bool = False) -> Identity | None:
    """Return which object of OpenStreetMap a feature is, or None if it does not say so.

    Read are `osm_id` with `osm_type`, `osm_way_id` (ogr2ogr), `id` or `@id` with a type (`_TYPES`), and "way/7" in
    `@id`, `@osmId`, `id` or the id of the feature, where "a14" is the area of way 7 (osmium). A negative `osm_id` is
    that of a relation, as osm2pgsql writes it. So is that of an area without a type if `is_ogr`: ogr2ogr gives areas
    `osm_way_id` if they are ways and `osm_id` if they are relations.

    >>> identity_of({"id": "relation/7", "properties": {}})
    Identity(is_relation=True, osm_id=7)
    >>> identity_of({"properties": {"osm_id": "13", "osm_type": "way"}})
    Identity(is_relation=False, osm_id=13)
    """
    properties = _properties(feature)
    types = (str(properties.get(name)).lower() for name in _TYPES)
    kind = next((_OBJECTS[each] for each in types if each in _OBJECTS), "")
    for value in (*(properties.get(name) for name in ("@id", "@osmId", "id")), feature.get("id")):
        named = _NAMED_ID.fullmatch(value) if isinstance(value, str) else None
        if named is not None and named[1] == "a":
            return Identity(int(named[2]) % 2 == 1, int(named[2]) // 2)
        if named is not None:
            return Identity(named[1].startswith("r"), int(named[2]))
    if is_ogr and not kind and (number := _whole(properties.get("osm_way_id"))):
        return Identity(is_relation=False, osm_id=abs(number))
    is_relation = kind == "relation" or (is_ogr and not kind and _kind_of(feature) in _AREAS)
    for name in ("osm_id", "osm_way_id", "osmid", *(("id", "@id") if kind else ())):
        number = _whole(properties.get(name))
        if number:
            return Identity(is_relation or number < 0, abs(number))
    return None


def _kind_of(feature: Mapping[str, object]) -> str:
    geometry = feature.get("geometry")
    return str(geometry.get("type") if isinstance(geometry, dict) else None)


def _whole(value: object) -> int | None:
    """Return an id of at most 62 bits, also of a text or a float; None if it is none."""
    if isinstance(value, bool) or not isinstance(value, int | float | str):
        return None
    if isinstance(value, float):
        return int(value) if value.is_integer() and abs(value) < _EXACT else None
    text = str(value).strip()
    is_number = re.fullmatch(r"-?[0-9]{1,19}(\.0+)?", text) is not None
    number = int(text.split(".")[0]) if is_number else 0
    return number if abs(number) < NEW_IDS else None


def _take(
    found: _Found, scan: Scan, classifier: Classifier, parts: dict[tuple[Identity, int], int], *, is_twin: bool
) -> None:
    """Classify one feature by its tags, and keep it under its id; a further part joins those before it."""
    # `is_twin`: it is one of the two features, a line and an area, that a closed way came as.
    get, identity, shape = found.tags.get, found.identity, found.shape
    labels: tuple[Label, ...] = ()
    is_area = shape.geom_type in _AREAS
    if is_area:
        labels = classifier.area_labels(get, is_relation=not is_twin)
    elif shape.geom_type in _LINES:
        labels = classifier.as_line(get).line
    wkb = bytes(shapely.to_wkb(shape))
    if not labels:
        reason = _reason(get, shape, classifier)
        if not is_twin or reason.endswith(_CLASSLESS):
            scan.tally.drops[reason] += 1
        scan.far.append(wkb)
        if is_area and get("landuse") in BUILT_UP:
            scan.built_up.append(wkb)
        return
    kind = classifier.kind(get, labels, is_area=is_area)
    if identity is None:
        scan.tally.notes["feature without the id of an object"] += 1
        scan.rows.append(ScanRow(wkb, kind, -1 - len(scan.rows), False, 0, NO_TIME))  # noqa: FBT003
        return
    place = parts.setdefault((identity, kind), len(scan.rows))
    if place == len(scan.rows):
        scan.rows.append(ScanRow(wkb, kind, identity.osm_id, identity.is_relation, 0, NO_TIME))
        return
    before = shapely.from_wkb(scan.rows[place].wkb)
    if shapely.covers(before, shape):
        scan.tally.notes["object that stands there twice, taken once"] += 1
        return
    scan.tally.notes["further part of an object, joined to it"] += 1
    scan.rows[place] = scan.rows[place]._replace(wkb=bytes(shapely.to_wkb(_joined(before, shape))))


def _reason(get: Get, shape: shapely.Geometry, classifier: Classifier) -> str:
    """Say why a feature is no object: it has no class, or one that this kind of geometry cannot have."""
    if not classifier.area_labels(get, is_relation=True):
        return f"{shape.geom_type}{_CLASSLESS}"
    is_closed = shape.geom_type in _LINES and bool(shapely.is_closed(shapely.get_parts(shape)).all())
    return _CLOSED if is_closed else f"{shape.geom_type}{_OTHER}"


def _joined(before: shapely.Geometry, part: shapely.Geometry) -> shapely.Geometry:
    if part.geom_type in _AREAS:
        return shapely.union(before, part)
    return shapely.multilinestrings(shapely.get_parts([before, part]))
