# SPDX-License-Identifier: Apache-2.0
"""Suite `oblique`: pictures that do not look straight down."""

from typing import Final

from sasgeo_bench.tasks.suites.base import SuiteCard, Variant
from sasgeo_bench.tasks.suites.pictures import BODY_SIGMA_DEG, Flight, PictureSuite

TILTS_DEG: Final = (15.0, 30.0, 50.0)
TILT, BODY = "P2 tilt", "P2 body"


def _flight(variant: Variant) -> Flight:
    if variant.kind == BODY:
        return Flight(is_fixed=True)
    return Flight(tilt_deg=variant.strength)


SUITE: Final = PictureSuite(
    card=SuiteCard(
        name="oblique",
        version=1,
        title="Oblique pictures (P2)",
        what="The camera's mount tilts by 15, 30 or 50 deg ahead (P2 tilt), or the camera is fixed to a body that "
        "rolls and pitches as measured in flight (P2 body).",
        separates="What bears relief, hidden ground and an error of attitude of 1 deg from what needs to look down.",
        falsifier="Another picture without tilt: scores as in the control.",
        strength_unit="deg of tilt",
    ),
    variants=(
        Variant(role="control", kind="control"),
        *(Variant(role="stress", kind=TILT, strength=tilt_deg) for tilt_deg in TILTS_DEG),
        Variant(role="stress", kind=BODY, strength=BODY_SIGMA_DEG),
        Variant(role="falsifier", kind="no tilt"),
    ),
    flight=_flight,
)
