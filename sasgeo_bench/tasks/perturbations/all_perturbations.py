# SPDX-License-Identifier: Apache-2.0
"""All perturbations by name: ours, each at a usual strength, and those of installed packages."""

import inspect
from collections.abc import Callable, Mapping
from dataclasses import dataclass, fields, is_dataclass, replace
from functools import partial
from typing import Any, Final

from sasgeo_bench.core.errors import MatchError
from sasgeo_bench.core.plugins import PERTURBATIONS as GROUP
from sasgeo_bench.core.plugins import find_inside
from sasgeo_bench.tasks.perturbations.ageing import Ageing, rates_by_hand
from sasgeo_bench.tasks.perturbations.base import Perturbation
from sasgeo_bench.tasks.perturbations.local_warp import LocalWarp, RowJitter, Tilt
from sasgeo_bench.tasks.perturbations.measured import MeasuredPerception
from sasgeo_bench.tasks.perturbations.occlusion import (
    AdversarialMask,
    Border,
    CanopyAndShadow,
    CentralCrop,
    FalseUnknown,
    Glare,
    Rectangles,
    TiltWedge,
)
from sasgeo_bench.tasks.perturbations.perception import Perception
from sasgeo_bench.tasks.perturbations.season import Season

SHIPPED: Final[Mapping[str, Perturbation]] = {
    "perception": Perception(error_factor=1.0),
    "measured-perception": MeasuredPerception(error_factor=1.0),
    "rectangles": Rectangles(share=0.3),
    "border": Border(share=0.3),
    "tilt-wedge": TiltWedge(share=0.3),
    "glare": Glare(share=0.2),
    "canopy-and-shadow": CanopyAndShadow(share=0.6),
    "adversarial-mask": AdversarialMask(share=0.3),
    "false-unknown": FalseUnknown(share=0.2),
    "local-warp": LocalWarp(rms_m=10.0),
    "row-jitter": RowJitter(rms_m=10.0),
    "tilt": Tilt(rms_m=10.0),
    "central-crop": CentralCrop(share=0.3),
    "season-leaf-on": Season(kind="leaf_on", strength=0.6),
    "season-snow": Season(kind="snow", strength=0.6),
    "season-low-water": Season(kind="low_water", strength=0.6),
    "season-harvest": Season(kind="harvest", strength=0.6),
    "ageing": Ageing(years=10.0, rates=rates_by_hand(), place="here"),
}
_USUAL: Final = 0.3  # strength at which a class or a function of a strength is tried


@dataclass(frozen=True, slots=True, kw_only=True)
class Ladder:
    """A perturbation at any strength, and the one that it is tried at."""

    at: Callable[[Any], Perturbation]
    strength: float
    knob: str  # the name of the strength


def find_perturbation(spec: str) -> object:
    """Return what a name, or "module:NAME", stands for: a perturbation at a usual strength, or what makes one of it.

    Raise `MatchError` if there is none, with the nearest name, it cannot be imported, or is no perturbation.

    >>> find_perturbation("border")
    Border(share=0.3)
    >>> find_perturbation("boarder")
    Traceback (most recent call last):
        ...
    sasgeo_bench.core.errors.MatchError: there is no perturbation 'boarder', did you mean 'border'? (list
    perturbations shows all; or module:NAME)
    """
    found = SHIPPED[spec] if spec in SHIPPED else find_inside(spec, GROUP, shipped=SHIPPED)
    ladder_of(found, spec)
    return found


def ladder_of(found: object, spec: str) -> Ladder:
    """Return a perturbation at any strength, from an instance, a class, or a function of a strength.

    The strength of an instance is the first of its fields that is a number; a class or function takes it as the one
    word that it cannot do without, or else its first. Raise `MatchError` for anything else.
    """
    if is_dataclass(found) and not isinstance(found, type) and callable(found):
        numbers = {one.name: getattr(found, one.name) for one in fields(found)}
        knob = next((name for name, value in numbers.items() if type(value) in (int, float)), None)
        if knob is None:
            raise MatchError(f"{spec}: none of its fields is a number, so that it has no strength")
        strength = float(numbers[knob])
        if strength == 0:
            raise MatchError(f"{spec}: its {knob} is 0, at which it changes nothing: name it at a usual strength")
        return Ladder(at=lambda value: replace(found, **{knob: value}), strength=strength, knob=knob)
    try:
        words = list(inspect.signature(found).parameters.values()) if callable(found) else []
    except (TypeError, ValueError):
        words = []
    needed = [
        one for one in words if one.default is one.empty and one.kind not in (one.VAR_POSITIONAL, one.VAR_KEYWORD)
    ]
    if not callable(found) or not words or len(needed) > 1:
        taken = ", ".join(one.name for one in needed) or "nothing"
        raise MatchError(
            f"{spec}: an object of type {type(found).__name__} that takes {taken} is no perturbation: name a frozen "
            "dataclass of one strength, an instance of one, or a function of a strength that makes one"
        )
    word = (needed or words)[0]
    at = found if word.kind is not word.KEYWORD_ONLY else partial(_by_word, found, word.name)
    return Ladder(at=at, strength=_USUAL, knob=word.name)


def _by_word(make: Callable[..., Perturbation], word: str, value: object) -> Perturbation:
    return make(**{word: value})
