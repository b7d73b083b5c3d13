# SPDX-License-Identifier: Apache-2.0
"""Plugins as version 0.1 scaffolds them pass the kit of today: who wrote one edits nothing. They never change."""

from pathlib import Path

import pytest

from sasgeo_bench.core.config import parse_toml
from sasgeo_bench.core.errors import ConfigError
from sasgeo_bench.matching.submission import API, Card
from sasgeo_bench.running.segmenter_testing import check_segmenter
from sasgeo_bench.running.testing import check_matcher
from sasgeo_bench.running.tracker_testing import check_tracker
from tests.slow import rest_slow

PLUGINS = Path(__file__).with_name("plugins_0_1")
KITS = {"matcher": check_matcher, "tracker": check_tracker, "segmenter": check_segmenter}


@pytest.mark.parametrize("kind", rest_slow(["matcher", "segmenter", "tracker"]))
def test_a_plugin_of_0_1_passes_every_check(kind, monkeypatch):
    monkeypatch.chdir(PLUGINS)
    checks = list(KITS[kind](f"kept_{kind}.{kind}:Kept{kind.capitalize()}"))
    assert len(checks) > 8
    assert [check for check in checks if check.outcome == "fail"] == []


def test_a_card_of_other_doors_is_refused_in_a_line():
    text = (PLUGINS / "kept_matcher" / "card.toml").read_text(encoding="utf-8")
    assert parse_toml(text, Card, source="card.toml").api == API
    with pytest.raises(ConfigError, match="api must be 1, got 2: install a sasgeo-bench that knows it"):
        parse_toml(text.replace("api = 1 ", "api = 2 "), Card, source="card.toml")
