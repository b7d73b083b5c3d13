# SPDX-License-Identifier: Apache-2.0
"""Base of the suites of flights whose maps are changed: what is done to them for each flight, and where there is room.

A task has many flights, and whole countries are large, so all flights share two maps. Each map is changed for every
flight: one of the two where its stress needs it, the other where its falsifier does. Which of the two is which takes
turns, so the name of a map does not tell.
"""

from abc import abstractmethod
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Final, Literal

import numpy as np
import shapely
from numpy.typing import NDArray

from sasgeo_bench.flights.trajectory import Trajectory
from sasgeo_bench.tasks.suites.base import Scene, Variant
from sasgeo_bench.tasks.suites.flights import FlightSuite
from sasgeo_bench.tasks.twin import Paste, paste, without

if TYPE_CHECKING:
    import geopandas as gpd

Floats = NDArray[np.float64]

STRETCHES_M: Final = (1000.0, 500.0, 250.0)  # of a flight, the longest that fits
SHARES: Final = (0.1, 1 / 3)  # of a flight that such a stretch takes
MAPS: Final = 2


@dataclass(frozen=True, kw_only=True)
class MapChange:
    """Ground of a map that is changed for one flight: pasted over, or cut away where there is no `paste`.

    `measured` is what a truth says of it.
    """

    area: shapely.Polygon
    paste: Paste | None = None
    measured: dict[str, float] = field(default_factory=dict)


@dataclass(frozen=True, kw_only=True)
class Plot:
    """Changes of the maps for one flight; `strength` is that of the stress that is drawn of it.

    `copy_m` leads from a place of the flight to the one that looks the same, east and north.
    """

    strength: float
    stress: MapChange
    falsifier: MapChange
    copy_m: tuple[float, float] | None = None

    def of(self, role: Literal["stress", "falsifier"]) -> MapChange:
        """Return the change that a stress or a falsifier needs."""
        return self.stress if role == "stress" else self.falsifier

    @property
    def areas(self) -> tuple[shapely.Polygon, shapely.Polygon]:
        """Return the ground of both changes."""
        return self.stress.area, self.falsifier.area


@dataclass(frozen=True, kw_only=True)
class Ground:
    """Where maps may be changed: mapped ground, less what other flights see and what is changed for them.

    `reach_m` is the largest distance that a view shows from its middle.
    """

    mapped: shapely.Geometry
    reach_m: float
    cell_m: float
    seen_m: Floats = field(default_factory=lambda: np.zeros((0, 2)))  # middles of views, (N, 2)
    changed: tuple[shapely.Polygon, ...] = ()

    def is_free(self, area: shapely.Polygon, *own_m: Floats) -> bool:
        """Return whether ground is out of sight of all other flights and of views given, and not changed yet."""
        seen = shapely.MultiPoint(np.concatenate([self.seen_m, *own_m]))
        return bool(shapely.distance(area, seen) > self.reach_m if len(seen.geoms) else True) and not any(
            shapely.intersects(area, list(self.changed))
        )

    def admits(self, places_m: Floats) -> bool:
        """Return whether views, shape (N, 2), show nothing of what is changed for other flights."""
        seen = shapely.MultiPoint(places_m)
        return all(shapely.distance(area, seen) > self.reach_m for area in self.changed)


@dataclass(frozen=True, kw_only=True)
class ChangedMapSuite(FlightSuite):
    """A suite of flights that search a changed copy of the map; the control searches the map as it is."""

    def usable(self, scene: Scene) -> tuple[Variant, ...]:  # noqa: ARG002 - the ground of each flight decides
        """Return all variants."""
        return self.variants

    @abstractmethod
    def plot(self, views: Trajectory, ground: Ground, rng: np.random.Generator) -> Plot | None:
        """Return what is to be done to the maps for a flight; None where there is no room for it."""

    def map_of(self, scene: Scene, variant: Variant, site: int) -> str:
        """Return the map that is changed for a variant of a flight."""
        if variant.role == "control":
            return scene.map.region
        return scene.others[(site + (variant.role == "falsifier")) % MAPS].region


def ground_of(scene: Scene, before: Iterable[tuple[Trajectory, Plot]]) -> Ground:
    """Return where a map may be changed for the next flight, after the flights before it."""
    flights = list(before)
    return Ground(
        mapped=scene.map.coverage.intersection(shapely.box(*scene.map.grid.bounds_m)),
        reach_m=scene.view_reach_m,
        cell_m=scene.map.grid.cell_size_m,
        seen_m=np.concatenate([np.zeros((0, 2)), *(views.position_m[:, :2] for views, _ in flights)]),
        changed=tuple(area for _, plot in flights for area in plot.areas),
    )


def stretches_m(length_m: float) -> tuple[float, ...]:
    """Return the stretches that suit a flight of a length, the longest first.

    >>> stretches_m(1950.0), stretches_m(9800.0)
    ((500.0, 250.0), (1000.0,))
    """
    least, most = SHARES
    return tuple(item for item in STRETCHES_M if least * length_m <= item <= most * length_m)


def changes_of(plots: Sequence[tuple[int, Plot]], number: int) -> list[MapChange]:
    """Return the changes of one of the maps, 0 or 1, for flights by the index of their site."""
    return [plot.of("stress" if site % MAPS == number else "falsifier") for site, plot in plots]


def changed(
    features: "gpd.GeoDataFrame", coverage: shapely.Geometry, changes: Sequence[MapChange]
) -> tuple["gpd.GeoDataFrame", shapely.Geometry]:
    """Return the features and the mapped area of a map after its changes."""
    lost = shapely.union_all([item.area for item in changes if item.paste is None])
    features = paste(features, [item.paste for item in changes if item.paste is not None])
    return (features, coverage) if lost.is_empty else (without(features, lost), coverage.difference(lost))
