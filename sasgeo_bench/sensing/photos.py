# SPDX-License-Identifier: Apache-2.0
"""Photos of drones: where and how they were taken, by their EXIF and XMP; their pixels are not decoded here."""

import datetime as dt
import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
from PIL import ExifTags

from sasgeo_bench.errors import CameraError, ImageError
from sasgeo_bench.geometry.grid import utm_epsg
from sasgeo_bench.geometry.pose import bearing_deg
from sasgeo_bench.geometry.projection import from_lonlat
from sasgeo_bench.sensing.camera import Attitude, Camera, Mount
from sasgeo_bench.sensing.intrinsics import Intrinsics
from sasgeo_bench.sensing.photo_angles import DJI, PIX4D, SKYDIO, altitude_m, body_angles, camera_angles, height_above_m
from sasgeo_bench.sensing.photo_heads import PhotoHead, Xmp, number_of, positive_of, read_head
from sasgeo_bench.sensing.photo_lens import Lens, Size
from sasgeo_bench.texts import one_line

MOST_BYTES: Final = 64 * 2**20  # of a photo

_STRAIGHT_DOWN_DEG: Final = -90.0
_HORIZON_DEG: Final = 90.0 - 1e-6  # of tilt; the optical axis of a camera that leans more meets no level ground
_STEP_DEG: Final = 1e-4  # to the north, by which the grid's north is found
_UNITS_MM: Final = {2: 25.4, 3: 10.0, 4: 1.0, 5: 0.001}  # EXIF's units of FocalPlaneXResolution

# EXIF's orientation -> right and down of the upright picture in those of the sensor; 0 is none, the others mirror.
_TURNS: Final[dict[int, tuple[tuple[int, int], tuple[int, int]]]] = {
    0: ((1, 0), (0, 1)),
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
    or barometer, often tens of metres off). Angles are against true north: `gimbal` of the camera, with pitch -90
    straight down whatever the drone's maker counts from, and `flight` of the body. `gimbal_fault` says why the file's
    angles of the camera are not understood.
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
    gimbal_fault: str = ""
    flight: Attitude | None = None
    lens: Lens = Lens()  # noqa: RUF009 - it is frozen
    taken_at: dt.datetime | None = None
    model: str = ""

    def intrinsics(self) -> Intrinsics:
        """Return a pinhole by the calibrated focal length in the XMP, else by the one on 35 mm film.

        The latter compares diagonals of sensors. A photo of 16 : 9 is taken for a cut out of a sensor of 4 : 3 as wide.
        Expect an error of 1 to 3 %; for better, calibrate the lens. Raise `CameraError` if the photo has neither, or
        was cut or zoomed so that neither belongs to it.

        >>> photo = Photo(name="a.jpg", width_px=4000, height_px=3000, lens=Lens(film_mm=20.0))
        >>> round(photo.intrinsics().focal_px[0])
        2311
        """
        size_px = (self.width_px, self.height_px)
        stored_px = size_px[::-1] if _TURNS[self.orientation][0][0] == 0 else size_px
        focal_px = self.lens.focal_px(self.name, stored_px)
        return Intrinsics(
            width_px=self.width_px,
            height_px=self.height_px,
            focal_px=(focal_px, focal_px),
            centre_px=(self.width_px / 2, self.height_px / 2),
        )

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
            If the photo lacks place, height or gimbal angles, if its height is not above the ground, or if it looks
            at the horizon or above.
        """
        height_m = self.height_m if height_m is None else height_m
        if self.gimbal_fault:
            raise CameraError(f"{self.name} has {self.gimbal_fault}: make the camera by `Camera.pointed`")
        if self.lon_deg is None or self.lat_deg is None or height_m is None or self.gimbal is None:
            facts = {"GPS": self.lon_deg, "height above take-off": height_m, "gimbal angles": self.gimbal}
            lacking = [name for name, value in facts.items() if value is None]
            mend = (
                "give height_m"
                if height_m is None and len(lacking) == 1
                else "use the drone's own file, not an edited copy"
            )
            raise CameraError(f"{self.name} has no pose: {', '.join(lacking)} missing; {mend}")
        if not height_m > 0:
            raise CameraError(
                f"{self.name} was taken {height_m:+g} m above the ground or the place of take-off: give its own height "
                "above the ground (height_m)"
            )
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
        if not sensor.tilt_deg < _HORIZON_DEG:
            raise CameraError(
                f"{self.name} looks at the horizon or the sky (gimbal pitch {self.gimbal.pitch_deg:+.1f}, -90 is "
                "straight down; some drones write 0 for unknown): leave it out, or make the camera by `Camera.pointed`"
            )
        return sensor.upright(_TURNS[self.orientation])


def _to_grid(lon_deg: float, lat_deg: float, epsg: int) -> tuple[float, float, float]:
    """Return easting, northing and the bearing of true north in the grid, degrees."""
    step_deg = -_STEP_DEG if lat_deg > 0 else _STEP_DEG  # never over a pole
    (here_m, there_m), (low_m, high_m) = from_lonlat(epsg).transform([lon_deg, lon_deg], [lat_deg, lat_deg + step_deg])
    sign = math.copysign(1.0, step_deg)
    return here_m, low_m, float(bearing_deg(sign * (there_m - here_m), sign * (high_m - low_m)))


def read_photo(path: Path, *, most_bytes: int = MOST_BYTES, most_pixels: int = 200_000_000) -> Photo:
    """Read the metadata of a drone's photo (JPEG, TIFF, DNG); raise `ImageError` if it is no sound photo.

    Nothing is decoded; limits are on the bytes of the file and the pixels that its head announces. What a file does not
    say is None, so that a photo without pose is refused only where its pose is asked for (`Photo.camera`).
    """
    size = path.stat().st_size if path.is_file() else 0  # what is no file is refused when it is opened
    if size > most_bytes:
        raise ImageError(f"{path} has {size} bytes, at most {most_bytes} are read: cut it, or scale it down, first")
    return _photo_of(path.name, read_head(path), most_pixels)


def _photo_of(name: str, head: PhotoHead, most_pixels: int) -> Photo:
    width_px, height_px = head.size_px
    if width_px * height_px > most_pixels or min(head.size_px) < 1:
        raise ImageError(
            f"{name} has {width_px} x {height_px} pixels, at most {most_pixels} are read: scale it down first"
        )
    orientation = head.exif.get(ExifTags.Base.Orientation, 1)
    if orientation not in _TURNS:
        raise ImageError(f"{name} is mirrored or damaged (EXIF orientation {orientation!r}): use the drone's own file")
    if _TURNS[orientation][0][0] == 0:
        width_px, height_px = height_px, width_px
    lon_deg, lat_deg = _place(head.gps)
    make = _text(head.exif.get(ExifTags.Base.Make)) or head.xmp.get(("http://ns.adobe.com/tiff/1.0", "Make"), "")
    angles = camera_angles(head.xmp, make)
    return Photo(
        name=name,
        width_px=width_px,
        height_px=height_px,
        orientation=orientation,
        lon_deg=lon_deg,
        lat_deg=lat_deg,
        height_m=height_above_m(head.xmp),
        altitude_m=altitude_m(head.xmp),
        gimbal=angles.attitude,
        gimbal_fault=angles.fault,
        flight=body_angles(head.xmp),
        lens=_lens(head.inner, head.xmp, make),
        taken_at=_time(head.inner.get(ExifTags.Base.DateTimeOriginal)),
        model=_text(head.exif.get(ExifTags.Base.Model)),
    )


def _text(value: object) -> str:
    return "" if value is None else str(value).strip("\0 ")


def _lens(inner: Mapping[int, Any], xmp: Xmp, make: str) -> Lens:
    calibrated_px, calibrated_size_px = _calibration(xmp)
    across, down = (
        positive_of(inner.get(tag)) for tag in (ExifTags.Base.ExifImageWidth, ExifTags.Base.ExifImageHeight)
    )
    a_unit = positive_of(inner.get(ExifTags.Base.FocalPlaneXResolution))
    unit_mm = _UNITS_MM.get(inner.get(ExifTags.Base.FocalPlaneResolutionUnit, 2))
    return Lens(
        focal_mm=positive_of(inner.get(ExifTags.Base.FocalLength)),
        film_mm=positive_of(inner.get(ExifTags.Base.FocalLengthIn35mmFilm)),
        calibrated_px=calibrated_px,
        calibrated_size_px=calibrated_size_px,
        sensor_px_mm=a_unit / unit_mm if a_unit and unit_mm else None,
        native_size_px=(across, down) if across and down else None,
        zoom=positive_of(inner.get(ExifTags.Base.DigitalZoomRatio)),
        make=make,
        projection=_projection(xmp),
    )


def _projection(xmp: Xmp) -> str:
    """Return the projection of a fisheye or a panorama, empty for the picture of a pinhole."""
    model = xmp.get((PIX4D, "ModelType"), "perspective").lower()
    return one_line(
        xmp.get(("http://ns.google.com/photos/1.0/panorama", "ProjectionType"), "" if model == "perspective" else model)
    )[:40]


def _calibration(xmp: Xmp) -> tuple[float | None, Size | None]:
    """The calibrated focal length, pixels, and the size of the picture with that optical centre in its middle."""
    # DJI's centre counts from the picture's corner, Skydio's from the middle of its first pixel.
    focal_px = positive_of(xmp.get((DJI, "CalibratedFocalLength")))
    uri, axis, half_px = (DJI, "", 0.0) if focal_px else (SKYDIO, "/", 0.5)
    if not focal_px:
        both = [positive_of(xmp.get((SKYDIO, f"CalibratedFocalLength/{side}"))) for side in "XY"]
        focal_px = sum(both) / 2 if all(both) else None  # type: ignore[arg-type]
    across, down = (positive_of(xmp.get((uri, f"CalibratedOpticalCenter{axis}{side}"))) for side in "XY")
    return focal_px, (2 * (across + half_px), 2 * (down + half_px)) if across and down else None


def _place(gps: Mapping[int, Any]) -> tuple[float, float] | tuple[None, None]:
    """Return longitude and latitude, or nothing where there was no fix (0, 0 included)."""
    lon_deg = _degrees(gps.get(ExifTags.GPS.GPSLongitude), gps.get(ExifTags.GPS.GPSLongitudeRef), "E", "W")
    lat_deg = _degrees(gps.get(ExifTags.GPS.GPSLatitude), gps.get(ExifTags.GPS.GPSLatitudeRef), "N", "S")
    if lon_deg is None or lat_deg is None or abs(lon_deg) > 180 or abs(lat_deg) > 90:  # the globe
        return None, None
    return (lon_deg, lat_deg) if lon_deg or lat_deg else (None, None)


def _degrees(parts: object, side: object, plus: str, minus: str) -> float | None:
    if not isinstance(parts, tuple) or len(parts) != 3 or side not in (plus, minus):  # deg, min, s
        return None
    numbers = [number_of(part) for part in parts]
    if None in numbers:
        return None
    degrees = float(np.dot(np.array(numbers, dtype=np.float64), (1, 1 / 60, 1 / 3600)))
    return degrees if side == plus else -degrees


def _time(text: object) -> dt.datetime | None:
    try:
        return dt.datetime.strptime(str(text).strip("\0 "), "%Y:%m:%d %H:%M:%S")  # noqa: DTZ007 - EXIF has no zone here
    except ValueError:
        return None
