# SPDX-License-Identifier: Apache-2.0
"""Milliseconds that integrity adds to an answer: evidence and protection levels of its modes, and P(false fix).

Searches are made up: 10 modes, 13 classes. "one at a time" is what a flight would pay for each answer, "together" what
a board pays for each of 2,000. Run it with `make bench`.
"""

import argparse
import statistics
import sys
import time
from collections.abc import Callable

import numpy as np

from sasgeo_bench.geometry.pose import Pose
from sasgeo_bench.matching.matcher import Prediction
from sasgeo_bench.sasgeo.conformal import levels_of
from sasgeo_bench.sasgeo.integrity import Modes, evidence_of
from sasgeo_bench.sasgeo.rejectors import SasgeoBoosted, SasgeoLogistic
from sasgeo_bench.search.plan import Null

MODES, CLASSES = 10, 13
CALIBRATION, ASKED = (300, 3000), 2000
SINGLES = 100


def modes_of(rng: np.random.Generator) -> Modes:
    """Modes of one search, best first."""
    by_class = rng.normal(0.0, 1.0, (MODES, CLASSES))
    order = np.argsort(-by_class.sum(axis=1))
    return Modes(positions_m=rng.uniform(0, 2000, (MODES, 2)), by_class=by_class[order], sigma_m=2.0)


def told_of(modes: Modes) -> dict[str, float]:
    """Everything an answer tells of its soundness."""
    null = Null(best=float(modes.scores[0]), mean=0.0, deviation=1.0, places=1000)
    return evidence_of(modes, null=null, unknown_share=0.3, map_age_years=2.0) | levels_of(modes)


def answer_of(modes: Modes, rng: np.random.Generator) -> Prediction:
    """The answer to one search."""
    poses = [Pose(easting_m=east, northing_m=north, yaw_deg=0.0) for east, north in modes.positions_m.tolist()]
    return Prediction(
        query_id=rng.bytes(12).hex(),
        candidates=tuple(zip(poses, modes.scores.tolist(), strict=True)),
        confidence=float(modes.masses[0]),
        diagnostics=told_of(modes),
    )


def millis(call: Callable[[], object], runs: int) -> float:
    """Median milliseconds of a call."""
    found = []
    for _ in range(runs):
        begun = time.perf_counter()
        call()
        found.append(1e3 * (time.perf_counter() - begun))
    return statistics.median(found)


def main() -> None:
    """Print a table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--runs", type=int, default=5)
    runs = parser.parse_args().runs
    rng = np.random.default_rng(0)
    searches = [modes_of(rng) for _ in range(ASKED + max(CALIBRATION))]
    # Anew each time: what `Modes` keeps of itself must not be there already.
    fresh = iter([modes_of(rng) for _ in range(runs * SINGLES)])
    print(
        f"evidence and levels of {MODES} modes: {millis(lambda: told_of(next(fresh)), runs * SINGLES):.2f} ms an answer"
    )
    answers = [answer_of(modes, rng) for modes in searches]
    is_false = rng.random(len(answers)) < 0.3  # some are false; timing needs no more
    asked = answers[:ASKED]
    print(f"{'rejector':>16} {'fitted on':>10} {'fit, s':>8} {'one at a time, ms':>18} {'together, ms each':>18}")
    for rule in (SasgeoLogistic, SasgeoBoosted):
        for count in CALIBRATION:
            rejector = rule()
            known, truth = answers[ASKED : ASKED + count], is_false[ASKED : ASKED + count]
            fit_s = millis(lambda: rejector.fit(known, truth), runs) / 1e3  # noqa: B023 - called before the next round
            single = iter(asked * runs)
            one = millis(lambda: rejector.p_false([next(single)]), runs * SINGLES)  # noqa: B023
            each = millis(lambda: rejector.p_false(asked), runs) / ASKED  # noqa: B023
            print(f"{rejector.card.name:>16} {count:10d} {fit_s:8.2f} {one:18.2f} {each:18.3f}", flush=True)


if __name__ == "__main__":
    sys.exit(main())
