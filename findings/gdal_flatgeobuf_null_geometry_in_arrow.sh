#!/usr/bin/env bash
# SPDX-License-Identifier: Apache-2.0
# GDAL reads a FlatGeobuf as a stream of Arrow whose offsets are damaged as soon as one feature has no geometry: behind
# it the column of geometries cannot be taken apart, and `validate(full=True)` says so. The same file without Arrow is
# read whole. Guessed: a feature without geometry is one empty value. Seen with pyogrio 0.13.0 (GDAL 3.12.4).
set -euo pipefail
scratch=$(mktemp -d)
trap 'rm -rf "$scratch"' EXIT
python3 -m venv "$scratch/venv"
"$scratch/venv/bin/pip" install --quiet --disable-pip-version-check pyogrio==0.13.0 geopandas==1.2.0 pyarrow==26.0.1
cat > "$scratch/show.py" <<'PYTHON'
import sys

import geopandas as gpd
import pyarrow as pa
import pyogrio
import shapely

print(f"pyogrio {pyogrio.__version__}, GDAL {pyogrio.__gdal_version_string__}, pyarrow {pa.__version__}")
places = [shapely.Point(1, 1), None, shapely.Point(3, 3)]
gpd.GeoDataFrame({"id": [1, 2, 3]}, geometry=places, crs=32632).to_file("a.fgb", SPATIAL_INDEX="NO")
_, _, geometry, _ = pyogrio.raw.read("a.fgb")
print("without Arrow:", [None if one is None else len(one) for one in geometry])
_, table = pyogrio.read_arrow("a.fgb")
try:
    table["wkb_geometry"].validate(full=True)
except pa.ArrowInvalid as error:
    print("with Arrow:", error)
    sys.exit([one is None for one in geometry] != [False, True, False])
sys.exit("with Arrow: valid")
PYTHON
cd "$scratch"
venv/bin/python show.py
