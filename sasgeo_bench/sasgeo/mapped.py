# SPDX-License-Identifier: Apache-2.0
"""Graph of a map, prepared for queries around a pose, with an index of pairs of junctions."""

from contextlib import suppress
from dataclasses import asdict, dataclass, fields
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Final, Self

import numpy as np
import scipy  # its trees are loaded where they are used: matchers without a graph start without them
from numpy.typing import NDArray

from sasgeo_bench.core.arrays import map_arrays, save_arrays
from sasgeo_bench.core.errors import StoreError
from sasgeo_bench.geometry.grid import Grid
from sasgeo_bench.geometry.pose import bearing_deg
from sasgeo_bench.regions.graph import LAYERS, build_graph
from sasgeo_bench.regions.region import MapGraph, Region
from sasgeo_bench.sasgeo.nodes import (
    INDEX,
    NODE_KINDS,
    Bools,
    Floats,
    Ints,
    Nodes,
    in_plan,
    nodes_of,
    out_of_water,
    patches_of,
)

if TYPE_CHECKING:
    import geopandas as gpd
    from scipy.spatial import cKDTree

Bits = NDArray[np.uint64]

JUNCTIONS: Final = (INDEX["intersection"], INDEX["mask intersection"])
SECTORS: Final = 36  # of 10 degrees, for directions of arms
_ARMS: Final = 3
_ONE: Final = np.uint64(1)
_LAST: Final = np.uint64(SECTORS - 1)
_HALF: Final = np.uint64(SECTORS // 2)
_ALL: Final = np.uint64((1 << SECTORS) - 1)


@dataclass(frozen=True, kw_only=True)
class JunctionPairs:
    """Pairs of junctions of one kind, the nearest first: T pairs of rows of nodes, with length and bearing.

    `arms`, uint64 of shape (T, 2), has one bit for each of `SECTORS` with an arm, counted from that bearing.
    """

    ends: Ints
    length_m: Floats
    bearing_deg: Floats
    arms: Bits

    @classmethod
    def of(cls, nodes: Nodes, kind: int, *, range_m: tuple[float, float]) -> Self:
        """Return pairs of junctions with at least three arms within a range of distances, metres."""
        chosen = np.flatnonzero((nodes.kind == kind) & (np.isfinite(nodes.arms_deg).sum(axis=1) >= _ARMS))
        places_m = nodes.places_m[chosen]
        pairs = np.zeros((0, 2), dtype=np.int64)
        if len(chosen):
            pairs = scipy.spatial.cKDTree(places_m).query_pairs(range_m[1], output_type="ndarray").astype(np.int64)
        along_m = places_m[pairs[:, 1]] - places_m[pairs[:, 0]]
        length_m = np.hypot(*along_m.T)
        order = np.lexsort((pairs[:, 1], pairs[:, 0], length_m))
        order = order[length_m[order] >= range_m[0]]
        ends, bearing = chosen[pairs[order]], bearing_deg(*along_m[order].T)
        # Bits of the sectors of angles of shape (..., A), shape (...); NaN has none
        turned_deg = nodes.arms_deg[ends] - bearing[:, None, None]
        finite = np.isfinite(turned_deg)
        share = np.mod(np.where(finite, turned_deg, 0.0), 360.0) / 360.0
        sector = np.minimum((share * SECTORS).astype(np.uint64), _LAST)
        arms = np.asarray(
            np.bitwise_or.reduce(np.where(finite, _ONE << sector, np.uint64(0)), axis=-1), dtype=np.uint64
        )
        return cls(ends=ends, length_m=length_m[order], bearing_deg=bearing, arms=arms)

    def turned(self) -> Self:
        """Return the pairs from their other ends."""
        arms = self.arms[:, ::-1]
        return type(self)(
            ends=self.ends[:, ::-1],
            length_m=self.length_m,
            bearing_deg=np.mod(self.bearing_deg + 180.0, 360.0),
            arms=((arms << _HALF) | (arms >> _HALF)) & _ALL,
        )

    def like(self, arms: Bits, first: int, last: int) -> Ints:
        """Return rows from `first` to `last` whose arms, shape (2,), agree but for one more or less at each end."""
        theirs = self.arms[first:last]
        # Sectors and their neighbours
        widened = np.asarray((arms | (arms << _ONE) | (arms >> _LAST) | (arms >> _ONE) | (arms << _LAST)) & _ALL)
        common = np.bitwise_count(theirs & widened)
        count = np.bitwise_count(theirs).astype(np.int64)
        own = np.bitwise_count(arms).astype(np.int64)
        fits = (common >= np.minimum(count, own)) & (np.abs(count - own) <= 1)
        return np.asarray(first + np.flatnonzero(fits.all(axis=1)))


_FIELDS: Final = tuple(item.name for item in fields(Nodes))
CROWD_M: Final = 150.0  # around a node, where its like are counted
_APART_M: Final = 1e4  # much more than any gate


PAIRED_M: Final = (20.0, 230.0)  # of two junctions, on the ground


@dataclass(frozen=True, kw_only=True)
class MappedGraph:
    """Nodes of a map (easting, northing) as vectors and as masks show them.

    `tree` holds easting, northing and kind, a kind lying `_APART_M` from the next one. `density_per_m2`, shape (K,), is
    the mean density of nodes of a kind around one of them, for the chance of a random match; 0 for kinds that the map
    lacks. `known`, shape (rows, cols), marks cells known to the map on `grid`.
    """

    nodes: Nodes
    tree: "cKDTree"
    density_per_m2: Floats
    known: Bools
    grid: Grid

    @classmethod
    def of(cls, region: Region) -> Self:
        """Prepare the graph of a region."""
        kept = region.kept("graph")
        with suppress(StoreError):  # removed meanwhile: it is made
            if kept is not None:
                return cls.open(kept, grid=region.grid)
        return cls.make(region.graph, region.features, known=region.known(), grid=region.grid)

    @classmethod
    def make(cls, graph: MapGraph, features: "gpd.GeoDataFrame", *, known: Bools, grid: Grid) -> Self:
        """Prepare a graph that was derived from features."""
        ways = features[features["class"].isin(list(LAYERS)).to_numpy()]
        plan = in_plan(ways)
        in_masks = out_of_water(nodes_of(build_graph(plan, bounds_m=grid.bounds_m), plan, "mask"), features)
        nodes = Nodes.joined((nodes_of(graph, ways, "vectors"), in_masks, patches_of(features)))
        return cls._of(nodes, known=known, grid=grid)

    @classmethod
    def open(cls, folder: Path, *, grid: Grid) -> Self:
        """Open what `save` wrote; raise `StoreError` if it is missing or damaged."""
        found = map_arrays(folder, "known", *_FIELDS)
        known = found.pop("known")
        # In memory, where they are looked up one by one
        return cls._of(Nodes(**{name: values.copy() for name, values in found.items()}), known=known, grid=grid)

    def save(self, folder: Path) -> None:
        """Write it to a folder."""
        save_arrays(folder, asdict(self.nodes) | {"known": self.known})

    @classmethod
    def _of(cls, nodes: Nodes, *, known: Bools, grid: Grid) -> Self:
        found = np.zeros(len(NODE_KINDS))
        for kind in np.unique(nodes.kind):
            places_m = nodes.places_m[nodes.kind == kind]
            counts = scipy.spatial.cKDTree(places_m).query_ball_point(places_m, CROWD_M, return_length=True)
            found[kind] = np.mean(counts) / (np.pi * CROWD_M**2)
        return cls(
            nodes=nodes,
            tree=scipy.spatial.cKDTree(_raised(nodes.places_m, nodes.kind)),
            density_per_m2=found,
            known=known,
            grid=grid,
        )

    @cached_property
    def links(self) -> dict[int, set[int]]:
        """Return the nodes that ways connect with each node."""
        return self.nodes.links()

    @cached_property
    def plan(self) -> "cKDTree":
        """Return a tree of the places."""
        return scipy.spatial.cKDTree(self.nodes.places_m)

    @cached_property
    def junction_pairs(self) -> dict[int, tuple[JunctionPairs, JunctionPairs]]:
        """Return pairs of junctions of each kind, once from either end."""
        # Of two junctions, on the ground
        found = {kind: JunctionPairs.of(self.nodes, kind, range_m=PAIRED_M) for kind in JUNCTIONS}
        return {kind: (pairs, pairs.turned()) for kind, pairs in found.items()}

    def around(self, place_m: Floats, radius_m: float) -> Ints:
        """Return sorted rows of nodes within a distance of a place."""
        return np.array(self.plan.query_ball_point(place_m, radius_m, return_sorted=True), dtype=np.int64)

    def like(self, places_m: Floats, kind: Ints, radius_m: Floats) -> tuple[Ints, Ints]:
        """Return rows of places, and of nodes of the same kind within a distance of them, shape (P,) each."""
        lists = self.tree.query_ball_point(_raised(places_m, kind), radius_m)
        rows = np.repeat(np.arange(len(places_m)), [len(item) for item in lists])
        return rows, np.array([node for item in lists for node in item], dtype=np.int64)

    def knows(self, places_m: Floats) -> Bools:
        """Return which places, shape (N, 2), the map knows."""
        row, col = self.grid.to_cells(places_m).T
        inside = (row >= 0) & (row < self.grid.rows) & (col >= 0) & (col < self.grid.cols)
        return np.asarray(inside & self.known[np.where(inside, row, 0), np.where(inside, col, 0)])


def _raised(places_m: Floats, kind: Ints) -> Floats:
    return np.column_stack((places_m, kind * _APART_M))
