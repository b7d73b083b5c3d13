# SPDX-License-Identifier: Apache-2.0
"""`ubev_template`: templates of several height layers, matched separately, then summed (U-BEV)."""

from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from sasgeo_baselines.shift_matcher import ShiftMatcher, overlap
from sasgeo_bench import PRESENT, UNKNOWN, Evidence, MatcherCard, Overlaps

TALL: Final = "building"  # the class that stands up from the ground
# Of a roof over that of the camera. A view of 192 m is taken from about 160 m: 0, 8 (houses) and 24 m (blocks).
HEIGHTS: Final = (0.0, 0.05, 0.15)


class UbevTemplate(ShiftMatcher):
    """Mean overlap of ground layers and of the layer of buildings, which is matched once for each height of roofs."""

    open_numbers = {
        "least_share": (0.25, 0.5, 0.75),  # of the view's known cells that the map must know
        "coarse_m": (4.0, 6.0),
    }
    chosen = {"least_share": 0.75, "coarse_m": 4.0}

    card = MatcherCard(
        name="ubev_template",
        version="1",
        title="Templates of ground and roof layers, matched separately",
        source=(
            "Boscolo Camiletto et al., U-BEV: Height-aware Bird's-Eye-View Segmentation and Neural Map-based "
            "Relocalization, arXiv 2310.13766, as its abstract describes it, for cars and from street level: the "
            "ground is seen in several layers of height, and the result is matched with a map by templates"
        ),
        ours=(
            "Heights are hypotheses, as neither view nor map tells them: roofs at 0, 5 and 15 % of the camera's "
            "height lean outwards from the middle of the view, so that the layer of buildings is drawn inwards by as "
            "much to lie on footprints. Each layer is a template by itself (intersection over union of a class over "
            "cells known on both sides); those of buildings are averaged to one class, then all classes of view or "
            f"map; a place of which the map knows less than {chosen['least_share']:g} of what the view knows has no "
            f"score; cells of {chosen['coarse_m']:g} m, then half as wide, headings 4, then 1 degree apart within 2.5 "
            "standard deviations"
        ),
        licence="Apache-2.0",
        tracks=("retrieval", "localization"),
        limits=(
            "The camera is taken to look straight down on the middle of the view, so that an orthographic view gets "
            "nothing but blur from the upper layers; all buildings of a layer have one height; scale is 1; no "
            "sequence, no weights by what lasts, no rejection; what is unknown is left out of both sides; no "
            "confidence; three layers of roofs, each a template, take more time than one"
        ),
    )

    # 4 degrees: half of it moves the rim of a view by less than a cell of 4 m: more layers, fewer headings
    yaw_step_deg = 4.0

    def channels(self, evidence: Evidence, names: tuple[str, ...]) -> NDArray[np.float32]:
        """Return the presence of each layer, then where each is known, then where any class is."""
        present, known = zip(*(layer for name in names for layer in layers_of(evidence, name)), strict=True)
        any_known = (evidence.cells != UNKNOWN).any(axis=0).astype(np.float32)
        return np.stack([*present, *known, any_known])

    def score(self, overlaps: Overlaps, names: tuple[str, ...]) -> NDArray[np.float32]:
        """Return the mean of intersection over union."""
        ground, at = len(names), 0  # the last channel of the map is where it is known
        total, classes = (np.zeros(overlaps.places, dtype=np.float32) for _ in range(2))
        sheets = (len(overlaps.totals) - 1) // 2
        for band, name in enumerate(names):
            heights = len(HEIGHTS) if name == TALL else 1
            over = [overlap(overlaps, layer, sheets + layer, band, ground) for layer in range(at, at + heights)]
            is_there = over[0][1]  # footprints are seen or mapped
            total += is_there * sum(share for share, _ in over) / np.float32(heights)
            classes += is_there
            at += heights
        share = overlaps.sums(2 * sheets, ground) / max(1.0, float(overlaps.totals[-1]))
        is_known = share >= self.numbers["least_share"]
        return np.where(is_known, total / np.maximum(classes, 1), -np.inf).astype(np.float32)


def layers_of(evidence: Evidence, name: str) -> list[tuple[NDArray[np.float32], NDArray[np.float32]]]:
    """Return presence and knowledge of a class on the ground, one pair for each height at which it may stand."""
    layer = evidence.layer(name)
    present, known = (layer == PRESENT).astype(np.float32), (layer != UNKNOWN).astype(np.float32)
    if name != TALL:
        return [(present, known)]
    return [(drawn_in(present, height), drawn_in(known, height)) for height in HEIGHTS]


def drawn_in(layer: NDArray[np.float32], height: float) -> NDArray[np.float32]:
    """Return the ground below roofs of a height (over that of the camera): all comes nearer to the middle of the view.

    A roof of height h that is seen r from the middle stands on ground at r (1 - h / H). Beyond the rim it is 0.

    >>> row = np.zeros((1, 11), dtype=np.float32); row[0, 10] = 1
    >>> drawn_in(row, 0.2)[0].round(1).tolist()
    [0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0]
    """
    if height == 0:
        return layer
    rows, cols = layer.shape
    share = 1.0 - height
    to_ground = np.array([[share, 0, height * (cols - 1) / 2], [0, share, height * (rows - 1) / 2]])
    found = cv2.warpAffine(layer, to_ground, (cols, rows), flags=cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT)
    return np.asarray(found, dtype=np.float32)
