# SPDX-License-Identifier: Apache-2.0
"""Base of all suites: the scene they draw from, sites, variants, and stable seeds."""

import hashlib
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Final, Literal

import numpy as np
from numpy.typing import NDArray

from sasgeo_bench.geometry.pose import Pose
from sasgeo_bench.regions.evidence import PRESENT, UNKNOWN, Evidence
from sasgeo_bench.sensing.rendering.palettes import Family
from sasgeo_bench.sensing.rendering.scene import Scene as Painted
from sasgeo_bench.tasks.frames import Frame, FrameLabels
from sasgeo_bench.tasks.perturbations.ageing import Ageing
from sasgeo_bench.tasks.perturbations.perception import NO_PROFILE, perception_of
from sasgeo_bench.tasks.perturbations.perception_profile import PerceptionProfile
from sasgeo_bench.tasks.pictured_ground import PicturedGround
from sasgeo_bench.tasks.private_seed import Seed
from sasgeo_bench.tasks.query import PERCEIVED, PROFILE, PUBLISHED, Detector, PriorGroup, Role, Track
from sasgeo_bench.tasks.split import Block
from sasgeo_bench.tasks.state import State
from sasgeo_bench.tasks.twin import Paste

if TYPE_CHECKING:
    import geopandas as gpd

MAIN_VIEW_CELLS: Final = 192
VIEW_CELLS: Final = (96, 192, 384)
ANCHOR_SPREAD: Final = 0.2  # largest distance of a site from its anchor, as a fraction of the view's side
Need = Literal[
    "older maps",
    "every older map",
    "another region",
    "another picture",
    "rates of ageing",
    "imagery",
    "degraded map",
    "natural twins",
]


@dataclass(frozen=True, slots=True, kw_only=True)
class NaturalTwin:
    """Two places that look alike and were found, not made.

    `place_m` and `twin_m` are easting and northing; a view at the first looks like one at the second with a heading
    `turn_deg` clockwise of its own. `likeness`, 0..1, is the share of what is drawn at either that the other shows.
    `rank` counts from 1, the likest pair of the map by the scorers that proposed it.
    """

    place_m: tuple[float, float]
    twin_m: tuple[float, float]
    turn_deg: float
    likeness: float
    rank: int = 0

    def pose(self, seen: Pose) -> Pose:
        """Return where the twin would be seen as the place is seen from a pose."""
        easting_m, northing_m = self.twin_m
        yaw_deg = (seen.yaw_deg + self.turn_deg) % 360
        return replace(seen, easting_m=easting_m, northing_m=northing_m, yaw_deg=yaw_deg)

    def reversed(self) -> "NaturalTwin":
        """Return the same pair as its twin has it."""
        return replace(self, place_m=self.twin_m, twin_m=self.place_m, turn_deg=-self.turn_deg)


@dataclass(frozen=True, kw_only=True)
class Scene:
    """The map to search, the world to see, and everything else that a suite draws from.

    `view_reach_m` is the largest distance that a view shows from its centre. `others` are a degraded state and states
    at other dates, oldest first; `elsewhere` is another place; `pictured` is the map with the imagery of the region,
    `pictured_elsewhere` that of another place; `scenes` are its tags; `twins` are the places that look like each site;
    `ageing` has the rates of other places; `looks` are the families of palettes and materials of pictures, by block,
    and `painted` the last windows that were painted; `profile` has the errors of the detector "profile". `natural` has
    the pairs of places of the map that look alike, `look_alikes` for each site its twin elsewhere.
    """

    map: State
    world: State
    blocks: tuple[Block, ...]
    view_reach_m: float
    scenes: tuple[str, ...]
    others: tuple[State, ...] = ()
    elsewhere: State | None = None
    pictured: PicturedGround | None = None
    pictured_elsewhere: PicturedGround | None = None
    twins: Mapping[int, tuple[tuple[float, float], ...]] = field(default_factory=dict)
    ageing: Ageing | None = None
    looks: Mapping[str, Family] = field(default_factory=dict)
    painted: dict[tuple[object, ...], Painted] = field(default_factory=dict, repr=False)
    profile: PerceptionProfile | None = None
    natural: tuple[NaturalTwin, ...] = ()
    look_alikes: Mapping[int, NaturalTwin] = field(default_factory=dict)

    def state(self, region: str) -> State:
        """Return the state of a map by its name."""
        return next(state for state in (self.map, *self.others) if state.region == region)


@dataclass(frozen=True, slots=True, kw_only=True)
class Variant:
    """One query to draw at every site; `radius_m` is that of its disc, where it has one of its own."""

    role: Role
    kind: str
    strength: float = 0.0
    view_cells: int = MAIN_VIEW_CELLS
    cell_size_m: float = 1.0
    detector: Detector = PUBLISHED
    radius_m: float | None = None

    @property
    def name(self) -> str:
        """Return the name within the suite, part of the seed of a query's id."""
        plain = f"{self.role}/{self.kind}/{self.strength:g}/{self.view_cells}/{self.cell_size_m:g}"
        disc = () if self.radius_m is None else (f"r{self.radius_m:g}",)
        return "/".join((plain, *disc, *self.others))

    @property
    def others(self) -> tuple[str, ...]:
        """Return what its seeds are named by besides: nothing for the detector that came first."""
        return () if self.detector == PUBLISHED else (self.detector,)

    @property
    def side_m(self) -> float:
        """Return the side of the view on the ground for scale 1."""
        return self.view_cells * self.cell_size_m

    def view(self, state: State, pose: Pose) -> Evidence:
        """Return what a perfect detector would see of a state from a pose."""
        return state.view(pose, size_cells=self.view_cells, cell_size_m=self.cell_size_m)


@dataclass(frozen=True, slots=True, kw_only=True)
class Choice:
    """A selection of a suite's variants; an empty field selects all.

    `kinds` are prefixes of kinds of stress; controls and falsifiers are always selected. Each variant is drawn once for
    each of `detectors` that the suite has, at the same site; unless any are chosen, for its first one. `profile` has
    the errors of the detector "profile".
    """

    views_cells: tuple[int, ...] = ()
    kinds: tuple[str, ...] = ()
    tracks: tuple[Track, ...] = ()
    detectors: tuple[Detector, ...] = (PUBLISHED,)
    profile: PerceptionProfile | None = None

    def takes(self, variant: Variant, track: Track) -> bool:
        """Return whether a variant on a track is selected."""
        return (
            (not self.views_cells or variant.view_cells in self.views_cells)
            and (not self.kinds or variant.role != "stress" or variant.kind.startswith(self.kinds))
            and (not self.tracks or track in self.tracks)
        )

    def lack(self, suite: "Suite") -> str | None:
        """Return why the selection does not fit the suite, or None if it does."""
        if PROFILE in self.detectors and self.profile is None:
            return NO_PROFILE
        if self.detectors != EVERYTHING.detectors and not suite.drawn_by(self.detectors):
            named = ", ".join(map(repr, self.detectors))
            return f"suite {suite.card.name!r} is not drawn by {named}: it has {', '.join(suite.detectors)}"
        if replace(self, detectors=EVERYTHING.detectors, profile=None) == EVERYTHING:
            return None
        stresses = [variant for variant in suite.variants if variant.role == "stress"]
        there: dict[str, tuple[Sequence[object], Sequence[object]]] = {
            "views_cells": (self.views_cells, sorted({variant.view_cells for variant in suite.variants})),
            "kinds": (self.kinds, sorted({variant.kind for variant in stresses})),
            "tracks": (self.tracks, sorted({track for item in suite.variants for track in suite.tracks(item)})),
        }
        for name, (chosen, known) in there.items():
            lost = next((item for item in chosen if not any(_begins(one, item) for one in known)), None)
            if lost is not None:
                return f"suite {suite.card.name!r} has nothing of {name} {lost!r}: it has {', '.join(map(str, known))}"
        some = any(self.takes(item, track) for item in stresses for track in suite.tracks(item))
        return None if some else f"suite {suite.card.name!r} has no stress of all that is chosen: choose less narrowly"


EVERYTHING: Final = Choice()


def _begins(known: object, chosen: object) -> bool:
    return known.startswith(chosen) if isinstance(known, str) and isinstance(chosen, str) else known == chosen


@dataclass(frozen=True, slots=True, kw_only=True)
class Site:
    """One place and heading where a control and its stresses are seen; `is_copy` marks a copy of another place."""

    index: int
    pose: Pose
    block: str
    density: float
    is_copy: bool = False

    @property
    def en_m(self) -> tuple[float, float]:
        """Return easting and northing."""
        return (self.pose.easting_m, self.pose.northing_m)


@dataclass(frozen=True, kw_only=True)
class QueryDraft:
    """A query drawn by a suite, before ids, priors and candidates are added.

    `vectors` are in the view's frame. `pose` is where the view was taken, if that is not the site; `has_pose` is False
    if it was not taken in this map. For retrieval, `is_removed` removes the true place from the candidates,
    `neighbours_m` replaces each candidate by a cluster of places, and `has_twins` adds the site's twins. `away_m` is
    the least distance from the truth to the rim of a searched disc that excludes it. `around_m` is the place that the
    disc holds, if not the truth, and `omits_m` are places that it must not hold. `group` overrides the prior group,
    `kind` that of the variant.
    `density` is that of the seen place, if that is not the site; `strength` is that of the stress, if the place and not
    the variant sets it. `frames` are pictures with what is believed of their
    cameras, `labels` what is on them; their evidence is all unknown until a segmenter has seen them.
    """

    evidence: Evidence
    is_present: bool = True
    has_pose: bool = True
    pose: Pose | None = None
    vectors: "gpd.GeoDataFrame | None" = None
    is_removed: bool = False
    neighbours_m: tuple[tuple[float, float], ...] = ()
    has_twins: bool = True
    away_m: float = 0.0
    around_m: tuple[float, float] | None = None
    omits_m: tuple[tuple[float, float], ...] = ()
    group: PriorGroup | None = None
    kind: str = ""
    density: float | None = None
    season: str = ""
    changed_share: float | None = None
    strength: float | None = None
    measured: dict[str, float] = field(default_factory=dict)
    frames: tuple[Frame, ...] = ()
    labels: tuple[FrameLabels, ...] = ()

    @classmethod
    def of_change(cls, evidence: Evidence, before: Evidence, after: Evidence, **measured: float) -> "QueryDraft":
        """Return a draft that records the changed share between two perfect views."""
        share = changed_share(before, after)
        return cls(evidence=evidence, changed_share=share, measured={"changed_share": share, **measured})


@dataclass(frozen=True, slots=True, kw_only=True)
class SuiteCard:
    """Purpose and design of a suite, for people.

    `separates` states what should differ if the mechanism works, `falsifier` which variant must show no gain. A suite
    that `has_own_priors` is about priors and accepts no other group. `needs` lists what its scene must hold besides a
    map.
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
    """Changes of a map before queries are drawn.

    `map_pastes` make the searched map, `world_pastes` the seen world (None if it is the map itself); `sites` are the
    remaining ones, some of them moved to a copy; `twins` are the places that look like each of them, by its index, and
    `elsewhere` its look-alike in the other region.
    """

    sites: tuple[Site, ...]
    map_pastes: tuple[Paste, ...]
    world_pastes: tuple[Paste, ...] | None
    twins: dict[int, tuple[tuple[float, float], ...]]
    elsewhere: dict[int, NaturalTwin] = field(default_factory=dict)


@dataclass(frozen=True, kw_only=True)
class Suite(ABC):
    """Base of suites: they draw queries and truths from a scene, sites and a seed."""

    card: SuiteCard
    variants: tuple[Variant, ...]

    def lack(self, scene: Scene) -> str | None:
        """Return what the region lacks for this suite, or None."""
        return None if scene.map.drawn.any() else "no road, building or other thing to hold on to"

    @property
    def is_pictured(self) -> bool:
        """Return whether queries hold pictures, whose evidence a segmenter makes."""
        return False

    @property
    def has_rivals(self) -> bool:
        """Return whether the disc of a localization query must hold the twins of its site."""
        return False

    def refusal(self, group: PriorGroup) -> str | None:
        """Return why a prior group of the user does not fit this suite, or None."""
        if group.is_gnss and "sequence" not in self.card.tracks:
            return f"has no flights, of which prior group {group.name} is: use r50 or r100 for weak GNSS"
        return "is about what is known before: leave --prior out" if self.card.has_own_priors else None

    def fitting(self, largest_m: float | None) -> tuple[Variant, ...]:
        """Return the variants on a region that allows views of a side; None is no limit."""
        return no_larger(self.variants, largest_m)

    def usable(self, scene: Scene) -> tuple[Variant, ...]:  # noqa: ARG002
        """Return the variants that the scene allows."""
        return self.variants

    def drawn_of(self, variant: Variant, older: int) -> int:  # noqa: ARG002
        """Return how many queries a variant is at a site of a region with so many older maps."""
        return 1

    def map_region(self, scene: Scene, variant: Variant) -> str:  # noqa: ARG002
        """Return the name of the map that a variant's queries search."""
        return scene.map.region

    def older(self, scene: Scene) -> tuple[State, ...]:
        """Return the older maps that queries search: where they show nothing, a view of today asks for nothing."""
        searched = {self.map_region(scene, variant) for variant in self.usable(scene)}
        return tuple(state for state in scene.others if state.region in searched)

    @property
    def detectors(self) -> tuple[Detector, ...]:
        """Return the families of errors that it can be drawn with: of perception, or of the look of pictures."""
        return PERCEIVED

    def drawn_by(self, chosen: Sequence[Detector]) -> tuple[Detector, ...]:
        """Return which of the chosen families it is drawn with: its first one if none is chosen."""
        return self.detectors[:1] if chosen == EVERYTHING.detectors else tuple(filter(self.detectors.count, chosen))

    def tracks(self, variant: Variant) -> tuple[Track, ...]:  # noqa: ARG002
        """Return the tracks of a variant."""
        return self.card.tracks

    @property
    def main_side_m(self) -> float:
        """Return the most frequent side of a view."""
        sides_m = [variant.side_m for variant in self.variants]
        return max(set(sides_m), key=lambda side_m: (sides_m.count(side_m), -side_m))

    def spacing_m(self, scene: Scene) -> float:  # noqa: ARG002
        """Return the least distance between two sites."""
        return self.main_side_m

    def clear_m(self, scene: Scene) -> float:
        """Return half the side of the square around a site that must be mapped: the reach of the largest view."""
        return scene.view_reach_m

    def anchors(self, scene: Scene) -> NDArray[np.float64] | None:  # noqa: ARG002
        """Return places (easting, northing) that sites must be near, shape (N, 2); None for anywhere."""
        return None

    @property
    def grounds(self) -> tuple[str, ...]:
        """Return the kinds of ground of which sites are chosen in turn."""
        return ("",)

    def ground_at(self, scene: Scene, pose: Pose) -> str | None:  # noqa: ARG002
        """Return the kind of ground, of `grounds`, at what may be a site; None if it must not be one."""
        return ""

    @property
    def anchor_spread_m(self) -> float:
        """Return the largest distance of a site from its anchor, east and north."""
        return ANCHOR_SPREAD * self.main_side_m

    def mine(self, scene: Scene, group: PriorGroup | None, seeds: "Seeds") -> tuple[NaturalTwin, ...]:  # noqa: ARG002
        """Return the pairs of places of the map that look alike, for a suite that needs "natural twins"."""
        return ()

    def edit(self, scene: Scene, sites: Sequence[Site], seeds: "Seeds") -> Edit | None:  # noqa: ARG002
        """Return the changes of map and world that the sites need, or None."""
        return None

    @abstractmethod
    def draw(self, shot: "ViewRequest") -> QueryDraft:
        """Draw the evidence and truth of one query."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Seeds:
    """Random streams of one site; each depends on its purpose alone.

    `root` is the seed of the whole request; `names` are region, suite and site.
    """

    root: Seed
    names: tuple[str, ...]

    def digest(self, *purpose: object) -> bytes:
        """Return the SHA-256 of the seed, the names and a purpose."""
        root = self.root if isinstance(self.root, int) else self.root.root
        text = "/".join(map(str, (root, *self.names, *purpose)))
        return hashlib.sha256(text.encode()).digest()

    def rng(self, *purpose: object) -> np.random.Generator:
        """Return the generator of a purpose, always at the start of its stream."""
        return np.random.default_rng(int.from_bytes(self.digest(*purpose)[:16], "big"))

    def under(self, *names: object) -> "Seeds":
        """Return the seeds of a part."""
        return Seeds(root=self.root, names=(*self.names, *map(str, names)))


@dataclass(frozen=True, kw_only=True)
class ViewRequest:
    """One view to draw: a variant at a site of a scene, and the seeds of the site.

    For a view of a flight `seeds` are those of the view, and `flight_seeds` those of what lasts for the whole flight.
    """

    scene: Scene
    site: Site
    variant: Variant
    seeds: Seeds
    flight_seeds: Seeds | None = None

    @property
    def draw(self) -> tuple[str, ...]:
        """Return what seeds of errors are named by: a falsifier of single views has others than the control."""
        is_again = self.variant.role == "falsifier" and self.flight_seeds is None  # flights say it themselves
        return (*self.variant.others, *(("again",) if is_again else ()))

    def rng(self, *purpose: object) -> np.random.Generator:
        """Return the generator of a purpose for this size of view."""
        return self.seeds.rng(*purpose, self.variant.view_cells)

    def clean(self, state: State | None = None) -> Evidence:
        """Return what a perfect detector would see of a state; of the world unless given."""
        return self.variant.view(state or self.scene.world, self.site.pose)

    def perceived(self, clean: Evidence | None = None, *, error_factor: float = 1.0) -> Evidence:
        """Return a clean view (of the world unless given) with errors, equal in all variants of one `draw`."""
        variant = self.variant
        rng = self.seeds.rng("perception", variant.view_cells, variant.cell_size_m, *self.draw)
        see = perception_of(variant.detector, error_factor=error_factor, profile=self.scene.profile)
        return see(self.clean() if clean is None else clean, rng)


def changed_share(first: Evidence, second: Evidence) -> float:
    """Return the fraction of the cells present in either view, over all classes, that are present in only one.

    Unknown cells do not count.
    """
    known = (first.cells != UNKNOWN) & (second.cells != UNKNOWN)
    one, two = first.cells == PRESENT, second.cells == PRESENT
    either = float((known & (one | two)).sum())
    return float((known & (one ^ two)).sum()) / either if either else 0.0


def ladder(
    kind: str, strengths: tuple[float, ...], *, small: tuple[float, ...] = (), large: tuple[float, ...] = ()
) -> tuple[Variant, ...]:
    """Return stress variants: strengths at the main view, and at the views half and twice as wide.

    A plain matcher should fail on some steps of the ladder and succeed on others: all find a large view with little
    stress, none a small one with much.

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


def no_larger(variants: Sequence[Variant], largest_m: float | None) -> tuple[Variant, ...]:
    """Return variants whose views are no larger: larger ones shrink to the largest view that fits, each drawn once.

    For places where little ground is mapped: a view must lie on it whole. None is no limit.

    Examples
    --------
    >>> some = (*controls(), Variant(role="falsifier", kind="no error"))
    >>> [(item.role, item.view_cells) for item in no_larger(some, 128.0)]
    [('control', 96), ('falsifier', 96)]
    """
    if largest_m is None:
        return tuple(variants)
    return tuple(dict.fromkeys(replace(item, view_cells=_fitting_cells(item, largest_m)) for item in variants))


def _fitting_cells(variant: Variant, largest_m: float) -> int:
    if variant.side_m <= largest_m:
        return variant.view_cells
    return max((cells for cells in VIEW_CELLS if cells * variant.cell_size_m <= largest_m), default=min(VIEW_CELLS))


def pair(control: str, stress: str, falsifier: str) -> tuple[Variant, ...]:
    """Return a control, a stress of strength 1 and a falsifier of these kinds."""
    return (
        Variant(role="control", kind=control),
        Variant(role="stress", kind=stress, strength=1.0),
        Variant(role="falsifier", kind=falsifier),
    )


def controls(*, views: tuple[int, ...] = VIEW_CELLS) -> tuple[Variant, ...]:
    """Return one control for each size of view."""
    return tuple(Variant(role="control", kind="control", view_cells=cells) for cells in views)


@dataclass(frozen=True, kw_only=True)
class PlainSuite(Suite):
    """A suite whose stress is one change of the evidence: `change` gets variant, perceived view and generator."""

    change: Callable[[Variant, Evidence, np.random.Generator], Evidence]

    def draw(self, shot: ViewRequest) -> QueryDraft:
        """Perceive, then change unless it is a control."""
        before = shot.perceived()
        if shot.variant.role == "control":
            return QueryDraft(evidence=before)
        after = self.change(shot.variant, before, shot.rng("change", shot.variant.kind))
        return QueryDraft(evidence=after, measured={"unknown_added": after.unknown_share - before.unknown_share})
