# SPDX-License-Identifier: Apache-2.0
"""Focal length of a photo in pixels, by what its metadata say of the lens; it belongs to a size of picture."""

import math
from dataclasses import dataclass
from typing import Final

from sasgeo_bench.errors import CameraError

Size = tuple[float, float]

_FILM_DIAGONAL_MM: Final = math.hypot(36.0, 24.0)
_WIDEST_SENSOR: Final = 1.55  # width / height; a wider photo is cut out of a sensor of 4 : 3
_CUTS: Final = (3 / 2, 16 / 9)  # width / height that cameras cut out of a higher sensor
_SAME: Final = 0.02  # difference of two aspects that are one


@dataclass(frozen=True, slots=True, kw_only=True)
class Lens:
    """Lens of a photo, as its file says it; None where it does not. Sizes are width and height as stored.

    `film_mm` is the focal length on 35 mm film. `calibrated_px` belongs to a picture of `calibrated_size_px` (twice the
    optical centre). `sensor_px_mm` are pixels of the sensor to a millimetre, of a picture of `native_size_px`, which is
    the size that EXIF names. `zoom` is the digital one. `projection` is empty for a pinhole, else such as "fisheye".
    """

    focal_mm: float | None = None
    film_mm: float | None = None
    calibrated_px: float | None = None
    calibrated_size_px: Size | None = None
    sensor_px_mm: float | None = None
    native_size_px: Size | None = None
    zoom: float | None = None
    make: str = ""
    projection: str = ""

    def focal_px(self, name: str, size_px: Size) -> float:
        """Return the focal length in pixels of a picture of a size; raise `CameraError` if there is none for it.

        A calibrated one comes first, then that on film, then that by the pixels of the sensor; the latter two must
        agree, and with a calibrated one whose picture has no size. A picture scaled down keeps its field of view; one
        that was cut does not say of what.

        >>> lens = Lens(calibrated_px=3666.67, calibrated_size_px=(4000.0, 3000.0))
        >>> lens.focal_px("a.jpg", (2000, 1500))
        1833.335
        """
        if self.projection:
            raise CameraError(
                f"{name} is a {self.projection} picture, which no pinhole describes: give the camera's intrinsics"
            )
        calibrated, film = self._by_calibration(name, size_px), self._by_film(name, size_px)
        sensor = self._by_sensor(name, size_px)
        by, other = "the pixels of its sensor", sensor
        if calibrated is not None:
            is_sized = self.calibrated_size_px or self.native_size_px
            by, other = "calibration", None if is_sized else calibrated
        # 0.15: difference of two focal lengths; that on film is rounded to millimetres
        if film is not None and other is not None and abs(film / other - 1) > 0.15:
            raise CameraError(
                f"{name} has two focal lengths, {film:.0f} px by 35 mm film and {other:.0f} px by {by}: it was cut or "
                "resized; use the drone's own file, or give the camera's intrinsics"
            )
        found = next((focal_px for focal_px in (calibrated, film, sensor) if focal_px is not None), None)
        if found is None:
            raise CameraError(f"{name} has no focal length on 35 mm film: give the camera's intrinsics")
        zoom = self.zoom or 1.0
        # Makers whose focal length on film leaves digital zoom out
        leaves_out = calibrated is None and film is not None and self.make.lower() in ("dji", "hasselblad")
        if zoom < 1.0 or (zoom > 1.0 and not leaves_out):
            raise CameraError(
                f"{name} has a digital zoom of {zoom:g}, which its focal length may count or not: give the camera's "
                "intrinsics"
            )
        return found * zoom

    def _by_calibration(self, name: str, size_px: Size) -> float | None:
        if self.calibrated_px is None:
            return None
        low, high = 0.3, 20.0  # in widths of the picture: limits of a calibrated focal length that can be meant
        side_px = max(self.calibrated_size_px or size_px)
        if not low * side_px <= self.calibrated_px <= high * side_px:
            return None
        return self.calibrated_px * self._scale(name, size_px, self._reference(name, size_px))

    def _reference(self, name: str, size_px: Size) -> Size:
        """Return the size of the picture that the calibrated focal length belongs to."""
        native, middle = self.native_size_px, self.calibrated_size_px
        if middle is None:
            return native or size_px
        if _is_near(middle, size_px) and (native is None or _is_near(native, middle)):
            return size_px
        if native is not None and _is_near(native, middle):
            return native
        if native is None or _is_near(native, size_px):
            return middle
        raise CameraError(
            f"{name} of {_text(size_px)} pixels was one of {_text(native)} by its EXIF, and is calibrated for "
            f"{_text(middle)}: use the drone's own file, or give the camera's intrinsics"
        )

    def _by_film(self, name: str, size_px: Size) -> float | None:
        """Compare diagonals of sensors; a picture of 16 : 9 is taken for a cut out of a sensor of 4 : 3 as wide."""
        if self.film_mm is None:
            return None
        native_px = self.native_size_px or size_px
        scale = self._scale(name, size_px, native_px)
        long_px, short_px = max(native_px), min(native_px)
        sensor_px = math.hypot(long_px, short_px if long_px <= _WIDEST_SENSOR * short_px else long_px * 3 / 4)
        return scale * self.film_mm * sensor_px / _FILM_DIAGONAL_MM

    def _by_sensor(self, name: str, size_px: Size) -> float | None:
        if self.focal_mm is None or self.sensor_px_mm is None:
            return None
        return self._scale(name, size_px, self.native_size_px or size_px) * self.focal_mm * self.sensor_px_mm

    def _scale(self, name: str, size_px: Size, of_px: Size) -> float:
        """Return pixels of a picture to a pixel of the one that it was; raise `CameraError` if it was cut or turned."""
        across, down = size_px[0] / of_px[0], size_px[1] / of_px[1]
        is_cut = down < across and any(abs(size_px[0] / size_px[1] / aspect - 1) <= _SAME for aspect in _CUTS)
        if abs(across / down - 1) > _SAME and not (is_cut and of_px[0] / of_px[1] < _WIDEST_SENSOR):
            raise CameraError(
                f"{name} of {_text(size_px)} pixels is cut out of a picture of {_text(of_px)}, or turned: use the "
                "drone's own file, or give the camera's intrinsics"
            )
        return across


def _is_near(one: Size, two: Size) -> bool:
    # 0.05 of a picture's size, by which an optical centre lies beside its middle
    return all(abs(a / b - 1) <= 0.05 for a, b in zip(one, two, strict=True))


def _text(size_px: Size) -> str:
    return f"{size_px[0]:.0f} x {size_px[1]:.0f}"
