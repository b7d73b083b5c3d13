# SPDX-License-Identifier: Apache-2.0
"""Trials of the scorer: one switch or number at a time, against what stands; stored ones hold the code."""

import json
from itertools import groupby
from pathlib import Path

import pytest

from benchmarks import open_numbers, scorer_trials
from sasgeo_bench.sasgeo import raster
from sasgeo_bench.sasgeo.variants import Sasgeo, SasgeoPrior

ROOT = Path(__file__).parents[2]
STORED = ROOT / "docs" / "results" / "scorer-trials.csv"


def test_each_setting_differs_from_what_stands_in_one_thing():
    stands = scorer_trials.TriedSasgeo()
    assert (stands.switches, stands.plan) == (Sasgeo.switches, SasgeoPrior().plan)
    settings = scorer_trials.TriedSasgeo.settings()
    assert all(len(one) <= 1 for one in settings)
    assert len({json.dumps(one) for one in settings}) == len(settings)
    for one in settings:
        for name, value in one.items():
            assert (name == "learns") == (value == scorer_trials.STANDS[name])


def test_a_setting_does_what_it_says_and_leaves_the_rest_as_it_was(monkeypatch):
    seen = {}
    monkeypatch.setattr(Sasgeo, "match", lambda *_, **__: seen.update(level_m=raster.LEVEL_M, bound=raster.REPEATED))
    scorer_trials.TriedSasgeo(level_m=8.0).match(None, top_k=1)
    assert seen == {"level_m": 8.0, "bound": scorer_trials.STANDS["repeated"]}
    assert scorer_trials.STANDS["level_m"] == raster.LEVEL_M
    assert not scorer_trials.TriedSasgeo(has_graph=0.0).switches.has_graph
    assert scorer_trials.TriedSasgeo(is_fitted=0.0).switches.weights == "even"
    assert scorer_trials.TriedSasgeo(beam=160.0).plan.beam == (160, 48, 20, 12, 10)
    assert scorer_trials.TriedSasgeo().learn(None) == ""


def test_what_stands_is_a_trial_of_each_number():
    answers = [
        open_numbers.Answer(system="sasgeo", setting=json.dumps(one), place="u", error_m=9.0, view_s=0.5)
        for one in scorer_trials.TriedSasgeo.settings()
    ]
    trials = scorer_trials.by_number(answers, ["u"])
    for name, own in groupby(trials, key=lambda trial: trial.system):
        values = {trial.numbers[name]: trial.was_used for trial in own}
        assert values == {scorer_trials.STANDS[name]: True, **dict.fromkeys(scorer_trials.OTHERS[name], False)}


@pytest.mark.parametrize("name", scorer_trials.STANDS)
def test_what_stands_is_what_the_rule_takes_from_the_stored_trials(name):
    own = [trial for trial in open_numbers.read_trials(STORED) if trial.system == name]
    assert open_numbers.verdict(own).chosen.numbers == {name: scorer_trials.STANDS[name]}


def test_the_record_shows_the_stored_trials():
    page = (ROOT / "docs" / "decisions" / "0040-chosen-on-train-places.md").read_text(encoding="utf-8")
    assert "\n".join(open_numbers.lines(open_numbers.read_trials(STORED))) in page
