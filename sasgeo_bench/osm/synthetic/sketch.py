# SPDX-License-Identifier: Apache-2.0
"""Sketch of an embedded town: streets that share nodes, houses along them, areas with holes."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import pairwise

import numpy as np
import shapely
from numpy.typing import NDArray

Tags = dict[str, str]
Line = NDArray[np.float64]

_STREET_HALF_M = {"primary": 6.0, "secondary": 5.5, "tertiary": 5.0, "track": 2.0, "footway": 1.5, "path": 1.5}
_DECIMALS = 2


@dataclass(frozen=True, slots=True, kw_only=True)
class Way:
    """One way of the plan: its line, shape (N, 2), metres from the town's centre, and its tags."""

    line: Line
    tags: Tags


@dataclass(frozen=True, slots=True, kw_only=True)
class Area:
    """One multipolygon of the plan: outer ring and holes, each shape (N, 2) and closed, in metres."""

    outer: Line
    inner: tuple[Line, ...]
    tags: Tags
    kind: str = "multipolygon"


@dataclass(slots=True)
class Sketch:
    """A town while it is drawn; x grows east and y north, the centre is (0, 0)."""

    half_m: float
    rng: np.random.Generator
    ways: list[Way] = field(default_factory=list)
    areas: list[Area] = field(default_factory=list)
    taken: list[shapely.Geometry] = field(default_factory=list)
    _boxes: NDArray[np.float64] = field(default_factory=lambda: np.empty((0, 4)))  # of `taken`, with room for more

    @property
    def square(self) -> shapely.Polygon:
        """Return the ground of the town."""
        return shapely.box(-self.half_m, -self.half_m, self.half_m, self.half_m)

    def street(self, line: Sequence[Sequence[float]] | Line, **tags: str) -> None:
        """Draw a street and keep its ground free of houses."""
        self.line(line, **tags)
        if tags.get("tunnel") is None:
            half_m = _STREET_HALF_M.get(tags.get("highway", ""), 4.0)
            self.keep_free(shapely.buffer(shapely.linestrings(np.asarray(line, dtype=np.float64)), half_m))

    def line(self, line: Sequence[Sequence[float]] | Line, **tags: str) -> None:
        """Draw a line that takes no ground: a hedge, a wall, a stream. The part beyond the town is cut off."""
        points = np.asarray(line, dtype=np.float64)
        if np.abs(points).max() <= self.half_m:
            self.ways.append(Way(line=points, tags=tags))
            return
        for part in shapely.get_parts(shapely.intersection(shapely.linestrings(points), self.square)):
            if part.geom_type == "LineString" and part.length > 1.0:
                self.ways.append(Way(line=shapely.get_coordinates(part), tags=tags))

    def ground(self, polygon: shapely.Geometry, *, is_free: bool = True, **tags: str) -> bool:
        """Draw an area, with holes as a multipolygon; return False if the ground is taken or too small."""
        if polygon.geom_type == "Polygon" and not self.square.contains(polygon):
            polygon = shapely.intersection(polygon, self.square)
        if polygon.geom_type != "Polygon" or polygon.area < 4.0:  # m2
            return False
        if is_free and self.is_taken(polygon):
            return False
        outer = shapely.get_coordinates(polygon.exterior)
        inner = tuple(shapely.get_coordinates(ring) for ring in polygon.interiors)
        if inner:
            self.areas.append(Area(outer=outer, inner=inner, tags=tags))
        else:
            self.ways.append(Way(line=outer, tags=tags))
        return True

    def keep_free(self, polygon: shapely.Geometry) -> None:
        """Reserve ground, so that nothing is built there."""
        if len(self.taken) == len(self._boxes):
            self._boxes = np.concatenate((self._boxes, np.empty((len(self.taken) + 256, 4))))
        self._boxes[len(self.taken)] = polygon.bounds
        self.taken.append(polygon)

    def is_taken(self, polygon: shapely.Geometry) -> bool:
        """Return whether the ground is taken already."""
        west, south, east, north = polygon.bounds
        low_x, low_y, high_x, high_y = self._boxes[: len(self.taken)].T
        near = np.flatnonzero((low_x <= east) & (high_x >= west) & (low_y <= north) & (high_y >= south))
        return any(shapely.intersects(self.taken[at], polygon) for at in near)

    def build(self, polygon: shapely.Geometry, **tags: str) -> bool:
        """Build a house if the ground is free and within the town."""
        if not self.square.contains(polygon) or not self.ground(polygon, is_free=True, **tags):
            return False
        self.keep_free(shapely.buffer(polygon, 1.0))
        return True

    def houses_along(
        self,
        line: Line,
        *,
        spacing_m: float,
        setback_m: float,
        size_m: tuple[float, float],
        kind: str = "house",
        chance: float = 0.9,
    ) -> None:
        """Build houses on both sides of a street, facing it, each a little different."""
        street = shapely.linestrings(line)
        for along_m in np.arange(spacing_m / 2, street.length, spacing_m):
            for side in (-1.0, 1.0):
                if self.rng.random() > chance:
                    continue
                here, ahead = street.interpolate(along_m), street.interpolate(min(along_m + 1.0, street.length))
                angle = np.arctan2(ahead.y - here.y, ahead.x - here.x)
                width_m, depth_m = np.array(size_m) * self.rng.uniform(0.8, 1.2, 2)
                back_m = setback_m + depth_m / 2 + self.rng.uniform(0, 2)
                centre = (here.x - side * back_m * np.sin(angle), here.y + side * back_m * np.cos(angle))
                self.build(house(centre, width_m, depth_m, float(angle), self.rng), building=kind)


def house(
    centre: tuple[float, float], width_m: float, depth_m: float, angle: float, rng: np.random.Generator
) -> shapely.Polygon:
    """Return a rectangle or, one time in three, an L, turned by an angle in radians."""
    x, y = width_m / 2, depth_m / 2
    corners = np.array([(-x, -y), (x, -y), (x, y), (-x, y)])
    if rng.random() < 1 / 3:
        corners = np.array([(-x, -y), (x, -y), (x, y), (x / 3, y), (x / 3, y / 3), (-x, y / 3)])
    turn = np.array([[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]])
    return shapely.Polygon(corners @ turn + np.array(centre))


def curve(points: Sequence[Sequence[float]] | Line, *, step_m: float = 12.0) -> Line:
    """Return a smooth line through points (Catmull-Rom), sampled about every `step_m` metres."""
    given = np.asarray(points, dtype=np.float64)
    padded = np.vstack((2 * given[0] - given[1], given, 2 * given[-1] - given[-2]))
    pieces = []
    for before, start, end, after in zip(padded[:-3], padded[1:-2], padded[2:-1], padded[3:], strict=True):
        count = max(1, round(float(np.hypot(*(end - start))) / step_m))
        t = (np.arange(count) / count)[:, None]
        pieces.append(
            0.5
            * (
                2 * start
                + (end - before) * t
                + (2 * before - 5 * start + 4 * end - after) * t**2
                + (3 * start - before - 3 * end + after) * t**3
            )
        )
    return np.vstack((*pieces, given[-1:])).round(_DECIMALS)


def wobble(line: Line, amount_m: float, rng: np.random.Generator) -> Line:
    """Move every inner point of a line by a random offset."""
    moved = line.copy()
    moved[1:-1] += rng.uniform(-amount_m, amount_m, (len(line) - 2, 2))
    return moved


def join_streets(ways: list[Way]) -> list[Way]:
    """Give ways of one layer a common point wherever they cross, so that they share a node there.

    Bridges, tunnels and other layers stay separate; railways join only each other and, at a level crossing, the
    streets.
    """
    network = [i for i, way in enumerate(ways) if "highway" in way.tags or "railway" in way.tags]
    lines = np.array([shapely.linestrings(ways[i].line) for i in network], dtype=object)
    levels = [ways[i].tags.get("layer", "0") for i in network]
    joined = list(ways)
    tree = shapely.STRtree(lines)
    for position, index in enumerate(network):
        cuts: list[tuple[float, float]] = []
        for other in sorted(tree.query(lines[position], predicate="intersects").tolist()):
            if other != position and levels[other] == levels[position]:
                # The pair is always cut in one order, so both lines get exactly the same point.
                first, second = sorted((position, other))
                cut = shapely.get_coordinates(shapely.intersection(lines[first], lines[second])).round(_DECIMALS)
                cuts += [(float(x), float(y)) for x, y in cut]
        joined[index] = Way(line=_with_points(ways[index].line, cuts), tags=ways[index].tags)
    return joined


def _with_points(line: Line, cuts: list[tuple[float, float]]) -> Line:
    base = shapely.linestrings(line)
    corners = [(float(base.project(shapely.Point(point))), tuple(point)) for point in line.round(_DECIMALS).tolist()]
    if len(corners) > 1:
        corners[-1] = (base.length, corners[-1][1])  # of a closed line the last point is not the first
    known = {point for _, point in corners}
    extra = [(float(base.project(shapely.Point(point))), point) for point in sorted(set(cuts)) if point not in known]
    return np.array([point for _, point in sorted(corners + extra, key=lambda item: item[0])])


def split_at(line: Line, start_m: float, end_m: float) -> tuple[Line, Line, Line]:
    """Cut a line into the parts before, between and after two distances along it."""
    base = shapely.linestrings(line)
    stops = [0.0, start_m, end_m, base.length]
    along = np.array([base.project(shapely.Point(point)) for point in line])
    along[-1] = base.length
    parts = []
    for low, high in pairwise(stops):
        inside = line[(along > low + 0.01) & (along < high - 0.01)]
        ends = [shapely.get_coordinates(base.interpolate(stop)) for stop in (low, high)]
        parts.append(np.vstack((ends[0], inside, ends[1])).round(_DECIMALS))
    return parts[0], parts[1], parts[2]
