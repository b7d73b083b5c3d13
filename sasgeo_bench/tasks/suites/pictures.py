# SPDX-License-Identifier: Apache-2.0
"""Suites of rendered pictures: aerial, accumulated, light, oblique, overlap-scale-tilt, relief and season-image."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Final

import numpy as np
from numpy.typing import NDArray

from sasgeo_bench.geometry.grid import Grid
from sasgeo_bench.geometry.pose import Pose
from sasgeo_bench.regions.evidence import UNKNOWN
from sasgeo_bench.sensing.accumulation import Errors, believed_steps, steps_between
from sasgeo_bench.sensing.camera import Attitude, Camera, Intrinsics, Mount
from sasgeo_bench.sensing.image import Picture
from sasgeo_bench.sensing.rendering.conditions import Conditions, Sun, draw_conditions
from sasgeo_bench.sensing.rendering.scene import Scene as Painted
from sasgeo_bench.sensing.rendering.scene import make_scene
from sasgeo_bench.sensing.rendering.seasons import Season
from sasgeo_bench.sensing.rendering.view import render_labelled
from sasgeo_bench.tasks.frame_evidence import poses_before, unseen
from sasgeo_bench.tasks.frames import Frame, FrameLabels, encode_webp
from sasgeo_bench.tasks.query import PAINTED, PERCEIVED, Detector
from sasgeo_bench.tasks.suites.base import MAIN_VIEW_CELLS, QueryDraft, Scene, Suite, SuiteCard, Variant, ViewRequest

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
AROUND: Final = ((-1, -1), (0, -1), (1, -1), (1, 0), (1, 1), (0, 1), (-1, 1), (-1, 0), (0, 0))
_STOP_M: Final = 46.0
STOPS_M: Final = tuple((_STOP_M * right, _STOP_M * ahead) for right, ahead in AROUND)


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
    overlap : float
        Share of the view, 0 to 1, that shows ground of the map. Beside it the picture shows its own other side the
        wrong way round: ground such as there is, but nowhere on the map.
    conditions : callable
        Changes the ordinary conditions of the site.
    """

    height_m: float = HEIGHT_M
    tilt_deg: float = 0.0
    is_fixed: bool = False
    stops_m: Sequence[tuple[float, float]] = ((0.0, 0.0),)
    odometry: Errors = ODOMETRY
    relief: float = 1.0
    overlap: float = 1.0
    conditions: Callable[[Conditions], Conditions] = field(default=lambda ordinary: ordinary)


@dataclass(frozen=True, slots=True, kw_only=True)
class CameraBelief:
    """One camera: as it was, in the CRS of the map, and as it is believed to have been, in the frame of the view."""

    true: Camera
    believed: Camera
    position_sigma_m: float
    yaw_sigma_deg: float


@dataclass(frozen=True, kw_only=True)
class PictureSuite(Suite):
    """A suite whose stress is in how pictures are taken, `flight` of each variant, or in their `change` afterwards.

    A site's weather, light and errors of attitude are the same in all variants, so that they differ by the stress
    alone; the noise of the sensor differs, so that a falsifier is another picture of the same.
    """

    flight: Callable[[Variant], Flight]
    change: Callable[[ViewRequest, Picture], Picture] = field(default=lambda _, taken: taken)

    @property
    def is_pictured(self) -> bool:
        """Return True."""
        return True

    @property
    def detectors(self) -> tuple[Detector, ...]:
        """Return the families of looks, and models of perception of the same views, which hold no pictures."""
        return (*PAINTED, *PERCEIVED)

    def draw(self, shot: ViewRequest) -> QueryDraft:
        """Take the pictures of a shot; their evidence is unknown until a segmenter has seen them.

        A model of perception takes none: it is what the same view would be worth without camera and segmenter.
        """
        variant, flight = shot.variant, self.flight(shot.variant)
        if variant.detector in PERCEIVED:
            clean = shot.clean()
            return QueryDraft(evidence=shot.perceived(clean.replace(_overlapping(shot, flight, clean.cells, axis=2))))
        of_weather = (shot.flight_seeds or shot.seeds).rng("conditions")
        conditions = flight.conditions(draw_conditions(of_weather, season="summer"))
        painted = _painted(shot, flight)
        beliefs = camera_beliefs(shot, flight)
        rng = shot.rng("sensor", variant.name)
        wider = flight.height_m * LENS.width_px / LENS.focal_px[0] / variant.side_m
        taken = [render_labelled(painted, belief.true, conditions, rng) for belief in beliefs]
        pictures = [self.change(shot, _overlapping(shot, flight, rgb, axis=1, wider=wider)) for rgb, _ in taken]
        found = [_overlapping(shot, flight, planes, axis=2, wider=wider) for _, planes in taken]
        state = shot.scene.world
        is_there = "building" in state.classes
        share = float((found[-1][state.classes.index("building")] == 1).mean()) if is_there else 0.0
        return QueryDraft(
            evidence=unseen(state.classes, variant.view_cells, variant.cell_size_m),
            frames=tuple(
                Frame(
                    picture=encode_webp(picture),
                    camera=belief.believed,
                    height_sigma_m=round(flight.height_m * self.card.group.scale_sigma, 2),
                    attitude_sigma_deg=ATTITUDE_SIGMA_DEG,
                    position_sigma_m=belief.position_sigma_m,
                    yaw_sigma_deg=belief.yaw_sigma_deg,
                )
                for belief, picture in zip(beliefs, pictures, strict=True)
            ),
            labels=tuple(FrameLabels.of(state.classes, item) for item in found),
            measured={
                "frames": float(len(pictures)),
                "gsd_m": round(flight.height_m / LENS.focal_px[0], 3),
                "tilt_deg": round(beliefs[-1].true.tilt_deg, 2),
                "brightness": round(float(np.mean(pictures)) / 255, 3),
                "contrast": round(float(np.std(pictures[-1])) / 255, 3),
                "hidden_share": round(float((found[-1] == UNKNOWN).mean()), 4),
                "building_share": round(share, 4),
            },
        )


def _overlapping(
    shot: ViewRequest, flight: Flight, seen: NDArray[np.uint8], *, axis: int, wider: float = 1.0
) -> NDArray[np.uint8]:
    """Return what is seen, mirrored along an axis beyond a share of the view; `wider` is its width in views."""
    if flight.overlap == 1.0:
        return seen
    share = (np.arange(seen.shape[axis]) + 0.5) / seen.shape[axis]
    is_own = share < 0.5 + (flight.overlap - 0.5) / wider
    if shot.seeds.rng("overlap").random() < 0.5:  # the left side is lost instead
        is_own = is_own[::-1]
    return np.where(np.expand_dims(is_own, [at for at in range(seen.ndim) if at != axis]), seen, np.flip(seen, axis))


_MOST_TILT_DEG: Final = 60.0  # of optical axes: the middle of a view must be seen


def camera_beliefs(shot: ViewRequest, flight: Flight) -> list[CameraBelief]:
    """Return where the cameras of a shot stood, and where they are believed to have stood, oldest first."""
    flown = [Pose(easting_m=right_m, northing_m=ahead_m, yaw_deg=0.0) for right_m, ahead_m in flight.stops_m]
    believed = poses_before(believed_steps(steps_between(flown), flight.odometry, shot.seeds.rng("odometry")))
    # The newest frame's are drawn alike in all variants.
    angles_deg = shot.seeds.rng("attitude").standard_normal((len(STOPS_M), 4))[len(STOPS_M) - len(flown) :]
    found = []
    for stop, place, drawn in zip(flown, believed, angles_deg, strict=True):
        body = BODY_SIGMA_DEG * drawn[:2] if flight.is_fixed else np.zeros(2)
        # 60 degrees of tilt of optical axes: the middle of a view must be seen
        tilt_deg, roll_deg = min(flight.tilt_deg + float(body[0]), _MOST_TILT_DEG), float(body[1])
        off = (ATTITUDE_SIGMA_DEG * drawn[2:]).tolist()
        distance_m = math.hypot(stop.easting_m, stop.northing_m)
        found.append(
            CameraBelief(
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


def _painted(shot: ViewRequest, flight: Flight) -> Painted:
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
        # 0.75 of the flight's height: a flight there is above everything
        scene.painted[key] = replace(made, below_m=0.75 * flight.height_m)
    return scene.painted[key]


HEIGHTS_M: Final = {80.0: 96, 160.0: MAIN_VIEW_CELLS, 320.0: 384, 500.0: 384}  # and the cells of their views


def _aerial_flight(variant: Variant) -> Flight:
    return Flight(height_m=variant.strength or HEIGHT_M)


AERIAL: Final = PictureSuite(
    card=SuiteCard(
        name="aerial",
        version=1,
        title="Pictures from straight above (P1)",
        what="A stabilized camera looks straight down from 80, 160, 320 or 500 m; a segmenter makes the evidence.",
        separates="Segmenters, and matchers that bear their errors, by what a pixel still resolves.",
        falsifier="Another picture from the control's height: scores as in the control.",
        strength_unit="m above the ground",
    ),
    variants=(
        Variant(role="control", kind="control"),
        *(
            Variant(role="stress", kind="P1 height", strength=height_m, view_cells=cells)
            for height_m, cells in HEIGHTS_M.items()
            if height_m != HEIGHT_M
        ),
        Variant(role="falsifier", kind="same height"),
    ),
    flight=_aerial_flight,
)


FRAMES: Final = (3.0, 9.0)
FRAME, DRIFT = "P6 frames", "P6 drift"
_STANDING: Final = "standing still"


_HEIGHT_M: Final = 80.0


def _accumulated_flight(variant: Variant) -> Flight:
    count, plain = int(variant.strength) or 1, Flight(height_m=_HEIGHT_M)
    if variant.kind == _STANDING:
        return replace(plain, stops_m=((0.0, 0.0),) * len(STOPS_M))
    bad = 5.0 if variant.kind == DRIFT else 1.0  # 5 times the drift
    return replace(
        plain,
        stops_m=STOPS_M[-count:],
        odometry=Errors(position_share=bad * ODOMETRY.position_share, yaw_deg_per_km=bad * ODOMETRY.yaw_deg_per_km),
    )


ACCUMULATED: Final = PictureSuite(
    card=SuiteCard(
        name="accumulated",
        version=1,
        title="Accumulated frames (P6)",
        what="One frame from 80 m shows a quarter of the view; 3 and 9 frames around it are laid together by odometry "
        "that drifts by 1 % and 2 deg per km (P6 frames), or by one five times as bad (P6 drift).",
        separates="What more frames give back from what their drift takes.",
        falsifier="Nine frames from one place: no more ground is seen than in the control.",
        strength_unit="frames",
    ),
    variants=(
        Variant(role="control", kind="one frame"),
        *(Variant(role="stress", kind=kind, strength=count) for kind in (FRAME, DRIFT) for count in FRAMES),
        Variant(role="falsifier", kind=_STANDING),
    ),
    flight=_accumulated_flight,
)


STRENGTHS: Final = (0.3, 0.6, 1.0)
SUN, HAZE, DUSK = "P4 sun", "P4 haze", "P4 dusk"
_CLEAR: Final = Conditions(sun=Sun(elevation_deg=50.0, azimuth_deg=160.0))
_LOWEST_DEG, _DARKEST_DEG, _THICKEST_M, _THINNEST_M = 5.0, -8.0, 500.0, 30_000.0


def _light_flight(variant: Variant) -> Flight:
    return Flight(conditions=lambda ordinary: _lit(ordinary, variant))


def _lit(ordinary: Conditions, variant: Variant) -> Conditions:
    """Return clear weather with a high sun, or what a kind makes of it; the rest as on the site."""
    high, share = _CLEAR.sun.elevation_deg, variant.strength
    lowest = {SUN: _LOWEST_DEG, DUSK: _DARKEST_DEG}.get(variant.kind, high)
    sun = replace(_CLEAR.sun, elevation_deg=high + share * (lowest - high))
    if variant.kind == DUSK:  # all of the ladder is around sunset
        sun = replace(_CLEAR.sun, elevation_deg=_LOWEST_DEG + share * (_DARKEST_DEG - _LOWEST_DEG))
    thick_m = _THICKEST_M if variant.kind == HAZE else _THINNEST_M
    visibility_m = _THINNEST_M * (thick_m / _THINNEST_M) ** share
    return replace(ordinary, sun=sun, cloud=0.0, visibility_m=visibility_m)


LIGHT: Final = PictureSuite(
    card=SuiteCard(
        name="light",
        version=1,
        title="Light and air (P4)",
        what="A low sun with long shadows (P4 sun), haze (P4 haze), and dusk to night (P4 dusk).",
        separates="Segmenters by the light in which they still see.",
        falsifier="Another picture in the control's light: scores as in the control.",
        strength_unit="share of the way to the worst",
    ),
    variants=(
        Variant(role="control", kind="control"),
        *(Variant(role="stress", kind=kind, strength=share) for kind in (SUN, HAZE, DUSK) for share in STRENGTHS),
        Variant(role="falsifier", kind="same light"),
    ),
    flight=_light_flight,
)


TILTS_DEG: Final = (15.0, 30.0, 50.0)
TILT, BODY = "P2 tilt", "P2 body"


def _oblique_flight(variant: Variant) -> Flight:
    if variant.kind == BODY:
        return Flight(is_fixed=True)
    return Flight(tilt_deg=variant.strength)


OBLIQUE: Final = PictureSuite(
    card=SuiteCard(
        name="oblique",
        version=1,
        title="Oblique pictures (P2)",
        what="The camera's mount tilts by 15, 30 or 50 deg ahead (P2 tilt), or the camera is fixed to a body that "
        "rolls and pitches as measured in flight (P2 body).",
        separates="What bears relief, hidden ground and an error of attitude of 1 deg from what needs to look down.",
        falsifier="Another picture without tilt: scores as in the control.",
        strength_unit="deg of tilt",
    ),
    variants=(
        Variant(role="control", kind="control"),
        *(Variant(role="stress", kind=TILT, strength=tilt_deg) for tilt_deg in TILTS_DEG),
        Variant(role="stress", kind=BODY, strength=BODY_SIGMA_DEG),
        Variant(role="falsifier", kind="no tilt"),
    ),
    flight=_oblique_flight,
)


OVERLAPS: Final = (1.0, 0.7, 0.4)
SCALES: Final = (1.0, 1.5, 2.0)
GRID_TILTS_DEG: Final = (0.0, 20.0, 40.0)
# Flights by kind, all at scale 1
_GRID: Final = {
    f"P8 tilt {tilt_deg:g}, overlap {overlap:g}": Flight(tilt_deg=tilt_deg, overlap=overlap)
    for tilt_deg in GRID_TILTS_DEG
    for overlap in OVERLAPS
}


def _grid_flight(variant: Variant) -> Flight:
    plain = _GRID.get(variant.kind, Flight())
    return replace(plain, height_m=HEIGHT_M * (variant.strength or 1.0))


@dataclass(frozen=True, kw_only=True)
class GridSuite(PictureSuite):
    """A suite whose pictures show more ground than the view: all of it is mapped, unless the camera is tilted."""

    def clear_m(self, scene: Scene) -> float:
        """Return half the side of the square that must be mapped: what the highest camera sees, in any heading."""
        widest_m = max(SCALES) * HEIGHT_M * LENS.width_px / LENS.focal_px[0]
        return max(super().clear_m(scene), widest_m / math.sqrt(2))


OVERLAP_SCALE_TILT: Final = GridSuite(
    card=SuiteCard(
        name="overlap-scale-tilt",
        version=1,
        title="Overlap, scale and tilt (P8)",
        what="All of the view, 70 or 40 % of it is ground of the map; the picture is taken from 160, 240 or 320 m, as "
        "is known; and the camera tilts by 0, 20 or 40 deg ahead: each with each.",
        separates="Matchers by what they bear of each, alone and together; those that compare pictures above all.",
        falsifier="Another picture of full overlap from the control's height without tilt: scores as in the control.",
        strength_unit="times the control's height",
    ),
    variants=(
        Variant(role="control", kind="control"),
        *(  # by height, and tilted behind all others: what is painted once serves those beside each other
            Variant(role="stress", kind=kind, strength=scale)
            for scale in SCALES
            for kind, flight in _GRID.items()
            if (scale, flight.tilt_deg, flight.overlap) != (1.0, 0.0, 1.0)
        ),
        Variant(role="falsifier", kind="control again"),
    ),
    flight=_grid_flight,
)


RELIEFS: Final = (1.0, 2.0, 4.0)


def _relief_flight(variant: Variant) -> Flight:
    return Flight(relief=variant.strength)


RELIEF: Final = PictureSuite(
    card=SuiteCard(
        name="relief",
        version=1,
        title="Relief (P3)",
        what="Buildings as high as they are, twice and four times as high, from 160 m: roofs lean away from the middle "
        "and hide ground.",
        separates="Matchers that bear roofs beside their footprints.",
        falsifier="Buildings flattened again: scores as in the control, where they are flat, too.",
        strength_unit="times the height of buildings",
    ),
    variants=(
        Variant(role="control", kind="flat"),
        *(Variant(role="stress", kind="P3 relief", strength=relief) for relief in RELIEFS),
        Variant(role="falsifier", kind="flattened"),
    ),
    flight=_relief_flight,
)


SEASONS: Final[tuple[Season, ...]] = ("spring", "autumn", "winter", "snow")


def _season_image_flight(variant: Variant) -> Flight:
    season: Season = next((name for name in SEASONS if variant.kind.endswith(name)), "summer")
    return Flight(conditions=lambda ordinary: replace(ordinary, season=season))


SEASON_IMAGE: Final = PictureSuite(
    card=SuiteCard(
        name="season-image",
        version=1,
        title="Seasons in pictures (P5)",
        what="The same place in spring, autumn, winter without leaves, and under snow; the map is that of summer.",
        separates="Segmenters by the seasons in which they still see; the query does not say the season.",
        falsifier="Another picture in summer: scores as in the control.",
        strength_unit="share of the season",
    ),
    variants=(
        Variant(role="control", kind="control"),
        *(Variant(role="stress", kind=f"P5 {season}", strength=1.0) for season in SEASONS),
        Variant(role="falsifier", kind="summer again"),
    ),
    flight=_season_image_flight,
)
