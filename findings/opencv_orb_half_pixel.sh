#!/usr/bin/env bash
# SPDX-License-Identifier: Apache-2.0
# ORB of OpenCV: a feature of octave n is found at whole pixels of a picture that is 1.2 ** n times smaller, and its place
# is multiplied by that. Centres of pixels then miss half of (1.2 ** n - 1) pixels, to the upper left, one pixel in the
# seventh octave. Two views that are turned by 180 degrees disagree by twice that. Guessed: places of all octaves are in
# one frame. Seen with opencv-python-headless 4.12.0.88.
set -euo pipefail
scratch=$(mktemp -d)
trap 'rm -rf "$scratch"' EXIT
python3 -m venv "$scratch/venv"
"$scratch/venv/bin/pip" install --quiet --disable-pip-version-check opencv-python-headless==4.12.0.88
cat > "$scratch/show.py" <<'PYTHON'
import sys

import cv2
import numpy as np

missed = {}  # by octave, how far a feature and the same one of the turned picture are off each other, pixels
rng = np.random.default_rng(1)
for trial in range(12):
    noise = rng.uniform(0, 255, (600 + 7 * trial, 800 + 11 * trial))
    picture = cv2.normalize(cv2.GaussianBlur(noise, (0, 0), 3.0), None, 0, 255, cv2.NORM_MINMAX).astype(np.uint8)
    turned = np.ascontiguousarray(picture[::-1, ::-1])
    orb = cv2.ORB.create(nfeatures=5000, nlevels=7)
    (points, words), (others, other_words) = (orb.detectAndCompute(one, None) for one in (picture, turned))
    for match in cv2.BFMatcher(cv2.NORM_HAMMING, crossCheck=True).match(words, other_words):
        one, other = points[match.queryIdx], others[match.trainIdx]
        off = np.add(one.pt, other.pt) - (picture.shape[1] - 1, picture.shape[0] - 1)
        if one.octave == other.octave and np.abs(off).max() < 8:
            missed.setdefault(one.octave, []).append(off)
print(f"OpenCV {cv2.__version__}")
so = len(missed) == 7
for octave, off in sorted(missed.items()):
    mean, model = np.mean(off, axis=0), 1 - 1.2**octave
    print(f"octave {octave}: {mean.round(2).tolist()} pixels (means of {len(off)}); 1 - 1.2 ** {octave} = {model:.2f}")
    so = so and np.allclose(mean, model, atol=0.3)
sys.exit(not so)
PYTHON
cd "$scratch"
venv/bin/python show.py
