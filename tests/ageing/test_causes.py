# SPDX-License-Identifier: Apache-2.0
"""Why things vanish and appear: small histories whose answer is known, and places whose answer was looked up."""

import datetime as dt

import numpy as np
import osmium
import pandas as pd
import pyproj
import pytest
import shapely

from sasgeo_bench.ageing.causes import CAUSES, MAPPING, WORLD, causes_of_vanished
from sasgeo_bench.ageing.measure import measure_ageing, pairs_of
from sasgeo_bench.osm.history import History, Lifecycle, State, date_extracts, read_history
from tests.drawn_features import features_of

OLD, NEW = dt.date(2015, 1, 1), dt.date(2020, 1, 1)
AREA = shapely.box(0, 0, 1000, 1000)  # one block
EARLY, DAY = pd.Timestamp("2012-05-01"), pd.Timestamp("2018-05-01")
STREET = {"osm_id": 9000, "class": "road_minor", "geometry": shapely.LineString([(0, 90), (1000, 90)])}
NO_HINTS = Lifecycle(gone=np.array([], dtype=object), rising=np.array([], dtype=object), started={})


def thing(identifier, x, y, side=10.0, drawn=EARLY, name="building"):
    return {
        "osm_id": identifier,
        "class": name,
        "timestamp": drawn,
        "geometry": shapely.box(x, y, x + side, y + side),
    }


def row_of(count, *, y=100.0, first=0, **more):
    """So many houses or woods, 20 m apart, along a line."""
    return [thing(first + at, 5 + 20.0 * (at % 45), y + 25 * (at // 45), **more) for at in range(count)]


def one_by_one(things):
    """The same, each drawn a month after the one before."""
    return [item | {"timestamp": DAY + pd.Timedelta(days=30 * at)} for at, item in enumerate(things)]


def causes(old, new, name="building", what="appeared"):
    """Shares of the causes that are not nought, of one class between two maps."""
    states = tuple(
        State(source="", on=on, features=features_of(STREET, *rows), lifecycle=NO_HINTS)
        for on, rows in ((OLD, old), (NEW, new))
    )
    table = measure_ageing(History(states=states, area=AREA, epsg=32632), place="here").table
    row = table[(table["class"] == name) & (table["span"] == "pooled")].iloc[0]
    shares = {cause: row[f"{what}_{cause}_share"] for cause in CAUSES}
    assert sum(shares.values()) == pytest.approx(1.0, abs=1e-5)
    least, most = row[f"{what[:6]}_least_per_year"], row[f"{what[:6]}_most_per_year"]
    assert 0 <= least <= most <= row[f"{what[:6]}_per_year"]
    return {cause: share for cause, share in shares.items() if share > 0}


def test_houses_drawn_at_once_along_streets_of_the_older_map_were_mapped_and_not_built():
    old = row_of(30)
    assert causes(old, old + row_of(40, first=100, y=60, drawn=DAY)) == {"mapping": 1.0}


def test_an_estate_away_from_all_streets_that_were_mapped_is_untold():
    old = row_of(30)
    assert causes(old, old + row_of(40, first=100, y=500, drawn=DAY)) == {"untold": 1.0}


def test_one_house_more_among_many_that_stayed_was_built():
    old = row_of(40)
    assert causes(old, [*old, thing(100, 800, 300, drawn=DAY)]) == {"world": 1.0}


def test_one_wood_more_among_many_says_nothing_and_a_block_of_few_houses_neither():
    old = row_of(40, name="green")
    assert causes(old, [*old, thing(100, 800, 300, drawn=DAY, name="green")], "green") == {"untold": 1.0}
    assert causes(row_of(5), [*row_of(5), thing(100, 800, 300, drawn=DAY)]) == {"untold": 1.0}


def test_ten_houses_of_one_day_are_told_by_their_times_alone():
    """Sixty houses gain twelve in five years: faster than settled ground, slower than any block that is filled."""
    old, new = row_of(60), row_of(12, first=100, y=60, drawn=DAY)
    assert causes(old, old + new) == {"mapping": 1.0}
    assert causes(old, old + one_by_one(new)) == {"untold": 1.0}
    assert causes(old, old + [item | {"timestamp": pd.NaT} for item in new]) == {"untold": 1.0}


def test_of_an_edited_object_the_ids_around_it_say_when_it_was_drawn():
    """Version 3 hides the day of drawing, which ids of the same day before and after it give back."""
    old, new = row_of(60), row_of(12, first=100, y=60, drawn=DAY)
    edited = [item | {"version": 3 if at % 2 else 1, "timestamp": DAY} for at, item in enumerate(new)]
    assert causes(old, [*old, *edited, thing(200, 900, 800, drawn=DAY)])["mapping"] > 0.9


def test_a_house_moved_farther_than_its_own_width_was_redrawn_under_its_id_or_another():
    old = row_of(40)
    for identifier in (100, 101):
        was, now = thing(100, 500, 500), thing(identifier, 512, 500)
        assert causes([*old, was], [*old, now]) == {"redrawn": 1.0}
        assert causes([*old, was], [*old, now], what="vanished") == {"redrawn": 1.0}


def test_a_road_drawn_anew_ten_metres_aside_was_redrawn():
    was, now = ({"osm_id": at, "class": "road_minor", "geometry": line(y)} for at, y in ((1, 500), (2, 510)))
    assert causes([was], [now], "road_minor") == {"redrawn": 1.0}
    assert causes([was], [now], "road_minor", what="vanished") == {"redrawn": 1.0}


def line(y):
    return shapely.LineString([(100, y), (800, y)])


def test_an_object_drawn_before_the_older_map_that_had_no_class_there_was_retagged():
    old = row_of(40)
    assert causes(old, [*old, thing(-5, 800, 300, drawn=EARLY)]) == {"retagged": 1.0}


def test_a_house_that_is_missing_alone_is_gone_and_of_a_block_that_lost_most_the_mapping_was_taken_back():
    old = row_of(40)
    assert causes(old, old[1:], what="vanished") == {"world": 1.0}
    assert causes(old, old[30:], what="vanished") == {"mapping": 1.0}
    assert causes(old, old[8:], what="vanished") == {"untold": 1.0}


def test_where_most_of_a_block_was_redrawn_a_missing_house_says_nothing():
    old = row_of(40)
    moved = [item | {"geometry": shapely.affinity.translate(item["geometry"], 2.0)} for item in old[1:]]
    assert causes(old, moved, what="vanished") == {"untold": 1.0}


def test_a_path_that_is_gone_is_untold_where_a_road_is_the_worlds():
    ways = [
        {"osm_id": at, "class": name, "geometry": line(300 + 60 * at)}
        for name in ("road_minor", "path_track")
        for at in range(8)
    ]
    left = [item for item in ways if item["osm_id"]]
    left.append({"osm_id": 0, "class": "road_minor", "geometry": shapely.LineString([(100, 300), (760, 300)])})
    found = {name: causes(ways, left, name, what="vanished") for name in ("road_minor", "path_track")}
    assert found == {"road_minor": {"world": 1.0}, "path_track": {"untold": 1.0}}


# Real data


def changes(folder, place, days, **more):
    history = read_history(date_extracts([folder / f"{place}-{day}.osm.pbf" for day in days]), **more)
    table = measure_ageing(history, place=place).table
    return table[(table["class"] == "building") & (table["span"] == "whole")].iloc[0], history


@pytest.mark.real
@pytest.mark.slow
def test_neubrandenburg_loses_two_in_a_thousand_buildings_by_the_world_from_2014_to_2016(real_extracts):
    _, history = changes(real_extracts, "neubrandenburg", ("2014-05-09", "2016-02-10"))
    pair = next(pairs_of(history))["building"]
    by_cause = causes_of_vanished(pair)[pair.gone.is_lost]
    gone = (by_cause[:, WORLD] > by_cause.sum(axis=1) / 2).sum()
    assert 0.001 < gone / len(pair.old.keys) < 0.004


@pytest.mark.real
@pytest.mark.slow
@pytest.mark.parametrize("place", ["douglas", "ramsey"])
def test_douglas_and_ramsey_grow_by_drawing_and_not_by_building(real_extracts, place):
    found, _ = changes(real_extracts, place, ("2018-10-19", "2021-11-07"))
    assert found["n_to"] > 1.6 * found["n_from"]
    assert found["appeared_mapping_share"] > 0.75
    assert found["appeared_world_share"] < 0.1
    assert found["vanished_share"] < 0.01


@pytest.mark.real
@pytest.mark.slow
@pytest.mark.parametrize(
    ("place", "box"), [("klaksvik", (-6.604, 62.218, -6.57, 62.241)), ("runavik", (-6.738, 62.104, -6.714, 62.134))]
)
def test_klaksvik_and_runavik_hardly_change_from_2014_to_2017_and_are_filled_in_a_year(real_extracts, place, box):
    dated = date_extracts(
        [real_extracts / "faroe-2017-02-18.osh.pbf", real_extracts / f"{place}-2018-06-19.osm.pbf"],
        at=[dt.date(2014, 1, 1), dt.date(2017, 2, 18)],
    )
    table = measure_ageing(read_history(dated, bounds=box, margin_m=0.0), place=place).table
    first, second = (row for _, row in table[(table["class"] == "building") & (table["span"] == "interval")].iterrows())
    assert first["vanished_share"] == 0.0
    assert first["n_to"] <= 1.07 * first["n_from"]
    assert second["n_to"] > 1.6 * second["n_from"]
    assert second["appeared_mapping_share"] > 0.7


def recount(folder, place, days, epsg):
    """Buildings of two maps, counted without any code of ours: their numbers, and the shares without a counterpart."""
    to_utm = pyproj.Transformer.from_crs(4326, epsg, always_xy=True)
    factory, keyed = osmium.geom.WKBFactory(), osmium.filter.KeyFilter("building")
    maps = []
    for day in days:
        path = str(folder / f"{place}-{day}.osm.pbf")
        areas = osmium.FileProcessor(path).with_locations().with_areas(keyed).with_filter(keyed)
        found = shapely.from_wkb([bytes.fromhex(factory.create_multipolygon(item)) for item in areas if item.is_area()])
        maps.append(shapely.make_valid(shapely.transform(found, lambda xy: np.column_stack(to_utm.transform(*xy.T)))))

    def missing(these, others):
        tree, lost = shapely.STRtree(others), 0.0
        for one in these:
            near = others[tree.query(one, predicate="intersects")]
            shared = shapely.area(shapely.intersection(near, one))
            if not (shared / (shapely.area(near) + one.area - shared) > 0.3).any():
                lost += shapely.area(shapely.difference(one, shapely.union_all(near)))
        return lost / shapely.area(these).sum()

    old, new = maps
    return len(old), len(new), missing(old, new), missing(new, old)


@pytest.mark.real
@pytest.mark.slow
@pytest.mark.parametrize(
    ("place", "days", "epsg"),
    [
        ("ramsey", ("2018-10-19", "2021-11-07"), 32630),
        ("douglas", ("2018-10-19", "2021-11-07"), 32630),
        ("klaksvik", ("2014-01-01", "2018-06-19"), 32629),
        ("neubrandenburg", ("2014-05-09", "2016-02-10"), 32633),
    ],
)
def test_a_plain_recount_finds_the_same_buildings_gone_and_come(real_extracts, place, days, epsg):
    found, _ = changes(real_extracts, place, days)
    before, after, vanished, appeared = recount(real_extracts, place, days, epsg)
    assert (before, after) == (pytest.approx(found["n_from"], rel=0.01), pytest.approx(found["n_to"], rel=0.01))
    assert vanished == pytest.approx(found["vanished_share"], abs=0.002)
    assert appeared == pytest.approx(found["appeared_share"], abs=0.01)


def test_causes_are_numbered_as_they_are_named():
    assert (CAUSES[WORLD], CAUSES[MAPPING]) == ("world", "mapping")
