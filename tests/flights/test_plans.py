# SPDX-License-Identifier: Apache-2.0
"""Flight plans: inside the mapped ground, as long as asked, of their kind, and the same for the same seed."""

from collections.abc import Callable
from dataclasses import replace
from functools import lru_cache
from pathlib import Path

import geopandas as gpd
import numpy as np
import pytest
import shapely
from hypothesis import given
from hypothesis import strategies as st

from sasgeo_bench.core.errors import FlightError
from sasgeo_bench.flights.kinematics import Limits, length_m
from sasgeo_bench.flights.plans import KINDS, Corridors, flight_area, plan_flight
from sasgeo_bench.regions.region import Region
from sasgeo_bench.regions.region_files import read_region

TOWNS = ("town-grid", "town-industrial", "town-riverside", "town-suburb")  # a fifth of the industrial town is unknown


@pytest.fixture(scope="module")
def regions(lay_towns: Callable[..., Path], tmp_path_factory: pytest.TempPathFactory) -> Callable[[str], Region]:
    out = lay_towns(tmp_path_factory.mktemp("flown") / "out", *TOWNS)
    return lru_cache(lambda name: read_region(out / "regions" / name))


def _drawn(region: Region, kind: str, *, seed: int = 0, **wish: object) -> np.ndarray:
    return plan_flight(region, kind, rng=np.random.default_rng(seed), **({"length_m": 2000.0} | wish))  # type: ignore[arg-type]


def _turns_deg(path_m: np.ndarray) -> np.ndarray:
    course = np.unwrap(np.arctan2(*np.diff(path_m, axis=0).T))
    return np.degrees(np.diff(course))


@given(
    town=st.sampled_from(TOWNS),
    kind=st.sampled_from(KINDS),
    along=st.sampled_from(("road", "water")),
    asked_m=st.floats(1000.0, 10_000.0),
    margin_m=st.floats(0.0, 200.0),
    seed=st.integers(0, 2**32 - 1),
)
def test_a_plan_is_inside_and_as_long_as_asked_or_is_refused_in_one_line(
    regions, town, kind, along, asked_m, margin_m, seed
) -> None:
    region = regions(town)
    refusal = ""
    try:
        path_m = _drawn(region, kind, seed=seed, length_m=asked_m, margin_m=margin_m, along=along)
    except FlightError as error:
        refusal = str(error)
    if refusal:
        assert refusal.isprintable()
        assert f"margin of {margin_m:g} m" in refusal
        return
    assert length_m(path_m) == pytest.approx(asked_m, rel=0.02)
    line = shapely.LineString(path_m)
    assert flight_area(region, margin_m).covers(line)
    assert region.coverage.covers(line)
    assert line.distance(region.coverage.exterior) >= margin_m - 1e-6
    cells = region.grid.to_cells(path_m)
    assert (cells >= 0).all()
    assert (cells < region.grid.shape).all()


@pytest.mark.parametrize("kind", KINDS)
def test_the_same_seed_draws_the_same_plan_and_another_another(regions: Callable[[str], Region], kind: str) -> None:
    first, again, other = (_drawn(regions("town-grid"), kind, seed=seed) for seed in (1, 1, 2))
    assert np.array_equal(first, again)
    assert not np.array_equal(first[:10], other[:10])


def test_a_corridor_does_not_depend_on_the_order_of_the_features(regions: Callable[[str], Region]) -> None:
    region = regions("town-riverside")
    turned = replace(region, features=region.features.iloc[::-1])
    assert np.array_equal(_drawn(region, "corridor"), _drawn(turned, "corridor"))


@pytest.mark.parametrize(("town", "along", "names"), [
    ("town-grid", "road", ["road_major", "road_minor"]),
    ("town-industrial", "water", ["waterway"]),
])  # fmt: skip
def test_a_corridor_follows_roads_or_a_waterway_without_u_turns(regions, town, along, names) -> None:
    region = regions(town)
    path_m = _drawn(region, "corridor", along=along, length_m=1500.0)
    ways = shapely.union_all(region.features[region.features["class"].isin(names)].geometry.to_numpy())
    assert shapely.distance(shapely.points(path_m), ways).max() < 30  # what is cut off a corner
    course = np.cumsum(_turns_deg(path_m))
    ahead = 20  # points of 2 m: within 40 m it never turns back
    assert np.abs(course[ahead:] - course[:-ahead]).max() < 130


def test_a_corridor_does_not_turn_back_over_a_link_between_carriageways() -> None:
    """Two roads 20 m from each other, with links each 150 m and at their ends: the way goes on, or straight over."""
    roads = [shapely.LineString([(at * 150, north) for at in range(9)]) for north in (0, 20)]
    links = [shapely.LineString([(at * 150, 0), (at * 150, 20)]) for at in range(9)]
    features = gpd.GeoDataFrame({"class": "road_major"}, geometry=[*roads, *links], index=range(11), crs=32632)
    corridors = Corridors.of(features, shapely.box(-500, -500, 2000, 500), "road")
    walks = [corridors.walk(700.0, np.random.default_rng(seed)) for seed in range(20)]
    found = [np.diff(walked[:, 0]) for walked in walks if walked is not None]
    assert len(found) > 5
    assert all((east >= -1e-6).all() or (east <= 1e-6).all() for east in found)


def test_a_survey_has_parallel_legs_one_spacing_apart(regions: Callable[[str], Region]) -> None:
    path_m = _drawn(regions("town-grid"), "survey", length_m=5000.0)
    sides = np.diff(path_m, axis=0)
    legs = sides[np.hypot(*sides.T) > 100]
    heading = np.degrees(np.arctan2(*legs.T)) % 180
    assert len(legs) >= 3
    assert np.ptp(heading) == pytest.approx(0, abs=1e-6)
    forward = legs @ legs[0]
    assert (np.sign(forward) == np.resize([1, -1], len(legs))).all()
    across = np.array([-legs[0, 1], legs[0, 0]]) / np.hypot(*legs[0])
    starts = (path_m[:-1][np.hypot(*sides.T) > 100] @ across).round(6)
    assert np.ptp(np.diff(starts)) == pytest.approx(0, abs=1e-5)
    assert 40 <= abs(starts[1] - starts[0]) <= 80
    width_m = abs(starts[-1] - starts[0])
    assert np.hypot(*legs.T).max() > 0.9 * width_m  # legs lie along the longer side


def test_a_long_survey_lies_along_the_longer_side_of_what_is_mapped(regions: Callable[[str], Region]) -> None:
    region = regions("town-industrial")
    west, south, _, north = region.grid.bounds_m
    strip = shapely.box(west, south, west + 700, north)
    path_m = _drawn(replace(region, coverage=strip), "survey", length_m=10_000.0)
    assert np.ptp(path_m[:, 1]) > 2 * np.ptp(path_m[:, 0])


def test_a_transit_leads_far_away_a_loiter_stays_and_waypoints_have_straight_legs(regions) -> None:
    path_m = _drawn(regions("town-grid"), "transit")
    assert np.hypot(*(path_m[-1] - path_m[0])) > 0.8 * 2000
    assert np.abs(_turns_deg(path_m)).max() < 3
    for seed in range(6):
        path_m = _drawn(regions("town-grid"), "loiter", seed=seed, length_m=6000.0)
        assert np.ptp(path_m, axis=0).max() < 650
        assert np.abs(_turns_deg(path_m)).max() < 6
    path_m = _drawn(regions("town-grid"), "waypoints", length_m=6000.0)
    lengths = np.hypot(*np.diff(path_m, axis=0).T)
    legs = lengths[lengths > 50]
    assert len(legs) >= 5
    assert legs[1:-1].min() > 130  # 150 m less the corners


def test_unknown_ground_within_a_region_is_flown_around(regions: Callable[[str], Region]) -> None:
    region = regions("town-grid")
    middle = shapely.box(*region.grid.bounds_m).centroid.buffer(300)
    holed = replace(region, coverage=region.coverage.difference(middle))
    for kind in KINDS:
        for seed in range(3):
            line = shapely.LineString(_drawn(holed, kind, seed=seed, length_m=1500.0, margin_m=50.0))
            assert line.distance(middle) >= 50 - 1e-6


def test_wide_corners_come_with_slow_turns(regions: Callable[[str], Region]) -> None:
    wide = Limits(speed_mps=(12.0, 12.0), corner_mps=12.0)
    path_m = _drawn(regions("town-grid"), "survey", limits=wide)
    arcs = np.hypot(*np.diff(path_m, axis=0).T)[1:]
    turns = np.abs(_turns_deg(path_m))
    radius_m = arcs[turns > 0.1] / np.radians(turns[turns > 0.1])
    assert np.median(radius_m) == pytest.approx(min(wide.turn_radius_m, 40), rel=0.1)


def test_what_does_not_fit_is_refused_with_what_does(regions: Callable[[str], Region]) -> None:
    with pytest.raises(
        FlightError, match=r"no transit of 5000 m in town-riverside .*: one of 1[0-9]00 m fits; for more"
    ):
        _drawn(regions("town-riverside"), "transit", length_m=5000.0)
    with pytest.raises(
        FlightError, match=r"no corridor along water of 2000 m in town-grid .*, nor one of 1000 m: take"
    ):
        _drawn(regions("town-grid"), "corridor", along="water")
    for kind in KINDS:
        with pytest.raises(FlightError, match=rf"no {kind}.* with a margin of 600 m, nor one of 1000 m"):
            _drawn(regions("town-riverside"), kind, margin_m=600.0)


@pytest.mark.parametrize(
    ("wish", "match"),
    [
        ({"length_m": 500.0}, "length_m lies in 1000..10000, got 500"),
        ({"length_m": float("nan")}, "length_m lies in"),
        ({"margin_m": -1.0}, "margin_m is a distance"),
        ({"kind": "corridor", "along": "rail"}, "along one of road, water, got 'rail'"),
        ({"kind": "joyride"}, "one of survey, corridor, transit, loiter, waypoints, got 'joyride'"),
    ],
)
def test_wishes_that_cannot_be_are_refused(regions: Callable[[str], Region], wish: dict, match: str) -> None:
    with pytest.raises(FlightError, match=match):
        _drawn(regions("town-suburb"), **({"kind": "loiter"} | wish))
