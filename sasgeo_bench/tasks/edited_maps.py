# SPDX-License-Identifier: Apache-2.0
"""Maps that are changed for a suite: regions of their own next to the one they come from, and what is drawn of them."""

from collections import Counter
from collections.abc import Mapping
from dataclasses import replace

import geopandas as gpd

from sasgeo_bench.core.errors import ConfigError
from sasgeo_bench.regions.build import build_edited, plan_build
from sasgeo_bench.regions.evidence import LayerBits
from sasgeo_bench.regions.graph import build_graph
from sasgeo_bench.regions.layers import burn_layers, make_paint
from sasgeo_bench.regions.region import Region
from sasgeo_bench.tasks.degraded_map import DROPPED, WARP_M, degrade
from sasgeo_bench.tasks.flight_sampling import Flight
from sasgeo_bench.tasks.sampling import Drawer
from sasgeo_bench.tasks.state import State
from sasgeo_bench.tasks.suites.base import Seeds, Site, Suite
from sasgeo_bench.tasks.suites.flights import MAPS, changed, changes_of
from sasgeo_bench.tasks.task_plan import Request
from sasgeo_bench.tasks.twin import paste


def degraded_map(request: Request, suite: Suite, base: Region) -> State:
    """Return the region's map with the faults of worse mapping, which is built next to it."""
    plan = plan_build(request.region, out=request.out, extract_folders=request.extract_folders)
    rng = Seeds(root=request.seed, names=(request.region.id, suite.card.name)).rng("degraded map")
    features = degrade(base.features, base.grid, rng)
    note = f"degraded: {DROPPED:.0%} of the buildings dropped, the rest {WARP_M:g} m off, for suite {suite.card.name}"
    folder = build_edited(plan, base, features, suffix=suite.card.name, note=note)
    return State.read(folder)


def edit_maps(
    request: Request, drawer: Drawer, base: Region, sites: tuple[Site, ...]
) -> tuple[Drawer, tuple[Site, ...]]:
    """Apply the suite's edit to map and world; drop sites without a twin."""
    suite, scene, seeds = drawer.suite, drawer.scene, drawer.seeds
    edit = suite.edit(scene, sites, seeds)
    # With many sites there may be no room for the copies of any.
    while request.may_be_fewer and edit is not None and not edit.sites and len(sites) > 1:
        sites = sites[: len(sites) // 2]
        edit = suite.edit(scene, sites, seeds)
    if edit is None:
        return drawer, sites
    if not edit.sites:
        raise ConfigError(f"{request.region.id} has no room for a copy of a site, as suite {suite.card.name!r} needs")
    if len(edit.sites) < request.count and not request.may_be_fewer:
        raise ConfigError(
            f"{request.region.id} has room for the copies of {len(edit.sites)} of {len(sites)} sites of suite "
            f"{suite.card.name!r}: lower --n or pass --up-to"
        )
    # Tried on the unedited map, so that no edited map is written without a query to ask on it.
    trial = replace(drawer, scene=replace(scene, twins=edit.twins, look_alikes=edit.elsewhere))
    reasons = Counter(map(trial.why_not, trial.jobs(edit.sites)))
    if None not in reasons:
        raise nothing_to_ask(request, suite, reasons)
    plan = plan_build(request.region, out=request.out, extract_folders=request.extract_folders)
    world = scene.world
    if edit.world_pastes is not None:
        world = _state_of(base, paste(base.features, edit.world_pastes))
    if not edit.map_pastes:
        return trial, edit.sites
    features = paste(base.features, edit.map_pastes)
    note = f"edited: {len(edit.map_pastes)} parts pasted for suite {suite.card.name}"
    folder = build_edited(plan, base, features, suffix=suite.card.name, note=note)
    edited = State.read(folder)
    world = edited if edit.world_pastes is None else world
    return replace(drawer, scene=replace(scene, map=edited, world=world, twins=edit.twins)), edit.sites


def changed_maps(request: Request, base: Region, flights: Mapping[int, Flight]) -> tuple[State, ...]:
    """Return the maps that are changed for flights, which are built next to the region's; none if none are needed."""
    plots = [(site, flight.plot) for site, flight in flights.items() if flight.plot is not None]
    plan = plan_build(request.region, out=request.out, extract_folders=request.extract_folders)
    found = []
    for number in range(MAPS if plots else 0):
        changes = changes_of(plots, number)
        features, coverage = changed(base.features, base.coverage, changes)
        folder = build_edited(
            plan,
            base,
            features,
            suffix=f"{request.suite}-{number + 1}",
            note=f"edited: {len(changes)} parts changed for suite {request.suite}",
            coverage=None if coverage is base.coverage else coverage,
        )
        found.append(State.read(folder))
    return tuple(found)


def nothing_to_ask(request: Request, suite: Suite, reasons: Counter[str | None]) -> ConfigError:
    """Return an error that gives the most frequent reason why no query can be asked; none if no view is chosen."""
    if not reasons:
        why = "its views are of other sizes, kinds or tracks than those asked for"
        return ConfigError(f"{request.region.id} has nothing of suite {suite.card.name!r} that is wanted: {why}")
    reason = reasons.most_common(1)[0][0]
    where = f"{request.region.id} is too small or too empty"
    if request.flown is not None:
        where = f"the flight over {request.region.id} leaves nothing to ask"
    return ConfigError(f"{where} for suite {suite.card.name!r}: {reason}")


def _state_of(base: Region, features: gpd.GeoDataFrame) -> State:
    """Return a state that is seen and never searched: layers in memory, no graph."""
    paint = make_paint(features, base.classes, base.coverage)
    return State(
        region=base.manifest.id,
        date=base.manifest.extract.date,
        grid=base.grid,
        classes=base.classes,
        bits=LayerBits.of(burn_layers(paint, base.grid)),
        features=features,
        graph=build_graph(features.iloc[:0]),
        coverage=base.coverage,
    )
