# SPDX-License-Identifier: Apache-2.0
"""The process that makes what is kept of a map (`running.kept`): code of ours alone, no plugin is imported."""

import json
import signal
import sys
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from sasgeo_bench.core.errors import ConfigError, StoreError
from sasgeo_bench.core.folders import fresh_folder, locked, remove_tree
from sasgeo_bench.core.room import Room, is_whole, seal
from sasgeo_bench.core.texts import message_of
from sasgeo_bench.regions.region_files import read_manifest, read_region
from sasgeo_bench.running.kept import bytes_of, code_hash
from sasgeo_bench.sasgeo.mapped import MappedGraph
from sasgeo_bench.sasgeo.raster import store_field
from sasgeo_bench.sasgeo.rates import FAR
from sasgeo_bench.sasgeo.weights import STRATA
from sasgeo_bench.search.view import Chart

_WIDEST_M: Final = 64.0  # cells of a search; a map is padded by as much
LONGEST_S: Final = 600  # that an order may take: a tenth of it is a map of 100 km2
_AGAIN_S: Final = 1.0  # until a process that was stopped and goes on is stopped again
_FACTORS: Final = (1, 2, 4, 8, 16)  # views of up to 1 km; the next level takes as long as all of these


def _field(
    region: Path, into: Path, *, likeness: list[list[float]], trust: list[list[float]] | None, cell_size_m: float
) -> None:
    count = len(read_manifest(region).classes)
    grades = _shares(likeness, (count, FAR + 1))
    by_stratum = None if trust is None else _shares(trust, (count, STRATA))
    if not 0 < cell_size_m <= _WIDEST_M:
        raise ConfigError(f"cells are at most {_WIDEST_M} m wide, not {cell_size_m!r}")
    store_field(region, into / "levels", grades, trust=by_stratum, cell_size_m=cell_size_m, factors=_FACTORS)
    for path in (into / "levels").iterdir():
        path.rename(into / path.name)
    (into / "levels").rmdir()


def _shares(given: list[list[float]], shape: tuple[int, int]) -> NDArray[np.float64]:
    shares = np.array(given, dtype=np.float64)
    if shares.shape != shape or not ((shares >= 0) & (shares <= 1)).all():
        raise ConfigError(f"expected shares, 0..1, of shape {shape}, got {shares.shape}")
    return shares


def _chart(region: Path, into: Path, *, thin: list[str], reach_m: float) -> None:
    # Metres; a table has a row for each cell squared, and nothing fades within less than a millimetre
    if reach_m and not 1e-3 <= reach_m <= 100:
        raise ConfigError(f"lines fade within 100 m, not {reach_m!r}")
    Chart.of(read_region(region, with_layers=False), thin=tuple(thin), reach_m=reach_m).save(into)


def _graph(region: Path, into: Path) -> None:
    MappedGraph.of(read_region(region, with_layers=False)).save(into)


MAKERS: Final[Mapping[str, Callable[..., None]]] = {"field": _field, "chart": _chart, "graph": _graph}


def keep(region: Path, folder: Path, what: str, settings: Mapping[str, Any], *, digest: str) -> None:
    """Make a kind of `MAKERS` of a map by some settings in a folder, unless it is there: whole or not at all.

    `digest` is the `Manifest.digest` of the map. Raise `StoreError` if the map is another one, or damaged, or if there
    is no room.
    """
    _check(region, digest)
    with locked(folder.parent.with_name(folder.name)):  # beside the map's folder: a plugin could hold a lock in it
        if is_whole(folder):
            return
        remove_tree(folder)
        Room.of_user().make(bytes_of(read_manifest(region)))
        folder.parent.mkdir(mode=0o700, parents=True, exist_ok=True)  # room may have been made of it
        with fresh_folder(folder) as scratch:
            MAKERS[what](region, scratch, **settings)
            _check(region, digest)
            seal(scratch)


def _check(region: Path, digest: str) -> None:
    if read_manifest(region).digest != digest:
        raise StoreError(f"{region} was built anew meanwhile")


def main() -> None:
    """Keep what standard input orders, each thing by itself.

    Whoever ordered it may have ended meanwhile; what is interrupted, or takes too long, leaves nothing behind.
    """
    if sys.platform != "win32":
        for number in (signal.SIGTERM, signal.SIGALRM, signal.SIGHUP, signal.SIGINT):
            if signal.getsignal(number) is not signal.SIG_IGN:  # as `nohup` or a shell's `&` have it
                signal.signal(number, _stop)
        signal.alarm(LONGEST_S)
    order, faults = json.loads(sys.stdin.read()), []
    if order["code"] != code_hash():  # it would lie under the name of what other code makes
        raise StoreError("the program was changed meanwhile")
    for wanted in order["wanted"]:
        try:
            keep(Path(order["region"]), Path(wanted.pop("folder")), **wanted)
        except Exception as error:  # noqa: BLE001 - of settings that a plugin chose; the next one is made
            faults.append(message_of(error))
    if faults:
        sys.exit(faults[0])


def _stop(number: int, _: object) -> None:
    if sys.platform != "win32":
        signal.setitimer(signal.ITIMER_REAL, _AGAIN_S)  # libraries swallow it while they are imported
    sys.exit(f"it was stopped by {signal.Signals(number).name}")
