#!/usr/bin/env bash
# SPDX-License-Identifier: Apache-2.0
# Not every error of rasterio is a `RasterioError`: a WarpedVRT of a photo without georeference, and `transform_bounds`
# to degrees with `densify_pts=0` (which rasterio's own check lets through), raise a `CPLE_AppDefinedError` of a private
# module, whose parents are `Exception` and no class of `rasterio.errors`. `except RasterioError` misses them. Guessed:
# caught. Seen with rasterio 1.4.4 (GDAL 3.10.3).
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
from rasterio import errors
from rasterio.vrt import WarpedVRT
from rasterio.warp import transform_bounds

warnings.simplefilter("ignore", errors.NotGeoreferencedWarning)
with rasterio.open("photo.tif", "w", driver="GTiff", width=8, height=8, count=1, dtype="uint8") as photo:
    photo.write(np.ones((8, 8), np.uint8), 1)


def warped():
    with rasterio.open("photo.tif") as photo, WarpedVRT(photo, src_crs="EPSG:32632", crs="EPSG:4326"):
        pass


def bounds():
    transform_bounds("EPSG:32632", "EPSG:4326", 600_000, 5_400_000, 600_100, 5_400_100, densify_pts=0)


print(f"rasterio {rasterio.__version__}, GDAL {rasterio.__gdal_version__}")
print("the error's class, whether one of rasterio.errors, whether a ValueError or RuntimeError:")
family = tuple(each for each in vars(errors).values() if isinstance(each, type) and each.__module__ == errors.__name__)
seen = []
for name, call in {"WarpedVRT of a photo": warped, "transform_bounds, densify_pts=0": bounds}.items():
    try:
        call()
        seen.append(None)
    except Exception as error:
        seen.append((type(error).__name__, isinstance(error, family), isinstance(error, (ValueError, RuntimeError))))
    print(f"{name}: {seen[-1]}")
sys.exit(seen != [("CPLE_AppDefinedError", False, False)] * 2)
PYTHON
cd "$scratch"
venv/bin/python show.py
