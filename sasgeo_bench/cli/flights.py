# SPDX-License-Identifier: Apache-2.0
"""Commands about flights and their odometry."""

import math
from pathlib import Path
from typing import Annotated

import pandas as pd
import typer
from rich.table import Table

from sasgeo_bench.cli.console import print_table, tell
from sasgeo_bench.errors import FlightError, counted
from sasgeo_bench.files.folders import fresh_file
from sasgeo_bench.files.parquet import write_frame
from sasgeo_bench.flights.axes import Axes
from sasgeo_bench.flights.drift import LOST_S, PairedRun, measure_drift, pair_run
from sasgeo_bench.flights.drift_fit import fit_profile
from sasgeo_bench.flights.drift_profile import write_drift_profile
from sasgeo_bench.flights.tum import read_tum

AxesFlag = Annotated[
    Axes | None,
    typer.Option(help="axes of TUM files: up (third axis up), or camera (right, down, ahead: KITTI, ORB-SLAM)"),
]


def measure_drift_command(
    truth: Annotated[list[Path], typer.Option(help="true trajectory, TUM format, plain or gzipped; may be repeated")],
    estimate: Annotated[list[Path], typer.Option(help="estimate of it; one for each --truth, in the same order")],
    lengths_m: Annotated[str, typer.Option(metavar="M,M,...", help="lengths of segments, metres of path")] = "10,50",
    lost_s: Annotated[float, typer.Option(min=0, help="seconds without a pose that are a lost stretch")] = LOST_S,
    axes: AxesFlag = None,
    results: Annotated[Path | None, typer.Option(help="also write the figures into this Parquet file")] = None,
    profile: Annotated[Path | None, typer.Option(help="also write a profile that was fitted, a TOML file")] = None,
) -> None:
    """Measure drift of odometry against truth by segment length; runs of one truth file are one cluster."""
    lengths = _read_lengths(lengths_m)
    _check_outputs([*truth, *estimate], [path for path in (results, profile) if path is not None])
    runs = _read_runs(truth, estimate, lost_s, axes)
    flights = counted(len({run.sequence for run in runs}), "sequence")
    tell(f"{counted(len(runs), 'run')} of {flights}, {sum(run.path_m for run in runs):.0f} m tracked")
    figures = measure_drift(runs, lengths_m=lengths)
    print_table(_table_of(figures))
    if results is not None:
        with fresh_file(results, mend="name another place, or free some space") as scratch:
            write_frame(figures, scratch, attrs={"runs": len(runs), "lost_s": lost_s})
        tell(f"wrote {results}")
    if profile is not None:
        fitted = fit_profile(runs, name=profile.stem, lengths_m=lengths)
        write_drift_profile(fitted.profile, profile)
        for row in fitted.parameters.to_dict("records"):
            tell(f"{row['name']} = {row['value']:.3f} [{row['lo']:.3f}, {row['hi']:.3f}]")
        tell(f"wrote {profile}: add where the data come from and where the profile must not be believed")


def _read_lengths(text: str) -> list[float]:
    """Read lengths in metres, separated by commas; each must be positive."""
    try:
        lengths = [float(part) for part in text.split(",")]
    except ValueError:
        lengths = []
    if not lengths or not all(0 < length < math.inf for length in lengths):
        message = f"--lengths-m must be positive metres as in 10,50, got {text!r}"
        raise FlightError(message)
    return lengths


def _read_runs(truth: list[Path], estimate: list[Path], lost_s: float, axes: Axes | None) -> list[PairedRun]:
    """Read pairs of files; each truth is read once."""
    if len(truth) != len(estimate):
        message = f"give one --estimate for each --truth, got {len(truth)} truths and {len(estimate)} estimates"
        raise FlightError(message)
    truths = {path: read_tum(path, axes=axes) for path in dict.fromkeys(truth)}
    runs = []
    for true_path, path in zip(truth, estimate, strict=True):
        believed = read_tum(path, axes=axes)
        try:
            run = pair_run(truths[true_path], believed, sequence=str(true_path.resolve()), lost_s=lost_s)
        except FlightError as error:
            message = f"{path} against {true_path}: {error}"
            raise FlightError(message) from error
        runs.append(run)
    return runs


def _check_outputs(inputs: list[Path], outputs: list[Path]) -> None:
    """Refuse to write a file over an input, or two into one."""
    for at, path in enumerate(outputs):
        if path in outputs[:at] or any(_is_same(path, other) for other in inputs):
            message = f"{path} is named twice, to read from and to write to: name another file"
            raise FlightError(message)


def _is_same(path: Path, other: Path) -> bool:
    return path.exists() and other.exists() and path.samefile(other)


def _table_of(figures: pd.DataFrame) -> Table:
    table = Table("figure", "length, m", "value", "95 %", "sequences", "segments", box=None, pad_edge=False)
    for row in figures.to_dict("records"):
        length = "" if math.isnan(row["length_m"]) else f"{row['length_m']:g}"
        value, lo, hi = ("-" if math.isnan(row[key]) else f"{row[key]:.2f}" for key in ("value", "lo", "hi"))
        table.add_row(row["figure"], length, value, f"[{lo}, {hi}]", str(row["sequences"]), str(row["segments"]))
    return table
