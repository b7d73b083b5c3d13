# SPDX-License-Identifier: Apache-2.0
"""`weights` as a user meets it."""

import json

import pytest
from matplotlib import image

from sasgeo_bench.osm.taxonomy import load_taxonomy
from sasgeo_bench.sasgeo.scorer_model import ScorerModel as Learnt

TOWN = "town-riverside"


@pytest.fixture
def learnt_file(tmp_path):
    path = tmp_path / "learnt.json"
    path.write_text(Learnt.by_hand(load_taxonomy().names).to_text())
    return path


def test_without_a_region_a_table_by_hand_is_printed(program):
    code, out, _ = program("weights", "--age", "0", "--age", "20")
    assert code == 0
    railway = next(line for line in out.splitlines() if line.startswith("railway"))
    assert railway.split() == ["railway", "2.30", "1.84"]


def test_fitted_stands_beside_hand_and_no_line_is_wider_than_a_terminal(program, learnt_file):
    code, out, _ = program("weights", "--learned", learnt_file)
    assert code == 0
    assert out.count("railway") == 6
    heads = [line.split() for line in out.splitlines() if "fitted" in line]
    assert heads[0] == ["hand"] * 5 + ["fitted"] * 5
    assert max(map(len, (line for line in out.splitlines() if not line.startswith("weight of")))) <= 80


@pytest.mark.slow
def test_a_region_gets_a_picture_for_each_age(program, own_out):
    code, out, _ = program("weights", TOWN, "--age", "0", "--age", "10", "--season", "snow", "--out", own_out)
    assert code == 0
    paths = [line.removeprefix("map of weights: ") for line in out.splitlines() if line.startswith("map of")]
    assert [path.rsplit("-", 2)[1] for path in paths] == ["0y", "10y"]
    young, old = (image.imread(path) for path in paths)
    assert young.shape == old.shape
    assert (young != old).any()


@pytest.mark.parametrize("age", ["-1", "nan", "inf"])
def test_what_is_no_age_gets_one_line(mistake, age):
    assert "at least 0 years and finite" in mistake("weights", f"--age={age}")


def test_an_unknown_region_gets_the_nearest_name(mistake, own_out):
    assert f"did you mean {TOWN!r}?" in mistake("weights", "town-riversite", "--out", own_out)
    assert "build-region it first" in mistake("weights", "vaduz", "--out", own_out)


@pytest.mark.parametrize("text", ["no json", '{"version": 2}', '{"version": 1, "classes": {"water": 5}}'])
def test_a_file_that_is_not_what_was_learnt_gets_one_line(mistake, tmp_path, text):
    path = tmp_path / "foreign.json"
    path.write_text(text)
    assert f"{path} is no learned text of a sasgeo matcher, name a .json of" in mistake("weights", "--learned", path)


def test_only_a_file_of_a_run_is_advised_to_be_removed(mistake, tmp_path):
    own = tmp_path / "out/runs/mine/abcd/learned/1.json"
    own.parent.mkdir(parents=True)
    own.write_bytes(b"\xff")
    (tmp_path / "layers.tif").write_bytes(b"\xff")
    values = {path: mistake("weights", "--learned", path) for path in ("out", "layers.tif", own)}
    assert "out is a folder, not a learned text: name a .json of out/runs/<matcher>/<hash>/learned/" in values["out"]
    assert "layers.tif is no learned text (" in values["layers.tif"]
    assert values[own].endswith("remove this file and run again, which trains anew")
    assert not any("remove" in values[path] for path in ("out", "layers.tif"))


def test_a_missing_file_and_foreign_classes_get_one_line(mistake, tmp_path, learnt_file):
    assert "there is no file nowhere.json" in mistake("weights", "--learned", "nowhere.json")
    strange = tmp_path / "strange.json"
    strange.write_text(learnt_file.read_text().replace('"railway":', '"tramway":'))
    assert "no class 'tramway'" in mistake("weights", "--learned", strange)


def test_a_region_with_other_classes_gets_one_line(mistake, own_out, tmp_path):
    few = tmp_path / "few.json"
    few.write_text(Learnt.by_hand(["water"]).to_text())
    assert "the model lacks the map's class" in mistake("weights", TOWN, "--learned", few, "--out", own_out)
    manifest = own_out / "regions" / TOWN / "region.json"
    about = json.loads(manifest.read_text())
    manifest.write_text(json.dumps(about | {"classes": ["tramway", *about["classes"][1:]]}))
    assert "build the region again" in mistake("weights", TOWN, "--out", own_out)
