# SPDX-License-Identifier: Apache-2.0
"""Time and size of the page that plays a flight, as `inspect` writes it: a whole process.

    .venv/bin/python benchmarks/flight_page.py

A log of rings over an embedded town is imported, `dead_reckoning` is asked every view, and its worst flight inspected;
all in a temporary folder. Goals: 500 views in 20 s and 5 MB.
"""

import argparse
import sys
import tempfile
from pathlib import Path

import numpy as np
from locate import watched

import sasgeo_bench as sgb
from sasgeo_bench.geometry.projection import to_lonlat
from sasgeo_bench.regions.region_files import read_manifest

TOWN = "town-grid"


def write_rings(path: Path, region: Path, length_m: float) -> None:
    """Write a log of rings of 300 to 500 m around the middle of a region, at 10 m/s, a point a second."""
    manifest = read_manifest(region)
    west, south, east, north = manifest.bounds_m
    time_s = np.arange(0.0, length_m / 10.0)
    radius_m = 400.0 + 100.0 * np.sin(time_s / 300.0)
    turn = np.cumsum(10.0 / radius_m)
    x_m, y_m = (west + east) / 2 + radius_m * np.cos(turn), (south + north) / 2 + radius_m * np.sin(turn)
    lon, lat = to_lonlat(manifest.epsg).transform(x_m, y_m)
    rows = [f"{s:g},{y:.8f},{x:.8f},100" for s, y, x in zip(time_s, lat, lon, strict=True)]
    path.write_text("\n".join(["time_s,lat,lon,height_m", *rows]) + "\n", encoding="ascii")


def main() -> None:
    """Print views, seconds and megabytes."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--length-m", type=float, default=26_000.0)
    given = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        out, log = Path(folder, "out"), Path(folder, "log.csv")
        sgb.build_region(TOWN, out=out)
        write_rings(log, out / "regions" / TOWN, given.length_m)
        (task,) = sgb.import_flight(log, region=TOWN, out=out)
        sgb.run(matcher="dead_reckoning", tasks=[task], out=out)
        words = ["inspect", str(out / "runs" / "dead_reckoning"), "--out", str(out)]
        seconds, megabytes = watched([sys.executable, "-m", "sasgeo_bench", *words])
        (page,) = (out / "sheets").glob("*.html")
        views = page.read_text(encoding="utf-8").partition('"status": [')[2].partition("]")[0].count('"') // 2
        print(f"{views} views: {seconds:.1f} s, a page of {page.stat().st_size / 1e6:.1f} MB, {megabytes:.0f} MB held")


if __name__ == "__main__":
    main()
