# SPDX-License-Identifier: Apache-2.0
"""A fix as files for maps and flights have it, and the texts of such files: GPX, GeoJSON, KML, TUM."""

import datetime as dt
import json
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Final
from xml.etree import ElementTree as ET

from sasgeo_bench.core.texts import plain

NS: Final = 1_000_000_000  # nanoseconds of a second
_GX: Final = "http://www.google.com/kml/ext/2.2"


@dataclass(frozen=True, kw_only=True)
class PlacedFix:
    """Where a view was taken by a method's answer, and how far to trust it.

    Parameters
    ----------
    name : str
        File of a picture, or id of a view.
    lon_deg, lat_deg : float
        WGS84.
    east_m, north_m : float
        In the map's CRS.
    heading_deg, yaw_deg : float
        Clockwise from true north, and from the north of the map's grid.
    is_accepted : bool
        Whether the fix may be relied on.
    p_false : float, optional
        Stated chance that it may not.
    covariance : tuple of float, optional
        3 x 3, row by row, in the order true east, true north, heading; m2, m deg and deg2.
    time_ns : int, optional
        Of the view; whose clock this is, the holder of the fix says.
    delay_s : float, optional
        From the view until the answer was there.
    height_m : float, optional
        Above the ground, as it was believed.
    is_jump : bool
        Whether it contradicts the fix before it and the odometer, or there was no odometer between them.
    comment : str
        For a reader.
    """

    name: str
    lon_deg: float
    lat_deg: float
    east_m: float
    north_m: float
    heading_deg: float
    yaw_deg: float
    is_accepted: bool
    p_false: float | None = None
    covariance: tuple[float, ...] | None = None
    time_ns: int | None = None
    delay_s: float | None = None
    height_m: float | None = None
    is_jump: bool = False
    comment: str = ""

    @property
    def words(self) -> str:
        """Return heading and trust in words."""
        trust = "" if self.p_false is None else f", P(false fix) {self.p_false:.3f}"
        return plain(f"heading {self.heading_deg:.0f} deg{trust}")


def iso_utc(time_ns: int) -> str:
    """Return a time since 1970, nanoseconds, as GPX and KML write UTC, to a millisecond.

    >>> iso_utc(1714558830_250_000_000)
    '2024-05-01T10:20:30.250Z'
    """
    ms = (time_ns + 500_000) // 1_000_000
    whole = dt.datetime.fromtimestamp(ms // 1000, tz=dt.UTC)
    return f"{whole:%Y-%m-%dT%H:%M:%S}.{ms % 1000:03d}Z"


def geojson_text(points: Iterable[tuple[float, float, Mapping[str, object]]], credit: str) -> str:
    """Return longitudes, latitudes and properties as points of GeoJSON (RFC 7946)."""
    features = [
        {"type": "Feature", "geometry": {"type": "Point", "coordinates": [lon, lat]}, "properties": properties}
        for lon, lat, properties in points
    ]
    return json.dumps({"type": "FeatureCollection", "attribution": credit, "features": features}, indent=1) + "\n"


def gpx_text(fixes: Sequence[PlacedFix], credit: str, *, track: str | None = None) -> str:
    """Return fixes as waypoints of GPX 1.1; with the name of a `track` as its points, whose times are UTC.

    A fix that is not accepted says so: its `fix` is "none".
    """
    root = ET.Element("gpx", version="1.1", creator="sasgeo-bench", xmlns="http://www.topografix.com/GPX/1/1")
    ET.SubElement(ET.SubElement(root, "metadata"), "desc").text = plain(f"map data: {credit}")
    parent, tag = root, "wpt"
    if track is not None:
        line = ET.SubElement(root, "trk")
        ET.SubElement(line, "name").text = plain(track)
        parent, tag = ET.SubElement(line, "trkseg"), "trkpt"
    for fix in fixes:
        point = ET.SubElement(parent, tag, lat=f"{fix.lat_deg:.7f}", lon=f"{fix.lon_deg:.7f}")
        if track is not None and fix.time_ns is not None:
            ET.SubElement(point, "time").text = iso_utc(fix.time_ns)
        ET.SubElement(point, "name").text = plain(fix.name)
        if fix.comment:
            ET.SubElement(point, "cmt").text = plain(fix.comment)
        ET.SubElement(point, "desc").text = fix.words
        if not fix.is_accepted:
            ET.SubElement(point, "fix").text = "none"
    return _xml(root)


def kml_text(fixes: Sequence[PlacedFix], credit: str, *, track: str | None = None) -> str:
    """Return fixes as placemarks of KML 2.2, clamped to the ground; with a name as one `gx:Track`, times in UTC."""
    root = ET.Element("kml", xmlns="http://www.opengis.net/kml/2.2")
    document = ET.SubElement(root, "Document")
    ET.SubElement(document, "description").text = plain(f"map data: {credit}")
    if track is not None:
        root.set("xmlns:gx", _GX)
        mark = ET.SubElement(document, "Placemark")
        ET.SubElement(mark, "name").text = plain(track)
        line = ET.SubElement(mark, "gx:Track")
        ET.SubElement(line, "altitudeMode").text = "clampToGround"
        for fix in fixes:
            ET.SubElement(line, "when").text = iso_utc(fix.time_ns or 0)
        for fix in fixes:
            ET.SubElement(line, "gx:coord").text = f"{fix.lon_deg:.7f} {fix.lat_deg:.7f} 0"
        for fix in fixes:
            ET.SubElement(line, "gx:angles").text = f"{fix.heading_deg:.2f} 0 0"
        return _xml(root)
    for fix in fixes:
        mark = ET.SubElement(document, "Placemark")
        ET.SubElement(mark, "name").text = plain(fix.name)
        ET.SubElement(mark, "description").text = fix.words
        point = ET.SubElement(mark, "Point")
        ET.SubElement(point, "altitudeMode").text = "clampToGround"
        ET.SubElement(point, "coordinates").text = f"{fix.lon_deg:.7f},{fix.lat_deg:.7f}"
    return _xml(root)


def tum_text(fixes: Iterable[PlacedFix]) -> str:
    """Return fixes as a TUM trajectory: time, x, y, z and the quaternion x, y, z, w of the heading.

    x and y are metres of the map's grid, z the height above the ground, 0 where none is known. The body's x points
    ahead: a heading of north is a turn by 90 degrees from east. Fixes without a time are left out.
    """
    lines = ["# time x y z qx qy qz qw"]
    for fix in fixes:
        if fix.time_ns is None:
            continue
        half = math.radians(90.0 - fix.yaw_deg) / 2
        # A float has no room for nanoseconds since 1970.
        lines.append(
            f"{fix.time_ns // NS}.{fix.time_ns % NS:09d} {fix.east_m:.3f} {fix.north_m:.3f} {fix.height_m or 0.0:.3f} "
            f"0 0 {math.sin(half):.9f} {math.cos(half):.9f}"
        )
    return "\n".join(lines) + "\n"


def _xml(root: ET.Element) -> str:
    ET.indent(root)
    return ET.tostring(root, encoding="unicode", xml_declaration=True) + "\n"
