# SPDX-License-Identifier: Apache-2.0
"""Suite `flight-off-map`: flights that leave the map and come back to it."""

import math
from typing import Final

import numpy as np
import shapely
from numpy.typing import NDArray

from sasgeo_bench.flights.trajectory import Trajectory
from sasgeo_bench.tasks.suites.base import SuiteCard, Variant
from sasgeo_bench.tasks.suites.flight_plots import (
    STRETCHES_M,
    ChangedMapSuite,
    Floats,
    Ground,
    MapChange,
    Plot,
    stretches_m,
)
from sasgeo_bench.tasks.suites.flights import SEQUENCE, START

OFF_MAP: Final = "off_map_m"  # measured: flown off the map
LOST: Final = "lost_m2"  # measured: what the map lost
_WITHIN: Final = (0.9, 1.2)  # of what is asked for, that the longest stretch measures: a hole's size comes in steps
_RADII: Final = np.linspace(0.4, 0.8, 9)  # of the hole, in lengths of the stretch: half, where it is straight


class FlightOffMapSuite(ChangedMapSuite):
    """One map has lost a disc that the flight passes through, the other one as much where the flight does not go."""

    def plot(self, views: Trajectory, ground: Ground, rng: np.random.Generator) -> Plot | None:
        """Cut the longest stretch that fits out of the map, and a disc of the same area near the flight."""
        place_m, flown_m = views.position_m[:, :2], views.distance_m
        if not ground.admits(place_m):
            return None
        for stretch_m in stretches_m(float(flown_m[-1])):
            hole = _hole(place_m, flown_m, stretch_m, ground, rng)
            other = None if hole is None else _elsewhere(hole, place_m, ground, rng)
            if hole is None or other is None:
                continue
            off_m = float(lengths_within(hole, place_m, flown_m).sum())
            return Plot(
                strength=stretch_m,
                stress=MapChange(area=hole, measured={OFF_MAP: round(off_m, 1), LOST: round(hole.area)}),
                falsifier=MapChange(area=other, measured={OFF_MAP: 0.0, LOST: round(other.area)}),
            )
        return None


def lengths_within(area: shapely.Polygon, place_m: Floats, flown_m: Floats) -> Floats:
    """Return how much is flown in an area on each step from view to view, metres, shape (N - 1,).

    A step with one end inside counts half.

    >>> path = np.column_stack([np.zeros(5), np.arange(0.0, 500.0, 100.0)])
    >>> lengths_within(shapely.box(-50, 150, 50, 450), path, path[:, 1]).tolist()
    [0.0, 50.0, 100.0, 100.0]
    """
    return _parts_m(np.asarray(shapely.contains_xy(area, *place_m.T)), flown_m)


def _parts_m(inside: NDArray[np.bool_], flown_m: Floats) -> Floats:
    return np.asarray(np.diff(flown_m) * (inside[:-1].astype(float) + inside[1:]) / 2)


def _hole(
    place_m: Floats, flown_m: Floats, stretch_m: float, ground: Ground, rng: np.random.Generator
) -> shapely.Polygon | None:
    """Return a disc that a flight passes through once for about a given length; None if none is found."""
    # Of several the one is taken of which the flight sees least at other times. The first and the last view see all of
    # their ground on the map.
    low_m, high_m = (share * flown_m[-1] for share in (0.2, 0.8))  # of a flight, where it may be off the map
    middles = np.flatnonzero((flown_m > low_m) & (flown_m < high_m))
    found: list[tuple[float, shapely.Polygon]] = []
    for _ in range(40 if len(middles) else 0):  # tried for each length
        # 0.6 of its radius, by which the middle of the hole may lie off the path
        middle, turn, aside = place_m[rng.choice(middles)], rng.uniform(0, 2 * np.pi), 0.6 * rng.random()
        for radius_m in stretch_m * _RADII:
            center_m = middle + aside * radius_m * np.array([np.sin(turn), np.cos(turn)])
            off_m = np.hypot(*(place_m - center_m).T)
            inside = off_m < radius_m
            # How much is flown inside: in the longest run of views, and in all together
            parts_m = _parts_m(inside, flown_m)
            run = np.cumsum(~inside)[:-1]  # a step from or to a view outside belongs to the run that it touches
            longest_m, total_m = float(np.bincount(run, parts_m).max()), float(parts_m.sum())
            if longest_m < _WITHIN[0] * stretch_m:
                continue
            is_between = low_m <= flown_m[inside].min() and flown_m[inside].max() <= high_m
            is_on = min(off_m[0], off_m[-1]) > radius_m + ground.reach_m
            # 1.3: the longest stretch, that all together measure: a flight passes through its hole once
            if longest_m <= _WITHIN[1] * stretch_m and is_between and is_on and total_m <= 1.3 * longest_m:
                hole = shapely.Point(center_m).buffer(radius_m, quad_segs=16)
                if ground.mapped.contains(hole) and ground.is_free(hole):
                    found.append((total_m - longest_m, hole))
            break
    return min(found, key=lambda item: item[0])[1] if found else None


def _elsewhere(
    hole: shapely.Polygon, place_m: Floats, ground: Ground, rng: np.random.Generator
) -> shapely.Polygon | None:
    """Return the disc of the size of a hole that lies nearest to a flight and out of its sight; None without one."""
    radius_m = math.sqrt(hole.area / math.pi)
    west, south, east, north = ground.mapped.bounds
    centers_m = rng.uniform((west, south), (east, north), (400, 2))  # 400 places tried for the hole of the falsifier
    near_m = shapely.distance(shapely.points(centers_m), shapely.MultiPoint(place_m))
    for at in np.argsort(near_m):
        if near_m[at] > radius_m + ground.reach_m:
            other = shapely.affinity.translate(hole, *(centers_m[at] - hole.centroid.coords[0]))
            if ground.mapped.contains(other) and not other.intersects(hole) and ground.is_free(other, place_m):
                return other
    return None


SUITE: Final = FlightOffMapSuite(
    card=SuiteCard(
        name="flight-off-map",
        version=1,
        title="Off the map (F7)",
        what="In its middle the flight is over ground that the searched map does not know, for 1 km, 500 m or 250 m, "
        "the longest that fits, and comes back. What is seen is the control's.",
        separates='Trackers that can say "none of these" from those that must choose.',
        falsifier="The map loses as much ground elsewhere, out of sight of the flight.",
        strength_unit="m flown off the map, about: off_map_m is how far",
        group=START,
        tracks=SEQUENCE,
        min_density=0.05,
    ),
    variants=(
        Variant(role="control", kind="whole map"),
        *(Variant(role="stress", kind="F7 off the map", strength=length_m) for length_m in sorted(STRETCHES_M)),
        Variant(role="falsifier", kind="ground lost elsewhere"),
    ),
)
