# SPDX-License-Identifier: Apache-2.0
# ruff: noqa: ARG002 - the door has its arguments
"""Trackers that break what they can; each is run by a test, none is installed."""

import gc
import os
import time
from dataclasses import replace
from pathlib import Path
from typing import ClassVar

from sasgeo_bench.geometry.pose import Pose
from sasgeo_bench.matching.matcher import MatcherCard
from sasgeo_bench.matching.tracker import Fix
from sasgeo_bench.tasks.query import Query

SAID = {"version": "1", "title": "Wayward", "source": "original", "ours": "all", "licence": "Apache-2.0"}
HERE = Pose(easting_m=0.0, northing_m=0.0, yaw_deg=0.0)


class Counting:
    """Says how many views it has had since the flight began, and which process it is in."""

    card = MatcherCard(name="counting", tracks=("sequence",), **SAID)

    def prepare(self, region, learned):
        self.region = region

    def start(self, prior):
        self.views = 0
        self.has_place = prior.has_place

    def step(self, query):
        self.views += 1
        values = {"views": self.views, "process": os.getpid(), "has_place": self.has_place}
        return Fix(pose=HERE, covariance=[[4, 0, 0], [0, 4, 0], [0, 0, 1]], modes=[(HERE, 0.5)], diagnostics=values)


class Holding(Counting):
    """Says how many queries its process holds; where that is also the process of the tests it looks for a second."""

    card = MatcherCard(name="holding", tracks=("sequence",), **SAID)

    def step(self, query):
        fix = super().step(query)
        held = sum(isinstance(item, Query) for item in gc.get_objects())
        return replace(fix, diagnostics={**fix.diagnostics, "held": held})


class Taught(Counting):
    """Learns how many views it was taught by, and says so at each step; -1 where it has learnt nothing."""

    card = MatcherCard(name="taught", tracks=("sequence",), **SAID)

    def learn(self, training):
        return str(len(training.pairs))

    def prepare(self, region, learned):
        self.lessons = -1 if learned is None else int(learned)

    def step(self, query):
        return Fix(pose=HERE, diagnostics={"lessons": self.lessons})


class Remembers(Counting):
    """Says how many flights it knows of, in memory and in files of its own: each is begun twice, once to warm up."""

    card = MatcherCard(name="remembers", tracks=("sequence",), **SAID)
    flights: ClassVar[set[str]] = set()

    def step(self, query):
        self.flights.add(query.step.sequence_id)
        Path(query.step.sequence_id).touch()
        return Fix(pose=HERE, diagnostics={"known": len(self.flights), "kept": len(list(Path.cwd().iterdir()))})


class ReadsAhead(Counting):
    """Looks for the views to come, and for the truths, wherever they may lie."""

    card = MatcherCard(name="reads-ahead", tracks=("sequence",), **SAID)

    def step(self, query):
        root = Path(__file__).parent / "out"
        for folder in ("tasks", "truth"):
            for path in (root / folder).rglob("*.parquet"):
                path.read_bytes()
                return Fix(pose=HERE, diagnostics={"read": 1.0})
        return Fix(pose=HERE, diagnostics={"read": 0.0})


class Failing(Counting):
    """Fails at the third view of the flight that a file beside it names, in the way that the file says."""

    card = MatcherCard(name="failing", tracks=("sequence",), **SAID)

    def step(self, query):
        flight, way = Path(__file__).with_name("fails").read_text(encoding="utf-8").split()
        if query.step.sequence_id != flight or query.step.frame != 2:
            return super().step(query)
        if way == "hangs":
            time.sleep(3600)
        if way == "dies":
            os._exit(3)
        if way == "raises":
            raise ValueError("no more today")
        if way == "singular":
            return Fix(pose=HERE, covariance=[[1, 1, 0], [1, 1, 0], [0, 0, 1]])
        return "a text"


class Ranks:
    """Ranks candidates, and finds no place."""

    card = MatcherCard(name="ranks", tracks=("retrieval",), **SAID)

    def prepare(self, region, learned):
        self.region = region

    def match(self, query, *, top_k):
        raise NotImplementedError
