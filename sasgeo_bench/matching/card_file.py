# SPDX-License-Identifier: Apache-2.0
"""`card.toml`: the one description of a method, which its class, its submission and its row have."""

from pathlib import Path
from typing import Any, Final

from sasgeo_bench.config import parse_toml
from sasgeo_bench.errors import ConfigError, MatchError, StoreError
from sasgeo_bench.files.paths import given_path, plain_file
from sasgeo_bench.files.plugins import CARD_FILE
from sasgeo_bench.matching.matcher import MatcherCard
from sasgeo_bench.matching.submission import Card

_EXAMPLE: Final = "submit --example-card prints a sound one"
_MOST_BYTES: Final = 100_000


def read_card(module: str | Path) -> MatcherCard:
    """Return the card of a matcher or a tracker from `card.toml` beside its module.

    Parameters
    ----------
    module : str or Path
        `__file__` of the module.

    Returns
    -------
    MatcherCard
        `trained_on` holds the places of the file, then its `trained_elsewhere`.

    Raises
    ------
    StoreError
        If there is no such file, or it cannot be read.
    ConfigError
        If a field is missing or wrong; all faults on one line.
    MatchError
        If it names no tracks, or different training for the halves of a split, which only answers of a file can have.

    Examples
    --------
    >>> class MyMatcher:  # in matcher.py, with card.toml in the same folder
    ...     card = read_card(__file__)  # doctest: +SKIP
    """
    path = given_path(module).with_name(CARD_FILE)
    found = read_card_file(path)
    if found.is_by_half:
        raise MatchError(
            f"{path}: trained_on speaks of halves, and one class answers about both: list the places, or let the "
            "runner train it by a method 'learn'"
        )
    given = found.model_dump(exclude={"trained_on", "trained_elsewhere"})
    fields: dict[str, Any] = {name: tuple(one) if isinstance(one, list) else one or "" for name, one in given.items()}
    try:
        return MatcherCard(**fields, trained_on=(*found.places, *filter(None, [found.trained_elsewhere])))
    except MatchError as error:
        raise MatchError(f"{path}: {str(error).removeprefix('card: ')}") from error


def read_card_file(path: Path) -> Card:
    """Read a card that an author wrote.

    Raise StoreError if it cannot be read. Raise ConfigError if a field is wrong; all faults on one line.
    """
    noun = f"write a card there, or name one ({_EXAMPLE})"
    if path.exists() and not path.is_file():  # a pipe would be waited for
        raise StoreError(f"{path} is no plain file: {noun}")
    try:
        with plain_file(path).open("rb") as source:
            read = source.read(_MOST_BYTES + 1)
        text = read.decode("utf-8-sig")  # some editors write a byte order mark
    except (UnicodeDecodeError, OSError) as error:
        fault = error.strerror if isinstance(error, OSError) else "it is no UTF-8"
        raise StoreError(f"{path} cannot be read ({fault}): {noun}") from error
    if len(read) > _MOST_BYTES:
        raise StoreError(f"{path} has more than {_MOST_BYTES} bytes: {noun}")
    try:
        return parse_toml(text, Card, source=str(path))
    except ConfigError as error:
        raise ConfigError(f"{error}: correct it there ({_EXAMPLE})") from error
