# SPDX-License-Identifier: Apache-2.0
"""Readings of the paper's decoys: one of them is the experiment, and each differs by what its name says."""

import numpy as np
import pandas as pd
import pytest
from sasgeo_baselines.global_descriptor import GlobalDescriptor
from sasgeo_paper import make_paper_task
from sasgeo_paper.decoys import (
    RANKED,
    Decoys,
    Described,
    decoys_markdown,
    describe_view,
    draw_trials,
    every_reading,
    finding_lines,
)
from sasgeo_paper.task import SUITE, VERSION, PaperDrawer
from sasgeo_paper.tiles import CLASSES, TILES
from sasgeo_paper.trials import draw_crops

from sasgeo_bench.regions import region_files
from sasgeo_bench.regions.evidence import Evidence
from sasgeo_bench.tasks.suites.base import Seeds

FEW = 8
EXPERIMENT = Decoys(chosen="counts", each_tile=49, around="anchor")


@pytest.fixture(scope="module")
def region(tmp_path_factory):
    out = tmp_path_factory.mktemp("decoys") / "out"
    make_paper_task(seed=42, out=out, trials=1)
    return region_files.read_region(out / "regions" / "paper-poc-42")


@pytest.fixture(scope="module")
def drawer(region):
    return PaperDrawer.of(region, Seeds(root=42, names=(SUITE, str(VERSION))))


@pytest.fixture(scope="module")
def described(region, drawer):
    return Described.of(region, drawer.windows)


@pytest.mark.slow
def test_one_reading_is_the_experiment_and_its_shares_rank_as_global_descriptor_does(region, drawer, described):
    found = draw_trials(drawer, described, EXPERIMENT, FEW)
    matcher = GlobalDescriptor()
    matcher.prepare(region, None)
    pairs = [drawer.draw(index) for index in range(FEW)]
    ranks = [matcher.match(query, top_k=10).poses.index(query.candidates[truth.candidate]) for query, truth in pairs]
    assert found.above[:, RANKED.index("shares")].tolist() == ranks
    assert [f"paper-poc-42/{tile}" for tile in found.tile] == [truth.block for _, truth in pairs]
    assert (found.above.std(axis=1) > 0).any()  # descriptors differ
    assert EXPERIMENT in set(every_reading())


def test_a_smaller_pool_holds_as_many_windows_of_each_tile_and_another_for_each_trial(described):
    reading = Decoys(chosen="unit", each_tile=5, around="anchor")
    first, numbers = described.pool(reading, np.random.default_rng(1))
    _, others = described.pool(reading, np.random.default_rng(2))
    assert np.bincount(first.tile).tolist() == [5] * TILES
    assert set(numbers.tolist()) != set(others.tolist())
    np.testing.assert_array_equal(first.points_m, described.windows.points_m[numbers])
    np.testing.assert_allclose(np.linalg.norm(first.counts, axis=1), 1.0)


def test_with_the_truth_as_anchor_the_others_are_the_nearest_to_it(described):
    for seed in range(20):
        crops = draw_crops(described.windows, np.random.default_rng(seed), around="truth")
        true = int(crops.windows[crops.true])
        assert true == int(np.random.default_rng(seed).integers(len(described.windows.tile)))
        assert set(crops.windows.tolist()) == set(described.windows.alike(true).tolist())


def test_rings_share_out_the_counts_of_a_window(described):
    rings = described.by["rings"].reshape(-1, len(CLASSES), 4)
    np.testing.assert_array_equal(rings.sum(axis=2), described.windows.counts)
    assert (rings.std(axis=0) > 0).all()


def test_unknown_cells_count_as_absent_in_counts_and_not_at_all_in_shares_and_rings():
    cells = np.zeros((1, 96, 96), dtype=np.uint8)
    cells[:, :, :48] = 2  # the left half is unknown
    cells[:, :, 48:72] = 1  # half of the right one is present
    found = describe_view(Evidence(classes=("water",), cells=cells, cell_size_m=1.0))
    assert found["counts"].tolist() == [96 * 24]
    assert found["shares"].tolist() == [96 * 48]
    assert found["unit"].tolist() == [1.0]
    assert found["rings"][0] == pytest.approx(np.pi * 16**2, rel=0.02)  # the innermost ring is full of water
    hidden = describe_view(Evidence(classes=("water",), cells=np.full_like(cells, 2), cell_size_m=1.0))
    assert np.isnan(hidden["shares"]).all()
    assert np.isnan(hidden["rings"]).all()


def row_of(inside, windows):
    head = {"chosen_by": "counts", "nearest_to": "anchor", "windows": windows, "ranked_by": "shares", "n": 220}
    figures = {f"{name}{end}": 0.5 for name in ("recall_1", "recall_5", "mrr") for end in ("", "_lo", "_hi")}
    return head | figures | {"inside": inside, "inside_wilson": 0}


@pytest.mark.parametrize(
    ("insides", "verdict"), [((0, 2), "None holds them"), ((3, 2), "One holds them"), ((3, 3), "is not decided")]
)
def test_what_the_table_shows_follows_from_it(insides, verdict):
    table = pd.DataFrame([row_of(inside, windows) for inside, windows in zip(insides, (30, 60), strict=True)])
    held = insides.count(3)
    lines = list(finding_lines(table))
    assert lines[0].startswith(f"- Intervals by tiles: {held} of 2 readings hold all three")
    assert ("30 windows" in lines[0]) == (insides[0] == 3)
    assert verdict in lines[2]
    assert "| counts | anchor | 60 | shares | 0.500 [0.500, 0.500] |" in decoys_markdown(table)
