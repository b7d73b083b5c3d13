# SPDX-License-Identifier: Apache-2.0
"""Rejectors on the answers of a matcher: fitted and given thresholds on calibration places, evaluated on test places.

A matcher's own confidence is treated as a rejector that needs no fit.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
import pandas as pd

from sasgeo_bench.errors import ConfigError, MatchError, counted
from sasgeo_bench.matching.matcher import Rejector, RejectorCard, check_p_false, remark_of
from sasgeo_bench.matching.plugins import rejector_maker
from sasgeo_bench.matching.results import Prediction
from sasgeo_bench.progress import Progress, Tell, spread
from sasgeo_bench.running.failures import Failures
from sasgeo_bench.scoring.base import Bools, Floats, weighted_mean
from sasgeo_bench.scoring.decisions import PRESENT_SHARES, Answers, accept, presence_weights
from sasgeo_bench.scoring.integrity_metric import choose_threshold, drawn_areas
from sasgeo_bench.scoring.intervals import ClusterDraws, Interval, effective_count, seed_of_text, share_interval
from sasgeo_bench.scoring.metrics import REJECTION, RISKS, THRESHOLDS, RejectionMetric, ThresholdMetric
from sasgeo_bench.scoring.rows import ALL_SUITES, GroupKey, Row, RowKey, bare, in_threads, to_frame
from sasgeo_bench.scoring.score import NOT_APPLICABLE
from sasgeo_bench.tasks.split import Split
from sasgeo_bench.texts import message_of

AS_DRAWN: Final = "as drawn"
_CACHED: Final = 2**16  # numbers that fit a core's cache: larger tables take twice the time
SLOW_DRAWS: Final = 1000  # for metrics that are no means: each draw sorts again


def integrity_rows(matcher: str, rejector: str, rows: pd.DataFrame, *, is_calibrated: bool = True) -> Iterator[Row]:
    """Yield every integrity metric of a matcher with a rejector, from rows of `rejection.judge` or `own_confidence`.

    They cover each suite, track and prior group, and all suites of a track and prior group together. The latter also
    come with present places reweighted to a share of 0.9, 0.7 and 0.5. Without `is_calibrated`, skip metrics that need
    probabilities.
    """
    names = {"matcher": matcher, "rejector": rejector, "stratum": AS_DRAWN}
    parts = [
        (RowKey.of(part, GroupKey(str(suite), str(track), str(prior_group)), **names), part)
        for (track, prior_group), whole in rows.groupby(["track", "prior_group"], sort=True)
        for suite, part in [(ALL_SUITES, whole), *whole.groupby("suite", sort=True)]
    ]
    metrics = [metric for metric in REJECTION if is_calibrated or not metric.needs_chances]
    yield from in_threads(lambda item: _rows(*item, metrics), parts)


def _rows(key: RowKey, part: pd.DataFrame, metrics: Sequence[RejectionMetric]) -> Iterator[Row]:
    some = answers_of(part)
    # The seed depends on the queries alone, so that all rejectors share draws.
    seed = seed_of_text(f"{key.suite}/{key.track}/{key.prior_group}")
    sites = np.unique(part["pair_id"], return_inverse=True)[1]
    drawn = ClusterDraws(blocks=part["block"].tolist(), sites=sites, seed=seed, draws=SLOW_DRAWS)
    is_pooled = key.suite == ALL_SUITES
    mixtures = dict(mixtures_of(some, is_pooled=is_pooled))
    areas = _drawn_areas(some, mixtures, drawn) if is_pooled and drawn.blocks_count > 1 else {}
    shares = {stratum: list(_shares(part, mass)) for stratum, mass in mixtures.items()}
    drawn_shares = iter(_drawn_shares([share for listed in shares.values() for share in listed], drawn))
    for stratum, mass in mixtures.items():
        mine, trials = replace(key, stratum=stratum), effective_count(sites, mass)
        for metric in metrics:
            value = metric.compute(some, weights=mass)
            if not (is_pooled and metric.has_interval):
                yield mine.row(metric, bare(value))
                continue
            most = metric.bounds[1]  # an area is a mean risk: scale it to [0, 1] and back
            area = areas.get((stratum, metric.name), np.empty(0))
            found, how = share_interval(value / most, area / most, trials)
            yield mine.row(metric, Interval(value=value, lo=found.lo * most, hi=found.hi * most), how)
        for share in shares[stratum]:
            value = weighted_mean(share.counted, share.mass)
            found, how = share_interval(value, next(drawn_shares), effective_count(sites, share.mass))
            yield mine.row(share.metric, found, how)


def _drawn_areas(
    answers: Answers, mixtures: Mapping[str, Floats], drawn: ClusterDraws
) -> Mapping[tuple[str, str], Floats]:
    """Return every draw of the areas that have intervals, by mixture and name."""
    found: dict[tuple[str, str], list[Floats]] = {}
    parts = (part for some in drawn.weights() for part in np.array_split(some, 1 + some.size // _CACHED))
    for weights in parts:
        for stratum, mass in mixtures.items():
            areas = drawn_areas(answers, weights * mass)
            found.setdefault((stratum, "aurc"), []).append(areas.aurc)
            found.setdefault((stratum, "augrc"), []).append(areas.augrc)
    return {key: np.concatenate(listed) for key, listed in found.items()}


def mixtures_of(some: Answers, *, is_pooled: bool) -> Iterator[tuple[str, Floats]]:
    """Yield names and weights: as drawn, and for pooled suites the declared mixtures of present and absent places."""
    yield AS_DRAWN, np.ones(len(some))
    if is_pooled and some.is_present.any() and not some.is_present.all():
        for share in PRESENT_SHARES:
            yield f"present {share:g}", presence_weights(some.is_present, share)


@dataclass(frozen=True, slots=True, kw_only=True)
class _Share:
    """A weighted share of the queries, as the coverage of a threshold; each column has shape (N,)."""

    metric: ThresholdMetric
    counted: Floats
    mass: Floats


def _shares(part: pd.DataFrame, mass: Floats) -> Iterator[_Share]:
    """Yield the coverage at thresholds chosen on calibration places, and the risk reached here.

    Skip thresholds that some rows lack: the coverage of the others would not be that of these queries.
    """
    is_false = (~part["is_right"].to_numpy(bool)).astype(float)
    for metric in THRESHOLDS:
        column = part[f"accepted_{metric.risk:g}"]
        if not column.isna().any():
            accepted = column.to_numpy(float)
            counted, counts = (is_false, mass * accepted) if metric.is_of_accepted else (accepted, mass)
            yield _Share(metric=metric, counted=counted, mass=counts)


def _drawn_shares(shares: Sequence[_Share], drawn: ClusterDraws) -> Iterator[Floats]:
    """Yield each share in every draw, with one pass over the draws; NaN where a draw has no weight.

    For fewer than two blocks the draws are empty.
    """
    if not shares or drawn.blocks_count < 2:  # noqa: PLR2004 - one block cannot differ from itself
        yield from (np.empty(0) for _ in shares)
        return
    columns = [share.counted * share.mass for share in shares] + [share.mass for share in shares]
    top, bottom = np.hsplit(np.vstack(list(drawn.sums(np.column_stack(columns)))), 2)
    yield from np.divide(top, bottom, out=np.full(top.shape, np.nan), where=bottom > 0).T


JUDGED: Final = "rejectors"  # what progress is shown of
OWN: Final = "own"  # name of a matcher's own confidence on a board; reserved
_NUMBER: Final = r"\d+(?:\.\d+)?"
_PARTS: Final = 5  # folds of the calibration blocks: thresholds need answers that the rejector was not fitted on

Make = Callable[[], Rejector]


@dataclass(frozen=True, kw_only=True)
class Rule:
    """A rejector to fit: its card, a function that makes a new one, and the split that names calibration places."""

    card: RejectorCard
    make: Make
    split: Split


def rules_of(specs: Sequence[str], split: Split | None) -> dict[str, Rule]:
    """Return rejectors by name from names or module:Class, after making each once.

    Raise ConfigError if there is no split, two share a name, or one has that of a matcher's own confidence.
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
    """One use of a split: masks of the rows to score and of those that calibrate, shape (N,).

    `is_own` is False if none of the fold's own calibration places is on the board, so that all other places calibrate.
    This fallback is not for matchers with training: their answers on other places were trained on the test place.
    """

    test: Bools
    calibration: Bools
    is_own: bool


def turns(scores: pd.DataFrame, split: Split, *, is_taught: bool = False) -> Iterator[Turn]:
    """Yield every use of a split for scored rows; each row is tested at most once, and no place calibrates itself.

    A hold-out split has one turn, by the part of each query; a cross-fit one for each place on the board. With
    `is_taught`, for a matcher that was trained on other places, only the fold's own calibration places calibrate.
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
    """Return a rejector's output for the answers of one matcher, each from a fit on other places.

    Each track and prior group has its own fit, over all suites. `make` makes a new rejector; `is_taught` is as in
    `turns`. The result holds the tested rows, with the columns `p_right` (NaN without an answer), `is_calibrated`
    (False if `p_right` is only an order), `accepted_<risk>` for each of `RISKS`, `is_own_calibration`, and `remark`,
    the rejector's remark on its fit.
    """
    frames = []
    usable = scores[scores["status"] != NOT_APPLICABLE]
    for _, group in usable.groupby(["track", "prior_group"], sort=True):
        for turn in turns(group, split, is_taught=is_taught):
            test, calibration = group[turn.test], group[turn.calibration]
            if len(test) and calibration["is_answered"].any():
                frames.append(_judged(test, calibration, predictions, make).assign(is_own_calibration=turn.is_own))
    return _together(
        frames, [*scores.columns, "p_right", "remark", "is_calibrated", *map(_accepted, RISKS), "is_own_calibration"]
    )


def remarks_of(judged: pd.DataFrame) -> list[str]:
    """Return a rejector's remarks on its fits with the number of answers; remarks that differ in numbers are one.

    >>> remarks_of(pd.DataFrame({"remark": ["", "2 too few", "2 too few"], "is_answered": [True, True, False]}))
    ['2 too few (1 answer judged so)']
    >>> remarks_of(pd.DataFrame({"remark": ["2 too few", "9 too few", "9 too few"], "is_answered": True}))
    ['9 too few (and alike in 1 fit more: 3 answers judged so)']
    """
    remarks = judged.loc[judged["is_answered"].astype(bool) & (judged["remark"] != ""), "remark"]
    found = []
    for _, alike in remarks.groupby(remarks.str.replace(_NUMBER, "#", regex=True), sort=True):
        counts = alike.value_counts()
        most = min(counts.index[counts == counts.max()])
        others = f"and alike in {counted(len(counts) - 1, 'fit')} more: " if len(counts) > 1 else ""
        found.append(f"{most} ({others}{counted(len(alike), 'answer')} judged so)")
    return sorted(found)


def why_not(scores: pd.DataFrame, *, is_taught: bool = False) -> str:
    """Return why `judge` has no row for a matcher; `is_taught` as there."""
    if not scores["is_answered"].any():
        return "it has no answers to judge"
    if is_taught:
        return "no other place of the board is in the half of one that it answered"
    if len(set(scores["place"])) > 1:
        return "no place that may calibrate another one has an answer"
    return "no other place of the board calibrates"


def own_confidence(scores: pd.DataFrame, split: Split | None = None, *, is_taught: bool = False) -> pd.DataFrame:
    """Return a matcher's own confidences in the form of `judge`, as a rejector without a fit.

    The columns are `p_right`, always a probability, and `accepted_<risk>`, NaN where no place calibrates. Only tracks
    and prior groups with some confidence count; an answer without one is trusted least. Of a hold-out split only the
    test part counts. Without a split there are no thresholds.
    """
    usable = scores[scores["status"] != NOT_APPLICABLE]
    frames = []
    for _, group in usable.groupby(["track", "prior_group"], sort=True):
        p_right = np.where(group["is_answered"].to_numpy(bool), group["confidence"].to_numpy(float), np.nan)
        if not np.isnan(p_right).all():
            frames.append(_own_of_group(group.assign(p_right=p_right), split, is_taught=is_taught))
    return _together(frames, [*scores.columns, "p_right", *map(_accepted, RISKS)])


def _own_of_group(group: pd.DataFrame, split: Split | None, *, is_taught: bool) -> pd.DataFrame:
    """Return the tested rows of one track and prior group, with the fixes that thresholds of other places accept."""
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
    p_false, remark = _fit_and_apply(make, calibration, test, predictions)
    asked = test.assign(p_right=1.0 - p_false, remark=remark, is_calibrated=make().card.is_calibrated)
    known = calibration.assign(p_right=1.0 - _held_back(make, calibration, predictions))
    return asked.assign(**_accepted_rows(known, asked))


def _accepted_rows(known: pd.DataFrame, asked: pd.DataFrame) -> dict[str, Bools]:
    """Return which fixes the thresholds chosen on some rows accept, by column name."""
    calibration, test = answers_of(known), answers_of(asked)
    return {_accepted(risk): accept(test, choose_threshold(calibration, risk)) for risk in RISKS}


def _held_back(make: Make, calibration: pd.DataFrame, predictions: Mapping[str, Prediction]) -> Floats:
    """Return probabilities on calibration blocks, each from a fit on the others; a single block uses its own fit."""
    names = sorted(set(calibration["block"]))
    if len(names) < 2:  # noqa: PLR2004 - one block cannot be left out
        return _fit_and_apply(make, calibration, calibration, predictions)[0]
    fold = calibration["block"].map({name: at % _PARTS for at, name in enumerate(names)}).to_numpy()
    found = np.full(len(calibration), np.nan)
    for part in sorted(set(fold)):
        rest, mine = calibration[fold != part], calibration[fold == part]
        if rest["is_answered"].any():
            found[fold == part] = _fit_and_apply(make, rest, mine, predictions)[0]
    return found


def _fit_and_apply(
    make: Make, known: pd.DataFrame, asked: pd.DataFrame, predictions: Mapping[str, Prediction]
) -> tuple[Floats, str]:
    """Fit on the answers of some rows; return P(false) of others, NaN without an answer, and the remark on the fit."""
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
    except (Exception, SystemExit) as error:  # a plugin must not end the program
        message = f"rejector {rejector.card.name!r} failed ({message_of(error)}): mend it, or leave it out"
        raise MatchError(message) from error
    return found, remark


def _answers(rows: pd.DataFrame, predictions: Mapping[str, Prediction]) -> Sequence[Prediction]:
    return [predictions[name] for name in rows["query_id"]]


def answers_of(judged: pd.DataFrame) -> Answers:
    """Return rows of `judge` as `decisions.Answers`."""
    return Answers(
        confidence=judged["p_right"].to_numpy(float),
        is_answered=judged["is_answered"].to_numpy(bool),
        is_right=judged["is_right"].to_numpy(bool),
        is_present=judged["is_present"].to_numpy(bool),
    )


@dataclass(frozen=True, kw_only=True)
class RejectionTask:
    """Answers of one entry to evaluate with rejectors, by name; its own confidence is always added.

    `split` assigns calibration places. `is_taught` is True if the entry was trained on other places of the split.
    """

    matcher: str
    scores: pd.DataFrame
    predictions: Mapping[str, Prediction]
    rules: Mapping[str, Rule]
    split: Split | None
    is_taught: bool


@dataclass(frozen=True, kw_only=True)
class RejectionResult:
    """Rows of `judge` by matcher and rejector, rows of the board, and the rejectors' remarks on their fits."""

    judged: Mapping[tuple[str, str], pd.DataFrame]
    rows: Sequence[pd.DataFrame]
    remarks: tuple[str, ...]


def evaluate_rejectors(
    tasks: Sequence[RejectionTask], *, jobs: int, failures: Failures, tell: Tell, progress: Progress
) -> RejectionResult:
    """Evaluate all rejectors on the answers of each entry; the number of processes does not affect the result.

    Record rejectors that fail on an entry, and report those that do not apply to it. Raise the error of a rejector that
    fails on every entry: it is at fault, not the answers.
    """
    judged: dict[tuple[str, str], pd.DataFrame] = {}
    rows: list[pd.DataFrame] = []
    errors: dict[str, list[Exception]] = {}
    remarks: list[str] = []
    progress.begin(JUDGED, len(tasks))
    for task, results in zip(tasks, spread(_evaluated, tasks, jobs=jobs), strict=True):
        progress.advance(JUDGED, 1)
        for name, found in results.items():
            if isinstance(found, Exception):
                failures.note(f"{task.matcher} x {name}", found)
                errors.setdefault(name, []).append(found)
                continue
            frame, figures = found
            if name == OWN and not len(frame):
                continue
            judged[task.matcher, name] = frame
            rows.append(figures)
            if not len(frame):
                tell(f"{name} on {task.matcher}: not applied, {why_not(task.scores, is_taught=task.is_taught)}")
            elif name != OWN:
                remarks += [f"{name} on {task.matcher}: {remark}" for remark in remarks_of(frame)]
    for name, listed in errors.items():
        if name != OWN and len(listed) == len(tasks):
            raise listed[0]
    for remark in remarks:
        tell(remark)
    return RejectionResult(judged=judged, rows=rows, remarks=tuple(remarks))


def _evaluated(task: RejectionTask) -> dict[str, tuple[pd.DataFrame, pd.DataFrame] | Exception]:
    """Return by rejector the rows of `judge` and those of the board, or the error; own confidence comes first."""
    results: dict[str, tuple[pd.DataFrame, pd.DataFrame] | Exception] = {}
    for name in (OWN, *task.rules):
        try:
            if name == OWN:  # it counts as a probability
                frame, is_calibrated = own_confidence(task.scores, task.split, is_taught=task.is_taught), True
            else:
                rule = task.rules[name]
                frame = judge(task.scores, task.predictions, rule.make, rule.split, is_taught=task.is_taught)
                is_calibrated = rule.card.is_calibrated
            figures = to_frame(list(integrity_rows(task.matcher, name, frame, is_calibrated=is_calibrated)))
            results[name] = frame, figures
        except Exception as error:  # noqa: BLE001 - only this entry with this rejector is skipped
            results[name] = error
    return results
