# SPDX-License-Identifier: Apache-2.0
"""The doctor: says what is there and what is missing, and changes nothing."""

import re

import pytest

from sasgeo_bench.cli import doctor
from sasgeo_bench.cli.doctor import examine


@pytest.fixture
def nowhere(tmp_path, monkeypatch):
    """A machine without extracts."""
    monkeypatch.delenv("SASGEO_EXTRACTS", raising=False)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    return tmp_path


@pytest.mark.parametrize(
    ("is_reachable", "mend"), [(True, "the server answers, build-region"), (False, "the server does not answer now")]
)
def test_missing_extracts_are_listed_by_what_was_found_to_help(nowhere, monkeypatch, is_reachable, mend):
    monkeypatch.setattr(doctor, "answers", lambda _: is_reachable)
    found = list(examine((), out=nowhere / "out"))
    labels, missing = sorted(finding for name, finding in found if name == "missing")
    assert missing.startswith(mend)
    assert labels.startswith("no address is known")
    assert "liechtenstein-2025-09-19.osm.pbf" in missing
    count, total = dict(found)["extracts found"].split(" that")[0].split(" of ")
    files = [int(re.search(r": (\d+) files \(", line)[1]) for line in (labels, missing)]
    assert (int(count), int(total)) == (0, sum(files))
    assert labels.count(".osm.") == 40 - labels.count(".geojson")  # the others are counted
    assert list(nowhere.iterdir()) == []


def test_a_folder_that_is_not_there_is_said(nowhere):
    found = [finding for name, finding in examine((nowhere / "osm",), out=nowhere) if name == "extracts in"]
    assert found[0] == f"{nowhere / 'osm'} (no such folder)"


@pytest.mark.real
def test_with_the_real_extracts_nothing_is_missing(real_extracts, tmp_path):
    assert "missing" not in dict(examine((real_extracts,), out=tmp_path))
