# SPDX-License-Identifier: Apache-2.0
"""Does the map notice that a receiver is led astray: fixes on the map against the track of a receiver.

An alarm is raised when several accepted fixes in a row lie outside of the ellipse in which receiver and fix agree. A
single false fix raises none.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
import pandas as pd
from numpy.typing import NDArray
from scipy.stats import chi2

from sasgeo_bench.core.errors import ConfigError
from sasgeo_bench.matching.matcher import Prediction

Floats = NDArray[np.float64]

SHARE: Final = 0.999  # of the ellipse, where both are right
IN_A_ROW: Final = 3
SIGMA_M: Final = 3.3  # of a receiver, each axis: GPS is within 8 m in 95 %
STARTS: Final = 20  # of pull-offs, evenly over the first two thirds of a flight


@dataclass(frozen=True, kw_only=True)
class Monitor:
    """When an alarm is raised, and what is believed of the receiver.

    Parameters
    ----------
    sigma_m : float
        Standard deviation of the receiver's places, each axis.
    in_a_row : int
        Accepted fixes that must disagree one after the other.
    share : float
        Of fixes that agree by chance alone if receiver and covariances are honest.

    Raises
    ------
    ConfigError
        If a number is out of range.
    """

    sigma_m: float = SIGMA_M
    in_a_row: int = IN_A_ROW
    share: float = SHARE

    def __post_init__(self) -> None:
        if not 0 < self.sigma_m <= 100:
            raise ConfigError(f"--sigma lies above 0 and within 100 m, got {self.sigma_m:g}")
        if not 1 <= self.in_a_row <= 100:
            raise ConfigError(f"--in-a-row lies within 1 and 100, got {self.in_a_row}")
        if not 0.5 <= self.share < 1:
            raise ConfigError(f"share lies within 0.5 and 1, got {self.share:g}")

    def alarms(self, fixes: "Fixes", receiver_m: Floats) -> NDArray[np.bool_]:
        """Return at which fixes an alarm stands, shape (N,); `receiver_m` is the receiver's track, shape (N, 2).

        >>> fixes = Fixes(time_s=np.arange(4.0), place_m=np.zeros((4, 2)), covariance=np.tile(np.eye(2), (4, 1, 1)))
        >>> Monitor().alarms(fixes, np.array([[0, 0], [30, 0], [30, 0], [30, 0]])).tolist()
        [False, False, False, True]
        """
        gaps_m = fixes.place_m - receiver_m
        spread = fixes.covariance + self.sigma_m**2 * np.eye(2)
        far = np.einsum("ni,nij,nj->n", gaps_m, np.linalg.inv(spread), gaps_m) > chi2.ppf(self.share, 2)
        return runs_of(far) >= self.in_a_row


def runs_of(is_far: NDArray[np.bool_]) -> NDArray[np.int64]:
    """Return how many there are in a row up to each, shape (N,).

    >>> runs_of(np.array([True, True, False, True])).tolist()
    [1, 2, 0, 1]
    """
    total = np.cumsum(is_far)
    before = np.maximum.accumulate(np.where(is_far, 0, total)) if len(is_far) else total
    return np.asarray(total - before, dtype=np.int64)


@dataclass(frozen=True, kw_only=True, eq=False)
class Fixes:
    """N accepted fixes of a flight in order: times, places (east, north; metres), covariances of shape (N, 2, 2)."""

    time_s: Floats
    place_m: Floats
    covariance: Floats

    @classmethod
    def of(cls, views: pd.DataFrame, answers: Mapping[str, Prediction]) -> "tuple[Fixes, Floats]":
        """Return the accepted fixes of the views of one flight that have a covariance, and where the drone truly was.

        `views` are rows of `scoring.flights.view_frame`, in order.
        """
        rows, covariances = [], []
        for row, name, is_accepted in zip(range(len(views)), views["query_id"], views["is_accepted"], strict=True):
            answer = answers.get(name)
            if not is_accepted or answer is None or answer.covariance is None:
                continue
            in_plane = np.array(answer.covariance).reshape(3, 3)[:2, :2]
            if np.isfinite(in_plane).all() and np.linalg.eigvalsh(in_plane)[0] > 0:
                rows.append(row)
                covariances.append(in_plane)
        kept = views.iloc[rows]
        fixes = cls(
            time_s=kept["time_s"].to_numpy(float),
            place_m=kept[["east_m", "north_m"]].to_numpy(float),
            covariance=np.array(covariances).reshape(-1, 2, 2),
        )
        return fixes, kept[["true_east_m", "true_north_m"]].to_numpy(float)


@dataclass(frozen=True, slots=True, kw_only=True)
class GnssCheck:
    """What a monitor makes of one flight.

    Parameters
    ----------
    fixes : int
        Accepted fixes with a covariance.
    hours : float
        How long the flight lasts.
    alarms_s : tuple of float
        When an alarm begins though the receiver is right.
    noticed_s : tuple of float
        For each pull-off, how long after its begin an alarm stands that did not stand before; infinite where none does.
    """

    fixes: int
    hours: float
    alarms_s: tuple[float, ...]
    noticed_s: tuple[float, ...] = ()


def check_gnss(
    views: pd.DataFrame,
    answers: Mapping[str, Prediction],
    *,
    monitor: Monitor,
    pull_mps: float = 0.0,
    draws_noise: bool = True,
    seed: int = 0,
) -> GnssCheck:
    """Ask a monitor of one flight, whose truth stands for the receiver.

    Parameters
    ----------
    views : DataFrame
        Rows of `scoring.flights.view_frame` of one flight.
    answers : mapping of str to Prediction
        By the id of the query.
    monitor : Monitor
        When an alarm is raised.
    pull_mps : float
        Speed at which the receiver's place leaves the true one, in one direction, metres a second; 0 for not at all.
    draws_noise : bool
        Whether the receiver is off by noise of `monitor.sigma_m`; not where the truths are a receiver's own.
    seed : int
        Of noise and directions.

    Returns
    -------
    GnssCheck
        Pull-offs begin at `STARTS` times, evenly over the first two thirds of the flight.
    """
    ordered = views.sort_values("frame")
    fixes, true_m = Fixes.of(ordered, answers)
    rng = np.random.default_rng(seed)
    noise_m = rng.normal(0.0, monitor.sigma_m, true_m.shape) if draws_noise else np.zeros_like(true_m)
    receiver_m = true_m + noise_m
    length_s = float(ordered["time_s"].iloc[-1] - ordered["time_s"].iloc[0])
    standing = monitor.alarms(fixes, receiver_m)
    begins = fixes.time_s[standing & ~np.append([False], standing[:-1])[: len(standing)]]
    noticed = []
    for start_s in np.linspace(0.0, length_s * 2 / 3, STARTS).tolist() if pull_mps else ():
        turn = rng.uniform(0, 2 * np.pi)
        off_m = pull_mps * np.maximum(fixes.time_s - start_s, 0.0)[:, None] * [np.cos(turn), np.sin(turn)]
        new = monitor.alarms(fixes, receiver_m + off_m) & ~standing & (fixes.time_s >= start_s)
        noticed.append(float(fixes.time_s[new][0] - start_s) if new.any() else np.inf)
    return GnssCheck(
        fixes=len(fixes.time_s), hours=length_s / 3600, alarms_s=tuple(begins.tolist()), noticed_s=tuple(noticed)
    )


def summary(checks: Sequence[GnssCheck], paths: Sequence[str]) -> dict[str, float]:
    """Return figures over flights: alarms an hour, the share that is noticed, and how soon (median, 95 %).

    `paths` names the path of each flight: hours are those of distinct paths, as flights along one path with several
    odometers share their views and so their errors. "At most" is the upper end of a Poisson count at 95 %, one-sided,
    of the alarms of a flight on average over these hours. Pull-offs that nobody notices count as infinite.

    Two flights of one path of half an hour; one of them alarms once:

    >>> flights = [GnssCheck(fixes=9, hours=0.5, alarms_s=(3.0,)), GnssCheck(fixes=9, hours=0.5, alarms_s=())]
    >>> summary(flights, ["a", "a"])
    {'paths': 1, 'hours': 0.5, 'alarms_per_hour': 1.0, 'alarms_per_hour_at_most': 7.815}
    >>> summary(flights, ["a", "b"])["alarms_per_hour_at_most"]
    4.744
    """
    flown = {path: one.hours for path, one in zip(paths, checks, strict=True)}
    hours, alarms = sum(flown.values()), sum(len(one.alarms_s) for one in checks)
    rate = alarms / sum(one.hours for one in checks) if hours else np.nan
    found = {
        "paths": len(flown),
        "hours": round(hours, 3),
        "alarms_per_hour": round(rate, 3),
        "alarms_per_hour_at_most": round(float(chi2.ppf(0.95, 2 * rate * hours + 2)) / 2 / hours, 3) if hours else rate,
    }
    times = np.array([time for one in checks for time in one.noticed_s])
    if len(times):
        p50, p95 = np.quantile(times, [0.5, 0.95], method="inverted_cdf").tolist()
        found |= {"noticed": round(float(np.isfinite(times).mean()), 3), "notice_p50_s": p50, "notice_p95_s": p95}
    return found
