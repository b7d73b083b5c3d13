# SPDX-License-Identifier: Apache-2.0
"""Time and memory of `score`, from reading the files to the written board, for boards of many sizes.

Queries, truths and answers are made up: 12 regions of four blocks each, four suites of both tracks, a tenth of the
places absent, 25 poses to an answer. A size is matchers x queries; each board is scored in a process of its own. The
first columns are intervals and ranks; the last ones the whole command, with the rejector `margin`, a contrast of two
matchers on each suite, and all figures (there are no maps, and so no pictures). A million answers take five minutes to
make up, once:

    python benchmarks/score.py --sizes 1x10000 10x1000 10x10000 10x100000 --runs 1 --keep out/made-up
"""

import argparse
import datetime as dt
import json
import resource
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from benchmarks.growth import draw
from sasgeo_bench.boards.archive import score_all
from sasgeo_bench.boards.build import make_board
from sasgeo_bench.boards.scored import ScoreRequest
from sasgeo_bench.geometry.grid import Grid
from sasgeo_bench.geometry.pose import Pose, Prior
from sasgeo_bench.matching.matcher import Prediction
from sasgeo_bench.regions.evidence import Evidence
from sasgeo_bench.running import prediction_files
from sasgeo_bench.running.prediction_files import CardRecord, RunManifest
from sasgeo_bench.scoring.contrasts import Contrast
from sasgeo_bench.scoring.intervals import DRAWS
from sasgeo_bench.tasks import task_files
from sasgeo_bench.tasks.query import Query, Truth
from sasgeo_bench.tasks.split import Split, SplitFile, make_split

SIZES = ("1x10000", "5x2000")  # matchers x queries
SUITES = ("clean", "occlusion", "real-age", "alias")
PLACES, SIDE_M = 12, 2048.0
POOL, TOP_K = 50, 25
CLASSES = tuple(f"class-{at}" for at in range(13))
SAME = Pose(easting_m=0.0, northing_m=0.0, yaw_deg=0.0)
PRIOR = Prior(center_m=(0.0, 0.0), radius_m=500.0, yaw_deg=0.0, yaw_sigma_deg=5.0, scale_sigma=0.03)


@dataclass(frozen=True, kw_only=True)
class Task:
    """One suite on one region, made up."""

    suite: str
    region: str
    queries: tuple[Query, ...]
    truths: tuple[Truth, ...]


def made_up_split() -> Split:
    """Twelve places of one region of four blocks each."""
    grids = {
        f"place-{at}": Grid(
            epsg=32632, west_m=300_000.0 + 20_000 * at, north_m=5_200_000.0, cell_size_m=1.0, rows=2048, cols=2048
        )
        for at in range(PLACES)
    }
    places = [{"name": name, "regions": [name], "half": "ab"[at % 2]} for at, name in enumerate(grids)]
    said = {"id": "made-up", "title": "Made up", "kind": "crossfit", "buffer_m": 0.0, "place": places}
    return make_split(SplitFile.model_validate(said), grids)


def somewhere(count: int, rng: np.random.Generator) -> list[Pose]:
    """Poses on a map."""
    table = rng.random((count, 3)) * (SIDE_M, SIDE_M, 360.0)
    return [Pose(easting_m=east, northing_m=north, yaw_deg=yaw) for east, north, yaw in table.tolist()]


def made_up_task(suite: str, region: str, count: int, evidence: Evidence, rng: np.random.Generator) -> Task:
    """Queries in the order of their ids; every fourth is a control, every tenth place is absent."""
    queries, truths = [], []
    for at, name in enumerate(sorted(rng.bytes(12).hex() for _ in range(count))):
        is_choice, is_control, is_present = at % 2 == 1, at % 4 < 2, at % 10 > 0  # shares as told
        places = somewhere(POOL, rng)
        right = int(rng.integers(POOL))
        query = Query(
            query_id=name,
            track="retrieval" if is_choice else "localization",
            suite=suite,
            suite_version=1,
            part="crossfit",
            region=region,
            evidence=evidence,
            observed_on=dt.date(2025, 9, 1),
            season="",
            prior=PRIOR,
            prior_group="r500-known-s3",
            candidates=tuple(places) if is_choice else (),
        )
        truth = Truth(
            query_id=name,
            is_present=is_present,
            pose=places[right],
            candidate=right if is_choice and is_present else -1,
            pair_id=f"{region}/{at // 8}",
            role="control" if is_control else "stress",
            kind="control" if is_control else f"U{1 + at // 4 % 4}",
            strength=0.0 if is_control else float(rng.choice((0.2, 0.4, 0.6))),
            strength_unit="share",
            unknown_share=0.0 if is_control else float(rng.random()),
            changed_share=float(rng.random()),
            feature_density=float(rng.random()),
            alias_index=float(rng.random()),
            block=f"{region}/{at // 8 % 2}-{at // 16 % 2}",
            scene="urban",
        )
        queries.append(query)
        truths.append(truth)
    return Task(suite=suite, region=region, queries=tuple(queries), truths=tuple(truths))


def answers(task: Task, skill: float, rng: np.random.Generator) -> list[Prediction]:
    """Answers of 25 poses, of which the first is right as often as the skill says; one in fifty is a time-out."""
    found = []
    for query, truth in zip(task.queries, task.truths, strict=True):
        if rng.random() < 0.02:  # one in fifty
            found.append(Prediction(query_id=query.query_id, status="timeout", message="late"))
            continue
        near = replace(truth.pose or SAME, easting_m=(truth.pose or SAME).easting_m + float(rng.normal(0.0, 8.0)))
        poses = [near, *somewhere(TOP_K - 1, rng)]
        if query.candidates:
            order = rng.permutation(POOL)[:TOP_K]
            poses = [query.candidates[at] for at in order]
            if truth.candidate >= 0:
                poses = list(dict.fromkeys([query.candidates[truth.candidate], *poses]))[:TOP_K]
        if rng.random() > skill:
            poses = [*poses[1:], poses[0]]
        scores = np.sort(rng.random(len(poses)))[::-1].tolist()
        found.append(
            Prediction(
                query_id=query.query_id,
                candidates=tuple(zip(poses, scores, strict=True)),
                confidence=float(rng.random()),
                diagnostics={"margin": scores[0] - scores[1]},
                latency_s=float(rng.exponential(0.1)),
            )
        )
    return found


def tasks_of(queries: int, rng: np.random.Generator) -> Iterator[Task]:
    """Yield tasks of all suites and places that hold some queries together."""
    cells = (rng.random((len(CLASSES), 192, 192)) < 0.1).astype(np.uint8)  # a tenth is drawn
    evidence = Evidence(classes=CLASSES, cells=cells, cell_size_m=1.0)
    names = [(suite, f"place-{at}") for suite in SUITES for at in range(PLACES)]
    counts = np.diff(np.linspace(0, queries, len(names) + 1).astype(int)).tolist()
    yield from (made_up_task(*name, count, evidence, rng) for name, count in zip(names, counts, strict=True))


def write(root: Path, matchers: int, queries: int) -> None:
    """Write tasks, truths and runs where the command looks for them."""
    rng = np.random.default_rng(0)
    skills = np.linspace(0.5, 0.7, matchers).tolist()
    for task in tasks_of(queries, rng):
        folder, truth = (root / kind / task.suite / task.region for kind in ("tasks", "truth"))
        folder.mkdir(parents=True)
        truth.mkdir(parents=True)
        origin = task_files.TaskOrigin(suite=task.suite, title=task.suite, region=task.region, map_fingerprint="")
        pairs = zip(task.queries, task.truths, strict=True)
        sha256 = task_files.write_task(folder, truth, pairs, origin).queries_sha256
        for at, skill in enumerate(skills):
            name = f"matcher-{at}"
            run = root / "runs" / name / task.suite / task.region
            prediction_files.write_part(run, answers(task, skill, rng))
            RunManifest(
                matcher=CardRecord(name=name, version="1"),
                hash=name,
                suite=task.suite,
                region=task.region,
                queries_sha256=sha256,
                map_bytes=10**7,
                prepare_s=1.0,
                cpu_s=60.0,
                peak_bytes=10**9,
            ).save(run)


def score(root: Path, *, is_whole: bool) -> dict[str, float]:
    """Score a made-up root as `score` does, in this process; return seconds by the clock and of processor, and MB."""
    names = sorted(path.name for path in (root / "runs").iterdir())
    contrasts = [Contrast(name=suite, first=names[0], second=names[-1], suites=(suite,)) for suite in SUITES]
    request = ScoreRequest(
        predictions=[root / "runs"],
        root=root,
        board=root / "boards" / "made-up",
        split=made_up_split(),
        rejectors=("margin",) if is_whole else (),
        contrasts=contrasts if is_whole and len(names) > 1 else (),
    )
    begun = time.perf_counter()
    (score_all if is_whole else make_board)(request)
    usage = resource.getrusage(resource.RUSAGE_SELF)
    used = usage.ru_utime + usage.ru_stime
    return {"s": time.perf_counter() - begun, "cpu_s": used, "mb": usage.ru_maxrss * 1024 / 1e6}


def measured(root: Path, *, is_whole: bool, runs: int) -> dict[str, float]:
    """Return medians of `score` in processes of their own."""
    command = [sys.executable, __file__, "--score", str(root), *(["--whole"] if is_whole else [])]
    outputs = [subprocess.run(command, stdout=subprocess.PIPE, check=True).stdout for _ in range(runs)]  # noqa: S603 - this program
    found = [json.loads(output) for output in outputs]
    return {name: statistics.median(one[name] for one in found) for name in found[0]}


def main() -> None:
    """Print a table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--sizes", nargs="+", default=SIZES, help="matchers x queries, as 10x1000")
    parser.add_argument("--runs", type=int, default=5)
    parser.add_argument("--keep", type=Path, help="folder of made-up answers, which are made once")
    parser.add_argument("--plot", type=Path, help="file to draw time and memory against rows to, as SVG")
    parser.add_argument("--score", type=Path, help=argparse.SUPPRESS)
    parser.add_argument("--whole", action="store_true", help=argparse.SUPPRESS)
    said = parser.parse_args()
    if said.score:
        print(json.dumps(score(said.score, is_whole=said.whole)))
        return
    print(f"medians of {said.runs} runs; {DRAWS} draws, {len(SUITES)} suites, {PLACES} places of 4 blocks\n")
    print("| matchers | queries | s | CPU s | peak MB | whole command, s | CPU s | peak MB |")
    print("|---:|---:|---:|---:|---:|---:|---:|---:|")
    charts: dict[str, dict[str, list[tuple[float, float]]]] = {}
    with tempfile.TemporaryDirectory() as scratch:
        for size in said.sizes:
            matchers, queries = map(int, size.split("x"))
            root = (said.keep or Path(scratch)) / size
            if not (root / "done").is_file():
                write(root, matchers, queries)
                (root / "done").touch()
            cells = [f"{matchers}", f"{queries}"]
            for is_whole in (False, True):
                one = measured(root, is_whole=is_whole, runs=said.runs)
                cells += [f"{one['s']:.1f}", f"{one['cpu_s']:.1f}", f"{one['mb']:.0f}"]
                label = "whole command" if is_whole else "intervals and ranks"
                for title, column in (("time (s)", "s"), ("peak memory (MB)", "mb")):
                    charts.setdefault(title, {}).setdefault(label, []).append((matchers * queries / 1000, one[column]))
            print(f"| {' | '.join(cells)} |", flush=True)
    if said.plot:
        draw(said.plot, charts, xlabel="thousands of rows (matchers x queries)")


if __name__ == "__main__":
    main()
