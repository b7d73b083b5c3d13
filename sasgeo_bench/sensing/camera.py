# SPDX-License-Identifier: Apache-2.0
"""A camera in the air: where it is, how it looks, and the way from the ground to its picture and back.

Order of angles, here and nowhere else. A body's axes are forward, right, down; the ground's are north, east, down.
From a body that heads north and level, turn by **yaw** about down (clockwise from above), then by **pitch** about the
new right (nose up), then by **roll** about the new forward (right side down): aerospace's z, y', x''. A camera is a
body whose forward is its optical axis; one that looks straight down has pitch -90. `tilt_deg` is pitch + 90: 0 is
straight down, and the tilt goes towards the heading. For such a camera, yaw is the heading of the picture's up.
"""

import math
from dataclasses import dataclass, field
from typing import Final, Self

import cv2
import numpy as np
import scipy  # its parts are loaded where they are used: what only plans or carries pictures starts without them
import shapely
from numpy.typing import NDArray

from sasgeo_bench.core.errors import CameraError
from sasgeo_bench.geometry.pose import bearing_deg, rotation
from sasgeo_bench.sensing.ground import Ground, Plane

Points = NDArray[np.float64]
Distortion = tuple[float, float, float, float, float]

NO_DISTORTION: Final[Distortion] = (0.0, 0.0, 0.0, 0.0, 0.0)

_HALF_PX: Final = 0.5  # from OpenCV's integer centres to pixel-is-area
_WIDEST_DEG: Final = 170.0  # of a field of view; beyond it a pinhole no longer describes a lens
_MOST_PX: Final = 100_000  # of a side
_STEPS: Final = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 100, 1e-10)  # to take distortion off


@dataclass(frozen=True, slots=True, kw_only=True)
class Intrinsics:
    """Pinhole with Brown distortion; raise `CameraError` if a value cannot be.

    `focal_px` and `centre_px` are (across, down); the centre counts from the outer corner of the first pixel.
    `distortion` is k1, k2, p1, p2, k3 as in OpenCV.

    Examples
    --------
    A picture as wide as it is far away sees 2 * atan(1 / 2) = 53.13 degrees:

    >>> camera = Intrinsics(width_px=800, height_px=600, focal_px=(800.0, 800.0), centre_px=(400.0, 300.0))
    >>> round(camera.horizontal_deg, 2)
    53.13
    """

    width_px: int
    height_px: int
    focal_px: tuple[float, float]
    centre_px: tuple[float, float]
    distortion: Distortion = NO_DISTORTION

    def __post_init__(self) -> None:
        """Check that the values describe a lens."""
        if not (1 <= self.width_px <= _MOST_PX and 1 <= self.height_px <= _MOST_PX):
            raise CameraError(
                f"a picture has 1 to {_MOST_PX} pixels a side, got {self.width_px!r} x {self.height_px!r}"
            )
        numbers = (*self.focal_px, *self.centre_px, *self.distortion)
        if len(numbers) != 2 + 2 + len(NO_DISTORTION) or not all(map(math.isfinite, numbers)):
            raise CameraError(
                f"a camera has two focal lengths, two coordinates of its centre and five coefficients of distortion "
                f"(k1, k2, p1, p2, k3), all finite, got {self.focal_px!r}, {self.centre_px!r}, {self.distortion!r}"
            )
        if not min(self.focal_px) > 0 or self.horizontal_deg > _WIDEST_DEG:
            raise CameraError(
                f"focal_px must be positive and leave a field of view of at most {_WIDEST_DEG:g} degrees, "
                f"got {self.focal_px!r} for {self.width_px} pixels: is it in millimetres?"
            )

    @classmethod
    def from_field_of_view(
        cls, *, horizontal_deg: float, width_px: int, height_px: int, distortion: Distortion = NO_DISTORTION
    ) -> Self:
        """Return a camera with square pixels whose picture is `horizontal_deg` wide; its centre is the picture's.

        >>> Intrinsics.from_field_of_view(horizontal_deg=90.0, width_px=800, height_px=600).focal_px
        (400.0, 400.0)
        """
        if not 0 < horizontal_deg <= _WIDEST_DEG:
            raise CameraError(f"a field of view is above 0 and at most {_WIDEST_DEG:g} degrees, got {horizontal_deg!r}")
        focal_px = round(width_px / 2 / math.tan(math.radians(horizontal_deg) / 2), 9)
        return cls(
            width_px=width_px,
            height_px=height_px,
            focal_px=(focal_px, focal_px),
            centre_px=(width_px / 2, height_px / 2),
            distortion=distortion,
        )

    @classmethod
    def from_matrix(
        cls, matrix: Points, *, width_px: int, height_px: int, distortion: Distortion = NO_DISTORTION
    ) -> Self:
        """Return the camera of a calibration with OpenCV: its matrix, shape (3, 3), counts from pixel centres.

        >>> opencv = np.array([[900.0, 0.0, 399.5], [0.0, 900.0, 299.5], [0.0, 0.0, 1.0]])
        >>> Intrinsics.from_matrix(opencv, width_px=800, height_px=600).centre_px
        (400.0, 300.0)
        """
        matrix = np.asarray(matrix, dtype=np.float64)
        if matrix.shape != (3, 3) or matrix[0, 1] or matrix[1, 0] or matrix[2].tolist() != [0.0, 0.0, 1.0]:
            raise CameraError(
                f"a camera matrix is [[fx, 0, cx], [0, fy, cy], [0, 0, 1]] (no skew), got {matrix.tolist()!r}"
            )
        (fx, _, cx), (_, fy, cy), _ = matrix.tolist()
        return cls(
            width_px=width_px,
            height_px=height_px,
            focal_px=(fx, fy),
            centre_px=(cx + _HALF_PX, cy + _HALF_PX),
            distortion=distortion,
        )

    @property
    def matrix(self) -> Points:
        """Return the camera matrix for OpenCV, shape (3, 3), which counts from pixel centres: undoes `from_matrix`."""
        (fx, fy), (cx, cy) = self.focal_px, self.centre_px
        return np.array([[fx, 0.0, cx - _HALF_PX], [0.0, fy, cy - _HALF_PX], [0.0, 0.0, 1.0]])

    @property
    def horizontal_deg(self) -> float:
        """Return the width of the field of view without distortion, degrees."""
        left, right = self.centre_px[0], self.width_px - self.centre_px[0]
        return math.degrees(math.atan2(left, self.focal_px[0]) + math.atan2(right, self.focal_px[0]))

    def contains(self, points_px: Points) -> NDArray[np.bool_]:
        """Return which points, shape (N, 2), lie in the picture; a NaN does not."""
        return np.asarray(((points_px >= 0) & (points_px < (self.width_px, self.height_px))).all(axis=1))

    def border_px(self, steps: int) -> Points:
        """Return points along the picture's edge, clockwise from its upper left, shape (4 * steps, 2)."""
        along = np.arange(steps) / steps
        none, full = np.zeros(steps), np.ones(steps)
        sides = [(along, none), (full, along), (1 - along, full), (none, 1 - along)]
        return np.concatenate([np.stack(side, axis=1) for side in sides]) * (self.width_px, self.height_px)

    def to_pixels(self, slopes: Points) -> Points:
        """Convert slopes (right / ahead, down / ahead), shape (N, 2), to pixels; NaN where the lens folds over.

        Far outside the picture the polynomial of the distortion turns back, and would bring such points into it.

        >>> lens = Intrinsics.from_field_of_view(horizontal_deg=90.0, width_px=800, height_px=600)
        >>> lens.to_pixels(np.array([[0.0, 0.0], [1.0, 0.5]])).tolist()
        [[400.0, 300.0], [800.0, 500.0]]
        """
        slopes = np.ascontiguousarray(slopes, dtype=np.float64)
        if not any(self.distortion):
            return slopes * self.focal_px + self.centre_px
        # Radius, as a slope, from which the radial polynomial no longer grows; infinite if it always does
        k1, k2, _, _, k3 = self.distortion
        slope = np.array([7 * k3, 5 * k2, 3 * k1, 1.0])  # the derivative of r (1 + k1 r2 + k2 r4 + k3 r6), in r2
        # 1e-15: moves no pixel of any lens; the division of a root by less would overflow
        squares = np.roots(np.where(np.abs(slope) < 1e-15, 0.0, slope))
        real = squares.real[(np.abs(squares.imag) < 1e-12) & (squares.real > 0)]  # rounding of a real root
        outside = ~(np.hypot(*slopes.T) < (float(np.sqrt(real.min())) if len(real) else math.inf))
        safe = np.column_stack([np.where(outside[:, None], 0.0, slopes), np.ones(len(slopes))])
        if not len(safe):
            return slopes
        none = np.zeros(3)
        pixels = cv2.projectPoints(safe, none, none, self.matrix, np.array(self.distortion))[0].reshape(-1, 2)
        return np.where(outside[:, None], np.nan, pixels + _HALF_PX)

    def to_slopes(self, points_px: Points) -> Points:
        """Convert pixels, shape (N, 2), to slopes (right / ahead, down / ahead); NaN where none belongs to it."""
        points_px = np.ascontiguousarray(points_px, dtype=np.float64)
        if not any(self.distortion) or not len(points_px):
            return (points_px - self.centre_px) / self.focal_px
        found = cv2.undistortPointsIter(
            np.nan_to_num(points_px - _HALF_PX).reshape(-1, 1, 2),
            self.matrix,
            np.array(self.distortion),
            np.eye(3),
            np.eye(3),
            _STEPS,
        )
        slopes = np.asarray(found, dtype=np.float64).reshape(-1, 2)
        # 1e-3 pixels: a point whose distortion cannot be undone this well has no ray
        missed = ~(np.abs(self.to_pixels(slopes) - points_px).max(axis=1) < 1e-3)
        return np.where(missed[:, None], np.nan, slopes)


Nine = tuple[float, float, float, float, float, float, float, float, float]

# Rows of a camera's right, down, ahead in the axes of its body (forward, right, down); and of NED in east, north, up.
_CAMERA_OF_BODY: Final = np.array([[0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [1.0, 0.0, 0.0]])
_NED_OF_ENU: Final = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])

_STRAIGHT_DOWN_DEG: Final = -90.0
_HIGHEST_M: Final = 50_000.0
_MESH: Final = 32  # parts of a side of the picture, for the footprint


def _check_finite(owner: object, *values: float) -> None:
    if not all(map(math.isfinite, values)):
        raise CameraError(f"angles and places of a camera are finite numbers, got {owner!r}")


@dataclass(frozen=True, slots=True, kw_only=True)
class Attitude:
    """Roll, pitch and yaw of a body, degrees, in the order that the head of this file states.

    A nose that rises by 10 degrees lifts what is ahead:

    >>> Attitude(pitch_deg=10.0).matrix[2, 0].round(3).item()  # forward, seen along down
    -0.174
    """

    roll_deg: float = 0.0
    pitch_deg: float = 0.0
    yaw_deg: float = 0.0

    def __post_init__(self) -> None:
        _check_finite(self, self.roll_deg, self.pitch_deg, self.yaw_deg)

    @property
    def matrix(self) -> Points:
        """Return the matrix from the body's (forward, right, down) to (north, east, down), shape (3, 3)."""
        angles = (self.yaw_deg, self.pitch_deg, self.roll_deg)
        return np.asarray(scipy.spatial.transform.Rotation.from_euler("ZYX", angles, degrees=True).as_matrix())


@dataclass(frozen=True, slots=True, kw_only=True)
class Mount:
    """How a camera sits on its vehicle: tilt, roll and yaw against the body, straight down by default.

    A stabilized mount (gimbal) follows the body's yaw alone; a fixed one takes part in its roll and pitch.
    """

    tilt_deg: float = 0.0
    roll_deg: float = 0.0
    yaw_deg: float = 0.0
    is_stabilized: bool = False

    def __post_init__(self) -> None:
        _check_finite(self, self.tilt_deg, self.roll_deg, self.yaw_deg)


@dataclass(frozen=True, slots=True, kw_only=True)
class Camera:
    """Centre of projection and direction of a camera over the ground.

    `east_m`, `north_m` and `height_m` are in the frame of the ground that it looks at; height counts from that frame's
    z = 0. `rotation` is the matrix from (east, north, up) to the camera's (right, down, ahead), row by row; use
    `pointed` or `mounted` to make it from angles. Raise `CameraError` if a value cannot be.

    Examples
    --------
    From 100 m, 10 m on the ground take 80 of 800 pixels that see 100 m; with yaw 90, east is up:

    >>> lens = Intrinsics.from_field_of_view(horizontal_deg=53.13010235, width_px=800, height_px=600)
    >>> camera = Camera.pointed(intrinsics=lens, east_m=0.0, north_m=0.0, height_m=100.0, yaw_deg=90.0)
    >>> camera.project(np.array([[10.0, 0.0, 0.0]])).round(3).tolist()
    [[400.0, 220.0]]
    """

    intrinsics: Intrinsics
    east_m: float
    north_m: float
    height_m: float
    rotation: Nine = field(repr=False)

    def __post_init__(self) -> None:
        _check_finite(self, self.east_m, self.north_m, self.height_m, *self.rotation)
        # 1e8 m of a coordinate: more than any projected CRS has
        if max(abs(self.east_m), abs(self.north_m)) > 1e8 or abs(self.height_m) > _HIGHEST_M:
            raise CameraError(
                f"a camera is within {_HIGHEST_M:g} m of height 0 and at coordinates in metres, got height "
                f"{self.height_m!r} at {self.east_m!r}, {self.north_m!r}"
            )
        matrix = np.reshape(self.rotation, (3, 3))
        if not np.allclose(matrix @ matrix.T, np.eye(3), atol=1e-6) or np.linalg.det(matrix) < 0:
            raise CameraError(f"rotation is nine numbers of a right-handed rotation, got {self.rotation!r}")

    @classmethod
    def pointed(
        cls,
        *,
        intrinsics: Intrinsics,
        east_m: float,
        north_m: float,
        height_m: float,
        yaw_deg: float,
        tilt_deg: float = 0.0,
    ) -> Self:
        """Return a camera that looks down, tilted towards its heading by `tilt_deg` (pitch of a gimbal + 90).

        One that is rolled as well is `mounted`.
        """
        return cls.mounted(
            intrinsics=intrinsics,
            east_m=east_m,
            north_m=north_m,
            height_m=height_m,
            body=Attitude(yaw_deg=yaw_deg),
            mount=Mount(tilt_deg=tilt_deg),
        )

    @classmethod
    def mounted(
        cls,
        *,
        intrinsics: Intrinsics,
        east_m: float,
        north_m: float,
        height_m: float,
        body: Attitude,
        mount: Mount,
    ) -> Self:
        """Return the camera of a vehicle with an attitude; what is fixed to the body turns with it.

        A nose 9.6 degrees up moves the middle of a fixed camera's picture ahead, by 13.5 m from 80 m:

        >>> from sasgeo_bench.sensing.ground import Plane
        >>> lens = Intrinsics.from_field_of_view(horizontal_deg=60.0, width_px=800, height_px=600)
        >>> body = Attitude(pitch_deg=9.6)
        >>> camera = Camera.mounted(
        ...     intrinsics=lens, east_m=0.0, north_m=0.0, height_m=80.0, body=body, mount=Mount()
        ... )
        >>> camera.unproject(np.array([[400.0, 300.0]]), Plane()).round(1).tolist()
        [[0.0, 13.5, 0.0]]
        """
        carrier = Attitude(yaw_deg=body.yaw_deg) if mount.is_stabilized else body
        pitch_deg = mount.tilt_deg + _STRAIGHT_DOWN_DEG
        on_body = Attitude(roll_deg=mount.roll_deg, pitch_deg=pitch_deg, yaw_deg=mount.yaw_deg)
        ned_of_camera_body = carrier.matrix @ on_body.matrix
        matrix = _CAMERA_OF_BODY @ ned_of_camera_body.T @ _NED_OF_ENU
        return cls(
            intrinsics=intrinsics,
            east_m=float(east_m),
            north_m=float(north_m),
            height_m=float(height_m),
            rotation=_nine(matrix),
        )

    @property
    def matrix(self) -> Points:
        """Return the rotation from (east, north, up) to (right, down, ahead), shape (3, 3)."""
        return np.reshape(self.rotation, (3, 3)).astype(np.float64)

    @property
    def position_m(self) -> Points:
        """Return east, north, height, shape (3,), metres."""
        return np.array([self.east_m, self.north_m, self.height_m])

    @property
    def yaw_deg(self) -> float:
        """Return the heading of the picture's up direction, [0, 360) degrees."""
        return float(bearing_deg(-self.rotation[3], -self.rotation[4]))

    @property
    def tilt_deg(self) -> float:
        """Return the angle between the optical axis and straight down, [0, 180] degrees."""
        return math.degrees(math.acos(max(-1.0, min(1.0, -self.rotation[8]))))

    def turned(self, error: Attitude) -> Self:
        """Return the camera turned about its own axes: pitch about its right, roll about its picture's up, yaw ahead.

        Small turns of a camera that looks straight down are those of the body that carries it: pitch moves the view
        ahead, roll (right side down) to the left, yaw clockwise.
        """
        body = scipy.spatial.transform.Rotation.from_euler(
            "ZYX", (error.yaw_deg, error.pitch_deg, error.roll_deg), degrees=True
        ).as_matrix()
        down_of_nadir = Attitude(pitch_deg=_STRAIGHT_DOWN_DEG).matrix
        camera_of_carrier = _CAMERA_OF_BODY @ down_of_nadir.T
        matrix = camera_of_carrier @ body.T @ camera_of_carrier.T @ self.matrix
        return self._with(matrix, self.position_m)

    def upright(self, turn: tuple[tuple[int, int], tuple[int, int]]) -> Self:
        """Return the camera of the picture after a turn by quarters: rows are its right and down in the old ones."""
        quarter = np.eye(3)
        quarter[:2, :2] = turn
        return self._with(quarter @ self.matrix, self.position_m)

    def above_origin(self) -> Self:
        """Return the camera above the origin, in axes in which its picture's up is north."""
        turn = np.eye(3)
        turn[:2, :2] = rotation(self.yaw_deg)
        return self._with(self.matrix @ turn, np.array([0.0, 0.0, self.height_m]))

    def moved(self, *, east_m: float = 0.0, north_m: float = 0.0, up_m: float = 0.0) -> Self:
        """Return the camera moved by metres; it looks as before."""
        return self._with(self.matrix, self.position_m + np.array([east_m, north_m, up_m]))

    def _with(self, matrix: Points, position_m: Points) -> Self:
        east_m, north_m, height_m = position_m.tolist()
        return type(self)(
            intrinsics=self.intrinsics, east_m=east_m, north_m=north_m, height_m=height_m, rotation=_nine(matrix)
        )

    def project(self, points_m: Points) -> Points:
        """Convert (east, north, up), shape (N, 3), metres, to pixels, shape (N, 2); NaN behind the camera.

        Points beside the picture get pixels outside it: ask `camera.contains`.
        """
        seen = (np.asarray(points_m, dtype=np.float64) - self.position_m) @ self.matrix.T
        # 1e-6 m ahead of the camera; what is nearer is not projected
        ahead_m = np.where(seen[:, 2] > 1e-6, seen[:, 2], np.nan)
        return self.intrinsics.to_pixels(seen[:, :2] / ahead_m[:, None])

    def rays(self, points_px: Points) -> Points:
        """Return the direction of each pixel, shape (N, 2) -> (N, 3), in (east, north, up), 1 long along the axis."""
        slopes = self.intrinsics.to_slopes(points_px)
        return np.column_stack([slopes, np.ones(len(slopes))]) @ self.matrix

    def unproject(self, points_px: Points, ground: Ground) -> Points:
        """Convert pixels, shape (N, 2), to the ground they show, (N, 3); NaN above the horizon and off the ground."""
        return ground.meet(self.position_m, self.rays(points_px))

    def gsd_m(self, points_px: Points, ground: Ground) -> Points:
        """Return the ground sampling distance at each pixel, shape (N,), metres; NaN where no ground is seen.

        The side of a pixel on the ground in the direction in which it is longest: how far apart two things must be to
        be seen as two whichever way they lie. Straight down it is height / focal length.

        >>> from sasgeo_bench.sensing.ground import Plane
        >>> lens = Intrinsics.from_field_of_view(horizontal_deg=90.0, width_px=1000, height_px=1000)
        >>> camera = Camera.pointed(intrinsics=lens, east_m=0.0, north_m=0.0, height_m=100.0, yaw_deg=0.0)
        >>> camera.gsd_m(np.array([[500.0, 500.0]]), Plane()).round(6).tolist()
        [0.2]
        """
        points_px = np.asarray(points_px, dtype=np.float64)
        steps = _HALF_PX * np.array([[1, 0], [-1, 0], [0, 1], [0, -1]])
        right, left, down, up = (self.unproject(points_px + step, ground)[:, :2] for step in steps)
        across, along = right - left, down - up
        # Largest singular value of the matrix with these columns.
        total = (across**2).sum(axis=1) + (along**2).sum(axis=1)
        area = across[:, 0] * along[:, 1] - across[:, 1] * along[:, 0]
        return np.asarray(np.sqrt((total + np.sqrt(np.maximum(total**2 - 4 * area**2, 0))) / 2))

    def footprint(self, ground: Ground, *, reach_m: float | None = None) -> shapely.Polygon:
        """Return the outline of the ground in the picture, east and north, metres; empty where no ground is seen.

        It ends `reach_m` from the point beneath the camera (20 times the height above ground by default), so that a
        picture with the horizon in it has an end. Over a plane it is exact; over heights it is the union of the patches
        of ground that a mesh of 32 x 32 parts of the picture shows, hidden ground between them included.

        >>> from sasgeo_bench.sensing.ground import Plane
        >>> lens = Intrinsics.from_field_of_view(horizontal_deg=90.0, width_px=1000, height_px=500)
        >>> camera = Camera.pointed(intrinsics=lens, east_m=0.0, north_m=0.0, height_m=50.0, yaw_deg=0.0)
        >>> tuple(round(edge_m, 6) for edge_m in camera.footprint(Plane()).bounds)
        (-50.0, -25.0, 50.0, 25.0)
        """
        beneath_m = ground.heights_m(self.position_m[None, :2])[0]
        above_m = self.height_m - (beneath_m if math.isfinite(beneath_m) else 0.0)
        if above_m <= 0:
            return shapely.Polygon()
        reach_m = reach_m or 20.0 * above_m  # reach of a footprint, in heights above the ground
        seen = self._outline(ground, above_m / reach_m) if isinstance(ground, Plane) else self._patches(ground)
        # Largest polygon of a geometry; an empty one if it holds none
        shape = seen.intersection(shapely.Point(self.east_m, self.north_m).buffer(reach_m, quad_segs=64))
        parts = [part for part in shapely.get_parts(shape) if part.geom_type == "Polygon"]
        return max(parts, key=shapely.area, default=shapely.Polygon())

    def _outline(self, ground: Plane, slope: float) -> shapely.Geometry:
        rays = self.rays(self.intrinsics.border_px(_MESH))
        # 0.01 of the slope at a footprint's end: where its straight far side is cut, before its round end
        points_m = ground.meet(self.position_m, _cut(rays[np.isfinite(rays).all(axis=1)], slope * 0.01))
        seen = points_m[np.isfinite(points_m).all(axis=1), :2].round(6)
        return shapely.Polygon(seen).buffer(0) if len(seen) > 2 else shapely.Polygon()  # a triangle

    def _patches(self, ground: Ground) -> shapely.Geometry:
        steps = np.linspace(0.0, 1.0, _MESH + 1)
        mesh = np.stack(np.meshgrid(steps * self.intrinsics.width_px, steps * self.intrinsics.height_px), axis=-1)
        points_m = self.unproject(mesh.reshape(-1, 2), ground)[:, :2].reshape(*mesh.shape)
        rings = np.stack([points_m[:-1, :-1], points_m[:-1, 1:], points_m[1:, 1:], points_m[1:, :-1]], axis=2)
        rings = rings.reshape(-1, 4, 2)
        quads = shapely.polygons(rings[np.isfinite(rings).all(axis=(1, 2))])
        return shapely.union_all(quads[shapely.is_valid(quads)])


def _nine(matrix: Points) -> Nine:
    """Return a matrix row by row; rounding keeps rotations by quarter turns exact."""
    a, b, c, d, e, f, g, h, i = (matrix.ravel().round(15) + 0.0).tolist()
    return (a, b, c, d, e, f, g, h, i)


def _cut(rays: Points, slope: float) -> Points:
    """Clip a closed ring of rays, shape (N, 3), to those that fall by at least `slope` metres a metre."""
    excess = -rays[:, 2] - slope * np.hypot(rays[:, 0], rays[:, 1])
    kept = []
    for ray, after, here, there in zip(rays, np.roll(rays, -1, axis=0), excess, np.roll(excess, -1), strict=True):
        if here >= 0:
            kept.append(ray)
        if (here >= 0) != (there >= 0):
            kept.append(ray + (after - ray) * here / (here - there))
    return np.array(kept).reshape(-1, 3)
