# SPDX-License-Identifier: Apache-2.0
"""Trials of the joint score: every arm is a matcher, and the table says what stored answers say."""

from collections import Counter
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np

import sasgeo_bench as sgb
from benchmarks import joint_trials
from benchmarks.joint_trials import ARMS, USUAL, Answer, lines, read_answers
from benchmarks.joint_weights import Modes, settings
from sasgeo_bench.sasgeo.ablations import Switches
from sasgeo_bench.sasgeo.variants import Sasgeo

ROOT = Path(__file__).parents[2]
OURS = ("searches_overlap", "weighs_prior", "weighs_amounts", "weighs_overlap")


def test_each_arm_leaves_out_one_thing_and_the_usual_one_all():
    changed = {}
    for name in ARMS:
        switches = None if "~" in name else getattr(sgb.load_matcher(name), "switches", None)
        if switches is not None:
            changed[name] = {key for key, value in asdict(switches).items() if value != asdict(Switches())[key]}
    assert changed.pop(USUAL) == {*OURS, "burns_vectors"}  # as it was before
    assert not changed.pop("sasgeo")
    assert not changed.pop("sasgeo_prior")  # untaught
    assert {len(one) for one in changed.values()} == {1}
    assert set().union(*changed.values()) == {*OURS, "burns_vectors", "has_graph"}
    assert Sasgeo.switches == Switches()


def test_cards_say_which_terms_an_arm_has():
    taught = [name for name in ARMS if name.startswith("sasgeo") and name != "sasgeo_prior" and "~" not in name]
    texts = {name: sgb.load_matcher(name).card for name in taught}
    assert len({card.ours for card in texts.values()}) == len(texts)
    assert texts[USUAL].version < texts["sasgeo"].version
    assert all("overlap" in texts[name].ours for name in ("sasgeo", "sasgeo_overlap_always"))


def test_by_hand_a_table_of_two_arms(tmp_path):
    one = Answer(arm=USUAL, group="clean x3", place="a", query_id="q1", is_found=False, is_listed=True, view_s=0.2)
    usual = [one, replace(one, query_id="q2", is_found=True), replace(one, query_id="q3", place="b", group="clean x4")]
    ours = [replace(item, arm="sasgeo", is_found=True, view_s=0.1) for item in usual]
    table = list(lines(usual + ours))
    assert table[0] == "| Arm | s | clean x3 + x4 | clean x3 | clean x4 |"
    assert table[2].startswith("| `sasgeo` | 0.10 | 1.000 of 1.000, +66.7 [")
    assert table[2].endswith("] (2/0), n 3 | 1.000 of 1.000 (1/0), n 2 | 1.000 of 1.000 (1/0), n 1 |")
    assert "| 0.333 of 1.000, +0.0 [0.0, 0.0] (0/0), n 3 |" in table[3]
    path = tmp_path / "answers.csv"
    path.write_text("arm,group,place,query_id,is_found,is_listed,view_s\nsasgeo,clean x3,a,q1,True,False,0.25\n")
    (read,) = read_answers(path)
    assert (read.is_found, read.is_listed, read.view_s) == (True, False, 0.25)
    assert read_answers(tmp_path / "none.csv") == []


def test_suites_are_drawn_before_they_are_asked():
    assert {suite for suite, *_ in joint_trials.ASKED} | set(joint_trials.LESSONS) == set(joint_trials.DRAWN)
    assert {joint_trials.half_of(name) for name in joint_trials.DATED} == {"a", "b"}
    assert joint_trials.half_of("malabo@2014-01-01") == "a"


def test_what_stands_finds_more_with_errors_and_loses_nowhere_beyond_one_view():
    stored = read_answers(ROOT / "docs" / "results" / "joint-trials.csv")
    assert {one.arm for one in stored} <= set(ARMS)
    ours, usual = (
        {(one.group, one.query_id): one.is_found for one in stored if one.arm == arm} for arm in ("sasgeo", USUAL)
    )
    assert ours.keys() == usual.keys()
    lost = Counter(group for group, query in ours if usual[group, query] and not ours[group, query])
    won = Counter(group for group, query in ours if ours[group, query] and not usual[group, query])
    assert max(lost.values(), default=0) <= 1
    assert all(won[group] > lost[group] + 5 for group in ("clean x3", "clean x4", "volatile-lure"))


def test_by_hand_what_a_gate_and_weights_would_find_among_two_modes():
    view = Modes(
        group="clean x4",
        right=np.array([True, False]),
        terms=np.array([0.0, 1.0]),
        unlike=np.array([0.5, 0.0]),
        overlaps=np.array([[0.1, 0.6], [0.2, 0.2]]),  # lines, then areas
        both=np.array([[10.0, 60.0], [20.0, 20.0]]),
        either=np.full((2, 2), 100.0),
        is_line=np.array([True, False]),
        weights=(1.0, 10.0),
    )
    assert view.lines_seen(as_one=True) == view.lines_seen(as_one=False) == 0.2
    assert view.finds(say=1.0)  # 7.0 - 0.5 against 1.0 + 4.0
    assert not view.finds(say=0.0)
    assert not view.finds(say=1.0, amount=8.0)
    assert not view.finds(say=1.0, overlap=0.1)
    assert {name: bool(finds(view)) for name, finds in settings()}["areas never count"] is False
