# SPDX-License-Identifier: Apache-2.0
"""A small task with its truths, and the hostile matchers beside it."""

import shutil
from pathlib import Path

import pytest

from tests.world import drawn

TOWN = "town-riverside"


@pytest.fixture(scope="session")
def made(tmp_path_factory, lay_towns):
    """A folder with out/ and hostile.py in it."""
    root = tmp_path_factory.mktemp("run")
    lay_towns(root / "out", TOWN)
    for suite in ("false-unknown", "clean"):
        drawn(root / "out", suite, TOWN, count=3, seed=4, may_be_fewer=True)
    shutil.copy(Path(__file__).with_name("hostile.py"), root / "hostile.py")
    return root


@pytest.fixture
def place(made, monkeypatch):
    """That folder as the working one, on the import path of whoever is started from here."""
    monkeypatch.chdir(made)
    monkeypatch.syspath_prepend(str(made))
    return made


@pytest.fixture
def task(place):
    return place / "out" / "tasks" / "false-unknown" / TOWN
