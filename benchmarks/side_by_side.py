# SPDX-License-Identifier: Apache-2.0
"""Two commits side by side: whole processes as a user types them, base and head in turn, medians and their ratio.

    python benchmarks/side_by_side.py d52d0bcd HEAD --into out/side-by-side
    python benchmarks/side_by_side.py d52d0bcd HEAD --into out/side-by-side --rows build sasgeo --runs 3

Checks both commits out below `--into`, makes an environment for each by its own `make install`, and runs each row in
each of them in turn, base first: A B A B. What a row needs (regions, tasks) each commit makes for itself, once. Seconds
are by the clock, `CPU s` are of a command and of all that it waited for, memory is that of its largest process; rows of
`profile` give what it measured of the matcher, those of Andorra and of made-up answers what the program prints. A ratio
is head over base. Other load is in the seconds of both alike, and least in `CPU s`: quote ratios of one run. A row that
one of the commits cannot carry out says so; rows that were measured are kept, and the same command goes on with the
others. Needs the extracts of Liechtenstein, Andorra and the Faroes in a folder that SASGEO_EXTRACTS names.
"""

import argparse
import json
import os
import re
import shutil
import statistics
import subprocess
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Final

HERE: Final = Path(__file__).resolve().parents[1]
FRESH: Final = "{fresh}"  # a folder that is emptied before each run
KEPT: Final = "{kept}"  # a folder of the commit, in which its regions and tasks stay
BASE: Final = "{base}"  # the checkout of the base: both commits score its stored boards
PLACES: Final = {  # name -> region whose extracts it has, and what its file says otherwise
    "square": ("vaduz", {"id": '"square"', "size_m": "[12288, 12288]"}),
    "faroes": (
        "torshavn",
        # Cells of 2 m: a region file may not ask for as many as of 1 m; a scene that older commits know, too
        {
            "id": '"faroes"',
            "center_lonlat": "[-6.97, 61.895]",
            "size_m": "[81920, 120832]",
            "cell_size_m": "2.0",
            "scenes": '["coastal"]',
        },
    ),
}
# A matcher of one's own, for no other can be entered; it lies in `KEPT`, which is on the path of imports
ENTRANT: Final = """from dataclasses import replace

from sasgeo_baselines.polar_vsc import PolarVsc


class Entrant(PolarVsc):
    card = replace(PolarVsc.card, name="entrant")
"""
VADUZ: Final = ("build-region", "vaduz", "--out", KEPT)


def drawn(suite: str, *, sites: int) -> tuple[str, ...]:
    """Return the words that draw a suite on Vaduz."""
    return ("make-queries", "--suite", suite, "--regions", "vaduz", "--n", str(sites), "--out", KEPT)


@dataclass(frozen=True, kw_only=True)
class Row:
    """A command of the program, or a program of ours (`*.py`), and what must be there before.

    `gives` takes figures from the folder `FRESH` and from what the program prints, in place of those of the process.
    `anew` is removed before each run.
    """

    name: str
    words: tuple[str, ...]
    first: tuple[tuple[str, ...], ...] = ()
    goal: float | None = None
    gives: Callable[[Path, str], dict[str, float]] | None = None
    anew: str = ""


def profiled(name: str, matcher: str, *, goal: float, suite: str = "clean") -> Row:
    """Return the row of one matcher over Vaduz, discs of 500 m at most."""
    asked = ("--radius", "600") if suite == "clean" else ()
    words = (
        "profile",
        "--matcher",
        matcher,
        "--tasks",
        f"{KEPT}/tasks/{suite}/vaduz",
        "--out",
        KEPT,
        "--seconds",
        "20",
    )
    first = (VADUZ, drawn(suite, sites=3))
    return Row(name=name, words=(*words, "--into", FRESH, *asked), first=first, goal=goal, gives=of_profile)


def of_profile(fresh: Path, _: str) -> dict[str, float]:
    """Return the figures of a profile."""
    found = json.loads(next(fresh.rglob("profile.json")).read_text())
    fixes = [fix for fix in found["fixes"] if fix["status"] == "ok"]
    times = sorted(fix["seconds"] for fix in fixes)
    return {
        "p50 s": statistics.median(times),
        "p95 s": times[int(0.95 * (len(times) - 1))],
        "CPU s": statistics.median(fix["cpu_s"] for fix in fixes),
        "start s": float(found["start_s"]),
        "prepare s": float(found["prepare_s"]),
        "MB": float(found["peak_bytes"]) / 1e6,
    }


def of_country(_: Path, said: str) -> dict[str, float]:
    r"""Return the figures that `search_countries.py` prints of a fix on two cores and of storing the levels.

    >>> fix = "| andorra | 558 | stored | 2 | 0.91 | 140 | 5.40 | 9.80 | 900 | 7 of 7 |  |  |"
    >>> stored = "| andorra | 80.1 | 76.0 | 1.0 | 2.0 | 3.0 | 4.0 | 5.0 | 6.0 |"
    >>> of_country(Path(), f"{fix}\n{stored}")["stored in s"]
    80.1
    """
    rows = [[cell.strip() for cell in line.strip("|\n ").split("|")] for line in said.splitlines() if line[:1] == "|"]
    fix = next(row for row in rows if row[2:4] == ["stored", "2"])
    stored = next(row for row in reversed(rows) if len(row) == 9)
    names = {"fix s": fix[6], "fix CPU s": fix[7], "ready s": fix[4], "MB": fix[8]}
    return {name: float(text) for name, text in (names | {"stored in s": stored[1], "CPU s": stored[2]}).items()}


def of_scores(_: Path, said: str) -> dict[str, float]:
    r"""Return the figures that `score.py` prints of the whole command, then of intervals and ranks alone.

    >>> of_scores(Path(), "a run\n| 10 | 100 | 1.0 | 2.0 | 300 | 4.0 | 5.0 | 600 |")["MB"]
    600.0
    """
    row = next(line for line in reversed(said.splitlines()) if line[:1] == "|")
    cells = [float(cell) for cell in row.strip("|\n ").split("|")]
    names = ("ranks s", "ranks CPU s", "ranks MB", "s", "CPU s", "MB")
    found = dict(zip(names, cells[2:], strict=True))
    return {name: found[name] for name in (*names[3:], *names[:3])}


def scored(matchers: int, queries: int) -> Row:
    """Return the row that scores made-up answers with rejectors and all figures; they are made up once."""
    words = ("benchmarks/score.py", "--sizes", f"{matchers}x{queries}", "--runs", "1", "--keep", f"{KEPT}/made-up")
    return Row(name=f"score {matchers * queries:,} rows", words=words, goal=0.3, gives=of_scores)


ROWS: Final = (
    Row(name="help", words=("--help",), goal=1.0),
    Row(name="build 16 km2", words=("build-region", "vaduz", "--out", FRESH), goal=0.4),
    Row(name="build 144 km2", words=("build-region", f"{KEPT}/square.toml", "--out", FRESH), goal=0.5),
    Row(name="build Faroes", words=("build-region", f"{KEPT}/faroes.toml", "--out", FRESH), goal=0.5),
    profiled("sasgeo_prior", "sasgeo_prior", goal=0.45),
    profiled("raster_soft", "raster_soft", goal=0.4),
    profiled("hu_map_only", "hu_map_only", goal=0.4),
    profiled("ubev_template", "ubev_template", goal=0.4),
    profiled("sasgeo_track", "sasgeo_track", goal=0.5, suite="flight-clean"),
    *(
        Row(
            name=f"draw {suite}",
            words=("make-queries", "--suite", suite, "--regions", "vaduz", "--n", str(sites), "--out", KEPT),
            first=(VADUZ,),
            goal=0.5,
        )
        for suite, sites in (("clean", 36), ("aerial", 40), ("flight-clean", 4))
    ),
    Row(name="render", words=("benchmarks/rendering.py", "--out", KEPT), goal=0.4),
    Row(
        name="Andorra",
        words=("-m", "benchmarks.search_countries", "--out", KEPT, "--regions", "andorra", "--ways", "stored"),
        first=(("build-region", "andorra", "--out", KEPT),),
        goal=0.46,
        gives=of_country,
        anew=f"{KEPT}/levels",
    ),
    Row(
        name="score modules",
        words=("score", "--predictions", f"{BASE}/docs/results/modules", "--out", FRESH),
        goal=0.35,
    ),
    scored(10, 10_000),
    scored(20, 50_000),
    Row(
        name="enter demo",
        words=(
            "enter",
            f"{KEPT}/results/demo",
            "--matcher",
            "entrant:Entrant",
            "--out",
            FRESH,
            "--into",
            f"{FRESH}/entrant",
        ),
        first=(("leaderboard", "demo", "--out", KEPT, "--results", f"{KEPT}/results"),),
        goal=0.3,
    ),
    Row(name="make demo", words=("make", "demo", f"OUT={FRESH}"), goal=0.6),
    Row(name="make test", words=("make", "test"), goal=0.65),
)


@dataclass(frozen=True)
class Checkout:
    """A commit, checked out and installed."""

    name: str
    root: Path
    base: Path

    @classmethod
    def of(cls, name: str, commit: str, into: Path, *, base: Path) -> "Checkout":
        """Check a commit out and install it, unless that is done."""
        made = cls(name, into / name, base)
        if not made.root.exists():
            git("worktree", "add", "--force", "--detach", str(made.root), commit)
        if not (made.root / ".venv" / "installed").exists():
            with (into / f"{name}.log").open("ab") as said:
                subprocess.run(["make", "install"], cwd=made.root, check=True, stdout=said, stderr=said)  # noqa: S607
            (made.root / ".venv" / "installed").touch()
        made.kept.mkdir(exist_ok=True)
        (made.kept / "entrant.py").write_text(ENTRANT)
        for place, (region, changes) in PLACES.items():
            text = (HERE / "regions" / f"{region}.toml").read_text()
            for key, value in changes.items():
                text = re.sub(f"^{key} = .*$", f"{key} = {value}", text, flags=re.MULTILINE)
            (made.kept / f"{place}.toml").write_text(text)
        return made

    @property
    def kept(self) -> Path:
        """Return the folder of its regions and tasks."""
        return self.root.parent / f"{self.name}-kept"

    def measured(self, row: Row) -> dict[str, float]:
        """Carry out a row once; return its figures by name."""
        fresh = self.root.parent / f"{self.name}-fresh"
        shutil.rmtree(fresh, ignore_errors=True)
        if row.anew:
            shutil.rmtree(self._word(row.anew, fresh), ignore_errors=True)
        begun = time.perf_counter()
        said = self.root.parent / f"{self.name}.out"
        with said.open("wb") as into:
            process = self._begin(row.words, fresh, into)
            _, status, usage = os.wait4(process.pid, 0)
        seconds = time.perf_counter() - begun
        if status:
            raise subprocess.CalledProcessError(os.waitstatus_to_exitcode(status), row.words)
        if row.gives:
            return row.gives(fresh, said.read_text(encoding="utf-8"))
        return {"s": seconds, "CPU s": usage.ru_utime + usage.ru_stime, "MB": usage.ru_maxrss * 1024 / 1e6}

    def prepare(self, row: Row) -> None:
        """Make what a row needs."""
        for words in row.first:
            with (self.root.parent / f"{self.name}.out").open("wb") as into:
                process = self._begin(words, self.root.parent / f"{self.name}-fresh", into)
            if process.wait():
                raise subprocess.CalledProcessError(process.returncode, words)

    def _word(self, word: str, fresh: Path) -> str:
        return word.replace(FRESH, str(fresh)).replace(KEPT, str(self.kept)).replace(BASE, str(self.base))

    def _begin(self, words: Sequence[str], fresh: Path, into: IO[bytes]) -> "subprocess.Popen[bytes]":
        given = [self._word(word, fresh) for word in words]
        binaries = self.root / ".venv" / "bin"
        if given[0].endswith(".py") or given[0] == "-m":
            given = [str(binaries / "python"), *given]
        elif given[0] != "make":
            given = [str(binaries / "sasgeo-bench"), *given]
        path = {"PATH": f"{binaries}:{os.environ['PATH']}", "PYTHONPATH": f"{self.root}:{self.kept}"}
        path["PYTHONDONTWRITEBYTECODE"] = ""  # as with a user, modules are compiled once
        with (self.root.parent / f"{self.name}.log").open("ab") as log:
            return subprocess.Popen(given, cwd=self.root, env=os.environ | path, stdout=into, stderr=log)  # noqa: S603 - our own programs


def git(*words: str) -> str:
    """Ask git."""
    return subprocess.run(["git", *words], cwd=HERE, check=True, capture_output=True, text=True).stdout.strip()  # noqa: S603, S607


def medians(runs: Sequence[Mapping[str, float]]) -> dict[str, float]:
    """Return the median of each figure.

    >>> medians([{"s": 1.0}, {"s": 3.0}, {"s": 2.0}])
    {'s': 2.0}
    """
    return {name: statistics.median(run[name] for run in runs) for name in runs[0]}


def table(found: Mapping[str, Mapping[str, Sequence[Mapping[str, float]]]]) -> str:
    """Return the rows that were measured as a table in Markdown.

    >>> print(table({"help": {"base": [{"s": 0.2}], "head": [{"s": 0.1}]}}))
    | row | figure | base | head | ratio | goal |
    |---|---|---:|---:|---:|---:|
    | help | s | 0.20 | 0.10 | 0.50 | 1.00 |
    """
    goals = {row.name: row.goal for row in ROWS}
    lines = ["| row | figure | base | head | ratio | goal |", "|---|---|---:|---:|---:|---:|"]
    for name, runs in found.items():
        if not all(runs.get(side) for side in ("base", "head")):
            lines.append(f"| {name} | not carried out by {' and '.join(s for s in runs if not runs[s])} | | | | |")
            continue
        base, head = (medians(runs[side]) for side in ("base", "head"))
        for at, figure in enumerate(base):
            goal = goals.get(name)
            told = f"{goal:.2f}" if goal and at == 0 else ""
            ratio = head[figure] / base[figure] if base[figure] else float("nan")
            shown = f"{base[figure]:.2f} | {head[figure]:.2f} | {ratio:.2f}"
            lines.append(f"| {name if at == 0 else ''} | {figure} | {shown} | {told} |")
    return "\n".join(lines)


def main() -> None:
    """Measure the rows that are asked for and not yet measured; print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("base", help="commit to measure against")
    parser.add_argument("head", help="commit to measure")
    parser.add_argument("--into", type=Path, default=Path("out/side-by-side"), help="folder for checkouts and figures")
    parser.add_argument("--rows", nargs="*", default=[""], help="beginnings of names of rows; default: all")
    parser.add_argument("--runs", type=int, default=5, help="runs of each row in each commit")
    asked = parser.parse_args()
    into = asked.into.resolve()
    into.mkdir(parents=True, exist_ok=True)
    commits = {"base": git("rev-parse", asked.base), "head": git("rev-parse", asked.head)}
    base = into / f"base-{commits['base'][:8]}"
    sides = {name: Checkout.of(f"{name}-{commit[:8]}", commit, into, base=base) for name, commit in commits.items()}
    kept = into / f"{commits['base'][:8]}-{commits['head'][:8]}.json"
    found = json.loads(kept.read_text()) if kept.exists() else {}
    for row in ROWS:
        if row.name in found or not any(row.name.startswith(word) for word in asked.rows):
            continue
        runs: dict[str, list[dict[str, float]]] = {name: [] for name in sides}
        for run in range(asked.runs):
            for name, side in sides.items():
                try:
                    if run == 0:
                        side.prepare(row)
                    elif not runs[name]:
                        continue
                    runs[name].append(side.measured(row))
                except (subprocess.CalledProcessError, StopIteration) as error:
                    print(f"{row.name} in {name}: {error}; see {into}/{side.name}.log", file=sys.stderr)
                    runs[name] = []
        found[row.name] = runs
        kept.write_text(json.dumps(found, indent=1))
        print(f"{row.name}: done", file=sys.stderr)
    print(table(found))


if __name__ == "__main__":
    main()
