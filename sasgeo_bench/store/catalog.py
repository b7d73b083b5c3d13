# SPDX-License-Identifier: Apache-2.0
"""Finding region files: those that ship with the package, and the user's own."""

import difflib
from collections.abc import Sequence
from pathlib import Path
from typing import Literal

from sasgeo_bench.errors import ConfigError
from sasgeo_bench.regionfile import RegionFile
from sasgeo_bench.tomlfile import parse_toml

Kind = Literal["regions", "splits", "pipelines"]


def shipped_dir(kind: Kind) -> Path:
    """Folder of the shipped files: inside an installed package, at the top of a checkout otherwise.

    Examples
    --------
    >>> shipped_dir("regions").name
    'regions'
    """
    package = Path(__file__).parents[1]
    installed = package / "shipped" / kind
    return installed if installed.is_dir() else package.parent / kind


def read_region_file(path: Path) -> RegionFile:
    """Read one region file.

    Raises
    ------
    ConfigError
        If it cannot be read or a value in it is wrong; all faults on one line.
    """
    try:
        text = path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        message = f"{path} cannot be read as a region file ({error}): name a .toml file or an id from list-regions"
        raise ConfigError(message) from error
    return parse_toml(text, RegionFile, source=str(path))


def list_region_files(*, folders: Sequence[Path] = ()) -> dict[str, Path]:
    """Region id -> file, of the given folders and those shipped.

    Raises
    ------
    ConfigError
        If a folder is missing, a file is wrong, or two files have one id.

    Examples
    --------
    >>> "vaduz" in list_region_files()
    True
    """
    found: dict[str, Path] = {}
    for folder in (*folders, shipped_dir("regions")):
        if not folder.is_dir():
            message = f"there is no folder {folder} with region files"
            raise ConfigError(message)
        for path in sorted(folder.glob("*.toml")):
            identifier = read_region_file(path).id
            if identifier in found and not found[identifier].samefile(path):
                message = f"two region files have the id {identifier!r}: {found[identifier]} and {path}; rename one"
                raise ConfigError(message)
            found.setdefault(identifier, path)
    return found


def find_region_file(id_or_path: str, *, folders: Sequence[Path] = ()) -> Path:
    """Find a region file by its id, or take the path of one.

    Raises
    ------
    ConfigError
        If there is none; the line suggests the nearest id.

    Examples
    --------
    >>> find_region_file("vadus")
    Traceback (most recent call last):
        ...
    sasgeo_bench.errors.ConfigError: there is no region 'vadus', did you mean 'vaduz'? (list-regions shows all)
    """
    if id_or_path.endswith(".toml"):
        path = Path(id_or_path)
        if not path.is_file():
            message = f"there is no region file {id_or_path}"
            raise ConfigError(message)
        return path
    known = list_region_files(folders=folders)
    if id_or_path not in known:
        near = difflib.get_close_matches(id_or_path, known, n=1, cutoff=0.5)
        hint = f", did you mean {near[0]!r}?" if near else ""
        message = f"there is no region {id_or_path!r}{hint} (list-regions shows all)"
        raise ConfigError(message)
    return known[id_or_path]
