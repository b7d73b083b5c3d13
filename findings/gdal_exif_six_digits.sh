#!/usr/bin/env bash
# SPDX-License-Identifier: Apache-2.0
# GDAL hands out a photo's EXIF numbers rounded to six digits: a place written in degrees and decimal minutes (as the
# standard shows it) is off by up to 9 cm, one in decimal degrees by up to 5.6 m, a height above 1 km by up to 5 mm. The
# rounded text is all there is of the place in the tags of the open file. Pillow gives the whole number. Guessed: as
# many digits as the rational has. Seen with GDAL 3.10.3 (rasterio 1.4.4), Pillow 13.0.0.
set -euo pipefail
scratch=$(mktemp -d)
trap 'rm -rf "$scratch"' EXIT
python3 -m venv "$scratch/venv"
"$scratch/venv/bin/pip" install --quiet --disable-pip-version-check rasterio==1.4.4 pillow==13.0.0 numpy==2.4.6
cat > "$scratch/show.py" <<'PYTHON'
import re
import sys
import warnings
from fractions import Fraction as F

import PIL
import rasterio
from PIL import Image

warnings.simplefilter("ignore")  # a photo has no georeference
GPS = 0x8825
FORMS = {
    "decimal minutes": (F(52), F(30123449, 1000000), F(0)),
    "decimal degrees": (F(52123449, 1000000), F(0), F(0)),
    "seconds": (F(52), F(7), F(12345649, 1000000)),
}


def metres(parts):  # northing, by 1852 m to the minute
    return float((parts[0] * 60 + parts[1] + parts[2] / 60) * 1852)


seen = {}
print(f"GDAL {rasterio.__gdal_version__}, rasterio {rasterio.__version__}, Pillow {PIL.__version__}")
for name, parts in FORMS.items():
    exif = Image.Exif()
    exif[GPS] = {1: "N", 2: tuple(map(float, parts))}
    Image.new("RGB", (16, 16)).save("photo.jpg", exif=exif)
    with rasterio.open("photo.jpg") as photo:
        text = photo.tags()["EXIF_GPSLatitude"]
    with Image.open("photo.jpg") as photo:
        other = [F(float(part)) for part in photo.getexif().get_ifd(GPS)[2]]
    off = [abs(metres(read) - metres(parts)) for read in ([F(part) for part in re.findall(r"[\d.]+", text)], other)]
    seen[name] = [round(each, 3) for each in off]
    print(f"{name}: GDAL {text}, off by {off[0]:.3f} m; Pillow {tuple(map(float, other))}, off by {off[1]:.3f} m")
sys.exit(seen != {"decimal minutes": [0.091, 0], "decimal degrees": [5.445, 0], "seconds": [0.002, 0]})
PYTHON
cd "$scratch"
venv/bin/python show.py
