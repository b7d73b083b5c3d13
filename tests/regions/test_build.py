# SPDX-License-Identifier: Apache-2.0
"""From a region file to a region directory, on embedded towns and, where they are, on real extracts."""

import datetime as dt
import errno
import json
import multiprocessing
import shutil
from dataclasses import replace
from pathlib import Path

import geopandas as gpd
import numpy as np
import pandas as pd
import pytest
import rasterio
import shapely
from shapely import affinity

from sasgeo_bench.core.errors import ConfigError, CoverageError, ExtractError, StoreError
from sasgeo_bench.core.folders import FileRecord
from sasgeo_bench.core.progress import reporting
from sasgeo_bench.osm.features import fingerprint
from sasgeo_bench.osm.read import Reading
from sasgeo_bench.regions import build, region_files
from sasgeo_bench.regions.build import build_made, build_region, plan_build
from sasgeo_bench.regions.evidence import PRESENT, LayerBits
from sasgeo_bench.regions.layers import OUTSIDE, read_bits
from sasgeo_bench.regions.region_files import differing_files, read_manifest, read_region
from sasgeo_bench.regions.region_spec import list_region_files, read_region_file
from tests.drawn_features import features_of
from tests.slow import rest_slow

TOWNS = ("town-grid", "town-old-town", "town-suburb", "town-industrial", "town-riverside", "town-agricultural")
FILES = {"region.json", "layers.tif", "features.parquet", "nodes.parquet", "edges.parquet", "preview.png"}


def spec_of(name: str, **changes: object):
    return read_region_file(list_region_files()[name]).model_copy(update=changes)


def small(name: str = "town-suburb", **changes: object):
    return spec_of(name, **({"size_m": (200.0, 150.0)} | changes))


def built(out: Path, spec, **options: object):
    plan = plan_build(spec, out=out, with_preview=True, **options)
    return plan, build_region(plan)


@pytest.fixture(scope="module")
def built_once(tmp_path_factory):
    """A root with the small region in it; read it, do not write to it."""
    out = tmp_path_factory.mktemp("small")
    built(out, small())
    return out


@pytest.fixture
def there(built_once, tmp_path):
    """The folder of the small region, built in the test's own root; and its manifest."""
    shutil.copytree(built_once, tmp_path, dirs_exist_ok=True)
    plan = plan_build(small(), out=tmp_path, with_preview=True)
    assert plan.is_current
    return plan, read_manifest(plan.folder)


@pytest.mark.parametrize("town", rest_slow(TOWNS, but=2))
def test_a_town_becomes_a_whole_region(town, tmp_path, lay_towns):
    folder = lay_towns(tmp_path, town) / "regions" / town
    assert {path.name for path in folder.iterdir()} == FILES - {"preview.png"}
    assert differing_files(folder) == []
    manifest, region = read_manifest(folder), read_region(folder)
    assert region.layers.shape == (len(region.classes), *region.grid.shape)
    assert ((region.layers <= PRESENT) | (region.layers == OUTSIDE)).all()
    assert fingerprint(region.features) == manifest.fingerprint
    assert manifest.counts == {name: int((region.features["class"] == name).sum()) for name in region.classes}
    assert (region.layer("building") == 1).any()
    assert {"intersection", "building"} <= set(region.graph.nodes["kind"])


def test_what_lies_beyond_the_town_is_unknown_not_absent(tmp_path, lay_towns):
    folder = lay_towns(tmp_path, "town-industrial") / "regions" / "town-industrial"
    manifest, region = read_manifest(folder), read_region(folder)
    outside = (region.layers == OUTSIDE).all(axis=0)
    assert 0.18 < outside.mean() < 0.24  # the town is 2048 m wide, the region 2304 m
    assert abs(1 - outside.mean() - manifest.coverage.share) < 0.002
    assert ((region.layers == OUTSIDE).any(axis=0) == outside).all()


def test_layers_that_are_read_as_bits_hold_the_same_cells_and_a_damaged_file_is_named(tmp_path):
    """The side is no multiple of the stripes that are read."""
    plan, _ = built(tmp_path, small(size_m=(60.0, 1100.0)))
    region, path = read_region(plan.folder), plan.folder / "layers.tif"
    bits = read_bits(path)
    np.testing.assert_array_equal(bits.bits, LayerBits.of(region.layers).bits)
    assert (bits.count, bits.bits.shape) == (len(region.classes), region.grid.shape)
    assert not bits.bits.flags.writeable
    path.write_bytes(path.read_bytes()[:2000])
    with pytest.raises(StoreError, match=r"layers\.tif cannot be read"):
        read_bits(path)


def test_layers_may_be_read_when_they_are_first_used_or_never(there):
    plan, _ = there
    whole, late, never = (read_region(plan.folder, with_layers=now) for now in (True, False, False))
    for name in whole.classes:
        np.testing.assert_array_equal(late.layer(name), whole.layer(name))
    np.testing.assert_array_equal(late.known(), (whole.layers <= PRESENT).all(axis=0))
    assert callable(vars(late)["layers"])  # has not been read: a layer is read alone
    assert not late.layer("building").flags.writeable
    np.testing.assert_array_equal(late.layers, whole.layers)
    (plan.folder / "layers.tif").unlink()
    np.testing.assert_array_equal(late.layer("building"), whole.layer("building"))
    assert len(never.features) == len(whole.features)
    for read in (lambda: never.layers, never.known, lambda: never.layer("building")):
        with pytest.raises(StoreError, match="build the region again"):
            read()


def test_a_map_on_the_way_to_queries_has_no_preview_until_one_is_wanted_and_it_alone_is_drawn(tmp_path, there):
    whole, _ = there
    out = tmp_path / "other"
    plan = plan_build(small(), out=out)
    build_region(plan)
    before = {path.name: path.stat().st_mtime_ns for path in plan.folder.iterdir()}
    assert set(before) == FILES - {"preview.png"}
    assert plan_build(small(), out=out).is_current
    shown, _ = built(out, small())
    assert not shown.is_current
    after = {path.name: path.stat().st_mtime_ns for path in plan.folder.iterdir()}
    assert {name for name in after if after[name] != before.get(name)} == {"preview.png", "region.json"}
    for name in FILES:
        assert (plan.folder / name).read_bytes() == (whole.folder / name).read_bytes(), name
    assert plan_build(small(), out=out).is_current


def test_every_file_carries_the_attribution(there):
    plan, manifest = there
    words = "(c) OpenStreetMap contributors, ODbL"
    assert manifest.attribution == words
    with rasterio.open(plan.folder / "layers.tif") as layers:
        assert words in layers.tags().values()
    assert words.encode() in (plan.folder / "preview.png").read_bytes()
    for name in ("features", "nodes", "edges"):
        assert words.encode() in (plan.folder / f"{name}.parquet").read_bytes()


def test_the_tables_open_with_pandas_and_geopandas_alone(there):
    plan, manifest = there
    features = gpd.read_parquet(plan.folder / "features.parquet")
    assert features.crs.to_epsg() == manifest.epsg
    edges = pd.read_parquet(plan.folder / "edges.parquet")
    nodes = gpd.read_parquet(plan.folder / "nodes.parquet")
    assert edges["source"].isin(nodes["id"]).all()


def test_a_second_build_is_skipped_and_says_so(there, tmp_path):
    plan, _ = there
    stamp = (plan.folder / "region.json").stat().st_mtime_ns
    lines: list[str] = []
    with reporting(lines.append):
        build_region(plan_build(small(), out=tmp_path))
    assert lines == ["town-suburb: up to date, nothing to do"]
    assert (plan.folder / "region.json").stat().st_mtime_ns == stamp


def test_a_changed_region_file_or_a_lost_layer_is_built_again(there, tmp_path):
    plan, _ = there
    assert not plan_build(small(cell_size_m=2.0), out=tmp_path).is_current
    assert plan_build(small(), out=tmp_path).is_current
    (plan.folder / "layers.tif").unlink()
    assert not plan_build(small(), out=tmp_path).is_current


def test_the_same_inputs_give_the_same_bytes(there, tmp_path):
    first, _ = there
    second, _ = built(tmp_path / "b", small())
    for name in FILES:
        assert (first.folder / name).read_bytes() == (second.folder / name).read_bytes(), name


def test_an_older_date_has_a_folder_of_its_own_and_one_that_is_none_is_refused(there, tmp_path):
    with pytest.raises(ConfigError, match="there are 2014-01-01"):
        plan_build(small(), out=tmp_path, date=dt.date(2000, 1, 1))
    old, _ = built(tmp_path, small(), date=dt.date(2014, 1, 1))
    new, _ = there
    assert plan_build(small(), out=tmp_path, date=dt.date(2025, 1, 1)).is_current
    assert (old.folder.name, new.folder.name) == ("town-suburb@2014-01-01", "town-suburb")
    assert read_manifest(old.folder).fingerprint != read_manifest(new.folder).fingerprint


@pytest.mark.parametrize("fault", [OSError(errno.ENOSPC, "No space left on device"), KeyboardInterrupt()])
def test_a_failure_on_the_way_leaves_the_old_region_as_it_was(there, tmp_path, monkeypatch, fault):
    plan, manifest = there

    def fail(*_: object, **__: object) -> None:
        raise fault

    monkeypatch.setattr(build, "write_layers", fail)
    with pytest.raises((StoreError, KeyboardInterrupt), match=r"No space left on device|^$"):
        built(tmp_path, small(cell_size_m=2.0))
    assert read_manifest(plan.folder) == manifest
    assert differing_files(plan.folder) == []
    assert [path.name for path in plan.folder.parent.iterdir() if ".partial" in path.name] == []


def test_a_build_killed_between_its_two_renames_is_taken_up(there, tmp_path):
    plan, _ = there
    plan.folder.rename(plan.folder.parent / ".town-suburb.replaced")
    (plan.folder.parent / ".town-suburb.partial").mkdir()
    built(tmp_path, small(cell_size_m=2.0))
    assert read_manifest(plan.folder).cell_size_m == 2.0
    assert sorted(path.name for path in plan.folder.parent.iterdir()) == ["town-suburb"]


def test_bounds_beyond_the_extract_say_what_it_covers(tmp_path):
    far = small(center_lonlat=(11.65, 48.65))
    plan = plan_build(far, out=tmp_path)
    moved = plan_build(far.model_copy(update={"center_lonlat": (11.8, 48.65)}), out=tmp_path)
    with pytest.raises(CoverageError, match="lie outside town-suburb"):
        # The town is made around its own centre, the grid lies eleven kilometres east of it.
        build_region(replace(plan, grid=moved.grid))
    assert not plan.folder.exists()


def test_a_manifest_of_another_schema_is_refused_and_built_again(there, tmp_path):
    plan, _ = there
    path = plan.folder / "region.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | {"schema_version": 0}))
    with pytest.raises(StoreError, match="schema version 0"):
        read_manifest(plan.folder)
    path.write_text("{}")
    with pytest.raises(StoreError, match=r"region\.json states no schema version, this version reads 1: build"):
        read_manifest(plan.folder)
    _, manifest = built(tmp_path, small())
    assert manifest.schema_version == 1


def test_a_file_of_another_size_is_refused_before_all_of_it_is_read(tmp_path, monkeypatch):
    with (tmp_path / "layers.tif").open("wb") as file:
        file.truncate(10**12)
    monkeypatch.setattr(region_files, "file_record", pytest.fail)
    with pytest.raises(StoreError, match=r"layers.tif is missing, or not what region.json says"):
        region_files._check_file(tmp_path / "layers.tif", FileRecord(sha256="0" * 64, bytes=1))


def test_a_manifest_without_its_files_or_of_other_cells_than_its_bounds_is_refused(there):
    plan, _ = there
    path = plan.folder / "region.json"
    sound = json.loads(path.read_text())
    for changes in ({"rows": 10**9}, {"cols": 1}, {"cell_size_m": 1e-6}, {"rows": 10**9, "cols": 10**9}, {"files": {}}):
        path.write_text(json.dumps(sound | changes))
        fault = "its files lack layers.tif" if "files" in changes else "it has .* cells, its bounds hold .*"
        with pytest.raises(StoreError, match=rf"is damaged \({fault}\): build the region again"):
            read_manifest(plan.folder)


def test_a_raster_of_another_size_than_the_manifest_says_is_refused(there):
    plan, _ = there
    path = plan.folder / "region.json"
    about = json.loads(path.read_text())
    west, _, east, north = about["bounds_m"]
    south = north - 10**9 * about["cell_size_m"]
    path.write_text(json.dumps(about | {"rows": 10**9, "bounds_m": [west, south, east, north]}))
    with pytest.raises(StoreError, match=r"layers.tif has layers, rows and columns .*: build the region again"):
        read_region(plan.folder)


@pytest.mark.parametrize("content", ["", "{", "[]", '{"schema_version": 1}', "[" * 100_000])
def test_a_damaged_manifest_is_reported_in_one_line(content, tmp_path):
    (tmp_path / "region.json").write_text(content)
    with pytest.raises(StoreError, match="build the region again") as caught:
        read_manifest(tmp_path)
    assert "\n" not in str(caught.value)


def test_verify_names_what_differs(there):
    plan, _ = there
    with (plan.folder / "edges.parquet").open("r+b") as file:
        file.write(b"????")
    (plan.folder / "nodes.parquet").unlink()
    (plan.folder / "stray.txt").write_text("?")
    (plan.folder / "preview.png").write_bytes(b"short")
    found = differing_files(plan.folder)
    for words in ("edges.parquet: SHA-256", "nodes.parquet: missing", "stray.txt: not in", "preview.png: 5 bytes"):
        (line,) = (line for line in found if line.startswith(f"{plan.folder}/{words}"))
        assert line.endswith(": move it away" if "stray" in words else ": build the region again")


def _build_in_process(out: str) -> None:
    build_region(plan_build(small(), out=Path(out)))


@pytest.mark.slow
def test_two_builds_of_one_region_at_once_both_end_well(tmp_path):
    context = multiprocessing.get_context("spawn")
    pair = [context.Process(target=_build_in_process, args=(str(tmp_path),)) for _ in range(2)]
    for process in pair:
        process.start()
    for process in pair:
        process.join()
    assert [process.exitcode for process in pair] == [0, 0]
    assert differing_files(tmp_path / "regions" / "town-suburb") == []


def generated(*houses: shapely.Polygon) -> Reading:
    """Houses that come from no extract, in the place of what is read from one."""
    return Reading(
        features=features_of(*({"class": "building", "geometry": house} for house in houses)),
        coverage=shapely.box(*small().grid().bounds_m),
        coverage_source="region file",
        osm_timestamp=None,
        drops={},
        hidden={},
        notes={},
        warnings=("made up",),
    )


def test_what_was_generated_becomes_a_region_that_says_so_and_is_built_once(tmp_path):
    west_m, south_m, *_ = small().grid().bounds_m
    flat, tall = shapely.box(0, 4, 20, 6), shapely.box(9, 0, 11, 10)  # of one centroid, and so of one fingerprint
    flat, tall = (affinity.translate(house, west_m + 10, south_m + 10) for house in (flat, tall))
    folder = build_made(small(), generated(flat), out=tmp_path)
    assert differing_files(folder) == []
    manifest = read_manifest(folder)
    assert (manifest.extract.bytes, manifest.warnings, manifest.counts["building"]) == (0, ("made up",), 1)
    assert (read_region(folder).layer("building") == 1).sum() == 40
    stamp = (folder / "region.json").stat().st_mtime_ns
    build_made(small(), generated(flat), out=tmp_path)
    assert (folder / "region.json").stat().st_mtime_ns == stamp
    build_made(small(), generated(tall), out=tmp_path)
    assert (read_region(folder).layer("building") == 1).sum() == 20


@pytest.mark.real
def test_vaduz_builds_from_the_real_extract(real_extracts, tmp_path):
    plan, manifest = built(tmp_path, spec_of("vaduz"), extract_folders=[real_extracts])
    assert differing_files(plan.folder) == []
    assert manifest.counts["building"] > 2500
    assert manifest.counts["railway"] > 0
    assert 0.8 < manifest.coverage.share < 0.95  # the south-west lies in Switzerland
    assert manifest.extract.osm_timestamp.date() == dt.date(2025, 9, 19)


@pytest.mark.real
def test_an_extract_changed_by_one_byte_is_refused(real_extracts, tmp_path):
    name = "dreieich-2022-10-16.osm.pbf"
    content = bytearray((real_extracts / name).read_bytes())
    content[-1] ^= 1
    (tmp_path / name).write_bytes(content)
    spec = spec_of("dreieich")
    offline = spec.model_copy(update={"extract": [item.model_copy(update={"urls": ()}) for item in spec.extract]})
    with pytest.MonkeyPatch.context() as patch:
        patch.delenv("SASGEO_EXTRACTS", raising=False)
        with pytest.raises(ExtractError, match="none of those accepted"):
            plan_build(offline, out=tmp_path, extract_folders=[tmp_path])


@pytest.mark.real
@pytest.mark.slow
@pytest.mark.parametrize("name", sorted(list_region_files()))
def test_every_shipped_region_builds_at_every_date(name, real_extracts, tmp_path):
    spec = spec_of(name)
    for extract in spec.extract:
        plan, manifest = built(tmp_path, spec, date=extract.date, extract_folders=[real_extracts])
        assert manifest.coverage.share > 0.15  # of two parts of a village: 0.155
        assert sum(manifest.counts.values()) > 20
        shutil.rmtree(plan.folder)
