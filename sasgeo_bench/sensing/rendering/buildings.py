# SPDX-License-Identifier: Apache-2.0
"""Buildings as blocks with a roof: heights, forms and materials estimated from outline and surroundings.

Features keep no tags beyond their class, so `building:levels` and `height` are not at hand: storeys follow from the
area of the outline and from how densely the ground around is built, with a spread drawn for each building.
"""

from dataclasses import dataclass
from typing import Final

import numpy as np
import shapely
from numpy.typing import NDArray

from sasgeo_bench.sensing.rendering.palettes import Cover, Palette, Roofing
from sasgeo_bench.sensing.rendering.plan import Mask, Plan, Shapes
from sasgeo_bench.sensing.rendering.texture import Numbers, bell, draw, seed_of

FLAT, GABLE, HIP = range(3)
COVERS: Final[tuple[Cover, ...]] = ("tiles", "slates", "sheets", "membrane", "gravel", "thatch")

_BLOCK_M: Final = 60.0  # cells in which built ground is summed, three by three
_MOST_RISE_M: Final = 7.0


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Buildings:
    """Arrays of N buildings: the rectangle around each (centre, axis along its ridge, half sides), heights, materials.

    `eave_m` is the height of the walls; a roof rises by `pitch` from there. `cover` counts in `COVERS`.
    """

    shapes: Shapes
    centre_m: Numbers
    axis: Numbers
    half_m: Numbers
    eave_m: Numbers
    pitch: Numbers
    form: NDArray[np.uint8]
    cover: NDArray[np.uint8]
    roof: Numbers
    wall: Numbers
    rust: Numbers

    def __len__(self) -> int:
        return len(self.eave_m)


def style_buildings(plan: Plan, relief: float) -> Buildings:
    """Return the buildings of a plan; `relief` multiplies all heights (0 lays every building flat on the ground)."""
    shapes = plan.of("building")
    centre_m, axis, half_m = rectangles(shapes.geometry)
    area_m2 = shapely.area(shapes.geometry)
    key = shapes.key
    storeys = estimate_storeys(area_m2, crowding(shapes.geometry), seed=plan.seed("storeys"), key=key)
    fill = area_m2 / np.maximum(4 * half_m.prod(axis=1), 1e-6)
    # Flat, gabled or hipped: what is large, high or small is flat, what is no rectangle is hipped
    is_large = np.clip((np.log(np.maximum(area_m2, 1)) - np.log(350)) / np.log(4), 0, 1) * 0.85
    flat = np.maximum(plan.palette.flat_share, np.where(storeys > 6, 1.0, is_large))
    is_flat = (plan.chance("flat", key) < flat) | ((area_m2 < 30) & (plan.chance("shed", key) < 0.5))
    is_gable = (fill > 0.86) & (plan.chance("gable", key) < 0.78)
    form = np.where(is_flat, FLAT, np.where(is_gable, GABLE, HIP)).astype(np.uint8)
    low, high = plan.palette.roof_pitch
    pitch = np.where(form == FLAT, 0.0, low + (high - low) * plan.chance("pitch", key))
    pitch = np.minimum(pitch, _MOST_RISE_M / np.maximum(half_m[:, 1], 1e-6))
    roof, cover, rust = _materials(plan, key, form == FLAT)
    walls = np.array(plan.palette.walls)
    wall = (
        walls[(plan.chance("wall", key) * len(walls)).astype(int)] * (1 + 0.1 * bell(plan.seed("paint"), key))[:, None]
    )
    eave_m = plan.palette.storey_m * storeys * (1 + 0.06 * bell(plan.seed("eave"), key)) + 0.3
    return Buildings(
        shapes=shapes,
        centre_m=centre_m,
        axis=axis,
        half_m=half_m,
        eave_m=eave_m * relief,
        pitch=pitch * relief,
        form=form,
        cover=cover,
        roof=roof,
        wall=wall,
        rust=rust,
    )


def rectangles(outlines: NDArray[np.object_]) -> tuple[Numbers, Numbers, Numbers]:
    """Return centre (N, 2), direction of the long side (N, 2) and half sides (N, 2) of the rectangle around each."""
    if not len(outlines):
        return np.zeros((0, 2)), np.zeros((0, 2)), np.zeros((0, 2))
    boxes = shapely.oriented_envelope(outlines)
    corners = np.stack([shapely.get_coordinates(box)[:4] for box in boxes])
    first, second = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 1]
    lengths = np.stack([np.hypot(*first.T), np.hypot(*second.T)], axis=1)
    is_first = lengths[:, 0] >= lengths[:, 1]
    axis = np.where(is_first[:, None], first, second) / np.maximum(lengths.max(axis=1), 1e-6)[:, None]
    half_m = np.stack([lengths.max(axis=1), lengths.min(axis=1)], axis=1) / 2
    return corners.mean(axis=1), axis, half_m


def crowding(outlines: NDArray[np.object_]) -> Numbers:
    """Return the share of built ground within about 90 m of each outline, shape (N,)."""
    if not len(outlines):
        return np.zeros(0)
    blocks = np.floor(shapely.get_coordinates(shapely.centroid(outlines)) / _BLOCK_M).astype(int)
    blocks -= blocks.min(axis=0) - 1
    built_m2 = np.zeros(blocks.max(axis=0) + 2)
    np.add.at(built_m2, tuple(blocks.T), shapely.area(outlines))
    steps = [(i, j) for i in (-1, 0, 1) for j in (-1, 0, 1)]
    around = np.sum([built_m2[blocks[:, 0] + i, blocks[:, 1] + j] for i, j in steps], axis=0)
    return np.asarray(around / (9 * _BLOCK_M**2))


def estimate_storeys(area_m2: Numbers, crowded: Numbers, *, seed: int, key: NDArray[np.int64]) -> Numbers:
    """Return a likely number of storeys, at least 0.8, for buildings of an area on ground built to a share.

    Sheds have one storey, houses one or two, blocks in dense quarters three to seven, halls one or two high ones;
    one in 25 of the middling buildings of a dense quarter is a tower.

    >>> area_m2, crowded = np.array([12.0, 120.0, 600.0]), np.array([0.1, 0.1, 0.4])
    >>> estimate_storeys(area_m2, crowded, seed=1, key=np.arange(3)).round(1).tolist()
    [0.8, 2.2, 4.5]
    """
    dense = np.clip((crowded - 0.12) / 0.25, 0.0, 1.0)
    house = np.clip(0.9 + (area_m2 - 30) / 90, 0.8, 2.2) + 1.2 * dense * (area_m2 > 60)
    block = 2.2 + 3.4 * dense
    hall = 2.0 + 1.8 * dense
    size = np.clip((np.log(np.maximum(area_m2, 1.0)) - np.log(250)) / np.log(2), 0.0, 1.0)
    large = np.clip((np.log(np.maximum(area_m2, 1.0)) - np.log(1200)) / np.log(2), 0.0, 1.0)
    middle = (1 - size) * house + size * block
    storeys = ((1 - large) * middle + large * hall) * (1 + 0.18 * bell(seed, key))
    is_tower = (area_m2 > 250) & (area_m2 < 1600) & (dense > 0.25) & (draw(seed + 1, key) < 0.04)
    storeys = np.where(is_tower, 8 + 9 * draw(seed + 2, key), storeys)
    return np.where(area_m2 < 30, 0.8, np.maximum(storeys, 0.9))


def _materials(plan: Plan, key: NDArray[np.int64], is_flat: Mask) -> tuple[Numbers, NDArray[np.uint8], Numbers]:
    """Return colour (N, 3), cover (N,) and share of rust (N,) of each roof; each place prefers some of the kinds."""
    colour, cover, rust = np.zeros((len(key), 3)), np.zeros(len(key), dtype=np.uint8), np.zeros(len(key))
    for chosen, roofings in ((~is_flat, plan.palette.pitched), (is_flat, plan.palette.flat)):
        edges = np.cumsum(_preferred(plan.palette, plan.place, roofings))
        pick = np.searchsorted(edges / edges[-1], plan.chance("roof", key), side="right").clip(0, len(roofings) - 1)
        for number, roofing in enumerate(roofings):
            mine = np.flatnonzero(chosen & (pick == number))
            tone = 1 + roofing.spread * bell(plan.seed("tone"), key[mine])
            hue = 0.016 * np.stack([bell(plan.seed(f"hue{band}"), key[mine]) for band in range(3)], axis=1)
            colour[mine] = np.array(roofing.colour) * (tone[:, None] + hue)
            cover[mine] = COVERS.index(roofing.cover)
            rust[mine] = roofing.rust * plan.chance("rust", key[mine])
    return np.clip(colour, 12, 250), cover, rust


def _preferred(palette: Palette, place: str, roofings: tuple[Roofing, ...]) -> Numbers:
    """Return the weights of kinds of roof at a place: some villages are red, some grey."""
    taste = draw(seed_of(palette.family, place, "taste"), np.arange(len(roofings)))
    return np.array([roofing.weight for roofing in roofings]) * (0.25 + 1.75 * taste)
