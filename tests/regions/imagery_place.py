# SPDX-License-Identifier: Apache-2.0
"""A made-up place with an aerial picture: houses as GeoJSON, and a GeoTIFF on which they are seen."""

import json
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pyproj
import rasterio
import shapely
from affine import Affine
from numpy.typing import NDArray
from rasterio.features import rasterize
from shapely import affinity

from sasgeo_bench.core.config import parse_toml
from sasgeo_bench.core.folders import sha256_of
from sasgeo_bench.regions.region_spec import RegionFile
from sasgeo_bench.regions.tiles import record_of

EPSG = 32632
WEST, SOUTH = 500_000.0, 5_210_000.0
SIDE_M = 384.0
GSD_M = 0.5
MERCATOR = 3857

SPEC = """
id = "hamlet"
title = "A hamlet"
scenes = ["suburban"]
bounds_lonlat = {bounds}
cell_size_m = 1.0
epsg = 32632
classes = ["building"]
largest_view_m = 96.0
coverage_parts_lonlat = [{ring}]
[[extract]]
file = "houses.geojson"
date = 2024-01-01
format = "geojson"
tags = {{ building = "yes" }}
sha256 = ["{extract}"]
[[imagery]]
file = "{picture}"
date = 2023-06-01
licence = "CC-BY-4.0"
attribution = "(c) somebody with a drone"
publish = {publish}
sha256 = ["{sha256}"]
"""


@dataclass(frozen=True, kw_only=True)
class Hamlet:
    """Files of the place in a folder, and the houses in metres."""

    folder: Path
    houses: list[shapely.Polygon]
    publish: bool = True
    picture: str = "mosaic.tif"
    extra: str = ""

    def text(self) -> str:
        """Return the text of the region file."""
        ring = to_lonlat(shapely.box(WEST + 20, SOUTH + 20, WEST + SIDE_M - 20, SOUTH + SIDE_M - 20))
        bounds = to_lonlat(shapely.box(WEST, SOUTH, WEST + SIDE_M, SOUTH + SIDE_M)).bounds
        text = SPEC.format(
            bounds=list(bounds),
            ring=[list(place) for place in ring.exterior.coords[:-1]],
            extract=sha256_of(self.folder / "houses.geojson"),
            picture=self.picture,
            publish=str(self.publish).lower(),
            sha256=record_of(self.folder / self.picture).sha256,
        )
        return text + self.extra

    def spec(self) -> RegionFile:
        """Return the region file."""
        return parse_toml(self.text(), RegionFile, source="hamlet.toml")

    def but(self, **changes: object) -> "Hamlet":
        """Return the place with other settings."""
        return replace(self, **changes)


def to_lonlat(shape: shapely.Geometry) -> shapely.Geometry:
    """Project a shape to longitude and latitude."""
    change = pyproj.Transformer.from_crs(EPSG, 4326, always_xy=True)
    return shapely.transform(shape, lambda at: np.column_stack(change.transform(*at.T)))


def make_hamlet(folder: Path, *, off_m: tuple[float, float] = (0.0, 0.0), seed: int = 3) -> Hamlet:
    """Write houses and a mosaic in Web Mercator, on which everything is seen `off_m` east and north of the map."""
    rng = np.random.default_rng(seed)
    folder.mkdir(parents=True, exist_ok=True)
    houses = [
        affinity.rotate(shapely.box(x, y, x + rng.uniform(8, 20), y + rng.uniform(8, 16)), rng.uniform(0, 90))
        for x in np.arange(WEST + 10, WEST + SIDE_M - 20, 32)
        for y in np.arange(SOUTH + 10, SOUTH + SIDE_M - 20, 32)
    ]
    write_houses(folder / "houses.geojson", houses)
    seen = [affinity.translate(house, *off_m) for house in houses]
    write_mosaic(folder / "mosaic.tif", seen, rng)
    return Hamlet(folder=folder, houses=houses)


def write_houses(path: Path, houses: list[shapely.Polygon], **more: object) -> None:
    """Write polygons as a GeoJSON file."""
    features = [
        {"type": "Feature", "properties": {"osm_id": at + 1}, "geometry": shapely.geometry.mapping(to_lonlat(house))}
        for at, house in enumerate(houses)
    ]
    path.write_text(json.dumps({"type": "FeatureCollection", "features": features, **more}))


def write_mosaic(path: Path, houses: list[shapely.Polygon], rng: np.random.Generator, **profile: object) -> None:
    """Write a picture of roofs on rough ground, in Web Mercator, a little larger than the place."""
    change = pyproj.Transformer.from_crs(EPSG, MERCATOR, always_xy=True)
    margin, end = 30.0, SIDE_M + 30.0
    rim = shapely.segmentize(shapely.box(WEST - margin, SOUTH - margin, WEST + end, SOUTH + end), 50.0)
    west, _, _, north = shapely.transform(rim, lambda at: np.column_stack(change.transform(*at.T))).bounds
    pixel = GSD_M / np.cos(np.radians(47.0))
    side = int((SIDE_M + 2 * margin) / GSD_M)
    transform = Affine(pixel, 0, west, 0, -pixel, north)
    roofs = [shapely.transform(house, lambda at: np.column_stack(change.transform(*at.T))) for house in houses]
    is_roof = rasterize(roofs, out_shape=(side, side), transform=transform).astype(bool)
    rgb = rng.normal(90, 12, (3, side, side)) + np.where(is_roof, 90, 0)
    write_picture(path, np.clip(rgb, 1, 250).astype(np.uint8), transform=transform, **profile)


def write_picture(path: Path, bands: NDArray[np.generic], **profile: object) -> None:
    """Write bands, shape (bands, rows, cols), as a GeoTIFF; in Web Mercator unless told otherwise."""
    count, rows, cols = bands.shape
    about = {"crs": f"EPSG:{MERCATOR}", "tiled": True, "compress": "deflate", **profile}
    with rasterio.open(
        path, "w", driver="GTiff", count=count, height=rows, width=cols, dtype=bands.dtype, **about
    ) as to:
        to.write(bands)
