# SPDX-License-Identifier: Apache-2.0
"""`schmidt_segcorr`: soft intersection over union of the segmented view and the map, class by class (Schmidt 2025)."""

from typing import Final

import numpy as np
from numpy.typing import NDArray

from sasgeo_baselines.shift_matcher import ShiftMatcher, overlap
from sasgeo_bench import PRESENT, UNKNOWN, Evidence, MatcherCard, Overlaps

FULL: Final = 255  # of a confidence


class SchmidtSegcorr(ShiftMatcher):
    """Mean over classes of intersection over union, at every place and heading."""

    open_numbers = {
        "least_share": (0.25, 0.5, 0.75),  # of the view's known cells that the map must know
        "coarse_m": (4.0, 6.0),
    }
    chosen = {"least_share": 0.75, "coarse_m": 6.0}

    card = MatcherCard(
        name="schmidt_segcorr",
        version="1",
        title="Overlap of the segmented view with the map, class by class",
        source=(
            "Schmidt et al. 2025, as the SASGeo paper (Trukhina and Vashkelis) describes it: semantic segmentation of "
            "UAV views held against OpenStreetMap. Its text was not found"
        ),
        ours=(
            "All but that idea: intersection over union of each class, weighed by the detector's confidence where the "
            "view has one, over cells known on both sides; the mean over the classes that view or map hold there; a "
            f"place of which the map knows less than {chosen['least_share']:g} of what the view knows has no score; "
            f"the map in cells of {chosen['coarse_m']:g} m, then half as wide, headings in steps of 3, then 0.75 "
            "degrees, of 2.5 standard deviations of the prior; no fit between cells; scale 1; no filter"
        ),
        licence="Apache-2.0",
        tracks=("retrieval", "localization"),
        limits=(
            "By that description no graph, no sequence, no weights by what lasts, no rejection; what is unknown is "
            "left out of both sides; thin classes overlap little where they lie a few metres off; no confidence"
        ),
    )

    def channels(self, evidence: Evidence, names: tuple[str, ...]) -> NDArray[np.float32]:
        """Return the degree of each class, then where each is known, then where any is."""
        at = [evidence.classes.index(name) for name in names]
        cells = evidence.cells[at]
        degree = (cells == PRESENT).astype(np.float32)
        if evidence.confidence is not None:
            degree *= evidence.confidence[at].astype(np.float32) / FULL
        known = (cells != UNKNOWN).astype(np.float32)
        return np.concatenate([degree, known, known.max(axis=0, keepdims=True)])

    def score(self, overlaps: Overlaps, names: tuple[str, ...]) -> NDArray[np.float32]:
        """Return the mean of intersection over union."""
        count = len(names)  # the last channel of the map is where it is known
        total, classes = (np.zeros(overlaps.places, dtype=np.float32) for _ in range(2))
        for at in range(count):
            over, is_there = overlap(overlaps, at, count + at, at, count)
            total += over
            classes += is_there
        share = overlaps.sums(2 * count, count) / max(1.0, float(overlaps.totals[-1]))
        is_known = share >= self.numbers["least_share"]
        return np.where(is_known, total / np.maximum(classes, 1), -np.inf).astype(np.float32)
