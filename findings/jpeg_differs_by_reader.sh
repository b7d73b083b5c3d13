#!/usr/bin/env bash
# SPDX-License-Identifier: Apache-2.0
# One JPEG, two pictures: rasterio's wheel brings IJG's libjpeg 9, Pillow's libjpeg-turbo, and where colour is stored at
# half the size (as cameras do) they enlarge it by other means: at the edge of a red roof a cell differs by 37 of 255,
# in fine noise by more than 100. With colour at full size they differ by 1 at most. A model fed by one and tested by
# the other sees other edges. Guessed: within 2 or 3, for rounding. Seen with rasterio 1.4.4 (GDAL 3.10.3), Pillow
# 13.0.0.
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
from PIL import Image, features

warnings.simplefilter("ignore")  # a photo has no georeference
roof = np.zeros((64, 64, 3), np.uint8)
roof[:, :33, 0] = 255  # red beside blue, the edge within a pair of columns
roof[:, 33:, 2] = 255
noise = np.random.default_rng(1).integers(0, 256, (64, 64, 3), np.uint8)
print(f"rasterio {rasterio.__version__}, GDAL {rasterio.__gdal_version__}, Pillow {PIL.__version__},", end=" ")
print("libjpeg-turbo", features.version("libjpeg_turbo"))
seen = {}
for name, picture in {"red roof": roof, "noise": noise}.items():
    for colour, subsampling in {"half size": 2, "full size": 0}.items():
        Image.fromarray(picture).save("photo.jpg", quality=95, subsampling=subsampling)
        with rasterio.open("photo.jpg") as file:
            mine = file.read().transpose(1, 2, 0).astype(int)
        with Image.open("photo.jpg") as file:
            other = np.asarray(file).astype(int)
        seen[name, colour] = int(np.abs(mine - other).max())
        print(f"{name}, colour at {colour}: the readers differ by up to {seen[name, colour]}")
near = max(seen[name, "full size"] for name in ("red roof", "noise"))
sys.exit(not (near <= 2 and seen["red roof", "half size"] > 20 and seen["noise", "half size"] > 60))
PYTHON
cd "$scratch"
venv/bin/python show.py
