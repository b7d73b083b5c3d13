# SPDX-License-Identifier: Apache-2.0
"""Map-style datasets of PyTorch: the queries of a task, and crops of labelled pictures with their masks.

An item depends on its index and the seed alone, not on the worker, the order of the calls or the epoch. All items of a
dataset have the same keys and shapes, so that the default collate function of a `DataLoader` makes batches of them; it
turns texts into lists.
"""

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final, Self, overload

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from sasgeo_bench.core.errors import ConfigError, ImageError
from sasgeo_bench.geometry.grid import Grid
from sasgeo_bench.geometry.pose import Pose
from sasgeo_bench.regions.evidence import UNKNOWN, LayerBits, observe
from sasgeo_bench.regions.region import Region
from sasgeo_bench.sensing.image import LabelledImage
from sasgeo_bench.tasks.frame_files import read_labels
from sasgeo_bench.tasks.frames import Frame, FrameLabels
from sasgeo_bench.tasks.query import Query, Track, Truth, base_of
from sasgeo_bench.tasks.task_files import QUERIES, QUERY_SCHEMA, Task, query_of, read_batches

try:
    import torch
    from torch.utils.data import Dataset
except (ImportError, OSError):  # an extra, or one that does not fit this system
    torch, Dataset = None, object

Tensor = Any  # PyTorch is an extra: it is read as untyped wherever it is installed
Item = dict[str, Any]
Cells = NDArray[np.uint8]

_NOWHERE_M: Final = (float("nan"), float("nan"))
_TURNS: Final = 4


class QueryDataset(Dataset):  # type: ignore[misc]  # of no type: PyTorch is an extra
    """The queries of a task as tensors: view, prior, a piece of the map, and the true pose where truths are given.

    Parameters
    ----------
    task : str or Path
        Folder of a task, as of `make_tasks`.
    truths : str or Path, optional
        Folder of its truths. Those of test places are for the scorer: train on tasks of other places.
    region : Region, optional
        The map that the task is about, for `map`.
    track : {"localization", "retrieval", "sequence"}
        Queries of this track alone.
    sides_cells : tuple of int
        Sides of `view` and of `map`, V and M below. Larger views are cut to their middle; what a smaller one does not
        show is unknown.
    seed : int
        The order of the items follows from hashes of the seed and of each query's id: the beginning of a dataset is a
        sample of it, and one more query changes the order of no other two.

    Raises
    ------
    ConfigError
        If PyTorch is missing, the task has no query of the track, or the region is not the one that it names.
    StoreError
        If the task or its truths are missing, damaged, or do not belong together.

    Notes
    -----
    An item has these keys. C are the classes of the view, in the order of `classes`; east and north are metres from
    `middle_m`, the middle of the prior's disc, or of the map where the prior has none.

    ============  ========  ==========  ===================================================================
    key           type      shape       content
    ============  ========  ==========  ===================================================================
    query_id      str                   id of the query
    view          uint8     (C, V, V)   0 absent, 1 present, 2 unknown; the heading is up
    prior         float32   (4,)        radius_m, yaw_deg, yaw_sigma_deg, scale_sigma; NaN where unknown
    middle_m      float64   (2,)        easting and northing of that middle; NaN without disc and region
    map           uint8     (C, M, M)   with a region: the map around `middle_m`, north up, in cells of the view
    pose          float32   (4,)        with truths: east_m, north_m, yaw_deg, scale; NaN if not taken here
    is_present    bool      ()          with truths: whether the place is on the searched map
    ============  ========  ==========  ===================================================================

    Examples
    --------
    >>> queries = QueryDataset("out/tasks/clean/town-grid", "out/truth/clean/town-grid")  # doctest: +SKIP
    >>> batches = torch.utils.data.DataLoader(queries, batch_size=8, shuffle=True, num_workers=2)  # doctest: +SKIP
    >>> next(iter(batches))["view"].shape  # doctest: +SKIP
    torch.Size([8, 13, 192, 192])
    """

    def __init__(
        self,
        task: str | Path,
        truths: str | Path | None = None,
        *,
        region: Region | None = None,
        track: Track = "localization",
        sides_cells: tuple[int, int] = (192, 512),
        seed: int = 0,
    ) -> None:
        _check_torch()
        opened = _opened(task, truths)
        if region is not None and base_of(opened.manifest.region) != base_of(region.manifest.id):
            raise ConfigError(
                f"{opened.folder} is about {opened.manifest.region!r}, the region is {region.manifest.id!r}: "
                "read the other one"
            )
        self.view_cells, self.map_cells = sides_cells
        self._truths = None
        if truths is not None:
            opened.check_truths()
            self._truths = {truth.query_id: truth for truth in opened.truths}
        self._rows = _rows_of(opened, track, seed)
        self.classes = self.query(0).evidence.classes
        self._map = None if region is None else _Map.of(region, self.classes)

    def __len__(self) -> int:
        return int(self._rows.num_rows)

    def query(self, index: int) -> Query:
        """Return the query behind an item, for `plot_query` or a matcher."""
        if not 0 <= index < len(self):
            raise IndexError(f"there are {len(self)} queries, got index {index}")
        return query_of(self._rows.slice(index, 1).to_pylist()[0])

    def __getitem__(self, index: int) -> Item:
        """Return one query as tensors."""
        query = self.query(index)
        prior, view = query.prior, query.evidence
        known = (prior.radius_m, prior.yaw_deg, prior.yaw_sigma_deg, prior.scale_sigma)
        middle_m = prior.center_m or (_NOWHERE_M if self._map is None else self._map.middle_m)
        item: Item = {
            "query_id": query.query_id,
            "view": torch.from_numpy(_fitted(view.cells, self.view_cells)),
            "prior": _numbers(known),
            "middle_m": torch.tensor(middle_m, dtype=torch.float64),
        }
        if self._map is not None:
            item["map"] = torch.from_numpy(self._map.around(middle_m, self.map_cells, view.cell_size_m))
        if self._truths is not None:
            truth = self._truths[query.query_id]
            item |= {"pose": _pose_of(truth, middle_m), "is_present": torch.tensor(truth.is_present)}
        return item


class PictureDataset(Dataset):  # type: ignore[misc]  # as above
    """Crops of labelled pictures with a mask for each class, to train a segmenter.

    Parameters
    ----------
    pictures : sequence of LabelledImage
        As of `ImageTraining.images` or `task_pictures`; all label the same classes. Each is read when it is needed, so
        that they may lie on disk.
    crop_px : int
        Side of a crop. A smaller picture is shown whole; the rest is black, and unknown in the mask.
    crops_each : int
        Crops of each picture, at places, turns and flips that follow from hashes of the seed, the place and the index.
    seed : int
        Another seed draws other crops; one crop of a picture does not depend on how many pictures there are.

    Raises
    ------
    ConfigError
        If PyTorch is missing.
    ImageError
        If there is no picture, or a size or count is less than 1.

    Notes
    -----
    An item has `picture`, uint8 (3, P, P): red, green, blue; `mask`, uint8 (C, P, P): 0 absent, 1 present, 2 unknown,
    which no loss should count; and `place`, a str.

    Examples
    --------
    >>> import sasgeo_bench as sgb
    >>> crops = PictureDataset(sgb.tiny_images(), crop_px=64, crops_each=3)  # doctest: +SKIP
    >>> len(crops), crops[0]["picture"].shape, crops[0]["mask"].shape  # doctest: +SKIP
    (12, torch.Size([3, 64, 64]), torch.Size([4, 64, 64]))
    """

    def __init__(
        self, pictures: Sequence[LabelledImage], *, crop_px: int = 128, crops_each: int = 16, seed: int = 0
    ) -> None:
        _check_torch()
        if not len(pictures) or crop_px < 1 or crops_each < 1:
            got = f"{len(pictures)} pictures, {crop_px} and {crops_each}"
            raise ImageError(f"crops need pictures, a side of at least 1 and as many of each, got {got}")
        self.crop_px, self.crops_each, self.seed = crop_px, crops_each, seed
        self._pictures, self.classes = pictures, pictures[0].classes

    def __len__(self) -> int:
        return len(self._pictures) * self.crops_each

    def __getitem__(self, index: int) -> Item:
        """Return one crop and its mask as tensors."""
        if not 0 <= index < len(self):
            raise IndexError(f"there are {len(self)} crops, got index {index}")
        at, number = divmod(index, self.crops_each)
        labelled = self._pictures[at]
        rng = np.random.default_rng(_hash_of(f"{self.seed}/{labelled.place}/{at}/{number}"))
        spare = [max(side - self.crop_px, 0) + 1 for side in labelled.image.shape]
        top, left = (int(rng.integers(most)) for most in spare)
        turns, is_flipped = int(rng.integers(_TURNS)), bool(rng.integers(2))
        found = {}
        bands = labelled.image.rgb.transpose(2, 0, 1)
        for name, planes, fill in (("picture", bands, 0), ("mask", labelled.labels, UNKNOWN)):
            part = planes[:, top : top + self.crop_px, left : left + self.crop_px]
            whole = np.full((len(part), self.crop_px, self.crop_px), fill, dtype=np.uint8)
            whole[:, : part.shape[1], : part.shape[2]] = part
            turned = np.rot90(whole, turns, axes=(1, 2))
            found[name] = torch.from_numpy(np.ascontiguousarray(turned[:, :, ::-1] if is_flipped else turned))
        return {**found, "place": labelled.place}


def task_pictures(task: str | Path, truths: str | Path) -> Sequence[LabelledImage]:
    """Return the pictures of a task with the labels of their pixels, each decoded when it is asked for.

    Parameters
    ----------
    task, truths : str or Path
        Folders of a task of pictures, such as `aerial`, and of its truths, which hold the labels.

    Returns
    -------
    sequence of LabelledImage
        In the order of the queries and frames; their place is the region of the task.

    Raises
    ------
    StoreError
        If a file is missing or damaged.
    ConfigError
        If the task has no pictures.

    Examples
    --------
    >>> pictures = task_pictures("out/tasks/aerial/town-grid", "out/truth/aerial/town-grid")  # doctest: +SKIP
    >>> crops = PictureDataset(pictures, crop_px=128)  # doctest: +SKIP
    """
    opened = _opened(task, truths)
    if not opened.manifest.frames:
        raise ConfigError(f"{opened.folder} has no pictures: name a task of a suite such as aerial")
    opened.check_truths()
    frames = {query.query_id: query.frames for query in opened.queries()}
    pairs = [(frames[name][number], labels) for name, number, labels in read_labels(opened.truth)]
    return _Pictures(pairs, base_of(opened.manifest.region))


def _opened(task: str | Path, truths: str | Path | None) -> Task:
    opened = Task.open(task)
    return opened if truths is None else replace(opened, truth=Path(truths))


class _Pictures(Sequence[LabelledImage]):
    """Pictures and labels of a task, compressed until they are asked for."""

    def __init__(self, pairs: Sequence[tuple[Frame, FrameLabels]], place: str) -> None:
        self._pairs, self._place = pairs, place

    @overload
    def __getitem__(self, at: int) -> LabelledImage: ...
    @overload
    def __getitem__(self, at: slice) -> "_Pictures": ...
    def __getitem__(self, at: int | slice) -> "LabelledImage | _Pictures":
        if isinstance(at, slice):
            return _Pictures(self._pairs[at], self._place)
        frame, labels = self._pairs[at]
        return labels.labelled(frame.image(), self._place)

    def __len__(self) -> int:
        return len(self._pairs)


def _check_torch() -> None:
    if torch is None:
        raise ConfigError("datasets need PyTorch: pip install 'sasgeo-bench[torch]'")


def _numbers(values: Sequence[float | None]) -> Tensor:
    """Return single-precision numbers, NaN for what is unknown."""
    return torch.tensor([float("nan") if value is None else value for value in values], dtype=torch.float32)


def _pose_of(truth: Truth, middle_m: tuple[float, float]) -> Tensor:
    if truth.pose is None:
        return _numbers([None] * 4)
    pose = truth.pose
    return _numbers((pose.easting_m - middle_m[0], pose.northing_m - middle_m[1], pose.yaw_deg, pose.scale))


def _hash_of(text: str) -> int:
    return int.from_bytes(hashlib.sha256(text.encode()).digest()[:8], "big")


def _rows_of(task: Task, track: Track, seed: int) -> pa.Table:
    """Read the queries of a track, packed as they are stored, in the order of hashes of the seed and their ids."""
    task.check_queries()
    rows = pa.Table.from_batches(list(read_batches(task.folder / QUERIES, QUERY_SCHEMA.names)))
    kept = [at for at, name in enumerate(rows["track"].to_pylist()) if name == track]
    if not kept:
        known = ", ".join(sorted(set(rows["track"].to_pylist()))) or "none"
        raise ConfigError(f"{task.folder} has no queries of the track {track!r}: it has {known}")
    ids = rows["query_id"].to_pylist()
    return rows.take(sorted(kept, key=lambda at: _hash_of(f"{seed}/{ids[at]}"))).combine_chunks()


def _fitted(cells: Cells, side: int) -> Cells:
    """Return the middle of a view, shape (C, side, side); unknown beyond it."""
    found = np.full((len(cells), side, side), UNKNOWN, dtype=np.uint8)
    rows, cols = cells.shape[1:]
    into, out = zip(*(_middles(side, size) for size in (rows, cols)), strict=True)
    found[:, *into] = cells[:, *out]
    return found


def _middles(side: int, size: int) -> tuple[slice, slice]:
    """Return where the middle of an axis of `size` cells goes in one of `side`, and where it is taken from."""
    count = min(side, size)
    into, out = (side - count) // 2, (size - count) // 2
    return slice(into, into + count), slice(out, out + count)


@dataclass(frozen=True, slots=True, kw_only=True)
class _Map:
    """A map that pieces are cut from: its layers, its grid, and which of its bands are the classes of a view."""

    layers: LayerBits
    grid: Grid
    bands: tuple[int, ...]

    @classmethod
    def of(cls, region: Region, classes: Sequence[str]) -> Self:
        """Return the map of a region; its features and graph are not kept."""
        bands = tuple(region.classes.index(name) for name in classes)
        return cls(layers=LayerBits.of(region.layers), grid=region.grid, bands=bands)

    @property
    def middle_m(self) -> tuple[float, float]:
        west_m, south_m, east_m, north_m = self.grid.bounds_m
        return ((west_m + east_m) / 2, (south_m + north_m) / 2)

    def around(self, middle_m: tuple[float, float], side: int, cell_size_m: float) -> Cells:
        """Return the map around a point, north up, shape (C, side, side); unknown beyond its edge."""
        pose = Pose(easting_m=middle_m[0], northing_m=middle_m[1], yaw_deg=0.0)
        cells = observe(self.layers, self.grid, pose, size_cells=side, cell_size_m=cell_size_m)
        return cells[list(self.bands)]
