# SPDX-License-Identifier: Apache-2.0
"""Read the private seed that a command is given, and the seed of sealed places."""

from pathlib import Path
from typing import Annotated

import typer

from sasgeo_bench.core.errors import ConfigError
from sasgeo_bench.core.progress import tell
from sasgeo_bench.tasks.private_seed import (
    LEAST_BITS,
    REPRODUCING_BITS,
    SEALED_VARIABLE,
    VARIABLE,
    PrivateSeed,
    take_seed,
)
from sasgeo_bench.tasks.task_plan import PRIVATE_ROOT

SeedFile = Annotated[
    Path | None,
    typer.Option(
        help=f"file NAME.seed with a private seed, readable by you alone (or the seed in {VARIABLE}): draw by it, into "
        "OUT/private"
    ),
]
SealedSeedFile = Annotated[
    Path | None,
    typer.Option(
        help=f"file NAME.seed with a seed, readable by you alone (or the seed in {SEALED_VARIABLE}): open the sealed "
        "places of the split, and draw them by it"
    ),
]


def private_seed(file: Path | None, *, public: int | None = None) -> PrivateSeed | None:
    """Take the private seed of a file or of the environment, and say what is to be known of it; None without one."""
    seed = take_seed(file)
    if seed is None:
        return None
    if public is not None:
        raise ConfigError("--seed is public and a private seed is given too: leave one of them out")
    tell(f"drawing by a private seed of {seed.bits} bits, commitment {seed.commitment[:12]}, into OUT/{PRIVATE_ROOT}")
    _warn_of_bits(seed)
    if LEAST_BITS <= seed.bits < REPRODUCING_BITS:
        tell(f"warning: a board of this seed makes no row reproduced: that takes {REPRODUCING_BITS} bits")
    return seed


def sealed_seed(file: Path | None) -> PrivateSeed | None:
    """Take the seed of sealed places of a file or of the environment; None without one."""
    seed = take_seed(file, is_sealed=True)
    if seed is not None:
        tell(f"sealed places are drawn by a seed of {seed.bits} bits, commitment {seed.commitment[:12]}")
        _warn_of_bits(seed)
    return seed


def _warn_of_bits(seed: PrivateSeed) -> None:
    if seed.bits < LEAST_BITS:
        tell(f"warning: {seed.bits} bits are no secret: anyone who sees a query can find the seed; use 32 hex digits")
