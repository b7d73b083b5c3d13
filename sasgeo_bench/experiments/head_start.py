# SPDX-License-Identifier: Apache-2.0
"""A head start: answers to what a pipeline asks first lie packed beside its file, and are unpacked once.

An archive may come from anybody. So it holds answers alone, never maps, queries, truths or what was learned: these
are made here, and an answer to another query than is drawn here counts for nothing. A pipeline file states the SHA-256
of its archive. What is unpacked is marked for good (`prediction_files.PACKED`), so that no board says "run here" of it.
"""

import hashlib
import io
import lzma
import re
import tarfile
from pathlib import Path, PurePosixPath
from tempfile import TemporaryDirectory
from typing import Final

from sasgeo_bench.boards.pipeline_spec import ArchiveSpec
from sasgeo_bench.core.archives import plain_members
from sasgeo_bench.core.errors import SasgeoError, StoreError, counted
from sasgeo_bench.core.folders import locked, remove_tree
from sasgeo_bench.core.json import parse_json
from sasgeo_bench.core.paths import plain_file
from sasgeo_bench.core.progress import tell
from sasgeo_bench.core.texts import one_line
from sasgeo_bench.running.leak_scan import PACKED
from sasgeo_bench.running.prediction_files import RUN, mark_packed

FOLDER: Final = "runs"  # below the root of what is built
MOST_PACKED: Final = 50_000_000  # bytes of an archive,
MOST_BYTES: Final = 100_000_000  # of what is in it,
MOST_FILES: Final = 20_000  # its files and folders,
MOST_MEMORY: Final = 200_000_000  # and bytes that unpacking may take
_SCRATCH: Final = ".head-start-"
_AT_ONCE: Final = 2**20
_PART: Final = re.compile(r"[A-Za-z0-9][A-Za-z0-9._+@-]{0,199}")  # of a path
_DEPTH: Final = 6  # runs/<matcher>/<hash>/<suite>/<region>/<file>
_DAMAGES: Final = (EOFError, lzma.LZMAError, tarfile.TarError, ValueError, OverflowError, MemoryError, RecursionError)
_FILE: Final = re.compile(r"run\.json|part-\d{20}-\d{1,10}\.parquet")


def head_start_of(pipeline_file: Path) -> Path | None:
    """Return the archive beside a pipeline file, `demo.tar.xz` beside `demo.toml`; None where none is.

    Raise `StoreError` if what has its name is no file.
    """
    archive = pipeline_file.with_name(pipeline_file.stem + PACKED)
    if archive.is_file():
        return archive
    if archive.is_symlink() or archive.exists():
        raise StoreError(f"{archive} is no file, and a head start of {pipeline_file.name} has this name: move it away")
    return None


def packed_for(pipeline_file: Path, stated: ArchiveSpec | None) -> Path | None:
    """Return the archive beside a pipeline file that states one; None, and a line that says why, where one is lacking.

    Raise `StoreError` as `head_start_of` does.
    """
    archive = head_start_of(pipeline_file)
    if archive is not None and stated is None:
        tell(
            f"{archive.name} is left packed, for {pipeline_file.name} does not state its SHA-256: "
            'archive = {sha256 = "..."} trusts it'
        )
        return None
    if archive is None and stated is not None:
        tell(f"{pipeline_file.name} states an archive, and there is none beside it: all is asked here")
    return archive


def unpack_head_start(pipeline_file: Path, stated: ArchiveSpec | None, out: Path) -> None:
    """Lay answers that are packed beside a pipeline file into `out`; nothing where it states no archive.

    The answers to each task are laid down whole where no run of their name has any, and replace nothing. They count as
    answers that were asked here do: to the same queries, by the same code. Raise `StoreError` if the archive is not the
    one that the file states, is damaged, holds something else or too much, or `out` cannot be written.
    """
    archive = packed_for(pipeline_file, stated)
    if archive is None or stated is None:
        return
    data = _read(archive, stated.sha256, pipeline_file)
    try:
        with locked(out / "head-start"):
            for left in out.glob(f"{_SCRATCH}*"):  # of a run that was killed: no other process unpacks now
                remove_tree(left)
            with TemporaryDirectory(prefix=_SCRATCH, dir=out) as folder:
                _unpack(archive, data, Path(folder))
                laid = _lay_all(Path(folder), out, stated.sha256)
    except SasgeoError:  # an error with a cause of its own, though it may be an `OSError`
        raise
    except OSError as error:
        raise StoreError(
            f"{out} cannot be written ({error.strerror or error}: {error.filename2 or error.filename}): check your "
            "rights and the free space, or name another folder by --out"
        ) from error
    if laid:
        tell(f"answers to {counted(laid, 'task')} came packed in {archive.name}, are not asked again, and say so")


def _read(archive: Path, sha256: str, pipeline_file: Path) -> bytes:
    """Read an archive; refuse one that is not the stated one."""
    try:
        with plain_file(archive).open("rb") as file:
            data = file.read(MOST_PACKED + 1)
    except OSError as error:
        raise StoreError(f"{archive} cannot be read ({error.strerror or error}): check your rights") from error
    if len(data) > MOST_PACKED:
        raise StoreError(f"{archive} is larger than {MOST_PACKED} bytes: pack less")
    found = hashlib.sha256(data).hexdigest()
    if found != sha256:
        raise StoreError(
            f"{archive} is not the archive that {pipeline_file.name} states (its SHA-256 is {found[:12]}..., stated is "
            f"{sha256[:12]}...): fetch both again, or take the archive away, and all is asked here"
        )
    return data


def _unpack(archive: Path, data: bytes, scratch: Path) -> None:
    """Unpack an archive of answers alone; whatever else is in it is refused before the first is written."""
    try:
        with tarfile.open(fileobj=io.BytesIO(_unpressed(data)), mode="r:") as packed:
            mend = f"pack answers alone, the folder {FOLDER} as it lies below OUT"
            members = plain_members(archive, packed, is_known=_is_of_run, most=MOST_FILES, mend=mend)
            files = {name: packed.extractfile(member) for name, member in members}
            for name, file in files.items():
                path = scratch / name
                path.parent.mkdir(parents=True, exist_ok=True)
                path.write_bytes(b"" if file is None else file.read())
    except _DAMAGES as error:
        mend = "pack it again, or take it away, and all is asked here"
        raise StoreError(f"{archive} is damaged ({one_line(str(error)) or type(error).__name__}): {mend}") from error
    _check_runs(archive, scratch)


def _unpressed(data: bytes) -> bytes:
    """Return what is compressed, in bounded memory; raise `ValueError` if it is too much."""
    reader = lzma.LZMADecompressor(format=lzma.FORMAT_XZ, memlimit=MOST_MEMORY)
    found = bytearray(reader.decompress(data, _AT_ONCE))
    while not reader.eof:
        if len(found) > MOST_BYTES:
            raise ValueError(f"it holds more than {MOST_BYTES} bytes")
        part = reader.decompress(b"", _AT_ONCE)
        if not part and reader.needs_input:
            raise EOFError("it is cut")
        found += part
    return bytes(found)


def _is_of_run(path: PurePosixPath, is_file: bool) -> bool:  # noqa: FBT001 - as `plain_members` asks
    """Return whether a member is the record of a run or a part of its answers, or a folder on the way there.

    >>> [_is_of_run(PurePosixPath(name), True) for name in ("runs/a/b/clean/vaduz/run.json", "runs/../a")]
    [True, False]
    """
    parts = path.parts
    is_within = bool(parts) and parts[0] == FOLDER and all(map(_PART.fullmatch, parts))
    if not is_file:
        return is_within and len(parts) < _DEPTH
    return is_within and len(parts) == _DEPTH and _FILE.fullmatch(parts[-1]) is not None


def _check_runs(archive: Path, scratch: Path) -> None:
    """Refuse answers without a sound record of their run: it is what tells who gave them."""
    for folder in sorted({path.parent for path in scratch.rglob("*") if path.is_file()}):
        try:
            about = parse_json(plain_file(folder / RUN).read_bytes())
        except (OSError, ValueError, RecursionError):
            about = None
        if not isinstance(about, dict):
            where = folder.relative_to(scratch)
            raise StoreError(f"{archive} holds no sound {RUN} in {where}: pack each run with its record")


def _lay_all(scratch: Path, out: Path, sha256: str) -> int:
    """Move the answers to each task to where none lie, marked; return how many were moved."""
    units = {run.parent: out / run.parent.relative_to(scratch) for run in scratch.rglob(RUN)}
    for unit, target in units.items():  # before the first is moved: where one cannot be, none is
        mark_packed(unit, sha256)
        target.parent.mkdir(parents=True, exist_ok=True)
    new = {unit: target for unit, target in units.items() if not target.exists()}
    for unit, target in new.items():
        unit.rename(target)
    return len(new)
