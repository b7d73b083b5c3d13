# SPDX-License-Identifier: Apache-2.0
"""Angles of a photo's camera: each maker's names, signs and zero, brought to those of `Attitude`.

`docs/concepts/camera.md` has the table of conventions with their sources.
"""

import warnings
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final

from scipy.spatial.transform import Rotation

from sasgeo_bench.sensing.camera import Attitude
from sasgeo_bench.sensing.photo_heads import Xmp, number_of

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
_HEIGHT: Final = ((DJI, "RelativeAltitude"), (AUTEL, "RelativeAltitude"), (SKYDIO, "RelativeAltitude"),
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
    return _first(xmp, _HEIGHT)


def altitude_m(xmp: Xmp) -> float | None:
    """Return the height above the sea, metres."""
    return _first(xmp, _ALTITUDE)


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
