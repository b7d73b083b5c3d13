# SPDX-License-Identifier: Apache-2.0
"""Matchers that look at pictures find views cut from the imagery of a made-up place, and say nothing of flat ones."""

import datetime as dt
import math
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
import shapely
from sasgeo_baselines.image.deep_retrieval import DeepRetrieval
from sasgeo_baselines.image.ncc_gradient import NccGradientMasked
from sasgeo_baselines.image.orb_homography import OrbHomography, OrbHomographyMasked
from sasgeo_baselines.image.view_image import under_roofs

import sasgeo_bench as sgb
from sasgeo_bench.matching.matcher import check_match, lacks
from sasgeo_bench.regions.evidence import UNKNOWN, Evidence
from sasgeo_bench.tasks.frames import encode_webp
from tests import world
from tests.regions.imagery_place import SOUTH, WEST, make_hamlet

NAMES = (
    *("deep_retrieval", "hog_colour", "hu_dual_reference", "hu_imagery_only", "ncc_gradient", "orb_homography"),
    *("ncc_gradient_masked", "orb_vlad"),  # beside its roofs, the place has no corners for orb_homography_masked
)
SIDE_M, PICTURE_PX, HEIGHT_M = 112.0, 400, 80.0
TRUTH = sgb.Pose(easting_m=WEST + 205.0, northing_m=SOUTH + 172.0, yaw_deg=65.0, scale=1.03)
PRIOR = sgb.Prior(
    center_m=(WEST + 180.0, SOUTH + 190.0), radius_m=100.0, yaw_deg=60.0, yaw_sigma_deg=5.0, scale_sigma=0.03
)


@pytest.fixture(scope="module")
def region(tmp_path_factory: pytest.TempPathFactory) -> sgb.Region:
    """A hamlet with imagery."""
    hamlet = make_hamlet(tmp_path_factory.mktemp("hamlet"))
    out = tmp_path_factory.mktemp("out")
    folders = {"extract_folders": [hamlet.folder], "imagery_folders": [hamlet.folder]}
    return sgb.read_region(world.built(hamlet.spec(), out, **folders))


@pytest.fixture(scope="module")
def window(region: sgb.Region) -> sgb.ImageryWindow:
    """All of its imagery."""
    return region.imagery.read(region.imagery.record.bounds_m)


def made_of(name: str, drawn_file: Path) -> sgb.Matcher:
    """A matcher by its name, with weights where it needs some; skips where it needs what is not installed."""
    made = sgb.load_matcher(name)
    if isinstance(made, DeepRetrieval):
        pytest.importorskip("torch", reason="PyTorch, the extra [torch], is not installed (make test-torch)")
        made.weights = drawn_file
    return made


@pytest.fixture(scope="module", params=NAMES)
def matcher(request: pytest.FixtureRequest, region: sgb.Region, drawn_file: Path) -> sgb.Matcher:
    """Each matcher, prepared."""
    made = made_of(request.param, drawn_file)
    made.prepare(region, None)
    return made


def camera() -> sgb.Camera:
    """Looks straight down on somewhat more than the view."""
    wide_deg = 2 * math.degrees(math.atan(0.6 * SIDE_M / HEIGHT_M))
    lens = sgb.Intrinsics.from_field_of_view(horizontal_deg=wide_deg, width_px=PICTURE_PX, height_px=PICTURE_PX)
    return sgb.Camera.pointed(intrinsics=lens, east_m=0.0, north_m=0.0, height_m=HEIGHT_M, yaw_deg=0.0)


def picture(window: sgb.ImageryWindow, pose: sgb.Pose, *, seed: int = 5) -> np.ndarray:
    """What the camera sees from a pose: darker, flatter and noisier than the imagery."""
    middles = np.arange(PICTURE_PX) + 0.5
    pixels = np.column_stack([axis.ravel() for axis in np.meshgrid(middles, middles)])
    places_m = pose.to_map(camera().unproject(pixels, sgb.Plane())[:, :2])
    at = (window.grid.to_uv(places_m) - 0.5).astype(np.float32).reshape(PICTURE_PX, PICTURE_PX, 2)
    seen = cv2.remap(window.rgb, at, None, cv2.INTER_LINEAR).astype(np.float64)
    noise = np.random.default_rng(seed).normal(0, 6, seen.shape)
    return np.clip(0.8 * seen + 25 + noise, 0, 255).astype(np.uint8)


def query_of(rgb: np.ndarray, **changes: object) -> sgb.Query:
    """A question about a picture; nothing of its evidence is known."""
    cells = np.full((1, int(SIDE_M), int(SIDE_M)), UNKNOWN, dtype=np.uint8)
    question = sgb.Query(
        query_id="q",
        track="localization",
        suite="rendered",
        suite_version=1,
        part="crossfit",
        region="hamlet",
        evidence=Evidence(classes=("building",), cells=cells, cell_size_m=1.0),
        observed_on=dt.date(2025, 1, 1),
        season="",
        prior=PRIOR,
        prior_group="r100-known-s3",
        frames=(sgb.Frame(picture=encode_webp(rgb), camera=camera()),),
    )
    return replace(question, **changes)


def off_m(pose: sgb.Pose, truth: sgb.Pose = TRUTH) -> float:
    return math.hypot(pose.easting_m - truth.easting_m, pose.northing_m - truth.northing_m)


def test_each_finds_a_darker_noisier_view_twice_alike_and_says_no_more_than_is_asked(matcher, window):
    query = query_of(picture(window, TRUTH))
    match = check_match(matcher.match(query, top_k=5), query, top_k=5)
    assert off_m(match.poses[0]) < 10.0
    assert match.diagnostics["margin"] >= 0.0
    assert matcher.match(query, top_k=5) == match
    assert matcher.match(query, top_k=1).poses == match.poses[:1]


@pytest.mark.parametrize("seed", range(3))
def test_each_finds_views_at_drawn_places(matcher, window, seed):
    rng = np.random.default_rng(seed)
    east_m, north_m = rng.uniform(-60, 60, 2)
    truth = sgb.Pose(
        easting_m=PRIOR.center_m[0] + east_m,
        northing_m=PRIOR.center_m[1] + north_m,
        yaw_deg=60.0 + rng.uniform(-5, 5),
        scale=1 + rng.uniform(-0.05, 0.05),
    )
    match = matcher.match(query_of(picture(window, truth, seed=seed)), top_k=1)
    assert off_m(match.poses[0], truth) < 10.0


def test_each_withholds_where_the_picture_is_flat(matcher):
    flat = np.full((PICTURE_PX, PICTURE_PX, 3), 120, dtype=np.uint8)
    assert matcher.match(query_of(flat), top_k=5).poses == ()


def test_each_scores_noise_lower_than_a_view(matcher, window):
    noise = np.random.default_rng(1).normal(120, 12, (PICTURE_PX, PICTURE_PX, 3)).clip(0, 255).astype(np.uint8)
    empty = matcher.match(query_of(noise), top_k=1)
    whole = matcher.match(query_of(picture(window, TRUTH)), top_k=1)
    assert not empty.scores or empty.scores[0] < 0.75 * whole.scores[0]


def test_each_ranks_candidates_and_equal_ones_tie(matcher, window):
    def at(east_m: float, north_m: float) -> sgb.Pose:
        return sgb.Pose(easting_m=WEST + east_m, northing_m=SOUTH + north_m, yaw_deg=60.0)

    candidates = (at(120, 120), at(206, 170), at(120, 120), at(290, 250))
    query = query_of(picture(window, TRUTH), track="retrieval", candidates=candidates)
    match = check_match(matcher.match(query, top_k=4), query, top_k=4)
    assert off_m(match.poses[0]) < 5.0
    same = [score for pose, score in zip(match.poses, match.scores, strict=True) if pose.easting_m == WEST + 120]
    assert len(set(same)) <= 1
    assert len(same) in (0, 2)


def test_each_withholds_beyond_the_imagery(matcher, window):
    away = replace(PRIOR, center_m=(WEST + 20_000.0, SOUTH))
    assert not matcher.match(query_of(picture(window, TRUTH), prior=away), top_k=5).poses


def test_each_searches_the_whole_map_without_a_disc(matcher, window):
    bare = replace(PRIOR, center_m=None, radius_m=None)
    match = matcher.match(query_of(picture(window, TRUTH), prior=bare), top_k=1)
    assert off_m(match.poses[0]) < 10.0


@pytest.mark.parametrize("name", NAMES)
def test_each_needs_a_picture_and_imagery_and_withholds_on_a_map_without(name, window, drawn_file):
    card, query = sgb.load_matcher(name).card, query_of(picture(window, TRUTH))
    assert lacks(card, query, is_pictured=True) is None
    assert lacks(card, query) == "no imagery"
    assert lacks(card, replace(query, frames=()), is_pictured=True) == "no image"
    made = made_of(name, drawn_file)
    made.prepare(SimpleNamespace(imagery=None), None)
    assert made.match(query, top_k=5) == sgb.WITHHELD


# --- masked by the map


def mapped_houses(region: sgb.Region) -> shapely.Geometry:
    """Houses on ground of which the map knows, less its rim."""
    return shapely.union_all(region.features.geometry.to_list()) & region.coverage.buffer(-3)


def test_what_lies_under_roofs_is_told_on_any_lattice(region):
    west_m, south_m, _, _ = region.grid.bounds_m
    grid = sgb.Grid(
        epsg=region.grid.epsg, west_m=west_m - 7.3, north_m=south_m + 200.4, cell_size_m=0.7, rows=300, cols=250
    )
    found = under_roofs(region, grid)
    rows, cols = np.indices(grid.shape)
    middles = grid.to_en_m(np.column_stack((cols.ravel() + 0.5, rows.ravel() + 0.5)))
    houses = shapely.union_all(region.features.geometry.to_list())
    near_m, far_m = (
        shapely.distance(shapely.points(middles), shape).reshape(grid.shape)
        for shape in (mapped_houses(region), houses)
    )
    assert found[near_m < 1.0].all()
    assert not found[far_m > 4.5].any()  # two metres along both axes, and a cell
    assert 0.2 < found.mean() < 0.8
    without = SimpleNamespace(classes=("water",), grid=region.grid)
    assert not under_roofs(without, grid).any()


def test_no_feature_of_a_masked_map_lies_on_a_roof(region):
    counts = []
    for made in (OrbHomography(), OrbHomographyMasked()):
        made.prepare(region, None)
        points = shapely.points(made._features.points)
        counts.append((len(points), int(shapely.contains(mapped_houses(region), points).sum())))
    assert counts[0][1] > 20
    assert counts[1][1] == 0
    assert 0 < counts[1][0] < counts[0][0]


@pytest.mark.parametrize("made", [NccGradientMasked(), OrbHomographyMasked()], ids=lambda made: made.card.name)
def test_a_masked_matcher_finds_the_place_by_the_ground_whatever_is_on_the_roofs(made, region, window):
    """Fields of many greys lie between the houses; the roofs of view and imagery have nothing in common."""
    rng, (rows, cols) = np.random.default_rng(2), window.grid.shape
    fields = rng.integers(40, 220, (rows // 7 + 1, cols // 7 + 1), dtype=np.uint8).repeat(7, 0).repeat(7, 1)
    is_roof = under_roofs(region, window.grid)

    def painted() -> np.ndarray:
        roofs = rng.integers(0, 255, (rows // 5 + 1, cols // 5 + 1), dtype=np.uint8).repeat(5, 0).repeat(5, 1)
        grey = np.where(is_roof, roofs[:rows, :cols], fields[:rows, :cols])
        return np.repeat(grey[..., None], 3, axis=2)

    rgb = painted()

    class Repainted:
        record, epsg = region.imagery.record, region.imagery.epsg

        def read(self, bounds_m, *, gsd_m):
            part = region.imagery.read(bounds_m, gsd_m=gsd_m)
            at = window.grid.to_cells(
                part.grid.to_en_m(np.argwhere(np.ones(part.grid.shape, dtype=bool))[:, ::-1] + 0.5)
            )
            row, col = np.clip(at, 0, np.array(window.grid.shape) - 1).T
            return replace(part, rgb=rgb[row, col].reshape(part.rgb.shape))

    made.prepare(
        SimpleNamespace(imagery=Repainted(), grid=region.grid, classes=region.classes, layer=region.layer), None
    )
    match = made.match(query_of(picture(replace(window, rgb=painted()), TRUTH)), top_k=1)
    assert match.poses
    assert off_m(match.poses[0]) < 10.0
