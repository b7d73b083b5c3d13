# SPDX-License-Identifier: Apache-2.0
"""How a detector fails, by class, as data; and how well one did, as an F1 score."""

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Self

import numpy as np

from sasgeo_bench.errors import PerturbError
from sasgeo_bench.regions.evidence import PRESENT, UNKNOWN, Evidence
from sasgeo_bench.tasks.perturbations.base import check_ranges
from sasgeo_bench.tasks.perturbations.fields import dilated
from sasgeo_bench.tasks.perturbations.objects import thin_classes

TOLERANCE_CELLS = 1.5  # the eight neighbours


@dataclass(frozen=True, slots=True, kw_only=True)
class ClassErrors:
    """How a detector fails on one class.

    Parameters
    ----------
    f1 : float
        Score in domain, pixel by pixel; of thin classes with one cell of tolerance.
    confused_with : str, optional
        Class it is taken for.
    confused : float
        Share of the lost cells that are taken for that class rather than for nothing.
    dropped, frayed : float
        Shares of what is lost that go by whole objects and at the edge; the rest goes in patches. Areas only.
    usual_share : float
        Share of a usual view the class covers; says how much of it is seen where none is.
    width_m : float
        Width of a false line; thin classes only.
    """

    f1: float
    confused_with: str | None = None
    confused: float = 0.0
    dropped: float = 0.4
    frayed: float = 0.4
    usual_share: float = 0.01
    width_m: float = 3.0

    def __post_init__(self) -> None:
        """Refuse what is no share."""
        check_ranges(self, f1=(0, 1), confused=(0, 1), dropped=(0, 1), frayed=(0, 1), usual_share=(0, 1))
        check_ranges(self, width_m=(0.1, 100))


def _openearthmap() -> Mapping[str, ClassErrors]:
    """Scores of U-Net-EfficientNet-B4 where OpenEarthMap has the class: building, road, water, tree, agriculture.

    Path, railway, hedge, coastline, bridge and car park are no classes of it: those scores are set by hand, below the
    road's for what is thinner and at or above it for what is wider. So are all shares but the scores.
    """
    return {
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
        "field_boundary": ClassErrors(
            f1=0.60, confused_with="path_track", confused=0.1, usual_share=0.004, width_m=1.5
        ),
        "bridge": ClassErrors(f1=0.77, usual_share=0.0005, width_m=6.0),
        "parking": ClassErrors(f1=0.77, confused_with="road_minor", confused=0.2, usual_share=0.01, dropped=0.3),
    }


@dataclass(frozen=True, slots=True, kw_only=True)
class PerceptionSettings:
    """The errors of a detector, as data.

    Parameters
    ----------
    classes : mapping of str to ClassErrors
        By class; one that is missing here is seen without error. Those of OpenEarthMap unless given.
    edge_m, patch_m, gap_m : float
        How wide the errors are: raggedness of edges, patches, gaps along lines; metres.
    stub_m : float
        Mean length of a false line, metres.
    spread : float
        How much the error differs from view to view and class to class, as a coefficient of variation.
    seen_anywhere : float
        Share of the false alarms that come whether or not the class is in view.
    """

    classes: Mapping[str, ClassErrors] = field(default_factory=_openearthmap)
    edge_m: float = 4.0
    patch_m: float = 12.0
    gap_m: float = 12.0
    stub_m: float = 25.0
    spread: float = 0.3
    seen_anywhere: float = 0.2

    def __post_init__(self) -> None:
        """Refuse sizes that are none, and a class taken for itself."""
        check_ranges(self, edge_m=(0.1, 1e3), patch_m=(0.1, 1e3), gap_m=(0.1, 1e3), stub_m=(1, 1e3))
        check_ranges(self, spread=(0, 2), seen_anywhere=(0, 1))
        wrong = [name for name, errors in self.classes.items() if errors.confused_with == name]
        if wrong:
            message = f"PerceptionSettings: {wrong[0]!r} is taken for itself, name another class in confused_with"
            raise PerturbError(message)

    @classmethod
    def with_f1(cls, **f1: float) -> Self:
        """Those of OpenEarthMap with other scores for some classes.

        Examples
        --------
        >>> PerceptionSettings.with_f1(building=0.7).classes["building"].f1
        0.7
        """
        usual = _openearthmap()
        unknown = sorted(set(f1) - set(usual))
        if unknown:
            message = f"PerceptionSettings: no class {unknown[0]!r}, there are {', '.join(usual)}"
            raise PerturbError(message)
        return cls(
            classes={**usual, **{name: dataclasses.replace(usual[name], f1=value) for name, value in f1.items()}}
        )


@dataclass(frozen=True, slots=True, kw_only=True)
class Agreement:
    """How a class as it was seen agrees with the class as it is: counts of cells, which add up over views.

    Examples
    --------
    >>> (Agreement(true=8, found=6, seen=8, right=6) + Agreement(true=2, found=0, seen=2, right=0)).f1
    0.6
    """

    true: int = 0
    found: int = 0
    seen: int = 0
    right: int = 0

    def __add__(self, other: "Agreement") -> "Agreement":
        """Counts of both."""
        return Agreement(
            true=self.true + other.true,
            found=self.found + other.found,
            seen=self.seen + other.seen,
            right=self.right + other.right,
        )

    @property
    def f1(self) -> float:
        """Harmonic mean of recall (found of true) and precision (right of seen); nan where there is neither."""
        if not self.true and not self.seen:
            return float("nan")
        recall = self.found / self.true if self.true else 0.0
        precision = self.right / self.seen if self.seen else 0.0
        return 2 * recall * precision / (recall + precision) if recall + precision else 0.0


def agreement(before: Evidence, after: Evidence, class_name: str) -> Agreement:
    """Count, among the cells that both views know, what was found and what is right.

    Areas are compared cell by cell. Of thin classes a cell counts as found, or right, if one of the class lies there or
    on one of the eight cells around it.
    """
    was, now = before.layer(class_name), after.layer(class_name)
    known = (was != UNKNOWN) & (now != UNKNOWN)
    true, seen = (was == PRESENT) & known, (now == PRESENT) & known
    near_true, near_seen = true, seen
    if class_name in thin_classes():
        near_true, near_seen = dilated(true, TOLERANCE_CELLS), dilated(seen, TOLERANCE_CELLS)
    counts = (int(np.count_nonzero(mask)) for mask in (true, true & near_seen, seen, seen & near_true))
    return Agreement(**dict(zip(("true", "found", "seen", "right"), counts, strict=True)))


def measured_f1(before: Evidence, after: Evidence, class_name: str) -> float:
    """F1 score of one class in a perturbed view against the clean one; `agreement` says how cells are compared.

    Examples
    --------
    >>> cells = np.array([[[1, 1, 0, 0]]], dtype=np.uint8)
    >>> view = Evidence(classes=("water",), cells=cells, cell_size_m=1.0)
    >>> measured_f1(view, view.replace(cells[:, :, ::-1].copy()), "water")
    0.0
    >>> measured_f1(view, view, "water")
    1.0
    """
    return agreement(before, after, class_name).f1
