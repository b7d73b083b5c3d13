# SPDX-License-Identifier: Apache-2.0
"""How many small faults in the code the tests find: a mutation score, by room, with its 95 % interval.

    python -m pip install cosmic-ray==8.7.0 coverage
    python benchmarks/mutants.py --into out/mutants.csv --jobs 2

A sample of all mutants that Cosmic Ray can make of some rooms is drawn by a seed. Each is put into a copy of the
checkout and tried by the tests of its module, else by those of its room, up to the first that fails: first by those
that run its line, or share a fixture that does; by all if the line is run by an import, or in no test's own process.
One that keeps the processor for more than `LONGEST_S`, or hangs for ten times that, is found, too. Rows are written as
they come, so that a run that was cut off goes on.

    python benchmarks/mutants.py --into out/after.csv --like out/before.csv CHECKOUT

tries the mutants of a table of another checkout instead, each at the line of the same text, and says how many outcomes
differ: two samples of 400 show differences of 7 points, the same mutants twice those of 2.
"""

import argparse
import ast
import csv
import json
import os
import random
import re
import shutil
import signal
import subprocess
import sys
import tempfile
from collections import Counter
from collections.abc import Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from queue import SimpleQueue
from typing import Final, NamedTuple

import pytest

from sasgeo_bench.scoring.intervals import wilson

ROOT: Final = Path(__file__).parents[1]
ROOMS: Final = ("scoring", "tasks", "flights", "sasgeo")
MUTANTS: Final = 400
LONGEST_S: Final = 300
# Faults that somebody might make: what bits have to do with is a type error at once, and unions are annotations.
_LEFT_OUT: Final = re.compile(r"Bit(Or|And|Xor)|Shift|_(Mod|FloorDiv|Pow)$|RemoveDecorator|ExceptionReplacer")
_COPIED: Final = ("sasgeo_bench", "tests", "baselines", "paper", "benchmarks", "pipelines", "regions", "splits", "docs",
                  "pyproject.toml", "README.md", "CONTRIBUTING.md")  # fmt: skip


_PYTEST: Final = ("-x", "-q", "-p", "no:benchmark", "-p", "no:cacheprovider")


class Mutant(NamedTuple):
    """A fault: the operator that makes it, where it lies in a module, and the number of that place."""

    module: str
    operator: str
    occurrence: int
    line: int


def mutants_of(rooms: list[str], root: Path = ROOT) -> Iterator[Mutant]:
    """Yield every mutant of the modules of some rooms of a checkout."""
    from cosmic_ray.ast import ast_nodes, get_ast_from_path  # noqa: PLC0415 - on demand
    from cosmic_ray.plugins import get_operator, operator_names  # noqa: PLC0415

    operators = {name: get_operator(name) for name in sorted(operator_names()) if not _LEFT_OUT.search(name)}
    made = {name: operator() for name, operator in operators.items() if not operator.arguments()}
    for path in sorted(path for room in rooms for path in (root / "sasgeo_bench" / room).rglob("*.py")):
        tree = get_ast_from_path(path)
        for name, operator in made.items():
            places = [start for node in ast_nodes(tree) for start, _ in operator.mutation_positions(node)]
            for occurrence, (line, _) in enumerate(places):
                yield Mutant(path.relative_to(root).as_posix(), name, occurrence, line)


def found_again(mutants: Iterable[Mutant], others: Iterable[Mutant], theirs: Path) -> dict[Mutant, Mutant]:
    """Return by mutant of another checkout that of ours at the only line of the same text, if there is one.

    `mutants` are all of ours, and `others` all of theirs: of several in a line the places are counted.
    """
    ours = {key: mutant for key, mutant in _by_text(mutants, ROOT).items() if mutant is not None}
    return {other: ours[key] for key, other in _by_text(others, theirs).items() if other is not None and key in ours}


def _by_text(mutants: Iterable[Mutant], root: Path) -> dict[tuple[str, str, str, int], Mutant | None]:
    """Return mutants by name of the module, operator, text of the line and number in it; None where two are alike."""
    lines: dict[str, list[str]] = {}
    number: Counter[tuple[str, str, int]] = Counter()
    found: dict[tuple[str, str, str, int], Mutant | None] = {}
    for mutant in mutants:
        text = lines.setdefault(mutant.module, (root / mutant.module).read_text(encoding="utf-8").splitlines())
        at = (mutant.module, mutant.operator, mutant.line)
        key = (Path(mutant.module).name, mutant.operator, text[mutant.line - 1].strip(), number[at])
        number[at] += 1
        found[key] = None if key in found else mutant
    return found


def tests_of(module: str) -> list[str]:
    """Return the tests that a module is tried by: its own, then those of its room that import it; else all of its room.

    Its own examples come first.
    """
    path = Path(module)
    room, dotted = Path("tests", *path.parts[1:-1]), ".".join(path.with_suffix("").parts)
    own, uses = room / f"test_{path.stem}.py", f"from {dotted} import"
    found = [
        each for each in sorted((ROOT / "tests" / path.parts[1]).rglob("test_*.py")) if uses in each.read_text("utf-8")
    ]
    names = [each.relative_to(ROOT).as_posix() for each in found]
    first = [own.as_posix()] if (ROOT / own).is_file() else []
    return [module, *dict.fromkeys([*first, *names])] if first or names else [module, room.as_posix()]


class Contexts:
    """A plugin of pytest that tells coverage.py which test runs, and notes which tests share a fixture."""

    def __init__(self) -> None:
        self._test = ""
        self.users: dict[str, list[str]] = {}

    def pytest_collection_finish(self, session: pytest.Session) -> None:
        """Note who uses a fixture, itself or through others."""
        for item in session.items:
            for name in getattr(item, "fixturenames", ()):
                self.users.setdefault(f"fixture {name}", []).append(item.nodeid.partition("[")[0])

    @pytest.hookimpl(wrapper=True)
    def pytest_runtest_protocol(self, item: pytest.Item) -> Iterator[None]:
        """Name a test without its parameters."""
        self._test = item.nodeid.partition("[")[0]
        _switch(self._test)
        return (yield)

    @pytest.hookimpl(wrapper=True)
    def pytest_fixture_setup(self, fixturedef: pytest.FixtureDef) -> Iterator[None]:
        """Lay what more than one test uses to the fixture."""
        if fixturedef.scope == "function":
            return (yield)
        _switch(f"fixture {fixturedef.argname}")
        try:
            return (yield)
        finally:
            _switch(self._test)


def _switch(context: str) -> None:
    from coverage import Coverage  # noqa: PLC0415

    running = Coverage.current()
    if running is not None:
        running.switch_context(context)


def trace(tests: list[str], into: Path) -> int:
    """Run tests of the folder that we are in, and write into a file of coverage.py which of them run which line."""
    from coverage import Coverage  # noqa: PLC0415

    watched = Coverage(data_file=into, source=[str(Path.cwd() / "sasgeo_bench")], config_file=False)
    watched.start()
    contexts = Contexts()
    code = pytest.main([*_PYTEST, *tests], plugins=[contexts])
    watched.stop()
    watched.save()
    into.with_suffix(".json").write_text(json.dumps(contexts.users), encoding="utf-8")
    return code


class Lines:
    """Which tests run which line, as coverage.py has it."""

    def __init__(self, data: Path, copy: Path) -> None:
        from coverage import CoverageData  # noqa: PLC0415

        self._data, self._copy = CoverageData(basename=str(data)), copy
        self._data.read()
        self._users = json.loads(data.with_suffix(".json").read_text(encoding="utf-8"))

    def tests(self, mutant: Mutant) -> list[list[str]]:
        """Return the lists of tests that a mutant is tried by, in turn."""
        own = tests_of(mutant.module)
        run = self._data.contexts_by_lineno(str(self._copy / mutant.module))
        contexts = {each for line in _statement(self._copy / mutant.module, mutant.line) for each in run.get(line, [])}
        users = {user for each in contexts for user in self._users.get(each, [each])}
        chosen = sorted(
            (each for each in users if each and any(_is_within(each, test) for test in own)),
            key=lambda each: next(number for number, test in enumerate(own) if _is_within(each, test)),
        )
        return [chosen] if chosen and "" not in contexts else [*([chosen] if chosen else []), own]


def _is_within(nodeid: str, test: str) -> bool:
    return nodeid.startswith((f"{test}::", f"{test}/"))


def _statement(path: Path, line: int) -> range:
    """Return the lines of the innermost statement around a line; of one with a body, those before it."""
    best = range(line, line + 1)
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.stmt):
            body = getattr(node, "body", None)
            end = body[0].lineno if body else (node.end_lineno or node.lineno) + 1
            if node.lineno <= line < end:
                best = range(node.lineno, end)
    return best


def tried(mutant: Mutant, copy: Path, tests: list[list[str]]) -> str:
    """Put a mutant into a copy of the checkout, run its tests, and take it out again; return what came of it."""
    from cosmic_ray.mutating import mutate_code  # noqa: PLC0415
    from cosmic_ray.plugins import get_operator  # noqa: PLC0415

    path = copy / mutant.module
    code = path.read_text(encoding="utf-8")
    mutated = mutate_code(code, get_operator(mutant.operator)(), mutant.occurrence)
    if mutated is None or mutated == code:
        return "none"
    path.write_text(mutated, encoding="utf-8")
    try:
        outcomes = (outcome_of(some, copy) for some in tests)
        return next((outcome for outcome in outcomes if outcome != "left"), "left")
    finally:
        path.write_text(code, encoding="utf-8")


def outcome_of(tests: list[str], copy: Path, *, longest_s: int = LONGEST_S) -> str:
    """Run tests in a copy of the checkout: "left" if all pass, "found" if one fails, "late" if they take too long.

    Time of the processor counts, so that a busy machine finds no more mutants.
    """
    limited = ["sh", "-c", f'ulimit -t {longest_s}; exec "$@"', "sh"]
    try:
        ended = subprocess.run(  # noqa: S603 - our own tests
            [*limited, sys.executable, "-m", "pytest", *_PYTEST, *tests],
            cwd=copy,
            env=_environment(copy),
            check=False,
            timeout=10 * longest_s,
            capture_output=True,
        )
    except subprocess.TimeoutExpired:
        return "late"
    known = {0: "left", 1: "found", -signal.SIGXCPU: "late", -signal.SIGKILL: "late"}
    return known.get(ended.returncode, f"found ({ended.returncode})")


def _environment(copy: Path) -> dict[str, str]:
    return os.environ | {"PYTHONPATH": str(copy), "OMP_NUM_THREADS": "1", "PYTHONDONTWRITEBYTECODE": "1"}


def copied(folder: Path) -> Path:
    """Return a copy of what the tests need, whose modules are read in place of the installed ones."""
    for name in _COPIED:
        source = ROOT / name
        (shutil.copytree if source.is_dir() else shutil.copyfile)(source, folder / name)
    return folder


def tried_all(mutants: list[Mutant], jobs: int) -> Iterator[tuple[Mutant, str]]:
    """Yield each mutant with its outcome; ends the program if the tests fail without one."""
    copies: SimpleQueue[Path] = SimpleQueue()
    with tempfile.TemporaryDirectory(prefix="mutants-") as scratch, ThreadPoolExecutor(jobs) as pool:
        for number in range(jobs):
            (Path(scratch) / str(number)).mkdir()
            copies.put(copied(Path(scratch) / str(number)))
        where = Path(scratch) / "0"
        every = list(dict.fromkeys(test for mutant in mutants for test in tests_of(mutant.module)))
        command = [sys.executable, str(Path(__file__).resolve()), "--into", str(where / "lines"), "--trace", *every]
        if subprocess.run(command, cwd=where, env=_environment(where), check=False).returncode:  # noqa: S603 - ours
            sys.exit("these tests fail without a mutant, so they tell nothing of one")
        lines = Lines(where / "lines", where)
        tests = {mutant: lines.tests(mutant) for mutant in mutants}

        def one(mutant: Mutant) -> tuple[Mutant, str]:
            copy = copies.get()
            try:
                return mutant, tried(mutant, copy, tests[mutant])
            finally:
                copies.put(copy)

        yield from pool.map(one, mutants)


def main() -> None:
    """Try the mutants that are not in the table yet, and print the score of each room and of all."""
    parser = argparse.ArgumentParser(description=str(__doc__).partition("\n")[0])
    parser.add_argument("--into", type=Path, required=True, help="table (*.csv) to write, and to go on with")
    parser.add_argument("--rooms", nargs="+", default=ROOMS, help="folders of sasgeo_bench")
    parser.add_argument("--mutants", type=int, default=MUTANTS, help="how many of all are drawn")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--jobs", type=int, default=1)
    parser.add_argument("--like", nargs=2, type=Path, metavar=("TABLE", "CHECKOUT"), help="try the mutants of these")
    parser.add_argument("--trace", nargs="+", metavar="TEST", help="run these under coverage.py into --into instead")
    words = parser.parse_args()
    if words.trace:
        sys.exit(trace(words.trace, words.into))
    every = list(mutants_of(words.rooms))
    drawn = random.Random(words.seed).sample(every, words.mutants)  # noqa: S311 - a sample, no secret
    pairs: dict[Mutant, Mutant] = {}
    if words.like:
        table, theirs = words.like
        before = _read(table)
        again = found_again(every, mutants_of(words.rooms, theirs), theirs)
        pairs = {again[mutant]: mutant for mutant, outcome in before.items() if mutant in again and outcome != "none"}
        drawn = list(pairs)
        print(f"{len(drawn)} of {len(before)} mutants are found again", file=sys.stderr, flush=True)
    known = _read(words.into)
    left = [mutant for mutant in drawn if mutant not in known]
    print(f"{len(every)} mutants, {len(drawn)} drawn, {len(left)} to be tried", file=sys.stderr, flush=True)
    for mutant, outcome in tried_all(left, words.jobs) if left else ():
        known[mutant] = outcome
        with words.into.open("a", newline="", encoding="utf-8") as file:
            csv.writer(file).writerow([*mutant, outcome])
    for room in (*words.rooms, ""):
        outcomes = [known[each] for each in drawn if each.module.startswith(f"sasgeo_bench/{room}")]
        tested = [each for each in outcomes if each != "none"]
        score = wilson(sum(each != "left" for each in tested), len(tested))
        print(f"{room or 'all':>8}: {score.value:.3f} [{score.lo:.3f} {score.hi:.3f}] of {len(tested)}")
    if pairs:
        both = [(before[pairs[mutant]] != "left", known[mutant] != "left") for mutant in drawn]
        gained, lost = both.count((False, True)), both.count((True, False))
        print(f"found there alone: {lost}, here alone: {gained}, of {len(both)}")


def _read(table: Path) -> dict[Mutant, str]:
    if not table.is_file():
        return {}
    with table.open(newline="", encoding="utf-8") as file:
        rows = list(csv.reader(file))
    return {
        Mutant(module, operator, int(occurrence), int(line)): found
        for module, operator, occurrence, line, found in rows
    }


if __name__ == "__main__":
    main()
