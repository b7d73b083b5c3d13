# SPDX-License-Identifier: Apache-2.0
"""Find files beside the code that reveal answers: queries, truths, results, boards, releases, other maps.

A matcher reads the folders that it is imported from. They are walked here, no links followed, so that whatever in them
tells where a query was taken can be hidden; how far the walk came is part of what it finds.
"""

import os
import sys
import sysconfig
import time
from collections import deque
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Final

from sasgeo_bench.running.root import SYSTEM
from sasgeo_bench.tasks.private_seed import SUFFIX as SEED

MOST_ENTRIES: Final = 200_000  # names that are looked at: about a second of a disk that is awake
MOST_DEPTH: Final = 12
_FRESH_S: Final = 60.0  # a walk counts so long; a run starts many processes, and others store results meanwhile

# A folder that holds all names of one of these tells answers.
_SIGNS: Final = tuple(
    frozenset(names)
    for names in (
        ("pack.json",),
        ("truths.parquet",),
        ("truth.parquet",),
        ("truth.json",),
        ("queries.parquet",),
        ("submission.json", "predictions"),
        ("board.json", "leaderboard.parquet"),
        ("release.json", "SHA256SUMS"),
        ("site.json", "index.html"),
        ("region.json", "layers.tif"),
    )
)
_SIGN_STARTS: Final = ("truth-", "part-")  # truths of one part of a task in a release; answers of a run
# What of it is hidden where it holds code or the map that is asked about, too, and cannot go as a whole.
_TELLING: Final = frozenset(
    {
        *("pack.json", "truths.parquet", "truth.parquet", "truth.json", "scores.parquet", "submission.json"),
        *("queries.parquet", "predictions.parquet", "runs.parquet", "tasks"),
        *("truth", "runs", "boards", "predictions", "learned", "pictures", "cases", "sheets"),
    }
)
_OUT: Final = frozenset({"tasks", "truth"})
_OF_OUT: Final = ("tasks", "truth", "runs", "boards", "release", "results", "sheets")
_HISTORY: Final = frozenset({".git", ".hg"})  # results that were ever committed are in there
_PASSED_OVER: Final = frozenset({"site-packages", "dist-packages", "node_modules", "__pycache__"})
_INTERPRETER: Final = frozenset({"pyvenv.cfg", "conda-meta"})


@dataclass(frozen=True, slots=True, kw_only=True)
class Telling:
    """A folder that tells answers, what of it does, and whether it holds code of its own."""

    folder: str
    parts: tuple[str, ...] = ()
    is_code: bool = False


@dataclass(frozen=True, slots=True, kw_only=True)
class Walk:
    """Folders that tell answers, outer ones first, and in words what was not looked at; empty where all was."""

    found: tuple[Telling, ...]
    unsearched: str = ""

    def hidden(self, kept: Sequence[Path]) -> list[str]:
        """Paths to hide: folders as a whole, or what tells of those that hold code or something that is kept.

        Examples
        --------
        >>> walk = Walk(found=(Telling(folder="/a/release", parts=("/a/release/truth",)),))
        >>> walk.hidden([]), walk.hidden([Path("/a/release/regions/vaduz")])
        (['/a/release'], ['/a/release/truth'])
        """
        real = [os.path.realpath(path) for path in kept]
        hidden: dict[str, None] = {}
        for item in self.found:
            if any(str(above) in hidden for above in Path(item.folder).parents):
                continue
            is_split = item.is_code or any(f"{path}/".startswith(f"{item.folder}/") for path in real)
            hidden.update(dict.fromkeys(item.parts if is_split else (item.folder,)))
        return list(hidden)


def walk_code(code: Iterable[Path]) -> Walk:
    """Look through the folders that code is imported from, all but those of the interpreter; again after a minute.

    Examples
    --------
    >>> walk_code([]).found
    ()
    """
    roots = dict.fromkeys(os.path.realpath(path) for path in code)
    own = tuple(root for root in roots if os.path.isdir(root) and not _is_interpreters(root))  # noqa: PTH112 - text
    return _walked(own, int(time.monotonic() // _FRESH_S))


@lru_cache(maxsize=4)
def _walked(roots: tuple[str, ...], minute: int) -> Walk:
    del minute
    return walk(roots)


def walk(roots: Sequence[str], *, most_entries: int = MOST_ENTRIES, most_depth: int = MOST_DEPTH) -> Walk:
    """Look through folders, the upper ones first.

    Parameters
    ----------
    roots : sequence of str
        Resolved folders.
    most_entries, most_depth : int
        Names that are looked at in all, and how many folders deep.

    Returns
    -------
    Walk
        What tells answers.

    Examples
    --------
    >>> walk(["/nowhere"]).found
    ()
    """
    found: list[Telling] = []
    queue, seen, entries, is_deep = deque((root, 0) for root in roots), set(roots), 0, False
    while queue and entries < most_entries:
        folder, depth = queue.popleft()
        held = _listed(folder, most_entries - entries)
        entries += len(held)
        tells, inside = _look(folder, held)
        found += tells
        inside = [path for path in inside if path not in seen]
        is_deep |= bool(inside) and depth >= most_depth
        if depth < most_depth:
            seen.update(inside)
            queue.extend((path, depth + 1) for path in inside)
    missed = [f"beyond {most_entries} files"] if entries >= most_entries else []
    missed += [f"deeper than {most_depth} folders"] if is_deep else []
    words = f"stored results {' or '.join(missed)} beside the code were not looked for" if missed else ""
    return Walk(found=tuple(found), unsearched=words)


def _is_interpreters(folder: str) -> bool:
    """True if a folder is the interpreter's own, or holds installed packages."""
    prefixes = {os.path.realpath(path) for path in (sys.prefix, sys.base_prefix)}
    installed = {os.path.realpath(path) for path in sysconfig.get_paths().values()} - prefixes
    return folder in prefixes or any(Path(folder).is_relative_to(path) for path in installed)


def _listed(folder: str, most: int) -> dict[str, bool]:
    """Names in a folder, so many at most, and whether each is a folder itself; none where it cannot be read."""
    held: dict[str, bool] = {}
    try:
        with os.scandir(folder) as entries:
            for entry in entries:
                held[entry.name] = entry.is_dir(follow_symlinks=False)
                if len(held) >= most:
                    break
    except OSError:
        pass  # what we cannot list, a process of the same user cannot read
    return held


def _look(folder: str, held: dict[str, bool]) -> tuple[list[Telling], list[str]]:
    """Return what reveals answers in a folder, and its subfolders still to scan."""
    names = held.keys()
    if names & _INTERPRETER or folder in {*SYSTEM, "/dev"}:
        return [], []
    base = folder.rstrip("/")
    telling = {name for name in names if name in _HISTORY or name.endswith(SEED)}  # a private seed draws the truths
    tells = [Telling(folder=f"{base}/{name}") for name in sorted(telling)]
    passed = {*_HISTORY, *_PASSED_OVER}
    if names >= _OUT:
        tells += [Telling(folder=f"{base}/{name}") for name in _OF_OUT]
        passed |= {"tasks", "truth", "runs", "boards"}
    if any(names >= sign for sign in _SIGNS) or any(_is_table(name) for name in names):
        parts = [name for name in sorted(names) if name in _TELLING or _is_table(name)]
        is_code = any(name.endswith(".py") for name in names)
        tells.insert(0, Telling(folder=folder, parts=tuple(f"{base}/{name}" for name in parts), is_code=is_code))
        passed.update(parts)
    return tells, list(_inside(base, held, passed))


def _is_table(name: str) -> bool:
    return name.startswith(_SIGN_STARTS) and name.endswith(".parquet")


def _inside(base: str, held: dict[str, bool], passed: set[str]) -> Iterator[str]:
    return (f"{base}/{name}" for name, is_folder in sorted(held.items()) if is_folder and name not in passed)
