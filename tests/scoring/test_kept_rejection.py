# SPDX-License-Identifier: Apache-2.0
"""What rejectors made of answers comes back as it was, and nothing that anything else would give."""

import os
import time
from dataclasses import replace

import numpy as np
import pandas as pd
import pytest

from sasgeo_bench.matching.matcher import Prediction
from sasgeo_bench.running.prediction_files import StoredAnswers
from sasgeo_bench.sasgeo.rejectors import SasgeoBoosted, SasgeoLogistic
from sasgeo_bench.scoring import kept_rejection, rejection
from sasgeo_bench.scoring.kept_rejection import MOST_DAYS, Judgement
from sasgeo_bench.scoring.rejection import OWN, RejectionTask, Rule, rules_of
from tests.scoring.test_integrity import Score, judged_table, split_of_countries

NAME = "sasgeo_logistic"


@pytest.fixture
def fits(monkeypatch):
    """Return the names of rejectors as they are fitted, on a program that does not change meanwhile."""
    monkeypatch.setattr(kept_rejection, "_programs", lambda module: module.encode())
    fitted, judge = [], rejection.judge

    def judged(scores, predictions, make, split, *, is_taught):
        fitted.append(make().card.name)
        return judge(scores, predictions, make, split, is_taught=is_taught)

    monkeypatch.setattr(rejection, "judge", judged)
    return fitted


def task(kept, rejectors=(NAME,), answers=None, **changes):
    """Return what two rejectors are to make of 120 answers, some with a confidence of their own."""
    table, found = judged_table()
    table = table.assign(block=[f"{place}/{at % 3}" for at, place in enumerate(table["place"])])
    sure = np.random.default_rng(0).random(len(table))
    table = table.assign(confidence=np.where(np.arange(len(table)) % 9 > 0, sure, np.nan))
    split = split_of_countries()
    usual = {
        "matcher": "mine",
        "scores": table,
        "predictions": StoredAnswers.of(answers or found.values()),
        "rules": rules_of(rejectors, split),
        "split": split,
        "is_taught": False,
        "kept": kept,
    }
    return RejectionTask(**(usual | changes))


def assert_same(found, expected):
    assert [*found] == [*expected]
    for name, judgement in expected.items():
        for mine, other in zip(found[name], judgement, strict=True):
            if len(other):  # columns of an empty table have no type
                pd.testing.assert_frame_equal(mine, other, check_exact=True)
            assert len(mine) == len(other)


def test_what_is_kept_is_what_was_computed_without_a_fit(tmp_path, fits):
    some = task(tmp_path / "kept", rejectors=(NAME, "sasgeo_boosted"))
    plain = rejection._evaluated(replace(some, kept=None))
    first, again = rejection._evaluated(some), rejection._evaluated(some)
    assert fits == [NAME, "sasgeo_boosted"] * 2
    assert [*plain] == [OWN, NAME, "sasgeo_boosted"]
    assert any(len(judgement.acceptance) for judgement in plain.values())
    assert plain[NAME].judged["remark"].nunique() > 0
    assert_same(first, plain)
    assert_same(again, plain)
    assert_same(
        rejection._evaluated(replace(some, rules={NAME: some.rules[NAME]})), {OWN: plain[OWN], NAME: plain[NAME]}
    )
    assert len(fits) == 4


def changed_answers(**changes):
    """Return the answers with one of them changed."""
    first, *others = judged_table()[1].values()
    return [replace(first, **changes), *others]


def of_one_half_more():
    split = split_of_countries()
    places = [place.model_copy(update={"half": "a"}) for place in split.spec.place]
    return replace(split, spec=split.spec.model_copy(update={"place": places}))


def with_column(name, value):
    table = task(None).scores
    table.loc[8, name] = value
    return table


@pytest.mark.parametrize(
    "change",
    [
        lambda: {"matcher": "another"},
        lambda: {"is_taught": True},
        lambda: {"split": of_one_half_more()},
        lambda: {"answers": changed_answers(confidence=0.25)},
        lambda: {"answers": changed_answers(diagnostics={"margin": 1.0})},
        lambda: {"answers": changed_answers(candidates=(*changed_answers()[1].candidates * 2,))},
        lambda: {"answers": [*judged_table()[1].values(), Prediction(query_id="beside")]},
        lambda: {"scores": with_column("is_right", value=False)},
        lambda: {"scores": with_column("country", "other")},
        lambda: {"scores": with_column("block", "place4/9")},
        lambda: {"scores": with_column("confidence", 0.125)},
        lambda: {"scores": task(None).scores[:119]},
        lambda: {"scores": task(None).scores[::-1].reset_index(drop=True)},
        lambda: {"scores": task(None).scores.assign(more=1.0)},
    ],
)
def test_anything_else_that_a_fit_follows_from_is_fitted_anew(tmp_path, fits, change):
    rejection._evaluated(task(tmp_path))
    changed = task(tmp_path, **change())
    found = rejection._evaluated(changed)
    assert fits == [NAME] * 2
    assert_same(found, rejection._evaluated(replace(changed, kept=None)))


def test_another_class_of_the_same_name_is_fitted_anew(tmp_path, fits):
    rejection._evaluated(task(tmp_path))
    rule = task(tmp_path).rules[NAME]
    other = replace(rule, make=SasgeoBoosted, code="sasgeo_bench.sasgeo.rejectors:SasgeoBoosted")
    rejection._evaluated(task(tmp_path, rules={NAME: other}))
    assert fits == [NAME, "sasgeo_boosted"]


def test_code_and_libraries_of_other_versions_are_another_program(tmp_path, monkeypatch):
    path = tmp_path / "sasgeo_like" / "rule.py"
    path.parent.mkdir()
    (path.parent / "__init__.py").touch()
    path.write_text("limit = 1\n")

    def of_program():
        kept_rejection._programs.cache_clear()
        return kept_rejection._programs("sasgeo_like")

    monkeypatch.syspath_prepend(tmp_path)
    __import__("sasgeo_like")
    assert of_program() is None  # it has changed since this process began
    for one in path.parent.rglob("*.py"):
        os.utime(one, (1e9, 1e9))
    before = of_program()
    assert before == of_program()
    path.write_text("limit = 2\n")
    os.utime(path, (1e9, 1e9))
    after = of_program()
    path.rename(path.with_name("other.py"))
    assert len({before, after, of_program()}) == 3
    monkeypatch.setattr(kept_rejection, "distributions", list)
    assert of_program() not in {before, after}
    kept_rejection._programs.cache_clear()


def test_of_a_rejector_that_does_not_ship_nothing_is_kept(tmp_path, fits):
    split = split_of_countries()
    rules = rules_of(["tests.scoring.test_integrity:Score"], split)
    assert rules["score"].code == "tests.scoring.test_integrity:Score"
    for rule in (rules["score"], Rule(card=Score.card, make=Score, split=split)):
        for _ in range(2):
            rejection._evaluated(task(tmp_path, rules={"score": rule}))
    assert fits == ["score"] * 4
    assert len([*tmp_path.iterdir()]) == 1  # the matcher's own confidence


def test_a_damaged_file_is_computed_anew_and_one_that_nobody_reads_goes(tmp_path, fits):
    some = task(tmp_path)
    plain = rejection._evaluated(some)
    for path in tmp_path.iterdir():
        data = bytearray(path.read_bytes())
        data[len(data) // 2] ^= 1
        path.write_bytes(data)
    old = tmp_path / f"old{kept_rejection._SUFFIX}"
    old.touch()
    os.utime(old, (time.time() - (MOST_DAYS + 1) * 86_400,) * 2)
    assert_same(rejection._evaluated(some), plain)
    assert_same(rejection._evaluated(some), plain)
    assert fits == [NAME] * 2
    assert not old.exists()


def test_what_cannot_be_written_is_computed_each_time(tmp_path, fits):
    (tmp_path / "kept").touch()  # no folder
    for _ in range(2):
        found = rejection._evaluated(task(tmp_path / "kept"))
    assert fits == [NAME] * 2
    assert isinstance(found[NAME], Judgement)
    assert type(task(None).rules[NAME].make()) is SasgeoLogistic
