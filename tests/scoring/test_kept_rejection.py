# SPDX-License-Identifier: Apache-2.0
"""What rejectors made of answers comes back as it was, and nothing that anything else would give."""

import os
import time
from dataclasses import replace
from types import SimpleNamespace
from unittest import mock

import numpy as np
import pandas as pd
import pytest

from sasgeo_bench.core.errors import StoreError
from sasgeo_bench.core.room import Room, seal
from sasgeo_bench.matching.matcher import Prediction
from sasgeo_bench.running.prediction_files import StoredAnswers
from sasgeo_bench.sasgeo.rejectors import SasgeoBoosted, SasgeoLogistic
from sasgeo_bench.scoring import kept_rejection, rejection
from sasgeo_bench.scoring.kept_rejection import Judgement
from sasgeo_bench.scoring.rejection import OWN, RejectionTask, Rule, rules_of
from tests.scoring.test_integrity import Score, judged_table, split_of_countries

NAME = "sasgeo_logistic"


@pytest.fixture
def fits(monkeypatch):
    """Return the names of rejectors as they are fitted, on a program that does not change meanwhile."""
    monkeypatch.setattr(kept_rejection, "_programs", lambda: b"program")
    monkeypatch.setenv("SASGEO_KEPT_MB", "100")
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
def test_anything_else_that_a_fit_follows_from_is_fitted_anew(tmp_path, fits, change, monkeypatch):
    monkeypatch.setattr(rejection, "integrity_rows", lambda *_, **__: [])  # they take most of the time
    monkeypatch.setattr(rejection, "acceptance_frame", lambda *_: rejection.ACCEPTANCE_SCHEMA.empty())
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

    def of_program(text, name="rule.py", changed_s=1e9):
        path.unlink(missing_ok=True)
        path.with_name(name).write_text(text)
        for one in path.parent.rglob("*.py"):
            os.utime(one, (changed_s, changed_s))
        return kept_rejection._programs()

    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setattr(kept_rejection, "SHIPPED_MODULES", ("sasgeo_like", "sasgeo_none"))
    __import__("sasgeo_like")
    before = of_program("limit = 1")
    compiled = path.parent / "__pycache__" / "rule.cpython-311.pyc.140234"  # while another process writes it
    compiled.parent.mkdir(exist_ok=True)
    compiled.touch()
    assert before == of_program("limit = 1")
    assert of_program("limit = 2", changed_s=time.time() + 1) is None  # since this process began
    others = [of_program("limit = 2", changed_s=2e8), of_program("limit = 1", changed_s=3e8, name="other.py")]
    monkeypatch.setattr(kept_rejection, "installed", list)
    kept_rejection._digest.cache_clear()
    others.append(kept_rejection._programs())
    assert len({before, *others}) == 4
    assert None not in others
    monkeypatch.setattr(kept_rejection, "_programs", lambda: None)
    rejection._evaluated(task(tmp_path / "kept"))
    assert not (tmp_path / "kept").exists()


def test_a_program_of_which_a_file_goes_meanwhile_is_none(monkeypatch):
    monkeypatch.setattr(kept_rejection, "_digest", mock.Mock(side_effect=FileNotFoundError))
    monkeypatch.setattr(kept_rejection.psutil, "Process", lambda: SimpleNamespace(create_time=lambda: 1e12))
    assert kept_rejection._programs() is None


def test_the_packages_that_ship_are_hashed():
    found = kept_rejection._programs()
    assert found is None or len(found) == 32  # None to who edits them meanwhile
    assert {"sasgeo_bench", "sasgeo_baselines"} <= {*kept_rejection.SHIPPED_MODULES}


def test_answers_that_cannot_be_read_are_the_fault_that_they_were(tmp_path, fits):
    unread = task(tmp_path / "kept", predictions=StoredAnswers({}, {}))
    found = rejection._evaluated(unread)
    assert isinstance(found[NAME], KeyError)
    assert isinstance(rejection._evaluated(replace(unread, kept=None))[NAME], KeyError)
    assert fits == []


def test_of_a_rejector_that_does_not_ship_nothing_is_kept(tmp_path, fits):
    split = split_of_countries()
    rules = rules_of(["tests.scoring.test_integrity:Score"], split)
    assert rules["score"].code == "tests.scoring.test_integrity:Score"
    for rule in (rules["score"], Rule(card=Score.card, make=Score, split=split)):
        for _ in range(2):
            rejection._evaluated(task(tmp_path, rules={"score": rule}))
    assert fits == ["score"] * 4
    assert len([*tmp_path.iterdir()]) == 1  # the matcher's own confidence


def tuned():
    """Return a rejector that ships, made otherwise than it ships."""
    rejector = SasgeoLogistic()
    rejector.p_false = lambda predictions: np.full(len(predictions), 0.5)
    return rejector


def test_of_a_rejector_that_a_function_makes_nothing_is_kept(tmp_path, fits):
    rejection._evaluated(task(tmp_path))
    rules = rules_of([f"{__name__}:tuned"], split_of_countries())
    assert_same(rejection._evaluated(task(tmp_path, rules=rules)), rejection._evaluated(task(None, rules=rules)))
    assert fits == [NAME] * 3


def test_a_damaged_file_is_computed_anew(tmp_path, fits):
    some = task(tmp_path)
    plain = rejection._evaluated(some)
    for path in tmp_path.iterdir():
        data = bytearray(path.read_bytes())
        data[len(data) // 2] ^= 1
        path.write_bytes(data)
    assert_same(rejection._evaluated(some), plain)
    assert_same(rejection._evaluated(some), plain)
    assert fits == [NAME] * 2


def test_maps_and_answers_share_one_size_and_what_was_not_read_longest_goes(tmp_path, fits, monkeypatch):
    monkeypatch.setenv("SASGEO_KEPT_MB", "1")
    room = Room(tmp_path)
    (room.maps / "a map" / "graph").mkdir(parents=True)
    (room.maps / "a map" / "graph" / "nodes.npy").write_bytes(bytes(400_000))
    seal(room.maps / "a map" / "graph")
    room.fits.mkdir()
    (room.fits / "old").write_bytes(bytes(590_000))
    (room.fits / ".left.partial").touch()
    for path in (room.fits / "old", room.fits / ".left.partial"):
        os.utime(path, (0, 0))
    rejection._evaluated(task(room.fits))
    assert [entry.path.parent.name for entry in room.entries()] == ["a map", "rejectors", "rejectors"]
    assert not {"old", ".left.partial"} & {path.name for path in room.fits.iterdir()}
    with pytest.raises(StoreError, match="more than SASGEO_KEPT_MB allows"):
        room.make(1_000_001)
    room.make(1_000_000)
    assert [*room.entries()] == [*room.maps.iterdir()] == []
    assert fits == [NAME]


def test_what_cannot_be_written_is_computed_each_time(tmp_path, fits):
    (tmp_path / "kept").touch()  # no folder
    for _ in range(2):
        found = rejection._evaluated(task(tmp_path / "kept"))
    assert fits == [NAME] * 2
    assert isinstance(found[NAME], Judgement)
    assert type(task(None).rules[NAME].make()) is SasgeoLogistic
