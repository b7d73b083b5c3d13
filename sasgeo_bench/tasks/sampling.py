# SPDX-License-Identifier: Apache-2.0
"""Queries and truths of a suite at its sites: ids, priors, candidates and strata, the same for all suites."""

import math
from collections import Counter
from collections.abc import Callable, Hashable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Final

import numpy as np
from numpy.typing import NDArray

from sasgeo_bench.core.errors import ConfigError
from sasgeo_bench.geometry.pose import Pose, Prior
from sasgeo_bench.regions.evidence import UNKNOWN, pack, unpack
from sasgeo_bench.tasks.query import TWIN_EAST, TWIN_NORTH, YAW_SIGMA_DEG, PriorGroup, Query, Track, Truth
from sasgeo_bench.tasks.split import Split
from sasgeo_bench.tasks.state import State, share_of
from sasgeo_bench.tasks.suites.base import (
    EVERYTHING,
    Choice,
    QueryDraft,
    Scene,
    Seeds,
    Site,
    Suite,
    Variant,
    ViewRequest,
    changed_share,
)
from sasgeo_bench.tasks.suites.mining import (
    STRIDE_M,
    Decoys,
    Windows,
    candidates,
    describe,
    min_distance_m,
    mine,
    shuffled_poses,
)
from sasgeo_bench.tasks.suites.rivals import NEAR_M, RivalCheck, kind_of

CANDIDATES: Final = (10, 50, 200)  # per query; sites take turns
LEAST_DRAWN: Final = 0.01  # of a view's cells: with fewer drawn cells on the map the truth cannot be found
UNANSWERABLE: Final = "unanswerable"  # measured: 1 if the searched map shows less than that
LEAST_CANDIDATES: Final = 4  # with the truth: with fewer there is no retrieval
_SAMPLES: Final = 256
_GOLDEN: Final = math.pi * (3 - math.sqrt(5))  # golden angle: spreads points evenly
_TURNS: Final = 72
_JITTER_M: Final = STRIDE_M / 2
_ROUNDED_M: Final = 0.1  # resolution of a disc's centre
KEPT_BYTES: Final = 2**26  # of drafts, packed


@dataclass(frozen=True, kw_only=True)
class Job:
    """One query to draw; its id is known beforehand."""

    query_id: str
    site: Site
    variant: Variant
    track: Track


@dataclass(frozen=True, slots=True, kw_only=True)
class _Kept:
    """A draft without its cells, and these packed."""

    draft: QueryDraft
    shape: tuple[int, ...]
    cells: bytes

    @classmethod
    def of(cls, draft: QueryDraft) -> "_Kept":
        seen = draft.evidence
        corner = seen.replace(seen.cells[:, :1, :1].copy())
        return cls(draft=replace(draft, evidence=corner), shape=seen.cells.shape, cells=pack(seen.cells))

    def whole(self) -> QueryDraft:
        return replace(self.draft, evidence=self.draft.evidence.replace(unpack(self.cells, self.shape)))


@dataclass(kw_only=True, eq=False)
class Drafts:
    """Drafts of views that are asked for several times, each drawn once: they are the same for every track, say.

    They are kept by groups, packed, each until as many have left its group as `asked` says; all take `room_bytes` at
    most, and what finds no room is drawn again.

    Examples
    --------
    >>> from sasgeo_bench.regions.evidence import Evidence
    >>> def draw():
    ...     print("drawn")
    ...     cells = np.zeros((1, 2, 2), dtype=np.uint8)
    ...     return QueryDraft(evidence=Evidence(classes=("water",), cells=cells, cell_size_m=1.0))
    >>> drafts = Drafts(asked=Counter({"pair": 2}), room_bytes=1000)
    >>> for _ in range(2):
    ...     found = drafts.of("pair", "view", draw)
    ...     drafts.leave("pair")
    drawn
    """

    asked: Counter[Hashable] = field(default_factory=Counter)
    room_bytes: int = 0
    _kept: dict[Hashable, dict[Hashable, _Kept]] = field(default_factory=dict, init=False, repr=False)

    def of(self, group: Hashable, view: Hashable, draw: Callable[[], QueryDraft]) -> QueryDraft:
        """Return the draft of a view of a group."""
        kept = self._kept.get(group, {}).get(view)
        if kept is not None:
            return kept.whole()
        draft = draw()
        is_plain = draft.vectors is None and not draft.frames and draft.evidence.confidence is None
        if is_plain and self.asked[group] > 1 and self.room_bytes > 0:
            kept = self._kept.setdefault(group, {})[view] = _Kept.of(draft)
            self.room_bytes -= len(kept.cells)
        return draft

    def leave(self, group: Hashable) -> None:
        """Count one who asks for the views of a group no more."""
        self.asked[group] -= 1
        if self.asked[group] <= 0:
            self.room_bytes += sum(len(kept.cells) for kept in self._kept.pop(group, {}).values())


@dataclass(frozen=True, kw_only=True)
class Drawer:
    """Draw the queries of one suite on one region.

    `windows` and `mined` cache what depends only on the map and the size of a view, `rivals` searches of equal views.
    """

    suite: Suite
    scene: Scene
    seeds: Seeds
    group: PriorGroup
    split: Split
    choice: Choice = EVERYTHING
    windows: dict[tuple[str, float], Windows] = field(default_factory=dict)
    mined: dict[tuple[str, float, int], Decoys] = field(default_factory=dict)
    rivals: RivalCheck = field(default_factory=RivalCheck)

    def jobs(self, sites: Sequence[Site]) -> list[Job]:
        """Return all queries in the order of their ids, so that neighbours in the table have nothing in common."""
        jobs = [
            Job(
                query_id=self._site_seeds(site).digest("query", variant.name, track).hex()[:24],
                site=site,
                variant=variant,
                track=track,
            )
            for site in sites
            for detector in self.suite.drawn_by(self.choice.detectors)
            for variant in (replace(item, detector=detector) for item in self.suite.variants)
            for track in self.suite.tracks(variant)
            if self.choice.takes(variant, track)
        ]
        return sorted(jobs, key=lambda job: job.query_id)

    def map_of(self, job: Job) -> str:
        """Return the name of the map that a query searches."""
        return self.suite.map_region(self.scene, job.variant)

    def _site_seeds(self, site: Site) -> Seeds:
        return self.seeds.under("site", site.index)

    def why_not(self, job: Job) -> str | None:
        """Return why a query is skipped, or None: hardly any feature at its site, or few candidates.

        Sites are chosen by the features in the suite's main view; a smaller view at the same place may show hardly any.
        The map without a stress decides, so that stresses are skipped with their control. With a handful of candidates
        a retrieval query decides nothing.
        """
        is_smaller = job.variant.side_m < self.suite.main_side_m
        if is_smaller and drawn_share(self.scene.map, job.site.pose, job.variant) < LEAST_DRAWN:
            return f"less than {LEAST_DRAWN:.0%} of the map is drawn there"
        if job.track != "retrieval":
            return None
        state = self.scene.state(self.map_of(job))
        is_choice = len(self._decoys(state, job)) >= LEAST_CANDIDATES
        return None if is_choice else f"fewer than {LEAST_CANDIDATES} candidates"

    def drawn(self, jobs: Sequence[Job]) -> Iterator[tuple[Query, Truth]]:
        """Yield queries and truths in their order; pictures are drawn site by site, since a place is painted once."""
        if not self.suite.is_pictured:
            drafts = Drafts(asked=Counter(map(_alike, jobs)), room_bytes=KEPT_BYTES)
            yield from (self._drawn(job, drafts) for job in jobs)
            return
        by_site = sorted(jobs, key=lambda job: (job.site.index, job.variant.detector, job.variant.name))
        found = {job.query_id: self.draw(job) for job in by_site}
        yield from (found[job.query_id] for job in jobs)

    def draw(self, job: Job) -> tuple[Query, Truth]:
        """Draw one query and its truth."""
        return self._drawn(job, Drafts())

    def _drawn(self, job: Job, drafts: Drafts) -> tuple[Query, Truth]:
        site, seeds = job.site, self._site_seeds(job.site)
        request = ViewRequest(scene=self.scene, site=site, variant=job.variant, seeds=seeds)
        draft = drafts.of(_alike(job), None, partial(self.suite.draw, request))
        drafts.leave(_alike(job))
        group = draft.group or self.group
        if job.track == "retrieval":  # a disc around the truth would show which of the candidates is right
            group = replace(group, radius_m=None)
        state = self.scene.state(self.map_of(job))
        pose = draft.pose or site.pose
        # Twins that the disc of a query must hold: none for retrieval, whose candidates hold them
        rivals_m = self._twins_m(job.site, draft) if self.suite.has_rivals and job.track == "localization" else ()
        rng = seeds.rng("prior", group.name)
        prior = make_prior(pose, group, rng=rng, rivals_m=rivals_m, around_m=draft.around_m, omits_m=draft.omits_m)
        if rivals_m:
            listed = self.rivals.measure(state, draft.evidence, prior, truth_m=site.en_m, rivals_m=rivals_m)
            draft = replace(draft, measured=draft.measured | listed)
        if draft.away_m:
            rng = seeds.rng("away", group.name, job.variant.name)
            prior = away(prior, pose, away_m=draft.away_m, share_of=self._share_of_disc(state), rng=rng)
            draft = replace(draft, measured=draft.measured | {"away_m": round(_outside_m(prior, pose), 1)})
        decoys = self._mined(state, site, job.variant.side_m)
        places, right = self._candidates(job, draft, state, prior) if job.track == "retrieval" else ((), -1)
        query = Query(
            query_id=job.query_id,
            track=job.track,
            suite=self.suite.card.name,
            suite_version=self.suite.card.version,
            part=self.split.part_in_task(next(block for block in self.scene.blocks if block.id == site.block)),
            region=state.region,
            evidence=draft.evidence,
            observed_on=self.scene.world.date,
            season=draft.season,
            prior=prior,
            prior_group=group.name,
            candidates=places,
            vectors=draft.vectors,
            frames=draft.frames,
        )
        return query, self._truth(job, draft, state, decoys, right)

    def _share_of_disc(self, state: State) -> Callable[[tuple[float, float], float], float]:
        turns = np.arange(_SAMPLES) * _GOLDEN
        spiral = np.sqrt((np.arange(_SAMPLES) + 0.5) / _SAMPLES)[:, None] * np.column_stack(
            (np.sin(turns), np.cos(turns))
        )

        def share(center_m: tuple[float, float], radius_m: float) -> float:
            row, col = state.grid.to_cells(center_m + radius_m * spiral).T
            inside = (row >= 0) & (row < state.grid.rows) & (col >= 0) & (col < state.grid.cols)
            return float(state.known[row[inside], col[inside]].sum()) / _SAMPLES

        return share

    def _truth(self, job: Job, draft: QueryDraft, state: State, decoys: Decoys, right: int) -> Truth:
        site, variant = job.site, job.variant
        changed, world = draft.changed_share, self.scene.world
        if changed is None:
            views = (variant.view(place, site.pose) for place in (world, state))
            changed = 0.0 if state is world else changed_share(*views)
        # Mark queries at places where the searched map shows hardly any feature
        is_blank = draft.has_pose and drawn_share(state, draft.pose or site.pose, variant) < LEAST_DRAWN
        return Truth(
            query_id=job.query_id,
            is_present=draft.is_present,
            pose=(draft.pose or site.pose) if draft.has_pose else None,
            candidate=right,
            pair_id=self._site_seeds(site).digest("pair", job.track).hex()[:16],
            role=variant.role,
            kind=kind_of(variant.role, draft.kind or variant.kind, draft.measured),
            strength=variant.strength if draft.strength is None else draft.strength,
            strength_unit=self.suite.card.strength_unit,
            unknown_share=share_of(draft.evidence.cells == UNKNOWN),
            changed_share=changed,
            feature_density=site.density if draft.density is None else draft.density,
            alias_index=decoys.alias_index if draft.has_pose and draft.pose is None else None,
            block=site.block,
            scene=",".join(self.scene.scenes),
            measured=draft.measured | self._twin(site, draft) | ({UNANSWERABLE: 1.0} if is_blank else {}),
            detector=variant.detector,
            labels=draft.labels,
        )

    def _twins_m(self, site: Site, draft: QueryDraft) -> tuple[tuple[float, float], ...]:
        """Return the twins of a site (easting, northing) if a draft shows the site and has twins."""
        is_of_site = draft.has_twins and draft.has_pose and draft.pose is None
        return self.scene.twins.get(site.index, ()) if is_of_site else ()

    def _twin(self, site: Site, draft: QueryDraft) -> dict[str, float]:
        """Return the offset east and north of the site's first twin, if there is one, for contact sheets."""
        twins = self._twins_m(site, draft)
        if not twins:
            return {}
        return {
            TWIN_EAST: round(twins[0][0] - site.pose.easting_m, 2),
            TWIN_NORTH: round(twins[0][1] - site.pose.northing_m, 2),
        }

    def _mined(self, state: State, site: Site, side_m: float) -> Decoys:
        key = (state.region, side_m)
        if key not in self.windows:
            clear_m = self.suite.clear_m(self.scene) + _JITTER_M
            self.windows[key] = describe(state, side_m=side_m, clear_m=clear_m)
        if (*key, site.index) not in self.mined:
            found = mine(self.windows[key], site.en_m, count=max(CANDIDATES))
            # A fixed offset from the lattice: averaging many queries of a site removes the jitter of each query.
            off_m = self._site_seeds(site).rng("decoys", *key).uniform(-_JITTER_M, _JITTER_M, found.points_m.shape)
            self.mined[*key, site.index] = replace(found, points_m=found.points_m + off_m)
        return self.mined[*key, site.index]

    def _decoys(self, state: State, job: Job) -> NDArray[np.float64]:
        """Return decoys that keep the distance from the site's twins too, shape (N, 2)."""
        points = self._mined(state, job.site, job.variant.side_m).points_m
        for twin in self.scene.twins.get(job.site.index, ()):
            points = points[np.hypot(*(points - twin).T) >= min_distance_m(job.variant.side_m / 2)]
        return points

    def _candidates(self, job: Job, draft: QueryDraft, state: State, prior: Prior) -> tuple[tuple[Pose, ...], int]:
        """Shuffle the true place, its twins and the best decoys for each query, all jittered alike."""
        site, points = job.site, self._decoys(state, job)
        # The number of candidates must not show whether the truth or twins are among them.
        total = min(CANDIDATES[site.index % len(CANDIDATES)], len(points))
        if draft.has_twins:
            points = np.vstack((np.array(self.scene.twins.get(site.index, ())).reshape(-1, 2), points))
        rng = self._site_seeds(site).rng("candidates", job.variant.name)
        yaw_deg = prior.yaw_deg if prior.yaw_deg is not None else 0.0
        if draft.neighbours_m:
            centres = points[: max(1, total // len(draft.neighbours_m)) - 1]
            return _clusters(site.en_m, centres, draft.neighbours_m, yaw_deg=yaw_deg, rng=rng)
        own = None if draft.is_removed else site.en_m
        decoys_m = points[: total - (own is not None)]
        return candidates(own, decoys_m, yaw_deg=yaw_deg, jitter_m=_JITTER_M, rng=rng)


def _alike(job: Job) -> Hashable:
    """Return what all queries of one draft have in common: they differ by their tracks."""
    return (job.site.index, job.variant)


def drawn_share(state: State, pose: Pose, variant: Variant) -> float:
    """Return the fraction of a view's cells in which a map shows a road, building, water or other drawn feature."""
    return state.drawn_share(pose, size_cells=variant.view_cells, cell_size_m=variant.cell_size_m)


def _clusters(
    truth: tuple[float, float],
    decoys_m: NDArray[np.float64],
    cluster_m: Sequence[tuple[float, float]],
    *,
    yaw_deg: float,
    rng: np.random.Generator,
) -> tuple[tuple[Pose, ...], int]:
    """Replace every place by a cluster of neighbours, in which its own position is random, as for decoys."""
    shape = np.array(cluster_m)
    at = int(np.argmin(np.hypot(*shape.T)))
    centres = decoys_m + rng.uniform(-_JITTER_M, _JITTER_M, decoys_m.shape)
    moved = [np.array(truth) + shape, *(centre + shape - shape[rng.integers(len(shape))] for centre in centres)]
    poses, order = shuffled_poses(np.concatenate(moved), yaw_deg=yaw_deg, rng=rng)
    return poses, int(np.flatnonzero(order == at)[0])


def make_prior(
    pose: Pose,
    group: PriorGroup,
    *,
    rng: np.random.Generator,
    rivals_m: Sequence[tuple[float, float]] = (),
    around_m: tuple[float, float] | None = None,
    omits_m: Sequence[tuple[float, float]] = (),
) -> Prior:
    """Draw a prior: a disc that holds the truth anywhere, and a heading and a scale off by their sigmas.

    With rivals the disc holds them too: its centre is uniform over the places that allow it, which are the same
    whichever of them is the truth. With `omits_m` the disc holds the truth, or `around_m` in its place, and lies clear
    of those places; its centre is uniform over what allows that.
    """
    turn, radius_share, yaw_noise = rng.uniform(0, 2 * np.pi), np.sqrt(rng.random()), rng.standard_normal()
    center_m = None
    if group.radius_m is not None:
        # Slightly less than the radius, so that rounding the centre does not put the truth outside.
        reach_m = group.radius_m - _ROUNDED_M
        center_m = _around(pose, reach_m * radius_share, turn)
        if rivals_m:
            places_m = np.array([(pose.easting_m, pose.northing_m), *rivals_m])
            center_m = _holding(places_m, reach_m, rng=rng)
        elif omits_m:
            held_m = np.array([around_m or (pose.easting_m, pose.northing_m)])
            center_m = _holding(held_m, reach_m, rng=rng, omits_m=np.array(omits_m))
    sigma_deg = YAW_SIGMA_DEG[group.yaw]
    yaw_deg = None if sigma_deg is None else round(round(float(pose.yaw_deg + sigma_deg * yaw_noise), 1) % 360, 1)
    return Prior(
        center_m=center_m,
        radius_m=group.radius_m,
        yaw_deg=yaw_deg,
        yaw_sigma_deg=sigma_deg,
        scale_sigma=group.scale_sigma,
    )


def _holding(
    places_m: NDArray[np.float64],
    reach_m: float,
    *,
    rng: np.random.Generator,
    omits_m: NDArray[np.float64] | None = None,
) -> tuple[float, float]:
    """Draw a point uniformly from those within reach of all places, shape (N, 2), and none of others; to a decimetre.

    Others are `NEAR_M` out of reach at least, so that no answer beside the disc's rim counts as one of them.
    """
    low, high = places_m.max(axis=0) - reach_m, places_m.min(axis=0) + reach_m
    # Drawn from the smallest square that holds them all, which does not depend on the order of the places.
    # 1024 points drawn for a centre, of which one at least should fit
    points = rng.uniform(np.minimum(low, high), np.maximum(low, high), (1024, 2))
    off_m = np.hypot(*(points[:, None] - places_m).transpose(2, 0, 1))
    is_fit = (off_m <= reach_m).all(axis=1)
    if omits_m is not None:
        out_m = np.hypot(*(points[:, None] - omits_m).transpose(2, 0, 1))
        is_fit &= (out_m > reach_m + NEAR_M).all(axis=1)
    fit = points[is_fit]
    if len(fit) == 0:
        raise ConfigError(f"no disc of {reach_m + _ROUNDED_M:g} m holds a place and all its twins: use a wider prior")
    return (round(float(fit[0, 0]), 1), round(float(fit[0, 1]), 1))


def away(
    prior: Prior,
    pose: Pose,
    *,
    away_m: float,
    share_of: Callable[[tuple[float, float], float], float],
    rng: np.random.Generator,
) -> Prior:
    """Move a prior's disc so that the truth `pose` is outside, `away_m` to 1.5 `away_m` from its rim.

    `share_of` gives the mapped fraction of a disc (centre, radius). Of many moves the one is taken that keeps this
    fraction most nearly: a disc half outside the map would reveal that the truth is not in it.

    Raises
    ------
    ConfigError
        If the prior has no disc: then there is no place outside.
    """
    if prior.radius_m is None or prior.center_m is None:
        raise ConfigError(
            "a prior group without a disc searches the whole map, and no place is outside: name one with a disc"
        )
    radius_m = prior.radius_m
    before = share_of(prior.center_m, radius_m)
    turns = rng.uniform(0, 2 * np.pi, _TURNS)
    distance_m = radius_m + away_m * rng.uniform(1.0, 1.5, _TURNS)
    centres = [_around(pose, *pair) for pair in zip(distance_m.tolist(), turns.tolist(), strict=True)]
    return replace(prior, center_m=min(centres, key=lambda center: abs(share_of(center, radius_m) - before)))


def _outside_m(prior: Prior, pose: Pose) -> float:
    center_m = prior.center_m or (pose.easting_m, pose.northing_m)
    return math.hypot(pose.easting_m - center_m[0], pose.northing_m - center_m[1]) - (prior.radius_m or 0.0)


def _around(pose: Pose, distance_m: float, turn: float) -> tuple[float, float]:
    return (
        round(float(pose.easting_m + distance_m * np.sin(turn)), 1),
        round(float(pose.northing_m + distance_m * np.cos(turn)), 1),
    )
