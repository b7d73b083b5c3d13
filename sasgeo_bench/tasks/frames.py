# SPDX-License-Identifier: Apache-2.0
"""Frames: the pictures of a query, each with its camera as it is believed; and their labels, which only truths hold."""

import datetime as dt
import zlib
from dataclasses import dataclass
from io import BytesIO
from typing import TYPE_CHECKING, Final, Self

import numpy as np
from numpy.typing import NDArray

from sasgeo_bench.core.errors import ImageError
from sasgeo_bench.regions.evidence import CELLS_PER_BYTE, UNKNOWN, pack, unpack

# Every process of a matcher reads queries, and few look at pictures: what these need is imported where it is used.
if TYPE_CHECKING:
    from sasgeo_bench.sensing.camera import Camera
    from sasgeo_bench.sensing.image import AerialImage, LabelledImage

MOST_PICTURE_BYTES: Final = 150_000
SIGMAS: Final = ("height_sigma_m", "attitude_sigma_deg", "position_sigma_m", "yaw_sigma_deg")


@dataclass(frozen=True, slots=True, kw_only=True)
class Frame:
    """One picture of a query, and what is believed of the camera that took it.

    Parameters
    ----------
    picture : bytes
        The picture as WebP, at most `MOST_PICTURE_BYTES`.
    camera : Camera
        In the frame of the view: east is right, north is up, metres from the middle of the view's evidence. What the
        query must not tell, place and heading, is not in it.
    height_sigma_m, attitude_sigma_deg : float
        Standard deviations of the believed height, and of tilt and roll.
    position_sigma_m, yaw_sigma_deg : float
        Standard deviations of where the camera stands and heads against the newest frame, from odometry; 0 for that.

    Raises
    ------
    ImageError
        If the picture is too large, or a standard deviation negative or not finite.
    """

    picture: bytes
    camera: "Camera"
    height_sigma_m: float = 0.0
    attitude_sigma_deg: float = 0.0
    position_sigma_m: float = 0.0
    yaw_sigma_deg: float = 0.0

    def __post_init__(self) -> None:
        if len(self.picture) > MOST_PICTURE_BYTES:
            raise ImageError(
                f"a picture has at most {MOST_PICTURE_BYTES} bytes, got {len(self.picture)}: compress it more"
            )
        for name in SIGMAS:
            value = getattr(self, name)
            if not (np.isfinite(value) and value >= 0):
                raise ImageError(f"{name} must be finite and not negative, got {value!r}")

    def image(self, *, observed_on: dt.date | None = None, season: str = "") -> "AerialImage":
        """Decode the picture; its camera stands above the origin and looks as in the view's frame."""
        from sasgeo_bench.sensing.image import AerialImage, decode_image  # noqa: PLC0415 - see above

        rgb = decode_image(self.picture, name="the picture of a frame", most_pixels=16_000_000)
        return AerialImage(
            rgb=rgb,
            camera=self.camera.moved(east_m=-self.camera.east_m, north_m=-self.camera.north_m),
            height_sigma_m=self.height_sigma_m,
            attitude_sigma_deg=self.attitude_sigma_deg,
            observed_on=observed_on,
            season=season,
        )


@dataclass(frozen=True, slots=True, kw_only=True)
class FrameLabels:
    """What is on each pixel of a frame, class by class; kept compressed, for a few hundred are in memory at once.

    >>> found = FrameLabels.of(("water",), np.array([[[0, 1, 2]]], dtype=np.uint8))
    >>> found.labels.tolist()
    [[[0, 1, 2]]]
    """

    classes: tuple[str, ...]
    rows: int
    cols: int
    packed: bytes

    @classmethod
    def of(cls, classes: tuple[str, ...], labels: NDArray[np.uint8]) -> Self:
        """Compress labels, uint8 of shape (C, H, W): ABSENT, PRESENT or UNKNOWN."""
        return cls(classes=classes, rows=labels.shape[1], cols=labels.shape[2], packed=zlib.compress(pack(labels), 1))

    @property
    def labels(self) -> NDArray[np.uint8]:
        """Return the labels, shape (C, H, W); raise `ShapeError` if the bytes do not fit."""
        shape = (len(self.classes), self.rows, self.cols)
        most = -(-int(np.prod(shape)) // CELLS_PER_BYTE)
        return unpack(zlib.decompressobj().decompress(self.packed, most), shape)

    def labelled(self, image: "AerialImage", place: str, classes: tuple[str, ...] | None = None) -> "LabelledImage":
        """Return an image of a place with these labels; of `classes`, of which those not known here are unknown.

        Raise `ImageError` if they do not fit.
        """
        from sasgeo_bench.sensing.image import LabelledImage  # noqa: PLC0415 - see above

        names, labels = classes or self.classes, self.labels
        planes = np.full((len(names), self.rows, self.cols), UNKNOWN, dtype=np.uint8)
        for at, name in enumerate(names):
            if name in self.classes:
                planes[at] = labels[self.classes.index(name)]
        return LabelledImage(image=image, classes=names, labels=planes, place=place)


def encode_webp(rgb: NDArray[np.uint8], *, most_bytes: int = MOST_PICTURE_BYTES) -> bytes:
    """Return a picture as WebP of the best of nine qualities that fits; raise `ImageError` if none does.

    >>> len(encode_webp(np.zeros((32, 32, 3), dtype=np.uint8))) < 200
    True
    """
    from PIL import Image  # noqa: PLC0415 - see above

    picture = Image.fromarray(np.ascontiguousarray(rgb))
    for quality in (85, 75, 65, 55, 45, 35, 25, 15, 5):  # of WebP, tried in turn until the picture fits
        encoded = BytesIO()
        picture.save(encoded, format="WEBP", quality=quality, method=2)
        if encoded.tell() <= most_bytes:
            return encoded.getvalue()
    raise ImageError(
        f"a picture of {rgb.shape[1]} x {rgb.shape[0]} pixels does not fit into {most_bytes} bytes: make it smaller"
    )
