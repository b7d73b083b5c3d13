# SPDX-License-Identifier: Apache-2.0
"""The errors of a detector by class, as data."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final

TOLERANCE_CELLS: Final = 1.5  # the eight neighbours
EDGE_M: Final = 4.0  # width of ragged edges
PATCH_M: Final = 12.0  # width of patches
GAP_M: Final = 12.0  # width of gaps along lines
STUB_M: Final = 25.0  # mean length of a false line
SPREAD: Final = 0.3  # coefficient of variation of the error over views and classes
SEEN_ANYWHERE: Final = 0.2  # fraction of the false alarms that occur whether or not the class is in view


@dataclass(frozen=True, slots=True, kw_only=True)
class ClassErrors:
    """Errors of a detector on one class.

    Parameters
    ----------
    f1 : float
        Score in domain, pixel by pixel; for line classes with one cell of tolerance.
    confused_with : str, optional
        Class that it is confused with.
    confused : float
        Fraction of the lost cells that become that class; the others become absent.
    dropped, frayed : float
        Fractions of the lost cells that go by whole objects and at edges; the others go in patches. Areas only.
    usual_share : float
        Fraction of a usual view that the class covers; sets the false alarms in views without it.
    width_m : float
        Width of a false line; line classes only.
    """

    f1: float
    confused_with: str | None = None
    confused: float = 0.0
    dropped: float = 0.4
    frayed: float = 0.4
    usual_share: float = 0.01
    width_m: float = 3.0


# Building, road, water, tree and agriculture have the scores of U-Net-EfficientNet-B4 on OpenEarthMap. The others are
# not in it: their scores are set by hand, below that of roads for thinner classes, at or above it for wider ones.
# Everything but the scores is set by hand too. A class that is not in this table is seen without error.
ERRORS: Final[Mapping[str, ClassErrors]] = {
    "road_major": ClassErrors(f1=0.77, confused_with="road_minor", confused=0.3, usual_share=0.02, width_m=7.0),
    "road_minor": ClassErrors(f1=0.77, confused_with="parking", confused=0.2, usual_share=0.05, width_m=4.5),
    "path_track": ClassErrors(f1=0.65, confused_with="field_boundary", confused=0.1, usual_share=0.01, width_m=2.0),
    "railway": ClassErrors(f1=0.77, confused_with="path_track", confused=0.1, usual_share=0.003),
    "building": ClassErrors(f1=0.89, confused_with="parking", confused=0.15, usual_share=0.12, dropped=0.5),
    "water": ClassErrors(f1=0.92, confused_with="green", confused=0.2, usual_share=0.05, dropped=0.2),
    "waterway": ClassErrors(f1=0.77, confused_with="path_track", confused=0.1, usual_share=0.008),
    "coastline": ClassErrors(f1=0.85, usual_share=0.0),
    "green": ClassErrors(f1=0.82, confused_with="farmland", confused=0.3, usual_share=0.15, dropped=0.3),
    "farmland": ClassErrors(f1=0.87, confused_with="green", confused=0.5, usual_share=0.10, dropped=0.2),
    "field_boundary": ClassErrors(f1=0.60, confused_with="path_track", confused=0.1, usual_share=0.004, width_m=1.5),
    "bridge": ClassErrors(f1=0.77, usual_share=0.0005, width_m=6.0),
    "parking": ClassErrors(f1=0.77, confused_with="road_minor", confused=0.2, usual_share=0.01, dropped=0.3),
}
