# SPDX-License-Identifier: Apache-2.0
"""Photos of drones: where and how they were taken, by their EXIF and XMP; their pixels are not decoded here."""

import datetime as dt
import math
import warnings
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
import pyproj
from PIL import ExifTags, Image, UnidentifiedImageError

from sasgeo_bench.errors import CameraError, ImageError
from sasgeo_bench.geometry.grid import utm_epsg
from sasgeo_bench.geometry.pose import bearing_deg
from sasgeo_bench.sensing.camera import Attitude, Camera, Mount
from sasgeo_bench.sensing.intrinsics import Intrinsics
from sasgeo_bench.texts import message_of

MOST_BYTES: Final = 64 * 2**20  # of a photo
MOST_PIXELS: Final = 200_000_000

_STRAIGHT_DOWN_DEG: Final = -90.0
_FILM_DIAGONAL_MM: Final = math.hypot(36.0, 24.0)
_WIDEST_SENSOR: Final = 1.55  # width / height; a wider photo is cut out of a sensor of 4 : 3
_FOCAL_PX: Final = (0.3, 20.0)  # in widths of the picture: limits of a calibrated focal length that can be meant
_STEP_DEG: Final = 1e-4  # to the north, by which the grid's north is found

# EXIF's orientation -> right and down of the upright picture in those of the sensor; the others mirror.
_TURNS: Final[dict[int, tuple[tuple[int, int], tuple[int, int]]]] = {
    1: ((1, 0), (0, 1)),
    3: ((-1, 0), (0, -1)),
    6: ((0, -1), (1, 0)),
    8: ((0, 1), (-1, 0)),
}


@dataclass(frozen=True, slots=True, kw_only=True)
class Photo:
    """Metadata of a photo, as its file says it; None where it does not.

    `width_px`, `height_px` are of the upright picture, as `decode_image` returns it; `orientation` is EXIF's number.
    Longitude and latitude are WGS 84. `height_m` counts from the place of take-off, `altitude_m` from the sea (by GNSS
    or barometer, often tens of metres off). Angles are those of the drone's maker, against true north: `gimbal` of the
    camera, with pitch -90 straight down, and `flight` of the body.
    """

    name: str
    width_px: int
    height_px: int
    orientation: int = 1
    lon_deg: float | None = None
    lat_deg: float | None = None
    height_m: float | None = None
    altitude_m: float | None = None
    gimbal: Attitude | None = None
    flight: Attitude | None = None
    focal_mm: float | None = None
    focal_35mm: float | None = None
    focal_px: float | None = None
    taken_at: dt.datetime | None = None
    model: str = ""

    def intrinsics(self) -> Intrinsics:
        """Return a pinhole by the calibrated focal length in the XMP, else by the one on 35 mm film.

        The latter compares diagonals of sensors. A photo of 16 : 9 is taken for a cut out of a sensor of 4 : 3 as wide.
        Expect an error of 1 to 3 %; for better, calibrate the lens. Raise `CameraError` if the photo has neither.

        >>> photo = Photo(name="a.jpg", width_px=4000, height_px=3000, focal_35mm=20.0)
        >>> round(photo.intrinsics().focal_px[0])
        2311
        """
        focal_px = self.focal_px if self.focal_px is not None else self._focal_by_film()
        return Intrinsics(
            width_px=self.width_px,
            height_px=self.height_px,
            focal_px=(focal_px, focal_px),
            centre_px=(self.width_px / 2, self.height_px / 2),
        )

    def _focal_by_film(self) -> float:
        if self.focal_35mm is None:
            message = f"{self.name} has no focal length on 35 mm film: give the camera's intrinsics"
            raise CameraError(message)
        long_px, short_px = max(self.width_px, self.height_px), min(self.width_px, self.height_px)
        sensor_px = math.hypot(long_px, short_px if long_px <= _WIDEST_SENSOR * short_px else long_px * 3 / 4)
        return self.focal_35mm * sensor_px / _FILM_DIAGONAL_MM

    def camera(
        self, *, epsg: int | None = None, height_m: float | None = None, intrinsics: Intrinsics | None = None
    ) -> Camera:
        """Return the camera over level ground at 0, in a projected CRS (the place's UTM zone by default).

        Parameters
        ----------
        epsg : int, optional
            Projected CRS whose easting and northing the camera has; its yaw is against that grid's north.
        height_m : float, optional
            Height above the ground, instead of that above the place of take-off.
        intrinsics : Intrinsics, optional
            Of the upright picture; by the focal length in the file if not given.

        Returns
        -------
        Camera
            At an easting and northing of the CRS, metres. Angles of the gimbal are taken in the order of `Attitude`.

        Raises
        ------
        CameraError
            If the photo lacks place, height or gimbal angles.
        """
        height_m = self.height_m if height_m is None else height_m
        if self.lon_deg is None or self.lat_deg is None or height_m is None or self.gimbal is None:
            facts = {"GPS": self.lon_deg, "height above take-off": height_m, "gimbal angles": self.gimbal}
            lacking = ", ".join(name for name, value in facts.items() if value is None)
            message = f"{self.name} has no pose: {lacking} missing; use the drone's own file, not an edited copy"
            raise CameraError(message)
        crs = epsg or utm_epsg(self.lon_deg, self.lat_deg)
        east_m, north_m, convergence_deg = _to_grid(self.lon_deg, self.lat_deg, crs)
        sensor = Camera.mounted(
            intrinsics=intrinsics or self.intrinsics(),
            east_m=east_m,
            north_m=north_m,
            height_m=height_m,
            body=Attitude(yaw_deg=self.gimbal.yaw_deg + convergence_deg),
            mount=Mount(tilt_deg=self.gimbal.pitch_deg - _STRAIGHT_DOWN_DEG, roll_deg=self.gimbal.roll_deg),
        )
        return sensor.upright(_TURNS[self.orientation])


def _to_grid(lon_deg: float, lat_deg: float, epsg: int) -> tuple[float, float, float]:
    """Return easting, northing and the bearing of true north in the grid, degrees."""
    to_grid = pyproj.Transformer.from_crs("EPSG:4326", f"EPSG:{epsg}", always_xy=True)
    step_deg = -_STEP_DEG if lat_deg > 0 else _STEP_DEG  # never over a pole
    (here_m, there_m), (low_m, high_m) = to_grid.transform([lon_deg, lon_deg], [lat_deg, lat_deg + step_deg])
    sign = math.copysign(1.0, step_deg)
    return here_m, low_m, float(bearing_deg(sign * (there_m - here_m), sign * (high_m - low_m)))


def read_photo(path: Path, *, most_bytes: int = MOST_BYTES, most_pixels: int = MOST_PIXELS) -> Photo:
    """Read the metadata of a drone's photo (JPEG, TIFF, DNG); raise `ImageError` if it is no sound photo.

    Nothing is decoded; limits are on the bytes of the file and the pixels that its head announces. What a file does not
    say is None, so that a photo without pose is refused only where its pose is asked for (`Photo.camera`).
    """
    try:
        _check_bytes(path, most_bytes)
        with warnings.catch_warnings(), Image.open(path, formats=("JPEG", "MPO", "TIFF")) as image:
            warnings.simplefilter("ignore")  # of Pillow: odd metadata; what is needed and odd is refused here
            return _photo_of(path.name, image, most_pixels)
    except ImageError:
        raise
    except (UnidentifiedImageError, Image.DecompressionBombError) as error:
        message = f"{path} is no JPEG or TIFF of a size that can be read ({message_of(error)}): check the file"
        raise ImageError(message) from error
    except FileNotFoundError as error:
        message = f"there is no photo {path}: check the path"
        raise ImageError(message) from error
    except Exception as error:  # Pillow and its XML reader fail at damaged files with errors of many kinds
        message = f"{path} has damaged metadata ({message_of(error)}): copy it again from the drone"
        raise ImageError(message) from error


def _check_bytes(path: Path, most_bytes: int) -> None:
    size = path.stat().st_size
    if size > most_bytes:
        message = f"{path} has {size} bytes, at most {most_bytes} are read: cut it, or scale it down, first"
        raise ImageError(message)


def _photo_of(name: str, image: Image.Image, most_pixels: int) -> Photo:
    width_px, height_px = image.size
    if width_px * height_px > most_pixels:
        message = f"{name} has {width_px} x {height_px} pixels, at most {most_pixels} are read: scale it down first"
        raise ImageError(message)
    exif = image.getexif()
    inner, xmp = exif.get_ifd(ExifTags.IFD.Exif), dict(_leaves(image.getxmp()))
    orientation = exif.get(ExifTags.Base.Orientation, 1)
    if orientation not in _TURNS:
        message = f"{name} is mirrored (EXIF orientation {orientation!r}): use the drone's own file"
        raise ImageError(message)
    if _TURNS[orientation][0][0] == 0:
        width_px, height_px = height_px, width_px
    lon_deg, lat_deg = _place(exif.get_ifd(ExifTags.IFD.GPSInfo))
    return Photo(
        name=name,
        width_px=width_px,
        height_px=height_px,
        orientation=orientation,
        lon_deg=lon_deg,
        lat_deg=lat_deg,
        height_m=_number(xmp.get("RelativeAltitude")),
        altitude_m=_number(xmp.get("AbsoluteAltitude")),
        gimbal=_attitude(xmp, "Gimbal"),
        flight=_attitude(xmp, "Flight"),
        focal_mm=_positive(inner.get(ExifTags.Base.FocalLength)),
        focal_35mm=_positive(inner.get(ExifTags.Base.FocalLengthIn35mmFilm)),
        focal_px=_calibrated(xmp, max(image.size)),
        taken_at=_time(inner.get(ExifTags.Base.DateTimeOriginal)),
        model=str(exif.get(ExifTags.Base.Model, "")).strip("\0 "),
    )


def _leaves(tree: Mapping[str, Any]) -> Iterator[tuple[str, str]]:
    """Yield name and text of everything in XMP; names have no prefix, whether attribute or element."""
    for name, value in tree.items():
        for item in value if isinstance(value, list) else [value]:
            if isinstance(item, Mapping):
                yield from _leaves(item)
            elif isinstance(item, str):
                yield name, item


def _number(value: Any) -> float | None:  # noqa: ANN401 - whatever metadata hold
    """Return a finite number out of EXIF or XMP, which may hold text, fractions of zero or nothing."""
    try:
        number = float(value)
    except (TypeError, ValueError, ZeroDivisionError):
        return None
    return number if math.isfinite(number) else None


def _positive(value: Any) -> float | None:  # noqa: ANN401 - as above
    number = _number(value)
    return number if number is not None and number > 0 else None


def _calibrated(xmp: Mapping[str, str], side_px: int) -> float | None:
    focal_px = _positive(xmp.get("CalibratedFocalLength"))
    low, high = _FOCAL_PX
    return focal_px if focal_px is not None and low * side_px <= focal_px <= high * side_px else None


def _attitude(xmp: Mapping[str, str], whose: str) -> Attitude | None:
    roll_deg, pitch_deg, yaw_deg = (_number(xmp.get(f"{whose}{axis}Degree")) for axis in ("Roll", "Pitch", "Yaw"))
    if roll_deg is None or pitch_deg is None or yaw_deg is None:
        return None
    return Attitude(roll_deg=roll_deg, pitch_deg=pitch_deg, yaw_deg=yaw_deg)


def _place(gps: Mapping[int, Any]) -> tuple[float, float] | tuple[None, None]:
    """Return longitude and latitude, or nothing where there was no fix (0, 0 included)."""
    lon_deg = _degrees(gps.get(ExifTags.GPS.GPSLongitude), gps.get(ExifTags.GPS.GPSLongitudeRef), "E", "W")
    lat_deg = _degrees(gps.get(ExifTags.GPS.GPSLatitude), gps.get(ExifTags.GPS.GPSLatitudeRef), "N", "S")
    if lon_deg is None or lat_deg is None or abs(lon_deg) > 180 or abs(lat_deg) > 90:  # noqa: PLR2004 - the globe
        return None, None
    return (lon_deg, lat_deg) if lon_deg or lat_deg else (None, None)


def _degrees(parts: object, side: object, plus: str, minus: str) -> float | None:
    if not isinstance(parts, tuple) or len(parts) != 3 or side not in (plus, minus):  # noqa: PLR2004 - deg, min, s
        return None
    numbers = [_number(part) for part in parts]
    if None in numbers:
        return None
    degrees = float(np.dot(np.array(numbers, dtype=np.float64), (1, 1 / 60, 1 / 3600)))
    return degrees if side == plus else -degrees


def _time(text: object) -> dt.datetime | None:
    """Return the drone's local time, which names no zone."""
    try:
        return dt.datetime.strptime(str(text).strip("\0 "), "%Y:%m:%d %H:%M:%S")  # noqa: DTZ007 - EXIF has no zone here
    except ValueError:
        return None
