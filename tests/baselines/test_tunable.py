# SPDX-License-Identifier: Apache-2.0
"""Open numbers: as many trials for one system as for any other, and one rule that chooses."""

import json
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from itertools import groupby
from pathlib import Path

import pytest
from sasgeo_baselines.schmidt_segcorr import SchmidtSegcorr
from sasgeo_baselines.tunable import MOST_TRIALS

from benchmarks import budget, open_numbers

SYSTEMS = open_numbers.systems()
HEAD = b"system,setting,views,right,median_m,view_s\n"
STORED = Path(__file__).parents[2] / "docs" / "results" / "open-numbers.csv"


@pytest.mark.parametrize("name", SYSTEMS)
def test_each_system_has_as_many_settings_as_any_other_and_ours_fewer_and_is_made_with_those_in_use(name):
    kind = SYSTEMS[name]
    assert len(kind.settings()) == (3 if name == "sasgeo" else MOST_TRIALS)
    assert dict(kind.chosen) in kind.settings()
    assert kind().numbers == dict(kind.chosen)
    other = next(one for one in kind.settings() if one != dict(kind.chosen))
    assert kind(**other).numbers == other


def test_the_values_in_use_are_those_that_found_most_in_the_stored_trials():
    stored = open_numbers.read_trials(STORED)
    found = {name: open_numbers.best(list(some)).numbers for name, some in groupby(stored, key=lambda one: one.system)}
    assert found == {name: dict(kind.chosen) for name, kind in SYSTEMS.items()}
    assert [(one.system, one.numbers) for one in stored] == [
        (name, numbers) for name, kind in SYSTEMS.items() for numbers in kind.settings()
    ]


@pytest.mark.parametrize("name", sorted(set(SYSTEMS) - {"sasgeo"}))
def test_the_card_of_a_system_states_the_values_in_use(name):
    kind = SYSTEMS[name]
    own = {"stride": 4.0 * kind.chosen.get("stride", 0), "per_m2": 1 / kind.chosen.get("per_m2", 1)}  # in other units
    assert [f"{own.get(each, value):g}" in kind.card.ours for each, value in kind.chosen.items()] == [True] * len(
        kind.chosen
    )


def test_the_page_shows_the_stored_trials():
    page = (STORED.parents[1] / "concepts" / "systems.md").read_text(encoding="utf-8")
    assert "\n".join(open_numbers.lines(open_numbers.read_trials(STORED))) in page


@pytest.fixture
def trials():
    """Made-up trials of two systems: the last setting finds most."""
    return [
        open_numbers.Trial(
            system=name, setting=json.dumps(one), views=64, right=20 + at, median_m=30.0 - at, view_s=0.5
        )
        for name in ("brm_grid", "polar_vsc")
        for at, one in enumerate(SYSTEMS[name].settings())
    ]


@pytest.mark.parametrize(
    "content",
    [
        *(None, b"\xff\xfe\x00", b"a,b\n1,2\n"),
        HEAD + b'a,"{""x"": 1}",64,5,9,1\na,"{""y"": 1}",64,5,9,1\n',  # two settings of other numbers
        HEAD + b'a,"{""x"": NaN}",64,5,9,1\n',
        HEAD + b'a,"{""x"": 1}",64,-1,9,1\n',
    ],
)
def test_a_file_that_holds_no_trials_is_reported_in_one_line(content, tmp_path, monkeypatch, capsys):
    path = tmp_path / "trials.csv"
    if content is not None:
        path.write_bytes(content)
    monkeypatch.setattr("sys.argv", ["open_numbers.py", "--table", str(path)])
    with pytest.raises(SystemExit) as ended:
        open_numbers.main()
    assert ended.value.code == 2
    assert f"{path} holds no trials, or is damaged: move it away" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("name", "fault"),
    [
        ("nope", "there is no matcher 'nope'"),
        ("dead_reckoning", "dead_reckoning is not among the matchers of list matchers"),
        ("nothere:Class", "nothere:Class is not among the matchers of list matchers"),
    ],
)
def test_what_is_no_system_is_told_before_anything_is_drawn(name, fault, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr("sys.argv", ["budget.py", "--out", str(tmp_path / "out"), "--matcher", name])
    with pytest.raises(SystemExit) as ended:
        budget.main()
    assert ended.value.code == 2
    assert fault in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


class Failing(SchmidtSegcorr):
    """A system that cannot be asked with one of its settings."""

    open_numbers = {"sharpness": (1.0, 2.0)}
    chosen = {"sharpness": 1.0}

    def __init__(self, **numbers):
        if numbers.get("sharpness") == 2.0:
            raise ValueError("too sharp")
        super().__init__()


def test_a_system_that_fails_costs_its_own_trials_and_old_settings_are_left_out(trials, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(open_numbers, "drawn", lambda _: {})
    monkeypatch.setattr(open_numbers, "ProcessPoolExecutor", ThreadPoolExecutor)
    monkeypatch.setattr(open_numbers, "tried", lambda *asked: made_up(*asked[2:]))
    old = replace(trials[0], setting='{"pixel_m": 2.0}')
    open_numbers.write_trials(tmp_path / "trials.csv", [*trials[6:], old])
    open_numbers.try_all(tmp_path, {"brm_grid": SYSTEMS["brm_grid"], "my-failing": Failing}, jobs=1)
    out = capsys.readouterr().out
    assert "1 stored trial left out: of numbers that are open no more" in out
    assert 'my-failing {"sharpness": 2.0}: no trial (ValueError: too sharp)' in out
    assert [line.split("|")[1].strip() for line in out.splitlines() if line.startswith("| `")] == ["`brm_grid`"]
    stored = open_numbers.read_trials(tmp_path / "trials.csv")
    assert [trial.system for trial in stored] == ["brm_grid"] * 6 + ["my-failing"] + ["polar_vsc"] * 6


def made_up(kind, system, numbers):
    """A trial of a system that can be made."""
    kind(**numbers)
    return open_numbers.Trial(system=system, setting=json.dumps(numbers), views=64, right=9, median_m=30.0, view_s=0.5)


def test_most_views_choose_then_the_median_error_then_the_order(trials):
    own = trials[:6]
    assert open_numbers.best(own) == own[-1]
    same = [replace(trial, right=20, median_m=9.0) for trial in own]
    assert open_numbers.best(same) == same[0]
    assert open_numbers.best([*same, replace(own[2], right=20, median_m=8.0)]).median_m == 8.0


def test_a_number_that_is_not_open_is_refused():
    with pytest.raises(TypeError, match="no open number 'sharpness', it has least_share, coarse_m"):
        SchmidtSegcorr(sharpness=2.0)
