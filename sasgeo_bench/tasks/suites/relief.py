# SPDX-License-Identifier: Apache-2.0
"""Suite `relief`: tall buildings lean away from the middle of the picture."""

from typing import Final

from sasgeo_bench.tasks.suites.base import SuiteCard, Variant
from sasgeo_bench.tasks.suites.pictures import Flight, PictureSuite

RELIEFS: Final = (1.0, 2.0, 4.0)


def _flight(variant: Variant) -> Flight:
    return Flight(relief=variant.strength)


SUITE: Final = PictureSuite(
    card=SuiteCard(
        name="relief",
        version=1,
        title="Relief (P3)",
        what="Buildings as high as they are, twice and four times as high, from 160 m: roofs lean away from the middle "
        "and hide ground.",
        separates="Matchers that bear roofs beside their footprints.",
        falsifier="Buildings flattened again: scores as in the control, where they are flat, too.",
        strength_unit="times the height of buildings",
    ),
    variants=(
        Variant(role="control", kind="flat"),
        *(Variant(role="stress", kind="P3 relief", strength=relief) for relief in RELIEFS),
        Variant(role="falsifier", kind="flattened"),
    ),
    flight=_flight,
)
