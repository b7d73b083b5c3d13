# SPDX-License-Identifier: Apache-2.0
"""Suites of corrupted pictures: corrupted, of rendered ones, and corrupted-real, cut out of the imagery of a region."""

from dataclasses import dataclass, replace
from typing import Final

from sasgeo_bench.geometry.pose import Pose
from sasgeo_bench.sensing.corruptions import COMPOUNDS, CORRUPTIONS, SEVERITIES, corrupt
from sasgeo_bench.sensing.image import Picture
from sasgeo_bench.tasks.pictured_ground import Cut, PicturedGround
from sasgeo_bench.tasks.query import PriorGroup
from sasgeo_bench.tasks.suites.base import MAIN_VIEW_CELLS, Scene, Suite, SuiteCard, Variant, ViewRequest
from sasgeo_bench.tasks.suites.pictures import Flight, PictureSuite
from sasgeo_bench.tasks.suites.real_image import SIDES_M, TURNED, RealImageSuite

COMPOUND: Final = "compound"
# Kinds of stress by the corruptions that they are: "weather fog", ..., "compound fog + camera shake"
KINDS: Final = {f"{one.family} {name}": name for name, one in CORRUPTIONS.items()} | {
    f"{COMPOUND} {name}": name for name in COMPOUNDS
}


def corrupted(shot: ViewRequest, picture: Picture) -> Picture:
    """Return the picture of a shot as its variant corrupts it; of one kind, all severities draw the same numbers."""
    name = KINDS.get(shot.variant.kind)
    if name is None:
        return picture
    rng = shot.seeds.rng("corruption", shot.variant.kind)
    return corrupt(picture, name, severity=int(shot.variant.strength), rng=rng)


@dataclass(frozen=True, kw_only=True)
class CorruptedRealSuite(RealImageSuite):
    """Views of 192 m out of the imagery of a region, at the sites of real views, corrupted."""

    def refusal(self, group: PriorGroup) -> str | None:
        """Return None: there is one disc, which a user may choose."""
        return Suite.refusal(self, group)

    def fitting(self, largest_m: float | None) -> tuple[Variant, ...]:
        """Return all variants, with views of 192 m or of the next smaller side that a region allows."""
        fit = [side_m for side_m in SIDES_M if side_m <= min(self.main_side_m, largest_m or self.main_side_m)]
        return tuple(replace(item, view_cells=round(max(fit, default=min(SIDES_M)))) for item in self.variants)

    def usable(self, scene: Scene) -> tuple[Variant, ...]:  # noqa: ARG002
        """Return all variants: they have one side, and search one map."""
        return self.variants

    def cuts(self, shot: ViewRequest, pictured: PicturedGround, pose: Pose) -> tuple[list[Cut], list[Pose]]:
        """Return the picture of a shot, corrupted, with the labels of the ground; and where it is taken."""
        cuts, believed = super().cuts(shot, pictured, pose)
        return [replace(cut, rgb=corrupted(shot, cut.rgb)) for cut in cuts], believed


def _variants(falsifier: str) -> tuple[Variant, ...]:
    stresses = [
        Variant(role="stress", kind=kind, strength=float(severity)) for kind in KINDS for severity in SEVERITIES
    ]
    return (
        Variant(role="control", kind="control", view_cells=MAIN_VIEW_CELLS),
        *stresses,
        Variant(role="falsifier", kind=falsifier),
    )


_SEPARATES: Final = "Segmenters by the faults of pictures that they bear: of weather, motion, sensor or compression."
_UNIT: Final = "severity, 1 to 3"

CORRUPTED: Final = PictureSuite(
    card=SuiteCard(
        name="corrupted",
        version=1,
        title="Corrupted pictures (P7)",
        what="A picture from 160 m under each of 19 corruptions (weather, motion, sensor, compression), and of 8 that "
        "compound two or three families, at three severities; a segmenter makes the evidence.",
        separates=_SEPARATES,
        falsifier="Another picture without corruption: scores as in the control.",
        strength_unit=_UNIT,
    ),
    variants=_variants("no corruption"),
    flight=lambda _: Flight(),
    change=corrupted,
)
CORRUPTED_REAL: Final = CorruptedRealSuite(
    card=SuiteCard(
        name="corrupted-real",
        version=1,
        title="Corrupted real pictures (R6)",
        what="A view of 192 m cut out of the imagery of a region, under the 27 corruptions of `corrupted`, at three "
        "severities; a segmenter makes the evidence.",
        separates=_SEPARATES,
        falsifier="The picture turned by 90, 180 or 270 deg, without corruption: scores as in the control.",
        strength_unit=_UNIT,
        needs=("imagery",),
        min_density=0.01,
    ),
    variants=_variants(TURNED),
)
