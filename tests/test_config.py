# SPDX-License-Identifier: Apache-2.0
"""Faults in TOML files, each in one line."""

from typing import Annotated

import pytest
from pydantic import Field

from sasgeo_bench.config import Document, find_document, parse_toml
from sasgeo_bench.errors import ConfigError


class Inner(Document):
    depth_m: float


class Outer(Document):
    name: str
    inner: list[Inner] = []
    near: Inner | None = None
    by_name: dict[str, Inner] = {}


def fault(text: str) -> str:
    with pytest.raises(ConfigError) as caught:
        parse_toml(text, Outer, source="a.toml")
    message = str(caught.value)
    assert "\n" not in message
    assert message.startswith("a.toml: ")
    return message


def test_a_good_document_is_read():
    assert parse_toml('name = "x"\n[[inner]]\ndepth_m = 2.0', Outer, source="a").inner[0].depth_m == 2.0


def test_an_unknown_key_suggests_the_nearest():
    assert "unknown key 'nam', did you mean 'name'?" in fault('nam = "x"')


def test_an_unknown_key_far_inside_suggests_the_nearest_there():
    assert "did you mean 'depth_m'?" in fault('name = "x"\n[[inner]]\ndepth = 2.0')
    assert "did you mean 'depth_m'?" in fault('name = "x"\n[near]\ndepth_n = 2.0\ndepth_m = 1.0')


def test_an_unknown_key_in_a_table_of_names_suggests_the_nearest():
    assert "did you mean 'depth_m'?" in fault('name = "x"\n[by_name.any]\ndepth = 2.0\ndepth_m = 1.0')


def test_a_file_full_of_faults_names_the_first_few():
    many = "".join(f"[by_name.n{at}]\ndepth_m = 'deep'\n" for at in range(12))
    found = fault(f'name = "x"\n{many}')
    assert "n7.depth_m" in found
    assert "n8.depth_m" not in found
    assert found.endswith("; and 4 more")


def test_an_unknown_key_like_no_other_lists_the_known_ones():
    assert "known keys: name, inner, near, by_name" in fault('name = "x"\nzzz = 1')


def test_a_wrong_type_says_what_was_found():
    assert "got 3" in fault("name = 3")


def test_one_thing_where_a_list_is_wanted_is_shown_as_a_list():
    class Sizes(Document):
        sizes: list[int]

    with pytest.raises(ConfigError, match=r"a\.toml: 'sizes' is a list: write \[192\]$"):
        parse_toml("sizes = 192", Sizes, source="a.toml")
    with pytest.raises(ConfigError, match=r"'sizes' is a list: for a list of tables write \[\[sizes\]\]$"):
        parse_toml("[sizes]\nx = 1", Sizes, source="a.toml")


class Shape(Document):
    size: tuple[float, float] = Field(strict=False)
    step: Annotated[float, Field(ge=0.1)] = 1.0
    inner: list[Inner] = []


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("size = 5", "'size' must be a list in brackets, [...], got 5"),
        ("size = [5.0]", "'size' has too few values, got [5.0]"),
        ("size = [1, 1]\nstep = 0.01", "'step': must be greater than or equal to 0.1, got 0.01"),
        ("[[inner]]\ndepth_m = 1.0\nsize = [1, 1]", "'inner.0.size', which belongs to the file itself: move it above"),
    ],
)
def test_faults_are_told_in_plain_words(text, said):
    with pytest.raises(ConfigError) as caught:
        parse_toml(text, Shape, source="a.toml")
    assert said in str(caught.value)


def test_a_folder_in_place_of_a_file_is_called_one(tmp_path):
    with pytest.raises(ConfigError, match=r"is a folder: name a region file in it \("):
        find_document(str(tmp_path), "region", "list regions shows all", dict)


def test_a_number_where_a_table_is_wanted_is_shown():
    class Inner(Document):
        a: int

    class Outer(Document):
        inner: Inner

    with pytest.raises(ConfigError, match=r"'inner' is a table of keys, got 0\.5$"):
        parse_toml("inner = 0.5", Outer, source="a.toml")


def test_a_missing_key_is_named():
    assert "'name' is missing" in fault("")


def test_two_faults_are_both_told():
    message = fault("nam = 3\nzzz = 4")
    assert "nam" in message
    assert "zzz" in message


@pytest.mark.parametrize("text", ["name = " + "[" * 5000, "name = " + "9" * 5000, "name = \x00", "name"])
def test_what_the_parser_itself_gives_up_on_is_a_fault_of_the_file(text):
    assert "not valid TOML: " in fault(text)


def test_no_toml_says_so():
    assert "not valid TOML" in fault("name = ")
