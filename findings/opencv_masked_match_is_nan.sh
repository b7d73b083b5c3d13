#!/usr/bin/env bash
# SPDX-License-Identifier: Apache-2.0
# OpenCV's matchTemplate with a mask (the corners of a turned view left out) is nan or infinite where the map is flat
# below it, for all three normed methods; minMaxLoc, the usual next line, then hands out another place than the best,
# with a score of 0.00 where the true place has 1.00. Open ground of a map of classes is flat. Without a mask all is finite
# and the place is right; with one, so are TM_CCOEFF and TM_SQDIFF. Guessed: 0 on flat ground, as without a mask. Seen
# with opencv-python-headless 4.14.0.94 and 5.0.0.93.
set -euo pipefail
scratch=$(mktemp -d)
trap 'rm -rf "$scratch"' EXIT
python3 -m venv "$scratch/venv"
"$scratch/venv/bin/pip" install --quiet --disable-pip-version-check opencv-python-headless==4.14.0.94 numpy==2.4.6
cat > "$scratch/show.py" <<'PYTHON'
import sys

import cv2
import numpy as np

SIDE, X, Y = 40, 100, 90
rng = np.random.default_rng(1)
classes = np.zeros((200, 200), np.uint8)  # open ground
for _ in range(12):
    left, top = rng.integers(70, 170, 2)
    width, height = rng.integers(6, 18, 2)
    classes[top : top + height, left : left + width] = 200  # a building
view = classes[Y : Y + SIDE, X : X + SIDE].copy()
mask = np.zeros_like(view)
cv2.circle(mask, (SIDE // 2, SIDE // 2), SIDE // 2 - 1, 255, -1)
print("OpenCV", cv2.__version__)
right = {}
for name in ("TM_CCOEFF_NORMED", "TM_CCORR_NORMED", "TM_SQDIFF_NORMED", "TM_CCOEFF", "TM_SQDIFF"):
    for how, given in (("plain", None), ("mask", mask)):
        scores = cv2.matchTemplate(classes, view, getattr(cv2, name), mask=given)
        low, high, low_at, high_at = cv2.minMaxLoc(scores)
        best, at = (low, low_at) if "SQDIFF" in name else (high, high_at)
        right[name, how] = tuple(at) == (X, Y)
        odd = int((~np.isfinite(scores)).sum())
        print(f"{name} {how}: best {best:.2f} at {tuple(at)}, at {(X, Y)} {scores[Y, X]:.2f}; not finite: {odd}")
wrong = {key for key, is_right in right.items() if not is_right}
sys.exit(wrong != {(name, how) for name, how in right if "NORMED" in name and how == "mask"})
PYTHON
cd "$scratch"
venv/bin/python show.py
