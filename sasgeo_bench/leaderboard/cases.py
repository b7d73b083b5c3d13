# SPDX-License-Identifier: Apache-2.0
"""Queries that went wrong, each in one class of failure, and a few of each class to look at.

The classes, in the order in which they are tried; every failure is in the first that fits:

absent accepted
    The place is absent, and the answer is accepted.
right but not accepted
    The fix is right, and is not accepted.
aged
    Under a stress whose view differs more from the map than that of its control does (`changed_share`, by at least
    0.1), the answer is wrong or none, and that of the control is right: same matcher, site, track, prior group and
    size of view.
occluded
    The same with more of the view unknown (`unknown_share`, by at least 0.05).
one of several
    The answer is wrong and accepted, and nobody could do better: the searched map holds the place several times, so
    that its ceiling is below 1. The controls and falsifiers of twins are such.
aliased
    The answer is wrong and accepted, at a place that has a double: alias index at least 0.9, the highest bin of a
    board, or a suite that copies places.
also without the stress
    Under a stress the answer is wrong or none, and so is that of a control at the site: the stress is not to blame.
other
    Any other control or stress at a present place without a right answer.

Accepted is what the operating rejector accepts at the threshold that kept the risk at 5 % on calibration places; where
there is none, every answer. Right is within 25 m whatever the heading, on both tracks, as in all figures of
rejection. Falsifiers are no cases: of some of them nothing else is asked than no answer.
"""

import hashlib
from collections.abc import Mapping, Sequence
from typing import Any, Final

import numpy as np
import pandas as pd

from sasgeo_bench.scoring.base import Bools
from sasgeo_bench.scoring.contrasts import Contrast
from sasgeo_bench.scoring.rejection import OWN

BOTH: Final = "also without the stress"
SEVERAL: Final = "one of several"
FAILURES: Final = (
    *("aliased", "aged", "occluded", "absent accepted", "right but not accepted", SEVERAL, BOTH, "other"),
)
MEANINGS: Final = {  # of the classes, for whoever looks at them; above in full
    "aliased": "wrong and accepted, where the map has a place much alike",
    "aged": "right on the map of the day, wrong where more of the map has changed",
    "occluded": "right in the open, wrong where more of the view is hidden",
    "absent accepted": "an answer is accepted although the place is not on the map",
    "right but not accepted": "the answer is right, and the rejector refuses it",
    SEVERAL: "wrong and accepted, but the map holds the place several times, and nothing tells which it is",
    BOTH: "as wrong without the stress, which is not to blame",
    "other": "no right answer, for no reason that is told here",
}
OPERATING: Final = "accepted_0.05"  # column of judged rows
COLUMNS: Final = ("query_id", "matcher", "failure", "suite", "region", "kind")
MOST_CASES: Final = 60  # of a board
_ALIAS: Final = 0.9
_UNKNOWN_MORE: Final = 0.05
_CHANGED_MORE: Final = 0.1  # the lowest bin of a board ends there: less is hardly a change
_COPIES: Final = ("alias", "topology-twins", "instance-twins")  # suites where every place has a double
_SITE: Final = ("pair_id", "track", "prior_group", "view_cells")


def operating_rejector(
    judged: Mapping[tuple[str, str], pd.DataFrame], matcher: str, contrasts: Sequence[Contrast] = ()
) -> str | None:
    """Return the rejector whose threshold accepts a matcher's answers; None if none has a threshold.

    It is that of the first contrast with the matcher as its first side, else the first in `judged`, else the matcher's
    own confidence.

    >>> rows = pd.DataFrame({"accepted_0.05": [True]})
    >>> operating_rejector({("m", "own"): rows, ("m", "margin"): rows}, "m")
    'margin'
    """
    sides = [item.first.partition(" x ") for item in contrasts]
    first = [rejector for name, _, rejector in sides if name == matcher and rejector]
    known = [rejector for name, rejector in judged if name == matcher]
    for rejector in (*first, *(name for name in known if name != OWN), OWN):
        frame = judged.get((matcher, rejector))
        if frame is not None and frame[OPERATING].notna().any():
            return rejector
    return None


def find_cases(scores: pd.DataFrame, matcher: str, judged: pd.DataFrame | None = None) -> pd.DataFrame:
    """Return the failures of one matcher in the order of its scored rows, with the columns `COLUMNS`.

    `judged` are the results of the operating rejector; rows that it lacks have no threshold.
    """
    taken, has_threshold = _accepted(scores, judged)
    is_present, is_right, is_answered = (
        scores[name].to_numpy(bool) for name in ("is_present", "is_right", "is_answered")
    )
    is_stress, is_asked = ((scores["role"] != role).to_numpy(bool) for role in ("control", "falsifier"))
    is_applicable = (scores["status"] != "not applicable").to_numpy(bool)  # else its card says so: nothing failed
    is_asked = is_asked & is_applicable
    is_wrong = is_present & ~is_right & is_asked
    control = _controls(scores)
    is_paired = is_wrong & is_stress & control["is_right"].to_numpy(bool)
    changed, unknown = (scores[name].to_numpy(float) for name in ("changed_share", "unknown_share"))
    alias = scores["alias_index"].astype(float).fillna(0.0).to_numpy(float)
    has_double = (alias >= _ALIAS) | scores["suite"].isin(_COPIES).to_numpy(bool)
    rules = (
        ("absent accepted", ~is_present & is_answered & taken & is_asked),
        ("right but not accepted", is_present & is_right & has_threshold & ~taken & is_asked),
        ("aged", is_paired & (changed >= control["changed_share"].to_numpy(float) + _CHANGED_MORE)),
        ("occluded", is_paired & (unknown >= control["unknown_share"].to_numpy(float) + _UNKNOWN_MORE)),
        (SEVERAL, is_wrong & is_answered & taken & (scores["ceiling"] < 1.0).to_numpy(bool)),
        ("aliased", is_wrong & is_answered & taken & has_double),
        (BOTH, is_wrong & is_stress & control["is_wrong"].to_numpy(bool)),
        ("other", is_wrong),
    )
    failure = np.select([mask for _, mask in rules], [name for name, _ in rules], default="")
    found = scores.assign(matcher=matcher, failure=failure)
    return pd.DataFrame(found[failure != ""], columns=list(COLUMNS)).reset_index(drop=True)


def _accepted(scores: pd.DataFrame, judged: pd.DataFrame | None) -> tuple[Bools, Bools]:
    """Return which answers are accepted, and for which a threshold exists."""
    answered = scores["is_answered"].to_numpy(bool)
    if judged is None:
        return answered, np.zeros(len(scores), dtype=bool)
    operating = dict(zip(judged["query_id"], judged[OPERATING], strict=True))
    known = np.array([float(operating.get(name, np.nan)) for name in scores["query_id"]], dtype=np.float64)
    is_known = ~np.isnan(known)
    return np.where(is_known, known > 0, answered), is_known


def _controls(scores: pd.DataFrame) -> pd.DataFrame:
    """Return for each row the controls at its site: whether all are right, some are wrong, and their shares."""
    controls = scores[(scores["role"] == "control").to_numpy(bool) & scores["is_present"].to_numpy(bool)]
    how = {"is_right": "all", "changed_share": "max", "unknown_share": "max"}
    found = controls.groupby(list(_SITE), as_index=False).agg(how)
    joined = scores[list(_SITE)].merge(found, on=list(_SITE), how="left")
    shares = {"is_right": joined["is_right"].eq(other=True), "is_wrong": joined["is_right"].eq(other=False)}
    return joined.assign(**shares).fillna({"changed_share": 0.0, "unknown_share": 0.0})


def sample_cases(cases: pd.DataFrame, *, each: int, most: int = MOST_CASES) -> pd.DataFrame:
    """Return at most `each` failures of each class and matcher; the choice depends on their names only.

    `cases` are from `find_cases`, one matcher after the other. At most `most` are chosen in all: the first of every
    class and matcher, then the second of each, and so on. They are in the order of classes, then of matchers as given.
    """
    if cases.empty:
        return cases
    matchers = list(dict.fromkeys(cases["matcher"]))
    ranked = cases.assign(
        _class=cases["failure"].map(FAILURES.index),
        _who=cases["matcher"].map(matchers.index),
        _mark=[_mark(*names) for names in zip(cases["matcher"], cases["query_id"], strict=True)],
    ).sort_values(["_class", "_who", "_mark"])
    ranked = ranked.assign(_round=ranked.groupby(["_class", "_who"]).cumcount())
    chosen = ranked[ranked["_round"] < each].sort_values(["_round", "_class", "_who"], kind="stable").head(most)
    chosen = chosen.sort_values(["_class", "_who", "_round"], kind="stable")
    return chosen[list(cases.columns)].reset_index(drop=True)


def _mark(matcher: str, query_id: str) -> str:
    return hashlib.sha256(f"{matcher}/{query_id}".encode()).hexdigest()


def count_cases(cases: pd.DataFrame) -> dict[str, int]:
    """Return the number of failures of each class."""
    counts = cases["failure"].value_counts()
    return {name: int(counts.get(name, 0)) for name in FAILURES}


def words_of(words: Mapping[tuple[str, str], pd.DataFrame], matcher: str, query_id: str) -> dict[str, Any]:
    """Return what rejectors state of one answer: chance to be false or rank, and whether they accept it.

    `words` are rows of `RejectionResult` by matcher and rejector, with the query ids as index.
    """
    p_false: dict[str, float] = {}
    orders: dict[str, float] = {}
    accepted: dict[str, bool] = {}
    for (name, rejector), frame in words.items():
        if name != matcher or query_id not in frame.index:
            continue
        row: Any = frame.loc[query_id]
        if pd.notna(row["p_right"]):
            is_chance = bool(row.get("is_calibrated", True))
            (p_false if is_chance else orders)[rejector] = 1.0 - float(row["p_right"])
        if pd.notna(row[OPERATING]) and row["is_answered"]:
            accepted[rejector] = bool(row[OPERATING])
    return {"p_false": p_false, "orders": orders, "accepted": accepted}
