# SPDX-License-Identifier: Apache-2.0
"""Read a map of one's own: GeoPackage, FlatGeobuf, GeoParquet, GeoJSON or zipped Shapefile, with a table of classes."""

import difflib
import json
import math
import warnings
import zipfile
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final, NamedTuple

import numpy as np
import pyproj
import shapely
from numpy.typing import NDArray

from sasgeo_bench.core.errors import CoverageError, ExtractError, StoreError, counted, named
from sasgeo_bench.core.parquet import MOST_VALUES, VERIFIED, open_table, read_schema
from sasgeo_bench.core.paths import plain_file
from sasgeo_bench.core.texts import one_line
from sasgeo_bench.geometry.grid import Grid
from sasgeo_bench.geometry.projection import WGS84, has_open_datum, to_lonlat
from sasgeo_bench.osm.geojson import NO_TIME, features_of, shape_of
from sasgeo_bench.osm.locate import ClassTable
from sasgeo_bench.osm.mapped import lonlat_box
from sasgeo_bench.osm.scan import Box, Classifier, Scan, ScanRow
from sasgeo_bench.osm.taxonomy import Label, Taxonomy

MOST_FEATURES: Final = 2_000_000  # in a region
MOST_UNPACKED: Final = 2_000_000_000  # bytes of a file that is read whole: an archive, a GeoParquet
_FORMS: Final = (
    (b"SQLite format 3\0", "GPKG"),
    (b"fgb\x03", "FlatGeobuf"),
    (b"PAR1", "Parquet"),
    (b"PK\x03\x04", "ESRI Shapefile"),
)
_SHAPEFILE: Final = b"\x00\x00\x27\x0a"
_MOST_NAMED: Final = 8
_MARGIN_M: Final = 100.0  # around the region, in which features are read
_ACCURATE_M: Final = 2.0
_AREA: Final = 2  # dimensions

Geometries = NDArray[np.object_]
Points = NDArray[np.float64]


class VectorScan(NamedTuple):
    """What a file holds of a region, and what its user should know."""

    scan: Scan
    warnings: tuple[str, ...]


@dataclass(frozen=True, kw_only=True)
class _Rows:
    """Features near a region: shapes in the file's CRS, None for none; texts of the column; widths."""

    shapes: Geometries
    values: list[str]
    widths: list[str]
    bounds: Sequence[float]  # of all of the file


def scan_vector(path: Path, taxonomy: Taxonomy, table: ClassTable, *, grid: Grid) -> VectorScan:
    """Read the features of a file that touch a grid, with the classes of a table.

    The format is told by the content. Coordinates go from the CRS of the file straight to that of the grid, with the
    most accurate operation at hand there, and are returned as its longitudes and latitudes. Areas that cross themselves
    are mended; of a geometry of several kinds the areas are taken, or else the lines. Features are numbered by class
    and place, so that every format gives the same.

    Raise `ExtractError` if the file is damaged or does not fit the table, `CoverageError` if nothing lies in the grid.
    """
    source = _open(path, table)
    step, doubt = _step(path, source.crs, grid)
    box = _box_in(path, step, grid)
    rows, scan = _read(source, table, box), Scan()
    bounds = shapely.bounds(rows.shapes)
    if lost := int((~np.isfinite(bounds).all(axis=1)).sum()):
        scan.tally.drops["feature without a geometry"] += lost
    near = np.flatnonzero(_meets(bounds, box))
    shapes_m = shapely.transform(rows.shapes[near], lambda at: np.column_stack(step.transform(*at.T)))
    is_in = _meets(shapely.bounds(shapes_m), grid.bounds_m)
    if not is_in.any():
        raise CoverageError(_nothing(path, source.crs, rows.bounds, box))
    shapes, mended = _mended(path, shapes_m[is_in])
    values = [rows.values[at] for at in near[is_in]]
    found = list(_found(scan, shapes, values, [rows.widths[at] for at in near[is_in]], table, taxonomy))
    reasons = ", ".join(f"{count} x {reason}" for reason, count in scan.tally.drops.most_common(_MOST_NAMED))
    if not found:
        raise ExtractError(f"{path}: none of {counted(len(shapes), 'feature')} in the region has a class ({reasons})")
    _number(scan, found, taxonomy, grid)
    left, unused = len(shapes) - len(found), sorted(set(table.values) - set(values))
    partial = f"{path.name}: {left} of {counted(len(shapes), 'feature')} in the region have no class ({reasons})"
    missed = f"{path.name}: no feature in the region has the {named(unused, 'value')} of `values`"
    said = ((doubt, doubt), (mended, mended), (left, partial), (unused, missed))
    return VectorScan(scan, tuple(text for is_so, text in said if is_so))


def _meets(bounds: Points, box: Box) -> NDArray[np.bool_]:
    """Return which of some bounds, shape (N, 4), are finite and meet a box."""
    west, south, east, north = box
    meets = (bounds[:, 0] <= east) & (bounds[:, 2] >= west) & (bounds[:, 1] <= north) & (bounds[:, 3] >= south)
    return np.asarray(meets & np.isfinite(bounds).all(axis=1))


class _Source(NamedTuple):
    """A checked file: how it is opened, its layer, its CRS."""

    path: Path
    form: str
    name: str
    layer: str | None
    crs: pyproj.CRS


def _open(path: Path, table: ClassTable) -> _Source:
    """Tell the format by the first bytes, since GDAL would open a file that names any other as its content."""
    try:
        with plain_file(path).open("rb") as file:
            head = file.read(64)
    except OSError as error:
        raise ExtractError(f"{path} cannot be read ({error.strerror or error})") from error
    form = next((form for magic, form in _FORMS if head.startswith(magic)), None)
    if form is None and head.removeprefix(b"\xef\xbb\xbf").lstrip().startswith(b"{"):
        form = "GeoJSON"
    if form is None:
        raise ExtractError(
            f"{path} is no GeoPackage, FlatGeobuf, GeoParquet, GeoJSON or zipped Shapefile: make it one "
            "(ogr2ogr -f GPKG)"
        )
    if form in ("GeoJSON", "Parquet") and table.layer is not None:
        raise ExtractError(f"{path} has no layers: leave layer = {table.layer!r} out of its [[own_map]]")
    if form == "GeoJSON":
        return _Source(path, form, str(path), None, pyproj.CRS.from_epsg(table.epsg or WGS84))
    if form == "Parquet":
        return _Source(path, form, str(path), None, _crs(path, _geo(path).crs, table.epsg))
    return _open_ogr(path, form, table)


def _open_ogr(path: Path, form: str, table: ClassTable) -> _Source:
    import pyogrio  # noqa: PLC0415 - few regions have a map that needs it

    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", RuntimeWarning)  # of GDAL, about what is refused below
            if form == "ESRI Shapefile":
                inner = _pick(path, _shapefiles(path), table.layer)
                name, layer = f"/vsizip/{{{path.resolve()}}}/{inner}", None
            else:
                name = str(path)
                layers = [str(layer) for layer, kind in pyogrio.list_layers(path) if kind is not None]
                layer = _pick(path, {each: each for each in layers}, table.layer)
            about = pyogrio.read_info(name, layer=layer)
    except (RuntimeError, ValueError, IndexError, OSError, zipfile.BadZipFile) as error:
        if isinstance(error, ExtractError):
            raise
        raise ExtractError(f"{path} cannot be read ({one_line(str(error))[:200]}): get it again") from error
    if about["driver"] != form:
        raise ExtractError(f"{path} is opened as {about['driver']}, not as {form}: make it one (ogr2ogr -f GPKG)")
    if not about["features"]:
        raise ExtractError(
            f"{path}: layer {layer or name.rpartition('/')[2]!r} is empty: name another, or get it again"
        )
    wanted = [one for one in (table.column, table.width_column) if one is not None]
    for column in wanted:
        _check_column(path, column, [str(field) for field in about["fields"]])
    return _Source(path, form, name, layer, _crs(path, about["crs"], table.epsg))


def _shapefiles(path: Path) -> dict[str, str]:
    """Return the shapefiles of an archive by their names, after a check of its size and of what they are."""
    with zipfile.ZipFile(path) as archive:
        unpacked = sum(item.file_size for item in archive.infolist())
        if unpacked > MOST_UNPACKED:
            raise ExtractError(f"{path} unpacks to more than {MOST_UNPACKED / 1e9:g} GB: cut it to the region")
        files = [name for name in archive.namelist() if name.lower().endswith(".shp")]
        for name in files:
            with archive.open(name) as file:
                if file.read(len(_SHAPEFILE)) != _SHAPEFILE:
                    raise ExtractError(f"{path}: {name} is no shapefile: zip .shp, .shx, .dbf and .prj of one")
    return {Path(name).stem: name for name in files}


def _pick(path: Path, layers: dict[str, str], asked: str | None) -> str:
    """Return the layer that is asked for, or the only one."""
    if not layers:
        raise ExtractError(f"{path} holds no layer with geometry: it is damaged (get it again), or of another kind")
    listed = named(list(layers), "layer", most=_MOST_NAMED)
    if asked is None and len(layers) > 1:
        raise ExtractError(f"{path} has {listed}: name one by layer in its [[own_map]], or each by one of its own")
    if asked is not None and asked not in layers:
        raise ExtractError(f"{path} has no layer {asked!r}, it has {listed}")
    return layers[asked or next(iter(layers))]


def _check_column(path: Path, column: str, columns: Sequence[str]) -> None:
    if column in columns:
        return
    near = difflib.get_close_matches(column, columns, n=1, cutoff=0.5)
    hint = f", did you mean {near[0]!r}?" if near else ""
    raise ExtractError(f"{path} has no column {column!r}{hint} It has {named(columns, 'column', most=_MOST_NAMED)}")


def _crs(path: Path, stated: str | pyproj.CRS | None, epsg: int | None) -> pyproj.CRS:
    """Return the CRS of a file in two dimensions: that which it states, or the one of the region file."""
    asked = None if epsg is None else pyproj.CRS.from_epsg(epsg)
    crs = pyproj.CRS.from_user_input(stated) if stated is not None else asked
    if crs is not None and crs.is_compound:
        crs = crs.sub_crs_list[0]
    if crs is not None and asked is not None and has_open_datum(crs):
        crs = asked  # which says what the file leaves open
    if crs is None or not (crs.is_geographic or crs.is_projected):
        what = "no coordinate reference system" if crs is None else f"the local one {one_line(crs.name)[:60]!r} alone"
        if crs is None or asked is None:
            raise ExtractError(f"{path} states {what}: say which it is by epsg = ... in its [[own_map]]")
        crs = asked
    own = None if has_open_datum(crs) else crs.to_epsg()
    if asked is not None and own is not None and own != asked.to_epsg():
        raise ExtractError(f"{path} states EPSG:{own}, its [[own_map]] epsg = {epsg}: leave that out, or mend the file")
    return crs.to_2d()


class _Geo(NamedTuple):
    """What a GeoParquet says of its geometry: its column, its CRS if one is stated, its box if it has one."""

    primary: str
    crs: pyproj.CRS | None
    has_boxes: bool


def _geo(path: Path) -> _Geo:
    try:
        with open_table(path, mend="write it with geopandas", most_rows=MOST_VALUES, is_whole=False) as file:
            unpacked = sum(file.metadata.row_group(at).total_byte_size for at in range(file.num_row_groups))
            about = json.loads((file.schema_arrow.metadata or {})[b"geo"])
        primary = str(about["primary_column"])
        column = about["columns"][primary]
        # By the specification longitude and latitude where nothing is said, unknown where null is
        stated = column.get("crs", f"EPSG:{WGS84}")
        crs = None if stated is None else pyproj.CRS.from_user_input(stated)
    except StoreError as error:
        raise ExtractError(str(error).replace("cannot be read (", "cannot be read as GeoParquet (", 1)) from error
    except (ValueError, KeyError, TypeError, AttributeError, pyproj.exceptions.CRSError) as error:
        why = f"no {error} in it" if isinstance(error, KeyError) else one_line(str(error))[:200]
        raise ExtractError(f"{path} cannot be read as GeoParquet ({why}): write it with geopandas") from error
    if unpacked > MOST_UNPACKED:
        raise ExtractError(f"{path} unpacks to more than {MOST_UNPACKED / 1e9:g} GB: cut it to the region")
    return _Geo(primary, crs, "covering" in column)


def _step(path: Path, crs: pyproj.CRS, grid: Grid) -> tuple[pyproj.Transformer, str]:
    """Return what turns coordinates of a file into those of a grid, and a warning if a better way is not at hand."""
    around = pyproj.transformer.AreaOfInterest(*lonlat_box(grid))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # said below, in our words
        group = pyproj.transformer.TransformerGroup(crs, grid.epsg, always_xy=True, area_of_interest=around)
    if not group.transformers:
        raise ExtractError(
            f"{path} cannot be projected from {one_line(crs.name)[:60]!r} to EPSG:{grid.epsg}: reproject"
        )
    step = group.transformers[0]
    is_rough = "Ballpark" in step.description
    if group.best_available and not is_rough and step.accuracy <= _ACCURATE_M:
        return step, ""
    off = (
        "an unknown error, which may be a hundred metres,"
        if is_rough or step.accuracy < 0
        else f"an error of about {step.accuracy:g} m"
    )
    missing = sorted({grid.full_name or grid.short_name for one in group.unavailable_operations for grid in one.grids})
    better = f"; a better way needs {named(missing, 'grid')} (projsync)" if missing else ""
    text = f"{path.name} goes from {one_line(crs.name)[:60]} to EPSG:{grid.epsg} with {off} ({step.description[:120]})"
    return step, text + better


def _box_in(path: Path, step: pyproj.Transformer, grid: Grid) -> Box:
    """Return the box of a grid in the CRS of a file, with a margin."""
    west, south, east, north = grid.bounds_m
    grown = (west - _MARGIN_M, south - _MARGIN_M, east + _MARGIN_M, north + _MARGIN_M)
    try:
        box = step.transform_bounds(*grown, densify_pts=21, errcheck=True, direction="INVERSE")
    except pyproj.exceptions.ProjError as error:
        raise ExtractError(f"{path}: the region lies outside its coordinate reference system ({error})") from error
    return (float(box[0]), float(box[1]), float(box[2]), float(box[3]))


def _read(source: _Source, table: ClassTable, box: Box) -> _Rows:
    if source.form == "GeoJSON":
        return _read_geojson(source.path, table)
    return (_read_parquet if source.form == "Parquet" else _read_ogr)(source, table, box)


def _read_geojson(path: Path, table: ClassTable) -> _Rows:
    shapes, values, widths, keys = [], list[str](), list[str](), dict[str, None]()
    for number, feature in enumerate(features_of(path, epsg=table.epsg)):
        properties = feature.get("properties") or {}
        keys |= dict.fromkeys(properties)
        shapes.append(shape_of(feature, path, number, is_lonlat=table.epsg is None))
        values.append(_text(properties.get(table.column)))
        widths.append(_text(properties.get(table.width_column)))
    for column in filter(None, (table.column, table.width_column)):
        _check_column(path, column, list(keys))
    if not shapes:
        raise ExtractError(f"{path} is empty: get it again")
    array = np.array(shapes, dtype=object)
    return _Rows(shapes=array, values=values, widths=widths, bounds=_bounds(array))


def _bounds(shapes: Geometries) -> list[float]:
    return [float(value) for value in shapely.total_bounds(shapes)]


def _read_parquet(source: _Source, table: ClassTable, box: Box) -> _Rows:
    import geopandas as gpd  # noqa: PLC0415 - few regions have a map that needs it

    path, about = source.path, _geo(source.path)
    named_columns = read_schema(path, mend="get it again").names
    wanted = [one for one in (table.column, table.width_column) if one is not None]
    for column in wanted:
        _check_column(path, column, [name for name in named_columns if name != about.primary])
    boxed = {"bbox": box} if about.has_boxes else {}
    try:
        columns = list(dict.fromkeys([*wanted, about.primary]))
        frame = gpd.read_parquet(path, columns=columns, **boxed, **VERIFIED)
        if about.has_boxes and frame.empty:  # to say where it lies
            frame = gpd.read_parquet(path, columns=columns, **VERIFIED)
    except (OSError, ValueError, KeyError, shapely.errors.ShapelyError) as error:
        raise ExtractError(f"{path} cannot be read as GeoParquet ({one_line(str(error))[:200]})") from error
    if frame.empty:
        raise ExtractError(f"{path} is empty: get it again")
    shapes = np.asarray(frame.geometry.array, dtype=object)
    _check_count(path, len(shapes))
    return _Rows(
        shapes=shapes,
        values=_texts(frame[table.column].tolist() if table.column else None, len(frame)),
        widths=_texts(frame[table.width_column].tolist() if table.width_column else None, len(frame)),
        bounds=_bounds(shapes),
    )


def _read_ogr(source: _Source, table: ClassTable, box: Box) -> _Rows:
    """Read a layer by its own index, without Arrow.

    In GDAL 3.12 a stream of FlatGeobuf is damaged by a feature without geometry, and one of GeoPackage holds curves,
    which come as straight pieces here.
    """
    import pyogrio  # noqa: PLC0415 - few regions have a map that needs it

    columns = list(dict.fromkeys(filter(None, (table.column, table.width_column))))
    try:
        about, _, wkb, fields = pyogrio.raw.read(
            source.name, layer=source.layer, columns=columns, bbox=box, max_features=MOST_FEATURES + 1
        )
        bounds = pyogrio.read_info(source.name, layer=source.layer, force_total_bounds=True)["total_bounds"]
    except (RuntimeError, ValueError, OSError) as error:
        raise ExtractError(f"{source.path} cannot be read ({one_line(str(error))[:200]}): get it again") from error
    _check_count(source.path, len(wkb))
    found = dict(zip(about["fields"], fields, strict=True))
    of = {name: found[name].tolist() for name in columns}
    return _Rows(
        shapes=np.asarray(shapely.from_wkb(wkb, on_invalid="ignore"), dtype=object),
        values=_texts(of.get(table.column or ""), len(wkb)),
        widths=_texts(of.get(table.width_column or ""), len(wkb)),
        bounds=bounds or (math.nan,) * 4,
    )


def _check_count(path: Path, count: int) -> None:
    if count > MOST_FEATURES:
        raise ExtractError(
            f"{path} has more than {MOST_FEATURES:,} features in the region: cut it, or a smaller region"
        )


def _texts(values: list[object] | None, count: int) -> list[str]:
    return [""] * count if values is None else [_text(value) for value in values]


def _text(value: object) -> str:
    """Return a value of a column as `values` names it: whole numbers without a fraction; empty for none.

    >>> [_text(value) for value in (31001.0, 2**53 + 1, True, " house ", float("nan"), None)]
    ['31001', '9007199254740993', 'true', 'house', '', '']
    """
    if isinstance(value, bool | np.bool_):
        return str(bool(value)).lower()
    if value is None or (isinstance(value, float) and not math.isfinite(value)):
        return ""
    return str(int(value) if isinstance(value, float) and value.is_integer() else value).strip()


def _nothing(path: Path, crs: pyproj.CRS, bounds: Sequence[float], box: Box) -> str:
    """Say that a file holds nothing in a region, where it lies, and whether its axes are swapped."""
    west, south, east, north = box
    code = crs.to_epsg()
    digits = ".4f" if crs.is_geographic else ".0f"
    where, wanted = (", ".join(f"{value:{digits}}" for value in one) for one in (bounds, box))
    text = f"{path.name} holds nothing in the region: it lies within [{where}] of "
    text += f"EPSG:{code}" if code else one_line(crs.name)[:60]
    low_y, low_x, high_y, high_x = bounds
    if low_x <= east and high_x >= west and low_y <= north and high_y >= south:
        return f"{text}, and in the region with its axes swapped: write x, or longitude, first"
    return f"{text}, the region within [{wanted}]: is its epsg right?"


def _mended(path: Path, shapes_m: Geometries) -> tuple[Geometries, str]:
    """Return shapes without crossing rings, and a warning with their area before and after."""
    is_broken = ~shapely.is_valid(shapes_m)
    if not is_broken.any():
        return shapes_m, ""
    broken = shapes_m[is_broken]
    mended = shapely.make_valid(broken, method="structure", keep_collapsed=False)
    before, after = (float(np.abs(shapely.area(shapes)).sum()) for shapes in (broken, mended))
    shapes = shapes_m.copy()
    shapes[is_broken] = mended
    return shapes, (
        f"{path.name}: {counted(len(broken), 'shape')} with crossing rings mended: {before:,.1f} m2 before, "
        f"{after:,.1f} m2 after"
    )


class _Found(NamedTuple):
    """A feature with a class: its shape in metres, and its number among `Scan.traits`."""

    class_name: str
    shape: shapely.Geometry
    kind: int


def _found(
    scan: Scan,
    shapes: Geometries,
    values: Sequence[str],
    widths: Sequence[str],
    table: ClassTable,
    taxonomy: Taxonomy,
) -> Iterator[_Found]:
    classifier, drops = Classifier(taxonomy, scan), scan.tally.drops
    labels = {name: _label(name, taxonomy) for name in table.named_classes}
    unnamed = Counter[str]()
    for shape, value, width in zip(shapes, values, widths, strict=True):
        name = table.class_of(value)
        if name is None:
            unnamed[value] += 1
            continue
        taken = _of_one_kind(shape, is_line=taxonomy[name].kind == "line")
        if taken is None:
            drops[f"{shape.geom_type} of class {name}" if not shape.is_empty else "shape without an inside"] += 1
            continue
        if shape.geom_type == "GeometryCollection":
            scan.tally.notes["geometry of several kinds, of which one was taken"] += 1
        get: Callable[[str], str | None] = {"width": width}.get
        is_area = shapely.get_dimensions(taken) == _AREA
        yield _Found(name, taken, classifier.kind(get, (labels[name],), is_area=is_area))
    for value, count in unnamed.most_common(_MOST_NAMED):
        drops[one_line(f"{table.column}={value or 'nothing'}: not in `values`")[:80]] += count
    if rest := unnamed.total() - sum(count for _, count in unnamed.most_common(_MOST_NAMED)):
        drops[f"other values of {table.column}: not in `values`"] += rest


def _label(name: str, taxonomy: Taxonomy) -> Label:
    """Return the label of a class: lines are as wide as the values of its tags in the middle, areas are filled."""
    rules = [rule for rule in taxonomy[name].rules if rule.geometry == "line"]
    widths = sorted(width for rule in rules for width in rule.widths.values())
    width_m = widths[len(widths) // 2] if widths else None
    fills = [rule.fills_to for rule in rules if rule.fills_to is not None]
    fills_to_m = fills[0] * width_m if fills and width_m is not None else None
    return Label(class_name=name, width_m=width_m, is_filled=True, keeps_width=True, fills_to_m=fills_to_m)


def _of_one_kind(shape: shapely.Geometry, *, is_line: bool) -> shapely.Geometry | None:
    """Return the areas of a shape, or its lines if it has no area and the class is one of lines; None if neither."""
    if shape.is_empty:
        return None
    if shape.geom_type in ("Polygon", "MultiPolygon"):
        return shape
    parts = shapely.get_parts(shapely.get_parts(shape))
    areas = parts[shapely.get_dimensions(parts) == _AREA]
    if len(areas):
        return shapely.union_all(areas)
    lines = parts[shapely.get_dimensions(parts) == 1]
    return shapely.multilinestrings(lines) if is_line and len(lines) else None


def _number(scan: Scan, found: list[_Found], taxonomy: Taxonomy, grid: Grid) -> None:
    """Keep features as rows, numbered by class and place: formats with an index have an order of their own."""
    shapes = np.array([each.shape for each in found], dtype=object)
    classes = np.array([taxonomy.names.index(each.class_name) for each in found])
    bounds = shapely.bounds(shapes).round(3) + 0.0
    order = np.lexsort((*bounds.T[::-1], classes))
    back = to_lonlat(grid.epsg)
    lonlat = shapely.to_wkb(shapely.transform(shapes, lambda at: np.column_stack(back.transform(*at.T))))
    scan.rows += [
        ScanRow(bytes(lonlat[at]), found[at].kind, number - len(found), False, 0, NO_TIME)  # noqa: FBT003
        for number, at in enumerate(order.tolist())
    ]
