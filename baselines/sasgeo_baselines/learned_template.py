# SPDX-License-Identifier: Apache-2.0
"""Encoders of `orienternet_template`: their weights, the passes that torch carries out, and how they are taught."""

import base64
import hashlib
import json
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Final, Self, TypeAlias, TypeVar

import numpy as np
from numpy.typing import NDArray
from scipy import fft

from sasgeo_baselines.learned import read_learned, sound

Floats = NDArray[np.float32]
Weights = dict[str, Floats]
Tensor: TypeAlias = Any  # of torch, an extra, of which type checkers know nothing
Value = TypeVar("Value", np.uint8, np.float16, np.float32)

NAME: Final = "orienternet_template"
CELL_M: Final = 4.0  # of a view, and about that of the map
CHANNELS: Final = 8  # of a template
FULL: Final = 255  # of a share
MARGIN: Final = 2  # cells to each side that an encoder sees of a cell: two kernels of 3 x 3

_FORMAT: Final = f"{NAME} 1"
_WIDTH: Final = 24  # channels between two convolutions
_USUAL_M2: Final = 16_000.0  # that a view knows

_PLACES: Final = 96  # a side of the square of places that a true one is compared with
_HEADINGS: Final = 12
_LOOKS_EACH: Final = 4  # at a view, on average: more make it surer of the places it learns from, and worse on others
_MOST_LOOKS: Final = 600
_BATCH: Final = 4
_RATE: Final = 3e-3  # of learning, at its highest
_DECAY: Final = 1e-2


@dataclass(frozen=True, kw_only=True)
class Encoders:
    """An encoder of views, one of maps, and how sharp the posterior is that follows from both.

    `classes` are the K classes that they read; `arrays` are tensors in the shapes of `shapes`.
    """

    torch: Any
    classes: tuple[str, ...]
    arrays: Mapping[str, Tensor]

    @classmethod
    def of(cls, torch: Any, classes: tuple[str, ...], weights: Weights) -> Self:  # noqa: ANN401 - a module
        """Hand weights to torch."""
        return cls(torch=torch, classes=classes, arrays={name: torch.from_numpy(one) for name, one in weights.items()})

    def template(self, view: Tensor) -> Tensor:
        """Return the template of a view, and the share of each of its cells that is known.

        Parameters
        ----------
        view : Tensor, shape (2K, rows, cols)
            Shares of cells where each class is present, then absent, 0..1; neither where it is unknown.

        Returns
        -------
        Tensor, shape (CHANNELS + 1, rows, cols)
            Channels, times confidence, times the share that is known; and that share, 0..1. An unknown cell is 0.
        """
        present, absent = view[: len(self.classes)], view[len(self.classes) :]
        each = present + absent
        known = each.amax(dim=0)
        reported = self._encoded("view", self.torch.cat([self._unusual(present, each), each]))
        confidence = self.torch.sigmoid(reported[CHANNELS])
        return self.torch.cat([reported[:CHANNELS] * confidence * known, known[None]])

    def features(self, mapped: Tensor, has: Tensor) -> Tensor:
        """Return the channels of a map, and its known cells.

        Parameters
        ----------
        mapped : Tensor, shape (K + 1, rows, cols)
            Shares of cells where each class is present, 0..1, and, last, 1 where the map is known.
        has : Tensor, shape (K,)
            1 for a class that the map knows of, 0 for one that is unknown all over it.

        Returns
        -------
        Tensor, shape (CHANNELS + 1, rows, cols)
            0 where the map is unknown.
        """
        known = mapped[-1:]
        usual = self._unusual(mapped[:-1], known * has[:, None, None])
        return self.torch.cat([self._encoded("map", self.torch.cat([usual, known])) * known, known])

    def sharpness(self, known_m2: Tensor) -> Tensor:
        """Return what the mean agreement is multiplied by, of a view that knows so many square metres."""
        level, power = self.arrays["sharpness"]
        return self.torch.exp(level + power * self.torch.log(known_m2.clamp(min=CELL_M**2) / _USUAL_M2))

    def _unusual(self, present: Tensor, known: Tensor) -> Tensor:
        """By how much each share differs from that of its class on maps, in standard deviations; 0 if unknown."""
        # A class that is rare counts as much as one that is common, and a cell that is unknown is an average one.
        mean, spread = self.arrays["usual"][:, :, None, None]
        return (present - mean * known) / spread

    def _encoded(self, side: str, planes: Tensor) -> Tensor:
        """Return two convolutions and a linear layer, added to one straight from what is read."""
        functional = self.torch.nn.functional
        at = planes[None]
        for level in range(2):
            kernel, shift = self.arrays[f"{side}.{level}.kernel"], self.arrays[f"{side}.{level}.shift"]
            at = functional.relu(functional.conv2d(at, kernel, shift, padding=1))
        found = functional.conv2d(at, self.arrays[f"{side}.2.kernel"], self.arrays[f"{side}.2.shift"])[0]
        straight = functional.conv2d(planes[None], self.arrays[f"{side}.straight.kernel"])[0]
        return self.torch.cat([found[:CHANNELS] + straight, found[CHANNELS:]])


def shapes(classes: int) -> dict[str, tuple[int, ...]]:
    """Return the shape of each array of encoders of so many classes.

    >>> shapes(13)["view.0.kernel"], sum(math.prod(shape) for shape in shapes(13).values())
    ((24, 26, 3, 3), 19877)
    """
    found: dict[str, tuple[int, ...]] = {"usual": (2, classes), "sharpness": (2,)}
    for side, given, reported in (("view", 2 * classes, CHANNELS + 1), ("map", classes + 1, CHANNELS)):
        for level, (into, out, size) in enumerate(((given, _WIDTH, 3), (_WIDTH, _WIDTH, 3), (_WIDTH, reported, 1))):
            found[f"{side}.{level}.kernel"] = (out, into, size, size)
            found[f"{side}.{level}.shift"] = (out,)
        found[f"{side}.straight.kernel"] = (CHANNELS, given, 1, 1)
    return found


def drawn_weights(classes: int) -> Weights:
    """Draw weights to begin with, the same every time: like classes meet in like channels, and little is added."""
    rng = np.random.default_rng(seed_of(f"{_FORMAT} weights"))
    found: Weights = {}
    for name, shape in shapes(classes).items():
        values = np.zeros(shape)
        if name.endswith(".kernel"):
            gain = 0.01 if ".2." in name else 2.0
            values = rng.normal(0, math.sqrt(gain / math.prod(shape[1:])), shape)
        found[name] = values.astype(np.float32)
    like = rng.normal(0, math.sqrt(1 / CHANNELS), (CHANNELS, classes))
    for side in ("view", "map"):
        straight = found[f"{side}.straight.kernel"]
        straight[:] = 0
        straight[:, :classes, 0, 0] = like
    found["view.2.shift"][CHANNELS] = 1.0  # of the confidence, which begins high
    found["usual"][1] = 1.0
    # Learning begins with a sharpness of 10, of a view that knows `_USUAL_M2`
    found["sharpness"][:] = math.log(10.0), 0.5  # 0.5: power of the known area
    return found


def seed_of(text: str) -> int:
    """Return a random seed that depends on a text alone.

    >>> seed_of("a view") == seed_of("a view") != seed_of("another")
    True
    """
    return int.from_bytes(hashlib.sha256(text.encode()).digest()[:8], "big")


def weights_text(classes: tuple[str, ...], weights: Weights) -> str:
    """Return classes and weights as JSON, each array as base64 of its little-endian half precision numbers.

    >>> text = weights_text(("water",), drawn_weights(1))
    >>> len(text) < 100_000, weights_of(text)[0]
    (True, ('water',))
    """
    arrays = {name: base64.b64encode(values.astype("<f2").tobytes()).decode() for name, values in weights.items()}
    return json.dumps({"format": _FORMAT, "classes": list(classes), "arrays": arrays})


def weights_of(learned: str) -> tuple[tuple[str, ...], Weights]:
    """Read the text of `weights_text`; raise one line if it is damaged."""

    def read(saved: dict[str, Any]) -> tuple[tuple[str, ...], Weights]:
        classes = tuple(str(name) for name in saved["classes"])
        found: Weights = {}
        for name, shape in shapes(len(classes)).items():
            values = np.frombuffer(base64.b64decode(saved["arrays"][name], validate=True), dtype="<f2")
            found[name] = values.astype(np.float32).reshape(shape)
        is_finite = all(bool(np.isfinite(values).all()) for values in found.values())
        is_whole = saved["format"] == _FORMAT and is_finite and bool((found["usual"][1] > 0).all())
        return sound((classes, found), is_sound=is_whole)

    return read_learned(NAME, learned, read)


# Templates over maps


def half_of(shape: tuple[int, ...], cells_m: tuple[float, float], step_m: float) -> int:
    """Return the cells of `step_m` from the middle of a view to its farthest corner, and one more."""
    return math.ceil(math.hypot(shape[0] * cells_m[0], shape[1] * cells_m[1]) / 2 / step_m) + 1


def turned(
    torch: Any,  # noqa: ANN401 - a module
    template: Tensor,
    cells_m: tuple[float, float],
    yaws_deg: Sequence[float],
    *,
    step_m: float,
) -> Tensor:
    """Lay a template on a north-up lattice for each heading, linearly, 0 beyond it.

    Parameters
    ----------
    torch : module
        PyTorch.
    template : Tensor, shape (C, rows, cols)
        Up is the heading.
    cells_m : tuple of float
        Height and width of its cells, metres.
    yaws_deg : sequence of float
        Headings.
    step_m : float
        Side of a cell of the lattice.

    Returns
    -------
    Tensor, shape (len(yaws_deg), C, side, side)
        The middle of the view is that of the middle cell.
    """
    rows, cols = template.shape[1:]
    half = half_of((rows, cols), cells_m, step_m)
    steps_m = torch.arange(-half, half + 1, dtype=torch.float32) * step_m
    yaws = torch.deg2rad(torch.tensor(list(yaws_deg), dtype=torch.float64)).to(torch.float32)[:, None, None]
    cosine, sine, east_m, north_m = torch.cos(yaws), torch.sin(yaws), steps_m[None, None, :], -steps_m[None, :, None]
    across = (cosine * east_m - sine * north_m) / (cols * cells_m[1] / 2)
    down = -(sine * east_m + cosine * north_m) / (rows * cells_m[0] / 2)
    return torch.nn.functional.grid_sample(
        template[None].expand(len(yaws_deg), -1, -1, -1),
        torch.stack([across, down], dim=-1),
        mode="bilinear",
        padding_mode="zeros",
        align_corners=False,
    )


def transformed(torch: Any, planes: Tensor, side: int) -> Tensor:  # noqa: ANN401 - a module
    """Return transforms of planes, (..., rows, cols), with 0 around, of a side at least: shape (..., n, n / 2 + 1)."""
    size = fft.next_fast_len(side, real=True)
    return torch.fft.fft(torch.fft.rfft(planes, n=size), n=size, dim=-2)


def agreement(torch: Any, seen: Tensor, mapped: Tensor, places: int, known: Tensor | None = None) -> Any:  # noqa: ANN401
    """Return the mean product of template and map over cells known on both sides, and the number of these cells.

    Parameters
    ----------
    torch : module
        PyTorch.
    seen : Tensor, shape (Y, CHANNELS + 1, n, n / 2 + 1)
        Transforms of turned templates.
    mapped : Tensor, shape (CHANNELS + 1, n, n / 2 + 1)
        Transform of the map under them at all places.
    places : int
        Places a side.
    known : Tensor, shape (Y, 1, 1), optional
        Numbers of cells where the map is known all over, which saves a transform.

    Returns
    -------
    tuple of Tensor, shapes (Y, places, places)
        The mean; the number, or `known`.
    """
    size = mapped.shape[-2]
    cross = (seen[:, :CHANNELS].conj() * mapped[:CHANNELS]).sum(dim=1)
    total = torch.fft.irfft2(cross, s=(size, size))[:, :places, :places]
    if known is None:
        both = seen[:, CHANNELS].conj() * mapped[CHANNELS]
        known = torch.fft.irfft2(both, s=(size, size))[:, :places, :places]
    return total / known.clamp(min=1.0), known


def step_deg_of(shape: tuple[int, ...], cells_m: tuple[float, float]) -> float:
    """Return the step between headings: it moves the rim of a view by one and a half cells.

    >>> round(step_deg_of((48, 48), (4.0, 4.0)), 2)
    3.58
    """
    half_m = max(shape[0] * cells_m[0], shape[1] * cells_m[1]) / 2
    return min(max(math.degrees(1.5 * CELL_M / half_m), 1.5), 8.0)


def known_m2(template: Tensor, cells_m: tuple[float, float]) -> Tensor:
    """Return the area that the view of a template knows."""
    return template[CHANNELS].sum() * (cells_m[0] * cells_m[1])


def cut(layers: NDArray[Value], row: int, col: int, shape: tuple[int, int]) -> NDArray[Value]:
    """Cut a window that begins at (row, col) out of layers, shape (C, rows, cols); 0 beyond them."""
    found = np.zeros((len(layers), *shape), dtype=layers.dtype)
    top, left = max(row, 0), max(col, 0)
    bottom, right = min(row + shape[0], layers.shape[1]), min(col + shape[1], layers.shape[2])
    if top < bottom and left < right:
        found[:, top - row : bottom - row, left - col : right - col] = layers[:, top:bottom, left:right]
    return found


def shares(planes: NDArray[np.uint8]) -> Floats:
    """Return shares that are stored in bytes, 0..1."""
    return np.divide(planes, np.float32(FULL), dtype=np.float32)


# Learning


@dataclass(frozen=True, kw_only=True)
class TrainingExample:
    """A view, and the map around the place where it was taken.

    Parameters
    ----------
    name : str
        What is drawn for it depends on its name.
    view : ndarray of uint8, shape (2K, rows, cols)
        Shares of cells where each class is present, then absent, 0..`FULL`.
    cells_m : tuple of float
        Height and width of a cell of the view, metres.
    mapped : ndarray of uint8, shape (K + 1, rows, cols)
        Shares of each class, and known cells.
    step_m : float
        Side of a cell of the map.
    has : ndarray of float32, shape (K,)
        1 for a class that the map knows of.
    place : tuple of float
        Row and column of the place in the map; whole numbers are centres of cells.
    yaw_deg : float
        Heading.
    """

    name: str
    view: NDArray[np.uint8]
    cells_m: tuple[float, float]
    mapped: NDArray[np.uint8]
    step_m: float
    has: Floats
    place: tuple[float, float]
    yaw_deg: float

    def scene(self, rng: np.random.Generator, *, places: int = _PLACES) -> "Scene":
        """Return the view over a square of places somewhere around its own, at random turned and mirrored."""
        half = half_of(self.view.shape[1:], self.cells_m, self.step_m)
        row, col = (math.floor(at) for at in self.place)
        top, left = row - int(rng.integers(places - 1)), col - int(rng.integers(places - 1))
        around = half + MARGIN
        side = places + 2 * around
        mapped = cut(self.mapped, top - around, left - around, (side, side))
        scene = Scene(
            view=shares(self.view),
            cells_m=self.cells_m,
            mapped=shares(mapped),
            step_m=self.step_m,
            place=(self.place[0] - top, self.place[1] - left),
            yaw_deg=self.yaw_deg,
        )
        if rng.integers(2):
            scene = scene.mirrored()
        return scene.turned(int(rng.integers(4))).seen_turned(int(rng.integers(4))).with_a_hole(rng)


@dataclass(frozen=True, kw_only=True)
class Scene:
    """A view and a square of map, which holds all of the view from each of its places, and `MARGIN` cells more.

    `place`, row and column, counts from the centre of the first place; the rest is as in `TrainingExample`, shares
    0..1.
    """

    view: Floats
    cells_m: tuple[float, float]
    mapped: Floats
    step_m: float
    place: tuple[float, float]
    yaw_deg: float

    @property
    def places(self) -> int:
        """Return places a side."""
        return int(self.mapped.shape[1] - 2 * (half_of(self.view.shape[1:], self.cells_m, self.step_m) + MARGIN))

    def mirrored(self) -> Self:
        """Swap east and west, and left and right in the view."""
        row, col = self.place
        place = (row, self.places - 1 - col)
        return replace(
            self, view=self.view[:, :, ::-1], mapped=self.mapped[:, :, ::-1], place=place, yaw_deg=-self.yaw_deg
        )

    def turned(self, quarters: int) -> Self:
        """Turn the map counter-clockwise by right angles; the view looks the same, from another heading."""
        row, col = self.place
        for _ in range(quarters % 4):
            row, col = self.places - 1 - col, row
        mapped = np.rot90(self.mapped, quarters, axes=(1, 2))
        return replace(self, mapped=mapped, place=(row, col), yaw_deg=self.yaw_deg - 90.0 * quarters)

    def seen_turned(self, quarters: int) -> Self:
        """Turn the view counter-clockwise by right angles: what was on its right is up."""
        view = np.rot90(self.view, quarters, axes=(1, 2))
        cells_m = self.cells_m[::-1] if quarters % 2 else self.cells_m
        return replace(self, view=view, cells_m=cells_m, yaw_deg=self.yaw_deg + 90.0 * quarters)

    def with_a_hole(self, rng: np.random.Generator) -> Self:
        """Hide, of every other view, a rectangle of at most a quarter."""
        if rng.integers(2):
            return self
        view = self.view.copy()
        windows = []
        for count in view.shape[1:]:
            size = int(rng.integers(1, max(count // 2, 1) + 1))
            first = int(rng.integers(count - size + 1))
            windows.append(slice(first, first + size))
        view[:, *windows] = 0
        return replace(self, view=view)


def fitted(torch: Any, classes: tuple[str, ...], examples: Sequence[TrainingExample]) -> Weights:  # noqa: ANN401 - a module
    """Return the weights under which the true poses of views are least surprising, by AdamW.

    The rate of learning rises, then falls as a cosine. The same examples give the same weights on one machine and
    thread: what is drawn depends on the names of views alone.
    """
    weights = drawn_weights(len(classes)) | {"usual": usual_shares(examples)}
    arrays = {name: torch.tensor(values, requires_grad=name != "usual") for name, values in weights.items()}
    kernels = [values for name, values in arrays.items() if name.endswith(".kernel")]
    others = [values for name, values in arrays.items() if name.endswith((".shift", "sharpness"))]
    groups = [{"params": kernels, "weight_decay": _DECAY}, {"params": others, "weight_decay": 0.0}]
    optimizer = torch.optim.AdamW(groups, lr=_RATE)
    encoders = Encoders(torch=torch, classes=classes, arrays=arrays)
    steps = max(1, min(_MOST_LOOKS, _LOOKS_EACH * len(examples)) // _BATCH)
    looks = _looks(examples)
    for step in range(steps):
        for group in optimizer.param_groups:
            # 0.05 of all steps, in which the rate rises
            group["lr"] = _RATE * min((step + 1) / (0.05 * steps + 1), (1 + math.cos(math.pi * step / steps)) / 2)
        optimizer.zero_grad(set_to_none=True)
        for _ in range(_BATCH):
            example, rng = next(looks)
            (surprise(encoders, example.scene(rng), torch.from_numpy(example.has), rng) / _BATCH).backward()
        torch.nn.utils.clip_grad_norm_([*kernels, *others], 5.0)  # norm of a gradient: a longer one is shortened to it
        optimizer.step()
    return {name: np.asarray(values.detach().numpy(), dtype=np.float32) for name, values in arrays.items()}


def usual_shares(examples: Sequence[TrainingExample]) -> Floats:
    """Return mean and standard deviation of each class over known cells of the maps of examples, shape (2, K)."""
    sums = np.zeros((3, len(examples[0].has)))
    for example in examples:
        known = shares(example.mapped[:-1, example.mapped[-1] > 0])
        sums += example.has * np.stack([known.sum(axis=1), (known**2).sum(axis=1), np.full(len(known), known.shape[1])])
    mean, square = sums[:2] / np.maximum(sums[2], 1)
    # 0.01: least spread of a class: one that maps hardly hold would count without bounds
    return np.stack([mean, np.sqrt(np.maximum(square - mean**2, 0.01**2))]).astype(np.float32)


def _looks(examples: Sequence[TrainingExample]) -> Iterator[tuple[TrainingExample, np.random.Generator]]:
    round_of = 0
    while True:
        for example in sorted(examples, key=lambda one: seed_of(f"{one.name} {round_of}")):
            yield example, np.random.default_rng(seed_of(f"{example.name} {round_of} look"))
        round_of += 1


def surprise(encoders: Encoders, scene: Scene, has: Tensor, rng: np.random.Generator) -> Tensor:
    """Return the negative log-likelihood of the true pose among all places of a scene and some headings.

    The log-posterior is read linearly between cells and headings. The true heading lies anywhere among the others.
    """
    torch = encoders.torch
    seen = encoders.template(torch.from_numpy(np.ascontiguousarray(scene.view)))
    mapped = encoders.features(torch.from_numpy(np.ascontiguousarray(scene.mapped)), has)
    mapped = mapped[:, MARGIN:-MARGIN, MARGIN:-MARGIN]
    turn = float(rng.uniform(0.0, _HEADINGS - 1.0))
    step_deg = step_deg_of(scene.view.shape[1:], scene.cells_m)
    yaws_deg = (scene.yaw_deg + step_deg * (np.arange(_HEADINGS) - turn)).tolist()
    laid = turned(torch, seen, scene.cells_m, yaws_deg, step_m=scene.step_m)
    over, under = (transformed(torch, one, mapped.shape[-1]) for one in (laid, mapped))
    means, _ = agreement(torch, over, under, scene.places)
    logits = encoders.sharpness(known_m2(seen, scene.cells_m)) * means
    logs = torch.log_softmax(logits.ravel(), dim=0).reshape(logits.shape)
    at = (turn, *scene.place)
    first = [min(max(math.floor(one), 0), count - 2) for one, count in zip(at, logs.shape, strict=True)]
    shares = [np.array([1 - one + low, one - low]) for one, low in zip(at, first, strict=True)]
    weights = torch.from_numpy(np.einsum("a,b,c->abc", *shares).astype(np.float32))
    around = tuple(slice(low, low + 2) for low in first)
    return -(weights * logs[around]).sum()
