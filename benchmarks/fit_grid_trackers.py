# SPDX-License-Identifier: Apache-2.0
"""Fit what filters on a grid ship, of the baselines and of the scorer, on made-up towns that are in no split.

    python benchmarks/fit_grid_trackers.py --out out/grid-trackers [--tracker grid_markov --tracker sasgeo_track ...]

draws four towns from a seed that no region of ours has, with maps of 2014, 2019 and 2025, and flies over them with poor
odometry (suite `flight-clean`) and over older maps (`flight-real-age`). It prints the ratio of densities that
`lsvl_belief` ships, and for each temper and doubt of a filter the share of views within 25 m, the share that is
accepted, and the mean logarithm of the belief within 25 m of the truth, at least one in a million: the higher, the
better; and the median of the squared error of accepted places over their covariance, per axis: 0.69 is honest. The
filters say at their constants which of these they took. `sasgeo_track` first learns from single views of
the same towns (suites `clean` and `real-age`); its temper is the weight of a view of new ground, its doubt the
probability that a view fits no place.
"""

import argparse
import math
from collections import defaultdict
from collections.abc import Iterator
from itertools import product
from pathlib import Path

import numpy as np
from sasgeo_baselines.trackers.grid_filter import GridFilter
from sasgeo_baselines.trackers.grid_markov import GridMarkov
from sasgeo_baselines.trackers.lsvl_belief import LsvlBelief, Ratio, distances

import sasgeo_bench as sgb
from sasgeo_bench.sasgeo.trackers import SasgeoTrack

MORPHOLOGIES = ("grid", "old_town", "riverside", "suburb")
DATES = ("2014-01-01", "2019-01-01", "2025-01-01")
SEED, SIZE_M, TASK_SEED = 51, 2048, 77
FLOWN = (("flight-clean", ("",), ("F1 wheel-poor",)), ("flight-real-age", ("@2014-01-01", "@2019-01-01"), ("F2",)))
TAUGHT_ON = (("flight-clean", ("",), ("no drift", "no drift again")), FLOWN[1])
VIEWS = 60  # of each flight
NEAR_M, LEAST_MASS = 25.0, 1e-6
TEMPERS = {
    "grid_markov": (0.006, 0.012, 0.024, 0.048),
    "lsvl_belief": (0.5, 1.0, 2.0, 4.0),
    "sasgeo_track": (0.125, 0.25, 0.5, 1.0),
}
LEARNED_FROM = ("clean", "real-age")  # single views, for sasgeo_track
SITES = 6
DOUBTS = (1e-3, 1e-2, 1e-1)

REGION = """\
id = "{name}"
title = "Town to fit grid filters on"
scenes = ["urban"]
center_lonlat = [{lon}, 49.0]
size_m = [{size_m}, {size_m}]
cell_size_m = 1.0
"""
EXTRACT = """
[[extract]]
file = "{name}-{date}.osm.pbf"
date = {date}
town = {{ morphology = "{morphology}", seed = {seed}, size_m = 2816.0 }}
"""
SPLIT = """\
id = "fit-grid-trackers"
title = "Towns to fit grid filters on"
kind = "crossfit"
buffer_m = 1000.0
block_m = 1000.0
reach_m = 360.0
"""
PLACE = '\n[[place]]\nname = "{name}"\nhalf = "{half}"\nregions = ["{name}"]\n'

Flight = list[tuple[sgb.Query, sgb.Truth]]
Flown = tuple[str, tuple[str, ...], tuple[str, ...]]  # suite, dates of the map, kinds


def draw_towns(out: Path) -> tuple[str, ...]:
    """Draw flights over the towns, and return the names of these."""
    towns = {f"train-{morphology.replace('_', '-')}": morphology for morphology in MORPHOLOGIES}
    folder, split = out / "region-files", out / "fit-grid-trackers.toml"
    folder.mkdir(parents=True, exist_ok=True)
    for number, (name, morphology) in enumerate(towns.items()):
        extracts = [EXTRACT.format(name=name, date=date, morphology=morphology, seed=SEED) for date in DATES]
        text = REGION.format(name=name, lon=11.0 + number / 2, size_m=SIZE_M) + "".join(extracts)
        (folder / f"{name}.toml").write_text(text, encoding="utf-8")
    places = [PLACE.format(name=name, half="ab"[number // 2]) for number, name in enumerate(towns)]
    split.write_text("".join([SPLIT, *places]), encoding="utf-8")
    sgb.make_tasks(
        suite=[suite for suite, _, _ in FLOWN],
        regions=list(towns),
        split=str(split),
        n=1,
        seed=TASK_SEED,
        region_files=[folder],
        out=out,
        up_to=True,
    )
    return tuple(towns)


def read_flights(out: Path, towns: tuple[str, ...], wanted: tuple[Flown, ...]) -> Iterator[Flight]:
    """Yield the flights of some kinds, in the order of their maps."""
    for town, (suite, dates, kinds) in product(towns, wanted):
        for date in dates:
            folder = Path(suite) / f"{town}{date}"
            flights: dict[str, Flight] = defaultdict(list)
            pairs = zip(sgb.read_queries(out / "tasks" / folder), sgb.read_truths(out / "truth" / folder), strict=True)
            for query, truth in pairs:
                if truth.kind in kinds and query.step is not None and query.step.frame < VIEWS:
                    flights[query.step.sequence_id].append((query, truth))
            yield from flights.values()


def learned(out: Path, towns: tuple[str, ...]) -> str:
    """Draw single views of the towns, and return what `sasgeo_track` learns from them."""
    sgb.make_tasks(
        suite=list(LEARNED_FROM),
        regions=list(towns),
        split=str(out / "fit-grid-trackers.toml"),
        n=SITES,
        seed=TASK_SEED,
        region_files=[out / "region-files"],
        out=out,
        up_to=True,
    )
    folders = [
        folder for suite in LEARNED_FROM for folder in sorted((out / "tasks" / suite).glob("*")) if folder.is_dir()
    ]
    pairs = [
        pair
        for folder in folders
        for pair in zip(
            sgb.read_queries(folder), sgb.read_truths(out / "truth" / folder.parent.name / folder.name), strict=True
        )
    ]
    regions = {name: sgb.read_region(out / "regions" / name) for name in dict.fromkeys(one.region for one, _ in pairs)}
    return SasgeoTrack().learn(sgb.Training(regions=regions, pairs=pairs))


def score(tracker: GridFilter | SasgeoTrack, flight: Flight) -> Iterator[tuple[bool, bool, float, float]]:
    """Yield of each view: within 25 m, accepted, log of the belief so near, and squared error over the covariance's."""
    tracker.start(flight[0][0].prior)
    for query, truth in flight:
        fix = tracker.step(query)
        if fix.pose is not None and truth.pose is not None:
            here_m = (truth.pose.easting_m, truth.pose.northing_m)
            away_m = math.dist((fix.pose.easting_m, fix.pose.northing_m), here_m)
            near = np.hypot(*(tracker.belief.places_m - here_m).T) <= NEAR_M
            mass = float(tracker.belief.mass.sum(axis=0).reshape(-1)[near].sum())
            gap_m = np.subtract((fix.pose.easting_m, fix.pose.northing_m), here_m)
            honest = float(gap_m @ np.linalg.solve(np.asarray(fix.covariance)[:2, :2], gap_m)) / 2
            yield away_m <= NEAR_M, fix.is_accepted, math.log(max(mass, LEAST_MASS)), honest


def try_settings(
    kind: type[GridFilter] | type[SasgeoTrack], out: Path, towns: tuple[str, ...], taught: str | None
) -> None:
    """Print the scores of a filter with each temper and doubt."""
    flights = list(read_flights(out, towns, FLOWN))
    trackers = {}
    for name in dict.fromkeys(flight[0][0].region for flight in flights):
        trackers[name] = kind()
        trackers[name].prepare(sgb.read_region(out / "regions" / name), taught)
    print(f"\n{kind.card.name}: {len(flights)} flights")
    print("temper, doubt: within 25 m, accepted, log of the belief near, NEES")
    for temper, doubt in product(TEMPERS[kind.card.name], DOUBTS):
        rows = []
        for flight in flights:
            tracker = trackers[flight[0][0].region]
            vars(tracker).update(exponent_scale=temper, outlier_probability=doubt)
            rows += list(score(tracker, flight))
        near, accepted, log, _ = np.mean(rows, axis=0)
        nees = np.median([row[3] for row in rows if row[1]] or [math.nan])
        print(f"{temper:g}, {doubt:g}: {near:.3f}, {accepted:.3f}, {log:.3f}, {nees:.3f}", flush=True)


def main() -> None:
    """Fit, and print what was found."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("out/grid-trackers"), help="folder of the towns")
    parser.add_argument("--tracker", action="append", choices=list(TEMPERS), help="default: all")
    options = parser.parse_args()
    towns = draw_towns(options.out)
    taught = None
    if not options.tracker or LsvlBelief.card.name in options.tracker:
        pairs = [pair for flight in read_flights(options.out, towns, TAUGHT_ON) for pair in flight]
        names = dict.fromkeys(query.region for query, _ in pairs)
        regions = {name: sgb.read_region(options.out / "regions" / name) for name in names}
        right, wrong = distances(sgb.Training(regions=regions, pairs=pairs))
        taught = Ratio.fitted(right, wrong).to_text()
        print(f"ratio of {len(right)} right and {len(wrong)} other poses: {taught}", flush=True)
    for kind in (GridMarkov, LsvlBelief, SasgeoTrack):
        if not options.tracker or kind.card.name in options.tracker:
            given = learned(options.out, towns) if kind is SasgeoTrack else taught if kind is LsvlBelief else None
            try_settings(kind, options.out, towns, given)


if __name__ == "__main__":
    main()
