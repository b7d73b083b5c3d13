# SPDX-License-Identifier: Apache-2.0
"""Measure what a matcher costs: the command. Its page is that of a site, of which `run` needs nothing."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import typer

from sasgeo_bench.boards.profile_page import PAGE, check_profile, facts, write_profile
from sasgeo_bench.cli.console import say, shown_progress
from sasgeo_bench.cli.options import Options, Out
from sasgeo_bench.cli.runs import PackedMaps
from sasgeo_bench.regions.packed_map import unpack_map
from sasgeo_bench.running.profiling import ProfileRequest, plan_profile, profile


@dataclass(frozen=True, kw_only=True)
class ProfileOptions(Options):
    """Flags of profile."""

    matcher: Annotated[str, typer.Option(help="name from list matchers or list trackers, or module:Class")]
    tasks: Annotated[
        list[Path],
        typer.Option(help="task folders, OUT/tasks/SUITE/REGION, of one map"),
    ]
    maps: PackedMaps = None
    cores: Annotated[int, typer.Option(help="processors that the matcher and this program share")] = 1
    memory_mb: Annotated[int, typer.Option(help="MB (10^6 bytes) for all processes of the matcher")] = 2000
    seconds: Annotated[
        float, typer.Option(help="how long it is asked, one query after the other; 20 queries at least")
    ] = 300.0
    radius: Annotated[
        float | None, typer.Option(metavar="METRES", help="only queries whose prior is a disc of at most this radius")
    ] = None
    train: Annotated[
        list[Path] | None, typer.Option(help="task folder to learn from, with its truths; may be repeated")
    ] = None
    trusted: Annotated[bool, typer.Option("--trusted", help="run without the sandbox")] = False
    into: Annotated[Path | None, typer.Option(help="folder to write; default: OUT/profiles/MATCHER")] = None
    out: Out = Path("out")


def profile_command(options: ProfileOptions) -> None:
    """Measure what a matcher costs on a small computer: latency over minutes, memory, bytes, heat, energy."""
    request = ProfileRequest(
        spec=options.matcher,
        tasks=options.tasks,
        out=options.out,
        cores=options.cores,
        memory_bytes=options.memory_mb * 10**6,
        sustain_s=options.seconds,
        radius_m=options.radius,
        train=tuple(options.train or ()),
        is_sandboxed=not options.trusted,
        maps=[unpack_map(path, options.out) for path in options.maps or ()],
    )
    plan = plan_profile(request)
    folder = options.into or options.out / "profiles" / plan.card.name
    check_profile(folder)  # before the minutes that it takes
    with shown_progress():
        found = profile(request, plan=plan)
    write_profile(found, folder)
    for name, value, meaning in facts(found):
        say(f"{name}: {value} ({meaning})")
    others = {status: count for status, count in found.statuses.items() if status != "ok"}
    if others:
        say(f"not answers: {', '.join(f'{count} {status}' for status, count in others.items())}")
    say(f"over time: {found.thermal_note()}")
    say(folder / PAGE)
