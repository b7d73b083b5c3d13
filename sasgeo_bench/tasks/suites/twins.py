# SPDX-License-Identifier: Apache-2.0
"""What the twin suites share: copies of a site elsewhere on the map, changed or not, and queries that must choose."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Final

import geopandas as gpd
import numpy as np
import shapely
from numpy.typing import NDArray
from scipy import ndimage

from sasgeo_bench.geometry.pose import Pose
from sasgeo_bench.regions.evidence import Evidence
from sasgeo_bench.tasks.query import PriorGroup
from sasgeo_bench.tasks.suites.base import Draft, Edit, Scene, Seeds, Site, State, Suite, Variant, perceived
from sasgeo_bench.tasks.suites.mining import least_apart_m
from sasgeo_bench.tasks.suites.vectors import VectorNoise, perceive_vectors
from sasgeo_bench.tasks.twin import Change, Paste

LATTICE_M: Final = 16.0
OFF_M: Final = 24.0  # how far the middle of what is copied lies from the site: its rim must not tell where the site is

TWIN_GROUP: Final = PriorGroup(radius_m=2000.0, yaw="weak", scale_sigma=0.03)  # wide enough to hold the twins

Places = tuple[tuple[float, float], ...]

# What turns a site into the change of its copy, with the site's own chance.
ChangeOf = Callable[[Scene, Site, np.random.Generator], Change]


@dataclass(frozen=True, kw_only=True)
class TwinSuite(Suite):
    """Every site has twins: copies elsewhere on the map that differ from it by one change.

    At every second site the true place has the change and the twin has not, so that "take the plainer one" does not
    help; of the original and its copies any is the true place, by lot, so that neither does "take the one whose roads
    go on". A query's view is of the true place; the twins are among its candidates.

    Parameters
    ----------
    change_of : callable
        (scene, site, rng) -> what is done to the copy.
    find : callable
        Scene -> easting and northing of what the suite is about, shape (N, 2); None for anywhere.
    needs : str
        What a region without such places lacks.
    copies : int
        Twins of a site.
    is_swapped : bool
        Whether every second site is changed in place.
    falsifier_sees_change : bool
        Of which of the two places the falsifier's vectors are, at every site: of the changed one, or of the plain one.
        So they tell nothing about which of the two is seen.
    """

    change_of: ChangeOf | None
    find: Callable[[Scene], NDArray[np.float64] | None]
    needs: str
    copies: int = 1
    is_swapped: bool = True
    falsifier_sees_change: bool = False

    def lack(self, scene: Scene) -> str | None:
        """Places of the right kind are needed."""
        places = self.find(scene)
        return None if places is None or len(places) else self.needs

    def anchors(self, scene: Scene) -> NDArray[np.float64] | None:
        """Near what the suite is about."""
        return self.find(scene)

    def radius_m(self, scene: Scene) -> float:
        """Of the discs that are copied: all that a view may show, wherever the disc's middle lies."""
        return scene.view_reach_m + OFF_M

    def spacing_m(self, scene: Scene) -> float:
        """So that what is copied from one site is not pasted over for another."""
        return 2 * self.clear_m(scene)

    def clear_m(self, scene: Scene) -> float:
        """All that is copied: what is unknown at the site and known at its twin would tell them apart."""
        return self.radius_m(scene) + OFF_M

    def edit(self, scene: Scene, sites: Sequence[Site], seeds: Seeds) -> Edit:
        """Find a place for every twin, say what is copied where, and by lot which of them is the true place."""
        clear_m = self.clear_m(scene)
        apart_m = max(least_apart_m(self.main_side_m / 2), 2 * clear_m)
        targets = find_targets(scene.map, sites, clear_m=clear_m, apart_m=apart_m, copies=self.copies, seeds=seeds)
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
        """The copies of one site; where the site is the changed one, itself as well."""
        turn, share = seeds.rng("off", *_key(site)).random(2)
        off_m = OFF_M * np.sqrt(share) * np.array([np.sin(2 * np.pi * turn), np.cos(2 * np.pi * turn)])
        source = np.array([site.pose.easting_m, site.pose.northing_m]) + off_m
        is_changed = self.is_swapped and site.index % 2 == 1
        plain = Paste(source_m=_place(source), target_m=_place(source), radius_m=self.radius_m(scene))
        if is_changed:
            yield replace(plain, change=change)
        for target in targets:
            yield replace(plain, target_m=_place(np.array(target) + off_m), change=None if is_changed else change)

    def draw(self, scene: Scene, site: Site, variant: Variant, seeds: Seeds) -> Draft:
        """See the true place; the control has no vectors, the falsifier's do not tell the two places apart."""
        seen = self.see(scene, site, variant, seeds)
        if variant.role == "control":
            return Draft(evidence=seen)
        vectors = perceive_vectors(
            scene.world,
            site.pose if variant.role == "stress" else self._told_nothing(scene, site),
            side_m=variant.side_m,
            noise=VectorNoise(),
            rng=seeds.rng("vectors", variant.view_cells),
        )
        return Draft(evidence=seen, vectors=vectors)

    def see(self, scene: Scene, site: Site, variant: Variant, seeds: Seeds) -> Evidence:
        """Perceive the layers at the true place."""
        return perceived(scene.world, site, variant, seeds)

    def _told_nothing(self, scene: Scene, site: Site) -> Pose:
        """The site where it is the place that the falsifier's vectors are of, else its twin."""
        is_changed = (self.is_swapped and site.index % 2 == 1) != site.is_copy
        if is_changed == self.falsifier_sees_change:
            return site.pose
        easting_m, northing_m = scene.twins[site.index][0]
        return replace(site.pose, easting_m=easting_m, northing_m=northing_m)


def _key(site: Site) -> tuple[int, int]:
    return (round(site.pose.easting_m * 100), round(site.pose.northing_m * 100))


def _place(point: NDArray[np.float64]) -> tuple[float, float]:
    return (float(point[0]), float(point[1]))


def _by_lot(scene: Scene, site: Site, targets: Places, seeds: Seeds) -> tuple[Site, Places]:
    """The true place and its twins, the original first: the site itself, or any of its copies in a block."""
    blocks = {target: block for target in targets for block in scene.blocks if block.holds(target)}
    lot = int(seeds.rng("lot", *_key(site)).integers(1 + len(blocks)))
    if lot == 0:
        return site, targets
    true = list(blocks)[lot - 1]
    pose = replace(site.pose, easting_m=true[0], northing_m=true[1])
    original = (site.pose.easting_m, site.pose.northing_m)
    others = tuple(target for target in targets if target != true)
    return replace(site, pose=pose, block=blocks[true].id, is_copy=True), (original, *others)


def find_targets(
    state: State, sites: Sequence[Site], *, clear_m: float, apart_m: float, copies: int, seeds: Seeds
) -> dict[int, Places]:
    """Find free places for the copies of every site: mapped, clear of every site and copy, apart from their own.

    Sites are served in turn; one that does not get all its copies gets none and is left out. A copy lies a whole number
    of cells from its site: moved by a part of one, its mask would differ at every edge, and tell it from the place.
    """
    cell_m = state.grid.cell_size_m
    step = max(1, round(LATTICE_M / cell_m))
    inside = np.pad(state.known[::step, ::step], 1)
    deep = ndimage.distance_transform_edt(inside)[1:-1, 1:-1] > clear_m / LATTICE_M + 1
    free = state.grid.to_centres_m(np.argwhere(deep) * step)
    for site in sites:
        free = free[np.hypot(*(free - (site.pose.easting_m, site.pose.northing_m)).T) > 2 * clear_m + cell_m]
    found: dict[int, Places] = {}
    for site in sites:
        rng = seeds.rng("target", *_key(site))
        own = np.array([site.pose.easting_m, site.pose.northing_m])
        taken: list[NDArray[np.float64]] = []
        left = free
        while len(taken) < copies:
            far = left[np.hypot(*(left - own).T) > apart_m + cell_m]
            if len(far) == 0:
                break
            picked = own + np.rint((far[rng.integers(len(far))] - own) / cell_m) * cell_m
            taken.append(picked)
            left = left[np.hypot(*(left - picked).T) > apart_m + 2 * cell_m]
        if len(taken) == copies:
            free = left
            found[site.index] = tuple(_place(point) for point in taken)
    return found


def nodes_of(scene: Scene, kinds: Sequence[str], *, least_degree: int = 0) -> gpd.GeoDataFrame:
    """Nodes of the map's graph of some kinds."""
    nodes = scene.map.graph.nodes
    return nodes[nodes["kind"].isin(list(kinds)).to_numpy() & (nodes["degree"].to_numpy() >= least_degree)]


def places_of(nodes: gpd.GeoDataFrame) -> NDArray[np.float64]:
    """Easting and northing of nodes, shape (N, 2)."""
    return np.asarray(shapely.get_coordinates(nodes.geometry.to_numpy())).reshape(-1, 2)
