# SPDX-License-Identifier: Apache-2.0
"""`deep_retrieval`: descriptors of a convolutional network, pooled part by part, against those of the imagery."""

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, Self

import cv2
import numpy as np
from numpy.typing import NDArray

import sasgeo_bench as sgb
from sasgeo_baselines.image.dense import (
    MOST_PLACES,
    Field,
    answer_candidates,
    answer_places,
    bounds_of,
    disc_of,
    turns_for,
)
from sasgeo_baselines.image.orb_vlad import centred
from sasgeo_baselines.image.view_image import LIMITS, PICTURE, Ortho, ViewImage, side_of, view_image
from sasgeo_baselines.segmenters.features import ColourBalance, lab_planes
from sasgeo_baselines.segmenters.network import MULTIPLE, card_with, encoded, input_planes, read_encoder, torch_module

if TYPE_CHECKING:
    from torch import Tensor

Planes = NDArray[np.float32]
Known = NDArray[np.bool_]

PIXEL_M: Final = 0.5
CELL_PX: Final = 8  # of the finer one
BLOCK_PX: Final = 16  # between the middles of two descriptors
PART_BLOCKS: Final = 3  # between two parts of a view
PARTS: Final = 64  # of a descriptor, its principal components
POWER: Final = 3.0  # of generalized means
_TILE_PX: Final = 256
_MARGIN_PX: Final = 64
_MOST_TAUGHT: Final = 20_000
_NOTHING: Final = 1e-6


@dataclass(frozen=True, kw_only=True)
class Encoder:
    """Encoder of a `unet`: what it sees of pictures with pixels of 0.5 m, as descriptors of blocks of 8 m."""

    torch: Any
    arrays: dict[str, "Tensor"]

    @classmethod
    def of(cls, path: Path, *, name: str) -> Self:
        """Read the weights of a file for the matcher `name`; raise one line if they, or PyTorch, are missing."""
        torch = torch_module(name)
        return cls(torch=torch, arrays={key: torch.from_numpy(values) for key, values in read_encoder(path).items()})

    def blocks(self, rgb: NDArray[np.uint8], is_known: Known, balance: ColourBalance) -> Planes:
        """Return the generalized means around every block, shape (rows, cols, channels); 0 where little is known.

        Rows and columns that do not fill a block are filled up with what is not known.
        """
        rows, cols = is_known.shape
        more = ((0, -rows % MULTIPLE), (0, -cols % MULTIPLE))
        # 1 pixel: less noise, which whitening would make much of
        soft = np.asarray(cv2.GaussianBlur(rgb, (0, 0), 1.0), dtype=np.uint8)
        planes = np.where(is_known, input_planes(soft, balance), 0).astype(np.float32)
        with self.torch.inference_mode():
            given = self.torch.from_numpy(np.pad(planes, ((0, 0), *more))[None])
            levels = [np.asarray(one[0].numpy()) for one in encoded(self.torch, self.arrays, given)]
        known = np.pad(is_known, more).astype(np.float32)
        weight = cv2.resize(known, (known.shape[1] // CELL_PX, known.shape[0] // CELL_PX), interpolation=cv2.INTER_AREA)
        # Of the encoder, whose cells are 4 and 8 m
        pooled = [_generalized_means(levels[level], np.asarray(weight, dtype=np.float32)) for level in (2, 3)]
        return np.concatenate(pooled, axis=2)[: -(-rows // BLOCK_PX), : -(-cols // BLOCK_PX)]


def _generalized_means(channels: Planes, weight: Planes) -> Planes:
    """Return unit vectors of means around every block, shape (rows, cols, C), of channels of one level."""
    sigma = 10.0 / (CELL_PX * PIXEL_M)  # m: standard deviation of the Gaussian that a descriptor pools over
    size = (weight.shape[1] * CELL_PX // BLOCK_PX, weight.shape[0] * CELL_PX // BLOCK_PX)
    whole = _pooled(weight, sigma, size)
    found = np.empty((*whole.shape, len(channels)), dtype=np.float32)
    for at, channel in enumerate(channels):
        fine = cv2.resize(channel, weight.shape[::-1], interpolation=cv2.INTER_NEAREST)
        found[:, :, at] = _pooled(np.asarray(fine, dtype=np.float32) ** POWER * weight, sigma, size)
    means = (found / np.maximum(whole, _NOTHING)[:, :, None]) ** (1 / POWER)
    return np.where((whole >= 0.5)[:, :, None], unit(means.astype(np.float32)), 0).astype(np.float32)


def _pooled(plane: Planes, sigma: float, size: tuple[int, int]) -> Planes:
    soft = cv2.GaussianBlur(plane, (0, 0), sigma, borderType=cv2.BORDER_REFLECT)
    return np.asarray(cv2.resize(soft, size, interpolation=cv2.INTER_AREA), dtype=np.float32)


def unit(vectors: Planes) -> Planes:
    """Return vectors of length 1 along the last axis; 0 stays 0.

    >>> unit(np.array([[3.0, 4.0], [0.0, 0.0]], dtype=np.float32)).round(2).tolist()
    [[0.6000000238418579, 0.800000011920929], [0.0, 0.0]]
    """
    length = np.linalg.norm(vectors, axis=-1, keepdims=True)
    return np.asarray(vectors / np.maximum(length, _NOTHING), dtype=np.float32)


@dataclass(frozen=True, kw_only=True)
class Whitening:
    """Mean of the descriptors of a map, and directions, shape (channels, PARTS), along which they vary evenly."""

    mean: Planes
    directions: Planes

    @classmethod
    def of(cls, descriptors: Planes, rng: np.random.Generator) -> Self:
        """Measure descriptors, shape (N, channels)."""
        some = descriptors
        if len(some) > _MOST_TAUGHT:
            some = some[np.sort(rng.choice(len(some), _MOST_TAUGHT, replace=False))]
        mean = some.mean(axis=0, dtype=np.float64)
        variances, directions = np.linalg.eigh(np.cov((some - mean).T))
        chosen = directions[:, ::-1][:, :PARTS] / np.sqrt(np.maximum(variances[::-1][:PARTS], _NOTHING))
        return cls(mean=mean.astype(np.float32), directions=chosen.astype(np.float32))

    def short(self, descriptors: Planes) -> Planes:
        """Return descriptors, shape (..., channels), as unit vectors of shape (..., PARTS); 0 stays 0."""
        found = unit(np.asarray((descriptors - self.mean) @ self.directions, dtype=np.float32))
        found[~descriptors.any(axis=-1)] = 0
        return found


class DeepRetrieval:
    """Tile, around every block of 8 m, whose parts have the descriptors of the parts of the view.

    Name the file of the weights in a class of your own (docs/howto/imagery.md): a learned text of `unet`, or an `.npz`.

    >>> DeepRetrieval().card.needs
    ('image', 'imagery')
    """

    card = sgb.MatcherCard(
        name="deep_retrieval",
        version="1",
        title="Pooled descriptors of a convolutional network over tiles of imagery",
        source="Generalized means and whitening: Radenovic et al., TPAMI 41, 2019",
        ours=(
            f"{PICTURE}; encoder of `unet` on smoothed pixels of 0.5 m, its levels of 4 and 8 m; generalized means "
            "(p = 3) over Gaussians of 10 m at every 8 m, 64 whitened principal components of the searched map's own; "
            "the mean of the cosines of all parts, 24 m apart, of the view turned to each heading; the place is the "
            "centroid of the scores within 24 m"
        ),
        licence="Apache-2.0",
        tracks=("retrieval", "localization"),
        needs=("image", "imagery"),
        limits=(
            "Needs the extra [torch], and a class of your own that names a file with the weights of the encoder: "
            f"`prepare` fails without; scale 1; {LIMITS}"
        ),
    )
    weights: Path | None = None

    def __init__(self) -> None:
        self.card = card_with(type(self).card, self.weights)
        self._encoder: Encoder | None = None
        self._whitening: Whitening | None = None

    def prepare(self, region: sgb.Region, learned: str | None) -> None:
        """Describe the imagery block by block; raise one line if no file of weights is named."""
        del learned
        self._whitening = None
        if self.weights is None:
            raise ValueError(
                f"{self.card.name} has no weights: name their file in a class of your own, "
                "class Mine(DeepRetrieval): weights = Path(...) (docs/howto/imagery.md)"
            )
        self._encoder = Encoder.of(self.weights, name=self.card.name)
        ortho = Ortho.of(region, gsd_m=PIXEL_M)
        if ortho is None or not ortho.is_known.any():
            return
        self._grid = ortho.grid.coarsen(BLOCK_PX)
        blocks = described(self._encoder, ortho)
        known = blocks[blocks.any(axis=2)]
        if len(known) > PARTS:
            self._whitening = Whitening.of(known, np.random.default_rng(7))
            self._blocks = self._whitening.short(blocks).astype(np.float16)

    def match(self, query: sgb.Query, *, top_k: int) -> sgb.Match:
        """Return the most similar tiles, or rank the candidates by the most similar one near each."""
        seen_image = view_image(query, gsd_m=PIXEL_M)
        if self._whitening is None or seen_image is None:
            return sgb.WITHHELD
        field = self._field(query, seen_image)
        if field is None:
            return sgb.WITHHELD
        diagnostics = {"peak": field.peak(), "seen_share": float(seen_image.is_seen.mean())}
        if query.track == "retrieval":
            return answer_candidates(query, field.near(query.candidates), top_k=top_k, diagnostics=diagnostics)
        most, disc = min(top_k, MOST_PLACES), disc_of(query.prior)
        modes = [centred(mode, field, disc) for mode in field.best(disc, most=most + 1)]
        return answer_places(modes, top_k=most, diagnostics=diagnostics)

    def _field(self, query: sgb.Query, seen_image: ViewImage) -> Field | None:
        """Return the best score of every block that the query leaves open, over all headings; None if there is none."""
        top, left, bottom, right = bounds_of(query, self._grid)
        if top >= bottom or left >= right:
            return None
        reach_m = side_of(query) / 2
        # 16 m at the edge of a view, between two headings
        headings = dict.fromkeys(turn.yaw_deg for turn in turns_for(query, reach_m=reach_m, step_m=16.0))
        turns = tuple(sgb.Pose(easting_m=0.0, northing_m=0.0, yaw_deg=yaw_deg) for yaw_deg in headings)
        best = np.full((bottom - top, right - left), -np.inf, dtype=np.float32)
        which = np.zeros(best.shape, dtype=np.int32)
        for at, turn in enumerate(turns):
            scores = self._scores(self._parts(seen_image, turn, reach_m), (top, left, bottom, right))
            better = scores > best
            best[better], which[better] = scores[better], at
        is_known = self._blocks[top:bottom, left:right].any(axis=2)
        grid = self._grid.window(top, left, bottom - top, right - left)
        return Field(grid=grid, scores=np.where(is_known, best, -np.inf).astype(np.float32), which=which, turns=turns)

    def _parts(self, seen_image: ViewImage, turn: sgb.Pose, reach_m: float) -> Planes:
        """Return the descriptors of the blocks of a view turned north up, shape (n, n, PARTS), n odd."""
        block_m = BLOCK_PX * PIXEL_M
        size = 2 * int(reach_m / block_m) + 1
        view = seen_image.turned(turn, size * BLOCK_PX)
        balance = ColourBalance.of(lab_planes(view.rgb[view.is_seen][None]))
        assert self._encoder is not None  # noqa: S101 - prepare() made both
        assert self._whitening is not None  # noqa: S101
        return self._whitening.short(self._encoder.blocks(view.rgb, view.is_seen, balance))

    def _scores(self, parts: Planes, bounds: tuple[int, int, int, int]) -> Planes:
        """Return the mean cosine of the parts of a view and those of the tile around each block of `bounds`."""
        top, left, bottom, right = bounds
        middle = len(parts) // 2
        # 12 m: a part lies so far within a view
        reach = int(max(middle - 12.0 / (BLOCK_PX * PIXEL_M), 0)) // PART_BLOCKS
        steps = [PART_BLOCKS * at for at in range(-reach, reach + 1)]
        total = np.zeros((bottom - top, right - left), dtype=np.float32)
        count = 0
        for down, across in ((down, across) for down in steps for across in steps):
            part = parts[middle + down, middle + across]
            if part.any():
                count += 1
                total += _shifted(self._blocks, (top + down, left + across), total.shape).astype(np.float32) @ part
        return np.asarray(total / max(count, 1), dtype=np.float32)


def described(encoder: Encoder, ortho: Ortho) -> Planes:
    """Return the descriptors of all blocks of the imagery of a map, shape (rows, cols, channels), half precision."""
    some = ortho.rgb[ortho.is_known]
    balance = ColourBalance.of(lab_planes(some[None, :: max(1, len(some) // _MOST_TAUGHT)]))
    rows, cols = (-(-side // BLOCK_PX) for side in ortho.is_known.shape)
    found: Planes | None = None
    for row, col, part in ortho.grid.windows(_TILE_PX):
        top, left = max(row - _MARGIN_PX, 0), max(col - _MARGIN_PX, 0)
        cut = np.s_[top : row + _TILE_PX + _MARGIN_PX, left : col + _TILE_PX + _MARGIN_PX]
        blocks = encoder.blocks(ortho.rgb[cut], ortho.is_known[cut], balance)
        if found is None:
            found = np.zeros((rows, cols, blocks.shape[2]), dtype=np.float16)
        at = (row // BLOCK_PX, col // BLOCK_PX)
        size = (-(-part.rows // BLOCK_PX), -(-part.cols // BLOCK_PX))
        inner = np.s_[(row - top) // BLOCK_PX :, (col - left) // BLOCK_PX :]
        found[at[0] : at[0] + size[0], at[1] : at[1] + size[1]] = blocks[inner][: size[0], : size[1]]
    assert found is not None  # noqa: S101 - a map has a tile at least
    return found


def _shifted(blocks: NDArray[np.float16], start: tuple[int, int], shape: tuple[int, int]) -> NDArray[np.float16]:
    """Return a window of blocks, 0 beyond them."""
    found = np.zeros((*shape, blocks.shape[2]), dtype=np.float16)
    (top, left), (rows, cols) = start, shape
    inside = blocks[max(top, 0) : max(top + rows, 0), max(left, 0) : max(left + cols, 0)]
    down, across = max(-top, 0), max(-left, 0)
    found[down : down + inside.shape[0], across : across + inside.shape[1]] = inside
    return found
