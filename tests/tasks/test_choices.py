# SPDX-License-Identifier: Apache-2.0
"""What is chosen on data is chosen on train places of the split `world`: no list names a calibration or test place."""

import hashlib
import tomllib
from pathlib import Path

import pytest

from benchmarks import joint_trials, open_numbers
from sasgeo_bench.regions.region_spec import list_region_files, read_region_file
from sasgeo_bench.tasks.split import find_split_file, read_split_file

ROOT = Path(__file__).parents[2]
WORLD = read_split_file(find_split_file("world"))
TRIALS = read_split_file(find_split_file("trials"))
TRAIN = {region: place.country for place in WORLD.place if place.part == "train" for region in place.region_ids}
LARGE_M2 = 5e6
STORED = tuple(sorted((ROOT / "docs" / "results").glob("joint-trials*.csv")))


def read(pipeline):
    """A pipeline as a table."""
    return tomllib.loads((ROOT / "pipelines" / f"{pipeline}.toml").read_text(encoding="utf-8"))


def asked_by(pipeline):
    """Regions that a pipeline names, in its list or in its tasks."""
    return {*pipeline.get("regions", ()), *(name for task in pipeline["task"] for name in task.get("regions", ()))}


@pytest.mark.parametrize(
    ("what", "regions"),
    [
        ("the split of trials", TRIALS.region_ids),
        ("open numbers", open_numbers.places()),
        ("trials of the scorer", asked_by(read("scorer-trials"))),
        ("the pilot of the fourth experiment", asked_by(read("places-pilot"))),
        ("trials of the joint score", joint_trials.DATED),
        *((path.name, {one.place for one in joint_trials.read_answers(path)}) for path in STORED),
        *(
            (path, open_numbers.read_trials(ROOT / "docs" / "results" / path)[0].right_of)
            for path in ("open-numbers.csv", "scorer-trials.csv")
        ),
    ],
)
def test_no_choice_rests_on_a_place_outside_train(what, regions):
    assert set(regions) <= set(TRAIN), what
    assert set(regions) <= set(TRIALS.region_ids), what


def test_the_pipeline_of_trials_draws_from_their_split_alone():
    assert {read(name)["split"] for name in ("scorer-trials", "places-pilot")} == {"trials"}


def test_places_of_trials_keep_their_names_and_countries_and_are_drawn_by_hash():
    place_of = {region: place for place in WORLD.place for region in place.region_ids}
    for place in TRIALS.place:
        assert {(place_of[name].name, place_of[name].country) for name in place.region_ids} == {
            (place.name, place.country)
        }
    files = list_region_files()
    area_m2 = {}
    for name in TRAIN:
        grid = read_region_file(files[name]).grid()
        area_m2[name] = grid.rows * grid.cols * grid.cell_size_m**2
    for country in set(TRAIN.values()):
        own = [name for name in TRAIN if TRAIN[name] == country]
        small = [name for name in own if area_m2[name] <= LARGE_M2] or [min(own, key=area_m2.__getitem__)]
        drawn = min(small, key=lambda name: hashlib.sha256(f"trials/{name}".encode()).hexdigest())
        assert next(place.region_ids for place in TRIALS.place if place.country == country) == (drawn,)


def test_each_half_is_asked_about_as_many_countries_as_the_other():
    halves = list(open_numbers.places().values())
    assert halves.count("a") == halves.count("b") == 6
