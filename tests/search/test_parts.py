# SPDX-License-Identifier: Apache-2.0
"""Sums of a map and a template, part by part, are those that are written out, whatever the sizes."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sasgeo_bench.search.parts import Parts
from sasgeo_bench.search.vote_search import ByPlanes, ByRows

SIDES = st.integers(1, 13)


def written_out(layers, template, places):
    """Return the sum of products at each place, one after the other."""
    high = template.shape[-1]
    return [
        [float((layers[:, row : row + high, col : col + high] * template).sum()) for col in range(places[1])]
        for row in range(places[0])
    ]


def some(seed, places, high, *, share):
    """Return two layers and known cells, of which a share is there, and a template of each; one layer is empty."""
    rng = np.random.default_rng(seed)
    layers = (rng.random((3, *(side + high - 1 for side in places))) < share).astype(np.float32)
    layers[seed % 3] = seed % 2
    return layers, rng.uniform(-1, 1, (3, high, high)).astype(np.float32)


@given(
    places=st.tuples(SIDES, SIDES),
    high=st.integers(1, 9),
    count=st.integers(1, 3),
    share=st.sampled_from([0.0, 0.02, 0.5, 1.0]),
    seed=st.integers(0, 99),
)
def test_parts_add_up_as_the_whole_does(places, high, count, share, seed):
    layers, template = some(seed, places, high, share=share)
    parts, found = Parts(places=places, high=high, count=count), np.full(places, np.nan)
    spectra = parts.templates(template)
    for here, window in zip(parts.slices, parts.windows(layers), strict=True):
        found[here] = parts.sums(window, spectra)
        under = layers[-1][tuple(slice(part.start, part.stop + high - 1) for part in here)]
        assert parts.is_full(window[-1]) == bool(under.all())
    np.testing.assert_allclose(found, written_out(layers, template, places), atol=1e-5)


@pytest.mark.parametrize("is_by_rows", [False, True])
@given(
    places=SIDES,
    high=st.integers(1, 9),
    count=st.integers(1, 3),
    share=st.sampled_from([0.0, 0.02, 0.5, 1.0]),
    seed=st.integers(0, 99),
)
def test_votes_are_those_written_out_where_enough_is_known(is_by_rows, places, high, count, share, seed):
    square = (places, places)
    layers, template = some(seed, square, high, share=share)
    bands = np.concatenate((template, np.ones((1, high, high), dtype=np.float32)))[None]
    votes = ByPlanes(parts=Parts(places=square, high=high, count=count))
    if is_by_rows:
        votes = ByRows(places=places, high=high)
    least = np.array([high * high / 2 - 0.25])
    total, counted = votes.votes(votes.window(layers[None]), votes.templates(bands), least)
    known = np.array(written_out(layers[-1:], bands[0, -1:], square))
    np.testing.assert_allclose(counted[0, 0], known, atol=1e-4)
    is_enough = known > least
    expected = np.array(written_out(layers, template, square))
    np.testing.assert_allclose(total[0, 0][is_enough], expected[is_enough], atol=1e-5)
