# SPDX-License-Identifier: Apache-2.0
"""`vecmap_phasecorr`: whitened correlation of weighted signed distances, class by class (VecMapLocNet)."""

import json
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import lru_cache
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from sasgeo_baselines.learned import read_learned, sound
from sasgeo_baselines.shift_matcher import ShiftMatcher
from sasgeo_bench import PRESENT, UNKNOWN, Chart, Evidence, MatcherCard, Overlaps, Pose, Query, Region, Training

FULL: Final = 255
SHARP_CELLS: Final = 1.0  # standard deviation of the low-pass, in cells
MOST_EXAMPLES: Final = 120
_NOTHING: Final = 1e-12


class VecmapPhasecorr(ShiftMatcher):
    """Sum over classes of whitened correlations, at every place and heading."""

    open_numbers = {
        "reach_m": (8.0, 16.0, 32.0),  # where distances are truncated
        "whitening": (0.5, 1.0),  # exponent of the modulus that a spectrum is divided by: 1 is phase alone
    }
    chosen = {"reach_m": 8.0, "whitening": 0.5}

    card = MatcherCard(
        name="vecmap_phasecorr",
        version="1",
        title="Whitened correlation of signed distances, class by class",
        source=(
            "Wang et al., VecMapLocNet, ISPRS Journal 225, 2025: weighted map elements and a matcher in the Fourier "
            "domain without parameters, as its abstract describes them"
        ),
        ours=(
            f"Channels are signed distances to the rim of each class, truncated at {chosen['reach_m']:g} m, of view "
            "and map, in place of two learned encoders; the cross-power spectrum of each class over its modulus to "
            f"the power {chosen['whitening']:g} (1 is phase alone), times a Gaussian of one cell; a class weighs by "
            "how far its own correlation stands out at true places of training, in standard deviations of the places "
            "within 150 m, 1 without training; the map in cells of 4 m, then 2 m, headings in steps of 3, then 0.75 "
            "degrees, of 2.5 standard deviations of the prior"
        ),
        licence="Apache-2.0",
        tracks=("retrieval", "localization"),
        limits=(
            "The source has three degrees of freedom: scale is 1; no sequence, weights are static, no rejection; what "
            "is unknown has the mean distance of its class, and beyond the map all classes count as far away; that "
            "spectra are whitened is ours, not known of the source; no confidence"
        ),
    )

    def chart_of(self, region: Region) -> Chart:
        """Return the signed distances of the map as degrees: 1 deep within a class, 0 far from it."""
        known = region.known()
        degree = np.zeros((len(region.classes), *region.grid.shape), dtype=np.uint8)
        for name, into in zip(region.classes, degree, strict=True):
            present = (region.layer(name) == PRESENT) & known
            if present.any():  # a class that the map lacks stays 0, and is not used
                into[:] = self._signed(present, known, region.grid.cell_size_m)
        return Chart(
            grid=region.grid,
            classes=region.classes,
            degree=degree,
            known=known.astype(np.uint8) * np.uint8(255),
        )

    def read(self, region: Region, learned: str | None) -> None:
        """Read the map and the weights."""
        self.weights: Mapping[str, float] = {} if learned is None else read_learned(self.card.name, learned, _weights)
        super().read(region, None)

    def channels(self, evidence: Evidence, names: tuple[str, ...]) -> NDArray[np.float32]:
        """Return the signed distances of the view, less their mean over known cells, 0 where it is unknown."""
        found = np.zeros((len(names), *evidence.shape), dtype=np.float32)
        for name, into in zip(names, found, strict=True):
            layer = evidence.layer(name)
            known = layer != UNKNOWN
            if known.any():
                distance = self._signed(layer == PRESENT, known, evidence.cell_size_m)
                into[known] = (distance[known] - distance[known].mean(dtype=np.float64)) / FULL
        return found

    def _signed(self, present: NDArray[np.bool_], known: NDArray[np.bool_], cell_m: float) -> NDArray[np.uint8]:
        return signed(present, known, cell_m, reach_m=self.numbers["reach_m"])

    def score(self, overlaps: Overlaps, names: tuple[str, ...]) -> NDArray[np.float32]:
        """Return the weighted sum of phase correlations."""
        weights = [self.weights.get(name, 1.0) for name in names]
        return phases(overlaps, weights, whitening=self.numbers["whitening"])

    def learn(self, training: Training) -> str:
        """Return weights by how far each class stands out at the true places of views, as JSON."""
        found: dict[str, list[float]] = {}
        pairs = [pair for pair in training.pairs if pair[0].track == "localization" and pair[1].pose is not None]
        step = max(1, len(pairs) // MOST_EXAMPLES)
        chosen = sorted(pairs[::step], key=lambda pair: pair[0].region)
        at = ""
        for query, truth in chosen:
            if query.region != at:
                at = query.region
                self.prepare(training.regions[at], None)
            for name, lead in () if truth.pose is None else self._leads(query, truth.pose).items():
                found.setdefault(name, []).append(lead)
        means = {name: max(0.0, float(np.mean(leads))) for name, leads in sorted(found.items())}
        scale = float(np.mean(list(means.values()))) if means else 0.0
        return json.dumps({name: round(mean / scale, 4) for name, mean in means.items()} if scale > 0 else {})

    def _leads(self, query: Query, pose: Pose) -> dict[str, float]:
        """Return by how many standard deviations the true place stands out for each class, at the true heading."""
        found: dict[str, float] = {}

        def note(overlaps: Overlaps, names: tuple[str, ...]) -> NDArray[np.float32]:
            """Note the leads in place of a score."""
            middle = overlaps.places[-1] // 2
            for at, name in enumerate(names):
                alone = [float(other == at) for other in range(len(names))]
                scores = phases(overlaps, alone, whitening=self.numbers["whitening"])
                near = scores[..., middle - 1 : middle + 2, middle - 1 : middle + 2].max()
                found[name] = float((near - scores.mean()) / max(float(scores.std()), _NOTHING))
            return np.zeros(overlaps.places, dtype=np.float32)

        known = replace(query.prior, yaw_deg=pose.yaw_deg, yaw_sigma_deg=0.01)
        search = self.look(replace(query, prior=known))
        if search is not None:
            names = tuple(search.chart.classes[band] for band in search.bands.tolist())
            plan = replace(search.plan, around_m=150.0)  # places that a class is held against while weights are learned
            replace(search, plan=plan, score=lambda overlaps: note(overlaps, names)).candidates([pose])
        return found


def _weights(saved: dict[str, float]) -> dict[str, float]:
    """Return the learned weights; raise where they are none."""
    return sound(dict(saved), is_sound=all(0 <= weight < np.inf for weight in saved.values()))


def phases(overlaps: Overlaps, weights: Sequence[float], *, whitening: float) -> NDArray[np.float32]:
    """Return the sum of whitened correlations of like channels by their weights, at each place.

    Spectra are divided by a power of their modulus: with 0 it is plain correlation, with 1 phase alone.

    A constant that is added to a channel of the map changes nothing where the view sums to 0:

    >>> rng = np.random.default_rng(0)
    >>> town = rng.random((1, 12, 12)).astype(np.float32)
    >>> seen = town[:, 3:8, 4:9] - town[:, 3:8, 4:9].mean()
    >>> found = phases(Overlaps.of(seen, town, places=(8, 8)), [1.0], whitening=1.0)
    >>> np.unravel_index(int(found.argmax()), found.shape)
    (np.int64(3), np.int64(4))
    """
    total = np.zeros(overlaps.mapped.shape[1:], dtype=np.complex64)
    for at, weight in enumerate(weights):
        if weight > 0:
            cross = overlaps.cross(at, at)
            modulus = np.maximum(np.abs(cross), np.float32(_NOTHING))
            total += np.float32(weight) * cross / modulus ** np.float32(whitening)
    return overlaps.back(np.asarray(total * lowpass(len(overlaps.seen[0]))))


@lru_cache(maxsize=8)
def lowpass(size: int) -> NDArray[np.float32]:
    """Return a Gaussian of `SHARP_CELLS` in the frequencies of a square of real numbers, (size, size / 2 + 1)."""
    down, across = np.fft.fftfreq(size)[:, None], np.fft.rfftfreq(size)[None, :]
    found = np.exp(-2 * (np.pi * SHARP_CELLS) ** 2 * (down**2 + across**2)).astype(np.float32)
    found.flags.writeable = False
    return np.asarray(found)


def signed(present: NDArray[np.bool_], known: NDArray[np.bool_], cell_m: float, *, reach_m: float) -> NDArray[np.uint8]:
    """Return signed distances to the rim of what is present, 0 far outside to `FULL` deep inside; the mean if unknown.

    >>> row = np.arange(60) < 30
    >>> signed(row[None], np.ones((1, 60), dtype=bool), 1.0, reach_m=16.0)[0, [0, 20, 29, 30, 59]].tolist()
    [255, 207, 135, 120, 0]
    """
    inside, outside = (_distance(mask) for mask in (present, ~present))
    share = np.clip(0.5 + (inside - outside) * cell_m / (2 * reach_m), 0.0, 1.0)
    found = np.rint(FULL * share).astype(np.uint8)  # in whole steps, for distances are not the same twice
    if known.any() and not known.all():
        found[~known] = np.rint(found[known].mean(dtype=np.float64))
    return np.asarray(found)


def _distance(mask: NDArray[np.bool_]) -> NDArray[np.float32]:
    """Return how far each marked cell lies from the next one that is not, cells; far if there is none."""
    if mask.all():
        return np.full(mask.shape, np.inf, dtype=np.float32)
    return np.asarray(cv2.distanceTransform(mask.astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_PRECISE))
