# SPDX-License-Identifier: Apache-2.0
"""The arms of the scorer on a made-up place: they answer, learn, withhold, and take whatever a view or a map lacks."""

import math
from dataclasses import replace

import numpy as np
import pytest

from sasgeo_bench.core.errors import ConfigError
from sasgeo_bench.matching.matcher import Learner, Matcher, Training, check_match
from sasgeo_bench.regions.evidence import ABSENT, PRESENT, UNKNOWN, Evidence
from sasgeo_bench.sasgeo.conformal import PROTECTION
from sasgeo_bench.sasgeo.graph import GraphRules
from sasgeo_bench.sasgeo.integrity import EVIDENCE_NAMES
from sasgeo_bench.sasgeo.learning import _pose
from sasgeo_bench.sasgeo.scorer_model import ScorerModel
from sasgeo_bench.sasgeo.variants import (
    Sasgeo,
    SasgeoAgeless,
    SasgeoDistinct,
    SasgeoEven,
    SasgeoFresh,
    SasgeoFreshAgeless,
    SasgeoGraph,
    SasgeoHard,
    SasgeoIndependent,
    SasgeoNoGraph,
    SasgeoPrior,
    SasgeoRaster,
    SasgeoRasterVectors,
    SasgeoStability,
    SasgeoStamped,
)
from sasgeo_bench.search.plan import Plan

ALL = (
    SasgeoRaster,
    SasgeoRasterVectors,
    SasgeoGraph,
    SasgeoStability,
    Sasgeo,
    SasgeoPrior,
    SasgeoDistinct,
    SasgeoStamped,
    SasgeoAgeless,
    SasgeoFresh,
    SasgeoFreshAgeless,
    SasgeoNoGraph,
    SasgeoEven,
    SasgeoIndependent,
    SasgeoHard,
)
LEARNERS = {*ALL} - {SasgeoRaster, SasgeoRasterVectors, SasgeoPrior}


def first(tiny, track, **wanted):
    """The first query of a track whose place is there, and where it is."""
    return next(
        (query, truth)
        for query, truth in zip(tiny.queries, tiny.truths, strict=True)
        if query.track == track
        and query.suite == "clean"
        and truth.pose is not None
        and all(getattr(truth, name) == value for name, value in wanted.items())
        and query.evidence.shape[0] >= 192
    )


def near(query, truth):
    """The same query with a narrow prior about its place: a search of fifty metres takes a moment."""
    center_m = (truth.pose.easting_m + 15.0, truth.pose.northing_m - 20.0)
    yaw_deg = (truth.pose.yaw_deg + 2.0) % 360
    narrow = {"center_m": center_m, "radius_m": 50.0, "yaw_deg": yaw_deg, "yaw_sigma_deg": 3.0, "scale_sigma": 0.02}
    return replace(query, prior=replace(query.prior, **narrow))


def prepared(arm, region):
    matcher = arm()
    matcher.prepare(region, None)
    return matcher


@pytest.fixture(scope="module")
def whole(tiny):
    return prepared(Sasgeo, tiny.region)


def test_cards_are_full_and_say_who_learns_and_switches_tell_the_arms_apart():
    for arm in ALL:
        assert isinstance(arm(), Matcher)
        assert isinstance(arm(), Learner) == (arm in LEARNERS)
        assert arm.card.limits
    assert len({arm.switches for arm in ALL}) == len(ALL) - 1
    assert SasgeoPrior.switches == Sasgeo.switches  # it is told apart by what it learns: nothing
    assert len({arm.card.name for arm in ALL}) == len(ALL)


def test_an_arm_without_age_weighs_every_map_as_one_of_today():
    learnt = ScorerModel.by_hand(["building", "railway"])
    young, old = (SasgeoAgeless.switches.gains(learnt, age_years=age) for age in (0.0, 30.0))
    aged = Sasgeo.switches.gains(learnt, age_years=30.0)
    assert (young.agree == old.agree).all()
    assert (aged.agree < old.agree).all()
    assert (Sasgeo.switches.gains(learnt, age_years=0.0).missed == young.missed).all()


@pytest.mark.parametrize("arm", ALL)
def test_every_arm_finds_a_noise_free_view(tiny, arm):
    query, truth = first(tiny, "localization", kind="no error")
    query = near(query, truth)
    match = check_match(prepared(arm, tiny.region).match(query, top_k=5), query, top_k=5)
    best = match.poses[0]
    assert math.dist((best.easting_m, best.northing_m), (truth.pose.easting_m, truth.pose.northing_m)) < 5.0


def test_a_view_in_which_no_class_is_likely_is_read_by_its_probabilities(tiny):
    query, truth = first(tiny, "localization", kind="no error")
    query = near(query, truth)
    view = query.evidence
    chances = np.where(view.cells == PRESENT, 0.4, 0.02)
    chances[view.cells == UNKNOWN] = np.nan
    faint = Evidence.of_probabilities(view.classes, chances, cell_size_m=view.cell_size_m)
    assert not (faint.cells == PRESENT).any()
    best, hard = (
        prepared(arm, tiny.region).match(replace(query, evidence=faint), top_k=1).poses[0]
        for arm in (Sasgeo, SasgeoHard)
    )
    off_m = [
        math.dist((at.easting_m, at.northing_m), (truth.pose.easting_m, truth.pose.northing_m)) for at in (best, hard)
    ]
    assert off_m[0] < 5.0
    assert off_m[1] > 5.0


def test_a_view_with_probabilities_is_searched_on_smaller_cells(tiny, whole):
    query, _ = first(tiny, "localization")
    view = query.evidence
    chances = np.where(view.cells == UNKNOWN, np.nan, np.where(view.cells == PRESENT, 0.9, 0.1))
    soft = replace(query, evidence=Evidence.of_probabilities(view.classes, chances, cell_size_m=view.cell_size_m))
    found = [whole._reader.read(one).plan(Plan()) for one in (query, soft)]
    assert found == [Plan(), replace(Plan(), cells=2 * Plan().cells)]


@pytest.mark.parametrize("arm", [Sasgeo, SasgeoRaster])
def test_certain_probabilities_change_no_answer(tiny, arm):
    query = near(*first(tiny, "localization"))
    view = query.evidence
    sure = view.replace(view.cells, np.where(view.cells == UNKNOWN, np.uint8(0), np.uint8(255)))
    matcher = prepared(arm, tiny.region)
    assert matcher.match(replace(query, evidence=sure), top_k=5) == matcher.match(query, top_k=5)


def test_an_answer_tells_its_evidence_and_protection_levels(tiny, whole, drawn):
    match = whole.match(near(*first(tiny, "localization", kind="no error")), top_k=5)
    diagnostics = set(match.diagnostics)
    assert {"margin_nats", "null_z", "unknown_share", "map_age_years", "sigma_m"} <= diagnostics
    assert diagnostics <= {*EVIDENCE_NAMES, *(item.name for item in PROTECTION)}
    assert "graph_consistency" not in diagnostics  # the view has no vectors, so there is no graph
    assert "graph_consistency" in whole.match(drawn.pairs[0][0], top_k=5).diagnostics
    assert 0 <= match.confidence <= 1


def test_candidates_are_ranked_and_keep_their_places(tiny, whole):
    query, truth = first(tiny, "localization", kind="no error")
    here = truth.pose
    places = [replace(here, easting_m=here.easting_m + 80.0 * at, yaw_deg=0.0, scale=1.0) for at in (2, 1, 0, -1)]
    asked = replace(
        query, track="retrieval", candidates=tuple(places), prior=replace(query.prior, center_m=None, radius_m=None)
    )
    match = check_match(whole.match(asked, top_k=50), asked, top_k=50)
    assert len(match.poses) == len(places)
    assert match.poses[0].easting_m == here.easting_m
    assert abs(match.poses[0].yaw_deg - here.yaw_deg) % 360 < 3.0


def test_without_vectors_burning_them_changes_nothing_and_with_them_something(tiny):
    plain, drawing = (prepared(arm, tiny.region) for arm in (SasgeoRaster, SasgeoRasterVectors))
    query = next(
        near(query, truth)
        for query, truth in zip(tiny.queries, tiny.truths, strict=True)
        if query.vectors is not None and query.track == "localization" and query.evidence.shape[0] == 192
        if len(query.vectors)
    )
    unburnt = plain.match(query, top_k=5)
    for vectors in (None, query.vectors.iloc[:0]):
        assert drawing.match(replace(query, vectors=vectors), top_k=5) == unburnt
    assert drawing.match(query, top_k=5).scores != unburnt.scores


def test_a_blind_view_is_withheld_and_without_a_heading_the_graph_proposes_poses(tiny, whole):
    query, _ = first(tiny, "localization")
    blind = query.evidence.replace(np.full_like(query.evidence.cells, UNKNOWN))
    assert not whole.match(replace(query, evidence=blind), top_k=5).poses
    query = next(item for item in tiny.queries if item.prior.yaw_deg is None and item.evidence.shape[0] == 192)
    check_match(whole.match(query, top_k=5), query, top_k=5)
    with pytest.raises(RuntimeError, match="prepare"):
        Sasgeo().match(tiny.queries[0], top_k=5)


@pytest.mark.parametrize("state", [ABSENT, PRESENT])
@pytest.mark.parametrize("arm", [SasgeoGraph, Sasgeo])
def test_a_view_that_says_the_same_everywhere_breaks_nothing(tiny, arm, state):
    query = near(*first(tiny, "localization"))
    plain = query.evidence.replace(np.full_like(query.evidence.cells, state))
    asked = replace(query, evidence=plain, vectors=None)
    check_match(prepared(arm, tiny.region).match(asked, top_k=5), asked, top_k=5)


def test_one_class_alone_and_classes_that_one_side_lacks(tiny, whole):
    query = near(*first(tiny, "localization"))
    seen, at = query.evidence, query.evidence.classes.index("road_major")
    for classes in (("road_major",), ("lava",)):
        one = Evidence(classes=classes, cells=seen.cells[at : at + 1].copy(), cell_size_m=seen.cell_size_m)
        asked = replace(query, evidence=one, vectors=None)
        match = check_match(whole.match(asked, top_k=5), asked, top_k=5)
        assert bool(match.poses) or classes == ("lava",)


@pytest.mark.slow
def test_a_prior_off_the_map_and_a_view_larger_than_it(tiny, whole):
    query = near(*first(tiny, "localization"))
    west_m, south_m, _, _ = tiny.region.grid.bounds_m
    away = replace(query, prior=replace(query.prior, center_m=(west_m - 9000.0, south_m), radius_m=100.0))
    assert not whole.match(away, top_k=5).poses
    seen, classes = query.evidence, ("road_major", "building")
    cells = [np.pad(seen.layer(name), 420, constant_values=UNKNOWN) for name in classes]
    large = Evidence(classes=classes, cells=np.stack(cells), cell_size_m=seen.cell_size_m)
    asked = replace(query, evidence=large, vectors=None, prior=replace(query.prior, radius_m=30.0, yaw_sigma_deg=1.0))
    check_match(whole.match(asked, top_k=5), asked, top_k=5)


def test_unknown_cells_change_nothing_where_they_are_silent_and_something_where_not(tiny):
    query = near(*first(tiny, "localization", kind="no error"))
    cells = query.evidence.cells.copy()
    rows = cells.shape[1]
    cells[:, : rows // 2] = UNKNOWN
    half = replace(query, evidence=query.evidence.replace(cells), vectors=None)
    silent, blind = (prepared(arm, tiny.region).match(half, top_k=1) for arm in (Sasgeo, SasgeoStability))
    assert silent.scores != blind.scores


@pytest.fixture(scope="module")
def training(tiny):
    pairs = [
        (near(query, truth), truth)
        for query, truth in zip(tiny.queries, tiny.truths, strict=True)
        if query.suite == "clean" and query.evidence.shape[0] == 192
    ]
    return Training(regions={tiny.queries[0].region: tiny.region}, pairs=pairs[:2])


def test_what_is_learnt_is_read_back_and_the_same_again(tiny, training):
    one, other = (SasgeoNoGraph().learn(training) for _ in range(2))
    assert one == other
    given = ScorerModel.from_text(one)
    assert given.views == sum(query.track == "localization" for query, _ in training.pairs)
    assert set(given.classes) == set(tiny.region.classes)
    matcher = SasgeoNoGraph()
    matcher.prepare(tiny.region, one)
    query, truth = first(tiny, "localization", kind="no error")
    best = matcher.match(near(query, truth), top_k=1).poses[0]
    assert math.dist((best.easting_m, best.northing_m), (truth.pose.easting_m, truth.pose.northing_m)) < 5.0


@pytest.fixture(scope="module")
def drawn(tiny):
    """Training views of 192 m with vectors."""
    pairs = [
        (near(query, truth), truth)
        for query, truth in zip(tiny.queries, tiny.truths, strict=True)
        if query.vectors is not None and query.evidence.shape[0] == 192 and query.prior.yaw_deg is not None
    ]
    return Training(regions={tiny.queries[0].region: tiny.region}, pairs=pairs)


@pytest.mark.slow
def test_the_whole_scorer_learns_weights_of_the_joint_score_from_views_with_vectors(training, drawn):
    hand = ScorerModel.by_hand(())
    assert ScorerModel.from_text(Sasgeo().learn(replace(training, pairs=training.pairs[:1]))).blend == hand.blend
    both = replace(training, pairs=[*training.pairs, *drawn.pairs])
    assert ScorerModel.from_text(Sasgeo().learn(both)).blend != hand.blend


def test_the_even_graph_learns_rules_and_blend_alone(drawn):
    given = ScorerModel.from_text(SasgeoGraph().learn(drawn))
    hand = ScorerModel.by_hand(given.classes)
    assert given.rules != hand.rules
    assert given.blend != hand.blend
    assert replace(given, rules=hand.rules, blend=hand.blend, views=0, blocks=0) == hand


def test_nothing_to_learn_from_is_said_and_without_vectors_the_starting_rules_hold(training):
    with pytest.raises(ConfigError, match="no view of the training part"):
        Sasgeo().learn(replace(training, pairs=[]))
    absent = [(query, replace(truth, is_present=False)) for query, truth in training.pairs]
    with pytest.raises(ConfigError, match="no view of the training part"):
        Sasgeo().learn(replace(training, pairs=absent))
    with pytest.raises(ConfigError, match="has no place: give views of present places"):
        _pose(replace(training.pairs[0][1], pose=None))
    pairs = [(replace(query, vectors=None), truth) for query, truth in training.pairs]
    assert ScorerModel.from_text(SasgeoGraph().learn(replace(training, pairs=pairs))).rules == GraphRules()
