# SPDX-License-Identifier: Apache-2.0
"""Measure segmenters: rendered to rendered, to a shifted family, to real images, and between real images.

    .venv/bin/python benchmarks/segmenters.py --out out --extracts DIR --zanzibar DIR
    .venv/bin/python benchmarks/segmenters.py --out out --towns          # embedded towns alone: no data at all
    .venv/bin/python benchmarks/segmenters.py --board docs/results/segmenters   # tables of a stored board, nothing else

Pictures are rendered on regions of the split `holdout`: train places in the family "train", test places in the families
"test" and "shifted". Regions that are not in `--out` are built first. `--zanzibar` and `--banepa` are folders with the
pictures and buildings of the regions `zanzibar` and `banepa`. The mapped parts of these regions are cut into views of
100 m, in blocks: two in each of the two villages of Zanzibar, 2.7 km apart, and the two parts of Banepa. For "zanzibar
-> zanzibar" and "banepa -> banepa" each block is segmented by what was learned from the other ones. Labels there are of
buildings alone; what lies outside the mapped parts, or has no picture, is unknown.

`--segmenter NAME`, repeatable, chooses segmenters. One that learns is tested on every set after learning from the
rendered pictures, and on real ones also after learning from real ones.

Every stage is kept in `--out`/segmenters and not made again: pictures, learned texts, counts of pixels. Remove the
folder to begin anew. Scores of all classes, places and seasons, with intervals, go to `--results`, by default
`--out`/segmenters/board, with reliability, error over coverage, costs, and a perception profile of each trial. Then the
tables of the board are printed, or, with `--page FILE`, put into a page below headings of the same names.
"""

import argparse
import hashlib
import json
import math
import os
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Final

os.environ.setdefault("OMP_NUM_THREADS", "1")

import numpy as np

import sasgeo_bench as sgb
from sasgeo_bench.geometry.grid import Grid
from sasgeo_bench.matching.segmenter import LearningSegmenter
from sasgeo_bench.regions.build import build_region, plan_build
from sasgeo_bench.regions.region_spec import find_region_file, read_region_file
from sasgeo_bench.scoring.intervals import seed_of_text
from sasgeo_bench.scoring.segmentation import PixelCounts, read_counts, write_counts
from sasgeo_bench.scoring.segmenter_board import (
    NOTHING,
    PLAIN,
    SegmenterBoard,
    SegmenterTrial,
    page_tables,
    with_tables,
    write_board,
)
from sasgeo_bench.sensing.camera import Camera, Intrinsics
from sasgeo_bench.sensing.image import SUFFIX, LabelledFiles, write_labelled
from sasgeo_bench.sensing.reference_imagery import part_bounds_m, region_views, split_bounds
from sasgeo_bench.sensing.rendering.conditions import draw_conditions
from sasgeo_bench.sensing.rendering.palettes import Family
from sasgeo_bench.sensing.rendering.scene import make_scene
from sasgeo_bench.sensing.rendering.view import render_labelled

TRAIN: Final = (
    *("andorra-la-vella", "encamp", "la-massana", "pas-de-la-casa", "sant-julia"),
    *("lauf", "porto", "town-grid", "town-suburb"),
)
TEST: Final = ("vaduz", "balzers", "badwildbad", "monaco", "town-riverside", "town-agricultural")
SEGMENTERS: Final = ("colour_thresholds", "pixel_forest")
SIDE_PX: Final = 448
VIEW_DEG: Final = 65.0
HEIGHTS_M: Final = (80.0, 300.0)
TILT_DEG: Final = 12.0  # standard deviation
PAINT_M: Final = 0.5  # cells of the paint
LEAST_SHARE: Final = 0.03  # of a scene that any class covers
RENDERED: Final = "rendered"
# Regions with imagery: their parts in the order of the region file, and blocks of each part.
REAL: Final = {"zanzibar": (("north", "south"), 2), "banepa": (("core", "north"), 1)}
TESTED: Final = ("test", "shifted", *REAL)
KINDS: Final = (PLAIN, "picture", "flight")  # uses of shares
DONE: Final = "done.json"

Files = tuple[Path, ...]


@dataclass(frozen=True)
class Trial:
    """A segmenter, what it learns from and what it is tested on; each fold is a pair of sets of pictures."""

    segmenter: str
    learned: str
    tested: str
    folds: tuple[tuple[Files, Files], ...]


def files_of(folder: Path, make: Callable[[], Iterator[sgb.LabelledImage]], *, asked: int = 0) -> Files:
    """Return the files of a set of pictures, made first unless the folder is complete.

    `asked` is the number of pictures that were asked for; a folder that was made with another one is refused.
    """
    done = folder / DONE
    if not done.exists():
        folder.mkdir(parents=True, exist_ok=True)
        began = time.perf_counter()
        count = len(write_labelled(folder, make()))
        took = time.perf_counter() - began
        about = {"asked": asked, "pictures": count, "seconds": round(took, 1)}
        done.write_text(json.dumps(about), encoding="utf-8")
        print(f"{folder}: {count} pictures in {took:.0f} s", flush=True)
    made = json.loads(done.read_text(encoding="utf-8"))["asked"]
    if made != asked:
        raise SystemExit(
            f"{folder} was made with --pictures {made}, not {asked}: pass that number, or remove the folder"
        )
    return tuple(sorted(folder.glob(f"*{SUFFIX}")))


def built_region(name: str, given: argparse.Namespace, folders: Sequence[Path]) -> sgb.Region:
    """Return a region, built first unless it is there; `folders` hold its extracts and pictures."""
    spec = read_region_file(find_region_file(name))
    if not (given.out / "regions" / name).exists():
        plan = plan_build(spec, out=given.out, extract_folders=folders, imagery_folders=folders)
        build_region(plan)
    return sgb.read_region(given.out / "regions" / name)


def rendered(region: str, family: Family, given: argparse.Namespace) -> Iterator[sgb.LabelledImage]:
    """Yield pictures of random places of a region where something is mapped, in random weather and season.

    All families see the same places from the same cameras in the same weather.
    """
    ground = built_region(region, given, given.extracts)
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


def real_blocks(name: str, given: argparse.Namespace) -> list[Files]:
    """Return the files of each block of a region with imagery."""
    root, (parts, count) = given.out / "segmenters" / "pictures" / name, REAL[name]
    if not all((root / f"{part}-{at}" / DONE).exists() for part in parts for at in range(count)):
        spec = read_region_file(find_region_file(name))
        region = built_region(name, given, [getattr(given, name)])
        for part, whole in zip(parts, part_bounds_m(spec, epsg=region.grid.epsg), strict=True):
            for at, block in enumerate(split_bounds(whole, count)):
                files_of(root / f"{part}-{at}", partial(region_views, region, block, place=f"{name}-{part}"))
    return [files_of(root / f"{part}-{at}", lambda: iter(())) for part in parts for at in range(count)]


def sets_of(given: argparse.Namespace) -> dict[str, list[Files]]:
    """Return the files of pictures by set and place, or block."""
    root = given.out / "segmenters" / "pictures"
    found: dict[str, list[Files]] = {}
    for name, family, regions in ((RENDERED, "train", TRAIN), ("test", "test", TEST), ("shifted", "shifted", TEST)):
        usable = [region for region in regions if not given.towns or region.startswith("town-")]
        found[name] = [
            files_of(root / name / region, partial(rendered, region, family, given), asked=given.pictures)
            for region in usable
        ]
    return found | {name: real_blocks(name, given) for name in REAL if getattr(given, name)}


def trials_of(sets: dict[str, list[Files]], segmenters: Sequence[str]) -> Iterator[Trial]:
    """Yield all trials of some segmenters.

    Those that do not learn are tested on every set; others after learning from rendered pictures, from the other blocks
    of the same real region, and from the real regions before it.
    """
    whole = {name: tuple(path for part in parts for path in part) for name, parts in sets.items()}
    tested = [name for name in TESTED if name in sets]
    for name in segmenters:
        if not isinstance(sgb.load_segmenter(name), LearningSegmenter):
            yield from (Trial(name, NOTHING, place, (((), whole[place]),)) for place in tested)
            continue
        yield from (Trial(name, RENDERED, place, ((whole[RENDERED], whole[place]),)) for place in tested)
        real = [place for place in tested if place in REAL]
        for at, place in enumerate(real):
            yield from (Trial(name, other, place, ((whole[other], whole[place]),)) for other in real[:at])
            yield Trial(name, place, place, tuple(without_each(sets[place])))


def without_each(blocks: Sequence[Files]) -> Iterator[tuple[Files, Files]]:
    """Yield for each block the files of all others, and its own."""
    for block in blocks:
        yield tuple(path for other in blocks if other is not block for path in other), block


def digest(*sets: Files) -> str:
    """Return a short name of some pictures, so that others are not taken for them."""
    names = "\n".join("/".join(path.parts[-3:]) for files in sets for path in (*files, Path()))
    return hashlib.sha256(names.encode()).hexdigest()[:8]


def learned_text(trial: Trial, paths: Files, root: Path) -> tuple[str | None, float]:
    """Return what the segmenter of a trial learned, and its processor time; from the disk if it is there."""
    segmenter = sgb.load_segmenter(trial.segmenter)
    if not isinstance(segmenter, LearningSegmenter):
        return None, 0.0
    file = root / "learned" / f"{trial.segmenter}-{trial.learned}-{digest(paths)}.json"
    timed = file.with_suffix(".seconds")
    if not timed.exists():
        file.parent.mkdir(parents=True, exist_ok=True)
        began = time.process_time()
        file.write_text(segmenter.learn(sgb.ImageTraining(images=LabelledFiles(paths))), encoding="utf-8")
        timed.write_text(f"{time.process_time() - began:.2f}", encoding="utf-8")
    return file.read_text(encoding="utf-8"), float(timed.read_text(encoding="utf-8"))


def outcome(trial: Trial, root: Path) -> SegmenterTrial:
    """Return the counts of a trial as the segmenter says and with shares; from the disk where they are."""
    texts = [learned_text(trial, taught, root) for taught, _ in trial.folds]
    pictures = digest(*(files for fold in trial.folds for files in fold))
    stem = f"{trial.segmenter}-{trial.learned}-{trial.tested}-{pictures}"
    files = {kind: root / "counts" / f"{stem}-{kind}.parquet" for kind in KINDS}
    timed = root / "counts" / f"{stem}.seconds"
    if not timed.exists():
        timed.parent.mkdir(parents=True, exist_ok=True)
        counts, seconds = _counted(trial, [text for text, _ in texts])
        for kind, file in files.items():
            write_counts(counts[kind], file)
        timed.write_text(f"{seconds:.4f}", encoding="utf-8")
        print(f"{stem}: {len(counts[PLAIN])} pictures", flush=True)
    return SegmenterTrial(
        segmenter=trial.segmenter,
        learned_from=trial.learned,
        tested_on=trial.tested,
        counts={kind: read_counts(file) for kind, file in files.items()},
        learn_s=float(np.mean([took for _, took in texts])),
        learned_mb=float(np.mean([len(text or "") for text, _ in texts])) / 1e6,
        segment_s=float(timed.read_text(encoding="utf-8")),
    )


def _counted(trial: Trial, texts: Sequence[str | None]) -> tuple[dict[str, list[PixelCounts]], float]:
    """Segment every picture and count; the second is the mean processor time of a picture, s."""
    found: dict[str, list[PixelCounts]] = {kind: [] for kind in KINDS}
    took: list[float] = []
    for text, (_, asked) in zip(texts, trial.folds, strict=True):
        segmenter = sgb.load_segmenter(trial.segmenter)
        for place in sorted({path.parent for path in asked}):
            images = list(LabelledFiles([path for path in asked if path.parent == place]))
            began = time.process_time()
            said = [segmenter.segment(one.image, learned=text) for one in images]
            took += [(time.process_time() - began) / len(images)] * len(images)
            shares = shares_of(images, said[0].classes)
            ways = (said, [one.with_shares(shares) for one in said], together(said, shares))
            for kind, some in zip(KINDS, ways, strict=True):
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
    """Make what is missing, write the board, and print its tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("out"))
    parser.add_argument("--results", type=Path, help="folder of the board")
    parser.add_argument("--board", type=Path, help="measure nothing: take the tables of this stored board")
    parser.add_argument("--page", type=Path, help="put the tables into this page instead of printing them")
    parser.add_argument("--extracts", type=Path, action="append", default=[])
    for name in REAL:
        parser.add_argument(f"--{name}", type=Path, help=f"folder with the pictures and buildings of {name}")
    parser.add_argument("--segmenter", action="append", help=f"repeatable; default: {' and '.join(SEGMENTERS)}")
    parser.add_argument("--towns", action="store_true", help="embedded towns alone")
    parser.add_argument("--pictures", type=int, default=12, help="of each region")
    given = parser.parse_args()
    folder = given.board or given.results or given.out / "segmenters" / "board"
    if not given.board:
        sets = sets_of(given)
        done = [outcome(trial, given.out / "segmenters") for trial in trials_of(sets, given.segmenter or SEGMENTERS)]
        taught = LabelledFiles([path for part in sets[RENDERED] for path in part])
        shares = {name: round(share, 4) for name, share in shares_of(taught, taught[0].classes).items()}
        attrs = {"pictures": given.pictures, "package": sgb.__version__, "rendered_shares": shares}
        write_board(folder, done, attrs=attrs)
    board = SegmenterBoard.read(folder)
    if given.page:
        given.page.write_text(with_tables(given.page.read_text(encoding="utf-8"), board), encoding="utf-8")
    else:
        print(page_tables(board))


if __name__ == "__main__":
    main()
