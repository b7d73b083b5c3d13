# SPDX-License-Identifier: Apache-2.0
"""Build a region directory from a region file: the order of the steps, and when a build is unnecessary."""

import datetime as dt
import hashlib
import json
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ThreadPoolExecutor, wait
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import partial, reduce
from importlib import metadata
from pathlib import Path
from typing import Final

import cv2
import geopandas as gpd
import numpy as np
import scipy  # its parts are loaded where they are used: few regions have imagery
import shapely
from numpy.typing import NDArray

from sasgeo_bench.core.errors import SasgeoError, StoreError, counted
from sasgeo_bench.core.folders import file_record, fresh_folder, locked, scratch_folder, sha256_of
from sasgeo_bench.core.progress import tell
from sasgeo_bench.geometry.grid import Grid
from sasgeo_bench.osm.features import fingerprint
from sasgeo_bench.osm.locate import Extract, find_extract, find_parts
from sasgeo_bench.osm.mapped import lonlat_box
from sasgeo_bench.osm.read import Reading, read_extract, read_geojson, read_vector
from sasgeo_bench.osm.synthetic.town import TownPlan, write_town
from sasgeo_bench.osm.taxonomy import load_taxonomy
from sasgeo_bench.regions import region_files
from sasgeo_bench.regions.graph import build_graph
from sasgeo_bench.regions.imagery import OFFSET_VERSION, ORTHO, Imagery, OffsetRecord, OrthoRecord, find_imagery
from sasgeo_bench.regions.layers import (
    PREVIEW_CELLS,
    PaintWindow,
    burn,
    burn_mapped,
    make_paint,
    overview_factors,
    read_overview,
    shown_factor,
    write_layers,
)
from sasgeo_bench.regions.ortho import Picture, check_picture, ortho_grid, write_ortho
from sasgeo_bench.regions.region import (
    DATA_VERSION,
    SCHEMA_VERSION,
    CoverageRecord,
    ExtractRecord,
    Manifest,
    MapGraph,
    OwnMapRecord,
    Region,
)
from sasgeo_bench.regions.region_spec import OwnMap, RegionFile


@dataclass(frozen=True, slots=True, kw_only=True)
class BuildPlan:
    """Inputs and outputs of a build.

    `source` is None for an embedded town, which is made during the build; `more` are further files of the extract.
    `own_maps` are the files of sources beside it, in the order of the region file.
    `pictures` are the checked pictures that become the imagery; none are looked for if the region is up to date, or
    would be but for its provenance, which `region.json` alone holds, or a preview.
    `with_preview` adds a picture of the layers, which takes longer than all else of a small region.
    """

    spec: RegionFile
    extract: Extract
    source: Path | None
    grid: Grid
    folder: Path
    inputs_sha256: str
    is_current: bool
    more: tuple[Path, ...] = ()
    own_maps: tuple[Path, ...] = ()
    pictures: tuple[Picture, ...] = ()
    with_preview: bool = False

    def to_text(self) -> str:
        """Describe inputs, grid, outputs and their size before compression, in several lines."""
        classes = len(self.spec.class_names)
        grid = self.grid
        west, south, east, north = lonlat_box(grid)
        cells = grid.rows * grid.cols
        area_km2 = cells * grid.cell_size_m**2 / 1e6
        reads = f"{self.source} ({self.source.stat().st_size / 1e6:.1f} MB)" if self.source else "an embedded town"
        shown = ortho_grid(self.pictures, grid) if self.pictures else None
        pictures = [
            f"  reads   {item.path} ({item.path.stat().st_size / 1e6:.1f} MB, {item.gsd_m:.3f} m a pixel)"
            for item in self.pictures
        ]
        imagery = f"  imagery {shown.rows} x {shown.cols} pixels of {shown.cell_size_m:.3f} m" if shown else ""
        return "\n".join(
            (
                f"{self.spec.id}: {self.spec.title}",
                f"  reads   {reads}, as of {self.extract.date}",
                *(f"  reads   {path} ({path.stat().st_size / 1e6:.1f} MB)" for path in (*self.more, *self.own_maps)),
                *pictures,
                f"  bounds  {west:.5f}, {south:.5f}, {east:.5f}, {north:.5f} (west, south, east, north)",
                f"  grid    {grid.rows} x {grid.cols} cells of {grid.cell_size_m:g} m, EPSG:{grid.epsg}",
                f"  area    {area_km2:.2f} km2",
                f"  layers  {counted(classes, 'class', 'classes')}, {classes * cells / 1e6:.0f} MB before compression",
                *([imagery] if imagery else []),
                f"  writes  {self.folder}" + (" (up to date, nothing to do)" if self.is_current else ""),
            )
        )


def plan_build(
    spec: RegionFile,
    *,
    out: Path,
    date: dt.date | None = None,
    extract_folders: Sequence[Path] = (),
    imagery_folders: Sequence[Path] = (),
    with_preview: bool = False,
) -> BuildPlan:
    """Find the inputs of a build, and whether its result is up to date; write nothing.

    The region goes to `out/regions/<id>`, that of an older date to `out/regions/<id>@<date>`; without `date` the newest
    extract is taken. `extract_folders` are searched before SASGEO_EXTRACTS and the user's cache, `imagery_folders`
    before SASGEO_IMAGERY and the folders `imagery` beside those of extracts. A region that lacks a wanted preview is
    not up to date. Raise `ConfigError` if the region has no extract of that date, `ExtractError` if the extract is not
    found, `ImageryError` if a picture is not found or cannot be used.
    """
    extract = spec.pick(date)
    source = None if extract.town else find_extract(extract, folders=extract_folders)
    more = find_parts(extract, folders=extract_folders)
    own_maps = tuple(find_extract(one.beside(extract), folders=extract_folders) for one in spec.own_map)
    is_newest = extract == spec.pick(None)
    folder = out / "regions" / (spec.id if is_newest else f"{spec.id}@{extract.date.isoformat()}")
    inputs = _inputs_sha256(spec, extract, sha256_of(source) if source else "")
    grid, kept = spec.grid(), _kept(folder, inputs)
    return BuildPlan(
        spec=spec,
        extract=extract,
        source=source,
        grid=grid,
        folder=folder,
        inputs_sha256=inputs,
        is_current=kept is not None and _states(kept, spec) and (_is_shown(kept) or not with_preview),
        more=more,
        own_maps=own_maps,
        pictures=tuple(
            check_picture(find_imagery(entry, folders=imagery_folders, extracts=extract_folders), entry, grid)
            for entry in (spec.imagery if kept is None else ())
        ),
        with_preview=with_preview,
    )


def _inputs_sha256(spec: RegionFile, extract: Extract, source_sha256: str) -> str:
    """Hash all inputs of a region: its file, the extract's bytes, the taxonomy, and our versions."""
    further = spec.provenance.further_sources  # the one line of provenance that every file of a region holds
    inputs = {
        **({"further_sources": further} if further else {}),
        "region": spec.model_dump(mode="json", exclude={"extract", "provenance"}),
        "extract": extract.model_dump(mode="json", exclude={"urls", "sha256"}),
        "source": source_sha256,
        "taxonomy": load_taxonomy().of_maps(),
        "versions": [SCHEMA_VERSION, DATA_VERSION, package_version()],
    }
    return hashlib.sha256(json.dumps(inputs, sort_keys=True).encode()).hexdigest()


def package_version() -> str:
    """Return the version of the installed package."""
    return metadata.version("sasgeo-bench")


def _kept(folder: Path, inputs_sha256: str) -> Manifest | None:
    """Return the manifest of a region whose files, but for a preview, a build would write; None if they are others."""
    try:
        manifest = region_files.read_manifest(folder)
    except StoreError:
        return None
    sizes_hold = all(
        (folder / name).is_file() and (folder / name).stat().st_size == record.bytes
        for name, record in manifest.files.items()
    )
    is_of_inputs = manifest.inputs_sha256 == inputs_sha256 and _is_measured(manifest.imagery)
    return manifest if sizes_hold and is_of_inputs else None


def _is_measured(imagery: OrthoRecord | None) -> bool:
    """Return whether the offset of imagery, if it has one, is what this program finds; the map's hash is without it."""
    return imagery is None or imagery.is_rendered or imagery.offset_version == OFFSET_VERSION


def _is_shown(manifest: Manifest) -> bool:
    return region_files.PREVIEW in manifest.files


def _states(manifest: Manifest, spec: RegionFile) -> bool:
    return manifest.provenance.model_dump() == spec.origin.model_dump()


def build_region(plan: BuildPlan) -> Manifest:
    """Build the region of a plan unless it is up to date, with a line for each step.

    A failed build leaves an earlier region as it was. Raise `ExtractError` or `CoverageError` if the extract is damaged
    or does not cover the bounds, `StoreError` if the folder cannot be written.
    """
    name = plan.folder.name
    manifest = _write_unless_current(plan, lambda scratch: _build_into(scratch, plan))
    if manifest is None:
        tell(f"{name}: up to date, nothing to do")
        return region_files.read_manifest(plan.folder)
    tell(f"{name}: mapped {manifest.coverage.to_text()}")
    tell(f"{name}: built {plan.folder}")
    return manifest


def _build_into(scratch: Path, plan: BuildPlan) -> Manifest:
    name = plan.folder.name
    if len(plan.pictures) < len(plan.spec.imagery):
        raise StoreError(f"{plan.folder} was changed after it was found up to date: build it again")
    with _source(plan) as source:
        tell(f"{name}: reading {source.name}")
        reading = _read(plan, source)
        for warning in reading.warnings:
            tell(f"{name}: warning: {warning}")
        record = file_record(source)
        extract = ExtractRecord(
            file=plan.extract.file,
            sha256=record.sha256,
            bytes=record.bytes,
            date=plan.extract.date,
            osm_timestamp=reading.osm_timestamp,
            also={path.name: sha256_of(path) for path in plan.more},
        )
    tell(
        f"{name}: {len(reading.features)} features into a graph and {counted(len(plan.spec.class_names), 'layer')}"
        f" of {plan.grid.rows} x {plan.grid.cols} cells"
    )
    imagery = _write_imagery(scratch, plan, reading) if plan.pictures else None
    return _write_into(scratch, plan, extract, reading, imagery=imagery)


def _read(plan: BuildPlan, source: Path) -> Reading:
    """Read the extract, and beside it each map of one's own for the classes that it gives."""
    spec = plan.spec
    stated, grid = spec.stated_coverage(), plan.grid
    if stated is not None and spec.is_own_alone:
        return reduce(Reading.beside, _read_own_maps(plan, stated))
    if stated is not None and (plan.extract.format == "geojson" or spec.own_map):
        of_geojson = partial(read_geojson, grid=grid, stated_coverage=stated)
        classes = spec.extract_classes
        if plan.extract.format == "geojson":
            reading = of_geojson((source, *plan.more), tags=plan.extract.tags, classes=classes)
        else:
            reading = read_extract(source, grid, at=plan.extract.date, stated_coverage=stated, classes=classes)
        return reduce(Reading.beside, _read_own_maps(plan, stated), reading)
    return read_extract(source, grid, at=plan.extract.date, stated_coverage=stated, classes=spec.classes)


def _read_own_maps(plan: BuildPlan, stated: shapely.Geometry) -> Iterator[Reading]:
    for own, path in zip(plan.spec.own_map, plan.own_maps, strict=True):
        if own.named_classes:
            yield read_vector(path, plan.grid, table=own, stated_coverage=stated)
        else:
            yield read_geojson((path,), plan.grid, tags=own.tags, stated_coverage=stated, classes=own.classes)


def _write_imagery(scratch: Path, plan: BuildPlan, reading: Reading) -> OrthoRecord:
    """Write `ortho.tif`, and measure its offset against the map."""
    name, path = plan.folder.name, scratch / ORTHO
    tell(f"{name}: cutting {counted(len(plan.pictures), 'picture')} to the region")
    for picture in plan.pictures:
        if picture.bands.note:
            tell(f"{name}: {picture.entry.file}: {picture.bands.note}")
    grid = ortho_grid(plan.pictures, plan.grid)
    write_ortho(path, plan.pictures, grid)
    record = OrthoRecord.unmeasured(tuple(item.record() for item in plan.pictures), grid)
    imagery = Imagery(path=path, file=file_record(path), record=record, epsg=grid.epsg)
    houses = reading.features[((reading.features["class"] == "building") & reading.features["is_visible"]).to_numpy()]
    # 0: seed of the tiles drawn anew for an interval: the same pictures give the same bytes
    offset = measure_offset(imagery, houses.geometry.to_numpy(), rng=np.random.default_rng(0))
    share = share_shown(imagery, reading.coverage, plan.grid.cell_size_m)
    shown = f"{name}: imagery shows {share:.1%} of the mapped ground"
    tell(f"{shown}, off the map by {offset.to_text()}" if offset else f"{shown}; its offset could not be measured")
    return record.model_copy(update={"offset": offset, "offset_version": OFFSET_VERSION, "share": share})


def share_shown(imagery: Imagery, mapped: shapely.Geometry, cell_size_m: float) -> float:
    """Return the fraction of the mapped ground that the imagery shows, by cells of the map or larger ones."""
    shown = total = 0
    areas = shapely.orient_polygons(shapely.get_parts(mapped), exterior_cw=False)
    step_m = max(cell_size_m, imagery.record.gsd_m)
    for _, _, part in Grid.from_bounds(*mapped.bounds, cell_size_m=step_m, epsg=imagery.epsg).windows(1024):
        is_mapped = burn(areas, part)
        if is_mapped.any():
            total += int(is_mapped.sum())
            shown += int((is_mapped & imagery.read(part.bounds_m, gsd_m=step_m).is_known).sum())
    return round(shown / total, 4) if total else 0.0


def _write_into(
    scratch: Path,
    plan: BuildPlan,
    extract: ExtractRecord,
    reading: Reading,
    *,
    imagery: OrthoRecord | None = None,
) -> Manifest:
    """Burn the layers, make the graph, and write all files of a region."""
    classes, terms = plan.spec.class_names, {"credit": plan.spec.credit, "licence": plan.spec.licence}
    shown: Future[None] = Future()  # the level that the preview shows is in its file
    factor = shown_factor(max(plan.grid.shape), overview_factors(plan.grid), longest_cells=PREVIEW_CELLS)

    def filled(level: int) -> None:
        if level == factor:
            shown.set_result(None)

    # Blocks are packed without holding the interpreter, so the layers are written while all else is made.
    with ThreadPoolExecutor(max_workers=1) as executor:
        paint = partial(_painter, reading, plan.grid, classes)
        layers = executor.submit(
            partial(write_layers, scratch / region_files.LAYERS, plan.grid, classes, paint, filled=filled, **terms)
        )
        graph = build_graph(reading.features, bounds_m=plan.grid.bounds_m)
        region_files.write_tables(scratch, reading.features, graph, **terms)
        manifest = make_manifest(plan, extract, reading, graph)
        if plan.with_preview and shown in wait((shown, layers), return_when=FIRST_COMPLETED).done:
            _write_preview(scratch, manifest)
        layers.result()
    files = {path.name: file_record(path) for path in sorted(scratch.iterdir())}
    manifest = manifest.model_copy(update={"files": files, "imagery": imagery})
    region_files.write_manifest(scratch, manifest)
    return manifest


def build_edited(
    plan: BuildPlan,
    base: Region,
    features: gpd.GeoDataFrame,
    *,
    suffix: str,
    note: str,
    coverage: shapely.Geometry | None = None,
) -> Path:
    """Write a region with edited features next to its base, as `<id>+<suffix>`, and return its folder.

    It has no imagery, which would show what was there before. Provenance stays that of the base, and so does the mapped
    area unless a smaller `coverage` is given; `note` says in the manifest what was edited. Raise `StoreError` if the
    folder cannot be written.
    """
    name = f"{plan.folder.name}+{suffix}"
    cut = "" if coverage is None else coverage.wkt
    inputs = hashlib.sha256(f"{base.manifest.inputs_sha256}/{note}/{fingerprint(features)}{cut}".encode()).hexdigest()
    spec = plan.spec.model_copy(update={"id": name, "title": f"{plan.spec.title} ({suffix})"})
    folder = plan.folder.parent / name
    edited = replace(plan, spec=spec, folder=folder, inputs_sha256=inputs, pictures=(), with_preview=False)
    record = base.manifest
    # Reason why ground of an edited map is unknown
    reading = Reading(
        features=features,
        coverage=base.coverage if coverage is None else coverage,
        coverage_source=record.coverage.source,
        osm_timestamp=record.extract.osm_timestamp,
        drops=record.drops,
        hidden=record.hidden,
        notes=record.notes,
        warnings=(*record.warnings, note),
        unknown_m2=record.coverage.unknown_m2
        | ({} if coverage is None else {"cut away": base.coverage.area - coverage.area}),
        cuts=record.coverage.cuts,
    )
    _write_unless_current(edited, lambda scratch: _write_into(scratch, edited, record.extract, reading))
    return edited.folder


def build_made(spec: RegionFile, reading: Reading, *, out: Path) -> Path:
    """Write a region of generated features to `out/regions/<id>`, and return its folder.

    `spec` gives place, id and title; the file of its one extract is not read. `reading` replaces what would be read
    from an extract. Raise `StoreError` if the folder cannot be written.
    """
    extract = spec.pick(None)
    # Hash every shape and its attributes; a fingerprint has only centroids
    shapes = b"".join(shapely.to_wkb(reading.features.geometry.to_numpy()))
    content = hashlib.sha256(fingerprint(reading.features).encode() + shapes).hexdigest()
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
    _write_unless_current(plan, lambda scratch: _write_into(scratch, plan, record, reading))
    return plan.folder


def _write_unless_current(plan: BuildPlan, write: Callable[[Path], Manifest]) -> Manifest | None:
    """Let `write` fill the folder of a region; return None if it is up to date, perhaps by a build we waited for."""
    try:
        with locked(plan.folder):
            kept = _kept(plan.folder, plan.inputs_sha256)
            if kept is not None:
                return _mend(plan, kept)
            with fresh_folder(plan.folder) as scratch:
                return write(scratch)
    except SasgeoError:
        raise
    except OSError as error:
        raise StoreError(
            f"{plan.folder} cannot be written ({error.strerror or error}): check the free space and your rights"
        ) from error


def _mend(plan: BuildPlan, kept: Manifest) -> Manifest | None:
    """Write what a region lacks whose map is up to date: lines of provenance, and a preview; None if nothing."""
    name, mended = plan.folder.name, kept
    if not _states(kept, plan.spec):
        tell(f"{name}: its provenance alone has changed: only {region_files.MANIFEST} is written")
        mended = mended.model_copy(update={"provenance": plan.spec.origin, "attribution": plan.spec.credit})
    if plan.with_preview and not _is_shown(kept):
        tell(f"{name}: its map is up to date, and {region_files.PREVIEW} is drawn")
        _write_preview(plan.folder, mended)
        shown = {region_files.PREVIEW: file_record(plan.folder / region_files.PREVIEW)}
        mended = mended.model_copy(update={"files": dict(sorted((mended.files | shown).items()))})
    if mended is kept:
        return None
    region_files.write_manifest(plan.folder, mended)
    return mended


def _write_preview(folder: Path, manifest: Manifest) -> None:
    from sasgeo_bench.regions.preview import write_preview  # noqa: PLC0415 - only a picture needs matplotlib

    layers = folder / region_files.LAYERS
    write_preview(
        folder / region_files.PREVIEW,
        manifest=manifest,
        overview=read_overview(layers, longest_cells=PREVIEW_CELLS),
    )


@contextmanager
def _source(plan: BuildPlan) -> Iterator[Path]:
    """Yield the extract; an embedded town is first written to a temporary folder."""
    if plan.source is not None:
        yield plan.source
        return
    town = plan.extract.town
    if town is None or plan.spec.center_lonlat is None:
        raise StoreError(f"{plan.spec.id}: an embedded town needs center_lonlat in its region file")
    with scratch_folder("town") as folder:
        path = folder / plan.extract.file
        longitude_deg, latitude_deg = plan.spec.center_lonlat
        shape = TownPlan(
            morphology=town.morphology, seed=town.seed, size_m=town.size_m, center_lonlat=(longitude_deg, latitude_deg)
        )
        write_town(shape, path, on=plan.extract.date)
        yield path


def _painter(reading: Reading, grid: Grid, classes: tuple[str, ...], factor: int) -> PaintWindow:
    """Return what burns a window of one overview, or of the map itself (factor 1)."""
    # Overviews draw lines at least one of their cells wide.
    least_width_m = 0.0 if factor == 1 else grid.cell_size_m * factor
    return partial(burn_mapped, make_paint(reading.features, classes, reading.coverage, least_width_m=least_width_m))


def make_manifest(plan: BuildPlan, extract: ExtractRecord, reading: Reading, graph: MapGraph) -> Manifest:
    """Make the content of `region.json`, without the hashes of the files."""
    grid, spec = plan.grid, plan.spec
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
        classes=spec.class_names,
        extract=extract,
        coverage=CoverageRecord(
            source=reading.coverage_source,
            share=min(1.0, reading.coverage.area / ((east - west) * (north - south))),
            wkt=shapely.to_wkt(reading.coverage, rounding_precision=2),
            unknown_m2={reason: round(area_m2, 1) for reason, area_m2 in reading.unknown_m2.items()},
            cuts=reading.cuts,
        ),
        counts={name: int(counts.get(name, 0)) for name in spec.class_names},
        graph_counts={str(name): int(count) for name, count in sorted(kinds.items())}
        | {f"edges_{name}": int(count) for name, count in sorted(graph.edges["relation"].value_counts().items())},
        hidden=reading.hidden,
        drops=reading.drops,
        notes=reading.notes,
        warnings=reading.warnings,
        fingerprint=fingerprint(reading.features),
        inputs_sha256=plan.inputs_sha256,
        files={},
        licence=spec.licence,
        attribution=spec.credit,
        provenance=spec.origin,
        # None where features are generated, and nothing is read
        own_maps=tuple(_own_map_record(one, path) for one, path in zip(spec.own_map, plan.own_maps, strict=False)),
    )


def _own_map_record(own: OwnMap, path: Path) -> OwnMapRecord:
    about = own.model_dump(include={"file", "date", "classes", "licence", "attribution", "publish", "source"})
    return OwnMapRecord(**about, **file_record(path).model_dump())


TILE_M: Final = 96.0
REACH_M: Final = 12.0  # offsets up to this one are found
LEAST_TILES: Final = 4
# Of an offset that is one: peaks by chance spread over the whole reach
_MOST_RESIDUAL_M: Final = 4.0
_MOST_INTERVAL_M: Final = 2.0
_SMOOTH_M: Final = 0.5
_LEVEL_PERCENT: Final = 95.0

Complex = NDArray[np.complex128]
Surface = NDArray[np.float64]


def measure_offset(
    imagery: Imagery, buildings: NDArray[np.object_], *, rng: np.random.Generator
) -> OffsetRecord | None:
    """Return the offset of imagery against building outlines, or None where edges are too few or do not agree.

    A wall counts by its direction, so that it agrees with an edge along it, dark to bright or bright to dark, and edges
    of crowns in all directions cancel. Each tile of 96 m gives a surface of correlation over offsets of up to 12 m,
    and counts if its peak is clear: one standard deviation above any other. The offset is the median of clear tiles:
    neither tiles on a slope, nor those where the ridges of a row of houses lie on its walls, move it far. Intervals
    come from tiles drawn anew with replacement.

    It is the offset of the edges of roofs against mapped outlines. Maps have walls at the ground, or roofs of another
    picture; and in a mosaic that is no true orthophoto a roof leans away from the middle of its photo, by its height
    times the tangent of the view's tilt. So the ground, roads among it, may lie otherwise by a metre or two.

    Parameters
    ----------
    imagery : Imagery
        Read tile by tile, at 0.25 m or its own pixels if they are coarser.
    buildings : ndarray of object
        Polygons in the region's CRS. Buildings that the map lacks add noise alone.
    rng : numpy.random.Generator
        Of the tiles drawn anew.

    Returns
    -------
    OffsetRecord or None
        None with fewer than `LEAST_TILES` clear tiles; and where the median clear tile is more than 4 m from the
        offset, or an interval wider than 2 m, as with peaks by chance.
    """
    step_m = max(0.25, imagery.record.gsd_m)  # m: step of the correlation, or the pixel of a coarser picture
    parts = shapely.get_parts(buildings)
    outlines = shapely.orient_polygons(parts[~shapely.is_empty(parts)], exterior_cw=False)
    found = [_clear_peak_m(surface, step_m) for surface in _surfaces(imagery, outlines, step_m)]
    peaks = np.array([peak for peak in found if peak is not None])
    if len(peaks) < LEAST_TILES:
        return None
    offset = np.median(peaks, axis=0)
    half_m, most_m = np.percentile(np.hypot(*(peaks - offset).T), (50, 90)).round(3).tolist()
    drawn = np.median(peaks[rng.integers(len(peaks), size=(500, len(peaks)))], axis=1)
    tail = (100 - _LEVEL_PERCENT) / 2
    low, high = np.percentile(drawn, (tail, 100 - tail), axis=0).round(3).tolist()
    if half_m > _MOST_RESIDUAL_M or max(high[0] - low[0], high[1] - low[1]) > _MOST_INTERVAL_M:
        return None
    return OffsetRecord(
        east_m=round(float(offset[0]), 3),
        north_m=round(float(offset[1]), 3),
        east_interval_m=(low[0], high[0]),
        north_interval_m=(low[1], high[1]),
        residual_m=half_m,
        residual_90_m=most_m,
        tiles=len(peaks),
        of_tiles=len(found),
    )


def _surfaces(imagery: Imagery, outlines: NDArray[np.object_], step_m: float) -> Iterator[Surface]:
    """Yield the correlation of each tile that holds walls, shape (2 R + 1, 2 R + 1), row down to the south."""
    tree, walls = shapely.STRtree(outlines), shapely.boundary(outlines)
    side = round(TILE_M / step_m)
    reach = round(REACH_M / step_m)
    lattice = Grid.from_bounds(*imagery.record.bounds_m, cell_size_m=step_m, epsg=imagery.epsg)
    for _, _, tile in lattice.windows(side):
        box = shapely.box(*tile.bounds_m)
        near = tree.query(box)
        # As much of walls as a tile is wide: with fewer its own offset says little
        if tile.shape != (side, side) or shapely.length(shapely.intersection(walls[near], box)).sum() < TILE_M:
            continue
        around = tile.window(-reach, -reach, side + 2 * reach, side + 2 * reach)
        view = imagery.read(around.bounds_m, gsd_m=step_m)
        if view.is_known.mean() >= 0.75:  # of what a tile may lie on
            yield _correlation(_Edges.of_map(outlines[near], tile), _Edges.of_picture(view.rgb, view.is_known, step_m))


@dataclass(frozen=True, kw_only=True)
class _Edges:
    """Edges as complex numbers of twice their angle: opposite directions agree, perpendicular ones cancel."""

    field: Complex

    @classmethod
    def of_map(cls, outlines: NDArray[np.object_], tile: Grid) -> "_Edges":
        roofs = burn(outlines, tile).astype(np.float32)
        return cls(field=_doubled(roofs, tile.cell_size_m))

    @classmethod
    def of_picture(cls, rgb: NDArray[np.uint8], is_known: NDArray[np.bool_], step_m: float) -> "_Edges":
        """Return the edges of a picture, strong ones cut, without those along the rim of what it shows."""
        grey = cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY).astype(np.float32)
        rim = 2 * round(2 * _SMOOTH_M / step_m) + 1
        inside = cv2.erode(is_known.view(np.uint8), np.ones((rim, rim), np.uint8), borderValue=1) > 0
        found = _doubled(grey, step_m) * inside
        strength = np.abs(found)
        most = float(np.percentile(strength[inside], _LEVEL_PERCENT)) if inside.any() else 0.0
        return cls(field=found * np.minimum(1.0, most / np.maximum(strength, 1e-9)))


def _doubled(values: NDArray[np.float32], step_m: float) -> Complex:
    smooth = cv2.GaussianBlur(values, (0, 0), _SMOOTH_M / step_m, borderType=cv2.BORDER_REPLICATE)
    across, down = cv2.Sobel(smooth, cv2.CV_64F, 1, 0), cv2.Sobel(smooth, cv2.CV_64F, 0, 1)
    slope = across + 1j * down
    return np.asarray(slope**2 / np.maximum(np.abs(slope), 1e-9))


def _correlation(on_map: _Edges, seen: _Edges) -> Surface:
    """Return the sum of products for each offset; the picture is larger than the map by the reach on each side."""
    template, picture = on_map.field, seen.field
    shape = tuple(scipy.fft.next_fast_len(size) for size in picture.shape)
    product = scipy.fft.fft2(picture, shape) * np.conj(scipy.fft.fft2(template, shape))
    count = picture.shape[0] - template.shape[0] + 1
    return np.asarray(scipy.fft.ifft2(product)[:count, :count].real)


def _clear_peak_m(surface: Surface, step_m: float) -> tuple[float, float] | None:
    """Return the offset, east and north, at which a surface is highest; None if another peak is about as high.

    Held against the picture of another tile, 3 to 8 % of the tiles of five places have a clear peak.
    """
    east_m, north_m = _peak_m(surface, step_m)
    reach = surface.shape[0] // 2
    if max(abs(east_m), abs(north_m)) > (reach - 1) * step_m:
        return None  # it rises beyond the reach
    at_m = np.arange(-reach, reach + 1) * step_m
    # 2 m: width of a peak, of blurred edges and of roofs that lean by unlike lengths; two pixels of a coarse picture
    is_other = np.hypot(at_m[None] - east_m, -at_m[:, None] - north_m) > max(2.0, 2 * step_m)
    return (east_m, north_m) if surface.max() - surface[is_other].max() > surface.std() else None


def _peak_m(surface: Surface, step_m: float) -> tuple[float, float]:
    row, col = (int(at) for at in np.unravel_index(np.argmax(surface), surface.shape))
    reach = surface.shape[0] // 2
    down = row - reach + _vertex(surface[:, col], row)
    right = col - reach + _vertex(surface[row], col)
    return float(right * step_m), float(-down * step_m)


def _vertex(line: Surface, at: int) -> float:
    """Return where a parabola through three points is highest, -0.5 to 0.5 from the middle one; 0 at an end."""
    if not 0 < at < len(line) - 1:
        return 0.0
    before, here, after = line[at - 1 : at + 2]
    bend = before - 2 * here + after
    return float(np.clip((before - after) / (2 * bend), -0.5, 0.5)) if bend < 0 else 0.0
