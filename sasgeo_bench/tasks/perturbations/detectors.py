# SPDX-License-Identifier: Apache-2.0
"""The detectors by their names: families of errors that share neither numbers nor structure."""

from collections.abc import Callable, Mapping
from typing import Final

from sasgeo_bench.errors import ConfigError
from sasgeo_bench.tasks.perturbations.base import Perturbation
from sasgeo_bench.tasks.perturbations.measured import MeasuredPerception
from sasgeo_bench.tasks.perturbations.perception import Perception
from sasgeo_bench.tasks.perturbations.perception_profile import PerceptionProfile
from sasgeo_bench.tasks.query import PROFILE, Detector

NO_PROFILE: Final = "detector 'profile' needs a perception profile: name its file with make-queries --profile FILE"


def _published(error_factor: float) -> Perturbation:
    return Perception(error_factor=error_factor)


def _measured(error_factor: float) -> Perturbation:
    return MeasuredPerception(error_factor=error_factor)


DETECTORS: Final[Mapping[Detector, Callable[[float], Perturbation]]] = {"published": _published, "measured": _measured}


def perception_of(
    detector: Detector, *, error_factor: float = 1.0, profile: PerceptionProfile | None = None
) -> Perturbation:
    """Return the errors of a detector, or of a segmenter's profile for the detector "profile".

    Raise `ConfigError` if that detector has no profile.

    >>> perception_of("measured", error_factor=2.0)
    MeasuredPerception(error_factor=2.0)
    """
    if detector != PROFILE:
        return DETECTORS[detector](error_factor)
    if profile is None:
        raise ConfigError(NO_PROFILE)
    return MeasuredPerception(error_factor=error_factor, errors=profile.errors())
