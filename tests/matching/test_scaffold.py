# SPDX-License-Identifier: Apache-2.0
"""The package that `new matcher` writes: sound, taken names refused, written whole or not at all; it passes the kit."""

import ast
import errno
import re
import tomllib
import zipfile
from importlib.util import find_spec
from pathlib import Path

import pytest

import sasgeo_bench
from sasgeo_bench.errors import ConfigError, StoreError
from sasgeo_bench.files.plugin_files import SHIPPED
from sasgeo_bench.files.plugins import MATCHERS, list_entry_points
from sasgeo_bench.geometry.pose import Pose
from sasgeo_bench.matching.card_file import read_card_file
from sasgeo_bench.matching.matcher import Match
from sasgeo_bench.matching.scaffold import plugin_files, write_plugin
from sasgeo_bench.regions.region import Region
from sasgeo_bench.running.testing import check_matcher
from sasgeo_bench.tasks.query import Query

LONGEST = "a" * 60
# Some of these would break what is generated if their class were called what the name says.
ACCEPTED = (
    *("my-matcher", "my_matcher", "a-b_c-d", "m", "m2", LONGEST, "resnet-50", "v2"),
    *("match", "query", "pose", "region", "layer-bits", "matcher-card", "withheld", "none", "true", "false"),
)
REFUSED = (
    *("", " ", "My-Matcher", "my matcher", "my.matcher", "my--matcher", "-matcher", "matcher-", "_m", "2m", "mätcher"),
    *("../x", "/etc/x", "a/b", "a\\b", "..", ".", "~", "$HOME", "a\nb", "a\n", 'a"', "a]", "{name}", "a" * 61),
    *("class", "import", "async", "random", "json", "test", "sasgeo_bench", "sasgeo-bench", "sasgeo-baselines"),
    *("numpy", "scipy", "cv2", "pandas", "pytest", "rich", "tests", "con", "aux", "fft_vote", "raster_uniform"),
    "oracle_pose",
)


def write_under(folder: Path, name: str) -> Path:
    write_plugin(folder / "plugin", plugin_files(name))
    return folder / "plugin"


@pytest.mark.parametrize("name", ACCEPTED)
def test_a_package_is_complete_and_names_its_class_everywhere_alike(tmp_path, name) -> None:
    folder = write_under(tmp_path, name)
    module = name.replace("-", "_")
    files = {path.relative_to(folder).as_posix() for path in folder.rglob("*") if path.is_file()}
    package = {f"src/{module}/{file}" for file in ("__init__.py", "matcher.py", "card.toml")}
    assert files == {"pyproject.toml", "README.md", "tests/test_conforms.py", *package}
    assert read_card_file(folder / "src" / module / "card.toml").name == name
    project = tomllib.loads((folder / "pyproject.toml").read_text())["project"]
    assert project["name"] == name.replace("_", "-")
    ((point, value),) = project["entry-points"][MATCHERS].items()
    assert point == name
    tree = ast.parse((folder / "src" / module / "matcher.py").read_text())
    (own,) = [node.name for node in tree.body if isinstance(node, ast.ClassDef)]
    assert value == f"{module}.matcher:{own}"
    assert f'check_matcher("{value}")' in (folder / "tests" / "test_conforms.py").read_text()
    assert f"check {name}" in (folder / "README.md").read_text()


@pytest.mark.parametrize("name", ACCEPTED)
def test_the_class_of_a_package_can_be_made_and_hides_nothing_that_it_needs(tmp_path, name) -> None:
    for path, text in plugin_files(name).items():
        if path.endswith(".py"):
            compile(text, path, "exec")
        assert not re.search(r"\{(name|module|cls|title|distribution)\}", text)
    module = write_under(tmp_path, name) / "src" / name.replace("-", "_") / "matcher.py"
    found: dict[str, object] = {"__file__": str(module)}
    exec(module.read_text(), found)  # noqa: S102 - our own text
    (own,) = [value for value in found.values() if getattr(value, "__module__", None) == "builtins"]
    assert own().card.name == name
    assert (found["Match"], found["Query"], found["Pose"], found["Region"]) == (Match, Query, Pose, Region)


@pytest.mark.parametrize("name", REFUSED)
def test_what_is_no_name_for_a_package_is_refused_in_one_line(name) -> None:
    with pytest.raises(ConfigError) as refused:
        plugin_files(name)
    assert "\n" not in str(refused.value)
    assert repr(name) in str(refused.value)


def test_no_package_hides_a_module_that_ours_imports() -> None:
    ours = Path(sasgeo_bench.__file__).parent.rglob("*.py")
    nodes = [node for path in ours for node in ast.walk(ast.parse(path.read_text(encoding="utf-8")))]
    names = [str(node.module) for node in nodes if isinstance(node, ast.ImportFrom)]
    names += [alias.name for node in nodes if isinstance(node, ast.Import) for alias in node.names]
    imported = {name.split(".")[0] for name in names}
    assert {"numpy", "pyarrow", "sasgeo_bench"} <= imported
    for name in imported - {"__future__"}:
        with pytest.raises(ConfigError):
            plugin_files(name)


def test_a_name_that_would_lose_to_a_built_in_matcher_is_refused() -> None:
    listed = [name for name, point in list_entry_points().items() if point.dist.name in SHIPPED]
    assert {"fft_vote", "sasgeo"} <= {*listed}
    for name in listed:
        with pytest.raises(ConfigError):
            plugin_files(name)
    with pytest.raises(ConfigError, match="is a matcher of sasgeo-bench itself, which would be used instead of yours"):
        plugin_files("fft_vote")
    assert plugin_files("fft-vote-2")


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


def test_a_file_above_the_folder_is_told_in_one_line(tmp_path) -> None:
    (tmp_path / "file").write_text("mine")
    with pytest.raises(StoreError, match="cannot be written") as told:
        write_plugin(tmp_path / "file" / "plugin", plugin_files("my-matcher"))
    assert "\n" not in str(told.value)
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
        write_plugin(folder, plugin_files("my-matcher"))
    monkeypatch.undo()
    assert list(tmp_path.iterdir()) == []


def test_a_folder_that_cannot_be_looked_into_is_told_in_one_line(tmp_path, monkeypatch) -> None:
    def refuse(self):
        raise PermissionError(errno.EACCES, "Permission denied", str(self))

    monkeypatch.setattr(Path, "iterdir", refuse)
    with pytest.raises(StoreError, match=r"cannot be read \(Permission denied\)"):
        write_plugin(tmp_path, {"a": "b"})


# --- what is written works ------------------------------------------------------------------------------------------


def test_what_is_written_passes_the_kit_at_once(tiny, tmp_path, monkeypatch) -> None:
    monkeypatch.syspath_prepend(str(write_under(tmp_path, "my-matcher") / "src"))
    checks = list(check_matcher("my_matcher.matcher:MyMatcher", place=tiny))
    assert [check.name for check in checks if check.outcome != "pass"] == []
    assert checks[0].found == "my-matcher 0.1.0"
    assert len(checks) > 10


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
