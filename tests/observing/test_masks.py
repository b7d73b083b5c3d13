# SPDX-License-Identifier: Apache-2.0
"""Masks of other people's networks: values as they are stored, whatever the file does to show them."""

import json
import re
import struct
import zlib
from pathlib import Path

import numpy as np
import pytest
import rasterio
from PIL import Image

from sasgeo_bench.core.config import parse_toml
from sasgeo_bench.core.errors import ConfigError, ImageError
from sasgeo_bench.observing.masks import Legend, Strange, read_coco, read_legend, read_mask, run_lengths
from sasgeo_bench.osm.taxonomy import load_taxonomy

ROOT = Path(__file__).parents[2]
VALUES = '[values]\n0 = "none"\n1 = "building"\n2 = ["road_major", "road_minor"]\n3 = "unknown"'
CELLS = np.array([[0, 1, 2, 3], [3, 2, 1, 0]], dtype=np.uint8)
# planes of road_major, road_minor, building: the roads are one of two
PLANES = [
    [[0, 0, 127, 255], [255, 127, 0, 0]],
    [[0, 0, 127, 255], [255, 127, 0, 0]],
    [[0, 254, 0, 255], [255, 0, 254, 0]],
]


def legend(text: str) -> Legend:
    return parse_toml(text, Legend, source="legend.toml")


def write_tiff(path: Path, bands: np.ndarray, **more) -> Path:
    count, rows, cols = bands.shape
    profile = {"driver": "GTiff", "count": count, "height": rows, "width": cols, "dtype": bands.dtype}
    with rasterio.open(path, "w", **profile, **more) as target:
        target.write(bands)
    return path


def palette(path: Path, bits: int) -> Path:
    image = Image.fromarray(CELLS, mode="P")
    image.putpalette([9, 9, 9, 250, 0, 0, 0, 250, 0, 0, 0, 250])
    image.save(path, bits=bits)
    with Image.open(path) as again:  # Pillow's own indices
        assert np.array_equal(np.asarray(again), CELLS)
    return path


@pytest.mark.parametrize(
    "write",
    [
        lambda folder: palette(folder / "a.png", 8),
        lambda folder: palette(folder / "a.png", 2),
        lambda folder: palette(folder / "a.png", 4),
        lambda folder: (Image.fromarray(CELLS, mode="L").save(folder / "a.png"), folder / "a.png")[1],
        lambda folder: (Image.fromarray(CELLS.astype(np.uint16)).save(folder / "a.png"), folder / "a.png")[1],
        lambda folder: write_tiff(folder / "a.tif", CELLS[None]),
        lambda folder: write_tiff(folder / "a.tif", CELLS[None], nbits=2),
        lambda folder: write_tiff(folder / "a.tif", CELLS[None], photometric="MINISWHITE"),
        lambda folder: write_tiff(folder / "a.tif", CELLS[None].astype(np.int32)),
        lambda folder: (np.save(folder / "a.npy", CELLS.astype(np.int64)), folder / "a.npy")[1],
    ],
    ids=["palette", "2 bits", "4 bits", "grey", "16 bits", "tiff", "tiff of 2 bits", "white is 0", "int32", "numpy"],
)
def test_values_are_those_that_are_stored(tmp_path, write):
    found = read_mask(write(tmp_path), legend(VALUES))
    assert found.classes == ("road_major", "road_minor", "building")
    assert found.probability_bytes.tolist() == PLANES


def png(cells: np.ndarray, bits: int, *, palette: bytes = b"", alpha: bytes = b"") -> bytes:
    """A PNG by its specification: values packed from the left, whatever any library does with them."""

    def chunk(kind: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    lines = b""
    for row in cells:
        digits = "".join(f"{value:0{bits}b}" for value in row)
        digits += "0" * (-len(digits) % 8)
        lines += b"\0" + bytes(int(digits[at : at + 8], 2) for at in range(0, len(digits), 8))
    head = struct.pack(">IIBBBBB", cells.shape[1], cells.shape[0], bits, 3 if palette else 0, 0, 0, 0)
    more = (chunk(b"PLTE", palette) if palette else b"") + (chunk(b"tRNS", alpha) if alpha else b"")
    parts = chunk(b"IHDR", head) + more + chunk(b"IDAT", zlib.compress(lines)) + chunk(b"IEND", b"")
    return b"\x89PNG\r\n\x1a\n" + parts


COLOURS = bytes([9, 9, 9, 250, 0, 0, 0, 250, 0, 0, 0, 250])


KINDS = {
    "grey": {},
    "grey, 0 transparent": {"alpha": b"\0\0"},
    "palette": {"palette": COLOURS},
    "palette, 0 transparent": {"palette": COLOURS, "alpha": b"\0"},
}


@pytest.mark.parametrize(
    ("kind", "bits"), [(kind, bits) for kind in KINDS for bits in (2, 4, 8, 16) if bits < 16 or "grey" in kind]
)
def test_a_png_of_any_depth_holds_what_its_bits_say(tmp_path, kind, bits):
    (tmp_path / "a.png").write_bytes(png(CELLS, bits, **KINDS[kind]))
    assert read_mask(tmp_path / "a.png", legend(VALUES)).probability_bytes.tolist() == PLANES


@pytest.mark.parametrize("bits", [1, 2, 4, 8, 16])
@pytest.mark.parametrize("photometric", ["MINISBLACK", "MINISWHITE"])
def test_a_tiff_of_any_depth_holds_what_its_bits_say(tmp_path, bits, photometric):
    cells = (CELLS % 2 if bits == 1 else CELLS).astype(np.uint16 if bits == 16 else np.uint8)
    path = write_tiff(tmp_path / "a.tif", cells[None], nbits=bits, photometric=photometric)
    wanted = PLANES if bits > 1 else (cells[None] * 254).tolist()
    meaning = VALUES if bits > 1 else '[values]\n0 = "none"\n1 = "building"'
    assert read_mask(path, legend(meaning)).probability_bytes.tolist() == wanted


def test_16_bits_are_neither_divided_nor_clipped(tmp_path):
    cells = np.array([[0, 1, 255, 256, 1000, 65535]])
    (tmp_path / "a.png").write_bytes(png(cells, 16))
    meaning = '[values]\n0 = "none"\n1 = "water"\n255 = "unknown"\n256 = "building"\n1000 = "green"\n65535 = "unknown"'
    found = read_mask(tmp_path / "a.png", legend(meaning))
    assert found.classes == ("building", "water", "green")
    assert found.probability_bytes[:, 0].T.tolist() == [
        [0, 0, 0],
        [0, 254, 0],
        [255, 255, 255],
        [254, 0, 0],
        [0, 0, 254],
        [255, 255, 255],
    ]


@pytest.mark.parametrize("bits", [2, 4, 8])
def test_a_palette_is_the_legend_where_that_is_of_colours(tmp_path, bits):
    (tmp_path / "a.png").write_bytes(png(CELLS, bits, palette=COLOURS, alpha=b"\xff\xff\xff\0"))
    meaning = '[colours]\n"#090909" = "none"\n"#fa0000" = "building"\n"#00fa00" = ["road_major", "road_minor"]'
    assert read_mask(tmp_path / "a.png", legend(meaning)).probability_bytes.tolist() == PLANES  # 3 is transparent


def test_what_the_legend_does_not_name_is_unknown_and_counted(tmp_path):
    cells = np.array([[0, 0, 1, 1, 9, 200]], dtype=np.uint8)
    np.save(tmp_path / "a.npy", cells)
    strange = Strange()
    found = read_mask(tmp_path / "a.npy", legend('[values]\n0 = "none"\n1 = "water"'), strange)
    assert found.probability_bytes.tolist() == [[[0, 0, 254, 254, 255, 255]]]
    assert strange.counts == {"9": 1, "200": 1}
    assert "2 pixels of 9, 200" in strange.note()


def test_a_mask_that_was_stretched_to_grey_levels_is_refused(tmp_path):
    Image.fromarray(CELLS * 85, mode="L").save(tmp_path / "a.png")
    with pytest.raises(ImageError, match="stretched to grey levels"):
        read_mask(tmp_path / "a.png", legend('[values]\n0 = "none"\n1 = "building"\n2 = "water"\n3 = "green"'))


def test_background_does_not_hide_that_the_legend_is_of_other_masks(tmp_path):
    cells = np.zeros((10, 10), dtype=np.uint8)
    cells[:2, :5] = 126
    np.save(tmp_path / "a.npy", cells)
    with pytest.raises(ImageError, match="not in the legend"):
        read_mask(tmp_path / "a.npy", legend('[values]\n0 = "none"\n1 = "building"'))


def test_nodata_is_unknown(tmp_path):
    path = write_tiff(tmp_path / "a.tif", np.array([[[0, 1, 255, 255, 255]]], dtype=np.uint8), nodata=255)
    strange = Strange()
    found = read_mask(path, legend('[values]\n0 = "none"\n1 = "water"'), strange)
    assert found.probability_bytes.tolist() == [[[0, 254, 255, 255, 255]]]
    assert not strange.counts


def test_colours_are_read_as_they_are_and_what_is_transparent_is_unknown(tmp_path):
    rgba = np.array([[[255, 0, 0, 255], [0, 0, 255, 255], [0, 0, 0, 255], [255, 0, 0, 0]]], dtype=np.uint8)
    Image.fromarray(rgba, mode="RGBA").save(tmp_path / "a.png")
    found = read_mask(
        tmp_path / "a.png", legend('[colours]\n"#FF0000" = "building"\n"#0000ff" = "water"\n"#000000" = "none"')
    )
    assert found.classes == ("building", "water")
    assert found.probability_bytes.tolist() == [[[254, 0, 0, 255]], [[0, 254, 0, 255]]]


def test_probabilities_keep_what_they_say(tmp_path):
    chances = np.array([[[0.0, 0.25, 1.0, np.nan]], [[0.5, 0.5, 0.1, 0.9]]], dtype=np.float32)
    expected = [[[0, 64, 254, 255]], [[127, 127, 25, 229]]]
    wanted = legend('[bands]\n1 = "building"\n2 = "water"')
    assert read_mask(write_tiff(tmp_path / "a.tif", chances), wanted).probability_bytes.tolist() == expected
    np.save(tmp_path / "a.npy", chances.astype(np.float64))
    assert read_mask(tmp_path / "a.npy", wanted).probability_bytes.tolist() == expected
    np.savez(tmp_path / "a.npz", roofs=chances[0], lakes=chances[1])
    by_name = legend('[bands]\nroofs = "building"\nlakes = "water"')
    assert read_mask(tmp_path / "a.npz", by_name).probability_bytes.tolist() == expected
    eight = write_tiff(tmp_path / "b.tif", np.array([[[0, 64, 255]]], dtype=np.uint8))
    assert read_mask(eight, legend('[bands]\n1 = "water"')).probability_bytes.tolist() == [[[0, 64, 254]]]


# Encoded by pycocotools 2.0.11, and what it encoded.
COCO = {
    "2110102": ((3, 4), [(1, 1), (1, 2), (2, 0)]),
    "0183K0004M": ((7, 5), [(0, 0), (6, 4), *((row, col) for row in range(2, 6) for col in range(1, 4))]),
}


@pytest.mark.parametrize("text", COCO)
def test_compressed_run_lengths_are_those_of_pycocotools(tmp_path, text):
    (rows, cols), there = COCO[text]
    expected = np.zeros((rows, cols), dtype=bool)
    expected[tuple(zip(*there, strict=True))] = True
    for counts in (text, run_lengths(text)):
        path = tmp_path / "coco.json"
        path.write_text(json.dumps(coco(counts, rows, cols)))
        ((name, found),) = read_coco(path, legend('[categories]\nroof = "building"'))
        assert name == "a.jpg"
        assert np.array_equal(found.probability_bytes[0] == 254, expected)
        assert set(np.unique(found.probability_bytes)) == {0, 254}


def coco(counts, rows, cols, **change):
    mask = {"counts": counts, "size": [rows, cols]}
    item = {"id": 1, "image_id": 1, "category_id": 7, "segmentation": mask} | change
    image = {"id": 1, "file_name": "a.jpg", "height": rows, "width": cols}
    return {"images": [image], "categories": [{"id": 7, "name": "roof"}], "annotations": [item]}


@pytest.mark.parametrize(
    ("content", "hint"),
    [
        (coco("2110102", 3, 4, segmentation=[[0, 0, 3, 0, 3, 3]]), "polygons"),
        (coco("2110102", 4, 4), "does not fit 4 x 4"),
        (coco([1, 2], 3, 4), "does not fit 3 x 4"),
        (coco("2", 3, 4, image_id=5), "no sound COCO"),
        (coco("P", 3, 4), "does not fit"),
        ({"images": []}, "no sound COCO"),
        ([], "no sound COCO"),
    ],
)
def test_a_coco_file_with_a_fault_is_refused_on_one_line(tmp_path, content, hint):
    (tmp_path / "coco.json").write_text(json.dumps(content))
    with pytest.raises(ImageError, match=hint) as refusal:
        list(read_coco(tmp_path / "coco.json", legend('[categories]\nroof = "building"')))
    assert "\n" not in str(refusal.value)


@pytest.mark.parametrize(
    ("text", "hint"),
    [
        ("", "got 0"),
        ('[values]\n0 = "none"\n[bands]\n1 = "water"', "got 2"),
        ('[values]\n0 = "roof"', "'roof' is no class"),
        ('[values]\nred = "water"', "whole numbers"),
        ('[values]\n0 = "none"', "names no class"),
        ('[colours]\n"red" = "water"', "#ff0000"),
        ('[bands]\n1 = "none"', "'none' is no class"),
        ('[values]\n1 = ["water", "none"]', "classes alone"),
        ('[values]\n99999 = "water"', "0 to 65535"),
        ('[values]\n01 = "water"\n1 = "building"', "twice"),
        ('[bands]\n0 = "water"', "counted from 1"),
        ('[bands]\n2 = ["road_major", "road_minor"]', "chances of one class, got several for '2'"),
        ('[bands]\n1 = "water"\n2 = "water"', "from two bands"),
    ],
)
def test_a_legend_that_means_nothing_is_refused(tmp_path, text, hint):
    (tmp_path / "legend.toml").write_text(text)
    with pytest.raises(ConfigError, match=hint):
        read_legend(tmp_path / "legend.toml")


def test_the_guide_lists_the_classes_that_a_legend_may_name():
    guide = (ROOT / "docs" / "howto" / "own-photos.md").read_text(encoding="utf-8")
    (listed,) = re.findall(r"The \[classes\]\(class\.md\) are ([^.]*)\.", guide)
    assert tuple(re.findall(r"`(\w+)`", listed)) == load_taxonomy().names


@pytest.mark.parametrize(
    ("name", "write", "text", "hint"),
    [
        ("a.png", lambda path: path.write_text("no mask"), VALUES, "no PNG or GeoTIFF"),
        ("a.npy", lambda path: path.write_bytes(b""), VALUES, "no array"),
        ("a.npy", lambda path: np.save(path, np.array([{}], dtype=object), allow_pickle=True), VALUES, "no array"),
        ("a.npy", lambda path: np.save(path, np.full((2, 2), 0.5)), VALUES, "whole"),
        ("a.npy", lambda path: np.save(path, np.full((2, 2), -1)), VALUES, "0 to 65535"),
        ("a.npy", lambda path: np.save(path, np.zeros((1, 2, 2))), VALUES, "a mask"),
        ("a.npy", lambda path: np.save(path, np.full((1, 2, 2), 3.0)), '[bands]\n1 = "water"', "sigmoid"),
        ("a.npy", lambda path: np.save(path, np.zeros((1, 2, 2))), '[bands]\n2 = "water"', "no band '2'"),
        ("a.npy", lambda path: np.save(path, np.zeros((2, 2))), '[bands]\n1 = "water"', "classes, rows, columns"),
        ("a.npy", lambda path: np.save(path, np.zeros((4, 5, 3))), '[bands]\n1 = "water"', "transpose them"),
        ("a.tif", lambda path: write_tiff(path, np.zeros((3, 2, 2), np.uint8), photometric="RGB"), VALUES, "3 bands"),
        ("a.tif", lambda path: write_tiff(path, CELLS[None]), '[bands]\n1 = "water"', "look like values of classes"),
        ("a.tif", lambda path: write_tiff(path, CELLS[None]), '[colours]\n"#ff0000" = "water"', "8-bit red"),
        ("a.tif", lambda path: write_tiff(path, CELLS[None]), '[categories]\nroof = "building"', "no COCO file"),
    ],
)
def test_what_is_no_mask_is_refused_on_one_line(tmp_path, name, write, text, hint):
    write(tmp_path / name)
    with pytest.raises(ImageError, match=hint) as refusal:
        read_mask(tmp_path / name, legend(text))
    assert "\n" not in str(refusal.value)
