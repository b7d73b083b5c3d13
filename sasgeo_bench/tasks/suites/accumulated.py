# SPDX-License-Identifier: Apache-2.0
"""Suite `accumulated`: several frames laid together by odometry that drifts."""

from dataclasses import replace
from typing import Final

from sasgeo_bench.sensing.accumulation import Errors
from sasgeo_bench.tasks.suites.base import SuiteCard, Variant
from sasgeo_bench.tasks.suites.pictures import ODOMETRY, STOPS_M, Flight, PictureSuite

FRAMES: Final = (3.0, 9.0)
FRAME, DRIFT = "P6 frames", "P6 drift"
_STANDING: Final = "standing still"


def _flight(variant: Variant) -> Flight:
    count, plain = int(variant.strength) or 1, Flight(height_m=80.0)
    if variant.kind == _STANDING:
        return replace(plain, stops_m=((0.0, 0.0),) * len(STOPS_M))
    bad = 5.0 if variant.kind == DRIFT else 1.0  # 5 times the drift
    return replace(
        plain,
        stops_m=STOPS_M[-count:],
        odometry=Errors(position_share=bad * ODOMETRY.position_share, yaw_deg_per_km=bad * ODOMETRY.yaw_deg_per_km),
    )


SUITE: Final = PictureSuite(
    card=SuiteCard(
        name="accumulated",
        version=1,
        title="Accumulated frames (P6)",
        what="One frame from 80 m shows a quarter of the view; 3 and 9 frames around it are laid together by odometry "
        "that drifts by 1 % and 2 deg per km (P6 frames), or by one five times as bad (P6 drift).",
        separates="What more frames give back from what their drift takes.",
        falsifier="Nine frames from one place: no more ground is seen than in the control.",
        strength_unit="frames",
    ),
    variants=(
        Variant(role="control", kind="one frame"),
        *(Variant(role="stress", kind=kind, strength=count) for kind in (FRAME, DRIFT) for count in FRAMES),
        Variant(role="falsifier", kind=_STANDING),
    ),
    flight=_flight,
)
