# SPDX-License-Identifier: Apache-2.0
"""Commands that measure how maps age."""

from pathlib import Path
from typing import Annotated

import typer

from sasgeo_bench.ageing.files import read_ageing, write_ageing, write_ratebook, write_summary
from sasgeo_bench.ageing.measure import measure_ageing
from sasgeo_bench.cli.console import read_day, say
from sasgeo_bench.cli.options import Out
from sasgeo_bench.errors import ConfigError
from sasgeo_bench.osm.history import MARGIN_M, date_extracts, read_history
from sasgeo_bench.osm.scan import Box


def measure_ageing_command(
    extract: Annotated[list[Path], typer.Option(help="a dated extract, or one full history with several --at")],
    at: Annotated[
        list[str] | None, typer.Option(help="YYYY-MM-DD: of each extract in order, or to cut a full history at")
    ] = None,
    place: Annotated[str | None, typer.Option(help="name of the place; default: how the first file begins")] = None,
    bounds: Annotated[str | None, typer.Option(metavar="W,S,E,N", help="degrees; default: what all map")] = None,
    margin_m: Annotated[
        float, typer.Option(min=0, help="cut off along the edges of extracts where those are estimated, metres")
    ] = MARGIN_M,
    out: Out = Path("out"),
) -> None:
    """Measure what vanished and appeared between dated extracts: OUT/ageing.parquet, ageing.md and ageing.svg."""
    box = _read_box(bounds)
    if out.exists() and not out.is_dir():
        raise ConfigError(f"--out {out} is a file: name a folder")
    dated = date_extracts(extract, at=[read_day(text, flag="--at") for text in at or ()])
    history = read_history(dated, bounds=box, margin_m=margin_m)
    name = place or extract[0].name.split(".")[0].split("-")[0]
    for path in write_ageing(out, measure_ageing(history, place=name)):
        say(path)


def compare_ageing_command(
    folder: Annotated[list[Path], typer.Argument(help="folders that measure-ageing wrote")],
    control: Annotated[
        list[Path] | None, typer.Option(help="folder of maps a day apart: reported next to the places, never as a rate")
    ] = None,
    rates: Annotated[Path | None, typer.Option(help="also write the rates of the places into this TOML file")] = None,
    out: Annotated[Path, typer.Option(help="the Markdown file to write")] = Path("ageing-summary.md"),
) -> None:
    """Put the measured rates of several places side by side, class by class."""
    places, controls = ([read_ageing(item) for item in items] for items in (folder, control or ()))
    say(write_summary(out, places, controls))
    if rates is not None:
        say(write_ratebook(rates, places))


def _read_box(text: str | None) -> Box | None:
    """Read west,south,east,north in degrees, None where it was left out."""
    if text is None:
        return None
    try:
        west, south, east, north = (float(part) for part in text.split(","))
    except ValueError:
        west, south, east, north = 0.0, 0.0, 0.0, 0.0
    if not (-180 <= west < east <= 180 and -90 <= south < north <= 90):  # noqa: PLR2004 - degrees on a sphere
        raise ConfigError(
            f"--bounds must be west,south,east,north in degrees as in 9.47,47.05,9.64,47.27, got {text!r}"
        )
    return (west, south, east, north)
