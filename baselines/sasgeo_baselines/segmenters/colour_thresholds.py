# SPDX-License-Identifier: Apache-2.0
"""`colour_thresholds`: colour indices of each pixel against fixed limits, the floor of all segmenters."""

from typing import Final

import cv2
import numpy as np

import sasgeo_bench as sgb
from sasgeo_baselines.segmenters.features import FINEST_M, Plane, ground_pixel_m, has_data

_MOST: Final = 0.9  # no index is surer than this


class ColourThresholds:
    """Green where a pixel is greener than red and blue, water where it is bluish and dark, roofs where it is bright."""

    card = sgb.SegmenterCard(
        name="colour_thresholds",
        version="1",
        title="Colour indices with fixed limits",
        source="Excess green: Woebbecke et al., Transactions of the ASAE 38, 1995; the other limits are guesses",
        ours="Nothing is learned; limits were set once, by eye; a chance rises with the index around its limit",
        licence="Apache-2.0",
        classes=("building", "water", "green"),
        limits="Knows neither texture nor shape: bare ground and roads are roofs, shadows are water, snow is all roofs",
    )

    def segment(self, image: sgb.AerialImage, *, learned: str | None) -> sgb.Segmentation:  # noqa: ARG002 - it learns nothing
        """Return chances of three classes; silent on patches of pure black or white."""
        gsd_m = ground_pixel_m(image)
        pixel_m = gsd_m if np.isfinite(gsd_m) else FINEST_M
        bands = np.asarray(image.rgb, dtype=np.float32) / 255
        # 0.5 m: standard deviation of the Gaussian before any index
        smooth = cv2.GaussianBlur(bands, (0, 0), max(0.3, 0.5 / pixel_m))
        found = np.stack(_chances(np.asarray(smooth, dtype=np.float32)))
        found[:, ~has_data(image.rgb, pixel_m)] = np.nan
        return sgb.Segmentation.of_probabilities(self.card.classes, found)


def _chances(bands: Plane) -> tuple[Plane, Plane, Plane]:
    """Return the chances of a roof, of water and of something green, shape (H, W) each, of bands in 0..1."""
    light = bands.mean(axis=2)
    # 0.05 is added to a sum of bands: the colour of black is noise
    red, green, blue = bands.transpose(2, 0, 1) / (bands.sum(axis=2) + 0.05)
    greener, bluer = 2 * green - red - blue, blue - red
    building = np.minimum(light - 0.62, 0.05 - greener)
    water = np.minimum(bluer - 0.08, 0.4 - light)
    return _slope(building), _slope(water), _slope(greener - 0.06)


def _slope(beyond: Plane) -> Plane:
    # 25: log-odds for each unit of an index beyond its limit
    return np.asarray(_MOST / (1 + np.exp(-25.0 * beyond)) + (1 - _MOST) / 2, dtype=np.float32)
