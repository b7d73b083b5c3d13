# SPDX-License-Identifier: Apache-2.0
"""Which maps a training uses: views on older maps, or the same views on maps of their own day."""

import datetime as dt
from dataclasses import replace
from types import SimpleNamespace

import pytest

from sasgeo_bench.errors import ConfigError
from sasgeo_bench.matching.matcher import Training
from sasgeo_bench.sasgeo.learning import on_maps_of_the_day, views_by_map
from sasgeo_bench.sasgeo.scorer_model import ScorerModel
from sasgeo_bench.sasgeo.variants import SasgeoFresh, SasgeoFreshAgeless

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


def test_the_truth_the_prior_and_the_view_stay_as_they_are(tiny):
    regions = maps(vaduz="2025-09-01", vaduz_at_2015_07_27="2015-07-27")
    [(before, truth)] = seen(tiny, "vaduz@2015-07-27")
    [(after, same)] = on_maps_of_the_day({"vaduz@2015-07-27": [(before, truth)]}, regions)["vaduz"]
    assert same is truth
    assert replace(after, region=before.region) == before


def test_a_view_of_an_older_day_moves_to_the_map_of_that_day(tiny):
    regions = maps(vaduz="2025-09-01", vaduz_at_2018_01_01="2018-01-01", vaduz_at_2013_08_03="2013-08-03")
    pairs = seen(tiny, "vaduz@2013-08-03", day=dt.date(2018, 1, 1))
    assert moved(pairs, regions) == {"vaduz@2018-01-01": ["0"]}


def test_views_without_a_map_of_their_day_are_dropped_and_none_left_is_said(tiny):
    regions = maps(vaduz="2025-09-01", triesen_at_2015_07_27="2015-07-27", triesen="2024-01-01")
    assert moved(seen(tiny, "triesen@2015-07-27", "vaduz"), regions) == {"vaduz": ["1"]}
    with pytest.raises(ConfigError, match="map of its own day"):
        moved(seen(tiny, "triesen@2015-07-27"), regions)


def test_an_arm_that_learns_from_maps_of_the_day_keeps_the_rates_of_ageing_set_by_hand(tiny):
    name = tiny.queries[0].region
    regions = {name: tiny.region, f"{name}@2000-01-01": tiny.region}
    pairs = [
        (replace(query, region=f"{name}@2000-01-01", observed_on=tiny.region.manifest.extract.date), truth)
        for query, truth in zip(tiny.queries, tiny.truths, strict=True)
        if query.suite == "clean" and query.track == "localization" and query.evidence.shape[0] == 192
    ]
    training = Training(regions=regions, pairs=pairs[:2])
    one, other = (ScorerModel.from_text(arm().learn(training)) for arm in (SasgeoFresh, SasgeoFreshAgeless))
    hand = ScorerModel.by_hand(one.classes)
    for model in (one, other):
        for fitted, start in zip(model.rates, hand.rates, strict=True):
            assert fitted.vanish_per_year == pytest.approx(start.vanish_per_year, rel=1e-3)
            assert fitted.appear_per_year == pytest.approx(start.appear_per_year, rel=1e-3)
    assert one == other  # they differ only where a map is old
