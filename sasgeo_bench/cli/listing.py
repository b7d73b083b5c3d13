# SPDX-License-Identifier: Apache-2.0
"""List regions, suites, matchers, trackers, rejectors and segmenters; each command imports what it lists."""

from collections.abc import Mapping

from rich.table import Table

from sasgeo_bench.cli.console import print_table
from sasgeo_bench.cli.options import RegionFolders
from sasgeo_bench.matching.plugins import (
    MATCHERS,
    ORACLE,
    ORACLE_SEGMENTER,
    REJECTORS,
    SEGMENTERS,
    TRACKERS,
    list_entry_points,
)


def list_regions_command(regions: RegionFolders = None) -> None:
    """List the regions that come with the package, and your own."""
    from sasgeo_bench.regions.region_spec import list_region_files, read_region_file  # noqa: PLC0415

    table = Table("id", "title", "km2", "cell", "dates", "scenes", box=None, pad_edge=False)
    for name, path in sorted(list_region_files(folders=regions or ()).items()):
        spec = read_region_file(path)
        grid = spec.grid()
        area_km2 = grid.rows * grid.cols * grid.cell_size_m**2 / 1e6
        dates = [extract.date.isoformat() for extract in spec.extract]
        shown = dates[0] if len(dates) == 1 else f"{dates[0]} .. {dates[-1]} ({len(dates)})"
        table.add_row(name, spec.title, f"{area_km2:.1f}", f"{grid.cell_size_m:g} m", shown, ", ".join(spec.scenes))
    print_table(table)


def list_suites_command() -> None:
    """List the suites: what each does and what it separates."""
    from sasgeo_bench.tasks.suites.all_suites import EVERY_SUITE  # noqa: PLC0415

    table = Table("suite", "title", "tracks", "per site", "separates", box=None, pad_edge=False)
    for name, suite in EVERY_SUITE.items():
        card = suite.card
        per_site = sum(len(suite.tracks(variant)) for variant in suite.variants)
        table.add_row(name, card.title, ", ".join(card.tracks), str(per_site), card.separates)
    print_table(table)


def list_matchers_command() -> None:
    """List the matchers that are installed, and where each comes from."""
    _list("matcher", MATCHERS, {ORACLE: ("sasgeo-bench", "a control, given the truth")})


def list_rejectors_command() -> None:
    """List the rejectors that are installed, and where each comes from."""
    _list("rejector", REJECTORS, {})


def list_trackers_command() -> None:
    """List the trackers that are installed, and where each comes from."""
    _list("tracker", TRACKERS, {ORACLE: ("sasgeo-bench", "a control, given the truths")})


def list_segmenters_command() -> None:
    """List the segmenters that are installed, and where each comes from."""
    _list("segmenter", SEGMENTERS, {ORACLE_SEGMENTER: ("sasgeo-bench", "a control, given the labels")})


def _list(kind: str, group: str, own: Mapping[str, tuple[str, str]]) -> None:
    """Print the entry points of a group, and what needs none."""
    rows = {
        name: (point.dist.name if point.dist is not None else "", point.value)
        for name, point in list_entry_points(group).items()
    }
    table = Table(kind, "package", "class", box=None, pad_edge=False)
    for name, cells in sorted((rows | dict(own)).items()):
        table.add_row(name, *cells)
    print_table(table)
