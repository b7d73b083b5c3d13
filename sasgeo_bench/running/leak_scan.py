# SPDX-License-Identifier: Apache-2.0
"""Find files next to the code that reveal answers: queries, truths, labels, results, boards, releases, other maps.

A matcher reads the folders that it is imported from. Walk them here, without following links, so that files which
reveal where a query was taken can be hidden; report how far the walk came.
"""

import os
import sys
import sysconfig
import time
from collections import deque
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import lru_cache
from itertools import accumulate
from pathlib import Path
from typing import Final

from sasgeo_bench.running.sandbox import SYSTEM
from sasgeo_bench.sensing.image import LABELLED
from sasgeo_bench.tasks.private_seed import SUFFIX as SEED

# A folder that holds all names of one of these reveals answers.
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
# Parts that are hidden of a folder that holds code or the map in question, too, and cannot be hidden as a whole.
_TELLING: Final = frozenset(
    {
        *("pack.json", "truths.parquet", "truth.parquet", "truth.json", "scores.parquet", "submission.json"),
        *("queries.parquet", "predictions.parquet", "runs.parquet", "tasks"),
        *("truth", "runs", "boards", "predictions", "learned", "pictures", "cases", "sheets"),
    }
)
_OUT: Final = frozenset({"tasks", "truth"})
_OF_OUT: Final = ("tasks", "truth", "runs", "boards", "release", "results", "sheets", "segmenters")
PACKED: Final = ".tar.xz"  # beside a pipeline file: answers (`experiments.head_start`)
_HISTORY: Final = frozenset({".git", ".hg"})  # they hold all results that were ever committed
_SKIPPED: Final = frozenset({"site-packages", "dist-packages", "node_modules", "__pycache__"})
_INTERPRETER: Final = frozenset({"pyvenv.cfg", "conda-meta"})


@dataclass(frozen=True, slots=True, kw_only=True)
class Telling:
    """A folder that reveals answers, the parts of it that do, and whether it holds code of its own."""

    folder: str
    parts: tuple[str, ...] = ()
    is_code: bool = False


@dataclass(frozen=True, slots=True, kw_only=True)
class Walk:
    """Folders that reveal answers, outer ones first, and a description of unsearched files, empty if there are none."""

    found: tuple[Telling, ...]
    unsearched: str = ""

    def hidden(self, kept: Sequence[Path]) -> list[str]:
        """Return the paths to hide: whole folders, or the revealing parts of those that hold code or a kept path.

        >>> walk = Walk(found=(Telling(folder="/a/release", parts=("/a/release/truth",)),))
        >>> walk.hidden([]), walk.hidden([Path("/a/release/regions/vaduz")])
        (['/a/release'], ['/a/release/truth'])
        """
        real = [os.path.realpath(path) for path in kept]
        hidden: dict[str, None] = {}
        for item in self.found:
            outer = accumulate(item.folder.split("/")[:-1], "{}/{}".format)
            if not hidden.keys().isdisjoint(outer):
                continue
            is_split = item.is_code or any(f"{path}/".startswith(f"{item.folder}/") for path in real)
            hidden.update(dict.fromkeys(item.parts if is_split else (item.folder,)))
        return list(hidden)


def walk_code(code: Iterable[Path]) -> Walk:
    """Walk the folders that code is imported from, except those of the interpreter; walk again after a minute."""
    roots = dict.fromkeys(os.path.realpath(path) for path in code)
    own = tuple(root for root in roots if os.path.isdir(root) and not _is_installed(root))  # noqa: PTH112 - text
    # 60 s: a walk is valid so long: a run starts many processes, and others store results meanwhile
    return _walked(own, int(time.monotonic() // 60.0))


@lru_cache(maxsize=4)
def _walked(roots: tuple[str, ...], minute: int) -> Walk:
    del minute
    return walk(roots)


# 200_000 names: about a second of a fast disk
def walk(roots: Sequence[str], *, most_entries: int = 200_000, most_depth: int = 12) -> Walk:
    """Walk resolved folders, upper ones first: at most so many names in all, and so many folders deep."""
    found: list[Telling] = []
    queue, seen, entries, is_deep = deque((root, 0) for root in roots), set(roots), 0, False
    while queue and entries < most_entries:
        folder, depth = queue.popleft()
        held = _listed(folder, most_entries - entries)
        entries += len(held)
        revealing, inside = _look(folder, held)
        found += revealing
        inside = [path for path in inside if path not in seen]
        is_deep |= bool(inside) and depth >= most_depth
        if depth < most_depth:
            seen.update(inside)
            queue.extend((path, depth + 1) for path in inside)
    missed = [f"beyond {most_entries} files"] if entries >= most_entries else []
    missed += [f"deeper than {most_depth} folders"] if is_deep else []
    words = f"stored results {' or '.join(missed)} next to the code were not looked for" if missed else ""
    return Walk(found=tuple(found), unsearched=words)


def _is_installed(folder: str) -> bool:
    prefixes = {os.path.realpath(path) for path in (sys.prefix, sys.base_prefix)}
    installed = {os.path.realpath(path) for path in sysconfig.get_paths().values()} - prefixes
    return folder in prefixes or any(Path(folder).is_relative_to(path) for path in installed)


def _listed(folder: str, most: int) -> dict[str, bool]:
    """List at most so many names in a folder, and whether each is a folder; none if it cannot be read."""
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
    names = held.keys()
    if names & _INTERPRETER or folder in {*SYSTEM, "/dev"}:
        return [], []
    base = folder.rstrip("/")
    telling = {name for name in names if name in _HISTORY or name.endswith(SEED)}  # truths are drawn by the seed
    telling |= {name for name in names if name.endswith(PACKED) and f"{name.removesuffix(PACKED)}.toml" in names}
    found = [Telling(folder=f"{base}/{name}") for name in sorted(telling)]
    skipped = {*_HISTORY, *_SKIPPED}
    if names >= _OUT:
        found += [Telling(folder=f"{base}/{name}") for name in _OF_OUT]
        skipped |= {"tasks", "truth", "runs", "boards"}
    if any(names >= sign for sign in _SIGNS) or any(_is_table(name) for name in names):
        parts = [name for name in sorted(names) if name in _TELLING or _is_table(name)]
        is_code = any(name.endswith(".py") for name in names)
        found.insert(0, Telling(folder=folder, parts=tuple(f"{base}/{name}" for name in parts), is_code=is_code))
        skipped.update(parts)
    return found, [f"{base}/{name}" for name in sorted(names) if held[name] and name not in skipped]


def _is_table(name: str) -> bool:
    # Truths of one part of a task in a release; answers of a run
    return (name.startswith(("truth-", "part-")) and name.endswith(".parquet")) or name.endswith(LABELLED)
