# SPDX-License-Identifier: Apache-2.0
"""Suites of places that look alike: alias, grade-separation, instance- and topology-twins, stable-not-distinctive."""

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Final

import numpy as np
import scipy
import shapely
from numpy.typing import NDArray

from sasgeo_bench.geometry.pose import Pose, bearing_deg, wrap_deg
from sasgeo_bench.osm.taxonomy import load_taxonomy
from sasgeo_bench.regions.evidence import UNKNOWN, Evidence
from sasgeo_bench.regions.graph import LAYERS
from sasgeo_bench.tasks.perturbations.base import share_changed
from sasgeo_bench.tasks.query import CEILING, RADII_M, PriorGroup
from sasgeo_bench.tasks.state import State
from sasgeo_bench.tasks.suites.base import (
    Edit,
    QueryDraft,
    Scene,
    Seeds,
    Site,
    Suite,
    SuiteCard,
    Variant,
    ViewRequest,
    pair,
)
from sasgeo_bench.tasks.suites.mining import min_distance_m
from sasgeo_bench.tasks.suites.vectors import site_vectors
from sasgeo_bench.tasks.twin import ROADS, Change, Paste, level_crossings, open_gaps, split_long, stagger
from sasgeo_bench.tasks.vectors import instances_of_mask

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
        room = CopySpacing(clear_m=clear_m, spacing_m=spacing_m, within_m=self.within_m)
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

    def draw(self, shot: ViewRequest) -> QueryDraft:
        """See the true place; the control has no vectors, the falsifier's do not distinguish the two places."""
        seen, role = self.see(shot), shot.variant.role
        if role == "stress":
            return QueryDraft(evidence=seen, vectors=site_vectors(shot, shot.site.pose))
        vectors = None if role == "control" else site_vectors(shot, self._uninformative_pose(shot))
        return QueryDraft(evidence=seen, vectors=vectors, measured={CEILING: 1.0 / (1 + self.copies)})

    def see(self, shot: ViewRequest) -> Evidence:
        """Perceive the layers at the true place."""
        return shot.perceived()

    def _uninformative_pose(self, shot: ViewRequest) -> Pose:
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
class CopySpacing:
    """What the copies of a site need: mapped ground around each, and least and largest distance from their site."""

    clear_m: float
    spacing_m: float
    within_m: float = math.inf


def find_targets(
    state: State, sites: Sequence[Site], room: CopySpacing, *, copies: int, seeds: Seeds
) -> dict[int, Places]:
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


_SEEN_M: Final = 90.0
_FEWEST_X: Final = 2


_PAIR_M: Final = 125.0  # between two junctions that one view shows


def _junctions(scene: Scene) -> NDArray[np.float64]:
    # 125 m between two junctions that one view shows
    return with_neighbours(places_of(nodes_of(scene, ["intersection"], least_degree=3)), within_m=_PAIR_M)


def _near(scene: Scene, site: Site, *, least_degree: int) -> NDArray[np.float64]:
    places = places_of(nodes_of(scene, ["intersection"], least_degree=least_degree))
    return np.asarray(places[np.hypot(*(places - site.en_m).T) < _SEEN_M])


GAP_M: Final = 2.0  # one or two cells: perception's own gaps are as wide


OFFSET_M: Final = 5.0  # between two T-junctions: less than the width of a road


def _change(scene: Scene, site: Site, rng: np.random.Generator) -> Change:
    """Split X-junctions into two T-junctions at half of the sites that have some; open gaps at all others."""
    crossings = _near(scene, site, least_degree=4)
    if len(crossings) >= _FEWEST_X and rng.random() < 0.5:  # half of them
        # 5 m between two T-junctions: less than the width of a road
        return lambda piece: stagger(piece, crossings, offset_m=OFFSET_M, rng=rng)
    near = _near(scene, site, least_degree=3)
    return lambda piece: open_gaps(piece, near, gap_m=GAP_M, rng=rng)


class TopologyTwins(TwinSuite):
    """Twins whose layers show each junction as at the true place or as at the twin, by lot.

    A gap is a few cells wide, but at the exact pose a few undisturbed cells are enough to distinguish the two places.
    With junctions drawn by lot, as a detector of that resolution would see them, layers cannot.
    """

    def see(self, shot: ViewRequest) -> Evidence:
        """Perceive the layers with each junction as in one of the two places."""
        easting_m, northing_m = shot.scene.twins[shot.site.index][0]
        twin = replace(shot.site.pose, easting_m=easting_m, northing_m=northing_m)
        other = shot.variant.view(shot.scene.world, twin)
        return shot.perceived(either(shot.clean(), other, shot.rng("junctions")))


_ONE_PATCH_CELLS: Final = 4  # differing cells within this distance belong to one junction


def either(own: Evidence, other: Evidence, rng: np.random.Generator) -> Evidence:
    """Take each patch of differing cells from one of two views, by lot."""
    differ = (own.cells != other.cells).any(axis=0)
    square = np.ones((3, 3), dtype=bool)
    # Differing cells within this distance belong to one junction
    near = scipy.ndimage.binary_dilation(differ, structure=square, iterations=_ONE_PATCH_CELLS // 2)
    patch, count = scipy.ndimage.label(near, structure=square)
    is_other = np.concatenate(([False], rng.random(count) < 0.5))[patch]  # half of them
    return own.replace(np.where(is_other, other.cells, own.cells))


TOPOLOGY_TWINS: Final = TopologyTwins(
    card=SuiteCard(
        name="topology-twins",
        version=2,
        title="Topology twins (G2)",
        what="A twin of the place, at most 800 m away, in which one road at each junction stops two metres short of "
        "the other, or in which every X-junction is two T-junctions five metres apart; at every second site the other "
        "way round.",
        separates="Connectivity of perceived vectors from rasters, in which each junction looks one way or the other.",
        falsifier="Vectors whose detector closes such gaps show both places alike: no gain over the control.",
        strength_unit="1 with perceived vectors",
        tracks=("retrieval", "localization"),
        group=TWIN_GROUP,
        min_density=0.1,  # with less in view a plain search lists neither place
    ),
    variants=pair("no vectors", "G2", "gaps closed"),
    change_of=_change,
    find=_junctions,
    needs="no two junctions near each other",
)


NEIGHBOUR_M: Final = 5.0
COPIES: Final = 3


class AliasSuite(TwinSuite):
    """R1: the truth is not among the candidates. R2: neighbours 5 m away. R4: identical blocks."""

    def draw(self, shot: ViewRequest) -> QueryDraft:
        """Perceive one view; the variant determines the candidates."""
        seen, kind = shot.perceived(), shot.variant.kind
        if kind.startswith("R1"):
            return QueryDraft(evidence=seen, is_present=False, is_removed=True)
        if kind.startswith("R2"):
            return QueryDraft(evidence=seen, has_twins=False, neighbours_m=_neighbours(shot.seeds.rng("neighbours")))
        has_twins = kind.startswith("R4")
        return QueryDraft(evidence=seen, has_twins=has_twins, measured={"twins": float(COPIES * has_twins)})


def _neighbours(rng: np.random.Generator) -> tuple[tuple[float, float], ...]:
    """Return a cross of five places 5 m from each other, moved so that any of them may be the true one."""
    cross = np.array([(0, 0), (1, 0), (-1, 0), (0, 1), (0, -1)]) * NEIGHBOUR_M
    moved = cross - cross[rng.integers(len(cross))]
    return tuple((float(x), float(y)) for x, y in moved)


ALIAS: Final = AliasSuite(
    card=SuiteCard(
        name="alias",
        version=1,
        title="Aliases (R1-R4)",
        what="The truth removed and its aliases left (R1), neighbours five metres apart (R2), three exact copies of "
        "the place (R4). R3 is no query of its own: the controls, pooled over town and country.",
        separates="Calibrated rejection from margins.",
        falsifier="The control has neither copies nor neighbours among its candidates.",
        strength_unit="1 where aliased",
        tracks=("retrieval",),
        min_density=0.01,
    ),
    variants=(
        Variant(role="control", kind="no copies"),
        Variant(role="stress", kind="R1 truth removed", strength=1.0),
        Variant(role="stress", kind="R2 neighbours", strength=1.0),
        Variant(role="stress", kind="R4 identical blocks", strength=1.0),
    ),
    copies=COPIES,
    within_m=math.inf,  # all of them are candidates, wherever they lie
    is_swapped=False,
)


def _overpasses(scene: Scene) -> NDArray[np.float64]:
    nodes = nodes_of(scene, ["crossing"])
    is_road = nodes["class"].isin(ROADS).to_numpy()
    return places_of(nodes[is_road & (nodes["level_difference"].to_numpy() != 0)])


class GradeSeparation(TwinSuite):
    """Twins with the bridge layer unknown in every view, so that only the vectors show the difference."""

    def draw(self, shot: ViewRequest) -> QueryDraft:
        """Hide the bridge layer."""
        draft = super().draw(shot)
        return replace(draft, evidence=without(draft.evidence, "bridge"))


def without(evidence: Evidence, class_name: str) -> Evidence:
    """Make one class unknown everywhere."""
    cells = evidence.cells.copy()
    cells[evidence.classes.index(class_name)] = UNKNOWN
    return evidence.replace(cells)


GRADE_SEPARATION: Final = GradeSeparation(
    card=SuiteCard(
        name="grade-separation",
        version=2,
        title="Grade separation (G4)",
        what="A twin, at most 800 m away, in which bridges lie on the ground, so that roads which pass over each other "
        "meet.",
        separates="Crossings without connection in the perceived vectors from rasters, in which both look alike.",
        falsifier="Bridges withheld: the vectors of both places show a level junction, and nothing separates them.",
        strength_unit="1 with perceived vectors",
        tracks=("retrieval", "localization"),
        group=TWIN_GROUP,
        min_density=0.02,
    ),
    variants=pair("no vectors", "G4", "bridge withheld"),
    change_of=lambda scene, site, rng: level_crossings,  # noqa: ARG005 - the same at every site
    find=_overpasses,
    needs="no bridge that carries one road over another",
    falsifier_sees_change=True,
)


LEAST_AREA_M2: Final = 160.0


_NEAR_M: Final = 70.0


def _halls(scene: Scene) -> NDArray[np.float64]:
    features = scene.map.features
    chosen = features[(features["class"] == "building").to_numpy() & features["is_visible"].to_numpy()]
    shapes = chosen.geometry.to_numpy()
    large = shapes[shapely.area(shapes) >= LEAST_AREA_M2]
    return with_neighbours(shapely.get_coordinates(shapely.centroid(large)).reshape(-1, 2), within_m=_NEAR_M)


class InstanceTwins(TwinSuite):
    """Twins whose falsifier derives the vectors from the mask, which is the same at both places."""

    def draw(self, shot: ViewRequest) -> QueryDraft:
        """Give instances as perceived, as derived from the mask, or none."""
        draft = super().draw(shot)
        if shot.variant.role != "falsifier":
            return draft
        return replace(draft, vectors=instances_of_mask(draft.evidence))


HOUSE_M: Final = 7.0


INSTANCE_TWINS: Final = InstanceTwins(
    card=SuiteCard(
        name="instance-twins",
        version=2,
        title="Instance twins (G3)",
        what="A twin, at most 800 m away, in which every hall is a row of houses of seven metres; the two masks are "
        "the same cell by cell.",
        separates="Instances of the perceived vectors from masks, which tie.",
        falsifier="Instances derived from the mask, which is the same at both places, must gain nothing.",
        strength_unit="1 with perceived instances",
        tracks=("retrieval", "localization"),
        group=TWIN_GROUP,
        min_density=0.05,
    ),
    variants=pair("no vectors", "G3", "instances of the mask"),
    change_of=lambda scene, site, rng: (  # noqa: ARG005 - the same at every site
        lambda piece: split_long(piece, piece_m=HOUSE_M, least_area_m2=LEAST_AREA_M2)
    ),
    find=_halls,
    needs="no two buildings of at least 160 m2 near each other",
)


STABLE: Final = tuple(name for name in LAYERS if name in load_taxonomy().having("through"))
VOLATILE: Final = {item.name: item.volatile for item in load_taxonomy().classes if item.volatile}  # and when it changes
MOST_ALIASES: Final = 8

_STEP_M: Final = 40.0
_REACH_M: Final = 90.0  # along the line in both directions: most of a view of 192 m
_SAME_DEG: Final = 12.0
_MOST_BUILT: Final = 0.03


class StableNotDistinctive(Suite):
    """Sites along straight lines of a stable class; the candidates are other places on parallel lines."""

    def lack(self, scene: Scene) -> str | None:
        """Refuse a region without straight stretches in open land."""
        return None if len(straight_places(scene)) else "no straight major road, railway or waterway in open land"

    def anchors(self, scene: Scene) -> NDArray[np.float64] | None:
        """Return places on the lines."""
        return straight_places(scene)[:, :2]

    def edit(self, scene: Scene, sites: Sequence[Site], seeds: Seeds) -> Edit | None:
        """Find existing twins, with the same distances from a line and from each other as sites; change no map."""
        places = straight_places(scene)
        spacing_m = min_distance_m(self.main_side_m / 2)
        spread_m = self.anchor_spread_m
        twins = {}
        for site in sites:
            rng = seeds.rng("alias", site.index)
            here = np.array(site.en_m)
            own = places[int(np.argmin(np.hypot(*(places[:, :2] - here).T))), 2]
            turned = np.abs(wrap_deg(2 * (places[:, 2] - own)) / 2)  # a line has no direction: modulo 180
            like = rng.permutation(places[turned <= _SAME_DEG, :2])
            like = like + rng.uniform(-spread_m, spread_m, like.shape)
            is_whole = [scene.map.is_mapped(place, self.clear_m(scene)) for place in like]
            # First few places that keep their distance from here and from each other
            taken = [here]
            for point in like[is_whole]:
                if len(taken) <= MOST_ALIASES and np.hypot(*(np.array(taken) - point).T).min() >= spacing_m:
                    taken.append(point)
            twins[site.index] = tuple((float(x), float(y)) for x, y in taken[1:])
        return Edit(
            map_pastes=(), world_pastes=None, sites=tuple(site for site in sites if twins[site.index]), twins=twins
        )

    def draw(self, shot: ViewRequest) -> QueryDraft:
        """Mirror the layers of some volatile classes within the view: all of them at strength 1."""
        seen = shot.perceived()
        # 6 steps of the change: so many however many classes there are
        after = mirrored(seen, round(shot.variant.strength * 6))
        return QueryDraft(evidence=after, measured={"cells_changed": share_changed(seen, after)})


def mirrored(evidence: Evidence, count: int) -> Evidence:
    """Mirror the first `count` volatile classes from left to right, which keeps their area."""
    cells = evidence.cells.copy()
    for index, name in enumerate(evidence.classes):
        if 0 < VOLATILE.get(name, 0) <= count:
            cells[index] = cells[index][:, ::-1]
    return evidence.replace(cells)


def straight_places(scene: Scene) -> NDArray[np.float64]:
    """Return easting, northing and bearing of points on straight stable lines in open land, shape (N, 3)."""
    features = scene.map.features
    chosen = features["class"].isin(STABLE).to_numpy() & features["is_visible"].to_numpy()
    lines = shapely.line_merge(shapely.union_all(features.geometry.to_numpy()[chosen])) if chosen.any() else None
    if lines is None:
        return np.zeros((0, 3))
    found = [_along(line) for line in shapely.get_parts(lines) if line.length > 2 * _REACH_M]
    places = np.concatenate(found) if found else np.zeros((0, 3))
    return np.asarray(places[_is_open(scene, places[:, :2])])


def _along(line: shapely.Geometry) -> NDArray[np.float64]:
    at = np.arange(_REACH_M, line.length - _REACH_M, _STEP_M)
    before, here, after = (
        shapely.get_coordinates(shapely.line_interpolate_point(line, at + shift)).reshape(-1, 2)
        for shift in (-_REACH_M, 0.0, _REACH_M)
    )
    chord = after - before
    is_straight = np.hypot(*chord.T) >= 0.995 * 2 * _REACH_M  # 0.995: least ratio of chord and line
    bearings = bearing_deg(chord[:, 0], chord[:, 1])
    return np.asarray(np.column_stack((here, bearings))[is_straight])


def _is_open(scene: Scene, places: NDArray[np.float64]) -> NDArray[np.bool_]:
    built, grid = scene.map.has("building"), scene.map.grid
    half = round(_REACH_M / grid.cell_size_m)
    found = []
    for row, col in grid.to_cells(places).tolist():
        window = built[max(0, row - half) : row + half, max(0, col - half) : col + half]
        found.append(window.size > 0 and float(window.mean()) <= _MOST_BUILT)
    return np.array(found, dtype=bool)


STABLE_NOT_DISTINCTIVE: Final = StableNotDistinctive(
    card=SuiteCard(
        name="stable-not-distinctive",
        version=1,
        title="Stable, not distinctive (S5)",
        what="A straight road, railway or canal in open land whose fields have changed; others are candidates.",
        separates="Stability times distinctiveness from stability alone, which trusts what is the same everywhere.",
        falsifier="The same places with the fields as mapped.",
        strength_unit="share of the volatile classes that have changed",
        tracks=("retrieval", "localization"),
        min_density=0.005,
    ),
    variants=(
        Variant(role="control", kind="unchanged"),
        Variant(role="stress", kind="S5", strength=0.4),
        Variant(role="stress", kind="S5", strength=1.0),
        Variant(role="falsifier", kind="unchanged again"),
    ),
)
