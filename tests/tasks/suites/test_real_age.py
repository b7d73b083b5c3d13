# SPDX-License-Identifier: Apache-2.0
"""Real ageing: each age is searched in the map nearest to it, and only where one is near enough."""

import datetime as dt
from dataclasses import replace
from functools import partial

import numpy as np
import pytest

from sasgeo_bench.tasks.suites.ages import age_years, has_age, map_of_age
from sasgeo_bench.tasks.suites.all_suites import SUITES
from sasgeo_bench.tasks.suites.base import Seeds, changed_share
from sasgeo_bench.tasks.suites.sites import choose_sites

SUITE = SUITES["real-age"]


@pytest.fixture
def dated(scene):
    """The suburb with older maps of the ages given, in years."""
    town = scene("town-suburb")

    def of_ages(*years):
        today = town.world.date
        states = (
            replace(town.map, region=f"old-{age:g}", date=today - dt.timedelta(days=round(365.25 * age)))
            for age in sorted(years, reverse=True)
        )
        return replace(town, others=tuple(states))

    return of_ages


def test_the_map_of_an_age_is_the_nearest_by_ratio(dated):
    town = dated(1.5, 4.0, 12.0)
    assert [map_of_age(town, years).region for years in (2.0, 5.0, 10.0)] == ["old-1.5", "old-4", "old-12"]
    assert map_of_age(dated(2.0, 12.0), 5.0).region == "old-12"  # 2.4 times as old, not 2.5 times as young
    assert age_years(town.others[0], town.world) == pytest.approx(12, abs=0.01)


@pytest.mark.parametrize(("age", "can"), [(7.9, False), (8.1, True), (10.0, True), (16.5, True), (17.0, False)])
def test_a_date_too_far_from_an_age_does_not_stand_for_it(dated, age, can):
    assert has_age(dated(age), 10.0) == can
    usable = {(item.role, item.strength) for item in SUITE.usable(dated(age)) if item.strength in (0.0, 10.0)}
    assert (("stress", 10.0) in usable) == can
    assert ("control", 0.0) in usable


def test_a_place_with_no_date_of_about_the_right_age_says_so(dated):
    assert "no older extract of about 2, 5, 10 years" in (SUITE.lack(dated(0.5)) or "")
    assert SUITE.lack(dated(2.0)) is None


def test_controls_search_the_map_of_the_day_and_stresses_an_older_one(carried):
    made = carried("real-age")
    for variant in made.suite.variants:
        searched = made.scene.state(made.suite.map_region(made.scene, variant))
        assert (searched is made.scene.map) == (variant.role == "control")
        for site in made.sites:
            draft = made.draw(site, variant)
            views = [
                state.view(site.pose, size_cells=variant.view_cells, cell_size_m=1.0)
                for state in (made.scene.world, searched)
            ]
            assert draft.changed_share == changed_share(*views)
            assert draft.measured["age_years"] == pytest.approx(age_years(searched, made.scene.world))


def test_a_site_was_mapped_on_every_older_map_that_is_searched(dated):
    town = dated(2.0, 5.0)
    seeds = Seeds(root=0, names=("town-suburb", "real-age"))
    choose = partial(choose_sites, suite=SUITE, count=6, seeds=seeds, group=SUITE.card.group, may_be_fewer=True)
    northings_m = [site.en_m[1] for site in choose(town)]
    middle_m = float(np.mean(northings_m))
    old = town.others[0]
    bits = old.bits.bits.copy()
    bits[: int(old.grid.to_cells(np.array([[0.0, middle_m]]))[0, 0])] = 0  # the north was not mapped five years ago
    empty = replace(town, others=(replace(old, bits=replace(old.bits, bits=bits)), town.others[1]))
    assert max(northings_m) > middle_m + SUITE.main_side_m / 2
    assert max(site.en_m[1] for site in choose(empty)) < middle_m + SUITE.main_side_m / 2
