# SPDX-License-Identifier: Apache-2.0
"""Suites of places that really look alike: natural-twins, with both in the disc, and natural-absent, with the other."""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import islice
from typing import Final

import cv2
import numpy as np
import scipy
from numpy.typing import NDArray

from sasgeo_bench.regions.evidence import UNKNOWN
from sasgeo_bench.tasks.query import CEILING, TWIN_TURN, PriorGroup, Role
from sasgeo_bench.tasks.state import State
from sasgeo_bench.tasks.suites.base import (
    Edit,
    NaturalTwin,
    QueryDraft,
    Scene,
    Seeds,
    Site,
    Suite,
    SuiteCard,
    Variant,
    ViewRequest,
)
from sasgeo_bench.tasks.suites.mining import SCORERS, STRIDE_M, Windows, describe
from sasgeo_bench.tasks.suites.rivals import NEAR_M, window
from sasgeo_bench.tasks.suites.twins import TWIN_GROUP
from sasgeo_bench.tasks.suites.vectors import site_vectors

FURTHEST_M: Final = 2000.0  # from a place to its twin, however wide the disc
VIEW_CELLS: Final = 96  # so little ground has look-alikes in most towns; 192 m have them in grid plans alone
LEAST_LIKENESS: Final = 0.85  # below it the scorer never took one for the other (record 41)
ERRORS: Final = 2.0  # times the error of perception in its own domain, in every variant
STEP: Final = 0.05  # of the ladder of margins

_TOLERANCE_M: Final = 4.0  # of two outlines that are the same
_COARSE_M: Final = 4.0
_FINE_M: Final = 2.0
_LATTICE: Final = 3  # strides between places whose twins are looked for
_PROPOSED: Final = 3  # by each scorer
_TRIED: Final = 400  # pairs, in the order of the scorers
_KEPT: Final = 120  # sites are drawn from these
_HOPELESS: Final = LEAST_LIKENESS - 0.15  # in coarse cells: finer ones add 0.1 at most
_TIED: Final = 0.01  # the tolerance leaves shifts equal that are not
_REACH_M: Final = 24.0  # the lattice is 32 m wide, so a twin lies at most 23 m beside a point of it
_OWN_REACH_M: Final = 2 * _REACH_M
_TURNS_DEG: Final = (-12.0, -8.0, -4.0, 0.0, 4.0, 8.0, 12.0)  # within what a weak heading leaves open
_FINE_TURNS_DEG: Final = (-2.0, 0.0, 2.0)

Place = tuple[float, float]
Floats = NDArray[np.float32]
Points = NDArray[np.float64]


@dataclass(frozen=True, slots=True, kw_only=True)
class _Shares:
    """Shares of all classes in cells of a map, and the same with a tolerance, shape (C, rows, cols)."""

    own: Floats
    near: Floats

    @classmethod
    def of(cls, state: State, center_m: Place, half_m: float, cell_m: float) -> "_Shares":
        """Return the shares around a place; beyond the map there is nothing."""
        factor = max(1, round(cell_m / state.grid.cell_size_m))
        half = math.ceil(half_m / cell_m)
        row, col = state.grid.to_cells(np.array([center_m]))[0].tolist()
        size = 2 * half * factor
        bits = window(state.bits.bits, row - half * factor, col - half * factor, (size, size))
        return cls._of_bits(state, bits, factor, cell_m)

    @classmethod
    def _of_bits(cls, state: State, bits: NDArray[np.uint32], factor: int, cell_m: float) -> "_Shares":
        size = (bits.shape[1] // factor, bits.shape[0] // factor)
        known = bits >> np.uint32(31) == 0
        layers = np.stack([(bits >> np.uint32(at) & 1 > 0) & known for at in range(len(state.classes))]).astype(
            np.float32
        )
        own = np.stack([cv2.resize(layer, size, interpolation=cv2.INTER_AREA) for layer in layers])
        reach = round(_TOLERANCE_M / cell_m)
        disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * reach + 1,) * 2)
        return cls(own=own, near=np.stack([cv2.dilate(layer, disc) for layer in own]))

    def middle(self, half: int) -> "_Shares":
        """Return the square of a half side, in cells, around the middle."""
        at = self.own.shape[1] // 2
        cut = (slice(None), slice(at - half, at + half), slice(at - half, at + half))
        return _Shares(own=self.own[cut], near=self.near[cut])

    def turned(self, turn_deg: float) -> "_Shares":
        """Return what a view that is turned clockwise by an angle shows."""
        if turn_deg == 0:
            return self
        size = self.own.shape[1]
        turn = cv2.getRotationMatrix2D(((size - 1) / 2,) * 2, turn_deg, 1.0)
        own, near = (
            np.stack([cv2.warpAffine(layer, turn, (size, size)) for layer in layers]).astype(np.float32)
            for layers in (self.own, self.near)
        )
        return _Shares(own=own, near=near)


def likeness(view: _Shares, around: _Shares) -> Floats:
    """Return how alike a view and each square of its size in its surroundings are, 0..1, shape (shifts, shifts).

    Of what is drawn in either, the share that the other shows within `_TOLERANCE_M`, class by class.
    """
    shifts = around.own.shape[1] - view.own.shape[1] + 1
    shared, drawn = np.zeros((shifts, shifts), np.float32), np.full((shifts, shifts), view.own.sum(), np.float32)
    box = np.ones(view.own.shape[1:], dtype=np.float32)
    for own, near, there, there_near in zip(view.own, view.near, around.own, around.near, strict=True):
        if there.any():
            shared += cv2.matchTemplate(there_near, own, cv2.TM_CCORR) + cv2.matchTemplate(there, near, cv2.TM_CCORR)
            drawn += cv2.matchTemplate(there, box, cv2.TM_CCORR)
    return np.asarray(shared / np.maximum(drawn, np.float32(1.0)))


def mine_twins(
    state: State, *, side_m: float, clear_m: float, within_m: float, min_density: float
) -> tuple[NaturalTwin, ...]:
    """Find the places of a map that have a look-alike near them, likest by four scorers first.

    Parameters
    ----------
    state : State
        The map.
    side_m : float
        Side of the compared squares, metres.
    clear_m : float
        Half the side of the square around either place that must be mapped, metres.
    within_m : float
        Largest distance of a twin, metres. The least one is that at which no two views overlap.
    min_density : float
        Least fraction of drawn cells at either place.

    Returns
    -------
    tuple of NaturalTwin
        At most one for each place of a lattice of 96 m.

    Notes
    -----
    For each place each of the four neutral scorers of `mining` names the places that it takes for likest, at the same
    heading. The union is ordered by the mean of their distances, each over its median; then headings and shifts are
    tried and the two drawings are laid on each other. A pair is left out if a view of either place, moved by 25 to 48 m
    along its own ground, is as much like it as a twin must be: along a straight road no view has a place of its own.
    """
    windows = describe(state, side_m=side_m, clear_m=clear_m + _REACH_M)
    places = _Places(state=state, windows=windows, side_m=side_m, clear_m=clear_m)
    found = places.twins(within_m=within_m, min_density=min_density)
    return tuple(replace(twin, rank=rank) for rank, twin in enumerate(islice(found, _KEPT), start=1))


@dataclass(frozen=True, kw_only=True)
class _Places:
    """Places of a map that are compared; views of two places do not overlap if they are two `clear_m` apart."""

    state: State
    windows: Windows
    side_m: float
    clear_m: float = 0.0

    def densities(self) -> Floats:
        """Return the fraction of drawn cells around every place of the lattice."""
        half, cell_m = round(self.side_m / 2 / self.state.grid.cell_size_m), self.state.grid.cell_size_m
        sums = cv2.integral(self.state.drawn.view(np.uint8))
        cells = self.state.grid.to_cells(self.windows.points_m)
        top, left = np.clip(cells - half, 0, None).T
        bottom, right = np.minimum(cells + half, np.array(self.state.drawn.shape)).T
        total = sums[bottom, right] - sums[top, right] - sums[bottom, left] + sums[top, left]
        return np.asarray(total * cell_m**2 / self.side_m**2, dtype=np.float32)

    def lattice(self, min_density: float) -> NDArray[np.int64]:
        """Return every third place in both directions that shows enough."""
        points = self.windows.points_m
        if len(points) == 0:
            return np.zeros(0, dtype=np.int64)
        steps = np.rint((points - points.min(axis=0)) / STRIDE_M).astype(np.int64)
        return np.flatnonzero((steps % _LATTICE == 0).all(axis=1) & (self.densities() >= min_density))

    def twins(self, *, within_m: float, min_density: float) -> Iterator[NaturalTwin]:
        """Yield the twins of the places of a coarser lattice, the likest by all scorers first."""
        points = self.windows.points_m
        enough, here = np.flatnonzero(self.densities() >= min_density), self.lattice(min_density)
        if len(enough) == 0:
            return
        tree = scipy.spatial.cKDTree(points[enough])
        rows: list[tuple[int, int]] = []
        distances: list[Floats] = []
        for at, near in zip(here, tree.query_ball_point(points[here], within_m - _REACH_M), strict=True):
            far = enough[np.sort(np.array(near, dtype=np.int64))]
            far = far[np.hypot(*(points[far] - points[at]).T) >= 2 * self.clear_m + _REACH_M]
            unlike = unlikeness(self.windows, int(at), self.windows, far)
            best = _first_of_each(unlike)
            rows += [(int(at), int(far[one])) for one in best]
            distances.append(unlike[:, best])
        yield from self._aligned(in_order(rows, distances))

    def _aligned(self, pairs: Sequence[tuple[int, int]]) -> Iterator[NaturalTwin]:
        own: dict[int, float] = {}
        done: set[int] = set()
        for at, there in pairs:
            place_m = _place(self.windows.points_m[at])
            if at not in own:
                own[at] = own_likeness(self.state, place_m, self.side_m)
            if at in done or own[at] > LEAST_LIKENESS:
                continue
            twin = align(self.state, place_m, self.state, _place(self.windows.points_m[there]), side_m=self.side_m)
            if twin.likeness < LEAST_LIKENESS or own_likeness(self.state, twin.twin_m, self.side_m) > LEAST_LIKENESS:
                continue
            done.add(at)
            yield twin


def in_order(rows: Sequence[tuple[int, int]], distances: Sequence[Floats]) -> list[tuple[int, int]]:
    """Return pairs by the mean of their distances by scorer, each over its median, least first; `_TRIED` at most."""
    if not rows:
        return []
    table = np.concatenate(distances, axis=1)
    scale = np.median(table, axis=1, keepdims=True)
    means = (table / np.where(scale > 0, scale, 1.0)).mean(axis=0)
    return [rows[at] for at in np.argsort(means, kind="stable")[:_TRIED]]


def unlikeness(windows: Windows, here: int, others: Windows, far: NDArray[np.int64]) -> Floats:
    """Return the distances of one place to others by each of the four scorers at one heading, shape (4, N)."""
    found = []
    for name in SCORERS:
        table, own = (others.plain[name], windows.plain[name][here]) if name in windows.plain else (None, None)
        if table is None or own is None:
            table, own = others.polar, windows.polar[here]
        found.append(np.sqrt(((table[far] - own) ** 2).sum(axis=tuple(range(1, table.ndim)))))
    return np.stack(found)


def _first_of_each(unlike: Floats) -> NDArray[np.int64]:
    """Return the first places of each scorer, each once."""
    first = np.argsort(unlike, axis=1, kind="stable")[:, :_PROPOSED]
    return np.unique(first)


def _place(point: Points) -> Place:
    return (float(point[0]), float(point[1]))


def own_likeness(state: State, place_m: Place, side_m: float) -> float:
    """Return how alike a view is to its own ground seen `NEAR_M` to 48 m beside it, the likest way; 0..1.

    In the cells in which a pair is measured: in coarser ones a view is less like its own ground.
    """
    half, reach = round(side_m / 2 / _FINE_M), round(_OWN_REACH_M / _FINE_M)
    around = _Shares.of(state, place_m, (half + reach) * _FINE_M, _FINE_M)
    found = likeness(around.middle(half), around)
    off_m = np.hypot(*np.mgrid[-reach : reach + 1, -reach : reach + 1]) * _FINE_M
    return float(found[(off_m >= NEAR_M) & (off_m <= _OWN_REACH_M)].max())


def align(state: State, place_m: Place, other: State, near_m: Place, *, side_m: float) -> NaturalTwin:
    """Lay the drawing at a place on that near another, of the same or another map; return where they agree best."""
    turn_deg, at_m = 0.0, near_m
    best = 0.0
    for cell_m, reach_m, turns in (
        (_COARSE_M, _REACH_M, _TURNS_DEG),
        (_FINE_M, _COARSE_M, _FINE_TURNS_DEG),
    ):
        half, reach = round(side_m / 2 / cell_m), round(reach_m / cell_m)
        wide = _Shares.of(state, place_m, side_m, cell_m)  # so wide that a turned view has no empty corner
        around = _Shares.of(other, at_m, (half + reach) * cell_m, cell_m)
        found = {turn: likeness(wide.turned(turn).middle(half), around) for turn in (turn_deg + one for one in turns)}
        turn_deg = max(found, key=lambda turn: float(found[turn].max()))
        down, right = _best_shift(found[turn_deg], wide.turned(turn_deg).middle(half), around)
        at_m = (at_m[0] + float(right - reach) * cell_m, at_m[1] - float(down - reach) * cell_m)
        best = float(found[turn_deg].max())
        if best < _HOPELESS:
            break
    # The drawing at the place, turned clockwise, is the one at the twin as it lies on the map.
    return NaturalTwin(place_m=place_m, twin_m=at_m, turn_deg=-turn_deg, likeness=round(best, 4))


def _best_shift(alike: Floats, view: _Shares, around: _Shares) -> tuple[int, int]:
    """Return the shift at which two drawings share most cells, of those at which they are as alike as they can be."""
    layers = [pair for pair in zip(view.own, around.own, strict=True) if pair[1].any()]
    shared = sum((cv2.matchTemplate(there, own, cv2.TM_CCORR) for own, there in layers), np.zeros_like(alike))
    shared[alike < alike.max() - _TIED] = -1.0
    down, right = np.unravel_index(int(shared.argmax()), shared.shape)
    return int(down), int(right)


@dataclass(frozen=True, kw_only=True)
class NaturalSuite(Suite):
    """Base of suites whose sites have a look-alike that somebody else has built.

    Views of all variants have `errors` times the errors of the detector. The strength of a stress is the margin of its
    pair, 1 minus the likeness, in steps of `STEP`; `measured` has it exactly.
    """

    errors: float = ERRORS

    def within_m(self, group: PriorGroup | None) -> float:
        """Return the largest distance of a twin: 1.6 radii of the disc that is to hold both, `FURTHEST_M` at most."""
        radius_m = (group or self.card.group).radius_m
        return FURTHEST_M if radius_m is None else min(FURTHEST_M, 1.6 * radius_m)

    def mine(self, scene: Scene, group: PriorGroup | None, seeds: Seeds) -> tuple[NaturalTwin, ...]:
        """Find the twins of a scene's map; the seed tosses which of two places is asked.

        Else every place would lie on the lattice and no twin would, which alone would tell them apart.
        """
        found = mine_twins(
            scene.map,
            side_m=self.main_side_m,
            clear_m=self.clear_m(scene),
            within_m=self.within_m(group),
            min_density=self.card.min_density,
        )
        tossed = (twin.reversed() if seeds.rng("coin", *twin.place_m).random() < 0.5 else twin for twin in found)
        return tuple({twin.place_m: twin for twin in tossed}.values())

    def refusal(self, group: PriorGroup) -> str | None:
        """Refuse a disc that leaves no room for two places whose views do not overlap, or that can omit neither."""
        if group.radius_m is None:
            return f"needs a disc that omits one of two places, and {group.name} has none: use r500"
        if self.within_m(group) > 2 * self.main_side_m * math.sqrt(2):
            return super().refusal(group)
        return f"needs a disc that holds two places whose views do not overlap, and {group.name} has none: use r500"

    def lack(self, scene: Scene) -> str | None:
        """Refuse a region without two places that look alike."""
        return super().lack(scene) or (None if scene.natural else "no two places of it look alike")

    def anchors(self, scene: Scene) -> Points:
        """Return the places that have a twin."""
        return np.array([twin.place_m for twin in scene.natural]).reshape(-1, 2)

    @property
    def anchor_spread_m(self) -> float:
        """Return 0: a site is the very place that was mined."""
        return 0.0

    def edit(self, scene: Scene, sites: Sequence[Site], seeds: Seeds) -> Edit:  # noqa: ARG002
        """Name the twin of each site; no map is changed."""
        twins: dict[int, tuple[Place, ...]] = {site.index: (pair_of(scene, site).twin_m,) for site in sites}
        return Edit(sites=tuple(sites), map_pastes=(), world_pastes=None, twins=twins)

    def draw(self, shot: ViewRequest) -> QueryDraft:
        """See the place, as a falsifier without what tells it from its twin; the control's disc omits the twin."""
        twin, variant = pair_of(shot.scene, shot.site), shot.variant
        clean = shot.clean()
        if variant.role == "falsifier":
            # Unknown before anything is perceived: of what differs no error may leave a trace either.
            other = variant.view(shot.scene.map, twin.pose(shot.site.pose))
            clean = clean.replace(np.where(clean.cells == other.cells, clean.cells, np.uint8(UNKNOWN)))
        seen = shot.perceived(clean, error_factor=self.errors)
        if variant.role == "control":
            return QueryDraft(evidence=seen, has_twins=False, omits_m=(twin.twin_m,))
        draft = self.stress(shot, twin, QueryDraft(evidence=seen))
        if variant.role == "falsifier":
            # two places, one answer
            return replace(draft, measured=draft.measured | {CEILING: 0.5, "unknown_added": seen.unknown_share})
        margin = 1.0 - self.shown(shot, twin).likeness
        return replace(
            draft,
            strength=round(max(1, math.ceil(margin / STEP - 1e-6)) * STEP, 2),
            measured={"margin": round(margin, 4), "twin_rank": float(twin.rank), TWIN_TURN: twin.turn_deg},
        )

    def shown(self, shot: ViewRequest, twin: NaturalTwin) -> NaturalTwin:  # noqa: ARG002
        """Return the pair that a stress is about: that of the site."""
        return twin

    def stress(self, shot: ViewRequest, twin: NaturalTwin, draft: QueryDraft) -> QueryDraft:  # noqa: ARG002
        """Return the draft with what the suite is about."""
        return draft


def pair_of(scene: Scene, site: Site) -> NaturalTwin:
    """Return the pair of a site."""
    return next(twin for twin in scene.natural if twin.place_m == site.en_m)


class NaturalTwins(NaturalSuite):
    """The disc holds a place and its look-alike."""

    @property
    def has_rivals(self) -> bool:
        """Return True: the disc holds both."""
        return True

    def stress(self, shot: ViewRequest, twin: NaturalTwin, draft: QueryDraft) -> QueryDraft:  # noqa: ARG002
        """Add perceived vectors where the variant has some."""
        is_told = shot.variant.kind == WITH_VECTORS
        return replace(draft, vectors=site_vectors(shot, shot.site.pose)) if is_told else draft


class NaturalAbsent(NaturalSuite):
    """The disc holds the look-alike alone; or it holds the place, and the view is of the likest one of another country.

    The likest place elsewhere may be far less alike than the twin: its own margin is the strength.
    """

    def lack(self, scene: Scene) -> str | None:
        """Refuse a scene without another region, too."""
        return super().lack(scene) or (None if scene.elsewhere else "no other region: name a second one")

    def edit(self, scene: Scene, sites: Sequence[Site], seeds: Seeds) -> Edit:
        """Name the look-alike of each site in the other region, too."""
        edit = super().edit(scene, sites, seeds)
        if scene.elsewhere is None:
            return edit
        found = look_alikes(scene.map, [site.en_m for site in sites], scene.elsewhere, self, self.clear_m(scene))
        return replace(edit, elsewhere={site.index: twin for site, twin in zip(sites, found, strict=True)})

    def stress(self, shot: ViewRequest, twin: NaturalTwin, draft: QueryDraft) -> QueryDraft:
        """Search around the twin a view of the place, or around the place a view of its look-alike elsewhere."""
        if shot.variant.kind != ELSEWHERE:
            return replace(draft, is_present=False, around_m=twin.twin_m, omits_m=(shot.site.en_m,))
        scene, other = shot.scene, shot.scene.look_alikes[shot.site.index]
        assert scene.elsewhere is not None  # noqa: S101 - by `lack`
        pose = other.pose(shot.site.pose)
        seen = shot.perceived(shot.variant.view(scene.elsewhere, pose), error_factor=self.errors)
        return replace(draft, evidence=seen, is_present=False, has_pose=False)

    def shown(self, shot: ViewRequest, twin: NaturalTwin) -> NaturalTwin:
        """Return the pair with the place elsewhere for a view of that."""
        return shot.scene.look_alikes[shot.site.index] if shot.variant.kind == ELSEWHERE else twin


def look_alikes(
    state: State, places_m: Sequence[Place], other: State, suite: Suite, clear_m: float
) -> tuple[NaturalTwin, ...]:
    """Return for each place of a map the likest one of another map, of those that the four scorers name first."""
    side_m, least = suite.main_side_m, suite.card.min_density
    there = describe(other, side_m=side_m, clear_m=clear_m + _REACH_M)
    enough = np.flatnonzero(_Places(state=other, windows=there, side_m=side_m).densities() >= least)
    here = describe(state, side_m=side_m, clear_m=clear_m, like=there)
    found = []
    for place_m in places_m:
        at = int(np.argmin(np.hypot(*(here.points_m - place_m).T)))
        best = enough[_first_of_each(unlikeness(here, at, there, enough))]
        tried = [align(state, place_m, other, _place(there.points_m[one]), side_m=side_m) for one in best]
        found.append(max(tried, key=lambda twin: twin.likeness))
    return tuple(found)


WITH_VECTORS: Final = "N1 vectors"
ELSEWHERE: Final = "elsewhere"

_WHAT: Final = (
    "Two places of one map, at most 1.6 radii of the disc apart, that four unlike scorers take for likest, laid on "
    "each other as they agree best; of what is drawn at either place, the other shows 0.85 or more within 4 m."
)


def _variants(*stresses: str) -> tuple[Variant, ...]:
    """Return a control, the stresses and a falsifier, all of one size of view."""
    kinds: tuple[tuple[Role, str], ...] = (
        ("control", "twin omitted"),
        *(("stress", kind) for kind in stresses),
        ("falsifier", "difference removed"),
    )
    return tuple(
        Variant(role=role, kind=kind, strength=float(role == "stress"), view_cells=VIEW_CELLS) for role, kind in kinds
    )


NATURAL_TWINS: Final = NaturalTwins(
    card=SuiteCard(
        name="natural-twins",
        version=1,
        title="Natural twins (N1)",
        what=f"{_WHAT} The disc holds both; that of the control omits the twin. Twice the detector's error.",
        separates="Whoever weighs what differs between two real places from whoever adds up what agrees.",
        falsifier="What differs between the two places is unknown to the view: nobody may tell them apart.",
        strength_unit="margin: share of what is drawn at either place and not at the other, within 4 m",
        needs=("natural twins",),
        group=TWIN_GROUP,
        min_density=0.1,
    ),
    variants=_variants("N1", WITH_VECTORS),
)

NATURAL_ABSENT: Final = NaturalAbsent(
    card=SuiteCard(
        name="natural-absent",
        version=1,
        title="A look-alike in place of the place (N2)",
        what=f"{_WHAT} The disc holds the twin and omits the place; or it holds the place, and the view is of its "
        "look-alike in another country. The control's disc holds the place alone. Twice the detector's error.",
        separates="Rejection: a matcher that answers here makes a false fix at the most plausible place there is.",
        falsifier="What differs between the two places is unknown to the view: nobody may tell that it is another one.",
        strength_unit="margin: share of what is drawn at either place and not at the other, within 4 m",
        needs=("natural twins", "another region"),
        group=TWIN_GROUP,
        min_density=0.1,
    ),
    variants=_variants("twin alone", ELSEWHERE),
)
