# SPDX-License-Identifier: Apache-2.0
"""The program of ablations: its arms, its boxes, what it refuses, keeps and prints; a stand-in teaches, not PyTorch."""

import shutil
import sys
from dataclasses import dataclass, fields
from types import SimpleNamespace

import numpy as np
import pytest
import shapely
from sasgeo_baselines.segmenters.osm_unet import WEIGHTS, OsmUNet
from sklearn.metrics import roc_auc_score

from benchmarks import ablate_segmenter
from benchmarks.ablate_segmenter import (
    ARMS,
    PLACES,
    Arm,
    PlaceResult,
    Plan,
    Result,
    check_untaught,
    differences,
    middle_of,
    planned,
    stride_of,
    table,
)
from benchmarks.real_pictures import Area, part_of, views_of
from benchmarks.segmenter_lessons import DRAWN, REAL, Part, sources_of
from sasgeo_bench.core.errors import StoreError
from sasgeo_bench.regions.evidence import UNKNOWN
from sasgeo_bench.regions.region_files import read_region
from sasgeo_bench.sensing.reference_imagery import region_views
from sasgeo_bench.sensing.rendering.wild import Ingredients
from tests import world
from tests.regions.imagery_place import make_hamlet

NORTH, SOUTH = Part("hamlet", (0.0, 1.0, 0.0, 0.5)), Part("hamlet", (0.0, 1.0, 0.5, 1.0))


@pytest.fixture(scope="module")
def built(tmp_path_factory):
    root, hamlet = tmp_path_factory.mktemp("out"), make_hamlet(tmp_path_factory.mktemp("hamlet"))
    world.built(hamlet.spec(), root, extract_folders=[hamlet.folder], imagery_folders=[hamlet.folder])
    return root


@pytest.fixture
def out(built, tmp_path):
    (tmp_path / "regions").symlink_to(built / "regions")
    return tmp_path


# Arms


def test_each_switch_is_left_out_of_one_arm_and_nothing_else_is():
    full = Ingredients()
    for name in (each.name for each in fields(Ingredients)):
        arm = ARMS[f"drawn-without-{name}"]
        changed = {
            each.name for each in fields(Ingredients) if getattr(arm.look, each.name) != getattr(full, each.name)
        }
        assert changed == {name}
        assert not getattr(arm.look, name)
        assert (arm.base, arm.drawn, arm.real) == ("drawn", DRAWN, ())


def test_each_base_is_an_arm_and_both_have_what_each_alone_has():
    assert {arm.base for arm in ARMS.values()} - {None} <= set(ARMS)
    assert (ARMS["both"].drawn, ARMS["both"].real) == (ARMS["drawn"].drawn, ARMS["real"].real) == (DRAWN, REAL)
    assert not ARMS["drawn"].real
    assert not ARMS["real"].drawn


def test_a_box_around_the_middle_has_its_area_and_the_proportions_of_the_part(built):
    whole = Part("hamlet", (0.1, 0.9, 0.0, 0.5))
    region = read_region(built / "regions" / "hamlet")
    all_of_it, box = (shapely.box(*part_of(region, part.box)) for part in (whole, middle_of(whole, 0.01, built)))
    assert box.area == pytest.approx(0.01e6)
    assert all_of_it.contains(box)
    assert box.centroid.distance(all_of_it.centroid) == pytest.approx(0, abs=1e-6)
    (west, south, east, north), (left, bottom, right, top) = all_of_it.bounds, box.bounds
    assert (right - left) / (top - bottom) == pytest.approx((east - west) / (north - south))


def test_a_box_that_is_larger_than_its_part_is_refused(built):
    with pytest.raises(SystemExit, match=r"^hamlet:0,1,0,0\.5 has 0\.\d\d km2, 1 are asked for"):
        middle_of(NORTH, 1, built)


def test_no_picture_is_asked_that_taught_but_the_part_beside_is(built):
    sources = sources_of([], [NORTH], 0.3, built)
    check_untaught(sources, [SOUTH], built)
    with pytest.raises(SystemExit, match=r"^hamlet:0,1,0\.4,1 shows ground whose picture teaches \(hamlet\)"):
        check_untaught(sources, [SOUTH, Part("hamlet", (0.0, 1.0, 0.4, 1.0))], built)


# The command line


def test_steps_are_whole_parts_or_fewer_than_one():
    assert [planned(["--steps", given])[0].steps for given in ("20", "1000", "1001")] == [20, 1000, 2000]
    plan, is_table = planned(["--arms", "drawn,real", "--table"])
    assert (plan.arms, plan.places, is_table) == (("drawn", "real"), PLACES, True)


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--arms", "drawn,dawn"], "there is no arm 'dawn': choose among both, "),
        (["--steps", "0"], "at least 1, got 0 and 200"),
        (["--views", "0"], "at least 1, got 2000 and 0"),
        (["--places", "a:0,2,0,1"], "'a:0,2,0,1' is no part of a picture: give NAME"),
    ],
)
def test_a_wrong_word_is_named(arguments, words, capsys):
    with pytest.raises(SystemExit) as stopped:
        planned(arguments)
    assert stopped.value.code == 2
    assert words in capsys.readouterr().err


# Views and areas under the curve


def test_views_are_thinned_until_they_are_few_enough(built):
    # The picture has 384 m and what lies around it: two squares of 256 m a side.
    region = read_region(built / "regions" / "hamlet")
    assert [stride_of(region, Part("hamlet"), most) for most in (1, 2, 3, 4, 200)] == [4, 2, 2, 1, 1]
    assert [stride_of(region, Part("hamlet", (0.0, 0.4, 0.0, 1.0)), most) for most in (1, 2)] == [2, 1]
    every, some = (list(views_of(region, (0, 1, 0, 1), stride)) for stride in (1, 2))
    assert 2 <= len(every) <= 4
    for one, same in zip(some, every[::2], strict=True):
        np.testing.assert_array_equal(one.labels, same.labels)


# Carrying out


@dataclass
class StandIn:
    """In place of `train_segmenter`: it keeps a state and has the weights that ship."""

    taught: int = 0
    is_cut: bool = False

    def train(self, sources, path, recipe):
        assert [one.box for one in sources] == [NORTH.box]
        assert (recipe.steps, recipe.part) == (20, 20)
        self.taught += 1
        path.write_text("state")
        if self.is_cut:
            raise KeyboardInterrupt
        return "net"

    def export(self, net, path):
        assert net == "net"
        shutil.copyfile(WEIGHTS, path)


@pytest.fixture
def stand_in(monkeypatch):
    found = StandIn()
    module = SimpleNamespace(train=found.train, export=found.export, Recipe=SimpleNamespace)
    monkeypatch.setitem(sys.modules, "benchmarks.train_segmenter", module)
    monkeypatch.setitem(ARMS, "north", Arm(real=(NORTH,)))
    return found


def call(monkeypatch, out, *more):
    arguments = ["ablate", "--out", str(out), "--steps", "20", "--arms", "north", "--places", str(SOUTH), *more]
    monkeypatch.setattr(sys, "argv", arguments)
    ablate_segmenter.main()


def test_an_arm_is_taught_once_and_its_areas_are_those_of_scikit_learn(out, stand_in, monkeypatch, capsys):
    call(monkeypatch, out)
    printed = capsys.readouterr()
    call(monkeypatch, out)
    assert stand_in.taught == 1
    assert capsys.readouterr().out == printed.out  # progress is beside, not in the table
    assert "north begins" in printed.err
    files = sorted(path.name for path in (out / "segmenters" / "ablations").iterdir())
    assert files == ["north-20.json", "north-20.onnx"]

    region, segmenter, said, labels = read_region(out / "regions" / "hamlet"), OsmUNet(), [], []
    for view in region_views(region, part_of(region, SOUTH.box), place="", gsd_m=0.5, side_px=512):
        is_known = view.labels[0] != UNKNOWN
        found = segmenter.segment(view.image, learned=None)
        said.append(found.probability_bytes[found.classes.index("building")][is_known])
        labels.append(view.labels[0][is_known])
    auc = roc_auc_score(np.concatenate(labels), np.concatenate(said))
    assert f"| north | {SOUTH} | {len(said)} | {auc:.3f} | - | - | - | - |" in printed.out


def test_an_arm_that_is_cut_off_keeps_its_state_and_no_result(out, stand_in, monkeypatch, capsys):
    stand_in.is_cut = True
    with pytest.raises(KeyboardInterrupt):
        call(monkeypatch, out)
    assert [path.name for path in (out / "segmenters" / "ablations").iterdir()] == ["north-20.pt"]
    with pytest.raises(SystemExit, match=r"^no arm of 20 steps is done in "):
        call(monkeypatch, out, "--table")
    assert "north" not in capsys.readouterr().out
    stand_in.is_cut = False
    call(monkeypatch, out)
    assert "north goes on" in capsys.readouterr().err


def test_a_place_that_teaches_is_not_asked_and_nothing_is_taught(out, stand_in, monkeypatch):
    with pytest.raises(SystemExit, match=r"shows ground whose picture teaches"):
        call(monkeypatch, out, "--places", "hamlet")
    assert stand_in.taught == 0


# Results


def seen(arm, *, places=("hill",), views=200, steps=2000, **aucs):
    areas = {name: Area(auc=auc, low=None, high=None, share=0.1) for name, auc in aucs.items()}
    return Result(
        arm=arm, steps=steps, views=views, places={place: PlaceResult(views=9, areas=areas) for place in places}
    )


def test_a_table_says_how_far_an_arm_is_from_its_base():
    results = {
        "drawn": seen("drawn", places=("hill", "shore"), building=0.9, water=0.75),
        "drawn-without-cars": seen(
            "drawn-without-cars", places=("hill", "shore"), building=0.8876, road=0.5, water=0.75
        ),
    }
    assert table(results).splitlines() == [
        "| arm | place | n | building | road | water | green | farmland |",
        "|---|---|---:|---:|---:|---:|---:|---:|",
        "| drawn | hill | 9 | 0.900 | - | 0.750 | - | - |",
        "| drawn | shore | 9 | 0.900 | - | 0.750 | - | - |",
        "| drawn-without-cars | hill | 9 | 0.888 (-0.012) | 0.500 | 0.750 (+0.000) | - | - |",
        "| drawn-without-cars | shore | 9 | 0.888 (-0.012) | 0.500 | 0.750 (+0.000) | - | - |",
    ]
    assert differences(results).splitlines() == [
        "| arm | building | road | water | green | farmland |",
        "|---|---|---|---|---|---|",
        "| drawn-without-cars | -0.01, -0.01 | - | +0.00, +0.00 | - | - |",
    ]


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("{", r"is damaged .*: remove it"),
        ("{}", r"is no result of an arm: remove it"),
        (seen("real").model_dump_json(), r"is of real and 2000 steps: remove it"),
        (seen("drawn", views=9).model_dump_json(), r"was made with --views 9 --places hill: give the same, remove it"),
        (seen("drawn", places=("shore",)).model_dump_json(), r"--places shore: give the same"),
    ],
)
def test_a_result_of_another_plan_is_refused(text, words, tmp_path):
    plan = Plan(out=tmp_path, steps=2000, places=(Part("hill"),))
    assert plan.result("drawn") is None
    path = plan.path("drawn", ".json")
    path.parent.mkdir(parents=True)
    path.write_text(seen("drawn", road=0.5).model_dump_json())
    assert plan.result("drawn").places["hill"].areas["road"].auc == 0.5
    path.write_text(text)
    with pytest.raises(StoreError, match=words):
        plan.result("drawn")
