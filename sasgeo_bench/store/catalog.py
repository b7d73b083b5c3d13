# SPDX-License-Identifier: Apache-2.0
"""Finding region and split files: those that ship with the package, and the user's own."""

import difflib
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Literal, TypeVar

from sasgeo_bench.errors import ConfigError
from sasgeo_bench.pipelinefile import PipelineFile
from sasgeo_bench.regionfile import RegionFile
from sasgeo_bench.split import Split, SplitFile, make_split
from sasgeo_bench.tomlfile import Document, parse_toml

Kind = Literal["regions", "splits", "pipelines"]
Model = TypeVar("Model", bound=Document)
Identified = RegionFile | SplitFile | PipelineFile


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
    return _read(path, RegionFile, "regions")


def read_split_file(path: Path) -> SplitFile:
    """Read one split file; raises as `read_region_file` does."""
    return _read(path, SplitFile, "splits")


def read_pipeline_file(path: Path) -> PipelineFile:
    """Read one pipeline file; raises as `read_region_file` does."""
    return _read(path, PipelineFile, "pipelines")


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
    return _list("regions", read_region_file, folders)


def list_split_files(*, folders: Sequence[Path] = ()) -> dict[str, Path]:
    """Split id -> file, of the given folders and those shipped; raises as `list_region_files` does.

    Examples
    --------
    >>> sorted(list_split_files())
    ['crossfit', 'holdout']
    """
    return _list("splits", read_split_file, folders)


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
    return _find(id_or_path, "region", "list-regions shows all", lambda: list_region_files(folders=folders))


def find_split_file(id_or_path: str, *, folders: Sequence[Path] = ()) -> Path:
    """Find a split file by its id, or take the path of one; raises as `find_region_file` does."""
    return _find(id_or_path, "split", "or name a .toml file", lambda: list_split_files(folders=folders))


def find_split(id_or_path: str, *, folders: Sequence[Path] = ()) -> Split:
    """The checked split of an id or file, laid out on all regions that are known; raises as `make_split` does.

    Examples
    --------
    >>> find_split("crossfit").half_of["porto"]
    'a'
    """
    grids = {item: read_region_file(path).grid() for item, path in list_region_files(folders=folders).items()}
    return make_split(read_split_file(find_split_file(id_or_path)), grids)


def list_pipeline_files() -> dict[str, Path]:
    """Pipeline id -> file, of those shipped; raises as `list_region_files` does.

    Examples
    --------
    >>> "demo" in list_pipeline_files()
    True
    """
    return _list("pipelines", read_pipeline_file, ())


def find_pipeline_file(id_or_path: str) -> Path:
    """Find a pipeline file by its id, or take the path of one; raises as `find_region_file` does."""
    return _find(id_or_path, "pipeline", "or name a .toml file", list_pipeline_files)


def _read(path: Path, model: type[Model], kind: Kind) -> Model:
    try:
        text = path.read_text(encoding="utf-8-sig")  # some editors begin a file with a mark of its byte order
    except (OSError, UnicodeDecodeError) as error:
        noun = kind.removesuffix("s")
        message = f"{path} cannot be read as a {noun} file ({error}): name a .toml file, or the id of one that ships"
        raise ConfigError(message) from error
    return parse_toml(text, model, source=str(path))


def _list(
    kind: Kind, read: Callable[[Path], RegionFile | SplitFile | PipelineFile], folders: Sequence[Path]
) -> dict[str, Path]:
    noun = kind.removesuffix("s")
    found: dict[str, Path] = {}
    for folder in (*folders, shipped_dir(kind)):
        if not folder.is_dir():
            message = f"there is no folder {folder} with {noun} files"
            raise ConfigError(message)
        for path in sorted(folder.glob("*.toml")):
            identifier = read(path).id
            if identifier in found and not found[identifier].samefile(path):
                message = f"two {noun} files have the id {identifier!r}: {found[identifier]} and {path}; rename one"
                raise ConfigError(message)
            found.setdefault(identifier, path)
    return found


def _find(id_or_path: str, noun: str, mend: str, list_known: Callable[[], dict[str, Path]]) -> Path:
    if id_or_path.endswith(".toml"):
        path = Path(id_or_path)
        if not path.is_file():
            message = f"there is no {noun} file {id_or_path}"
            raise ConfigError(message)
        return path
    known = list_known()
    if id_or_path not in known:
        near = difflib.get_close_matches(id_or_path, known, n=1, cutoff=0.6)
        hint = f", did you mean {near[0]!r}?" if near else ""
        message = f"there is no {noun} {id_or_path!r}{hint} ({mend})"
        raise ConfigError(message)
    return known[id_or_path]
