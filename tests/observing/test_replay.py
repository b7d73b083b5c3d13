# SPDX-License-Identifier: Apache-2.0
"""A flight sent over UDP: a listener finds the same fixes, times and ellipses; none of these tests measures time."""

import socket
from types import SimpleNamespace

import numpy as np
import pytest

from sasgeo_bench.core.errors import ConfigError
from sasgeo_bench.flights.leap_seconds import WEEK_S, utc_of_gps
from sasgeo_bench.observing import replay as replaying
from sasgeo_bench.observing.fix_files import NS
from sasgeo_bench.observing.flight_messages import departures, message_of, origin_of
from sasgeo_bench.observing.replay import ReplayRequest, Target, replay
from tests.observing.flown import START_NS, invented
from tests.observing.listening import ASKED_NS, FIRST_S, UNIX_S, Listener, silence


class _Deaf(socket.socket):
    """A socket that hears what it is told to."""

    def __init__(self, *kind, recv):
        super().__init__(*kind)
        self.recv = recv


FLIGHT = invented(6, is_jump=[False, False, True, False, False, False])
SENT = departures(FLIGHT)


def request_to(port, **changes):
    usual = {
        "sent": SENT,
        "target": Target(host="127.0.0.1", port=port),
        "kind": "vision_position_estimate",
        "origin": origin_of(SENT),
        "start_ns": START_NS,
        "speed": 100.0,
    }
    return ReplayRequest(**usual | changes)


def test_a_listener_finds_the_fixes_times_and_ellipses_that_were_sent():
    with Listener() as listener:
        report = replay(request_to(listener.port))
    found = listener.named("VISION_POSITION_ESTIMATE")
    assert len(found) == len(SENT)
    for one, message in zip(SENT, found, strict=True):
        expected = message_of(one, "vision_position_estimate", origin_of(SENT), one.fix.time_ns, None)
        assert message.usec == one.fix.time_ns // 1000
        assert (message.x, message.y, message.yaw) == pytest.approx((expected.x, expected.y, expected.yaw), abs=1e-4)
        assert list(message.covariance) == pytest.approx(expected.covariance, rel=1e-6)
        assert message.reset_counter == (one.fix.time_ns - START_NS >= 2 * NS)
        assert (message.get_srcSystem(), message.get_srcComponent()) == (1, 191)
    assert len(report.late_s) == len(SENT)
    assert (report.late_s >= 0).all()  # none before its time
    assert report.refused == 0
    assert [one.get_seq() for one in listener.heard] == list(range(len(listener.heard)))


def test_an_autopilot_is_told_who_speaks_and_the_origin_once_before_all_fixes():
    with Listener() as listener:
        replay(request_to(listener.port))
    beat, origin = listener.heard[:2]
    assert (beat.get_type(), beat.type, beat.autopilot) == ("HEARTBEAT", 18, 8)  # an onboard computer, no autopilot
    assert origin.get_type() == "SET_GPS_GLOBAL_ORIGIN"
    assert (origin.target_system, origin.latitude, origin.longitude) == (1, 471_400_000, 95_200_000)
    assert len(listener.named("SET_GPS_GLOBAL_ORIGIN")) == 1


def test_a_receivers_time_is_that_of_gps():
    with Listener() as listener:
        replay(request_to(listener.port, kind="gps_input"))
    found = listener.named("GPS_INPUT")
    seconds = utc_of_gps(np.array([one.time_week * WEEK_S + one.time_week_ms / 1e3 for one in found]))
    assert seconds == pytest.approx([one.fix.time_ns / NS for one in SENT])
    assert [one.lat for one in found] == [round(one.fix.lat_deg * 1e7) for one in SENT]
    assert [one.yaw for one in found] == [35_000, 36_000, 1_000, 2_000, 3_000, 4_000]
    assert {round(one.horiz_accuracy, 4) for one in found} == {round(float(np.sqrt(12.5 + np.hypot(3.5, 6.0))), 4)}


def test_stamps_of_now_pass_as_fast_as_the_flight_is_replayed():
    with Listener() as listener:
        replay(request_to(listener.port, clock="now"))
    stamps = [one.usec for one in listener.named("VISION_POSITION_ESTIMATE")]
    assert np.diff(stamps).tolist() == pytest.approx([10_000] * 5, abs=1)  # a second of the flight in 1/100


def test_stamps_of_a_simulator_count_from_the_first_time_it_told():
    with Listener(is_simulator=True) as listener:
        replay(request_to(listener.port, clock="simulator", speed=1.0, kind="gps_input"))
    found = listener.named("GPS_INPUT")
    assert [one.time_usec / 1e6 for one in found] == [FIRST_S + at for at in range(6)]
    seconds = utc_of_gps(np.array([one.time_week * WEEK_S + one.time_week_ms / 1e3 for one in found]))
    assert seconds == pytest.approx([UNIX_S + at for at in range(6)])
    (answer,) = [one for one in listener.named("TIMESYNC") if one.ts1 == ASKED_NS]
    assert FIRST_S <= answer.tc1 / NS < FIRST_S + 6


def test_a_simulator_that_tells_no_time_is_named(monkeypatch):
    monkeypatch.setattr(replaying, "_FIRST_S", 0.05)
    with (
        Listener() as listener,
        pytest.raises(ConfigError, match=r"no SYSTEM_TIME came from udp:127\.0\.0\.1:.* take --clock now"),
    ):
        replay(request_to(listener.port, clock="simulator", speed=1.0))
    assert listener.named("HEARTBEAT")
    assert not listener.named("VISION_POSITION_ESTIMATE")


def test_where_nobody_listens_the_packets_that_were_refused_are_counted():
    pytest.importorskip("pymavlink")
    with silence() as port:
        report = replay(request_to(port))
    assert len(report.late_s) == len(SENT)
    assert 0 < report.refused <= report.packets


def test_a_route_that_is_lost_on_the_way_is_one_line(monkeypatch):
    def lost(*_):
        raise OSError(113, "No route to host")

    with Listener(is_simulator=True) as listener:
        monkeypatch.setattr(replaying.socket, "socket", lambda *kind: _Deaf(*kind, recv=lost))
        with pytest.raises(ConfigError, match=r"cannot be reached \(No route to host\): name another by --to"):
            replay(request_to(listener.port, speed=1.0))


def test_no_wait_adds_to_another(monkeypatch):
    """Each look at the clock costs 10 ms here and each wait 20 ms more than asked: no fix is later for those before."""
    pytest.importorskip("pymavlink")
    now = {"s": 1000.0}

    def monotonic():
        now["s"] += 0.01
        return now["s"]

    def select(_read, _write, _fault, wait_s):
        now["s"] += wait_s + 0.02
        return [], [], []

    monkeypatch.setattr(replaying, "time", SimpleNamespace(monotonic=monotonic, time_ns=lambda: 0))
    monkeypatch.setattr(replaying, "select", SimpleNamespace(select=select))
    flight = invented(60)
    with Listener() as listener:
        report = replay(request_to(listener.port, sent=departures(flight), speed=1.0))
    assert (report.late_s >= 0).all()
    assert report.late_s.max() < 0.2


def test_a_clock_of_a_simulator_stops_with_it_and_goes_on_after_a_new_start(monkeypatch):
    now = {"s": 50.0}
    monkeypatch.setattr(replaying, "time", SimpleNamespace(monotonic=lambda: now["s"]))
    clock = replaying._SimulatorClock()
    clock.hear(10.0, 0.0)
    assert clock.left_s(0.0) == 0.0
    now["s"] = 51.0
    clock.hear(14.0, 0.0)  # four times as fast
    assert clock.left_s(8.0) == pytest.approx(1.0)
    now["s"] = 51.5
    assert clock.left_s(8.0) == pytest.approx(0.5)
    now["s"] = 99.0  # nothing was told since: it runs on for a second, not longer
    assert clock.left_s(10.0) == pytest.approx(0.5)
    assert clock.stamp_ns(2.0) == 12 * NS
    assert clock.utc_ns(2.0) is None
    clock.hear(1.0, UNIX_S)
    assert clock.left_s(4.0) == pytest.approx(0.0)
    assert clock.utc_ns(4.0) == UNIX_S * NS
    clock.hear(2.0, 1e13)  # no week of GPS_INPUT is so far off
    assert clock.utc_ns(4.0) is None


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("udp:127.0.0.1", r"is no address: say udp:HOST:PORT, as udp:127\.0\.0\.1:14550"),
        ("udp:127.0.0.1:0", "a port lies within 1 and 65535, got 0"),
        ("udp:127.0.0.1:65536", "a port lies within 1 and 65535, got 65536"),
        ("udp:example.org:14550", "'example.org' is no address in numbers"),
        ("udp:127.0.0.999:14550", "is no address in numbers"),
        ("udp:[fe80::1%]:14550", "is no address in numbers"),
    ],
)
def test_an_address_that_is_none_is_refused(text, words):
    with pytest.raises(ConfigError, match=words):
        Target.parse(text)


def test_addresses_of_both_kinds_are_read_as_they_are_written():
    for text in ("udp:127.0.0.1:14550", "udp:[::1]:14550"):
        assert Target.parse(text).text == text
    assert Target.parse("udp:localhost:14550") == Target.parse("udp://127.0.0.1:14550")


def test_a_speed_that_cannot_be_is_refused():
    for speed in (0.0, float("nan"), 1e6):
        with pytest.raises(ConfigError, match="--speed lies within"):
            request_to(1, speed=speed)
    with pytest.raises(ConfigError, match="--speed is set by the simulator"):
        request_to(1, speed=2.0, clock="simulator")
