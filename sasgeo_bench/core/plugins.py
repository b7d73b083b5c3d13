# SPDX-License-Identifier: Apache-2.0
"""Find plugins by the name of an entry point, or by module:Class; built-in ones win a clash of names."""

import ast
import difflib
import hashlib
import importlib
import json
import os
import re
import site
import sys
import sysconfig
import warnings
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import lru_cache, partial
from importlib.machinery import ModuleSpec, PathFinder
from importlib.metadata import Distribution, EntryPoint, distributions
from importlib.util import resolve_name
from pathlib import Path
from typing import Any, Final
from urllib.parse import unquote, urlsplit

from sasgeo_bench.core.errors import MatchError, SasgeoError, counted
from sasgeo_bench.core.paths import plain_file
from sasgeo_bench.core.texts import message_of, one_line

SHIPPED: Final = ("sasgeo-bench", "sasgeo-baselines", "sasgeo-paper")  # the distributions whose names win
SHIPPED_MODULES: Final = ("sasgeo_bench", "sasgeo_baselines", "sasgeo_paper")  # theirs
_SITE_NAMES: Final = ("site-packages", "dist-packages")
_HERE: Final = Path(__file__).resolve().parents[1]


@dataclass(frozen=True, slots=True)
class Home:
    """The outermost package or module that holds a plugin: its name, and its folder or file."""

    name: str
    path: Path


def import_paths(spec: str) -> list[str]:
    """Return where the process of a plugin imports from, in order.

    The working folder comes first for `module:Class`, which may lie there. For a registered name it comes last, or a
    file in it would stand for a library that the plugin was installed with.
    """
    here, others = os.getcwd(), [path for path in sys.path if path]  # noqa: PTH109
    return [here, *others] if ":" in spec else [*others, here]


def find_module(name: str, paths: Sequence[str]) -> ModuleSpec | None:
    """Find a module as `import` would on some paths; no code of it, nor of the packages around it, is run.

    >>> found = find_module("sasgeo_bench.core.plugins", [])
    >>> found is not None and found.origin == str(Path(__file__).with_name("plugins.py"))
    True
    """
    found, where = None, list(paths)
    for at, part in enumerate(name.split(".")):
        if at == 0 and part == _HERE.name:  # imported already, wherever the paths lead
            where = [str(_HERE)]
            continue
        if at > 0 and not where:
            return None
        # Further in by the last part of the name: by all of it, the packages around it would have to be imported.
        found = _spec(part, where, sys.meta_path if at == 0 else (PathFinder,))
        if found is None:
            return None
        where = list(found.submodule_search_locations or ())
    return found


def _spec(name: str, where: list[str], finders: Iterable[Any]) -> ModuleSpec | None:
    for finder in finders:
        with suppress(ImportError, AttributeError, ValueError, OSError, KeyError):
            found: ModuleSpec | None = finder.find_spec(name, where)
            if found is not None:
                return found
    return None


def file_of(found: ModuleSpec | None) -> Path | None:
    """Return the file of a module, or the archive that it lies in; None for one without."""
    if found is None or not found.origin or not found.has_location:
        return None
    path = Path(found.origin).resolve()
    return next((part for part in (path, *path.parents) if part.is_file()), None)


def home_of(module: str, paths: Sequence[str]) -> Home | None:
    """Return the outermost package or module that a module lies in; None if there is none.

    A folder without `__init__.py` is no package: what lies in it is found below.
    """
    parts = module.split(".")
    for at in range(len(parts)):
        name = ".".join(parts[: at + 1])
        found = find_module(name, paths)
        path = file_of(found)
        if path is not None and found is not None:
            is_package = found.submodule_search_locations is not None and path.name.startswith("__init__.")
            return Home(name, path.parent if is_package else path)
    return None


def read_entry_points(group: str) -> list[EntryPoint]:
    """Return the entry points of all that can be imported, our own first; of others that share a name the first found.

    A distribution counts as ours if it is installed, whatever one on PYTHONPATH calls itself.
    """
    ours: list[EntryPoint] = []
    others: list[EntryPoint] = []
    seen: set[str] = set()
    for found in distributions():
        points = found.entry_points.select(group=group)
        if not points:  # before its name is asked for, which is slow
            continue
        if _is_shipped(found):
            ours += points
        elif _module_of(found) not in seen:
            seen |= {_module_of(found)} - set(SHIPPED)
            others += points
    return [*dict.fromkeys(ours), *others]


def is_ours(point: EntryPoint) -> bool:
    """Return whether an entry point is one of those that ship."""
    return point.dist is not None and _is_shipped(point.dist)


def _is_shipped(found: Distribution) -> bool:
    """Return whether a distribution is one of ours: installed, and not only called so."""
    return _module_of(found) in SHIPPED and Path(str(found.locate_file(""))).resolve() in _bases()


@lru_cache(maxsize=64)  # its entry points share a distribution, which reads its metadata anew at every access
def _module_of(found: Distribution) -> str:
    return re.sub(r"[-_.]+", "-", found.name).lower()


@lru_cache(maxsize=1)
def _bases() -> tuple[Path, ...]:
    """Return the folders that the interpreter imports from by itself, without PYTHONPATH and the working folder."""
    sites = _sites()
    return tuple(dict.fromkeys(path.resolve() for path in (*sites, *_linked(sites), _HERE.parent)))


def _sites() -> list[Path]:
    with_user = [site.getusersitepackages()] if site.ENABLE_USER_SITE else []
    known = (*site.getsitepackages(), *with_user, sysconfig.get_path("purelib"), sysconfig.get_path("platlib"))
    return [Path(path) for path in dict.fromkeys(known) if Path(path).is_dir()]


def _linked(sites: Sequence[Path]) -> Iterator[Path]:
    """Yield the folders that installed files add to the path, and checkouts installed for editing."""
    for folder in sites:
        for path in sorted(folder.glob("*.pth")):
            with suppress(OSError, UnicodeDecodeError):
                lines = [line.strip() for line in plain_file(path).read_text(encoding="utf-8").splitlines()]
                yield from (folder / line for line in lines if line and not line.startswith(("#", "import")))
    for found in distributions(path=list(map(str, sites))):
        if found.name in SHIPPED:
            yield from _edited(found)


def _edited(found: Distribution) -> Iterator[Path]:
    with suppress(OSError, ValueError, KeyError, TypeError):
        about = json.loads(found.read_text("direct_url.json") or "{}")
        if about["dir_info"]["editable"]:
            yield Path(unquote(urlsplit(about["url"]).path))


def is_shipped(module: str, paths: Sequence[str]) -> bool:
    """Return whether a module is one of ours, and is read from where ours are installed.

    >>> is_shipped("sasgeo_bench.matching.controls.blind", []), is_shipped("numpy", sys.path)
    (True, False)
    """
    return module.partition(".")[0] in SHIPPED_MODULES and strange_file(module, paths) is None


def ships(path: Path) -> bool:
    """Return whether a file, its links followed, lies in one of our packages, where these are installed.

    >>> ships(Path(__file__).resolve()), ships(Path(os.__file__))
    (True, False)
    """
    return any(path.is_relative_to(folder) for folder in _shipped_folders())


@lru_cache(maxsize=1)
def _shipped_folders() -> tuple[Path, ...]:
    found = (file_of(find_module(name, [str(base) for base in _bases()])) for name in SHIPPED_MODULES)
    return (_HERE, *(path.parent for path in found if path is not None))  # ours is imported already


def strange_file(module: str, paths: Sequence[str]) -> Path | None:
    """Return the file that one of our modules would be read from, if that is not where ours are installed."""
    path = file_of(find_module(module, paths))
    top = module.partition(".")[0]
    if path is None or any(path.is_relative_to(base / top) or path.parent == base for base in _bases()):
        return None
    return path


def is_installed(folder: Path) -> bool:
    """Return whether a folder holds installed packages, and not code of somebody's own, installed for editing or not.

    >>> is_installed(Path(os.__file__).parent), is_installed(Path("/home/me/my-matcher/src"))
    (True, False)
    """
    known = (*_sites(), *(Path(sysconfig.get_path(name)) for name in ("stdlib", "platstdlib")))
    return folder.name in _SITE_NAMES or folder.resolve() in {path.resolve() for path in known}


MATCHERS: Final = "sasgeo_bench.matchers"
TRACKERS: Final = "sasgeo_bench.trackers"
REJECTORS: Final = "sasgeo_bench.rejectors"
SEGMENTERS: Final = "sasgeo_bench.segmenters"
SUITES: Final = "sasgeo_bench.suites"
METRICS: Final = "sasgeo_bench.metrics"
PERTURBATIONS: Final = "sasgeo_bench.perturbations"
EXPERIMENTS: Final = "sasgeo_bench.experiments"
CARD_FILE: Final = "card.toml"  # beside a plugin: the one description of a method
YARDSTICK: Final = "oracle_"  # prefix of oracles, which use the truth and are never ranked
# The runner's own controls, which are given the truth: no plugin can have their names.
ORACLE: Final = "oracle_pose"
ORACLE_SEGMENTER: Final = "oracle_segmenter"
_RESERVED: Final = {MATCHERS: ORACLE, TRACKERS: ORACLE, SEGMENTERS: ORACLE_SEGMENTER}
_WHAT: Final = dict.fromkeys((SUITES, METRICS, PERTURBATIONS), "NAME")  # behind a module, where that is no class
KINDS: Final = {
    MATCHERS: "matcher",
    TRACKERS: "tracker",
    REJECTORS: "rejector",
    SEGMENTERS: "segmenter",
    SUITES: "suite",
    METRICS: "metric",
    PERTURBATIONS: "perturbation",
    EXPERIMENTS: "experiment",
}


def list_entry_points(group: str = MATCHERS) -> dict[str, EntryPoint]:
    """Return the entry points of a group by name; of two with one name the built-in one, else the first listed.

    Warn of a name that occurs twice, or is that of the runner's own control. Raise `MatchError` if an installed package
    has entry points that cannot be read.
    """
    found: dict[str, EntryPoint] = {}
    for point in _installed(group):
        if point.name == _RESERVED.get(group):
            message = (
                f"{_home(point)} ({point.value}) is not used: {point.name!r} is the name of a control of the runner"
            )
            warnings.warn(message, stacklevel=2)
        elif point.name not in found:
            found[point.name] = point
        elif found[point.name].value != point.value:
            message = _clash(found[point.name], point)
            warnings.warn(message, stacklevel=2)
    return dict(sorted(found.items()))


def _installed(group: str) -> tuple[EntryPoint, ...]:
    try:
        return _read(group, tuple(sys.path))
    except Exception as error:
        raise MatchError(
            f"an installed package has entry points that cannot be read ({message_of(error)}): reinstall or remove it"
        ) from error


@lru_cache(maxsize=8)
def _read(group: str, _: tuple[str, ...]) -> tuple[EntryPoint, ...]:
    """Read the entry points of a group once for each list of places that packages are imported from."""
    return tuple(sorted(read_entry_points(group), key=lambda point: (not is_ours(point), _home(point), point.value)))


def _clash(first: EntryPoint, other: EntryPoint) -> str:
    """Name two plugins with the same name, and say which is used: ours, otherwise neither."""
    lost = f"{_home(other)} ({other.value})"
    if is_ours(first):
        return f"two plugins are named {first.name!r}: {_home(first)} is used, {lost} is not"
    return (
        f"two plugins are named {first.name!r}: {_home(first)} ({first.value}) and {lost}, so neither is used: "
        "uninstall one, or name module:Class"
    )


def shipped_names(group: str = MATCHERS) -> frozenset[str]:
    """Return the names of shipped plugins of a group, which no other plugin may use."""
    shipped = {point.name for point in _installed(group) if is_ours(point)}
    return frozenset(shipped | {_RESERVED[group]} if group in _RESERVED else shipped)


def check_card_name(spec: str, name: str, *, is_oracle: bool = False, group: str = MATCHERS) -> None:
    """Raise `MatchError` for a card name that would imitate a shipped plugin or an oracle.

    `spec` is the name of the plugin, or module:Class; `is_oracle` states that a pipeline lists it as an oracle.

    >>> check_card_name("mine:Matcher", "oracle_pose")
    Traceback (most recent call last):
        ...
    sasgeo_bench.core.errors.MatchError: mine:Matcher: its card is named 'oracle_pose', as a matcher that ships:
    rename it
    """
    shipped = shipped_names(group)
    module, is_class, _ = spec.partition(":")
    ships = is_shipped(module, import_paths(spec)) if is_class else spec in shipped
    if not ships and name in shipped:
        raise MatchError(f"{one_line(spec)}: its card is named {name!r}, as a {KINDS[group]} that ships: rename it")
    if name.startswith(YARDSTICK) and not (ships or is_oracle):
        raise MatchError(
            f"{one_line(spec)}: its card is named {name!r}, and names that begin with {YARDSTICK} are of oracles, "
            "which use the truth: rename it"
        )


def _home(point: EntryPoint) -> str:
    return "" if point.dist is None else _name_of(point.dist)


@lru_cache(maxsize=16)  # its entry points share a distribution, which reads its metadata anew at every access
def _name_of(distribution: Distribution) -> str:
    return distribution.name


def is_tracker(name: str) -> bool:
    """Return whether a name is registered for a tracker and for no matcher; nothing is imported.

    >>> is_tracker("dead_reckoning"), is_tracker("random")
    (True, False)
    """
    return name in list_entry_points(TRACKERS) and name not in list_entry_points()


def made(spec: str, target: Callable[[], Any]) -> Any:  # noqa: ANN401 - any plugin
    """Make a plugin; a failure is reported in one line."""
    try:
        return target()
    except (Exception, SystemExit) as error:  # a plugin that ends the program must not look like a good end
        raise _failed(spec, "cannot be made", error) from error


def find_plugin(spec: str, group: str) -> Any:  # noqa: ANN401 - any plugin
    """Return the class behind a name or module:Class, or the instance where it is one."""
    if not isinstance(spec, str):
        raise MatchError(f"{one_line(repr(spec))} is no name of a {KINDS[group]}: name one as a text, or module:Class")
    if ":" not in spec:
        return _from_entry_point(spec, group)
    module, _, name = spec.partition(":")
    try:
        return getattr(importlib.import_module(module), name)
    except (Exception, SystemExit) as error:
        raise _failed(one_line(spec), "cannot be imported", error) from error


NAME: Final = re.compile(r"(?!.{61})[a-z][a-z0-9]*(?:[-_][a-z0-9]+)*")  # of what runs inside the program


def find_inside(spec: str, group: str, *, shipped: Collection[str]) -> Any:  # noqa: ANN401 - any plugin
    """Return what a name, or "module:NAME", stands for, of what runs inside the program; `shipped` are names of ours.

    A module may lie in the working folder. Raise `MatchError` if there is none, with the nearest name.
    """
    if isinstance(spec, str) and ":" in spec and os.getcwd() not in sys.path:  # noqa: PTH109 - a text
        sys.path.insert(0, os.getcwd())  # noqa: PTH109
    if isinstance(spec, str) and ":" not in spec and spec not in list_entry_points(group):
        raise unknown(spec, group, others=shipped)
    return find_plugin(spec, group)


def check_own_name(spec: str, name: object, group: str, *, shipped: Collection[str], where: str = "it") -> None:
    """Raise `MatchError` unless a plugin inside the program has a name of its own, that of its entry point.

    `where` is what says the name.
    """
    if not isinstance(name, str) or not NAME.fullmatch(name):
        quoted = one_line(repr(name))
        raise MatchError(
            f"{spec}: {where} is named {quoted}: lower-case letters, digits, - and _ make a name, 60 at most"
        )
    if name in shipped:
        raise MatchError(f"{spec}: {where} is named {name!r}, as a {KINDS[group]} that ships: rename it")
    if ":" not in spec and name != spec:
        raise MatchError(
            f"{spec}: {where} is named {name!r}, and a {KINDS[group]} is found by one name: give the entry point "
            "(pyproject.toml) the same, and install it again"
        )


def _known(name: str, group: str) -> EntryPoint:
    points = list_entry_points(group)
    if name not in points:
        raise unknown(name, group)
    others = {point.value: point for point in _installed(group) if point.name == name and point != points[name]}
    rival = next((point for value, point in others.items() if value != points[name].value), None)
    if rival is not None and not is_ours(points[name]):
        raise MatchError(_clash(points[name], rival))
    _check_place(points[name])
    return points[name]


def _check_place(point: EntryPoint) -> None:
    """Refuse a plugin that ships where other code of its name would be imported: its rows would not be its own."""
    strange = strange_file(point.module, import_paths(point.name)) if is_ours(point) else None
    if strange is not None:
        raise MatchError(
            f"{point.name}: {point.module} would be imported from {one_line(str(strange))}, and not from where "
            f"{_home(point)} is installed: take that folder off PYTHONPATH"
        )


def code_of(spec: str, *groups: str) -> tuple[str, str]:
    """Return module and name of the class behind a name of one of the groups, or behind module:Class.

    Nothing is imported. Raise `MatchError` if there is none of that name.

    >>> code_of("random", MATCHERS, TRACKERS)
    ('sasgeo_bench.matching.controls.blind', 'RandomPlaces')
    """
    if ":" in spec:
        module, _, name = spec.partition(":")
        return module, name
    group = next((one for one in groups if spec in list_entry_points(one)), None)
    if group is None:
        raise unknown(spec, *groups)
    point = _known(spec, group)
    return point.module, point.attr


def unknown(name: str, *groups: str, others: Collection[str] = ()) -> MatchError:
    """Return the error for a name that no group has, with the nearest one; `others` are names without entry points."""
    known = [*others, *(each for group in groups for each in list_entry_points(group))]
    near = difflib.get_close_matches(name, known, n=1)
    hint = f", did you mean {near[0]!r}?" if near else ""
    kinds = [KINDS[group] for group in groups]
    kind = " or ".join(filter(None, (", ".join(kinds[:-1]), kinds[-1])))
    lists = " and ".join(f"list {one}s" for one in kinds) if len(kinds) <= 2 else "list"  # to be read
    shown = f"{lists} show{'s' if ' and ' not in lists else ''} all"
    return MatchError(f"there is no {kind} {name!r}{hint} ({shown}; or module:{_WHAT.get(groups[0], 'Class')})")


def check_names(*, matchers: Sequence[str] = (), rejectors: Sequence[str] = (), segmenters: Sequence[str] = ()) -> None:
    """Raise `MatchError` for names that no installed package registers; import nothing, accept any module:Class.

    `matchers` may name trackers, too.
    """
    for listed, group in ((matchers, MATCHERS), (rejectors, REJECTORS), (segmenters, SEGMENTERS)):
        for name in listed:
            if ":" not in name and name != _RESERVED.get(group):
                _known(name, TRACKERS if group == MATCHERS and is_tracker(name) else group)


def check_registered(rejectors: Sequence[str], *, source: str) -> None:
    """Raise `MatchError` if a data file, `source`, names a rejector that no installed package registers.

    Importing a module:Class from data would run any code. Nothing is imported here.
    """
    known = list_entry_points(REJECTORS) if rejectors else {}
    stray = next((name for name in rejectors if name not in known), None)
    if stray is not None:
        raise MatchError(
            f"{source} names the rejector {one_line(stray)!r}, and data may name registered ones only (list rejectors "
            "shows all): name each that is to judge with --rejector, and code only if you trust it"
        )


def _from_entry_point(name: str, group: str) -> Callable[[], Any]:
    point = _known(name, group)
    try:
        return point.load()  # type: ignore[no-any-return]
    except (Exception, SystemExit) as error:
        raise _failed(name, f"{point.value} of {_home(point)} cannot be imported", error) from error


def _failed(spec: str, what: str, error: BaseException) -> MatchError:
    """Return the error for a plugin whose code fails; one of ours, as of its card, says all there is to say."""
    return MatchError(f"{spec}: {error}" if isinstance(error, SasgeoError) else f"{spec}: {what} ({message_of(error)})")


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
    used = {f"{_OURS}:{path.relative_to(_PACKAGE).as_posix()}": path for room in rooms for path in _room_files(room)}
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
    """What is known of a file: its SHA-256, and the modules that it imports."""

    digest: bytes
    imports: frozenset[str] = frozenset()


def _file_code(path: Path) -> _Code:
    try:
        about = path.stat()
        return _read_code(path, about.st_size, about.st_mtime_ns)
    except OSError as error:
        raise MatchError(
            f"{path}, which is code of a plugin, cannot be read ({error.strerror}): check your rights"
        ) from error


@lru_cache(maxsize=4096)
def _read_code(path: Path, size: int, changed_ns: int) -> _Code:
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
        _forget_homes(tree)
    return _Code(hashlib.sha256(_shape(tree).encode(errors="replace")).digest(), imports)


def _forget_homes(tree: ast.Module) -> None:
    """Take out of a tree where the names of our own modules come from, and so in which order they are imported."""
    homeless, rest = [], []
    for node in ast.walk(tree):
        if isinstance(node, ast.ImportFrom) and node.module and node.module.partition(".")[0] in SHIPPED_MODULES:
            node.module = None
    for node in tree.body:
        if isinstance(node, ast.ImportFrom) and node.module is None:
            homeless += [ast.ImportFrom(module=None, names=[name], level=node.level) for name in node.names]
        else:
            rest.append(node)
    tree.body = [*rest, *sorted(homeless, key=ast.dump)]  # a docstring stays the first


def _tree(data: bytes) -> ast.Module | None:
    """Parse a file; None if it is no Python of this version."""
    try:
        return ast.parse(data)
    except (SyntaxError, ValueError, RecursionError, MemoryError):
        return None


def _shape(tree: ast.AST) -> str:
    """Return what a syntax tree says: types, fields and values, without docstrings, and what is empty or no code."""
    parts: list[str] = []
    left: list[Any] = [tree]  # what is still to be written, last first: trees and lists, or how the rest is written
    while left:
        item = left.pop()
        if isinstance(item, str):
            parts.append(item)
        elif isinstance(item, list):
            parts.append("[")
            left.append("]")
            left += [_part(one) for one in reversed(item)]
        else:
            parts.append(f"{type(item).__name__}(")
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
    return "".join(parts)


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
