# SPDX-License-Identifier: Apache-2.0
"""Measure a history of dated states: shares, shifts, rates and causes of change, per class and pair of dates."""

import datetime as dt
import hashlib
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Final

import geopandas as gpd
import numpy as np
import pandas as pd
import shapely

from sasgeo_bench.ageing.causes import (
    CAUSES,
    DAYS_PER_YEAR,
    RETAGGED,
    UNTOLD,
    WORLD,
    DrawnDays,
    Pair,
    Stock,
    causes_of_appeared,
    causes_of_vanished,
    cells_of,
    lost_shapes,
    streets_of,
    verdict_of,
)
from sasgeo_bench.ageing.compare import (
    REDRAWN_M,
    Floats,
    Ints,
    Verdict,
    cut_to,
    make_areas,
    make_pieces,
)
from sasgeo_bench.osm.history import History, ObjectKey, State
from sasgeo_bench.osm.taxonomy import Kind, load_taxonomy

DRAWS: Final = 1000
LEVEL: Final = 0.95
_NEWTON_STEPS: Final = 60


@dataclass(frozen=True, slots=True, kw_only=True)
class Rate:
    """A yearly rate and its 95 % interval; NaN if unknown, infinite if nothing is left."""

    per_year: float
    lo: float
    hi: float


def seeded_rng(*purpose: object) -> np.random.Generator:
    """Return a random generator for one purpose (place, class, dates), the same on every machine."""
    text = "/".join(map(str, purpose))
    return np.random.default_rng(int.from_bytes(hashlib.sha256(text.encode()).digest()[:16], "big"))


def loss_rate(lost: Floats, total: Floats, years: Floats) -> Floats:
    """Estimate the yearly rate of an exponential life by maximum likelihood, from amounts lost between dates.

    `lost` and `total` have shape (..., K): amounts lost within each of K intervals of lengths `years`, and amounts at
    their beginnings. The rate, shape (...), is NaN if there was nothing to lose, infinite if all was lost.

    Notes
    -----
    A loss is only known to lie between two dates. The score is sum(lost * t / expm1(rate * t)) - sum(kept * t) = 0. It
    decreases and is convex in the rate, so that Newton's steps from below reach its one root without passing it. One
    interval has the closed form -ln(1 - share) / t.

    Examples
    --------
    >>> loss_rate(np.array([10.0, 19.0]), np.array([100.0, 100.0]), np.array([1.0, 2.0])).round(4).item()
    0.1054
    """
    exposure = total.sum(axis=-1)
    kept = ((total - lost) * years).sum(axis=-1)
    some = lost.sum(axis=-1)
    rate = np.full(exposure.shape, np.nan)
    rate[(exposure > 0) & (some <= 0)] = 0.0
    rate[(exposure > 0) & (kept <= 0)] = np.inf
    solvable = (exposure > 0) & (some > 0) & (kept > 0)
    rate[solvable] = _root(lost[solvable], kept[solvable], some[solvable], years)
    return rate


def _root(lost: Floats, kept: Floats, some: Floats, years: Floats) -> Floats:
    """Solve the score equation, shapes (N, K), (N,), (N,) and (K,)."""
    # 1 / expm1(x) > 1 / x - 1 / 2, so the root of the right hand side lies below the true one.
    rate: Floats = some / (kept + (lost * years).sum(axis=-1) / 2)
    for _ in range(_NEWTON_STEPS):
        grown = np.expm1(rate[:, None] * years)
        score = (lost * years / grown).sum(axis=-1) - kept
        slope = -(lost * years**2 * (grown + 1) / grown**2).sum(axis=-1)
        step = -score / slope
        rate += step
        if (np.abs(step) <= 1e-12 * rate).all():
            break
    return rate


def bootstrap_rate(
    lost: Floats, total: Floats, years: Floats, *, things: int, rng: np.random.Generator, part: Floats | None = None
) -> Rate:
    """Estimate a yearly rate with a 95 % interval from resampled spatial blocks.

    `lost` and `total` have shape (B, K): amounts of B blocks in K intervals of lengths `years`; `part`, of that shape,
    is what of the lost amount has some cause, and the rate is then that of losses by this cause. If none of the
    `things` was lost so, the bootstrap has no variance, and the upper end is the rate at which losing none has a
    probability of 5 % (the rule of three). The interval is NaN for fewer than two blocks: neighbours change together,
    so one block is one sample.
    """
    part = lost if part is None else part
    best = float(_rate_of_part(lost.sum(axis=0), total.sum(axis=0), years, part.sum(axis=0)))
    if math.isnan(best):
        return Rate(per_year=best, lo=best, hi=best)
    if best == 0.0:
        # 0.05: probability of no loss at the upper end of a zero rate
        return Rate(per_year=0.0, lo=0.0, hi=float(-np.log(0.05) / (max(things, 1) * years.mean())))
    blocks = len(total)
    if blocks < 2:  # one block cannot differ from itself
        return Rate(per_year=best, lo=math.nan, hi=math.nan)
    weights = rng.multinomial(blocks, np.full(blocks, 1 / blocks), size=DRAWS).astype(np.float64)
    drawn = _rate_of_part(weights @ lost, weights @ total, years, weights @ part)
    drawn = drawn[~np.isnan(drawn)]  # a draw of empty blocks alone had nothing to lose
    tail = (1 - LEVEL) / 2
    lo, hi = np.quantile(drawn, [tail, 1 - tail], method="inverted_cdf")
    return Rate(per_year=best, lo=float(lo), hi=float(hi))


def _rate_of_part(lost: Floats, total: Floats, years: Floats, part: Floats) -> Floats:
    """Return the rate of losses by one cause: its share of all, for causes compete for the same things."""
    rate, some, whole = loss_rate(lost, total, years), part.sum(axis=-1), lost.sum(axis=-1)
    share = np.divide(some, whole, out=np.zeros_like(rate), where=whole > 0)
    return np.asarray(np.multiply(rate, share, out=np.zeros_like(rate), where=(share > 0) | np.isnan(rate)))


LEAST_DAYS: Final = 30  # a yearly rate from a shorter time would multiply the events of single days
UNITS: Final[dict[Kind, str]] = {"area": "m2", "line": "m"}

# Column -> pandas dtype. Shares lie within 0..1 and are NaN of an empty whole.
_RATES: Final = tuple(
    f"{what}_per_year{end}"
    for what in (
        *("vanish", "vanish_least", "vanish_most", "appear", "appear_least", "appear_most"),
        *("ground_lost", "ground_gained"),
    )
    for end in ("", "_lo", "_hi")
)
_SHARES: Final = (
    *("vanished_share", "appeared_share", "vanished_number_share", "appeared_number_share", "redrawn_share"),
    *("retagged_share", "ground_lost_share", "ground_gained_share", "shift_median_m", "shift_p90_m"),
    "id_vanished_share",
)
_EXPLAINED: Final = tuple(f"{what}_{cause}_share" for what in ("vanished", "appeared") for cause in CAUSES)
DTYPES: Final = {
    **dict.fromkeys(("place", "class", "unit", "span"), "str"),
    **dict.fromkeys(("date_from", "date_to"), "datetime64[ms]"),
    "years": "float64",
    **dict.fromkeys(("n_from", "n_to"), "int64"),
    **dict.fromkeys(("amount_from", "amount_to", *_SHARES, *_RATES, *_EXPLAINED), "float64"),
    "blocks": "int64",
}


@dataclass(frozen=True, slots=True, kw_only=True)
class _Change:
    """One class between two states: both verdicts, and the lost amount of each unit by cause, shape (U, 5)."""

    date_from: dt.date
    date_to: dt.date
    old: Verdict
    new: Verdict
    n_from: int
    n_to: int
    id_vanished_share: float
    vanished: Floats
    appeared: Floats

    @property
    def years(self) -> float:
        return (self.date_to - self.date_from).days / DAYS_PER_YEAR


@dataclass(frozen=True, slots=True, kw_only=True)
class Ageing:
    """Measurements of one place: a table with the columns of `DTYPES`, its states, and its area.

    `country` is an id as in the splits, empty where nobody said.
    """

    place: str
    country: str = ""
    sources: tuple[str, ...]
    area_km2: float
    table: pd.DataFrame


def measure_ageing(history: History, *, place: str, country: str = "") -> Ageing:
    """Measure how each class changed between the states (at least two) of a history; `place` seeds the bootstrap.

    In the table, `span` is "interval" for neighbouring dates, "whole" for the first against the last, and "pooled" for
    the rates that explain all intervals together, without shares.

    Only objects visible from above count, as in the layers: a stream put into a culvert has vanished, and is counted as
    retagged. `vanished_share` is of the older amount, `appeared_share` of the newer; `*_number_share` is the same by
    number of things, each of which counts as gone (or new) if more than half of it is. Rates of ground count what the
    class no longer, or newly, covers, so they hold what was redrawn too. Dates less than `LEAST_DAYS` apart get shares
    but no rates.
    """
    kinds = _kinds()
    changes = [_changes(pairs) for is_whole in (False, True) for pairs in pairs_of(history, is_whole=is_whole)]
    rows: list[dict[str, object]] = []
    for name in kinds:
        of_class = [change[name] for change in changes]
        if not any(item.n_from or item.n_to for item in of_class):
            continue
        common = {"place": place, "class": name, "unit": UNITS[kinds[name]]}
        rows += [common | _row(item, "interval", place=place, name=name) for item in of_class[:-1]]
        rows.append(common | _row(of_class[-1], "whole", place=place, name=name))
        rows.append(common | _pooled_row(of_class[:-1], place=place, name=name))
    table = pd.DataFrame(rows, columns=list(DTYPES)).astype(dict(DTYPES))
    numbers_only = [column for column, kind in DTYPES.items() if kind == "float64"]
    table[numbers_only] = table[numbers_only].round(6)
    return Ageing(
        place=place,
        country=country,
        sources=tuple(f"{state.source} of {state.on}" for state in history.states),
        area_km2=round(float(shapely.area(history.area)) / 1e6, 3),
        table=table,
    )


def pairs_of(history: History, *, is_whole: bool = False) -> Iterator[dict[str, Pair]]:
    """Yield the pairs of each class of neighbouring states, or those of the first and the last state alone."""
    kinds, states = _kinds(), history.states
    days = DrawnDays([state.features for state in states])
    last = len(states) - 1
    at = (0, last) if is_whole else range(last + 1)
    stocks = {index: _stocks(states[index], history.area, kinds, days) for index in at}
    for pair in pairwise(at):
        yield _pairs(states, stocks, pair, kinds)


def _kinds() -> dict[str, Kind]:
    return {item.name: item.kind for item in load_taxonomy().classes}


def _stocks(state: State, area: shapely.Geometry, kinds: dict[str, Kind], days: DrawnDays) -> dict[str, Stock]:
    features = state.features
    shapes = cut_to(np.asarray(features.geometry.array, dtype=object), area)
    classes, visible = features["class"].to_numpy(), features["is_visible"].to_numpy()
    widths_m = features["width_m"].to_numpy(dtype=np.float64)
    found = {}
    for name, kind in kinds.items():
        rows = np.flatnonzero((classes == name) & visible)
        things = make_areas(shapes[rows]) if kind == "area" else make_pieces(shapes[rows], widths_m[rows])
        hidden = shapes[(classes == name) & ~visible]
        keys = _keys(features, rows[things.rows])
        first, last = days.between(keys)
        found[name] = Stock(
            things=things, keys=keys, hidden=hidden[~shapely.is_empty(hidden)], drawn_from=first, drawn_to=last
        )
    return found


def _keys(features: gpd.GeoDataFrame, rows: Ints) -> list[ObjectKey]:
    types, ids = features["osm_type"].to_numpy()[rows], features["osm_id"].to_numpy()[rows]
    return [ObjectKey(*pair) for pair in zip(types.tolist(), ids.tolist(), strict=True)]


def _pairs(
    states: Sequence[State], stocks: Mapping[int, dict[str, Stock]], pair: tuple[int, int], kinds: dict[str, Kind]
) -> dict[str, Pair]:
    """Compare every class of two states; what replaced an object is known only after all classes are compared."""
    before, after = (states[index] for index in pair)
    old, new = (stocks[index] for index in pair)
    last, newest = states[-1], stocks[len(states) - 1]
    gone = {name: verdict_of(old[name], new[name]) for name in kinds}
    come = {name: verdict_of(new[name], old[name]) for name in kinds}
    left = {name: lost_shapes(old[name], gone[name]) for name in kinds}
    arrived = {name: lost_shapes(new[name], come[name]) for name in kinds}
    streets = streets_of(before)
    keys = [frozenset(_keys(state.features, np.arange(len(state.features)))) for state in (before, after)]
    found = {}
    for name, kind in kinds.items():
        others = [other for other in kinds if other != name and kinds[other] == kind]
        found[name] = Pair(
            name=name,
            old_on=before.on,
            new_on=after.on,
            old=old[name],
            new=new[name],
            gone=gone[name],
            come=come[name],
            into=np.concatenate([new[name].hidden, *(arrived[other] for other in others)]),
            out_of=np.concatenate([old[name].hidden, *(left[other] for other in others)]),
            old_keys=keys[0],
            new_keys=keys[1],
            old_hints=before.lifecycle,
            new_hints=after.lifecycle,
            streets=streets,
            newest=newest[name],
            unknown=come[name] if after is last else verdict_of(newest[name], old[name]),
            years_to_newest=(last.on - before.on).days / DAYS_PER_YEAR,
        )
    return found


def _changes(pairs: dict[str, Pair]) -> dict[str, _Change]:
    return {
        name: _Change(
            date_from=pair.old_on,
            date_to=pair.new_on,
            old=pair.gone,
            new=pair.come,
            n_from=len(pair.old.keys),
            n_to=len(pair.new.keys),
            id_vanished_share=_share(sum(key not in pair.new_keys for key in pair.old.keys), len(pair.old.keys)),
            vanished=causes_of_vanished(pair),
            appeared=causes_of_appeared(pair),
        )
        for name, pair in pairs.items()
    }


def _row(change: _Change, span: str, *, place: str, name: str) -> dict[str, object]:
    old, new = change.old, change.new
    amount_from, amount_to = float(old.amount.sum()), float(new.amount.sum())
    # Shift of each re-drawn thing, and the amount kept of it
    left = old.amount - old.lost
    kept = np.bincount(old.thing, weights=left, minlength=len(old.shift_m)).astype(np.float64)
    is_redrawn = np.nan_to_num(old.shift_m) > REDRAWN_M
    moved, weight = old.shift_m[is_redrawn], kept[is_redrawn]
    quantiles = _quantiles(moved, weight, (0.5, 0.9))
    return _rates([change], span, place=place, name=name) | {
        "n_from": change.n_from,
        "n_to": change.n_to,
        "amount_from": amount_from,
        "amount_to": amount_to,
        "vanished_share": _share(old.lost.sum(), amount_from),
        "appeared_share": _share(new.lost.sum(), amount_to),
        "vanished_number_share": _share(old.lost_things, change.n_from),
        "appeared_number_share": _share(new.lost_things, change.n_to),
        "redrawn_share": _share(weight.sum(), amount_from),
        "retagged_share": _share(change.vanished[:, RETAGGED].sum(), amount_from),
        "ground_lost_share": _share(old.uncovered.sum(), amount_from),
        "ground_gained_share": _share(new.uncovered.sum(), amount_to),
        "shift_median_m": quantiles[0],
        "shift_p90_m": quantiles[1],
        "id_vanished_share": change.id_vanished_share,
    }


def _pooled_row(changes: Sequence[_Change], *, place: str, name: str) -> dict[str, object]:
    first, last = changes[0], changes[-1]
    return _rates(changes, "pooled", place=place, name=name) | {
        "n_from": first.n_from,
        "n_to": last.n_to,
        "amount_from": float(first.old.amount.sum()),
        "amount_to": float(last.new.amount.sum()),
    }


def _rates(changes: Sequence[_Change], span: str, *, place: str, name: str) -> dict[str, object]:
    """Return the part that rows of one interval and of all share: dates, rates, explanations, number of blocks."""
    years = np.array([change.years for change in changes])
    first, last = changes[0].date_from, changes[-1].date_to
    old, new = _block_tables(changes)
    most = [WORLD, UNTOLD]
    sides = {
        "vanish": (old, old.lost, old.lost, "n_from"),
        "vanish_least": (old, old.lost, old.causes[..., WORLD], "n_from"),
        "vanish_most": (old, old.lost, old.causes[..., most].sum(axis=-1), "n_from"),
        "appear": (new, new.lost, new.lost, "n_to"),
        "appear_least": (new, new.lost, new.causes[..., WORLD], "n_to"),
        "appear_most": (new, new.lost, new.causes[..., most].sum(axis=-1), "n_to"),
        "ground_lost": (old, old.uncovered, old.uncovered, "n_from"),
        "ground_gained": (new, new.uncovered, new.uncovered, "n_to"),
    }
    rates: dict[str, object] = {}
    for what, (side, lost, part, count) in sides.items():
        rate = Rate(per_year=np.nan, lo=np.nan, hi=np.nan)
        if (last - first).days >= LEAST_DAYS:
            things = sum(getattr(change, count) for change in changes)
            rng = seeded_rng(place, name, span, first, last, what)
            rate = bootstrap_rate(lost, side.amount, years, things=things, rng=rng, part=part)
        column = f"{what}_per_year"
        rates |= {column: rate.per_year, f"{column}_lo": rate.lo, f"{column}_hi": rate.hi}
    return {
        "span": span,
        "date_from": pd.Timestamp(first),
        "date_to": pd.Timestamp(last),
        "years": float(years.sum()),
        **rates,
        **_shares("vanished", old),
        **_shares("appeared", new),
        "blocks": len(old.amount),
    }


def _shares(what: str, blocks: "_Blocks") -> dict[str, float]:
    """Return shares of the lost amount by cause; together they are 1."""
    amounts = blocks.causes.sum(axis=(0, 1))
    return {f"{what}_{cause}_share": _share(amounts[at], amounts.sum()) for at, cause in enumerate(CAUSES)}


@dataclass(frozen=True, slots=True, kw_only=True)
class _Blocks:
    """Amounts of one side of all intervals by block, each of shape (blocks, intervals); causes along a third axis."""

    amount: Floats
    lost: Floats
    uncovered: Floats
    causes: Floats


def _block_tables(changes: Sequence[_Change]) -> tuple[_Blocks, _Blocks]:
    sides = [
        [(change.old, change.vanished, cells_of(change.old.xy_m)) for change in changes],
        [(change.new, change.appeared, cells_of(change.new.xy_m)) for change in changes],
    ]
    blocks = np.unique(np.concatenate([cells for side in sides for *_, cells in side]))
    old, new = (_added_up(side, blocks) for side in sides)
    return old, new


def _added_up(side: Sequence[tuple[Verdict, Floats, Ints]], blocks: Ints) -> _Blocks:
    sums = []
    for verdict, causes, cells in side:
        at = np.searchsorted(blocks, cells)
        columns = (verdict.amount, verdict.lost, verdict.uncovered, *causes.T)
        sums.append([np.bincount(at, weights=of, minlength=len(blocks)) for of in columns])
    table = np.array(sums, dtype=np.float64).transpose(2, 0, 1)  # blocks, intervals, columns
    return _Blocks(amount=table[..., 0], lost=table[..., 1], uncovered=table[..., 2], causes=table[..., 3:])


def _quantiles(values: Floats, weights: Floats, levels: tuple[float, ...]) -> list[float]:
    """Return weighted quantiles; NaN for no values."""
    if len(values) == 0:
        return [float("nan")] * len(levels)
    order = np.argsort(values, kind="stable")
    passed = np.cumsum(weights[order])
    places = np.searchsorted(passed, np.array(levels) * passed[-1])
    return [float(values[order][min(place, len(values) - 1)]) for place in places.tolist()]


def _share(part: float, whole: float) -> float:
    return float(part / whole) if whole > 0 else float("nan")


SPANNED: Final = ("vanish", "vanish_least", "vanish_most", "appear", "appear_least", "appear_most")
_LEAST_PLACES: Final = 3  # fewer cannot be drawn anew: two places make three different draws


def by_country(places: Sequence[Ageing]) -> pd.DataFrame:
    """Put the places of each country together: a row for each class and country, with rates and their 95 % intervals.

    Amounts of all places and intervals are added up. The interval of three or more places comes from draws of places,
    since places differ by more than their blocks do; of two it reaches from the lowest end of their own to the highest,
    and of one it is its own. Places without a country are left out.
    """
    rows: list[dict[str, object]] = []
    known = [place.table.assign(place=place.place, country=place.country) for place in places if place.country]
    table = pd.concat(known, ignore_index=True) if known else pd.DataFrame(columns=["class", "country"])
    for name in load_taxonomy().names:
        for country, own in table[table["class"] == name].groupby("country", sort=False):
            found: dict[str, object] = {"class": name, "country": country, "places": own["place"].nunique()}
            for what in SPANNED:
                rate = _country_rate(own, what, name=name, country=str(country))
                column = f"{what}_per_year"
                found |= {column: rate.per_year, f"{column}_lo": rate.lo, f"{column}_hi": rate.hi}
            rows.append(found)
    return pd.DataFrame(rows)


def _country_rate(table: pd.DataFrame, what: str, *, name: str, country: str) -> Rate:
    side, _, bound = what.partition("_")
    past, end = {"vanish": ("vanished", "from"), "appear": ("appeared", "to")}[side]
    causes = {"": CAUSES, "least": ("world",), "most": ("world", "untold")}[bound]
    pairs = table[(table["span"] == "interval") & (table[f"amount_{end}"] > 0)]
    total = pairs[f"amount_{end}"].to_numpy()
    lost = total * pairs[f"{past}_share"].to_numpy()
    part = lost * np.nan_to_num(pairs[[f"{past}_{cause}_share" for cause in causes]].to_numpy()).sum(axis=1)
    years = pairs["years"].to_numpy()
    places = pairs["place"].drop_duplicates().tolist()
    if len(places) < _LEAST_PLACES:
        own = table[table["span"] == "pooled"]
        best = float(_rate_of_part(lost, total, years, part)) if len(pairs) else math.nan
        return Rate(
            per_year=best,
            lo=own[f"{what}_per_year_lo"].min(skipna=True),
            hi=own[f"{what}_per_year_hi"].max(skipna=True),
        )
    at = np.searchsorted(np.sort(places), pairs["place"].to_numpy())
    rows = at[None, :] == np.arange(len(places))[:, None]  # places, intervals
    things = int(pairs[f"n_{end}"].sum())
    rng = seeded_rng(country, name, what)
    return bootstrap_rate(rows * lost, rows * total, years, things=things, rng=rng, part=rows * part)
