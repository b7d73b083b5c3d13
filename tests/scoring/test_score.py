# SPDX-License-Identifier: Apache-2.0
"""Scored rows: every query has one, and what is right is decided by hand here."""

import math
from dataclasses import replace

import numpy as np
import pytest

from sasgeo_bench.core.errors import MetricError
from sasgeo_bench.geometry.pose import Pose
from sasgeo_bench.matching.matcher import Prediction
from sasgeo_bench.scoring.score import COLUMNS, score_task, settle_not_applicable
from sasgeo_bench.tasks.query import Head, Truth

HERE = Pose(easting_m=100.0, northing_m=200.0, yaw_deg=350.0)
HEAD = Head(
    query_id="a",
    track="localization",
    suite="clean",
    suite_version=1,
    part="crossfit",
    region="vaduz+alias",
    view_cells=192,
    cell_size_m=1.0,
    prior_group="r500-weak-s3",
)
TRUTH = Truth(
    query_id="a",
    is_present=True,
    pose=HERE,
    candidate=-1,
    pair_id="p",
    role="stress",
    kind="U1",
    strength=0.3,
    strength_unit="share",
    unknown_share=0.3,
    changed_share=0.0,
    feature_density=0.1,
    alias_index=0.8,
    block="vaduz/0-0",
    scene="urban",
)


def answer(*places, scores=None, **changes):
    """Poses (east, north, yaw) with scores falling by one, unless given."""
    poses = [Pose(easting_m=east, northing_m=north, yaw_deg=yaw) for east, north, yaw in places]
    scores = scores or [-float(at) for at in range(len(poses))]
    return Prediction(query_id="a", candidates=tuple(zip(poses, scores, strict=True)), **changes)


def row_of(prediction, *, head=HEAD, truth=TRUTH, **changes):
    found = {} if prediction is None else {prediction.query_id: prediction}
    table = score_task([head], [truth], found, **changes)
    assert tuple(table.columns) == COLUMNS
    (row,) = table.to_dict("records")
    return row


def test_errors_are_those_of_the_first_pose():
    row = row_of(answer((103.0, 204.0, 5.0), (100.0, 200.0, 350.0), confidence=0.7, latency_s=0.2))
    assert (row["position_error_m"], row["yaw_error_deg"], row["log_scale_error"]) == (5.0, 15.0, 0.0)
    assert (row["is_right"], row["is_answered"], row["confidence"], row["latency_s"]) == (True, True, 0.7, 0.2)
    assert (row["place"], row["region"], row["pool"]) == ("vaduz", "vaduz+alias", 0)


@pytest.mark.parametrize(("east", "is_right"), [(125.0, True), (125.1, False)])
def test_a_fix_is_right_within_25_metres(east, is_right):
    assert row_of(answer((east, 200.0, 0.0)))["is_right"] is is_right


@pytest.mark.parametrize(
    "prediction",
    [None, Prediction(query_id="a"), Prediction(query_id="a", status="timeout", message="late")],
)
def test_no_answer_is_an_infinite_error_and_never_left_out(prediction):
    row = row_of(prediction)
    assert row["position_error_m"] == row["yaw_error_deg"] == math.inf
    assert not row["is_right"]
    assert not row["is_answered"]
    assert row["status"] == ("missing" if prediction is None else prediction.status)
    assert math.isnan(row["confidence"])


def test_an_absent_place_has_no_error_and_no_right_answer():
    absent = replace(TRUTH, is_present=False)
    row = row_of(answer((100.0, 200.0, 350.0)), truth=absent)
    assert math.isnan(row["position_error_m"])
    assert row["is_answered"]
    assert not row["is_right"]


CHOICES = tuple(replace(HERE, easting_m=east) for east in (100.0, 500.0, 900.0))
CHOOSE = replace(HEAD, track="retrieval", candidates=CHOICES)
SECOND = replace(TRUTH, candidate=1, pose=replace(HERE, easting_m=490.0))  # candidates are moved off their places


@pytest.mark.parametrize(
    ("places", "scores", "rank", "is_right"),
    [
        ([(500.0, 200.0, 0.0)], [1.0], (0, 1, 1), True),
        ([(100.0, 200.0, 0.0), (500.0, 200.0, 0.0)], [2.0, 1.0], (1, 1, 1), False),
        ([(100.0, 200.0, 0.0), (500.0, 200.0, 0.0)], [1.0, 1.0], (0, 2, 1), False),
        ([(500.0, 200.0, 0.0), (100.0, 200.0, 0.0)], [1.0, 1.0], (0, 2, 1), True),
        ([(900.0, 200.0, 0.0)], [1.0], (0, 0, 0), False),
    ],
)
def test_the_rank_of_a_candidate_counts_those_above_and_those_tied(places, scores, rank, is_right):
    row = row_of(answer(*places, scores=scores), head=CHOOSE, truth=SECOND)
    assert (row["above"], row["tied"], row["right"]) == rank
    assert row["is_right"] is is_right
    assert row["pool"] == 3
    assert math.isnan(row["position_error_m"])


NEIGHBOURS = replace(CHOOSE, candidates=tuple(replace(HERE, easting_m=east) for east in (100.0, 125.0, 125.1)))
FIRST = replace(TRUTH, candidate=0)


@pytest.mark.parametrize(("east", "rank", "is_right"), [(125.0, (0, 0, 0), True), (125.1, (0, 0, 0), False)])
def test_a_pick_beside_the_right_candidate_is_a_false_fix_only_beyond_25_metres(east, rank, is_right):
    row = row_of(answer((east, 200.0, 90.0)), head=NEIGHBOURS, truth=FIRST)
    assert row["is_right"] is is_right
    assert (row["above"], row["tied"], row["right"]) == rank  # no hit, either way


def test_no_pick_is_right_where_the_true_place_is_not_among_the_candidates():
    removed = replace(FIRST, is_present=False, candidate=-1)
    assert not row_of(answer((125.0, 200.0, 0.0)), head=NEIGHBOURS, truth=removed)["is_right"]


def test_two_candidates_on_one_spot_are_told_apart_by_their_order():
    twins = replace(CHOOSE, candidates=(CHOICES[0], CHOICES[1], CHOICES[1]))
    given = answer((500.0, 200.0, 0.0), (500.0, 200.0, 0.0), scores=[2.0, 1.0])
    first, second = (row_of(given, head=twins, truth=replace(TRUTH, candidate=at)) for at in (1, 2))
    assert (first["above"], second["above"]) == (0, 1)


def test_the_place_is_that_of_the_split():
    assert row_of(None, place_of={"vaduz/0-0": "liechtenstein"})["place"] == "liechtenstein"


def test_truths_and_predictions_of_other_queries_are_refused():
    with pytest.raises(MetricError, match="query a has no truth"):
        score_task([HEAD], [replace(TRUTH, query_id="b")], {})
    with pytest.raises(MetricError, match="prediction b belongs to no query"):
        score_task([HEAD], [TRUTH], {"b": Prediction(query_id="b")})


def test_not_applicable_counts_only_where_all_of_a_group_is():
    heads = [replace(HEAD, query_id=name, suite=suite) for name, suite in (("a", "x"), ("b", "x"), ("c", "y"))]
    truths = [replace(TRUTH, query_id=head.query_id) for head in heads]
    given = {name: Prediction(query_id=name, status="not applicable") for name in ("a", "c")}
    table = settle_not_applicable(score_task(heads, truths, given | {"b": Prediction(query_id="b")}))
    assert table["status"].tolist() == ["missing", "ok", "not applicable"]
    assert np.isinf(table["position_error_m"]).all()
