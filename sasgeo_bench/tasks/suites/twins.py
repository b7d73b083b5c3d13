# SPDX-License-Identifier: Apache-2.0
"""Base of the twin suites: copies of a site elsewhere on the map, with or without a change."""

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Final

import numpy as np
import scipy
import shapely
from numpy.typing import NDArray

from sasgeo_bench.geometry.pose import Pose
from sasgeo_bench.regions.evidence import Evidence
from sasgeo_bench.tasks.query import CEILING, RADII_M, PriorGroup
from sasgeo_bench.tasks.state import State
from sasgeo_bench.tasks.suites.base import Draft, Edit, Scene, Seeds, Shot, Site, Suite
from sasgeo_bench.tasks.suites.mining import min_distance_m
from sasgeo_bench.tasks.suites.vectors import site_vectors
from sasgeo_bench.tasks.twin import Change, Paste

if TYPE_CHECKING:
    import geopandas as gpd

LATTICE_M: Final = 16.0
OFF_M: Final = 24.0  # largest offset of a copied disc from its site, so that its rim does not show where the site is

TWIN_GROUP: Final = PriorGroup(radius_m=500.0, yaw="weak", scale_sigma=0.03)
RIVAL_M: Final = 800.0  # largest distance of a twin from its site: a disc of `TWIN_GROUP` holds both

Places = tuple[tuple[float, float], ...]
ChangeOf = Callable[[Scene, Site, np.random.Generator], Change]


@dataclass(frozen=True, kw_only=True)
class TwinSuite(Suite):
    """Base of suites whose sites have twins: copies elsewhere on the map that differ by one change.

    At every second site (if `is_swapped`) the true place has the change and the twin does not, so that "take the
    plainer one" does not help. The true place is drawn by lot from the original and its copies, so that "take the one
    whose roads continue" does not help either. A view shows the true place; the twins are among its candidates, or in
    the disc of its prior, from which they lie at most `within_m`.

    `change_of` returns the change of a site's copy. `find` returns the places that sites are near, shape (N, 2), and
    `needs` names what a region without any lacks. The falsifier's vectors are those of the changed place if
    `falsifier_sees_change`, else of the plain one, at every site; so they do not show which of the two is seen.
    """

    change_of: ChangeOf | None = None
    find: Callable[[Scene], NDArray[np.float64]] | None = None
    needs: str = ""
    copies: int = 1
    within_m: float = RIVAL_M
    is_swapped: bool = True
    falsifier_sees_change: bool = False

    def lack(self, scene: Scene) -> str | None:
        """Refuse a region without places of the right kind."""
        places = self.anchors(scene)
        return None if places is None or len(places) else self.needs

    @property
    def has_rivals(self) -> bool:
        """Return whether twins are near enough for one disc."""
        return math.isfinite(self.within_m)

    def refusal(self, group: PriorGroup) -> str | None:
        """Refuse a disc that cannot hold a site and a twin at the largest distance."""
        if group.radius_m is None or not self.has_rivals or 2 * group.radius_m > self.within_m:
            return super().refusal(group)
        least = min(radius_m for radius_m in RADII_M if radius_m and 2 * radius_m > self.within_m)
        return (
            f"needs a disc that holds two places up to {self.within_m:g} m apart, and {group.name} has none: "
            f"use r{least:g} or more, or leave --prior out"
        )

    def anchors(self, scene: Scene) -> NDArray[np.float64] | None:
        """Return the places that `find` finds."""
        return None if self.find is None else self.find(scene)

    def radius_m(self, scene: Scene) -> float:
        """Return the radius of copied discs, which hold all that a view may show at any offset."""
        return scene.view_reach_m + OFF_M

    def spacing_m(self, scene: Scene) -> float:
        """Return a distance at which no copy overwrites the source of another."""
        return 2 * self.clear_m(scene)

    def clear_m(self, scene: Scene) -> float:
        """Return the reach of the copied disc: an unknown cell of the site would distinguish it from its twin."""
        return self.radius_m(scene) + OFF_M

    def edit(self, scene: Scene, sites: Sequence[Site], seeds: Seeds) -> Edit:
        """Find places for the twins, plan the copies, and draw the true place of each site."""
        clear_m = self.clear_m(scene)
        spacing_m = max(min_distance_m(self.main_side_m / 2), 2 * clear_m)
        room = Room(clear_m=clear_m, spacing_m=spacing_m, within_m=self.within_m)
        targets = find_targets(scene.map, sites, room, copies=self.copies, seeds=seeds)
        pastes: list[Paste] = []
        moved: list[Site] = []
        twins: dict[int, Places] = {}
        for site in sites:
            if site.index not in targets:
                continue
            rng = seeds.rng("twin", *_key(site))
            change = self.change_of(scene, site, rng) if self.change_of else None
            pastes += self._pastes(scene, site, targets[site.index], change, seeds)
            true, twins[site.index] = _by_lot(scene, site, targets[site.index], seeds)
            moved.append(true)
        return Edit(map_pastes=tuple(pastes), world_pastes=None, sites=tuple(moved), twins=twins)

    def _pastes(
        self, scene: Scene, site: Site, targets: Places, change: Change | None, seeds: Seeds
    ) -> Iterator[Paste]:
        """Yield the copies of one site, and the site itself if it is the changed one."""
        turn, share = seeds.rng("off", *_key(site)).random(2)
        off_m = OFF_M * np.sqrt(share) * np.array([np.sin(2 * np.pi * turn), np.cos(2 * np.pi * turn)])
        source = np.array(site.en_m) + off_m
        is_changed = self.is_swapped and site.index % 2 == 1
        plain = Paste(source_m=_place(source), target_m=_place(source), radius_m=self.radius_m(scene))
        if is_changed:
            yield replace(plain, change=change)
        for target in targets:
            yield replace(plain, target_m=_place(np.array(target) + off_m), change=None if is_changed else change)

    def draw(self, shot: Shot) -> Draft:
        """See the true place; the control has no vectors, the falsifier's do not distinguish the two places."""
        seen, role = self.see(shot), shot.variant.role
        if role == "stress":
            return Draft(evidence=seen, vectors=site_vectors(shot, shot.site.pose))
        vectors = None if role == "control" else site_vectors(shot, self._uninformative_pose(shot))
        return Draft(evidence=seen, vectors=vectors, measured={CEILING: 1.0 / (1 + self.copies)})

    def see(self, shot: Shot) -> Evidence:
        """Perceive the layers at the true place."""
        return shot.perceived()

    def _uninformative_pose(self, shot: Shot) -> Pose:
        """Return where the falsifier's vectors are taken: at the site or at its twin."""
        site = shot.site
        is_changed = (self.is_swapped and site.index % 2 == 1) != site.is_copy
        if is_changed == self.falsifier_sees_change:
            return site.pose
        easting_m, northing_m = shot.scene.twins[site.index][0]
        return replace(site.pose, easting_m=easting_m, northing_m=northing_m)


def _key(site: Site) -> tuple[int, int]:
    return (round(site.pose.easting_m * 100), round(site.pose.northing_m * 100))


def _place(point: NDArray[np.float64]) -> tuple[float, float]:
    return (float(point[0]), float(point[1]))


def _by_lot(scene: Scene, site: Site, targets: Places, seeds: Seeds) -> tuple[Site, Places]:
    """Draw the true place from the site and its copies in blocks; return it and its twins, the original first."""
    blocks = {target: block for target in targets for block in scene.blocks if block.holds(target)}
    lot = int(seeds.rng("lot", *_key(site)).integers(1 + len(blocks)))
    if lot == 0:
        return site, targets
    true = list(blocks)[lot - 1]
    pose = replace(site.pose, easting_m=true[0], northing_m=true[1])
    others = tuple(target for target in targets if target != true)
    return replace(site, pose=pose, block=blocks[true].id, is_copy=True), (site.en_m, *others)


@dataclass(frozen=True, slots=True, kw_only=True)
class Room:
    """What the copies of a site need: mapped ground around each, and least and largest distance from their site."""

    clear_m: float
    spacing_m: float
    within_m: float = math.inf


def find_targets(state: State, sites: Sequence[Site], room: Room, *, copies: int, seeds: Seeds) -> dict[int, Places]:
    """Find free places for the copies of every site: mapped, clear of every site and copy, neither near nor far.

    Sites take turns; one without room for all its copies is dropped. The offset of a copy is a whole number of cells:
    at a fraction of a cell its mask would differ at every edge, which would give it away.
    """
    cell_m = state.grid.cell_size_m
    step = max(1, round(LATTICE_M / cell_m))
    inside = np.pad(state.known[::step, ::step], 1)
    deep = scipy.ndimage.distance_transform_edt(inside)[1:-1, 1:-1] > room.clear_m / LATTICE_M + 1
    free = state.grid.to_centres_m(np.argwhere(deep) * step)
    for site in sites:
        free = free[np.hypot(*(free - site.en_m).T) > 2 * room.clear_m + cell_m]
    found: dict[int, Places] = {}
    for site in sites:
        rng = seeds.rng("target", *_key(site))
        own = np.array(site.en_m)
        taken: list[NDArray[np.float64]] = []
        left = free
        while len(taken) < copies:
            off_m = np.hypot(*(left - own).T)
            fit = left[(off_m > room.spacing_m + cell_m) & (off_m < room.within_m - cell_m)]
            if len(fit) == 0:
                break
            picked = own + np.rint((fit[rng.integers(len(fit))] - own) / cell_m) * cell_m
            taken.append(picked)
            left = left[np.hypot(*(left - picked).T) > room.spacing_m + 2 * cell_m]
        if len(taken) == copies:
            free = left
            found[site.index] = tuple(_place(point) for point in taken)
    return found


def nodes_of(scene: Scene, kinds: Sequence[str], *, least_degree: int = 0) -> "gpd.GeoDataFrame":
    """Return nodes of the map's graph of some kinds."""
    nodes = scene.map.graph.nodes
    return nodes[nodes["kind"].isin(list(kinds)).to_numpy() & (nodes["degree"].to_numpy() >= least_degree)]


def places_of(nodes: "gpd.GeoDataFrame") -> NDArray[np.float64]:
    """Return easting and northing of nodes, shape (N, 2)."""
    return np.asarray(shapely.get_coordinates(nodes.geometry.to_numpy())).reshape(-1, 2)


def with_neighbours(places: NDArray[np.float64], *, within_m: float) -> NDArray[np.float64]:
    """Return the places, shape (N, 2), that have another one within a distance."""
    points = shapely.points(places)
    hits = shapely.STRtree(points).query(points, predicate="dwithin", distance=within_m)[0]
    return np.asarray(places[np.bincount(hits, minlength=len(places)) > 1])
