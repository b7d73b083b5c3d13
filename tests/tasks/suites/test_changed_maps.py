# SPDX-License-Identifier: Apache-2.0
"""Flights whose maps are changed: off the map and back, ground that the map shows twice, and room for both."""

from dataclasses import replace

import numpy as np
import pytest
import shapely

from sasgeo_bench.core.errors import ConfigError
from sasgeo_bench.regions.evidence import PRESENT, UNKNOWN
from sasgeo_bench.regions.region_files import read_region
from sasgeo_bench.tasks import flight_sampling
from sasgeo_bench.tasks.build import check_task, make_tasks
from sasgeo_bench.tasks.query import TWIN_EAST, TWIN_NORTH, PriorGroup
from sasgeo_bench.tasks.suites.all_suites import FLIGHT_SUITES
from sasgeo_bench.tasks.suites.flights import LOST, OFF_MAP, SHARES, Ground, lengths_within
from sasgeo_bench.tasks.suites.twins import RIVAL_M
from sasgeo_bench.tasks.task_files import read_truths
from sasgeo_bench.tasks.task_plan import TaskRequest, plan_requests

CHANGED = ("flight-off-map", "flight-alias")
TOWN = "town-suburb"


@pytest.fixture
def own_town(lay_towns, tmp_path):
    """A root of one's own to write to, with one small town in it."""
    return lay_towns(tmp_path / "out", TOWN)


def on_map(pairs):
    return np.array([truth.is_present for _, truth in pairs])


def places(pairs):
    return np.array([(truth.pose.easting_m, truth.pose.northing_m) for _, truth in pairs])


def searched(made, pairs):
    return made.airspace.scene.state(pairs[0][0].region)


def steps(pairs):
    return [query.step for query, _ in pairs]


@pytest.mark.parametrize("name", CHANGED)
def test_all_that_differs_between_variants_is_the_map(flown, name, root):
    made = flown(name, root)
    control = made.of("control")
    assert searched(made, control) is made.airspace.scene.map
    regions = {pairs[0][0].region for pairs in made.views.values()}
    assert len(regions) == len(made.views) == 3
    for pairs in made.views.values():
        assert [query.evidence.cells.tobytes() for query, _ in pairs] == [
            query.evidence.cells.tobytes() for query, _ in control
        ]
        assert pairs[0][0].prior == control[0][0].prior
        assert [step.increment for step in steps(pairs)] == [step.increment for step in steps(control)]


def test_a_flight_leaves_the_map_once_in_its_middle_and_comes_back(flown, root):
    made = flown("flight-off-map", root)
    control, stress, falsifier = (made.of(role) for role in ("control", "stress", "falsifier"))
    assert on_map(control).all()
    assert on_map(falsifier).all()
    off = np.flatnonzero(~on_map(stress))
    assert np.diff(off).max() == 1
    assert 2 < off[0] < off[-1] < len(stress) - 3
    state = searched(made, stress)
    for (_, truth), is_on in zip(stress, on_map(stress), strict=True):
        row, col = state.grid.to_cells(np.array([[truth.pose.easting_m, truth.pose.northing_m]]))[0]
        assert bool(state.known[row, col]) == is_on
    (off_m,) = {truth.measured[OFF_MAP] for _, truth in stress}
    assert off_m == pytest.approx(stress[0][1].strength, rel=0.35)
    assert off_m <= SHARES[1] * made.flight.length_m
    assert {truth.measured[OFF_MAP] for _, truth in (*control, *falsifier)} == {0.0}


def test_a_place_off_the_map_has_its_pose_and_its_distance_and_no_map_can_answer_it(flown):
    made = flown("flight-off-map")
    control, stress = made.of("control"), made.of("stress")
    np.testing.assert_array_equal(places(stress), places(control))
    assert [truth.measured["distance_m"] for _, truth in stress] == [
        truth.measured["distance_m"] for _, truth in control
    ]
    assert all("unanswerable" not in truth.measured for _, truth in stress if not truth.is_present)
    assert all(truth.measured["is_seen"] for _, truth in stress)


def test_the_map_of_the_falsifier_loses_as_much_where_no_view_of_the_flight_shows_it(flown, root):
    made = flown("flight-off-map", root)
    control, stress, falsifier = (made.of(role) for role in ("control", "stress", "falsifier"))
    lost = [searched(made, pairs).known.sum() for pairs in (control, stress, falsifier)]
    assert lost[0] - lost[1] == pytest.approx(lost[0] - lost[2], rel=0.01)
    assert lost[0] - lost[1] == pytest.approx(stress[0][1].measured[LOST], rel=0.01)  # cells of a metre
    variant = next(variant for variant in made.views if variant.role == "falsifier")
    for _, truth in falsifier:
        assert (variant.view(searched(made, falsifier), truth.pose).cells != UNKNOWN).all()


def test_what_a_map_lost_is_not_among_its_features_either(flown):
    made = flown("flight-off-map")
    state = searched(made, made.of("stress"))
    hole = made.flight.plot.stress.area
    assert not state.coverage.intersects(hole.buffer(-1.0))
    assert not state.features.geometry.intersects(hole.buffer(-1.0)).any()
    assert made.airspace.scene.map.features.geometry.intersects(hole).any()


def test_views_of_a_copied_stretch_are_the_same_at_both_places_and_later_ones_are_not(flown, root):
    made = flown("flight-alias", root)
    stress = made.of("stress")
    variant, state = next(variant for variant in made.views if variant.role == "stress"), searched(made, stress)
    is_copied = np.array([truth.measured["is_copied"] == 1 for _, truth in stress])
    flown_m = np.array([truth.measured["distance_m"] for _, truth in stress])
    assert is_copied[flown_m <= variant.strength].all()
    assert not is_copied[flown_m > 2 * variant.strength].any()
    east_m, north_m = made.flight.plot.copy_m
    for (_, truth), is_alike in zip(stress, is_copied, strict=True):
        copy = replace(truth.pose, easting_m=truth.pose.easting_m + east_m, northing_m=truth.pose.northing_m + north_m)
        here, there = (variant.view(state, pose) for pose in (truth.pose, copy))
        assert bool((here.cells == there.cells).all()) == is_alike
        assert (TWIN_EAST in truth.measured) == is_alike
        if is_alike:
            assert truth.measured["copy_likeness"] == 1.0
            assert (here.cells == PRESENT).any()
            assert (truth.measured[TWIN_EAST], truth.measured[TWIN_NORTH]) == (east_m, north_m)


def test_the_start_and_its_copy_both_lie_in_the_disc_and_no_view_shows_changed_ground(flown):
    made = flown("flight-alias")
    control = made.of("control")
    start_m, copy_m = places(control)[0], np.array(made.flight.plot.copy_m)
    prior = control[0][0].prior
    for place_m in (start_m, start_m + copy_m):
        assert np.hypot(*(place_m - prior.center_m)) <= prior.radius_m
    assert np.hypot(*copy_m) <= RIVAL_M
    for variant, pairs in made.views.items():
        for _, truth in pairs:
            views = [
                variant.view(state, truth.pose).cells for state in (searched(made, pairs), made.airspace.scene.world)
            ]
            np.testing.assert_array_equal(*views)


def test_the_mirror_image_of_the_falsifier_changes_the_same_ground_and_no_view_fits_it(flown, root):
    made = flown("flight-alias", root)
    plot, base = made.flight.plot, made.airspace.scene.map
    assert plot.stress.area.equals(plot.falsifier.area)
    differing = [(searched(made, made.of(role)).bits.bits != base.bits.bits).mean() for role in ("stress", "falsifier")]
    assert differing[0] == pytest.approx(differing[1], rel=0.3)
    assert max(truth.measured["copy_likeness"] for _, truth in made.of("falsifier")) < 0.5
    assert not any(truth.measured["is_copied"] for role in ("control", "falsifier") for _, truth in made.of(role))


def test_a_disc_that_cannot_hold_the_start_and_its_copy_is_refused():
    suite = FLIGHT_SUITES["flight-alias"]
    small, wide = (PriorGroup(radius_m=radius_m, yaw="weak", scale_sigma=0.03) for radius_m in (250.0, 2000.0))
    assert "use r500 or more" in suite.refusal(small)
    assert suite.refusal(wide) is None


def test_flown_lengths_in_an_area_add_up_and_are_none_outside():
    path = np.column_stack([np.arange(0.0, 1000.0, 50.0), np.zeros(20)])
    whole = lengths_within(shapely.box(-1, -1, 2000, 1), path, path[:, 0])
    assert whole.sum() == 950.0
    assert lengths_within(shapely.box(-1, 5, 2000, 6), path, path[:, 0]).sum() == 0.0


def test_ground_that_others_see_or_that_is_changed_for_them_is_not_free():
    seen_m = np.array([[0.0, 0.0], [0.0, 100.0]])
    ground = Ground(
        mapped=shapely.box(-2000, -2000, 2000, 2000),
        reach_m=100.0,
        cell_m=1.0,
        seen_m=seen_m,
        changed=(shapely.box(500, 500, 600, 600),),
    )
    assert ground.is_free(shapely.box(101, 0, 200, 100))
    assert not ground.is_free(shapely.box(99, 0, 200, 100))
    assert not ground.is_free(shapely.box(550, 550, 900, 900))
    assert not ground.is_free(shapely.box(101, 0, 200, 100), np.array([[250.0, 50.0]]))
    assert ground.admits(np.array([[399.0, 550.0]]))
    assert not ground.admits(np.array([[401.0, 550.0]]))


def test_the_map_of_a_stress_takes_turns_so_that_its_name_does_not_tell(flown):
    made = flown("flight-off-map")
    suite, scene = made.airspace.suite, made.airspace.scene
    by_role = {variant.role: variant for variant in made.views}
    maps = {role: [suite.map_of(scene, by_role[role], site) for site in range(4)] for role in by_role}
    assert set(maps["control"]) == {scene.map.region}
    assert maps["stress"][0] != maps["stress"][1]
    assert maps["stress"][:2] == maps["stress"][2:] == maps["falsifier"][:2][::-1]


def test_changed_maps_are_regions_of_their_own_and_their_tasks_hold_together(own_town, monkeypatch):
    name = "flight-off-map"
    monkeypatch.setattr(flight_sampling, "LENGTHS_M", (1000.0,))
    wanted = TaskRequest(suites=(name,), regions=(TOWN,), split="crossfit", count=1, seed=0, out=own_town)
    (request,) = plan_requests(wanted)
    made = make_tasks(request)
    names = [f"{TOWN}+{name}-1", f"{TOWN}+{name}-2"]
    assert sorted(item.folder.name for item in made) == sorted([TOWN, *names])
    for item in made:
        assert check_task(item) == []
        truths = list(read_truths(own_town / "truth" / name / item.folder.name))
        assert len({truth.role for truth in truths}) == 1
    base, *maps = (read_region(own_town / "regions" / item) for item in (TOWN, *names))
    for region in maps:
        cut = base.manifest.coverage.share - region.manifest.coverage.share
        lost_m2 = region.manifest.coverage.unknown_m2["cut away"]
        assert cut > 0.02
        assert lost_m2 == pytest.approx(cut * 1024**2, rel=1e-3)
        assert any(f"changed for suite {name}" in line for line in region.manifest.warnings)


def test_where_nothing_can_be_changed_the_request_gets_one_line_and_writes_no_map(own_town, monkeypatch):
    monkeypatch.setattr(flight_sampling, "LENGTHS_M", (1000.0,))
    monkeypatch.setattr("sasgeo_bench.tasks.suites.flights.STRETCHES_M", ())
    wanted = TaskRequest(suites=("flight-off-map",), regions=(TOWN,), split="crossfit", count=1, seed=0, out=own_town)
    (request,) = plan_requests(wanted)
    with pytest.raises(ConfigError, match="town-suburb has room for 0 of 1 flights of suite 'flight-off-map'"):
        make_tasks(request)
    assert not [path.name for path in (own_town / "regions").iterdir() if "+flight" in path.name and path.is_dir()]
