# SPDX-License-Identifier: Apache-2.0
"""Rendered reference imagery: the whole of a region from above, as it was at one date, in a look of its own."""

import datetime as dt
import os
import shutil
from collections.abc import Generator, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Final

import numpy as np
import shapely

from sasgeo_bench.core.errors import ConfigError, ImageryError, SasgeoError, StoreError
from sasgeo_bench.core.folders import file_record, fresh_folder, locked
from sasgeo_bench.core.progress import tell
from sasgeo_bench.geometry.grid import Grid
from sasgeo_bench.geometry.projection import from_lonlat
from sasgeo_bench.regions import region_files
from sasgeo_bench.regions.build import build_region, package_version, plan_build, share_shown
from sasgeo_bench.regions.evidence import UNKNOWN
from sasgeo_bench.regions.imagery import ORTHO, Bounds, Imagery, OrthoRecord, PictureRecord, RenderedRecord
from sasgeo_bench.regions.layers import OUTSIDE, Paint, burn_layers, make_paint
from sasgeo_bench.regions.ortho import OrthoTile, lattice_within, write_tiles
from sasgeo_bench.regions.region import LICENCE, Manifest, Region
from sasgeo_bench.regions.region_spec import RegionFile
from sasgeo_bench.sensing.image import AerialImage, LabelledImage
from sasgeo_bench.sensing.rendering.conditions import Conditions, Sun
from sasgeo_bench.sensing.rendering.palettes import PALETTES, Family
from sasgeo_bench.sensing.rendering.scene import Scene, make_scene
from sasgeo_bench.sensing.rendering.seasons import SEASONS, Season
from sasgeo_bench.sensing.rendering.texture import seed_of
from sasgeo_bench.sensing.rendering.view import render_ortho

if TYPE_CHECKING:
    import geopandas as gpd

LEAST_LABELLED: Final = 0.25  # fraction of a view; one that shows less of the mapped area is left out


def part_bounds_m(spec: RegionFile, *, epsg: int) -> tuple[Bounds, ...]:
    """Return west, south, east, north of each part of the mapped area that a region file states, in its order.

    >>> from sasgeo_bench.regions.region_spec import find_region_file, read_region_file
    >>> north, south = part_bounds_m(read_region_file(find_region_file("zanzibar")), epsg=32737)
    >>> [round(end - start) for start, end in zip(north, north[2:])]  # metres
    [608, 302]
    """
    to_map = from_lonlat(epsg)
    rings = [spec.coverage_lonlat] if spec.coverage_lonlat is not None else spec.coverage_parts_lonlat or []
    corners = [np.column_stack(to_map.transform(*np.array(ring).T)) for ring in rings]
    return tuple(tuple(shapely.LinearRing(ring).bounds) for ring in corners)


def split_bounds(bounds_m: Bounds, count: int) -> tuple[Bounds, ...]:
    """Return `count` equally wide blocks of a box, west first.

    >>> split_bounds((0.0, 0.0, 30.0, 10.0), 2)
    ((0.0, 0.0, 15.0, 10.0), (15.0, 0.0, 30.0, 10.0))
    """
    west, south, east, north = bounds_m
    edges = np.linspace(west, east, count + 1).tolist()
    return tuple((left, south, right, north) for left, right in pairwise(edges))


def region_views(
    region: Region, bounds_m: Bounds, *, place: str, gsd_m: float = 0.25, side_px: int = 400
) -> Iterator[LabelledImage]:
    """Yield square views of a part of a region, side by side, with the classes of its map as labels.

    Parameters
    ----------
    region : Region
        A region with imagery.
    bounds_m : tuple of float
        West, south, east, north of the part of the picture, metres in the region's CRS.
    place : str
        Place of the labelled images.
    gsd_m, side_px : float, int
        Width of a pixel on the ground, and pixels of a side. Views at the eastern and southern edge may be narrower, by
        half a side at most.

    Raises
    ------
    ImageryError
        If the region has no imagery.

    Notes
    -----
    Labels are burned from the features at the pixels of the view; the offset of the imagery against the map is taken
    off where it was measured. They are UNKNOWN outside the mapped area and where the imagery has no data. Views of
    which less than `LEAST_LABELLED` is known are left out.

    Examples
    --------
    `list(region_views(read_region("out/regions/zanzibar"), bounds_m, place="zanzibar-north"))` holds views of 100 m.
    """
    if region.imagery is None:
        raise ImageryError(f"region {region.manifest.id} has no imagery: choose one whose region file names some")
    paint = make_paint(region.features, region.classes, region.coverage)
    whole = Grid.from_bounds(*bounds_m, cell_size_m=gsd_m, epsg=region.grid.epsg)
    for row, rows in _strips(whole.rows, side_px):
        for col, cols in _strips(whole.cols, side_px):
            view = _view(region.imagery, region.classes, paint, whole.window(row, col, rows, cols), place)
            if (view.labels != UNKNOWN).any(axis=0).mean() >= LEAST_LABELLED:
                yield view


def _strips(total: int, side: int) -> Iterator[tuple[int, int]]:
    """Yield start and length of the strips of an axis; the last one is left out if shorter than half a side."""
    for start in range(0, total, side):
        length = min(side, total - start)
        if 2 * length >= side:
            yield start, length


def _view(imagery: Imagery, classes: tuple[str, ...], paint: Paint, grid: Grid, place: str) -> LabelledImage:
    shown = imagery.read(grid.bounds_m, gsd_m=grid.cell_size_m)
    right_m, up_m = imagery.off_m
    labels = burn_layers(paint, replace(grid, west_m=grid.west_m - right_m, north_m=grid.north_m - up_m))
    labels[(labels == OUTSIDE) | ~shown.is_known] = UNKNOWN
    image = AerialImage.from_above(np.ascontiguousarray(shown.rgb), gsd_m=grid.cell_size_m)
    return LabelledImage(image=image, classes=classes, labels=labels, place=place)


FINEST_M: Final = 0.25
COARSEST_M: Final = 2.0
_LOOK: Final = "reference imagery"  # no query is drawn in a look of a name that begins so
_TILE_PX: Final = 1024
_REACH_M: Final = 40.0  # painted around a tile: shadows fall into it, yards and crowns reach into it
_COARSEST_CELL_M: Final = 1.0
_SOURCE: Final = "rendered from the map: no photograph, and not the look of any query"


@dataclass(frozen=True, slots=True, kw_only=True)
class Look:
    """How reference imagery looks; raise `ConfigError` for a family, season or resolution that there is not.

    >>> Look(season="monsoon")
    Traceback (most recent call last):
        ...
    sasgeo_bench.core.errors.ConfigError: season is one of spring, summer, autumn, winter, snow, got 'monsoon'
    """

    family: Family = "calibration"
    season: Season = "autumn"
    gsd_m: float = 0.5
    seed: int = 0

    def __post_init__(self) -> None:
        for name, known in (("family", tuple(PALETTES)), ("season", SEASONS)):
            if getattr(self, name) not in known:
                raise ConfigError(f"{name} is one of {', '.join(known)}, got {getattr(self, name)!r}")
        if not FINEST_M <= self.gsd_m <= COARSEST_M:
            raise ConfigError(f"gsd_m lies between {FINEST_M:g} and {COARSEST_M:g} m, got {self.gsd_m!r}")

    def conditions(self, place: str) -> Conditions:
        """Return one light for the whole image, drawn for place and seed: a survey flies around noon, in the clear."""
        rng = np.random.default_rng(seed_of(place, _LOOK, self.seed))
        sun = Sun(
            elevation_deg=round(float(rng.uniform(30, 55)), 1), azimuth_deg=round(float(rng.uniform(110, 250)), 1)
        )
        return Conditions(season=self.season, sun=sun, cloud=0.15, noise=0.006, jpeg_quality=0)

    @property
    def name(self) -> str:
        """Return what seeds its styles: it differs from that of all queries, and from seed to seed."""
        return f"{_LOOK} {self.seed}"


def render_imagery(folder: Path, world: Path, look: Look) -> OrthoRecord:
    """Render the map in `world`, a dated state of the place of the region in `folder`, as that region's imagery.

    The region's map stays as it is, and so does its hash: tasks and answers of methods that look at no imagery stay
    valid. Nothing is done if the region has this very imagery. A failed rendering leaves the region as it was.

    Raises
    ------
    StoreError
        If either is not built, or the folder cannot be written.
    ImageryError
        If the region has real imagery, or the map shows nothing to draw.
    """
    region_files.read_manifest(folder)  # before a lock is made: what is no region gets no file beside it
    try:
        with locked(folder):
            manifest, shown = region_files.read_manifest(folder), region_files.read_manifest(world)
            picture = _picture(manifest, shown, look)
            if _is_current(folder, manifest, picture) and manifest.imagery is not None:
                tell(f"{folder.name}: rendered imagery is up to date, nothing to do")
                return manifest.imagery
            features = region_files.read_features(world)  # without the layers, which take more memory than a tile
            rendering = _Rendering(folder, manifest, shown, features, look, picture)
            # Refuse a map without a visible feature in the bounds
            geometry = rendering.features.geometry.to_numpy()[rendering.features["is_visible"].to_numpy()]
            if not shapely.intersects(geometry, shapely.box(*rendering.manifest.bounds_m)).any():
                raise ImageryError(
                    f"{rendering.folder.name} of {rendering.picture.date} shows nothing to draw: take another date"
                )
            with fresh_folder(folder) as scratch:
                return _render_into(scratch, rendering)
    except SasgeoError:
        raise
    except OSError as error:
        raise StoreError(
            f"{folder} cannot be written ({error.strerror or error}): check the free space and your rights"
        ) from error


def render_place(
    spec: RegionFile,
    *,
    look: Look,
    out: Path,
    date: dt.date | None = None,
    extract_folders: Sequence[Path] = (),
) -> Path:
    """Render the imagery of a region that is built in `out`; an older state of its place is built if it is missing.

    Return the image. Raise as `render_imagery` and `plan_build` do.
    """
    plan = plan_build(spec, out=out, extract_folders=extract_folders)
    if not plan.is_current:
        raise StoreError(
            f"{plan.folder} is not built, or not by this region file: run sasgeo-bench build-region {spec.id}"
        )
    world = plan if date is None else plan_build(spec, out=out, date=date, extract_folders=extract_folders)
    if not world.is_current:
        build_region(world)
    render_imagery(plan.folder, world.folder, look)
    return plan.folder / ORTHO


@dataclass(frozen=True, slots=True)
class _Rendering:
    """What is rendered: the region that gets the imagery, the map that it shows, its look and its record.

    `features` are those of the map that is shown.
    """

    folder: Path
    manifest: Manifest
    shown: Manifest
    features: "gpd.GeoDataFrame"
    look: Look
    picture: PictureRecord

    @property
    def place(self) -> str:
        return place_of(self.manifest.id)


def place_of(region: str) -> str:
    """Return the place of a map, by which its styles are drawn.

    >>> place_of("vaduz@2013-08-03")
    'vaduz'
    """
    return region.split("@", maxsplit=1)[0]


def _picture(manifest: Manifest, shown: Manifest, look: Look) -> PictureRecord:
    """Return the record of the image; refuse a region whose imagery is real."""
    if manifest.imagery is not None and not manifest.imagery.is_rendered:
        raise ImageryError(
            f"{manifest.id} has imagery of its own ([[imagery]] in its region file): a rendered one adds nothing"
        )
    extract, sun = shown.extract, look.conditions(place_of(manifest.id)).sun
    return PictureRecord(
        file=extract.file,
        sha256=extract.sha256,
        bytes=extract.bytes,
        date=extract.date,
        licence=LICENCE,
        attribution=shown.attribution,
        publish=all(own.publish for own in shown.own_maps),
        source=_SOURCE,
        gsd_m=look.gsd_m,
        rendered=RenderedRecord(
            family=look.family,
            season=look.season,
            seed=look.seed,
            sun_elevation_deg=sun.elevation_deg,
            sun_azimuth_deg=sun.azimuth_deg,
            map_sha256=shown.inputs_sha256,
            made_by=f"sasgeo-bench {package_version()}",
        ),
    )


def _is_current(folder: Path, manifest: Manifest, picture: PictureRecord) -> bool:
    path, record = folder / ORTHO, manifest.imagery
    if record is None or record.pictures != (picture,) or not path.is_file():
        return False
    return ORTHO in manifest.files and manifest.files[ORTHO] == file_record(path)


def _render_into(scratch: Path, rendering: _Rendering) -> OrthoRecord:
    """Fill the folder that replaces a region's: its other files, the image, and a manifest that says so."""
    folder, manifest = rendering.folder, rendering.manifest
    tell(f"{folder.name}: rendering {rendering.picture.to_text().removeprefix('rendered from ')}")
    for name in manifest.files:
        if name != ORTHO:
            _link(folder / name, scratch / name)
    bounds = np.array([manifest.bounds_m])
    grid = lattice_within(bounds, manifest.grid, finest_m=rendering.look.gsd_m)
    tiles = _tiles(rendering, grid)
    if not write_tiles(scratch / ORTHO, grid, tiles, attribution=rendering.picture.attribution, licence=LICENCE):
        raise ImageryError(f"{folder.name} of {rendering.picture.date} has no mapped ground: take another date")
    # Record with the share of the region's mapped ground that is shown
    # There is no offset to measure: the image lies on the map that it shows.
    record = OrthoRecord.unmeasured((rendering.picture,), grid)
    imagery = Imagery(path=scratch / ORTHO, file=file_record(scratch / ORTHO), record=record, epsg=grid.epsg)
    mapped = shapely.from_wkt(rendering.manifest.coverage.wkt)
    record = record.model_copy(update={"share": share_shown(imagery, mapped, rendering.manifest.cell_size_m)})
    files = manifest.files | {ORTHO: file_record(scratch / ORTHO)}
    changed = manifest.model_copy(update={"files": dict(sorted(files.items())), "imagery": record})
    region_files.write_manifest(scratch, changed)
    tell(f"{folder.name}: {record.to_text()}")
    return record


def _link(source: Path, target: Path) -> None:
    """Give a file a second name; copy it where the file system has no such names."""
    with suppress(OSError):
        os.link(source, target)
        return
    shutil.copy2(source, target)


def _tiles(rendering: _Rendering, grid: Grid) -> Generator[OrthoTile]:
    """Yield the image tile by tile: one painted window is in memory at a time."""
    conditions = rendering.look.conditions(rendering.place)
    for row, col, part in grid.windows(_TILE_PX):
        scene = _scene(rendering, part)
        # Which pixels show mapped ground, shape (rows, cols)
        length = max(part.shape)
        diagonal = scene.grid.to_cells(part.to_centres_m(np.column_stack([np.arange(length)] * 2).astype(np.int64)))
        rows, cols = diagonal[: part.rows, 0], diagonal[: part.cols, 1]
        is_known = np.asarray(scene.is_mapped[np.ix_(rows, cols)])
        if not is_known.any():
            continue
        rng = np.random.default_rng((seed_of(rendering.place, rendering.look.name), row, col))
        picture = render_ortho(scene, part, conditions, rng)
        yield OrthoTile(row=row, col=col, rgb=np.ascontiguousarray(np.moveaxis(picture, -1, 0)), is_known=is_known)


def _scene(rendering: _Rendering, part: Grid) -> Scene:
    cell_m = min(part.cell_size_m, _COARSEST_CELL_M)
    west, south, east, north = part.bounds_m
    window = Grid.from_bounds(
        west - _REACH_M, south - _REACH_M, east + _REACH_M, north + _REACH_M, cell_size_m=cell_m, epsg=part.epsg
    )
    return make_scene(
        rendering.features,
        rendering.shown.classes,
        shapely.from_wkt(rendering.shown.coverage.wkt),
        place=f"{rendering.place}/{rendering.look.name}",
        window=window,
        family=rendering.look.family,
    )
