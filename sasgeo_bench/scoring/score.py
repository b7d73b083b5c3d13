# SPDX-License-Identifier: Apache-2.0
"""Scored rows: one for every query of a task, answered or not."""

from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, fields
from typing import Annotated, Final, Self

import numpy as np
import pandas as pd

from sasgeo_bench.core.errors import MetricError
from sasgeo_bench.matching.matcher import Prediction
from sasgeo_bench.running.prediction_files import CANDIDATE_M, AnswerColumns, Answers
from sasgeo_bench.scoring.base import Bools, Floats, Ints
from sasgeo_bench.scoring.frames import PRIOR_GROUP, TRACK, Shown, row_columns
from sasgeo_bench.scoring.pose import check_candidate, columns_of, pose_errors, rank_candidate, ranks_of_lists
from sasgeo_bench.tasks.query import CEILING, COPIES, SEQUENCE, Head, Truth, base_of

SCORER_VERSION: Final = 6  # raise it if the same predictions get other scores; a board has one version
FIX_M: Final = 25.0  # mission tolerance e_max of Eq. 12: a fix beyond it is false, on both tracks
MISSING: Final = "missing"  # status of a query without a row
NOT_APPLICABLE: Final = "not applicable"
RETRIEVAL: Final = "retrieval"  # the track


@dataclass(frozen=True, slots=True, kw_only=True)
class Score:
    """One scored query of one matcher.

    What a column says of the query, of the truth or of the prediction is stated there.
    """

    query_id: Annotated[str, "Id of the query"]
    track: Annotated[str, TRACK]
    suite: Annotated[str, "Suite of the query"]
    suite_version: Annotated[int, "Its version"]
    part: Annotated[str, "Part of the split, of the query"]
    region: Annotated[str, "Region of the query"]
    place: Annotated[str, "Unit of the split, the region without a split"]
    country: Annotated[str, "Country that the split gives the place, else the place"]
    block: Annotated[str, "Block of the truth"]
    prior_group: Annotated[str, PRIOR_GROUP]
    view_cells: Annotated[int, "Side of the view, in cells"]
    cell_size_m: Annotated[float, "Side of a cell"]
    pool: Annotated[int, "Number of candidates; 0 for localization"]
    pair_id: Annotated[str, "Site, which queries of the same ground share"]
    role: Annotated[str, "Stress, control or falsifier"]
    kind: Annotated[str, Shown("Kind of stress, or of its absence")]
    strength: Annotated[float, "Strength of the stress"]
    strength_unit: Annotated[str, "Unit of the strength"]
    unknown_share: Annotated[float, "Share of the view of which nothing is known"]
    changed_share: Annotated[float, "Share of the map that was changed there"]
    feature_density: Annotated[float | None, "Share of the map that has something there"]
    alias_index: Annotated[float | None, "How alike the likest other place is"]
    scene: Annotated[str, "Kind of place"]
    detector: Annotated[str, "Detector that made the evidence"]
    is_present: Annotated[bool, "The place is on the map"]
    status: Annotated[
        str,
        'Of the prediction, or "missing"; "not applicable" must cover all queries of a suite, track and prior group, '
        "so that a submission cannot choose its queries",
    ]
    ceiling: Annotated[
        float,
        "The most that any matcher can expect of the primary metric: 0 for an absent place, 1 in k where k places are "
        "the same, else 1",
    ]
    is_answered: Annotated[bool, "There is a fix that could be accepted"]
    above: Annotated[int, "Candidates that are scored above the right one; 0 for a miss and for localization"]
    tied: Annotated[int, "Candidates with its score, itself included; 0 as above"]
    right: Annotated[int, "How many of these are right; 0 as above"]
    position_error_m: Annotated[
        float, "Of the first pose, for localization of a present place; infinite without an answer, else NaN"
    ]
    yaw_error_deg: Annotated[float, "Error of its heading"]
    log_scale_error: Annotated[float, "Error of the logarithm of its scale"]
    is_right: Annotated[
        bool,
        "The fix lies within 25 m of the true position (Eq. 12); never for an absent place. In retrieval, too: a wrong "
        "candidate so near is no hit, but no false fix either",
    ]
    confidence: Annotated[float, "Of the prediction; NaN if missing"]
    latency_s: Annotated[float, "Time of the answer; NaN if unknown"]


COLUMNS: Final = tuple(column.name for column in row_columns(Score))
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
    questions = Questions.of(heads, truths, place_of=place_of, country_of=country_of)
    return with_answers(questions.frame, questions.answered(Answers.of(predictions.values())))


def with_answers(questions: pd.DataFrame, answers: pd.DataFrame) -> pd.DataFrame:
    """Return scored rows with the columns of `Score` from those of queries and of answers, without a copy of either."""
    return pd.DataFrame({name: (answers if name in answers else questions)[name] for name in COLUMNS}, copy=False)


@dataclass(frozen=True, kw_only=True)
class Questions:
    """N queries of a task with their truths, as columns to score the answers of many entries against.

    `frame` has the columns of `Score` that no answer changes. `poses`, shape (N, 4), are the true poses
    (`pose.columns_of`), NaN where none counts; `right_m`, shape (N, 2), where the right candidate lies, NaN where there
    is none; `twins` are the queries of whose candidates several lie there.
    """

    heads: tuple[Head, ...]
    truths: tuple[Truth, ...]
    frame: pd.DataFrame
    poses: Floats
    right_m: Floats
    twins: frozenset[int]

    @classmethod
    def of(
        cls,
        heads: Iterable[Head],
        truths: Iterable[Truth],
        *,
        place_of: Mapping[str, str] | None = None,
        country_of: Mapping[str, str] | None = None,
    ) -> Self:
        """Return the queries of a task; arguments and errors are as of `score_task`."""
        asked = tuple(heads)
        by_id = truths_of(asked, truths, ())
        known = tuple(by_id[head.query_id] for head in asked)
        places = [
            (place_of or {}).get(truth.block, base_of(head.region)) for head, truth in zip(asked, known, strict=True)
        ]
        columns = {
            **{name: [getattr(head, name) for head in asked] for name in _HEAD_COLUMNS},
            **{name: [getattr(truth, name) for truth in known] for name in _TRUTH_COLUMNS},
            "place": places,
            "country": [(country_of or {}).get(place, place) for place in places],
            "pool": [len(head.candidates) for head in asked],
            "ceiling": [ceiling_of(truth) for truth in known],
        }
        right_m, twins = np.full((len(asked), 2), np.nan), set()
        for at, (head, truth) in enumerate(zip(asked, known, strict=True)):
            if head.track == RETRIEVAL and truth.is_present:
                spots_m = np.array([(pose.easting_m, pose.northing_m) for pose in head.candidates])
                check_candidate(truth, len(spots_m))
                right_m[at] = spots_m[truth.candidate]
                if np.count_nonzero(distances_m(spots_m, right_m[at]) <= 2 * CANDIDATE_M) > 1:
                    twins.add(at)
        return cls(
            heads=asked,
            truths=known,
            frame=pd.DataFrame(columns),
            poses=columns_of([truth.pose if truth.is_present else None for truth in known]),
            right_m=right_m,
            twins=frozenset(twins),
        )

    def answered(self, given: Answers) -> pd.DataFrame:
        """Return the other columns of `Score`, a row for each query in order, from answers, at most one each.

        Raise MetricError if a row belongs to no query.
        """
        answers, places = given.columns(), {head.query_id: at for at, head in enumerate(self.heads)}
        _check_known(answers.query_id, places)
        row_of = np.full(len(self.heads), -1)
        row_of[[places[name] for name in answers.query_id]] = np.arange(len(given.table))
        # A row more for queries without an answer, which the index -1 finds.
        first = np.append(answers.fix, -1)[row_of]
        fixes = np.vstack((answers.poses, np.full(4, np.nan)))[first]
        errors = self._errors(fixes)
        above, tied, right = self._ranks(given, answers, row_of)
        is_miss = (self.frame["track"] == RETRIEVAL).to_numpy(bool)  # a given heading and a random offset: no errors
        found = {
            "status": [[*answers.status, MISSING][row] for row in row_of],
            "is_answered": first >= 0,
            "above": above,
            "tied": tied,
            "right": right,
            **{name: np.where(is_miss, np.nan, column) for name, column in errors.items()},
            "is_right": errors["position_error_m"] <= FIX_M,
            "confidence": np.append(answers.confidence, np.nan)[row_of],
            "latency_s": np.append(answers.latency_s, np.nan)[row_of],
        }
        return pd.DataFrame(found)

    def _errors(self, fixes: Floats) -> dict[str, Floats]:
        """Return metres, degrees and logarithm of the scale of each fix, shape (N,); NaN without a true pose."""
        found = pose_errors(fixes, np.nan_to_num(self.poses, nan=1.0))
        is_known = ~np.isnan(self.poses[:, 0])
        columns = {
            "position_error_m": found.position_m,
            "yaw_error_deg": found.yaw_deg,
            "log_scale_error": found.log_scale,
        }
        return {name: np.where(is_known, column, np.nan) for name, column in columns.items()}

    def _ranks(self, given: Answers, answers: AnswerColumns, row_of: Ints) -> Ints:
        """Return above, tied and right of the ranks of the right candidates, shape (3, N); see `pose.Rank`.

        A pose of the answer is the candidate at its position. Where another candidate shares the position of the right
        one, each pose is compared with all of them.
        """
        query = np.full(len(answers.query_id), -1)
        query[row_of[row_of >= 0]] = np.flatnonzero(row_of >= 0)
        spots_m = self.right_m[query[answers.row]]
        is_right = answers.is_ok[answers.row] & (distances_m(answers.poses[:, :2], spots_m) <= CANDIDATE_M)
        found = ranks_of_lists(answers.row, answers.scores, is_right, len(answers.query_id))
        ranks = np.array([np.append(column, 0)[row_of] for column in (found.above, found.tied, found.right)])
        for at in self.twins:
            one = None if row_of[at] < 0 else next(iter(given.some([row_of[at]]).found.values()))
            rank = rank_candidate(one, self.truths[at], self.heads[at].candidates)
            ranks[:, at] = rank.above, rank.tied, rank.right
        return np.asarray(ranks)


def distances_m(spots_m: Floats, other_m: Floats) -> Floats:
    """Return the distances of K positions from others, or from one, shape (K, 2) or (2,)."""
    gaps_m = spots_m - other_m
    return np.asarray(np.hypot(gaps_m[:, 0], gaps_m[:, 1]))


def single_views(scores: pd.DataFrame) -> pd.DataFrame:
    """Return the scored rows that are of views alone, and not of flights."""
    return some_rows(scores, (scores["track"] != SEQUENCE).to_numpy(bool))


def some_rows(scores: pd.DataFrame, chosen: Bools) -> pd.DataFrame:
    """Return the chosen rows, numbered anew; the table itself, and no copy, where these are all."""
    return scores if chosen.all() else scores[chosen].reset_index(drop=True)


def truths_of(asked: Sequence[Head], truths: Iterable[Truth], answered: Iterable[str]) -> dict[str, Truth]:
    """Return the truths by query id; raise MetricError if one is missing, or an answer belongs to no query."""
    by_id = {truth.query_id: truth for truth in truths}
    lost = next((head.query_id for head in asked if head.query_id not in by_id), None)
    if lost is not None:
        raise MetricError(f"query {lost} has no truth: these are the truths of other queries, make the queries again")
    _check_known(answered, {head.query_id for head in asked})
    return by_id


def _check_known(answered: Iterable[str], asked: Collection[str]) -> None:
    foreign = next((name for name in answered if name not in asked), None)
    if foreign is not None:
        raise MetricError(f"prediction {foreign} belongs to no query of the task: 'verify' lists them all")


def ceiling_of(truth: Truth) -> float:
    """Return the most that a matcher can expect of the primary metric at a query, in [0, 1].

    Suites measure it where copies of a place leave nothing to tell them by. Tasks of version 1 and 2 only count the
    copies among the candidates of `alias`.
    """
    if not truth.is_present:
        return 0.0
    copies = truth.measured.get(COPIES, 0.0)
    return truth.measured.get(CEILING, 1.0 / (1.0 + copies))


def settle_not_applicable(scores: pd.DataFrame) -> pd.DataFrame:
    """Return the rows with "not applicable" as "missing" unless it covers a whole suite, track and prior group.

    A card's requirements are the same for all of these; a file that omits single queries would choose its queries.
    """
    claimed = scores["status"] == NOT_APPLICABLE
    group = [scores["suite"], scores["track"], scores["prior_group"]]
    is_whole = claimed.groupby(group).transform("all").astype(bool)
    return scores.assign(status=scores["status"].where(~claimed | is_whole, MISSING))
