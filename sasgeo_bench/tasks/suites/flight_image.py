# SPDX-License-Identifier: Apache-2.0
"""Suite `flight-image`: flights whose views are pictures, in other seasons than the map's."""

from dataclasses import dataclass, replace
from typing import Final

from sasgeo_bench.sensing.rendering.seasons import Season
from sasgeo_bench.tasks.suites.base import SuiteCard, Variant
from sasgeo_bench.tasks.suites.flights import SEQUENCE, START, FlightSuite
from sasgeo_bench.tasks.suites.pictures import Flight, PictureSuite

SEASONS: Final[tuple[Season, ...]] = ("autumn", "snow")  # of the stresses, in the order of their strength


@dataclass(frozen=True, kw_only=True)
class FlightImageSuite(PictureSuite, FlightSuite):
    """A flight whose views are pictures; weather and light are the same from its first view to its last."""


def _flight(variant: Variant) -> Flight:
    season: Season = next((name for name in SEASONS if variant.kind.endswith(name)), "summer")
    return Flight(conditions=lambda ordinary: replace(ordinary, season=season))


SUITE: Final = FlightImageSuite(
    card=SuiteCard(
        name="flight-image",
        version=1,
        title="Flights in pictures (F9)",
        what="A flight of 1 or 2 km whose views are pictures from straight above, one every 80 to 120 m, in autumn and "
        "under snow; the control's are of summer. A segmenter makes the evidence.",
        separates="Trackers that bear the errors of a segmenter, which last for as long as the season does.",
        falsifier="Other pictures in summer: scores as in the control.",
        strength_unit="season: 1 for autumn, 2 for snow",
        group=START,
        tracks=SEQUENCE,
        min_density=0.05,
    ),
    variants=(
        Variant(role="control", kind="summer"),
        *(
            Variant(role="stress", kind=f"F9 {season}", strength=float(order))
            for order, season in enumerate(SEASONS, start=1)
        ),
        Variant(role="falsifier", kind="summer again"),
    ),
    flight=_flight,
    every_m=(80.0, 120.0),  # flown between two pictures, on average: rendering takes most of the time
    longest_m=2000.0,
)
