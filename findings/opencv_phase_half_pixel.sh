#!/usr/bin/env bash
# SPDX-License-Identifier: Apache-2.0
# OpenCV's phaseCorrelate finds two equal pictures half a pixel apart wherever the size it pads them to is odd: sides of
# 125, 129 to 135, 217 to 225 pixels and others. The answer of every pair of that size is off by as much, with a response
# of 1. Guessed: 0, 0, as at 128 pixels. Seen with opencv-python-headless 4.14.0.94 and 5.0.0.93.
set -euo pipefail
scratch=$(mktemp -d)
trap 'rm -rf "$scratch"' EXIT
python3 -m venv "$scratch/venv"
"$scratch/venv/bin/pip" install --quiet --disable-pip-version-check opencv-python-headless==4.14.0.94 numpy==2.4.6
cat > "$scratch/show.py" <<'PYTHON'
import sys

import cv2
import numpy as np

picture = np.random.default_rng(1).random((300, 300))
print("OpenCV", cv2.__version__)
seen = []
for side in (124, 125, 128, 131, 225):
    here = np.ascontiguousarray(picture[:side, :side])
    (x, y), response = cv2.phaseCorrelate(here, here)
    seen.append((round(x, 3) + 0.0, round(y, 3) + 0.0))
    padded = cv2.getOptimalDFTSize(side)
    print(f"{side} pixels, padded to {padded}: a picture and itself differ by {seen[-1]}, response {response:.2f}")
moved, _ = cv2.phaseCorrelate(picture[:125, :125].copy(), np.roll(picture[:125, :125], (3, -5), (0, 1)))
print(f"125 pixels, moved by (-5, 3): {tuple(round(value, 3) for value in moved)}")
half = (0.5, 0.5)
sys.exit((seen, tuple(round(value, 3) for value in moved)) != ([half, half, (0.0, 0.0), half, half], (-4.5, 3.5)))
PYTHON
cd "$scratch"
venv/bin/python show.py
