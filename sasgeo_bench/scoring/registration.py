# SPDX-License-Identifier: Apache-2.0
"""What a contrast could show at all, computed from its queries before anybody is asked.

A registration whose least difference exceeds what can be gained is refused: no method could ever have been shown to
matter. The rest of it, of how many places it will speak and which difference so many can show, is printed.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Final

import pandas as pd

from sasgeo_bench.errors import ConfigError, counted
from sasgeo_bench.progress import tell
from sasgeo_bench.scoring.base import block_codes
from sasgeo_bench.scoring.compare import design_effect, detectable_difference, detectable_mean
from sasgeo_bench.scoring.contrasts import Contrast, chosen_rows
from sasgeo_bench.scoring.verdicts import (
    ALPHA,
    LEAST_PLACES,
    LESS,
    LOWER,
    RELATIVE,
    attainable,
    best_value,
    unreachable,
)
from sasgeo_bench.tasks.query import SEQUENCE

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
