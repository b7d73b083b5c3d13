# SPDX-License-Identifier: Apache-2.0
"""Run a module as another system would let it run: `python other_system.py SYSTEM MODULE ARGUMENTS`.

To our own modules, and to these alone, `sys.platform` is SYSTEM (`win32` or `darwin`), and what it lacks is not there:
modules of Linux, names of `os` and `signal`, /proc. Where Windows does otherwise than Linux, files do so for all:
no folder is opened, no name is taken over by `rename`, lines of a text end in two characters. Libraries and their
binary parts are those of Linux. What a real Windows or macOS adds to that is seen in .github/workflows.
"""

import builtins
import io
import os
import runpy
import signal
import subprocess
import sys
from pathlib import Path
from types import ModuleType

OURS = ("sasgeo_bench", "sasgeo_baselines", "sasgeo_paper", "__main__")
LACKING = {
    "darwin": {"modules": {"spwd", "ossaudiodev"}, "os": {"O_PATH", "pidfd_open"}, "signal": {"SIGRTMIN", "SIGPOLL"}},
    "win32": {
        "modules": {"fcntl", "resource", "pwd", "grp", "termios", "tty", "pty", "syslog", "posix", "curses"},
        "os": {
            *("O_PATH", "O_DIRECTORY", "O_NOFOLLOW", "O_CLOEXEC", "O_NONBLOCK", "pidfd_open", "memfd_create", "fork"),
            *("getuid", "geteuid", "getgid", "getegid", "setsid", "killpg", "getpgid", "nice", "uname", "sysconf"),
            *("mkfifo", "statvfs", "fstatvfs", "chown", "wait", "wait4", "makedev", "getloadavg", "WIFEXITED"),
        },
        "signal": {"SIGKILL", "SIGHUP", "SIGALRM", "SIGSTOP", "SIGPIPE", "SIGUSR1", "alarm", "setitimer", "pause"},
    },
}
OF_LINUX = {"sched_getaffinity", "sched_setaffinity", "unshare", "setns", "getrandom", "posix_fadvise"}


def without(module: ModuleType, names: set[str], **changed: object) -> ModuleType:
    """Return a module without some names."""
    less = ModuleType(module.__name__)
    vars(less).update({name: value for name, value in vars(module).items() if name not in names} | changed)
    return less


def importer(system: str):
    """Return an `__import__` that gives our modules what the system has."""
    lacking, plain = LACKING[system], builtins.__import__
    shown = {
        "sys": without(sys, {"getallocatedblocks"}, platform=system),
        "os": without(os, lacking["os"] | OF_LINUX),
        "signal": without(signal, lacking["signal"]),
    }

    def imported(name, globals=None, locals=None, fromlist=(), level=0):  # noqa: A002
        importing = (globals or {}).get("__name__") or ""
        if not level and importing.partition(".")[0] in OURS:
            if name.partition(".")[0] in lacking["modules"]:
                raise ModuleNotFoundError(f"No module named {name!r}")
            if name in shown:
                return shown[name]
        return plain(name, globals, locals, fromlist, level)

    return imported


def hide_proc(system: str) -> None:
    """Hide /proc and /sys from all but psutil, which asks the system; write texts as the system does."""
    opened = io.open

    def open_(file, mode="r", buffering=-1, encoding=None, errors=None, newline=None, **more):
        is_system = isinstance(file, str | os.PathLike) and os.fspath(file).startswith(("/proc", "/sys"))
        if is_system and not sys._getframe(1).f_globals["__name__"].startswith("psutil"):
            raise FileNotFoundError(2, "No such file or directory", os.fspath(file))
        if system == "win32" and "b" not in mode and "r" not in mode and newline is None:
            newline = "\r\n"
        return opened(file, mode, buffering, encoding, errors, newline, **more)

    builtins.open = io.open = open_


def as_windows() -> None:
    """Refuse what Windows refuses: open folders, names taken over, links, flushes of what was opened for reading."""
    import fcntl  # noqa: PLC0415 - of this system

    opened, renamed, flushed = os.open, os.rename, os.fsync

    def open_(path, flags, *rest, **more):
        if Path(path).is_dir():
            raise PermissionError(13, "Permission denied", path)
        return opened(path, flags, *rest, **more)

    def rename(source, target, **more):
        if os.path.lexists(target):
            raise FileExistsError(183, "Cannot create a file when that file already exists", target)
        return renamed(source, target, **more)

    def fsync(descriptor):
        if fcntl.fcntl(descriptor, fcntl.F_GETFL) & os.O_ACCMODE == os.O_RDONLY:
            raise OSError(9, "Bad file descriptor")
        flushed(descriptor)

    def no_link(*_, **__):
        raise OSError(1314, "A required privilege is not held by the client")

    def no_mount(_):
        raise NotImplementedError("Path.is_mount() is unsupported on this system")

    os.open, os.rename, os.fsync, os.symlink, Path.is_mount = open_, rename, fsync, no_link, no_mount


def pass_on(system: str) -> None:
    """Let processes of ours run under the system, too; Windows passes no descriptors on."""
    begun = subprocess.Popen.__init__

    def begin(self, args, *rest, **more):
        if system == "win32" and more.get("pass_fds"):
            raise ValueError("pass_fds not supported on Windows.")
        if isinstance(args, list) and args[:3] == [sys.executable, "-P", "-m"]:
            args = [sys.executable, "-P", __file__, system, *args[3:]]
        begun(self, args, *rest, **more)

    subprocess.Popen.__init__ = begin


def main() -> None:
    """Run a module under the system."""
    system, module, *arguments = sys.argv[1:]
    sys.argv = [module, *arguments]
    hide_proc(system)
    pass_on(system)
    if system == "win32":
        as_windows()
    builtins.__import__ = importer(system)
    runpy.run_module(module, run_name="__main__", alter_sys=True)


if __name__ == "__main__":
    main()
