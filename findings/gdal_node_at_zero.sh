#!/usr/bin/env bash
# SPDX-License-Identifier: Apache-2.0
# GDAL's OSM driver loses a node at exactly longitude 0, latitude 0: a square becomes a triangle, a road a shorter one.
# Valid OSM: a node may lie there, on the equator in the Gulf of Guinea. Seen with GDAL 3.12.4 (pyogrio 0.13.0), and with
# 3.6.2 of Debian 12. A node one step of 1e-7 degrees away is kept.
set -euo pipefail
scratch=$(mktemp -d)
trap 'rm -rf "$scratch"' EXIT
python3 -m venv "$scratch/venv"
"$scratch/venv/bin/pip" install --quiet --disable-pip-version-check pyogrio==0.13.0 shapely==2.2.0
cat > "$scratch/show.py" <<'PYTHON'
import sys
from pathlib import Path

import pyogrio
import pyogrio.raw
import shapely

NODES = {1: (None, None), 2: (0.001, 0), 3: (0.001, 0.001), 4: (0, 0.001), 5: (0.0005, 0.0005)}
WAYS = {1: ([1, 2, 3, 4, 1], "building", "yes"), 2: ([5, 1, 2], "highway", "service")}


def points(folder, at):
    nodes = NODES | {1: at}
    body = [f'<node id="{key}" version="1" lon="{lon:.7f}" lat="{lat:.7f}"/>' for key, (lon, lat) in nodes.items()]
    for key, (refs, tag, value) in WAYS.items():
        inner = "".join(f'<nd ref="{ref}"/>' for ref in refs)
        body.append(f'<way id="{key}" version="1">{inner}<tag k="{tag}" v="{value}"/></way>')
    path = Path(folder, "square.osm")
    path.write_text(f'<osm version="0.6">{"".join(body)}</osm>')
    layers = ("multipolygons", "lines")
    return [len(shapely.get_coordinates(shapely.from_wkb(pyogrio.raw.read(path, layer=name)[2]))) for name in layers]


zero, beside = points(sys.argv[1], (0, 0)), points(sys.argv[1], (1e-7, 0))
print(f"GDAL {'.'.join(map(str, pyogrio.__gdal_version__))}, pyogrio {pyogrio.__version__}")
print(f"corner at 0, 0: the square's ring has {zero[0]} points, the road {zero[1]}")
print(f"corner at 0.0000001, 0: the square's ring has {beside[0]} points, the road {beside[1]}")
sys.exit((zero, beside) != ([4, 2], [5, 3]))
PYTHON
"$scratch/venv/bin/python" "$scratch/show.py" "$scratch"
