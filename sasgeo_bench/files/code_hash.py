# SPDX-License-Identifier: Apache-2.0
"""The hash of the code that makes a plugin's answers: taken from files, and never told by the plugin.

Rows are kept as long as it stays. Words change nothing: Python is hashed as its syntax tree, without comments,
docstrings and positions, and alike by every version of Python.
"""

import ast
import hashlib
import os
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache, partial
from importlib.util import resolve_name
from pathlib import Path
from typing import Any, Final

from sasgeo_bench.errors import MatchError, counted
from sasgeo_bench.files.paths import plain_file
from sasgeo_bench.files.plugin_files import (
    SHIPPED_MODULES,
    Home,
    file_of,
    find_module,
    home_of,
    import_paths,
    is_installed,
    is_shipped,
    ships,
)
from sasgeo_bench.files.plugins import CARD_FILE, code_of

_PACKAGE: Final = Path(__file__).resolve().parents[1]
_OURS: Final = _PACKAGE.name
MOST_FILES: Final = 20_000  # of a plugin
_CACHES: Final = ("__pycache__",)
_WORDS: Final = (CARD_FILE,)  # its version and places are told apart by themselves; all else in it is for readers
_PYTHON: Final = ".py"
_MOST_BITS: Final = 2000  # of a number that Python writes in decimal digits, however it is set up
_IMPORTERS: Final = ("import_module", "__import__")


def plugin_code(spec: str, *groups: str, tools: Collection[str] = (), always: Collection[str] = ()) -> str:
    """Return the SHA-256 of the code of a plugin, by name in one of some groups or `module:Class`, and of its tools.

    Its own is all of the outermost package or module that it lies in, and of modules beside it that these import; of
    one that ships, the files of its folder. Files that are no Python count by their bytes. `tools` are modules of this
    package that count where the plugin imports them, `always` those that count anyhow. Raise `MatchError` if there is
    no such code.
    """
    module, name = code_of(spec, *groups)
    own = _own_files(spec, module, name, import_paths(spec))
    rooms = sorted({*always, *_rooms(own.values(), tools)})
    used = {f"{_OURS}:{_shown(path)}": path for room in rooms for path in _room_files(room)}
    return digest_of(own | used)


def digest_of(files: Mapping[str, Path]) -> str:
    """Return the SHA-256 of some files and the names they are known by; of those that ship, modules have no names.

    So code that ships can move to other files, and is the same code.
    """
    digest = hashlib.sha256()
    for part in sorted(_label(name, path).encode() + b"\0" + file_digest(path) for name, path in files.items()):
        digest.update(part)
    return digest.hexdigest()


def _label(name: str, path: Path) -> str:
    if not ships(path):
        return name
    return "" if path.suffix == _PYTHON else path.name


def file_digest(path: Path) -> bytes:
    """Return the SHA-256 of a file: of Python as its syntax tree; raise `MatchError` if it cannot be read."""
    return _file_code(path).digest


@dataclass(frozen=True, slots=True)
class _Code:
    """What is told of a file: its SHA-256, and the modules that it imports."""

    digest: bytes
    imports: frozenset[str] = frozenset()


def _file_code(path: Path) -> _Code:
    try:
        about = path.stat()
        return _read(path, about.st_size, about.st_mtime_ns)
    except OSError as error:
        raise MatchError(
            f"{path}, which is code of a plugin, cannot be read ({error.strerror}): check your rights"
        ) from error


@lru_cache(maxsize=4096)
def _read(path: Path, size: int, changed_ns: int) -> _Code:
    del size, changed_ns
    if path.suffix != _PYTHON:
        with plain_file(path).open("rb") as file:
            return _Code(hashlib.file_digest(file, "sha256").digest())
    data = plain_file(path).read_bytes()
    tree = _tree(data)
    if tree is None:
        return _Code(hashlib.sha256(data).digest())
    imports = _imports(tree)
    if ships(path):
        # Take out of a tree where the names of our own modules come from
        for node in ast.walk(tree):
            if isinstance(node, ast.ImportFrom) and node.module and node.module.partition(".")[0] in SHIPPED_MODULES:
                node.module = None
    return _Code(hashlib.sha256(_shape(tree).encode(errors="replace")).digest(), imports)


def _tree(data: bytes) -> ast.Module | None:
    """Parse a file; None if it is no Python of this version."""
    try:
        return ast.parse(data)
    except (SyntaxError, ValueError, RecursionError, MemoryError):
        return None


def _shape(tree: ast.AST) -> str:
    """Return what a syntax tree says: types, fields and values, without docstrings, and what is empty or no code."""
    said: list[str] = []
    left: list[Any] = [tree]  # what is still to be said, last first: trees and lists, or how the rest is said
    while left:
        item = left.pop()
        if isinstance(item, str):
            said.append(item)
        elif isinstance(item, list):
            said.append("[")
            left.append("]")
            left += [_part(one) for one in reversed(item)]
        else:
            said.append(f"{type(item).__name__}(")
            left.append(")")
            for field in reversed(item._fields):
                value = getattr(item, field, None)
                # Fields of a syntax tree that change nothing
                if (
                    field in ("kind", "type_comment")
                    or value == []
                    or (value is None and not isinstance(item, ast.Constant))
                ):
                    continue
                if field == "body" and isinstance(value, list) and _has_docstring(item):
                    value = value[1:]
                left += [_part(value), f"{field}="]
    return "".join(said)


def _part(value: object) -> object:
    if isinstance(value, ast.AST | list):
        return value
    return f"{hex(value) if isinstance(value, int) and value.bit_length() > _MOST_BITS else repr(value)};"


def _has_docstring(node: ast.AST) -> bool:
    if not isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef):
        return False
    first = node.body[0] if node.body else None
    return isinstance(first, ast.Expr) and isinstance(first.value, ast.Constant) and isinstance(first.value.value, str)


def _own_files(spec: str, module: str, name: str, paths: Sequence[str]) -> dict[str, Path]:
    found: dict[str, Path] = {}
    for one in _ways(module, name, paths):
        if one.partition(".")[0] == _OURS:
            path = file_of(find_module(one, paths))
            found |= {} if path is None else _named(_OURS, path.parent)
            continue
        home = home_of(one, paths)
        if home is not None:
            found |= _named(home.name, home.path) | _beside(home, paths)
    if not found:
        raise MatchError(
            f"{spec}: no file of {module} can be found: rows are kept by its code, so it must lie on the disk"
        )
    if len(found) > MOST_FILES:
        raise MatchError(f"{spec}: the package of {module} holds {counted(len(found), 'file')}, {MOST_FILES} at most")
    return found


def _ways(module: str, name: str, paths: Sequence[str]) -> list[str]:
    """Return the module of a class, and those that it is handed on from by `from ... import`."""
    ways, wanted = [module], name.partition(".")[0]
    for _ in range(20):  # at most 20 steps from a name to where its class is
        path = file_of(find_module(ways[-1], paths))
        tree = None if path is None or path.suffix != _PYTHON else _tree(plain_file(path).read_bytes())
        found = next(
            (
                (_absolute(node, ways[-1], is_package=path is not None and path.name == "__init__.py"), alias.name)
                for node in ast.walk(tree or ast.Module([], []))
                if isinstance(node, ast.ImportFrom)
                for alias in node.names
                if (alias.asname or alias.name) == wanted
            ),
            None,
        )
        if found is None or found[0] in ways:
            break
        source, wanted = found
        ways.append(_public().get(wanted, source) if source == _OURS else source)
    return ways


def _named(label: str, path: Path) -> dict[str, Path]:
    """Return a file, or the files of a folder, by name, without what Python itself has compiled, and hidden ones."""
    # A linked folder counts where it leads to one beside the package, which its process may read.
    if path.is_file():
        return {f"{label}{path.suffix}": path}
    found: dict[str, Path] = {}
    seen: set[Path] = set()
    for parent, folders, files in os.walk(path, followlinks=True):
        real = Path(parent).resolve()
        if real in seen or not real.is_relative_to(path.parent):
            folders.clear()
            continue
        seen.add(real)
        folders[:] = sorted(one for one in folders if one not in _CACHES and not one.startswith("."))
        for one in files:
            inner = Path(parent, one)
            is_compiled = one.endswith(".pyc") and one[:-1] in files  # one without its source is what runs
            if not one.startswith(".") and not is_compiled and one not in _WORDS and inner.is_file():
                found[f"{label}/{inner.relative_to(path).as_posix()}"] = inner
        if len(found) > MOST_FILES:
            break
    return found


def _beside(home: Home, paths: Sequence[str]) -> dict[str, Path]:
    """Return the files of modules beside one of somebody's own, and that it imports, but what is installed or ships."""
    # In a checkout of ours, our own packages lie beside it; what counts of them are its tools, as everywhere.
    root = _root_of(home)
    if is_installed(root) or is_shipped(home.name, paths):
        return {}
    found: dict[str, Path] = {}
    find = _finder(paths)
    seen, left = {home.path}, [home]
    while left:
        here = left.pop()
        own = _named(here.name, here.path).values()
        names = {name for path in own if path.suffix == _PYTHON for name in _file_code(path).imports}
        package = here.name.rpartition(".")[0]
        for other in {find(_resolved(name, package)) for name in names}:
            if other is None or other.path in seen:
                continue
            seen.add(other.path)
            if _root_of(other) == root and not ships(other.path):
                found |= _named(other.name, other.path)
                left.append(other)
    return found


def _finder(paths: Sequence[str]) -> Callable[[str], Home | None]:
    """Return `home_of` on some paths; each place is looked for once, for it is asked of every import of every file."""
    find = lru_cache(maxsize=None)(partial(home_of, paths=paths))

    def home(module: str) -> Home | None:
        return find(module.partition(".")[0]) or find(module)  # most lie in a package, whose home is theirs

    return home


def _root_of(home: Home) -> Path:
    """Return the folder on the import path that holds a module: above those without `__init__.py` that it lies in."""
    above = home.path.parents
    return above[min(home.name.count("."), len(above) - 1)]


def _resolved(name: str, package: str) -> str:
    """Return the whole name of a module that is imported within a package; empty where it leads out of it."""
    try:
        return resolve_name(name, package)
    except ImportError:
        return ""


def _rooms(files: Iterable[Path], tools: Collection[str]) -> set[str]:
    rooms: set[str] = set()
    left = [path for path in files if path.suffix == _PYTHON]
    while left:
        for name in _file_code(left.pop()).imports:
            module = _public().get(name.removeprefix(f"{_OURS}."), name).removeprefix(f"{_OURS}.")
            room = next((tool for tool in tools if f"{module}.".startswith(f"{tool}.")), None)
            if room is not None and room not in rooms:
                rooms.add(room)
                left += _room_files(room)
    return rooms


def _imports(tree: ast.Module) -> frozenset[str]:
    """Return the modules that a file imports anywhere, and names that it takes out of this package as a whole."""
    found: set[str] = set()
    known_as = set()
    taken = []
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
            known_as |= {alias.asname or _OURS for alias in node.names if alias.name == _OURS}
        elif isinstance(node, ast.ImportFrom):
            source = f"{'.' * node.level}{node.module or ''}"
            found |= {source, *(f"{source.rstrip('.')}.{alias.name}" for alias in node.names)} - {"."}
        elif isinstance(node, ast.Call) and node.args and isinstance(node.args[0], ast.Constant):
            called = getattr(node.func, "attr", getattr(node.func, "id", ""))
            found |= {str(node.args[0].value)} - {""} if called in _IMPORTERS else set()
        elif isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name):
            taken.append((node.value.id, node.attr))
    return frozenset(found | {f"{_OURS}.{name}" for whole, name in taken if whole in known_as})


def _absolute(node: ast.ImportFrom, module: str, *, is_package: bool) -> str:
    """Return the module that `from ... import` names, seen from another one."""
    if not node.level:
        return str(node.module)
    package = module if is_package else module.rpartition(".")[0]
    return _resolved("." * node.level + (node.module or ""), package)


@lru_cache(maxsize=1)
def _public() -> Mapping[str, str]:
    tree = ast.parse((_PACKAGE / "__init__.pyi").read_bytes())
    froms = [node for node in tree.body if isinstance(node, ast.ImportFrom)]
    return {alias.name: f"{_OURS}.{node.module}" for node in froms for alias in node.names}


def _room_files(room: str) -> list[Path]:
    place: Any = _PACKAGE.joinpath(*room.split("."))
    files = place.rglob("*.py") if place.is_dir() else (place.with_suffix(end) for end in (_PYTHON, ".toml"))
    return sorted(path for path in files if path.is_file())


def _shown(path: Path) -> str:
    return path.relative_to(_PACKAGE).as_posix()
