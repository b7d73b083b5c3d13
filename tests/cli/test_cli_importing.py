# SPDX-License-Identifier: Apache-2.0
"""Commands about datasets of other benchmarks, as a user types them."""

import pyarrow.parquet as pq
import pytest

from tests.exchange.importers import writers

PLACES = {"000000": (120.38, 30.32), "000001": (120.381, 30.32), "002256": (119.5, 29.1)}


def test_import_writes_a_table_and_says_what_it_holds(program, tmp_path):
    writers.write_dense(tmp_path / "set", PLACES)
    code, out, err = program("import-dataset", "--kind", "dense-uav", "set")
    assert code == 0, err
    assert out == "out/datasets/dense-uav/items.parquet\n"
    assert "DenseUAV: 12 items (6 query, 6 gallery); Dai et al." in err
    assert "terms: " in err
    table = pq.read_table(tmp_path / out.strip())
    assert table.num_rows == 12
    assert sorted(path.name for path in (tmp_path / "out" / "datasets" / "dense-uav").iterdir()) == ["items.parquet"]


def test_a_ranking_is_scored_beside_it(program, tmp_path):
    writers.write_dense(tmp_path / "set", PLACES)
    gallery = [f"test/gallery_satellite/{label}/H80.tif" for label in PLACES]
    answers = {f"test/query_drone/{label}/H80.JPG": gallery for label in PLACES}
    writers.write_ranking(tmp_path / "ranking.parquet", answers)
    code, out, err = program(
        "import-dataset", "set", "--kind", "dense-uav", "--ranking", "ranking.parquet", "--out", "mine"
    )
    assert code == 0, err
    assert out.splitlines()[:2] == [f"mine/datasets/dense-uav/{name}.parquet" for name in ("items", "metrics")]
    assert "drone to satellite: 3 queries, 3 answered, 0 without a positive; gallery of 3" in out
    (recall,) = [line for line in out.splitlines() if line.startswith("recall_1 ")]
    assert recall.split()[1:3] == ["0.3333", "0.3333"]
    (other,) = [line for line in out.splitlines() if line.startswith("sdm_693m_1 ")]
    assert other.split()[1] == "-"
    assert pq.read_table(tmp_path / "mine/datasets/dense-uav/metrics.parquet").num_rows == 19


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        (("import-dataset", "set", "--kind", "dens-uav"), "did you mean 'dense-uav'?"),
        (("import-dataset", "nowhere", "--kind", "dense-uav"), "there is no folder nowhere"),
        (("import-dataset", "set", "--kind", "uav-visloc"), "holds no satellite_coordinates_range.csv"),
        (("import-dataset", "set"), "missing option '--kind'"),
        (("import-dataset", "--where", "set", "--kind", "sues-200"), "holds no satellite-view"),
    ],
)
def test_a_mistake_gets_one_line_and_nothing_is_written(mistake, tmp_path, words, expected):
    writers.write_dense(tmp_path / "set", PLACES)
    assert expected in mistake(*words)
    assert not (tmp_path / "out").exists()


def test_a_wrong_ranking_stops_an_import_before_anything_is_written(program, tmp_path):
    writers.write_dense(tmp_path / "set", PLACES)
    writers.write_ranking(tmp_path / "ranking.parquet", {"a\x1b[31m<b>": ["b"]})
    for path in ("ranking.parquet", "none.parquet"):
        code, out, err = program("import-dataset", "set", "--kind", "dense-uav", "--ranking", path)
        assert (code, out) == (2, "")
        assert "Traceback" not in err
        assert "\x1b" not in err
    assert not (tmp_path / "out").exists()


def test_markup_in_names_is_shown_as_it_is(program, tmp_path):
    root = writers.write_university(tmp_path / "set")
    writers.put(root / "test" / "query_drone" / "0000" / "[bold]<b>:smile:.jpg")
    code, _, err = program("import-dataset", "set", "--kind", "university-1652")
    assert code == 0, err
    names = pq.read_table(tmp_path / "out/datasets/university-1652/items.parquet")["item_id"].to_pylist()
    assert "test/query_drone/0000/[bold]<b>:smile:.jpg" in names


def test_locate_says_where_a_set_lies_and_what_covers_it(program, tmp_path):
    writers.write_dense(tmp_path / "set", PLACES | {"000002": (9.522, 47.15)})
    code, out, err = program("import-dataset", "--where", "--kind", "dense-uav", "set")
    assert code == 0, err
    assert "download.geofabrik.de" in err
    lines = out.splitlines()
    assert [line.split()[1] for line in lines[1:4]] == ["4", "4", "8"]
    assert "[9.5220, 47.1500]" in lines[1]
    assert "1.0 x 1.0" in lines[1]
    assert " vaduz " in lines[1]
    assert lines[1].split(" - ")[1].strip().startswith("europe/liechtenstein, ")
    assert lines[3].endswith("asia/china/zhejiang, asia/china, asia")
    assert not (tmp_path / "out").exists()


def test_a_set_without_coordinates_is_told_so(program, tmp_path):
    writers.write_university(tmp_path / "set")
    code, out, err = program("import-dataset", "--where", "--kind", "university-1652", "set")
    assert (code, out) == (2, "")
    assert err.splitlines()[-1] == ("sasgeo-bench: University-1652 has no coordinates: no extract can be named for it")
