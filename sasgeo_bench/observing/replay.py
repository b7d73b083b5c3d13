# SPDX-License-Identifier: Apache-2.0
"""Send the fixes of a flight to an autopilot or a simulator as a companion computer would: MAVLink 2 over UDP."""

import ipaddress
import re
import select
import socket
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from typing import Any, Final, Literal, Protocol, Self

import numpy as np
from numpy.typing import NDArray

from sasgeo_bench.core import progress
from sasgeo_bench.core.errors import ConfigError
from sasgeo_bench.flights.leap_seconds import is_date
from sasgeo_bench.observing.fix_files import NS
from sasgeo_bench.observing.flight_messages import Departure, GpsInput, Kind, Message, Origin, message_of

Clock = Literal["log", "now", "simulator"]

_TARGET: Final = re.compile(r"udp:(?://)?(?:\[(?P<six>[^\]]*)\]|(?P<four>[^:]*)):(?P<port>[0-9]{1,5})")
_SYSTEM: Final = 1  # that of the autopilot, to which a companion computer belongs
_BEAT_S: Final = 1.0  # between heartbeats
_FIRST_S: Final = 10.0  # until the time of a simulator must have come
_LAST_S: Final = 0.05  # after the last message, in which the system says that nobody takes it
_STEP_S: Final = 0.05  # longest wait by a simulator's clock, whose speed changes
_MOST_BYTES: Final = 65_536  # of a datagram


@dataclass(frozen=True, kw_only=True)
class Target:
    """Where messages are sent to: an address in numbers and a port.

    >>> Target.parse("udp:127.0.0.1:14550").text
    'udp:127.0.0.1:14550'
    """

    host: str
    port: int

    @classmethod
    def parse(cls, text: str) -> Self:
        """Read udp:HOST:PORT; HOST is `localhost` or in numbers. Raise `ConfigError`."""
        found = _TARGET.fullmatch(text)
        if found is None:
            raise ConfigError(f"--to {text!r} is no address: say udp:HOST:PORT, as udp:127.0.0.1:14550")
        host, port = found["four"] if found["six"] is None else found["six"], int(found["port"])
        try:
            host = str(ipaddress.ip_address("127.0.0.1" if host == "localhost" else host))
        except ValueError as error:
            raise ConfigError(
                f"--to {text!r}: {host!r} is no address in numbers, as 127.0.0.1, nor localhost"
            ) from error
        if not 0 < port < 65_536:
            raise ConfigError(f"--to {text!r}: a port lies within 1 and 65535, got {port}")
        return cls(host=host, port=port)

    @property
    def text(self) -> str:
        """Return the address as it is given."""
        return f"udp:[{self.host}]:{self.port}" if ":" in self.host else f"udp:{self.host}:{self.port}"


@dataclass(frozen=True, kw_only=True)
class ReplayRequest:
    """What is sent, where to, and by which clock.

    Parameters
    ----------
    sent : sequence of Departure
        At least one, in the order of sending.
    target : Target
        The autopilot, the simulator, or a router before them.
    kind : {"vision_position_estimate", "gps_input"}
        Message that holds a fix.
    origin : Origin
        Of the local frame; the autopilot is told it once.
    clock : {"log", "now", "simulator"}
        Whose time the messages are stamped with: that of the flight, that of this computer, or that which the simulator
        tells, by which they are sent as well.
    start_ns : int, optional
        When the first view was taken, since 1970, UTC; needed for the clock of the log.
    speed : float
        Seconds of the flight in one of this computer.

    Raises
    ------
    ConfigError
        If the speed is out of range, or is set by the simulator.
    """

    sent: Sequence[Departure]
    target: Target
    kind: Kind
    origin: Origin
    clock: Clock = "log"
    start_ns: int | None = None
    speed: float = 1.0

    def __post_init__(self) -> None:
        if not 0.01 <= self.speed <= 1000:
            raise ConfigError(f"--speed lies within 0.01 and 1000, got {self.speed:g}")
        if self.clock == "simulator" and self.speed != 1:
            raise ConfigError("--speed is set by the simulator: leave it out with --clock simulator")


@dataclass(frozen=True, kw_only=True)
class ReplayReport:
    """How a replay went: how late each fix was sent, seconds, and how many packets nobody took, as far as is known."""

    late_s: NDArray[np.float64]
    packets: int
    refused: int

    def late_ms(self, share: float) -> float:
        """Return a quantile of the lateness, milliseconds."""
        return 1000.0 * float(np.quantile(self.late_s, share))


class _Clock(Protocol):
    """Time of a flight: how long until a second of it, and the stamp of one."""

    def left_s(self, flight_s: float) -> float:
        """Seconds of this computer until a second of the flight; negative once it has passed."""

    def stamp_ns(self, flight_s: float) -> int:
        """The stamp of a second of the flight."""

    def utc_ns(self, flight_s: float) -> int | None:
        """The same by UTC; None where that is not known."""

    def now_ns(self) -> int:
        """The stamp of this moment."""


class _OwnClock:
    """Counts by this computer's monotonic clock from when it is made, so that no wait adds to another."""

    def __init__(self, start_ns: int | None, speed: float) -> None:
        self._began_s, self._speed = time.monotonic(), speed
        self._start_ns, self._pace = (time.time_ns(), speed) if start_ns is None else (start_ns, 1.0)

    def left_s(self, flight_s: float) -> float:
        return self._began_s + flight_s / self._speed - time.monotonic()

    def stamp_ns(self, flight_s: float) -> int:
        return self._start_ns + round(flight_s / self._pace * NS)

    def utc_ns(self, flight_s: float) -> int | None:
        return self.stamp_ns(flight_s)

    def now_ns(self) -> int:
        return self.stamp_ns((time.monotonic() - self._began_s) * self._speed)


@dataclass(slots=True)
class _SimulatorClock:
    """Follows the times that a simulator tells (SYSTEM_TIME); the flight begins with the first.

    In between it runs on at the speed of the last two, for as long as there was between them: a simulator may stop.
    """

    first_s: float = 0.0  # of the simulator
    last_s: float = 0.0
    heard_s: float | None = None  # of this computer
    gap_s: float = 0.0
    pace: float = 1.0
    unix_ns: int | None = None  # at the simulator's second 0

    def hear(self, boot_s: float, unix_s: float) -> None:
        now_s = time.monotonic()
        if self.heard_s is None or boot_s < self.last_s:
            self.first_s += boot_s - self.last_s  # one that was started anew goes on from here
        elif now_s > self.heard_s:
            self.gap_s = now_s - self.heard_s
            self.pace = (boot_s - self.last_s) / self.gap_s
        self.last_s, self.heard_s = boot_s, now_s
        self.unix_ns = round((unix_s - boot_s) * NS) if is_date(unix_s) else None

    def _now_s(self) -> float:
        """Return the simulator's second at this moment."""
        return self.last_s + self.pace * min(time.monotonic() - (self.heard_s or 0.0), self.gap_s)

    def left_s(self, flight_s: float) -> float:
        left_s = self.first_s + flight_s - self._now_s()
        return left_s / self.pace if self.pace > 0 else left_s

    def stamp_ns(self, flight_s: float) -> int:
        return max(round((self.first_s + flight_s) * NS), 0)

    def utc_ns(self, flight_s: float) -> int | None:
        return None if self.unix_ns is None else self.unix_ns + self.stamp_ns(flight_s)

    def now_ns(self) -> int:
        return round(self._now_s() * NS)


def replay(request: ReplayRequest) -> ReplayReport:
    """Send the fixes of a flight, each when a companion computer would have, and return how late they were.

    A heartbeat is sent each second, the origin of the local frame once. Requests of an autopilot to compare clocks
    (TIMESYNC) are answered, so that it knows how old a fix is.

    Raises
    ------
    ConfigError
        If pymavlink is not installed, the address cannot be reached, or no time comes from the simulator.
    """
    with _Link(request.target) as link:
        clock: _Clock
        if request.clock == "simulator":
            clock = link.follow()
        else:
            clock = _OwnClock(request.start_ns if request.clock == "log" else None, request.speed)
        link.clock = clock
        link.beat()
        link.send_origin(request.origin, clock.stamp_ns(0.0))
        label = "fixes sent"
        progress.begin(label, len(request.sent))
        late_s = []
        for one in request.sent:
            stamp_ns, utc_ns = clock.stamp_ns(one.view_s), clock.utc_ns(one.view_s)
            message = message_of(one, request.kind, request.origin, stamp_ns, utc_ns)
            link.listen_until(one.sent_s)
            link.send(message)
            late_s.append(-clock.left_s(one.sent_s))
            progress.advance(label, 1)
        link.listen(_LAST_S)
        return ReplayReport(late_s=np.array(late_s), packets=link.packets, refused=link.refused)


@dataclass(slots=True)
class _Link:
    """A socket of UDP to an autopilot, and what is said there besides fixes."""

    target: Target
    packets: int = 0
    refused: int = 0
    clock: _Clock | None = None
    _mavlink: Any = None
    _socket: socket.socket = field(init=False)
    _beat_s: float = 0.0  # when the next heartbeat is due

    def __enter__(self) -> Self:
        try:
            from pymavlink.dialects.v20 import common  # type: ignore[import-untyped] # noqa: PLC0415 - only if installed
        except ImportError as error:
            raise ConfigError("replay needs the package pymavlink: pip install 'sasgeo-bench[logs]'") from error
        self._mavlink = common.MAVLink(self, srcSystem=_SYSTEM, srcComponent=common.MAV_COMP_ID_ONBOARD_COMPUTER)
        self._mavlink.robust_parsing = True
        family = socket.AF_INET6 if ":" in self.target.host else socket.AF_INET
        self._socket = socket.socket(family, socket.SOCK_DGRAM)
        try:
            self._socket.connect((self.target.host, self.target.port))
        except OSError as error:
            self._socket.close()
            raise self._unreachable(error) from error
        return self

    def __exit__(self, *_: object) -> None:
        self._socket.close()

    def _unreachable(self, error: OSError) -> ConfigError:
        return ConfigError(f"{self.target.text} cannot be reached ({error.strerror or error}): name another by --to")

    def follow(self) -> _SimulatorClock:
        """Wait for the time of the simulator; return the clock that follows it."""
        clock = _SimulatorClock()
        self.clock = clock
        end_s = time.monotonic() + _FIRST_S
        while clock.heard_s is None:
            self.beat()
            self.listen(min(_BEAT_S, max(end_s - time.monotonic(), 0.0)))
            if time.monotonic() >= end_s and clock.heard_s is None:
                raise ConfigError(
                    f"no SYSTEM_TIME came from {self.target.text} in {_FIRST_S:g} s: let the simulator send it, or "
                    "take --clock now"
                )
        return clock

    def beat(self) -> None:
        """Send a heartbeat if one is due."""
        if time.monotonic() < self._beat_s:
            return
        self._beat_s = time.monotonic() + _BEAT_S
        # MAV_TYPE_ONBOARD_CONTROLLER, MAV_AUTOPILOT_INVALID, no mode, MAV_STATE_ACTIVE
        self._mavlink.heartbeat_send(18, 8, 0, 0, 4)

    def send_origin(self, origin: Origin, stamp_ns: int) -> None:
        """Tell the autopilot the origin of its local frame."""
        place = (round(origin.lat_deg * 1e7), round(origin.lon_deg * 1e7), round(origin.alt_m * 1e3))
        self._mavlink.set_gps_global_origin_send(_SYSTEM, *place, stamp_ns // 1000)

    def send(self, message: Message) -> None:
        """Send a fix."""
        link = self._mavlink
        send = link.gps_input_send if isinstance(message, GpsInput) else link.vision_position_estimate_send
        send(**asdict(message))

    def write(self, data: bytes) -> None:
        """Send a packet; the library calls this with each message."""
        self.packets += 1
        for _ in range(2):
            try:
                self._socket.send(data)
            except ConnectionRefusedError:  # this is about a packet before, and the one at hand was not sent
                self.refused += 1
                continue
            except OSError as error:
                raise self._unreachable(error) from error
            return

    def listen_until(self, flight_s: float) -> None:
        """Wait until a second of the flight; send heartbeats and answer meanwhile."""
        while self.clock is not None and (left_s := self.clock.left_s(flight_s)) > 0:
            wait_s = min(left_s, max(self._beat_s - time.monotonic(), 0.0))
            self.listen(wait_s if isinstance(self.clock, _OwnClock) else min(wait_s, _STEP_S))
            self.beat()

    def listen(self, wait_s: float) -> None:
        """Wait for a packet, and take what it says; return after it, or when the time is over."""
        if not select.select([self._socket], [], [], wait_s)[0]:
            return
        try:
            data = self._socket.recv(_MOST_BYTES)
        except ConnectionRefusedError:
            self.refused += 1
            return
        except OSError as error:  # as of a route that was lost
            raise self._unreachable(error) from error
        for message in self._mavlink.parse_buffer(data) or ():
            name = message.get_type()
            if name == "SYSTEM_TIME" and isinstance(self.clock, _SimulatorClock):
                self.clock.hear(message.time_boot_ms / 1e3, message.time_unix_usec / 1e6)
            elif name == "TIMESYNC" and message.tc1 == 0 and self.clock is not None and self.clock.now_ns() > 0:
                self._mavlink.timesync_send(self.clock.now_ns(), message.ts1)
