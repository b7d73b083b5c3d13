# SPDX-License-Identifier: Apache-2.0
"""Units of flight logs: by what words names state them, and what the user states of a log whose file does not."""

import math
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import Final, Literal

from sasgeo_bench.core.errors import FlightError
from sasgeo_bench.core.texts import plain
from sasgeo_bench.flights.trajectory import AXES, Axes

TimeUnit = Literal["s", "ms", "us", "ns", "none"]
HeightUnit = Literal["m", "cm", "mm", "ft", "none"]
AngleUnit = Literal["deg", "cdeg", "rad", "none"]
PlaceUnit = Literal["deg", "rad", "e7"]

SPEED_MPS: Final = 10.0  # of a log without times
FASTEST_MPS: Final = 100.0  # between two points: no drone of this benchmark is faster
LOWEST_M: Final = 5.0  # lower poses are of a drone that stands, takes off or lands
HIGHEST_M: Final = 10_000.0
LEAST_FIX: Final = 3  # of MAVLink, PX4 and ArduPilot alike: a place in three dimensions

# Option of the program, as a field or argument in Python -> least and most.
RANGES: Final = MappingProxyType(
    {
        "--speed-mps": (0.1, FASTEST_MPS),
        "--height": (LOWEST_M, HIGHEST_M),
        "--least-m": (1.0, 1e6),
        "--takeoff-height": (-500.0, 9000.0),
        "--margin-m": (0.0, 1e6),
    }
)

# Quantity -> unit -> factor to s, m or degrees.
UNITS: Final = MappingProxyType(
    {
        "time": {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9},
        "height": {"m": 1.0, "cm": 0.01, "mm": 1e-3, "ft": 0.3048},
        "angle": {"deg": 1.0, "cdeg": 0.01, "rad": math.degrees(1.0)},
        "place": {"deg": 1.0, "rad": math.degrees(1.0), "e7": 1e-7},
    }
)
_TURNS: Final = dict.fromkeys(("deg", "degs", "degree", "degrees"), "deg") | dict.fromkeys(
    ("rad", "rads", "radian", "radians"), "rad"
)
# Quantity -> end of a name -> unit.
WORDS: Final = MappingProxyType(
    {
        "time": dict.fromkeys(("s", "sec", "secs", "second", "seconds"), "s")
        | dict.fromkeys(("ms", "msec", "msecs", "millis", "millisecond", "milliseconds"), "ms")
        | dict.fromkeys(("us", "usec", "usecs", "micros", "microsecond", "microseconds"), "us")
        | dict.fromkeys(("ns", "nsec", "nsecs", "nanos", "nanosecond", "nanoseconds"), "ns"),
        "height": dict.fromkeys(("m", "meter", "meters", "metre", "metres"), "m")
        | dict.fromkeys(("cm", "centimeters", "centimetres"), "cm")
        | dict.fromkeys(("mm", "millimeters", "millimetres"), "mm")
        | dict.fromkeys(("ft", "feet", "foot"), "ft"),
        "angle": _TURNS
        | dict.fromkeys(("360",), "deg")
        | dict.fromkeys(("cdeg", "centideg", "centidegrees", "0_01_deg"), "cdeg"),
        "place": _TURNS
        | dict.fromkeys(("dd",), "deg")
        | dict.fromkeys(("e7", "1e7", "dege7", "deg_e7", "1e_7", "1e_7_deg", "1e_7deg"), "e7"),
    }
)


@dataclass(frozen=True, slots=True, kw_only=True)
class LogFacts:
    """What the file of a log does not say itself.

    Parameters
    ----------
    time_unit : {"s", "ms", "us", "ns", "none"}, optional
        Unit of a table's times whose column does not name it; "none": no column is the time.
    height_unit : {"m", "cm", "mm", "ft", "none"}, optional
        Unit of heights; "none": heights are not read.
    angle_unit : {"deg", "cdeg", "rad", "none"}, optional
        Unit of yaw, pitch and roll (cdeg: 0.01 degrees); "none": they are not read.
    place_unit : {"deg", "rad", "e7"}, optional
        Unit of latitude and longitude (e7: 1e-7 degrees).
    axes : {"up", "camera"}, optional
        Axes of a TUM file (`sasgeo_bench.flights.trajectory`).
    speed_mps : float, optional
        Even speed of a log without times, 0.1 to 100 m/s; by default 10 m/s.
    vehicle : int, optional
        System id of the vehicle in a telemetry log of several.
    takeoff_m : float, optional
        Altitude of the place of take-off, metres above the sea: heights are altitudes less it.
    dem : Path, optional
        GeoTIFF of the ground's heights above the sea: heights are altitudes less it.

    Raises
    ------
    FlightError
        If a unit or axes are none of these, or the speed is no speed of a drone.
    """

    time_unit: TimeUnit | None = None
    height_unit: HeightUnit | None = None
    angle_unit: AngleUnit | None = None
    place_unit: PlaceUnit | None = None
    axes: Axes | None = None
    speed_mps: float | None = None
    vehicle: int | None = None
    takeoff_m: float | None = None
    dem: Path | None = None

    def __post_init__(self) -> None:
        for quantity in UNITS:
            unit, choices = self.unit(quantity), choices_of(quantity)
            if unit is not None and unit not in choices:
                raise FlightError(f"{quantity}_unit must be one of {', '.join(choices)}, got {unit!r}")
        if self.axes is not None and self.axes not in AXES:
            raise FlightError(f"axes must be one of {', '.join(AXES)}, got {self.axes!r}")
        check_within("--speed-mps", self.speed_mps)
        check_within("--takeoff-height", self.takeoff_m)

    def unit(self, quantity: str) -> str | None:
        """Return the unit that the user states for a quantity."""
        units = {
            "time": self.time_unit,
            "height": self.height_unit,
            "angle": self.angle_unit,
            "place": self.place_unit,
        }
        return units[quantity]

    def check_untold(self, path: Path) -> None:
        """Raise `FlightError` if a unit is stated for a file that is no table: its format states them all."""
        for quantity in UNITS:
            if self.unit(quantity) is not None:
                raise FlightError(
                    f"{plain(path.name)} is no table, and its units are known: leave out --{quantity}-unit"
                )


def check_within(option: str, value: float | None) -> None:
    """Raise `FlightError` if a number that was given lies outside of what its option takes.

    >>> check_within("--height", float("nan"))
    Traceback (most recent call last):
        ...
    sasgeo_bench.core.errors.FlightError: --height must be a number from 5 to 10000, got nan
    """
    least, most = RANGES[option]
    if value is not None and not least <= value <= most:
        raise FlightError(f"{option} must be a number from {least:g} to {most:g}, got {value:g}")


def choices_of(quantity: str) -> tuple[str, ...]:
    """Return the units of a quantity, and "none" where it may be left out.

    >>> choices_of("place"), choices_of("angle")
    (('deg', 'rad', 'e7'), ('deg', 'cdeg', 'rad', 'none'))
    """
    return (*UNITS[quantity], *(("none",) if quantity != "place" else ()))
