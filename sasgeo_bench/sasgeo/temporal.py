# SPDX-License-Identifier: Apache-2.0
"""The scorer over time: Eqs. 10 and 11 of the SASGeo paper on a belief over place and heading.

The joint objective over a flight sums what each view says (J_R) and how well each step fits the odometer (J_T). Where a
list of modes is the choice at each view, it is maximised by dynamic programming over the lists. Here every cell and
heading is a choice, so nothing is lost between lists, and the recursion sums over all ways instead of keeping the best
one: the belief at a view is the probability of each pose given all views until then.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import ClassVar, Final, Self

import numpy as np
from numpy.typing import NDArray

from sasgeo_bench.core.errors import PoseError
from sasgeo_bench.geometry.pose import Pose, Prior, wrap_deg
from sasgeo_bench.matching.belief_fix import fix_of, followed
from sasgeo_bench.matching.controls.blind import is_blind
from sasgeo_bench.matching.matcher import MatcherCard, Training
from sasgeo_bench.matching.tracker import SIDE, Fix
from sasgeo_bench.regions.region import Region
from sasgeo_bench.sasgeo.ablations import Switches
from sasgeo_bench.sasgeo.learning import learn
from sasgeo_bench.sasgeo.reading import Reader
from sasgeo_bench.sasgeo.scorer_model import ScorerModel
from sasgeo_bench.search.belief import Floats, GridBelief, known_on, surface_logs
from sasgeo_bench.search.dense import LevelView, surface
from sasgeo_bench.search.field import Field, Template
from sasgeo_bench.search.plan import Plan
from sasgeo_bench.tasks.query import Query, Step

CELL_M: Final = 4.0  # of the map that is searched: of a whole country its layers take 0.3 GB
NONE: Final = 1e-3  # probability that a view fits no place better than the rest: aged or perceived beyond recognition
# Of the fitted exponents, for views whose ground is all new: of 0.125, 0.25, 0.5 and 1 the one with the most views
# within 25 m in `python benchmarks/fit_grid_trackers.py --tracker sasgeo_track`, on made-up towns that are in no split.
FRESH: Final = 0.5
LEAST: Final = 0.9  # mass within 25 m of a fix that is accepted
LOST_M: Final = 600.0  # radius of the first search for another place
_MOST_LOST_M: Final = 8000.0
_DOUBTS: Final = 3  # views in a row that fit better elsewhere
_AROUND_DEG: Final = 10.0
VIO: Final = "vio_mahalanobis"  # diagnostic: the last step of the estimate against the odometer's (Eq. 10)
_SCALES: Final = np.arange(-0.09, 0.0901, 0.01)  # logarithms
_NO_ODOMETER: Final = np.diag([60.0**2, 60.0**2, 30.0**2]).ravel()  # m2, deg2: as far as a drone flies between views


@dataclass(frozen=True, slots=True, kw_only=True)
class OverTime:
    """Settings in which the ablations over time differ; defaults are those of the full tracker.

    `has_odometry` moves the belief by the odometer's increments (J_T), else it spreads by as far as a drone flies
    between two views. `has_none` lets a view fit no place, else the belief is forced to one. `takes_rivals` follows
    another place beside the belief where views fit better there.
    """

    has_odometry: bool = True
    has_none: bool = True
    takes_rivals: bool = True


def increment_cost(step: Step, before: Pose, after: Pose) -> float:
    """Return -J_T of Eq. 10: the squared Mahalanobis norm of a step against the odometer's increment.

    Parameters
    ----------
    step : Step
        The increment and its covariance.
    before, after : Pose
        Poses of the two views.

    Returns
    -------
    float
        Squared norm; 0 where the odometer says nothing.

    Notes
    -----
    The residual is that of the increment in the axes of the view before: right, up and turn. For the few degrees
    between an increment and its estimate it equals the logarithm of SE(2) to first order.

    Examples
    --------
    Ten metres too far, with a standard deviation of five:

    >>> step = Step(sequence_id="f", frame=1, increment=(0.0, 50.0, 0.0), covariance=(25.0, 0, 0, 0, 25.0, 0, 0, 0, 1))
    >>> at = Pose(easting_m=0.0, northing_m=0.0, yaw_deg=90.0)
    >>> round(increment_cost(step, at, replace(at, easting_m=60.0)), 6)
    4.0
    """
    if step.increment is None or step.covariance is None:
        return 0.0
    turn = np.radians(before.yaw_deg)
    east_m, north_m = after.easting_m - before.easting_m, after.northing_m - before.northing_m
    right_m, up_m = east_m * np.cos(turn) - north_m * np.sin(turn), east_m * np.sin(turn) + north_m * np.cos(turn)
    off_deg = float(wrap_deg(after.yaw_deg - before.yaw_deg - step.increment[2]))
    residual = np.array([right_m - step.increment[0], up_m - step.increment[1], off_deg])
    # 1e-9 m2 and deg2, added to an odometer's covariance: one that is exact has none
    covariance = np.reshape(step.covariance, (SIDE, SIDE)) + 1e-9 * np.eye(SIDE)
    return float(residual @ np.linalg.solve(covariance, residual))


@dataclass(frozen=True, kw_only=True)
class FlightScale:
    """What is known of the scale of a flight's views, which is the same for all of them.

    `logs` are log-probabilities of the logarithms of scale `_SCALES`, up to a constant.
    """

    logs: NDArray[np.float64]

    @classmethod
    def of(cls, prior: Prior) -> Self:
        """Begin with the prior's standard deviation around 1."""
        return cls(logs=-0.5 * (_SCALES / max(prior.scale_sigma, 1e-3)) ** 2)

    @property
    def mean(self) -> float:
        """Return the expected scale.

        >>> prior = Prior(center_m=None, radius_m=None, yaw_deg=None, yaw_sigma_deg=None, scale_sigma=0.03)
        >>> FlightScale.of(prior).mean
        1.0
        """
        mass = np.exp(self.logs - self.logs.max())
        return math.exp(round(float(mass @ _SCALES / mass.sum()), 6))

    def seen(self, scored: "_Scored", pose: Pose) -> Self:
        """Add what a view at a pose says of its scale."""
        scores = scored.of_scales(pose)
        return replace(self, logs=self.logs + scores - scores.max())


@dataclass(frozen=True, kw_only=True)
class _Rival:
    """Another belief, begun evenly around where the tracker thinks it is, and its lead in evidence, nats."""

    belief: GridBelief
    lead_nats: float = 0.0
    views: int = 0


_USUAL_M: Final = 50.0  # between two views, where no odometer says it


class SasgeoTrack:
    """The scorer's raster over time, with the parts that `switches` and `over_time` select.

    `exponent_scale` is the share of the fitted exponents that a view of new ground has, `outlier_probability` that
    of a view that fits no place.
    """

    card: MatcherCard
    switches: ClassVar[Switches] = Switches(has_graph=False, burns_vectors=False, correlates="faint")
    over_time: ClassVar[OverTime] = OverTime()
    exponent_scale: float = FRESH
    outlier_probability: float = NONE

    def __init__(self) -> None:
        self._reader: Reader | None = None
        self._belief: GridBelief | None = None

    def learn(self, training: Training) -> str:
        """Fit the model of the scorer to views of known place."""
        return learn(training, self.switches, plan=Plan()).to_text()

    def prepare(self, region: Region, learned: str | None) -> None:
        """Read a map with a trained model, or the one set by hand."""
        model = ScorerModel.from_text(learned) if learned else ScorerModel.by_hand(region.classes)
        self._reader = Reader.of(region, model, self.switches, search_cell_m=CELL_M)

    @property
    def belief(self) -> GridBelief:
        """Return the belief after the last view."""
        if self._belief is None:
            raise RuntimeError(f"{self.card.name}: call start() first, and step() with the views of a flight")
        return self._belief

    @property
    def _map(self) -> Reader:
        if self._reader is None:
            raise RuntimeError(f"{self.card.name}: call prepare() with a region before start()")
        return self._reader

    def start(self, prior: Prior) -> None:
        """Begin with an even belief over the prior."""
        self._belief = GridBelief.of(prior, self._map.field.grid)
        self._scale = FlightScale.of(prior)
        self._new_m = math.inf  # flown since the last view that showed something
        self._doubts = 0
        self._lost_m = LOST_M
        self._rival: _Rival | None = None
        self._last: Pose | None = None

    def step(self, query: Query) -> Fix:
        """Move the belief by the odometer, weigh it by the view, and say where its mass is."""
        if query.step is None:
            raise RuntimeError(f"{self.card.name}: step() needs the views of a flight")
        belief = self._moved(self.belief, query.step)
        if self._rival is not None:
            self._rival = replace(self._rival, belief=self._moved(self._rival.belief, query.step))
        self._new_m += self._way_m(query.step)
        if not is_blind(query):
            belief = self._seen(belief, query)
        self._belief = belief.fitted()
        fix = fix_of(self._belief, least=LEAST)
        before, self._last = self._last, fix.pose
        off = {} if before is None or fix.pose is None else {VIO: _off(query.step, before, fix.pose)}
        return replace(
            fix,
            pose=None if fix.pose is None else replace(fix.pose, scale=self._scale.mean),
            diagnostics={**fix.diagnostics, **off},
            is_accepted=fix.is_accepted and not (self._rival is not None and self._rival.lead_nats > 0),
        )

    def _way_m(self, step: Step) -> float:
        if not self.over_time.has_odometry:
            return _USUAL_M
        return math.inf if step.increment is None else math.hypot(*step.increment[:2])

    def _moved(self, belief: GridBelief, step: Step) -> GridBelief:
        if self.over_time.has_odometry or step.frame == 0:
            return followed(belief, step)
        blind = replace(step, increment=(0.0, 0.0, 0.0), covariance=tuple(_NO_ODOMETER.tolist()))
        return followed(belief, blind)

    def _seen(self, belief: GridBelief, query: Query) -> GridBelief:
        """Weigh the belief by a view, learn the flight's scale, and mind whether the view fits better elsewhere."""
        template = self._map.read(query).template
        # Ground seen before says nothing new of the map.
        weight = self.exponent_scale * min(1.0, self._new_m / template.side_m)
        self._new_m = 0.0
        outlier_probability = self.outlier_probability if self.over_time.has_none else 0.0
        scored = _Scored(field=self._map.field, template=template, scale=self._scale.mean, weight=weight)
        # Mean place of a belief
        plane = belief.mass.sum(axis=0, dtype=np.float64).ravel()
        east_m, north_m = (plane @ belief.places_m / plane.sum()).tolist()
        average = scored.of_average((east_m, north_m))
        logs = scored.on(belief, elsewhere=average)
        weighed = belief.weighed(logs, outlier_probability=outlier_probability)
        fix = fix_of(weighed, least=LEAST)
        if fix.pose is None:
            return weighed
        if fix.is_accepted:
            self._scale = self._scale.seen(scored, fix.pose)
        if not self.over_time.takes_rivals:
            return weighed
        is_doubted = _evidence(belief, logs) < average
        self._doubts = self._doubts + 1 if is_doubted else 0
        lead_nats = -_evidence(belief, logs)
        return self._held(weighed, fix.pose, lead_nats, lambda other: scored.on(other, elsewhere=average))

    def _held(
        self, weighed: GridBelief, pose: Pose, lead_nats: float, logs_on: Callable[[GridBelief], Floats]
    ) -> GridBelief:
        """Follow a rival where views fit better elsewhere, and return the belief that has more evidence."""
        # `lead_nats` is minus the evidence of this view for the tracker's own belief.
        rival = self._rival
        if rival is None:
            if self._doubts < _DOUBTS:
                return weighed
            near = Prior(
                center_m=(pose.easting_m, pose.northing_m),
                radius_m=self._lost_m,
                yaw_deg=None,
                yaw_sigma_deg=None,
                scale_sigma=0.0,
            )
            rival = _Rival(belief=GridBelief.of(near, self._map.field.grid))
        theirs = logs_on(rival.belief)
        lead_nats += rival.lead_nats + _evidence(rival.belief, theirs)
        found = rival.belief.weighed(theirs, outlier_probability=self.outlier_probability).fitted()
        if lead_nats > 6.0 and fix_of(found, least=LEAST).is_accepted:  # nats: more evidence than the belief has
            self._rival, self._doubts, self._lost_m = None, 0, LOST_M
            return found
        self._rival = replace(rival, belief=found, lead_nats=lead_nats, views=rival.views + 1)
        if self._rival.views >= 20:  # views for which another place is followed beside the belief
            is_lost = self._doubts >= _DOUBTS
            # 4: the next search, where the one before found nothing
            self._lost_m = min(4.0 * self._lost_m, _MOST_LOST_M) if is_lost else LOST_M
            self._rival = None
        return weighed


_AROUND_M: Final = 450.0  # radius of the places that a view is held against


@dataclass(frozen=True, kw_only=True)
class _Scored:
    """A view, to be scored at poses of a map: log-likelihood ratios times a weight."""

    field: Field
    template: Template
    scale: float
    weight: float

    def on(self, belief: GridBelief, *, elsewhere: float) -> Floats:
        """Return the scores at the headings in `belief.asked` and each cell of its window."""
        # Of a cell that the map does not know nothing is known: there a view scores `elsewhere`.
        logs = surface_logs(self.field, self.template, belief, exponent_scale=self.weight, scale=self.scale)
        known = known_on(self.field, belief.grid)
        return np.asarray(known * logs + (1 - known) * np.float32(elsewhere))

    def of_average(self, center_m: tuple[float, float]) -> float:
        """Return the logarithm of the mean likelihood of mapped places and headings around a place; 0 off the map."""
        try:
            found = surface(
                self.field,
                self.template,
                center_m=center_m,
                radius_m=_AROUND_M,
                yaws_deg=np.arange(0.0, 360.0, _AROUND_DEG),
                factor=4,
                scale=self.scale,
            )
        except PoseError:  # the disc does not meet the map
            return 0.0
        is_known = known_on(self.field, found.grid) > 1 / 2
        if not is_known.any():
            return 0.0
        logs = self.weight * found.scores[:, is_known].astype(np.float64)
        top = float(logs.max())
        return top + math.log(float(np.exp(logs - top).mean()))

    def of_scales(self, pose: Pose) -> NDArray[np.float64]:
        """Return the score of a pose at each of `_SCALES`."""
        view = LevelView.of(self.field, self.template, 1)
        return self.weight * np.array([view.score(replace(pose, scale=math.exp(one))) for one in _SCALES])


def _off(step: Step, before: Pose, after: Pose) -> float:
    return math.sqrt(increment_cost(step, before, after))


def _evidence(belief: GridBelief, logs: Floats) -> float:
    top = float(logs.max())
    return top + math.log(max(float((belief.mass[belief.asked] * np.exp(logs - top)).sum(dtype=np.float64)), 1e-30))
