# SPDX-License-Identifier: Apache-2.0
"""Views of embedded towns as a perfect detector would see them, for every perturbation."""

from collections.abc import Sequence

import numpy as np
import pytest

from sasgeo_bench.geometry.pose import Pose
from sasgeo_bench.regions.evidence import UNKNOWN, Evidence, LayerBits, observe
from sasgeo_bench.regions.region_files import read_region

TOWNS = ("town-suburb", "town-riverside", "town-industrial")
VIEWS_PER_TOWN = 4
SIZE_CELLS = 192


@pytest.fixture(scope="session")
def views(lay_towns, tmp_path_factory) -> Sequence[Evidence]:
    """Views of 192 m at 1 m cells, of any heading, wholly within their town."""
    rng, found = np.random.default_rng(7), []
    out = lay_towns(tmp_path_factory.mktemp("towns"), *TOWNS)
    for town in TOWNS:
        region = read_region(out / "regions" / town)
        bits, grid = LayerBits.of(region.layers), region.grid
        west_m, south_m, east_m, north_m = grid.bounds_m
        wanted = len(found) + VIEWS_PER_TOWN
        while len(found) < wanted:
            pose = Pose(
                easting_m=rng.uniform(west_m, east_m),
                northing_m=rng.uniform(south_m, north_m),
                yaw_deg=rng.uniform(0, 360),
            )
            cells = observe(bits, grid, pose, size_cells=SIZE_CELLS, cell_size_m=1.0)
            if not (cells == UNKNOWN).any():
                found.append(Evidence(classes=region.classes, cells=cells, cell_size_m=1.0))
    return tuple(found)


@pytest.fixture(scope="session")
def view(views) -> Evidence:
    """One by the river, with what towns have little of drawn in: paths and hedges through green and fields, parking."""
    scene, cells = views[VIEWS_PER_TOWN], views[VIEWS_PER_TOWN].cells.copy()
    at = {name: cells[index] for index, name in enumerate(scene.classes)}
    at["green"][100:170, 20:90] = at["farmland"][20:90, 100:180] = at["parking"][150:175, 120:160] = 1
    at["water"][10:60, 10:60] = 1
    for row in range(20, 180, 30):
        at["path_track"][row : row + 2] = at["field_boundary"][row + 10] = at["waterway"][row + 20] = 1
    return scene.replace(cells)


@pytest.fixture(scope="session")
def half_known(view) -> Evidence:
    """The same with a quarter unknown, for all classes, and another strip for roads alone, and with a confidence."""
    cells = view.cells.copy()
    cells[:, :96, :96] = UNKNOWN
    cells[:3, 100:120] = UNKNOWN
    return view.replace(cells, (np.indices(cells.shape).sum(axis=0) % 256).astype(np.uint8))
