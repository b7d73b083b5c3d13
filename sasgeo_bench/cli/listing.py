# SPDX-License-Identifier: Apache-2.0
"""List regions, suites, matchers, trackers, rejectors and segmenters; each command imports what it lists."""

from collections.abc import Callable, Mapping
from dataclasses import fields
from typing import Annotated, Any, Final

import typer
from rich.table import Table

from sasgeo_bench.cli.console import print_table, say, tell
from sasgeo_bench.cli.options import RegionFolders
from sasgeo_bench.files.plugins import (
    MATCHERS,
    ORACLE,
    ORACLE_SEGMENTER,
    REJECTORS,
    SEGMENTERS,
    TRACKERS,
    list_entry_points,
)
from sasgeo_bench.matching.plugins import load_matcher, load_rejector, load_segmenter, load_tracker
from sasgeo_bench.texts import plain

_OF_DEMO: Final = "demo-"  # too many made-up towns to list
Shown = Annotated[str | None, typer.Argument(help="show the card of one: a name of the list, or module:Class")]


def list_regions_command(regions: RegionFolders = None) -> None:
    """List the regions that come with the package, and your own."""
    from sasgeo_bench.config import shipped_dir  # noqa: PLC0415
    from sasgeo_bench.regions.region_spec import list_region_files, read_region_file  # noqa: PLC0415

    table = Table("id", "title", "km2", "cell", "dates", "scenes", box=None, pad_edge=False)
    files = list_region_files(folders=regions or ())
    shipped = shipped_dir("regions")
    of_demo = sorted(name for name, path in files.items() if name.startswith(_OF_DEMO) and path.parent == shipped)
    for name in sorted(files.keys() - set(of_demo)):
        spec = read_region_file(files[name])
        grid = spec.grid()
        area_km2 = grid.rows * grid.cols * grid.cell_size_m**2 / 1e6
        dates = [extract.date.isoformat() for extract in spec.extract]
        shown = dates[0] if len(dates) == 1 else f"{dates[0]} .. {dates[-1]} ({len(dates)})"
        table.add_row(name, spec.title, f"{area_km2:.1f}", f"{grid.cell_size_m:g} m", shown, ", ".join(spec.scenes))
    print_table(table)
    tell(f"and {len(of_demo)} small towns of `leaderboard demo`, {_OF_DEMO}...: regions/README.md")


def list_suites_command() -> None:
    """List the suites: what each does and what it separates."""
    from sasgeo_bench.tasks.suites.all_suites import EVERY_SUITE  # noqa: PLC0415

    table = Table("suite", "title", "tracks", "per site", "separates", box=None, pad_edge=False)
    for name, suite in EVERY_SUITE.items():
        card = suite.card
        per_site = sum(len(suite.tracks(variant)) for variant in suite.variants)
        table.add_row(name, card.title, ", ".join(card.tracks), str(per_site), card.separates)
    print_table(table)


def list_matchers_command(name: Shown = None) -> None:
    """List the matchers that are installed, and where each comes from; or show the card of one."""
    _list("matcher", MATCHERS, {ORACLE: ("sasgeo-bench", "a control, given the truth")}, name, load_matcher)


def list_rejectors_command(name: Shown = None) -> None:
    """List the rejectors that are installed, and where each comes from; or show the card of one."""
    _list("rejector", REJECTORS, {}, name, load_rejector)


def list_trackers_command(name: Shown = None) -> None:
    """List the trackers that are installed, and where each comes from; or show the card of one."""
    _list("tracker", TRACKERS, {ORACLE: ("sasgeo-bench", "a control, given the truths")}, name, load_tracker)


def list_segmenters_command(name: Shown = None) -> None:
    """List the segmenters that are installed, and where each comes from; or show the card of one."""
    own = {ORACLE_SEGMENTER: ("sasgeo-bench", "a control, given the labels")}
    _list("segmenter", SEGMENTERS, own, name, load_segmenter)


def _list(
    kind: str, group: str, own: Mapping[str, tuple[str, str]], name: str | None, load: Callable[[str], Any]
) -> None:
    """Print the entry points of a group and what needs none; or the card of the one of a name."""
    if name is not None and name in own:
        say(f"{name}: {own[name][1]}, and has no card")
        return
    if name is not None:
        _show(load(name).card)
        return
    rows = {
        name: (point.dist.name if point.dist is not None else "", point.value)
        for name, point in list_entry_points(group).items()
    }
    table = Table(kind, "package", "class", box=None, pad_edge=False)
    for each, cells in sorted((rows | dict(own)).items()):
        table.add_row(each, *cells)
    print_table(table)


def _show(card: object) -> None:
    """Print what a card says, a field after the other; what it leaves empty is left out."""
    said = ((field.name.replace("_", " "), getattr(card, field.name)) for field in fields(card))  # type: ignore[arg-type]
    for title, value in said:
        text = ", ".join(value) if isinstance(value, tuple) else str(value)
        if text:
            say(f"{title}: {plain(text)}")
