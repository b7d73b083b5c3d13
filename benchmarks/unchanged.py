# SPDX-License-Identifier: Apache-2.0
"""Fingerprints of what the program makes, so that a change of the house can be shown to change no result.

Record them before the change and compare after it, each time into an empty folder:

    python benchmarks/unchanged.py --out before --record before.json
    python benchmarks/unchanged.py --out after --against before.json

It drives the program as a user would, so that no move of a module concerns it. It builds two towns and, where its
extract is there, Vaduz; draws every suite on them, pictures and flights included, and some queries by a private seed;
releases a town; carries out the demo and stores it; submits to it and enters it; scores every stored board again and
publishes one. With --quick it builds and draws alone.

A fingerprint is a SHA-256, and its name begins with its kind: `file` of bytes; `table` of a column of a table, for each
matcher by itself where there are several; `words` of a text in which hashes, and where times are in it all numbers, are
left out. So what goes is named column by column and matcher by matcher, and `--kinds table file` passes over words.

Where a change may move the last bits of a number, name the folder of before as well: a column of numbers that are as
near as `--tolerance` is then the same.

    python benchmarks/unchanged.py --out after --against before.json --near before --tolerance 0.001
"""

import argparse
import hashlib
import json
import re
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final

import numpy as np
import pandas as pd

KINDS: Final = ("file", "table", "words")
REGIONS: Final = ("town-riverside", "town-suburb", "vaduz")
STORED: Final = Path(__file__).parents[1] / "docs" / "results"
PUBLISHED: Final = "systems-objects"
MINE: Final = "my-matcher"
PRIVATE: Final = "314159265358979323846264338327950288419716939937510"
# What depends on the machine or the code, in the tables of a board: figures of time and storage, and the code's hash.
_MEASURED: Final = r"latency|seconds|_s$|peak|memory|cpu|map_|bytes|^prepare$|^index$|^hash$|sha256|version|created"
_HASH: Final = re.compile(r"\b[0-9a-f]{6,64}\b")
_NUMBER: Final = re.compile(r"\d[\d.,]*")
_TEXTS: Final = (".csv", ".html", ".json", ".md", ".py", ".svg", ".tex", ".toml")
_PASSED_OVER: Final = (".lock",)
_ROOTLESS: Final = ("new-matcher", "submit")  # commands without --out

Prints = Iterator[tuple[str, str]]


@dataclass(frozen=True, kw_only=True)
class Program:
    """The installed program, and the root of what it builds.

    It keeps what each command says, with its status.
    """

    out: Path
    said: dict[str, str] = field(default_factory=dict)

    def run(self, *words: str, at: Path | None = None) -> bool:
        """Run a command, in a working folder; return whether it ends with status 0."""
        print("sasgeo-bench", *words, file=sys.stderr, flush=True)
        root = () if words[0] in _ROOTLESS else ("--out", str(self.out))
        command = [str(Path(sys.executable).with_name("sasgeo-bench")), *words, *root]
        ended = subprocess.run(command, check=False, cwd=at, capture_output=True, text=True)  # noqa: S603 - our own program
        said, name = (text.replace(str(self.out), "OUT") for text in (ended.stdout, " ".join(words)))
        self.said[name] = f"{ended.returncode}\n{_masked(said, is_measured=True)}"
        if ended.returncode:
            print(ended.stderr[-2000:], file=sys.stderr, flush=True)
        return ended.returncode == 0


def make(out: Path, *, is_quick: bool) -> Prints:
    """Run the program, and yield name and SHA-256 of everything that it has made."""
    program = Program(out=out)
    yield from _places(program)
    if not is_quick:
        yield from _demo(program)
        yield from _stored(program)
    for command, text in program.said.items():
        yield f"words: {command}", _sha256(text.encode())


def _places(program: Program) -> Prints:
    """Regions, every suite on them, queries of a private seed, and a release."""
    out = program.out
    regions = [name for name in REGIONS if program.run("build-region", name)]
    for name in regions:
        yield from _files(out, out / "regions" / name)
        program.run("make-queries", "--regions", name, "--n", "2", "--up-to", "--skip", "--jobs", "2")
    seed = out / "own.seed"
    seed.touch(mode=0o600)
    seed.write_text(PRIVATE, encoding="utf-8")
    words = ("--suite", "clean", "--suite", "instance-twins", "--regions", REGIONS[0], "--n", "2", "--up-to")
    program.run("make-queries", *words, "--seed-file", str(seed))
    for folder in ("tasks", "truth", "private/tasks", "private/truth"):
        yield from _files(out, out / folder)
    program.run("release", "--regions", REGIONS[0], "--into", str(out / "release"), "--date", "2026-01-01")
    yield from _files(out, out / "release")


def _demo(program: Program) -> Prints:
    """The demo with its board, site and stored results; a submission to it, and an entry."""
    out = program.out
    results = out / "results" / "demo"
    program.run("leaderboard", "demo", "--jobs", "2", "--results", str(results.parent))
    yield from _board(out, out / "boards" / "demo", is_measured=True)
    yield from _board(out, results, is_measured=True)
    program.run("new-matcher", MINE, "--into", str(out / "plugin"))
    yield from _board(out, out / "plugin", is_measured=True)
    source, entered, submitted = out / "plugin" / "src", out / "entered" / MINE, out / "submitted" / MINE
    program.run("enter", str(results), "--matcher", "my_matcher.matcher:MyMatcher", "--into", str(entered), at=source)
    words = ("--predictions", str(out / "runs" / MINE), "--card", str(source / "my_matcher" / "card.toml"))
    program.run("submit", *words, "--for", str(results), "--into", str(submitted))
    program.run("verify", str(submitted), "--for", str(results))
    program.run("score", "--predictions", str(results), "--submissions", str(submitted), "--name", "submitted")
    for folder in (entered, submitted, out / "boards" / "submitted"):
        yield from _board(out, folder, is_measured=True)


def _stored(program: Program) -> Prints:
    """Stored boards, scored again; the site of one."""
    out = program.out
    for board in sorted(STORED.iterdir()):
        if (board / "pack.json").is_file():
            program.run("score", "--predictions", str(board), "--name", board.name, "--jobs", "2")
            yield from _board(out, out / "boards" / board.name, is_measured=False)
    program.run("publish", "--board", str(out / "boards" / PUBLISHED), "--into", str(out / "site"))
    yield from _board(out, out / "site", is_measured=False)


def _files(root: Path, folder: Path) -> Prints:
    for path in _all_files(folder):
        yield f"file: {path.relative_to(root)}", _sha256(path.read_bytes())


def _board(root: Path, folder: Path, *, is_measured: bool) -> Prints:
    """Fingerprints of a board, a submission or a site; figures of time are passed over if they were measured now."""
    for path in _all_files(folder):
        name = str(path.relative_to(root))
        if path.suffix == ".parquet":
            yield from _columns(name, pd.read_parquet(path), is_measured=is_measured)
        elif path.suffix in _TEXTS:
            yield f"words: {name}", _sha256(_masked(path.read_text(encoding="utf-8"), is_measured=is_measured).encode())
        elif not is_measured or "maps" not in path.parts:
            yield f"file: {name}", _sha256(path.read_bytes())


def _columns(name: str, table: pd.DataFrame, *, is_measured: bool) -> Prints:
    if is_measured:
        table = table.loc[:, ~table.columns.str.contains(_MEASURED)]
        if "metric" in table:
            table = table[~table["metric"].astype(str).str.contains(_MEASURED)]
    parts = table.groupby("matcher", sort=True, observed=True) if "matcher" in table else [("", table)]
    for matcher, part in parts:
        for column in part:
            text = part[column].to_csv(index=False, float_format="%.12g")
            yield f"table: {name}: {matcher}: {column}".replace(": :", ":"), _sha256(text.encode())


def _is_near(name: str, before: Path, after: Path, *, tolerance: float) -> bool:
    """Return whether a column, by the name of its fingerprint, holds nearly the same numbers in two folders."""
    if not name.startswith("table: "):
        return False
    path, *of_matcher, column = name.split(": ")[1:]
    if not all((root / path).is_file() for root in (before, after)):
        return False
    tables = [pd.read_parquet(root / path) for root in (before, after)]
    if of_matcher:
        tables = [table[table["matcher"] == of_matcher[0]] for table in tables]
    one, two = (table[column].to_numpy() for table in tables)
    if len(one) != len(two) or not all(np.issubdtype(values.dtype, np.floating) for values in (one, two)):
        return False
    return bool(np.allclose(one, two, rtol=tolerance, atol=tolerance, equal_nan=True))


def _masked(text: str, *, is_measured: bool) -> str:
    text = _HASH.sub("#", text)
    return _NUMBER.sub("0", text) if is_measured else text


def _all_files(folder: Path) -> list[Path]:
    return [path for path in sorted(folder.rglob("*")) if path.is_file() and path.suffix not in _PASSED_OVER]


def _sha256(data: bytes) -> str:
    return hashlib.sha256(data).hexdigest()


def main() -> None:
    """Record the fingerprints, or say which have changed."""
    parser = argparse.ArgumentParser(description=str(__doc__).partition("\n")[0])
    parser.add_argument("--out", type=Path, required=True, help="an empty folder")
    parser.add_argument("--record", type=Path, help="JSON file to write")
    parser.add_argument("--against", type=Path, help="JSON file that was recorded before")
    parser.add_argument("--near", type=Path, help="the --out of before: numbers as near as --tolerance are the same")
    parser.add_argument("--tolerance", type=float, default=1e-3, help="of --near, in units of the column and relative")
    parser.add_argument("--kinds", nargs="+", choices=KINDS, default=KINDS, help="of fingerprints to compare")
    parser.add_argument("--quick", action="store_true", help="regions and queries alone")
    words = parser.parse_args()
    if words.out.exists() and any(words.out.iterdir()):
        sys.exit(f"{words.out} is not empty: name another folder")
    words.out.mkdir(parents=True, exist_ok=True)
    found = dict(make(words.out.resolve(), is_quick=words.quick))
    if words.record:
        words.record.write_text(json.dumps(found, indent=1) + "\n", encoding="utf-8")
    before = json.loads(words.against.read_text(encoding="utf-8")) if words.against else found
    names = {name for name in before.keys() | found.keys() if name.partition(":")[0] in words.kinds}
    changed = sorted(name for name in names if before.get(name) != found.get(name))
    if words.near:
        near = {name for name in changed if _is_near(name, words.near, words.out, tolerance=words.tolerance)}
        changed = [name for name in changed if name not in near]
        print(f"{len(near)} columns differ by less than {words.tolerance:g}")
    for name in changed:
        print(f"{name}: {'changed' if name in before and name in found else 'gone' if name in before else 'new'}")
    print(f"{len(names)} fingerprints, {len(changed)} changed")
    sys.exit(bool(changed))


if __name__ == "__main__":
    main()
