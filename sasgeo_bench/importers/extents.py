# SPDX-License-Identifier: Apache-2.0
"""Ground of a dataset with coordinates, and the OpenStreetMap extracts that cover it."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from importlib import resources
from pathlib import Path
from typing import Annotated, Final

import numpy as np
import shapely
from pydantic import Field
from sklearn.cluster import DBSCAN  # type: ignore[import-untyped, unused-ignore]

from sasgeo_bench.config import Document, Line, parse_toml
from sasgeo_bench.errors import DatasetError
from sasgeo_bench.geometry.projection import to_lonlat
from sasgeo_bench.importers.items import Box, Dataset, Item
from sasgeo_bench.regions.region_spec import RegionFile, list_region_files, read_region_file

GAP_M: Final = 5_000.0  # items farther apart than this lie in different areas
_RADIUS_M: Final = 6_371_000.0
_M_PER_DEG: Final = 111_320.0
_STEP_DEG: Final = 0.001  # items within such a cell count once when areas are formed
_FILE: Final = "regional_extracts.toml"


class RegionalExtract(Document):
    """A regional extract of download.geofabrik.de, by its name there; the box is rounded outwards."""

    name: Line
    box: Annotated[tuple[float, float, float, float], Field(strict=False)]


class _RegionalExtracts(Document):
    extract: list[RegionalExtract]


@cache
def regional_extracts() -> tuple[RegionalExtract, ...]:
    """Return the regional extracts that are known here: provinces of China, and the continents."""
    text = resources.files("sasgeo_bench.importers").joinpath(_FILE).read_text(encoding="utf-8")
    return tuple(parse_toml(text, _RegionalExtracts, source=_FILE).extract)


@dataclass(frozen=True, slots=True, kw_only=True)
class Extent:
    """One area of a dataset.

    Parameters
    ----------
    box : Box
        Its items, with a margin.
    items : int
        How many items lie in it.
    groups : tuple of str
        Their groups, such as flights.
    width_km, height_km : float
        Size of the box.
    covered_by, touched_by : tuple of str
        Region files whose ground covers the box, or meets it in part.
    extracts : tuple of str
        Names of regional extracts whose boxes hold the area, smallest first; the first may be a neighbour's.
    """

    box: Box
    items: int
    groups: tuple[str, ...]
    width_km: float
    height_km: float
    covered_by: tuple[str, ...]
    touched_by: tuple[str, ...]
    extracts: tuple[str, ...]


def find_extents(dataset: Dataset, *, folders: Sequence[Path] = ()) -> tuple[Extent, ...]:
    """Return the areas of a dataset, from west to east, and what covers each.

    Items lie in one area if steps of at most 5 km lead from one to the other; each area gets a margin of 500 m.
    `folders` hold region files of the user's own. Raise `DatasetError` if no item has a place.
    """
    placed = [item for item in dataset.items if item.position is not None]
    if not placed:
        raise DatasetError(f"{dataset.card.title} has no coordinates: no extract can be named for it")
    grounds = _region_grounds(folders)
    extents = [_extent(members, grounds) for members in _clusters(placed)]
    return tuple(sorted(extents, key=lambda extent: (extent.box.west_deg, extent.box.south_deg)))


def _extent(members: Sequence[Item], grounds: dict[str, shapely.Geometry]) -> Extent:
    box = _box_of(members)
    area = shapely.box(box.west_deg, box.south_deg, box.east_deg, box.north_deg)
    covering = [name for name, ground in grounds.items() if ground.covers(area)]
    touching = [name for name, ground in grounds.items() if name not in covering and ground.intersects(area)]
    holding = [item for item in regional_extracts() if shapely.box(*item.box).covers(area)]
    per_lon_m = _M_PER_DEG * math.cos(math.radians(box.centre.latitude_deg))
    return Extent(
        box=box,
        items=len(members),
        groups=tuple(sorted({item.group for item in members if item.group is not None})),
        width_km=(box.east_deg - box.west_deg) * per_lon_m / 1000,
        height_km=(box.north_deg - box.south_deg) * _M_PER_DEG / 1000,
        covered_by=tuple(covering),
        touched_by=tuple(touching),
        extracts=tuple(item.name for item in sorted(holding, key=lambda item: shapely.box(*item.box).area)),
    )


def _clusters(items: Sequence[Item]) -> list[list[Item]]:
    """Group items that steps of `GAP_M` connect."""
    lonlat = np.array([(item.position.longitude_deg, item.position.latitude_deg) for item in items if item.position])
    cells, member = np.unique(np.round(lonlat / _STEP_DEG), axis=0, return_inverse=True)
    places = np.radians(cells[:, ::-1] * _STEP_DEG)
    search = DBSCAN(eps=GAP_M / _RADIUS_M, min_samples=1, metric="haversine", algorithm="ball_tree")
    labels = search.fit_predict(places)[member.ravel()]
    return [[items[int(at)] for at in np.flatnonzero(labels == label)] for label in np.unique(labels)]


def _box_of(items: Sequence[Item]) -> Box:
    places = [item.position for item in items if item.position is not None]
    longitudes, latitudes = [place.longitude_deg for place in places], [place.latitude_deg for place in places]
    north_deg = 500.0 / _M_PER_DEG  # m: a view reaches beyond its centre
    east_deg = north_deg / math.cos(math.radians(sum(latitudes) / len(latitudes)))
    return Box(
        west_deg=min(longitudes) - east_deg,
        south_deg=min(latitudes) - north_deg,
        east_deg=max(longitudes) + east_deg,
        north_deg=max(latitudes) + north_deg,
    )


def _region_grounds(folders: Sequence[Path]) -> dict[str, shapely.Geometry]:
    """Return the ground of each region file, degrees; made-up towns have none."""
    specs = {name: read_region_file(path) for name, path in sorted(list_region_files(folders=folders).items())}
    return {name: _ground(spec) for name, spec in specs.items() if not all(item.town for item in spec.extract)}


def _ground(spec: RegionFile) -> shapely.Geometry:
    """Return what a region's extract is known to map: its coverage if it is stated, else the region itself."""
    if spec.coverage_lonlat is not None:
        return shapely.Polygon(spec.coverage_lonlat)
    grid = spec.grid()
    return shapely.box(*to_lonlat(grid.epsg).transform_bounds(*grid.bounds_m))
