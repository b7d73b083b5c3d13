# SPDX-License-Identifier: Apache-2.0
"""Seasons: what they do to grass, crops and crowns."""

import datetime as dt
from dataclasses import dataclass
from typing import Final, Literal, get_args

Season = Literal["spring", "summer", "autumn", "winter", "snow"]
Colour = tuple[float, float, float]

SEASONS: Final[tuple[Season, ...]] = get_args(Season)


@dataclass(frozen=True, slots=True, kw_only=True)
class Growth:
    """State of what grows: `bare_share` of the broad-leaved crowns has no leaves.

    A colour and a share say how far grass, crowns and crops are drawn towards that colour; `ploughed_share` of the
    fields is bare soil; `snow` is the share of the open ground that is white.
    """

    grass: Colour
    grass_share: float
    crown: Colour
    crown_share: float
    bare_share: float
    ploughed_share: float
    ripe_share: float
    snow: float = 0.0


GROWTH: Final[dict[Season, Growth]] = {
    "spring": Growth(
        grass=(118, 150, 62),
        grass_share=0.45,
        crown=(132, 158, 74),
        crown_share=0.4,
        bare_share=0.15,
        ploughed_share=0.4,
        ripe_share=0.05,
    ),
    "summer": Growth(
        grass=(128, 138, 78),
        grass_share=0.1,
        crown=(84, 112, 56),
        crown_share=0.0,
        bare_share=0.0,
        ploughed_share=0.12,
        ripe_share=0.45,
    ),
    "autumn": Growth(
        grass=(136, 130, 80),
        grass_share=0.45,
        crown=(172, 124, 52),
        crown_share=0.6,
        bare_share=0.2,
        ploughed_share=0.55,
        ripe_share=0.25,
    ),
    "winter": Growth(
        grass=(134, 126, 92),
        grass_share=0.65,
        crown=(112, 100, 80),
        crown_share=0.3,
        bare_share=1.0,
        ploughed_share=0.6,
        ripe_share=0.0,
    ),
    "snow": Growth(
        grass=(134, 126, 92),
        grass_share=0.7,
        crown=(104, 98, 84),
        crown_share=0.3,
        bare_share=1.0,
        ploughed_share=0.6,
        ripe_share=0.0,
        snow=0.96,
    ),
}


def season_of(day: dt.date, latitude_deg: float) -> Season:
    """Return the season of a day by its month, half a year later south of the equator; never "snow".

    >>> season_of(dt.date(2024, 7, 1), 47.0), season_of(dt.date(2024, 7, 1), -33.0)
    ('summer', 'winter')
    """
    month = day.month if latitude_deg >= 0 else (day.month + 5) % 12 + 1
    order: tuple[Season, ...] = ("winter", "spring", "summer", "autumn")
    return order[month % 12 // 3]
