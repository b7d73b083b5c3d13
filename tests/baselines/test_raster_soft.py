# SPDX-License-Identifier: Apache-2.0
"""`raster_soft`: probabilities against the map, whatever their level."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from sasgeo_baselines.raster_soft import RasterSoft, soft_template

from sasgeo_bench.geometry.pose import Pose, Prior
from sasgeo_bench.regions.evidence import ABSENT, PRESENT, UNKNOWN, Evidence
from sasgeo_bench.sensing.birdseye import SoftView

HERE = Pose(easting_m=1170.0, northing_m=8800.0, yaw_deg=40.0)
NEAR_HERE = Prior(center_m=(1190.0, 8790.0), radius_m=60.0, yaw_deg=43.0, yaw_sigma_deg=3.0, scale_sigma=0.0)


@pytest.fixture(scope="module")
def region(made):
    return made.region_of(made.textured(1))


@pytest.fixture(scope="module")
def view(made, region) -> Evidence:
    """A perfect view of a textured map."""
    return made.view_of(region, HERE, size_cells=64)


def squeezed(view: Evidence, low: float, high: float) -> Evidence:
    """The view as a segmenter tells it whose probabilities are `low` where nothing is and `high` where something is."""
    chances = np.where(view.cells == PRESENT, high, low).astype(np.float32)
    chances[view.cells == UNKNOWN] = np.nan
    return SoftView(classes=view.classes, probabilities=chances, cell_size_m=view.cell_size_m).to_evidence()


def best(made, matcher, region, view: Evidence) -> Pose | None:
    matcher.prepare(region, None)
    found = matcher.match(made.query_of(view, NEAR_HERE), top_k=3)
    return found.poses[0] if found.poses else None


def off_m(pose: Pose) -> float:
    return float(np.hypot(pose.easting_m - HERE.easting_m, pose.northing_m - HERE.northing_m))


@pytest.mark.parametrize(("low", "high"), [(0.0, 1.0), (0.05, 0.25), (0.7, 0.95)])
def test_the_place_is_found_at_any_level_of_the_probabilities(made, region, view, low, high) -> None:
    pose = best(made, RasterSoft(), region, squeezed(view, low, high))
    assert off_m(pose) < 3
    assert abs(pose.yaw_deg - HERE.yaw_deg) < 3


def test_the_score_of_a_place_is_the_covariance() -> None:
    chances = np.array([[[0.1, 0.9], [0.2, np.nan]]])
    mapped, share = np.array([[0.0, 1.0], [0.0, 1.0]]), 0.25
    made = soft_template(chances, np.array([share]))
    total = float((made[0] * mapped).sum() + made[1].sum())
    seen = np.array([0.1, 0.9, 0.2])
    by_hand = ((seen - seen.mean()) * (np.array([0.0, 1.0, 0.0]) - share)).sum()
    assert total == pytest.approx(by_hand)
    assert made[2].tolist() == [[1, 1], [1, 0]]


@given(
    chances=arrays(np.float64, (2, 3, 3), elements=st.floats(0.0, 0.4)),
    more=st.floats(0.0, 0.5),
    times=st.floats(0.1, 1.0),
)
def test_level_and_contrast_change_no_order(chances, more, times) -> None:
    shares = np.array([0.1, 0.5])
    plain, other = (soft_template(some, shares) for some in (chances, times * chances + more))
    np.testing.assert_allclose(other[:3], times * plain[:3], atol=1e-9)


def test_what_is_unknown_is_silent() -> None:
    seen = Evidence(classes=("water",), cells=np.array([[[PRESENT, ABSENT, UNKNOWN]]], dtype=np.uint8), cell_size_m=1.0)
    made = soft_template(seen.probabilities(), np.array([0.3]))
    assert made[:, 0, 2].tolist() == [0.0, 0.0, 0.0]
    assert made[0, 0, :2].tolist() == [0.5, -0.5]
