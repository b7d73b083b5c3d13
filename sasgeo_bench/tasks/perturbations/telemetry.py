# SPDX-License-Identifier: Apache-2.0
"""Ways to send a view over a narrow link: what arrives of it, and how many bytes that took.

All messages hold states alone, no confidence, and are deflated where that makes them shorter. What a budget leaves out
arrives as unknown, but for outlines, which move.
"""

import zlib
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

import numpy as np
import shapely
from numpy.typing import NDArray

from sasgeo_bench.osm.taxonomy import load_taxonomy
from sasgeo_bench.regions.evidence import ABSENT, PRESENT, UNKNOWN, Evidence, cell_offsets_m
from sasgeo_bench.regions.graph import build_graph
from sasgeo_bench.tasks.vectors import as_features, vector_table

if TYPE_CHECKING:
    import geopandas as gpd

Mask = NDArray[np.bool_]
Outline = list[NDArray[np.int64]]  # rings of one polygon in whole cells, the outer one first

TOLERANCES_CELLS: Final = (0.5, 1.0, 1.5, 2.0, 3.0, 4.0, 6.0, 8.0, 12.0, 16.0, 24.0, 32.0)  # of simplified outlines
TILE_CELLS: Final = 16  # a side of a region of interest
ARM_M: Final = 12.0  # of a road that is sent with a junction
_ARM_STEPS: Final = 64  # directions of an arm: 5.6 degrees
_PLACE_STEPS: Final = 256  # places along a side of the view: less than 1 m at 192 m
_FORK: Final = 3
_RING: Final = 4  # points of the shortest ring, its first twice
_LEAST_SHARE: Final = 1e-4  # of a class on the map: rarer ones say no more
_LOW_BITS: Final = 7  # of a byte in a number of several


@dataclass(frozen=True, kw_only=True)
class Sent:
    """What arrives of a view, and the length of the message; `vectors` where lines are sent."""

    evidence: Evidence
    bytes: int
    vectors: "gpd.GeoDataFrame | None" = None


def whole(evidence: Evidence) -> Sent:
    """Send all cells, two bits for each."""
    bits = np.unpackbits(evidence.cells.reshape(-1, 1), axis=1)[:, -2:]
    return Sent(evidence=evidence.replace(evidence.cells), bytes=length_of(np.packbits(bits).tobytes()))


def run_length(evidence: Evidence) -> Sent:
    """Send all cells as runs of one state, class by class and row by row; nothing is lost."""
    return Sent(evidence=evidence.replace(evidence.cells), bytes=length_of(runs_of(evidence.cells)))


def runs_of(cells: NDArray[np.uint8]) -> bytes:
    """Return runs: four times the length and the state, each a number of as many bytes as it needs.

    >>> list(runs_of(np.array([0, 0, 0, 1, 1, 2], dtype=np.uint8)))
    [12, 9, 6]
    """
    flat = cells.ravel()
    starts = np.concatenate([[0], np.flatnonzero(np.diff(flat)) + 1]) if len(flat) else np.zeros(0, dtype=np.int64)
    lengths = np.diff(starts, append=len(flat))
    return numbers(4 * lengths + flat[starts])


def numbers(values: NDArray[np.int64]) -> bytes:
    """Return numbers of 0 and more, seven bits to a byte, the lowest first (LEB128).

    >>> list(numbers(np.array([5, 300])))
    [5, 172, 2]
    """
    found = bytearray()
    for number in values.tolist():
        left = number
        while left >> _LOW_BITS:
            found.append(left & 0x7F | 0x80)
            left >>= _LOW_BITS
        found.append(left)
    return bytes(found)


def length_of(message: bytes) -> int:
    """Return the bytes of a message, deflated where that is shorter, and one that says which."""
    return 1 + min(len(message), len(zlib.compress(message, 9)))


def outlines(evidence: Evidence, *, budget_bytes: int) -> Sent:
    """Send outlines of what is present and of what is unknown, with the least tolerance that the budget allows.

    Outlines lose points, and those that are smaller than the square of the tolerance are lost. Where the largest
    tolerance is too long, the largest outlines are sent.
    """
    masks = _masks(evidence)
    shapes = [_polygons(mask) for _, _, mask in masks]
    message: list[list[Outline]] = []
    for tolerance in TOLERANCES_CELLS:
        message = [_simplified(some, tolerance) for some in shapes]
        if length_of(_outline_bytes(message)) <= budget_bytes:
            break
    else:
        message = _largest(message, budget_bytes)
    cells = np.full(evidence.cells.shape, ABSENT, dtype=np.uint8)
    for (classes, state, _), some in zip(masks, message, strict=True):
        # Cells whose middles lie in one of the outlines
        from rasterio.features import rasterize  # noqa: PLC0415 - suites are listed without it

        polygons = [shapely.Polygon(rings[0], rings[1:]) for rings in some]
        filled = (
            np.zeros(evidence.shape, dtype=bool)
            if not polygons
            else np.asarray(rasterize(polygons, out_shape=evidence.shape) > 0)
        )
        cells[classes] = np.where(filled, np.uint8(state), cells[classes])
    return Sent(evidence=evidence.replace(cells), bytes=length_of(_outline_bytes(message)))


def _masks(evidence: Evidence) -> list[tuple[list[int], int, Mask]]:
    """Return the classes, state and cells of each layer to send: presence, further unknown cells, and common ones."""
    cells, every = evidence.cells, list(range(len(evidence.cells)))
    common = (cells == UNKNOWN).all(axis=0)
    layers = [([at], PRESENT, cells[at] == PRESENT) for at in every]
    layers += [([at], UNKNOWN, (cells[at] == UNKNOWN) & ~common) for at in every]
    return [*layers, (every, UNKNOWN, common)]


def _polygons(mask: Mask) -> NDArray[np.object_]:
    from rasterio.features import shapes  # noqa: PLC0415 - suites are listed without it

    found = [shapely.geometry.shape(item) for item, _ in shapes(mask.astype(np.uint8), mask=mask)]
    return np.array(found, dtype=object)


def _simplified(shapes: NDArray[np.object_], tolerance: float) -> list[Outline]:
    """Return polygons with fewer points, in whole cells; small ones are dropped."""
    kept = shapes[shapely.area(shapes) >= tolerance**2] if len(shapes) else shapes
    found = []
    for shape in shapely.simplify(kept, tolerance):
        rings = [np.rint(shapely.get_coordinates(ring)).astype(np.int64) for ring in shapely.get_rings(shape)]
        if rings and len(rings[0]) >= _RING:
            found.append([ring for ring in rings if len(ring) >= _RING])
    return found


def _outline_bytes(message: Sequence[Sequence[Outline]]) -> bytes:
    """Return numbers of polygons, of rings and of points, then steps from point to point, forth and back in turn."""
    values: list[int] = []
    for some in message:
        values.append(len(some))
        for rings in some:
            values.append(len(rings))
            for ring in rings:
                steps = np.diff(ring[:-1], axis=0, prepend=0).ravel()
                values += [len(ring) - 1, *np.where(steps >= 0, 2 * steps, -2 * steps - 1).tolist()]
    return numbers(np.array(values, dtype=np.int64))


def _largest(message: list[list[Outline]], budget_bytes: int) -> list[list[Outline]]:
    places = [(layer, at) for layer, some in enumerate(message) for at in range(len(some))]
    order = sorted(places, key=lambda place: (-shapely.Polygon(message[place[0]][place[1]][0]).area, *place))

    def first(count: int) -> list[list[Outline]]:
        chosen = set(order[:count])
        return [[rings for at, rings in enumerate(some) if (layer, at) in chosen] for layer, some in enumerate(message)]

    return first(most_within(lambda count: length_of(_outline_bytes(first(count))), len(order), budget_bytes))


def junctions(evidence: Evidence, vectors: "gpd.GeoDataFrame", *, budget_bytes: int) -> Sent:
    """Send places and arms of junctions in perceived vectors, those with most arms first; all other ground is unknown.

    A place has a byte for each axis, an arm one for its direction; the class of a road is not sent: its arms arrive as
    lines and cells of a minor road.
    """
    found = sorted(_junctions(vectors), key=lambda one: (-len(one[1]), np.hypot(*one[0]), *one[0]))
    side_m = max(evidence.size_m)

    def message(count: int) -> bytes:
        rows = [[*_place_steps(place_m, side_m), len(arms), *arms] for place_m, arms in found[:count]]
        return bytes([value for row in rows for value in row])

    count = most_within(lambda count: length_of(message(count)), len(found), budget_bytes)
    lines = []
    for place_m, arms in found[:count]:
        middle_m = (np.array(_place_steps(place_m, side_m)) + 0.5) / _PLACE_STEPS * side_m - side_m / 2
        turns = np.radians(np.array(arms) * 360.0 / _ARM_STEPS)
        ends_m = middle_m + ARM_M * np.column_stack([np.sin(turns), np.cos(turns)])
        lines += [shapely.LineString([middle_m, end_m]).intersection(_frame(evidence)) for end_m in ends_m]
    table = vector_table([("road_minor", 0, False, line) for line in lines if line.length > 0])
    return Sent(evidence=_drawn(evidence, lines), bytes=length_of(message(count)), vectors=table)


def _junctions(vectors: "gpd.GeoDataFrame") -> Iterator[tuple[tuple[float, float], list[int]]]:
    """Yield place (right, up) and directions of the arms of each junction, in steps of a circle, sorted."""
    features = as_features(vectors)
    nodes = build_graph(features).nodes
    chosen = nodes[(nodes["kind"] == "intersection").to_numpy() & (nodes["degree"] >= _FORK).to_numpy()]
    is_road = features["class"].isin(load_taxonomy().of_graph("road")).to_numpy()
    is_line = shapely.get_dimensions(features.geometry.to_numpy()) == 1  # squares have no arms, and may be invalid
    roads = shapely.union_all(features.geometry.to_numpy()[is_road & is_line])
    for place in chosen.geometry:
        rim = shapely.intersection(roads, place.buffer(ARM_M).exterior)
        away_m = shapely.get_coordinates(rim) - shapely.get_coordinates(place)
        turns = np.mod(np.rint(np.degrees(np.arctan2(*away_m.T)) * _ARM_STEPS / 360.0), _ARM_STEPS)
        yield (float(place.x), float(place.y)), sorted({int(turn) for turn in turns})


def _place_steps(place_m: tuple[float, float], side_m: float) -> list[int]:
    steps = np.floor((np.array(place_m) / side_m + 0.5) * _PLACE_STEPS)
    return [int(value) for value in np.clip(steps, 0, _PLACE_STEPS - 1)]


def _frame(evidence: Evidence) -> shapely.Polygon:
    width_m, height_m = evidence.size_m
    return shapely.box(-width_m / 2, -height_m / 2, width_m / 2, height_m / 2)


ARM_WIDTH_M: Final = 4.0  # of that road, where cells are made of it


def _drawn(evidence: Evidence, lines: Sequence[shapely.Geometry]) -> Evidence:
    cells = np.full(evidence.cells.shape, UNKNOWN, dtype=np.uint8)
    if lines and "road_minor" in evidence.classes:
        near = shapely.union_all(lines).buffer(ARM_WIDTH_M / 2)
        middles_m = cell_offsets_m(evidence.shape, evidence.cell_size_m)
        is_road = shapely.contains_xy(near, middles_m[:, 0], middles_m[:, 1]).reshape(evidence.shape)
        cells[evidence.classes.index("road_minor"), is_road] = PRESENT
    return evidence.replace(cells)


def regions_of_interest(evidence: Evidence, shares: NDArray[np.float64], *, budget_bytes: int) -> Sent:
    """Send the squares that say most for their bytes; the rest arrives as unknown.

    Parameters
    ----------
    evidence : Evidence
        The view.
    shares : ndarray of float, shape (C,)
        Share of each class of the view on the map that the drone carries.
    budget_bytes : int
        Longest message.

    Notes
    -----
    A run of known cells says -log2 of the share of its state on the map, however long it is, since its cells belong
    together; a square's bytes are those of its runs.
    """
    # First row and column of each square
    shape = evidence.shape
    corners = [(row, col) for row in range(0, shape[0], TILE_CELLS) for col in range(0, shape[1], TILE_CELLS)]
    parts = [_part(evidence.cells, corner) for corner in corners]
    worth = [information_bits(part, shares) / len(runs_of(part)) for part in parts]
    order = sorted(range(len(corners)), key=lambda at: (-worth[at], at))

    def message(count: int) -> bytes:
        return b"".join(numbers(np.array([at])) + runs_of(parts[at]) for at in order[:count])

    count = most_within(lambda count: length_of(message(count)), len(order), budget_bytes)
    cells = np.full(evidence.cells.shape, UNKNOWN, dtype=np.uint8)
    for at in order[:count]:
        _part(cells, corners[at])[:] = parts[at]
    return Sent(evidence=evidence.replace(cells), bytes=length_of(message(count)))


def _part(cells: NDArray[np.uint8], corner: tuple[int, int]) -> NDArray[np.uint8]:
    row, col = corner
    return cells[:, row : row + TILE_CELLS, col : col + TILE_CELLS]


def information_bits(cells: NDArray[np.uint8], shares: NDArray[np.float64]) -> float:
    """Return what the runs of some cells, shape (C, rows, cols), say together.

    >>> cells = np.zeros((1, 1, 8), dtype=np.uint8)
    >>> cells[0, 0, 2:5] = 1
    >>> round(information_bits(cells, np.array([0.25])), 3)  # a run of a quarter, between two of three quarters
    2.83
    """
    share = np.clip(shares, _LEAST_SHARE, 1.0 - _LEAST_SHARE)
    bits = np.stack([-np.log2(1.0 - share), -np.log2(share), np.zeros(len(share))], axis=1)
    flat = cells.reshape(len(cells), -1)
    begins = np.ones(flat.shape, dtype=bool)
    begins[:, 1:] = flat[:, 1:] != flat[:, :-1]
    return float(bits[np.arange(len(cells))[:, None], flat][begins].sum())


def most_within(length: Callable[[int], int], most: int, budget_bytes: int) -> int:
    """Return the largest number, up to `most`, whose message is within a budget; lengths grow with the number.

    >>> most_within(lambda count: 10 * count + 1, 9, 45)
    4
    """
    low, high = 0, most
    while low < high:
        middle = (low + high + 1) // 2
        if length(middle) <= budget_bytes:
            low = middle
        else:
            high = middle - 1
    return low
