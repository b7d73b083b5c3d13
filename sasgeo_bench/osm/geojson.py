# SPDX-License-Identifier: Apache-2.0
"""Read features of OpenStreetMap that come as GeoJSON, such as the building labels of a mosaic."""

import datetime as dt
import json
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Final

import shapely

from sasgeo_bench.errors import ExtractError
from sasgeo_bench.files.json import MOST_BYTES, parse_json
from sasgeo_bench.osm.scan import Box, Classifier, Scan, ScanRow, Tally
from sasgeo_bench.osm.taxonomy import Label, Taxonomy

_NO_TIME: Final = dt.datetime(1970, 1, 1, tzinfo=dt.UTC)
_WGS84: Final = ("CRS84", "EPSG::4326", "EPSG:4326")  # ends of the names of longitude and latitude in old files
_IDENTITY: Final = ("osm_id", "osm_type", "version", "timestamp")
_AREAS: Final = ("Polygon", "MultiPolygon")
_LINES: Final = ("LineString", "MultiLineString")
_MOST_LATITUDE_DEG: Final = 90.0
_MOST_LONGITUDE_DEG: Final = 180.0


def scan_geojson(files: Sequence[Path], taxonomy: Taxonomy, *, tags: Mapping[str, str], box: Box) -> Scan:
    """Read the features of GeoJSON files as `scan_file` reads an OSM file.

    Properties are tags; `tags` are added where a feature lacks them. `osm_id` and `osm_type` say which object of
    OpenStreetMap a feature is; without them it gets a negative id, and an object that two files hold is taken once.
    `box` is west, south, east, north, degrees; features outside it are neither classified nor counted.

    Raise `ExtractError`, which names the file and the feature, if a file is no GeoJSON in longitude and latitude, or a
    geometry is broken.
    """
    scan = Scan()
    classifier = Classifier(taxonomy, scan)
    frame = shapely.box(*box)
    seen: set[tuple[bool, int]] = set()
    for path in files:
        for number, feature in enumerate(_features(path)):
            shape = _shape(feature, path, number)
            if shape is None:
                scan.tally.drops["feature without a geometry"] += 1
            elif not shapely.intersects(shape, frame):
                scan.far.append(bytes(shapely.to_wkb(shape)))
            else:
                _take(feature, shape, scan, classifier, tags, seen)
    return scan


def _features(path: Path) -> Iterator[Any]:
    """Yield the features of a file, after a check of its form and its coordinate reference system."""
    if path.stat().st_size > MOST_BYTES:
        message = f"{path} has more than {MOST_BYTES / 1e6:.0f} MB: cut it to the region"
        raise ExtractError(message)
    try:
        content = parse_json(path.read_bytes())
    except (OSError, ValueError) as error:
        message = f"{path} cannot be read as GeoJSON ({str(error)[:200]}): get it again"
        raise ExtractError(message) from error
    features = content.get("features") if isinstance(content, dict) else None
    if not isinstance(features, list) or content.get("type") != "FeatureCollection":
        message = f"{path} is no GeoJSON FeatureCollection: export the features of OpenStreetMap as one"
        raise ExtractError(message)
    crs = content.get("crs")
    if crs is not None and not json.dumps(crs).rstrip('"}').endswith(_WGS84):
        message = (
            f"{path} is in {json.dumps(crs)[:100]}, GeoJSON is in longitude and latitude: reproject it to EPSG:4326"
        )
        raise ExtractError(message)
    yield from features


def _shape(feature: Any, path: Path, number: int) -> shapely.Geometry | None:  # noqa: ANN401 - what a file holds
    """Return the geometry of a feature, mended where its rings cross; None if it has none."""
    geometry = feature.get("geometry") if isinstance(feature, dict) else None
    if geometry is None and isinstance(feature, dict):
        return None
    try:
        shape = shapely.geometry.shape(geometry)
        fault = _fault(shape)
    except (ValueError, TypeError, AttributeError, KeyError, IndexError, shapely.errors.ShapelyError) as error:
        fault = str(error)[:200] or "no geometry"
    if fault:
        message = f"{path}: feature {number} has a broken geometry ({fault}): remove or mend it"
        raise ExtractError(message)
    if shape.is_empty:
        return None
    return shape if shape.is_valid else shapely.make_valid(shape, method="structure", keep_collapsed=False)


def _fault(shape: shapely.Geometry) -> str:
    """Describe coordinates that are no longitudes and latitudes, or return an empty text."""
    if shape.is_empty:
        return ""
    west, south, east, north = shape.bounds
    is_across = -_MOST_LONGITUDE_DEG <= west <= east <= _MOST_LONGITUDE_DEG
    is_up = -_MOST_LATITUDE_DEG <= south <= north <= _MOST_LATITUDE_DEG
    return "" if is_across and is_up else f"its bounds {shape.bounds} are no longitudes and latitudes"


def _take(
    feature: Mapping[str, Any],
    shape: shapely.Geometry,
    scan: Scan,
    classifier: Classifier,
    tags: Mapping[str, str],
    seen: set[tuple[bool, int]],
) -> None:
    """Classify one feature by its tags, and keep it under its id."""
    properties = feature.get("properties") or {}
    own = {str(key): str(value) for key, value in properties.items() if value is not None and key not in _IDENTITY}
    get, is_relation = ({**tags, **own}).get, properties.get("osm_type") == "relation"
    is_area = shape.geom_type in _AREAS
    labels: tuple[Label, ...] = ()
    if is_area:
        labels = classifier.area_labels(get, is_relation=True)
    elif shape.geom_type in _LINES:
        labels = classifier.as_line(get).line
    if not labels:
        scan.tally.drops[f"{shape.geom_type} without a class"] += 1
        scan.far.append(bytes(shapely.to_wkb(shape)))
        return
    identifier = _identifier(properties, scan.tally, count=len(scan.rows))
    if (is_relation, identifier) in seen:
        scan.tally.notes["object that stands there twice, taken once"] += 1
        return
    seen.add((is_relation, identifier))
    kind = classifier.kind(get, labels, is_area=is_area)
    scan.rows.append(ScanRow(bytes(shapely.to_wkb(shape)), kind, identifier, is_relation, 0, _NO_TIME))


def _identifier(properties: Mapping[str, Any], tally: Tally, *, count: int) -> int:
    """Return the id of an object of OpenStreetMap, or a negative one of our own."""
    found = properties.get("osm_id")
    if isinstance(found, int) and not isinstance(found, bool) and 0 < found < 2**62:
        return found
    tally.notes["feature without the id of an object"] += 1
    return -1 - count
