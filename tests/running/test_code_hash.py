# SPDX-License-Identifier: Apache-2.0
"""What makes a run another run: the plugin's own code, and that of the rooms it answers with."""

import sys
from importlib.util import find_spec
from pathlib import Path
from types import ModuleType

import pytest

from sasgeo_bench.matching.matcher import Matcher
from sasgeo_bench.running import serve
from sasgeo_bench.running.serve import TOOLS, code_hash

PLUGIN = "class Mine:\n    pass\n"


@pytest.fixture
def matcher(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Matcher:
    """A plugin of one file."""
    (tmp_path / "mine_of_the_test.py").write_text(PLUGIN)
    monkeypatch.syspath_prepend(str(tmp_path))
    monkeypatch.setattr(serve, "TOOLS", ())
    module = __import__("mine_of_the_test")
    monkeypatch.setitem(sys.modules, "mine_of_the_test", module)
    made: Matcher = module.Mine()
    return made


def fake_tool(folder: Path, monkeypatch: pytest.MonkeyPatch, name: str = "search") -> Path:
    """A room `sasgeo_bench.<name>` of two files, loaded; -> its second file."""
    room = folder / name
    room.mkdir()
    (room / "__init__.py").write_text("")
    (room / "find.py").write_text("beam = 1\n")
    module = ModuleType(f"sasgeo_bench.{name}")
    module.__file__ = str(room / "__init__.py")
    monkeypatch.setitem(sys.modules, module.__name__, module)
    monkeypatch.setattr(serve, "TOOLS", (name,))
    return room / "find.py"


def test_a_change_of_the_plugin_changes_its_hash(tmp_path: Path, matcher: Matcher) -> None:
    before = code_hash(matcher)
    assert before == code_hash(matcher)
    (tmp_path / "mine_of_the_test.py").write_text(PLUGIN + "# changed\n")
    assert code_hash(matcher) != before


def test_a_change_of_the_search_it_has_loaded_changes_its_hash(
    tmp_path: Path, matcher: Matcher, monkeypatch: pytest.MonkeyPatch
) -> None:
    alone = code_hash(matcher)
    find = fake_tool(tmp_path, monkeypatch)
    before = code_hash(matcher)
    assert before != alone
    find.write_text("beam = 2\n")
    assert code_hash(matcher) != before


def test_a_search_it_has_not_loaded_does_not_count(matcher: Matcher, monkeypatch: pytest.MonkeyPatch) -> None:
    alone = code_hash(matcher)
    monkeypatch.setattr(serve, "TOOLS", ("search",))
    monkeypatch.delitem(sys.modules, "sasgeo_bench.search", raising=False)
    assert code_hash(matcher) == alone


def test_the_rooms_that_count_are_there() -> None:
    assert all(find_spec(f"sasgeo_bench.{tool}") for tool in TOOLS), "a file that moved would drop out of the hash"
