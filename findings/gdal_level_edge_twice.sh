#!/usr/bin/env bash
# SPDX-License-Identifier: Apache-2.0
# GDAL burns the cells whose centres lie on a level edge for both neighbours that share it, and those on an upright edge
# for one: parcels that tile a square of 100 cells have 110 together, or 100 if the cut is turned by 90 degrees. In an
# image of labels the last one burnt wins, so that their order moves the edge. Seen with GDAL 3.10.3 (rasterio 1.4.4).
set -euo pipefail
scratch=$(mktemp -d)
trap 'rm -rf "$scratch"' EXIT
python3 -m venv "$scratch/venv"
"$scratch/venv/bin/pip" install --quiet --disable-pip-version-check rasterio==1.4.4 shapely==2.2.0 numpy==2.4.6
cat > "$scratch/show.py" <<'PYTHON'
import sys

import rasterio
import shapely
from rasterio.features import rasterize
from rasterio.transform import from_origin


def cells(*parcels):
    return [int(rasterize([each], out_shape=(10, 10), transform=from_origin(0, 10, 1, 1)).sum()) for each in parcels]


level = cells(shapely.box(0, 0, 10, 5.5), shapely.box(0, 5.5, 10, 10))  # the cut runs through centres of cells
upright = cells(shapely.box(0, 0, 5.5, 10), shapely.box(5.5, 0, 10, 10))
print(f"GDAL {rasterio.__gdal_version__}, rasterio {rasterio.__version__}")
print(f"a square of 100 cells cut by a level line: {level[0]} + {level[1]} = {sum(level)}")
print(f"a square of 100 cells cut by an upright line: {upright[0]} + {upright[1]} = {sum(upright)}")
sys.exit((sum(level), sum(upright)) != (110, 100))
PYTHON
"$scratch/venv/bin/python" "$scratch/show.py"
