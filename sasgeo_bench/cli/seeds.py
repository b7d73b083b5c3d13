# SPDX-License-Identifier: Apache-2.0
"""Read the private seed that a command is given."""

from pathlib import Path
from typing import Annotated

import typer

from sasgeo_bench.errors import ConfigError
from sasgeo_bench.progress import Tell
from sasgeo_bench.tasks.private_seed import LEAST_BITS, REPRODUCING_BITS, VARIABLE, PrivateSeed, take_seed
from sasgeo_bench.tasks.task_plan import PRIVATE_ROOT

SeedFile = Annotated[
    Path | None,
    typer.Option(
        help=f"file NAME.seed with a private seed, readable by you alone (or the seed in {VARIABLE}): draw by it, into "
        "OUT/private"
    ),
]


def private_seed(file: Path | None, *, tell: Tell, public: int | None = None) -> PrivateSeed | None:
    """Take the private seed of a file or of the environment, and say what is to be known of it; None without one."""
    seed = take_seed(file)
    if seed is None:
        return None
    if public is not None:
        message = "--seed is public and a private seed is given too: leave one of them out"
        raise ConfigError(message)
    tell(f"drawing by a private seed of {seed.bits} bits, commitment {seed.commitment[:12]}, into OUT/{PRIVATE_ROOT}")
    if seed.bits < LEAST_BITS:
        tell(f"warning: {seed.bits} bits are no secret: anyone who sees a query can find the seed; use 32 hex digits")
    elif seed.bits < REPRODUCING_BITS:
        tell(f"warning: a board of this seed makes no row reproduced: that takes {REPRODUCING_BITS} bits")
    return seed
