# SPDX-License-Identifier: Apache-2.0
"""Read and write Parquet files with checksums and within bounds; every table of ours goes through here.

Each page carries a CRC, which any reader can verify. Pages do not cover the footer, which holds names and types of the
columns, so a file also carries the CRC-32 of its own footer. A file of somebody else may have neither; then only its
structure is checked.
"""

import json
import os
import zlib
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any, BinaryIO, Final

import pyarrow as pa

from sasgeo_bench.core.errors import SasgeoError, StoreError
from sasgeo_bench.core.paths import plain_file

# Every process of a matcher imports this, and hardly one reads a file: what reading takes is imported where it is used.
if TYPE_CHECKING:
    import pandas as pd
    import pyarrow.parquet as pq

CHECKED: Final = {"compression": "zstd", "write_page_checksum": True}
VERIFIED: Final = {"page_checksum_verification": True}
MOST_ROWS: Final = 1_000_000  # of a table that is converted to rows
MOST_VALUES: Final = 100_000_000  # of all columns together, with the items of lists
_MOST_UNPACKED: Final = 2_000_000_000  # bytes
MOST_TEXT_BYTES: Final = 32_000_000  # of one text
_TEXTS_AT_ONCE: Final = 65_536
_ATTRS: Final = b"PANDAS_ATTRS"  # where pandas itself looks for them
_SEAL: Final = b"sasgeo_footer_crc32"
_DIGITS: Final = 8  # of a CRC-32, hexadecimal
_MARK: Final = _SEAL + bytes((0x18, _DIGITS))  # Thrift's next field, a text of so many bytes
_TAIL_BYTES: Final = 8  # length of the footer, and the magic number
_MOST_QUOTED: Final = 200  # characters of a library's error


@contextmanager
def table_writer(path: Path, schema: pa.Schema, **options: Any) -> Iterator["pq.ParquetWriter"]:  # noqa: ANN401
    """Open a writer of a table with checksums; `options` are those of `pyarrow.parquet.ParquetWriter`.

    The table is complete when the block ends.
    """
    import pyarrow.parquet as pq  # noqa: PLC0415

    about = {key: value for key, value in (schema.metadata or {}).items() if key != _SEAL}
    with pq.ParquetWriter(path, schema.with_metadata(about), **{**CHECKED, **options}) as writer:
        writer.add_key_value_metadata({_SEAL.decode(): "0" * _DIGITS})
        yield writer
    # Write the CRC of the footer, computed with zeros in its place, where the writer left zeros
    with path.open("r+b") as file:
        footer = _read_footer(file)
        at = footer.index(_MARK) + len(_MARK)
        file.seek(at - len(footer), os.SEEK_END)
        file.write(_crc_of(footer, at))


def write_table(table: pa.Table, path: Path, *, row_group_size: int | None = None, **options: Any) -> None:  # noqa: ANN401
    """Write a table with checksums; the same table gives the same bytes."""
    with table_writer(path, table.schema, **options) as writer:
        writer.write_table(table, row_group_size)


def write_frame(frame: "pd.DataFrame", path: Path, *, attrs: Mapping[str, object], **metadata: str) -> None:
    """Write a data frame with checksums, its `attrs`, and further metadata of the file."""
    table = pa.Table.from_pandas(frame, preserve_index=False)
    about = {**(table.schema.metadata or {}), **metadata, _ATTRS: json.dumps(attrs)}
    write_table(table.replace_schema_metadata(about), path)


def read_frame(path: Path, *, mend: str) -> "pd.DataFrame":
    """Read the output of `write_frame`, with its `attrs`; raise as `open_table` does."""
    return as_frame(read_table(path, mend=mend, most_rows=MOST_VALUES), path, mend=mend)


def as_frame(table: pa.Table, path: Path, *, mend: str) -> "pd.DataFrame":
    """Return a table that was read from the output of `write_frame` as a data frame; raise as `open_table` does."""
    try:
        frame: pd.DataFrame = table.to_pandas()
        frame.attrs = json.loads((table.schema.metadata or {}).get(_ATTRS, b"{}"))
    except (ValueError, TypeError, KeyError, AttributeError, IndexError, RecursionError, pa.ArrowException) as error:
        raise StoreError(f"{path} cannot be read ({str(error)[:_MOST_QUOTED]}): {mend}") from error
    return frame


@contextmanager
def open_table(
    path: Path,
    *,
    mend: str,
    most_rows: int = MOST_ROWS,
    is_whole: bool = True,
    **options: Any,  # noqa: ANN401
) -> Iterator["pq.ParquetFile"]:
    """Open a table of unknown origin: check its footer and bound its size before anything is read.

    A table that is not read whole (`is_whole`) is bounded by row group; a text that stands once in the file and in a
    million rows counts a million times. `options` are those of `pyarrow.parquet.ParquetFile`. Pages that carry a
    checksum are verified as they are read. Raise `StoreError`, with the advice `mend`, if the file is missing, damaged,
    no table, or too large, or if reading fails while it is open.
    """
    import pyarrow.parquet as pq  # noqa: PLC0415

    try:
        # Refuse a file whose footer contradicts its CRC; one without a CRC passes
        with plain_file(path).open("rb") as file:
            footer = _read_footer(file)
        at = footer.find(_MARK) + len(_MARK)
        if at >= len(_MARK) and footer[at : at + _DIGITS] != _crc_of(footer, at):
            raise pa.ArrowInvalid("its footer is damaged")
        with pq.ParquetFile(plain_file(path), **{**VERIFIED, **options}) as source:
            fault = size_fault(source.metadata, most_rows=most_rows, is_whole=is_whole)
            if fault is None and not options.get("read_dictionary"):  # who reads so has bounds of its own
                fault = _unpacked_fault(path, source.metadata, is_whole=is_whole)
            if fault is not None:
                raise StoreError(f"{path} holds {fault}: {mend}")
            yield source
    except SasgeoError:
        raise
    except (OSError, pa.ArrowException, UnicodeDecodeError) as error:
        text = getattr(error, "strerror", None) or str(error)
        raise StoreError(f"{path} cannot be read ({text[:_MOST_QUOTED]}): {mend}") from error


def read_table(path: Path, *, mend: str, columns: Sequence[str] | None = None, most_rows: int = MOST_ROWS) -> pa.Table:
    """Read a table, or some of its columns; raise as `open_table` does."""
    with open_table(path, mend=mend, most_rows=most_rows) as source:
        return source.read(columns=None if columns is None else list(columns))


def read_kept(
    path: Path,
    *,
    mend: str,
    keep: Callable[[pa.Table], pa.BooleanArray],
    may_hold: Callable[[Mapping[str, tuple[Any, Any]]], bool] = lambda _: True,
) -> pa.Table:
    """Read the rows that `keep` marks, one row group after the other; raise as `open_table` does.

    Row groups of which `may_hold` says that they have none are not read; it gets the least and the greatest value of
    each column that the footer has them for, by its path.
    """
    with open_table(path, mend=mend, most_rows=MOST_VALUES, is_whole=False) as source:
        groups = [at for at in range(source.num_row_groups) if may_hold(_ranges(source.metadata.row_group(at)))]
        parts = (source.read_row_group(at) for at in groups)
        kept = [part.filter(keep(part)) for part in parts]
        return pa.concat_tables(kept) if kept else source.schema_arrow.empty_table()


def _ranges(group: "pq.RowGroupMetaData") -> dict[str, tuple[Any, Any]]:
    chunks = [(chunk.path_in_schema, chunk.statistics) for chunk in map(group.column, range(group.num_columns))]
    return {name: (known.min, known.max) for name, known in chunks if known is not None and known.has_min_max}


def read_schema(path: Path, *, mend: str) -> pa.Schema:
    """Read names, types and metadata of a table's columns; raise as `open_table` does."""
    with open_table(path, mend=mend, most_rows=MOST_VALUES, is_whole=False) as source:
        return source.schema_arrow


def read_batches(
    path: Path, *, mend: str, rows: int, columns: Collection[str], text_bytes: int
) -> Iterator[pa.RecordBatch]:
    """Yield some columns of a table, so many rows at once; texts as dictionaries, that hold each distinct one once.

    Columns that the table lacks are passed over. Raise as `open_table` does, and if the texts of a column have more
    than `text_bytes` bytes each on the average: that is seen before they are unpacked.
    """
    with open_table(path, mend=mend) as source:
        leaves = map(source.schema.column, range(len(source.schema)))
        texts = {one.path for one in leaves if one.physical_type == "BYTE_ARRAY" and _column_of(one.path) in columns}
        fault = _texts_fault(source.metadata, texts, text_bytes)
        found = [name for name in dict.fromkeys(source.schema_arrow.names) if name in columns]
    if fault is not None:
        raise StoreError(f"{path} holds {fault}: {mend}")
    with open_table(path, mend=mend, read_dictionary=sorted(texts)) as source:
        for group in range(source.num_row_groups):  # Arrow cannot join the dictionaries of two inside a list
            yield from source.iter_batches(rows, row_groups=[group], columns=found)


def _column_of(leaf: str) -> str:
    return leaf.partition(".")[0]


def _texts_fault(about: "pq.FileMetaData", texts: Collection[str], text_bytes: int) -> str | None:
    """Describe a column of texts that are too long on the average, by the footer, or return None."""
    for group in map(about.row_group, range(about.num_row_groups)):
        for chunk in map(group.column, range(about.num_columns)):
            # A million bytes that a column of texts may have, with the headers of its pages
            size, most = chunk.total_uncompressed_size, text_bytes * chunk.num_values + 1_000_000
            if chunk.path_in_schema in texts and size > most:
                return f"{size} bytes of texts in {_column_of(chunk.path_in_schema)}, {most} at most"
    return None


def _unpacked_fault(path: Path, about: "pq.FileMetaData", *, is_whole: bool) -> str | None:
    """Describe texts that become too large when each of their rows gets its own, or return None."""
    # The footer does not tell. Columns that could are read as dictionaries first, which hold each distinct text once.
    groups = range(about.num_row_groups)
    for together in (groups,) if is_whole else ((at,) for at in groups):
        total = 0
        for at, names in _doubtful(about, together):
            for size, longest in _texts_of(path, at, names):
                total += size
                if longest > MOST_TEXT_BYTES:
                    return f"a text of {longest} bytes, {MOST_TEXT_BYTES} at most"
                if total > _MOST_UNPACKED:
                    return f"texts of more than {_MOST_UNPACKED} bytes unpacked"
    return None


def _doubtful(about: "pq.FileMetaData", groups: Iterable[int]) -> Iterator[tuple[int, list[str]]]:
    """Yield row groups, and their columns of texts that may be too large, together or one text of them."""
    chunks = [(at, about.row_group(at).column(column)) for at in groups for column in range(about.num_columns)]
    texts = [(at, chunk) for at, chunk in chunks if chunk.physical_type == "BYTE_ARRAY"]
    most: dict[tuple[int, str], int] = {
        (at, chunk.path_in_schema): chunk.num_values * chunk.total_uncompressed_size for at, chunk in texts
    }
    sure = 0
    for key in sorted(most, key=most.__getitem__):
        sure += most[key]
        if sure > _MOST_UNPACKED // 2:
            break
        most[key] = 0
    long = {(at, chunk.path_in_schema) for at, chunk in texts if chunk.total_uncompressed_size > MOST_TEXT_BYTES}
    for at in groups:
        names = [name for (group, name), size in most.items() if group == at and (size or (group, name) in long)]
        if names:
            yield at, names


def _texts_of(path: Path, group: int, columns: Sequence[str]) -> Iterator[tuple[int, int]]:
    """Yield the bytes of some texts of a row group, all of them and the longest one, without unpacking them."""
    if not columns:
        return
    import pyarrow.compute as pc  # noqa: PLC0415
    import pyarrow.parquet as pq  # noqa: PLC0415

    with pq.ParquetFile(plain_file(path), **VERIFIED, read_dictionary=list(columns)) as source:
        for name in columns:
            for batch in source.iter_batches(_TEXTS_AT_ONCE, row_groups=[group], columns=[name]):
                for texts in (found for column in batch.columns for found in _dictionaries(column)):
                    lengths = pc.binary_length(texts.dictionary)
                    if len(lengths) and len(texts):
                        yield pc.sum(lengths.take(texts.indices)).as_py() or 0, pc.max(lengths).as_py() or 0


def _dictionaries(array: pa.Array) -> Iterator[pa.DictionaryArray]:
    """Yield the dictionaries in a column, however deep in lists and records they lie."""
    if isinstance(array, pa.DictionaryArray):
        yield array
    elif isinstance(array, pa.MapArray):
        yield from (found for part in (array.keys, array.items) for found in _dictionaries(part))
    elif isinstance(array, pa.StructArray):
        yield from (found for part in array.flatten() for found in _dictionaries(part))
    elif isinstance(array, pa.ListArray | pa.LargeListArray | pa.FixedSizeListArray):
        yield from _dictionaries(array.flatten())


def size_fault(about: "pq.FileMetaData", *, most_rows: int, is_whole: bool = True) -> str | None:
    """Describe what is too large about a table, by its footer, or return None."""
    groups = [about.row_group(at) for at in range(about.num_row_groups)]
    chunks = [[group.column(at) for at in range(about.num_columns)] for group in groups]
    rows = max(about.num_rows, sum(group.num_rows for group in groups))
    values = sum(chunk.num_values for columns in chunks for chunk in columns)
    sizes = [sum(map(_size_of, columns, map(about.schema.column, range(about.num_columns)))) for columns in chunks]
    unpacked = sum(sizes) if is_whole else max(sizes, default=0)
    found = {"rows": (rows, most_rows), "values": (values, MOST_VALUES), "bytes unpacked": (unpacked, _MOST_UNPACKED)}
    return next((f"{count} {what}, {most} at most" for what, (count, most) in found.items() if count > most), None)


def _size_of(chunk: "pq.ColumnChunkMetaData", leaf: "pq.ColumnSchema") -> int:
    """Return the bytes of a part of a column, also where a value of fixed length stands in the file but once."""
    fixed = chunk.num_values * leaf.length if chunk.physical_type == "FIXED_LEN_BYTE_ARRAY" else 0
    return max(int(chunk.total_uncompressed_size), int(fixed))


def _read_footer(file: BinaryIO) -> bytes:
    """Read footer and tail of a file; all of a file shorter than it claims."""
    size = file.seek(0, os.SEEK_END)
    file.seek(max(size - _TAIL_BYTES, 0))
    length = int.from_bytes(file.read(4), "little") + _TAIL_BYTES
    file.seek(max(size - length, 0))
    return file.read()


def _crc_of(footer: bytes, at: int) -> bytes:
    plain = footer[:at] + b"0" * _DIGITS + footer[at + _DIGITS :]
    return f"{zlib.crc32(plain):0{_DIGITS}x}".encode()
