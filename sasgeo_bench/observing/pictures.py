# SPDX-License-Identifier: Apache-2.0
"""A picture of a user's own: a drone's photo, a georeferenced one, or any other whose size on the ground is known."""

import datetime as dt
import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final, Self

import cv2
import numpy as np
import rasterio
import shapely
from affine import Affine
from numpy.typing import NDArray
from pyproj import CRS, Transformer
from pyproj.exceptions import ProjError
from rasterio.enums import ColorInterp, Resampling
from rasterio.errors import CRSError, RasterioError
from rasterio.vrt import WarpedVRT

from sasgeo_bench.core.errors import CameraError, ConfigError, GridError, ImageError, SasgeoError
from sasgeo_bench.core.geotiff import open_geotiff
from sasgeo_bench.core.paths import read_bounded
from sasgeo_bench.core.progress import tell
from sasgeo_bench.geometry.grid import Grid, utm_epsg
from sasgeo_bench.geometry.pose import Pose, bearing_deg
from sasgeo_bench.geometry.projection import has_open_datum, to_grid
from sasgeo_bench.regions.layers import find_bands, selected
from sasgeo_bench.sensing.camera import Attitude, Camera, Intrinsics
from sasgeo_bench.sensing.dem import read_dem
from sasgeo_bench.sensing.ground import Dem, Plane
from sasgeo_bench.sensing.image import AerialImage, decode_image
from sasgeo_bench.sensing.photos import MOST_BYTES, Photo, read_photo
from sasgeo_bench.sensing.video import SUFFIXES as VIDEOS

WIDEST_M: Final = 384.0  # side of a view: the largest that was measured
LEAST_M: Final = 16.0  # of a smaller view nothing can be said
FINEST_M: Final = 0.25  # pixels on the ground; finer ones are averaged
STEEPEST_DEG: Final = 60.0  # of tilt: beyond it the ground of a view is far and coarse
SUFFIXES: Final = (".jpg", ".jpeg", ".png", ".webp", ".tif", ".tiff")
ARCHIVES: Final = (".zip", ".tar", ".gz", ".tgz", ".7z", ".rar")
_UNREAD: Final = frozenset(  # pictures and videos that drones and telephones write
    {".dng", ".heic", ".heif", ".raw", ".arw", ".cr2", ".nef", ".bmp", ".gif", ".jxl", ".avif", *VIDEOS}
)
_FINE_M: Final = 128.0  # widest view in cells of `_CELLS_M[0]`, as in the suites
_CELLS_M: Final = (0.5, 1.0)
_MARGIN: Final = 1.25  # times the view's side is what is cut out of a picture
_MERIDIAN_DEG: Final = 9.0
_STRAIGHT: Final = "taken as seen from straight above"
_DEM_CELL_M: Final = 10.0  # of the lattice of heights; GLO-30 and SRTM have 30 m
_AROUND_M: Final = 400.0  # of ground around the cameras whose heights are read
_STEPS: Final = 41  # places along the axis of a tilted camera, where its view may lie


@dataclass(frozen=True, slots=True, kw_only=True)
class Told:
    """What a user says of pictures, in place of what their files say or lack; None where he says nothing.

    `height_m` is the height above the ground, `ground_width_m` how wide the ground in the picture is. `dem`, a GeoTIFF,
    tells the height of photos that state an altitude and none above take-off.
    """

    height_m: float | None = None
    ground_width_m: float | None = None
    dem: Path | None = None

    def __post_init__(self) -> None:
        if self.dem is not None and (self.height_m is not None or self.ground_width_m is not None):
            raise ConfigError("the size on the ground is told in one way: give --height, --ground-width or --dem alone")
        for name, most in (("height_m", 10_000.0), ("ground_width_m", 100_000.0)):
            value = getattr(self, name)
            if value is not None and not 0 < value <= most:
                raise CameraError(f"{name.replace('_', ' ')[:-2]} is above 0 and at most {most:g} m, got {value!r}")


@dataclass(frozen=True, slots=True, kw_only=True)
class OwnPicture:
    """What is known of a picture before its pixels are read.

    Parameters
    ----------
    path : Path
        Of the file.
    lonlat : tuple of float, optional
        Where the camera stood (of a georeferenced picture: its middle), WGS 84, degrees; None where the file says none.
    position_by : str
        "EXIF" or "georeference"; empty without a position.
    heading_deg : float, optional
        Of the picture's up, degrees clockwise from true north; None where the file says none.
    heading_by : str
        "gimbal" or "georeference"; empty without one.
    scale_sigma : float
        Standard deviation of the size on the ground, as a fraction.
    taken_at : datetime, optional
        By the camera's clock.
    camera : Camera, optional
        Above the origin, the picture's up being north; of a photo.
    gsd_m : float, optional
        Width of a pixel on the ground, of a georeferenced picture.
    size_m : tuple of float, optional
        Width and height of the ground in a georeferenced picture, metres.
    height_m : float, optional
        Of a photo, above the ground as it is believed.
    note : str
        What was taken for granted, in a few words.
    """

    path: Path
    lonlat: tuple[float, float] | None = None
    position_by: str = ""
    heading_deg: float | None = None
    heading_by: str = ""
    scale_sigma: float
    taken_at: dt.datetime | None = None
    camera: Camera | None = None
    gsd_m: float | None = None
    size_m: tuple[float, float] | None = None
    height_m: float | None = None
    note: str = ""

    @property
    def tilt_deg(self) -> float:
        """Return the angle of the camera from straight down, degrees; 0 of a georeferenced picture."""
        return 0.0 if self.camera is None else self.camera.tilt_deg


@dataclass(frozen=True, slots=True, kw_only=True)
class Sight:
    """What a picture shows of the ground: a square, heading up, and the picture that it is seen in.

    `image` stands above the origin, its up is north. `middle_m` is where the middle of the square lies, (right, up) of
    the point beneath the camera, metres; `side_m` how long its sides are.
    """

    image: AerialImage
    middle_m: tuple[float, float]
    side_m: float

    @property
    def cell_size_m(self) -> float:
        """Return the side of a cell of the view, metres, as the suites have it."""
        return cell_of_view_m(self.side_m)

    @property
    def size_cells(self) -> int:
        """Return the cells along a side."""
        return max(2, int(self.side_m / self.cell_size_m))

    @property
    def pose(self) -> Pose:
        """Return where the square lies in the frame of the image."""
        return Pose(easting_m=self.middle_m[0], northing_m=self.middle_m[1], yaw_deg=0.0)

    def camera_pose(self, view: Pose) -> Pose:
        """Return where the camera stands if the square lies at a pose of a map; it heads as the square does.

        >>> image = AerialImage.from_above(np.zeros((8, 8, 3), dtype=np.uint8), gsd_m=1.0)
        >>> ahead = Sight(image=image, middle_m=(0.0, 30.0), side_m=8.0)
        >>> stood = ahead.camera_pose(Pose(easting_m=100.0, northing_m=0.0, yaw_deg=90.0))
        >>> round(stood.easting_m), round(stood.northing_m)
        (70, 0)
        """
        east_m, north_m = view.to_map(-np.array([self.middle_m]))[0].tolist()
        return replace(view, easting_m=east_m, northing_m=north_m)

    def view_pose(self, camera: Pose) -> Pose:
        """Return where the square lies if the camera stands at a pose of a map; the inverse of `camera_pose`."""
        east_m, north_m = camera.to_map(np.array([self.middle_m]))[0].tolist()
        return replace(camera, easting_m=east_m, northing_m=north_m)


def cell_of_view_m(side_m: float) -> float:
    """Return the side of a cell of a view, metres, as the suites have it: finer ones of small views."""
    return _CELLS_M[side_m > _FINE_M]


def list_pictures(path: Path, *, is_told: bool = True) -> list[Path]:
    """Return the pictures of a folder and of those below it, sorted by path, or the one file that is named.

    Pictures of formats that are not read are told, unless they were before. Raise `ImageError` if there is no picture,
    or it is an archive.
    """
    if path.is_dir():
        files = sorted(one for one in path.rglob("*") if one.is_file())
        files = [one for one in files if not any(part.startswith(".") for part in one.relative_to(path).parts)]
        found = [one for one in files if one.suffix.lower() in SUFFIXES]
        other = Counter(one.suffix.lower() for one in files if one.suffix.lower() in _UNREAD)
        if other and is_told:
            kinds = ", ".join(f"{count} {suffix}" for suffix, count in other.most_common())
            tell(f"passed over in {path}: {kinds}: export photos as JPEG, and name each video by itself")
        if not found:
            videos = ", or one of its videos" if any(suffix in VIDEOS for suffix in other) else ""
            raise ImageError(f"{path} holds no picture ({', '.join(SUFFIXES)}): name a folder that does{videos}")
        return found
    if not path.is_file():
        raise ImageError(f"there is no picture or folder {path}: check the path")
    if path.suffix.lower() in ARCHIVES:
        raise ImageError(f"{path} is an archive: unpack it and name the folder")
    return [path]


def open_picture(path: Path, told: Told | None = None) -> OwnPicture:
    """Read what a file, or the user in its place, says of a picture; no pixel is decoded.

    Raises
    ------
    ImageError
        If the file is no picture, or damaged.
    CameraError
        If its size on the ground is not known, or the camera does not look at the ground.

    Examples
    --------
    >>> open_picture(Path("garden.jpg"))
    Traceback (most recent call last):
        ...
    sasgeo_bench.core.errors.ImageError: there is no photo garden.jpg: check the path
    """
    told = told or Told()
    if path.suffix.lower() in (".tif", ".tiff") and (found := _georeferenced(path)) is not None:
        names = {"--height": told.height_m, "--ground-width": told.ground_width_m, "--dem": told.dem}
        given = " and ".join(name for name, value in names.items() if value is not None)
        return replace(found, note=f"{given} passed over: its georeference tells its size") if given else found
    if path.suffix.lower() in (".png", ".webp"):  # without metadata of a drone that anybody writes
        return _plain(path, told)
    return _of_photo(path, read_photo(path), told)


def _plain(path: Path, told: Told) -> OwnPicture:
    if told.ground_width_m is None:
        raise CameraError(f"{path.name} does not say how large its ground is: say --ground-width in metres")
    return OwnPicture(path=path, scale_sigma=0.03, note=_STRAIGHT)


def _of_photo(path: Path, photo: Photo, told: Told) -> OwnPicture:
    if photo.gimbal_fault:
        raise CameraError(f"{path.name} has {photo.gimbal_fault}: use the drone's own file")
    lonlat = None if photo.lon_deg is None or photo.lat_deg is None else (photo.lon_deg, photo.lat_deg)
    place_fault = f"position passed over: {photo.place_fault}" if photo.place_fault else ""
    known = OwnPicture(
        path=path,
        lonlat=lonlat,
        position_by="EXIF" if lonlat else "",
        scale_sigma=0.03,
        taken_at=photo.taken_at,
        note="; ".join(filter(None, ["" if photo.gimbal else _STRAIGHT, place_fault])),
    )
    if told.ground_width_m is not None:
        if photo.gimbal is None:
            return known
        raise CameraError(f"{path.name} says how its camera stood: say --height in place of --ground-width")
    height_m = photo.height_m if told.height_m is None else told.height_m
    if height_m is None and told.dem is not None:
        height_m = _height_over(told.dem, path.name, photo, lonlat)
        known = replace(
            known, note="; ".join(filter(None, [known.note, f"height above the ground by {told.dem.name}"]))
        )
    if height_m is None:
        raise CameraError(
            f"{path.name} does not say how high the drone was: say --height in metres above the ground, or "
            "--ground-width"
        )
    if not height_m > 0:
        raise CameraError(f"{path.name} was taken {height_m:+g} m above take-off: say --height above the ground")
    try:
        lens = photo.intrinsics()
    except CameraError as error:
        raise CameraError(f"{error}; or say --ground-width") from error
    gimbal = photo.gimbal or Attitude(pitch_deg=-90.0)
    # Anywhere on the central meridian of a zone, where north is that of the grid: headings stay against true north.
    placed = replace(photo, lon_deg=_MERIDIAN_DEG, lat_deg=0.0, place_fault="", gimbal=gimbal)
    sensor = placed.camera(height_m=height_m, intrinsics=lens)
    if sensor.tilt_deg > STEEPEST_DEG:
        raise CameraError(
            f"{path.name} looks {sensor.tilt_deg:.0f} degrees away from straight down, at most {STEEPEST_DEG:g} are "
            "read: leave it out"
        )
    by = "gimbal" if photo.gimbal else ""
    return replace(
        known,
        heading_deg=sensor.yaw_deg if by else None,
        heading_by=by,
        scale_sigma=0.10,
        camera=sensor.above_origin(),
        height_m=height_m,
    )


def _height_over(dem: Path, name: str, photo: Photo, lonlat: tuple[float, float] | None) -> float:
    """Return how high a photo was taken above the ground beneath it."""
    if lonlat is None:
        raise CameraError(f"{name} has no position, at which --dem tells the ground: say --height above the ground")
    epsg = utm_epsg(*lonlat)
    place_m = np.array([to_grid(*lonlat, epsg)[:2]])
    ground_m = float(ground_around(dem, place_m, epsg).heights_m(place_m)[0])
    found = height_above(ground_m, photo.altitude_m, is_ellipsoidal=photo.is_ellipsoidal)
    if isinstance(found, str):
        raise CameraError(f"{name} is a photo {found}: say --height above the ground")
    return found


def ground_around(dem: Path, places_m: NDArray[np.float64], epsg: int) -> Dem:
    """Read the heights of the ground around cameras, (N, 2); raise `ConfigError` if they cannot be read, or end there.

    Both they and altitudes of pictures are taken to count from the sea.
    """
    low, high = places_m.min(axis=0) - _AROUND_M, places_m.max(axis=0) + _AROUND_M
    grid = Grid.from_bounds(*low.tolist(), *high.tolist(), cell_size_m=_DEM_CELL_M, epsg=epsg)
    try:
        return read_dem(dem, grid)
    except CameraError as error:
        raise ConfigError(str(error)) from error


def height_above(ground_m: float, altitude_m: float | None, *, is_ellipsoidal: bool) -> float | str:
    """Return the height of a camera above the ground, metres, or why it is not known.

    >>> height_above(430.0, 512.5, is_ellipsoidal=False), height_above(430.0, None, is_ellipsoidal=False)
    (82.5, 'without an altitude')
    """
    if altitude_m is None:
        return "without an altitude"
    if is_ellipsoidal:
        return "whose altitude counts from the ellipsoid, where the ground's heights do from the sea: convert it"
    return altitude_m - ground_m if math.isfinite(ground_m) else "beyond the heights of the ground"


def _georeferenced(path: Path) -> OwnPicture | None:
    """Return a picture with a place on earth; None if the file says none."""
    try:
        with open_geotiff(path) as source:
            if source.crs is None or source.transform.is_identity:
                return None
            if has_open_datum(CRS.from_wkt(source.crs.to_wkt())):
                raise ImageError(
                    f"{path} has a coordinate system that leaves the datum open, so that it may lie a hundred metres "
                    "off: write the right one into it (gdal_edit.py -a_srs EPSG:...)"
                )
            ground = _Ground.of(source)
    except RasterioError as error:
        if isinstance(error, CRSError):
            raise ImageError(f"{path} has a coordinate system that is not known ({error}): warp it") from error
        return None  # no TIFF that GDAL reads: a photo, or damaged, which is refused as such
    except (ProjError, GridError) as error:
        raise ImageError(f"{path} lies nowhere on earth ({error}): check its georeference") from error
    return OwnPicture(
        path=path,
        lonlat=ground.lonlat,
        position_by="georeference",
        heading_deg=ground.true_heading_deg,
        heading_by="georeference",
        scale_sigma=0.03,
        gsd_m=ground.gsd_m,
        size_m=ground.size_m,
    )


@dataclass(frozen=True, slots=True, kw_only=True)
class _Ground:
    """The middle of a georeferenced picture: where, how large its pixels are, and which way up is, in a UTM zone."""

    epsg: int
    lonlat: tuple[float, float]
    middle_m: tuple[float, float]
    gsd_m: float
    heading_deg: float  # of the picture's up in the grid
    true_heading_deg: float
    size_m: tuple[float, float]

    @classmethod
    def of(cls, source: rasterio.io.DatasetReader) -> Self:
        to_lonlat = Transformer.from_crs(source.crs.to_wkt(), 4326, always_xy=True)
        col, row = source.width / 2, source.height / 2
        x, y = source.transform @ (col, row)
        lon_deg, lat_deg = to_lonlat.transform(x, y, errcheck=True)
        epsg = utm_epsg(lon_deg, lat_deg)
        projected = Transformer.from_crs(source.crs.to_wkt(), epsg, always_xy=True)
        # Over many pixels: of one, rounding would show.
        cols = np.array([col, 0, source.width, col, col])
        rows = np.array([row, row, row, 0, source.height])
        xs, ys = source.transform @ (cols, rows)
        east, north = projected.transform(xs, ys, errcheck=True)
        across, up = (east[2] - east[1], north[2] - north[1]), (east[3] - east[4], north[3] - north[4])
        width_m, height_m = math.hypot(*across), math.hypot(*up)
        gsd_m = math.sqrt(abs(across[0] * up[1] - across[1] * up[0]) / (source.width * source.height))
        if not (math.isfinite(gsd_m) and gsd_m > 0):
            raise GridError(f"pixels of {gsd_m!r} m")
        heading_deg = float(bearing_deg(*up))
        _, _, convergence_deg = to_grid(lon_deg, lat_deg, epsg)
        return cls(
            epsg=epsg,
            lonlat=(lon_deg, lat_deg),
            middle_m=(float(east[0]), float(north[0])),
            gsd_m=gsd_m,
            heading_deg=heading_deg,
            true_heading_deg=(heading_deg - convergence_deg) % 360.0,
            size_m=(width_m, height_m),
        )


def see(picture: OwnPicture, told: Told | None = None) -> Sight:
    """Decode a picture, or the part of it that a view needs, with pixels no finer than a segmenter needs.

    Raises
    ------
    ImageError
        If its pixels are damaged, or too many.
    CameraError
        If it shows less ground than `LEAST_M` a side.
    """
    return fitted(see_whole(picture, told))


def see_whole(picture: OwnPicture, told: Told | None = None) -> Sight:
    """Decode a picture as `see` does, with all of a photo and all its pixels."""
    name = picture.path.name
    image = _decoded(picture, told or Told(), name)
    middle_m, side_m = largest_square(image.camera.footprint(Plane()))
    if side_m < LEAST_M:
        raise CameraError(
            f"{name} shows a square of {side_m:.0f} m, a view has at least {LEAST_M:g} m: check the height, or "
            "leave it out"
        )
    return Sight(image=image, middle_m=middle_m, side_m=side_m)


def _decoded(picture: OwnPicture, told: Told, name: str) -> AerialImage:
    if picture.camera is None and picture.position_by == "georeference":
        rgb, gsd_m = _read_georeferenced(picture)
        return AerialImage.from_above(rgb, gsd_m=gsd_m)
    rgb = decode_image(read_bounded(picture.path, MOST_BYTES), name=name)
    if picture.camera is None:
        assert told.ground_width_m is not None  # noqa: S101 - by `open_picture`
        gsd_m = told.ground_width_m / rgb.shape[1]
        if gsd_m > 5.0:  # metres: no house would be seen
            raise CameraError(
                f"{name} would have pixels of {gsd_m:.1f} m by --ground-width, at most 5 show a map's things"
            )
        return AerialImage.from_above(rgb, gsd_m=gsd_m)
    lens = picture.camera.intrinsics
    if rgb.shape[:2] != (lens.height_px, lens.width_px):
        raise ImageError(
            f"{name} has {rgb.shape[1]} x {rgb.shape[0]} pixels, its head says another size: copy it again"
        )
    return AerialImage(rgb=rgb, camera=picture.camera)


def largest_square(footprint: shapely.Polygon, *, most_m: float = WIDEST_M) -> tuple[tuple[float, float], float]:
    """Return middle and side of the largest north-up square in a footprint that is as long as `most_m` at most.

    Its middle lies on the line north of the footprint's; of several, the nearest to the origin is taken, where pixels
    are finest.

    >>> largest_square(shapely.box(-30, -20, 30, 20))
    ((0.0, 0.0), 40.0)
    """
    if footprint.is_empty:
        return (0.0, 0.0), 0.0
    west, south, east, north = footprint.bounds
    shapely.prepare(footprint)
    found = ((0.0, 0.0), 0.0)
    for y in sorted(np.linspace(south, north, _STEPS).tolist(), key=abs):
        line = footprint.intersection(shapely.LineString([(west, y), (east, y)]))
        if line.is_empty:
            continue
        x = line.centroid.x
        low, high = 0.0, min(most_m, 2 * (north - south), 2 * (east - west))
        for _ in range(20):  # halvings: to a millimetre
            side = (low + high) / 2
            half = side / 2 - 1e-6
            is_in = half <= 0 or footprint.covers(shapely.box(x - half, y - half, x + half, y + half))
            low, high = (side, high) if is_in else (low, side)
        if low > found[1] + 0.01:  # a centimetre
            found = ((x, y), low)
    (x, y), side = found
    return (round(x, 3), round(y, 3)), round(side, 2)


def fitted(sight: Sight) -> Sight:
    """Return what a picture shows with the part of it around the view, and pixels no finer than `FINEST_M`."""
    image = sight.image
    reach = sight.side_m / 2 * _MARGIN
    steps = np.linspace(-reach, reach, 9)
    en_m = np.stack(np.meshgrid(steps, steps), axis=-1).reshape(-1, 2) + sight.middle_m
    points = image.camera.project(np.column_stack([en_m, np.zeros(len(en_m))]))
    points = points[np.isfinite(points).all(axis=1)]
    rows, cols = image.shape
    left, top = np.floor(points.min(axis=0)).clip(0).astype(int).tolist()
    right, bottom = np.minimum(np.ceil(points.max(axis=0)).astype(int), (cols, rows)).tolist()
    part = image.cropped(top, left, bottom - top, right - left)
    gsd_m = sight.side_m / max(1.0, float(np.ptp(points, axis=0).min()) / _MARGIN)
    factor = int(FINEST_M / gsd_m)
    return replace(sight, image=part if factor < 2 else averaged(part, factor))


def averaged(image: AerialImage, factor: int) -> AerialImage:
    """Return a picture with pixels so many times as wide; rows and columns that fill no whole pixel are left out."""
    rows, cols = (side // factor for side in image.shape)
    rgb = cv2.resize(image.rgb[: rows * factor, : cols * factor], (cols, rows), interpolation=cv2.INTER_AREA)
    small = resized(image.camera.intrinsics, (cols, rows), (1 / factor, 1 / factor))
    return replace(image, rgb=np.ascontiguousarray(rgb), camera=replace(image.camera, intrinsics=small))


def resized(lens: Intrinsics, size_px: tuple[int, int], times: tuple[float, float]) -> Intrinsics:
    """Return the lens of a picture of another size, width and height, that shows the same so many times as large.

    >>> lens = Intrinsics.from_field_of_view(horizontal_deg=90.0, width_px=400, height_px=300)
    >>> resized(lens, (200, 150), (0.5, 0.5)).focal_px
    (100.0, 100.0)
    """
    (focal_x, focal_y), (centre_x, centre_y) = lens.focal_px, lens.centre_px
    return replace(
        lens,
        width_px=size_px[0],
        height_px=size_px[1],
        focal_px=(focal_x * times[0], focal_y * times[1]),
        centre_px=(centre_x * times[0], centre_y * times[1]),
    )


def _read_georeferenced(picture: OwnPicture) -> tuple[NDArray[np.uint8], float]:
    """Read the middle of a georeferenced picture in its own axes: what a view needs; black where it is empty."""
    path = picture.path
    try:
        with open_geotiff(path, has_more=True) as source:
            ground = _Ground.of(source)
            bands = find_bands(path, source)
            gsd_m = max(ground.gsd_m, FINEST_M)
            cols, rows = (max(2, round(min(side, WIDEST_M * _MARGIN) / gsd_m)) for side in ground.size_m)
            turned = Affine.translation(*ground.middle_m) @ Affine.rotation(-ground.heading_deg)
            transform = turned @ Affine.scale(gsd_m, -gsd_m) @ Affine.translation(-cols / 2, -rows / 2)
            view = selected(source, bands)
            with (
                rasterio.open(view, driver="VRT") if view else source as shown,
                WarpedVRT(
                    shown,
                    crs=f"EPSG:{ground.epsg}",
                    transform=transform,
                    height=rows,
                    width=cols,
                    resampling=Resampling.average if gsd_m > 1.5 * ground.gsd_m else Resampling.cubic,
                    add_alpha=ColorInterp.alpha not in shown.colorinterp,
                    init_dest_nodata=False,
                ) as warped,
            ):
                alpha = warped.colorinterp.index(ColorInterp.alpha) + 1
                found = warped.read((1, 2, 3, alpha))
    except (RasterioError, OSError) as error:
        if isinstance(error, SasgeoError):
            raise
        raise ImageError(f"{path} is damaged ({str(error)[:200]}): get it again") from error
    rgb = np.where(found[3] > 0, found[:3], 0).astype(np.uint8)
    if not (found[3] > 0).any():
        raise ImageError(f"{path} shows nothing around its middle: name a part of it that does")
    return np.ascontiguousarray(np.moveaxis(rgb, 0, -1)), gsd_m


def names_of(paths: Sequence[Path], root: Path) -> list[str]:
    """Return the names by which pictures are known: relative to the folder that was named."""
    return [path.relative_to(root).as_posix() if root.is_dir() else path.name for path in paths]
