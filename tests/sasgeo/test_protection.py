# SPDX-License-Identifier: Apache-2.0
"""Protection levels on lists of modes made by hand: what moves the answer, what does not, and what says nothing."""

import math

import numpy as np
import pytest

from sasgeo_bench.core.errors import ShapeError
from sasgeo_bench.sasgeo.conformal import (
    PROTECTION,
    RISKS,
    density_level,
    gauss_level,
    levels_of,
    posterior_sigma_m,
    separation_level,
    sigmas,
)
from tests.sasgeo.simulated import modes_of

SIGMA_M = 2.0


AGREED = modes_of([[0, 0], [0, 80], [60, 0]], [[9, 8, 7], [1, 2, 1], [2, 1, 0]])


def test_a_round_gaussian_exceeds_its_sigmas_as_often_as_the_risk():
    away = np.hypot(*np.random.default_rng(0).normal(0, 1, (2, 200_000)))
    for risk in RISKS:
        assert (away > sigmas(risk)).mean() == pytest.approx(risk, rel=0.2)
    with pytest.raises(ShapeError, match=r"risk must lie in \(0, 1\), got 1.5"):
        sigmas(1.5)


def test_classes_that_agree_leave_the_uncertainty_of_a_refined_position():
    for risk in RISKS:
        assert separation_level(AGREED, risk) == pytest.approx(sigmas(risk) * SIGMA_M)
    assert separation_level(AGREED, 1e-2) < density_level(AGREED, 1e-2) < 10.0


def test_the_class_whose_loss_moves_the_answer_farthest_sets_the_level_and_of_ties_the_farthest():
    # Without the first class the third mode wins, 60 m away; without the second, the second one, 80 m away.
    modes = modes_of([[0, 0], [0, 80], [60, 0]], [[5, 5, 2], [5, -3, 3], [-2, 6, 3]])
    assert separation_level(modes, 1e-2) == pytest.approx(80.0 + sigmas(1e-2) * SIGMA_M)
    assert separation_level(modes, 1e-3) > separation_level(modes, 1e-2)
    modes = modes_of([[0, 0], [30, 0], [90, 0], [200, 0]], [[5, 1], [1, 1], [0, 1], [0, 0]])
    assert separation_level(modes, 1e-2) == pytest.approx(90.0 + sigmas(1e-2) * SIGMA_M)


@pytest.mark.parametrize(
    ("positions_m", "by_class"),
    [([[0, 0]], [[9, 9]]), ([[0, 0], [50, 0]], [[9], [1]]), ([[0, 0], [50, 0]], [[9, 1], [1, 1]])],
)
def test_where_nothing_is_left_that_could_disagree_there_is_no_separation_level(positions_m, by_class):
    modes = modes_of(positions_m, by_class)
    assert separation_level(modes, 1e-2) == math.inf
    assert not any("separation" in name for name in levels_of(modes))
    assert np.isfinite(list(levels_of(modes).values())).all()


def test_two_modes_alike_are_as_uncertain_as_their_distance_by_the_longer_axis():
    modes = modes_of([[0, 0], [100, 0]], [[5, 5], [5, 5]], none_nats=-50.0)
    assert posterior_sigma_m(modes) == pytest.approx(math.sqrt(0.5 * 100**2 + SIGMA_M**2))
    assert gauss_level(modes, 1e-2) == pytest.approx(sigmas(1e-2) * posterior_sigma_m(modes))
    assert density_level(modes, 1e-2) == pytest.approx(100.0 + sigmas(5e-3) * SIGMA_M)
    line = modes_of([[0, 0], [30, 40]], [[1], [1]], none_nats=-50.0)
    assert posterior_sigma_m(line) == pytest.approx(math.sqrt(0.5 * 50**2 + SIGMA_M**2))


def test_no_radius_holds_the_chance_that_none_is_right():
    modes = modes_of([[0, 0], [40, 0]], [[4, 4], [0, 0]], none_nats=4.0)  # e^-4 = 1.8 %
    assert density_level(modes, 1e-2) == math.inf
    assert "hpl_density_0.01_m" not in levels_of(modes)
    assert density_level(modes, 0.1) < math.inf


def test_levels_grow_as_the_risk_falls_and_a_class_that_says_nothing_changes_nothing():
    found = levels_of(AGREED)
    assert list(found) == [item.name for item in PROTECTION]
    for method in ("separation", "gauss", "density"):
        assert found[f"hpl_{method}_0.001_m"] > found[f"hpl_{method}_0.01_m"] > 0
    wider = modes_of(AGREED.positions_m, np.hstack((AGREED.by_class, np.zeros((3, 1)))))
    assert levels_of(wider) == pytest.approx(levels_of(AGREED))
