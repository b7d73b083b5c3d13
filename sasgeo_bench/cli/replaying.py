# SPDX-License-Identifier: Apache-2.0
"""Command that replays the fixes of a flight: into an autopilot or a simulator, or into a file."""

import datetime as dt
import re
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Final

import typer

from sasgeo_bench.cli.console import CONTESTANT_FAILED, complain, say, shown_progress
from sasgeo_bench.cli.options import Options
from sasgeo_bench.core.errors import ConfigError, counted
from sasgeo_bench.core.progress import tell
from sasgeo_bench.observing.fix_files import NS
from sasgeo_bench.observing.flight_fixes import FlightFixes, read_flight_fixes
from sasgeo_bench.observing.flight_messages import Departure, Kind, Origin, departures, origin_of
from sasgeo_bench.observing.flight_outputs import CSV, SUFFIXES, check_accepted, check_dated, write_fixes
from sasgeo_bench.observing.replay import Clock, ReplayRequest, Target
from sasgeo_bench.observing.replay import replay as replayed

_UDP: Final = "udp:"
_ELSEWHERE: Final = re.compile(r"(?:udpout|udpin|udp|tcp|tcpin|serial)(?::|$)|.*://")
_FILES: Final = ", ".join(SUFFIXES)


@dataclass(frozen=True, kw_only=True)
class ReplayOptions(Options):
    """Flags of replay."""

    run: Annotated[Path, typer.Argument(help="folder of a run over flights, as run prints it, or of locate")] = field(
        kw_only=False
    )
    to: Annotated[str, typer.Option(help=f"udp:HOST:PORT, or a file: {_FILES}")]
    flight: Annotated[str | None, typer.Option(help="beginning of its id, where the run is of several")] = None
    tasks: Annotated[Path | None, typer.Option(help="folder of the task; default: that which run answered")] = None
    kind: Annotated[
        Kind | None, typer.Option("--as", help="message of a fix, also in .csv; default: vision_position_estimate")
    ] = None
    has_all: Annotated[bool, typer.Option("--all", help="take fixes that are not accepted as well")] = False
    start: Annotated[
        str | None, typer.Option(help="of the flight, as 2026-05-01T10:00:00Z; default: as its log says")
    ] = None
    origin: Annotated[
        str | None, typer.Option(help="LON,LAT[,ALT] of the local frame, m above the sea; default: the first fix, 0")
    ] = None
    delay: Annotated[
        float | None, typer.Option(help="seconds from a view to its fix; default: as measured in the run")
    ] = None
    rate: Annotated[float | None, typer.Option(help="fixes in a second at most; default: all")] = None
    clock: Annotated[
        Clock | None,
        typer.Option(help="of the stamps: that of the flight, this computer's, a simulator's; default: log if known"),
    ] = None
    speed: Annotated[float, typer.Option(help="seconds of the flight in a second")] = 1.0


def replay_command(options: ReplayOptions) -> None:
    """Send the fixes of a flight to an autopilot or simulator as a companion computer would, or into a file."""
    target = _target(options.to)
    for name, is_given, needed in (
        ("--clock", options.clock is not None, target is not None),
        ("--speed", options.speed != 1, target is not None),
        ("--as", options.kind is not None, target is not None or options.to.lower().endswith(CSV)),
    ):
        if is_given and not needed:
            raise ConfigError(f"{name} makes no sense for {options.to}: leave it out, or send to udp:HOST:PORT")
    if options.delay is not None and not 0 <= options.delay <= 3600:
        raise ConfigError(f"--delay lies within 0 and 3600 s, got {options.delay:g}")
    if options.rate is not None and not 0 < options.rate <= 1000:
        raise ConfigError(f"--rate lies above 0 and up to 1000 a second, got {options.rate:g}")
    start_ns = None if options.start is None else _moment_ns(options.start)
    origin = None if options.origin is None else _origin(options.origin)
    flight = read_flight_fixes(options.run, flight=options.flight, tasks=options.tasks)
    tell(_summary(flight))
    if start_ns is not None:
        flight = flight.starting(start_ns)
    elif flight.clock == "camera":
        tell("times are those of the cameras' clocks, taken as UTC: --start names another")
    sent = departures(flight, delay_s=options.delay, rate_hz=options.rate, has_all=options.has_all)
    kind = options.kind or "vision_position_estimate"
    origin = origin or origin_of(sent)
    if target is None:
        path = Path(options.to)
        write_fixes(path, flight, sent, kind=kind, origin=origin)
        tell(f"{counted(len(sent), 'fix', 'fixes')} written")
        say(path)
    else:
        _send(target, flight, sent, kind=kind, origin=origin, options=options)


def _send(
    target: Target,
    flight: FlightFixes,
    sent: tuple[Departure, ...],
    *,
    kind: Kind,
    origin: Origin,
    options: ReplayOptions,
) -> None:
    if kind != "gps_input":
        check_accepted(sent, "VISION_POSITION_ESTIMATE cannot")
    clock = options.clock or ("now" if flight.start_ns is None else "log")
    if clock == "log":
        check_dated(flight, "--clock log")
    elif options.clock is None:
        tell("stamps are of this computer's clock: the flight does not say when it began (--start)")
    request = ReplayRequest(
        sent=sent,
        target=target,
        kind=kind,
        origin=origin,
        clock=clock,
        start_ns=flight.start_ns,
        speed=options.speed,
    )
    tell(
        f"origin {origin.lon_deg:.7f},{origin.lat_deg:.7f},{origin.alt_m:g}; the last fix after {sent[-1].sent_s:.1f} s"
    )
    with shown_progress():
        report = replayed(request)
    late = f"late by {report.late_ms(0.5):.1f} ms (p50), {report.late_ms(0.99):.1f} ms (p99)"
    heard = "; nobody listened" if report.refused else "; UDP does not tell whether they arrived"
    say(f"{counted(len(sent), 'fix', 'fixes')} sent to {target.text}, {late}{heard}")
    if report.refused:
        complain(f"nobody listened at {target.text} to {report.refused} of {counted(report.packets, 'packet')}")
        raise typer.Exit(CONTESTANT_FAILED)


def _summary(flight: FlightFixes) -> str:
    return (
        f"flight {flight.flight}: {counted(flight.views, 'view')}, {counted(len(flight.fixes), 'fix', 'fixes')}, "
        f"{len(flight.accepted)} accepted"
    )


def _target(text: str) -> Target | None:
    """Return an address of UDP; None for the name of a file."""
    if text.startswith(_UDP):
        return Target.parse(text)
    if _ELSEWHERE.match(text):
        raise ConfigError(f"--to {text!r} is no address that is known: say udp:HOST:PORT, or a file ({_FILES})")
    return None


def _moment_ns(text: str) -> int:
    try:
        moment = dt.datetime.fromisoformat(text)
    except ValueError:
        moment = None
    if moment is None or moment.tzinfo is None or not 1981 <= moment.year < 2038:  # from GPS to the end of ROS's stamps
        raise ConfigError(f"--start is a date and time with its zone, as 2026-05-01T10:00:00Z, got {text!r}")
    return round(moment.timestamp() * 1e6) * (NS // 10**6)


def _origin(text: str) -> Origin:
    try:
        numbers = [float(part) for part in text.split(",")]
    except ValueError:
        numbers = []
    if len(numbers) not in (2, 3):
        raise ConfigError(f"--origin is LON,LAT or LON,LAT,ALT in degrees and metres, as 9.52,47.14,450, got {text!r}")
    return Origin(lon_deg=numbers[0], lat_deg=numbers[1], alt_m=numbers[2] if len(numbers) > 2 else 0.0)
