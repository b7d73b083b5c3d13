# SPDX-License-Identifier: Apache-2.0
# ruff: noqa: ARG002 - the door has its arguments, and what these find is held against what they were given
"""Matchers that learn, well and badly; each is run by a test, none is installed."""

import json
import time

from sasgeo_bench.geometry.pose import Pose
from sasgeo_bench.matching.matcher import Match, MatcherCard

SAID = {"version": "1", "title": "Learner", "source": "original", "ours": "all", "licence": "Apache-2.0"}
BOTH = ("localization", "retrieval")


class Counts:
    """Learns how many pairs there are, and shows it in each answer; -1 where it has learnt nothing."""

    card = MatcherCard(name="counts", tracks=BOTH, **SAID)

    def learn(self, training):
        maps = {query.region: training.regions[query.region] for query, _ in training.pairs}
        assert set(maps) == set(training.regions)
        assert all(truth.query_id == query.query_id for query, truth in training.pairs)
        suites = sorted({query.suite for query, _ in training.pairs})
        return json.dumps({"pairs": len(training.pairs), "maps": sorted(maps), "suites": suites})

    def prepare(self, region, learned):
        self.learned = {"pairs": -1} if learned is None else json.loads(learned)

    def match(self, query, *, top_k):
        values = {"pairs": float(self.learned["pairs"])}
        if query.candidates:
            poses = query.candidates[:top_k]
            return Match(poses=poses, scores=[0.0] * len(poses), diagnostics=values, confidence=0.5)
        x, y = query.prior.center_m or (0.0, 0.0)
        pose = Pose(easting_m=x, northing_m=y, yaw_deg=query.prior.yaw_deg or 0.0)
        return Match(poses=[pose], scores=[0.0], diagnostics=values, confidence=0.5)


class NeedsTraining(Counts):
    card = MatcherCard(name="needs-training", tracks=BOTH, needs=("training",), **SAID)

    def prepare(self, region, learned):
        self.learned = json.loads(learned)


class Oracle(Counts):
    card = MatcherCard(name="oracle_counts", tracks=BOTH, **SAID)


class RaisesInLearn(Counts):
    def learn(self, training):
        raise ValueError("nothing\nto see")


class HangsInLearn(Counts):
    def learn(self, training):
        time.sleep(1000)


class LearnsBytes(Counts):
    def learn(self, training):
        return b"\x00"


class ReadsTruth(Counts):
    """Counts the truths that it can read from the disk while it learns."""

    def learn(self, training):
        root = next(iter(training.regions._folders.values())).parents[1]
        found = 0
        for path in (root / "truth").glob("*/*/truth.parquet"):
            try:
                found += len(path.read_bytes()) > 0
            except OSError:
                continue
        assert next(iter(training.regions.values())).layers.any()
        return json.dumps({"pairs": found})
