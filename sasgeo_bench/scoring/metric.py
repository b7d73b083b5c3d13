# SPDX-License-Identifier: Apache-2.0
"""Kinds of metrics: what a row of the table of metrics says of itself, and how it is computed."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import numpy as np
import pandas as pd

from sasgeo_bench.scoring import cost
from sasgeo_bench.scoring.base import Bools, Floats


@dataclass(frozen=True, slots=True, kw_only=True)
class Metric:
    """A metric as a board prints it.

    `name` is as in the column `metric` of `leaderboard.parquet`, `meaning` one or two sentences for a reader of the
    board, `source` the reference of the definition, `unit` "1" for none, `bounds` the least and greatest possible
    value.
    """

    name: str
    meaning: str
    source: str = "original"
    unit: str = "1"
    better: Literal["higher", "lower"] = "lower"
    bounds: tuple[float, float] = (0.0, 1.0)

    @property
    def worst(self) -> float:
        """Return the value of a method that fails at everything."""
        return self.bounds[self.better == "lower"]


def every_row(scores: pd.DataFrame) -> Bools:
    """Return a mask of all rows."""
    return np.ones(len(scores), dtype=bool)


@dataclass(frozen=True, slots=True, kw_only=True)
class MeanMetric(Metric):
    """A mean over queries or flights, printed on some tracks; matchers are ranked by the primary one.

    `values` maps scored rows (`scores.parquet`) to one number for each; of a metric of another package NaN leaves a
    query out. `counts` maps them to a mask of the denominator, by default all. The denominator is the same for every
    matcher: whether a query counts may depend on the query and its truth, never on the answer. One that no answer does
    not spoil, as a share of false fixes, names in `read_with` the metric of the track that counts no answers.

    Examples
    --------
    >>> def near(scores):
    ...     return (scores["position_error_m"] <= 15.0).where(scores["is_present"]).to_numpy(float)
    >>> meaning = "Share of queries with a fix within 15 m, whatever the heading"
    >>> MeanMetric(name="within-15m", meaning=meaning, better="higher", tracks=("localization",), values=near).worst
    0.0
    """

    tracks: tuple[str, ...]
    values: Callable[[pd.DataFrame], Floats]
    counts: Callable[[pd.DataFrame], Bools] = every_row
    is_primary: bool = False
    read_with: str = ""


@dataclass(frozen=True, slots=True, kw_only=True)
class QuantileMetric(Metric):
    """A quantile of the errors in a column of scored rows of one track, including infinite ones."""

    column: str
    share: float
    track: str = "localization"


@dataclass(frozen=True, slots=True, kw_only=True)
class RejectionMetric(Metric):
    """A metric of matcher x rejector; `needs_chances` if the confidence must be a probability.

    `compute(answers, weights=...)` takes `decisions.Fixes` of N queries and weights of shape (N,).
    """

    compute: Callable[..., float]
    needs_chances: bool = False
    has_interval: bool = False


@dataclass(frozen=True, slots=True, kw_only=True)
class ThresholdMetric(Metric):
    """A share of queries at a threshold chosen on calibration places.

    The threshold kept the false fixes among the accepted ones at `limit`, or, if it `is_of_absent`, the accepted ones
    among absent places. `what` is the share: of all queries that are "covered", of the accepted ones that are false
    ("risk"), of the present places whose fix is right and accepted ("right"), or of the "absent" ones accepted.
    """

    limit: float
    what: Literal["covered", "risk", "right", "absent"]
    is_of_absent: bool = False

    @property
    def accepted(self) -> str:
        """Return the column of judged rows with what the threshold accepts."""
        return f"accepted_absent_{self.limit:g}" if self.is_of_absent else f"accepted_{self.limit:g}"


@dataclass(frozen=True, slots=True, kw_only=True)
class CostMetric(Metric):
    """Cost of the answers of one matcher, by track or of all tracks together."""

    compute: Callable[[cost.Costs], float]
    is_by_track: bool = False
