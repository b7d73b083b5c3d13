# SPDX-License-Identifier: Apache-2.0
"""Which maps a training uses: views on older maps, or the same views on maps of their own day."""

import datetime as dt
from dataclasses import replace
from functools import partial
from types import SimpleNamespace

import pytest

from sasgeo_bench.core.errors import ConfigError
from sasgeo_bench.matching.matcher import Training
from sasgeo_bench.sasgeo import learning
from sasgeo_bench.sasgeo.learning import around_views, on_maps_of_the_day, views_by_map
from sasgeo_bench.sasgeo.scorer_model import ScorerModel
from sasgeo_bench.sasgeo.variants import SasgeoFresh, SasgeoFreshAgeless, SasgeoNoGraph

TODAY = dt.date(2025, 9, 1)


def maps(**dates):
    """Maps of which only the date is known, by name; "_at_" stands for @ and "_plus_" for +."""
    names = {name.replace("_at_", "@").replace("_plus_", "+").replace("_", "-"): date for name, date in dates.items()}
    return {
        name: SimpleNamespace(manifest=SimpleNamespace(extract=SimpleNamespace(date=dt.date.fromisoformat(date))))
        for name, date in names.items()
    }


def seen(tiny, *names, day=TODAY):
    """One view on each map."""
    pairs = zip(tiny.queries, tiny.truths, strict=True)
    query, truth = next((query, truth) for query, truth in pairs if truth.pose and query.track == "localization")
    return [(replace(query, query_id=str(at), region=name, observed_on=day), truth) for at, name in enumerate(names)]


def moved(pairs, regions):
    views = on_maps_of_the_day(views_by_map(Training(regions=regions, pairs=pairs)), regions)
    return {name: [query.query_id for query, _ in some] for name, some in views.items()}


def test_views_on_older_maps_move_to_the_map_of_their_day_and_the_rest_stays(tiny):
    regions = maps(vaduz="2025-09-01", vaduz_at_2015_07_27="2015-07-27", vaduz_plus_twins="2025-09-01")
    pairs = seen(tiny, "vaduz@2015-07-27", "vaduz", "vaduz+twins")
    assert moved(pairs, regions) == {"vaduz": ["0", "1"], "vaduz+twins": ["2"]}
    before, truth = pairs[0]
    [(after, same)] = on_maps_of_the_day({"vaduz@2015-07-27": [(before, truth)]}, regions)["vaduz"]
    assert same is truth
    assert replace(after, region=before.region) == before  # truth, prior and view stay as they are
    regions = maps(vaduz="2025-09-01", vaduz_at_2018_01_01="2018-01-01", vaduz_at_2013_08_03="2013-08-03")
    pairs = seen(tiny, "vaduz@2013-08-03", day=dt.date(2018, 1, 1))
    assert moved(pairs, regions) == {"vaduz@2018-01-01": ["0"]}


def test_views_without_a_map_of_their_day_are_dropped_and_none_left_is_said(tiny):
    regions = maps(vaduz="2025-09-01", triesen_at_2015_07_27="2015-07-27", triesen="2024-01-01")
    assert moved(seen(tiny, "triesen@2015-07-27", "vaduz"), regions) == {"vaduz": ["1"]}
    with pytest.raises(ConfigError, match="map of its own day"):
        moved(seen(tiny, "triesen@2015-07-27"), regions)


def near(tiny, count=3):
    """Views of known place whose prior is a disc about it, small beside the map."""
    narrow = {"radius_m": 50.0, "yaw_sigma_deg": 5.0}
    return [
        (replace(query, prior=replace(query.prior, center_m=(pose.easting_m, pose.northing_m), **narrow)), truth)
        for query, truth in zip(tiny.queries, tiny.truths, strict=True)
        if query.suite == "clean" and query.track == "localization" and query.evidence.shape[0] == 192
        for pose in [truth.pose]
    ][:count]


@pytest.mark.slow
def test_an_arm_that_learns_from_maps_of_the_day_keeps_the_rates_of_ageing_set_by_hand(tiny):
    name = tiny.queries[0].region
    regions = {name: tiny.region, f"{name}@2000-01-01": tiny.region}
    pairs = [
        (replace(query, region=f"{name}@2000-01-01", observed_on=tiny.region.manifest.extract.date), truth)
        for query, truth in near(tiny, 2)
    ]
    training = Training(regions=regions, pairs=pairs)
    one, other = (ScorerModel.from_text(arm().learn(training)) for arm in (SasgeoFresh, SasgeoFreshAgeless))
    hand = ScorerModel.by_hand(one.classes)
    for model in (one, other):
        for fitted, start in zip(model.rates, hand.rates, strict=True):
            assert fitted.vanish_per_year == pytest.approx(start.vanish_per_year, rel=1e-3)
            assert fitted.appear_per_year == pytest.approx(start.appear_per_year, rel=1e-3)
    assert one == other  # they differ only where a map is old


@pytest.mark.slow
def test_parts_of_a_large_map_teach_what_the_whole_map_does(tiny, monkeypatch):
    training = Training(regions={tiny.queries[0].region: tiny.region}, pairs=near(tiny, 2))
    whole = SasgeoNoGraph().learn(training)
    cut = partial(around_views, most_values=1)
    monkeypatch.setattr(learning, "around_views", cut)
    assert SasgeoNoGraph().learn(training) == whole


def test_each_view_of_a_large_map_has_a_part_that_holds_its_prior(tiny):
    name = tiny.queries[0].region
    views, regions = around_views({name: near(tiny)}, {name: tiny.region}, most_values=1)
    assert [len(some) for some in views.values()] == [1, 1, 1]
    for own, [(query, truth)] in views.items():
        part, grid = regions[own], tiny.region.grid
        assert query.region == own
        assert part.grid.rows * part.grid.cols < grid.rows * grid.cols
        west_m, south_m, east_m, north_m = part.grid.bounds_m
        reach_m = 50.0 + 96 * 2**0.5
        map_west_m, map_south_m, map_east_m, map_north_m = grid.bounds_m
        assert west_m <= max(truth.pose.easting_m - reach_m, map_west_m)
        assert east_m >= min(truth.pose.easting_m + reach_m, map_east_m)
        assert south_m <= max(truth.pose.northing_m - reach_m, map_south_m)
        assert north_m >= min(truth.pose.northing_m + reach_m, map_north_m)
        row, col = ((map_north_m - north_m) / grid.cell_size_m, (west_m - map_west_m) / grid.cell_size_m)
        window = tiny.region.layers[:, int(row) :, int(col) :][:, : part.grid.rows, : part.grid.cols]
        assert (part.layers == window).all()
        assert part.manifest.extract == tiny.region.manifest.extract


def test_small_maps_and_views_from_anywhere_keep_the_whole_map(tiny):
    name = tiny.queries[0].region
    some = near(tiny)
    views, regions = around_views({name: some}, {name: tiny.region})
    assert (views[name], regions[name]) == (some, tiny.region)
    lost = [(replace(query, prior=replace(query.prior, center_m=None, radius_m=None)), truth) for query, truth in some]
    assert list(around_views({name: lost}, {name: tiny.region}, most_values=1)[0]) == [name]
