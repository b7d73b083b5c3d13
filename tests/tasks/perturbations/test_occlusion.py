# SPDX-License-Identifier: Apache-2.0
"""What hides cells hides the share asked for, where it says, and nothing but what it says."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sasgeo_bench.core.errors import PerturbError
from sasgeo_bench.regions.evidence import PRESENT, UNKNOWN, Evidence
from sasgeo_bench.tasks.perturbations.base import hide, share_hidden
from sasgeo_bench.tasks.perturbations.occlusion import (
    HIDDEN,
    MASKS,
    AdversarialMask,
    Border,
    CanopyAndShadow,
    CentralCrop,
    FalseUnknown,
    Glare,
    Rectangles,
    TiltWedge,
    far_side,
    library,
    shaded,
    shadow,
)

BY_SHARE = (Rectangles, Border, TiltWedge, Glare, AdversarialMask, CentralCrop, FalseUnknown)


def blank(rows=96, cols=96, classes=("water", "building", "road_minor")):
    return Evidence(classes=classes, cells=np.zeros((len(classes), rows, cols), dtype=np.uint8), cell_size_m=1.0)


def hidden(perturbation, view, seed=0):
    return perturbation(view, np.random.default_rng(seed)).cells == UNKNOWN


@pytest.mark.parametrize("share", [0.05, 0.2, 0.4, 0.6, 0.95])
@pytest.mark.parametrize("kind", BY_SHARE)
def test_the_share_that_is_asked_for_is_reached(kind, share, view):
    shares = [share_hidden(view, kind(share=share)(view, np.random.default_rng(seed))) for seed in range(5)]
    assert np.mean(shares) == pytest.approx(share, abs=0.012)
    assert np.ptp(shares) < 0.02


@pytest.mark.parametrize("kind", BY_SHARE)
def test_a_share_of_one_hides_everything(kind, view):
    assert hidden(kind(share=1.0), view).all()


@given(share=st.floats(0.001, 1), rows=st.integers(1, 60), cols=st.integers(1, 60), seed=st.integers(0, 99))
def test_rectangles_cover_the_share_to_the_cell_whatever_the_shape(share, rows, cols, seed):
    mask = Rectangles(share=share).mask(blank(rows, cols), np.random.default_rng(seed))
    assert mask.sum() == round(share * rows * cols)


def test_a_border_leaves_the_middle_and_a_crop_nothing_else():
    for kind in (Border(share=0.5), CentralCrop(share=0.5)):
        mask = hidden(kind, blank())[0]
        assert not mask[40:56, 40:56].any()
        assert mask[[0, 0, -1, -1], [0, -1, 0, -1]].all()


@pytest.mark.parametrize(
    ("direction_deg", "row", "col"), [(0.0, 0, 48), (90.0, 48, 95), (180.0, 95, 48), (270.0, 48, 0)]
)
def test_the_wedge_hides_the_side_the_camera_leans_to(direction_deg, row, col):
    mask = far_side(blank(), 0.3, direction_deg)
    assert mask[row, col]
    assert not mask[95 - row, 95 - col]


def test_glare_likes_water_and_reaches_less_far_for_some_classes():
    lake = blank()
    cells = lake.cells.copy()
    cells[0, :, :48] = PRESENT
    masks = [hidden(Glare(share=0.2), lake.replace(cells.copy()), seed) for seed in range(20)]
    assert np.mean([mask[:, :, :48].mean() for mask in masks]) > 2 * np.mean([mask[:, :, 48:].mean() for mask in masks])
    ones, others = np.stack([mask[0] for mask in masks]), np.stack([mask[1] for mask in masks])
    assert 0.05 < (ones & ~others).sum() / ones.sum() < 0.3
    assert 0.05 < (others & ~ones).sum() / others.sum() < 0.3


def sun_deg(seed):
    return np.random.default_rng(seed).uniform(0, 360)


def test_shade_hides_lines_only_and_only_near_green_or_behind_houses(view):
    mask = hidden(CanopyAndShadow(share=1.0), view)
    lines = np.isin(view.classes, HIDDEN)
    assert not mask[~lines].any()
    assert (mask[lines] == shaded(view, sun_deg(0))).all()
    assert 0.05 < mask[lines].mean() < 0.9


def test_half_of_the_shade_is_half_of_it(view):
    mask = hidden(CanopyAndShadow(share=0.5), view)[view.classes.index("road_minor")]
    assert mask.sum() == pytest.approx(shaded(view, sun_deg(0)).sum() / 2, abs=2)


@pytest.mark.parametrize(("sun_deg", "row", "col"), [(0.0, 14, 10), (90.0, 10, 6), (180.0, 6, 10), (270.0, 10, 14)])
def test_a_shadow_falls_away_from_the_sun(sun_deg, row, col):
    house = np.zeros((21, 21), dtype=bool)
    house[10, 10] = True
    cast = shadow(house, sun_deg, 4.0)
    assert cast.sum() == 5
    assert cast[row, col]


def test_the_library_of_masks_is_fixed_and_its_masks_differ():
    masks = library((64, 64), 0.3)
    assert len(masks) == MASKS == 32
    assert len({mask.tobytes() for mask in masks}) == MASKS
    np.testing.assert_array_equal(library.__wrapped__((64, 64), 0.3), masks)


def test_the_worst_mask_hides_more_of_what_is_there_than_rectangles_do(views):
    def lost(perturbation, seed):
        shares = []
        for view in views:
            present = view.cells == PRESENT
            shares.append(hidden(perturbation, view, seed)[present].mean())
        return np.mean(shares)

    assert lost(AdversarialMask(share=0.3), 0) > 1.2 * np.mean([lost(Rectangles(share=0.3), seed) for seed in range(3)])


def test_false_unknowns_lie_together_and_differ_between_classes():
    mask = hidden(FalseUnknown(share=0.2), blank(192, 192))
    together = (mask[:, :, 1:] & mask[:, :, :-1]).sum() / mask[:, :, 1:].sum()
    assert together > 0.85  # cells drawn one by one: 0.2
    assert np.corrcoef(mask[0].ravel(), mask[1].ravel())[0, 1] < 0.5


@pytest.mark.parametrize(
    ("mask", "what"),
    [
        (np.ones((3, 3)), "float64 of shape (3, 3)"),
        (np.ones((2, 2), dtype=bool), "bool of shape (2, 2)"),
        ([True], "list"),
    ],
)
def test_what_is_no_mask_of_the_view_is_refused_in_one_line(mask, what):
    view = Evidence(classes=("water",), cells=np.zeros((1, 3, 3), dtype=np.uint8), cell_size_m=1.0)
    with pytest.raises(PerturbError, match=r"expected an array of bool of shape \(3, 3\), or \(1, 3, 3\)") as caught:
        hide(view, mask)
    assert what in str(caught.value)
