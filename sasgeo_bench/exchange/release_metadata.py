# SPDX-License-Identifier: Apache-2.0
"""Metadata of a release: `croissant.json` with the meaning of every column, and STAC in `stac/` for maps."""

import datetime as dt
import json
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import pyarrow as pa
import shapely

from sasgeo_bench.core.errors import counted
from sasgeo_bench.core.parquet import read_schema
from sasgeo_bench.core.texts import json_text, markdown, markdown_code
from sasgeo_bench.exchange.release_files import (
    COPYRIGHT_URL,
    LICENCE_URL,
    TRUTHS,
    Release,
    ReleaseMap,
    ReleaseTask,
    places_of,
)
from sasgeo_bench.geometry.grid import Grid
from sasgeo_bench.geometry.projection import to_lonlat
from sasgeo_bench.regions import region_files
from sasgeo_bench.regions.imagery import ORTHO
from sasgeo_bench.regions.layers import OUTSIDE
from sasgeo_bench.regions.region import LICENCE, MADE_UP
from sasgeo_bench.tasks.task_files import FILE_SCHEMA, PLAIN_TRUTH_SCHEMA

if TYPE_CHECKING:
    import mlcroissant as mlc
    import pystac

QUERY_TEXTS: Final = {
    "query_id": "name of the query; a hash that says nothing about the answer",
    "track": "retrieval (rank the candidates) or localization (find the pose)",
    "suite": "what is done to the view, and against which control",
    "suite_version": "version of the suite",
    "part": "train, calibration or test; crossfit where every place is test once, in the fold that leaves it out",
    "region": "the map to search: a folder of regions/; no other map may be used to answer",
    "cell_size_m": "side of a cell of the view on the ground, metres, at scale 1",
    "rows": "cells of the view from top to bottom",
    "cols": "cells of the view from left to right",
    "classes": "names of the classes, in the order of the evidence",
    "evidence": "two bits a cell, four cells to a byte, the first in the lowest bits: 0 absent, 1 present, 2 unknown; "
    "class by class, row by row, top row first; the top of the view is the heading",
    "confidence": "one byte a cell, 0 to 255, in the order of the evidence; null where it is unknown",
    "observed_on": "day of the view",
    "season": "leaf_on, snow, low_water, harvest, or empty where it is unknown",
    "prior_group": "how much is known before, by name; results of two groups are never ranked together",
    "prior_easting_m": "middle of the disc that holds the place, metres in the CRS of the map; null where unknown",
    "prior_northing_m": "middle of the disc that holds the place, metres in the CRS of the map; null where unknown",
    "prior_radius_m": "radius of the disc, metres; null where nothing is known of the place",
    "prior_yaw_deg": "noisy heading, degrees clockwise from grid north; null where unknown",
    "prior_yaw_sigma_deg": "standard deviation of that heading, degrees; null where unknown",
    "prior_scale_sigma": "standard deviation of the view's scale around 1",
    "candidates": "retrieval: the poses to rank; empty for localization and flights",
    "vectors": "perceived lines and outlines: class, level, is_bridge, and WKB in metres right and up from the middle "
    "of the view; null in most suites",
    "sequence_id": "flight of the view; null for a view alone",
    "frame": "number of the view within its flight, from 0; null for a view alone",
    "increment": "what the odometer says since the view before: right and up in its axes, metres, and the turn, "
    "degrees clockwise; null at the first view, where the odometer is lost, and for a view alone",
    "increment_covariance": "what the odometer believes of it: 3 x 3 row by row, m2, m deg and deg2; null without one",
    "frames": "pictures with the cameras that are believed; null where perception is modelled",
    "asked_sha256": "hash of the row and its map: an answer says which query it answers by it",
}
TRUTH_TEXTS: Final = {
    "query_id": "of the query",
    "is_present": "false where the place is not in the disc, not among the candidates, or not on the map",
    "easting_m": "where the view was taken, metres in the CRS of the map; null where it was not taken on this map",
    "northing_m": "where the view was taken, metres in the CRS of the map; null where it was not taken on this map",
    "yaw_deg": "heading of the view, degrees clockwise from grid north",
    "scale": "scale of the view: metres on the ground by cell_size_m",
    "candidate": "number of the right candidate, from 0; -1 for localization, or where it is absent",
    "pair_id": "shared by all queries of one site: a control and its stresses",
    "role": "control, stress or falsifier",
    "kind": "part of the suite",
    "strength": "step of the suite's ladder, in strength_unit; 0 for controls",
    "strength_unit": "unit of the strength",
    "unknown_share": "share of unknown cells",
    "changed_share": "of what view or map show, the share that only one of them does; in real-age mostly mapping",
    "feature_density": "share of the place's map with a road, building or other drawn thing",
    "alias_index": "likeness of the likest other place, 0 to 1; null where the view was not taken at the site",
    "block": "evaluation block, region/row-column; resample by it, never by single queries",
    "scene": "tags of the region",
    "measured": "what was measured to have been done, name and value",
    "detector": "family of the errors of perception: published, measured, silent, or profile",
}
FEATURE_TEXTS: Final = {
    "osm_type": "node, way or relation; coastline for sea, which is no object but lies right of the coastlines",
    "osm_id": "id of the object in OpenStreetMap",
    "version": "version of the object",
    "timestamp": "when that version was made",
    "class": "semantic class",
    "level": "layer above or below ground",
    "is_bridge": "whether it is a bridge",
    "is_tunnel": "whether it is a tunnel",
    "geometry": "WKB, metres in the CRS of the map",
}


AUTHORS: Final = "The sasgeo-bench authors"
CROISSANT: Final = "croissant.json"
ZENODO: Final = "zenodo.json"
_KEYWORDS: Final = ["map localization", "UAV", "OpenStreetMap", "geolocalization"]
PARQUET: Final = "application/x-parquet"
_MEDIA_TYPES: Final = {
    ".parquet": PARQUET,
    ".tif": "image/tiff",
    ".json": "application/json",
    ".png": "image/png",
}
_MAP_TABLES: Final = {
    "map-features": (region_files.FEATURES, "Classified geometry of the maps", FEATURE_TEXTS),
    "map-nodes": (region_files.NODES, "Nodes of the map graphs", {}),
    "map-edges": (region_files.EDGES, "Edges of the map graphs", {}),
}
_SCHEMA_ORG: Final = "https://schema.org/"
_ML_COMMONS: Final = "http://mlcommons.org/croissant/"
_CONFORMS_TO: Final = f"{_ML_COMMONS}1.1"
# What the context of 1.1 has besides that of 1.0, which mlcroissant writes by itself.
_NEW_TERMS: Final = {
    "arrayShape": "cr:arrayShape",
    "containedIn": "cr:containedIn",
    "description": {"@container": "@language"},
    "isArray": "cr:isArray",
    "name": {"@container": "@language"},
}
# Croissant has no type for bytes: mlcroissant hands those of a "Text" over as they are.
_TYPES: Final = (
    (pa.types.is_boolean, f"{_SCHEMA_ORG}Boolean"),
    (pa.types.is_int16, f"{_ML_COMMONS}Int16"),
    (pa.types.is_int32, f"{_ML_COMMONS}Int32"),
    (pa.types.is_int64, f"{_ML_COMMONS}Int64"),
    (pa.types.is_float32, f"{_ML_COMMONS}Float32"),
    (pa.types.is_float64, f"{_ML_COMMONS}Float64"),
    (pa.types.is_date, f"{_SCHEMA_ORG}Date"),
    (pa.types.is_timestamp, f"{_SCHEMA_ORG}DateTime"),
)


def write_croissant(folder: Path, release: Release) -> None:
    """Write the metadata of a release whose data is written, sizes and hashes of its files included."""
    import mlcroissant as mlc  # noqa: PLC0415 - an extra, for releases only

    versions = type(mlc.Context().conforms_to)  # the package shows it nowhere else
    tables = [*_query_tables(release), *_map_tables(folder, release)]
    metadata = mlc.Metadata(
        ctx=mlc.Context(conforms_to=versions(_CONFORMS_TO), rdf=mlc.Rdf(context={**mlc.Rdf().context, **_NEW_TERMS})),
        name="sasgeo-bench",
        description=_description(release),
        license=[LICENCE_URL],
        url=release.url,
        version=release.version,
        date_published=dt.datetime.fromisoformat(release.published),
        keywords=_KEYWORDS,
        creators=[mlc.Organization(name=AUTHORS)],
        cite_as=cite_as(release),
        data_biases=["OpenStreetMap is denser in some countries than in others."],
        personal_sensitive_information=["None: names and ids of the accounts that edited the map are not kept."],
        distribution=[*_file_objects(release), *map(_file_set, tables)],
        record_sets=[_record_set(table) for table in tables],
    )
    (folder / CROISSANT).write_text(json_text(metadata.to_json()), encoding="utf-8")


def write_zenodo(folder: Path, release: Release) -> None:
    """Write the metadata of a deposit at Zenodo, which gives a release its DOI."""
    content = {
        "title": f"sasgeo-bench, dataset release {release.version}",
        "upload_type": "dataset",
        "description": _description(release),
        "creators": [{"name": AUTHORS}],
        "license": LICENCE,
        "version": release.version,
        "publication_date": release.published,
        "access_right": "open",
        "language": "eng",
        "keywords": _KEYWORDS,
        "notes": release.credit,
    }
    related = [{"identifier": release.url, "relation": "isIdenticalTo"}] if release.url else []
    text = json_text(content | ({"related_identifiers": related} if related else {}))
    (folder / ZENODO).write_text(text, encoding="utf-8")


def _description(release: Release) -> str:
    return (
        f"Semantic maps of {len(release.regions)} regions and {release.queries} queries for map localization of "
        f"UAVs without GNSS, made from dated OpenStreetMap extracts. {release.credit}"
    )


def cite_as(release: Release) -> str:
    """Return the citation of a release as BibTeX."""
    year = release.published[:4]
    return (
        f"@misc{{sasgeo_bench_{year}, title = {{sasgeo-bench, dataset release {release.version}}}, "
        f"author = {{{{{AUTHORS}}}}}, year = {{{year}}}, "
        f"note = {{Data {release.credit}}}}}"
    )


@dataclass(frozen=True, kw_only=True)
class _Table:
    """Files of one kind: a file set and a record set. `texts` say what the columns mean."""

    name: str
    pattern: str
    description: str
    schema: pa.Schema
    texts: Mapping[str, str]

    @property
    def files(self) -> str:
        """Id of the file set."""
        return f"{self.name}-files"


def _query_tables(release: Release) -> Iterator[_Table]:
    for suite in release.suites:
        title = release.tasks_of(suite)[0].source.manifest.title
        yield _Table(
            name=suite,
            pattern=f"tasks/{suite}/*/*.parquet",
            description=f"Queries: {title}",
            schema=FILE_SCHEMA,
            texts=QUERY_TEXTS,
        )
        if release.tables_of(suite, kind="truth"):
            yield _Table(
                name=f"{suite}-{TRUTHS}",
                pattern=f"truth/{suite}/*/*.parquet",
                description=f"Truths: {title}",
                schema=PLAIN_TRUTH_SCHEMA,
                texts=TRUTH_TEXTS,
            )


def _map_tables(folder: Path, release: Release) -> Iterator[_Table]:
    first = folder / "regions" / release.maps[0].name
    for name, (file, title, texts) in _MAP_TABLES.items():
        schema = read_schema(first / file, mend="build the region again")
        yield _Table(name=name, pattern=f"regions/*/{file}", description=title, schema=schema, texts=texts)


def _file_objects(release: Release) -> list["mlc.FileObject"]:
    import mlcroissant as mlc  # noqa: PLC0415 - see write_croissant

    return [
        mlc.FileObject(
            id=path,
            name=path,
            content_url=path,
            content_size=f"{record.bytes} B",
            encoding_formats=[_MEDIA_TYPES.get(Path(path).suffix, "text/plain")],
            sha256=record.sha256,
        )
        for path, record in release.files.items()
    ]


def _file_set(table: _Table) -> "mlc.FileSet":
    import mlcroissant as mlc  # noqa: PLC0415 - see write_croissant

    return mlc.FileSet(id=table.files, name=table.files, includes=[table.pattern], encoding_formats=[PARQUET])


def _record_set(table: _Table) -> "mlc.RecordSet":
    import mlcroissant as mlc  # noqa: PLC0415 - see write_croissant

    fields = [_field(table, item) for item in table.schema if not pa.types.is_struct(item.type)]
    if table.pattern.startswith("regions/"):
        fields.insert(0, _map_field(table))
    return mlc.RecordSet(id=table.name, name=table.name, description=table.description, fields=fields)


def _map_field(table: _Table) -> "mlc.Field":
    """Return the column with the map of a row, which only the path of its file states."""
    import mlcroissant as mlc  # noqa: PLC0415 - see write_croissant

    return mlc.Field(
        id=f"{table.name}/region",
        name="region",
        description="the map, a folder of regions/",
        data_types=[_type(pa.string())],
        source=mlc.Source(
            file_set=table.files,
            extract=mlc.Extract(file_property="fullpath"),
            transforms=[mlc.Transform(regex="regions/([^/]+)/.*")],
        ),
    )


def _field(table: _Table, column: pa.Field) -> "mlc.Field":
    import mlcroissant as mlc  # noqa: PLC0415 - see write_croissant

    is_list = pa.types.is_list(column.type)
    inner = column.type.value_type if is_list else column.type
    name = f"{table.name}/{column.name}"
    common = {"id": name, "name": column.name, "description": table.texts.get(column.name)}
    if not pa.types.is_struct(inner):
        is_array = True if is_list else None
        return mlc.Field(**common, data_types=[_type(inner)], is_array=is_array, source=_source(table, column.name))
    parts = [
        mlc.Field(
            id=f"{name}/{part.name}",
            name=part.name,
            data_types=[_type(part.type)],
            source=_source(table, column.name, within=part.name),
        )
        for part in inner
    ]
    return mlc.Field(**common, is_array=True, sub_fields=parts)


def _source(table: _Table, column: str, *, within: str | None = None) -> "mlc.Source":
    import mlcroissant as mlc  # noqa: PLC0415 - see write_croissant

    transforms = [] if within is None else [mlc.Transform(json_path=within)]
    return mlc.Source(file_set=table.files, extract=mlc.Extract(column=column), transforms=transforms)


def _type(kind: pa.DataType) -> str:
    """Return Croissant's type of a column."""
    return next((name for is_it, name in _TYPES if is_it(kind)), f"{_SCHEMA_ORG}Text")


STAC: Final = "stac"
_COLLECTION: Final = "regions"
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
    ORTHO: ("aerial imagery", "image/tiff; application=geotiff; profile=cloud-optimized", ["visual"]),
    region_files.FEATURES: ("classified geometry, GeoParquet 1.1", _PARQUET, ["data"]),
    region_files.NODES: ("nodes of the map graph, GeoParquet 1.1", _PARQUET, ["data"]),
    region_files.EDGES: ("edges of the map graph", _PARQUET, ["data"]),
    region_files.PREVIEW: ("picture of the layers", "image/png", ["overview"]),
    region_files.MANIFEST: ("provenance, counts and hashes", "application/json", ["metadata"]),
}


def write_stac(folder: Path, release: Release) -> None:
    """Write the catalog into `stac/` of a release: one collection, an item for each map."""
    import pystac  # noqa: PLC0415 - an extra, for releases only

    items = [_item(item, release) for item in release.maps]
    collection = _collection(items, release)
    collection.add_items(items)
    catalog = pystac.Catalog(
        id="sasgeo-bench",
        title="sasgeo-bench",
        description=f"Maps of the dataset release {release.version} of sasgeo-bench. {release.credit}",
        extra_fields={"attribution": release.credit},
    )
    catalog.add_link(_licence_link())
    catalog.add_child(collection)
    catalog.normalize_hrefs(f"/{STAC}")  # no real path: in one, # and ? would be parts of an address
    for item in collection.get_items():
        item.make_asset_hrefs_relative()
    catalog.catalog_type = pystac.CatalogType.SELF_CONTAINED
    for each in (catalog, collection, *items):
        path = folder / str(each.get_self_href()).removeprefix("/")
        path.parent.mkdir(parents=True, exist_ok=True)
        content = json.dumps(each.to_dict(include_self_link=False), indent=2)
        path.write_text(content, encoding="utf-8")


def _collection(items: list["pystac.Item"], release: Release) -> "pystac.Collection":
    import pystac  # noqa: PLC0415 - see write_stac

    collection = pystac.Collection(
        id=_COLLECTION,
        title="Semantic maps of regions",
        description=(
            "Semantic layers, classified geometry and map graphs of geographic regions, each made from one dated "
            f"OpenStreetMap extract. {release.credit}"
        ),
        extent=pystac.Extent.from_items(items),
        license=LICENCE,
        keywords=["OpenStreetMap", "map localization", "UAV", "semantic map"],
        providers=_providers(release),
        extra_fields={"attribution": release.credit, "version": release.version},
    )
    collection.add_link(_licence_link())
    return collection


def _providers(release: Release) -> list["pystac.Provider"]:
    import pystac  # noqa: PLC0415 - see write_stac

    roles = pystac.ProviderRole
    return [
        pystac.Provider("OpenStreetMap contributors", roles=[roles.LICENSOR, roles.PRODUCER], url=COPYRIGHT_URL),
        pystac.Provider(AUTHORS, description=release.made_by, roles=[roles.PROCESSOR]),
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
            **{f"sasgeo:{name}": value for name, value in about.provenance.model_dump().items()},
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
    """Return the bands of a raster, of imagery its own resolution and licence; nothing for another file."""
    imagery = item.manifest.imagery
    if name == ORTHO and imagery is not None:
        bands = [{"name": band} for band in ("red", "green", "blue")]
        licences = "; ".join(dict.fromkeys(picture.licence for picture in imagery.pictures))
        return {
            "data_type": "uint8",
            "bands": bands,
            "gsd": imagery.gsd_m,
            "license": licences,
            "attribution": imagery.attribution,
        }
    if name != region_files.LAYERS:
        return {}
    return {"data_type": "uint8", "nodata": OUTSIDE, "bands": [{"name": band} for band in item.manifest.classes]}


def footprint(grid: Grid) -> shapely.Polygon:
    """Return the outline of a region in WGS84, longitude first."""
    west, south, east, north = grid.bounds_m
    longest_m = max(east - west, north - south)
    outline = shapely.segmentize(shapely.box(west, south, east, north), longest_m / _SIDE_POINTS)
    corners = zip(*to_lonlat(grid.epsg).transform(*shapely.get_coordinates(outline).T), strict=True)
    return shapely.Polygon([(round(lon, _DECIMALS), round(lat, _DECIMALS)) for lon, lat in corners])


CARD: Final = "README.md"
_FIRST_SUITE: Final = "clean"  # what is loaded where no configuration is named
# The size classes of the Hub.
_SIZES: Final = ((1_000, "n<1K"), (10_000, "1K<n<10K"), (100_000, "10K<n<100K"), (1_000_000, "100K<n<1M"))


def card_text(release: Release) -> str:
    """Return the card: Markdown after a YAML head."""
    sections = (_opening, _suites, _regions, _loading, _meaning, _ending)
    head = f"---\n{_head(release)}\n---"
    return "\n\n".join((head, *(section(release) for section in sections))) + "\n"


def _head(release: Release) -> str:
    """Return YAML for the Hub and for `datasets.load_dataset(folder, configuration)`."""
    from huggingface_hub import DatasetCardData  # noqa: PLC0415 - as above

    first = _FIRST_SUITE if _FIRST_SUITE in release.suites else release.suites[0]
    configs: list[dict[str, Any]] = []
    for suite in release.suites:
        for kind, name in (("queries", suite), ("truth", f"{suite}-{TRUTHS}")):
            tables = release.tables_of(suite, kind=kind)
            if tables:
                files = [{"split": part, "path": list(paths)} for part, paths in tables.items()]
                configs.append(
                    {"config_name": name, **({"default": True} if name == first else {}), "data_files": files}
                )
    data = DatasetCardData(
        license="odbl",
        pretty_name="sasgeo-bench",
        size_categories=[next((name for most, name in _SIZES if release.queries < most), "n>1M")],
        tags=["geospatial", "OpenStreetMap", "UAV", "map-localization"],
        attribution=release.credit,
        configs=configs,
    )
    return data.to_yaml()


def _opening(release: Release) -> str:
    regions, maps = counted(len(release.regions), "region"), counted(len(release.maps), "map")
    files = (
        "`layers.tif` (cloud-optimized GeoTIFF, a band for each class), `features.parquet` and `nodes.parquet` "
        "(GeoParquet 1.1), `edges.parquet`, `region.json`"
    )
    return f"""\
# sasgeo-bench, dataset release {release.version}

Semantic maps of {regions} and {counted(release.queries, "query", "queries")} for map localization of UAVs without
GNSS: each query is a view of a place by a detector that makes errors, and asks where on a map it was taken.
Everything is made from dated OpenStreetMap extracts by {release.made_by}; published {release.published}.

**{release.credit}.** The data is under the Open Database License 1.0 ([notice](LICENSE-ODbL.txt),
[text]({LICENCE_URL}), [source]({COPYRIGHT_URL})).

| In this release | What |
|---|---|
| `regions/<map>/` | {maps}: {files} |
| `tasks/<suite>/<map>/` | queries: what a matcher may see |
| `truth/<suite>/<map>/` | answers: {_truth_line(release)} |
| `stac/catalog.json` | the maps as a static STAC catalog |
| `croissant.json` | Croissant 1.1 metadata |
| `datasheet.md` | how the data came to be, what it is for, and what not |
| `imagery/` | {_imagery_line(release)} |
| `SHA256SUMS` | `sha256sum -c SHA256SUMS` checks every file |"""


def _imagery_line(release: Release) -> str:
    """Say where imagery is, which is under other licences."""
    shown = {item.name: item.manifest.imagery for item in release.maps if item.manifest.imagery is not None}
    if not shown:
        return "imagery, apart from what is derived from OpenStreetMap: none in this release"
    text = f"licences and authors of the imagery, `ortho.tif` of {', '.join(shown)}, which is not under the ODbL"
    rendered = [name for name, record in shown.items() if record.is_rendered]
    return f"{text}, but for what is rendered from the map ({', '.join(rendered)})" if rendered else text


def _truth_line(release: Release) -> str:
    if release.board is not None:
        return f"none here; they are {release.truths_text}"
    if release.with_truth:
        return "all are in this release"
    released = sorted({part for task in release.tasks for part in task.released})
    if release.split.kind == "crossfit":
        return "none here; in a cross-fit every place is a test place once, so all of them are kept back"
    return f"those of {' and '.join(released)} are here, those of test are kept back" if released else "kept back"


def _table(head: str, rows: Iterable[str]) -> str:
    """Join the lines of a Markdown table."""
    return "\n".join((head, "|" + "---|" * (head.count("|") - 1), *rows))


def _suites(release: Release) -> str:
    rows = []
    for suite in release.suites:
        tasks = release.tasks_of(suite)
        for part in release.tables_of(suite):
            own = [task for task in tasks if part in task.parts]
            released = f"`{suite}-{TRUTHS}`" if any(part in task.released for task in own) else "kept back"
            count = sum(task.parts[part] for task in own)
            title = markdown(tasks[0].source.manifest.title)
            rows.append(f"| `{suite}` | {title} | `{part}` | {count} | {len(own)} | {released} |")
    return "## Suites\n\n" + _table("| Configuration | What is asked | Split | Queries | Maps | Truths |", rows)


def _regions(release: Release) -> str:
    split = release.split
    places = (
        f"| {place.name} | {place.part or f'half {place.half}'} | {', '.join((*place.regions, *place.blocks))} |"
        for place in places_of(release)
    )
    crossfit = (
        "Each place is tested once. Training for a place comes from the other half; the rest of its own half "
        "calibrates."
    )
    buffer = (
        f"Split `{split.id}` ({markdown(split.title)}): places that are used for different purposes keep at least "
        f"{split.buffer_m:g} m apart."
    )
    parts = (
        "## Maps and places",
        buffer,
        _table("| Place | Part or half | Regions |", places),
        *((crossfit,) if split.kind == "crossfit" else ()),
        _table("| Map | What | Date | Size | CRS |", map(_map_row, release.maps)),
        "`name@date` is an older map of a place, `name+suite` one that a suite has edited.",
    )
    return "\n\n".join(parts)


def _map_row(item: ReleaseMap) -> str:
    about = item.manifest
    size = f"{about.cols} x {about.rows} cells of {about.cell_size_m:g} m"
    return f"| `{item.name}` | {markdown(about.title)} | {about.extract.date} | {size} | EPSG:{about.epsg} |"


def _loading(release: Release) -> str:
    suite = _FIRST_SUITE if _FIRST_SUITE in release.suites else release.suites[0]
    task: ReleaseTask = release.tasks_of(suite)[0]
    part = next(iter(task.parts))
    table, name = task.file_of(part), task.map_name
    return f"""\
## Load it

In this folder, with public libraries alone. Queries by [datasets](https://huggingface.co/docs/datasets):

```python
from pathlib import Path

from datasets import load_dataset

folder = str(Path.cwd())  # or where the release was put, or its name on the Hub
queries = load_dataset(folder, "{suite}", split="{part}")
print(len(queries), queries[0]["query_id"], queries[0]["region"])
```

By pandas, with what was seen as an array of class, row and column, 0 absent, 1 present, 2 unknown:

```python
import numpy as np
import pandas as pd

queries = pd.read_parquet("{table}")
row = queries.iloc[0]
packed = np.frombuffer(row["evidence"], dtype=np.uint8)
states = (packed[:, None] >> np.array([0, 2, 4, 6], dtype=np.uint8)) & 3
shape = (len(row["classes"]), row["rows"], row["cols"])
cells = states.ravel()[: np.prod(shape)].reshape(shape)
building = cells[list(row["classes"]).index("building")]
print(cells.shape, (building == 1).sum(), "cells with a building")
```

The map that is searched:

```python
import geopandas as gpd
import pandas as pd
import rasterio

with rasterio.open("regions/{name}/layers.tif", driver="GTiff") as source:
    layers = source.read()  # 0 absent, 1 present, 255 outside the mapped area
    print(source.descriptions, source.crs, source.tags()["attribution"])
features = gpd.read_parquet("regions/{name}/features.parquet")
nodes = gpd.read_parquet("regions/{name}/nodes.parquet")
edges = pd.read_parquet("regions/{name}/edges.parquet")
print(len(features), len(nodes), len(edges))
```

With sasgeo-bench itself, `sasgeo-bench run --tasks tasks/{suite}/{name}` runs a matcher on it: the folder is laid out
as the program's own."""


def _columns(texts: Mapping[str, str]) -> str:
    return _table("| Column | What |", (f"| `{name}` | {text} |" for name, text in texts.items()))


def _meaning(release: Release) -> str:
    truths = ""
    if any(task.released for task in release.tasks):
        head = "\n\n## Columns of the truths\n\nA row for each query, to be joined by `query_id`.\n\n"
        truths = head + _columns(TRUTH_TEXTS)
    return f"""\
## Columns of the queries

{_columns(QUERY_TEXTS)}

Easting and northing are metres in the CRS of the map (`epsg` in its `region.json`); a yaw is a heading, clockwise
from grid north. Outside the mapped area nothing is known, which is not the same as absent.

## What counts as an answer

A matcher searches the map that `region` names and no other: another date of the place, or the map that a suite
edited, would give the world away. An answer depends on its own query alone, never on other queries. Results of
different `prior_group` are not ranked together, and are resampled by place and block, not by single
queries.{truths}"""


def _ending(release: Release) -> str:
    return f"""\
## Licence and citation

{release.credit}. Name OpenStreetMap and its contributors where a reader sees it, and offer what is derived from this
data under the ODbL as well ([LICENSE-ODbL.txt](LICENSE-ODbL.txt)). Maps whose name begins with `town-` are made up by
a program; the notice stands on them too.

```bibtex
{cite_as(release)}
```"""


DATASHEET: Final = "datasheet.md"
_M2_PER_KM2: Final = 1e6


def datasheet_text(release: Release) -> str:
    """Return the datasheet in Markdown, its numbers counted from the release itself."""
    opening = f"""\
# Datasheet of sasgeo-bench, dataset release {release.version}

After Gebru et al., *Datasheets for Datasets*, Communications of the ACM 64(12), 2021. {release.credit}."""
    parts = (
        opening,
        _motivation(release),
        _composition(release),
        _card_collection(release),
        _preprocessing(release),
        _uses(),
        _distribution(release),
        _maintenance(release),
    )
    return "\n\n".join(parts) + "\n"


def _motivation(release: Release) -> str:
    return f"""\
## Motivation

**For what purpose was it made?** To measure how well a UAV without GNSS finds its place on a semantic map, where the
map is old, the view is partly hidden or wrong, places look alike, or the place is not on the map at all; and to tell
a right fix from a false one.

**Who made it?** The authors of sasgeo-bench, by {release.made_by}.

**Who paid for it?** No funding is declared. The maps are the work of OpenStreetMap's contributors."""


def _composition(release: Release) -> str:
    area_km2, dates = _area_km2(release), sorted(item.manifest.extract.date for item in release.maps)
    objects = _sum(item.manifest.counts for item in release.maps)
    parts = _sum(task.parts for task in release.tasks)
    made_up = [name for name in release.regions if name.startswith(MADE_UP)]
    towns = f", {len(made_up)} of them made up by a program" if made_up else ""
    queries = ", ".join(f"{part} {count}" for part, count in parts.items())
    kept = "All truths are in the release." if release.with_truth else "Truths of test queries are kept back."
    return f"""\
## Composition

**What are the instances?** Maps and queries. A map is a region with a raster for each semantic class, the classified
geometry, and a graph of junctions, crossings, bridges and buildings. A query is a view of a place: for each class and
cell present, absent or unknown, with what is known of place, heading and scale before.

**How many are there?** {counted(len(release.regions), "region")} ({area_km2:,.1f} km2{towns}) in
{counted(len(release.maps), "map")} of {dates[0]} to {dates[-1]}; {counted(release.queries, "query", "queries")} of
{counted(len(release.suites), "suite")} ({queries}); {counted(len(release.files), "file")} with
{release.bytes / 1e6:,.1f} MB of data.

{_class_table(objects)}

**Is it a sample?** Yes. Regions were chosen for variety and for having dated extracts. Places within them are
drawn at random among those that are mapped and not empty.

**Is there a label?** The pose of the view, and whether the place is on the map. {kept}

**Is anything missing?** {_mapped_line(release)} Outside the mapped area cells are 255, never absent. What is not
visible from above is left out and counted, as is every object that could not be used: {_left_out_line(release)}.

**Are there recommended splits?** Split `{release.split.id}`: {markdown(release.split.title)}.
Whole places are separated by {release.split.buffer_m:g} m at least.

**Are there errors, noise or redundancy?** The errors of the detector are put in on purpose, as many for each class as
published detectors make. The maps have the errors and gaps of OpenStreetMap. All queries of one site show one place:
they are not independent, and figures are to be resampled by place and block.

**Does it rely on other data?** No; every file is in the release. `region.json` of each map names its extract by
SHA-256.

**Does it hold anything confidential, offensive, or about people?** No. Ids, versions and times of map objects are
kept; names and ids of the accounts that edited them are not."""


def _area_km2(release: Release) -> float:
    """Return the ground of all regions, each counted once whatever the number of its maps."""
    areas = {
        item.region: item.manifest.rows * item.manifest.cols * item.manifest.cell_size_m**2 / _M2_PER_KM2
        for item in release.maps
    }
    return sum(areas.values())


def _sum(counts: Iterable[Mapping[str, int]]) -> Counter[str]:
    """Add counts by name, names that count 0 included."""
    found: Counter[str] = Counter()
    for one in counts:
        found.update(one)
    return found


def _class_table(objects: Counter[str]) -> str:
    lines = (f"| {markdown_code(name)} | {count:,} |" for name, count in objects.items())
    return _table("| Class | Objects in all maps |", lines)


def _mapped_line(release: Release) -> str:
    least = min(release.maps, key=lambda item: item.manifest.coverage.share)
    share = least.manifest.coverage.share
    if share == 1:
        return "Every map is mapped whole."
    return f"The least mapped map is `{least.name}`: {share:.1%} of it."


def _left_out_line(release: Release) -> str:
    hidden = sum(sum(item.manifest.hidden.values()) for item in release.maps)
    dropped = sum(sum(item.manifest.drops.values()) for item in release.maps)
    counts = f"{hidden:,} objects in and around the maps are not visible, {dropped:,} were dropped"
    return f"{counts}, with reasons in `region.json`"


def _card_collection(release: Release) -> str:
    files = {item.manifest.extract.file: item.manifest.extract.sha256 for item in release.maps}
    lines = (f"| {markdown_code(name)} | {markdown_code(files[name])} |" for name in sorted(files))
    table = _table("| Extract | SHA-256 |", lines)
    return f"""\
## Collection

**How was the data acquired?** Maps: from dated extracts of OpenStreetMap, drawn by its contributors from surveys,
imagery and open data ([source]({COPYRIGHT_URL})). Queries: computed from the maps; no aircraft was flown.

**Over what time?** The dates of the maps are those of the extracts.

{table}

**Were people involved or asked?** No people are in the data. Contributors of OpenStreetMap have agreed to its
licence."""


def _preprocessing(release: Release) -> str:
    classes = len(release.maps[0].manifest.classes)
    return f"""\
## Preprocessing

**What was done?** Objects are put into {classes} classes by exact tags, projected to the UTM zone of the region,
mended where their geometry is broken, burnt into a raster for each class, and linked into a graph. Views are cut from
the layers at random poses; errors of perception, hidden parts, age or seasons are put in as the suite says, and each
has a control that differs in nothing else.

**Is the raw data kept?** Not in the release. An extract can be found by its name and SHA-256, and
`sasgeo-bench build-region` builds the map from it again.

**Is the software available?** Yes, under the Apache License 2.0: {release.made_by}."""


def _uses() -> str:
    return """\
## Uses

**What is it for?** Comparing methods of map localization and of rejecting false fixes.

**What else could it be used for?** Studies of how maps age, of places that look alike, or of graphs of maps.

**What should it not be used for?** Navigation of any real vehicle. Figures found here say how methods compare on
semantic views that a program made, not how often a real flight would find its place. The maps are not to be used as
maps: they are simplified, and some (`name+suite`) are edited so that places look alike.

**What could make it unfair?** OpenStreetMap is denser in some countries than in others; methods that do well here may
do worse where little is mapped."""


def _distribution(release: Release) -> str:
    has_imagery = any(item.manifest.imagery is not None for item in release.maps)
    more = (
        "Aerial imagery (`ortho.tif`), under the licences that `imagery/README.md` lists."
        if has_imagery
        else "No imagery; the folder `imagery/` is where it would be, apart and with its own\nlicence."
    )
    return f"""\
## Distribution

**How is it distributed?** As a folder of files: cloud-optimized GeoTIFF, GeoParquet 1.1 and Parquet, with a STAC
catalog, Croissant metadata and a card that the `datasets` library reads.

**Under which licence?** Open Database License 1.0, {LICENCE_URL}. {release.credit}. Every file says so in its own
metadata or text.

**Is there anything else in it?** {more}"""


def _maintenance(release: Release) -> str:
    return f"""\
## Maintenance

**Who keeps it?** The authors of sasgeo-bench.

**Will it be updated?** A release does not change. Its version, {release.version}, says how its maps are made (first
number) and how its queries are (second): figures of two versions are never put on one board. Two releases of one
version may hold other regions and queries; `release.json` says which, and `SHA256SUMS` whether two are the same.

**How can others add to it?** A region is one TOML file, a suite one module: sasgeo-bench says how. What is derived
from the data is offered under the ODbL."""
