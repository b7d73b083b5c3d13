# SPDX-License-Identifier: Apache-2.0
"""Choose the numbers that the sources of systems leave open: on train places, by one rule for all, ours included.

    .venv/bin/python benchmarks/open_numbers.py --out out/open-numbers
    .venv/bin/python benchmarks/open_numbers.py --out out/open-numbers --matcher my-matcher
    .venv/bin/python benchmarks/open_numbers.py --table docs/results/open-numbers.csv

The first command draws views of a train place of each train country (split `trials`, suite `clean` with two and four
times the error of perception, a disc of 250 m), asks each system of ours about them with each of its settings, six at
most, and writes each answer, then `trials.csv`, into the folder; it resumes. The second does so for a matcher of yours,
which is a `Tunable`. What learns is asked about half of the places after learning from two places of the other half.

The rule: of the settings that are not in use the best one is that which finds most views within 25 m, of several that
whose median error is less, no answer counting as the radius of the search, of several of these the first. It takes the
place of the one in use if it finds more, and the 95 % interval of the difference, by resampling places, excludes zero.
The third command prints a table.
"""

import argparse
import csv
import hashlib
import json
import math
import re
import time
from collections.abc import Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from functools import lru_cache, partial
from importlib.metadata import entry_points
from itertools import chain, groupby, product
from pathlib import Path
from typing import Any, Final

import numpy as np
from sasgeo_baselines.tunable import Tunable

import sasgeo_bench as sgb
from sasgeo_bench.core.errors import MatchError, SasgeoError, StoreError, counted
from sasgeo_bench.core.texts import NAME, one_line
from sasgeo_bench.regions.region_files import read_region
from sasgeo_bench.sasgeo.variants import Sasgeo
from sasgeo_bench.scoring.intervals import ClusterDraws, Interval, mean_interval
from sasgeo_bench.search.plan import Plan
from sasgeo_bench.tasks.split import find_split_file, read_split_file

SPLIT = "trials"
ASKED = {"clean": ("perception", (2.0, 4.0))}  # by suite: kind and strengths of the views
# What bounds the time: half the usual radius, no more of a map than a view and its disc need, and one site a place. The
# second site is learned from alone.
PRIOR, AROUND_M = "r250-weak-s3", 650.0
SITES, SEED = 2, 90
LESSONS = 2  # places of the other half that are learned from
VIEW_M, RIGHT_M = 192.0, 25.0
HEAD: Final = ("system", "setting", "was_used", "views", "median_m", "view_s")  # of trials; a column a place follows
ANSWER: Final = ("system", "setting", "place", "error_m", "view_s")

Pairs = list[tuple[sgb.Query, sgb.Truth]]


class TunedSasgeo(Tunable, Sasgeo):
    """The scorer with the number of its search that the paper leaves open; the rest of it is learned."""

    open_numbers = {"cells": (12, 16, 24)}
    chosen = {"cells": Plan().cells}

    def __init__(self, **numbers: float) -> None:
        super().__init__(**numbers)
        Sasgeo.__init__(self, Plan(cells=int(self.numbers["cells"])))


@dataclass(frozen=True, slots=True, kw_only=True)
class Views:
    """Views by place, with their truths: those that are asked, and those of the same kinds that may be learned from."""

    out: Path
    asked: Mapping[str, Pairs]
    lessons: Mapping[str, Pairs]


@dataclass(frozen=True, slots=True, kw_only=True)
class Answer:
    """How far an answer to a view was off, and how many seconds of the processor it took."""

    system: str
    setting: str
    place: str
    error_m: float
    view_s: float


@dataclass(frozen=True, slots=True, kw_only=True)
class Trial:
    """A setting of a system: of how many views how many it found in each place, median error, seconds a view.

    `was_used` is whether the setting was in use when it was tried.
    """

    system: str
    setting: str
    was_used: bool
    views: int
    right_of: Mapping[str, int]
    median_m: float
    view_s: float

    @property
    def numbers(self) -> dict[str, float]:
        """Return the values of the open numbers."""
        return dict(json.loads(self.setting))

    @property
    def right(self) -> int:
        """Return how many views it found in all places together."""
        return sum(self.right_of.values())


@dataclass(frozen=True, slots=True, kw_only=True)
class Verdict:
    """The setting that was in use, the best of the others, and by how many points this finds more."""

    used: Trial
    other: Trial
    gain: Interval

    @property
    def chosen(self) -> Trial:
        """Return the setting that is taken: another one only where it surely finds more."""
        return self.other if self.gain.lo > 0 else self.used


def places() -> dict[str, str]:
    """Return the first region of each country of the split, with its half."""
    listed = read_split_file(find_split_file(SPLIT)).place
    firsts = {place.country or place.name: place for place in reversed(listed)}.values()
    return {place.region_ids[0]: str(place.half) for place in reversed(firsts)}


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


def drawn(out: Path, kinds: Mapping[str, tuple[str, tuple[float, ...]]] = ASKED) -> Views:
    """Draw the views of some suites; `kinds` are those that are asked, each with its strengths."""
    sgb.make_tasks(suite=list(kinds), regions=list(places()), split=SPLIT, n=SITES, seed=SEED, prior=PRIOR, out=out)
    asked: dict[str, Pairs] = {place: [] for place in places()}
    lessons: dict[str, Pairs] = {place: [] for place in places()}
    for place, (suite, (kind, strengths)) in product(places(), kinds.items()):
        truths = {truth.query_id: truth for truth in sgb.read_truths(out / "truth" / suite / place)}
        own = [
            (query, truths[query.query_id])
            for query in sgb.read_queries(out / "tasks" / suite / place)
            if query.track == "localization" and round(max(query.evidence.size_m)) == VIEW_M
        ]
        own = [(query, truth) for query, truth in own if truth.kind == kind]
        lessons[place] += own
        asked[place] += [pair for pair in own if pair[1].pose == own[0][1].pose and pair[1].strength in strengths]
    return Views(out=out, asked=asked, lessons=lessons)


def answers(views: Views, place: str, system: str, kind: type[Tunable], setting: str) -> list[Answer]:
    """Ask a system with one setting about the views of a place."""
    matcher: Any = kind(**json.loads(setting))
    poses = [truth.pose for _, truth in views.asked[place] if truth.pose is not None]
    region = _around(views.out / "regions" / place, tuple((pose.easting_m, pose.northing_m) for pose in poses))
    matcher.prepare(region, _learned(views, place, system, kind, setting))
    found = []
    for query, truth in views.asked[place]:
        start = time.process_time()
        poses = matcher.match(query, top_k=1).poses
        taken_s = round(time.process_time() - start, 3)
        error_m = round(_error_m(poses, query, truth), 2)
        found.append(Answer(system=system, setting=setting, place=place, error_m=error_m, view_s=taken_s))
    return found


def _learned(views: Views, place: str, system: str, kind: type[Tunable], setting: str) -> str | None:
    """Return what a system learns from the last places of the half that a place is not in; learned once, and stored."""
    matcher: Any = kind(**json.loads(setting))
    if not isinstance(matcher, sgb.Learner):
        return None
    half_of = places()
    of_setting = hashlib.sha256(setting.encode()).hexdigest()[:8]
    path = views.out / "learned" / f"{system}-{of_setting}-not-{half_of[place]}.txt"
    if not path.exists():
        others = [name for name in views.lessons if half_of[name] != half_of[place]][-LESSONS:]
        regions = {name: _read(views.out / "regions" / name) for name in others}
        pairs = list(chain(*(views.lessons[name] for name in others)))
        text = matcher.learn(sgb.Training(regions=regions, pairs=pairs))
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text, encoding="utf-8")
    return path.read_text(encoding="utf-8")


@lru_cache(maxsize=LESSONS)
def _read(folder: Path) -> sgb.Region:
    """Return a region, kept for the next setting: to read it takes longer than to answer."""
    return sgb.read_region(folder, with_layers=False)


@lru_cache(maxsize=1)
def _around(folder: Path, places_m: tuple[tuple[float, float], ...]) -> sgb.Region:
    """Return the part of a region around some places."""
    (west_m, south_m), (east_m, north_m) = np.min(places_m, axis=0) - AROUND_M, np.max(places_m, axis=0) + AROUND_M
    return read_region(folder, bounds_m=(west_m, south_m, east_m, north_m))


def _error_m(poses: Sequence[sgb.Pose], query: sgb.Query, truth: sgb.Truth) -> float:
    if not poses or truth.pose is None:
        return float(query.prior.radius_m or 0.0)
    return float(np.hypot(poses[0].easting_m - truth.pose.easting_m, poses[0].northing_m - truth.pose.northing_m))


def trials_of(found: Iterable[Answer], known: Mapping[str, type[Tunable]], wanted: Sequence[str]) -> list[Trial]:
    """Return the trials of the settings that have answered in all wanted places, in the order of `known`."""
    rows: dict[tuple[str, str], list[Answer]] = {}
    for one in found:
        rows.setdefault((one.system, one.setting), []).append(one)
    trials = [
        Trial(
            system=system,
            setting=setting,
            was_used=json.loads(setting) == dict(known[system].chosen),
            views=len(own),
            right_of={place: sum(one.error_m <= RIGHT_M for one in own if one.place == place) for place in wanted},
            median_m=round(float(np.median([one.error_m for one in own])), 1),
            view_s=round(sum(one.view_s for one in own) / len(own), 2),
        )
        for (system, setting), own in rows.items()
        if system in known and {one.place for one in own} == set(wanted)
    ]
    return sorted_trials(trials, known)


def best(trials: Iterable[Trial]) -> Trial:
    """Return the trial that finds most; of several the one with the least median error; of several the first."""
    return min(trials, key=lambda trial: (-trial.right, trial.median_m))


def verdict(trials: Sequence[Trial]) -> Verdict:
    """Judge the settings of one system, of which one was in use.

    >>> rights = {True: [1, 1, 0, 1, 0, 1], False: [2, 2, 1, 2, 1, 2]}
    >>> some = [Trial(system="a", setting=f'{{"x": {int(used)}}}', was_used=used, views=12, median_m=9.0, view_s=1.0,
    ...               right_of=dict(zip("uvwxyz", right, strict=True))) for used, right in rights.items()]
    >>> verdict(some).gain
    Interval(value=50.0, lo=50.0, hi=50.0)
    >>> verdict(some).chosen.numbers
    {'x': 0}
    """
    used = next(trial for trial in trials if trial.was_used)
    other = best(trial for trial in trials if trial is not used)
    here = list(used.right_of)
    more = np.array([other.right_of[place] - used.right_of[place] for place in here]) * len(here) / used.views * 100
    return Verdict(used=used, other=other, gain=mean_interval(more, ClusterDraws(blocks=here, seed=SEED)))


def read_trials(path: Path) -> list[Trial]:
    """Read trials, each once, in the order of systems and of their settings; raise `StoreError` if there are none."""
    try:
        with path.open(encoding="utf-8", newline="") as file:
            rows = {(row["system"], row["setting"]): row for row in csv.DictReader(file)}
        found = [
            Trial(
                system=row["system"],
                setting=row["setting"],
                was_used={"yes": True, "": False}[row["was_used"]],
                views=int(row["views"]),
                right_of={name: int(cell) for name, cell in row.items() if name not in HEAD},
                median_m=float(row["median_m"]),
                view_s=float(row["view_s"]),
            )
            for row in rows.values()
        ]
        is_whole = bool(found) and all(map(_is_sound, found)) and all(map(_is_judged, _by_system(found).values()))
    except (OSError, ValueError, KeyError, TypeError, AttributeError):
        is_whole = False
    if not is_whole:
        raise StoreError(f"{path} holds no trials, or is damaged: move it away, and run with --out")
    return sorted_trials(found)


def sorted_trials(trials: Iterable[Trial], known: Mapping[str, type[Tunable]] | None = None) -> list[Trial]:
    """Return trials in the order of systems and of the settings of `known` ones, ours unless given."""
    order = {
        (name, json.dumps(one)): at
        for name, kind in (known or systems()).items()
        for at, one in enumerate(kind.settings())
    }
    return sorted(trials, key=lambda trial: (trial.system, order.get((trial.system, trial.setting), len(order))))


def _by_system(trials: Sequence[Trial]) -> dict[str, list[Trial]]:
    """Return the trials of each system; those of one follow each other."""
    return {system: list(own) for system, own in groupby(trials, key=lambda trial: trial.system)}


def _is_sound(trial: Trial) -> bool:
    """Return whether a trial could have been written by this program."""
    numbers = trial.numbers.values()
    is_number = all(isinstance(value, int | float) and math.isfinite(value) for value in numbers)
    is_counted = min(trial.right_of.values(), default=-1) >= 0 and trial.right <= trial.views
    is_measured = math.isfinite(trial.median_m) and math.isfinite(trial.view_s)
    return bool(numbers) and is_number and is_counted and is_measured and re.fullmatch(NAME, trial.system) is not None


def _is_judged(trials: Sequence[Trial]) -> bool:
    """Return whether all settings of a system set the same numbers, and one of several was in use."""
    names = {tuple(sorted(trial.numbers)) for trial in trials}
    return len(names) == 1 and sum(trial.was_used for trial in trials) == 1 < len(trials)


def write_trials(path: Path, trials: Sequence[Trial]) -> None:
    """Write trials in place of what is there."""
    with path.open("w", encoding="utf-8", newline="") as file:
        table = csv.writer(file, lineterminator="\n")
        table.writerow([*HEAD, *trials[0].right_of])
        for one in trials:
            used = "yes" if one.was_used else ""
            table.writerow([one.system, one.setting, used, one.views, one.median_m, one.view_s, *one.right_of.values()])


def lines(trials: Sequence[Trial]) -> Iterator[str]:
    """Yield a table in Markdown: of each system how many views each setting found, and what the rule says."""
    yield "| System | Open numbers | Found, by setting | In use | Best other | More, points | Then | Seconds a view |"
    yield "|---|---|---|---|---|---|---|---:|"
    for system, own in _by_system(trials).items():
        judged = verdict(own)
        used, other, gain = judged.used, judged.other, judged.gain
        tried = {name: list(dict.fromkeys(trial.numbers[name] for trial in own)) for name in used.numbers}
        opened = "; ".join(f"`{name}` {', '.join(f'{one:g}' for one in each)}" for name, each in tried.items())
        found = ", ".join(f"**{trial.right}**" if trial is used else str(trial.right) for trial in own)
        yield (
            f"| `{system}` | {opened} | {found} of {used.views} | {_values(used)} | {_values(other)} | "
            f"{gain.value:+.1f} [{gain.lo:.1f}, {gain.hi:.1f}] | {'kept' if judged.chosen is used else 'changed'} | "
            f"{judged.chosen.view_s:.2f} |"
        )


def _values(trial: Trial) -> str:
    return ", ".join(f"{value:g}" for value in trial.numbers.values())


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


def read_answers(path: Path) -> list[Answer]:
    """Read the answers that are there; raise `StoreError` if a file is there that holds none."""
    if not path.exists():
        return []
    try:
        with path.open(encoding="utf-8", newline="") as file:
            return [
                Answer(**row | {"error_m": float(row["error_m"]), "view_s": float(row["view_s"])})
                for row in csv.DictReader(file)
            ]
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise StoreError(f"{path} holds no answers, or is damaged: move it away") from error


def try_all(out: Path, asked_now: dict[str, type[Tunable]], *, jobs: int) -> None:
    """Ask what is left, place by place, store each answer and the trials, and print the table.

    A system that fails costs its own trials alone.
    """
    there = read_answers(out / "answers.csv")  # a file that is none is told before anything is drawn
    views = drawn(out)
    found = ask_all(views, asked_now, there, jobs=jobs)
    known = systems() | asked_now
    trials = trials_of(found, known, list(views.asked))
    if trials:
        write_trials(out / "trials.csv", trials)
    whole = {name: own for name, own in _by_system(trials).items() if len(own) == len(known[name].settings())}
    print(*lines([trial for name, own in whole.items() if name in asked_now for trial in own]), sep="\n")


def ask_all(
    views: Views, asked_now: Mapping[str, type[Tunable]], there: Sequence[Answer], *, jobs: int
) -> list[Answer]:
    """Return the answers that are there with all others, which are stored as they come; say what gave none."""
    found = list(there)
    done = {(one.place, one.system, one.setting) for one in found}
    todo = [
        (place, name, kind, json.dumps(numbers))
        for place in views.asked
        for name, kind in asked_now.items()
        for numbers in kind.settings()
        if (place, name, json.dumps(numbers)) not in done
    ]
    print(f"{counted(len(done), 'setting at a place', 'settings at places')} there, {len(todo)} to ask", flush=True)
    path = views.out / "answers.csv"
    with ProcessPoolExecutor(jobs) as pool, path.open("a", encoding="utf-8", newline="") as file:
        table = csv.writer(file, lineterminator="\n")
        if not found:
            table.writerow(ANSWER)
        spread = pool.map if jobs > 1 else map
        for item in spread(partial(_asked_or_told, views), *zip(*todo, strict=True)) if todo else ():
            if isinstance(item, str):
                print(item)
                continue
            found.extend(item)
            table.writerows([getattr(one, name) for name in ANSWER] for one in item)
            file.flush()
    return found


def _asked_or_told(views: Views, place: str, system: str, kind: type[Tunable], setting: str) -> list[Answer] | str:
    """Return answers, or a line that says why there are none."""
    try:
        return answers(views, place, system, kind, setting)
    except Exception as error:  # noqa: BLE001 - whatever a contestant does
        return one_line(f"{system} {setting} at {place}: no answer ({type(error).__name__}: {error})")


if __name__ == "__main__":
    main()
