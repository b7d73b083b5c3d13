# SPDX-License-Identifier: Apache-2.0
"""Suite `real-image`: views cut out of real aerial imagery, against the map as it is and against a worse one."""

from dataclasses import dataclass, replace
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from sasgeo_bench.geometry.pose import Pose
from sasgeo_bench.regions.evidence import PRESENT, UNKNOWN, Evidence
from sasgeo_bench.regions.imagery import Imagery
from sasgeo_bench.sensing.camera import Attitude, Camera, Mount
from sasgeo_bench.sensing.intrinsics import Intrinsics
from sasgeo_bench.tasks.frames import Frame, FrameLabels, encode_webp
from sasgeo_bench.tasks.query import REAL, Detector, Role
from sasgeo_bench.tasks.suites.base import Draft, Scene, Shot, Suite, SuiteCard, Variant

CELL_M: Final = 0.5
SIDES_M: Final = (128.0, 96.0, 64.0)
DEGRADED: Final = "R2 degraded map"
_VIEW: Final = "R1 view"
_TURNED: Final = "turned picture"
_PICTURE: Final = 1.25  # times the view's side is what a picture shows
_MOST_PX: Final = 768
_HEIGHT_M: Final = 2000.0  # of the camera that a mosaic stands for: from there nothing leans
_UNKNOWN_BIT: Final = np.uint32(1 << 31)


@dataclass(frozen=True, kw_only=True)
class RealImageSuite(Suite):
    """Views out of the imagery of a region: turned, scaled, at the resolution of the mosaic or a coarser one."""

    @property
    def is_pictured(self) -> bool:
        """Return True."""
        return True

    @property
    def detectors(self) -> tuple[Detector, ...]:
        """Return that pictures are real."""
        return (REAL,)

    def lack(self, scene: Scene) -> str | None:
        """Return that there is no imagery, or what any suite lacks."""
        if scene.imagery is None:
            return "no real imagery ([[imagery]] in its region file)"
        return super().lack(scene)

    def spacing_m(self, scene: Scene) -> float:  # noqa: ARG002
        """Return the diagonal of the largest view: views of two sites share no ground, however they are turned."""
        return float(np.sqrt(2)) * max(variant.side_m for variant in self.variants)

    def usable(self, scene: Scene) -> tuple[Variant, ...]:  # noqa: ARG002
        """Return the variants, each once, where a region allows small views alone."""
        control_m = max(variant.side_m for variant in self.variants)
        sides = [replace(item, strength=item.side_m) if item.role == "stress" else item for item in self.variants]
        return tuple(item for item in dict.fromkeys(sides) if item.kind != _VIEW or item.side_m < control_m)

    def map_region(self, scene: Scene, variant: Variant) -> str:
        """Return the degraded map for its variants."""
        return scene.others[0].region if variant.kind == DEGRADED else scene.map.region

    def draw(self, shot: Shot) -> Draft:
        """Cut the picture of a shot; its evidence is unknown until a segmenter has seen it."""
        variant, state, imagery = shot.variant, shot.scene.world, shot.scene.imagery
        if imagery is None:
            raise ValueError(f"{state.region} has no imagery")
        pose = _pose(shot)
        width_px = min(_MOST_PX, round(_PICTURE * variant.side_m / imagery.record.gsd_m))
        pixel_m = _PICTURE * variant.side_m / width_px
        # Easting and northing of each pixel, shape (H, W, 2)
        right = (np.arange(width_px) + 0.5 - width_px / 2) * pixel_m
        across, ahead = np.meshgrid(right, -right)
        ground_m = pose.to_map(np.stack((across.ravel(), ahead.ravel()), axis=1)).reshape(width_px, width_px, 2)
        picture, is_known = _cut(imagery, ground_m)
        # What the map says of each pixel, shape (C, H, W): UNKNOWN beyond its ground or the imagery
        row, col = state.grid.to_cells(ground_m.reshape(-1, 2)).T
        inside = (row >= 0) & (row < state.grid.rows) & (col >= 0) & (col < state.grid.cols)
        bits = np.full(len(row), _UNKNOWN_BIT)
        bits[inside] = state.bits.bits[row[inside], col[inside]]
        states = [(bits >> np.uint32(at) & np.uint32(1)).astype(np.uint8) for at in range(len(state.classes))]
        found = np.stack(states).reshape(-1, *is_known.shape)
        found[:, ((bits & _UNKNOWN_BIT) > 0).reshape(is_known.shape) | ~is_known] = UNKNOWN
        cells = np.full((len(state.classes), variant.view_cells, variant.view_cells), UNKNOWN, dtype=np.uint8)
        frame = Frame(
            picture=encode_webp(picture),
            camera=_camera(pixel_m, width_px),
            height_sigma_m=round(_HEIGHT_M * self.card.group.scale_sigma, 2),
        )
        return Draft(
            evidence=Evidence(classes=state.classes, cells=cells, cell_size_m=variant.cell_size_m),
            frames=(frame,),
            labels=(FrameLabels.of(state.classes, found),),
            pose=pose if pose is not shot.site.pose else None,
            measured={
                "gsd_m": round(pixel_m, 3),
                "pictured_share": round(float(is_known.mean()), 4),
                "building_share": round(float((found == PRESENT).any(axis=0).mean()), 4),
            },
        )


def _pose(shot: Shot) -> Pose:
    """Return where the picture of a shot is taken: the falsifier's is turned by a quarter to three quarters."""
    site = shot.site.pose
    if shot.variant.kind != _TURNED:
        return site
    turn_deg = float(shot.seeds.rng("turn").uniform(90.0, 270.0))
    return Pose(
        easting_m=site.easting_m,
        northing_m=site.northing_m,
        yaw_deg=(site.yaw_deg + turn_deg) % 360,
        scale=site.scale,
    )


def _camera(pixel_m: float, width_px: int) -> Camera:
    focal_px, centre_px = _HEIGHT_M / pixel_m, width_px / 2
    return Camera.mounted(
        intrinsics=Intrinsics(
            width_px=width_px,
            height_px=width_px,
            focal_px=(focal_px, focal_px),
            centre_px=(centre_px, centre_px),
        ),
        east_m=0.0,
        north_m=0.0,
        height_m=_HEIGHT_M,
        body=Attitude(roll_deg=0.0, pitch_deg=0.0, yaw_deg=0.0),
        mount=Mount(),
    )


def _cut(imagery: Imagery, ground_m: NDArray[np.float64]) -> tuple[NDArray[np.uint8], NDArray[np.bool_]]:
    """Return the picture of some ground, shape (H, W, 3), and where the imagery shows it, shape (H, W)."""
    pixel_m = float(np.hypot(*(ground_m[0, 1] - ground_m[0, 0])))
    low, high = ground_m.min(axis=(0, 1)) - 2 * pixel_m, ground_m.max(axis=(0, 1)) + 2 * pixel_m
    bounds_m = (float(low[0]), float(low[1]), float(high[0]), float(high[1]))
    window = imagery.read(bounds_m, gsd_m=max(pixel_m, imagery.record.gsd_m))
    uv = (window.grid.to_uv(ground_m.reshape(-1, 2)) - 0.5).astype(np.float32).reshape(ground_m.shape)
    picture = cv2.remap(window.rgb, uv[..., 0], uv[..., 1], cv2.INTER_LINEAR)
    known = cv2.remap(window.is_known.view(np.uint8), uv[..., 0], uv[..., 1], cv2.INTER_NEAREST)
    return np.asarray(picture, dtype=np.uint8), np.asarray(known > 0)


def _variant(role: Role, kind: str, side_m: float) -> Variant:
    return Variant(role=role, kind=kind, view_cells=round(side_m / CELL_M), cell_size_m=CELL_M)


SUITE: Final = RealImageSuite(
    card=SuiteCard(
        name="real-image",
        version=1,
        title="Real pictures (R)",
        what="Views of 128, 96 and 64 m cut out of the imagery of a region, turned and scaled, against its map as it "
        "is (R1) and without 20 % of its roofs, the others 1.5 m off (R2); a segmenter makes the evidence.",
        separates="What is learned from rendered pictures from what real ones need.",
        falsifier="The picture turned by 90 to 270 deg: scores as in the control.",
        strength_unit="m, the side of the view",
        needs=("imagery", "degraded map"),
    ),
    variants=(
        _variant("control", "control", SIDES_M[0]),
        *(_variant("stress", _VIEW, side_m) for side_m in SIDES_M[1:]),
        *(_variant("stress", DEGRADED, side_m) for side_m in SIDES_M),
        _variant("falsifier", _TURNED, SIDES_M[0]),
    ),
)
