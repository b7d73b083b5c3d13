# SPDX-License-Identifier: Apache-2.0
"""Metrics of other packages: found by name or module, held to their rules, measured beside ours without moving them."""

import dataclasses
import math
import re
import sys
import tempfile
from functools import cache, partial
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

import sasgeo_bench as sgb
from sasgeo_bench.core.errors import ConfigError, MatchError, MetricError
from sasgeo_bench.scoring import metric_testing
from sasgeo_bench.scoring.metric_plugins import ForeignMetric, find_metric, find_metrics, with_metrics
from sasgeo_bench.scoring.metric_testing import check_metric, metric_files
from sasgeo_bench.scoring.metrics import means_of
from sasgeo_bench.scoring.tables import leaderboard
from tests.scoring.test_tables import scores
from tests.slow import rest_slow

MEANS = {one.name: one for track in ("localization", "retrieval", "sequence") for one in means_of(track)}
NO_ANSWER = "no answer is the worst there is"


def near(rows):
    value = np.clip((50.0 - rows["position_error_m"].to_numpy(float)) / 45.0, 0.0, 1.0)
    return np.where(rows["is_present"], value, np.nan)


def metric(values=near, **changes):
    record = {"name": "near", "meaning": "Nearness of the fix", "better": "higher", "tracks": ("localization",)}
    return sgb.MeanMetric(**(record | {"values": values} | changes))


def foreign(*metrics):
    return [ForeignMetric(f"mine:{at}", one, "0" * 64) for at, one in enumerate(metrics)]


@pytest.fixture(scope="module", autouse=True)
def _worked_once():
    """The kit's answers on its small towns are worked once: each metric is asked about copies of the same rows."""
    with pytest.MonkeyPatch.context() as patch, tempfile.TemporaryDirectory() as folder:
        worked = cache(partial(metric_testing.worked_answers, Path(folder)))

        def copies(_, track):
            return {name: rows.copy() for name, rows in worked(track).items()}

        patch.setattr(metric_testing, "worked_answers", copies)
        yield


class Untold:
    def __repr__(self):
        return "Untold()"


class Unsaid:
    def __repr__(self):
        raise SystemExit(0)


class Unarrayed:
    def __init__(self, error):
        self.error = error

    def __array__(self, *_, **__):
        raise self.error


@pytest.mark.parametrize(
    ("value", "fault"),
    [
        (near, "a function is no metric, which is an instance of sasgeo_bench.MeanMetric: name MeanMetric("),
        (3, "an object of type int is no metric"),
        (None, "an object of type NoneType is no metric"),
        (sgb.MeanMetric, "an object of type type is no metric"),
        (metric(name="success_25m"), "it is named 'success_25m', as a metric that ships: rename it"),
        (metric(name="rank"), "it is named 'rank', as a column of boards: rename it"),
        (metric(name="Near One"), "it is named 'Near One': lower-case letters"),
        (metric(name=3), "it is named 3: lower-case letters"),
        (metric(name="n" * 5000), "it is named 'nnn"),
        (metric(meaning="m" * 4001), "its meaning is 'mmm"),
        (
            metric(meaning="two\nlines"),
            "its meaning is 'two\\nlines', expected a line of text, 4000 characters at most",
        ),
        (metric(better=np.array(["higher", "lower"])), "better is array(['higher', 'lower']"),
        (metric(bounds=(0, 10**400)), "bounds are (0, 1000"),
        (metric(bounds=(0, Untold())), "bounds are (0, Untold()), expected"),
        (metric(meaning=Unsaid()), "what it says of itself cannot be read (SystemExit"),
        (metric(meaning=" "), "its meaning is ' ', expected a line of text"),
        (metric(unit="a\nb"), "its unit is 'a\\nb', expected a line of text"),
        (metric(better="more"), "better is 'more', expected 'higher' or 'lower'"),
        (metric(bounds=(1.0, 0.0)), "bounds are (1.0, 0.0), expected the least and the greatest value"),
        (metric(bounds=(math.nan, 1.0)), "bounds are (nan, 1.0), expected"),
        (metric(bounds="01"), "bounds are '01', expected"),
        (metric(tracks=("flights",)), "tracks are ('flights',), expected some of"),
        (metric(tracks=[["localization"]]), "tracks are [['localization']], expected some of"),
        (metric(tracks="localization"), "tracks are 'localization', expected some of"),
        (metric(is_primary=True), "is_primary is true"),
        (metric(values=0.5), "values is no function of scored rows"),
        (metric(counts=True), "counts is no function of scored rows"),
    ],
)
def test_what_is_no_metric_or_says_nothing_of_itself_is_refused_in_one_line(named, value, fault):
    with pytest.raises(MatchError) as refused:
        find_metric(named(value))
    assert str(refused.value).startswith(f"module_of_mine:ONE: {fault}")
    assert "\n" not in str(refused.value)
    assert len(str(refused.value)) < 500


@pytest.mark.parametrize(
    ("names", "fault"),
    [
        (["succes_25m"], "there is no metric 'succes_25m', did you mean 'success_25m'? (list metrics shows all; or"),
        (["success_25m"], "success_25m is on every board: name metrics of your own alone"),
        (["nowhere:ONE"], "nowhere:ONE: cannot be imported (ModuleNotFoundError"),
        (["os:no_such"], "os:no_such: cannot be imported (AttributeError"),
        ([3], "3 is no name of a metric"),
    ],
)
def test_a_name_that_no_board_can_add_is_refused_in_one_line(names, fault):
    with pytest.raises(MatchError) as refused:
        find_metrics(names)
    assert str(refused.value).startswith(fault)


def test_two_metrics_of_one_name_are_refused_and_one_that_is_named_twice_counts_once(tmp_path, monkeypatch):
    files = metric_files("my-metric")
    for module in ("one_metric", "two_metric"):
        (tmp_path / f"{module}.py").write_text(files["src/my_metric/metric.py"])
    monkeypatch.syspath_prepend(tmp_path)
    (found,) = find_metrics(["one_metric:METRIC", "one_metric:METRIC"])
    assert (found.spec, found.metric.name, len(found.sha256)) == ("one_metric:METRIC", "my-metric", 64)
    with pytest.raises(MatchError, match="one_metric:METRIC and two_metric:METRIC are both named 'my-metric'"):
        find_metrics(["one_metric:METRIC", "two_metric:METRIC"])
    (tmp_path / "one_metric.py").write_text(files["src/my_metric/metric.py"].replace("50.0", "60.0"))
    assert find_metrics(["one_metric:METRIC"])[0].sha256 != found.sha256


def values_in_place(rows):
    rows["is_right"] = True
    rows.pop("position_error_m")
    return np.ones(len(rows))


def stop(_):
    raise SystemExit(3)


@pytest.mark.parametrize(
    ("values", "fault"),
    [
        (lambda rows: rows["no_such"], "it fails (KeyError: 'no_such')"),
        (stop, "it fails (SystemExit: 3)"),
        (lambda _: np.ones(3), "its values have shape (3,), expected (4,): one for each row of scores"),
        (lambda rows: np.ones((len(rows), 2)), "its values have shape (4, 2), expected (4,)"),
        (lambda _: 0.5, "its values have shape (), expected (4,)"),
        (lambda _: None, "it returns a NoneType of no numbers"),
        (lambda rows: ["0.5"] * len(rows), "it returns a list of no numbers"),
        (lambda rows: (0.5 for _ in range(len(rows))), "it returns a generator of no numbers"),
        (lambda rows: np.full(len(rows), math.inf), "it says inf, expected a finite number between 0 and 1"),
        (lambda rows: np.full(len(rows), 1.5), "it says 1.5, expected a finite number between 0 and 1"),
        (lambda rows: np.full(len(rows), -0.1), "it says -0.1, expected a finite number between 0 and 1"),
        (lambda rows: pd.Series(near(rows))[::-1], "its values are of other rows, or in another order"),
        (
            lambda rows: np.ma.masked_array(near(rows), near(rows) > 0),
            "it returns a MaskedArray of no numbers as",
        ),
        (lambda rows: [[1.0]] + [[1.0, 2.0]] * (len(rows) - 1), "it returns a list of no numbers as its values"),
        (lambda rows: [10**400] * len(rows), "it returns a list of no numbers as its values"),
        (lambda _: Unarrayed(RuntimeError("two\nlines")), "it returns an Unarrayed of no numbers as its values"),
        (lambda _: Unarrayed(SystemExit(0)), "it returns an Unarrayed of no numbers as its values"),
        (lambda rows: near(rows) * 1j, "it returns a ndarray of no numbers"),
    ],
)
def test_a_metric_that_fails_on_answers_is_named_in_one_line_and_nothing_is_compared(values, fault):
    with pytest.raises(MetricError) as raised:
        with_metrics(foreign(metric(values)), {"mine": scores([0.0, 1.0, 30.0, 99.0])})
    assert str(raised.value).startswith(f"mine:0, on the answers of mine (localization): {fault}")
    assert "\n" not in str(raised.value)


@pytest.mark.parametrize(
    ("counts", "fault"),
    [
        (lambda rows: np.ones(len(rows)), "its counts are of type float64, expected bool"),
        (lambda rows: [1] * len(rows), "its counts are of type int64, expected bool"),
        (lambda rows: (rows["position_error_m"] < 9.0)[::-1], "its counts are of other rows, or in another order"),
        (lambda rows: np.ma.masked_array([True] * len(rows), mask=True), "it returns a MaskedArray of no numbers as"),
        (lambda rows: [True] * (len(rows) - 1), r"its counts have shape \(1,\), expected \(2,\)"),
        (lambda _: Unarrayed(SystemExit(0)), "it returns an Unarrayed of no numbers as its counts"),
    ],
)
def test_a_mask_of_no_bools_or_of_other_rows_is_refused(counts, fault):
    with pytest.raises(MetricError, match=f"^mine:0, on the answers of mine .localization.: {fault}"):
        with_metrics(foreign(metric(counts=counts)), {"mine": scores([0.0, 99.0])})


def test_what_counts_may_not_depend_on_the_answer():
    asked = {"good": scores([0.0, 1.0]), "bad": scores([0.0, 99.0])}
    chosen = metric(lambda rows: np.where(rows["is_right"], 1.0, np.nan))
    with pytest.raises(MetricError, match=r"^mine:0: query q00001 counts for good, and not for bad: what counts may"):
        with_metrics(foreign(chosen), asked)
    asked["bad"]["status"] = "not applicable"  # its card excludes all of it
    frames, _ = with_metrics(foreign(chosen), asked)
    assert frames["bad"]["metric near"].isna().all()


@pytest.mark.parametrize(
    "values", [near, lambda rows: pd.Series(near(rows)), lambda rows: list(near(rows)), lambda rows: rows["is_right"]]
)
def test_its_rows_stand_beside_ours_which_stay_what_they_are_to_the_last_digit(values):
    asked = {"good": scores([0.0, 5.0, 27.5, 40.0]), "bad": scores([27.5, 99.0, math.inf, 12.0])}
    kept = {name: frame.copy() for name, frame in asked.items()}
    plain = leaderboard(asked, draws=100)
    frames, more = with_metrics(foreign(metric(values)), asked)
    whole = leaderboard(frames, draws=100, more=more)
    pd.testing.assert_frame_equal(whole[whole["metric"] != "near"].reset_index(drop=True), plain)
    for name, frame in kept.items():
        pd.testing.assert_frame_equal(asked[name], frame)
    row = whole[(whole["metric"] == "near") & (whole["matcher"] == "good") & (whole["stratum"] == "all")].iloc[0]
    expected = np.asarray(values(asked["good"]), dtype=float).mean()
    assert row["value"] == pytest.approx(expected)
    assert row["lo"] <= row["value"] <= row["hi"]
    assert (row["unit"], row["better"], row["n"]) == ("1", "higher", 4)


def test_a_function_that_writes_into_its_rows_moves_no_figure():
    asked = {"mine": scores([0.0, 99.0])}
    plain = leaderboard(asked, draws=100)
    frames, more = with_metrics(foreign(metric(values_in_place)), asked)
    whole = leaderboard(frames, draws=100, more=more)
    pd.testing.assert_frame_equal(whole[whole["metric"] != "near"].reset_index(drop=True), plain)


def test_queries_that_do_not_count_are_in_no_denominator():
    half = metric(lambda rows: np.where(np.arange(len(rows)) % 2 == 0, near(rows), np.nan))
    frames, more = with_metrics(foreign(half), {"mine": scores([0.0, 99.0, 27.5, 99.0])})
    rows = leaderboard(frames, draws=100, more=more)
    row = rows[(rows["metric"] == "near") & (rows["stratum"] == "all")].iloc[0]
    assert (row["n"], row["value"]) == (2, pytest.approx(0.75))


def writes(rows):
    rows["is_right"] = True
    return near(rows)


def ranks(rows):
    return rows["position_error_m"].rank(pct=True).to_numpy(float)


@pytest.mark.parametrize(
    ("rule", "one"),
    [
        ("the same queries count for every method", metric(lambda rows: np.where(rows["is_right"], 1.0, np.nan))),
        ("the given scores are not changed", metric(writes)),
        ("each query by itself, in any order", metric(ranks)),
        ("no answer is the worst there is", metric(lambda rows: np.where(rows["is_answered"], near(rows), 0.5))),
        ("no answer is the worst there is", metric(lambda rows: rows["is_answered"] * 1.0, better="lower")),
        ("a number, or NaN, for each query", metric(lambda rows: rows["position_error_m"])),
    ],
)  # fmt: skip
def test_a_metric_that_breaks_a_rule_fails_there(named, tmp_path, rule, one):
    rows = list(check_metric(named(one), out=tmp_path))
    assert f"localization: {rule}" in [row.name for row in rows if row.outcome == "fail"]
    assert all("\n" not in row.found for row in rows)


def test_a_metric_that_counts_nothing_in_the_small_town_is_not_said_to_pass(named, tmp_path):
    nothing = metric(lambda rows: np.full(len(rows), np.nan))
    last = list(check_metric(named(nothing), out=tmp_path))[-1]
    assert last.outcome == "not applicable"
    assert "so nothing is checked" in last.found


@pytest.mark.parametrize("name", rest_slow(sorted(MEANS), but=2))
def test_metrics_that_ship_keep_the_rules(tmp_path, name):
    excused = {row.name.partition(": ")[2] for row in check_metric(name, out=tmp_path) if row.outcome != "pass"}
    assert excused <= ({NO_ANSWER} if MEANS[name].read_with else {"a number, or NaN, for each query"})


def test_what_no_answer_does_not_spoil_is_read_with_a_metric_that_it_spoils(named, tmp_path):
    def far(rows):
        return np.where(rows["is_present"], rows["is_answered"] & (rows["position_error_m"] > 50.0), np.nan)

    def found(other):
        one = metric(far, better="lower", read_with=other)
        return next(row for row in check_metric(named(one), out=tmp_path) if row.name.endswith(NO_ANSWER))

    assert (found("").outcome, found("answered").outcome) == ("fail", "not applicable")
    assert "name in read_with the metric that counts it" in found("").found
    assert found("aurc").outcome == "fail"
    assert "expected one of" in found("aurc").found


def test_the_metric_of_the_scaffold_keeps_every_rule(tmp_path, monkeypatch):
    files = metric_files("my-nearness")
    (tmp_path / "my_nearness.py").write_text(files["src/my_nearness/metric.py"])
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", [*sys.path])
    found = list(check_metric("my_nearness:METRIC", out=tmp_path / "out"))
    assert [row for row in found if row.outcome != "pass"] == []
    assert "right 1, 400 m off 0, no answer 0" in [row.found for row in found]
    values = {field.name for field in dataclasses.fields(sgb.MeanMetric)}
    assert {"name", "meaning", "unit", "better", "bounds", "tracks", "values"} <= values


def test_the_metric_of_the_guide_keeps_every_rule(named, tmp_path):
    text = (Path(__file__).parents[2] / "docs" / "howto" / "metric.md").read_text(encoding="utf-8")
    (code,) = re.findall(r"^```python\n(.*?)^```$", text, re.MULTILINE | re.DOTALL)
    made: dict[str, object] = {}
    exec(code, made)  # noqa: S102 - of our own documents
    assert {row.outcome for row in check_metric(named(made["METRIC"]), out=tmp_path)} == {"pass"}


@pytest.mark.parametrize("name", ["success_25m", "rank", "My_Metric", "numpy"])
def test_a_name_that_a_metric_cannot_have_is_refused_before_anything_is_written(name):
    with pytest.raises(ConfigError, match=name):
        metric_files(name)
