# SPDX-License-Identifier: Apache-2.0
"""What a matcher's process can reach: namespaces and Landlock where the system has them; what was not possible is said.

Only the standard library, and no thread, may be loaded before `enter`: a namespace of users cannot be entered with more
than one thread, and what is imported afterwards is read under the rules.
"""

import ctypes
import errno
import os
import resource
import signal
import struct
import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Final, NoReturn

CLONE_NEWNS: Final = 0x00020000
CLONE_NEWIPC: Final = 0x08000000
CLONE_NEWUSER: Final = 0x10000000
CLONE_NEWPID: Final = 0x20000000
CLONE_NEWNET: Final = 0x40000000
MS_REC_PRIVATE: Final = 0x4000 | 0x40000
MS_BIND: Final = 0x1000
MS_PROC: Final = 0b1110  # no set-user-id, no devices, nothing executable
PR_SET_PDEATHSIG: Final = 1
PR_SET_NO_NEW_PRIVS: Final = 38
_BY_SIGNAL: Final = 128  # an exit status beyond this says which signal, as shells have it
LANDLOCK_CREATE: Final = 444
LANDLOCK_ADD: Final = 445
LANDLOCK_RESTRICT: Final = 446
LANDLOCK_VERSION: Final = 1
RULE_PATH: Final = 1
_CAPABILITIES: Final = 0x20080522  # version of the structures that say which powers a process has

# Rights of Landlock by the version that brought them; https://docs.kernel.org/userspace-api/landlock.html
READ_RIGHTS: Final = 0b1101  # execute, read file, read directory
LIST_RIGHT: Final = 0b1000  # read directory
_FIRST_RIGHTS: Final = (1 << 13) - 1
_LATER_RIGHTS: Final = {2: 1 << 13, 3: 1 << 14, 5: 1 << 15}  # refer, truncate, ioctl on devices
_FILE_RIGHTS: Final = 0b111 | 1 << 14 | 1 << 15  # those that a rule on a single file may hold
_NET_SINCE, _NET_RIGHTS = 4, 0b11  # bind and connect of TCP
_SCOPE_SINCE, _SCOPES = 6, 0b11  # abstract sockets and signals leave the domain

SYSTEM: Final = ("/usr", "/lib", "/lib64", "/lib32", "/bin", "/sbin", "/etc", "/opt", "/nix", "/proc", "/sys")
# What Python, psutil and libraries of linear algebra read of a /proc that shows other processes, too.
OWN_PROC: Final = (
    *("/proc/self", "/proc/sys", "/proc/cpuinfo", "/proc/meminfo", "/proc/stat", "/proc/filesystems"),
    *("/proc/version", "/proc/uptime", "/proc/loadavg"),
)
DEVICES: Final = ("/dev/null", "/dev/zero", "/dev/random", "/dev/urandom", "/dev/full")


@dataclass(frozen=True, slots=True, kw_only=True)
class Policy:
    """What a process may do.

    Parameters
    ----------
    readable : sequence of str
        Folders and files besides the system's that it may read.
    writable : sequence of str
        Folders that it may write.
    hidden : sequence of str
        Folders and files it must not see, wherever they lie.
    memory_bytes, file_bytes : int
        Address space of each of its processes, and the largest file it may write.
    unsearched : str
        Where nobody looked for what is to be hidden, in words.
    """

    readable: Sequence[str]
    writable: Sequence[str]
    hidden: Sequence[str]
    memory_bytes: int
    file_bytes: int
    unsearched: str = ""


@dataclass(frozen=True, slots=True, kw_only=True)
class Isolation:
    """What was done; each in words for people, "not ..." where the system offers no way."""

    files: str
    truth: str
    network: str
    processes: str

    def to_dict(self) -> dict[str, str]:
        """For `run.json`."""
        return {name: getattr(self, name) for name in ("files", "truth", "network", "processes")}


def enter(policy: Policy) -> Isolation:
    """Shut the process in; where that is possible it returns in a child, in a process namespace of its own.

    Parameters
    ----------
    policy : Policy
        What may be reached.

    Returns
    -------
    Isolation
        What the system offered.
    """
    _prctl(PR_SET_PDEATHSIG, signal.SIGKILL)
    hidden = outermost(policy.hidden)
    spaces = _enter_namespaces()
    covered = [bool(spaces & CLONE_NEWNS) and _cover(folder) for folder in hidden]
    is_hidden = all(covered) and bool(spaces & CLONE_NEWNS)
    if spaces & CLONE_NEWPID:
        _fork_into_namespace()
    has_proc = bool(spaces & CLONE_NEWPID and spaces & CLONE_NEWNS) and _mount_proc()
    _limit(policy)
    version = landlock_version()
    if version > 0:
        unseen = hidden if has_proc else [*hidden, "/proc"]
        rules = [rule for item in (*SYSTEM, *policy.readable) for rule in around(item, unseen)]
        rules += [] if has_proc else [(path, READ_RIGHTS) for path in OWN_PROC]
        _landlock(policy, rules, version)
    if spaces:
        _drop_powers()
    return Isolation(
        files=f"only what is needed (Landlock {version})" if version > 0 else "not limited",
        truth=_truth_words(is_hidden=is_hidden, version=version, unsearched=policy.unsearched),
        network=_network_words(spaces, version),
        processes=_process_words(spaces, has_proc=has_proc, version=version),
    )


def _truth_words(*, is_hidden: bool, version: int, unsearched: str) -> str:
    ways = [
        way for way, used in (("covered by an empty mount", is_hidden), ("refused by Landlock", version > 0)) if used
    ]
    if not ways:
        return "not protected"
    elsewhere = "" if version > 0 else "copies that lie elsewhere can be read"
    return "; ".join(filter(None, (", ".join(ways), elsewhere, unsearched)))


def _process_words(spaces: int, *, has_proc: bool, version: int) -> str:
    apart = "a namespace of their own, all end together" if spaces & CLONE_NEWPID else "not apart"
    if has_proc:
        return f"{apart}; /proc shows no others"
    return f"{apart}; /proc of others {'is refused by Landlock' if version > 0 else 'can be read, command lines too'}"


def _network_words(spaces: int, version: int) -> str:
    if spaces & CLONE_NEWNET:
        return "none (a namespace of its own)"
    return "no TCP (Landlock)" if version >= _NET_SINCE else "not cut"


def landlock_version() -> int:
    """Version of Landlock that the kernel offers; 0 where it has none.

    Examples
    --------
    >>> landlock_version() >= 0
    True
    """
    if sys.platform != "linux":
        return 0
    found = _syscall(LANDLOCK_CREATE, None, 0, LANDLOCK_VERSION)
    return max(0, found)


def _libc() -> ctypes.CDLL:
    return ctypes.CDLL(None, use_errno=True)


def _syscall(number: int, *arguments: object) -> int:
    """Call the kernel; the negative error number where it refuses."""
    libc = _libc()
    libc.syscall.restype = ctypes.c_long
    result = int(libc.syscall(ctypes.c_long(number), *arguments))
    return result if result >= 0 else -ctypes.get_errno()


def _prctl(option: int, value: int) -> bool:
    return sys.platform == "linux" and int(_libc().prctl(option, value, 0, 0, 0)) == 0


def _enter_namespaces() -> int:
    """Enter as many new namespaces as the system allows; the flags of those entered."""
    if sys.platform != "linux":
        return 0
    user, group = os.getuid(), os.getgid()
    wanted = CLONE_NEWNS | CLONE_NEWNET | CLONE_NEWIPC | CLONE_NEWPID
    if _libc().unshare(CLONE_NEWUSER | wanted) != 0:
        return 0
    for name, text in (("setgroups", "deny"), ("uid_map", f"{user} {user} 1"), ("gid_map", f"{group} {group} 1")):
        if not _write(f"/proc/self/{name}", text):
            break
    if _libc().mount(b"none", b"/", None, MS_REC_PRIVATE, None) != 0:
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


def _cover(path: str) -> bool:
    """Put an empty folder over another one, or nothing over a file, for this process and its children alone."""
    if os.path.isdir(path):  # noqa: PTH112 - no pathlib before the door is shut
        return int(_libc().mount(b"none", os.fsencode(path), b"tmpfs", 0, b"size=4k,mode=000")) == 0
    return int(_libc().mount(b"/dev/null", os.fsencode(path), None, MS_BIND, None)) == 0


def _mount_proc() -> bool:
    """Put the /proc of our own process namespace over that of the system, whose command lines are other people's.

    The kernel refuses it where parts of the system's /proc are covered, as in most containers.
    """
    if _libc().mount(b"proc", b"/proc", b"proc", MS_PROC, None) != 0:
        return False
    return os.readlink("/proc/self") == str(os.getpid())  # noqa: PTH115 - no pathlib before the door is shut


def _drop_powers() -> None:
    """Give back what a namespace of users brought: whoever may mount there could take covers off again."""
    _prctl(PR_SET_NO_NEW_PRIVS, 1)
    header, none = struct.pack("Ii", _CAPABILITIES, 0), bytes(24)
    if _libc().capset(header, none) != 0:
        number = ctypes.get_errno()
        raise OSError(number, os.strerror(number))


def _fork_into_namespace() -> None:
    """Go on in a new process namespace, as the second process in it; the two outer ones wait and end as it does.

    Not as the first one: what it sends to itself would not reach it, and orphans would be its own to bury.
    """
    child = os.fork()
    if child:
        _end_as(child, can_die=True)
    _prctl(PR_SET_PDEATHSIG, signal.SIGKILL)
    child = os.fork()
    if child:
        _end_as(child, can_die=False)
    _prctl(PR_SET_PDEATHSIG, signal.SIGKILL)


def _end_as(child: int, *, can_die: bool) -> NoReturn:
    """Wait for a child, bury orphans meanwhile, and end as it did; by its signal, or by its signal's number and 128."""
    while True:
        try:
            found, status = os.wait()
        except InterruptedError:
            continue
        if found == child:
            break
    code = os.WEXITSTATUS(status) if os.WIFEXITED(status) else _BY_SIGNAL + os.WTERMSIG(status)
    if can_die and code > _BY_SIGNAL:
        number = code - _BY_SIGNAL
        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
        if number not in {signal.SIGKILL, signal.SIGSTOP}:
            signal.signal(number, signal.SIG_DFL)
        os.kill(os.getpid(), number)
    os._exit(code)


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


def _landlock(policy: Policy, readable: Sequence[tuple[str, int]], version: int) -> None:
    """Refuse every file that is not allowed; there is no way back for this process and its children."""
    rights = _FIRST_RIGHTS
    for since, later in _LATER_RIGHTS.items():
        rights |= later if version >= since else 0
    attributes = struct.pack(
        "QQQ", rights, _NET_RIGHTS if version >= _NET_SINCE else 0, _SCOPES if version >= _SCOPE_SINCE else 0
    )
    size = 24 if version >= _SCOPE_SINCE else 16 if version >= _NET_SINCE else 8
    ruleset = _syscall(LANDLOCK_CREATE, ctypes.c_char_p(attributes), ctypes.c_size_t(size), 0)
    if ruleset < 0:
        raise OSError(-ruleset, os.strerror(-ruleset))
    allowed = [*readable, *((path, READ_RIGHTS | 0b10) for path in DEVICES)]
    allowed += [(path, rights) for path in policy.writable]
    for path, granted in allowed:
        _allow(ruleset, path, granted & rights)
    _prctl(PR_SET_NO_NEW_PRIVS, 1)
    refused = _syscall(LANDLOCK_RESTRICT, ruleset, 0)
    os.close(ruleset)
    if refused < 0:
        raise OSError(-refused, os.strerror(-refused))


def _allow(ruleset: int, path: str, rights: int) -> None:
    """Add a rule for a folder or a file; one that is not there is passed over."""
    try:
        descriptor = os.open(path, os.O_PATH | os.O_CLOEXEC)
    except OSError:
        return
    try:
        if not os.path.isdir(path):  # noqa: PTH112 - no pathlib before the door is shut
            rights &= _FILE_RIGHTS
        rule = struct.pack("=Qi", rights, descriptor)
        added = _syscall(LANDLOCK_ADD, ruleset, RULE_PATH, ctypes.c_char_p(rule), 0)
        if added < 0 and added != -errno.EINVAL:
            raise OSError(-added, os.strerror(-added), path)
    finally:
        os.close(descriptor)


def outermost(paths: Sequence[str]) -> list[str]:
    """Where paths lead to that exist, without those that lie within another: what is covered has nothing within.

    Examples
    --------
    >>> outermost(["/usr/lib", "/usr", "/usr/../usr", "/nowhere"])
    ['/usr']
    """
    found: list[str] = []
    for path in sorted({os.path.realpath(path) for path in paths}, key=lambda path: path.split("/")):
        if os.path.exists(path) and not (found and path.startswith(f"{found[-1]}/")):  # noqa: PTH110 - no pathlib yet
            found.append(path)
    return found


def around(path: str, hidden: Sequence[str]) -> Iterator[tuple[str, int]]:
    """A path with the right to read it; where something hidden lies within, all else that lies there now.

    Of a folder that holds something hidden the names can be listed, or nothing in it could be imported. Links in it
    are passed over: what they lead to is read where it lies, if that is in reach, and nobody looked through it else.

    Examples
    --------
    >>> [name for name, _ in around("/usr", ["/home/me/truth"])]
    ['/usr']
    >>> list(around("/home/me/truth/vaduz", ["/home/me/truth"]))
    []
    """
    real = os.path.realpath(path)
    if any(real == folder or real.startswith(f"{folder}/") for folder in hidden):
        return
    inside = [folder for folder in hidden if folder.startswith(f"{real.rstrip('/')}/")]
    if not inside:
        yield path, READ_RIGHTS
        return
    try:
        names = sorted(os.listdir(real))  # noqa: PTH208 - no pathlib before the door is shut
    except OSError:
        return
    yield real, LIST_RIGHT
    for name in names:
        inner = f"{real.rstrip('/')}/{name}"
        if not os.path.islink(inner):  # noqa: PTH114 - no pathlib before the door is shut
            yield from around(inner, hidden)
