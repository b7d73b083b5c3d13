# SPDX-License-Identifier: Apache-2.0
"""A dataset release on disk: maps, tasks and truths as others load them, with their hashes; whole or not at all."""

import shutil
from collections import Counter
from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

import pyarrow as pa
import pyarrow.compute as pc

from sasgeo_bench.core.errors import SasgeoError, StoreError
from sasgeo_bench.core.folders import (
    FileRecord,
    check_known,
    check_room,
    file_record,
    fresh_folder,
    is_ours,
    locked,
    sha256_of,
)
from sasgeo_bench.core.parquet import open_table, read_table, table_writer
from sasgeo_bench.core.paths import plain_file
from sasgeo_bench.core.texts import json_text
from sasgeo_bench.regions.imagery import ORTHO
from sasgeo_bench.regions.region import ATTRIBUTION, DATA_VERSION, LICENCE, Manifest, credit_of
from sasgeo_bench.regions.region_files import MANIFEST
from sasgeo_bench.tasks import task_files
from sasgeo_bench.tasks.query import TASK_VERSION, base_of
from sasgeo_bench.tasks.split import Place, SplitFile
from sasgeo_bench.tasks.task_files import FILE_SCHEMA, PLAIN_TRUTH_SCHEMA, TRUTH_SCHEMA, Task

INDEX: Final = "release.json"
SUMS: Final = "SHA256SUMS"
NOTICE: Final = "LICENSE-ODbL.txt"
_PICTURES: Final = "frames.list.element.picture"  # the column as Parquet names it
IMAGERY: Final = "imagery/README.md"
LICENCE_URL: Final = "https://opendatacommons.org/licenses/odbl/1-0/"
COPYRIGHT_URL: Final = "https://www.openstreetmap.org/copyright"
SCHEMA_VERSION: Final = 1
TRUTHS: Final = "truth"  # configuration and record set of a suite's truths: its name, a dash, and this

_NOTICE: Final = """\
{credit}

The data of this release is made available under the Open Database License 1.0 (ODbL-1.0).
Licence text: {licence_url}
Source and its copyright: {copyright_url}

Whoever passes the data on, changed or not, keeps this notice, names OpenStreetMap and its contributors where a
reader sees it, and offers what is derived from the data under the ODbL as well. Further sources that stand above
have the licence that is named with them. A picture or a score made from
the data may have another licence and carries the attribution.
"""

_NO_IMAGERY: Final = f"""\
# Imagery

None is in this release: every file of it is derived from OpenStreetMap ({ATTRIBUTION}), and the column `frames` of the
queries is empty. Imagery has a licence of its own; a release that holds some lists it here, each picture with its
licence.
"""
_IMAGERY: Final = """\
# Imagery

Each file has the licence of the pictures that it was cut out of; who passes it on must name their authors where readers
see it. Photographs are not derived from OpenStreetMap, and not under the ODbL. What is rendered from a map is, and its
source says so. All other files are as the notice says.

| file | picture | date | licence | attribution | source |
|---|---|---|---|---|---|
"""


@dataclass(frozen=True, kw_only=True)
class ReleaseMap:
    """One map of a release: a folder of `regions/`, and the content of its `region.json`."""

    folder: Path
    manifest: Manifest

    @property
    def name(self) -> str:
        """Return the folder's name, which is the map's name in queries, as in "vaduz" or "vaduz@2021-10-28"."""
        return self.folder.name

    @property
    def region(self) -> str:
        """Return the region, whatever the date of the map and whether a suite has edited it."""
        return base_of(self.name)


@dataclass(frozen=True, kw_only=True)
class BoardTasks:
    """The queries of a published board: its name, its split, the folders of its tasks, and hashes of queries by id.

    `lost` counts queries of the board that are not drawn as they were, and not in the release.
    """

    name: str
    split: str
    folders: tuple[Path, ...]
    asked: Mapping[str, str]
    lost: int

    @property
    def regions(self) -> tuple[str, ...]:
        """Return the regions that are asked about, whatever the date of their maps."""
        return tuple(sorted({base_of(folder.name) for folder in self.folders}))


@dataclass(frozen=True, kw_only=True)
class ReleaseTask:
    """One task of a release.

    `parts` counts the queries of each part; `released` are the parts whose truths are released. `only` are the queries
    to release, all without it.
    """

    source: Task
    parts: Mapping[str, int]
    released: frozenset[str] = frozenset()
    only: frozenset[str] | None = None

    @property
    def suite(self) -> str:
        """Return the name of the suite."""
        return self.source.manifest.suite

    @property
    def map_name(self) -> str:
        """Return the map that is searched."""
        return self.source.manifest.region

    @property
    def is_whole(self) -> bool:
        """Return whether all its queries are released and of one part, so that its file is released as it is."""
        return len(self.parts) == 1 and self.only is None

    def file_of(self, part: str, *, kind: str = "queries") -> str:
        """Return the path in the release of a part's queries, or of its truths."""
        root = "tasks" if kind == "queries" else "truth"
        name = f"{kind}.parquet" if self.is_whole else f"{kind}-{part}.parquet"
        return f"{root}/{self.suite}/{self.map_name}/{name}"


@dataclass(frozen=True, kw_only=True)
class Release:
    """Content of a release, before and after it is written.

    `published` is a day as in 2026-01-31, `url` the address of the release, `with_truth` whether it holds all truths;
    `files` gives size and hash of each file of maps and tasks by its path, once they are copied. `board` is the id of
    the board whose queries they are, if they are one's, `lost` how many of these are not here.
    """

    regions: tuple[str, ...]
    split: SplitFile
    maps: tuple[ReleaseMap, ...]
    tasks: tuple[ReleaseTask, ...]
    with_truth: bool
    published: str
    made_by: str
    url: str | None = None
    files: Mapping[str, FileRecord] = field(default_factory=dict)
    board: str | None = None
    lost: int = 0

    @property
    def version(self) -> str:
        """Return the versions of data and tasks, as in 1.1.0; regions do not count."""
        return f"{DATA_VERSION}.{TASK_VERSION}.0"

    @property
    def credit(self) -> str:
        """Return whom to name beside the data: OpenStreetMap, and further sources of maps."""
        return credit_of(item.manifest.provenance for item in self.maps)

    @property
    def truths_text(self) -> str:
        """Return which truths are in the release."""
        if self.board is not None:
            return f"in the stored results of the board {self.board}"
        return "of all queries" if self.with_truth else "of the test part left out"

    @property
    def suites(self) -> tuple[str, ...]:
        """Return the suites in the order of their names."""
        return tuple(sorted({task.suite for task in self.tasks}))

    @property
    def queries(self) -> int:
        """Return the number of queries in all."""
        return sum(sum(task.parts.values()) for task in self.tasks)

    @property
    def bytes(self) -> int:
        """Return the size of all files that are written."""
        return sum(record.bytes for record in self.files.values())

    def tasks_of(self, suite: str) -> list[ReleaseTask]:
        """Return the tasks of one suite, in the order of their maps."""
        return [task for task in self.tasks if task.suite == suite]

    def tables_of(self, suite: str, *, kind: str = "queries") -> dict[str, list[str]]:
        """Return the files of a suite's queries or truths by part, without parts that have none."""
        found: dict[str, list[str]] = {}
        for task in self.tasks_of(suite):
            for part in task.parts if kind == "queries" else sorted(task.released):
                found.setdefault(part, []).append(task.file_of(part, kind=kind))
        return {part: found[part] for part in sorted(found)}


def count_parts(task: Task, only: Collection[str] | None = None) -> dict[str, int]:
    """Count the queries of each part of a task, or some of them; raise `StoreError` if a column is missing."""
    path, found = task.folder / task_files.QUERIES, Counter[str]()
    task_files.check_columns(path, FILE_SCHEMA.names)
    for batch in task_files.read_batches(path, ["query_id", "part"]):
        found.update(_of(batch, only)["part"].to_pylist())
    return {part: found[part] for part in sorted(found)}


def _of(batch: pa.RecordBatch, only: Collection[str] | None) -> pa.RecordBatch:
    """Return the rows of some queries, or all."""
    return batch if only is None else batch.filter(pc.is_in(batch["query_id"], pa.array(sorted(only))))


def has_images(task: Task) -> bool:
    """Return whether any query of a task holds an image, by the counts of its file."""
    with open_table(task.folder / task_files.QUERIES, mend="make the queries again", is_whole=False) as source:
        metadata = source.metadata
    columns = [
        metadata.row_group(group).column(at)
        for group in range(metadata.num_row_groups)
        for at in range(metadata.num_columns)
        if metadata.schema.column(at).path == _PICTURES
    ]
    return any(one.statistics is None or one.statistics.null_count < one.num_values for one in columns)


def check_target(folder: Path) -> None:
    """Raise `StoreError`, naming a file, if a folder holds what no release has written, or what was changed since."""
    if folder.is_symlink() or (folder.exists() and not folder.is_dir()):
        raise StoreError(f"{folder} is a file or a link: move it away, a release goes there")
    check_room(folder)
    sums = _sums_of(folder)
    check_known(folder, {SUMS, *sums} if sums else (), "a release")
    changed = next((name for name, each in sums.items() if not _is_same(folder / name, each)), None)
    if changed is not None:
        raise StoreError(
            f"{folder / changed} was changed since it was released, which would be lost: move the folder away, or name "
            "another one"
        )


def _is_same(path: Path, sha256: str) -> bool:
    return not path.is_file() or sha256_of(path) == sha256


def _sums_of(folder: Path) -> dict[str, str]:
    """Return the SHA-256 of the files of an older release of ours; nothing where there is none."""
    try:
        lines = plain_file(folder / SUMS).read_text(encoding="utf-8").splitlines() if is_ours(folder / INDEX) else []
    except (OSError, UnicodeDecodeError):
        lines = []
    return {line[66:]: line[:64] for line in lines}  # two spaces between


@contextmanager
def open_release(folder: Path) -> Iterator[Path]:
    """Yield an empty folder that becomes the release when the block ends well; an older release is whole until then.

    Raise `StoreError` if the folder holds something else, or cannot be written.
    """
    try:
        with locked(folder):
            check_target(folder)
            with fresh_folder(folder) as scratch:
                yield scratch
    except SasgeoError:
        raise
    except OSError as error:
        raise StoreError(
            f"{folder} cannot be written ({error.strerror or error}): check the free space and your rights, and "
            "release again; a release that was there is as it was"
        ) from error


def copy_data(folder: Path, release: Release) -> None:
    """Copy maps and tasks into a release; files are copied whole, or a row group at a time where parts are mixed.

    Raise `StoreError` if a file is missing.
    """
    for item in release.maps:
        target = folder / "regions" / item.name
        target.mkdir(parents=True)
        for name in (MANIFEST, *item.manifest.files):
            _copy(item.folder / name, target / name)
    for task in release.tasks:
        _copy_queries(folder, task)
        if task.released:
            _copy_truths(folder, task)


def _copy(source: Path, target: Path) -> None:
    try:
        shutil.copyfile(source, target)
    except FileNotFoundError as error:
        raise StoreError(f"{source} is missing: build the region, or make the queries, again") from error


def _copy_queries(folder: Path, task: ReleaseTask) -> None:
    target = folder / "tasks" / task.suite / task.map_name
    target.mkdir(parents=True)
    if task.is_whole:
        for name in (task_files.QUERIES, task_files.TASK):
            _copy(task.source.folder / name, target / name)
        return
    for part in task.parts:
        rows = task_files.read_batches(task.source.folder / task_files.QUERIES, FILE_SCHEMA.names)
        chosen = (_of(batch.filter(pc.equal(batch["part"], part)), task.only) for batch in rows)
        _write_batches(folder / task.file_of(part), FILE_SCHEMA, chosen)


def _copy_truths(folder: Path, task: ReleaseTask) -> None:
    target = folder / "truth" / task.suite / task.map_name
    target.mkdir(parents=True)
    heads = read_table(
        task.source.folder / task_files.QUERIES, mend="make the queries again", columns=["query_id", "part"]
    )
    for part in sorted(task.released):
        ids = heads.filter(pc.equal(heads["part"], part))["query_id"].combine_chunks()
        rows = task_files.read_batches(task.source.truth / task_files.TRUTH, TRUTH_SCHEMA.names)
        plain = (_plain(batch.filter(pc.is_in(batch["query_id"], ids))) for batch in rows)
        _write_batches(folder / task.file_of(part, kind="truth"), PLAIN_TRUTH_SCHEMA, plain)
    if task.is_whole:  # neither the seed nor the hash of the request, which would tell it
        _write_json(
            target / task_files.TRUTH_OF,
            {"queries_sha256": task.source.manifest.queries_sha256},
            credit=task.source.manifest.credit,
        )


def _plain(batch: pa.RecordBatch) -> pa.RecordBatch:
    """Return truths with lists of pairs instead of maps, which not every reader of Parquet knows."""
    columns = [column.cast(item.type) for column, item in zip(batch.columns, PLAIN_TRUTH_SCHEMA, strict=True)]
    return pa.RecordBatch.from_arrays(columns, schema=PLAIN_TRUTH_SCHEMA)


def _write_batches(path: Path, schema: pa.Schema, batches: Iterator[pa.RecordBatch]) -> None:
    with table_writer(path, schema, compression_level=9) as target:
        for batch in batches:
            if batch.num_rows:
                target.write_batch(batch.select(schema.names).cast(schema))


def _write_json(path: Path, content: Mapping[str, object], *, credit: str) -> None:
    path.write_text(json_text({**content, "licence": LICENCE, "attribution": credit}), encoding="utf-8")


def read_records(folder: Path, release: Release) -> dict[str, FileRecord]:
    """Return size and hash of every file by its path; raise `StoreError` if one differs from its manifest."""
    found = {
        path.relative_to(folder).as_posix(): file_record(path) for path in sorted(folder.rglob("*")) if path.is_file()
    }
    for item in release.maps:
        for name, record in item.manifest.files.items():
            if found[f"regions/{item.name}/{name}"] != record:
                raise StoreError(f"{item.folder / name} is not what {MANIFEST} says: build the region again")
    for task in (one for one in release.tasks if one.is_whole):
        part = next(iter(task.parts))
        if found[task.file_of(part)].sha256 != task.source.manifest.queries_sha256:
            raise StoreError(
                f"{task.source.folder / task_files.QUERIES} is not what {task_files.TASK} says: make the queries again"
            )
    return found


def write_texts(folder: Path, release: Release, texts: Mapping[str, str]) -> None:
    """Write the licence notice, the note on imagery, and further texts by their paths."""
    notice = _NOTICE.format(credit=release.credit, licence_url=LICENCE_URL, copyright_url=COPYRIGHT_URL)
    for name, text in {NOTICE: notice, IMAGERY: imagery_text(release.maps), **texts}.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_text(text, encoding="utf-8")


def imagery_text(maps: Sequence[ReleaseMap]) -> str:
    """Return the note on imagery: each picture with its licence and attribution, or that there is none."""
    rows = [
        f"| `regions/{item.name}/{ORTHO}` | {one.file} | {one.date.isoformat()} | {one.licence} | {one.attribution} "
        f"| {one.source or ''} |"
        for item in maps
        if item.manifest.imagery is not None
        for one in item.manifest.imagery.pictures
    ]
    return _IMAGERY + "\n".join(rows) + "\n" if rows else _NO_IMAGERY


def write_index(folder: Path, release: Release) -> None:
    """Write `release.json`: what is in the release, for programs."""
    split = release.split
    content = {
        "schema_version": SCHEMA_VERSION,
        "version": release.version,
        "data_version": DATA_VERSION,
        "task_version": TASK_VERSION,
        "made_by": release.made_by,
        "published": release.published,
        "regions": list(release.regions),
        **({} if release.board is None else {"board": {"id": release.board, "queries_left_out": release.lost}}),
        "split": {"id": split.id, "title": split.title, "kind": split.kind, "buffer_m": split.buffer_m},
        "places": [place.model_dump(mode="json", exclude_defaults=True) for place in places_of(release)],
        "maps": [map_record(item) for item in release.maps],
        "tasks": [_task_record(task) for task in release.tasks],
        "truths": release.truths_text,
        "licence_url": LICENCE_URL,
    }
    _write_json(folder / INDEX, content, credit=release.credit)


def places_of(release: Release) -> list[Place]:
    """Return the places of the split with regions of the release, without the regions that it does not hold."""
    found = []
    for place in release.split.place:
        own = [name for name in place.regions if name in release.regions]
        blocks = [name for name in place.blocks if name.split("/")[0] in release.regions]
        if own or blocks:
            found.append(place.model_copy(update={"regions": own, "blocks": blocks}))
    return found


def map_record(item: ReleaseMap) -> dict[str, object]:
    """Return what the manifest of a release says of a map."""
    about = item.manifest
    return {
        "map": item.name,
        "region": item.region,
        "title": about.title,
        "date": about.extract.date.isoformat(),
        "epsg": about.epsg,
        "bounds_lonlat": list(about.bounds_lonlat),
        "fingerprint": about.fingerprint,
        "extract": {"file": about.extract.file, "sha256": about.extract.sha256},
        **about.provenance.model_dump(),
    }


def _task_record(task: ReleaseTask) -> dict[str, Any]:
    return {
        "suite": task.suite,
        "suite_version": task.source.manifest.suite_version,
        "map": task.map_name,
        "split": task.source.manifest.split,
        "queries": dict(task.parts),
        "truths": sorted(task.released),
        "files": {part: task.file_of(part) for part in task.parts},
    }


def write_sums(folder: Path, known: Mapping[str, FileRecord]) -> None:
    """Write `SHA256SUMS`, the last file of a release; hashes in `known` are not computed again."""
    names = sorted(path.relative_to(folder).as_posix() for path in folder.rglob("*") if path.is_file())
    lines = [f"{(known.get(name) or file_record(folder / name)).sha256}  {name}\n" for name in names]
    (folder / SUMS).write_text("".join(lines), encoding="utf-8")
