# SPDX-License-Identifier: Apache-2.0
"""Suite `flight-gap`: a stretch of a flight that nobody sees."""

from typing import Final

from sasgeo_bench.tasks.suites.base import SuiteCard, Variant
from sasgeo_bench.tasks.suites.flights import SEQUENCE, START, FlightSuite, Mission

GAPS_M: Final = (500.0, 1000.0)
SCATTERED: Final = "as many views, scattered"


def _mission(variant: Variant) -> Mission:
    if variant.kind == SCATTERED:
        return Mission(gaps_m=GAPS_M, is_scattered=True)
    return Mission(gaps_m=(variant.strength,) if variant.role == "stress" else ())


SUITE: Final = FlightSuite(
    card=SuiteCard(
        name="flight-gap",
        version=1,
        title="Unseen stretch (F4)",
        what="In the middle of the flight no view shows anything for 500 m or 1 km, as in cloud or over a lake; the "
        "odometer goes on. A gap is a third of the flight at most.",
        separates="Trackers whose belief grows with the drift from those that go on with what was right before.",
        falsifier="As many views show nothing as in the longest gap of the flight, spread evenly over it.",
        strength_unit="m flown without a view",
        group=START,
        tracks=SEQUENCE,
        min_density=0.05,
    ),
    variants=(
        Variant(role="control", kind="no gap"),
        *(Variant(role="stress", kind="F4 gap", strength=length_m) for length_m in GAPS_M),
        Variant(role="falsifier", kind=SCATTERED),
    ),
    mission=_mission,
)
