# SPDX-License-Identifier: Apache-2.0
"""What every suite shares: the scene it draws from, the sites, the ladder of variants, and seeds that stay put."""

import datetime as dt
import hashlib
import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Final, Literal

import geopandas as gpd
import numpy as np
from numpy.typing import NDArray

from sasgeo_bench.geometry.grid import Grid
from sasgeo_bench.geometry.pose import Pose
from sasgeo_bench.regions.evidence import PRESENT, UNKNOWN, Evidence, LayerBits, observe
from sasgeo_bench.regions.region import MapGraph, Region
from sasgeo_bench.tasks.perturbations.ageing import Ageing
from sasgeo_bench.tasks.perturbations.perception import Perception
from sasgeo_bench.tasks.private_seed import Seed
from sasgeo_bench.tasks.query import PriorGroup, Role, Track
from sasgeo_bench.tasks.split import Block
from sasgeo_bench.tasks.twin import Paste

MAIN_VIEW_CELLS: Final = 192
VIEW_CELLS: Final = (96, 192, 384)
Need = Literal["older maps", "another region", "rates of ageing"]
DRAWN_CLASSES: Final = ("road_major", "road_minor", "path_track", "railway", "building", "waterway", "field_boundary")


@dataclass(frozen=True, kw_only=True)
class State:
    """One dated state of a place: its layers in bits, its features and its graph, on one lattice."""

    region: str
    date: dt.date
    grid: Grid
    classes: tuple[str, ...]
    bits: LayerBits
    features: gpd.GeoDataFrame
    graph: MapGraph

    @classmethod
    def of(cls, region: Region, name: str | None = None) -> "State":
        """State of a region that was read; `name` is its folder where that differs from its id."""
        return cls(
            region=name or region.manifest.id,
            date=region.manifest.extract.date,
            grid=region.grid,
            classes=region.classes,
            bits=LayerBits.of(region.layers),
            features=region.features,
            graph=region.graph,
        )

    def view(self, pose: Pose, *, size_cells: int, cell_size_m: float) -> Evidence:
        """What a perfect view from a pose would see of this state."""
        cells = observe(self.bits, self.grid, pose, size_cells=size_cells, cell_size_m=cell_size_m)
        return Evidence(classes=self.classes, cells=cells, cell_size_m=cell_size_m)

    @cached_property
    def known(self) -> NDArray[np.bool_]:
        """Where the map says anything, shape (rows, cols)."""
        return np.asarray(self.bits.bits >> np.uint32(31) == 0)

    def is_mapped(self, en_m: NDArray[np.float64], half_m: float) -> bool:
        """Whether all of a square around a place is on the map."""
        row, col = self.grid.to_cells(np.asarray(en_m)[None, :])[0].tolist()
        half = math.ceil(half_m / self.grid.cell_size_m)
        inside = half <= row < self.grid.rows - half and half <= col < self.grid.cols - half
        return inside and bool(self.known[row - half : row + half + 1, col - half : col + half + 1].all())

    def has(self, class_name: str) -> NDArray[np.bool_]:
        """Where one class is present, shape (rows, cols)."""
        bit, unknown = 1 << self.classes.index(class_name), 1 << 31
        return np.asarray(self.bits.bits & np.uint32(bit | unknown) == np.uint32(bit))

    @cached_property
    def drawn(self) -> NDArray[np.bool_]:
        """Where any of `DRAWN_CLASSES` is present: what a matcher can hold on to."""
        mask = np.uint32(sum(1 << self.classes.index(name) for name in DRAWN_CLASSES if name in self.classes))
        return np.asarray((self.bits.bits & mask).astype(bool) & self.known)


@dataclass(frozen=True, kw_only=True)
class Scene:
    """All that a suite draws from: the map to be searched, the world to be seen, and where queries may lie.

    `view_reach_m` is how far from its centre a view may show anything: half a diagonal at the largest scale. `others`
    are states of the same place at other dates, oldest first; `elsewhere` is another place, where one was given;
    `scenes` are the tags of the region; `twins` are the places that look like each site; `ageing` has the rates of
    other places.
    """

    map: State
    world: State
    blocks: tuple[Block, ...]
    view_reach_m: float
    scenes: tuple[str, ...]
    others: tuple[State, ...] = ()
    elsewhere: State | None = None
    twins: Mapping[int, tuple[tuple[float, float], ...]] = field(default_factory=dict)
    ageing: Ageing | None = None

    def state(self, region: str) -> State:
        """The state of a map by its name."""
        return next(state for state in (self.map, *self.others) if state.region == region)


@dataclass(frozen=True, slots=True, kw_only=True)
class Variant:
    """One query to be made at every site."""

    role: Role
    kind: str
    strength: float = 0.0
    view_cells: int = MAIN_VIEW_CELLS
    cell_size_m: float = 1.0

    @property
    def name(self) -> str:
        """Unique within a suite; part of the seed of a query's id."""
        return f"{self.role}/{self.kind}/{self.strength:g}/{self.view_cells}/{self.cell_size_m:g}"

    @property
    def side_m(self) -> float:
        """Side of the view on the ground for scale 1."""
        return self.view_cells * self.cell_size_m


@dataclass(frozen=True, slots=True, kw_only=True)
class Choice:
    """Which of a suite's variants are drawn; what is empty leaves all in.

    Parameters
    ----------
    views_cells : tuple of int
        Sizes of views, controls and falsifiers among them.
    kinds : tuple of str
        Kinds of stress, as they begin; controls and falsifiers are drawn whatever they are.
    tracks : tuple of str
        What is asked.

    Examples
    --------
    >>> choice = Choice(kinds=("U2",))
    >>> [choice.takes(Variant(role="stress", kind=kind), "retrieval") for kind in ("U1 rectangles", "U2 glare")]
    [False, True]
    """

    views_cells: tuple[int, ...] = ()
    kinds: tuple[str, ...] = ()
    tracks: tuple[Track, ...] = ()

    def takes(self, variant: Variant, track: Track) -> bool:
        """Whether this variant is asked on this track."""
        return (
            (not self.views_cells or variant.view_cells in self.views_cells)
            and (not self.kinds or variant.role != "stress" or variant.kind.startswith(self.kinds))
            and (not self.tracks or track in self.tracks)
        )

    def lack(self, suite: "Suite") -> str | None:
        """Say what the suite has nothing of, or None if all that is named is there."""
        if self == EVERYTHING:
            return None
        stresses = [variant for variant in suite.variants if variant.role == "stress"]
        there: dict[str, tuple[Sequence[object], Sequence[object]]] = {
            "views_cells": (self.views_cells, sorted({variant.view_cells for variant in suite.variants})),
            "kinds": (self.kinds, sorted({variant.kind for variant in stresses})),
            "tracks": (self.tracks, sorted({track for item in suite.variants for track in suite.tracks(item)})),
        }
        for name, (wanted, known) in there.items():
            lost = next((item for item in wanted if not any(_begins(one, item) for one in known)), None)
            if lost is not None:
                return f"suite {suite.card.name!r} has nothing of {name} {lost!r}: it has {', '.join(map(str, known))}"
        some = any(self.takes(item, track) for item in stresses for track in suite.tracks(item))
        return None if some else f"suite {suite.card.name!r} has no stress of all that is chosen: choose less narrowly"


EVERYTHING: Final = Choice()


def _begins(known: object, wanted: object) -> bool:
    return known.startswith(wanted) if isinstance(known, str) and isinstance(wanted, str) else known == wanted


@dataclass(frozen=True, slots=True, kw_only=True)
class Site:
    """One place and heading where a control and its stresses are seen; `is_copy` where it is the copy of another."""

    index: int
    pose: Pose
    block: str
    density: float
    is_copy: bool = False


@dataclass(frozen=True, kw_only=True)
class Draft:
    """What a suite made of a site and a variant, before ids, priors and candidates are added.

    `vectors` lie in the view's frame. `pose` is where the view was taken, if that is not the site; `has_pose` is False
    where it was not taken in this map. For retrieval, `is_removed` leaves the true place out of the candidates,
    `neighbours_m` puts a cluster of places in place of each, and `has_twins` says whether the site's twins are among
    them. `away_m` puts the searched disc at least so far from the truth that it lies outside. `group` overrides the
    prior group. `density` is that of the place that is seen, where that is not the site.
    """

    evidence: Evidence
    is_present: bool = True
    has_pose: bool = True
    pose: Pose | None = None
    vectors: gpd.GeoDataFrame | None = None
    is_removed: bool = False
    neighbours_m: tuple[tuple[float, float], ...] = ()
    has_twins: bool = True
    away_m: float = 0.0
    group: PriorGroup | None = None
    density: float | None = None
    season: str = ""
    changed_share: float | None = None
    measured: dict[str, float] = field(default_factory=dict)


@dataclass(frozen=True, slots=True, kw_only=True)
class SuiteCard:
    """What a suite does and why, for people.

    `separates` says what should differ if the mechanism works; `falsifier` which variant must show no gain. Where
    `has_own_priors`, what is known before is what the suite is about, and no other group can be asked for. `needs` is
    what its scene must hold beside a map.
    """

    name: str
    version: int
    title: str
    what: str
    separates: str
    falsifier: str
    strength_unit: str
    tracks: tuple[Track, ...] = ("localization",)
    needs: tuple[Need, ...] = ()
    has_own_priors: bool = False
    group: PriorGroup = PriorGroup(radius_m=500.0, yaw="weak", scale_sigma=0.03)  # noqa: RUF009 - frozen
    min_density: float = 0.03


@dataclass(frozen=True, kw_only=True)
class Edit:
    """What a suite does to a map before queries are drawn.

    `map_pastes` make the map that is searched, `world_pastes` the world that is seen (None where it is the map itself);
    `sites` are those that are left, some of them moved to a copy; `twins` are the places that look like each of them,
    by its index.
    """

    sites: tuple[Site, ...]
    map_pastes: tuple[Paste, ...]
    world_pastes: tuple[Paste, ...] | None
    twins: dict[int, tuple[tuple[float, float], ...]]


@dataclass(frozen=True, kw_only=True)
class Suite(ABC):
    """Region + sites + seed -> queries and truths; a child says how one query is drawn."""

    card: SuiteCard
    variants: tuple[Variant, ...]

    def lack(self, scene: Scene) -> str | None:
        """Say what the region lacks for this suite, or None if it can carry it."""
        return None if scene.map.drawn.any() else "no road, building or other thing to hold on to"

    def usable(self, scene: Scene) -> tuple[Variant, ...]:
        """Variants that this scene can carry."""
        del scene
        return self.variants

    def map_region(self, scene: Scene, variant: Variant) -> str:
        """Name of the map that a variant's queries search."""
        del variant
        return scene.map.region

    def tracks(self, variant: Variant) -> tuple[Track, ...]:
        """What is asked with a variant's views."""
        del variant
        return self.card.tracks

    @property
    def main_side_m(self) -> float:
        """Side of the view that most variants share."""
        sides_m = [variant.side_m for variant in self.variants]
        return max(set(sides_m), key=lambda side_m: (sides_m.count(side_m), -side_m))

    def spacing_m(self, scene: Scene) -> float:
        """Least distance between two sites."""
        del scene
        return self.main_side_m

    def clear_m(self, scene: Scene) -> float:
        """Half the side of the square around a site that must be mapped whole: what the largest view reaches."""
        return scene.view_reach_m

    def anchors(self, scene: Scene) -> NDArray[np.float64] | None:
        """Easting and northing of places the sites must be centred near, shape (N, 2); None for anywhere."""
        del scene
        return None

    def edit(self, scene: Scene, sites: Sequence[Site], seeds: "Seeds") -> Edit | None:
        """Changes of the map and the world that the sites need, or None."""
        del scene, sites, seeds
        return None

    @abstractmethod
    def draw(self, scene: Scene, site: Site, variant: Variant, seeds: "Seeds") -> Draft:
        """Make one query's evidence and truth."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Seeds:
    """Streams of chance for one site, told apart by their purpose and nothing else.

    Parameters
    ----------
    root : int or PrivateSeed
        The seed of the whole request.
    names : tuple of str
        Region, suite and site.

    Examples
    --------
    >>> seeds = Seeds(root=1, names=("vaduz", "clean", "7"))
    >>> bool(seeds.rng("yaw").integers(100) == seeds.rng("yaw").integers(100))
    True
    """

    root: Seed
    names: tuple[str, ...]

    def digest(self, *purpose: object) -> bytes:
        """SHA-256 of the seed, the names and a purpose."""
        root = self.root if isinstance(self.root, int) else self.root.root
        text = "/".join(map(str, (root, *self.names, *purpose)))
        return hashlib.sha256(text.encode()).digest()

    def rng(self, *purpose: object) -> np.random.Generator:
        """A generator for one purpose; asking for it again gives the same stream from the start."""
        return np.random.default_rng(int.from_bytes(self.digest(*purpose)[:16], "big"))

    def under(self, *names: object) -> "Seeds":
        """Seeds of something within."""
        return Seeds(root=self.root, names=(*self.names, *map(str, names)))


def perceived(
    state: State,
    site: Site,
    variant: Variant,
    seeds: Seeds,
    *,
    error_factor: float = 1.0,
    clean: Evidence | None = None,
) -> Evidence:
    """View of a state with perception's errors; the same errors in every variant of a site with this view.

    What differs between a control and its stress is then the stress alone. `clean` is the view without errors, where
    it is no longer that of the state.
    """
    if clean is None:
        clean = state.view(site.pose, size_cells=variant.view_cells, cell_size_m=variant.cell_size_m)
    rng = seeds.rng("perception", variant.view_cells, variant.cell_size_m)
    return Perception(error_factor=error_factor)(clean, rng)


def changed_share(first: Evidence, second: Evidence) -> float:
    """Share of what either view shows, over all classes, that only one of them shows; unknown cells are left out.

    Examples
    --------
    >>> one, two = (
    ...     Evidence(classes=("a",), cells=np.array([[row]], dtype=np.uint8), cell_size_m=1.0)
    ...     for row in ([1, 1, 0, 2], [1, 0, 0, 1])
    ... )
    >>> changed_share(one, two)
    0.5
    """
    known = (first.cells != UNKNOWN) & (second.cells != UNKNOWN)
    one, two = first.cells == PRESENT, second.cells == PRESENT
    either = float((known & (one | two)).sum())
    return float((known & (one ^ two)).sum()) / either if either else 0.0


def ladder(
    kind: str,
    strengths: tuple[float, ...],
    *,
    small: tuple[float, ...] = (),
    large: tuple[float, ...] = (),
) -> tuple[Variant, ...]:
    """Stress variants: strengths at the main view, and those of the views half and twice as wide.

    A plain matcher should fail somewhere on the ladder and succeed somewhere else: what is stressed little in a large
    view is found by all, and what is stressed much in a small one by none.

    Examples
    --------
    >>> [(item.strength, item.view_cells) for item in ladder("U1", (0.2, 0.4), small=(0.4,))]
    [(0.2, 192), (0.4, 192), (0.4, 96)]
    """
    return tuple(
        Variant(role="stress", kind=kind, strength=strength, view_cells=cells)
        for cells, listed in ((MAIN_VIEW_CELLS, strengths), (min(VIEW_CELLS), small), (max(VIEW_CELLS), large))
        for strength in listed
    )


def controls(kind: str = "control", *, views: tuple[int, ...] = (MAIN_VIEW_CELLS,)) -> tuple[Variant, ...]:
    """One control for each size of view."""
    return tuple(Variant(role="control", kind=kind, view_cells=cells) for cells in views)


@dataclass(frozen=True, kw_only=True)
class PlainSuite(Suite):
    """A suite whose stress is one change of the evidence, the rest as in the control.

    `change` gets the variant, the perceived view and a generator; for a control it is not called. `check` measures what
    was done.
    """

    change: Callable[[Variant, Evidence, np.random.Generator], Evidence]
    check: Callable[[Evidence, Evidence], dict[str, float]] | None = None

    def draw(self, scene: Scene, site: Site, variant: Variant, seeds: Seeds) -> Draft:
        """Perceive, then change."""
        before = perceived(scene.world, site, variant, seeds)
        if variant.role == "control":
            return Draft(evidence=before)
        after = self.change(variant, before, seeds.rng("change", variant.kind, variant.view_cells))
        measured = {"unknown_added": after.unknown_share - before.unknown_share}
        if self.check is not None:
            measured |= self.check(before, after)
        return Draft(evidence=after, measured=measured)
