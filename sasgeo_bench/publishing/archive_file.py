# SPDX-License-Identifier: Apache-2.0
"""Stored results: a board with the answers and truths it was made of, small enough to be kept with the code.

What was seen is left out, for scores need none of it; so matchers cannot be run on what is stored, and all that was
answered can be scored again.
"""

import gzip
import json
import re
import shutil
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
import pyarrow as pa

from sasgeo_bench.bounds import one_line
from sasgeo_bench.errors import SasgeoError, StoreError
from sasgeo_bench.files.file_manifest import SITE_FOLDERS, hashes_of, list_files, resolve_link
from sasgeo_bench.files.folders import fresh_folder, locked
from sasgeo_bench.files.json import parse_json
from sasgeo_bench.files.parquet import read_table, write_table
from sasgeo_bench.geometry.pose import Pose
from sasgeo_bench.leaderboard.board_files import FIGURES, PICTURES
from sasgeo_bench.matching import learned_file
from sasgeo_bench.matching.learned_file import LearnedSaid
from sasgeo_bench.matching.results import Prediction
from sasgeo_bench.publishing.archive_folder import (
    CSV,
    LEARNED,
    PACK,
    PREDICTIONS,
    SCHEMA_VERSION,
    TABLES,
    check_replaced,
    read_settings,
    sound,
)
from sasgeo_bench.publishing.archive_rows import RUNS_SCHEMA, TASK, TASK_SCHEMA, check_predictions, check_tables
from sasgeo_bench.regions.region import ATTRIBUTION, LICENCE
from sasgeo_bench.regions.region_files import MANIFEST
from sasgeo_bench.running import prediction_files
from sasgeo_bench.running.prediction_rows import PREDICTION_SCHEMA, prediction_row
from sasgeo_bench.tasks import task_files
from sasgeo_bench.tasks.task_rows import ASKED, HEAD_SCHEMA, TRUTH_SCHEMA, VIEW_BYTES, asked_under
from sasgeo_bench.texts import FOLDER, json_text

MOST_BYTES: Final = 20_000_000
_LEVEL: Final = 19
_PAGE_BYTES: Final = 2**24  # what is alike is told once in a page: few pages, small files
_TEXTS: Final = ("query_id", "track", "suite", "part", "region", "prior_group", "status", "message")
_MEND: Final = "fetch the results again"
_AND: Final = "; "
_NO_PICTURES: Final = "pictures of regions, suites and cases"
_NO_HEADINGS: Final = "heading and scale of all poses of an answer but the first: no figure reads them"


@dataclass(frozen=True, slots=True, kw_only=True)
class TaskFolders:
    """Folders of a task, its truths and its map; the map need not exist."""

    task: Path
    truth: Path
    region: Path


@dataclass(frozen=True, slots=True, kw_only=True)
class StoredRun:
    """One run: what `run.json` is to say, its answers, and the text that was learnt for it, if any."""

    about: Mapping[str, Any]
    predictions: Sequence[Prediction]
    learned: Path | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class Packed:
    """Result of writing: bytes in all, bytes and number of predictions, and what was left out to be small."""

    total_bytes: int
    prediction_bytes: int
    predictions: int
    dropped: str = ""


def write_pack(
    folder: Path,
    *,
    board: Path,
    tasks: Sequence[TaskFolders],
    runs: Mapping[str, Sequence[StoredRun]],
    settings: Mapping[str, Any],
    lacks: str = "",
    most_bytes: int = MOST_BYTES,
) -> Packed:
    """Store a board with what it was made of, whole or not at all.

    Parameters
    ----------
    folder : Path
        To write; older results there are replaced.
    board : Path
        Folder of the board.
    tasks : sequence of TaskFolders
        All that were scored, in the order they were.
    runs : mapping of str to sequence of StoredRun
        By contestant, in the order they were read.
    settings : mapping
        How it was scored.
    lacks : str
        What stored results it was made of had left out already.
    most_bytes : int
        Of all files together. What is larger is written without pictures, then without headings and scales of the poses
        beside the first, and then with figures as .svg.gz.

    Returns
    -------
    Packed
        How large it is.

    Raises
    ------
    StoreError
        If it would be larger all the same, the folder holds something else, or a file cannot be read or written; what
        was there before is as it was.
    """
    check_replaced(folder)
    folder = resolve_link(folder)
    try:
        with locked(folder, tell=lambda _: None), fresh_folder(folder) as scratch:
            list_files(board, without=SITE_FOLDERS)  # a link would be followed to what it leads to
            shutil.copytree(board, scratch, dirs_exist_ok=True, ignore=shutil.ignore_patterns(*SITE_FOLDERS))
            _squeeze(scratch / CSV)
            _write_tasks(scratch, tasks)
            _write_runs(scratch, runs)
            said, dropped = {**settings, "contestants": list(runs)}, lacks
            found = _write_predictions(scratch, runs, is_lean=False)
            _write_settings(scratch, said, dropped)
            if _bytes_of(scratch) > most_bytes and (scratch / PICTURES).is_dir():
                shutil.rmtree(scratch / PICTURES)
                dropped = _with(dropped, _NO_PICTURES)
                _write_settings(scratch, said, dropped)
            if _bytes_of(scratch) > most_bytes:
                dropped = _with(dropped, _NO_HEADINGS)
                found = _write_predictions(scratch, runs, is_lean=True)
                _write_settings(scratch, said, dropped)
            if _bytes_of(scratch) > most_bytes:  # they are drawn again where results are scored
                for figure in sorted((scratch / FIGURES).glob("*.svg")):
                    _squeeze(figure)
                _write_settings(scratch, said, dropped)
            total = _bytes_of(scratch)
            _check_size(folder, total, found, most_bytes)
    except SasgeoError:
        raise
    except OSError as error:
        message = (
            f"{folder} cannot be written ({_reason(error)}): check the free space and your rights; results "
            "that were there are as they were"
        )
        raise StoreError(message) from error
    count = sum(len(run.predictions) for listed in runs.values() for run in listed)
    return Packed(total_bytes=total, prediction_bytes=found, predictions=count, dropped=dropped)


def _reason(error: OSError) -> str:
    """Return why a file could not be written; for a copied folder the reason of its first file."""
    if isinstance(error, shutil.Error) and error.args and isinstance(error.args[0], list) and error.args[0]:
        return one_line(str(error.args[0][0][-1]))
    return one_line(str(error.strerror or error))


def _with(dropped: str, more: str) -> str:
    """Return what was left out with one more item, each once."""
    return _AND.join(dict.fromkeys(filter(None, (*dropped.split(_AND), more))))


def _write_settings(folder: Path, said: Mapping[str, Any], dropped: str) -> None:
    content = {
        "schema_version": SCHEMA_VERSION,
        **said,
        "dropped": dropped,
        "licence": LICENCE,
        "attribution": ATTRIBUTION,
        "files": hashes_of(folder, [name for name in list_files(folder) if name != PACK]),
    }
    (folder / PACK).write_text(json_text(content), encoding="utf-8")


def _check_size(folder: Path, total: int, predictions: int, most: int) -> None:
    if total > most:
        message = (
            f"{folder} would hold {total / 1e6:.1f} MB ({predictions / 1e6:.1f} MB of predictions), {most / 1e6:g} MB "
            "at most: store a pipeline of fewer matchers or sites, or of a smaller top_k; nothing was written"
        )
        raise StoreError(message)


def _bytes_of(folder: Path) -> int:
    return sum(path.stat().st_size for path in folder.rglob("*") if path.is_file())


def _squeeze(path: Path) -> None:
    """Put a .gz in place of a file: the same bytes for the same text."""
    with gzip.GzipFile(f"{path}.gz", "wb", compresslevel=9, mtime=0) as target:
        target.write(path.read_bytes())
    path.unlink()


def _write_table(table: pa.Table, path: Path) -> None:
    leaves = [name for name in table.column_names if name in {*_TEXTS, "about"}]
    write_table(
        table,
        path,
        compression_level=_LEVEL,
        data_page_size=_PAGE_BYTES,
        row_group_size=max(len(table), 1),
        use_dictionary=[*leaves, "diagnostics.key_value.key", "measured.key_value.key"],
        write_statistics=False,
    )


def _write_tasks(folder: Path, tasks: Sequence[TaskFolders]) -> None:
    """Tasks without what was seen, and their truths."""
    said, queries, truths = [], [], []
    for number, item in enumerate(tasks):
        region = item.region / MANIFEST
        said.append(
            {
                "task_json": (item.task / task_files.TASK).read_text(encoding="utf-8"),
                "truth_json": (item.truth / task_files.TRUTH_OF).read_text(encoding="utf-8"),
                "region_json": region.read_text(encoding="utf-8") if region.is_file() else None,
            }
        )
        heads = read_table(item.task / task_files.QUERIES, mend="make the queries again", columns=HEAD_SCHEMA.names)
        asked, view_bytes = task_files.read_asked(item.task), task_files.read_view_bytes(item.task)
        names = heads["query_id"].to_pylist()
        heads = heads.append_column(ASKED, pa.array([asked[name] for name in names], pa.string()))
        heads = heads.append_column(VIEW_BYTES, pa.array([view_bytes[name] for name in names], pa.int64()))
        queries.append(_numbered(heads, number))
        told = read_table(item.truth / task_files.TRUTH, mend="make the queries again", columns=TRUTH_SCHEMA.names)
        truths.append(_numbered(told, number))
    _write_table(pa.Table.from_pylist(said, schema=TASK_SCHEMA), folder / "tasks.parquet")
    _write_table(pa.concat_tables(queries), folder / "queries.parquet")
    _write_table(pa.concat_tables(truths), folder / "truths.parquet")


def _numbered(table: pa.Table, number: int) -> pa.Table:
    return table.append_column(TASK, pa.array(np.full(len(table), number), pa.int32()))


def _write_runs(folder: Path, runs: Mapping[str, Sequence[StoredRun]]) -> None:
    """Write the record of each run and its training, each text once."""
    rows = []
    for name, listed in runs.items():
        for run in listed:
            about = json.dumps(dict(run.about))
            rows.append({"contestant": name, "rows": len(run.predictions), "about": about})
            if run.learned is not None and run.learned.is_file():
                place = folder / LEARNED / _file_of(run.about)
                place.mkdir(parents=True, exist_ok=True)
                shutil.copyfile(run.learned, place / run.learned.name)
    _write_table(pa.Table.from_pylist(rows, schema=RUNS_SCHEMA), folder / "runs.parquet")


def _file_of(about: Mapping[str, Any]) -> str:
    """Name of a contestant's file: that of the matcher, and its hash."""
    return f"{about['matcher']['name']}-{about['hash']}"


def _write_predictions(folder: Path, runs: Mapping[str, Sequence[StoredRun]], *, is_lean: bool) -> int:
    """Write a file for each entry, its runs one after the other, and return the bytes."""
    place = folder / PREDICTIONS
    place.mkdir(exist_ok=True)
    for listed in runs.values():
        rows = [item for run in listed for item in run.predictions]
        kept = [prediction_row(_lean(item) if is_lean else item) for item in rows]
        table = pa.Table.from_pylist(kept, schema=PREDICTION_SCHEMA)
        _write_table(table, place / f"{_file_of(listed[0].about)}.parquet")
    return _bytes_of(place)


def _lean(item: Prediction) -> Prediction:
    """An answer whose poses all have the heading and scale of the first."""
    if not item.candidates:
        return item
    first = item.candidates[0][0]
    poses = tuple(
        (Pose(easting_m=pose.easting_m, northing_m=pose.northing_m, yaw_deg=first.yaw_deg, scale=first.scale), score)
        for pose, score in item.candidates
    )
    return Prediction(
        query_id=item.query_id,
        candidates=poses,
        confidence=item.confidence,
        diagnostics=item.diagnostics,
        status=item.status,
        message=item.message,
        latency_s=item.latency_s,
    )


# --- back to folders --------------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True, kw_only=True)
class Unpacked:
    """Stored results as folders again, in the order they were scored."""

    root: Path
    tasks: tuple[Path, ...]
    runs: tuple[Path, ...]


def unpack(folder: Path, into: Path) -> Unpacked:
    """Lay stored results out as tasks/, truth/, regions/ and runs/, as they are scored.

    Parameters
    ----------
    folder : Path
        From `write_pack`.
    into : Path
        An empty folder.

    Raises
    ------
    StoreError
        If the results are damaged.
    """
    with sound(folder):
        read_settings(folder)
        tables = {name: read_table(folder / f"{name}.parquet", mend=_MEND) for name in TABLES}
        check_tables(tables)
        tasks = tuple(_lay_tasks(tables, into))
        asked = dict(zip(*(tables["queries"][name].to_pylist() for name in ("query_id", ASKED)), strict=True))
        return Unpacked(root=into, tasks=tasks, runs=tuple(_lay_runs(folder, tables["runs"], asked, into)))


def unpack_tasks(folder: Path, into: Path) -> tuple[Path, ...]:
    """Lay the tasks of stored results out, with their maps' `region.json` and truths, and no answers.

    Parameters
    ----------
    folder : Path
        From `write_pack`.
    into : Path
        An empty folder.

    Returns
    -------
    tuple of Path
        Task folders.

    Raises
    ------
    StoreError
        If the results are damaged.
    """
    with sound(folder):
        read_settings(folder)
        tables = {name: read_table(folder / f"{name}.parquet", mend=_MEND) for name in TABLES if name != "runs"}
        check_tables(tables)
        return tuple(_lay_tasks(tables, into))


def _lay_tasks(tables: Mapping[str, pa.Table], into: Path) -> Iterator[Path]:
    parts = {name: _parts_of(tables[name]) for name in ("queries", "truths")}
    for number, row in enumerate(tables["tasks"].to_pylist()):
        about = parse_json(row["task_json"])
        suite, region = (_folder_name(about[name]) for name in ("suite", "region"))
        task, truth = (into / kind / suite / region for kind in ("tasks", "truth"))
        for place in (task, truth):
            place.mkdir(parents=True)
        (task / task_files.TASK).write_text(row["task_json"], encoding="utf-8")
        (truth / task_files.TRUTH_OF).write_text(row["truth_json"], encoding="utf-8")
        write_table(parts["queries"][number], task / task_files.QUERIES)
        write_table(parts["truths"][number], truth / task_files.TRUTH)
        if row["region_json"] is not None:
            place = into / "regions" / region
            place.mkdir(parents=True, exist_ok=True)
            (place / MANIFEST).write_text(row["region_json"], encoding="utf-8")
        yield task


def _parts_of(table: pa.Table) -> dict[int, pa.Table]:
    """Rows of each task, which lie together."""
    numbers, starts, counts = np.unique(table[TASK].to_numpy(), return_index=True, return_counts=True)
    plain = table.drop_columns([TASK])
    return {
        int(number): plain.slice(start, count) for number, start, count in zip(numbers, starts, counts, strict=True)
    }


def _folder_name(name: str) -> str:
    if not re.fullmatch(FOLDER, name):
        message = f"{name!r} is no name of a folder"
        raise ValueError(message)
    return name


def _lay_runs(folder: Path, runs: pa.Table, asked: Mapping[str, str], into: Path) -> Iterator[Path]:
    by_name: dict[str, list[dict[str, Any]]] = {}
    for row in runs.to_pylist():
        by_name.setdefault(row["contestant"], []).append({**row, "about": parse_json(row["about"])})
    for listed in by_name.values():
        stem = _folder_name(_file_of(listed[0]["about"]))
        table, start = read_table(folder / PREDICTIONS / f"{stem}.parquet", mend=_MEND), 0
        check_predictions(stem, table)
        if sum(row["rows"] for row in listed) != len(table):
            message = f"runs.parquet does not tell the {len(table)} answers of {stem}"
            raise ValueError(message)
        if (folder / LEARNED / stem).is_dir():
            shutil.copytree(folder / LEARNED / stem, into / "runs" / stem / learned_file.FOLDER)
        for row in listed:
            about, count = row["about"], row["rows"]
            place = into / "runs" / stem / _folder_name(about["suite"]) / _folder_name(about["region"])
            prediction_files.write_run(place, about)
            said = LearnedSaid.of(about)
            key = None if said is None else said.key
            part = table.slice(start, count)
            ties = [asked_under(asked[name], key) for name in part["query_id"].to_pylist()]
            write_table(part.append_column(ASKED, pa.array(ties, pa.string())), place / "part-0.parquet")
            start += count
            yield place
