# SPDX-License-Identifier: Apache-2.0
"""Images as bytes and files: nothing is lost, and bytes from anywhere are refused in one line."""

import datetime as dt
import json
import struct
import zlib
from dataclasses import replace

import numpy as np
import pytest

from sasgeo_bench.core.errors import ImageError, StoreError
from sasgeo_bench.sensing.image import (
    LabelledFiles,
    image_bytes,
    image_from,
    labelled_bytes,
    labelled_from,
    write_labelled,
)
from sasgeo_bench.sensing.tiny_images import tiny_images

IMAGE = replace(tiny_images()[0].image, observed_on=dt.date(2024, 7, 1), season="leaf_on", height_sigma_m=2.5)


def test_an_image_keeps_pixels_camera_sigmas_and_day_and_a_body_without_end_is_not_unpacked() -> None:
    again = image_from(image_bytes(IMAGE))
    np.testing.assert_array_equal(again.rgb, IMAGE.rgb)
    for name in ("camera", "height_sigma_m", "attitude_sigma_deg", "observed_on", "season"):
        assert getattr(again, name) == getattr(IMAGE, name)
    (count,) = struct.unpack("!I", SOUND[6:10])
    bomb = SOUND[: 10 + count] + zlib.compress(bytes(10**7))
    with pytest.raises(ImageError, match="does not hold the 36864 bytes"):
        image_from(bomb)


def test_labelled_images_are_read_from_their_files_when_they_are_asked_for(tmp_path) -> None:
    images = tiny_images()
    files = LabelledFiles(write_labelled(tmp_path / "set", images))
    assert len(files) == 4
    for one, other in zip(files, images, strict=True):
        np.testing.assert_array_equal(one.labels, other.labels)
        np.testing.assert_array_equal(one.image.rgb, other.image.rgb)
        assert (one.classes, one.place) == (other.classes, other.place)
    assert [each.place for each in files[2:]] == ["drawn-west", "drawn-west"]
    files.paths[0].write_bytes(b"x")
    with pytest.raises(ImageError, match=r"000000.labelled: these bytes are not a labelled image"):
        _ = files[0]
    files.paths[0].unlink()
    with pytest.raises(StoreError, match=r"000000.labelled cannot be read \(No such file"):
        _ = files[0]


def test_images_of_other_classes_are_refused_and_nothing_half_written_is_left(tmp_path) -> None:
    first = tiny_images()[0]
    other = replace(first, classes=first.classes[::-1])
    with pytest.raises(ImageError, match="image 1 labels green, water"):
        write_labelled(tmp_path, [first, other])
    assert [path.name for path in tmp_path.iterdir()] == ["000000.labelled"]


def changed(data: bytes, **changes: object) -> bytes:
    """The bytes of an image with another head."""
    magic, (count,) = data[:6], struct.unpack("!I", data[6:10])
    text = json.dumps(json.loads(data[10 : 10 + count]) | changes).encode()
    return magic + struct.pack("!I", len(text)) + text + data[10 + count :]


SOUND = image_bytes(IMAGE)
CAMERA = json.loads(SOUND[10 : 10 + struct.unpack("!I", SOUND[6:10])[0]])["camera"]
HUGE = CAMERA | {"intrinsics": CAMERA["intrinsics"] | {"width_px": 90_000, "height_px": 90_000}}
BROKEN = CAMERA | {"intrinsics": CAMERA["intrinsics"] | {"width_px": 12.5}}


@pytest.mark.parametrize(
    ("data", "fault"),
    [
        (b"", "not an aerial image"),
        (labelled_bytes(tiny_images()[0]), "not an aerial image"),
        (SOUND[:-20], "does not hold the 36864 bytes"),
        (SOUND[:-4] + b"1234", "damaged"),
        (SOUND + b"x", "does not hold"),
        (changed(SOUND, camera=None), "camera of an image's head is damaged"),
        (changed(SOUND, camera=CAMERA | {"height_m": "high"}), "camera of an image's head is damaged"),
        (changed(SOUND, camera=CAMERA | {"rotation": [0.0] * 9}), "camera of an image's head is damaged"),
        (changed(SOUND, camera=HUGE), "at most 64000000 pixels"),
        (changed(SOUND, camera=BROKEN), "at most 64000000 pixels|damaged"),
        (changed(SOUND, observed_on="yesterday"), "head of an image is damaged"),
        (changed(SOUND, height_sigma_m=-1.0), "height_sigma_m must be finite and not negative"),
    ],
)
def test_bytes_that_are_no_image_are_refused_in_one_line(data, fault) -> None:
    with pytest.raises(ImageError, match=fault) as refused:
        image_from(data)
    assert "\n" not in str(refused.value)


@pytest.mark.parametrize(
    ("changes", "fault"),
    [
        ({"classes": None}, "head of a labelled image is damaged"),
        ({"classes": ["building"] * 4}, "each once"),
        ({"classes": [f"c{at}" for at in range(65)]}, "head of a labelled image is damaged"),
        ({"place": 7}, "head of a labelled image is damaged"),
    ],
)
def test_labels_that_fit_nothing_are_refused(changes, fault) -> None:
    with pytest.raises(ImageError, match=fault):
        labelled_from(changed(labelled_bytes(tiny_images()[0]), **changes))
