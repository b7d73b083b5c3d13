# SPDX-License-Identifier: Apache-2.0
"""Base of suites whose queries begin as pictures: the flight, the rendered frames, and what is believed of cameras."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import cache
from typing import TYPE_CHECKING, Final

import numpy as np

from sasgeo_bench.geometry.grid import Grid
from sasgeo_bench.geometry.pose import Pose
from sasgeo_bench.regions.evidence import UNKNOWN, Evidence
from sasgeo_bench.sensing.accumulation import Errors, believed_steps, steps_between
from sasgeo_bench.sensing.camera import Attitude, Camera, Mount
from sasgeo_bench.sensing.intrinsics import Intrinsics
from sasgeo_bench.sensing.rendering.conditions import Conditions, draw_conditions
from sasgeo_bench.sensing.rendering.scene import Scene as Painted
from sasgeo_bench.sensing.rendering.scene import make_scene
from sasgeo_bench.sensing.rendering.view import labels, render
from sasgeo_bench.tasks.frame_evidence import poses_before
from sasgeo_bench.tasks.frames import Frame, FrameLabels, encode_webp
from sasgeo_bench.tasks.query import PAINTED, PERCEIVED, Detector
from sasgeo_bench.tasks.suites.base import Draft, Shot, Suite, Variant

if TYPE_CHECKING:
    from sasgeo_bench.sensing.rendering.palettes import Family

LENS: Final = Intrinsics.from_field_of_view(horizontal_deg=64.0, width_px=768, height_px=768)  # 1.25 x the height wide
HEIGHT_M: Final = 160.0  # of ordinary pictures: 200 m wide, a view of 192 m
ATTITUDE_SIGMA_DEG: Final = 1.0
# Roll and pitch of a survey drone that flies 8 to 12 m/s at 80 m, each: the tilt then has a median of 9.6 and a 95th
# percentile of 20 degrees, where 9.6 and 21.5 were measured (MARS-LVIG).
BODY_SIGMA_DEG: Final = 8.2
ODOMETRY: Final = Errors(position_share=0.01, yaw_deg_per_km=2.0)  # a nominal visual-inertial odometry
_FINEST_M, _COARSEST_M = 0.25, 1.0
_VIEW: Final = Pose(easting_m=0.0, northing_m=0.0, yaw_deg=0.0)
# Stops of a flight around the last one, by which a view of twice the picture's width is covered.
_AROUND: Final = ((-1, -1), (0, -1), (1, -1), (1, 0), (1, 1), (0, 1), (-1, 1), (-1, 0), (0, 0))
_STOP_M: Final = 46.0
STOPS_M: Final = tuple((_STOP_M * right, _STOP_M * ahead) for right, ahead in _AROUND)


@dataclass(frozen=True, slots=True, kw_only=True)
class Flight:
    """How the pictures of one variant are taken.

    Parameters
    ----------
    height_m : float
        Believed height above the ground. The true one is that times the scale of the site's view.
    tilt_deg : float
        Of the camera's mount, ahead.
    is_fixed : bool
        The camera takes part in roll and pitch of the body, as measured; otherwise it is stabilized.
    stops_m : sequence of (right, ahead)
        Where frames are taken against the last one, oldest first, which is (0, 0).
    odometry : Errors
        Of the way between the frames.
    relief : float
        Multiplies the heights of buildings.
    conditions : callable
        Changes the ordinary conditions of the site.
    """

    height_m: float = HEIGHT_M
    tilt_deg: float = 0.0
    is_fixed: bool = False
    stops_m: Sequence[tuple[float, float]] = ((0.0, 0.0),)
    odometry: Errors = ODOMETRY
    relief: float = 1.0
    conditions: Callable[[Conditions], Conditions] = field(default=lambda ordinary: ordinary)


@dataclass(frozen=True, slots=True, kw_only=True)
class Stand:
    """One camera: as it was, in the CRS of the map, and as it is believed to have been, in the frame of the view."""

    true: Camera
    believed: Camera
    position_sigma_m: float
    yaw_sigma_deg: float


@dataclass(frozen=True, kw_only=True)
class PictureSuite(Suite):
    """A suite whose stress is in how pictures are taken: `flight` of each variant.

    A site's weather, light and errors of attitude are the same in all variants, so that they differ by the stress
    alone; the noise of the sensor differs, so that a falsifier is another picture of the same.
    """

    flight: Callable[[Variant], Flight]

    @property
    def is_pictured(self) -> bool:
        """Return True."""
        return True

    @property
    def detectors(self) -> tuple[Detector, ...]:
        """Return the families of looks, and models of perception of the same views, which hold no pictures."""
        return (*PAINTED, *PERCEIVED)

    def draw(self, shot: Shot) -> Draft:
        """Take the pictures of a shot; their evidence is unknown until a segmenter has seen them.

        A model of perception takes none: it is what the same view would be worth without camera and segmenter.
        """
        if shot.variant.detector in PERCEIVED:
            return Draft(evidence=shot.perceived())
        variant, flight = shot.variant, self.flight(shot.variant)
        of_weather = (shot.flight_seeds or shot.seeds).rng("conditions")
        conditions = flight.conditions(draw_conditions(of_weather, season="summer"))
        painted = _painted(shot, flight)
        stands = stands_of(shot, flight)
        rng = shot.rng("sensor", variant.name)
        pictures = [render(painted, stand.true, conditions, rng) for stand in stands]
        found = [labels(painted, stand.true, season=conditions.season) for stand in stands]
        state = shot.scene.world
        is_there = "building" in state.classes
        share = float((found[-1][state.classes.index("building")] == 1).mean()) if is_there else 0.0
        return Draft(
            evidence=_unseen(state.classes, variant.view_cells, variant.cell_size_m),
            frames=tuple(
                Frame(
                    picture=encode_webp(picture),
                    camera=stand.believed,
                    height_sigma_m=round(flight.height_m * self.card.group.scale_sigma, 2),
                    attitude_sigma_deg=ATTITUDE_SIGMA_DEG,
                    position_sigma_m=stand.position_sigma_m,
                    yaw_sigma_deg=stand.yaw_sigma_deg,
                )
                for stand, picture in zip(stands, pictures, strict=True)
            ),
            labels=tuple(FrameLabels.of(state.classes, item) for item in found),
            measured={
                "frames": float(len(pictures)),
                "gsd_m": round(flight.height_m / LENS.focal_px[0], 3),
                "tilt_deg": round(stands[-1].true.tilt_deg, 2),
                "brightness": round(float(np.mean(pictures)) / 255, 3),
                "contrast": round(float(np.std(pictures[-1])) / 255, 3),
                "hidden_share": round(float((found[-1] == UNKNOWN).mean()), 4),
                "building_share": round(share, 4),
            },
        )


@cache
def _unseen(classes: tuple[str, ...], size_cells: int, cell_size_m: float) -> Evidence:
    """Return evidence that is all unknown, the same for all views: many are in memory at once."""
    cells = np.full((len(classes), size_cells, size_cells), UNKNOWN, dtype=np.uint8)
    return Evidence(classes=classes, cells=cells, cell_size_m=cell_size_m)


def stands_of(shot: Shot, flight: Flight) -> list[Stand]:
    """Return where the cameras of a shot stood, and where they are believed to have stood, oldest first."""
    flown = [Pose(easting_m=right_m, northing_m=ahead_m, yaw_deg=0.0) for right_m, ahead_m in flight.stops_m]
    said = poses_before(believed_steps(steps_between(flown), flight.odometry, shot.seeds.rng("odometry")))
    # The newest frame's are drawn alike in all variants.
    angles_deg = shot.seeds.rng("attitude").standard_normal((len(STOPS_M), 4))[len(STOPS_M) - len(flown) :]
    found = []
    for stop, place, drawn in zip(flown, said, angles_deg, strict=True):
        body = BODY_SIGMA_DEG * drawn[:2] if flight.is_fixed else np.zeros(2)
        # 60 degrees of tilt of optical axes: the middle of a view must be seen
        tilt_deg, roll_deg = min(flight.tilt_deg + float(body[0]), 60.0), float(body[1])
        off = (ATTITUDE_SIGMA_DEG * drawn[2:]).tolist()
        distance_m = math.hypot(stop.easting_m, stop.northing_m)
        found.append(
            Stand(
                true=_camera(flight, shot.site.pose, stop, tilt_deg + off[0], roll_deg + off[1]),
                believed=_camera(flight, _VIEW, place, tilt_deg, roll_deg),
                position_sigma_m=round(flight.odometry.position_share * distance_m, 3),
                yaw_sigma_deg=round(flight.odometry.yaw_deg_per_km * math.sqrt(distance_m / 1000), 3),
            )
        )
    return found


def _camera(flight: Flight, view: Pose, stop: Pose, tilt_deg: float, roll_deg: float) -> Camera:
    """Return the camera of a stop, given in the axes of the view's frame; `view` puts that on the map."""
    # The middle of the view is where the optical axis of the last camera should point.
    ahead_m = flight.height_m * math.tan(math.radians(flight.tilt_deg))
    east_m, north_m = view.to_map(np.array([(stop.easting_m, stop.northing_m - ahead_m)]))[0].tolist()
    return Camera.mounted(
        intrinsics=LENS,
        east_m=east_m,
        north_m=north_m,
        height_m=flight.height_m * view.scale,
        body=Attitude(roll_deg=roll_deg, pitch_deg=tilt_deg, yaw_deg=view.yaw_deg + stop.yaw_deg),
        mount=Mount(),
    )


def _painted(shot: Shot, flight: Flight) -> Painted:
    """Return the painted window of a shot, from the scene's store if it was painted just before."""
    scene, site, variant = shot.scene, shot.site, shot.variant
    family: Family = "shifted" if variant.detector == "shifted" else scene.looks[site.block]
    # Half the side of the window that is painted: the view in any heading, and what a tilted camera sees
    stops = max(math.dist(stop, (0.0, 0.0)) for stop in flight.stops_m)
    half_picture_m = flight.height_m * LENS.width_px / LENS.focal_px[0] / math.sqrt(2)
    tilted = flight.tilt_deg > 0 or flight.is_fixed
    reach_m = round(1.1 * max(variant.side_m / math.sqrt(2), half_picture_m + stops) * (1.5 if tilted else 1.0), 1)
    pixel_m = flight.height_m / LENS.focal_px[0]
    cell_m = min(max(pixel_m * 1.4, _FINEST_M), _COARSEST_M)  # cells of paint in a pixel, about
    key = (site.en_m, family, flight.relief, flight.height_m, reach_m, round(cell_m, 3))
    if key not in scene.painted:
        while len(scene.painted) >= 2:  # painted windows
            scene.painted.pop(next(iter(scene.painted)))
        side = 2 * math.ceil(reach_m / cell_m)
        window = Grid(
            epsg=scene.world.grid.epsg,
            west_m=site.pose.easting_m - side / 2 * cell_m,
            north_m=site.pose.northing_m + side / 2 * cell_m,
            cell_size_m=cell_m,
            rows=side,
            cols=side,
        )
        state = scene.world
        made = make_scene(
            state.features,
            state.classes,
            state.coverage,
            place=scene.map.region.split("@")[0],
            window=window,
            family=family,
            relief=flight.relief,
        )
        # 0.75 of the flight's height: whoever flies there flies above everything
        scene.painted[key] = replace(made, below_m=0.75 * flight.height_m)
    return scene.painted[key]
