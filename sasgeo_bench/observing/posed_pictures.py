# SPDX-License-Identifier: Apache-2.0
"""Pictures of a user's own with the pose of each in the CRS of a map, from their files, a table and heights."""

import datetime as dt
import math
import re
import warnings
from collections import Counter, defaultdict
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from io import BytesIO
from pathlib import Path
from typing import Final

import numpy as np
from PIL import ExifTags, Image
from rasterio.errors import RasterioError

from sasgeo_bench.core.errors import CameraError, ConfigError, ImageError, SasgeoError, counted
from sasgeo_bench.core.geotiff import open_geotiff
from sasgeo_bench.core.paths import read_bounded
from sasgeo_bench.core.texts import plain
from sasgeo_bench.geometry.pose import Pose
from sasgeo_bench.geometry.projection import WGS84, to_grid
from sasgeo_bench.observing.picture_poses import STRAIGHT_DOWN, PicturePose, PoseTable, picture_heading_deg
from sasgeo_bench.observing.pictures import (
    LEAST_M,
    STEEPEST_DEG,
    WIDEST_M,
    OwnPicture,
    ground_around,
    height_above,
    largest_square,
    list_pictures,
    names_of,
    open_picture,
    resized,
)
from sasgeo_bench.sensing.camera import Attitude, Camera, Intrinsics
from sasgeo_bench.sensing.ground import Dem, Plane
from sasgeo_bench.sensing.photos import DJI, MOST_BYTES, Photo, PhotoHead, number_of, photo_of, read_head

GPS_SIGMA_M: Final = 3.3  # of one axis: 95 % within 8 m, as the GPS performance standard of 2020 states it
_TILT_SIGMA: Final = 0.0175  # metres to a metre of height: a gimbal is right to a degree
_SAME_SHAPE: Final = 0.01  # by which the aspects of a picture and of a smaller copy differ, from rounding
_NADIR_DEG: Final = 5.0  # of tilt: a camera that leans less looks straight down, but for the wind
_FINE_M: Final = 0.5  # of a standard deviation, below which the datum of a place counts: plates move by 0.02 m a year


@dataclass(frozen=True, kw_only=True)
class Heights:
    """How high cameras were above the ground, where that is not what their files say.

    One of them at most is given: a height above the ground of all pictures; heights of the ground, a GeoTIFF; or the
    altitude of the place of take-off. Raise `ConfigError` otherwise.
    """

    height_m: float | None = None
    dem: Path | None = None
    takeoff_m: float | None = None

    def __post_init__(self) -> None:
        if sum(value is not None for value in (self.height_m, self.dem, self.takeoff_m)) > 1:
            raise ConfigError("heights come from one source: give --height, --dem or --takeoff-height alone")
        if self.height_m is not None and not 0 < self.height_m <= 10_000:
            raise ConfigError(f"--height lies above 0 and within 10000 m, got {self.height_m!r}")


@dataclass(frozen=True, kw_only=True)
class PosedPicture:
    """A picture whose pose is known.

    Parameters
    ----------
    name : str
        By which messages call it.
    picture : OwnPicture
        Its camera above the origin, the picture's up being north.
    pose : Pose
        Of the middle of its view on the map, with the picture's up for its heading.
    sigma_m : float
        Standard deviation of that place along one axis, metres.
    position_m : tuple of float
        Easting, northing and height above the ground of the camera, metres.
    side_m : float
        Of the view.
    time_s : float, optional
        Seconds since 1970, by the camera's clock or the table's.
    lens : str
        What tells cameras apart: model and size.
    is_turned : bool
        Whether EXIF turns what the file stores.
    """

    name: str
    picture: OwnPicture
    pose: Pose
    sigma_m: float
    position_m: tuple[float, float, float]
    side_m: float
    time_s: float | None = None
    lens: str = ""
    is_turned: bool = False


@dataclass(kw_only=True)
class PosedPictures:
    """Pictures with poses in the order of their names, and the others by reason; `notes` are lines for the user."""

    pictures: list[PosedPicture] = field(default_factory=list)
    left_out: "defaultdict[str, list[str]]" = field(default_factory=lambda: defaultdict(list))
    notes: list[str] = field(default_factory=list)

    def leave_out(self, why: Callable[[PosedPicture], str]) -> None:
        """Leave out each picture for the reason that is given of it, if one is."""
        reasons = [why(one) for one in self.pictures]
        for one, reason in zip(self.pictures, reasons, strict=True):
            if reason:
                self.left_out[reason].append(one.name)
        self.pictures = [one for one, reason in zip(self.pictures, reasons, strict=True) if not reason]


def pose_pictures(
    folder: Path, table: PoseTable | None, *, epsg: int, heights: Heights, sigma_m: float | None = None
) -> PosedPictures:
    """Return the pictures of a folder with their poses in a projected CRS; no pixel of a photo is decoded.

    Parameters
    ----------
    folder : Path
        Of photos and georeferenced pictures.
    table : PoseTable, optional
        Poses that replace what photos say of themselves, as far as it has them.
    epsg : int
        CRS of a map.
    heights : Heights
        Where heights above the ground come from.
    sigma_m : float, optional
        Standard deviation of places, for all pictures whose file or row does not state it.

    Raises
    ------
    ConfigError
        If the ground's heights do not cover the pictures.
    ImageError
        If there is no picture. A picture that has no pose is left out, with its reason.
    """
    found = PosedPictures()
    paths = list_pictures(folder)
    seen: list[_Stand] = []
    taken: Counter[str] = Counter()
    for path, name in zip(paths, names_of(paths, folder), strict=True):
        try:
            if path.suffix.lower() in (".tif", ".tiff"):
                picture = open_picture(path) if is_georeferenced(path) else None
                if picture is not None and picture.position_by == "georeference":
                    found.pictures.append(from_above(picture, name, epsg, sigma_m))
                    continue
            row = None if table is None else table.find(name)
            if table is not None and row is None:
                found.left_out[table.why_not(name)].append(name)
                continue
            taken[row.name if row is not None else ""] += 1
            hint = STRAIGHT_DOWN if table is None else table.angles_hint
            stand = _stand(path, name, row, hint, epsg=epsg, sigma_m=sigma_m)
        except SasgeoError as error:
            found.left_out[f"that cannot be read ({reason_of(error, path)})"].append(name)
            continue
        if isinstance(stand, str):
            found.left_out[stand].append(name)
        else:
            seen.append(stand)
    for stand in [stand for stand in seen if stand.row is not None and taken[stand.row.name] > 1]:
        seen.remove(stand)
        found.left_out["of one name, for which the table has one row (name their folders there)"].append(stand.name)
    headings = Counter(stand.heading_note for stand in seen if stand.heading_note)
    found.notes += [f"{note} ({counted(count, 'picture')})" for note, count in headings.items()]
    found.notes += _clocks(seen)
    found.notes += _passed_over(heights, found.pictures)
    seen = _in_one_zone(seen, found)
    found.notes += _datums(seen)
    ground = _ground(heights, seen, epsg, found) if seen else None
    for stand in seen:
        posed = _posed(stand, heights, ground)
        if isinstance(posed, str):
            found.left_out[posed].append(stand.name)
        else:
            found.pictures.append(posed)
    found.pictures.sort(key=lambda one: one.name)
    return found


def reason_of(error: SasgeoError, path: Path) -> str:
    """Return the text of an error without the name of its picture or mask, so that like faults are counted together.

    >>> reason_of(ImageError("photos/1.jpg is no JPEG"), Path("photos/1.jpg"))
    'it is no JPEG'
    >>> reason_of(ImageError("most of what 1.png holds is 1.5"), Path("photos/1.jpg"))
    'most of what it holds is 1.5'
    """
    text = plain(str(error)).replace(plain(str(path)), "it").replace(plain(path.name), "it")
    return re.sub(rf"(?<!\w){re.escape(plain(path.stem))}\.[A-Za-z]\w*", "it", text)[:160]


def is_georeferenced(path: Path) -> bool:
    """Return whether a file is a TIFF that says where it lies."""
    try:
        with open_geotiff(path) as source:
            return source.crs is not None and not source.transform.is_identity
    except RasterioError:
        return False


def from_above(picture: OwnPicture, name: str, epsg: int, sigma_m: float | None) -> PosedPicture:
    """Return a georeferenced picture, which is seen from straight above; raise `CameraError` if it is too small."""
    assert picture.lonlat is not None  # noqa: S101 - by its georeference
    assert picture.size_m is not None  # noqa: S101 - by its georeference
    side_m = min(WIDEST_M, *picture.size_m)
    if side_m < LEAST_M:
        raise CameraError(f"{name} shows a square of {side_m:.0f} m, a view has at least {LEAST_M:g} m")
    east_m, north_m, convergence_deg = to_grid(*picture.lonlat, epsg)
    yaw_deg = ((picture.heading_deg or 0.0) + convergence_deg) % 360.0
    return PosedPicture(
        name=name,
        picture=picture,
        pose=Pose(easting_m=east_m, northing_m=north_m, yaw_deg=yaw_deg),
        sigma_m=GPS_SIGMA_M if sigma_m is None else sigma_m,
        position_m=(east_m, north_m, 0.0),
        side_m=side_m,
        lens=f"georeferenced, pixels of {picture.gsd_m or 0.0:.2f} m",
    )


@dataclass(frozen=True, kw_only=True)
class _Stand:
    """A photo before its height above the ground is known."""

    path: Path
    name: str
    photo: Photo
    row: PicturePose | None
    place_m: tuple[float, float]
    sigma_m: float
    epsg: int
    heading_note: str = ""
    zone_s: float = 0.0  # by which the clock is ahead of UTC, where it must be known

    @property
    def altitude(self) -> tuple[float | None, str]:
        if self.row is not None and self.row.altitude_m is not None:
            return self.row.altitude_m, self.row.altitude_of
        return self.photo.altitude_m, "ellipsoid" if self.photo.is_ellipsoidal else "sea"

    @property
    def exif_s(self) -> float | None:
        taken = self.photo.taken_at
        return None if taken is None else taken.replace(tzinfo=dt.UTC).timestamp()

    @property
    def taken_s(self) -> float | None:
        return None if self.exif_s is None else self.exif_s - self.zone_s

    @property
    def height_m(self) -> float | None:
        return self.photo.height_m if self.row is None or self.row.height_m is None else self.row.height_m

    def camera(self, height_m: float) -> Camera:
        lens = None if self.row is None or self.row.intrinsics is None else _fitted(self.row.intrinsics, self.photo)
        camera = self.photo.camera(epsg=self.epsg, height_m=height_m, intrinsics=lens)
        # A place in another datum came straight to the map's CRS.
        return camera.moved(east_m=self.place_m[0] - camera.east_m, north_m=self.place_m[1] - camera.north_m)


def _fitted(lens: Intrinsics, photo: Photo) -> Intrinsics | None:
    """Return the lens of a table for the picture at hand, which may be a smaller copy; None if it is another picture.

    Tools that scale pictures round their sides, each by itself.
    """
    across, down = photo.width_px / lens.width_px, photo.height_px / lens.height_px
    if abs(across / down - 1) > _SAME_SHAPE:
        return None
    return resized(lens, (photo.width_px, photo.height_px), (across, down))


def _stand(
    path: Path, name: str, row: PicturePose | None, hint: str, *, epsg: int, sigma_m: float | None
) -> _Stand | str:
    """Return where a photo was taken, or why that is not known; `hint` says how angles of cameras can be told."""
    photo, of_file_m = _photo(path)
    heading_note = ""
    if row is not None:
        if photo.orientation != 1 and not (row.attitude is None and row.heading_deg is None):
            return "that EXIF turns, so that the table's angles may be of another picture"
        lon, lat = row.lonlat
        photo = replace(photo, lon_deg=lon, lat_deg=lat, place_fault="")
        if row.attitude is not None:
            photo = replace(photo, gimbal=row.attitude, gimbal_fault="")
        elif row.heading_deg is not None:
            photo, heading_note = _headed(photo, row.heading_deg)
    if photo.place_fault:
        return f"with a position {photo.place_fault}: convert it"
    if photo.lon_deg is None or photo.lat_deg is None:
        return "without a position (say --poses or --track, or copy the drone's own files)"
    if photo.gimbal is None:
        return f"without angles of the camera ({hint})"
    place_m = to_grid(photo.lon_deg, photo.lat_deg, epsg)[:2] if row is None else row.in_crs(epsg)
    stated = of_file_m if row is None else row.sigma_m
    stated = sigma_m if stated is None else stated
    return _Stand(
        path=path,
        name=name,
        photo=photo,
        row=row,
        place_m=place_m,
        sigma_m=GPS_SIGMA_M if stated is None else stated,
        epsg=epsg,
        heading_note=heading_note,
    )


def _headed(photo: Photo, heading_deg: float) -> tuple[Photo, str]:
    """Return a photo with the heading of a table that has no pitch, and what to say of it."""
    gimbal = Attitude(pitch_deg=-90.0) if photo.gimbal is None and not photo.gimbal_fault else photo.gimbal
    if gimbal is None or gimbal.matrix[2, 0] < math.cos(math.radians(_NADIR_DEG)):
        return photo, "not used: the table's heading, without a pitch, of cameras that do not look straight down"
    more_deg = heading_deg - picture_heading_deg(gimbal)
    note = "the table has a heading and no pitch: taken as cameras that look straight down"
    return replace(photo, gimbal=replace(gimbal, yaw_deg=gimbal.yaw_deg + more_deg)), note


def _photo(path: Path) -> tuple[Photo, float | None]:
    """Return what a file says of its picture, and the standard deviation of its place if it states one."""
    if path.suffix.lower() in (".png", ".webp"):
        try:
            data = read_bounded(path, MOST_BYTES)
            with warnings.catch_warnings(), Image.open(BytesIO(data), formats=("PNG", "WEBP")) as image:
                warnings.simplefilter("ignore")  # of Pillow: odd metadata
                # Pillow decodes a PNG to look for EXIF behind its pixels.
                exif = image.getexif() if "exif" in image.info or b"exif" in data.lower() else {}
                turned: Mapping[int, int] = {ExifTags.Base.Orientation: exif.get(ExifTags.Base.Orientation, 1)}
                head = PhotoHead(size_px=image.size, exif=turned, inner={}, gps={}, xmp={})
        except Exception as error:  # Pillow fails at damaged files with errors of many kinds
            raise ImageError(f"{path.name} is no sound picture: copy it again") from error
        return photo_of(path.name, head), None
    head = read_head(path)
    spreads = [number_of(head.xmp.get((DJI, f"RtkStd{axis}"))) for axis in ("Lon", "Lat")]
    known = [value for value in spreads if value is not None and value > 0]
    sigma_m = max(known) if len(known) == 2 else number_of(head.gps.get(ExifTags.GPS.GPSHPositioningError))
    return photo_of(path.name, head), sigma_m if sigma_m is not None and sigma_m > 0 else None


def _clocks(seen: Sequence[_Stand]) -> list[str]:
    """Return a line where a table has other times than the photos themselves, both by a local clock."""
    off_s = [
        stand.row.time_s - stand.exif_s
        for stand in seen
        if stand.row is not None and stand.row.clock == "local" and stand.row.time_s and stand.exif_s is not None
    ]
    odd = [value for value in off_s if abs(value) > 1.0]  # EXIF counts seconds
    if not odd:
        return []
    off = f"{float(np.median(odd)):+.0f} s (median) off EXIF at {len(odd)} of {counted(len(off_s), 'picture')}"
    return [f"clocks disagree: the table is {off}; the table's times are taken"]


def _passed_over(heights: Heights, georeferenced: Sequence[PosedPicture]) -> list[str]:
    """Return a line where heights are given for pictures that need none."""
    if heights == Heights() or not georeferenced:
        return []
    return [f"heights are passed over of {counted(len(georeferenced), 'georeferenced picture')}: each tells its size"]


def _datums(seen: Sequence[_Stand]) -> list[str]:
    """Return a line where places are so good that it counts by which datum they are, and none says so."""
    fine = [stand for stand in seen if stand.sigma_m < _FINE_M and (stand.row is None or stand.row.epsg == WGS84)]
    if not fine:
        return []
    good = f"places of {counted(len(fine), 'picture')} are good to less than {_FINE_M:g} m, and taken as WGS 84"
    return [
        f"{good} of the day: a network in ETRS89, NAD83 or GDA2020 lies up to 2 m off, say its CRS by --poses, --epsg"
    ]


def _in_one_zone(seen: Sequence[_Stand], found: PosedPictures) -> list[_Stand]:
    """Return photos whose clocks go together, in UTC where they are of several zones, and say so."""
    counts = Counter(stand.photo.utc_offset for stand in seen if stand.photo.taken_at is not None)
    if len(counts) < 2:
        return list(seen)
    if None in counts:
        found.notes.append(
            f"clocks: {counts[None]} of {counted(counts.total(), 'photo')} state no zone (EXIF's OffsetTimeOriginal): "
            "all are taken to be of one"
        )
        return list(seen)
    found.notes.append(f"clocks: photos of {len(counts)} zones, whose times are taken in UTC")
    offsets_s = [0.0 if stand.photo.utc_offset is None else stand.photo.utc_offset.total_seconds() for stand in seen]
    return [replace(stand, zone_s=zone_s) for stand, zone_s in zip(seen, offsets_s, strict=True)]


def _ground(heights: Heights, seen: Sequence[_Stand], epsg: int, found: PosedPictures) -> Dem | None:
    """Read the heights of the ground around all cameras, and say what they count from."""
    if heights.dem is None:
        return None
    dem = ground_around(heights.dem, np.array([stand.place_m for stand in seen]), epsg)
    found.notes.append(
        f"heights of the ground by {heights.dem.name}, taken to be above the sea as GLO-30 (EGM2008) and SRTM (EGM96) "
        "are; altitudes of the pictures as well: they may differ by the receiver's own geoid"
    )
    return dem


def _posed(stand: _Stand, heights: Heights, dem: Dem | None) -> PosedPicture | str:
    """Return a photo with the pose of its view, or why it has none."""
    height_m = _height(stand, heights, dem, stand.place_m)
    if isinstance(height_m, str):
        return height_m
    for _ in range(3 if dem is not None else 1):  # the ground of the view lies beside that beneath the camera
        if not height_m > 0:
            return "that were not above the ground"
        try:
            camera = stand.camera(height_m)
        except CameraError as error:
            return f"whose camera is not known ({reason_of(error, stand.path)})"
        if camera.tilt_deg > STEEPEST_DEG:
            return f"that look more than {STEEPEST_DEG:g} degrees away from straight down"
        above = camera.above_origin()
        middle_m, side_m = largest_square(above.footprint(Plane()))
        if side_m < LEAST_M:
            return f"that show less ground than {LEAST_M:g} m a side"
        here = Pose(easting_m=camera.east_m, northing_m=camera.north_m, yaw_deg=camera.yaw_deg)
        east_m, north_m = here.to_map(np.array([middle_m]))[0].tolist()
        if dem is not None:
            found_m = _height(stand, heights, dem, (east_m, north_m))
            height_m = found_m if isinstance(found_m, float) else height_m
    sigma_m = float(np.hypot(stand.sigma_m, _TILT_SIGMA * camera.height_m))
    photo, row = stand.photo, stand.row
    return PosedPicture(
        name=stand.name,
        picture=OwnPicture(
            path=stand.path,
            lonlat=(photo.lon_deg, photo.lat_deg),  # type: ignore[arg-type]
            position_by="EXIF" if row is None else "table",
            scale_sigma=0.03 if dem is not None or heights.height_m is not None else 0.10,
            taken_at=photo.taken_at,
            camera=above,
            height_m=camera.height_m,
        ),
        pose=replace(here, easting_m=east_m, northing_m=north_m),
        sigma_m=round(sigma_m, 2),
        position_m=(camera.east_m, camera.north_m, camera.height_m),
        side_m=side_m,
        time_s=row.time_s if row is not None and row.time_s is not None else stand.taken_s,
        lens=f"{photo.model or 'camera'} {photo.width_px} x {photo.height_px}",
        is_turned=photo.orientation != 1,
    )


def _height(stand: _Stand, heights: Heights, dem: Dem | None, at_m: tuple[float, float]) -> float | str:
    """Return the height of a camera above the ground of a place, metres, or why it is not known."""
    if heights.height_m is not None:
        return heights.height_m
    altitude_m, of = stand.altitude
    if dem is None and heights.takeoff_m is None:
        return (
            "whose height above the ground is not known (say --height, --dem or --takeoff-height)"
            if (stand.height_m is None)
            else stand.height_m
        )
    ground_m = heights.takeoff_m
    if ground_m is None:
        assert dem is not None  # noqa: S101 - one of both
        ground_m = float(dem.heights_m(np.array([at_m]))[0])
    return height_above(ground_m, altitude_m, is_ellipsoidal=of == "ellipsoid")


def lenses_of(pictures: Sequence[PosedPicture]) -> Mapping[str, int]:
    """Return the cameras of some pictures with how many each took, most first."""
    counts: defaultdict[str, int] = defaultdict(int)
    for one in pictures:
        counts[one.lens] += 1
    return dict(sorted(counts.items(), key=lambda item: -item[1]))
