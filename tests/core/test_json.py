# SPDX-License-Identifier: Apache-2.0
"""JSON of anybody: what Python's reader lets pass, and no document of ours holds."""

from pathlib import Path

import pytest

from sasgeo_bench.core.errors import StoreError
from sasgeo_bench.core.json import parse_json, read_json


@pytest.mark.parametrize(
    ("text", "fault"),
    [
        ("[" * 100_000, "nested too deep"),
        ("1" * 5000, "has too many digits"),
        ("1e999", "1e999 is too large a number"),
        ("NaN", "NaN is no number of JSON"),
        ("-Infinity", "-Infinity is no number of JSON"),
        (r'"\ud800"', "surrogates not allowed"),
        ('{"a": {"b": 1, "b": 1}}', "the key 'b' stands there twice"),
        ("", "Expecting value"),
        ("{} {}", "Extra data"),
    ],
)
def test_what_is_no_document_of_ours_is_refused_in_one_line(text: str, fault: str, tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=fault.replace("(", r"\(")):
        parse_json(text)
    path = tmp_path / "said.json"
    path.write_text(text, encoding="utf-8")
    with pytest.raises(StoreError, match=r"said\.json is damaged \(.*\): fetch it again") as caught:
        read_json(path, mend="fetch it again")
    assert len(str(caught.value).splitlines()) == 1


def test_a_file_that_is_too_large_or_no_text_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "said.json"
    path.write_bytes(b'"' + b"a" * 100 + b'"')
    with pytest.raises(StoreError, match="it has more than 100 bytes"):
        read_json(path, mend="fetch it again", most_bytes=100)
    path.write_bytes(b'"\xff"')
    with pytest.raises(StoreError, match="can't decode"):
        read_json(path, mend="fetch it again")
