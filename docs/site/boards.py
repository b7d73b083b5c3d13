# SPDX-License-Identifier: Apache-2.0
"""The page of all published boards, and a site of each, from what docs/results stores."""

import json
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Final

from sasgeo_bench.boards.board import Board, read_board
from sasgeo_bench.boards.board_tables import Book
from sasgeo_bench.boards.overview import Overview, overviews_of
from sasgeo_bench.boards.pipeline_spec import find_pipeline_file, read_pipeline_file
from sasgeo_bench.boards.publish import publish
from sasgeo_bench.core.parquet import read_frame
from sasgeo_bench.core.progress import duration_text
from sasgeo_bench.regions.region import DATA_VERSION
from sasgeo_bench.regions.region_spec import list_region_files, read_region_file
from sasgeo_bench.scoring.rows import is_unranked
from sasgeo_bench.tasks.query import CONTROLS, TASK_VERSION, base_of

RESULTS: Final = Path(__file__).parents[1] / "results"  # stored boards
PAGE: Final = "boards.md"
_MOST_SENTENCES: Final = 4  # of a board
_INTRODUCTION: Final = """# Published boards

Each board is a site of its own: who is good at what, which differences are real, every table, and what the answers
cost. The sentences are those of its first page. Figures, pictures of single queries and files to download take the
stored answers: `sasgeo-bench publish --board docs/results/<board>` makes a site with them. What the boards mean for the
paper stands in the [results](results/README.md); where a new method can show something, in [what is still
unsolved](unsolved.md).
"""
_ENTERING: Final = """
## Entering

What entering each takes, fewest queries first, from what is stored with it. **Begin with `systems-objects`**: the
fewest views of real places that need no segmenter. Where nothing can be downloaded begin with [the board of the
demo](howto/submission.md#practise).

```bash
sasgeo-bench enter docs/results/systems-objects --matcher my-matcher --dry-run  # minutes on this machine
```

*Asking* is from the quickest ranked row of the board to the slowest, at its mean time for a query; drawing the queries
and scoring come on top. *Extracts* are those of real places, *disk* is maps and queries. *Sealed* places need the
published seed. *Closed* boards were made on maps that this version makes otherwise: their figures stand, and only the
version that made them can enter them. Queries of another task version than today's, {version}, that are drawn otherwise
by now count as misses. [Submit answers](howto/submission.md) says more.
"""


def page(table: Callable[[Iterable[str], Iterable[Iterable[object]]], Iterable[str]]) -> str:
    """Return the page of all published boards, newest maps first; `table` writes a table (`reference.table`)."""
    boards = [read_board(pack.parent) for pack in sorted(RESULTS.glob("*/pack.json"))]
    newest = sorted(boards, key=lambda board: -(board.about.data_version or 0))
    rows = sorted(map(_row, boards), key=lambda row: row[1])
    head = ("Board", "Queries", "Suites", "Places", "Asking", "Extracts", "Disk", "Sealed", "Task version", "Open")
    parts = [_INTRODUCTION, *(line for board in newest for line in _headline(board))]
    return "\n".join((*parts, _ENTERING.format(version=TASK_VERSION), *table(head, rows)))


def sites() -> Iterator[tuple[str, bytes]]:
    """Yield the files of the site of each board, by their paths in the site of the documentation."""
    for pack in sorted(RESULTS.glob("*/pack.json")):
        with TemporaryDirectory() as scratch:
            folder = publish(pack.parent, Path(scratch) / "site", tables_only=True).folder
            for path in sorted(folder.rglob("*")):
                if path.is_file():
                    yield f"{site_of(pack.parent.name)}/{path.relative_to(folder).as_posix()}", path.read_bytes()


def site_of(name: str) -> str:
    """Return the folder of a board's site in that of the documentation."""
    return f"boards/{name}"


def _headline(board: Board) -> Iterator[str]:
    """Yield heading, sentences and versions of one board."""
    about = board.about
    yield f"\n## [{_title_of(board)}]({site_of(board.folder.name)}/index.html)\n"
    overviews = overviews_of(Book.of(board.leaderboard, about.entries, added=about.added))
    yield from _sentences(overviews)
    yield (
        f"\n`{board.folder.name}`, scorer version {about.scorer_version}, maps of data version {about.data_version}"
        f"{'' if about.data_version == DATA_VERSION else ' (closed)'}."
    )


def _sentences(overviews: Sequence[Overview]) -> Iterator[str]:
    """Yield the first of what a board says: who is good at what, and where too few were asked."""
    found = list(dict.fromkeys(f"- **{one.family}**: {one.text}." for all_ in overviews for one in all_.headlines))
    yield from found[:_MOST_SENTENCES]
    if len(found) > _MOST_SENTENCES:
        yield f"- {len(found) - _MOST_SENTENCES} more on its first page."
    few = "; ".join(overview.few_text for overview in overviews if overview.few)
    if few:
        yield f"- **Too few to rank**: {few}."


def _title_of(board: Board) -> str:
    """Return the title of a board; boards of before titles were stored have that of their pipeline."""
    about = board.about
    if about.title or about.pipeline is None:
        return about.title or board.folder.name
    return read_pipeline_file(find_pipeline_file(about.pipeline.id)).title


def _row(board: Board) -> tuple[str, int, int, int, str, str, str, str, int, str]:
    """Return what entering one board takes, from its stored tables."""
    folder, about = board.folder, board.about
    tasks = read_frame(folder / "tasks.parquet", mend="")
    maps = {one["id"]: one for one in map(json.loads, tasks["region_json"])}
    drawn = list(map(json.loads, tasks["task_json"]))
    queries = sum(sum(one["counts"].values()) for one in drawn)
    towns = {item.file for path in list_region_files().values() for item in read_region_file(path).extract if item.town}
    extracts = {one["extract"]["file"]: one["extract"]["bytes"] for one in maps.values()}
    real = {name: count for name, count in extracts.items() if name not in towns}
    bytes_on_disk = sum(part["bytes"] for one in (*maps.values(), *drawn) for part in one["files"].values())
    return (
        f"[`{folder.name}`]({site_of(folder.name)}/index.html)",
        queries,
        len({one["suite"] for one in drawn} - {CONTROLS}),
        len({base_of(name) for name in maps}),
        _asking(folder, queries),
        f"{len(real)}, {sum(real.values()) / 1e6:.0f} MB" if real else "none",
        f"{bytes_on_disk / 1e6:.0f} MB",
        str(len(about.sealed) or "-"),
        int(about.task_version or 0),
        "yes" if about.data_version == DATA_VERSION else "closed",
    )


def _asking(folder: Path, queries: int) -> str:
    """Return how long the quickest and the slowest ranked row of a board would take for so many queries."""
    answers = read_frame(folder / "predictions.parquet", mend="")
    means = answers[~answers["matcher"].map(is_unranked).astype(bool)].groupby("matcher")["latency_s"].mean()
    return " to ".join(duration_text(queries * float(end)) for end in (means.min(), means.max()))
