# SPDX-License-Identifier: Apache-2.0
"""The confusions of one segmenter, measured on labelled images, and what it withholds when it is silent where unsure.

`sasgeo_bench.scoring.perception_profile` makes it. A view with the errors of a profile has the rates of a segmenter;
how its errors lie together is that of the detector "measured". A scorer never reads a profile: it estimates its own
rates from train blocks.
"""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, ClassVar, Final, Self

from pydantic import Field, field_validator, model_validator

from sasgeo_bench.core.config import Document, Line, Short, parse_toml
from sasgeo_bench.core.errors import ConfigError, StoreError
from sasgeo_bench.core.folders import fresh_file
from sasgeo_bench.core.paths import plain_file
from sasgeo_bench.osm.taxonomy import MeasuredErrors, load_taxonomy
from sasgeo_bench.tasks.perturbations.measured import MEASURED, MeasuredPerception, Share, Silence

VERSION: Final = 1
_MEND: Final = "name a .toml file that perception_profile.write_profile has written"
_DIGITS: Final = 5
_MOST_BYTES: Final = 1_000_000
_PLAIN: Final = MeasuredErrors(recall=1.0, precision=1.0)
_MUTE: Final = Silence(found=1.0, missed=1.0, alarm=1.0, absent=1.0)


class ClassConfusions(Document):
    """Rates of one class, of pixels with a prediction.

    `recall` and `precision` as usual; `of_ground` is the fraction of the ground without any labelled class that is seen
    as this one; `called` are fractions of this class that are seen as others instead, `also` those that are seen as
    others besides. `pixels` counts those of the class. `silent` are the shares of these answers that are withheld.
    """

    without_empty: ClassVar[frozenset[str]] = frozenset({"silent"})
    pixels: Annotated[int, Field(gt=0)]
    recall: Share
    precision: Share
    of_ground: Share
    called: dict[str, Share] = {}
    also: dict[str, Share] = {}
    silent: Silence | None = None

    @model_validator(mode="after")
    def _is_whole(self) -> Self:
        if self.recall + sum(self.called.values()) > 1 + 10 ** (1 - _DIGITS):
            raise ValueError("recall and called add up to more than 1")
        return self


class PerceptionProfile(Document):
    """Confusions of a segmenter by class, and where they come from.

    `silence` is the share of all its answers that is withheld, the least sure ones; 0 without any.
    """

    without_empty: ClassVar[frozenset[str]] = frozenset({"silence"})
    version: int = VERSION
    segmenter: Short
    learned_from: Line
    tested_on: Line
    images: Annotated[int, Field(gt=0)]
    silence: Share = 0.0
    classes: dict[str, ClassConfusions] = Field(alias="class")

    @field_validator("version")
    @classmethod
    def _is_current(cls, version: int) -> int:
        if version != VERSION:
            raise ValueError(f"measure the profile anew: this program reads version {VERSION}")
        return version

    @model_validator(mode="after")
    def _is_silent_of_all(self) -> Self:
        if any((found.silent is None) == bool(self.silence) for found in self.classes.values()):
            raise ValueError("silence needs the shares 'silent' of each class, and they need it")
        return self

    def perception(self, error_factor: float = 1.0) -> MeasuredPerception:
        """Return what draws views with these errors, and this silence.

        Sizes and widths, and how errors lie together, are those of the detector "measured". A class that the profile
        does not have is seen without errors; a segmenter with silence says nothing of it.
        """
        said = {name: found.silent for name, found in self.classes.items() if found.silent is not None}
        return MeasuredPerception(
            error_factor=error_factor,
            errors={name: _errors(name, found) for name, found in self.classes.items()},
            silence=dict.fromkeys(load_taxonomy().names, _MUTE) | said if said else {},
        )


def _errors(name: str, found: ClassConfusions) -> MeasuredErrors:
    recall = min(found.recall, 1 - sum(found.called.values()))
    return MEASURED.get(name, _PLAIN).model_copy(
        update={
            "recall": recall,
            "precision": found.precision,
            "called": dict(found.called) if recall < 1 else {},
            "also": dict(found.also),
            "of_yards": None,
            "of_ground": found.of_ground,
            "alarms_on": "ground",
            "is_ground": False,
        }
    )


def read_profile(path: Path) -> PerceptionProfile:
    """Read a profile; raise `ConfigError`, in one line, if it is missing or wrong."""
    try:
        if path.exists() and not (path.is_file() and path.stat().st_size <= _MOST_BYTES):
            raise ConfigError(f"{path} is no perception profile: expected a file of at most {_MOST_BYTES} bytes")
        text = plain_file(path).read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigError(f"{path} cannot be read as a perception profile ({error}): {_MEND}") from error
    profile = parse_toml(text, PerceptionProfile, source=str(path))
    known = set(load_taxonomy().names)
    named = {name for at, found in profile.classes.items() for name in (at, *found.called, *found.also)}
    if strange := sorted(named - known):
        raise ConfigError(
            f"{path} has rates of {', '.join(strange)}, which is no class: choose of {', '.join(sorted(known))}"
        )
    return profile


def write_profile(profile: PerceptionProfile, path: Path) -> None:
    """Write a profile as TOML; raise `StoreError` if the file cannot be written."""
    head = profile.model_dump(exclude={"classes"})
    lines = ["# Confusions of a segmenter, measured on labelled images; not to be edited.", *_lines(head)]
    for name, found in profile.classes.items():
        lines += ["", f"[class.{name}]", *_lines(found.model_dump())]
    try:
        with fresh_file(path, mend="free some space and measure again") as scratch:
            scratch.write_text("\n".join(lines) + "\n", encoding="utf-8")
    except OSError as error:
        raise StoreError(f"{path} cannot be written ({error.strerror or error}): name another place") from error


def _lines(values: Mapping[str, object]) -> list[str]:
    """Return keys and values as TOML; JSON's texts and numbers are TOML's."""
    return [f"{key} = {_value(value)}" for key, value in values.items()]


def _value(value: object) -> str:
    if isinstance(value, Mapping):
        return f"{{ {', '.join(_lines(value))} }}" if value else "{}"
    return json.dumps(round(value, _DIGITS) if isinstance(value, float) else value)
