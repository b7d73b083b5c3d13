# SPDX-License-Identifier: Apache-2.0
"""The paper's experiment as tables: every trial, our figures next to its Table II, and data of its figures."""

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Final

import numpy as np
import pandas as pd

from sasgeo_bench.matching.matcher import Prediction
from sasgeo_bench.scoring.base import Bools
from sasgeo_bench.scoring.decisions import Fixes, aurc, risk_coverage
from sasgeo_bench.scoring.intervals import Interval, wilson_mean
from sasgeo_bench.scoring.metrics import ranks_of
from sasgeo_bench.scoring.pose import hits, reciprocal_ranks
from sasgeo_bench.scoring.rows import is_unranked
from sasgeo_bench.scoring.score import NOT_APPLICABLE
from sasgeo_bench.scoring.strata import ALL
from sasgeo_bench.tasks.query import Truth

PAPER_TRIALS: Final = 220
METRICS: Final = {"recall_1": "Recall@1", "recall_5": "Recall@5", "mrr": "MRR"}
CHANGE_EDGES: Final = (0.0, 0.08, 0.16, 0.24, 0.32)  # of the map-change probability: quarters of its range
_NOTHING: Final = Interval(value=math.nan, lo=math.nan, hi=math.nan)
_MARGIN_DIGITS: Final = 9  # scores that differ by less differ by rounding: no threshold should part them


@dataclass(frozen=True, slots=True, kw_only=True)
class Published:
    """A row of the paper's Table II; the interval of Recall@1 is Wilson's."""

    matcher: str
    title: str
    recall_1: float
    lo: float
    hi: float
    recall_5: float
    mrr: float


PUBLISHED: Final = tuple(
    Published(matcher=matcher, title=title, recall_1=recall_1, lo=lo, hi=hi, recall_5=recall_5, mrr=mrr)
    for matcher, title, recall_1, lo, hi, recall_5, mrr in (
        ("global_descriptor", "Global descriptor", 0.586, 0.520, 0.649, 0.886, 0.701),
        ("raster_uniform", "Raster, uniform", 0.945, 0.907, 0.969, 1.000, 0.966),
        ("raster_graph", "Raster + graph", 0.950, 0.913, 0.972, 0.995, 0.968),
        ("raster_graph_stability", "+ stability", 0.950, 0.913, 0.972, 0.995, 0.967),
        ("full_unknown", "Full + unknown handling", 0.955, 0.918, 0.975, 1.000, 0.971),
    )
)


def in_order(matchers: Sequence[str]) -> list[str]:
    """Sort matchers: the paper's variants in its order, then others by name, then controls.

    >>> in_order(["random", "mine", "raster_graph", "global_descriptor"])
    ['global_descriptor', 'raster_graph', 'mine', 'random']
    """
    known = [item.matcher for item in PUBLISHED if item.matcher in matchers]
    others = sorted(set(matchers) - set(known), key=lambda name: (is_unranked(name), name))
    return [*known, *others]


def title_of(matcher: str) -> str:
    """Return a variant's name in the paper's table, or any other matcher's own."""
    return next((item.title for item in PUBLISHED if item.matcher == matcher), matcher)


def trials_frame(
    scores: Mapping[str, pd.DataFrame],
    predictions: Mapping[str, Mapping[str, Prediction]],
    truths: Mapping[str, Truth],
) -> pd.DataFrame:
    """Return a row for each trial and matcher: the changes to the view, and the result.

    `scores` are scored rows by matcher, `predictions` by matcher and query id, `truths` by query id. Matchers come as
    in `in_order`. `rank_best` and `rank_worst` differ where the true candidate's score is tied; both are missing where
    it is not in the answer. `margin` is the first score less the second.
    """
    frames = [_trials_of(name, scores[name], predictions[name], truths) for name in in_order(list(scores))]
    return pd.concat(frames, ignore_index=True)


def _trials_of(
    matcher: str, scores: pd.DataFrame, predictions: Mapping[str, Prediction], truths: Mapping[str, Truth]
) -> pd.DataFrame:
    ranks = ranks_of(scores)
    ids = scores["query_id"].tolist()
    is_listed = ranks.right > 0
    first, second = np.array([_two_scores(predictions.get(name)) for name in ids]).reshape(-1, 2).T
    done = pd.DataFrame([truths[name].measured for name in ids])
    return pd.DataFrame(
        {
            "matcher": matcher,
            "query_id": ids,
            "seed": [int(region.rpartition("-")[2]) for region in scores["region"]],
            "tile": [int(truths[name].block.rpartition("/")[2]) for name in ids],
            "block": scores["block"].to_numpy(),
            "status": scores["status"].to_numpy(),
            "is_answered": scores["is_answered"].to_numpy(bool),
            "is_right": scores["is_right"].to_numpy(bool),
            "rank_best": _whole(ranks.above + 1, is_listed),
            "rank_worst": _whole(ranks.above + ranks.tied, is_listed),
            "recall_1": hits(ranks, 1),
            "recall_5": hits(ranks, 5),
            "mrr": reciprocal_ranks(ranks),
            "score_first": first,
            "score_second": second,
            "margin": np.round(first - second, _MARGIN_DIGITS),
            "latency_s": scores["latency_s"].to_numpy(float),
            **{name: done[name].to_numpy(float) for name in done.columns},
        }
    )


def _two_scores(prediction: Prediction | None) -> tuple[float, float]:
    """Return the scores of the first candidate and the second; NaN where there is none."""
    found = [] if prediction is None else [score for _, score in prediction.candidates[:2]]
    first, second = (*found, math.nan, math.nan)[:2]
    return first, second


def _whole(values: np.ndarray, is_there: Bools) -> pd.Series:
    """Return whole numbers, missing where there is none."""
    return pd.Series(values, dtype="Int64").where(pd.Series(is_there))


def summary_frame(trials: pd.DataFrame, board: pd.DataFrame) -> pd.DataFrame:
    """Return a row for each matcher and figure, ours next to the paper's.

    `trials` is from `trials_frame`; `board` holds the leaderboard's rows of this suite, with intervals over clusters.
    `paper` comes with `paper_lo` and `paper_hi` where the paper gives them; `value` with Wilson's interval `lo`, `hi`
    as if trials were independent; `cluster_lo`, `cluster_hi` by resampling `clusters` of one `cluster` ("tile" or
    "seed"), then trials within; `is_within` is whether the paper's figure lies in the interval of `used_interval`.
    """
    seeds = int(trials["seed"].nunique())
    whole = board[(board["stratum"] == ALL) & (board["rejector"] == "")].set_index(["matcher", "metric"])
    rows = []
    for matcher in in_order(list(dict.fromkeys(trials["matcher"]))):
        own = trials[trials["matcher"] == matcher]
        is_asked = bool((own["status"] != NOT_APPLICABLE).any())
        paper = next((item for item in PUBLISHED if item.matcher == matcher), None)
        for metric in METRICS:
            found = wilson_mean(own[metric].to_numpy(float)) if is_asked else _NOTHING
            over = _over_clusters(whole, matcher, metric)
            published, cluster = _published(paper, metric), "tile" if seeds == 1 else "seed"
            lo, hi = used_interval(cluster, wilson=(found.lo, found.hi), clusters=(over.lo, over.hi))
            rows.append(
                {
                    "matcher": matcher,
                    "title": title_of(matcher),
                    "metric": metric,
                    **published,
                    "value": found.value,
                    "lo": found.lo,
                    "hi": found.hi,
                    "n": len(own),
                    "cluster": cluster,
                    "clusters": int(own["block"].nunique()),
                    "cluster_lo": over.lo,
                    "cluster_hi": over.hi,
                    "is_within": bool(lo <= published["paper"] <= hi),
                }
            )
    return pd.DataFrame(rows)


def _published(paper: Published | None, metric: str) -> dict[str, float]:
    """Return the paper's figure; it gives an interval of Recall@1 alone."""
    if paper is None:
        return {"paper": math.nan, "paper_lo": math.nan, "paper_hi": math.nan, "paper_n": 0}
    lo, hi = (paper.lo, paper.hi) if metric == "recall_1" else (math.nan, math.nan)
    return {"paper": getattr(paper, metric), "paper_lo": lo, "paper_hi": hi, "paper_n": PAPER_TRIALS}


def _over_clusters(whole: pd.DataFrame, matcher: str, metric: str) -> Interval:
    """Return the leaderboard's interval; none where the matcher cannot answer."""
    if (matcher, metric) not in whole.index:
        return _NOTHING
    row = whole.loc[[(matcher, metric)]].iloc[0]
    return Interval(value=float(row["value"]), lo=float(row["lo"]), hi=float(row["hi"]))


def used_interval(cluster: str, *, wilson: tuple[float, float], clusters: tuple[float, float]) -> tuple[float, float]:
    """Return our interval that is compared with the paper's figure: Wilson's for one seed, over seeds for several."""
    return wilson if cluster == "tile" or math.isnan(clusters[0]) else clusters


def robustness_frame(trials: pd.DataFrame) -> pd.DataFrame:
    """Return Recall@1 of each matcher in quarters of map-change probability, with Wilson's interval.

    Columns: matcher, title, low and high edge, mean probability, n, value, lo, hi; no row for an empty quarter.
    Controls are left out.
    """
    rows = []
    for matcher, own in _contestants(trials):
        at = np.clip(np.digitize(own["change_probability"], CHANGE_EDGES[1:-1]), 0, len(CHANGE_EDGES) - 2)
        for index, (low, high) in enumerate(pairwise(CHANGE_EDGES)):
            part = own[at == index]
            if len(part):
                found = wilson_mean(part["recall_1"].to_numpy(float))
                mean = float(part["change_probability"].mean())
                head = {"matcher": matcher, "title": title_of(matcher), "low": low, "high": high, "mean": mean}
                rows.append(head | {"n": len(part), "value": found.value, "lo": found.lo, "hi": found.hi})
    return pd.DataFrame(rows)


def risk_frame(trials: pd.DataFrame) -> pd.DataFrame:
    """Return risk against coverage of each matcher whose answers are accepted from the largest margin down.

    Columns: matcher, title, margin (the threshold), coverage, risk, and n and aurc, the same in all rows of a matcher.
    Controls are left out.
    """
    frames = []
    for matcher, own in _contestants(trials):
        some = Fixes(
            confidence=own["margin"].to_numpy(float),
            is_answered=own["is_answered"].to_numpy(bool),
            is_right=own["is_right"].to_numpy(bool),
            is_present=np.ones(len(own), dtype=bool),
        )
        curve = risk_coverage(some)
        head = {"matcher": matcher, "title": title_of(matcher)}
        points = {"margin": curve.threshold, "coverage": curve.coverage, "risk": curve.risk}
        frames.append(pd.DataFrame(head | points | {"n": len(own), "aurc": aurc(some)}))
    return pd.concat(frames, ignore_index=True)


def _contestants(trials: pd.DataFrame) -> Iterator[tuple[str, pd.DataFrame]]:
    """Yield the trials of each matcher that is no control and can answer."""
    asked = trials[trials["status"] != NOT_APPLICABLE]
    for matcher in in_order(list(dict.fromkeys(asked["matcher"]))):
        if not is_unranked(matcher):
            yield matcher, trials[trials["matcher"] == matcher]


def example_of(truths: Sequence[Truth]) -> Truth:
    """Choose the trial to show: nearest to the middle of occlusion and change, if possible turned and cropped.

    Results of matchers have no part in the choice.
    """
    turned = [item for item in truths if item.measured["rotation_deg"] > 0 and item.measured["crop_fraction"] < 1]
    middle = {"occlusion_share": 0.24 / 2, "change_probability": CHANGE_EDGES[-1] / 2}

    def away(item: Truth) -> float:
        """Return the distance from the middle, in ranges."""
        return sum(abs(item.measured[name] / (2 * value) - 0.5) for name, value in middle.items())

    return min(turned or truths, key=lambda item: (away(item), item.query_id))
