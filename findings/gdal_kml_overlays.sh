#!/usr/bin/env bash
# SPDX-License-Identifier: Apache-2.0
# GDAL's LIBKML driver on KML's pictures: a `<GroundOverlay>` is a rectangle that its `<rotation>` does not turn, so
# that a picture turned by 90 degrees covers other ground than the polygon says; a `<PhotoOverlay>` with a camera and a
# point is no feature at all, though a placemark with only a camera is a point. Guessed: a turned rectangle, and a
# point. Seen with GDAL 3.12.4 (pyogrio 0.13.0).
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

BOX = "<north>51</north><south>50</south><east>14</east><west>10</west>"
CAMERA = "<Camera><longitude>10</longitude><latitude>50</latitude><altitude>80</altitude></Camera>"
POINT = "<Point><coordinates>10,50,80</coordinates></Point>"
ICON = "<Icon><href>a.jpg</href></Icon>"


def read(*features):
    body = "<Placemark><name>start</name><Point><coordinates>0,1</coordinates></Point></Placemark>" + "".join(features)
    Path("a.kml").write_text(f'<kml xmlns="http://www.opengis.net/kml/2.2"><Document>{body}</Document></kml>')
    return [shapely.from_wkb(each) for each in pyogrio.raw.read("a.kml")[2][1:]]  # after the start


def ground(turn):
    box = f"<LatLonBox>{BOX}<rotation>{turn}</rotation></LatLonBox>"
    return read(f"<GroundOverlay><name>g</name>{ICON}{box}</GroundOverlay>")[0].bounds


print(f"GDAL {'.'.join(map(str, pyogrio.__gdal_version__))}, pyogrio {pyogrio.__version__}")
turned = [ground(0), ground(90)]
print("a picture over 4 by 1 degrees, bounds if not turned and if turned by 90 degrees:", *turned)
photo = read(f"<PhotoOverlay><name>p</name>{CAMERA}{ICON}{POINT}</PhotoOverlay>")
placed = read(f"<Placemark><name>p</name>{CAMERA}</Placemark>")
print(f"features of a photo overlay: {len(photo)}; of a placemark with the same camera: {len(placed)}, {placed[0].wkt}")
sys.exit((turned, len(photo), len(placed)) != ([(10, 50, 14, 51)] * 2, 0, 1))
PYTHON
cd "$scratch"
venv/bin/python show.py
