# SPDX-License-Identifier: Apache-2.0
"""The score by FFT is the score cell by cell; the score of a pose is the score of what is seen from it."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from sasgeo_bench.geometry.pose import Pose
from sasgeo_bench.regions.evidence import ABSENT, PRESENT, UNKNOWN, LayerBits, observe
from sasgeo_bench.search.parts import Parts
from sasgeo_bench.search.view import Chart, Patch, View, fade
from sasgeo_bench.search.vote_search import ByPlanes, ByRows, VoteGains, make_template

POSITIVE = arrays(np.float64, 3, elements=st.floats(0, 10))
GAINS = st.builds(VoteGains, agree=POSITIVE, extra=POSITIVE, missed=POSITIVE)


def score_cells(seen: np.ndarray, mapped: np.ndarray, gains: VoteGains) -> float:
    """Eq. (8) cell by cell over the number of cells known on both sides; 0 where nothing is known."""
    losses = ((gains.agree, PRESENT, PRESENT), (-gains.extra, PRESENT, ABSENT), (-gains.missed, ABSENT, PRESENT))
    total = sum(gain @ ((seen == view) & (mapped == under)).sum(axis=(1, 2)) for gain, view, under in losses)
    known = int(((seen != UNKNOWN) & (mapped != UNKNOWN)).sum())
    return float(total / known) if known else 0.0


@pytest.mark.parametrize(
    "votes",
    [ByRows(places=4, high=5), *(ByPlanes(parts=Parts(places=(4, 4), high=5, count=count)) for count in (1, 2, 3))],
)
@given(
    seen=arrays(np.uint8, (2, 3, 5, 5), elements=st.integers(0, 2)),
    mapped=arrays(np.uint8, (2, 3, 8, 8), elements=st.integers(0, 1)),
    unknown=arrays(np.bool_, (2, 8, 8)),
    gains=GAINS,
)
def test_templates_and_windows_together_vote_as_each_pair_does(votes, seen, mapped, unknown, gains) -> None:
    known = ~unknown[:, None]
    layers = np.concatenate((mapped * known, known), axis=1).astype(np.float32)
    templates = np.stack([make_template(view, gains) for view in seen]).astype(np.float32)
    total, counted = votes.votes(votes.window(layers), votes.templates(templates))
    for view, square in np.ndindex(2, 2):
        cells = np.where(unknown[square], UNKNOWN, mapped[square]).astype(np.uint8)
        windows = np.lib.stride_tricks.sliding_window_view(cells, (5, 5), axis=(1, 2))
        expected = [[score_cells(seen[view], windows[:, row, col], gains) for col in range(4)] for row in range(4)]
        found = np.where(counted[view, square] > 0.5, total[view, square] / np.maximum(counted[view, square], 1.0), 0.0)
        np.testing.assert_allclose(found, expected, rtol=1e-4, atol=1e-4)


def test_a_view_of_two_cells_scores_as_worked_by_hand() -> None:
    # Seen: present, absent. Map: absent, present, present, unknown.
    seen, mapped = np.array([[[1, 0]]], dtype=np.uint8), np.array([[[0, 1, 1, 2]]], dtype=np.uint8)
    gains = VoteGains(agree=np.array([4.0]), extra=np.array([2.0]), missed=np.array([1.0]))
    found = [score_cells(seen, mapped[..., at : at + 2], gains) for at in range(3)]
    assert found == [(-2 - 1) / 2, (4 - 1) / 2, 4.0]


@given(
    east_m=st.floats(-220, 220),
    north_m=st.floats(-220, 220),
    yaw_deg=st.floats(0, 359),
    scale=st.floats(0.9, 1.1),
    seed=st.integers(0, 9),
)
def test_a_pose_scores_as_what_is_seen_from_it(made, east_m, north_m, yaw_deg, scale, seed) -> None:
    region = made.region_of(made.textured(1))
    chart = Chart.of(region)
    pose = Pose(easting_m=1210.0 + east_m, northing_m=8790.0 + north_m, yaw_deg=yaw_deg, scale=scale)
    rng = np.random.default_rng(seed)
    evidence = made.view_of(region, Pose(easting_m=1200.0, northing_m=8800.0, yaw_deg=10.0), size_cells=32)
    cells = np.where(rng.random(evidence.cells.shape) < 0.2, UNKNOWN, evidence.cells).astype(np.uint8)
    gains = VoteGains(agree=rng.random(3), extra=rng.random(3), missed=rng.random(3))
    view = View.of(evidence, make_template(cells, gains), np.arange(3))
    patch = Patch.around(chart, view.bands, (pose.easting_m, pose.northing_m), view.reach_m * 1.2)
    under = observe(LayerBits.of(region.layers), region.grid, pose, size_cells=32, cell_size_m=1.0)
    expected = score_cells(cells, under, gains)
    found = patch.score(view.samples(view.template, stride=1), pose, least_overlap=0.0)
    if (under == UNKNOWN).all():
        assert found == -np.inf
    else:
        assert found == pytest.approx(expected, rel=1e-4, abs=1e-5)


@given(cells=arrays(np.uint8, (3, 4, 4), elements=st.integers(0, 2)), gains=GAINS)
def test_probabilities_vote_as_the_mean_of_states_that_are_drawn_with_them(cells, gains) -> None:
    quarter = np.where(cells == UNKNOWN, np.nan, 0.25)
    seen, other = (np.where(cells == UNKNOWN, UNKNOWN, state).astype(np.uint8) for state in (PRESENT, ABSENT))
    found = make_template(cells, gains, chances=quarter)
    expected = 0.25 * make_template(seen, gains) + 0.75 * make_template(other, gains)
    np.testing.assert_allclose(found, expected, atol=1e-9)
    certain = np.where(cells == UNKNOWN, np.nan, cells)
    np.testing.assert_array_equal(make_template(cells, gains, chances=certain), make_template(cells, gains))


def test_what_fades_does_not_depend_on_where_in_memory_it_lies(made) -> None:
    present = made.textured(1, side=96)[1] == 1
    rng = np.random.default_rng(0)
    kept, found = [], set()
    for size in rng.integers(1, 200_000, 300):
        kept = [*kept[-5:], np.ones(size, dtype=np.uint8)]
        found.add(fade(present, reach_cells=4.0).tobytes())
    assert len(found) == 1


def test_what_fades_is_the_formula() -> None:
    present = np.zeros((30, 40), dtype=bool)
    present[3, 4] = True
    rows, cols = np.indices(present.shape)
    expected = np.exp(-((rows - 3) ** 2 + (cols - 4) ** 2) / (2 * 2.5**2))
    np.testing.assert_allclose(fade(present, reach_cells=2.5), expected, atol=1e-9, rtol=1e-6)
