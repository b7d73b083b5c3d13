# SPDX-License-Identifier: Apache-2.0
# ruff: noqa: PLW0108, PTH123, PTH208, S108, SIM115, T201 - a program that breaks in, run by a test in a process that is shut in
"""Tries everything that must not be possible, and some that must; prints what was refused, as JSON."""

import ctypes
import fcntl
import json
import mmap
import os
import resource
import shutil
import signal
import socket
import struct
import subprocess
import sys
import tempfile
import threading
from pathlib import Path

PLACE = json.loads(sys.argv[1]) if __name__ == "__main__" else dict.fromkeys(("shown", "scratch"), "")
SHOWN, SCRATCH = Path(PLACE["shown"]), Path(PLACE["scratch"])
VICTIM = SHOWN / "victim"
LIBC = ctypes.CDLL(None, use_errno=True)


def call(name, *arguments):
    """Call a function of the C library; OSError where it fails."""
    if getattr(LIBC, name)(*arguments) == -1:
        raise OSError(ctypes.get_errno(), name)


def send(family, kind, address):
    """Say who we are to a listener."""
    with socket.socket(family, kind) as link:
        link.settimeout(5)
        link.connect(address)
        link.send(b"x")


def send_by_a_pair():
    ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_DGRAM)
    with ours, theirs:
        ours.connect(PLACE["datagrams"])
        ours.send(b"x")


def change_by_descriptor():
    with VICTIM.open("rb") as file:
        os.fchmod(file.fileno(), 0o600)


def change_program():
    """Give our own program the mode it has: where this gets through, it is the real one."""
    path = Path("/proc/self/exe")
    path.chmod(path.stat().st_mode & 0o7777)


def set_flags():
    with VICTIM.open("rb") as file:
        flags = bytearray(8)
        fcntl.ioctl(file, 0x80086601, flags)
        fcntl.ioctl(
            file, 0x40086602, struct.pack("q", struct.unpack("q", flags)[0] | 0x40)
        )  # to be left out of backups


NOBODY = 4_190_001  # the number of no process, group and user: what finds nobody got through, and hurt nobody
NUMBERS = {"ioprio_set": (251, 30), "move_pages": (279, 239)}


def numbered(name, *arguments):
    """Call the kernel by the number of a call."""
    call("syscall", NUMBERS[name][os.uname().machine == "aarch64"], *arguments)


def nobody(attack):
    try:
        attack()
    except ProcessLookupError:
        return


def own_limits():
    """What libraries do to their own process, which they name by 0 or by its number."""
    for own in (0, os.getpid()):
        resource.prlimit(own, resource.RLIMIT_CORE, resource.prlimit(own, resource.RLIMIT_CORE))
        os.setpriority(os.PRIO_PROCESS, own, os.getpriority(os.PRIO_PROCESS, own))
        os.sched_setaffinity(own, os.sched_getaffinity(own))
    resource.setrlimit(resource.RLIMIT_NOFILE, resource.getrlimit(resource.RLIMIT_NOFILE))
    os.nice(0)


def look_into(number):
    text = ctypes.create_string_buffer(8)
    ours, theirs = struct.pack("QQ", ctypes.addressof(text), 8), struct.pack("QQ", PLACE["address"], 8)
    call("process_vm_readv", number, ours, 1, theirs, 1, 0)


def in_child(attack):
    """Try what changes the process itself in another one; OSError where it fails."""
    child = os.fork()
    if child == 0:
        os._exit(0 if outcome(attack) == "done" else 1)
    if os.waitpid(child, 0)[1]:
        raise OSError("refused")


def fill_scratch():
    files = [SCRATCH / f"filled-{at}" for at in range(16)]
    try:
        for path in files:
            path.write_bytes(bytes(2**19))
    finally:
        for path in files:
            path.unlink(missing_ok=True)


def link_into_scratch():
    os.link(VICTIM, SCRATCH / "linked")


def make_device():
    os.mknod(SCRATCH / "device", 0o600 | 0x2000, os.makedev(1, 3))


def run_thread():
    done = []
    thread = threading.Thread(target=done.append, args=(1,))
    thread.start()
    thread.join()
    assert done


def run_forked():
    child = os.fork()
    if child == 0:
        os._exit(7)
    assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 7


def talk_in_a_pair():
    ours, theirs = socket.socketpair()
    with ours, theirs:
        ours.sendall(b"x")
        assert theirs.recv(1) == b"x"


def use_temporary():
    with tempfile.TemporaryDirectory() as folder, tempfile.NamedTemporaryFile(dir=folder) as file:
        file.write(b"x")
    assert Path(tempfile.gettempdir()) == SCRATCH


def share_memory():
    with open("/dev/shm/shared", "wb+") as file:
        file.truncate(4096)
        mmap.mmap(file.fileno(), 4096)[0] = 1


def copy_with_modes():
    shutil.copy(VICTIM, SCRATCH / "copied")


def start_program():
    assert subprocess.run([sys.executable, "-c", "print(6*7)"], capture_output=True, check=True).stdout == b"42\n"


def take_lease():
    """Have whoever writes to a file wait for us; a lease that has readers wait, too, is taken by the same call."""
    with VICTIM.open("rb") as file:
        fcntl.fcntl(file, 1024, fcntl.F_RDLCK)


ATTACKS = {
    "read the truth": lambda: (SHOWN / "truth/answers").read_bytes()[0],
    "read stored results": lambda: (SHOWN / "truths.parquet").read_bytes()[0],
    "read elsewhere": lambda: Path(PLACE["elsewhere"], "secret").read_bytes()[0],
    "list elsewhere": lambda: os.listdir(PLACE["elsewhere"]),
    "read command lines of others": lambda: Path(f"/proc/{PLACE['other']}/cmdline").read_bytes()[0],
    "write a file": lambda: VICTIM.open("r+b").write(b"y"),
    "empty a file": lambda: os.truncate(VICTIM, 1),
    "make a file": lambda: (SHOWN / "made").touch(),
    "remove a file": lambda: (SHOWN / "removed").unlink(),
    "link a file": link_into_scratch,
    "change a mode": lambda: VICTIM.chmod(0o644),
    "change the mode of a folder": lambda: SHOWN.chmod(0o755),
    "change a mode by descriptor": change_by_descriptor,
    "change the mode of what came along": lambda: os.fchmod(0, 0o640),
    "change the mode of our own program": change_program,
    "change an owner": lambda: os.chown(VICTIM, os.getuid(), os.getgid()),
    "change times": lambda: os.utime(VICTIM, (1, 1)),
    "set an attribute": lambda: os.setxattr(VICTIM, "user.x", b"x"),
    "set a flag": set_flags,
    "change the kernel's settings": lambda: open("/proc/sys/kernel/core_pattern", "r+b"),
    "connect to a path elsewhere": lambda: send(socket.AF_UNIX, socket.SOCK_STREAM, PLACE["stream"]),
    "connect to a path among the code": lambda: send(socket.AF_UNIX, socket.SOCK_STREAM, PLACE["near"]),
    "connect to an abstract name": lambda: send(socket.AF_UNIX, socket.SOCK_STREAM, "\0" + PLACE["abstract"]),
    "send datagrams by a pair": send_by_a_pair,
    "connect by TCP": lambda: send(socket.AF_INET, socket.SOCK_STREAM, ("127.0.0.1", PLACE["tcp"])),
    "send by UDP": lambda: send(socket.AF_INET, socket.SOCK_DGRAM, ("127.0.0.1", PLACE["udp"])),
    "signal another process": lambda: os.kill(PLACE["other"], signal.SIGCONT),
    "lower the limits of another process": lambda: resource.prlimit(PLACE["other"], resource.RLIMIT_CORE, (0, 0)),
    "read the limits of another process": lambda: resource.prlimit(PLACE["other"], resource.RLIMIT_CORE),
    "slow a process": lambda: nobody(lambda: os.setpriority(os.PRIO_PROCESS, NOBODY, 5)),
    "slow a group": lambda: nobody(lambda: os.setpriority(os.PRIO_PGRP, NOBODY, 5)),
    "slow all processes of a user": lambda: nobody(lambda: os.setpriority(os.PRIO_USER, NOBODY, 5)),
    "take a processor from a process": lambda: nobody(lambda: os.sched_setaffinity(NOBODY, os.sched_getaffinity(0))),
    "schedule a process": lambda: nobody(lambda: os.sched_setscheduler(NOBODY, os.SCHED_BATCH, os.sched_param(0))),
    "rank a process": lambda: nobody(lambda: os.sched_setparam(NOBODY, os.sched_param(0))),
    "slow the files of a process": lambda: nobody(lambda: numbered("ioprio_set", 1, NOBODY, 2 << 13 | 7)),
    "slow the files of a group": lambda: nobody(lambda: numbered("ioprio_set", 2, NOBODY, 2 << 13 | 7)),
    "move the memory of a process": lambda: nobody(lambda: numbered("move_pages", NOBODY, 0, None, None, None, 0)),
    "trace another process": lambda: call("ptrace", 0x4206, PLACE["other"], None, None),
    "read the memory of another process": lambda: look_into(PLACE["other"]),
    "hide our own memory": lambda: in_child(lambda: call("prctl", 4, 0, 0, 0, 0)),
    "take covers off": lambda: call("umount2", os.fsencode(SHOWN / "truth"), 2),
    "mount": lambda: call("mount", b"none", os.fsencode(SCRATCH), b"tmpfs", 0, None),
    "change the root": lambda: os.chroot(SCRATCH),
    "make a namespace": lambda: in_child(lambda: call("unshare", 0x10000000)),
    "fork into a namespace": lambda: os.waitpid(_forked(0x10000000), 0),
    "make a device": make_device,
    "fill the disc": fill_scratch,
    "take a lease": take_lease,
    "keep memory secret": lambda: call("syscall", 447, 0),
    "keep memory in the kernel": lambda: call("shmctl", _segment(), 0, None),
}
HARMLESS = {
    "write in scratch": lambda: (SCRATCH / "own").write_bytes(b"x"),
    "threads": run_thread,
    "fork": run_forked,
    "pairs of sockets": talk_in_a_pair,
    "temporary files": use_temporary,
    "programs": start_program,
    "shared memory": share_memory,
    "copies with their modes": copy_with_modes,
    "own limits": own_limits,
    "own processes": lambda: Path("/proc/self/statm").read_bytes()[0],
    "processors": lambda: os.listdir("/sys/devices/system/cpu"),
}


def _segment():
    found = LIBC.shmget(0, 4096, 0o1600)
    if found == -1:
        raise OSError(ctypes.get_errno(), "shmget")
    return found


def _forked(flags):
    number = {"x86_64": 56, "aarch64": 220}[os.uname().machine]
    child = LIBC.syscall(number, flags | signal.SIGCHLD, 0, 0, 0, 0)
    if child == 0:
        os._exit(0)
    if child == -1:
        raise OSError(ctypes.get_errno(), "clone")
    return child


def outcome(attack):
    """What came of it."""
    try:
        attack()
    except (OSError, IndexError):
        return "refused"
    return "done"


if __name__ == "__main__":
    os.chdir(SCRATCH)
    print(json.dumps({name: outcome(attack) for name, attack in {**HARMLESS, **ATTACKS}.items()}))
