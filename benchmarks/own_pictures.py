# SPDX-License-Identifier: Apache-2.0
"""Gather the answers on which `locate` calibrates P(false fix), and say how well it holds at places left out.

    sasgeo-bench leaderboard pictures --out out
    .venv/bin/python benchmarks/own_pictures.py out --write sasgeo_bench/observing/chances.json
    .venv/bin/python benchmarks/own_pictures.py

Answers of `sasgeo` to `real-image` of `osm_unet_held_out`: places that taught that segmenter nothing. Without `out` the
file that ships is read. The table leaves each place out in turn: P(false fix) is fitted on the others.
"""

import argparse
import json
import math
from collections import Counter
from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path
from typing import Final

import numpy as np

from sasgeo_bench.core.errors import SasgeoError
from sasgeo_bench.observing.chances import Answers, Chances, StoredFit, shipped_answers
from sasgeo_bench.running.prediction_files import read_predictions
from sasgeo_bench.sasgeo.integrity import EVIDENCE_NAMES
from sasgeo_bench.sasgeo.rejectors import FittedModel, is_none, lead
from sasgeo_bench.scoring.intervals import wilson_share
from sasgeo_bench.tasks.query import Truth, base_of
from sasgeo_bench.tasks.task_files import Task

MATCHER: Final = "sasgeo"
SEGMENTER: Final = "osm_unet_held_out"
SUITE: Final = f"real-image+{SEGMENTER}"
BINS: Final = (0.0, 0.05, 0.2, 0.5, 0.8, 0.9, 1.0)
FOUND_M, FOUND_DEG = 25.0, 5.0
MOST_SCALE_SIGMA: Final = 0.1  # of the photos of benchmarks/own_photos.py; of the answers here 0.03


def is_right(truth: Truth, answer: object) -> bool:
    """Return whether the first pose of an answer is the true one, within 25 m and 5 deg."""
    if not truth.is_present or truth.pose is None:
        return False
    pose = answer.candidates[0][0]
    off_m = math.hypot(pose.easting_m - truth.pose.easting_m, pose.northing_m - truth.pose.northing_m)
    return off_m <= FOUND_M and abs((pose.yaw_deg - truth.pose.yaw_deg + 180) % 360 - 180) <= FOUND_DEG


def rounded(value: float | None) -> float | None:
    """Return a number to five digits; None where there is none."""
    return None if value is None or not math.isfinite(value) else float(f"{value:.5g}")


def gathered(out: Path) -> Answers:
    """Read the answers of a folder; raise `SystemExit` if there is none."""
    places: list[str] = []
    rows, sides, gsds, versions = [], set(), set(), set()
    for folder in sorted((out / "runs" / MATCHER).glob(f"*/{SUITE}/*/")):
        task = Task.open(out / "tasks" / SUITE / folder.name)
        run = json.loads((folder / "run.json").read_text(encoding="utf-8"))
        versions.add(run["matcher"]["version"])
        place = base_of(folder.name).removesuffix("-osm").removesuffix("-ortho")
        if place not in places:
            places.append(place)
        truths = {item.query_id: item for item in task.truths}
        sides |= {head.view_cells * head.cell_size_m for head in task.heads()}
        gsds |= {item.measured.get("gsd_m", 0.0) for item in truths.values()}
        for answer in read_predictions(folder):
            truth = truths.get(answer.query_id)
            if truth is not None and answer.status == "ok" and not is_none(answer):
                numbers = [rounded(answer.diagnostics.get(name)) for name in EVIDENCE_NAMES]
                false = float(not is_right(truth, answer))
                rows.append((places.index(place), false, rounded(lead(answer)), rounded(answer.confidence), *numbers))
    if len(versions) != 1:
        raise SystemExit(
            f"{out} holds answers of {len(versions)} versions of {MATCHER} to {SUITE}: make the board anew"
        )
    return Answers(
        matcher=MATCHER,
        version=versions.pop(),
        segmenters=(SEGMENTER, "osm_unet"),
        asked=SEGMENTER,
        places=tuple(places),
        sides_m=(min(sides), max(sides)),
        most_gsd_m=max(gsds),
        most_radius_m=500.0,
        most_yaw_sigma_deg=20.0,
        most_scale_sigma=MOST_SCALE_SIGMA,
        diagnostics=EVIDENCE_NAMES,
        rows=tuple(rows),
    )


def left_out(answers: Answers) -> "tuple[np.ndarray, np.ndarray]":
    """Return P(false fix) of each answer by the places that are not its own, and its place."""
    place = np.array([int(row[0]) for row in answers.rows])
    p_false = np.zeros(len(place))
    items = answers.predictions()
    for number, name in enumerate(answers.places):
        chances = Chances.fitted(answers, without=[name])
        here = np.flatnonzero(place == number)
        p_false[here] = chances.rejector.p_false([items[at] for at in here])
    return p_false, place


def tables(answers: Answers) -> Iterator[str]:
    """Yield the table of stated and true shares, and what each place accepts."""
    p_false, place = left_out(answers)
    false = answers.is_false
    yield "| P(false fix) | n | Stated, % | False, % | 95 % |\n|---|---:|---:|---:|---|"
    for low, high in pairwise(BINS):
        here = (p_false >= low) & ((p_false < high) | (high == 1.0))
        if here.any():
            limits = wilson_share(float(false[here].mean()), int(here.sum()))
            yield (
                f"| {low:g} to {high:g} | {here.sum()} | {100 * p_false[here].mean():.0f} | "
                f"{100 * false[here].mean():.0f} | {100 * limits.lo:.0f} to {100 * limits.hi:.0f} |"
            )
    yield ""
    yield "| Place left out | n | Right | Accepted at 5 % | False of them | Said to be off the map | Right of them |"
    yield "|---|---:|---:|---:|---:|---:|---:|"
    for number, name in enumerate(answers.places):
        here = place == number
        taken, refused = here & (p_false <= 0.05), here & (p_false >= 0.9)
        yield (
            f"| {name} | {here.sum()} | {(here & ~false).sum()} | {taken.sum()} | {(taken & false).sum()} | "
            f"{refused.sum()} | {(refused & ~false).sum()} |"
        )


def with_fit(answers: Answers) -> Answers:
    """Return answers with the fit on all of them, which `locate` reads."""
    rule = Chances.fitted(answers).rejector.rule
    if not isinstance(rule, FittedModel):
        raise SystemExit("too few right or false answers for a fit: make a larger board")
    return answers.model_copy(update={"fit": StoredFit.of(rule)})


def main() -> None:
    """Print the tables, and write the file if asked to."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("out", type=Path, nargs="?", help="folder of the board; the file that ships without it")
    parser.add_argument("--write", type=Path, help="file to write")
    given = parser.parse_args()
    found = [gathered(given.out)] if given.out else list(shipped_answers())
    for answers in found:
        print(answers.text, Counter(answers.is_false.tolist()))
        print("\n".join(tables(answers)))
    if given.write:
        text = json.dumps([with_fit(item).model_dump(mode="json") for item in found], separators=(",", ":"))
        given.write.write_text(text.replace("],[", "],\n[") + "\n", encoding="utf-8")


if __name__ == "__main__":
    try:
        main()
    except SasgeoError as error:
        raise SystemExit(str(error)) from error
