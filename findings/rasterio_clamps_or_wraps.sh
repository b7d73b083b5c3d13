#!/usr/bin/env bash
# SPDX-License-Identifier: Apache-2.0
# rasterio, a number too large for the cells' type: `rasterize` clamps it and rounds, `write` lets it wrap and cuts, and
# neither warns. As uint8, 300 is 255 from the one and 44 from the other, -5 is 0 and 251, 1.7 is 2 and 1. Labels of
# more than 255 objects so become one object, or those of others. Guessed: an error, or at least the same from both.
# Seen with rasterio 1.4.4 (GDAL 3.10.3), numpy 2.4.6.
set -euo pipefail
scratch=$(mktemp -d)
trap 'rm -rf "$scratch"' EXIT
python3 -m venv "$scratch/venv"
"$scratch/venv/bin/pip" install --quiet --disable-pip-version-check rasterio==1.4.4 numpy==2.4.6
cat > "$scratch/show.py" <<'PYTHON'
import sys
import warnings

import numpy as np
import rasterio
from rasterio.features import rasterize

warnings.simplefilter("ignore", rasterio.errors.NotGeoreferencedWarning)
SQUARE = {"type": "Polygon", "coordinates": [[(0, 0), (1, 0), (1, 1), (0, 1), (0, 0)]]}
print(f"rasterio {rasterio.__version__}, GDAL {rasterio.__gdal_version__}, numpy {np.__version__}")
seen = {}
with warnings.catch_warnings(record=True) as caught:
    warnings.simplefilter("always")
    warnings.simplefilter("ignore", rasterio.errors.NotGeoreferencedWarning)
    for value in (300, -5, 1.7):
        burnt = int(rasterize([(SQUARE, value)], out_shape=(1, 1), dtype="uint8")[0, 0])
        with rasterio.open("cell.tif", "w", driver="GTiff", width=1, height=1, count=1, dtype="uint8") as cell:
            cell.write(np.array([[value]]), 1)
        with rasterio.open("cell.tif") as cell:
            seen[value] = burnt, int(cell.read(1)[0, 0])
        print(f"{value} as uint8: rasterize {seen[value][0]}, write {seen[value][1]}")
print("warnings:", len(caught))
sys.exit((seen, len(caught)) != ({300: (255, 44), -5: (0, 251), 1.7: (2, 1)}, 0))
PYTHON
cd "$scratch"
venv/bin/python show.py
