#!/usr/bin/env bash
# SPDX-License-Identifier: Apache-2.0
# pyproj's `CRS.to_epsg()` and rasterio's take a CRS whose datum is unknown, as PROJ's strings without a datum and many
# .prj files have it, for one with a datum by its ellipsoid alone, at the default confidence of 70: Bessel's is that of a
# railway (EPSG:5683), Krassowsky's Albania's, the international one ED50 or Aratu. Places transformed by the code lie
# 126 m to 256 m from those transformed by the CRS itself. rasterio's also forgets a +towgs84 of one's own. Guessed:
# None, as for +proj=longlat +ellps=WGS84. Seen with pyproj 3.7.2 (PROJ 9.5.1), rasterio 1.4.4 (GDAL 3.10.3).
set -euo pipefail
scratch=$(mktemp -d)
trap 'rm -rf "$scratch"' EXIT
python3 -m venv "$scratch/venv"
"$scratch/venv/bin/pip" install --quiet --disable-pip-version-check pyproj==3.7.2 rasterio==1.4.4 numpy==2.4.6
cat > "$scratch/show.py" <<'PYTHON'
import sys

import pyproj
import rasterio

CASES = {  # by what a file states: the code, and a place of it
    "+proj=tmerc +lat_0=0 +lon_0=9 +k=1 +x_0=3500000 +ellps=bessel": (5683, 3_500_000),
    "+proj=tmerc +lat_0=0 +lon_0=21 +k=1 +x_0=4500000 +ellps=krass": (2462, 4_500_000),
    "+proj=utm +zone=32 +ellps=intl": (23032, 500_000),
    "+proj=utm +zone=22 +south +ellps=intl": (20822, 500_000),
    "+proj=longlat +ellps=WGS84": (None, 0),
}
print(f"pyproj {pyproj.__version__} (PROJ {pyproj.proj_version_str}), rasterio {rasterio.__version__}")
is_so = True
for text, (code, east) in CASES.items():
    crs = pyproj.CRS(text)
    codes = crs.to_epsg(), rasterio.crs.CRS.from_string(text).to_epsg()
    is_so &= codes == (code, code)
    line = f"{text}: datum {crs.datum.name!r}, codes {codes}"
    if codes[0] is not None:
        ways = [pyproj.Transformer.from_crs(one, "EPSG:4326", always_xy=True) for one in (crs, codes[0])]
        (lon, lat), (other_lon, other_lat) = (way.transform(east, 5_300_000) for way in ways)
        off_m = pyproj.Geod(ellps="WGS84").inv(lon, lat, other_lon, other_lat)[2]
        is_so &= off_m > 100
        line += f", {pyproj.CRS.from_epsg(codes[0]).name}; {off_m:.0f} m apart"
    print(line)
shifted = "+proj=utm +zone=32 +ellps=GRS80 +towgs84=100,50,0,0,0,0,0"
codes = pyproj.CRS(shifted).to_epsg(), rasterio.crs.CRS.from_string(shifted).to_epsg()
print(f"{shifted}: codes {codes}")
sys.exit(not (is_so and codes == (None, 25832)))
PYTHON
cd "$scratch"
venv/bin/python show.py
