# SPDX-License-Identifier: Apache-2.0
"""The conformance kit of perturbations: what each promises, checked on views of a small town."""

import math
from collections.abc import Iterator, Sequence
from contextlib import nullcontext
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final

import numpy as np

from sasgeo_bench.core.errors import MatchError, PerturbError
from sasgeo_bench.core.folders import scratch_folder
from sasgeo_bench.core.texts import message_of, one_line
from sasgeo_bench.regions.evidence import ABSENT, UNKNOWN, Evidence
from sasgeo_bench.running.testing import Check, tiny_place, tried
from sasgeo_bench.tasks.perturbations.all_perturbations import Ladder, find_perturbation, ladder_of
from sasgeo_bench.tasks.perturbations.base import Perturbation

NO_STRENGTHS: Final = (-99.0, math.nan, math.inf, "much", None, True)
_SHAPES: Final = ((1, 1), (1, 40), (40, 3))  # rows and columns of odd views
_SEED: Final = 4


def check_perturbation(spec: str, *, out: Path | None = None) -> Iterator[Check]:
    """Try a perturbation, by name or "module:NAME", on views of a small town; yield a row for each rule.

    It is an instance, a class, or a function of a strength, and runs in this process, as it does when queries are
    drawn: name only code that you trust. `out` is where the town is kept from one to the next; by default a scratch
    folder.

    Examples
    --------
    >>> {check.outcome for check in check_perturbation("border")}
    {'pass'}
    """
    name = "loads, and has a strength"
    try:
        ladder = _tried(spec)
    except MatchError as error:
        yield Check(name=name, outcome="fail", found=str(error))
        return
    yield Check(name=name, outcome="pass", found=f"{ladder.knob}, tried at {ladder.strength:g}")
    with nullcontext(out) if out else scratch_folder("check") as folder:
        seen = [query.evidence for query in tiny_place(folder).queries]
    yield from promises(ladder, (*seen[::8], half_known(seen[0])))


def _tried(spec: str) -> Ladder:
    ladder = ladder_of(find_perturbation(spec), spec)
    word = f"{ladder.knob} {ladder.strength:g}"
    try:
        made = ladder.at(ladder.strength)
    except (Exception, SystemExit) as error:  # whatever code of somebody's own raises
        raise MatchError(f"{spec}: it cannot be made with {word} ({message_of(error)})") from error
    if not callable(made):
        raise MatchError(f"{spec}: with {word} it makes an object of type {type(made).__name__}, no callable")
    return ladder


def promises(ladder: Ladder, views: Sequence[Evidence]) -> Iterator[Check]:
    """Try a perturbation on some views; yield a row for each rule."""
    yield from _Kit(ladder, views).checks()


def half_known(view: Evidence) -> Evidence:
    """Return a view with a quarter unknown, a strip more for some classes, and a confidence."""
    cells = view.cells.copy()
    rows, cols = view.shape
    cells[:, : rows // 2, : cols // 2] = UNKNOWN
    cells[:3, cols // 2 : cols // 2 + cols // 8] = UNKNOWN
    return view.replace(cells, (np.indices(cells.shape).sum(axis=0) % 256).astype(np.uint8))


@dataclass(frozen=True)
class _Kit:
    """What every perturbation keeps to on some views; each rule returns a fault in words, or None."""

    ladder: Ladder
    views: Sequence[Evidence]

    def checks(self) -> Iterator[Check]:
        """Try every rule in turn."""
        moves = getattr(self.perturbation, "moves_cells", False)
        kept = "cells move, and nothing appears" if moves else "unknown cells stay unknown"
        found = f"{len(self.views)} views"
        first_of: dict[str, str] = {}
        for row in tried(
            (
                ("gives a view of the same classes and shape", self.keeps_shape, found),
                ("changes no cell at strength 0", self.is_neutral, found),
                ("the same seed, the same view", self.repeats, found),
                ("the given view is not changed", self.leaves_input, found),
                (kept, self.adds_nothing, found),
                ("a class more changes no other one", self.draws_by_class, found),
                ("takes views of one class, and of any shape", self.takes_any, found),
                ("changes some cells", self.acts, found),
                ("refuses what is no strength", self.refuses, found),
            )
        ):
            first = first_of.setdefault(row.found, row.name)
            is_again = row.outcome == "fail" and first != row.name
            yield replace(row, found=f"as in: {first}") if is_again else row

    @property
    def perturbation(self) -> Perturbation:
        """Return it at the strength at which it is tried."""
        return self.ladder.at(self.ladder.strength)

    def keeps_shape(self) -> str | None:
        for view in self.views:
            after = _seen(self.perturbation, view)
            if (after.classes, after.shape, after.cell_size_m) != (view.classes, view.shape, view.cell_size_m):
                return f"a view of {len(view.classes)} classes and {view.shape} cells becomes one of {after.shape}"
            if (after.confidence is None) != (view.confidence is None):
                return "it takes the confidence of a view away, or makes one up"
        return None

    def is_neutral(self) -> str | None:
        neutral = self.ladder.at(0.0)
        if all(np.array_equal(_seen(neutral, view).cells, view.cells) for view in self.views):
            return None
        return "a cell changes at strength 0, so that a control is not what it was"

    def repeats(self) -> str | None:
        for view in self.views:
            first, second = (_seen(self.perturbation, view) for _ in range(2))
            if not _is_same(first, second):
                return "two views of one seed differ: all chance comes from the generator that is given"
        return None

    def leaves_input(self) -> str | None:
        for view in self.views:
            given = _copied(view)
            self.perturbation(given, np.random.default_rng(_SEED))
            if not _is_same(given, view):
                return "it writes into the view that it is given, which the control shows too: work on a copy"
        return None

    def adds_nothing(self) -> str | None:
        moves = getattr(self.perturbation, "moves_cells", False)
        for view in self.views:
            blank = view.replace(np.full_like(view.cells, UNKNOWN), view.confidence)
            if _seen(self.perturbation, blank).unknown_share != 1.0:
                return "a view that is unknown all over is known afterwards"
            if not moves and (_seen(self.perturbation, view).cells[view.cells == UNKNOWN] != UNKNOWN).any():
                return "an unknown cell becomes known: if cells change their place, say moves_cells = True in the class"
        return None

    def draws_by_class(self) -> str | None:
        """Take a class away that is nowhere on the view."""
        view = self.views[0]
        for at in (0, len(view.classes) // 2, len(view.classes) - 1):
            cells = view.cells.copy()
            cells[at] = ABSENT
            less = replace(view, classes=view.classes[:at] + view.classes[at + 1 :], cells=np.delete(cells, at, axis=0))
            with_it, without = _seen(self.perturbation, view.replace(cells)), _seen(self.perturbation, less)
            if not np.array_equal(np.delete(with_it.cells, at, axis=0), without.cells):
                return (
                    f"with {view.classes[at]}, of which nothing is seen, other classes change: draw each from its own "
                    "stream, sasgeo_bench.Streams(rng).of(name)"
                )
        return None

    def takes_any(self) -> str | None:
        view, middle = self.views[0], len(self.views[0].classes) // 2
        odd = [view.replace(view.cells[:, :rows, :cols].copy()) for rows, cols in _SHAPES]
        one = slice(middle, middle + 1)
        odd.append(replace(view, classes=view.classes[one], cells=view.cells[one, :50, :70].copy()))
        rest = _Kit(self.ladder, odd)
        return rest.keeps_shape() or rest.is_neutral() or rest.repeats() or rest.leaves_input() or rest.adds_nothing()

    def acts(self) -> str | None:
        if any((_seen(self.perturbation, view).cells != view.cells).any() for view in self.views):
            return None
        return f"nothing changes at {self.ladder.knob} {self.ladder.strength:g}: name an instance at a usual strength"

    def refuses(self) -> str | None:
        for value in NO_STRENGTHS:
            try:
                self.ladder.at(value)
            except (ValueError, TypeError):
                continue
            except Exception as error:  # noqa: BLE001 - of another's code
                return f"{value!r} for a strength makes it fail ({message_of(error)}): refuse it as a ValueError"
            return f"it takes {value!r} for a strength: check_ranges(self, {self.ladder.knob}=(0, 1)) refuses it"
        return None


def _copied(view: Evidence) -> Evidence:
    return view.replace(view.cells.copy(), None if view.confidence is None else view.confidence.copy())


def _seen(perturbation: Perturbation, view: Evidence) -> Evidence:
    """Return what is left of a copy of a view, always of one seed."""
    after = perturbation(_copied(view), np.random.default_rng(_SEED))
    if not isinstance(after, Evidence):
        raise PerturbError(f"it returns a {one_line(type(after).__name__)}, expected an Evidence")
    return after


def _is_same(one: Evidence, other: Evidence) -> bool:
    first, second = (np.zeros(0) if view.confidence is None else view.confidence for view in (one, other))
    return np.array_equal(first, second) and np.array_equal(one.cells, other.cells)
