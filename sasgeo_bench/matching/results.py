# SPDX-License-Identifier: Apache-2.0
"""Prediction: one row of an answer, of a program or a file; and the hash of a run."""

import hashlib
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Final, Literal, get_args

from sasgeo_bench.geometry.pose import Pose

Status = Literal["ok", "timeout", "crash", "invalid", "refused", "not applicable"]
STATUSES: Final[tuple[Status, ...]] = get_args(Status)
SOUND: Final[frozenset[Status]] = frozenset({"ok", "refused", "not applicable"})  # of a matcher that works


@dataclass(frozen=True, slots=True, kw_only=True)
class Prediction:
    """One row of the predictions of a task; the contract of a submission.

    Parameters
    ----------
    query_id : str
        Of the query.
    candidates : tuple of (Pose, float)
        Poses with scores, best first; empty where the answer was withheld or there is none.
    confidence : float, optional
        Probability that the first pose is right.
    diagnostics : mapping of str to float
        Further numbers of the matcher.
    status : str
        "ok"; "timeout", "crash", "invalid" or "refused" where there is no answer; "not applicable" where the matcher's
        card excludes the query.
    message : str
        The reason, in one line, if there is no answer.
    latency_s : float, optional
        By the runner's clock, from when the query was sent until the answer was read; None where there is no answer,
        and in files whose author gives none. Rows of older programs have the matcher's own clock here.
    matcher_s : float, optional
        Of `match` alone by the clock of the matcher's own process; no metric uses it.
    is_accepted : bool, optional
        Of a tracker: whether its estimate, the first pose, may be relied on.
    covariance : tuple of float, optional
        Of a tracker's estimate: 3 x 3, row by row, in the order east, north, yaw; m2, m deg and deg2.
    """

    query_id: str
    candidates: tuple[tuple[Pose, float], ...] = ()
    confidence: float | None = None
    diagnostics: Mapping[str, float] = field(default_factory=dict)
    status: Status = "ok"
    message: str = ""
    latency_s: float | None = None
    matcher_s: float | None = None
    is_accepted: bool | None = None
    covariance: tuple[float, ...] | None = None


def matcher_hash(spec: str, version: str, code: bytes, settings: str) -> str:
    """Return 12 hex digits that identify a run: by the name, version and code of its matcher, and its settings."""
    digest = hashlib.sha256()
    for part in (spec.encode(), version.encode(), code, settings.encode()):
        digest.update(len(part).to_bytes(8, "big") + part)
    return digest.hexdigest()[:12]
