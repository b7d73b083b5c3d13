# SPDX-License-Identifier: Apache-2.0
"""Items of another benchmark's dataset: queries and gallery, with what the set says of each."""

import datetime as dt
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final, Literal, Self

import numpy as np
import pyproj
from numpy.typing import NDArray

from sasgeo_bench.core.errors import DatasetError
from sasgeo_bench.geometry.grid import utm_epsg
from sasgeo_bench.geometry.projection import from_lonlat

Role = Literal["query", "gallery", "train", "unsplit"]
MOST_ITEMS: Final = 1_000_000
_LOWEST_M: Final = -1_000.0
_HIGHEST_M: Final = 30_000.0


@dataclass(frozen=True, slots=True, kw_only=True)
class Position:
    """Longitude and latitude of WGS 84, degrees; `DatasetError` outside -180..180 and the latitudes of UTM.

    >>> Position(longitude_deg=30.3, latitude_deg=120.1)
    Traceback (most recent call last):
        ...
    sasgeo_bench.core.errors.DatasetError: longitude 30.3, latitude 120.1 is no place: longitudes lie within -180..180,
    latitudes within -80..84 (are the two swapped?)
    """

    longitude_deg: float
    latitude_deg: float

    def __post_init__(self) -> None:
        """Refuse what lies on no map of ours."""
        low, high = -80.0, 84.0  # of UTM
        if -180 <= self.longitude_deg <= 180 and low <= self.latitude_deg <= high:  # degrees of longitude
            return
        is_swapped = low <= self.longitude_deg <= high < abs(self.latitude_deg) <= 180  # as above
        hint = " (are the two swapped?)" if is_swapped else ""
        raise DatasetError(
            f"longitude {self.longitude_deg!r}, latitude {self.latitude_deg!r} is no place: longitudes lie within "
            f"-180..180, latitudes within {low:g}..{high:g}{hint}"
        )


@dataclass(frozen=True, slots=True, kw_only=True)
class Box:
    """Edges in degrees of WGS 84; `DatasetError` unless west < east and south < north."""

    west_deg: float
    south_deg: float
    east_deg: float
    north_deg: float

    def __post_init__(self) -> None:
        if not (self.west_deg < self.east_deg and self.south_deg < self.north_deg):
            raise DatasetError(
                f"a box grows from west to east and from south to north, got west {self.west_deg!r}, south "
                f"{self.south_deg!r}, east {self.east_deg!r}, north {self.north_deg!r}"
            )

    @property
    def centre(self) -> Position:
        """Return the middle of the box."""
        return Position(
            longitude_deg=(self.west_deg + self.east_deg) / 2, latitude_deg=(self.south_deg + self.north_deg) / 2
        )

    def contains(self, position: Position) -> bool:
        """Return whether a place lies in the box; its west and south edges belong to it, the others to the next box."""
        is_between = self.west_deg <= position.longitude_deg < self.east_deg
        return is_between and self.south_deg <= position.latitude_deg < self.north_deg


@dataclass(frozen=True, slots=True, kw_only=True)
class Attitude:
    """Angles of a camera as its set gives them, degrees; None where it gives none.

    Parameters
    ----------
    heading_deg : float, optional
        Clockwise from true north, [0, 360).
    pitch_deg, roll_deg : float, optional
        As in the file: their zero and their sign are those of the set.
    """

    heading_deg: float | None = None
    pitch_deg: float | None = None
    roll_deg: float | None = None

    def __post_init__(self) -> None:
        """Refuse angles that are not finite; bring the heading into its range."""
        given = [value for value in (self.heading_deg, self.pitch_deg, self.roll_deg) if value is not None]
        if not all(map(math.isfinite, given)):
            raise DatasetError(f"angles must be finite, got {given!r}")
        if self.heading_deg is not None:
            object.__setattr__(self, "heading_deg", self.heading_deg % 360.0 % 360.0)


@dataclass(frozen=True, slots=True, kw_only=True)
class Item:
    """One image of a dataset, or one tile of a map that it cuts.

    Parameters
    ----------
    item_id : str
        The image's path inside the folder, with slashes; the name of a tile.
    role : {"query", "gallery", "train", "unsplit"}
        Use in the set's own evaluation; "unsplit" where the folder says nothing of it.
    view : str
        Kind of picture: drone, satellite, street, ...
    label : str, optional
        Items of one label show one place. None where positions tell what belongs together.
    group : str, optional
        Flight or flying height; what the set reports separately.
    position : Position, optional
        Place of the image's centre; None where the set has no coordinates.
    box : Box, optional
        Ground of a tile.
    height_m : float, optional
        Flying height as in the set; its datum is the set's own.
    attitude : Attitude, optional
        Angles of the camera.
    taken_on : datetime.date, optional
        Day of the image.
    """

    item_id: str
    role: Role
    view: str
    label: str | None = None
    group: str | None = None
    position: Position | None = None
    box: Box | None = None
    height_m: float | None = None
    attitude: Attitude | None = None
    taken_on: dt.date | None = None

    def __post_init__(self) -> None:
        if not self.item_id.isprintable():
            raise DatasetError(f"an item needs a name of one printable line, got {self.item_id!a}")
        if self.height_m is not None and not _LOWEST_M <= self.height_m <= _HIGHEST_M:
            raise DatasetError(
                f"{self.item_id}: heights lie within {_LOWEST_M:g}..{_HIGHEST_M:g} m, got {self.height_m!r}"
            )


@dataclass(frozen=True, slots=True, kw_only=True)
class DatasetCard:
    """Name, origin and terms of a dataset; `kind` is its name on the command line, `source` where its code is."""

    kind: str
    title: str
    source: str
    licence: str
    attribution: str


@dataclass(frozen=True, slots=True, kw_only=True)
class Dataset:
    """Everything that an importer read: a card, the items, and what it left out or took on trust, a line each."""

    card: DatasetCard
    items: tuple[Item, ...]
    notes: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        """Refuse an empty set, one that is too large, and two items of one name."""
        if not 0 < len(self.items) <= MOST_ITEMS:
            raise DatasetError(f"a {self.card.title} folder holds 1 to {MOST_ITEMS} images, got {len(self.items)}")
        seen: set[str] = set()
        for item in self.items:
            if item.item_id in seen:
                raise DatasetError(f"two items are named {item.item_id!r}: rename one")
            seen.add(item.item_id)

    def count(self, role: Role) -> int:
        """Return how many items have a role."""
        return sum(item.role == role for item in self.items)


@dataclass(frozen=True, slots=True, kw_only=True)
class UtmPlaces:
    """Places in the plain UTM zone of each: EPSG code, easting and northing (metres), meridian convergence (degrees).

    All have shape (N,). The convergence is the bearing of grid north, clockwise from true north.
    """

    epsg: NDArray[np.int64]
    easting_m: NDArray[np.float64]
    northing_m: NDArray[np.float64]
    convergence_deg: NDArray[np.float64]

    @classmethod
    def of(cls, positions: Sequence[Position]) -> Self:
        """Project places, each into its own zone.

        A flight due north, 3 degrees west of the zone's middle, has grid bearing 1.5: 0 less the convergence.

        >>> flight = UtmPlaces.of([Position(longitude_deg=120.0, latitude_deg=y) for y in (30.0, 30.01)])
        >>> bearing_deg = np.degrees(np.arctan2(np.diff(flight.easting_m), np.diff(flight.northing_m)))
        >>> (float(bearing_deg[0].round(2)), float(flight.convergence_deg[0].round(2)))
        (1.5, -1.5)
        """
        lonlat = np.array([(item.longitude_deg, item.latitude_deg) for item in positions]).reshape(-1, 2)
        epsg = np.array([utm_epsg(*pair) for pair in lonlat.tolist()], dtype=np.int64)
        found = np.empty((3, len(lonlat)))
        for code in np.unique(epsg):
            here = epsg == code
            lon_deg, lat_deg = lonlat[here].T
            found[:2, here] = from_lonlat(int(code)).transform(lon_deg, lat_deg)
            factors = pyproj.Proj(int(code)).get_factors(lon_deg, lat_deg)
            found[2, here] = factors.meridian_convergence
        return cls(epsg=epsg, easting_m=found[0], northing_m=found[1], convergence_deg=found[2])
