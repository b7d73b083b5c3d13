# SPDX-License-Identifier: Apache-2.0
"""What was tried to make the scorer better, on the four towns where its switches are chosen.

    python benchmarks/scorer_trials.py levels --out out     # widths of a level and bounds: errors that hang together
    python benchmarks/scorer_trials.py beams --out out [--radius-m 2000]      # modes that the search keeps
    python benchmarks/scorer_trials.py shifts --out out     # each square of a view may lie a few metres off
    python benchmarks/scorer_trials.py ages --out out       # every map is some years older than it says
    python benchmarks/scorer_trials.py survival --out out   # nodes of an old map weigh by what is left of their class
    python benchmarks/scorer_trials.py unknown --out out    # hidden is absent, with each kind of errors

Needs the views that `sasgeo-bench leaderboard scorer-trials` draws into `--out`. Each asks the untaught scorer for
stressed localization views of 192 m and prints the share found within 25 m and 5 deg, by suite, with the processor time
of a view. `--every 3` asks one view in three.
"""

import argparse
import datetime as dt
import math
import time
from collections import defaultdict
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from functools import partial
from itertools import product
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
from sasgeo_bench.tasks.suites.measured_vectors import MeasuredVectorNoise, perceive_coarsely

import sasgeo_bench as sgb
from sasgeo_bench.sasgeo import raster
from sasgeo_bench.sasgeo.graph import verify
from sasgeo_bench.sasgeo.joint import columns
from sasgeo_bench.sasgeo.nodes import NODE_KINDS
from sasgeo_bench.sasgeo.reading import Reader, Reading
from sasgeo_bench.sasgeo.scorer_model import ScorerModel
from sasgeo_bench.sasgeo.variants import LISTED, SasgeoPrior
from sasgeo_bench.search.dense import LevelView
from sasgeo_bench.search.field import FULL, between, warped
from sasgeo_bench.search.find import search
from sasgeo_bench.search.plan import Plan
from sasgeo_bench.tasks.query import base_of

# Widths, metres, with bounds: both are changed about the values that ship, one at a time.
PAIRS = [*product((24.0,), (1e3, 3e3, 1e4, 3e4)), *product((12.0, 48.0, 96.0), (3e3,))]
BEAMS = ((320, 96, 32, 16, 12), (160, 48, 16, 8, 6), (80, 24, 10, 6, 5), (40, 12, 5, 3, 3))
SQUARES_M, SIGMAS_M, REACH = (24.0, 48.0, 96.0), (1.0, 2.0, 3.0), 2  # REACH in cells of the search
YEARS = (0.0, 3.0, 10.0, 30.0)
BETAS = (0.25, 0.5, 1.0)
NEAR_M, NEAR_DEG, SIDE_M = 25.0, 5.0, 192.0
TOWNS = ("krems", "porto", "london", "vaduz")  # of `scorer-trials`: the scorer is chosen nowhere else

Asked = tuple[str, sgb.Query, sgb.Truth]
Finder = Callable[[sgb.Query, sgb.Truth], sgb.Pose | None]
Row = Callable[[Reader], Finder]


def views(out: Path, *, every: int, radius_m: float | None) -> Iterator[Asked]:
    """Yield every so many of the views of each task on a town of the trials, map by map."""
    folders = (one for one in (out / "tasks").glob("*/*") if not one.name.startswith("."))
    for folder in sorted(folders, key=lambda one: (one.name, one.parent.name)):
        if base_of(folder.name).partition("+")[0] not in TOWNS:
            continue
        truths = {one.query_id: one for one in sgb.read_truths(out / "truth" / folder.parent.name / folder.name)}
        asked = [
            query
            for query in sgb.read_queries(folder)
            if query.track == "localization" and round(max(query.evidence.size_m)) == SIDE_M
            if truths[query.query_id].is_present and truths[query.query_id].role == "stress"
        ]
        for query in sorted(asked, key=lambda one: one.query_id)[::every]:
            prior = replace(query.prior, radius_m=query.prior.radius_m if radius_m is None else radius_m)
            yield folder.parent.name, replace(query, prior=prior), truths[query.query_id]


def is_right(pose: sgb.Pose | None, truth: sgb.Truth) -> bool:
    """Whether a pose is near enough."""
    if pose is None or truth.pose is None:
        return False
    off_m = math.dist((pose.easting_m, pose.northing_m), (truth.pose.easting_m, truth.pose.northing_m))
    return off_m <= NEAR_M and abs(float(sgb.wrap_deg(pose.yaw_deg - truth.pose.yaw_deg))) <= NEAR_DEG


class Table:
    """Rows that are filled view by view: each map is read once for all of them."""

    def __init__(self, rows: dict[str, Row], out: Path) -> None:
        self.rows, self.out = rows, out
        self.found: dict[str, dict[str, list[bool]]] = {name: defaultdict(list) for name in rows}
        self.seconds: dict[str, list[float]] = {name: [] for name in rows}

    def ask(self, asked: Sequence[Asked]) -> None:
        """Ask all rows for all views."""
        region, finders = "", dict[str, Finder]()
        for suite, query, truth in asked:
            if query.region != region:
                region, here = query.region, sgb.read_region(self.out / "regions" / query.region)
                reader = Reader.of(here, ScorerModel.by_hand(here.classes), SasgeoPrior.switches)
                finders = {name: make(reader) for name, make in self.rows.items()}
            for name, find in finders.items():
                start = time.process_time()
                pose = find(query, truth)
                self.seconds[name].append(time.process_time() - start)
                self.found[name][suite].append(is_right(pose, truth))

    def text(self) -> str:
        """Return the table."""
        first = next(iter(self.found.values()))
        suites = sorted(first)
        counts = [f"{suite} ({len(first[suite])})" for suite in suites]
        lines = [f"| | all ({sum(map(len, first.values()))}) | {' | '.join(counts)} | CPU s |", "|---|"]
        lines[1] += "---:|" * (len(suites) + 2)
        for name, by_suite in self.found.items():
            shares = [np.mean([one for some in by_suite.values() for one in some])]
            shares += [np.mean(by_suite[suite]) for suite in suites]
            cells = " | ".join(f"{share:.3f}" for share in shares)
            lines.append(f"| {name} | {cells} | {np.median(self.seconds[name]):.2f} |")
        return "\n".join(lines)


def matcher_of(reader: Reader, plan: Plan | None = None) -> SasgeoPrior:
    """Return the matcher with a map that has been read."""
    matcher = SasgeoPrior(plan)
    matcher._reader = reader  # noqa: SLF001 - read once for all rows
    return matcher


def first_of(reader: Reader, *, plan: Plan | None = None) -> Finder:
    """Return who gives the first pose of the scorer."""
    matcher = matcher_of(reader, plan)
    return lambda query, _: next(iter(matcher.match(query, top_k=1).poses), None)


def alone(reader: Reader) -> Finder:
    """Return who counts each cell alone."""
    return first_of(replace(reader, switches=replace(reader.switches, correlates=False)))


def blind(reader: Reader, *, correlates: bool) -> Finder:
    """Return who takes what is hidden for absent."""
    return first_of(replace(reader, switches=replace(reader.switches, is_unknown_silent=False, correlates=correlates)))


def levelled_by(reader: Reader, *, width_m: float, bound: float) -> Finder:
    """Return who finds with another width of a level, and another bound."""
    find = first_of(reader)

    def found(query: sgb.Query, truth: sgb.Truth) -> sgb.Pose | None:
        """Find a view."""
        raster.LEVEL_M, raster.REPEATED = width_m, bound  # type: ignore[misc] # constants, but for this program
        return find(query, truth)

    return found


def older_by(reader: Reader, *, years: float) -> Finder:
    """Return who takes every map to be older by some years."""
    find = first_of(reader)

    def found(query: sgb.Query, truth: sgb.Truth) -> sgb.Pose | None:
        """Find a view that is later by as much."""
        later = query.observed_on + dt.timedelta(days=365.25 * years)
        return find(replace(query, observed_on=later), truth)

    return found


def listed(reading: Reading) -> list[sgb.Pose]:
    """Return the modes that the scorer orders by the joint score."""
    starts, prior = reading.proposed(), reading.query.prior
    found = search(reading.reader.field, reading.template, prior, Plan(), count=LISTED, starts=starts)
    return [mode.pose for mode in found.modes]


def shifted(reader: Reader, *, square_m: float, sigma_m: float) -> Finder:
    """Return who lets each square of a view lie off by some metres: a likelihood summed over its shifts.

    Shifts are normal with `sigma_m` on each axis, and independent from square to square.
    """

    def found(query: sgb.Query, _: sgb.Truth) -> sgb.Pose | None:
        """Order the modes anew."""
        reading = reader.read(query)
        poses = listed(reading)
        if not poses:
            return None
        view = LevelView.of(reader.field, reading.template, 1)
        more = [summed_over_shifts(view, pose, square_m, sigma_m) - view.score(pose) for pose in poses]
        terms = reading.terms(poses, reading.verified(poses)).sum(axis=1)
        return poses[int(np.argmax(terms + more))]

    return found


def summed_over_shifts(view: LevelView, pose: sgb.Pose, square_m: float, sigma_m: float) -> float:
    """Return the score of a pose whose squares may each be off."""
    (rows, cols), cell_m = view.frame.shape, view.frame.cell_size_m
    wide = view.frame.window(-REACH, -REACH, rows + 2 * REACH, cols + 2 * REACH)
    under = warped(view.level.cells, between(wide, pose, view.level.grid), wide.shape).astype(np.float32)
    firsts = [np.linspace(0, n, max(1, round(n * cell_m / square_m)) + 1).astype(int)[:-1] for n in (rows, cols)]
    offs = np.array(list(product(range(2 * REACH + 1), repeat=2)))
    sums = []
    for down, right in offs.tolist():
        cells = np.einsum("ijb,ijb->ij", under[down : down + rows, right : right + cols], view.bands) / FULL
        sums.append(np.add.reduceat(np.add.reduceat(cells, firsts[0], axis=0), firsts[1], axis=1).ravel())
    logs = -(((offs - REACH) * cell_m) ** 2).sum(axis=1) / (2 * sigma_m**2)
    logs -= np.log(np.exp(logs).sum())
    return float(np.logaddexp.reduce(np.stack(sums) + logs[:, None], axis=0).sum())


def surviving(reader: Reader, *, world: sgb.Region, beta: float, ages: bool) -> Finder:
    """Return who compares vectors of the world of today with the graph of an old map.

    With `ages` a mapped node is seen, and a seen one mapped, with the probability by hand times that with which the
    class that changes fastest among those of the node survives the age of the map: w_i of Eq. 9.
    """
    state: Any = SimpleNamespace(features=world.features)

    def found(query: sgb.Query, truth: sgb.Truth) -> sgb.Pose | None:
        """Draw the vectors, and order the modes with them."""
        assert truth.pose is not None  # noqa: S101 - only present places are asked
        rng = np.random.default_rng(int(query.query_id[:8], 16))
        vectors = perceive_coarsely(state, truth.pose, side_m=SIDE_M, noise=MeasuredVectorNoise(), rng=rng)
        reading = reader.read(replace(query, vectors=vectors))
        poses = listed(reading)
        if not poses or reading.graph is None:
            return None
        model = reader.model
        rates = dict(zip(model.classes, model.rates, strict=True))
        left = np.array(
            [min((rates[name].survival(reading.age_years) for name in kind.classes if name in rates), default=1.0)
             for kind in NODE_KINDS]
        )  # fmt: skip
        hit, extra = np.array(model.rules.hit) * left, 1 - (1 - np.array(model.rules.extra)) * left
        rules = replace(model.rules, hit=tuple(hit), extra=tuple(extra)) if ages else model.rules
        graph = np.array([one.score for one in verify(reading.observed, reading.graph, poses, rules)])
        by_class = reading.by_class(poses) * model.scaling
        terms = columns(by_class, graph, replace(model.blend, beta=beta), nodes=len(reading.observed.nodes))
        return poses[int(np.argmax(terms.sum(axis=1)))]

    return found


def rows_of(trial: str, out: Path) -> dict[str, Row]:
    """Return the rows of a trial."""
    if trial == "levels":
        pairs = {f"{w:g} m, {b:g}": partial(levelled_by, width_m=w, bound=b) for w, b in PAIRS}
        return {"each cell alone": alone, **pairs}
    if trial == "beams":
        return {" ".join(map(str, beam)): partial(first_of, plan=Plan(beam=beam)) for beam in BEAMS}
    if trial == "ages":
        return {f"{years:g} years": partial(older_by, years=years) for years in YEARS}
    if trial == "unknown":
        return {
            "each cell alone": alone,
            "each cell alone, hidden is absent": partial(blind, correlates=False),
            "hang together": first_of,
            "hang together, hidden is absent": partial(blind, correlates=True),
        }
    if trial == "shifts":
        pairs = {f"{s:g} m, {m:g} m": partial(shifted, square_m=s, sigma_m=m) for s, m in product(SQUARES_M, SIGMAS_M)}
        return {"as it is": first_of, **pairs}
    world = sgb.read_region(out / "regions" / "vaduz")
    betas = {
        f"graph {'by what is left' if ages else 'as it is'}, beta {beta:g}": partial(
            surviving, world=world, beta=beta, ages=ages
        )
        for ages, beta in product((False, True), BETAS)
    }
    return {"no vectors": first_of, **betas}


def main() -> None:
    """Print the table of one trial."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("trial", choices=("levels", "beams", "shifts", "ages", "survival", "unknown"))
    parser.add_argument(
        "--out", type=Path, default=Path("out"), help="where sasgeo-bench leaderboard scorer-trials drew its views"
    )
    parser.add_argument("--every", type=int, default=1, help="asks one view in so many of each task")
    parser.add_argument("--radius-m", type=float, help="searches so far around, in place of what the views say")
    words = parser.parse_args()
    if words.every < 1:
        parser.error(f"--every is at least 1, got {words.every}")
    if words.radius_m is not None and not 0 < words.radius_m < math.inf:
        parser.error(f"--radius-m is above 0 and finite, got {words.radius_m:g}")
    asked = list(views(words.out, every=words.every, radius_m=words.radius_m))
    only = {"survival": "real-age", "unknown": "occlusion"}.get(words.trial)
    asked = [one for one in asked if only in (None, one[0])]
    if not asked:
        parser.error(
            f"{words.out} holds no such views: sasgeo-bench leaderboard scorer-trials --out {words.out} draws some"
        )
    table = Table(rows_of(words.trial, words.out), words.out)
    table.ask(asked)
    print(table.text())


if __name__ == "__main__":
    main()
