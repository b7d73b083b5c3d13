# SPDX-License-Identifier: Apache-2.0
"""A dataset release: public libraries load it without this package, validators accept it, what is unfit is refused."""

import datetime as dt
import errno
import filecmp
import json
import os
import re
import shutil
import subprocess
import sys
from collections.abc import Callable, Iterator
from dataclasses import replace
from itertools import islice
from pathlib import Path

import jsonschema
import mlcroissant
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pyproj
import pystac
import pytest
import rasterio
import shapely
from affine import Affine
from huggingface_hub import DatasetCard
from PIL import Image
from pystac.validation.stac_validator import JsonSchemaSTACValidator
from rio_cogeo.cogeo import cog_validate

from sasgeo_bench.core.errors import StoreError
from sasgeo_bench.core.folders import file_record, sha256_of
from sasgeo_bench.core.progress import reporting
from sasgeo_bench.exchange import release as release_module
from sasgeo_bench.exchange.release import ReleaseRequest, make_release
from sasgeo_bench.exchange.release_files import Release, open_release
from sasgeo_bench.exchange.release_metadata import footprint
from sasgeo_bench.geometry.grid import Grid
from sasgeo_bench.regions.imagery import ORTHO, ImageryEntry, OrthoRecord
from sasgeo_bench.regions.layers import read_overview
from sasgeo_bench.regions.ortho import check_picture, ortho_grid, write_ortho
from sasgeo_bench.regions.preview import write_preview
from sasgeo_bench.regions.region import ATTRIBUTION, OwnMapRecord
from sasgeo_bench.regions.region_files import read_manifest, write_manifest
from sasgeo_bench.running.plan import RunRequest, reach_of
from sasgeo_bench.sensing.camera import Camera, Intrinsics
from sasgeo_bench.tasks import task_files
from sasgeo_bench.tasks.build import put_task
from sasgeo_bench.tasks.frame_files import FRAME, frame_row
from sasgeo_bench.tasks.frames import Frame
from tests.regions.imagery_place import write_picture

GRID, RIVERSIDE = "town-grid", "town-riverside"
FOLDER = "release"

# What a stranger does who has the folder and no code of ours.
LOAD_ALL = """
import json, sys
sys.modules["sasgeo_bench"] = None
from pathlib import Path
import geopandas, pandas, rasterio
from datasets import get_dataset_config_names, load_dataset

here = str(Path.cwd())
found = {"rows": {}, "queries": {}, "layers": {}, "features": {}, "nodes": {}, "edges": {}}
for name in get_dataset_config_names(here):
    for split, rows in load_dataset(here, name, cache_dir=sys.argv[1]).items():
        found["rows"][f"{name}/{split}"] = [row["query_id"] for row in rows]
for path in sorted(Path().glob("tasks/*/*/*.parquet")):
    found["queries"][str(path)] = len(pandas.read_parquet(path))
for folder in sorted(Path("regions").iterdir()):
    with rasterio.open(folder / "layers.tif") as source:
        found["layers"][folder.name] = [source.count, int((source.read() == 1).sum()), str(source.crs)]
    for table in ("features", "nodes"):
        read = geopandas.read_parquet(folder / f"{table}.parquet")
        assert read.geometry.is_valid.all() and read.crs is not None
        found[table][folder.name] = len(read)
    found["edges"][folder.name] = len(pandas.read_parquet(folder / "edges.parquet"))
print(json.dumps(found))
"""


def _request(out: Path, into: Path, **changes: object) -> ReleaseRequest:
    asked = {
        "regions": (GRID, RIVERSIDE),
        "suites": ("clean", "alias"),
        "split": "crossfit",
        "with_truth": False,
    }
    return ReleaseRequest(**(asked | changes), out=out, into=into)


def _release(out: Path, into: Path, **changes: object) -> Release:
    return make_release(_request(out, into, **changes))


@pytest.fixture(scope="module")
def source(tasks: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Root of what is built, with a preview on one of its maps."""
    out = Path(shutil.copytree(tasks, tmp_path_factory.mktemp("source") / "out"))
    folder = out / "regions" / GRID
    manifest = read_manifest(folder)
    write_preview(
        folder / "preview.png", manifest=manifest, overview=read_overview(folder / "layers.tif", longest_cells=600)
    )
    files = {**manifest.files, "preview.png": file_record(folder / "preview.png")}
    write_manifest(folder, manifest.model_copy(update={"files": files}))
    return out


@pytest.fixture(scope="module")
def written(source: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A release with the truths of all queries."""
    into = tmp_path_factory.mktemp("released") / FOLDER
    _release(source, into, with_truth=True)
    return into


def _files(folder: Path) -> Iterator[Path]:
    return (path for path in sorted(folder.rglob("*")) if path.is_file())


def _python(code: str, folder: Path, *words: str) -> str:
    """Run a program in a folder, as a stranger without network would."""
    environment = {
        "PATH": os.environ["PATH"],
        "HOME": str(folder.parent),
        "HF_HUB_OFFLINE": "1",
        "HF_DATASETS_DISABLE_PROGRESS_BARS": "1",
    }
    done = subprocess.run(  # noqa: S603 - our own program
        [sys.executable, "-c", code, *words],
        cwd=folder,
        env=environment,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    return done.stdout


# --- imagery --------------------------------------------------------------------------------------------------------


def _with_imagery(source: Path, out: Path, *, publish: bool) -> Path:
    """Copy a root, and give one of its maps a picture."""
    out = Path(shutil.copytree(source, out))
    folder = out / "regions" / RIVERSIDE
    manifest = read_manifest(folder)
    west, _, _, north = manifest.bounds_m
    pixels = np.random.default_rng(0).integers(1, 250, (3, 128, 128), dtype=np.uint8)
    write_picture(out / "a.tif", pixels, crs=f"EPSG:{manifest.epsg}", transform=Affine(1, 0, west, 0, -1, north))
    entry = ImageryEntry(
        file="a.tif",
        sha256=("0" * 64,),
        date=dt.date(2024, 1, 1),
        licence="CC-BY-4.0",
        attribution="(c) a pilot",
        publish=publish,
    )
    picture = check_picture(out / "a.tif", entry, manifest.grid)
    grid = ortho_grid([picture], manifest.grid)
    write_ortho(folder / ORTHO, [picture], grid)
    record = OrthoRecord(
        pictures=(picture.record(),),
        gsd_m=grid.cell_size_m,
        bounds_m=grid.bounds_m,
        rows=grid.rows,
        cols=grid.cols,
        share=0.5,
        offset=None,
    )
    files = {**manifest.files, ORTHO: file_record(folder / ORTHO)}
    write_manifest(folder, manifest.model_copy(update={"files": files, "imagery": record}))
    return out


def test_imagery_travels_with_its_own_licence_and_author(source: Path, tmp_path: Path) -> None:
    into = tmp_path / FOLDER
    _release(_with_imagery(source, tmp_path / "out", publish=True), into, regions=(RIVERSIDE,), suites=("clean",))
    note = (into / "imagery" / "README.md").read_text()
    assert f"| `regions/{RIVERSIDE}/ortho.tif` | a.tif | 2024-01-01 | CC-BY-4.0 | (c) a pilot |" in note
    assert "not under the ODbL" in (into / "README.md").read_text()
    with rasterio.open(into / "regions" / RIVERSIDE / ORTHO) as ortho:
        assert ortho.tags()["attribution"] == "(c) a pilot"
    (item,) = into.glob("stac/regions/*/*.json")
    asset = json.loads(item.read_text())["assets"]["ortho"]
    assert (asset["license"], asset["attribution"], asset["gsd"]) == ("CC-BY-4.0", "(c) a pilot (CC-BY-4.0)", 1.0)
    assert "ortho.tif" in (into / "croissant.json").read_text()


def test_imagery_that_must_not_be_passed_on_is_refused_before_anything_is_written(source: Path, tmp_path: Path) -> None:
    out, into = _with_imagery(source, tmp_path / "out", publish=False), tmp_path / FOLDER
    with pytest.raises(StoreError, match=r"ortho.tif holds a.tif, whose region file says publish = false"):
        _release(out, into, regions=(RIVERSIDE,), suites=("clean",))
    assert not into.exists()


# --- others load it -------------------------------------------------------------------------------------------------


def test_public_libraries_alone_load_every_file(written: Path, source: Path, tmp_path: Path) -> None:
    found = json.loads(_python(LOAD_ALL, written, str(tmp_path)).splitlines()[-1])
    drawn = {"clean": (RIVERSIDE,), "alias": (f"{GRID}+alias",)}
    for suite, maps in drawn.items():
        ids = [name for region in maps for name in task_files.Task.open(source / "tasks" / suite / region).ids()]
        assert found["rows"][f"{suite}/crossfit"] == ids
        assert found["rows"][f"{suite}-truth/crossfit"] == ids
        assert sum(count for path, count in found["queries"].items() if suite in path) == len(ids)
    for name in (GRID, RIVERSIDE, f"{GRID}+alias"):
        about = read_manifest(source / "regions" / name)
        assert found["layers"][name][0] == len(about.classes)
        assert found["layers"][name][1] > 0
        assert found["layers"][name][2] == f"EPSG:{about.epsg}"
        assert found["features"][name] == pq.read_metadata(source / "regions" / name / "features.parquet").num_rows
        assert min(found["nodes"][name], found["edges"][name]) > 0


def test_the_hub_reads_the_head_of_the_card(written: Path) -> None:
    data = DatasetCard.load(written / "README.md").data
    assert (data.license, data.size_categories) == ("odbl", ["n<1K"])
    assert "OpenStreetMap" in data.attribution
    assert [one["config_name"] for one in data.configs] == ["alias", "alias-truth", "clean", "clean-truth"]
    assert [one["config_name"] for one in data.configs if one.get("default")] == ["clean"]
    paths = [path for one in data.configs for files in one["data_files"] for path in files["path"]]
    assert len(paths) == 4
    assert all((written / path).is_file() for path in paths)


def test_the_command_of_the_guide_is_one_of_the_hub() -> None:
    text = (Path(__file__).parents[2] / "docs/howto/release.md").read_text(encoding="utf-8")
    (command,) = re.findall(r"^hf upload \S+ \S+ \. (--[a-z-]+) dataset$", text, flags=re.MULTILINE)
    shown = subprocess.run([Path(sys.executable).with_name("hf"), "upload", "--help"], capture_output=True, check=True)  # noqa: S603 - beside our own Python
    assert command in shown.stdout.decode()


def test_the_lines_of_the_card_run_and_show_what_our_own_code_sees(written: Path, tmp_path: Path) -> None:
    card = (written / "README.md").read_text(encoding="utf-8")
    blocks = re.findall(r"```python\n(.*?)```", card, flags=re.DOTALL)
    assert len(blocks) == 3
    blocked = 'import sys\nsys.modules["sasgeo_bench"] = None\n'
    saved = "\nnp.save(sys.argv[1], cells)\nprint(row['query_id'])"
    copied = Path(shutil.copytree(written, tmp_path / "copy"))
    given = _python(blocked + "\n".join(blocks) + saved, copied, str(tmp_path / "cells.npy"))
    table = re.search(r'read_parquet\("(tasks/[^"]+)"', card)[1]
    first = next(task_files.read_queries((written / table).parent))
    assert given.splitlines()[-1] == first.query_id
    np.testing.assert_array_equal(np.load(tmp_path / "cells.npy"), first.evidence.cells)


def test_a_footprint_keeps_to_the_sides_of_its_grid_between_its_points_too() -> None:
    # 20 km at 61 degrees north: a side drawn between its corners alone would bulge by 14 m.
    grid = Grid(epsg=32632, west_m=600_000.0, north_m=6_780_000.0, cell_size_m=100.0, rows=200, cols=200)
    outline = footprint(grid)
    assert outline.is_valid
    assert 10 < outline.centroid.x < 12
    assert 60 < outline.centroid.y < 62
    fine = shapely.get_coordinates(shapely.segmentize(outline, 0.001))
    back = pyproj.Transformer.from_crs(4326, grid.epsg, always_xy=True).transform(*fine.T)
    box = shapely.box(*grid.bounds_m)
    assert shapely.distance(box.exterior, shapely.points(*back)).max() < 0.5
    assert shapely.Polygon(np.column_stack(back)).area == pytest.approx(box.area, rel=1e-4)


def test_a_release_is_a_root_that_the_program_itself_runs_and_scores_on(written: Path, source: Path) -> None:
    folder, truth = written / "tasks/clean" / RIVERSIDE, written / "truth/clean" / RIVERSIDE
    assert replace(task_files.Task.open(folder), truth=truth).faults() == []
    replace(task_files.Task.open(folder), truth=truth).check_truths()
    assert list(task_files.read_truths(truth)) == list(task_files.read_truths(source / "truth/clean" / RIVERSIDE))
    request = RunRequest(spec="sasgeo_raster", tasks=(folder,), out=source)
    reach = reach_of(request, [written / "regions" / RIVERSIDE])
    assert written / "truth" in reach.hidden
    assert written / "regions" / GRID in reach.hidden


def test_a_matcher_cannot_see_a_release_beside_its_tasks_and_can_see_the_map_of_one_it_runs_on(source: Path) -> None:
    tasks, released = source / "tasks/clean" / RIVERSIDE, source / FOLDER / "tasks/clean" / RIVERSIDE
    hidden = reach_of(RunRequest(spec="x", tasks=(tasks,), out=source), [source / "regions" / RIVERSIDE]).hidden
    assert source.resolve() / FOLDER in hidden
    mapped = source / FOLDER / "regions" / RIVERSIDE
    hidden = reach_of(RunRequest(spec="x", tasks=(released,), out=source), [mapped]).hidden
    assert not any(mapped.resolve().is_relative_to(path) for path in hidden)


# --- validators -----------------------------------------------------------------------------------------------------


def test_rio_cogeo_finds_every_raster_valid(written: Path) -> None:
    rasters = list(written.glob("regions/*/layers.tif"))
    assert len(rasters) == 3
    for path in rasters:
        is_valid, faults, _ = cog_validate(path, quiet=True)
        assert (is_valid, faults) == (True, [])


# Fields of the extensions, after their pages: pystac holds the schemas of the core alone, and tests use no network.
FIELDS = {
    "type": "object",
    "required": ["proj:code", "proj:shape", "proj:transform", "proj:bbox"],
    "properties": {
        "proj:code": {"type": "string", "pattern": "^EPSG:[0-9]+$"},
        "proj:shape": {"type": "array", "items": {"type": "integer"}, "minItems": 2, "maxItems": 2},
        "proj:transform": {"type": "array", "items": {"type": "number"}, "minItems": 6, "maxItems": 6},
        "proj:bbox": {"type": "array", "items": {"type": "number"}, "minItems": 4, "maxItems": 4},
    },
}
ASSET = {
    "type": "object",
    "required": ["href", "type", "roles", "file:size", "file:checksum"],
    "properties": {
        "file:size": {"type": "integer", "minimum": 1},
        "file:checksum": {"type": "string", "pattern": "^1220[0-9a-f]{64}$"},
    },
}


def test_pystac_finds_the_catalog_valid_and_its_links_lead_to_the_files(written: Path) -> None:
    catalog = pystac.Catalog.from_file(str(written / "stac/catalog.json"))
    collections, items = list(catalog.get_children()), list(catalog.get_items(recursive=True))
    assert [item.id for item in items] == [GRID, f"{GRID}+alias", RIVERSIDE]
    validator = JsonSchemaSTACValidator()
    for one in (catalog, *collections, *items):
        manifest = json.loads(Path(one.get_self_href()).read_text(encoding="utf-8"))
        assert validator.validate_core(manifest, one.STAC_OBJECT_TYPE, "1.1.0")
        outward = [link for link in manifest["links"] if link["rel"] != "license"]
        assert all(not re.match(r"[a-z]+:|/", link["href"]) for link in outward)
        assert [link["href"] for link in manifest["links"] if link["rel"] == "license"]
    for item in items:
        jsonschema.validate(item.properties, FIELDS)
        with rasterio.open(item.assets["layers"].get_absolute_href()) as layers:
            assert list(layers.shape) == item.properties["proj:shape"]
            assert list(layers.transform)[:6] == item.properties["proj:transform"]
            assert [band["name"] for band in item.assets["layers"].extra_fields["bands"]] == list(layers.descriptions)
        for asset in item.assets.values():
            jsonschema.validate(asset.to_dict(), ASSET)
            record = file_record(Path(asset.get_absolute_href()))
            assert asset.extra_fields["file:checksum"] == f"1220{record.sha256}"


def test_mlcroissant_finds_no_issue_and_loads_records_of_every_set(written: Path, source: Path) -> None:
    loaded = mlcroissant.Dataset(str(written / "croissant.json"))
    issues = loaded.metadata.ctx.issues
    assert (issues.errors, issues.warnings) == (set(), set())
    assert json.loads((written / "croissant.json").read_text())["conformsTo"] == "http://mlcommons.org/croissant/1.1"
    sets = [item.id for item in loaded.metadata.record_sets]
    maps = ["map-features", "map-nodes", "map-edges"]
    assert sets == ["alias", "alias-truth", "clean", "clean-truth", *maps]
    for name in sets:
        assert list(islice(loaded.records(name), 2)), name
    ids = [row["alias/query_id"].decode() for row in loaded.records("alias")]
    assert ids == task_files.Task.open(source / "tasks/alias" / f"{GRID}+alias").ids()
    hashes = {item.content_url: item.sha256 for item in loaded.metadata.file_objects}
    data = {
        path.relative_to(written).as_posix()
        for root in ("regions", "tasks", "truth")
        for path in _files(written / root)
    }
    assert set(hashes) == data
    assert all(file_record(written / path).sha256 == found for path, found in hashes.items())


def test_the_metadata_of_a_deposit_say_what_the_release_says(written: Path, source: Path, tmp_path: Path) -> None:
    content, index, croissant = (
        json.loads((written / name).read_text(encoding="utf-8"))
        for name in ("zenodo.json", "release.json", "croissant.json")
    )
    assert content["title"].endswith(index["version"])
    assert content["version"] == index["version"]
    assert content["publication_date"] == index["published"]
    assert content["license"] == "ODbL-1.0"
    assert content["creators"] == [{"name": croissant["creator"]["name"]}]
    assert content["description"] == croissant["description"]
    assert "related_identifiers" not in content
    _release(source, tmp_path / FOLDER, url="https://example.org/mine")
    content = json.loads((tmp_path / FOLDER / "zenodo.json").read_text(encoding="utf-8"))
    assert content["related_identifiers"] == [{"identifier": "https://example.org/mine", "relation": "isIdenticalTo"}]


def test_sha256sum_checks_every_file(written: Path) -> None:
    command = ["sha256sum", "-c", "--strict", "SHA256SUMS"]
    done = subprocess.run(command, cwd=written, capture_output=True, text=True, check=True)  # noqa: S603 - of PATH
    listed = {line.removesuffix(": OK") for line in done.stdout.splitlines()}
    assert listed == {path.relative_to(written).as_posix() for path in _files(written)} - {"SHA256SUMS"}


def test_a_source_of_a_map_beside_openstreetmap_is_named_with_it(source: Path, tmp_path: Path) -> None:
    out = Path(shutil.copytree(source, tmp_path / "out"))
    folder, further = out / "regions" / GRID, "building: a land survey (CC0-1.0)"
    manifest = read_manifest(folder)
    provenance = manifest.provenance.model_copy(update={"further_sources": further})
    stated = {"provenance": provenance, "attribution": provenance.credit}
    write_manifest(folder, manifest.model_copy(update=stated))
    _release(out, tmp_path / FOLDER, with_truth=True)
    texts = ("README.md", "LICENSE-ODbL.txt", "release.json", "stac/catalog.json", "zenodo.json", "datasheet.md")
    for name in (*texts, "croissant.json"):
        assert f"{ATTRIBUTION}; {further}" in (tmp_path / FOLDER / name).read_text(encoding="utf-8"), name
    own = OwnMapRecord(
        file="survey.geojson",
        sha256="0" * 64,
        bytes=1,
        date=None,
        classes=("building",),
        licence="all rights reserved",
        attribution="a land survey",
        publish=False,
        source=None,
    )
    write_manifest(folder, manifest.model_copy(update={"own_maps": (own,)}))
    with pytest.raises(StoreError, match=f"publish = false .*all rights reserved.*: leave {GRID} out"):
        _release(out, tmp_path / "kept", with_truth=True)


def test_every_file_names_its_source_and_licence_in_itself(written: Path) -> None:
    for path in _files(written):
        if path.suffix == ".tif":
            with rasterio.open(path) as raster:
                record = raster.tags()["attribution"]
        elif path.suffix == ".parquet":
            record = " ".join(value.decode() for key, value in pq.read_schema(path).metadata.items() if key != b"geo")
        elif path.suffix == ".png":
            record = Image.open(path).text["Copyright"]
        elif path.name == "SHA256SUMS":
            continue  # hashes alone, in the form that sha256sum reads
        else:
            record = path.read_text(encoding="utf-8")
        assert ATTRIBUTION in record, path


# --- what is in it --------------------------------------------------------------------------------------------------


def test_the_same_regions_and_tasks_give_the_same_bytes(written: Path, source: Path, tmp_path: Path) -> None:
    again = _release(source, tmp_path / "elsewhere" / "other", with_truth=True)
    names = [path.relative_to(written).as_posix() for path in _files(written)]
    same, other, lost = filecmp.cmpfiles(written, tmp_path / "elsewhere" / "other", names, shallow=False)
    assert (len(same), other, lost) == (len(names), [], [])
    assert len(again.files) < len(names)


def test_ground_is_counted_once_whatever_the_number_of_its_maps(written: Path) -> None:
    grid, riverside = (read_manifest(written / "regions" / name).grid for name in (GRID, RIVERSIDE))
    area_km2 = (grid.rows * grid.cols + riverside.rows * riverside.cols) / 1e6
    assert f"2 regions ({area_km2:.1f} km2, 2 of them made up by a program)" in (written / "datasheet.md").read_text()


def test_in_a_cross_fit_no_truth_is_released_unless_asked_for(source: Path, written: Path, tmp_path: Path) -> None:
    lines: list[str] = []
    with reporting(lines.append):
        make_release(_request(source, tmp_path / FOLDER))
    assert not (tmp_path / FOLDER / "truth").exists()
    assert (written / "truth/clean" / RIVERSIDE / "truth.parquet").is_file()
    assert any("their seed is so small that anyone can find it" in line for line in lines)
    everything = b"".join(path.read_bytes() for path in _files(tmp_path / FOLDER) if path.suffix in {".json", ".md"})
    assert b"request_sha256" not in everything
    assert b'"seed"' not in everything


def _rewritten(source: Path, out: Path, part_of: Callable[[int], str]) -> Path:
    """A root with the clean task of the town by the river in other parts of the split `holdout`."""
    shutil.copytree(source / "regions", out / "regions")
    folder = source / "tasks/clean" / RIVERSIDE
    queries, truths = task_files.read_queries(folder), task_files.read_truths(source / "truth/clean" / RIVERSIDE)
    pairs = [
        (replace(query, part=part_of(at)), truth) for at, (query, truth) in enumerate(zip(queries, truths, strict=True))
    ]
    kept = task_files.Task.open(folder).manifest.origin.model_copy(update={"split": "holdout"})
    put_task(iter(pairs), kept, task_files.TruthManifest(seed=10**30), out=out)
    return out


def test_parts_of_a_task_are_splits_of_their_own_and_test_truths_stay_back(source: Path, tmp_path: Path) -> None:
    out = _rewritten(source, tmp_path / "out", lambda at: ("train", "test")[at % 2])
    _release(out, tmp_path / FOLDER, regions=(RIVERSIDE,), suites=(), split="holdout")
    found = json.loads(_python(LOAD_ALL, tmp_path / FOLDER, str(tmp_path)).splitlines()[-1])
    ids = task_files.Task.open(out / "tasks/clean" / RIVERSIDE).ids()
    expected = {"clean/train": ids[::2], "clean/test": ids[1::2], "clean-truth/train": ids[::2]}
    assert found["rows"] == expected
    assert not list((tmp_path / FOLDER).rglob("truth-test*"))
    assert not list((tmp_path / FOLDER).rglob("task.json"))
    assert f"| `clean` | Rotation, scale and crop | `test` | {len(ids[1::2])} | 1 | kept back |" in (
        tmp_path / FOLDER / "README.md"
    ).read_text(encoding="utf-8")


def test_truths_of_training_places_are_released_and_have_to_be_there(source: Path, tmp_path: Path) -> None:
    out = _rewritten(source, tmp_path / "out", lambda _: "train")
    asked = {"regions": (RIVERSIDE,), "suites": ("clean",), "split": "holdout"}
    made = _release(out, tmp_path / FOLDER, **asked)
    assert f"truth/clean/{RIVERSIDE}/truth.parquet" in made.files
    shutil.rmtree(out / "truth")
    with pytest.raises(OSError, match=r"holds no truths of .*clean"):
        _release(out, tmp_path / FOLDER, **asked)


# --- what is refused, and what an accident leaves ---------------------------------------------------------------------


@pytest.fixture
def own(source: Path, tmp_path: Path) -> Path:
    """A root of one's own: a region and its clean task."""
    for folder in (f"regions/{RIVERSIDE}", f"tasks/clean/{RIVERSIDE}", f"truth/clean/{RIVERSIDE}"):
        shutil.copytree(source / folder, tmp_path / "out" / folder)
    return tmp_path / "out"


def _edit(path: Path, **changes: object) -> None:
    path.write_text(json.dumps(json.loads(path.read_text()) | changes))


OF_A_MAP = ("layers.tif", "features.parquet", "nodes.parquet", "edges.parquet")


@pytest.mark.parametrize(
    ("changes", "expected"),
    [
        ({"licence": ""}, "says no licence or no attribution, and a release must: build the region again"),
        ({"files": {}}, "is damaged (its files lack layers.tif): build the region again"),
        (
            {"files": {name: {"sha256": "0" * 64, "bytes": 1} for name in (*OF_A_MAP, "../stray")}},
            "is damaged (it names the file '../stray')",
        ),
        ({"licence": "  "}, "says no licence or no attribution"),
        ({"attribution": ""}, "says no licence or no attribution"),
        ({"licence": "CC-BY-4.0"}, "says licence 'CC-BY-4.0': a release holds data under ODbL-1.0 alone"),
        ({"fingerprint": "0" * 64}, f"{RIVERSIDE} was built anew since: make the queries again"),
    ],
)
def test_a_region_that_is_not_fit_is_refused(changes, expected, own, mistake):
    _edit(own / "regions" / RIVERSIDE / "region.json", **changes)
    assert expected in mistake("release", "--regions", RIVERSIDE, "--out", own)
    assert not (own / FOLDER).exists()


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        (
            ("--regions", RIVERSIDE, "--url", "javascript:alert(1)"),
            "--url is 'javascript:alert(1)': the address of a release begins with https:// or http://",
        ),
        (
            ("--regions", RIVERSIDE, "--url", 'https://x.org/"><script>'),
            "the address of a release begins with https://",
        ),
        (("--regions", RIVERSIDE, "--url", "https://x.org/\n- a"), "holds letters, digits and the signs of addresses"),
        (("--regions", "town-rivreside"), "there is no region 'town-rivreside', did you mean 'town-riverside'?"),
        (("--regions", "vaduz"), "holds no map of vaduz: sasgeo-bench build-region vaduz"),
        (("--regions", f"{RIVERSIDE}@2014-01-01"), "--regions takes ids as in 'vaduz'"),
        (("--regions", "../regions"), "there is no region '../regions'"),
        (("--regions", RIVERSIDE, "--suites", "occlusoin"), "did you mean 'occlusion'"),
        (("--regions", RIVERSIDE, "--suites", "occlusion"), f"holds no queries of occlusion on {RIVERSIDE}: "),
        (("--regions", RIVERSIDE, "--split", "holdout"), "was drawn by split 'crossfit', not by 'holdout'"),
        (("--regions", RIVERSIDE, "--split", "nowhere"), "there is no split 'nowhere'"),
        (("--regions", RIVERSIDE, "--into", "out/tasks/new"), "lies inside out/tasks, which others read"),
        (("--regions", RIVERSIDE, "--into", "out/segmenters/new"), "lies inside out/segmenters, which others read"),
        (("--regions", RIVERSIDE, "--into", "."), "that would be lost and are not part of a release"),
        (("--regions", RIVERSIDE, "--date", "yesterday"), "--date must be a date as in 2021-10-28"),
    ],
)
def test_a_request_that_makes_no_sense_gets_one_line(words, expected, own, mistake):
    del own
    assert expected in mistake("release", *words, "--out", "out")


def test_damaged_files_and_regions_without_queries_are_refused_and_nothing_is_written(own, program):
    def refusal() -> str:
        code, out, err = program("release", "--regions", RIVERSIDE, "--out", own)
        assert (code, out) == (2, "")
        return err.splitlines()[-1]

    raster = own / "regions" / RIVERSIDE / "layers.tif"
    whole = raster.read_bytes()
    raster.write_bytes(whole[:-1] + b"?")
    assert "layers.tif is not what region.json says: build the region again" in refusal()
    with rasterio.open(raster, "w", driver="GTiff", width=2000, height=2000, count=1, dtype="uint8"):
        pass
    assert "layers.tif is no cloud-optimized GeoTIFF" in refusal()
    raster.write_bytes(whole)
    (own / "regions" / RIVERSIDE / "nodes.parquet").unlink()
    assert "nodes.parquet is missing: " in refusal()
    shutil.rmtree(own / "tasks")
    assert "holds no queries of any suite on" in refusal()
    assert sorted(path.name for path in own.iterdir() if not path.name.startswith(".")) == ["regions", "truth"]


def test_an_older_release_is_replaced_and_a_strange_file_in_it_saved(own, program, mistake):
    words = ("release", "--regions", RIVERSIDE, "--out", own)
    code, out, _ = program(*words)
    assert (code, out.splitlines()[0].split(":")[1]) == (
        0,
        " 1 map, 32 queries of 1 suite, " + out.split(", ")[-1].strip(),
    )
    (own / FOLDER / "stac" / "mine.txt").write_text("mine")
    assert "holds 1 file (stac/mine.txt) that would be lost and are not part of a release" in mistake(*words)
    (own / FOLDER / "stac" / "mine.txt").unlink()
    os.mkfifo(own / FOLDER / "pipe")
    assert "1 file (pipe) that would be lost" in mistake(*words)
    (own / FOLDER / "pipe").unlink()
    assert program(*words, "--truth")[0] == 0
    assert (own / FOLDER / "truth").is_dir()
    (own / FOLDER / "README.md").write_text("changed by hand", encoding="utf-8")
    assert "README.md was changed since it was released, which would be lost" in mistake(*words)


def test_a_folder_of_another_program_with_files_of_the_same_names_is_saved(own, mistake):
    folder = own / "thesis"
    folder.mkdir()
    for name, text in (("thesis.tex", "years of work"), ("release.json", '{"version": "1.0"}')):
        (folder / name).write_text(text, encoding="utf-8")
    sums = [f"{sha256_of(folder / name)}  {name}\n" for name in ("thesis.tex", "release.json")]
    (folder / "SHA256SUMS").write_text("".join(sums), encoding="utf-8")
    given = mistake("release", "--regions", RIVERSIDE, "--out", own, "--into", folder)
    assert "(SHA256SUMS, release.json, thesis.tex) that would be lost" in given
    assert (folder / "thesis.tex").read_text(encoding="utf-8") == "years of work"


@pytest.mark.parametrize("name", ["C#", "what?", "two\nlines", "a b"])
def test_a_release_is_whole_whatever_its_folder_is_called(name, own, tmp_path):
    (tmp_path / "C").mkdir()
    (tmp_path / "C" / "catalog.json").write_text("mine", encoding="utf-8")
    _release(own, tmp_path / name / "release", regions=(RIVERSIDE,), suites=("clean",))
    assert {"catalog.json", "regions"} <= {path.name for path in (tmp_path / name / "release" / "stac").iterdir()}
    assert (tmp_path / "C" / "catalog.json").read_text(encoding="utf-8") == "mine"
    assert [path.name for path in (tmp_path / "C").iterdir()] == ["catalog.json"]


def test_links_in_a_circle_and_folders_that_cannot_be_are_one_line(own, mistake, tmp_path):
    (tmp_path / "loop").symlink_to("loop")
    (tmp_path / "file").touch()
    words = ("release", "--regions", RIVERSIDE, "--out", own, "--into")
    assert "is a file or a link" in mistake(*words, tmp_path / "loop")
    assert "loop/x cannot be looked into (Too many levels of symbolic links)" in mistake(
        *words, tmp_path / "loop" / "x"
    )
    assert "file is a file: name another folder" in mistake(*words, tmp_path / "file" / "x")
    assert "/proc/x cannot be written" in mistake(*words, "/proc/x")
    assert "/proc is a mount point" in mistake(*words, "/proc")


@pytest.mark.parametrize("fault", [OSError(errno.ENOSPC, "No space left on device"), KeyboardInterrupt()])
def test_an_accident_leaves_the_old_release_whole(fault, own, monkeypatch):
    asked = {"regions": (RIVERSIDE,), "suites": ("clean",)}
    _release(own, own / FOLDER, **asked)
    before = {path: path.read_bytes() for path in _files(own / FOLDER)}

    def fail(*_: object) -> None:
        raise fault

    monkeypatch.setattr(release_module, "write_sums", fail)
    with pytest.raises((OSError, KeyboardInterrupt)) as caught:
        _release(own, own / FOLDER, **asked, with_truth=True)
    message = (
        "(No space left on device): check the free space and your rights, and release again; a release that was there"
    )
    assert isinstance(fault, KeyboardInterrupt) or message in str(caught.value)
    assert {path: path.read_bytes() for path in _files(own / FOLDER)} == before
    assert sorted(path.name for path in own.iterdir() if "partial" in path.name or "replaced" in path.name) == []


def test_a_folder_that_is_a_file_or_a_link_is_refused(tmp_path):
    (tmp_path / "file").write_text("mine")
    (tmp_path / "link").symlink_to(tmp_path)
    for name in ("file", "link"):
        with (
            pytest.raises(OSError, match="is a file or a link: move it away"),
            open_release(tmp_path / name),
        ):
            pass


def test_without_the_extra_one_line_names_it(own, mistake, monkeypatch):
    monkeypatch.setattr(release_module, "find_spec", lambda name: None if name == "pystac" else object())
    assert mistake("release", "--regions", RIVERSIDE, "--out", own).endswith(
        "a release needs pystac: pip install 'sasgeo-bench[publish]'"
    )


def test_queries_with_pictures_are_refused_and_told_what_to_do_instead(own, mistake):
    path = own / "tasks/clean" / RIVERSIDE / "queries.parquet"
    table = pq.read_table(path)
    lens = Intrinsics.from_field_of_view(horizontal_deg=60.0, width_px=8, height_px=8)
    camera = Camera.pointed(intrinsics=lens, east_m=0.0, north_m=0.0, height_m=80.0, yaw_deg=0.0)
    images = pa.array([[frame_row(Frame(picture=b"webp", camera=camera))], *[None] * (len(table) - 1)], pa.list_(FRAME))
    at = table.schema.get_field_index("frames")
    pq.write_table(table.set_column(at, table.schema.field(at), [images]), path)
    given = mistake("release", "--regions", RIVERSIDE, "--out", own)
    assert "holds pictures, and a release holds none so far: name the other suites with --suites" in given
