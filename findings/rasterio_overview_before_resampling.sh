#!/usr/bin/env bash
# SPDX-License-Identifier: Apache-2.0
# rasterio's `read(out_shape=..., resampling=average)` does not average if the file has an overview of that very size:
# it hands out the overview, whatever that was made with; built with "nearest" (the default of many tools) it is every
# fourth cell. The same file without overviews gives averages. A model so sees another picture after somebody has sped
# the file up. Guessed: the method asked for holds. Seen with rasterio 1.4.4 (GDAL 3.10.3).
set -euo pipefail
scratch=$(mktemp -d)
trap 'rm -rf "$scratch"' EXIT
python3 -m venv "$scratch/venv"
"$scratch/venv/bin/pip" install --quiet --disable-pip-version-check rasterio==1.4.4 numpy==2.4.6
cat > "$scratch/show.py" <<'PYTHON'
import sys

import numpy as np
import rasterio
from rasterio.enums import Resampling

about = {"driver": "GTiff", "width": 16, "height": 16, "count": 1, "dtype": "uint8", "crs": "EPSG:32632"}
with rasterio.open("file.tif", "w", transform=rasterio.Affine(1, 0, 600_000, 0, -1, 5_400_000), **about) as file:
    file.write(np.arange(256, dtype=np.uint8).reshape(16, 16), 1)


def quarter(**options):
    with rasterio.open("file.tif", **options) as file:
        return file.read(1, out_shape=(4, 4), resampling=Resampling.average)[0].tolist()


before = quarter()
with rasterio.open("file.tif", "r+") as file:
    file.build_overviews([4], Resampling.nearest)
after, without = quarter(), quarter(overview_level="NONE")
print(f"rasterio {rasterio.__version__}, GDAL {rasterio.__gdal_version__}; first row of a quarter of the size, by average")
print("without overviews:", before)
print("with an overview of that size:", after)
print("with it, opened so that it is not used:", without)
sys.exit((before, after, without) != ([26, 30, 34, 38], [0, 4, 8, 12], [26, 30, 34, 38]))
PYTHON
cd "$scratch"
venv/bin/python show.py
