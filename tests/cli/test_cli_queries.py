# SPDX-License-Identifier: Apache-2.0
"""`make-queries`, `list suites`, `inspect` and `verify` as a user meets them."""

import json
import shutil
from pathlib import Path

import cv2
import pytest

from sasgeo_bench.boards.headroom import headroom_of, read_headroom
from sasgeo_bench.core.config import shipped_dir
from sasgeo_bench.regions.build import build_region, plan_build
from sasgeo_bench.regions.evidence import PRESENT
from sasgeo_bench.regions.region_spec import read_region_file
from sasgeo_bench.tasks.suites.all_suites import EVERY_SUITE, SUITES
from sasgeo_bench.tasks.task_files import QUERIES, TASK, TRUTH, TRUTH_OF, read_queries, read_truths

RIVERSIDE = "town-riverside"
CLEAN = f"clean/{RIVERSIDE}"


@pytest.fixture
def out(tasks, tmp_path):
    """A root of one's own, with the tasks in it."""
    return Path(shutil.copytree(tasks, tmp_path / "out"))


def town(folder: Path, name: str, **changes: str) -> Path:
    text = (shipped_dir("regions") / f"{RIVERSIDE}.toml").read_text()
    for old, new in {f'id = "{RIVERSIDE}"': f'id = "{name}"', **changes}.items():
        assert old in text
        text = text.replace(old, new)
    folder.mkdir(exist_ok=True)
    path = folder / f"{name}.toml"
    path.write_text(text)
    return path


def split_file(folder: Path, *names: str, kind: str = "holdout") -> Path:
    lines = [f'id = "mine"\ntitle = "Mine"\nkind = "{kind}"\nbuffer_m = 0.0']
    for at, name in enumerate(names):
        lines.append(f'[[place]]\nname = "{name}"\nregions = ["{name}"]')
        lines.append(f'part = "{("train", "test")[at % 2]}"' if kind == "holdout" else f'half = "{"ab"[at % 2]}"')
    path = folder / "split.toml"
    path.write_text("\n".join(lines) + "\n")
    return path


PROFILE = """
segmenter = "mine"
learned_from = "rendered"
tested_on = "elsewhere"
images = 3
[class.building]
pixels = 900
recall = {recall}
precision = 0.9
of_ground = 0.0
"""


def profile_file(folder: Path, recall: float) -> Path:
    path = folder / "mine.toml"
    path.write_text(PROFILE.format(recall=recall))
    return path


# --- make-queries ---------------------------------------------------------------------------------------------------


def test_each_task_gets_one_line_on_stderr_and_stdout_stays_empty(program, own_out):
    words = ("--suite", "absent", "--suite", "no-priors", "--regions", RIVERSIDE, "--n", "1")
    code, printed, err = program("make-queries", *words, "--out", own_out)
    assert (code, printed) == (0, "")
    assert [line.split(":")[0] for line in err.splitlines()] == [f"absent on {RIVERSIDE}", f"no-priors on {RIVERSIDE}"]
    assert f"5 queries at 1 site in {own_out}/tasks/absent/{RIVERSIDE}" in err.splitlines()[0]


@pytest.mark.slow
@pytest.mark.usefixtures("in_this_process")
def test_regions_are_built_on_the_way_and_two_at_once_give_what_one_after_the_other_does(program, tasks, tmp_path):
    # Views of a wrong place are taken in the next region of the split: both of them want the grid.
    words = ("--suite", "absent", "--regions", RIVERSIDE, "--regions", "town-grid", "--n", "1")
    code, _, err = program("make-queries", *words, "--jobs", "2", "--out", "two")
    assert code == 0, err
    for kind, file in (("tasks", QUERIES), ("tasks", TASK), ("truth", TRUTH), ("truth", TRUTH_OF)):
        path = Path(kind) / "absent" / RIVERSIDE / file
        assert (tmp_path / "two" / path).read_bytes() == (tasks / path).read_bytes()
    folders = {str(path.parent.relative_to(tmp_path / "two/tasks")) for path in (tmp_path / "two/tasks").rglob(TASK)}
    assert folders == {f"absent/{region}" for region in (RIVERSIDE, "town-grid")}


def test_a_dry_run_tells_and_writes_nothing(program, tmp_path):
    code, printed, err = program("make-queries", "--regions", RIVERSIDE, "--regions", "town-grid", "--dry-run")
    assert (code, err) == (0, "")
    assert len(printed.splitlines()) == 2 * len(SUITES)
    count = 8 * len(SUITES["clean"].variants) * len(SUITES["clean"].card.tracks)
    assert f"clean on {RIVERSIDE}: at most 8 sites, {count} queries, out/tasks/clean/{RIVERSIDE}" in printed
    assert list(tmp_path.iterdir()) == []


def test_what_a_region_cannot_carry_can_be_passed_over(program, own_out):
    words = ("--suite", "grade-separation", "--suite", "absent", "--regions", RIVERSIDE, "--n", "1")
    code, _, err = program("make-queries", *words, "--skip", "--out", own_out)
    assert code == 0
    assert f"grade-separation on {RIVERSIDE}: passed over, {RIVERSIDE} cannot carry suite" in err
    assert {path.parent.parent.name for path in (own_out / "tasks").rglob(TASK)} == {"absent"}


def buildings_of(out: Path) -> dict[str, int]:
    """Cells of buildings in all views of `clean` at full strength, by detector."""
    truths = {truth.query_id: truth for truth in read_truths(out / "truth" / CLEAN)}
    found: dict[str, int] = {}
    for query in read_queries(out / "tasks" / CLEAN):
        truth, view = truths[query.query_id], query.evidence
        if truth.role == "stress":
            cells = int((view.cells[view.classes.index("building")] == PRESENT).sum())
            found[truth.detector] = found.get(truth.detector, 0) + cells
    return found


def test_views_are_drawn_with_a_perception_profile_and_again_when_it_changes(program, own_out, tmp_path):
    words = ("--suite", "clean", "--regions", RIVERSIDE, "--n", "1", "--detector", "published", "--out", own_out)
    code, _, err = program("make-queries", *words, "--profile", profile_file(tmp_path, 0.9))
    assert code == 0, err
    assert "has no rates of road_major" in err
    high = buildings_of(own_out)
    assert high["profile"] > 0
    assert json.loads((own_out / "truth" / CLEAN / TRUTH_OF).read_text())["profile"]["segmenter"] == "mine"
    assert program("make-queries", *words, "--profile", profile_file(tmp_path, 0.2))[0] == 0
    low = buildings_of(own_out)
    assert low["published"] == high["published"]
    assert low["profile"] < high["profile"] / 2


def test_priors_that_are_asked_for_are_those_of_the_task(program, own_out):
    words = ("--suite", "growth", "--regions", RIVERSIDE, "--n", "1", "--prior", "r250-known-s10", "--out", own_out)
    assert program("make-queries", *words)[0] == 0
    queries = list(read_queries(own_out / "tasks/growth" / RIVERSIDE))
    assert {(query.prior.radius_m, query.prior.yaw_sigma_deg, query.prior.scale_sigma) for query in queries} == {
        (250.0, 5.0, 0.1)
    }
    assert json.loads((own_out / "tasks/growth" / RIVERSIDE / TASK).read_text())["prior_groups"] == ["r250-known-s10"]


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        (("--n", "0"), "--n must be at least 1, got 0"),
        (("--suite", "claen"), "there is no suite 'claen', did you mean 'clean'?"),
        (("--prior", "r500-weak"), "'r500-weak' is no prior group: r50, r100, r250, r500, r2000, rnone, or of fl"),
        (("--region-files", "nowhere"), "there is no folder nowhere"),
        (("--detector", "profile"), "detector 'profile' needs a perception profile: name its file with make-queries"),
        (("--profile", "none.toml"), "none.toml cannot be read as a perception profile"),
        (("--detector", "published", "--detector", "mine"), "--detector 'mine' is unknown: published or measured"),
    ],
)
def test_a_mistake_gets_one_line_and_exit_2_and_nothing_is_written(words, expected, mistake, tmp_path):
    assert expected in mistake("make-queries", "--suite", "clean", "--regions", RIVERSIDE, "--n", "1", *words)
    assert list(tmp_path.iterdir()) == []


def test_real_ageing_of_a_region_with_one_date_gets_one_line(program, tmp_path):
    path = town(tmp_path / "own", "mine", **{"size_m = [1024, 1024]": "size_m = [512, 512]"})
    first = path.read_text().index("[[extract]]")
    path.write_text(path.read_text()[:first] + path.read_text()[path.read_text().rindex("[[extract]]") :])
    split = split_file(tmp_path, "mine", "town-grid")
    code, printed, err = program("make-queries", "--suite", "real-age", "--regions", path, "--split", split, "--n", "1")
    assert (code, printed) == (2, "")
    assert err.splitlines()[-1] == (
        "sasgeo-bench: mine cannot carry suite 'real-age': "
        "one date only, real ageing needs an older extract of the same place (--skip passes on to the next suite)"
    )
    assert sorted(item.name for item in (tmp_path / "out").iterdir()) == ["regions"]


# --- list suites ----------------------------------------------------------------------------------------------------


def test_all_suites_are_listed_with_what_they_separate_most_headroom_first(program):
    code, printed, err = program("list", "suites")
    assert code == 0
    assert err.startswith("headroom: the most that could be gained")
    lines = printed.splitlines()
    listed = [line.split()[0] for line in lines[1:] if line.strip()]
    first = list(dict.fromkeys(one.suite for one in read_headroom()))  # as docs/unsolved.md has them
    assert listed[: len(first)] == first
    assert listed[len(first) : len(EVERY_SUITE)] == [name for name in EVERY_SUITE if name not in first]
    for best in map(headroom_of, first):
        line = next(line for line in lines if line.startswith(f"{best.suite} "))
        assert (f" {best.headroom:.2f}" if best.state == "open" else f" {best.state} ") in line
    assert len(SUITES) == 19
    for name, suite in EVERY_SUITE.items():
        line = next(line for line in lines if line.startswith(f"{name} "))
        assert suite.card.title in line
        assert suite.card.separates in line


# --- inspect --------------------------------------------------------------------------------------------------------


def test_a_task_is_shown_with_a_sheet_of_the_right_size(program, out):
    code, printed, err = program("inspect", CLEAN, "--rows", "3", "--out", out)
    assert (code, err) == (0, "")
    sheet = out / "sheets" / f"clean-{RIVERSIDE}.png"
    assert f"contact sheet: {sheet}" in printed
    localization = 2 * len(SUITES["clean"].variants)
    for word in ("Rotation, scale and crop", "ODbL", "map_fingerprint", f"localization {localization}"):
        assert word in printed
    assert not set("{}[]'") & set(printed)
    three = cv2.imread(str(sheet)).shape[0]
    heights = []
    for rows in ("1", "2"):
        program("inspect", CLEAN, "--rows", rows, "--out", out)
        heights.append(cv2.imread(str(sheet)).shape[0])
    assert 100 < three - heights[1] == pytest.approx(heights[1] - heights[0], abs=1)


def test_one_query_is_shown_by_its_id_and_a_task_by_its_folder(program, out):
    name = next(read_queries(out / "tasks" / CLEAN)).query_id[:8]
    code, printed, _ = program("inspect", out / "tasks" / CLEAN, "--query", name, "--out", out)
    assert code == 0
    sheet = out / "sheets" / f"clean-{RIVERSIDE}-{name}.png"
    assert str(sheet) in printed
    program("inspect", CLEAN, "--rows", "1", "--out", out)
    assert cv2.imread(str(sheet)).shape == cv2.imread(str(out / "sheets" / f"clean-{RIVERSIDE}.png")).shape


def test_a_split_is_shown_with_its_map(program, tmp_path):
    code, printed, err = program("inspect", "holdout")
    assert (code, err) == (0, "")
    assert "nearest blocks of two parts" in printed
    assert "map of parts: out/sheets/split-holdout.png" in printed
    assert cv2.imread(str(tmp_path / "out/sheets/split-holdout.png")).shape[1] > 1200


@pytest.mark.parametrize(
    ("target", "words"),
    [
        ("nothing", "there is no region, task, split or run 'nothing': build-region and make-queries put some into"),
        ("out/regions/vadus", "there is no region, task, split or run 'vadus', did you mean 'vaduz'?"),
        ("vaduz@2013-08-03", "out/regions holds no region 'vaduz@2013-08-03': build-region vaduz --date 2013-08-03"),
        ("clean/nowhere", "holds no task clean/nowhere: draw it with make-queries --suite clean"),
        ("claen/town-grid", "there is no suite 'claen', did you mean 'clean/town-grid'?"),
        (".", ". is no region, task or run: build-region"),
    ],
)
@pytest.mark.parametrize("command", ["inspect", "verify"])
def test_a_target_that_is_nothing_gets_one_line(command, target, words, mistake):
    assert words in mistake(command, target)


@pytest.mark.parametrize(
    ("target", "words"),
    [
        ("nothing", f"name one of those in out, 2 regions (town-grid, {RIVERSIDE}), 1 task ({CLEAN})"),
        ("out", f"out is no region, task or run: name one of those in out, 2 regions (town-grid, {RIVERSIDE})"),
        ("out/tasks", f"out/tasks is no region, task or run, but holds some: name one, as out/tasks/{CLEAN}"),
        ("out/boards/mine", "out/boards/mine is a board: publish --board out/boards/mine makes a site of it"),
        (f"out/tasks/{CLEAN}/task.json", f"is a file, not a region, task or run: name its folder out/tasks/{CLEAN}"),
        ("clean/town-riversied", f"holds no task clean/town-riversied: there is {CLEAN}"),
        ("town-grid.toml", "town-grid.toml is a region file: inspect town-grid shows it"),
        ("mine.toml", "mine.toml is a region file: build-region mine.toml first, then inspect mine"),
        ("out/locate/a", "out/locate/a is what locate found: open out/locate/a/index.html in a browser"),
        ("out/locate/a/index.html", "out/locate/a/index.html is a page: open it in a browser"),
    ],
)
def test_a_target_that_is_something_else_is_told_what_it_is_and_what_there_is(target, words, mistake, tmp_path):
    files = [f"regions/{RIVERSIDE}/region.json", "regions/town-grid/region.json", f"tasks/{CLEAN}/task.json"]
    others = ("boards/mine/board.json", "locate/a/locate.csv", "locate/a/index.html")
    for path in (tmp_path / "out" / file for file in (*files, *others)):
        path.parent.mkdir(parents=True, exist_ok=True)
        path.touch()
    for name in ("mine.toml", "town-grid.toml"):
        (tmp_path / name).write_text('id = "mine"\n[[extract]]\nfile = "a.osm.pbf"\n')
    assert words in mistake("inspect", target)


# --- verify ---------------------------------------------------------------------------------------------------------


def test_a_good_task_is_said_to_be_good_with_and_without_its_truths(program, out):
    message = "all files are as task.json says, and every query has its truth"
    assert program("verify", CLEAN, "--out", out) == (0, f"{CLEAN}: {message}\n", "")
    (out / "truth" / CLEAN / TRUTH).unlink()
    code, printed, _ = program("verify", CLEAN, "--out", out)
    assert code == 0
    assert "every query has its truth" not in printed
    assert "its truths are not here" in printed


def test_faults_of_a_task_are_listed_and_make_exit_2(program, out):
    data = bytearray((out / "tasks" / CLEAN / QUERIES).read_bytes())
    data[1000] ^= 1
    (out / "tasks" / CLEAN / QUERIES).write_bytes(bytes(data))
    (out / "tasks" / CLEAN / "stray.txt").write_text("?")
    code, printed, err = program("verify", CLEAN, "--out", out)
    assert (code, err) == (2, "")
    assert "queries.parquet: " in printed
    assert "SHA-256" in printed
    assert "stray.txt: not part of a task" in printed


def test_one_target_is_verified_and_tasks_are_for_answers_alone(mistake, out):
    for words in ((), (CLEAN, "--predictions", CLEAN)):
        assert "verify needs one target: name a region, a task, a split, a run" in mistake("verify", *words)
    for target in (CLEAN, RIVERSIDE, "crossfit"):
        assert f"{target} holds no answers, and --tasks is" in mistake("verify", target, "--for", CLEAN, "--out", out)


@pytest.mark.parametrize("name", ["holdout", "crossfit"])
def test_the_towns_of_the_shipped_splits_share_no_ground(name, program, towns):
    code, printed, err = program("verify", name, "--out", towns)
    assert code == 0
    assert printed.startswith(f"{name}: no two parts share ground or look alike, 2 regions and ")
    assert printed.endswith(" blocks of 10 buildings searched\n")
    assert err.startswith("not searched, for not built: ")


def test_one_town_under_two_names_in_two_parts_is_caught(program, own_out, tmp_path):
    path = town(tmp_path / "own", "elsewhere", **{"center_lonlat = [12.25, 49.25]": "center_lonlat = [14.05, 51.35]"})
    build_region(plan_build(read_region_file(path), out=own_out))
    for kind in ("holdout", "crossfit"):
        split = split_file(tmp_path, RIVERSIDE, "elsewhere", "town-grid", "town-suburb", kind=kind)
        code, printed, err = program("verify", split, "--regions", path.parent, "--out", own_out)
        assert (code, err) == (2, "not searched, for not built: 1 region (town-suburb)\n")
        (line,) = printed.splitlines()
        assert f"{RIVERSIDE}/0-0 and elsewhere/0-0 of different parts hold the same ground: " in line
        assert int(line.split("ground: ")[1].split()[0]) > 50


def test_a_split_of_which_nothing_is_built_gets_one_line(program):
    code, printed, err = program("verify", "holdout")
    assert (code, printed) == (2, "")
    assert err.splitlines()[-1].endswith("build-region more")
