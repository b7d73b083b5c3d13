# SPDX-License-Identifier: Apache-2.0
"""What the kernel tells of heat, clock and energy of this computer; None where it tells nothing."""

import platform
from collections.abc import Iterator
from pathlib import Path
from typing import Final

import psutil

_SYS: Final = Path("/sys")
_PER_DEGREE: Final = 1e3


def hottest_celsius(root: Path = _SYS) -> float | None:
    """Return the temperature of the hottest zone, degrees Celsius; of zones that say something possible."""
    found = (_number(path) for path in (root / "class/thermal").glob("thermal_zone*/temp"))
    celsius = (milli / _PER_DEGREE for milli in found if milli)
    return max((value for value in celsius if -50 < value < 200), default=None)  # others are no sensor


def clock_mhz() -> float | None:
    """Return the present clock of the processor, the mean of its cores."""
    found = psutil.cpu_freq()
    return None if found is None or not found.current else float(found.current)


class EnergyMeter:
    """Counts the joules of all processor packages of this computer, whatever uses them.

    Examples
    --------
    >>> EnergyMeter(Path("nowhere")).joules() is None
    True
    """

    def __init__(self, root: Path = _SYS) -> None:
        self._counters = [path for path in _packages(root) if _number(path / "energy_uj") is not None]
        self._last = [_number(path / "energy_uj") or 0 for path in self._counters]
        self._sum = 0

    def joules(self) -> float | None:
        """Return the joules since it was made; None without counters. Call it now and then: counters wrap around."""
        if not self._counters:
            return None
        for at, path in enumerate(self._counters):
            now = _number(path / "energy_uj") or 0
            grown = now - self._last[at]
            self._sum += grown if grown >= 0 else grown + (_number(path / "max_energy_range_uj") or 0)
            self._last[at] = now
        return self._sum / 1e6  # microjoules in a joule


def processor_name(info: Path = Path("/proc/cpuinfo")) -> str:
    """Return the name of the processor as its maker gives it, or the kind of machine."""
    try:
        lines = info.read_text(encoding="utf-8", errors="replace").splitlines()
    except OSError:
        lines = []
    named = (line.partition(":")[2].strip() for line in lines if line.startswith(("model name", "Model", "Hardware")))
    return next(filter(None, named), platform.machine())


def _packages(root: Path) -> Iterator[Path]:
    yield from (path for path in sorted((root / "class/powercap").glob("*:*")) if path.name.count(":") == 1)


def _number(path: Path) -> int | None:
    """Read a whole number, or None."""
    try:
        return int(path.read_text(encoding="ascii"))
    except (OSError, ValueError):
        return None
