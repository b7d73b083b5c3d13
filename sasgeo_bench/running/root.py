# SPDX-License-Identifier: Apache-2.0
# ruff: noqa: PTH102, PTH103, PTH110, PTH112, PTH114, PTH115, PTH120, PTH123, PTH208, PTH211
# Without pathlib, which is slow to load: this runs before the sandbox is closed.
"""A private root for a matcher's process: the files it needs, read only, and one scratch folder of limited size.

Everything here happens in a mount namespace of its own; the system's mounts stay as they are.
"""

import os
from collections.abc import Iterable, Sequence
from typing import Final

from sasgeo_bench.running import kernel
from sasgeo_bench.running.kernel import outermost

MS_RDONLY: Final = 0x1
MS_NOSUID: Final = 0x2
MS_NODEV: Final = 0x4
MS_NOEXEC: Final = 0x8
MS_REMOUNT: Final = 0x20
MS_BIND: Final = 0x1000
MS_REC: Final = 0x4000
MS_UNBINDABLE: Final = 0x20000
_DETACH: Final = 2  # umount2: at once, even if in use
_MOST_LINKS: Final = 40  # as the kernel follows

SYSTEM: Final = (
    *("/usr", "/lib", "/lib64", "/lib32", "/bin", "/sbin", "/etc", "/opt", "/nix"),
    *("/proc", "/sys/devices/system"),  # of /sys processors and memory, which libraries read; no network, no disks
)
DEVICES: Final = ("/dev/null", "/dev/zero", "/dev/random", "/dev/urandom", "/dev/full")
SHARED_MEMORY: Final = "/dev/shm"  # noqa: S108 - a name for the scratch folder, where shared memory and semaphores go
_STREAMS: Final = {"fd": "fd", "stdin": "fd/0", "stdout": "fd/1", "stderr": "fd/2"}
# Folders of the system's root that hold no code, or other users' files, where the import path includes that root.
_NOT_CODE: Final = frozenset(
    ("dev", "proc", "sys", "run", "tmp", "var", "home", "root", "mnt", "media", "srv", "boot", "lost+found")
)


def enter_root(scratch: str, *, shown: Iterable[str], hidden: Sequence[str], scratch_bytes: int) -> bool:
    """Enter a private root with the system's programs and the `shown` paths, read only; return False if refused.

    At the path of `scratch`, an empty resolved folder, lies the only writable folder: in memory, of `scratch_bytes`.
    The resolved `hidden` paths are covered by empty mounts. If the kernel refuses, everything stays as it was.
    """
    try:
        kernel.mount("none", scratch, "tmpfs", MS_NOSUID | MS_NODEV, "size=1m,nr_inodes=8k,mode=755")
    except OSError:
        return False
    try:
        _fill(scratch, shown=shown, hidden=hidden)
        _make_read_only(scratch, writable=_add_scratch(scratch, scratch_bytes))
        os.chdir(scratch)
        if kernel.libc().pivot_root(b".", b".") != 0:
            raise kernel.last_error()
    except OSError:
        os.chdir("/")
        kernel.libc().umount2(os.fsencode(scratch), _DETACH)
        return False
    if kernel.libc().umount2(b".", _DETACH) != 0:
        raise kernel.last_error()
    os.chdir("/")
    return True


def has_own_proc() -> bool:
    """Return whether /proc shows our own process namespace."""
    return os.readlink("/proc/self") == str(os.getpid())


def _fill(new: str, *, shown: Iterable[str], hidden: Sequence[str]) -> None:
    """Bind the system and the shown paths, cover the hidden ones, and add devices and processes."""
    # A bind that contains the new root must not contain it a second time.
    kernel.mount("none", new, None, MS_UNBINDABLE)
    links: dict[str, str] = {}
    real = [_resolve(path, links) for path in [*SYSTEM, *shown] if os.path.exists(path) and path != "/proc"]
    bound = outermost([path for found in real for path in _parts(found)])
    for path in bound:
        _place(new, path)
    for link, target in sorted(links.items()):
        if not os.path.lexists(f"{new}{link}"):
            os.makedirs(os.path.dirname(f"{new}{link}"), exist_ok=True)
            os.symlink(target, f"{new}{link}")
    for path in hidden:
        if os.path.isdir(f"{new}{path}"):
            kernel.mount("none", f"{new}{path}", "tmpfs", 0, "size=4k,mode=000")
        elif os.path.exists(f"{new}{path}"):
            kernel.mount("/dev/null", f"{new}{path}", None, MS_BIND)
    for path in DEVICES:
        _place(new, path)
    for name, target in _STREAMS.items():
        os.symlink(f"/proc/self/{target}", f"{new}/dev/{name}")
    os.mkdir(f"{new}/proc")
    try:
        kernel.mount("proc", f"{new}/proc", "proc", MS_NOSUID | MS_NODEV | MS_NOEXEC)
    except OSError:  # parts of the system's are covered, as in most containers: then there is no other one
        kernel.mount("/proc", f"{new}/proc", None, MS_BIND | MS_REC)


def _add_scratch(new: str, size_bytes: int) -> list[str]:
    """Mount a folder in memory at its own path in the new root, and once more for shared memory; the two mounts."""
    inside = f"{new}{new}"
    os.makedirs(inside, exist_ok=True)
    kernel.mount("none", inside, "tmpfs", MS_NOSUID | MS_NODEV, f"size={size_bytes},nr_inodes=100k,mode=700")
    shared = f"{new}{SHARED_MEMORY}"
    if os.path.exists(shared):  # code is imported from there
        return [inside]
    os.mkdir(shared)
    kernel.mount(inside, shared, None, MS_BIND)
    return [inside, shared]


def _make_read_only(new: str, *, writable: Sequence[str]) -> None:
    """Remount all there is in the new root, one by one: flags of a bind do not hold for mounts within it."""
    with open("/proc/self/mountinfo", "rb") as file:
        fields = [line.split() for line in file]
    for _, _, _, _, where, options, *_ in fields:
        path = os.fsdecode(where.decode("unicode_escape").encode("latin-1"))
        if path in writable or not f"{path}/".startswith(f"{new}/"):
            continue
        flags = MS_REMOUNT | MS_BIND | MS_RDONLY | MS_NOSUID
        flags |= 0 if path.removeprefix(new) in DEVICES else MS_NODEV
        flags |= MS_NOEXEC if b"noexec" in options.split(b",") else 0
        kernel.mount("none", path, None, flags)


def _place(new: str, path: str) -> None:
    target = f"{new}{path}"
    if os.path.isdir(path):
        os.makedirs(target, exist_ok=True)
    else:
        os.makedirs(os.path.dirname(target), exist_ok=True)
        os.close(os.open(target, os.O_CREAT | os.O_WRONLY, 0o444))
    kernel.mount(path, target, None, MS_BIND | MS_REC)


def _parts(path: str) -> list[str]:
    """A folder; of the root of all folders what may be code."""
    if path != "/":
        return [path]
    return [f"/{name}" for name in os.listdir(path) if name not in _NOT_CODE and not os.path.islink(f"/{name}")]


def _resolve(path: str, links: dict[str, str]) -> str:
    """Resolve a path, and collect the links on the way so that they can be made again."""
    at, rest, count = "", path.split("/")[::-1], 0
    while rest:
        name = rest.pop()
        here = f"{at}/{name}"
        if name in {"", "."}:
            continue
        if name == "..":
            at = at.rpartition("/")[0]
        elif os.path.islink(here) and count < _MOST_LINKS:
            links[here] = os.readlink(here)
            at = "" if links[here].startswith("/") else at
            rest += links[here].split("/")[::-1]
            count += 1
        else:
            at = here
    return at or "/"
