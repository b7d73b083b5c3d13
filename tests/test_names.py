# SPDX-License-Identifier: Apache-2.0
"""What becomes a folder, a flag, a key or a title: refused in one line where it is made or read."""

import json
import re
from importlib.metadata import entry_points
from pathlib import Path

import pytest

from sasgeo_bench.boards.pipeline_spec import ContrastSpec, PipelineFile, list_pipeline_files, read_pipeline_file
from sasgeo_bench.core.config import check_document
from sasgeo_bench.core.errors import ConfigError, MatchError
from sasgeo_bench.core.plugins import MATCHERS, REJECTORS
from sasgeo_bench.core.texts import NAME, VERSION
from sasgeo_bench.matching.matcher import MatcherCard, RejectorCard
from sasgeo_bench.matching.submission import Card
from sasgeo_bench.tasks.split import SplitFile
from tests.core.test_texts import NASTY

ROOT = Path(__file__).parents[1]
SAID = {"name": "mine", "version": "1", "title": "Mine", "source": "original", "ours": "all", "licence": "MIT"}
WRONG = tuple(text for text in NASTY if not re.fullmatch(VERSION, text))


@pytest.mark.parametrize("text", WRONG)
def test_no_card_has_such_a_name_or_version(text):
    for name in ("name", "version"):
        with pytest.raises(MatchError, match=f"card: {name} ") as matcher:
            MatcherCard(**SAID | {name: text}, tracks=("localization",))
        with pytest.raises(MatchError, match=f"card: {name} "):
            RejectorCard(**SAID | {name: text})
        with pytest.raises(ConfigError, match=name) as submitted:
            check_document(SAID | {"trained_on": "none", name: text}, Card, source="card.toml")
        for fault in (matcher, submitted):
            assert str(fault.value).isprintable()
            assert len(str(fault.value)) < 500


@pytest.mark.parametrize("text", ["a\nb", "\x1b[31m", "\u202ex", "\ud800", "x" * 5000])
def test_a_card_is_in_lines_of_printable_characters(text):
    for name in ("title", "source", "ours", "licence", "limits"):
        for card, more in ((MatcherCard, {"tracks": ("localization",)}), (RejectorCard, {})):
            with pytest.raises(MatchError, match=f"card: {name} must be one line of at most 4000 printable characters"):
                card(**SAID | {name: text}, **more)
    with pytest.raises(MatchError, match="card: trained_on must be one line"):
        MatcherCard(**SAID, tracks=("localization",), trained_on=(text,))


@pytest.mark.parametrize("text", ["", "\u202ex", "a\x1b[31mb", "x" * 301])
def test_titles_of_files_are_lines_of_printable_characters(text):
    halves = {"vaduz": "a", "eschen": "a", "monaco": "b", "porto": "b"}
    places = [{"name": name, "regions": [name], "half": half} for name, half in halves.items()]
    task = [{"suites": ["clean"], "sites": 1}]
    for model, each in (
        (SplitFile, {"id": "mine", "kind": "crossfit", "buffer_m": 0.0, "place": places}),
        (PipelineFile, {"id": "mine", "split": "crossfit", "matchers": ["random"], "task": task}),
    ):
        check_document(each | {"title": r"cost $\nosuchthing$ | <b>"}, model, source="a.toml")
        with pytest.raises(ConfigError, match="title"):
            check_document(each | {"title": text}, model, source="a.toml")
    contrast = {"name": "a", "first": "b", "second": "c", "suites": ["clean"]}
    for key, wrong in (("why", "a\x1bb"), ("kinds", [text])):
        with pytest.raises(ConfigError, match=key):
            check_document(contrast | {key: wrong}, ContrastSpec, source="a.toml")


def test_every_shipped_and_stored_name_and_version_is_one():
    shipped = [point.name for group in (MATCHERS, REJECTORS) for point in entry_points(group=group)]
    for path in list_pipeline_files().values():
        spec = read_pipeline_file(path)
        shipped += [*spec.matchers, *spec.rejectors]
    cards = []
    for path in ROOT.glob("docs/results/*/board.json"):
        record = json.loads(path.read_text(encoding="utf-8"))
        cards += [entry["card"] for entry in record["entries"] if entry["card"]] + record["rejectors"]
    assert len(cards) > 20
    for name in {*shipped, *(card["name"] for card in cards)}:
        assert re.fullmatch(NAME, name), name
    for version in {card["version"] for card in cards}:
        assert re.fullmatch(VERSION, version), version
