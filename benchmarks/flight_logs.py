# SPDX-License-Identifier: Apache-2.0
"""Time and memory of reading flight logs: whole processes of `import-flight` on logs that this script writes.

Logs of 20 minutes have the messages of a usual flight around those that are read (1,000 a second); logs of a million
rows have a fix in each. `python benchmarks/flight_logs.py [FOLDER]`; needs the extra [logs] and 1 GB on disk.
"""

import os
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Final

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1]))
from tests.flights import autopilots  # writes them, in all formats

REPEATS: Final = 3
MINUTES: Final = 20
ROWS: Final = 1_000_000
PROGRAM: Final = "from sasgeo_bench.cli import main; main()"
FAST: Final = "uint64_t timestamp;float[16] v;"
IMU: Final = (210, "QBffffffIIfBBHH", "TimeUS,I,GyrX,GyrY,GyrZ,AccX,AccY,AccZ,EG,EA,T,GH,AH,GHz,AHz")


def steps(count: int, rate_hz: float) -> np.ndarray:
    """Microseconds of messages at an even rate."""
    return (np.arange(count) * (1e6 / rate_hz)).astype(np.int64)


def places(count: int) -> tuple[list[float], list[float]]:
    """Longitudes and latitudes of circles of 300 m, flown in a minute each at five fixes a second."""
    angle = np.arange(count) * 2 * np.pi / 300
    return (9.52 + 0.004 * np.sin(angle)).tolist(), (47.14 + 0.0027 * np.cos(angle)).tolist()


def write_ulog(path: Path, fixes: int, *, more: int = 0) -> None:
    """Write a ULog of fixes, heights and attitudes, and of other messages."""
    lon, lat = places(fixes)
    stamps = steps(fixes, 5).tolist()
    gps = [(us, 1_746_093_600_000_000 + us, lat[at], lon[at], 480.0, 527.0, 1.2, 3) for at, us in enumerate(stamps)]
    topics = {("vehicle_gps_position", 0): (autopilots.GPS_114, gps)}
    if more:
        often = steps(fixes * 10, 50).tolist()
        topics |= {
            ("vehicle_local_position", 0): (autopilots.LOCAL, [(us, 0.0, 0.0, -80.0, True, True) for us in often[::5]]),
            ("home_position", 0): (autopilots.HOME, [(0, lat[0], lon[0], 480.0, 0.0, 0.0, 0.0, 0.0)]),
            ("vehicle_attitude", 0): (autopilots.ATTITUDE, [(us, 1.0, 0.0, 0.0, 0.0) for us in often]),
            ("sensor_combined", 0): (FAST, [(us, *[0.1] * 16) for us in steps(more, 1000).tolist()]),
        }
    path.write_bytes(autopilots.ulog(topics))


def write_dataflash(path: Path, fixes: int, *, more: int = 0) -> None:
    """Write a DataFlash log of fixes, heights and attitudes, and of other messages."""
    lon, lat = places(fixes)
    gps_ms = [round(one / 1e3) for one in steps(fixes, 5).tolist()]
    rows = {
        "GPS": [
            (us, 0, 3, gps_ms[at] % 604_800_000, 2364, 9, 0.8, lat[at], lon[at], 480.0, 8.0, 45.0, 0.0, 0.0, 1)
            for at, us in enumerate(steps(fixes, 5).tolist())
        ]
    }
    if more:
        often = steps(fixes * 5, 25).tolist()
        rows["POS"] = [(us, 47.14, 9.52, 560.0, 80.0, 80.0) for us in often]
        rows["ATT"] = [(us, 0.0, 0.0, 0.0, 0.0, 0.0, 90.0, 0.0, 0.0, 1) for us in often]
        rows["IMU"] = [(us, 0, *[0.1] * 6, 0, 0, 40.0, 1, 1, 1000, 1000) for us in steps(more, 1000).tolist()]
    path.write_bytes(autopilots.dataflash(rows, autopilots.MESSAGES | {"IMU": IMU}))


def write_gpx(path: Path, fixes: int) -> None:
    """Write a GPX track with elevations and times."""
    lon, lat = places(fixes)
    times = np.datetime_as_string(
        np.datetime64("2025-05-01T10:00:00.000") + steps(fixes, 5).astype("m8[us]"), unit="ms"
    )
    points = (
        f'<trkpt lat="{y:.7f}" lon="{x:.7f}"><ele>480.5</ele><time>{at}Z</time></trkpt>\n'
        for x, y, at in zip(lon, lat, times.tolist(), strict=True)
    )
    with path.open("w") as file:
        file.write('<?xml version="1.0"?><gpx xmlns="http://www.topografix.com/GPX/1/1"><trk><trkseg>\n')
        file.writelines(points)
        file.write("</trkseg></trk></gpx>\n")


def write_csv(path: Path, fixes: int) -> None:
    """Write a table of times, places and heights."""
    lon, lat = places(fixes)
    rows = (
        f"{us / 1e6:.1f},{y:.7f},{x:.7f},80.0\n" for us, x, y in zip(steps(fixes, 5).tolist(), lon, lat, strict=True)
    )
    with path.open("w") as file:
        file.write("time_s,lat_deg,lon_deg,height_m\n")
        file.writelines(rows)


def write_tlog(path: Path, fixes: int) -> None:
    """Write a telemetry log of fixes alone."""
    from pymavlink.dialects.v20 import common  # noqa: PLC0415 - of the extra

    lon, lat = places(fixes)
    link = common.MAVLink(None, srcSystem=1, srcComponent=1)
    with path.open("wb") as file:
        for us, x, y in zip(steps(fixes, 5).tolist(), lon, lat, strict=True):
            one = common.MAVLink_gps_raw_int_message(
                us + 1, 3, round(y * 1e7), round(x * 1e7), 480_000, 80, 90, 0, 0, 9
            )
            file.write((1_746_093_600_000_000 + us).to_bytes(8, "big") + bytes(one.pack(link)))


def write_mcap(path: Path, fixes: int) -> None:
    """Write an MCAP file of fixes alone."""
    lon, lat = places(fixes)
    messages = (
        (
            "/fix",
            autopilots.NAV_SAT,
            1_746_093_600_000_000_000 + us * 1000,
            {"header": {"stamp": autopilots.stamp(us / 1e6)}, "latitude": y, "longitude": x, "altitude": 527.0},
        )
        for us, x, y in zip(steps(fixes, 5).tolist(), lon, lat, strict=True)
    )
    folder = autopilots.bag(path, messages, topics=[("/fix", autopilots.NAV_SAT)])
    next(folder.glob("*.mcap")).rename(path)


FLOWN: Final = MINUTES * 60
LOGS: Final = {
    f"ULog, {MINUTES} min": ("a.ulg", lambda path: write_ulog(path, FLOWN * 5, more=FLOWN * 1000)),
    f"DataFlash, {MINUTES} min": ("a.bin", lambda path: write_dataflash(path, FLOWN * 5, more=FLOWN * 1000)),
    "GPX, a million points": ("b.gpx", lambda path: write_gpx(path, ROWS)),
    "CSV, a million rows": ("b.csv", lambda path: write_csv(path, ROWS)),
    "ULog, a million fixes": ("b.ulg", lambda path: write_ulog(path, ROWS)),
    "DataFlash, a million fixes": ("b.bin", lambda path: write_dataflash(path, ROWS)),
    "telemetry, a million fixes": ("b.tlog", lambda path: write_tlog(path, ROWS)),
    "MCAP, a million fixes": ("b.mcap", lambda path: write_mcap(path, ROWS)),
}


def measure(path: Path) -> tuple[float, float, float]:
    """Return seconds by the clock and of processor, and peak megabytes, of one process that reads a log."""
    start = time.perf_counter()
    process = subprocess.Popen(  # noqa: S603 - our own program
        [sys.executable, "-c", PROGRAM, "import-flight", str(path)], stdout=subprocess.DEVNULL
    )
    _, status, used = os.wait4(process.pid, 0)
    if status:
        raise SystemExit(f"import-flight {path} failed")
    return time.perf_counter() - start, used.ru_utime + used.ru_stime, used.ru_maxrss * 1024 / 1e6


def main() -> None:
    """Write the logs, each in a process of its own, whose memory the next do not inherit, and print the table."""
    if sys.argv[1:2] == ["--write"]:
        LOGS[sys.argv[2]][1](Path(sys.argv[3]))
        return
    with tempfile.TemporaryDirectory() as scratch:
        folder = Path(sys.argv[1]) if len(sys.argv) > 1 else Path(scratch)
        print("| log | MB | s | CPU s | peak MB |\n|---|---:|---:|---:|---:|")
        for name, (file, _) in LOGS.items():
            path = folder / file
            if not path.exists():
                subprocess.run([sys.executable, __file__, "--write", name, path], check=True)  # noqa: S603 - this script
            clock_s, processor_s, peaks = zip(*(measure(path) for _ in range(REPEATS)), strict=True)
            figures = f"{statistics.median(clock_s):.1f} | {statistics.median(processor_s):.1f} | {max(peaks):.0f}"
            print(f"| {name} | {path.stat().st_size / 1e6:.0f} | {figures} |", flush=True)


if __name__ == "__main__":
    main()
