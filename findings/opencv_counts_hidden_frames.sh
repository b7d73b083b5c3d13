#!/usr/bin/env bash
# SPDX-License-Identifier: Apache-2.0
# An MP4 that was trimmed without decoding (ffmpeg -ss -c copy, a telephone's editor) keeps the frames before the cut and
# hides them by an edit list. OpenCV decodes the others alone and counts their times from 0, but CAP_PROP_FRAME_COUNT
# counts the hidden ones too, so that frames / rate is longer than the video. Guessed: it counts what it decodes. Seen
# with opencv-python-headless 4.14.0.94 and 4.10.0.84.
set -euo pipefail
scratch=$(mktemp -d)
trap 'rm -rf "$scratch"' EXIT
python3 -m venv "$scratch/venv"
"$scratch/venv/bin/pip" install --quiet --disable-pip-version-check opencv-python-headless==4.14.0.94 numpy==2.4.6
cat > "$scratch/show.py" <<'PYTHON'
import struct
import sys
from pathlib import Path

import cv2
import numpy as np

FRAMES, RATE, HIDDEN = 40, 10.0, 10
path = Path("trimmed.mp4").absolute()
writer = cv2.VideoWriter(str(path), cv2.CAP_FFMPEG, cv2.VideoWriter.fourcc(*"mp4v"), RATE, (96, 64))
for at in range(FRAMES):
    writer.write(np.full((64, 96, 3), 6 * at + 12, np.uint8))
writer.release()
data = bytearray(path.read_bytes())
scale = struct.unpack(">I", data[data.index(b"mdhd") + 16 :][:4])[0]  # of the track, units of a second
edits = data.index(b"elst") + 12  # length in units of the film, then the first time shown in those of the track
length = struct.unpack(">I", data[edits : edits + 4])[0]
data[edits : edits + 8] = struct.pack(">II", length * (FRAMES - HIDDEN) // FRAMES, int(scale * HIDDEN / RATE))
path.write_bytes(data)
video = cv2.VideoCapture(str(path), cv2.CAP_FFMPEG)
counted, seen = int(video.get(cv2.CAP_PROP_FRAME_COUNT)), []
while video.grab():
    milliseconds = video.get(cv2.CAP_PROP_POS_MSEC)
    seen.append((round(milliseconds), round((video.retrieve()[1].mean() - 11) / 6)))
print(f"OpenCV {cv2.__version__}: counts {counted} frames, decodes {len(seen)}")
print(f"first: frame {seen[0][1]} of those written, at {seen[0][0]} ms")
sys.exit((counted, len(seen), seen[0]) != (FRAMES, FRAMES - HIDDEN, (0, HIDDEN)))
PYTHON
cd "$scratch"
venv/bin/python show.py
