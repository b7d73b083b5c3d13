# SPDX-License-Identifier: Apache-2.0
"""Graph of a map, prepared for queries around a pose."""

from dataclasses import dataclass
from functools import cached_property
from typing import Final, Self

import geopandas as gpd
import numpy as np
from scipy.spatial import cKDTree

from sasgeo_bench.geometry.grid import Grid
from sasgeo_bench.regions.evidence import PRESENT
from sasgeo_bench.regions.network import LAYERS
from sasgeo_bench.regions.region import MapGraph, Region
from sasgeo_bench.sasgeo.kinds import KINDS
from sasgeo_bench.sasgeo.nodes import Bools, Floats, Ints, Nodes, nodes_of, patches_of
from sasgeo_bench.sasgeo.pairs import JUNCTIONS, JunctionPairs

CROWD_M: Final = 150.0  # around a node, where its like are counted
PAIRED_M: Final = (20.0, 230.0)  # of two junctions, on the ground
_APART_M: Final = 1e4  # much more than any gate


@dataclass(frozen=True, kw_only=True)
class MappedGraph:
    """Nodes of a map as vectors and as masks show them.

    Parameters
    ----------
    nodes : Nodes
        Places are easting and northing, metres.
    tree : cKDTree
        Of easting, northing and kind, a kind lying `_APART_M` from the next one.
    density_per_m2 : ndarray of float64, shape (K,)
        Mean density of nodes of a kind around one of them, for the chance of a random match; 0 for kinds that the map
        lacks.
    known : ndarray of bool, shape (rows, cols)
        Cells known to the map.
    grid : Grid
        Its lattice.
    """

    nodes: Nodes
    tree: cKDTree
    density_per_m2: Floats
    known: Bools
    grid: Grid

    @classmethod
    def of(cls, region: Region) -> Self:
        """Prepare the graph of a region."""
        known = np.asarray((region.layers <= PRESENT).all(axis=0))
        return cls.make(region.graph, region.features, known=known, grid=region.grid)

    @classmethod
    def make(cls, graph: MapGraph, features: gpd.GeoDataFrame, *, known: Bools, grid: Grid) -> Self:
        """Prepare a graph that was derived from features.

        Examples
        --------
        >>> import shapely
        >>> from sasgeo_bench.regions.graph import build_graph
        >>> from sasgeo_bench.tasks.vectors import as_features, vector_table
        >>> house = as_features(vector_table([("building", 0, False, shapely.box(5, 5, 9, 9))]))
        >>> grid = Grid(epsg=32632, west_m=0.0, north_m=20.0, cell_size_m=1.0, rows=20, cols=20)
        >>> mapped = MappedGraph.make(build_graph(house), house, known=np.ones((20, 20), dtype=bool), grid=grid)
        >>> [KINDS[kind].name for kind in mapped.nodes.kind]
        ['building', 'building patch']
        """
        ways = features[features["class"].isin(list(LAYERS)).to_numpy()]
        parts = (nodes_of(graph, ways, "vectors"), nodes_of(graph, ways, "mask"), patches_of(features))
        nodes = Nodes.joined(parts)
        return cls(
            nodes=nodes,
            tree=cKDTree(_raised(nodes.places_m, nodes.kind)),
            density_per_m2=_density(nodes),
            known=known,
            grid=grid,
        )

    @cached_property
    def links(self) -> dict[int, set[int]]:
        """Return the nodes that ways connect with each node."""
        return self.nodes.links()

    @cached_property
    def plan(self) -> cKDTree:
        """Return a tree of the places."""
        return cKDTree(self.nodes.places_m)

    @cached_property
    def junction_pairs(self) -> dict[int, tuple[JunctionPairs, JunctionPairs]]:
        """Return pairs of junctions of each kind, once from either end."""
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
    """Return places with their kind as a third coordinate."""
    return np.column_stack((places_m, kind * _APART_M))


def _density(nodes: Nodes) -> Floats:
    found = np.zeros(len(KINDS))
    for kind in np.unique(nodes.kind):
        places_m = nodes.places_m[nodes.kind == kind]
        counts = cKDTree(places_m).query_ball_point(places_m, CROWD_M, return_length=True)
        found[kind] = np.mean(counts) / (np.pi * CROWD_M**2)
    return found
