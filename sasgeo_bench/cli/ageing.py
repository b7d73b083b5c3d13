# SPDX-License-Identifier: Apache-2.0
"""Commands that measure how maps age."""

from pathlib import Path
from typing import Annotated

import typer

from sasgeo_bench.ageing.measure import measure_ageing
from sasgeo_bench.cli.console import Out, read_box, read_day, say, tell
from sasgeo_bench.extract.history import MARGIN_M, date_extracts, read_history
from sasgeo_bench.store.ageingfile import read_ageing, write_ageing, write_summary
from sasgeo_bench.store.ratebookfile import write_ratebook


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
    box = read_box(bounds)
    dated = date_extracts(extract, at=[read_day(text, flag="--at") for text in at or ()])
    history = read_history(dated, bounds=box, margin_m=margin_m, tell=tell)
    name = place or extract[0].name.split(".")[0].split("-")[0]
    for path in write_ageing(out, measure_ageing(history, place=name)):
        say(path)


def compare_ageing_command(
    folder: Annotated[list[Path], typer.Argument(help="folders that measure-ageing wrote")],
    control: Annotated[
        list[Path] | None, typer.Option(help="folder of maps a day apart: told of beside the places, never as a rate")
    ] = None,
    rates: Annotated[Path | None, typer.Option(help="also write the rates of the places into this TOML file")] = None,
    out: Annotated[Path, typer.Option(help="the Markdown file to write")] = Path("ageing-summary.md"),
) -> None:
    """Put the measured rates of several places beside each other, class by class."""
    places, controls = ([read_ageing(item) for item in items] for items in (folder, control or ()))
    say(write_summary(out, places, controls))
    if rates is not None:
        say(write_ratebook(rates, places))
