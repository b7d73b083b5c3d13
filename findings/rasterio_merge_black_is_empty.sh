#!/usr/bin/env bash
# SPDX-License-Identifier: Apache-2.0
# rasterio's merge takes 0 for "not there yet", also where no nodata is set: with `method="first"` a black cell of the
# first picture is overwritten by the second, though nothing says that black is empty; so shadow is patched from the
# neighbour. `method="count"` counts the same black cell as one of two. Guessed: the first picture wins wherever it
# lies. Seen with rasterio 1.4.4.
set -euo pipefail
scratch=$(mktemp -d)
trap 'rm -rf "$scratch"' EXIT
python3 -m venv "$scratch/venv"
"$scratch/venv/bin/pip" install --quiet --disable-pip-version-check rasterio==1.4.4 numpy==2.4.6
cat > "$scratch/show.py" <<'PYTHON'
import sys

import numpy as np
import rasterio
from rasterio.merge import merge


def write(name, west, cells):
    about = {"driver": "GTiff", "width": 3, "height": 1, "count": 1, "dtype": "uint8", "crs": "EPSG:32632"}
    with rasterio.open(name, "w", transform=rasterio.Affine(1, 0, 600_000 + west, 0, -1, 5_400_000), **about) as file:
        file.write(np.array([cells], np.uint8), 1)
    return name


pictures = [write("first.tif", 0, [5, 0, 5]), write("second.tif", 1, [9, 9, 9])]
seen = {method: merge(pictures, method=method)[0][0, 0].tolist() for method in ("first", "count")}
print(f"rasterio {rasterio.__version__}")
print("cells 5 0 5 and, one cell to the east, 9 9 9, no nodata:", seen)
sys.exit(seen != {"first": [5, 9, 5, 9], "count": [1, 2, 2, 1]})
PYTHON
cd "$scratch"
venv/bin/python show.py
