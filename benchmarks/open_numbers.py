# SPDX-License-Identifier: Apache-2.0
"""Choose the numbers that the sources of systems leave open: on train places, by one rule for all, ours included.

    .venv/bin/python benchmarks/open_numbers.py --out out/open-numbers --jobs 2
    .venv/bin/python benchmarks/open_numbers.py --out out/open-numbers --matcher my-matcher
    .venv/bin/python benchmarks/open_numbers.py --table docs/results/open-numbers.csv

The first command draws views of four towns that are on no board of systems (suite `clean` with errors of perception,
and `local-warp` with tilt), asks each system of ours about them with each of its settings, six at most, and writes
`trials.csv` into the folder; it resumes. The second does so for a matcher of yours, which is a `Tunable`. What learns
is asked about two towns after learning from the views of the other two. The setting that finds most views within 25 m
is chosen; of several the one whose median error is less, no answer counting as the radius of the search; of several of
these the first. The third command prints a table.
"""

import argparse
import csv
import json
import math
import re
import time
from collections.abc import Iterable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict, dataclass
from functools import partial
from importlib.metadata import entry_points
from itertools import chain, groupby
from pathlib import Path
from typing import Any

import numpy as np
from sasgeo_baselines.tunable import Tunable

import sasgeo_bench as sgb
from sasgeo_bench.core.errors import MatchError, SasgeoError, StoreError, counted
from sasgeo_bench.core.texts import NAME, one_line
from sasgeo_bench.sasgeo.variants import Sasgeo
from sasgeo_bench.search.plan import Plan

HALVES = (("krems", "porto"), ("london", "vaduz"))  # towns on which systems were tried while they were built
SUITES = {"clean": ("perception",), "local-warp": ("G1 tilt",)}
SITES, SEED = 2, 90
VIEW_M, RIGHT_M = 192.0, 25.0

Asked = dict[str, list[tuple[sgb.Query, sgb.Truth]]]  # by place


class TunedSasgeo(Tunable, Sasgeo):
    """The scorer with the number of its search that the paper leaves open; the rest of it is learned."""

    open_numbers = {"cells": (12, 16, 24)}
    chosen = {"cells": Plan().cells}

    def __init__(self, **numbers: float) -> None:
        super().__init__(**numbers)
        Sasgeo.__init__(self, Plan(cells=int(self.numbers["cells"])))


@dataclass(frozen=True, slots=True, kw_only=True)
class Trial:
    """A setting of a system, how many views it was asked and found, and its median error and seconds a view."""

    system: str
    setting: str
    views: int
    right: int
    median_m: float
    view_s: float

    @property
    def numbers(self) -> dict[str, float]:
        """Return the values of the open numbers."""
        return dict(json.loads(self.setting))


def systems(names: Sequence[str] = ()) -> dict[str, type[Tunable]]:
    """Return the systems of some names by name, all of ours without any; `MatchError` where one has no open numbers."""
    found: dict[str, type[Tunable]] = {"sasgeo": TunedSasgeo}
    for point in entry_points(group="sasgeo_bench.matchers"):
        is_ours = point.value.startswith("sasgeo_baselines.") and not point.value.startswith("sasgeo_baselines.image.")
        if point.name not in found and (point.name in names or (is_ours and not names)):
            kind = point.load()
            if isinstance(kind, type) and issubclass(kind, Tunable) and kind.open_numbers:
                found[point.name] = kind
    stray = next((name for name in names if name not in found), None)
    if stray is not None:
        raise MatchError(
            f"{stray} is no installed matcher with open numbers: its class must be a Tunable that names some"
        )
    return dict(sorted((name, kind) for name, kind in found.items() if name in names or not names))


def drawn(out: Path) -> Asked:
    """Draw the views, and return them by place with their truths."""
    sgb.make_tasks(suite=list(SUITES), regions=list(chain(*HALVES)), n=SITES, seed=SEED, out=out)
    found: Asked = {}
    for place in chain(*HALVES):
        for suite, kinds in SUITES.items():
            truths = {truth.query_id: truth for truth in sgb.read_truths(out / "truth" / suite / place)}
            for query in sgb.read_queries(out / "tasks" / suite / place):
                truth = truths[query.query_id]
                is_asked = query.track == "localization" and truth.kind in kinds and truth.role == "stress"
                if is_asked and round(max(query.evidence.size_m)) == VIEW_M:
                    found.setdefault(place, []).append((query, truth))
    return found


def tried(out: Path, asked: Asked, kind: type[Tunable], system: str, numbers: dict[str, float]) -> Trial:
    """Ask a system with one setting about all views."""
    regions = {name: sgb.read_region(out / "regions" / name, with_layers=False) for name in asked}
    errors_m, seconds = [], 0.0
    for half, other in (HALVES, HALVES[::-1]):
        matcher: Any = kind(**numbers)
        is_learner = isinstance(matcher, sgb.Learner)
        pairs = list(chain(*(asked[place] for place in other)))
        learned = matcher.learn(sgb.Training(regions=regions, pairs=pairs)) if is_learner else None
        for place in half:
            matcher = kind(**numbers)
            matcher.prepare(regions[place], learned)
            for query, truth in asked[place]:
                start = time.process_time()
                poses = matcher.match(query, top_k=1).poses
                seconds += time.process_time() - start
                errors_m.append(_error_m(poses, query, truth))
    return Trial(
        system=system,
        setting=json.dumps(numbers),
        views=len(errors_m),
        right=int((np.array(errors_m) <= RIGHT_M).sum()),
        median_m=round(float(np.median(errors_m)), 1),
        view_s=round(seconds / len(errors_m), 2),
    )


def _error_m(poses: Sequence[sgb.Pose], query: sgb.Query, truth: sgb.Truth) -> float:
    if not poses or truth.pose is None:
        return float(query.prior.radius_m or 0.0)
    return float(np.hypot(poses[0].easting_m - truth.pose.easting_m, poses[0].northing_m - truth.pose.northing_m))


def best(trials: Sequence[Trial]) -> Trial:
    """Return the trial whose setting is chosen.

    >>> some = [Trial(system="a", setting=str(at), views=9, right=right, median_m=error_m, view_s=1.0)
    ...         for at, (right, error_m) in enumerate([(5, 30.0), (6, 9.0), (6, 8.0), (6, 8.0)])]
    >>> best(some).setting
    '2'
    """
    return min(trials, key=lambda trial: (-trial.right, trial.median_m))


def read_trials(path: Path) -> list[Trial]:
    """Read trials, each once, in the order of systems and of their settings; raise `StoreError` if there are none."""
    try:
        with path.open(encoding="utf-8", newline="") as file:
            rows = {(row["system"], row["setting"]): row for row in csv.DictReader(file)}
        found = [
            Trial(
                system=row["system"],
                setting=row["setting"],
                views=int(row["views"]),
                right=int(row["right"]),
                median_m=float(row["median_m"]),
                view_s=float(row["view_s"]),
            )
            for row in rows.values()
        ]
        is_whole = bool(found) and all(map(_is_sound, found)) and _have_same_names(found)
    except (OSError, ValueError, KeyError, TypeError, AttributeError):
        is_whole = False
    if not is_whole:
        raise StoreError(f"{path} holds no trials, or is damaged: move it away, and run with --out")
    return sorted_trials(found)


def sorted_trials(trials: Iterable[Trial], known: dict[str, type[Tunable]] | None = None) -> list[Trial]:
    """Return trials in the order of systems and of the settings of `known` ones, ours unless given."""
    order = {
        (name, json.dumps(one)): at
        for name, kind in (known or systems()).items()
        for at, one in enumerate(kind.settings())
    }
    return sorted(trials, key=lambda trial: (trial.system, order.get((trial.system, trial.setting), len(order))))


def _is_sound(trial: Trial) -> bool:
    """Return whether a trial could have been written by this program."""
    numbers = trial.numbers.values()
    is_number = all(isinstance(value, int | float) and math.isfinite(value) for value in numbers)
    is_counted = 0 <= trial.right <= trial.views and math.isfinite(trial.median_m) and math.isfinite(trial.view_s)
    return bool(numbers) and is_number and is_counted and re.fullmatch(NAME, trial.system) is not None


def _have_same_names(trials: Sequence[Trial]) -> bool:
    """Return whether all settings of each system set the same numbers."""
    names = {(trial.system, tuple(sorted(trial.numbers))) for trial in trials}
    return len(names) == len({system for system, _ in names})


def write_trials(path: Path, trials: Sequence[Trial]) -> None:
    """Write trials in place of what is there."""
    with path.open("w", encoding="utf-8", newline="") as file:
        table = csv.DictWriter(file, fieldnames=list(Trial.__dataclass_fields__), lineterminator="\n")
        table.writeheader()
        table.writerows(asdict(trial) for trial in trials)


def lines(trials: Sequence[Trial]) -> Iterator[str]:
    """Yield a table in Markdown: of each system the numbers, how many views each setting found, and the chosen one."""
    yield "| System | Open numbers | Found, by setting | Chosen | Seconds a view |"
    yield "|---|---|---|---|---:|"
    for system, some in groupby(trials, key=lambda trial: trial.system):
        own = list(some)
        chosen = best(own)
        tried_values = {name: list(dict.fromkeys(trial.numbers[name] for trial in own)) for name in chosen.numbers}
        opened = "; ".join(f"`{name}` {', '.join(f'{one:g}' for one in each)}" for name, each in tried_values.items())
        found = ", ".join(f"**{trial.right}**" if trial is chosen else str(trial.right) for trial in own)
        values = ", ".join(f"{value:g}" for value in chosen.numbers.values())
        yield f"| `{system}` | {opened} | {found} of {chosen.views} | {values} | {chosen.view_s:.2f} |"


def main() -> None:
    """Draw, ask and store; or print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("out/open-numbers"), help="folder of maps, views and trials")
    parser.add_argument("--jobs", type=int, default=1, help="processes")
    parser.add_argument("--matcher", action="append", default=[], help="name of a system; may be repeated")
    parser.add_argument("--table", type=Path, help="print the table of stored trials, and stop")
    options = parser.parse_args()
    if options.jobs < 1:
        parser.error(f"--jobs is {options.jobs}, expected 1 at least")
    try:
        if options.table is not None:
            print(*lines(read_trials(options.table)), sep="\n")
        else:
            try_all(options.out, systems(options.matcher), jobs=options.jobs)
    except SasgeoError as error:
        parser.error(str(error))


def try_all(out: Path, asked_now: dict[str, type[Tunable]], *, jobs: int) -> None:
    """Ask what is left, store each trial, and print the table; a system that fails costs its own trials alone."""
    path = out / "trials.csv"
    there = read_trials(path) if path.exists() else []  # a file that is none is told before anything is drawn
    known = {(name, json.dumps(numbers)) for name, kind in asked_now.items() for numbers in kind.settings()}
    trials = [trial for trial in there if trial.system not in asked_now or (trial.system, trial.setting) in known]
    if len(trials) < len(there):
        print(f"{counted(len(there) - len(trials), 'stored trial')} left out: of numbers that are open no more")
    asked = drawn(out)
    done = {(trial.system, trial.setting) for trial in trials}
    todo = [
        (kind, name, numbers)
        for name, kind in asked_now.items()
        for numbers in kind.settings()
        if (name, json.dumps(numbers)) not in done
    ]
    with ProcessPoolExecutor(jobs) as pool:
        for trial in pool.map(partial(_tried_or_told, out, asked), *zip(*todo, strict=True)) if todo else ():
            if isinstance(trial, str):
                print(trial)
                continue
            trials.append(trial)
            write_trials(path, trials)
            print(f"{trial.system} {trial.setting}: {trial.right} of {trial.views}, {trial.view_s:.2f} s a view")
    left = {name for name, _ in known - {(trial.system, trial.setting) for trial in trials}}
    whole = (trial for trial in trials if trial.system in asked_now and trial.system not in left)
    print(*lines(sorted_trials(whole, asked_now)), sep="\n")


def _tried_or_told(out: Path, asked: Asked, kind: type[Tunable], system: str, numbers: dict[str, float]) -> Trial | str:
    """Return a trial, or a line that says why there is none."""
    try:
        return tried(out, asked, kind, system, numbers)
    except Exception as error:  # noqa: BLE001 - whatever a contestant does
        return one_line(f"{system} {json.dumps(numbers)}: no trial ({type(error).__name__}: {error})")


if __name__ == "__main__":
    main()
