# SPDX-License-Identifier: Apache-2.0
"""Masks and probabilities of somebody else's network as tasks: evidence that every matcher reads."""

from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final

import numpy as np

from sasgeo_bench.core.errors import ConfigError, ImageError, SasgeoError, named
from sasgeo_bench.core.geotiff import open_geotiff
from sasgeo_bench.core.progress import tell
from sasgeo_bench.core.texts import plain
from sasgeo_bench.geometry.pose import Pose
from sasgeo_bench.observing.import_photos import ImportRequest, Perceived, table_of, view_cells, write_tasks
from sasgeo_bench.observing.masks import MASKS, Legend, Strange, read_coco, read_mask
from sasgeo_bench.observing.pictures import (
    ARCHIVES,
    OwnPicture,
    cell_of_view_m,
    largest_square,
    open_picture,
    resized,
)
from sasgeo_bench.observing.posed_pictures import (
    PosedPicture,
    PosedPictures,
    from_above,
    is_georeferenced,
    pose_pictures,
)
from sasgeo_bench.regions.region_files import read_manifest
from sasgeo_bench.sensing.birdseye import to_evidence
from sasgeo_bench.sensing.camera import Camera
from sasgeo_bench.sensing.ground import Plane
from sasgeo_bench.sensing.image import AerialImage
from sasgeo_bench.sensing.segmentation import Segmentation
from sasgeo_bench.tasks.frame_evidence import for_classes, unseen
from sasgeo_bench.tasks.task_files import Task

SUITE: Final = "masks"
_SQUARE: Final = 0.01  # by which the sides of a pixel on the ground may differ


@dataclass(frozen=True, kw_only=True)
class MaskRequest:
    """Masks that become tasks of a region.

    `photos` is the request for the pictures that the masks are of, and `masks` a folder with a mask for each of them,
    of its name with any suffix, or a COCO file. Where the masks are georeferenced, or a table tells their poses,
    `photos.pictures` is the folder of masks itself, and `masks` the same.
    """

    photos: ImportRequest
    masks: Path
    legend: Legend


def import_masks(request: MaskRequest) -> tuple[Task, ...]:
    """Write the tasks of some masks, as `import_photos` does of photos; their evidence is there at once.

    A mask has the size of its picture, or is smaller by one factor. What the legend does not name is unknown, and said.
    Raise as `import_photos`, and `ImageError` if no mask can be read; one that cannot is left out, with its reason.
    """
    photos = request.photos
    manifest = read_manifest(photos.region)
    strange = Strange()
    given = _Masks.of(request, strange)
    if request.masks == photos.pictures and request.masks.is_dir():
        found = _posed_masks(request, manifest.epsg)
    else:
        found = pose_pictures(
            photos.pictures, table_of(photos), epsg=manifest.epsg, heights=photos.heights, sigma_m=photos.sigma_m
        )
    users = Counter(_key(one.name) for one in found.pictures)

    def unmasked(one: PosedPicture) -> str:
        if not given.has(one.name):
            return f"without a mask of their name (there is {given.shown})"
        return "that share a mask with another picture" if users[_key(one.name)] > 1 else ""

    found.leave_out(unmasked)
    turned = [one.name for one in found.pictures if one.is_turned]
    if turned:
        tell(f"{named(turned, 'photo')} turned by EXIF: masks are taken as upright, as such a photo is shown")

    def perceive(one: PosedPicture) -> Perceived:
        """Return the evidence of a mask under the camera of its picture, for the classes of the map."""
        seen = given.read(one.name)
        rows, cols = seen.shape
        if one.picture.camera is None:
            gsd_m = square_pixel_m(one.picture, rows, cols)
            image_camera = AerialImage.from_above(np.zeros((rows, cols, 3), dtype=np.uint8), gsd_m=gsd_m).camera
        else:
            image_camera = scaled(one.picture.camera, rows, cols, plain(one.name))
        middle_m, side_m = largest_square(image_camera.footprint(Plane()))
        cell_m = cell_of_view_m(side_m)
        cells = view_cells(int(side_m / cell_m))
        pose = Pose(easting_m=middle_m[0], northing_m=middle_m[1], yaw_deg=0.0)
        evidence = to_evidence(seen, image_camera, Plane(), size_cells=cells, cell_size_m=cell_m, pose=pose)
        return Perceived(evidence=for_classes(evidence, unseen(manifest.classes, cells, cell_m)))

    absent = [name for name in request.legend.classes if name not in manifest.classes]
    if absent:
        tell(f"the map has no {', '.join(absent)}: what the masks say of it is left out")
    made = write_tasks(photos, manifest, found, perceive)
    if strange.note():
        tell(strange.note())
    return made


def square_pixel_m(picture: OwnPicture, rows: int, cols: int) -> float:
    """Return the width of a pixel of a mask of a georeferenced picture; raise `ImageError` if it is not square."""
    assert picture.size_m is not None  # noqa: S101 - it is georeferenced
    with open_geotiff(picture.path) as source:
        if source.transform.determinant > 0:
            raise ImageError(f"{picture.path.name} is stored mirrored, such as south-up: warp it (gdalwarp -r near)")
        shape = source.shape
    across_m, down_m = picture.size_m[0] / cols, picture.size_m[1] / rows
    if abs(across_m / down_m - 1) > _SQUARE:
        words = f"has pixels of {across_m:.2f} x {down_m:.2f} m"
        if (rows, cols) != shape:
            words += f", its picture {shape[1]} x {shape[0]} of them"
        raise ImageError(f"{picture.path.name} {words}: warp it to a projected CRS (gdalwarp -r near)")
    return across_m


def scaled(camera: Camera, rows: int, cols: int, name: str) -> Camera:
    """Return the camera of a mask that has fewer or more pixels than its picture; raise `ImageError` for another shape.

    >>> from sasgeo_bench.sensing.camera import Intrinsics
    >>> lens = Intrinsics.from_field_of_view(horizontal_deg=90.0, width_px=400, height_px=300)
    >>> camera = Camera.pointed(intrinsics=lens, east_m=0.0, north_m=0.0, height_m=50.0, yaw_deg=0.0)
    >>> scaled(camera, 150, 200, "a.png").intrinsics.focal_px
    (100.0, 100.0)
    """
    lens = camera.intrinsics
    across, down = cols / lens.width_px, rows / lens.height_px
    # a pixel of the smaller one: programs round a side up or down
    if abs(across - down) > 1.0 / min(lens.width_px, lens.height_px, rows, cols):
        raise ImageError(
            f"the mask of {name} has {cols} x {rows} pixels, its picture {lens.width_px} x {lens.height_px}: it was "
            "stretched (resize it to the shape of the picture), cut or turned"
        )
    return replace(camera, intrinsics=resized(lens, (cols, rows), (across, down)))


@dataclass(frozen=True, kw_only=True)
class _Masks:
    """Masks by the names of pictures: files of a folder, or of one COCO file."""

    legend: Legend
    strange: Strange
    files: dict[str, Path]
    coco: dict[str, Segmentation]

    @classmethod
    def of(cls, request: MaskRequest, strange: Strange) -> "_Masks":
        path, legend = request.masks, request.legend
        if path.is_file() and path.suffix.lower() == ".json":
            coco: dict[str, Segmentation] = {}
            for name, seen in read_coco(path, legend):
                if _key(name) in coco:
                    raise ConfigError(f"{path.name} names {plain(name)} and another picture of that name: rename one")
                coco[_key(name)] = seen
            return cls(legend=legend, strange=strange, files={}, coco=coco)
        if path.suffix.lower() in ARCHIVES:
            raise ConfigError(f"{path} is an archive: unpack it and name the folder")
        if not path.is_dir():
            raise ConfigError(f"{path} is no folder of masks, nor a COCO file (*.json): check the path")
        files: dict[str, Path] = {}
        for file in _files(path):
            other = files.setdefault(_key(file.relative_to(path).as_posix()), file)
            if other != file:
                raise ConfigError(f"{path} holds {other.name} and {file.name} for one picture: keep one of them")
        if not files:
            raise ConfigError(f"{path} holds no mask ({', '.join(MASKS)}): name a folder that does")
        return cls(legend=legend, strange=strange, files=files, coco={})

    @property
    def shown(self) -> str:
        """Return the first of the masks, by name."""
        return plain(next(iter([*self.coco, *(path.name for path in self.files.values())]), "none"))

    def has(self, name: str) -> bool:
        return _key(name) in self.files or _key(name) in self.coco

    def read(self, name: str) -> Segmentation:
        key = _key(name)
        return self.coco[key] if key in self.coco else read_mask(self.files[key], self.legend, self.strange)


def _files(folder: Path) -> Iterator[Path]:
    return (one for one in sorted(folder.rglob("*")) if one.suffix.lower() in MASKS and one.is_file())


def _key(name: str) -> str:
    """Return a name without its suffix, by which pictures and masks find each other."""
    return name.rpartition(".")[0].casefold() or name.casefold()


def _posed_masks(request: MaskRequest, epsg: int) -> PosedPictures:
    """Return the masks of a folder that say themselves where they lie; with a table, those that it names."""
    photos, found = request.photos, PosedPictures()
    if photos.poses is not None:
        return pose_pictures(
            photos.pictures, table_of(photos), epsg=epsg, heights=photos.heights, sigma_m=photos.sigma_m
        )
    for path in _files(request.masks):
        name = path.relative_to(request.masks).as_posix()
        try:
            found.pictures.append(_georeferenced(path, name, epsg, photos.sigma_m))
        except SasgeoError as error:
            found.left_out[f"that say no place ({plain(str(error)).replace(path.name, 'it')[:160]})"].append(name)
    return found


def _georeferenced(path: Path, name: str, epsg: int, sigma_m: float | None) -> PosedPicture:
    if path.suffix.lower() not in (".tif", ".tiff") or not is_georeferenced(path):
        raise ImageError(f"{path.name} is not georeferenced: name its photos with --photos, or a table with --poses")
    picture = open_picture(path)
    assert picture.lonlat is not None  # noqa: S101 - by its georeference
    with open_geotiff(path) as source:
        rows, cols = source.shape
    square_pixel_m(picture, rows, cols)
    return from_above(picture, name, epsg, sigma_m)
