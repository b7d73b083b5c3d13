# SPDX-License-Identifier: Apache-2.0
"""The command that examines a user's set-up: versions, folders, extracts, and what is missing."""

import os
import platform
import shutil
from collections.abc import Iterator, Sequence
from importlib import metadata
from pathlib import Path
from typing import Final

import pyproj
import rasterio
import shapely
from rich.table import Table

from sasgeo_bench.cli.console import print_table
from sasgeo_bench.cli.options import ExtractFolders, Out
from sasgeo_bench.core.errors import ExtractError, StoreError, named
from sasgeo_bench.core.room import VARIABLE, Room, most_bytes
from sasgeo_bench.osm.locate import IMAGERY_VARIABLE, Extract, answers, extract_folders, find_extract
from sasgeo_bench.regions.region_spec import list_region_files, read_region_file

_LIBRARIES: Final = ("osmium", "shapely", "geopandas", "rasterio", "numpy", "pandas", "pyarrow")

_MOST_LISTED: Final = 40  # files that are missing


def examine(folders: Sequence[Path], *, out: Path) -> Iterator[tuple[str, str]]:
    """Yield name and finding, one pair for each thing looked at; changes nothing and downloads nothing.

    Examples
    --------
    >>> dict(examine((), out=Path("out")))["python"].count(".")
    2
    """
    yield "sasgeo-bench", metadata.version("sasgeo-bench")
    yield "python", platform.python_version()
    for name in _LIBRARIES:
        yield name, metadata.version(name)
    yield "GDAL, GEOS, PROJ", f"{rasterio.__gdal_version__}, {shapely.geos_version_string}, {pyproj.proj_version_str}"
    yield "SASGEO_EXTRACTS", os.environ.get("SASGEO_EXTRACTS", "not set")
    for folder in extract_folders(folders):
        yield "extracts in", f"{folder}" + ("" if folder.is_dir() else " (no such folder)")
    yield IMAGERY_VARIABLE, os.environ.get(IMAGERY_VARIABLE, "not set")
    root = next(parent for parent in (out.absolute(), *out.absolute().parents) if parent.exists())
    is_writable = os.access(root, os.W_OK)
    free_gb = shutil.disk_usage(root).free / 1e9
    yield "output", f"{out.absolute()}, {free_gb:.1f} GB free" + ("" if is_writable else ", NOT WRITABLE")
    yield "kept of maps and answers", _kept_words()
    yield from _missing(folders)


def _kept_words() -> str:
    try:
        room = Room.of_user()
    except StoreError as error:
        return f"nothing: {error}"
    kept_mb = sum(entry.size for entry in room.entries()) / 1e6
    return f"{room.root}, {kept_mb:.0f} MB of {most_bytes() / 1e6:.0f} ({VARIABLE})"


def _missing(folders: Sequence[Path]) -> Iterator[tuple[str, str]]:
    """Extracts of the shipped regions that are not on this machine, by what can be done about it."""
    wanted: set[str] = set()
    missing: dict[str, list[str]] = {}
    for path in list_region_files().values():
        for extract in read_region_file(path).extract:
            if extract.town is not None or extract.file in wanted:
                continue
            wanted.add(extract.file)
            try:
                find_extract(extract.model_copy(update={"urls": ()}), folders=folders)
            except ExtractError:
                missing.setdefault(_mend(extract), []).append(extract.file)
    found = len(wanted) - sum(map(len, missing.values()))
    yield "extracts found", f"{found} of {len(wanted)} that the shipped regions name"
    for mend, files in sorted(missing.items()):
        yield "missing", f"{mend}: {named(sorted(files), 'file', most=_MOST_LISTED)}"


def _mend(extract: Extract) -> str:
    if not extract.urls:
        return "no address is known, region files state the source: put them into one of the folders"
    if not any(map(answers, extract.urls)):
        return "the server does not answer now, put them into one of the folders or try again later"
    return "the server answers, build-region downloads them"


def doctor_command(extracts: ExtractFolders = None, out: Out = Path("out")) -> None:
    """Report versions, folders and extracts, and what is missing."""
    table = Table(box=None, show_header=False, pad_edge=False)
    for name, finding in examine(extracts or (), out=out):
        table.add_row(name, finding)
    print_table(table)
