# SPDX-License-Identifier: Apache-2.0
"""What every suite must hold to: its stress is measured and grows, its falsifier is its control, its seed decides."""

from dataclasses import fields, replace

import numpy as np
import pytest

from sasgeo_bench.ageing.ratebook import load_ratebook, pool_rates
from sasgeo_bench.core.errors import ConfigError
from sasgeo_bench.osm.taxonomy import load_taxonomy
from sasgeo_bench.regions.evidence import PRESENT, UNKNOWN
from sasgeo_bench.tasks.perturbations.perception import Perception
from sasgeo_bench.tasks.state import DRAWN_CLASSES
from sasgeo_bench.tasks.suites.ages import after, ageing_of
from sasgeo_bench.tasks.suites.all_suites import SUITES
from sasgeo_bench.tasks.suites.base import ViewRequest
from sasgeo_bench.tasks.suites.mining import min_distance_m
from sasgeo_bench.tasks.suites.sites import choose_sites
from sasgeo_bench.tasks.suites.twins import VOLATILE, straight_places
from sasgeo_bench.tasks.suites.views import bent
from tests.slow import rest_slow
from tests.tasks.suites.conftest import ROOTS

# What is measured of a stress, and grows with its strength.
GROWS = {
    "clean": "cells_changed",
    "occlusion": "unknown_added",
    "false-unknown": "unknown_added",
    "local-warp": "cells_changed",
    "real-age": "changed_share",
    "synthetic-age": "changed_share",
    "growth": "changed_share",
    "season": "cells_changed",
    "stable-not-distinctive": "cells_changed",
    "telemetry": "cells_changed",
}
# Suites in whose stress the view itself is that of the control: the map, the vectors, the priors or the candidates are
# what differs.
SAME_VIEW = ("topology-twins", "instance-twins", "grade-separation", "no-priors", "real-age", "alias", "natural-twins")
NATURAL = ("natural-twins", "natural-absent")  # their falsifiers see nothing of what differs
ALL_UNKNOWN = "all unknown"


def same_vectors(one, other):
    if one is None or other is None:
        return one is other
    columns = ["class", "level", "is_bridge"]
    return one[columns].equals(other[columns]) and one.geometry.to_wkt().tolist() == other.geometry.to_wkt().tolist()


def same_drafts(one, other):
    rest = [item.name for item in fields(one) if item.name not in ("evidence", "vectors")]
    return (
        (one.evidence.cells == other.evidence.cells).all()
        and same_vectors(one.vectors, other.vectors)
        and all(getattr(one, name) == getattr(other, name) for name in rest)
    )


def stresses(made, role="stress"):
    return [item for item in made.suite.variants if item.role == role]


@pytest.mark.parametrize("name", rest_slow(SUITES, but=8))
def test_the_same_seed_gives_the_same_draft(carried, name):
    made = carried(name)
    smallest = {item.kind: item for item in sorted(made.suite.variants, key=lambda item: -item.view_cells)}
    for variant in smallest.values():
        assert same_drafts(made.draw(made.sites[0], variant), made.drawn(made.sites[0], variant))


@pytest.mark.parametrize("name", rest_slow(SUITES, but=8))
def test_another_seed_gives_other_errors_of_perception(carried, name):
    made = carried(name)
    other = replace(made, seeds=replace(made.seeds, root=2))
    variant = next(item for item in stresses(made) if item.strength > 0)
    views = [of.draw(made.sites[0], variant).evidence.cells for of in (made, other)]
    assert (views[0] != views[1]).any()


@pytest.mark.parametrize("name", SUITES)
def test_views_have_the_size_and_cells_their_variant_says(carried, name):
    made = carried(name)
    for variant in made.suite.variants:
        evidence = made.drawn(made.sites[-1], variant).evidence
        assert evidence.shape == (variant.view_cells, variant.view_cells)
        assert evidence.cell_size_m == variant.cell_size_m
        assert evidence.classes == made.scene.map.classes


@pytest.mark.parametrize("name", [name for name in SUITES if any(v.role == "falsifier" for v in SUITES[name].variants)])
def test_the_view_of_a_falsifier_is_that_of_its_control_but_for_the_draw_of_errors(carried, name, monkeypatch, root):
    made = carried(name, root)
    for variant in stresses(made, "falsifier"):
        draft, control = (made.drawn(made.sites[0], one) for one in (variant, made.control(variant)))
        assert name == "clean" or (draft.evidence.cells != control.evidence.cells).any()
    monkeypatch.setattr(ViewRequest, "draw", property(lambda shot: shot.variant.others))
    for variant in stresses(made, "falsifier"):
        for site in made.sites:
            draft, control = made.draw(site, variant), made.drawn(site, made.control(variant))
            if variant.kind == ALL_UNKNOWN:
                assert (draft.evidence.cells == UNKNOWN).all()
                continue
            if name in NATURAL:  # sees less, with errors of its own
                assert (draft.evidence.cells == UNKNOWN).mean() > (control.evidence.cells == UNKNOWN).mean()
                continue
            np.testing.assert_array_equal(draft.evidence.cells, control.evidence.cells)
            assert draft.group == control.group
            assert draft.is_present == control.is_present
            assert draft.changed_share == control.changed_share
            if control.vectors is not None:
                assert same_vectors(draft.vectors, control.vectors)


@pytest.mark.parametrize("name", SAME_VIEW)
def test_where_the_stress_lies_elsewhere_the_view_is_that_of_the_control(carried, name, root):
    made = carried(name, root)
    for variant in stresses(made):
        for site in made.sites:
            draft, control = made.drawn(site, variant), made.drawn(site, made.control(variant))
            np.testing.assert_array_equal(draft.evidence.cells, control.evidence.cells)
            if control.vectors is not None:
                assert same_vectors(draft.vectors, control.vectors)


@pytest.mark.parametrize("name", sorted(set(SUITES) - set(SAME_VIEW) - {"clean", "absent", "natural-absent", "season"}))
def test_where_the_stress_lies_in_the_view_it_differs_from_the_control(carried, name, root):
    made = carried(name, root)
    for variant in stresses(made):
        # Nothing need be lost in a long message, nor change in a small view in a few years: the truth says so then.
        message = "cells_changed" if name == "telemetry" else "changed_share"
        drafts = [(made.drawn(site, variant), made.drawn(site, made.control(variant))) for site in made.sites]
        differs = np.array([(draft.evidence.cells != control.evidence.cells).any() for draft, control in drafts])
        is_still = np.array([draft.measured.get(message) == 0 for draft, _ in drafts])
        assert not (differs & is_still).any()
        assert differs.any() or is_still.all()  # a detector may overlook the little that changed at one site
        if variant.view_cells >= 192 and name not in ("telemetry", "synthetic-age"):
            assert differs.all()


@pytest.mark.parametrize("name", GROWS)
def test_what_is_measured_of_a_stress_grows_with_its_strength(carried, name):
    made = [carried(name, root) for root in ROOTS]
    kinds = {item.kind for item in stresses(made[0])}
    grew = 0
    for kind in kinds:
        rungs = sorted(
            (item for item in stresses(made[0]) if item.kind == kind and item.view_cells == 192),
            key=lambda item: item.strength,
        )
        steps = [
            np.mean([one.drawn(site, item).measured[GROWS[name]] for one in made for site in one.sites])
            for item in rungs
        ]
        assert steps[0] > 0 or name == "season"
        assert np.all(np.diff(steps) > 0) or (name == "season" and max(steps) < 1e-3)
        grew += len(steps) > 1
    assert grew


@pytest.mark.parametrize("name", ["occlusion", "false-unknown"])
def test_as_much_is_unknown_as_the_strength_says_and_the_rest_is_as_in_the_control(carried, name, root):
    made = carried(name, root)
    for variant in stresses(made):
        for site in made.sites:
            seen, control = (made.drawn(site, item).evidence for item in (variant, made.control(variant)))
            is_left = seen.cells != UNKNOWN
            np.testing.assert_array_equal(seen.cells[is_left], control.cells[is_left])
            was_known = control.cells != UNKNOWN
            hidden = (was_known & ~is_left).sum(axis=(1, 2)) / was_known.sum(axis=(1, 2))
            if variant.kind.startswith("U3"):  # what grows over thin classes, where it grows
                assert 0 < hidden.max() <= variant.strength
                assert set(np.array(seen.classes)[hidden > 0]) <= set(load_taxonomy().lines)
            else:
                assert hidden.mean() == pytest.approx(variant.strength, abs=0.03)


def test_a_warp_bends_cells_and_vectors_by_one_field(carried, root):
    made = carried("local-warp", root)
    for variant in stresses(made):
        for site in made.sites:
            draft, control = made.drawn(site, variant), made.drawn(site, made.control(variant))
            assert draft.measured["rms_m"] == pytest.approx(variant.strength)
            if control.vectors.empty:
                continue
            assert draft.vectors["class"].tolist() == control.vectors["class"].tolist()
            still = bent(control.vectors, np.zeros((2, *draft.evidence.shape)), 1.0)
            assert (draft.vectors.geometry.to_wkt() != still.geometry.to_wkt()).mean() > 0.9


@pytest.mark.parametrize(("name", "kind"), [("growth", "S3"), ("synthetic-age", "aged")])
def test_as_much_of_the_map_has_changed_as_the_truth_says(carried, name, kind, root):
    made = carried(name, root)
    for variant in stresses(made):
        assert variant.kind == kind
        for site in made.sites:
            draft = made.drawn(site, variant)
            assert draft.changed_share == draft.measured["changed_share"]
            assert 0 <= draft.changed_share <= 1


def test_a_town_aged_by_forty_years_loses_and_gains_about_as_much_as_the_rate_book_says(carried):
    """Over many draws: a view holds few pieces of road, and some new ones find no place."""
    made, years = carried("synthetic-age"), 40.0
    ageing = after(ageing_of(pool_rates(load_ratebook()), place="here"), years)
    ageing = replace(ageing, rates={name: ageing.rates[name] for name in ("building", "road_minor")})
    views = [made.scene.world.view(site.pose, size_cells=192, cell_size_m=1.0) for site in made.sites] * 25
    both = [(view, ageing(view, np.random.default_rng(seed))) for seed, view in enumerate(views)]
    for name, rates in ageing.rates.items():
        masks = [tuple(state.layer(name) == PRESENT for state in pair) for pair in both]
        old = sum(int(before.sum()) for before, _ in masks)
        lost = sum(int((before & ~later).sum()) for before, later in masks) / old
        gained = sum(int((later & ~before).sum()) for before, later in masks) / old
        assert lost == pytest.approx(1 - np.exp(-rates.vanish_per_year * years), abs=0.05), name
        assert 0.3 < gained / np.expm1(rates.appear_per_year * years) < 1.1, name


def test_about_as_many_houses_appear_as_growth_says(carried):
    made = [carried("growth", root) for root in ROOTS]
    for variant in stresses(made[0]):
        if variant.view_cells == 192 and variant.strength <= 1:
            found = [one.drawn(site, variant).measured["new_per_old_area"] for one in made for site in one.sites]
            assert np.mean(found) == pytest.approx(variant.strength, rel=0.45)


def test_better_perception_errs_less_and_none_of_the_controls_errs(carried, root):
    made = carried("clean", root)
    for site in made.sites:
        for variant in stresses(made, "control"):
            perfect = made.scene.world.view(site.pose, size_cells=variant.view_cells, cell_size_m=1.0)
            np.testing.assert_array_equal(made.drawn(site, variant).evidence.cells, perfect.cells)


def test_perception_is_that_of_the_site_and_the_view_alone(carried):
    # The same generator for every variant: what differs is then the stress.
    made = carried("season")
    site = made.sites[0]
    rng = made.seeds.under("site", site.index).rng("perception", 192, 1.0)
    view = made.scene.world.view(site.pose, size_cells=192, cell_size_m=1.0)
    expected = Perception(error_factor=1.0)(view, rng)
    np.testing.assert_array_equal(made.drawn(site, stresses(made, "control")[1]).evidence.cells, expected.cells)


@pytest.mark.parametrize("name", SUITES)
def test_a_place_is_absent_only_where_the_kind_says_so(carried, name, root):
    made = carried(name, root)
    absent = {"outside", "wrong place", "corrupted view", "R1 truth removed"}
    for variant in made.suite.variants:
        draft = made.drawn(made.sites[0], variant)
        is_absent = variant.kind in absent or (name == "natural-absent" and variant.role != "control")
        assert draft.is_present != is_absent
        assert draft.has_pose == (variant.kind not in ("wrong place", "elsewhere"))
        assert draft.is_removed == variant.kind.startswith("R1")
        assert (draft.away_m > 0) == (variant.kind == "outside")


# One suite each


def test_a_season_is_said_in_the_falsifier_too(carried, root):
    made = carried("season", root)
    for variant in made.suite.variants:
        given = made.drawn(made.sites[0], variant).season
        assert given == ("" if variant.role == "control" else variant.kind)


def test_seasons_without_anything_to_change_are_left_out(scene):
    by_the_river, among_fields = (
        {item.kind for item in SUITES["season"].usable(scene(where))}
        for where in ("town-riverside", "town-agricultural large")
    )
    assert by_the_river >= {"low_water", "snow", "control"}
    assert "harvest" not in by_the_river
    assert "harvest" in among_fields


def test_mirroring_leaves_stable_classes_and_amounts_as_they_were(carried, root):
    made = carried("stable-not-distinctive", root)
    for variant in stresses(made):
        moved = [name for name, rank in VOLATILE.items() if rank <= round(variant.strength * 6)]
        assert {"green", "farmland"} <= set(moved)
        for site in made.sites:
            seen, control = (made.drawn(site, item).evidence for item in (variant, made.control(variant)))
            for layer in seen.classes:
                assert (seen.layer(layer) == 1).sum() == (control.layer(layer) == 1).sum()
                if layer not in moved:
                    np.testing.assert_array_equal(seen.layer(layer), control.layer(layer))


def test_aliases_of_a_straight_line_run_the_same_way_far_from_it_and_from_each_other(carried):
    made = carried("stable-not-distinctive")
    lines = straight_places(made.scene)
    for site in made.sites:
        here = np.array([[site.pose.easting_m, site.pose.northing_m]])
        twins = np.array(made.scene.twins[site.index])
        assert 1 <= len(twins) <= 8
        both = np.vstack((here, twins))
        apart_m = np.hypot(*(both[:, None] - both[None]).transpose(2, 0, 1))
        assert apart_m[~np.eye(len(both), dtype=bool)].min() >= min_distance_m(96.0)
        bearings = [lines[int(np.argmin(np.hypot(*(lines[:, :2] - at).T))), 2] for at in both]
        off_deg = np.abs((np.array(bearings) - bearings[0] + 90) % 180 - 90)
        assert off_deg.max() <= 12


def test_aliases_lie_as_far_off_their_lines_as_sites_do_and_all_around_them_is_mapped(carried):
    made = carried("stable-not-distinctive")
    lines = straight_places(made.scene)[:, :2]
    off_m = {"sites": [], "twins": []}
    for root in range(10):
        seeds = replace(made.seeds, root=root)
        sites = choose_sites(
            made.scene, made.suite, count=99, seeds=seeds, group=made.suite.card.group, may_be_fewer=True
        )
        edit = made.suite.edit(made.scene, sites, seeds)
        places = {
            "sites": [(site.pose.easting_m, site.pose.northing_m) for site in edit.sites],
            "twins": [place for site in edit.sites for place in edit.twins[site.index]],
        }
        for name, points in places.items():
            for point in np.array(points):
                assert made.scene.map.is_mapped(point, made.scene.view_reach_m)
                off_m[name].append(np.hypot(*(lines - point).T).min())
    assert min(map(len, off_m.values())) > 30
    assert np.mean(off_m["twins"]) == pytest.approx(np.mean(off_m["sites"]), rel=0.2)
    assert np.median(off_m["twins"]) > 5  # not on the line, where no site is


def test_without_priors_the_views_are_the_same_and_with_them_the_scale_is_said_as_wide_as_it_is(carried, root):
    made = carried("no-priors", root)
    drawn_sigma = made.suite.card.group.scale_sigma
    for variant in made.suite.variants:
        group = made.drawn(made.sites[0], variant).group
        if variant.role == "stress":
            assert group is None
            continue
        assert group.radius_m is not None
        assert group.yaw == "known"
        assert group.scale_sigma == drawn_sigma


def test_a_view_of_a_wrong_place_is_taken_in_the_other_region_at_about_the_same_density(carried, root):
    made = carried("absent", root)
    wrong = next(item for item in stresses(made) if item.kind == "wrong place")
    for site in made.sites:
        assert abs(made.drawn(site, wrong).measured["density"] - site.density) < 0.1


def test_a_corrupted_view_keeps_its_amounts_and_loses_its_place(carried, root):
    made = carried("absent", root)
    broken = next(item for item in stresses(made) if item.kind == "corrupted view")
    for site in made.sites:
        seen, control = (made.drawn(site, item).evidence for item in (broken, made.control(broken)))
        assert (seen.cells == 1).sum() == (control.cells == 1).sum()
        assert (seen.cells != control.cells).any()


def test_a_view_of_a_wrong_place_shows_nothing_beyond_the_map_there(scene, carried):
    made = carried("absent")
    wrong = next(item for item in stresses(made) if item.kind == "wrong place")
    poor = replace(made, scene=replace(made.scene, elsewhere=scene("town-industrial short").map))
    for root in range(4):
        for site in made.sites:
            seen = replace(poor, seeds=replace(made.seeds, root=root)).draw(site, wrong).evidence
            assert not (seen.cells == UNKNOWN).all(axis=0).any()


def test_another_region_without_room_for_a_whole_view_is_refused(carried):
    made = carried("absent")
    wrong = next(item for item in stresses(made) if item.kind == "wrong place")
    state, reach = made.scene.elsewhere, int(made.scene.view_reach_m)
    bits = np.full_like(state.bits.bits, 1 << 31)
    bits[300 : 300 + 2 * reach - 2, 300 : 300 + 2 * reach - 2] = 0
    small = replace(made.scene, elsewhere=replace(state, bits=replace(state.bits, bits=bits)))
    with pytest.raises(ConfigError, match="too small to take a view of a wrong place"):
        replace(made, scene=small).draw(made.sites[0], wrong)


def drawn_share(evidence):
    """Share of cells in which anything is drawn."""
    return np.any([evidence.layer(name) == 1 for name in DRAWN_CLASSES if name in evidence.classes], axis=0).mean()


def test_a_feature_poor_view_is_of_a_real_place_of_the_block_with_next_to_nothing_drawn(carried, root):
    made = carried("absent", root)
    poor = next(item for item in stresses(made) if item.kind == "feature-poor")
    bounds = {block.id: block.bounds_m for block in made.scene.blocks}
    for site in made.sites:
        draft = made.drawn(site, poor)
        assert draft.is_present
        assert draft.measured["is_real_place"] == 1
        pose = draft.pose
        west, south, east, north = bounds[site.block]
        assert west <= pose.easting_m < east
        assert south <= pose.northing_m < north
        assert (pose.yaw_deg, pose.scale) == (site.pose.yaw_deg, site.pose.scale)
        assert made.scene.map.is_mapped(np.array([pose.easting_m, pose.northing_m]), made.scene.view_reach_m)
        perfect = made.scene.world.view(pose, size_cells=192, cell_size_m=1.0)
        assert drawn_share(perfect) < 0.01
        assert drawn_share(draft.evidence) < 0.03  # with what perception sees that is not there
        assert drawn_share(made.drawn(site, made.control(poor)).evidence) > 0.02


def test_where_all_of_a_block_has_something_the_site_itself_is_seen_without_it(carried):
    made = carried("absent")
    poor = next(item for item in stresses(made) if item.kind == "feature-poor")
    state = made.scene.map
    bits = state.bits.bits | np.uint32(1 << state.classes.index("building"))
    full = replace(made.scene, map=replace(state, bits=replace(state.bits, bits=bits)))
    for site in made.sites:
        draft = replace(made, scene=full).draw(site, poor)
        assert draft.measured["is_real_place"] == 0
        assert draft.pose is None
        assert draft.is_present
        assert drawn_share(draft.evidence) == 0


def test_neighbours_are_five_metres_apart_and_the_truth_is_any_of_them(carried):
    made = carried("alias")
    variant = next(item for item in stresses(made) if item.kind.startswith("R2"))
    at = set()
    for root in range(30):
        other = replace(made, seeds=replace(made.seeds, root=root))
        shape = np.array(other.draw(made.sites[0], variant).neighbours_m)
        apart_m = np.hypot(*(shape[:, None] - shape[None]).transpose(2, 0, 1))
        assert apart_m[~np.eye(5, dtype=bool)].min() == pytest.approx(5.0)
        assert np.hypot(*shape.T).min() == 0
        at.add(tuple(shape.mean(axis=0)))
    assert len(at) == 5  # the truth has been the middle and each arm of the cross


# What a place lacks


@pytest.mark.parametrize(
    ("name", "where", "words"),
    [
        ("grade-separation", "town-suburb", "no bridge that carries one road over another"),
        ("topology-twins", "town-riverside", "no two junctions near each other"),
        ("real-age", "town-industrial short", "one date only"),
    ],
)
def test_a_place_that_cannot_carry_a_suite_says_what_it_lacks(scene, name, where, words):
    assert words in (SUITES[name].lack(scene(where)) or "")


@pytest.mark.parametrize(
    ("name", "without", "words"),
    [
        ("absent", {"elsewhere": None}, "no other region"),
        ("synthetic-age", {"ageing": None}, "no rates of ageing from another place"),
        ("real-age", {"others": ()}, "one date only"),
    ],
)
def test_a_scene_without_what_a_suite_draws_from_says_so(scene, name, without, words):
    town = scene("town-suburb")
    assert SUITES[name].lack(town) is None
    assert words in (SUITES[name].lack(replace(town, **without)) or "")


@pytest.mark.parametrize("name", ["clean", "growth", "instance-twins", "topology-twins", "stable-not-distinctive"])
def test_an_empty_map_can_carry_no_suite(scene, edited, name):
    town = scene("town-suburb")
    empty = edited("town-suburb", town.map.features.iloc[:0])
    assert SUITES[name].lack(replace(town, map=empty, world=empty))


def test_a_map_too_small_to_search_carries_no_search_without_priors(scene):
    town = scene("town-suburb")
    bits = town.map.bits.bits.copy()
    bits[500:] = 1 << 31
    small = replace(town.map, bits=replace(town.map.bits, bits=bits))
    found = SUITES["no-priors"].lack(replace(town, map=small))
    assert found is None
    bits[400:] = 1 << 31
    small = replace(town.map, bits=replace(town.map.bits, bits=bits))
    assert "0.41 km2 mapped" in (SUITES["no-priors"].lack(replace(town, map=small)) or "")
