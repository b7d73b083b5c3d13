#!/usr/bin/env bash
# SPDX-License-Identifier: Apache-2.0
# rasterio's WarpedVRT of a picture with alpha and nodata 255: ground beyond the picture, and ground that alpha hides,
# reads as opaque, since the nodata value fills the alpha band as well. Guessed: alpha is 0 there, as with nodata 0.
# Mend: init_dest_nodata=False. Ours: tests/regions/test_bands.py, "alpha last, white is empty too".
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install -q rasterio==1.4.4 numpy==2.4.6 || exit 1
cd "$folder"
venv/bin/python - <<'PY'
import numpy as np
import rasterio
from rasterio.enums import ColorInterp as Is
from rasterio.transform import Affine
from rasterio.vrt import WarpedVRT

there = Affine(1, 0, 600_000, 0, -1, 5_400_000)
seen = {}
for nodata in (0, 255):
    about = {"driver": "GTiff", "width": 8, "height": 8, "count": 4, "dtype": "uint8", "crs": "EPSG:32632"}
    with rasterio.open("a.tif", "w", transform=there, nodata=nodata, **about) as file:
        file.colorinterp = (Is.red, Is.green, Is.blue, Is.alpha)
        bands = np.full((4, 8, 8), 90, np.uint8)
        bands[3] = 255
        bands[3, :, :4] = 0  # the left half is hidden
        file.write(bands)
    for init in (True, False):
        with (
            rasterio.open("a.tif") as file,
            WarpedVRT(file, crs=file.crs, transform=there, width=12, height=8, init_dest_nodata=init) as view,
        ):
            hidden, shown, _, beyond = view.read(4)[4, [1, 5, 7, 10]].tolist()
        seen[nodata, init] = (hidden, shown, beyond)
print("rasterio", rasterio.__version__, "GDAL", rasterio.__gdal_version__)
print("alpha where hidden, shown, beyond the picture, by (nodata, init_dest_nodata):", seen)
raise SystemExit(
    seen != {(0, True): (0, 255, 0), (0, False): (0, 255, 0), (255, True): (255, 255, 255), (255, False): (0, 255, 0)}
)
PY
