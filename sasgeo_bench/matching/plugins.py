# SPDX-License-Identifier: Apache-2.0
"""Load matchers, trackers, segmenters and rejectors, each with a sound card and the methods of its kind."""

from collections.abc import Callable, Sequence
from functools import partial
from typing import TYPE_CHECKING, Any

from sasgeo_bench.core.errors import MatchError
from sasgeo_bench.core.plugins import (
    KINDS,
    MATCHERS,
    REJECTORS,
    SEGMENTERS,
    TRACKERS,
    find_plugin,
    is_tracker,
    list_entry_points,
    made,
    unknown,
)
from sasgeo_bench.core.texts import message_of, one_line

if TYPE_CHECKING:
    from sasgeo_bench.matching.matcher import Matcher, Rejector
    from sasgeo_bench.matching.segmenter import Segmenter
    from sasgeo_bench.matching.tracker import Tracker


def load_matcher(spec: str) -> "Matcher":
    """Import and make the matcher of a name, or of "module:Class".

    Raise `MatchError` if there is none of that name, it cannot be imported or made, or has no sound card or methods.

    >>> load_matcher("no_such_matcher")
    Traceback (most recent call last):
        ...
    sasgeo_bench.core.errors.MatchError: there is no matcher 'no_such_matcher' (list matchers shows all; or
    module:Class)
    """
    from sasgeo_bench.matching.matcher import MatcherCard  # noqa: PLC0415 - names are listed without it

    matcher: Matcher = made(spec, find_plugin(spec, MATCHERS))
    _check(spec, matcher, MatcherCard, MATCHERS, ("prepare", "match"))
    return matcher


def load_tracker(spec: str) -> "Tracker":
    """Import and make the tracker of a name, or of "module:Class"; raise `MatchError` as `load_matcher` does.

    >>> load_tracker("dead_reckoning").card.tracks
    ('sequence',)
    """
    from sasgeo_bench.matching.matcher import MatcherCard  # noqa: PLC0415 - as in load_matcher

    tracker: Tracker = made(spec, find_plugin(spec, TRACKERS))
    _check(spec, tracker, MatcherCard, TRACKERS, ("prepare", "start", "step"))
    return tracker


def load_method(spec: str) -> "Matcher | Tracker":
    """Import and make a matcher or a tracker; a class of one's own is a tracker if it has `step`.

    Raise `MatchError` as `load_matcher` does.
    """
    if ":" in spec:
        return (
            load_tracker(spec) if callable(getattr(find_plugin(spec, TRACKERS), "step", None)) else load_matcher(spec)
        )
    if is_tracker(spec):
        return load_tracker(spec)
    if spec not in list_entry_points():
        raise unknown(spec, MATCHERS, TRACKERS)
    return load_matcher(spec)


def load_segmenter(spec: str) -> "Segmenter":
    """Import and make the segmenter of a name, or of "module:Class"; raise `MatchError` as `load_matcher` does.

    >>> load_segmenter("no_such_segmenter")
    Traceback (most recent call last):
        ...
    sasgeo_bench.core.errors.MatchError: there is no segmenter 'no_such_segmenter' (list segmenters shows all; or
    module:Class)
    """
    from sasgeo_bench.matching.segmenter import SegmenterCard  # noqa: PLC0415 - as in load_matcher

    segmenter: Segmenter = made(spec, find_plugin(spec, SEGMENTERS))
    _check(spec, segmenter, SegmenterCard, SEGMENTERS, ("segment",))
    return segmenter


def load_rejector(spec: str) -> "Rejector":
    """Import and make the rejector of a name, or of "module:Class"; raise `MatchError` as `load_matcher` does."""
    return rejector_maker(spec)()


def rejector_maker(spec: str) -> "partial[Rejector]":
    """Return a function that makes rejectors as `load_rejector` does, but looks up the name once.

    Its last argument is what the name stands for: a class, or a function that makes a rejector.

    Raise `MatchError` if there is none of that name, or it cannot be imported.
    """
    return partial(_rejector, spec, find_plugin(spec, REJECTORS))


def _rejector(spec: str, target: Callable[[], Any]) -> "Rejector":
    from sasgeo_bench.matching.matcher import RejectorCard  # noqa: PLC0415 - as in load_matcher

    rejector: Rejector = made(spec, target)
    _check(spec, rejector, RejectorCard, REJECTORS, ("fit", "p_false"))
    return rejector


def _check(spec: str, plugin: object, card_type: type, group: str, verbs: Sequence[str]) -> None:
    """Refuse a plugin without the card and the methods of its kind."""
    try:
        card = getattr(plugin, "card", None)
        missing = [name for name in verbs if not callable(getattr(plugin, name, None))]
    except (Exception, SystemExit) as error:
        raise MatchError(f"{spec}: its card and verbs cannot be read ({message_of(error)})") from error
    if not isinstance(card, card_type):
        expected = f"{card_type.__module__}.{card_type.__name__}"
        raise MatchError(f"{spec}: card is a {type(card).__name__}, expected a {expected}")
    if missing:
        raise MatchError(
            f"{spec}: {type(plugin).__name__} is not a {KINDS[group]}, it has no {' and no '.join(missing)}"
        )
    name = str(getattr(card, "name", ""))
    if ":" not in spec and name != spec:
        raise MatchError(
            f"{spec}: its card is named {one_line(name)!r}, and rows are found by one name: give the entry "
            "point (pyproject.toml) and the card (card.toml) the same, and install it again"
        )
    if group == TRACKERS and "sequence" not in getattr(card, "tracks", ()):
        raise MatchError(
            f"{spec}: card: tracks lacks 'sequence', which is what a tracker follows: tracks=(\"sequence\",)"
        )
