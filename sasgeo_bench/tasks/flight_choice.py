# SPDX-License-Identifier: Apache-2.0
"""Choose the flights of a suite over a region: paths in one part of the split, over ground where enough is drawn."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
import shapely
from numpy.typing import NDArray

from sasgeo_bench.errors import ConfigError, FlightError
from sasgeo_bench.flights.kinematics import fly
from sasgeo_bench.flights.plans import KINDS, PlanKind, flight_area, plan_flight
from sasgeo_bench.flights.trajectory import Trajectory
from sasgeo_bench.geometry.pose import Pose, rotation
from sasgeo_bench.regions.region import Region
from sasgeo_bench.tasks.query import PriorGroup
from sasgeo_bench.tasks.sampling import drawn_share
from sasgeo_bench.tasks.split import Split
from sasgeo_bench.tasks.suites.base import Scene, Seeds, Site
from sasgeo_bench.tasks.suites.flight_plots import ChangedMapSuite, Plot, ground_of
from sasgeo_bench.tasks.suites.flights import EXTENT, HEIGHT_M, LENGTHS_M, LOITER_M, UNEVEN, FlightSuite

Floats = NDArray[np.float64]

_SCALE_CUT: Final = 2.0  # sigmas, as for views alone


@dataclass(frozen=True, kw_only=True)
class Flight:
    """A flight over a region: N views, their mean spacing, the scale that all have, and how maps are changed for it."""

    site: Site
    views: Trajectory
    spacing_m: float
    scale: float
    plot: Plot | None = None

    @property
    def length_m(self) -> float:
        """Return the distance flown from the first view to the last."""
        return float(self.views.distance_m[-1])

    @property
    def middle(self) -> int:
        """Return the index of the view in the middle."""
        return len(self.views) // 2


def pose_of(views: Trajectory, frame: int, scale: float) -> Pose:
    """Return the pose of one view."""
    east_m, north_m = views.position_m[frame, :2].tolist()
    return Pose(easting_m=east_m, northing_m=north_m, yaw_deg=float(views.yaw_deg[frame]), scale=scale)


@dataclass(frozen=True, kw_only=True)
class Airspace:
    """Where the flights of a suite may go, and the seeds of region and suite that they are drawn from."""

    region: Region
    scene: Scene
    suite: FlightSuite
    split: Split
    seeds: Seeds
    group: PriorGroup

    def seeds_of(self, index: int) -> Seeds:
        """Return the seeds of one flight."""
        return self.seeds.under("flight", index)

    def choose(self, *, count: int, may_be_fewer: bool) -> dict[int, Flight]:
        """Choose flights, by index; kinds take turns, and each is as long as the ground allows.

        All views of a flight are centred in blocks of one part of the split; all they may show is mapped. The result
        begins a sequence that does not depend on `count`. Flights may cross: what they share counts by places.

        Raises
        ------
        ConfigError
            If there is room for fewer; with `may_be_fewer`, only if there is room for none.
        """
        flights: dict[int, Flight] = {}
        for index in range(count):
            flight = self._flight(index, list(flights.values()))
            if flight is not None:
                flights[index] = flight
        if not flights or (len(flights) < count and not may_be_fewer):
            raise ConfigError(
                f"{self.scene.map.region} has room for {len(flights)} of {count} flights of suite "
                f"{self.suite.card.name!r}: too little is mapped or drawn"
                + (", lower --n or pass --up-to" if flights else "")
            )
        return flights

    def _flight(self, index: int, before: Sequence[Flight]) -> Flight | None:
        """Return the longest flight that is found, of the kind whose turn it is if possible."""
        seeds, sigmas = self.seeds_of(index), (-_SCALE_CUT, _SCALE_CUT)
        extent_m = math.sqrt(flight_area(self.region, self.suite.clear_m(self.scene)).area)
        scale = 1.0 + self.group.scale_sigma * float(np.clip(seeds.rng("scale").standard_normal(), *sigmas))
        spacing_m = float(seeds.rng("spacing").uniform(*self.suite.every_m))
        kinds = [KINDS[(index + turn) % len(KINDS)] for turn in range(len(KINDS))]
        longest_m = min(EXTENT * extent_m, self.suite.longest_m)
        for length_m in (length_m for length_m in LENGTHS_M if length_m <= longest_m):
            for kind in kinds:
                for attempt in range(6):  # paths of a kind and length before it does not fit
                    rng = seeds.rng("path", kind, f"{length_m:g}", attempt)
                    views = self._views(kind, length_m, spacing_m, rng)
                    if views is None:
                        break
                    if not self._is_in_one_part(views):
                        continue
                    plot = self._plot(views, before, rng)
                    if (plot is None) == isinstance(self.suite, ChangedMapSuite) or not self._is_drawn(views, scale):
                        continue
                    site = Site(index=index, pose=pose_of(views, 0, scale), block=self._block(views), density=0.0)
                    return Flight(site=site, views=views, spacing_m=spacing_m, scale=scale, plot=plot)
        return None

    def _plot(self, views: Trajectory, before: Sequence[Flight], rng: np.random.Generator) -> Plot | None:
        """Return how maps are changed for a flight after those before it; None if they are not, or have no room."""
        if not isinstance(self.suite, ChangedMapSuite):
            return None
        ground = ground_of(self.scene, [(flight.views, flight.plot) for flight in before if flight.plot is not None])
        return self.suite.plot(views, ground, rng)

    def elsewhere(self, flight: Flight, carried_m: float) -> Trajectory | None:
        """Return another first half for a flight, which ends so far from its middle; None if none is found."""
        area, seeds = flight_area(self.region, self.suite.clear_m(self.scene)), self.seeds_of(flight.site.index)
        # 1.5: length of the path before the carrying, in that of the half it stands for
        length_m = max(1.5 * flight.middle * flight.spacing_m, min(LENGTHS_M))
        for attempt in range(20):  # shapes of the path that may end where a carried drone is taken from
            rng = seeds.rng("carried", f"{carried_m:g}", attempt)
            views = self._views("waypoints", length_m, flight.spacing_m, rng)
            if views is None or len(views) < flight.middle:
                continue
            shape = rows(views, slice(0, flight.middle))
            for _ in range(24):  # tried for each shape
                # Turn and move a path so that it ends about `carried_m` from a place, in any direction
                # 1.25: most that a distance carried is more or less than asked for, as a factor
                middle_m = flight.views.position_m[flight.middle, :2]
                far_m = carried_m * 1.25 ** rng.uniform(-1, 1)
                bearing, turn_deg = rng.uniform(0, 2 * np.pi), float(rng.uniform(0, 360))
                position_m = shape.position_m.copy()
                end_m = middle_m + far_m * np.array([np.sin(bearing), np.cos(bearing)])
                position_m[:, :2] = end_m + (position_m[:, :2] - position_m[-1, :2]) @ rotation(turn_deg).T
                half = Trajectory.of_angles(
                    time_s=shape.time_s, position_m=position_m, yaw_deg=shape.yaw_deg + turn_deg
                )
                is_over = bool(area.covers(shapely.MultiPoint(half.position_m[:, :2])))
                if is_over and self._is_in_one_part(half, flight.views) and self._is_drawn(half, flight.scale):
                    return half
        return None

    def _views(self, kind: PlanKind, length_m: float, spacing_m: float, rng: np.random.Generator) -> Trajectory | None:
        """Return the poses of the views of a flight, None if no such path fits."""
        # Their spacing is uneven, and its mean differs from flight to flight: else it would tell how far an odometer is
        # off.
        margin_m = self.suite.clear_m(self.scene)
        length_m = min(length_m, LOITER_M) if kind == "loiter" else length_m
        try:
            path_m = plan_flight(self.region, kind, length_m=length_m, rng=rng, margin_m=margin_m)
        except FlightError:
            return None
        flown = fly(path_m, height_m=HEIGHT_M, rng=rng)
        steps_m = spacing_m * rng.uniform(*UNEVEN, math.ceil(length_m / (spacing_m * min(UNEVEN))))
        at_m = np.concatenate([[0.0], np.cumsum(steps_m)])
        return flown.at(np.interp(at_m[at_m < flown.distance_m[-1]], flown.distance_m, flown.time_s))

    def _is_in_one_part(self, *flown: Trajectory) -> bool:
        """Return whether all views are centred in blocks of one part of the split: what trains must not be tested."""
        parts = {
            next(
                (self.split.part_of(self.split.place_of[block.id]) for block in self.scene.blocks if block.holds(at)),
                None,
            )
            for views in flown
            for at in zip(*views.position_m[:, :2].T.tolist(), strict=True)
        }
        return len(parts) == 1 and None not in parts

    def _block(self, views: Trajectory) -> str:
        middle = pose_of(views, len(views) // 2, 1.0)
        return next(block.id for block in self.scene.blocks if block.holds((middle.easting_m, middle.northing_m)))

    def _is_drawn(self, views: Trajectory, scale: float) -> bool:
        variant, maps = self.suite.variants[0], (self.scene.map, *self.suite.older(self.scene))
        poses = [pose_of(views, frame, scale) for frame in range(len(views))]
        means = [np.mean([drawn_share(state, pose, variant) for pose in poses]) for state in maps]
        return float(min(means)) >= self.suite.card.min_density


def rows(views: Trajectory, which: slice) -> Trajectory:
    """Return some of the poses of a trajectory."""
    return Trajectory(
        time_s=views.time_s[which], position_m=views.position_m[which], quaternion_xyzw=views.quaternion_xyzw[which]
    )
