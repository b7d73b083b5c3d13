# SPDX-License-Identifier: Apache-2.0
"""A query of twins asks for one of two places: its disc holds both, and says whether a plain search lists both."""

import datetime as dt
from dataclasses import replace

import geopandas as gpd
import numpy as np
import pytest
import shapely

from sasgeo_bench.core.errors import ConfigError
from sasgeo_bench.geometry.grid import Grid
from sasgeo_bench.geometry.pose import Pose, Prior
from sasgeo_bench.regions.evidence import LayerBits
from sasgeo_bench.tasks.query import PriorGroup
from sasgeo_bench.tasks.sampling import make_prior
from sasgeo_bench.tasks.state import State
from sasgeo_bench.tasks.suites.all_suites import EVERY_SUITE
from sasgeo_bench.tasks.suites.rivals import RivalCheck, field_of, kind_of, plain_modes
from sasgeo_bench.tasks.suites.twins import RIVAL_M, TWIN_GROUP

RIVALLED = ("topology-twins", "instance-twins", "grade-separation", "volatile-lure")
HERE = Pose(easting_m=0.0, northing_m=0.0, yaw_deg=30.0)
THERE = (640.0, -480.0)  # as far as a twin may be


def rng(seed):
    return np.random.default_rng(seed)


# The disc


def test_a_disc_holds_the_place_and_all_its_rivals():
    for seed in range(200):
        center_m = np.array(make_prior(HERE, TWIN_GROUP, rng=rng(seed), rivals_m=[THERE, (300.0, 300.0)]).center_m)
        for place in ((0.0, 0.0), THERE, (300.0, 300.0)):
            assert np.hypot(*(center_m - place)) <= TWIN_GROUP.radius_m


def test_a_disc_is_the_same_whichever_of_both_places_is_the_true_one():
    for seed in range(50):
        swapped = replace(HERE, easting_m=THERE[0], northing_m=THERE[1])
        one = make_prior(HERE, TWIN_GROUP, rng=rng(seed), rivals_m=[THERE])
        assert one == make_prior(swapped, TWIN_GROUP, rng=rng(seed), rivals_m=[(0.0, 0.0)])


def test_the_centre_of_a_disc_is_uniform_over_the_places_that_hold_both():
    rival = np.array((600.0, 0.0))
    centres = np.array(
        [make_prior(HERE, TWIN_GROUP, rng=rng(seed), rivals_m=[tuple(rival)]).center_m for seed in range(2000)]
    )
    nearer = np.hypot(*centres.T) < np.hypot(*(centres - rival).T)
    assert nearer.mean() == pytest.approx(0.5, abs=0.04)

    def lens(radius_m):
        """Area where two discs 600 m apart overlap."""
        return 2 * radius_m**2 * np.arccos(300 / radius_m) - 300 * np.sqrt(4 * radius_m**2 - 600**2)

    for radius_m in (350.0, 400.0, 450.0):
        inside = (np.hypot(*centres.T) < radius_m) & (np.hypot(*(centres - rival).T) < radius_m)
        assert inside.mean() == pytest.approx(lens(radius_m) / lens(500.0), abs=0.04)


def test_rivals_move_the_disc_and_nothing_else():
    plain = make_prior(HERE, TWIN_GROUP, rng=rng(3))
    assert replace(make_prior(HERE, TWIN_GROUP, rng=rng(3), rivals_m=[THERE]), center_m=plain.center_m) == plain
    anywhere = replace(TWIN_GROUP, radius_m=None)
    assert make_prior(HERE, anywhere, rng=rng(3), rivals_m=[THERE]).center_m is None


def test_a_disc_that_cannot_hold_both_places_is_refused():
    with pytest.raises(ConfigError, match="no disc of 250 m holds a place and all its twins"):
        make_prior(HERE, replace(TWIN_GROUP, radius_m=250.0), rng=rng(0), rivals_m=[THERE])


@pytest.mark.parametrize("name", RIVALLED)
def test_a_suite_of_twins_refuses_a_disc_too_small_for_any_of_its_pairs(name):
    suite = EVERY_SUITE[name]
    for wide in ("r500-weak-s3", "r2000-known-s3", "rnone-unknown-s15"):
        assert suite.refusal(PriorGroup.parse(wide)) is None
    for narrow in ("r100-weak-s3", "r250-known-s10"):
        assert suite.refusal(PriorGroup.parse(narrow)).endswith("use r500 or more, or leave --prior out")


@pytest.mark.parametrize("name", RIVALLED)
def test_twins_lie_within_reach_of_one_disc(carried, name):
    made = carried(name)
    for site in made.sites:
        for twin in made.scene.twins[site.index]:
            assert np.hypot(*np.subtract(twin, site.en_m)) <= RIVAL_M


# The list


def town(*, rival=True, side=600, patch=112):
    """A map of random blocks of 8 m, on which a square repeats elsewhere, or is full there."""
    cells = np.kron(rng(0).random((2, side // 8, side // 8)) < 0.3, np.ones((1, 8, 8))).astype(np.uint8)
    copy = cells[:, 80 : 80 + patch, 96 : 96 + patch] if rival else 1
    cells[:, 400 : 400 + patch, 400 : 400 + patch] = copy
    nothing = gpd.GeoDataFrame({"class": []}, geometry=gpd.GeoSeries([], crs="EPSG:32632"))
    return State(
        region="here",
        date=dt.date(2025, 1, 1),
        grid=Grid(epsg=32632, west_m=0.0, north_m=float(side), cell_size_m=1.0, rows=side, cols=side),
        classes=("building", "water"),
        bits=LayerBits.of(cells),
        features=nothing,
        graph=None,
        coverage=shapely.box(0, 0, side, side),
    )


TRUTH = Pose(easting_m=152.0, northing_m=464.0, yaw_deg=0.0)
PLACE, RIVAL = (152.0, 464.0), (456.0, 144.0)
PRIOR = Prior(center_m=(304.0, 304.0), radius_m=250.0, yaw_deg=2.0, yaw_sigma_deg=4.0, scale_sigma=0.01)


def seen(state):
    return state.view(TRUTH, size_cells=96, cell_size_m=1.0)


def measure(state, prior=PRIOR):
    return RivalCheck().measure(state, seen(state), prior, truth_m=PLACE, rivals_m=[RIVAL])


def test_a_search_lists_a_place_and_its_copy_with_about_one_score():
    given = measure(town())
    assert (given["rivals"], given["rivals_in_disc"], given["rivals_listed"], given["truth_listed"]) == (1, 1, 1, 1)
    assert given["rival_lead"] == pytest.approx(0, abs=0.01)
    assert kind_of("stress", "G2", given) == "G2"


def test_a_rival_that_no_search_would_list_makes_a_stress_another_kind():
    given = measure(town(rival=False))
    assert (given["rivals_listed"], given["truth_listed"]) == (0, 1)
    assert "rival_lead" not in given
    assert kind_of("stress", "G2", given) == "unrivalled G2"
    assert {kind_of(role, "k", given) for role in ("control", "falsifier")} == {"k"}


def test_a_place_that_no_search_would_list_makes_a_stress_another_kind_too():
    state = town()
    full = replace(
        state, bits=LayerBits(bits=np.where(np.arange(600)[:, None] < 220, np.uint32(3), state.bits.bits), count=2)
    )
    given = RivalCheck().measure(full, seen(state), PRIOR, truth_m=PLACE, rivals_m=[RIVAL])
    assert (given["rivals_listed"], given["truth_listed"]) == (1, 0)
    assert kind_of("stress", "S2", given) == "unrivalled S2"


def test_a_rival_outside_the_disc_is_counted_as_such():
    given = measure(town(), replace(PRIOR, center_m=(152.0, 444.0), radius_m=60.0))
    assert (given["rivals_in_disc"], given["rivals_listed"], given["truth_listed"]) == (0, 0, 1)


def test_the_score_of_a_view_without_error_is_one_at_its_place_and_that_of_its_opposite_negative():
    state = town()
    exact = replace(PRIOR, yaw_deg=0.0, yaw_sigma_deg=1.0, scale_sigma=0.0)
    best = plain_modes(state, seen(state), exact)[0]
    assert best.score == pytest.approx(1, abs=0.03)
    opposite = seen(state).replace(1 - seen(state).cells)
    near = replace(exact, center_m=PLACE, radius_m=1.0)
    assert plain_modes(state, opposite, near)[0].score < -0.5


def test_unknown_cells_count_neither_way():
    state = town()
    cells = seen(state).cells.copy()
    cells[:, :40] = 2
    assert plain_modes(state, seen(state).replace(cells), PRIOR)[0].score == pytest.approx(1, abs=0.05)


def test_the_map_around_a_disc_is_that_of_the_whole_map_and_unknown_beyond_it():
    state = town()
    whole = field_of(state, state.classes, replace(PRIOR, center_m=None, radius_m=None), reach_m=50.0)
    part = field_of(state, state.classes, replace(PRIOR, center_m=(340.0, 260.0)), reach_m=50.0)
    assert part.grid.cell_size_m == whole.grid.cell_size_m == 2.0
    row, col = whole.grid.to_cells(part.grid.to_centres_m(np.array([[0, 0]])))[0]
    high, wide = 300 - row, 300 - col
    np.testing.assert_array_equal(part.layers[:, :high, :wide], whole.layers[:, row:, col:])
    assert not part.known[high:].any()
    corner = field_of(state, state.classes, replace(PRIOR, center_m=(0.0, 0.0)), reach_m=50.0)
    half = corner.known.shape[0] // 2
    assert (corner.known[:half, half:] == 255).all()
    assert not corner.known[half:].any()
    assert not corner.layers[:, half:].any()


def test_views_that_show_the_same_are_searched_once(monkeypatch):
    asked = []
    monkeypatch.setattr("sasgeo_bench.tasks.suites.rivals.plain_modes", lambda *words: asked.append(words) or ())
    check, state = RivalCheck(), town()
    for prior in (PRIOR, PRIOR, replace(PRIOR, radius_m=240.0)):
        check.measure(state, seen(state), prior, truth_m=PLACE, rivals_m=[RIVAL])
    assert len(asked) == 2
