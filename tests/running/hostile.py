# SPDX-License-Identifier: Apache-2.0
# ruff: noqa: ARG002, T201 - the door has its arguments, and some of these print
"""Matchers that break what they can; each is run by a test, none is installed."""

import os
import signal
import socket
import sys
import time
from pathlib import Path

from sasgeo_bench.geometry.pose import Pose
from sasgeo_bench.matching.matcher import Match, MatcherCard

SAID = {"version": "1", "title": "Hostile", "source": "original", "ours": "all", "licence": "Apache-2.0"}


class Plain:
    """Answers the middle of the disc, or the first candidates; and is a little slow, so that it can be killed."""

    card = MatcherCard(name="plain", tracks=("localization", "retrieval"), **SAID)

    def prepare(self, region, learned):
        self.region = region

    def match(self, query, *, top_k):
        time.sleep(0.01)
        if query.candidates:
            poses = query.candidates[:top_k]
            return Match(poses=poses, scores=[-float(at) for at in range(len(poses))])
        x, y = query.prior.center_m or (0.0, 0.0)
        seen = float((query.evidence.cells == 1).mean())
        return Match(poses=[Pose(easting_m=x, northing_m=y, yaw_deg=0.0)], scores=[seen], diagnostics={"seen": seen})


class Slow(Plain):
    """As plain, but slow enough to be killed in the middle."""

    def match(self, query, *, top_k):
        time.sleep(0.1)
        return super().match(query, top_k=top_k)


class Held(Plain):
    """As plain, but as long as there is a file `hold` beside it, only queries that it names are answered."""

    def match(self, query, *, top_k):
        hold = Path(__file__).with_name("hold")
        while hold.exists():
            try:
                if query.query_id in hold.read_text(encoding="utf-8"):
                    break
            except FileNotFoundError:
                break
            time.sleep(0.01)
        return super().match(query, top_k=top_k)


class TellsProcess(Plain):
    """Says which process it is in, how many maps that has prepared, and how many maps it can read."""

    def __init__(self):
        self.token, self.maps = float(int.from_bytes(os.urandom(6), "big")), 0

    def prepare(self, region, learned):
        self.maps += 1
        self.readable = 0
        for name in ("town-riverside", "town-copy"):
            try:
                (Path(__file__).parent / "out" / "regions" / name / "region.json").read_bytes()
            except OSError:
                continue
            self.readable += 1

    def match(self, query, *, top_k):
        values = {"process": self.token, "maps": float(self.maps), "readable maps": float(self.readable)}
        return Match(poses=(), scores=(), diagnostics=values)


class Works(Plain):
    """Takes 0.2 s of a processor for each query."""

    def match(self, query, *, top_k):
        begun = time.process_time()
        while time.process_time() - begun < 0.2:
            pass
        return super().match(query, top_k=top_k)


class ExitsOnce(TellsProcess):
    """Leaves its process at the third question, which is the second query: the first was asked twice."""

    def __init__(self):
        super().__init__()
        self.asked = 0

    def match(self, query, *, top_k):
        self.asked += 1
        if self.asked == 3:
            os._exit(3)
        return super().match(query, top_k=top_k)


class HangsLater(TellsProcess):
    """Does not come back from its third question."""

    def __init__(self):
        super().__init__()
        self.asked = 0

    def match(self, query, *, top_k):
        self.asked += 1
        if self.asked == 3:
            time.sleep(1000)
        return super().match(query, top_k=top_k)


class Hangs(Plain):
    def match(self, query, *, top_k):
        while True:
            time.sleep(1)


class HangsInPrepare(Plain):
    def prepare(self, region, learned):
        time.sleep(1000)


class Segfaults(Plain):
    def match(self, query, *, top_k):
        os.kill(os.getpid(), signal.SIGSEGV)
        time.sleep(5)


class DiesByAnySignal(Plain):
    """A signal of real time, which has no name."""

    def match(self, query, *, top_k):
        os.kill(os.getpid(), 40)
        time.sleep(5)


class Exits(Plain):
    def match(self, query, *, top_k):
        print("last words")
        sys.stdout.flush()
        os._exit(3)


class Raises(Plain):
    def match(self, query, *, top_k):
        raise ValueError("no idea\nwhere this is")


class Holds(Plain):
    """Keeps 64 MiB of a map."""

    def prepare(self, region, learned):
        self.held = b"x" * 2**26


class RaisesInPrepare(Plain):
    def prepare(self, region, learned):
        raise ValueError("no index today")


class Leaks(Plain):
    def match(self, query, *, top_k):
        held = []
        while True:
            held.append(b"x" * 2**23 + bytes(len(held)))


class Forks(Plain):
    def match(self, query, *, top_k):
        for _ in range(20):
            if os.fork() == 0:
                time.sleep(1000)
        return super().match(query, top_k=top_k)


class Prints(Plain):
    def match(self, query, *, top_k):
        for _ in range(100):
            print("x" * 100_000)
        return super().match(query, top_k=top_k)


class ScoresNan(Plain):
    def match(self, query, *, top_k):
        return Match(poses=[Pose(easting_m=0.0, northing_m=0.0, yaw_deg=0.0)], scores=[float("nan")])


class SureByWords(Plain):
    def match(self, query, *, top_k):
        return Match(poses=(), scores=(), confidence="0.5")


class SureBeyondNumbers(Plain):
    def match(self, query, *, top_k):
        return Match(poses=(), scores=(), confidence=10**400)


class MeasuresItself(Plain):
    """Has the runner told of a map of endless size: it changes what is measured with in its own process."""

    def __init__(self):
        sizes = iter((0, float("inf")))
        sys.modules["sasgeo_bench.running.serve"]._resident_bytes = lambda: next(sizes)


class LeavesAtOnce(Plain):
    def __init__(self):
        sys.exit(0)


class ClaimsToBeTheOracle(Plain):
    card = MatcherCard(name="oracle_pose", tracks=("localization", "retrieval"), **SAID)


class ReturnsText(Plain):
    def match(self, query, *, top_k):
        return "here"


class ReturnsMany(Plain):
    def match(self, query, *, top_k):
        return Match(poses=[Pose(easting_m=0.0, northing_m=0.0, yaw_deg=0.0)] * 1_000_000, scores=[0.0] * 1_000_000)


class ReadsTruth(Plain):
    def match(self, query, *, top_k):
        for path in sys.path:
            for truth in (Path(path) / "out" / "truth").rglob("*.parquet"):
                truth.read_bytes()
                raise RuntimeError("read the truth")
        return super().match(query, top_k=top_k)


class ListsFolders(Plain):
    """Says which of the folders beside the map it can read or write."""

    def match(self, query, *, top_k):
        found = {}
        for path in sys.path:
            out = Path(path) / "out"
            for name in ("truth", "runs"):
                try:
                    found[f"{name} files"] = float(len([*(out / name).rglob("*.parquet")]))
                except OSError:
                    found[f"{name} files"] = 0.0
        return Match(poses=(), scores=(), diagnostics=found)


class ReadsAllBeside(Plain):
    """Counts the files beside its code in which a test has written that they tell answers; links are followed."""

    told = b" ".join((b"this", b"tells", b"answers"))  # never in one piece: not here, nor where this file is compiled

    def match(self, query, *, top_k):
        count = 0
        for path in sys.path[:2]:
            for folder, _, names in os.walk(path, followlinks=True):
                for name in names:
                    try:
                        count += self.told in (Path(folder) / name).read_bytes()
                    except OSError:
                        continue
        return Match(poses=(), scores=(), diagnostics={"told": float(count)})


class ReadsCommandLines(Plain):
    """Looks for a secret among the command lines of all processes, and reads of itself what libraries read."""

    def match(self, query, *, top_k):
        try:
            numbers = [path.name for path in Path("/proc").iterdir() if path.name.isdigit()]
        except OSError:  # a folder that may not be listed may still be read by name
            numbers = range(1, 2**16)
        secrets = 0
        for number in numbers:
            try:
                secrets += b"my-secret-seed" in Path(f"/proc/{number}/cmdline").read_bytes()
            except OSError:
                continue
        own = min(len(Path(f"/proc/{name}").read_bytes()) for name in ("self/statm", "cpuinfo", "meminfo", "stat"))
        return Match(poses=(), scores=(), diagnostics={"secrets": float(secrets), "own": float(own)})


class WritesResults(Plain):
    def match(self, query, *, top_k):
        for path in sys.path:
            tasks = Path(path) / "out" / "tasks"
            if tasks.is_dir():
                (tasks / "mine").write_text("x")
        return super().match(query, top_k=top_k)


class Connects(Plain):
    def match(self, query, *, top_k):
        with socket.socket() as link:
            link.settimeout(1)
            link.connect(("192.0.2.1", 80))
        return super().match(query, top_k=top_k)


class TellsEnvironment(Plain):
    def match(self, query, *, top_k):
        return Match(poses=(), scores=(), diagnostics=dict.fromkeys(os.environ, 0.0))


class LiesOnTheWire(Plain):
    """Writes to the socket of its own process."""

    def match(self, query, *, top_k):
        for number in range(3, 256):
            try:
                os.write(number, b"\x7f\xff\xff\xff\x00\x00\x00\x00" + b"x" * 100)
            except OSError:
                continue
        return super().match(query, top_k=top_k)


ANSWER = '{"nonce": "NONCE", "status": "ok", "seconds": 0.1, "cpu_s": 0.1}'
WITHHELD_ROW = '{"query_id": "", "candidates": []}'


def write_past_the_server(text, row="", *, times=1):
    """Write a message to the socket of this process, as an answer to the question that was asked last."""
    frame = sys._getframe()
    while not (isinstance(frame.f_locals.get("message"), dict) and "self" in frame.f_locals):
        frame = frame.f_back
    data = text.replace("NONCE", frame.f_locals["message"]["nonce"]).encode()
    head = len(data).to_bytes(4, "big") + len(row).to_bytes(4, "big")
    frame.f_locals["self"].channel.sendall((head + data + row.encode()) * times)


class FarAway(Plain):
    """Answers past all checks of its own process, with a place that is none."""

    def match(self, query, *, top_k):
        far = '{"query_id": "", "candidates": [[{"easting_m": 1e300, "northing_m": 0.0, "yaw_deg": 0.0}, 1.0]]}'
        write_past_the_server(ANSWER, far)
        time.sleep(1000)


class CardOfAList(Plain):
    def __init__(self):
        write_past_the_server('{"nonce": "NONCE", "status": "ok", "learns": false, "card": [[]]}')
        time.sleep(1000)


class AnswersInAdvance(Plain):
    """Says at once what it will answer to the next question, which then seems to take no time."""

    def match(self, query, *, top_k):
        write_past_the_server(ANSWER, WITHHELD_ROW, times=2)
        return super().match(query, top_k=top_k)


class OddName(Plain):
    """As an ordinary plugin may: the name of a diagnostic comes out of a file name, half of a pair of surrogates."""

    def match(self, query, *, top_k):
        return Match(poses=(), scores=(), diagnostics={"\ud800": 1.0})


class PoseFarAway(Plain):
    def match(self, query, *, top_k):
        return Match(poses=[Pose(easting_m=1e300, northing_m=0.0, yaw_deg=0.0)], scores=[1.0])


class DigsDeep(Plain):
    """Leaves 1,100 nested folders in its scratch folder, and takes the rights to some."""

    def match(self, query, *, top_k):
        Path("closed").mkdir(exist_ok=True)
        Path("closed/in").mkdir(exist_ok=True)
        Path("closed").chmod(0)
        for _ in range(1100):
            Path("nested").mkdir(exist_ok=True)
            os.chdir("nested")
        return super().match(query, top_k=top_k)


class NotAnException(BaseException):
    """Is not caught by whoever catches exceptions."""

    def __str__(self):
        raise type(self)


class RaisesWhatNobodyCatches(Plain):
    def match(self, query, *, top_k):
        raise NotAnException


class Liar:
    """Raises wherever it is looked at."""

    def __len__(self):
        return 1

    def __iter__(self):
        raise NotAnException

    __float__ = __str__ = __repr__ = __iter__


class AnswersLiars(Plain):
    def match(self, query, *, top_k):
        return Match(poses=Liar(), scores=Liar(), diagnostics={"a": Liar()})


class SetsItsClock(Plain):
    """Has its process's clocks run the way it likes, and takes 0.3 s for an answer."""

    def match(self, query, *, top_k):
        time.sleep(0.3)
        return super().match(query, top_k=top_k)

    def __init__(self):
        time.perf_counter = lambda: 1.0
        ticks = iter(range(10**9))
        time.process_time = lambda: 1e6 * next(ticks)


class NoMatcher:
    """Has a card and no verbs."""

    card = Plain.card


class NoCard:
    """Has the verbs and no card."""

    prepare = Plain.prepare
    match = Plain.match


class BadCard(Plain):
    """Has a card that says nothing of its licence; the class cannot even be made."""

    def __init__(self):
        self.card = MatcherCard(name="bad", tracks=("retrieval",), **{**SAID, "licence": " "})


class WantsImages(Plain):
    card = MatcherCard(name="wants-images", tracks=("localization", "retrieval"), needs=("image",), **SAID)


class WantsImagery(Plain):
    card = MatcherCard(name="wants-imagery", tracks=("localization", "retrieval"), needs=("imagery",), **SAID)


class ReadsWhatIsKept(Plain):
    """Asks for what is kept of the map; tries to change it, to see that of other maps, and to have nonsense made."""

    def prepare(self, region, learned):
        super().prepare(region, learned)
        folder = region.kept("chart", thin=[], reach_m=0.0)
        try:
            others = [path for path in folder.parent.parent.iterdir() if path != folder.parent]
        except OSError:
            others = []
        written = []
        for path in (folder / "known.npy", folder / "more.npy", folder.parent / "more"):
            try:
                path.write_bytes(b"mine")
                written.append(path.name)
            except OSError:
                pass
        nonsense = {"chart": {"thin": [], "reach_m": 1e9}, "field": {"into": "/tmp"}}  # noqa: S108 - a name
        self.told = {
            "is there": float((folder / "known.npy").is_file()),
            "other maps": float(len(others)),
            "written": float(len(written)),
            "nonsense": float(sum(region.kept(what, **settings) is not None for what, settings in nonsense.items())),
        }

    def match(self, query, *, top_k):
        found = super().match(query, top_k=top_k)
        return Match(poses=found.poses, scores=found.scores, diagnostics=self.told)


class AsksForWhatIsNotKept(Plain):
    """Asks the runner for what it does not have, in the middle of an answer."""

    def prepare(self, region, learned):
        region.kept("truth")
