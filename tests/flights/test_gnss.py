# SPDX-License-Identifier: Apache-2.0
"""Weak receivers along flights: drawn errors that last, and a log's second receiver beside that of the truth."""

from pathlib import Path

import numpy as np
import pyproj
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sasgeo_bench.core.errors import FlightError
from sasgeo_bench.flights.gnss import draw_gnss
from sasgeo_bench.flights.logs import FlownPath
from tests.flights import autopilots
from tests.flights.autopilots import (
    LEVEL,
    START_S,
    ardupilot_rows,
    bag,
    dataflash,
    fusing,
    mavros_messages,
    px4_drift,
    stamps_us,
    tlog,
    ulog,
    write,
)

EPSG = 32632


@given(radius_m=st.floats(2, 500), seed=st.integers(0, 100))
def test_every_disc_holds_its_view_also_after_rounding(radius_m: float, seed: int) -> None:
    gnss = draw_gnss(np.arange(0, 900, 5.0), radius_m=radius_m, rng=np.random.default_rng(seed))
    assert (gnss.away_m < radius_m).all()
    for at in (0, 50, int(gnss.away_m.argmax())):
        middle, radius = gnss.disc(at, (500_000.0, 5_200_000.0))
        assert middle is not None
        assert radius is not None
        assert np.hypot(middle[0] - 500_000.0, middle[1] - 5_200_000.0) <= radius


def test_drawn_errors_have_the_stated_size_and_last_a_minute() -> None:
    time_s = np.arange(0, 600, 10.0)
    rng = np.random.default_rng(0)
    drawn = np.array([draw_gnss(time_s, radius_m=60.0, rng=rng).off_m for _ in range(3000)])
    assert drawn.std(axis=0).ravel() == pytest.approx(np.full(120, 20.0), rel=0.06)
    assert np.abs(drawn.mean(axis=0)).max() < 1.5
    for steps in (1, 6, 18):
        kept = np.mean(drawn[:, :-steps] * drawn[:, steps:]) / np.mean(drawn**2)
        assert kept == pytest.approx(np.exp(-10 * steps / 60), abs=0.03)
    assert abs(np.mean(drawn[..., 0] * drawn[..., 1])) < 10  # m2, of 400


# Second receivers


@pytest.fixture
def readers() -> None:
    """What reads logs of autopilots."""
    pytest.importorskip("pyulog", reason="needs the extra [logs]")
    pytest.importorskip("pymavlink", reason="needs the extra [logs]")


EAST_DEG = 1e-4  # 7.6 m that the second receiver is off


def px4(rows: list[tuple], *, is_second: bool = True) -> dict:
    """A ULog of two receivers; PX4 also publishes the one that it chose."""
    log = px4_drift(1.0, {("estimator_status", 0): fusing(lambda _: True)})
    log["sensor_gps", 0] = log["vehicle_gps_position", 0]
    if is_second:
        log["sensor_gps", 1] = (autopilots.GPS_114, rows)
    return log


def weak(*, eph: float = 6.0, fix_type: int = 3) -> list[tuple]:
    rows = []
    for row in autopilots.gps_rows(LEVEL):
        stamp, utc_us, lat, lon, *rest = row
        rows.append((stamp, utc_us, lat, lon + EAST_DEG, *rest[:2], eph, fix_type))
    return rows


def off_m(moments_s: np.ndarray) -> np.ndarray:
    """East and north of the second receiver less the first in the CRS, by its own projection."""
    lon, lat = (np.interp(moments_s, LEVEL.time_s, one) for one in (LEVEL.lon_deg, LEVEL.lat_deg))
    into = pyproj.Transformer.from_crs(4326, EPSG, always_xy=True)
    return np.column_stack(into.transform(lon + EAST_DEG, lat)) - np.column_stack(into.transform(lon, lat))


def places_m(moments_s: np.ndarray) -> np.ndarray:
    lon, lat = (np.interp(moments_s, LEVEL.time_s, one) for one in (LEVEL.lon_deg, LEVEL.lat_deg))
    return np.column_stack(pyproj.Transformer.from_crs(4326, EPSG, always_xy=True).transform(lon, lat))


MOMENTS_S = np.array([1.0, 20.3, 77.1, 110.0])


@pytest.mark.usefixtures("readers")
def test_the_disc_is_around_the_weaker_receiver_with_three_times_what_it_states(tmp_path: Path) -> None:
    path = write(tmp_path / "a.ulg", ulog(px4(weak())))
    receiver = FlownPath(file=path).second_receiver()
    assert receiver.name == "sensor_gps 1"
    gnss = receiver.along(MOMENTS_S, places_m(MOMENTS_S), epsg=EPSG)
    np.testing.assert_allclose(gnss.off_m, off_m(MOMENTS_S), atol=0.02)
    np.testing.assert_allclose(gnss.radius_m, 18.0, rtol=1e-6)
    middle, radius = gnss.disc(1, (0.0, 0.0))
    assert middle == pytest.approx(off_m(MOMENTS_S)[1], abs=0.06)
    assert radius == 18.0


@pytest.mark.usefixtures("readers")
def test_a_moment_without_a_fix_has_no_disc(tmp_path: Path) -> None:
    rows = [row for at, row in enumerate(weak()) if not 95 < at < 115]  # for 4 s
    receiver = FlownPath(file=write(tmp_path / "a.ulg", ulog(px4(rows)))).second_receiver()
    moments_s = np.array([19.0, 21.0, 23.0])
    gnss = receiver.along(moments_s, places_m(moments_s), epsg=EPSG)
    assert np.isfinite(gnss.radius_m).tolist() == [True, False, True]
    assert gnss.disc(1, (0.0, 0.0)) == (None, None)


@pytest.mark.usefixtures("readers")
@pytest.mark.parametrize(
    ("log", "match"),
    [
        (px4([], is_second=False), "sensor_gps 0 is vehicle_gps_position 0 under another name, which is the truth$"),
        (px4(weak(eph=0.5)), "sensor_gps 1 states 0.5 m, no worse than vehicle_gps_position 0, which is the truth"),
        (px4(weak(eph=float("nan"))), "sensor_gps 1 does not state its accuracy"),
        (px4(weak(fix_type=1)), "sensor_gps 0 is vehicle_gps_position 0 under another name, which is the truth$"),
        (px4_drift(1.0, {}), r"a\.ulg has one receiver, vehicle_gps_position 0, which is the truth"),
    ],
)
def test_a_receiver_that_is_the_truth_or_no_weak_one_is_refused_by_name(tmp_path: Path, log: dict, match: str) -> None:
    with pytest.raises(FlightError, match=match):
        FlownPath(file=write(tmp_path / "a.ulg", ulog(log))).second_receiver()


def test_a_table_has_no_second_receiver(tmp_path: Path) -> None:
    (tmp_path / "a.csv").write_text("time_s,lat,lon,height_m\n0,47.14,9.52,80\n9,47.141,9.52,80\n")
    with pytest.raises(FlightError, match=r"a\.csv has no second receiver"):
        FlownPath(file=tmp_path / "a.csv").second_receiver()


@pytest.mark.usefixtures("readers")
def test_second_receivers_of_other_autopilots_are_read_alike(tmp_path: Path) -> None:
    rows = ardupilot_rows(LEVEL)
    rows["GPS"] = [(*row[:2], 3, *row[3:]) for row in rows["GPS"]]
    rows["GPS"] = [row if row[1] == 0 else (*row[:8], row[8] + EAST_DEG, *row[9:]) for row in rows["GPS"]]
    receivers = {write(tmp_path / "a.bin", dataflash(rows)): ("GPS 1", 3 * 1.75)}

    from pymavlink.dialects.v20 import common  # type: ignore[import-untyped] # noqa: PLC0415 - only where installed

    link = common.MAVLink(None, srcSystem=1, srcComponent=1)
    packets = tlog(LEVEL, late_s=0)
    for at, us in enumerate(stamps_us(LEVEL.time_s)):
        lat, lon = round(LEVEL.lat_deg[at] * 1e7), round((LEVEL.lon_deg[at] + EAST_DEG) * 1e7)
        one = common.MAVLink_gps2_raw_message(us, 3, lat, lon, 560_000, 80, 90, 800, 4500, 9, 0, 0, h_acc=4000)
        packets += (START_S * 1_000_000 + us).to_bytes(8, "big") + bytes(one.pack(link))
    receivers[write(tmp_path / "a.tlog", packets)] = ("GPS2_RAW", 12.0)
    for path, (name, radius_m) in receivers.items():
        receiver = FlownPath(file=path).second_receiver()
        assert receiver.name == name
        gnss = receiver.along(MOMENTS_S, places_m(MOMENTS_S), epsg=EPSG)
        np.testing.assert_allclose(gnss.off_m, off_m(MOMENTS_S), atol=0.02)
        np.testing.assert_allclose(gnss.radius_m, radius_m)


@pytest.mark.usefixtures("readers")
def test_the_second_topic_of_a_bag_is_read_on_the_clock_of_the_first(tmp_path: Path) -> None:
    pytest.importorskip("rosbags", reason="needs the extra [logs]")
    messages = mavros_messages(LEVEL)
    for topic, kind, recorded_ns, fields in list(messages):
        if topic.endswith("raw/fix"):
            lat, lon = fields["latitude"], fields["longitude"]
            other = {"position_covariance": [49.0, 0, 0, 0, 49.0, 0, 0, 0, 90.0], "longitude": lon + EAST_DEG}
            messages.append(("/second/fix", kind, recorded_ns + 1, fields | {"latitude": lat} | other))
    messages = [one for one in sorted(messages, key=lambda one: one[2]) if one[0] != "/second/fix" or one[2] % 3]
    receiver = FlownPath(file=bag(tmp_path / "a.mcap", messages)).second_receiver()
    assert receiver.name == "/second/fix"
    gnss = receiver.along(MOMENTS_S, places_m(MOMENTS_S), epsg=EPSG)
    np.testing.assert_allclose(gnss.off_m, off_m(MOMENTS_S), atol=0.05)
    np.testing.assert_allclose(gnss.radius_m, 21.0)
