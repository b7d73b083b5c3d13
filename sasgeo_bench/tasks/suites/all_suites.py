# SPDX-License-Identifier: Apache-2.0
"""All suites by name; a new suite is a file of its own and a line here."""

import difflib
from typing import Final

from sasgeo_bench.errors import ConfigError
from sasgeo_bench.tasks.suites import (
    absent,
    accumulated,
    aerial,
    alias,
    board_controls,
    clean,
    false_unknown,
    flight_alias,
    flight_clean,
    flight_gap,
    flight_image,
    flight_kidnap,
    flight_off_map,
    flight_overconfident,
    flight_real_age,
    flight_start,
    grade_separation,
    growth,
    instance_twins,
    light,
    local_warp,
    no_priors,
    oblique,
    occlusion,
    real_age,
    real_image,
    relief,
    season,
    season_image,
    stable_not_distinctive,
    synthetic_age,
    telemetry,
    topology_twins,
    volatile_lure,
)
from sasgeo_bench.tasks.suites.base import Suite
from sasgeo_bench.tasks.suites.flights import FlightSuite

SUITES: Final[dict[str, Suite]] = {
    suite.card.name: suite
    for suite in (
        clean.SUITE,
        occlusion.SUITE,
        false_unknown.SUITE,
        local_warp.SUITE,
        topology_twins.SUITE,
        instance_twins.SUITE,
        grade_separation.SUITE,
        no_priors.SUITE,
        real_age.SUITE,
        synthetic_age.SUITE,
        volatile_lure.SUITE,
        growth.SUITE,
        season.SUITE,
        stable_not_distinctive.SUITE,
        alias.SUITE,
        absent.SUITE,
        telemetry.SUITE,
    )
}
# Queries of these are pictures, of which a segmenter makes evidence; they are drawn where they are named.
PICTURE_SUITES: Final[dict[str, Suite]] = {
    suite.card.name: suite
    for suite in (
        aerial.SUITE,
        oblique.SUITE,
        relief.SUITE,
        light.SUITE,
        season_image.SUITE,
        accumulated.SUITE,
        real_image.SUITE,
    )
}
# Queries of these are the views of a flight in order; they are drawn where they are named.
FLIGHT_SUITES: Final[dict[str, FlightSuite]] = {
    suite.card.name: suite
    for suite in (
        flight_clean.SUITE,
        flight_real_age.SUITE,
        flight_start.SUITE,
        flight_gap.SUITE,
        flight_kidnap.SUITE,
        flight_overconfident.SUITE,
        flight_alias.SUITE,
        flight_off_map.SUITE,
        flight_image.SUITE,
    )
}
# With the controls, which every board draws in addition to its experiment.
EVERY_SUITE: Final[dict[str, Suite]] = {
    **SUITES,
    **PICTURE_SUITES,
    **FLIGHT_SUITES,
    board_controls.SUITE.card.name: board_controls.SUITE,
}
# Suites of pictures, flights among them.
PICTURED: Final = frozenset(name for name, suite in EVERY_SUITE.items() if suite.is_pictured)


def find_suite(name: str) -> Suite:
    """Return the suite of a name; raise a ConfigError that suggests the nearest name if there is none."""
    if name not in EVERY_SUITE:
        near = difflib.get_close_matches(name, EVERY_SUITE, n=1, cutoff=0.5)
        hint = f", did you mean {near[0]!r}?" if near else ""
        raise ConfigError(f"there is no suite {name!r}{hint} (list-suites shows all)")
    return EVERY_SUITE[name]
