#!/usr/bin/env bash
# SPDX-License-Identifier: Apache-2.0
# GDAL's OSM driver drops the tags of a closed way that is the outer ring of a multipolygon with a tag of its own: a
# building along the edge of a housing estate is in no layer. With only `type` on the relation, the way's tags go to it
# (as was the custom once), so the building is there; one `name` or `source` on the relation, and it is nowhere.
# pyosmium's areas keep both, and so does GDAL if the way is a fence, which it takes for a line. Guessed: the way is a
# feature of its own. Seen with GDAL 3.12.4 (pyogrio 0.13.0), pyosmium 4.3.2.
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

CORNERS = [(1, 1), (2, 1), (2, 2), (1, 2), (1.2, 1.2), (1.4, 1.2), (1.4, 1.4), (1.2, 1.4)]
CASES = {
    "type only": ("building", {}),
    "name": ("building", {"name": "Court"}),
    "source": ("building", {"source": "survey"}),
    "landuse": ("building", {"landuse": "residential"}),
    "landuse, way is a fence": ("barrier", {"landuse": "residential"}),
}


def tags(pairs):
    return "".join(f'<tag k="{key}" v="{value}"/>' for key, value in pairs.items())


def write(key, relation):
    nodes = "".join(f'<node id="{at}" version="1" lon="{x}" lat="{y}"/>' for at, (x, y) in enumerate(CORNERS, 1))
    ways = ""
    for way, (ring, pairs) in {1: ((1, 2, 3, 4, 1), {key: "yes"}), 2: ((5, 6, 7, 8, 5), {})}.items():
        refs = "".join(f'<nd ref="{at}"/>' for at in ring)
        ways += f'<way id="{way}" version="1">{refs}{tags(pairs)}</way>'
    members = '<member type="way" ref="1" role="outer"/><member type="way" ref="2" role="inner"/>'
    last = f'<relation id="1" version="1">{members}{tags({"type": "multipolygon"} | relation)}</relation>'
    Path("court.osm").write_text(f'<osm version="0.6">{nodes}{ways}{last}</osm>')


def in_gdal(key):
    found = 0
    for layer in ("points", "lines", "multilinestrings", "multipolygons", "other_relations"):
        meta, _, _, columns = pyogrio.raw.read("court.osm", layer=layer)
        for name, column in zip(meta["fields"], columns, strict=True):
            found += sum(value is not None and (name == key or f'"{key}"' in str(value)) for value in column)
    return found


def in_pyosmium(key):
    return sum(item.is_area() and key in item.tags for item in osmium.FileProcessor("court.osm").with_areas())


seen = {}
print(f"GDAL {'.'.join(map(str, pyogrio.__gdal_version__))}, pyosmium {version('osmium')}")
for name, (key, relation) in CASES.items():
    write(key, relation)
    seen[name] = in_gdal(key), in_pyosmium(key)
    print(f"relation with {name}: features with `{key}`: GDAL {seen[name][0]}, pyosmium's areas {seen[name][1]}")
sys.exit(list(seen.values()) != [(1, 1), (0, 1), (0, 1), (0, 1), (1, 1)])
PYTHON
cd "$scratch"
venv/bin/python show.py
