# SPDX-License-Identifier: Apache-2.0
"""Faults in TOML files, each in one line."""

from typing import Annotated

import pytest
from pydantic import Field

from sasgeo_bench.core.config import Document, find_document, parse_toml
from sasgeo_bench.core.errors import ConfigError


class Inner(Document):
    depth_m: float


class Outer(Document):
    name: str
    inner: list[Inner] = []
    near: Inner | None = None
    by_name: dict[str, Inner] = {}
    sizes: list[int] = []
    size: tuple[float, float] = Field((1, 1), strict=False)
    step: Annotated[float, Field(ge=0.1)] = 1.0


def fault(text: str) -> str:
    with pytest.raises(ConfigError) as caught:
        parse_toml(text, Outer, source="a.toml")
    message = str(caught.value)
    assert "\n" not in message
    assert message.startswith("a.toml: ")
    return message


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ('nam = "x"', "unknown key 'nam', did you mean 'name'?"),
        ('name = "x"\n[[inner]]\ndepth = 2.0', "did you mean 'depth_m'?"),
        ('name = "x"\n[near]\ndepth_n = 2.0\ndepth_m = 1.0', "did you mean 'depth_m'?"),
        ('name = "x"\n[by_name.any]\ndepth = 2.0\ndepth_m = 1.0', "did you mean 'depth_m'?"),
        ('name = "x"\nzzz = 1', "known keys: name, inner, near, by_name, sizes, size, step"),
        ("name = 3", "got 3"),
        ("", "'name' is missing"),
        ('name = "x"\nsizes = 192', "'sizes' is a list: write [192]"),
        ('name = "x"\n[sizes]\nx = 1', "'sizes' is a list: for a list of tables write [[sizes]]"),
        ('name = "x"\nnear = 0.5', "'near' is a table of keys, got 0.5"),
        ('name = "x"\nsize = 5', "'size' must be a list in brackets, [...], got 5"),
        ('name = "x"\nsize = [5.0]', "'size' has too few values, got [5.0]"),
        ('name = "x"\nstep = 0.01', "'step': must be greater than or equal to 0.1, got 0.01"),
        ('[[inner]]\ndepth_m = 1.0\nname = "x"', "'inner.0.name', which belongs to the file itself: move it above"),
        ("name = ", "not valid TOML"),
    ],
)
def test_a_fault_is_reported_in_plain_words(text, expected):
    assert expected in fault(text)


def test_a_file_full_of_faults_names_the_first_few():
    many = "".join(f"[by_name.n{at}]\ndepth_m = 'deep'\n" for at in range(12))
    found = fault(f'name = "x"\n{many}')
    assert "n7.depth_m" in found
    assert "n8.depth_m" not in found
    assert found.endswith("; and 4 more")


def test_a_folder_in_place_of_a_file_is_called_one(tmp_path):
    with pytest.raises(ConfigError, match=r"is a folder: name a region file in it \("):
        find_document(str(tmp_path), "region", "list regions shows all", dict)


def test_two_faults_are_both_told():
    message = fault("nam = 3\nzzz = 4")
    assert "nam" in message
    assert "zzz" in message


@pytest.mark.parametrize("text", ["name = " + "[" * 5000, "name = " + "9" * 5000, "name = \x00", "name"])
def test_what_the_parser_itself_gives_up_on_is_a_fault_of_the_file(text):
    assert "not valid TOML: " in fault(text)
