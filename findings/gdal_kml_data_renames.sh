#!/usr/bin/env bash
# SPDX-License-Identifier: Apache-2.0
# GDAL's LIBKML driver lets a placemark's `<Data name="name">` overwrite the placemark's own `<name>`, and one called
# "description" its description: the drone's file says `DJI_0042`, the feature is called `Hasselblad`. Typed data of a
# `<Schema>` go to a column of their own, `name2`. Guessed: the same for both. Seen with GDAL 3.12.4 (pyogrio 0.13.0).
set -euo pipefail
scratch=$(mktemp -d)
trap 'rm -rf "$scratch"' EXIT
python3 -m venv "$scratch/venv"
"$scratch/venv/bin/pip" install --quiet --disable-pip-version-check pyogrio==0.13.0 numpy==2.4.6
cat > "$scratch/show.py" <<'PYTHON'
import sys
from pathlib import Path

import pyogrio
import pyogrio.raw

UNTYPED = '<Data name="name"><value>Hasselblad</value></Data><Data name="description"><value>L1D</value></Data>'
TYPED = '<SchemaData schemaUrl="#s"><SimpleData name="name">Hasselblad</SimpleData></SchemaData>'
SCHEMA = '<Schema name="s" id="s"><SimpleField type="string" name="name"/></Schema>'


def read(head, data):
    own = "<name>DJI_0042</name><description>over the weir</description>"
    point = "<Point><coordinates>10,50</coordinates></Point>"
    body = f"{head}<Placemark>{own}<ExtendedData>{data}</ExtendedData>{point}</Placemark>"
    Path("photo.kml").write_text(f'<kml xmlns="http://www.opengis.net/kml/2.2"><Document>{body}</Document></kml>')
    meta, _, _, columns = pyogrio.raw.read("photo.kml")
    row = dict(zip(meta["fields"], (column[0] for column in columns), strict=True))
    return {key: value for key, value in row.items() if key.lower().startswith(("name", "descr")) and value}


untyped, typed = read("", UNTYPED), read(SCHEMA, TYPED)
print(f"GDAL {'.'.join(map(str, pyogrio.__gdal_version__))}, pyogrio {pyogrio.__version__}")
print("placemark DJI_0042, over the weir; data as <Data>:", untyped)
print("the same with data of a <Schema>:", typed)
own = {"Name": "DJI_0042", "description": "over the weir"}
sys.exit((untyped, typed) != ({"Name": "Hasselblad", "description": "L1D"}, own | {"name2": "Hasselblad"}))
PYTHON
cd "$scratch"
venv/bin/python show.py
