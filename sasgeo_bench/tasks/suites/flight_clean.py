# SPDX-License-Identifier: Apache-2.0
"""Suite `flight-clean`: flights over today's map with odometers of several qualities."""

from typing import Final

from sasgeo_bench.tasks.suites.base import SuiteCard, Variant
from sasgeo_bench.tasks.suites.flights import AGAIN, SEQUENCE, START, FlightSuite, Mission

PROFILES: Final = ("vo-mono-survey", "wheel-poor", "vio-stereo", "vio-mono")  # by their drift after kilometres
_KIND: Final = "F1"


def _mission(variant: Variant) -> Mission:
    if variant.role == "stress":
        return Mission(profile=variant.kind.removeprefix(f"{_KIND} "))
    return Mission(profile="perfect", draw=AGAIN if variant.role == "falsifier" else "")


SUITE: Final = FlightSuite(
    card=SuiteCard(
        name="flight-clean",
        version=1,
        title="Drift of odometry (F1)",
        what="A flight over today's map, a view every 40 to 60 m, with the usual errors of perception and an odometer "
        "of each kind there is a profile of; the control's does not drift.",
        separates="What a map gives back of what drift takes.",
        falsifier="No drift again, with other errors of perception.",
        strength_unit="place of the odometer in the order of drift",
        group=START,
        tracks=SEQUENCE,
        min_density=0.05,
    ),
    variants=(
        Variant(role="control", kind="no drift"),
        *(
            Variant(role="stress", kind=f"{_KIND} {profile}", strength=float(order))
            for order, profile in enumerate(PROFILES, start=1)
        ),
        Variant(role="falsifier", kind="no drift again"),
    ),
    mission=_mission,
)
