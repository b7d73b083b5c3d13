# SPDX-License-Identifier: Apache-2.0
"""Learning from views whose places are known: rates at the true pose, exponents from what a search finds beside it."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from sasgeo_bench.errors import ConfigError
from sasgeo_bench.grid import Grid
from sasgeo_bench.matcher import Training
from sasgeo_bench.pose import Pose
from sasgeo_bench.query import Query, Truth
from sasgeo_bench.region import Region
from sasgeo_bench.sasgeo.arms import Switches
from sasgeo_bench.sasgeo.learnt import Learnt
from sasgeo_bench.sasgeo.raster import RasterView, read_field
from sasgeo_bench.sasgeo.rates import NOWHERE, Tally, rings, tally
from sasgeo_bench.sasgeo.temper import fit_temper
from sasgeo_bench.search.field import Field
from sasgeo_bench.search.find import search
from sasgeo_bench.search.plan import Plan

DAYS_PER_YEAR: Final = 365.25
MODES: Final = 16  # of a search to learn from
WRONG_M: Final = 25.0  # a mode this far from the truth is a wrong place
ROUNDS: Final = 2  # exponents change what a search finds; after two rounds hardly


def age_years(query: Query, region: Region) -> float:
    """From the map to the view; 0 where the map is the younger one."""
    return max(0.0, (query.observed_on - region.manifest.extract.date).days / DAYS_PER_YEAR)


@dataclass(frozen=True, kw_only=True)
class Lesson:
    """One view whose place on a map is known."""

    query: Query
    truth: Truth
    pose: Pose
    region: Region

    @property
    def age_years(self) -> float:
        """Of the map."""
        return age_years(self.query, self.region)


def lessons_of(training: Training) -> list[Lesson]:
    """Views that lie on their maps, map by map; those of a list of candidates are the same views once more."""
    found = [
        Lesson(query=query, truth=truth, pose=truth.pose, region=training.regions[query.region])
        for query, truth in training.pairs
        if truth.is_present and truth.pose is not None and query.track == "localization"
    ]
    return sorted(found, key=lambda lesson: lesson.query.region)


def learn(training: Training, switches: Switches, *, plan: Plan | None = None) -> Learnt:
    """Learn rates, likeness and exponents.

    Parameters
    ----------
    training : Training
        Of train places.
    switches : Switches
        Which arm learns.
    plan : Plan, optional
        How is searched.

    Returns
    -------
    Learnt
        Of the classes of the maps.

    Raises
    ------
    ConfigError
        If no view lies on its map, or maps have different classes.
    """
    lessons = lessons_of(training)
    if not lessons:
        message = "no view of the train part lies on its map: name suites whose places are there, such as clean"
        raise ConfigError(message)
    by_map = _by_map(lessons)
    learnt = Learnt.of([one for some in by_map.values() for one in _tallies(some, switches)])
    for _ in range(ROUNDS):
        choices = [one for some in by_map.values() for one in _choices(some, learnt, switches, plan or Plan())]
        if choices:
            learnt = replace(learnt, temper=fit_temper(choices))
    return learnt


def _by_map(lessons: Sequence[Lesson]) -> Mapping[str, list[Lesson]]:
    """Lessons by the map they lie on: one map is made ready at a time."""
    names = dict.fromkeys(lesson.query.region for lesson in lessons)
    return {name: [lesson for lesson in lessons if lesson.query.region == name] for name in names}


def _tallies(lessons: Sequence[Lesson], switches: Switches) -> list[Tally]:
    """What was seen on one map, at the true places."""
    region = lessons[0].region
    near = rings(region.layers, cell_size_m=region.grid.cell_size_m)
    return [_tally(lesson, near, switches) for lesson in lessons]


def _tally(lesson: Lesson, near: NDArray[np.uint8], switches: Switches) -> Tally:
    region, seen = lesson.region, switches.seen(lesson.query.evidence)
    under = _under(near, region.grid, lesson.pose, seen.shape, seen.cell_size_m)
    cells = np.full(under.shape, NOWHERE, dtype=np.uint8)  # neither present nor absent: a class the view does not know
    for at, name in enumerate(region.classes):
        if name in seen.classes:
            cells[at] = seen.layer(name)
    return tally(region.classes, cells, under, age_years=lesson.age_years, block=lesson.truth.block)


def _under(
    near: NDArray[np.uint8], grid: Grid, pose: Pose, shape: tuple[int, int], cell_m: float
) -> NDArray[np.uint8]:
    """What of a map lies in the middle of each cell of a view."""
    rows, cols = np.indices(shape)
    right_m, up_m = (cols - (shape[1] - 1) / 2) * cell_m, ((shape[0] - 1) / 2 - rows) * cell_m
    row, col = grid.to_cells(pose.to_map(np.column_stack((right_m.ravel(), up_m.ravel())))).T
    inside = (row >= 0) & (row < grid.rows) & (col >= 0) & (col < grid.cols)
    found = near[:, np.clip(row, 0, grid.rows - 1), np.clip(col, 0, grid.cols - 1)]
    return np.asarray(np.where(inside, found, NOWHERE), dtype=np.uint8).reshape(len(near), *shape)


def _choices(
    lessons: Sequence[Lesson], learnt: Learnt, switches: Switches, plan: Plan
) -> list[NDArray[np.float64]]:
    """Scores by class of the truth and of the wrong places a search finds, for each view of one map."""
    region = lessons[0].region
    field = read_field(region, learnt.likeness)
    found = (_choice(lesson, field, learnt, switches, plan) for lesson in lessons)
    return [one for one in found if len(one) > 1]


def _choice(
    lesson: Lesson, field: Field, learnt: Learnt, switches: Switches, plan: Plan
) -> NDArray[np.float64]:
    query, pose = lesson.query, lesson.pose
    gains = switches.gains(learnt, age_years=lesson.age_years)
    view = RasterView.of(switches.seen(query.evidence), learnt.classes, gains)
    modes = search(field, view.tempered(learnt.temper).template(), query.prior, plan, count=MODES).modes
    here = (pose.easting_m, pose.northing_m)
    wrong = [mode.pose for mode in modes if math.dist((mode.pose.easting_m, mode.pose.northing_m), here) > WRONG_M]
    return np.stack([view.by_class(field, one) for one in (pose, *wrong)])

