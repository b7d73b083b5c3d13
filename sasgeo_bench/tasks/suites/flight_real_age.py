# SPDX-License-Identifier: Apache-2.0
"""Suite `flight-real-age`: flights over today's world, on older maps of the same place."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Final

from sasgeo_bench.tasks.suites.base import Draft, Scene, Shot, SuiteCard, Variant
from sasgeo_bench.tasks.suites.flights import AGAIN, SEQUENCE, START, FlightSuite, Mission
from sasgeo_bench.tasks.suites.real_age import AGES_YEARS, age_years, has_age, map_of_age


class FlightRealAgeSuite(FlightSuite):
    """One flight, followed on maps of several ages; the control has today's map."""

    def lack(self, scene: Scene) -> str | None:
        """Refuse a region without an older extract of a fitting age."""
        if not any(has_age(scene, years) for years in AGES_YEARS):
            return f"no older extract of about {', '.join(f'{years:g}' for years in AGES_YEARS)} years"
        return super().lack(scene)

    def usable(self, scene: Scene) -> tuple[Variant, ...]:
        """Return the ages for which there is a map."""
        return tuple(item for item in self.variants if item.role != "stress" or has_age(scene, item.strength))

    def map_region(self, scene: Scene, variant: Variant) -> str:
        """Return the older map for a stress, today's for the others."""
        return map_of_age(scene, variant.strength).region if variant.role == "stress" else scene.map.region

    def draw(self, shot: Shot) -> Draft:
        """Perceive today's world; measure the age of the map and its changes."""
        if shot.variant.role != "stress":
            return replace(super().draw(shot), changed_share=0.0, measured={"age_years": 0.0})
        old = map_of_age(shot.scene, shot.variant.strength)
        draft = Draft.of_change(shot.perceived(), shot.clean(), shot.clean(old))
        return replace(draft, measured={"age_years": age_years(old, shot.scene.world), **draft.measured})


def _mission(variant: Variant) -> Mission:
    return Mission(draw=AGAIN if variant.role == "falsifier" else "")


def _ages(ages_years: Sequence[float]) -> tuple[Variant, ...]:
    return tuple(Variant(role="stress", kind="F2", strength=years) for years in ages_years)


SUITE: Final = FlightRealAgeSuite(
    card=SuiteCard(
        name="flight-real-age",
        version=1,
        title="Flights over aged maps (F2)",
        what="The map is that of an extract about 2, 5 or 10 years older than the world that is flown over, as in "
        "real-age; the control's is today's.",
        separates="Trackers that lean on what lasts from those that lean on what is many.",
        falsifier="Today's map again, with other errors of perception and odometry.",
        strength_unit="years between map and world, about: age_years is what they are",
        needs=("older maps",),
        group=START,
        tracks=SEQUENCE,
        min_density=0.05,
    ),
    variants=(
        Variant(role="control", kind="today's map"),
        *_ages(AGES_YEARS),
        Variant(role="falsifier", kind="today's map again"),
    ),
    mission=_mission,
)
