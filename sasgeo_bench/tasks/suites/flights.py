# SPDX-License-Identifier: Apache-2.0
"""Base of the suites whose queries are the views of a flight, in order, with what an odometer says between them."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

from sasgeo_bench.flights.odometry import Belief
from sasgeo_bench.tasks.query import PriorGroup, Track
from sasgeo_bench.tasks.suites.base import Draft, Scene, Shot, Suite, Variant

SPACING_M: Final = (40.0, 60.0)  # flown between two views, on average: each flight has its own
UNEVEN: Final = (0.7, 1.3)  # single steps in that average: were they even, they would tell an odometer's scale
HEIGHT_M: Final = 120.0  # above the ground: a view of 192 m is 1.6 times as wide
LENGTHS_M: Final = (10_000.0, 4_000.0, 2_000.0, 1_000.0)  # of a flight, the longest that suits the ground
LOITER_M: Final = 2_000.0  # of a loiter at most: more laps would see the same ground again
EXTENT: Final = 2.5  # a flight is at most so many times as long as the square root of the ground's area
START: Final = PriorGroup(radius_m=500.0, yaw="weak", scale_sigma=0.03)
AGAIN: Final = "again"  # names other draws of perception and odometry, for falsifiers
SEQUENCE: Final[tuple[Track, ...]] = ("sequence",)  # tracks of all these suites


@dataclass(frozen=True, slots=True, kw_only=True)
class Mission:
    """What happens on the flights of a variant.

    Parameters
    ----------
    profile : str
        Drift profile of the odometer (`flights.drift_profile`).
    belief : {"honest", "optimistic"}
        Covariances that fit the drift, or standard deviations a third of these.
    group : PriorGroup, optional
        What is known at the first view; the suite's own group unless given.
    gaps_m : tuple of float
        Lengths of the stretch in the middle of the flight where no view shows anything: the longest that is at most a
        third of the flight. Where none is, the flight is left out.
    is_scattered : bool
        Whether as many views show nothing, spread evenly over the flight, instead of those of the gap.
    carried_m : float
        The drone begins elsewhere and is carried so far, unseen, to the middle of the flight; 0 for not at all.
    is_lost : bool
        Whether the odometer says nothing of the step to the middle. Otherwise that of a carried drone says the
        control's step, as if nothing had happened.
    draw : str
        Names other draws of perception and odometry: variants of one name have the same.
    """

    profile: str = "vo-mono-survey"  # profile of the odometer where a suite is not about drift
    belief: Belief = "honest"
    group: PriorGroup | None = None
    gaps_m: tuple[float, ...] = ()
    is_scattered: bool = False
    carried_m: float = 0.0
    is_lost: bool = False
    draw: str = ""


def uneventful(variant: Variant) -> Mission:
    """Return the mission of a flight on which nothing happens."""
    del variant
    return Mission()


@dataclass(frozen=True, kw_only=True)
class FlightSuite(Suite):
    """A suite of flights: all variants at a site fly the same way, and `mission` says what happens on it.

    `every_m` are the bounds of a flight's mean spacing of views, and `longest_m` of its length.
    """

    mission: Callable[[Variant], Mission] = uneventful
    every_m: tuple[float, float] = SPACING_M
    longest_m: float = max(LENGTHS_M)

    def draw(self, shot: Shot) -> Draft:
        """Perceive one view."""
        return Draft(evidence=shot.perceived())

    def map_of(self, scene: Scene, variant: Variant, site: int) -> str:  # noqa: ARG002 - all sites are alike
        """Return the name of the map that a variant searches at a site, given by its index."""
        return self.map_region(scene, variant)


def carries(scene: Scene, distance_m: float) -> bool:
    """Return whether a drone can be carried so far over the map: half of its longer side, or less."""
    west, south, east, north = scene.map.grid.bounds_m
    return distance_m <= max(east - west, north - south) / 2
