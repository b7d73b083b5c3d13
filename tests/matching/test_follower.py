# SPDX-License-Identifier: Apache-2.0
"""A matcher of single views follows flights: asked within the belief, taken up where it fits, and found again."""

import datetime as dt
import math
from dataclasses import replace

import numpy as np
import pytest

from sasgeo_bench.core.errors import MatchError
from sasgeo_bench.geometry.grid import Grid
from sasgeo_bench.geometry.pose import Pose, Prior
from sasgeo_bench.matching.follower import Follower, FollowPlan, card_on_flights, follower_record
from sasgeo_bench.matching.matcher import WITHHELD, Match, MatcherCard, lacks
from sasgeo_bench.matching.tracker import Tracker, check_fix
from sasgeo_bench.regions.evidence import Evidence
from sasgeo_bench.tasks.query import Query, Step

CARD = MatcherCard(
    name="sees", version="1", title="Sees", source="original", ours="all", licence="MIT", tracks=("localization",)
)
GRID = Grid(epsg=32632, west_m=0.0, north_m=4000.0, cell_size_m=2.0, rows=2000, cols=2000)
START = Prior(center_m=(1000.0, 1000.0), radius_m=500.0, yaw_deg=10.0, yaw_sigma_deg=20.0, scale_sigma=0.03)
NOTHING = Prior(center_m=None, radius_m=None, yaw_deg=None, yaw_sigma_deg=None, scale_sigma=0.03)
COVARIANCE = (1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0)


class Sees:
    """A matcher that is told what to answer, and keeps what it was asked."""

    card = CARD

    def __init__(self, answers):
        self.answers, self.asked = list(answers), []

    def prepare(self, region, learned):
        raise NotImplementedError

    def match(self, query, *, top_k):
        assert top_k == FollowPlan().top_k
        self.asked.append(query)
        answer = self.answers[len(self.asked) - 1]
        return answer(query) if callable(answer) else answer


def at(east_m, north_m, yaw_deg=0.0, confidence=None):
    pose = Pose(easting_m=east_m, northing_m=north_m, yaw_deg=yaw_deg)
    return Match(poses=[pose], scores=[1.0], confidence=confidence)


def view(frame, increment=(0.0, 50.0, 0.0), *, prior=NOTHING):
    given = frame > 0 and increment is not None
    covariance = COVARIANCE if given else None
    step = Step(sequence_id="f", frame=frame, increment=increment if given else None, covariance=covariance)
    return Query(
        query_id=f"f{frame:06x}",
        track="sequence",
        suite="flight-clean",
        suite_version=1,
        part="test",
        region="town-grid",
        prior_group="r500-weak-s3",
        evidence=Evidence(classes=("building",), cells=np.ones((1, 4, 4), dtype=np.uint8), cell_size_m=1.0),
        observed_on=dt.date(2025, 1, 1),
        season="",
        prior=START if frame == 0 else prior,
        step=step,
    )


def follow(answers, *, steps=None, prior=START, **plan):
    """Fly north with a matcher; return the fixes and what it was asked."""
    matcher = Sees(answers)
    follower = Follower(matcher, FollowPlan(**plan), grid=GRID)
    follower.start(prior)
    steps = steps or [(0.0, 50.0, 0.0)] * len(answers)
    fixes = [check_fix(follower.step(view(frame, steps[frame])), top_k=5) for frame in range(len(answers))]
    return fixes, matcher.asked


def test_the_first_view_is_asked_with_the_prior_and_later_ones_within_the_belief():
    fixes, asked = follow([at(900.0, 1100.0), at(902.0, 1149.0, 359.0)])
    assert [fix.is_accepted for fix in fixes] == [True, True]
    first, second = (query.prior for query in asked)
    assert first == START
    assert second.center_m == pytest.approx((900.0, 1150.0))
    assert second.radius_m == 50.0
    assert second.yaw_sigma_deg == pytest.approx(math.sqrt(3.0**2 + 1), rel=1e-3)
    assert second.scale_sigma == 0.03
    assert {(query.track, query.step) for query in asked} == {("localization", None)}
    assert fixes[1].pose == Pose(easting_m=902.0, northing_m=1149.0, yaw_deg=359.0)
    assert np.sqrt(np.diag(fixes[1].covariance)).tolist() == [5.0, 5.0, 3.0]


@pytest.mark.parametrize("answer", [WITHHELD, at(1000.0, 1200.0), at(1000.0, 1050.0, 90.0), at(1000, 1050, 0, 0.4)])
def test_an_answer_that_does_not_fit_is_not_taken_up_and_odometry_is_added_up(answer):
    fixes, asked = follow([at(1000.0, 1000.0), answer, at(1000.0, 1100.0, confidence=0.5)])
    assert [fix.is_accepted for fix in fixes] == [True, False, True]
    assert fixes[1].pose == Pose(easting_m=1000.0, northing_m=1050.0, yaw_deg=0.0)
    assert fixes[1].covariance[0][0] > fixes[0].covariance[0][0]
    assert fixes[1].confidence is None
    assert fixes[2].confidence == 0.5
    assert asked[2].prior.center_m == pytest.approx((1000.0, 1100.0))


def test_a_belief_that_nothing_corrects_widens_until_the_start_and_finds_the_drone_again():
    """The drone is elsewhere after the second view: what fits no belief is taken up once the belief is wide."""
    answers = [at(1000.0, 1000.0), at(1000.0, 1050.0), *[at(1000.0, 1050.0 + 50 * more + 350) for more in range(30)]]
    fixes, asked = follow(answers, patience=3)
    found = next(index for index in range(2, len(fixes)) if fixes[index].is_accepted)
    assert 4 < found < 25
    assert all(fix.is_accepted for fix in fixes[found:])
    radii = [query.prior.radius_m for query in asked]
    assert radii[1] == 50.0
    assert sorted(radii[1 : found + 1]) == radii[1 : found + 1]
    assert radii[-1] == 50.0
    _, asked = follow([at(1000.0, 1000.0), *[at(0.0, 0.0)] * 30], patience=3)
    assert asked[-1].prior.radius_m == 500.0
    assert asked[-1].prior.yaw_deg is None
    _, asked = follow([at(1000.0, 1000.0), *[at(0.0, 0.0)] * 30], patience=3, lost_radius_m=900.0)
    assert asked[-1].prior.radius_m == 900.0


def test_views_without_an_answer_widen_nothing_beyond_the_odometry():
    _, asked = follow([at(1000.0, 1000.0), *[WITHHELD] * 20], patience=3)
    assert asked[-1].prior.radius_m < 300.0
    assert asked[-1].prior.yaw_sigma_deg < 6.0


def test_without_a_place_the_whole_map_is_searched_and_a_matcher_that_needs_one_gets_it():
    matcher = Sees([WITHHELD] * 2)
    matcher.card = replace(CARD, needs=("position", "yaw"))
    follower = Follower(matcher, grid=GRID)
    follower.start(NOTHING)
    follower.step(view(0, prior=NOTHING))
    prior = matcher.asked[0].prior
    assert (prior.center_m, prior.radius_m, prior.yaw_deg) == (
        (2000.0, 2000.0),
        pytest.approx(2000 * math.sqrt(2)),
        0.0,
    )
    _, asked = follow([WITHHELD], prior=NOTHING)
    assert (asked[0].prior.center_m, asked[0].prior.yaw_deg) == (None, None)


def test_a_flight_without_odometry_or_answers_keeps_a_sound_covariance():
    count = 400
    fixes, asked = follow([at(1000.0, 1000.0), *[WITHHELD] * count], steps=[None] * (count + 1))
    assert not fixes[-1].is_accepted
    assert asked[-1].prior.radius_m == 500.0
    assert asked[-1].prior.yaw_deg is None


def test_start_forgets_the_flight_before():
    matcher = Sees([at(1000.0, 1000.0), at(1000.0, 1000.0), at(1000.0, 1050.0)])
    follower = Follower(matcher, grid=GRID)
    first, second = [], []
    for fixes in (first, second):
        follower.start(START)
        fixes.append(follower.step(view(0)))
    assert first[0].pose == second[0].pose
    assert matcher.asked[0].prior == matcher.asked[1].prior == START


def test_a_wrong_answer_and_a_wrong_order_are_named():
    follower = Follower(Sees([at(0.0, 0.0), "a text"]), grid=GRID)
    with pytest.raises(RuntimeError, match=r"call start\(\) first"):
        follower.step(view(0))
    with pytest.raises(RuntimeError, match=r"call prepare\(\) with a region"):
        Follower(Sees([])).start(START)
    follower.start(START)
    follower.step(view(0))
    with pytest.raises(MatchError, match="returned str"):
        follower.step(view(1))


def test_a_card_says_how_flights_are_followed_and_settings_are_part_of_a_run():
    follower = Follower(Sees([]), FollowPlan(gate=2.0))
    assert isinstance(follower, Tracker)
    assert follower.card.tracks == ("sequence",)
    assert follower.card.name == CARD.name
    assert "Mahalanobis distance at most 2;" in follower.card.ours
    assert card_on_flights(CARD).tracks == ("localization", "sequence")
    assert follower_record(CARD)["gate"] == 3.5
    assert follower_record(replace(CARD, tracks=("retrieval",))) is None
    assert follower_record(replace(CARD, tracks=("sequence",))) is None


def test_a_class_of_ones_own_has_its_own_card_and_covariance():
    class Sure(Follower):
        card = replace(CARD, name="sure", tracks=("sequence",))

        def __init__(self):
            super().__init__(Sees([at(1000.0, 1000.0)]), grid=GRID)

        def covariance_of(self, found, query):
            return 0.25 * super().covariance_of(found, query)

    follower = Sure()
    follower.start(START)
    fix = follower.step(view(0))
    assert follower.card.name == "sure"
    assert fix.covariance[0][0] == 6.25


def test_place_and_heading_are_there_for_every_view_of_a_followed_flight():
    later = view(3)
    assert lacks(replace(CARD, needs=("position", "yaw")), later) is None
    assert lacks(replace(CARD, needs=("image",)), later) == "no image"
    assert lacks(replace(CARD, tracks=("sequence",), needs=("position",)), later) == "no position"
    assert lacks(replace(CARD, tracks=("retrieval",)), later) == "track sequence"
