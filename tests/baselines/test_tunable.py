# SPDX-License-Identifier: Apache-2.0
"""Open numbers: as many trials for one system as for any other, and one rule that chooses."""

import json
from itertools import groupby
from pathlib import Path

import pytest
from sasgeo_baselines.schmidt_segcorr import SchmidtSegcorr
from sasgeo_baselines.tunable import MOST_TRIALS

from benchmarks import budget, open_numbers
from sasgeo_bench.core.errors import StoreError

SYSTEMS = open_numbers.systems()
HEAD = b"system,setting,was_used,views,median_m,view_s,here\n"
LEFT = {"lcm_balanced", "liu_object_graph"}  # the dearest, not tried on train places yet: record 40
STORED = Path(__file__).parents[2] / "docs" / "results" / "open-numbers.csv"


@pytest.mark.parametrize("name", SYSTEMS)
def test_each_system_has_as_many_settings_as_any_other_and_ours_fewer_and_is_made_with_those_in_use(name):
    kind = SYSTEMS[name]
    assert len(kind.settings()) == (3 if name == "sasgeo" else MOST_TRIALS)
    assert dict(kind.chosen) in kind.settings()
    assert kind().numbers == dict(kind.chosen)
    other = next(one for one in kind.settings() if one != dict(kind.chosen))
    assert kind(**other).numbers == other


def test_the_values_in_use_are_those_that_the_rule_takes_from_the_stored_trials():
    stored = open_numbers.read_trials(STORED)
    judged = {name: open_numbers.verdict(list(some)) for name, some in groupby(stored, key=lambda one: one.system)}
    assert {name: found.chosen.numbers for name, found in judged.items()} == {
        name: dict(kind.chosen) for name, kind in SYSTEMS.items() if name not in LEFT
    }
    assert [(one.system, one.numbers) for one in stored] == [
        (name, numbers) for name, kind in SYSTEMS.items() if name not in LEFT for numbers in kind.settings()
    ]
    assert {tuple(one.right_of) for one in stored} == {tuple(open_numbers.places())}


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


def made_up(name, numbers, found=(1, 1, 1, 1, 1, 1), *, used=False, median_m=30.0):
    """A trial of 12 views in six places."""
    return open_numbers.Trial(
        system=name,
        setting=json.dumps(numbers),
        was_used=used,
        views=12,
        right_of=dict(zip("uvwxyz", found, strict=True)),
        median_m=median_m,
        view_s=0.5,
    )


@pytest.mark.parametrize(
    "content",
    [
        *(None, b"\xff\xfe\x00", b"a,b\n1,2\n"),
        HEAD + b'a,"{""x"": 1}",yes,64,9,1,5\na,"{""y"": 1}",,64,9,1,5\n',  # two settings of other numbers
        HEAD + b'a,"{""x"": 1}",,64,9,1,5\na,"{""x"": 2}",,64,9,1,5\n',  # none in use
        HEAD + b'a,"{""x"": NaN}",yes,64,9,1,5\na,"{""x"": 2}",,64,9,1,5\n',
        HEAD + b'a,"{""x"": 1}",yes,64,9,1,-1\na,"{""x"": 2}",,64,9,1,5\n',
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


def test_a_system_that_fails_costs_its_own_trials_and_what_is_there_is_not_asked_again(tmp_path, monkeypatch, capsys):
    asked = []

    def answered(_views, place, system, kind, setting):
        kind(**json.loads(setting))
        asked.append((place, system, setting))
        return [open_numbers.Answer(system=system, setting=setting, place=place, error_m=9.0, view_s=0.5)]

    views = open_numbers.Views(out=tmp_path, asked={"u": [], "v": []}, lessons={})
    monkeypatch.setattr(open_numbers, "drawn", lambda _: views)
    monkeypatch.setattr(open_numbers, "answers", answered)
    open_numbers.try_all(tmp_path, {"brm_grid": SYSTEMS["brm_grid"]}, jobs=1)
    assert len(asked) == 12
    open_numbers.try_all(tmp_path, {"brm_grid": SYSTEMS["brm_grid"], "my-failing": Failing}, jobs=1)
    out = capsys.readouterr().out
    assert "12 settings at places there, 4 to ask" in out
    assert 'my-failing {"sharpness": 2.0} at u: no answer (ValueError: too sharp)' in out
    assert len(asked) == 14
    assert [line.split("|")[1].strip() for line in out.splitlines() if line.startswith("| `")] == ["`brm_grid`"] * 2
    answers = open_numbers.read_answers(tmp_path / "answers.csv")
    assert {(one.place, one.system, one.setting) for one in answers} == set(asked)


def test_answers_that_are_none_are_told(tmp_path):
    (tmp_path / "answers.csv").write_text("system,place\na,b\n")
    with pytest.raises(StoreError, match="holds no answers"):
        open_numbers.read_answers(tmp_path / "answers.csv")


def test_most_views_choose_then_the_median_error_then_the_order():
    own = [made_up("a", {"x": at}, (at,) * 6) for at in range(2)]
    assert open_numbers.best(own) == own[-1]
    same = [made_up("a", {"x": at}, median_m=9.0) for at in range(3)]
    assert open_numbers.best(same) == same[0]
    better = made_up("a", {"x": 3}, median_m=8.0)
    assert open_numbers.best([*same, better]) == better


@pytest.mark.parametrize(
    ("found", "changes"),
    [
        ((2, 2, 2, 2, 1, 1), True),
        ((1, 1, 1, 1, 1, 1), False),  # a tie
        ((2, 2, 1, 1, 1, 1), False),  # more, but only in two places
        ((0, 0, 0, 0, 0, 1), False),
    ],
)
def test_a_setting_is_changed_only_where_another_one_surely_finds_more(found, changes):
    used, other = made_up("a", {"x": 0}, used=True), made_up("a", {"x": 1}, found, median_m=1.0)
    judged = open_numbers.verdict([used, made_up("a", {"x": 2}, (0,) * 6), other])
    assert (judged.used, judged.other) == (used, other)
    assert judged.chosen == (other if changes else used)
    assert judged.gain.value == pytest.approx(100 * (other.right - used.right) / 12)


def test_trials_are_written_and_read_again(tmp_path):
    some = [made_up("brm_grid", one, used=not at) for at, one in enumerate(SYSTEMS["brm_grid"].settings())]
    open_numbers.write_trials(tmp_path / "trials.csv", some)
    assert open_numbers.read_trials(tmp_path / "trials.csv") == some


def test_a_number_that_is_not_open_is_refused():
    with pytest.raises(TypeError, match="no open number 'sharpness', it has least_share, coarse_m"):
        SchmidtSegcorr(sharpness=2.0)
