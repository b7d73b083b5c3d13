# SPDX-License-Identifier: Apache-2.0
"""A strip shows pictures with their evidence and answers: half of them failures, as far as there are."""

from types import SimpleNamespace

import numpy as np
import pandas as pd
import pytest

from sasgeo_bench.errors import ConfigError
from sasgeo_bench.geometry.pose import Pose
from sasgeo_bench.leaderboard import strip_plot
from sasgeo_bench.leaderboard.case_plot import CasePicture, MapPart
from sasgeo_bench.leaderboard.strip_plot import strip_of, strip_pixels
from sasgeo_bench.regions.evidence import Evidence

PLACE = Pose(easting_m=50.0, northing_m=50.0, yaw_deg=30.0)


def case(answer=PLACE, what="P1 height, strength 320 (m above ground)"):
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
    )


def cases(rights, suites=None):
    """A run of queries that are right or wrong, by the order of their ids."""
    rows = pd.DataFrame({"is_right": rights})
    names = suites or ["aerial+good"] * len(rights)
    rows = rows.assign(query_id=[f"q{at:02}" for at in range(len(rows))], region="town", suite=names, role="stress")
    tasks = {(name, "town"): SimpleNamespace(about={"frames": 3} if "+" in name else {}) for name in set(names)}
    return SimpleNamespace(scores=rows.assign(is_present=True), tasks=tasks, run="out/runs/good")


@pytest.mark.parametrize(
    ("rights", "count", "chosen"),
    [
        ([True, False, True, False, True, False], 4, ["q01", "q03", "q00", "q02"]),
        ([True, True, False, True], 4, ["q02", "q00", "q01", "q03"]),
        ([False, False, False, True], 3, ["q00", "q01", "q03"]),
        ([True], 6, ["q00"]),
    ],
)
def test_half_of_a_strip_are_failures_as_far_as_there_are(monkeypatch, rights, count, chosen):
    monkeypatch.setattr(strip_plot, "picture_of", lambda _, name: (name, name))
    assert strip_of(cases(rights), count) == chosen


def test_queries_without_pictures_are_left_out_and_a_run_of_these_alone_is_refused(monkeypatch):
    monkeypatch.setattr(strip_plot, "picture_of", lambda _, name: (name, name))
    assert strip_of(cases([True, True], ["clean", "aerial+good"]), 2) == ["q01"]
    with pytest.raises(ConfigError, match="no answers to queries with pictures"):
        strip_of(cases([True], ["clean"]), 2)


def test_a_strip_is_drawn_alike_twice_and_tells_the_distance():
    far = Pose(easting_m=80.0, northing_m=90.0, yaw_deg=0.0)
    assert (case(far).error_m, case(None).error_m) == (50.0, None)
    rows = [case(), case(far), case(None)]
    first, again = (strip_pixels(rows, title="raster on aerial") for _ in range(2))
    np.testing.assert_array_equal(first, again)
    assert first.shape[0] > 3 * 190
    assert (strip_pixels(rows[:1], title="raster on aerial").shape[0]) < first.shape[0] / 2
