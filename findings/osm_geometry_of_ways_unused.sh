#!/usr/bin/env bash
# SPDX-License-Identifier: Apache-2.0
# OSM XML that gives each way's corners with their places, as a query server's "out geom" does, holds all a polygon
# needs, but GDAL has no feature of it and pyosmium's `with_areas()` no area, both without an error: they know places of
# nodes only. pyosmium reads those places, but `with_locations()` wipes them out again. Guessed: a polygon, or an error.
# Seen with GDAL 3.12.4 (pyogrio 0.13.0), pyosmium 4.3.2.
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
refs = "".join(f'<nd ref="{at + 1}" lon="{PLACES[at][0]}" lat="{PLACES[at][1]}"/>' for at in (0, 1, 2, 3, 0))
bounds = '<bounds minlat="1" minlon="1" maxlat="2" maxlon="2"/>'
way = f'<way id="1">{bounds}{refs}<tag k="building" v="yes"/></way>'
Path("geom.osm").write_text(f'<osm version="0.6">{way}</osm>')


def placed(items):
    return sum(node.location.valid() for item in items if item.is_way() for node in item.nodes)


layers = [str(name) for name, _ in pyogrio.list_layers("geom.osm")]
features = sum(len(pyogrio.raw.read("geom.osm", layer=name)[2]) for name in layers)
areas = sum(item.is_area() for item in osmium.FileProcessor("geom.osm").with_areas())
plain, joined = (placed(osmium.FileProcessor("geom.osm")), placed(osmium.FileProcessor("geom.osm").with_locations()))
print(f"GDAL {'.'.join(map(str, pyogrio.__gdal_version__))}, pyosmium {version('osmium')}")
print(f"a building with its corners' places: GDAL {features} features in {len(layers)} layers, pyosmium {areas} areas")
print(f"pyosmium, places of the way's 5 nodes: {plain}; with_locations(): {joined}")
sys.exit((features, areas, plain, joined) != (0, 0, 5, 0))
PYTHON
cd "$scratch"
venv/bin/python show.py
