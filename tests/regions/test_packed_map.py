# SPDX-License-Identifier: Apache-2.0
"""A packed map is the region that it was packed from; whatever is no sound one is refused in one line."""

import io
import json
import os
import shutil
import tarfile
from pathlib import Path

import numpy as np
import pytest

from sasgeo_bench.core import folders
from sasgeo_bench.core.errors import ConfigError, StoreError
from sasgeo_bench.regions import packed_map
from sasgeo_bench.regions.packed_map import PackedMap, pack_map, unpack_map
from sasgeo_bench.regions.region_files import differing_files, read_manifest, read_region

TOWN = "town-grid"


@pytest.fixture(scope="module")
def region(towns: Path) -> Path:
    return towns / "regions" / TOWN


@pytest.fixture
def packed(region, tmp_path) -> Path:
    pack_map(region, tmp_path / "town.map")
    return tmp_path / "town.map"


def members(path: Path) -> dict[str, bytes]:
    with tarfile.open(path) as archive:
        return {one.name: archive.extractfile(one).read() for one in archive}


def write(path: Path, content: dict[str, bytes], *odd: tarfile.TarInfo) -> Path:
    """Write a tar archive of some files, and of members of other kinds."""
    with tarfile.open(path, "w") as archive:
        for name, data in content.items():
            about = tarfile.TarInfo(name)
            about.size = len(data)
            archive.addfile(about, io.BytesIO(data))
        for about in odd:
            archive.addfile(about)
    return path


def test_it_is_the_region_in_all_that_matching_reads(region, packed, tmp_path):
    folder = unpack_map(packed, tmp_path / "out").folder
    there, here = read_region(region), read_region(folder)
    assert folder.name == TOWN
    assert differing_files(folder) == []
    assert here.manifest.fingerprint == there.manifest.fingerprint
    assert here.manifest.inputs_sha256 == there.manifest.inputs_sha256
    np.testing.assert_array_equal(here.layers, there.layers)
    for name in ("nodes", "edges"):
        assert getattr(here.graph, name).equals(getattr(there.graph, name))
    assert here.features.equals(there.features)


def test_it_says_what_it_is_of_how_large_and_whom_to_name(region, packed):
    content = members(packed)
    about = json.loads(content.pop("map.json"))
    assert set(about["files"]) == set(content)
    assert about["region"] == TOWN
    assert about["km2"] == pytest.approx(4.194304)
    assert about["mb"] == pytest.approx(sum(map(len, content.values())) / 1e6)
    assert about["mb_per_km2"] == pytest.approx(about["mb"] / about["km2"], abs=1e-5)
    assert about["mb_per_km2"] < 2.0
    assert "OpenStreetMap contributors, ODbL" in about["attribution"]
    assert json.loads(content["region.json"])["extract"] == json.loads((region / "region.json").read_text())["extract"]


def test_the_same_region_gives_the_same_bytes(region, packed, tmp_path):
    pack_map(region, tmp_path / "again.map")
    assert (tmp_path / "again.map").read_bytes() == packed.read_bytes()
    pack_map(region, packed)  # over itself
    assert (tmp_path / "again.map").read_bytes() == packed.read_bytes()


def test_preview_and_imagery_stay_behind_unless_asked_for(own_out, tmp_path):
    folder = own_out / "regions" / TOWN
    path = folder / "region.json"
    about = json.loads(path.read_text())
    (folder / "preview.png").write_bytes(b"picture")
    about["files"]["preview.png"] = folders.file_record(folder / "preview.png").model_dump()
    path.write_text(json.dumps(about))
    assert pack_map(folder, tmp_path / "town.map").left_out == ("preview.png",)
    assert "preview.png" not in members(tmp_path / "town.map")
    assert differing_files(unpack_map(tmp_path / "town.map", tmp_path).folder) == []
    with pytest.raises(ConfigError, match="has no imagery: leave --with-imagery out"):
        pack_map(folder, tmp_path / "town.map", with_imagery=True)


def test_it_is_unpacked_once_and_anew_where_a_file_was_changed(packed, tmp_path):
    folder = unpack_map(packed, tmp_path).folder
    before = (folder / "layers.tif").stat().st_ino
    assert unpack_map(packed, tmp_path).folder == folder
    assert (folder / "layers.tif").stat().st_ino == before
    (folder / "nodes.parquet").write_bytes(b"changed")
    unpack_map(packed, tmp_path)
    assert differing_files(folder) == []


def test_two_maps_of_one_name_lie_apart(packed, tmp_path, towns):
    other = tmp_path / "other" / "town.map"
    renamed = shutil.copytree(towns / "regions" / "town-riverside", tmp_path / "other" / TOWN)
    pack_map(Path(renamed), other)
    first, second = (unpack_map(path, tmp_path / "out").folder for path in (packed, other))
    assert first.name == second.name
    assert read_manifest(first).fingerprint != read_manifest(second).fingerprint


def test_a_read_only_folder_serves_where_the_map_lies_unpacked(packed, tmp_path, monkeypatch):
    folder = unpack_map(packed, tmp_path / "out").folder

    def refuse(*_: object) -> None:
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr(packed_map, "locked", refuse)
    assert unpack_map(packed, tmp_path / "out").folder == folder
    with pytest.raises(
        StoreError, match=r"cannot be written \(Permission denied\): check the free space and your rights"
    ):
        unpack_map(packed, tmp_path / "elsewhere")


def test_a_full_disk_leaves_nothing_half_written(packed, tmp_path, monkeypatch):
    def full(*_: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(packed_map, "copyfileobj", full)
    with pytest.raises(StoreError, match=r"No space left on device.*name another folder by --out"):
        unpack_map(packed, tmp_path / "out")
    assert not [path for path in (tmp_path / "out").rglob("*") if path.is_file()]


def test_a_full_disk_leaves_the_earlier_map(region, packed, monkeypatch):
    before = packed.read_bytes()

    def full(*_: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(tarfile.TarFile, "addfile", full)
    with pytest.raises(StoreError, match="No space left on device"):
        pack_map(region, packed)
    assert packed.read_bytes() == before
    assert sorted(path.name for path in packed.parent.iterdir()) == ["town.map"]


def changed(content: dict[str, bytes], **changes: object) -> dict[str, bytes]:
    """Return the members with other words in map.json."""
    about = json.loads(content["map.json"]) | changes
    return content | {"map.json": json.dumps(about).encode()}


def link(name: str, kind: bytes = tarfile.SYMTYPE) -> tarfile.TarInfo:
    about = tarfile.TarInfo(name)
    about.type, about.linkname = kind, "/etc/passwd"
    return about


@pytest.mark.parametrize("share", [0.0, 0.001, 0.3, 0.99])
def test_a_file_that_was_cut_is_refused(packed, tmp_path, share):
    data = packed.read_bytes().rstrip(b"\0")
    packed.write_bytes(data[: int(share * len(data))])
    with pytest.raises(StoreError, match=r"town\.map is (no packed map, or was cut|damaged)"):
        unpack_map(packed, tmp_path / "out")
    assert not (tmp_path / "out").exists() or not [path for path in (tmp_path / "out").rglob("*") if path.is_file()]


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda it: changed(it, map_version=7), "of version 7, this program reads 1"),
        (lambda it: changed(it, region="../../home"), "damaged .*region"),
        (lambda it: changed(it, files={}), "does not list what a map is of"),
        (lambda it: changed(it, weights={"matcher": "mine", "trained_on": [], "pairs": 1}), "does not list what"),
        (lambda it: changed(it, nonsense=1), "unknown key 'nonsense'"),
        (lambda it: it | {"map.json": b"[]"}, "of version None"),
        (lambda it: it | {"map.json": b"{"}, "damaged"),
        (lambda it: {name: it[name] for name in reversed(it)}, "does not begin with map.json"),
        (lambda it: it | {"../../evil": b"x"}, "holds '../../evil': a packed map holds nothing but map.json"),
        (lambda it: it | {"/etc/evil": b"x"}, "holds '/etc/evil'"),
        (lambda it: it | {"nodes.parquet": it["edges.parquet"]}, "nodes.parquet is not what map.json says"),
        (lambda it: it | {"nodes.parquet": bytes(len(it["nodes.parquet"]))}, "nodes.parquet is not what"),
        (lambda it: it | {"ortho.tif": b"x"}, "ortho.tif is not what map.json says"),
        (lambda it: {name: it[name] for name in it if name != "layers.tif"}, "layers.tif is not what map.json says"),
        (lambda _: {"readme.txt": b"x"}, "holds 'readme.txt'"),
        (lambda _: {}, "no packed map"),
    ],
)
def test_whatever_else_it_holds_is_refused_and_nothing_is_left(packed, tmp_path, change, words):
    write(packed, change(members(packed)))
    with pytest.raises(StoreError, match=words):
        unpack_map(packed, tmp_path / "out")
    assert not (tmp_path / "out").exists() or not [path for path in (tmp_path / "out").rglob("*") if path.is_file()]


@pytest.mark.parametrize("odd", [link("layers.tif"), link("layers.tif", tarfile.LNKTYPE), link("x", tarfile.CHRTYPE)])
def test_links_and_devices_are_refused(packed, tmp_path, odd):
    content = members(packed)
    write(packed, {name: content[name] for name in content if name != "layers.tif"}, odd)
    with pytest.raises(StoreError, match="which is no plain file, or is there twice"):
        unpack_map(packed, tmp_path / "out")


def test_a_text_a_folder_and_a_pipe_of_that_name_are_refused(tmp_path):
    text, pipe = tmp_path / "text.map", tmp_path / "pipe.map"
    text.write_text("Liechtenstein")
    os.mkfifo(pipe)
    for path, words in ((text, "no packed map"), (pipe, "a pipe"), (tmp_path / "no.map", "No such file")):
        with pytest.raises(StoreError, match=words):
            unpack_map(path, tmp_path / "out")


def test_packing_replaces_nothing_but_a_packed_map(region, tmp_path):
    notes = tmp_path / "notes.map"
    notes.write_text("mine")
    with pytest.raises(StoreError, match=r"notes\.map is there, and is no packed map to replace"):
        pack_map(region, notes)
    assert notes.read_text() == "mine"
    with pytest.raises(ConfigError, match=r"a packed map is named \*\.map, as in .*town\.map"):
        pack_map(region, tmp_path / "town.tar")


def test_a_damaged_region_is_not_packed(own_out, tmp_path):
    folder = own_out / "regions" / TOWN
    (folder / "edges.parquet").write_bytes(b"damaged")
    with pytest.raises(StoreError, match=r"edges\.parquet is missing, or not what region\.json says"):
        pack_map(folder, tmp_path / "town.map")
    assert not (tmp_path / "town.map").exists()


def test_a_map_that_must_not_be_passed_on_says_so(packed):
    about = PackedMap.model_validate(json.loads(members(packed)["map.json"]))
    assert "must not be passed on" not in about.to_text()
    assert "must not be passed on" in about.model_copy(update={"publish": False}).to_text()


def test_inspect_and_verify_say_what_it_is(program, region):
    code, out, err = program("pack-map", region, "--into", "town.map")
    assert code == 0, err
    assert out.startswith("town.map: 0.")
    assert "MB a km2 of 4.19 km2" in out
    code, out, _ = program("verify", "town.map")
    assert (code, out.count("all files are as the manifest says")) == (0, 1)
    assert "MB a km2" in out
    code, out, _ = program("inspect", "town.map")
    assert code == 0
    assert out.startswith("town.map: 0.")
    assert "EPSG:" in out
