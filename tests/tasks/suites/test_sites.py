# SPDX-License-Identifier: Apache-2.0
"""Sites: far enough apart, within their blocks, mapped, and the first of a longer list."""

from dataclasses import replace

import numpy as np
import pytest

from sasgeo_bench.core.errors import ConfigError
from sasgeo_bench.regions.evidence import UNKNOWN
from sasgeo_bench.tasks.split import blocks_of
from sasgeo_bench.tasks.suites.all_suites import SUITES
from sasgeo_bench.tasks.suites.base import Seeds
from sasgeo_bench.tasks.suites.sites import choose_sites
from tests.slow import rest_slow

SEEDS = Seeds(root=3, names=("town", "sites"))
ALL = 1000


def chosen(scene, name, count=ALL, *, seeds=SEEDS, may_be_fewer=True):
    suite = SUITES[name]
    return choose_sites(scene, suite, count=count, seeds=seeds, group=suite.card.group, may_be_fewer=may_be_fewer)


def places(sites):
    return np.array([(site.pose.easting_m, site.pose.northing_m) for site in sites])


@pytest.fixture(scope="module")
def quarters(scene):
    """The suburb in blocks of half a kilometre, for views of 192 m."""
    town = scene("town-suburb")
    return replace(town, blocks=blocks_of(town.map.region, town.map.grid, block_m=500.0))


@pytest.mark.parametrize("name", ["clean", "growth", "topology-twins", "instance-twins", "no-priors"])
@pytest.mark.parametrize("where", ["town-suburb", "town-old-town large"])
def test_no_two_sites_are_nearer_than_the_suite_asks(scene, name, where):
    town = scene(where, name)
    found = places(chosen(town, name))
    apart_m = np.hypot(*(found[:, None] - found[None]).transpose(2, 0, 1))
    assert apart_m[~np.eye(len(found), dtype=bool)].min(initial=np.inf) >= SUITES[name].spacing_m(town)


def test_every_site_lies_in_the_block_it_names_and_blocks_take_turns(quarters):
    sites = chosen(quarters, "clean", 4)
    bounds = {block.id: block.bounds_m for block in quarters.blocks}
    for site in sites:
        west, south, east, north = bounds[site.block]
        assert west <= site.pose.easting_m < east
        assert south <= site.pose.northing_m < north
    assert len({site.block for site in sites}) == 4
    assert [site.index for site in sites] == [0, 1, 2, 3]


@pytest.mark.parametrize("name", ["clean", "growth", "instance-twins"])
def test_a_larger_count_only_adds(quarters, name):
    every = chosen(quarters, name)
    assert len(every) > 2
    for count in range(1, len(every) + 1):
        assert chosen(quarters, name, count) == every[:count]


def test_the_same_seed_gives_the_same_sites_and_another_one_others(quarters):
    assert chosen(quarters, "clean") == chosen(quarters, "clean")
    other = chosen(quarters, "clean", seeds=Seeds(root=4, names=SEEDS.names))
    assert not np.isin(places(other), places(chosen(quarters, "clean"))).any()


@pytest.mark.parametrize("name", rest_slow(["instance-twins", "clean", "no-priors"]))
def test_all_that_any_view_of_a_site_may_show_is_mapped(scene, name):
    town = scene("town-industrial short", name)  # its map ends short of its grid
    assert not town.map.known.all()
    suite = SUITES[name]
    most = suite.clear_m(town)
    assert most >= max(variant.side_m for variant in suite.variants) / 2 * np.sqrt(2)
    sites = [site for root in range(5) for site in chosen(town, name, seeds=Seeds(root=root, names=()))]
    at_rim = []
    for site in sites:
        row, col = town.map.grid.to_cells(places([site]))[0]
        reach = int(most)
        assert town.map.known[row - reach : row + reach, col - reach : col + reach].all()
        at_rim.append(not town.map.is_mapped(places([site])[0], 1.5 * most))
        for variant in suite.variants:
            largest = replace(site.pose, scale=1 + 2 * suite.card.group.scale_sigma)
            for pose in (site.pose, replace(largest, yaw_deg=45.0)):
                view = town.map.view(pose, size_cells=variant.view_cells, cell_size_m=variant.cell_size_m)
                assert not (view.cells == UNKNOWN).any()
    assert any(at_rim)


def test_a_place_is_mapped_where_all_of_its_square_is(scene):
    state = scene("town-suburb").map
    bits = np.full_like(state.bits.bits, 1 << 31)
    bits[200:301, 400:501] = 0
    square = replace(state, bits=replace(state.bits, bits=bits))
    middle = state.grid.to_centres_m(np.array([[250, 450]]))[0]
    assert square.is_mapped(middle, 50.0)
    assert not square.is_mapped(middle, 50.1)
    assert not square.is_mapped(middle + np.array([1.0, 0.0]), 50.0)
    corner = state.grid.to_centres_m(np.array([[30, 30]]))[0]
    assert state.is_mapped(corner, 30.0)
    assert not state.is_mapped(corner, 31.0)  # beyond the grid nothing is known
    assert not state.is_mapped(corner - np.array([1e5, 0.0]), 5.0)


def test_a_site_says_how_much_is_drawn_in_its_view(scene):
    town = scene("town-suburb")
    for site in chosen(town, "clean", 3):
        row, col = town.map.grid.to_cells(places([site]))[0]
        window = town.map.drawn[row - 96 : row + 96, col - 96 : col + 96]
        assert site.density == pytest.approx(window.mean())
        assert site.density >= SUITES["clean"].card.min_density


def test_headings_go_all_round_and_scales_stay_near_one(scene):
    suite = SUITES["clean"]
    sites = [
        site for root in range(12) for site in chosen(scene("town-suburb"), "clean", seeds=Seeds(root=root, names=()))
    ]
    yaws, scales = np.array([(site.pose.yaw_deg, site.pose.scale) for site in sites]).T
    assert (np.histogram(yaws, bins=4, range=(0, 360))[0] > 0.1 * len(sites)).all()
    assert np.abs(scales - 1).max() <= 2 * suite.card.group.scale_sigma + 1e-12
    assert scales.std() == pytest.approx(suite.card.group.scale_sigma, rel=0.25)


def test_too_many_are_refused_with_how_many_there_are(scene):
    town = scene("town-suburb")
    most = len(chosen(town, "clean"))
    with pytest.raises(ConfigError, match=rf"holds {most} places .* {most + 1} were asked for"):
        chosen(town, "clean", most + 1, may_be_fewer=False)
    assert len(chosen(town, "clean", most, may_be_fewer=False)) == most


def test_a_map_without_any_place_is_refused_even_where_fewer_will_do(scene):
    with pytest.raises(ConfigError, match="holds no place for suite 'stable-not-distinctive'"):
        chosen(scene("town-suburb"), "stable-not-distinctive")
