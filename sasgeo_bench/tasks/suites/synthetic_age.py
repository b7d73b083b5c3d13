# SPDX-License-Identifier: Apache-2.0
"""Suite `synthetic-age`: the world is the map grown older, at rates measured in other places."""

from dataclasses import replace
from typing import Final

import numpy as np

from sasgeo_bench.ageing.ratebook import PooledRates
from sasgeo_bench.tasks.perturbations.ageing import Ageing, Rates
from sasgeo_bench.tasks.suites.base import Draft, Scene, Shot, Suite, SuiteCard, Variant, controls, ladder
from sasgeo_bench.tasks.vectors import VECTOR_CLASSES

YEARS: Final = (2.0, 5.0, 10.0, 20.0, 40.0)
_MOST_NEW_PER_OLD: Final = 1.0


class SyntheticAgeSuite(Suite):
    """Years pass between map and view; for places with one date only."""

    def lack(self, scene: Scene) -> str | None:
        """Refuse a region without rates of other places."""
        return "no rates of ageing from another place" if scene.ageing is None else super().lack(scene)

    def draw(self, shot: Shot) -> Draft:
        """Let the years pass, then perceive; a control sees the map's own day."""
        if shot.variant.strength == 0 or shot.scene.ageing is None:
            return Draft(evidence=shot.perceived(), changed_share=0.0)
        clean = shot.clean()
        grown = after(shot.scene.ageing, shot.variant.strength)(clean, shot.rng("ageing"))
        return Draft.of_change(shot.perceived(grown), clean, grown)


def ageing_of(pooled: PooledRates, *, place: str) -> Ageing:
    """Return ageing by the measured rates of other places, with no year passed yet.

    The shift of redrawn objects is the median over the classes whose centre moves because they were redrawn and not
    because they grew; how many are redrawn follows from the rates of the ground.
    """
    names = [name for name in VECTOR_CLASSES if name in pooled.classes]
    shifts_m = [shift_m for name in names if (shift_m := pooled.classes[name].shift_median_m) is not None]
    classes = {
        name: Rates(
            vanish_per_year=item.vanish_per_year,
            appear_per_year=item.appear_per_year,
            ground_lost_per_year=item.ground_lost_per_year,
            ground_gained_per_year=item.ground_gained_per_year,
        )
        for name, item in pooled.classes.items()
    }
    # 1.1774: median of a length whose two components have standard deviation 1: sqrt(2 ln 2)
    return Ageing(
        years=0.0,
        rates=classes,
        measured_in=pooled.places,
        place=place,
        shift_m=float(np.median(shifts_m)) / 1.1774 if shifts_m else 0.0,
    )


def after(ageing: Ageing, years: float) -> Ageing:
    """Return ageing by so many years.

    A class at most doubles, by its things and by its ground: rates of appearing were measured on maps that were being
    completed, and a complete map grows less.
    """
    most = float(np.log1p(_MOST_NEW_PER_OLD)) / years if years > 0 else np.inf
    return replace(ageing, years=years, rates={name: _at_most(rates, most) for name, rates in ageing.rates.items()})


def _at_most(rates: Rates, most_per_year: float) -> Rates:
    ground = rates.ground_gained_per_year
    return replace(
        rates,
        appear_per_year=min(rates.appear_per_year, most_per_year),
        ground_gained_per_year=None if ground is None else min(ground, most_per_year),
    )


SUITE: Final = SyntheticAgeSuite(
    card=SuiteCard(
        name="synthetic-age",
        version=2,
        title="Synthetic ageing",
        what="Things vanish, appear and are drawn anew for 2 to 40 years; ground is lost and gained at the rates that "
        "were measured in other places.",
        separates="Stability from uniform weights where no second date is there; to be read beside real-age.",
        falsifier="No year has passed: scores as in the control.",
        strength_unit="years between map and world",
        needs=("rates of ageing",),
    ),
    variants=(
        *controls(),
        *ladder("aged", YEARS, small=(5.0, 10.0, 20.0, 40.0), large=(10.0, 40.0)),
        Variant(role="falsifier", kind="no year"),
    ),
)
