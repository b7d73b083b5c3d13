# SPDX-License-Identifier: Apache-2.0
"""The command that writes a dataset release."""

from pathlib import Path
from typing import Annotated

import typer

from sasgeo_bench.cli.console import Out, read_date, say, tell
from sasgeo_bench.errors import counted
from sasgeo_bench.publishing.release import ReleaseRequest, make_release


def release_command(  # noqa: PLR0913 - a command has as many flags as its users need
    *,
    regions: Annotated[list[str], typer.Option("--regions", help="id of a built region; may be repeated")],
    suites: Annotated[
        list[str] | None,
        typer.Option("--suites", help="name from list-suites; may be repeated; default: all there are queries of"),
    ] = None,
    split: Annotated[str, typer.Option(help="id or file of the split that the queries were drawn by")] = "crossfit",
    truth: Annotated[bool, typer.Option("--truth", help="put the truths of test queries into it too")] = False,
    into: Annotated[Path | None, typer.Option(help="folder of the release; default: OUT/release")] = None,
    date: Annotated[str | None, typer.Option(help="day of publication; default: that of the newest map")] = None,
    url: Annotated[str | None, typer.Option(help="address where the release will be found")] = None,
    out: Out = Path("out"),
) -> None:
    """Write regions and queries as a dataset that others load without this program (needs the extra publish)."""
    day = read_date(date)
    request = ReleaseRequest(
        regions=tuple(regions),
        suites=tuple(suites or ()),
        split=split,
        with_truth=truth,
        out=out,
        into=into or out / "release",
        published=None if day is None else day.isoformat(),
        url=url,
    )
    release = make_release(request, tell=tell)
    maps, queries = counted(len(release.maps), "map"), counted(release.queries, "query", "queries")
    suites_said = counted(len(release.suites), "suite")
    say(f"{request.into}: {maps}, {queries} of {suites_said}, {release.bytes / 1e6:.1f} MB")
