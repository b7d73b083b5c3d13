# SPDX-License-Identifier: Apache-2.0
"""Tables with checksums: no flipped bit changes a value unnoticed, and none is read that is larger than it may be."""

import re
from pathlib import Path

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from sasgeo_bench.core import parquet
from sasgeo_bench.core.errors import StoreError
from sasgeo_bench.core.parquet import read_frame, read_schema, read_table, write_frame, write_table
from sasgeo_bench.running.prediction_files import PREDICTION_SCHEMA

PACKAGE = Path(parquet.__file__).parents[1]
MEND = "write it again"


def answers(count: int) -> pa.Table:
    """Rows with every kind of column that we write: texts, numbers, lists of structs, maps, and nulls."""
    rng = np.random.default_rng(0)
    pose = {"easting_m": 5e5, "northing_m": 5.2e6, "yaw_deg": 10.0, "scale": 1.0, "score": 0.5}
    rows = [
        {
            "query_id": f"query-{at}",
            "candidates": [pose | {"score": float(score)} for score in rng.random(3)],
            "confidence": float(rng.random()) if at % 3 else None,
            "diagnostics": [("margin", float(rng.random()))],
            "status": "ok",
            "message": "",
            "latency_s": float(rng.random()),
        }
        for at in range(count)
    ]
    return pa.Table.from_pylist(rows, schema=PREDICTION_SCHEMA)


def flipped(data: bytes, bit: int) -> bytes:
    changed = bytearray(data)
    changed[bit // 8] ^= 1 << bit % 8
    return bytes(changed)


def some_bits(path: Path, count: int, begin: int = 0) -> list[int]:
    return np.random.default_rng(0).integers(8 * begin, 8 * path.stat().st_size, count).tolist()


def changes_accepted(path: Path, bits: list[int]) -> list[int]:
    """Those flipped bits after which a file is read, and says something else."""
    data, before = path.read_bytes(), read_table(path, mend=MEND)
    other, found = path.with_name("flipped.parquet"), []
    for bit in bits:
        other.write_bytes(flipped(data, bit))
        try:
            after = read_table(other, mend=MEND)
        except StoreError as error:
            assert len(str(error).splitlines()) == 1  # noqa: PT017
            continue
        if not (after.equals(before) and after.schema.equals(before.schema)):
            found.append(bit)
    return found


def test_no_flipped_bit_of_a_table_of_ours_changes_a_value_unnoticed_and_without_checksums_many_do(tmp_path) -> None:
    path = tmp_path / "part.parquet"
    write_table(answers(20), path)
    assert changes_accepted(path, some_bits(path, 400)) == []
    path = tmp_path / "part.parquet"
    pq.write_table(answers(20), path, compression="zstd")
    assert changes_accepted(path, some_bits(path, 50))


def test_no_flipped_bit_of_a_footer_of_ours_is_accepted_but_in_the_name_of_its_checksum(tmp_path: Path) -> None:
    path = tmp_path / "part.parquet"
    write_table(answers(2), path)
    data = path.read_bytes()
    begin = len(data) - 8 - int.from_bytes(data[-8:-4], "little")
    accepted = []
    for at in some_bits(path, 300, begin):
        (tmp_path / "flipped.parquet").write_bytes(flipped(data, at))
        try:
            read_table(tmp_path / "flipped.parquet", mend=MEND)
        except StoreError:
            continue
        accepted.append(at // 8)
    name = data.rindex(b"sasgeo_footer_crc32")
    assert all(name <= at <= name + len(b"sasgeo_footer_crc32") + 1 for at in accepted)


def test_the_same_table_gives_the_same_bytes_and_what_was_read_is_written_with_a_checksum_of_its_own(tmp_path) -> None:
    for name in ("a", "b"):
        write_table(answers(3), tmp_path / name)
    assert (tmp_path / "a").read_bytes() == (tmp_path / "b").read_bytes()
    first, second = tmp_path / "a.parquet", tmp_path / "b.parquet"
    write_table(answers(3), first)
    write_table(read_table(first, mend=MEND), second)
    assert read_table(second, mend=MEND).equals(answers(3))
    assert changes_accepted(second, some_bits(second, 50)) == []


@pytest.mark.parametrize("codec", ["snappy", "none", "zstd", "gzip"])
def test_tables_of_others_without_checksums_are_read_as_they_are(codec: str, tmp_path: Path) -> None:
    path = tmp_path / "mine.parquet"
    frame = pd.DataFrame({"a": [1.5, None], "b": ["x", "y"]})
    frame.to_parquet(path, compression=codec)
    pd.testing.assert_frame_equal(read_frame(path, mend=MEND), frame)


def test_others_read_our_tables(tmp_path: Path) -> None:
    path = tmp_path / "ours.parquet"
    frame = pd.DataFrame({"a": [1.5, 2.5]})
    write_frame(frame, path, attrs={"place": "toytown"}, made_by="us")
    found = pd.read_parquet(path, page_checksum_verification=True)
    pd.testing.assert_frame_equal(found, frame)
    assert found.attrs == {"place": "toytown"} == read_frame(path, mend=MEND).attrs
    assert read_schema(path, mend=MEND).metadata[b"made_by"] == b"us"


@pytest.mark.parametrize(
    ("table", "fault"),
    [
        (pa.table({"a": pa.nulls(1_000_001)}), "1000001 rows, 1000000 at most"),
        (pa.table({f"a{at}": pa.nulls(1_000_000) for at in range(101)}), "101000000 values, 100000000 at most"),
    ],
)
def test_a_table_that_is_too_large_is_refused_before_it_is_read(table: pa.Table, fault: str, tmp_path: Path) -> None:
    path = tmp_path / "many.parquet"
    pq.write_table(table, path, compression="zstd")
    before = pa.total_allocated_bytes()
    with pytest.raises(StoreError, match=f"holds {fault}: write it again"):
        read_table(path, mend=MEND)
    assert pa.total_allocated_bytes() - before < 10_000_000


@pytest.mark.parametrize("kept", [slice(-1), slice(0), slice(4), slice(4, None)])
def test_a_file_that_is_no_table_is_refused_in_one_line(kept: slice, tmp_path: Path) -> None:
    path = tmp_path / "part.parquet"
    write_table(answers(2), path)
    path.write_bytes(path.read_bytes()[kept])
    with pytest.raises(StoreError, match=r"part\.parquet cannot be read \(.*\): write it again") as caught:
        read_table(path, mend=MEND)
    assert len(str(caught.value).splitlines()) == 1


def test_no_other_file_of_the_package_writes_or_reads_parquet() -> None:
    calls = re.compile(r"pyarrow\.parquet|\.to_parquet\(|\.read_parquet\(")
    geometry = ("**geographic)", "**VERIFIED)")  # geopandas has functions of its own
    found = [
        f"{path.relative_to(PACKAGE)}: {line.strip()}"
        for path in sorted(PACKAGE.rglob("*.py"))
        for line in path.read_text(encoding="utf-8").splitlines()
        if path.name not in ("parquet.py", "release_metadata.py") and calls.search(line) and not line.endswith(geometry)
    ]
    assert found == []


LONG = "x" * 10_000
BOMBS = {
    "texts": lambda: pa.array([LONG] * 1000),
    "bytes": lambda: pa.array([LONG.encode()] * 1000),
    "large texts": lambda: pa.array([LONG] * 1000, pa.large_string()),
    "in lists": lambda: pa.array([[LONG] * 10] * 100),
    "in lists of lists": lambda: pa.array([[[LONG] * 10] * 10] * 10),
    "in records": lambda: pa.array([{"a": 1, "b": LONG}] * 1000),
    "names in maps": lambda: pa.array([[(LONG, 1.0)]] * 1000, pa.map_(pa.string(), pa.float64())),
    "values in maps": lambda: pa.array([[("a", LONG)]] * 1000, pa.map_(pa.string(), pa.string())),
    "of fixed length": lambda: pa.array([LONG.encode()] * 1000, pa.binary(10_000)),
    "behind others": lambda: pa.array([*("y" * 10 for _ in range(1000)), *([LONG] * 1000), None]),
}


@pytest.mark.parametrize("kind", BOMBS)
@pytest.mark.parametrize("rows", [7, None], ids=["in groups", "at once"])
def test_one_long_text_in_many_rows_is_refused_before_it_is_unpacked(kind, rows, tmp_path, monkeypatch):
    monkeypatch.setattr(parquet, "_MOST_UNPACKED", 10**6)
    path, texts = tmp_path / "a.parquet", BOMBS[kind]()
    pq.write_table(pa.table({"n": range(len(texts)), "a": texts}), path, row_group_size=rows)
    assert path.stat().st_size < 10**6
    with pytest.raises(StoreError, match="bytes unpacked") as caught:
        read_table(path, mend=MEND)
    assert str(caught.value).endswith(MEND)
    fewer = tmp_path / "b.parquet"
    pq.write_table(pa.table({"a": texts[:1]}), fewer, row_group_size=rows)
    assert read_table(fewer, mend=MEND)["a"].to_pylist() == texts[:1].to_pylist()


def test_no_text_is_longer_than_a_bound(tmp_path, monkeypatch):
    monkeypatch.setattr(parquet, "MOST_TEXT_BYTES", 9_999)
    write_table(pa.table({"a": ["short", LONG]}), tmp_path / "a.parquet")
    with pytest.raises(StoreError, match="holds a text of 10000 bytes, 9999 at most: write it again"):
        read_table(tmp_path / "a.parquet", mend=MEND)
