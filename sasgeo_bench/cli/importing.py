# SPDX-License-Identifier: Apache-2.0
"""Commands about datasets of other benchmarks: import one, score a ranking of it, find the map under it."""

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Final

import typer
from rich.table import Table

from sasgeo_bench.cli.console import print_table, say
from sasgeo_bench.cli.options import Out, RegionFolders
from sasgeo_bench.core.errors import ConfigError, counted, named
from sasgeo_bench.core.progress import tell
from sasgeo_bench.exchange.importers.items import Dataset, Role
from sasgeo_bench.exchange.importers.kinds import IMPORTERS, read_dataset
from sasgeo_bench.exchange.importers.reports import Report

MOST: Final = 3  # regional extracts that are named for an area: its box may lie in those of neighbours


def import_dataset_command(
    folder: Annotated[Path, typer.Argument(help="folder of the dataset; it is only read")],
    *,
    kind: Annotated[str, typer.Option(help=f"kind of the dataset: {', '.join(IMPORTERS)}")],
    ranking: Annotated[
        list[Path] | None,
        typer.Option(help="Parquet file of query_id, gallery_id, rank (from 1) to score; may be repeated"),
    ] = None,
    where: Annotated[
        bool, typer.Option("--where", help="say where it lies, and which extracts cover it; write nothing")
    ] = False,
    regions: RegionFolders = None,
    out: Out = Path("out"),
) -> None:
    """List queries and gallery of another benchmark's dataset, and score a ranking of them: OUT/datasets/KIND."""
    if where:
        if ranking:
            raise ConfigError("--where scores nothing: leave it out, or leave out --ranking")
        _say_where(folder, kind, regions or ())
        return
    from sasgeo_bench.core.folders import sha256_of  # noqa: PLC0415
    from sasgeo_bench.exchange.importers.reports import score_ranking  # noqa: PLC0415
    from sasgeo_bench.exchange.importers.retrieval import read_ranking  # noqa: PLC0415
    from sasgeo_bench.exchange.importers.tables import import_folder, write_items, write_reports  # noqa: PLC0415

    dataset = _read(folder, kind)
    target = import_folder(out, dataset, source=folder)
    reports = score_ranking(dataset, read_ranking(ranking, dataset.items)) if ranking else ()
    say(write_items(target, dataset))
    if ranking:
        say(write_reports(target, dataset, reports, rankings=[sha256_of(path) for path in ranking]))
    for report in reports:
        _show(report)


def _say_where(folder: Path, kind: str, regions: Sequence[Path]) -> None:
    """Say where a dataset lies, and which OpenStreetMap extracts cover it."""
    from sasgeo_bench.exchange.importers.reader import find_extents  # noqa: PLC0415

    extents = find_extents(_read(folder, kind), folders=regions)
    table = Table("area", "items", "center_lonlat", "km", "west,south,east,north", box=None, pad_edge=False)
    for title in ("regions that cover it", "regions in part", "regional extracts"):
        table.add_column(title)
    for number, extent in enumerate(extents, start=1):
        box, centre = extent.box, extent.box.centre
        table.add_row(
            named(extent.groups, "group") if extent.groups else str(number),
            str(extent.items),
            f"[{centre.longitude_deg:.4f}, {centre.latitude_deg:.4f}]",
            f"{extent.width_km:.1f} x {extent.height_km:.1f}",
            ",".join(f"{side:.4f}" for side in (box.west_deg, box.south_deg, box.east_deg, box.north_deg)),
            *(", ".join(names) or "-" for names in (extent.covered_by, extent.touched_by, extent.extracts[:MOST])),
        )
    print_table(table)
    tell(
        "regional extracts are NAME-latest.osm.pbf of download.geofabrik.de, smallest first; their boxes are rounded "
        "and overlap, so check the outline there"
    )


def _read(folder: Path, kind: str) -> Dataset:
    """Read a dataset and say what was found."""
    dataset = read_dataset(folder, kind)
    roles: tuple[Role, ...] = ("query", "gallery", "train", "unsplit")
    found = ", ".join(f"{dataset.count(role)} {role}" for role in roles if dataset.count(role))
    tell(f"{dataset.card.title}: {counted(len(dataset.items), 'item')} ({found}); {dataset.card.attribution}")
    tell(f"terms: {dataset.card.licence} ({dataset.card.source})")
    for note in dataset.notes:
        tell(f"note: {note}")
    return dataset


def _show(report: Report) -> None:
    """Print the metrics of a report."""
    queries = f"{counted(report.queries, 'query', 'queries')}, {report.answered} answered"
    say(f"{report.title}: {queries}, {report.without_positive} without a positive; gallery of {report.gallery}")
    table = Table("metric", "released", "corrected", "released / corrected", box=None, pad_edge=False)
    for score in report.scores:
        values = (_value(value, score.unit) for value in (score.released, score.corrected))
        table.add_row(score.metric, *values, score.difference)
    print_table(table)


def _value(value: float | None, unit: str) -> str:
    if value is None:
        return "-"
    return f"{value:.1f} m" if unit == "m" else f"{value:.4f}"
