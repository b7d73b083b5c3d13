#!/usr/bin/env bash
# SPDX-License-Identifier: Apache-2.0
# GDAL's OSM driver tells from the key alone (by a list in its osmconf.ini) whether a closed way is an area: storage
# tanks, solar panels, substations, building parts and dams are lines; closed loops of a taxiway or a cliff, and the
# coastline of an island, polygons. pyosmium takes all of them for areas, and a road around a block too. So the same
# file has other areas in the one than in the other. Guessed: by key and value. Seen with GDAL 3.12.4 (pyogrio 0.13.0),
# pyosmium 4.3.2.
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
LINES = ["man_made=storage_tank", "power=generator", "power=substation", "building:part=yes", "waterway=dam"]
POLYGONS = ["aeroway=taxiway", "natural=cliff", "natural=coastline"]
ROUND = ["highway=residential"]
nodes = "".join(f'<node id="{at}" version="1" lon="{x}" lat="{y}"/>' for at, (x, y) in enumerate(PLACES, 1))
refs = "".join(f'<nd ref="{at}"/>' for at in (1, 2, 3, 4, 1))
print(f"GDAL {'.'.join(map(str, pyogrio.__gdal_version__))}, pyosmium {version('osmium')}")
seen = {}
for tag in LINES + POLYGONS + ROUND:
    key, value = tag.split("=")
    way = f'<way id="1" version="1">{refs}<tag k="{key}" v="{value}"/></way>'
    Path("way.osm").write_text(f'<osm version="0.6">{nodes}{way}</osm>')
    layers = [name for name in ("lines", "multipolygons") if len(pyogrio.raw.read("way.osm", layer=name)[2])]
    seen[tag] = layers, sum(item.is_area() for item in osmium.FileProcessor("way.osm").with_areas())
    print(f"closed way {tag}: GDAL {', '.join(layers)}; pyosmium {seen[tag][1]} area")
sys.exit(seen != {tag: (["multipolygons" if tag in POLYGONS else "lines"], 1) for tag in seen})
PYTHON
cd "$scratch"
venv/bin/python show.py
