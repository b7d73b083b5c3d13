# SPDX-License-Identifier: Apache-2.0
"""What time does: ageing at the rates given, never at a place's own, and seasons class by class."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sasgeo_bench.core.errors import PerturbError
from sasgeo_bench.osm.taxonomy import load_taxonomy
from sasgeo_bench.regions.evidence import ABSENT, PRESENT, UNKNOWN, Evidence
from sasgeo_bench.tasks.perturbations.ageing import Ageing, Rates
from sasgeo_bench.tasks.perturbations.base import find_objects, pick_up_to
from sasgeo_bench.tasks.perturbations.season import Season


def rates(vanish=0.0, appear=0.0, names=("building",)):
    return dict.fromkeys(names, Rates(vanish_per_year=vanish, appear_per_year=appear))


def houses(per_side=8, size=192, **others):
    """Houses of 8 by 8 m in rows, and other layers by name."""
    cells = np.zeros((1 + len(others), size, size), dtype=np.uint8)
    for row in range(per_side):
        for col in range(per_side):
            cells[0, 10 + 22 * row : 18 + 22 * row, 10 + 22 * col : 18 + 22 * col] = 1
    for index, mask in enumerate(others.values()):
        cells[1 + index] = mask
    return Evidence(classes=("building", *others), cells=cells, cell_size_m=1.0)


def count(view, name="building"):
    return len(find_objects(view.layer(name) == PRESENT).areas_cells)


def aged(view, seeds=range(20), **parameters):
    return [Ageing(place="here", **parameters)(view, np.random.default_rng(seed)) for seed in seeds]


@pytest.mark.parametrize(("rate", "years"), [(0.01, 5), (0.01, 30), (0.05, 10)])
def test_as_many_things_vanish_as_the_rate_says(rate, years):
    village = houses()
    left = np.mean([count(view) for view in aged(village, rates=rates(vanish=rate), years=years)])
    assert left == pytest.approx(64 * np.exp(-rate * years), rel=0.06)


def test_houses_vanish_whole_and_nothing_appears_without_a_rate():
    village = houses()
    for view in aged(village, rates=rates(vanish=0.05), years=10):
        assert (view.cells <= village.cells).all()
        assert set(find_objects(view.cells[0] == PRESENT).areas_cells) == {64}


def test_the_sea_stays_where_ponds_vanish():
    water, coast = (np.zeros((192, 192), dtype=np.uint8) for _ in range(2))
    water[:40], water[120:130, 120:130], coast[40:42] = 1, 1, 1
    shore = houses(per_side=1, water=water, coastline=coast)
    views = aged(shore, rates=rates(vanish=5.0, names=("water",)), years=10)
    assert all((view.layer("water")[:40] == PRESENT).all() for view in views)
    assert all((view.layer("water")[120:130, 120:130] == ABSENT).all() for view in views)


@pytest.mark.parametrize("years", [5, 20])
def test_as_many_things_appear_as_the_rate_says_where_there_is_room(years):
    village = houses(per_side=4)
    new = np.mean([count(view) - 16 for view in aged(village, rates=rates(appear=0.02), years=years)])
    assert new == pytest.approx(16 * np.expm1(0.02 * years), rel=0.25)


def test_what_appears_meets_no_building_water_or_road(view):
    for name in ("water", "road_minor", "road_major", "railway"):
        for after in aged(view, rates=rates(appear=0.05), years=10, seeds=range(4)):
            new = (after.layer("building") == PRESENT) & (view.layer("building") != PRESENT)
            assert not new[view.layer(name) == PRESENT].any()


def test_green_goes_where_a_house_comes():
    lawn = houses(per_side=4, green=1)
    (after,) = aged(lawn, rates=rates(appear=0.1), years=10, seeds=[0])
    new = (after.cells[0] == PRESENT) & (lawn.cells[0] != PRESENT)
    assert new.any()
    assert (after.cells[1][new] == ABSENT).all()
    assert (after.cells[1][~new] == PRESENT).all()


def test_roads_go_and_come_in_pieces(views):
    kept, new = [], []
    for view in views:
        before = view.layer("road_minor") == PRESENT
        if before.mean() > 0.02:
            names = ("road_minor",)
            older = aged(view, rates=rates(vanish=0.03, names=names), years=10, seeds=range(40))
            grown = aged(view, rates=rates(appear=0.03, names=names), years=10, seeds=range(40))
            kept += [(after.layer("road_minor") == PRESENT).sum() / before.sum() for after in older]
            new += [((after.layer("road_minor") == PRESENT) & ~before).sum() / before.sum() for after in grown]
    assert np.mean(kept) == pytest.approx(np.exp(-0.3), abs=0.08)
    assert 0.05 < np.mean(new) < 0.4
    assert np.std(kept) > 0.05  # pieces, not a thinning of everything


def test_a_place_is_never_aged_by_its_own_rates():
    with pytest.raises(PerturbError, match="the rates come from 'vaduz' itself, take those of other places"):
        Ageing(years=5, rates=rates(), place="vaduz", measured_in=("triesen", "vaduz"))


def test_rates_that_are_none_are_refused():
    with pytest.raises(PerturbError, match="vanish_per_year lies between"):
        rates(vanish=-1.0)


@given(budget=st.floats(0, 100), seed=st.integers(0, 999))
def test_what_is_picked_exceeds_its_budget_by_less_than_one_thing(budget, seed):
    areas = np.array([5, 20, 1, 30, 8, 8])
    chosen = pick_up_to(areas, budget, np.random.default_rng(seed))
    assert areas[chosen].sum() < budget + 30


def test_what_is_picked_is_the_budget_in_the_mean():
    areas = np.array([5, 20, 1, 30, 8, 8])
    picked = [areas[pick_up_to(areas, 25.0, np.random.default_rng(seed))].sum() for seed in range(3000)]
    assert np.mean(picked) == pytest.approx(25, abs=0.8)


# Seasons


def changed(view, kind, strength=0.6, seed=0):
    """Names of the classes that differ, and the view after."""
    after = Season(kind=kind, strength=strength)(view, np.random.default_rng(seed))
    return {name for name in view.classes if (view.layer(name) != after.layer(name)).any()}, after


def test_leaves_hide_lines_within_green_and_nothing_else(view):
    names, after = changed(view, "leaf_on")
    assert "path_track" in names
    assert names <= {"path_track", "road_minor", "waterway", "field_boundary"}
    assert (after.cells == view.cells)[:, view.layer("green") != PRESENT].all()


def test_snow_hides_paths_and_makes_fields_unknown(view):
    names, after = changed(view, "snow")
    assert {"path_track", "green"} <= names <= {item.name for item in load_taxonomy().classes if "snow" in item.seasons}
    assert (after.layer("green") == UNKNOWN).mean() == pytest.approx(0.6, abs=0.01)
    assert (after.layer("path_track") == PRESENT).sum() < (view.layer("path_track") == PRESENT).sum()
    assert not (after.layer("path_track") == UNKNOWN).any()


def test_low_water_takes_the_rim_of_a_lake_and_leaves_its_middle():
    rows, cols = np.indices((192, 192)) - 96
    cells = (np.hypot(rows, cols) < 60).astype(np.uint8)[None]
    lake = Evidence(classes=("water",), cells=cells, cell_size_m=1.0)
    shrunk = []
    for strength in (0.2, 0.5, 1.0):
        _, after = changed(lake, "low_water", strength)
        assert (after.cells[0, 76:116, 76:116] == PRESENT).all()
        shrunk.append(60 - np.sqrt((after.cells == PRESENT).sum() / np.pi))
    assert shrunk == pytest.approx([2.4, 6, 12], rel=0.35)


def test_a_stream_falls_dry_but_not_within_a_lake(view):
    _, after = changed(view, "low_water", 1.0)
    in_water = view.layer("water") == PRESENT
    assert (after.layer("waterway") == view.layer("waterway"))[in_water].all()
    assert (after.layer("waterway")[~in_water] == ABSENT).all()


def test_harvest_takes_fields_for_green_as_a_whole(view):
    names, after = changed(view, "harvest", 1.0)
    assert names <= {"farmland", "green", "field_boundary"}
    was_field = view.layer("farmland") == PRESENT
    assert (after.layer("green")[was_field] == PRESENT).mean() > 0.9
    assert (after.layer("farmland")[was_field] == PRESENT).mean() < 0.1


def test_a_season_that_is_none_is_refused():
    with pytest.raises(PerturbError, match="kind is one of leaf_on, snow, low_water, harvest, got 'monsoon'"):
        Season(kind="monsoon", strength=0.5)
