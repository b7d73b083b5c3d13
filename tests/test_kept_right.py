# SPDX-License-Identifier: Apache-2.0
"""What is right here where a good guess, or other software, is wrong: the table in docs/concepts/kept-right.md."""

from dataclasses import replace
from io import BytesIO

import numpy as np
import pyproj
import pytest
import shapely
from PIL import Image

from sasgeo_bench.core.errors import FlightError
from sasgeo_bench.flights.logs import read_log
from sasgeo_bench.geometry.grid import Grid
from sasgeo_bench.osm.read import read_extract
from sasgeo_bench.regions.layers import burn
from sasgeo_bench.sensing.image import decode_image
from sasgeo_bench.sensing.photos import read_photo
from tests.sensing.test_photos import POSE, write_photo, xmp_of

SQUARE = Grid(epsg=32631, west_m=0.0, north_m=10.0, cell_size_m=1.0, rows=10, cols=10)


def test_a_node_at_exactly_0_0_belongs_to_its_ring(tmp_path):
    places = [(0, 0), (0.001, 0), (0.001, 0.001), (0, 0.001)]
    nodes = "".join(f'<node id="{at + 1}" version="1" lon="{x}" lat="{y}"/>' for at, (x, y) in enumerate(places))
    refs = "".join(f'<nd ref="{ref}"/>' for ref in (1, 2, 3, 4, 1))
    path = tmp_path / "square.osm"
    path.write_text(f'<osm version="0.6">{nodes}<way id="1" version="1">{refs}<tag k="building" v="yes"/></way></osm>')
    grid = Grid.from_bounds(166_000.0, -100.0, 166_400.0, 300.0, cell_size_m=1.0, epsg=32631)
    (found,) = read_extract(path, grid, stated_coverage=shapely.box(-1, -1, 1, 1)).features.geometry
    assert shapely.get_num_coordinates(found) == 5
    assert found.area == pytest.approx(111.3 * 110.6, rel=2e-3)  # a square of 0.001 degrees on the equator


# A square of 10 x 10 cells, cut by lines through the centres of its cells: level, upright, both, aslant.
CUTS = {
    "level": [shapely.box(0, 0, 10, 5.5), shapely.box(0, 5.5, 10, 10)],
    "upright": [shapely.box(0, 0, 5.5, 10), shapely.box(5.5, 0, 10, 10)],
    "quarters": [shapely.box(*west, *east) for west, east in (((0, 0), (3.5, 2.5)), ((3.5, 0), (10, 2.5)), ((0, 2.5),
     (3.5, 10)), ((3.5, 2.5), (10, 10)))],
    "diagonal": [shapely.Polygon([(0, 0), (10, 0), (10, 10)]), shapely.Polygon([(0, 0), (10, 10), (0, 10)])],
    "falling": [shapely.Polygon([(0, 10), (0, 0), (10, 0)]), shapely.Polygon([(0, 10), (10, 0), (10, 10)])],
    "aslant": [shapely.Polygon([(0, 0), (10, 0), (10, 3.3), (9.9, 3.3)]), shapely.Polygon([(0, 0), (9.9, 3.3), (10,
     3.3), (10, 10), (0, 10)])],
    "fan": [shapely.Polygon([(4.5, 4.5), first, second]) for first, second in (((0, 0), (10, 0)), ((10, 0), (10, 10)),
     ((10, 10), (0, 10)), ((0, 10), (0, 0)))],
}  # fmt: skip


@pytest.mark.parametrize("parcels", CUTS.values(), ids=CUTS)
def test_parcels_that_tile_a_square_share_its_cells_out(parcels):
    drawn = [burn(shapely.orient_polygons(np.array([each])), SQUARE) for each in parcels]
    np.testing.assert_array_equal(np.sum(drawn, axis=0), 1)


def gpx(*times):
    points = "".join(
        f'<trkpt lat="{47.14 + at / 1e4:.4f}" lon="9.52"><time>{time}</time></trkpt>' for at, time in enumerate(times)
    )
    return f'<gpx xmlns="http://www.topografix.com/GPX/1/1"><trk><trkseg>{points}</trkseg></trk></gpx>'


def test_times_of_four_zones_in_one_track_agree(tmp_path):
    path = tmp_path / "zones.gpx"
    day = "2025-05-01T"
    path.write_text(gpx(f"{day}07:00:00-03:00", f"{day}06:30:01-03:30", f"{day}15:30:02+05:30", f"{day}10:00:03Z"))
    log = read_log(path)
    assert log.time_s is not None
    assert log.time_s.tolist() == [0, 1, 2, 3]


@pytest.mark.parametrize("moment", ["2016-12-31T23:59:60Z", "2016-12-31T24:00:00Z"])
def test_a_time_that_no_day_has_is_refused_by_its_point(tmp_path, moment):
    path = tmp_path / "leap.gpx"
    path.write_text(gpx("2016-12-31T23:59:58Z", "2016-12-31T23:59:59Z", moment))
    with pytest.raises(FlightError, match="point 3: time is no date and time"):
        read_log(path)


def kml(coords, angles=""):
    whens = "".join(f"<when>2025-05-01T10:00:0{at}Z</when>" for at in range(3))
    inner = "".join(f"<gx:coord>{each}</gx:coord>" for each in coords)
    return (
        '<kml xmlns:gx="http://www.google.com/kml/ext/2.2"><gx:Track><altitudeMode>relativeToGround</altitudeMode>'
        f"{whens}{inner}{angles}</gx:Track></kml>"
    )


def test_a_place_that_a_track_leaves_empty_is_refused(tmp_path):
    path = tmp_path / "track.kml"
    path.write_text(kml(["9.52 47.14 60", "", "9.52 47.1402 60"]))
    with pytest.raises(FlightError, match="point 2"):
        read_log(path)


@pytest.mark.parametrize("angles", ["", "<gx:angles/><gx:angles/><gx:angles/>"])
def test_no_heading_is_made_up_where_a_track_has_no_angles(tmp_path, angles):
    path = tmp_path / "track.kml"
    path.write_text(kml(["9.52 47.14 60", "9.52 47.1401 60", "9.52 47.1402 60"], angles))
    assert read_log(path).yaw_deg is None


@pytest.mark.parametrize("orientation", range(1, 9))
def test_every_format_is_turned_alike_by_its_orientation(orientation):
    stored = np.zeros((32, 48, 3), dtype=np.uint8)
    stored[:16, :24], stored[16:, :24], stored[:16, 24:] = (220, 0, 0), (0, 220, 0), (0, 0, 220)
    exif = Image.Exif()
    exif[0x0112] = orientation
    found = []
    for kind, how in (("PNG", {}), ("JPEG", {"quality": 95, "subsampling": 0}), ("WEBP", {"lossless": True})):
        buffer = BytesIO()
        Image.fromarray(stored).save(buffer, kind, exif=exif, **how)
        found.append(decode_image(buffer.getvalue()).astype(int))
    assert found[0].shape == ((32, 48, 3) if orientation < 5 else (48, 32, 3))
    np.testing.assert_array_equal(found[0], found[2])
    np.testing.assert_allclose(found[1], found[0], atol=60)  # JPEG blurs at the edges of the four fields
    assert np.abs(found[1] - found[0]).mean() < 3


# East and west of the zone's meridian, north and south of the equator, and beyond the zone.
PLACES = [
    (10.5, 47.0, 32632),
    (7.5, 47.0, 32632),
    (172.0, -43.5, 32759),
    (170.0, -43.5, 32759),
    (13.0, 47.0, 32632),
]


@pytest.mark.parametrize(("lon_deg", "lat_deg", "epsg"), PLACES)
def test_a_photo_heads_by_the_grid_in_the_south_and_beyond_the_zone_too(tmp_path, lon_deg, lat_deg, epsg):
    path = write_photo(tmp_path / "DJI_0001.JPG", xmp=xmp_of(POSE | {"GimbalYawDegree": "0"}))
    placed = replace(read_photo(path), lon_deg=lon_deg, lat_deg=lat_deg)
    convergence_deg = pyproj.Proj(epsg).get_factors(lon_deg, lat_deg).meridian_convergence
    assert abs(convergence_deg) > 0.3
    found = placed.camera(epsg=epsg).yaw_deg
    assert (found + convergence_deg + 180) % 360 - 180 == pytest.approx(0.0, abs=0.01)


def test_a_gimbal_on_its_back_looks_as_the_one_that_is_turned_round(tmp_path):
    names = ("GimbalYawDegree", "GimbalPitchDegree", "GimbalRollDegree")
    headings = []
    for angles in (("-150", "-90", "180"), ("30", "-90", "0"), ("30", "-90", "30")):
        path = write_photo(tmp_path / "DJI_0001.JPG", xmp=xmp_of(POSE | dict(zip(names, angles, strict=True))))
        headings.append(read_photo(path).camera().yaw_deg)
    first, second, other = headings
    assert first == pytest.approx(second, abs=1e-6)
    assert abs(first - other) > 1
