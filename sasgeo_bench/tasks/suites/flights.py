# SPDX-License-Identifier: Apache-2.0
"""Suites whose queries are the views of a flight in order, with what an odometer says between them."""

import math
from abc import abstractmethod
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import TYPE_CHECKING, Final, Literal

import numpy as np
import shapely
import shapely.affinity
from numpy.typing import NDArray

from sasgeo_bench.flights.odometry import Belief
from sasgeo_bench.flights.trajectory import Trajectory
from sasgeo_bench.sensing.rendering.seasons import Season
from sasgeo_bench.tasks.query import RADII_M, PriorGroup, Track
from sasgeo_bench.tasks.suites.ages import AGES_YEARS, age_years, has_age, map_of_age
from sasgeo_bench.tasks.suites.base import QueryDraft, Scene, Suite, SuiteCard, Variant, ViewRequest
from sasgeo_bench.tasks.suites.pictures import Flight, PictureSuite
from sasgeo_bench.tasks.suites.twins import RIVAL_M
from sasgeo_bench.tasks.twin import Paste, mirror, paste, without

if TYPE_CHECKING:
    import geopandas as gpd

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
    takes_log : bool
        Whether odometry of the log of a flight that was flown takes the place of what is drawn by the profile, where it
        has some, and a profile of one's own that of this one. A variant that is about a profile keeps it.
    """

    profile: str = "vo-mono-survey"  # profile of the odometer where a suite is not about drift
    belief: Belief = "honest"
    group: PriorGroup | None = None
    gaps_m: tuple[float, ...] = ()
    is_scattered: bool = False
    carried_m: float = 0.0
    is_lost: bool = False
    draw: str = ""
    takes_log: bool = True


def uneventful(variant: Variant) -> Mission:
    """Return the mission of a flight on which nothing happens."""
    del variant
    return Mission()


@dataclass(frozen=True, kw_only=True)
class FlightSuite(Suite):
    """A suite of flights: all variants at a site fly the same way, and `mission` says what happens on it.

    `every_m` are the bounds of a flight's mean spacing of views, and `longest_m` of its length. Variants `of_own` are
    added on a flight that was flown with an odometer of its own: that of its log, or of a profile that was measured.
    """

    mission: Callable[[Variant], Mission] = uneventful
    of_own: tuple[Variant, ...] = ()
    every_m: tuple[float, float] = SPACING_M
    longest_m: float = max(LENGTHS_M)

    def draw(self, shot: ViewRequest) -> QueryDraft:
        """Perceive one view."""
        return QueryDraft(evidence=shot.perceived())

    def look(self, variant: Variant) -> Variant:
        """Return a variant whose views show the same from the same poses, the same one for as many as possible."""
        if type(self).draw is not FlightSuite.draw:  # what a suite draws itself may depend on anything
            return variant
        return replace(variant, role="control", kind="control", strength=0.0)

    def map_of(self, scene: Scene, variant: Variant, site: int) -> str:  # noqa: ARG002 - all sites are alike
        """Return the name of the map that a variant searches at a site, given by its index."""
        return self.map_region(scene, variant)


def carries(scene: Scene, distance_m: float) -> bool:
    """Return whether a drone can be carried so far over the map: half of its longer side, or less."""
    west, south, east, north = scene.map.grid.bounds_m
    return distance_m <= max(east - west, north - south) / 2


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
        middle, turn, off_share = place_m[rng.choice(middles)], rng.uniform(0, 2 * np.pi), 0.6 * rng.random()
        for radius_m in stretch_m * _RADII:
            center_m = middle + off_share * radius_m * np.array([np.sin(turn), np.cos(turn)])
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


FLIGHT_OFF_MAP: Final = FlightOffMapSuite(
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


_RIM_M: Final = 8.0  # copied beyond what views show: cells at the rim of a copy may differ


_ON_PATH_M: Final = 1.0  # nearer to the stretch, a view sees what was copied


class FlightAliasSuite(ChangedMapSuite):
    """One map shows the ground of the first stretch a second time, the other one shows it there as in a mirror."""

    def refusal(self, group: PriorGroup) -> str | None:
        """Refuse a disc that cannot hold the start and its copy."""
        if group.radius_m is None or 2 * group.radius_m > RIVAL_M:
            return super().refusal(group)
        least = min(radius_m for radius_m in RADII_M if radius_m and 2 * radius_m > RIVAL_M)
        return f"needs a disc that holds two places up to {RIVAL_M:g} m apart: use r{least:g} or more"

    def clear_m(self, scene: Scene) -> float:
        """Return how far around the path ground is copied."""
        return super().clear_m(scene) + _RIM_M

    def plot(self, views: Trajectory, ground: Ground, rng: np.random.Generator) -> Plot | None:
        """Copy the ground of the longest stretch that fits, out of sight of the flight."""
        place_m, flown_m = views.position_m[:, :2], views.distance_m
        if not ground.admits(place_m):
            return None
        for stretch_m in stretches_m(float(flown_m[-1])):
            hull = shapely.MultiPoint(place_m[flown_m <= stretch_m]).convex_hull.buffer(_ON_PATH_M)
            area = hull.buffer(ground.reach_m + _RIM_M)
            # 1.25 of the stretch, at most, is flown over the copied ground: who comes back knows it by then
            is_left = lengths_within(hull, place_m, flown_m).sum() <= 1.25 * stretch_m
            copy_m = _room(area, place_m, ground, rng) if is_left else None
            if copy_m is not None:
                # Copy of an area, and the copy of its mirror image, both of the same outline
                middle_m = _middle_m(area)
                radius_m = float(shapely.hausdorff_distance(shapely.Point(middle_m), area)) + _RIM_M
                target_m = (middle_m[0] + copy_m[0], middle_m[1] + copy_m[1])
                plain = Paste(source_m=middle_m, target_m=target_m, radius_m=radius_m, outline=area)

                stress, falsifier = plain, replace(plain, change=partial(mirror, classes=None, center_m=middle_m))
                facts = {"copy_m": round(float(np.hypot(*copy_m)), 1)}
                return Plot(
                    strength=stretch_m,
                    stress=MapChange(area=stress.area, paste=stress, measured=facts),
                    falsifier=MapChange(area=falsifier.area, paste=falsifier, measured=facts),
                    copy_m=copy_m,
                )
        return None


def _room(
    area: shapely.Polygon, place_m: Floats, ground: Ground, rng: np.random.Generator
) -> tuple[float, float] | None:
    """Return how far east and north an area has room a second time: whole cells, so that its cells are the same."""
    # 2000 are tried for the copy
    shifts_m = np.rint(rng.uniform(-RIVAL_M, RIVAL_M, (2000, 2)) / ground.cell_m) * ground.cell_m
    mirrored = shapely.affinity.scale(area, xfact=-1.0, yfact=1.0, origin=_middle_m(area))
    if not ground.mapped.contains(shapely.union(area, mirrored)):
        return None
    room_m = np.array(ground.mapped.bounds) - area.bounds  # west, south, east, north of it: the box is checked first
    is_near = np.hypot(*shifts_m.T) < RIVAL_M
    is_within = ((shifts_m >= room_m[:2]) & (shifts_m <= room_m[2:])).all(axis=1)
    for shift_m in shifts_m[is_near & is_within].tolist():
        copy = shapely.affinity.translate(area, *shift_m)
        is_clear = not copy.intersects(area)
        if is_clear and ground.mapped.contains(copy) and ground.is_free(copy, place_m):
            return (shift_m[0], shift_m[1])
    return None


def _middle_m(area: shapely.Polygon) -> tuple[float, float]:
    west, south, east, north = area.bounds
    return ((west + east) / 2, (south + north) / 2)


FLIGHT_ALIAS: Final = FlightAliasSuite(
    card=SuiteCard(
        name="flight-alias",
        version=1,
        title="Repeated ground (F8)",
        what="The searched map shows the ground of the first 1 km, 500 m or 250 m of the flight, the longest that "
        "fits, a second time, up to 800 m away and within the disc of the start: no view there tells which it is, and "
        "no turn. Only the way out does.",
        separates="Trackers that keep two hypotheses until one is right, and say so, from those that pick one.",
        falsifier="The second time the ground is as in a mirror: as much of the map is changed, and it does not fit.",
        strength_unit="m of the flight that the map shows twice, about: is_copied says which views",
        group=START,
        tracks=SEQUENCE,
        min_density=0.05,
    ),
    variants=(
        Variant(role="control", kind="no copy"),
        *(Variant(role="stress", kind="F8 copied start", strength=length_m) for length_m in sorted(STRETCHES_M)),
        Variant(role="falsifier", kind="mirror image"),
    ),
)


PROFILES: Final = ("vo-mono-survey", "wheel-poor", "vio-stereo", "vio-mono")  # by their drift after kilometres
_KIND: Final = "F1"
_OWN: Final = f"{_KIND} own odometer"


def _clean_mission(variant: Variant) -> Mission:
    if variant.kind == _OWN:
        return Mission()
    if variant.role == "stress":
        return Mission(profile=variant.kind.removeprefix(f"{_KIND} "), takes_log=False)
    return Mission(profile="perfect", draw=AGAIN if variant.role == "falsifier" else "", takes_log=False)


FLIGHT_CLEAN: Final = FlightSuite(
    card=SuiteCard(
        name="flight-clean",
        version=1,
        title="Drift of odometry (F1)",
        what="A flight over today's map, a view every 40 to 60 m, with the usual errors of perception and an odometer "
        "of each kind there is a profile of; the control's does not drift.",
        separates="What a map gives back of what drift takes.",
        falsifier="No drift again, with other errors of perception.",
        strength_unit="place of the odometer in the order of drift",
        group=START,
        tracks=SEQUENCE,
        min_density=0.05,
    ),
    variants=(
        Variant(role="control", kind="no drift"),
        *(
            Variant(role="stress", kind=f"{_KIND} {profile}", strength=float(order))
            for order, profile in enumerate(PROFILES, start=1)
        ),
        Variant(role="falsifier", kind="no drift again"),
    ),
    mission=_clean_mission,
    of_own=(Variant(role="stress", kind=_OWN, strength=float(len(PROFILES) + 1)),),
)


GAPS_M: Final = (500.0, 1000.0)
SCATTERED: Final = "as many views, scattered"


def _gap_mission(variant: Variant) -> Mission:
    if variant.kind == SCATTERED:
        return Mission(gaps_m=GAPS_M, is_scattered=True)
    return Mission(gaps_m=(variant.strength,) if variant.role == "stress" else ())


FLIGHT_GAP: Final = FlightSuite(
    card=SuiteCard(
        name="flight-gap",
        version=1,
        title="Unseen stretch (F4)",
        what="In the middle of the flight no view shows anything for 500 m or 1 km, as in cloud or over a lake; the "
        "odometer goes on. A gap is a third of the flight at most.",
        separates="Trackers whose belief grows with the drift from those that go on with what was right before.",
        falsifier="As many views show nothing as in the longest gap of the flight, spread evenly over it.",
        strength_unit="m flown without a view",
        group=START,
        tracks=SEQUENCE,
        min_density=0.05,
    ),
    variants=(
        Variant(role="control", kind="no gap"),
        *(Variant(role="stress", kind="F4 gap", strength=length_m) for length_m in GAPS_M),
        Variant(role="falsifier", kind=SCATTERED),
    ),
    mission=_gap_mission,
)


SEASONS: Final[tuple[Season, ...]] = ("autumn", "snow")  # of the stresses, in the order of their strength


@dataclass(frozen=True, kw_only=True)
class FlightImageSuite(PictureSuite, FlightSuite):
    """A flight whose views are pictures; weather and light are the same from its first view to its last."""


def _flight(variant: Variant) -> Flight:
    season: Season = next((name for name in SEASONS if variant.kind.endswith(name)), "summer")
    return Flight(conditions=lambda ordinary: replace(ordinary, season=season))


EVERY_M: Final = (80.0, 120.0)  # flown between two pictures, on average: rendering takes most of the time


LONGEST_M: Final = 2000.0


FLIGHT_IMAGE: Final = FlightImageSuite(
    card=SuiteCard(
        name="flight-image",
        version=1,
        title="Flights in pictures (F9)",
        what="A flight of 1 or 2 km whose views are pictures from straight above, one every 80 to 120 m, in autumn and "
        "under snow; the control's are of summer. A segmenter makes the evidence.",
        separates="Trackers that bear the errors of a segmenter, which last for as long as the season does.",
        falsifier="Other pictures in summer: scores as in the control.",
        strength_unit="season: 1 for autumn, 2 for snow",
        group=START,
        tracks=SEQUENCE,
        min_density=0.05,
    ),
    variants=(
        Variant(role="control", kind="summer"),
        *(
            Variant(role="stress", kind=f"F9 {season}", strength=float(order))
            for order, season in enumerate(SEASONS, start=1)
        ),
        Variant(role="falsifier", kind="summer again"),
    ),
    flight=_flight,
    every_m=EVERY_M,
    longest_m=LONGEST_M,
)


DISTANCES_M: Final = (1000.0, 2000.0, 5000.0)
TOLD, UNTOLD = "F5 odometer lost", "F5 odometer unaware"
STAYS: Final = "odometer lost, not carried"


class FlightKidnapSuite(FlightSuite):
    """A flight that begins elsewhere; from the middle on it is the control's."""

    def lack(self, scene: Scene) -> str | None:
        """Refuse a map on which no drone can be carried even the least distance."""
        if not carries(scene, min(DISTANCES_M)):
            return f"no room to be carried {min(DISTANCES_M):g} m"
        return super().lack(scene)

    def usable(self, scene: Scene) -> tuple[Variant, ...]:
        """Return the distances for which there is room."""
        return tuple(item for item in self.variants if item.role != "stress" or carries(scene, item.strength))


def _kidnap_mission(variant: Variant) -> Mission:
    if variant.kind == STAYS:
        return Mission(is_lost=True)
    return Mission(carried_m=variant.strength, is_lost=variant.kind == TOLD)


FLIGHT_KIDNAP: Final = FlightKidnapSuite(
    card=SuiteCard(
        name="flight-kidnap",
        version=1,
        title="Carried away (F5)",
        what="The flight begins elsewhere; in its middle the drone is carried, unseen, 1, 2 or 5 km to where the "
        "control flies, and goes on as the control does. Its odometer says nothing of that step, or the control's.",
        separates="Trackers that can give up a belief that was right from those that cannot.",
        falsifier="The odometer says nothing of one step, and the drone is not carried.",
        strength_unit="m carried, about: carried_m is how far",
        group=START,
        tracks=SEQUENCE,
        min_density=0.05,
    ),
    variants=(
        Variant(role="control", kind="not carried"),
        *(Variant(role="stress", kind=kind, strength=far_m) for kind in (TOLD, UNTOLD) for far_m in DISTANCES_M),
        Variant(role="falsifier", kind=STAYS),
    ),
    mission=_kidnap_mission,
)


def _overconfident_mission(variant: Variant) -> Mission:
    return Mission(
        belief="optimistic" if variant.role == "stress" else "honest", draw=AGAIN if variant.role == "falsifier" else ""
    )


FLIGHT_OVERCONFIDENT: Final = FlightSuite(
    card=SuiteCard(
        name="flight-overconfident",
        version=1,
        title="Optimistic odometry (F6)",
        what="The same increments as in the control, and standard deviations a third of those that would be honest.",
        separates="Trackers that test what the odometer believes from those that trust it.",
        falsifier="Honest covariances, with other errors of perception and odometry.",
        strength_unit="1 for optimistic covariances",
        group=START,
        tracks=SEQUENCE,
        min_density=0.05,
    ),
    variants=(
        Variant(role="control", kind="honest"),
        Variant(role="stress", kind="F6 a third of the sigmas", strength=1.0),
        Variant(role="falsifier", kind="honest again"),
    ),
    mission=_overconfident_mission,
)


class FlightRealAgeSuite(FlightSuite):
    """One flight, followed on maps of several ages; the control has today's map."""

    def lack(self, scene: Scene) -> str | None:
        """Refuse a region without an older extract of a fitting age."""
        if not any(has_age(scene, years) for years in AGES_YEARS):
            return f"no older extract of about {', '.join(f'{years:g}' for years in AGES_YEARS)} years"
        return super().lack(scene)

    def usable(self, scene: Scene) -> tuple[Variant, ...]:
        """Return the ages for which there is a map."""
        return tuple(item for item in self.variants if item.role != "stress" or has_age(scene, item.strength))

    def map_region(self, scene: Scene, variant: Variant) -> str:
        """Return the older map for a stress, today's for the others."""
        return map_of_age(scene, variant.strength).region if variant.role == "stress" else scene.map.region

    def draw(self, shot: ViewRequest) -> QueryDraft:
        """Perceive today's world; measure the age of the map and its changes."""
        if shot.variant.role != "stress":
            return replace(super().draw(shot), changed_share=0.0, measured={"age_years": 0.0})
        old = map_of_age(shot.scene, shot.variant.strength)
        draft = QueryDraft.of_change(shot.perceived(), shot.clean(), shot.clean(old))
        return replace(draft, measured={"age_years": age_years(old, shot.scene.world), **draft.measured})


def _real_age_mission(variant: Variant) -> Mission:
    return Mission(draw=AGAIN if variant.role == "falsifier" else "")


def _ages(ages_years: Sequence[float]) -> tuple[Variant, ...]:
    return tuple(Variant(role="stress", kind="F2", strength=years) for years in ages_years)


FLIGHT_REAL_AGE: Final = FlightRealAgeSuite(
    card=SuiteCard(
        name="flight-real-age",
        version=1,
        title="Flights over aged maps (F2)",
        what="The map is that of an extract about 2, 5 or 10 years older than the world that is flown over, as in "
        "real-age; the control's is today's.",
        separates="Trackers that lean on what lasts from those that lean on what is many.",
        falsifier="Today's map again, with other errors of perception and odometry.",
        strength_unit="years between map and world, about: age_years is what they are",
        needs=("older maps",),
        group=START,
        tracks=SEQUENCE,
        min_density=0.05,
    ),
    variants=(
        Variant(role="control", kind="today's map"),
        *_ages(AGES_YEARS),
        Variant(role="falsifier", kind="today's map again"),
    ),
    mission=_real_age_mission,
)


KNOWN: Final = PriorGroup(radius_m=100.0, yaw="known", scale_sigma=0.03)
ANYWHERE: Final = "F3 anywhere"
START_RADII_M: Final = (500.0, 2000.0)


def _start_mission(variant: Variant) -> Mission:
    if variant.role == "falsifier":
        return Mission(group=KNOWN, draw=AGAIN)
    if variant.role == "control":
        return Mission(group=KNOWN)
    radius_m = None if variant.kind == ANYWHERE else variant.strength
    return Mission(group=PriorGroup(radius_m=radius_m, yaw="weak", scale_sigma=0.03))


FLIGHT_START: Final = FlightSuite(
    card=SuiteCard(
        name="flight-start",
        version=1,
        title="Unknown start (F3)",
        what="A flight begins within a disc of 500 m or 2 km that is known, or anywhere on the map; the control's "
        "begins within 100 m with a known heading.",
        separates="Trackers that keep several hypotheses until one is right from those that begin with one.",
        falsifier="The start of the control, with other errors of perception and odometry.",
        strength_unit="radius of the disc, m; 0 for the control, 9999 for the whole map",
        has_own_priors=True,
        group=KNOWN,
        tracks=SEQUENCE,
        min_density=0.05,
    ),
    variants=(
        Variant(role="control", kind="known start"),
        *(Variant(role="stress", kind="F3 disc", strength=radius_m) for radius_m in START_RADII_M),
        Variant(role="stress", kind=ANYWHERE, strength=9999.0),
        Variant(role="falsifier", kind="known start again"),
    ),
    mission=_start_mission,
)
