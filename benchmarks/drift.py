# SPDX-License-Identifier: Apache-2.0
"""Drift of real visual-inertial odometry, by segment length; the shipped profiles fitted to it and drawn again.

Reads a folder of EuRoC runs, `est/<odometer>_<sequence>*.txt.gz` with truths `gt/<sequence>_*.txt.gz`, named by
--folder or SASGEO_ODOMETRY. `--write` fits the profiles of visual-inertial odometry anew.
"""

import argparse
import os
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pandas as pd

from sasgeo_bench.flights.drift import FittedDrift, PairedRun, fit_profile, law_figures, measure_drift, pair_run
from sasgeo_bench.flights.drift_profile import DriftProfile, load_profile, write_drift_profile
from sasgeo_bench.flights.odometry import dead_reckon, draw_odometry
from sasgeo_bench.flights.trajectory import Trajectory, read_tum
from sasgeo_bench.geometry.pose import bearing_deg, wrap_deg

# File name, what it is, seconds without a pose that are a lost stretch: keyframes may be far from each other.
ODOMETERS = {
    "rpg_vio_mono": ("VIO, monocular", 2.0),
    "rpg_vio_stereo": ("VIO, stereo", 2.0),
    "vislam_ba": ("VI-SLAM, keyframes after bundle adjustment", 60.0),
    "vislam_rp": ("VI-SLAM, real time", 2.0),
}
PROFILES = {"vio-mono": "rpg_vio_mono", "vio-stereo": "rpg_vio_stereo"}
LENGTHS_M = (10.0, 20.0, 50.0)
DRAWN = 100  # runs of each flight
LIMITS = (
    "Flights of 36 to 130 m in rooms at about 1 m/s, six of them: nothing is known beyond 50 m, and in a room errors "
    "are bounded by its size. Kilometres outdoors, at 10 m/s and 100 m above the ground, rest on the model alone. No "
    "reset and no lost stretch in 0.5 km: up to 7 per km of each agree with that."
)
SURVEY_M, LINE_M, GAP_M, STEP_M, ALIGNED = 3000.0, 500.0, 50.0, 5.0, 8
SURVEY_RUNS = 200


def read_runs(folder: Path, name: str) -> list[PairedRun]:
    """Runs of one odometer with their truths."""
    runs = []
    for path in sorted((folder / "est").glob(f"{name}_*.txt.gz")):
        sequence = path.name.removeprefix(f"{name}_")[:5]
        (truth,) = (folder / "gt").glob(f"{sequence}_*.txt.gz")
        runs.append(pair_run(read_tum(truth), read_tum(path), sequence=sequence, lost_s=ODOMETERS[name][1]))
    return runs


def drawn_runs(folder: Path, name: str, profile: DriftProfile) -> Iterator[PairedRun]:
    """Runs drawn from a profile on the true paths of an odometer, held level: the axes of these bodies differ."""
    for number, path in enumerate(sorted((folder / "est").glob(f"{name}_*.txt.gz"))):
        sequence = path.name.removeprefix(f"{name}_")[:5]
        (file,) = (folder / "gt").glob(f"{sequence}_*.txt.gz")
        truth = read_tum(file)
        poses = read_tum(path).time_s
        true = truth.at(poses[(poses >= truth.time_s[0]) & (poses <= truth.time_s[-1])])
        level = Trajectory.of_angles(time_s=true.time_s, position_m=true.position_m, yaw_deg=np.zeros(len(true)))
        for run in range(DRAWN):
            steps = draw_odometry(level, profile, rng=np.random.default_rng([number, run]))
            yield pair_run(level, dead_reckon(level, steps), sequence=sequence)


def table(head: list[str], rows: list[list[object]]) -> None:
    """Print a table as Markdown."""
    print("| " + " | ".join(head) + " |")
    print("|---|" + "---:|" * (len(head) - 1))
    for row in rows:
        print("| " + " | ".join(str(cell) for cell in row) + " |")
    print()


def shown(figures: pd.DataFrame, figure: str, length_m: float) -> str:
    """One figure with its interval."""
    row = figures[(figures["figure"] == figure) & (figures["length_m"] == length_m)].iloc[0]
    return f"{row['value']:.2f} [{row['lo']:.2f}, {row['hi']:.2f}]"


def print_measured(folder: Path) -> None:
    """Print what was measured of each odometer."""
    rows, rare = [], []
    for name, (title, _) in ODOMETERS.items():
        runs = read_runs(folder, name)
        figures = measure_drift(runs, lengths_m=(10.0, 50.0))
        asked = [(figure, at) for figure in ("position_pct", "yaw_deg", "scale_pct") for at in (10.0, 50.0)]
        rows.append([title, len(runs), *(shown(figures, *each) for each in asked)])
        rates = figures.set_index("figure").loc[["resets_per_km", "lost_per_km"]]
        ends = [f"{row['value']:.1f} [{row['lo']:.1f}, {row['hi']:.1f}]" for _, row in rates.iterrows()]
        rare.append([title, f"{sum(run.path_m for run in runs) / 1000:.2f}", *ends])
    figures_of = [f"{figure}, {at} m" for figure in ("position %", "yaw, deg", "scale %") for at in (10, 50)]
    table(["Odometer", "runs", *figures_of], rows)
    table(["Odometer", "km", "resets per km", "lost per km"], rare)


def print_fitted(folder: Path) -> dict[str, FittedDrift]:
    """Fit the shipped profiles, draw runs from them, and print what was measured, what the law says, what was drawn."""
    fitted = {}
    for name, source in PROFILES.items():
        runs = read_runs(folder, source)
        said = "EuRoC MAV data set (ASL, ETH Zurich); estimates of uzh-rpg/rpg_trajectory_evaluation, truth of OpenVINS"
        card = {
            "title": f"Visual-inertial odometry, {'stereo' if 'stereo' in source else 'monocular'}",
            "source": f"Fitted to segments of 10, 20 and 50 m by benchmarks/drift.py: {said}; {source}, one run of "
            "each of six sequences, 0.51 km.",
            "limits": LIMITS,
        }
        found = fitted[name] = fit_profile(runs, name=name, lengths_m=LENGTHS_M, card=card)
        drawn = measure_drift(list(drawn_runs(folder, source, found.profile)), lengths_m=LENGTHS_M, draws=10)
        law = law_figures(found.profile, runs, lengths_m=LENGTHS_M)
        measured = measure_drift(runs, lengths_m=LENGTHS_M)
        rows = [
            [figure, f"{at:g}", shown(measured, figure, at), f"{value:.2f}", shown(drawn, figure, at).split(" ")[0]]
            for figure, at, value in law.itertuples(index=False)
        ]
        print(f"{name}: run_spread {found.profile.run_spread:.2f}, slip over {found.profile.slip.length_m:g} m\n")
        values = found.parameters.itertuples()
        table(["Parameter", "value"], [[r.name, f"{r.value:.2f} [{r.lo:.2f}, {r.hi:.2f}]"] for r in values])
        table(["Root mean square", "length, m", "measured", "law", "drawn"], rows)
    return fitted


def survey() -> Trajectory:
    """A flight of parallel lines at 10 m/s and 80 m."""
    corners, up = [(0.0, 0.0)], True
    while len(corners) * (LINE_M + GAP_M) / 2 < SURVEY_M + LINE_M:
        north = LINE_M if up else 0.0
        corners += [(corners[-1][0], north), (corners[-1][0] + GAP_M, north)]
        up = not up
    places = np.array(corners)
    path = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(places, axis=0).T))])
    at = np.arange(0.0, SURVEY_M, STEP_M)
    east, north = (np.interp(at, path, axis) for axis in places.T)
    yaw = bearing_deg(np.gradient(east), np.gradient(north))
    position = np.stack([east, north, np.full(len(at), 80.0)], axis=1)
    return Trajectory.of_angles(time_s=at / 10, position_m=position, yaw_deg=yaw)


def similarity(flown: np.ndarray, believed: np.ndarray, window: np.ndarray) -> np.ndarray:
    """Turn and scale that fit each window of true places to the believed ones, as complex numbers."""
    true, seen = flown[window], believed[window]
    true, seen = true - true.mean(axis=1, keepdims=True), seen - seen.mean(axis=1, keepdims=True)
    return (true.conj() * seen).sum(axis=1) / (np.abs(true) ** 2).sum(axis=1)


def print_survey() -> None:
    """Print what runs of vo-mono-survey have, measured as the published ones were, by quantiles over runs."""
    flight, profile, found = survey(), load_profile("vo-mono-survey"), []
    flown = flight.position_m[:, 0] + 1j * flight.position_m[:, 1]
    lengths = [round(length / STEP_M) for length in (50, 100, 200, 1000)]
    begins = np.arange(ALIGNED, len(flown) - lengths[-1])
    before = begins[:, None] + np.arange(-ALIGNED, 1)
    for run in range(SURVEY_RUNS):
        steps = draw_odometry(flight, profile, rng=np.random.default_rng([1, run]))
        reckoned = dead_reckon(flight, steps)
        believed = reckoned.position_m[:, 0] + 1j * reckoned.position_m[:, 1]
        turn = similarity(flown, believed, before)
        row = []
        for length in lengths:
            moved = (believed[begins + length] - believed[begins]) / turn
            error = np.abs(moved - (flown[begins + length] - flown[begins]))
            row.append(100 * np.median(error) / (length * STEP_M))
        ahead = begins + lengths[2]
        heading = wrap_deg(reckoned.yaw_deg - flight.yaw_deg)
        row.append(np.sqrt(np.mean(wrap_deg(heading[ahead] - heading[begins]) ** 2)))
        scale = np.abs(similarity(flown, believed, begins[:, None] + np.arange(lengths[2] + 1)) / turn)
        row.append(100 * np.sqrt(np.mean(np.log(scale) ** 2)))
        whole = similarity(flown, believed, np.arange(len(flown))[None])[0]
        row.append(np.sqrt(np.mean(np.abs((believed - believed.mean()) / whole - (flown - flown.mean())) ** 2)))
        found.append(row)
    names = ["50 m, %", "100 m, %", "200 m, %", "1 km, %", "yaw rms 200 m, deg", "scale rms 200 m, %", "ATE, m"]
    quantiles = np.quantile(found, [0.1, 0.5, 0.9, 0.99], axis=0).T
    print("vo-mono-survey, quantiles over runs\n")
    rows = [[name, *(f"{value:.2f}" for value in values)] for name, values in zip(names, quantiles, strict=True)]
    table(["Figure", "10 %", "median", "90 %", "99 %"], rows)


def main() -> None:
    """Print the tables of docs/concepts/flights.md."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--folder", type=Path, default=os.environ.get("SASGEO_ODOMETRY"))
    parser.add_argument("--write", type=Path, help="folder to write the fitted profiles into")
    asked = parser.parse_args()
    if asked.folder is None:
        parser.error("name the folder of the runs: --folder, or SASGEO_ODOMETRY")
    print_measured(asked.folder)
    for name, found in print_fitted(asked.folder).items():
        if asked.write is not None:
            write_drift_profile(found.profile, asked.write / f"{name}.toml")
    print_survey()


if __name__ == "__main__":
    sys.exit(main())
