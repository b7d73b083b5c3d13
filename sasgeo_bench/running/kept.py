# SPDX-License-Identifier: Apache-2.0
"""What is made of a large map is kept for later processes, by the program alone, in the user's cache (`core.room`).

A plugin asks for it by name and settings (`Region.kept`); a process of ours without any plugin makes it
(`running.keeper`), so that no plugin can write what another one reads. A plugin is shown what is kept of its own map.
"""

import hashlib
import json
import os
import platform
import subprocess
import sys
import threading
from collections.abc import Mapping, Sequence
from contextlib import suppress
from functools import cache
from pathlib import Path
from queue import Queue
from tempfile import TemporaryFile
from typing import Any, Final

from pydantic import JsonValue

from sasgeo_bench.core.errors import SasgeoError, StoreError
from sasgeo_bench.core.paths import plain_file
from sasgeo_bench.core.progress import tell
from sasgeo_bench.core.room import Room, is_whole, most_bytes, touch
from sasgeo_bench.core.texts import one_line
from sasgeo_bench.regions.region import Manifest
from sasgeo_bench.regions.region_files import read_manifest

LEAST_CELLS: Final = 2048**2  # of a map: a smaller one is made in less time than a process takes to start
# Of the lowest priority that still gets a thirtieth of a processor, where matchers want all of them; Windows has none
_MAKER: Final = "import os; getattr(os, 'nice', int)(15); from sasgeo_bench.running.keeper import main; main()"
_BEGUN: Final = threading.Lock()  # taken once, by who starts the thread that serves orders
_ORDERS: Final = Queue[tuple[Path, list[Mapping[str, Any]]]]()


def shelf_of(region: Path) -> Path | None:
    """Return the folder of what is kept of a map, made now; None for a small map, or where nothing can be kept."""
    with suppress(SasgeoError, OSError, RuntimeError):  # the last one of links in a circle
        manifest = read_manifest(region)
        if _is_worth_it(manifest):
            shelf = Room.of_user().maps.resolve() / manifest.digest
            shelf.mkdir(mode=0o700, parents=True, exist_ok=True)  # a map may be private
            return shelf
    return None


def kept_of(region: Path, what: str, settings: Mapping[str, JsonValue], *, digest: str) -> Path | None:
    """Return the folder of what is kept of a map by some settings, in a cache that may be read-only; None without it.

    Parameters
    ----------
    region : Path
        Folder of the map.
    what : str
        A name of `keeper.MAKERS`.
    settings : mapping
        Arguments of that maker.
    digest : str
        `Manifest.digest` of the map that the asking process has read: of a map that was built anew, nothing is given.
    """
    shelf = shelf_of(region)
    if shelf is None or shelf.name != digest:
        return None
    folder = shelf / _name_of(what, settings, digest)
    if not is_whole(folder):
        return None
    touch(folder)
    return folder


def _name_of(what: str, settings: Mapping[str, JsonValue], digest: str) -> str:
    # Settings, the map, all code of ours, the libraries, the processor: whatever the result may follow from
    about = [what, dict(settings), digest, code_hash(), installed()]
    return hashlib.sha256(json.dumps(about, sort_keys=True).encode()).hexdigest()


def order(region: Path, wanted: Sequence[Mapping[str, Any]]) -> None:
    """Have what was asked for in vain made for later processes, by one beside this one; nobody waits for it.

    One order is made at a time. What is at work when this process ends is finished, orders that wait are dropped.

    Parameters
    ----------
    region : Path
        Folder of the map.
    wanted : sequence of mapping
        Arguments of `kept_of`: `what`, `settings` and `digest`; those of another map are left out.
    """
    shelf = shelf_of(region) if wanted else None
    if shelf is None:
        return
    wanted = [one for one in wanted if one["digest"] == shelf.name]
    if wanted and os.access(shelf, os.W_OK):
        if _BEGUN.acquire(blocking=False):
            threading.Thread(target=_serve, daemon=True).start()
        _ORDERS.put((region.resolve(), [{**one, "folder": str(shelf / _name_of(**one))} for one in wanted]))


def _serve() -> None:
    while True:
        region, wanted = _ORDERS.get()
        try:
            left = [one for one in wanted if not is_whole(Path(one["folder"]))]  # it was made meanwhile, for another
            if left:
                _make(json.dumps({"code": code_hash(), "region": str(region), "wanted": left}))
        except Exception as error:  # noqa: BLE001 - the next order is served, whatever came of this one
            _tell_once(f"nothing is kept of {region.name} ({one_line(str(error))[:200]})")
        finally:
            _ORDERS.task_done()


@cache
def _tell_once(text: str) -> None:
    tell(text)


def bytes_of(manifest: Manifest) -> int:
    """Return about how much is made of a map at most: a byte for each class and cell."""
    return manifest.rows * manifest.cols * (len(manifest.classes) + 1)


def _is_worth_it(manifest: Manifest) -> bool:
    return manifest.rows * manifest.cols >= LEAST_CELLS and 2 * bytes_of(manifest) <= most_bytes()


def _make(ordered: str) -> None:
    with (  # pipes would end with this process
        TemporaryFile("w+", encoding="utf-8") as asked,
        TemporaryFile("w+", encoding="utf-8", errors="replace") as said,
    ):
        asked.write(ordered)
        asked.seek(0)
        command = [sys.executable, "-P", "-c", _MAKER]
        made = subprocess.run(command, stdin=asked, stdout=said, stderr=said, check=False)  # noqa: S603
        if made.returncode:
            said.seek(0)
            last = said.read().strip().rpartition("\n")[2]
            raise StoreError(f"it cannot be made: {last or f'exit status {made.returncode}'}")


@cache
def code_hash() -> str:
    """Return the SHA-256 of all files of this package: a change in any makes all anew."""
    package, digest = Path(__file__).resolve().parents[1], hashlib.sha256()
    for path in sorted((*package.rglob("*.py"), *package.rglob("*.toml"))):
        data = plain_file(path).read_bytes()
        digest.update(f"{path.relative_to(package).as_posix()}\0{len(data)}\0".encode() + data)
    return digest.hexdigest()


@cache
def installed() -> list[str]:
    """Return names and versions of all that is installed, as its folders are called, and of Python and the computer."""
    found = {path.name for entry in sys.path if entry for path in Path(entry).glob("*-info")}
    return [*sorted(found), platform.python_version(), platform.platform(), platform.node()]
