# SPDX-License-Identifier: Apache-2.0
"""What every matcher holds: its card, its answers on an embedded town, what it finds on a made-up map that suits it."""

import tomllib
from collections.abc import Callable
from copy import deepcopy
from dataclasses import replace
from functools import cache
from importlib import import_module
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest
from sasgeo_baselines.global_descriptor import GlobalDescriptor, Sums
from sasgeo_baselines.map_density_prior import MapDensityPrior

from sasgeo_bench.core.plugins import YARDSTICK
from sasgeo_bench.geometry.pose import Pose, Prior
from sasgeo_bench.matching.matcher import MatcherCard, check_match
from sasgeo_bench.regions.evidence import UNKNOWN, Evidence
from sasgeo_bench.regions.region_files import read_region
from sasgeo_bench.tasks.task_files import read_queries, read_truths
from tests.baselines import worlds
from tests.baselines.worlds import World
from tests.made_up import error_m
from tests.slow import rest_slow

ROOT = Path(__file__).parents[2]
LIBRARY, BASELINES = (
    tomllib.loads(path.read_text(encoding="utf-8"))["project"]["entry-points"]["sasgeo_bench.matchers"]
    for path in (ROOT / "pyproject.toml", ROOT / "baselines" / "pyproject.toml")
)
NEEDS_TRAINING = ("orienternet_template",)  # and PyTorch: tests/baselines/test_orienternet.py
# Yardsticks have tests of their own: tests/baselines/test_oracle_objects.py.
# Those that look at pictures have nothing to look at on these towns: tests/baselines/test_image_matchers.py.
REGISTERED = {name: value for name, value in LIBRARY.items() if ".controls." in value} | {
    name: value
    for name, value in BASELINES.items()
    if ".image." not in value and name not in NEEDS_TRAINING and not name.startswith(YARDSTICK)
}
# These withhold where a view shows few whole objects.
OF_OBJECTS = (
    *("liu_object_graph", "ouyang_shape_votes", "road_2rit", "spatial_graph_clique", "stfm_centroids"),
    "triangle_rsim",
)
CONTROLS = ("random", "prior_centre", "map_density_prior")


class Case(NamedTuple):
    """A map, how many cells a view has, how near it is found, and how many of its columns may be hidden."""

    world: Callable[[], World]
    view_cells: int
    within_m: float
    within_deg: float
    hidden: int


DENSE = Case(worlds.things, 96, 1.0, 1.5, 40)
OBJECTS = Case(worlds.houses, 176, 3.0, 3.0, 36)
TILES = Case(worlds.things, 192, 17.0, 8.0, 80)  # 17 m: half a diagonal of the lattice
CASES = {
    "anyvisloc_pipeline": Case(worlds.things, 160, 3.0, 8.0, 56),
    "brm_grid": Case(worlds.things, 192, 4.0, 3.0, 84),
    "fft_vote": DENSE,
    "full_unknown": DENSE,
    "lcm_balanced": TILES._replace(within_deg=15.0),
    "liu_object_graph": Case(worlds.village, 192, 2.0, 2.0, 80),
    "maplocnet_regress": Case(worlds.things, 160, 12.0, 8.0, 56),
    "ouyang_shape_votes": Case(worlds.suburb, 192, 6.0, 6.0, 70),
    "polar_vsc": Case(worlds.things, 192, 4.0, 3.0, 84),
    "popov_roadplane": Case(worlds.streets, 176, 3.0, 1.0, 50),
    "raster_graph": DENSE,
    "raster_graph_stability": DENSE,
    "raster_soft": DENSE,
    "raster_uniform": DENSE,
    "road_2rit": Case(worlds.streets, 176, 2.0, 1.0, 50),
    "schmidt_segcorr": Case(worlds.things, 128, 3.0, 2.0, 56),
    "spatial_graph_clique": OBJECTS,
    "stfm_centroids": OBJECTS,
    "sues_multi_height": TILES,
    "triangle_rsim": OBJECTS,
    "u1652_instance_retrieval": TILES,
    "ubev_template": Case(worlds.things, 160, 3.0, 2.0, 56),
    "vecmap_phasecorr": Case(worlds.things, 128, 3.0, 2.0, 56),
    "vojir_instance_rays": Case(worlds.suburb, 192, 6.0, 6.0, 70),
    "zhang_hier_consensus": Case(worlds.things, 160, 3.0, 2.0, 70),
    "zilke_semantic_mi": Case(worlds.things, 128, 3.0, 2.0, 56),
}
BEYOND_M = 10.0  # a pose is refined after its search, and may leave the disc by that
NEEDS_NO_CLASS = ("zilke_semantic_mi",)  # mutual information needs none in common


def make(name: str):
    module, _, attribute = REGISTERED[name].partition(":")
    return getattr(import_module(module), attribute)()


@pytest.fixture(scope="module")
def region(town_tasks):
    return read_region(town_tasks / "regions" / "town-grid")


@pytest.fixture(scope="module")
def prepared(region):
    """A matcher by its name, prepared once: what it answers depends on nothing that it was asked before."""

    @cache
    def of_name(name):
        matcher = make(name)
        matcher.prepare(region, None)
        return matcher

    return of_name


@pytest.fixture(scope="module")
def queries(town_tasks):
    return [
        query for query in read_queries(town_tasks / "tasks" / "clean" / "town-grid") if query.evidence.shape[0] < 384
    ]


@pytest.fixture(scope="module")
def two(queries):
    """A small view of each track, searched within 40 m of the middle of its prior and among three candidates."""
    small = [item for item in queries if item.evidence.shape[0] == 96]
    found, listed = (next(item for item in small if item.track == track) for track in ("localization", "retrieval"))
    return [
        replace(found, prior=replace(found.prior, radius_m=40.0, yaw_sigma_deg=5.0)),
        replace(listed, candidates=listed.candidates[:3]),
    ]


@pytest.fixture(scope="module")
def truths(town_tasks):
    return {item.query_id: item for item in read_truths(town_tasks / "truth" / "clean" / "town-grid")}


@pytest.mark.parametrize("name", REGISTERED)
def test_a_matcher_is_registered_under_the_name_of_its_card(name) -> None:
    card = make(name).card
    assert isinstance(card, MatcherCard)
    assert card.name == name
    assert card.licence == "Apache-2.0"
    assert card.limits
    assert set(card.tracks) == {"retrieval", "localization"}


def test_every_matcher_is_registered() -> None:
    assert set(REGISTERED) == {"global_descriptor", "graph_only", *CASES, *CONTROLS}


@pytest.fixture(scope="module")
def without_error(queries, truths):
    """A view that shows whole objects, searched within 100 m of the middle of its prior."""
    found = next(item for item in queries if item.evidence.shape[0] == 192 and truths[item.query_id].role == "control")
    return replace(found, prior=replace(found.prior, radius_m=100.0))


# Of the others below, `make test` asks on made-up maps alone.
ON_A_TOWN = (*OF_OBJECTS, "popov_roadplane", *(name for name in REGISTERED if name not in CASES))


@pytest.mark.parametrize("name", rest_slow(dict.fromkeys((*ON_A_TOWN, *REGISTERED)), but=len(ON_A_TOWN)))
def test_answers_are_valid_and_the_same_in_any_order_and_no_more_than_asked_for(
    name, prepared, two, without_error
) -> None:
    first, second = prepared(name), deepcopy(prepared(name))
    asked = (without_error if name in OF_OBJECTS else two[0], two[1])
    forward = {query.query_id: check_match(first.match(query, top_k=2), query, top_k=2) for query in asked}
    backward = {query.query_id: check_match(second.match(query, top_k=2), query, top_k=2) for query in reversed(asked)}
    assert forward == backward
    found, ranked = forward.values()
    assert found.poses
    assert len(ranked.poses) == 2 or name in OF_OBJECTS
    assert all(match.confidence is None for match in forward.values() if match.poses)


@pytest.mark.parametrize("name", REGISTERED)
def test_a_matcher_says_that_it_must_be_prepared(name, queries) -> None:
    with pytest.raises(RuntimeError, match="prepare"):
        make(name).match(queries[0], top_k=1)


LEARNERS = (
    *("lcm_balanced", "maplocnet_regress", "sues_multi_height", "u1652_instance_retrieval", "vecmap_phasecorr"),
    "vojir_instance_rays",
)


@pytest.mark.parametrize("name", LEARNERS)
def test_a_damaged_learned_text_is_refused_in_one_line(name, region) -> None:
    matcher = make(name)
    for text in ("x", "", "null", "[]", '{"spread": [0]}', '{"building": "much"}'):
        with pytest.raises(ValueError, match=f"^{name}: the learned text is damaged.*learn again$"):
            matcher.prepare(region, text)


@pytest.mark.parametrize("name", [name for name in REGISTERED if name not in {"graph_only", *OF_OBJECTS}])
def test_a_map_of_three_rows_is_borne(name, made, two) -> None:
    matcher, region = make(name), made.region_of(np.zeros((3, 3, 320), dtype=np.uint8))
    matcher.prepare(region, None)
    query = replace(two[0], prior=replace(two[0].prior, center_m=(1100.0, 8999.0)))
    check_match(matcher.match(query, top_k=5), query, top_k=5)


@pytest.mark.parametrize("name", CONTROLS)
def test_controls_do_not_look_at_the_view(name, prepared, queries) -> None:
    matcher = prepared(name)
    for query in queries[:6]:
        other = query.evidence.replace(np.zeros_like(query.evidence.cells))
        changed = replace(query, evidence=other)
        assert matcher.match(changed, top_k=5) == matcher.match(query, top_k=5)


def test_random_places_lie_in_the_disc(region, queries) -> None:
    matcher = make("random")
    matcher.prepare(region, None)
    query = next(item for item in queries if item.prior.center_m is not None)
    points = np.array([(pose.easting_m, pose.northing_m) for pose in matcher.match(query, top_k=500).poses])
    away_m = np.hypot(*(points - query.prior.center_m).T)
    assert away_m.max() <= query.prior.radius_m
    assert (away_m < query.prior.radius_m / 2).mean() == pytest.approx(0.25, abs=0.07)


def test_sums_of_squares_are_those_of_the_cells(made) -> None:
    layers = made.textured(5, side=96)
    layers[:, :8, :8] = 255
    region = made.region_of(layers)
    sums = Sums.of(region)
    # A square on whole coarse cells, its corner unknown: rows and columns 0..31 of the map.
    counted = sums.squares(np.array([(1016.0, 8984.0)]), 32.0)[:, 0]
    inside = layers[:, :32, :32]
    assert counted.tolist() == [*(int((layer == 1).sum()) for layer in inside), 32 * 32 - 64]


def test_the_fullest_place_and_the_likest_shares_are_found_on_a_map_made_for_it(made) -> None:
    layers = np.zeros((3, 400, 400), dtype=np.uint8)
    layers[0, 240:304, 80:144] = (
        1  # one block of houses: its middle is 112 m east, 128 m north of the south-west corner
    )
    region = made.region_of(layers)
    full, likest = MapDensityPrior(), GlobalDescriptor()
    for matcher in (full, likest):
        matcher.prepare(region, None)
    pose = Pose(easting_m=1112.0, northing_m=8728.0, yaw_deg=0.0)
    anywhere = Prior(center_m=None, radius_m=None, yaw_deg=None, yaw_sigma_deg=None, scale_sigma=0.03)
    query = made.query_of(made.view_of(region, pose, size_cells=64), anywhere)
    for matcher in (full, likest):
        best = matcher.match(query, top_k=1).poses[0]
        assert np.hypot(best.easting_m - pose.easting_m, best.northing_m - pose.northing_m) <= 25.0


# On a made-up map that suits it


@pytest.fixture(scope="module")
def suited():
    """A matcher by its name, prepared once on its map."""

    @cache
    def of_name(name):
        made = worlds.LiuOnMadeUp() if name == "liu_object_graph" else make(name)
        made.prepare(CASES[name].world().region, None)
        return made

    return of_name


@pytest.mark.parametrize("name", CASES)
def test_a_view_is_found_alike_whatever_was_asked_before_and_no_answer_is_beyond_the_prior(name, suited) -> None:
    case = CASES[name]
    here, prior = case.world().here, case.world().prior
    query = case.world().query(case.view_cells)
    answer = check_match(suited(name).match(query, top_k=5), query, top_k=5)
    assert error_m(answer, here) < case.within_m
    assert abs(answer.poses[0].yaw_deg - here.yaw_deg) < case.within_deg
    suited(name).match(replace(query, candidates=(replace(here, yaw_deg=0.0),), track="retrieval"), top_k=1)
    assert answer == check_match(suited(name).match(query, top_k=5), query, top_k=5)
    assert answer.confidence is None
    for pose in answer.poses:
        away_m = np.hypot(pose.easting_m - prior.center_m[0], pose.northing_m - prior.center_m[1])
        assert away_m <= prior.radius_m + BEYOND_M


@pytest.mark.parametrize("name", CASES)
def test_a_view_is_found_half_hidden_and_without_a_prior(name, suited) -> None:
    case = CASES[name]
    query = worlds.hidden(case.world().query(case.view_cells, prior=worlds.ANYWHERE), slice(case.hidden))
    answer = suited(name).match(query, top_k=1)
    assert error_m(answer, case.world().here) < case.within_m
    assert abs(answer.poses[0].yaw_deg % 360 - case.world().here.yaw_deg) < case.within_deg


@pytest.mark.parametrize("name", CASES)
def test_candidates_are_ranked_and_copies_tie(name, suited) -> None:
    case = CASES[name]
    here, anywhere = case.world().here, replace(case.world().prior, center_m=None, radius_m=None)
    places = tuple(replace(here, easting_m=here.easting_m + off_m) for off_m in (90.0, 0.0, -90.0, 0.0))
    query = case.world().query(case.view_cells, candidates=places, track="retrieval", prior=anywhere)
    answer = check_match(suited(name).match(query, top_k=4), query, top_k=4)
    assert [pose.easting_m for pose in answer.poses[:2]] == [here.easting_m] * 2
    assert answer.scores[0] == answer.scores[1]
    assert all(score < answer.scores[0] for score in answer.scores[2:])


@pytest.mark.parametrize("name", CASES)
def test_what_shows_nothing_or_lies_beyond_the_map_is_withheld(name, suited) -> None:
    case = CASES[name]
    query = case.world().query(case.view_cells)
    cells = query.evidence.cells
    alien = Evidence(classes=("railway", "green", "farmland")[: len(cells)], cells=cells, cell_size_m=1.0)
    asked = [
        replace(query, evidence=query.evidence.replace(np.full_like(cells, UNKNOWN))),
        replace(query, prior=replace(query.prior, center_m=(90_000.0, 90_000.0))),
    ]
    if name not in NEEDS_NO_CLASS:
        asked.append(replace(query, evidence=alien))
    asked.append(replace(query, evidence=Evidence(classes=("orchard",), cells=cells[:1], cell_size_m=1.0)))
    asked.append(replace(query, candidates=(), track="retrieval"))
    for one in asked:
        answer = suited(name).match(one, top_k=3)
        assert not answer.poses
        assert not answer.scores


@pytest.mark.parametrize("name", CASES)
def test_views_of_few_cells_are_borne(name, suited) -> None:
    query = CASES[name].world().query(CASES[name].view_cells)
    for rows in (1, 6):
        tiny = replace(query, evidence=query.evidence.replace(query.evidence.cells[:, 48 : 48 + rows, 48:49].copy()))
        check_match(suited(name).match(tiny, top_k=5), tiny, top_k=5)


@pytest.mark.parametrize("name", [*OF_OBJECTS, "vojir_instance_rays"])
def test_matchers_of_objects_withhold_where_a_view_or_a_map_has_too_few(name, suited) -> None:
    query = CASES[name].world().query(CASES[name].view_cells)
    bare = make(name)
    bare.prepare(worlds.bare().region, None)
    absent = replace(query, evidence=query.evidence.replace(np.zeros_like(query.evidence.cells)))
    assert not suited(name).match(absent, top_k=3).poses
    assert not bare.match(query, top_k=3).poses
    if name in OF_OBJECTS:
        assert not suited(name).match(worlds.hidden(query, slice(24, None)), top_k=3).poses
