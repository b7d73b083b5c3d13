# SPDX-License-Identifier: Apache-2.0
"""Terms of the joint score: what is not seen has no say, and no weight turns a term around."""

import numpy as np
import pytest

from sasgeo_bench.core.errors import ConfigError
from sasgeo_bench.geometry.pose import Pose, Prior
from sasgeo_bench.sasgeo.joint import HALF_NODES, Blend, columns, contradiction, of_prior


@pytest.mark.parametrize(
    ("name", "value"), [("alpha", -1.0), ("beta", float("nan")), ("eta", float("inf")), ("overlap", -0.1)]
)
def test_weights_that_turn_a_term_around_are_refused(name, value):
    with pytest.raises(ConfigError, match=name):
        Blend(**{name: value})


def test_by_hand_contradiction_is_never_covered_up():
    terms = columns(
        np.array([[2.0, -4.0], [1.0, 0.5]]), np.array([3.0, -1.0]), Blend(alpha=2.0, beta=0.5, eta=0.25), nodes=2
    )
    share = 2 / (2 + HALF_NODES)
    assert terms == pytest.approx(np.array([[4.0, -8.0, 1.5 * share, -1.0], [2.0, 1.0, -0.5 * share, 0.0]]))
    assert not columns(np.ones((3, 2)), np.array([5.0, -5.0, 0.0]), Blend(), nodes=0)[:, 2].any()
    by_class = np.array([[2.0, -4.0], [1.0, 0.5]])
    assert (columns(by_class, None, Blend(), nodes=9) == by_class).all()  # without a graph
    assert contradiction(np.array([[100.0, -3.0], [0.0, 0.0]])).tolist() == [3.0, 0.0]


def test_the_prior_says_nothing_of_a_heading_that_it_does_not_know_and_of_places():
    anywhere = Prior(center_m=(0.0, 0.0), radius_m=100.0, yaw_deg=None, yaw_sigma_deg=None, scale_sigma=0.0)
    poses = [
        Pose(easting_m=east_m, northing_m=0.0, yaw_deg=yaw_deg) for east_m, yaw_deg in ((0.0, 10.0), (90.0, 200.0))
    ]
    assert of_prior(poses, anywhere).tolist() == [[0.0, 0.0], [0.0, 0.0]]


def test_the_prior_takes_the_short_way_round_and_scales_by_their_logarithm():
    prior = Prior(center_m=None, radius_m=None, yaw_deg=350.0, yaw_sigma_deg=10.0, scale_sigma=0.05)
    poses = [
        Pose(easting_m=0.0, northing_m=0.0, yaw_deg=yaw_deg, scale=scale)
        for yaw_deg, scale in ((350.0, 1.0), (10.0, 1.1), (330.0, 1 / 1.1))
    ]
    found = of_prior(poses, prior)
    assert found[0].tolist() == [0.0, 0.0]
    assert found[1] == pytest.approx(found[2])
    assert found[1] == pytest.approx([-2.0, -0.5 * (np.log(1.1) / 0.05) ** 2])
