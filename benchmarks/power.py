# SPDX-License-Identifier: Apache-2.0
"""How likely an experiment decides each of its contrasts, or shows that it is equal: simulated from a pilot board.

    .venv/bin/sasgeo-bench leaderboard pilot.toml --out out      # the pipeline, with split = "trials"
    .venv/bin/python -m benchmarks.power out/boards/places --split world

Differences of the two sides of a contrast are those of the pilot's places. Each test place of the split takes those of
a pilot place by lot, with as many views, drawn with replacement: once all places of a country take them of one pilot
place ("alike", the worst), once each of its own ("apart"). Where some places of the pilot have no view, as many of the
test places have none. Then the rule of a board is applied: *shown* where intervals
by places and by countries leave out 0 and p over places, by a normal law, is at most 5 % over the number of contrasts
(the first step of Holm); *equal* where both intervals lie within the least difference that matters. "As in the pilot"
is how often the difference is shown if the pilot's is the true one; "if equal" how often equality is shown where none
is: the sides of each pilot place are swapped by lot, and where no view of the pilot differs, two are made to, one each
way. As on a board, intervals are never inside those that so many sites allow where fewer than six places differ, so
that one site a place shows no equality within 3 points. `--sites` asks for so many times the sites of the pilot. Chosen
contrasts are judged, not what comes out. The last columns are for the file of the pipeline: the share of the second
side, of queries that one side alone finds, and how alike the differences of a place are.
"""

import argparse
import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
import pandas as pd
from numpy.typing import NDArray
from scipy.stats import norm

from benchmarks.recompute_intervals import differences
from sasgeo_bench.core.errors import SasgeoError
from sasgeo_bench.regions.region_spec import list_region_files, read_region_file
from sasgeo_bench.scoring.compare import LEAST_PLACES
from sasgeo_bench.scoring.intervals import difference_interval, wilson_share
from sasgeo_bench.tasks.split import SplitFile, find_split_file, read_split_file

SEED, TRIALS, DRAWS, LEVEL = 1, 400, 400, 0.05
OF_MATCHERS: Final = ("primary", "interaction", "shift")
PLAIN: Final = ("clean",)  # suites that every place can carry
DATED: Final = "real-age"  # a suite that has places with maps of several dates alone
Floats = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Asked:
    """Differences of a place, shape (N,), and the number of its sites."""

    gaps: Floats
    sites: int


def ranked_places(split: SplitFile, suites: list[str]) -> dict[str, str]:
    """Return country by place, of the places that rank and have queries of some suites."""
    files = list_region_files()
    dated = {name for name, path in files.items() if len(read_region_file(path).extract) > 1}
    return {
        place.name: place.country or place.name
        for place in split.place
        if place.part in (None, "test") and (DATED not in suites or dated.intersection(place.region_ids))
    }


def simulated(
    pilot: list[Asked], country_of: list[str], rng: np.random.Generator, *, times: int, alike: bool
) -> list[Asked]:
    """Return differences of each place: those of a pilot place, drawn with replacement, of so many times its sites."""
    own = rng.integers(len(pilot), size=len(country_of))
    if alike:
        _, number = np.unique(country_of, return_inverse=True)
        own = rng.integers(len(pilot), size=number.max() + 1)[number]
    return [Asked(rng.choice(pilot[at].gaps, times * len(pilot[at].gaps)), times * pilot[at].sites) for at in own]


def swapped(pilot: list[Asked], rng: np.random.Generator) -> list[Asked]:
    """Return a pilot of equal sides: those of each place are swapped by lot; two views differ if none does."""
    if not any(one.gaps.any() for one in pilot):
        first, second = rng.choice(len(pilot), 2, replace=False)
        pilot = [
            Asked(np.where(np.arange(len(one.gaps)) == 0, float(at == first) - float(at == second), 0.0), one.sites)
            for at, one in enumerate(pilot)
        ]
    return [
        Asked(side * one.gaps, one.sites) for side, one in zip(rng.choice([-1.0, 1.0], len(pilot)), pilot, strict=True)
    ]


def ends(asked: list[Asked], cluster: list[str], rng: np.random.Generator) -> tuple[float, float]:
    """Return the ends of the 95 % interval of the mean by clusters."""
    _, number = np.unique(cluster, return_inverse=True)
    sums = np.bincount(number, [one.gaps.sum() for one in asked])
    sizes = np.bincount(number, [len(one.gaps) for one in asked])
    drawn = rng.multinomial(len(sums), np.full(len(sums), 1 / len(sums)), size=DRAWS)
    low, high = np.quantile((drawn @ sums) / np.maximum(drawn @ sizes, 1), [0.025, 0.975])
    return float(low), float(high)


def least_ends(asked: list[Asked]) -> tuple[float, float]:
    """Return the ends that so many sites allow, of queries won and lost, where few places differ; else none."""
    gaps = np.concatenate([one.gaps for one in asked])
    if sum(bool(one.gaps.any()) for one in asked) >= LEAST_PLACES:
        return np.inf, -np.inf
    sites = sum(one.sites for one in asked)
    sides = (float(np.maximum(gaps, 0.0).mean()), float(np.maximum(-gaps, 0.0).mean()))
    found = difference_interval(*(wilson_share(side, sites) for side in sides))
    return found.lo, found.hi


def outcome(asked: list[Asked], countries: list[str], least: float, critical: float, rng: np.random.Generator) -> str:
    """Return "shown", "equal" or "open"."""
    both = [ends(asked, by, rng) for by in (list(map(str, range(len(asked)))), countries)] + [least_ends(asked)]
    low, high = min(one[0] for one in both), max(one[1] for one in both)
    sums = np.array([one.gaps.sum() for one in asked])
    is_sure = abs(sums.sum()) > critical * np.sqrt((sums**2).sum())
    if is_sure and (low > 0 or high < 0):
        return "shown"
    return "equal" if -least < low and high < least else "open"


def likeness(gaps: list[Floats]) -> float:
    """Return how much more alike differences of one place are than those of two: the intraclass correlation."""
    every = np.concatenate(gaps)
    size = len(every) / len(gaps)
    within = sum(((gap - gap.mean()) ** 2).sum() for gap in gaps) / max(len(every) - len(gaps), 1)
    between = sum(len(gap) * (gap.mean() - every.mean()) ** 2 for gap in gaps) / max(len(gaps) - 1, 1)
    return float(max(0.0, (between - within) / max(between + (size - 1) * within, 1e-12)))


def line(contrast: dict[str, Any], scores: pd.DataFrame, split: SplitFile, critical: float, times: int = 1) -> str:
    """Return the row of a contrast, of so many times the sites of the pilot."""
    gaps = differences(scores, contrast)
    pilot = [
        Asked(own["gap"].to_numpy(float), own["pair_id"].nunique()) for _, own in gaps.groupby("place", observed=True)
    ]
    every_country = list(ranked_places(split, contrast["suites"]).values())
    share = len(pilot) / max(len(pilot), scores.loc[scores["suite"].isin(PLAIN), "place"].nunique())
    count = round((1.0 if DATED in contrast["suites"] else share) * len(every_country))
    name, least = contrast["name"], float(contrast["min_effect"])
    if len(pilot) < 2:  # nothing is known of how places differ
        return f"| {name} | {len(gaps)}, {len(pilot)} | - | | | | | | |"
    rng = np.random.default_rng(SEED)
    shares = []
    for wanted in ("shown", "equal"):
        for alike in (True, False):
            found = 0
            for _ in range(TRIALS):
                country_of = [every_country[at] for at in np.sort(rng.permutation(len(every_country))[:count])]
                of_pilot = pilot if wanted == "shown" else swapped(pilot, rng)
                some = simulated(of_pilot, country_of, rng, times=times, alike=alike)
                found += outcome(some, country_of, least, critical, rng) == wanted
            shares.append(f"{found / TRIALS:.2f}")
    of_places = [one.gaps for one in pilot]
    every = np.concatenate(of_places)
    second = gaps[contrast["second"]].mean()
    views = round(times * len(every) / len(pilot) * count)
    return (
        f"| {name} | {len(every)}, {len(pilot)} | {100 * every.mean():+.1f} | {views}, {count} "
        f"({len(set(country_of))}) | {shares[0]}, {shares[1]} | {shares[2]}, {shares[3]} | {second:.2f} | "
        f"{(every != 0).mean():.2f} | {likeness(of_places):.2f} |"
    )


def main() -> None:
    """Print a row for each contrast of matchers."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("board", type=Path, help="folder of the pilot's board")
    parser.add_argument("--split", default="world", help="split whose test places the experiment asks")
    parser.add_argument("--sites", type=int, default=1, help="how many times the sites of the pilot are asked")
    asked = parser.parse_args()
    if asked.sites < 1:
        parser.error(f"--sites must be at least 1, got {asked.sites}")
    contrasts = json.loads((asked.board / "board.json").read_text(encoding="utf-8"))["contrasts"]
    scores = pd.read_parquet(asked.board / "scores.parquet")
    try:
        split = read_split_file(find_split_file(asked.split))
    except SasgeoError as error:
        parser.error(str(error))
    critical = float(norm.isf(LEVEL / len(contrasts) / 2))
    print(
        "| contrast | pilot: views, places | gain, points | test: views, places (countries) | shown as in the pilot, "
        "alike, apart | equal if equal, alike, apart | second | discordant | correlation |"
    )
    print("|---|---|---:|---|---|---|---:|---:|---:|")
    for contrast in contrasts:
        if contrast["metric"] in OF_MATCHERS:
            print(line(contrast, scores, split, critical, asked.sites), flush=True)


if __name__ == "__main__":
    main()
