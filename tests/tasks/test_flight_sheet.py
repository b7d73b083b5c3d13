# SPDX-License-Identifier: Apache-2.0
"""Maps of flights: each variant of a site, the true path, and where the odometer alone would lead."""

import json
import shutil
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pyarrow.parquet as pq
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from PIL import Image

from sasgeo_bench.core.errors import ConfigError, StoreError
from sasgeo_bench.geometry.pose import reckon, wrap_deg
from sasgeo_bench.regions.region import ATTRIBUTION
from sasgeo_bench.tasks import flight_sampling
from sasgeo_bench.tasks.build import make_tasks
from sasgeo_bench.tasks.query import SEQUENCE_DIGITS, flight_id
from sasgeo_bench.tasks.sheet import flight_panels, write_flight_sheet
from sasgeo_bench.tasks.task_files import Task, read_queries
from sasgeo_bench.tasks.task_plan import TaskRequest, plan_requests

NAME = "flight-kidnap/town-grid"


@pytest.fixture(scope="module")
def made(towns, tmp_path_factory) -> Path:
    """A root with short flights of two sites; read it, do not write to it."""
    out = Path(shutil.copytree(towns, tmp_path_factory.mktemp("flights") / "out"))
    wanted = TaskRequest(suites=("flight-kidnap",), regions=("town-grid",), split="crossfit", count=2, seed=0, out=out)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(flight_sampling, "LENGTHS_M", (1000.0,))
        for request in plan_requests(wanted):
            make_tasks(request)
    return out


def panels_of(out: Path, **options):
    return flight_panels(Task.open(out / "tasks" / NAME), **options)


@given(
    arrays(np.float64, (7, 2), elements=st.floats(-1e4, 1e4)),
    arrays(np.float64, 7, elements=st.floats(0, 359)),
)
def test_an_odometer_without_errors_leads_along_the_true_path(place_m, yaw_deg):
    moved = (np.diff(place_m[:, 0]) + 1j * np.diff(place_m[:, 1])) * np.exp(1j * np.radians(yaw_deg[:-1]))
    increments = np.column_stack([moved.real, moved.imag, wrap_deg(np.diff(yaw_deg))])
    np.testing.assert_allclose(reckon(place_m[0], yaw_deg[0], increments), place_m, atol=1e-6)


def test_an_odometer_that_is_lost_stays_where_it_is():
    increments = np.array([[0.0, 10.0, 0.0], [np.nan] * 3, [0.0, 10.0, 0.0]])
    assert reckon(np.zeros(2), 0.0, increments).tolist() == [[0, 0], [0, 10], [0, 10], [0, 20]]


def test_panels_are_whole_sites_and_the_control_comes_first(made):
    few, many = panels_of(made, count=1), panels_of(made, count=12)
    assert [panel.flight for panel in many[: len(few)]] == [panel.flight for panel in few]
    assert len({panel.truth.pair_id for panel in few}) == 1
    assert len({panel.truth.pair_id for panel in many}) == 2
    assert [panel.truth.role for panel in few] == ["control", "stress", "stress", "falsifier"]


def test_a_panel_says_where_the_odometer_was_lost_and_the_drone_carried(made):
    control, lost, unaware, falsifier = panels_of(made, count=1)
    middle = len(control.place_m) // 2
    assert [panel.lost.tolist() for panel in (control, lost, unaware, falsifier)] == [[], [middle], [], [middle]]
    assert [panel.carried_to for panel in (control, lost, unaware, falsifier)] == [None, middle, middle, None]
    off_m = [np.hypot(*(panel.reckoned_m - panel.place_m).T) for panel in (control, lost)]
    assert off_m[0].max() < 100
    assert off_m[1][:middle].max() < 100
    assert off_m[1][middle] > 700


def test_a_flight_is_found_by_the_beginning_of_its_id_and_a_wrong_one_gets_a_line(made):
    first = panels_of(made, count=1)[0].flight
    assert [panel.flight for panel in panels_of(made, flight=first[:8])] == [first]
    with pytest.raises(ConfigError, match="holds no flight 'zz': it has 8 flights, as "):
        panels_of(made, flight="zz")


@pytest.mark.slow
def test_a_sheet_is_a_picture_with_attribution_and_a_row_for_each_site(made, tmp_path):
    task, path = Task.open(made / "tasks" / NAME), tmp_path / "sheet.png"
    assert task.manifest.is_of_flights
    sizes = {}
    for count in (1, 12):
        shown = panels_of(made, count=count)
        write_flight_sheet(path, task, shown)
        with Image.open(path) as picture:
            assert picture.text["Copyright"] == ATTRIBUTION
        sizes[count] = cv2.imread(str(path)).shape
    assert sizes[1][1] == sizes[12][1]
    assert sizes[12][0] > 1.5 * sizes[1][0]


def test_truths_of_other_flights_and_a_map_built_anew_are_refused(made, tmp_path):
    out = Path(shutil.copytree(made, tmp_path / "out"))
    shown, task = panels_of(out, count=1), Task.open(out / "tasks" / NAME)
    other = replace(task, manifest=task.manifest.model_copy(update={"map_fingerprint": "0"}))
    with pytest.raises(StoreError, match="built anew since"):
        write_flight_sheet(tmp_path / "a.png", other, shown)
    truths = out / "truth" / NAME / "truth.parquet"
    pq.write_table(pq.read_table(truths).slice(1), truths)
    with pytest.raises(StoreError, match="does not hold the truths of"):
        panels_of(out, count=12)


@pytest.mark.slow
def test_inspect_draws_flights_one_flight_or_the_sheet_of_one_view(made, program, mistake, tmp_path):
    out = Path(shutil.copytree(made, tmp_path / "out"))
    view = next(read_queries(out / "tasks" / NAME)).query_id
    assert len(flight_id(view)) == SEQUENCE_DIGITS
    sheets = {}
    for query in (None, flight_id(view), view):
        code, printed, err = program("inspect", NAME, "--out", out, *(("--query", query) if query else ()))
        assert (code, err) == (0, "")
        path = Path(printed.splitlines()[-1].removeprefix("contact sheet: "))
        sheets[query] = cv2.imread(str(path)).shape[:2]
    assert sheets[None][1] > sheets[flight_id(view)][1]
    assert sheets[view] != sheets[flight_id(view)]
    assert "holds no flight 'zz'" in mistake("inspect", NAME, "--out", out, "--query", "zz")
    assert "holds no query" in mistake("inspect", NAME, "--out", out, "--query", "z" * 24)
    assert json.loads((out / "tasks" / NAME / "task.json").read_text())["counts"].keys() == {"sequence"}
