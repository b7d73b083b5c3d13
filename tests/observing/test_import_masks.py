# SPDX-License-Identifier: Apache-2.0
"""Masks as tasks: their evidence is that of the map where they were drawn of it, and what lacks is said."""

import json
from pathlib import Path

import numpy as np
import pytest
import rasterio
from affine import Affine
from PIL import ExifTags, Image

import sasgeo_bench as sgb
from sasgeo_bench.core.errors import ConfigError
from sasgeo_bench.geometry.projection import to_grid, to_lonlat
from sasgeo_bench.tasks.task_files import Task
from tests.observing.test_pictures import turned
from tests.sensing.test_photos import POSE, write_photo, xmp_of

TOWN = "town-riverside"
LEGEND = '[values]\n0 = "none"\n1 = "building"\n2 = "road_minor"\n3 = "water"\n'
CODES = {"building": 1, "road_minor": 2, "water": 3}
SIDE, PIXEL_M = 256, 0.5
HEADING_DEG = 35.0


@pytest.fixture(scope="module")
def region(towns: Path) -> sgb.Region:
    return sgb.read_region(towns / "regions" / TOWN)


def mask_at(region: sgb.Region, pose: sgb.Pose) -> np.ndarray:
    """The map under a pose as a mask: later classes over earlier ones."""
    bits = sgb.LayerBits.of(region.layers)
    cells = sgb.observe(bits, region.grid, pose, size_cells=SIDE, cell_size_m=PIXEL_M)
    found = np.zeros((SIDE, SIDE), dtype=np.uint8)
    for name, code in CODES.items():
        found[cells[region.classes.index(name)] == sgb.PRESENT] = code
    return found


@pytest.fixture(scope="module")
def pose(region: sgb.Region) -> sgb.Pose:
    """A place at which everything is to be seen."""
    west, south, east, north = region.grid.bounds_m
    for east_m in np.arange(west + 150, east - 150, 60):
        for north_m in np.arange(south + 150, north - 150, 60):
            found = sgb.Pose(easting_m=float(east_m), northing_m=float(north_m), yaw_deg=HEADING_DEG)
            if (np.bincount(mask_at(region, found).ravel(), minlength=4) > 500).all():
                return found
    raise AssertionError("the town has changed")


@pytest.fixture(scope="module")
def values(region: sgb.Region, pose: sgb.Pose) -> np.ndarray:
    return mask_at(region, pose)


@pytest.fixture
def legend(tmp_path: Path) -> Path:
    (tmp_path / "legend.toml").write_text(LEGEND)
    return tmp_path / "legend.toml"


def write_mask(path: Path, values: np.ndarray, region: sgb.Region, pose: sgb.Pose) -> Path:
    shape = {"width": SIDE, "height": SIDE, "count": 1, "dtype": "uint8"}
    place = turned(pose.yaw_deg, PIXEL_M, east_m=pose.easting_m, north_m=pose.northing_m, size=(SIDE, SIDE))
    with rasterio.open(path, "w", driver="GTiff", crs=f"EPSG:{region.grid.epsg}", transform=place, **shape) as target:
        target.write(values[None])
    return path


def checked(task: Task, values: np.ndarray, pose: sgb.Pose, *, off_m: float) -> sgb.Query:
    """The only query of a task, whose evidence is that of the mask, and whose truth is where it was drawn."""
    ((query, truth),) = zip(task.queries(), task.truths, strict=True)
    assert truth.pose is not None
    assert (truth.pose.easting_m, truth.pose.northing_m) == pytest.approx((pose.easting_m, pose.northing_m), abs=off_m)
    assert (truth.pose.yaw_deg - pose.yaw_deg + 180) % 360 - 180 == pytest.approx(0.0, abs=0.05)
    view = query.evidence
    cells = view.shape[0]
    start = (SIDE - cells) // 2
    for name, code in CODES.items():
        expected = values[start : start + cells, start : start + cells] == code
        is_known = view.layer(name) != sgb.UNKNOWN  # a roof hides ground behind it, under a camera of 100 m
        seen = view.layer(name) == sgb.PRESENT
        assert is_known.mean() > 0.9
        assert (seen == expected)[is_known].mean() > 0.98, name  # cells on an edge may go either way
    known = {name for name in view.classes if (view.layer(name) != sgb.UNKNOWN).any()}
    assert known == set(CODES)
    hidden = np.mean([(view.layer(name) == sgb.UNKNOWN).mean() for name in CODES])  # other classes hide nothing
    assert truth.unknown_share == pytest.approx(hidden)
    return query


def test_a_georeferenced_mask_is_evidence_of_the_map_where_it_lies(own_out, region, pose, values, legend, tmp_path):
    folder = tmp_path / "masks"
    folder.mkdir()
    write_mask(folder / "a.tif", values, region, pose)
    (task,) = sgb.import_masks(folder, legend=legend, region=TOWN, out=own_out)
    query = checked(task, values, pose, off_m=0.01)
    assert (query.suite, query.frames, query.track) == ("masks", (), "localization")
    assert np.hypot(query.prior.center_m[0] - pose.easting_m, query.prior.center_m[1] - pose.northing_m) > 1.0


def photo_at(path: Path, region: sgb.Region, pose: sgb.Pose, *, size=(SIDE, SIDE)) -> Path:
    """A photo from straight above whose pixels are those of the mask."""
    lon, lat = to_lonlat(region.grid.epsg).transform(pose.easting_m, pose.northing_m)
    true_deg = (pose.yaw_deg - to_grid(lon, lat, region.grid.epsg)[2] + 180) % 360 - 180
    focal_px = 24.0 * np.hypot(*size) / np.hypot(36.0, 24.0)
    down = POSE | {
        "RelativeAltitude": f"{focal_px * PIXEL_M:+.4f}",
        "GimbalPitchDegree": "-90.00",
        "GimbalYawDegree": f"{true_deg:+.4f}",
    }
    parts = {}
    for name, value, plus, minus in (("Latitude", lat, "N", "S"), ("Longitude", lon, "E", "W")):
        parts[getattr(ExifTags.GPS, f"GPS{name}Ref")] = plus if value >= 0 else minus
        parts[getattr(ExifTags.GPS, f"GPS{name}")] = (abs(value), 0.0, 0.0)
    return write_photo(path, gps=parts, xmp=xmp_of(down), focal=24, size=size)


@pytest.mark.parametrize("kind", ["png", "smaller png", "coco"])
def test_a_mask_of_a_photo_has_its_camera(own_out, region, pose, values, legend, tmp_path, kind):
    photos, masks = tmp_path / "photos", tmp_path / "masks"
    photos.mkdir()
    masks.mkdir()
    photo_at(photos / "a.jpg", region, pose)
    given = masks
    if kind == "coco":
        given = tmp_path / "coco.json"
        given.write_text(json.dumps(coco_of(values)))
        legend.write_text('[categories]\nroof = "building"\nlane = "road_minor"\nlake = "water"\n')
    else:
        step = 2 if kind == "smaller png" else 1
        Image.fromarray(values[::step, ::step], mode="L").save(masks / "A.png")
    (task,) = sgb.import_masks(given, photos=photos, legend=legend, region=TOWN, out=own_out)
    if kind == "smaller png":
        ((query, truth),) = zip(task.queries(), task.truths, strict=True)
        assert truth.pose.easting_m == pytest.approx(pose.easting_m, abs=0.5)
        share = (query.evidence.layer("water") == sgb.PRESENT).mean()
        assert share == pytest.approx((values == 3).mean(), abs=0.02)
    else:
        checked(task, values, pose, off_m=0.5)


def coco_of(values: np.ndarray) -> dict[str, object]:
    items = []
    for number, code in enumerate((1, 2, 3)):
        down = (values == code).flatten(order="F")
        edges = np.flatnonzero(np.diff(down.astype(np.int8))) + 1
        runs = np.diff([0, *edges, down.size]).tolist()
        counts = [0, *runs] if down[0] else runs
        mask = {"counts": counts, "size": list(values.shape)}
        items.append({"id": number, "image_id": 1, "category_id": code, "segmentation": mask})
    names = [{"id": 1, "name": "roof"}, {"id": 2, "name": "lane"}, {"id": 3, "name": "lake"}]
    rows, cols = values.shape
    image = {"id": 1, "file_name": "a.jpg", "height": rows, "width": cols}
    return {"images": [image], "categories": names, "annotations": items}


def test_probabilities_stay_probabilities(own_out, region, pose, values, tmp_path):
    folder = tmp_path / "masks"
    folder.mkdir()
    chances = np.where(values == 1, 0.8, 0.1).astype(np.float32)
    place = turned(pose.yaw_deg, PIXEL_M, east_m=pose.easting_m, north_m=pose.northing_m, size=(SIDE, SIDE))
    shape = {"width": SIDE, "height": SIDE, "count": 1, "dtype": "float32"}
    with rasterio.open(
        folder / "a.tif", "w", driver="GTiff", crs=f"EPSG:{region.grid.epsg}", transform=place, **shape
    ) as target:
        target.write(chances[None])
    (tmp_path / "legend.toml").write_text('[bands]\n1 = "building"\n')
    (task,) = sgb.import_masks(folder, legend=tmp_path / "legend.toml", region=TOWN, out=own_out)
    (query,) = task.queries()
    found = query.evidence.probabilities()[query.evidence.classes.index("building")]
    assert np.nanmax(found) == pytest.approx(0.8, abs=0.01)
    assert np.nanmin(found) == pytest.approx(0.1, abs=0.01)


def test_what_the_legend_does_not_name_is_said(own_out, region, pose, values, legend, tmp_path):
    folder = tmp_path / "masks"
    folder.mkdir()
    odd = values.copy()
    odd[:3] = 77
    write_mask(folder / "a.tif", odd, region, pose)
    lines = []
    sgb.import_masks(folder, legend=legend, region=TOWN, out=own_out, tell=lines.append)
    assert any(f"{3 * SIDE} pixels of 77" in line for line in lines)


@pytest.mark.parametrize(
    ("make", "hint"),
    [
        (lambda path, values: Image.fromarray(values, mode="L").save(path), "not georeferenced"),
        (lambda path, values: path.with_suffix(".txt").write_text(str(values.shape)), "holds no mask"),
    ],
)
def test_masks_without_a_place_are_refused(own_out, values, legend, tmp_path, make, hint):
    masks = tmp_path / "masks"
    masks.mkdir()
    make(masks / "a.png", values)
    with pytest.raises(ConfigError, match=hint):
        sgb.import_masks(masks, legend=legend, region=TOWN, out=own_out)


def test_a_mask_of_another_shape_and_a_photo_without_one_are_left_out(own_out, region, pose, values, legend, tmp_path):
    photos, masks = tmp_path / "photos", tmp_path / "masks"
    photos.mkdir()
    masks.mkdir()
    for name in ("a", "b", "c"):
        photo_at(photos / f"{name}.jpg", region, pose)
    Image.fromarray(values, mode="L").save(masks / "a.png")
    Image.fromarray(values[:100], mode="L").save(masks / "b.png")
    lines = []
    (task,) = sgb.import_masks(masks, photos=photos, legend=legend, region=TOWN, out=own_out, tell=lines.append)
    assert task.manifest.queries == 1
    assert any("c.jpg" in line and "without a mask" in line for line in lines)
    assert any("b.jpg" in line and "cut or turned" in line for line in lines)


def test_masks_with_one_fault_are_one_line_with_their_names_in_order(own_out, region, pose, values, tmp_path):
    photos, masks = tmp_path / "photos", tmp_path / "masks"
    photos.mkdir()
    masks.mkdir()
    for name, held in zip("dcba", (values, values[::-1], values.T, np.where(values == 3, 1, values)), strict=True):
        photo_at(photos / f"{name}.jpg", region, pose)
        Image.fromarray(held, mode="L").save(masks / f"{name}.png")
    (tmp_path / "legend.toml").write_text('[values]\n9 = "building"\n')  # and the background is not named
    lines = []
    with pytest.raises(ConfigError, match=r"4 pictures \(a\.jpg, b\.jpg, c\.jpg, \.\.\.\) that cannot be decoded"):
        sgb.import_masks(
            masks, photos=photos, legend=tmp_path / "legend.toml", region=TOWN, out=own_out, tell=lines.append
        )
    (line,) = (line for line in lines if "left out" in line)
    assert "a.jpg, b.jpg, c.jpg" in line
    assert 'it holds is not in the legend, such as 0: if that is the background, say 0 = "none"' in line


def test_masks_of_another_legend_are_one_line_however_many(own_out, region, pose, values, legend, tmp_path):
    photos, masks = tmp_path / "photos", tmp_path / "masks"
    photos.mkdir()
    masks.mkdir()
    for name in ("a", "b", "c"):
        photo_at(photos / f"{name}.jpg", region, pose)
        Image.fromarray(values * 60 + 5, mode="L").save(masks / f"{name}.png")
    with pytest.raises(
        ConfigError, match=r"3 pictures \(a\.jpg, b\.jpg, c\.jpg\) .*most of what it holds is not in the"
    ):
        sgb.import_masks(masks, photos=photos, legend=legend, region=TOWN, out=own_out)
    (tmp_path / "masks.zip").write_bytes(b"PK")
    with pytest.raises(ConfigError, match=r"masks\.zip is an archive: unpack it and name the folder"):
        sgb.import_masks(tmp_path / "masks.zip", photos=photos, legend=legend, region=TOWN, out=own_out)


def test_pixels_that_are_not_square_ask_for_a_warp(own_out, values, legend, tmp_path):
    folder = tmp_path / "masks"
    folder.mkdir()
    transform = Affine.translation(12.9, 48.2) @ Affine.scale(1e-5, -1e-5)
    shape = {"width": SIDE, "height": SIDE, "count": 1, "dtype": "uint8"}
    with rasterio.open(folder / "a.tif", "w", driver="GTiff", crs="EPSG:4326", transform=transform, **shape) as target:
        target.write(values[None])
    with pytest.raises(ConfigError, match="warp it to a projected CRS"):
        sgb.import_masks(folder, legend=legend, region=TOWN, out=own_out)


def test_a_smaller_mask_of_a_georeferenced_picture_keeps_its_scale(own_out, region, pose, values, legend, tmp_path):
    photos, masks = tmp_path / "photos", tmp_path / "masks"
    photos.mkdir()
    masks.mkdir()
    place = turned(pose.yaw_deg, PIXEL_M, east_m=pose.easting_m, north_m=pose.northing_m, size=(SIDE, SIDE))
    rgb = np.full((3, SIDE, SIDE), 120, dtype=np.uint8)
    shape = {"width": SIDE, "height": SIDE, "count": 3, "dtype": "uint8", "photometric": "RGB"}
    with rasterio.open(
        photos / "a.tif", "w", driver="GTiff", crs=f"EPSG:{region.grid.epsg}", transform=place, **shape
    ) as target:
        target.write(rgb)
    Image.fromarray(values[::2, ::2], mode="L").save(masks / "a.png")
    (task,) = sgb.import_masks(masks, photos=photos, legend=legend, region=TOWN, out=own_out)
    (query,) = task.queries()
    assert query.evidence.shape[0] * query.evidence.cell_size_m == pytest.approx(SIDE * PIXEL_M, abs=8)
    assert (query.evidence.layer("water") == sgb.PRESENT).mean() == pytest.approx((values == 3).mean(), abs=0.02)


def test_a_mask_that_is_stored_mirrored_is_refused(own_out, region, pose, values, legend, tmp_path):
    folder = tmp_path / "masks"
    folder.mkdir()
    place = turned(0.0, PIXEL_M, east_m=pose.easting_m, north_m=pose.northing_m, size=(SIDE, SIDE))
    south_up = place @ Affine.translation(0, SIDE) @ Affine.scale(1, -1)
    shape = {"width": SIDE, "height": SIDE, "count": 1, "dtype": "uint8"}
    with rasterio.open(
        folder / "a.tif", "w", driver="GTiff", crs=f"EPSG:{region.grid.epsg}", transform=south_up, **shape
    ) as target:
        target.write(values[::-1][None])
    with pytest.raises(ConfigError, match="stored mirrored"):
        sgb.import_masks(folder, legend=legend, region=TOWN, out=own_out)


def test_two_photos_of_one_name_share_no_mask(own_out, region, pose, values, legend, tmp_path):
    photos, masks = tmp_path / "photos", tmp_path / "masks"
    photos.mkdir()
    masks.mkdir()
    for name in ("a.jpg", "a.jpeg"):
        photo_at(photos / name, region, pose)
    Image.fromarray(values, mode="L").save(masks / "a.png")
    with pytest.raises(ConfigError, match="share a mask"):
        sgb.import_masks(masks, photos=photos, legend=legend, region=TOWN, out=own_out)


@pytest.mark.slow
def test_every_matcher_answers_masks(own_out, region, pose, values, legend, tmp_path):
    folder = tmp_path / "masks"
    folder.mkdir()
    write_mask(folder / "a.tif", values, region, pose)
    (task,) = sgb.import_masks(folder, legend=legend, region=TOWN, out=own_out)
    report = sgb.run(matcher="sasgeo", tasks=task.folder, out=own_out, trusted=True)
    assert report.counts == {"ok": 1}
