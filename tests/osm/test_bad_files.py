# SPDX-License-Identifier: Apache-2.0
"""Extracts with something in them that cannot be: refused in one line, or left out and counted."""

import bz2
import datetime as dt
import gzip
import re
from pathlib import Path

import pytest

from sasgeo_bench.core.errors import ExtractError
from sasgeo_bench.geometry.grid import Grid
from sasgeo_bench.osm.history import DatedExtract, date_extracts, read_history
from sasgeo_bench.osm.read import read_extract
from sasgeo_bench.osm.snapshot import read_header

TOYTOWN = (Path(__file__).parents[1] / "data" / "toytown.osm").read_text(encoding="utf-8")
GRID = Grid.from_bounds(499_900, 5_205_000, 500_600, 5_205_700, cell_size_m=10, epsg=32632)


def changed(pattern: str, replacement: str) -> str:
    text, count = re.subn(pattern, replacement, TOYTOWN, count=1)
    assert count == 1
    return text


BAD = {
    **{f"{axis}-{value}": changed(f' {axis}="[^"]*"', f' {axis}="{value}"') for axis in ("lat", "lon")
       for value in ("nan", "1e9", "-inf", "", "abc", "48.1 ", "0x10")},
    **{f"{what}-{value[:6]}": changed(f'<{what}="[^"]*"', f'<{what}="{value}"')
       for what in ("node id", "way id", "nd ref") for value in ("9" * 20, "9223372036854775807", "", "1.5", "one")},
    **{f"{what}-{value}": changed(f'(<{what} [^>]*timestamp=)"[^"]*"', rf'\1"{value}"')
       for what in ("node", "way") for value in ("2020-13-45T00:00:00Z", "", "yesterday", "0001-01-01T00:00:00Z")},
    "bounds": changed('minlat="[^"]*"', 'minlat="nan"'),
    "tag": changed('<tag k="', f'<tag k="{"k" * 70_000}'),
    "entities": changed("<osm ", '<!DOCTYPE x [<!ENTITY a SYSTEM "file:///etc/passwd">]><osm '),
    "cut": TOYTOWN[: len(TOYTOWN) // 2],
    "nul": changed("<node", "<no\0de"),
    "version": changed('version="0.6"', 'version="0.5"'),
}  # fmt: skip


@pytest.mark.parametrize("name", sorted(BAD))
def test_an_extract_that_cannot_be_read_is_refused_in_one_line(name: str, tmp_path: Path) -> None:
    path = tmp_path / "town-2020-01-01.osm"
    path.write_text(BAD[name], encoding="utf-8")
    with pytest.raises(ExtractError) as caught:
        read_extract(path, GRID)
    assert str(caught.value).startswith(f"{path} cannot be read as OSM data (")
    assert len(str(caught.value).splitlines()) == 1
    assert len(str(caught.value)) < 500
    with pytest.raises(ExtractError):
        read_history([DatedExtract(path=path, on=dt.date(2020, 1, 1))])


def test_a_box_that_is_none_is_refused_in_one_line(tmp_path: Path) -> None:
    path = tmp_path / "town.osm"
    path.write_text(BAD["bounds"], encoding="utf-8")
    with pytest.raises(ExtractError, match="wrong format for coordinate: 'nan'"):
        read_header(path)
    with pytest.raises(ExtractError, match="wrong format for coordinate: 'nan'"):
        date_extracts([path, path])


@pytest.mark.parametrize("pack", [gzip.compress, bz2.compress])
@pytest.mark.parametrize("share", [0.01, 0.5, 0.999])
def test_a_packed_extract_that_was_cut_short_is_refused_in_one_line(pack, share: float, tmp_path: Path) -> None:
    data = pack(TOYTOWN.encode())
    path = tmp_path / ("town.osm.gz" if pack is gzip.compress else "town.osm.bz2")
    path.write_bytes(data[: int(len(data) * share)])
    with pytest.raises(ExtractError, match="cannot be read as OSM data"):
        read_extract(path, GRID)


@pytest.mark.parametrize("place", ['lat="91"', 'lon="180.1"', 'lon="-200"'])
def test_a_node_beyond_the_globe_is_taken_out_of_its_way_and_counted(place, tmp_path) -> None:
    path, plain = tmp_path / "town.osm", tmp_path / "plain.osm"
    path.write_text(changed(f' {place[:3]}="[^"]*"', f" {place}"), encoding="utf-8")
    plain.write_text(TOYTOWN, encoding="utf-8")
    reading, missing = read_extract(path, GRID), "way with nodes missing: the rest was kept"
    assert reading.drops["node beyond 180 degrees east or 90 degrees north, taken out of a way"] == 1
    assert reading.notes[missing] == read_extract(plain, GRID).notes[missing] + 1


def test_changesets_in_an_extract_are_passed_over(tmp_path: Path) -> None:
    path, plain = tmp_path / "town.osm", tmp_path / "plain.osm"
    path.write_text(TOYTOWN.replace("</osm>", '<changeset id="1" open="false"/></osm>'), encoding="utf-8")
    plain.write_text(TOYTOWN, encoding="utf-8")
    assert read_extract(path, GRID).features.equals(read_extract(plain, GRID).features)
