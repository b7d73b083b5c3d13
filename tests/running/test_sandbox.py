# SPDX-License-Identifier: Apache-2.0
"""A process is shut in as well as the system allows, and what it lacks is said; every lack and attack is tried here."""

import contextlib
import ctypes
import json
import os
import re
import socket
import subprocess
import sys
from pathlib import Path

import pytest

from sasgeo_bench.running import kernel, sandbox

HAS_SPACES = subprocess.run(["unshare", "-Urm", "true"], capture_output=True, check=False).returncode == 0  # noqa: S607
HAS_LANDLOCK = sandbox.landlock_version() >= kernel.SCOPE_SINCE
HERE = Path(__file__).parent
MOST_BYTES = 4 * 2**20  # of the scratch folder; the attack writes twice as much

# A bare interpreter, as the runner starts it, with some of the ways taken from it; then the attacks as a program anew.
PROGRAM = """
import json, os, sys
sys.path.append(sys.argv[1])
from sasgeo_bench.running import kernel
from sasgeo_bench.running import sandbox
def refused(*given):
    raise OSError(1, "not here")
really = kernel.mount
without = {
    "namespaces": lambda: setattr(sandbox, "_enter_namespaces", lambda: 0),
    "Landlock": lambda: setattr(sandbox, "landlock_version", lambda: 0),
    "seccomp": lambda: setattr(kernel, "is_offered", lambda: False),
    "mounts": lambda: setattr(kernel, "mount", lambda *given: refused() if "tmpfs" in given else really(*given)),
    "proc": lambda: setattr(kernel, "mount", lambda *given: refused() if "proc" in given else really(*given)),
}
for name in json.loads(sys.argv[2]):
    without[name]()
isolation = sandbox.enter(sandbox.Policy(**json.loads(sys.argv[3])))
print(json.dumps(isolation.to_dict()), flush=True)
os.execv(sys.executable, [sys.executable, *sys.argv[4:]])
"""

MODES = {
    "all": (),
    "no /proc": ("proc",),
    "no root": ("mounts",),
    "no namespaces": ("namespaces",),
    "no Landlock": ("Landlock",),
    "seccomp alone": ("namespaces", "Landlock"),
    "Landlock alone": ("namespaces", "seccomp"),
    "nothing": ("namespaces", "Landlock", "seccomp"),
}
OPEN = {"seccomp alone", "nothing"}  # neither a root of its own nor Landlock: files are open
UNFILTERED = {"Landlock alone", "nothing"}
# In which modes an attack gets through; it must not in any other, and has to in these, or it would prove nothing.
GETS_THROUGH = {
    "read the truth": OPEN,
    "read stored results": OPEN,
    "read elsewhere": OPEN,
    "list elsewhere": OPEN,
    "read command lines of others": OPEN,
    "write a file": OPEN,
    "empty a file": {"nothing"},
    "make a file": OPEN,
    "remove a file": OPEN,
    "link a file": OPEN,
    "change a mode": UNFILTERED,
    "change the mode of a folder": UNFILTERED,
    "change a mode by descriptor": UNFILTERED,
    "change the mode of what came along": UNFILTERED,
    "change an owner": UNFILTERED,
    "change times": UNFILTERED,
    "set an attribute": UNFILTERED,
    "set a flag": UNFILTERED,
    "connect to a path elsewhere": UNFILTERED,
    "connect to a path among the code": UNFILTERED,
    "connect to an abstract name": {"nothing"},
    "send datagrams by a pair": UNFILTERED,
    "connect by TCP": {"nothing"},
    "send by UDP": UNFILTERED,
    "signal another process": OPEN,
    "lower the limits of another process": UNFILTERED,
    "read the limits of another process": UNFILTERED,
    "slow a process": UNFILTERED,
    "slow a group": UNFILTERED,
    "slow all processes of a user": UNFILTERED,
    "take a processor from a process": UNFILTERED,
    "schedule a process": UNFILTERED,
    "rank a process": UNFILTERED,
    "slow the files of a process": UNFILTERED,
    "slow the files of a group": UNFILTERED,
    "hide our own memory": UNFILTERED,
    "take covers off": set(),
    "mount": set(),
    "make a namespace": UNFILTERED,
    "fork into a namespace": UNFILTERED,
    "change the root": set(),
    "make a device": set(),
    "fill the disc": {"no root", "no namespaces", "Landlock alone", *OPEN},
    "keep memory in the kernel": UNFILTERED,
    "take a lease": UNFILTERED,
}
# What nothing at all refuses depends on the machine: some refuse to trace others, or are run by nobody special.
BY_MACHINE = {
    *("trace another process", "read the memory of another process", "change the kernel's settings"),
    *("change the mode of our own program", "keep memory secret", "move the memory of a process"),
}
# What does not work within, by mode, and is no attack: where /dev/shm is the system's, and where modes are refused.
LOST = {
    "shared memory": {"no root", "no namespaces", "Landlock alone"},
    "copies with their modes": {"no root", "no namespaces", "seccomp alone"},
}
NO_NET = "none, no socket can be made (seccomp)"
OWN_PIDS = "a namespace of their own, all end together"
IN_MEMORY = "4 MB in memory at most"
ON_DISC = "files of 1 MB at most, as many as the disc holds"
ALONE = "among others, which cannot be signalled (Landlock), all end together"
LOOSE = "among others, all end together while the one that keeps them lives"
REFUSED, SEEN = "; /proc of others is refused by Landlock", "; /proc of others can be read, command lines too"
SAID = {
    "all": (
        "not in its root, refused by Landlock",
        f"{NO_NET}, a namespace of its own",
        f"{OWN_PIDS}; /proc shows no others",
    ),
    "no /proc": ("not in its root, refused by Landlock", f"{NO_NET}, a namespace of its own", OWN_PIDS + REFUSED),
    "no root": ("refused by Landlock", f"{NO_NET}, a namespace of its own", OWN_PIDS + REFUSED),
    "no namespaces": ("refused by Landlock", NO_NET, ALONE + REFUSED),
    "no Landlock": ("not in its root", f"{NO_NET}, a namespace of its own", f"{OWN_PIDS}; /proc shows no others"),
    "seccomp alone": ("not protected", NO_NET, LOOSE + SEEN),
    "Landlock alone": (
        "refused by Landlock",
        "no TCP (Landlock); all else can be reached, local sockets too",
        ALONE + REFUSED,
    ),
    "nothing": ("not protected", "not cut", LOOSE + SEEN),
}


class Place:
    """Files to attack, listeners to reach, and a process to hurt."""

    def __init__(self, root, stack):
        self.shown, self.elsewhere, self.scratch = (root / name for name in ("shown", "elsewhere", "scratch"))
        for folder in (self.shown / "truth", self.elsewhere, self.scratch):
            folder.mkdir(parents=True)
        for path in (
            *(self.shown / name for name in ("truth/answers", "truths.parquet", "victim", "removed", "harmless")),
            *(self.elsewhere / name for name in ("secret", "input")),
        ):
            path.write_bytes(b"xx")
        sleeper = [
            sys.executable,
            "-I",
            "-S",
            "-c",
            "import time; print(flush=True); time.sleep(1000)",
            "my-secret-seed",
        ]
        self.other = stack.enter_context(subprocess.Popen(sleeper, stdout=subprocess.PIPE))  # noqa: S603 - ours
        stack.callback(self.other.kill)
        self.other.stdout.readline()
        stream, datagram = socket.SOCK_STREAM, socket.SOCK_DGRAM
        self.listeners = {
            "stream": self._listen(stack, socket.AF_UNIX, stream, str(self.elsewhere / "stream")),
            "near": self._listen(stack, socket.AF_UNIX, stream, str(self.shown / "near")),
            "datagrams": self._listen(stack, socket.AF_UNIX, datagram, str(self.elsewhere / "datagrams")),
            "abstract": self._listen(stack, socket.AF_UNIX, stream, "\0" + f"sasgeo-{os.getpid()}"),
            "tcp": self._listen(stack, socket.AF_INET, stream, ("127.0.0.1", 0)),
            "udp": self._listen(stack, socket.AF_INET, datagram, ("127.0.0.1", 0)),
        }

    @staticmethod
    def _listen(stack, family, kind, address):
        link = stack.enter_context(socket.socket(family, kind))
        link.bind(address)
        link.settimeout(0)
        if kind == socket.SOCK_STREAM:
            link.listen(8)
        return link

    def reached(self):
        """Which listeners anybody came to."""
        found = set()
        for name, link in self.listeners.items():
            with contextlib.suppress(BlockingIOError):
                if link.type == socket.SOCK_STREAM:
                    link.accept()[0].close()
                else:
                    link.recv(10)
                found.add(name)
        return found

    def told(self):
        """All that the attacks must know."""
        names = {name: link.getsockname() for name, link in self.listeners.items()}
        folders = {name: str(getattr(self, name)) for name in ("shown", "elsewhere", "scratch")}
        paths = {name: names[name] for name in ("stream", "near", "datagrams")}
        ports = {name: names[name][1] for name in ("tcp", "udp")}
        others = {"other": self.other.pid, "address": ctypes.addressof(ctypes.py_object(None))}
        return {**folders, **paths, **ports, **others, "abstract": f"sasgeo-{os.getpid()}"}

    def state(self):
        """All that a change of files and folders would change."""
        found = {}
        for path in (self.shown, *sorted(self.shown.rglob("*")), self.elsewhere, *sorted(self.elsewhere.rglob("*"))):
            about = path.stat()
            names = [*os.listxattr(path)] if path.is_file() else []
            found[str(path)] = (about.st_mode, about.st_uid, about.st_mtime_ns, about.st_size, about.st_nlink, names)
        return found


@pytest.fixture
def stack():
    with contextlib.ExitStack() as opened:
        yield opened


def shut_in(place, lacking, command, *, readable=None):
    """What a process says that lacks some of the ways to shut it in, and what a program in it prints."""
    code = [str(place.shown), str(HERE), sys.prefix, sys.base_prefix, sys.executable]
    policy = {
        "readable": code if readable is None else [*code, readable],
        "scratch": str(place.scratch),
        "hidden": [str(place.shown / "truth"), str(place.shown / "truths.parquet")],
        "memory_bytes": 2**40,
        "file_bytes": 2**20,
        "scratch_bytes": MOST_BYTES,
    }
    package = str(Path(sandbox.__file__).parents[2])
    arguments = [package, json.dumps(lacking), json.dumps(policy), *map(str, command)]
    with (place.elsewhere / "input").open("rb") as given:
        done = subprocess.run(  # noqa: S603 - ours
            [sys.executable, "-I", "-S", "-c", PROGRAM, *arguments],
            capture_output=True,
            text=True,
            check=False,
            stdin=given,
            env={"PATH": "/usr/bin:/bin", "TMPDIR": str(place.scratch), "HOME": str(place.scratch)},
        )
    assert done.returncode == 0, done.stderr
    lines, *printed = done.stdout.splitlines()
    return json.loads(lines), "\n".join(printed)


def can_be_made(mode):
    """Whether this machine has what a mode does not lack."""
    return (HAS_SPACES or "namespaces" in MODES[mode]) and (HAS_LANDLOCK or "Landlock" in MODES[mode])


@pytest.mark.parametrize(
    "mode",
    [
        pytest.param(mode, marks=pytest.mark.skipif(not can_be_made(mode), reason="not on this machine"))
        for mode in MODES
    ],
)
def test_every_attack_gets_as_far_as_is_said_and_nothing_harmless_is_lost(tmp_path, stack, mode):
    place = Place(tmp_path, stack)
    before = place.state()
    given, printed = shut_in(place, MODES[mode], [HERE / "attacks.py", json.dumps(place.told())])
    found = json.loads(printed)
    done = {name for name, outcome in found.items() if outcome == "done"}
    through = {name for name in GETS_THROUGH if name in done}
    assert through == {name for name, modes in GETS_THROUGH.items() if mode in modes}
    harmless = set(found) - set(GETS_THROUGH) - BY_MACHINE
    assert harmless - done == {name for name, modes in LOST.items() if mode in modes}
    if mode not in OPEN | UNFILTERED:
        assert not done & BY_MACHINE
        assert place.state() == before
        assert not place.reached()
        assert place.other.poll() is None
    elif mode == "nothing":
        assert place.reached() == set(place.listeners)
    truth, network, processes = SAID[mode]
    assert (given["truth"], given["network"], given["processes"]) == (truth, network, processes)
    assert given["scratch"] == (ON_DISC if mode in GETS_THROUGH["fill the disc"] else IN_MEMORY)


def needs(*modes):
    """Modes that can be made here."""
    return pytest.mark.parametrize("mode", [mode for mode in modes if can_be_made(mode)])


READS = """
import json, sys
found = []
for path in sys.argv[1:]:
    try:
        found.append(open(path, "rb").read().decode())
    except OSError:
        found.append(None)
print(json.dumps(found))
"""


@needs("all", "no /proc", "no namespaces")
def test_whoever_works_in_the_root_of_all_folders_does_not_read_what_others_do_either(tmp_path, stack, mode):
    place = Place(tmp_path, stack)
    paths = [place.shown / "truth/answers", f"/proc/{place.other.pid}/cmdline", place.elsewhere / "secret"]
    _, printed = shut_in(place, MODES[mode], ["-c", READS, *paths], readable="/")
    assert json.loads(printed) == [None, None, "xx" if mode == "no namespaces" else None]


@needs("all", "no namespaces")
def test_code_is_found_by_the_links_that_lead_to_it(tmp_path, stack, mode):
    place = Place(tmp_path, stack)
    (place.elsewhere / "deep").mkdir()
    (place.elsewhere / "deep/code").symlink_to("../../shown")
    (tmp_path / "first").symlink_to(place.elsewhere)
    link = tmp_path / "first/deep/code"
    names = ("harmless", "truth/answers", "../secret")
    _, printed = shut_in(place, MODES[mode], ["-c", READS, *(link / name for name in names)], readable=str(link))
    assert json.loads(printed) == ["xx", None, None]


WRITES = """
import sys
for path in sys.argv[1:]:
    try:
        open(path, "ab").write(b"y")
    except OSError:
        continue
    print(path)
"""


@needs("all", "no Landlock")
@pytest.mark.parametrize("readable", ["", "shown"], ids=["scratch within the code", "apart"])
def test_folders_of_any_name_are_read_only_but_for_the_scratch_folder(tmp_path, stack, mode, readable):
    place = Place(tmp_path / "ä b\\040c", stack)
    paths = [place.scratch / "made", place.shown / "harmless", place.shown / "made", place.elsewhere / "secret"]
    _, printed = shut_in(place, MODES[mode], ["-c", WRITES, *paths], readable=str(place.shown.parent / readable))
    assert printed.splitlines() == [str(place.scratch / "made")]
    assert list(place.scratch.iterdir()) == []


@needs("no Landlock")
def test_the_root_holds_what_is_needed_alone(tmp_path, stack, mode):
    place = Place(tmp_path, stack)
    code = {sys.prefix, sys.base_prefix, os.path.realpath(sys.executable), str(HERE), str(tmp_path)}
    listing = "import json, os; print(json.dumps([os.listdir(path) for path in ('/', '/dev')]))"
    _, printed = shut_in(place, MODES[mode], ["-c", listing])
    found, devices = json.loads(printed)
    system = {path.split("/")[1] for path in (*sandbox.SYSTEM, *code, "/dev")}
    assert set(found) <= system
    assert (
        {Path(path).name for path in sandbox.DEVICES}
        < set(devices)
        <= {
            *(Path(path).name for path in sandbox.DEVICES),
            *("shm", "fd", "stdin", "stdout", "stderr"),
        }
    )


def test_what_a_link_leads_to_beside_something_hidden_is_not_read(tmp_path):
    inside, elsewhere = tmp_path / "inside", tmp_path / "elsewhere"
    (inside / "truth").mkdir(parents=True)
    elsewhere.mkdir()
    (inside / "link").symlink_to(elsewhere)
    found = [path for path, _ in kernel.around(str(inside), [str(inside / "truth")])]
    assert found == [str(inside)]


def test_numbers_of_refused_calls_are_those_of_this_system():
    header = Path("/usr/include/x86_64-linux-gnu/asm/unistd_64.h")
    if os.uname().machine != "x86_64" or not header.is_file():
        pytest.skip("no list of this system's calls is installed")
    known = dict(re.findall(r"#define __NR_(\w+) (\d+)", header.read_text(encoding="utf-8")))
    listed = (*kernel.DANGEROUS, *kernel.METADATA, *(calls for calls, _ in kernel._OF_PROCESSES))
    refused = [call.split() for call in ", ".join(listed).split(", ")]
    assert {name: known[name] for name, _, _ in refused if name in known} == {
        name: number for name, number, _ in refused if name in known
    }
    assert len([name for name, _, _ in refused if name in known]) > 50
