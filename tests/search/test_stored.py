# SPDX-License-Identifier: Apache-2.0
"""Levels on disk are those made in memory, whatever the windows; a search on either finds the same."""

import os
import re
import shutil

import numpy as np
import pytest

from sasgeo_bench.core.errors import ShapeError, StoreError
from sasgeo_bench.geometry.grid import Grid
from sasgeo_bench.geometry.pose import Prior
from sasgeo_bench.search.field import FULL, Field, Template
from sasgeo_bench.search.find import rank, search
from sasgeo_bench.search.stored import StoredField, store_levels

ROWS, COLS, WINDOW = 150, 203, 64
GRID = Grid(epsg=32632, west_m=400.0, north_m=800.0, cell_size_m=2.0, rows=ROWS, cols=COLS)
FACTORS = (1, 2, 4, 8)
ANYWHERE = Prior(center_m=None, radius_m=None, yaw_deg=None, yaw_sigma_deg=None, scale_sigma=0.0)


@pytest.fixture(scope="module")
def whole():
    """A thin class, a wide one, one that the map lacks; nothing is mapped in two windows."""
    rng = np.random.default_rng(3)
    layers = np.zeros((3, ROWS, COLS), np.uint8)
    layers[0][rng.random((ROWS, COLS)) < 0.02] = FULL
    layers[1, 40:140, 70:190] = rng.integers(100, FULL, (100, 120))
    known = np.full((ROWS, COLS), FULL, np.uint8)
    known[:WINDOW, : 2 * WINDOW] = 0
    layers[:, known == 0] = 0
    return Field.of(grid=GRID, layers=layers, known=known)


def part_of(whole):
    """What paints a window of a map; windows in which nothing is mapped are left out."""
    asked = []

    def paint(window):
        asked.append(window)
        row, col = round((GRID.north_m - window.north_m) / 2.0), round((window.west_m - GRID.west_m) / 2.0)
        cut = np.s_[row : row + window.rows, col : col + window.cols]
        known = whole.known[cut].copy()
        return Field.of(grid=window, layers=whole.layers[:, *cut].copy(), known=known) if known.any() else None

    return paint, asked


def stored_in(folder, whole, **changes):
    paint, asked = part_of(whole)
    return store_levels(folder, GRID, 3, paint, **{"factors": FACTORS, "window_cells": WINDOW, **changes}), asked


@pytest.fixture(scope="module")
def stored(tmp_path_factory, whole):
    return stored_in(tmp_path_factory.mktemp("levels") / "map", whole)[0]


@pytest.mark.parametrize("factor", FACTORS)
def test_a_level_on_disk_is_the_one_made_in_memory(stored, whole, factor):
    found, expected = stored.level(factor), whole.level(factor)
    np.testing.assert_array_equal(found.cells.fours, expected.cells.fours)
    np.testing.assert_array_equal(found.thinner, expected.thinner)
    assert (found.grid, found.factor) == (expected.grid, expected.factor)
    assert isinstance(found.cells.fours.base, np.memmap)
    assert factor < 8 or (found.thinner[0] < 0.5 and found.thinner[[1, 3]].tolist() == [1.0, 1.0])  # thin and wide


@pytest.fixture(scope="module")
def view(whole):
    seen = whole.layers[:, 60:100, 80:120].astype(np.float32) / FULL
    return Template(weights=2 * seen - 0.3, known=-0.3 * seen.sum(axis=0), cell_size_m=2.0)


def test_a_search_on_stored_levels_finds_what_it_finds_in_memory(stored, whole, view):
    found = search(stored, view, ANYWHERE)
    assert found == search(whole, view, ANYWHERE)
    assert len(found.modes) > 3
    poses = [mode.pose for mode in found.modes[:3]]
    assert rank(stored, view, ANYWHERE, poses) == rank(whole, view, ANYWHERE, poses)


def test_levels_of_the_same_key_are_opened_and_others_are_made_anew(tmp_path, whole):
    first, asked = stored_in(tmp_path / "map", whole, key="a")
    again, none = stored_in(tmp_path / "map", whole, key="a")
    assert (again, len(asked), none) == (first, 12, [])
    other, anew = stored_in(tmp_path / "map", whole, key="b")
    assert (other.key, anew) == ("b", asked)
    assert [path.name for path in tmp_path.iterdir() if not path.name.endswith(".lock")] == ["map"]


def test_levels_replace_no_files_of_others(tmp_path, whole):
    stored_in(tmp_path / "map", whole, key="a")
    (tmp_path / "map" / "notes.txt").touch()
    (tmp_path / "other").mkdir()
    (tmp_path / "other" / "levels.json").write_text('{"key": "b"}', encoding="utf-8")
    (tmp_path / "file").touch()
    for name, words in (("map", "notes.txt"), ("file", "is no folder")):
        with pytest.raises(StoreError, match=words):
            stored_in(tmp_path / name, whole, key="b")
    with pytest.raises(StoreError, match="damaged"):
        stored_in(tmp_path / "other", whole, key="b")
    assert (tmp_path / "map" / "notes.txt").is_file()


def test_windows_that_cut_cells_and_levels_that_are_not_stored_are_refused(tmp_path, whole, stored):
    with pytest.raises(ShapeError, match=r"windows of 60 cells cut cells of the levels \[8\]: name a multiple"):
        stored_in(tmp_path / "map", whole, window_cells=60)
    assert not (tmp_path / "map").exists()
    with pytest.raises(StoreError, match="holds the levels 1, 2, 4, 8, not 16: search for a smaller view"):
        stored.level(16)


def test_what_is_cut_off_leaves_the_levels_as_they_were(tmp_path, whole):
    first, _ = stored_in(tmp_path / "map", whole, key="a")

    def paint(_):
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        store_levels(tmp_path / "map", GRID, 3, paint, key="b")
    assert StoredField.open(tmp_path / "map") == first


@pytest.mark.parametrize(
    ("name", "spoil", "words"),
    [
        ("levels.json", lambda _: b"{", "damaged"),
        ("levels.json", lambda _: b"[]", "damaged"),
        ("levels.json", lambda _: b'{"grid": {}, "key": "", "thinner": {"1": []}}', "damaged"),
        ("levels.json", lambda data: data.replace(b"1.0]", b"1e308]"), "are no shares"),
        ("levels.json", lambda data: data.replace(b"1.0]", b'"nan"]'), "are no shares"),
        ("levels.json", lambda data: re.sub(rb'"thinner": {.*?}', b'"thinner": {}', data), "lists no level 1"),
        ("levels.json", lambda data: data.replace(b'"rows": 150', b'"rows": 151'),
         r"level-1.npy has uint8 of shape \(1, 150, 203, 4\), expected uint8 of \(1, 151, "),
        ("level-4.npy", lambda _: b"", "damaged"),
        ("level-4.npy", None, "damaged"),
        ("level-2.npy", lambda _: b"\x93NUMPY\x01\x00v\x00" + b"(" * 118, "TokenError"),
        ("level-2.npy", lambda _: b"PK\x03\x04 no archive", "magic string"),
        ("level-2.npy", lambda data: data + b"x", "longer than its cells"),
        ("level-2.npy", lambda data: data.replace(b"order': False", b"order': True "), "expected uint8"),
    ],
)  # fmt: skip
def test_levels_whose_bytes_are_damaged_are_reported_in_one_line(tmp_path, stored, name, spoil, words):
    path = shutil.copytree(stored.folder, tmp_path / "map") / name
    path.write_bytes(spoil(path.read_bytes())) if spoil else path.unlink()
    with pytest.raises(StoreError, match=words) as caught:
        StoredField.open(tmp_path / "map")
    assert "store the levels of the map again" in str(caught.value)
    assert len(str(caught.value).splitlines()) == 1


def test_a_pipe_in_place_of_a_level_is_refused_not_waited_for(tmp_path, stored):
    folder = shutil.copytree(stored.folder, tmp_path / "map")
    opened = StoredField.open(folder)
    (folder / "level-2.npy").unlink()
    os.mkfifo(folder / "level-2.npy")
    for read in (lambda: StoredField.open(folder), lambda: opened.level(2)):
        with pytest.raises(StoreError, match="it is a pipe"):
            read()
