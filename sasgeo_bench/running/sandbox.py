# SPDX-License-Identifier: Apache-2.0
"""Isolate a matcher's process by namespaces, Landlock and seccomp where the system has them; report what it lacks.

Only the standard library, and no thread, may be loaded before `enter`: a user namespace cannot be entered with more
than one thread. Afterwards start a new program: the old one still holds files of the system's root.
"""

import os
import signal
import struct
import sys
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass
from types import FrameType
from typing import Final, NoReturn

from sasgeo_bench.running import kernel
from sasgeo_bench.running.kernel import READ_RIGHTS, WRITE_RIGHT, around, landlock_version, outermost, restrict

if sys.platform != "win32":
    import resource

# ruff: noqa: PTH102, PTH103, PTH110, PTH112, PTH114, PTH115, PTH120, PTH123, PTH208, PTH211
# Without pathlib, which is slow to load: this runs before the sandbox is closed.


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


CLONE_NEWNS: Final = 0x00020000
CLONE_NEWIPC: Final = 0x08000000
CLONE_NEWUSER: Final = 0x10000000
CLONE_NEWPID: Final = 0x20000000
CLONE_NEWNET: Final = 0x40000000
MS_REC_PRIVATE: Final = 0x4000 | 0x40000
_BY_SIGNAL: Final = 128  # an exit status beyond this states the signal, as in shells
_NO_TRUTH: Final = "not in its root"
_REFUSED: Final = "refused by Landlock"
_AND: Final = " | "  # between the isolations of several processes of one run
_CAPABILITIES: Final = 0x20080522  # version of the structures of capset

# Files that Python, psutil and libraries of linear algebra read in a /proc that shows other processes, too.
OWN_PROC: Final = (
    *("/proc/self", "/proc/sys", "/proc/cpuinfo", "/proc/meminfo", "/proc/stat", "/proc/filesystems"),
    *("/proc/version", "/proc/uptime", "/proc/loadavg"),
)


@dataclass(frozen=True, slots=True, kw_only=True)
class Policy:
    """Permissions of a process: paths it may read besides the system's, and limits.

    `scratch` is an empty resolved folder, the only writable one; `hidden` paths stay hidden wherever they lie. The
    limits hold for the address space of each process, the largest file, and all files together. `unsearched` describes
    where no search for paths to hide was made.
    """

    readable: Sequence[str]
    scratch: str
    hidden: Sequence[str]
    memory_bytes: int
    file_bytes: int
    scratch_bytes: int
    unsearched: str = ""


@dataclass(frozen=True, slots=True, kw_only=True)
class Isolation:
    """Protections that were applied, each in words; also those that the system lacks."""

    files_read: str
    files_changed: str
    truth: str
    network: str
    processes: str
    scratch: str

    def to_dict(self) -> dict[str, str]:
        """Return the words for `run.json`."""
        return asdict(self)


PROMISES: Final = (*Isolation.__dataclass_fields__, "memory")  # the last one is enforced from outside


@dataclass(frozen=True, slots=True, kw_only=True)
class _Walls:
    """Protections around a process: flags of namespaces, version of Landlock, the others yes or no."""

    spaces: int
    has_root: bool
    has_proc: bool
    landlock: int
    has_filter: bool


def enter(policy: Policy) -> Isolation:
    """Isolate the process; return in a child, in its own process namespace where the system allows one."""
    if os.path.realpath(policy.scratch) != policy.scratch:  # mounts are known by their resolved paths
        raise OSError(f"{policy.scratch} leads elsewhere, expected a resolved folder")
    hidden = outermost(policy.hidden)
    spaces = _enter_namespaces()
    has_pid_namespace = bool(spaces & CLONE_NEWPID)
    _fork(_Keeper(has_pid_namespace=has_pid_namespace, can_die=True))
    has_root = bool(spaces & CLONE_NEWNS) and enter_root(
        policy.scratch, shown=policy.readable, hidden=hidden, scratch_bytes=policy.scratch_bytes
    )
    has_proc = has_pid_namespace and has_root and has_own_proc()
    if has_pid_namespace:  # not the first process in it, which gets no signals from itself and must adopt orphans
        _fork(_Keeper(has_pid_namespace=True, can_die=False))
    if has_root:  # an inherited descriptor would give access to the system's root
        nothing = os.open("/dev/null", os.O_RDONLY)
        os.dup2(nothing, 0)
        os.close(nothing)
    _limit(policy)
    version = landlock_version()
    if version > 0:
        unseen = hidden if has_proc else [*hidden, "/proc"]
        rules = [rule for item in (*SYSTEM, *policy.readable) for rule in around(item, unseen)]
        rules += [] if has_proc else [(path, READ_RIGHTS) for path in OWN_PROC]
        rules += [(path, READ_RIGHTS | WRITE_RIGHT) for path in DEVICES]
        restrict(rules, [policy.scratch, *([SHARED_MEMORY] if has_root else [])], version)
    _drop_powers()
    walls = _Walls(
        spaces=spaces,
        has_root=has_root,
        has_proc=has_proc,
        landlock=version,
        has_filter=kernel.refuse(metadata=not has_root),
    )
    return _described(walls, policy)


def _described(walls: _Walls, policy: Policy) -> Isolation:
    return Isolation(
        files_read=_joined(
            "a root of its own with what is needed" if walls.has_root else "",
            f"only what is needed (Landlock {walls.landlock})" if walls.landlock > 0 else "",
            otherwise="not limited",
        ),
        files_changed=_changed_words(walls),
        truth=_truth_words(walls, policy.unsearched),
        network=_network_words(walls),
        processes=_process_words(walls),
        scratch=f"{policy.scratch_bytes / 1e6:.0f} MB in memory at most"
        if walls.has_root
        else f"files of {policy.file_bytes / 1e6:.0f} MB at most, as many as the disc holds",
    )


def _joined(*ways: str, otherwise: str) -> str:
    return ", ".join(filter(None, ways)) or otherwise


def _changed_words(walls: _Walls) -> str:
    if walls.has_root:
        return "only its scratch folder, all else is mounted read only"
    if walls.landlock == 0:
        no_metadata = "not limited, but no modes, owners, times and attributes (seccomp)"
        return no_metadata if walls.has_filter else "not limited"
    kept = f"only its scratch folder (Landlock {walls.landlock})"
    emptied = "" if walls.landlock >= kernel.TRUNCATE_SINCE else "; others can be emptied"
    metadata = "can be changed everywhere" if not walls.has_filter else "cannot be changed anywhere (seccomp)"
    return f"{kept}{emptied}; modes, owners, times and attributes {metadata}"


def joined(isolations: Iterable[Mapping[str, str]]) -> dict[str, str]:
    """Join the isolations of several processes, each text once.

    >>> joined([{"truth": "not in its root"}, {"truth": "not protected"}, {"truth": "not protected"}])
    {'truth': 'not in its root | not protected'}
    """
    words: dict[str, list[str]] = {}
    for isolation in isolations:
        for name, text in isolation.items():
            words.setdefault(name, []).extend(text.split(_AND))
    return {name: _AND.join(dict.fromkeys(texts)) for name, texts in words.items()}


UNGUARDED: Final = "trusted code, not shut in"  # each promise of a run without the sandbox


def is_unguarded(isolation: Mapping[str, str]) -> bool:
    """Return whether any process of a run was outside the sandbox.

    >>> [is_unguarded({"truth": words}) for words in ("not in its root", "not in its root | trusted code, not shut in")]
    [False, True]
    """
    return UNGUARDED in isolation.get("truth", "").split(_AND)


def keeps_truth(isolation: Mapping[str, str]) -> bool:
    """Return whether truths were kept from all processes of a run.

    >>> [keeps_truth({"truth": words}) for words in ("not in its root, refused by Landlock", "not protected")]
    [True, False]
    """
    return all(part.startswith((_NO_TRUTH, _REFUSED)) for part in isolation.get("truth", "").split(_AND))


def _truth_words(walls: _Walls, unsearched: str) -> str:
    ways = _joined(_NO_TRUTH if walls.has_root else "", _REFUSED if walls.landlock > 0 else "", otherwise="")
    return "; ".join(filter(None, (ways, unsearched))) if ways else "not protected"


def _network_words(walls: _Walls) -> str:
    """Describe how the network is cut, local sockets included."""
    if walls.has_filter:
        space = ", a namespace of its own" if walls.spaces & CLONE_NEWNET else ""
        return f"none, no socket can be made (seccomp){space}"
    if walls.spaces & CLONE_NEWNET:
        where = "in folders that it may read" if walls.has_root else "anywhere"
        return f"no way out (a namespace of its own); local sockets with a path {where} can be reached"
    if walls.landlock >= kernel.NET_SINCE:
        return "no TCP (Landlock); all else can be reached, local sockets too"
    return "not cut"


def _process_words(walls: _Walls) -> str:
    where = "among others, all end together while the one that keeps them lives"
    if walls.spaces & CLONE_NEWPID:
        where = "a namespace of their own, all end together"
    elif walls.landlock >= kernel.SCOPE_SINCE:
        where = "among others, which cannot be signalled (Landlock), all end together"
    if walls.has_proc:
        return f"{where}; /proc shows no others"
    is_refused = walls.landlock > 0
    return f"{where}; /proc of others {'is refused by Landlock' if is_refused else 'can be read, command lines too'}"


def _enter_namespaces() -> int:
    """Enter as many new namespaces as the system allows; return the flags of those entered."""
    if sys.platform != "linux":
        return 0
    user, group = os.getuid(), os.getgid()
    wanted = CLONE_NEWNS | CLONE_NEWNET | CLONE_NEWIPC | CLONE_NEWPID
    if kernel.libc().unshare(CLONE_NEWUSER | wanted) != 0:
        return 0
    for name, text in (("setgroups", "deny"), ("uid_map", f"{user} {user} 1"), ("gid_map", f"{group} {group} 1")):
        if not _write(f"/proc/self/{name}", text):
            break
    try:
        kernel.mount("none", "/", None, MS_REC_PRIVATE)
    except OSError:
        return wanted & ~CLONE_NEWNS
    return wanted


def _write(path: str, text: str) -> bool:
    try:
        descriptor = os.open(path, os.O_WRONLY)
    except OSError:
        return False
    try:
        os.write(descriptor, text.encode())
    except OSError:
        return False
    finally:
        os.close(descriptor)
    return True


def _drop_powers() -> None:
    """Drop the privileges of root or of a user namespace: a process that may mount could uncover hidden files."""
    if not kernel.prctl(kernel.PR_SET_NO_NEW_PRIVS, 1):
        return  # no Linux
    header, none = struct.pack("Ii", _CAPABILITIES, 0), bytes(24)
    if kernel.libc().capset(header, none) != 0:
        raise kernel.last_error()


def _fork(keeper: "_Keeper") -> None:
    """Continue in a child; this process keeps it, and ends as it does."""
    keeper.prepare()
    parent = os.getpid()
    child = os.fork()
    if child:
        keeper.keep(child)
    kernel.prctl(kernel.PR_SET_CHILD_SUBREAPER, 0)
    signal.signal(signal.SIGTERM, signal.SIG_DFL)
    kernel.prctl(kernel.PR_SET_PDEATHSIG, signal.SIGKILL)
    if os.getppid() not in {parent, 0}:  # it ended before we asked to end with it; 0 is a parent out of our namespace
        os._exit(1)


@dataclass(frozen=True, slots=True, kw_only=True)
class _Keeper:
    """A process that waits for its child, reaps orphans meanwhile, and leaves no process behind when either ends.

    If the child has a process namespace (`has_pid_namespace`), all in it end with its first process. Otherwise
    processes that leave their parents become children of the keeper.
    """

    has_pid_namespace: bool
    can_die: bool

    def prepare(self) -> None:
        if not self.has_pid_namespace:
            kernel.prctl(kernel.PR_SET_CHILD_SUBREAPER, 1)

    def keep(self, child: int) -> NoReturn:
        """Wait for a child and end as it did; by its signal, or by its signal's number and 128."""

        def end(number: int, frame: FrameType | None) -> NoReturn:
            del frame
            self._kill(child)
            os._exit(_BY_SIGNAL + number)

        if self.can_die:
            signal.signal(signal.SIGTERM, end)
            kernel.prctl(kernel.PR_SET_PDEATHSIG, signal.SIGTERM)
        kernel.prctl(kernel.PR_SET_DUMPABLE, 0)  # it still has the system's root: refuse looks into it
        _drop_powers()
        status = None
        while status is None:
            found, ended = os.wait()
            status = ended if found == child else None
        code = os.WEXITSTATUS(status) if os.WIFEXITED(status) else _BY_SIGNAL + os.WTERMSIG(status)
        self._kill(0)
        if self.can_die and code > _BY_SIGNAL:
            number = code - _BY_SIGNAL
            resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
            if number not in {signal.SIGKILL, signal.SIGSTOP}:
                signal.signal(number, signal.SIG_DFL)
            os.kill(os.getpid(), number)
        os._exit(code)

    def _kill(self, child: int) -> None:
        """Kill a child, if given, and without a namespace all descendants; wait until they are gone."""
        while True:
            for number in [child] if self.has_pid_namespace else _below(os.getpid()):
                if number:
                    _kill(number)
            if self.has_pid_namespace and not child:
                return
            try:
                os.wait()
            except ChildProcessError:
                return


def _kill(number: int) -> None:
    try:
        os.kill(number, signal.SIGKILL)
    except OSError:
        return


def _below(root: int) -> list[int]:
    """Return the numbers of a process's descendants, as /proc shows them."""
    parents: dict[int, int] = {}
    names = os.listdir("/proc") if os.path.isdir("/proc") else []
    for name in names:
        try:
            with open(f"/proc/{name}/stat", "rb") as file:
                parents[int(name)] = int(file.read().rpartition(b")")[2].split()[1])
        except (OSError, ValueError):
            continue
    found: list[int] = []
    last = {root}
    while last:
        last = {number for number, parent in parents.items() if parent in last}
        found += last
    return found


def _limit(policy: Policy) -> None:
    limits = {
        resource.RLIMIT_AS: policy.memory_bytes,
        resource.RLIMIT_FSIZE: policy.file_bytes,
        resource.RLIMIT_CORE: 0,
        resource.RLIMIT_NOFILE: 1024,
    }
    for kind, value in limits.items():
        _, most = resource.getrlimit(kind)
        least = value if most == resource.RLIM_INFINITY else min(value, most)
        resource.setrlimit(kind, (least, least))
