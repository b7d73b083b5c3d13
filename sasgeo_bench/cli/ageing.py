# SPDX-License-Identifier: Apache-2.0
"""Commands that measure how maps age."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import typer

from sasgeo_bench.ageing.files import read_ageing, write_ageing, write_ratebook, write_summary
from sasgeo_bench.ageing.measure import measure_ageing
from sasgeo_bench.cli.console import read_day, say
from sasgeo_bench.cli.options import Options
from sasgeo_bench.core.errors import ConfigError
from sasgeo_bench.osm.history import MARGIN_M, date_extracts, read_history
from sasgeo_bench.osm.scan import Box


@dataclass(frozen=True, kw_only=True)
class AgeingOptions(Options):
    """Flags of measure-ageing."""

    extract: Annotated[
        list[Path] | None, typer.Option(help="a dated extract, or one full history with several --at")
    ] = None
    at: Annotated[
        list[str] | None, typer.Option(help="YYYY-MM-DD: of each extract in order, or to cut a full history at")
    ] = None
    place: Annotated[str | None, typer.Option(help="name of the place; default: how the first file begins")] = None
    country: Annotated[str, typer.Option(help="its country, for --rates: places are aged by rates of others")] = ""
    bounds: Annotated[str | None, typer.Option(metavar="W,S,E,N", help="degrees; default: what all map")] = None
    margin_m: Annotated[
        float, typer.Option(min=0, help="cut off along the edges of extracts where those are estimated, metres")
    ] = MARGIN_M
    compare: Annotated[
        list[Path] | None,
        typer.Option(help="folder that measure-ageing wrote: put the rates of several side by side, class by class"),
    ] = None
    control: Annotated[
        list[Path] | None,
        typer.Option(help="with --compare: folder of maps a day apart, shown next to the places, never as a rate"),
    ] = None
    rates: Annotated[
        Path | None, typer.Option(help="with --compare: also write the rates of the places into this TOML file")
    ] = None
    out: Annotated[
        Path | None,
        typer.Option(
            envvar="SASGEO_OUT",
            help="folder to write (out); with --compare, the Markdown file, or the folder of ageing-summary.md",
        ),
    ] = None


def measure_ageing_command(options: AgeingOptions) -> None:
    """Measure what vanished and appeared between dated extracts: OUT/ageing.parquet, ageing.md and ageing.svg.

    With --compare, put the rates of several places that were measured before side by side.
    """
    if options.compare:
        _compare(options)
        return
    if not options.extract:
        raise ConfigError("measure-ageing needs --extract, or --compare with folders that it wrote before")
    if options.control or options.rates:
        raise ConfigError("--control and --rates go with --compare: leave them out")
    out = options.out or Path("out")
    box = _read_box(options.bounds)
    if out.exists() and not out.is_dir():
        raise ConfigError(f"--out {out} is a file: name a folder")
    dated = date_extracts(options.extract, at=[read_day(text, flag="--at") for text in options.at or ()])
    history = read_history(dated, bounds=box, margin_m=options.margin_m)
    name = options.place or options.extract[0].name.split(".")[0].split("-")[0]
    for path in write_ageing(out, measure_ageing(history, place=name, country=options.country)):
        say(path)


def _compare(options: AgeingOptions) -> None:
    """Put the measured rates of several places side by side."""
    measuring = {
        "--extract": options.extract,
        "--at": options.at,
        "--place": options.place,
        "--country": options.country,
        "--bounds": options.bounds,
        "--margin-m": options.margin_m != MARGIN_M,
    }
    given = [flag for flag, value in measuring.items() if value]
    if given:
        raise ConfigError(f"--compare reads folders that were written before: leave out {' and '.join(given)}")
    out = options.out or Path()
    places, controls = ([read_ageing(item) for item in items or ()] for items in (options.compare, options.control))
    say(write_summary(out / "ageing-summary.md" if out.is_dir() or not out.suffix else out, places, controls))
    if options.rates is not None:
        say(write_ratebook(options.rates, places))


def _read_box(text: str | None) -> Box | None:
    """Read west,south,east,north in degrees, None where it was left out."""
    if text is None:
        return None
    try:
        west, south, east, north = (float(part) for part in text.split(","))
    except ValueError:
        west, south, east, north = 0.0, 0.0, 0.0, 0.0
    if not (-180 <= west < east <= 180 and -90 <= south < north <= 90):  # degrees on a sphere
        raise ConfigError(
            f"--bounds must be west,south,east,north in degrees as in 9.47,47.05,9.64,47.27, got {text!r}"
        )
    return (west, south, east, north)
