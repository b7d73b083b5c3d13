# SPDX-License-Identifier: Apache-2.0
"""The public names: each is there, none costs anything before it is asked for, and plugins need no others."""

import ast
import inspect
import subprocess
import sys
from contextlib import contextmanager
from pathlib import Path

import pytest
import sasgeo_baselines

import sasgeo_bench as sgb
from sasgeo_bench.cli.program import load
from sasgeo_bench.core.errors import SasgeoError
from sasgeo_bench.core.progress import reporting
from sasgeo_bench.matching.scaffold import package_files
from sasgeo_bench.regions.region_files import read_region

ROOT = Path(__file__).parents[1]
STUB = ast.parse(Path(sgb.__file__).with_name("__init__.pyi").read_text(encoding="utf-8"))
NAMES = [alias.name for node in STUB.body if isinstance(node, ast.ImportFrom) for alias in node.names]


def inner_imports(text):
    """Modules of the package that a file imports instead of public names."""
    nodes = list(ast.walk(ast.parse(text)))
    froms = [node.module or "" for node in nodes if isinstance(node, ast.ImportFrom)]
    plain = [alias.name for node in nodes if isinstance(node, ast.Import) for alias in node.names]
    return [name for name in (*froms, *plain) if name.startswith("sasgeo_bench.")]


def test_every_public_name_is_there_and_no_other():
    assert [name for name in NAMES if getattr(sgb, name) is None] == []
    assert set(NAMES) <= set(dir(sgb)) & set(sgb.__all__)
    with pytest.raises(AttributeError, match="Posse"):
        _ = sgb.Posse


def test_importing_the_package_imports_none_of_its_libraries():
    code = "import sys, sasgeo_bench; print({'numpy', 'pandas', 'shapely', 'pydantic'} & set(sys.modules))"
    ended = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=True)  # noqa: S603 - our own
    assert ended.stdout == "set()\n"


def test_baselines_and_a_new_plugin_need_public_names_alone():
    baselines = sorted(Path(sasgeo_baselines.__file__).parent.rglob("*.py"))
    assert [
        (path.name, found) for path in baselines if (found := inner_imports(path.read_text(encoding="utf-8")))
    ] == []
    files = package_files("matcher", "my-matcher")
    assert not [name for path, text in files.items() if path.endswith(".py") for name in inner_imports(text)]
    assert any("from sasgeo_bench import" in text for text in files.values())


STEPS = {
    "build-region": "build_region",
    "render-imagery": "render_imagery",
    "make-queries": "make_tasks",
    "run": "run",
    "score": "score",
    "publish": "publish",
}
OUTLETS = ("quiet", "log")  # flags of every command, of no function
NOT_FLAGS = ("say", "tell", "progress")  # where lines go, and what counts


@pytest.mark.parametrize(("command", "function"), STEPS.items())
def test_a_function_takes_the_words_of_the_flags_of_its_command(command, function):
    flags = {item.name: item for item in load(command).params if item.name not in OUTLETS}
    words = inspect.signature(getattr(sgb, function)).parameters
    assert list(words) == [*flags, *NOT_FLAGS]
    for name, flag in flags.items():
        assert flag.param_type_name == "argument" or f"--{name.replace('_', '-')}" in flag.opts
        assert flag.required == (words[name].default is inspect.Parameter.empty)
        assert flag.required or flag.default in (words[name].default, str(words[name].default))
        assert f"\n{name} : " in getattr(sgb, function).__doc__


@pytest.mark.slow
@pytest.mark.usefixtures("in_threads", "without_drawings", "plain_site")
def test_a_town_is_driven_from_region_to_site_by_functions_alone(tmp_path, capfd):
    out, notes = tmp_path / "out", []
    (folder,) = sgb.build_region("town-grid", out=out)
    region = sgb.read_region(str(folder))  # folders may be texts, as everywhere
    assert region.layers.any()
    tasks = sgb.make_tasks(suite="clean", regions="town-grid", n=1, out=str(out))
    assert tasks == (out / "tasks/clean/town-grid",)
    assert sgb.read_task(str(tasks[0]))["suite"] == "clean"
    truths = list(sgb.read_truths(str(out / "truth/clean/town-grid")))
    assert [truth.query_id for truth in truths] == [query.query_id for query in sgb.read_queries(str(tasks[0]))]
    for matcher in (names := {"oracle_pose", "prior_centre"}):
        with reporting(notes.append):
            report = sgb.run(matcher=matcher, tasks=tasks, out=out)
        assert report.counts == {"ok": len(list(sgb.read_queries(tasks[0])))}
        answers = list(sgb.read_predictions(str(report.folders[0])))
        assert len(answers) == len(truths)
    assert any("ok" in line for line in notes)
    board = sgb.score(predictions=out / "runs", draws=100, cases=False, out=out)
    assert set(board.scores["matcher"]) == names
    site = sgb.publish(board=out / "boards/board", into=tmp_path / "site")
    assert (site.folder / "index.html").is_file()
    assert capfd.readouterr() == ("", "")


def test_a_dry_run_returns_the_folders_and_writes_none(tmp_path):
    plan = []
    folders = sgb.build_region(["town-grid", "town-suburb"], out=tmp_path, dry_run=True, say=plan.append)
    assert folders == (tmp_path / "regions/town-grid", tmp_path / "regions/town-suburb")
    assert "town-suburb" in plan[0]
    assert not list(tmp_path.iterdir())


SLOW = {"pandas", "geopandas", "rasterio", "pyproj", "pyarrow.compute", "pyarrow.parquet", "scipy", "matplotlib"}


@pytest.mark.parametrize(
    ("code", "unused"),
    [
        ("sasgeo_bench.running.serve", SLOW),
        ("sasgeo_bench.cli.doors", {"numpy", "pandas", "pydantic"}),
        ("sasgeo_bench.cli.regions", {"matplotlib", "scipy.optimize"}),
        ("sasgeo_bench.tasks.build", {"matplotlib", "scipy.interpolate", "scipy.signal", "scipy.stats"}),
        ("sasgeo_bench.running.serve_segmenter", SLOW - {"scipy"} | {"pyarrow"}),
        ("sasgeo_bench.cli.observing", {"geopandas", "matplotlib", "pandas", "sklearn", "scipy.stats"}),
        ("sasgeo_bench.sasgeo.variants", {"matplotlib", "sklearn", "scipy.stats"}),
        ("sasgeo_baselines.map_density_prior", {"pandas", "scipy"}),
    ],
)
def test_a_process_imports_slow_libraries_only_where_it_uses_them(code, unused):
    code = f"import sys, {code}; print({unused!r} & set(sys.modules))"
    ended = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=True)  # noqa: S603 - our own
    assert ended.stdout == "set()\n"


def test_features_and_graph_of_a_stored_region_are_read_when_they_are_first_asked_for(towns):
    entered = []

    @contextmanager
    def around():
        entered.append("read")
        yield

    region = read_region(towns / "regions/town-grid", around=around)
    assert region.layers.any()
    assert entered == []
    assert region.graph.nodes is region.graph.nodes
    assert region.features is region.features
    assert entered == ["read", "read"]


READERS = (
    *("read_board", "read_card", "read_imagery", "read_predictions", "read_queries", "read_region", "read_task"),
    *("read_truths", "build_region", "load_matcher", "load_rejector", "load_segmenter", "load_tracker", "plot_region"),
)


@pytest.mark.parametrize("name", READERS)
def test_what_is_no_folder_or_no_name_is_refused_in_a_line_of_ours(tmp_path, monkeypatch, name):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "file").write_text("x", encoding="utf-8")
    (tmp_path / "folder").mkdir()
    for given in (5, 1.5, None, b"x", object(), "nowhere", "a\0b", "file", "folder"):
        with pytest.raises(SasgeoError) as refused:
            next(iter(getattr(sgb, name)(given)))  # a reader of rows begins when the first is asked for
        assert "\n" not in str(refused.value)
