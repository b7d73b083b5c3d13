# SPDX-License-Identifier: Apache-2.0
"""System calls of Linux without a name in Python: Landlock, and a seccomp filter in classic BPF."""

import ctypes
import errno
import os
import struct
import sys
from collections.abc import Iterator, Sequence
from typing import Final

PR_SET_PDEATHSIG: Final = 1
PR_SET_DUMPABLE: Final = 4
PR_SET_CHILD_SUBREAPER: Final = 36
PR_SET_NO_NEW_PRIVS: Final = 38


def libc() -> ctypes.CDLL:
    """Load the C library; a call that fails leaves its error number for `last_error`."""
    return ctypes.CDLL(None, use_errno=True)


def last_error() -> OSError:
    """Return the error of the last call that failed."""
    number = ctypes.get_errno()
    return OSError(number, os.strerror(number))


def syscall(number: int, *arguments: object) -> int:
    """Call the kernel by number; return the negative error number if it refuses."""
    library = libc()
    library.syscall.restype = ctypes.c_long
    result = int(library.syscall(ctypes.c_long(number), *arguments))
    return result if result >= 0 else -ctypes.get_errno()


def prctl(option: int, value: int) -> bool:
    """Set a property of this process; return False where the system does not know it."""
    return sys.platform == "linux" and int(libc().prctl(option, value, 0, 0, 0)) == 0


def mount(source: str, target: str, kind: str | None, flags: int, data: str = "") -> None:
    """Mount something, or change a mount; raise `OSError` if the kernel refuses."""
    given = (os.fsencode(source), os.fsencode(target), kind.encode() if kind else None)
    if libc().mount(*given, ctypes.c_ulong(flags), data.encode() or None) != 0:
        raise last_error()


LANDLOCK_CREATE: Final = 444
LANDLOCK_ADD: Final = 445
LANDLOCK_RESTRICT: Final = 446
LANDLOCK_VERSION: Final = 1
RULE_PATH: Final = 1

# Rights of Landlock by the version that brought them; https://docs.kernel.org/userspace-api/landlock.html
READ_RIGHTS: Final = 0b1101  # execute, read file, read directory
WRITE_RIGHT: Final = 0b10  # write file
LIST_RIGHT: Final = 0b1000  # read directory
_FIRST_RIGHTS: Final = (1 << 13) - 1
TRUNCATE_SINCE: Final = 3
_LATER_RIGHTS: Final = {2: 1 << 13, TRUNCATE_SINCE: 1 << 14, 5: 1 << 15}  # refer, truncate, ioctl on devices
_FILE_RIGHTS: Final = 0b111 | 1 << 14 | 1 << 15  # those that a rule on a single file may hold
NET_SINCE: Final = 4
_NET_RIGHTS: Final = 0b11  # bind and connect of TCP
SCOPE_SINCE: Final = 6
_SCOPES: Final = 0b11  # abstract sockets and signals leave the domain


def landlock_version() -> int:
    """Return the version of Landlock that the kernel offers, 0 without Landlock."""
    if sys.platform != "linux":
        return 0
    return max(0, syscall(LANDLOCK_CREATE, None, 0, LANDLOCK_VERSION))


def restrict(allowed: Sequence[tuple[str, int]], writable: Sequence[str], version: int) -> None:
    """Refuse access to all files that are not allowed, for good, to this process and its children.

    `allowed` gives paths, and the rights to them and their contents; `writable` folders have all rights. `version` is
    that of Landlock, at least 1.
    """
    rights = _FIRST_RIGHTS
    for since, later in _LATER_RIGHTS.items():
        rights |= later if version >= since else 0
    attributes = struct.pack(
        "QQQ", rights, _NET_RIGHTS if version >= NET_SINCE else 0, _SCOPES if version >= SCOPE_SINCE else 0
    )
    size = 24 if version >= SCOPE_SINCE else 16 if version >= NET_SINCE else 8
    ruleset = syscall(LANDLOCK_CREATE, ctypes.c_char_p(attributes), ctypes.c_size_t(size), 0)
    if ruleset < 0:
        raise OSError(-ruleset, os.strerror(-ruleset))
    for path, granted in (*allowed, *((path, rights) for path in writable)):
        _allow(ruleset, path, granted & rights)
    prctl(PR_SET_NO_NEW_PRIVS, 1)
    refused = syscall(LANDLOCK_RESTRICT, ruleset, 0)
    os.close(ruleset)
    if refused < 0:
        raise OSError(-refused, os.strerror(-refused))


def _allow(ruleset: int, path: str, rights: int) -> None:
    """Add a rule for a folder or file, if it exists."""
    try:
        descriptor = os.open(path, os.O_PATH | os.O_CLOEXEC)
    except OSError:
        return
    try:
        if not os.path.isdir(path):  # noqa: PTH112 - no pathlib before the sandbox is closed
            rights &= _FILE_RIGHTS
        rule = struct.pack("=Qi", rights, descriptor)
        added = syscall(LANDLOCK_ADD, ruleset, RULE_PATH, ctypes.c_char_p(rule), 0)
        if added < 0 and added != -errno.EINVAL:
            raise OSError(-added, os.strerror(-added), path)
    finally:
        os.close(descriptor)


def outermost(paths: Sequence[str]) -> list[str]:
    """Resolve paths that exist, and drop those inside another one.

    >>> outermost(["/usr/lib", "/usr", "/usr/../usr", "/nowhere"])
    ['/usr']
    """
    found: list[str] = []
    for path in sorted({os.path.realpath(path) for path in paths}, key=lambda path: path.split("/")):
        if os.path.exists(path) and not (found and path.startswith(f"{found[-1]}/")):  # noqa: PTH110 - no pathlib yet
            found.append(path)
    return found


def around(path: str, hidden: Sequence[str]) -> Iterator[tuple[str, int]]:
    """Yield a path with the right to read it or, if it contains hidden paths, everything else in it.

    The names in a folder that contains something hidden can be listed, or nothing in it could be imported. Links in it
    are skipped: their targets are read where they lie, if they are readable.

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
        names = sorted(os.listdir(real))  # noqa: PTH208 - no pathlib before the sandbox is closed
    except OSError:
        return
    yield real, LIST_RIGHT
    for name in names:
        inner = f"{real.rstrip('/')}/{name}"
        if not os.path.islink(inner):  # noqa: PTH114 - no pathlib before the sandbox is closed
            yield from around(inner, inside)


_SECCOMP: Final = {"x86_64": 317, "aarch64": 277}
_ARCHITECTURE: Final = {"x86_64": 0xC000003E, "aarch64": 0xC00000B7}  # AUDIT_ARCH_..., of linux/audit.h
_SET_FILTER, _SPEC_ALLOW = 1, 1 << 2  # the second one: do not slow down memory because of a filter
_X32: Final = 0x40000000  # calls of x86_64 with short pointers have numbers of their own
_ALLOW, _REFUSE = 0x7FFF0000, 0x00050000
_LOAD, _EQUAL, _AT_LEAST, _ANY_BIT, _AND, _RETURN = 0x20, 0x15, 0x35, 0x45, 0x54, 0x06
_NUMBER_AT, _ARCHITECTURE_AT, _ARGUMENTS_AT = 0, 4, 16

# Names, and numbers on x86_64 and aarch64 as in asm/unistd_64.h and asm-generic/unistd.h; 0 where there is no call.
DANGEROUS: Final = (
    # Mounts, namespaces and roots, which could uncover hidden files.
    "mount 165 40, umount2 166 39, pivot_root 155 41, chroot 161 51, unshare 272 97, setns 308 268",
    "open_tree 428 428, move_mount 429 429, fsopen 430 430, fsconfig 431 431, fsmount 432 432, fspick 433 433",
    "mount_setattr 442 442, open_tree_attr 467 467, open_by_handle_at 304 265",
    # Memory and files of other processes.
    "ptrace 101 117, process_vm_readv 310 270, process_vm_writev 311 271, process_madvise 440 440",
    "pidfd_getfd 438 438, kcmp 312 272",
    # Keys, programs in the kernel, rings of calls that no filter sees, faults and counters that reveal others.
    "add_key 248 217, request_key 249 218, keyctl 250 219, bpf 321 280",
    "io_uring_setup 425 425, userfaultfd 323 282, perf_event_open 298 241",
    # Sockets: no namespace separates those that have a path. Connected pairs remain.
    "socket 41 198, connect 42 203",
    # Memory and queues that outlive their process, or that cannot be counted from outside.
    "memfd_secret 447 447, shmget 29 194, semget 64 190, msgget 68 186, mq_open 240 180",
)
# What Landlock does not refuse: modes, owners, times and attributes, and before version 3 the length of a file by path.
METADATA: Final = (
    "chmod 90 0, fchmod 91 52, fchmodat 268 53, fchmodat2 452 452",
    "chown 92 0, fchown 93 55, lchown 94 0, fchownat 260 54",
    "utime 132 0, utimes 235 0, futimesat 261 0, utimensat 280 88",
    "setxattr 188 5, lsetxattr 189 6, fsetxattr 190 7, setxattrat 463 463",
    "removexattr 197 14, lremovexattr 198 15, fremovexattr 199 16, removexattrat 466 466",
    "file_setattr 469 469, truncate 76 45",
)
# Calls that name a process whose limits, priority, processors or memory they change, and which argument names it. 0 is
# the calling process, as the C library says it. A limit of time or files, lowered, would end the runner.
_OF_PROCESSES: Final = (
    ("prlimit64 302 261, sched_setparam 142 118, sched_setscheduler 144 119, sched_setaffinity 203 122", 0),
    ("sched_setattr 314 274, migrate_pages 256 238, move_pages 279 239", 0),
    ("setpriority 141 140, ioprio_set 251 30", 1),
)
# The first argument of the last two says what the second one names: a process, not a group, nor all of a user.
_ONE_PROCESS: Final = {"setpriority": 0, "ioprio_set": 1}
PR_SCHED_CORE: Final = 62  # has processors shared with another process, or not
_IOCTL: Final = {"x86_64": 16, "aarch64": 29}
_FILE_GROUPS: Final = (0x6600, 0x5800)  # groups "f" and "X" of ioctl: flags of files, sealing them
_GROUP: Final = 0xFF00
_SOCKETPAIR: Final = {"x86_64": 53, "aarch64": 199}
_KIND, _DATAGRAM = 0xF, 2
_PRCTL: Final = {"x86_64": 157, "aarch64": 167}
_FCNTL: Final = {"x86_64": 72, "aarch64": 25}
_LEASES: Final = (1024, 1026)  # F_SETLEASE and F_NOTIFY: a lease blocks all others who open the file
_CLONE: Final = {"x86_64": 56, "aarch64": 220}
_NEW_SPACES: Final = 0x7E020000  # all CLONE_NEW... that clone takes
_CLONE3: Final = 435


def is_offered() -> bool:
    """Return whether the system call numbers of this processor are known here."""
    is_linux = os.uname().sysname == "Linux"
    return is_linux and os.uname().machine in _ARCHITECTURE and struct.calcsize("P") == 8  # bytes of a pointer


def refuse(*, metadata: bool) -> bool:
    """Refuse dangerous calls, for good, to this process and its children; return False where the kernel cannot.

    With `metadata`, refuse changes of modes, owners, times and attributes of all files, too.
    """
    if not is_offered():
        return False
    prctl(PR_SET_NO_NEW_PRIVS, 1)
    code = program(os.uname().machine, metadata=metadata, own=os.getpid())
    buffer = ctypes.create_string_buffer(code, len(code))
    given = struct.pack("HxxxxxxQ", len(code) // 8, ctypes.addressof(buffer))
    number = _SECCOMP[os.uname().machine]
    return any(syscall(number, _SET_FILTER, flags, ctypes.c_char_p(given)) == 0 for flags in (_SPEC_ALLOW, 0))


def program(machine: str, *, metadata: bool, own: int) -> bytes:
    """Return the filter of the process `own` for a kind of processor, eight bytes for each step."""
    refused = ", ".join((*DANGEROUS, *(METADATA if metadata else ()))).split(", ")
    numbers = [number for _, number in _numbered(refused, machine)]
    steps = [_step(_LOAD, _ARCHITECTURE_AT), _step(_EQUAL, _ARCHITECTURE[machine], yes=1), _answer(errno.EPERM)]
    steps += [_step(_LOAD, _NUMBER_AT), _step(_AT_LEAST, _X32, no=1), _answer(errno.ENOSYS)]
    # The arguments of clone3 lie in memory, where no filter sees them: libraries then use clone.
    steps += [_step(_EQUAL, _CLONE3, no=1), _answer(errno.ENOSYS)]
    for number in filter(None, numbers):
        steps += [_step(_EQUAL, number, no=1), _answer(errno.EPERM)]
    steps += _own_alone(machine, own)
    steps += _by_argument(_CLONE[machine], 0, [_step(_ANY_BIT, _NEW_SPACES, no=1), _answer(errno.EPERM)])
    # A pair of datagram sockets can be connected anew, to a path; one of streams cannot.
    kinds = [_step(_AND, _KIND), _step(_EQUAL, _DATAGRAM, no=1), _answer(errno.EPERM)]
    steps += _by_argument(_SOCKETPAIR[machine], 1, kinds)
    # A process that is not dumpable would hide its memory from the runner.
    dumpable = [_step(_EQUAL, PR_SET_DUMPABLE, no=1), _answer(errno.EPERM)]
    steps += _by_argument(_PRCTL[machine], 0, [*dumpable, _step(_EQUAL, PR_SCHED_CORE, no=1), _answer(errno.EPERM)])
    leases = [step for command in _LEASES for step in (_step(_EQUAL, command, no=1), _answer(errno.EPERM))]
    steps += _by_argument(_FCNTL[machine], 1, leases)
    if metadata:
        groups = [step for group in _FILE_GROUPS for step in (_step(_EQUAL, group, no=1), _answer(errno.EPERM))]
        steps += _by_argument(_IOCTL[machine], 1, [_step(_AND, _GROUP), *groups])
    return b"".join([*steps, _step(_RETURN, _ALLOW)])


def _numbered(calls: Sequence[str], machine: str) -> list[tuple[str, int]]:
    at = 1 + list(_ARCHITECTURE).index(machine)
    return [(call.split()[0], int(call.split()[at])) for call in calls]


def _own_alone(machine: str, own: int) -> Iterator[bytes]:
    """Yield steps that refuse to change how other processes than `own` may run: it names itself by number or 0."""
    for calls, argument in _OF_PROCESSES:
        for name, number in _numbered(calls.split(", "), machine):
            steps = [_step(_EQUAL, 0, yes=2), _step(_EQUAL, own, yes=1), _answer(errno.EPERM)]
            if name in _ONE_PROCESS:
                load = _step(_LOAD, _ARGUMENTS_AT + 8 * argument)
                steps = [_step(_EQUAL, _ONE_PROCESS[name], yes=1), _answer(errno.EPERM), load, *steps]
            yield from _by_argument(number, 0, steps)


def _by_argument(number: int, argument: int, steps: list[bytes]) -> Iterator[bytes]:
    """Yield steps on the low half of an argument of one call, which passes if none of them refuses it."""
    yield _step(_EQUAL, number, no=len(steps) + 2)
    yield _step(_LOAD, _ARGUMENTS_AT + 8 * argument)
    yield from steps
    yield _step(_RETURN, _ALLOW)


def _step(code: int, value: int, *, yes: int = 0, no: int = 0) -> bytes:
    return struct.pack("HBBI", code, yes, no, value)


def _answer(number: int) -> bytes:
    return _step(_RETURN, _REFUSE | number)
