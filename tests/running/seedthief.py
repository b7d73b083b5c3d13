# SPDX-License-Identifier: Apache-2.0
# ruff: noqa: ARG002 - the door has its arguments
"""A matcher that looks for a private seed wherever a process of its user might find one."""

import os
from pathlib import Path

from sasgeo_bench.geometry.pose import Pose
from sasgeo_bench.matching.matcher import Match, MatcherCard

SAID = {"version": "1", "title": "Thief", "source": "original", "ours": "all", "licence": "Apache-2.0"}
SECRET = "0f1e2d3c" + "4b5a6978" + "8796a5b4" + "c3d2e1f0"


def _text(path):
    try:
        return path.read_bytes().decode(errors="replace")
    except OSError:
        return ""


class Thief:
    """Says in diagnostics in which place it found the seed."""

    card = MatcherCard(name="thief", tracks=("localization", "retrieval"), **SAID)

    def prepare(self, region, learned):
        here = Path(__file__).parent
        processes = [path / name for path in Path("/proc").glob("[0-9]*") for name in ("environ", "cmdline")]
        found = {
            "file": _text(here / "my.seed"),
            "environment": " ".join(os.environ.values()),
            "processes": " ".join(map(_text, processes)),
        }
        self.found = {name: float(SECRET in text) for name, text in found.items()}

    def match(self, query, *, top_k):
        poses = query.candidates[:1] or [Pose(easting_m=0.0, northing_m=0.0, yaw_deg=0.0)]
        return Match(poses=poses, scores=[0.0], diagnostics=self.found)


class PassesForFftVote(Thief):
    """Bears the name of a matcher that ships."""

    card = MatcherCard(name="fft_vote", tracks=("localization", "retrieval"), **SAID)
