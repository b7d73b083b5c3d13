# SPDX-License-Identifier: Apache-2.0
"""The package that `new matcher` writes: sound, taken names refused, written whole or not at all; it passes the kit."""

import ast
import errno
import re
import tomllib
import zipfile
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pytest

import sasgeo_bench
from sasgeo_bench.core.errors import ConfigError, StoreError
from sasgeo_bench.core.plugins import MATCHERS, SEGMENTERS, SHIPPED, TRACKERS, list_entry_points
from sasgeo_bench.geometry.pose import Pose
from sasgeo_bench.matching.matcher import Match
from sasgeo_bench.matching.scaffold import package_files, write_plugin
from sasgeo_bench.matching.segmenter import ImageTraining
from sasgeo_bench.regions.region import Region
from sasgeo_bench.running.segmenter_testing import check_segmenter
from sasgeo_bench.running.testing import check_matcher
from sasgeo_bench.sensing.segmentation import Segmentation
from sasgeo_bench.sensing.tiny_images import tiny_images
from sasgeo_bench.tasks.query import Query

LONGEST = "a" * 60
# Some of these would break what is generated if their class were called what the name says.
ACCEPTED = {
    "matcher": (
        *("my-matcher", "my_matcher", "a-b_c-d", "m", "m2", LONGEST, "resnet-50", "v2"),
        *("match", "query", "pose", "region", "layer-bits", "matcher-card", "withheld", "none", "true", "false"),
    ),
    "tracker": ("my-tracker", "a-b_c", "m2", "pose", "matcher-card", "fix", "region", "none"),
    "segmenter": ("my-segmenter", "a-b_c", "segmentation", "segmenter-card", "aerial-image", "image-training", "none"),
}
REFUSED = (
    *("", " ", "My-Matcher", "my matcher", "my.matcher", "my--matcher", "-matcher", "matcher-", "_m", "2m", "mätcher"),
    *("../x", "/etc/x", "a/b", "a\\b", "..", ".", "~", "$HOME", "a\nb", "a\n", 'a"', "a]", "{name}", "a" * 61),
    *("class", "import", "async", "random", "json", "test", "sasgeo_bench", "sasgeo-bench", "sasgeo-baselines"),
    *("numpy", "scipy", "cv2", "pandas", "pytest", "rich", "tests", "con", "aux", "fft_vote", "raster_uniform"),
    "oracle_pose",
)


# Names that ship, by the kinds for which they are taken.
TAKEN = dict.fromkeys(("fft_vote", "raster_uniform", "oracle_pose"), ("matcher", "tracker"))
TAKEN |= {"dead_reckoning": ("tracker",), "oracle_segmenter": ("segmenter",)}
KINDS = ("matcher", "tracker", "segmenter")
GROUPS = {"matcher": MATCHERS, "tracker": TRACKERS, "segmenter": SEGMENTERS}
# What a class needs, which a name like its own must not hide.
NEEDED = {
    "matcher": {"Match": Match, "Query": Query, "Pose": Pose, "Region": Region},
    "tracker": {"Pose": Pose},
    "segmenter": {"Segmentation": Segmentation},
}


def write_under(folder: Path, name: str) -> Path:
    write_plugin(folder / "plugin", package_files("matcher", name))
    return folder / "plugin"


@pytest.mark.parametrize(("kind", "name"), [(kind, name) for kind, names in ACCEPTED.items() for name in names])
def test_a_package_is_complete_and_its_class_can_be_made_and_hides_nothing_that_it_needs(tmp_path, kind, name) -> None:
    files, module = package_files(kind, name), name.replace("-", "_")
    card = {f"src/{module}/card.toml"} if kind != "segmenter" else set()
    package = {f"src/{module}/__init__.py", f"src/{module}/{kind}.py", *card}
    assert set(files) == {"pyproject.toml", "README.md", "tests/test_conforms.py", *package}
    project = tomllib.loads(files["pyproject.toml"])["project"]
    assert project["name"] == name.replace("_", "-")
    ((point, value),) = project["entry-points"][GROUPS[kind]].items()
    assert point == name
    tree = ast.parse(files[f"src/{module}/{kind}.py"])
    (own,) = [node.name for node in tree.body if isinstance(node, ast.ClassDef)]
    assert value == f"{module}.{kind}:{own}"
    assert f'check_{kind}("{value}")' in files["tests/test_conforms.py"]
    assert f"check {name}" in files["README.md"]
    assert not any(re.search(r"\{(name|module|cls|title|distribution)\}", text) for text in files.values())
    write_plugin(tmp_path / "plugin", files)
    path = tmp_path / "plugin" / "src" / module / f"{kind}.py"
    assert {
        each.relative_to(tmp_path / "plugin").as_posix() for each in path.parents[2].rglob("*") if each.is_file()
    } == {*files}
    found: dict[str, object] = {"__file__": str(path)}
    exec(path.read_text(), found)  # noqa: S102 - our own text
    assert found[own]().card.name == name
    assert {each: found[each] for each in NEEDED[kind]} == NEEDED[kind]


@pytest.mark.parametrize("name", [*REFUSED, "dead_reckoning", "oracle_segmenter"])
@pytest.mark.parametrize("kind", KINDS)
def test_what_is_no_name_for_a_package_or_taken_is_refused_in_one_line(kind, name) -> None:
    if name in TAKEN and kind not in TAKEN[name]:
        assert package_files(kind, name)
        return
    with pytest.raises(ConfigError) as refused:
        package_files(kind, name)
    assert "\n" not in str(refused.value)
    assert repr(name) in str(refused.value)


def test_a_segmenter_that_is_written_learns_to_tell_roofs_from_the_rest() -> None:
    found: dict[str, object] = {}
    exec(package_files("segmenter", "my-segmenter")["src/my_segmenter/segmenter.py"], found)  # noqa: S102 - our own text
    *train, test = tiny_images()
    segmenter = found["MySegmenter"]()
    given = segmenter.segment(test.image, learned=segmenter.learn(ImageTraining(images=train)))
    roof, at = given.probabilities()[given.classes.index("building")], test.classes.index("building")
    assert roof[test.labels[at] == 1].mean() > 0.8
    assert roof[test.labels[at] == 0].mean() < 0.3
    assert np.isnan(segmenter.segment(test.image, learned=None).probabilities()).all()


def test_no_package_hides_a_module_that_ours_imports() -> None:
    ours = Path(sasgeo_bench.__file__).parent.rglob("*.py")
    nodes = [node for path in ours for node in ast.walk(ast.parse(path.read_text(encoding="utf-8")))]
    names = [str(node.module) for node in nodes if isinstance(node, ast.ImportFrom)]
    names += [alias.name for node in nodes if isinstance(node, ast.Import) for alias in node.names]
    imported = {name.split(".")[0] for name in names}
    assert {"numpy", "pyarrow", "sasgeo_bench"} <= imported
    for name in imported - {"__future__"}:
        with pytest.raises(ConfigError):
            package_files("matcher", name)


def test_a_name_that_would_lose_to_a_built_in_matcher_is_refused() -> None:
    listed = [name for name, point in list_entry_points().items() if point.dist.name in SHIPPED]
    assert {"fft_vote", "sasgeo"} <= {*listed}
    for name in listed:
        with pytest.raises(ConfigError):
            package_files("matcher", name)
    with pytest.raises(ConfigError, match="is a matcher of sasgeo-bench itself, which would be used instead of yours"):
        package_files("matcher", "fft_vote")
    assert package_files("matcher", "fft-vote-2")


# --- writing --------------------------------------------------------------------------------------------------------


def test_a_package_goes_into_an_empty_folder_or_a_new_one_however_deep(tmp_path) -> None:
    (tmp_path / "empty").mkdir()
    for folder in (tmp_path / "empty", tmp_path / "a" / "b" / "c"):
        write_plugin(folder, {"deep/er/file.txt": "x", "top.txt": "y"})
        assert (folder / "deep/er/file.txt").read_text() == "x"
        assert (folder / "top.txt").read_text() == "y"


@pytest.mark.parametrize("in_the_way", ["plugin/notes.txt", "plugin/src/x.py", "plugin/.hidden", "plugin"])
def test_a_folder_that_is_not_empty_or_a_file_in_the_way_is_refused_and_left_alone(tmp_path, in_the_way) -> None:
    path = tmp_path / in_the_way
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text("mine")
    with pytest.raises(StoreError, match="is there already and not empty: name another folder"):
        write_under(tmp_path, "my-matcher")
    assert path.read_text() == "mine"
    assert [item for item in tmp_path.rglob("*") if item.is_file()] == [path]


def test_a_file_above_the_folder_is_reported_in_one_line(tmp_path) -> None:
    (tmp_path / "file").write_text("mine")
    with pytest.raises(StoreError, match="cannot be written") as caught:
        write_plugin(tmp_path / "file" / "plugin", package_files("matcher", "my-matcher"))
    assert "\n" not in str(caught.value)
    assert [item.name for item in tmp_path.iterdir()] == ["file"]


@pytest.mark.parametrize("is_there", [False, True])
@pytest.mark.parametrize("written", range(6))
def test_nothing_half_written_is_left_on_a_full_disk(tmp_path, monkeypatch, is_there, written) -> None:
    folder = tmp_path / "new" / "plugin" if not is_there else tmp_path
    write, count = Path.write_text, 0

    def some(self, text, **options):
        nonlocal count
        count += 1
        if count > written:
            write(self, text[:10], **options)
            raise OSError(errno.ENOSPC, "No space left on device")
        return write(self, text, **options)

    monkeypatch.setattr(Path, "write_text", some)
    with pytest.raises(StoreError, match=r"cannot be written \(No space left on device\)"):
        write_plugin(folder, package_files("matcher", "my-matcher"))
    monkeypatch.undo()
    assert list(tmp_path.iterdir()) == []


def test_a_folder_that_cannot_be_looked_into_is_reported_in_one_line(tmp_path, monkeypatch) -> None:
    def refuse(self):
        raise PermissionError(errno.EACCES, "Permission denied", str(self))

    monkeypatch.setattr(Path, "iterdir", refuse)
    with pytest.raises(StoreError, match=r"cannot be read \(Permission denied\)"):
        write_plugin(tmp_path, {"a": "b"})


# --- what is written works ------------------------------------------------------------------------------------------


@pytest.mark.usefixtures("in_threads")
@pytest.mark.parametrize("kind", ["matcher", "segmenter"])  # test_tracker_testing flies a tracker
def test_what_is_written_passes_the_kit_at_once(tiny, tmp_path, monkeypatch, kind) -> None:
    write_plugin(tmp_path / "plugin", package_files(kind, f"my-new-{kind}"))
    monkeypatch.syspath_prepend(str(tmp_path / "plugin" / "src"))
    spec = f"my_new_{kind}.{kind}:MyNew{kind.title()}"
    checks = list(check_matcher(spec, place=tiny) if kind == "matcher" else check_segmenter(spec))
    assert [check.name for check in checks if check.outcome != "pass"] == []
    assert checks[0].found == f"my-new-{kind} 0.1.0"


@pytest.mark.parametrize("name", ["my-matcher", "none"])
def test_what_is_written_can_be_built_and_names_its_entry_point(tmp_path, name) -> None:
    if find_spec("hatchling") is None:
        pytest.skip("hatchling, the build backend, is not installed (make install brings it)")
    from hatchling.builders.wheel import WheelBuilder  # noqa: PLC0415 - only where it is installed

    folder = write_under(tmp_path, name)
    (wheel,) = WheelBuilder(str(folder)).build(directory=str(tmp_path / "dist"), versions=["standard"])
    module = name.replace("-", "_")
    with zipfile.ZipFile(wheel) as archive:
        points = archive.read(f"{module}-0.1.0.dist-info/entry_points.txt").decode()
        assert {f"{module}/matcher.py", f"{module}/card.toml"} <= {*archive.namelist()}
    assert re.fullmatch(rf"\[{MATCHERS}\]\n{name} = {module}\.matcher:\w+\n", points)
