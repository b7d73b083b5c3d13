# SPDX-License-Identifier: Apache-2.0
"""The house (docs/README.md): folders in the order of the pipeline, each of which imports only those above it."""

import ast
import re
from collections.abc import Iterator, Mapping, Sequence
from functools import cache
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

import pytest

import sasgeo_bench

PACKAGE = "sasgeo_bench"
ROOT = Path(sasgeo_bench.__file__).parent

# A room is a folder, or a file beside the folders. What stands above may be imported, what stands below may not; a file
# that is added to a folder edits nothing here.
HOUSE = (
    # What any program needs.
    "core",
    # The pipeline.
    *("geometry", "osm", "regions", "ageing", "search", "sensing", "flights", "tasks"),
    *("matching", "sasgeo", "running", "observing"),
    *("scoring", "boards", "exchange", "experiments", "cli", "__main__"),
)

# What draws the queries, and what answers them: a scorer that used a generator's code would know too much.
GENERATORS = ("ageing", "tasks.perturbations", "tasks.suites", "tasks.twin", "tasks.sampling", "tasks.build")
SCORERS = ("search", "sasgeo")
# Measures drawn queries by a plain search with even weights, and changes none of them.
MEASURES = ("tasks.suites.rivals",)


def module_name(path: str) -> str:
    """`osm/read.py` -> `osm.read`; `osm/__init__.py` -> `osm`; `__init__.py` -> the empty name."""
    parts = path.removesuffix(".py").split("/")
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


def room_of(module: str) -> str:
    return module.split(".", maxsplit=1)[0]


@cache
def import_nodes(text: str) -> tuple[ast.Import | ast.ImportFrom, ...]:
    """Return the imports of a file; several tests ask for those of every file, and to parse all takes seconds."""
    return tuple(node for node in ast.walk(ast.parse(text)) if isinstance(node, ast.Import | ast.ImportFrom))


def imported_modules(text: str, modules: set[str]) -> Iterator[tuple[int, str]]:
    """Line and module of every import of our own package, wherever in the file it stands."""
    for node in import_nodes(text):
        if isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom) and node.level:
            names = [f"{PACKAGE}.{'.' * node.level}{node.module or ''}"]  # relative: in no room, so always a fault
        else:
            # `from sasgeo_bench.osm import read` takes a module, `from sasgeo_bench.geometry.grid import Grid` a name.
            full = [f"{node.module}.{alias.name}" for alias in node.names]
            names = [name if inside(name) in modules else str(node.module) for name in full]
        for name in names:
            if name == PACKAGE or name.startswith(f"{PACKAGE}."):
                yield node.lineno, inside(name)


def inside(name: str) -> str:
    """`sasgeo_bench.geometry.grid` -> `geometry.grid`; the package itself -> the empty name."""
    return name.removeprefix(PACKAGE).removeprefix(".")


def house_faults(sources: Mapping[str, str], house: Sequence[str]) -> list[str]:
    """One line for each file without a room, and for each import of a room that does not stand above."""
    modules = {module_name(path) for path in sources}
    faults = []
    for path, text in sorted(sources.items()):
        room = room_of(module_name(path))
        if room and room not in house:
            faults.append(f"{path} is in no room of the house: put it into the folder of the noun that it makes")
            continue
        above = house[: house.index(room)] if room else house
        for line, target in sorted(set(imported_modules(text, modules))):
            if room_of(target) not in above and (room_of(target) != room or target not in modules):
                shown = f"{PACKAGE}.{target}" if target else PACKAGE
                faults.append(f"{path}:{line} imports {shown}, which does not stand above it")
    return faults


def circle(sources: Mapping[str, str]) -> list[str]:
    """Files that import each other in a circle, in order; none where there is no circle."""
    modules = {module_name(path) for path in sources}
    graph = {
        module_name(path): {target for _, target in imported_modules(text, modules)} - {module_name(path)}
        for path, text in sources.items()
    }
    try:
        TopologicalSorter(graph).prepare()
    except CycleError as error:
        return list(error.args[1])
    return []


def shared_code_faults(sources: Mapping[str, str]) -> list[str]:
    """One line for each import of a generator in a scorer, and the other way round."""
    modules = {module_name(path) for path in sources}
    faults = []
    for path, text in sorted(sources.items()):
        name = module_name(path)
        barred = GENERATORS if _is_in(name, SCORERS) else SCORERS if _is_in(name, GENERATORS) else ()
        barred = tuple(room for room in barred if room != "search") if _is_in(name, MEASURES) else barred
        for line, target in imported_modules(text, modules):
            if _is_in(target, barred):
                faults.append(f"{path}:{line} imports {target}: generator and scorer share no code")
    return faults


def _is_in(module: str, rooms: Sequence[str]) -> bool:
    return any(module == room or module.startswith(f"{room}.") for room in rooms)


@pytest.fixture(scope="module")
def sources() -> dict[str, str]:
    """The files of the package, by their path inside it."""
    return {path.relative_to(ROOT).as_posix(): path.read_text(encoding="utf-8") for path in ROOT.rglob("*.py")}


def test_every_file_has_a_room_and_imports_only_rooms_above_it(sources: dict[str, str]) -> None:
    faults = house_faults(sources, HOUSE)
    assert not faults, "\n".join(faults)


def test_the_package_imports_nothing_that_is_built_on_it(sources: dict[str, str]) -> None:
    built_on_it = re.compile(r"^\s*(?:from|import) sasgeo_(?:baselines|paper)\b", flags=re.MULTILINE)
    assert [path for path, text in sources.items() if built_on_it.search(text)] == []


def test_no_files_import_each_other_in_a_circle(sources: dict[str, str]) -> None:
    assert circle(sources) == []


def test_generator_and_scorer_share_no_code(sources: dict[str, str]) -> None:
    modules = {module_name(path) for path in sources}
    assert modules >= {*GENERATORS, *SCORERS, *MEASURES}
    faults = shared_code_faults(sources)
    assert not faults, "\n".join(faults)


@pytest.mark.parametrize(
    ("path", "text", "fault"),
    [
        ("osm/read.py", "import sasgeo_bench.cli", "osm/read.py:1 imports sasgeo_bench.cli"),
        ("osm/read.py", "from sasgeo_bench import cli", "osm/read.py:1 imports sasgeo_bench, which"),
        ("osm/read.py", "def late():\n    from sasgeo_bench.cli import main", "osm/read.py:2 imports sasgeo_bench.cli"),
        ("osm/read.py", "from .errors import GridError", "osm/read.py:1 imports sasgeo_bench..errors"),
        ("osm/read.py", "from sasgeo_bench.osm.unknown import thing", "osm/read.py:1 imports sasgeo_bench.osm.unknown"),
        ("errors.py", "from sasgeo_bench.osm import Extract", "errors.py:1 imports sasgeo_bench.osm"),
        ("kitchen/stove.py", "", "kitchen/stove.py is in no room"),
    ],
)
def test_a_made_up_violation_is_found(path: str, text: str, fault: str) -> None:
    faults = house_faults({path: text}, ("errors", "osm", "tasks", "cli"))
    assert len(faults) == 1
    assert faults[0].startswith(fault)


def test_imports_of_rooms_above_of_files_beside_and_of_other_packages_are_no_violation() -> None:
    files = {
        "__init__.py": "from sasgeo_bench.cli import main",
        "cli/__init__.py": "import numpy as np\nfrom sasgeo_bench.osm import Extract\nfrom sasgeo_bench import osm",
        "osm/__init__.py": "from sasgeo_bench.osm.read import Extract",
        "osm/read.py": "from sasgeo_bench.osm import locate\nfrom sasgeo_bench.core.errors import ExtractError",
        "osm/locate.py": "from sasgeo_bench.core.errors import ExtractError",
    }
    assert house_faults(files, ("core", "osm", "cli")) == []
    assert circle(files) == []
    assert set(circle(files | {"osm/locate.py": "def late():\n    import sasgeo_bench.osm.read"})) >= {"osm.read"}


def test_made_up_shared_code_is_found() -> None:
    files = {"tasks/suites/base.py": "from sasgeo_bench.search.find import find", "tasks/query.py": "import numpy"}
    other = {
        "sasgeo/arms.py": "from sasgeo_bench.tasks.suites import base",
        "sasgeo/rates.py": "from sasgeo_bench.tasks.query import Query",
    }
    found = "tasks/suites/base.py:1 imports search.find: generator and scorer share no code"
    assert shared_code_faults(files) == [found]
    assert len(shared_code_faults(other)) == 1
    (file,) = (f"{name.replace('.', '/')}.py" for name in MEASURES)
    assert shared_code_faults({file: "from sasgeo_bench.search.find import search"}) == []
    assert len(shared_code_faults({file: "from sasgeo_bench.sasgeo.raster import score"})) == 1
