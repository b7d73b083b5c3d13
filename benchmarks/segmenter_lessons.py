# SPDX-License-Identifier: Apache-2.0
"""What `osm_unet` is taught: crops of maps and pictures, as another sensor would see them, with weighed labels.

Needs no PyTorch; `train_segmenter.py` and `ablate_segmenter.py` teach by it.
"""

import argparse
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from types import ModuleType
from typing import Final, NamedTuple, Protocol, Self

import cv2
import numpy as np
import shapely
from numpy.typing import NDArray
from sasgeo_baselines.segmenters.osm_unet import CLASSES, normalized
from scipy.special import expit

import sasgeo_bench as sgb
from benchmarks.real_pictures import WHOLE, Box, box_of, part_of
from sasgeo_bench.regions.evidence import PRESENT, UNKNOWN
from sasgeo_bench.sensing.crops import Crop, drawn_crops, real_crops
from sasgeo_bench.sensing.rendering.wild import Ingredients

SIDE_PX: Final = 256
PIXEL_M: Final = 0.5
CELL_PX: Final = 2  # a side of the cells that the network answers
PART: Final = 1000  # steps between which the state is kept, and of one seed
ZOOM: Final = 1.4
EDGE: Final = 0.4  # weight of a cell at an edge: maps lie 1 to 3 m off
BARE: Final = 0.25  # of the absence of an area class where the map has nothing at all: nobody may have mapped it
AREAS: Final = frozenset({"green", "farmland", "parking", "bare"})
SHADED: Final = 0.15  # of real crops: steep valleys are half in the shade

Pixels = NDArray[np.uint8]
Planes = NDArray[np.float32]


class Part(NamedTuple):
    """A part of the picture over a region."""

    region: str
    box: Box = WHOLE

    @classmethod
    def parse(cls, text: str) -> Self:
        """Read NAME or NAME:WEST,EAST,NORTH,SOUTH."""
        name, colon, numbers = text.partition(":")
        try:
            return cls(_named(name), box_of(numbers) if colon else WHOLE)
        except argparse.ArgumentTypeError as error:
            raise argparse.ArgumentTypeError(
                f"{text!r} is no part of a picture: give NAME or NAME:WEST,EAST,NORTH,SOUTH, fractions from 0 to 1"
            ) from error

    def __str__(self) -> str:
        numbers = ",".join(f"{at:g}" for at in self.box)
        return self.region if self.box == Part(self.region).box else f"{self.region}:{numbers}"


def _named(name: str) -> str:
    if not name:
        raise argparse.ArgumentTypeError("a part of a picture has a name")
    return name


# Maps that are drawn: one place at least of each train country of the split `world`, but those under pictures.
DRAWN: Final = (
    *("badhersfeld", "bayreuth-east", "berlinmitte", "brumadinho", "duitama", "dursunbey", "eskisehir", "gdansk"),
    *("hanoi", "hcmc", "kathmandu", "malabo", "moron", "pontadelgada", "porto", "rzeszow", "sanmartinorio", "saopaulo"),
    "trento",
)
REAL: Final = (Part("pardubice-ortho", (0.0, 1.0, 0.0, 0.8)), Part("banepa"))
HELD: Final = Part("pardubice-ortho", (0.0, 1.0, 0.8, 1.0))  # the south of Pardubice is kept back


def lesson(crop: Crop) -> tuple[Planes, Planes]:
    """Return the share of each cell that a class covers, and its weight, both of shape (classes, H / 2, W / 2)."""
    side = crop.rgb.shape[0] // CELL_PX
    at = dict(zip(crop.classes, crop.labels, strict=True))
    is_known = shares((crop.labels != UNKNOWN).all(axis=0), side) > 0.99  # all of a cell
    nothing = shares((crop.labels != PRESENT).all(axis=0), side)
    wanted, weights = (np.zeros((len(CLASSES), side, side), dtype=np.float32) for _ in range(2))
    for number, name in enumerate(CLASSES):
        if name not in at:
            continue
        share = shares(at[name] == PRESENT, side)
        around = cv2.blur(share, (3, 3))
        weight = np.where((around > 0.05) & (around < 0.95), EDGE, 1.0)  # an edge runs through a neighbour
        if name in AREAS:
            weight = np.where(share == 0, weight * (1 - (1 - BARE) * nothing), weight)
        if name == "water" and "waterway" in at:  # a stream that is mapped as a line may be seen or not
            weight = np.where((share == 0) & (shares(at["waterway"] == PRESENT, side) > 0), 0.0, weight)
        wanted[number], weights[number] = share, weight * is_known
    return wanted, weights


def shares(mask: NDArray[np.bool_], side: int) -> Planes:
    """Return the marked share of each cell."""
    return np.asarray(cv2.resize(mask.astype(np.float32), (side, side), interpolation=cv2.INTER_AREA))


def varied(rgb: Pixels, rng: np.random.Generator) -> Pixels:
    """Return a picture as another sensor would have taken it: coarser, sharper, in other colours, noisy, packed."""
    seen = rgb.astype(np.float32) / 255
    side = seen.shape[0]
    if rng.random() < 0.6:
        fewer = max(32, int(side / rng.uniform(1, 2.6)))
        how = cv2.INTER_LINEAR if rng.random() < 0.5 else cv2.INTER_CUBIC
        seen = cv2.resize(
            cv2.resize(seen, (fewer, fewer), interpolation=cv2.INTER_AREA), (side, side), interpolation=how
        )
    if rng.random() < 0.2:
        seen = seen + rng.uniform(0.3, 1.2) * (seen - cv2.GaussianBlur(seen, (0, 0), 1.2))
    seen = np.clip(seen, 0, 1) ** np.exp(rng.normal(0, 0.25))
    mixed = np.eye(3) + rng.normal(0, 0.12, (3, 3))
    if rng.random() < 0.15:
        grey = rng.uniform(0.3, 1)
        mixed = mixed * (1 - grey) + grey / 3
    seen = seen @ mixed.T.astype(np.float32)
    if rng.random() < 0.1:
        seen = seen[..., rng.permutation(3)]
    seen = seen * np.exp(rng.normal(0, 0.15, 3)) + rng.normal(0, 0.05, 3)
    if rng.random() < 0.5:
        seen = seen + rng.normal(0, rng.uniform(0, 0.05), seen.shape)
    if rng.random() < 0.15:
        axis, slopes = np.linspace(-1, 1, side), rng.normal(0, 0.15, 2)
        seen = seen * (1 + slopes[0] * axis[:, None, None] + slopes[1] * axis[None, :, None])
    if rng.random() < SHADED:
        seen = seen * (1 - shade(side, rng)[..., None] * rng.uniform((0.4, 0.35, 0.2), (0.8, 0.75, 0.6)))
    found = np.asarray(np.clip(seen, 0, 1) * 255, dtype=np.uint8)
    if rng.random() < 0.4:
        _, packed = cv2.imencode(".jpg", found, [cv2.IMWRITE_JPEG_QUALITY, int(rng.integers(25, 90))])
        found = np.asarray(cv2.imdecode(packed, cv2.IMREAD_COLOR), dtype=np.uint8)
    return found


def shade(side: int, rng: np.random.Generator) -> Planes:
    """Return how much the shade of a slope or a tower covers each pixel, 0 to 1, shape (side, side)."""
    axis, turn = np.linspace(-1, 1, side, dtype=np.float32), rng.uniform(0, 2 * np.pi)
    ragged = cv2.resize(rng.normal(0, 0.15, (9, 9)).astype(np.float32), (side, side), interpolation=cv2.INTER_CUBIC)
    beyond = np.cos(turn) * axis[None] + np.sin(turn) * axis[:, None] + ragged - rng.uniform(-0.7, 0.7)
    return np.asarray(expit(beyond / rng.uniform(0.01, 0.1)), dtype=np.float32)


class Teacher(Protocol):
    """Anything that crops come from."""

    @property
    def share(self) -> float:
        """Return how often it is asked, of all."""
        ...

    @property
    def is_drawn(self) -> bool:
        """Return whether its crops are drawn: they need no other sensor."""
        ...

    def crops(self, seed: int) -> Iterator[Crop]:
        """Return crops without end."""
        ...


@dataclass(frozen=True)
class Source:
    """Where crops come from: drawn of the maps of some regions, or cut out of one picture, within `box` of it.

    `share` is how often it is asked, `look` what goes into drawn pictures.
    """

    regions: tuple[sgb.Region, ...]
    share: float
    box: Box | None = None  # None: drawn
    look: Ingredients | None = None  # None: all

    @property
    def is_drawn(self) -> bool:
        """Return whether its crops are drawn: they need no other sensor."""
        return self.box is None

    def crops(self, seed: int) -> Iterator[Crop]:
        """Return crops without end."""
        shape = {"seed": seed, "side_px": SIDE_PX, "pixel_m": PIXEL_M, "zoom": ZOOM}
        if self.box is None:
            return drawn_crops(self.regions, **shape, ingredients=self.look)
        return real_crops(self.regions, **shape, bounds_m=part_of(self.regions[0], self.box))


def sources_of(
    drawn: Sequence[str], real: Sequence[Part], drawn_share: float, out: Path, *, look: Ingredients | None = None
) -> list[Source]:
    """Return sources: real ones share what is not drawn by the roots of their areas."""
    regions = {name: region_of(name, out) for name in (*drawn, *(part.region for part in real))}
    sizes = [math.sqrt(shapely.box(*part_of(regions[part.region], part.box)).area) for part in real]
    left = 1 - (drawn_share if drawn and real else float(bool(drawn)))
    found = [
        Source((regions[part.region],), left * size / sum(sizes), part.box)
        for part, size in zip(real, sizes, strict=True)
    ]
    if drawn:
        found.append(Source(tuple(regions[name] for name in drawn), 1 - left, look=look))
    return found


def batches(
    sources: Sequence[Teacher], part: int, size: int, *, steps: int = PART
) -> Iterator[tuple[Planes, Planes, Planes]]:
    """Yield planes, wanted shares and weights of each step of a part, stacked over `size` crops."""
    opened = [one.crops(part * len(sources) + number) for number, one in enumerate(sources)]
    shares = [one.share for one in sources]
    rng = np.random.default_rng([1, part])
    for _ in range(steps):
        parts = []
        for at in rng.choice(len(sources), size=size, p=shares):
            crop = next(opened[at])
            rgb = crop.rgb if sources[at].is_drawn else varied(crop.rgb, rng)
            parts.append((normalized(rgb), *lesson(crop)))
        planes, wanted, weights = (np.stack(some) for some in zip(*parts, strict=True))
        yield planes, wanted, weights


def trainer() -> ModuleType:
    """Return `train_segmenter`; end with one line where what it needs is missing."""
    try:
        return import_module("benchmarks.train_segmenter")
    except ModuleNotFoundError as error:
        raise SystemExit(f"{error.name} is missing, which teaching needs: .venv/bin/pip install torch onnx") from error


def region_of(name: str, out: Path) -> sgb.Region:
    """Read a region; end with one line if it is not built."""
    if not (out / "regions" / name).exists():
        raise SystemExit(f"{name} is not built: sasgeo-bench build-region {name} --out {out}")
    return sgb.read_region(out / "regions" / name)
