# SPDX-License-Identifier: Apache-2.0
"""All suites by name: ours by family, a line here for each, and those of installed packages."""

from functools import lru_cache
from typing import Final

from sasgeo_bench.core.errors import ConfigError, MatchError
from sasgeo_bench.core.plugins import SUITES as GROUP
from sasgeo_bench.core.plugins import check_own_name, find_inside, list_entry_points, made, plugin_code
from sasgeo_bench.tasks.query import BY
from sasgeo_bench.tasks.suites import (
    ages,
    board_controls,
    corrupted,
    flights,
    natural,
    pictures,
    real_image,
    twins,
    views,
)
from sasgeo_bench.tasks.suites.base import Suite
from sasgeo_bench.tasks.suites.flights import FlightSuite

SUITES: Final[dict[str, Suite]] = {
    suite.card.name: suite
    for suite in (
        views.CLEAN,
        views.OCCLUSION,
        views.FALSE_UNKNOWN,
        views.LOCAL_WARP,
        twins.TOPOLOGY_TWINS,
        twins.INSTANCE_TWINS,
        twins.GRADE_SEPARATION,
        views.NO_PRIORS,
        ages.REAL_AGE,
        ages.SYNTHETIC_AGE,
        ages.VOLATILE_LURE,
        ages.GROWTH,
        views.SEASON,
        twins.STABLE_NOT_DISTINCTIVE,
        twins.ALIAS,
        views.ABSENT,
        natural.NATURAL_TWINS,
        natural.NATURAL_ABSENT,
        views.TELEMETRY,
    )
}
# Queries of these are pictures, of which a segmenter makes evidence; they are drawn where they are named.
PICTURE_SUITES: Final[dict[str, Suite]] = {
    suite.card.name: suite
    for suite in (
        pictures.AERIAL,
        pictures.OBLIQUE,
        pictures.RELIEF,
        pictures.LIGHT,
        pictures.SEASON_IMAGE,
        pictures.ACCUMULATED,
        corrupted.CORRUPTED,
        pictures.OVERLAP_SCALE_TILT,
        real_image.REAL_IMAGE,
        corrupted.CORRUPTED_REAL,
    )
}
# Queries of these are the views of a flight in order; they are drawn where they are named.
FLIGHT_SUITES: Final[dict[str, FlightSuite]] = {
    suite.card.name: suite
    for suite in (
        flights.FLIGHT_CLEAN,
        flights.FLIGHT_REAL_AGE,
        flights.FLIGHT_START,
        flights.FLIGHT_GAP,
        flights.FLIGHT_KIDNAP,
        flights.FLIGHT_OVERCONFIDENT,
        flights.FLIGHT_ALIAS,
        flights.FLIGHT_OFF_MAP,
        flights.FLIGHT_IMAGE,
        real_image.FLIGHT_REAL_IMAGE,
    )
}
# With the controls, which every board draws in addition to its experiment.
EVERY_SUITE: Final[dict[str, Suite]] = {
    **SUITES,
    **PICTURE_SUITES,
    **FLIGHT_SUITES,
    board_controls.SUITE.card.name: board_controls.SUITE,
}


def list_suites() -> tuple[str, ...]:
    """Return the names of all suites: ours in the order of their families, then those of installed packages."""
    return (*EVERY_SUITE, *(name for name in list_entry_points(GROUP) if name not in EVERY_SUITE))


def is_foreign(spec: str) -> bool:
    """Return whether a suite is of another package: what it draws depends on code that is not ours."""
    return spec not in EVERY_SUITE


def find_suite(spec: str) -> Suite:
    """Return the suite of a name, or of "module:NAME": an instance of `Suite`, or what makes one.

    Raise `ConfigError` if there is none, with the nearest name, or it cannot be imported, is no suite, or has the name
    of another one.

    >>> find_suite("clean").card.title
    'Rotation, scale and crop'
    >>> find_suite("cleen")
    Traceback (most recent call last):
        ...
    sasgeo_bench.core.errors.ConfigError: there is no suite 'cleen', did you mean 'clean'? (list suites shows all; or
    module:NAME)
    """
    return _foreign(spec) if is_foreign(spec) else EVERY_SUITE[spec]


def known_suite(name: str) -> Suite | None:
    """Return the suite of a name, whichever segmenter made its evidence; None for one that is not here.

    Queries of other datasets and of programs elsewhere have suites, too.

    >>> known_suite("aerial+pixel_forest") is find_suite("aerial"), known_suite("swa-pf")
    (True, None)
    """
    name = name.partition(BY)[0]
    try:
        return find_suite(name) if name in list_suites() else None
    except ConfigError:  # a package that cannot be imported
        return None


def is_pictured(name: str) -> bool:
    """Return whether queries of a suite of this name hold pictures; False for one that is not here."""
    suite = known_suite(name)
    return suite is not None and suite.is_pictured


def suite_code(spec: str) -> str | None:
    """Return the SHA-256 of the code of a suite of another package; None for ours, which the program's version names.

    Raise `ConfigError` if its code cannot be found.
    """
    try:
        return plugin_code(spec, GROUP) if is_foreign(spec) else None
    except MatchError as error:
        raise ConfigError(str(error)) from error


@lru_cache(maxsize=64)
def _foreign(spec: str) -> Suite:
    try:
        found = find_inside(spec, GROUP, shipped=EVERY_SUITE)
        suite = found if isinstance(found, Suite) else made(spec, found)
        if isinstance(suite, Suite):
            check_own_name(spec, suite.card.name, GROUP, shipped=EVERY_SUITE, where="its card")
            return suite
    except MatchError as error:
        raise ConfigError(str(error)) from error
    raise ConfigError(f"{spec}: a {type(suite).__name__} is no suite: name an instance of sasgeo_bench.Suite")
