# SPDX-License-Identifier: Apache-2.0
"""The kit of perturbations: what is none is refused in one line, and each rule finds who breaks it."""

import tomllib
from dataclasses import dataclass, field

import numpy as np
import pytest

import sasgeo_bench as sgb
from sasgeo_bench.core.errors import ConfigError
from sasgeo_bench.matching.scaffold import package_files, write_plugin
from sasgeo_bench.running import perturbation_testing
from sasgeo_bench.running.perturbation_testing import check_perturbation
from tests.slow import rest_slow


@pytest.fixture
def one_town(tiny, monkeypatch):
    """The kit looks at views of a town that is there already."""
    monkeypatch.setattr(perturbation_testing, "tiny_place", lambda _: tiny)


@dataclass(frozen=True)
class Stripes:
    share: float

    def __post_init__(self):
        sgb.check_ranges(self, share=(0.0, 1.0))

    def __call__(self, evidence, rng):
        hidden = rng.permutation(evidence.shape[0]) < round(self.share * evidence.shape[0])
        return sgb.hide(evidence, np.broadcast_to(hidden[:, None], evidence.shape))


class Writes(Stripes):
    def __call__(self, evidence, rng):
        if self.share:
            evidence.cells[:, rng.integers(evidence.shape[0])] = sgb.UNKNOWN
        return evidence


class Nothing(Stripes):
    def __call__(self, *_):
        return None


class Smaller(Stripes):
    def __call__(self, evidence, _):
        return evidence.replace(evidence.cells[:, 1:].copy()) if self.share else evidence


class Always(Stripes):
    def __call__(self, evidence, rng):
        return Stripes(share=0.1)(evidence, rng)


class Chance(Stripes):
    def __call__(self, evidence, _):
        return Stripes.__call__(self, evidence, np.random.default_rng())


class Reveals(Stripes):
    def __call__(self, evidence, _):
        return evidence.replace(np.zeros_like(evidence.cells), evidence.confidence) if self.share else evidence


class Moves(Reveals):
    moves_cells = True


class OneStream(Stripes):
    """Draws for one class after the other from one stream."""

    def __call__(self, evidence, rng):
        missed = np.stack([rng.random(evidence.shape) < self.share for _ in evidence.classes])
        return sgb.with_cells(evidence, np.where(missed, sgb.ABSENT, evidence.cells).astype(np.uint8))


class OwnStreams(Stripes):
    def __call__(self, evidence, rng):
        streams = sgb.Streams(rng)
        missed = np.stack([streams.of(name).random(evidence.shape) < self.share for name in evidence.classes])
        return sgb.with_cells(evidence, np.where(missed, sgb.ABSENT, evidence.cells).astype(np.uint8))


class Large(Stripes):
    def __call__(self, evidence, rng):
        if evidence.shape[0] < 10:
            raise ValueError("too small")
        return Stripes.__call__(self, evidence, rng)


class Idle(Stripes):
    def __call__(self, evidence, _):
        return evidence


@dataclass(frozen=True)
class Unchecked:
    share: float
    stripes: dict = field(default_factory=dict)

    def __call__(self, evidence, rng):
        return Stripes(share=min(float(self.share), 1.0))(evidence, rng)


@dataclass(frozen=True)
class Stumbles(Stripes):
    """Takes a strength that is no number for one, and falls over it."""

    def __post_init__(self):
        if not hasattr(self.share, "real") or isinstance(self.share, bool):
            self.share.nothing  # noqa: B018
        super().__post_init__()


@pytest.mark.usefixtures("one_town")
@pytest.mark.parametrize(
    ("rule", "one"),
    [
        ("gives a view of the same classes and shape", Nothing),
        ("gives a view of the same classes and shape", Smaller),
        ("changes no cell at strength 0", Always),
        ("the same seed, the same view", Chance),
        ("the given view is not changed", Writes),
        ("unknown cells stay unknown", Reveals),
        ("cells move, and nothing appears", Moves),
        ("a class more changes no other one", OneStream),
        ("takes views of one class, and of any shape", Large),
        ("changes some cells", Idle),
        ("refuses what is no strength", Unchecked),
        ("refuses what is no strength", Stumbles),
    ],
)
def test_a_perturbation_that_breaks_a_rule_fails_there(named, tmp_path, rule, one):
    rows = list(check_perturbation(named(one), out=tmp_path))
    assert rule in [row.name for row in rows if row.outcome == "fail"]
    assert all("\n" not in row.found for row in rows)


@pytest.mark.usefixtures("one_town")
@pytest.mark.parametrize(
    "one", rest_slow([Stripes, OwnStreams, Stripes(share=0.5), lambda strength: Stripes(share=strength)], but=2)
)
def test_a_sound_class_instance_or_function_of_a_strength_keeps_every_rule(named, tmp_path, one):
    assert [row for row in check_perturbation(named(one), out=tmp_path) if row.outcome != "pass"] == []


@pytest.mark.usefixtures("one_town")
@pytest.mark.parametrize(
    ("given", "expected"),
    [
        (lambda _: None, "a NoneType"),
        (lambda view: np.ones(view.shape, dtype=int), "int64 of shape"),
        (lambda _: np.ones((2, 3), dtype=bool), "bool of shape (2, 3)"),
    ],
)
def test_a_mask_that_is_none_is_told_once(named, tmp_path, given, expected):
    one = type("Masked", (sgb.Occlusion,), {"mask": lambda _, view, __: given(view)})
    lines = [row.found for row in check_perturbation(named(one), out=tmp_path) if row.outcome == "fail"]
    assert lines[0].startswith(f"PerturbError: Masked: the mask of what to hide is {expected}")
    assert ", expected an array of bool of shape (" in lines[0]
    assert sum("mask()" in line for line in lines) <= 2  # views of odd shapes are told apart


def stop(_):
    raise SystemExit(3)


@pytest.mark.parametrize(
    ("one", "fault"),
    [
        (3, "an object of type int that takes nothing is no perturbation: name a frozen dataclass of one strength"),
        ("border", "an object of type str that takes nothing is no perturbation"),
        (Stripes(0.5).__call__, "an object of type method that takes evidence, rng is no perturbation"),
        (lambda: None, "an object of type function that takes nothing is no perturbation"),
        (Stripes(share=0.0), "its share is 0, at which it changes nothing: name it at a usual strength"),
        (lambda strength: strength / 0, "it cannot be made with strength 0.3 (ZeroDivisionError"),
        (stop, "it cannot be made with _ 0.3 (SystemExit"),
        (lambda strength: [strength], "with strength 0.3 it makes an object of type list, no callable"),
    ],
)
def test_what_is_no_perturbation_is_refused_in_one_line(named, one, fault):
    (row,) = check_perturbation(named(one))
    assert row.outcome == "fail"
    assert row.found.startswith(f"module_of_mine:ONE: {fault}")
    assert "\n" not in row.found


@pytest.mark.parametrize(
    ("name", "fault"),
    [
        ("boarder", "there is no perturbation 'boarder', did you mean 'border'? (list perturbations shows all; or"),
        ("nowhere:ONE", "nowhere:ONE: cannot be imported (ModuleNotFoundError"),
    ],
)
def test_a_name_without_a_perturbation_is_refused_in_one_line(name, fault):
    (row,) = check_perturbation(name)
    assert row.found.startswith(fault)


def test_the_package_of_the_scaffold_holds_a_sound_perturbation_and_its_suite(tmp_path, monkeypatch, lay_towns):
    files = package_files("perturbation", "my-stress")
    write_plugin(tmp_path / "my-stress", files)
    monkeypatch.syspath_prepend(tmp_path / "my-stress" / "src")
    points = tomllib.loads(files["pyproject.toml"])["project"]["entry-points"]
    perturbation, suite = points["sasgeo_bench.perturbations"]["my-stress"], points["sasgeo_bench.suites"]["my-stress"]
    lay_towns(tmp_path / "out", "town-agricultural")
    checks = [*check_perturbation(perturbation, out=tmp_path / "out"), *sgb.check_suite(suite, out=tmp_path / "out")]
    assert [check for check in checks if check.outcome != "pass"] == []
    assert f'check_perturbation("{perturbation}")' in files["tests/test_conforms.py"]
    assert f'check_suite("{suite}")' in files["tests/test_suite.py"]


@pytest.mark.parametrize("name", ["border", "occlusion", "My-Stress", "numpy"])
def test_a_name_that_a_perturbation_cannot_have_is_refused_before_anything_is_written(name):
    with pytest.raises(ConfigError, match=name):
        package_files("perturbation", name)
