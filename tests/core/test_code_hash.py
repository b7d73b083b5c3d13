# SPDX-License-Identifier: Apache-2.0
"""What makes a run another run: the files of a plugin's own code, and those of the tools that it imports."""

import sys
from importlib.util import find_spec
from pathlib import Path

import pytest

from sasgeo_bench.core import plugins
from sasgeo_bench.core.errors import MatchError
from sasgeo_bench.core.plugins import MATCHERS, digest_of, ships
from sasgeo_bench.running.plugin_code import SEGMENTER_TOOLS, TOOLS, matcher_code, segmenter_code

MODULE = '''
"""What it is."""
import numpy as np


class Mine:
    """A matcher."""

    def match(self, query, *, top_k):
        """Answer."""
        return [top_k, f"{query!r:>10}", 1.5, None, b"x"]
'''
SAME_TREE = '''
# Other words, and other lines.


import numpy as np

class Mine:
    def match(self, query, *, top_k):

        """In other words,

        and more of them."""
        return [
            top_k, f"{query!r:>10}", 1.5, None, b"x",
        ]  # all of them
'''


@pytest.fixture
def lay(tmp_path, monkeypatch):
    """Write files into the working folder; the function returns the hash of `plugin:Mine`, or of another class."""
    monkeypatch.chdir(tmp_path)

    def write(files: dict[str, str | bytes], spec: str = "plugin:Mine") -> str:
        for name, text in files.items():
            path = tmp_path / name
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_bytes(text if isinstance(text, bytes) else text.encode())
        sys.path_importer_cache.clear()  # files that are newer than the clock of folders tells
        return matcher_code(spec)

    return write


def test_words_and_lines_change_no_hash_and_code_does(lay):
    before = lay({"plugin.py": MODULE})
    assert lay({"plugin.py": SAME_TREE}) == before
    assert lay({"plugin.py": "\ufeff" + SAME_TREE.replace("\n", "\r\n")}) == before
    for old, new in (("1.5", "1.25"), ("None", "0"), (":>10", ":>11"), ('b"x"', '"x"'), ("top_k,", "top_k + 0,")):
        assert lay({"plugin.py": SAME_TREE.replace(old, new)}) != before, new
    assert lay({"plugin.py": SAME_TREE}) == before


@pytest.mark.parametrize(
    ("one", "other"),
    [
        ("x = None", "x = ..."),
        ("x = 1", "x = 1.0"),
        ("x = 0.0", "x = -0.0"),
        ("x = {**y}", "x = {None: y}"),
        ("def f(a, *, b): pass", "def f(a, b): pass"),
        ("x: int", "x: int = None"),
        ("return_ = 'doc'; 'doc'", "return_ = 'doc'"),
        ("from . import a", "from .. import a"),
        ("def f():\n  'doc'\n  'not'", "def f():\n  'doc'"),
        ("not = python", "not  = python"),
        (f"x = 0x{'f' * 5000}", f"x = 0x{'f' * 4999}e"),
        (f"x = {'a + ' * 2000} b", f"x = {'a + ' * 2000} c"),
    ],
)
def test_what_differs_as_code_differs_as_hash(lay, one, other):
    assert lay({"plugin.py": one}) != lay({"plugin.py": other})


def test_all_of_a_package_counts_and_what_is_no_python_by_its_bytes(lay):
    package = {"plugin/__init__.py": "from plugin.inner.code import Mine\n", "plugin/inner/code.py": MODULE}
    before = lay(package)
    for name in ("plugin/data/weights.npz", "plugin/settings.toml", "plugin/util.py", "plugin/fast.so"):
        after = lay({name: b"x = 1"})
        assert after != before, name
        before = after
    assert lay({"plugin/util.py": b"x = 1  # one"}) == before
    assert lay({"plugin/settings.toml": b"x = 1 # one"}) != before


def test_what_nobody_runs_does_not_count(lay):
    before = lay({"plugin/__init__.py": MODULE})
    others = (
        "plugin/__pycache__/a.cpython-311.pyc",
        "plugin/.cache/b.py",
        "plugin/.c.swp",
        "other.py",
        "data.bin",
        "plugin/card.toml",
    )
    assert lay(dict.fromkeys(others, b"?")) == before


def test_a_module_beside_it_that_it_imports_counts_and_another_does_not(lay):
    before = lay({"plugin.py": "import helper\n" + MODULE, "helper.py": "from deeper import x", "deeper/x.py": ""})
    assert lay({"idle.py": "x = 1"}) == before
    assert lay({"helper.py": "from deeper import x, y"}) != before
    before = lay({"deeper/__init__.py": "x = 1"})
    assert lay({"deeper/far.txt": "x"}) != before


@pytest.mark.parametrize(
    ("spec", "own", "name"),
    [
        ("a.b.plugin:Mine", "from a.c import helper", "a/c/helper.py"),  # none of the folders is a package
        ("a.b.plugin:Mine", "from ..c import helper", "a/c/helper.py"),
        ("plugin:Mine", "import lib.deep.code as c", "lib/deep/code.py"),
        ("plugin:Mine", "def later():\n    return importlib.import_module('helper')", "helper.py"),
        ("plugin:Mine", "x = __import__('helper')", "helper.py"),
    ],
)
def test_whatever_way_a_module_beside_it_is_imported_it_counts(lay, spec, own, name):
    before = lay({f"{spec.partition(':')[0].replace('.', '/')}.py": f"{own}\n{MODULE}", name: "x = 1"}, spec)
    assert lay({name: "x = 2"}, spec) != before


def test_what_is_installed_for_editing_counts_as_code_of_ones_own(lay, tmp_path, monkeypatch):
    sites = tmp_path / "lib/site-packages"
    monkeypatch.setattr(plugins, "_sites", lambda: [sites])
    monkeypatch.setattr(plugins, "_bases", lambda: (sites, tmp_path / "src"))  # by a .pth file
    monkeypatch.setattr(sys, "path", [str(sites), str(tmp_path / "src"), *sys.path])
    for folder, counts in (("src", True), ("lib/site-packages", False)):
        files = {f"{folder}/{folder[:3]}_plugin.py": f"import helper\n{MODULE}", f"{folder}/helper.py": "x = 1"}
        before = lay(files, f"{folder[:3]}_plugin:Mine")
        assert (lay({f"{folder}/helper.py": "x = 2"}, f"{folder[:3]}_plugin:Mine") != before) is counts, folder


def test_a_linked_folder_beside_the_package_counts_and_one_elsewhere_or_around_does_not(lay, tmp_path):
    before = lay({"here/plugin/__init__.py": MODULE, "here/models/a.npz": "1", "far/b.npz": "1"}, "here.plugin:Mine")
    for link, target in (("far", "../../far"), ("me", "."), ("root", "../..")):
        (tmp_path / "here/plugin" / link).symlink_to(target)
        assert lay({}, "here.plugin:Mine") == before, link
    (tmp_path / "here/plugin/models").symlink_to("../models")
    linked = lay({}, "here.plugin:Mine")
    assert linked != before
    assert lay({"here/models/a.npz": "2"}, "here.plugin:Mine") != linked


def test_compiled_code_counts_where_no_source_of_it_is_there(lay):
    before = lay({"plugin/__init__.py": MODULE, "plugin/core.pyc": b"1"})
    assert lay({"plugin/core.pyc": b"2"}) != before
    before = lay({"plugin/core.py": "x = 1"})
    assert lay({"plugin/core.pyc": b"3"}) == before


def test_a_class_that_is_handed_on_counts_where_it_is(lay, tmp_path, monkeypatch):
    monkeypatch.syspath_prepend(str(tmp_path / "elsewhere"))
    files = {"elsewhere/vendor/__init__.py": "from .deep import Mine as Mine", "elsewhere/vendor/deep.py": MODULE}
    before = lay({"plugin.py": "from vendor import Mine", **files})
    assert lay({"elsewhere/vendor/deep.py": MODULE.replace("1.5", "2.5")}) != before
    ours = lay({"plugin.py": "from sasgeo_bench.matching.controls.blind import RandomPlaces as Mine"})
    assert ours != lay({"plugin.py": "from sasgeo_bench.matching.controls.fft_vote import FftVote as Other"})


def test_the_tools_that_it_imports_count_by_whatever_name(lay, monkeypatch):
    texts = (
        "from sasgeo_bench.search.find import score_at",
        "import sasgeo_bench.search",
        "import sasgeo_bench as sgb\ny = sgb.Chart",
        "def later():\n    from sasgeo_bench import VotePlan",
    )
    alone = plugins._rooms([], TOOLS)
    for text in texts:
        lay({"plugin.py": text})
        assert plugins._rooms([Path("plugin.py")], TOOLS) >= {"search"}, text
    lay({"plugin.py": "import sasgeo_bench as sgb\ny = sgb.Grid"})
    assert plugins._rooms([Path("plugin.py")], TOOLS) == alone
    before = lay({"plugin.py": texts[0], "changed.py": "beam = 1"})
    files = plugins._room_files
    monkeypatch.setattr(plugins, "_room_files", lambda room: [*files(room)][: -1 if room == "search" else None])
    assert lay({}) != before


def test_the_plugin_has_no_say_in_its_hash(lay, tmp_path):
    """It runs nothing: what a plugin does when it is imported cannot change what is hashed."""
    before = lay({"plugin.py": "raise SystemExit\n", "mark.txt": "x"})
    liar = "import pathlib, sys\npathlib.Path('ran').touch()\nsys.modules.clear()\n__file__ = 'mark.txt'\n"
    assert lay({"plugin.py": liar}) != before
    assert not (tmp_path / "ran").exists()


def test_names_are_part_of_a_hash_and_their_order_is_not_and_what_is_nowhere_is_refused(tmp_path, lay):
    one, two = tmp_path / "one.py", tmp_path / "two.py"
    one.write_text("x = 1")
    two.write_text("x = 2")
    assert digest_of({"a": one, "b": two}) == digest_of({"b": two, "a": one}) != digest_of({"a": two, "b": one})
    with pytest.raises(MatchError, match="no file of nowhere_to_be can be found"):
        lay({}, "nowhere_to_be:Mine")
    with pytest.raises(MatchError, match=f"there is no .* 'nobody' .*|{MATCHERS}"):
        matcher_code("nobody")


def test_code_that_ships_may_move_and_is_the_same_code(tmp_path, monkeypatch):
    """Whoever has answers would be asked anew for nothing. Code of others may be read by its name."""
    texts = ("from sasgeo_bench.old.room import f", "from sasgeo_bench.new import f", "from sasgeo_bench.new import g")
    old, new, other = (tmp_path / f"{name}.py" for name in ("old", "new", "other"))
    for path, text in zip((old, new, other), texts, strict=True):
        path.write_text(f"{text}\nx = 1")
    assert digest_of({"a.py": old}) != digest_of({"a.py": new})
    monkeypatch.setattr(plugins, "ships", lambda path: path.parent == tmp_path)
    plugins._read_code.cache_clear()
    assert digest_of({"room/a.py": old}) == digest_of({"hall/b.py": new}) != digest_of({"hall/b.py": other})
    first, last = "from sasgeo_bench.a.room import b, c", "from sasgeo_bench.b.room import a"
    old.write_text(f'"""Words."""\n{first}\n{last}\nx = 1')
    new.write_text(f'"""Others."""\n{last}\nfrom sasgeo_bench.c import c\nfrom sasgeo_bench.d import b\nx = 1')
    other.write_text(f'"""Words."""\n{first}\nx = 1')  # one name less
    plugins._read_code.cache_clear()
    assert digest_of({"a.py": old}) == digest_of({"b.py": new}) != digest_of({"a.py": other})
    data = tmp_path / "weights.npz"
    data.write_bytes(b"1")
    renamed = data.with_name("others.npz")
    renamed.write_bytes(b"1")
    assert digest_of({"room/w": data}) == digest_of({"hall/w": data}) != digest_of({"hall/w": renamed})
    plugins._read_code.cache_clear()


def test_in_a_checkout_of_ours_a_plugin_has_the_hash_that_it_has_elsewhere(lay, tmp_path, monkeypatch):
    text = "from sasgeo_bench.search.find import score_at\n" + MODULE
    elsewhere = lay({"plugin.py": text})
    root_of = plugins._root_of
    monkeypatch.setattr(plugins, "_root_of", lambda one: tmp_path if ships(one.path) else root_of(one))
    assert lay({}) == elsewhere


def test_what_ships_has_a_hash_by_its_folder_and_the_rooms_that_count_are_there():
    assert matcher_code("random") == matcher_code("prior_centre") != matcher_code("sasgeo")
    assert segmenter_code("colour_thresholds") != matcher_code("raster_uniform")
    rooms = (*TOOLS, *SEGMENTER_TOOLS)
    assert all(find_spec(f"sasgeo_bench.{tool}") for tool in rooms), "a file that moved would drop out of the hash"
    assert all(plugins._room_files(tool) for tool in rooms)
