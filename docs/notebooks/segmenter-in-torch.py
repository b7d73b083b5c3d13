# ---
# jupyter:
#   # SPDX-License-Identifier: Apache-2.0
#   kernelspec: {display_name: Python 3, language: python, name: python3}
# ---

# %% [markdown]
# # A segmenter in PyTorch
#
# A matcher needs evidence: where in a picture are roads, houses, water? This notebook paints aerial pictures of two
# synthetic towns, trains a small network on them, and asks it about a third town that it never saw, with other roofs,
# soils and walls. It takes a minute or two on two cores without a GPU, and needs the extra `[torch]`.

# %%
import hashlib

import matplotlib.pyplot as plt
import numpy as np
import pandas as pd
import torch

import sasgeo_bench as sgb

torch.manual_seed(0)
torch.set_num_threads(1)  # threads of small networks wait for each other where a machine is busy
CLASSES = ("building", "road")
SIDE_PX, HEIGHT_M = 256, 111.0  # half a metre a pixel, straight down

# %% [markdown]
# ## Pictures with labels
#
# A scene is painted from the features of a region, and any camera can take a picture of it. `render_labelled` gives the
# picture and, for each pixel, the classes of what its ray meets. Palettes of training and of test share no material.

# %%
names = ("town-grid", "town-suburb", "town-riverside")
towns = {name: sgb.read_region(folder) for name, folder in zip(names, sgb.build_region(list(names)), strict=True)}
lens = sgb.Intrinsics.from_field_of_view(horizontal_deg=60.0, width_px=SIDE_PX, height_px=SIDE_PX)


def picture_of(name: str, number: int, family: str) -> sgb.LabelledImage:
    """Return a picture of a town from a place, a heading and a light that follow from its name and number."""
    rng = np.random.default_rng(int(hashlib.sha256(f"{name}/{number}".encode()).hexdigest()[:12], 16))
    region = towns[name]
    west, south, east, north = region.grid.bounds_m
    at = (float(rng.uniform(west + 120, east - 120)), float(rng.uniform(south + 120, north - 120)))
    window = sgb.Grid.around(*at, size_m=(200.0, 200.0), cell_size_m=0.5, epsg=region.grid.epsg)
    scene = sgb.make_scene(region.features, region.classes, region.coverage, place=name, window=window, family=family)
    turned = {"height_m": HEIGHT_M, "yaw_deg": float(rng.uniform(0, 360))}
    camera = sgb.Camera.pointed(intrinsics=lens, east_m=at[0], north_m=at[1], **turned)
    rgb, labels = sgb.render_labelled(scene, camera, sgb.draw_conditions(rng, season="summer"), rng)
    believed = sgb.Camera.pointed(intrinsics=lens, east_m=0.0, north_m=0.0, height_m=HEIGHT_M, yaw_deg=0.0)
    building, *roads = (labels[region.classes.index(one)] for one in ("building", "road_major", "road_minor"))
    road = np.where((roads[0] == sgb.PRESENT) | (roads[1] == sgb.PRESENT), sgb.PRESENT, np.maximum(*roads))
    return sgb.LabelledImage(
        image=sgb.AerialImage(rgb=rgb, camera=believed),
        classes=CLASSES,
        labels=np.stack([building, road]).astype(np.uint8),
        place=name,
    )


seen = [picture_of(name, number, "train") for name in ("town-grid", "town-suburb") for number in range(12)]
familiar, unseen = ([picture_of("town-riverside", number, look) for number in range(8)] for look in ("train", "test"))
print(f"{len(seen)} pictures to learn from; {len(unseen)} of another town to be asked about, in each of two looks")

# %%
colours = {"road": "#0072b2", "building": "#d55e00"}


def over(rgb: np.ndarray, planes: np.ndarray) -> np.ndarray:
    """Return a picture in grey with classes in their colours, the later ones on top."""
    found = np.repeat(rgb.mean(axis=2, keepdims=True), 3, axis=2) / 255
    for name, text in colours.items():
        colour = np.array([int(text[at : at + 2], 16) / 255 for at in (1, 3, 5)])
        found[planes[CLASSES.index(name)]] = 0.35 * found[planes[CLASSES.index(name)]] + 0.65 * colour
    return found


_, charts = plt.subplots(2, 4, figsize=(11, 5.6), layout="constrained")
for column, one in zip(charts.T, (seen[0], seen[12], unseen[0], unseen[1]), strict=True):
    column[0].imshow(one.image.rgb)
    column[1].imshow(over(one.image.rgb, one.labels == sgb.PRESENT))
    column[0].set_title(one.place, fontsize=9)
for chart in charts.flat:
    chart.set(xticks=[], yticks=[])

# %% [markdown]
# ## A dataset
#
# `PictureDataset` cuts crops with their masks. A crop follows from its index and a seed, whichever worker makes it.

# %%
crops = sgb.PictureDataset(seen, crop_px=80, crops_each=160)
batches = torch.utils.data.DataLoader(
    crops, batch_size=8, shuffle=True, generator=torch.Generator().manual_seed(0), num_workers=0
)
batch = next(iter(batches))
print(len(crops), "crops;", "a batch:", tuple(batch["picture"].shape), tuple(batch["mask"].shape))

# %% [markdown]
# ## Two networks
#
# One sees colours alone, pixel by pixel. The other is a small U-Net and sees what lies around. Each gives the log-odds
# of every class, since classes overlap. Pixels that nobody has looked at are left out of the loss.


# %%
def block(inputs: int, outputs: int) -> torch.nn.Sequential:
    """Return two convolutions with normalization."""
    layers = []
    for width in (inputs, outputs):
        layers += [torch.nn.Conv2d(width, outputs, 3, padding=1), torch.nn.GroupNorm(4, outputs), torch.nn.ReLU()]
    return torch.nn.Sequential(*layers)


class SmallUNet(torch.nn.Module):
    """Three levels; the finest is half the picture's resolution, 1 m."""

    def __init__(self) -> None:
        super().__init__()
        self.down = torch.nn.ModuleList([block(12, 24), block(24, 48), block(48, 96)])
        self.up = torch.nn.ModuleList([block(96 + 48, 48), block(48 + 24, 24)])
        self.head = torch.nn.Conv2d(24, 4 * len(CLASSES), 1)
        torch.nn.init.constant_(self.head.bias, -2.0)  # both classes are rare

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        """Return log-odds, shape (B, C, H, W), of pictures of shape (B, 3, H, W)."""
        x, kept = torch.nn.functional.pixel_unshuffle(x, 2), []
        for number, down in enumerate(self.down):
            x = down(torch.nn.functional.max_pool2d(x, 2) if number else x)
            kept.append(x)
        for up, skip in zip(self.up, (kept[1], kept[0]), strict=True):
            x = up(torch.cat((torch.nn.functional.interpolate(x, scale_factor=2), skip), dim=1))
        return torch.nn.functional.pixel_shuffle(self.head(x), 2)


def standardized(rgb: torch.Tensor) -> torch.Tensor:
    """Return pictures with zero mean and unit deviation in each band, whatever the light."""
    x = rgb.float()
    return (x - x.mean(dim=(2, 3), keepdim=True)) / (x.std(dim=(2, 3), keepdim=True) + 1)


def train(network: torch.nn.Module, steps: int) -> list[float]:
    """Minimize the cross-entropy of what is labelled; return the loss of each step."""
    optimizer = torch.optim.AdamW(network.parameters(), lr=3e-3)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimizer, 6e-3, total_steps=steps)
    losses = []
    for _, one in zip(range(steps), batches, strict=False):
        known, truth = one["mask"] != sgb.UNKNOWN, (one["mask"] == sgb.PRESENT).float()
        odds = network(standardized(one["picture"]))
        each = torch.nn.functional.binary_cross_entropy_with_logits(odds, truth, reduction="none")
        loss = (each * known).sum() / known.sum()
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        schedule.step()
        losses.append(loss.item())
    return losses


networks = {
    "colours alone": torch.nn.Sequential(
        torch.nn.Conv2d(3, 32, 1),
        torch.nn.ReLU(),
        torch.nn.Conv2d(32, 32, 1),
        torch.nn.ReLU(),
        torch.nn.Conv2d(32, len(CLASSES), 1),
    ),
    "small U-Net": SmallUNet(),
}
_, chart = plt.subplots(figsize=(7, 3), layout="constrained")
for name, network in networks.items():
    losses = train(network, steps=400)
    smooth = np.convolve(losses, np.ones(20) / 20, mode="valid")
    chart.plot(
        np.arange(len(smooth)) + 20, smooth, label=f"{name}, {sum(p.numel() for p in network.parameters()):,} weights"
    )
chart.set(xlabel="step (8 crops)", ylabel="cross-entropy, mean of 20", ylim=(0, None))
_ = chart.legend()

# %% [markdown]
# ## The town that it never saw
#
# Intersection over union of each class, over all pictures together: 1 is perfect. First on the pictures it learned
# from; then on the other town in the same materials; then with roofs, soils and walls that it never saw either. What is
# lost between the columns is what a figure from the training pictures would hide.


# %%
def chances(network: torch.nn.Module, one: sgb.LabelledImage) -> np.ndarray:
    """Return the probability of each class at each pixel."""
    picture = torch.from_numpy(one.image.rgb.transpose(2, 0, 1).copy())[None]
    with torch.inference_mode():
        return torch.sigmoid(network(standardized(picture)))[0].numpy()


def overlap(network: torch.nn.Module, pictures: list[sgb.LabelledImage]) -> pd.Series:
    """Return the intersection over union of each class that the pictures show."""
    both = either = 0
    for one in pictures:
        found, known = chances(network, one) >= 0.5, one.labels != sgb.UNKNOWN
        truth = one.labels == sgb.PRESENT
        both = both + (found & truth & known).sum(axis=(1, 2))
        either = either + ((found | truth) & known).sum(axis=(1, 2))
    return pd.Series(both / np.maximum(either, 1), index=CLASSES)


scores = {
    (name, where): overlap(network, pictures)
    for name, network in networks.items()
    for where, pictures in (("learned", seen), ("unseen town", familiar), ("and materials", unseen))
}
table = pd.DataFrame(scores)
table.loc["mean"] = table.mean()
table.round(2)

# %%
_, charts = plt.subplots(3, 4, figsize=(11, 8.3), layout="constrained")
for line, one in zip(charts, unseen[:3], strict=True):
    shown = {"picture": one.image.rgb / 255, "labels": over(one.image.rgb, one.labels == sgb.PRESENT)}
    shown |= {name: over(one.image.rgb, chances(network, one) >= 0.5) for name, network in networks.items()}
    for chart, (name, picture) in zip(line, shown.items(), strict=True):
        chart.imshow(picture)
        chart.set(xticks=[], yticks=[])
        chart.set_title(name, fontsize=9)

# %% [markdown]
# These are few pictures and a minute of training: the figures say how such a loop is written, not how well it can be
# done. Measured segmenters, with their training and on real pictures, are in [segmenters](../results/segmenters.md).
#
# ## Is a probability one?
#
# A matcher weighs evidence by its confidence, so 0.8 should be right in four pixels of five. Below the grey line the
# network is too sure, above it too modest.

# %%
said = np.concatenate([chances(networks["small U-Net"], one)[one.labels != sgb.UNKNOWN] for one in unseen])
true = np.concatenate([(one.labels == sgb.PRESENT)[one.labels != sgb.UNKNOWN] for one in unseen])
bins = np.minimum((said * 10).astype(int), 9)
counts = np.bincount(bins, minlength=10)
_, chart = plt.subplots(figsize=(4, 4), layout="constrained")
chart.plot([0, 1], [0, 1], color="#999999", lw=0.8)
chart.plot(np.bincount(bins, said, 10) / counts, np.bincount(bins, true, 10) / counts, marker="o")
chart.set(xlabel="stated probability", ylabel="share that is there", title="unseen town and materials")

# %% [markdown]
# ## Where to go on
#
# - [Add a segmenter](../howto/segmenter.md) turns such a network into a plugin: `learn` and `segment` in a process of
#   its own, and a row beside the shipped ones.
# - [Work in Python](../howto/notebook.md) has `QueryDataset`, which gives views, priors and map pieces to a matcher
#   that learns.
