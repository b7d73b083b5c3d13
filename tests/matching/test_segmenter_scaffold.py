# SPDX-License-Identifier: Apache-2.0
"""The package that `new segmenter` writes: sound, taken names refused; it passes the kit."""

import ast
import re
import tomllib

import numpy as np
import pytest

from sasgeo_bench.errors import ConfigError
from sasgeo_bench.files.plugins import SEGMENTERS
from sasgeo_bench.matching.scaffold import write_plugin
from sasgeo_bench.matching.segmenter import ImageTraining
from sasgeo_bench.matching.segmenter_scaffold import segmenter_files
from sasgeo_bench.running.segmenter_testing import check_segmenter
from sasgeo_bench.sensing.segmentation import Segmentation
from sasgeo_bench.sensing.tiny_images import tiny_images

# Some of these would break what is generated if their class were called what the name says.
ACCEPTED = ("my-segmenter", "a-b_c", "m2", "segmentation", "segmenter-card", "aerial-image", "image-training", "none")
REFUSED = ("", "My-Segmenter", "2m", "../x", "{name}", "class", "numpy", "json", "a" * 61, "oracle_segmenter")


@pytest.mark.parametrize("name", ACCEPTED)
def test_a_package_is_complete_and_names_its_class_everywhere_alike(name) -> None:
    files = segmenter_files(name)
    module = name.replace("-", "_")
    package = {f"src/{module}/__init__.py", f"src/{module}/segmenter.py"}
    assert set(files) == {"pyproject.toml", "README.md", "tests/test_conforms.py", *package}
    project = tomllib.loads(files["pyproject.toml"])["project"]
    ((point, value),) = project["entry-points"][SEGMENTERS].items()
    assert point == name
    tree = ast.parse(files[f"src/{module}/segmenter.py"])
    (own,) = [node.name for node in tree.body if isinstance(node, ast.ClassDef)]
    assert value == f"{module}.segmenter:{own}"
    assert f'check_segmenter("{value}")' in files["tests/test_conforms.py"]
    assert f"check {name}" in files["README.md"]
    assert not any(re.search(r"\{(name|module|cls|title|distribution)\}", text) for text in files.values())
    found: dict[str, object] = {}
    exec(files[f"src/{module}/segmenter.py"], found)  # noqa: S102 - our own text
    assert found[own]().card.name == name
    assert found["Segmentation"] is Segmentation


@pytest.mark.parametrize("name", REFUSED)
def test_what_is_no_name_for_a_package_is_refused_in_one_line(name) -> None:
    with pytest.raises(ConfigError) as refused:
        segmenter_files(name)
    assert "\n" not in str(refused.value)
    assert repr(name) in str(refused.value)


@pytest.mark.usefixtures("in_threads")
def test_what_is_written_passes_the_kit_at_once(tmp_path, monkeypatch) -> None:
    write_plugin(tmp_path / "plugin", segmenter_files("my-scaffolded"))
    monkeypatch.syspath_prepend(str(tmp_path / "plugin" / "src"))
    checks = list(check_segmenter("my_scaffolded.segmenter:MyScaffolded"))
    assert [check.name for check in checks if check.outcome != "pass"] == []
    assert checks[0].found == "my-scaffolded 0.1.0"


def test_what_is_written_learns_to_tell_roofs_from_the_rest() -> None:
    found: dict[str, object] = {}
    exec(segmenter_files("my-segmenter")["src/my_segmenter/segmenter.py"], found)  # noqa: S102 - our own text
    *train, test = tiny_images()
    segmenter = found["MySegmenter"]()
    said = segmenter.segment(test.image, learned=segmenter.learn(ImageTraining(images=train)))
    roof, at = said.probabilities()[said.classes.index("building")], test.classes.index("building")
    assert roof[test.labels[at] == 1].mean() > 0.8
    assert roof[test.labels[at] == 0].mean() < 0.3
    assert np.isnan(segmenter.segment(test.image, learned=None).probabilities()).all()
