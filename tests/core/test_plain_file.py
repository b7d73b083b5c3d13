# SPDX-License-Identifier: Apache-2.0
"""No reader waits for a pipe: whatever is opened to be read is looked at first."""

import ast
import os
import socket
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

import sasgeo_bench
from sasgeo_bench.boards.board_files import read_board_manifest
from sasgeo_bench.boards.pipeline_spec import ArchiveSpec
from sasgeo_bench.core.config import read_document
from sasgeo_bench.core.errors import SasgeoError
from sasgeo_bench.core.folders import sha256_of
from sasgeo_bench.core.json import read_json
from sasgeo_bench.core.parquet import read_table
from sasgeo_bench.core.paths import plain_file
from sasgeo_bench.experiments.head_start import unpack_head_start
from sasgeo_bench.flights.drift_profile import read_drift_profile
from sasgeo_bench.matching.cards import read_learned
from sasgeo_bench.regions.layers import read_bits, read_layers, read_overview
from sasgeo_bench.regions.region_spec import RegionFile
from sasgeo_bench.sensing.photos import read_photo

CODE = Path(sasgeo_bench.__file__).parent
READS = {"read_bytes", "read_text"}
OPENERS = {"rasterio.open", "Image.open", "tarfile.open", "gzip.open", "pq.ParquetFile", "np.load", "open_memmap"}
NAMES = {"open", *READS, *(name.rpartition(".")[2] for name in OPENERS)}
# Files of the kernel; and reads of what ships with the package, or what the same function has just written.
APART = {f"running/{name}.py" for name in ("kernel", "memory", "sandbox", "sensors")}
OWN = {
    ("core/config.py", "path.read_text"),  # which looks by itself: folders stand below it
    ("experiments/head_start.py", "tarfile.open"),  # of bytes
    ("flights/drift_profile.py", "file.read_text"),
    ("matching/follower.py", "Path(module).read_bytes"),
    ("core/plugins.py", "found.read_text"),  # of what is installed
    ("boards/site.py", "vendor.joinpath(name).read_text"),
    ("boards/site_files.py", "path.read_text"),
    ("regions/ortho.py", "rasterio.open"),  # a view of a file that is open, in memory
    ("core/plugins.py", "(_PACKAGE / '__init__.pyi').read_bytes"),
    ("running/training.py", "one.read_bytes"),
    ("sensing/image.py", "Image.open"),
    ("observing/masks.py", "np.load"),  # of bytes
    ("observing/posed_pictures.py", "Image.open"),  # as above
    ("observing/pictures.py", "rasterio.open"),  # a view of a file that is open, in memory
    ("observing/video.py", "path.read_bytes"),  # of what the same function has just written
    ("regions/packed_map.py", "tarfile.open"),  # of a plain file that is open
}


@pytest.fixture
def pipe(tmp_path: Path) -> Path:
    path = tmp_path / "pipe"
    os.mkfifo(path)
    return path


READERS: dict[str, Callable[[Path], object]] = {
    "a hash": sha256_of,
    "JSON": lambda path: read_json(path, mend="again"),
    "a table": lambda path: read_table(path, mend="again"),
    "layers": read_layers,
    "bits of layers": read_bits,
    "an overview": lambda path: read_overview(path, longest_cells=100),
    "a photo": read_photo,
    "a drift profile": read_drift_profile,
    "a learned text": read_learned,
}


@pytest.mark.parametrize("read", READERS.values(), ids=READERS)
def test_a_pipe_is_refused_not_waited_for(pipe: Path, read: Callable[[Path], object]) -> None:
    with pytest.raises((SasgeoError, OSError), match="it is a pipe"):
        read(pipe)


def test_a_pipe_in_place_of_a_file_of_a_folder_or_of_a_kind_is_refused(tmp_path, pipe) -> None:
    os.mkfifo(tmp_path / "board.json")
    with pytest.raises(SasgeoError, match="it is a pipe"):
        read_board_manifest(tmp_path)
    os.mkfifo(tmp_path / "mine.tar.xz")
    stated = ArchiveSpec(sha256="0" * 64)
    with pytest.raises(SasgeoError, match="mine"):
        unpack_head_start(tmp_path / "mine.toml", stated, tmp_path / "out")
    with pytest.raises(SasgeoError, match="it is no plain file"):
        read_document(pipe, RegionFile, "regions")


def test_links_are_followed_and_sockets_and_devices_refused(tmp_path: Path, pipe: Path) -> None:
    (tmp_path / "link").symlink_to(pipe)
    with socket.socket(socket.AF_UNIX) as server:
        server.bind(os.path.relpath(tmp_path / "socket"))  # an absolute path may be too long for one
        for path, words in (
            (tmp_path / "link", "a pipe"),
            (tmp_path / "socket", "a socket"),
            (Path("/dev/zero"), "dev"),
        ):
            with pytest.raises(OSError, match=f"it is {words}|it is a {words}"):
                plain_file(path)
    for path in (tmp_path, tmp_path / "none", CODE / "core" / "errors.py", Path("a" * 5000), Path("\0")):
        assert plain_file(path) == path  # of these, the opening itself speaks


@pytest.mark.parametrize("name", ["JSON", "a learned text", "a board", "TOML"])
def test_a_file_that_nobody_has_written_by_hand_is_refused(tmp_path: Path, name: str) -> None:
    path = tmp_path / "board.json"
    with path.open("wb") as file:
        file.truncate(6 * 10**7)
    others: dict[str, Callable[[Path], object]] = {
        "a board": lambda path: read_board_manifest(path.parent),
        "TOML": lambda path: read_document(path, RegionFile, "regions"),
    }
    read = {**READERS, **others}[name]
    with pytest.raises(SasgeoError, match=r"it has more than \d+ bytes"):
        read(path)


def unguarded(path: Path) -> Iterator[str]:
    """Reads of a file that do not go through `plain_file`, as `file:line: code`."""
    file = path.relative_to(CODE).as_posix()
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if not isinstance(node, ast.Call) or not isinstance(node.func, ast.Attribute) or node.func.attr not in NAMES:
            continue
        called, text = ast.unparse(node.func), ast.unparse(node)
        modes = {item.value for item in node.args if isinstance(item, ast.Constant)}
        is_read = node.func.attr in READS or (node.func.attr == "open" and "rb" in modes) or called in OPENERS
        is_checked = "plain_file(" in text or "resources.files(" in text or (file, called) in OWN
        if is_read and not is_checked and "w" not in modes:
            yield f"{file}:{node.lineno}: {text[:80]}"


def test_every_reader_looks_first() -> None:
    files = [path for path in sorted(CODE.rglob("*.py")) if path.relative_to(CODE).as_posix() not in APART]
    assert [line for path in files for line in unguarded(path)] == []
