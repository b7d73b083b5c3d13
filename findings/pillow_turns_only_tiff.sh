#!/usr/bin/env bash
# SPDX-License-Identifier: Apache-2.0
# Pillow turns a TIFF by its orientation tag when it opens it, and turns no JPEG, PNG or WebP with the same tag: one
# photo saved as each has two shapes. rasterio turns neither, so boxes drawn in one fit the other in three formats of
# four. Guessed: none is turned without `exif_transpose`. Seen with Pillow 13.0.0, rasterio 1.4.4 (GDAL 3.10.3).
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

warnings.simplefilter("ignore")  # a photo has no georeference
ORIENTATION, QUARTER_TURN = 274, 6
exif = Image.Exif()
exif[ORIENTATION] = QUARTER_TURN
print(f"Pillow {PIL.__version__}, rasterio {rasterio.__version__}, GDAL {rasterio.__gdal_version__}")
seen = {}
for ending in ("tif", "jpg", "png", "webp"):
    Image.new("RGB", (20, 10)).save(f"photo.{ending}", exif=exif)
    with Image.open(f"photo.{ending}") as photo:
        seen[ending] = [np.asarray(photo).shape[:2]]
    if ending != "webp":  # not in every build of GDAL
        with rasterio.open(f"photo.{ending}") as photo:
            seen[ending].append(photo.shape)
    print(f"{ending}, 10 rows and 20 columns, a quarter turn: Pillow, rasterio: {seen[ending]}")
lying, standing = (10, 20), (20, 10)
sys.exit(seen != {"tif": [standing, lying], "jpg": [lying] * 2, "png": [lying] * 2, "webp": [lying]})
PYTHON
cd "$scratch"
venv/bin/python show.py
