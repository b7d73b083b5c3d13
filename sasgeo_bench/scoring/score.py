# SPDX-License-Identifier: Apache-2.0
"""Scored rows: one for every query of a task, answered or not."""

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, fields
from typing import Final

import pandas as pd

from sasgeo_bench.errors import MetricError
from sasgeo_bench.geometry.pose import Pose
from sasgeo_bench.matching.matcher import SAME_PLACE_M
from sasgeo_bench.matching.results import Prediction
from sasgeo_bench.scoring.pose import MISS, Rank, first_pose, pose_errors, rank_candidate, rank_of
from sasgeo_bench.tasks.query import CEILING, COPIES, SEQUENCE, Head, Truth, base_of

SCORER_VERSION: Final = 6  # raise it if the same predictions get other scores; a board has one version
FIX_M: Final = 25.0  # mission tolerance e_max of Eq. 12: a fix beyond it is false, on both tracks
MISSING: Final = "missing"  # status of a query without a row
NOT_APPLICABLE: Final = "not applicable"

Errors = tuple[float, float, float]
_NO_ERROR: Final[Errors] = (math.nan, math.nan, math.nan)


@dataclass(frozen=True, slots=True, kw_only=True)
class Score:
    """One scored query of one matcher.

    Parameters
    ----------
    query_id, track, suite, suite_version, part, region, prior_group, view_cells, cell_size_m
        Of the query.
    pool : int
        Number of candidates; 0 for localization.
    place, country : str
        Unit of the split, the region without a split; the country that the split gives it, else the place.
    block, pair_id, role, kind, strength, strength_unit, scene
        Of the truth; so are unknown_share, changed_share, feature_density, alias_index and detector.
    is_present : bool
        The place is on the map.
    status : str
        Of the prediction, or "missing". "not applicable" must cover all queries of a suite, track and prior group, so
        that a submission cannot choose its queries.
    ceiling : float
        The most that any matcher can expect of the primary metric: 0 for an absent place, 1 in k where k places are the
        same, else 1.
    is_answered : bool
        There is a fix that could be accepted.
    above, tied, right : int
        Rank of the right candidate (`pose.Rank`); 0, 0, 0 for a miss and for localization.
    position_error_m, yaw_error_deg, log_scale_error : float
        Of the first pose, for localization of a present place; infinite without an answer, else NaN.
    is_right : bool
        The fix lies within `FIX_M` of the true position (Eq. 12); never for an absent place. In retrieval too: a wrong
        candidate within that distance is no hit, but no false fix either.
    confidence : float
        Of the prediction; NaN if missing.
    latency_s : float
        NaN if unknown.
    """

    query_id: str
    track: str
    suite: str
    suite_version: int
    part: str
    region: str
    place: str
    country: str
    block: str
    prior_group: str
    view_cells: int
    cell_size_m: float
    pool: int
    pair_id: str
    role: str
    kind: str
    strength: float
    strength_unit: str
    unknown_share: float
    changed_share: float
    feature_density: float | None
    alias_index: float | None
    scene: str
    detector: str
    is_present: bool
    status: str
    ceiling: float
    is_answered: bool
    above: int
    tied: int
    right: int
    position_error_m: float
    yaw_error_deg: float
    log_scale_error: float
    is_right: bool
    confidence: float
    latency_s: float


COLUMNS: Final = tuple(field.name for field in fields(Score))
_HEAD_COLUMNS: Final = tuple(field.name for field in fields(Head) if field.name in COLUMNS)
_TRUTH_COLUMNS: Final = tuple(
    field.name for field in fields(Truth) if field.name in COLUMNS and field.name not in _HEAD_COLUMNS
)


def score_task(
    heads: Iterable[Head],
    truths: Iterable[Truth],
    predictions: Mapping[str, Prediction],
    *,
    place_of: Mapping[str, str] | None = None,
    country_of: Mapping[str, str] | None = None,
) -> pd.DataFrame:
    """Score the predictions of one task: a row for each query in order, with the columns of `Score`.

    `heads` and `truths` cover the same queries; a query without a prediction is a miss. `place_of` maps blocks to
    places of the split, `country_of` places to countries. Raise MetricError if a query has no truth or a prediction
    belongs to no query.
    """
    asked = list(heads)
    by_id = truths_of(asked, truths, predictions)
    answers = [predictions.get(head.query_id) for head in asked]
    errors = _errors([by_id[head.query_id] for head in asked], answers)
    places = [(place_of or {}).get(by_id[head.query_id].block, base_of(head.region)) for head in asked]
    rows = [
        _score(head, by_id[head.query_id], prediction, error, (place, (country_of or {}).get(place, place)))
        for head, prediction, error, place in zip(asked, answers, errors, places, strict=True)
    ]
    return pd.DataFrame({name: [getattr(row, name) for row in rows] for name in COLUMNS}, columns=list(COLUMNS))


def single_views(scores: pd.DataFrame) -> pd.DataFrame:
    """Return the scored rows that are of views alone, and not of flights."""
    return scores[(scores["track"] != SEQUENCE).to_numpy(bool)].reset_index(drop=True)


def truths_of(
    asked: Sequence[Head], truths: Iterable[Truth], predictions: Mapping[str, Prediction]
) -> dict[str, Truth]:
    """Return the truths by query id; raise MetricError if one is missing, or a prediction belongs to no query."""
    by_id = {truth.query_id: truth for truth in truths}
    lost = next((head.query_id for head in asked if head.query_id not in by_id), None)
    if lost is not None:
        message = f"query {lost} has no truth: these are the truths of other queries, make the queries again"
        raise MetricError(message)
    foreign = next(iter(set(predictions) - {head.query_id for head in asked}), None)
    if foreign is not None:
        message = f"prediction {foreign} belongs to no query of the task: 'validate' lists them all"
        raise MetricError(message)
    return by_id


def _errors(truths: Sequence[Truth], answers: Sequence[Prediction | None]) -> list[Errors]:
    """Return metres, degrees and logarithm of the scale of each first pose; NaN without a true pose."""
    found = [_NO_ERROR] * len(truths)
    asked = [(at, truth.pose) for at, truth in enumerate(truths) if truth.is_present and truth.pose is not None]
    errors = pose_errors([first_pose(answers[at]) for at, _ in asked], [pose for _, pose in asked])
    columns = (errors.position_m.tolist(), errors.yaw_deg.tolist(), errors.log_scale.tolist())
    for (at, _), *error in zip(asked, *columns, strict=True):
        found[at] = (error[0], error[1], error[2])
    return found


def _score(head: Head, truth: Truth, prediction: Prediction | None, errors: Errors, where: tuple[str, str]) -> Score:
    rank = MISS
    is_right = errors[0] <= FIX_M  # retrieval candidates have a given heading and a random offset, so no errors below
    if head.track == "retrieval":
        errors = _NO_ERROR
        rank = _rank(prediction, truth, head.candidates) if truth.is_present else MISS
    return Score(
        **{name: getattr(head, name) for name in _HEAD_COLUMNS},
        **{name: getattr(truth, name) for name in _TRUTH_COLUMNS},
        place=where[0],
        country=where[1],
        pool=len(head.candidates),
        status=MISSING if prediction is None else prediction.status,
        ceiling=ceiling_of(truth),
        is_answered=first_pose(prediction) is not None,
        above=rank.above,
        tied=rank.tied,
        right=rank.right,
        position_error_m=errors[0],
        yaw_error_deg=errors[1],
        log_scale_error=errors[2],
        is_right=is_right,
        confidence=math.nan if prediction is None or prediction.confidence is None else prediction.confidence,
        latency_s=math.nan if prediction is None or prediction.latency_s is None else prediction.latency_s,
    )


def ceiling_of(truth: Truth) -> float:
    """Return the most that a matcher can expect of the primary metric at a query, in [0, 1].

    Suites measure it where copies of a place leave nothing to tell them by. Tasks of version 1 and 2 only count the
    copies among the candidates of `alias`.
    """
    if not truth.is_present:
        return 0.0
    copies = truth.measured.get(COPIES, 0.0)
    return truth.measured.get(CEILING, 1.0 / (1.0 + copies))


def _rank(prediction: Prediction | None, truth: Truth, candidates: Sequence[Pose]) -> Rank:
    """Return the rank of the right candidate; compare all candidates only if another one shares its position."""
    right = candidates[truth.candidate]
    twins = sum(_is_at(other, right, within_m=2 * SAME_PLACE_M) for other in candidates)
    if twins > 1:
        return rank_candidate(prediction, truth, candidates)
    if prediction is None or prediction.status != "ok":
        return MISS
    scores = [score for _, score in prediction.candidates]
    return rank_of(scores, [_is_at(pose, right) for pose, _ in prediction.candidates])


def _is_at(pose: Pose, place: Pose, *, within_m: float = SAME_PLACE_M) -> bool:
    return math.hypot(pose.easting_m - place.easting_m, pose.northing_m - place.northing_m) <= within_m


def settle_not_applicable(scores: pd.DataFrame) -> pd.DataFrame:
    """Return the rows with "not applicable" as "missing" unless it covers a whole suite, track and prior group.

    A card's requirements are the same for all of these; a file that omits single queries would choose its queries.
    """
    claimed = scores["status"] == NOT_APPLICABLE
    group = [scores["suite"], scores["track"], scores["prior_group"]]
    is_whole = claimed.groupby(group).transform("all").astype(bool)
    return scores.assign(status=scores["status"].where(~claimed | is_whole, MISSING))
