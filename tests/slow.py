# SPDX-License-Identifier: Apache-2.0
"""Parameters of which `make test` takes a few alone, where the others show the same of other cases."""

from collections.abc import Iterable
from typing import Any

import pytest


def rest_slow(values: Iterable[Any], *, but: int = 1) -> list[Any]:
    """Return parameters, all but the first `but` of them marked `slow`; tuples are several arguments."""
    listed = [value if isinstance(value, tuple) else (value,) for value in values]
    return [
        *(pytest.param(*one) for one in listed[:but]),
        *(pytest.param(*one, marks=pytest.mark.slow) for one in listed[but:]),
    ]
