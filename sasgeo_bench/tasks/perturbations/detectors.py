# SPDX-License-Identifier: Apache-2.0
"""The detectors by their names: families of errors that share neither numbers nor structure."""

from collections.abc import Callable, Mapping
from typing import Final

from sasgeo_bench.tasks.perturbations.base import Perturbation
from sasgeo_bench.tasks.perturbations.measured import MeasuredPerception
from sasgeo_bench.tasks.perturbations.perception import Perception
from sasgeo_bench.tasks.query import Detector


def _published(error_factor: float) -> Perturbation:
    return Perception(error_factor=error_factor)


def _measured(error_factor: float) -> Perturbation:
    return MeasuredPerception(error_factor=error_factor)


DETECTORS: Final[Mapping[Detector, Callable[[float], Perturbation]]] = {"published": _published, "measured": _measured}
