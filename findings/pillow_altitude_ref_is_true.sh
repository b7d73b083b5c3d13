#!/usr/bin/env bash
# SPDX-License-Identifier: Apache-2.0
# Pillow gives the EXIF tag for "above sea level" as `b"\x00"`, which is true in Python: `-height if gps[5] else height`
# turns every photo's height upside down, and `gps[5] == 1` never holds below the sea. It takes the int 0 for writing,
# and piexif reads the int 0 from the same file. Guessed: the int that was written. Seen with Pillow 13.0.0, piexif
# 1.1.3.
set -euo pipefail
scratch=$(mktemp -d)
trap 'rm -rf "$scratch"' EXIT
python3 -m venv "$scratch/venv"
"$scratch/venv/bin/pip" install --quiet --disable-pip-version-check pillow==13.0.0 piexif==1.1.3
cat > "$scratch/show.py" <<'PYTHON'
import sys

import piexif
import PIL
from PIL import Image

GPS, REF, HEIGHT = 0x8825, 5, 6
print(f"Pillow {PIL.__version__}, piexif {piexif.VERSION}")
seen = []
for name, ref in (("above", 0), ("below", 1)):
    exif = Image.Exif()
    exif[GPS] = {REF: ref, HEIGHT: 100.0}
    Image.new("RGB", (16, 16)).save("photo.jpg", exif=exif)
    with Image.open("photo.jpg") as photo:
        mine = photo.getexif().get_ifd(GPS)[REF]
    other = piexif.load("photo.jpg")["GPS"][REF]
    seen.append((mine, bool(mine), other))
    print(f"{name} the sea, written as {ref}: Pillow reads {mine!r}, as a condition {bool(mine)}; piexif reads {other!r}")
sys.exit(seen != [(b"\x00", True, 0), (b"\x01", True, 1)])
PYTHON
cd "$scratch"
venv/bin/python show.py
