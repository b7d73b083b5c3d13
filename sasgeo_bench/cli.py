# SPDX-License-Identifier: Apache-2.0
"""The program `sasgeo-bench`: parses, calls, prints. Results go to stdout, everything else to stderr."""

import datetime as dt
import sys
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from multiprocessing import get_context
from pathlib import Path
from typing import Annotated, Final

import typer
from rich.console import Console
from rich.table import Table

from sasgeo_bench.ageing.measure import measure_ageing
from sasgeo_bench.build import BuildPlan, build_region, plan_build
from sasgeo_bench.doctor import examine
from sasgeo_bench.duplicates import constellations, search_split
from sasgeo_bench.errors import ConfigError, SasgeoError
from sasgeo_bench.extract.history import MARGIN_M, date_extracts, read_history
from sasgeo_bench.extract.scan import Box
from sasgeo_bench.plugins import list_entry_points
from sasgeo_bench.query import PriorGroup
from sasgeo_bench.region import Manifest
from sasgeo_bench.request import Request, Wanted, plan_requests
from sasgeo_bench.run.runner import RunRequest, plan_run, run
from sasgeo_bench.run.worker import Limits
from sasgeo_bench.scaffold import plugin_files
from sasgeo_bench.split import make_split
from sasgeo_bench.store.ageingfile import read_ageing, write_ageing, write_summary
from sasgeo_bench.store.catalog import (
    find_region_file,
    find_split_file,
    list_region_files,
    list_split_files,
    read_region_file,
    read_split_file,
)
from sasgeo_bench.store.pluginfiles import write_plugin
from sasgeo_bench.store.ratebookfile import write_ratebook
from sasgeo_bench.store.regiondir import differing_files, read_features, read_manifest
from sasgeo_bench.store.rundir import merge_runs
from sasgeo_bench.store.sheet import write_sheet
from sasgeo_bench.store.splitmap import write_split_map
from sasgeo_bench.store.taskdir import TASK, read_task
from sasgeo_bench.suites.all_suites import SUITES, find_suite
from sasgeo_bench.tasks import check_task, has_truths, make_tasks, panels
from sasgeo_bench.testing import check_matcher
from sasgeo_bench.validate import validate

EXIT_USER: Final = 2
EXIT_INTERRUPTED: Final = 130
TOP_DROPS: Final = 12
PIPE_WIDTH: Final = 200

app = typer.Typer(no_args_is_help=True, pretty_exceptions_enable=False, add_completion=False, help=__doc__)
errors = Console(stderr=True, soft_wrap=True, highlight=False, emoji=False)

Out = Annotated[Path, typer.Option(envvar="SASGEO_OUT", help="root of what is built")]
RegionFolders = Annotated[list[Path] | None, typer.Option("--regions", help="folder with region files of your own")]
ExtractFolders = Annotated[
    list[Path] | None,
    typer.Option("--extracts", help="folder to search for extracts, before SASGEO_EXTRACTS and the user's cache"),
]


@app.command("build-region")
def build_region_command(
    region: Annotated[list[str], typer.Argument(help="ids from list-regions, or files of your own (*.toml)")],
    date: Annotated[
        str | None, typer.Option(help="YYYY-MM-DD of one of the region's extracts; default: newest")
    ] = None,
    extracts: ExtractFolders = None,
    regions: RegionFolders = None,
    out: Out = Path("out"),
    *,
    dry_run: Annotated[bool, typer.Option("--dry-run", help="say what would be read and written, and stop")] = False,
    jobs: Annotated[int, typer.Option(min=1, help="regions built at once")] = 1,
) -> None:
    """Build regions from dated extracts: layers, features, graph, manifest and preview in OUT/regions/<id>/."""
    day = _date(date)
    plans = [_plan(name, out=out, date=day, extracts=extracts, regions=regions) for name in region]
    if dry_run:
        typer.echo("\n".join(plan.to_text() for plan in plans))
        return
    if jobs == 1 or len(plans) == 1:
        for plan in plans:
            build_region(plan, tell=_tell)
        return
    with ProcessPoolExecutor(max_workers=jobs, mp_context=get_context("spawn")) as pool:
        for _ in pool.map(_build_quietly, plans):
            pass


def _build_quietly(plan: BuildPlan) -> None:
    """Build in a process of its own; only there because a process pool needs a function it can name."""
    build_region(plan, tell=_tell)


def _plan(
    name: str, *, out: Path, date: dt.date | None, extracts: list[Path] | None, regions: list[Path] | None
) -> BuildPlan:
    spec = read_region_file(find_region_file(name, folders=regions or ()))
    return plan_build(spec, out=out, date=date, extract_folders=extracts or ())


def _date(text: str | None) -> dt.date | None:
    return _day(text, flag="--date") if text else None


def _day(text: str, *, flag: str) -> dt.date:
    try:
        return dt.date.fromisoformat(text)
    except ValueError as error:
        message = f"{flag} must be a date as in 2021-10-28, got {text!r}"
        raise ConfigError(message) from error


def _tell(line: str) -> None:
    errors.print(line, markup=False)


@app.command("measure-ageing")
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
    box = _box(bounds)
    dated = date_extracts(extract, at=[_day(text, flag="--at") for text in at or ()])
    history = read_history(dated, bounds=box, margin_m=margin_m, tell=_tell)
    name = place or extract[0].name.split(".")[0].split("-")[0]
    for path in write_ageing(out, measure_ageing(history, place=name)):
        typer.echo(path)


def _box(text: str | None) -> Box | None:
    if text is None:
        return None
    try:
        west, south, east, north = (float(part) for part in text.split(","))
    except ValueError:
        west, south, east, north = 0.0, 0.0, 0.0, 0.0
    if not (-180 <= west < east <= 180 and -90 <= south < north <= 90):  # noqa: PLR2004 - degrees on a sphere
        message = f"--bounds must be west,south,east,north in degrees as in 9.47,47.05,9.64,47.27, got {text!r}"
        raise ConfigError(message)
    return (west, south, east, north)


@app.command("compare-ageing")
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
    typer.echo(write_summary(out, places, controls))
    if rates is not None:
        typer.echo(write_ratebook(rates, places))


@app.command("list-regions")
def list_regions_command(regions: RegionFolders = None) -> None:
    """List the regions that come with the package, and your own."""
    table = Table("id", "title", "km2", "cell", "dates", "scenes", box=None, pad_edge=False)
    for name, path in sorted(list_region_files(folders=regions or ()).items()):
        spec = read_region_file(path)
        grid = spec.grid()
        area_km2 = grid.rows * grid.cols * grid.cell_size_m**2 / 1e6
        dates = [extract.date.isoformat() for extract in spec.extract]
        shown = dates[0] if len(dates) == 1 else f"{dates[0]} .. {dates[-1]} ({len(dates)})"
        table.add_row(name, spec.title, f"{area_km2:.1f}", f"{grid.cell_size_m:g} m", shown, ", ".join(spec.scenes))
    _print(table)


@app.command("list-suites")
def list_suites_command() -> None:
    """List the suites: what each does and what it separates."""
    table = Table("suite", "title", "tracks", "per site", "separates", box=None, pad_edge=False)
    for name, suite in SUITES.items():
        card = suite.card
        table.add_row(
            name, card.title, ", ".join(card.tracks), str(len(suite.variants) * len(card.tracks)), card.separates
        )
    _print(table)


@app.command("make-queries")
def make_queries_command(  # noqa: PLR0913 - a command has as many flags as its users need
    *,
    suite: Annotated[
        list[str] | None, typer.Option(help="name from list-suites; may be repeated; default: all")
    ] = None,
    regions: Annotated[
        list[str] | None,
        typer.Option(
            "--regions", help="id from list-regions, or own file; may be repeated; default: all that can be built"
        ),
    ] = None,
    split: Annotated[str, typer.Option(help="id of a shipped split, or a file of your own (*.toml)")] = "crossfit",
    n: Annotated[int, typer.Option(help="sites in each region; each carries all the variants of a suite")] = 8,
    seed: Annotated[int, typer.Option(help="root of all chance")] = 0,
    prior: Annotated[
        str | None, typer.Option(help="prior group, as in r500-weak-s3; default: that of the suite")
    ] = None,
    extracts: ExtractFolders = None,
    region_folders: Annotated[
        list[Path] | None, typer.Option("--region-files", help="folder with region files of your own")
    ] = None,
    out: Out = Path("out"),
    up_to: Annotated[bool, typer.Option("--up-to", help="fewer sites where a region does not hold n")] = False,
    skip: Annotated[bool, typer.Option("--skip", help="pass over what a region cannot carry, and say so")] = False,
    dry_run: Annotated[bool, typer.Option("--dry-run", help="say what would be drawn and written, and stop")] = False,
    jobs: Annotated[int, typer.Option(min=1, help="regions at once")] = 1,
) -> None:
    """Draw queries into OUT/tasks/<suite>/<region>/ and their truths into OUT/truth/<suite>/<region>/."""
    wanted = Wanted(
        suites=tuple(suite or SUITES),
        regions=tuple(regions or ()),
        split=split,
        count=n,
        seed=seed,
        group=PriorGroup.parse(prior) if prior else None,
        extract_folders=tuple(extracts or ()),
        region_folders=tuple(region_folders or ()),
        out=out,
        may_be_fewer=up_to,
    )
    requests = plan_requests(wanted, tell=_tell)
    if dry_run:
        for item in requests:
            per_site = len(find_suite(item.suite).variants) * len(find_suite(item.suite).card.tracks)
            folder = item.out / "tasks" / item.suite / item.region.id
            most = f"at most {item.count} sites, {item.count * per_site} queries"
            typer.echo(f"{item.suite} on {item.region.id}: {most}, {folder}")
        return
    by_region: dict[str, list[Request]] = {}
    for item in requests:
        by_region.setdefault(item.region.id, []).append(item)
    work = partial(_make_all, skip=skip)
    if jobs == 1 or len(by_region) == 1:
        for items in by_region.values():
            work(items)
        return
    with ProcessPoolExecutor(max_workers=jobs, mp_context=get_context("spawn")) as pool:
        for _ in pool.map(work, by_region.values()):
            pass


def _make_all(requests: list[Request], *, skip: bool) -> None:
    """Make the tasks of one region in turn."""
    for request in requests:
        try:
            make_tasks(request, tell=_tell)
        except ConfigError as error:
            if not skip:
                raise
            _tell(f"{request.suite} on {request.region.id}: passed over, {error}")


@app.command("inspect")
def inspect_command(
    target: Annotated[str, typer.Argument(help="a built region, a task (SUITE/REGION), a split, or the folder of one")],
    query: Annotated[str | None, typer.Option(help="of a task: this query alone, by the beginning of its id")] = None,
    rows: Annotated[int, typer.Option(min=1, max=60, help="of a task: queries on the contact sheet")] = 12,
    region_folders: RegionFolders = None,
    out: Out = Path("out"),
) -> None:
    """Say what is in a region, a task or a split; of a task draw a contact sheet, of a split its map."""
    folder = Path(target) if Path(target).is_dir() else out / "tasks" / target
    if (folder / TASK).is_file():
        _inspect_task(folder, out, query=query, rows=rows)
        return
    _check_target(target, out)
    if target.endswith(".toml") or target in list_split_files():
        _inspect_split(target, out, region_folders or [])
        return
    folder = Path(target) if Path(target).is_dir() else out / "regions" / target
    manifest = read_manifest(folder)
    _print(_summary(manifest, folder))
    _print(_class_table(manifest))
    _print(_reasons(manifest))


def _check_target(target: str, out: Path) -> None:
    """Refuse a task that is not there by naming those that are."""
    suite, _, region = target.partition("/")
    if suite not in SUITES or (region and Path(target).is_dir()):
        return
    made = sorted(path.parent.name for path in (out / "tasks" / suite).glob(f"*/{TASK}"))
    near = [name for name in made if name.split("+")[0].split("@")[0] == region.split("+")[0].split("@")[0]] or made
    there = ", ".join(f"{suite}/{name}" for name in near[:8]) or "none of this suite: make-queries first"
    message = f"{out / 'tasks'} holds no task {target}; there is {there}"
    raise ConfigError(message)


def _inspect_task(folder: Path, out: Path, *, query: str | None, rows: int) -> None:
    """Print what a task is and draw its contact sheet."""
    about = read_task(folder)
    table = Table(box=None, show_header=False, pad_edge=False)
    for name, value in about.items():
        table.add_row(
            name, ", ".join(f"{key} {item}" for key, item in value.items()) if isinstance(value, dict) else str(value)
        )
    _print(table)
    truth_folder = out / "truth" / about["suite"] / about["region"]
    chosen = panels(folder, truth_folder, out=out, count=rows, query_id=query)
    path = out / "sheets" / f"{about['suite']}-{about['region']}{f'-{query}' if query else ''}.png"
    path.parent.mkdir(parents=True, exist_ok=True)
    write_sheet(path, title=f"{about['title']}: {about['region']}", panels=chosen)
    typer.echo(f"contact sheet: {path}")


def _inspect_split(target: str, out: Path, folders: list[Path]) -> None:
    """Print the places of a split and draw their map."""
    grids = {name: read_region_file(path).grid() for name, path in list_region_files(folders=folders).items()}
    split = make_split(read_split_file(find_split_file(target)), grids)
    typer.echo(split.to_text())
    path = out / "sheets" / f"split-{split.spec.id}.png"
    path.parent.mkdir(parents=True, exist_ok=True)
    write_split_map(path, split)
    typer.echo(f"map of parts: {path}")


def _summary(manifest: Manifest, folder: Path) -> Table:
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
    table.add_row("mapped", f"{coverage.share:.1%} of the grid ({coverage.source}); the rest is unknown, not absent")
    table.add_row("graph", graph)
    table.add_row("preview", str(folder / "preview.png"))
    table.add_row("licence", f"{manifest.licence}, {manifest.attribution}")
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


@app.command("verify")
def verify_command(
    target: Annotated[str, typer.Argument(help="a built region, a task (SUITE/REGION), a split, or the folder of one")],
    region_folders: RegionFolders = None,
    out: Out = Path("out"),
) -> None:
    """Hold a region or a task against its hashes; search the parts of a split for ground they share."""
    task_folder = Path(target) if Path(target).is_dir() else out / "tasks" / target
    if (task_folder / TASK).is_file():
        with_truths = "every query has its truth" if has_truths(task_folder, out=out) else "its truths are not here"
        faults, good = check_task(task_folder, out=out), f"all files are as task.json says, and {with_truths}"
    elif target.endswith(".toml") or target in list_split_files():
        faults, good = _shared_ground(target, out, region_folders or [])
    else:
        folder = Path(target) if Path(target).is_dir() else out / "regions" / target
        faults, good = differing_files(folder), "all files are as the manifest says"
    for line in faults:
        typer.echo(line)
    if faults:
        raise typer.Exit(EXIT_USER)
    typer.echo(f"{target}: {good}")


def _shared_ground(target: str, out: Path, folders: list[Path]) -> tuple[list[str], str]:
    """Ground that parts of a split share, and what was searched."""
    grids = {name: read_region_file(path).grid() for name, path in list_region_files(folders=folders).items()}
    split = make_split(read_split_file(find_split_file(target)), grids)
    built = [region for region in split.spec.region_ids if (out / "regions" / region).is_dir()]
    missing = [region for region in split.spec.region_ids if region not in built]
    if missing:
        _tell(f"{len(missing)} regions are not built and not searched: {', '.join(missing)}")
    if len({split.part_of(place) for place, blocks in split.blocks.items() if blocks[0].region in built}) < 2:  # noqa: PLR2004
        message = (
            f"{out / 'regions'} holds regions of fewer than two parts of split {split.spec.id!r}: build-region more"
        )
        raise ConfigError(message)
    maps = {region: constellations(read_features(out / "regions" / region)) for region in built}
    faults = [
        f"{item.first} and {item.second} of different parts hold the same ground: {item.count} buildings lie alike"
        for item in search_split(split, maps)
    ]
    return faults, f"no two parts share ground, {len(built)} regions searched"


@app.command("list-matchers")
def list_matchers_command() -> None:
    """List the matchers that are installed, and where each comes from."""
    table = Table("matcher", "package", "class", box=None, pad_edge=False)
    for name, point in list_entry_points().items():
        table.add_row(name, point.dist.name if point.dist is not None else "", point.value)
    _print(table)


@app.command("new-matcher")
def new_matcher_command(
    name: Annotated[str, typer.Argument(help="of the matcher, as in my-matcher")],
    folder: Annotated[Path | None, typer.Option("--into", help="an empty folder; default: one of that name")] = None,
) -> None:
    """Write a plugin package that passes check-matcher at once, for you to put your method into."""
    files = plugin_files(name)
    target = folder or Path(name)
    write_plugin(target, files)
    typer.echo(f"{target}: {len(files)} files; next: pip install -e {target} && sasgeo-bench check-matcher {name}")


@app.command("check-matcher")
def check_matcher_command(
    matcher: Annotated[str, typer.Argument(help="name from list-matchers, or module:Class")],
) -> None:
    """Try a matcher on a tiny town and say, row by row, whether it keeps to what all of them keep to."""
    table = Table("check", "outcome", "found", box=None, pad_edge=False)
    failed = 0
    for check in check_matcher(matcher):
        failed += check.outcome == "fail"
        table.add_row(check.name, check.outcome, check.found)
    _print(table)
    if failed:
        _tell(f"{matcher}: {failed} checks failed")
        raise typer.Exit(EXIT_USER)


@app.command("run")
def run_command(  # noqa: PLR0913 - a command has as many flags as its users need
    *,
    matcher: Annotated[str, typer.Option(help="name from list-matchers, or module:Class")],
    tasks: Annotated[list[Path], typer.Option(help="task folder, OUT/tasks/SUITE/REGION; may be repeated")],
    top_k: Annotated[int, typer.Option(help="poses asked of each query")] = 25,
    jobs: Annotated[int, typer.Option(help="processes at once")] = 1,
    shard: Annotated[str, typer.Option(help="i/n: answer the i-th of n parts of the queries")] = "1/1",
    limit: Annotated[int | None, typer.Option(help="queries of each task at most")] = None,
    match_s: Annotated[float, typer.Option(help="seconds for one query")] = Limits().match_s,
    prepare_s: Annotated[float, typer.Option(help="seconds for one map")] = Limits().prepare_s,
    memory_mb: Annotated[int, typer.Option(help="MiB for all processes of the matcher")] = Limits().memory_bytes
    // 2**20,
    again: Annotated[list[str] | None, typer.Option(help="ask rows of this status again, as in timeout")] = None,
    trusted: Annotated[bool, typer.Option("--trusted", help="do not shut the matcher in; run.json says so")] = False,
    dry_run: Annotated[bool, typer.Option("--dry-run", help="say what is left to do, and stop")] = False,
    out: Out = Path("out"),
) -> None:
    """Ask a matcher every query of some tasks; goes on where an earlier run was cut off."""
    request = RunRequest(
        spec=matcher,
        tasks=tasks,
        out=out,
        top_k=top_k,
        limits=Limits(match_s=match_s, prepare_s=prepare_s, memory_bytes=memory_mb * 2**20),
        jobs=jobs,
        shard=_shard(shard),
        limit=limit,
        again=tuple(again or ()),
        is_shut_in=not trusted,
    )
    plan = plan_run(request)
    if dry_run:
        typer.echo(plan.to_text())
        return
    report = run(plan, tell=_tell)
    counts = ", ".join(f"{count} {status}" for status, count in sorted(report.counts.items())) or "nothing left"
    _tell(f"{plan.card.name} {plan.card.version}: {counts}")
    for folder in report.folders:
        typer.echo(str(folder))


def _shard(text: str) -> tuple[int, int]:
    index, _, count = text.partition("/")
    if not (index.isdecimal() and count.isdecimal() and text.isascii()):
        message = f"--shard must be i/n, as in 1/2, got {text!r}"
        raise ConfigError(message)
    return int(index), int(count)


@app.command("merge")
def merge_command(
    *,
    runs: Annotated[list[Path], typer.Option(help="folder of parts, or file; may be repeated")],
    into: Annotated[Path, typer.Option(help="predictions file to write")],
) -> None:
    """Put the parts of a run, shards of several machines included, into one predictions file, sorted by query."""
    count = merge_runs(runs, into)
    typer.echo(f"{into}: {count} predictions")


@app.command("validate")
def validate_command(
    *,
    predictions: Annotated[Path, typer.Option(help="predictions file, or the folder of a run")],
    tasks: Annotated[list[Path], typer.Option(help="task folder; may be repeated")],
) -> None:
    """List everything in which predictions are not what the tasks ask for."""
    count = 0
    for violation in validate(predictions, tasks):
        typer.echo(violation.to_text())
        count += 1
    if count:
        _tell(f"{predictions}: {count} violations")
        raise typer.Exit(EXIT_USER)
    typer.echo(f"{predictions}: answers every query of {len(tasks)} tasks, and nothing else")


@app.command("doctor")
def doctor_command(extracts: ExtractFolders = None, out: Out = Path("out")) -> None:
    """Say which versions, folders and extracts are found, and what is missing."""
    table = Table(box=None, show_header=False, pad_edge=False)
    for name, finding in examine(extracts or (), out=out):
        table.add_row(name, finding)
    _print(table)


def _print(table: Table) -> None:
    """Print to stdout: as wide as the terminal there, unwrapped into a file or pipe."""
    console = Console(highlight=False, width=None if sys.stdout.isatty() else PIPE_WIDTH, markup=False)
    with console.capture() as captured:
        console.print(table)
    typer.echo("\n".join(line.rstrip() for line in captured.get().splitlines()) + "\n")


def main() -> None:
    """Run the program: 0 done, 2 the user's mistake on one line, 1 our bug with a traceback."""
    try:
        app()
    except SasgeoError as error:
        errors.print(f"sasgeo-bench: {error}", markup=False)
        sys.exit(EXIT_USER)
    except SystemExit as leaving:
        if leaving.code == EXIT_INTERRUPTED:  # typer turns Ctrl-C into this exit without a word
            errors.print("sasgeo-bench: interrupted; what was there before is as it was")
        raise
