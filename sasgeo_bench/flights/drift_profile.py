# SPDX-License-Identifier: Apache-2.0
"""Drift of one kind of odometer as numbers in a TOML file, with where they come from and where they end."""

import json
from collections.abc import Mapping
from importlib import resources
from pathlib import Path
from typing import Annotated, Final

from pydantic import Field

from sasgeo_bench.core.config import Document, Line, Prose, parse_toml
from sasgeo_bench.core.errors import ConfigError
from sasgeo_bench.core.folders import fresh_file
from sasgeo_bench.core.paths import plain_file
from sasgeo_bench.core.texts import NAME

_FOLDER: Final = "profiles"
_MOST_BYTES: Final = 100_000
_DIGITS: Final = 4

Share = Annotated[float, Field(ge=0, le=50)]  # percent; beyond, an odometer measures nothing
Length = Annotated[float, Field(ge=0.1, le=1e6)]  # metres
Rate = Annotated[float, Field(ge=0, le=100)]  # events per kilometre
Degrees = Annotated[float, Field(ge=0, le=180)]


class ScaleDrift(Document):
    """Errors of length, standard deviations in percent: one for a run, and one that wanders over `length_m`."""

    bias_pct: Share = 0.0
    wander_pct: Share = 0.0
    length_m: Length = 500.0


class SlipDrift(Document):
    """Errors of velocity along and across, each of standard deviation `sigma_pct`, correlated over `length_m`."""

    sigma_pct: Share = 0.0
    length_m: Length = 5.0


class HeadingDrift(Document):
    """Errors of heading: a random walk, and a constant rate of each run; standard deviations after 100 m.

    With `length_m` the walk saturates: it becomes a Gauss-Markov process of that correlation length, which begins as
    the same walk. Loop closing and a compass do so.
    """

    walk_deg_at_100m: Degrees = 0.0
    rate_deg_at_100m: Degrees = 0.0
    length_m: Length | None = None


class Resets(Document):
    """Sudden jumps, as of a tracker that begins anew: how often, and their standard deviations.

    `position_m` is of each axis. `scale_pct` is the standard deviation of the scale from there on, in place of the
    run's own.
    """

    per_km: Rate = 0.0
    position_m: Annotated[float, Field(ge=0, le=1e4)] = 0.0
    yaw_deg: Degrees = 0.0
    scale_pct: Share = 0.0


class Dropouts(Document):
    """Stretches without odometry: how often, and their mean length (exponential)."""

    per_km: Rate = 0.0
    length_m: Length = 50.0


class DriftProfile(Document):
    """Drift of one kind of odometer over distance, by `sasgeo_bench.flights.odometry.draw_odometry`.

    `run_spread` is the standard deviation of the logarithm of a factor that each run has on all its drift; the mean
    square of the factor is 1, so standard deviations are those of all runs together. `source` says what was measured,
    `limits` where the profile must not be believed.

    Examples
    --------
    >>> profile = load_profile("wheel-poor")
    >>> profile.scale.bias_pct, profile.resets.per_km
    (2.0, 0.0)
    """

    id: Annotated[str, Field(pattern=NAME)]
    title: Line
    source: Prose
    limits: Prose
    run_spread: Annotated[float, Field(ge=0, le=2)] = 0.0
    scale: ScaleDrift = ScaleDrift()
    slip: SlipDrift = SlipDrift()
    heading: HeadingDrift = HeadingDrift()
    resets: Resets = Resets()
    dropouts: Dropouts = Dropouts()


def list_profiles() -> list[str]:
    """Return the ids of the profiles that come with the package, sorted.

    >>> list_profiles()
    ['perfect', 'vio-mono', 'vio-stereo', 'vo-mono-survey', 'wheel-poor']
    """
    files = resources.files("sasgeo_bench.flights").joinpath(_FOLDER).iterdir()
    return sorted(file.name.removesuffix(".toml") for file in files if file.name.endswith(".toml"))


def load_profile(name: str) -> DriftProfile:
    """Return a profile that comes with the package; raise `ConfigError`, naming all, if there is none of this id."""
    if name not in list_profiles():
        raise ConfigError(f"there is no drift profile {name!r}: choose of {', '.join(list_profiles())}")
    file = resources.files("sasgeo_bench.flights").joinpath(_FOLDER, f"{name}.toml")
    return parse_toml(file.read_text(encoding="utf-8"), DriftProfile, source=f"{name}.toml")


def read_drift_profile(path: Path) -> DriftProfile:
    """Read a profile of one's own; raise `ConfigError`, in one line, if the file is missing or wrong."""
    mend = "name a .toml file that measure-drift --profile has written"
    try:
        with plain_file(path).open("rb") as source:
            content = source.read(_MOST_BYTES + 1)
        if len(content) > _MOST_BYTES:
            raise ConfigError(f"{path} is no drift profile, it has more than {_MOST_BYTES} bytes: {mend}")
        text = content.decode("utf-8-sig")
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigError(
            f"{path} cannot be read as a drift profile ({getattr(error, 'strerror', None) or error}): {mend}"
        ) from error
    return parse_toml(text, DriftProfile, source=str(path))


def write_drift_profile(profile: DriftProfile, path: Path) -> None:
    """Write a profile as TOML, numbers to four digits; raise `StoreError` if it cannot be written."""
    content = profile.model_dump(exclude_none=True)
    tables = {key: value for key, value in content.items() if isinstance(value, dict)}
    lines = _lines({key: value for key, value in content.items() if key not in tables})
    for name, values in tables.items():
        lines += ["", f"[{name}]", *_lines(values)]
    with fresh_file(path, mend="name another place, or free some space") as scratch:
        scratch.write_text("# SPDX-License-Identifier: Apache-2.0\n" + "\n".join(lines) + "\n", encoding="utf-8")


def _lines(values: Mapping[str, object]) -> list[str]:
    """Return keys and values as TOML; JSON's texts and numbers are TOML's."""
    return [
        f"{key} = {json.dumps(float(f'{value:.{_DIGITS}g}') if isinstance(value, float) else value)}"
        for key, value in values.items()
    ]
