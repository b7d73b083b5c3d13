# SPDX-License-Identifier: Apache-2.0
"""A strip shows pictures with their evidence and answers: half of them failures, as far as there are."""

from types import SimpleNamespace

import numpy as np
import pandas as pd
import pytest
from matplotlib.axes import Axes

from sasgeo_bench.boards import strip_plot
from sasgeo_bench.boards.cases import CasePicture, MapPart
from sasgeo_bench.boards.strip_plot import Strip, best_on_pictures, pictured_tasks, strip_of, strip_pixels
from sasgeo_bench.core.errors import ConfigError
from sasgeo_bench.geometry.pose import Pose
from sasgeo_bench.regions.evidence import Evidence
from sasgeo_bench.tasks.query import TRUTH_SIGMA
from sasgeo_bench.tasks.segmented import NOTHING, Segmented

PLACE = Pose(easting_m=50.0, northing_m=50.0, yaw_deg=30.0)


def case(answer=PLACE, what="P1 height, strength 320 (m above ground)", **more):
    view = Evidence(classes=("building",), cells=np.ones((1, 8, 8), dtype=np.uint8), cell_size_m=5.0)
    part = MapPart(colours=np.ones((20, 20, 3)), west_m=0.0, south_m=0.0, east_m=100.0, north_m=100.0)
    return CasePicture(
        title="",
        view=view,
        part=part,
        true=PLACE,
        is_present=True,
        modes=() if answer is None else ((answer, 1.0),),
        at_true=view,
        at_answer=None if answer is None else view,
        disc=None,
        lines=(),
        attribution="(c) OpenStreetMap contributors, ODbL",
        what=what,
        picture=np.full((16, 16, 3), 90, dtype=np.uint8),
        region="town-grid",
        **more,
    )


def cases(rights, suites=None):
    """A run of queries that are right or wrong, by the order of their ids."""
    rows = pd.DataFrame({"is_right": rights})
    names = suites or ["aerial+good"] * len(rights)
    rows = rows.assign(query_id=[f"q{at:02}" for at in range(len(rows))], region="town", suite=names, role="stress")
    rows = rows.assign(yaw_error_deg=0.0, detector="rendered", strength_unit="m")
    tasks = {
        (name, "town"): SimpleNamespace(
            manifest=SimpleNamespace(frames=3 if "+" in name else None, is_of_flights=False)
        )
        for name in set(names)
    }
    return SimpleNamespace(scores=rows.assign(is_present=True), tasks=tasks, run="out/runs/good")


@pytest.mark.parametrize(
    ("rights", "count", "chosen"),
    [
        ([True, False, True, False, True, False], 4, ["q00", "q02", "q01", "q03"]),
        ([True, True, False, True], 4, ["q00", "q01", "q03", "q02"]),
        ([False, False, False, True], 3, ["q03", "q00", "q01"]),
        ([True], 6, ["q00"]),
    ],
)
def test_half_of_a_strip_are_failures_as_far_as_there_are(monkeypatch, rights, count, chosen):
    monkeypatch.setattr(strip_plot, "picture_of", lambda _, name: (name, name))
    strip, rows = strip_of(cases(rights), count)
    assert list(strip.query_ids) == rows == chosen
    assert (strip.found, strip.total) == (sum(rights), len(rights))


def test_ten_queries_are_five_failures_of_all_regions_in_turn_whatever_the_order_of_the_rows():
    rights = [at % 3 == 0 for at in range(60)]
    scores = cases(rights).scores.assign(region=[f"town-{at // 20}" for at in range(60)])
    tasks = {("aerial+good", f"town-{at}") for at in range(3)}
    strip = Strip.of(scores, tasks, 10)
    assert strip == Strip.of(scores.sample(frac=1, random_state=3), tasks, 10)
    chosen = scores.set_index("query_id").loc[list(strip.query_ids)]
    assert chosen["is_right"].tolist() == [True] * 5 + [False] * 5
    assert chosen["region"].tolist()[5:] == ["town-0", "town-1", "town-2", "town-0", "town-1"]
    assert strip.facts.startswith("The pose is found (within 25 m and 5 deg) in 20 of 60 queries")


def test_a_place_with_a_wrong_heading_is_a_failure():
    scores = cases([True, True]).scores.assign(yaw_error_deg=[4.0, 6.0])
    assert Strip.of(scores, {("aerial+good", "town")}, 2).query_ids == ("q00", "q01")
    turned = [Pose(easting_m=50.0, northing_m=50.0, yaw_deg=30.0 - by_deg) for by_deg in (4.0, 6.0)]
    assert [case(answer).is_found for answer in turned] == [True, False]


def test_an_own_picture_whose_file_states_another_heading_is_no_fault_of_the_matcher(monkeypatch):
    scores = cases([True, True, False]).scores.assign(yaw_error_deg=[4.0, 6.0, 6.0], role="control")
    assert "the place" not in Strip.of(scores, {("aerial+good", "town")}, 3).facts
    own = Strip.of(scores.assign(strength_unit=TRUTH_SIGMA), {("aerial+good", "town")}, 3)
    assert "in 1 of 3 queries (in 1 more the place, with another heading than the file states);" in own.facts
    assert "stress" not in own.facts
    said = []
    monkeypatch.setattr(Axes, "set_xlabel", lambda _, text, **words: said.append((text, words.get("color"))))
    far = Pose(easting_m=80.0, northing_m=90.0, yaw_deg=30.0)
    turned = Pose(easting_m=50.0, northing_m=52.0, yaw_deg=36.0)
    rows = [case(turned), case(turned, is_own=True), case(far, is_own=True), case(is_own=True)]
    strip_pixels(own, rows, title="mine")
    verdicts = [one for one in said if "off" in one[0]]
    assert [text for text, _ in verdicts] == [
        "MISSED: 2 m and 6 deg off",
        "PLACE FOUND: 2 m and 6 deg off",
        "MISSED: 50 m and 0 deg off",
        "FOUND: 0 m and 0 deg off",
    ]
    assert len({colour for _, colour in verdicts}) == 3


def test_the_strip_of_a_board_is_of_the_matcher_that_finds_most_and_never_of_a_control():
    scores = {name: cases(rights).scores for name, rights in (("a", [True, False]), ("b", [True, True]))}
    known = {("aerial+good", "town")}
    assert best_on_pictures(scores | {"oracle_pose": cases([True] * 3).scores}, known) == "b"
    assert best_on_pictures({"b": scores["a"], "a": scores["a"]}, known) == "a"
    assert best_on_pictures(scores, {("aerial+good", "elsewhere")}) is None


def test_queries_without_pictures_are_left_out_and_a_run_of_these_alone_is_refused(monkeypatch):
    monkeypatch.setattr(strip_plot, "picture_of", lambda _, name: (name, name))
    assert strip_of(cases([True, True], ["clean", "aerial+good"]), 2)[1] == ["q01"]
    with pytest.raises(ConfigError, match="no answers to queries with pictures"):
        strip_of(cases([True], ["clean"]), 2)


def test_a_strip_is_drawn_alike_twice_and_tells_the_distance():
    far = Pose(easting_m=80.0, northing_m=90.0, yaw_deg=0.0)
    assert (case(far).error_m, case(None).error_m) == (50.0, None)
    seen = Segmented(drawn=np.full((8, 8), NOTHING, dtype=np.uint8))
    rows = [case(segmented=seen), case(far), case(None)]
    strip = Strip(found=1, total=3, query_ids=("a", "b", "c"))
    first, again = (strip_pixels(strip, rows, title="raster on aerial") for _ in range(2))
    np.testing.assert_array_equal(first, again)
    assert first.shape[0] > 3 * 190
    assert (strip_pixels(strip, rows[:1], title="raster on aerial").shape[0]) < first.shape[0] / 2


def test_views_of_a_model_of_perception_have_no_picture_and_count_nowhere():
    scores = cases([True, True, False]).scores.assign(detector=["rendered", "published", "measured"])
    strip = Strip.of(scores, {("aerial+good", "town")}, 3)
    assert (strip.found, strip.total, strip.query_ids) == (1, 1, ("q00",))


def test_a_control_that_is_told_the_answer_is_shown_only_where_there_is_nothing_else():
    both = cases([True, False], ["aerial+good", "aerial+oracle_segmenter"])
    alone = cases([True], ["aerial+oracle_segmenter"])
    assert pictured_tasks(both) == (("aerial+good", "town"),)
    assert pictured_tasks(alone) == (("aerial+oracle_segmenter", "town"),)
