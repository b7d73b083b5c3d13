# SPDX-License-Identifier: Apache-2.0
"""A dense search scores each place by the cosine that is written out, whatever is known of the map and the view."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from sasgeo_baselines.image.dense import Search, Stack

import sasgeo_bench as sgb

SIDES = st.integers(1, 15)


def cosine(cut, known, view, least):
    """Return the score of a view over a cut of the map, as it is defined; None where rounding decides."""
    weight, power = view.is_known.sum(), (view.channels.astype(float) ** 2).sum()
    if weight == 0 or power == 0 or 2 * (known & view.is_known).sum() < weight:
        return -np.inf
    energy, floor = (cut**2).sum(axis=0)[view.is_known].sum(), max(least * weight, 1e-12)
    if abs(energy - floor) < 1e-4 * floor:
        return None
    return float((cut * view.channels).sum() / np.sqrt(power * energy)) if energy > floor else 0.0


@given(
    shape=st.tuples(SIDES, SIDES),
    margin=st.integers(0, 6),
    ground=st.sampled_from([0.0, 0.02, 0.5, 1.0]),
    seen=st.sampled_from([0.0, 0.02, 0.5, 1.0]),
    seed=st.integers(0, 99),
)
def test_scores_are_those_written_out(shape, margin, ground, seen, seed):
    rng, side = np.random.default_rng(seed), 2 * margin + 1
    stacks = []
    for size, share in ((shape, ground), ((side, side), seen)):
        is_known = rng.random(size) < share
        channels = rng.choice([-1.0, 0.5, 1.0], size=(2, *size)) * is_known
        channels[seed % 2] *= seed % 3 > 0
        stacks.append(Stack(channels=channels.astype(np.float32), is_known=is_known))
    town, view = stacks
    (top, left), (bottom, right) = np.sort(rng.integers(0, shape, (2, 2)), axis=0).tolist()
    grid = sgb.Grid(epsg=32632, west_m=0.0, north_m=99.0, cell_size_m=1.0, rows=shape[0], cols=shape[1])
    search = Search.of(town, grid, (top, left, bottom + 1, right + 1), margin=margin)
    found = search.scores(view)
    channels, known = (
        np.pad(of, [(0, 0)] * (of.ndim - 2) + [(margin, margin)] * 2) for of in (town.channels, town.is_known)
    )
    for row, col in np.ndindex(*found.shape):
        here = np.s_[..., top + row : top + row + side, left + col : left + col + side]
        expected = cosine(channels[here].astype(float), known[here], view, search.least_energy)
        if expected is not None:
            np.testing.assert_allclose(found[row, col], expected, atol=1e-5)


def test_no_rounding_decides_where_exactly_half_of_a_view_lies_on_known_imagery():
    rng, margin, side = np.random.default_rng(0), 10, 160
    is_known = np.ones((side, side), dtype=np.bool_)
    is_known[:, side // 2 :] = False
    town = Stack(channels=rng.normal(size=(1, side, side)).astype(np.float32) * is_known, is_known=is_known)
    grid = sgb.Grid(epsg=32632, west_m=0.0, north_m=160.0, cell_size_m=1.0, rows=side, cols=side)
    seen = np.ones((2 * margin + 1, 2 * margin + 1), dtype=np.bool_)
    seen[:, margin] = False  # of the other columns, as many on either side
    view = Stack(channels=rng.normal(size=(1, *seen.shape)).astype(np.float32) * seen, is_known=seen)
    scores = Search.of(town, grid, (margin, 0, side - margin, side), margin=margin).scores(view)
    assert np.isfinite(scores[:, margin : side // 2 + 1]).all()
    assert not np.isfinite(scores[:, side // 2 + 1 :]).any()
