# SPDX-License-Identifier: Apache-2.0
"""Registered contrasts: a real difference is found, none is a null, and what cannot be decided is said to be so."""

import math
from dataclasses import replace

import numpy as np
import pytest

from sasgeo_bench.boards.board_tables import contrast_table
from sasgeo_bench.core.errors import ConfigError
from sasgeo_bench.scoring import compare
from sasgeo_bench.scoring.contrasts import Contrast, evaluate_contrasts
from sasgeo_bench.scoring.intervals import wilson
from tests.scoring.test_tables import scores

CONTRAST = Contrast(name="graph", first="with", second="without", suites=("occlusion",))


@pytest.fixture(autouse=True)
def _few_flips(monkeypatch):
    """Signs are flipped 16,000 times at most: tests/scoring/test_compare.py flips them as often as a board does."""
    monkeypatch.setattr(compare, "_FLIPS", 2**14)


def errors(share, count=600, seed=1):
    """Errors of which a share is right; the same queries are right for the same seed."""
    return np.where(np.random.default_rng(seed).random(count) < share, 1.0, 99.0)


def held(contrast, judged=None, **tables):
    return evaluate_contrasts([contrast], tables, judged or {}, draws=400)[0]


def test_a_real_difference_is_found_with_its_discordant_pairs():
    better, worse = errors(0.8), errors(0.6)
    found = held(CONTRAST, **{"with": scores(better, blocks=60), "without": scores(worse, blocks=60)})
    assert (found.first_only, found.second_only) == (int(((better < 25) & (worse > 25)).sum()), 0)
    assert found.difference == pytest.approx((better < 25).mean() - (worse < 25).mean())
    assert 0 < found.lo < found.difference < found.hi
    assert found.p_holm < 0.001
    assert found.verdict == "with is better, by as much as matters"
    assert (found.outcome, found.places) == ("decided", 60)
    other = held(
        replace(CONTRAST, first="without", second="with"),
        **{"with": scores(better, blocks=60), "without": scores(worse, blocks=60)},
    )
    assert other.verdict == "with is better, by as much as matters"
    assert other.difference == -found.difference


def test_a_small_difference_is_told_to_be_small():
    better = errors(0.5)
    worse = better.copy()
    worse[np.flatnonzero(better < 25)[:12]] = 99.0
    tables = {"with": scores(better, blocks=60), "without": scores(worse, blocks=60)}
    found = held(CONTRAST, **tables)
    assert found.verdict == "with is better; whether by as much as matters is not decided"
    small = held(replace(CONTRAST, min_effect=0.1), **tables)
    assert (small.outcome, small.verdict) == ("decided, small", "with is better, by less than would matter")


def test_no_difference_is_equality_and_says_how_sure_it_is():
    same = errors(0.7)
    found = held(CONTRAST, **{"with": scores(same, blocks=60), "without": scores(same, blocks=60)})
    assert found.verdict == f"equal (within {CONTRAST.min_effect:g}): any difference is smaller than would matter"
    assert found.p_exact == 1.0
    few = errors(0.7, 40)
    unsure = held(CONTRAST, **{"with": scores(few, blocks=10), "without": scores(errors(0.7, 40, seed=9), blocks=10)})
    assert unsure.verdict == "not decided: no difference shown, and one that matters is not ruled out"


def test_of_few_sites_no_difference_is_not_ruled_out():
    same = {name: scores(np.full(6, 99.0), blocks=6) for name in ("with", "without")}
    found = held(CONTRAST, **same)
    most = wilson(0, 6).hi  # neither won a query: each may have, as often as 0 of 6 allows
    assert (found.lo, found.hi) == pytest.approx((-most, most))
    assert found.verdict == "not decided: no difference shown, and one that matters is not ruled out"
    full = held(CONTRAST, **{name: scores(np.ones(6), blocks=6) for name in ("with", "without")})
    assert full.verdict == "not decided: at most 0.000 can be gained, and 0.030 was to matter"


def test_a_difference_over_few_blocks_has_the_doubts_of_its_sites():
    # Two blocks of two sites of ten queries: the first is right at all of them, the second at none.
    sites = {"block": [f"b{at // 20}" for at in range(40)], "pair_id": [f"s{at // 10}" for at in range(40)]}
    found = held(CONTRAST, **{"with": scores(np.ones(40), **sites), "without": scores(99 * np.ones(40), **sites)})
    won, lost = wilson(4, 4), wilson(0, 4)
    assert found.lo == pytest.approx(1 - math.hypot(1 - won.lo, lost.hi))
    assert (found.difference, found.hi) == (1.0, 1.0)


@pytest.mark.parametrize(("places_won", "is_floored"), [(0, True), (1, True), (5, True), (6, False)])
def test_few_places_that_differ_leave_the_doubts_of_the_sites(places_won, is_floored):
    # A query of the first `places_won` of 40 places is won, and none is lost: no draw of places has a loss.
    ours, theirs = np.ones(40), np.ones(40)
    theirs[:places_won] = 99.0
    found = held(CONTRAST, **{"with": scores(ours, blocks=40), "without": scores(theirs, blocks=40)})
    won, lost = wilson(places_won, 40), wilson(0, 40)
    floor = found.difference - math.hypot(won.value - won.lo, lost.hi)
    assert (found.lo == pytest.approx(floor)) is is_floored


def test_countries_are_drawn_where_places_share_some_and_widen_the_interval():
    # Sixty places, six to a country: in three countries the first side is right everywhere, in the others nowhere.
    country = [f"country {at % 10}" for at in range(600)]
    is_won = np.arange(600) % 10 < 3
    ours, theirs = scores(np.where(is_won, 1.0, 99.0), blocks=60), scores(99 * np.ones(600), blocks=60)
    apart = held(CONTRAST, **{"with": ours, "without": theirs})
    assert apart.countries == apart.places == 60
    assert math.isnan(apart.lo_countries)
    shared = held(
        CONTRAST, **{name: table.assign(country=country) for name, table in (("with", ours), ("without", theirs))}
    )
    assert (shared.places, shared.countries) == (60, 10)
    assert (shared.lo, shared.hi) == (apart.lo, apart.hi)
    assert shared.lo_countries < shared.lo - 0.05
    assert shared.hi_countries > shared.hi + 0.05
    assert (apart.outcome, shared.outcome) == ("decided", "not decided")
    assert shared.verdict == "not decided: a difference is shown by places, none by countries"
    few = [f"country {at % 5}" for at in range(600)]
    alike = held(CONTRAST, **{"with": ours.assign(country=few), "without": theirs.assign(country=few)})
    assert alike.verdict == "with is better, by as much as matters; of 5 countries alone"
    title = {column.name: at for at, column in enumerate(contrast_table([shared]).columns)}
    cells = contrast_table([shared]).rows[0].cells
    assert cells[title["by countries"]].text.startswith("[0.000, 0.")
    assert cells[title["n"]].text == "600 in 60 blocks, 60 places, 10 countries"
    assert "by countries" not in [column.name for column in contrast_table([apart]).columns]


def test_few_places_decide_nothing():
    found = held(CONTRAST, **{"with": scores(np.ones(100), blocks=5), "without": scores(99 * np.ones(100), blocks=5)})
    assert found.verdict == "not decided: 5 places, at least 6 are needed"


def test_kinds_choose_and_controls_and_falsifiers_do_not_count():
    roles = ["stress", "stress", "control", "falsifier"] * 60
    kinds = ["U1 rectangles", "U2 border", "control", "U2 none"] * 60
    table = scores(np.ones(240), blocks=60, role=roles, kind=kinds)
    found = held(replace(CONTRAST, kinds=("U2",)), **{"with": table, "without": table})
    assert found.n == 60
    assert held(CONTRAST, **{"with": table, "without": table}).n == 120
    far = table.assign(kind="unrivalled U2")
    assert held(CONTRAST, **{"with": far, "without": far}).n == 0
    assert held(replace(CONTRAST, kinds=("U9",)), **{"with": table, "without": table}).verdict == "not tested: no query"


def test_a_detector_chooses_and_its_controls_are_its_own():
    roles, detectors = ["stress", "control"] * 120, ["published", "published", "measured", "measured"] * 60
    sites = [site for site in range(60) for _ in range(4)]
    # The first side is right everywhere but on controls of one detector; the second nowhere.
    errors_m = np.where(np.arange(240) % 4 == 3, 99.0, 1.0)
    known = {
        "with": scores(errors_m, blocks=60, role=roles, detector=detectors, pair_id=sites),
        "without": scores(99 * np.ones(240), blocks=60, role=roles, detector=detectors, pair_id=sites),
    }
    less = replace(CONTRAST, metric="interaction")
    assert held(replace(CONTRAST, detectors=("measured",)), **known).n == 60
    assert held(replace(less, detectors=("published",)), **known).difference == 0.0
    assert held(replace(less, detectors=("measured",)), **known).difference == 1.0
    assert held(less, **known).difference == 0.5


def test_a_shift_is_what_another_detector_adds_variant_by_variant():
    sites = [site for site in range(60) for _ in range(4)]
    about = {"blocks": 60, "pair_id": sites, "detector": ["published", "measured"] * 120}
    about |= {"kind": ["U2 glare", "U2 glare", "U2 wedge", "U2 wedge"] * 60}
    right = np.ones(240)
    # The second side loses glare of the other detector alone, so half of its answers there.
    worse = np.where(np.arange(240) % 4 == 1, 99.0, 1.0)
    known = {"with": scores(right, **about), "without": scores(worse, **about)}
    shift = replace(CONTRAST, metric="shift", detectors=("measured",))
    found = held(shift, **known)
    assert (found.n, found.first_value, found.second_value, found.difference) == (120, 0.0, -0.5, 0.5)
    assert held(replace(shift, kinds=("U2 wedge",)), **known).difference == 0.0
    both = {"with": scores(worse, **about), "without": scores(worse, **about)}
    assert held(shift, **both).difference == 0.0


def test_rejectors_are_compared_by_the_area_under_risk_against_coverage():
    table = scores(errors(0.6), blocks=60)
    is_false = ~table["is_right"].to_numpy(bool)
    sure = table.assign(p_right=np.where(is_false, 0.1, 0.9))
    blind = table.assign(p_right=np.random.default_rng(2).random(len(table)))
    contrast = Contrast(
        name="rejection",
        first="mine x logistic",
        second="mine x margin",
        suites=("occlusion",),
        metric="aurc",
        min_effect=0.2,
    )
    judged = {("mine", "logistic"): sure, ("mine", "margin"): blind}
    found = held(contrast, judged)
    assert found.difference < found.hi < 0
    assert found.verdict == "mine x logistic is better, by as much as matters"
    same = held(replace(contrast, first="mine x margin"), judged)
    assert same.outcome == "equal"


def test_an_area_that_is_not_defined_decides_nothing_and_loosens_no_other_test():
    right = scores(np.zeros(60), blocks=60)  # without a false answer there is no AUROC
    judged = {("mine", name): right.assign(p_right=share) for name, share in (("logistic", 0.9), ("margin", 0.5))}
    sides = {"first": "mine x logistic", "second": "mine x margin"}
    undefined = replace(CONTRAST, name="rejection", metric="auroc", **sides)
    tables = {"with": scores(errors(0.62), blocks=60), "without": scores(errors(0.58), blocks=60)}
    area, graph = evaluate_contrasts([undefined, CONTRAST], tables, judged, draws=400)
    assert (area.outcome, area.p_holm) == ("not decided", 1.0)
    assert graph.p_holm == pytest.approx(min(1.0, 2 * graph.p_places))


def test_holm_is_over_all_that_were_registered():
    better, worse = errors(0.62), errors(0.58)
    tables = {"with": scores(better, blocks=60), "without": scores(worse, blocks=60)}
    alone = evaluate_contrasts([CONTRAST], tables, {}, draws=400)[0]
    both = evaluate_contrasts([replace(CONTRAST, name=name) for name in "ab"], tables, {}, draws=400)
    assert both[0].p_holm == pytest.approx(min(1.0, 2 * alone.p_holm))


def test_an_unknown_method_is_refused_by_name():
    with pytest.raises(
        ConfigError, match=r"contrast 'graph' names 'without', which is not on the board: there is with"
    ):
        held(CONTRAST, **{"with": scores([1.0])})
