# SPDX-License-Identifier: Apache-2.0
"""Finding extracts: order of folders, hashes, download, and what is said when nothing is found."""

import datetime as dt
import hashlib
import http.server
import threading
from functools import partial

import pooch
import pytest

from sasgeo_bench.core.errors import ExtractError
from sasgeo_bench.core.folders import PREFIX
from sasgeo_bench.osm import locate
from sasgeo_bench.osm.locate import Extract, TownEntry, extract_folders, find_extract

CONTENT = b"not really map data"
SHA256 = hashlib.sha256(CONTENT).hexdigest()


@pytest.fixture(autouse=True)
def cache(tmp_path, monkeypatch):
    folder = tmp_path / "cache"
    monkeypatch.setattr(locate, "cache_folder", lambda: folder)
    monkeypatch.delenv("SASGEO_EXTRACTS", raising=False)
    locate._server_answers.cache_clear()
    return folder


def wanted(*, sha256: tuple[str, ...] = (SHA256,), urls: tuple[str, ...] = ()) -> Extract:
    return Extract(file="a.osm.pbf", date=dt.date(2020, 1, 1), sha256=sha256, urls=urls)


def put(folder, content=CONTENT):
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "a.osm.pbf").write_bytes(content)
    return folder


@pytest.fixture
def server(tmp_path):
    """Serves the folder `served`, which holds the extract, on this machine."""
    put(tmp_path / "served")
    handler = type("Handler", (http.server.SimpleHTTPRequestHandler,), {"log_message": lambda *_: None})
    serve = partial(handler, directory=str(tmp_path / "served"))
    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), serve) as running:
        threading.Thread(target=running.serve_forever, daemon=True).start()
        yield f"http://127.0.0.1:{running.server_address[1]}/a.osm.pbf"
        running.shutdown()


def test_folders_are_searched_in_order_given_then_variable_then_cache(tmp_path, monkeypatch, cache):
    monkeypatch.setenv("SASGEO_EXTRACTS", f"{tmp_path / 'b'}:{tmp_path / 'c'}")
    assert extract_folders([tmp_path / "a"]) == (tmp_path / "a", tmp_path / "b", tmp_path / "c", cache)
    for name in ("c", "b", "a"):
        put(tmp_path / name)
        assert find_extract(wanted(), folders=[tmp_path / "a"]).parent == tmp_path / name


def test_the_cache_is_asked_for_only_where_no_other_folder_has_the_file(tmp_path, monkeypatch):
    def refuse():
        raise AssertionError

    monkeypatch.setattr(locate, "cache_folder", refuse)
    assert find_extract(wanted(), folders=[put(tmp_path / "a")]).parent == tmp_path / "a"
    with pytest.raises(AssertionError):
        find_extract(wanted(), folders=[tmp_path / "b"])


def test_a_file_of_the_right_name_and_another_hash_is_passed_over(tmp_path):
    put(tmp_path / "wrong", b"other")
    put(tmp_path / "right")
    found = find_extract(wanted(sha256=("0" * 64, SHA256)), folders=[tmp_path / "wrong", tmp_path / "right"])
    assert found.parent.name == "right"


def test_what_is_not_found_is_reported_in_one_line_with_hashes_and_folders(tmp_path, cache):
    put(tmp_path / "wrong", b"other")
    with pytest.raises(ExtractError) as caught:
        find_extract(wanted(), folders=[tmp_path / "wrong"])
    assert SHA256 in str(caught.value)
    assert hashlib.sha256(b"other").hexdigest() in str(caught.value)
    with pytest.raises(ExtractError) as caught:
        find_extract(wanted(), folders=[tmp_path / "mine"])
    message = str(caught.value)
    assert "\n" not in message
    for word in ("a.osm.pbf", SHA256, str(tmp_path / "mine"), str(cache), "--extracts"):
        assert word in message


def test_a_download_lands_in_the_cache_and_is_found_there_next_time(server, cache):
    (cache / f"{PREFIX}download-dead").mkdir(parents=True)  # of a program that was killed meanwhile
    assert find_extract(wanted(urls=(server,))) == cache / "a.osm.pbf"
    assert find_extract(wanted()) == cache / "a.osm.pbf"
    assert [path.name for path in cache.iterdir()] == ["a.osm.pbf"]


def test_the_second_address_is_tried_where_the_first_fails(server, cache):
    assert find_extract(wanted(urls=("http://127.0.0.1:1/a.osm.pbf", server))).parent == cache


def test_offline_the_line_holds_no_words_of_a_library(cache):
    with pytest.raises(ExtractError, match=r"127\.0\.0\.1:1/a\.osm\.pbf cannot be reached") as caught:
        find_extract(wanted(urls=("http://127.0.0.1:1/a.osm.pbf",)))
    assert "Pool" not in str(caught.value)
    assert not cache.exists()


def test_a_name_whose_look_up_never_ends_is_given_up(monkeypatch):
    ends = threading.Event()
    monkeypatch.setattr(locate, "ANSWER_S", 0.05)
    monkeypatch.setattr(pooch, "HTTPDownloader", lambda **_: lambda *_, **__: ends.wait())
    try:
        assert not locate.answers("https://somewhere.invalid/a.osm.pbf")
    finally:
        ends.set()


TOWN = Extract(file="t.osm.pbf", date=dt.date(2020, 1, 1), town=TownEntry(morphology="grid", seed=1))


@pytest.mark.parametrize(
    ("extract_at", "words"),
    [
        (lambda url: wanted(sha256=("0" * 64,), urls=(url,)), "none of those accepted"),
        (lambda url: wanted(urls=(url + ".missing",)), "could not be downloaded: the server answered with status 404"),
        (lambda _: wanted(urls=("gopher://127.0.0.1/a.osm.pbf",)), "cannot be reached"),
        (lambda _: TOWN, "made by the build"),
    ],
)
def test_what_cannot_be_had_is_told_and_leaves_nothing(extract_at, words, server, cache):
    with pytest.raises(ExtractError, match=words):
        find_extract(extract_at(server))
    assert not cache.exists() or list(cache.iterdir()) == []
