# SPDX-License-Identifier: Apache-2.0
"""Regional extracts: the table names the one of a place, and a download is bounded, goes on, and comes whole or not."""

import http.server
import threading

import pytest
import shapely

from sasgeo_bench.core.errors import ExtractError
from sasgeo_bench.osm import locate, regional
from sasgeo_bench.osm.regional import download_regional, read_outline, regional_extracts, regional_extracts_of
from sasgeo_bench.osm.snapshot import read_header
from sasgeo_bench.osm.synthetic.town import TownPlan, write_town

PLACE = shapely.box(1.51, 42.50, 1.53, 42.52)  # in Andorra


@pytest.mark.parametrize(
    ("place", "name"),
    [
        ((1.52, 42.51), "europe/andorra"),
        ((-6.77, 62.01), "europe/faroe-islands"),
        ((9.52, 47.14), "europe/liechtenstein"),
        ((13.40, 52.52), "europe/germany/berlin"),
        ((-97.74, 30.27), "north-america/us/texas"),
        ((-157.86, 21.31), "north-america/us/hawaii"),
        ((178.44, -18.13), "australia-oceania/fiji"),
        ((-16.25, 28.47), "africa/canary-islands"),
        ((2.35, 48.86), "europe/france"),
        ((55.45, -20.88), "europe/france"),  # La Reunion
        ((120.386, 30.322), "asia/china/zhejiang"),
        ((139.69, 35.69), "asia/japan"),
    ],
)
def test_a_place_is_led_to_its_extract_and_its_continent(place, name):
    found = [item.name for item in regional_extracts_of(shapely.Point(place))]
    assert name in found[:3]
    assert "/" not in found[-1]


def test_boxes_are_boxes_and_states_and_provinces_lie_in_their_countries():
    boxes = {}
    for item in regional_extracts():
        west, south, east, north = item.box
        assert -180 <= west < east <= 180
        assert -90 <= south < north <= 90
        boxes.setdefault(item.name, []).append(shapely.box(*item.box))
    assert len(boxes) > 290
    for country in ("asia/china", "europe/germany"):
        (whole,) = boxes[country]
        parts = [box for name, found in boxes.items() if name.startswith(f"{country}/") for box in found]
        assert len(parts) > 15
        assert all(whole.buffer(0.15).covers(box) for box in parts)


def test_an_outline_has_rings_and_holes_and_anything_else_is_refused():
    text = (
        "x\n1\n 0 0\n 4 0\n 4 4\n 0 4\nEND\n2\n 8 0\n 9E+0 0\n 9 1\n 8 1\nEND\n!3\n 1 1\n 2 1\n 2 2\n 1 2\nEND\nEND\n"
    )
    area = shapely.box(0, 0, 4, 4).union(shapely.box(8, 0, 9, 1)).difference(shapely.box(1, 1, 2, 2))
    assert read_outline(text).equals(area)
    for wrong in ("", "<html>no such page</html>", "x\n1\n 0 here\nEND\nEND\n"):
        with pytest.raises(ExtractError, match="outline"):
            read_outline(wrong)


class _Provider(http.server.BaseHTTPRequestHandler):
    """Serves files by path, from where it is asked to; an answer to `broken` paths ends after half of the bytes."""

    files: dict[str, bytes]
    broken: set[str]
    asked: list[str]

    def log_message(self, *_):
        """Keep quiet."""

    def do_HEAD(self):
        self._answer(is_head=True)

    def do_GET(self):
        self._answer(is_head=False)

    def _answer(self, *, is_head):
        content = self.files.get(self.path, b"here" if self.path == "/" else None)
        if content is None:
            self.send_error(404)
            return
        begin = int((self.headers.get("Range") or "bytes=0-").removeprefix("bytes=").removesuffix("-"))
        self.asked.append(f"{self.path} {begin}" if not is_head else f"{self.path} head")
        self.send_response(206 if self.headers.get("Range") else 200)
        self.send_header("Content-Length", str(len(content) - begin))
        self.send_header("ETag", '"one"')
        self.end_headers()
        if not is_head:
            self.wfile.write(content[begin : len(content) // 2 if self.path in self.broken else None])


@pytest.fixture
def provider(tmp_path, monkeypatch):
    """Serve an extract of Andorra, and an outline of it, as the provider does; downloads go to a folder of the test."""
    town = tmp_path / "town.osm.pbf"
    write_town(TownPlan(morphology="suburb", seed=3, size_m=400.0, center_lonlat=(1.52, 42.51)), town)
    around = "\n".join(f" {lon} {lat}" for lon, lat in ((1.4, 42.4), (1.8, 42.4), (1.8, 42.7), (1.4, 42.7)))
    beside = around.replace("1.4", "1.7")
    files = {
        "/europe/andorra-latest.osm.pbf": town.read_bytes(),
        "/europe/andorra.poly": f"andorra\n1\n{around}\nEND\nEND\n".encode(),
        "/europe/spain.poly": f"spain\n1\n{beside}\nEND\nEND\n".encode(),
    }
    handler = type("Handler", (_Provider,), {"files": files, "broken": set(), "asked": []})
    monkeypatch.setattr(regional, "cache_folder", lambda: tmp_path / "cache")
    locate._server_answers.cache_clear()
    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), handler) as running:
        threading.Thread(target=running.serve_forever, daemon=True).start()
        monkeypatch.setattr(regional, "SERVER", f"http://127.0.0.1:{running.server_address[1]}")
        yield handler
        running.shutdown()


def test_a_download_is_named_by_the_day_of_its_content_and_nothing_else_is_left(provider, tmp_path):
    path = download_regional(PLACE, most_mb=10)
    stated = read_header(path).replicated_at
    assert path == tmp_path / "cache" / f"andorra-{stated.date() if stated else 'undated'}.osm.pbf"
    assert path.read_bytes() == provider.files["/europe/andorra-latest.osm.pbf"]
    assert [one.name for one in (tmp_path / "cache").iterdir()] == [path.name]


def test_the_outline_passes_over_a_neighbour_whose_box_holds_the_place(provider):
    provider.files["/europe/andorra.poly"], provider.files["/europe/spain.poly"] = (
        provider.files["/europe/spain.poly"],
        provider.files["/europe/andorra.poly"],
    )
    provider.files["/europe/spain-latest.osm.pbf"] = provider.files["/europe/andorra-latest.osm.pbf"]
    assert download_regional(PLACE, most_mb=10).name.startswith("spain-")


def test_what_broke_off_goes_on_where_it_ended(provider, tmp_path):
    file = "/europe/andorra-latest.osm.pbf"
    provider.broken.add(file)
    with pytest.raises(ExtractError, match="the same command goes on from there"):
        download_regional(PLACE, most_mb=10)
    assert [one.suffix for one in (tmp_path / "cache").iterdir()] == [".part"]
    provider.broken.clear()
    path = download_regional(PLACE, most_mb=10)
    assert path.read_bytes() == provider.files[file]
    assert f"{file} {len(provider.files[file]) // 2}" in provider.asked


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda _: None, "and at most 0 MB are downloaded"),
        (lambda files: files.pop("/europe/andorra-latest.osm.pbf"), "the server answered with status 404"),
    ],
)
def test_a_file_that_is_too_large_or_is_not_there_is_reported_and_leaves_nothing(change, words, provider, tmp_path):
    change(provider.files)
    with pytest.raises(ExtractError, match=words):
        download_regional(PLACE, most_mb=1e-6)
    assert list((tmp_path / "cache").glob("*.osm.pbf*")) == []


def test_a_server_that_does_not_answer_is_reported(monkeypatch):
    monkeypatch.setattr(regional, "SERVER", "http://127.0.0.1:1")
    with pytest.raises(ExtractError, match=r"127\.0\.0\.1:1 cannot be reached"):
        download_regional(PLACE, most_mb=10)
