# SPDX-License-Identifier: Apache-2.0
"""The experiment as a region and a task on disk; each trial is drawn by its number and the seed."""

import datetime as dt
import hashlib
import json
from dataclasses import dataclass
from importlib.metadata import version
from itertools import product
from pathlib import Path
from typing import Final

import numpy as np
import shapely

from sasgeo_bench.boards.pipeline_spec import PAPER_SUITE, Crop, PaperSpec, paper_suite
from sasgeo_bench.core.errors import ConfigError, StoreError
from sasgeo_bench.core.progress import tell
from sasgeo_bench.geometry.pose import Pose
from sasgeo_bench.geometry.projection import to_lonlat
from sasgeo_bench.osm.locate import Extract
from sasgeo_bench.osm.read import Reading
from sasgeo_bench.osm.taxonomy import load_taxonomy
from sasgeo_bench.regions import region_files
from sasgeo_bench.regions.build import build_made
from sasgeo_bench.regions.evidence import PRESENT
from sasgeo_bench.regions.region import DATA_VERSION, SCHEMA_VERSION, Region
from sasgeo_bench.regions.region_spec import RegionFile
from sasgeo_bench.tasks.build import check_task, put_task
from sasgeo_bench.tasks.private_seed import PrivateSeed, seed_record
from sasgeo_bench.tasks.query import TASK_VERSION, PriorGroup, Query, Truth
from sasgeo_bench.tasks.sampling import make_prior
from sasgeo_bench.tasks.state import DRAWN_CLASSES, State
from sasgeo_bench.tasks.suites.base import Seeds, changed_share
from sasgeo_bench.tasks.suites.mining import Windows as MinedWindows
from sasgeo_bench.tasks.suites.mining import describe, mine
from sasgeo_bench.tasks.task_files import Task, TaskOrigin, TruthManifest
from sasgeo_bench.tasks.task_plan import check_roots
from sasgeo_paper.tiles import (
    CELL_M,
    EPSG,
    MARGIN_M,
    TILES,
    WINDOW_M,
    Windows,
    make_tiles,
    mosaic_grid,
    tile_boxes,
)
from sasgeo_paper.trials import (
    Transformation,
    View,
    draw_crops,
    draw_transformation,
    draw_view,
    true_pose,
)

SUITE: Final = PAPER_SUITE  # names the draws of every reading of the crop, so that they share their trials
VERSION: Final = 1
TRIALS: Final = 220
GROUP: Final = PriorGroup(radius_m=None, yaw="unknown", scale_sigma=0.15)
DATE: Final = dt.date(2026, 1, 1)
STRENGTH_UNIT: Final = "map-change probability"
DATA: Final = "procedural regions, no OSM data in them"  # source stated by pictures and tables


def make_paper_task(
    *,
    seed: int,
    out: Path,
    trials: int = TRIALS,
    private: PrivateSeed | None = None,
    crop: Crop = "unknown",
) -> Path:
    """Make the paper's 30 regions, draw its retrieval trials on them, and return the folder of the task.

    The region is written to `out/regions/paper-poc-<seed>`, the task to `out/tasks/paper-poc/paper-poc-<seed>`; the
    paper's seed is 42. The first of many `trials` are those of a shorter request. `private` replaces the seed of all
    random draws; the public seed is then a name. Another reading of `crop` has a suite of its own, on the same trials:
    the `pair_id` of a trial is the same in each. Raise `ConfigError` if the seed is negative, there are no trials, or
    truths would lie where the queries are; `StoreError` if a folder cannot be written, or holds something else.
    """
    if seed < 0:
        raise ConfigError(f"the seed names the region and must be 0 or more, got {seed}")
    if trials < 1:
        raise ConfigError(f"there must be at least one trial, got {trials}")
    check_roots(out)
    seeds = Seeds(root=seed, names=(SUITE, str(VERSION)))
    if private is not None:
        seeds = Seeds(root=private, names=(SUITE, str(VERSION), str(seed)))
    tell(f"{region_name(seed)}: drawing {TILES} tiles")
    folder = build_made(_spec(seed), _generated(seed, seeds), out=out)
    drawer = PaperDrawer.of(region_files.read_region(folder), seeds, crop=crop)
    pairs = sorted((drawer.draw(index) for index in range(trials)), key=lambda pair: pair[0].query_id)
    hidden = TruthManifest.model_validate(
        seed_record(private or seed) | {"request_sha256": _request_sha256(seed, trials, private, crop)}
    )
    views_cells = sorted({query.evidence.shape[0] for query, _ in pairs})
    made = put_task(pairs, _origin(drawer.region, crop, views_cells), hidden, out=out)
    tell(f"{paper_suite(crop)} on {region_name(seed)}: {made.manifest.queries} trials in {made.folder}")
    return made.folder


def made_paper_task(
    *, seed: int, out: Path, trials: int = TRIALS, private: PrivateSeed | None = None, crop: Crop = "unknown"
) -> Path | None:
    """Return the task folder of these trials, or None if they have to be drawn; nothing is drawn to find out.

    Task, truths and region are as they were written, and nothing that decides their content has changed since.
    """
    folder = out / "tasks" / paper_suite(crop) / region_name(seed)
    record = TruthManifest.read(out / "truth" / paper_suite(crop) / region_name(seed))
    if record.request_sha256 != _request_sha256(seed, trials, private, crop):
        return None
    try:
        task = Task.open(folder, out)
        faults = [*check_task(task), *region_files.differing_files(out / "regions" / region_name(seed))]
    except StoreError:
        return None
    return folder if not faults and task.has_truths else None


def drawn(spec: PaperSpec, *, out: Path, private: PrivateSeed | None = None) -> dict[tuple[str, str], Path | None]:
    """Return the folder of each task by suite and region, None where it has to be drawn."""
    return {
        (suite, region_name(seed)): made_paper_task(seed=seed, out=out, trials=spec.trials, private=private, crop=crop)
        for suite, crop in spec.crops.items()
        for seed in spec.seeds
    }


def draw(spec: PaperSpec, *, out: Path, private: PrivateSeed | None = None) -> list[Path]:
    """Draw every seed and reading of the crop, unless up to date, and return the folders of the tasks."""
    folders = []
    for crop, seed in product(spec.crops.values(), spec.seeds):
        made = made_paper_task(seed=seed, out=out, trials=spec.trials, private=private, crop=crop)
        folders.append(made or make_paper_task(seed=seed, out=out, trials=spec.trials, private=private, crop=crop))
    return folders


def _request_sha256(seed: int, trials: int, private: PrivateSeed | None, crop: Crop) -> str:
    """Hash all that decides which trials a seed gives; the recipe itself is in it by its version."""
    record = {
        "suite": [SUITE, VERSION, TASK_VERSION],
        "region": [SCHEMA_VERSION, DATA_VERSION, load_taxonomy().of_maps()],
        "seed": seed,
        "trials": trials,
        "made_by": version("sasgeo-bench"),
    }
    if private is not None:
        record["private_seed"] = private.commitment
    if crop != "unknown":  # tasks that are older than this choice stay valid
        record["crop"] = crop
    return hashlib.sha256(json.dumps(record, sort_keys=True).encode()).hexdigest()


def region_name(seed: int) -> str:
    """Return the name of the region of a seed, as in paper-poc-42."""
    return f"{SUITE}-{seed}"


def _spec(seed: int) -> RegionFile:
    """Return the place of the mosaic as a region specification."""
    grid = mosaic_grid()
    west_m, south_m, east_m, north_m = grid.bounds_m
    center_lonlat = to_lonlat(EPSG).transform((west_m + east_m) / 2, (south_m + north_m) / 2)
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


_CROPPED: Final[dict[Crop, str]] = {
    "unknown": "",
    "absent": "; cropped cells count as absent",
    "smaller": "; a cropped view is smaller",
}


def _origin(region: Region, crop: Crop, views_cells: list[int]) -> TaskOrigin:
    """Say how the queries were drawn, without their places."""
    return TaskOrigin(
        suite=paper_suite(crop),
        suite_version=VERSION,
        title=f"The paper's synthetic proof of concept{_CROPPED[crop]}",
        what="turned, magnified, cropped, occluded and changed views of procedural regions; ten candidates",
        separates="global description from spatial alignment",
        falsifier="none",
        strength_unit=STRENGTH_UNIT,
        region=region.manifest.id,
        map_date=region.manifest.extract.date.isoformat(),
        map_fingerprint=region.manifest.fingerprint,
        map_inputs_sha256=region.manifest.inputs_sha256,
        provenance=region.manifest.provenance,
        sites=TILES,
        views_cells=views_cells,
        epsg=region.manifest.epsg,
        made_by=f"sasgeo-bench {version('sasgeo-bench')}",
    )


@dataclass(frozen=True, kw_only=True)
class PaperDrawer:
    """Draw the trials of one region; `crop` is read as `PaperSpec` says."""

    region: Region
    seeds: Seeds
    state: State
    windows: Windows
    mined: MinedWindows
    crop: Crop = "unknown"

    @classmethod
    def of(cls, region: Region, seeds: Seeds, *, crop: Crop = "unknown") -> "PaperDrawer":
        """Describe the region's candidate crops."""
        state = State.of(region)
        return cls(
            region=region,
            seeds=seeds,
            state=state,
            windows=Windows.of(region),
            mined=describe(state, side_m=WINDOW_M, clear_m=MARGIN_M - 2),
            crop=crop,
        )

    def draw(self, index: int) -> tuple[Query, Truth]:
        """Draw one trial; it depends on its number and the seed alone."""
        seeds = self.seeds.under("trial", index)
        crops = draw_crops(self.windows, seeds.rng("crops"))
        done = draw_transformation(seeds.rng("transformation"))
        points_m = self.windows.points_m[crops.windows]
        center_m = (float(points_m[crops.true, 0]), float(points_m[crops.true, 1]))
        view = draw_view(self.state, center_m, done, seeds, crop=self.crop)
        pose = true_pose(center_m, done)
        query = Query(
            query_id=seeds.digest("query", *(() if self.crop == "unknown" else (self.crop,))).hex()[:24],
            track="retrieval",
            suite=paper_suite(self.crop),
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
            changed_share=changed_share(view.mapped, view.visible),
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
