# SPDX-License-Identifier: Apache-2.0
"""Maps that know of few classes: what is of another class is unknown, in views, suites, wrong places and answers."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from sasgeo_bench.geometry.pose import Pose
from sasgeo_bench.matching.controls.fft_vote import FftVote
from sasgeo_bench.regions.evidence import UNKNOWN, LayerBits
from sasgeo_bench.regions.region_files import read_region
from sasgeo_bench.regions.region_spec import list_region_files, read_region_file
from sasgeo_bench.sasgeo.variants import Sasgeo
from sasgeo_bench.tasks.build import make_tasks
from sasgeo_bench.tasks.split import SplitFile, find_split_file, make_split, read_split_file
from sasgeo_bench.tasks.state import State
from sasgeo_bench.tasks.suites.all_suites import SUITES, find_suite
from sasgeo_bench.tasks.suites.base import Scene, no_larger
from sasgeo_bench.tasks.task_files import read_queries, read_task, read_truths
from sasgeo_bench.tasks.task_plan import Request, wrong_place
from tests.regions.imagery_place import make_hamlet

HOUSES = ("building",)


@pytest.fixture(scope="module")
def asked(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Root with the clean and absent queries of a place whose map knows of buildings alone."""
    hamlet, out = make_hamlet(tmp_path_factory.mktemp("hamlet")), tmp_path_factory.mktemp("out")
    town = read_region_file(list_region_files()["town-suburb"]).model_copy(update={"size_m": (640.0, 640.0)})
    places = [
        {"name": "hamlet", "half": "a", "regions": ["hamlet"]},
        {"name": "b", "half": "a", "regions": ["town-grid"]},
    ]
    places += [{"name": name, "half": "b", "regions": [name]} for name in ("town-suburb", "town-riverside")]
    spec = SplitFile(id="own", title="own", kind="crossfit", buffer_m=100.0, place=places)
    known = {name: read_region_file(path) for name, path in list_region_files().items()}
    known |= {"hamlet": hamlet.spec(), "town-suburb": town}
    split = make_split(spec, {name: item.grid() for name, item in known.items()})
    bare = hamlet.spec().model_copy(update={"imagery": []})
    for suite in ("clean", "absent"):
        request = Request(
            suite=suite,
            region=bare,
            split=split,
            elsewhere=town,
            count=2,
            seed=0,
            out=out,
            extract_folders=(hamlet.folder,),
            may_be_fewer=True,
        )
        make_tasks(request)
    return out


def test_the_map_and_every_view_know_of_buildings_alone(asked):
    assert read_region(asked / "regions" / "hamlet").classes == HOUSES
    queries = [query for suite in ("clean", "absent") for query in read_queries(asked / "tasks" / suite / "hamlet")]
    assert {query.evidence.classes for query in queries} == {HOUSES}


def test_views_of_a_wrong_place_do_not_give_themselves_away_by_their_classes(asked):
    truths = {truth.query_id: truth for truth in read_truths(asked / "truth" / "absent" / "hamlet")}
    wrong = [
        query
        for query in read_queries(asked / "tasks" / "absent" / "hamlet")
        if truths[query.query_id].kind == "wrong place"
    ]
    assert wrong
    assert all(query.evidence.classes == HOUSES and (query.evidence.cells == 1).any() for query in wrong)


def test_large_views_shrink_to_what_the_mapped_ground_holds(asked):
    about = read_task(asked / "tasks" / "clean" / "hamlet")
    assert about["views_cells"] == [96]
    roles = {truth.role for truth in read_truths(asked / "truth" / "clean" / "hamlet")}
    assert roles == {"control", "stress", "falsifier"}


@pytest.mark.parametrize("matcher", [FftVote, Sasgeo])
def test_a_matcher_finds_a_view_of_buildings(matcher, asked):
    solver = matcher()
    solver.prepare(read_region(asked / "regions" / "hamlet"), None)
    truths = {truth.query_id: truth for truth in read_truths(asked / "truth" / "clean" / "hamlet")}
    queries = [
        query
        for query in read_queries(asked / "tasks" / "clean" / "hamlet")
        if truths[query.query_id].role == "falsifier" and query.track == "localization"
    ]
    errors_m = []
    for query in queries[:2]:
        best, pose = solver.match(query, top_k=3).poses[0], truths[query.query_id].pose
        errors_m.append(np.hypot(best.easting_m - pose.easting_m, best.northing_m - pose.northing_m))
    assert min(errors_m) < 5


@pytest.mark.parametrize("name", SUITES)
def test_variants_shrink_and_each_is_drawn_once(name):
    variants = find_suite(name).variants
    assert no_larger(variants, None) == variants
    small = no_larger(variants, 96.0)
    assert len(set(small)) == len(small)
    assert max(item.side_m for item in small) <= 96.0 or min(item.view_cells for item in variants) > 96
    assert {(item.role, item.kind, item.strength) for item in small} == {
        (item.role, item.kind, item.strength) for item in variants
    }


def test_a_state_of_some_classes_shows_what_the_whole_shows_of_them(tiny):
    state = State.of(tiny.region)
    layers = np.array(tiny.region.layers)
    layers[:, :40] = 255
    state = replace(state, bits=LayerBits.of(layers))
    names = ("water", "building")
    part = state.of_classes(names)
    west, _, _, north = tiny.region.grid.bounds_m
    pose = Pose(easting_m=west + 300, northing_m=north - 60, yaw_deg=30.0)
    whole, some = (one.view(pose, size_cells=96, cell_size_m=1.0) for one in (state, part))
    assert some.classes == names
    assert (some.cells == UNKNOWN).any()
    for name in names:
        np.testing.assert_array_equal(some.layer(name), whole.layer(name))
    assert state.of_classes(state.classes) is state


def test_no_season_changes_a_map_of_buildings_and_others_change_what_is_there(tiny):
    suite, state = find_suite("season"), State.of(tiny.region)

    def scene(*names: str) -> Scene:
        part = state.of_classes(names)
        return Scene(map=part, world=part, blocks=(), view_reach_m=1.0, scenes=())

    assert suite.lack(scene("building")) == "no season changes any class that its map knows of"
    assert suite.lack(scene("building", "path_track")) is None
    kinds = {item.kind for item in suite.usable(scene("building", "path_track")) if item.role == "stress"}
    assert kinds == {"snow"}


def test_a_wrong_place_knows_of_all_that_the_map_knows_of():
    known = {name: read_region_file(path) for name, path in list_region_files().items()}
    split = make_split(read_split_file(find_split_file("imagery")), {name: one.grid() for name, one in known.items()})
    other = wrong_place(split, known["zanzibar"], known)
    assert set(known["zanzibar"].class_names) <= set(other.class_names)
    assert other.id != "banepa"  # sealed
    for town in ("town-suburb", "town-agricultural"):
        assert wrong_place(split, known[town], known).class_names == known[town].class_names
