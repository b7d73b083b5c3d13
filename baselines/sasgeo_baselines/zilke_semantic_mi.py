# SPDX-License-Identifier: Apache-2.0
"""`zilke_semantic_mi`: normalized mutual information of the labels of view and map (Zilke 2025)."""

from itertools import product
from typing import Final

import numpy as np
from numpy.typing import NDArray

from sasgeo_baselines.shift_matcher import ShiftMatcher
from sasgeo_bench import PRESENT, UNKNOWN, Chart, Evidence, MatcherCard, Overlaps, Region, load_taxonomy

# Where several classes hold in a cell the first is its label: what is small or thin before what covers ground.
_OF: Final = load_taxonomy().groups
LABELS: Final = (
    _OF["building"],
    (*_OF["street"], *_OF["bridge"], "parking"),
    (*_OF["railway"], *_OF["path"]),
    _OF["water"],
    (*_OF["green"], *_OF["field"]),
)
NAMES: Final = (*(group[0] for group in LABELS), "rest")  # known cells without a label
_NOTHING: Final = 1e-9


class ZilkeSemanticMi(ShiftMatcher):
    """Normalized mutual information over the joint histogram of labels, at every place and heading."""

    open_numbers = {"coarse_m": (4.0, 6.0, 8.0), "least_share": (0.25, 0.5)}
    chosen = {"coarse_m": 6.0, "least_share": 0.25}

    card = MatcherCard(
        name="zilke_semantic_mi",
        version="1",
        title="Mutual information of the labels of view and map",
        source=(
            "Zilke et al. 2025, as the SASGeo paper (Trukhina and Vashkelis) describes it: semantic map data for the "
            "localization of UAVs. Its text was not found. Normalized mutual information: Studholme, Hill and Hawkes, "
            "Pattern Recognition 1999"
        ),
        ours=(
            "All but that idea: five groups of classes and the rest are the labels of a cell; (H(view) + H(map)) / "
            "H(view, map) of the cells with a label, or known, on both sides, from correlations of all pairs of "
            "labels; which label of the view belongs to which of the map is not assumed; a place of which the map "
            f"knows less than {chosen['least_share']:g} of what the view knows has no score; the map in cells of "
            f"{chosen['coarse_m']:g} m, then half as wide, headings in steps of 3, then 0.75 degrees, of 2.5 standard "
            "deviations of the prior; scale 1; no filter"
        ),
        licence="Apache-2.0",
        tracks=("retrieval", "localization"),
        limits=(
            "By that description no graph, no sequence, no weights by what lasts, no rejection; a cell has one label; "
            "views of few labels say little; no confidence"
        ),
    )

    def chart_of(self, region: Region) -> Chart:
        """Return the labels of the map, one to a known cell."""
        known = region.known()
        left, degree = known.copy(), np.zeros((len(NAMES), *region.grid.shape), dtype=np.uint8)
        for group, into in zip(LABELS, degree, strict=False):
            for name in (one for one in group if one in region.classes):
                into[(region.layer(name) == PRESENT) & left] = 255
            left &= into == 0
        degree[-1][left] = 255
        return Chart(grid=region.grid, classes=NAMES, degree=degree, known=known.astype(np.uint8) * np.uint8(255))

    def shared(self, evidence: Evidence, chart: Chart) -> list[str]:
        """Return all labels of the map; none where no class of the view makes one."""
        has_label = any(name in evidence.classes for group in LABELS for name in group)
        return list(chart.classes) if has_label else []

    def channels(self, evidence: Evidence, names: tuple[str, ...]) -> NDArray[np.float32]:
        """Return the labels of the view, one to a cell that is known in all classes or present in one."""
        del names
        left = np.ones(evidence.shape, dtype=bool)
        found = np.zeros((len(NAMES), *evidence.shape), dtype=np.float32)
        for group, into in zip(LABELS, found, strict=False):
            for name in (one for one in group if one in evidence.classes):
                into[(evidence.layer(name) == PRESENT) & left] = 1
            left &= into == 0
        found[-1] = left & (evidence.cells != UNKNOWN).all(axis=0)
        return found

    def score(self, overlaps: Overlaps, names: tuple[str, ...]) -> NDArray[np.float32]:
        """Return the normalized mutual information."""
        seen = range(len(overlaps.seen))
        joint = np.stack([np.maximum(overlaps.sums(*pair), 0) for pair in product(seen, range(len(names)))])
        joint = joint.reshape(len(seen), len(names), *overlaps.places)
        total = joint.sum(axis=(0, 1))
        share = total / max(1.0, float(overlaps.totals.sum()))
        joint /= np.maximum(total, _NOTHING)
        both = _entropy(joint.reshape(-1, *overlaps.places))
        view, mapped = _entropy(joint.sum(axis=1)), _entropy(joint.sum(axis=0))
        found = np.where(both > _NOTHING, (view + mapped) / np.maximum(both, _NOTHING), 1.0)
        return np.where(share >= self.numbers["least_share"], found, -np.inf).astype(np.float32)


def _entropy(shares: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return the entropy over the first axis, nats."""
    return np.asarray(-(shares * np.log(np.maximum(shares, np.float32(_NOTHING)))).sum(axis=0))
