# SPDX-License-Identifier: Apache-2.0
"""Seconds to score 10,000 predictions and put them on a board with all intervals: one matcher, and five.

Queries, truths and answers are made up: 12 regions of four blocks each, four suites of both tracks, a tenth of the
places absent, 25 poses to an answer. "in memory" is scoring and figures alone; "from disk" is all that the command
`score` does, from reading the files to the written board; "+ margin" is that with a rejector, and a contrast of both.
Run it with `make bench`.
"""

import argparse
import datetime as dt
import gc
import statistics
import sys
import tempfile
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from sasgeo_bench.geometry.grid import Grid
from sasgeo_bench.geometry.pose import Pose, Prior
from sasgeo_bench.leaderboard.board import ScoreRequest
from sasgeo_bench.leaderboard.build import make_board
from sasgeo_bench.matching.results import Prediction
from sasgeo_bench.regions.evidence import Evidence
from sasgeo_bench.running import prediction_files
from sasgeo_bench.scoring.contrasts import Contrast
from sasgeo_bench.scoring.draws import DRAWS
from sasgeo_bench.scoring.score import score_task
from sasgeo_bench.scoring.tables import leaderboard
from sasgeo_bench.tasks import task_files
from sasgeo_bench.tasks.query import Head, Query, Truth
from sasgeo_bench.tasks.split import Split, SplitFile, make_split

SIZES = ((1, 10_000), (5, 2_000))  # matchers, queries: 10,000 predictions each
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
        is_choice, is_control, is_present = at % 2 == 1, at % 4 < 2, at % 10 > 0  # noqa: PLR2004 - shares as told
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
        if rng.random() < 0.02:  # noqa: PLR2004 - one in fifty
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


def made_up(matchers: int, queries: int) -> tuple[list[Task], dict[str, list[list[Prediction]]]]:
    """Tasks, and for each matcher its answers to each of them."""
    rng = np.random.default_rng(0)
    cells = (rng.random((len(CLASSES), 192, 192)) < 0.1).astype(np.uint8)  # noqa: PLR2004 - a tenth is drawn
    evidence = Evidence(classes=CLASSES, cells=cells, cell_size_m=1.0)
    names = [(suite, f"place-{at}") for suite in SUITES for at in range(PLACES)]
    counts = np.diff(np.linspace(0, queries, len(names) + 1).astype(int)).tolist()
    tasks = [made_up_task(*name, count, evidence, rng) for name, count in zip(names, counts, strict=True)]
    skills = np.linspace(0.5, 0.7, matchers).tolist()
    return tasks, {f"matcher-{at}": [answers(task, skill, rng) for task in tasks] for at, skill in enumerate(skills)}


def head_of(query: Query) -> Head:
    """What scoring needs of a query."""
    names = ("query_id", "track", "suite", "suite_version", "part", "region", "prior_group", "candidates")
    said = {name: getattr(query, name) for name in names}
    return Head(**said, view_cells=query.evidence.shape[0], cell_size_m=query.evidence.cell_size_m)


def in_memory(tasks: Sequence[Task], given: Mapping[str, Sequence[Sequence[Prediction]]], split: Split) -> float:
    """Seconds of scoring and of the leaderboard."""
    heads = [head_of(query) for task in tasks for query in task.queries]
    truths = [truth for task in tasks for truth in task.truths]
    found = {name: {item.query_id: item for part in parts for item in part} for name, parts in given.items()}
    begun = time.perf_counter()
    leaderboard({name: score_task(heads, truths, mine, place_of=split.place_of) for name, mine in found.items()})
    return time.perf_counter() - begun


def write(tasks: Sequence[Task], given: Mapping[str, Sequence[Sequence[Prediction]]], root: Path) -> None:
    """Tasks, truths and runs where the command looks for them."""
    for at, task in enumerate(tasks):
        folder, truth = (root / kind / task.suite / task.region for kind in ("tasks", "truth"))
        folder.mkdir(parents=True)
        truth.mkdir(parents=True)
        about = {"suite": task.suite, "title": task.suite, "region": task.region, "map_fingerprint": ""}
        task_files.write_task(folder, truth, zip(task.queries, task.truths, strict=True), about)
        sha256 = task_files.read_task(folder)["files"][task_files.QUERIES]["sha256"]
        for name, parts in given.items():
            run = root / "runs" / name / task.suite / task.region
            prediction_files.write_part(run, parts[at])
            card = {"name": name, "version": "1"}
            costs = {"prepare_s": 1.0, "peak_bytes": 10**9, "map_bytes": 10**7, "cpu_s": 60.0}
            said = {"suite": task.suite, "region": task.region, "queries_sha256": sha256, "hash": name}
            prediction_files.write_run(run, {"matcher": card, **said, **costs})


def from_disk(root: Path, split: Split, *, rejectors: Sequence[str], names: Sequence[str]) -> float:
    """Seconds of all that `score` does."""
    pair = (names[0], names[-1])
    request = ScoreRequest(
        predictions=[root / "runs"],
        root=root,
        board=root / "boards" / "made-up",
        split=split,
        rejectors=rejectors,
        contrasts=[Contrast(name=suite, first=pair[0], second=pair[1], suites=(suite,)) for suite in SUITES],
    )
    begun = time.perf_counter()
    make_board(request, tell=lambda _: None)
    return time.perf_counter() - begun


def main() -> None:
    """Print a table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--runs", type=int, default=5)
    runs = parser.parse_args().runs
    split = made_up_split()
    print(f"medians of {runs} runs in seconds; {DRAWS} draws, {len(SUITES)} suites, {PLACES} places of 4 blocks\n")
    print(f"{'matchers':>8} {'queries':>8} {'in memory':>10} {'from disk':>10} {'+ margin':>9}")
    for matchers, queries in SIZES:
        tasks, given = made_up(matchers, queries)
        with tempfile.TemporaryDirectory() as folder:
            root = Path(folder)
            write(tasks, given, root)
            gc.collect()
            gc.freeze()  # what was made up here is not for the scorer to look through
            rows = [
                (
                    in_memory(tasks, given, split),
                    from_disk(root, split, rejectors=(), names=list(given)),
                    from_disk(root, split, rejectors=("margin",), names=list(given)),
                )
                for _ in range(runs)
            ]
        memory_s, disk_s, margin_s = (statistics.median(column) for column in zip(*rows, strict=True))
        print(f"{matchers:8d} {queries:8d} {memory_s:10.2f} {disk_s:10.2f} {margin_s:9.2f}", flush=True)


if __name__ == "__main__":
    sys.exit(main())
