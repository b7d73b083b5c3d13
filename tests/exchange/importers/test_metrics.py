# SPDX-License-Identifier: Apache-2.0
"""Metrics of other datasets, as their code computes them and as they should be: every known trap by hand."""

import math

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from hypothesis import given
from hypothesis import strategies as st
from sklearn.metrics import average_precision_score

from sasgeo_bench.core.errors import DatasetError, StoreError
from sasgeo_bench.exchange.importers import retrieval
from sasgeo_bench.exchange.importers.items import Dataset, Item, Position
from sasgeo_bench.exchange.importers.kinds import IMPORTERS, read_dataset
from sasgeo_bench.exchange.importers.reports import score_ranking
from sasgeo_bench.exchange.importers.retrieval import read_ranking
from tests.exchange.importers import writers


def dataset_of(kind, queries, gallery):
    """A dataset by label of its queries and gallery (and place, where a pair is given), without a folder."""
    items = [
        *(_item("query", *pair) for pair in queries.items()),
        *(_item("gallery", *pair) for pair in gallery.items()),
    ]
    return Dataset(card=IMPORTERS[kind].card, items=tuple(items))


def _item(role, name, about):
    label, place = about if isinstance(about, tuple) else (about, None)
    position = Position(longitude_deg=place[0], latitude_deg=place[1]) if place else None
    return Item(item_id=name, role=role, view=f"{role}-view", label=label, position=position)


@pytest.fixture
def scores(tmp_path):
    """Metrics of the only report of a ranking, by name."""

    def score(dataset, answers):
        ranking = read_ranking([writers.write_ranking(tmp_path / "ranking.parquet", answers)], dataset.items)
        (report,) = score_ranking(dataset, ranking)
        return {each.metric: each for each in report.scores}

    return score


def both(score):
    return (score.released, score.corrected)


# Formulas


@given(st.lists(st.booleans(), min_size=1, max_size=40).filter(any))
def test_step_average_precision_is_that_of_scikit_learn(right):
    ranks = np.flatnonzero(right)
    expected = average_precision_score(right, np.arange(len(right), 0, -1))
    assert retrieval.step_ap(ranks, len(ranks)) == pytest.approx(expected)


@given(st.lists(st.booleans(), min_size=1, max_size=40).filter(any))
def test_trapezoid_average_precision_is_the_sum_of_trapezoids(right):
    area = 0.0
    for rank, is_right in enumerate(right):
        if is_right:
            left = sum(right[:rank]) / rank if rank else 1.0
            area += (left + sum(right[: rank + 1]) / (rank + 1)) / 2 / sum(right)
    ranks = np.flatnonzero(right)
    assert retrieval.trapezoid_ap(ranks, len(ranks)) == pytest.approx(area)
    assert retrieval.trapezoid_ap(ranks, len(ranks)) <= retrieval.step_ap(ranks, len(ranks)) + 1e-12


@given(st.floats(-179.0, 179.0), st.floats(-70.0, 70.0), st.floats(-0.01, 0.01), st.floats(-0.01, 0.01))
def test_the_sphere_differs_from_the_ellipsoid_by_less_than_a_hundredth(longitude, latitude, east, north):
    here, there = np.array([longitude, latitude]), np.array([longitude + east, latitude + north])
    sphere_m, ellipsoid_m = retrieval.haversine_m(here, there), retrieval.geodesic_m(here, there)
    assert abs(sphere_m - ellipsoid_m) <= 0.01 * ellipsoid_m + 1e-3


def test_weights_of_the_decay_fall_by_one_a_rank():
    assert retrieval.weighted_decay(np.array([[1.0, 0.5, 0.0]]))[0] == pytest.approx((3 * 1 + 2 * 0.5 + 1 * 0) / 6)


# Traps


def test_recall_at_one_percent_is_released_one_rank_too_far(scores):
    gallery = {f"g{at:03}": "right" if at == 2 else f"wrong{at}" for at in range(200)}
    dataset = dataset_of("university-1652", {"q": "right"}, gallery)
    found = scores(dataset, {"q": sorted(gallery)})
    assert both(found["recall_1pct"]) == (1.0, 0.0)  # the third answer, and 1 % of 200 are two
    found = scores(dataset_of("university-1652", {"q": "right"}, {"a": "wrong", "b": "right"}), {"q": ["a", "b"]})
    assert both(found["recall_1pct"]) == (0.0, 0.0)  # round(0.02) is index 0: here the two agree
    assert both(found["recall_5"]) == (None, 1.0)  # beyond the gallery


def test_queries_without_a_positive_are_released_as_misses(scores):
    queries, gallery = {"q1": "a", "q2": "nowhere"}, {"g1": "a", "g2": "b"}
    found = scores(dataset_of("university-1652", queries, gallery), {"q1": ["g1", "g2"], "q2": ["g1", "g2"]})
    assert both(found["recall_1"]) == both(found["ap"]) == (0.5, 1.0)
    found = scores(dataset_of("university-1652", {"q": "a"}, {"g": "b"}), {"q": ["g"]})
    assert both(found["recall_1"]) == (0.0, None)
    assert both(found["ap"]) == (None, None)


def test_average_precision_is_released_by_trapezoids(scores):
    dataset = dataset_of("sues-200", {"q": "a"}, {"g1": "b", "g2": "a", "g3": "a"})
    found = scores(dataset, {"q": ["g1", "g2", "g3"]})
    trapezoids, steps = ((0 + 1 / 2) / 2 + (1 / 2 + 2 / 3) / 2) / 2, (1 / 2 + 2 / 3) / 2
    assert both(found["ap"]) == pytest.approx((trapezoids, steps))


def test_average_precision_of_game4loc_is_by_steps(tmp_path, scores):
    dataset = read_dataset(writers.write_visloc(tmp_path / "set"), "uav-visloc")
    one = [item.item_id for item in dataset.items if item.role == "gallery" and item.group == "01"]
    found = scores(dataset, {"01/drone/01_0001.JPG": one, "01/drone/01_0002.JPG": one})
    # Frames lie in the tiles 1_000_000 and 2_000_000, and 1_001_000 and 2_002_001; tiles come zoom, column, row.
    assert one.index("01_2_000_000.png") == 2
    assert one.index("01_2_002_001.png") == 7
    steps = ((1 / 1 + 2 / 3) / 2 + (1 / 2 + 2 / 8) / 2) / 2
    assert both(found["ap"]) == pytest.approx((steps, steps))


NORTH = {"q": ("a", (120.0, 30.0)), "east": ("b", (120.001, 30.0)), "north": ("c", (120.0, 30.001))}


def dense(queries, gallery):
    return dataset_of("dense-uav", queries, gallery)


def test_sdm_in_degrees_takes_east_for_as_far_as_north(scores):
    gallery = {"g-east": NORTH["east"], "g-north": NORTH["north"]}
    east, north = (
        scores(dense({"q": NORTH["q"]}, gallery), {"q": order})["sdm_15m_1"]
        for order in (["g-east", "g-north"], ["g-north", "g-east"])
    )
    assert east.released == pytest.approx(north.released, rel=0.05)  # both 0.001 degrees, but for rounding
    assert east.released == pytest.approx(math.exp(-5), rel=0.05)
    assert east.corrected > 1.8 * north.corrected  # 96 m and 111 m
    assert east.corrected == pytest.approx(math.exp(-5000 / 111_320 * 96.49), rel=1e-3)


def test_sdm_of_two_names_and_precisions_are_told_apart_and_the_first_answers_weigh_most(scores):
    # 100 m: exp(-4.5) against exp(-0.1).
    dataset = dense({"q": ("a", (120.0, 30.0))}, {"g": ("b", (120.0, 30.000902))})
    found = scores(dataset, {"q": ["g"]})
    assert found["sdm_15m_1"].corrected == pytest.approx(0.0112, abs=2e-4)
    assert found["sdm_693m_1"].corrected == pytest.approx(0.9048, abs=2e-4)
    assert found["sdm_693m_1"].released is None  # DenseUAV's code has no such metric
    near = {"g": ("b", (120.000003, 30.0))}
    found = scores(dense({"q": ("a", (120.0, 30.0))}, near), {"q": ["g"]})
    assert found["sdm_15m_1"].released == 1.0
    assert found["sdm_15m_1"].corrected == pytest.approx(math.exp(-5000 / 111_320 * 0.2895), rel=1e-3)
    gallery = {"near": ("a", (120.0, 30.0)), "far": ("b", (121.0, 30.0)), "farther": ("c", (122.0, 30.0))}
    dataset = dense({"q": ("a", (120.0, 30.0))}, gallery)
    found = scores(dataset, {"q": ["far", "near", "farther"]})
    assert both(found["sdm_15m_3"]) == pytest.approx((2 / 6, 2 / 6))


def test_an_answer_at_the_limit_is_released_as_a_miss(tmp_path, scores, monkeypatch):
    monkeypatch.setattr("sasgeo_bench.exchange.importers.reports.haversine_m", lambda *_: np.array([[20.0]]))
    monkeypatch.setattr("sasgeo_bench.exchange.importers.reports.geodesic_m", lambda *_: np.array([[20.0]]))
    found = scores(dense({"q": NORTH["q"]}, {"g": NORTH["east"]}), {"q": ["g"]})
    assert both(found["ma_20m"]) == (0.0, 1.0)
    assert both(found["ma_10m"]) == (0.0, 0.0)
    visloc = read_dataset(writers.write_visloc(tmp_path / "set"), "uav-visloc")
    found = scores(visloc, {"01/drone/01_0001.JPG": ["01_1_000_000.png"]})
    # Two frames in flight 01, one without an answer.
    assert both(found["accuracy_20m"]) == (0.0, 0.5)
    assert both(found["accuracy_40m"]) == (0.5, 0.5)


def test_accuracy_is_released_on_a_sphere(scores):
    # 99.8 m on the ellipsoid, 100.2 m on the sphere.
    found = scores(dense({"q": ("a", (120.0, 30.0))}, {"g": ("b", (120.0, 30.0009))}), {"q": ["g"]})
    assert both(found["ma_100m"]) == (0.0, 1.0)


def test_the_logged_distance_of_game4loc_forgets_the_latitude(tmp_path, scores):
    dataset = read_dataset(writers.write_visloc(tmp_path / "set"), "uav-visloc")
    answers = {f"01/drone/01_000{at}.JPG": ["01_1_000_000.png"] for at in (1, 2)}
    found = scores(dataset, answers)["logged_distance"]
    frames = np.array([[116.005, 29.715], [116.025, 29.705]])
    centre = np.array([116.01, 29.71])
    assert found.corrected == pytest.approx(retrieval.geodesic_m(frames, centre).mean())
    east_m = 0.010 * 111_320 * math.cos(math.radians(29.71))  # mean of 0.005 and 0.015 degrees
    assert found.released == pytest.approx(east_m, rel=0.01)
    assert found.released < found.corrected


def test_mean_distances_are_of_all_the_first_answers(tmp_path, scores):
    dataset = read_dataset(writers.write_visloc(tmp_path / "set"), "uav-visloc")
    tiles = ["01_1_000_000.png", "01_1_001_000.png", "01_2_000_000.png"]
    found = scores(dataset, {f"01/drone/01_000{at}.JPG": tiles for at in (1, 2)})
    frames = np.array([[116.005, 29.715], [116.025, 29.705]])[:, None]
    centres = np.array([[116.01, 29.71], [116.03, 29.71], [116.005, 29.715]])
    assert both(found["dis_3"]) == pytest.approx((retrieval.geodesic_m(frames, centres).mean(),) * 2)
    assert found["dis_5"].released is None


# What is scored


def test_a_query_without_an_answer_is_a_miss(tmp_path):
    dataset = dataset_of("university-1652", {"q1": "a", "q2": "b"}, {"g1": "a", "g2": "b"})
    path = writers.write_ranking(tmp_path / "r.parquet", {"q1": ["g1", "g2"]})
    (report,) = score_ranking(dataset, read_ranking((path,), dataset.items))
    assert (report.queries, report.answered, report.without_positive, report.gallery) == (2, 1, 0, 2)
    assert {score.metric: both(score) for score in report.scores}["recall_1"] == (0.5, 0.5)


def test_a_short_list_leaves_open_what_it_cannot_say(scores):
    gallery = {f"g{at}": "a" if at in (0, 7) else f"b{at}" for at in range(20)}
    found = scores(dataset_of("university-1652", {"q": "a"}, gallery), {"q": [f"g{at}" for at in range(5)]})
    assert both(found["recall_5"]) == (1.0, 1.0)
    assert both(found["recall_10"]) == (None, None)
    assert both(found["ap"]) == (None, None)  # a positive is not ranked


def test_each_height_of_sues_is_reported_by_itself(tmp_path):
    dataset = read_dataset(writers.write_sues(tmp_path / "set"), "sues-200")
    answers = {}
    for height, order in (("150", ("0001", "0002")), ("300", ("0002", "0001"))):
        gallery = [f"Testing/{height}/gallery_satellite/{label}/0.jpg" for label in order]
        answers[f"Testing/{height}/query_drone/0001/0.jpg"] = gallery
        answers[f"Testing/{height}/query_drone/0002/0.jpg"] = gallery[::-1]
    path = writers.write_ranking(tmp_path / "r.parquet", answers)
    reports = score_ranking(dataset, read_ranking((path,), dataset.items))
    assert [(report.title, report.queries, report.gallery) for report in reports] == [
        ("drone to satellite, 150 m", 2, 2),
        ("drone to satellite, 300 m", 2, 2),
    ]
    assert [report.scores[0].corrected for report in reports] == [1.0, 0.0]
    answers = [f"Testing/{height}/gallery_satellite/0001/0.jpg" for height in ("150", "300")]
    path = writers.write_ranking(tmp_path / "r.parquet", {"Testing/150/query_drone/0001/0.jpg": answers})
    with pytest.raises(DatasetError, match="several views and heights"):
        score_ranking(dataset, read_ranking((path,), dataset.items))


def test_both_directions_are_reported_one_by_one(tmp_path):
    dataset = read_dataset(writers.write_university(tmp_path / "set"), "university-1652")
    answers = {
        "test/query_drone/0001/0001.jpg": ["test/gallery_satellite/0001/0001.jpg"],
        "test/query_satellite/0001/0001.jpg": ["test/gallery_drone/0000/0000.jpg"],
    }
    path = writers.write_ranking(tmp_path / "r.parquet", answers)
    reports = {each.title: each for each in score_ranking(dataset, read_ranking((path,), dataset.items))}
    assert {title: (each.queries, each.gallery) for title, each in reports.items()} == {
        "drone to satellite": (3, 3),
        "satellite to drone": (2, 3),
    }


def test_flights_without_an_answer_are_not_asked(tmp_path):
    dataset = read_dataset(writers.write_visloc(tmp_path / "set"), "uav-visloc")
    path = writers.write_ranking(tmp_path / "r.parquet", {"07/drone/07_0001.JPG": ["07_1_000_000.png"]})
    (report,) = score_ranking(dataset, read_ranking((path,), dataset.items))
    assert (report.queries, report.gallery, report.without_positive) == (1, 10, 0)


@given(st.permutations(range(6)), st.permutations(range(3)))
def test_the_order_of_rows_changes_nothing(tmp_path_factory, order, queries):
    dataset = dataset_of("university-1652", {f"q{at}": "ab"[at % 2] for at in range(3)}, {"g0": "a", "g1": "b"})
    rows = [(f"q{query}", f"g{answer}", 1 + (query + answer) % 2) for query in queries for answer in range(2)]
    folder = tmp_path_factory.mktemp("rows")
    found = []
    for at, some in enumerate((rows, [rows[each] for each in order])):
        names = dict(zip(("query_id", "gallery_id", "rank"), zip(*some, strict=True), strict=True))
        pq.write_table(pa.table(names), folder / f"{at}.parquet")
        found.append(score_ranking(dataset, read_ranking([folder / f"{at}.parquet"], dataset.items)))
    assert found[0] == found[1]


# Rankings that are none


@pytest.mark.parametrize(
    ("columns", "expected"),
    [
        ({"query_id": ["q"], "gallery_id": ["g1"]}, "has no column 'rank'"),
        (pa.table([["q"], ["q"], ["g1"], [1]], ["query_id", "query_id", "gallery_id", "rank"]), "or more than one"),
        ({"query_id": ["q"], "gallery_id": ["g1"], "rank": pa.array([None], pa.int64())}, "expected whole numbers"),
        ({"query_id": [7], "gallery_id": ["g1"], "rank": [1]}, "query_id: expected text, got int64"),
        ({"query_id": ["x\x1b[31m\n"], "gallery_id": ["g1"], "rank": [1]}, "is no query of the dataset"),
        ({"query_id": ["g1"], "gallery_id": ["g1"], "rank": [1]}, "query_id: 'g1' is no query of the dataset"),
        ({"query_id": ["q"], "gallery_id": [None], "rank": [1]}, "gallery_id: expected text, got null"),
        ({"query_id": ["q", "q"], "gallery_id": ["g1", None], "rank": [1, 2]}, "a missing value is no gallery"),
        ({"query_id": ["q"], "gallery_id": ["g1"], "rank": [0]}, "do not run from 1"),
        ({"query_id": ["q", "q"], "gallery_id": ["g1", "g2"], "rank": [1, 2**62]}, "do not run from 1"),
        ({"query_id": ["q", "q"], "gallery_id": ["g1", "g2"], "rank": [1, 1]}, "without a gap or a tie"),
        ({"query_id": ["q", "q"], "gallery_id": ["g1", "g2"], "rank": [1, 3]}, "without a gap or a tie"),
        ({"query_id": ["q", "q"], "gallery_id": ["g1", "g1"], "rank": [1, 2]}, "ranks 'g1' twice for query 'q'"),
        (pa.table({"query_id": pa.array([], pa.string()), "gallery_id": pa.array([], pa.string()), "rank": pa.array([],
         pa.int64())}), "has no row"),
    ],
)  # fmt: skip
def test_a_wrong_ranking_is_refused_in_one_line(columns, expected, tmp_path):
    dataset = dataset_of("university-1652", {"q": "a"}, {"g1": "a", "g2": "b"})
    pq.write_table(pa.table(columns) if isinstance(columns, dict) else columns, tmp_path / "r.parquet")
    with pytest.raises(DatasetError) as fault:
        read_ranking([tmp_path / "r.parquet"], dataset.items)
    assert expected in str(fault.value)
    assert str(fault.value).isprintable()


def test_an_id_that_is_no_text_is_refused_and_names_may_be_stored_as_a_dictionary(tmp_path):
    dataset = dataset_of("university-1652", {"q": "a"}, {"g1": "a"})
    wrong = pa.array([b"\xf4q"], pa.binary()).view(pa.string())
    pq.write_table(pa.table({"query_id": wrong, "gallery_id": ["g1"], "rank": [1]}), tmp_path / "r.parquet")
    with pytest.raises(DatasetError, match="is no query of the dataset"):
        read_ranking([tmp_path / "r.parquet"], dataset.items)
    dataset = dataset_of("university-1652", {"q": "a"}, {"g1": "a"})
    table = pa.table({"query_id": ["q"], "gallery_id": ["g1"], "rank": pa.array([1], pa.int32())})
    table = table.set_column(0, "query_id", table["query_id"].dictionary_encode())
    pq.write_table(table, tmp_path / "r.parquet")
    assert read_ranking([tmp_path / "r.parquet"], dataset.items).queries.tolist() == [0]


@pytest.mark.parametrize("content", [b"", b"PAR1 no table PAR1", b"query_id,gallery_id,rank\nq,g1,1\n", None])
def test_what_is_no_table_is_refused(content, tmp_path):
    if content is not None:
        (tmp_path / "r.parquet").write_bytes(content)
    with pytest.raises(StoreError, match="ranks from 1"):
        read_ranking([tmp_path / "r.parquet"], ())


def test_a_ranking_may_lie_in_several_files(tmp_path):
    dataset = dataset_of("university-1652", {"q1": "a", "q2": "b"}, {"g1": "a", "g2": "b"})
    answers = {"q1": ["g1", "g2"], "q2": ["g2", "g1"]}
    one = writers.write_ranking(tmp_path / "one.parquet", answers)
    parts = [writers.write_ranking(tmp_path / f"{query}.parquet", {query: answers[query]}) for query in ("q2", "q1")]
    whole, joined = (score_ranking(dataset, read_ranking(paths, dataset.items)) for paths in ([one], parts))
    assert whole == joined
    with pytest.raises(DatasetError, match="a gap or a tie"):
        read_ranking([*parts, parts[0]], dataset.items)
