#!/usr/bin/env bash
# SPDX-License-Identifier: Apache-2.0
# A KML placemark whose geometry is a `<LinearRing>` of its own, as KML allows, reads through GDAL's LIBKML driver and
# pyogrio as a geometry of no bytes: not None, so it passes a test for missing ones, and shapely raises on it. The same
# ring as a LineString is read. Guessed: a closed line. Seen with GDAL 3.12.4 (pyogrio 0.13.0), shapely 2.2.0.
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

gdal = ".".join(map(str, pyogrio.__gdal_version__))
print(f"GDAL {gdal}, pyogrio {pyogrio.__version__}, shapely {shapely.__version__}")
seen = {}
for name in ("LinearRing", "LineString"):
    ring = f"<{name}><coordinates>10,50 11,50 11,51 10,50</coordinates></{name}>"
    body = f"<Document><Placemark><name>field</name>{ring}</Placemark></Document>"
    Path("field.kml").write_text(f'<kml xmlns="http://www.opengis.net/kml/2.2">{body}</kml>')
    data = pyogrio.raw.read("field.kml")[2][0]
    try:
        seen[name] = len(data), shapely.from_wkb(data).geom_type
    except shapely.errors.GEOSException as error:
        seen[name] = len(data), type(error).__name__
    print(f"{name}: {seen[name][0]} bytes, {seen[name][1]}")
sys.exit((seen["LinearRing"], seen["LineString"][1]) != ((0, "GEOSException"), "LineString"))
PYTHON
cd "$scratch"
venv/bin/python show.py
