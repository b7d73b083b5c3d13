# SPDX-License-Identifier: Apache-2.0
"""The house (docs/README.md) as a total order: a file of sasgeo_bench imports only files above it."""

import ast
from collections.abc import Iterator, Mapping
from pathlib import Path

import pytest

PACKAGE = "sasgeo_bench"
ROOT = Path(__file__).parents[1] / PACKAGE

# A room is a file, or a folder with its files in their own order: what stands above may be imported, what stands below
# may not. A folder with no files named is one whose inside is not built yet: its files get their order when they come.
# Rooms may be listed before they are built. The package's __init__ stands last: it gathers the public names, and
# nothing imports it.
HOUSE: dict[str, tuple[str, ...] | None] = {
    "texts": None,
    "errors": None,
    "processes": None,
    "progress": None,
    "tomlfile": None,
    "angles": None,
    "bounds": None,
    "pose": None,
    "grid": None,
    "taxonomy": None,
    "features": None,
    "extract": (
        "locate",
        "snapshot",
        "coverage",
        "cuts",
        "sea",
        "mapped",
        "scan",
        "read",
        "lifecycle",
        "history",
        "sketch",
        "morphology",
        "town",
    ),
    "regionfile": None,
    "layers": None,
    "evidence": None,
    "ageing": ("pairing", "rates", "measure", "ratebook"),
    "shapes": None,
    "network": None,
    "graph": None,
    "vectors": None,
    "region": None,
    "search": ("field", "plan", "space", "dense", "sight", "find"),
    "camera": None,
    "imagery": None,
    "perturb": (
        *("base", "fields", "objects", "resample", "detector"),
        *("perception", "occlusion", "border", "wedge", "glare", "canopy", "adversarial", "false_unknown"),
        *("local_warp", "tilt", "crop", "rotation", "scale", "line_width", "season", "ageing"),
    ),
    "query": None,
    "split": None,
    "trajectory": None,
    "duplicates": None,
    "pipelinefile": None,
    "twin": None,
    "privateseed": None,
    "suites": (
        *("base", "sites", "mining", "vectors", "twins"),
        *("clean", "occlusion", "false_unknown", "local_warp", "topology_twins", "instance_twins", "grade_separation"),
        *("no_priors", "real_age", "synthetic_age", "volatile_lure", "growth", "season", "stable_not_distinctive"),
        *("alias", "absent", "board_controls", "all_suites"),
    ),
    "matcher": None,
    "results": None,
    "rejector": None,
    "submissionfile": None,
    "store": (
        *("parquetfile", "jsonfile", "layerfile", "regiondir", "taskrows", "taskdir", "runrows", "failures"),
        *("learnedfile", "rundir", "submissiondir", "fileset", "packabout", "boardfile", "packrows", "packdir"),
        *("packfile", "svgfile", "sitedir", "pluginfiles", "seedfile"),
        *(
            "canvas",
            "preview",
            "picture",
            "sheet",
            "caseplot",
            "weightplot",
            "lookalikeplot",
            "splitmap",
            "paperplot",
            "boardplot",
            "ageingplot",
            "ageingfile",
            "ratebookfile",
            "catalog",
        ),
        *("columntexts", "releasedir", "stacfile", "croissantfile", "datasetcard", "datasheet"),
    ),
    "build": None,
    "request": None,
    "draw": None,
    "tasks": None,
    "requests": None,
    "panels": None,
    "paper": ("tiles", "windows", "trials", "task"),
    "doctor": None,
    "sasgeo": (
        *("rates", "seasons", "stamps", "temper", "weights", "raster", "distinct"),
        *("kinds", "nodes", "skeleton", "observed", "pairs", "mapped", "ratios", "graph", "tuples", "descriptor"),
        *("temporal", "joint", "learnt", "arms", "reading", "learning"),
        *("integrity", "protection", "conformal", "frame", "rejectors", "matchers", "variants"),
    ),
    "worth": None,
    "lookalike": None,
    "plugins": None,
    "run": (
        *("kernel", "seccomp", "landlock", "root", "sandbox", "wire", "replies", "launch", "serve", "child", "beside"),
        *("cgroup", "memory", "worker", "oracle"),
        *("lesson", "plan", "teach", "schedule", "answers", "cluster", "runner"),
    ),
    "metrics": (
        *("base", "ranking", "pose", "decisions", "integrity", "calibration"),
        *("sequence", "cost", "draws", "intervals", "protection", "compare", "power"),
    ),
    "validate": None,
    "score": None,
    "report": (
        *("measures", "rows", "strata", "steps", "tables", "rejection", "integrity", "contrasts", "falsifiers"),
        *("reproduction", "controls", "costs", "text", "latex", "protection", "cases"),
        *("paper", "papertext", "plottables", "pools", "axes", "plots", "poolplots"),
        *("sitetable", "sitewords", "sitesource", "siteboard", "sitepages", "coast", "siteplots", "site"),
    ),
    "boardtasks": None,
    "entries": None,
    "contestants": None,
    "judging": None,
    "apart": None,
    "privateboard": None,
    "boards": None,
    "boardfigures": None,
    "casepanels": None,
    "boardpictures": None,
    "runcases": None,
    "packing": None,
    "submissions": None,
    "paperboard": None,
    "pipeline": None,
    "boardshape": None,
    "publish": None,
    "release": None,
    "scaffold": None,
    "testing": None,
    "cli": (
        *("console", "regions", "ageing", "queries", "looking", "weights", "matchers", "runs", "submissions"),
        *("boards", "publishing", "releasing"),
        "program",
    ),
}

# The rooms that touch the disk, and the few calls others may make, each with its reason.
FILE_ROOMS = ("extract", "imagery", "store")
FILE_EXCEPTIONS = {
    ("taxonomy", "read_text"): "reads the taxonomy.toml packaged beside it",
    ("run.sandbox", "open"): "opens what the kernel asks for: identity maps, and who came from whom",
    ("run.landlock", "open"): "opens paths to be allowed, as the kernel asks for",
    ("run.root", "open"): "makes files to mount others on, and reads which mounts there are",
    ("run.cgroup", "read_text"): "reads what the kernel counts",
    ("run.cgroup", "write_text"): "writes limits for the kernel",
    ("run.memory", "read_bytes"): "reads what the kernel says of a process",
    ("run.serve", "read_bytes"): "hashes the plugin's own code",
}
FILE_CALLS = frozenset(
    {
        *("open", "fdopen", "mkstemp", "NamedTemporaryFile", "TemporaryFile"),
        *("read_text", "write_text", "read_bytes", "write_bytes"),
        *("read_parquet", "to_parquet", "write_table", "read_table", "read_csv", "to_csv", "read_file", "to_file"),
        *("savefig", "imsave", "imread", "savez", "savez_compressed", "tofile", "fromfile", "memmap"),
    }
)


def room_order(house: Mapping[str, tuple[str, ...] | None]) -> list[str]:
    """Every module name the house knows, top to bottom, as `errors` or `extract.read`; a folder ends with itself."""
    order = []
    for room, files in house.items():
        order += [f"{room}.{name}" for name in files or ()]
        order.append(room)
    return order


def module_name(path: str) -> str:
    """`extract/read.py` -> `extract.read`; `extract/__init__.py` -> `extract`; `__init__.py` -> the empty name."""
    parts = path.removesuffix(".py").split("/")
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


def imported_modules(tree: ast.AST, modules: set[str]) -> Iterator[tuple[int, str]]:
    """Line and module of every import of our own package, wherever in the file it stands."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom) and node.level:
            names = [f"{PACKAGE}.{'.' * node.level}{node.module or ''}"]  # relative: in no room, so always a fault
        elif isinstance(node, ast.ImportFrom):
            # `from sasgeo_bench.extract import read` takes a module, `from sasgeo_bench.grid import Grid` a name.
            full = [f"{node.module}.{alias.name}" for alias in node.names]
            names = [name if _inside(name) in modules else str(node.module) for name in full]
        else:
            continue
        for name in names:
            if name == PACKAGE or name.startswith(f"{PACKAGE}."):
                yield node.lineno, _inside(name)


def _inside(name: str) -> str:
    """`sasgeo_bench.grid` -> `grid`; the package itself -> the empty name."""
    return name.removeprefix(PACKAGE).removeprefix(".")


def house_faults(sources: Mapping[str, str], house: Mapping[str, tuple[str, ...] | None]) -> list[str]:
    """One line for each file without a room and each import of something not above; `sources` maps path to text."""
    order = room_order(house)
    names = {path: module_name(path) for path in sources}
    modules = {*order, *names.values()} - {""}
    faults = []
    for path, name in sorted(names.items()):
        if name and name not in order:
            faults.append(f"{path} is in no room of the house: add it to HOUSE in tests/test_architecture.py")
            continue
        place = order.index(name) if name else len(order)
        for line, target in sorted(set(imported_modules(ast.parse(sources[path]), modules))):
            if target not in order or order.index(target) >= place:
                shown = f"{PACKAGE}.{target}" if target else PACKAGE
                faults.append(f"{path}:{line} imports {shown}, which does not stand above it")
    return faults


def file_faults(sources: Mapping[str, str]) -> list[str]:
    """One line for each call that opens a file outside the rooms that may."""
    faults = []
    for path, text in sorted(sources.items()):
        name = module_name(path)
        if name.split(".")[0] in FILE_ROOMS:
            continue
        for node in ast.walk(ast.parse(text)):
            if not isinstance(node, ast.Call):
                continue
            function = node.func
            called = getattr(function, "id", None) or getattr(function, "attr", None)
            if called in FILE_CALLS and (name, called) not in FILE_EXCEPTIONS:
                faults.append(f"{path}:{node.lineno} calls {called}(): only {', '.join(FILE_ROOMS)} open files")
    return faults


# Rooms that draw what is asked, and rooms that answer it: a scorer that used a generator's code would know too much.
GENERATORS = ("ageing", "perturb", "suites", "twin", "draw", "tasks")
SCORERS = ("search", "sasgeo")


def shared_code_faults(sources: Mapping[str, str]) -> list[str]:
    """One line for each import of a generator in a scorer, and the other way round."""
    modules = {module_name(path) for path in sources}
    faults = []
    for path, text in sorted(sources.items()):
        room = module_name(path).split(".")[0]
        barred = GENERATORS if room in SCORERS else SCORERS if room in GENERATORS else ()
        for line, target in imported_modules(ast.parse(text), modules):
            if target.split(".")[0] in barred:
                faults.append(f"{path}:{line} imports {target}: generator and scorer share no code")
    return faults


@pytest.fixture(scope="module")
def sources() -> dict[str, str]:
    """The files of the package, by their path inside it."""
    return {path.relative_to(ROOT).as_posix(): path.read_text(encoding="utf-8") for path in ROOT.rglob("*.py")}


def test_every_file_has_a_room_and_imports_only_what_stands_above_it(sources: dict[str, str]) -> None:
    faults = house_faults(sources, HOUSE)
    assert not faults, "\n".join(faults)


def test_generator_and_scorer_share_no_code(sources: dict[str, str]) -> None:
    assert {module_name(path).split(".")[0] for path in sources} >= {*GENERATORS, *SCORERS}
    faults = shared_code_faults(sources)
    assert not faults, "\n".join(faults)


def test_only_the_rooms_that_may_open_files_do_so(sources: dict[str, str]) -> None:
    faults = file_faults(sources)
    assert not faults, "\n".join(faults)


def test_every_exception_for_files_is_still_needed(sources: dict[str, str]) -> None:
    unused = [
        f"{name}: {called}"
        for name, called in FILE_EXCEPTIONS
        if f"{called}(" not in sources.get(f"{name.replace('.', '/')}.py", "")
    ]
    assert unused == []


@pytest.mark.parametrize(
    ("path", "text", "fault"),
    [
        ("grid.py", "import sasgeo_bench.cli", "grid.py:1 imports sasgeo_bench.cli"),
        ("grid.py", "from sasgeo_bench import cli", "grid.py:1 imports sasgeo_bench.cli"),
        ("grid.py", "from sasgeo_bench.grid import Grid", "grid.py:1 imports sasgeo_bench.grid"),
        ("grid.py", "def late():\n    from sasgeo_bench.layers import burn", "grid.py:2 imports sasgeo_bench.layers"),
        ("grid.py", "from .errors import GridError", "grid.py:1 imports sasgeo_bench..errors"),
        ("grid.py", "import sasgeo_bench as sgb", "grid.py:1 imports sasgeo_bench, which"),
        ("grid.py", "from sasgeo_bench.unknown import thing", "grid.py:1 imports sasgeo_bench.unknown"),
        (
            "extract/locate.py",
            "from sasgeo_bench.extract import read",
            "extract/locate.py:1 imports sasgeo_bench.extract.read",
        ),
        ("extract/read.py", "import sasgeo_bench.extract", "extract/read.py:1 imports sasgeo_bench.extract, which"),
        ("kitchen.py", "", "kitchen.py is in no room"),
        ("extract/cellar.py", "", "extract/cellar.py is in no room"),
        ("angles/left.py", "", "angles/left.py is in no room"),
    ],
)
def test_a_made_up_violation_is_found(path: str, text: str, fault: str) -> None:
    house = {"errors": None, "grid": None, "angles": None, "extract": ("locate", "read"), "layers": None, "cli": None}
    faults = house_faults({path: text}, house)
    assert len(faults) == 1
    assert faults[0].startswith(fault)


def test_imports_of_rooms_above_and_of_other_packages_are_no_violation() -> None:
    sources = {
        "__init__.py": "from sasgeo_bench.cli import main",
        "cli.py": "import numpy as np\nfrom sasgeo_bench.extract import Extract\nfrom sasgeo_bench import grid",
        "extract/__init__.py": "from sasgeo_bench.extract.read import Extract",
        "extract/read.py": "from sasgeo_bench.extract import locate\nfrom sasgeo_bench.grid import Grid",
        "extract/locate.py": "from sasgeo_bench.errors import ExtractError",
    }
    house = {"errors": None, "grid": None, "extract": ("locate", "read"), "cli": None}
    assert house_faults(sources, house) == []


def test_made_up_shared_code_is_found() -> None:
    files = {"suites/base.py": "from sasgeo_bench.search.find import find", "perturb/base.py": "import numpy"}
    other = {
        "sasgeo/arms.py": "from sasgeo_bench.suites import base",
        "sasgeo/rates.py": "from sasgeo_bench import grid",
    }
    assert shared_code_faults(files) == ["suites/base.py:1 imports search.find: generator and scorer share no code"]
    assert len(shared_code_faults(other)) == 1


@pytest.mark.parametrize("call", ["open('a')", "Path('a').read_text()", "rasterio.open('a')", "table.to_parquet('a')"])
def test_a_made_up_file_access_is_found(call: str) -> None:
    assert len(file_faults({"grid.py": call})) == 1
    assert file_faults({"store/region_dir.py": call}) == []
