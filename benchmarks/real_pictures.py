# SPDX-License-Identifier: Apache-2.0
"""Say how well a segmenter orders the pixels of real pictures: the area under the ROC curve, class by class.

    .venv/bin/python benchmarks/real_pictures.py --out out chateaugiron-ortho koeln-ortho

The regions are built in `--out` and have imagery. Their pictures are cut into views of 256 m, north up, without gaps;
labels are the layers of the map, roads as one class: `road` is `road_major` or `road_minor`. Intervals (95 %) draw
views; they say nothing of other places. A place whose picture taught the segmenter is named.
`--weights FILE` asks other weights of the network, `--box W,E,N,S` a part of the picture, as fractions of its sides,
`--every N` every Nth view. `--adapt` adapts the network without labels: `exposure` takes that of the whole picture
instead of each view's, `mirrored` the mean with the mirrored view, `both` both, `scales` the mean of the view as it is,
smaller and larger; of the weights of `--segmenter`.

`--profile FILE` writes the perception profile over all regions instead, of classes as the segmenter tells them; with
`--silence SHARE` it says what is withheld when that share of all answers, the least sure ones, is. The profile of the
detector "silent" was made by

    .venv/bin/python benchmarks/real_pictures.py --out out chateaugiron-ortho andorra-la-vella-ortho \
        --profile sasgeo_bench/tasks/perturbations/silent.toml --silence 0.05
"""

import argparse
import sys
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from itertools import chain, islice
from pathlib import Path
from typing import Final

import numpy as np
from sasgeo_baselines.segmenters.osm_unet import HELD_OUT_WEIGHTS, WEIGHTS, Exposure, OsmUNet

import sasgeo_bench as sgb
from sasgeo_bench.core.config import JsonDocument
from sasgeo_bench.core.errors import SasgeoError
from sasgeo_bench.core.texts import one_line
from sasgeo_bench.scoring.perception_profile import measure_profile
from sasgeo_bench.scoring.segmentation import PixelCounts, segmentation_scores
from sasgeo_bench.sensing.reference_imagery import region_views
from sasgeo_bench.tasks.perturbations.perception_profile import write_profile

ROADS: Final = ("road_major", "road_minor")
ROAD: Final = "road"
SHOWN: Final = ("building", ROAD, "path_track", "railway", "water", "green", "farmland", "parking", "bare")
GSD_M: Final = 0.5
SIDE_PX: Final = 512
THIN: Final = 4

Box = tuple[float, float, float, float]  # of a picture, fractions of its sides: west, east, north, south
WHOLE: Final[Box] = (0.0, 1.0, 0.0, 1.0)
SCALES: Final = (0.8, 1.0, 1.25)  # of `--adapt scales`: as if pixels were so much wider


def joined_labels(view: sgb.LabelledImage) -> sgb.LabelledImage:
    """Return a view whose roads are one class."""
    at = [view.classes.index(name) for name in ROADS if name in view.classes]
    if not at:
        return view
    rest = [number for number in range(len(view.classes)) if number not in at]
    roads = view.labels[at]
    one = np.where((roads == sgb.UNKNOWN).any(axis=0), sgb.UNKNOWN, roads.max(axis=0)).astype(np.uint8)
    names = (*(view.classes[number] for number in rest), ROAD)
    return replace(view, classes=names, labels=np.concatenate([view.labels[rest], one[None]]))


def joined_answer(found: sgb.Segmentation) -> sgb.Segmentation:
    """Return a segmentation with the probability of any road beside the other classes."""
    chances = found.probabilities()
    at = [found.classes.index(name) for name in ROADS if name in found.classes]
    road = 1 - np.prod(1 - chances[at], axis=0, keepdims=True)
    return sgb.Segmentation.of_probabilities((*found.classes, ROAD), np.concatenate([chances, road]))


def box_of(text: str) -> Box:
    """Read west, east, north and south of a part of a picture, fractions of its sides."""
    try:
        west, east, north, south = map(float, text.split(","))
    except ValueError:
        west = east = north = south = 0.0
    if not (0 <= west < east <= 1 and 0 <= north < south <= 1):
        raise argparse.ArgumentTypeError(
            f"{text!r} is no part of a picture: give WEST,EAST,NORTH,SOUTH, fractions from 0 to 1"
        )
    return west, east, north, south


def positive(text: str) -> int:
    """Read a whole number of at least 1."""
    if not text.isdecimal() or int(text) < 1:
        raise argparse.ArgumentTypeError(f"{text!r} is no whole number of at least 1")
    return int(text)


def part_of(region: sgb.Region, box: Sequence[float]) -> tuple[float, float, float, float]:
    """Return west, south, east, north of a part of a region's picture, metres; `box` is west, east, north, south."""
    west, south, east, north = region.imagery.record.bounds_m
    left, right, top, bottom = box
    width, height = east - west, north - south
    return west + left * width, north - bottom * height, west + right * width, north - top * height


def views_of(region: sgb.Region, box: Sequence[float], every: int = 1) -> Iterator[sgb.LabelledImage]:
    """Return every so manieth view of a part of a region's picture."""
    if region.imagery is None:
        raise SystemExit(f"{region.manifest.id} has no imagery: name a region whose file has [[imagery]]")
    views = region_views(region, part_of(region, box), place=region.manifest.id, gsd_m=GSD_M, side_px=SIDE_PX)
    return islice(views, 0, None, every)


def exposure_of(views: Iterator[sgb.LabelledImage]) -> Exposure:
    """Return the exposure of some views together: of a pixel in `THIN` along each axis, where there is a picture."""
    pixels = [view.image.rgb[::THIN, ::THIN][view.image.rgb[::THIN, ::THIN].any(axis=2)] for view in views]
    return Exposure.of(np.concatenate(pixels))


class Scaled:
    """A segmenter that sees each picture in several sizes, and says the mean of what it sees."""

    def __init__(self, segmenter: sgb.Segmenter) -> None:
        self.segmenter, self.card = segmenter, segmenter.card

    def segment(self, image: sgb.AerialImage, *, learned: str | None) -> sgb.Segmentation:
        """Return the mean of the probabilities in all sizes."""
        found = [self.segmenter.segment(seen_from(image, scale), learned=learned) for scale in SCALES]
        chances = np.mean([one.probabilities() for one in found], axis=0)
        return sgb.Segmentation.of_probabilities(found[0].classes, chances)


def seen_from(image: sgb.AerialImage, scale: float) -> sgb.AerialImage:
    """Return a picture as if its camera had been so many times as high, so that its pixels are so much wider."""
    return replace(image, camera=replace(image.camera, height_m=image.camera.height_m * scale))


def counted(segmenter: sgb.Segmenter, views: Iterator[sgb.LabelledImage]) -> Iterator[PixelCounts]:
    """Yield the counts of each view."""
    for number, view in enumerate(views):
        found = joined_answer(segmenter.segment(view.image, learned=None))
        yield PixelCounts.of(joined_labels(view), found, image=str(number))


class Area(JsonDocument):
    """Area under the ROC curve of a class, with the interval of draws of views; share of the pixels that it covers."""

    auc: float
    low: float | None  # None: of a single view
    high: float | None
    share: float


def areas_of(counts: Sequence[PixelCounts]) -> dict[str, Area]:
    """Return the area under the curve of each class of `SHOWN` that the views show, in that order."""
    scores = segmentation_scores(counts, draws=500, groups=["all"])
    rows = scores[scores["metric"] == "auc"].set_index("class")
    found = {}
    for name in SHOWN:
        if name in rows.index and np.isfinite(rows.loc[name, "value"]):
            pixels = sum(one.of_class(name) for one in counts)
            low, high = (None if np.isnan(end) else float(end) for end in rows.loc[name, ["lo_images", "hi_images"]])
            share = float(pixels[1].sum() / pixels.sum())
            found[name] = Area(auc=float(rows.loc[name, "value"]), low=low, high=high, share=share)
    return found


def write_profile_of(segmenter: sgb.Segmenter, views: Iterable[sgb.LabelledImage], silence: float, path: Path) -> None:
    """Write the perception profile of a segmenter on some views."""
    counts = [
        PixelCounts.of(view, segmenter.segment(view.image, learned=None), image=str(number))
        for number, view in enumerate(views)
    ]
    card = segmenter.card
    taught = ", ".join(card.trained_on) or "nothing"
    write_profile(measure_profile(counts, segmenter=card.name, learned_from=taught, silence=silence), path)


def weights_of(segmenter: str) -> Path:
    """Return the weights of a segmenter that can be adapted; end with one line for any other."""
    known = {"osm_unet": WEIGHTS, "osm_unet_held_out": HELD_OUT_WEIGHTS}
    if segmenter not in known:
        raise SystemExit(f"--adapt is of {' and '.join(known)}, got {segmenter}: leave it out, or name one of them")
    return known[segmenter]


def main() -> None:
    """Print a row for each region and class."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("regions", nargs="+")
    parser.add_argument("--out", type=Path, default=Path("out"))
    parser.add_argument("--segmenter", default="osm_unet_held_out", help="name of one that needs no training")
    parser.add_argument("--weights", type=Path, help="of osm_unet, instead of those that ship")
    parser.add_argument("--box", type=box_of, default=WHOLE, help="west, east, north, south, fractions from 0 to 1")
    parser.add_argument("--every", type=positive, default=1, help="take one view of so many")
    parser.add_argument("--profile", type=Path, help="write the perception profile into this file, and no table")
    parser.add_argument("--silence", type=float, default=0.0, help="share of the answers that --profile withholds")
    parser.add_argument("--adapt", choices=("exposure", "mirrored", "both", "scales"), help="of osm_unet")
    options = parser.parse_args()
    box = options.box
    regions = {name: sgb.read_region(options.out / "regions" / name) for name in options.regions}
    weights = options.weights or (weights_of(options.segmenter) if options.adapt else None)
    if options.profile:
        views = chain.from_iterable(views_of(region, box, options.every) for region in regions.values())
        segmenter = sgb.load_segmenter(options.segmenter)
        write_profile_of(segmenter, views, options.silence, options.profile)
        return
    print("| region | class | AUC | 95 % | share | views |\n|---|---|---:|---|---:|---:|")
    for name, region in regions.items():
        if weights is None:
            segmenter = sgb.load_segmenter(options.segmenter)
        else:
            segmenter = OsmUNet(
                weights,
                exposure=exposure_of(views_of(region, box)) if options.adapt in ("exposure", "both") else None,
                is_mirrored=options.adapt in ("mirrored", "both"),
            )
            if options.adapt == "scales":
                segmenter = Scaled(segmenter)
        if weights is None and any(name.startswith(place) for place in segmenter.card.trained_on):
            print(f"{name} taught {segmenter.card.name}: this is no figure of a new place", file=sys.stderr)
        counts = list(counted(segmenter, views_of(region, box, options.every)))
        for shown, area in areas_of(counts).items():
            limits = "-" if area.low is None else f"{area.low:.3f} to {area.high:.3f}"
            print(f"| {name} | {shown} | {area.auc:.3f} | {limits} | {area.share:.3f} | {len(counts)} |")


if __name__ == "__main__":
    try:
        main()
    except (SasgeoError, ValueError) as error:  # ValueError: a segmenter that needs training, weights that are none
        raise SystemExit(one_line(str(error))) from error
