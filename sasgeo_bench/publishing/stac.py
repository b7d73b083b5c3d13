# SPDX-License-Identifier: Apache-2.0
"""`stac/`: the maps of a release as a static STAC catalog, with relative links only."""

import datetime as dt
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import pyproj
import shapely

from sasgeo_bench.geometry.grid import Grid
from sasgeo_bench.publishing.release_files import COPYRIGHT_URL, LICENCE_URL, Release, ReleaseMap
from sasgeo_bench.regions import region_files
from sasgeo_bench.regions.layers import OUTSIDE
from sasgeo_bench.regions.region import ATTRIBUTION, LICENCE

if TYPE_CHECKING:
    import pystac

STAC: Final = "stac"
_COLLECTION: Final = "regions"
_WGS84: Final = 4326
_PARQUET: Final = "application/vnd.apache.parquet"
_DECIMALS: Final = 7  # of a degree: a centimetre
_SIDE_POINTS: Final = 8  # between the corners of a footprint: a straight side of the grid is none in degrees
_MULTIHASH_SHA256: Final = "1220"  # what SHA-256 is and how long, before its digits
# File name -> title, media type, roles.
_ASSETS: Final = {
    region_files.LAYERS: (
        "semantic layers, a band for each class",
        "image/tiff; application=geotiff; profile=cloud-optimized",
        ["data"],
    ),
    region_files.FEATURES: ("classified geometry, GeoParquet 1.1", _PARQUET, ["data"]),
    region_files.NODES: ("nodes of the map graph, GeoParquet 1.1", _PARQUET, ["data"]),
    region_files.EDGES: ("edges of the map graph", _PARQUET, ["data"]),
    region_files.PREVIEW: ("picture of the layers", "image/png", ["overview"]),
    region_files.MANIFEST: ("provenance, counts and hashes", "application/json", ["metadata"]),
}


def write_stac(folder: Path, release: Release) -> None:
    """Write the catalog into `stac/` of a release: one collection, an item for each map."""
    import pystac  # noqa: PLC0415 - an extra: only whoever writes a release needs it

    items = [_item(item, release) for item in release.maps]
    collection = _collection(items, release)
    collection.add_items(items)
    catalog = pystac.Catalog(
        id="sasgeo-bench",
        title="sasgeo-bench",
        description=f"Maps of the dataset release {release.version} of sasgeo-bench. {ATTRIBUTION}",
        extra_fields={"attribution": ATTRIBUTION},
    )
    catalog.add_link(_licence_link())
    catalog.add_child(collection)
    catalog.normalize_hrefs(str(folder / STAC))
    for item in collection.get_items():
        item.make_asset_hrefs_relative()
    catalog.save(catalog_type=pystac.CatalogType.SELF_CONTAINED)


def _collection(items: list["pystac.Item"], release: Release) -> "pystac.Collection":
    import pystac  # noqa: PLC0415 - see write_stac

    collection = pystac.Collection(
        id=_COLLECTION,
        title="Semantic maps of regions",
        description=(
            "Semantic layers, classified geometry and map graphs of geographic regions, each made from one dated "
            f"OpenStreetMap extract. {ATTRIBUTION}"
        ),
        extent=pystac.Extent.from_items(items),
        license=LICENCE,
        keywords=["OpenStreetMap", "map localization", "UAV", "semantic map"],
        providers=_providers(release),
        extra_fields={"attribution": ATTRIBUTION, "version": release.version},
    )
    collection.add_link(_licence_link())
    return collection


def _providers(release: Release) -> list["pystac.Provider"]:
    import pystac  # noqa: PLC0415 - see write_stac

    roles = pystac.ProviderRole
    return [
        pystac.Provider("OpenStreetMap contributors", roles=[roles.LICENSOR, roles.PRODUCER], url=COPYRIGHT_URL),
        pystac.Provider("The sasgeo-bench authors", description=release.made_by, roles=[roles.PROCESSOR]),
    ]


def _licence_link() -> "pystac.Link":
    import pystac  # noqa: PLC0415 - see write_stac

    return pystac.Link(rel="license", target=LICENCE_URL, title="Open Database License 1.0")


def _item(item: ReleaseMap, release: Release) -> "pystac.Item":
    import pystac  # noqa: PLC0415 - see write_stac
    from pystac.extensions.file import FileExtension  # noqa: PLC0415
    from pystac.extensions.projection import ProjectionExtension  # noqa: PLC0415

    about, grid = item.manifest, item.manifest.grid
    outline = footprint(grid)
    found = pystac.Item(
        id=item.name,
        geometry=shapely.geometry.mapping(outline),
        bbox=list(outline.bounds),
        datetime=about.extract.osm_timestamp or dt.datetime.combine(about.extract.date, dt.time(), tzinfo=dt.UTC),
        properties={
            "title": about.title if item.name == about.id else f"{about.title} ({item.name})",
            "license": LICENCE,
            "attribution": about.attribution,
            "gsd": about.cell_size_m,
            "providers": [provider.to_dict() for provider in _providers(release)],
            "sasgeo:scenes": list(about.scenes),
            "sasgeo:extract": about.extract.file,
            "sasgeo:extract_sha256": about.extract.sha256,
            "sasgeo:fingerprint": about.fingerprint,
        },
    )
    projection = ProjectionExtension.ext(found, add_if_missing=True)
    projection.apply(
        code=f"EPSG:{grid.epsg}",
        bbox=list(about.bounds_m),
        shape=[grid.rows, grid.cols],
        transform=list(grid.transform),
    )
    FileExtension.add_to(found)
    found.add_link(_licence_link())
    for name, (title, media_type, roles) in _ASSETS.items():
        path = f"regions/{item.name}/{name}"
        if path in release.files:
            record = release.files[path]
            extra = {
                "file:size": record.bytes,
                "file:checksum": _MULTIHASH_SHA256 + record.sha256,
                **_bands(name, item),
            }
            # Beside the catalog: stac/regions/<map>/<map>.json.
            asset = pystac.Asset(f"../../../{path}", title, media_type=media_type, roles=roles, extra_fields=extra)
            found.add_asset(name.split(".")[0], asset)
    return found


def _bands(name: str, item: ReleaseMap) -> dict[str, Any]:
    """Return the bands of a raster; nothing for another file."""
    if name != region_files.LAYERS:
        return {}
    return {"data_type": "uint8", "nodata": OUTSIDE, "bands": [{"name": band} for band in item.manifest.classes]}


def footprint(grid: Grid) -> shapely.Polygon:
    """Return the outline of a region in WGS84, longitude first."""
    west, south, east, north = grid.bounds_m
    longest_m = max(east - west, north - south)
    outline = shapely.segmentize(shapely.box(west, south, east, north), longest_m / _SIDE_POINTS)
    to_lonlat = pyproj.Transformer.from_crs(grid.epsg, _WGS84, always_xy=True)
    corners = zip(*to_lonlat.transform(*shapely.get_coordinates(outline).T), strict=True)
    return shapely.Polygon([(round(lon, _DECIMALS), round(lat, _DECIMALS)) for lon, lat in corners])
