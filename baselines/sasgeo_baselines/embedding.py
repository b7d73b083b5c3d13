# SPDX-License-Identifier: Apache-2.0
"""Retrieval of map tiles by a learned embedding: locations are classes, the bottleneck before them is the feature."""

import base64
import hashlib
import json
import warnings
import zlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import groupby
from typing import Any, Final, Self

import numpy as np
from numpy.typing import NDArray

from sasgeo_baselines.global_descriptor import separate
from sasgeo_baselines.learned import read_learned, sound
from sasgeo_baselines.place_matcher import SPREAD, PlaceMatcher
from sasgeo_baselines.polar import (
    CELL_M,
    DEPTH,
    GROUPS,
    RADIUS_M,
    SECTORS,
    SIDE,
    described,
    map_rows,
    padded_strips,
    places_m,
    turned,
    view_descriptor,
)
from sasgeo_bench import (
    UNKNOWN,
    Disc,
    Evidence,
    Grid,
    Mode,
    Pose,
    Query,
    Region,
    Training,
    Truth,
    inverse,
    points_of,
    turns_of,
)

STRIDE: Final = 6  # cells between two tiles of a gallery: 24 m, so that no place is farther than 17 m from one
APART_M: Final = 25.0  # between two places of an answer
YAW_STEP_DEG: Final = 7.5  # a third of a sector
DIMENSIONS: Final = 128  # of the learned feature, as the recipe has it
NUMBERS: Final = len(GROUPS) * DEPTH  # of a descriptor

OTHERS: Final = 48  # locations of each training map besides those of views
MOST_OTHERS: Final = 480  # of all: bounds memory and time
MOST_VIEWS: Final = 1200  # of training
NEAR_M: Final = 12.0  # a made-up view lies so far from its tile, as the middle of a real one from the lattice
NEAR_DEG: Final = 4.0  # half a step of headings
_FORMAT: Final = "sasgeo-baselines embedding 1"
_QUARTERS: Final = 4
_FULL: Final = 255.0
_DIGITS: Final = 6  # of a cosine: equal tiles are equal
_AT_ONCE: Final = 64  # tiles cut together: 16 MB
_SMALL: Final = 0.05  # standard deviation of a number of the descriptor that is noise
_RATE: Final = 1e-3

# Of the cards of all who learn an embedding.
OURS: Final = (
    "In place of networks for pictures: a descriptor of view and map alike (occupancy of 7 groups of classes in 8 "
    "rings and 16 sectors of a disc of 96 m, and how much lies near them), and a linear bottleneck of 128 numbers in "
    "front of the softmax (MLPClassifier of scikit-learn, 30 epochs). Locations are those of the views of training, "
    "and up to 48 random ones of each of its maps, shown from within 12 m of their middle with errors drawn from those "
    "of training's views. The gallery has a tile every 24 m, facing north; a view is turned north from each heading "
    "that it may have, 7.5 degrees apart within two standard deviations of the prior. A candidate has a tile of its own"
)
LIMITS: Final = (
    "Works on class layers until pictures are the query. Untaught it ranks by the cosine of the plain descriptor, less "
    "its mean over the map. The answer is the middle of a tile, up to 17 m off; views are cut beyond 96 m from their "
    "middle; what is unknown in a view counts as average, what is unknown on the map as empty; scale is 1; no "
    "sequence, no weights by what lasts, no rejection, no confidence"
)

Rows = NDArray[np.float32]  # descriptors or features, shape (N, NUMBERS) or (N, F)


def unit(rows: Rows) -> Rows:
    """Return rows of length 1; 0 stays 0."""
    return np.asarray(rows / np.maximum(np.linalg.norm(rows, axis=-1, keepdims=True), 1e-6), dtype=np.float32)


def north_up(evidence: Evidence, yaw_deg: float) -> Evidence:
    """Turn a view that heads so until north is up; cells that come in from beyond its rim are unknown.

    Examples
    --------
    A view that heads east sees at its top what lies in the east, on the right of a map:

    >>> cells = np.array([[[0, 1, 0], [0, 0, 0], [0, 0, 0]]], dtype=np.uint8)
    >>> north_up(Evidence(classes=("building",), cells=cells, cell_size_m=1.0), 90.0).cells[0].tolist()
    [[0, 0, 0], [0, 0, 1], [0, 0, 0]]
    """
    rows, cols = evidence.shape
    right, up = np.meshgrid(np.arange(cols) + 0.5 - cols / 2, rows / 2 - 0.5 - np.arange(rows))
    back = inverse(Pose(easting_m=0.0, northing_m=0.0, yaw_deg=yaw_deg))
    across, along = back.to_map(np.column_stack([right.ravel(), up.ravel()])).round(6).T
    col, row = np.floor(across + cols / 2).astype(np.int64), np.floor(rows / 2 - along).astype(np.int64)
    inside = (row >= 0) & (row < rows) & (col >= 0) & (col < cols)
    taken = evidence.cells.reshape(len(evidence.classes), -1)[:, np.where(inside, row * cols + col, 0)]
    taken[:, ~inside] = UNKNOWN
    return evidence.replace(taken.reshape(evidence.cells.shape))


@dataclass(frozen=True, kw_only=True)
class Ground:
    """Planes of a map (`polar.padded_strips`) of which tiles are cut at any pose; uint8 of shape (planes, rows, cols).

    `corner_m` is their north-western corner, beyond that of the map. Unknown ground is empty, as beyond the map.
    """

    corner_m: tuple[float, float]
    planes: NDArray[np.uint8]

    @classmethod
    def of(cls, region: Region) -> Self:
        """Read a map."""
        west_m, _, _, north_m = region.grid.bounds_m
        strips = [np.rint(strip * _FULL).astype(np.uint8) for strip in padded_strips(region, stride=SIDE)]
        return cls(corner_m=(west_m - RADIUS_M, north_m + RADIUS_M), planes=np.concatenate(strips, axis=1))

    def tiles(self, poses: Sequence[Pose]) -> Rows:
        """Return descriptors of tiles: of the map turned and scaled as a view from each pose would show it."""
        parts = [self._some(poses[at : at + _AT_ONCE]) for at in range(0, len(poses), _AT_ONCE)]
        return np.concatenate([np.zeros((0, NUMBERS), dtype=np.float32), *parts])

    def _some(self, poses: Sequence[Pose]) -> Rows:
        at_m = (np.arange(SIDE) + 0.5) * CELL_M - RADIUS_M
        right_m, up_m = np.meshgrid(at_m, -at_m)
        offsets_m = np.column_stack([right_m.ravel(), up_m.ravel()])
        points_m = np.stack([pose.to_map(offsets_m) for pose in poses])
        col, row = np.floor((points_m - self.corner_m) / (CELL_M, -CELL_M)).astype(np.int64).transpose(2, 0, 1)
        rows, cols = self.planes.shape[1:]
        inside = (row >= 0) & (row < rows) & (col >= 0) & (col < cols)
        cut = self.planes.reshape(len(self.planes), -1)[:, np.where(inside, row * cols + col, 0)] * inside
        strip = cut.reshape(len(cut), len(poses), SIDE, SIDE).transpose(0, 2, 1, 3).reshape(len(cut), SIDE, -1)
        return map_rows(strip.astype(np.float32) / np.float32(_FULL), stride=SIDE)


@dataclass(frozen=True, kw_only=True)
class Embedding:
    """Linear feature of a descriptor: (descriptor - mean) @ weights, of length 1; of the descriptor, without weights.

    `mean` has shape (NUMBERS,), `weights` (NUMBERS, DIMENSIONS).
    """

    mean: Rows
    weights: Rows | None = None

    def features(self, descriptors: Rows) -> Rows:
        """Return features of descriptors; what is unknown (NaN) counts as average."""
        centred = np.nan_to_num(descriptors - self.mean)
        return unit(centred if self.weights is None else centred @ self.weights)

    def to_text(self) -> str:
        """Return it as JSON."""
        assert self.weights is not None  # noqa: S101 - nothing was learned otherwise
        content = np.concatenate([self.mean[:, None], self.weights], axis=1).astype("<f2").tobytes()
        numbers = base64.b85encode(content).decode("ascii")
        return json.dumps({"format": _FORMAT, "crc32": zlib.crc32(content), "numbers": numbers})

    @classmethod
    def read(cls, text: str, *, name: str) -> Self:
        """Read a learned text for the matcher `name`; raise one line if it is damaged."""

        def read(saved: dict[str, Any]) -> NDArray[np.float32]:
            """Return all numbers."""
            content = base64.b85decode(saved["numbers"])
            numbers = np.frombuffer(content, dtype="<f2").astype(np.float32).reshape(NUMBERS, 1 + DIMENSIONS)
            is_whole = saved["format"] == _FORMAT and saved["crc32"] == zlib.crc32(content)
            return sound(numbers, is_sound=is_whole and bool(np.isfinite(numbers).all()))

        numbers = read_learned(name, text, read)
        return cls(mean=numbers[:, 0], weights=numbers[:, 1:])


@dataclass(frozen=True, kw_only=True)
class Gallery:
    """Places of a map, shape (N, 2), and features of the tiles around them, north up, shape (N, F)."""

    places_m: NDArray[np.float64]
    features: NDArray[np.float16]

    @classmethod
    def of(cls, grid: Grid, rows: NDArray[np.float16], embedding: Embedding) -> Self:
        """Embed the descriptors of a map, shape (rows, cols, NUMBERS)."""
        features = [embedding.features(row.astype(np.float32)).astype(np.float16) for row in rows]
        return cls(places_m=places_m(grid, rows.shape[:2], stride=STRIDE), features=np.concatenate(features))

    def within(self, disc: Disc) -> tuple[NDArray[np.float64], NDArray[np.float16]]:
        """Return the places within a disc, shape (N, 2), and their features."""
        inside = disc.holds(self.places_m)
        return self.places_m[inside], self.features[inside]


@dataclass(frozen=True, kw_only=True)
class Sight:
    """Features of a view, shape (H, F), turned north up from each of the headings that it may have."""

    yaws_deg: tuple[float, ...]
    features: Rows


class EmbeddingMatcher(PlaceMatcher[Sight]):
    """Cosine ranking of tiles of the map; a subclass says of which lessons its embedding is learned."""

    copies = 1  # of the tile of a location, at as many headings
    heights: tuple[float, ...] = (1.0,)  # from which each view of a location is shown, relative to its own
    made_up = 8  # views of a location that no view of training shows, at each height
    others = OTHERS
    several_deg: tuple[float, ...] = (0.0,)  # turns of the copies of a view whose mean is its feature

    open_numbers = {"penalty": (1e-4, 1e-3, 1e-2), "epochs": (15, 30)}  # of squared weights; of training
    chosen = {"penalty": 1e-3, "epochs": 30}

    def read(self, region: Region, learned: str | None) -> None:
        """Describe the map, by the plain descriptor if nothing was learned."""
        taught = None if learned is None else Embedding.read(learned, name=self.card.name)
        self._classes = region.classes
        self._ground = Ground.of(region)
        rows = np.stack([row.astype(np.float16) for row in described(region, stride=STRIDE)])
        self._embedding = taught or Embedding(mean=rows.mean(axis=(0, 1), dtype=np.float32))
        self._gallery = Gallery.of(region.grid, rows, self._embedding)

    def look(self, query: Query) -> Sight | None:
        """Return the features of a view at the headings that it may have; None where nothing is known near its middle.

        Of headings at right angles to each other one is turned cell by cell, the others sector by sector. Classes that
        the map lacks are left out.
        """
        shared = [at for at, name in enumerate(query.evidence.classes) if name in self._classes]
        if not shared:
            return None
        seen = Evidence(
            classes=tuple(query.evidence.classes[at] for at in shared),
            cells=query.evidence.cells[shared],
            cell_size_m=query.evidence.cell_size_m,
        )
        level = replace(query.prior, scale_sigma=0.0)
        turns = turns_of(level, spread=SPREAD, step=float(np.radians(YAW_STEP_DEG)))
        found: dict[float, Rows] = {}
        for base in turns.bases:
            upright = [view_descriptor(north_up(seen, base.yaw_deg + by_deg)) for by_deg in self.several_deg]
            for quarter in range(turns.quarters):
                sectors = quarter * SECTORS // _QUARTERS
                copies = [turned(descriptor, sectors, yaws=SECTORS) for descriptor in upright]
                found[base.yaw_deg + 90.0 * quarter] = np.stack(copies)
        if np.isnan(np.stack([*found.values()])).all():
            return None
        means = [self._embedding.features(copies).mean(axis=0) for copies in found.values()]
        return Sight(yaws_deg=tuple(found), features=unit(np.stack(means)))

    def modes(self, view: Sight, disc: Disc, *, count: int) -> list[Mode]:
        """Return the most similar tiles."""
        places_m, features = self._gallery.within(disc)
        return self._ranked(view, places_m, features, most=count)

    def near(self, view: Sight, poses: Sequence[Pose]) -> list[Mode | None]:
        """Return the heading at which the tile around each candidate is most similar."""
        upright = [replace(pose, yaw_deg=0.0, scale=1.0) for pose in poses]
        features = self._embedding.features(self._ground.tiles(upright))
        rows = zip(poses, features, strict=True)
        found = [self._ranked(view, points_of([pose]), row[None], most=1) for pose, row in rows]
        return [next(iter(modes), None) for modes in found]

    def _ranked(
        self, view: Sight, places_m: NDArray[np.float64], features: NDArray[np.floating], *, most: int
    ) -> list[Mode]:
        """Return the places whose features are most similar to those of a view at any heading."""
        if not len(places_m):
            return []
        cosine = features.astype(np.float32) @ view.features.T
        which, best = cosine.argmax(axis=1), cosine.max(axis=1).astype(np.float64).round(_DIGITS)
        chosen = separate(places_m, best, apart_m=APART_M, most=most)
        return [
            Mode(
                pose=Pose(
                    easting_m=float(places_m[at, 0]),
                    northing_m=float(places_m[at, 1]),
                    yaw_deg=view.yaws_deg[int(which[at])],
                ),
                score=float(best[at]),
            )
            for at in chosen
        ]

    def learn(self, training: Training) -> str:
        """Return the embedding of the locations of training, as JSON."""
        pairs = [pair for pair in training.pairs if pair[0].track == "localization" and pair[1].pose is not None]
        chosen = sorted(pairs[:: -(-len(pairs) // MOST_VIEWS) or 1], key=lambda pair: pair[0].region)
        lessons: list[Lessons] = []
        others = min(self.others, MOST_OTHERS // max(1, len({query.region for query, _ in chosen})))
        for name, some in groupby(chosen, key=lambda pair: pair[0].region):
            region, rng = training.regions[name], _rng(name)
            ground = Ground.of(region)
            lessons.extend(self._of_views(ground, list(some)))
            lessons.extend(self._of_others(ground, region.grid, others, rng))
        if len(lessons) < 2:  # noqa: PLR2004 - two classes
            message = f"{self.card.name}: training shows {len(lessons)} locations, expected two at least"
            raise ValueError(message)
        return fitted(
            lessons,
            _rng(self.card.name),
            penalty=self.numbers["penalty"],
            epochs=int(self.numbers["epochs"]),
        ).to_text()

    def _of_views(self, ground: Ground, pairs: Sequence[tuple[Query, Truth]]) -> Iterator["Lessons"]:
        """Yield the lessons of each location that views of training show."""
        by_place: dict[tuple[float, float], list[tuple[Evidence, Pose]]] = {}
        for query, truth in pairs:
            if truth.pose is not None:
                place = (round(truth.pose.easting_m), round(truth.pose.northing_m))
                by_place.setdefault(place, []).append((query.evidence, truth.pose))
        for views in by_place.values():
            tiles = ground.tiles(self._copied(views[0][1]))
            shown = [views[at % len(views)] for at in range(max(len(views), self.copies))]
            seen = np.stack(
                [
                    view_descriptor(north_up(_from_height(evidence, height), pose.yaw_deg - self._turn_deg(at)))
                    for height in self.heights
                    for at, (evidence, pose) in enumerate(shown)
                ]
            )
            level = self.heights.index(1.0) * len(shown) + np.arange(len(shown))
            errors = seen[level] - tiles[np.arange(len(shown)) % self.copies]
            yield Lessons(tiles=tiles, views=seen, errors=errors, is_made_up=False)

    def _of_others(self, ground: Ground, grid: Grid, count: int, rng: np.random.Generator) -> Iterator["Lessons"]:
        """Yield the lessons of locations anywhere on a map, seen from near their middles without errors."""
        west_m, south_m, east_m, north_m = grid.bounds_m
        for _ in range(count):
            place_m = rng.uniform((west_m, south_m), (east_m, north_m))
            pose = Pose(easting_m=float(place_m[0]), northing_m=float(place_m[1]), yaw_deg=0.0)
            views = [
                replace(
                    pose,
                    easting_m=pose.easting_m + float(rng.uniform(-NEAR_M, NEAR_M)),
                    northing_m=pose.northing_m + float(rng.uniform(-NEAR_M, NEAR_M)),
                    yaw_deg=self._turn_deg(at) + float(rng.uniform(-NEAR_DEG, NEAR_DEG)),
                    scale=height,
                )
                for height in self.heights
                for at in range(self.made_up)
            ]
            yield Lessons(
                tiles=ground.tiles(self._copied(pose)),
                views=ground.tiles(views),
                errors=np.zeros((0, NUMBERS), dtype=np.float32),
                is_made_up=True,
            )

    def _turn_deg(self, at: int) -> float:
        """Return the heading of a copy; a view is shown at that of the copy of its number."""
        return 360.0 * (at % self.copies) / self.copies

    def _copied(self, pose: Pose) -> list[Pose]:
        return [replace(pose, yaw_deg=self._turn_deg(at), scale=1.0) for at in range(self.copies)]


def _from_height(evidence: Evidence, height: float) -> Evidence:
    """Return a view as it looks from so many times its height, if that is not known: all in it is smaller."""
    return replace(evidence, cell_size_m=evidence.cell_size_m / height)


@dataclass(frozen=True, kw_only=True)
class Lessons:
    """Descriptors of one location: its tile and copies of it, and views; made-up views are without errors so far.

    `errors` are differences between views and the tile from where they were taken.
    """

    tiles: Rows
    views: Rows
    errors: Rows
    is_made_up: bool


def fitted(lessons: Sequence[Lessons], rng: np.random.Generator, *, penalty: float, epochs: int) -> Embedding:
    """Return the weights of a bottleneck before a softmax over locations: shared by tiles and views (instance loss)."""
    from sklearn.exceptions import ConvergenceWarning  # type: ignore[import-untyped, unused-ignore]  # noqa: PLC0415
    from sklearn.neural_network import MLPClassifier  # type: ignore[import-untyped, unused-ignore]  # noqa: PLC0415

    errors = np.concatenate([lesson.errors for lesson in lessons])
    rows, label = [], []
    for at, lesson in enumerate(lessons):
        views = lesson.views
        if lesson.is_made_up and len(errors):
            views = np.clip(views + errors[rng.integers(len(errors), size=len(views))], 0.0, 1.0)
        rows += [lesson.tiles, views]
        label += [at] * (len(lesson.tiles) + len(views))
    table = np.concatenate(rows)
    mean = np.nanmean(table, axis=0)
    spread = np.maximum(np.nanstd(table, axis=0), _SMALL)
    model = MLPClassifier(
        hidden_layer_sizes=(DIMENSIONS,),
        activation="identity",
        alpha=penalty,
        learning_rate_init=_RATE,
        max_iter=epochs,
        n_iter_no_change=epochs,
        random_state=int(rng.integers(2**31)),
    )
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ConvergenceWarning)  # it is stopped early on purpose
        model.fit(np.nan_to_num((table - mean) / spread), label)
    return Embedding(mean=mean.astype(np.float32), weights=(model.coefs_[0] / spread[:, None]).astype(np.float32))


def _rng(name: str) -> np.random.Generator:
    """Return the random generator of a name."""
    return np.random.default_rng(int.from_bytes(hashlib.sha256(name.encode()).digest()[:8], "big"))
