# SPDX-License-Identifier: Apache-2.0
"""Subtitles of DJI's videos: each form that firmware writes, and one line for each fault of a file."""

import datetime as dt
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import pytest

from sasgeo_bench.core.errors import FlightError
from sasgeo_bench.flights.log_subtitles import Subtitles, read_srt
from sasgeo_bench.flights.log_units import LogFacts
from sasgeo_bench.flights.logs import read_log

Written = Callable[..., Subtitles]


def block(number: int, text: str, *, step_ms: int = 1000, begin_ms: int = 0) -> str:
    """A subtitle, one after the other at an even rate."""

    def stamp(ms: int) -> str:
        return f"{ms // 3_600_000:02}:{ms // 60_000 % 60:02}:{ms // 1000 % 60:02},{ms % 1000:03}"

    start = begin_ms + (number - 1) * step_ms
    return f"{number}\n{stamp(start)} --> {stamp(start + step_ms)}\n{text}\n\n"


@pytest.fixture
def read(tmp_path: Path) -> Written:
    def of(texts: Sequence[str], *, ending: str = "\n", encoding: str = "utf-8", **how: int) -> Subtitles:
        path = tmp_path / "DJI_0001.SRT"
        whole = "".join(block(at, text, **how) for at, text in enumerate(texts, start=1))
        path.write_bytes(whole.replace("\n", ending).encode(encoding))
        return read_srt(path)

    return of


def two(text: str) -> list[str]:
    """Two subtitles that differ in the last digit of the latitude, which is marked."""
    return [text.replace("#", "3"), text.replace("#", "4")]


FONT = '<font size="28">{} : 1, DiffTime : 33ms\n{}\n{} </font>'
CAMERA = "[iso : 110] [shutter : 1/200.0] [fnum : 280] [ev : 0.7] [ct : 5064] [color_md : default]"
MINI = f"{CAMERA} [focal_len : 240] [dzoom_ratio: 10000, delta:0],[latitude: 47.14000#] [longitude: 9.520001] "
PRY = "F.PRY (-5.3°, 2.1°, 28.3°), G.PRY (-40.0°, 1.0°, 28.2°)"
FORMS = {
    # Text; then longitude, latitude, height, altitude, angles of the camera and focal length on film that it says.
    "Mini 3 Pro": (MINI + "[rel_alt: 1.300 abs_alt: 189.2]", 9.520001, 47.140003, 1.3, 189.2, None, 24.0),
    "Mavic 3T": (
        FONT.format(
            "FrameCnt",
            "2023-06-28 18:43:56.810",
            "[focal_len: 40.00] [dzoom_ratio: 2.00], [latitude: -37.99609#] [longitude: 177.035704] "
            "[rel_alt: 75.645 abs_alt: 227.888] [gb_yaw: -76.8 gb_pitch: -49.1 gb_roll: 0.5]",
        ),
        *(177.035704, -37.996093, 75.645, 227.888, (-76.8, -49.1, 0.5), 80.0),
    ),
    "in brackets of their own": (
        "[latitude: 47.14000#] [longitude: 9.520001] [rel_alt: 60.1] [gb_yaw: 0.0] [gb_pitch: -90.0] [gb_roll: 0.0]",
        *(9.520001, 47.140003, 60.1, None, (0.0, -90.0, 0.0), None),
    ),
    "Mavic 2 Zoom": (
        FONT.format(
            "SrtCnt",
            "2023-01-06 18:56:48,380,821",
            CAMERA + " [focal_len : 350] [latitude : 47.14000#] [longtitude : -9.520001] [altitude: 350.000]",
        )
        + "\n</font>",
        *(-9.520001, 47.140003, None, 350.0, None, 35.0),
    ),
    "Mavic Mini": (
        "F/2.8, SS 206.14, ISO 150, EV 0, GPS (-82.6669, 27.771#, 10), D 2.80m, H -1.20m, H.S 3.00m/s, V.S 4.00m/s ",
        *(-82.6669, 27.7713, -1.2, None, None, None),
    ),
    "Mavic Pro": (
        "HOME(149.0251,-20.2532) 2017.08.05 14:11:51\nGPS(149.0251,-20.253#,16) BAROMETER:1.9\nISO:100 EV: Fnum:2.2 ",
        *(149.0251, -20.2533, 1.9, None, None, None),
    ),
    "Matrice 300": (
        "2022.06.21 16:06:17\nGPS(36.614#,-6.1120,0.0M) BAROMETER:0.3M",
        *(-6.112, 36.6143, 0.3, None, None, None),
    ),
    "Phantom 4 RTK": (
        "RTK (120.083799, 30.21363#, 28), HOME (120.0841, 30.2142, 103.55m), D 75.36m, H 76.19m, V.S 1.00m/s, " + PRY,
        *(120.083799, 30.213633, 76.19, None, (28.2, -40.0, 1.0), None),
    ),
    "Inspire": (
        "GPS (8.5, 47.14000#, 12) BAROMETER(91.2)",
        *(8.5, 47.140003, 91.2, None, None, None),
    ),
}


@pytest.mark.parametrize("form", FORMS)
def test_what_each_form_says_is_read(read: Written, form: str) -> None:
    text, lon, lat, height_m, altitude_m, gimbal, film_mm = FORMS[form]
    found = read(two(text))
    assert found.log.lon_deg.tolist() == [lon, lon]
    assert found.log.lat_deg[0] == lat
    assert found.log.time_s is not None
    assert found.log.time_s.tolist() == [0.0, 1.0]
    for column, value in ((found.log.height_m, height_m), (found.log.altitude_m, altitude_m), (found.film_mm, film_mm)):
        assert (None if column is None else column[0]) == value
    assert (None if found.gimbal_deg is None else tuple(found.gimbal_deg[0])) == gimbal
    assert found.log.altitude_of == "unknown"


def test_the_bodys_angles_are_not_those_of_the_camera(read: Written) -> None:
    found = read(two(FORMS["Phantom 4 RTK"][0]))
    assert found.log.yaw_deg is not None
    assert found.log.pitch_deg is not None
    assert (found.log.yaw_deg[0], found.log.pitch_deg[0]) == (28.3, -5.3)
    found = read(
        two("[latitude: 47.14000#] [longtitude: 9.5] [altitude: 28.7] [Drone: Yaw:-146.0, Pitch:-0.6, Roll:1.3]")
    )
    assert found.log.yaw_deg is not None
    assert found.log.roll_deg is not None
    assert (found.log.yaw_deg[0], found.log.roll_deg[0], found.gimbal_deg) == (-146.0, 1.3, None)


@pytest.mark.parametrize(
    ("clock", "began"),
    [
        ("2023-06-28 18:43:56.810", dt.datetime(2023, 6, 28, 18, 43, 46, 810_000)),  # noqa: DTZ001 - it says no zone
        ("2023-06-28 18:43:56,810,500", dt.datetime(2023, 6, 28, 18, 43, 46, 810_500)),  # noqa: DTZ001
        ("2023-06-28 18:43:56:810", dt.datetime(2023, 6, 28, 18, 43, 46, 810_000)),  # noqa: DTZ001
        ("2017.08.5 8:11:51", dt.datetime(2017, 8, 5, 8, 11, 41)),  # noqa: DTZ001
        ("2023-06-31 18:43:56", None),
        ("", None),
    ],
)
def test_the_clock_of_no_zone_dates_the_begin_alone(read: Written, clock: str, began: dt.datetime | None) -> None:
    found = read([f"{clock}\n{text}" for text in two(MINI)], begin_ms=10_000)
    assert found.began == began
    assert found.log.start_s is None  # which is UTC
    assert found.log.time_s is not None
    assert found.log.time_s.tolist() == [10.0, 11.0]


@pytest.mark.parametrize(
    ("ending", "encoding"),
    [("\r\n", "utf-8"), ("\n", "utf-8-sig"), ("\r\n", "utf-16"), ("\n", "latin-1"), ("\r", "utf-8")],
)
def test_ends_of_lines_and_encodings_do_not_count(read: Written, ending: str, encoding: str) -> None:
    found = read(two(FORMS["Phantom 4 RTK"][0]), ending=ending, encoding=encoding)
    assert found.log.lat_deg.tolist() == [30.213633, 30.213634]
    assert found.gimbal_deg is not None
    assert found.gimbal_deg[0].tolist() == [28.2, -40.0, 1.0]


def test_a_block_at_0_0_is_no_place_and_moves_no_other(read: Written) -> None:
    at = "[latitude: {}] [longitude: {}] [rel_alt: 5.0]"
    texts = [at.format(0.0, 0.0), *(at.format(f"47.1400{k}", 9.52) for k in range(3)), at.format(0.0, 0.0)]
    texts.append(at.format(47.1401, 9.52))
    with pytest.warns(UserWarning, match="left out 2 points at 0, 0, where the drone had no fix"):
        found = read(texts)
    assert found.log.lat_deg.tolist() == [47.14, 47.14001, 47.14002, 47.1401]
    assert found.log.time_s is not None
    assert found.log.time_s.tolist() == [1.0, 2.0, 3.0, 5.0]


def test_places_that_repeat_from_frame_to_frame_are_points_where_they_change(read: Written) -> None:
    """Ten positions a second in 30 subtitles: a receiver's step of 4 decimals would be 330 m/s."""
    texts = [f"GPS ({9.52 + at // 30 * 1e-4:.4f}, 47.1400, 12), H {at // 60}.00m" for at in range(121)]
    found = read(texts, step_ms=33)
    assert found.log.lon_deg.tolist() == pytest.approx([9.52, 9.5201, 9.5202, 9.5203, 9.5204])
    assert found.log.time_s is not None
    assert found.log.time_s.tolist() == pytest.approx([0.0, 0.99, 1.98, 2.97, 3.96])


def test_radians_are_known_by_their_sea(read: Written) -> None:
    found = read(two("[latitude: 0.60855#] [longtitude: -1.963763] [altitude: 1429.697998]"))
    assert found.log.lat_deg[0] == pytest.approx(np.degrees(0.608553))
    assert found.log.lon_deg[0] == pytest.approx(np.degrees(-1.963763))
    assert any("radians" in note for note in found.log.notes)


def test_what_not_all_subtitles_say_is_not_read_and_noted(read: Written) -> None:
    texts = [f"{text} [rel_alt: 50]" for text in two(MINI)]
    texts.append("[latitude: 47.140010] [longitude: 9.520001]")
    found = read(texts)
    assert (found.log.height_m, found.film_mm) == (None, None)
    assert "rel_alt of 2 of 3 subtitles: not read" in found.log.notes


@pytest.mark.parametrize("end", ["[rel_alt: 1.3", "[latitude: 47.14", "GPS (9.52, 47"])
def test_subtitles_that_were_cut_off_are_read_up_to_the_cut(tmp_path: Path, end: str) -> None:
    text = "[latitude: 47.14000#] [longitude: 9.520001] [rel_alt: 60.1 abs_alt: 500.2]"
    path = tmp_path / "a.srt"
    path.write_text("".join(block(at, one) for at, one in enumerate([*two(text), end], start=1)).rstrip("\n"))
    log = read_log(path)
    assert log.lat_deg.tolist() == [47.140003, 47.140004]
    assert log.height_m is not None
    assert log.height_m.tolist() == [60.1, 60.1]
    assert "cut off: the file ends within a subtitle, and is read up to there" in log.notes
    path.write_text("".join(block(at, one) for at, one in enumerate(two(text), start=1)).rstrip("\n"))
    assert not any("cut off" in note for note in read_log(path).notes)


FAULTS = {
    "no subtitles": ("hello\n", "holds no subtitles"),
    "words alone": (block(1, "Hello") + block(2, "there"), r"no place in 2 subtitles: .* or name a log"),
    "no fix": (block(1, "[latitude: 0.0] [longitude: 0.0]") * 2, "every place is 0, 0"),
    "one point": (block(1, MINI.replace("#", "3")), "two points at least, the log has 1"),
    "nowhere": (block(1, "GPS(190.0,95.0,3)") + block(2, "GPS(190.1,95.0,3)"), "no degrees on Earth"),
    "back in time": (
        block(1, MINI.replace("#", "3"), begin_ms=9000) + block(1, MINI.replace("#", "4")),
        "time goes back by 9 s",
    ),
    "a jump": (block(1, MINI.replace("#", "3")) + block(2, MINI.replace("47.14000#", "48.0")), "moves at"),
    "empty": ("", "empty: copy it anew"),
}


@pytest.mark.parametrize("fault", FAULTS)
@pytest.mark.filterwarnings("ignore")
def test_a_fault_is_one_line(tmp_path: Path, fault: str) -> None:
    text, hint = FAULTS[fault]
    path = tmp_path / "a.srt"
    path.write_text(text)
    with pytest.raises(FlightError, match=hint) as error:
        read_srt(path)
    assert "\n" not in str(error.value)


def test_read_log_takes_subtitles_by_their_suffix(tmp_path: Path) -> None:
    path = tmp_path / "DJI_0001.SRT"
    path.write_text("".join(block(at, text) for at, text in enumerate(two(MINI), start=1)))
    assert read_log(path).lat_deg.tolist() == [47.140003, 47.140004]
    with pytest.raises(FlightError, match="leave out --time-unit"):
        read_log(path, LogFacts(time_unit="s"))


def test_a_text_of_letters_without_end_is_passed_over(read: Written) -> None:
    place = "[latitude: 47.14000#] [longitude: 9.520001] "
    found = read([*two(place), place.replace("#", "5") + "a" * 1_000_000])  # by its square it would take hours
    assert found.log.lat_deg.tolist() == [47.140003, 47.140004, 47.140005]
