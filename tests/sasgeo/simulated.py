# SPDX-License-Identifier: Apache-2.0
"""Made-up searches whose posterior is right by construction, and answers to them of which the truth is known."""

from dataclasses import dataclass

import numpy as np

from sasgeo_bench.geometry.pose import Pose
from sasgeo_bench.matching.matcher import Prediction
from sasgeo_bench.sasgeo.conformal import levels_of
from sasgeo_bench.sasgeo.integrity import Modes, evidence_of
from sasgeo_bench.search.plan import Null

CLASSES, MODES, SIGMA_M = 4, 6, 3.0


@dataclass(frozen=True)
class Simulated:
    """Answers, which are false, the chance of that each was drawn with, and their errors in metres."""

    answers: list[Prediction]
    is_false: np.ndarray
    chance: np.ndarray
    error_m: np.ndarray


def modes_of(positions_m, by_class, **changes):
    values = {"positions_m": np.array(positions_m, float), "by_class": np.array(by_class, float), "sigma_m": 2.0}
    return Modes(**(values | changes))


def simulate(count, *, seed=0, hardness=0.5):
    """Answers with a known chance of being false.

    It hangs on the margin and on three things that no score tells: how much is unknown, the age of the map, and how
    well the graph agrees. So a rule that reads the evidence can do better than one that reads the margin.
    """
    rng = np.random.default_rng(seed)
    answers, chance = [], []
    for at in range(count):
        unknown, age, graph = rng.uniform(0, 0.8), rng.uniform(0, 12), rng.uniform(0, 1)
        by_class = rng.normal(0, 1, (MODES, CLASSES))
        by_class[0] += rng.gamma(2.0, 0.8)
        by_class = by_class[np.argsort(-by_class.sum(axis=1))]
        apart_m = rng.uniform(0, 600, (MODES, 2)) + 100.0 * np.arange(MODES)[:, None]
        modes = Modes(positions_m=apart_m, by_class=by_class, sigma_m=SIGMA_M)
        null = Null(best=float(modes.scores[0]), mean=0.0, deviation=2.0, places=500)
        given = evidence_of(
            modes,
            null=null,
            unknown_share=unknown,
            map_age_years=age,
            graph_consistency=graph if at % 10 else None,
            information_nats=20 * (1 - unknown),
        )
        odds = hardness - 0.5 * given["margin_nats"] + 3.0 * (unknown - 0.4) + 0.15 * (age - 6) - 3.0 * (graph - 0.5)
        chance.append(1 / (1 + np.exp(-odds)))
        places = [Pose(easting_m=east, northing_m=north, yaw_deg=0.0) for east, north in apart_m.tolist()]
        candidates = tuple(zip(places, modes.scores.tolist(), strict=True))
        answers.append(
            Prediction(
                query_id=str(at),
                candidates=candidates,
                confidence=float(modes.masses[0]),
                diagnostics=given | levels_of(modes),
            )
        )
    chance = np.array(chance)
    is_false = rng.random(count) < chance
    error_m = np.where(is_false, rng.uniform(30, 900, count), np.hypot(*rng.normal(0, SIGMA_M, (2, count))))
    return Simulated(answers=answers, is_false=is_false, chance=chance, error_m=error_m)
