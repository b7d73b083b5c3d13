# SPDX-License-Identifier: Apache-2.0
"""How late the fixes of a flight leave, at a listener on this machine (goal: 20 ms at p99).

    .venv/bin/python benchmarks/replay.py --seconds 60 --rate 20

Sends a made-up flight of so many fixes a second by each message, and prints how late they left by the sender's clock,
how much later than the first they came by the listener's, and the load of the machine. Needs the extra [logs].
"""

import argparse
import os
import socket
import threading
import time

import numpy as np
from pymavlink.dialects.v20 import common

from sasgeo_bench.observing.fix_files import NS, PlacedFix
from sasgeo_bench.observing.flight_fixes import FlightFixes
from sasgeo_bench.observing.flight_messages import MESSAGES, departures, origin_of
from sasgeo_bench.observing.replay import ReplayRequest, Target, replay


def main() -> None:
    """Print a row for each message."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seconds", type=float, default=60.0, help="of the flight")
    parser.add_argument("--rate", type=float, default=20.0, help="fixes a second")
    options = parser.parse_args()
    flight = made_up(round(options.seconds * options.rate), options.rate)
    print("| message | fixes | late p50, ms | p99, ms | most, ms | came late p99, ms | load |")
    print("|---|---:|---:|---:|---:|---:|---:|")
    for kind in MESSAGES:
        sent = departures(flight)
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as listener:
            listener.bind(("127.0.0.1", 0))
            came_s: list[float] = []
            hearing = threading.Thread(target=hear, args=(listener, len(sent), kind.upper(), came_s))
            hearing.start()
            target = Target(host="127.0.0.1", port=listener.getsockname()[1])
            report = replay(
                ReplayRequest(sent=sent, target=target, kind=kind, origin=origin_of(sent), start_ns=flight.begin_ns)
            )
            hearing.join()
        # Against the clock of the sender the listener has none of its own: the earliest is taken as in time.
        over_s = np.array(came_s) - [one.sent_s for one in sent]
        late = [f"{report.late_ms(share):.2f}" for share in (0.5, 0.99, 1.0)]
        came = f"{1000 * np.quantile(over_s - over_s.min(), 0.99):.2f}"
        print(f"| {kind} | {len(sent)} | {' | '.join(late)} | {came} | {os.getloadavg()[0]:.1f} |", flush=True)


def made_up(count: int, rate_hz: float) -> FlightFixes:
    """Return a flight of fixes to the north-east."""
    begin_ns = 1_777_629_600 * NS
    fixes = tuple(
        PlacedFix(
            name=f"{at:06x}",
            lon_deg=9.52 + at * 1e-5,
            lat_deg=47.14 + at * 1e-5,
            east_m=539_000.0 + at,
            north_m=5_221_000.0 + at,
            heading_deg=45.0,
            yaw_deg=45.4,
            is_accepted=True,
            covariance=(9.0, 1.0, 0.0, 1.0, 9.0, 0.0, 0.0, 0.0, 4.0),
            time_ns=begin_ns + round(at / rate_hz * NS),
            delay_s=0.3,
        )
        for at in range(count)
    )
    return FlightFixes(flight="made-up", fixes=fixes, views=count, begin_ns=begin_ns, clock="utc", epsg=32632)


def hear(listener: socket.socket, count: int, name: str, came_s: list[float]) -> None:
    """Note when so many messages of a name came."""
    link = common.MAVLink(None)
    listener.settimeout(30.0)
    while len(came_s) < count:
        data = listener.recv(65_536)
        now_s = time.monotonic()
        came_s += [now_s for message in link.parse_buffer(data) or () if message.get_type() == name]


if __name__ == "__main__":
    main()
