# SPDX-License-Identifier: Apache-2.0
"""The lookalike is found by rule, and is scored by the terms of the joint score."""

from dataclasses import replace

import numpy as np
import pytest

from sasgeo_bench.errors import ConfigError
from sasgeo_bench.leaderboard.lookalike import find_lookalike, find_pair
from sasgeo_bench.regions.region_files import read_region
from sasgeo_bench.sasgeo.scorer_model import ScorerModel
from sasgeo_bench.tasks.suites.mining import RINGS, Windows, min_distance_m


def windows(shares, *, spacing_m):
    """Places in a row, of which only shares of two classes are told."""
    table = np.array(shares, dtype=np.float32)
    return Windows(
        points_m=np.column_stack((np.arange(len(table)) * spacing_m, np.zeros(len(table)))),
        radius_m=100.0,
        shares=np.repeat(table, RINGS, axis=1),
        plain={"histogram": table},
        polar=np.zeros((len(table), 1, 1), dtype=np.float32),
        spectrum=np.zeros((len(table), 1), dtype=np.float32),
    )


def test_the_most_varied_place_gets_its_like_that_is_far_enough():
    shares = [(0.2, 0.2), (0.2, 0.2), (0.4, 0.0), (0.21, 0.1), (0.9, 0.0), (0.0, 0.5)]
    pair = find_pair(windows(shares, spacing_m=min_distance_m(100.0) / 2))
    assert pair.here_m == (0.0, 0.0)
    # The second place has the same shares, but lies too near.
    assert pair.there_m[0] == pytest.approx(1.5 * min_distance_m(100.0))
    assert pair.distance == pytest.approx(np.hypot(0.01, 0.1), abs=1e-5)


def test_where_all_places_are_near_or_empty_there_is_no_pair():
    for shares, spacing_m in (([(0.2, 0.2)] * 3, 10.0), ([(0.0, 0.01)] * 3, 1000.0)):
        with pytest.raises(ConfigError, match="choose a larger one"):
            find_pair(windows(shares, spacing_m=spacing_m))


def test_the_true_place_beats_its_lookalike_on_a_fresh_map(towns):
    town = read_region(towns / "regions" / "town-riverside")
    found = find_lookalike(town, town, ScorerModel.by_hand(town.classes), side_m=96.0)
    assert found.age_years == 0
    assert found.terms.loc["joint", "true place"] > found.terms.loc["joint", "lookalike"]
    for name in ("true place", "lookalike"):
        assert found.terms.loc["raster", name] == pytest.approx(found.scores[f"score {name}"].sum())
        assert found.terms.loc["joint", name] == pytest.approx(found.terms[name].iloc[:3].sum())
    assert found.scores["share view"].to_numpy() == pytest.approx(found.scores["share true place"].to_numpy(), abs=0.01)


def test_two_places_and_a_map_of_the_future_are_refused(towns):
    town, other = (read_region(towns / "regions" / name) for name in ("town-riverside", "town-grid"))
    hand = ScorerModel.by_hand(town.classes)
    with pytest.raises(ConfigError, match="not one region at two dates"):
        find_lookalike(town, other, hand, side_m=96.0)
    extract = town.manifest.extract
    older = extract.model_copy(update={"date": extract.date.replace(year=2000)})
    past = replace(town, manifest=town.manifest.model_copy(update={"extract": older}))
    with pytest.raises(ConfigError, match="swap them"):
        find_lookalike(town, past, hand, side_m=96.0)
