# SPDX-License-Identifier: Apache-2.0
"""Flights of a suite over a region, and their queries and truths: views in order, with odometry between them."""

import math
from collections import Counter
from collections.abc import Hashable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from functools import partial
from typing import Final

import numpy as np
import shapely
from numpy.typing import NDArray

from sasgeo_bench.core.errors import ConfigError, FlightError, counted
from sasgeo_bench.core.progress import tell
from sasgeo_bench.flights.drift_profile import DriftProfile, load_profile
from sasgeo_bench.flights.gnss import CORRELATION_S, SIGMAS, SecondReceiver, WeakGnss, draw_gnss
from sasgeo_bench.flights.kinematics import fly
from sasgeo_bench.flights.logs import FlownPath
from sasgeo_bench.flights.odometry import LoggedSteps, Odometry, draw_odometry
from sasgeo_bench.flights.own_odometry import OwnOdometry
from sasgeo_bench.flights.plans import KINDS, PlanKind, flight_area, plan_flight
from sasgeo_bench.flights.trajectory import Trajectory
from sasgeo_bench.geometry.pose import Pose, Prior, rotation
from sasgeo_bench.regions.evidence import UNKNOWN
from sasgeo_bench.regions.region import Region
from sasgeo_bench.tasks.query import (
    GNSS_M,
    SEQUENCE_DIGITS,
    TWIN_EAST,
    TWIN_NORTH,
    PriorGroup,
    Query,
    Step,
    Truth,
    flight_id,
    view_id,
)
from sasgeo_bench.tasks.sampling import KEPT_BYTES, LEAST_DRAWN, UNANSWERABLE, Drafts, Job, drawn_share, make_prior
from sasgeo_bench.tasks.split import Split
from sasgeo_bench.tasks.state import State, share_of
from sasgeo_bench.tasks.suites.base import (
    EVERYTHING,
    Choice,
    QueryDraft,
    Scene,
    Seeds,
    Site,
    Variant,
    ViewRequest,
    changed_share,
)
from sasgeo_bench.tasks.suites.flights import (
    EXTENT,
    HEIGHT_M,
    LENGTHS_M,
    LOITER_M,
    UNEVEN,
    ChangedMapSuite,
    FlightSuite,
    Mission,
    Plot,
    ground_of,
)

Floats = NDArray[np.float64]
Disc = tuple[tuple[float, float] | None, float | None]  # middle and radius of a prior's, None where it has none

UTC: Final = "utc_s"  # measured: when a view of a logged flight was flown, seconds since 1970; the log may not tell it
LOGGED: Final = "is_logged"  # measured: whether the step to a view is of the log's own odometry
GNSS_OFF: Final = "gnss_off_m"  # measured: how far a view is from the fix of its prior
_SCALE_CUT: Final = 2.0  # sigmas, as for views alone


@dataclass(frozen=True, kw_only=True)
class Flight:
    """A flight over a region: N views, their mean spacing, the scale that all have, and how maps are changed for it.

    `own` are the steps of its log's odometry between the views, `gnss` the fixes of its log's weaker receiver.
    """

    site: Site
    views: Trajectory
    spacing_m: float
    scale: float
    plot: Plot | None = None
    own: LoggedSteps | None = None
    gnss: WeakGnss | None = None

    @property
    def length_m(self) -> float:
        """Return the distance flown from the first view to the last."""
        return float(self.views.distance_m[-1])

    @property
    def middle(self) -> int:
        """Return the index of the view in the middle."""
        return len(self.views) // 2


@dataclass(frozen=True, kw_only=True)
class LoggedFlight:
    """A flight that was flown over a region, and what its log has besides, or why it has none.

    Parameters
    ----------
    path : Trajectory
        The longest stretch over the region.
    start_s : float, optional
        When its clock was 0, seconds since 1970, UTC, if that is known.
    own : OwnOdometry or str
        Odometry that fused no GNSS.
    receiver : SecondReceiver or str
        A weaker receiver beside that of the truth.
    drift : DriftProfile, optional
        What its odometer declares and is drawn by, where a suite is not about a profile; by default that of the suite.
    """

    path: Trajectory
    start_s: float | None
    own: OwnOdometry | str
    receiver: SecondReceiver | str
    drift: DriftProfile | None = None

    @classmethod
    def of(cls, flown: FlownPath, region: Region, *, margin_m: float, group: PriorGroup) -> "LoggedFlight":
        """Read a log over a region; a receiver only where priors are of one."""
        path = flown.over(region, margin_m=margin_m)
        own: OwnOdometry | str
        receiver: SecondReceiver | str = ""
        try:
            own = flown.own_odometry()
        except FlightError as error:
            if flown.topic is not None:  # which was asked for by name
                raise
            own = str(error)
        if group.is_gnss:
            try:
                receiver = flown.second_receiver()
            except FlightError as error:
                receiver = str(error)
        return cls(path=path, start_s=flown.start_s, own=own, receiver=receiver, drift=flown.profile)

    def odometry_words(self, flight: Flight) -> str:
        """Return where the odometry of the flight is from, and tell how far that of its log is off."""
        name = Mission().profile if self.drift is None else self.drift.id
        drawn = "profiles of drift" if self.drift is None else f"the profile {name}"
        own, steps = self.own, flight.own
        if isinstance(own, str) or steps is None:
            return f"drawn by {drawn}: {own}"
        if not steps.is_logged.any():
            return f"drawn by {drawn}: {own.name} fused GNSS or has no poses along the flight ({own.told})"
        off_pct, off_deg = steps.off(flight.views)
        if not math.isnan(off_pct):
            turned = "" if math.isnan(off_deg) else f" and its turns by {off_deg:.2g} deg"
            tell(f"steps of {own.name} are off the receiver by {off_pct:.2g} % of the way{turned} (medians)")
        words = own.where(steps)
        if not steps.is_logged.all():
            words += f", drawn by the profile {name} where it fused GNSS or has no poses ({own.told})"
        if np.isnan(steps.yaw_deg).all():
            words += "; turns are drawn, as its headings are the vehicle's and so are those of the truth"
        return f"{words}; noise is declared as the profile {name} has it"


def gnss_words(flight: Flight, group: PriorGroup, logged: LoggedFlight | None) -> str:
    """Return where the fixes of priors by a weak receiver are from, and tell how far those of a log are off."""
    gnss, receiver = flight.gnss, "no log has it" if logged is None else logged.receiver
    if isinstance(receiver, str) or gnss is None or not np.isfinite(gnss.radius_m).any():
        disc_m = group.radius_m or math.nan
        why = receiver if isinstance(receiver, str) else f"{receiver.name} has no fix along the flight"
        drawn = f"drawn, {disc_m / SIGMAS:.3g} m on each axis, correlated over {CORRELATION_S:g} s"
        return f"{drawn}, in discs of {disc_m:g} m: {why}"
    is_fix = np.isfinite(gnss.radius_m)
    away_m, radius_m = gnss.away_m[is_fix], gnss.radius_m[is_fix]
    tell(
        f"fixes of {receiver.name} are off the truth by {np.median(away_m):.1f} m (median), in "
        f"{(away_m > radius_m).sum()} of {counted(len(radius_m), 'view')} by more than their disc"
    )
    lacks = f", none in {(~is_fix).sum()} of {counted(len(is_fix), 'view')}" if not is_fix.all() else ""
    lacks += "" if is_fix[0] else ", the first among them: the start is anywhere on the map"
    stated = f"discs of {SIGMAS:g} times the accuracy that it states, {np.median(radius_m):.3g} m (median)"
    return f"of {receiver.name} of the log, {stated}{lacks}"


def pose_of(views: Trajectory, frame: int, scale: float) -> Pose:
    """Return the pose of one view."""
    east_m, north_m = views.position_m[frame, :2].tolist()
    return Pose(easting_m=east_m, northing_m=north_m, yaw_deg=float(views.yaw_deg[frame]), scale=scale)


@dataclass(frozen=True, kw_only=True)
class Airspace:
    """Where the flights of a suite may go, and the seeds of region and suite that they are drawn from.

    `flown` is a flight that was flown there; it is the only one then.
    """

    region: Region
    scene: Scene
    suite: FlightSuite
    split: Split
    seeds: Seeds
    group: PriorGroup
    flown: LoggedFlight | None = None

    def seeds_of(self, index: int) -> Seeds:
        """Return the seeds of one flight."""
        return self.seeds.under("flight", index)

    def choose(self, *, count: int, may_be_fewer: bool) -> dict[int, Flight]:
        """Choose flights, by index; kinds take turns, and each is as long as the ground allows.

        All views of a flight are centred in blocks of one part of the split; all they may show is mapped. The result
        begins a sequence that does not depend on `count`. Flights may cross: what they share counts by places.

        Raises
        ------
        ConfigError
            If there is room for fewer; with `may_be_fewer`, only if there is room for none.
        """
        if self.flown is not None:
            return {0: self._logged(self.flown)}
        flights: dict[int, Flight] = {}
        for index in range(count):
            flight = self._flight(index, list(flights.values()))
            if flight is not None:
                flights[index] = flight
        if not flights or (len(flights) < count and not may_be_fewer):
            raise ConfigError(
                f"{self.scene.map.region} has room for {len(flights)} of {count} flights of suite "
                f"{self.suite.card.name!r}: too little is mapped or drawn"
                + (", lower --n or pass --up-to" if flights else "")
            )
        return flights

    def _flight(self, index: int, before: Sequence[Flight]) -> Flight | None:
        """Return the longest flight that is found, of the kind whose turn it is if possible."""
        seeds = self.seeds_of(index)
        extent_m = math.sqrt(flight_area(self.region, self.suite.clear_m(self.scene)).area)
        scale, spacing_m = self._scale_and_spacing_m(seeds)
        kinds = [KINDS[(index + turn) % len(KINDS)] for turn in range(len(KINDS))]
        longest_m = min(EXTENT * extent_m, self.suite.longest_m)
        for length_m in (length_m for length_m in LENGTHS_M if length_m <= longest_m):
            for kind in kinds:
                for attempt in range(6):  # paths of a kind and length before it does not fit
                    rng = seeds.rng("path", kind, f"{length_m:g}", attempt)
                    views = self._views(kind, length_m, spacing_m, rng)
                    if views is None:
                        break
                    if not (self._is_in_one_part(views) and self._is_shown(views, scale)):
                        continue
                    plot = self._plot(views, before, rng)
                    if (plot is None) == isinstance(self.suite, ChangedMapSuite) or not self._is_drawn(views, scale):
                        continue
                    site = Site(index=index, pose=pose_of(views, 0, scale), block=self._block(views), density=0.0)
                    return Flight(site=site, views=views, spacing_m=spacing_m, scale=scale, plot=plot)
        return None

    def _scale_and_spacing_m(self, seeds: Seeds) -> tuple[float, float]:
        sigmas = float(np.clip(seeds.rng("scale").standard_normal(), -_SCALE_CUT, _SCALE_CUT))
        return 1.0 + self.group.scale_sigma * sigmas, float(seeds.rng("spacing").uniform(*self.suite.every_m))

    def _logged(self, flown: LoggedFlight) -> Flight:
        """Return the flight that was flown, or raise `ConfigError` that says why it cannot be asked."""
        seeds = self.seeds_of(0)
        scale, spacing_m = self._scale_and_spacing_m(seeds)
        views = _spaced(flown.path, float(flown.path.distance_m[-1]), spacing_m, seeds.rng("path", "flown"))
        where, plot = self.scene.map.region, None
        if not self._is_in_one_part(views):
            raise ConfigError(
                f"the flight over {where} crosses blocks of several parts of split {self.split.spec.id!r}, or ground "
                "outside of them: name a split in which the region is one place, as new-split proposes"
            )
        if not self._is_shown(views, scale):
            raise ConfigError(f"the flight over {where} leaves what suite {self.suite.card.name!r} can show")
        if isinstance(self.suite, ChangedMapSuite):
            plot = self._plot(views, (), seeds.rng("plot", "flown"))
            if plot is None:
                raise ConfigError(
                    f"the flight over {where} leaves no room for what suite {self.suite.card.name!r} changes"
                )
        if not self._is_drawn(views, scale):
            raise ConfigError(
                f"the flight over {where} sees too little that is mapped: {self.suite.card.min_density:.0%} are needed"
            )
        site = Site(index=0, pose=pose_of(views, 0, scale), block=self._block(views), density=0.0)
        own = None if isinstance(flown.own, str) else flown.own.steps(views.time_s)
        gnss = None
        if not isinstance(flown.receiver, str):
            gnss = flown.receiver.along(views.time_s, views.position_m[:, :2], epsg=self.scene.map.grid.epsg)
        return Flight(site=site, views=views, spacing_m=spacing_m, scale=scale, plot=plot, own=own, gnss=gnss)

    def _plot(self, views: Trajectory, before: Sequence[Flight], rng: np.random.Generator) -> Plot | None:
        """Return how maps are changed for a flight after those before it; None if they are not, or have no room."""
        if not isinstance(self.suite, ChangedMapSuite):
            return None
        ground = ground_of(self.scene, [(flight.views, flight.plot) for flight in before if flight.plot is not None])
        return self.suite.plot(views, ground, rng)

    def elsewhere(self, flight: Flight, carried_m: float) -> Trajectory | None:
        """Return another first half for a flight, which ends so far from its middle; None if none is found."""
        area, seeds = flight_area(self.region, self.suite.clear_m(self.scene)), self.seeds_of(flight.site.index)
        # 1.5: length of the path before the carrying, in that of the half it stands for
        length_m = max(1.5 * flight.middle * flight.spacing_m, min(LENGTHS_M))
        for attempt in range(20):  # shapes of the path that may end where a carried drone is taken from
            rng = seeds.rng("carried", f"{carried_m:g}", attempt)
            views = self._views("waypoints", length_m, flight.spacing_m, rng)
            if views is None or len(views) < flight.middle:
                continue
            shape = rows(views, slice(0, flight.middle))
            for _ in range(24):  # tried for each shape
                half = _placed(shape, flight.views.position_m[flight.middle, :2], carried_m, rng)
                is_over = bool(area.covers(shapely.MultiPoint(half.position_m[:, :2])))
                if is_over and self._is_in_one_part(half, flight.views) and self._is_drawn(half, flight.scale):
                    return half
        return None

    def _views(self, kind: PlanKind, length_m: float, spacing_m: float, rng: np.random.Generator) -> Trajectory | None:
        """Return the poses of the views of a flight, None if no such path fits."""
        # Their spacing is uneven, and its mean differs from flight to flight: else it would tell how far an odometer is
        # off.
        margin_m = self.suite.clear_m(self.scene)
        length_m = min(length_m, LOITER_M) if kind == "loiter" else length_m
        try:
            path_m = plan_flight(self.region, kind, length_m=length_m, rng=rng, margin_m=margin_m)
        except FlightError:
            return None
        return _spaced(fly(path_m, height_m=HEIGHT_M, rng=rng), length_m, spacing_m, rng)

    def _is_in_one_part(self, *flown: Trajectory) -> bool:
        """Return whether all views are centred in blocks of one part of the split: what trains must not be tested."""
        parts = {
            next(
                (self.split.part_of(self.split.place_of[block.id]) for block in self.scene.blocks if block.holds(at)),
                None,
            )
            for views in flown
            for at in zip(*views.position_m[:, :2].T.tolist(), strict=True)
        }
        return len(parts) == 1 and None not in parts

    def _is_shown(self, views: Trajectory, scale: float) -> bool:
        poses = (pose_of(views, frame, scale) for frame in range(len(views)))
        return all(self.suite.ground_at(self.scene, pose) is not None for pose in poses)

    def _block(self, views: Trajectory) -> str:
        middle = pose_of(views, len(views) // 2, 1.0)
        return next(block.id for block in self.scene.blocks if block.holds((middle.easting_m, middle.northing_m)))

    def _is_drawn(self, views: Trajectory, scale: float) -> bool:
        variant, maps = self.suite.variants[0], (self.scene.map, *self.suite.older(self.scene))
        poses = [pose_of(views, frame, scale) for frame in range(len(views))]
        means = [np.mean([drawn_share(state, pose, variant) for pose in poses]) for state in maps]
        return float(min(means)) >= self.suite.card.min_density


def _spaced(flown: Trajectory, length_m: float, spacing_m: float, rng: np.random.Generator) -> Trajectory:
    """Return the poses of the views along a path of about a length, unevenly spaced by so much on average."""
    steps_m = spacing_m * rng.uniform(*UNEVEN, math.ceil(length_m / (spacing_m * min(UNEVEN))))
    at_m = np.concatenate([[0.0], np.cumsum(steps_m)])
    return flown.at(np.interp(at_m[at_m < flown.distance_m[-1]], flown.distance_m, flown.time_s))


def _placed(shape: Trajectory, middle_m: Floats, carried_m: float, rng: np.random.Generator) -> Trajectory:
    """Turn and move a path so that it ends about `carried_m` from a place, in any direction."""
    # 1.25: most that a distance carried is more or less than asked for, as a factor
    far_m = carried_m * 1.25 ** rng.uniform(-1, 1)
    bearing, turn_deg = rng.uniform(0, 2 * np.pi), float(rng.uniform(0, 360))
    position_m = shape.position_m.copy()
    end_m = middle_m + far_m * np.array([np.sin(bearing), np.cos(bearing)])
    position_m[:, :2] = end_m + (position_m[:, :2] - position_m[-1, :2]) @ rotation(turn_deg).T
    return Trajectory.of_angles(time_s=shape.time_s, position_m=position_m, yaw_deg=shape.yaw_deg + turn_deg)


def rows(views: Trajectory, which: slice) -> Trajectory:
    """Return some of the poses of a trajectory."""
    return Trajectory(
        time_s=views.time_s[which], position_m=views.position_m[which], quaternion_xyzw=views.quaternion_xyzw[which]
    )


_MOST_GAP: Final = 1 / 3  # of a flight


@dataclass(frozen=True, kw_only=True)
class FlightDrawer:
    """Draw the flights of one suite on one region; `carried` caches where carried drones come from.

    `told` says where odometry is from (`odometry`), and fixes of a weak receiver (`gnss`): fields of `TaskOrigin`.
    """

    airspace: Airspace
    flights: dict[int, Flight]
    choice: Choice = EVERYTHING
    told: Mapping[str, str] = field(default_factory=dict)
    carried: dict[tuple[int, float], Trajectory | None] = field(default_factory=dict)

    @classmethod
    def of(cls, airspace: Airspace, flights: dict[int, Flight], choice: Choice) -> "FlightDrawer":
        """Return what draws some flights, and tell where their odometry and their priors are from."""
        told, suite, flown = {}, airspace.suite, airspace.flown
        first = next(iter(flights.values()))
        if flown is not None:
            told["odometry"] = flown.odometry_words(first)
            tell(f"odometry: {told['odometry']}")
            if flown.drift is not None or (first.own is not None and first.own.is_logged.any()):
                airspace = replace(airspace, suite=replace(suite, variants=suite.variants + suite.of_own))
        if airspace.group.is_gnss:
            told["gnss"] = gnss_words(first, airspace.group, flown)
            tell(f"prior: fixes {told['gnss']}")
        return cls(airspace=airspace, flights=flights, choice=choice, told=told)

    @property
    def suite(self) -> FlightSuite:
        """Return the suite."""
        return self.airspace.suite

    @property
    def scene(self) -> Scene:
        """Return what it draws from."""
        return self.airspace.scene

    def jobs(self, sites: Sequence[Site]) -> list[Job]:
        """Return all flights in the order of their ids; the id of a job is that of its first view."""
        jobs = [
            Job(
                query_id=view_id(self._seeds(site).digest("flight", variant.name).hex()[:SEQUENCE_DIGITS], 0),
                site=site,
                variant=variant,
                track="sequence",
            )
            for site in sites
            for detector in self.suite.drawn_by(self.choice.detectors)
            for variant in (replace(item, detector=detector) for item in self.suite.variants)
            if self.choice.takes(variant, "sequence") and self._is_of(site, variant)
        ]
        return sorted(jobs, key=lambda job: job.query_id)

    def _is_of(self, site: Site, variant: Variant) -> bool:
        """Return whether a site has a variant: where maps are changed for a flight, only one strength of its stress."""
        plot = self.flights[site.index].plot
        return plot is None or variant.role != "stress" or variant.strength == plot.strength

    def map_of(self, job: Job) -> str:
        """Return the name of the map that a flight is searched on."""
        return self.suite.map_of(self.scene, job.variant, job.site.index)

    def why_not(self, job: Job) -> str | None:
        """Return why a flight is left out, or None: its stress does not fit, or no stress does that it is held against.

        A flight may be too short for its gap, or have nowhere to be carried from.
        """
        own = self._misfit(job.site, job.variant)
        if own is not None or job.variant.role == "stress":
            return own
        stresses = [
            item for item in self.suite.variants if item.role == "stress" and self.choice.takes(item, job.track)
        ]
        misfits = [self._misfit(job.site, item) for item in stresses]
        return misfits[0] if misfits and None not in misfits else None

    def _misfit(self, site: Site, variant: Variant) -> str | None:
        """Return why what happens to a variant cannot happen to a flight, or None."""
        mission, flight = self.suite.mission(variant), self.flights[site.index]
        if mission.gaps_m and _gap_m(flight, mission) is None:
            return "a gap is a third of its flight at most"
        if mission.carried_m and self._elsewhere(flight, mission.carried_m) is None:
            return f"no flight ends {mission.carried_m:g} m from its middle"
        return None

    def drawn(self, jobs: Sequence[Job]) -> Iterator[tuple[Query, Truth]]:
        """Yield the views of flights in order, each with its truth.

        Pictures are drawn place by place, since a place is painted once.
        """
        if not self.suite.is_pictured:
            drafts = Drafts(asked=Counter(map(self._alike, jobs)), room_bytes=KEPT_BYTES)
            for job in jobs:
                yield from self._flown(job, drafts)
                drafts.leave(self._alike(job))
            return
        found: dict[str, list[tuple[Query, Truth]]] = {job.query_id: [] for job in jobs}
        for site in dict.fromkeys(job.site.index for job in jobs):
            own = [job for job in jobs if job.site.index == site]
            for pairs in zip(*(self._flown(job, Drafts()) for job in own), strict=True):
                for job, pair in zip(own, pairs, strict=True):
                    found[job.query_id].append(pair)
        for job in jobs:
            yield from found[job.query_id]

    def _alike(self, job: Job) -> Hashable:
        """Return what all flights have in common whose views are the same where they are at the same place."""
        return (job.site.index, self.suite.look(job.variant), self.suite.mission(job.variant).draw)

    def _flown(self, job: Job, drafts: Drafts) -> Iterator[tuple[Query, Truth]]:
        mission, flight = self.suite.mission(job.variant), self.flights[job.site.index]
        before = self._elsewhere(flight, mission.carried_m) if mission.carried_m else None
        views = flight.views if before is None else _joined(before, flight)
        steps, distance_m = self._odometry(views, flight, mission), views.distance_m
        measured = _changes(flight, job.variant)
        if before is not None:
            carried_m = float(distance_m[flight.middle] - distance_m[flight.middle - 1])
            measured["carried_m"] = round(carried_m, 1)
            distance_m = np.where(np.arange(len(views)) < flight.middle, distance_m, distance_m - carried_m)
        unseen, time_s = _unseen(flight, mission), views.time_s - views.time_s[0]
        gnss = self._gnss(flight, mission)
        start_s = None if self.airspace.flown is None else self.airspace.flown.start_s
        for frame in range(len(views)):
            is_lost = mission.is_lost and frame == flight.middle
            step = _step(flight_id(job.query_id), frame, steps, is_lost=is_lost)
            flown = {"distance_m": round(float(distance_m[frame]), 1), "time_s": round(float(time_s[frame]), 2)}
            own = flown | {"is_seen": float(not unseen[frame])}
            if flight.own is not None and mission.takes_log and frame > 0:
                own[LOGGED] = float(flight.own.is_logged[frame - 1] and (before is None or frame >= flight.middle))
            if start_s is not None:
                own[UTC] = round(start_s + float(views.time_s[frame]), 3)
            fix = None
            if gnss is not None:
                place_m = views.position_m[frame, :2].tolist()
                # The start's radius bounds what a tracker searches on the way, where a receiver soon states less
                least_m = 0.0 if frame else GNSS_M
                fix = gnss.disc(frame, (place_m[0], place_m[1]), least_m=least_m)
                own |= {GNSS_OFF: round(float(gnss.away_m[frame]), 1)} if fix[0] is not None else {}
            pose = pose_of(views, frame, flight.scale)
            seeds = self._seeds(job.site).under("view", frame, *([mission.draw] if mission.draw else []))
            request = self._request(job, pose, seeds)
            draft = drafts.of(self._alike(job), (frame, pose), partial(self.suite.draw, request))
            yield self._view(job, request.site, draft, step, measured=own | measured, fix=fix)

    def _odometry(self, views: Trajectory, flight: Flight, mission: Mission) -> Odometry:
        """Return what the odometer says: to the middle and from there on what it says in the control."""
        seeds, profile, into = self._seeds(flight.site), load_profile(mission.profile), flight.middle - 1
        flown = self.airspace.flown
        if flown is not None and flown.drift is not None and mission.takes_log:
            profile = flown.drift
        step, control = (
            draw_odometry(flown, profile, belief=mission.belief, rng=seeds.rng("odometry", mission.draw))
            for flown in (views, flight.views)
        )
        if flight.own is not None and mission.takes_log:
            control = flight.own.over(control, profile, belief=mission.belief)
            step = control if views is flight.views else step
        both = {item.name: (getattr(step, item.name), getattr(control, item.name)) for item in fields(Odometry)}
        return Odometry(**{name: np.concatenate([own[:into], usual[into:]]) for name, (own, usual) in both.items()})

    def _gnss(self, flight: Flight, mission: Mission) -> WeakGnss | None:
        """Return the fixes of priors at the views of a flight.

        They are off alike where the drone flies another first half: no disc tells which half is the control's.
        """
        group = mission.group or self.airspace.group
        if not group.is_gnss or group.radius_m is None:
            return None
        rng = self._seeds(flight.site).rng("gnss", group.name)
        return flight.gnss or draw_gnss(flight.views.time_s, radius_m=group.radius_m, rng=rng)

    def _seeds(self, site: Site) -> Seeds:
        return self.airspace.seeds_of(site.index)

    def _elsewhere(self, flight: Flight, carried_m: float) -> Trajectory | None:
        key = (flight.site.index, carried_m)
        if key not in self.carried:
            self.carried[key] = self.airspace.elsewhere(flight, carried_m)
        return self.carried[key]

    def _request(self, job: Job, pose: Pose, seeds: Seeds) -> ViewRequest:
        site = replace(job.site, pose=pose, density=drawn_share(self.scene.map, pose, job.variant))
        flight_seeds = self._seeds(job.site)
        return ViewRequest(scene=self.scene, site=site, variant=job.variant, seeds=seeds, flight_seeds=flight_seeds)

    def _view(
        self, job: Job, site: Site, draft: QueryDraft, step: Step, *, measured: dict[str, float], fix: Disc | None
    ) -> tuple[Query, Truth]:
        scene, variant, pose, seeds = self.scene, job.variant, site.pose, self._seeds(job.site)
        group = self.suite.mission(variant).group or self.airspace.group
        evidence = draft.evidence
        if not measured["is_seen"]:
            evidence = evidence.replace(np.full_like(evidence.cells, UNKNOWN))
        state, plot = scene.state(self.map_of(job)), self.flights[job.site.index].plot
        copy = None if plot is None or plot.copy_m is None else _moved(pose, plot.copy_m)
        if copy is not None:
            measured |= _likeness(state, pose, copy, variant)
        prior = _no_prior(group)
        if step.frame == 0:
            rivals_m = () if copy is None else ((copy.easting_m, copy.northing_m),)
            prior = make_prior(pose, group, rng=seeds.rng("prior", group.name), rivals_m=rivals_m)
        if fix is not None:
            prior = replace(prior, center_m=fix[0], radius_m=fix[1])
        query = Query(
            query_id=view_id(step.sequence_id, step.frame),
            track="sequence",
            suite=self.suite.card.name,
            suite_version=self.suite.card.version,
            part=self.airspace.split.part_in_task(next(block for block in scene.blocks if block.id == site.block)),
            region=state.region,
            evidence=evidence,
            observed_on=scene.world.date,
            season=draft.season,
            prior=prior,
            prior_group=group.name,
            frames=draft.frames,
            step=step,
        )
        return query, self._truth(job, query, site, replace(draft, measured=draft.measured | measured))

    def _truth(self, job: Job, query: Query, site: Site, draft: QueryDraft) -> Truth:
        variant, state = job.variant, self.scene.state(query.region)
        changed = draft.changed_share
        if changed is None:
            views = (variant.view(place, site.pose) for place in (self.scene.world, state))
            changed = 0.0 if state is self.scene.world else changed_share(*views)
        is_present = state.knows(site.pose)
        is_blank = is_present and drawn_share(state, site.pose, variant) < LEAST_DRAWN
        return Truth(
            query_id=query.query_id,
            is_present=is_present,
            pose=site.pose,
            candidate=-1,
            pair_id=self._seeds(site).digest("pair").hex()[:16],
            role=variant.role,
            kind=variant.kind,
            strength=variant.strength,
            strength_unit=self.suite.card.strength_unit,
            unknown_share=share_of(query.evidence.cells == UNKNOWN),
            changed_share=changed,
            feature_density=site.density,
            alias_index=None,
            block=site.block,
            scene=",".join(self.scene.scenes),
            measured=draft.measured | ({UNANSWERABLE: 1.0} if is_blank else {}),
            detector=variant.detector,
            labels=draft.labels,
        )


def _changes(flight: Flight, variant: Variant) -> dict[str, float]:
    if flight.plot is None:
        return {}
    if variant.role == "control":
        return dict.fromkeys(flight.plot.stress.measured, 0.0)
    return flight.plot.of(variant.role).measured


def _moved(pose: Pose, by_m: tuple[float, float]) -> Pose:
    return replace(pose, easting_m=pose.easting_m + by_m[0], northing_m=pose.northing_m + by_m[1])


def _likeness(state: State, pose: Pose, copy: Pose, variant: Variant) -> dict[str, float]:
    """How like a view of the map is to that at its copy: equal cells of all present in either, and if all are."""
    # Of an exact copy, also the way to it.
    here, there = (variant.view(state, at) for at in (pose, copy))
    is_copied = bool(np.array_equal(here.cells, there.cells))
    found = {"copy_likeness": round(1 - changed_share(here, there), 4), "is_copied": float(is_copied)}
    if not is_copied:
        return found
    east_m, north_m = copy.easting_m - pose.easting_m, copy.northing_m - pose.northing_m
    return found | {TWIN_EAST: round(east_m, 2), TWIN_NORTH: round(north_m, 2)}


def _joined(before: Trajectory, flight: Flight) -> Trajectory:
    """Return a flight with another first half; the second begins one step of time after it."""
    after = rows(flight.views, slice(flight.middle, None))
    step_s = float(np.median(np.diff(after.time_s)))
    later_s = after.time_s - after.time_s[0] + before.time_s[-1] + step_s
    return Trajectory(
        time_s=np.concatenate([before.time_s, later_s]),
        position_m=np.concatenate([before.position_m, after.position_m]),
        quaternion_xyzw=np.concatenate([before.quaternion_xyzw, after.quaternion_xyzw]),
    )


def _gap_m(flight: Flight, mission: Mission) -> float | None:
    return max((gap_m for gap_m in mission.gaps_m if gap_m <= _MOST_GAP * flight.length_m), default=None)


def _unseen(flight: Flight, mission: Mission) -> NDArray[np.bool_]:
    """Return which views show nothing: those of the gap in the middle, or as many evenly spread."""
    distance_m, gap_m = flight.views.distance_m, _gap_m(flight, mission)
    if gap_m is None:
        return np.zeros(len(distance_m), dtype=bool)
    found = np.abs(distance_m - flight.length_m / 2) <= gap_m / 2
    if mission.is_scattered:
        evenly = np.linspace(0, len(found) - 1, int(found.sum()) + 2).round().astype(int)[1:-1]
        found = np.isin(np.arange(len(found)), evenly)
    return found


def _step(sequence_id: str, frame: int, steps: Odometry, *, is_lost: bool) -> Step:
    if frame == 0 or is_lost or steps.is_lost[frame - 1]:
        return Step(sequence_id=sequence_id, frame=frame)
    at = frame - 1
    increment = (float(steps.right_m[at]), float(steps.up_m[at]), float(steps.yaw_deg[at]))
    return Step(
        sequence_id=sequence_id,
        frame=frame,
        increment=increment,
        covariance=tuple(steps.covariance[at].ravel().tolist()),
    )


def _no_prior(group: PriorGroup) -> Prior:
    """Return the prior of a view that is not the first: the scale alone."""
    return Prior(center_m=None, radius_m=None, yaw_deg=None, yaw_sigma_deg=None, scale_sigma=group.scale_sigma)
