# SPDX-License-Identifier: Apache-2.0
"""The content of a site as values, read from a board's folder, and the folder of the site, written all or nothing."""

import difflib
import gzip
import html
import re
import zlib
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import AbstractContextManager, contextmanager, nullcontext
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final, Self
from xml.etree import ElementTree as ET

import pandas as pd
import pyarrow as pa

from sasgeo_bench.ageing.ratebook import RateBook
from sasgeo_bench.boards.archive_file import is_pack, read_pack
from sasgeo_bench.boards.board import Board
from sasgeo_bench.boards.board_files import (
    ACCEPTANCE,
    ANSWERS,
    BOARD,
    FIGURES,
    LEADERBOARD,
    PROTECTION,
    REQUIREMENTS,
    SCORES,
)
from sasgeo_bench.boards.manifests import PackManifest, PicturesManifest, parse_record
from sasgeo_bench.core.errors import SasgeoError, StoreError
from sasgeo_bench.core.folders import IMAGES, SITE_FOLDERS, check_site, fresh_folder, list_files, locked
from sasgeo_bench.core.folders import SITE_MANIFEST as MANIFEST
from sasgeo_bench.core.paths import plain_file
from sasgeo_bench.core.texts import json_text, one_line
from sasgeo_bench.regions.region import LICENCE
from sasgeo_bench.scoring.contrasts import Contrast

MAPS: Final = "maps"
_MOST_POINTS: Final = 100_000.0  # of a figure, either way
_TITLE: Final = re.compile(r"<dc:title>(.*?)</dc:title>", re.DOTALL)
_WIDTH: Final = re.compile(r'<svg[^>]*?\swidth="([\d.]+)(?:pt|px)?"', re.DOTALL)
_HEIGHT: Final = re.compile(r'<svg[^>]*?\sheight="([\d.]+)(?:pt|px)?"', re.DOTALL)


@dataclass(frozen=True, slots=True, kw_only=True)
class SiteFigure:
    """A figure: name of its file, text of the SVG, title, and width and height in points."""

    file: str
    text: str
    title: str
    width: float
    height: float

    @classmethod
    def of(cls, file: str, text: str) -> Self:
        """Read title and size of an SVG; one without a title has the name of its file.

        >>> figure = SiteFigure.of("own.svg", '<svg width="90pt" height="45pt"><dc:title>A &amp; B</dc:title></svg>')
        >>> figure.title, figure.width, figure.height
        ('A & B', 90.0, 45.0)
        """
        title, *sizes = (pattern.search(text) for pattern in (_TITLE, _WIDTH, _HEIGHT))
        found = (float(size[1]) if size else 0.0 for size in sizes)
        width, height = (size if 0 < size < _MOST_POINTS else 480.0 for size in found)
        shown = html.unescape(title[1]).strip() if title else Path(file).stem
        return cls(file=file, text=text, title=" ".join(shown.split()), width=width, height=height)


@dataclass(frozen=True, slots=True, kw_only=True)
class Spot:
    """Place of a region, from its shipped file, or as it was built."""

    region: str
    title: str
    longitude_deg: float
    latitude_deg: float
    scenes: tuple[str, ...]
    is_made_up: bool = False


@dataclass(frozen=True, slots=True, kw_only=True)
class Download:
    """A file that the site offers: name, bytes as downloaded, and a description."""

    file: str
    data: bytes
    what: str


@dataclass(frozen=True, kw_only=True)
class SiteSource:
    """Content of all pages of a site.

    `title` is that of the board's pipeline where it is known. `reasons` states why
    each contrast was registered. `spots` are positions of regions, as far as they are known; `parts` holds place, and
    half or part of the split, of each region; `rates` is measured ageing. `scenes` is success by kind of place
    (`tables.scene_frame`). `times_figure` is of the first page: accuracy against time.
    """

    name: str
    title: str
    board: Board
    rates: RateBook
    scenes: pd.DataFrame = field(default_factory=pd.DataFrame)
    registered: tuple[Contrast, ...] = ()
    reasons: Mapping[str, str] = field(default_factory=dict)
    figures: tuple[SiteFigure, ...] = ()
    downloads: tuple[Download, ...] = ()
    pictures: PicturesManifest = field(default_factory=PicturesManifest)
    spots: Mapping[str, Spot] = field(default_factory=dict)
    parts: Mapping[str, tuple[str, str]] = field(default_factory=dict)
    rates_figure: SiteFigure | None = None
    map_figure: SiteFigure | None = None
    times_figure: SiteFigure | None = None


_NAMED: Final = 5  # boards that an error lists
_TAGS: Final = frozenset(  # of SVG: what shapes and texts are made of
    {
        *("svg", "g", "defs", "title", "desc", "metadata", "style", "path", "use", "rect", "circle", "ellipse", "line"),
        *("polyline", "polygon", "text", "tspan", "image", "symbol", "marker", "clipPath", "mask", "pattern"),
        *("linearGradient", "radialGradient", "stop"),
    }
)
_SVG: Final = "{http://www.w3.org/2000/svg}"
_INERT: Final = f"{_SVG}metadata"  # attribution in other vocabularies; its links are not followed
_ENTITY: Final = re.compile(
    r"<!(ENTITY|ATTLIST|ELEMENT)|<!DOCTYPE[^>]*\[|<\?xml-stylesheet|<\?xml[^>]*encoding\s*=\s*(?![\"']utf-8[\"'])",
    re.IGNORECASE,
)
_ACTS: Final = re.compile(r"javascript:|@import|expression\(|url\(\s*['\"]?(?!#)", re.IGNORECASE)
_WITHIN: Final = re.compile(r"#|data:image/(png|jpeg|webp);base64,")


def svg_fault(text: str) -> str | None:
    """Return what an SVG holds that a figure does not need: scripts, event handlers, links; None if nothing.

    Raise `ValueError` if it is no XML.

    >>> svg_fault('<svg xmlns="http://www.w3.org/2000/svg" onload="alert(1)"/>')
    'an attribute onload'
    """
    found = _ENTITY.search(text)
    if found:
        return f"a declaration {found[0]!r}"
    try:
        root = ET.fromstring(text)  # noqa: S314 - what could grow without end is refused above
    except ET.ParseError as error:
        raise ValueError(f"it is no XML: {error}") from error
    inert = {id(item) for metadata in root.iter(_INERT) for item in metadata.iter()}
    drawn = (item for item in root.iter() if id(item) not in inert or item.tag == _INERT)
    return next((fault for item in drawn if (fault := _fault_of(item))), None)


def _fault_of(item: ET.Element) -> str | None:
    if not isinstance(item.tag, str) or not item.tag.startswith(_SVG) or item.tag.removeprefix(_SVG) not in _TAGS:
        return f"an element {str(item.tag).removeprefix(_SVG)[:60]!r}"
    for name, value in item.attrib.items():
        short = name.rpartition("}")[2].lower()
        if short.startswith("on"):
            return f"an attribute {short[:60]}"
        if (short in {"href", "src", "base"} and not _WITHIN.match(value.strip())) or _ACTS.search(value):
            return f"a link {value[:60]!r}"
    if item.tag == f"{_SVG}style" and (found := _ACTS.search(item.text or "")):
        return f"a style with {found[0]!r}"
    return None


PICTURES: Final = "pictures"
FILES: Final = "files"
MOST_BYTES: Final = 3_000_000  # of the pages of a site with their figures; a larger one is reported
_OFFERED: Final = {  # files for download, with descriptions
    f"{LEADERBOARD}.parquet": "the master: every figure with its interval, ranks, n, blocks and places",
    f"{LEADERBOARD}.csv": "the same for a spreadsheet",
    f"{LEADERBOARD}.tex": "tables for a paper",
    f"{LEADERBOARD}.md": "tables as text",
    "contrasts.parquet": "registered contrasts",
    "falsifiers.parquet": "the same two methods where they should not differ",
    "controls.parquet": "controls of every matcher",
    f"{ACCEPTANCE}.parquet": "risk and coverage by cost, share and kind of absent places",
    f"{PROTECTION}.parquet": "protection levels, counted",
    f"{REQUIREMENTS}.parquet": "verdict, figure and interval of each requirement",
    "paper.md": "the paper's experiment next to its Table II",
    "paper.parquet": "the same as a table",
    f"{SCORES}.parquet": "a row for each query of each matcher",
    f"{ANSWERS}.parquet": "true place and fix of each query of each matcher, and the class of its failure",
    BOARD: "versions, hashes and cards",
}
_LARGE_BYTES: Final = 500_000  # text beyond is offered as .gz
_LEFT_OUT_BYTES: Final = 1_500_000  # larger files, packed, stay with the board
_MOST_UNPACKED: Final = 50_000_000  # bytes of a .gz; none of our texts is larger


@dataclass(frozen=True, kw_only=True)
class BoardFiles:
    """Files of a board's folder that a site shows.

    `settings` are those of stored results, None for a board that is not stored.
    """

    board: Board
    figures: tuple[SiteFigure, ...]
    downloads: tuple[Download, ...]
    pictures: PicturesManifest
    settings: PackManifest | None


def read_board_files(folder: Path) -> BoardFiles:
    """Read a board, or stored results, for its site.

    Raise `StoreError` if there is no board, or a file of it is damaged, a link, or a figure that does more than draw.
    """
    with _sound(folder):
        list_files(folder, without=SITE_FOLDERS)
        return BoardFiles(
            board=Board.open(folder),
            figures=tuple(_read_figures(folder / FIGURES)),
            downloads=tuple(_read_downloads(folder)),
            pictures=_read_pictures(folder / PICTURES),
            settings=read_pack(folder) if is_pack(folder) else None,
        )


@contextmanager
def _sound(folder: Path) -> Iterator[None]:
    try:
        yield
    except SasgeoError:
        raise
    except (
        *(OSError, ValueError, TypeError, KeyError, AttributeError, EOFError, pa.ArrowException),
        *(zlib.error, RecursionError, MemoryError),
    ) as error:
        text = one_line(str(error))
        raise StoreError(
            f"{folder} holds a damaged board ({text}): score it again, or fetch the results again"
        ) from error


def _plain_or_packed(path: Path) -> bytes | None:
    """Return the bytes of a file, or of its .gz unpacked; None where there is neither."""
    packed = path.with_name(f"{path.name}.gz")
    if path.is_file():
        return plain_file(path).read_bytes()
    return _unpacked(packed) if packed.is_file() else None


def _unpacked(path: Path) -> bytes:
    """Unpack a .gz of limited size."""
    try:
        with gzip.open(plain_file(path)) as source:
            data = source.read(_MOST_UNPACKED + 1)
    except (OSError, EOFError, zlib.error) as error:
        raise ValueError(f"{path.name} cannot be unpacked: {error}") from error
    if len(data) > _MOST_UNPACKED:
        raise ValueError(f"{path.name} unpacks to more than {_MOST_UNPACKED / 1e6:g} MB")
    return data


def _read_figures(folder: Path) -> Iterator[SiteFigure]:
    """Read figures, refusing an SVG that does more than draw: pages link to it."""
    for name in sorted({path.name.removesuffix(".gz") for path in folder.glob("*.svg*")}):
        data = _plain_or_packed(folder / name) if name.endswith(".svg") else None
        if not data:
            continue
        try:
            text = data.decode()
            fault = svg_fault(text)
        except ValueError as error:
            raise ValueError(f"{name}: {error}") from error
        if fault is not None:
            raise StoreError(
                f"{folder / name} holds {fault}, as no figure of a board does: score it again, or remove the file"
            )
        yield SiteFigure.of(name, text)


def _read_downloads(folder: Path) -> Iterator[Download]:
    for name, what in _OFFERED.items():
        data = _plain_or_packed(folder / name)
        if data is None:
            continue
        is_packed = len(data) > _LARGE_BYTES and not name.endswith(".parquet")
        data = gzip.compress(data, mtime=0) if is_packed else data
        if len(data) <= _LEFT_OUT_BYTES:
            yield Download(file=f"{name}.gz" if is_packed else name, data=data, what=what)


def _read_pictures(folder: Path) -> PicturesManifest:
    """Read the list of pictures, and check each file against the folder; empty where there is none."""
    path = folder / f"{PICTURES}.json"
    if not path.is_file():
        return PicturesManifest()
    try:
        found = parse_record(plain_file(path).read_bytes(), PicturesManifest)
        for name in found.files:
            _check_picture(folder, name)
    except SasgeoError:
        raise
    except ValueError as error:
        text = one_line(str(error))
        raise StoreError(f"{path} is damaged ({text}): make the pictures again, or move the folder away") from error
    return found


def _check_picture(folder: Path, name: str) -> None:
    """Refuse a file that is no picture, is missing, or lies outside the folder."""
    path = folder / name
    is_inside = path.resolve().is_relative_to(folder.resolve()) and not Path(name).is_absolute()
    if not is_inside or path.suffix.lower() not in IMAGES or not path.is_file():
        raise StoreError(
            f"{folder / PICTURES}.json names {name!r}, which is no picture in {folder}: "
            "make the pictures again, or move the folder away"
        )


@dataclass(frozen=True, slots=True, kw_only=True)
class Written:
    """Result of writing a site: folder, bytes of pages and figures, of pictures and maps, of downloads; pages."""

    folder: Path
    site_bytes: int
    download_bytes: int
    picture_bytes: int
    pages: int

    def to_text(self) -> str:
        """Return folder and sizes in one line."""
        sizes = {"": self.site_bytes, " of pictures": self.picture_bytes, " of downloads": self.download_bytes}
        texts = [f"{size / 1e6:.2f} MB{what}" for what, size in sizes.items()]
        return f"{self.folder}: {self.pages} pages, {', '.join(texts)}"


@contextmanager
def held(folder: Path, target: Path, *, root: Path) -> Iterator[None]:
    """Lock a board against other writers while its site is made.

    Raise `StoreError` if there is no board, naming those in boards/ below `root`, or the target holds something that is
    no site.
    """
    if not (folder / BOARD).is_file():
        boards = {path.parent.name: path.parent for path in sorted((root / "boards").glob(f"*/{BOARD}"))}
        near = difflib.get_close_matches(folder.name, boards, n=1)
        some = ", ".join(map(str, list(boards.values())[:_NAMED])) or "out/boards/demo"
        hint = f"did you mean {boards[near[0]]}?" if near else f"name the folder of one, as {some}"
        raise StoreError(f"{folder} holds no board ({BOARD}): {hint}")
    check_target(target)
    with locked(folder):
        yield


def site_lock(folder: Path, target: Path) -> AbstractContextManager[None]:
    """Return the lock of a site, to be held while it is written: a board that is refused leaves no lock behind.

    A site in the board's own folder has none: its file would be foreign there, and the lock of the board suffices.
    """
    return nullcontext() if target.parent.resolve() == folder.resolve() else locked(target)


def check_target(target: Path) -> None:
    """Raise `StoreError` if a site cannot replace a folder: a file, no site, or one with foreign files."""
    if target.exists() and not target.is_dir():
        raise StoreError(f"{target} is a file: move it away, or name another folder")
    if target.is_dir() and any(target.iterdir()) and not (target / MANIFEST).is_file():
        raise StoreError(f"{target} holds something else than a site, which would be lost: name another folder")
    check_site(target)


def write_site(
    target: Path,
    files: BoardFiles,
    *,
    pages: Mapping[str, str],
    figures: Iterable[SiteFigure],
    name: str,
) -> Written:
    """Write a site, whole or not at all; an older one in the target folder is replaced.

    `pages` are the texts of pages, style and script by file name, `name` that of the board; downloads and pictures come
    from its files. Raise `StoreError` if the site cannot be written; an older site then stays as it was.
    """
    check_target(target)
    written: dict[str, bytes] = {file: text.encode() for file, text in pages.items()}
    written |= {f"{FIGURES}/{item.file}": item.text.encode() for item in figures}
    written |= {f"{FILES}/{item.file}": item.data for item in files.downloads}
    pictures = {
        f"{PICTURES}/{file}": files.board.folder / PICTURES / file for file in sorted(set(files.pictures.files))
    }
    content = {
        "board": name,
        "made_by": files.board.about.made_by,
        "licence": LICENCE,
        "attribution": files.board.about.credit,
        "files": sorted({*written, *pictures}),
    }
    written[MANIFEST] = json_text(content).encode()
    try:
        with fresh_folder(target) as scratch:
            for file, data in written.items():
                _put(scratch / file, data)
            for file, path in pictures.items():
                _put(scratch / file, plain_file(path).read_bytes())
        picture_bytes = sum(
            path.stat().st_size for kind in (PICTURES, MAPS) for path in (target / kind).rglob("*") if path.is_file()
        )
    except SasgeoError:  # an error with a cause of its own, though it may be an `OSError`
        raise
    except OSError as error:
        raise StoreError(
            f"{target} cannot be written ({error.strerror or error}): check the free space and your rights, and "
            "publish again; a site that was there is as it was"
        ) from error
    return Written(
        folder=target,
        site_bytes=sum(len(data) for file, data in written.items() if not file.startswith((f"{FILES}/", f"{MAPS}/"))),
        download_bytes=sum(len(item.data) for item in files.downloads),
        picture_bytes=picture_bytes,
        pages=sum(file.endswith(".html") for file in pages),
    )


def _put(path: Path, data: bytes) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(data)


def draw_text(draw: Callable[[Path], object], folder: Path) -> str:
    """Return the text of an SVG that a function draws into a path in a scratch folder."""
    path = folder / "drawn.svg"
    draw(path)
    return path.read_text(encoding="utf-8")
