# SPDX-License-Identifier: Apache-2.0
"""Suites of real pictures, cut out of the imagery of a region: real-image, single views, and flight-real-image."""

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from sasgeo_bench.core.errors import ConfigError
from sasgeo_bench.geometry.pose import Pose
from sasgeo_bench.sensing.accumulation import believed_steps, steps_between
from sasgeo_bench.sensing.camera import Attitude, Camera, Intrinsics, Mount
from sasgeo_bench.sensing.sharpness import no_sharper
from sasgeo_bench.tasks.frame_evidence import poses_before, unseen
from sasgeo_bench.tasks.frames import Frame, FrameLabels, encode_webp
from sasgeo_bench.tasks.pictured_ground import GROUNDS, Cut, PicturedGround
from sasgeo_bench.tasks.query import REAL, Detector, PriorGroup, Role
from sasgeo_bench.tasks.state import State
from sasgeo_bench.tasks.suites.base import QueryDraft, Scene, Site, Suite, SuiteCard, Variant, ViewRequest
from sasgeo_bench.tasks.suites.flights import AGAIN, LONGEST_M, SEQUENCE, START, FlightSuite, Mission
from sasgeo_bench.tasks.suites.pictures import AROUND, ODOMETRY

SIDES_M: Final = (384.0, 256.0, 192.0, 128.0, 96.0)
MAIN_M: Final = 192.0  # of the view by which sites are chosen and kept apart
DISC_M: Final = 250.0  # of the second disc; the first is that of the card
LEAST_SHOWN: Final = 0.97  # of a view, and of its picture, at every site
LEAST_PX: Final = 100  # of the picture's own pixels along the side of a view
VIEW, DEGRADED, OLDER, OWN, ABSENT, FRAMES = (
    "R1 view",
    "R2 degraded map",
    "R3 map",
    "R4 own town",
    "R4 another town",
    "R5 frames",
)
NO_IMAGERY: Final = "no real imagery ([[imagery]] in its region file)"
_OF: Final = f"{OLDER} of "  # before the date
TURNED: Final = "turned picture"
COUNTS: Final = (3.0, 9.0)  # of frames
FRAME_M: Final = 128.0  # of ground that each of several frames shows
_FINE_M: Final = 128.0  # widest view in fine cells
_FINE_CELL_M: Final = 0.5
_PICTURE: Final = 1.25  # times the view's side is what a picture shows
_MOST_PX: Final = 768
_HEIGHT_M: Final = 2000.0  # of the camera that a mosaic stands for: from there nothing leans
_TRIES: Final = 4000


@dataclass(frozen=True, kw_only=True)
class RealImageSuite(Suite):
    """Views out of the imagery of a region: turned, scaled, at the resolution of the mosaic or a coarser one.

    Sites lie where the picture shows `LEAST_SHOWN` of every view, and take turns in the kinds of ground that there are
    (`pictured_ground.GROUNDS`). The kind of a view of R1 names the ground that it shows itself. Where a view is on the
    map is said in coordinates of the map: the offset of the imagery, where it is measured, is taken off.
    """

    @property
    def is_pictured(self) -> bool:
        """Return True."""
        return True

    @property
    def detectors(self) -> tuple[Detector, ...]:
        """Return that pictures are real."""
        return (REAL,)

    @property
    def main_side_m(self) -> float:
        """Return the side by which sites are chosen: 192 m, or the largest that a region allows."""
        return min(MAIN_M, max(variant.side_m for variant in self.variants))

    def refusal(self, group: PriorGroup) -> str | None:  # noqa: ARG002
        """Refuse every group: the suite has two."""
        return f"asks discs of {self.card.group.radius_m:g} and {DISC_M:g} m itself: leave --prior out"

    def lack(self, scene: Scene) -> str | None:
        """Return that there is no imagery or too coarse a one, or what any suite lacks."""
        if scene.pictured is None:
            return NO_IMAGERY
        gsd_m, side_m = scene.pictured.own_gsd_m, max(variant.side_m for variant in self.variants)
        if LEAST_PX * gsd_m > side_m:
            return f"its picture has pixels of {gsd_m:g} m, fewer than {LEAST_PX} along a view of {side_m:g} m"
        return super().lack(scene)

    def fitting(self, largest_m: float | None) -> tuple[Variant, ...]:
        """Return the variants whose views are no larger; the control is the largest."""
        fit = [side_m for side_m in SIDES_M if largest_m is None or side_m <= largest_m]
        return _of_sides(self.variants, fit or [min(SIDES_M)])

    def usable(self, scene: Scene) -> tuple[Variant, ...]:
        """Return the variants that the picture resolves: R3 for each older map, R4 where both pictures do."""
        assert scene.pictured is not None  # noqa: S101 - by `lack`
        coarser_m = math.inf if scene.pictured_elsewhere is None else _coarser_gsd_m(scene)
        least_m = LEAST_PX * scene.pictured.own_gsd_m
        there = {variant.side_m for variant in self.variants}
        older = [state for state in scene.others if state.date < scene.map.date]
        found: list[Variant] = []
        resolved_m = [side_m for side_m in SIDES_M if side_m in there and side_m >= least_m]
        for variant in _of_sides(self.variants, resolved_m):
            if variant.kind == OLDER:
                found += [replace(variant, kind=f"{_OF}{state.date}") for state in older]
            elif variant.kind not in (OWN, ABSENT) or variant.side_m >= LEAST_PX * coarser_m:
                found.append(variant)
        return tuple(found)

    def drawn_of(self, variant: Variant, older: int) -> int:
        """Return a query for each older map for R3, one for the others."""
        return older if variant.kind == OLDER else 1

    def map_region(self, scene: Scene, variant: Variant) -> str:
        """Return the degraded map for R2, an older one for R3."""
        if variant.kind == DEGRADED:
            suffix = f"+{self.card.name}"
        elif variant.kind.startswith(OLDER):
            suffix = f"@{variant.kind.removeprefix(_OF)}"
        else:
            return scene.map.region
        return next(state.region for state in scene.others if state.region.endswith(suffix))

    def older(self, scene: Scene) -> tuple[State, ...]:  # noqa: ARG002
        """Return none: sites, and so views, are the same whatever the other maps lack."""
        return ()

    @property
    def grounds(self) -> tuple[str, ...]:
        """Return the kinds of ground, which sites take turns in."""
        return GROUNDS

    def ground_at(self, scene: Scene, pose: Pose) -> str | None:
        """Return the kind of ground of the main view; None where the picture lacks a part of some view."""
        assert scene.pictured is not None  # noqa: S101 - by `lack`
        return scene.pictured.ground(pose, self.main_side_m) if _is_shown(scene.pictured, pose, self.variants) else None

    def draw(self, shot: ViewRequest) -> QueryDraft:
        """Cut the pictures of a shot; their evidence is unknown until a segmenter has seen them.

        Views of R4 are drawn in pairs of the own town's ground and another's, each no sharper than the other one.
        """
        variant, here = shot.variant, shot.scene.pictured
        assert here is not None  # noqa: S101 - by `lack`
        is_here = variant.kind != ABSENT
        pictured, site = seen = (here, shot.site)
        if variant.kind in (OWN, ABSENT):
            elsewhere = self._elsewhere(shot)
            (pictured, site), (beside, paired) = (seen, elsewhere) if is_here else (elsewhere, seen)
        pose = _turned(shot) if variant.kind == TURNED else site.pose
        cuts, believed = self.cuts(shot, pictured, pose)
        if variant.kind in (OWN, ABSENT):
            (other,), _ = self.cuts(shot, beside, paired.pose)
            cuts = [replace(cut, rgb=no_sharper(cut.rgb, than=other.rgb)) for cut in cuts]
        classes = here.state.classes
        return QueryDraft(
            evidence=unseen(classes, variant.view_cells, variant.cell_size_m),
            frames=tuple(_frame(cut, place, self.card) for cut, place in zip(cuts, believed, strict=True)),
            labels=tuple(FrameLabels.of(pictured.state.classes, cut.labels) for cut in cuts),
            is_present=is_here,
            has_pose=is_here,
            pose=pose if is_here and pose is not site.pose else None,
            kind=f"{VIEW.partition(' ')[0]} {here.ground(pose, variant.side_m)}" if variant.kind == VIEW else "",
            group=None if variant.radius_m is None else replace(self.card.group, radius_m=variant.radius_m),
            density=site.density,
            measured=_measured(pictured, cuts),
        )

    def cuts(self, shot: ViewRequest, pictured: PicturedGround, pose: Pose) -> tuple[list[Cut], list[Pose]]:
        """Return the pictures of a shot, and where each is believed to be taken in the frame of the view."""
        assert shot.scene.pictured is not None  # noqa: S101 - by `lack`
        is_one = shot.variant.kind != FRAMES
        side_m = _PICTURE * (shot.variant.side_m if is_one else FRAME_M)
        # Views of R4 have as many pixels wherever they are taken: their number must not tell one of another town.
        is_paired = shot.variant.kind in (OWN, ABSENT)
        gsd_m = _coarser_gsd_m(shot.scene) if is_paired else shot.scene.pictured.imagery.record.gsd_m
        width_px = _width_px(side_m, gsd_m)
        # Of several frames each shows less, and they lie around the last one.
        stops = [
            Pose(easting_m=FRAME_M / 2 * right, northing_m=FRAME_M / 2 * ahead, yaw_deg=0.0)
            for right, ahead in AROUND[-1 if is_one else -int(shot.variant.strength) :]
        ]
        believed = poses_before(believed_steps(steps_between(stops), ODOMETRY, shot.seeds.rng("odometry")))
        cuts = []
        for stop in stops:
            east_m, north_m = pose.to_map(np.array([(stop.easting_m, stop.northing_m)]))[0].tolist()
            taken = replace(pose, easting_m=east_m, northing_m=north_m)
            cuts.append(pictured.cut(taken, side_m, width_px))
        return cuts, believed

    def _elsewhere(self, shot: ViewRequest) -> tuple[PicturedGround, Site]:
        """Return a place of the other picture, of the site's kind of ground where one is found."""
        here, there = shot.scene.pictured, shot.scene.pictured_elsewhere
        assert here is not None  # noqa: S101 - by `lack`
        assert there is not None  # noqa: S101 - by `usable`
        wanted, state = here.ground(shot.site.pose, self.main_side_m), there.state
        paired = [variant for variant in self.variants if variant.kind in (OWN, ABSENT)]
        most_m = shot.scene.view_reach_m * max(one.side_m for one in paired) / max(one.side_m for one in self.variants)
        west, south, east, north = there.imagery.record.bounds_m
        found: Pose | None = None
        for point in shot.seeds.rng("elsewhere").uniform((west, south), (east, north), (_TRIES, 2)):
            pose = replace(shot.site.pose, easting_m=float(point[0]), northing_m=float(point[1]))
            is_alike = there.ground(pose, self.main_side_m) == wanted
            if not (is_alike or found is None):
                continue
            if _is_shown(there, pose, paired) and state.is_mapped(point, most_m):
                found = pose
                if is_alike:
                    break
        if found is None:
            raise ConfigError(f"{state.region} has no picture of a view to ask elsewhere: choose another split")
        return there, replace(shot.site, pose=found, density=there.drawn_share(found, self.main_side_m))


def _turned(shot: ViewRequest) -> Pose:
    """Return the pose of the falsifier: turned by one, two or three quarters, it shows the very same ground."""
    site, quarters = shot.site.pose, int(shot.seeds.rng("turn").integers(1, 4))
    return replace(site, yaw_deg=(site.yaw_deg + 90.0 * quarters) % 360)


def _is_shown(pictured: PicturedGround, pose: Pose, variants: Sequence[Variant]) -> bool:
    """Return whether the imagery shows every view of a place, and the picture of each, up to their corners."""
    if not pictured.shows(np.array([(pose.easting_m, pose.northing_m)])).all():
        return False  # most places of a map beyond its picture
    sides_m = sorted({side_m for variant in variants for side_m in (variant.side_m, _PICTURE * variant.side_m)})
    is_within = all(pictured.shows_corners(pose, side_m) for side_m in sides_m)
    return is_within and all(pictured.shown_share(pose, side_m) >= LEAST_SHOWN for side_m in sides_m)


def _width_px(side_m: float, gsd_m: float) -> int:
    return min(_MOST_PX, round(side_m / gsd_m))


def _coarser_gsd_m(scene: Scene) -> float:
    """Return the ground resolution that both the region's picture and the other town's have."""
    both = filter(None, (scene.pictured, scene.pictured_elsewhere))
    return max(max(one.own_gsd_m, one.imagery.record.gsd_m) for one in both)


def _measured(pictured: PicturedGround, cuts: Sequence[Cut]) -> dict[str, float]:
    return {
        "gsd_m": round(cuts[-1].pixel_m, 3),
        "map_off_m": round(float(np.hypot(*pictured.off_m)), 2),
        "pictured_share": round(min(float(cut.is_known.mean()) for cut in cuts), 4),
        "building_share": round(cuts[-1].share(pictured.state.classes, "building"), 4),
    }


def _frame(cut: Cut, place: Pose, card: SuiteCard) -> Frame:
    """Return a picture with its camera, which is believed to stand at a place in the frame of the view."""
    distance_m = float(np.hypot(place.easting_m, place.northing_m))
    return Frame(
        picture=encode_webp(cut.rgb),
        camera=_camera(cut, place),
        height_sigma_m=round(_HEIGHT_M * card.group.scale_sigma, 2),
        position_sigma_m=round(ODOMETRY.position_share * distance_m, 3),
        yaw_sigma_deg=round(ODOMETRY.yaw_deg_per_km * math.sqrt(distance_m / 1000), 3),
    )


def _camera(cut: Cut, place: Pose) -> Camera:
    """Return the camera that a picture stands for, in the frame of the view."""
    width_px = cut.rgb.shape[1]
    focal_px, centre_px = _HEIGHT_M / cut.pixel_m, width_px / 2
    return Camera.mounted(
        intrinsics=Intrinsics(
            width_px=width_px,
            height_px=width_px,
            focal_px=(focal_px, focal_px),
            centre_px=(centre_px, centre_px),
        ),
        east_m=place.easting_m,
        north_m=place.northing_m,
        height_m=_HEIGHT_M,
        body=Attitude(roll_deg=0.0, pitch_deg=0.0, yaw_deg=place.yaw_deg),
        mount=Mount(),
    )


def _variant(
    role: Role, kind: str, side_m: float, *, strength: float | None = None, disc_m: float | None = None
) -> Variant:
    cell_m = _FINE_CELL_M if side_m <= _FINE_M else 1.0
    if strength is None:
        strength = side_m if role == "stress" else 0.0
    return Variant(
        role=role,
        kind=kind,
        strength=strength,
        view_cells=round(side_m / cell_m),
        cell_size_m=cell_m,
        radius_m=disc_m,
    )


def _of_sides(variants: Iterable[Variant], sides_m: Sequence[float]) -> tuple[Variant, ...]:
    """Return variants with views of these sides alone, widest first: the control has the largest, R1 has all.

    Others have the side below theirs if theirs is not there; several frames need their own.
    """
    found = []
    for variant in variants:
        wanted_m = sides_m[0] if variant.role != "stress" else variant.side_m
        if wanted_m in sides_m and variant.role == "stress":
            found.append(variant)
        elif variant.kind not in (VIEW, FRAMES):
            side_m = next((side_m for side_m in sides_m if side_m <= wanted_m), sides_m[-1])
            found.append(_variant(variant.role, variant.kind, side_m, disc_m=variant.radius_m))
    return tuple(dict.fromkeys(found))


REAL_IMAGE: Final = RealImageSuite(
    card=SuiteCard(
        name="real-image",
        version=3,
        title="Real pictures (R)",
        what="Views of 384 to 96 m cut out of the imagery of a region, turned and scaled, in discs of 500 and 250 m: "
        "against its map as it is, by what they show (R1 built, mixed, open), without 20 % of its roofs, "
        "the others 1.5 m off (R2), and as it was on each older date (R3); another town's picture, "
        "and the own one beside it, each no sharper than the other (R4); 3 and 9 frames "
        "of 128 m, laid together by odometry that drifts by 1 % (R5). A segmenter makes the evidence.",
        separates="What is learned from rendered pictures from what real ones need.",
        falsifier="The picture turned by 90, 180 or 270 deg: scores as in the control.",
        strength_unit="m, the side of the view; R5: frames",
        needs=("imagery", "degraded map", "every older map", "another picture"),
        min_density=0.01,
    ),
    variants=(
        *(_variant("control", "control", SIDES_M[0], disc_m=disc_m) for disc_m in (None, DISC_M)),
        *(_variant("stress", VIEW, side_m, disc_m=disc_m) for disc_m in (None, DISC_M) for side_m in SIDES_M),
        *(_variant("stress", kind, side_m) for kind in (DEGRADED, OWN, ABSENT) for side_m in (256.0, 128.0)),
        _variant("stress", OLDER, 256.0),
        *(_variant("stress", FRAMES, 256.0, strength=count) for count in COUNTS),
        _variant("falsifier", TURNED, SIDES_M[0]),
    ),
)


@dataclass(frozen=True, kw_only=True)
class RealFlightSuite(FlightSuite):
    """Flights over the imagery of a region: each view is one picture cut out of it, all of which it shows."""

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
        return super().lack(scene) if scene.pictured is not None else NO_IMAGERY

    def clear_m(self, scene: Scene) -> float:
        """Return half the side of the square that must be mapped: what a picture shows, in any heading."""
        return _PICTURE * super().clear_m(scene)

    def ground_at(self, scene: Scene, pose: Pose) -> str | None:
        """Return "" where the imagery shows the whole picture; None elsewhere."""
        assert scene.pictured is not None  # noqa: S101 - by `lack`
        return "" if _is_shown(scene.pictured, pose, self.variants) else None

    def draw(self, shot: ViewRequest) -> QueryDraft:
        """Cut the picture of one view; its evidence is unknown until a segmenter has seen it."""
        variant, pictured = shot.variant, shot.scene.pictured
        assert pictured is not None  # noqa: S101 - by `lack`
        side_m = _PICTURE * variant.side_m
        cut = pictured.cut(shot.site.pose, side_m, _width_px(side_m, pictured.imagery.record.gsd_m))
        classes = pictured.state.classes
        return QueryDraft(
            evidence=unseen(classes, variant.view_cells, variant.cell_size_m),
            frames=(_frame(cut, Pose(easting_m=0.0, northing_m=0.0, yaw_deg=0.0), self.card),),
            labels=(FrameLabels.of(classes, cut.labels),),
            measured=_measured(pictured, [cut]),
        )


DRIFTS: Final = ("vo-mono-survey", "vio-mono")  # measured profiles that drift least and most
_KIND: Final = "F10"
_SIDE_M: Final = 128.0


def _mission(variant: Variant) -> Mission:
    is_stress = variant.role == "stress"
    return Mission(
        profile=variant.kind.removeprefix(f"{_KIND} ") if is_stress else "perfect",
        draw=AGAIN if variant.role == "falsifier" else "",
    )


FLIGHT_REAL_IMAGE: Final = RealFlightSuite(
    card=SuiteCard(
        name="flight-real-image",
        version=1,
        title="Flights over real pictures (F10)",
        what="A flight of 1 or 2 km over the imagery of a region: a picture of 128 m every 40 to 60 m, and an odometer "
        "that drifts as the least and the most that was measured; the control's does not. A segmenter makes the "
        "evidence.",
        separates="What many real pictures give that one does not from what drift takes.",
        falsifier="The same pictures without drift: scores as in the control.",
        strength_unit="place of the odometer in the order of drift",
        needs=("imagery",),
        group=START,
        tracks=SEQUENCE,
        min_density=0.03,
    ),
    variants=(
        _variant("control", "no drift", _SIDE_M),
        *(
            _variant("stress", f"{_KIND} {name}", _SIDE_M, strength=float(order))
            for order, name in enumerate(DRIFTS, start=1)
        ),
        _variant("falsifier", "no drift again", _SIDE_M),
    ),
    mission=_mission,
    longest_m=LONGEST_M,
)
