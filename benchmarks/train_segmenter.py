# SPDX-License-Identifier: Apache-2.0
"""Teach the network of `osm_unet` on drawn and real crops, and write the weights that ship; needs PyTorch and onnx.

    .venv/bin/pip install torch onnx
    .venv/bin/python benchmarks/train_segmenter.py --out out --name osm_unet_held_out
    .venv/bin/python benchmarks/train_segmenter.py --out out --name osm_unet \
      --real pardubice-ortho:0,1,0,0.8 banepa chateaugiron-ortho koeln-ortho

`--out` holds built regions. Crops are drawn from the maps of `--drawn` and cut out of the pictures over `--real`, as
`sasgeo_bench.sensing.crops` yields them. The state is kept in `--out`/segmenters/osm_unet every few
minutes, and the same command goes on from there. The same command gives the same weights on one machine and thread; a
run that was cut off, too. At the end NAME.onnx lies beside the state; `--ship` puts it where the plugins read theirs.
"""

import argparse
import math
import os
import shutil
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

os.environ.setdefault("OMP_NUM_THREADS", "1")

import numpy as np
import onnx
import torch
from onnx import helper, numpy_helper
from sasgeo_baselines.segmenters.osm_unet import CLASSES, WEIGHTS, OsmUNet
from torch import nn
from torch.nn import functional

from benchmarks.real_pictures import part_of
from benchmarks.segmenter_lessons import (
    CELL_PX,
    DRAWN,
    HELD,
    PART,
    PIXEL_M,
    REAL,
    SIDE_PX,
    Part,
    Teacher,
    batches,
    region_of,
    sources_of,
)
from sasgeo_bench.scoring.segmentation import PixelCounts
from sasgeo_bench.sensing.reference_imagery import region_views
from sasgeo_bench.sensing.segmentation import SILENT, calibration_of

WIDTHS: Final = (24, 40, 64, 96, 128)  # channels at cells of 1, 2, 4, 8 and 16 m
RISE: Final = 200  # steps in which it rises; then it falls as a cosine
DECAY: Final = 1e-3
SEEDS: Final = 1000  # parts that one seed has, at most
LEAST_CELLS: Final = 2000  # of a class in a step: fewer weigh less
HALF_FROM: Final = 16  # numbers of an array that is stored in half precision


@dataclass(frozen=True, kw_only=True)
class Recipe:
    """How a network is taught; `steps` are rounded up to parts, `rate` is that of learning at its highest."""

    steps: int = 5000
    batch: int = 4  # crops of a step
    rate: float = 2e-3
    begin: Path | None = None  # a kept state whose weights it begins with; None: random ones
    part: int = PART
    seed: int = 0


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


def loss_of(found: torch.Tensor, wanted: torch.Tensor, weights: torch.Tensor) -> torch.Tensor:
    """Return the sum over classes of the mean cross-entropy of their cells."""
    each = functional.binary_cross_entropy_with_logits(found, wanted, reduction="none") * weights
    return (each.sum(dim=(0, 2, 3)) / weights.sum(dim=(0, 2, 3)).clamp(min=LEAST_CELLS)).sum()


def calibrate(net: Net, weights: Path, given: Part, out: Path) -> None:
    """Scale and shift the log-odds of each class by labelled pixels of a picture that taught nothing (Platt 1999)."""
    segmenter, region = OsmUNet(weights), region_of(given.region, out)
    views = region_views(region, part_of(region, given.box), place=given.region, gsd_m=PIXEL_M, side_px=2 * SIDE_PX)
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


def train(sources: Sequence[Teacher], path: Path, recipe: Recipe) -> Net:
    """Teach a network, or go on with one; `path` keeps its state."""
    torch.manual_seed(recipe.seed)
    torch.set_num_threads(int(os.environ["OMP_NUM_THREADS"]))
    net = Net().to(memory_format=torch.channels_last)
    optimizer = torch.optim.AdamW(net.parameters(), lr=recipe.rate, weight_decay=DECAY)
    done, steps = 0, math.ceil(recipe.steps / recipe.part) * recipe.part
    if recipe.begin is not None and not path.exists():
        net.load_state_dict(torch.load(recipe.begin, weights_only=True)["net"])
    if path.exists():
        state = torch.load(path, weights_only=True)
        net.load_state_dict(state["net"])
        optimizer.load_state_dict(state["optimizer"])
        done = state["done"]
    began = time.perf_counter()
    net.train()
    while done < steps:
        total, part = 0.0, SEEDS * recipe.seed + done // recipe.part
        for arrays in batches(sources, part, recipe.batch, steps=recipe.part):
            planes, wanted, weights = map(torch.from_numpy, arrays)
            for group in optimizer.param_groups:
                group["lr"] = recipe.rate * min((done + 1) / RISE, 1) * (1 + math.cos(math.pi * done / steps)) / 2
            with torch.autocast("cpu", torch.bfloat16):
                found = net(planes.to(memory_format=torch.channels_last))
            loss = loss_of(found.float(), wanted, weights)
            optimizer.zero_grad(set_to_none=True)
            loss.backward()
            torch.nn.utils.clip_grad_norm_(net.parameters(), 5.0)
            optimizer.step()
            total += float(loss.detach())
            done += 1
        print(
            f"{done} of {steps} steps in {time.perf_counter() - began:.0f} s, loss {total / recipe.part:.3f}",
            flush=True,
        )
        torch.save(
            {"net": net.state_dict(), "optimizer": optimizer.state_dict(), "done": done}, path.with_suffix(".new")
        )
        path.with_suffix(".new").replace(path)
    return net


def main() -> None:
    """Teach, write, and put the weights in place if that is asked for."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("out"))
    parser.add_argument("--name", default="osm_unet_held_out", help="of the state and the weights")
    parser.add_argument("--drawn", nargs="*", default=DRAWN, help="regions whose maps are drawn")
    parser.add_argument(
        "--real",
        nargs="*",
        type=Part.parse,
        default=REAL,
        help="regions with pictures: NAME, or NAME:WEST,EAST,NORTH,SOUTH",
    )
    parser.add_argument("--drawn-share", type=float, default=0.3, help="of all crops")
    parser.add_argument(
        "--calibrate",
        type=lambda text: Part.parse(text) if text else None,
        default=HELD,
        help="part of a picture that taught nothing; empty: none",
    )
    parser.add_argument("--steps", type=int, default=Recipe.steps, help=f"rounded up to parts of {PART}")
    parser.add_argument("--batch", type=int, default=Recipe.batch, help="crops of a step")
    parser.add_argument("--rate", type=float, default=Recipe.rate, help="of learning, at its highest")
    parser.add_argument("--begin", type=Path, help="a kept state (*.pt) whose weights it begins with, else drawn ones")
    parser.add_argument("--ship", action="store_true", help="copy the weights to where the plugins read theirs")
    options = parser.parse_args()
    folder = options.out / "segmenters" / "osm_unet"
    folder.mkdir(parents=True, exist_ok=True)
    sources = sources_of(options.drawn, options.real, options.drawn_share, options.out)
    recipe = Recipe(steps=options.steps, batch=options.batch, rate=options.rate, begin=options.begin)
    net = train(sources, folder / f"{options.name}.pt", recipe)
    weights = folder / f"{options.name}.onnx"
    export(net, weights)
    if options.calibrate:
        calibrate(net, weights, options.calibrate, options.out)
        export(net, weights)
    print(f"{weights}: {weights.stat().st_size / 1e6:.2f} MB")
    if options.ship:
        shutil.copyfile(weights, WEIGHTS.with_name(weights.name))


if __name__ == "__main__":
    main()
