# SPDX-License-Identifier: Apache-2.0
"""Matcher x rejector: fitted on calibration places, thresholds chosen there too, and counted on test places alone.

A matcher's own confidence stands beside the rejectors as one that needs no fit.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
import pandas as pd

from sasgeo_bench.bounds import message_of
from sasgeo_bench.errors import ConfigError, MatchError, counted
from sasgeo_bench.matching.plugins import rejector_maker
from sasgeo_bench.matching.rejector import Rejector, RejectorCard, check_p_false, remark_of
from sasgeo_bench.matching.results import Prediction
from sasgeo_bench.scoring.base import Bools, Floats
from sasgeo_bench.scoring.decisions import Answers, accept
from sasgeo_bench.scoring.integrity_metric import choose_threshold
from sasgeo_bench.scoring.score import NOT_APPLICABLE
from sasgeo_bench.tasks.split import Split

OWN: Final = "own"  # what a board calls a matcher's own confidence; no rejector can have the name
RISKS: Final = (0.01, 0.05)
_NUMBER: Final = r"\d+(?:\.\d+)?"
_SAID: Final = ("p_right", "remark", "is_calibrated")
_PARTS: Final = 5  # of the calibration blocks: a threshold is chosen on answers that its rejector was not fitted on

Make = Callable[[], Rejector]


@dataclass(frozen=True, kw_only=True)
class Rule:
    """A rejector that is to be fitted: what it says of itself, what makes a new one, and on which places."""

    card: RejectorCard
    make: Make
    split: Split


def rules_of(specs: Sequence[str], split: Split | None) -> dict[str, Rule]:
    """Rejectors by name, each tried once before anything is read.

    Parameters
    ----------
    specs : sequence of str
        Names, or module:Class.
    split : Split, optional
        Says which places calibrate.

    Raises
    ------
    ConfigError
        If there is no split, two have one name, or one that of a matcher's own confidence.

    Examples
    --------
    >>> rules_of([], None)
    {}
    """
    found: dict[str, Rule] = {}
    named: dict[str, str] = {}
    for spec in specs:
        if split is None:
            message = "rejectors are fitted on the calibration places of a split: name one with --split"
            raise ConfigError(message)
        make = rejector_maker(spec)
        card = make().card
        if named.setdefault(card.name, spec) != spec:
            message = f"{named[card.name]} and {spec} are both named {card.name!r}: rename one, or leave it out"
            raise ConfigError(message)
        if card.name == OWN:
            message = f"{spec}: {OWN!r} is what a board calls a matcher's own confidence: rename the rejector"
            raise ConfigError(message)
        found[card.name] = Rule(card=card, make=make, split=split)
    return found


@dataclass(frozen=True, slots=True, kw_only=True)
class Turn:
    """One use of a split: which rows are scored, and which calibrate.

    `is_own` is False where none of the fold's own calibration places is on the board, so that all the other places
    calibrate. Not so for a matcher that learns: its answers on these others come from what the test place taught it.
    """

    test: Bools
    calibration: Bools
    is_own: bool


def turns(scores: pd.DataFrame, split: Split, *, is_taught: bool = False) -> Iterator[Turn]:
    """Every use of a split for some scored rows; each row is tested once at most.

    Parameters
    ----------
    scores : pandas.DataFrame
        Columns place and part.
    split : Split
        Hold-out: one turn, by the part of each query. Cross-fit: one for each place on the board.
    is_taught : bool
        Whether the matcher has learnt from other places: then none but the fold's own calibration places calibrate.

    Yields
    ------
    Turn
        Masks of shape (N,). A place never calibrates itself.
    """
    place, part = scores["place"].to_numpy(), scores["part"].to_numpy()
    if split.spec.kind == "holdout":
        yield Turn(test=part == "test", calibration=part == "calibration", is_own=True)
        return
    for fold in split.folds:
        test = place == fold.held_out
        if not test.any():
            continue
        own = np.array([fold.part_of.get(name) == "calibration" for name in place], dtype=bool)
        is_own = is_taught or bool(own.any())
        yield Turn(test=test, calibration=own if is_own else ~test, is_own=is_own)


def judge(
    scores: pd.DataFrame, predictions: Mapping[str, Prediction], make: Make, split: Split, *, is_taught: bool = False
) -> pd.DataFrame:
    """What a rejector says of the answers of one matcher, each by a fit on other places.

    Parameters
    ----------
    scores : pandas.DataFrame
        Of one matcher; several tracks and prior groups are fitted apart, all suites together.
    predictions : mapping of str to Prediction
        The same answers by query id.
    make : callable
        Gives a new rejector.
    split : Split
        Says which places calibrate.
    is_taught : bool
        Whether the matcher has learnt from other places of the split.

    Returns
    -------
    pandas.DataFrame
        The rows that were tested, with the columns `p_right` (NaN without an answer), `is_calibrated` (else that is an
        order and no chance), `accepted_<risk>` for each of `RISKS`, `is_own_calibration`, and `remark`, what the
        rejector said of its fit.
    """
    frames = []
    usable = scores[scores["status"] != NOT_APPLICABLE]
    for _, group in usable.groupby(["track", "prior_group"], sort=True):
        for turn in turns(group, split, is_taught=is_taught):
            test, calibration = group[turn.test], group[turn.calibration]
            if len(test) and calibration["is_answered"].any():
                frames.append(_judged(test, calibration, predictions, make).assign(is_own_calibration=turn.is_own))
    return _together(frames, [*scores.columns, *_SAID, *map(_accepted, RISKS), "is_own_calibration"])


def remarks_of(judged: pd.DataFrame) -> list[str]:
    """What a rejector said of its fits, with how many answers it was said of; remarks that differ in numbers are one.

    A board fits hundreds of times, and what is to be known is where it does not hold, and of how much.

    Examples
    --------
    >>> remarks_of(pd.DataFrame({"remark": ["", "2 too few", "2 too few"], "is_answered": [True, True, False]}))
    ['2 too few (1 answer judged so)']
    >>> remarks_of(pd.DataFrame({"remark": ["2 too few", "9 too few", "9 too few"], "is_answered": True}))
    ['9 too few (and alike in 1 fit more: 3 answers judged so)']
    """
    said = judged.loc[judged["is_answered"].astype(bool) & (judged["remark"] != ""), "remark"]
    found = []
    for _, alike in said.groupby(said.str.replace(_NUMBER, "#", regex=True), sort=True):
        counts = alike.value_counts()
        most = min(counts.index[counts == counts.max()])
        others = f"and alike in {counted(len(counts) - 1, 'fit')} more: " if len(counts) > 1 else ""
        found.append(f"{most} ({others}{counted(len(alike), 'answer')} judged so)")
    return sorted(found)


def why_not(scores: pd.DataFrame, *, is_taught: bool = False) -> str:
    """Why `judge` has no row for a matcher, in words.

    Parameters
    ----------
    scores : pandas.DataFrame
        Of one matcher.
    is_taught : bool
        Whether it has learnt from other places of the split.

    Examples
    --------
    >>> why_not(pd.DataFrame({"is_answered": [False, False], "place": ["vaduz", "monaco"]}))
    'it has no answers to judge'
    """
    if not scores["is_answered"].any():
        return "it has no answers to judge"
    if is_taught:
        return "no other place of the board is in the half of one that it answered"
    if len(set(scores["place"])) > 1:
        return "no place that may calibrate another one has an answer"
    return "no other place of the board calibrates"


def own_word(scores: pd.DataFrame, split: Split | None = None, *, is_taught: bool = False) -> pd.DataFrame:
    """What a matcher itself says of its answers: its confidence, as a rejector that learns nothing.

    Parameters
    ----------
    scores : pandas.DataFrame
        Of one matcher. Of a hold-out split only the test part counts, as for any rejector.
    split : Split, optional
        Says on which places thresholds for `RISKS` are chosen; all else needs none.
    is_taught : bool
        Whether the matcher has learnt from other places of the split.

    Returns
    -------
    pandas.DataFrame
        As of `judge`, with `accepted_<risk>` NaN where no place calibrates, and always a chance. Only tracks and prior
        groups in which some answer has a confidence; an answer without one is trusted least.

    Examples
    --------
    >>> from sasgeo_bench.scoring.score import score_task
    >>> len(own_word(score_task([], [], {})))
    0
    """
    usable = scores[scores["status"] != NOT_APPLICABLE]
    frames = []
    for _, group in usable.groupby(["track", "prior_group"], sort=True):
        p_right = np.where(group["is_answered"].to_numpy(bool), group["confidence"].to_numpy(float), np.nan)
        if not np.isnan(p_right).all():
            frames.append(_own_of_group(group.assign(p_right=p_right), split, is_taught=is_taught))
    return _together(frames, [*scores.columns, "p_right", *map(_accepted, RISKS)])


def _own_of_group(group: pd.DataFrame, split: Split | None, *, is_taught: bool) -> pd.DataFrame:
    """The rows of one track and prior group that are tested, with what thresholds of other places accept."""
    accepted = {_accepted(risk): np.full(len(group), np.nan) for risk in RISKS}
    for turn in () if split is None else turns(group, split, is_taught=is_taught):
        known = group[turn.calibration]
        if known["is_answered"].any():
            for name, taken in _accepted_rows(known, group[turn.test]).items():
                accepted[name][turn.test] = taken
    group = group.assign(**accepted)
    is_holdout = split is not None and split.spec.kind == "holdout"
    return group[(group["part"] == "test").to_numpy(bool)] if is_holdout else group


def _together(frames: Sequence[pd.DataFrame], columns: Sequence[str]) -> pd.DataFrame:
    return pd.concat(frames, ignore_index=True) if frames else pd.DataFrame(columns=list(columns))


def _accepted(risk: float) -> str:
    return f"accepted_{risk:g}"


def _judged(
    test: pd.DataFrame, calibration: pd.DataFrame, predictions: Mapping[str, Prediction], make: Make
) -> pd.DataFrame:
    p_false, remark = _fit_and_say(make, calibration, test, predictions)
    asked = test.assign(p_right=1.0 - p_false, remark=remark, is_calibrated=make().card.is_calibrated)
    known = calibration.assign(p_right=1.0 - _held_back(make, calibration, predictions))
    return asked.assign(**_accepted_rows(known, asked))


def _accepted_rows(known: pd.DataFrame, asked: pd.DataFrame) -> dict[str, Bools]:
    """Which fixes the thresholds accept that are chosen on some rows, by the name of the column."""
    calibration, test = answers_of(known), answers_of(asked)
    return {_accepted(risk): accept(test, choose_threshold(calibration, risk)) for risk in RISKS}


def _held_back(make: Make, calibration: pd.DataFrame, predictions: Mapping[str, Prediction]) -> Floats:
    """Probabilities on calibration blocks, each by a fit on the other ones; of a single block by its own fit."""
    names = sorted(set(calibration["block"]))
    if len(names) < 2:  # noqa: PLR2004 - one block cannot be left out
        return _fit_and_say(make, calibration, calibration, predictions)[0]
    fold = calibration["block"].map({name: at % _PARTS for at, name in enumerate(names)}).to_numpy()
    found = np.full(len(calibration), np.nan)
    for part in sorted(set(fold)):
        rest, mine = calibration[fold != part], calibration[fold == part]
        if rest["is_answered"].any():
            found[fold == part] = _fit_and_say(make, rest, mine, predictions)[0]
    return found


def _fit_and_say(
    make: Make, known: pd.DataFrame, asked: pd.DataFrame, predictions: Mapping[str, Prediction]
) -> tuple[Floats, str]:
    """Fit on the answers of some rows; say of others, NaN where there is no answer. And what it remarks of the fit."""
    rejector = make()
    answered = known[known["is_answered"].to_numpy(bool)]
    found = np.full(len(asked), np.nan)
    is_answered = asked["is_answered"].to_numpy(bool)
    some = _answers(asked[is_answered], predictions)
    try:
        rejector.fit(_answers(answered, predictions), ~answered["is_right"].to_numpy(bool))
        if some:
            found[is_answered] = check_p_false(rejector.p_false(some), len(some))
        remark = remark_of(rejector)
    except (Exception, SystemExit) as error:  # a plugin that ends the program must not look like a good end
        message = f"rejector {rejector.card.name!r} failed ({message_of(error)}): mend it, or leave it out"
        raise MatchError(message) from error
    return found, remark


def _answers(rows: pd.DataFrame, predictions: Mapping[str, Prediction]) -> Sequence[Prediction]:
    return [predictions[name] for name in rows["query_id"]]


def answers_of(judged: pd.DataFrame) -> Answers:
    """Judged rows as the integrity figures take them."""
    return Answers(
        confidence=judged["p_right"].to_numpy(float),
        is_answered=judged["is_answered"].to_numpy(bool),
        is_right=judged["is_right"].to_numpy(bool),
        is_present=judged["is_present"].to_numpy(bool),
    )
