#!/usr/bin/env bash
# SPDX-License-Identifier: Apache-2.0
# A ULog that was cut off within a message (battery out, card full) is read by pyulog up to there without a word: no
# exception, nothing printed, and `file_corruption` is False, as of a whole file. Whoever asks it takes half a flight for
# a flight. Guessed: True. Seen with pyulog 1.3.0.
set -euo pipefail
scratch=$(mktemp -d)
trap 'rm -rf "$scratch"' EXIT
python3 -m venv "$scratch/venv"
"$scratch/venv/bin/pip" install --quiet --disable-pip-version-check pyulog==1.3.0
cat > "$scratch/show.py" <<'PYTHON'
import io
import struct
import sys
from importlib.metadata import version

from pyulog import ULog


def message(kind: str, data: bytes) -> bytes:
    return struct.pack("<HB", len(data), ord(kind)) + data


whole = b"ULog\x01\x12\x35\x01" + bytes(8) + message("B", bytes(40))
whole += message("F", b"height:uint64_t timestamp;float m;") + message("A", struct.pack("<BH", 0, 0) + b"height")
whole += b"".join(message("D", struct.pack("<HQf", 0, at * 1000, 1.0)) for at in range(100))
logs = {"whole": ULog(io.BytesIO(whole)), "cut": ULog(io.BytesIO(whole[:-700]))}
print("pyulog", version("pyulog"))
for name, log in logs.items():
    print(f"{name}: {len(log.data_list[0].data['timestamp'])} rows, corruption: {log.file_corruption}")
rows = [len(log.data_list[0].data["timestamp"]) for log in logs.values()]
sys.exit(not (rows == [100, 58] and not any(log.file_corruption for log in logs.values())))
PYTHON
"$scratch/venv/bin/python" "$scratch/show.py"
