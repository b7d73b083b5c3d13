# SPDX-License-Identifier: Apache-2.0
"""Suite `telemetry`: what arrives of a view over a narrow link, by five ways to send it."""

from typing import Final

from sasgeo_bench.regions.evidence import Evidence
from sasgeo_bench.tasks.perturbations.base import share_changed, share_hidden
from sasgeo_bench.tasks.perturbations.telemetry import Sent, junctions, outlines, regions_of_interest, run_length, whole
from sasgeo_bench.tasks.suites.base import Draft, Shot, Suite, SuiteCard, Variant, controls, ladder
from sasgeo_bench.tasks.suites.vectors import site_vectors

OUTLINES, REGIONS, JUNCTIONS = "outlines", "regions of interest", "junctions"
RUNS: Final = "runs"


def budget_bytes(strength: float) -> int:
    """Return the longest message of a strength.

    >>> [budget_bytes(strength) for strength in (1, 2, 5)]
    [2048, 1024, 128]
    """
    return round(4096 / 2**strength)  # 4096 bytes: a budget of strength 0; each step halves it


class TelemetrySuite(Suite):
    """The same perceived view, sent in several ways."""

    def draw(self, shot: Shot) -> Draft:
        """Perceive, send, and show what arrives."""
        seen = shot.perceived()
        sent = _sent(shot, seen)
        return Draft(
            evidence=sent.evidence,
            vectors=sent.vectors,
            measured={
                "bytes": float(sent.bytes),  # of the message
                "cells_changed": share_changed(seen, sent.evidence),
                "unknown_added": share_hidden(seen, sent.evidence),
            },
        )


def _sent(shot: Shot, seen: Evidence) -> Sent:
    kind, budget = shot.variant.kind, budget_bytes(shot.variant.strength)
    if kind == OUTLINES:
        return outlines(seen, budget_bytes=budget)
    if kind == REGIONS:
        return regions_of_interest(seen, shot.scene.map.shares, budget_bytes=budget)
    if kind == JUNCTIONS:
        return junctions(seen, site_vectors(shot), budget_bytes=budget)
    return run_length(seen) if kind == RUNS else whole(seen)


SUITE: Final = TelemetrySuite(
    card=SuiteCard(
        name="telemetry",
        version=1,
        title="Telemetry: a view over a narrow link",
        what="The view is sent whole or as runs (nothing is lost), as outlines that are simplified, as the squares "
        "that say most for their bytes, or as junctions alone, in a message of at most so many bytes.",
        separates="Matchers that need few bytes from those that need the whole view: success against bytes for a fix.",
        falsifier="Runs: shorter, and nothing is lost: scores as in the control.",
        strength_unit="halvings of a message of 4096 bytes",
    ),
    variants=(
        *controls(views=(192,)),
        *ladder(OUTLINES, (2.0, 3.0, 4.0, 5.0)),
        *ladder(REGIONS, (2.0, 3.0, 4.0, 5.0)),
        *ladder(JUNCTIONS, (7.0, 8.0, 9.0)),
        Variant(role="falsifier", kind=RUNS),
    ),
)
