# SPDX-License-Identifier: Apache-2.0
# ruff: noqa: ARG002 - the door has its arguments
"""Trackers with one fault each, for the conformance kit; none is installed."""

import numpy as np

from sasgeo_bench.geometry.pose import Pose
from sasgeo_bench.matching.matcher import MatcherCard
from sasgeo_bench.matching.tracker import Fix
from sasgeo_bench.regions.evidence import PRESENT

SAID = {"version": "1", "title": "Stray", "source": "original", "ours": "all", "licence": "MIT"}
SOME = np.diag([100.0, 100.0, 25.0])


class Still:
    """Stays in the middle of the map, and accepts nothing."""

    card = MatcherCard(name="still", tracks=("sequence",), **SAID)

    def prepare(self, region, learned):
        west_m, south_m, east_m, north_m = region.grid.bounds_m
        self.bounds_m = region.grid.bounds_m
        self.pose = Pose(easting_m=(west_m + east_m) / 2, northing_m=(south_m + north_m) / 2, yaw_deg=0.0)

    def start(self, prior):
        self.count = 0

    def step(self, query):
        self.count += 1
        return Fix(pose=self.pose, covariance=SOME, is_accepted=False)


class Imitates(Still):
    card = MatcherCard(name="dead_reckoning", tracks=("sequence",), **SAID)


class Unprepared(Still):
    def prepare(self, region, learned):
        raise ValueError("no map today")


class Singular(Still):
    def step(self, query):
        return Fix(pose=self.pose, covariance=np.ones((3, 3)), is_accepted=False)


class SometimesSure(Still):
    def step(self, query):
        covariance = SOME if query.step.frame % 2 else None
        return Fix(pose=self.pose, covariance=covariance, is_accepted=False)


class Fickle(Still):
    flown = 0

    def start(self, prior):
        type(self).flown += 1

    def step(self, query):
        return Fix(pose=self.pose, covariance=type(self).flown * SOME, is_accepted=False)


class Remembers(Still):
    """Has the answer of the flight before the last one in its mind, if that was another flight."""

    seen = ""
    flights = 0

    def step(self, query):
        if query.step.sequence_id != self.seen:
            self.seen, self.flights = query.step.sequence_id, self.flights + 1
        return Fix(pose=self.pose, covariance=self.flights * SOME, is_accepted=False)


class LooksHard(Still):
    def step(self, query):
        if not (query.evidence.cells == PRESENT).any():
            raise ValueError("nothing to see")
        return super().step(query)


class Brittle(Still):
    """Bears no flight but an ordinary one."""

    def start(self, prior):
        super().start(prior)
        self.middle_m = sum(prior.center_m)

    def step(self, query):
        if query.step.frame:
            np.linalg.inv(np.reshape(query.step.covariance, (3, 3)))
            if query.step.increment[1] > self.bounds_m[2] - self.bounds_m[0]:
                raise IndexError("off the map")
        return super().step(query)


class AlwaysSure(Still):
    def step(self, query):
        return Fix(pose=self.pose, covariance=SOME)
