# SPDX-License-Identifier: Apache-2.0
"""Suite `flight-overconfident`: an odometer that believes in a third of its own errors."""

from typing import Final

from sasgeo_bench.tasks.suites.base import SuiteCard, Variant
from sasgeo_bench.tasks.suites.flights import AGAIN, SEQUENCE, START, FlightSuite, Mission


def _mission(variant: Variant) -> Mission:
    return Mission(
        belief="optimistic" if variant.role == "stress" else "honest", draw=AGAIN if variant.role == "falsifier" else ""
    )


SUITE: Final = FlightSuite(
    card=SuiteCard(
        name="flight-overconfident",
        version=1,
        title="Optimistic odometry (F6)",
        what="The same increments as in the control, and standard deviations a third of those that would be honest.",
        separates="Trackers that test what the odometer believes from those that trust it.",
        falsifier="Honest covariances, with other errors of perception and odometry.",
        strength_unit="1 for optimistic covariances",
        group=START,
        tracks=SEQUENCE,
        min_density=0.05,
    ),
    variants=(
        Variant(role="control", kind="honest"),
        Variant(role="stress", kind="F6 a third of the sigmas", strength=1.0),
        Variant(role="falsifier", kind="honest again"),
    ),
    mission=_mission,
)
