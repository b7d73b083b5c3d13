# SPDX-License-Identifier: Apache-2.0
"""Paths for flights over a region: survey, corridor, transit, loiter and waypoints, all over mapped ground."""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from types import MappingProxyType
from typing import Final, Literal, Self, get_args

import geopandas as gpd
import numpy as np
import shapely
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter1d

from sasgeo_bench.core.errors import FlightError
from sasgeo_bench.flights.kinematics import DEFAULT_LIMITS, Limits, length_m, round_corners
from sasgeo_bench.geometry.pose import wrap_deg
from sasgeo_bench.osm.taxonomy import load_taxonomy
from sasgeo_bench.regions.graph import ROAD, WATER, make_chains, make_network
from sasgeo_bench.regions.region import Region

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
Ways = Literal["road", "water"]

# Classes of the map, and their layer of the network. Paths are left out: they wind more than a drone follows.
_CLASSES: Final = {
    "road": (load_taxonomy().having("street"), ROAD),
    "water": (load_taxonomy().of_graph("water"), WATER),
}
_LINE_DIMENSION: Final = 1
_PASSING_DEGREE: Final = 2
_STEP_M: Final = 2.0  # between points of a corridor
_TURN_STEP_M: Final = 10.0  # by which turns along a way are measured
_SMOOTHING_M: Final = 15.0  # standard deviation: a drone follows a road's course, not its every vertex
_SHARPEST_CORNER_DEG: Final = 120.0  # at a junction; sharper ones are U-turns
_LINK_M: Final = 60.0  # nearer turns count as one: over a link between carriageways there is no way back


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Corridors:
    """Ways between junctions, each in both directions.

    Entry `at` of each tuple is a directed way; `at ^ 1` is its way back. They do not depend on the order of the
    features that they are made from.
    """

    lines_m: tuple[Floats, ...]  # points, (P, 2)
    length_m: Floats  # (E,)
    start: Ints  # (E,) junction
    end: Ints  # (E,)
    heading: Floats  # (E, 2) radians at the start and at the end, counter-clockwise from east

    def __len__(self) -> int:
        return len(self.lines_m)

    @classmethod
    def of(cls, features: gpd.GeoDataFrame, area: shapely.Geometry, along: Ways) -> Self:
        """Return the ways of a map inside an area; roads under ground count too, the drone flies over them."""
        names, layer = _CLASSES[along]
        chosen = features[features["class"].isin(names).to_numpy()]
        shapes = np.asarray(chosen.geometry.array)
        is_line = shapely.get_dimensions(shapes) == _LINE_DIMENSION
        # Smoothing cuts corners: an inset keeps it inside where the area bends inwards.
        shapes = shapely.intersection(shapes[is_line], area.buffer(-_SMOOTHING_M))
        ways = gpd.GeoDataFrame(
            {"class": chosen["class"].to_numpy()[is_line], "is_visible": True}, geometry=shapes, crs=features.crs
        )
        network = make_network(ways)
        degree = network.degree(layer)
        if not len(network.ends):
            return cls._joined([])
        chains = make_chains(network, layer, is_break=(degree > 0) & (degree != _PASSING_DEGREE))
        parts = np.split(chains.en_m, chains.first[1:-1])
        # A ring without a junction leads nowhere.
        is_ring = (chains.tips[:, 0] == chains.tips[:, 1]) & (degree[chains.tips[:, 0]] == _PASSING_DEGREE)
        kept = [part for part, is_out in zip(parts, is_ring, strict=True) if not is_out and not _turns_back(part)]
        return cls._joined(kept)

    @classmethod
    def _joined(cls, parts: list[Floats]) -> Self:
        """Number the junctions, and sort the ways by place: nothing depends on the order they came in."""
        lines = sorted((_forward(part) for part in parts), key=lambda part: part.ravel().tolist())
        both = tuple(line for part in lines for line in (part, part[::-1]))
        tips = np.array([(line[0], line[-1]) for line in both]).reshape(-1, 2).round(3)
        number = np.unique(tips, axis=0, return_inverse=True)[1].reshape(-1, 2)
        return cls(
            lines_m=both,
            length_m=np.array([np.hypot(*np.diff(line, axis=0).T).sum() for line in both]),
            start=number[:, 0],
            end=number[:, 1],
            heading=np.array([(_heading(line), _heading(line[::-1]) + math.pi) for line in both]).reshape(-1, 2),
        )

    def walk(self, length_m: float, rng: np.random.Generator) -> Floats | None:
        """Draw a way of a length at least, smoothed, points 2 m apart, shape (N, 2); None where a search found none.

        At a junction it turns by 120 degrees at most, likely goes on straight, and rarely where it was before. From a
        dead end the search goes back to the last choice.
        """
        leaving: dict[int, list[int]] = {}
        for way, junction in enumerate(self.start.tolist()):
            leaving.setdefault(junction, []).append(way)
        first = int(rng.integers(len(self)))
        walk, rests = [first], [self._choices(leaving, [first], rng)]
        total_m = float(self.length_m[first])
        for _ in range(3000):  # at most 3000 steps of a search, dead ends included
            if not walk:
                return None
            if total_m >= length_m:
                line_m = self._smoothed(walk, length_m)
                if line_m is not None:
                    return line_m
            if rests[-1]:
                way = rests[-1].pop()
                walk.append(way)
                total_m += float(self.length_m[way])
                rests.append(self._choices(leaving, walk, rng))
            else:
                total_m -= float(self.length_m[walk.pop()])
                rests.pop()
        return None

    def _choices(self, leaving: dict[int, list[int]], walk: list[int], rng: np.random.Generator) -> list[int]:
        here = walk[-1]
        ways = [way for way in leaving.get(int(self.end[here]), []) if way != here ^ 1]
        if not ways:
            return []
        turns = np.abs(wrap_deg(np.degrees(self.heading[ways, 0] - self.heading[here, 1])))
        both = np.abs(wrap_deg(np.degrees(self.heading[ways, 0] - self._course_before(walk))))
        times = np.array([sum(way in (past, past ^ 1) for past in walk) for way in ways])
        # The largest of these is each way in proportion to its weight (exponential clocks).
        # 40 degrees by which a turn is e times less likely
        # 0.2 of the chance of a way that was flown before
        clocks = np.log(rng.random(len(ways))) * np.exp(turns / 40.0) * 0.2 ** -times.astype(np.float64)
        return [
            ways[at] for at in np.argsort(clocks, kind="stable") if max(turns[at], both[at]) <= _SHARPEST_CORNER_DEG
        ]

    def _course_before(self, walk: list[int]) -> float:
        """Return the direction at the end of a walk before its last links, radians."""
        at, links_m = len(walk) - 1, float(self.length_m[walk[-1]])
        while at > 0 and links_m < _LINK_M:
            at -= 1
            links_m += float(self.length_m[walk[at]])
        return float(self.heading[walk[at], 1])

    def _smoothed(self, walk: list[int], length_m: float) -> Floats | None:
        """Return the smoothed line of a walk if it is long enough."""
        line_m = np.concatenate([self.lines_m[way] for way in walk])
        along_m = np.append(0.0, np.cumsum(np.hypot(*np.diff(line_m, axis=0).T)))
        # 1.3 of the length, before it is smoothed, which shortens it
        even_m = np.arange(0.0, min(float(along_m[-1]), 1.3 * length_m), _STEP_M)
        even = np.stack([np.interp(even_m, along_m, axis) for axis in line_m.T], axis=1)
        smooth = gaussian_filter1d(even, _SMOOTHING_M / _STEP_M, axis=0, mode="nearest")
        return smooth if np.hypot(*np.diff(smooth, axis=0).T).sum() >= length_m else None


def _forward(line_m: Floats) -> Floats:
    """Return a line from the lesser of its ends; of two equal ones, in the lesser order of its points."""
    return min((line_m, line_m[::-1]), key=lambda part: part.ravel().tolist())


def _turns_back(line_m: Floats) -> bool:
    along_m = np.append(0.0, np.cumsum(np.hypot(*np.diff(line_m, axis=0).T)))
    even_m = np.arange(0.0, along_m[-1], _TURN_STEP_M)
    sides = np.diff(np.stack([np.interp(even_m, along_m, axis) for axis in line_m.T], axis=1), axis=0)
    course_deg = np.degrees(np.unwrap(np.arctan2(*sides.T)))
    reach = round(_LINK_M / _TURN_STEP_M)
    first, last = course_deg[: max(1, len(course_deg) - reach)], course_deg[min(reach, len(course_deg) - 1) :]
    # 150 degrees within that length, on one way: turning loops and hairpins are not followed
    return len(course_deg) > 1 and float(np.abs(last - first[: len(last)]).max()) > 150.0


def _heading(line_m: Floats) -> float:
    """Return the direction in which a line begins, radians."""
    along_m = np.append(0.0, np.cumsum(np.hypot(*np.diff(line_m, axis=0).T)))
    # 30 m over which the direction at a junction is measured
    east, north = (np.interp(30.0, along_m, axis) for axis in (line_m - line_m[0]).T)
    return math.atan2(north, east)


PlanKind = Literal["survey", "corridor", "transit", "loiter", "waypoints"]

KINDS: Final[tuple[PlanKind, ...]] = get_args(PlanKind)
SHORTEST_M, LONGEST_M = 1_000.0, 10_000.0
MARGIN_M: Final = 100.0  # from the edge of what is mapped: about what a camera sees to its side from 120 m

_ASKED_M: Final = 100.0  # to which lengths are rounded down where an error names one
_DRAWS: Final = 40  # of a path, before there is none
_PLACES: Final = 24  # tried for the shape of each draw
_LEAST_LEGS: Final = 3
_RADIUS_M: Final = (50.0, 200.0)  # of a loiter
_NEXT: Final = 24  # places drawn for the next waypoint
_CURVE_M: Final = 2.0  # between points of a curve


@dataclass(frozen=True, slots=True, kw_only=True)
class _Wish:
    """What a plan shall be, and where it may lie."""

    area: shapely.Geometry  # prepared
    length_m: float
    limits: Limits
    corridors: Corridors | None


def flight_area(region: Region, margin_m: float = MARGIN_M) -> shapely.Geometry:
    """Return where flights may go: mapped ground within the grid, less a margin; empty where there is none.

    Ground that the map does not know is outside, and the margin holds around it too.
    """
    if not (math.isfinite(margin_m) and margin_m >= 0):
        raise FlightError(f"margin_m is a distance in metres, got {margin_m!r}")
    area = region.coverage.intersection(shapely.box(*region.grid.bounds_m)).buffer(-margin_m)
    shapely.prepare(area)
    return area


def plan_flight(
    region: Region,
    kind: PlanKind,
    *,
    length_m: float,
    rng: np.random.Generator,
    margin_m: float = MARGIN_M,
    along: Ways = "road",
    limits: Limits = DEFAULT_LIMITS,
) -> Floats:
    """Draw the path of a flight over a region.

    Parameters
    ----------
    region : Region
        Its mapped ground is flown over, its roads or waterways are followed.
    kind : {"survey", "corridor", "transit", "loiter", "waypoints"}
        Parallel legs; a way along roads or a waterway without U-turns; a gentle path between two places far apart;
        laps of a circle, an oval or an eight; straight legs between random places.
    length_m : float
        Length of the path, 1,000 to 10,000 m.
    rng : numpy Generator
        Source of all choices: equal seeds give equal paths.
    margin_m : float
        Least distance from ground that is not mapped, and from the edge of the region, metres.
    along : {"road", "water"}
        What a corridor follows.
    limits : Limits
        Their `turn_radius_m` rounds the corners.

    Returns
    -------
    ndarray, shape (N, 2)
        Easting and northing, metres, of a path that `fly` takes. Its length is the one asked for.

    Raises
    ------
    FlightError
        If no such path fits; the message names the longest that was found.

    Examples
    --------
    >>> import tempfile
    >>> from pathlib import Path
    >>> from sasgeo_bench.regions.build import build_region, plan_build
    >>> from sasgeo_bench.regions.region_files import read_region
    >>> from sasgeo_bench.regions.region_spec import find_region_file, read_region_file
    >>> with tempfile.TemporaryDirectory() as out:
    ...     spec = read_region_file(find_region_file("town-suburb"))
    ...     _ = build_region(plan_build(spec, out=Path(out)))
    ...     region = read_region(Path(out) / "regions" / "town-suburb")
    >>> path = plan_flight(region, "loiter", length_m=2000.0, rng=np.random.default_rng(3))
    >>> round(length_m(path)), bool(flight_area(region).covers(shapely.LineString(path)))
    (2000, True)
    """
    if kind not in KINDS:
        raise FlightError(f"a flight is one of {', '.join(KINDS)}, got {kind!r}")
    if along not in get_args(Ways):
        raise FlightError(f"a corridor lies along one of {', '.join(get_args(Ways))}, got {along!r}")
    if not SHORTEST_M <= length_m <= LONGEST_M:
        raise FlightError(f"length_m lies in {SHORTEST_M:g}..{LONGEST_M:g}, got {length_m!r}")
    area = flight_area(region, margin_m)
    corridors = Corridors.of(region.features, area, along) if kind == "corridor" else None
    wish = _Wish(area=area, length_m=float(length_m), limits=limits, corridors=corridors)
    path_m = None if area.is_empty else _MAKERS[kind](wish, rng)
    if path_m is None:
        name = f"{kind} along {along}" if kind == "corridor" else kind
        raise FlightError(_what_fits(wish, kind, name, region.manifest.id, margin_m))
    return path_m


def _what_fits(wish: _Wish, kind: PlanKind, name: str, region: str, margin_m: float) -> str:
    """Return the message that a path does not fit, with the longest one that does."""
    low, high = SHORTEST_M, wish.length_m
    longest = None
    # Draws of their own, so that the message does not depend on the caller's.
    while not wish.area.is_empty and (longest is None or high - low > _ASKED_M):
        middle = low if longest is None else (low + high) / 2
        if _MAKERS[kind](replace(wish, length_m=middle), np.random.default_rng(0)) is not None:
            longest = low = middle
        elif longest is None:
            break
        else:
            high = middle
    head = f"found no {name} of {wish.length_m:g} m in {region} with a margin of {margin_m:g} m"
    mend = "take a smaller margin, another kind or a larger region"
    if longest is None:
        return f"{head}, nor one of {SHORTEST_M:g} m: {mend}"
    return f"{head}: one of {longest // _ASKED_M * _ASKED_M:.0f} m fits; for more, {mend}"


def _survey(wish: _Wish, rng: np.random.Generator) -> Floats | None:
    """Draw parallel legs, along the longer side of their rectangle; long surveys lie along the area's longer side."""
    # Bearing of the longer side of an area; of a square one, either
    corners_m = shapely.get_coordinates(shapely.oriented_envelope(wish.area))[:3]
    sides = np.diff(corners_m, axis=0)
    lengths = np.hypot(*sides.T)
    is_square = lengths.max() < 1.05 * lengths.min()  # sides as like as these have no longer one
    at = int(rng.integers(2)) if is_square else int(np.argmax(lengths))
    longer_deg = math.degrees(math.atan2(sides[at, 0], sides[at, 1]))
    radius_m = wish.limits.turn_radius_m
    saved_m = (4 - math.pi) * radius_m  # by the two rounded corners of each turn
    for draw in range(_DRAWS):
        # Between legs of a survey: pictures from 120 m overlap by half or more
        spacing_m = max(rng.uniform(40.0, 80.0), 2 * radius_m)
        most = int(math.sqrt(wish.length_m / spacing_m)) + 1
        for legs in rng.permutation(np.arange(_LEAST_LEGS, most + 1)).tolist():
            leg_m = (wish.length_m - (legs - 1) * (spacing_m - saved_m)) / legs
            if leg_m < max((legs - 1) * spacing_m, 2 * radius_m):
                continue
            across = np.repeat(np.arange(legs) * spacing_m, 2) * rng.choice([-1, 1])
            along = np.resize([0.0, leg_m, leg_m, 0.0], 2 * legs)
            shape_m = round_corners(np.column_stack([across, along]), radius_m)
            headings = longer_deg + np.array([0.0, 180.0]) if draw % 2 else rng.uniform(0.0, 360.0, 2)
            placed = _placed(shape_m, wish.area, headings, rng)
            if placed is not None:
                return placed
    return None


def _corridor(wish: _Wish, rng: np.random.Generator) -> Floats | None:
    if wish.corridors is None or not len(wish.corridors):
        return None
    for _ in range(_DRAWS):
        line_m = wish.corridors.walk(wish.length_m, rng)
        if line_m is not None:
            path_m = _cut(line_m, wish.length_m)
            if path_m is not None and _fits(path_m, wish.area):
                return path_m
    return None


def _transit(wish: _Wish, rng: np.random.Generator) -> Floats | None:
    """Draw a curve between two places, past one waypoint or two."""
    from scipy.interpolate import CubicSpline  # noqa: PLC0415 - slow to import, and most processes fly nothing

    for _ in range(_DRAWS):
        count = int(rng.integers(1, 3))
        at = np.array([0.0, *(np.arange(1, count + 1) + rng.uniform(-0.2, 0.2, count)) / (count + 1), 1.0])
        # Of a transit's waypoints from the straight line, in its lengths
        off = np.array([0.0, *(rng.uniform(0.04, 0.15, count) * rng.choice([-1, 1], count)), 0.0])
        curve = CubicSpline(at, np.column_stack([off, at]), bc_type="natural")
        shape_m = curve(np.linspace(0.0, 1.0, math.ceil(wish.length_m / _CURVE_M) + 1))
        shape_m *= wish.length_m / length_m(shape_m)
        placed = _placed(shape_m, wish.area, rng.uniform(0.0, 360.0, _PLACES), rng)
        if placed is not None:
            return placed
    return None


def _loiter(wish: _Wish, rng: np.random.Generator) -> Floats | None:
    """Draw laps of a circle, an oval or an eight around a place, to the right or to the left."""
    for _ in range(_DRAWS):
        least_m = max(_RADIUS_M[0], 2 * wish.limits.turn_radius_m)  # ovals and eights have half of it
        radius_m = rng.uniform(least_m, max(_RADIUS_M[1], least_m))
        lap_m = (_circle, _oval, _eight)[rng.integers(3)](radius_m, rng)
        lap_m = lap_m * np.array([rng.choice([-1.0, 1.0]), 1.0])
        laps = math.ceil(wish.length_m / length_m(lap_m)) + 1
        start = int(rng.integers(len(lap_m) - 1))
        shape_m = np.tile(lap_m[:-1], (laps + 1, 1))[start:]
        cut_m = _cut(shape_m, wish.length_m)
        placed = None if cut_m is None else _placed(cut_m, wish.area, rng.uniform(0.0, 360.0, 4), rng)
        if placed is not None:
            return placed
    return None


def _waypoints(wish: _Wish, rng: np.random.Generator) -> Floats | None:
    """Draw places one after the other; legs have a least length and no hairpins between them."""
    for _ in range(_DRAWS):
        places_m = _points(wish.area, 1, rng)
        flown_m = 0.0
        while len(places_m) and flown_m < wish.length_m:
            found = _next_place(places_m, wish.area, rng)
            if found is None:
                break
            places_m = np.vstack([places_m, found])
            # Rounding shortens the path a little, so it is measured as it is flown.
            flown_m = length_m(round_corners(places_m, wish.limits.turn_radius_m))
        if flown_m < wish.length_m:
            continue
        path_m = _cut(round_corners(places_m, wish.limits.turn_radius_m), wish.length_m)
        if path_m is not None and _fits(path_m, wish.area):
            return path_m
    return None


_MAKERS: Final[MappingProxyType[str, Callable[[_Wish, np.random.Generator], Floats | None]]] = MappingProxyType(
    {"survey": _survey, "corridor": _corridor, "transit": _transit, "loiter": _loiter, "waypoints": _waypoints}
)


def _next_place(places_m: Floats, area: shapely.Geometry, rng: np.random.Generator) -> Floats | None:
    here_m = places_m[-1]
    low_m, high_m = 150.0, 800.0  # between waypoints
    reach_m, turn = rng.uniform(low_m, high_m, _NEXT), rng.uniform(0.0, 2 * np.pi, _NEXT)
    legs_m = reach_m[:, None] * np.stack([np.sin(turn), np.cos(turn)], axis=1)
    is_open = shapely.contains_xy(area, here_m + legs_m)
    if len(places_m) > 1:
        before_m = here_m - places_m[-2]
        ahead = legs_m @ before_m / reach_m / np.hypot(*before_m)
        is_open &= ahead >= math.cos(math.radians(130.0))  # degrees: the sharpest turn at a waypoint
    for leg_m in legs_m[is_open]:
        if _fits(np.stack([here_m, here_m + leg_m]), area):
            return np.asarray(here_m + leg_m)
    return None


def _placed(shape_m: Floats, area: shapely.Geometry, headings_deg: Floats, rng: np.random.Generator) -> Floats | None:
    """Turn a shape to headings in turn and move it to where it fits; None where no place was found."""
    west, south, east, north = shapely.bounds(area).tolist()
    for heading_deg in headings_deg.tolist():
        turn = math.radians(heading_deg)
        turned = shape_m @ np.array([[math.cos(turn), -math.sin(turn)], [math.sin(turn), math.cos(turn)]])
        room = np.array([east - west, north - south]) - np.ptp(turned, axis=0)
        if room.min() < 0:
            continue
        turned += (west, south) - turned.min(axis=0)
        for share in rng.random((max(1, _PLACES // len(headings_deg)), 2)):
            if _fits(turned + share * room, area):
                return np.asarray(turned + share * room)
    return None


def _fits(path_m: Floats, area: shapely.Geometry) -> bool:
    return bool(area.covers(shapely.LineString(path_m)))


def _points(area: shapely.Geometry, count: int, rng: np.random.Generator) -> Floats:
    """Draw places in an area, evenly; fewer than asked for, or none, in one that hardly fills its box."""
    west, south, east, north = shapely.bounds(area).tolist()
    drawn_m = rng.uniform((west, south), (east, north), (64 * count, 2))
    return np.asarray(drawn_m[shapely.contains_xy(area, drawn_m)][:count])


def _cut(line_m: Floats, most_m: float) -> Floats | None:
    """Return the first part of a line, of a length; None if it is shorter."""
    along_m = np.append(0.0, np.cumsum(np.hypot(*np.diff(line_m, axis=0).T)))
    if along_m[-1] < most_m:
        return None
    end_m = [np.interp(most_m, along_m, axis) for axis in line_m.T]
    return np.vstack([line_m[along_m < most_m - 1e-6], end_m])  # m by which a place may lie outside


def _circle(radius_m: float, _: np.random.Generator) -> Floats:
    return _arc(radius_m, 0.0, 2 * math.pi)


def _oval(radius_m: float, rng: np.random.Generator) -> Floats:
    """Return a racetrack: two straights, and two halves of a circle."""
    radius_m /= 2
    half_m = radius_m * (rng.uniform(1.5, 3.0) - 1)  # length over width of an oval
    up_m = np.array([0.0, half_m])
    top, bottom = _arc(radius_m, 0.0, math.pi) + up_m, _arc(radius_m, math.pi, 2 * math.pi) - up_m
    return np.vstack([top, bottom, top[:1]])


def _eight(radius_m: float, _: np.random.Generator) -> Floats:
    radius_m /= 2
    off_m = np.array([radius_m, 0.0])
    right, left = _arc(radius_m, math.pi, 3 * math.pi) + off_m, _arc(radius_m, 0.0, -2 * math.pi) - off_m
    return np.vstack([right, left[1:]])


def _arc(radius_m: float, first: float, last: float) -> Floats:
    """Return an arc from an angle to another, radians, counter-clockwise from east."""
    angles = np.linspace(first, last, math.ceil(radius_m * abs(last - first) / _CURVE_M) + 1)
    return radius_m * np.stack([np.cos(angles), np.sin(angles)], axis=1)
