#!/usr/bin/env bash
# SPDX-License-Identifier: Apache-2.0
# mavlogdump.py --format csv writes a field that is a list (ODOMETRY.q, the covariances) with its commas and without
# quotes, so that rows have more cells than the head, and every column behind the list is another. Guessed: one cell.
# Its --format json holds the list whole.
# Seen with pymavlink 2.4.50.
set -euo pipefail
scratch=$(mktemp -d)
trap 'rm -rf "$scratch"' EXIT
python3 -m venv "$scratch/venv"
"$scratch/venv/bin/pip" install --quiet --disable-pip-version-check pymavlink==2.4.50
cat > "$scratch/show.py" <<'PYTHON'
import csv
import subprocess
import sys
from importlib.metadata import version
from pathlib import Path

from pymavlink.dialects.v20 import common

path = Path(sys.argv[1], "a.tlog")
zeros = [0.0] * 21
one = common.MAVLink_odometry_message(1, 20, 12, 1.0, 2.0, 3.0, [1.0, 0.0, 0.0, 0.0], *[0.0] * 6, zeros, zeros, 0, 2, 0)
path.write_bytes((1_746_093_600_000_000).to_bytes(8, "big") + bytes(one.pack(common.MAVLink(None))))
tool = Path(sys.executable).with_name("mavlogdump.py")
words = [sys.executable, tool, "--format", "csv", "--types", "ODOMETRY", path]
head, row = list(csv.reader(subprocess.run(words, capture_output=True, text=True, check=True).stdout.splitlines()))
print(f"pymavlink {version('pymavlink')}: {len(head)} names in the head, {len(row)} cells in the row")
sys.exit(len(row) == len(head))
PYTHON
"$scratch/venv/bin/python" "$scratch/show.py" "$scratch"
