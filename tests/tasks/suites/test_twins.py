# SPDX-License-Identifier: Apache-2.0
"""Twin suites: a place and its twin look alike but for one change, and neither rim nor falsifier tells them apart."""

from dataclasses import replace

import numpy as np
import pytest
import shapely

from sasgeo_bench.regions.evidence import UNKNOWN, Evidence
from sasgeo_bench.regions.graph import build_graph
from sasgeo_bench.tasks.query import CEILING
from sasgeo_bench.tasks.suites.ages import STABLE, VOLATILE
from sasgeo_bench.tasks.suites.base import Seeds, ViewRequest, changed_share
from sasgeo_bench.tasks.suites.mining import min_distance_m
from sasgeo_bench.tasks.suites.sites import choose_sites
from sasgeo_bench.tasks.suites.twins import OFF_M, CopySpacing, either, find_targets
from sasgeo_bench.tasks.suites.vectors import VectorNoise, perceive_vectors
from sasgeo_bench.tasks.twin import around, paste
from sasgeo_bench.tasks.vectors import as_features
from tests.slow import rest_slow
from tests.tasks.suites.conftest import ROOTS

TWINS = ("topology-twins", "instance-twins", "grade-separation", "volatile-lure", "alias")
CHANGED = ("topology-twins", "instance-twins", "grade-separation")  # by one change, which vectors show
EXACT = VectorNoise(missed_share=0.0, gap_share=0.0, shift_m=0.0)


def pairs(made):
    """Every site with the pose of each of its twins."""
    return [
        (site, replace(site.pose, easting_m=easting_m, northing_m=northing_m))
        for site in made.sites
        for easting_m, northing_m in made.scene.twins[site.index]
    ]


def is_changed(site):
    """Whether the true place is the changed one: by turns at the original, and the other way round at its copy."""
    return (site.index % 2 == 1) != site.is_copy


def original_of(made, site):
    """Where on the map as it was the site and its copies come from."""
    easting_m, northing_m = (
        made.scene.twins[site.index][0] if site.is_copy else (site.pose.easting_m, site.pose.northing_m)
    )
    return replace(site.pose, easting_m=easting_m, northing_m=northing_m)


def view(state, pose, size_cells=192):
    return state.view(pose, size_cells=size_cells, cell_size_m=1.0)


def drawn(made, pose):
    return perceive_vectors(made.scene.map, pose, side_m=192.0, noise=EXACT, rng=np.random.default_rng(0))


def amount(made, pose):
    """What the change of a suite makes more of: houses, junctions of four arms taken for level, loose ends."""
    vectors = drawn(made, pose)
    if made.suite.card.name == "instance-twins":
        return int((vectors["class"] == "building").sum())
    nodes = build_graph(as_features(vectors)).nodes
    is_meeting = (nodes["kind"] == "intersection").to_numpy()
    if made.suite.card.name == "grade-separation":
        return int(is_meeting.sum())
    inside = np.abs(shapely.get_coordinates(nodes.geometry.to_numpy())).max(axis=1) < 90
    return int((is_meeting & inside & (nodes["degree"] == 3).to_numpy()).sum()) * 1000 + int(
        ((nodes["kind"] == "dead_end").to_numpy() & inside).sum()
    )


@pytest.mark.parametrize("name", TWINS)
def test_copies_lie_on_mapped_ground_off_every_site_and_far_from_their_own(carried, name):
    made = carried(name)
    clear_m = made.suite.clear_m(made.scene)
    copies = np.array([(pose.easting_m, pose.northing_m) for _, pose in pairs(made)])
    sites = np.array([(site.pose.easting_m, site.pose.northing_m) for site in made.sites])
    assert len(copies) == len(sites) * made.suite.copies
    everything = np.vstack((copies, sites))
    apart_m = np.hypot(*(everything[:, None] - everything[None]).transpose(2, 0, 1))
    assert apart_m[~np.eye(len(everything), dtype=bool)].min() > 2 * clear_m - 1e-6
    for site in made.sites:
        own = np.array([(site.pose.easting_m, site.pose.northing_m), *made.scene.twins[site.index]])
        apart_m = np.hypot(*(own[:, None] - own[None]).transpose(2, 0, 1))
        assert apart_m[~np.eye(len(own), dtype=bool)].min() >= min_distance_m(96.0)
    for site, pose in pairs(made):
        for at in (site.pose, pose):
            assert not (view(made.plain.map, at).cells == UNKNOWN).any()


@pytest.mark.parametrize("name", TWINS)
def test_copies_lie_a_whole_number_of_cells_away(carried, name):
    for site, pose in pairs(carried(name)):
        steps = np.array([pose.easting_m - site.pose.easting_m, pose.northing_m - site.pose.northing_m])
        assert steps == pytest.approx(np.rint(steps), abs=1e-6)


@pytest.mark.parametrize("name", ["instance-twins", "alias"])
def test_masks_of_a_place_and_its_copy_are_the_same_cell_by_cell(carried, name, root):
    made = carried(name, root)
    for site, pose in pairs(made):
        truth, twin = view(made.scene.map, site.pose), view(made.scene.map, pose)
        assert (truth.cells == 1).any()
        np.testing.assert_array_equal(truth.cells, twin.cells)


def test_masks_of_an_overpass_and_a_level_junction_are_the_same_but_for_the_bridge(carried, root):
    made = carried("grade-separation", root)
    for site, pose in pairs(made):
        truth, twin = view(made.scene.map, site.pose), view(made.scene.map, pose)
        differ = {name for name in truth.classes if (truth.layer(name) != twin.layer(name)).any()}
        assert differ == {"bridge"}


def test_masks_of_topology_twins_are_nearly_the_same(carried, root):
    made = carried("topology-twins", root)
    for site, pose in pairs(made):
        truth, twin = view(made.scene.map, site.pose), view(made.scene.map, pose)
        assert 0 < changed_share(truth, twin) < 0.08
        differ = {name for name in truth.classes if (truth.layer(name) != twin.layer(name)).any()}
        assert differ <= {"road_major", "road_minor", "path_track"}


@pytest.mark.parametrize("name", CHANGED)
def test_a_twin_differs_from_its_place_by_its_vectors(carried, name, root):
    made = carried(name, root)
    for site, pose in pairs(made):
        assert amount(made, site.pose) != amount(made, pose)


@pytest.mark.parametrize("name", ["topology-twins", "instance-twins"])
def test_at_every_second_site_the_change_is_at_the_original_and_not_at_its_copy(carried, name, root):
    made = carried(name, root)
    assert {site.index % 2 for site in made.sites} == {0, 1}
    for site, pose in pairs(made):
        original = original_of(made, site)
        as_mapped = perceive_vectors(made.plain.map, original, side_m=192.0, noise=EXACT, rng=np.random.default_rng(0))
        plain_at, changed_at = (pose, site.pose) if is_changed(site) else (site.pose, pose)
        assert same_shapes(drawn(made, plain_at), as_mapped)
        assert not same_shapes(drawn(made, changed_at), as_mapped)


def same_shapes(one, other):
    """Whether two tables of vectors show the same; a cut rim is beyond their view."""
    for name in set(one["class"]) | set(other["class"]):
        shapes = [item.geometry[(item["class"] == name).to_numpy()].to_numpy() for item in (one, other)]
        lengths_m = [shapely.length(part).sum() for part in shapes]
        if abs(lengths_m[0] - lengths_m[1]) > 0.005 * lengths_m[0]:
            return False
        if shapely.hausdorff_distance(*(shapely.union_all(part) for part in shapes)) > 0.25:
            return False
    return True


# Which of two places is the original


def lots(made, roots=24):
    """Sites before and after the lot, for many seeds: the map is not edited, where pastes would lie is enough."""
    group = made.suite.card.group
    for root in range(roots):
        seeds = Seeds(root=root, names=("lots",))
        sites = choose_sites(made.plain, made.suite, count=8, seeds=seeds, group=group, may_be_fewer=True)
        edit = made.suite.edit(made.plain, sites, seeds)
        before = {site.index: site for site in sites}
        for site in edit.sites:
            yield before[site.index], site, edit


@pytest.mark.parametrize("name", rest_slow(TWINS, but=2))
def test_by_lot_the_true_place_is_any_of_the_places_that_look_alike(carried, name):
    made = carried(name)
    found = list(lots(made))
    share = 1 / (1 + made.suite.copies)
    assert len(found) >= 20
    is_original = np.array([not site.is_copy for _, site, _ in found])
    assert is_original.mean() == pytest.approx(share, abs=2.6 * np.sqrt(share * (1 - share) / len(found)))
    bounds = {block.id: block.bounds_m for block in made.plain.blocks}
    for before, site, edit in found:
        west, south, east, north = bounds[site.block]
        assert west <= site.pose.easting_m < east
        assert south <= site.pose.northing_m < north
        assert (site.index, site.density) == (before.index, before.density)
        assert (site.pose.yaw_deg, site.pose.scale) == (before.pose.yaw_deg, before.pose.scale)
        here = (site.pose.easting_m, site.pose.northing_m)
        original = (before.pose.easting_m, before.pose.northing_m)
        assert len(set(edit.twins[site.index])) == made.suite.copies
        assert here not in edit.twins[site.index]
        if site.is_copy:
            assert edit.twins[site.index][0] == original
        else:
            assert site == before
        # Whatever is true, one paste ends at every copy and none that is unchanged at the original.
        off = {tuple(np.subtract(item.target_m, item.source_m).round(6)) for item in edit.map_pastes}
        ends = [tuple(np.subtract(at, original).round(6)) for at in (here, *edit.twins[site.index]) if at != original]
        assert set(ends) <= off


@pytest.mark.parametrize("name", ["topology-twins", "alias"])
def test_copies_that_lie_in_no_block_of_the_split_are_never_the_true_place(carried, name):
    made = carried(name)
    west, south, east, north = made.plain.map.grid.bounds_m
    half = replace(made.plain.blocks[0], bounds_m=(west, south, (west + east) / 2, north))
    in_half = replace(made, plain=replace(made.plain, blocks=(half,)))
    found = list(lots(in_half))
    assert {site.is_copy for _, site, _ in found} == {True, False}
    assert all(half.holds((site.pose.easting_m, site.pose.northing_m)) for _, site, _ in found)


def rim_ends(features, place, suite, scene):
    """Roads that end about where a disc around a place may have been cut: what a copy has, and the original not."""
    roads = features[features["class"].isin(["road_major", "road_minor", "path_track"]).to_numpy()]
    nodes = build_graph(roads).nodes
    at = shapely.get_coordinates(nodes.geometry.to_numpy()[(nodes["kind"] == "dead_end").to_numpy()])
    off_m = np.hypot(*(at - place).T)
    return int((np.abs(off_m - suite.radius_m(scene)) < OFF_M).sum())


@pytest.mark.slow
def test_roads_that_go_on_across_the_rim_tell_the_original_but_not_the_truth(carried):
    made = carried("topology-twins")
    group, tells_original, tells_truth = made.suite.card.group, [], []
    for root in range(10):
        seeds = Seeds(root=root, names=("rims",))
        sites = choose_sites(made.plain, made.suite, count=4, seeds=seeds, group=group, may_be_fewer=True)
        edit = made.suite.edit(made.plain, sites, seeds)
        after = paste(made.plain.map.features, edit.map_pastes)
        for site in edit.sites:
            here = (site.pose.easting_m, site.pose.northing_m)
            ends = [rim_ends(after, at, made.suite, made.plain) for at in (here, edit.twins[site.index][0])]
            points = 0.5 if ends[0] == ends[1] else float(ends[0] < ends[1])
            tells_truth.append(points)
            if site.index % 2 == 0:  # at the others both are cut
                tells_original.append(1 - points if site.is_copy else points)
    assert np.mean(tells_original) > 0.85
    assert 0.3 < np.mean(tells_truth) < 0.7


@pytest.mark.parametrize("name", TWINS)
def test_discs_that_are_copied_do_not_have_the_site_in_their_middle(carried, name):
    made = carried(name)
    found = list(lots(made, 10))
    off_m = []
    for before, _, edit in found:
        here = np.array([before.pose.easting_m, before.pose.northing_m])
        off_m.append(min(np.hypot(*(np.array(item.source_m) - here)) for item in edit.map_pastes))
    assert max(off_m) <= OFF_M + 1e-6
    assert np.mean(np.array(off_m) < OFF_M / 2) == pytest.approx(0.25, abs=0.22)  # by area
    assert {item.radius_m for *_, edit in found for item in edit.map_pastes} == {
        carried(name).scene.view_reach_m + OFF_M
    }


@pytest.mark.parametrize("name", ["topology-twins", "instance-twins", "grade-separation", "alias"])
def test_all_that_any_view_shows_is_within_what_is_copied(carried, name, root):
    made = carried(name, root)
    largest = 1 + 2 * made.suite.card.group.scale_sigma
    for site, pose in pairs(made):
        for yaw_deg in (0.0, 45.0, site.pose.yaw_deg):
            truth, twin = (
                view(made.scene.map, replace(at, yaw_deg=yaw_deg, scale=largest)) for at in (site.pose, pose)
            )
            differ = {layer for layer in truth.classes if (truth.layer(layer) != twin.layer(layer)).any()}
            roads = {"road_major", "road_minor", "path_track"} if name == "topology-twins" else set()
            assert differ <= roads | ({"bridge"} if name == "grade-separation" else set())


def agreement(seen, mapped):
    """Share of cells that are as mapped: the plainest of scores."""
    known = (seen.cells != UNKNOWN) & (mapped.cells != UNKNOWN)
    return float((known & (seen.cells == mapped.cells)).sum() / known.sum())


def test_agreement_of_cells_at_the_exact_pose_does_not_tell_topology_twins_apart(carried):
    made = carried("topology-twins")
    control = next(item for item in made.suite.variants if item.role == "control")
    prefers_truth = []
    for site, pose in pairs(made):
        # Either of the two as the true place: perception overlooks more than it makes up, so one of them is likelier.
        for true, other in ((site.pose, pose), (pose, site.pose)):
            twins = {site.index: ((other.easting_m, other.northing_m),)}
            of = replace(made, scene=replace(made.scene, twins=twins))
            truth, twin = (view(made.scene.map, at) for at in (true, other))
            for root in range(15):
                seen = replace(of, seeds=replace(made.seeds, root=root)).draw(replace(site, pose=true), control)
                gain = agreement(seen.evidence, truth) - agreement(seen.evidence, twin)
                prefers_truth.append((np.sign(gain) + 1) / 2)
    assert np.mean(prefers_truth) == pytest.approx(0.5, abs=0.2)


def test_layers_of_topology_twins_show_every_junction_as_at_one_of_both_places():
    plain, changed = np.zeros((2, 1, 60, 60), dtype=np.uint8)
    for row in (10, 30, 50):
        for col in (10, 30, 50):
            changed[0, row : row + 2, col : col + 3] = 1
    own, other = (Evidence(classes=("road_minor",), cells=cells, cell_size_m=1.0) for cells in (plain, changed))
    shown = []
    for seed in range(40):
        cells = either(own, other, np.random.default_rng(seed)).cells
        patches = [cells[0, row : row + 2, col : col + 3] for row in (10, 30, 50) for col in (10, 30, 50)]
        assert all(patch.min() == patch.max() for patch in patches)
        assert cells.sum() == sum(patch.sum() for patch in patches)
        shown.append([patch.max() for patch in patches])
    assert np.mean(shown) == pytest.approx(0.5, abs=0.08)
    assert np.abs(np.corrcoef(np.array(shown).T) - np.eye(9)).max() < 0.6  # each by itself


# Falsifiers


@pytest.mark.parametrize("name", ["topology-twins", "grade-separation"])
def test_vectors_of_the_falsifier_are_of_the_same_one_of_both_places_whichever_is_seen(carried, name, root):
    made = carried(name, root)
    for site, pose in pairs(made):
        plain_at, changed_at = (pose, site.pose) if is_changed(site) else (site.pose, pose)
        wanted = changed_at if made.suite.falsifier_sees_change else plain_at
        shot = ViewRequest(scene=made.scene, site=site, variant=made.suite.variants[0], seeds=made.seeds)
        taken = made.suite._uninformative_pose(shot)
        assert (taken.easting_m, taken.northing_m) == (wanted.easting_m, wanted.northing_m)
        assert taken.yaw_deg == site.pose.yaw_deg


@pytest.mark.parametrize("name", [*CHANGED, "volatile-lure"])
def test_nothing_but_a_guess_is_left_where_no_vector_tells_the_two_places_apart(carried, name, root):
    made = carried(name, root)
    for variant in made.suite.variants:
        is_guess = name in CHANGED and variant.role != "stress"
        ceilings = {made.draw(site, variant).measured.get(CEILING, 1.0) for site in made.sites}
        assert ceilings == {0.5 if is_guess else 1.0}


def test_vectors_of_the_instance_falsifier_follow_from_the_mask(carried, root):
    made = carried("instance-twins", root)
    falsifier = next(item for item in made.suite.variants if item.role == "falsifier")
    for site in made.sites:
        draft = made.draw(site, falsifier)
        mask = draft.evidence.layer("building") == 1
        assert draft.vectors.geometry.area.sum() == pytest.approx(mask.sum())


def test_no_view_of_a_grade_separation_shows_the_bridge_layer(carried, root):
    made = carried("grade-separation", root)
    for variant in made.suite.variants:
        for site in made.sites:
            draft = made.draw(site, variant)
            assert (draft.evidence.layer("bridge") == UNKNOWN).all()
            if variant.role == "falsifier":
                assert not draft.vectors["is_bridge"].any()
                assert (draft.vectors["level"] == 0).all()
            if variant.role == "stress":
                assert draft.vectors["is_bridge"].any() != is_changed(site)


# The lure


def test_a_changed_world_agrees_with_its_place_on_what_is_stable_and_with_the_lure_on_the_rest(carried, root):
    made = carried("volatile-lure", root)
    ways = {site.is_copy for site in made.sites}
    assert len(ways) == 2 or root != ROOTS[0]  # it works both ways; of few sites, by lot, all may be copies
    for site, pose in pairs(made):
        world, truth, lure = (
            view(state, at)
            for state, at in ((made.scene.world, site.pose), (made.scene.map, site.pose), (made.scene.map, pose))
        )
        assert any((world.layer(name) != truth.layer(name)).any() for name in VOLATILE)
        for name in VOLATILE:
            np.testing.assert_array_equal(world.layer(name), lure.layer(name))
        for name in STABLE:
            np.testing.assert_array_equal(world.layer(name), truth.layer(name))
    for is_copy in ways:
        assert any(
            (view(made.scene.map, site.pose).layer(name) != view(made.scene.map, pose).layer(name)).any()
            for site, pose in pairs(made)
            for name in STABLE
            if site.is_copy == is_copy
        )


def test_without_a_change_the_original_of_a_lure_is_as_it_was(carried, root):
    made = carried("volatile-lure", root)
    for site in made.sites:
        at = original_of(made, site)
        np.testing.assert_array_equal(view(made.scene.map, at).cells, view(made.plain.map, at).cells)


def test_a_lure_has_as_much_of_everything_as_its_place(carried, root):
    made = carried("volatile-lure", root)
    for site in made.sites:
        original = original_of(made, site)
        item = next(
            item
            for item in made.edit.map_pastes
            if np.hypot(*np.subtract(item.source_m, (original.easting_m, original.northing_m))) <= OFF_M
        )
        places = [around(made.scene.map.features, at, item.radius_m - 1) for at in (item.source_m, item.target_m)]
        for name in (*VOLATILE, *STABLE):
            areas, lengths = (
                [getattr(part.geometry[(part["class"] == name).to_numpy()], what).sum() for part in places]
                for what in ("area", "length")
            )
            assert areas[0] == pytest.approx(areas[1], rel=0.01, abs=1.0)
            if not areas[0]:  # where a circle cuts an area its outline grows
                assert lengths[0] == pytest.approx(lengths[1], rel=0.01, abs=1.0)


# Where copies find no room


def test_sites_without_room_for_their_copies_are_left_out(scene, carried):
    suite, town = carried("alias").suite, scene("town-suburb")
    seeds = Seeds(root=1, names=())
    sites = choose_sites(town, suite, count=99, seeds=seeds, group=suite.card.group, may_be_fewer=True)
    clear_m, apart_m = suite.clear_m(town), min_distance_m(96.0)
    found = find_targets(town.map, sites, CopySpacing(clear_m=clear_m, spacing_m=apart_m), copies=1, seeds=seeds)
    assert len(found) < len(sites)
    assert {len(targets) for targets in found.values()} <= {1}
    edit = replace(suite, copies=1).edit(town, sites, seeds)
    assert set(edit.twins) == set(found) == {site.index for site in edit.sites}
    assert len(edit.map_pastes) == len(found)
