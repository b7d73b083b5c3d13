#!/usr/bin/env bash
# SPDX-License-Identifier: Apache-2.0
# GDAL's OSM driver hands out invalid polygons for multipolygons that pyosmium joins to valid ones: two inner rings that
# share an edge, two outer rings that do, an inner ring along the outer one stay as they are drawn. The usual mend,
# shapely's `make_valid`, fills the last one's yard: 0.7 of the square becomes 1. Guessed: joined, as the layer is one
# of polygons. Seen with GDAL 3.12.4 (pyogrio 0.13.0), pyosmium 4.3.2, shapely 2.2.0.
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

PLACES = [(1, 1), (2, 1), (2, 2), (1, 2), (1.3, 1.3), (1.6, 1.3), (1.6, 1.6), (1.3, 1.6), (3, 1), (3, 2)]
YARD = (1, 2, 3, 4, 1)
CASES = {
    "inner beside inner": {"outer": [YARD], "inner": [(5, 6, 7, 5), (7, 8, 5, 7)]},
    "outer beside outer": {"outer": [YARD, (2, 9, 10, 3, 2)], "inner": []},
    "inner along outer": {"outer": [YARD], "inner": [(1, 2, 7, 1)]},
    "inner apart": {"outer": [YARD], "inner": [(5, 6, 7, 5)]},
}


def write(rings):
    nodes = "".join(f'<node id="{at}" version="1" lon="{x}" lat="{y}"/>' for at, (x, y) in enumerate(PLACES, 1))
    ways = members = ""
    for key, (role, ring) in enumerate(((role, ring) for role in rings for ring in rings[role]), 1):
        refs = "".join(f'<nd ref="{at}"/>' for at in ring)
        ways += f'<way id="{key}" version="1">{refs}</way>'
        members += f'<member type="way" ref="{key}" role="{role}"/>'
    tags = '<tag k="type" v="multipolygon"/><tag k="building" v="yes"/>'
    last = f'<relation id="1" version="1">{members}{tags}</relation>'
    Path("yard.osm").write_text(f'<osm version="0.6">{nodes}{ways}{last}</osm>')


def shape():
    factory = osmium.geom.WKBFactory()
    for item in osmium.FileProcessor("yard.osm").with_areas():
        if item.is_area():
            return shapely.from_wkb(bytes.fromhex(factory.create_multipolygon(item)))
    raise SystemExit("no area")


gdal = ".".join(map(str, pyogrio.__gdal_version__))
print(f"GDAL {gdal}, pyosmium {version('osmium')}, shapely {shapely.__version__}")
seen = {}
for name, rings in CASES.items():
    write(rings)
    mine = shapely.from_wkb(pyogrio.raw.read("yard.osm", layer="multipolygons")[2][0])
    other = shape()
    areas = [round(each.area, 6) for each in (mine, shapely.make_valid(mine), other)]
    seen[name] = mine.is_valid, other.is_valid, areas[1] - areas[0], areas[2] - areas[0]
    print(f"{name}: GDAL {shapely.is_valid_reason(mine)}; pyosmium {shapely.is_valid_reason(other)}")
    print(f"    its area {areas[0]}, mended {areas[1]}; pyosmium's {areas[2]}")
gained = {name: round(each[2], 6) for name, each in seen.items()}
valid = {name: each[:2] for name, each in seen.items()}
print("gained by the mend:", gained)
right = valid == {name: (name == "inner apart", True) for name in CASES}
right &= gained == {name: 0.3 * (name == "inner along outer") for name in CASES}
sys.exit(not (right and all(each[3] == 0 for each in seen.values())))
PYTHON
cd "$scratch"
venv/bin/python show.py
