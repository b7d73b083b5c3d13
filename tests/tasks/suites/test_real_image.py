# SPDX-License-Identifier: Apache-2.0
"""Real pictures: where they may lie, what they show, and what a query of them must not tell."""

from collections import Counter
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest
import rasterio
import shapely
from rasterio.windows import Window
from scipy.ndimage import gaussian_filter

from sasgeo_bench.core.errors import ConfigError, ImageryError
from sasgeo_bench.geometry.pose import Pose
from sasgeo_bench.regions.build import build_region, plan_build
from sasgeo_bench.regions.evidence import PRESENT, UNKNOWN, LayerBits, observe
from sasgeo_bench.regions.imagery import OffsetRecord
from sasgeo_bench.regions.region_files import read_region
from sasgeo_bench.regions.region_spec import RegionFile, list_region_files, read_region_file
from sasgeo_bench.sensing.segmentation import Segmentation
from sasgeo_bench.tasks.build import make_tasks
from sasgeo_bench.tasks.frame_evidence import evidence_of
from sasgeo_bench.tasks.frame_files import read_labels
from sasgeo_bench.tasks.pictured_ground import BUILT, GROUNDS, OPEN, Cut, PicturedGround
from sasgeo_bench.tasks.split import SplitFile, blocks_of, make_split
from sasgeo_bench.tasks.state import State
from sasgeo_bench.tasks.suites.base import Scene, Seeds, ViewRequest
from sasgeo_bench.tasks.suites.real_image import ABSENT, DEGRADED, FRAMES, OLDER, OWN, REAL_IMAGE, TURNED, VIEW
from sasgeo_bench.tasks.suites.sites import choose_sites, largest_scale
from sasgeo_bench.tasks.task_files import Task, read_queries, read_truths
from sasgeo_bench.tasks.task_plan import Request
from tests.regions import imagery_place
from tests.regions.imagery_place import SOUTH, WEST, Hamlet, make_hamlet, write_houses, write_mosaic, write_picture
from tests.sensing.test_sharpness import of_laplacian

SIDE_M = 1536.0
SHOWN_M = 960.0  # north of the southern rim a picture shows the village
SEEDS = Seeds(root=2, names=("village", "real-image"))


@dataclass(frozen=True, kw_only=True)
class Village:
    """A built place whose west is fields with a few huts and whose north is on no picture."""

    spec: RegionFile
    folder: Path
    out: Path

    def pictured(self) -> PicturedGround:
        region = read_region(self.out / "regions" / self.spec.id)
        return PicturedGround(state=State.of(region), imagery=region.imagery)


def lay_village(folder: Path, out: Path, name: str, *, largest_m: float, seed: int) -> Village:
    """Build a place of 1.5 km x 1.5 km with houses in the east, huts in the west, and a picture of its south."""
    rng = np.random.default_rng(seed)
    folder.mkdir(parents=True)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(imagery_place, "SIDE_M", SIDE_M)
        houses = []
        for east_m in np.arange(16, SIDE_M - 24, 32):
            for north_m in np.arange(16, SIDE_M - 24, 32):
                is_hut = east_m < SIDE_M / 2
                if is_hut and (east_m % 128 > 32 or north_m % 64 > 32):
                    continue
                side_m = rng.uniform(8, 9) if is_hut else rng.uniform(12, 18)
                house = shapely.box(WEST + east_m, SOUTH + north_m, WEST + east_m + side_m, SOUTH + north_m + side_m)
                houses.append(shapely.affinity.rotate(house, rng.uniform(0, 90)))
        write_houses(folder / "houses.geojson", houses)
        write_mosaic(folder / "mosaic.tif", houses, rng)
        with rasterio.open(folder / "mosaic.tif") as whole:
            north = int(whole.height * (1 - (SHOWN_M + 30) / (SIDE_M + 60)))
            part = Window(0, north, whole.width, whole.height - north)
            bands, transform = whole.read(window=part), whole.window_transform(part)
        write_picture(folder / "mosaic.tif", bands, transform=transform)
        spec = Hamlet(folder=folder, houses=houses).spec()
    entry = spec.imagery[0].model_copy(update={"attribution": f"(c) {name}"})
    spec = spec.model_copy(update={"id": name, "largest_view_m": largest_m, "imagery": [entry]})
    build_region(plan_build(spec, out=out, extract_folders=[folder], imagery_folders=[folder]))
    return Village(spec=spec, folder=folder, out=out)


pytestmark = pytest.mark.slow  # it draws several tasks of pictures first


@pytest.fixture(scope="module")
def village(tmp_path_factory: pytest.TempPathFactory) -> Village:
    root = tmp_path_factory.mktemp("village")
    return lay_village(root / "files", root / "out", "village", largest_m=192.0, seed=3)


def scene_of(pictured: PicturedGround, elsewhere: PicturedGround | None = None, **changes) -> Scene:
    fitting = REAL_IMAGE.fitting(192.0)
    most_m = max(item.side_m for item in fitting) / 2 * np.sqrt(2) * largest_scale(REAL_IMAGE.card.group)
    state = pictured.state
    plain = Scene(
        map=state,
        world=state,
        blocks=blocks_of(state.region, state.grid),
        view_reach_m=most_m,
        scenes=("suburban",),
        pictured=pictured,
        pictured_elsewhere=elsewhere,
    )
    return replace(plain, **changes)


@pytest.fixture(scope="module")
def over(village) -> tuple[Scene, tuple]:
    """The village and its sites, with the same place as the other town, for want of another."""
    pictured = village.pictured()
    scene = scene_of(pictured, pictured)
    return scene, sites_of(scene, 8)


def suite_on(scene: Scene):
    suite = replace(REAL_IMAGE, variants=REAL_IMAGE.fitting(192.0))
    assert suite.lack(scene) is None
    return replace(suite, variants=suite.usable(scene))


def sites_of(scene: Scene, count: int, **seeds) -> tuple:
    suite = suite_on(scene)
    group = suite.card.group
    return choose_sites(scene, suite, count=count, seeds=replace(SEEDS, **seeds), group=group, may_be_fewer=True)


def shot_of(scene: Scene, site, kind: str, *, strength: float | None = None) -> ViewRequest:
    found = [item for item in suite_on(scene).variants if item.kind == kind and strength in (None, item.strength)]
    return ViewRequest(scene=scene, site=site, variant=found[0], seeds=SEEDS.under("site", site.index))


# --- variants


def told(variants) -> Counter:
    return Counter((item.role, item.kind, item.side_m, item.radius_m) for item in variants)


def test_the_whole_suite_asks_five_sides_in_two_discs_and_what_else_its_card_says():
    sides = {(item.kind, item.radius_m): set() for item in REAL_IMAGE.variants}
    for item in REAL_IMAGE.variants:
        sides[item.kind, item.radius_m].add(item.side_m)
    assert sides[VIEW, None] == sides[VIEW, 250.0] == {384.0, 256.0, 192.0, 128.0, 96.0}
    assert sides["control", None] == sides["control", 250.0] == sides[TURNED, None] == {384.0}
    assert {item.strength for item in REAL_IMAGE.variants if item.kind == FRAMES} == {3.0, 9.0}
    assert len({item.name for item in REAL_IMAGE.variants}) == len(REAL_IMAGE.variants)


@pytest.mark.parametrize("largest_m", [None, 300.0, 192.0, 128.0, 100.0, 96.0, 60.0])
def test_no_view_is_larger_than_the_region_allows_and_each_is_drawn_once(largest_m):
    fitting = REAL_IMAGE.fitting(largest_m)
    assert len(set(fitting)) == len(fitting)
    sides = {item.side_m for item in fitting}
    assert max(sides) <= max(largest_m or 384.0, 96.0)
    (control,) = {item.side_m for item in fitting if item.role != "stress"}
    assert control == max(sides)
    views = {item.side_m for item in fitting if item.kind == VIEW}
    assert views == {side for side in (384.0, 256.0, 192.0, 128.0, 96.0) if side <= control}
    assert any(item.kind == DEGRADED for item in fitting)


def of_own_pixels(pictured: PicturedGround, gsd_m: float) -> PicturedGround:
    record = pictured.imagery.record
    pictures = tuple(item.model_copy(update={"gsd_m": gsd_m}) for item in record.pictures)
    record = record.model_copy(update={"pictures": pictures})
    return replace(pictured, imagery=replace(pictured.imagery, record=record))


def test_a_picture_of_coarse_pixels_is_asked_no_small_view_and_one_too_coarse_none(village):
    pictured = village.pictured()

    def of_pixels(gsd_m):
        return scene_of(of_own_pixels(pictured, gsd_m))

    suite = replace(REAL_IMAGE, variants=REAL_IMAGE.fitting(192.0))
    assert {item.side_m for item in suite.usable(of_pixels(0.9))} == {192.0, 128.0, 96.0}
    assert {item.side_m for item in suite.usable(of_pixels(1.2))} == {192.0, 128.0}
    assert suite.lack(of_pixels(2.0)) == "its picture has pixels of 2 m, fewer than 100 along a view of 192 m"


@pytest.mark.parametrize(
    ("own_m", "other_m", "expected"),
    [
        (0.5, 0.5, {192.0, 128.0}),
        (0.75, 0.5, {192.0, 128.0}),
        (0.5, 0.85, {192.0, 128.0}),
        (0.5, 1.5, {192.0}),
        (0.5, 2.0, set()),
    ],
)
def test_another_town_and_the_own_one_are_asked_by_the_views_that_both_pictures_resolve(
    own_m, other_m, expected, village
):
    pictured = village.pictured()
    scene = scene_of(of_own_pixels(pictured, own_m), of_own_pixels(pictured, other_m))
    for kind in (OWN, ABSENT):
        assert {item.side_m for item in suite_on(scene).variants if item.kind == kind} == expected


def test_every_older_map_is_searched_at_the_same_sites_and_none_that_is_degraded(over):
    scene, sites = over
    state = scene.map
    dated = tuple(
        replace(state, region=f"village@{year}-01-01", date=state.date.replace(year=year)) for year in (2013, 2017)
    )
    bare = tuple(replace(one, bits=replace(one.bits, bits=one.bits.bits & np.uint32(1 << 31))) for one in dated)
    worse = replace(state, region="village+real-image")
    aged = replace(scene, others=(worse, *bare))
    suite = suite_on(aged)
    searched = {item.kind: suite.map_region(aged, item) for item in suite.variants}
    assert searched[f"{OLDER} of 2013-01-01"] == "village@2013-01-01"
    assert searched[f"{OLDER} of 2017-01-01"] == "village@2017-01-01"
    assert searched[DEGRADED] == "village+real-image"
    assert {searched[kind] for kind in (VIEW, ABSENT, "control", TURNED)} == {"village"}
    assert sites_of(aged, 8) == sites  # an empty map moves none
    plan = [item for item in REAL_IMAGE.variants if item.kind == OLDER]
    assert [REAL_IMAGE.drawn_of(item, older=2) for item in plan] == [2]


# --- sites


def test_sites_take_turns_in_the_kinds_of_ground_and_find_their_number_on_the_picture(over):
    scene, sites = over
    assert len(sites) == 8
    kinds = Counter(scene.pictured.ground(site.pose, 192.0) for site in sites)
    assert min(kinds[BUILT], kinds[OPEN]) >= 3
    for site in sites:
        houses = scene.map.view(site.pose, size_cells=192, cell_size_m=1.0).layer("building") == PRESENT
        kind = scene.pictured.ground(site.pose, 192.0)
        assert (kind == BUILT) == (houses.mean() >= 0.1) or abs(houses.mean() - 0.1) < 0.01


def test_every_view_and_picture_of_every_site_is_shown(over):
    scene, sites = over
    suite = suite_on(scene)
    north = [site.pose.northing_m for site in sites]
    assert max(north) < SOUTH + SHOWN_M - 96.0
    assert max(north) > SOUTH + SHOWN_M - 250.0  # as near to the rim as pictures allow, about
    for site in sorted(sites, key=lambda one: -one.pose.northing_m)[:4]:
        for variant in suite.variants:
            shot = ViewRequest(scene=scene, site=site, variant=variant, seeds=SEEDS.under("site", site.index))
            draft = suite.draw(shot)
            assert draft.measured["pictured_share"] >= 0.97
            for frame in draft.frames:
                rgb = frame.image().rgb
                assert rgb[[0, 0, -1, -1], [0, -1, 0, -1]].sum(axis=1).min() > 60  # no corner is black


def test_a_hole_that_hides_a_small_view_makes_no_site(village):
    pictured = village.pictured()
    pose = sites_of(scene_of(pictured), 1)[0].pose
    suite = suite_on(scene_of(pictured))
    assert suite.ground_at(scene_of(pictured), pose) is not None
    shown = pictured._shown
    hole = shown.is_known.copy()
    row, col = shown.grid.to_cells(np.array([(pose.easting_m + 20, pose.northing_m)]))[0]
    hole[row - 10 : row + 10, col - 10 : col + 10] = False  # 400 of 9216 m2, and 1 % of 192 m x 192 m
    holed = village.pictured()
    holed.__dict__["_shown"] = replace(shown, is_known=hole)
    assert holed.shown_share(pose, 192.0) > 0.97 > holed.shown_share(pose, 96.0)
    assert suite.ground_at(scene_of(holed), pose) is None


def test_places_of_sites_follow_no_lattice(village):
    scene = scene_of(village.pictured())
    sites = [site for root in range(4) for site in sites_of(scene, 8, root=root)]
    grid = scene.pictured.imagery.grid
    phases = np.array([grid.to_uv(np.array([site.en_m]))[0] % 1 for site in sites])
    assert (np.histogram2d(*phases.T, bins=2, range=[(0, 1), (0, 1)])[0] > 0.12 * len(sites)).all()


@pytest.mark.real
def test_a_picture_of_half_a_region_carries_as_many_sites_as_are_asked_for(real_extracts, tmp_path):
    spec = read_region_file(list_region_files()["pardubice-ortho"])
    try:
        plan = plan_build(spec, out=tmp_path, extract_folders=[real_extracts])
    except ImageryError as error:
        pytest.skip(str(error))
    build_region(plan)
    region = read_region(plan.folder)
    pictured = PicturedGround(state=State.of(region), imagery=region.imagery)
    assert region.imagery.record.share < 0.5
    scene = scene_of(pictured, view_reach_m=384 / np.sqrt(2) * largest_scale(REAL_IMAGE.card.group))
    suite = replace(REAL_IMAGE, variants=REAL_IMAGE.usable(scene))
    sites = choose_sites(scene, suite, count=36, seeds=SEEDS, group=suite.card.group)
    kinds = Counter(pictured.ground(site.pose, 192.0) for site in sites)
    assert set(kinds) == set(GROUNDS)
    assert min(kinds.values()) >= 6
    assert min(pictured.shown_share(site.pose, 1.25 * 384.0) for site in sites) >= 0.97


# --- queries


def test_the_offset_of_the_imagery_is_taken_off(village):
    pictured = village.pictured()
    site = next(one for one in sites_of(scene_of(pictured), 8) if pictured.ground(one.pose, 96.0) == BUILT)
    # If a thing is seen 6 m east and 4 m south of its place, the picture of that place lies there.
    off = OffsetRecord.model_construct(east_m=6.0, north_m=-4.0)
    record = pictured.imagery.record.model_copy(update={"offset": off})
    moved = replace(pictured, imagery=replace(pictured.imagery, record=record))
    pose = replace(site.pose, easting_m=site.pose.easting_m + 6.0, northing_m=site.pose.northing_m - 4.0)
    drafts = [
        REAL_IMAGE.draw(shot_of(scene_of(ground), replace(site, pose=at), VIEW, strength=96.0))
        for ground, at in ((moved, site.pose), (pictured, pose), (pictured, site.pose))
    ]
    there, same, unmoved = (draft.frames[0].image().rgb.astype(float) for draft in drafts)
    assert np.abs(there - same).mean() < 0.1 * np.abs(there - unmoved).mean()
    assert drafts[0].labels == drafts[2].labels  # what is mapped stays that of the site
    assert drafts[0].measured["map_off_m"] == pytest.approx(np.hypot(6, 4), abs=0.01)
    assert drafts[0].pose is None


def test_a_view_of_another_town_says_no_pose_and_has_as_many_pixels(over):
    scene, sites = over
    site = sites[0]
    one, other = (suite_on(scene).draw(shot_of(scene, site, kind, strength=128.0)) for kind in (OWN, ABSENT))
    assert (one.is_present, one.has_pose, one.pose) == (True, True, None)
    assert (other.is_present, other.has_pose, other.pose) == (False, False, None)
    assert one.frames[0].camera == other.frames[0].camera
    assert one.frames[0].image().rgb.shape == other.frames[0].image().rgb.shape
    assert one.frames[0].picture != other.frames[0].picture
    assert {item.kind for item in suite_on(scene_of(scene.pictured)).variants} == {
        item.kind for item in suite_on(scene).variants
    } - {OWN, ABSENT}


@dataclass(frozen=True, kw_only=True)
class Dull(PicturedGround):
    """A place under a picture that says its pixels to be as wide, but is blurred."""

    def cut(self, pose: Pose, side_m: float, width_px: int) -> Cut:
        cut = super().cut(pose, side_m, width_px)
        sigma_px = 1.2 * width_px / side_m
        return replace(
            cut, rgb=np.rint(gaussian_filter(cut.rgb.astype(float), (sigma_px, sigma_px, 0))).astype(np.uint8)
        )


@pytest.mark.parametrize("is_dull_here", [False, True])
def test_the_variance_of_the_laplacian_does_not_tell_a_view_of_another_town(is_dull_here, village):
    sharp = village.pictured()
    dull = Dull(state=sharp.state, imagery=sharp.imagery)
    here, there = (dull, sharp) if is_dull_here else (sharp, dull)
    scene = scene_of(here, there)
    suite = suite_on(scene)
    pairs, before = [], []
    for site in sites_of(scene, 8):
        for side_m in (128.0, 192.0):
            shots = [shot_of(scene, site, kind, strength=side_m) for kind in (OWN, ABSENT)]
            pairs.append([of_laplacian(suite.draw(shot).frames[0].image().rgb) for shot in shots])
            before.append([of_laplacian(one.cut(site.pose, 1.25 * side_m, 200).rgb) for one in (here, there)])
    one, other = np.array(pairs).T
    assert 0.35 < (one[:, None] > other[None, :]).mean() < 0.65
    assert np.median(np.abs(np.log(one / other))) < 0.1
    one, other = np.array(before).T
    assert abs((one[:, None] > other[None, :]).mean() - 0.5) > 0.4


def test_a_map_that_knows_of_fewer_classes_lends_its_picture_and_says_nothing_of_the_others(over):
    scene, sites = over
    state = scene.map
    more = replace(
        state,
        classes=("water", *state.classes),
        bits=LayerBits(bits=twice(state.bits.bits), count=len(state.classes) + 1),
    )
    wider = replace(scene, map=more, world=more, pictured=replace(scene.pictured, state=more))
    draft = suite_on(wider).draw(shot_of(wider, sites[0], ABSENT))
    assert draft.evidence.classes == more.classes
    assert draft.labels[0].classes == state.classes


def twice(bits: np.ndarray) -> np.ndarray:
    """Return bits with an empty class in front."""
    unknown = np.uint32(1 << 31)
    return np.where(bits & unknown, unknown, bits << np.uint32(1))


def test_the_kind_of_a_view_is_that_of_its_own_ground_and_its_group_that_of_its_disc(over):
    scene, sites = over
    seen = set()
    for site in sites:
        for variant in suite_on(scene).variants:
            if variant.kind == VIEW:
                shot = ViewRequest(scene=scene, site=site, variant=variant, seeds=SEEDS.under("site", site.index))
                draft = REAL_IMAGE.draw(shot)
                assert draft.kind == f"R1 {scene.pictured.ground(site.pose, variant.side_m)}"
                assert (draft.group is None) == (variant.radius_m is None)
                seen.add((draft.kind, draft.group and draft.group.name))
    assert {("R1 built", None), ("R1 built", "r250-weak-s3"), ("R1 open", None)} <= seen


def test_a_turned_picture_shows_the_ground_of_the_control(over):
    scene, sites = over
    for site in sites[:4]:
        one, other = (REAL_IMAGE.draw(shot_of(scene, site, kind)) for kind in ("control", TURNED))
        turn = round(other.pose.yaw_deg - site.pose.yaw_deg) % 360
        assert turn in (90, 180, 270)
        # A camera that is turned clockwise by a quarter sees the ground turned counter-clockwise.
        back = np.rot90(one.labels[0].labels, turn // 90, axes=(1, 2))
        assert (back == other.labels[0].labels).mean() > 0.99


def test_frames_lie_around_the_last_one_which_is_the_view_alone(over):
    scene, sites = over
    suite = replace(REAL_IMAGE, variants=REAL_IMAGE.fitting(None))
    variant = next(item for item in suite.variants if item.kind == FRAMES and item.strength == 9)
    site = sites[0]
    alone = REAL_IMAGE.draw(shot_of(scene, site, VIEW, strength=128.0))
    draft = suite.draw(ViewRequest(scene=scene, site=site, variant=variant, seeds=SEEDS.under("site", site.index)))
    assert len(draft.frames) == 9
    assert draft.frames[-1].picture == alone.frames[0].picture
    stands = np.array([(frame.camera.east_m, frame.camera.north_m) for frame in draft.frames])
    assert stands[-1].tolist() == [0.0, 0.0]
    wanted = 64.0 * np.array([(-1, -1), (0, -1), (1, -1), (1, 0), (1, 1), (0, 1), (-1, 1), (-1, 0), (0, 0)])
    off_m = np.hypot(*(stands - wanted).T)
    assert off_m.max() < 20
    assert off_m[:-1].min() > 0  # the odometer drifts


# --- flights


def test_a_flight_over_a_mosaic_stays_on_it_and_shows_where_its_truths_are(village):
    request = request_of(village.spec, village.out, village.folder, suite="flight-real-image", count=2)
    (task,) = make_tasks(request)
    truths = {item.query_id: item for item in read_truths(village.out / "truth" / "flight-real-image" / "village")}
    found = {name: item for name, _, item in read_labels(village.out / "truth" / "flight-real-image" / "village")}
    state, seen, off_m = village.pictured().state, Counter(), {}
    for query in read_queries(task.folder):
        truth = truths[query.query_id]
        assert len(query.frames) == 1
        assert truth.measured["pictured_share"] >= 0.97
        assert truth.pose.northing_m < SOUTH + SHOWN_M - 80
        assert (query.prior.center_m is None) == (query.step.frame > 0)
        house = state.view(truth.pose, size_cells=128, cell_size_m=1.0).layer("building") == PRESENT
        rows = found[query.query_id].labels[0] == PRESENT  # of a picture that is 1.25 times as wide
        middle = rows[32:-32, 32:-32].reshape(128, 2, 128, 2).mean(axis=(1, 3)) > 0.5
        assert (middle == house).mean() > 0.97
        seen[truth.kind] += 1
        off_m.setdefault(truth.kind, []).append(truth)
    assert len(set(seen.values())) == 1
    assert set(seen) == {"no drift", "no drift again", "F10 vo-mono-survey", "F10 vio-mono"}
    poses = [[(one.pose.easting_m, one.pose.yaw_deg) for one in listed] for listed in off_m.values()]
    assert all(sorted(one) == sorted(poses[0]) for one in poses)


# --- tasks on disk


def request_of(spec, out: Path, folder: Path | None = None, **changes) -> Request:
    places = [{"name": spec.id, "half": "a", "regions": [spec.id]}]
    places += [{"name": "other", "half": "a", "regions": ["town-grid"]}]
    places += [{"name": name, "half": "b", "regions": [name]} for name in ("town-suburb", "town-riverside")]
    split = SplitFile(id="own", title="own", kind="crossfit", buffer_m=100.0, place=places)
    known = {name: read_region_file(path) for name, path in list_region_files().items()} | {spec.id: spec}
    settings = {
        "suite": REAL_IMAGE.card.name,
        "region": spec,
        "split": make_split(split, {name: item.grid() for name, item in known.items()}),
        "count": 2,
        "seed": 5,
        "out": out,
        "may_be_fewer": True,
        "extract_folders": () if folder is None else (folder,),
    }
    return Request(**settings | changes)


@pytest.fixture(scope="module")
def drawn(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Root with the queries of a hamlet with imagery, on its map and on the degraded one."""
    folder, out = tmp_path_factory.mktemp("hamlet"), tmp_path_factory.mktemp("out")
    spec = make_hamlet(folder).spec()
    build_region(plan_build(spec, out=out, extract_folders=[folder], imagery_folders=[folder]))
    other = lay_village(out / "files", out, "village", largest_m=192.0, seed=4).spec
    make_tasks(request_of(spec, out, folder, elsewhere=other, extract_folders=(folder, out / "files")))
    return out


def pairs(out: Path, region: str = "hamlet"):
    truths = {item.query_id: item for item in read_truths(out / "truth" / "real-image" / region)}
    return [(query, truths[query.query_id]) for query in read_queries(out / "tasks" / "real-image" / region)]


def test_pictures_show_the_place_that_the_truth_names(drawn):
    found = {(name, at): item for name, at, item in read_labels(drawn / "truth" / "real-image" / "hamlet")}
    state = State.of(read_region(drawn / "regions" / "hamlet"))
    for query, truth in pairs(drawn):
        rows, cols = query.evidence.shape
        assert (query.evidence.cells == UNKNOWN).all()
        labels = found[query.query_id, 0]
        grey = query.frames[0].image().rgb.mean(axis=2)
        house = labels.labels[0] == PRESENT
        # Houses of the mosaic are of another brightness than the ground: the picture shows what its labels say.
        assert abs(grey[house].mean() - grey[~house].mean()) > 10
        if not truth.is_present:
            continue
        planes = np.where(labels.labels == UNKNOWN, np.nan, labels.labels == PRESENT)
        oracle = Segmentation.of_probabilities(labels.classes, planes)
        seen = evidence_of(query.frames, [oracle], size_cells=rows, cell_size_m=query.evidence.cell_size_m)
        mapped = observe(state.bits, state.grid, truth.pose, size_cells=cols, cell_size_m=query.evidence.cell_size_m)
        known = (seen.cells != UNKNOWN) & (mapped != UNKNOWN)
        both, either = (
            op(seen.cells == PRESENT, mapped == PRESENT)[known].sum() for op in (np.logical_and, np.logical_or)
        )
        assert either > 100
        assert both / either > 0.85


def test_a_small_place_has_its_largest_view_in_both_discs_and_another_town_in_one(drawn):
    sites = len({truth.pair_id for _, truth in pairs(drawn)})
    found = Counter((query.prior_group, truth.kind, truth.strength) for query, truth in pairs(drawn))
    assert found == {
        ("r500-weak-s3", "control", 0.0): sites,
        ("r250-weak-s3", "control", 0.0): sites,
        ("r500-weak-s3", TURNED, 0.0): sites,
        ("r500-weak-s3", OWN, 96.0): sites,
        ("r500-weak-s3", ABSENT, 96.0): sites,
        ("r500-weak-s3", "R1 built", 96.0): sites,
        ("r250-weak-s3", "R1 built", 96.0): sites,
    }
    assert {truth.detector for _, truth in pairs(drawn)} == {"real"}
    assert {(truth.kind, truth.strength) for _, truth in pairs(drawn, "hamlet+real-image")} == {(DEGRADED, 96.0)}
    for query, truth in pairs(drawn):
        off_m = [truth.pose.easting_m, truth.pose.northing_m] if truth.pose else [WEST + 192, SOUTH + 192]
        assert np.hypot(*(np.array(query.prior.center_m) - off_m)) <= query.prior.radius_m + 150 * (truth.pose is None)


def test_a_task_names_the_owners_of_all_its_pictures(drawn):
    for region in ("hamlet", "hamlet+real-image"):
        task = Task.open(drawn / "tasks" / "real-image" / region, drawn)
        assert task.manifest.picture_attribution == "(c) somebody with a drone (CC-BY-4.0); (c) village (CC-BY-4.0)"


def test_the_degraded_map_lacks_houses_and_no_site_is_nearer_than_a_view_is_wide(drawn):
    houses = [len(read_region(drawn / "regions" / name).features) for name in ("hamlet", "hamlet+real-image")]
    assert houses[1] == round(0.8 * houses[0])
    assert all(truth.changed_share > 0.1 for _, truth in pairs(drawn, "hamlet+real-image"))
    places = {truth.pair_id: (truth.pose.easting_m, truth.pose.northing_m) for _, truth in pairs(drawn) if truth.pose}
    one, two = places.values()
    assert np.hypot(one[0] - two[0], one[1] - two[1]) >= 96


def test_what_it_cannot_be_drawn_on_or_with_is_refused_in_one_line(tmp_path):
    town = read_region_file(list_region_files()["town-old-town"])
    with pytest.raises(ConfigError, match=r"town-old-town cannot carry suite 'real-image': no real imagery"):
        make_tasks(request_of(town, tmp_path))
    group = replace(REAL_IMAGE.card.group, radius_m=100.0)
    with pytest.raises(ConfigError, match="suite 'real-image' asks discs of 500 and 250 m itself: leave --prior out"):
        make_tasks(request_of(town, tmp_path, group=group))
