# SPDX-License-Identifier: Apache-2.0
"""A built region in one file: what matching reads of it, for the computer of an aircraft.

A packed map is a tar archive without compression, for its files are compressed: `map.json`, and beside it layers,
features and graph as they were built, and what a matcher has learned, if that is packed too. It is unpacked once, into
a folder named after its hash, and is a region there: whatever takes the folder of a region gives the same answers.
"""

import hashlib
import io
import tarfile
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from importlib.metadata import version
from pathlib import Path
from re import fullmatch
from shutil import copyfileobj
from typing import Annotated, Final, Self

from pydantic import Field

from sasgeo_bench.core.archives import plain_members
from sasgeo_bench.core.config import JsonDocument, check_document
from sasgeo_bench.core.errors import ConfigError, SasgeoError, StoreError
from sasgeo_bench.core.folders import FileRecord, absolute, file_record, fresh_file, fresh_folder, locked, sha256_of
from sasgeo_bench.core.json import parse_json
from sasgeo_bench.core.paths import given_path, plain_file
from sasgeo_bench.core.texts import FOLDER, json_text, one_line
from sasgeo_bench.regions.imagery import ORTHO
from sasgeo_bench.regions.region import ATTRIBUTION, Count, Manifest
from sasgeo_bench.regions.region_files import (
    EDGES,
    FEATURES,
    LAYERS,
    MANIFEST,
    NODES,
    check_files,
    read_manifest,
)

LEARNED: Final = "learned.json"  # as of a run
SUFFIX: Final = ".map"
UNPACKED: Final = "maps"  # below the root of what is built
MAP_VERSION: Final = 1
_ABOUT: Final = "map.json"
_MOST_ABOUT: Final = 1_000_000  # bytes
_NEEDED: Final = (MANIFEST, LAYERS, FEATURES, NODES, EDGES)
_KNOWN: Final[tuple[str, ...]] = (_ABOUT, *_NEEDED, ORTHO, LEARNED)
_MEND: Final = "fetch the file again, or pack the map again with pack-map"
_DAMAGES: Final = (tarfile.TarError, EOFError, ValueError, OverflowError, RecursionError)


class Weights(JsonDocument):
    """Who learned the text that is packed with a map, of which places, and of how many queries with their truths."""

    matcher: str
    trained_on: tuple[str, ...]
    pairs: Count


class PackedMap(JsonDocument):
    """`map.json`: what a packed map is of, how large it is, whom to name, and the hashes of its files.

    `region` is the name of the folder that it was packed from; what that had besides is `left_out`. `mb` are its files,
    of 10^6 bytes; `km2` is the ground of its grid; `publish` says whether it may be passed on. What it was built from
    stands in `region.json`, one of the files.
    """

    map_version: int
    made_by: str
    region: Annotated[str, Field(pattern=FOLDER)]
    km2: Annotated[float, Field(gt=0)]
    mb: Annotated[float, Field(ge=0)]
    mb_per_km2: Annotated[float, Field(ge=0)]
    licence: str
    attribution: str
    files: dict[str, FileRecord]
    left_out: tuple[str, ...] = ()
    publish: bool = True
    weights: Weights | None = None

    @classmethod
    def read(cls, content: object, path: Path) -> Self:
        """Read what a file says of itself; raise `StoreError` if it is damaged or of another version."""
        found = content.get("map_version") if isinstance(content, dict) else None
        if found != MAP_VERSION:
            raise StoreError(
                f"{path} is a packed map of version {one_line(repr(found))[:40]}, this program reads {MAP_VERSION}: "
                "pack the map again with this version's pack-map"
            )
        try:
            about = check_document(content, cls, source=_ABOUT)
        except ConfigError as error:
            raise StoreError(f"{path} is damaged ({str(error)[:200]}): {_MEND}") from error
        lost = [name for name in _NEEDED if name not in about.files]
        odd = set(about.files) - set(_KNOWN) or {_ABOUT} & set(about.files)
        if lost or odd or (about.weights is None) != (LEARNED not in about.files):
            raise StoreError(f"{path} is damaged ({_ABOUT} does not list what a map is of): {_MEND}")
        return about

    def to_text(self) -> str:
        """Describe in one line how large it is, and what was left out."""
        without = f"; without {', '.join(self.left_out)}" if self.left_out else ""
        kept = "" if self.publish else "; it must not be passed on (publish = false)"
        learned = "" if self.weights is None else f"; with what {self.weights.matcher} has learned"
        return f"{self.mb:.2f} MB, {self.mb_per_km2:.2f} MB a km2 of {self.km2:.2f} km2{learned}{without}{kept}"


@dataclass(frozen=True, slots=True, kw_only=True)
class UnpackedMap:
    """A packed map, and the folder that it lies unpacked in, `root`: a region, and what a matcher has learned."""

    file: Path
    about: PackedMap
    root: Path

    @property
    def folder(self) -> Path:
        """Folder of the region."""
        return self.root / self.about.region

    @property
    def learned(self) -> Path:
        """File of the text that `about.weights` tells of."""
        return self.root / LEARNED

    def path(self, name: str) -> Path:
        """Return where one of `about.files` lies."""
        return self.learned if name == LEARNED else self.folder / name

    @property
    def lacks_imagery(self) -> bool:
        """Whether the region had imagery that was not packed."""
        return ORTHO in self.about.left_out


def is_packed_map(path: Path) -> bool:
    """Return whether a path is meant as a packed map: by its suffix, whether or not the file is there.

    >>> is_packed_map(Path("vaduz.map")), is_packed_map(Path("out/regions/vaduz"))
    (True, False)
    """
    return path.suffix == SUFFIX and not path.is_dir()


def pack_map(
    folder: Path, path: Path, *, with_imagery: bool = False, learned: tuple[Weights, Path] | None = None
) -> PackedMap:
    """Write what matching reads of a built region into one file; the same region gives the same bytes.

    Parameters
    ----------
    folder : Path
        Folder of the region.
    path : Path
        File to write, `*.map`; an earlier packed map there is replaced.
    with_imagery : bool
        Whether the aerial imagery goes in, which is far larger than the map, and which few matchers look at.
    learned : tuple of Weights and Path, optional
        What a matcher has learned, and the file of that text.

    Raises
    ------
    ConfigError
        If the file would not be named as packed maps are, or the region has no imagery to pack.
    StoreError
        If the region is missing or damaged, the file cannot be written, or would replace something else.

    Examples
    --------
    >>> pack_map(Path("out/regions/vaduz"), Path("vaduz.zip"))
    Traceback (most recent call last):
        ...
    sasgeo_bench.core.errors.ConfigError: vaduz.zip: a packed map is named *.map, as in vaduz.map
    """
    if path.suffix != SUFFIX:
        raise ConfigError(f"{path}: a packed map is named *{SUFFIX}, as in {path.with_suffix(SUFFIX)}")
    manifest = read_manifest(folder)
    if with_imagery and manifest.imagery is None:
        raise ConfigError(f"{folder} has no imagery: leave --with-imagery out")
    sources = {name: folder / name for name in _KNOWN if name in manifest.files and (with_imagery or name != ORTHO)}
    check_files(folder, sources)
    if path.exists() and not _is_sound(path):
        raise StoreError(
            f"{path} is there, and is no packed map to replace: remove it, or name another file with --into"
        )
    with fresh_file(path, mend="check the free space and your rights, or name another file with --into") as scratch:
        return _write(absolute(folder).name, manifest, sources, learned, scratch)


def _write(
    own: str, manifest: Manifest, sources: dict[str, Path], learned: tuple[Weights, Path] | None, path: Path
) -> PackedMap:
    """Write a packed map of some files of a region, which has its manifest without the others."""
    kept = manifest.model_copy(
        update={
            "files": {name: manifest.files[name] for name in sources},
            "imagery": manifest.imagery if ORTHO in sources else None,
        }
    )
    text = json_text(kept.model_dump(mode="json")).encode()
    files = {MANIFEST: FileRecord(sha256=hashlib.sha256(text).hexdigest(), bytes=len(text)), **kept.files}
    if learned is not None:
        files[LEARNED] = file_record(learned[1])
    km2 = manifest.rows * manifest.cols * manifest.cell_size_m**2 / 1e6
    mb = sum(record.bytes for record in files.values()) / 1e6
    about = PackedMap(
        map_version=MAP_VERSION,
        made_by=f"sasgeo-bench {version('sasgeo-bench')}",
        region=own if fullmatch(FOLDER, own) else manifest.id,
        km2=round(km2, 6),
        mb=round(mb, 6),
        mb_per_km2=round(mb / km2, 6),
        licence=manifest.licence,
        attribution=_credit(kept),
        files=files,
        left_out=tuple(sorted(set(manifest.files) - set(sources))),
        publish=all(one.publish for one in kept.own_maps) and (kept.imagery is None or kept.imagery.is_publishable),
        weights=None if learned is None else learned[0],
    )
    head = json_text(about.model_dump(mode="json")).encode()
    with tarfile.open(path, "w:", format=tarfile.USTAR_FORMAT) as archive:
        for name, data in ((_ABOUT, head), (MANIFEST, text)):
            archive.addfile(_member(name, len(data)), io.BytesIO(data))
        for name, file in (*sources.items(), *([] if learned is None else [(LEARNED, learned[1])])):
            with plain_file(file).open("rb") as source:
                archive.addfile(_member(name, files[name].bytes), source)
    return about


def _member(name: str, size: int) -> tarfile.TarInfo:
    """Return the head of a member that tells nothing of when, where or by whom it was packed."""
    found = tarfile.TarInfo(name)
    found.size = size
    return found


def _credit(manifest: Manifest) -> str:
    """Return whom to name beside a map, its further sources and its imagery included."""
    imagery = None if manifest.imagery is None else manifest.imagery.attribution
    parts = (manifest.attribution or ATTRIBUTION, manifest.provenance.further_sources, imagery)
    return "; ".join(dict.fromkeys(filter(None, parts)))


def unpack_map(path: str | Path, out: Path) -> UnpackedMap:
    """Unpack a packed map below a root, once; a later call finds it there, and holds it against its hashes.

    The region lies in `out/maps/<hash of the file>/<name of the region>`, whole or not at all.

    Raises
    ------
    StoreError
        If the file is missing, damaged, of another version or holds anything else, or the folder cannot be written.

    Examples
    --------
    >>> unpack_map("nowhere.map", Path("out"))
    Traceback (most recent call last):
        ...
    sasgeo_bench.core.errors.StoreError: nowhere.map cannot be read (No such file or directory): check the path
    """
    file = given_path(path)
    about = _read_about(file)
    root = out / UNPACKED / sha256_of(file)[:16]
    found = UnpackedMap(file=file, about=about, root=root)
    if _is_whole(found):  # before the lock: a read-only folder serves as well
        return found
    try:
        with locked(root):
            if not _is_whole(found):
                with fresh_folder(root) as scratch:
                    _unpack(replace(found, root=scratch))
    except SasgeoError:  # an error with a cause of its own, though it may be an `OSError`
        raise
    except OSError as error:
        raise StoreError(
            f"{root} cannot be written ({error.strerror or error}): check the free space and your rights, or name "
            "another folder by --out"
        ) from error
    return found


def _is_whole(found: UnpackedMap) -> bool:
    """Return whether a map lies there as it was packed."""
    try:
        return all(file_record(found.path(name)) == record for name, record in found.about.files.items())
    except OSError:
        return False


@contextmanager
def _opened(path: Path) -> Iterator[tuple[PackedMap, Iterator[tuple[str, tarfile.TarInfo]], tarfile.TarFile]]:
    """Open a packed map: what it says of itself, its other members, and the archive; a damage is one line."""
    try:
        with plain_file(path).open("rb") as source, tarfile.open(fileobj=source, mode="r:") as archive:
            members = plain_members(
                path,
                archive,
                is_known=lambda name, is_file: is_file and str(name) in _KNOWN,
                most=len(_KNOWN),
                mend=f"a packed map holds nothing but {', '.join(_KNOWN)}",
            )
            first, head = next(members, ("", None))
            content = None if head is None or head.size > _MOST_ABOUT else archive.extractfile(head)
            if first != _ABOUT or content is None:
                raise StoreError(f"{path} is no packed map (it does not begin with {_ABOUT}): pack-map writes one")
            yield PackedMap.read(parse_json(content.read()), path), members, archive
    except SasgeoError:
        raise
    except tarfile.ReadError as error:
        raise StoreError(f"{path} is no packed map, or was cut ({one_line(str(error))}): {_MEND}") from error
    except _DAMAGES as error:
        raise StoreError(f"{path} is damaged ({one_line(str(error)) or type(error).__name__}): {_MEND}") from error


def _read_about(path: Path) -> PackedMap:
    """Read what a file says of itself, and no more."""
    try:
        with _opened(path) as (about, _, _):
            return about
    except SasgeoError:
        raise
    except OSError as error:
        raise StoreError(f"{path} cannot be read ({error.strerror or error}): check the path") from error


def _is_sound(path: Path) -> bool:
    """Return whether a file says of itself that it is a packed map of this version."""
    try:
        _read_about(path)
    except StoreError:
        return False
    return True


def _unpack(found: UnpackedMap) -> None:
    """Unpack a map into its folder, which is empty; refuse files that are not what `map.json` says."""
    found.folder.mkdir()
    with _opened(found.file) as (about, members, archive):
        if about != found.about:
            raise StoreError(f"{found.file} was replaced while it was read: run again")
        for name, member in members:
            content = archive.extractfile(member)
            if content is None or name not in about.files or member.size != about.files[name].bytes:
                raise StoreError(f"{found.file} is damaged ({name} is not what {_ABOUT} says): {_MEND}")
            with found.path(name).open("wb") as target:
                copyfileobj(content, target)
    for name, record in found.about.files.items():
        path = found.path(name)
        if not path.is_file() or file_record(path) != record:
            raise StoreError(f"{found.file} is damaged ({name} is not what {_ABOUT} says): {_MEND}")
    read_manifest(found.folder)
