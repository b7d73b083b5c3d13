# SPDX-License-Identifier: Apache-2.0
"""Pictures of any order of bands, any way to say "no picture", any direction of rows: the same ground, or one line."""

import re
from dataclasses import dataclass, field

import numpy as np
import pytest
import rasterio
from affine import Affine
from rasterio.enums import ColorInterp as Is
from scipy import ndimage

from sasgeo_bench.core.errors import ImageryError
from sasgeo_bench.geometry.grid import Grid
from sasgeo_bench.regions.imagery import ImageryEntry, read_window
from sasgeo_bench.regions.ortho import check_picture, is_empty, ortho_grid, write_ortho

SIDE = 48
WEST, NORTH = 600_000.0, 5_400_000.0
REGION = Grid(epsg=32632, west_m=WEST, north_m=NORTH, cell_size_m=1.0, rows=SIDE, cols=SIDE)
UP = Affine(1, 0, WEST, 0, -1, NORTH)
HALF = SIDE // 2
COLOURS = {"red": (220, 30, 20), "blue": (20, 40, 210), "white": (245, 245, 245), "water": (10, 30, 60)}
QUARTERS = {
    "red": (slice(HALF), slice(HALF, None)),
    "blue": (slice(HALF), slice(HALF)),
    "white": (slice(HALF, None), slice(HALF)),
    "water": (slice(HALF, None), slice(HALF, None)),
}


def _ground():
    rgb = np.empty((3, SIDE, SIDE), np.uint8)
    for name, quarter in QUARTERS.items():
        rgb[:, *quarter] = np.array(COLOURS[name])[:, None, None]
    return rgb


RGB = _ground()
R, G, B = RGB[:1], RGB[1:2], RGB[2:]
INFRARED = np.random.default_rng(3).integers(0, 200, (1, SIDE, SIDE)).astype(np.uint8)
FULL = np.full((1, SIDE, SIDE), 255, np.uint8)
SHOWN = FULL.copy()
SHOWN[:, :8] = 0  # the rows farthest north hold no picture
BLACK = np.where(SHOWN > 0, RGB, 0)  # as files without a mask say so
BGR, NO = (Is.blue, Is.green, Is.red), Is.undefined
RGB_ALPHA, ALPHA_RGB = (Is.red, Is.green, Is.blue, Is.alpha), (Is.alpha, Is.red, Is.green, Is.blue)
GREY = (Is.gray, NO, NO, NO)


@dataclass(frozen=True)
class Made:
    """Bands of a file, what it calls them, and where its pixels lie."""

    bands: tuple[np.ndarray, ...]
    colours: tuple[Is, ...] | None = None
    transform: Affine = UP
    names: tuple[str, ...] = ()
    mask: np.ndarray | None = None
    beside: bool = False  # the mask lies in a file of its own
    profile: dict[str, object] = field(default_factory=dict)

    def write(self, path):
        bands = np.concatenate(self.bands)
        about = {"crs": "EPSG:32632", "transform": self.transform, "dtype": bands.dtype, **self.profile}
        count, rows, cols = bands.shape
        with (
            rasterio.Env(GDAL_TIFF_INTERNAL_MASK=not self.beside),
            rasterio.open(path, "w", driver="GTiff", count=count, height=rows, width=cols, **about) as target,
        ):
            if self.colours:
                target.colorinterp = self.colours
            if self.names:
                target.descriptions = self.names
            target.write(bands)
            if self.mask is not None:
                target.write_mask(self.mask)


def _rotated():
    """The same ground by pixels of 0.9 m that are turned by 30 degrees about its middle; black beyond."""
    turn = Affine.rotation(30.0) @ Affine.scale(0.9, -0.9)
    size = 80
    x, y = turn @ (size / 2, size / 2)
    transform = Affine.translation(WEST + HALF - x, NORTH - HALF - y) @ turn
    cols, rows = np.meshgrid(np.arange(size) + 0.5, np.arange(size) + 0.5)
    x, y = transform @ (cols, rows)
    col, row = np.floor(x - WEST).astype(int), np.floor(NORTH - y).astype(int)
    is_in = (col >= 0) & (col < SIDE) & (row >= 0) & (row < SIDE)
    bands = np.zeros((3, size, size), np.uint8)
    bands[:, is_in] = RGB[:, row[is_in], col[is_in]]
    return Made((bands,), transform=transform, profile={"nodata": 0})


MINISBLACK = {"photometric": "MINISBLACK"}
WHOLE = {
    "green, blue, red": Made((G, B, R), (Is.green, Is.blue, Is.red)),
    "blue, green, red": Made((RGB[::-1],), BGR),
    "with infrared": Made((RGB, INFRARED), (Is.red, Is.green, Is.blue, NO)),
    "infrared first": Made((INFRARED, RGB), (NO, Is.red, Is.green, Is.blue)),
    "by the names of the bands": Made((RGB[::-1], INFRARED, INFRARED), (*GREY, NO), names=("blue_band", "Green",
     "Band 3 (red)", "Red_Edge", "Near Infrared"), profile=MINISBLACK),
    "by letters": Made((RGB[::-1],), GREY[:3], names=("B", "G", "R"), profile=MINISBLACK),
    "alpha everywhere, black is empty": Made((RGB, FULL), RGB_ALPHA, profile={"nodata": 0}),
    "rows from south to north": Made((RGB[:, ::-1],), transform=Affine(1, 0, WEST, 0, 1, NORTH - SIDE)),
    "columns from east to west": Made((RGB[:, :, ::-1],), transform=Affine(-1, 0, WEST + SIDE, 0, -1, NORTH)),
    "both": Made((RGB[:, ::-1, ::-1],), transform=Affine(-1, 0, WEST + SIDE, 0, 1, NORTH - SIDE)),
    "rows are columns": Made((RGB.transpose(0, 2, 1),), transform=Affine(0, 1, WEST, -1, 0, NORTH)),
    "with heights in its CRS": Made((RGB,), profile={"crs": "EPSG:25832+5783"}),
}  # fmt: skip
CUT = {
    "alpha first": Made((SHOWN, RGB), ALPHA_RGB),
    "alpha first, black is empty too": Made((SHOWN, RGB), ALPHA_RGB, profile={"nodata": 0}),
    "alpha second": Made((R, SHOWN, G, B), (Is.red, Is.alpha, Is.green, Is.blue)),
    "alpha after infrared": Made((RGB, INFRARED, SHOWN), (*RGB_ALPHA[:3], NO, Is.alpha)),
    "alpha last, black is empty too": Made((RGB, SHOWN), RGB_ALPHA, profile={"nodata": 0}),
    "alpha last, white is empty too": Made((RGB, SHOWN), RGB_ALPHA, profile={"nodata": 255}),
    "alpha of three levels": Made((RGB, np.where(np.arange(SIDE) % 2, SHOWN, SHOWN // 2)), RGB_ALPHA),
    "alpha of 0 and 1": Made((RGB, SHOWN // 255), RGB_ALPHA),
    "alpha and a mask": Made((RGB, FULL), RGB_ALPHA, mask=SHOWN[0]),
    "a mask that shows more than alpha": Made((SHOWN, RGB), ALPHA_RGB, mask=FULL[0], beside=True),
    "a mask of other bands": Made((RGB[::-1],), BGR, mask=SHOWN[0]),
    "a mask in a file of its own": Made((RGB,), mask=SHOWN[0], beside=True),
    "black of other bands": Made((BLACK[::-1],), BGR, profile={"nodata": 0}),
    "a colour that single bands have elsewhere": Made(
        (np.where(SHOWN > 0, RGB, 30)[::-1],), BGR, profile={"nodata": 30}
    ),
    "from south to north": Made(
        (RGB[::-1, ::-1], SHOWN[:, ::-1]), (*BGR, Is.alpha), transform=Affine(1, 0, WEST, 0, 1, NORTH - SIDE)
    ),
}
NOTED = {
    "infrared that calls itself alpha": (Made((RGB, INFRARED), RGB_ALPHA),
     "band 4 calls itself alpha and holds a picture"),
    "bands of one level and water": (Made((RGB, np.where(B == 60, 0, 130).astype(np.uint8)), RGB_ALPHA), "infrared"),
    "names that say no colour": (Made((RGB,), (*GREY[:3],), names=("B4", "B3", "B2"), profile=MINISBLACK),
     r"its bands are called B4, B3, B2: bands \(1, 2, 3\) are taken as red"),
    "bands without a word": (Made((RGB, INFRARED), GREY, profile=MINISBLACK), r"bands \(1, 2, 3\) are taken as red"),
}  # fmt: skip


def lay(folder, made):
    """Return the picture as checked, and its pixels on the lattice of the region."""
    path = folder / "a picture & <more>.tif"
    made.write(path)
    entry = ImageryEntry.model_construct(
        file=path.name, attribution="me", licence="CC0-1.0", empty_rgb=None, gsd_m=None
    )
    picture = check_picture(path, entry, REGION)
    write_ortho(folder / "ortho.tif", [picture], ortho_grid([picture], REGION))
    return picture, read_window(folder / "ortho.tif", REGION, is_coarser=False)


def check_colours(window):
    for name, quarter in QUARTERS.items():
        middle = (slice(None), *(slice(part.indices(SIDE)[0] + 10, part.indices(SIDE)[1] - 4) for part in quarter))
        seen = np.moveaxis(window.rgb, -1, 0)[middle].reshape(3, -1).mean(axis=1)
        np.testing.assert_allclose(seen, COLOURS[name], atol=6, err_msg=name)  # JPEG


@pytest.mark.parametrize("case", WHOLE)
def test_colours_are_those_that_the_file_names_wherever_its_rows_begin(case, tmp_path):
    picture, window = lay(tmp_path, WHOLE[case])
    check_colours(window)
    assert window.is_known.all()
    assert picture.bands.note == ""


def test_a_turned_picture_is_turned_back(tmp_path):
    _, window = lay(tmp_path, _rotated())
    check_colours(window)
    assert window.is_known[2:-2, 2:-2].all()


@pytest.mark.parametrize("case", CUT)
def test_ground_is_known_where_everything_that_the_file_says_shows_a_picture(case, tmp_path):
    _, window = lay(tmp_path, CUT[case])
    check_colours(window)
    assert not window.is_known[:7].any()
    assert window.is_known[9:].all()


@pytest.mark.parametrize("case", NOTED)
def test_a_doubtful_choice_of_bands_is_noted(case, tmp_path):
    made, words = NOTED[case]
    picture, window = lay(tmp_path, made)
    check_colours(window)
    assert window.is_known.all()
    assert re.search(words, picture.bands.note)


def test_infrared_that_calls_itself_alpha_leaves_black_and_mask_in_force(tmp_path):
    for made in (
        Made((BLACK, np.where(SHOWN > 0, INFRARED, 0)), RGB_ALPHA, profile={"nodata": 0}),
        Made((RGB, INFRARED), RGB_ALPHA, mask=SHOWN[0], beside=True),
    ):
        _, window = lay(tmp_path, made)
        assert not window.is_known[:7].any()
        assert window.is_known[9:].all()
        (tmp_path / "a picture & <more>.tif.msk").unlink(missing_ok=True)


SITE = 'ENGCRS["site",EDATUM["x"],CS[Cartesian,2],AXIS["(E)",east],AXIS["(N)",north],LENGTHUNIT["metre",1]]'
REFUSED = {
    "inks": (Made((RGB, FULL), (Is.cyan, Is.magenta, Is.yellow, Is.black)), "its bands are cyan, magenta, yellow, bl"),
    "grey with alpha": (Made((R, FULL), (Is.gray, Is.alpha)), r"2 band\(s\) of uint8, .* its bands are gray, alpha"),
    "a palette": (Made((R,), (Is.palette,)), "-expand rgb for a palette"),
    "reals": (Made((RGB.astype(np.float32),)), "of float32, imagery is 8-bit"),
    "4 bits": (Made((RGB // 16,), profile={"nbits": 4}), "colours of 4 bits"),
    "two alphas": (Made((RGB, FULL, FULL), (*RGB_ALPHA, Is.alpha)), "alpha, alpha"),
    "two reds": (Made((RGB, R), (*RGB_ALPHA[:3], Is.red)), "blue, red"),
    "names against colours": (Made((RGB[::-1],), names=("Blue", "Green", "Red")),
     r"\(1, 2, 3\) by their colour interpretation, \(3, 2, 1\) by their names"),
    "infrared, red, green": (Made((INFRARED, R, G), GREY[:3], names=("nir", "red", "green"), profile=MINISBLACK),
     "its bands are called nir, red, green"),
    "infrared, red, green in the place of colours": (Made((INFRARED, R, G), names=("nir", "red", "green")),
     r"\(1, 2, 3\) by their colour interpretation, nir, red, green by their names"),
    "a building site": (Made((RGB,), profile={"crs": rasterio.crs.CRS.from_wkt(SITE)}), "'site', which is neither"),
    "metres from the Earth's centre": (Made((RGB,), profile={"crs": "EPSG:4978"}), "neither geographic nor projected"),
    "an ellipsoid alone": (Made((RGB,), profile={"crs": "+proj=utm +zone=32 +ellps=bessel"}), "leaves the datum open"),
    "the Moon": (Made((RGB,), transform=Affine(1e-5, 0, 11, 0, -1e-5, 49), profile={"crs": "IAU_2015:30100"}),
     "cannot be projected to EPSG:32632"),
    "pixels without height": (Made((RGB,), transform=Affine(1, 0, WEST, 0, 0, NORTH)), "pixels of 0 m"),
}  # fmt: skip


@pytest.mark.parametrize("case", REFUSED)
def test_what_is_no_colour_picture_of_a_place_on_earth_is_refused_on_one_line(case, tmp_path):
    made, words = REFUSED[case]
    with pytest.raises(ImageryError, match=words) as caught:
        lay(tmp_path, made)
    assert "\n" not in str(caught.value)
    assert "a picture & <more>.tif" in str(caught.value)


@pytest.mark.parametrize("diameter_px", range(2, 10))
def test_a_hole_lies_where_its_colour_does(diameter_px):
    rng = np.random.default_rng(diameter_px)
    is_near = ndimage.binary_dilation(rng.random((60, 70)) > 0.985, iterations=3)
    holes = is_empty(
        np.where(is_near, 255, 90)[None].repeat(3, axis=0).astype(np.uint8), (255, 255, 255), diameter_px=diameter_px
    )
    assert (holes <= is_near).all()
    radius = diameter_px // 2
    reach = np.arange(-radius, radius + 1)
    half = np.rint(np.sqrt(radius**2 - reach**2))  # OpenCV's disc: half the width of each of its rows
    disc = np.abs(reach) <= half[:, None]
    eroded = _with_its_edge_repeated(is_near, radius, lambda wide: ndimage.binary_erosion(wide, disc))
    opened = _with_its_edge_repeated(eroded, radius, lambda wide: ndimage.binary_dilation(wide, disc))
    np.testing.assert_array_equal(holes, opened)


def _with_its_edge_repeated(cells, margin, change):
    return change(np.pad(cells, margin, mode="edge"))[margin:-margin, margin:-margin]
