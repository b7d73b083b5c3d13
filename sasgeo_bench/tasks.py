# SPDX-License-Identifier: Apache-2.0
"""A suite, a region, a split and a seed -> queries and truths on disk: the order of the steps."""

import datetime as dt
import hashlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Final

import geopandas as gpd
import numpy as np
from numpy.typing import NDArray

from sasgeo_bench.ageing.ratebook import pool_rates
from sasgeo_bench.build import build_edited, build_region, plan_build
from sasgeo_bench.errors import ConfigError, ExtractError, SasgeoError, StoreError
from sasgeo_bench.evidence import LayerBits
from sasgeo_bench.graph import build_graph
from sasgeo_bench.layers import burn_layers, make_paint
from sasgeo_bench.perturb.ageing import Ageing
from sasgeo_bench.pose import Pose, Prior
from sasgeo_bench.query import TASK_VERSION, YAW_SIGMA_DEG, PriorGroup, Query, Track, Truth
from sasgeo_bench.region import Region
from sasgeo_bench.regionfile import RegionFile
from sasgeo_bench.split import Block, Split
from sasgeo_bench.store import regiondir, taskdir
from sasgeo_bench.store.ratebookfile import load_ratebook
from sasgeo_bench.store.sheet import Panel
from sasgeo_bench.suites.all_suites import SUITES, find_suite
from sasgeo_bench.suites.base import Draft, Scene, Seeds, Site, State, Suite, Variant, changed_share
from sasgeo_bench.suites.mining import STRIDE_M, Decoys, Windows, candidates, describe, mine
from sasgeo_bench.suites.sites import choose_sites
from sasgeo_bench.suites.synthetic_age import ageing_of
from sasgeo_bench.twin import paste

CANDIDATES: Final = (10, 50, 200)  # of a site, in turn
AGES_YEARS: Final = (2.0, 5.0, 10.0)
_DAYS_PER_YEAR: Final = 365.25
_TWIN_CLEAR: Final = 1.0  # half sides around a twin in which no other candidate lies
_JITTER_M: Final = STRIDE_M / 2

Tell = Callable[[str], None]


@dataclass(frozen=True, kw_only=True)
class Request:
    """What is asked for: one suite on one region.

    Parameters
    ----------
    suite : str
        Its name.
    region : RegionFile
        Where.
    split : Split
        Says the blocks and their parts.
    count : int
        Sites; each carries all the variants of the suite.
    seed : int
        Root of all chance.
    out : Path
        Root of what is built.
    group : PriorGroup, optional
        Priors; those of the suite unless given.
    elsewhere : RegionFile, optional
        Where views of a wrong place are taken.
    extract_folders : sequence of Path
        For regions that are not built yet.
    may_be_fewer : bool
        Whether as many sites as the region holds will do.
    """

    suite: str
    region: RegionFile
    split: Split
    count: int
    seed: int
    out: Path
    group: PriorGroup | None = None
    elsewhere: RegionFile | None = None
    extract_folders: tuple[Path, ...] = ()
    may_be_fewer: bool = False


@dataclass(frozen=True, kw_only=True)
class Made:
    """One task that was written: its folder, how many queries, and how many sites."""

    folder: Path
    queries: int
    sites: int


def make_tasks(request: Request, *, tell: Tell) -> tuple[Made, ...]:
    """Draw the queries of one suite on one region and write them.

    Parameters
    ----------
    request : Request
        What is asked for.
    tell : callable
        Gets one line for every step.

    Returns
    -------
    tuple of Made
        One for each map that is searched: the region itself, and for real ageing each older map.

    Raises
    ------
    ConfigError
        If there is no such suite, the count is not positive, the region cannot carry the suite or does not hold so many
        sites; nothing is written.
    """
    suite = find_suite(request.suite)
    if request.count < 1:
        message = f"--n must be at least 1, got {request.count}"
        raise ConfigError(message)
    scene, base = _scene(request, suite, tell)
    reason = suite.lack(scene)
    if reason is not None:
        message = f"{request.region.id} cannot carry suite {suite.card.name!r}: {reason}"
        raise ConfigError(message)
    group = request.group or suite.card.group
    seeds = Seeds(root=request.seed, names=(request.region.id, suite.card.name, str(suite.card.version)))
    suite = replace(suite, variants=suite.usable(scene))
    _check_reach(scene, suite, group)
    sites = choose_sites(scene, suite, count=request.count, seeds=seeds, group=group, may_be_fewer=request.may_be_fewer)
    scene, sites = _edited(request, suite, scene, base, sites, seeds)
    drawer = _Drawer(suite=suite, scene=scene, seeds=seeds, group=group, split=request.split)
    return tuple(_write(request, drawer, sites, tell))


def _check_reach(scene: Scene, suite: Suite, group: PriorGroup) -> None:
    """Refuse views whose footprint may reach farther beyond a block than the split allows for."""
    largest_m = max(variant.side_m for variant in suite.variants)
    reach_m = largest_m / 2 * float(np.sqrt(2)) * (1 + 2 * group.scale_sigma)
    # A scale of two sigma with weak priors needs more than the plain half diagonal: the split says how much there is.
    if largest_m / 2 * float(np.sqrt(2)) > scene.reach_m:
        message = (
            f"views of {largest_m:g} m reach {reach_m:.0f} m beyond a block, the split allows {scene.reach_m:g} m: "
            "use a split with a larger reach_m"
        )
        raise ConfigError(message)


def _scene(request: Request, suite: Suite, tell: Tell) -> tuple[Scene, Region]:
    """Build what is missing and read what the suite draws from."""
    base = _built(request, request.region, None, tell)
    blocks = request.split.blocks_in(request.region.id)
    if not blocks:
        message = f"split {request.split.spec.id!r} does not speak of region {request.region.id!r}"
        raise ConfigError(message)
    state = State.of(base)
    others: tuple[State, ...] = ()
    elsewhere: State | None = None
    if suite.card.name == "real-age":
        dates = aged_dates(request.region)
        others = tuple(
            State.of(_built(request, request.region, date, tell), name=f"{request.region.id}@{date.isoformat()}")
            for date in dates
        )
    if suite.card.name == "absent" and request.elsewhere is not None:
        elsewhere = State.of(_built(request, request.elsewhere, None, tell))
    scene = Scene(
        map=state,
        world=state,
        blocks=blocks,
        reach_m=request.split.spec.reach_m,
        scenes=base.manifest.scenes,
        others=others,
        elsewhere=elsewhere,
        ageing=_ageing(request.region) if suite.card.name == "synthetic-age" else None,
    )
    return scene, base


def _ageing(spec: RegionFile) -> Ageing:
    """Ageing by the rates measured in all places but the region's own."""
    book = load_ratebook()
    place = book.place_of(spec.pick(None).file)
    return ageing_of(pool_rates(book, besides=[place] if place else []), place=place or spec.id)


def _built(request: Request, spec: RegionFile, date: dt.date | None, tell: Tell) -> Region:
    """Read a region, built first where it is not there or its inputs have changed."""
    plan = plan_build(spec, out=request.out, date=date, extract_folders=request.extract_folders)
    if not plan.is_current:
        build_region(plan, tell=tell)
    return regiondir.read_region(plan.folder)


def aged_dates(spec: RegionFile) -> tuple[dt.date, ...]:
    """Dates of the older maps for real ageing: for each age the nearest there is, oldest first.

    Examples
    --------
    >>> from sasgeo_bench.store.catalog import find_region_file, read_region_file
    >>> [str(date) for date in aged_dates(read_region_file(find_region_file("dreieich")))]
    ['2013-07-19']
    """
    newest = spec.pick(None).date
    older = sorted(extract.date for extract in spec.extract if extract.date < newest)
    if not older:
        return ()
    ages_years = np.array([(newest - date).days / _DAYS_PER_YEAR for date in older])
    return tuple(sorted({older[int(np.argmin(np.abs(np.log(ages_years / years))))] for years in AGES_YEARS}))


def _edited(
    request: Request, suite: Suite, scene: Scene, base: Region, sites: tuple[Site, ...], seeds: Seeds
) -> tuple[Scene, tuple[Site, ...]]:
    """Carry out what the suite does to the map and the world; sites it found no twin for are left out."""
    edit = suite.edit(scene, sites, seeds)
    if edit is None:
        return scene, sites
    kept = tuple(site for site in sites if edit.twins.get(site.index))
    if not kept or (len(kept) < len(sites) and not request.may_be_fewer):
        message = (
            f"{request.region.id} has room for the twins of {len(kept)} of {len(sites)} sites of suite "
            f"{suite.card.name!r}: lower --n or pass --up-to"
        )
        raise ConfigError(message)
    plan = plan_build(request.region, out=request.out, extract_folders=request.extract_folders)
    twins = {site.index: edit.twins[site.index] for site in kept}
    world = scene.world
    if edit.world_pastes is not None:
        world = _state_of(base, paste(base.features, edit.world_pastes))
    if not edit.map_pastes:
        return replace(scene, twins=twins), kept
    features = paste(base.features, edit.map_pastes)
    note = f"edited: {len(edit.map_pastes)} parts pasted for suite {suite.card.name}, seed {request.seed}"
    folder = build_edited(plan, base, features, suffix=suite.card.name, note=note)
    edited = State.of(regiondir.read_region(folder))
    return replace(scene, map=edited, world=world if edit.world_pastes is not None else edited, twins=twins), kept


def _state_of(base: Region, features: gpd.GeoDataFrame) -> State:
    """A state that is seen and never searched: layers burnt in memory, no graph."""
    paint = make_paint(features, base.classes, base.coverage)
    empty = build_graph(features.iloc[:0])
    return State(
        region=base.manifest.id,
        date=base.manifest.extract.date,
        grid=base.grid,
        classes=base.classes,
        bits=LayerBits.of(burn_layers(paint, base.grid)),
        features=features,
        graph=empty,
    )


@dataclass(frozen=True, kw_only=True)
class _Job:
    """One query to be drawn; its id is known before it is."""

    query_id: str
    site: Site
    variant: Variant
    track: Track


@dataclass(frozen=True, kw_only=True)
class _Drawer:
    """Draws the queries of one suite on one region.

    `windows` and `mined` keep what a map and a size of view share.
    """

    suite: Suite
    scene: Scene
    seeds: Seeds
    group: PriorGroup
    split: Split
    windows: dict[tuple[str, float], Windows] = field(default_factory=dict)
    mined: dict[tuple[str, float, int], Decoys] = field(default_factory=dict)

    def jobs(self, sites: Sequence[Site]) -> list[_Job]:
        """All queries, in the order of their ids: neighbours in the table have nothing in common."""
        jobs = [
            _Job(
                query_id=self._site_seeds(site).digest("query", variant.name, track).hex()[:24],
                site=site,
                variant=variant,
                track=track,
            )
            for site in sites
            for variant in self.suite.variants
            for track in self.suite.card.tracks
        ]
        return sorted(jobs, key=lambda job: job.query_id)

    def _site_seeds(self, site: Site) -> Seeds:
        return self.seeds.under("site", site.index)

    def can_draw(self, job: _Job) -> bool:
        """Whether there are enough decoys: with a handful of candidates a retrieval query decides nothing."""
        if job.track != "retrieval":
            return True
        state = self.scene.state(self.suite.map_region(self.scene, job.variant))
        return len(self._mined(state, job.site, job.variant.side_m).points_m) >= min(CANDIDATES) - 1

    def draw(self, job: _Job) -> tuple[Query, Truth]:
        """Draw one query and its truth."""
        site, seeds = job.site, self._site_seeds(job.site)
        draft = self.suite.draw(self.scene, site, job.variant, seeds)
        group = draft.group or self.group
        state = self.scene.state(self.suite.map_region(self.scene, job.variant))
        prior = make_prior(site.pose, group, away_m=draft.away_m, rng=seeds.rng("prior", group.name, draft.away_m))
        decoys = self._mined(state, site, job.variant.side_m)
        places: tuple[Pose, ...] = ()
        right = -1
        if job.track == "retrieval":
            places, right = self._candidates(job, draft, decoys, prior)
        query = Query(
            query_id=job.query_id,
            track=job.track,
            suite=self.suite.card.name,
            suite_version=self.suite.card.version,
            part=self.split.part_in_task(self._block(site)),
            region=state.region,
            evidence=draft.evidence,
            observed_on=self.scene.world.date,
            season=draft.season,
            prior=prior,
            prior_group=group.name,
            candidates=places,
            vectors=draft.vectors,
        )
        return query, self._truth(job, draft, state, decoys, right)

    def _block(self, site: Site) -> Block:
        return next(block for block in self.scene.blocks if block.id == site.block)

    def _truth(self, job: _Job, draft: Draft, state: State, decoys: Decoys, right: int) -> Truth:
        site, variant = job.site, job.variant
        changed = draft.changed_share
        if changed is None:
            same = state is self.scene.world
            cells, cell_m = variant.view_cells, variant.cell_size_m
            views = (place.view(site.pose, size_cells=cells, cell_size_m=cell_m) for place in (self.scene.world, state))
            changed = 0.0 if same else changed_share(*views)
        return Truth(
            query_id=job.query_id,
            is_present=draft.is_present,
            pose=site.pose if draft.has_pose else None,
            candidate=right,
            pair_id=self._site_seeds(site).digest("pair", job.track).hex()[:16],
            role=variant.role,
            kind=variant.kind,
            strength=variant.strength,
            strength_unit=self.suite.card.strength_unit,
            unknown_share=draft.evidence.unknown_share,
            changed_share=changed,
            feature_density=site.density,
            alias_index=decoys.alias_index,
            block=site.block,
            scene=",".join(self.scene.scenes),
            measured=draft.measured,
        )

    def _mined(self, state: State, site: Site, side_m: float) -> Decoys:
        center_m = (site.pose.easting_m, site.pose.northing_m)
        key = (state.region, side_m)
        if key not in self.windows:
            self.windows[key] = describe(state, side_m=side_m)
        if (*key, site.index) not in self.mined:
            self.mined[*key, site.index] = mine(self.windows[key], center_m, count=max(CANDIDATES) - 1)
        return self.mined[*key, site.index]

    def _candidates(self, job: _Job, draft: Draft, decoys: Decoys, prior: Prior) -> tuple[tuple[Pose, ...], int]:
        """The true place, its twins, and the best decoys, shuffled; every one jittered alike."""
        site = job.site
        truth = (site.pose.easting_m, site.pose.northing_m)
        total = CANDIDATES[site.index % len(CANDIDATES)]
        twins = np.array(self.scene.twins.get(site.index, ())).reshape(-1, 2)
        points = decoys.points_m
        for twin in twins:
            points = points[np.hypot(*(points - twin).T) > _TWIN_CLEAR * job.variant.side_m / 2]
        if draft.has_twins:
            points = np.vstack((twins, points))
        seeds = self._site_seeds(site)
        rng = seeds.rng("candidates", job.variant.view_cells, job.variant.kind if draft.neighbours_m else "")
        yaw_deg = prior.yaw_deg if prior.yaw_deg is not None else 0.0
        if draft.neighbours_m:
            return _clusters(truth, points[: total // 5 - 1], draft.neighbours_m, yaw_deg=yaw_deg, rng=rng)
        own = None if draft.is_removed else truth
        return candidates(own, points[: total - 1], yaw_deg=yaw_deg, jitter_m=_JITTER_M, rng=rng)


def _clusters(
    truth: tuple[float, float],
    decoys_m: NDArray[np.float64],
    cluster_m: Sequence[tuple[float, float]],
    *,
    yaw_deg: float,
    rng: np.random.Generator,
) -> tuple[tuple[Pose, ...], int]:
    """A cluster of neighbours around every place; which of its cluster the truth is, is chance, as for decoys."""
    shape = np.array(cluster_m)
    at = int(np.argmin(np.hypot(*shape.T)))
    centres = decoys_m + rng.uniform(-_JITTER_M, _JITTER_M, decoys_m.shape)
    moved = [np.array(truth) + shape, *(centre + shape - shape[rng.integers(len(shape))] for centre in centres)]
    points = np.concatenate(moved)
    order = rng.permutation(len(points))
    poses = tuple(
        Pose(easting_m=round(float(x), 2), northing_m=round(float(y), 2), yaw_deg=yaw_deg) for x, y in points[order]
    )
    return poses, int(np.flatnonzero(order == at)[0])


def make_prior(pose: Pose, group: PriorGroup, *, away_m: float, rng: np.random.Generator) -> Prior:
    """Draw what is known before: a disc in which the truth lies anywhere, a heading and a scale off by their sigmas.

    With `away_m` the disc lies so far off that its edge is that far from the truth.

    Examples
    --------
    >>> pose = Pose(easting_m=0.0, northing_m=0.0, yaw_deg=10.0)
    >>> group = PriorGroup(radius_m=500.0, yaw="unknown", scale_sigma=0.03)
    >>> prior = make_prior(pose, group, away_m=0.0, rng=np.random.default_rng(1))
    >>> bool(np.hypot(*prior.center_m) <= 500), prior.yaw_deg is None
    (True, True)
    """
    turn, radius_share, yaw_noise = rng.uniform(0, 2 * np.pi), np.sqrt(rng.random()), rng.standard_normal()
    center_m = None
    if group.radius_m is not None:
        apart_m = group.radius_m * radius_share if away_m == 0 else group.radius_m + away_m
        center_m = (
            round(float(pose.easting_m + apart_m * np.sin(turn)), 1),
            round(float(pose.northing_m + apart_m * np.cos(turn)), 1),
        )
    sigma_deg = YAW_SIGMA_DEG[group.yaw]
    yaw_deg = None if sigma_deg is None else round(float((pose.yaw_deg + sigma_deg * yaw_noise) % 360), 1)
    return Prior(
        center_m=center_m,
        radius_m=group.radius_m,
        yaw_deg=yaw_deg,
        yaw_sigma_deg=sigma_deg,
        scale_sigma=group.scale_sigma,
    )


def _write(request: Request, drawer: _Drawer, sites: Sequence[Site], tell: Tell) -> Iterator[Made]:
    """Write one task for every map that is searched."""
    jobs = drawer.jobs(sites)
    left = [job for job in jobs if drawer.can_draw(job)]
    if len(left) < len(jobs):
        tell(f"{len(jobs) - len(left)} retrieval queries left out: the map has fewer than {min(CANDIDATES) - 1} decoys")
    by_map: dict[str, list[_Job]] = {}
    if not left:
        message = f"{request.region.id} is too small for suite {drawer.suite.card.name!r}: no decoys far enough away"
        raise ConfigError(message)
    for job in left:
        by_map.setdefault(drawer.suite.map_region(drawer.scene, job.variant), []).append(job)
    name = drawer.suite.card.name
    for region, own in sorted(by_map.items()):
        task_folder = request.out / "tasks" / name / region
        truth_folder = request.out / "truth" / name / region
        about = _about(request, drawer, region, sites, own)
        try:
            with (
                regiondir.locked(task_folder, tell=tell),
                regiondir.locked(truth_folder, tell=tell),
                regiondir.fresh_folder(truth_folder) as truth_scratch,
                regiondir.fresh_folder(task_folder) as task_scratch,
            ):
                total = taskdir.write_task(task_scratch, truth_scratch, map(drawer.draw, own), about)
        except SasgeoError:
            raise
        except OSError as error:
            message = (
                f"{task_folder} cannot be written ({error.strerror or error}): check the free space and your rights"
            )
            raise StoreError(message) from error
        tell(f"{name} on {region}: {total} queries at {len(sites)} sites in {task_folder}")
        yield Made(folder=task_folder, queries=total, sites=len(sites))


def _about(
    request: Request, drawer: _Drawer, region: str, sites: Sequence[Site], jobs: Sequence[_Job]
) -> dict[str, Any]:
    """What `task.json` says of how the queries came to be; nothing of where they lie."""
    card = drawer.suite.card
    state = drawer.scene.state(region)
    manifest = regiondir.read_manifest(request.out / "regions" / region)
    spec = request.split.spec
    return {
        "suite": card.name,
        "suite_version": card.version,
        "title": card.title,
        "what": card.what,
        "separates": card.separates,
        "falsifier": card.falsifier,
        "strength_unit": card.strength_unit,
        "region": region,
        "map_date": state.date.isoformat(),
        "map_fingerprint": manifest.fingerprint,
        "split": spec.id,
        "split_sha256": hashlib.sha256(spec.model_dump_json().encode()).hexdigest(),
        "seed": request.seed,
        "sites": len(sites),
        "views_cells": sorted({job.variant.view_cells for job in jobs}),
        "prior_group": (request.group or card.group).name,
        "made_from": {"task_version": TASK_VERSION},
    }


def wrong_place(split: Split, region: RegionFile, known: Mapping[str, RegionFile]) -> RegionFile | None:
    """The region where views of a wrong place are taken: the next place of the split, town for town and real for real.

    It depends on the split alone, so that asking for more regions changes no query.
    """
    places = [[name for name in place.regions if name in known] for place in split.spec.place]
    at = next((index for index, names in enumerate(places) if region.id in names), None)
    if at is None:
        return None
    is_town = region.pick(None).town is not None
    for step in range(1, len(places)):
        for name in places[(at + step) % len(places)]:
            if (known[name].pick(None).town is not None) == is_town:
                return known[name]
    return None


def default_suites() -> tuple[str, ...]:
    """Names of all suites."""
    return tuple(SUITES)


def is_reachable(spec: RegionFile, request_folders: Sequence[Path], out: Path) -> bool:
    """Whether a region is a town, or its newest extract is on this machine."""
    offline = spec.model_copy(update={"extract": [item.model_copy(update={"urls": ()}) for item in spec.extract]})
    try:
        plan_build(offline, out=out, extract_folders=request_folders)
    except ExtractError:
        return False
    return True


def panels(
    task_folder: Path, truth_folder: Path, *, out: Path, count: int = 12, query_id: str | None = None
) -> tuple[Panel, ...]:
    """Choose queries of a task for a contact sheet: each kind and strength of a site, site by site.

    Parameters
    ----------
    task_folder, truth_folder : Path
        A task and its truths.
    out : Path
        Root with the regions the task searches.
    count : int
        At most so many.
    query_id : str, optional
        This query alone.

    Raises
    ------
    StoreError
        If a file is missing.
    ConfigError
        If there is no such query.
    """
    about = taskdir.read_task(task_folder)
    state = State.of(regiondir.read_region(out / "regions" / about["region"]), name=about["region"])
    truths = {truth.query_id: truth for truth in taskdir.read_truths(truth_folder)}
    chosen = _for_sheet(list(truths.values()), count)
    if query_id is not None:
        chosen = [truth for truth in truths.values() if truth.query_id.startswith(query_id)][:1]
        if not chosen:
            message = f"{task_folder} holds no query {query_id!r}"
            raise ConfigError(message)
    wanted = {truth.query_id for truth in chosen}
    queries = {}
    rivals: dict[Pose, tuple[Pose, ...]] = {}
    poses = {truth.pose for truth in chosen}
    for query in taskdir.read_queries(task_folder):
        truth = truths[query.query_id]
        if query.query_id in wanted:
            queries[query.query_id] = query
        if query.candidates and truth.pose in poses and truth.pose is not None:
            others = tuple(pose for at, pose in enumerate(query.candidates) if at != truth.candidate)
            rivals.setdefault(truth.pose, others)
    return tuple(
        _panel(queries[truth.query_id], truth, state, rivals.get(truth.pose, ()) if truth.pose else ())
        for truth in chosen
    )


def _for_sheet(truths: Sequence[Truth], count: int) -> list[Truth]:
    """Queries of as few sites as needed to show every variant, then more; controls first."""
    first = {truth.pair_id: truth.block for truth in sorted(truths, key=lambda item: item.pair_id)}
    rank = {"control": 0, "falsifier": 1, "stress": 2}
    order = sorted(
        truths, key=lambda item: (list(first).index(item.pair_id), rank[item.role], item.kind, item.strength)
    )
    seen: set[tuple[str, float, float]] = set()
    chosen = []
    for truth in order:
        variant = (truth.kind, truth.strength, round(truth.unknown_share, 0) if truth.role == "falsifier" else 0.0)
        if variant not in seen:
            seen.add(variant)
            chosen.append(truth)
    rest = [truth for truth in order if truth not in chosen]
    return (chosen + rest)[:count]


def _panel(query: Query, truth: Truth, state: State, rivals: Sequence[Pose]) -> Panel:
    """What the map shows at the truth, and at the candidate that overlaps most with it; mined where there is none."""
    if truth.pose is None:
        return Panel(query=query, truth=truth, at_truth=None, at_decoy=None)
    size, cell_m = query.evidence.shape[0], query.evidence.cell_size_m
    at_truth = state.view(truth.pose, size_cells=size, cell_size_m=cell_m)
    places = [(pose.easting_m, pose.northing_m) for pose in rivals]
    if not places:
        center_m = (truth.pose.easting_m, truth.pose.northing_m)
        mined = mine(describe(state, side_m=size * cell_m), center_m, count=1).points_m
        places = [(float(x), float(y)) for x, y in mined]
    views = [
        state.view(replace(truth.pose, easting_m=x, northing_m=y), size_cells=size, cell_size_m=cell_m)
        for x, y in places
    ]
    hardest = min(views, key=lambda view: changed_share(at_truth, view), default=None)
    return Panel(query=query, truth=truth, at_truth=at_truth, at_decoy=hardest)
