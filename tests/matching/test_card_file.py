# SPDX-License-Identifier: Apache-2.0
"""`card.toml` beside a module is the card of its class, of its submission and of its row."""

import os

import pytest

from sasgeo_bench.core.errors import ConfigError, MatchError, StoreError
from sasgeo_bench.matching.cards import read_card, read_card_file
from sasgeo_bench.matching.submission import example_card

MORE = 'authors = ["A. Author"]\ncontact = "a@example.org"\ncode = "https://example.org/mine"\n'


def write(folder, old="", new="", more=""):
    (folder / "card.toml").write_text(example_card("mine").replace(old, new) + more, encoding="utf-8")
    return folder / "matcher.py"


def test_a_class_has_what_its_card_says_and_other_training_stands_with_the_places(tmp_path):
    card = read_card(write(tmp_path, "uses = []", 'uses = ["imagery"]', MORE))
    assert (card.name, card.tracks, card.needs) == ("mine", ("retrieval", "localization"), ("position",))
    assert (card.uses, card.authors, card.code) == (("imagery",), ("A. Author",), "https://example.org/mine")
    assert card.limits.startswith("looks at a coarse lattice")
    assert card.trained_on == ()
    module = write(tmp_path, 'trained_on = "none"', 'trained_on = ["porto"]\ntrained_elsewhere = "views of Zurich"')
    assert read_card(module).trained_on == ("porto", "views of Zurich")


def test_halves_are_for_answers_of_a_file_alone(tmp_path):
    module = write(tmp_path, 'trained_on = "none"', 'trained_on = { a = ["munich"], b = ["porto"] }')
    assert read_card_file(tmp_path / "card.toml").is_by_half
    with pytest.raises(MatchError, match="trained_on speaks of halves, and one class answers about both"):
        read_card(module)


def test_what_is_wrong_is_said_with_the_file_and_a_pipe_is_not_waited_for(tmp_path):
    with pytest.raises(StoreError, match=r"card\.toml cannot be read"):
        read_card(tmp_path / "matcher.py")
    with pytest.raises(ConfigError, match=r"card\.toml: 'licence' is missing"):
        read_card(write(tmp_path, "licence", "# licence"))
    with pytest.raises(MatchError, match="tracks is empty"):
        read_card(write(tmp_path, "tracks =", "# tracks ="))
    with pytest.raises(ConfigError, match=r"card\.toml: api must be 1, got 2: install a sasgeo-bench that knows it$"):
        read_card(write(tmp_path, "api = 1", "api = 2"))
    (tmp_path / "card.toml").unlink()
    os.mkfifo(tmp_path / "card.toml")
    with pytest.raises(StoreError, match=r"card\.toml is no plain file: write a card there, or name one"):
        read_card_file(tmp_path / "card.toml")
