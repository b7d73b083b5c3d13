# SPDX-License-Identifier: Apache-2.0
"""The package that `new tracker` writes: sound, and taken names refused; `test_tracker_testing` flies it."""

import ast
import re
import tomllib

import pytest

from sasgeo_bench.errors import ConfigError
from sasgeo_bench.files.plugins import TRACKERS
from sasgeo_bench.geometry.pose import Pose
from sasgeo_bench.matching.scaffold import write_plugin
from sasgeo_bench.matching.tracker_scaffold import tracker_files

# Some of these would break what is generated if their class were called what the name says.
ACCEPTED = ("my-tracker", "a-b_c", "m2", "pose", "matcher-card", "fix", "region", "none")
REFUSED = ("", "My-Tracker", "2m", "../x", "{name}", "class", "numpy", "a" * 61)
TAKEN = ("dead_reckoning", "raster_uniform", "fft_vote", "oracle_pose")


@pytest.mark.parametrize("name", ACCEPTED)
def test_a_package_is_complete_and_names_its_class_everywhere_alike(tmp_path, name) -> None:
    files = tracker_files(name)
    module = name.replace("-", "_")
    package = {f"src/{module}/{file}" for file in ("__init__.py", "tracker.py", "card.toml")}
    assert set(files) == {"pyproject.toml", "README.md", "tests/test_conforms.py", *package}
    project = tomllib.loads(files["pyproject.toml"])["project"]
    ((point, value),) = project["entry-points"][TRACKERS].items()
    assert point == name
    tree = ast.parse(files[f"src/{module}/tracker.py"])
    (own,) = [node.name for node in tree.body if isinstance(node, ast.ClassDef)]
    assert value == f"{module}.tracker:{own}"
    assert f'check_tracker("{value}")' in files["tests/test_conforms.py"]
    assert f"check {name}" in files["README.md"]
    assert not any(re.search(r"\{(name|module|cls|title|distribution)\}", text) for text in files.values())
    write_plugin(tmp_path / "plugin", files)
    found: dict[str, object] = {"__file__": str(tmp_path / "plugin" / "src" / module / "tracker.py")}
    exec(files[f"src/{module}/tracker.py"], found)  # noqa: S102 - our own text
    assert (found[own]().card.name, found[own]().card.tracks) == (name, ("sequence",))
    assert found["Pose"] is Pose


@pytest.mark.parametrize("name", [*REFUSED, *TAKEN])
def test_what_is_no_name_for_a_package_or_taken_is_refused_in_one_line(name) -> None:
    with pytest.raises(ConfigError) as refused:
        tracker_files(name)
    assert "\n" not in str(refused.value)
    assert repr(name) in str(refused.value)
