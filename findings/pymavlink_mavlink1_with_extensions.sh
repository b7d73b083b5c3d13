#!/usr/bin/env bash
# SPDX-License-Identifier: Apache-2.0
# pymavlink asked for MAVLink 1 of a message with extension fields (`force_mavlink1=True`) writes them all: GPS_RAW_INT
# has 52 bytes where MAVLink 1 has 30, "extension fields are not sent when a message is encoded using the MAVLink 1
# protocol" (mavlink.io, serialization). A reader that checks the length of MAVLink 1 rejects it. Guessed: 30 bytes.
# Seen with pymavlink 2.4.50.
set -euo pipefail
scratch=$(mktemp -d)
trap 'rm -rf "$scratch"' EXIT
python3 -m venv "$scratch/venv"
"$scratch/venv/bin/pip" install --quiet --disable-pip-version-check pymavlink==2.4.50
cat > "$scratch/show.py" <<'PYTHON'
import sys
from importlib.metadata import version

from pymavlink.dialects.v10 import common as first
from pymavlink.dialects.v20 import common as second

fields = (1, 3, 471400000, 95200000, 480000, 80, 90, 800, 4500, 9)
plain = first.MAVLink_gps_raw_int_message(*fields).pack(first.MAVLink(None))
more = second.MAVLink_gps_raw_int_message(*fields, 527000, 1250, 0, 0, 0, 0)
forced = more.pack(second.MAVLink(None), force_mavlink1=True)
print(f"pymavlink {version('pymavlink')}: magic {forced[0]:#x}, {forced[1]} bytes; MAVLink 1 has {plain[1]}")
sys.exit(not (forced[0] == 0xFE and forced[1] == 52 and plain[1] == 30))
PYTHON
"$scratch/venv/bin/python" "$scratch/show.py"
