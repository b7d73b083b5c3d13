# SPDX-License-Identifier: Apache-2.0
"""Memory of a process and of all that came from it: looked at in a thread of its own as long as the process lives."""

import contextlib
import os
import re
import subprocess
import threading
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final

import psutil

from sasgeo_bench.bounds import message_of
from sasgeo_bench.running.cgroup import Group

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
