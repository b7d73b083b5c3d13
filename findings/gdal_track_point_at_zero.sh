#!/usr/bin/env bash
# SPDX-License-Identifier: Apache-2.0
# GDAL's LIBKML driver reads an empty `<gx:coord/>` of a flight log's track as the point 0, 0, 0. KML has the empty
# element for a moment whose place is unknown; a gap of one reading is so a line to the Gulf of Guinea and back, and
# valid geometry. Guessed: the point is left out. Seen with GDAL 3.12.4 (pyogrio 0.13.0).
set -euo pipefail
scratch=$(mktemp -d)
trap 'rm -rf "$scratch"' EXIT
python3 -m venv "$scratch/venv"
"$scratch/venv/bin/pip" install --quiet --disable-pip-version-check pyogrio==0.13.0 shapely==2.2.0 numpy==2.4.6
cat > "$scratch/show.py" <<'PYTHON'
import sys
from pathlib import Path

import pyogrio
import pyogrio.raw
import shapely

SPACES = 'xmlns="http://www.opengis.net/kml/2.2" xmlns:gx="http://www.google.com/kml/ext/2.2"'
times = "".join(f"<when>2020-01-01T00:00:0{second}Z</when>" for second in range(3))
places = "<gx:coord>10 50 100</gx:coord><gx:coord/><gx:coord>10.001 50 101</gx:coord>"
track = f"<Placemark><name>flight</name><gx:Track>{times}{places}</gx:Track></Placemark>"
Path("flight.kml").write_text(f'<?xml version="1.0"?><kml {SPACES}><Document>{track}</Document></kml>')
line = shapely.from_wkb(pyogrio.raw.read("flight.kml")[2][0])
print(f"GDAL {'.'.join(map(str, pyogrio.__gdal_version__))}, pyogrio {pyogrio.__version__}")
print("three readings, the second without a place:", line.wkt)
sys.exit(list(line.coords) != [(10, 50, 100), (0, 0, 0), (10.001, 50, 101)])
PYTHON
cd "$scratch"
venv/bin/python show.py
