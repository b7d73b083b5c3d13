#!/usr/bin/env bash
# SPDX-License-Identifier: Apache-2.0
# Pillow counts the overviews of an aerial TIFF as frames: `n_frames` is 3 for one picture with two overviews, and
# whoever goes through the frames gets it three times, each smaller. If the file has a mask of its own inside,
# `n_frames` raises a SyntaxError, though the picture opens and loads. Guessed: one frame, since the tags say which is
# reduced and which a mask. Seen with Pillow 13.0.0, files of rasterio 1.4.4 (GDAL 3.10.3).
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
from PIL import Image, ImageSequence

warnings.simplefilter("ignore")  # no georeference is needed
about = {"driver": "GTiff", "width": 256, "height": 256, "count": 3, "dtype": "uint8", "photometric": "RGB"}
for name in ("overviews.tif", "mask.tif"):
    with rasterio.Env(GDAL_TIFF_INTERNAL_MASK=True), rasterio.open(name, "w", **about) as file:
        file.write(np.full((3, 256, 256), 9, np.uint8))
        if name == "mask.tif":
            file.write_mask(np.eye(256, dtype=np.uint8) * 255)
with rasterio.open("overviews.tif", "r+") as file:
    file.build_overviews([2, 4])
with Image.open("overviews.tif") as file:
    frames, sizes = file.n_frames, [frame.size for frame in ImageSequence.Iterator(file)]
with Image.open("mask.tif") as file:
    file.load()
    try:
        raised = file.n_frames
    except SyntaxError as error:
        raised = f"SyntaxError: {error}"
print(f"Pillow {PIL.__version__}, rasterio {rasterio.__version__}, GDAL {rasterio.__gdal_version__}")
print(f"a picture with two overviews: {frames} frames, {sizes}")
print(f"a picture with a mask inside, n_frames: {raised}")
sys.exit((frames, sizes[1:], str(raised)[:11]) != (3, [(128, 128), (64, 64)], "SyntaxError"))
PYTHON
cd "$scratch"
venv/bin/python show.py
