# SPDX-License-Identifier: Apache-2.0
"""Photos of drones: where and how they were taken, by their EXIF and XMP; their pixels are not decoded here."""

import datetime as dt
import math
import re
import warnings
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any, Final

import numpy as np
from defusedxml.ElementTree import fromstring  # type: ignore[import-untyped]
from PIL import ExifTags, Image, UnidentifiedImageError
from PIL.TiffImagePlugin import ImageFileDirectory_v2
from scipy.spatial.transform import Rotation

from sasgeo_bench.core.errors import CameraError, ImageError
from sasgeo_bench.core.paths import plain_file
from sasgeo_bench.core.texts import message_of, one_line, plain
from sasgeo_bench.geometry.grid import utm_epsg
from sasgeo_bench.geometry.projection import to_grid
from sasgeo_bench.sensing.camera import Attitude, Camera, Intrinsics, Mount

MOST_BYTES: Final = 64 * 2**20  # of a photo
_TIFF_MARKS: Final = (b"II*\0", b"MM\0*")
_WIDTH, _HEIGHT, _KIND, _PARTS, _XMP, _CROP = 256, 257, 254, 330, 700, 50720
_FRAME: Final = ("adobe:ns:meta", "http://www.w3.org/1999/02/22-rdf-syntax-ns#")  # namespaces that hold no property

Xmp = Mapping[tuple[str, str], str]


@dataclass(frozen=True, slots=True, kw_only=True)
class PhotoHead:
    """Metadata of a photo: `exif` is the first directory of tags, `inner` that of the camera.

    `size_px` is the width and height as stored, before the orientation turns it; of a DNG those of the developed photo.
    Keys of `xmp` are a namespace URI without its last "/", and a name; parts of a structure are named "Whole/Part".
    """

    size_px: tuple[int, int]
    exif: Mapping[int, Any]
    inner: Mapping[int, Any]
    gps: Mapping[int, Any]
    xmp: Xmp


def read_head(path: Path, *, most_bytes: int = MOST_BYTES) -> PhotoHead:
    """Read the head of a photo; raise `ImageError` if it is no sound JPEG, TIFF or DNG of so many bytes at most."""
    size = path.stat().st_size if path.is_file() else -1  # what is no file is refused when it is opened
    if size == 0:
        raise ImageError(f"{path} is empty: copy it again from the drone")
    if size > most_bytes:
        raise ImageError(f"{path} has {size} bytes, at most {most_bytes} are read: cut it, or scale it down, first")
    try:
        with warnings.catch_warnings(), plain_file(path).open("rb") as file:
            warnings.simplefilter("ignore")  # of Pillow: odd metadata; what is needed and odd is refused later
            if file.read(4) in _TIFF_MARKS:
                return _read_tiff(file)
            with Image.open(plain_file(path), formats=("JPEG",)) as image:  # one of several (MPO) is one, too
                return _head(image.size, image.getexif(), image.info.get("xmp"))
    except ImageError:
        raise
    except (UnidentifiedImageError, Image.DecompressionBombError) as error:
        raise ImageError(
            f"{path} is no JPEG, TIFF or DNG of a size that can be read ({message_of(error)}): check the file"
        ) from error
    except FileNotFoundError as error:
        raise ImageError(f"there is no photo {path}: check the path") from error
    except Exception as error:  # Pillow and the reader of XML fail at damaged files with errors of many kinds
        raise ImageError(f"{path} has damaged metadata ({message_of(error)}): copy it again from the drone") from error


def _head(size_px: tuple[int, int], exif: Image.Exif, xmp: object) -> PhotoHead:
    packet = xmp.encode() if isinstance(xmp, str) else xmp if isinstance(xmp, bytes) else b""
    return PhotoHead(
        size_px=size_px,
        exif=exif,
        inner=exif.get_ifd(ExifTags.IFD.Exif),
        gps=exif.get_ifd(ExifTags.IFD.GPSInfo),
        xmp=properties_of(packet),
    )


def _read_tiff(file: IO[bytes]) -> PhotoHead:
    """Read a TIFF's or DNG's head: in a DNG the first picture is a preview, and others hang on its directory."""
    file.seek(0)
    exif = Image.Exif()
    exif.load_from_fp(file)
    first = dict(exif)
    offsets = first.get(_PARTS, ())
    parts: list[Mapping[int, Any]] = [first]
    file.seek(0)
    start = file.read(8)
    for offset in (offsets if isinstance(offsets, tuple) else (offsets,))[:32]:  # at most 32 parts of a DNG
        part = ImageFileDirectory_v2(start)
        file.seek(int(offset))
        part.load(file)
        parts.append(dict(part))
    # 1: bit of NewSubfileType: a preview of another picture in the file
    whole = [part for part in parts if not int(part.get(_KIND, 0)) & 1] or parts
    return _head(max(map(_size_px, whole), key=math.prod), exif, first.get(_XMP))


def _size_px(part: Mapping[int, Any]) -> tuple[int, int]:
    """Return width and height of a picture of a TIFF: of a raw one those that its maker crops it to."""
    width, height = part.get(_CROP) or (part.get(_WIDTH, 0), part.get(_HEIGHT, 0))
    return int(width), int(height)


def properties_of(packet: bytes) -> dict[tuple[str, str], str]:
    """Return the properties of an XMP packet, written as attributes or as elements, by namespace URI and name.

    >>> found = properties_of(b'<x:xmpmeta xmlns:x="adobe:ns:meta/" xmlns:d="http://x.y/z/" d:Yaw="+9.0"/>')
    >>> found["http://x.y/z", "Yaw"]
    '+9.0'
    """
    packet = packet.strip(b"\0 \r\n")
    found: dict[tuple[str, str], str] = {}
    if packet:
        for key, text in _properties(fromstring(packet), ()):
            found.setdefault(key, text)
    return found


def _properties(element: Any, path: tuple[str, ...]) -> Iterator[tuple[tuple[str, str], str]]:  # noqa: ANN401 - untyped
    uri, name = _split(element.tag)
    here = path if uri in _FRAME else (*path, name)
    if here != path and element.text and element.text.strip():
        yield (uri, "/".join(here)), element.text.strip()
    for attribute, value in element.attrib.items():
        uri, name = _split(attribute)
        if uri and uri not in _FRAME:
            yield (uri, "/".join((*here, name))), value
    for child in element:
        yield from _properties(child, here)


def _split(name: str) -> tuple[str, str]:
    """Return the namespace URI of a name without its last "/", and the local name."""
    uri, _, local = name.rpartition("}")
    return uri.removeprefix("{").rstrip("/"), local


def number_of(value: Any) -> float | None:  # noqa: ANN401 - whatever metadata hold
    """Return a finite number out of EXIF or XMP, which may hold text, fractions of zero or nothing.

    >>> number_of("+12.50"), number_of("7/2"), number_of("0/0"), number_of(None)
    (12.5, 3.5, None, None)
    """
    try:
        parts = value.split("/") if isinstance(value, str) else [value]
        number = float(parts[0]) / float(parts[1]) if len(parts) == 2 else float(value)  # a fraction
    except (TypeError, ValueError, ZeroDivisionError):
        return None
    return number if math.isfinite(number) else None


def positive_of(value: Any) -> float | None:  # noqa: ANN401 - as above
    """Return a finite number above 0 out of EXIF or XMP, None for anything else."""
    number = number_of(value)
    return number if number is not None and number > 0 else None


DJI: Final = "http://www.dji.com/drone-dji/1.0"
AUTEL: Final = "http://www.autelrobotics.com/drone/1.0"
SKYDIO: Final = "https://www.skydio.com/drone-skydio/1.0"
PIX4D: Final = "http://pix4d.com/camera/1.0"
SENSEFLY: Final = "http://ns.sensefly.com/Camera/1.0"

_GIMBAL: Final = ("GimbalRollDegree", "GimbalPitchDegree", "GimbalYawDegree")
_CAMERA: Final[Mapping[str, tuple[str, str, str]]] = {  # makers before Pix4D, whose tags several of them write as well
    DJI: _GIMBAL,
    AUTEL: _GIMBAL,
    "http://www.parrot.com/drone-parrot/1.0": ("CameraRollDegree", "CameraPitchDegree", "CameraYawDegree"),
    SKYDIO: ("CameraOrientationNED/Roll", "CameraOrientationNED/Pitch", "CameraOrientationNED/Yaw"),
    PIX4D: ("Roll", "Pitch", "Yaw"),
    SENSEFLY: ("Roll", "Pitch", "Yaw"),
}
_ABOVE_GROUND: Final = ((DJI, "RelativeAltitude"), (AUTEL, "RelativeAltitude"), (SKYDIO, "RelativeAltitude"),
                  (PIX4D, "AboveGroundAltitude"), (SENSEFLY, "AboveGroundAltitude"))  # fmt: skip
_ALTITUDE: Final = tuple((uri, "AbsoluteAltitude") for uri in (DJI, AUTEL, SKYDIO))
_STRAIGHT_DOWN: Final = Attitude(pitch_deg=-90.0)


@dataclass(frozen=True, slots=True, kw_only=True)
class Angles:
    """Attitude of a camera, its forward being the optical axis; or why what the file says is not understood."""

    attitude: Attitude | None = None
    fault: str = ""


def camera_angles(xmp: Xmp, make: str) -> Angles:
    """Return the attitude of a photo's camera; without one and without a fault if the file says nothing.

    Pix4D's angles are those of the body on which a camera looks straight down; all others are of the optical axis.

    >>> pix4d = {(PIX4D, "Yaw"): "90", (PIX4D, "Pitch"): "30", (PIX4D, "Roll"): "0"}
    >>> found = camera_angles(pix4d, "Sentera").attitude
    >>> round(found.pitch_deg), round(found.yaw_deg)
    (-60, 90)
    """
    for uri, names in _CAMERA.items():
        found = _attitude(xmp, uri, names)
        if found is None:
            continue
        if uri in (PIX4D, SENSEFLY):
            return _pix4d(found, make)
        return _autel(found) if uri == AUTEL or "autel" in make.lower() else Angles(attitude=found)
    return Angles()


def body_angles(xmp: Xmp) -> Attitude | None:
    """Return the attitude of the drone's body, None if the file does not say it."""
    names = ("FlightRollDegree", "FlightPitchDegree", "FlightYawDegree")
    return _attitude(xmp, DJI, names) or _attitude(xmp, AUTEL, names)


def height_above_m(xmp: Xmp) -> float | None:
    """Return the height above the place of take-off (Pix4D's: above ground), metres."""
    return _first(xmp, _ABOVE_GROUND)


def altitude_m(xmp: Xmp) -> float | None:
    """Return the altitude, metres: above the sea, unless `is_ellipsoidal`."""
    return _first(xmp, _ALTITUDE)


def _exif_altitude(gps: Mapping[int, object]) -> tuple[float | None, bool]:
    """Return the altitude that EXIF states, metres, and whether it counts from the ellipsoid (since EXIF 3.0)."""
    metres, given = number_of(gps.get(ExifTags.GPS.GPSAltitude)), gps.get(ExifTags.GPS.GPSAltitudeRef, 0)
    reference = given[0] if isinstance(given, bytes) and given else given
    if metres is None or reference not in (0, 1, 2, 3):  # above and below the sea, and the same of the ellipsoid
        return None, False
    return (-metres if reference in (1, 3) else metres), reference in (2, 3)


def is_ellipsoidal(altitude_type: str) -> bool:
    """Return whether DJI's AltitudeType says that an absolute altitude counts from the ellipsoid, as RTK's do.

    >>> is_ellipsoidal("RtkAlt"), is_ellipsoidal("GpsFusionAlt")
    (True, False)
    """
    return altitude_type.strip().lower() == "rtkalt"


def datum_fault(datum: str) -> str:
    """Return what is wrong with EXIF's GPSMapDatum, empty where it is WGS 84, in any spelling, or not said.

    >>> datum_fault("WGS-84"), datum_fault("TOKYO")
    ('', "in another datum than WGS 84 ('TOKYO')")
    """
    key = re.sub(r"[^A-Z0-9]", "", datum.upper())
    is_meant = not key or re.match(r"WGS(19)?84|WORLDGEODETICSYSTEM(19)?84|EPSG4326$", key)
    return "" if is_meant else f"in another datum than WGS 84 ({plain(datum)[:40]!r})"


def _first(xmp: Xmp, keys: tuple[tuple[str, str], ...]) -> float | None:
    return next((value for key in keys if (value := number_of(xmp.get(key))) is not None), None)


def _attitude(xmp: Xmp, uri: str, names: tuple[str, str, str]) -> Attitude | None:
    roll_deg, pitch_deg, yaw_deg = (number_of(xmp.get((uri, name))) for name in names)
    if roll_deg is None or pitch_deg is None or yaw_deg is None:
        return None
    return Attitude(roll_deg=roll_deg, pitch_deg=pitch_deg, yaw_deg=yaw_deg)


def _autel(found: Attitude) -> Angles:
    """Autel counts the pitch downwards in some firmware, upwards in other; the gimbals rise by 30 degrees at most."""
    if found.pitch_deg <= 0:
        return Angles(attitude=found)
    if found.pitch_deg > 30.0:  # degrees to which Autel's gimbals rise above the horizon
        return Angles(attitude=Attitude(roll_deg=found.roll_deg, pitch_deg=-found.pitch_deg, yaw_deg=found.yaw_deg))
    return Angles(
        fault=f"a pitch of {found.pitch_deg:+g} degrees, which Autel counts from the horizon upwards or downwards"
    )


def _pix4d(found: Attitude, make: str) -> Angles:
    """Pix4D: pitch 0 is straight down, 90 ahead; senseFly turns the sign of the roll."""
    # -20 degrees: no camera that looks down at 0 leans back more, but one that counts from the horizon
    if found.pitch_deg < -20.0:
        return Angles(
            fault=f"a pitch of {found.pitch_deg:+g} degrees in Camera:Pitch, where 0 is straight down and 90 ahead: it "
            "seems to count from the horizon"
        )
    roll_deg = -found.roll_deg if make.lower() == "sensefly" else found.roll_deg
    body = Attitude(roll_deg=roll_deg, pitch_deg=found.pitch_deg, yaw_deg=found.yaw_deg)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # straight down yaw and roll are one turn: scipy leaves roll at 0
        turn = Rotation.from_matrix(body.matrix @ _STRAIGHT_DOWN.matrix)
        yaw_deg, pitch_deg, roll_deg = turn.as_euler("ZYX", degrees=True).tolist()
    return Angles(attitude=Attitude(roll_deg=roll_deg, pitch_deg=pitch_deg, yaw_deg=yaw_deg))


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
            f"{name} of {_lens_text(size_px)} pixels was one of {_lens_text(native)} by its EXIF, and is calibrated "
            f"for {_lens_text(middle)}: use the drone's own file, or give the camera's intrinsics"
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
                f"{name} of {_lens_text(size_px)} pixels is cut out of a picture of {_lens_text(of_px)}, or turned: "
                "use the drone's own file, or give the camera's intrinsics"
            )
        return across


def _is_near(one: Size, two: Size) -> bool:
    # 0.05 of a picture's size, by which an optical centre lies beside its middle
    return all(abs(a / b - 1) <= 0.05 for a, b in zip(one, two, strict=True))


def _lens_text(size_px: Size) -> str:
    return f"{size_px[0]:.0f} x {size_px[1]:.0f}"


_STRAIGHT_DOWN_DEG: Final = -90.0
_HORIZON_DEG: Final = 90.0 - 1e-6  # of tilt; the optical axis of a camera that leans more meets no level ground
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
    Longitude and latitude are WGS 84; `place_fault` says why there are none though the file has a place. `height_m`
    counts from the place of take-off, `altitude_m` from the sea (by GNSS or barometer, often tens of metres off), or
    from the ellipsoid if `is_ellipsoidal`. Angles are against true north: `gimbal` of the camera, with pitch -90
    straight down whatever the drone's maker counts from, and `flight` of the body. `gimbal_fault` says why the file's
    angles of the camera are not understood.
    """

    name: str
    width_px: int
    height_px: int
    orientation: int = 1
    lon_deg: float | None = None
    lat_deg: float | None = None
    place_fault: str = ""
    height_m: float | None = None
    altitude_m: float | None = None
    is_ellipsoidal: bool = False
    gimbal: Attitude | None = None
    gimbal_fault: str = ""
    flight: Attitude | None = None
    lens: Lens = Lens()
    taken_at: dt.datetime | None = None
    utc_offset: dt.timedelta | None = None
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
        if self.place_fault:
            raise CameraError(f"{self.name} has a place {self.place_fault}: make the camera by `Camera.pointed`")
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
        east_m, north_m, convergence_deg = to_grid(self.lon_deg, self.lat_deg, crs)
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


def read_photo(path: str | Path, *, most_bytes: int = MOST_BYTES, most_pixels: int = 200_000_000) -> Photo:
    """Read the metadata of a drone's photo (JPEG, TIFF, DNG); raise `ImageError` if it is no sound photo.

    Nothing is decoded; limits are on the bytes of the file and the pixels that its head announces. What a file does not
    say is None, so that a photo without pose is refused only where its pose is asked for (`Photo.camera`).
    """
    path = Path(path)
    return photo_of(path.name, read_head(path, most_bytes=most_bytes), most_pixels=most_pixels)


def photo_of(name: str, head: PhotoHead, *, most_pixels: int = 200_000_000) -> Photo:
    """Return a photo by its head; raise `ImageError` if it is too large, mirrored or damaged."""
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
    place_fault = "" if lon_deg is None else datum_fault(_text(head.gps.get(ExifTags.GPS.GPSMapDatum)))
    if place_fault:
        lon_deg = lat_deg = None
    make = _text(head.exif.get(ExifTags.Base.Make)) or head.xmp.get(("http://ns.adobe.com/tiff/1.0", "Make"), "")
    angles = camera_angles(head.xmp, make)
    by_drone_m, (by_exif_m, is_exif_ellipsoidal) = altitude_m(head.xmp), _exif_altitude(head.gps)
    return Photo(
        name=name,
        width_px=width_px,
        height_px=height_px,
        orientation=orientation,
        lon_deg=lon_deg,
        lat_deg=lat_deg,
        place_fault=place_fault,
        height_m=height_above_m(head.xmp),
        altitude_m=by_drone_m if by_drone_m is not None else by_exif_m,
        is_ellipsoidal=is_ellipsoidal(head.xmp.get((DJI, "AltitudeType"), ""))
        if by_drone_m is not None
        else is_exif_ellipsoidal,
        gimbal=angles.attitude,
        gimbal_fault=angles.fault,
        flight=body_angles(head.xmp),
        lens=_lens(head.inner, head.xmp, make),
        taken_at=_time(head.inner),
        utc_offset=_utc_offset(head.inner),
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


def _utc_offset(inner: Mapping[int, Any]) -> dt.timedelta | None:
    """Return how far the clock is ahead of UTC (EXIF 2.31, OffsetTimeOriginal); None where the file does not say."""
    text = _text(inner.get(ExifTags.Base.OffsetTimeOriginal))
    found = re.fullmatch(r"([+-])([0-9]{2}):([0-9]{2})", text.strip())
    if found is None:
        return None
    offset = dt.timedelta(hours=int(found[2]), minutes=int(found[3]))
    return -offset if found[1] == "-" else offset


def _time(inner: Mapping[int, Any]) -> dt.datetime | None:
    text = _text(inner.get(ExifTags.Base.DateTimeOriginal))
    try:
        moment = dt.datetime.strptime(text, "%Y:%m:%d %H:%M:%S")  # noqa: DTZ007 - EXIF has no zone here
    except ValueError:
        return None
    fraction = _text(inner.get(ExifTags.Base.SubsecTimeOriginal))  # digits behind the point
    return moment + dt.timedelta(seconds=float(f"0.{fraction}")) if re.fullmatch("[0-9]{1,9}", fraction) else moment
