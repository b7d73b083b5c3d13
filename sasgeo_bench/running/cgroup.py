# SPDX-License-Identifier: Apache-2.0
"""Control groups: where we may make one, the kernel limits the memory and the number of a matcher's processes."""

import contextlib
import itertools
import os
import signal
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final, Self

_PREFIX: Final = "sasgeo-bench-"
_NEEDED: Final = ("memory", "pids")
_MOUNTS: Final = Path("/proc/self/mountinfo")
_OWN: Final = Path("/proc/self/cgroup")
_ROUNDS, _ROUND_S = 400, 0.005  # how often and how far apart we look whether killed processes are gone
_numbers = itertools.count()


@dataclass(frozen=True, slots=True, kw_only=True)
class Group:
    """A control group: one folder with both controllers (version 2), or one for each (version 1).

    Examples
    --------
    >>> group = Group(version=2, memory=Path("/sys/fs/cgroup/a"), pids=Path("/sys/fs/cgroup/a"))
    >>> group.folders
    (PosixPath('/sys/fs/cgroup/a'),)
    """

    version: int
    memory: Path
    pids: Path

    @property
    def folders(self) -> tuple[Path, ...]:
        """Its folders, each once."""
        return tuple(dict.fromkeys((self.memory, self.pids)))

    @classmethod
    def make(cls, *, memory_bytes: int, processes: int) -> Self | None:
        """Make a group with these limits, after removing those whose runner was killed; None where we may not.

        Parameters
        ----------
        memory_bytes : int
            Of all its processes together, files in memory and buffers of the kernel among it.
        processes : int
            Processes and threads at once.
        """
        for version, parents in _places():
            name = f"{_PREFIX}{_runner()}-{next(_numbers)}"
            for folder in dict.fromkeys(parents):
                _sweep(folder)
            group = cls(version=version, memory=parents[0] / name, pids=parents[1] / name)
            try:
                group._create(memory_bytes, processes)
            except OSError:
                group.remove()
                continue
            return group
        return None

    def _create(self, memory_bytes: int, processes: int) -> None:
        for folder in self.folders:
            folder.mkdir()
        limits: Mapping[str, int] = {"memory.max": memory_bytes}
        more = {"memory.swap.max": 0, "memory.oom.group": 1}
        if self.version == 1:
            limits, more = {"memory.limit_in_bytes": memory_bytes}, {"memory.memsw.limit_in_bytes": memory_bytes}
        for name, value in limits.items():
            (self.memory / name).write_text(str(value), encoding="utf-8")
        (self.pids / "pids.max").write_text(str(processes), encoding="utf-8")
        for name, value in more.items():  # not every kernel has these
            with contextlib.suppress(OSError):
                (self.memory / name).write_text(str(value), encoding="utf-8")

    def add(self, number: int) -> None:
        """Put a process into it; what it starts from then on is in it, too.

        Raises
        ------
        OSError
            If we may not.
        """
        for folder in self.folders:
            (folder / "cgroup.procs").write_text(str(number), encoding="utf-8")

    def peak_bytes(self) -> int:
        """Most memory its processes held at once, as the kernel counted it; that of now where it keeps no peak."""
        names = ("memory.max_usage_in_bytes",) if self.version == 1 else ("memory.peak", "memory.current")
        return next(filter(None, (_number(self.memory / name) for name in names)), 0)

    def is_full(self) -> bool:
        """True if the kernel killed one of its processes for its memory."""
        name = "memory.oom_control" if self.version == 1 else "memory.events"
        found = dict(line.split() for line in _lines(self.memory / name))
        return int(found.get("oom_kill", 0)) > 0

    def remove(self) -> None:
        """Kill whatever is in it, and remove it; what is left because it would not die is swept by a later run."""
        for folder in self.folders:
            _remove(folder)


def _places() -> Iterator[tuple[int, Sequence[Path]]]:
    """Versions, and the folders for memory and for processes in which a group may be made, best first."""
    own = {names: path for _, names, path in (line.split(":", 2) for line in _lines(_OWN))}
    mounts = [
        (before.split()[3:5], after.split()) for before, _, after in (x.partition(" - ") for x in _lines(_MOUNTS))
    ]
    for (root, where), (kind, *_) in mounts:
        folder = _folder(root, where, own.get("")) if kind == "cgroup2" else None
        if folder is not None:
            # A folder with processes of its own gives no controllers to those within: then beside it, or further up.
            for place in (folder, *folder.parents):
                if place.is_relative_to(where) and _offers(place):
                    yield 2, (place, place)
    found: dict[str, Path] = {}
    for (root, where), (kind, _, options) in mounts:
        for names, path in own.items():
            folder = _folder(root, where, path) if kind == "cgroup" and names in options else None
            for controller in set(_NEEDED) & set(names.split(",")):
                if folder is not None and controller in options.split(","):
                    found[controller] = folder
    if len(found) == len(_NEEDED):
        yield 1, [found[controller] for controller in _NEEDED]


def _folder(root: str, where: str, path: str | None) -> Path | None:
    """Place of a group below a mount of groups, whose own root may be one of them; None if it lies elsewhere."""
    root = root.rstrip("/")
    if path is None or not f"{path}/".startswith(f"{root}/"):
        return None
    return Path(where, path[len(root) :].lstrip("/"))


def _offers(folder: Path) -> bool:
    """True if groups in a version 2 folder have the controllers that are needed."""
    names = " ".join(_lines(folder / "cgroup.subtree_control")).split()
    return set(_NEEDED) <= set(names) and os.access(folder, os.W_OK)


def _runner() -> str:
    """Name of this process that no later one has: namespace, number, and when it began."""
    return f"{_namespace()}-{os.getpid()}-{_begun(os.getpid())}"


def _namespace() -> str:
    return os.readlink("/proc/self/ns/pid").strip("pid:[]")  # noqa: PTH115 - no file, a number


def _begun(number: int) -> str:
    """Return the start of a process in ticks since boot; empty if there is no such process."""
    lines = _lines(Path(f"/proc/{number}/stat"))
    return lines[0].rpartition(")")[2].split()[19] if lines else ""


def _sweep(folder: Path) -> None:
    """Remove groups that runs left here because they were killed; those of other process namespaces are not ours."""
    with contextlib.suppress(OSError):
        for path in folder.glob(f"{_PREFIX}{_namespace()}-*"):
            _, number, begun, _ = path.name.removeprefix(_PREFIX).split("-")
            if _begun(int(number)) != begun:
                _remove(path)


def _remove(folder: Path) -> None:
    for _ in range(_ROUNDS):
        with contextlib.suppress(OSError):
            (folder / "cgroup.kill").write_text("1", encoding="utf-8")
        for line in _lines(folder / "cgroup.procs"):
            with contextlib.suppress(OSError, ValueError):
                if int(line):
                    os.kill(int(line), signal.SIGKILL)
        try:
            folder.rmdir()
        except FileNotFoundError:
            return
        except OSError:
            time.sleep(_ROUND_S)
        else:
            return


def _number(path: Path) -> int:
    text = "".join(_lines(path))
    return int(text) if text.isdigit() else 0


def _lines(path: Path) -> list[str]:
    try:
        return path.read_text(encoding="utf-8").splitlines()
    except OSError:
        return []
