# SPDX-License-Identifier: Apache-2.0
"""Suite `season-image`: the same place in other seasons."""

from dataclasses import replace
from typing import Final

from sasgeo_bench.sensing.rendering.seasons import Season
from sasgeo_bench.tasks.suites.base import SuiteCard, Variant
from sasgeo_bench.tasks.suites.pictures import Flight, PictureSuite

SEASONS: Final[tuple[Season, ...]] = ("spring", "autumn", "winter", "snow")


def _flight(variant: Variant) -> Flight:
    season: Season = next((name for name in SEASONS if variant.kind.endswith(name)), "summer")
    return Flight(conditions=lambda ordinary: replace(ordinary, season=season))


SUITE: Final = PictureSuite(
    card=SuiteCard(
        name="season-image",
        version=1,
        title="Seasons in pictures (P5)",
        what="The same place in spring, autumn, winter without leaves, and under snow; the map is that of summer.",
        separates="Segmenters by the seasons in which they still see; the query does not say the season.",
        falsifier="Another picture in summer: scores as in the control.",
        strength_unit="share of the season",
    ),
    variants=(
        Variant(role="control", kind="control"),
        *(Variant(role="stress", kind=f"P5 {season}", strength=1.0) for season in SEASONS),
        Variant(role="falsifier", kind="summer again"),
    ),
    flight=_flight,
)
