# SPDX-License-Identifier: Apache-2.0
"""Python's search for garbage, put off while many objects are made of which none is."""

import gc
from collections.abc import Iterator
from contextlib import contextmanager


@contextmanager
def uncollected() -> Iterator[None]:
    """Stop the cyclic garbage collector while lists of objects grow: a tenth of a scan, half of reading answers.

    >>> with uncollected():
    ...     gc.isenabled()
    False
    >>> gc.isenabled()
    True
    """
    was_enabled = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if was_enabled:
            gc.enable()
