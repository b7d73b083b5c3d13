# SPDX-License-Identifier: Apache-2.0
"""Pictures from outside: decoded within limits, or refused in one line."""

import struct
import zlib
from io import BytesIO
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray
from PIL import Image

from sasgeo_bench.core.errors import ImageError
from sasgeo_bench.sensing.camera import Camera, Intrinsics
from sasgeo_bench.sensing.ground import Plane
from sasgeo_bench.sensing.image import AerialImage, LabelledImage, decode_image

RED, GREEN, BLUE = (250, 0, 0), (0, 250, 0), (0, 0, 250)


def camera(rows: int, cols: int) -> Camera:
    lens = Intrinsics.from_field_of_view(horizontal_deg=70.0, width_px=cols, height_px=rows)
    return Camera.pointed(intrinsics=lens, east_m=0.0, north_m=0.0, height_m=80.0, yaw_deg=0.0)


def encoded(image: Image.Image, kind: str = "PNG", **options: object) -> bytes:
    file = BytesIO()
    image.save(file, format=kind, **options)
    return file.getvalue()


def chunk(name: bytes, content: bytes) -> bytes:
    return struct.pack("!I", len(content)) + name + content + struct.pack("!I", zlib.crc32(name + content))


def png(width: int, height: int, *, bits: int, kind: int, pixels: bytes) -> bytes:
    """A PNG written by hand, whose head may say anything."""
    head = struct.pack("!IIBBBBB", width, height, bits, kind, 0, 0, 0)
    parts = (chunk(b"IHDR", head), chunk(b"IDAT", zlib.compress(pixels)), chunk(b"IEND", b""))
    return b"\x89PNG\r\n\x1a\n" + b"".join(parts)


@pytest.mark.parametrize("kind", ["PNG", "JPEG", "WEBP", "TIFF"])
def test_each_format_keeps_rows_columns_and_the_order_of_colours(kind: str) -> None:
    picture = np.zeros((32, 48, 3), dtype=np.uint8)
    picture[:16], picture[16:] = RED, BLUE
    found = decode_image(encoded(Image.fromarray(picture), kind))
    assert found.shape == (32, 48, 3)
    assert found.dtype == np.uint8
    np.testing.assert_allclose(found[4, 4].astype(int), RED, atol=12)
    np.testing.assert_allclose(found[-4, 4].astype(int), BLUE, atol=12)


@pytest.mark.parametrize("orientation", range(1, 9))
def test_a_turned_photo_stands_upright(orientation: int) -> None:
    upright = np.array([[RED, GREEN], [BLUE, (250, 250, 250)], [(0, 0, 0), (90, 90, 90)]], dtype=np.uint8)
    stored = {
        1: upright,
        2: upright[:, ::-1],
        3: upright[::-1, ::-1],
        4: upright[::-1],
        5: upright.transpose(1, 0, 2),
        6: np.rot90(upright),
        7: upright[::-1, ::-1].transpose(1, 0, 2),
        8: np.rot90(upright, -1),
    }[orientation]
    exif = Image.Exif()
    exif[0x0112] = orientation
    np.testing.assert_array_equal(decode_image(encoded(Image.fromarray(stored), exif=exif)), upright)


def test_sixteen_bits_of_grey_are_rounded_to_eight_and_those_of_colour_read() -> None:
    values = np.array([[0, 128, 129, 257, 32768, 65535]], dtype=np.uint16)
    found = decode_image(encoded(Image.fromarray(values)))
    assert found[0, :, 0].tolist() == [0, 0, 1, 1, 128, 255]
    assert (found == found[:, :, :1]).all()
    pixels = b"\0" + struct.pack("!6H", 65535, 0, 0, 0, 0, 65535)
    assert decode_image(png(2, 1, bits=16, kind=2, pixels=pixels)).tolist() == [[[255, 0, 0], [0, 0, 255]]]


def test_a_palette_grey_two_levels_and_transparent_pixels_become_colours() -> None:
    palette = Image.new("P", (2, 1))
    palette.putpalette([*RED, *GREEN])
    palette.putpixel((1, 0), 1)
    assert decode_image(encoded(palette)).tolist() == [[list(RED), list(GREEN)]]
    assert decode_image(encoded(Image.new("L", (1, 1), 77))).tolist() == [[[77, 77, 77]]]
    assert decode_image(encoded(Image.new("1", (1, 1), 1))).tolist() == [[[255, 255, 255]]]
    image = Image.new("RGBA", (3, 1), (200, 100, 50, 255))
    image.putpixel((1, 0), (200, 100, 50, 0))
    image.putpixel((2, 0), (200, 100, 50, 51))
    assert decode_image(encoded(image)).tolist() == [[[200, 100, 50], [0, 0, 0], [40, 20, 10]]]


BIG = encoded(Image.fromarray(np.arange(64 * 64 * 3, dtype=np.uint32).astype(np.uint8).reshape(64, 64, 3)))
PHOTO = encoded(Image.fromarray(np.zeros((64, 64, 3), dtype=np.uint8)), "JPEG")

BAD: dict[str, tuple[bytes, str]] = {
    "empty": (b"", "is empty"),
    "text": (b"no image at all", "no JPEG, PNG, WebP or TIFF"),
    "gif": (encoded(Image.new("P", (2, 2)), "GIF"), "no JPEG, PNG, WebP or TIFF"),
    "head only": (BIG[:20], "damaged"),
    "half a png": (BIG[: len(BIG) // 2], "truncated or damaged"),
    "half a jpeg": (PHOTO[: len(PHOTO) - 60], "truncated or damaged"),
    "bits flipped": (BIG[:60] + bytes(40) + BIG[100:], "damaged"),
    "no pixels": (png(0, 5, bits=8, kind=2, pixels=b""), "no JPEG, PNG, WebP or TIFF"),
    "bomb": (png(40_000, 40_000, bits=8, kind=2, pixels=bytes(1000)), "than twice the pixels"),
    "large": (png(9_000, 9_000, bits=8, kind=2, pixels=bytes(1000)), "has 9000 x 9000 pixels, at most 64000000"),
    "text bomb": (
        BIG[:33] + chunk(b"zTXt", b"a\0\0" + zlib.compress(bytes(2**26))) + BIG[33:],
        "Decompressed data too large",
    ),
    "floats": (encoded(Image.new("F", (2, 2)), "TIFF"), "kind 'F', not colours"),
}


@pytest.mark.parametrize("name", BAD)
def test_a_bad_image_is_refused_in_one_line_that_says_what_to_do(name: str) -> None:
    data, fault = BAD[name]
    with pytest.raises(ImageError, match=fault) as refusal:
        decode_image(data, name="flight/0001.jpg")
    assert str(refusal.value).startswith("flight/0001.jpg ")
    assert ": " in str(refusal.value)
    assert "\n" not in str(refusal.value)


MEDLEY = [BIG, PHOTO, encoded(Image.fromarray(np.eye(40, dtype=np.uint8) * 255), "WEBP", lossless=True)]


@given(
    st.sampled_from(MEDLEY), st.lists(st.tuples(st.integers(0, 500), st.integers(0, 255)), max_size=5), st.integers(1)
)
def test_bytes_that_were_changed_or_cut_are_a_picture_or_one_line(data, changes, kept) -> None:
    broken = bytearray(data[:kept])
    for at, value in changes:
        broken[at % len(broken)] = value
    message = ""
    try:
        assert decode_image(bytes(broken)).ndim == 3
    except ImageError as error:
        message = str(error)
    assert "\n" not in message


def test_bytes_and_pixels_are_counted_before_decoding(monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(*_: object) -> None:
        raise AssertionError

    monkeypatch.setattr(Image.Image, "convert", fail)
    monkeypatch.setattr("PIL.ImageFile.ImageFile.load", fail)
    with pytest.raises(ImageError, match="pixels, at most 4095"):
        decode_image(BIG, most_pixels=64 * 64 - 1)
    with pytest.raises(ImageError, match=f"{len(BIG)} bytes, at most 100 are read"):
        decode_image(BIG, most_bytes=100)


def aerial(rows: int = 4, cols: int = 6, **changes: object) -> AerialImage:
    return AerialImage(**{"rgb": np.zeros((rows, cols, 3), np.uint8), "camera": camera(rows, cols)} | changes)


def test_the_picture_of_an_aerial_image_cannot_be_changed() -> None:
    image = aerial()
    assert image.shape == (4, 6)
    with pytest.raises(ValueError, match="read-only"):
        image.rgb[0, 0] = 1


@pytest.mark.parametrize(
    ("changes", "fault"),
    [
        ({"camera": camera(6, 4)}, r"shape \(6, 4, 3\)"),
        ({"rgb": np.zeros((4, 6, 3))}, "got float64"),
        ({"rgb": np.zeros((4, 6), np.uint8)}, r"got uint8 of shape \(4, 6\)"),
        ({"height_sigma_m": -1.0}, "height_sigma_m must be finite and not negative"),
        ({"attitude_sigma_deg": float("nan")}, "attitude_sigma_deg must be finite"),
    ],
)
def test_an_aerial_image_fits_its_camera(changes: dict[str, object], fault: str) -> None:
    with pytest.raises(ImageError, match=fault):
        aerial(**changes)


@pytest.mark.parametrize(
    ("classes", "labels", "fault"),
    [
        (("water",), np.zeros((2, 4, 6), np.uint8), r"shape \(1, 4, 6\)"),
        (("water",), np.zeros((1, 4, 6)), "got float64"),
        (("water",), np.full((1, 4, 6), 3, np.uint8), "2 unknown, got 3"),
        ((), np.zeros((0, 4, 6), np.uint8), "got none"),
        (("water", "water"), np.zeros((2, 4, 6), np.uint8), "each once, got water, water"),
    ],
)
def test_labels_fit_their_picture(classes: tuple[str, ...], labels: np.ndarray, fault: str) -> None:
    with pytest.raises(ImageError, match=fault):
        LabelledImage(image=aerial(), classes=classes, labels=labels, place="oslo")


def test_infrared_in_a_tiff_that_calls_itself_alpha_does_not_darken_the_picture():
    def tiff_of(alpha):
        return encoded(Image.fromarray(np.dstack([np.full((20, 20, 3), 90, np.uint8), alpha]), "RGBA"), "TIFF")

    infrared = np.random.default_rng(1).integers(1, 200, (20, 20), dtype=np.uint8)
    with pytest.raises(ImageError, match=r"chip.tif has a band that calls itself alpha .* -b 1 -b 2 -b 3"):
        decode_image(tiff_of(infrared), name="chip.tif")
    mask = np.full((20, 20), 255, np.uint8)
    mask[:3], mask[3] = 0, 128
    assert decode_image(tiff_of(mask))[:, 0, 0].tolist() == [0] * 3 + [45] + [90] * 16


def test_a_picture_from_straight_above_has_pixels_of_the_width_that_is_said() -> None:
    rgb = np.zeros((40, 30, 3), dtype=np.uint8)
    image = AerialImage.from_above(rgb, gsd_m=0.28)
    at_m = image.camera.unproject(np.array([[15.0, 20.0], [16.0, 20.0], [15.0, 19.0]]), Plane())
    np.testing.assert_allclose(at_m[:, :2], [[0, 0], [0.28, 0], [0, 0.28]], atol=1e-9)


@pytest.mark.parametrize(
    ("rgb", "gsd_m", "words"),
    [
        (np.zeros((4, 4, 3), dtype=np.uint8), 0.0, r"gsd_m, the width of a pixel on the ground, is positive"),
        (np.zeros((4, 4, 3), dtype=np.uint8), np.nan, r"gsd_m, the width of a pixel on the ground, is positive"),
        (np.zeros((4, 4), dtype=np.uint8), 0.5, r"rgb is uint8 of shape \(H, W, 3\), got uint8 of shape \(4, 4\)"),
        (np.zeros((4, 4, 4), dtype=np.uint8), 0.5, r"rgb is uint8 of shape"),
        (np.zeros((4, 4, 3)), 0.5, r"rgb is uint8 of shape"),
    ],
)
def test_what_is_no_picture_from_above_is_refused(rgb: NDArray[Any], gsd_m: float, words: str) -> None:
    with pytest.raises(ImageError, match=words):
        AerialImage.from_above(rgb, gsd_m=gsd_m)
