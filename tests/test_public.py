# SPDX-License-Identifier: Apache-2.0
"""The public names: each is there, none costs anything before it is asked for, and plugins need no others."""

import ast
import subprocess
import sys
from pathlib import Path

import pytest

import sasgeo_bench as sgb
from sasgeo_bench.matching.scaffold import plugin_files

ROOT = Path(__file__).parents[1]
STUB = ast.parse((ROOT / "sasgeo_bench" / "__init__.pyi").read_text(encoding="utf-8"))
NAMES = [alias.name for node in STUB.body if isinstance(node, ast.ImportFrom) for alias in node.names]


def inner_imports(text):
    """Modules of the package that a file imports instead of public names."""
    nodes = list(ast.walk(ast.parse(text)))
    froms = [node.module or "" for node in nodes if isinstance(node, ast.ImportFrom)]
    plain = [alias.name for node in nodes if isinstance(node, ast.Import) for alias in node.names]
    return [name for name in (*froms, *plain) if name.startswith("sasgeo_bench.")]


@pytest.mark.parametrize("name", NAMES)
def test_every_public_name_is_there(name):
    assert getattr(sgb, name) is not None
    assert name in dir(sgb)
    assert name in sgb.__all__


def test_a_name_that_is_none_is_refused_as_of_any_module():
    with pytest.raises(AttributeError, match="Posse"):
        _ = sgb.Posse


def test_importing_the_package_imports_none_of_its_libraries():
    code = "import sys, sasgeo_bench; print({'numpy', 'pandas', 'shapely', 'pydantic'} & set(sys.modules))"
    ended = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=True)  # noqa: S603 - our own
    assert ended.stdout == "set()\n"


@pytest.mark.parametrize("path", sorted((ROOT / "baselines").rglob("*.py")), ids=lambda path: path.name)
def test_baselines_need_public_names_alone_as_any_plugin_does(path):
    assert inner_imports(path.read_text(encoding="utf-8")) == []


def test_a_new_plugin_begins_with_public_names_alone():
    files = plugin_files("my-matcher")
    assert not [name for path, text in files.items() if path.endswith(".py") for name in inner_imports(text)]
    assert any("from sasgeo_bench import" in text for text in files.values())
