# SPDX-License-Identifier: Apache-2.0
"""Teach the network of `osm_unet` on drawn and real crops, and write the weights that ship; needs PyTorch and onnx.

    .venv/bin/pip install torch onnx
    .venv/bin/python benchmarks/train_segmenter.py --out out --name shipped --steps 4000

`--out` holds built regions. Crops are drawn from the maps of `--drawn` and cut out of the pictures over `--real`, as
`sasgeo_bench.sensing.crops` yields them. The state is kept in `--out`/segmenters/osm_unet every few
minutes, and the same command goes on from there. The same command gives the same weights on one machine and thread; a
run that was cut off, too. At the end NAME.onnx lies beside the state; `--ship` puts it where the plugin reads it.
"""

import argparse
import math
import os
import shutil
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

os.environ.setdefault("OMP_NUM_THREADS", "1")

import cv2
import numpy as np
import onnx
import shapely
import torch
from numpy.typing import NDArray
from onnx import helper, numpy_helper
from sasgeo_baselines.segmenters.osm_unet import CLASSES, WEIGHTS, OsmUNet, normalized
from scipy.special import expit
from torch import nn
from torch.nn import functional

import sasgeo_bench as sgb
from benchmarks.real_pictures import part_of
from sasgeo_bench.regions.evidence import PRESENT, UNKNOWN
from sasgeo_bench.scoring.segmentation import PixelCounts
from sasgeo_bench.sensing.crops import Crop, drawn_crops, real_crops
from sasgeo_bench.sensing.reference_imagery import region_views
from sasgeo_bench.sensing.segmentation import SILENT, calibration_of

WIDTHS: Final = (24, 40, 64, 96, 128)  # channels at cells of 1, 2, 4, 8 and 16 m
SIDE_PX: Final = 256
PIXEL_M: Final = 0.5
CELL_PX: Final = 2  # a side of the cells that the network answers
RISE: Final = 200  # steps in which it rises; then it falls as a cosine
DECAY: Final = 1e-3
PART: Final = 1000  # steps between which the state is kept, and of one seed
ZOOM: Final = 1.4
WHOLE: Final = (0.0, 1.0, 0.0, 1.0)  # of a picture: west, east, north, south
LEAST_CELLS: Final = 2000  # of a class in a step: fewer weigh less
EDGE: Final = 0.4  # weight of a cell at an edge: maps lie 1 to 3 m off
BARE: Final = 0.25  # of the absence of an area class where the map has nothing at all: nobody may have mapped it
AREAS: Final = frozenset({"green", "farmland", "parking", "bare"})
SHADED: Final = 0.15  # of real crops: steep valleys are half in the shade
HALF_FROM: Final = 16  # numbers of an array that is stored in half precision

# Maps that are drawn: one place at least of each train country of the split `world`, but those under pictures.
DRAWN: Final = (
    *("badhersfeld", "bayreuth-east", "berlinmitte", "brumadinho", "duitama", "dursunbey", "eskisehir", "gdansk"),
    *("hanoi", "hcmc", "kathmandu", "malabo", "moron", "pontadelgada", "porto", "rzeszow", "sanmartinorio", "saopaulo"),
    "trento",
)
REAL: Final = ("pardubice-ortho:0,1,0,0.8", "banepa")
HELD: Final = "pardubice-ortho:0,1,0.8,1"  # the south of Pardubice is kept back

Pixels = NDArray[np.uint8]
Planes = NDArray[np.float32]


class Block(nn.Sequential):
    """Two convolutions, each normalized over the batch."""

    def __init__(self, given: int, width: int) -> None:
        layers: list[nn.Module] = []
        for channels in (given, width):
            layers += [nn.Conv2d(channels, width, 3, padding=1, bias=False), nn.BatchNorm2d(width), nn.ReLU()]
        super().__init__(*layers)


class Net(nn.Module):
    """A U-Net whose first convolution halves rows and columns, and whose answer stays at those."""

    def __init__(self, widths: Sequence[int] = WIDTHS) -> None:
        super().__init__()
        self.stem = nn.Sequential(
            nn.Conv2d(3, widths[0], 4, stride=CELL_PX, padding=1, bias=False), nn.BatchNorm2d(widths[0]), nn.ReLU()
        )
        self.down = nn.ModuleList(Block(*pair) for pair in zip((widths[0], *widths[:-1]), widths, strict=True))
        at = widths[-1]
        self.up = nn.ModuleList()
        for width in reversed(widths[:-1]):
            self.up.append(Block(at + width, width))
            at = width
        self.head = nn.Conv2d(at, len(CLASSES), 1)

    def forward(self, planes: torch.Tensor) -> torch.Tensor:
        """Return the log-odds of each class, shape (N, classes, H / 2, W / 2)."""
        at = self.stem(planes)
        levels = []
        for number, block in enumerate(self.down):
            at = block(functional.max_pool2d(at, 2) if number else at)
            levels.append(at)
        for block, beside in zip(self.up, reversed(levels[:-1]), strict=True):
            at = block(torch.cat([functional.interpolate(at, scale_factor=2, mode="nearest"), beside], dim=1))
        return self.head(at)


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


@dataclass(frozen=True)
class Source:
    """Where crops come from: drawn of the maps of some regions, or cut out of one picture, within `box` of it.

    `share` is how often it is asked.
    """

    regions: tuple[sgb.Region, ...]
    share: float
    box: tuple[float, ...] | None = None  # None: drawn

    def crops(self, seed: int) -> Iterator[Crop]:
        """Return crops without end."""
        shape = {"seed": seed, "side_px": SIDE_PX, "pixel_m": PIXEL_M, "zoom": ZOOM}
        if self.box is None:
            return drawn_crops(self.regions, **shape)
        return real_crops(self.regions, **shape, bounds_m=part_of(self.regions[0], self.box))


def sources_of(drawn: Sequence[str], real: Sequence[str], drawn_share: float, out: Path) -> list[Source]:
    """Return sources: real ones share what is not drawn by the roots of their areas."""
    boxes = {
        name: tuple(map(float, box.split(","))) if box else WHOLE for name, _, box in (t.partition(":") for t in real)
    }
    regions = {name: region_of(name, out) for name in (*drawn, *boxes)}
    sizes = {name: math.sqrt(shapely.box(*part_of(regions[name], box)).area) for name, box in boxes.items()}
    left = 1 - (drawn_share if drawn and real else float(bool(drawn)))
    found = [Source((regions[name],), left * sizes[name] / sum(sizes.values()), box) for name, box in boxes.items()]
    if drawn:
        found.append(Source(tuple(regions[name] for name in drawn), 1 - left))
    return found


def batches(sources: Sequence[Source], part: int, size: int) -> Iterator[tuple[torch.Tensor, ...]]:
    """Yield planes, wanted shares and weights of each step of a part."""
    opened = [one.crops(part * len(sources) + number) for number, one in enumerate(sources)]
    shares = [one.share for one in sources]
    rng = np.random.default_rng([1, part])
    for _ in range(PART):
        parts = []
        for at in rng.choice(len(sources), size=size, p=shares):
            crop = next(opened[at])
            rgb = crop.rgb if sources[at].box is None else varied(crop.rgb, rng)
            parts.append((normalized(rgb), *lesson(crop)))
        yield tuple(torch.from_numpy(np.stack(planes)) for planes in zip(*parts, strict=True))


def loss_of(found: torch.Tensor, wanted: torch.Tensor, weights: torch.Tensor) -> torch.Tensor:
    """Return the sum over classes of the mean cross-entropy of their cells."""
    each = functional.binary_cross_entropy_with_logits(found, wanted, reduction="none") * weights
    return (each.sum(dim=(0, 2, 3)) / weights.sum(dim=(0, 2, 3)).clamp(min=LEAST_CELLS)).sum()


def calibrate(net: Net, weights: Path, region: sgb.Region, box: Sequence[float]) -> None:
    """Scale and shift the log-odds of each class by labelled pixels of a picture that taught nothing (Platt 1999)."""
    segmenter = OsmUNet(weights)
    views = region_views(region, part_of(region, box), place=region.manifest.id, gsd_m=PIXEL_M, side_px=2 * SIDE_PX)
    counts = [PixelCounts.of(view, segmenter.segment(view.image, learned=None), image="") for view in views]
    for number, name in enumerate(CLASSES):
        pixels = sum(one.of_class(name) for one in counts if name in one.classes)
        if not isinstance(pixels, int) and pixels[:, :SILENT].any(axis=1).all():
            scale, shift = calibration_of(pixels)
            print(f"{name}: log-odds times {scale:.2f}, {shift:+.2f}")
            with torch.no_grad():
                net.head.weight[number] *= scale
                net.head.bias[number] = net.head.bias[number] * scale + shift


def export(net: Net, path: Path) -> None:
    """Write a network as ONNX with its larger arrays in half precision, which OpenCV reads."""
    net.eval()
    torch.onnx.export(
        net,
        (torch.zeros(1, 3, SIDE_PX, SIDE_PX),),
        str(path),
        dynamo=False,
        opset_version=13,
        input_names=["picture"],
        output_names=["log_odds"],
        dynamic_axes={"picture": {2: "rows", 3: "cols"}, "log_odds": {2: "rows", 3: "cols"}},
    )
    model = onnx.load(path)
    graph, casts, halves = model.graph, [], []
    for array in list(graph.initializer):
        values = numpy_helper.to_array(array)
        if values.dtype == np.float32 and values.size > HALF_FROM:
            graph.initializer.remove(array)
            name = f"{array.name}.half"
            halves.append(numpy_helper.from_array(values.astype(np.float16), name))
            casts.append(helper.make_node("Cast", [name], [array.name], to=onnx.TensorProto.FLOAT))
    nodes = [*casts, *graph.node]
    del graph.node[:]
    graph.node.extend(nodes)
    graph.initializer.extend(halves)
    onnx.checker.check_model(model)
    onnx.save(model, path)


def train(sources: Sequence[Source], path: Path, given: argparse.Namespace) -> Net:
    """Teach a network, or go on with one; `path` keeps its state."""
    torch.manual_seed(0)
    torch.set_num_threads(int(os.environ["OMP_NUM_THREADS"]))
    net = Net().to(memory_format=torch.channels_last)
    optimizer = torch.optim.AdamW(net.parameters(), lr=given.rate, weight_decay=DECAY)
    done, steps = 0, math.ceil(given.steps / PART) * PART
    if given.begin is not None and not path.exists():
        net.load_state_dict(torch.load(given.begin, weights_only=True)["net"])
    if path.exists():
        state = torch.load(path, weights_only=True)
        net.load_state_dict(state["net"])
        optimizer.load_state_dict(state["optimizer"])
        done = state["done"]
    began = time.perf_counter()
    net.train()
    while done < steps:
        total = 0.0
        for planes, wanted, weights in batches(sources, done // PART, given.batch):
            for group in optimizer.param_groups:
                group["lr"] = given.rate * min((done + 1) / RISE, 1) * (1 + math.cos(math.pi * done / steps)) / 2
            with torch.autocast("cpu", torch.bfloat16):
                found = net(planes.to(memory_format=torch.channels_last))
            loss = loss_of(found.float(), wanted, weights)
            optimizer.zero_grad(set_to_none=True)
            loss.backward()
            torch.nn.utils.clip_grad_norm_(net.parameters(), 5.0)
            optimizer.step()
            total += float(loss.detach())
            done += 1
        print(f"{done} of {steps} steps in {time.perf_counter() - began:.0f} s, loss {total / PART:.3f}", flush=True)
        torch.save(
            {"net": net.state_dict(), "optimizer": optimizer.state_dict(), "done": done}, path.with_suffix(".new")
        )
        path.with_suffix(".new").replace(path)
    return net


def main() -> None:
    """Teach, write, and put the weights in place if that is asked for."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("out"))
    parser.add_argument("--name", default="osm_unet", help="of the state and the weights")
    parser.add_argument("--drawn", nargs="*", default=DRAWN, help="regions whose maps are drawn")
    parser.add_argument(
        "--real", nargs="*", default=REAL, help="regions with pictures: NAME, or NAME:WEST,EAST,NORTH,SOUTH"
    )
    parser.add_argument("--drawn-share", type=float, default=0.5, help="of all crops")
    parser.add_argument("--calibrate", default=HELD, help="part of a picture that taught nothing; empty: none")
    parser.add_argument("--steps", type=int, default=5000, help=f"rounded up to parts of {PART}")
    parser.add_argument("--batch", type=int, default=4, help="crops of a step")
    parser.add_argument("--rate", type=float, default=2e-3, help="of learning, at its highest")
    parser.add_argument("--begin", type=Path, help="a kept state (*.pt) whose weights it begins with, else drawn ones")
    parser.add_argument("--ship", action="store_true", help="copy the weights to where the plugin reads them")
    options = parser.parse_args()
    folder = options.out / "segmenters" / "osm_unet"
    folder.mkdir(parents=True, exist_ok=True)
    sources = sources_of(options.drawn, options.real, options.drawn_share, options.out)
    net = train(sources, folder / f"{options.name}.pt", options)
    weights = folder / f"{options.name}.onnx"
    export(net, weights)
    if options.calibrate:
        name, _, box = options.calibrate.partition(":")
        calibrate(net, weights, region_of(name, options.out), tuple(map(float, box.split(","))))
        export(net, weights)
    print(f"{weights}: {weights.stat().st_size / 1e6:.2f} MB")
    if options.ship:
        shutil.copyfile(weights, WEIGHTS)


def region_of(name: str, out: Path) -> sgb.Region:
    """Read a region; end with one line if it is not built."""
    if not (out / "regions" / name).exists():
        raise SystemExit(f"{name} is not built: sasgeo-bench build-region {name} --out {out}")
    return sgb.read_region(out / "regions" / name)


if __name__ == "__main__":
    main()
