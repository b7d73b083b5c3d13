# SPDX-License-Identifier: Apache-2.0
"""Where the code of a plugin lies, found as Python would import it, but without running any of it.

Whoever installs a plugin, or puts it on PYTHONPATH, trusts it. What a name that ships stands for does not change by
that: it is read from where sasgeo-bench, sasgeo-baselines and sasgeo-paper are installed, or from nowhere.
"""

import json
import os
import re
import site
import sys
import sysconfig
from collections.abc import Iterable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import lru_cache
from importlib.machinery import ModuleSpec, PathFinder
from importlib.metadata import Distribution, EntryPoint, distributions
from pathlib import Path
from typing import Any, Final
from urllib.parse import unquote, urlsplit

from sasgeo_bench.files.paths import plain_file

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

    >>> found = find_module("sasgeo_bench.files.plugins", [])
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
        elif _name_of(found) not in seen:
            seen |= {_name_of(found)} - set(SHIPPED)
            others += points
    return [*dict.fromkeys(ours), *others]


def is_ours(point: EntryPoint) -> bool:
    """Return whether an entry point is one of those that ship."""
    return point.dist is not None and _is_shipped(point.dist)


def _is_shipped(found: Distribution) -> bool:
    """Return whether a distribution is one of ours: installed, and not only called so."""
    return _name_of(found) in SHIPPED and Path(str(found.locate_file(""))).resolve() in _bases()


@lru_cache(maxsize=64)  # its entry points share a distribution, which reads its metadata anew at every access
def _name_of(found: Distribution) -> str:
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
