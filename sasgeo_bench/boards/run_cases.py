# SPDX-License-Identifier: Apache-2.0
"""Failures of a matcher's runs, query by query, and the content of the picture of each."""

import difflib
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Final

import numpy as np
import pandas as pd

from sasgeo_bench.boards.cases import (
    CasePicture,
    MapPart,
    disc_of,
    find_cases,
    operating_rejector,
    seen_at,
    window_around,
    words_of,
)
from sasgeo_bench.core.errors import ConfigError, SasgeoError, StoreError, counted
from sasgeo_bench.core.progress import tell
from sasgeo_bench.geometry.grid import Grid
from sasgeo_bench.geometry.pose import Pose
from sasgeo_bench.matching.matcher import Prediction
from sasgeo_bench.regions import region_files
from sasgeo_bench.regions.evidence import LayerBits
from sasgeo_bench.regions.layers import read_layers
from sasgeo_bench.running.prediction_files import CANDIDATE_M, Answers, RunManifest, read_ties
from sasgeo_bench.sasgeo.integrity import EVIDENCE
from sasgeo_bench.scoring.controls import is_control
from sasgeo_bench.scoring.entries import Entry, find_entries
from sasgeo_bench.scoring.flights import ScoredFlights, score_flights
from sasgeo_bench.scoring.pose import first_pose
from sasgeo_bench.scoring.rejection import OWN, judge, own_confidence, rules_of
from sasgeo_bench.scoring.score import COLUMNS, MISSING, score_task, settle_not_applicable
from sasgeo_bench.tasks.build import rebuild_hint
from sasgeo_bench.tasks.query import REAL, Query, Truth
from sasgeo_bench.tasks.segmented import read_segmented, segmented_file
from sasgeo_bench.tasks.sheet import strength_text
from sasgeo_bench.tasks.split import Split
from sasgeo_bench.tasks.task_files import Task

_ROOM: Final = 1.25  # around both places
_LEAST_SIDES: Final = 2.4  # of a view, a piece of a map is at least
_MOST_LINES: Final = 17
_MOST_LETTERS: Final = 40  # of a name there


@dataclass(frozen=True, kw_only=True)
class Case:
    """One query and all that is known of its answer.

    `failure` is the class of the failure; "" without one. `prediction` is None for a missing row. By rejector,
    `p_false` is the stated chance that the answer is false, `orders` the same of rejectors that give an order and no
    probability, and `accepted` whether the threshold for a risk of 5 % accepts it.
    """

    matcher: str
    failure: str
    query: Query
    truth: Truth
    prediction: Prediction | None
    p_false: Mapping[str, float] = field(default_factory=dict)
    orders: Mapping[str, float] = field(default_factory=dict)
    accepted: Mapping[str, bool] = field(default_factory=dict)

    @property
    def fix(self) -> Pose | None:
        """Return the first pose of the answer."""
        return first_pose(self.prediction)

    @property
    def error_m(self) -> float | None:
        """Return the distance of the answer from the true place; None if either is unknown."""
        fix, true = self.fix, self.truth.pose
        if fix is None or true is None:
            return None
        return math.hypot(fix.easting_m - true.easting_m, fix.northing_m - true.northing_m)


def facts_of(case: Case) -> dict[str, float | str]:
    """Return the known facts of a case as plain numbers and words.

    `error_m` is the distance from where the view was taken, also of absent places; `score_margin` the score of the
    first pose less that of the second; `p_false_<rejector>` (`order_<rejector>` where it is no probability) and
    `accepted_<rejector>` are of a rejector, `reported_<name>` are diagnostics of the answer.
    """
    prediction, truth = case.prediction, case.truth
    status: str = MISSING if prediction is None else prediction.status
    if prediction is not None and status == "ok" and case.fix is None:
        status = "withheld"
    scores = [score for _, score in prediction.candidates] if prediction is not None else []
    found: dict[str, float | str | None] = {
        "status": status,
        "error_m": case.error_m,
        "score_margin": scores[0] - scores[1] if len(scores) > 1 else None,
        "confidence": None if prediction is None else prediction.confidence,
        **{f"p_false_{name}": value for name, value in case.p_false.items()},
        **{f"order_{name}": value for name, value in case.orders.items()},
        **{f"accepted_{name}": "yes" if value else "no" for name, value in case.accepted.items()},
        "present": "yes" if truth.is_present else "no",
        "strength": truth.strength,
        "strength_unit": truth.strength_unit,
        "unknown_share": truth.unknown_share,
        "changed_share": truth.changed_share,
        "alias_index": truth.alias_index,
        "map_age_years": truth.measured.get("age_years"),
        **{f"reported_{name}": value for name, value in (() if prediction is None else prediction.diagnostics.items())},
    }
    texts: dict[str, float | str] = {name: value for name, value in found.items() if isinstance(value, str)}
    numbers = {name: float(value) for name, value in found.items() if value is not None and name not in texts}
    rounded = {name: float(f"{value:.6g}") for name, value in numbers.items() if math.isfinite(value)}
    return {name: (texts | rounded)[name] for name in found if name in texts or name in rounded}


def read_picture(case: Case, task: Task) -> CasePicture:
    """Read the map, evidence and poses that the picture of a case shows.

    The map must be the very build that the task was drawn on. Raise StoreError if it is missing, damaged, or was built
    anew since.
    """
    region = task.region
    manifest = region_files.read_manifest(region)
    if not task.manifest.is_of_map(manifest):
        raise StoreError(rebuild_hint(task.manifest.region))
    query, truth = case.query, case.truth
    modes = case.prediction.candidates if case.prediction is not None and case.fix is not None else ()
    row, col, rows, cols = window = _window(case, manifest.grid)
    layers, grid = read_layers(region / region_files.LAYERS, window=window), manifest.grid.window(row, col, rows, cols)
    bits = LayerBits.of(layers)
    owners = [manifest.attribution]
    if truth.detector == REAL:  # cut out of imagery, perhaps of another place
        of_map = "" if manifest.imagery is None else manifest.imagery.attribution
        owners.append(task.manifest.picture_attribution or of_map)
    return CasePicture(
        title=_title(case),
        view=query.evidence,
        part=MapPart.of(layers, grid, manifest),
        true=truth.pose,
        is_present=truth.is_present,
        modes=modes,
        at_true=None if truth.pose is None else seen_at(truth.pose, query.evidence, bits, grid, manifest),
        at_answer=None if case.fix is None else seen_at(case.fix, query.evidence, bits, grid, manifest),
        disc=disc_of(query),
        lines=_lines(case),
        attribution="; ".join(filter(None, owners)),
        what=_what(case),
        region=query.region,
        picture=query.frames[-1].image().rgb if query.frames else None,
        segmented=read_segmented(segmented_file(task.root, task.manifest.queries_sha256), query.query_id),
        is_own=truth.is_own,
    )


def _window(case: Case, grid: Grid) -> tuple[int, int, int, int]:
    """Return row, column, rows and columns of the part of the map to draw, square unless the map ends."""
    side_m = max(case.query.evidence.size_m)
    poses = [pose for pose in (case.truth.pose, case.fix) if pose is not None]
    if not poses:
        return (0, 0, grid.rows, grid.cols)
    places = np.array([(pose.easting_m, pose.northing_m) for pose in poses])
    span_m = float(np.ptp(places, axis=0).max()) + math.sqrt(2.0) * side_m
    half_m = max(_ROOM * span_m, _LEAST_SIDES * side_m) / 2
    return window_around(grid, (places.min(axis=0) + places.max(axis=0)) / 2, half_m)


def _title(case: Case) -> str:
    query = case.query
    where = f"{query.suite} / {query.region} ({_what(case)}; {query.track})"
    return f"{case.failure or 'no failure'}: {case.matcher} on {where}\nquery {query.query_id}"


def _what(case: Case) -> str:
    """Return kind and strength of the stress."""
    truth = case.truth
    return truth.kind if truth.role == "control" else f"{truth.kind}, {strength_text(truth)}"


def _lines(case: Case) -> list[str]:
    """Return the lines of a picture about an answer: result, rejectors, diagnostics."""
    facts = facts_of(case)
    lines = ["the answer", f"status: {facts['status']}"]
    if case.error_m is not None:
        lines.append(f"error: {case.error_m:.1f} m" + ("" if case.truth.is_present else " (of an absent place)"))
    if case.query.track == "retrieval":
        lines.append(f"right candidate: {_right_candidate(case)}")
    if "confidence" in facts:
        lines.append(f"own confidence: {facts['confidence']:.3g}")
    rejectors = [(f"P(false) {name}", name, value) for name, value in case.p_false.items()]
    rejectors += [(f"{name} (an order, no probability)", name, value) for name, value in case.orders.items()]
    for label, name, value in rejectors:
        taken = "" if name not in case.accepted else f", {'accepted' if case.accepted[name] else 'rejected'}"
        lines.append(f"{label}: {value:.3g}{taken}")
    alias = "" if case.truth.alias_index is None else f", alias {case.truth.alias_index:.2f}"
    lines.append(f"unknown {case.truth.unknown_share:.2f}, changed {case.truth.changed_share:.2f}{alias}")
    diagnostics = {} if case.prediction is None else dict(case.prediction.diagnostics)
    lines += ["", "its diagnostics"] if diagnostics or rejectors else ["", "no diagnostics"]
    known = [(item.name, item.unit) for item in EVIDENCE if item.name in diagnostics]
    known += [(name, "") for name in sorted(diagnostics) if name not in {name for name, _ in known}]
    for name, unit in known:  # a long name would reach into the map next to it
        short = name if len(name) <= _MOST_LETTERS else f"{name[: _MOST_LETTERS - 3]}..."
        lines.append(f"{short}: {diagnostics[name]:.3g}{'' if unit in {'', '1'} else f' {unit}'}")
    rest = len(lines) - _MOST_LINES
    return lines if rest <= 0 else [*lines[: _MOST_LINES - 1], f"and {rest + 1} more"]


def _right_candidate(case: Case) -> str:
    """Return the position of the right candidate in the answer."""
    candidates, right = case.query.candidates, case.truth.candidate
    if not 0 <= right < len(candidates):
        return f"none of {len(candidates)}"
    place = candidates[right]
    poses = [] if case.prediction is None else [pose for pose, _ in case.prediction.candidates]
    at = [
        number
        for number, pose in enumerate(poses, start=1)
        if math.hypot(pose.easting_m - place.easting_m, pose.northing_m - place.northing_m) <= CANDIDATE_M
    ]
    return f"{at[0] if at else 'not'} in the list of {len(poses)}"


_NAMED: Final = 3


@dataclass(frozen=True, kw_only=True)
class RunCases:
    """A matcher's scored answers.

    `run` is the path as given, `root` holds tasks/, truth/ and regions/. `judged` are results of rejectors by matcher
    and rejector, its own confidence among them; `tasks` are by suite and region, `predictions` by query. Those of
    flights are in `flights`, by suite and region, and not among the others.
    """

    run: Path
    entry: Entry
    root: Path
    tasks: Mapping[tuple[str, str], Task]
    predictions: Mapping[str, Prediction]
    flights: Mapping[tuple[str, str], ScoredFlights]
    scores: pd.DataFrame = field(default_factory=lambda: pd.DataFrame(columns=list(COLUMNS)))
    judged: Mapping[tuple[str, str], pd.DataFrame] = field(default_factory=dict)

    def failures(self) -> pd.DataFrame:
        """Return every failure with its class (`cases.COLUMNS`), without those of a board's controls."""
        rejector = operating_rejector(self.judged, self.entry.name)
        judged = None if rejector is None else self.judged[self.entry.name, rejector]
        return find_cases(self.scores[~is_control(self.scores)].reset_index(drop=True), self.entry.name, judged)


def root_of(run: Path, out: Path) -> Path:
    """Return the folder of tasks, truths and regions of a run: next to its runs/, unless given."""
    above = (folder.parent for folder in run.resolve().parents if folder.name == "runs")
    return next((root for root in above if (root / "tasks").is_dir()), out)


def read_run_cases(run: Path, *, out: Path, split: Split | None, rejectors: Sequence[str] = ()) -> RunCases:
    """Score the answers of a run, in a folder with runs of one matcher.

    `out` is the root of tasks and truths of runs that lie elsewhere; `split` assigns the places that calibrate.
    `rejectors` are names, or module:Class; the matcher's own confidence is always among them. Report which
    runs are left out. Raise StoreError if no task of the run is there as it was asked, or a truth is missing. Raise
    ConfigError if the folder holds runs of several matchers.
    """
    entries = find_entries([run])
    if len(entries) > 1:
        names = ", ".join(f"{entry.version}: {entry.sources[0].parents[1]}" for entry in entries[:_NAMED])
        raise ConfigError(f"{run} holds runs of {len(entries)} matchers or versions: name the folder of one ({names})")
    (entry,), root = entries, root_of(run, out)
    predictions: dict[str, Prediction] = {}
    tasks: dict[tuple[str, str], Task] = {}
    lost: list[SasgeoError] = []
    flights: dict[tuple[str, str], ScoredFlights] = {}
    frames = []
    place_of = {} if split is None else split.place_of
    for source, manifest in zip(entry.sources, entry.runs, strict=True):
        name = (manifest.suite, manifest.region)
        try:
            task = Task.open(root.joinpath("tasks", *name), root)
            mine = _answers(source, manifest, task)
            task.check_truths()
            asked = (tuple(task.heads()), task.truths)
        except SasgeoError as error:
            lost.append(error)
            continue
        predictions |= mine
        if task.manifest.is_of_flights:
            flights[name] = score_flights(*asked, mine, place_of=place_of)
            continue
        frames.append(score_task(*asked, mine, place_of=place_of))
        tasks[name] = task
    if not (frames or flights):
        raise lost[0]
    if lost:
        tell(f"left out: {counted(len(lost), 'run')} of {len(entry.sources)}, as {lost[0]}")
    found = RunCases(run=run, entry=entry, root=root, tasks=tasks, predictions=predictions, flights=flights)
    if not frames:
        return found
    scores = settle_not_applicable(pd.concat(frames, ignore_index=True))
    return replace(found, scores=scores, judged=_judged(entry, scores, predictions, split, rejectors))


def _answers(source: Path, run: RunManifest, task: Task) -> dict[str, Prediction]:
    """Return the answers of a run to the queries as they are now."""
    is_same = run.queries_sha256 == task.manifest.queries_sha256
    found = Answers.open(source, task.asked, is_tied=is_same)
    if not (found.found or is_same):
        raise StoreError(
            f"{source} holds answers to other queries than {task.folder} does now: "
            "run again, or make the old ones again"
        )
    return found.found


def _judged(
    entry: Entry,
    scores: pd.DataFrame,
    predictions: Mapping[str, Prediction],
    split: Split | None,
    rejectors: Sequence[str],
) -> dict[tuple[str, str], pd.DataFrame]:
    """Return the results of the matcher's own confidence and of some rejectors, where they apply."""
    usable = scores[~is_control(scores)].reset_index(drop=True)
    is_taught = any(run.learned is not None for run in entry.runs)
    found = {OWN: own_confidence(usable, split, is_taught=is_taught)}
    for name, rule in rules_of(rejectors, split).items():
        found[name] = judge(usable, predictions, rule.make, rule.split, is_taught=is_taught)
    return {(entry.name, name): frame for name, frame in found.items() if len(frame)}


def picture_of(cases: RunCases, query: str) -> tuple[str, CasePicture]:
    """Return the id of a query, from the beginning of one, and the content of its picture.

    Raise ConfigError if no query, or more than one, begins so. Raise StoreError if the query was drawn anew since it
    was asked, or its map is missing or another one.
    """
    query_id = _find(cases, query)
    row = cases.scores[cases.scores["query_id"] == query_id].iloc[0]
    task = cases.tasks[row["suite"], row["region"]]
    (found,) = list(task.some({query_id}))
    failures = cases.failures().set_index("query_id")["failure"]
    words = {key: frame.set_index("query_id") for key, frame in cases.judged.items()}
    case = Case(
        matcher=cases.entry.name,
        failure=str(failures.get(query_id, "")),
        query=found[0],
        truth=next(truth for truth in task.truths if truth.query_id == query_id),
        prediction=cases.predictions.get(query_id),
        **words_of(words, cases.entry.name, query_id),
    )
    return query_id, read_picture(case, task)


def find_flight(cases: RunCases, query: str) -> str | None:
    """Return the one flight whose id begins so, or that a view belongs to; None without one.

    Raise ConfigError if there are several, or the query is empty.
    """
    flights = sorted(name for found in cases.flights.values() for name in found.flights["query_id"])
    found = _beginning(cases, flights, query) or [name for name in flights if query.startswith(name)]
    return found[0] if found else None


def _beginning(cases: RunCases, known: Sequence[str], query: str) -> list[str]:
    """Return the one id that begins so, in a list, or none; raise ConfigError if there are several."""
    if not query:
        raise ConfigError(f"--query is empty: name the beginning of an id, as 'inspect {cases.run}' lists some")
    found = [name for name in known if name.startswith(query)]
    if len(found) > 1:
        raise ConfigError(
            f"{len(found)} ids begin with {query!r} ({', '.join(found[:_NAMED])}, ...): name more of the id"
        )
    return found


def _find(cases: RunCases, query: str) -> str:
    """Return the one id that begins so."""
    known = sorted(cases.scores["query_id"])
    found = _beginning(cases, known, query)
    answered = {tie.query_id for source in cases.entry.sources for tie in read_ties(source)}
    is_old = found and found[0] in answered and found[0] not in cases.predictions
    if is_old or (not found and any(name.startswith(query) for name in answered)):
        raise StoreError(
            f"query {query!r} was drawn anew since {cases.run} answered it: run again, or make the old queries again"
        )
    if not found:
        near = difflib.get_close_matches(query, known, n=1)
        hint = f"did you mean {near[0]}?" if near else f"'inspect {cases.run}' lists some that went wrong"
        raise ConfigError(f"{cases.run} was asked no query {query!r}; {hint}")
    return str(found[0])
