# SPDX-License-Identifier: Apache-2.0
"""Measured ageing: pairs worked by hand, rates against what was simulated, and files that come out the same."""

import datetime as dt
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pandas as pd
import pytest
import shapely
from hypothesis import given
from hypothesis import strategies as st

from sasgeo_bench.ageing import measure
from sasgeo_bench.ageing.compare import (
    compare_areas,
    compare_pieces,
    covered_share,
    cut_to,
    make_areas,
    make_pieces,
    polygons_of,
)
from sasgeo_bench.ageing.files import read_ageing, summary_text, write_ageing
from sasgeo_bench.ageing.measure import DTYPES as COLUMNS
from sasgeo_bench.ageing.measure import bootstrap_rate, loss_rate, measure_ageing, seeded_rng
from sasgeo_bench.core.errors import ConfigError, StoreError
from sasgeo_bench.osm.history import History, Lifecycle, ObjectKey, Span, State
from sasgeo_bench.osm.taxonomy import load_taxonomy
from tests.drawn_features import features_of

OLD, NEW = dt.date(2015, 1, 1), dt.date(2020, 1, 1)
AREA = shapely.box(-1000, -1000, 3000, 3000)
NO_HINTS = Lifecycle(gone=np.array([], dtype=object), rising=np.array([], dtype=object), started={})


def house(x, y=0.0, width=10.0, depth=10.0):
    return shapely.box(x, y, x + width, y + depth)


def line(*points):
    return shapely.LineString(points)


def state(on, things, lifecycle=None, *, hidden=(), **usual):
    """A state of (id, class, geometry) rows; ids in `hidden` lie under ground."""
    rows = [
        {"osm_id": each[0], "class": each[1], "geometry": each[2], "is_visible": each[0] not in hidden}
        for each in things
    ]
    return State(source="", on=on, features=features_of(*rows, **usual), lifecycle=lifecycle or NO_HINTS)


def measured(*states, area=AREA):
    return measure_ageing(History(states=states, area=area, epsg=32632), place="here").table


def test_shares_by_number_stand_beside_those_by_amount_and_a_line_counts_where_half_of_it_is_gone():
    """One of two houses goes, four sheds come: a fifth of the ground is gone, and half of the houses."""
    old = state(OLD, [(1, "building", house(0, width=40)), (2, "building", house(100))])
    sheds = [(at, "building", house(200 + 20 * at, width=5, depth=5)) for at in range(3, 7)]
    found = row(measured(old, state(NEW, [(1, "building", house(0, width=40)), *sheds])), "building")
    assert (found["vanished_share"], found["vanished_number_share"]) == (0.2, 0.5)
    assert (found["appeared_share"], found["appeared_number_share"]) == (0.2, 0.8)
    lines = [(1, "road_minor", line((0, 0), (100, 0))), (2, "road_minor", line((0, 200), (100, 200)))]
    kept = [(1, "road_minor", line((0, 0), (60, 0))), (2, "road_minor", line((0, 200), (40, 200)))]
    found = row(measured(state(OLD, lines), state(NEW, kept)), "road_minor")
    assert found["vanished_number_share"] == 0.5
    assert 0.4 < found["vanished_share"] < 0.6


def row(table, name, span="whole"):
    return table[(table["class"] == name) & (table["span"] == span)].iloc[0]


def changes(old, new, **more):
    return measured(state(OLD, old), state(NEW, new, **more))


# Pairing, worked by hand

VANISHED, MOVED, RENEWED, RETAGGED, HALVED, STAYS, QUARTERED = (house(x) for x in range(0, 700, 100))
OLD_HOUSES = [
    (identifier, "building", shape)
    for identifier, shape in enumerate([VANISHED, MOVED, RENEWED, RETAGGED, HALVED, STAYS, QUARTERED], start=1)
]
NEW_HOUSES = [
    (2, "building", house(102)),
    (33, "building", RENEWED),
    (4, "parking", RETAGGED),
    (5, "building", house(400, width=5)),
    (55, "building", house(405, width=5)),
    (6, "building", STAYS),
    *((77 + k, "building", house(600 + 5 * (k % 2), 5 * (k // 2), 5, 5)) for k in range(4)),
    (99, "building", house(900)),
]


def test_houses_that_vanish_move_change_id_or_tag_or_are_split_are_told_apart():
    found = row(changes(OLD_HOUSES, NEW_HOUSES), "building")
    assert (found["n_from"], found["n_to"]) == (7, 10)
    assert (found["amount_from"], found["amount_to"], found["unit"]) == (700.0, 600.0, "m2")
    assert found["vanished_share"] == pytest.approx(2 / 7, abs=1e-6)  # the vanished and the retagged one
    assert found["retagged_share"] == pytest.approx(1 / 7, abs=1e-6)
    assert found["appeared_share"] == pytest.approx(1 / 6, abs=1e-6)
    assert found["redrawn_share"] == pytest.approx(2 / 7, abs=1e-6)  # the moved one, and the half of the halved one
    assert (found["shift_median_m"], found["shift_p90_m"]) == (2.0, 2.5)
    assert found["id_vanished_share"] == pytest.approx(3 / 7, abs=1e-6)  # vanished, renewed, quartered
    assert found["ground_lost_share"] == pytest.approx((200 + 20) / 700, abs=1e-6)


def test_a_road_redrawn_beside_its_place_keeps_its_length_and_loses_ground():
    """Two of 100 m: one moves by 1 m of its 4 m, one by more than a road can move."""
    old = [(1, "road_minor", line((0, 0), (100, 0))), (2, "road_minor", line((0, 100), (100, 100)))]
    new = [(1, "road_minor", line((0, 1), (100, 1))), (2, "road_minor", line((0, 120), (100, 120)))]
    found = row(measured(state(OLD, old, width_m=4.0), state(NEW, new, width_m=4.0)), "road_minor")
    assert (found["vanished_share"], found["ground_lost_share"]) == (0.5, 0.625)
    rate = -np.log(1 - 0.625) / ((NEW - OLD).days / 365.25)
    assert [found[f"ground_{what}_per_year"] for what in ("lost", "gained")] == pytest.approx([rate] * 2, abs=1e-6)


def test_a_ring_that_starts_elsewhere_or_runs_the_other_way_is_the_same_house_and_ground_is_covered_once():
    turned = shapely.Polygon([(10, 10), (10, 0), (0, 0), (0, 10)])
    found = compare_areas(make_areas(np.array([house(0)])), make_areas(np.array([turned])))
    assert found.lost.tolist() == found.shift_m.tolist() == [0.0]
    found = compare_areas(make_areas(np.array([house(0, width=60)])), make_areas(np.array([house(0)])))
    assert found.lost.tolist() == [500.0]  # a sixth is covered
    covers = np.array([house(0, width=4), house(2, width=4)])
    assert covered_share(np.array([house(0)]), covers).tolist() == [0.6]
    split, whole = NEW_HOUSES[6:10], OLD_HOUSES[6:]  # a merge is a split seen from the other side
    merged = row(changes(split, whole), "building")
    assert (merged["vanished_share"], merged["appeared_share"]) == (0.0, 0.0)


def test_a_forest_that_swallows_a_house_does_not_take_its_place_but_fields_take_that_of_a_meadow():
    forest, meadow = shapely.box(-500, -500, 500, 500), shapely.box(1000, 0, 1200, 100)
    fields = [(8, "farmland", shapely.box(1000, 0, 1100, 100)), (9, "farmland", shapely.box(1100, 0, 1200, 100))]
    table = changes([(1, "building", house(0)), (2, "green", meadow)], [(3, "green", forest), *fields])
    assert row(table, "building")["vanished_share"] == 1.0
    assert row(table, "building")["retagged_share"] == 0.0
    assert row(table, "green")["retagged_share"] == 1.0
    assert row(table, "farmland")["appeared_retagged_share"] == 1.0


def test_a_road_shortened_by_half_or_drawn_anew_or_become_a_square_loses_what_is_gone():
    found = row(
        changes([(1, "road_minor", line((0, 0), (200, 0)))], [(1, "road_minor", line((0, 0), (100, 0)))]), "road_minor"
    )
    assert found["vanished_share"] == pytest.approx(95 / 200, abs=1e-6)
    assert (found["appeared_share"], found["redrawn_share"]) == (0.0, 0.0)
    assert (found["amount_from"], found["amount_to"], found["unit"]) == (200.0, 100.0, "m")
    new = [(7, "road_minor", line((130, 2), (0, 2))), (8, "road_minor", line((130, 2), (200, 2)))]
    found = row(changes([(1, "road_minor", line((0, 0), (77, 0), (200, 0)))], new), "road_minor")
    assert (found["vanished_share"], found["appeared_share"]) == (0.0, 0.0)
    assert (found["redrawn_share"], found["shift_median_m"], found["id_vanished_share"]) == (1.0, 2.0, 1.0)
    found = row(
        changes([(1, "road_minor", line((0, 5), (50, 5)))], [(1, "road_minor", house(0, width=50))]), "road_minor"
    )
    assert (found["n_from"], found["n_to"], found["vanished_share"]) == (1, 0, 0.0)


def test_a_street_made_a_path_is_retagged_and_one_put_into_a_tunnel_too():
    street, other = line((0, 0), (100, 0)), line((0, 500), (100, 500))
    old = [(1, "road_minor", street), (2, "road_minor", other)]
    table = measured(state(OLD, old), state(NEW, [(1, "path_track", street), (2, "road_minor", other)], hidden={2}))
    found = row(table, "road_minor")
    assert (found["vanished_share"], found["retagged_share"], found["id_vanished_share"]) == (1.0, 1.0, 0.0)
    assert found["vanished_retagged_share"] == 1.0
    assert row(table, "path_track")["appeared_retagged_share"] == 1.0


def test_only_what_lies_in_the_common_area_counts_and_broken_polygons_are_mended():
    old, new = [(1, "building", house(0)), (2, "building", house(95))], [(1, "building", house(0))]
    table = measured(state(OLD, old), state(NEW, new), area=shapely.box(-50, -50, 100, 50))
    assert row(table, "building")["amount_from"] == 150.0
    assert row(table, "building")["vanished_share"] == pytest.approx(1 / 3, abs=1e-6)
    bowtie = shapely.Polygon([(0, 0), (10, 10), (10, 0), (0, 10)])
    assert shapely.area(polygons_of(np.array([bowtie]))).tolist() == [50.0]
    assert make_areas(np.array([bowtie, shapely.Polygon()])).rows.tolist() == [0]
    assert shapely.area(cut_to(np.array([bowtie]), shapely.box(0, 0, 5, 10))).tolist() == [25.0]


@given(st.lists(st.tuples(st.integers(0, 40), st.integers(0, 40), st.integers(1, 9), st.integers(1, 9)), max_size=12))
def test_loss_lies_between_nothing_and_all_and_an_empty_map_loses_all(boxes):
    houses = np.array([house(*box) for box in boxes], dtype=object)
    some, nothing = make_areas(houses), make_areas(np.array([], dtype=object))
    half = compare_areas(some, make_areas(houses[::2]))
    assert ((half.lost >= 0) & (half.lost <= half.amount)).all()
    assert half.lost[::2].sum() == 0.0
    assert compare_areas(some, nothing).lost.tolist() == shapely.area(houses).tolist()
    assert len(compare_areas(nothing, some).lost) == 0


@given(st.lists(st.tuples(st.integers(0, 90), st.integers(0, 90)), min_size=2, max_size=9, unique=True))
def test_pieces_of_a_line_add_up_to_its_length_and_are_found_again_when_it_runs_backwards(points):
    forth, back = (make_pieces(np.array([line(*order)])) for order in (points, points[::-1]))
    assert forth.lengths_m.sum() == pytest.approx(sum(np.hypot(*np.subtract(a, b)) for a, b in pairwise(points)))
    assert forth.lengths_m.max() <= 5.0
    assert compare_pieces(forth, back).lost.sum() == 0.0


# What tags explain


def places(*shapes):
    return np.array(shapes, dtype=object)


def test_what_is_tagged_demolished_or_under_construction_is_the_worlds_change():
    hints = Lifecycle(gone=places(house(0)), rising=places(shapely.box(95, -5, 115, 15)), started={})
    old = [(1, "building", house(0)), (2, "building", house(100)), (3, "building", house(200)), (4, "building", STAYS)]
    found = row(measured(state(OLD, old), state(NEW, [(4, "building", STAYS)], hints)), "building")
    assert found["vanished_share"] == 0.75
    assert found["vanished_world_share"] == pytest.approx(2 / 3, abs=1e-6)
    assert found["vanished_untold_share"] == pytest.approx(1 / 3, abs=1e-6)


def test_start_dates_and_building_sites_tell_new_houses_from_late_mapping():
    before = Lifecycle(gone=places(), rising=places(house(0)), started={})
    years = {1: (2017, 2018), 2: (1950, 1950), 3: (2010, 2019)}
    started = {ObjectKey("way", key): Span(dt.date(a, 1, 1), dt.date(b, 12, 31)) for key, (a, b) in years.items()}
    after = Lifecycle(gone=places(), rising=places(), started=started)
    new = [(k, "building", house(100 * k)) for k in range(5)]
    found = row(measured(state(OLD, new[4:], before), state(NEW, new, after)), "building")
    assert found["appeared_share"] == 0.8
    assert found["appeared_world_share"] == 0.5  # the site's, and that of 2017
    assert found["appeared_mapping_share"] == 0.25
    assert found["appeared_untold_share"] == 0.25  # begun between 2010 and 2019: before or after the older map


def test_a_road_through_a_building_site_is_explained_by_it_along_the_site_only():
    before = Lifecycle(gone=places(), rising=places(shapely.box(0, -20, 50, 20)), started={})
    new = [(1, "road_minor", line((0, 0), (200, 0))), (2, "building", STAYS)]
    found = row(measured(state(OLD, new[1:], before), state(NEW, new)), "road_minor")
    assert found["appeared_world_share"] == pytest.approx(55 / 200, abs=1e-6)


# Rates


def test_one_interval_has_the_closed_form_one_block_no_interval_and_maps_a_day_apart_no_rates():
    rate = loss_rate(np.array([25.0]), np.array([100.0]), np.array([4.0]))
    assert rate == pytest.approx(-np.log(0.75) / 4)
    alone = bootstrap_rate(np.ones((1, 1)), np.full((1, 1), 9.0), np.ones(1), things=9, rng=seeded_rng())
    assert alone.per_year == pytest.approx(-np.log(8 / 9))
    assert np.isnan(alone.lo)
    assert np.isnan(alone.hi)
    houses = [(k, "building", house(100 * k)) for k in range(4)]
    table = measured(state(OLD, houses), state(OLD + dt.timedelta(days=1), houses[:3]))
    assert row(table, "building")["vanished_share"] == 0.25
    assert table[[column for column in COLUMNS if "per_year" in column]].isna().all(axis=None)


@given(st.floats(0.001, 2.0), st.lists(st.floats(0.1, 9.0), min_size=1, max_size=6), st.floats(1.0, 1e6))
def test_the_pooled_rate_is_the_one_that_all_intervals_share(rate, years, amount):
    years = np.array(years)
    total = np.full(len(years), amount)
    assert loss_rate(total * -np.expm1(-rate * years), total, years) == pytest.approx(rate, rel=1e-6)


def test_the_pooled_rate_maximises_the_likelihood_of_censored_losses():
    lost, total, years = np.array([3.0, 20.0, 1.0]), np.array([100.0, 90.0, 80.0]), np.array([1.0, 4.0, 0.5])
    rates = np.linspace(0.001, 0.2, 20_000)[:, None]
    likelihood = (lost * np.log(-np.expm1(-rates * years)) - (total - lost) * rates * years).sum(axis=1)
    assert loss_rate(lost, total, years) == pytest.approx(rates[likelihood.argmax(), 0], abs=2e-5)


def test_nothing_to_lose_has_no_rate_all_lost_an_infinite_one_and_no_loss_the_rule_of_three():
    years = np.array([2.0])
    assert np.isnan(loss_rate(np.zeros(1), np.zeros(1), years))
    assert np.isinf(loss_rate(np.ones(1), np.ones(1), years))
    spared = bootstrap_rate(np.zeros((9, 1)), np.ones((9, 1)), years, things=300, rng=seeded_rng())
    assert (spared.per_year, spared.lo) == (0.0, 0.0)
    assert spared.hi == pytest.approx(3.0 / (300 * 2), rel=0.01)


def test_the_block_interval_covers_a_known_rate_about_as_often_as_it_says(monkeypatch):
    monkeypatch.setattr(measure, "DRAWS", 400)
    rate, years, rng = 0.03, np.array([1.5, 4.0]), seeded_rng("coverage")
    hits, trials = 0, 200
    for _ in range(trials):
        # Blocks of unequal size, whose things fall in clumps of five.
        clumps = rng.integers(2, 30, size=(80, 2))
        lost = 5.0 * rng.binomial(clumps, -np.expm1(-rate * years))
        found = bootstrap_rate(lost, 5.0 * clumps, years, things=int(5 * clumps.sum()), rng=rng)
        hits += found.lo <= rate <= found.hi
    assert 0.89 <= hits / trials <= 0.99


def test_pooled_rows_weigh_all_intervals_and_whole_rows_compare_the_ends():
    years = [dt.date(2010 + 2 * k, 1, 1) for k in range(3)]
    grown = [(k, "building", house(100 * k)) for k in range(8)]
    table = measured(state(years[0], grown[:8]), state(years[1], grown[:4]), state(years[2], grown[:2]))
    of_class = table[table["class"] == "building"]
    assert of_class["span"].tolist() == ["interval", "interval", "whole", "pooled"]
    for _, found in of_class.iterrows():
        assert found["vanish_per_year"] == pytest.approx(np.log(2) / 2, rel=1e-3)
    assert row(table, "building")["vanished_share"] == 0.75
    assert (row(table, "building", "pooled")["n_from"], row(table, "building", "pooled")["n_to"]) == (8, 2)


# Files


@pytest.fixture(scope="module")
def ageing():
    states = (state(OLD, OLD_HOUSES), state(NEW, NEW_HOUSES))
    return measure_ageing(History(states=states, area=AREA, epsg=32632), place="Toytown")


def test_files_come_out_the_same_each_time_and_name_whose_data_they_are(ageing, tmp_path):
    first, second = (write_ageing(tmp_path / name, ageing) for name in "ab")
    assert [path.name for path in first] == ["ageing.parquet", "ageing.md", "ageing.svg"]
    for one, other in zip(first, second, strict=True):
        assert one.read_bytes() == other.read_bytes()
        assert b"OpenStreetMap contributors, ODbL" in one.read_bytes()
    assert len(list((tmp_path / "a").iterdir())) == 3


def test_a_table_is_read_back_as_it_was_written(ageing, tmp_path):
    write_ageing(tmp_path, ageing)
    back = read_ageing(tmp_path)
    assert (back.place, back.sources, back.area_km2) == (ageing.place, ageing.sources, ageing.area_km2)
    pd.testing.assert_frame_equal(back.table, ageing.table, check_dtype=False)
    assert list(back.table.columns) == list(COLUMNS)


def test_the_summary_has_a_row_for_each_place_under_each_class_and_controls_apart(ageing):
    text = summary_text([ageing, replace(ageing, place="Here")], [replace(ageing, place="Elsewhere")])
    building = load_taxonomy()["building"].persistence
    assert f"set by hand: vanishes {100 * building.vanish_per_year:.2f}, appears" in text
    assert "(c) OpenStreetMap contributors, ODbL" in text
    places, controls = text.split("## Controls")
    assert places.count("| Toytown |") == places.count("| Here |") == 1 + 2
    assert "## building" in places
    assert places.count("| Elsewhere |") == 1
    assert "| class | Elsewhere |" in controls
    vanished, appeared = (100 * row(ageing.table, "building")[f"{what}_share"] for what in ("vanished", "appeared"))
    assert f"| building | {vanished:.1f} %, {appeared:.1f} % |" in controls


@pytest.mark.parametrize("others", ["places", "controls"])
def test_two_tables_of_one_place_are_refused(ageing, others):
    with pytest.raises(ConfigError, match="two tables are of 'Toytown'"):
        summary_text([ageing, ageing] if others == "places" else [ageing], [ageing] if others == "controls" else [])


def test_a_file_that_is_no_table_of_ageing_is_told(tmp_path):
    pd.DataFrame({"a": [1]}).to_parquet(tmp_path / "ageing.parquet")
    with pytest.raises(StoreError, match="measure it again"):
        read_ageing(tmp_path)
    (tmp_path / "ageing.parquet").write_bytes(b"?")
    with pytest.raises(StoreError, match="measure it again"):
        read_ageing(tmp_path)
