# SPDX-License-Identifier: Apache-2.0
"""The queries and truths of a suite at its sites: ids, priors, candidates and strata are the same for all suites."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from sasgeo_bench.errors import ConfigError
from sasgeo_bench.geometry.pose import Pose, Prior
from sasgeo_bench.regions.evidence import PRESENT
from sasgeo_bench.tasks.query import TWIN_EAST, TWIN_NORTH, YAW_SIGMA_DEG, PriorGroup, Query, Track, Truth
from sasgeo_bench.tasks.split import Block, Split
from sasgeo_bench.tasks.suites.base import (
    DRAWN_CLASSES,
    EVERYTHING,
    Choice,
    Draft,
    Scene,
    Seeds,
    Shot,
    Site,
    State,
    Suite,
    Variant,
    changed_share,
)
from sasgeo_bench.tasks.suites.mining import STRIDE_M, Decoys, Windows, candidates, describe, min_distance_m, mine

CANDIDATES: Final = (10, 50, 200)  # of a site, in turn
LEAST_DRAWN: Final = 0.01  # of a view's cells: a map that shows less at the truth leaves nothing to find it by
UNANSWERABLE: Final = "unanswerable"  # measured: 1 where the searched map shows less than that
LEAST_CANDIDATES: Final = 4  # the truth among them: where fewer places keep their distance there is no retrieval
_SAMPLES: Final = 256
_GOLDEN: Final = math.pi * (3 - math.sqrt(5))  # a turn that never comes back to itself: evenly spread points
_TURNS: Final = 72
_JITTER_M: Final = STRIDE_M / 2
_ROUNDED_M: Final = 0.1  # decimals of a disc's centre


@dataclass(frozen=True, kw_only=True)
class Job:
    """One query to be drawn; its id is known before it is."""

    query_id: str
    site: Site
    variant: Variant
    track: Track


@dataclass(frozen=True, kw_only=True)
class Drawer:
    """Draws the queries of one suite on one region.

    `windows` and `mined` keep what a map and a size of view share.
    """

    suite: Suite
    scene: Scene
    seeds: Seeds
    group: PriorGroup
    split: Split
    choice: Choice = EVERYTHING
    windows: dict[tuple[str, float], Windows] = field(default_factory=dict)
    mined: dict[tuple[str, float, int], Decoys] = field(default_factory=dict)

    def jobs(self, sites: Sequence[Site]) -> list[Job]:
        """All queries, in the order of their ids: neighbours in the table have nothing in common."""
        jobs = [
            Job(
                query_id=self._site_seeds(site).digest("query", variant.name, track).hex()[:24],
                site=site,
                variant=variant,
                track=track,
            )
            for site in sites
            for variant in self.suite.variants
            for track in self.suite.tracks(variant)
            if self.choice.takes(variant, track)
        ]
        return sorted(jobs, key=lambda job: job.query_id)

    def _site_seeds(self, site: Site) -> Seeds:
        return self.seeds.under("site", site.index)

    def why_not(self, job: Job) -> str | None:
        """Why a query is not asked, or None: next to nothing is drawn at its site, or there are few candidates.

        Sites were chosen by what is drawn in the suite's main view: of a smaller view at the same place it may be next
        to nothing. What counts is the map without a stress, so that stresses are left out with their control. With a
        handful of candidates a retrieval query decides nothing.
        """
        is_smaller = job.variant.side_m < self.suite.main_side_m
        if is_smaller and drawn_share(self.scene.map, job.site.pose, job.variant) < LEAST_DRAWN:
            return f"less than {LEAST_DRAWN:.0%} of the map is drawn there"
        if job.track != "retrieval":
            return None
        state = self.scene.state(self.suite.map_region(self.scene, job.variant))
        is_choice = len(self._decoys(state, job)) >= LEAST_CANDIDATES
        return None if is_choice else f"fewer than {LEAST_CANDIDATES} candidates"

    def draw(self, job: Job) -> tuple[Query, Truth]:
        """Draw one query and its truth."""
        site, seeds = job.site, self._site_seeds(job.site)
        draft = self.suite.draw(Shot(scene=self.scene, site=site, variant=job.variant, seeds=seeds))
        group = draft.group or self.group
        if job.track == "retrieval":  # the candidates say where; a disc around the truth would tell which of them
            group = replace(group, radius_m=None)
        state = self.scene.state(self.suite.map_region(self.scene, job.variant))
        pose = draft.pose or site.pose
        prior = make_prior(pose, group, rng=seeds.rng("prior", group.name))
        if draft.away_m:
            rng = seeds.rng("away", group.name, job.variant.name)
            prior = away(prior, pose, away_m=draft.away_m, share_of=self._share_of_disc(state), rng=rng)
            draft = replace(draft, measured=draft.measured | {"away_m": round(_outside_m(prior, pose), 1)})
        decoys = self._mined(state, site, job.variant.side_m)
        places: tuple[Pose, ...] = ()
        right = -1
        if job.track == "retrieval":
            places, right = self._candidates(job, draft, state, prior)
        query = Query(
            query_id=job.query_id,
            track=job.track,
            suite=self.suite.card.name,
            suite_version=self.suite.card.version,
            part=self.split.part_in_task(self._block(site)),
            region=state.region,
            evidence=draft.evidence,
            observed_on=self.scene.world.date,
            season=draft.season,
            prior=prior,
            prior_group=group.name,
            candidates=places,
            vectors=draft.vectors,
        )
        return query, self._truth(job, draft, state, decoys, right)

    def _share_of_disc(self, state: State) -> Callable[[tuple[float, float], float], float]:
        """A measure of how much of a disc is on the map."""
        turns = np.arange(_SAMPLES) * _GOLDEN
        spiral = np.sqrt((np.arange(_SAMPLES) + 0.5) / _SAMPLES)[:, None] * np.column_stack(
            (np.sin(turns), np.cos(turns))
        )

        def share(center_m: tuple[float, float], radius_m: float) -> float:
            """Share of points, spread evenly, that are mapped."""
            row, col = state.grid.to_cells(center_m + radius_m * spiral).T
            inside = (row >= 0) & (row < state.grid.rows) & (col >= 0) & (col < state.grid.cols)
            return float(state.known[row[inside], col[inside]].sum()) / _SAMPLES

        return share

    def _block(self, site: Site) -> Block:
        return next(block for block in self.scene.blocks if block.id == site.block)

    def _truth(self, job: Job, draft: Draft, state: State, decoys: Decoys, right: int) -> Truth:
        site, variant = job.site, job.variant
        changed = draft.changed_share
        if changed is None:
            same = state is self.scene.world
            cells, cell_m = variant.view_cells, variant.cell_size_m
            views = (place.view(site.pose, size_cells=cells, cell_size_m=cell_m) for place in (self.scene.world, state))
            changed = 0.0 if same else changed_share(*views)
        return Truth(
            query_id=job.query_id,
            is_present=draft.is_present,
            pose=(draft.pose or site.pose) if draft.has_pose else None,
            candidate=right,
            pair_id=self._site_seeds(site).digest("pair", job.track).hex()[:16],
            role=variant.role,
            kind=variant.kind,
            strength=variant.strength,
            strength_unit=self.suite.card.strength_unit,
            unknown_share=draft.evidence.unknown_share,
            changed_share=changed,
            feature_density=site.density if draft.density is None else draft.density,
            alias_index=decoys.alias_index if draft.has_pose and draft.pose is None else None,
            block=site.block,
            scene=",".join(self.scene.scenes),
            measured=draft.measured
            | self._twin(site, draft)
            | _unanswerable(draft, state, draft.pose or site.pose, variant),
        )

    def _twin(self, site: Site, draft: Draft) -> dict[str, float]:
        """How far east and north of the site its first twin lies, where there is one: what a sheet shows beside it."""
        twins = self.scene.twins.get(site.index, ())
        if not (twins and draft.has_twins and draft.has_pose) or draft.pose is not None:
            return {}
        return {
            TWIN_EAST: round(twins[0][0] - site.pose.easting_m, 2),
            TWIN_NORTH: round(twins[0][1] - site.pose.northing_m, 2),
        }

    def _mined(self, state: State, site: Site, side_m: float) -> Decoys:
        center_m = (site.pose.easting_m, site.pose.northing_m)
        key = (state.region, side_m)
        if key not in self.windows:
            clear_m = self.suite.clear_m(self.scene) + _JITTER_M
            self.windows[key] = describe(state, side_m=side_m, clear_m=clear_m)
        if (*key, site.index) not in self.mined:
            found = mine(self.windows[key], center_m, count=max(CANDIDATES))
            # Off their lattice once and for all: the jitter of each query goes if many queries of a site are averaged.
            off_m = self._site_seeds(site).rng("decoys", *key).uniform(-_JITTER_M, _JITTER_M, found.points_m.shape)
            self.mined[*key, site.index] = replace(found, points_m=found.points_m + off_m)
        return self.mined[*key, site.index]

    def _decoys(self, state: State, job: Job) -> NDArray[np.float64]:
        """Decoys as far from the site's twins as from the site, shape (N, 2)."""
        points = self._mined(state, job.site, job.variant.side_m).points_m
        for twin in self.scene.twins.get(job.site.index, ()):
            points = points[np.hypot(*(points - twin).T) >= min_distance_m(job.variant.side_m / 2)]
        return points

    def _candidates(self, job: Job, draft: Draft, state: State, prior: Prior) -> tuple[tuple[Pose, ...], int]:
        """The true place, its twins, and the best decoys, shuffled anew for each query; every one jittered alike."""
        site, points = job.site, self._decoys(state, job)
        truth = (site.pose.easting_m, site.pose.northing_m)
        # As many with the truth or twins as without: their number must not say whether they are among them.
        total = min(CANDIDATES[site.index % len(CANDIDATES)], len(points))
        if draft.has_twins:
            points = np.vstack((np.array(self.scene.twins.get(site.index, ())).reshape(-1, 2), points))
        rng = self._site_seeds(site).rng("candidates", job.variant.name)
        yaw_deg = prior.yaw_deg if prior.yaw_deg is not None else 0.0
        if draft.neighbours_m:
            centres = points[: max(1, total // len(draft.neighbours_m)) - 1]
            return _clusters(truth, centres, draft.neighbours_m, yaw_deg=yaw_deg, rng=rng)
        own = None if draft.is_removed else truth
        decoys_m = points[: total - (own is not None)]
        return candidates(own, decoys_m, yaw_deg=yaw_deg, jitter_m=_JITTER_M, rng=rng)


def drawn_share(state: State, pose: Pose, variant: Variant) -> float:
    """Share of the cells of a view in which a map shows a road, a building, water or another drawn thing."""
    view = state.view(pose, size_cells=variant.view_cells, cell_size_m=variant.cell_size_m)
    layers = [view.classes.index(name) for name in (*DRAWN_CLASSES, "water") if name in view.classes]
    return float((view.cells[layers] == PRESENT).any(axis=0).mean())


def _unanswerable(draft: Draft, state: State, pose: Pose, variant: Variant) -> dict[str, float]:
    """A mark on queries at places of which the searched map shows next to nothing."""
    is_blank = draft.has_pose and drawn_share(state, pose, variant) < LEAST_DRAWN
    return {UNANSWERABLE: 1.0} if is_blank else {}


def _clusters(
    truth: tuple[float, float],
    decoys_m: NDArray[np.float64],
    cluster_m: Sequence[tuple[float, float]],
    *,
    yaw_deg: float,
    rng: np.random.Generator,
) -> tuple[tuple[Pose, ...], int]:
    """A cluster of neighbours around every place; which of its cluster the truth is, is chance, as for decoys."""
    shape = np.array(cluster_m)
    at = int(np.argmin(np.hypot(*shape.T)))
    centres = decoys_m + rng.uniform(-_JITTER_M, _JITTER_M, decoys_m.shape)
    moved = [np.array(truth) + shape, *(centre + shape - shape[rng.integers(len(shape))] for centre in centres)]
    points = np.concatenate(moved)
    order = rng.permutation(len(points))
    poses = tuple(
        Pose(easting_m=round(float(x), 2), northing_m=round(float(y), 2), yaw_deg=yaw_deg) for x, y in points[order]
    )
    return poses, int(np.flatnonzero(order == at)[0])


def make_prior(pose: Pose, group: PriorGroup, *, rng: np.random.Generator) -> Prior:
    """Draw what is known before: a disc in which the truth lies anywhere, a heading and a scale off by their sigmas.

    Examples
    --------
    >>> pose = Pose(easting_m=0.0, northing_m=0.0, yaw_deg=10.0)
    >>> group = PriorGroup(radius_m=500.0, yaw="unknown", scale_sigma=0.03)
    >>> prior = make_prior(pose, group, rng=np.random.default_rng(1))
    >>> bool(np.hypot(*prior.center_m) <= 500), prior.yaw_deg is None
    (True, True)
    """
    turn, radius_share, yaw_noise = rng.uniform(0, 2 * np.pi), np.sqrt(rng.random()), rng.standard_normal()
    center_m = None
    if group.radius_m is not None:
        # A little less than the radius, so that rounding the centre does not put the truth outside.
        center_m = _around(pose, (group.radius_m - _ROUNDED_M) * radius_share, turn)
    sigma_deg = YAW_SIGMA_DEG[group.yaw]
    yaw_deg = None if sigma_deg is None else round(round(float(pose.yaw_deg + sigma_deg * yaw_noise), 1) % 360, 1)
    return Prior(
        center_m=center_m,
        radius_m=group.radius_m,
        yaw_deg=yaw_deg,
        yaw_sigma_deg=sigma_deg,
        scale_sigma=group.scale_sigma,
    )


def away(
    prior: Prior,
    pose: Pose,
    *,
    away_m: float,
    share_of: Callable[[tuple[float, float], float], float],
    rng: np.random.Generator,
) -> Prior:
    """Move a prior's disc so that the truth lies outside of it, `away_m` or half as far again from its rim.

    Parameters
    ----------
    prior : Prior
        One with the truth inside.
    pose : Pose
        The truth.
    away_m : float
        Least distance between the truth and the disc.
    share_of : callable
        (centre, radius) -> share of a disc that is on the map. Of many ways to move the disc, that one is taken which
        leaves as much of it on the map as before: a disc half off the map would tell that the truth is not in it.
    rng : numpy.random.Generator
        Chance.

    Raises
    ------
    ConfigError
        If the prior has no disc: then there is no place outside.
    """
    if prior.radius_m is None or prior.center_m is None:
        message = "a prior group without a disc searches the whole map, and no place is outside: name one with a disc"
        raise ConfigError(message)
    radius_m = prior.radius_m
    before = share_of(prior.center_m, radius_m)
    turns = rng.uniform(0, 2 * np.pi, _TURNS)
    apart_m = radius_m + away_m * rng.uniform(1.0, 1.5, _TURNS)
    centres = [_around(pose, *pair) for pair in zip(apart_m.tolist(), turns.tolist(), strict=True)]
    return replace(prior, center_m=min(centres, key=lambda center: abs(share_of(center, radius_m) - before)))


def _outside_m(prior: Prior, pose: Pose) -> float:
    """How far a pose lies outside of a prior's disc."""
    center_m = prior.center_m or (pose.easting_m, pose.northing_m)
    return math.hypot(pose.easting_m - center_m[0], pose.northing_m - center_m[1]) - (prior.radius_m or 0.0)


def _around(pose: Pose, apart_m: float, turn: float) -> tuple[float, float]:
    """A place at a distance from a pose, to a decimetre."""
    return (
        round(float(pose.easting_m + apart_m * np.sin(turn)), 1),
        round(float(pose.northing_m + apart_m * np.cos(turn)), 1),
    )
