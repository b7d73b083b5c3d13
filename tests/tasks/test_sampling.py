# SPDX-License-Identifier: Apache-2.0
"""Priors hold what they promise, and neither they nor the candidates tell which place is the true one."""

from dataclasses import replace

import geopandas as gpd
import numpy as np
import pytest
import shapely
from hypothesis import given
from hypothesis import strategies as st
from scipy import stats
from scipy.spatial.distance import cdist

from sasgeo_bench.core.config import shipped_dir
from sasgeo_bench.core.errors import ConfigError
from sasgeo_bench.geometry.pose import Pose, wrap_deg
from sasgeo_bench.osm.features import DTYPES, make_features
from sasgeo_bench.regions import region_files
from sasgeo_bench.regions.build import build_region, plan_build
from sasgeo_bench.regions.region_spec import read_region_file
from sasgeo_bench.tasks.query import RADII_M, SCALE_SIGMAS, YAW_SIGMA_DEG, PriorGroup
from sasgeo_bench.tasks.sampling import CANDIDATES, LEAST_CANDIDATES, Drawer, Job, away, make_prior
from sasgeo_bench.tasks.split import SplitFile, make_split
from sasgeo_bench.tasks.state import State
from sasgeo_bench.tasks.suites import twins, views
from sasgeo_bench.tasks.suites.base import Scene, Seeds, Variant
from sasgeo_bench.tasks.suites.mining import STRIDE_M, min_distance_m
from sasgeo_bench.tasks.suites.sites import choose_sites
from sasgeo_bench.tasks.twin import Paste, paste

SITES = 45
PLACES = ("wide", "far", "farther", "farthest")
UNLIKELY = (
    1e-6  # of a true statement about chance to fail; the draws are seeded, so that a test that holds goes on holding
)

groups = st.builds(
    PriorGroup,
    radius_m=st.sampled_from(RADII_M),
    yaw=st.sampled_from(["known", "weak", "unknown"]),
    scale_sigma=st.sampled_from(SCALE_SIGMAS),
)
poses = st.builds(Pose, easting_m=st.floats(-1e6, 1e6), northing_m=st.floats(-1e6, 1e6), yaw_deg=st.floats(0, 359.999))
seeds = st.integers(0, 2**32 - 1)


def off_m(prior, pose):
    return float(np.hypot(*np.subtract(prior.center_m, (pose.easting_m, pose.northing_m))))


def many_priors(group, *, count=4000):
    pose = Pose(easting_m=500_000.0, northing_m=5_300_000.0, yaw_deg=3.0)
    rng = np.random.default_rng(5)
    return pose, [make_prior(pose, group, rng=rng) for _ in range(count)]


# --- priors ---------------------------------------------------------------------------------------------------------


@given(groups, poses, seeds)
def test_the_truth_lies_in_the_disc_and_what_is_unknown_is_none(group, pose, seed):
    prior = make_prior(pose, group, rng=np.random.default_rng(seed))
    assert (prior.radius_m, prior.scale_sigma) == (group.radius_m, group.scale_sigma)
    assert prior.yaw_sigma_deg == YAW_SIGMA_DEG[group.yaw]
    assert (prior.center_m is None) == (group.radius_m is None)
    assert (prior.yaw_deg is None) == (group.yaw == "unknown")
    assert prior.center_m is None or off_m(prior, pose) <= prior.radius_m
    assert prior.yaw_deg is None or 0 <= prior.yaw_deg < 360


def test_the_truth_lies_in_the_disc_even_if_chance_puts_it_on_the_rim():
    class Rim:
        """Chance at its worst: the largest share of the radius, at any turn."""

        def __init__(self, turn):
            self.turn = turn

        def uniform(self, low, high):
            return low + self.turn * (high - low)

        def random(self):
            return np.nextafter(1.0, 0.0)

        def standard_normal(self):
            return 0.0

    pose = Pose(easting_m=0.04, northing_m=0.06, yaw_deg=0.0)
    group = PriorGroup(radius_m=250.0, yaw="weak", scale_sigma=0.03)
    for turn in np.linspace(0, 1, 200):
        assert off_m(make_prior(pose, group, rng=Rim(turn)), pose) <= 250.0


@given(st.floats(359.9, 359.9999))
def test_a_heading_that_rounds_up_to_a_full_turn_is_zero(yaw_deg):
    class Calm(np.random.Generator):
        """No noise."""

        def standard_normal(self):
            return 0.0

    pose = Pose(easting_m=0.0, northing_m=0.0, yaw_deg=yaw_deg)
    group = PriorGroup(radius_m=None, yaw="known", scale_sigma=0.03)
    prior = make_prior(pose, group, rng=Calm(np.random.PCG64(1)))
    assert 0 <= prior.yaw_deg < 360


def test_the_truth_lies_anywhere_in_the_disc_alike():
    pose, priors = many_priors(PriorGroup(radius_m=500.0, yaw="weak", scale_sigma=0.03))
    east, north = np.subtract([prior.center_m for prior in priors], (pose.easting_m, pose.northing_m)).T
    assert stats.kstest(np.hypot(east, north) ** 2 / 500.0**2, "uniform").pvalue > 1e-3
    assert stats.kstest(np.arctan2(north, east) / (2 * np.pi) + 0.5, "uniform").pvalue > 1e-3


@pytest.mark.parametrize(("yaw", "sigma_deg"), [("known", 5.0), ("weak", 20.0)])
def test_the_heading_is_off_by_the_sigma_that_is_stated(yaw, sigma_deg):
    pose, priors = many_priors(PriorGroup(radius_m=None, yaw=yaw, scale_sigma=0.03))
    off_deg = np.array([float(wrap_deg(prior.yaw_deg - pose.yaw_deg)) for prior in priors])
    assert stats.kstest(off_deg / sigma_deg, "norm").pvalue > 1e-3
    assert off_deg.std() == pytest.approx(sigma_deg, rel=0.05)


DISC = PriorGroup(radius_m=500.0, yaw="weak", scale_sigma=0.03)


def everywhere(center_m, radius_m):
    """Of a map without end, every disc is on the map."""
    del center_m, radius_m
    return 1.0


def test_a_disc_that_is_put_away_has_its_rim_that_far_from_the_truth_in_every_direction():
    pose, priors = many_priors(DISC, count=1000)
    rng = np.random.default_rng(6)
    moved = [away(prior, pose, away_m=384.0, share_of=everywhere, rng=rng) for prior in priors]
    off = np.array([off_m(prior, pose) for prior in moved]) - 500.0
    assert stats.kstest((off - 384.0) / 192.0, "uniform").pvalue > 1e-3
    assert (off.min(), off.max()) == pytest.approx((384.0, 576.0), abs=2.0)
    east, north = np.subtract([prior.center_m for prior in moved], (pose.easting_m, pose.northing_m)).T
    assert stats.kstest(np.arctan2(north, east) / (2 * np.pi) + 0.5, "uniform").pvalue > 1e-3
    assert [replace(prior, center_m=old.center_m) for prior, old in zip(moved, priors, strict=True)] == priors


def test_of_all_ways_to_move_a_disc_that_is_taken_which_leaves_as_much_of_it_on_the_map():
    def east_of_the_coast(center_m, radius_m):
        return min(1.0, max(0.0, (center_m[0] - 499_500.0) / radius_m))

    pose, priors = many_priors(DISC, count=200)
    rng = np.random.default_rng(6)
    for prior in priors:
        moved = away(prior, pose, away_m=384.0, share_of=east_of_the_coast, rng=rng)
        shares = [east_of_the_coast(item.center_m, 500.0) for item in (prior, moved)]
        assert shares[1] == pytest.approx(shares[0], abs=0.2)


def test_without_a_disc_no_place_is_outside():
    pose, (prior,) = many_priors(PriorGroup(radius_m=None, yaw="weak", scale_sigma=0.03), count=1)
    with pytest.raises(ConfigError, match="name one with a disc"):
        away(prior, pose, away_m=384.0, share_of=everywhere, rng=np.random.default_rng(1))


def auc(ours, theirs):
    """How often a number of one kind is larger than one of the other; 0.5 where it tells nothing."""
    return float(stats.mannwhitneyu(ours, theirs).statistic) / (len(ours) * len(theirs))


@pytest.mark.slow
def test_how_much_of_a_disc_is_on_the_map_does_not_tell_whether_the_truth_is_in_it(wide, sites):
    """Of twice 360 discs of 500 m on 2.3 km, the share on the map tells them apart with an AUC of 0.46.

    A disc moved with no thought of the map is told by it with an AUC of 0.17; by how far its centre lies beyond the rim
    with 0.84, now with 0.59: where all of a disc is on the map, it may lie anywhere on it.
    """
    west, south, east, north = wide.scene.map.grid.bounds_m
    share_of = wide._share_of_disc(wide.scene.map)
    rng = np.random.default_rng(3)
    centers = {"inside": [], "outside": [], "anywhere outside": []}
    for site in [site for site in sites for _ in range(8)]:
        prior = make_prior(site.pose, DISC, rng=rng)
        centers["inside"].append(prior.center_m)
        centers["outside"].append(away(prior, site.pose, away_m=384.0, share_of=share_of, rng=rng).center_m)
        centers["anywhere outside"].append(away(prior, site.pose, away_m=384.0, share_of=everywhere, rng=rng).center_m)
    shares = {name: [share_of(center, 500.0) for center in found] for name, found in centers.items()}
    beyond_m = {
        name: [max(west - x, x - east, south - y, y - north) for x, y in found] for name, found in centers.items()
    }
    record = {
        (measure, name): auc(values[name], values["inside"])
        for measure, values in (("share", shares), ("beyond", beyond_m))
        for name in ("outside", "anywhere outside")
    }
    assert record["share", "outside"] == pytest.approx(0.5, abs=0.07), record
    assert record["beyond", "outside"] == pytest.approx(0.5, abs=0.13), record
    assert record["share", "anywhere outside"] < 0.3, record
    assert record["beyond", "anywhere outside"] > 0.7, record


# --- candidates -----------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def wide(tmp_path_factory) -> Drawer:
    """A drawer on a town of two kilometres: room enough for decoys. Only retrieval, no perception errors."""
    folder = tmp_path_factory.mktemp("wide")
    text = (shipped_dir("regions") / "town-grid.toml").read_text()
    for old, new in (("[1024, 1024]", "[2304, 2304]"), ("1536.0", "2560.0"), ("town-grid", "wide")):
        text = text.replace(old, new)
    (folder / "wide.toml").write_text(text)
    spec = read_region_file(folder / "wide.toml")
    plan = plan_build(spec, out=folder)
    build_region(plan)
    places = [{"name": name, "regions": [name], "half": half} for name, half in zip(PLACES, "abab", strict=True)]
    split_file = SplitFile.model_validate(
        {"id": "x", "title": "X", "kind": "crossfit", "buffer_m": 0.0, "place": places}
    )
    grids = {name: replace(plan.grid, north_m=plan.grid.north_m + 50_000 * at) for at, name in enumerate(PLACES)}
    split = make_split(split_file, grids)
    region = region_files.read_region(plan.folder)
    state = State.of(region)
    scene = Scene(map=state, world=state, blocks=split.blocks_in("wide"), view_reach_m=360.0, scenes=("urban",))
    sizes = tuple(Variant(role="control", kind="control", view_cells=cells) for cells in (96, 192))
    suite = replace(views.CLEAN, card=replace(views.CLEAN.card, tracks=("retrieval",)), variants=sizes)
    return Drawer(
        suite=suite, scene=scene, seeds=Seeds(root=1, names=("wide", "x")), group=suite.card.group, split=split
    )


@pytest.fixture(scope="module")
def sites(wide):
    return choose_sites(wide.scene, wide.suite, count=SITES, seeds=wide.seeds, group=wide.group, may_be_fewer=True)


@pytest.fixture(scope="module")
def drawn(wide, sites):
    """Queries with their truths, one for each site and view that has decoys enough."""
    return [wide.draw(job) for job in wide.jobs(sites) if wide.why_not(job) is None]


def points_of(query):
    return np.array([(pose.easting_m, pose.northing_m) for pose in query.candidates])


def hits(drawn, guess):
    """How often a guess that sees the candidates alone is right, and a number that chance would hardly reach."""
    found = [guess(points_of(query)) == truth.candidate for query, truth in drawn]
    chances = [1 / len(query.candidates) for query, _ in drawn]
    # The sum of unequal coins is narrower than this binomial of the same mean.
    return sum(found), stats.binom.isf(UNLIKELY, len(drawn), float(np.mean(chances)))


def nearest_others_m(points):
    apart_m = cdist(points, points)
    np.fill_diagonal(apart_m, np.inf)
    return apart_m.min(axis=1)


def off_lattice_m(points):
    return np.abs((points + STRIDE_M / 2) % STRIDE_M - STRIDE_M / 2).max(axis=1)


GUESSES = {
    "first": lambda at: 0,  # noqa: ARG005
    "last": lambda at: len(at) - 1,
    "nearest to the middle of all": lambda at: np.argmin(np.hypot(*(at - at.mean(axis=0)).T)),
    "nearest to their median": lambda at: np.argmin(np.hypot(*(at - np.median(at, axis=0)).T)),
    "most decimals": lambda at: np.argmax([sum(len(str(value)) for value in point) for point in at.tolist()]),
    "nearest to the lattice": lambda at: np.argmin(np.abs((at + STRIDE_M / 2) % STRIDE_M - STRIDE_M / 2).max(axis=1)),
    "farthest from the lattice": lambda at: np.argmax(
        np.abs((at + STRIDE_M / 2) % STRIDE_M - STRIDE_M / 2).max(axis=1)
    ),
    "westernmost": lambda at: np.argmin(at[:, 0]),
    "northernmost": lambda at: np.argmax(at[:, 1]),
}


@pytest.mark.parametrize("name", GUESSES)
def test_a_guess_that_sees_only_where_candidates_lie_is_at_chance(name, drawn):
    right, bound = hits(drawn, GUESSES[name])
    assert right <= bound


def test_the_loneliest_candidate_is_not_the_true_one(drawn):
    right, bound = hits(drawn, lambda at: np.argmax(nearest_others_m(at)))
    assert right <= bound
    right, bound = hits(drawn, lambda at: np.argmin(nearest_others_m(at)))
    assert right <= bound


def test_candidates_keep_as_far_from_each_other_as_from_the_truth(drawn, wide):
    for query, truth in drawn:
        least_m = min_distance_m(query.evidence.shape[0] * query.evidence.cell_size_m / 2)
        assert nearest_others_m(points_of(query)).min() > least_m - np.sqrt(2) * 2 * STRIDE_M, truth.kind
        assert LEAST_CANDIDATES <= len(query.candidates) <= max(CANDIDATES)
    assert len({len(query.candidates) for query, _ in drawn}) > 1
    assert {query.evidence.shape[0] for query, _ in drawn} == {item.view_cells for item in wide.suite.variants}


def test_no_candidate_lies_where_no_truth_can(drawn, wide):
    west, south, east, north = wide.scene.map.grid.bounds_m
    least_m = wide.suite.clear_m(wide.scene) - STRIDE_M / 2
    margins_m = {True: [], False: []}
    for query, truth in drawn:
        x, y = points_of(query).T
        margin_m = np.min([x - west, east - x, y - south, north - y], axis=0)
        assert margin_m.min() > least_m - wide.scene.map.grid.cell_size_m
        for at, value in enumerate(margin_m.tolist()):
            margins_m[at == truth.candidate].append(value)
    assert auc(margins_m[True], margins_m[False]) == pytest.approx(0.5, abs=0.15), "0.60 on a map of 2.3 km"


def test_a_guess_that_knows_the_truth_is_found_out(drawn):
    answers = iter([truth.candidate for _, truth in drawn])
    right, bound = hits(drawn, lambda _: next(answers))
    assert right == len(drawn) > bound


def test_remainders_on_the_lattice_of_the_decoys_are_those_of_the_truth(drawn):
    right = np.concatenate([points_of(query)[truth.candidate] for query, truth in drawn])
    wrong = np.concatenate([np.delete(points_of(query), truth.candidate, axis=0).ravel() for query, truth in drawn])
    assert stats.ks_2samp(right % STRIDE_M, wrong % STRIDE_M).pvalue > 1e-3
    decimals = [np.abs(values * 100 - np.rint(values * 100)).max() for values in (right, wrong)]
    assert max(decimals) < 1e-3


def test_many_queries_of_a_site_do_not_tell_the_truth_by_the_mean_places_of_its_candidates(wide, sites):
    """Each query jitters its candidates anew; what is left in the mean must not be the lattice of the decoys."""
    views = tuple(Variant(role="stress", kind="perception", strength=at, view_cells=96) for at in range(10))
    drawer = replace(wide, suite=replace(wide.suite, variants=views), mined={})
    rights, chances = [0, 0], []
    for site in sites[:30]:
        drawn = [
            drawer.draw(Job(query_id="q", site=site, variant=view, track="retrieval")) for view in drawer.suite.variants
        ]
        first = points_of(drawn[0][0])
        found = [points_of(query) for query, _ in drawn]
        assert len({tuple(at[0]) for at in found}) == len(found), "jittered anew for every query"
        means = np.mean([at[cdist(first, at).argmin(axis=1)] for at in found], axis=0)
        assert np.hypot(*(means - first).T).max() < STRIDE_M, "the same places"
        off_m = off_lattice_m(means - drawer.windows[drawer.scene.map.region, 96.0].points_m[0])
        for at, guess in enumerate((off_m.argmin(), off_m.argmax())):
            rights[at] += int(guess == drawn[0][1].candidate)
        chances.append(1 / len(first))
    assert max(rights) <= stats.binom.isf(UNLIKELY, len(chances), float(np.mean(chances))), rights


def test_candidates_are_shuffled_anew_for_every_query_of_a_site(wide, sites):
    views = tuple(Variant(role="stress", kind="perception", strength=at, view_cells=96) for at in range(8))
    drawer = replace(wide, suite=replace(wide.suite, variants=views), mined={})
    answers = [
        drawer.draw(Job(query_id="q", site=sites[1], variant=view, track="retrieval"))[1].candidate for view in views
    ]
    assert len(set(answers)) > 2


def test_the_place_of_the_truth_in_the_list_is_any_alike(drawn):
    ranks = [(truth.candidate + 0.5) / len(query.candidates) for query, truth in drawn]
    assert stats.kstest(ranks, "uniform").pvalue > 1e-3


def test_the_true_candidate_lies_near_the_truth_and_not_on_it(drawn):
    for query, truth in drawn:
        off = points_of(query)[truth.candidate] - (truth.pose.easting_m, truth.pose.northing_m)
        assert np.abs(off).max() <= STRIDE_M / 2 + 0.01
        assert np.abs(off).max() > 0.05
        apart_m = cdist(points_of(query), [(truth.pose.easting_m, truth.pose.northing_m)])[:, 0]
        assert int(np.argmin(apart_m)) == truth.candidate


def test_a_retrieval_query_has_no_disc_and_its_candidates_share_the_heading_of_its_prior(drawn):
    assert drawn
    for query, _ in drawn:
        assert query.prior.center_m is None
        assert query.prior.radius_m is None
        assert query.prior_group.startswith("rnone-")
        assert {pose.yaw_deg for pose in query.candidates} == {query.prior.yaw_deg}
        assert {pose.scale for pose in query.candidates} == {1.0}


def test_a_localization_query_has_a_disc_and_no_candidates(wide, sites):
    job = Job(query_id="q", site=sites[0], variant=wide.suite.variants[0], track="localization")
    query, truth = wide.draw(job)
    assert query.candidates == ()
    assert truth.candidate == -1
    assert off_m(query.prior, truth.pose) <= query.prior.radius_m == wide.group.radius_m


def test_there_are_as_many_candidates_with_the_truth_and_twins_as_without_them(wide, sites):
    kinds = {variant.kind[:2]: variant for variant in twins.ALIAS.variants if not variant.kind.startswith("R2")}
    copies = {site.index: ((site.pose.easting_m + 700.0, site.pose.northing_m),) for site in sites}
    drawer = replace(wide, suite=twins.ALIAS, scene=replace(wide.scene, twins=copies), windows={}, mined={})
    seen = set()
    for site in sites[:9]:
        jobs = {
            kind: Job(query_id="q", site=site, variant=variant, track="retrieval") for kind, variant in kinds.items()
        }
        if drawer.why_not(jobs["no"]):
            continue
        answers = {kind: drawer.draw(job) for kind, job in jobs.items()}
        (count,) = {len(query.candidates) for query, _ in answers.values()}
        assert LEAST_CANDIDATES <= count <= max(CANDIDATES)
        assert {kind: truth.candidate >= 0 for kind, (_, truth) in answers.items()} == {"no": 1, "R1": 0, "R4": 1}
        assert not answers["R1"][1].is_present
        for kind, (query, _) in answers.items():
            is_near = np.hypot(*(points_of(query) - copies[site.index]).T) < STRIDE_M
            assert is_near.sum() == (kind != "no")
        seen.add(count)
    assert len(seen) > 1


def test_in_a_cluster_of_neighbours_any_of_them_may_be_the_true_one(wide, sites):
    variant = next(item for item in twins.ALIAS.variants if item.kind.startswith("R2"))
    drawer = replace(wide, suite=twins.ALIAS, windows={}, mined={})
    offsets = []
    for site in sites:
        job = Job(query_id="q", site=site, variant=variant, track="retrieval")
        if drawer.why_not(job) is None:
            query, truth = drawer.draw(job)
            points = points_of(query)
            assert len(points) % 5 == 0
            own = points[np.hypot(*(points - points[truth.candidate]).T) < 15]
            assert len(own) == 5
            offsets.append(tuple((points[truth.candidate] - own.mean(axis=0)).round(1).tolist()))
    assert set(offsets) == {(0.0, 0.0), (5.0, 0.0), (-5.0, 0.0), (0.0, 5.0), (0.0, -5.0)}


def test_ids_are_unique_and_sorted_and_their_order_is_not_that_of_the_sites(wide, sites):
    jobs = wide.jobs(sites)
    names = [job.query_id for job in jobs]
    assert names == sorted(set(names))
    assert all(len(name) == 24 and set(name) <= set("0123456789abcdef") for name in names)
    order = [job.site.index for job in jobs]
    assert abs(stats.spearmanr(np.arange(len(order)), order).statistic) < 4 / np.sqrt(len(order))
    other = replace(wide, seeds=replace(wide.seeds, root=2)).jobs(sites)
    assert not set(names) & {job.query_id for job in other}


def test_what_was_pasted_does_not_say_by_its_rows_or_numbers_which_place_is_the_original():
    houses = [shapely.box(x, y, x + 8, y + 6) for x in range(0, 60, 20) for y in range(0, 60, 20)]
    count = len(houses)
    base = {name: [0] * count for name in DTYPES} | {
        "osm_type": ["way"] * count,
        "osm_id": list(range(100, 100 + count)),
        "class": ["building"] * count,
        "timestamp": [None] * count,
        "geometry": houses,
    }
    features = make_features(base, epsg=32632)
    own = Paste(source_m=(30.0, 30.0), target_m=(30.0, 30.0), radius_m=25.0)
    east, west = (replace(own, target_m=(30.0 + shift, 30.0)) for shift in (500.0, -500.0))
    table = paste(features, [own, east, west])
    pasted = table[table["osm_id"] >= 100 + count]
    middles = np.asarray(pasted.geometry.centroid.x)
    assert (np.diff(middles // 500) >= 0).all(), "rows run from west to east, whichever is the original"
    assert pasted["osm_id"].is_unique
    old = table[table["osm_id"] < 100 + count]
    assert not (shapely.distance(old.geometry.to_numpy(), shapely.Point(30, 30)) < 24.9).any(), "an arc of chords"
    assert isinstance(table, gpd.GeoDataFrame)
