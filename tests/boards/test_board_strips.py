# SPDX-License-Identifier: Apache-2.0
"""The strip of a board: pictures of the matcher that finds most, on the site's first page, and as a PNG."""

import json
from dataclasses import replace
from types import SimpleNamespace

import cv2
import numpy as np
import pandas as pd
import pytest

from sasgeo_bench.boards import board_pictures
from sasgeo_bench.boards.board_pictures import STRIP_BYTES, case_pixels, is_kept_back, pictures_extra
from sasgeo_bench.boards.build import make_board
from sasgeo_bench.boards.publish import publish
from sasgeo_bench.boards.scored import ScoreRequest
from sasgeo_bench.boards.strip_plot import pictured_tasks
from sasgeo_bench.core.progress import reporting
from sasgeo_bench.matching.matcher import Prediction
from sasgeo_bench.running import prediction_files
from sasgeo_bench.running.prediction_files import RunManifest
from sasgeo_bench.sensing.segmentation import Segmentation
from sasgeo_bench.sensing.tiny_images import tiny_images
from sasgeo_bench.tasks import task_files
from sasgeo_bench.tasks.build import put_task
from sasgeo_bench.tasks.frames import Frame, encode_webp
from sasgeo_bench.tasks.segmented import Segmented, segmented_file, write_segmented
from tests import world
from tests.regions.imagery_place import make_hamlet

SUITE, REGION, HASH = "aerial+good", "town-riverside", "0123456789ab"
DRAWN = tiny_images()[0]


def put_pictures(out, tasks, detector="rendered"):
    """Queries of another suite, each with one picture and what is seen in it."""
    folder, hidden = tasks / "tasks" / "absent" / REGION, tasks / "truth" / "absent" / REGION
    truths = {truth.query_id: truth for truth in task_files.read_truths(hidden)}
    frame = Frame(picture=encode_webp(DRAWN.image.rgb), camera=DRAWN.image.camera)
    asked = [query for query in task_files.read_queries(folder) if truths[query.query_id].is_present]
    pairs = [
        (replace(query, suite=SUITE, frames=(frame,)), replace(truths[query.query_id], detector=detector))
        for query in asked
        if query.track == "localization"
    ]
    about = task_files.read_task(folder)
    kept = {name: about[name] for name in ("map_fingerprint", "map_inputs_sha256", "title", "split", "sites")}
    origin = task_files.TaskOrigin(**kept, suite=SUITE, region=REGION)
    with reporting(print):
        made = put_task(pairs, origin, task_files.TruthManifest(seed=0), out=out)
    planes = np.where(DRAWN.labels == 1, 254, 0).astype(np.uint8)
    seen = Segmented.of(Segmentation(classes=DRAWN.classes, probability_bytes=planes))
    sha256 = task_files.read_task(made.folder)["files"][task_files.QUERIES]["sha256"]
    write_segmented(segmented_file(out, sha256), {query.query_id: seen for query, _ in pairs})
    return made.folder, pairs


def run(out, task, pairs, name, rights):
    """Answers of a matcher that finds some of the places, and takes others to be 300 m away."""
    answers = []
    for number, (query, truth) in enumerate(pairs):
        off_m = 0.0 if number < rights else 300.0
        place = replace(truth.pose, easting_m=truth.pose.easting_m + off_m)
        answers.append(Prediction(query_id=query.query_id, candidates=((place, 1.0),), latency_s=0.1))
    folder = out / "runs" / name / HASH / SUITE / REGION
    prediction_files.write_part(folder, answers, asked=task_files.Task.open(task).asked)
    about = {"matcher": {"name": name, "version": "1"}, "hash": HASH, "suite": SUITE, "region": REGION}
    sha256 = task_files.read_task(task)["files"][task_files.QUERIES]["sha256"]
    RunManifest(**about, queries_sha256=sha256).save(folder)


def lay_board(out, tasks, detector="rendered"):
    """A board of two matchers on pictures, in out/boards/mine, and what was said of its pictures."""
    out.mkdir()
    (out / "regions").symlink_to(tasks / "regions")
    task, pairs = put_pictures(out, tasks, detector)
    for name, rights in (("worse", 1), ("better", 2)):
        run(out, task, pairs, name, rights)
    folder, told = out / "boards" / "mine", []
    with reporting(told.append):
        extras = (lambda found: pictures_extra(found, root=out),)
        make_board(ScoreRequest(predictions=[out / "runs"], root=out, board=folder, draws=100), extras)
    return folder, told


@pytest.fixture(scope="module")
def board(tasks, tmp_path_factory):
    return lay_board(tmp_path_factory.mktemp("strips") / "out", tasks)[0]


def test_a_board_on_pictures_has_a_strip_of_the_matcher_that_finds_most(board):
    (strip,) = json.loads((board / "pictures" / "pictures.json").read_text(encoding="utf-8"))["strips"]
    assert (strip["suite"], strip["matcher"]) == (SUITE, "better")
    assert "better on aerial+good. The pose is found (within 25 m and 5 deg) in 2 of " in strip["alt"]
    path = board / "pictures" / strip["file"]
    assert path.stat().st_size <= STRIP_BYTES
    assert cv2.imread(str(path)).shape[1] > 800


@pytest.mark.parametrize("is_of_flights", [False, True])
def test_flights_of_pictures_have_maps_instead_of_a_strip(is_of_flights, monkeypatch):
    rows = {"query_id": ["00ff"], "suite": "flight-image+good", "region": REGION, "role": "control", "detector": "real"}
    scores = {
        "tracker": pd.DataFrame(
            rows | {"is_present": True, "is_right": True, "yaw_error_deg": 0.0, "strength_unit": "m"}
        )
    }
    task = SimpleNamespace(manifest=SimpleNamespace(frames=3, is_of_flights=is_of_flights))
    drawn = []
    monkeypatch.setattr(board_pictures, "_cases", lambda chosen, *_: drawn.extend(chosen) or iter(()))
    found = SimpleNamespace(add=lambda *_: None)
    board_pictures._add_strips(found, SimpleNamespace(scores=scores), {("flight-image+good", REGION): task})
    assert drawn == ([] if is_of_flights else [("00ff", "tracker")])
    cases = SimpleNamespace(tasks={("flight-image+good", REGION): task})
    assert len(pictured_tasks(cases)) == len(drawn)


def test_no_photograph_stands_on_a_board_that_nobody_allowed_to_pass_on(tasks, tmp_path, monkeypatch):
    shown = []
    monkeypatch.setattr(board_pictures, "case_pixels", lambda case: shown.append(case) or case_pixels(case))
    folder, told = lay_board(tmp_path / "out", tasks, "real")
    listed = json.loads((folder / "pictures" / "pictures.json").read_text(encoding="utf-8"))
    assert listed["strips"] == []
    assert len(listed["cases"]) == len(shown) > 0
    assert all(case.picture is None and case.segmented is None for case in shown)
    assert any(line.startswith("left out: 1 picture, for photographs of which no region file says") for line in told)


@pytest.mark.parametrize(
    ("detector", "publish", "is_kept"), [("real", False, True), ("real", True, False), ("rendered", False, False)]
)
def test_a_photograph_is_shown_where_its_region_file_says_so(detector, publish, is_kept, tmp_path):
    hamlet = make_hamlet(tmp_path / "files").but(publish=publish)
    folders = {"extract_folders": [hamlet.folder], "imagery_folders": [hamlet.folder]}
    folder = world.built(hamlet.spec(), tmp_path / "out", **folders)
    case = SimpleNamespace(truth=SimpleNamespace(detector=detector))
    for name in (folder.name, f"{folder.name}+real-image"):  # an edited map has no imagery of its own
        assert is_kept_back(case, SimpleNamespace(region=folder.with_name(name))) == is_kept


@pytest.mark.usefixtures("plain_site")
def test_the_strip_stands_on_the_first_page_with_its_attribution(board):
    with reporting(print):
        publish(board, root=board.parents[1])
    page = (board / "site" / "index.html").read_text(encoding="utf-8")
    shown = page[page.index("From the picture to the pose") : page.index("Which differences are real")]
    assert 'src="pictures/strips/aerial%2Bgood.webp"' in shown
    assert "OpenStreetMap contributors, ODbL" in shown
    assert (board / "site" / "pictures" / "strips" / "aerial+good.webp").is_file()


def test_the_strip_of_a_board_is_drawn_as_a_png_of_its_best_run(board, program):
    out = board.parents[1]
    code, printed, _ = program("inspect", str(board), "--strip", "3", "--out", str(out))
    assert (code, printed) == (0, f"strip: {out / 'sheets' / 'strip-better.png'}\n")
    assert cv2.imread(str(out / "sheets" / "strip-better.png")).shape[1] > 800


def test_a_strip_of_what_holds_no_answers_is_refused(program, board):
    out = board.parents[1]
    for target in ("crossfit", str(out / "regions" / REGION), str(out / "tasks" / SUITE / REGION)):
        code, _, err = program("inspect", target, "--strip", "3", "--out", str(out))
        assert (code, "--strip draws queries with their answers" in err) == (2, True)
