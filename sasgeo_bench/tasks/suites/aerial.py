# SPDX-License-Identifier: Apache-2.0
"""Suite `aerial`: pictures from straight above, from several heights."""

from typing import Final

from sasgeo_bench.tasks.suites.base import MAIN_VIEW_CELLS, SuiteCard, Variant
from sasgeo_bench.tasks.suites.pictures import HEIGHT_M, Flight, PictureSuite

HEIGHTS_M: Final = {80.0: 96, 160.0: MAIN_VIEW_CELLS, 320.0: 384, 500.0: 384}  # and the cells of their views


def _flight(variant: Variant) -> Flight:
    return Flight(height_m=variant.strength or HEIGHT_M)


SUITE: Final = PictureSuite(
    card=SuiteCard(
        name="aerial",
        version=1,
        title="Pictures from straight above (P1)",
        what="A stabilized camera looks straight down from 80, 160, 320 or 500 m; a segmenter makes the evidence.",
        separates="Segmenters, and matchers that bear their errors, by what a pixel still resolves.",
        falsifier="Another picture from the control's height: scores as in the control.",
        strength_unit="m above the ground",
    ),
    variants=(
        Variant(role="control", kind="control"),
        *(
            Variant(role="stress", kind="P1 height", strength=height_m, view_cells=cells)
            for height_m, cells in HEIGHTS_M.items()
            if height_m != HEIGHT_M
        ),
        Variant(role="falsifier", kind="same height"),
    ),
    flight=_flight,
)
