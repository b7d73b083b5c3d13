# SPDX-License-Identifier: Apache-2.0
"""Build a region directory from a region file: the order of the steps, and when a build is unnecessary."""

import datetime as dt
import hashlib
import json
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import partial
from importlib import metadata
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Final

import geopandas as gpd
import shapely

from sasgeo_bench.errors import SasgeoError, StoreError
from sasgeo_bench.files.folders import file_record, fresh_folder, locked, sha256_of
from sasgeo_bench.geometry.grid import Grid
from sasgeo_bench.osm.features import fingerprint
from sasgeo_bench.osm.locate import Extract, find_extract
from sasgeo_bench.osm.mapped import lonlat_box
from sasgeo_bench.osm.read import Reading, read_extract
from sasgeo_bench.osm.snapshot import is_history
from sasgeo_bench.osm.synthetic.town import TownPlan, write_town
from sasgeo_bench.osm.taxonomy import Taxonomy, load_taxonomy
from sasgeo_bench.progress import Tell
from sasgeo_bench.regions import region_files
from sasgeo_bench.regions.graph import build_graph
from sasgeo_bench.regions.layers import PaintWindow, burn_layers, make_paint, read_overview, write_layers
from sasgeo_bench.regions.region import (
    ATTRIBUTION,
    DATA_VERSION,
    LICENCE,
    SCHEMA_VERSION,
    CoverageRecord,
    ExtractRecord,
    Manifest,
    MapGraph,
    Region,
)
from sasgeo_bench.regions.region_spec import RegionFile

PREVIEW_CELLS: Final = 2048


@dataclass(frozen=True, slots=True, kw_only=True)
class BuildPlan:
    """Inputs and outputs of a build. `source` is None for an embedded town, which is made during the build."""

    spec: RegionFile
    extract: Extract
    source: Path | None
    grid: Grid
    folder: Path
    inputs_sha256: str
    is_current: bool

    def to_text(self) -> str:
        """Describe inputs, grid, outputs and their size before compression, in several lines."""
        classes = len(load_taxonomy().names)
        grid = self.grid
        west, south, east, north = lonlat_box(grid)
        cells = grid.rows * grid.cols
        area_km2 = cells * grid.cell_size_m**2 / 1e6
        reads = f"{self.source} ({self.source.stat().st_size / 1e6:.1f} MB)" if self.source else "an embedded town"
        return "\n".join(
            (
                f"{self.spec.id}: {self.spec.title}",
                f"  reads   {reads}, as of {self.extract.date}",
                f"  bounds  {west:.5f}, {south:.5f}, {east:.5f}, {north:.5f} (west, south, east, north)",
                f"  grid    {grid.rows} x {grid.cols} cells of {grid.cell_size_m:g} m, EPSG:{grid.epsg}",
                f"  area    {area_km2:.2f} km2",
                f"  layers  {classes} classes, {classes * cells / 1e6:.0f} MB before compression",
                f"  writes  {self.folder}" + (" (up to date, nothing to do)" if self.is_current else ""),
            )
        )


def plan_build(
    spec: RegionFile, *, out: Path, date: dt.date | None = None, extract_folders: Sequence[Path] = ()
) -> BuildPlan:
    """Find the inputs of a build, and whether its result is up to date; write nothing.

    The region goes to `out/regions/<id>`, that of an older date to `out/regions/<id>@<date>`; without `date` the newest
    extract is taken. `extract_folders` are searched before SASGEO_EXTRACTS and the user's cache. Raise `ConfigError` if
    the region has no extract of that date, `ExtractError` if the extract is not found.
    """
    extract = spec.pick(date)
    source = None if extract.town else find_extract(extract, folders=extract_folders)
    is_newest = extract == spec.pick(None)
    folder = out / "regions" / (spec.id if is_newest else f"{spec.id}@{extract.date.isoformat()}")
    inputs = _inputs_sha256(spec, extract, sha256_of(source) if source else "")
    return BuildPlan(
        spec=spec,
        extract=extract,
        source=source,
        grid=spec.grid(),
        folder=folder,
        inputs_sha256=inputs,
        is_current=_is_current(folder, inputs),
    )


def _inputs_sha256(spec: RegionFile, extract: Extract, source_sha256: str) -> str:
    """Hash all inputs of a region: its file, the extract's bytes, the taxonomy, and our versions."""
    inputs = {
        "region": spec.model_dump(mode="json", exclude={"extract"}),
        "extract": extract.model_dump(mode="json", exclude={"urls", "sha256"}),
        "source": source_sha256,
        "taxonomy": load_taxonomy().model_dump(mode="json"),
        "versions": [SCHEMA_VERSION, DATA_VERSION, package_version()],
    }
    return hashlib.sha256(json.dumps(inputs, sort_keys=True).encode()).hexdigest()


def package_version() -> str:
    """Return the version of the installed package."""
    return metadata.version("sasgeo-bench")


def _is_current(folder: Path, inputs_sha256: str) -> bool:
    try:
        manifest = region_files.read_manifest(folder)
    except StoreError:
        return False
    sizes_hold = all(
        (folder / name).is_file() and (folder / name).stat().st_size == record.bytes
        for name, record in manifest.files.items()
    )
    return sizes_hold and manifest.inputs_sha256 == inputs_sha256


def build_region(plan: BuildPlan, *, tell: Tell, with_preview: bool = True) -> Manifest:
    """Build the region of a plan unless it is up to date; `tell` receives a line for each step.

    A failed build leaves an earlier region as it was. Raise `ExtractError` or `CoverageError` if the extract is damaged
    or does not cover the bounds, `StoreError` if the folder cannot be written.
    """
    name = plan.folder.name
    manifest = _write_unless_current(
        plan, tell, lambda scratch: _build_into(scratch, plan, tell, with_preview=with_preview)
    )
    if manifest is None:
        tell(f"{name}: up to date, nothing to do")
        return region_files.read_manifest(plan.folder)
    tell(f"{name}: mapped {manifest.coverage.to_text()}")
    tell(f"{name}: built {plan.folder}")
    return manifest


def _build_into(scratch: Path, plan: BuildPlan, tell: Tell, *, with_preview: bool) -> Manifest:
    taxonomy, name = load_taxonomy(), plan.folder.name
    with _source(plan) as source:
        tell(f"{name}: reading {source.name}")
        reading = read_extract(
            source,
            plan.grid,
            at=plan.extract.date if is_history(source) else None,
            stated_coverage=shapely.Polygon(plan.spec.coverage_lonlat) if plan.spec.coverage_lonlat else None,
        )
        record = file_record(source)
        extract = ExtractRecord(
            file=plan.extract.file,
            sha256=record.sha256,
            bytes=record.bytes,
            date=plan.extract.date,
            osm_timestamp=reading.osm_timestamp,
        )
    tell(
        f"{name}: {len(reading.features)} features into a graph and {len(taxonomy.names)} layers"
        f" of {plan.grid.rows} x {plan.grid.cols} cells"
    )
    return _write_into(scratch, plan, extract, reading, with_preview=with_preview)


def _write_into(
    scratch: Path, plan: BuildPlan, extract: ExtractRecord, reading: Reading, *, with_preview: bool
) -> Manifest:
    """Burn the layers, make the graph, and write all files of a region."""
    taxonomy = load_taxonomy()
    # GDAL packs blocks without holding the interpreter, so the layers are written while the graph is made.
    with ThreadPoolExecutor(max_workers=1) as executor:
        paint = partial(_painter, reading, plan.grid, taxonomy)
        layers = executor.submit(write_layers, scratch / region_files.LAYERS, plan.grid, taxonomy.names, paint)
        graph = build_graph(reading.features, bounds_m=plan.grid.bounds_m)
        region_files.write_tables(scratch, reading.features, graph)
        manifest = make_manifest(plan, extract, reading, graph)
        layers.result()
    if with_preview:
        from sasgeo_bench.regions.preview import write_preview  # noqa: PLC0415 - only a picture needs matplotlib

        overview = read_overview(scratch / region_files.LAYERS, longest_cells=PREVIEW_CELLS)
        write_preview(scratch / region_files.PREVIEW, manifest=manifest, overview=overview)
    files = {path.name: file_record(path) for path in sorted(scratch.iterdir())}
    manifest = manifest.model_copy(update={"files": files})
    region_files.write_manifest(scratch, manifest)
    return manifest


def build_edited(plan: BuildPlan, base: Region, features: gpd.GeoDataFrame, *, suffix: str, note: str) -> Path:
    """Write a region with edited features next to its base, as `<id>+<suffix>`, and return its folder.

    Coverage and provenance stay those of the base; `note` says in the manifest what was edited. Raise `StoreError` if
    the folder cannot be written.
    """
    name = f"{plan.folder.name}+{suffix}"
    inputs = hashlib.sha256(f"{base.manifest.inputs_sha256}/{note}/{fingerprint(features)}".encode()).hexdigest()
    spec = plan.spec.model_copy(update={"id": name, "title": f"{plan.spec.title} ({suffix})"})
    edited = replace(plan, spec=spec, folder=plan.folder.parent / name, inputs_sha256=inputs)
    record = base.manifest
    reading = Reading(
        features=features,
        coverage=base.coverage,
        coverage_source=record.coverage.source,
        osm_timestamp=record.extract.osm_timestamp,
        drops=record.drops,
        hidden=record.hidden,
        notes=record.notes,
        warnings=(*record.warnings, note),
        unknown_m2=record.coverage.unknown_m2,
        cuts=record.coverage.cuts,
    )
    _write_unless_current(
        edited, lambda _: None, lambda scratch: _write_into(scratch, edited, record.extract, reading, with_preview=True)
    )
    return edited.folder


def build_made(spec: RegionFile, reading: Reading, *, out: Path, tell: Tell) -> Path:
    """Write a region of generated features to `out/regions/<id>`, and return its folder.

    `spec` gives place, id and title; the file of its one extract is not read. `reading` replaces what would be read
    from an extract. Raise `StoreError` if the folder cannot be written.
    """
    extract = spec.pick(None)
    content = _content_sha256(reading.features)
    plan = BuildPlan(
        spec=spec,
        extract=extract,
        source=None,
        grid=spec.grid(),
        folder=out / "regions" / spec.id,
        inputs_sha256=_inputs_sha256(spec, extract, f"{content}/{reading.coverage.wkt}"),
        is_current=False,
    )
    record = ExtractRecord(file=extract.file, sha256=content, bytes=0, date=extract.date, osm_timestamp=None)
    _write_unless_current(plan, tell, lambda scratch: _write_into(scratch, plan, record, reading, with_preview=True))
    return plan.folder


def _content_sha256(features: gpd.GeoDataFrame) -> str:
    """Hash every shape and its attributes; a fingerprint has only centroids."""
    shapes = b"".join(shapely.to_wkb(features.geometry.to_numpy()))
    return hashlib.sha256(fingerprint(features).encode() + shapes).hexdigest()


def _write_unless_current(plan: BuildPlan, tell: Tell, write: Callable[[Path], Manifest]) -> Manifest | None:
    """Let `write` fill the folder of a region; return None if it is up to date, perhaps by a build we waited for."""
    try:
        with locked(plan.folder, tell=tell):
            if _is_current(plan.folder, plan.inputs_sha256):
                return None
            with fresh_folder(plan.folder) as scratch:
                return write(scratch)
    except SasgeoError:
        raise
    except OSError as error:
        message = f"{plan.folder} cannot be written ({error.strerror or error}): check the free space and your rights"
        raise StoreError(message) from error


@contextmanager
def _source(plan: BuildPlan) -> Iterator[Path]:
    """Yield the extract; an embedded town is first written to a temporary folder."""
    if plan.source is not None:
        yield plan.source
        return
    town = plan.extract.town
    if town is None or plan.spec.center_lonlat is None:
        message = f"{plan.spec.id}: an embedded town needs center_lonlat in its region file"
        raise StoreError(message)
    with TemporaryDirectory(prefix="sasgeo-town-") as folder:
        path = Path(folder) / plan.extract.file
        longitude_deg, latitude_deg = plan.spec.center_lonlat
        shape = TownPlan(
            morphology=town.morphology, seed=town.seed, size_m=town.size_m, center_lonlat=(longitude_deg, latitude_deg)
        )
        write_town(shape, path, on=plan.extract.date)
        yield path


def _painter(reading: Reading, grid: Grid, taxonomy: Taxonomy, factor: int) -> PaintWindow:
    """Return what burns a window of one overview, or of the map itself (factor 1).

    Overviews draw lines at least one of their cells wide.
    """
    least_width_m = 0.0 if factor == 1 else grid.cell_size_m * factor
    return partial(
        burn_layers, make_paint(reading.features, taxonomy.names, reading.coverage, least_width_m=least_width_m)
    )


def make_manifest(plan: BuildPlan, extract: ExtractRecord, reading: Reading, graph: MapGraph) -> Manifest:
    """Make the content of `region.json`, without the hashes of the files."""
    taxonomy, grid, spec = load_taxonomy(), plan.grid, plan.spec
    west, south, east, north = grid.bounds_m
    counts = reading.features["class"].value_counts()
    kinds = graph.nodes["kind"].value_counts()
    return Manifest(
        schema_version=SCHEMA_VERSION,
        data_version=DATA_VERSION,
        package_version=package_version(),
        id=spec.id,
        title=spec.title,
        scenes=tuple(spec.scenes),
        epsg=grid.epsg,
        bounds_m=grid.bounds_m,
        bounds_lonlat=lonlat_box(grid),
        cell_size_m=grid.cell_size_m,
        rows=grid.rows,
        cols=grid.cols,
        classes=taxonomy.names,
        extract=extract,
        coverage=CoverageRecord(
            source=reading.coverage_source,
            share=min(1.0, reading.coverage.area / ((east - west) * (north - south))),
            wkt=shapely.to_wkt(reading.coverage, rounding_precision=2),
            unknown_m2={reason: round(area_m2, 1) for reason, area_m2 in reading.unknown_m2.items()},
            cuts=reading.cuts,
        ),
        counts={name: int(counts.get(name, 0)) for name in taxonomy.names},
        graph_counts={str(name): int(count) for name, count in sorted(kinds.items())}
        | {f"edges_{name}": int(count) for name, count in sorted(graph.edges["relation"].value_counts().items())},
        hidden=reading.hidden,
        drops=reading.drops,
        notes=reading.notes,
        warnings=reading.warnings,
        fingerprint=fingerprint(reading.features),
        inputs_sha256=plan.inputs_sha256,
        files={},
        licence=LICENCE,
        attribution=ATTRIBUTION,
    )
