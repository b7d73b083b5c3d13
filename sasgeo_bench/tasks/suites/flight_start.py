# SPDX-License-Identifier: Apache-2.0
"""Suite `flight-start`: less and less is known of where a flight begins."""

from typing import Final

from sasgeo_bench.tasks.query import PriorGroup
from sasgeo_bench.tasks.suites.base import SuiteCard, Variant
from sasgeo_bench.tasks.suites.flights import AGAIN, SEQUENCE, FlightSuite, Mission

KNOWN: Final = PriorGroup(radius_m=100.0, yaw="known", scale_sigma=0.03)
ANYWHERE: Final = "F3 anywhere"
RADII_M: Final = (500.0, 2000.0)


def _mission(variant: Variant) -> Mission:
    if variant.role == "falsifier":
        return Mission(group=KNOWN, draw=AGAIN)
    if variant.role == "control":
        return Mission(group=KNOWN)
    radius_m = None if variant.kind == ANYWHERE else variant.strength
    return Mission(group=PriorGroup(radius_m=radius_m, yaw="weak", scale_sigma=0.03))


SUITE: Final = FlightSuite(
    card=SuiteCard(
        name="flight-start",
        version=1,
        title="Unknown start (F3)",
        what="A flight begins within a disc of 500 m or 2 km that is known, or anywhere on the map; the control's "
        "begins within 100 m with a known heading.",
        separates="Trackers that keep several hypotheses until one is right from those that begin with one.",
        falsifier="The start of the control, with other errors of perception and odometry.",
        strength_unit="radius of the disc, m; 0 for the control, 9999 for the whole map",
        has_own_priors=True,
        group=KNOWN,
        tracks=SEQUENCE,
        min_density=0.05,
    ),
    variants=(
        Variant(role="control", kind="known start"),
        *(Variant(role="stress", kind="F3 disc", strength=radius_m) for radius_m in RADII_M),
        Variant(role="stress", kind=ANYWHERE, strength=9999.0),
        Variant(role="falsifier", kind="known start again"),
    ),
    mission=_mission,
)
