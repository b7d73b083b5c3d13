# SPDX-License-Identifier: Apache-2.0
"""Suite `light`: the sun sinks, the air thickens, night falls."""

from dataclasses import replace
from typing import Final

from sasgeo_bench.sensing.rendering.conditions import Conditions, Sun
from sasgeo_bench.tasks.suites.base import SuiteCard, Variant
from sasgeo_bench.tasks.suites.pictures import Flight, PictureSuite

STRENGTHS: Final = (0.3, 0.6, 1.0)
SUN, HAZE, DUSK = "P4 sun", "P4 haze", "P4 dusk"
_CLEAR: Final = Conditions(sun=Sun(elevation_deg=50.0, azimuth_deg=160.0))
_LOWEST_DEG, _DARKEST_DEG, _THICKEST_M, _THINNEST_M = 5.0, -8.0, 500.0, 30_000.0


def _flight(variant: Variant) -> Flight:
    return Flight(conditions=lambda ordinary: _lit(ordinary, variant))


def _lit(ordinary: Conditions, variant: Variant) -> Conditions:
    """Return clear weather with a high sun, or what a kind makes of it; the rest as on the site."""
    high, share = _CLEAR.sun.elevation_deg, variant.strength
    lowest = {SUN: _LOWEST_DEG, DUSK: _DARKEST_DEG}.get(variant.kind, high)
    sun = replace(_CLEAR.sun, elevation_deg=high + share * (lowest - high))
    if variant.kind == DUSK:  # all of the ladder is around sunset
        sun = replace(_CLEAR.sun, elevation_deg=_LOWEST_DEG + share * (_DARKEST_DEG - _LOWEST_DEG))
    thick_m = _THICKEST_M if variant.kind == HAZE else _THINNEST_M
    visibility_m = _THINNEST_M * (thick_m / _THINNEST_M) ** share
    return replace(ordinary, sun=sun, cloud=0.0, visibility_m=visibility_m)


SUITE: Final = PictureSuite(
    card=SuiteCard(
        name="light",
        version=1,
        title="Light and air (P4)",
        what="A low sun with long shadows (P4 sun), haze (P4 haze), and dusk to night (P4 dusk).",
        separates="Segmenters by the light in which they still see.",
        falsifier="Another picture in the control's light: scores as in the control.",
        strength_unit="share of the way to the worst",
    ),
    variants=(
        Variant(role="control", kind="control"),
        *(Variant(role="stress", kind=kind, strength=share) for kind in (SUN, HAZE, DUSK) for share in STRENGTHS),
        Variant(role="falsifier", kind="same light"),
    ),
    flight=_flight,
)
