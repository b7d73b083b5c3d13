#!/usr/bin/env bash
# SPDX-License-Identifier: Apache-2.0
# rasterio, writing four bands of 8 bits as GeoTIFF without saying what they are, makes the fourth alpha: near infrared
# of an aerial picture turns to opacity, and water, which is dark there, is masked when it is read. The same with 16
# bits has no alpha, nor have three bands and two. `photometric="RGB", alpha="no"` mends it. Guessed: four plain bands.
# Seen with rasterio 1.4.4 (GDAL 3.10.3).
set -euo pipefail
scratch=$(mktemp -d)
trap 'rm -rf "$scratch"' EXIT
python3 -m venv "$scratch/venv"
"$scratch/venv/bin/pip" install --quiet --disable-pip-version-check rasterio==1.4.4 numpy==2.4.6
cat > "$scratch/show.py" <<'PYTHON'
import sys

import numpy as np
import rasterio


def read(bands, dtype, **options):
    about = {"driver": "GTiff", "width": 2, "height": 1, "count": bands, "dtype": dtype, "crs": "EPSG:32632"}
    cells = np.full((bands, 1, 2), 90, dtype)
    cells[-1, 0, 0] = 0  # water in the last band
    place = rasterio.Affine(1, 0, 600_000, 0, -1, 5_400_000)
    with rasterio.open("aerial.tif", "w", transform=place, **about, **options) as file:
        file.write(cells)
    with rasterio.open("aerial.tif") as file:
        return file.colorinterp[-1].name, file.read(1, masked=True).mask.any().item()


print(f"rasterio {rasterio.__version__}, GDAL {rasterio.__gdal_version__}")
seen = []
for bands, dtype, options in (
    (4, "uint8", {}),
    (4, "uint16", {}),
    (3, "uint8", {}),
    (2, "uint8", {}),
    (4, "uint8", {"photometric": "RGB", "alpha": "no"}),
):
    seen.append(read(bands, dtype, **options))
    print(f"{bands} bands of {dtype} {options or ''}: the last is {seen[-1][0]}; where it is 0, masked: {seen[-1][1]}")
masked = [each[1] for each in seen]
sys.exit((seen[0], masked) != (("alpha", True), [True, False, False, False, False]))
PYTHON
cd "$scratch"
venv/bin/python show.py
