# SPDX-License-Identifier: Apache-2.0
# ruff: noqa: ARG002 - the door has its arguments
"""Matchers with one fault each, for the conformance kit to find; and one without."""

import os
from pathlib import Path

import numpy as np

from sasgeo_bench.geometry.pose import Pose
from sasgeo_bench.matching.matcher import WITHHELD, Match, MatcherCard
from sasgeo_bench.regions.evidence import PRESENT, UNKNOWN

SAID = {"version": "1", "title": "Faulty", "source": "original", "ours": "all", "licence": "Apache-2.0"}
BOTH = ("localization", "retrieval")


class Good:
    """The middle of the disc, or of the map; candidates by their distance to the middle of the map."""

    card = MatcherCard(name="good", tracks=BOTH, **SAID)

    def prepare(self, region, learned):
        west_m, south_m, east_m, north_m = region.grid.bounds_m
        self.middle_m = ((west_m + east_m) / 2, (south_m + north_m) / 2)

    def match(self, query, *, top_k):
        if (query.evidence.cells == UNKNOWN).all():
            return WITHHELD
        return self.answer(query, top_k)

    def answer(self, query, top_k):
        if query.track == "retrieval":
            return self.ranked(query, top_k)
        x, y = self.center_m(query)
        seen = float((query.evidence.cells == PRESENT).mean())
        yaw_deg = query.prior.yaw_deg or 0.0
        return Match(poses=[Pose(easting_m=x, northing_m=y, yaw_deg=yaw_deg)], scores=[seen], confidence=0.5)

    def center_m(self, query):
        return query.prior.center_m or self.middle_m

    def ranked(self, query, top_k):
        scored = [(self.score(pose, at), pose) for at, pose in enumerate(query.candidates)]
        best = sorted(scored, key=lambda item: -item[0])[:top_k]
        return Match(poses=[pose for _, pose in best], scores=[score for score, _ in best])

    def score(self, pose, at):
        return -float(np.hypot(pose.easting_m - self.middle_m[0], pose.northing_m - self.middle_m[1]))


class NoCard(Good):
    card = None


class RaisesInPrepare(Good):
    def prepare(self, region, learned):
        raise ValueError("no index today")


class WantsImages(Good):
    card = MatcherCard(name="wants-images", tracks=BOTH, needs=("image",), **SAID)


class RanksOnly(Good):
    card = MatcherCard(name="ranks-only", tracks=("retrieval",), **SAID)


class ScoresNan(Good):
    def answer(self, query, top_k):
        found = super().answer(query, top_k)
        return Match(poses=found.poses, scores=[float("nan")] * len(found.poses))


class WorstFirst(Good):
    """Wrong where there are several to order."""

    def ranked(self, query, top_k):
        found = super().ranked(query, top_k)
        return Match(poses=found.poses[::-1], scores=found.scores[::-1])


class RaisesWithVectors(Good):
    def answer(self, query, top_k):
        if query.vectors is not None:
            raise TypeError("what are\nthese?")
        return super().answer(query, top_k)


class Fickle(Good):
    """Counts what it was asked."""

    asked = 0

    def answer(self, query, top_k):
        self.asked += 1
        found = super().answer(query, top_k)
        return Match(poses=found.poses, scores=found.scores, diagnostics={"asked": self.asked})


class FailsAgain(Good):
    """Crashes when it is asked the same once more."""

    last = None

    def answer(self, query, top_k):
        if query.query_id == self.last:
            raise RuntimeError("again?")
        self.last = query.query_id
        return super().answer(query, top_k)


class TwoAtLeast(Good):
    def ranked(self, query, top_k):
        return super().ranked(query, max(2, top_k))


class WantsADisc(Good):
    """Its card does not say so."""

    def center_m(self, query):
        x, y = query.prior.center_m
        return x, y


class SaysItWantsADisc(WantsADisc):
    card = MatcherCard(name="wants-a-disc", tracks=BOTH, needs=("position",), **SAID)


class WantsAHeading(Good):
    """Its card does not say so."""

    def answer(self, query, top_k):
        if not 0 <= query.prior.yaw_deg < 360:
            return WITHHELD
        return super().answer(query, top_k)


class Boasts(Good):
    """Has an answer for whoever sees nothing."""

    def match(self, query, *, top_k):
        return self.answer(query, top_k)


class Doubts(Good):
    """Answers whoever sees nothing, and says that it knows nothing."""

    def match(self, query, *, top_k):
        found = self.answer(query, top_k)
        blind = bool((query.evidence.cells == UNKNOWN).all())
        return Match(poses=found.poses, scores=found.scores, confidence=0.0 if blind else 0.5)


class LostBeyondTheMap(Good):
    def center_m(self, query):
        x, y = super().center_m(query)
        return [(x, y)][int(abs(x - self.middle_m[0]) // 2000)]


class IgnoresThePrior(Good):
    def center_m(self, query):
        return self.middle_m


class FirstIsBetter(Good):
    """Breaks ties by the order of the candidates."""

    def score(self, pose, at):
        return super().score(pose, at) - at / 1000


class LooksBack(Good):
    """Remembers the query before; the same query twice changes nothing."""

    before, now = "", ""

    def answer(self, query, top_k):
        if query.query_id != self.now:
            self.before, self.now = self.now, query.query_id
        found = super().answer(query, top_k)
        return Match(poses=found.poses, scores=found.scores, diagnostics={f"after {self.before}": 1.0})


class BornWithChance(Good):
    """Draws once, when it is made: the same all the time in one process."""

    def __init__(self):
        self.chance = int.from_bytes(os.urandom(4), "big")

    def answer(self, query, top_k):
        found = super().answer(query, top_k)
        return Match(poses=found.poses, scores=found.scores, diagnostics={"chance": float(self.chance)})


class WritesAmongMaps(Good):
    """Leaves a file where the maps are: the place lies beside this file."""

    def answer(self, query, top_k):
        (Path(__file__).parent / "place" / "regions" / "mine.txt").write_text("here")
        return super().answer(query, top_k)


class WritesToScratch(Good):
    def answer(self, query, top_k):
        (Path.home() / "mine.txt").write_text("here")
        return super().answer(query, top_k)


class Learns(Good):
    """Knows a number afterwards, and does well without."""

    def learn(self, training):
        return str(len(training.pairs) + len(training.regions))

    def prepare(self, region, learned):
        super().prepare(region, learned)
        self.bias = float(learned or 0)


class LearnsByChance(Learns):
    def learn(self, training):
        return str(int.from_bytes(os.urandom(4), "big"))


class LearnsNothing(Learns):
    def learn(self, training):
        raise ValueError("too hard")


class CannotWithout(Learns):
    """Its card does not say so."""

    def prepare(self, region, learned):
        super().prepare(region, learned + "0")


class SaysItCannotWithout(CannotWithout):
    card = MatcherCard(name="cannot-without", tracks=BOTH, needs=("training",), **SAID)
