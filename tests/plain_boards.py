# SPDX-License-Identifier: Apache-2.0
"""Boards without their texts, which take half the work of a small board, for tests that read none of them."""

from collections.abc import Iterator
from contextlib import contextmanager

import pytest

from sasgeo_bench.boards import build
from sasgeo_bench.scoring import rejection
from sasgeo_bench.scoring.rejection import acceptance_frame


@contextmanager
def plain_boards() -> Iterator[None]:
    """Boards have empty texts, and no table of what is accepted by cost."""
    with pytest.MonkeyPatch.context() as patch:
        for name in ("board_markdown", "board_latex"):
            patch.setattr(build, name, lambda *_, **__: "")
        patch.setattr(rejection, "acceptance_frame", lambda one, other, rows: acceptance_frame(one, other, rows[:0]))
        yield
