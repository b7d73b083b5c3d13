#!/usr/bin/env bash
# SPDX-License-Identifier: Apache-2.0
# GDAL's OSM driver keeps all digits of a node that is a feature, and seven of the same node as a corner of a way: where
# a file has more (editors write eleven for what they have moved), a crossing no longer lies on its road, and `touches`
# or a join by place says false. pyosmium rounds both. Guessed: one number for one node. Seen with GDAL 3.12.4 (pyogrio
# 0.13.0), pyosmium 4.3.2.
set -euo pipefail
scratch=$(mktemp -d)
trap 'rm -rf "$scratch"' EXIT
python3 -m venv "$scratch/venv"
"$scratch/venv/bin/pip" install --quiet --disable-pip-version-check osmium==4.3.2 pyogrio==0.13.0 shapely==2.2.0
cat > "$scratch/show.py" <<'PYTHON'
import sys
from importlib.metadata import version
from pathlib import Path

import osmium
import pyogrio
import pyogrio.raw
import shapely


def write(lon, lat):
    crossing = f'<node id="1" version="1" lon="{lon}" lat="{lat}"><tag k="highway" v="crossing"/></node>'
    ends = '<node id="2" version="1" lon="13.401" lat="52.501"/><node id="3" version="1" lon="13.399" lat="52.5"/>'
    refs = "".join(f'<nd ref="{at}"/>' for at in (3, 1, 2))
    way = f'<way id="1" version="1">{refs}<tag k="highway" v="residential"/></way>'
    Path("road.osm").write_text(f'<osm version="0.6">{crossing}{ends}{way}</osm>')


def in_gdal():
    point, line = (shapely.from_wkb(pyogrio.raw.read("road.osm", layer=name)[2][0]) for name in ("points", "lines"))
    return point.coords[0], line.coords[1]


def in_pyosmium():
    point = corner = None
    for item in osmium.FileProcessor("road.osm").with_locations():
        if item.is_node() and item.id == 1:
            point = item.lon, item.lat
        elif item.is_way():
            corner = item.nodes[1].lon, item.nodes[1].lat
    return point, corner


print(f"GDAL {'.'.join(map(str, pyogrio.__gdal_version__))}, pyosmium {version('osmium')}")
seen = []
for place in (("13.40012345678", "52.50012345678"), ("13.4001235", "52.5001235")):
    write(*place)
    for name, (point, corner) in (("GDAL", in_gdal()), ("pyosmium", in_pyosmium())):
        seen.append(point == corner)
        print(f"crossing at {place}, {name}: point {point}, corner of the road {corner}, the same: {seen[-1]}")
sys.exit(seen != [False, True, True, True])
PYTHON
cd "$scratch"
venv/bin/python show.py
