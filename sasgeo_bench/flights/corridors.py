# SPDX-License-Identifier: Apache-2.0
"""Corridors: ways along the roads or waterways of a map, without U-turns, smoothed as a drone follows them."""

import math
from dataclasses import dataclass
from typing import Final, Literal, Self

import geopandas as gpd
import numpy as np
import shapely
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter1d

from sasgeo_bench.geometry.pose import wrap_deg
from sasgeo_bench.osm.taxonomy import load_taxonomy
from sasgeo_bench.regions.network import ROAD, WATER, make_chains, make_network

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
_SHARPEST_DEG: Final = 120.0  # at a junction; sharper ones are U-turns
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
        return [ways[at] for at in np.argsort(clocks, kind="stable") if max(turns[at], both[at]) <= _SHARPEST_DEG]

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
