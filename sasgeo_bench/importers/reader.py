# SPDX-License-Identifier: Apache-2.0
"""Read a dataset's folder of unknown origin: nothing is written, no link leads out, every name and size is bounded."""

import csv
import re
from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from sasgeo_bench.errors import DatasetError, counted
from sasgeo_bench.files.paths import plain_file
from sasgeo_bench.importers.items import MOST_ITEMS, Item, Role

IMAGES: Final = (".jpg", ".jpeg", ".png", ".tif", ".tiff", ".bmp", ".webp")
_MOST_BYTES: Final = 100_000_000  # of a table
_MOST_QUOTED: Final = 60  # characters
_NUMBER: Final = re.compile(r"[+-]?([0-9]+(\.[0-9]*)?|\.[0-9]+)([eE][+-]?[0-9]+)?")


class FolderReader:
    """A folder that is only read; `skipped` counts what was left out, by reason.

    `layout` says in a clause what the folder should hold; errors end with it.
    """

    def __init__(self, root: Path, *, layout: str) -> None:
        self.layout = layout
        self.skipped: Counter[str] = Counter()
        if not root.is_dir():
            raise DatasetError(f"there is no folder {root}: {layout}")
        self.root = root.resolve()
        if next(self.root.iterdir(), None) is None:
            raise DatasetError(f"{root} is empty: {layout}")

    def has(self, relative: str) -> bool:
        """Return whether the folder holds a file or folder of a relative path."""
        return (self.root / relative).exists()

    def folders(self, relative: str) -> list[str]:
        """Return the names of the folders in a folder, sorted; raise `DatasetError` if it is missing."""
        return [path.name for path in self._entries(relative) if path.is_dir()]

    def files(self, relative: str) -> list[str]:
        """Return the names of the files in a folder, sorted."""
        return [path.name for path in self._entries(relative) if path.is_file()]

    def images(self, relative: str) -> list[str]:
        """Return the names of the images in a folder, sorted; other files are counted in `skipped`.

        Raise `DatasetError` if the folder is missing, or an image is empty.
        """
        found = []
        for path in self._entries(relative):
            if not path.is_file():
                self.skipped["entry among images that is no file"] += 1
            elif path.suffix.lower() not in IMAGES:
                self.skipped["file that is no image by its name"] += 1
            elif path.stat().st_size == 0:
                raise DatasetError(f"{self._shown(relative, path.name)} is an empty file: copy it again")
            else:
                found.append(path.name)
        return found

    def file(self, relative: str) -> Path:
        """Return the path of a file; raise `DatasetError` if it is missing or leads out of the folder."""
        path = self.root / relative
        self._refuse_way_out(path, relative)
        if not path.is_file():
            raise self.missing(relative)
        return path

    def lines(self, relative: str) -> Iterator[tuple[int, str]]:
        """Yield number and text of each line of a text file that is not blank; the first line is number 1."""
        path = self.file(relative)
        if path.stat().st_size > _MOST_BYTES:
            raise DatasetError(
                f"{relative} has {path.stat().st_size} bytes, {_MOST_BYTES} at most: it is no table of this set"
            )
        try:
            text = plain_file(path).read_text(encoding="utf-8-sig")
        except UnicodeDecodeError as error:
            raise DatasetError(f"{relative} is no text in UTF-8 (byte {error.start}): copy it again") from error
        for number, line in enumerate(text.splitlines(), start=1):
            if line.strip():
                yield number, line

    def rows(self, relative: str, *, columns: tuple[str, ...]) -> Iterator["TableRow"]:
        """Yield the rows of a CSV file with a header; raise `DatasetError` if it lacks one of the columns."""
        found = self.lines(relative)
        head = [name.strip() for name in _split(next(found, (0, ""))[1], where=f"{relative} line 1")]
        lacking = [name for name in columns if name not in head]
        if lacking or len(set(head)) < len(head):
            shown = ", ".join(head)[:_MOST_QUOTED] or "nothing"
            fault = f"no column {lacking[0]!r}" if lacking else "two columns of one name"
            raise DatasetError(f"{relative} has {fault} (its first line: {shown}): expected {','.join(columns)}")
        for number, line in found:
            cells = _split(line, where=f"{relative} line {number}")
            if len(cells) != len(head):
                raise DatasetError(
                    f"{relative} line {number} has {counted(len(cells), 'cell')}, its first line {len(head)}"
                )
            cells = [cell.strip() for cell in cells]
            yield TableRow(where=f"{relative} line {number}", cells=dict(zip(head, cells, strict=True)))

    def missing(self, relative: str) -> DatasetError:
        """Return the error that names a missing file or folder."""
        return DatasetError(f"{self.root} holds no {relative}: {self.layout}")

    def notes(self) -> tuple[str, ...]:
        """Return a line for each reason for which something was left out."""
        return tuple(f"left out {count} x {reason}" for reason, count in sorted(self.skipped.items()))

    def _entries(self, relative: str) -> list[Path]:
        """Return what lies in a folder, sorted by name, without hidden files."""
        folder = self.root / relative
        self._refuse_way_out(folder, relative)
        if not folder.is_dir():
            raise self.missing(relative)
        found = sorted(path for path in folder.iterdir() if not path.name.startswith("."))
        for path in found:
            if not path.name.isprintable():
                raise DatasetError(f"{relative} holds a name that is no printable line, {path.name!a}: rename it")
            if path.is_symlink():
                self._refuse_way_out(path, self._shown(relative, path.name))
        return found

    def _refuse_way_out(self, path: Path, shown: str) -> None:
        try:
            is_inside = path.resolve().is_relative_to(self.root)
        except (OSError, RuntimeError):  # a circle of links
            is_inside = False
        if not is_inside:
            raise DatasetError(f"{shown} is a link that leads out of {self.root}: put the file itself there")

    @staticmethod
    def _shown(relative: str, name: str) -> str:
        return name if relative == "." else f"{relative}/{name}"


@dataclass(frozen=True, slots=True)
class TableRow:
    """One row of a table: its cells by column, and where it stands, for errors."""

    where: str
    cells: Mapping[str, str]

    def number(self, name: str) -> float:
        """Return a cell as a number; raise `DatasetError` if it is none."""
        return to_number(self.cells[name], where=f"{self.where}, {name}")


def to_number(text: str, *, where: str) -> float:
    """Return a decimal number; raise `DatasetError` for anything else, NaN and infinity too.

    >>> to_number("nan", where="01.csv line 3, lat")
    Traceback (most recent call last):
        ...
    sasgeo_bench.errors.DatasetError: 01.csv line 3, lat: expected a number, got 'nan'
    """
    value = float(text) if _NUMBER.fullmatch(text) else float("inf")
    if abs(value) == float("inf"):
        raise DatasetError(f"{where}: expected a number, got {text[:_MOST_QUOTED]!r}")
    return value


def _split(line: str, *, where: str) -> list[str]:
    try:
        return next(csv.reader([line]), [])
    except csv.Error as error:
        raise DatasetError(f"{where} is no row of a table ({error}): copy the file again") from error


@dataclass(frozen=True, slots=True, kw_only=True)
class LabelFolder:
    """A folder of folders, one for each label: its path, and what its items are."""

    relative: str
    role: Role
    view: str
    group: str | None = None
    height_m: float | None = None


def read_labels(reader: FolderReader, folder: LabelFolder, *, digits: int) -> list[Item]:
    """Read `<folder>/<label>/<image>`: an item for each image.

    Raise `DatasetError` if the folder is missing, a label is not of so many digits, or a label has no image. The
    released code reads labels as numbers, by which `7` and `0007` are one; so only the full form is a label here.
    """
    items: list[Item] = []
    for label in reader.folders(folder.relative):
        path = f"{folder.relative}/{label}"
        if not re.fullmatch(rf"[0-9]{{{digits}}}", label):
            raise DatasetError(f"{path} is not named by a label of {digits} digits: remove it or rename it")
        names = reader.images(path)
        if not names:
            raise DatasetError(f"{path} holds no image ({', '.join(IMAGES)}): copy the folder again")
        items += [
            Item(
                item_id=f"{path}/{name}",
                role=folder.role,
                view=folder.view,
                label=label,
                group=folder.group,
                height_m=folder.height_m,
            )
            for name in names
        ]
        if len(items) > MOST_ITEMS:
            raise DatasetError(f"{folder.relative} holds more than {MOST_ITEMS} images: name the folder of one dataset")
    if not items:
        raise DatasetError(f"{folder.relative} holds no folder of a label: {reader.layout}")
    return items
