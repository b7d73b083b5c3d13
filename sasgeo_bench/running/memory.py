# SPDX-License-Identifier: Apache-2.0
"""Memory of a process and its descendants: measured in a thread, and limited by a control group if possible."""

import contextlib
import ctypes
import itertools
import os
import re
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import Final, Self

import psutil

from sasgeo_bench.core.texts import message_of

_PREFIX: Final = "sasgeo-bench-"
_NEEDED: Final = ("memory", "pids")
_MOUNTS: Final = Path("/proc/self/mountinfo")
_OWN: Final = Path("/proc/self/cgroup")
_ROUNDS, _ROUND_S = 400, 0.005  # how often and at which interval we check that killed processes are gone
_numbers = itertools.count()


# Of the C library: blocks from this size on are pages of their own, and this much that is free on top of the heap is
# given back. By default both grow with what was freed, up to 32 and 64 MiB, which then stay with the process.
_OWN_PAGES, _FREE_ON_TOP = 4 * 2**20, 8 * 2**20
LEAN: Final = {  # a process's environment in which it keeps little of what it freed, at a few per cent of its time
    "MALLOC_MMAP_THRESHOLD_": str(_OWN_PAGES),
    "MALLOC_TRIM_THRESHOLD_": str(_FREE_ON_TOP),
}
_M_TRIM_THRESHOLD, _M_MMAP_THRESHOLD, _M_ARENA_MAX = -1, -3, -8  # of malloc.h


def be_lean() -> None:
    """Let this process, from now on, keep little of what it freed; does nothing where the C library has no such way."""
    if sys.platform != "linux":
        return
    adjust = getattr(ctypes.CDLL(None), "mallopt", None)  # of glibc; others may lack it
    if adjust is not None:
        for option, value in ((_M_MMAP_THRESHOLD, _OWN_PAGES), (_M_TRIM_THRESHOLD, _FREE_ON_TOP), (_M_ARENA_MAX, 1)):
            adjust(option, value)


@dataclass(frozen=True, slots=True, kw_only=True)
class Group:
    """A control group: one folder with both controllers (version 2), or one for each (version 1)."""

    version: int
    memory: Path
    pids: Path

    @property
    def folders(self) -> tuple[Path, ...]:
        """Return its folders, each once."""
        return tuple(dict.fromkeys((self.memory, self.pids)))

    @classmethod
    def make(cls, *, memory_bytes: int, processes: int) -> Self | None:
        """Make a group with these limits, after removing those whose runner was killed; return None if refused.

        The limits hold for all its processes together: memory with in-memory files and kernel buffers, and the number
        of processes and threads.
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
        optional = {"memory.swap.max": 0, "memory.oom.group": 1}
        if self.version == 1:
            limits, optional = {"memory.limit_in_bytes": memory_bytes}, {"memory.memsw.limit_in_bytes": memory_bytes}
        for name, value in limits.items():
            (self.memory / name).write_text(str(value), encoding="utf-8")
        (self.pids / "pids.max").write_text(str(processes), encoding="utf-8")
        for name, value in optional.items():  # not every kernel has these
            with contextlib.suppress(OSError):
                (self.memory / name).write_text(str(value), encoding="utf-8")

    def add(self, number: int) -> None:
        """Put a process into it, with all that it starts from then on; raise `OSError` if refused."""
        for folder in self.folders:
            (folder / "cgroup.procs").write_text(str(number), encoding="utf-8")

    def peak_bytes(self) -> int:
        """Return the peak memory of its processes by the kernel's count, or the current one if there is no peak."""
        names = ("memory.max_usage_in_bytes",) if self.version == 1 else ("memory.peak", "memory.current")
        return next(filter(None, (_number(self.memory / name) for name in names)), 0)

    def is_full(self) -> bool:
        """Return whether the kernel killed one of its processes for its memory."""
        name = "memory.oom_control" if self.version == 1 else "memory.events"
        found = dict(line.split() for line in _lines(self.memory / name))
        return int(found.get("oom_kill", 0)) > 0

    def remove(self) -> None:
        """Kill its processes, and remove it; a group whose processes do not die is removed by a later run."""
        for folder in self.folders:
            _remove(folder)


def _places() -> Iterator[tuple[int, Sequence[Path]]]:
    """Yield versions and folders (for memory, for processes) in which a group may be made, best first."""
    own = {names: path for _, names, path in (line.split(":", 2) for line in _lines(_OWN))}
    mounts = [
        (before.split()[3:5], after.split()) for before, _, after in (x.partition(" - ") for x in _lines(_MOUNTS))
    ]
    for (root, where), (kind, *_) in mounts:
        folder = _folder(root, where, own.get("")) if kind == "cgroup2" else None
        if folder is not None:
            # A folder with processes of its own gives no controllers to its children: try its parents, too.
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
    """Return the folder of a group below a mount, which may show one group as its root; None if it lies elsewhere."""
    root = root.rstrip("/")
    if path is None or not f"{path}/".startswith(f"{root}/"):
        return None
    return Path(where, path[len(root) :].lstrip("/"))


def _offers(folder: Path) -> bool:
    """Return whether groups in a version 2 folder have the controllers that are needed."""
    names = " ".join(_lines(folder / "cgroup.subtree_control")).split()
    return set(_NEEDED) <= set(names) and os.access(folder, os.W_OK)


def _runner() -> str:
    """Return a name of this process that no later one has: namespace, number, and start."""
    return f"{_namespace()}-{os.getpid()}-{_begun(os.getpid())}"


def _namespace() -> str:
    return os.readlink("/proc/self/ns/pid").strip("pid:[]")  # noqa: PTH115 - no file, a number


def _begun(number: int) -> str:
    """Return the start of a process in ticks since boot; empty if there is no such process."""
    lines = _lines(Path(f"/proc/{number}/stat"))
    return lines[0].rpartition(")")[2].split()[19] if lines else ""


def _sweep(folder: Path) -> None:
    """Remove groups of killed runs; those of other process namespaces are not ours."""
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


WATCH_S: Final = 0.05  # interval of measurements
_TRIES: Final = 3  # a process that ends meanwhile may look odd once
_AGAIN_S: Final = 0.01
_SHARED: Final = ("/memfd:", "/dev/shm/")  # noqa: S108 - how names of open files in memory begin
_USUAL: Final = 3  # processes: two keepers, and the matcher's own
_GROWN: Final = 1.02  # growth of an estimate before it is measured exactly again
_MAPPING: Final = re.compile(
    rb"[0-9a-f]+-[0-9a-f]+ \S{4} [0-9a-f]+ (?P<major>[0-9a-f]+):(?P<minor>[0-9a-f]+) (?P<inode>\d+)"
)
_SHARE: Final = re.compile(rb"Pss: +(?P<kb>\d+) kB")
_HAS_PROC: Final = sys.platform == "linux"  # elsewhere resident memory is all there is, and no file in memory is seen
_KB: Final = 1024
_BLOCK: Final = 512


@dataclass(kw_only=True)
class MemoryWatch:
    """Measures the memory of a process, and ends it above a limit.

    `process` is the outermost one, `kill` ends it with all its descendants, `scratch` is its scratch folder, which may
    lie in memory, and `group` the control group in which the kernel counts, too.
    """

    process: subprocess.Popen[bytes]
    most_bytes: int
    kill: Callable[[], None]
    scratch: Path
    group: Group | None = None
    is_over: bool = False
    fault: str = ""
    _sampled: int = 0
    _estimated: int = 0
    _stop: threading.Event = field(default_factory=threading.Event)
    _thread: threading.Thread | None = None

    def start(self) -> None:
        """Measure until stopped."""
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def stop(self) -> None:
        """Stop measuring."""
        self._stop.set()
        if self._thread is not None:
            self._thread.join()

    @property
    def peak_bytes(self) -> int:
        """Return the peak memory, measured or counted by the kernel."""
        return max(self._sampled, self.group.peak_bytes() if self.group else 0)

    def look(self) -> bool:
        """Measure once; return whether the memory exceeds the limit, or cannot be measured."""
        for _ in range(_TRIES):
            try:
                return self._measure()
            except Exception as error:  # noqa: BLE001 - a process controls what it shows of itself
                fault = message_of(error)
                time.sleep(_AGAIN_S)
        self.fault, self.is_over = fault, True
        return True

    @property
    def why(self) -> str:
        """Return the reason for ending the process."""
        if self.fault:
            return f"its memory could not be looked at ({self.fault})"
        return f"takes more than the {self.most_bytes / 1e6:.0f} MB of memory that are allowed"

    def _measure(self) -> bool:
        family = _family(self.process.pid)
        shared = _shared(family, self.scratch)
        estimate = _resident_bytes(family) + shared.bytes
        # Exact, which takes longer, only where pages may count twice and the estimate has grown; by Linux alone.
        if _HAS_PROC and (len(family) > _USUAL or shared.bytes or estimate > self.most_bytes):
            if estimate > max(self._estimated * _GROWN, self._sampled) or estimate > self.most_bytes:
                self._estimated = estimate
                estimate = min(estimate, _exact_bytes(family, shared))
            else:
                estimate = 0
        self._sampled = max(self._sampled, estimate)
        is_full = self.group is not None and self.group.is_full()
        self.is_over = self.is_over or is_full or estimate > self.most_bytes
        return self.is_over

    def _run(self) -> None:
        while not self._stop.wait(WATCH_S):
            if self.look():
                self.kill()
                return


@dataclass(frozen=True, slots=True, kw_only=True)
class _Shared:
    """Files in memory by device and inode, with their sizes, and a scratch folder in memory."""

    sizes: Mapping[tuple[int, int], int]
    scratch_bytes: int = 0
    scratch_device: int = -1

    @property
    def bytes(self) -> int:
        """Return the size of all of it, each file once."""
        return sum(self.sizes.values()) + self.scratch_bytes


def _family(number: int) -> list[int]:
    if not _has_children_lists():
        try:
            root = psutil.Process(number)
            return [number, *(child.pid for child in root.children(recursive=True))]
        except psutil.Error:
            return []
    found = [number]
    for parent in found:  # grows
        with contextlib.suppress(OSError):
            listed = [_lines(task / "children") for task in Path(f"/proc/{parent}/task").iterdir()]
            found += [int(child) for lines in listed for child in " ".join(lines).split()]
    return list(dict.fromkeys(found))


@cache
def _has_children_lists() -> bool:
    number = os.getpid()
    return Path(f"/proc/{number}/task/{number}/children").is_file()


def _resident_bytes(family: Iterable[int]) -> int:
    total = 0
    for number in family:
        try:
            total += psutil.Process(number).memory_info().rss
        except psutil.Error:
            continue
    return total


def _shared(family: Sequence[int], scratch: Path) -> _Shared:
    """Find in-memory files that some processes hold open, and their scratch folder if it lies in memory."""
    sizes: dict[tuple[int, int], int] = {}
    used, device = 0, -1
    for number in family if _HAS_PROC else ():
        try:
            for entry in os.scandir(f"/proc/{number}/fd"):
                if os.readlink(entry.path).startswith(_SHARED):  # noqa: PTH115 - not a path
                    found = entry.stat()
                    sizes[found.st_dev, found.st_ino] = found.st_blocks * _BLOCK
        except OSError:
            pass
        if device < 0:
            with contextlib.suppress(OSError):
                device, used = _scratch_in_memory(number, scratch)
    sizes = {key: size for key, size in sizes.items() if key[0] != device}
    return _Shared(sizes=sizes, scratch_bytes=used, scratch_device=device)


def _scratch_in_memory(number: int, scratch: Path) -> tuple[int, int]:
    """Return device and used bytes of a process's scratch folder if it lies in memory, or else -1 and 0."""
    # Resolve the path once: while a process enters its root, it leads to the system's disk for a moment.
    inside = os.open(f"/proc/{number}/root{scratch}", os.O_PATH | os.O_CLOEXEC)
    try:
        device = os.fstat(inside).st_dev
        if device == os.stat(scratch).st_dev:  # noqa: PTH116 - as fstat gives it
            return -1, 0
        of = os.fstatvfs(inside)
    finally:
        os.close(inside)
    return device, (of.f_blocks - of.f_bfree) * of.f_frsize


def _exact_bytes(family: Iterable[int], shared: _Shared) -> int:
    """Measure the memory of processes; pages that several map, or that lie in an in-memory file, count once."""
    total = shared.bytes
    for number in family:
        try:
            total += _mapped_bytes(Path(f"/proc/{number}/smaps").read_bytes(), shared)
        except OSError:
            continue
    return total


def _mapped_bytes(smaps: bytes, shared: _Shared) -> int:
    """Sum the memory that a process maps by its `smaps`, without shared files; names may look like other lines."""
    total, is_counted = 0, False
    for line in smaps.split(b"\n"):  # the kernel writes this one break in a name as \012, and no other
        if found := _MAPPING.match(line):
            device = os.makedev(int(found["major"], 16), int(found["minor"], 16))
            is_counted = device == shared.scratch_device or (device, int(found["inode"])) in shared.sizes
        elif not is_counted and (found := _SHARE.fullmatch(line)):
            total += int(found["kb"]) * _KB
    return total
