# SPDX-License-Identifier: Apache-2.0
"""Registered contrasts: two methods on the same queries, tested as registered before any run."""

import math
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Annotated, ClassVar, Final

import numpy as np
import pandas as pd
from pydantic import ConfigDict, Field
from scipy.sparse import hstack

from sasgeo_bench.core.errors import ConfigError, counted
from sasgeo_bench.core.progress import tell
from sasgeo_bench.scoring.base import Bools, Floats, block_codes, codes_of
from sasgeo_bench.scoring.compare import (
    ALPHA,
    LEAST_PLACES,
    LESS,
    LOWER,
    OF_MATCHERS,
    RELATIVE,
    ContrastMetric,
    Finding,
    attainable,
    best_value,
    design_effect,
    detectable_difference,
    detectable_mean,
    holm,
    mcnemar_clustered,
    mcnemar_exact,
    sensitivity,
    sign_flip,
    swap_places,
    unreachable,
)
from sasgeo_bench.scoring.decisions import Curve, aurc, auroc, excess_aurc
from sasgeo_bench.scoring.intervals import (
    DRAWS,
    BoardDraws,
    ClusterDraws,
    Interval,
    bootstrap_means,
    difference_interval,
    percentile_interval,
    seed_of_text,
    wilson_share,
)
from sasgeo_bench.scoring.metrics import THRESHOLDS, mean_of, primary_of
from sasgeo_bench.scoring.rejection_rows import SLOW_DRAWS, answers_of
from sasgeo_bench.tasks.query import PUBLISHED, SEQUENCE, UNRIVALLED, Detector, Track

PRIMARY: Final = "primary"
AREAS: Final = {"aurc": aurc, "e_aurc": excess_aurc, "auroc": auroc}
ACCEPTED: Final = {metric.name: metric.accepted for metric in THRESHOLDS if metric.what == "right"}


@dataclass(frozen=True, slots=True, kw_only=True)
class Contrast:
    """Two methods and the queries they are compared on, as a pipeline file registers it.

    The difference is `first` less `second`: matchers, or for metrics of rejectors each "matcher x rejector". The
    queries are those of `suites`, pooled, on one track; `kinds` are prefixes of the kinds that count, as in "U2", all
    if empty; `detectors` those whose views count, all if empty.

    The metric is "primary", success or recall at 1 on present places under stress; "interaction", the same less what
    the method reaches on the control of the same site and view, so that the difference is what the stress adds to the
    difference; "shift", the same less what the method reaches on the view of the same site by the detector
    `published`, so that the difference is what another detector adds to it; "false_accepted" of flights, the share of
    the views with an accepted fix that is false; or of rejectors, on all places: "e_aurc", the area under the
    risk-coverage curve above that of a perfect order; "auroc", the chance that a right answer is surer than a false
    one; "right_at_absent_0.05", the share of present places that are rightly accepted where 5 % of the absent ones are;
    "aurc", the whole area, of which a perfect order has much where many answers are false. `min_effect` is the least
    relevant difference: of fractions, or for "aurc" and "e_aurc" relative to the second method.
    """

    __pydantic_config__: ClassVar = ConfigDict(extra="forbid")  # where manifests hold contrasts

    name: str
    first: str
    second: str
    suites: tuple[str, ...]
    kinds: tuple[str, ...] = ()
    detectors: tuple[Detector, ...] = ()
    metric: ContrastMetric = "primary"
    track: Track = "localization"
    min_effect: Annotated[float, Field(ge=0, le=1, strict=True)] = 0.03

    def queries_text(self) -> str:
        """Name the queries that count.

        >>> Contrast(name="seen", first="a", second="b", suites=("clean",), detectors=("measured",)).queries_text()
        'suites clean, detectors measured'
        """
        chosen = {"suites": self.suites, "kinds": self.kinds, "detectors": self.detectors}
        return ", ".join(f"{name} {', '.join(values)}" for name, values in chosen.items() if values)


def evaluate_contrasts(
    contrasts: Sequence[Contrast],
    scores: Mapping[str, pd.DataFrame],
    rejections: Mapping[tuple[str, str], pd.DataFrame],
    *,
    draws: int = DRAWS,
    failed: Collection[str] = (),
) -> tuple[Finding, ...]:
    """Test every registered contrast, in order; a contrast without queries, or with a failed side, has p = 1.

    `contrasts` are all registered ones and no others: Holm's adjustment covers them. `scores` are scored rows by
    matcher, `rejections` those of `rejection.judge` by matcher and rejector. `failed` names matchers, and "matcher x
    rejector", that failed and so are not on the board. Raise ConfigError if a contrast names a method that is not on
    the board, and none failed.
    """
    there = scores.keys() | {" x ".join(key) for key in rejections}
    found = [
        _tested(contrast, scores, rejections, draws)
        if not failed or {contrast.first, contrast.second} <= there
        else replace(_nothing(contrast), note=_undecided(contrast, there, failed))
        for contrast in contrasts
    ]
    adjusted = holm({item.name: 1.0 if math.isnan(item.p_places) else item.p_places for item in found})
    return tuple(replace(item, p_holm=adjusted[item.name]) for item in found)


def _undecided(contrast: Contrast, there: Collection[str], failed: Collection[str]) -> str:
    """Return the verdict of a contrast with a side that is not on a board where something failed."""
    side = next(name for name in (contrast.first, contrast.second) if name not in there)
    is_known = side in failed or side.split(" x ", maxsplit=1)[0] in failed
    return f"not decided: {side} {'failed' if is_known else 'is not on the board'}"


def _tested(
    contrast: Contrast,
    scores: Mapping[str, pd.DataFrame],
    rejections: Mapping[tuple[str, str], pd.DataFrame],
    draws: int,
) -> Finding:
    first, second = _pair(contrast, scores, rejections)
    if contrast.metric in AREAS:
        return _area_finding(contrast, first, second) if len(first) else _nothing(contrast)
    if contrast.metric in LESS:
        sides = _less_other(contrast, scores, first, second)
        return _value_finding(contrast, first[sides.is_counted], sides, draws)
    return mean_finding(contrast, first, second, draws)


def _pair(
    contrast: Contrast, scores: Mapping[str, pd.DataFrame], rejections: Mapping[tuple[str, str], pd.DataFrame]
) -> tuple[pd.DataFrame, pd.DataFrame]:
    """Return rows of both sides for the same queries in the same order."""
    is_of_rejectors = contrast.metric not in OF_MATCHERS
    known = {" x ".join(key): rows for key, rows in rejections.items()} if is_of_rejectors else scores
    return both_on(contrast, known, _counted(contrast))


def both_on(
    contrast: Contrast, known: Mapping[str, pd.DataFrame], chosen: Callable[[pd.DataFrame], "pd.Series[bool]"]
) -> tuple[pd.DataFrame, pd.DataFrame]:
    """Return rows of both sides on a contrast's suites, track and kinds, for the same queries in the same order.

    `known` holds scored rows by the names of sides; `chosen` selects the rows that count, shape (N,). Raise ConfigError
    if a side is not on the board.
    """
    frames = []
    for name in (contrast.first, contrast.second):
        if name not in known:
            there = ", ".join(sorted(known)) or "nothing of the kind"
            raise ConfigError(f"contrast {contrast.name!r} names {name!r}, which is not on the board: there is {there}")
        frames.append(_rows_of(contrast, known[name], chosen))
    shared = sorted(set(frames[0]["query_id"]) & set(frames[1]["query_id"]))
    first, second = (frame.set_index("query_id", drop=False).loc[shared] for frame in frames)
    return first, second


@dataclass(frozen=True, slots=True, kw_only=True)
class PlaceDifference:
    """Difference of a contrast at one place, first less second, with its 95 % interval and sample sizes."""

    place: str
    n: int
    blocks: int
    difference: float
    lo: float
    hi: float


def by_place(
    contrast: Contrast,
    scores: Mapping[str, pd.DataFrame],
    rejections: Mapping[tuple[str, str], pd.DataFrame],
    *,
    draws: int = SLOW_DRAWS,
) -> tuple[PlaceDifference, ...]:
    """Return the difference of a contrast at each place, by name; exploratory, not part of the registered test.

    Parameters and errors are those of `evaluate_contrasts`; blocks are resampled within each place.
    """
    first, second = _pair(contrast, scores, rejections)
    places = first["place"].to_numpy(str)
    return tuple(
        _at_place(contrast, scores, (first[places == place], second[places == place]), draws)
        for place in np.unique(places)
    )


def _at_place(
    contrast: Contrast, scores: Mapping[str, pd.DataFrame], rows: tuple[pd.DataFrame, pd.DataFrame], draws: int
) -> PlaceDifference:
    if contrast.metric in AREAS:
        found = _area_finding(contrast, *rows)
    else:
        sides = _less_other(contrast, scores, *rows) if contrast.metric in LESS else _sides(contrast, *rows)
        found = _value_finding(contrast, rows[0][sides.is_counted], sides, draws, is_tested=False)
    return PlaceDifference(
        place=str(rows[0]["place"].iloc[0]),
        n=found.n,
        blocks=found.blocks,
        difference=found.difference,
        lo=found.lo_blocks,
        hi=found.hi_blocks,
    )


def chosen_rows(contrast: Contrast, frame: pd.DataFrame) -> pd.DataFrame:
    """Return the scored rows that a contrast counts: its suites, kinds, detectors and track."""
    return _rows_of(contrast, frame, _counted(contrast))


def _rows_of(
    contrast: Contrast, frame: pd.DataFrame, chosen: Callable[[pd.DataFrame], "pd.Series[bool]"]
) -> pd.DataFrame:
    """Return chosen rows of a contrast: suites, track, detectors and kinds; without stress rows belong to all kinds.

    Twins and lures that no search lists count for no contrast.
    """
    rows = frame[frame["suite"].isin(contrast.suites) & (frame["track"] == contrast.track)]
    if contrast.detectors:
        rows = rows[rows["detector"].isin(contrast.detectors)]
    rows = rows[chosen(rows).to_numpy(bool)]
    is_kind = rows["kind"].str.startswith(contrast.kinds or "") & ~rows["kind"].str.startswith(UNRIVALLED)
    is_kind |= rows["role"] != "stress"
    return rows[is_kind.to_numpy(bool)]


def _counted(contrast: Contrast) -> Callable[[pd.DataFrame], "pd.Series[bool]"]:
    """Return a function that masks the rows a contrast counts: present places under stress, or all but falsifiers."""
    if contrast.metric in AREAS:
        return lambda rows: rows["role"] != "falsifier"
    if contrast.metric in ACCEPTED:
        return lambda rows: rows["is_present"].astype(bool) & (rows["role"] != "falsifier")
    return lambda rows: rows["is_present"].astype(bool) & (rows["role"] == "stress")


def _nothing(contrast: Contrast) -> Finding:
    return Finding(
        name=contrast.name,
        first=contrast.first,
        second=contrast.second,
        metric=contrast.metric,
        least=contrast.min_effect,
        is_lower_better=contrast.metric in LOWER,
    )


def _drawn(contrast: Contrast, rows: pd.DataFrame, draws: int) -> BoardDraws:
    names = (rows[name].tolist() for name in ("place", "block", "pair_id"))
    return BoardDraws.of(*names, seed=seed_of_text(contrast.name), draws=draws)


def _by_country(contrast: Contrast, rows: pd.DataFrame, draws: int) -> ClusterDraws | None:
    """Draw countries, places in them, and blocks in these; None where no country has several places."""
    if rows["country"].nunique() == rows["place"].nunique():
        return None
    country, place, block = (rows[name].tolist() for name in ("country", "place", "block"))
    return ClusterDraws(places=country, blocks=place, sites=block, seed=seed_of_text(contrast.name), draws=draws)


@dataclass(frozen=True, slots=True, kw_only=True)
class _Sides:
    """Values of both sides per counted query, the best ones the first side could have, shape (N,) each.

    `is_counted` masks the rows of the pair that have a value.
    """

    ours: Floats
    theirs: Floats
    best: Floats
    is_counted: Bools


def _sides(contrast: Contrast, first: pd.DataFrame, second: pd.DataFrame) -> _Sides:
    """Return the primary metric of both sides, false fixes, or which present places they rightly accept."""
    every = np.ones(len(first), dtype=bool)
    if contrast.metric in OF_MATCHERS:
        is_primary = contrast.metric == PRIMARY
        metric = primary_of(contrast.track) if is_primary else mean_of(contrast.track, contrast.metric)
        best: Floats = first["ceiling"].to_numpy(float) if is_primary else np.zeros(len(first))
        return _Sides(ours=metric.values(first), theirs=metric.values(second), best=best, is_counted=every)
    column = ACCEPTED[contrast.metric]
    every = (first[column].notna() & second[column].notna()).to_numpy(bool)
    ours, theirs = (
        (rows[column].to_numpy(float) * rows["is_right"].to_numpy(float))[every] for rows in (first, second)
    )
    return _Sides(ours=ours, theirs=theirs, best=first["is_right"].to_numpy(float)[every], is_counted=every)


def _less_other(
    contrast: Contrast, scores: Mapping[str, pd.DataFrame], first: pd.DataFrame, second: pd.DataFrame
) -> _Sides:
    """Return the primary metric of both sides less that on other views of the same site and size.

    Of an interaction these are the controls by the same detector, of a shift the same variants by the other detector.
    """
    is_shift = contrast.metric == "shift"
    metric = primary_of(contrast.track)
    key = ["suite", "pair_id", "view_cells", *(("kind", "strength") if is_shift else ("detector",))]
    others = both_on(
        replace(contrast, detectors=(PUBLISHED,)) if is_shift else contrast,
        scores,
        _counted(contrast) if is_shift else lambda rows: rows["is_present"].astype(bool) & (rows["role"] == "control"),
    )
    before = []
    for rows, control in zip((first, second), others, strict=True):
        of_site = pd.Series(metric.values(control), index=pd.MultiIndex.from_frame(control[key]))
        mean = of_site.groupby(level=key).mean()
        before.append(mean.reindex(pd.MultiIndex.from_frame(rows[key])).to_numpy(float))
    is_counted = ~(np.isnan(before[0]) | np.isnan(before[1]))
    ours, theirs = (
        (metric.values(rows) - control)[is_counted] for rows, control in zip((first, second), before, strict=True)
    )
    best = np.asarray((first["ceiling"].to_numpy(float) - before[0])[is_counted], dtype=np.float64)
    return _Sides(ours=ours, theirs=theirs, best=best, is_counted=is_counted)


def mean_finding(
    contrast: Contrast, first: pd.DataFrame, second: pd.DataFrame, draws: int, *, is_tested: bool = True
) -> Finding:
    """Return the finding by success or recall on the same queries in the same order, without Holm's adjustment.

    Without `is_tested`, leave out p over places, the interval by countries and what is detectable, which take longest.
    """
    sides = _sides(contrast, first, second)
    found = _value_finding(contrast, first[sides.is_counted], sides, draws, is_tested=is_tested)
    if not found.n:
        return found
    whole = 0.0 if found.is_lower_better else 1.0  # a shared tie is no win
    won = [(values == whole).astype(float) for values in (sides.ours, sides.theirs)]
    blocks = first["block"][sides.is_counted].tolist()
    exact, clustered = mcnemar_exact(won[0], won[1]), mcnemar_clustered(won[0], won[1], blocks)
    places = first["place"][sides.is_counted].tolist()
    is_enough = is_tested and found.places >= LEAST_PLACES
    return replace(
        found,
        first_only=exact.first_only,
        second_only=exact.second_only,
        p_exact=exact.p_value,
        p_clustered=clustered.p_value,
        detectable=sensitivity(sides.ours, sides.theirs, places, are_shares=contrast.track == SEQUENCE)
        if is_enough
        else math.nan,
    )


def _value_finding(
    contrast: Contrast, rows: pd.DataFrame, sides: _Sides, draws: int, *, is_tested: bool = True
) -> Finding:
    """Return the finding by means of values; `rows` are those of the counted queries."""
    if not len(rows):
        return _nothing(contrast)
    gaps = sides.ours - sides.theirs
    drawn = _drawn(contrast, rows, draws)
    won = (float(np.maximum(gaps, 0.0).mean()), float(np.maximum(-gaps, 0.0).mean()))
    means = drawn.means(gaps[:, None])
    place = codes_of(rows["place"])
    found = replace(
        _nothing(contrast),
        n=len(gaps),
        blocks=drawn.by_block.units_count,
        places=drawn.by_place.units_count,
        first_value=float(sides.ours.mean()),
        second_value=float(sides.theirs.mean()),
        best=float(sides.best.mean()),
        difference=float(gaps.mean()),
        first_only=int((gaps > 0).sum()),
        second_only=int((gaps < 0).sum()),
        p_places=sign_flip(np.bincount(place, weights=gaps).astype(float)) if is_tested else math.nan,
    )
    varied = (rows.loc[gaps != 0, "place"].nunique(), rows.loc[gaps != 0, "block"].nunique())
    found = _with_ends(found, (means[0][:, 0], means[1][:, 0]), won, drawn.trials, varied)
    far = _by_country(contrast, rows, draws) if is_tested else None
    return _with_countries(found, rows, None if far is None else bootstrap_means(gaps[:, None], far)[:, 0])


def _area_finding(contrast: Contrast, first: pd.DataFrame, second: pd.DataFrame) -> Finding:
    """Return the finding by an area of the answers of both sides."""
    both = [answers_of(frame) for frame in (first, second)]
    area = AREAS[contrast.metric]
    ours, theirs = (area(answers) for answers in both)
    drawn = _drawn(contrast, first, SLOW_DRAWS)

    curves = [Curve.of(answers, is_merged=True) for answers in both]
    table = hstack([curve.sides for curve in curves], format="csr")
    columns = curves[0].sides.shape[1]

    def gaps_of(one: ClusterDraws) -> Floats:
        """Return the difference of the areas in every draw."""
        gaps = []
        for masses in one.sums(table):
            sides = zip(curves, (masses[:, :columns], masses[:, columns:]), strict=True)
            found = [getattr(curve.areas(mine), contrast.metric) for curve, mine in sides]
            gaps.append(found[0] - found[1])
        return np.concatenate(gaps)

    gaps = drawn.of_both(gaps_of)
    place = codes_of(first["place"])
    is_relative = contrast.metric in RELATIVE
    best = {"aurc": aurc(both[0]) - excess_aurc(both[0]), "e_aurc": 0.0, "auroc": 1.0}[contrast.metric]
    found = replace(
        _nothing(contrast),
        n=len(first),
        blocks=drawn.by_block.units_count,
        places=drawn.by_place.units_count,
        first_value=ours,
        second_value=theirs,
        best=best,
        difference=ours - theirs,
        p_places=swap_places(both[0], both[1], place, contrast.metric),
        least=contrast.min_effect * (abs(theirs) if is_relative else 1.0),
    )
    units = (drawn.by_place.units_count, drawn.by_block.units_count)
    found = _with_ends(found, gaps, (ours, theirs), drawn.trials, units)
    far = _by_country(contrast, first, SLOW_DRAWS)
    return _with_countries(found, first, None if far is None else gaps_of(far))


def _with_ends(
    found: Finding, draws: tuple[Floats, Floats], sides: tuple[float, float], trials: float, varied: tuple[int, int]
) -> Finding:
    """Return a finding with the ends of the intervals by places and by blocks; the former are never inside the latter.

    `varied` counts the places and the blocks in which the sides differ. Draws of few of these say little: where the
    first side wins one query and loses none, no draw has a loss, though as many more queries might have one. Then
    Wilson's intervals of both `sides`, two fractions whose difference it is (of queries won and lost, or two areas),
    over as many `trials` as there are sites, set the least width.
    """
    wide = difference_interval(*(wilson_share(min(side, 1.0), trials) for side in sides))
    both: list[Interval] = []
    for values, count in zip(draws, varied, strict=True):
        ends = percentile_interval(found.difference, values)
        is_enough = count >= LEAST_PLACES and ends.lo < ends.hi
        both.append(ends if is_enough else _around(ends, wide))
    places, blocks = _around(*both), both[1]
    return replace(found, lo=places.lo, hi=places.hi, lo_blocks=blocks.lo, hi_blocks=blocks.hi)


def _with_countries(found: Finding, rows: pd.DataFrame, draws: Floats | None) -> Finding:
    """Return a finding with the number of countries and, from draws of these, an interval no narrower than by places.

    Without draws no country has several places, and there is no interval.
    """
    found = replace(found, countries=int(rows["country"].nunique()))
    if draws is None or found.countries < LEAST_PLACES:
        return found
    by_places = Interval(value=found.difference, lo=found.lo, hi=found.hi)
    ends = _around(percentile_interval(found.difference, draws), by_places)
    return replace(found, lo_countries=ends.lo, hi_countries=ends.hi)


def _around(first: Interval, second: Interval) -> Interval:
    """Return the interval around two; NaN counts as inside."""
    return Interval(value=first.value, lo=float(np.fmin(first.lo, second.lo)), hi=float(np.fmax(first.hi, second.hi)))


CORRELATION: Final = 0.05  # of the differences of two queries of one place, unless a pilot says otherwise


@dataclass(frozen=True, slots=True, kw_only=True)
class Pilot:
    """What is known of a contrast from train places, before it is registered.

    `second` is the metric of the second side, `control` of an interaction or a shift the share that the first side
    reaches on the other views, `false_share` the share of the second side's answers that are false, `discordant` the
    share of queries that just one side gets right, `spread` of flights the standard deviation of the difference of one,
    `correlation` how much more alike differences of one place are than those of two. None where nothing is known.
    """

    second: float | None = None
    control: float | None = None
    false_share: float | None = None
    discordant: float | None = None
    spread: float | None = None
    correlation: float = CORRELATION


@dataclass(frozen=True, slots=True, kw_only=True)
class Registration:
    """What a contrast could show: its queries, the best attainable value and gain, and the power of its places.

    `attainable` is the most that the first side can gain on the second, NaN if not known, `least` what is to matter;
    `detectable` the least difference that so many places show at 5 % with a power of 80 %, `detectable_first` at 5 %
    divided by the number of contrasts, as Holm's adjustment asks of the first; both NaN for areas.
    """

    name: str
    queries: int
    blocks: int
    places: int
    countries: int
    best: float
    second: float | None
    attainable: float
    least: float
    detectable: float
    detectable_first: float

    def to_text(self) -> str:
        """Return the registration in a line.

        >>> print(Registration(name="graph", queries=285, blocks=95, places=18, countries=9, best=1.0, second=0.6,
        ...     attainable=0.4, least=0.03, detectable=0.06, detectable_first=0.08).to_text())
        ... # doctest: +NORMALIZE_WHITESPACE
        graph: 285 queries in 95 blocks, 18 places of 9 countries; at most 0.400 can be gained (best 1.000, second
        0.600), 0.030 is to matter; the least difference that so many places can show is 0.060, or 0.080 if it comes
        first in Holm's order
        """
        of = f" of {counted(self.countries, 'country', 'countries')}" if self.countries < self.places else ""
        few = "" if self.places >= LEAST_PLACES else f"; too few to decide anything, at least {LEAST_PLACES} are needed"
        return (
            f"{self.name}: {counted(self.queries, 'query', 'queries')} in {counted(self.blocks, 'block')}, "
            f"{counted(self.places, 'place')}{of}; {self._gain()}, {self.least:.3f} is to matter{self._power()}{few}"
        )

    def _gain(self) -> str:
        """Say what can be gained, if it is known."""
        if math.isnan(self.attainable):
            return "what can be gained is not known"
        second = "not known" if self.second is None else f"{self.second:.3f}"
        return f"at most {self.attainable:.3f} can be gained (best {self.best:.3f}, second {second})"

    def _power(self) -> str:
        """Say which difference the places show, at both ends of Holm's order."""
        if math.isnan(self.detectable):
            return ""
        if math.isinf(self.detectable):
            return "; nothing can be shown unless more queries differ than a pilot says, or twice what matters"
        last, first = (
            "none" if math.isinf(least) else f"{least:.3f}" for least in (self.detectable, self.detectable_first)
        )
        more = "" if first == last else f", or {first} if it comes first in Holm's order"
        return f"; the least difference that so many places can show is {last}{more}"


def check_contrasts(
    contrasts: Sequence[Contrast],
    pilots: Mapping[str, Pilot],
    design: pd.DataFrame,
) -> tuple[Registration, ...]:
    """Return what each contrast could show, and tell it.

    `design` holds a row for each drawn query, as `score.score_task` returns them without predictions. Raise ConfigError
    for the first contrast whose least difference cannot be reached.
    """
    found = tuple(
        registered(item, pilots.get(item.name, Pilot()), design, contrasts=len(contrasts)) for item in contrasts
    )
    for item, one in zip(contrasts, found, strict=True):
        tell(one.to_text())
        message = unreachable(one.name, item.metric, gain=one.attainable, least=one.least)
        if one.queries and message is not None:
            raise ConfigError(message)
    return found


def registered(contrast: Contrast, pilot: Pilot, design: pd.DataFrame, *, contrasts: int = 1) -> Registration:
    """Return what one of so many contrasts could show.

    Without a pilot the share of false answers is the least one, which absent places force, and the second side orders
    blindly.

    Three quarters of the places are absent, so a perfect order has most of the area already:

    >>> names = {"suite": "absent", "track": "localization", "role": "stress", "kind": "outside"}
    >>> some = pd.DataFrame([{**names, "is_present": at == 0, "ceiling": float(at == 0), "place": str(at),
    ...     "block": str(at), "country": str(at)} for at in range(4)])
    >>> contrast = Contrast(name="r", first="a x b", second="a x c", suites=("absent",), metric="aurc", min_effect=0.2)
    >>> found = registered(contrast, Pilot(second=0.45, false_share=0.75), some)
    >>> round(found.best, 3), round(found.attainable, 3), round(found.least, 3)
    (0.403, 0.047, 0.09)
    """
    rows = chosen_rows(contrast, design)
    best, blind = _best_and_blind(contrast, pilot, rows)
    second = pilot.second
    value = blind if second is None else second
    return Registration(
        name=contrast.name,
        queries=len(rows),
        blocks=int(rows["block"].nunique()),
        places=int(rows["place"].nunique()),
        countries=int(rows["country"].nunique()),
        best=best,
        second=second,
        attainable=attainable(best, value, is_lower_better=contrast.metric in LOWER),
        least=contrast.min_effect * (value if contrast.metric in RELATIVE else 1.0),
        detectable=_detectable(contrast, pilot, rows, ALPHA),
        detectable_first=_detectable(contrast, pilot, rows, ALPHA / contrasts),
    )


def _best_and_blind(contrast: Contrast, pilot: Pilot, rows: pd.DataFrame) -> tuple[float, float]:
    """Return the best value, and the one that the second side reaches blindly, where nothing else is known of it."""
    if not len(rows):
        return math.nan, math.nan
    ceiling, absent = float(rows["ceiling"].mean()), 1.0 - float(rows["is_present"].mean())
    false = absent if pilot.false_share is None else pilot.false_share
    best = best_value(contrast.metric, ceiling=ceiling, control=pilot.control, false_share=false)
    blind = {
        "auroc": 0.5,
        "aurc": false,
        "e_aurc": false - best_value("aurc", false_share=false),
        **dict.fromkeys(LESS, math.nan),
        "false_accepted": math.nan,
    }
    return best, blind.get(contrast.metric, 0.0)


def _detectable(contrast: Contrast, pilot: Pilot, rows: pd.DataFrame, level: float) -> float:
    """Return the least difference that the places show; the discordant queries are twice the least difference.

    Of flights it follows from the pilot's spread, and is not known without. Otherwise it is infinite where too few
    places have a discordant query: the sign-flip test over k of them has no p below 2 / 2^k.
    """
    if contrast.metric in {"aurc", "e_aurc", "auroc"} or not len(rows):
        return math.nan
    sizes, _ = block_codes(rows["place"].tolist(), len(rows))
    pairs = len(rows) / design_effect(sizes, pilot.correlation)
    if contrast.track == SEQUENCE:
        return math.nan if pilot.spread is None else detectable_mean(pairs, pilot.spread, level=level)
    share = min(1.0, 2 * contrast.min_effect) if pilot.discordant is None else pilot.discordant
    if min(len(sizes), share * len(rows)) < math.log2(2 / level):
        return math.inf
    return detectable_difference(pairs, share, level=level)
