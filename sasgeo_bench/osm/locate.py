# SPDX-License-Identifier: Apache-2.0
"""What a region file says of an extract or map, and the file itself: in the given folders, else downloaded."""

import datetime as dt
import os
import sys
from collections.abc import Iterable, Iterator, Sequence
from contextlib import suppress
from functools import cache
from pathlib import Path
from threading import Event, Thread
from typing import Annotated, Final, Literal, Self
from urllib.parse import urlsplit

from pydantic import (
    AfterValidator,
    Field,
    SerializerFunctionWrapHandler,
    StringConstraints,
    field_validator,
    model_serializer,
    model_validator,
)

from sasgeo_bench.core.config import Document, Line
from sasgeo_bench.core.errors import ExtractError
from sasgeo_bench.core.folders import scratch_folder, sha256_of
from sasgeo_bench.core.progress import QUIET
from sasgeo_bench.osm.taxonomy import load_taxonomy

FOLDERS_VARIABLE: Final = "SASGEO_EXTRACTS"
IMAGERY_VARIABLE: Final = "SASGEO_IMAGERY"
ANSWER_S: Final = 3.0  # a server silent for longer counts as unreachable

Sha256 = Annotated[str, StringConstraints(pattern=r"^[0-9a-f]{64}$")]
# Source of the mapped area of an extract.
CoverageSource = Literal["region file", "header box", "estimated", "estimated and islands"]
Morphology = Literal["grid", "old_town", "suburb", "industrial", "riverside", "agricultural"]


class TownEntry(Document):
    """An embedded town in place of a file: made by `write_town`, never downloaded."""

    morphology: Morphology
    seed: Annotated[int, Field(ge=0)]
    size_m: Annotated[float, Field(gt=0, le=10_000)] = 1024.0


def plain_name(file: str) -> str:
    """Return a file name; raise `ValueError` if it holds folders."""
    if Path(file).name != file:
        raise ValueError(f"file must be a plain file name without folders, got {file!r}")
    return file


PlainName = Annotated[Line, AfterValidator(plain_name)]


class ExtractPart(Document):
    """A further file of an extract that comes in several; `sha256` as for the extract."""

    file: PlainName
    sha256: Annotated[tuple[Sha256, ...], Field(strict=False, min_length=1)]


class Extract(Document):
    """One `[[extract]]` of a region file.

    `date` is the date of the extract; for a full history, the date to cut it at. Several hashes are several accepted
    forms of one file, such as with and without user names.

    `format` "geojson" is for features of OpenStreetMap as GeoJSON, whose properties are tags. `tags` are those that
    all its features have, as in a file of buildings that does not say so; `also` are further files of that format.
    """

    file: PlainName
    date: dt.date
    sha256: Annotated[tuple[Sha256, ...], Field(strict=False)] = ()
    urls: Annotated[tuple[str, ...], Field(strict=False)] = ()
    town: TownEntry | None = None
    format: Literal["osm", "geojson", "own_map"] = "osm"
    tags: dict[str, Line] = {}
    also: Annotated[tuple[ExtractPart, ...], Field(strict=False)] = ()

    @model_serializer(mode="wrap")
    def _as_written(self, handler: SerializerFunctionWrapHandler) -> dict[str, object]:
        """Leave out `format`, `tags` and `also` of an OSM file: such regions keep the hash of older versions."""
        newer = ("format", "tags", "also") if self.format == "osm" else ()
        return {name: value for name, value in handler(self).items() if name not in newer}

    @model_validator(mode="after")
    def _has_only_keys_of_its_format(self) -> Self:
        if self.format == "osm" and (self.tags or self.also):
            raise ValueError(
                f"extract {self.file!r} has tags or also, which are for format = 'geojson': leave them out"
            )
        return self

    @model_validator(mode="after")
    def _has_source(self) -> Self:
        if bool(self.sha256) == (self.town is not None):
            raise ValueError(f"extract {self.file!r} needs either sha256 = [...] or town = {{...}}")
        return self


class ClassTable(Document):
    r"""Which rows of a file of features are of which class of the map: all of one `class`, or by a `column`.

    `values` says which class each value of the column is; rows with other values are left out and counted. `layer` is
    needed where the file has several, `epsg` where it says no coordinate reference system. `width_column` holds the
    widths of lines in metres; without it they are as wide as the class usually is.

    >>> from sasgeo_bench.core.config import parse_toml
    >>> text = 'column = "use"\nvalues = { house = "building", shed = "building", pond = "water" }'
    >>> parse_toml(text, ClassTable, source="[[own_map]]").named_classes
    ('building', 'water')
    """

    layer: Line | None = None
    class_name: str | None = Field(default=None, alias="class")
    column: Line | None = None
    values: dict[Line, str] = {}
    width_column: Line | None = None
    epsg: int | None = None

    @field_validator("epsg")
    @classmethod
    def _epsg_is_known(cls, epsg: int | None) -> int | None:
        import pyproj  # noqa: PLC0415 - a process of a matcher reads no map of one's own, and starts without it

        try:
            return epsg if epsg is None or pyproj.CRS.from_epsg(epsg) else None
        except pyproj.exceptions.CRSError as error:
            raise ValueError(f"epsg {epsg!r} is unknown: name the one of its coordinates") from error

    @model_validator(mode="after")
    def _says_classes_once(self) -> Self:
        if (self.column is None) != (not self.values) or (self.column and self.class_name):
            raise ValueError(
                "say which class its features are by class = '...', or by column = '...' and a table of its values, "
                "values = { house = 'building' }"
            )
        named_ones = [name for name in (self.class_name, *self.values.values()) if name is not None]
        if not named_ones and (self.layer or self.width_column or self.epsg):
            raise ValueError("layer, width_column and epsg are of maps with `class`, or `column` and `values`: add one")
        known = load_taxonomy().names
        strange = next((name for name in named_ones if name not in known), None)
        if strange is not None:
            raise ValueError(f"its features are {strange!r}, which is no class: there are {', '.join(known)}")
        return self

    @property
    def named_classes(self) -> tuple[str, ...]:
        """Return the classes that it names, in the order of their ids; none where properties are tags."""
        found = {self.class_name, *self.values.values()}
        return tuple(name for name in load_taxonomy().names if name in found)

    def class_of(self, value: str) -> str | None:
        """Return the class of a feature with a value in the column, as text; None if it is none."""
        return self.class_name or self.values.get(value)


def extract_folders(given: Sequence[Path] = ()) -> tuple[Path, ...]:
    """Return the folders to search for extracts, in order: those given, SASGEO_EXTRACTS, the user's cache."""
    found = [*given, *_named_by(FOLDERS_VARIABLE)]
    with suppress(ExtractError):  # a user without a home has no cache
        found.append(cache_folder())
    return tuple(found)


def _named_by(variable: str) -> list[Path]:
    return [Path(folder) for folder in os.environ.get(variable, "").split(os.pathsep) if folder]


def imagery_folders(given: Sequence[Path] = (), *, extracts: Sequence[Path] = ()) -> tuple[Path, ...]:
    """Return the folders to search for aerial imagery, in order.

    Those given, SASGEO_IMAGERY, and the folder `imagery` beside each folder of extracts; files may lie one folder
    deeper.

    >>> Path("data/imagery") in imagery_folders(extracts=[Path("data/osm")])
    True
    """
    beside = (folder.parent / "imagery" for folder in (*extracts, *_named_by(FOLDERS_VARIABLE)))
    return (*given, *_named_by(IMAGERY_VARIABLE), *beside)


def named_files(name: str, folders: Sequence[Path], *, has_folders: bool = False) -> list[Path]:
    """List the files of a name in folders and in the folders directly below them, in order; folders of it, too."""
    found = (path for folder in folders for path in (folder / name, *sorted(folder.glob(f"*/{name}"))))
    return [path for path in found if path.is_file() or (has_folders and path.is_dir())]


def cache_folder() -> Path:
    """Return the folder of downloaded extracts; raise `ExtractError` if the user has no cache."""
    import pooch  # noqa: PLC0415 - only downloads, and what they left, need it

    try:
        return Path(pooch.os_cache("sasgeo-bench"))
    except RuntimeError as error:  # of a user who is only a number, as in containers
        raise ExtractError("you have no home, and so no cache: name a folder by XDG_CACHE_HOME") from error


def find_extract(extract: Extract, *, folders: Sequence[Path] = ()) -> Path:
    """Find the file of an extract by name and SHA-256, or download it into the user's cache; `folders` come first.

    GeoJSON and maps of one's own, which come with imagery, are looked for in the folders of imagery too. Raise
    `ExtractError` if no folder holds the file and it cannot be downloaded; the message names the file, its SHA-256 and
    where to put it.
    """
    if not extract.sha256:
        raise ExtractError(f"{extract.file} is an embedded town: it is made by the build, there is no file to find")
    wrong: list[str] = []
    for path in _places(extract, folders):
        if path.is_file():
            found = sha256_of(path)
            if found in extract.sha256:
                return path
            wrong.append(f"{path} has SHA-256 {found}, which is none of those accepted")
    failures: list[str] = []
    for url in extract.urls:
        try:
            return _download(extract, url)
        except ExtractError as error:
            failures.append(str(error))
    raise ExtractError(_not_found(extract, folders, wrong + failures))


def _places(extract: Extract, folders: Sequence[Path]) -> Iterator[Path]:
    """Yield where the file of an extract may lie on this machine, the user's cache not before it is asked for."""
    yield from (folder / extract.file for folder in (*folders, *_named_by(FOLDERS_VARIABLE)))
    yield cache_folder() / extract.file
    if extract.format != "osm":
        yield from named_files(extract.file, imagery_folders(extracts=folders))


def missing_files(extracts: Iterable[Extract], *, folders: Sequence[Path] = ()) -> tuple[str, ...]:
    """Return the names of the files of extracts that are not on this machine; nothing is downloaded or hashed.

    Embedded towns have no file.

    >>> missing_files([Extract(file="nowhere.osm.pbf", date=dt.date(2020, 1, 1), sha256=("0" * 64,))])
    ('nowhere.osm.pbf',)
    """
    named = (one for extract in extracts if extract.town is None for one in (extract, *_parts(extract)))
    return tuple(sorted({one.file for one in named if not any(path.is_file() for path in _places(one, folders))}))


def find_parts(extract: Extract, *, folders: Sequence[Path] = ()) -> tuple[Path, ...]:
    """Find the further files of an extract; raise as `find_extract` does."""
    return tuple(find_extract(part, folders=folders) for part in _parts(extract))


def _parts(extract: Extract) -> list[Extract]:
    return [extract.model_copy(update={"file": part.file, "sha256": part.sha256, "urls": ()}) for part in extract.also]


def _not_found(extract: Extract, folders: Sequence[Path], reasons: Sequence[str]) -> str:
    hashes = " or ".join(extract.sha256)
    places = ", ".join(str(folder) for folder in extract_folders(folders))
    because = f" ({'; '.join(reasons)})" if reasons else ""
    return (
        f"{extract.file} (SHA-256 {hashes}) was not found{because}: "
        f"put it into {places}, or name its folder with --extracts or {FOLDERS_VARIABLE}"
    )


def _download(extract: Extract, url: str) -> Path:
    """Download into the cache; the file gets its name only if its hash is accepted."""
    import pooch  # noqa: PLC0415 - only downloads need it

    if not answers(url):
        raise ExtractError(f"{url} cannot be reached")
    folder = cache_folder()
    # 30 s between two parts of a download
    load = pooch.HTTPDownloader(timeout=30.0, progressbar=sys.stderr.isatty() and QUIET not in os.environ)
    pooch.get_logger().setLevel("WARNING")  # else it prints the path of its temporary file
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with scratch_folder("download", within=folder) as scratch:
            # pooch checks one hash, and several may be accepted here: so it gets none, and we check.
            got = Path(pooch.retrieve(url, known_hash=None, fname=extract.file, path=scratch, downloader=load))
            found = sha256_of(got)
            if found in extract.sha256:
                return got.replace(folder / extract.file)
            raise ExtractError(f"{url} has SHA-256 {found}, which is none of those accepted")  # noqa: TRY301 - an OSError too, and passed on as it is
    except ExtractError:
        raise
    except OSError as error:  # requests' errors are OSErrors, too
        raise ExtractError(f"{url} could not be downloaded: {_why(error)}") from error


def _why(error: OSError) -> str:
    """Describe why a download failed, without the internals that the libraries name."""
    response = getattr(error, "response", None)
    if response is not None:
        return f"the server answered with status {response.status_code}"
    return error.strerror or "the connection broke off"


def answers(url: str) -> bool:
    """Return whether the server of an address answers within `ANSWER_S`; each server is asked once."""
    parts = urlsplit(url)
    return parts.scheme in {"http", "https"} and _server_answers(f"{parts.scheme}://{parts.netloc}")


@cache
def _server_answers(server: str) -> bool:

    found = Event()
    # In a thread: the lookup of a name ignores the time limit of the connection.
    thread = Thread(target=_ask, args=(server, found), daemon=True)
    thread.start()
    thread.join(ANSWER_S)
    return found.is_set()


def _ask(server: str, found: Event) -> None:
    import pooch  # noqa: PLC0415 - only downloads need it

    with suppress(OSError, ValueError):
        pooch.HTTPDownloader(timeout=ANSWER_S)(server, None, None, check_only=True)
        found.set()
