# SPDX-License-Identifier: Apache-2.0
"""Flights and their queries: chosen within one part, one after another; kept as they are on disk and on the wire."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sasgeo_bench.core.errors import ConfigError, PoseError, StoreError
from sasgeo_bench.core.progress import reporting
from sasgeo_bench.regions.region_files import read_region
from sasgeo_bench.tasks import build, flight_sampling, task_files
from sasgeo_bench.tasks.flight_sampling import Airspace, FlightDrawer
from sasgeo_bench.tasks.query import Step, flight_id, view_id
from sasgeo_bench.tasks.split import Place, SplitFile, blocks_of, find_split, make_split
from sasgeo_bench.tasks.state import State
from sasgeo_bench.tasks.suites.all_suites import find_suite
from sasgeo_bench.tasks.suites.base import Choice, Scene, Seeds
from sasgeo_bench.tasks.suites.flights import LOITER_M
from sasgeo_bench.tasks.task_files import (
    QUERY_SCHEMA,
    asked_sha256,
    query_bytes,
    query_from,
    query_of,
    query_row,
    read_queries,
    read_truths,
    write_task,
)
from sasgeo_bench.tasks.task_plan import TaskRequest, plan_requests
from tests.tasks.test_task_files import ABOUT, one_query, one_truth

pytestmark = pytest.mark.usefixtures("small_flight_views")

TOWN = "town-grid"
REACH_M = 144.0

numbers = st.floats(allow_nan=False, allow_infinity=False)
covariances = st.lists(st.floats(-1e3, 1e3), min_size=9, max_size=9).map(
    lambda mixed: tuple((np.reshape(mixed, (3, 3)) @ np.reshape(mixed, (3, 3)).T).ravel().tolist())
)
known_steps = st.builds(
    Step,
    sequence_id=st.text(min_size=1, max_size=18),
    frame=st.integers(1, 2**31 - 1),
    increment=st.tuples(numbers, numbers, numbers),
    covariance=covariances,
)
unknown_steps = st.builds(Step, sequence_id=st.text(min_size=1), frame=st.integers(0, 99))


@pytest.fixture(scope="module")
def airspace(towns) -> Airspace:
    """Where flights of a suite may go over the town; short ones, so that they are drawn in no time."""
    region = read_region(towns / "regions" / TOWN)
    state = State.of(region)
    blocks = blocks_of(TOWN, region.grid)
    over = Scene(map=state, world=state, blocks=blocks, view_reach_m=REACH_M, scenes=region.manifest.scenes)
    suite = find_suite("flight-overconfident")
    seeds = Seeds(root=1, names=(TOWN,))
    return Airspace(
        region=region, scene=over, suite=suite, split=find_split("crossfit"), seeds=seeds, group=suite.card.group
    )


@pytest.fixture
def short(monkeypatch) -> None:
    """Flights of one kilometre alone."""
    monkeypatch.setattr(flight_sampling, "LENGTHS_M", (1000.0,))


def make(out: Path, suite: str = "flight-overconfident", **changes):
    base = {"suites": (suite,), "regions": (TOWN,), "split": "crossfit", "count": 1, "seed": 0, "out": out}
    return [made for request in plan_requests(TaskRequest(**base | changes)) for made in build.make_tasks(request)]


def paths(flights):
    return {index: flight.views.position_m.tolist() for index, flight in flights.items()}


# --- steps ----------------------------------------------------------------------------------------------------------


@given(known_steps | unknown_steps)
def test_a_step_comes_back_from_its_row_and_from_the_wire_as_it_was(step):
    query = one_query(track="sequence", candidates=(), step=step)
    row = query_row(query)
    assert set(row) <= set(QUERY_SCHEMA.names)
    assert query_of(row).step == step
    assert query_from(query_bytes(query)).step == step


def test_tables_of_before_there_were_flights_are_read_and_ask_what_they_asked(tmp_path):
    """Their columns for flights are all null."""
    folders = [tmp_path / name for name in ("task", "truth")]
    for folder in folders:
        folder.mkdir()
    write_task(*folders, [(one_query(), one_truth())], ABOUT)
    assert [query.step for query in read_queries(folders[0])] == [None]
    row = query_row(one_query())
    nulls = dict.fromkeys(("sequence_id", "frame", "increment", "increment_covariance"))
    assert asked_sha256(row, {}) == asked_sha256(row | nulls, {})
    flight = query_row(one_query(step=Step(sequence_id="f", frame=0)))
    assert asked_sha256(row, {}) != asked_sha256(flight, {})


@pytest.mark.parametrize(
    "changes",
    [
        {"frame": -1},
        {"increment": (0.0, 50.0, 0.0)},
        {"covariance": (1.0,) * 9},
        {"increment": (0.0, 50.0), "covariance": (1.0,) * 9},
        {"increment": (0.0, 50.0, 0.0), "covariance": (1.0,) * 3},
        {"increment": (0.0, np.nan, 0.0), "covariance": (1.0,) * 9},
        {"increment": (0.0, 50.0, 0.0), "covariance": (np.inf,) * 9},
        {"increment": (0.0, 50.0, 0.0), "covariance": (1.0,) * 9, "frame": 0},
    ],
)
def test_a_step_that_is_not_whole_is_refused_with_what_was_given(changes):
    with pytest.raises(PoseError, match="a step has a frame from 0 on and, after the first, 3 finite numbers") as error:
        Step(**{"sequence_id": "f1", "frame": 1} | changes)
    assert "sequence_id='f1'" in str(error.value)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    "covariance",
    [
        pytest.param((-1.0, 0, 0, 0, 1.0, 0, 0, 0, 1.0), id="negative"),
        pytest.param((1.0, 0.5, 0, 0, 1.0, 0, 0, 0, 1.0), id="not symmetric"),
    ],
)
def test_a_covariance_that_is_none_is_refused(covariance):
    with pytest.raises(PoseError, match="a covariance is symmetric and positive semidefinite"):
        Step(sequence_id="f1", frame=1, increment=(0.0, 50.0, 0.0), covariance=covariance)


@pytest.mark.parametrize("column", ["frame", "increment_covariance"])
def test_a_row_that_lacks_a_part_of_its_step_is_named_as_damaged(tmp_path, monkeypatch, column):
    folders = [tmp_path / name for name in ("task", "truth")]
    for folder in folders:
        folder.mkdir()
    step = Step(sequence_id="f", frame=1, increment=(0.0, 50.0, 0.0), covariance=(1.0,) * 9)
    monkeypatch.setattr(task_files, "query_row", lambda query: query_row(query) | {column: None})
    write_task(*folders, [(one_query(step=step), one_truth())], ABOUT)
    with pytest.raises(StoreError, match=r"queries\.parquet"):
        list(read_queries(folders[0]))


def test_ids_of_views_sort_by_flight_then_by_time():
    ids = [view_id(flight, frame) for flight in ("0a", "0b") for frame in (0, 1, 10, 255, 256)]
    assert sorted(ids) == ids
    assert {flight_id(item) for item in ids} == {"0a", "0b"}


# --- choice of flights ----------------------------------------------------------------------------------------------


@pytest.mark.usefixtures("short")
def test_more_sites_add_flights_and_change_none(airspace):
    few, many = (airspace.choose(count=count, may_be_fewer=False) for count in (2, 5))
    assert list(many) == [0, 1, 2, 3, 4]
    assert paths(few) == {index: path for index, path in paths(many).items() if index < 2}
    assert [few[index].site for index in few] == [many[index].site for index in few]


@pytest.mark.usefixtures("short")
def test_another_seed_flies_elsewhere_and_spacings_differ(airspace):
    one = airspace.choose(count=2, may_be_fewer=False)
    other = replace(airspace, seeds=replace(airspace.seeds, root=2)).choose(count=2, may_be_fewer=False)
    spacings_m = {flight.spacing_m for flights in (one, other) for flight in flights.values()}
    assert len(spacings_m) == 4
    assert paths(one) != paths(other)


def test_all_that_the_views_of_a_flight_may_show_is_mapped_and_the_longest_flight_is_taken(airspace):
    (flight,) = airspace.choose(count=1, may_be_fewer=False).values()
    assert 3900 < flight.length_m < 4000
    west, south, east, north = airspace.region.grid.bounds_m
    for east_m, north_m in flight.views.position_m[:, :2]:
        assert west + REACH_M < east_m < east - REACH_M
        assert south + REACH_M < north_m < north - REACH_M


def test_a_loiter_makes_few_laps_where_other_kinds_fly_far(airspace, monkeypatch):
    kinds = {}
    for kind in ("loiter", "waypoints"):
        monkeypatch.setattr(flight_sampling, "KINDS", (kind,))
        kinds[kind] = airspace.choose(count=1, may_be_fewer=False)[0].length_m
    assert kinds["loiter"] <= LOITER_M < kinds["waypoints"]


@pytest.mark.usefixtures("short")
def test_no_flight_passes_from_one_part_of_a_split_to_another(airspace):
    names = {part: [block.id for block in airspace.scene.blocks if block.row == row] for row, part in enumerate("ab")}
    parts = {"a": "train", "b": "test"}
    places = [Place(name=name, blocks=blocks, part=parts[name]) for name, blocks in names.items()]
    spec = SplitFile(id="two", title="Two", kind="holdout", buffer_m=0.0, reach_m=0.0, place=places)
    split = make_split(spec, {TOWN: airspace.region.grid})
    halved = replace(airspace, split=split)
    flights = halved.choose(count=4, may_be_fewer=True)
    assert flights
    assert paths(flights) != {index: paths(airspace.choose(count=4, may_be_fewer=True))[index] for index in flights}
    for flight in flights.values():
        places = flight.views.position_m[:, :2]
        at = [block for block in airspace.scene.blocks for place in places if block.holds(place)]
        assert len(at) == len(flight.views)
        assert len({split.place_of[block.id] for block in at}) == 1
        assert flight.site.block in {block.id for block in at}


@pytest.mark.slow
@pytest.mark.usefixtures("short")
def test_too_little_ground_or_too_little_on_it_gets_one_line(airspace):
    empty = replace(airspace, scene=replace(airspace.scene, blocks=()))
    with pytest.raises(ConfigError, match=r"town-grid has room for 0 of 2 flights .* too little is mapped or drawn$"):
        empty.choose(count=2, may_be_fewer=True)
    card = replace(airspace.suite.card, min_density=0.99)
    bare = replace(airspace, suite=replace(airspace.suite, card=card))
    with pytest.raises(ConfigError, match="has room for 0 of 1 flights"):
        bare.choose(count=1, may_be_fewer=False)


def test_a_gap_that_is_too_long_is_left_out_and_where_none_fits_its_control_too(airspace, monkeypatch):
    suite = find_suite("flight-gap")
    left = {}
    for length_m in (1000.0, 2000.0):
        monkeypatch.setattr(flight_sampling, "LENGTHS_M", (length_m,))
        over = replace(airspace, suite=suite)
        flights = over.choose(count=1, may_be_fewer=False)
        drawer = FlightDrawer(airspace=over, flights=flights)
        jobs = drawer.jobs([flight.site for flight in flights.values()])
        left[length_m] = {(job.variant.role, job.variant.strength) for job in jobs if drawer.why_not(job) is None}
    assert left == {1000.0: set(), 2000.0: {("control", 0.0), ("stress", 500.0), ("falsifier", 0.0)}}


def test_a_drone_that_cannot_be_carried_so_far_is_left_out_with_its_control(airspace, monkeypatch):
    monkeypatch.setattr(flight_sampling, "LENGTHS_M", (1000.0,))
    suite = find_suite("flight-kidnap")
    far = tuple(replace(item, strength=5000.0) if item.role == "stress" else item for item in suite.variants)
    over = replace(airspace, suite=replace(suite, variants=far))
    flights = over.choose(count=1, may_be_fewer=False)
    drawer = FlightDrawer(airspace=over, flights=flights)
    reasons = {drawer.why_not(job) for job in drawer.jobs([flight.site for flight in flights.values()])}
    assert reasons == {"no flight ends 5000 m from its middle"}
    chosen = replace(drawer, choice=Choice(kinds=("none of these",)))
    assert {chosen.why_not(job) for job in chosen.jobs([flights[0].site])} == {None}


# --- tasks on disk --------------------------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.usefixtures("short")
def test_the_same_request_makes_the_same_bytes_and_more_sites_change_none_of_the_queries(own_out):
    found = []
    for count in (1, 1, 2):
        (made,) = make(own_out, count=count)
        truths = own_out / "truth" / made.folder.relative_to(own_out / "tasks")
        files = (made.folder / task_files.QUERIES, made.folder / task_files.TASK, truths / task_files.TRUTH)
        found.append([path.read_bytes() for path in files])
        if count == 1:
            first = {query.query_id: query_bytes(query) for query in read_queries(made.folder)}
    assert found[0] == found[1]
    more = {query.query_id: query_bytes(query) for query in read_queries(made.folder)}
    assert first == {name: more[name] for name in first}
    assert len(more) > len(first)
    assert build.check_task(made) == []
    ids = [query.query_id for query in read_queries(made.folder)]
    assert ids == sorted(ids) == [truth.query_id for truth in read_truths(truths)]


def test_where_no_flight_fits_the_request_gets_one_line_and_writes_nothing(own_out, monkeypatch):
    monkeypatch.setattr(flight_sampling, "LENGTHS_M", (10_000.0,))
    with pytest.raises(ConfigError, match="town-grid has room for 0 of 1 flights of suite 'flight-overconfident'"):
        make(own_out)
    assert not (own_out / "tasks").exists()
    assert not (own_out / "truth").exists()


@pytest.mark.usefixtures("short")
def test_flights_that_are_left_out_are_counted_and_a_task_without_any_is_refused(own_out):
    lines: list[str] = []
    refused = pytest.raises(ConfigError, match="too small or too empty for suite 'flight-gap': a gap is a third")
    with reporting(lines.append), refused:
        make(own_out, "flight-gap")
    assert "flight-gap on town-grid: 4 flights left out, a gap is a third of its flight at most" in lines
    assert not (own_out / "tasks").exists()


@pytest.mark.usefixtures("short")
def test_a_failure_in_the_middle_of_a_flight_leaves_the_old_task_whole(own_out, monkeypatch):
    (made,) = make(own_out)
    before = {path.name: path.read_bytes() for path in made.folder.iterdir() if path.is_file()}
    monkeypatch.setattr("sasgeo_bench.tasks.flight_sampling._no_prior", lambda _: 1 / 0)
    with pytest.raises(ZeroDivisionError):
        make(own_out, seed=1)
    assert {path.name: path.read_bytes() for path in made.folder.iterdir() if path.is_file()} == before


@pytest.mark.usefixtures("short")
def test_flights_drawn_together_are_those_drawn_one_by_one(airspace):
    space = replace(airspace, suite=find_suite("flight-clean"))
    flights = space.choose(count=1, may_be_fewer=False)
    drawer = FlightDrawer.of(space, flights, Choice())
    jobs = drawer.jobs([flight.site for flight in flights.values()])
    together = list(drawer.drawn(jobs))
    alone = [pair for job in jobs for pair in FlightDrawer.of(space, flights, Choice()).drawn([job])]
    assert len({query.evidence.cells.tobytes() for query, _ in together}) < len(together)
    for (query, truth), (first, its_truth) in zip(together, alone, strict=True):
        assert query_bytes(query) == query_bytes(first)
        assert truth == its_truth
