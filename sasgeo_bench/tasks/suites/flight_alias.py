# SPDX-License-Identifier: Apache-2.0
"""Suite `flight-alias`: flights whose first stretch lies on the map twice."""

from dataclasses import replace
from functools import partial
from typing import Final

import numpy as np
import shapely
import shapely.affinity

from sasgeo_bench.flights.trajectory import Trajectory
from sasgeo_bench.tasks.query import RADII_M, PriorGroup
from sasgeo_bench.tasks.suites.base import Scene, SuiteCard, Variant
from sasgeo_bench.tasks.suites.flight_off_map import lengths_within
from sasgeo_bench.tasks.suites.flight_plots import (
    STRETCHES_M,
    ChangedMapSuite,
    Floats,
    Ground,
    MapChange,
    Plot,
    stretches_m,
)
from sasgeo_bench.tasks.suites.flights import SEQUENCE, START
from sasgeo_bench.tasks.suites.twins import RIVAL_M
from sasgeo_bench.tasks.twin import Paste, mirror

_RIM_M: Final = 8.0  # copied beyond what views show: cells at the rim of a copy may differ


class FlightAliasSuite(ChangedMapSuite):
    """One map shows the ground of the first stretch a second time, the other one shows it there as in a mirror."""

    def refusal(self, group: PriorGroup) -> str | None:
        """Refuse a disc that cannot hold the start and its copy."""
        if group.radius_m is None or 2 * group.radius_m > RIVAL_M:
            return super().refusal(group)
        least = min(radius_m for radius_m in RADII_M if radius_m and 2 * radius_m > RIVAL_M)
        return f"needs a disc that holds two places up to {RIVAL_M:g} m apart: use r{least:g} or more"

    def clear_m(self, scene: Scene) -> float:
        """Return how far around the path ground is copied."""
        return super().clear_m(scene) + _RIM_M

    def plot(self, views: Trajectory, ground: Ground, rng: np.random.Generator) -> Plot | None:
        """Copy the ground of the longest stretch that fits, out of sight of the flight."""
        place_m, flown_m = views.position_m[:, :2], views.distance_m
        if not ground.admits(place_m):
            return None
        for stretch_m in stretches_m(float(flown_m[-1])):
            # 1 m: nearer to the stretch, a view sees what was copied
            hull = shapely.MultiPoint(place_m[flown_m <= stretch_m]).convex_hull.buffer(1.0)
            area = hull.buffer(ground.reach_m + _RIM_M)
            # 1.25 of the stretch, at most, is flown over the copied ground: who comes back knows it by then
            is_left = lengths_within(hull, place_m, flown_m).sum() <= 1.25 * stretch_m
            copy_m = _room(area, place_m, ground, rng) if is_left else None
            if copy_m is not None:
                # Copy of an area, and the copy of its mirror image, both of the same outline
                middle_m = _middle_m(area)
                radius_m = float(shapely.hausdorff_distance(shapely.Point(middle_m), area)) + _RIM_M
                target_m = (middle_m[0] + copy_m[0], middle_m[1] + copy_m[1])
                plain = Paste(source_m=middle_m, target_m=target_m, radius_m=radius_m, outline=area)

                stress, falsifier = plain, replace(plain, change=partial(mirror, classes=None, center_m=middle_m))
                facts = {"copy_m": round(float(np.hypot(*copy_m)), 1)}
                return Plot(
                    strength=stretch_m,
                    stress=MapChange(area=stress.area, paste=stress, measured=facts),
                    falsifier=MapChange(area=falsifier.area, paste=falsifier, measured=facts),
                    copy_m=copy_m,
                )
        return None


def _room(
    area: shapely.Polygon, place_m: Floats, ground: Ground, rng: np.random.Generator
) -> tuple[float, float] | None:
    """Return how far east and north an area has room a second time: whole cells, so that its cells are the same."""
    # 2000 are tried for the copy
    shifts_m = np.rint(rng.uniform(-RIVAL_M, RIVAL_M, (2000, 2)) / ground.cell_m) * ground.cell_m
    mirrored = shapely.affinity.scale(area, xfact=-1.0, yfact=1.0, origin=_middle_m(area))
    if not ground.mapped.contains(shapely.union(area, mirrored)):
        return None
    room_m = np.array(ground.mapped.bounds) - area.bounds  # west, south, east, north of it: the box is checked first
    is_near = np.hypot(*shifts_m.T) < RIVAL_M
    is_within = ((shifts_m >= room_m[:2]) & (shifts_m <= room_m[2:])).all(axis=1)
    for shift_m in shifts_m[is_near & is_within].tolist():
        copy = shapely.affinity.translate(area, *shift_m)
        is_apart = not copy.intersects(area)
        if is_apart and ground.mapped.contains(copy) and ground.is_free(copy, place_m):
            return (shift_m[0], shift_m[1])
    return None


def _middle_m(area: shapely.Polygon) -> tuple[float, float]:
    west, south, east, north = area.bounds
    return ((west + east) / 2, (south + north) / 2)


SUITE: Final = FlightAliasSuite(
    card=SuiteCard(
        name="flight-alias",
        version=1,
        title="Repeated ground (F8)",
        what="The searched map shows the ground of the first 1 km, 500 m or 250 m of the flight, the longest that "
        "fits, a second time, up to 800 m away and within the disc of the start: no view there tells which it is, and "
        "no turn. Only the way out does.",
        separates="Trackers that keep two hypotheses until one is right, and say so, from those that pick one.",
        falsifier="The second time the ground is as in a mirror: as much of the map is changed, and it does not fit.",
        strength_unit="m of the flight that the map shows twice, about: is_copied says which views",
        group=START,
        tracks=SEQUENCE,
        min_density=0.05,
    ),
    variants=(
        Variant(role="control", kind="no copy"),
        *(Variant(role="stress", kind="F8 copied start", strength=length_m) for length_m in sorted(STRETCHES_M)),
        Variant(role="falsifier", kind="mirror image"),
    ),
)
