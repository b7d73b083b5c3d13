# SPDX-License-Identifier: Apache-2.0
"""Tell why things vanished from a map or appeared on it: the world, mapping, redrawing, retagging, or untold.

Evidence in order of strength: lifecycle tags, what stands in the place now, ids, dates of drawing, and neighbours. An
extract without times of its objects gives no dates of drawing, and more of its changes stay untold.
"""

import datetime as dt
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
import pandas as pd
import shapely

from sasgeo_bench.ageing.compare import (
    COVER_SHARE,
    NEAR_M,
    REDRAWN_M,
    Areas,
    Flags,
    Floats,
    Geometries,
    Ints,
    Pieces,
    Verdict,
    compare_areas,
    compare_pieces,
    covered_share,
    distance_m,
    polygons_of,
    replaced_share,
)
from sasgeo_bench.geometry.pairs import overlapping
from sasgeo_bench.osm.history import Lifecycle, ObjectKey, State
from sasgeo_bench.osm.taxonomy import load_taxonomy

CAUSES: Final = ("world", "mapping", "redrawn", "retagged", "untold")
WORLD, MAPPING, REDRAWN, RETAGGED, UNTOLD = range(len(CAUSES))

DAYS_PER_YEAR: Final = 365.25
BLOCK_M: Final = 1000.0
REACH_M: Final = 15.0  # aerial images of different years lie up to this far apart, and what is traced from them
STREET_M: Final = 50.0  # a house this near to a street belongs to it
BULK_THINGS: Final = 10  # of a class in one block on one day: drawn from an image or imported, not one by one
LEAST_NEIGHBOURS: Final = 10  # fewer say nothing of their block
# Of a block's stock, a year. Settled ground gains about 1 % of buildings a year; no square kilometre builds 10 %.
SETTLED_PER_YEAR: Final = 0.02
CATCH_UP_PER_YEAR: Final = 0.10
LINE_THING_M: Final = 50.0  # of line counts as one neighbour
_BUILT: Final = (*load_taxonomy().having("built"), "railway", "bridge")
_DAY: Final = np.timedelta64(1, "D")

Days = np.ndarray[tuple[int], np.dtype[np.datetime64]]


@dataclass(frozen=True, slots=True, kw_only=True)
class Stock:
    """One class in one state, cut to the common area; `hidden` is the part of it not visible from above.

    `keys` and the days between which each thing was drawn, `drawn_from` and `drawn_to`, are of the T things; not-a-time
    where nothing is known.
    """

    things: Areas | Pieces
    keys: list[ObjectKey]
    hidden: Geometries
    drawn_from: Days
    drawn_to: Days


class DrawnDays:
    """Days on which objects were drawn: of version 1 its own time; ids of OSM rise with time, and bound the others.

    >>> table = pd.DataFrame({"osm_type": "way", "osm_id": [10, 20, 30], "version": [1, 4, 1],
    ...     "timestamp": pd.to_datetime(["2015-03-01", "2019-01-01", "2015-03-04"])})
    >>> days = DrawnDays([table])
    >>> [str(day[0]) for day in days.between([ObjectKey("way", 20)])]
    ['2015-03-01', '2015-03-04']
    """

    def __init__(self, tables: Sequence[pd.DataFrame]) -> None:
        together = pd.concat([table[["osm_type", "osm_id", "version", "timestamp"]] for table in tables])
        first = together[(together["version"] == 1) & together["timestamp"].notna()]
        first = first.drop_duplicates(["osm_type", "osm_id"]).sort_values("osm_id", kind="stable")
        self._known = {
            kind: (own["osm_id"].to_numpy(), own["timestamp"].dt.tz_localize(None).to_numpy().astype("datetime64[D]"))
            for kind, own in first.groupby("osm_type")
        }

    def between(self, keys: Sequence[ObjectKey]) -> tuple[Days, Days]:
        """Return the first and the last day on which each object can have been drawn; not-a-time if unknown."""
        low, high = (np.full(len(keys), "NaT", dtype="datetime64[D]") for _ in range(2))
        kinds = np.array([key.osm_type for key in keys], dtype=str)
        ids = np.array([key.osm_id for key in keys], dtype=np.int64)
        for kind, (known, days) in self._known.items():
            own = np.flatnonzero(kinds == kind)
            at = np.searchsorted(known, ids[own], side="right") - 1
            below = at >= 0
            low[own[below]] = days[at[below]]
            after = np.where(below & (known[at] == ids[own]), at, at + 1)
            above = after < len(known)
            high[own[above]] = days[after[above]]
        return low, high


@dataclass(frozen=True, slots=True, kw_only=True)
class Pair:
    """One class in two states, `old` and `new`, what each lacks of the other, and what else stood around.

    `into` and `out_of` are what other classes of its kind gained and lost, with the hidden part of its own; `old_keys`
    and `new_keys` name all objects of the maps, whatever their class; `streets` are those of the older map. `newest` is
    the class on the last map of all, `unknown` what of it the older map lacks, and `years_to_newest` lie between them.
    """

    name: str
    old_on: dt.date
    new_on: dt.date
    old: Stock
    new: Stock
    gone: Verdict
    come: Verdict
    into: Geometries
    out_of: Geometries
    old_keys: frozenset[ObjectKey]
    new_keys: frozenset[ObjectKey]
    old_hints: Lifecycle
    new_hints: Lifecycle
    streets: Geometries
    newest: Stock
    unknown: Verdict
    years_to_newest: float

    @property
    def years(self) -> float:
        """Return the years between the two states."""
        return (self.new_on - self.old_on).days / DAYS_PER_YEAR


def causes_of_vanished(pair: Pair) -> Floats:
    """Return how much of each unit of the older map was lost by each cause, shape (U, 5), columns as in `CAUSES`.

    In this order: what is tagged as gone or a building site was lost by the world; what another class replaced was
    retagged, a house only if its own object has another class; a thing whose object or likeness stands nearby was
    redrawn; of a block that lost most of its things the mapping was taken back; and what is built and alone is missing
    in a block that else stayed as it was, was lost by the world. The rest is untold.
    """
    verdict, hints = pair.gone, np.concatenate((pair.new_hints.gone, pair.new_hints.rising))
    by = _Causes(verdict)
    by.give(WORLD, _is_near(pair.old, verdict, hints))
    by.give_amount(RETAGGED, _retagged(pair, pair.old, verdict, pair.into, pair.new_keys - {*pair.new.keys}))
    by.give(REDRAWN, _is_redrawn(pair.old, verdict, pair.new, pair.come))
    things, units = _weights(pair.old), _blocks(verdict)
    lost, total = _sum(units, things * verdict.is_lost), _sum(units, things)
    by.give(MAPPING, (lost >= BULK_THINGS) & (lost >= COVER_SHARE * total))
    if pair.name in _BUILT:
        moved = things * (np.nan_to_num(verdict.shift_m) > REDRAWN_M)[verdict.thing]
        is_quiet = _sum(units, moved) < COVER_SHARE * total
        by.give(WORLD, is_quiet & _is_settled(lost, total, pair.years))
    return by.amounts


def causes_of_appeared(pair: Pair, *, has_tags: bool = True) -> Floats:
    """Return how much of each unit of the newer map appeared by each cause, shape (U, 5), columns as in `CAUSES`.

    In this order: a start date tells the world from late mapping, and a building site is the world's; what replaced
    another class was retagged, and so was an object drawn before the older map that had no class there; a thing whose
    object or likeness stood nearby was redrawn. A block whose class grew faster than anything is built was being
    mapped, and things drawn together on one day were, too; houses only where a street of the older map passes. What is
    built and appeared alone, in a block that grows no faster than settled ground does, is the world's. The rest is
    untold: `has_tags` set to False leaves out the tags, to hold the other rules against them.
    """
    verdict, stock = pair.come, pair.new
    by = _Causes(verdict)
    is_new, is_old, is_site = tagged(pair)
    by.give(WORLD, is_new & has_tags)
    by.give(MAPPING, is_old & has_tags)
    by.give_amount(RETAGGED, _retagged(pair, stock, verdict, pair.out_of, pair.old_keys - {*pair.old.keys}))
    by.give(WORLD, is_site & has_tags)
    by.give(REDRAWN, _is_redrawn(stock, verdict, pair.old, pair.gone))
    before = set(pair.old.keys)
    is_known = np.array([key in before for key in stock.keys], dtype=bool)
    is_older = stock.drawn_to <= np.datetime64(pair.old_on)  # false for not-a-time
    by.give(RETAGGED, (is_older & ~is_known)[verdict.thing])
    unknown, total = _unknown(pair, verdict)
    is_settled = _is_settled(unknown, total, pair.years_to_newest)
    growing = total * -np.expm1(-CATCH_UP_PER_YEAR * pair.years_to_newest)
    is_catching_up = (unknown > growing) & (total >= LEAST_NEIGHBOURS)
    is_bulk = _is_bulk(stock, verdict)
    is_placed = np.ones(len(verdict.lost), dtype=bool)
    if pair.name in load_taxonomy().having("roofed"):
        is_placed = distance_m(verdict.xy_m, pair.streets, within_m=STREET_M) <= STREET_M
    is_street = pair.name in load_taxonomy().having("street")
    by.give(MAPPING, is_placed & (is_catching_up | (is_bulk & ~is_settled & ~np.bool_(is_street))))
    if pair.name in _BUILT:
        by.give(WORLD, is_settled & ~is_bulk)
    return by.amounts


def tagged(pair: Pair) -> tuple[Flags, Flags, Flags]:
    """Return which units a tag says are new, which older than the older map, and which stand on a building site."""
    verdict = pair.come
    spans = [pair.new_hints.started.get(key) for key in pair.new.keys]
    is_new = np.array([span is not None and span.first > pair.old_on for span in spans], dtype=bool)[verdict.thing]
    is_old = np.array([span is not None and span.last <= pair.old_on for span in spans], dtype=bool)[verdict.thing]
    is_site = _is_near(pair.new, verdict, pair.old_hints.rising) & ~is_old
    return is_new, is_old, is_site


class _Causes:
    """Amounts by cause, given away in order: what one cause took is not there for the next; `UNTOLD` is the rest."""

    def __init__(self, verdict: Verdict) -> None:
        self.amounts = np.zeros((len(verdict.lost), len(CAUSES)))
        self.amounts[:, UNTOLD] = verdict.lost

    def give(self, cause: int, which: Flags) -> None:
        self.give_amount(cause, np.where(which, np.inf, 0.0))

    def give_amount(self, cause: int, amount: Floats) -> None:
        taken = np.minimum(amount, self.amounts[:, UNTOLD])
        self.amounts[:, UNTOLD] -= taken
        self.amounts[:, cause] += taken


def verdict_of(these: Stock, others: Stock) -> Verdict:
    """Find what of a class in one state has no counterpart in another."""
    if isinstance(these.things, Areas) and isinstance(others.things, Areas):
        return compare_areas(these.things, others.things)
    if isinstance(these.things, Pieces) and isinstance(others.things, Pieces):
        return compare_pieces(these.things, others.things)
    raise TypeError  # a class has one kind in every state


def lost_shapes(stock: Stock, verdict: Verdict) -> Geometries:
    """Return the areas, or middles of pieces, that lost more than they kept."""
    if isinstance(stock.things, Areas):
        return stock.things.shapes[verdict.is_lost]
    return np.asarray(shapely.points(stock.things.middles[verdict.is_lost]))


def _retagged(
    pair: Pair, stock: Stock, verdict: Verdict, others: Geometries, elsewhere: frozenset[ObjectKey]
) -> Floats:
    """Return the lost amount of each unit that another class has: of a house only if its own object is `elsewhere`.

    A car park in the place of a house is no retagging: somebody pulled the house down, or drew it wrongly.
    """
    if pair.name not in load_taxonomy().having("roofed"):
        return _taken(stock, verdict, others)
    is_elsewhere = np.array([key in elsewhere for key in stock.keys], dtype=bool)
    return np.where(is_elsewhere[verdict.thing], verdict.lost, 0.0)


def _taken(stock: Stock, verdict: Verdict, others: Geometries) -> Floats:
    """Return the lost amount of each unit that another class of the kind, or its own hidden part, replaced."""
    taken = np.zeros(len(verdict.lost))
    units = np.flatnonzero(verdict.is_lost)
    if isinstance(stock.things, Areas):
        share = replaced_share(stock.things.shapes[units], polygons_of(others))
        taken[units] = np.minimum(share * verdict.amount[units], verdict.lost[units])
    else:
        taken[units] = verdict.lost[units] * (distance_m(stock.things.middles[units], others) <= NEAR_M)
    return taken


def _is_near(stock: Stock, verdict: Verdict, hints: Geometries) -> Flags:
    near = np.zeros(len(verdict.lost), dtype=bool)
    units = np.flatnonzero(verdict.lost > 0)
    if isinstance(stock.things, Areas):
        near[units] = covered_share(stock.things.shapes[units], hints) >= COVER_SHARE
    else:
        near[units] = distance_m(stock.things.middles[units], hints) <= NEAR_M
    return near


def _is_redrawn(stock: Stock, verdict: Verdict, others: Stock, missing: Verdict) -> Flags:
    """Return which units stand in the other state under their own id, or near it in their likeness, both unpaired.

    A thing is like another if its area is half to twice as large. A line that kept its id may have been lengthened or
    cut short, so ids say nothing of its pieces.
    """
    found = np.zeros(len(verdict.lost), dtype=bool)
    units = np.flatnonzero(verdict.lost > 0)
    if isinstance(stock.things, Pieces):
        found[units] = distance_m(verdict.xy_m[units], lost_shapes(others, missing), within_m=REACH_M) <= REACH_M
        return found
    there = set(others.keys)
    found[units] = [stock.keys[thing] in there for thing in verdict.thing[units]]
    unpaired = np.flatnonzero(missing.is_lost)
    around = shapely.buffer(shapely.points(verdict.xy_m[units]), REACH_M)
    left, right = overlapping(around, shapely.points(missing.xy_m[unpaired]), predicate="intersects")
    ratio = verdict.amount[units[left]] / missing.amount[unpaired[right]]
    found[units[left[(ratio >= COVER_SHARE) & (ratio <= 1 / COVER_SHARE)]]] = True
    return found


def _is_settled(changed: Floats, total: Floats, years: float) -> Flags:
    """Return where enough neighbours stayed, and no more than one thing, or what settled ground may, has changed."""
    return (total - changed >= LEAST_NEIGHBOURS) & (changed <= np.maximum(1.0, SETTLED_PER_YEAR * years * total))


def _unknown(pair: Pair, verdict: Verdict) -> tuple[Floats, Floats]:
    """Return, for the block of each unit, how much of the newest map's stock the older map lacks, and all of it."""
    cells, things = cells_of(pair.unknown.xy_m), _weights(pair.newest)
    blocks, at = np.unique(np.concatenate((cells, cells_of(verdict.xy_m))), return_inverse=True)
    newest, own = at[: len(cells)], at[len(cells) :]
    lacking, all_of = (
        np.bincount(newest, weights=of, minlength=len(blocks))[own].astype(np.float64)
        for of in (things * pair.unknown.is_lost, things)
    )
    return lacking, all_of


def _is_bulk(stock: Stock, verdict: Verdict) -> Flags:
    """Return which units are of things that came to their block with many others on one day."""
    lost = np.zeros(len(stock.keys), dtype=bool)
    lost[verdict.thing[verdict.is_lost]] = True
    first = np.zeros(len(stock.keys), dtype=np.int64)
    first[verdict.thing[::-1]] = np.arange(len(verdict.thing))[::-1]
    is_dated = lost & (stock.drawn_to - stock.drawn_from <= _DAY)
    dated = np.flatnonzero(is_dated)
    table = pd.DataFrame({"cell": cells_of(verdict.xy_m[first[dated]]), "day": stock.drawn_from[dated]})
    together = table.groupby(["cell", "day"])["day"].transform("size").to_numpy()
    is_bulk = np.zeros(len(stock.keys), dtype=bool)
    is_bulk[dated] = together >= BULK_THINGS
    return is_bulk[verdict.thing]


def _weights(stock: Stock) -> Floats:
    """Return how many neighbours each unit counts as."""
    if isinstance(stock.things, Areas):
        return np.ones(len(stock.things.shapes))
    return stock.things.lengths_m / LINE_THING_M


def _blocks(verdict: Verdict) -> Ints:
    return np.asarray(np.unique(cells_of(verdict.xy_m), return_inverse=True)[1])


def _sum(blocks: Ints, values: Floats) -> Floats:
    """Return, for each unit, the sum over its block."""
    return np.asarray(np.bincount(blocks, weights=values)[blocks] if len(blocks) else np.zeros(0))


def cells_of(xy_m: Floats) -> Ints:
    """Return the number of the block of 1 km that each place lies in."""
    cells = np.floor(xy_m / BLOCK_M).astype(np.int64).reshape(-1, 2)
    return np.asarray(cells[:, 0] * 2**32 + cells[:, 1])


def streets_of(state: State) -> Geometries:
    """Return the streets of a state that are visible from above."""
    table = state.features
    is_street = table["class"].isin(load_taxonomy().having("street")) & table["is_visible"]
    return np.asarray(table.geometry.array[is_street.to_numpy()], dtype=object)
