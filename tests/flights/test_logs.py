# SPDX-License-Identifier: Apache-2.0
"""Flight logs: formats and units, cut to a region, and one line for each fault of a file."""

import datetime as dt
import gzip
import io
import math
import sys
import zipfile
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pyproj
import pytest
import shapely
from hypothesis import given
from hypothesis import strategies as st

from sasgeo_bench.core.errors import ConfigError, FlightError
from sasgeo_bench.flights import log_points
from sasgeo_bench.flights.log_points import steps_m
from sasgeo_bench.flights.log_units import LogFacts
from sasgeo_bench.flights.logs import FlownPath, read_flight, read_log
from sasgeo_bench.flights.plans import flight_area
from sasgeo_bench.geometry.grid import Grid
from sasgeo_bench.geometry.pose import bearing_deg, wrap_deg
from sasgeo_bench.regions.region import Region
from sasgeo_bench.regions.region_files import read_region
from sasgeo_bench.sensing.camera import Attitude
from sasgeo_bench.sensing.ground import Dem
from tests.flights.autopilots import Flown, bag, mavros_messages, px4_topics, ulog
from tests.sensing.test_ground import write_dem

LON, LAT = 9.52, 47.14
START = dt.datetime(2025, 5, 1, 10, tzinfo=dt.UTC)
BOMB = """<?xml version="1.0"?><!DOCTYPE lolz [<!ENTITY lol "lol"><!ENTITY lol2 "&lol;&lol;&lol;&lol;&lol;&lol;&lol;">
<!ENTITY lol3 "&lol2;&lol2;&lol2;&lol2;&lol2;&lol2;">]>{}"""
EXTERNAL = '<?xml version="1.0"?><!DOCTYPE x [<!ENTITY e SYSTEM "file:///etc/hostname">]>{}'
POINT = '<trkpt lat="{}" lon="{}">{}</trkpt>'
SUM = "<trkpt lat='47.14' lon='9.52'><time>&lol3;</time></trkpt>"
LINE = "<kml><Document><Placemark><LineString><coordinates>{}</coordinates></LineString></Placemark></Document></kml>"


def _points(count: int = 5, *, step_deg: float = 1e-4) -> list[tuple[float, float, int]]:
    """Longitude, latitude and seconds of a flight to the north at 11 m/s."""
    return [(LON, round(LAT + at * step_deg, 7), at) for at in range(count)]


def _gpx(points: list[tuple[float, float, int]], *, tag: str = "trk", times: bool = True) -> str:
    stamps = [(START + dt.timedelta(seconds=at)).isoformat().replace("+00:00", "Z") for _, _, at in points]
    time = "<time>{}</time>" if times else ""
    body = "".join(POINT.format(lat, lon, time.format(at)) for (lon, lat, _), at in zip(points, stamps, strict=True))
    head = '<?xml version="1.0"?><gpx xmlns="http://www.topografix.com/GPX/1/1">'
    inner = f"<trk><trkseg>{body}</trkseg></trk>" if tag == "trk" else f"<rte>{body.replace('trkpt', 'rtept')}</rte>"
    return f"{head}{inner}</gpx>"


def _csv(head: str, *rows: str) -> str:
    return "\n".join([head, *rows, ""])


@pytest.fixture
def written(tmp_path: Path) -> Callable[[str, str], Path]:
    def write(name: str, text: str) -> Path:
        path = tmp_path / name
        path.write_text(text, encoding="utf-8")
        return path

    return write


@pytest.fixture(scope="module")
def region(lay_towns: Callable[..., Path], tmp_path_factory: pytest.TempPathFactory) -> Region:
    out = lay_towns(tmp_path_factory.mktemp("logged") / "out", "town-grid")
    return read_region(out / "regions" / "town-grid")


def _refused(path: Path) -> str:
    with pytest.raises(FlightError) as fault:
        read_log(path)
    line = str(fault.value)
    assert line.isprintable()
    assert len(line) < 500
    assert path.name in line
    return line


# Formats


@pytest.mark.parametrize("tag", ["trk", "rte"])
def test_a_gpx_track_or_route_has_places_and_times(written, tag) -> None:
    text = _gpx(_points(), tag=tag)
    segments = text.replace("</trkpt><trkpt", "</trkpt></trkseg><trkseg><trkpt", 1)  # of a track follow each other
    for log in (read_log(written("a.gpx", text)), read_log(written("b.gpx", segments))):
        assert log.lat_deg.tolist() == [lat for _, lat, _ in _points()]
        assert log.lon_deg.tolist() == [LON] * 5
        assert log.time_s.tolist() == [0, 1, 2, 3, 4]
        assert (log.height_m, log.yaw_deg) == (None, None)


@pytest.mark.parametrize(("mode", "heights"), [("relativeToGround", [80, 90]), ("absolute", None), ("", None)])
def test_a_kml_line_has_heights_above_the_ground_alone_and_no_times(written, mode, heights) -> None:
    line = LINE.format("\n 9.52,47.14,80 \t 9.52,47.15,90\n")
    text = line.replace("<coordinates>", f"<altitudeMode>{mode}</altitudeMode><coordinates>")
    log = read_log(written("a.KML", text))
    assert log.time_s is None
    assert (None if log.height_m is None else log.height_m.tolist()) == heights


@pytest.mark.parametrize(
    ("name", "text", "expected"),
    [
        ("a.gpx", _gpx(_points()).replace("<time>", "<ele>480</ele><time>", 3),
         "altitudes, which are not those of all points"),
        ("b.gpx", _gpx(_points()).replace("<time>", "<ele>480</ele><time>").replace("480", "-.-", 1),
         "altitudes, which are not those of all points"),
        ("a.kml", LINE.format("9.52,47.14,80 9.52,47.15,90"),
         "altitudes, which are neither relative to the ground nor absolute"),
        ("a.csv", "lat,lon,height_furlong,heading_mil\n1,1,2,3\n1,2,2,3", "'height_furlong', 'heading_mil'"),
        ("b.csv", "lat,lon,date,altitude,time_s,\n1,1,x,2,1,\n1,1.00001,y,2,3,",
         "'date', 'altitude'; an altitude is read if one column of them states its unit"),
        ("e.csv", "lat,lon,altitude_m,time_s,\n1,1,2,1,\n1,1.00001,,3,", "'altitude_m'; an altitude is read if"),
        ("c.csv", "lat,lon,pitch_deg,\x1b[31m\n1,1,2,3\n1,2,2,3", "'pitch_deg', '?[31m'"),
        ("d.csv", "lat,lon," + ",".join(f"c{at:0>99}" for at in range(99)), "'c000"),
    ],
)  # fmt: skip
def test_what_of_a_file_is_not_read_is_reported_in_one_line(
    written: Callable, name: str, text: str, expected: str
) -> None:
    if name == "d.csv":
        text += "".join(f"\n1,{at + 1}" + ",5" * 99 for at in range(2))
    last = read_log(
        written(name, text), LogFacts(time_unit="none") if name in ("a.csv", "c.csv", "d.csv") else None
    ).notes[-1]
    assert last.startswith(f"not read: {expected}")
    assert last.isprintable()
    assert len(last) < 600


def test_a_kml_track_has_times_and_times_of_other_elements_are_not_its_own(written: Callable) -> None:
    whens = "".join(f"<when>2025-05-01T10:00:0{at}Z</when>" for at in range(3))
    coords = "".join(f"<gx:coord>9.52 {47.14 + at / 1e4} 60</gx:coord>" for at in range(3))
    other = "<Placemark><TimeStamp><when>2020-01-01T00:00:00Z</when></TimeStamp></Placemark>"
    model = "<Model><altitudeMode>absolute</altitudeMode></Model>"
    text = (
        f'<kml xmlns:gx="http://www.google.com/kml/ext/2.2">{other}<gx:Track><altitudeMode>relativeToGround'
        f"</altitudeMode>{whens}{coords}{model}</gx:Track>{other}</kml>"
    )
    log = read_log(written("a.kml", text))
    assert (log.time_s.tolist(), log.height_m.tolist()) == ([0, 1, 2], [60, 60, 60])
    assert (log.start_s, log.altitude_m) == (START.timestamp(), None)
    above_sea = read_log(written("b.kml", text.replace("relativeToGround", "absolute").replace("Z</when>", "</when>")))
    assert (above_sea.altitude_m.tolist(), above_sea.altitude_of) == ([60, 60, 60], "geoid")
    assert (above_sea.height_m, above_sea.start_s) == (None, None)  # a time without a zone


def _kml_track(count: int, mode: str, *, up: str = " 60", first: int = 0) -> str:
    ats = range(first, first + count)
    whens = "".join(f"<when>2025-05-01T05:00:{at:02}-05:00</when>" for at in ats)
    coords = "".join(f"<gx:coord>9.52 {47.14 + at / 1e4}{up}</gx:coord>" for at in ats)
    return f"<gx:Track>{mode}{whens}{coords}</gx:Track>"


RELATIVE = "<altitudeMode>relativeToGround</altitudeMode>"


@pytest.mark.parametrize(
    ("inner", "found"),
    [
        (_kml_track(3, RELATIVE), [60, 60, 60]),
        (_kml_track(3, ""), None),  # what it counts from is not said
        (_kml_track(3, "<altitudeMode>clampToGround</altitudeMode>"), None),
        (_kml_track(3, "<gx:altitudeMode>relativeToSeaFloor</gx:altitudeMode>"), None),
        (_kml_track(3, RELATIVE, up=""), None),
        (_kml_track(3, RELATIVE).replace("60</gx:coord></gx:Track>", "</gx:coord></gx:Track>"), None),  # not of all
        (_kml_track(1, RELATIVE), "a flight has two points at least, the log has 1"),
        (_kml_track(1, RELATIVE) + _kml_track(3, RELATIVE, first=5), "2 lines or tracks, one is read"),
    ],
)
def test_a_kml_track_keeps_every_time_and_heights_of_a_stated_mode_alone(written: Callable, inner, found) -> None:
    path = written("a.kml", f'<kml xmlns:gx="http://www.google.com/kml/ext/2.2"><Placemark>{inner}</Placemark></kml>')
    if isinstance(found, str):
        assert found in _refused(path)
        return
    log = read_log(path)
    assert log.time_s.tolist() == [0, 1, 2]
    assert log.start_s == START.timestamp()  # of a zone west of Greenwich
    assert (None if log.height_m is None else log.height_m.tolist()) == found


@pytest.mark.parametrize("zone", ["Z", "-05:00", "+09:30"])
def test_times_of_a_gpx_are_moments_in_any_zone(written: Callable, zone: str) -> None:
    local = START + (dt.datetime.fromisoformat(f"2025-05-01T00:00:00{zone}").utcoffset() or dt.timedelta())
    text = _gpx(_points())
    for at in range(5):
        here = (local + dt.timedelta(seconds=at)).strftime("%Y-%m-%dT%H:%M:%S")
        text = text.replace(f"2025-05-01T10:00:0{at}Z", f"{here}{zone}")
    log = read_log(written("a.gpx", text))
    assert (log.start_s, log.time_s.tolist()) == (START.timestamp(), [0, 1, 2, 3, 4])


@pytest.mark.parametrize("name", ["a.gpx", "a.csv"])
def test_a_log_over_the_antimeridian_is_one_flight(written: Callable, name: str) -> None:
    points = [((179.9995 + at * 1e-4 + 180) % 360 - 180, -16.5, at) for at in range(10)]
    rows = [f"{at},{lat},{lon:.7f}" for lon, lat, at in points]
    log = read_log(written(name, _gpx(points) if name == "a.gpx" else _csv("time_s,lat,lon", *rows)))
    assert log.lon_deg.min() < -179.9 < 179.9 < log.lon_deg.max()
    way_m = 1e-4 * np.pi / 180 * 6_378_137 * np.cos(np.radians(16.5))
    assert steps_m(log.lon_deg, log.lat_deg) == pytest.approx(way_m, rel=1e-2)
    path = written("b.csv", _csv("time_s,lat,lon", *(row.replace(",-179.", ",180.") for row in rows)))
    assert "longitude 180.9" in _refused(path)


def test_altitudes_below_the_sea_are_read(written: Callable) -> None:
    log = read_log(written("a.gpx", _gpx(_points()).replace("<time>", "<ele>-412.5</ele><time>")))  # at the Dead Sea
    assert log.altitude_m.tolist() == [-412.5] * 5


def test_a_kmz_is_the_kml_in_its_root(written: Callable, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    line = LINE.format("9.52,47.14,80 9.53,47.15,90")
    packed = io.BytesIO()
    with zipfile.ZipFile(packed, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("files/other.kml", "<kml/>")
        archive.writestr("doc.kml", line)
    path = tmp_path / "a.KMZ"
    path.write_bytes(packed.getvalue())
    assert read_log(path).lat_deg.tolist() == read_log(written("a.kml", line)).lat_deg.tolist()
    with monkeypatch.context() as patch:
        patch.setattr(log_points, "MOST_BYTES", 10_000)
        with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
            archive.writestr("doc.kml", line + " " * 99_999)
        assert "bytes unpacked: keep the track alone" in _refused(path)
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("files/other.kml", line)
    assert "holds no KML in its root" in _refused(path)


def test_a_gpx_track_starts_in_utc_and_does_not_say_which_sea_its_elevations_count_from(written: Callable) -> None:
    log = read_log(written("a.gpx", _gpx(_points()).replace("<time>", "<ele>480.5</ele><time>")))
    assert (log.start_s, log.altitude_m.tolist(), log.altitude_of) == (START.timestamp(), [480.5] * 5, "unknown")
    bare = read_log(written("b.gpx", _gpx(_points(), times=False)))
    assert (bare.start_s, bare.altitude_m, bare.height_m) == (None, None, None)


@pytest.mark.parametrize("year", ["1970", "2100"])
def test_a_clock_that_was_not_set_tells_no_utc(written: Callable, year: str) -> None:
    with pytest.warns(UserWarning, match="its clock was not set, as it tells no date from 1980 to 2038"):
        log = read_log(written("a.gpx", _gpx(_points()).replace(f"<time>{START.year}", f"<time>{year}")))
    assert (log.start_s, len(log)) == (None, 5)


@pytest.mark.parametrize(
    "text",
    [
        _csv("# made by hand", "", "lat_deg\tlon_deg\ttime_ms", "47.14\t9.52\t5000", "47.1401\t9.52\t6000", "\t\t"),
        _csv("utc,lat,lon", '"2025-05-01T10:00:00+02:00",47.14,9.52', "2025-05-01T08:00:01Z,47.1401,9.52"),
        _csv("utc,lat,lon", "2025-05-01 10:00:00 UTC,47.14,9.52", "2025-05-01 12:00:01.0 UTC+02:00,47.1401,9.52"),
    ],
)
def test_a_csv_log_is_the_same_flight_by_any_of_its_names_and_units(written: Callable, text: str) -> None:
    log = read_log(written("a.csv", text))
    assert log.lat_deg.tolist() == [47.14, 47.1401]
    assert log.lon_deg.tolist() == [9.52, 9.52]
    assert log.time_s == pytest.approx([0, 1])


# Faults


@pytest.mark.parametrize(
    ("text", "match"),
    [
        (_csv("lat,lon", "47.14,9.52"), "two points at least, the log has 1"),
        ("", "empty: copy it anew, or export more"),
        ("\n", "no column of latitude and longitude, found none: name them lat_deg and lon_deg"),
        (_csv("x,y\x1b[31m,lat", "1,2,3"), r"no column of longitude, found 'x', 'y\?\[31m', 'lat'"),
        (_csv("lat,lon,GPS.lat", "1,2,3"), "latitude is ambiguous, columns 'lat', 'GPS.lat': keep one"),
        (_csv("lat,lon,yaw_deg,heading_rad", "1,2,3,4"), "yaw is ambiguous, columns 'yaw_deg', 'heading_rad'"),
        (_csv("lat,lon", "47.14,9.52", "nan,9.52"), "line 3: latitude is no number, 'nan'"),
        (_csv("lat,lon", "47.14,9.52", "4_7,9.52"), "line 3: latitude is no number"),
        (_csv("lat,lon", "47.14,9.52", ",9.52"), "line 3: latitude is missing"),
        (_csv("lat,lon", "47.14,9.52", "47.1,\x1b]0;x\x07"), r"line 3: longitude is no number, '\?\]0;x\?'"),
        (_csv("lat,lon", "47.14,9.52", "97.14,9.52"), "line 3: latitude 97.14, longitude 9.52 are no degrees on Earth"),
        (_csv("lat,lon", "47.14,9.52", "47.14,189.5"), "line 3: latitude 47.14, longitude 189.5 are no degrees"),
        (_csv("lat,lon", "47.14,9.52", "0,0"), "line 3: latitude and longitude are 0, which is no fix"),
        (_csv("lat;lon", "47.14;9.52", "47,14;9,52"), "line 3: latitude is no number, .*decimals with a point"),
        (_csv("lat,lon", "47.14,9.52", "47.14"), "line 3: 1 cells, the head has 2"),
        (_csv("lat,lon", "47.14,9.52", '47.1,"9.5'), "line 3: no sound CSV"),
        (_csv("lat,lon,time_s", "47.14,9.52,3", "47.1401,9.52,2"), "line 3: time goes back by 1 s: sort"),
        (_csv("lat,lon,time_s", "47.14,9.52,-1e308", "47.1401,9.52,1e308"), "line 2: time is no number, '-1e308'"),
        (_csv("lat,lon,time_s", "47.14,9.52,3", "47.1401,9.52,"), "line 3: time is missing"),
        (_csv("lat,lon,time", "47.14,9.52,2025-05-01T10:00:00", "47.2,9.52,6"), "line 3: time is no date and time"),
        (_csv("lat,lon,time_s", "47.14,9.52,3", "48.14,9.52,4"), "line 3: moves at 111183 m/s since the point before"),
        (_csv("lat,lon,hdg_cdeg", "47.14,9.52,65535", "47.15,9.52,9000"),
         "line 2: yaw, column 'hdg_cdeg', cdeg, is 655.35 degrees, bey"),
        (_csv("lat,lon,yaw_rad", "47.14,9.52,1", "47.15,9.52,190"),
         "line 3: yaw, column 'yaw_rad', rad, is 10886.2 deg"),
        (_csv("lat_e7,lon", "471400000.5,9.52", "47,9"),
         "'lat_e7' has decimals, .* of 1e-7 degrees: name it by its unit"),
        (_csv("lat,lon,height_m", "47.14,9.52,2e4", "47.15,9.52,80"),
         "line 2: height, column 'height_m', m, is 20000 m, beyond 10000"),
    ],
)  # fmt: skip
def test_each_fault_of_a_table_is_one_line_that_names_the_place_and_the_mend(written, text, match) -> None:
    with pytest.raises(FlightError, match=match):
        raise FlightError(_refused(written("a.csv", text)))


@pytest.mark.parametrize(
    ("name", "text", "match"),
    [
        ("a.gpx", BOMB.format(f"<gpx>{SUM}</gpx>"), "has a document type or entities"),
        ("a.kml", BOMB.format(LINE.format("&lol3;")), "has a document type or entities"),
        ("a.gpx", EXTERNAL.format(f"<gpx>{POINT.format(1, 2, '<time>&e;</time>')}</gpx>"), "has a document type or"),
        ("a.kml", EXTERNAL.format(LINE.format("&e;")), "has a document type or entities"),
        ("a.gpx", "<gpx><trk>", "no sound XML"),
        ("a.gpx", "<gpx>" + "<a>" * 9000, "more than 10000000 elements, or 64 in each other: keep the track alone"),
        ("a.gpx", _gpx(_points()).replace("<time>", "<time/><time>"), "point 1: time is no date and time"),
        ("a.gpx", "<gpx/>", "holds no track or route: export that of the flight"),
        ("a.gpx", _gpx(_points()).replace("</trk>", "</trk><trk></trk>"), "more than one track"),
        ("a.gpx", _gpx(_points(), tag="rte").replace("</rtept><", "</rtept></rte><rte><", 1), "more than one route"),
        ("a.gpx", _gpx(_points()).replace("<time>2025-05-01T10:00:02Z</time>", ""), "4 of 5 points have a time"),
        ("a.gpx", _gpx(_points()).replace("10:00:02Z", "10:00:00Z"), "point 3: time goes back by 1 s"),
        ("a.gpx", f"<gpx {' '.join(f'a{at}=' + repr('') for at in range(20000))}/>", "a tag has more than 100000 char"),
        ("a.gpx", _gpx(_points()).replace("2025-05-01T10:00:02Z", "&#9;noon"), "point 3: time is no date and time"),
        ("a.gpx", _gpx(_points()).replace('lat="47.1402"', 'lat="NaN"'), "point 3: latitude is no number, 'NaN'"),
        ("a.gpx", _gpx(_points()).replace('lat="47.1402"', ""), "point 3: latitude is missing"),
        ("a.gpx", _gpx(_points()).replace('lat="47.1402"', 'lat="-91"'),
         "point 3: latitude -91, longitude 9.52 are no"),
        ("a.kml", "<kml/>", "holds no line or track: export that of the flight"),
        ("a.kml", LINE.format("9,47 9,48").replace("</Document>", "<LineString/></Document>"), "2 lines or tracks"),
        ("a.kml", LINE.format("9.52, 47.14"), "point 1: longitude is no number|latitude is missing|is no longitude"),
        ("a.kml", LINE.format("9.52 47.14"), "point 1: '9.52' is no longitude, latitude and altitude"),
        ("a.kmz", "PK", "no sound KMZ"),
        ("a.zip", "PK", "no flight log that is read: .gpx, .kml, .kmz, .srt, .ulg, .*.csv, .pos, .tum, .txt, .*gz are"),
    ],
)  # fmt: skip
def test_each_fault_of_a_track_is_one_line_that_names_the_point_and_the_mend(written, name, text, match) -> None:
    with pytest.raises(FlightError, match=match):
        raise FlightError(_refused(written(name, text)))


def test_files_that_are_missing_too_large_or_no_text_are_refused(written, tmp_path, monkeypatch) -> None:
    assert "there is no flight log" in _refused(tmp_path / "none.csv")
    binary = tmp_path / "a.csv"
    binary.write_bytes(b"lat,lon\n\xff\xfe,9\n")
    assert "no text in UTF-8" in _refused(binary)
    binary.write_bytes(b"\x00" * 100)
    _refused(binary)
    tracks = [written("b.gpx", _gpx(_points(9))), written("b.kml", LINE.format("9,47 " * 9))]
    tables = [written("b.csv", _csv("lat,lon", *(f"{lat},{lon}" for lon, lat, _ in _points(9))))]
    for path in (*tracks, *tables):
        with monkeypatch.context() as patch:
            patch.setattr(log_points, "MOST_POINTS", 8)
            assert "more than 8 points" in _refused(path)
        with monkeypatch.context() as patch:
            patch.setattr(log_points, "MOST_BYTES", 8)
            assert "at most 8 are read" in _refused(path)


@given(st.binary(max_size=300), st.sampled_from([".gpx", ".kml", ".csv"]))
def test_any_bytes_are_read_or_refused_in_one_line(tmp_path_factory, content, suffix) -> None:
    path = tmp_path_factory.mktemp("any") / f"a{suffix}"
    path.write_bytes(content)
    assert _refused(path)


def test_points_before_the_first_fix_and_of_one_time_or_place_are_left_out_with_a_word(written) -> None:
    """Logs of PX4 and ArduPilot begin at 0, 0; those with times in whole seconds repeat them."""
    rows = [f"{at // 2},{LAT + at * 5e-5 if at > 3 else 0},{LON if at > 3 else 0},8" for at in range(20)]
    path = written("a.csv", _csv("time_s,lat,lon,height_m", *rows))
    with pytest.warns(UserWarning, match=r"a\.csv: left out") as caught:
        log = read_log(path)
    assert [str(each.message) for each in caught] == [
        "a.csv: left out 4 points at 0, 0 before the first fix",
        "a.csv: left out 8 points with the time of the point before",
    ]
    assert log.time_s.tolist() == list(range(8))
    assert log.lat_deg[:2] == pytest.approx([LAT + 2e-4, LAT + 3e-4])
    with pytest.warns(UserWarning, match=r"a\.kml: left out 1 point with the place of the point before"):
        log = read_log(written("a.kml", LINE.format("9.52,47.14 9.52,47.14 9.52,47.15")))
    assert log.lat_deg.tolist() == [47.14, 47.15]


def test_more_elements_than_a_track_has_and_a_log_of_days_are_refused(written, monkeypatch, region) -> None:
    monkeypatch.setattr(log_points, "_MOST_ELEMENTS", 8)
    assert "more than 8 elements" in _refused(written("a.gpx", "<gpx>" + "<a/>" * 8))
    path = written("a.csv", _csv("time_s,lat,lon", "0,48.05,11.05", "300000,48.05,11.06"))
    with pytest.raises(FlightError, match=r"lasts 300000 s, more than 1000000 steps of 0\.2 s: cut it"):
        read_flight(path, region, height_m=80.0)


# Onto a region


def _lonlat(region: Region, en_m: np.ndarray) -> np.ndarray:
    to_degrees = pyproj.Transformer.from_crs(f"EPSG:{region.manifest.epsg}", "EPSG:4326", always_xy=True)
    return np.stack(to_degrees.transform(*en_m.T), axis=1)


def _table(region: Region, en_m: np.ndarray, *, speed_mps: float = 10.0, more: str = "", cells: str = "") -> str:
    """A log of points in the region's CRS at an even speed."""
    time_s = np.append(0.0, np.cumsum(np.hypot(*np.diff(en_m, axis=0).T))) / speed_mps
    rows = [
        f"{at!r},{lat!r},{lon!r}{cells}"
        for at, (lon, lat) in zip(time_s.tolist(), _lonlat(region, en_m).tolist(), strict=True)
    ]
    return _csv(f"time_s,lat,lon{more}", *rows)


def _across(region: Region, *, beyond_m: float = 0.0, points: int = 400) -> np.ndarray:
    """A straight way to grid east through the middle of a region, and beyond its edges."""
    west, south, east, north = region.grid.bounds_m
    east_m = np.linspace(west - beyond_m, east + beyond_m, points)
    return np.column_stack([east_m, np.full(points, (south + north) / 2)])


def test_a_log_is_cut_to_its_longest_stretch_inside(written: Callable, region: Region) -> None:
    flown = read_flight(written("a.csv", _table(region, _across(region, beyond_m=500.0))), region, height_m=100.0)
    west, south, east, north = region.grid.bounds_m
    assert flown.position_m[0] == pytest.approx([west + 100, (south + north) / 2, 100], abs=2.1)
    assert flown.position_m[-1] == pytest.approx([east - 100, (south + north) / 2, 100], abs=2.1)
    assert flight_area(region, 100.0).covers(shapely.LineString(flown.position_m[:, :2]))
    assert np.diff(flown.time_s) == pytest.approx(0.2)
    assert flown.time_s[0] == pytest.approx(60, abs=0.3)
    assert np.diff(flown.distance_m) == pytest.approx(2.0, abs=0.01)
    assert wrap_deg(flown.yaw_deg - 90) == pytest.approx(0, abs=0.05)


def test_a_log_is_cut_at_ground_that_is_not_mapped(written: Callable, region: Region) -> None:
    west, south, east, north = region.grid.bounds_m
    hole = shapely.box(west + 700, south, west + 800, north)
    holed = replace(region, coverage=region.coverage.difference(hole))
    path = written("a.csv", _table(region, _across(region)))
    flown = read_flight(path, holed, height_m=100.0, margin_m=50.0)
    assert flown.position_m[0, 0] == pytest.approx(west + 850, abs=2.1)
    assert flown.position_m[-1, 0] == pytest.approx(east - 50, abs=2.1)


def test_a_log_is_cut_at_a_gap_unless_it_has_no_times(written: Callable, region: Region) -> None:
    places = _across(region, points=200)
    gapped = np.delete(places, range(60, 80), axis=0)
    west = region.grid.bounds_m[0]
    flown = read_flight(written("a.csv", _table(region, gapped)), region, height_m=100.0)
    assert flown.position_m[0, 0] == pytest.approx(places[80, 0], abs=2.1)
    lines = " ".join(f"{lon},{lat}" for lon, lat in _lonlat(region, gapped).tolist())
    whole = read_flight(written("a.kml", LINE.format(lines)), region, height_m=100.0, facts=LogFacts(speed_mps=8.0))
    assert whole.position_m[0, 0] == pytest.approx(west + 100, abs=2.1)
    # Even on the ellipsoid; the grid of a UTM zone is 0.04 % smaller in the zone's middle.
    assert np.diff(whole.distance_m) / 0.2 == pytest.approx(8.0, rel=2e-3)


def test_a_log_that_leaves_is_refused_in_one_line_with_the_longest_stretch(written: Callable, region: Region) -> None:
    near = written("b.csv", _table(region, _across(region)[:100]))
    with pytest.raises(FlightError, match=r"leaves town-grid: of \d+ m .* has 40\d m, 1000 m are .* a smaller --l"):
        read_flight(near, region, height_m=100.0)
    assert read_flight(near, region, height_m=100.0, least_m=400.0).distance_m[-1] > 400


@pytest.mark.parametrize(
    ("rows", "where"),
    [
        (["47.14,9.52,0", "47.15,9.52,100"], "at latitude 47.1400 to 47.1500, longitude 9.5200 to 9.5200"),
        (["-47.14,-170.52,0", "-47.15,-170.52,100"], "at latitude -47.1500 to -47.1400, longitude -170.5200"),
    ],
)
def test_a_log_beside_a_region_is_refused_by_where_both_lie(written, region, rows, where) -> None:
    path = written("a.csv", _csv("lat,lon,time_s", *rows))
    with pytest.raises(FlightError, match=rf"a\.csv lies elsewhere, {where} .*, and town-grid at latitude 48\.\d+ to"):
        read_flight(path, region, height_m=100.0)


@pytest.mark.parametrize(
    ("head", "turn", "hint"),
    [
        ("lon,lat,time_s", lambda lon, lat: (lat, lon), "longitude and latitude seem to be swapped"),
        ("lat,lon,time_s", lambda lon, lat: (math.radians(lat), math.radians(lon)), "or say --place-unit rad"),
        ("lat,lon,time_s", lambda lon, lat: (lat - 1, lon), "take another region$"),
    ],
)
def test_a_log_beside_a_region_whose_places_lie_on_it_otherwise_is_told_how(written, region, head, turn, hint) -> None:
    west, south, east, north = region.manifest.bounds_lonlat
    first, second = turn((west + east) / 2, (south + north) / 2)
    rows = [f"{first!r},{second!r},{at * 100}" if not at else f"{first + 1e-4!r},{second!r},100" for at in range(2)]
    with pytest.raises(FlightError, match=hint):
        read_flight(written("a.csv", _csv(head, *rows)), region, height_m=100.0)


def test_heights_come_from_the_log_or_are_given(written: Callable, region: Region) -> None:
    with_heights = written("a.csv", _table(region, _across(region), more=",height_m", cells=",70"))
    assert np.unique(read_flight(with_heights, region).position_m[:, 2]).tolist() == [70]
    assert np.unique(read_flight(with_heights, region, height_m=90.0).position_m[:, 2]).tolist() == [90]
    without = written("b.csv", _table(region, _across(region), more=",alt", cells=",470"))
    with pytest.raises(FlightError, match=r"b\.csv has no height above the ground: say one, as in --height 100"):
        read_flight(without, region)


def test_the_log_of_an_autopilot_is_flown_over_a_region(region: Region, tmp_path: Path) -> None:
    pytest.importorskip("pyulog", reason="needs the extra [logs]")
    places = _across(region)
    lon, lat = _lonlat(region, places).T
    time_s = np.arange(len(places)) * 0.5
    flown = SimpleNamespace(
        time_s=time_s, lon_deg=lon, lat_deg=lat, height_m=np.full(len(lon), 90.0), yaw_deg=np.full(len(lon), 30.0)
    )
    path = tmp_path / "a.ulg"
    path.write_bytes(ulog(px4_topics(flown)))
    over = read_flight(path, region)
    west, south, east, north = region.grid.bounds_m
    assert over.position_m[0] == pytest.approx([west + 100, (south + north) / 2, 90], abs=2.5)
    assert over.position_m[-1] == pytest.approx([east - 100, (south + north) / 2, 90], abs=2.5)
    convergence = pyproj.Proj(f"EPSG:{region.manifest.epsg}").get_factors(lon[0], lat[0]).meridian_convergence
    assert over.yaw_deg == pytest.approx(30 - convergence, abs=0.05)


def test_a_bag_is_known_by_all_files_of_its_folder(tmp_path: Path) -> None:
    pytest.importorskip("rosbags", reason="needs the extra [logs]")
    first, second = (bag(tmp_path / f"{at}.mcap", mavros_messages(Flown(count=9 + at))) for at in range(2))
    keys = [FlownPath(file=folder).key for folder in (first, second)]
    assert keys[0] != keys[1]
    assert FlownPath(file=first).key == keys[0]


def test_a_flight_that_never_leaves_the_ground_is_refused(written: Callable, region: Region) -> None:
    path = written("a.csv", _table(region, _across(region), more=",height_m", cells=",4.5"))
    with pytest.raises(FlightError, match=r"a\.csv never leaves the ground: 4\.5 m above it at most, 5 m are needed"):
        read_flight(path, region)


def test_what_is_on_the_ground_is_left_out(written: Callable, region: Region) -> None:
    places = _across(region)
    lines = _table(region, places, more=",height_m").splitlines()
    rows = [f"{line},{min(100.0, max(0.0, at - 100.0))}" for at, line in enumerate(lines[1:])]
    flown = read_flight(written("a.csv", _csv(lines[0], *rows)), region)
    assert flown.position_m[0, 2] == pytest.approx(5, abs=0.4)
    assert flown.position_m[0, 0] == pytest.approx(places[105, 0], abs=2.1)


@pytest.mark.parametrize(
    ("own_m", "expected_m", "where"),
    [
        ((0, 4.9, 80, 90, 5, 0), (0, 4.9, 120, 120, 120, 0), "where its own is 5 m at least"),
        ((1, 2, 1, 2, 1, 2), (120,) * 6, "throughout"),  # as of a log whose heights say nothing
        ((50, 60, 50, 60, 50, 60), (120,) * 6, "throughout"),
    ],
)
def test_a_height_that_is_said_is_that_of_the_flight_and_not_of_the_ground_before_it(
    written: Callable, own_m: tuple[float, ...], expected_m: tuple[float, ...], where: str
) -> None:
    line = " ".join(f"9.52,{47.14 + at / 1e4:.4f},{height}" for at, height in enumerate(own_m))
    shape = f"<coordinates>{line}</coordinates><altitudeMode>relativeToGround</altitudeMode>"
    log = read_log(written("a.kml", f"<kml><LineString>{shape}</LineString></kml>"), height_m=120.0)
    assert log.height_m is not None
    assert log.height_m.tolist() == list(expected_m)
    assert log.notes[-1] == f"height: 120 m {where}, as --height says"


def test_yaw_of_a_log_is_turned_from_true_north_to_the_grid(written: Callable, region: Region) -> None:
    places = _across(region)
    path = written("a.csv", _table(region, places, more=",yaw_deg,pitch_deg,roll_deg", cells=",30,-8,4"))
    flown = read_flight(path, region, height_m=100.0)
    (lon, lat) = _lonlat(region, flown.position_m[:1, :2])[0]
    to_grid = pyproj.Transformer.from_crs("EPSG:4326", f"EPSG:{region.manifest.epsg}", always_xy=True)
    east, north = to_grid.transform([lon, lon], [lat, lat + 1e-5])
    true_north = float(bearing_deg(east[1] - east[0], north[1] - north[0]))
    assert abs(wrap_deg(true_north)) > 1  # else the test would show nothing
    assert wrap_deg(flown.yaw_deg[0] - 30 - true_north) == pytest.approx(0, abs=0.01)
    level = Attitude(yaw_deg=float(flown.yaw_deg[0]), pitch_deg=-8, roll_deg=4).matrix
    assert flown.rotation.apply([0.0, 0.0, 1.0])[0, 2] == pytest.approx(-level[2, 2])


def test_while_a_drone_hovers_it_points_where_it_flew(written: Callable, region: Region) -> None:
    west, south, *_ = region.grid.bounds_m
    start = np.array([west + 200, south + 200])
    offsets_m = [(at * 10.0, 0.0) for at in range(121)] + [(1200.0, at * 0.01) for at in range(1, 6)]
    places = start + np.array(offsets_m)
    rows = [f"{at},{lat!r},{lon!r}" for at, (lon, lat) in enumerate(_lonlat(region, places).tolist())]
    flown = read_flight(written("a.csv", _csv("time_s,lat,lon", *rows)), region, height_m=50.0)
    assert wrap_deg(flown.yaw_deg - 90) == pytest.approx(0, abs=1.0)


def test_a_tum_file_in_the_regions_frame_is_cut_alike(tmp_path: Path, region: Region) -> None:
    places = _across(region)
    rows = [f"{at} {east!r} {north!r} 75 0 0 0 1" for at, (east, north) in enumerate(places.tolist())]
    path = tmp_path / "run.txt.gz"
    path.write_bytes(gzip.compress("\n".join(rows).encode()))
    flown = read_flight(path, region)
    assert flown.position_m[0] == pytest.approx([places[0, 0] + 100, places[0, 1], 75], abs=1.1)
    assert np.unique(flown.quaternion_xyzw.round(9), axis=0).tolist() == [[0, 0, 0, 1]]
    path.write_bytes(gzip.compress(b"0 1 2 75 0 0 0 1\n"))
    with pytest.raises(FlightError, match="two poses at least, got 1"):
        read_flight(path, region)
    path.write_bytes(gzip.compress(b"0 1 2 75 0 0 0 1\n9 90 2 75 0 0 0 1\n"))
    with pytest.raises(FlightError, match=r"run\.txt\.gz leaves town-grid: of 89 m .* has 0 m"):
        read_flight(path, region)


@pytest.mark.parametrize(
    "wish",
    [
        {"step_s": 0.0},
        {"step_s": 1e9},
        {"least_m": float("nan")},
        {"height_m": -1.0},
        {"height_m": 1e9},
        {"margin_m": -1.0},
    ],
)
def test_wishes_that_cannot_be_are_refused(written: Callable, region: Region, wish: dict) -> None:
    path = written("a.csv", _table(region, _across(region)))
    with pytest.raises(FlightError, match=next(iter(wish)).removesuffix("_m")):
        read_flight(path, region, **({"height_m": 100.0} | wish))


# Autopilots


@pytest.mark.parametrize(
    ("name", "library"), [("a.ulg", "pyulog"), ("a.bin", "pymavlink"), ("a.tlog", "pymavlink"), ("a.bag", "rosbags")]
)
def test_a_log_whose_library_is_not_installed_names_the_extra(
    written: Callable, monkeypatch: pytest.MonkeyPatch, name: str, library: str
) -> None:
    for module in [one for one in sys.modules if one.partition(".")[0] == library]:
        monkeypatch.delitem(sys.modules, module)
    monkeypatch.setitem(sys.modules, library, None)
    with pytest.raises(ConfigError, match=rf"needs the package {library}: pip install 'sasgeo-bench\[logs\]'"):
        read_log(written(name, ""))


# Heights above the ground by altitudes


def above_a_slope(region: Region) -> str:
    """A GPX of a level flight due east at 600 m above the sea, over ground that rises from 400 m in the west."""
    west, south, east, north = region.manifest.bounds_m
    to_lonlat = pyproj.Transformer.from_crs(region.manifest.epsg, 4326, always_xy=True)
    places = [to_lonlat.transform(x, (south + north) / 2) for x in np.arange(west, east, 10.0)]
    points = [(lon, lat, second) for second, (lon, lat) in enumerate(places)]
    return _gpx(points).replace("<time>", "<ele>600</ele><time>")


def test_heights_are_altitudes_less_those_of_the_ground_or_of_the_take_off(written, region, tmp_path) -> None:
    path = written("a.gpx", above_a_slope(region))
    with pytest.raises(FlightError, match="say one, as in --height 100, or that of the ground by --dem or --takeoff"):
        read_flight(path, region)
    flown = read_flight(path, region, facts=LogFacts(takeoff_m=470.0))
    assert np.ptp(flown.position_m[:, 2]) == 0
    assert flown.position_m[0, 2] == 130
    west, south, east, north = region.manifest.bounds_m
    epsg = region.manifest.epsg
    grid = Grid.from_bounds(west - 100, south - 100, east + 100, north + 100, cell_size_m=10.0, epsg=epsg)
    columns = grid.west_m + 10.0 * (np.arange(grid.cols) + 0.5)
    ground_m = np.broadcast_to(400 + 0.2 * (columns - west), (grid.rows, grid.cols))
    dem = write_dem(tmp_path / "dem.tif", Dem(grid=grid, cells_m=ground_m.astype(np.float32)), crs=f"EPSG:{epsg}")
    flown = read_flight(path, region, facts=LogFacts(dem=dem), least_m=500.0)
    # down to 5 m above the ground, where the stretch ends
    expected = 600 - (400 + 0.2 * (flown.position_m[:, 0] - west))
    np.testing.assert_allclose(flown.position_m[:, 2], expected, atol=0.1)


@pytest.mark.parametrize(
    ("name", "facts", "words"),
    [
        ("a.gpx", {"takeoff_m": 470.0, "dem": Path("dem.tif")}, "give --height, --dem or --takeoff-height alone"),
        ("a.gpx", {"dem": Path("none.tif")}, "none.tif"),
        ("a.csv", {"takeoff_m": 470.0}, "a.csv has no altitude"),
        ("a.tum", {"takeoff_m": 470.0}, "a.tum has heights: leave out --dem and --takeoff-height"),
        ("a.kml", {"takeoff_m": 470.0}, "a.kml has no altitude"),
    ],
)
def test_what_altitudes_do_not_tell_is_refused(written, region, name, facts, words) -> None:
    west, south, east, north = region.manifest.bounds_lonlat
    ends = [((south + north) / 2, west), ((south + north) / 2, east)]
    texts = {
        "a.gpx": above_a_slope(region),
        "a.csv": _csv("lat,lon", *(f"{lat},{lon}" for lat, lon in ends)),
        "a.tum": "0 0 0 80 0 0 0 1\n1 9 0 80 0 0 0 1\n",
        "a.kml": LINE.format(" ".join(f"{lon},{lat}" for lat, lon in ends)),
    }
    with pytest.raises(FlightError, match=words):
        read_flight(written(name, texts[name]), region, facts=LogFacts(**facts))


@pytest.mark.parametrize("altitude", ["-8.3e127", "19001", "1e400"])
def test_an_altitude_that_none_can_be_is_refused_with_its_point_or_left_out(written, altitude) -> None:
    text = _gpx(_points()).replace("<time>", "<ele>480</ele><time>").replace("<ele>480", f"<ele>{altitude}", 1)
    if altitude == "1e400":  # no number: those of all points are left out
        assert read_log(written("a.gpx", text)).altitude_m is None
    else:
        assert "altitude is" in _refused(written("a.gpx", text))
