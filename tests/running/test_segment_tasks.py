# SPDX-License-Identifier: Apache-2.0
"""Evidence of pictures: made at other places than it was learned from, once, and a fault costs its picture alone."""

import json
import os
import shutil
from dataclasses import replace
from itertools import islice
from pathlib import Path

import numpy as np
import pytest

from sasgeo_bench.core.errors import ConfigError, StoreError
from sasgeo_bench.core.plugins import ORACLE_SEGMENTER
from sasgeo_bench.core.progress import reporting
from sasgeo_bench.regions.evidence import PRESENT, UNKNOWN
from sasgeo_bench.regions.region_files import read_region
from sasgeo_bench.running.plan import RunRequest, plan_run
from sasgeo_bench.running.prediction_files import read_predictions
from sasgeo_bench.running.runner import run
from sasgeo_bench.running.segment_tasks import FOLDER, SegmentTasks, segment_tasks
from sasgeo_bench.running.training import recalibrated, shares_within
from sasgeo_bench.running.worker import Limits
from sasgeo_bench.sensing.segmentation import Segmentation
from sasgeo_bench.sensing.tiny_images import tiny_images
from sasgeo_bench.tasks import task_files
from sasgeo_bench.tasks.build import make_tasks, put_task
from sasgeo_bench.tasks.frames import Frame, FrameLabels, encode_webp
from sasgeo_bench.tasks.query import Step, view_id
from sasgeo_bench.tasks.segmented import read_segmented, segmented_file
from sasgeo_bench.tasks.split import find_split
from sasgeo_bench.tasks.task_files import TaskOrigin, TruthManifest
from sasgeo_bench.tasks.task_plan import TaskRequest, plan_requests

TOWNS = ("town-grid", "town-riverside")  # of either half
PATIENT = Limits(match_s=600.0, learn_s=600.0, memory_bytes=2 * 10**9)


def silent(line):
    del line


KEPT = ("map_fingerprint", "map_inputs_sha256", "title", "split", "sites")


def with_pictures(query, truth, at):
    """A query whose view is a drawn picture, and its truth with the labels."""
    drawn = tiny_images()[at % len(tiny_images())]
    blind = np.full_like(query.evidence.cells, UNKNOWN)
    frame = Frame(picture=encode_webp(drawn.image.rgb), camera=drawn.image.camera)
    labels = FrameLabels.of(drawn.classes, drawn.labels)
    return (
        replace(query, suite="aerial", evidence=query.evidence.replace(blind), frames=(frame,)),
        replace(truth, labels=(labels,), detector="rendered"),
    )


@pytest.fixture(scope="module")
def drawn_once(tmp_path_factory, lay_towns):
    """A root with tasks of four pictures in each of two towns, and their folders in it."""
    out = tmp_path_factory.mktemp("pictured") / "out"
    lay_towns(out, *TOWNS)
    wanted = TaskRequest(
        suites=("clean",), regions=TOWNS, split="crossfit", count=1, seed=4, out=out, may_be_fewer=True
    )
    folders = []
    for request in plan_requests(wanted):
        (made,) = make_tasks(request)
        about = made.manifest
        truth = out / "truth" / "clean" / request.region.id
        plain = islice(zip(task_files.read_queries(made.folder), task_files.read_truths(truth), strict=True), 4)
        pairs = [with_pictures(*pair, at) for at, pair in enumerate(plain)]
        kept = {name: getattr(about, name) for name in KEPT}
        own = TaskOrigin(**kept, suite="aerial", region=request.region.id)
        folders.append(put_task(pairs, own, TruthManifest(seed=4), out=out).folder.relative_to(out))
    return out, folders


@pytest.fixture
def pictured(tmp_path, drawn_once, monkeypatch):
    """These tasks, in an out/ of the test's own below the working folder."""
    drawn, folders = drawn_once
    out = Path(shutil.copytree(drawn, tmp_path / "out"))
    monkeypatch.syspath_prepend(str(Path(__file__).parent))
    monkeypatch.chdir(tmp_path)
    return tuple(out / folder for folder in folders)


def wanted(folders, spec, **changes):
    given = {"spec": spec, "tasks": folders, "split": find_split("crossfit"), "out": Path("out"), "limits": PATIENT}
    return SegmentTasks(**given | changes)


def of_oracle(folders, lines=None):
    with reporting(silent if lines is None else lines.append):
        return segment_tasks(wanted(folders, ORACLE_SEGMENTER))


def test_the_oracles_evidence_is_what_the_labels_show_under_new_ids_with_the_truths_of_the_pictures(pictured):
    made = of_oracle(pictured)
    assert [folder.parent.name for folder in made] == ["aerial+oracle_segmenter"] * 2
    queries = list(task_files.read_queries(made[0]))
    truths = list(task_files.read_truths(Path("out/truth/aerial+oracle_segmenter") / made[0].name))
    assert [query.query_id for query in queries] == sorted(truth.query_id for truth in truths)
    before = {query.query_id for query in task_files.read_queries(pictured[0])}
    assert not before & {query.query_id for query in queries}
    for query, truth in zip(queries, truths, strict=True):
        assert (query.evidence.layer("building") == PRESENT).any()
        assert query.evidence.confidence.any()
        assert (query.evidence.layer("railway") == UNKNOWN).all()  # nobody has labelled one
        assert truth.unknown_share == pytest.approx(query.evidence.unknown_share)
        assert len(query.frames) == 1
    assert not list(Path("out/truth/aerial+oracle_segmenter").rglob("labels.parquet"))


def in_flight(query, truth, at):
    """A query and its truth as one of two views of one of two flights; those of the second come first."""
    sequence, frame = ("0f" * 9, "0e" * 9)[at // 2], at % 2
    way = {"increment": (0.0, 50.0, 0.0), "covariance": tuple(np.eye(3).ravel().tolist())} if frame else {}
    step = Step(sequence_id=sequence, frame=frame, **way)
    prior = replace(query.prior, center_m=None, radius_m=None, yaw_deg=None, yaw_sigma_deg=None)
    query_id = view_id(sequence, frame)
    known = query.prior if frame == 0 else prior
    own = replace(
        query, query_id=query_id, track="sequence", suite="flight-image", candidates=(), step=step, prior=known
    )
    return own, replace(truth, query_id=query_id, candidate=-1)


@pytest.mark.usefixtures("in_threads")
def test_views_of_a_flight_stay_in_order_and_a_tracker_follows_them(pictured):
    about = task_files.read_task(pictured[0])
    truth = Path("out/truth/aerial") / pictured[0].name
    both = zip(task_files.read_queries(pictured[0]), task_files.read_truths(truth), strict=True)
    pairs = [in_flight(*with_pictures(*pair, at), at) for at, pair in enumerate(both)]
    own = TaskOrigin(**{name: about[name] for name in (*KEPT, "region")}, suite="flight-image")
    pairs = sorted(pairs, key=lambda pair: pair[0].query_id)
    task = put_task(pairs, own, TruthManifest(seed=4), out=Path("out"))
    (made,) = of_oracle([task.folder])
    queries = list(task_files.read_queries(made))
    assert [query.step.frame for query in queries] == [0, 1, 0, 1]
    assert [query.query_id for query in queries] == [
        view_id(query.step.sequence_id, query.step.frame) for query in queries
    ]
    assert not {query.query_id for query in queries} & {query.query_id for query, _ in pairs}
    assert {query.step.increment for query in queries if query.step.frame} == {(0.0, 50.0, 0.0)}
    assert all((query.evidence.layer("building") == PRESENT).any() for query in queries)
    plan = plan_run(RunRequest(spec="dead_reckoning", tasks=(made,), out=Path("out"), limits=PATIENT))
    run(plan)
    assert [item.status for item in read_predictions(plan.parts[0].folder)] == ["ok"] * 4


def test_what_is_up_to_date_stays_and_other_pictures_are_segmented_again(pictured):
    lines = []
    made = of_oracle(pictured, lines)
    before = (made[0] / "queries.parquet").stat().st_mtime_ns
    assert len(lines) == 2
    assert of_oracle(pictured, lines) == made
    assert (len(lines), (made[0] / "queries.parquet").stat().st_mtime_ns) == (2, before)
    (made[0] / "queries.parquet").write_bytes(b"half written")
    of_oracle(pictured, lines)
    assert len(lines) == 3
    assert len(list(task_files.read_queries(made[0]))) == 4


@pytest.mark.usefixtures("in_threads")
def test_each_half_is_seen_after_learning_from_the_other_and_nothing_is_learned_twice(pictured):
    lines = []
    with reporting(lines.append):
        made = segment_tasks(wanted(pictured, "segmenters:Learns"))
    texts = {path: json.loads(path.read_text()) for path in Path("out", FOLDER).rglob("*.txt")}
    assert sorted(text["places"] for text in texts.values()) == [[name] for name in TOWNS]
    records = {folder.name: task_files.read_task(folder)["segmenter"] for folder in made}
    assert len({record["learned_sha256"] for record in records.values()}) == 2
    assert sum("trained on the pictures" in line for line in lines) == 2
    again = []
    with reporting(again.append):
        segment_tasks(wanted(pictured, "segmenters:Learns"))
    assert again == []


@pytest.mark.usefixtures("in_threads")
def test_a_picture_that_a_segmenter_fails_at_has_no_evidence_and_is_told(pictured):
    for _ in range(2):  # what failed is tried again, and told again
        lines = []
        with reporting(lines.append):
            made = segment_tasks(wanted(pictured[:1], "segmenters:WrongShape"))
        assert "failed at 4 of 4 pictures, whose evidence is unknown" in lines[-1]
    assert task_files.read_task(made[0])["failed_pictures"] == 4
    for query in task_files.read_queries(made[0]):
        assert (query.evidence.cells == UNKNOWN).all()
        assert query.evidence.confidence is not None


@pytest.mark.usefixtures("in_threads")
@pytest.mark.parametrize("damage", [b"garbage", b"", bytes([255, 254, 0])])
def test_a_damaged_learned_text_is_refused_and_loses_no_evidence(pictured, damage):
    made = segment_tasks(wanted(pictured, "segmenters:Learns"))
    before = (made[1] / "queries.parquet").read_bytes()
    for path in Path("out", FOLDER).rglob("*.txt"):
        path.write_bytes(damage)
    (made[0] / "queries.parquet").unlink()
    with pytest.raises(StoreError, match=r"\.txt is damaged: remove this file and segment again, which learns anew$"):
        segment_tasks(wanted(pictured, "segmenters:Learns"))
    assert (made[1] / "queries.parquet").read_bytes() == before


def test_pictures_to_look_at_that_are_gone_are_made_again(pictured):
    (made,) = of_oracle(pictured[:1])
    stored = segmented_file(Path("out"), task_files.read_task(made)["files"][task_files.QUERIES]["sha256"])
    stored.unlink()
    of_oracle(pictured[:1])
    assert all(read_segmented(stored, query.query_id).drawn.any() for query in task_files.read_queries(made))


def test_wrong_tasks_are_refused_in_a_line(pictured):
    made = of_oracle(pictured[:1])
    with pytest.raises(ConfigError, match="name the task of the pictures, without"):
        of_oracle(made)
    with pytest.raises(ConfigError, match="holds no pictures: draw a suite that has some"):
        of_oracle([Path("out/tasks/clean") / TOWNS[0]])
    with pytest.raises(StoreError, match="make the queries first"):
        of_oracle([Path("out/tasks/aerial/nowhere")])
    near = [Path(os.path.relpath(folder)) for folder in pictured[:1]]
    assert [folder.is_absolute() for folder in of_oracle(near)] == [False]  # as the tasks were named
    labels = Path("out/truth/aerial") / TOWNS[1] / "labels.parquet"
    labels.unlink()
    with pytest.raises(StoreError, match=r"labels\.parquet cannot be read .*make the queries again"):
        of_oracle(pictured[1:])
    assert not Path("out/tasks/aerial+oracle_segmenter", TOWNS[1]).exists()


def test_a_matcher_of_evidence_is_not_asked_about_pictures_that_nobody_has_seen(pictured):
    request = RunRequest(spec="prior_centre", tasks=[pictured[0]], out=Path("out"))
    with pytest.raises(StoreError, match=r"holds pictures and no evidence.*run sasgeo-bench segment"):
        plan_run(request)
    plan = plan_run(replace(request, tasks=of_oracle(pictured[:1])))
    assert sum(len(part.left) for part in plan.parts) == 4


def test_recalibrated_evidence_has_the_shares_of_the_map_within_the_priors(pictured):
    (made,) = segment_tasks(wanted(pictured[:1], ORACLE_SEGMENTER, is_recalibrated=True))
    assert made.parent.name == "aerial+oracle_segmenter+shares"
    assert task_files.read_task(made)["segmenter"]["recalibrated_by"] == "shares of the map"
    plain = of_oracle(pictured[:1])[0]
    ids = [{query.query_id for query in task_files.read_queries(folder)} for folder in (made, plain)]
    assert not ids[0] & ids[1]


def test_pictures_are_recalibrated_together_and_one_that_failed_is_left_out(pictured):
    region = read_region(Path("out/regions") / pictured[0].name)
    queries = list(task_files.read_queries(pictured[0]))[:2]
    planes = np.array([[[200, 100]]], dtype=np.uint8)
    seen = [Segmentation(classes=("building",), probability_bytes=part) for part in (planes, planes // 2)]
    shares = shares_within([query.prior for query in queries], region)
    assert 0 < shares["building"] < 0.5
    found = list(recalibrated(zip(queries, ([seen[0]], [seen[1]]), strict=True), region))
    means = [one.shares()["building"] for _, (one,) in found]
    assert means[0] > means[1]
    assert np.mean(means) == pytest.approx(shares["building"], abs=0.01)
    (_, (one, two)) = next(iter(recalibrated([(with_two(queries[0]), [None, seen[0]])], region)))
    assert one is None
    assert two.shares()["building"] == pytest.approx(shares["building"], abs=0.01)


def with_two(query):
    return replace(query, frames=query.frames * 2)


@pytest.mark.usefixtures("in_threads")
def test_train_places_of_a_hold_out_are_learned_from_and_not_asked(pictured):
    split = find_split("holdout")
    parts = {folder: split.part_of(split.places_in(folder.name)[0]) for folder in pictured}
    assert set(parts.values()) == {"train", "test"}
    lines = []
    with reporting(lines.append):
        made = segment_tasks(wanted(pictured, "segmenters:Learns", split=split))
    assert [folder.name for folder in made] == [folder.name for folder in pictured if parts[folder] == "test"]
    assert any(line.startswith("left out: 1 train place") for line in lines)
