# SPDX-License-Identifier: Apache-2.0
"""Aerial pictures that a region file names: who made them, what may be done with them, and where they lie."""

import datetime as dt
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Final

from pydantic import Field

from sasgeo_bench.config import Document, Line
from sasgeo_bench.errors import ImageryError
from sasgeo_bench.files.folders import sha256_of
from sasgeo_bench.osm.locate import IMAGERY_VARIABLE, PlainName, Sha256, imagery_folders, named_files

_FLAG: Final = "--imagery"
Level = Annotated[int, Field(ge=0, le=255)]


class ImageryEntry(Document):
    """One `[[imagery]]` of a region file: a GeoTIFF of aerial pictures.

    `publish` says whether the picture, or what is cut out of it, may be passed on. `empty_rgb` is the colour of areas
    without a picture, in files that say so by no mask. `gsd_m` is a coarser ground resolution than the file has.

    >>> from sasgeo_bench.config import parse_toml
    >>> text = '''
    ... file = "mosaic.tif"
    ... sha256 = ["0000000000000000000000000000000000000000000000000000000000000000"]
    ... date = 2024-01-01
    ... licence = "CC-BY-4.0"
    ... attribution = "OpenAerialMap contributors"
    ... '''
    >>> parse_toml(text, ImageryEntry, source="[[imagery]]")
    Traceback (most recent call last):
        ...
    sasgeo_bench.errors.ConfigError: [[imagery]]: 'publish' is missing
    """

    file: PlainName
    sha256: Annotated[tuple[Sha256, ...], Field(strict=False, min_length=1)]
    date: dt.date
    licence: Line
    attribution: Line
    publish: bool
    source: Line | None = None
    empty_rgb: Annotated[tuple[Level, Level, Level], Field(strict=False)] | None = None
    gsd_m: Annotated[float, Field(gt=0, le=100)] | None = None


def find_imagery(entry: ImageryEntry, *, folders: Sequence[Path] = (), extracts: Sequence[Path] = ()) -> Path:
    """Find a picture by name and SHA-256; `folders` come first, then those of `imagery_folders`.

    Pictures are never downloaded. Raise `ImageryError` if no folder holds it; the message says where to put it.
    """
    places = imagery_folders(folders, extracts=extracts)
    wrong: list[str] = []
    for path in named_files(entry.file, places):
        found = sha256_of(path)
        if found in entry.sha256:
            return path
        wrong.append(f"{path} has SHA-256 {found}, which is none of those accepted")
    because = f" ({'; '.join(wrong)})" if wrong else ""
    where = ", ".join(map(str, dict.fromkeys(places))) or "a folder"
    raise ImageryError(
        f"{entry.file} (SHA-256 {' or '.join(entry.sha256)}) was not found{because}: put it into {where}, or name its "
        f"folder with {_FLAG} or {IMAGERY_VARIABLE}"
    )
