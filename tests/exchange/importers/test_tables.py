# SPDX-License-Identifier: Apache-2.0
"""What an import writes: columns, nulls, places in both forms; whole or not at all."""

import datetime as dt
import json
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest

from sasgeo_bench.core.errors import DatasetError, StoreError
from sasgeo_bench.core.parquet import read_frame
from sasgeo_bench.exchange.importers.items import Item, Position, UtmPlaces
from sasgeo_bench.exchange.importers.kinds import IMPORTERS, read_dataset
from sasgeo_bench.exchange.importers.reports import score_ranking
from sasgeo_bench.exchange.importers.retrieval import read_ranking
from sasgeo_bench.exchange.importers.tables import ITEM_SCHEMA, import_folder, items_table, write_items, write_reports
from tests.exchange.importers import writers

ROLES = ("query", "gallery")


def row(table, name):
    return next(each for each in table.to_pylist() if each["item_id"] == name)


def test_a_set_without_places_has_null_in_their_columns(tmp_path):
    table = items_table(read_dataset(writers.write_university(tmp_path), "university-1652"))
    assert table.schema.equals(ITEM_SCHEMA)
    for name in ("longitude_deg", "easting_m", "epsg", "yaw_deg", "height_m", "taken_on", "west_deg", "group"):
        assert table[name].null_count == table.num_rows
    for name in ("item_id", "role", "view", "label", "attribution"):
        assert table[name].null_count == 0


def test_a_frame_has_its_place_in_degrees_and_metres_and_its_heading_in_both_norths(tmp_path):
    table = items_table(read_dataset(writers.write_visloc(tmp_path), "uav-visloc"))
    frame = row(table, "01/drone/01_0001.JPG")
    assert (frame["longitude_deg"], frame["latitude_deg"], frame["epsg"]) == (116.005, 29.715, 32650)
    found = UtmPlaces.of([Position(longitude_deg=116.005, latitude_deg=29.715)])
    assert (frame["easting_m"], frame["northing_m"]) == (found.easting_m[0], found.northing_m[0])
    assert frame["heading_deg"] == 350.0
    # West of the zone's middle (117 degrees) grid north lies 0.49 degrees west of true north.
    assert frame["yaw_deg"] == pytest.approx(350.0 + 0.995 * np.sin(np.radians(29.715)), abs=1e-3)
    assert (frame["pitch_deg"], frame["roll_deg"], frame["height_m"]) == (1.5, -2.5, 520.5)
    assert frame["taken_on"] == dt.date(2018, 10, 13)
    assert "Xu et al." in frame["attribution"]


def test_a_tile_has_its_ground(tmp_path):
    tile = row(items_table(read_dataset(writers.write_visloc(tmp_path), "uav-visloc")), "07_2_003_001.png")
    assert (tile["role"], tile["group"], tile["heading_deg"]) == ("gallery", "07", None)
    edges = [tile[f"{side}_deg"] for side in ("west", "south", "east", "north")]
    np.testing.assert_allclose(edges, (116.03, 29.70, 116.04, 29.71), atol=1e-9)


def test_the_file_says_where_it_is_from_and_is_the_same_each_time_and_an_item_has_a_name_of_one_line(tmp_path):
    dataset = read_dataset(writers.write_visloc(tmp_path / "set"), "uav-visloc")
    schema = pq.read_schema(write_items(tmp_path / "out", dataset))
    about = json.loads(schema.metadata[b"dataset"])
    assert (about["kind"], about["source"]) == ("uav-visloc", "https://github.com/IntelliSensing/UAV-VisLoc")
    assert about["notes"] == list(dataset.notes)
    assert str(tmp_path) not in json.dumps(about)
    dataset = read_dataset(writers.write_dense(tmp_path / "set", {"000000": (120.0, 30.0)}), "dense-uav")
    first, second = (write_items(tmp_path / name, dataset).read_bytes() for name in ("a", "b"))
    assert first == second
    with pytest.raises(DatasetError, match="one printable line"):
        Item(item_id="a\nb", role="query", view="drone")


def test_metrics_are_written_with_the_hash_of_their_ranking(tmp_path):
    dataset = read_dataset(writers.write_university(tmp_path / "set"), "university-1652")
    answers = {"test/query_drone/0001/0001.jpg": ["test/gallery_satellite/0001/0001.jpg"]}
    path = writers.write_ranking(tmp_path / "r.parquet", answers)
    reports = score_ranking(dataset, read_ranking([path], dataset.items))
    frame = read_frame(write_reports(tmp_path / "out", dataset, reports, rankings=["ab" * 32]), mend="")
    assert frame.attrs["rankings_sha256"] == ["ab" * 32]
    first = frame[frame.metric == "recall_1"].iloc[0]
    assert (first.query_view, first.gallery_view, first.queries, first.released) == ("drone", "satellite", 3, 1 / 3)
    assert frame[frame.metric == "ap"].released.tolist() == [1 / 3]
    assert np.isnan(frame[frame.metric == "recall_10"].released.item())


def test_nothing_is_written_into_the_folder_that_is_read(tmp_path):
    root = writers.write_university(tmp_path / "set")
    dataset = read_dataset(root, "university-1652")
    (tmp_path / "alias").symlink_to(root)
    for out in (root, root / "test", tmp_path / "alias" / "out"):
        with pytest.raises(DatasetError, match="lies in the folder that is read"):
            import_folder(out, dataset, source=root)
    assert import_folder(tmp_path, dataset, source=root) == tmp_path / "datasets" / "university-1652"


def test_a_table_that_cannot_be_written_leaves_the_old_one_and_no_scratch(tmp_path, monkeypatch):
    dataset = read_dataset(writers.write_university(tmp_path / "set"), "university-1652")
    before = write_items(tmp_path / "out", dataset).read_bytes()

    def fail(_, path):
        path.write_bytes(b"half")
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("sasgeo_bench.exchange.importers.tables.write_table", fail)
    with pytest.raises(StoreError, match="No space left"):
        write_items(tmp_path / "out", dataset)
    assert [path.name for path in (tmp_path / "out").iterdir()] == ["items.parquet"]
    assert (tmp_path / "out" / "items.parquet").read_bytes() == before


def test_the_guide_explains_every_column_and_metric(tmp_path):
    page = (Path(__file__).parents[3] / "docs" / "howto" / "other-datasets.md").read_text(encoding="utf-8")
    assert [name for name in ITEM_SCHEMA.names if f"`{name}`" not in page] == []
    for kind, root in (("uav-visloc", writers.write_visloc(tmp_path / "a")), ("dense-uav", dense(tmp_path / "b"))):
        dataset = read_dataset(root, kind)
        query, answer = (next(item.item_id for item in dataset.items if item.role == role) for role in ROLES)
        path = writers.write_ranking(tmp_path / "r.parquet", {query: [answer]})
        (report,) = score_ranking(dataset, read_ranking([path], dataset.items))
        kinds = {score.metric.rsplit("_", 1)[0] for score in report.scores} - {"logged"}
        assert [name for name in kinds if f"`{name}" not in page] == []
    assert all(f"`{kind}`" in page for kind in IMPORTERS)


def dense(root: Path) -> Path:
    return writers.write_dense(root, {"000000": (120.0, 30.0)})
