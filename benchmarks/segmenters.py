# SPDX-License-Identifier: Apache-2.0
"""Measure segmenters: rendered to rendered, to a shifted family, to real images, and between real images.

    .venv/bin/python benchmarks/segmenters.py --out out --extracts DIR --zanzibar DIR
    .venv/bin/python benchmarks/segmenters.py --out out --towns          # embedded towns alone: no data at all

Pictures are rendered on regions of the split `holdout`: train places in the family "train", test places in the families
"test" and "shifted". Regions that are not in `--out` are built first. `--zanzibar` is a folder with the two mosaics and
the buildings that `data/imagery/manifest.toml` names; its four blocks, two in each of two villages 2.7 km apart, are
cut into views of 100 m, and for "zanzibar -> zanzibar" each block is segmented by what was learned from the other
three. Labels there are of buildings alone.

Every stage is kept in `--out`/segmenters and not made again: pictures, learned texts, counts of pixels. Remove the
folder to begin anew. Scores of all classes, places and seasons, with intervals, go to `scores.parquet` there, and
`reliability.parquet` and `coverage.parquet` beside it. One table is printed, for the class `--class`. Its last columns
are IoU and calibration error after `Segmentation.with_shares`, given the share of the class in the pictures of the
place: of each picture alone, and of all pictures of the place together, as of one flight.
"""

import argparse
import json
import math
import os
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

os.environ.setdefault("OMP_NUM_THREADS", "1")

import cv2
import geopandas as gpd
import numpy as np
import pandas as pd
import rasterio
from rasterio.features import rasterize

import sasgeo_bench as sgb
from sasgeo_bench.files.parquet import write_frame
from sasgeo_bench.geometry.grid import Grid
from sasgeo_bench.matching.segmenter import LearningSegmenter
from sasgeo_bench.regions.build import build_region, plan_build
from sasgeo_bench.regions.region_spec import find_region_file, read_region_file
from sasgeo_bench.scoring.draws import seed_of_text
from sasgeo_bench.scoring.segmentation import error_over_coverage, reliability, segmentation_scores
from sasgeo_bench.scoring.segmentation_counts import PixelCounts, read_counts, write_counts
from sasgeo_bench.sensing.camera import Camera
from sasgeo_bench.sensing.image_bytes import SUFFIX, LabelledFiles, write_labelled
from sasgeo_bench.sensing.intrinsics import Intrinsics
from sasgeo_bench.sensing.rendering.conditions import draw_conditions
from sasgeo_bench.sensing.rendering.palettes import Family
from sasgeo_bench.sensing.rendering.scene import make_scene
from sasgeo_bench.sensing.rendering.view import render_labelled

TRAIN: Final = (
    *("andorra-la-vella", "encamp", "la-massana", "pas-de-la-casa", "sant-julia"),
    *("lauf", "porto", "town-grid", "town-suburb"),
)
TEST: Final = ("vaduz", "balzers", "badwildbad", "monaco", "town-riverside", "town-agricultural")
SIDE_PX: Final = 448
VIEW_DEG: Final = 65.0
HEIGHTS_M: Final = (80.0, 300.0)
TILT_DEG: Final = 12.0  # standard deviation
PAINT_M: Final = 0.5  # cells of the paint
LEAST_SHARE: Final = 0.03  # of a scene that any class covers
REAL_M: Final = 0.25  # pixels of a view of Zanzibar
REAL_PX: Final = 400
FAR_M: Final = 1000.0  # height of the camera of a mosaic, in which nothing leans
DONE: Final = "done.json"


@dataclass(frozen=True)
class Trial:
    """A segmenter, what it learns from and what it is tested on; each fold is a pair of sets of pictures."""

    segmenter: str
    learned: str
    tested: str
    folds: tuple[tuple[tuple[Path, ...], tuple[Path, ...]], ...]


def files_of(folder: Path, make: Callable[[], Iterator[sgb.LabelledImage]]) -> tuple[Path, ...]:
    """Return the files of a set of pictures, made first unless the folder is complete."""
    done = folder / DONE
    if not done.exists():
        folder.mkdir(parents=True, exist_ok=True)
        began = time.perf_counter()
        count = len(write_labelled(folder, make()))
        took = time.perf_counter() - began
        done.write_text(json.dumps({"pictures": count, "seconds": round(took, 1)}), encoding="utf-8")
        print(f"{folder}: {count} pictures in {took:.0f} s", flush=True)
    return tuple(sorted(folder.glob(f"*{SUFFIX}")))


def rendered(region: str, family: Family, given: argparse.Namespace) -> Iterator[sgb.LabelledImage]:
    """Yield pictures of random places of a region where something is mapped, in random weather and season.

    All families see the same places from the same cameras in the same weather.
    """
    folder = given.out / "regions" / region
    if not folder.exists():
        plan = plan_build(read_region_file(find_region_file(region)), out=given.out, extract_folders=given.extracts)
        build_region(plan, tell=lambda _: None, with_preview=False)
    ground = sgb.read_region(folder)
    rng = np.random.default_rng(seed_of_text(f"segmenters/{region}"))
    made = 0
    for _ in range(20 * given.pictures):
        if made == given.pictures:
            return
        height_m = float(np.exp(rng.uniform(*np.log(HEIGHTS_M))))
        reach_m = 1.5 * height_m * math.tan(math.radians(VIEW_DEG / 2))
        west, south, east, north = ground.grid.bounds_m
        at = [float(rng.uniform(low + reach_m, high - reach_m)) for low, high in ((west, east), (south, north))]
        window = Grid.around(*at, size_m=(2 * reach_m, 2 * reach_m), cell_size_m=PAINT_M, epsg=ground.grid.epsg)
        scene = make_scene(ground.features, ground.classes, ground.coverage, place=region, window=window, family=family)
        if not scene.is_mapped.all() or (scene.class_bits > 0).mean() < LEAST_SHARE:
            continue
        lens = Intrinsics.from_field_of_view(horizontal_deg=VIEW_DEG, width_px=SIDE_PX, height_px=SIDE_PX)
        look = {"intrinsics": lens, "height_m": height_m, "tilt_deg": min(abs(rng.normal(0, TILT_DEG)), 30.0)}
        camera = Camera.pointed(**look, east_m=at[0], north_m=at[1], yaw_deg=float(rng.uniform(0, 360)))
        weather = draw_conditions(rng)
        rgb, truth = render_labelled(scene, camera, weather, rng)
        picture = sgb.AerialImage(
            rgb=rgb,
            camera=Camera.pointed(**look, east_m=0.0, north_m=0.0, yaw_deg=0.0),
            season=weather.season,
        )
        made += 1
        yield sgb.LabelledImage(image=picture, classes=scene.classes, labels=truth, place=region)


def zanzibar(folder: Path, village: str, half: int) -> Iterator[sgb.LabelledImage]:
    """Yield the views of one half of a village: west 0, east 1."""
    with rasterio.open(folder / f"zanzibar_{village}_z21.tif") as source:
        houses = gpd.read_file(folder / "osm_buildings_labels.geojson").to_crs(source.crs).geometry
        middle = gpd.GeoSeries.from_xy([source.bounds.left], [source.bounds.top], crs=source.crs).to_crs(4326)
        shrink = REAL_M / (source.res[0] * math.cos(math.radians(middle.y.iloc[0])))
        cols, rows = int(source.width / shrink), int(source.height / shrink)
        rgb = cv2.resize(source.read().transpose(1, 2, 0), (cols, rows), interpolation=cv2.INTER_AREA)
        where = source.transform * source.transform.scale(source.width / cols, source.height / rows)
    truth = rasterize([(house, 1) for house in houses], (rows, cols), transform=where, dtype="uint8")
    focal = FAR_M / REAL_M
    for row in range(0, rows - REAL_PX // 2, REAL_PX):
        for col in range(half * (cols // 2), (half + 1) * (cols // 2) - REAL_PX // 2, REAL_PX):
            part = np.s_[row : row + REAL_PX, col : min(col + REAL_PX, (half + 1) * (cols // 2))]
            height, width = truth[part].shape
            lens = Intrinsics(
                width_px=width, height_px=height, focal_px=(focal, focal), centre_px=(width / 2, height / 2)
            )
            camera = Camera.pointed(intrinsics=lens, east_m=0.0, north_m=0.0, height_m=FAR_M, yaw_deg=0.0)
            picture = sgb.AerialImage(rgb=rgb[part].copy(), camera=camera)
            yield sgb.LabelledImage(
                image=picture, classes=("building",), labels=truth[part][None].copy(), place=f"zanzibar-{village}"
            )


def sets_of(given: argparse.Namespace) -> dict[str, list[tuple[Path, ...]]]:
    """Return the files of pictures by set and place, or block."""
    root = given.out / "segmenters" / "pictures"
    found: dict[str, list[tuple[Path, ...]]] = {}
    for name, family, regions in (("rendered", "train", TRAIN), ("test", "test", TEST), ("shifted", "shifted", TEST)):
        usable = [region for region in regions if not given.towns or region.startswith("town-")]
        found[name] = [
            files_of(root / name / region, lambda region=region, family=family: rendered(region, family, given))
            for region in usable
        ]
    if given.zanzibar:
        found["zanzibar"] = [
            files_of(
                root / "zanzibar" / f"{village}-{half}",
                lambda village=village, half=half: zanzibar(given.zanzibar, village, half),
            )
            for village in ("north", "south")
            for half in (0, 1)
        ]
    return found


def trials_of(sets: dict[str, list[tuple[Path, ...]]]) -> Iterator[Trial]:
    """Yield all trials: the floor and the forest on every set, and real to real with one block left out each time."""
    train = tuple(path for part in sets["rendered"] for path in part)
    for tested in ("test", "shifted", "zanzibar"):
        if tested in sets:
            asked = tuple(path for part in sets[tested] for path in part)
            yield Trial("colour_thresholds", "-", tested, (((), asked),))
            yield Trial("pixel_forest", "rendered", tested, ((train, asked),))
    blocks = sets.get("zanzibar", [])
    folds = [(tuple(path for other in blocks if other is not block for path in other), block) for block in blocks]
    if folds:
        yield Trial("pixel_forest", "zanzibar", "zanzibar", tuple(folds))


def learned_text(trial: Trial, number: int, paths: Sequence[Path], root: Path) -> tuple[str | None, float]:
    """Return what the segmenter of a trial learned, and its processor time; from the disk if it is there."""
    segmenter = sgb.load_segmenter(trial.segmenter)
    if not isinstance(segmenter, LearningSegmenter):
        return None, 0.0
    file = root / "learned" / f"{trial.segmenter}-{trial.learned}-{number}.json"
    timed = file.with_suffix(".seconds")
    if not timed.exists():
        file.parent.mkdir(parents=True, exist_ok=True)
        began = time.process_time()
        file.write_text(segmenter.learn(sgb.ImageTraining(images=LabelledFiles(paths))), encoding="utf-8")
        timed.write_text(f"{time.process_time() - began:.2f}", encoding="utf-8")
    return file.read_text(encoding="utf-8"), float(timed.read_text(encoding="utf-8"))


@dataclass(frozen=True)
class Outcome:
    """Counts of a trial: as the segmenter says, with shares by picture, and with shares by flight."""

    counts: dict[str, tuple[PixelCounts, ...]]
    segment_s: float
    learn_s: float
    learned_mb: float


def outcome(trial: Trial, root: Path) -> Outcome:
    """Return the counts of a trial, from the disk where they are."""
    texts = [learned_text(trial, at, taught, root) for at, (taught, _) in enumerate(trial.folds)]
    stem = f"{trial.segmenter}-{trial.learned}-{trial.tested}"
    files = {kind: root / "counts" / f"{stem}-{kind}.parquet" for kind in ("plain", "picture", "flight")}
    timed = root / "counts" / f"{stem}.seconds"
    if not timed.exists():
        timed.parent.mkdir(parents=True, exist_ok=True)
        counts, seconds = _counted(trial, [text for text, _ in texts])
        for kind, file in files.items():
            write_counts(counts[kind], file)
        timed.write_text(f"{seconds:.4f}", encoding="utf-8")
    return Outcome(
        counts={kind: read_counts(file) for kind, file in files.items()},
        segment_s=float(timed.read_text(encoding="utf-8")),
        learn_s=float(np.mean([took for _, took in texts])),
        learned_mb=float(np.mean([len(text or "") for text, _ in texts])) / 1e6,
    )


def _counted(trial: Trial, texts: Sequence[str | None]) -> tuple[dict[str, list[PixelCounts]], float]:
    """Segment every picture and count; the second is the mean processor time of a picture, s."""
    found: dict[str, list[PixelCounts]] = {"plain": [], "picture": [], "flight": []}
    took = []
    for text, (_, asked) in zip(texts, trial.folds, strict=True):
        segmenter = sgb.load_segmenter(trial.segmenter)
        for place in sorted({path.parent for path in asked}):
            images = list(LabelledFiles([path for path in asked if path.parent == place]))
            began = time.process_time()
            said = [segmenter.segment(one.image, learned=text) for one in images]
            took.append((time.process_time() - began) / len(images))
            shares = shares_of(images, said[0].classes)
            ways = {
                "plain": said,
                "picture": [one.with_shares(shares) for one in said],
                "flight": together(said, shares),
            }
            for kind, some in ways.items():
                found[kind] += [
                    PixelCounts.of(one, seen, image=f"{place.name}/{at}")
                    for at, (one, seen) in enumerate(zip(images, some, strict=True))
                ]
    return found, float(np.mean(took))


def shares_of(images: Sequence[sgb.LabelledImage], classes: Sequence[str]) -> dict[str, float]:
    """Return the share of each class in the labelled pixels of some pictures."""
    found = {}
    for name in classes:
        if name in images[0].classes:
            states = [one.labels[one.classes.index(name)] for one in images]
            known = sum(np.count_nonzero(state != sgb.UNKNOWN) for state in states)
            present = sum(np.count_nonzero(state == sgb.PRESENT) for state in states)
            if known:
                found[name] = present / known
    return found


def together(said: Sequence[sgb.Segmentation], shares: dict[str, float]) -> list[sgb.Segmentation]:
    """Return segmentations that have taken new shares together, as one picture would."""
    count = len(said[0].classes)
    rows = np.concatenate([one.probability_bytes.reshape(count, 1, -1) for one in said], axis=2)
    new = sgb.Segmentation(classes=said[0].classes, probability_bytes=rows).with_shares(shares).probability_bytes
    ends = np.cumsum([one.probability_bytes[0].size for one in said])[:-1]
    parts = np.split(new, ends, axis=2)
    return [
        sgb.Segmentation(classes=one.classes, probability_bytes=part.reshape(one.probability_bytes.shape).copy())
        for one, part in zip(said, parts, strict=True)
    ]


def main() -> None:
    """Make what is missing, and print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("out"))
    parser.add_argument("--extracts", type=Path, action="append", default=[])
    parser.add_argument("--zanzibar", type=Path, help="folder with the mosaics")
    parser.add_argument("--towns", action="store_true", help="embedded towns alone")
    parser.add_argument("--pictures", type=int, default=5, help="of each region")
    parser.add_argument("--class", dest="class_name", default="building", help="class of the printed table")
    given = parser.parse_args()
    root = given.out / "segmenters"
    frames: dict[str, list[pd.DataFrame]] = {"scores": [], "reliability": [], "coverage": []}
    lines = []
    for trial in trials_of(sets_of(given)):
        found = outcome(trial, root)
        about = {"segmenter": trial.segmenter, "learned_from": trial.learned, "tested_on": trial.tested}
        scores = {}
        for kind, counts in found.counts.items():
            scores[kind] = segmentation_scores(counts, **about, shares=kind)
            frames["scores"].append(scores[kind])
        frames["reliability"].append(reliability(found.counts["plain"], **about))
        frames["coverage"].append(error_over_coverage(found.counts["plain"], **about))
        lines.append(_line(trial, found, scores, given.class_name))
    for name, some in frames.items():
        write_frame(pd.concat(some, ignore_index=True), root / f"{name}.parquet", attrs={})
    print(f"| {' | '.join(lines[0])} |\n|{'---|' * len(lines[0])}")
    for line in lines:
        print(f"| {' | '.join(line.values())} |")


def _line(trial: Trial, found: Outcome, scores: dict[str, pd.DataFrame], class_name: str) -> dict[str, str]:
    """Return a row of the printed table."""
    line = {"segmenter": trial.segmenter, "learned from": trial.learned, "tested on": trial.tested}
    line |= {"pictures": str(len(found.counts["plain"]))}
    line |= {
        metric.upper(): _shown(scores["plain"], class_name, metric) for metric in ("auc", "iou", "ece", "share_gap")
    }
    for kind in ("picture", "flight"):
        line |= {
            f"{metric.upper()}, shares by {kind}": _shown(scores[kind], class_name, metric) for metric in ("iou", "ece")
        }
    line |= {"learned, CPU s": f"{found.learn_s:.0f}", "learned, MB": f"{found.learned_mb:.1f}"}
    return line | {"a picture, CPU s": f"{found.segment_s:.2f}"}


def _shown(scores: pd.DataFrame, class_name: str, metric: str) -> str:
    """Return a value over all images with its interval."""
    one = scores[(scores["group"] == "all") & (scores["class"] == class_name) & (scores["metric"] == metric)]
    if one.empty:
        return "-"
    row = one.iloc[0]
    lo, hi = (row["lo"], row["hi"]) if not math.isnan(row["lo"]) else (row["lo_images"], row["hi_images"])
    return f"{row['value']:.3f} [{lo:.3f}, {hi:.3f}]"


if __name__ == "__main__":
    main()
