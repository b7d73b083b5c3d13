# SPDX-License-Identifier: Apache-2.0
"""Memory of a process and its descendants: measured in a thread, and limited by a control group if possible."""

import contextlib
import itertools
import os
import re
import signal
import subprocess
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final, Self

import psutil

from sasgeo_bench.bounds import message_of

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


WATCH_S: Final = 0.05  # how often memory is looked at
_TRIES: Final = 3  # what ends while it is looked at may look odd once
_AGAIN_S: Final = 0.01
_SHARED: Final = ("/memfd:", "/dev/shm/")  # noqa: S108 - what open files are called that lie in memory
_USUAL: Final = 3  # processes: two that keep the matcher's, and its own
_GROWN: Final = 1.02  # by so much has an estimate grown before it is looked at closely again
_MAPPING: Final = re.compile(
    rb"[0-9a-f]+-[0-9a-f]+ \S{4} [0-9a-f]+ (?P<major>[0-9a-f]+):(?P<minor>[0-9a-f]+) (?P<inode>\d+)"
)
_SHARE: Final = re.compile(rb"Pss: +(?P<kb>\d+) kB")
_KB: Final = 1024
_BLOCK: Final = 512


@dataclass(kw_only=True)
class MemoryWatch:
    """Looks at the memory of a process, and ends it when it takes more than it may.

    Parameters
    ----------
    process : subprocess.Popen
        The outermost process.
    most_bytes : int
        What it may take.
    kill : callable
        Ends it and all that came from it.
    scratch : Path
        Its scratch folder, which may lie in memory.
    group : Group, optional
        Where the kernel counts, too.
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
        """Most memory that was found at once, by looking or by the kernel's own count."""
        return max(self._sampled, self.group.peak_bytes() if self.group else 0)

    def look(self) -> bool:
        """Measure once; true if the memory exceeds the limit, or cannot be measured."""
        for _ in range(_TRIES):
            try:
                return self._measure()
            except Exception as error:  # noqa: BLE001 - what a process shows of itself is its own making
                fault = message_of(error)
                time.sleep(_AGAIN_S)
        self.fault, self.is_over = fault, True
        return True

    @property
    def why(self) -> str:
        """Return why the process was ended."""
        if self.fault:
            return f"its memory could not be looked at ({self.fault})"
        return f"takes more than the {self.most_bytes / 1e6:.0f} MB of memory that are allowed"

    def _measure(self) -> bool:
        family = _family(self.process.pid)
        shared = _shared(family, self.scratch)
        estimate = _resident_bytes(family) + shared.bytes
        # Exact only where pages may count twice, and the sum says something new: it takes longer to find out.
        if len(family) > _USUAL or shared.bytes or estimate > self.most_bytes:
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
    """A file in memory, mapped or not: its size, and its key in a list of mappings."""

    sizes: Mapping[tuple[int, int], int]
    scratch_bytes: int = 0
    scratch_device: int = -1

    @property
    def bytes(self) -> int:
        """All of it, each once."""
        return sum(self.sizes.values()) + self.scratch_bytes


def _family(number: int) -> list[int]:
    try:
        root = psutil.Process(number)
        return [number, *(child.pid for child in root.children(recursive=True))]
    except psutil.Error:
        return []


def _resident_bytes(family: Iterable[int]) -> int:
    total = 0
    for number in family:
        try:
            total += psutil.Process(number).memory_info().rss
        except psutil.Error:
            continue
    return total


def _shared(family: Sequence[int], scratch: Path) -> _Shared:
    """Files in memory that some processes hold open, and their scratch folder if it lies in memory."""
    sizes: dict[tuple[int, int], int] = {}
    used, device = 0, -1
    for number in family:
        try:
            for entry in os.scandir(f"/proc/{number}/fd"):
                if os.readlink(entry.path).startswith(_SHARED):  # noqa: PTH115 - no file
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
    """Return device and used bytes of a process's scratch folder if it lies in memory, or else -1 and 0.

    The path is looked up once: while a process enters its own root, it leads to the system's disk for a moment, whose
    used space is nobody's memory.
    """
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
    """Memory of some processes; pages that several of them map, or that lie in a file in memory, count once."""
    total = shared.bytes
    for number in family:
        try:
            total += _mapped_bytes(Path(f"/proc/{number}/smaps").read_bytes(), shared)
        except OSError:
            continue
    return total


def _mapped_bytes(smaps: bytes, shared: _Shared) -> int:
    """Memory that a process maps by its `smaps`, but for what is shared; names of files may look like other lines."""
    total, is_counted = 0, False
    for line in smaps.split(b"\n"):  # the kernel writes this one break in a name as \012, and no other
        if found := _MAPPING.match(line):
            device = os.makedev(int(found["major"], 16), int(found["minor"], 16))
            is_counted = device == shared.scratch_device or (device, int(found["inode"])) in shared.sizes
        elif not is_counted and (found := _SHARE.fullmatch(line)):
            total += int(found["kb"]) * _KB
    return total
