# SPDX-License-Identifier: Apache-2.0
"""Seasons: changes of a view by leaves, snow, drought and harvest, class by class."""

from dataclasses import dataclass
from typing import Final, get_args

import cv2
import numpy as np
from numpy.typing import NDArray

from sasgeo_bench.core.errors import PerturbError
from sasgeo_bench.osm.taxonomy import Season as Kind
from sasgeo_bench.osm.taxonomy import load_taxonomy
from sasgeo_bench.regions.evidence import ABSENT, PRESENT, UNKNOWN, Evidence
from sasgeo_bench.tasks.perturbations.base import (
    Field,
    Mask,
    check_ranges,
    dilated,
    find_objects,
    highest,
    smooth_noise,
    top_share,
    with_cells,
)
from sasgeo_bench.tasks.perturbations.streams import Streams

Layers = dict[str, NDArray[np.uint8]]

# Classes that a season changes, or hides.
CHANGED: Final[dict[Kind, tuple[str, ...]]] = {kind: load_taxonomy().touched_by(kind) for kind in get_args(Kind)}


_PATCH_M: Final = 25.0  # width of the patches that change; fields change as a whole


_RETREAT_M: Final = 12.0  # of the waterline at strength 1, from a gentle bank


@dataclass(frozen=True, kw_only=True)
class Season:
    """See the ground in a season that the map does not know.

    `leaf_on`: paths, minor roads, streams and hedges within green disappear. `snow`: paths and field boundaries
    disappear, fields, green, car parks and bare ground become unknown. `low_water`: the waterline retreats, streams
    fall dry. `harvest`: fields look like green, some green looks like fields, boundaries between them disappear.

    `strength`, 0 to 1, is the fraction that changes of what the season can change; of 12 m for the retreat of the
    waterline.
    """

    kind: Kind
    strength: float

    def __post_init__(self) -> None:
        check_ranges(self, strength=(0, 1))
        if self.kind not in get_args(Kind):
            raise PerturbError(f"Season: kind is one of {', '.join(get_args(Kind))}, got {self.kind!r}")

    def __call__(self, evidence: Evidence, rng: np.random.Generator, /) -> Evidence:
        """Change the layers that the season changes."""
        if self.strength == 0:
            return evidence
        cells = evidence.cells.copy()
        layers = dict(zip(evidence.classes, cells, strict=True))
        noise = smooth_noise(evidence.shape, _PATCH_M / evidence.cell_size_m, rng)
        if self.kind == "leaf_on":
            _clear(layers, CHANGED[self.kind], _strongest(noise, _of(layers, "green"), self.strength))
        elif self.kind == "snow":
            white = top_share(noise, self.strength)
            _clear(layers, load_taxonomy().touched_by(self.kind, "lost"), white)
            for name in load_taxonomy().touched_by(self.kind, "unknown"):
                if name in layers:
                    layers[name][white] = UNKNOWN
        elif self.kind == "low_water":
            self._dry(layers, noise, evidence.cell_size_m)
        else:
            self._harvest(layers, noise, Streams(rng))
        return with_cells(evidence, cells)

    def _dry(self, layers: Layers, noise: Field, cell_size_m: float) -> None:
        """Move the waterline inwards, more where the noise is strong, as from a gentle bank."""
        water = _of(layers, "water")
        if water.any():
            # Water continues outside the view, so the edge of the view is no bank.
            from_bank_m = cv2.distanceTransform(water.view(np.uint8), cv2.DIST_L2, 3) * cell_size_m
            gentle = np.clip(1 + noise / 2, 0.2, 2.0)
            _clear(layers, ("water",), water & (from_bank_m <= self.strength * _RETREAT_M * gentle))
        # A line within a lake or broad river does not fall dry before the water around it.
        _clear(layers, ("waterway",), _strongest(noise, _of(layers, "waterway") & ~water, self.strength))

    def _harvest(self, layers: Layers, noise: Field, streams: Streams) -> None:
        """Exchange fields and green, each parcel as a whole, and remove the boundaries between them."""
        boundary = _of(layers, "field_boundary")
        farmland, green = _of(layers, "farmland"), _of(layers, "green")
        mown = _some_parcels(farmland, boundary, self.strength, streams.of("farmland"))
        # Green that fills the view is a wood or a mountain side, not a field.
        meadows = green & ~farmland
        # 0.25: largest meadow of the view
        # 0.3: ratio of the fraction of green that looks like fields to that of fields that look like green
        grown = _some_parcels(meadows, boundary, self.strength * 0.3, streams.of("green"), most=0.25)
        for name, gained, lost in (("green", mown, grown), ("farmland", grown, mown)):
            if name in layers:
                layers[name][lost] = ABSENT
                layers[name][gained] = PRESENT
        _clear(layers, ("field_boundary",), _strongest(noise, boundary, self.strength))


def _of(layers: Layers, name: str) -> Mask:
    if name in layers:
        return np.asarray(layers[name] == PRESENT)
    return np.zeros(next(iter(layers.values())).shape, dtype=bool)


def _clear(layers: Layers, names: tuple[str, ...], mask: Mask) -> None:
    for name in names:
        if name in layers:
            layers[name][mask] = ABSENT


def _strongest(noise: Field, mask: Mask, share: float) -> Mask:
    return mask & (noise >= highest(noise[mask], share * np.count_nonzero(mask)))


def _some_parcels(mask: Mask, boundary: Mask, share: float, rng: np.random.Generator, *, most: float = 1.0) -> Mask:
    """Choose parcels between boundaries with probability `share`; return them with their boundary cells."""
    # Parcels that cover more than `most` of the view are never chosen.
    parcels = find_objects(mask & ~boundary)
    is_chosen = (rng.random(len(parcels.areas_cells)) < share) & (parcels.areas_cells <= most * mask.size)
    chosen = parcels.mask_of(is_chosen)
    return dilated(chosen, 1.5) & mask & (chosen | boundary)
