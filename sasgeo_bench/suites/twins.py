# SPDX-License-Identifier: Apache-2.0
"""What the twin suites share: copies of a site elsewhere on the map, changed or not, and queries that must choose."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Final

import geopandas as gpd
import numpy as np
import shapely
from numpy.typing import NDArray
from scipy import ndimage

from sasgeo_bench.pose import Pose
from sasgeo_bench.query import PriorGroup
from sasgeo_bench.suites.base import Draft, Edit, Scene, Seeds, Site, State, Suite, Variant, perceived
from sasgeo_bench.suites.vectors import VectorNoise, perceive_vectors
from sasgeo_bench.twin import Change, Paste

LATTICE_M: Final = 16.0
RING_M: Final = 12.0  # cleared around a site and its twins: a cut rim must not tell the copy from the place
_APART: Final = 3.0  # radii between a site and its twin, as for every decoy
_TRIES: Final = 60

TWIN_GROUP: Final = PriorGroup(radius_m=2000.0, yaw="weak", scale_sigma=0.03)  # wide enough to hold the twins

# What turns a site into the change of its copy, with the site's own chance.
ChangeOf = Callable[[Scene, Site, np.random.Generator], Change]


@dataclass(frozen=True, kw_only=True)
class TwinSuite(Suite):
    """Every site has twins: copies elsewhere on the map that differ from it by one change.

    At every second site the true place has the change and the twin has not, so that "take the plainer one" does not
    help. A query's view is of the true place; the twins are among its candidates.

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

    def radius_m(self) -> float:
        """Of the discs that are copied: the half diagonal of the largest view, and a little for its scale."""
        return max(variant.side_m for variant in self.variants) / 2 * float(np.sqrt(2)) * 1.08

    def spacing_m(self) -> float:
        """So that the discs of two sites, which are cut out of the map, do not meet."""
        return 2 * (self.radius_m() + RING_M)

    def mapped_m(self) -> float:
        """All that is copied: what is unknown at the site and known at its twin would tell them apart."""
        return 2 * self.radius_m()

    def least_known(self) -> float:
        """The whole of it."""
        return 1.0

    def edit(self, scene: Scene, sites: Sequence[Site], seeds: Seeds) -> Edit:
        """Find a place for every twin and say what is copied where."""
        radius_m = self.radius_m()
        targets = find_targets(scene.map, sites, radius_m=radius_m + RING_M, copies=self.copies, seeds=seeds)
        pastes: list[Paste] = []
        for site in sites:
            if site.index not in targets:
                continue
            center_m = (site.pose.easting_m, site.pose.northing_m)
            change = self.change_of(scene, site, seeds.rng("twin", *_key(site))) if self.change_of else None
            swapped = self.is_swapped and site.index % 2 == 1
            plain = Paste(source_m=center_m, target_m=center_m, radius_m=radius_m, ring_m=RING_M)
            pastes.append(replace(plain, change=change if swapped else None))
            pastes += [
                replace(plain, target_m=target, change=None if swapped else change) for target in targets[site.index]
            ]
        return Edit(map_pastes=tuple(pastes), world_pastes=None, twins=targets)

    def draw(self, scene: Scene, site: Site, variant: Variant, seeds: Seeds) -> Draft:
        """See the true place; the control has no vectors, the falsifier's do not tell the two places apart."""
        seen = perceived(scene.world, site, variant, seeds)
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

    def _told_nothing(self, scene: Scene, site: Site) -> Pose:
        """The site where it is the place that the falsifier's vectors are of, else its twin."""
        is_changed = self.is_swapped and site.index % 2 == 1
        if is_changed == self.falsifier_sees_change:
            return site.pose
        easting_m, northing_m = scene.twins[site.index][0]
        return replace(site.pose, easting_m=easting_m, northing_m=northing_m)


def _key(site: Site) -> tuple[int, int]:
    return (round(site.pose.easting_m * 100), round(site.pose.northing_m * 100))


def find_targets(
    state: State, sites: Sequence[Site], *, radius_m: float, copies: int, seeds: Seeds
) -> dict[int, tuple[tuple[float, float], ...]]:
    """Find free discs for the copies of every site: mapped, off every site and every other copy, 3 radii from its own.

    Sites are served in turn; one that does not get all its copies gets none and is left out. A copy lies a whole number
    of cells from its site: moved by a part of one, its mask would differ at every edge, and tell it from the place.
    """
    cell_m = state.grid.cell_size_m
    step = max(1, round(LATTICE_M / cell_m))
    reach = radius_m / LATTICE_M
    inside = np.pad(state.known[::step, ::step], 1)
    deep = ndimage.distance_transform_edt(inside)[1:-1, 1:-1] > reach + 1
    cells = np.argwhere(deep) * step
    free = state.grid.to_centres_m(cells)
    for site in sites:
        free = free[np.hypot(*(free - (site.pose.easting_m, site.pose.northing_m)).T) > 2 * radius_m + cell_m]
    found: dict[int, tuple[tuple[float, float], ...]] = {}
    for site in sites:
        rng = seeds.rng("target", *_key(site))
        own = np.array([site.pose.easting_m, site.pose.northing_m])
        taken: list[NDArray[np.float64]] = []
        left = free
        while len(taken) < copies:
            far = left[np.hypot(*(left - own).T) > _APART * radius_m + cell_m]
            if len(far) == 0:
                break
            picked = own + np.rint((far[rng.integers(len(far))] - own) / cell_m) * cell_m
            taken.append(picked)
            left = left[np.hypot(*(left - picked).T) > 2 * radius_m + 2 * cell_m]
        if len(taken) == copies:
            free = left
            found[site.index] = tuple((float(x), float(y)) for x, y in taken)
    return found


def nodes_of(scene: Scene, kinds: Sequence[str], *, least_degree: int = 0) -> gpd.GeoDataFrame:
    """Nodes of the map's graph of some kinds."""
    nodes = scene.map.graph.nodes
    return nodes[nodes["kind"].isin(list(kinds)).to_numpy() & (nodes["degree"].to_numpy() >= least_degree)]


def places_of(nodes: gpd.GeoDataFrame) -> NDArray[np.float64]:
    """Easting and northing of nodes, shape (N, 2)."""
    return np.asarray(shapely.get_coordinates(nodes.geometry.to_numpy())).reshape(-1, 2)
