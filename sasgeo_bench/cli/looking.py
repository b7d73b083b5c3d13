# SPDX-License-Identifier: Apache-2.0
"""Commands that look at what was made, and hold it against what it should be."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Final

import typer
from rich.table import Table

from sasgeo_bench.cli.built_regions import find_built
from sasgeo_bench.cli.console import print_table, say
from sasgeo_bench.cli.options import Options, Out, RegionFolders
from sasgeo_bench.cli.targets import find_task, is_split, sheet_path
from sasgeo_bench.core.errors import ConfigError
from sasgeo_bench.core.progress import tell
from sasgeo_bench.osm.taxonomy import load_taxonomy
from sasgeo_bench.regions.packed_map import is_packed_map, unpack_map
from sasgeo_bench.regions.region import Manifest
from sasgeo_bench.regions.region_files import LAYERS, PREVIEW, differing_files, read_manifest
from sasgeo_bench.regions.region_spec import list_region_files, read_region_file
from sasgeo_bench.running.prediction_files import is_run
from sasgeo_bench.tasks.query import SEQUENCE_DIGITS
from sasgeo_bench.tasks.split import find_split_file, make_split, read_split_file
from sasgeo_bench.tasks.task_files import Task

TOP_DROPS: Final = 12


@dataclass(frozen=True, kw_only=True)
class InspectOptions(Options):
    """Flags of inspect."""

    query: Annotated[
        str | None, typer.Option(help="of a task or a run: this query (or flight) alone, by the beginning of its id")
    ] = None
    rows: Annotated[int, typer.Option(min=1, max=60, help="of a task: queries, or flights, on the contact sheet")] = 12
    strip: Annotated[
        int | None,
        typer.Option(
            min=1, max=20, help="of a run on pictures, or of a board's best one: draw so many queries, half failures"
        ),
    ] = None
    rejector: Annotated[
        list[str] | None, typer.Option(help="acceptance rule for answers of a run; may be repeated")
    ] = None
    split: Annotated[str, typer.Option(help="of a run: says which places calibrate rejectors")] = "crossfit"
    region_folders: RegionFolders = None
    out: Out = Path("out")


def inspect_command(
    target: Annotated[
        str,
        typer.Argument(
            help="a built region, a packed map (*.map), a task (SUITE/REGION), a split, or the folder of one, a run or "
            "a board"
        ),
    ],
    options: InspectOptions,
) -> None:
    """Print the content of a region, task, split or run; draw a task's sheet, a split's map, a query and its answer."""
    out, query, folders = options.out, options.query, options.region_folders or []
    task_folder, region_folder = find_task(target, out), find_built(target, out)
    if task_folder is not None:
        _refuse_strip(target, options.strip)
        _inspect_task(Task.open(task_folder, out), out, query=query, rows=options.rows)
        return
    if options.strip is not None:
        from sasgeo_bench.cli.looking_runs import run_of  # noqa: PLC0415 - boards take a second to import

        target = str(run_of(Path(target), out))
    if Path(target).is_dir() and is_run(Path(target)):
        from sasgeo_bench.boards.run_cases import read_run_cases  # noqa: PLC0415 - as above
        from sasgeo_bench.cli.looking_runs import inspect_run  # noqa: PLC0415

        grids = {name: read_region_file(path).grid() for name, path in list_region_files(folders=folders).items()}
        chosen = make_split(read_split_file(find_split_file(options.split)), grids)
        cases = read_run_cases(Path(target), out=out, split=chosen, rejectors=options.rejector or ())
        inspect_run(cases, out, query, options.strip)
        return
    if region_folder is None and not is_split(target):
        from sasgeo_bench.cli.no_target import no_target  # noqa: PLC0415 - looks for all that it might be

        raise no_target(target, out, folders)
    _refuse_strip(target, options.strip)
    if query is not None:
        raise ConfigError(
            f"--query draws a query of a task or a run, and {target} is neither: leave it out, or name one of these"
        )
    if region_folder is None:
        _inspect_split(target, out, folders)
        return
    manifest = read_manifest(region_folder)
    if is_packed_map(Path(target)):
        say(f"{target}: {unpack_map(target, out).about.to_text()}")
    print_table(_summary(manifest, region_folder, _preview(manifest, region_folder, out)))
    print_table(_class_table(manifest))
    if (reasons := _reasons(manifest)).row_count:
        print_table(reasons)
    for line in differing_files(region_folder):
        tell(f"warning: {line}")


def _preview(manifest: Manifest, folder: Path, out: Path) -> Path:
    """Return the picture of a map: that of the build, or one drawn now, for maps on the way to queries have none."""
    if PREVIEW in manifest.files:
        return folder / PREVIEW
    from sasgeo_bench.regions.layers import PREVIEW_CELLS, read_overview  # noqa: PLC0415 - imports GDAL
    from sasgeo_bench.regions.preview import write_preview  # noqa: PLC0415

    path = sheet_path(out, "map", folder.name)
    path.parent.mkdir(parents=True, exist_ok=True)
    overview = read_overview(folder / LAYERS, longest_cells=PREVIEW_CELLS)
    write_preview(path, manifest=manifest, overview=overview)
    return path


def _refuse_strip(target: str, strip: int | None) -> None:
    """Refuse to draw a strip of something that holds no answers."""
    if strip is not None:
        raise ConfigError(f"--strip draws queries with their answers, and {target} holds none: name a run or a board")


def _inspect_task(task: Task, out: Path, *, query: str | None, rows: int) -> None:
    """Print what a task is and draw its contact sheet; of flights, maps of their paths, unless a view is named."""
    from sasgeo_bench.tasks import sheet  # noqa: PLC0415 - what draws takes half a second to import

    about = task.manifest
    path = sheet_path(out, *about.name, *([query] if query else []))
    is_of_view = query is not None and len(query) > SEQUENCE_DIGITS
    maps = sheet.flight_panels(task, count=rows, flight=query) if about.is_of_flights and not is_of_view else ()
    chosen = () if maps else sheet.panels_of(task, count=rows, query_id=query)
    table = Table(box=None, show_header=False, pad_edge=False)
    for name, value in about.to_json().items():
        table.add_row(name, _text_of(value))
    print_table(table)
    path.parent.mkdir(parents=True, exist_ok=True)
    if maps:
        sheet.write_flight_sheet(path, task, maps)
    else:
        sheet.write_sheet(path, title=f"{about.title}: {about.region}", panels=chosen, credit=about.provenance.credit)
    say(f"contact sheet: {path}")


def _text_of(value: object) -> str:
    """Return a value of `task.json` as text without the signs of a programming language."""
    if isinstance(value, dict):
        return ", ".join(f"{key} {_text_of(item)}" for key, item in value.items())
    return ", ".join(map(_text_of, value)) if isinstance(value, list) else str(value)


def _inspect_split(target: str, out: Path, folders: list[Path]) -> None:
    """Print the places of a split and draw their map."""
    grids = {name: read_region_file(path).grid() for name, path in list_region_files(folders=folders).items()}
    split = make_split(read_split_file(find_split_file(target)), grids)
    from sasgeo_bench.tasks.split_map import write_split_map  # noqa: PLC0415 - imports matplotlib

    say(split.to_text())
    path = out / "sheets" / f"split-{split.spec.id}.png"
    path.parent.mkdir(parents=True, exist_ok=True)
    write_split_map(path, split)
    say(f"map of parts: {path}")


def _summary(manifest: Manifest, folder: Path, preview: Path) -> Table:
    extract, coverage = manifest.extract, manifest.coverage
    graph = ", ".join(f"{name} {count}" for name, count in manifest.graph_counts.items())
    table = Table(box=None, show_header=False, pad_edge=False)
    table.add_row("region", f"{manifest.id}: {manifest.title}")
    table.add_row("folder", str(folder))
    table.add_row("scenes", ", ".join(manifest.scenes))
    table.add_row("extract", f"{extract.file}, as of {extract.date}, SHA-256 {extract.sha256}")
    table.add_row(
        "grid", f"{manifest.rows} x {manifest.cols} cells of {manifest.cell_size_m:g} m, EPSG:{manifest.epsg}"
    )
    table.add_row("mapped", f"{coverage.to_text()}; what is not mapped is unknown, not absent")
    if len(manifest.classes) < len(load_taxonomy().names):
        table.add_row("classes", f"{', '.join(manifest.classes)}; whatever is of another class is unknown")
    if manifest.imagery is not None:
        table.add_row("imagery", manifest.imagery.to_text())
    table.add_row("graph", graph)
    table.add_row("preview", str(preview))
    table.add_row("licence", f"{manifest.licence}, {manifest.attribution}")
    for title, text in manifest.provenance.titled().items():
        table.add_row(title, text)
    return table


def _class_table(manifest: Manifest) -> Table:
    table = Table("class", "objects", box=None, pad_edge=False)
    for name, count in manifest.counts.items():
        table.add_row(name, str(count))
    return table


def _reasons(manifest: Manifest) -> Table:
    table = Table("in and around the grid", "objects", box=None, pad_edge=False)
    for title, reasons in (("not visible", manifest.hidden), ("dropped", manifest.drops), ("mended", manifest.notes)):
        listed = list(reasons.items())
        for reason, count in listed[:TOP_DROPS]:
            table.add_row(f"{title}: {reason}", str(count))
        if len(listed) > TOP_DROPS:
            rest = sum(count for _, count in listed[TOP_DROPS:])
            table.add_row(f"{title}: {len(listed) - TOP_DROPS} more reasons (region.json)", str(rest))
    for warning in manifest.warnings:
        table.add_row(f"warning: {warning}", "")
    return table
