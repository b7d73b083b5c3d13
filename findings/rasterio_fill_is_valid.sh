#!/usr/bin/env bash
# SPDX-License-Identifier: Apache-2.0
# rasterio's read beyond the edge of a picture: `boundless=True, masked=True` masks the ground outside, but with a
# `fill_value` nothing outside is masked, so that made-up cells count as measured ones; with `fill_value=0` they are
# masked again. Guessed: the value under the mask changes, not the mask. Seen with rasterio 1.4.4 (GDAL 3.10.3).
set -euo pipefail
scratch=$(mktemp -d)
trap 'rm -rf "$scratch"' EXIT
python3 -m venv "$scratch/venv"
"$scratch/venv/bin/pip" install --quiet --disable-pip-version-check rasterio==1.4.4 numpy==2.4.6
cat > "$scratch/show.py" <<'PYTHON'
import sys

import numpy as np
import rasterio
from rasterio.windows import Window

about = {"driver": "GTiff", "width": 3, "height": 1, "count": 1, "dtype": "uint8", "crs": "EPSG:32632"}
with rasterio.open("strip.tif", "w", transform=rasterio.Affine(1, 0, 600_000, 0, -1, 5_400_000), **about) as strip:
    strip.write(np.array([[1, 2, 3]], np.uint8), 1)
print(f"rasterio {rasterio.__version__}, GDAL {rasterio.__gdal_version__}; the first two of four cells are outside")
seen = {}
with rasterio.open("strip.tif") as strip:
    for fill in (None, 77, 0):
        cells = strip.read(1, window=Window(-2, 0, 4, 1), boundless=True, masked=True, fill_value=fill)
        seen[fill] = np.ma.getmaskarray(cells)[0].tolist()
        print(f"fill_value={fill}: cells {cells.data[0].tolist()}, masked {seen[fill]}")
outside, none = [True, True, False, False], [False] * 4
sys.exit(seen != {None: outside, 77: none, 0: outside})
PYTHON
cd "$scratch"
venv/bin/python show.py
