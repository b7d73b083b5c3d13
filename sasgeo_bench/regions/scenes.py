# SPDX-License-Identifier: Apache-2.0
"""Scenes: the kinds of ground of a region, told by the shares of its mapped ground, not by looking at it."""

import datetime as dt
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import geopandas as gpd
import numpy as np
import osmium
import shapely
from numpy.typing import NDArray

from sasgeo_bench.geometry.grid import Grid
from sasgeo_bench.geometry.pairs import overlapping
from sasgeo_bench.osm.features import SEA
from sasgeo_bench.osm.mapped import lonlat_box, project
from sasgeo_bench.osm.read import Reading, read_extract
from sasgeo_bench.osm.scan import area_wkb, reaches
from sasgeo_bench.osm.snapshot import elements, open_snapshot
from sasgeo_bench.regions.region_spec import Scene

URBAN: Final = 0.15  # shares of the mapped ground: under buildings
SUBURBAN: Final = 0.03  # with less a region is rural
FIELDS: Final = 0.15
WATER: Final = 0.02
SHORE: Final = 0.15  # under water, where less than `SUBURBAN` is under buildings
INDUSTRY: Final = 0.10
WOOD: Final = 0.25
BARE: Final = 0.15
SPARSE: Final = 0.10  # under anything at all, at most

_PROBE_M: Final = 16.0  # 65,000 probes in a region of 16 km2: a share is known to 0.2 %
_TAGS: Final = {  # of areas that are no class of their own, or of one with others
    "industry": (("landuse", "industrial"),),
    "wood": (("landuse", "forest"), ("natural", "wood"), ("landcover", "trees")),
    "bare": (("natural", "desert"),),
}


@dataclass(frozen=True, slots=True, kw_only=True)
class Ground:
    """Shares of the mapped ground of a region, 0 to 1, and whether a coastline runs through it."""

    built: float
    fields: float
    water: float
    industry: float
    wood: float
    bare: float
    drawn: float
    is_coast: bool

    def scenes(self) -> list[Scene]:
        """Return the kinds of ground: "urban", "suburban" or "rural", and what else there is.

        Examples
        --------
        >>> shares = {"built": 0.01, "fields": 0.0, "water": 0.2, "industry": 0.0, "bare": 0.0, "drawn": 0.6}
        >>> Ground(**shares, wood=0.3, is_coast=False).scenes()
        ['rural', 'riverside', 'forest', 'shore']
        """
        found: dict[Scene, bool] = {
            "urban": self.built >= URBAN,
            "suburban": SUBURBAN <= self.built < URBAN,
            "rural": self.built < SUBURBAN,
            "industrial": self.industry >= INDUSTRY,
            "riverside": self.water >= WATER and not self.is_coast,
            "agricultural": self.fields >= FIELDS,
            "coastal": self.is_coast,
            "forest": self.wood >= WOOD,
            "desert": self.bare >= BARE,
            "shore": self.water >= SHORE and self.built < SUBURBAN,
            "sparse": self.drawn < SPARSE,
        }
        return [name for name, is_there in found.items() if is_there]


def measure_ground(path: Path, grid: Grid, *, at: dt.date | None = None) -> Ground:
    """Measure the mapped ground of a grid in an extract.

    Parameters
    ----------
    path : Path
        An extract, or a full history.
    grid : Grid
        Of the region.
    at : date, optional
        Day of the map.

    Raises
    ------
    ExtractError, CoverageError
        As `read_extract`.

    Notes
    -----
    A share is that of probes on a lattice of 16 m that lie on things of a class, so that areas that overlap count once.
    Lines are as wide as they are drawn. Industry is `landuse=industrial`: large buildings are campuses and city blocks
    as often as works. Wood is a part of the class `green`.
    """
    return ground_of(read_extract(path, grid, at=at), path, grid, at=at)


def ground_of(reading: Reading, path: Path, grid: Grid, *, at: dt.date | None = None) -> Ground:
    """Measure the mapped ground of a grid as `measure_ground`, of what was read of an extract before."""
    return share_ground(reading.features, reading.coverage, land=_read_land(path, grid, at=at))


def share_ground(
    features: gpd.GeoDataFrame, coverage: shapely.Geometry, *, land: dict[str, NDArray[np.object_]] | None = None
) -> Ground:
    """Return the shares of mapped ground under features and under `land`, areas by kind, in one projected CRS.

    Examples
    --------
    >>> squares = [shapely.box(0, 0, 320, 320), shapely.box(480, 0, 800, 800)]
    >>> features = gpd.GeoDataFrame({"class": ["building", "farmland"]}, geometry=squares)
    >>> features = features.assign(osm_type="way", is_visible=True, width_m=np.nan)
    >>> ground = share_ground(features, shapely.box(0, 0, 800, 800))
    >>> ground.built, ground.fields, ground.scenes()
    (0.16, 0.4, ['urban', 'agricultural'])
    """
    west, south, east, north = shapely.bounds(coverage)
    easting_m, northing_m = (
        np.arange(low + _PROBE_M / 2, high, _PROBE_M) for low, high in ((west, east), (south, north))
    )
    probes = shapely.points(*(side.ravel() for side in np.meshgrid(easting_m, northing_m)))
    probes = probes[shapely.intersects(probes, coverage)]
    shown = features[features["is_visible"].to_numpy(bool)]
    names, shapes = shown["class"].to_numpy(str), shown.geometry.to_numpy()
    is_line = shapely.get_dimensions(shapes) < 2
    shapes = shapes.copy()
    shapes[is_line] = shapely.buffer(shapes[is_line], shown["width_m"].to_numpy(float)[is_line] / 2, quad_segs=2)

    def share(areas: NDArray[np.object_]) -> float:
        _, hit = overlapping(areas, probes, predicate="intersects")
        return len(np.unique(hit)) / max(len(probes), 1)

    more = {kind: (land or {}).get(kind, shapes[:0]) for kind in _TAGS}
    return Ground(
        built=share(shapes[names == "building"]),
        fields=share(shapes[names == "farmland"]),
        water=share(shapes[names == "water"]),
        industry=share(more["industry"]),
        wood=share(more["wood"]),
        bare=share(np.concatenate([shapes[names == "bare"], more["bare"]])),
        drawn=share(shapes),
        is_coast=bool((features["osm_type"] == SEA).any()),
    )


def _read_land(path: Path, grid: Grid, *, at: dt.date | None) -> dict[str, NDArray[np.object_]]:
    """Return the areas of `_TAGS` that reach into a grid, in its CRS."""
    wanted = osmium.filter.TagFilter(*(tag for tags in _TAGS.values() for tag in tags))
    box = lonlat_box(grid)
    found: dict[str, list[bytes]] = {kind: [] for kind in _TAGS}
    with open_snapshot(path, at=at) as snapshot:
        areas = osmium.FileProcessor(str(snapshot.path)).with_areas(wanted)
        for area in elements(areas.with_filter(osmium.filter.EntityFilter(osmium.osm.AREA)).with_filter(wanted)):
            wkb = area_wkb(area)
            if wkb is None or not reaches(wkb, box):
                continue
            for kind, tags in _TAGS.items():
                if any(area.tags.get(key) == value for key, value in tags):
                    found[kind].append(wkb)
    return {
        kind: shapely.make_valid(project(shapely.from_wkb(np.array(wkbs, dtype=object)), grid.epsg))
        for kind, wkbs in found.items()
    }
