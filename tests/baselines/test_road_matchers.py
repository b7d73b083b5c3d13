# SPDX-License-Identifier: Apache-2.0
"""Matchers of roads: cases worked by hand, the property that each must have, and what they find."""

from dataclasses import replace

import numpy as np
import pytest
import shapely
from hypothesis import given
from hypothesis import strategies as st
from sasgeo_baselines.pose_votes import Votes, rigid_poses
from sasgeo_baselines.road_2rit import JUNCTIONS, Road2Rit, Tuples, same_arms
from sasgeo_baselines.road_alignment import (
    Alignment,
    Borders,
    PopovRoadplane,
    matrix_of,
    straightened,
    through,
    upright,
)
from sasgeo_baselines.roads import MappedRoads, SeenRoads

from sasgeo_bench.geometry.grid import Grid
from sasgeo_bench.geometry.pose import Pose, inverse
from sasgeo_bench.matching.matcher import Match, check_match
from sasgeo_bench.regions.evidence import PRESENT, UNKNOWN
from sasgeo_bench.sasgeo.nodes import MOST_ARMS, Nodes
from sasgeo_bench.search.plan import Disc
from sasgeo_bench.tasks.vectors import vector_table
from tests.baselines.worlds import PRIOR, hidden, streets
from tests.made_up import HERE, error_m

DISC = Disc(center_m=PRIOR.center_m, radius_m=100.0)
VIEW = 176
TILT = matrix_of(np.array([0.0, 0, 0, 0, 0, 0, 0.12, -0.15]))


@pytest.fixture(scope="module")
def region():
    return streets().region


@pytest.fixture
def query():
    return streets().query(VIEW)


def test_a_view_of_vectors_is_found_by_its_junctions(query, region):
    matcher = Road2Rit()
    matcher.prepare(region, None)
    assert matcher.match(query, top_k=1).scores[0] > 0.9
    view = shapely.box(-VIEW / 2, -VIEW / 2, VIEW / 2, VIEW / 2)
    mapped = shapely.transform(region.features.geometry.to_numpy(), inverse(HERE).to_map)
    cut = [street for street in shapely.intersection(mapped, view) if not street.is_empty]
    point = shapely.LineString([(0, 0), (0, 0)])  # as a detector may draw it
    drawn = vector_table([("road_minor", 0, False, street) for street in (*cut, point)])
    answer = matcher.match(replace(query, vectors=drawn), top_k=1)
    assert error_m(answer) < 1
    assert answer.scores[0] > 0.9


@given(st.floats(0, 359), st.integers(2, 5), st.integers(0, 9))
def test_patterns_laid_by_a_pose_name_it(yaw_deg, count, seed):
    here = Pose(easting_m=1000.0, northing_m=-70.0, yaw_deg=yaw_deg)
    seen_m = np.random.default_rng(seed).uniform(-90, 90, (count, 2))
    east_m, north_m, found_deg = rigid_poses(seen_m[None], here.to_map(seen_m)[None])[0]
    assert (east_m, north_m) == pytest.approx((1000.0, -70.0))
    assert np.cos(np.radians(found_deg - yaw_deg)) == pytest.approx(1.0)


def junctions(places_m, arms_deg):
    count = len(places_m)
    arms = np.full((count, MOST_ARMS), np.nan)
    arms[:, : len(arms_deg[0])] = arms_deg
    return Nodes(
        places_m=np.array(places_m, dtype=np.float64),
        kind=np.full(count, JUNCTIONS[0]),
        degree=np.full(count, 3),
        area_m2=np.full(count, np.nan),
        reach_m=np.zeros(count),
        arms_deg=arms,
        pairs=np.zeros((0, 2), dtype=np.int64),
        relation=np.zeros(0, dtype=np.int64),
        feature=np.full(count, -1),
    )


def test_a_tuple_by_hand():
    """From the south-western junction the other one lies due east: all bearings count from there."""
    nodes = junctions([[0, 0], [60, 0], [900, 0]], [[90.0, 180.0, 270.0], [270.0, 0.0, 90.0], [0.0, 90.0, 180.0]])
    found = Tuples.of(nodes, JUNCTIONS[0])
    assert found.length_m.tolist() == [60.0]
    assert found.arms_deg[0, :, :3].tolist() == [[0.0, 90.0, 180.0], [180.0, 270.0, 0.0]]
    assert found.turned().arms_deg[0, :, :3].tolist() == [[0.0, 90.0, 180.0], [180.0, 270.0, 0.0]]
    again = found.turned().turned()
    np.testing.assert_array_equal(again.ends_m, found.ends_m)
    np.testing.assert_array_equal(again.arms_deg, found.arms_deg)


@given(st.lists(st.integers(0, 359), min_size=3, max_size=5), st.integers(0, 359))
def test_junctions_are_the_same_from_wherever_bearings_count(arms_deg, turn_deg):
    ours, theirs = np.array(arms_deg, dtype=float), np.array([[0.0, 90.0, 200.0, np.nan]])
    assert same_arms(ours, theirs, turn_deg=20.0, least=2) == same_arms(
        ours + turn_deg, theirs + turn_deg, turn_deg=20.0, least=2
    )
    assert same_arms(ours, ours[None], turn_deg=20.0, least=2).all()


def test_votes_that_agree_make_a_crowd_and_the_heaviest_is_first():
    poses = np.array([[0.0, 0.0, 358.0], [3.0, 0.0, 2.0], [50.0, 0.0, 0.0], [0.0, 0.0, 90.0]])
    first, second, third = Votes.of(poses, np.array([1.0, 1.0, 3.0, 0.5])).crowds(count=9)
    assert (first.rows.tolist(), second.rows.tolist(), third.rows.tolist()) == ([2], [0, 1], [3])
    assert second.mode.pose.easting_m == pytest.approx(1.5)
    assert np.cos(np.radians(second.mode.pose.yaw_deg)) == pytest.approx(1.0)


@given(st.lists(st.floats(0.1, 1.0), min_size=3, max_size=8), st.randoms(use_true_random=False))
def test_crowds_of_the_same_weights_tie_in_whatever_order_they_are_summed(weights, random):
    shuffled = [random.sample(weights, len(weights)) for _ in range(8)]
    east_m = np.repeat(100.0 * np.arange(len(shuffled)), len(weights))
    poses = np.column_stack([east_m, np.zeros((len(east_m), 2))])
    scores = [crowd.mode.score for crowd in Votes.of(poses, np.concatenate(shuffled)).crowds(count=8)]
    assert len(scores) == len(shuffled)
    assert scores == sorted(scores, reverse=True)


def test_agreement_of_roads_by_hand(made):
    """Of a road 100 m long and 5 m wide half is mapped; a mapped one beside it is not seen."""
    layers = np.zeros((3, 100, 100), dtype=np.uint8)
    layers[1, 48:53, :] = 1
    seen = made.query_of(made.view_of(made.region_of(layers), pose := _middle(), size_cells=100), PRIOR)
    roads = SeenRoads.of(seen)
    assert MappedRoads.of(made.region_of(layers)).agreement(roads, pose) == pytest.approx(1.0)
    half, other = layers.copy(), layers.copy()
    half[1, :, 50:] = 0
    assert MappedRoads.of(made.region_of(half)).agreement(roads, pose) == pytest.approx(0.55, abs=0.03)
    other[1, 80:85, :] = 1
    assert MappedRoads.of(made.region_of(other)).agreement(roads, pose) == pytest.approx(0.5, abs=0.03)
    part = seen.evidence.cells.copy()
    part[:, 70:] = UNKNOWN
    unsure = SeenRoads.of(replace(seen, evidence=seen.evidence.replace(part)))
    assert MappedRoads.of(made.region_of(other)).agreement(unsure, pose) == pytest.approx(1.0)


def _middle():
    return Pose(easting_m=1050.0, northing_m=8950.0, yaw_deg=0.0)


def test_a_fit_to_roads_brings_a_pose_back(query, region):
    off = replace(HERE, easting_m=HERE.easting_m + 4.0, northing_m=HERE.northing_m - 3.0, yaw_deg=HERE.yaw_deg + 2.0)
    roads = MappedRoads.of(region)
    found = roads.settled(SeenRoads.of(query), off, DISC)
    assert np.hypot(found.easting_m - HERE.easting_m, found.northing_m - HERE.northing_m) < 1
    assert found.yaw_deg == pytest.approx(HERE.yaw_deg, abs=0.5)


@given(st.lists(st.floats(-0.2, 0.2), min_size=8, max_size=8))
def test_no_similarity_is_left_in_an_upright_homography(parameters):
    once = upright(matrix_of(np.array(parameters)))
    np.testing.assert_allclose(upright(once), once, atol=1e-6)
    turned = np.array([[0.9, 0.5, 0.1], [-0.5, 0.9, -0.3], [0.0, 0.0, 1.0]])
    np.testing.assert_allclose(upright(turned @ once), once, atol=1e-6)


def test_borders_of_roads_undo_a_tilt(query, region):
    """The view is tilted by 0.19 of a half at its edge; what is left after the alignment is a tenth of that."""
    tilt = upright(TILT)
    seen = straightened(query, np.linalg.inv(tilt))
    front = PopovRoadplane(Still([]))
    front.prepare(region, None)
    found = front.alignment(seen, [replace(HERE, easting_m=HERE.easting_m + 2.0)])
    assert found.before < 0.6
    assert found.share > 0.9
    corners = np.array([[-0.9, -0.9], [0.9, -0.9], [0.0, 0.0], [0.9, 0.9], [-0.9, 0.9]])
    left = through(found.matrix, corners) - through(tilt, corners)
    before = corners - through(tilt, corners)
    assert np.square(left).sum() < 0.02 * np.square(before).sum()


def test_a_straightened_view_moves_its_vectors_with_its_cells(query):
    """A house 50 m ahead, drawn as a vector, too, is seen farther away."""
    cells = np.zeros_like(query.evidence.cells)
    cells[0, 34:42, 84:92] = PRESENT
    house = vector_table([("building", 0, False, shapely.box(-4, 46, 4, 54))])
    asked = replace(query, evidence=query.evidence.replace(cells), vectors=house)
    found = straightened(asked, matrix_of(np.array([0, 0, 0, 0, 0, 0, 0, -0.2])))
    row, col = np.argwhere(found.evidence.cells[0] == PRESENT).mean(axis=0)
    middle = found.vectors.geometry.iloc[0].centroid
    assert (col + 0.5 - 88, 88 - row - 0.5) == pytest.approx((middle.x, middle.y), abs=0.5)
    assert middle.y == pytest.approx(50 / (1 - 0.2 * 50 / 88), abs=0.3)
    assert straightened(asked, np.eye(3)).evidence.cells.tolist() == cells.tolist()


class Still:
    """A matcher that always answers the same place, with a score for each time that it is asked."""

    card = PopovRoadplane.card

    def __init__(self, scores):
        self.scores, self.asked = scores, []

    def prepare(self, region, learned):
        del region, learned

    def match(self, query, *, top_k):
        self.asked.append(query)
        return Match(poses=[HERE][:top_k], scores=[self.scores[len(self.asked) - 1]])


@pytest.mark.parametrize(("scores", "best"), [((0.5, 0.6), 0.6), ((0.5, 0.4), 0.5)])
def test_the_answer_with_the_higher_score_stands(query, region, scores, best):
    inner = Still(scores)
    front = PopovRoadplane(inner)
    front.prepare(region, None)
    seen = straightened(query, np.linalg.inv(upright(TILT)))
    answer = check_match(front.match(seen, top_k=1), seen, top_k=1)
    assert answer.scores == [best]
    assert answer.poses == [HERE]
    assert inner.asked[1].prior.center_m == (HERE.easting_m, HERE.northing_m)
    assert answer.diagnostics["is_straightened"] == (best == 0.6)
    assert len(inner.asked) == 2


def test_a_view_that_lies_flat_or_shows_no_road_is_matched_as_it_is(query, region):
    for seen in (query, hidden(query, slice(VIEW))):
        inner = Still((0.5,))
        front = PopovRoadplane(inner)
        front.prepare(region, None)
        assert front.match(seen, top_k=1).scores == [0.5]
        assert inner.asked == [seen]


def test_borders_face_off_the_road_and_end_before_what_is_unknown():
    present, known = np.zeros((2, 60, 60), dtype=bool)
    present[20:26], known[:, :40] = True, True
    grid = Grid(epsg=0, west_m=0.0, north_m=60.0, cell_size_m=1.0, rows=60, cols=60)
    found = Borders.of(present, known, grid)
    assert sorted(set(found.places_m[:, 1])) == [34.0, 40.0]
    assert (found.outward[:, 1] * (found.places_m[:, 1] - 37.0) > 0).all()
    assert found.places_m[:, 0].max() < 38
    straight = Alignment.of(found, found, Pose(easting_m=0.0, northing_m=0.0, yaw_deg=0.0), 30.0)
    assert straight.share == straight.before == 1.0
