# SPDX-License-Identifier: Apache-2.0
"""Suite `real-age`: the map is that of an older extract, the world that of the newest one."""

from dataclasses import replace
from typing import Final

import numpy as np

from sasgeo_bench.tasks.state import State
from sasgeo_bench.tasks.suites.base import Draft, Scene, Shot, Suite, SuiteCard, Variant, controls, ladder

AGES_YEARS: Final = (2.0, 5.0, 10.0)
DAYS_PER_YEAR: Final = 365.25
_MOST_OF_AGE: Final = 5 / 3


class RealAgeSuite(Suite):
    """One view of today's world, searched for in maps of several ages; the control searches today's map.

    `strength` is the age that a map stands for; the truth of each query says its age in years, `age_years`.
    """

    def lack(self, scene: Scene) -> str | None:
        """Refuse a region without an older extract."""
        if not scene.others:
            return "one date only, real ageing needs an older extract of the same place"
        if not any(has_age(scene, years) for years in AGES_YEARS):
            return f"no older extract of about {', '.join(f'{years:g}' for years in AGES_YEARS)} years"
        return None

    def usable(self, scene: Scene) -> tuple[Variant, ...]:
        """Return the ages for which there is a map."""
        return tuple(item for item in self.variants if item.role != "stress" or has_age(scene, item.strength))

    def map_region(self, scene: Scene, variant: Variant) -> str:
        """Return the older map for a stress, today's for its control."""
        return map_of_age(scene, variant.strength).region if variant.role == "stress" else scene.map.region

    def draw(self, shot: Shot) -> Draft:
        """Perceive today's world; measure the age of the map and its changes."""
        if shot.variant.role != "stress":
            return Draft(evidence=shot.perceived(), changed_share=0.0, measured={"age_years": 0.0})
        old = map_of_age(shot.scene, shot.variant.strength)
        draft = Draft.of_change(shot.perceived(), shot.clean(), shot.clean(old))
        return replace(draft, measured={"age_years": age_years(old, shot.scene.world), **draft.measured})


def age_years(old: State, new: State) -> float:
    """Return the years between two states."""
    return (new.date - old.date).days / DAYS_PER_YEAR


def map_of_age(scene: Scene, years: float) -> State:
    """Return the older state whose age is nearest to the given one by ratio."""
    return min(
        scene.others, key=lambda state: (abs(np.log(max(age_years(state, scene.world), 0.01) / years)), state.date)
    )


def has_age(scene: Scene, years: float) -> bool:
    """Return whether there is a state of about that age: not much younger, and less than twice as old."""
    if not scene.others:
        return False
    # 0.8 of the age of a variant, so that none of "10 years" is less than 8
    return 0.8 <= age_years(map_of_age(scene, years), scene.world) / years <= _MOST_OF_AGE


SUITE: Final = RealAgeSuite(
    card=SuiteCard(
        name="real-age",
        version=2,
        title="Real ageing (S1)",
        what="The map is that of an extract about 2, 5 or 10 years older than the world that is seen: the nearest date "
        "there is, 1.6 to 3.3, 4 to 8.3 or 8 to 16.7 years. Most of what differs was mapped since, not built.",
        separates="Stability from uniform weights: stable classes should carry what volatile ones lost.",
        falsifier="The same views against the map of the same day.",
        strength_unit="years between map and world, about: age_years is what they are",
        needs=("older maps",),
    ),
    variants=(*controls(), *ladder("S1", AGES_YEARS, small=AGES_YEARS, large=(10.0,))),
)
