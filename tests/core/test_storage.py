# SPDX-License-Identifier: Apache-2.0
"""Folders in object storage come back as they were sent, whatever is cut, damaged or forged on the way."""

import json
from contextlib import suppress
from pathlib import Path

import pytest

import sasgeo_bench as sgb
from sasgeo_bench.core import storage
from sasgeo_bench.core.errors import ConfigError, StoreError
from sasgeo_bench.core.storage import LIST, fetch, send

fsspec = pytest.importorskip("fsspec", reason="fsspec is not installed (make install brings it)")


@pytest.fixture(params=["memory", "file"])
def url(request, tmp_path):
    """A place that is empty, in memory and on a disk."""
    if request.param == "file":
        yield f"file://{tmp_path / 'bucket' / 'vaduz'}"
        return
    yield "memory://bucket/vaduz"
    system = fsspec.filesystem("memory")
    system.store.clear()
    system.pseudo_dirs[:] = [""]


@pytest.fixture
def folder(tmp_path):
    """A folder of some files, one of them deep, and what hides in it."""
    made = tmp_path / "vaduz"
    for name, text in {"region.json": "{}", "layers/a.tif": "a" * 5000, "layers/b.tif": "b", ".lock": ""}.items():
        (made / name).parent.mkdir(parents=True, exist_ok=True)
        (made / name).write_text(text, encoding="utf-8")
    return made


def contents(root):
    return {path.relative_to(root).as_posix(): path.read_bytes() for path in root.rglob("*") if path.is_file()}


def seen(folder):
    return {name: data for name, data in contents(folder).items() if not name.startswith(".")}


def place(url):
    """The file system of an URL, and the path there."""
    return fsspec.url_to_fs(url)


def test_what_is_sent_comes_back_and_only_what_changed_is_moved_again(url, folder, tmp_path):
    assert (sent := send(folder, url)).moved == sent.files == 3
    assert sent.bytes == 5003
    assert fetch(url, tmp_path / "here").moved == 3
    assert contents(tmp_path / "here") == seen(folder)
    assert send(folder, url).moved == fetch(url, tmp_path / "here").moved == 0
    (folder / "layers" / "b.tif").write_text("B", encoding="utf-8")
    (folder / "new.txt").write_text("new", encoding="utf-8")
    assert send(folder, url).moved == 2
    assert fetch(url, tmp_path / "here").moved == 2
    assert contents(tmp_path / "here") == seen(folder)
    assert sent.hidden == 1
    assert [path.name for path in tmp_path.iterdir() if path.name.startswith(".")] == []
    system, root = place(url)
    assert {Path(name).name for name in system.find(root)} == {"region.json", "a.tif", "b.tif", "new.txt", LIST}


def test_what_was_cut_goes_on_where_it_was_and_is_nothing_until_then(url, folder, tmp_path, monkeypatch):
    system, _ = place(url)
    put, get, moved = type(system).put_file, type(system).get_file, []

    def cut(move, most):
        def moving(self, first, second, **more):
            if len(moved) == most:
                raise ConnectionError("the line is dead")
            moved.append(first)
            return move(self, first, second, **more)

        return moving

    monkeypatch.setattr("sasgeo_bench.core.storage._FILES_AT_ONCE", 1)
    monkeypatch.setattr(type(system), "put_file", cut(put, 2))
    with pytest.raises(StoreError, match=r"cannot be reached \(the line is dead\)"):
        send(folder, url)
    with pytest.raises(StoreError, match="was not sent to its end"):
        fetch(url, tmp_path / "here")
    monkeypatch.setattr(type(system), "put_file", put)
    assert send(folder, url).moved == 1
    moved.clear()
    monkeypatch.setattr(type(system), "get_file", cut(get, 2))
    with pytest.raises(StoreError, match="the line is dead"):
        fetch(url, tmp_path / "here")
    assert not (tmp_path / "here").exists()
    monkeypatch.setattr(type(system), "get_file", get)
    assert fetch(url, tmp_path / "here").moved == 1
    assert contents(tmp_path / "here") == seen(folder)


@pytest.mark.parametrize("is_there", [False, True])
@pytest.mark.parametrize("at", ["Path.unlink", "replace_folder", "Path.rename 1", "Path.rename 2", "Path.rename 3"])
def test_a_fetch_that_is_killed_late_goes_on(url, folder, tmp_path, monkeypatch, at, is_there):
    """Killed: nothing of it runs any more, and no block is left as it should be."""
    send(folder, url)
    if is_there:
        fetch(url, tmp_path / "here")
        (folder / "layers" / "b.tif").write_text("B", encoding="utf-8")
        send(folder, url)
    name, _, number = at.partition(" ")
    calls = []

    class Killed(BaseException):
        pass

    def killing(really):
        def call(*given, **more):
            calls.append(given)
            if len(calls) == int(number or 1):
                raise Killed
            return really(*given, **more)

        return call

    with monkeypatch.context() as patch:
        owner, attribute = (Path, name[5:]) if name.startswith("Path.") else (storage, name)
        patch.setattr(owner, attribute, killing(getattr(owner, attribute)))
        with suppress(Killed):
            fetch(url, tmp_path / "here")
    assert fetch(url, tmp_path / "here").moved == 0 or not calls
    assert contents(tmp_path / "here") == seen(folder)
    assert [path.name for path in tmp_path.iterdir() if path.name.startswith(".") and "lock" not in path.name] == []


def test_what_a_fetch_left_of_a_folder_that_was_sent_anew_since_does_not_stay(url, folder, tmp_path):
    send(folder, url)
    left = tmp_path / ".here.whole"
    left.mkdir()
    (left / "older.txt").write_text("older", encoding="utf-8")
    fetch(url, tmp_path / "here")
    assert contents(tmp_path / "here") == seen(folder)
    assert not left.exists()


def test_a_file_that_is_not_what_was_sent_is_refused_and_the_folder_stays(url, folder, tmp_path):
    send(folder, url)
    fetch(url, tmp_path / "here")
    (folder / "layers" / "b.tif").write_text("B", encoding="utf-8")
    send(folder, url)
    system, root = place(url)
    system.pipe_file(f"{root}/layers/b.tif", b"x")
    with pytest.raises(StoreError, match=r"layers/b\.tif is not what was sent: remove that file there, and send"):
        fetch(url, tmp_path / "here")
    assert (tmp_path / "here" / "layers" / "b.tif").read_text(encoding="utf-8") == "b"
    system.rm_file(f"{root}/layers/b.tif")
    assert send(folder, url).moved == 1
    system.pipe_file(f"{root}/layers/a.tif", b"short")  # of another size: sent again without a word
    assert send(folder, url).moved == 1
    assert fetch(url, tmp_path / "here").moved == 1
    assert contents(tmp_path / "here") == seen(folder)


def test_storage_loses_nothing_of_others(url, folder, tmp_path):
    system, root = place(url)
    system.makedirs(root, exist_ok=True)
    system.pipe_file(f"{root}/thesis.txt", b"mine")
    with pytest.raises(StoreError, match=r"holds 1 file \(thesis\.txt\) of another folder"):
        send(folder, url)
    system.rm_file(f"{root}/thesis.txt")
    send(folder, url)
    system.pipe_file(f"{root}/notes", b"theirs")  # beside a folder that was sent, and in the way of a file
    (folder / "notes").write_text("mine", encoding="utf-8")
    with pytest.raises(StoreError, match=r"\(notes\) of another folder"):
        send(folder, url)
    assert system.cat_file(f"{root}/notes") == b"theirs"
    system.rm_file(f"{root}/notes")
    (tmp_path / "other").mkdir()
    (tmp_path / "other" / "task.json").write_text("{}", encoding="utf-8")
    with pytest.raises(StoreError, match=r"holds 3 files .* of another folder"):
        send(tmp_path / "other", url)
    (folder / "layers" / "a.tif").unlink()
    with pytest.raises(StoreError, match=r"layers/a\.tif"):  # an older copy loses nothing, either
        send(folder, url)
    assert fetch(url, tmp_path / "new").moved == 3


def test_markers_of_folders_as_consoles_make_them_are_no_files_of_others(folder, tmp_path, monkeypatch):
    url = "memory://bucket/marked"
    system, root = place(url)
    find = type(system).find
    markers = {f"{root}{end}": {"size": 0, "type": "file"} for end in ("/", "/layers/", "/layers_$folder$")}
    system.makedirs(root, exist_ok=True)
    monkeypatch.setattr(type(system), "find", lambda *given, **more: find(*given, **more) | markers)
    assert send(folder, url).moved == fetch(url, tmp_path / "here").moved == 3
    markers[f"{root}/thesis/"] = {"size": 4, "type": "file"}  # bytes, whatever their name
    with pytest.raises(StoreError, match="of another folder"):
        send(folder, url)
    monkeypatch.undo()
    system.rm(root, recursive=True)


def test_a_fetch_loses_nothing_of_others(url, folder, tmp_path):
    send(folder, url)
    (tmp_path / "here").mkdir()
    (tmp_path / "here" / "notes.txt").write_text("mine", encoding="utf-8")
    with pytest.raises(StoreError, match=r"holds 1 file \(notes\.txt\) that would be lost"):
        fetch(url, tmp_path / "here")
    (tmp_path / "file").write_text("mine", encoding="utf-8")
    (tmp_path / "link").symlink_to(tmp_path / "here")
    (tmp_path / "dangling").symlink_to(tmp_path / "nowhere")
    for name in ("file", "link", "dangling"):
        with pytest.raises(StoreError, match="is a link, or no folder, and would be lost"):
            fetch(url, tmp_path / name)
    (tmp_path / ".new.fetched").mkdir()
    (tmp_path / ".new.fetched" / "notes.txt").write_text("mine", encoding="utf-8")
    (tmp_path / ".far.fetched").symlink_to(tmp_path / "here")
    (tmp_path / ".old.fetched").write_text("mine", encoding="utf-8")
    for name in ("new", "far", "old"):
        with pytest.raises(StoreError, match="stands in the way, and is no fetch that was cut: move it away"):
            fetch(url, tmp_path / name)
    assert contents(tmp_path / "here") == {"notes.txt": b"mine"}
    assert contents(tmp_path / ".new.fetched") == {"notes.txt": b"mine"}
    assert (tmp_path / "file").read_text(encoding="utf-8") == "mine"


def test_what_a_fetch_of_another_folder_left_is_no_part_of_this_one(url, folder, tmp_path):
    send(folder, url)
    system, root = place(url)
    system.pipe_file(f"{root}/region.json", b"x")
    with pytest.raises(StoreError, match="is not what was sent"):
        fetch(url, tmp_path / "here")
    (tmp_path / "other").mkdir()
    (tmp_path / "other" / "layers").write_text("a file", encoding="utf-8")  # a folder there
    send(tmp_path / "other", f"{url}-other")
    fetch(f"{url}-other", tmp_path / "here")
    assert contents(tmp_path / "here") == {"layers": b"a file"}


@pytest.mark.parametrize(
    "name", ["../out.txt", "/etc/out.txt", "a//b", "a/../../b", ".hidden", "a\\b", "", "a\0b", "x" * 300, "layers"]
)
def test_a_list_that_leads_out_of_the_folder_is_refused(url, folder, tmp_path, name):
    send(folder, url)
    system, root = place(url)
    content = json.loads(system.cat_file(f"{root}/{LIST}"))
    content["files"][name] = content["files"].pop("region.json")
    system.pipe_file(f"{root}/{LIST}", json.dumps(content).encode())
    with pytest.raises(StoreError, match="which is no file of a folder: empty that place, and send") as refused:
        fetch(url, tmp_path / "here")
    assert "\n" not in str(refused.value)
    assert not (tmp_path / "here").exists()


@pytest.mark.parametrize("text", ["", "[]", "{", '{"made_by": "sasgeo-bench send"}', '{"made_by": "other"}', "\xff"])
def test_a_list_that_is_none_is_refused_in_a_line(url, tmp_path, folder, text):
    system, root = place(url)
    system.makedirs(root, exist_ok=True)
    system.pipe_file(f"{root}/{LIST}", text.encode("latin-1"))
    for work in (lambda: fetch(url, tmp_path / "here"), lambda: send(folder, url)):
        with pytest.raises(
            StoreError, match=r"sent\.json (is no list of files|lists nothing).*: empty that place"
        ) as refused:
            work()
        assert "\n" not in str(refused.value)


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        (("send", "vaduz", "nonsense://a/b"), "nonsense://a/b cannot be reached (Protocol not known"),
        (("send", "vaduz", "memory://"), "names no place in a storage"),
        (("send", "vaduz", "ftp://me:secret@127.0.0.1:1/a?token=secret"), "ftp://127.0.0.1:1/a cannot be reached"),
        (("send", "vaduz", "vaduz/layers/copy"), "would be sent into itself"),
        (("send", "nowhere", "memory://a/b"), "does not exist"),
        (("send", "vaduz/region.json", "memory://a/b"), "is no folder"),
        (("send", "vaduz/empty", "memory://a/b"), "holds no file to send"),
        (("send", "odd", "memory://a/b"), "holds 'a\\\\b', a name that no storage keeps"),
        (("fetch", "memory://nobody/sent", "/"), "/ is a mount point"),
        (("fetch", "memory://nobody/sent", "here"), "holds no folder that was sent"),
        (("fetch", "memory://nobody/sent", "vaduz/region.json/here"), "region.json is a file"),
    ],
)
def test_mistakes_are_reported_in_a_line(folder, mistake, monkeypatch, words, expected):
    monkeypatch.chdir(folder.parent)
    (folder / "empty").mkdir()
    (folder.parent / "odd").mkdir()
    (folder.parent / "odd" / "a\\b").write_text("", encoding="utf-8")
    assert expected in (line := mistake(*words))
    assert "secret" not in line


def test_a_link_is_not_sent_nor_without_its_package(folder, monkeypatch):
    (folder / "link").symlink_to("/etc/passwd")
    with pytest.raises(StoreError, match="is a link"):
        send(folder, "memory://bucket/linked")
    (folder / "link").unlink()
    monkeypatch.setitem(__import__("sys").modules, "fsspec", None)
    with pytest.raises(ConfigError, match="needs the package fsspec"):
        send(folder, "memory://bucket/vaduz")


def region_of(folder, name):
    folder.mkdir(parents=True)
    (folder / "region.json").write_text(json.dumps({"id": name}), encoding="utf-8")
    return folder


def test_one_region_does_not_replace_another(tmp_path, url):
    vaduz, town = (region_of(tmp_path / name, name) for name in ("vaduz", "town"))
    send(vaduz, url)
    with pytest.raises(StoreError, match="holds vaduz, and town would replace it: name another place, or empty that"):
        send(town, url)
    with pytest.raises(StoreError, match="town holds town, and vaduz would replace it: name another folder"):
        fetch(url, town)
    assert json.loads((town / "region.json").read_text(encoding="utf-8")) == {"id": "town"}
    (vaduz / "region.json").write_text(json.dumps({"id": "vaduz", "data_version": 3}), encoding="utf-8")
    assert send(vaduz, url).moved == 1
    assert fetch(url, tmp_path / "again").files == 1


def test_a_region_its_tasks_and_a_run_are_the_same_at_another_place(tmp_path, lay_towns, program):
    out, there = lay_towns(tmp_path / "out", "town-riverside"), tmp_path / "there"
    (task,) = sgb.make_tasks(suite="clean", regions="town-riverside", n=1, up_to=True, out=out)
    for name in ("regions/town-riverside", "tasks/clean/town-riverside", "truth/clean/town-riverside"):
        code, printed, _ = program("send", out / name, f"memory://out/{name}")
        assert (code, "sent" in printed) == (0, True)
        code, printed, _ = program("fetch", f"memory://out/{name}", there / name)
        assert (code, "fetched" in printed) == (0, True)
        assert contents(there / name) == seen(out / name)
    sgb.run(matcher="prior_centre", tasks=there / task.relative_to(out), out=there)
    send(there / "runs", "memory://out/runs")
    fetch("memory://out/runs", out / "runs")
    board = sgb.score(predictions=out / "runs", out=out, cases=False)
    assert board.scores.loc[board.scores["matcher"] == "prior_centre", "status"].eq("ok").all()
