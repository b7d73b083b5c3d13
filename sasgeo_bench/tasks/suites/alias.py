# SPDX-License-Identifier: Apache-2.0
"""Suite `alias`: other places look like the true one, and the matcher should report that it cannot decide."""

import math
from typing import Final

import numpy as np

from sasgeo_bench.tasks.suites.base import Draft, Shot, SuiteCard, Variant
from sasgeo_bench.tasks.suites.twins import TwinSuite

NEIGHBOUR_M: Final = 5.0
COPIES: Final = 3


class AliasSuite(TwinSuite):
    """R1: the truth is not among the candidates. R2: neighbours 5 m away. R4: identical blocks."""

    def draw(self, shot: Shot) -> Draft:
        """Perceive one view; the variant determines the candidates."""
        seen, kind = shot.perceived(), shot.variant.kind
        if kind.startswith("R1"):
            return Draft(evidence=seen, is_present=False, is_removed=True)
        if kind.startswith("R2"):
            return Draft(evidence=seen, has_twins=False, neighbours_m=_neighbours(shot.seeds.rng("neighbours")))
        has_twins = kind.startswith("R4")
        return Draft(evidence=seen, has_twins=has_twins, measured={"twins": float(COPIES * has_twins)})


def _neighbours(rng: np.random.Generator) -> tuple[tuple[float, float], ...]:
    """Return a cross of five places 5 m from each other, moved so that any of them may be the true one."""
    cross = np.array([(0, 0), (1, 0), (-1, 0), (0, 1), (0, -1)]) * NEIGHBOUR_M
    moved = cross - cross[rng.integers(len(cross))]
    return tuple((float(x), float(y)) for x, y in moved)


SUITE: Final = AliasSuite(
    card=SuiteCard(
        name="alias",
        version=1,
        title="Aliases (R1-R4)",
        what="The truth removed and its aliases left (R1), neighbours five metres apart (R2), three exact copies of "
        "the place (R4). R3 is no query of its own: the controls, pooled over town and country.",
        separates="Calibrated rejection from margins.",
        falsifier="The control has neither copies nor neighbours among its candidates.",
        strength_unit="1 where aliased",
        tracks=("retrieval",),
        min_density=0.01,
    ),
    variants=(
        Variant(role="control", kind="no copies"),
        Variant(role="stress", kind="R1 truth removed", strength=1.0),
        Variant(role="stress", kind="R2 neighbours", strength=1.0),
        Variant(role="stress", kind="R4 identical blocks", strength=1.0),
    ),
    copies=COPIES,
    within_m=math.inf,  # all of them are candidates, wherever they lie
    is_swapped=False,
)
