# SPDX-License-Identifier: Apache-2.0
"""Tasks and pictures as datasets of PyTorch: items, their order, batches of several workers, and what is refused."""

import hashlib
import pickle
from types import SimpleNamespace

import numpy as np
import pytest

import sasgeo_bench as sgb
from sasgeo_bench.core.errors import ConfigError, ImageError, StoreError
from sasgeo_bench.tasks import torch as datasets
from sasgeo_bench.tasks.frames import Frame, FrameLabels, encode_webp

PICTURES = sgb.tiny_images()
TOWN = "town-riverside"


@pytest.fixture(scope="module")
def torch():
    """PyTorch; the test is skipped without it."""
    return pytest.importorskip("torch", reason="PyTorch, the extra [torch], is not installed (make test-torch)")


@pytest.fixture
def folders(tasks):
    """Task, truths and map of a town."""
    return SimpleNamespace(
        task=tasks / "tasks" / "clean" / TOWN,
        truths=tasks / "truth" / "clean" / TOWN,
        region=sgb.read_region(tasks / "regions" / TOWN),
    )


# Where torch is missing


def test_without_torch_one_line_says_what_to_install(monkeypatch, tmp_path):
    monkeypatch.setattr(datasets, "torch", None)
    for make in (lambda: sgb.QueryDataset(tmp_path), lambda: sgb.PictureDataset(PICTURES)):
        with pytest.raises(ConfigError, match=r"^datasets need PyTorch: pip install 'sasgeo-bench\[torch\]'$"):
            make()


def test_a_view_is_cut_to_its_middle_and_unknown_beyond():
    cells = np.arange(9, dtype=np.uint8).reshape(1, 3, 3) % 2
    np.testing.assert_array_equal(datasets._fitted(cells, 1), cells[:, 1:2, 1:2])
    larger = datasets._fitted(cells, 5)
    np.testing.assert_array_equal(larger[:, 1:4, 1:4], cells)
    assert (larger == sgb.UNKNOWN).sum() == 25 - 9


# Queries


def test_items_are_the_queries_of_a_track_each_once_in_the_order_of_their_hashes(torch, folders):
    del torch
    found = [item["query_id"] for item in sgb.QueryDataset(folders.task, seed=5)]
    asked = [query.query_id for query in sgb.read_queries(folders.task) if query.track == "localization"]
    assert found == sorted(asked, key=lambda name: hashlib.sha256(f"5/{name}".encode()).digest()[:8])
    assert found != [item["query_id"] for item in sgb.QueryDataset(folders.task, seed=6)]


def test_an_item_holds_view_prior_and_truth_of_its_query(torch, folders):
    queries = {query.query_id: query for query in sgb.read_queries(folders.task)}
    truths = {truth.query_id: truth for truth in sgb.read_truths(folders.truths)}
    dataset = sgb.QueryDataset(folders.task, folders.truths, sides_cells=(384, 8))
    for item in dataset:
        query, truth = queries[item["query_id"]], truths[item["query_id"]]
        edge = (384 - query.evidence.shape[0]) // 2
        inner = item["view"][:, edge : 384 - edge, edge : 384 - edge]
        assert torch.equal(inner, torch.from_numpy(query.evidence.cells.copy()))
        assert item["prior"][0] == query.prior.radius_m
        assert bool(item["is_present"]) == truth.is_present
        at = item["middle_m"].numpy() + item["pose"][:2].double().numpy()
        np.testing.assert_allclose(at, (truth.pose.easting_m, truth.pose.northing_m), atol=1e-3)


def test_the_map_of_an_item_shows_what_the_view_sees_at_its_pose(torch, folders):
    """A view is sampled from the map by its pose: rebuilt from `map` alone, it is what the whole map shows there."""
    del torch
    dataset = sgb.QueryDataset(folders.task, folders.truths, region=folders.region, sides_cells=(192, 1400))
    item = dataset[0]
    east_m, north_m, yaw_deg, scale = item["pose"].double().tolist()
    side, size_m = 1400, dataset.query(0).evidence.cell_size_m
    half_m = side * size_m / 2
    grid = sgb.Grid(epsg=32633, west_m=-half_m, north_m=half_m, cell_size_m=size_m, rows=side, cols=side)
    pose = sgb.Pose(easting_m=east_m, northing_m=north_m, yaw_deg=yaw_deg, scale=scale)
    layers = sgb.LayerBits.of(np.where(item["map"].numpy() == sgb.UNKNOWN, 255, item["map"].numpy()).astype(np.uint8))
    rebuilt = sgb.observe(layers, grid, pose, size_cells=96, cell_size_m=size_m)
    true = next(one for one in sgb.read_truths(folders.truths) if one.query_id == item["query_id"])
    whole = sgb.LayerBits.of(folders.region.layers)
    seen = sgb.observe(whole, folders.region.grid, true.pose, size_cells=96, cell_size_m=size_m)
    order = [folders.region.classes.index(name) for name in dataset.classes]
    assert (rebuilt == seen[order]).mean() > 0.97  # each samples a lattice of its own


def test_workers_give_the_same_batches_as_none(torch, folders):
    dataset = sgb.QueryDataset(folders.task, folders.truths, region=folders.region, sides_cells=(192, 64))
    loaders = [torch.utils.data.DataLoader(dataset, batch_size=4, num_workers=count) for count in (0, 2)]
    for alone, shared in zip(*loaders, strict=True):
        assert alone.keys() == shared.keys()
        assert alone["query_id"] == shared["query_id"]
        for name in ("view", "map", "prior", "pose", "middle_m"):
            torch.testing.assert_close(alone[name], shared[name], equal_nan=True)


def test_a_dataset_travels_to_a_worker_that_is_started_anew(torch, folders):
    dataset = sgb.QueryDataset(folders.task, folders.truths, region=folders.region, sides_cells=(192, 32))
    again = pickle.loads(pickle.dumps(dataset))  # noqa: S301 - our own
    assert torch.equal(again[1]["map"], dataset[1]["map"])
    assert isinstance(dataset, torch.utils.data.Dataset)


def test_what_does_not_fit_is_refused_in_a_line(torch, folders, tasks):
    del torch
    with pytest.raises(ConfigError, match="has no queries of the track 'sequence': it has localization, retrieval"):
        sgb.QueryDataset(folders.task, track="sequence")
    with pytest.raises(ConfigError, match="is about 'town-riverside', the region is 'town-grid'"):
        sgb.QueryDataset(folders.task, region=sgb.read_region(tasks / "regions" / "town-grid"))
    with pytest.raises(StoreError, match="holds the truths of other queries"):
        sgb.QueryDataset(folders.task, tasks / "truth" / "absent" / TOWN)
    with pytest.raises(IndexError, match="got index 100000"):
        sgb.QueryDataset(folders.task)[100_000]


# Pictures


def test_a_crop_and_its_mask_are_cut_turned_and_flipped_alike(torch):
    """Of a picture whose red is a class, every crop has that class where it is red."""
    del torch
    rgb = np.zeros((96, 128, 3), dtype=np.uint8)
    rgb[10:50, 20:45, 0] = 255
    labels = (rgb[None, :, :, 0] > 0).astype(np.uint8)
    one = sgb.LabelledImage(image=sgb.with_picture(rgb), classes=("water",), labels=labels, place="drawn")
    crops = sgb.PictureDataset([one], crop_px=64, crops_each=40)
    for item in crops:
        np.testing.assert_array_equal(item["picture"][0].numpy() > 0, item["mask"][0].numpy() == sgb.PRESENT)
    assert len({item["mask"].numpy().tobytes() for item in crops}) > 20


def test_a_crop_depends_on_its_index_and_the_seed_alone_and_needs_pictures(torch):
    few, more = (sgb.PictureDataset(PICTURES[:count], crop_px=64, crops_each=5) for count in (2, 4))
    for at in reversed(range(len(few))):
        assert torch.equal(few[at]["picture"], more[at]["picture"])
    other = sgb.PictureDataset(PICTURES, crop_px=64, crops_each=5, seed=1)
    assert any(not torch.equal(more[at]["mask"], other[at]["mask"]) for at in range(len(other)))
    del torch
    with pytest.raises(ImageError, match="crops need pictures"):
        sgb.PictureDataset([])


def test_what_lies_beyond_a_small_picture_is_black_and_unknown(torch):
    del torch
    item = sgb.PictureDataset(PICTURES, crop_px=160, crops_each=1)[0]
    assert item["picture"].shape == (3, 160, 160)
    is_beyond = (item["mask"] == sgb.UNKNOWN).all(dim=0)
    assert int(is_beyond.sum()) >= 160 * 160 - 96 * 128
    assert int(((item["picture"] == 0).all(dim=0) & is_beyond).sum()) >= 160 * 160 - 96 * 128


def test_pictures_of_a_task_are_decoded_with_the_labels_of_their_frames():
    one = PICTURES[0]
    labels = FrameLabels.of(one.classes, one.labels)
    pictures = datasets._Pictures(
        [(Frame(picture=encode_webp(one.image.rgb), camera=one.image.camera), labels)] * 3, "t"
    )
    assert len(pictures[1:]) == 2
    np.testing.assert_array_equal(pictures[0].labels, one.labels)
    assert np.abs(pictures[0].image.rgb.astype(int) - one.image.rgb).mean() < 12  # WebP loses a little


def test_a_task_without_pictures_is_refused(folders):
    with pytest.raises(ConfigError, match="has no pictures: name a task of a suite such as aerial"):
        sgb.task_pictures(folders.task, folders.truths)
