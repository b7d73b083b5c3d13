#!/usr/bin/env bash
# SPDX-License-Identifier: Apache-2.0
# One TIFF of labels, two answers: Pillow turns a mask round whose white is the low value, where rasterio gives the
# numbers stored; it makes 17 of label 1 if labels have 4 bits, as if they were grey; from 32 bits without sign all
# above 2147483647 come out negative, and from 8 bits with sign all below zero come out large. No warning in any.
# Guessed: the stored numbers. Seen with Pillow 13.0.0, rasterio 1.4.4 (GDAL 3.10.3).
set -euo pipefail
scratch=$(mktemp -d)
trap 'rm -rf "$scratch"' EXIT
python3 -m venv "$scratch/venv"
"$scratch/venv/bin/pip" install --quiet --disable-pip-version-check rasterio==1.4.4 pillow==13.0.0 numpy==2.4.6
cat > "$scratch/show.py" <<'PYTHON'
import sys
import warnings

import numpy as np
import PIL
import rasterio
from PIL import Image

warnings.simplefilter("ignore", rasterio.errors.NotGeoreferencedWarning)
CASES = {
    "mask, white is the low value": ("uint8", [0, 1, 1, 0], {"photometric": "MINISWHITE", "nbits": 1}),
    "mask, white is the high value": ("uint8", [0, 1, 1, 0], {"photometric": "MINISBLACK", "nbits": 1}),
    "labels of 4 bits": ("uint8", [0, 1, 7, 15], {"nbits": 4}),
    "labels of 8 bits": ("uint8", [0, 1, 7, 15], {}),
    "labels of 32 bits without sign": ("uint32", [0, 1, 2**31, 2**32 - 1], {}),
    "labels of 8 bits with sign": ("int8", [-1, 0, 1, 7], {}),
}
print(f"Pillow {PIL.__version__}, rasterio {rasterio.__version__}, GDAL {rasterio.__gdal_version__}")
seen = []
with warnings.catch_warnings(record=True) as caught:
    warnings.simplefilter("always")
    warnings.simplefilter("ignore", rasterio.errors.NotGeoreferencedWarning)
    for name, (dtype, labels, options) in CASES.items():
        about = {"driver": "GTiff", "width": 4, "height": 1, "count": 1, "dtype": dtype}
        with rasterio.open("labels.tif", "w", **about, **options) as file:
            file.write(np.array([[labels]], dtype))
        with rasterio.open("labels.tif") as file:
            mine = file.read(1)[0].tolist()
        with Image.open("labels.tif") as file:
            other = np.asarray(file)[0].astype(int).tolist()
        seen.append(other)
        print(f"{name}: rasterio {mine}, Pillow {other}")
        if mine != labels:
            sys.exit(1)
expected = [[1, 0, 0, 1], [0, 1, 1, 0], [0, 17, 119, 255], [0, 1, 7, 15], [0, 1, -(2**31), -1], [255, 0, 1, 7]]
sys.exit((seen, len(caught)) != (expected, 0))
PYTHON
cd "$scratch"
venv/bin/python show.py
