# SPDX-License-Identifier: Apache-2.0
"""The page of natural twins: .venv/bin/python docs/figures/natural_twins.py --out out.

`build-region --every` built the regions before. Pairs are mined once for each region, into OUT/natural-twins, so that a
run goes on where it was cut off. Forty pairs of train places are drawn and asked; answers stay in OUT/answers.
"""

import argparse
import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from functools import cache
from pathlib import Path
from typing import Final

import cv2
import numpy as np
import pandas as pd
import scipy
from numpy.typing import NDArray

from sasgeo_bench.core.errors import ConfigError
from sasgeo_bench.geometry.pose import Pose
from sasgeo_bench.regions.region import ATTRIBUTION
from sasgeo_bench.regions.region_spec import list_region_files, read_region_file
from sasgeo_bench.tasks.build import read_scene
from sasgeo_bench.tasks.split import Place, Split, find_split_file, make_split, read_split_file
from sasgeo_bench.tasks.state import DRAWN_CLASSES, State
from sasgeo_bench.tasks.suites.base import MAIN_VIEW_CELLS, NaturalTwin, Seeds
from sasgeo_bench.tasks.suites.natural import NATURAL_TWINS, pair_of
from sasgeo_bench.tasks.suites.sites import choose_sites
from sasgeo_bench.tasks.task_plan import Request

SPLIT: Final = "world"
DOCS: Final = Path(__file__).parents[1]
MOST: Final = 1000  # more sites than any place here has


@cache
def split() -> Split:
    """Return the split, on the lattices of its regions."""
    spec = read_split_file(find_split_file(SPLIT))
    files = list_region_files()
    return make_split(spec, {name: read_region_file(files[name]).grid() for name in spec.region_ids})


def mined(region: str, out: Path) -> list[NaturalTwin]:
    """Return the pairs of a region whose places do not overlap, as the suite asks them; mine them unless it was done."""
    path = out / "natural-twins" / f"{region}.json"
    if not path.exists():
        path.parent.mkdir(parents=True, exist_ok=True)
        scratch = path.with_suffix(".part")
        scratch.write_text(json.dumps([asdict(twin) for twin in _mine(region, out)]), encoding="utf-8")
        scratch.replace(path)
    rows = json.loads(path.read_text(encoding="utf-8"))
    return [NaturalTwin(**row | {name: tuple(row[name]) for name in ("place_m", "twin_m")}) for row in rows]


def _mine(region: str, out: Path) -> list[NaturalTwin]:
    spec, suite = read_region_file(list_region_files()[region]), NATURAL_TWINS
    name = suite.card.name
    request = Request(suite=name, suite_spec=name, region=spec, split=split(), elsewhere=None, count=2, seed=0, out=out)
    scene, _ = read_scene(request, suite)
    if suite.lack(scene):
        return []
    seeds = Seeds(root=0, names=(spec.id, name, str(suite.card.version)))
    try:
        sites = choose_sites(scene, suite, count=MOST, seeds=seeds, group=suite.card.group, may_be_fewer=True)
    except ConfigError:  # none in a block
        return []
    return [pair_of(scene, site) for site in sites]


def main() -> None:
    """Mine."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, required=True)
    out = parser.parse_args().out
    for place in split().spec.place:
        if not place.sealed:
            for region in place.region_ids:
                print(region, len(mined(region, out)), flush=True)


if __name__ == "__main__":
    main()
