#!/usr/bin/env bash
# SPDX-License-Identifier: Apache-2.0
# pyosmium places no node with a negative id, as editors number what is not uploaded yet: `with_areas()` leaves a
# building of such nodes out without an error, `with_locations()` gives its way without places, though the nodes
# themselves have them. One new corner of an old building is enough. GDAL stops at such a file and names the setting
# that reads it. Guessed: placed, or an error. Seen with pyosmium 4.3.2, GDAL 3.12.4 (pyogrio 0.13.0).
set -euo pipefail
scratch=$(mktemp -d)
trap 'rm -rf "$scratch"' EXIT
python3 -m venv "$scratch/venv"
"$scratch/venv/bin/pip" install --quiet --disable-pip-version-check osmium==4.3.2 pyogrio==0.13.0 numpy==2.4.6
cat > "$scratch/show.py" <<'PYTHON'
import sys
from importlib.metadata import version
from pathlib import Path

import osmium
import pyogrio
import pyogrio.raw

PLACES = [(1, 1), (2, 1), (2, 2), (1, 2)]


def write(*ids):
    nodes = [f'<node id="{key}" version="1" lon="{x}" lat="{y}"/>' for key, (x, y) in zip(ids, PLACES, strict=True)]
    refs = "".join(f'<nd ref="{key}"/>' for key in (*ids, ids[0]))
    way = f'<way id="1" version="1">{refs}<tag k="building" v="yes"/></way>'
    Path("house.osm").write_text(f'<osm version="0.6">{"".join(nodes)}{way}</osm>')


def found():
    areas = sum(item.is_area() for item in osmium.FileProcessor("house.osm").with_areas())
    placed = 0
    for item in osmium.FileProcessor("house.osm").with_locations():
        if item.is_way():
            placed = sum(node.location.valid() for node in item.nodes)
    return areas, placed


def polygons(custom):
    pyogrio.set_gdal_config_options({"OSM_USE_CUSTOM_INDEXING": custom})
    try:
        return len(pyogrio.raw.read("house.osm", layer="multipolygons")[2])
    except pyogrio.errors.FeatureError as error:
        return str(error)


print(f"pyosmium {version('osmium')}, GDAL {'.'.join(map(str, pyogrio.__gdal_version__))}")
seen = []
for ids in ((1, 2, 3, 4), (-1, 2, 3, 4), (-1, -2, -3, -4)):
    write(*ids)
    seen.append(found())
    print(f"a building of the nodes {ids}: pyosmium {seen[-1][0]} area, {seen[-1][1]} of 5 places")
stop, other = polygons("YES"), polygons("NO")
print("GDAL, the last one:", stop, "| with that:", other)
sys.exit((seen, other, "CUSTOM_INDEXING" in str(stop)) != ([(1, 5), (0, 3), (0, 0)], 1, True))
PYTHON
cd "$scratch"
venv/bin/python show.py
