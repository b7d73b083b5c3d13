#!/usr/bin/env bash
# SPDX-License-Identifier: Apache-2.0
# Pillow on 16 bits: a colour TIFF comes as 8 bits by leaving off the low byte, without a word, so that a 12-bit aerial
# picture (0 to 4095) is 0 to 15, nearly black; a grey one keeps 16 bits, and `convert("L")` makes all above 255 white.
# rasterio reads both as they are. Guessed: both scaled, or an error. Seen with Pillow 13.0.0, rasterio 1.4.4.
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

warnings.simplefilter("ignore")  # no georeference is needed
values = np.array([100, 255, 256, 2000, 4095], np.uint16)
print(f"Pillow {PIL.__version__}, rasterio {rasterio.__version__}")
seen = {}
for name, bands in (("colour", 3), ("grey", 1)):
    about = {"driver": "GTiff", "width": 5, "height": 1, "count": bands, "dtype": "uint16"}
    with rasterio.open(f"{name}.tif", "w", photometric="RGB" if bands == 3 else "MINISBLACK", **about) as file:
        file.write(np.tile(values, (bands, 1, 1)))
    with rasterio.open(f"{name}.tif") as file:
        kept = file.read(1)[0].tolist()
    with Image.open(f"{name}.tif") as file:
        eight = file if file.mode == "RGB" else file.convert("L")
        seen[name] = kept, file.mode, np.asarray(eight).reshape(5, -1)[:, 0].tolist()
    print(f"{name}: rasterio {kept}; Pillow opens mode {file.mode}, in 8 bits {seen[name][2]}")
kept = values.tolist()
sys.exit(seen != {"colour": (kept, "RGB", [0, 0, 1, 7, 15]), "grey": (kept, "I;16", [100, 255, 255, 255, 255])})
PYTHON
cd "$scratch"
venv/bin/python show.py
