# SPDX-License-Identifier: Apache-2.0
"""A place and the one whose classes cover as much ground, scored: what Fig. 1 of the SASGeo paper shows, measured."""

import math
from dataclasses import dataclass
from typing import Final

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from sasgeo_bench.errors import ConfigError
from sasgeo_bench.geometry.grid import Grid
from sasgeo_bench.geometry.pose import Pose, Prior
from sasgeo_bench.leaderboard.lookalike_plot import LookalikeSheet
from sasgeo_bench.regions.evidence import PRESENT, Evidence
from sasgeo_bench.regions.region import Region
from sasgeo_bench.sasgeo.ablations import Switches
from sasgeo_bench.sasgeo.class_weights import class_weights_of, rarity_map, weight_map
from sasgeo_bench.sasgeo.reading import Reader, Reading
from sasgeo_bench.sasgeo.scorer_model import ScorerModel
from sasgeo_bench.sasgeo.weight_plot import top_of
from sasgeo_bench.search.find import rank
from sasgeo_bench.tasks.query import Query
from sasgeo_bench.tasks.state import State
from sasgeo_bench.tasks.suites.mining import RINGS, Windows, describe, min_distance_m
from sasgeo_bench.tasks.suites.vectors import VectorNoise, perceive_vectors

VARIED: Final = 0.1  # share of the places that are most varied, among which one is chosen
LEAST_DRAWN: Final = 0.05  # of a place's ground: with less there is nothing to confuse
SIDE_M: Final = 192.0  # of the view, as in most suites
NAMES: Final = ("true place", "lookalike")
NOTE: Final = (
    "The place was chosen by rule: of the tenth of places whose classes are most evenly mixed on the map, the one "
    "with the nearest lookalike. A lookalike is the place nearest by the shares of all classes, at least three "
    "footprint radii away; these two differ by {distance:.2f} standard deviations over the map. Scores are those of "
    "the best pose within 24 m of each place, at any heading. A class counts by where it lies, not by how much of it "
    "there is. The raster term is the weighted sum of all classes, listed or not."
)
_CHUNK: Final = 256
_EXACT: Final = VectorNoise(missed_share=0.0, gap_share=0.0, shift_m=0.0)
_NOTHING: Final = 1e-9


@dataclass(frozen=True, kw_only=True)
class Pair:
    """Two places of a map: the one that is seen, and the one most like it by how much ground each class covers.

    `distance` is how unlike they are: Euclidean distance of the shares of all classes, each in standard deviations over
    the map.
    """

    here_m: tuple[float, float]
    there_m: tuple[float, float]
    distance: float


@dataclass(frozen=True, kw_only=True)
class Lookalike:
    """A view, its true place and its lookalike, as the scorer sees them.

    `query` is the view of the true place, heading north, without a prior. `poses` are the best near each place, the
    true one first, `views` the map from these poses. `scores` has a row for each class: the shares of cells that it
    covers, `share view`, `share true place` and `share lookalike`, and the tempered raster scores of Eq. 8 in nats,
    `score true place` and `score lookalike`. `terms` are those of Eq. 11 in nats, weighed as in the joint score: rows
    raster, graph, contradiction, joint; columns `NAMES`. `age_years` is that of the map.
    """

    query: Query
    pair: Pair
    poses: tuple[Pose, ...]
    views: tuple[Evidence, ...]
    scores: pd.DataFrame
    terms: pd.DataFrame
    age_years: float


def find_pair(windows: Windows) -> Pair:
    """Choose a place that is varied and has a lookalike: the rule, not a person, says which.

    Of the tenth of places whose drawn classes are most evenly mixed (largest entropy of their shares), the one whose
    nearest other place by the shares of all classes is nearest. The other lies at least three footprint radii away, as
    every decoy does. Shares are those of discs: turning changes nothing. Raise ConfigError if no place holds enough, or
    none lies far enough from it.
    """
    shares = windows.shares.reshape(len(windows.points_m), -1, RINGS).mean(axis=2)
    total = shares.sum(axis=1)
    parts = shares / np.maximum(total, _NOTHING)[:, None]
    entropy = -(parts * np.log(np.maximum(parts, _NOTHING))).sum(axis=1)
    enough = np.flatnonzero(total >= LEAST_DRAWN)
    varied = enough[np.argsort(-entropy[enough], kind="stable")][: math.ceil(VARIED * len(enough))]
    best: Pair | None = None
    table, points = windows.plain["histogram"].astype(np.float64), windows.points_m
    for start in range(0, len(varied), _CHUNK):
        rows = varied[start : start + _CHUNK]
        apart_m = np.hypot(*(points[rows, None, :] - points[None, :, :]).transpose(2, 0, 1))
        unlike = _distances(table[rows], table)
        unlike[apart_m < min_distance_m(windows.radius_m)] = np.inf
        at, other = np.unravel_index(int(np.argmin(unlike)), unlike.shape)
        distance = float(unlike[at, other])
        if math.isfinite(distance) and (best is None or distance < best.distance):
            best = Pair(here_m=_place(points[rows[at]]), there_m=_place(points[other]), distance=distance)
    if best is None:
        raise ConfigError(
            "the map has no two places far enough apart that hold roads, buildings or water: choose a larger one"
        )
    return best


def _distances(rows: NDArray[np.float64], table: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return Euclidean distances between all rows of two tables, shape (R, N)."""
    squared = (rows**2).sum(axis=1)[:, None] - 2 * rows @ table.T + (table**2).sum(axis=1)[None, :]
    return np.asarray(np.sqrt(np.maximum(squared, 0.0)))


def _place(point_m: NDArray[np.float64]) -> tuple[float, float]:
    return (float(point_m[0]), float(point_m[1]))


def find_lookalike(mapped: Region, world: Region, model: ScorerModel, *, side_m: float) -> Lookalike:
    """Score a place, as it is on the day of `world`, and its lookalike on an older map.

    `mapped` and `world` are one region at two dates, or the same twice. Raise ConfigError if
    the regions are of two places, the map is the younger one, or it holds no such pair of places.
    """
    check_dates(mapped, world)
    on_map, in_world = State.of(mapped), State.of(world)
    cell_m = mapped.grid.cell_size_m
    size = round(side_m / cell_m)
    pair = find_pair(describe(on_map, side_m=side_m, clear_m=side_m * math.sqrt(0.5)))
    places = [Pose(easting_m=at_m[0], northing_m=at_m[1], yaw_deg=0.0) for at_m in (pair.here_m, pair.there_m)]
    query = Query(
        query_id="lookalike",
        track="retrieval",
        suite="lookalike",
        suite_version=1,
        part="test",
        region=mapped.manifest.id,
        evidence=in_world.view(places[0], size_cells=size, cell_size_m=cell_m),
        observed_on=in_world.date,
        season="",
        prior=Prior(center_m=None, radius_m=None, yaw_deg=None, yaw_sigma_deg=None, scale_sigma=0.0),
        prior_group="rnone-unknown-s0",
        candidates=tuple(places),
        vectors=perceive_vectors(in_world, places[0], side_m=side_m, noise=_EXACT, rng=np.random.default_rng(0)),
    )
    glance = Reader.of(mapped, model, Switches()).read(query)
    poses = best_poses(glance)
    views = tuple(on_map.view(pose, size_cells=size, cell_size_m=cell_m) for pose in poses)
    return Lookalike(
        query=query,
        pair=pair,
        poses=poses,
        views=views,
        scores=_scores(glance, poses, views),
        terms=_terms(glance, poses),
        age_years=glance.age_years,
    )


def check_dates(mapped: Region, world: Region) -> None:
    """Refuse two places, and a map that is younger than what is seen."""
    one, other = mapped.manifest, world.manifest
    if one.id != other.id or one.grid != other.grid:
        raise ConfigError(
            f"{one.id} and {other.id} are not one region at two dates: name {one.id!r}, or {one.id}@<date>"
        )
    if one.extract.date > other.extract.date:
        raise ConfigError(
            f"the map, of {one.extract.date}, is younger than what is seen, of {other.extract.date}: swap them"
        )


def best_poses(glance: Reading) -> tuple[Pose, ...]:
    """Return the best pose near each candidate of a view, at any heading."""
    found, _ = rank(glance.reader.field, glance.template, glance.query.prior, glance.query.candidates)
    return tuple(
        place if mode is None else mode.pose for mode, place in zip(found, glance.query.candidates, strict=True)
    )


def _scores(glance: Reading, poses: tuple[Pose, ...], views: tuple[Evidence, ...]) -> pd.DataFrame:
    classes = glance.reader.region.classes
    by_class = glance.by_class(poses) * glance.reader.model.scaling
    columns = {"share view": _shares(glance.query.evidence)}
    columns |= {f"share {name}": _shares(view) for name, view in zip(NAMES, views, strict=True)}
    columns |= {f"score {name}": row for name, row in zip(NAMES, by_class, strict=True)}
    return pd.DataFrame(columns, index=pd.Index(classes, name="class"))


def _shares(view: Evidence) -> NDArray[np.float64]:
    return np.asarray((view.cells == PRESENT).mean(axis=(1, 2)))


def _terms(glance: Reading, poses: tuple[Pose, ...]) -> pd.DataFrame:
    """Return raster, graph, contradiction and their sum; the first alone for a variant without a graph."""
    terms = glance.terms(poses, glance.verified(poses))
    classes = len(glance.reader.region.classes)
    raster, rest = terms[:, :classes].sum(axis=1), terms[:, classes:]
    graph, against = rest.T if rest.shape[1] else np.zeros((2, len(poses)))
    rows = {"raster": raster, "graph": graph, "contradiction": against, "joint": terms.sum(axis=1)}
    return pd.DataFrame(rows, index=list(NAMES)).T


def sheet_of(found: Lookalike, mapped: Region, model: ScorerModel) -> LookalikeSheet:
    """Put what was found into words and pictures."""
    about, side_m = mapped.manifest, found.query.evidence.size_m[0]
    class_weights = class_weights_of(model, age_years=found.age_years)
    weights = weight_map(mapped.layers, class_weights, rarity_map(mapped))
    apart_m = math.dist(found.pair.here_m, found.pair.there_m)
    turned_deg = round(float(found.poses[1].yaw_deg)) % 360
    east_m, north_m = (round(value) for value in found.pair.here_m)
    return LookalikeSheet(
        title=f"{about.title}: what is seen, what the map says there, and where else it says nearly the same",
        facts=(
            f"{side_m:g} m views, no errors of perception  |  map {found.age_years:.1f} years older than the view  |  "
            f"scores of {'sasgeo' if model.views else 'sasgeo_prior'}  |  EPSG:{about.epsg}, {east_m} E, {north_m} N"
        ),
        view=found.query.evidence,
        mapped=found.views[0],
        lookalike=found.views[1],
        weights=_cut(weights, mapped.grid, found.pair.here_m, found.query.evidence.shape[0]),
        top=top_of([weights]),
        class_weights=dict(zip(mapped.classes, class_weights.tolist(), strict=True)),
        scores=found.scores,
        terms=found.terms,
        panels=(
            f"a  the view, {found.query.observed_on}",
            f"b  the map there, {about.extract.date}",
            "c  weights of the map there",
            f"d  the lookalike, {apart_m:.0f} m off" + (f", turned by {turned_deg}\u00b0" if turned_deg else ""),
        ),
        note=NOTE.format(distance=found.pair.distance),
    )


def _cut(raster: NDArray[np.float32], grid: Grid, at_m: tuple[float, float], size_cells: int) -> NDArray[np.float32]:
    """Return the square of a raster around a place."""
    col, row = np.rint(grid.to_uv(np.array([at_m]))[0] - size_cells / 2).astype(int).tolist()
    return raster[row : row + size_cells, col : col + size_cells]
