# SPDX-License-Identifier: Apache-2.0
"""Kinds of nodes, their sources, and probabilities of seeing them."""

from dataclasses import dataclass
from typing import Final, Literal

from sasgeo_bench.regions.network import LAYERS, ROAD

Drawing = Literal["vectors", "mask"]

ROADS: Final = tuple(name for name, layer in LAYERS.items() if layer == ROAD)


@dataclass(frozen=True, slots=True, kw_only=True)
class NodeKind:
    """A kind of node, its source, and probabilities set by hand.

    A node can be missed only where `classes` are known; `hit` is the probability that a visible map node is seen,
    `extra` the share of seen nodes that no map has, `spread_m` the standard deviation of its centre.
    """

    name: str
    drawing: Drawing
    classes: tuple[str, ...]
    hit: float
    extra: float
    spread_m: float = 0.0


def _kind(name: str, drawing: Drawing, classes: tuple[str, ...], *chances: float) -> NodeKind:
    hit, extra, *spread_m = chances
    return NodeKind(name=name, drawing=drawing, classes=classes, hit=hit, extra=extra, spread_m=sum(spread_m))


_RAIL: Final = (*ROADS, "railway")
_WATER: Final = (*ROADS, "waterway")
# Vectors show connections and separate houses; a mask shows neither, so its nodes have kinds of their own. A detector
# misses a tenth of the ways; where it misses one of two, there is no junction, and new ends appear.
KINDS: Final = (
    _kind("intersection", "vectors", ROADS, 0.75, 0.08),
    _kind("dead_end", "vectors", ROADS, 0.7, 0.5),
    _kind("crossing", "vectors", ROADS, 0.75, 0.08),
    _kind("level_crossing", "vectors", _RAIL, 0.75, 0.08),
    _kind("road_rail_crossing", "vectors", _RAIL, 0.75, 0.08),
    _kind("road_water_crossing", "vectors", _WATER, 0.75, 0.1),
    _kind("river_bend", "vectors", ("waterway",), 0.5, 0.3, 10.0),
    _kind("building", "vectors", ("building",), 0.85, 0.1),
    _kind("mask intersection", "mask", ROADS, 0.6, 0.3),
    _kind("mask dead_end", "mask", ROADS, 0.4, 0.8, 2.0),
    _kind("mask rail crossing", "mask", _RAIL, 0.6, 0.3),
    _kind("mask water crossing", "mask", _WATER, 0.5, 0.3),
    _kind("mask river_bend", "mask", ("waterway",), 0.4, 0.4, 10.0),
    _kind("building patch", "mask", ("building",), 0.75, 0.2),
    _kind("farmland patch", "mask", ("farmland",), 0.4, 0.5, 8.0),
    _kind("green patch", "mask", ("green",), 0.4, 0.5, 8.0),
    _kind("parking patch", "mask", ("parking",), 0.5, 0.4, 4.0),
    _kind("water patch", "mask", ("water",), 0.5, 0.4, 6.0),
)
INDEX: Final = {kind.name: at for at, kind in enumerate(KINDS)}
PATCHES: Final = tuple(kind.classes[0] for kind in KINDS if kind.name.endswith("patch"))
