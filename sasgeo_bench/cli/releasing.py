# SPDX-License-Identifier: Apache-2.0
"""The command that writes a dataset release."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import typer

from sasgeo_bench.cli.console import read_date, say, tell
from sasgeo_bench.cli.options import Options, Out
from sasgeo_bench.errors import counted
from sasgeo_bench.publishing.release import ReleaseRequest, make_release


@dataclass(frozen=True, kw_only=True)
class ReleaseOptions(Options):
    """Flags of release."""

    regions: Annotated[list[str], typer.Option("--regions", help="id of a built region; may be repeated")]
    suites: Annotated[
        list[str] | None,
        typer.Option("--suites", help="name from list-suites; may be repeated; default: all there are queries of"),
    ] = None
    split: Annotated[str, typer.Option(help="id or file of the split that the queries were drawn by")] = "crossfit"
    truth: Annotated[bool, typer.Option("--truth", help="put the truths of test queries into it too")] = False
    into: Annotated[Path | None, typer.Option(help="folder of the release; default: OUT/release")] = None
    date: Annotated[str | None, typer.Option(help="day of publication; default: that of the newest map")] = None
    url: Annotated[str | None, typer.Option(help="address where the release will be found")] = None
    out: Out = Path("out")


def release_command(options: ReleaseOptions) -> None:
    """Write regions and queries as a dataset that others load without this program (needs the extra publish)."""
    day = read_date(options.date)
    request = ReleaseRequest(
        regions=tuple(options.regions),
        suites=tuple(options.suites or ()),
        split=options.split,
        with_truth=options.truth,
        out=options.out,
        into=options.into or options.out / "release",
        published=None if day is None else day.isoformat(),
        url=options.url,
    )
    release = make_release(request, tell=tell)
    maps, queries = counted(len(release.maps), "map"), counted(release.queries, "query", "queries")
    suites_said = counted(len(release.suites), "suite")
    say(f"{request.into}: {maps}, {queries} of {suites_said}, {release.bytes / 1e6:.1f} MB")
