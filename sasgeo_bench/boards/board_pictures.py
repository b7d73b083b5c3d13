# SPDX-License-Identifier: Apache-2.0
"""The pictures of a board: a map of each region, an example of each suite, and queries that went wrong."""

import re
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any, Final

import numpy as np
import pandas as pd

from sasgeo_bench.boards.board_files import ANSWER_SCHEMA, ANSWERS, PICTURES_FILE, AdditionalFiles
from sasgeo_bench.boards.cases import (
    COLUMNS,
    MOST_CASES,
    WEBP,
    case_pixels,
    find_cases,
    fitted,
    operating_rejector,
    pixels_of,
    sample_cases,
    words_of,
)
from sasgeo_bench.boards.flight_plots import MOST_TRACKERS, flight_map_pixels, shown_flight
from sasgeo_bench.boards.manifests import FailedCase, MapBlock, Picture, PictureStrip, RegionMap
from sasgeo_bench.boards.plots import ranked_matchers, shown_matchers
from sasgeo_bench.boards.run_cases import Case, facts_of, read_picture
from sasgeo_bench.boards.scored import Scored
from sasgeo_bench.boards.strip_plot import Strip, best_on_pictures, strip_pixels
from sasgeo_bench.core.errors import SasgeoError, StoreError, counted
from sasgeo_bench.core.progress import spread, tell
from sasgeo_bench.core.texts import json_text, one_line
from sasgeo_bench.regions import region_files
from sasgeo_bench.regions.layers import read_overview
from sasgeo_bench.regions.painting import paint_overview
from sasgeo_bench.regions.region import LICENCE, Manifest
from sasgeo_bench.running.failures import Failures, is_disk_error
from sasgeo_bench.running.prediction_files import StoredAnswers
from sasgeo_bench.scoring.base import Floats
from sasgeo_bench.scoring.contrasts import Contrast
from sasgeo_bench.scoring.pose import columns_of
from sasgeo_bench.scoring.score import single_views
from sasgeo_bench.tasks.query import CONTROLS, REAL, Truth, base_of
from sasgeo_bench.tasks.sheet import panels_of, sheet_figure
from sasgeo_bench.tasks.split import Split
from sasgeo_bench.tasks.task_files import Task, TaskManifest

REGION_BYTES: Final = 120_000
SUITE_BYTES: Final = 38_000
CASE_BYTES: Final = 31_000
MOST_BYTES: Final = 8_000_000  # of all pictures of a board
STRIP_BYTES: Final = 160_000
STRIP_ROWS: Final = 4
FLIGHT_BYTES: Final = 220_000
KINDS: Final = ("regions", "suites", "strips", "flights", "cases")
_SOMETIMES: Final = ("strips", "flights")  # kinds that are not named where there are none
_MAP_CELLS: Final = 1100  # along the longer side of a map: finer ones take more than they show
_SHEET_DPI: Final = 72
_EACH: Final = 4  # cases of one class and matcher
_PLAIN: Final = re.compile(r"[^A-Za-z0-9.@+]+")


@dataclass(kw_only=True)
class _Found:
    """Pictures so far, what `pictures.json` says of them, and why others are not among them."""

    files: dict[str, bytes] = field(default_factory=dict)
    listed: dict[str, list[Picture]] = field(default_factory=lambda: {kind: [] for kind in KINDS})
    lacking: Counter[str] = field(default_factory=Counter)
    failures: Failures

    def add(self, kind: str, name: str, draw: Callable[[], bytes], make: Callable[..., Picture]) -> None:
        """Draw one, and list what is made of its file, or note why not: a board is not lost for a picture."""
        try:
            data = draw()
        except SasgeoError as error:
            self.lacking[one_line(str(error))] += 1
            return
        except Exception as error:
            if is_disk_error(error):
                raise
            self.failures.note(f"picture {name}", error)
            return
        if sum(map(len, self.files.values())) + len(data) > MOST_BYTES:
            self.lacking[f"all pictures together take {MOST_BYTES / 1e6:g} MB at most"] += 1
            return
        file = _file_of(kind, name)
        self.files[file] = data
        self.listed[kind].append(make(file=file))


def _file_of(kind: str, name: str) -> str:
    return f"{kind}/{_PLAIN.sub('-', name).strip('-')}{WEBP}"


def pictures_extra(
    scored: Scored,
    *,
    root: Path,
    contrasts: Sequence[Contrast] = (),
    split: Split | None = None,
    has_cases: bool = True,
    jobs: int = 1,
) -> AdditionalFiles:
    """Draw pictures of a board, and list them in `pictures.json`; empty if there is none.

    `root` holds regions/, tasks/ and truth/; tasks that are missing there, or of other queries, have no picture. Report
    which pictures cannot be drawn, and how many there are. `contrasts` are the registered ones, `split` has the blocks
    of a map; `has_cases` adds failed queries, drawn by `jobs` processes, and `answers.parquet` with the place of every
    query.
    """
    found = _Found(failures=scored.failures)
    tasks = [about for about in scored.tasks if about.suite != CONTROLS]
    asked = {about.name: task for about in tasks if (task := _there(about, root)) is not None}
    if len(asked) < len(tasks):
        tell(f"pictures of {len(asked)} of {counted(len(tasks), 'task')}: {root / 'tasks'} lacks the views of the rest")
    _add_regions(found, list(asked), root, split)
    _add_suites(found, asked, scored)
    answers = {}
    if has_cases:
        failures = _failures(scored, contrasts)
        placed = answers_frame(scored, failures, ranked_matchers(scored.board.leaderboard))
        answers = {ANSWERS: placed} if len(placed) else {}
        _add_strips(found, scored, asked)
        _add_flights(found, scored, asked)
        shown = failures[failures["matcher"].isin(shown_matchers(scored.board.leaderboard, contrasts))]
        _add_cases(found, scored, shown, asked, jobs=jobs)
    for reason, count in found.lacking.items():
        tell(f"left out: {counted(count, 'picture')}, {reason}")
    listed = ", ".join(
        f"{len(rows)} of {kind}" for kind, rows in found.listed.items() if rows or kind not in _SOMETIMES
    )
    tell(f"pictures: {listed}, {sum(map(len, found.files.values())) / 1e6:.2f} MB")
    if not found.files:
        return AdditionalFiles(tables=answers)
    kinds = {kind: [item.model_dump(mode="json") for item in items] for kind, items in found.listed.items()}
    content = json_text({**kinds, "licence": LICENCE, "attribution": scored.board.about.credit})
    return AdditionalFiles(tables=answers, pictures={**found.files, PICTURES_FILE: content.encode()})


def _there(about: TaskManifest, root: Path) -> Task | None:
    """Return the task with these queries, to the byte, if it is there: stored results hold no views of their own."""
    try:
        task = Task.open(root / "tasks" / about.suite / about.region, root)
    except StoreError:
        return None
    return task if task.manifest.files == about.files else None


# --- regions and suites -----------------------------------------------------------------------------------------------


def _add_regions(found: _Found, asked: Sequence[tuple[str, str]], root: Path, split: Split | None) -> None:
    """Add each region once: itself, or the first of its maps if it is missing."""
    maps: dict[str, list[str]] = {}
    for _, region in asked:
        maps.setdefault(base_of(region), []).append(region)
    for base, variants in sorted(maps.items()):
        there = (name for name in (base, *sorted(variants)) if (root / "regions" / name).is_dir())
        folder = root / "regions" / next(there, base)
        try:
            manifest = region_files.read_manifest(folder)
        except SasgeoError as error:
            found.lacking[one_line(str(error))] += 1
            continue
        blocks = () if split is None else split.blocks_in(base)
        lies = partial(
            RegionMap,
            region=base,
            alt=f"Map of {base}: semantic classes in colours",
            bounds_m=list(manifest.bounds_m),
            blocks=[MapBlock(name=one.id, bounds_m=list(one.bounds_m)) for one in blocks],
        )
        found.add("regions", base, partial(_map, folder, manifest), lies)


def _map(folder: Path, manifest: Manifest) -> bytes:
    """Return a map that fills its picture."""
    colours = paint_overview(manifest, read_overview(folder / region_files.LAYERS, longest_cells=_MAP_CELLS))
    return fitted(np.ascontiguousarray(colours[..., ::-1]), REGION_BYTES)


def _add_suites(found: _Found, asked: Mapping[tuple[str, str], Task], scored: Scored) -> None:
    """Add for each suite a control and its strongest stress at one site."""
    drawn: dict[tuple[str, str], set[str]] = {}
    for frame in scored.scores.values():
        for suite, region, role in zip(frame["suite"], frame["region"], frame["role"], strict=True):
            drawn.setdefault((suite, region), set()).add(role)
    best: dict[str, tuple[int, str]] = {}
    for suite, region in asked:
        roles = drawn.get((suite, region), set())
        rank = -sum(weight for role, weight in (("stress", 2), ("control", 1)) if role in roles)
        best[suite] = min(best.get(suite, (1, "")), (rank, region))
    for suite, (_, region) in sorted(best.items()):
        alt = f"Example of {suite} on {region}: view, map at the true place, difference, twin or hardest decoy"
        found.add("suites", suite, partial(_example, asked[suite, region]), partial(Picture, suite=suite, alt=alt))


def _example(task: Task) -> bytes:
    shown = panels_of(task, choose=control_and_stress)
    title = f"{task.manifest.title}: {task.manifest.region}"
    sheet = sheet_figure(title, shown, dpi=_SHEET_DPI, credit=task.manifest.credit)
    return fitted(pixels_of(sheet), SUITE_BYTES)


def control_and_stress(truths: Sequence[Truth]) -> list[Truth]:
    """Return a control and the strongest stress of its site, or the strongest stress and another query.

    >>> control_and_stress([])
    []
    """
    order = sorted(truths, key=lambda item: (item.pair_id, item.kind, -item.strength, item.query_id))
    for one in (item for item in order if item.role == "control"):
        stressed = [item for item in order if item.pair_id == one.pair_id and item.role == "stress"]
        if stressed:
            return [one, max(stressed, key=lambda item: item.strength)]
    rank = {"stress": 0, "control": 1, "falsifier": 2}
    return sorted(order, key=lambda item: (rank[item.role], -item.strength))[:2]


# --- strips and cases -------------------------------------------------------------------------------------------------


def _add_strips(found: _Found, scored: Scored, asked: Mapping[tuple[str, str], Task]) -> None:
    """Add for each suite of pictures some queries of the matcher that finds most of them, from picture to pose.

    Flights are scored as wholes: they have their maps.
    """
    pictured = {name: task for name, task in asked.items() if task.manifest.frames and not task.manifest.is_of_flights}
    for suite in sorted({suite for suite, _ in pictured}):
        own = {name: task for name, task in pictured.items() if name[0] == suite}
        name = best_on_pictures(scored.scores, own)
        if name is None:
            continue
        strip = Strip.of(scored.scores[name], own, STRIP_ROWS)
        chosen = scored.scores[name].set_index("query_id").loc[list(strip.query_ids), ["suite", "region"]]
        drawn = {
            (row["query_id"], name): row | {"matcher": name, "failure": ""}
            for row in chosen.reset_index().to_dict("records")
        }
        cases = {case.query.query_id: case for case in _cases(drawn, scored, {}, asked, found)}
        alt = f"From the picture to the pose: {name} on {suite}. {strip.facts}"
        found.add(
            "strips",
            suite,
            partial(_strip, strip, cases, own, title=f"{name} on {suite}"),
            partial(PictureStrip, suite=suite, matcher=name, alt=alt),
        )


def _strip(strip: Strip, cases: Mapping[str, Case], tasks: Mapping[tuple[str, str], Task], *, title: str) -> bytes:
    own = [cases[query_id] for query_id in strip.query_ids if query_id in cases]
    named = [(case, tasks[case.query.suite, case.query.region]) for case in own]
    rows = [read_picture(case, task) for case, task in named if not is_kept_back(case, task)]
    if named and not rows:
        raise StoreError("for photographs of which no region file says that they may be passed on")
    return fitted(strip_pixels(strip, rows, title=title), STRIP_BYTES)


def _add_flights(found: _Found, scored: Scored, asked: Mapping[tuple[str, str], Task]) -> None:
    """Add for each suite of flights the flight on which trackers differ most, a map for each of them."""
    flown = [name for name, task in asked.items() if task.manifest.is_of_flights]
    names = [name for name in shown_matchers(scored.board.leaderboard, ()) if name in scored.views]
    for suite in sorted({suite for suite, _ in flown}):
        regions = [region for one, region in flown if one == suite]
        chosen = shown_flight({name: scored.scores[name] for name in names}, suite, regions)
        if chosen is None:
            continue
        region, flight = chosen
        shown = [name for name in names if (scored.views[name]["sequence_id"] == flight).any()][:MOST_TRACKERS]
        views = {name: scored.views[name] for name in shown}
        alt = f"A flight of {suite} on {region}, with the estimates of {', '.join(shown)}"
        found.add(
            "flights",
            suite,
            partial(_flight_map, asked[suite, region], flight, views),
            partial(Picture, suite=suite, alt=alt),
        )


def _flight_map(task: Task, flight: str, views: Mapping[str, pd.DataFrame]) -> bytes:
    return fitted(flight_map_pixels(task, flight, views), FLIGHT_BYTES)


def _add_cases(
    found: _Found, scored: Scored, failures: pd.DataFrame, asked: Mapping[tuple[str, str], Task], *, jobs: int
) -> None:
    failures = failures[[key in asked for key in zip(failures["suite"], failures["region"], strict=True)]]
    if not len(failures):
        return
    chosen = sample_cases(failures, each=_EACH, most=MOST_CASES)
    words = {key: frame.set_index("query_id") for key, frame in scored.judged.items() if key[0] in {*chosen["matcher"]}}
    drawn = {(row["query_id"], row["matcher"]): row for row in chosen.to_dict("records")}
    cases = list(_cases(drawn, scored, words, asked, found))
    draws = [partial(_drawn, case, asked[case.query.suite, case.query.region]) for case in cases]
    for case, outcome in zip(cases, spread(_outcome, draws, jobs=jobs), strict=True):
        row = drawn[case.query.query_id, case.matcher]
        facts = facts_of(case)
        off = f", {facts['error_m']:.0f} m off" if "error_m" in facts else ""
        alt = f"{case.failure}: view, true place and answer of {case.matcher} on {row['suite']}, {row['region']}{off}"
        found.add(
            "cases",
            f"{case.matcher}-{case.query.query_id}",
            partial(_picture, outcome),
            partial(FailedCase, **{name: row[name] for name in COLUMNS}, alt=alt, facts=facts),
        )
    order = {_file_of("cases", f"{matcher}-{query_id}"): at for at, (query_id, matcher) in enumerate(drawn)}
    found.listed["cases"].sort(key=lambda one: order[one.file])


def _failures(scored: Scored, contrasts: Sequence[Contrast]) -> pd.DataFrame:
    """Return every failure of the ranked matchers of a board, with its class."""
    frames = [pd.DataFrame(columns=list(COLUMNS))]
    for name in ranked_matchers(scored.board.leaderboard):
        with scored.failures.of(f"cases of {name}"):
            if name in scored.scores:
                rejector = operating_rejector(scored.judged, name, contrasts)
                judged = None if rejector is None else scored.judged[name, rejector]
                frames.append(find_cases(single_views(scored.scores[name]), name, judged))
    return pd.concat(frames, ignore_index=True)


def _outcome(draw: Callable[[], bytes]) -> bytes | Exception:
    """Return a picture, or why there is none: of several processes none ends the others by an error."""
    try:
        return draw()
    except Exception as error:  # noqa: BLE001 - raised where the picture is added
        return error


def _picture(outcome: bytes | Exception) -> bytes:
    if isinstance(outcome, Exception):
        raise outcome
    return outcome


def _drawn(case: Case, task: Task) -> bytes:
    shown = read_picture(case, task)
    if is_kept_back(case, task):
        shown = replace(shown, picture=None, segmented=None)
    return fitted(case_pixels(shown), CASE_BYTES)


def is_kept_back(case: Case, task: Task) -> bool:
    """Return whether a query shows a photograph that may not be passed on, as far as its region is known."""
    if case.truth.detector != REAL:
        return False
    # Edited maps have no imagery: a photograph of another town goes with that of the region itself.
    imagery = region_files.read_manifest(task.region.with_name(base_of(task.region.name))).imagery
    return imagery is None or not imagery.is_publishable


def _cases(
    drawn: Mapping[tuple[Any, Any], Mapping[Any, Any]],
    scored: Scored,
    words: Mapping[tuple[str, str], pd.DataFrame],
    tasks: Mapping[tuple[str, str], Task],
    found: _Found,
) -> Iterator[Case]:
    """Yield each chosen case with its view, task by task."""
    by_task: dict[tuple[str, str], list[Mapping[Any, Any]]] = {}
    for row in drawn.values():
        by_task.setdefault((row["suite"], row["region"]), []).append(row)
    for name, rows in sorted(by_task.items()):
        try:
            some = list(tasks[name].some({row["query_id"] for row in rows}))
        except SasgeoError as error:
            found.lacking[one_line(str(error))] += len(rows)
            continue
        views = {query.query_id: query for query, _, _ in some}
        for row in rows:
            query_id, matcher = row["query_id"], row["matcher"]
            yield Case(
                matcher=matcher,
                failure=row["failure"],
                query=views[query_id],
                truth=scored.truths[query_id],
                prediction=scored.predictions[matcher].get(query_id),
                **words_of(words, matcher, query_id),
            )


# --- where every answer lies ------------------------------------------------------------------------------------------


def answers_frame(scored: Scored, failures: pd.DataFrame, names: Sequence[str]) -> pd.DataFrame:
    """Return a row for each answer of some matchers to a single view, with the columns of `ANSWER_SCHEMA`.

    `failures` are all of these matchers, as of `cases.find_cases`; `failure` is empty where there is none. Falsifiers
    are left out: nothing is asked of them than another answer. `view_m` is the side of a view. True is where it was
    taken, also of absent places; poses that do not exist are NaN.
    """
    frames = [_answers_of(scored, name, failures) for name in names if name in scored.scores]
    some = [frame for frame in frames if len(frame)]
    return pd.concat(some, ignore_index=True) if some else ANSWER_SCHEMA.empty()


def _answers_of(scored: Scored, name: str, failures: pd.DataFrame) -> pd.DataFrame:
    scores = single_views(scored.scores[name])
    rows = scores[(scores["role"] != "falsifier").to_numpy(bool)]
    ids = rows["query_id"].tolist()
    mine = failures[(failures["matcher"] == name).to_numpy(bool)]
    classes = dict(zip(mine["query_id"], mine["failure"], strict=True))
    true = columns_of([scored.truths[query_id].pose for query_id in ids])
    columns = {
        "query_id": ids,
        "matcher": name,
        **{column: rows[column].to_numpy() for column in ("suite", "region", "kind", "role", "is_present", "status")},
        "failure": [classes.get(query_id, "") for query_id in ids],
        "view_m": (rows["view_cells"] * rows["cell_size_m"]).to_numpy(),
        **_numbers("true", true),
        **_numbers("fix", _fixes(scored.predictions[name], ids)),
    }
    return pd.DataFrame(columns)[list(ANSWER_SCHEMA.names)]


def _fixes(answers: StoredAnswers, ids: Sequence[str]) -> Floats:
    """Return the fixes of some queries as columns, shape (N, 4); NaN without one."""
    place = {query_id: at for at, query_id in enumerate(ids)}
    found = np.full((len(ids), 4), np.nan)
    for columns in answers.columns(ids):
        at = np.array([place.get(query_id, -1) for query_id in columns.query_id], dtype=np.int64)
        is_fix = (at >= 0) & (columns.fix >= 0)
        found[at[is_fix]] = columns.poses[columns.fix[is_fix]]
    return found


def _numbers(what: str, poses: Floats) -> dict[str, Floats]:
    """Return poses to a decimetre and a tenth of a degree: enough to draw, and small on disk."""
    names = ("easting_m", "northing_m", "yaw_deg")
    return {f"{what}_{name}": column.round(1) for name, column in zip(names, poses.T[:3], strict=True)}
