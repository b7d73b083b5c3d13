#!/usr/bin/env bash
# SPDX-License-Identifier: Apache-2.0
# mlcroissant reads a field that its Croissant file calls sc:Text as whatever the column of the CSV looks like: the
# tile "0012" is b"12", and b"0012" as soon as another row has a letter; "1e5" is b"100000.0"; a place called "NA" is
# None. Joined by that key to files or to another table, rows are missed or meet others. Guessed: the text of the file,
# since the type is stated. Seen with mlcroissant 1.1.1, pandas 3.1.1.
set -euo pipefail
scratch=$(mktemp -d)
trap 'rm -rf "$scratch"' EXIT
python3 -m venv "$scratch/venv"
"$scratch/venv/bin/pip" install --quiet --disable-pip-version-check mlcroissant==1.1.1 pandas==3.1.1
cat > "$scratch/show.py" <<'PYTHON'
import hashlib
import json
import logging
import sys
from importlib.metadata import version
from pathlib import Path

logging.disable(logging.WARNING)
import mlcroissant as mlc  # noqa: E402

ABOUT = {"name": "tiles", "description": "tiles", "url": "https://example.org", "license": "MIT", "version": "1.0.0"}


def read(tiles):
    table = "tile\n" + "".join(f"{tile}\n" for tile in tiles)
    Path("tiles.csv").write_text(table)
    sha256 = hashlib.sha256(table.encode()).hexdigest()
    names = {"id": "tiles.csv", "name": "tiles.csv"}
    file = mlc.FileObject(**names, content_url="tiles.csv", encoding_formats=["text/csv"], sha256=sha256)
    source = mlc.Source(file_object="tiles.csv", extract=mlc.Extract(column="tile"))
    field = mlc.Field(id="rows/tile", name="tile", data_types=[mlc.DataType.TEXT], source=source)
    rows = mlc.RecordSet(id="rows", name="rows", fields=[field])
    about = mlc.Metadata(**ABOUT, distribution=[file], record_sets=[rows])
    Path("croissant.json").write_text(json.dumps(about.to_json(), default=str))
    return [row["rows/tile"] for row in mlc.Dataset(jsonld="croissant.json").records("rows")]


print(f"mlcroissant {version('mlcroissant')}, pandas {version('pandas')}")
seen = []
for tiles in (["0012", "0013"], ["0012", "x13"], ["1e5", "2e5"], ["NA", "b"]):
    seen.append(read(tiles))
    print(f"{tiles}, stated to be text, are {seen[-1]}")
sys.exit(seen != [[b"12", b"13"], [b"0012", b"x13"], [b"100000.0", b"200000.0"], [None, b"b"]])
PYTHON
cd "$scratch"
venv/bin/python show.py
