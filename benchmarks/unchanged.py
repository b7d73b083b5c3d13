# SPDX-License-Identifier: Apache-2.0
"""Fingerprints of what the program makes, so that a change of the house can be shown to change no result.

Record them before the change and compare after it, each time into an empty folder:

    python benchmarks/unchanged.py --out before --record before.json
    python benchmarks/unchanged.py --out after --against before.json

It drives the program as a user would, so that no move of a module concerns it: builds a town and, where its extract is
there, Vaduz; draws every suite on both; carries out the demo; scores the stored boards again. About fifteen minutes;
with --quick, which makes no board, about two.
"""

import argparse
import hashlib
import json
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Final

import pandas as pd

STORED: Final = Path(__file__).parents[1] / "docs" / "results"
REGIONS: Final = ("town-riverside", "vaduz")
# What depends on the machine or the code, in the tables of a board: figures of time and storage, and the code's hash.
_MEASURED: Final = r"latency|seconds|_s$|peak|memory|cpu|map_|bytes|^prepare$|^index$|^hash$"


def make(out: Path, *, is_quick: bool) -> Iterator[tuple[str, str]]:
    """Run the program, and yield name and SHA-256 of everything that it has made."""
    regions = [name for name in REGIONS if _runs("build-region", name, "--out", str(out))]
    for name in regions:
        yield from _files(out, out / "regions" / name)
        words = ("make-queries", "--regions", name, "--n", "2", "--up-to", "--skip", "--out", str(out))
        if not _runs(*words):
            sys.exit(f"no queries could be drawn on {name}")
    for folder in ("tasks", "truth"):
        yield from _files(out, out / folder)
    if is_quick:
        return
    _runs("leaderboard", "demo", "--jobs", "2", "--out", str(out))
    yield from _tables(out / "boards" / "demo", "demo", is_measured_here=True)
    for board in sorted(STORED.iterdir()):
        if (board / "pack.json").is_file():
            _runs("score", "--predictions", str(board), "--name", board.name, "--jobs", "2", "--out", str(out))
            yield from _tables(out / "boards" / board.name, board.name, is_measured_here=False)


def _runs(*words: str) -> bool:
    print("sasgeo-bench", *words, file=sys.stderr)
    command = [str(Path(sys.executable).with_name("sasgeo-bench")), *words]
    return subprocess.run(command, check=False, stdout=subprocess.DEVNULL).returncode == 0  # noqa: S603 - our own program


def _files(root: Path, folder: Path) -> Iterator[tuple[str, str]]:
    for path in sorted(folder.rglob("*")):
        if path.is_file() and not path.name.endswith(".lock"):
            yield str(path.relative_to(root)), hashlib.sha256(path.read_bytes()).hexdigest()


def _tables(board: Path, name: str, *, is_measured_here: bool) -> Iterator[tuple[str, str]]:
    for path in sorted(board.glob("*.parquet")):
        table = pd.read_parquet(path)
        if is_measured_here:
            table = table.loc[:, ~table.columns.str.contains(_MEASURED)]
            if "metric" in table:
                table = table[~table["metric"].str.contains(_MEASURED)]
        text = table.to_csv(index=False, float_format="%.12g")
        yield f"{name}: {path.name}", hashlib.sha256(text.encode()).hexdigest()


def main() -> None:
    """Record the fingerprints, or say which have changed."""
    parser = argparse.ArgumentParser(description=str(__doc__).partition("\n")[0])
    parser.add_argument("--out", type=Path, required=True, help="an empty folder")
    parser.add_argument("--record", type=Path, help="JSON file to write")
    parser.add_argument("--against", type=Path, help="JSON file that was recorded before")
    parser.add_argument("--quick", action="store_true", help="regions and queries alone")
    words = parser.parse_args()
    if words.out.exists() and any(words.out.iterdir()):
        sys.exit(f"{words.out} is not empty: name another folder")
    found = dict(make(words.out, is_quick=words.quick))
    if words.record:
        words.record.write_text(json.dumps(found, indent=1) + "\n", encoding="utf-8")
    before = json.loads(words.against.read_text(encoding="utf-8")) if words.against else found
    changed = sorted(name for name in before.keys() | found.keys() if before.get(name) != found.get(name))
    for name in changed:
        print(f"{name}: {'changed' if name in before and name in found else 'in one of the two alone'}")
    print(f"{len(found)} fingerprints, {len(changed)} changed")
    sys.exit(bool(changed))


if __name__ == "__main__":
    main()
