# SPDX-License-Identifier: Apache-2.0
"""Queries and truths of a request on disk, and checks that tasks, truths and maps belong together."""

import datetime as dt
import hashlib
import json
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from contextlib import AbstractContextManager
from dataclasses import asdict, dataclass, replace
from importlib.metadata import version
from pathlib import Path
from typing import Final

import numpy as np

from sasgeo_bench.ageing.ratebook import load_ratebook, pool_rates
from sasgeo_bench.core.errors import ConfigError, SasgeoError, StoreError, counted
from sasgeo_bench.core.folders import fresh_folder, locked
from sasgeo_bench.core.progress import reporting, spread, tell
from sasgeo_bench.regions import region_files
from sasgeo_bench.regions.build import build_region, plan_build
from sasgeo_bench.regions.layers import read_bits
from sasgeo_bench.regions.region import Region
from sasgeo_bench.regions.region_spec import RegionFile
from sasgeo_bench.sensing.rendering.palettes import Family
from sasgeo_bench.tasks import task_files
from sasgeo_bench.tasks.edited_maps import changed_maps, degraded_map, edit_maps, nothing_to_ask
from sasgeo_bench.tasks.flight_sampling import Airspace, FlightDrawer, LoggedFlight
from sasgeo_bench.tasks.frame_files import LABELS
from sasgeo_bench.tasks.perturbations.ageing import Ageing
from sasgeo_bench.tasks.perturbations.perception import silent_profile
from sasgeo_bench.tasks.pictured_ground import PicturedGround
from sasgeo_bench.tasks.private_seed import seed_record
from sasgeo_bench.tasks.query import SILENT, TASK_VERSION, Query, Truth, base_of
from sasgeo_bench.tasks.sampling import Drawer, Job
from sasgeo_bench.tasks.split import Block, Split
from sasgeo_bench.tasks.state import State
from sasgeo_bench.tasks.suites.ages import ageing_of
from sasgeo_bench.tasks.suites.all_suites import suite_code
from sasgeo_bench.tasks.suites.base import EVERYTHING, Scene, Seeds, Site, Suite
from sasgeo_bench.tasks.suites.flights import FlightSuite
from sasgeo_bench.tasks.suites.sites import choose_sites, largest_scale
from sasgeo_bench.tasks.task_files import Task, TaskOrigin, TruthManifest
from sasgeo_bench.tasks.task_plan import Request, check_count, check_roots, check_separate, older_dates

_SKIP: Final = " (--skip passes on to the next suite)"


def make_tasks(request: Request) -> tuple[Task, ...]:
    """Draw a suite's queries on a region; write a task for each searched map, for real ageing each older one.

    Raises
    ------
    ConfigError
        If there is no such suite, the count is not positive, or the region cannot carry the suite or so many sites;
        nothing is written.
    """
    with _locked(request):
        return _make_tasks(request)


def _locked(request: Request) -> AbstractContextManager[None]:
    """Lock a request from start to end, since a second run of it would change the map that this one uses."""
    check_count(request.count)
    check_roots(request.out)
    # The lock is where maps are built, so that a refused request leaves nothing among tasks.
    return locked(request.out / "regions" / f"{request.region.id}+{request.suite}.request")


def ensure_tasks(request: Request) -> tuple[Path, ...]:
    """Return the task folders of a request; draw them unless they are up to date. Raise as `make_tasks` does."""
    made = made_tasks(request)
    if made is None:
        with _locked(request):
            made = made_tasks(request) or tuple(task.folder for task in _make_tasks(request))
    return made


def made_tasks(request: Request) -> tuple[Path, ...] | None:
    """Return the task folders that this very request has made, or None if it has to be drawn.

    They are unchanged, request and program version are the same, and a build would give the map they search.
    """
    sha256 = _request_sha256(request)
    drawn = {name: record for name, record in _records(request).items() if record.request_sha256 == sha256}
    if not drawn or any(record.maps != len(drawn) for record in drawn.values()):
        return None
    folders = tuple(request.out / "tasks" / request.suite / name for name in drawn)
    try:
        tasks = [Task.open(folder, request.out) for folder in folders]
        if any(check_task(task) or not task.has_truths for task in tasks):
            return None
    except StoreError:
        return None
    plan = plan_build(request.region, out=request.out, extract_folders=request.extract_folders)
    return folders if plan.is_current else None


def why_to_draw(request: Request) -> str:
    """Return in a few words why a request has to be drawn."""
    records = [record for record in _records(request).values() if record.model_fields_set]
    if not records:
        return "not there yet"
    if any(record.request_sha256 == _request_sha256(request) for record in records):
        return "task, truths or map changed since"
    if all(record.model_copy(update=seed_record(request.seed)) != record for record in records):
        return "drawn with another seed"
    counts = [record.count for record in records]
    if not {request.count, None} & set(counts):
        return f"drawn with sites = {counts[0]}, now {request.count}"
    return "drawn by other settings or an older version"


def _records(request: Request) -> dict[str, TruthManifest]:
    """Return by map the contents of `truth.json` of a request's suite and region."""
    folders = sorted((request.out / "truth" / request.suite).glob(f"{request.region.id}*"))
    return {path.name: TruthManifest.read(path) for path in folders if is_of_region(path.name, request.region.id)}


def is_of_region(name: str, region: str) -> bool:
    """Return whether a map is that of a region, or an older date or an edit of it."""
    return base_of(name) == region


def _request_sha256(request: Request) -> str:
    content = {
        "suite": [request.suite, request.found.card.version, TASK_VERSION, *_foreign_code(request)],
        "region": request.region.model_dump(mode="json"),
        "elsewhere": request.elsewhere and request.elsewhere.model_dump(mode="json"),
        # Halves decide only where methods train, countries how rows cluster: changing them redraws nothing. What is
        # sealed has its own seed. Who lends its imagery is `elsewhere`.
        "split": request.split.spec.model_dump(
            mode="json", exclude={"place": {"__all__": {"half", "country", "sealed"}}, "lends": True}
        ),
        "count": [request.count, request.may_be_fewer],
        "seed": request.seed if isinstance(request.seed, int) else request.seed.commitment,
        "group": None if request.group is None else request.group.name,
        "made_by": version("sasgeo-bench"),
    }
    if request.flown is not None:
        content["flown"] = request.flown.key
    if request.choice != EVERYTHING:  # tasks that are older than this field stay valid
        choice = asdict(replace(request.choice, profile=None))
        del choice["profile"]
        if request.choice.detectors == EVERYTHING.detectors:
            del choice["detectors"]
        if request.choice.profile is not None:
            choice["profile"] = request.choice.profile.model_dump(mode="json")
        if SILENT in request.choice.detectors:
            choice["silent"] = silent_profile().model_dump(mode="json")
        content["choice"] = choice
    return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()


def _foreign_code(request: Request) -> tuple[str, ...]:
    """Return the hash of a suite that is not ours: another code draws other queries."""
    code = suite_code(request.suite_spec or request.suite)
    return () if code is None else (code,)


def _make_tasks(request: Request) -> tuple[Task, ...]:
    drawer, sites = plan_draw(request)
    return tuple(_write(request, drawer, sites))


def plan_draw(request: Request) -> tuple[Drawer | FlightDrawer, list[Site]]:
    """Return what draws the queries of a request, and the sites where it does; missing maps are built.

    Raise `ConfigError` if the region cannot carry the suite or so many sites.
    """
    suite = request.found
    suite = replace(suite, variants=suite.fitting(request.region.largest_view_m))
    refusal = None if request.group is None else suite.refusal(request.group)
    if refusal is not None:
        raise ConfigError(f"suite {suite.card.name!r} {refusal}")
    scene, base = read_scene(request, suite)
    reason = suite.lack(scene)
    if reason is not None:
        raise ConfigError(f"{request.region.id} cannot carry suite {suite.card.name!r}: {reason}{_SKIP}")
    group = request.group or suite.card.group
    seeds = Seeds(root=request.seed, names=(request.region.id, suite.card.name, str(suite.card.version)))
    suite = replace(suite, variants=suite.usable(scene))
    if isinstance(suite, FlightSuite):
        over = base if scene.pictured is None else base.within(scene.pictured.footprint)
        flown = None
        if request.flown is not None:
            flown = LoggedFlight.of(request.flown, over, margin_m=suite.clear_m(scene), group=group)
            seeds = seeds.under("flown", request.flown.key)  # another log has other ids: no answer fits both
        airspace = Airspace(
            region=over, scene=scene, suite=suite, split=request.split, seeds=seeds, group=group, flown=flown
        )
        flights = airspace.choose(count=request.count, may_be_fewer=request.may_be_fewer)
        airspace = replace(airspace, scene=replace(scene, others=scene.others + changed_maps(request, base, flights)))
        pilot = FlightDrawer.of(airspace, flights, request.choice)
        return pilot, [flight.site for flight in flights.values()]
    sites = choose_sites(scene, suite, count=request.count, seeds=seeds, group=group, may_be_fewer=request.may_be_fewer)
    drawer = Drawer(suite=suite, scene=scene, seeds=seeds, group=group, split=request.split, choice=request.choice)
    drawer, edited = edit_maps(request, drawer, base, sites)
    return drawer, list(edited)


def _view_reach_m(request: Request, suite: Suite) -> float:
    """Return the reach of views from their centre; refuse one that the split does not allow for."""
    largest_m = max(variant.side_m for variant in suite.variants)
    reach_m = largest_m / 2 * float(np.sqrt(2)) * largest_scale(request.group or suite.card.group)
    allowed_m = request.split.spec.reach_m
    if reach_m > allowed_m:
        raise ConfigError(
            f"views of {largest_m:g} m reach up to {reach_m:.0f} m beyond a block, the split {allowed_m:g} m: "
            "use a split with a larger reach_m"
        )
    return reach_m


def read_scene(request: Request, suite: Suite) -> tuple[Scene, Region]:
    """Build missing regions and read what the suite draws from."""
    folder = _built(request, request.region, None)
    base = region_files.read_region(folder, with_layers=False)
    blocks = request.split.blocks_in(request.region.id)
    if not blocks:
        raise ConfigError(f"split {request.split.spec.id!r} does not speak of region {request.region.id!r}")
    state = State.of(base, bits=read_bits(folder / region_files.LAYERS))
    needs = suite.card.needs
    elsewhere: State | None = None
    pictured = _pictured(base, state) if "imagery" in needs else None
    older = () if "imagery" in needs and pictured is None else older_dates(request.region, needs)
    others = tuple(State.read(_built(request, request.region, date)) for date in older)
    if "degraded map" in needs and pictured is not None:
        others = (degraded_map(request, suite, base), *others)
    if "another region" in needs and request.elsewhere is not None:
        # A view that shows more than the region's map knows of would give away that it is of another place.
        elsewhere = State.read(_built(request, request.elsewhere, None)).of_classes(base.classes)
    scene = Scene(
        map=state,
        world=state,
        blocks=blocks,
        view_reach_m=_view_reach_m(request, suite),
        scenes=base.manifest.scenes,
        others=others,
        elsewhere=elsewhere,
        pictured=pictured,
        pictured_elsewhere=_pictured_elsewhere(request) if "another picture" in needs and pictured else None,
        ageing=_ageing(request.region, request.split) if "rates of ageing" in needs else None,
        looks={block.id: look_of(request.split, block) for block in blocks} if suite.is_pictured else {},
        profile=request.choice.profile,
    )
    if "natural twins" in needs:
        seeds = Seeds(root=request.seed, names=(request.region.id, suite.card.name))
        scene = replace(scene, natural=suite.mine(scene, request.group, seeds))
    return scene, base


def _pictured(base: Region, state: State) -> PicturedGround | None:
    """Return a map with the imagery of its region; None where there is none, or none of photographs."""
    imagery = base.imagery
    return None if imagery is None or imagery.record.is_rendered else PicturedGround(state=state, imagery=imagery)


def _pictured_elsewhere(request: Request) -> PicturedGround | None:
    if request.elsewhere is None:
        return None
    folder = _built(request, request.elsewhere, None)
    there = region_files.read_region(folder, with_layers=False)
    state = State.of(there, bits=read_bits(folder / region_files.LAYERS))
    # A map that knows of fewer classes labels those alone: the others are unknown on its pictures.
    return _pictured(there, state.of_classes([name for name in request.region.class_names if name in there.classes]))


def look_of(split: Split, block: Block) -> Family:
    """Return the family of palettes of a block: that of its part; the halves of a cross-fit look different, too."""
    place = split.place_of[block.id]
    if split.half_of:
        return "train" if split.half_of.get(place) == "a" else "test"
    return split.folds[0].part_of[place]


def _ageing(spec: RegionFile, split: Split) -> Ageing:
    """Return the rates of other countries: of a region's own, its extract, its provenance or its split tells."""
    book = load_ratebook()
    told = [book.country_of(spec.pick(None).file), (spec.provenance.country or "").lower().replace(" ", "-")]
    own = {*filter(None, told), *(split.country_of[place] for place in split.places_in(spec.id))}
    return ageing_of(pool_rates(book, exclude=own), place=spec.id)


def _built(request: Request, spec: RegionFile, date: dt.date | None) -> Path:
    """Return the folder of a region, which is built if it is missing or its inputs have changed."""
    plan = plan_build(spec, out=request.out, date=date, extract_folders=request.extract_folders)
    if not plan.is_current:
        build_region(plan)
    return plan.folder


def _write(request: Request, drawer: Drawer | FlightDrawer, sites: Sequence[Site]) -> Iterator[Task]:
    jobs = drawer.jobs(sites)
    why = {job.query_id: drawer.why_not(job) for job in jobs}
    left = [job for job in jobs if why[job.query_id] is None]
    reasons = Counter(why.values())
    for reason in sorted(filter(None, reasons)):
        where = f"{drawer.suite.card.name} on {request.region.id}"
        named = ("flight", "flights") if isinstance(drawer, FlightDrawer) else ("query", "queries")
        tell(f"{where}: {counted(reasons[reason], *named)} left out, {reason}")
    by_map: dict[str, list[Job]] = {}
    if not left:
        raise nothing_to_ask(request, drawer.suite, reasons)
    for job in left:
        by_map.setdefault(drawer.map_of(job), []).append(job)
    name = drawer.suite.card.name
    # With the seed anyone could draw the truths again, so it stays with them.
    profile = request.choice.profile
    hidden = TruthManifest.model_validate(
        seed_record(request.seed)
        | {"count": request.count, "maps": len(by_map), "request_sha256": _request_sha256(request)}
        | ({} if profile is None else {"profile": profile.model_dump(mode="json", exclude={"classes"})})
    )
    for region, own in sorted(by_map.items()):
        origin = _origin(request, drawer, region, sites, own)
        made = put_task(drawer.drawn(own), origin, hidden, out=request.out)
        drawn = f"{counted(made.manifest.queries, 'query', 'queries')} at {counted(len(sites), 'site')}"
        tell(f"{name} on {region}: {drawn} in {made.folder}")
        yield made


def put_task(pairs: Iterable[tuple[Query, Truth]], origin: TaskOrigin, hidden: TruthManifest, *, out: Path) -> Task:
    """Write queries below `out/tasks` and their truths below `out/truth`, each folder whole or not at all.

    `pairs` are in the order of the query ids. `origin` becomes `task.json`; its `suite` and `region` name the
    folders. `hidden` becomes `truth.json`; `task.json` repeats the commitment of a private or sealed seed.

    Raises
    ------
    StoreError
        If a folder holds foreign files or cannot be written, or if only one of its queries and these has a private
        seed.
    """
    task_folder = out / "tasks" / origin.suite / origin.region
    truth_folder = out / "truth" / origin.suite / origin.region
    check_separate(out / "tasks", truth_folder)
    check_separate(task_folder, out / "truth")
    task_files.check_ours(task_folder, (task_files.QUERIES, task_files.TASK))
    task_files.check_ours(truth_folder, (task_files.TRUTH, task_files.TRUTH_OF, LABELS))
    # Refuse to draw with a public seed over queries of a private one, and the other way round
    before = TruthManifest.read(truth_folder)
    if before.model_fields_set and (before.private_seed is None) != (hidden.private_seed is None):
        kinds = ("private", "public") if hidden.private_seed is None else ("public", "private")
        raise StoreError(
            f"{truth_folder} was drawn by a {kinds[0]} seed, and this one is {kinds[1]}: choose another --out"
        )
    seeds = {"private_seed": hidden.private_seed, "sealed_seed": hidden.sealed_seed}
    origin = origin.model_copy(update={name: seed for name, seed in seeds.items() if seed is not None})
    try:
        with (
            locked(task_folder),
            locked(truth_folder),
            fresh_folder(task_folder) as task_scratch,
            fresh_folder(truth_folder) as truth_scratch,
        ):
            manifest = task_files.write_task(task_scratch, truth_scratch, pairs, origin, hidden)
    except SasgeoError:
        raise
    except OSError as error:
        raise StoreError(
            f"{task_folder} cannot be written ({error.strerror or error}): check the free space and your rights"
        ) from error
    return Task(task_folder, manifest, truth_folder, out)


def _origin(
    request: Request, drawer: Drawer | FlightDrawer, region: str, sites: Sequence[Site], jobs: Sequence[Job]
) -> TaskOrigin:
    """Say how the queries were drawn, but not where they lie."""
    card, code = drawer.suite.card, suite_code(request.suite_spec or request.suite)
    state = drawer.scene.state(region)
    manifest = region_files.read_manifest(request.out / "regions" / region)
    spec = request.split.spec
    texts = {name: getattr(card, name) for name in ("title", "what", "separates", "falsifier", "strength_unit")}
    pictured = filter(None, (drawer.scene.pictured, drawer.scene.pictured_elsewhere))
    owners = "; ".join(dict.fromkeys(item.imagery.record.attribution for item in pictured))
    texts |= {"picture_attribution": owners} if owners else {}
    texts |= drawer.told if isinstance(drawer, FlightDrawer) else {}
    return TaskOrigin(
        suite=card.name,
        suite_version=card.version,
        **(texts if code is None else texts | {"suite_sha256": code}),
        region=region,
        map_date=state.date.isoformat(),
        map_fingerprint=manifest.fingerprint,
        map_inputs_sha256=manifest.inputs_sha256,
        licence=manifest.licence,
        attribution=manifest.attribution,
        provenance=manifest.provenance,
        split=spec.id,
        split_sha256=hashlib.sha256(spec.model_dump_json().encode()).hexdigest(),
        sites=len(sites),
        views_cells=sorted({job.variant.view_cells for job in jobs}),
        epsg=state.grid.epsg,
        made_by=f"sasgeo-bench {version('sasgeo-bench')}",
    )


def check_task(task: Task) -> list[str]:
    """Check a task against its hashes, its truths and its map; return a line for each fault."""
    faults = task.faults()
    if not task.manifest.is_of_map(region_files.read_manifest(task.region)):
        faults.append(rebuild_hint(task.manifest.region))
    return faults


def rebuild_hint(region: str) -> str:
    """Return the message that a map is no longer the one its queries were drawn on."""
    return f"{region} was built anew since: make the queries again"


@dataclass(frozen=True, kw_only=True)
class TaskResult:
    """Result of a request: its folders, or what the region lacks for it, and the lines of progress."""

    lines: tuple[str, ...]
    folders: tuple[Path, ...] = ()
    lack: str | None = None


def carry_out(requests: Sequence[Request], *, jobs: int = 1) -> Iterator[TaskResult]:
    """Draw the tasks of requests with several processes, whose number changes no query; yield results in order.

    Tasks that are up to date stay. Raise a StoreError if a folder cannot be written or
    holds foreign files.
    """
    yield from spread(_carry_out, requests, jobs=jobs, label="tasks drawn")


def _carry_out(request: Request) -> TaskResult:
    lines: list[str] = []
    try:
        with reporting(lines.append):
            folders = ensure_tasks(request)
    except ConfigError as error:
        return TaskResult(lines=tuple(lines), lack=str(error).removesuffix(_SKIP))
    return TaskResult(lines=tuple(lines), folders=folders)
