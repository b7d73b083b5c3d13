# SPDX-License-Identifier: Apache-2.0
"""The experiment as a region and a task on disk, and its trials: candidates and transformed views."""

import datetime as dt
import hashlib
import json
import math
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any, Final

import numpy as np
import pyproj
import shapely
from numpy.typing import NDArray

from sasgeo_bench.errors import ConfigError, StoreError
from sasgeo_bench.experiments.paper.tiles import (
    CELL_M,
    CLASSES,
    EPSG,
    MARGIN_M,
    TILES,
    WINDOW_CELLS,
    WINDOW_M,
    Windows,
    make_tiles,
    mosaic_grid,
    tile_boxes,
)
from sasgeo_bench.geometry.pose import Pose
from sasgeo_bench.leaderboard.pipeline_spec import PAPER_SUITE
from sasgeo_bench.osm.locate import Extract
from sasgeo_bench.osm.read import Reading
from sasgeo_bench.osm.taxonomy import load_taxonomy
from sasgeo_bench.progress import Tell
from sasgeo_bench.regions import region_files
from sasgeo_bench.regions.build import build_made
from sasgeo_bench.regions.evidence import PRESENT, Evidence
from sasgeo_bench.regions.region import DATA_VERSION, SCHEMA_VERSION, Region
from sasgeo_bench.regions.region_spec import RegionFile
from sasgeo_bench.tasks import task_files
from sasgeo_bench.tasks.build import check_task, has_truths, put_task
from sasgeo_bench.tasks.perturbations.ageing import Ageing, Rates
from sasgeo_bench.tasks.perturbations.base import check_ranges, hide
from sasgeo_bench.tasks.perturbations.occlusion import CentralCrop
from sasgeo_bench.tasks.private_seed import PrivateSeed, seed_record
from sasgeo_bench.tasks.query import TASK_VERSION, PriorGroup, Query, Truth
from sasgeo_bench.tasks.sampling import make_prior
from sasgeo_bench.tasks.suites.base import DRAWN_CLASSES, Seeds, State, changed_share
from sasgeo_bench.tasks.suites.mining import Windows as MinedWindows
from sasgeo_bench.tasks.suites.mining import describe, mine
from sasgeo_bench.tasks.task_plan import check_roots

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


def draw_crops(windows: Windows, rng: np.random.Generator) -> Crops:
    """Draw ten similar windows, and one of them as the true one.

    Were the others the nearest to the true one, it would lie in their middle: ranking candidates by distance from the
    mean of all ten would find it in a third of the trials without using the query.
    """
    alike = windows.alike(int(rng.integers(len(windows.tile))))
    shown = rng.permutation(alike)
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

    `occlusion_share` and `retained_share` are those of the cells that the rectangle covers and the crop leaves.
    """

    evidence: Evidence
    mapped: Evidence
    world: Evidence
    occlusion_share: float
    retained_share: float


def draw_view(state: State, center_m: tuple[float, float], done: Transformation, seeds: Seeds) -> View:
    """Rotate, scale, change, crop and occlude, in this order, a view around an easting and northing."""
    pose = true_pose(center_m, done)
    mapped = only_paper(state.view(pose, size_cells=WINDOW_CELLS, cell_size_m=CELL_M))
    world = map_change(done.change_probability)(mapped, seeds.rng("change"))
    # Beyond the tile there is nothing to be seen, so no cell of the world is unknown.
    cropped = CentralCrop(share=1 - done.crop_fraction)(world, seeds.rng("crop"))
    covered = rectangle(world.shape, done.occlusion_share, seeds.rng("occlusion"))
    return View(
        evidence=hide(cropped, covered),
        mapped=mapped,
        world=world,
        occlusion_share=float(covered.mean()),
        retained_share=1 - cropped.unknown_share,
    )


def true_pose(center_m: tuple[float, float], done: Transformation) -> Pose:
    """Return the pose of a trial's view."""
    return Pose(easting_m=center_m[0], northing_m=center_m[1], yaw_deg=done.rotation_deg, scale=done.scale)


def only_paper(view: Evidence) -> Evidence:
    """Keep the five layers of the paper."""
    cells = view.cells[[view.classes.index(name) for name in CLASSES]]
    return Evidence(classes=CLASSES, cells=cells, cell_size_m=view.cell_size_m)


SUITE: Final = PAPER_SUITE
VERSION: Final = 1
TRIALS: Final = 220
GROUP: Final = PriorGroup(radius_m=None, yaw="unknown", scale_sigma=0.15)
DATE: Final = dt.date(2026, 1, 1)
STRENGTH_UNIT: Final = "map-change probability"
DATA: Final = "procedural regions, no OSM data in them"  # source stated by pictures and tables


def make_paper_task(
    *, seed: int, out: Path, trials: int = TRIALS, private: PrivateSeed | None = None, tell: Tell
) -> Path:
    """Make the paper's 30 regions, draw its retrieval trials on them, and return the folder of the task.

    The region is written to `out/regions/paper-poc-<seed>`, the task to `out/tasks/paper-poc/paper-poc-<seed>`; the
    paper's seed is 42. The first of many `trials` are those of a shorter request. `private` replaces the seed of all
    random draws; the public seed is then a name. Raise `ConfigError` if the seed is negative, there are no trials, or
    truths would lie where the queries are; `StoreError` if a folder cannot be written, or holds something else.
    """
    if seed < 0:
        message = f"the seed names the region and must be 0 or more, got {seed}"
        raise ConfigError(message)
    if trials < 1:
        message = f"there must be at least one trial, got {trials}"
        raise ConfigError(message)
    check_roots(out)
    seeds = Seeds(root=seed, names=(SUITE, str(VERSION)))
    if private is not None:
        seeds = Seeds(root=private, names=(SUITE, str(VERSION), str(seed)))
    tell(f"{region_name(seed)}: drawing {TILES} tiles")
    folder = build_made(_spec(seed), _generated(seed, seeds), out=out, tell=tell)
    drawer = PaperDrawer.of(region_files.read_region(folder), seeds)
    pairs = sorted((drawer.draw(index) for index in range(trials)), key=lambda pair: pair[0].query_id)
    hidden = {**seed_record(private or seed), "request_sha256": _request_sha256(seed, trials, private)}
    made = put_task(pairs, _about(drawer.region), hidden, out=out, tell=tell)
    tell(f"{SUITE} on {region_name(seed)}: {made.queries} trials in {made.folder}")
    return made.folder


def made_paper_task(*, seed: int, out: Path, trials: int = TRIALS, private: PrivateSeed | None = None) -> Path | None:
    """Return the task folder of these trials, or None if they have to be drawn; nothing is drawn to find out.

    Task, truths and region are as they were written, and nothing that decides their content has changed since.
    """
    folder = out / "tasks" / SUITE / region_name(seed)
    record = task_files.read_hidden(out / "truth" / SUITE / region_name(seed))
    if record.get("request_sha256") != _request_sha256(seed, trials, private):
        return None
    try:
        faults = [*check_task(folder, out=out), *region_files.differing_files(out / "regions" / region_name(seed))]
        return folder if not faults and has_truths(folder, out=out) else None
    except StoreError:
        return None


def _request_sha256(seed: int, trials: int, private: PrivateSeed | None) -> str:
    """Hash all that decides which trials a seed gives; the recipe itself is in it by its version."""
    record = {
        "suite": [SUITE, VERSION, TASK_VERSION],
        "region": [SCHEMA_VERSION, DATA_VERSION, load_taxonomy().model_dump(mode="json")],
        "seed": seed,
        "trials": trials,
        "made_by": version("sasgeo-bench"),
    }
    if private is not None:
        record["private_seed"] = private.commitment
    return hashlib.sha256(json.dumps(record, sort_keys=True).encode()).hexdigest()


def region_name(seed: int) -> str:
    """Return the name of the region of a seed, as in paper-poc-42."""
    return f"{SUITE}-{seed}"


def _spec(seed: int) -> RegionFile:
    """Return the place of the mosaic as a region specification."""
    grid = mosaic_grid()
    west_m, south_m, east_m, north_m = grid.bounds_m
    to_lonlat = pyproj.Transformer.from_crs(EPSG, 4326, always_xy=True)
    center_lonlat = to_lonlat.transform((west_m + east_m) / 2, (south_m + north_m) / 2)
    generated = Extract(file=f"{region_name(seed)}.generated", date=DATE, sha256=("0" * 64,))
    return RegionFile(
        id=region_name(seed),
        title=f"Procedural regions of the SASGeo paper's experiment, seed {seed}",
        scenes=["suburban", "agricultural"],
        center_lonlat=center_lonlat,
        size_m=(east_m - west_m, north_m - south_m),
        cell_size_m=CELL_M,
        epsg=EPSG,
        extract=[generated],
    )


def _generated(seed: int, seeds: Seeds) -> Reading:
    """Return the tiles in the form of a read extract."""
    return Reading(
        features=make_tiles(seeds),
        coverage=shapely.multipolygons(tile_boxes()),
        coverage_source="region file",
        osm_timestamp=None,
        drops={},
        hidden={},
        notes={},
        warnings=(f"procedural, seed {seed}: generated by sasgeo_bench.paper from no extract; no OSM data are in it",),
    )


def _about(region: Region) -> dict[str, Any]:
    """Return the `task.json` of the queries, without their places."""
    return {
        "suite": SUITE,
        "suite_version": VERSION,
        "title": "The paper's synthetic proof of concept",
        "what": "turned, magnified, cropped, occluded and changed views of procedural regions; ten candidates",
        "separates": "global description from spatial alignment",
        "falsifier": "none",
        "strength_unit": STRENGTH_UNIT,
        "region": region.manifest.id,
        "map_date": region.manifest.extract.date.isoformat(),
        **task_files.map_of(region.manifest),
        "sites": TILES,
        "views_cells": [WINDOW_CELLS],
        "epsg": region.manifest.epsg,
        "made_by": f"sasgeo-bench {version('sasgeo-bench')}",
    }


@dataclass(frozen=True, kw_only=True)
class PaperDrawer:
    """Draw the trials of one region."""

    region: Region
    seeds: Seeds
    state: State
    windows: Windows
    mined: MinedWindows

    @classmethod
    def of(cls, region: Region, seeds: Seeds) -> "PaperDrawer":
        """Describe the region's candidate crops."""
        state = State.of(region)
        return cls(
            region=region,
            seeds=seeds,
            state=state,
            windows=Windows.of(region),
            mined=describe(state, side_m=WINDOW_M, clear_m=MARGIN_M - 2),
        )

    def draw(self, index: int) -> tuple[Query, Truth]:
        """Draw one trial; it depends on its number and the seed alone."""
        seeds = self.seeds.under("trial", index)
        crops = draw_crops(self.windows, seeds.rng("crops"))
        done = draw_transformation(seeds.rng("transformation"))
        points_m = self.windows.points_m[crops.windows]
        center_m = (float(points_m[crops.true, 0]), float(points_m[crops.true, 1]))
        view = draw_view(self.state, center_m, done, seeds)
        pose = true_pose(center_m, done)
        query = Query(
            query_id=seeds.digest("query").hex()[:24],
            track="retrieval",
            suite=SUITE,
            suite_version=VERSION,
            part="test",
            region=self.region.manifest.id,
            evidence=view.evidence,
            observed_on=self.state.date,
            season="",
            prior=make_prior(pose, GROUP, rng=seeds.rng("prior")),
            prior_group=GROUP.name,
            candidates=tuple(
                Pose(easting_m=float(east_m), northing_m=float(north_m), yaw_deg=0.0) for east_m, north_m in points_m
            ),
        )
        truth = Truth(
            query_id=query.query_id,
            is_present=True,
            pose=pose,
            candidate=crops.true,
            pair_id=seeds.digest("pair").hex()[:16],
            role="stress",
            kind="trial",
            strength=done.change_probability,
            strength_unit=STRENGTH_UNIT,
            unknown_share=view.evidence.unknown_share,
            changed_share=changed_share(view.mapped, view.evidence),
            feature_density=_density(view),
            alias_index=mine(self.mined, center_m, count=1).alias_index,
            block=f"{self.region.manifest.id}/{self.windows.tile[crops.windows[crops.true]]}",
            scene=",".join(self.region.manifest.scenes),
            measured=_measured(done, view),
        )
        return query, truth


def _density(view: View) -> float:
    """Return the share of the place's map with a road, building or hedge."""
    drawn = [view.mapped.layer(name) == PRESENT for name in view.mapped.classes if name in DRAWN_CLASSES]
    return float(np.any(drawn, axis=0).mean())


def _measured(done: Transformation, view: View) -> dict[str, float]:
    """Return the changes to a view and their effects."""
    return {
        "rotation_deg": done.rotation_deg,
        "scale": done.scale,
        "crop_fraction": done.crop_fraction,
        "retained_share": view.retained_share,
        "occlusion_share": view.occlusion_share,
        "change_probability": done.change_probability,
        "changed_share": changed_share(view.mapped, view.world),
        "unknown_share": view.evidence.unknown_share,
    }
