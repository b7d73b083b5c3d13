# SPDX-License-Identifier: Apache-2.0
"""Retrieval of map tiles by a learned embedding: a linear feature that tells locations apart, shared with views."""

import base64
import hashlib
import json
import zlib
from collections.abc import Iterator, Mapping, Sequence
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
    RINGS,
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
YAW_STEP_DEG: Final = 7.5  # a third of a sector
NUMBERS: Final = len(GROUPS) * DEPTH  # of a descriptor

OTHERS: Final = 400  # locations of each training map besides those of views
MOST_ROWS: Final = 120_000  # descriptors of all these: bounds memory (220 MB) and time (a minute)
NEAR_M: Final = 12.0  # a made-up view lies so far from its tile, as the middle of a real one from the lattice
NEAR_DEG: Final = 4.0  # half a step of headings
_FORMAT: Final = "sasgeo-baselines embedding 2"
_FULL: Final = 255.0
_AT_ONCE: Final = 64  # tiles cut together: 16 MB; locations whose examples are read together
_SMALL: Final = 0.05  # standard deviation of a number of the descriptor that is noise
_NOTHING: Final = 1e-6  # of the largest ratio of scatters: a direction in which locations do not differ


def ours(chosen: Mapping[str, float]) -> str:
    """Return what the cards of all who learn an embedding say, with their open numbers."""
    return (
        f"In place of networks for pictures: a descriptor of view and map alike (occupancy of {len(GROUPS)} groups of "
        f"classes in {RINGS} rings and {SECTORS} sectors of a disc of {RADIUS_M:g} m, and how much lies near them). In "
        f"place of a trained network before a softmax: a linear bottleneck of up to {chosen['size']:g} numbers, the "
        "directions in which locations differ most for what differs within them (linear discriminants; "
        f"{chosen['shrinkage']:g} of the mean variance within locations is added to that of each direction). A "
        "bottleneck trained before a softmax over the locations of training ranked new locations worse than the plain "
        "descriptor: it learned no distance for them. Locations are those of the views of training, and up to "
        f"{OTHERS} random ones of each of its maps, fewer where their tiles and views would be more than "
        f"{MOST_ROWS:,}; they are shown from within {NEAR_M:g} m of their middle with errors drawn from those of the "
        "views of their map. The gallery has a tile every "
        f"{STRIDE * CELL_M:g} m, facing north; a view is turned north from each heading that it may have, "
        f"{YAW_STEP_DEG:g} degrees apart within {SPREAD:g} standard deviations of the prior. A candidate has a tile of "
        "its own"
    )


LIMITS: Final = (
    "Works on class layers, not on pictures. Untaught it ranks by the cosine of the plain descriptor, less its mean "
    "over the map and divided by its spread there. The answer is the middle of a tile, up to "
    f"{STRIDE * CELL_M / 2**0.5:.0f} m off; views are cut beyond {RADIUS_M:g} m from their middle; what is unknown in "
    "a view counts as average, what is unknown on the map as empty; scale is 1; no sequence, no weights by what lasts, "
    "no rejection, no confidence"
)

Rows = NDArray[np.float32]  # descriptors or features, shape (N, NUMBERS) or (N, F)
Stored = NDArray[np.float16]  # the same where there are many


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
    """Linear feature of a descriptor: (descriptor - mean) / spread @ weights, of length 1; weights are 1 if not given.

    `mean` and `spread` have shape (NUMBERS,), `weights` (NUMBERS, F).
    """

    mean: Rows
    spread: Rows
    weights: Rows | None = None

    def standard(self, descriptors: NDArray[np.floating]) -> Rows:
        """Return standardised descriptors; what is unknown (NaN) counts as average."""
        return np.asarray(np.nan_to_num((descriptors - self.mean) / self.spread), dtype=np.float32)

    def features(self, descriptors: NDArray[np.floating]) -> Rows:
        """Return features of descriptors."""
        rows = self.standard(descriptors)
        return unit(rows if self.weights is None else rows @ self.weights)

    def to_text(self) -> str:
        """Return it as JSON."""
        assert self.weights is not None  # noqa: S101 - nothing was learned otherwise
        content = np.column_stack([self.mean, self.spread, self.weights]).astype("<f2").tobytes()
        numbers = base64.b85encode(content).decode("ascii")
        return json.dumps({"format": _FORMAT, "crc32": zlib.crc32(content), "numbers": numbers})

    @classmethod
    def read(cls, text: str, *, name: str) -> "Embedding":
        """Read a learned text for the matcher `name`; raise one line if it is damaged."""

        def read(saved: dict[str, Any]) -> Embedding:
            content = base64.b85decode(saved["numbers"])
            numbers = np.frombuffer(content, dtype="<f2").astype(np.float32).reshape(NUMBERS, -1)
            found = Embedding(mean=numbers[:, 0], spread=numbers[:, 1], weights=numbers[:, 2:])
            is_whole = saved["format"] == _FORMAT and saved["crc32"] == zlib.crc32(content)
            is_sound = numbers.shape[1] > 2 and bool(np.isfinite(numbers).all() and (found.spread > 0).all())
            return sound(found, is_sound=is_whole and is_sound)

        return read_learned(name, text, read)


@dataclass(frozen=True, kw_only=True)
class Gallery:
    """Places of a map, shape (N, 2), and features of the tiles around them, north up, shape (N, F)."""

    places_m: NDArray[np.float64]
    features: Stored

    @classmethod
    def of(cls, grid: Grid, rows: Stored, embedding: Embedding) -> Self:
        """Embed the descriptors of a map, shape (rows, cols, NUMBERS)."""
        features = [embedding.features(row).astype(np.float16) for row in rows]
        return cls(places_m=places_m(grid, rows.shape[:2], stride=STRIDE), features=np.concatenate(features))

    def within(self, disc: Disc) -> tuple[NDArray[np.float64], Stored]:
        """Return the places within a disc, shape (N, 2), and their features."""
        inside = disc.holds(self.places_m)
        return self.places_m[inside], self.features[inside]


@dataclass(frozen=True, kw_only=True)
class PreparedView:
    """Features of a view, shape (H, F), turned north up from each of the headings that it may have."""

    yaws_deg: tuple[float, ...]
    features: Rows


class EmbeddingMatcher(PlaceMatcher[PreparedView]):
    """Cosine ranking of tiles of the map; a subclass says of which examples its embedding is learned."""

    copies = 1  # of the tile of a location, at as many headings
    heights: tuple[float, ...] = (1.0,)  # from which each view of a location is shown, relative to its own
    made_up = 8  # views of a location that no view of training shows, at each height
    others = OTHERS
    several_deg: tuple[float, ...] = (0.0,)  # turns of the copies of a view whose mean is its feature

    open_numbers = {"shrinkage": (0.1, 0.3, 0.9), "size": (64, 128)}  # of the scatter within locations; of features
    chosen = {"shrinkage": 0.9, "size": 128}

    def read(self, region: Region, learned: str | None) -> None:
        """Describe the map, by the plain descriptor if nothing was learned."""
        taught = None if learned is None else Embedding.read(learned, name=self.card.name)
        self._classes = region.classes
        self._ground = Ground.of(region)
        rows = np.stack([row.astype(np.float16) for row in described(region, stride=STRIDE)])
        self._embedding = taught or _plain(rows)
        self._gallery = Gallery.of(region.grid, rows, self._embedding)

    def look(self, query: Query) -> PreparedView | None:
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
                sectors = quarter * SECTORS // 4
                copies = [turned(descriptor, sectors, yaws=SECTORS) for descriptor in upright]
                found[base.yaw_deg + 90.0 * quarter] = np.stack(copies)
        if np.isnan(np.stack([*found.values()])).all():
            return None
        means = [self._embedding.features(copies).mean(axis=0) for copies in found.values()]
        return PreparedView(yaws_deg=tuple(found), features=unit(np.stack(means)))

    def modes(self, view: PreparedView, disc: Disc, *, count: int) -> list[Mode]:
        """Return the most similar tiles."""
        places_m, features = self._gallery.within(disc)
        return self._ranked(view, places_m, features, most=count)

    def near(self, view: PreparedView, poses: Sequence[Pose]) -> list[Mode | None]:
        """Return the heading at which the tile around each candidate is most similar."""
        upright = [replace(pose, yaw_deg=0.0, scale=1.0) for pose in poses]
        features = self._embedding.features(self._ground.tiles(upright))
        rows = zip(poses, features, strict=True)
        found = [self._ranked(view, points_of([pose]), row[None], most=1) for pose, row in rows]
        return [next(iter(modes), None) for modes in found]

    def _ranked(
        self, view: PreparedView, places_m: NDArray[np.float64], features: NDArray[np.floating], *, most: int
    ) -> list[Mode]:
        if not len(places_m):
            return []
        cosine = features.astype(np.float32) @ view.features.T
        # 6 digits of a cosine: equal tiles are equal
        which, best = cosine.argmax(axis=1), cosine.max(axis=1).astype(np.float64).round(6)
        chosen = separate(places_m, best, apart_m=25.0, most=most)  # between two places of an answer
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
        # At most 1200 views of training
        chosen = sorted(pairs[:: -(-len(pairs) // 1200) or 1], key=lambda pair: pair[0].region)
        shown = self.copies + len(self.heights) * self.made_up
        others = min(self.others, MOST_ROWS // (shown * max(1, len({query.region for query, _ in chosen}))))
        examples: list[Stored] = []
        for name, some in groupby(chosen, key=lambda pair: pair[0].region):
            region = training.regions[name]
            ground = Ground.of(region)
            seen = list(self._of_views(ground, list(some)))
            errors = np.concatenate([example.errors for example in seen])
            examples.extend(example.rows for example in seen)
            examples.extend(self._of_others(ground, region.grid, others, errors, _rng(name)))
        if len(examples) < 2:  # two classes
            raise ValueError(f"{self.card.name}: training shows {len(examples)} locations, expected two at least")
        return fitted(examples, shrinkage=self.numbers["shrinkage"], size=int(self.numbers["size"])).to_text()

    def _of_views(self, ground: Ground, pairs: Sequence[tuple[Query, Truth]]) -> Iterator["TrainingExample"]:
        """Yield the examples of each location that views of training show."""
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
            yield TrainingExample(
                rows=np.concatenate([tiles, seen]).astype(np.float16), errors=errors.astype(np.float16)
            )

    def _of_others(
        self, ground: Ground, grid: Grid, count: int, errors: Stored, rng: np.random.Generator
    ) -> Iterator[Stored]:
        """Yield the examples of locations anywhere on a map, seen from near their middles with such errors."""
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
            tiles = ground.tiles(self._copied(pose))
            seen = ground.tiles(views) + errors[rng.integers(len(errors), size=len(views))]
            yield np.concatenate([tiles, np.clip(seen, 0.0, 1.0)]).astype(np.float16)

    def _turn_deg(self, at: int) -> float:
        """Return the heading of a copy; a view is shown at that of the copy of its number."""
        return 360.0 * (at % self.copies) / self.copies

    def _copied(self, pose: Pose) -> list[Pose]:
        return [replace(pose, yaw_deg=self._turn_deg(at), scale=1.0) for at in range(self.copies)]


def _from_height(evidence: Evidence, height: float) -> Evidence:
    """Return a view as it looks from so many times its height, if that is not known: all in it is smaller."""
    return replace(evidence, cell_size_m=evidence.cell_size_m / height)


@dataclass(frozen=True, kw_only=True)
class TrainingExample:
    """Descriptors of one location: its tile and copies of it, then views; and how views differ from the tile there."""

    rows: Stored
    errors: Stored


def fitted(locations: Sequence[Stored], *, shrinkage: float, size: int) -> Embedding:
    """Return up to `size` linear discriminants of locations, each with the descriptors of its tiles and views.

    They are the leading directions of the scatter of the means of locations over that within locations, to which
    `shrinkage` of its mean variance is added in all directions. In features, what differs within locations has about
    the same variance in each. The largest weight of a direction is positive.
    """
    from scipy.linalg import eigh  # noqa: PLC0415 - slow to import, and only learning needs it

    plain = _measured(locations)
    within, middles, count = np.zeros((NUMBERS, NUMBERS)), [], 0
    for rows, lengths in _together(locations):
        table = plain.standard(rows)
        means = np.add.reduceat(table, np.cumsum([0, *lengths[:-1]]), axis=0) / np.array(lengths)[:, None]
        table -= np.repeat(means, lengths, axis=0)
        within += table.T @ table
        middles.append(means)
        count += len(table)
    within /= count
    floor = max(shrinkage * float(np.trace(within)) / NUMBERS, _NOTHING)
    between = np.cov(np.concatenate(middles), rowvar=False)
    most = min(size, len(locations) - 1, NUMBERS)
    ratios, directions = eigh(between, within + floor * np.eye(NUMBERS), subset_by_index=(NUMBERS - most, NUMBERS - 1))
    kept = np.flatnonzero(ratios > _NOTHING * ratios[-1])[::-1] if ratios[-1] > 0 else np.array([most - 1])
    weights = directions[:, kept]
    weights *= np.where(np.take_along_axis(weights, np.abs(weights).argmax(axis=0)[None], axis=0) < 0, -1.0, 1.0)
    return replace(plain, weights=weights.astype(np.float32))


def _together(locations: Sequence[Stored]) -> Iterator[tuple[Rows, list[int]]]:
    for first in range(0, len(locations), _AT_ONCE):
        some = locations[first : first + _AT_ONCE]
        yield np.concatenate(some).astype(np.float32), [len(rows) for rows in some]


def _measured(locations: Sequence[Stored]) -> Embedding:
    """Return the mean and spread of descriptors over what is known."""
    known, total, squares = np.zeros((3, NUMBERS))
    for rows, _ in _together(locations):
        known += (~np.isnan(rows)).sum(axis=0)
        total += np.nansum(rows, axis=0)
        squares += np.nansum(np.square(rows), axis=0)
    mean = total / known
    spread = np.sqrt(np.maximum(squares / known - mean**2, _SMALL**2))
    return Embedding(mean=mean.astype(np.float32), spread=spread.astype(np.float32))


def _plain(rows: Stored) -> Embedding:
    mean = rows.mean(axis=(0, 1), dtype=np.float32)
    variance = np.mean([np.square(row - mean).mean(axis=0) for row in rows], axis=0)
    return Embedding(mean=mean, spread=np.maximum(np.sqrt(variance), _SMALL).astype(np.float32))


def _rng(name: str) -> np.random.Generator:
    return np.random.default_rng(int.from_bytes(hashlib.sha256(name.encode()).digest()[:8], "big"))
