# SPDX-License-Identifier: Apache-2.0
"""Say what `osm_unet` learns of a new place from its own accepted fixes, without labels: self-training.

    .venv/bin/pip install torch onnx
    .venv/bin/python benchmarks/self_train.py --out out --begin out/segmenters/osm_unet/osm_unet_held_out.pt

The region is built in `--out`, and those that `train_segmenter.py` needs. Views of 256 m of the west of its picture are
segmented by `osm_unet_held_out` and searched by `sasgeo` in a disc of 250 m, heading known to 20 degrees; where its
posterior at the best place is at least `--least`, the map under the answer, not under the truth, labels the picture.
Then the network that `--begin` keeps goes on in four ways, and each is asked in the east, which none has seen:

- `teachers`: as many steps with what taught it before, so that more steps are not taken for more knowledge
- `accepted`: half of the crops are of accepted views
- `all`: of all views, as they were answered, right or wrong
- `true`: of all views under their true poses, which nobody has on a flight: the most that can be gained

A way that was cut off goes on from its last part of steps.
"""

import argparse
import hashlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray
from sasgeo_baselines.segmenters.osm_unet import OsmUNet, OsmUNetHeldOut

import sasgeo_bench as sgb
from benchmarks.faint_views import is_close
from benchmarks.real_pictures import GSD_M, Area, areas_of, counted, part_of, views_of
from benchmarks.real_pictures import SIDE_PX as VIEW_PX
from benchmarks.segmenter_lessons import (
    DRAWN,
    PIXEL_M,
    REAL,
    SIDE_PX,
    Box,
    Source,
    Teacher,
    region_of,
    sources_of,
    trainer,
)
from sasgeo_bench.core.errors import SasgeoError
from sasgeo_bench.regions.evidence import Evidence, LayerBits, observe
from sasgeo_bench.sensing.crops import Crop
from sasgeo_bench.sensing.reference_imagery import region_views
from sasgeo_bench.tasks.query import Query

CELL_M: Final = 1.0
RADIUS_M, YAW_SIGMA_DEG, SCALE_SIGMA = 250.0, 20.0, 0.03
WEST: Final[Box] = (0.0, 0.5, 0.0, 1.0)
EAST: Final[Box] = (0.5, 1.0, 0.0, 1.0)
SHOWN: Final = ("building", "road", "path_track", "water", "green", "farmland")
PART: Final = 250  # steps between which the state is kept


@dataclass(frozen=True, kw_only=True)
class Answered:
    """A picture with the map under the answer and under the truth, both of shape (C, H, W), and how sure it was."""

    rgb: NDArray[np.uint8]
    classes: tuple[str, ...]
    answer: NDArray[np.uint8]
    truth: NDArray[np.uint8]
    pose: sgb.Pose
    chance: float
    is_right: bool

    def crop(self, rng: np.random.Generator, *, is_true: bool) -> Crop:
        """Return a part of the picture with its labels, in one of eight turns."""
        labels = self.truth if is_true else self.answer
        row, col = (int(rng.integers(side - SIDE_PX + 1)) for side in self.rgb.shape[:2])
        window = np.s_[row : row + SIDE_PX, col : col + SIDE_PX]
        rgb, cut = self.rgb[window], labels[:, *window]
        turns, is_mirrored = int(rng.integers(4)), bool(rng.integers(2))
        rgb, cut = np.rot90(rgb, turns), np.rot90(cut, turns, axes=(1, 2))
        if is_mirrored:
            rgb, cut = rgb[:, ::-1], cut[:, :, ::-1]
        return Crop(
            rgb=np.ascontiguousarray(rgb),
            classes=self.classes,
            labels=np.ascontiguousarray(cut),
            pixel_m=PIXEL_M,
            region="",
            pose=self.pose,
        )


@dataclass(frozen=True, kw_only=True)
class Fixes:
    """Answered views as a source of crops."""

    views: tuple[Answered, ...]
    share: float
    is_true: bool = False
    is_drawn: bool = False

    def crops(self, seed: int) -> Iterator[Crop]:
        """Return crops without end."""
        rng = np.random.default_rng([2, seed])
        while True:
            yield self.views[rng.integers(len(self.views))].crop(rng, is_true=self.is_true)


def evidence_of(found: sgb.Segmentation) -> Evidence:
    """Return what a segmentation says in cells of `CELL_M`, means of its pixels."""
    factor = round(CELL_M / GSD_M)
    chances = found.probabilities()
    rows, cols = (side // factor for side in chances.shape[1:])
    cut = chances[:, : rows * factor, : cols * factor].reshape(len(chances), rows, factor, cols, factor)
    return Evidence.of_probabilities(found.classes, cut.mean(axis=(2, 4)), cell_size_m=CELL_M)


def placed(region: sgb.Region, box: Box) -> Iterator[tuple[sgb.LabelledImage, NDArray[np.float64]]]:
    """Yield the square views of a part of a picture, side by side, with the place of their middle on the picture."""
    side_m = VIEW_PX * GSD_M
    west, south, east, north = part_of(region, box)
    for top in np.arange(north, south + side_m, -side_m).tolist():
        for left in np.arange(west, east - side_m, side_m).tolist():
            bounds_m = (left, top - side_m, left + side_m, top)
            for view in region_views(region, bounds_m, place=region.manifest.id, gsd_m=GSD_M, side_px=VIEW_PX):
                yield view, np.array([left + side_m / 2, top - side_m / 2])


def asked(region: sgb.Region, seen: Evidence, truth: sgb.Pose, rng: np.random.Generator) -> Query:
    """Return the question where a view is, with a prior off its place and heading by as much as it declares."""
    angle, far_m = rng.uniform(0, 2 * np.pi), RADIUS_M * np.sqrt(rng.uniform())
    prior = sgb.Prior(
        center_m=(truth.easting_m + far_m * np.cos(angle), truth.northing_m + far_m * np.sin(angle)),
        radius_m=RADIUS_M,
        yaw_deg=float(rng.normal(0, YAW_SIGMA_DEG)),
        yaw_sigma_deg=YAW_SIGMA_DEG,
        scale_sigma=SCALE_SIGMA,
    )
    return Query(
        query_id="self-training",
        track="localization",
        suite="real-image",
        suite_version=1,
        part="test",
        region=region.manifest.id,
        prior_group="r250-weak-s3",
        evidence=seen,
        observed_on=region.manifest.extract.date,
        season="",
        prior=prior,
    )


def answered(region: sgb.Region, box: Box, *, seed: int = 0) -> Iterator[Answered]:
    """Segment and search the views of a part of a picture; one that is not answered is left out."""
    matcher, segmenter = sgb.load_matcher("sasgeo"), OsmUNetHeldOut()
    matcher.prepare(region, None)
    bits, rng = LayerBits.of(region.layers), np.random.default_rng([3, seed])
    off_m = np.zeros(2) if region.imagery is None else np.array(region.imagery.off_m)
    for view, middle_m in placed(region, box):
        east_m, north_m = (middle_m - off_m).tolist()
        truth = sgb.Pose(easting_m=east_m, northing_m=north_m, yaw_deg=0.0)
        query = asked(region, evidence_of(segmenter.segment(view.image, learned=None)), truth, rng)
        match = matcher.match(query, top_k=1)
        if not match.poses:
            continue
        pose = match.poses[0]
        yield Answered(
            rgb=view.image.rgb,
            classes=region.classes,
            answer=observe(bits, region.grid, pose, size_cells=VIEW_PX, cell_size_m=GSD_M),
            truth=observe(bits, region.grid, truth, size_cells=VIEW_PX, cell_size_m=GSD_M),
            pose=pose,
            chance=match.confidence or 0.0,
            is_right=is_close(pose, truth),
        )


def ways_of(views: Sequence[Answered], least: float, teachers: Sequence[Source]) -> dict[str, list[Teacher]]:
    """Return what teaches in each way."""
    before = [replace(one, share=one.share / 2) for one in teachers]
    accepted = tuple(view for view in views if view.chance >= least)
    return {
        "teachers": list(teachers),
        "accepted": [*before, Fixes(views=accepted, share=0.5)],
        "all": [*before, Fixes(views=tuple(views), share=0.5)],
        "true": [*before, Fixes(views=tuple(views), share=0.5, is_true=True)],
    }


def key_of(teachers: Sequence[Teacher], begin: Path, *numbers: float) -> str:
    """Return what a kept state is known by: another state, number or answer must not go on from it."""
    fixes = [(view.pose, view.chance, one.is_true) for one in teachers if isinstance(one, Fixes) for view in one.views]
    return hashlib.sha256(begin.read_bytes() + repr((numbers, fixes)).encode()).hexdigest()[:12]


def row(way: str, areas: dict[str, Area], count: int) -> str:
    """Return a row of the table."""
    cells = [f"{areas[name].auc:.3f}" if name in areas else "-" for name in SHOWN]
    return f"| {way} | {count} | {' | '.join(cells)} |"


def main() -> None:
    """Print how many views are accepted, and a row for each way."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("out"))
    parser.add_argument("--begin", type=Path, required=True, help="state of osm_unet_held_out (*.pt)")
    parser.add_argument("--region", default="chateaugiron-ortho")
    parser.add_argument("--least", type=float, default=0.9, help="posterior of an accepted fix")
    parser.add_argument("--steps", type=int, default=1000, help="of 4 crops")
    parser.add_argument("--seed", type=int, default=0, help="of the order of crops: another one tells luck")
    parser.add_argument("--rate", type=float, default=3e-4, help="of learning, at its highest")
    given = parser.parse_args()
    if not given.begin.is_file():
        parser.error(f"there is no {given.begin}: train_segmenter.py leaves the state of its network there")
    teach = trainer()
    region, folder = region_of(given.region, given.out), given.out / "segmenters" / "self_train"
    folder.mkdir(parents=True, exist_ok=True)
    views = list(answered(region, WEST))
    accepted = [view for view in views if view.chance >= given.least]
    if not accepted:
        raise SystemExit(f"none of {len(views)} answers is as sure as {given.least:g}: give a smaller --least")
    for title, some in (("all", views), ("accepted", accepted)):
        print(f"{title}: {len(some)} views, {sum(not view.is_right for view in some)} of them at a wrong place")
    print(f"\n| Way | n | {' | '.join(SHOWN)} |\n|---|{'---:|' * (1 + len(SHOWN))}", flush=True)
    counts = list(counted(OsmUNetHeldOut(), views_of(region, EAST)))
    print(row("before", areas_of(counts), len(counts)), flush=True)
    teachers = sources_of(DRAWN, REAL, 0.3, given.out)
    for way, sources in ways_of(views, given.least, teachers).items():
        kept = folder / f"{given.region}-{way}-{key_of(sources, given.begin, given.steps, given.rate, given.seed)}"
        recipe = teach.Recipe(steps=given.steps, rate=given.rate, begin=given.begin, part=PART, seed=given.seed)
        teach.export(teach.train(sources, kept.with_suffix(".pt"), recipe), kept.with_suffix(".onnx"))
        counts = list(counted(OsmUNet(kept.with_suffix(".onnx")), views_of(region, EAST)))
        print(row(way, areas_of(counts), len(counts)), flush=True)


if __name__ == "__main__":
    try:
        main()
    except SasgeoError as error:
        raise SystemExit(str(error)) from error
