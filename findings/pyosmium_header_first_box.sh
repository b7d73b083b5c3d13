#!/usr/bin/env bash
# SPDX-License-Identifier: Apache-2.0
# pyosmium gives the first of several bounding boxes of a file's header: `header().box()` is the first of the file's
# `<bounds>`, though the header object holds them all (written to XML again, both are there; written to PBF, one box
# around both). Editors that download more than one area save such files: whoever takes the box as what the file covers
# loses the rest without a word, and there is no call for the others. Guessed: the box around all. Seen with pyosmium
# 4.3.2.
set -euo pipefail
scratch=$(mktemp -d)
trap 'rm -rf "$scratch"' EXIT
python3 -m venv "$scratch/venv"
"$scratch/venv/bin/pip" install --quiet --disable-pip-version-check osmium==4.3.2
cat > "$scratch/show.py" <<'PYTHON'
import sys
from importlib.metadata import version
from pathlib import Path

import osmium

BOXES = '<bounds minlon="1" minlat="1" maxlon="2" maxlat="2"/><bounds minlon="10" minlat="10" maxlon="12" maxlat="12"/>'
NODES = '<node id="1" version="1" lon="1.5" lat="1.5"/><node id="2" version="1" lon="11" lat="11"/>'
Path("two.osm").write_text(f'<osm version="0.6">{BOXES}{NODES}</osm>')


def box(path):
    with osmium.io.Reader(path) as reader:
        return str(reader.header().box())


def again(path):
    with osmium.io.Reader("two.osm") as reader, osmium.SimpleWriter(path, header=reader.header()) as writer:
        for item in osmium.FileProcessor("two.osm"):
            writer.add(item)


again("again.osm")
again("again.osm.pbf")
first, both = "(1.0000000/1.0000000 2.0000000/2.0000000)", "(1.0000000/1.0000000 12.0000000/12.0000000)"
kept = Path("again.osm").read_text().count("<bounds ")
print("pyosmium", version("osmium"))
print("box of a file with two <bounds>:", box("two.osm"))
print("written again as XML:", kept, "<bounds>; as PBF:", box("again.osm.pbf"))
others = [name for name in dir(osmium.io.Header) if "box" in name]
print("calls of the header about boxes:", others)
sys.exit((box("two.osm"), kept, box("again.osm.pbf"), others) != (first, 2, both, ["add_box", "box"]))
PYTHON
cd "$scratch"
venv/bin/python show.py
