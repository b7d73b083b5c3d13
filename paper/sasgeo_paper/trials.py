# SPDX-License-Identifier: Apache-2.0
"""One trial of the experiment: its candidates, and its transformed view."""

import math
from dataclasses import dataclass
from typing import Final, Literal

import numpy as np
from numpy.typing import NDArray

from sasgeo_bench.boards.pipeline_spec import Crop
from sasgeo_bench.geometry.pose import Pose
from sasgeo_bench.regions.evidence import ABSENT, UNKNOWN, Evidence
from sasgeo_bench.tasks.perturbations.ageing import Ageing, Rates
from sasgeo_bench.tasks.perturbations.base import Mask, check_ranges, hide
from sasgeo_bench.tasks.perturbations.occlusion import CentralCrop
from sasgeo_bench.tasks.state import State
from sasgeo_bench.tasks.suites.base import Seeds
from sasgeo_paper.tiles import CELL_M, CLASSES, WINDOW_CELLS, Windows

Around = Literal["anchor", "truth"]

ROTATIONS_DEG: Final = (0.0, 30.0, 60.0, 90.0)
SCALES: Final = (0.85, 1.0, 1.15)
CROP_FRACTIONS: Final = (0.70, 0.85, 1.0)
MOST_OCCLUDED: Final = 0.24
MOST_CHANGED: Final = 0.32
# By how much less likely than the most volatile class each is to change; the paper gives no numbers.
CHANGE_FACTORS: Final = {
    "road_major": 0.25,
    "water": 0.25,
    "road_minor": 0.5,
    "building": 0.75,
    "field_boundary": 1.0,
}
_LONGEST: Final = 2.0  # sides of an occluding rectangle at most


@dataclass(frozen=True, slots=True, kw_only=True)
class Transformation:
    """Changes to the view of one trial, none by default; `PerturbError` if a value is beyond the ranges of the paper.

    `rotation_deg` is the heading of the view, clockwise from north; `scale` metres on the ground for each side of a
    view's cell; `crop_fraction` the share of the view retained around its middle; `occlusion_share` the share of cells
    behind one rectangle; `change_probability` that of an object of the most volatile class.
    """

    rotation_deg: float = 0.0
    scale: float = 1.0
    crop_fraction: float = 1.0
    occlusion_share: float = 0.0
    change_probability: float = 0.0

    def __post_init__(self) -> None:
        """Check the ranges."""
        check_ranges(
            self,
            rotation_deg=(min(ROTATIONS_DEG), max(ROTATIONS_DEG)),
            scale=(min(SCALES), max(SCALES)),
            crop_fraction=(min(CROP_FRACTIONS), max(CROP_FRACTIONS)),
            occlusion_share=(0, MOST_OCCLUDED),
            change_probability=(0, MOST_CHANGED),
        )


def draw_transformation(rng: np.random.Generator) -> Transformation:
    """Draw every part independently: values of a set with equal probability, shares and probabilities uniformly."""
    return Transformation(
        rotation_deg=float(rng.choice(ROTATIONS_DEG)),
        scale=float(rng.choice(SCALES)),
        crop_fraction=float(rng.choice(CROP_FRACTIONS)),
        occlusion_share=float(rng.uniform(0, MOST_OCCLUDED)),
        change_probability=float(rng.uniform(0, MOST_CHANGED)),
    )


@dataclass(frozen=True, kw_only=True)
class Crops:
    """Candidates of one trial as numbers of windows, in display order, and the index of the true one."""

    windows: NDArray[np.int64]
    true: int


def draw_crops(windows: Windows, rng: np.random.Generator, *, around: Around = "anchor") -> Crops:
    """Draw ten similar windows, those nearest to a random one, and one of them as the true one.

    Were the others the nearest to the true one, as with `around` "truth", it would lie in their middle: ranking
    candidates by distance from the mean of all ten would find it in a third of the trials without using the query.
    """
    alike = windows.alike(int(rng.integers(len(windows.tile))))
    shown = rng.permutation(alike)
    if around == "truth":
        return Crops(windows=shown, true=int(np.flatnonzero(shown == alike[0])[0]))
    return Crops(windows=shown, true=int(rng.integers(len(shown))))


def rectangle(shape: tuple[int, int], share: float, rng: np.random.Generator) -> NDArray[np.bool_]:
    """Return a random rectangle in a view that covers a share of it, or up to a row less; shape (rows, cols).

    >>> covered = rectangle((96, 96), 0.24, np.random.default_rng(0))
    >>> bool(0.23 < covered.mean() <= 0.24)
    True
    """
    stretch = _LONGEST ** float(rng.uniform(-0.5, 0.5))
    area_cells = share * shape[0] * shape[1]
    rows = min(shape[0], max(1, round(math.sqrt(area_cells) * stretch)))
    cols = min(shape[1], int(area_cells / rows))
    top, left = rng.integers(0, (shape[0] - rows + 1, shape[1] - cols + 1)).tolist()
    covered = np.zeros(shape, dtype=bool)
    covered[top : top + rows, left : left + cols] = True
    return covered


def map_change(probability: float) -> Ageing:
    """Change the world against the map: objects vanish, and as many new ones appear.

    >>> rates = map_change(0.32).rates["building"]
    >>> round(1 - math.exp(-rates.vanish_per_year), 2), round(math.expm1(rates.appear_per_year), 2)
    (0.24, 0.24)
    """
    by_class = {name: factor * probability for name, factor in CHANGE_FACTORS.items()}
    rates = {
        name: Rates(vanish_per_year=-math.log1p(-chance), appear_per_year=math.log1p(chance))
        for name, chance in by_class.items()
    }
    return Ageing(years=1.0, rates=rates, place="procedural")


@dataclass(frozen=True, kw_only=True)
class View:
    """One trial: the evidence, the map at the same pose, and the world there before any of it is hidden.

    `visible` is the evidence with all unknown that was cropped or occluded; it differs from `evidence` where cropped
    cells are read otherwise. `occlusion_share` and `retained_share` are those of the cells that the rectangle covers
    and the crop leaves.
    """

    evidence: Evidence
    visible: Evidence
    mapped: Evidence
    world: Evidence
    occlusion_share: float
    retained_share: float


def draw_view(
    state: State, center_m: tuple[float, float], done: Transformation, seeds: Seeds, *, crop: Crop = "unknown"
) -> View:
    """Rotate, scale, change, crop and occlude, in this order, a view around an easting and northing.

    `crop` decides what becomes of the cropped cells, and nothing else: the same seeds draw the same view.
    """
    pose = true_pose(center_m, done)
    mapped = only_paper(state.view(pose, size_cells=WINDOW_CELLS, cell_size_m=CELL_M))
    world = map_change(done.change_probability)(mapped, seeds.rng("change"))
    # Beyond the tile there is nothing to be seen, so no cell of the world is unknown.
    cropped = CentralCrop(share=1 - done.crop_fraction)(world, seeds.rng("crop"))
    covered = rectangle(world.shape, done.occlusion_share, seeds.rng("occlusion"))
    visible = hide(cropped, covered)
    return View(
        evidence=read_crop(visible, is_cropped=cropped.cells[0] == UNKNOWN, is_covered=covered, crop=crop),
        visible=visible,
        mapped=mapped,
        world=world,
        occlusion_share=float(covered.mean()),
        retained_share=1 - cropped.unknown_share,
    )


def read_crop(visible: Evidence, *, is_cropped: Mask, is_covered: Mask, crop: Crop) -> Evidence:
    """Return a view whose cropped cells are read as `PaperSpec` says; `is_cropped` and `is_covered` are (rows, cols).

    A cropped cell that is also covered stays unknown under "absent". "smaller" keeps the rows and columns within the
    crop, cell by cell.

    >>> ring = np.array([[1, 1, 1], [1, 0, 1], [1, 1, 1]], dtype=bool)
    >>> pond = Evidence(classes=("water",), cells=np.where(ring, 2, 1).astype(np.uint8)[None], cell_size_m=1.0)
    >>> hidden = {"is_cropped": ring, "is_covered": np.tri(3, k=-1, dtype=bool)}
    >>> read_crop(pond, **hidden, crop="absent").cells[0].tolist()
    [[0, 0, 0], [2, 1, 0], [2, 2, 0]]
    >>> read_crop(pond, **hidden, crop="smaller").cells.tolist()
    [[[1]]]
    """
    if crop == "absent":
        return visible.replace(np.where(is_cropped & ~is_covered, np.uint8(ABSENT), visible.cells))
    if crop == "smaller":
        rows, cols = (~is_cropped).any(axis=1), (~is_cropped).any(axis=0)
        return visible.replace(np.ascontiguousarray(visible.cells[:, rows][:, :, cols]))
    return visible


def true_pose(center_m: tuple[float, float], done: Transformation) -> Pose:
    """Return the pose of a trial's view."""
    return Pose(easting_m=center_m[0], northing_m=center_m[1], yaw_deg=done.rotation_deg, scale=done.scale)


def only_paper(view: Evidence) -> Evidence:
    """Keep the five layers of the paper."""
    cells = view.cells[[view.classes.index(name) for name in CLASSES]]
    return Evidence(classes=CLASSES, cells=cells, cell_size_m=view.cell_size_m)
