# SPDX-License-Identifier: Apache-2.0
"""Suites of other packages: found by name or module, checked by the kit, drawn as ours are."""

import sys

import pytest

from sasgeo_bench.core.errors import ConfigError
from sasgeo_bench.matching.scaffold import package_files
from sasgeo_bench.running.suite_testing import check_suite
from sasgeo_bench.tasks.build import made_tasks, make_tasks
from sasgeo_bench.tasks.suites.all_suites import _foreign, find_suite, known_suite, suite_code
from sasgeo_bench.tasks.task_files import read_task
from sasgeo_bench.tasks.task_plan import TaskRequest, plan_requests

TOWN = "town-agricultural"


@pytest.fixture
def written(tmp_path, monkeypatch):
    """Write a module with the suite of the scaffold, some of its words replaced; return how it is named."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", [*sys.path])

    def write(module, **words):
        text = package_files("suite", "my-rows")["src/my_rows/suite.py"]
        for old, new in words.values():
            assert old in text
            text = text.replace(old, new)
        (tmp_path / f"{module}.py").write_text(text)
        return f"{module}:SUITE"

    yield write
    _foreign.cache_clear()
    for path in tmp_path.glob("*.py"):
        sys.modules.pop(path.stem, None)


def planned(spec, out):
    wanted = TaskRequest(suites=(spec,), regions=(TOWN,), split="crossfit", count=1, seed=1, out=out, may_be_fewer=True)
    return plan_requests(wanted)[0]


@pytest.fixture
def failed(tmp_path, lay_towns):
    """Names of the rules that a suite breaks."""
    lay_towns(tmp_path / "out", TOWN)
    return lambda spec: [row.name for row in check_suite(spec, out=tmp_path / "out") if row.outcome == "fail"]


def test_a_suite_of_somebody_else_is_drawn_under_its_name_and_again_when_its_code_changes(written, tmp_path, lay_towns):
    lay_towns(tmp_path / "out", TOWN)
    spec = written("rows_drawn")
    request = planned(spec, tmp_path / "out")
    (made,) = make_tasks(request)
    about = read_task(made.folder)
    assert made.folder == tmp_path / "out" / "tasks" / "my-rows" / TOWN
    assert about["suite_sha256"] == suite_code(spec)
    assert made_tasks(request) == (made.folder,)
    written("rows_drawn", rows=("rng.permutation(rows)", "rng.permutation(rows)[::-1]"))
    assert suite_code(spec) != about["suite_sha256"]
    assert made_tasks(request) is None
    assert suite_code("clean") is None
    assert known_suite("my-rows") is None  # nobody has registered it


def test_the_suite_of_the_scaffold_keeps_every_rule(written, failed):
    assert failed(written("rows_kept")) == []


@pytest.mark.slow
@pytest.mark.parametrize(("severity", "broken"), [(2, []), (0, ["a stress changes something"])])
def test_a_stress_may_lie_in_the_pictures_alone(failed, tmp_path, monkeypatch, severity, broken):
    text = f"""from dataclasses import replace
from sasgeo_bench.tasks.suites.corrupted import CORRUPTED
from sasgeo_bench.tasks.suites.pictures import Flight
import numpy as np

SUITE = replace(
    CORRUPTED,
    card=replace(CORRUPTED.card, name="my-fog"),
    variants=tuple(replace(one, view_cells=48) for one in CORRUPTED.variants[::82] + CORRUPTED.variants[1:2]),
    flight=lambda _: Flight(height_m=40.0),
    change=lambda shot, seen: np.full_like(seen, 9 + {severity} * (shot.variant.role == "stress")),
)
"""
    module = f"fog_{severity}"
    (tmp_path / f"{module}.py").write_text(text)
    monkeypatch.syspath_prepend(tmp_path)
    assert failed(f"{module}:SUITE") == broken


@pytest.mark.parametrize(
    ("rule", "old", "new"),
    [
        ("the same seed, the same queries", "rng.permutation(rows)", "np.random.default_rng().permutation(rows)"),
        ("a falsifier sees what its control sees", 'kind="none"', 'kind="none", strength=0.5'),
        ("a stress changes something", "share=variant.strength", "share=0.0"),
        ("has a control, a stress and a falsifier", '        Variant(role="falsifier", kind="none"),\n', ""),
        ("draws queries on town-agricultural", "rows, cols = evidence.shape", "rows, cols = 1 / 0"),
        ("loads, and has a card", "version=1", "version=1, colour=2"),
    ],
)  # fmt: skip
def test_a_suite_that_breaks_a_rule_fails_there(written, failed, rule, old, new):
    module = "rows_" + "".join(filter(str.isalpha, rule))
    assert rule in failed(written(module, change=(old, new)))


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("topologie-twins", "there is no suite 'topologie-twins', did you mean 'topology-twins'?"),
        ("nowhere:SUITE", "nowhere:SUITE: cannot be imported"),
        ("os:getcwd", "a str is no suite"),
        ("rows_taken:SUITE", "its card is named 'clean', as a suite that ships: rename it"),
        ("rows_odd:SUITE", "its card is named '../x'"),
    ],
)
def test_what_is_no_suite_is_refused_in_one_line(written, name, words):
    written("rows_taken", name=('name="my-rows"', 'name="clean"'))
    written("rows_odd", name=('name="my-rows"', 'name="../x"'))
    with pytest.raises(ConfigError) as raised:
        find_suite(name)
    assert words in str(raised.value)
    assert "\n" not in str(raised.value)


@pytest.mark.parametrize("name", ["clean", "My_Suite", "numpy"])
def test_a_name_that_a_suite_cannot_have_is_refused_before_anything_is_written(name):
    with pytest.raises(ConfigError, match=name):
        package_files("suite", name)
