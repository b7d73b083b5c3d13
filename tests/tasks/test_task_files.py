# SPDX-License-Identifier: Apache-2.0
"""Tasks on disk: what is written comes back, and what is damaged is named."""

import datetime as dt
import json
from dataclasses import fields, replace
from pathlib import Path
from typing import get_args

import geopandas as gpd
import numpy as np
import pyarrow.parquet as pq
import pytest
import shapely
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from sasgeo_bench.core.errors import StoreError
from sasgeo_bench.geometry.pose import Pose, Prior
from sasgeo_bench.regions.evidence import Evidence, pack
from sasgeo_bench.regions.region import ATTRIBUTION, LICENCE
from sasgeo_bench.tasks.query import TASK_VERSION, TASK_VERSIONS, Detector, Query, Truth
from sasgeo_bench.tasks.task_files import (
    ASKED,
    QUERIES,
    QUERY_SCHEMA,
    TASK,
    TRUTH,
    TRUTH_OF,
    Task,
    TaskOrigin,
    TruthManifest,
    asked_sha256,
    read_queries,
    read_task,
    read_truths,
    truth_sha256,
    write_task,
)

ROOT = Path(__file__).parents[2]
ABOUT = TaskOrigin(suite="clean", title="Clean", region="here", map_fingerprint="0")
SAID = ABOUT.model_dump(exclude_unset=True) | {
    "schema_version": 1,
    "task_version": TASK_VERSION,
    "counts": {},
    "files": {},
}

metres = st.floats(-1e7, 1e7)
shares = st.floats(0, 1)
words = st.text(max_size=12)
poses = st.builds(Pose, easting_m=metres, northing_m=metres, yaw_deg=st.floats(0, 359), scale=st.floats(0.5, 2))
points = st.tuples(metres, metres)
in_view = st.floats(-1e5, 1e5)
corners = st.tuples(in_view, in_view)
shapes = st.one_of(
    st.builds(shapely.Point, corners),
    st.builds(shapely.LineString, st.lists(corners, min_size=2, max_size=4)),
    st.builds(lambda x, y: shapely.box(x, y, x + 1, y + 2), in_view, in_view),
)


def observation_bytes(query):
    """Two bits for each cell and class, one byte for each confidence, WKB for each vector; nothing is compressed."""
    total = len(pack(query.evidence.cells))
    total += 0 if query.evidence.confidence is None else query.evidence.confidence.size
    return total + sum(map(len, [] if query.vectors is None else shapely.to_wkb(query.vectors.geometry.to_numpy())))


@st.composite
def sights(draw):
    shape = (draw(st.integers(1, 3)), draw(st.integers(1, 5)), draw(st.integers(1, 5)))
    certain = arrays(np.uint8, shape, elements=st.integers(0, 255))
    return Evidence(
        classes=tuple(f"class{at}" for at in range(shape[0])),
        cells=draw(arrays(np.uint8, shape, elements=st.integers(0, 2))),
        cell_size_m=draw(st.floats(0.1, 10)),
        confidence=draw(st.none() | certain),
    )


@st.composite
def priors(draw):
    has_place, has_yaw = draw(st.booleans()), draw(st.booleans())
    return Prior(
        center_m=draw(points) if has_place else None,
        radius_m=draw(st.floats(1, 1e4)) if has_place else None,
        yaw_deg=draw(st.floats(0, 359)) if has_yaw else None,
        yaw_sigma_deg=draw(st.floats(0.1, 90)) if has_yaw else None,
        scale_sigma=draw(st.floats(0, 1)),
    )


@st.composite
def vectors(draw):
    rows = draw(st.lists(st.tuples(words, st.integers(-5, 5), st.booleans(), shapes), max_size=4))
    return gpd.GeoDataFrame(
        {
            "class": np.array([row[0] for row in rows], dtype=object),
            "level": np.array([row[1] for row in rows], dtype=np.int16),
            "is_bridge": np.array([row[2] for row in rows], dtype=bool),
        },
        geometry=gpd.GeoSeries([row[3] for row in rows], dtype="geometry"),
    )


queries = st.builds(
    Query,
    query_id=words,
    track=st.sampled_from(["retrieval", "localization"]),
    suite=words,
    suite_version=st.integers(1, 99),
    part=words,
    region=words,
    evidence=sights(),
    observed_on=st.dates(dt.date(1990, 1, 1), dt.date(2100, 1, 1)),
    season=words,
    prior=priors(),
    prior_group=words,
    candidates=st.lists(poses, max_size=4).map(tuple),
    vectors=st.none() | vectors(),
)
truths = st.builds(
    Truth,
    query_id=words,
    is_present=st.booleans(),
    pose=st.none() | poses,
    candidate=st.integers(-1, 500),
    pair_id=words,
    role=st.sampled_from(["control", "stress", "falsifier"]),
    kind=words,
    strength=st.floats(-10, 10),
    strength_unit=words,
    unknown_share=shares,
    changed_share=shares,
    feature_density=shares,
    alias_index=shares,
    block=words,
    scene=words,
    detector=st.sampled_from(get_args(Detector)),
    measured=st.dictionaries(words, st.floats(allow_nan=False), max_size=3),
)


def check_same(one, two):
    """Two queries that say the same; arrays and tables do not compare by themselves."""
    names = [field.name for field in fields(Query) if field.name not in {"evidence", "vectors"}]
    assert [getattr(one, name) for name in names] == [getattr(two, name) for name in names]
    first, second = one.evidence, two.evidence
    assert (first.classes, first.cell_size_m) == (second.classes, second.cell_size_m)
    np.testing.assert_array_equal(first.cells, second.cells)
    assert (first.confidence is None) == (second.confidence is None)
    if first.confidence is not None:
        np.testing.assert_array_equal(first.confidence, second.confidence)
    assert (one.vectors is None) == (two.vectors is None)
    if one.vectors is not None:
        assert list(one.vectors.columns) == list(two.vectors.columns)
        assert one.vectors.dtypes.astype(str).to_list() == two.vectors.dtypes.astype(str).to_list()
        assert one.vectors.drop(columns="geometry").equals(two.vectors.drop(columns="geometry"))
        kinds = [bytes(shapely.to_wkb(shape)) for shape in one.vectors.geometry]
        assert kinds == [bytes(shapely.to_wkb(shape)) for shape in two.vectors.geometry]


def one_query(**changes):
    base = {
        "query_id": "a" * 24,
        "track": "retrieval",
        "suite": "clean",
        "suite_version": 1,
        "part": "test",
        "region": "here",
        "evidence": Evidence(classes=("road",), cells=np.array([[[0, 1, 2]]], dtype=np.uint8), cell_size_m=0.5),
        "observed_on": dt.date(2025, 1, 2),
        "season": "",
        "prior": Prior(center_m=None, radius_m=None, yaw_deg=None, yaw_sigma_deg=None, scale_sigma=0.1),
        "prior_group": "rnone-unknown-s10",
        "candidates": (Pose(easting_m=1.25, northing_m=-2.0, yaw_deg=3.0),),
    }
    return Query(**base | changes)


def one_truth(**changes):
    base = {
        "query_id": "a" * 24,
        "is_present": True,
        "pose": Pose(easting_m=1.0, northing_m=2.0, yaw_deg=3.0, scale=1.1),
        "candidate": 0,
        "pair_id": "p",
        "role": "control",
        "kind": "control",
        "strength": 0.0,
        "strength_unit": "none",
        "unknown_share": 0.0,
        "changed_share": 0.0,
        "feature_density": 0.5,
        "alias_index": 0.5,
        "block": "here/0-0",
        "scene": "urban",
    }
    return Truth(**base | changes)


@pytest.fixture
def folders(tmp_path):
    found = (tmp_path / "task", tmp_path / "truth")
    for folder in found:
        folder.mkdir()
    return found


@pytest.fixture
def written(folders):
    """Three queries and their truths on disk."""
    names = [letter * 24 for letter in "abc"]
    write_task(*folders, ((one_query(query_id=name), one_truth(query_id=name)) for name in names), ABOUT)
    return folders


def opened(folders):
    """The task in one folder, with the truths in another."""
    return replace(Task.open(folders[0]), truth=folders[1])


def test_truths_of_before_there_were_detectors_are_of_the_published_one(written):
    path = written[1] / TRUTH
    pq.write_table(pq.read_table(path).drop_columns(["detector"]), path)
    assert {truth.detector for truth in read_truths(written[1])} == {"published"}


def test_what_is_learned_from_the_published_detector_keeps_its_hash():
    one = one_truth(query_id="a" * 24)
    assert truth_sha256(one) == "134a6243d85d4f58eda1fb7c9465cc2526cf89e5d9ce1d60deb132086b368984"
    assert truth_sha256(replace(one, detector="measured")) != truth_sha256(one)


@settings(max_examples=15)
@given(st.lists(st.tuples(queries, truths), min_size=1, max_size=3))
def test_a_task_comes_back_from_disk_as_it_was(tmp_path_factory, pairs):
    task_folder, truth_folder = (tmp_path_factory.mktemp(name) for name in ("task", "truth"))
    assert write_task(task_folder, truth_folder, pairs, ABOUT).queries == len(pairs)
    for back, (query, _) in zip(read_queries(task_folder), pairs, strict=True):
        check_same(back, query)
    assert pq.read_schema(task_folder / QUERIES).names == [*QUERY_SCHEMA.names, ASKED]
    assert list(read_truths(truth_folder)) == [truth for _, truth in pairs]
    assert sum(read_task(task_folder)["counts"].values()) == len(pairs)
    assert Task.open(task_folder).view_bytes() == {query.query_id: observation_bytes(query) for query, _ in pairs}


def test_more_queries_than_fit_into_a_row_group_keep_their_order(folders):
    names = [f"{at:024x}" for at in range(300)]
    write_task(*folders, ((one_query(query_id=name), one_truth(query_id=name)) for name in names), ABOUT)
    assert pq.ParquetFile(folders[0] / QUERIES).num_row_groups == 3
    assert [query.query_id for query in read_queries(folders[0])] == names
    assert Task.open(folders[0]).view_bytes() == dict.fromkeys(names, observation_bytes(one_query()))
    assert [truth.query_id for truth in read_truths(folders[1])] == names
    assert opened(folders).faults() == []


def test_what_is_asked_has_one_hash_for_good_and_another_for_whatever_decides_an_answer():
    row = {
        "query_id": "a",
        "evidence": b"\x01",
        "observed_on": dt.date(2026, 1, 2),
        "prior_radius_m": 500.0,
        "frame": None,
    }
    values = {"map_fingerprint": "ff"}
    # If this changes, all answers there are have to be given anew.
    assert asked_sha256(row, values)[:16] == "8e5fa691a0d01c92"
    others = [row | {name: row[name] * 2} for name in ("query_id", "evidence", "prior_radius_m")]
    others += [row | {"observed_on": dt.date(2026, 1, 3)}, row | {"season": "snow"}]
    found = {asked_sha256(row, values), asked_sha256(row, {"map_fingerprint": "ee"}), asked_sha256(row, {})}
    assert len(found | {asked_sha256(other, values) for other in others}) == len(others) + 3


def test_every_file_says_whose_data_it_holds_and_under_which_licence(written):
    for path in (written[0] / QUERIES, written[1] / TRUTH):
        record = pq.read_schema(path).metadata
        assert record[b"attribution"].decode() == ATTRIBUTION
        assert record[b"licence"].decode() == LICENCE
    about = json.loads((written[0] / TASK).read_text(encoding="utf-8"))
    assert (about["attribution"], about["licence"]) == (ATTRIBUTION, LICENCE)


def test_the_same_queries_make_the_same_bytes(tmp_path):
    found = []
    for name in ("one", "two"):
        folders = [tmp_path / name / kind for kind in ("task", "truth")]
        for folder in folders:
            folder.mkdir(parents=True)
        write_task(*folders, [(one_query(), one_truth())], ABOUT)
        found.append([path.read_bytes() for path in (folders[0] / QUERIES, folders[0] / TASK, folders[1] / TRUTH)])
    assert found[0] == found[1]


def test_a_good_task_has_no_faults_with_and_without_its_truths(written):
    assert opened(written).faults() == []
    (written[1] / TRUTH).unlink()
    assert opened(written).faults() == []


def test_any_flipped_byte_is_a_fault_and_nothing_else_goes_wrong(written):
    path = written[0] / QUERIES
    content = path.read_bytes()
    for at in range(0, len(content), 97):
        path.write_bytes(content[:at] + bytes([content[at] ^ 1]) + content[at + 1 :])
        (fault,) = opened(written).faults()
        assert fault.startswith(f"{path}: ")
        assert "SHA-256" in fault


def test_a_missing_truth_a_foreign_file_and_a_wrong_count_are_faults(written):
    task_folder, truth_folder = written
    table = pq.read_table(truth_folder / TRUTH)
    pq.write_table(table.slice(1), truth_folder / TRUTH)
    (task_folder / "deep").mkdir()
    (task_folder / "deep" / "note.txt").write_text("?")
    about = json.loads((task_folder / TASK).read_text(encoding="utf-8"))
    (task_folder / TASK).write_text(json.dumps(about | {"counts": {"retrieval": 4}}))
    message = "\n".join(opened(written).faults())
    assert "truth.parquet: 2 truths that are not those of the 3 queries" in message
    assert "note.txt: not part of a task" in message
    assert "holds 3 of retrieval, task.json says 4 of retrieval: make the queries again" in message


def test_truths_say_which_queries_they_are_of_and_what_is_hidden_stays_with_them(folders):
    write_task(*folders, [(one_query(), one_truth())], ABOUT, TruthManifest(seed=987_654_321))
    record = json.loads((folders[1] / TRUTH_OF).read_text(encoding="utf-8"))
    assert record == {"queries_sha256": read_task(folders[0])["files"][QUERIES]["sha256"], "seed": 987_654_321}
    assert "987654321" not in (folders[0] / TASK).read_text(encoding="utf-8")
    assert sorted(path.name for path in folders[0].iterdir()) == [QUERIES, TASK]
    assert sorted(path.name for path in folders[1].iterdir()) == [TRUTH_OF, TRUTH]
    assert opened(folders).faults() == []


def test_truths_of_other_queries_are_a_fault_though_their_ids_are_the_same(written, tmp_path):
    others = [tmp_path / "other" / name for name in ("task", "truth")]
    for folder in others:
        folder.mkdir(parents=True)
    names = [letter * 24 for letter in "abc"]
    write_task(*others, ((one_query(query_id=name, season="x"), one_truth(query_id=name)) for name in names), ABOUT)
    (fault,) = opened((written[0], others[1])).faults()
    other = read_task(others[0])["files"][QUERIES]["sha256"]
    assert fault == f"{others[1]}/truth.json: the truths are of other queries, SHA-256 {other}: make the queries again"


@pytest.mark.parametrize("text", [None, "{", "[]", "3", "{}", '{"queries_sha256": null}'])
def test_truths_that_do_not_say_which_queries_they_are_of_are_a_fault(text, written):
    (written[1] / TRUTH_OF).unlink()
    if text is not None:
        (written[1] / TRUTH_OF).write_text(text)
    (fault,) = opened(written).faults()
    assert fault.startswith(f"{written[1]}/truth.json: the truths are of other queries, SHA-256 ")


def test_truths_in_another_order_are_a_fault(written):
    table = pq.read_table(written[1] / TRUTH)
    pq.write_table(table.take([1, 0, 2]), written[1] / TRUTH)
    assert "in order" in opened(written).faults()[0]


def test_a_task_without_its_queries_has_that_one_fault(written):
    (written[0] / QUERIES).unlink()
    assert opened(written).faults() == [f"{written[0]}/queries.parquet: missing: make the queries again"]


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("{", "is damaged"),
        ("[]", "is damaged"),
        ('{"schema_version": 0}', "has schema version 0, this version reads 1"),
        ('{"schema_version": 1}', "is damaged (task.json: 'suite' is missing; "),
        (json.dumps(SAID | {"files": {}}), "'files.queries.parquet' is missing"),
        (json.dumps(SAID | {"files": {"queries.parquet": {"sha256": 5, "bytes": 1}}}), "must be a string"),
        (json.dumps(SAID | {"counts": {"retrieval": -1}}), "greater than or equal to 0, got -1"),
        (json.dumps(SAID | {"suite": "../../x"}), "'suite'"),
        (json.dumps(SAID | {"titel": "x"}), "unknown key 'titel', did you mean 'title'?"),
        (json.dumps(SAID | {"files": 3}), "is damaged"),
        ('{"schema_version": "1"}', "has schema version '1'"),
    ],
)
def test_a_damaged_or_foreign_task_json_is_named_with_its_mend(text, expected, written):
    (written[0] / TASK).write_text(text)
    with pytest.raises(StoreError) as caught:
        read_task(written[0])
    assert expected in str(caught.value)
    assert str(caught.value).endswith("make the queries again")
    assert "\n" not in str(caught.value)


def test_tasks_and_stored_boards_of_earlier_versions_stay_what_they_were(written):
    record = json.loads((written[0] / TASK).read_text())
    for version in TASK_VERSIONS:
        (written[0] / TASK).write_text(json.dumps(record | {"task_version": version}))
        assert read_task(written[0])["task_version"] == version
    boards = [json.loads(path.read_text()) for path in (ROOT / "docs" / "results").glob("*/board.json")]
    assert boards
    assert {board["task_version"] for board in boards} <= set(TASK_VERSIONS)


def test_a_cut_off_table_is_named_with_its_mend(written):
    for path, read in ((written[0] / QUERIES, read_queries), (written[1] / TRUTH, read_truths)):
        path.write_bytes(path.read_bytes()[:-100])
        with pytest.raises(StoreError, match=r"cannot be read .*: make the queries again"):
            list(read(path.parent))


def test_a_table_of_another_schema_names_the_columns_it_lacks(written):
    path = written[0] / QUERIES
    pq.write_table(pq.read_table(path).drop_columns(["season", "part"]), path)
    with pytest.raises(StoreError, match="lacks the columns part, season: make the queries again"):
        list(read_queries(written[0]))
