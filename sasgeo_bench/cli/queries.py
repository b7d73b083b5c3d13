# SPDX-License-Identifier: Apache-2.0
"""Draw queries: the function and its command."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Annotated, get_args

import typer

from sasgeo_bench.cli.console import say, shown_progress
from sasgeo_bench.cli.options import Dask, ExtractFolders, Options, Out, OwnRegionFolders, takes
from sasgeo_bench.cli.seeds import SeedFile, private_seed
from sasgeo_bench.core.errors import ConfigError
from sasgeo_bench.core.progress import reported, spread, tell
from sasgeo_bench.flights.logs import FlownPath, OdometryOf
from sasgeo_bench.osm.taxonomy import load_taxonomy
from sasgeo_bench.tasks import build
from sasgeo_bench.tasks.perturbations.perception_profile import read_profile
from sasgeo_bench.tasks.query import PROFILE, Detector, PriorGroup
from sasgeo_bench.tasks.suites.all_suites import SUITES
from sasgeo_bench.tasks.suites.base import Choice
from sasgeo_bench.tasks.task_plan import SPLIT, Request, TaskRequest, plan_requests, root_of


@dataclass(frozen=True, kw_only=True)
class QueryOptions(Options):
    """Flags of make-queries."""

    suite: Annotated[
        list[str] | None, typer.Option(help="name from list suites; may be repeated; default: all but controls")
    ] = None
    regions: Annotated[
        list[str] | None,
        typer.Option(
            "--regions", help="id from list regions, or own file; may be repeated; default: all that can be built"
        ),
    ] = None
    split: Annotated[
        str | None,
        typer.Option(
            help=f"id of a shipped split, or a file of your own (*.toml); default: {SPLIT}; an own place is all test"
        ),
    ] = None
    n: Annotated[int, typer.Option(help="sites in each region; each carries all the variants of a suite")] = 8
    seed: Annotated[int | None, typer.Option(min=0, help="public random seed; default: 0")] = None
    seed_file: SeedFile = None
    prior: Annotated[
        str | None,
        typer.Option(help="prior group, as in r500-weak-s3, of flights also gnss; default: that of the suite"),
    ] = None
    detector: Annotated[
        list[str] | None,
        typer.Option(
            help="family of errors: published, measured or silent, of pictures rendered or shifted; may be repeated, "
            "for pairs"
        ),
    ] = None
    profile: Annotated[
        Path | None,
        typer.Option(help="perception profile of a segmenter (*.toml); its errors are the detector 'profile'"),
    ] = None
    extracts: ExtractFolders = None
    region_files: OwnRegionFolders = None
    out: Out = Path("out")
    flight: Annotated[
        Path | None,
        typer.Option(help="log of a flight that was flown, for suites of flights; it is their one site"),
    ] = None
    height: Annotated[float | None, typer.Option(help="of that flight above the ground, instead of the log's")] = None
    odometry: Annotated[
        OdometryOf,
        typer.Option(
            help="of that flight: of its log where this fused no GNSS, or drawn by a profile of drift (drawn)"
        ),
    ] = "log"
    drift: Annotated[
        str | None,
        typer.Option(
            help="profile of drift that its odometry declares, and is drawn by: a file of measure-drift --profile, or "
            "a name, as vio-mono; default: that of the suite"
        ),
    ] = None
    up_to: Annotated[bool, typer.Option("--up-to", help="fewer sites where a region does not hold n")] = False
    skip: Annotated[bool, typer.Option("--skip", help="pass over what a region cannot carry, and say so")] = False
    dry_run: Annotated[bool, typer.Option("--dry-run", help="say what would be drawn and written, and stop")] = False
    jobs: Annotated[int, typer.Option(min=1, help="tasks drawn at once")] = 1
    dask: Dask = None


@takes(QueryOptions)
def make_tasks(options: QueryOptions) -> tuple[Path, ...]:
    """Draw the queries of suites on regions, and their truths; regions that are not built yet are built.

    Returns
    -------
    tuple of Path
        Task folders, `out/tasks/<suite>/<region>`; the truths lie in `out/truth/<suite>/<region>`.

    Raises
    ------
    ConfigError
        If a suite, region or split is unknown, a profile cannot be read, or a region cannot carry a suite (unless
        `skip`).
    ExtractError
        If a region cannot be built since its extract is missing.

    Examples
    --------
    >>> import sasgeo_bench as sgb
    >>> folders = sgb.make_tasks(suite="clean", regions="town-grid", n=4, dry_run=True, say=print)
    clean on town-grid: at most 4 sites, 112 queries, out/tasks/clean/town-grid
    """
    private = private_seed(options.seed_file, public=options.seed)
    wanted = TaskRequest(
        suites=tuple(options.suite or SUITES),
        regions=tuple(options.regions or ()),
        split=options.split,
        count=options.n if options.flight is None else 1,
        seed=private or options.seed or 0,
        group=PriorGroup.parse(options.prior) if options.prior else None,
        extract_folders=tuple(options.extracts or ()),
        region_folders=tuple(options.region_files or ()),
        out=root_of(options.out, private),
        may_be_fewer=options.up_to,
        choice=_choice(options),
        flown=_flown(options),
    )
    requests = plan_requests(wanted)
    if options.dry_run:
        for item in requests:
            options.say(_in_words(item))
        return tuple(map(_folder, requests))
    make = partial(_make, skip=options.skip)
    made = spread(reported(make), requests, jobs=options.jobs, dask=options.dask, label="tasks drawn")
    return tuple(folder for folders in made for folder in folders)


def make_queries_command(options: QueryOptions) -> None:
    """Draw queries into OUT/tasks/<suite>/<region>/ and their truths into OUT/truth/<suite>/<region>/."""
    with shown_progress():
        make_tasks(**vars(options) | {"say": say})


def _flown(options: QueryOptions) -> FlownPath | None:
    if options.flight is None:
        for name in ("height", "odometry", "drift"):
            if getattr(options, name) not in (None, "log"):
                raise ConfigError(f"--{name} is of a flight: name its log by --flight")
        return None
    return FlownPath(file=options.flight, height_m=options.height, odometry=options.odometry, drift=options.drift)


def _folder(request: Request) -> Path:
    return request.out / "tasks" / request.suite / request.region.id


def _choice(options: QueryOptions) -> Choice:
    """Return the chosen detectors; a profile is one of them."""
    if options.profile is None:
        return Choice(detectors=_detectors(options.detector))
    profile = read_profile(options.profile)
    lost = [name for name in load_taxonomy().names if name not in profile.classes]
    if lost:
        instead = "is unknown in all views" if profile.silence else "views show that without errors"
        tell(f"{options.profile} has no rates of {', '.join(lost)}: {instead}")
    return Choice(detectors=_detectors([*(options.detector or ()), PROFILE]), profile=profile)


def _detectors(names: Sequence[str] | None) -> tuple[Detector, ...]:
    """Return the detectors of some names, each once; raise a ConfigError if there is no such detector."""
    known = get_args(Detector)
    for name in names or ():
        if name not in known:
            raise ConfigError(f"--detector {name!r} is unknown: {' or '.join(known)}")
    return tuple(name for name in known if name in names) if names else Choice().detectors


def _in_words(request: Request) -> str:
    named = (
        "flights" if "sequence" in request.found.card.tracks else "queries"
    )  # the ground decides how many views one has
    most = f"at most {request.count} sites, {request.most} {named}"
    return f"{request.suite} on {request.region.id}: {most}, {_folder(request)}"


def _make(request: Request, *, skip: bool) -> list[Path]:
    """Make the tasks of one suite on one region."""
    try:
        return [made.folder for made in build.make_tasks(request)]
    except ConfigError as error:
        if not skip:
            raise
        tell(f"{request.suite} on {request.region.id}: passed over, {error}")
        return []
