# SPDX-License-Identifier: Apache-2.0
"""Suite `flight-kidnap`: a drone that is carried kilometres away, with or without its odometer's knowledge."""

from typing import Final

from sasgeo_bench.tasks.suites.base import Scene, SuiteCard, Variant
from sasgeo_bench.tasks.suites.flights import SEQUENCE, START, FlightSuite, Mission, carries

DISTANCES_M: Final = (1000.0, 2000.0, 5000.0)
TOLD, UNTOLD = "F5 odometer lost", "F5 odometer unaware"
STAYS: Final = "odometer lost, not carried"


class FlightKidnapSuite(FlightSuite):
    """A flight that begins elsewhere; from the middle on it is the control's."""

    def lack(self, scene: Scene) -> str | None:
        """Refuse a map on which nobody can be carried even the least distance."""
        if not carries(scene, min(DISTANCES_M)):
            return f"no room to be carried {min(DISTANCES_M):g} m"
        return super().lack(scene)

    def usable(self, scene: Scene) -> tuple[Variant, ...]:
        """Return the distances for which there is room."""
        return tuple(item for item in self.variants if item.role != "stress" or carries(scene, item.strength))


def _mission(variant: Variant) -> Mission:
    if variant.kind == STAYS:
        return Mission(is_lost=True)
    return Mission(carried_m=variant.strength, is_lost=variant.kind == TOLD)


SUITE: Final = FlightKidnapSuite(
    card=SuiteCard(
        name="flight-kidnap",
        version=1,
        title="Carried away (F5)",
        what="The flight begins elsewhere; in its middle the drone is carried, unseen, 1, 2 or 5 km to where the "
        "control flies, and goes on as the control does. Its odometer says nothing of that step, or the control's.",
        separates="Trackers that can give up a belief that was right from those that cannot.",
        falsifier="The odometer says nothing of one step, and the drone is not carried.",
        strength_unit="m carried, about: carried_m is how far",
        group=START,
        tracks=SEQUENCE,
        min_density=0.05,
    ),
    variants=(
        Variant(role="control", kind="not carried"),
        *(Variant(role="stress", kind=kind, strength=far_m) for kind in (TOLD, UNTOLD) for far_m in DISTANCES_M),
        Variant(role="falsifier", kind=STAYS),
    ),
    mission=_mission,
)
