# SPDX-License-Identifier: Apache-2.0
"""Answers that are packed beside a pipeline file are laid down once, whole, marked, and replace nothing."""

import hashlib
import io
import lzma
import tarfile
from pathlib import Path

import pytest

from sasgeo_bench.boards.pipeline_spec import ArchiveSpec, PipelineFile
from sasgeo_bench.core.errors import StoreError
from sasgeo_bench.core.progress import reporting
from sasgeo_bench.experiments import head_start
from sasgeo_bench.experiments.head_start import unpack_head_start
from sasgeo_bench.running.prediction_files import RunManifest

RUN = "runs/random/abc/clean/one"
PART = f"{RUN}/part-{1:020d}-7.parquet"
PACKED = {f"{RUN}/run.json": b"{}", PART: b"answers", "runs/sasgeo/abc/clean/one/run.json": b'{"hash": "abc"}'}


def entry(name: str, content: bytes = b"", **more: object) -> tuple[tarfile.TarInfo, bytes]:
    found = tarfile.TarInfo(name)
    found.size = len(content)
    for key, value in more.items():
        setattr(found, key, value)
    return found, content


def packed(folder: Path, entries: list[tuple[tarfile.TarInfo, bytes]]) -> Path:
    with tarfile.open(folder / "mine.tar.xz", "w:xz") as archive:
        for about, content in entries:
            archive.addfile(about, io.BytesIO(content))
    return folder / "mine.toml"


def whole(folder: Path, files: dict[str, bytes] = PACKED) -> Path:
    return packed(folder, [entry(name, content) for name, content in files.items()])


def unpack(file: Path) -> None:
    """Unpack into `out` beside the file what it states rightly."""
    data = file.with_name("mine.tar.xz").read_bytes()
    unpack_head_start(file, ArchiveSpec(sha256=hashlib.sha256(data).hexdigest()), file.parent / "out")


def found(out: Path) -> dict[str, bytes]:
    return {path.relative_to(out).as_posix(): path.read_bytes() for path in out.rglob("*") if path.is_file()}


def test_all_is_laid_down_whole_marked_for_good_and_told_once(tmp_path):
    lines: list[str] = []
    with reporting(lines.append):
        unpack(whole(tmp_path))
        unpack(whole(tmp_path))
    laid = found(tmp_path / "out")
    assert {name: content for name, content in laid.items() if not name.endswith("packed.json")} == PACKED
    assert sum(name.endswith("packed.json") for name in laid) == 2
    (line,) = lines
    assert line.startswith("answers to 2 tasks came packed in mine.tar.xz")
    folder = tmp_path / "out" / RUN
    assert RunManifest.open(folder) == RunManifest(packed=True)
    RunManifest(hash="abc").save(folder)  # as when more is asked
    assert RunManifest.open(folder) == RunManifest(hash="abc", packed=True)


def test_what_was_there_stays_unmarked_and_is_not_mixed_with_what_is_packed(tmp_path):
    own = tmp_path / "out" / RUN
    own.mkdir(parents=True)
    (own / "run.json").write_bytes(b'{"own": 1}')
    unpack(whole(tmp_path))
    assert found(own) == {"run.json": b'{"own": 1}'}
    assert RunManifest.open(own) == RunManifest(own=1)


def test_without_a_stated_hash_nothing_is_unpacked_and_a_line_says_so(tmp_path):
    lines: list[str] = []
    with reporting(lines.append):
        unpack_head_start(whole(tmp_path), None, tmp_path / "out")
    (tmp_path / "mine.tar.xz").unlink()
    with reporting(pytest.fail):
        unpack_head_start(tmp_path / "mine.toml", None, tmp_path / "out")
    with reporting(lines.append):
        unpack_head_start(tmp_path / "mine.toml", ArchiveSpec(sha256="0" * 64), tmp_path / "out")
    assert not (tmp_path / "out").exists()
    assert "mine.tar.xz is left packed, for mine.toml does not state its SHA-256" in lines[0]
    assert "states an archive, and there is none" in lines[1]


def test_another_archive_than_the_stated_one_is_refused(tmp_path):
    with pytest.raises(StoreError, match=r"mine\.tar\.xz is not the archive that mine\.toml states \(its SHA-256 is"):
        unpack_head_start(whole(tmp_path), ArchiveSpec(sha256="0" * 64), tmp_path / "out")
    assert not (tmp_path / "out").exists()


LINK = {"type": tarfile.SYMTYPE, "linkname": "/etc/passwd"}


@pytest.mark.parametrize(
    "strange",
    [
        entry("readme.txt"),
        entry("regions/vaduz/region.json", b"{}"),
        entry("tasks/clean/vaduz/task.json", b"{}"),
        entry("truth/clean/vaduz/truths.parquet"),
        entry("segmenters/forest-abc/text.txt"),
        entry("boards/demo/board.json"),
        entry("runs/random/abc/learned/text.txt"),
        entry("runs/random/abc/clean/one/packed.json", b"{}"),
        entry("runs/random/abc/clean/one/.hidden"),
        entry("runs/random/abc/clean/one/deep/run.json", b"{}"),
        entry("runs/run.json", b"{}"),
        entry("../runs/random/abc/clean/one/run.json"),
        entry("/runs/random/abc/clean/one/run.json"),
        entry("runs/../../../../lost/run.json"),
        entry("runs/random/abc/clean/..", type=tarfile.DIRTYPE),
        entry(PART, **LINK),
        entry(PART, type=tarfile.LNKTYPE, linkname=f"{RUN}/run.json"),
        entry(PART, type=tarfile.FIFOTYPE),
        entry(PART, type=tarfile.CHRTYPE, devmajor=1, devminor=5),
        entry("runs/random", **LINK),
        entry(f"runs/random/abc/clean//one/{PART[-32:]}", b"again"),
        entry("runs/ra\nndom/abc/clean/one/run.json", b"{}"),
        entry("runs/random/abc/clean/one/run.json\u202e", b"{}"),
    ],
)
def test_what_is_no_answer_is_refused_in_one_line_before_anything_is_laid_down(tmp_path, strange):
    file = packed(tmp_path, [*(entry(*one) for one in PACKED.items()), strange])
    with pytest.raises(StoreError, match=r"mine\.tar\.xz holds .*: pack answers alone, the folder runs") as caught:
        unpack(file)
    assert "\n" not in str(caught.value)
    assert found(tmp_path / "out") == {}
    assert sorted(path.name for path in tmp_path.iterdir()) == ["mine.tar.xz", "out"]


def test_answers_without_a_sound_record_of_their_run_are_refused(tmp_path):
    for record in ({}, {f"{RUN}/run.json": b"["}, {f"{RUN}/run.json": b"[]"}, {f"{RUN}/run.json": b"[" * 10**5}):
        with pytest.raises(StoreError, match=rf"no sound run\.json in {RUN}: pack each run with its record"):
            unpack(whole(tmp_path, {PART: b"answers", **record}))
    assert found(tmp_path / "out") == {}


def test_what_is_too_much_is_refused_before_it_is_unpacked(tmp_path, monkeypatch):
    many = [entry(f"runs/a/b/c/d{at}", type=tarfile.DIRTYPE) for at in range(30)]
    monkeypatch.setattr(head_start, "MOST_FILES", 20)
    with pytest.raises(StoreError, match="holds more than 20 files and folders"):
        unpack(packed(tmp_path, many))
    monkeypatch.setattr(head_start, "MOST_BYTES", 10**6)
    with pytest.raises(StoreError, match="it holds more than 1000000 bytes"):
        unpack(whole(tmp_path, {**PACKED, PART: bytes(2 * 10**7)}))
    long = lzma.compress(bytes(10**7))  # behind the end of the archive
    archive = whole(tmp_path).with_name("mine.tar.xz")
    archive.write_bytes(lzma.compress(lzma.decompress(archive.read_bytes()) + lzma.decompress(long)))
    with pytest.raises(StoreError, match="it holds more than 1000000 bytes"):
        unpack(tmp_path / "mine.toml")
    monkeypatch.setattr(head_start, "MOST_PACKED", 100)
    with pytest.raises(StoreError, match="is larger than 100 bytes"):
        unpack(tmp_path / "mine.toml")
    assert found(tmp_path / "out") == {}


def pax_bomb() -> bytes:
    """A header that says that ten gigabytes of further headers follow."""
    header = tarfile.TarInfo("runs")
    header.type, header.size = tarfile.XHDTYPE, 10**10
    return lzma.compress(header.tobuf(tarfile.GNU_FORMAT) + bytes(1024))


@pytest.mark.parametrize("fault", ["cut", "no archive", "too long", "needs much", "claims much"])
def test_a_damaged_archive_costs_one_line_and_leaves_nothing(tmp_path, fault, monkeypatch):
    archive = whole(tmp_path).with_name("mine.tar.xz")
    data = archive.read_bytes()
    if fault == "needs much":
        monkeypatch.setattr(head_start, "MOST_MEMORY", 10_000)
    archive.write_bytes(
        {
            "cut": data[:150],
            "no archive": b"nothing of the kind",
            "too long": lzma.compress(lzma.decompress(data)[:700]),
            "needs much": data,
            "claims much": pax_bomb(),
        }[fault]
    )
    with pytest.raises(StoreError, match=r"mine\.tar\.xz is damaged \(.+\): pack it again, or take it away") as caught:
        unpack(tmp_path / "mine.toml")
    assert "\n" not in str(caught.value)
    assert found(tmp_path / "out") == {}


@pytest.mark.parametrize("blocked", ["out", "out/runs", "out/runs/random/abc"])
def test_where_one_thing_cannot_be_laid_down_none_is_and_the_line_names_the_folder(tmp_path, blocked):
    (tmp_path / blocked).parent.mkdir(parents=True, exist_ok=True)
    (tmp_path / blocked).write_bytes(b"in the way")
    with pytest.raises(StoreError, match="out") as caught:
        unpack(whole(tmp_path))
    assert blocked in str(caught.value)
    assert "archive" not in str(caught.value)
    assert [path.read_bytes() for path in (tmp_path / "out").rglob("*") if path.is_file()] in ([], [b"in the way"])


def test_what_a_killed_run_left_is_removed_and_a_folder_of_that_name_is_named(tmp_path):
    left = tmp_path / "out/.head-start-killed/runs"
    left.mkdir(parents=True)
    unpack(whole(tmp_path))
    assert PART in found(tmp_path / "out")
    assert not left.exists()
    (tmp_path / "mine.tar.xz").unlink()
    (tmp_path / "mine.tar.xz").mkdir()
    with pytest.raises(StoreError, match=r"mine\.tar\.xz is no file"):
        unpack_head_start(tmp_path / "mine.toml", None, tmp_path / "out")


def test_the_hash_of_an_archive_is_no_part_of_the_experiment_and_must_be_one():
    spec = {"id": "mine", "title": "Mine", "split": "crossfit", "matchers": ["random"]}
    spec |= {"task": [{"suites": ["clean"], "sites": 2}]}
    stated = PipelineFile.model_validate(spec | {"archive": {"sha256": "ab" * 32}})
    assert stated.archive == ArchiveSpec(sha256="ab" * 32)
    assert stated.sha256 == PipelineFile.model_validate(spec).sha256
    for wrong in ("AB" * 32, "ab" * 31, ""):
        with pytest.raises(ValueError, match="sha256"):
            ArchiveSpec(sha256=wrong)
