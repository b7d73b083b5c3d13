# SPDX-License-Identifier: Apache-2.0
"""What is added to a draft tells nothing of the answer: priors, candidates and ids are the same for all variants."""

from collections import Counter
from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from sasgeo_bench.regions.evidence import Evidence, LayerBits
from sasgeo_bench.tasks import sampling
from sasgeo_bench.tasks.query import TWIN_EAST, TWIN_NORTH
from sasgeo_bench.tasks.sampling import CANDIDATES, LEAST_CANDIDATES, UNANSWERABLE, Drafts, Drawer
from sasgeo_bench.tasks.split import SplitFile, make_split
from sasgeo_bench.tasks.suites.base import QueryDraft
from sasgeo_bench.tasks.suites.mining import STRIDE_M, min_distance_m
from sasgeo_bench.tasks.task_files import query_row

SITES = 2  # of a suite, whose drafts are dear
MORE_SITES = {"alias": 3}  # where chance is judged over few queries of a site
PLACES = ("here", "there", "beyond", "away")


@pytest.fixture(scope="module")
def drawn(carried):
    """A suite on its town, the drawer, and queries and truths at its first sites."""

    @cache
    def of_suite(name):
        made = carried(name)
        grid = made.scene.map.grid
        spec = SplitFile.model_validate(
            {
                "id": "mine",
                "title": "Mine",
                "kind": "crossfit",
                "buffer_m": 0.0,
                "place": [
                    {"name": name, "regions": [name], "half": half} for name, half in zip(PLACES, "abab", strict=True)
                ],
            }
        )

        def far(at):
            return replace(grid, west_m=grid.west_m + 50_000 * at)

        split = make_split(spec, {name: grid if name == "here" else far(at) for at, name in enumerate(PLACES)})
        drawer = Drawer(suite=made.suite, scene=made.scene, seeds=made.seeds, group=made.suite.card.group, split=split)
        jobs = [job for job in drawer.jobs(made.sites[: MORE_SITES.get(name, SITES)]) if drawer.why_not(job) is None]
        return made, drawer, [drawer.draw(job) for job in jobs]

    return of_suite


def by_site(drafts):
    pairs = {}
    for query, truth in drafts:
        pairs.setdefault(truth.pair_id, []).append((query, truth))
    return pairs.values()


@pytest.mark.parametrize("name", ["occlusion", "alias", "instance-twins", "growth"])
def test_control_stress_and_falsifier_of_a_site_share_pose_and_prior(drawn, name):
    _, _, drafts = drawn(name)
    for pair in by_site(drafts):
        assert len({truth.role for _, truth in pair}) > 1
        assert len({truth.pose for _, truth in pair}) == 1
        assert len({query.prior for query, _ in pair}) == 1
        assert len({query.prior_group for query, _ in pair}) == 1


def test_only_without_priors_the_prior_differs_and_the_falsifier_has_that_of_the_control(drawn):
    _, _, drafts = drawn("no-priors")
    for pair in by_site(drafts):
        priors = {(truth.role, query.evidence.shape): query.prior for query, truth in pair}
        assert priors["falsifier", (192, 192)] == priors["control", (192, 192)]
        assert priors["stress", (192, 192)].center_m is None
        assert priors["stress", (192, 192)].yaw_deg is None
        assert priors["control", (192, 192)].scale_sigma == priors["stress", (192, 192)].scale_sigma


def places_of(query):
    return np.array([(pose.easting_m, pose.northing_m) for pose in query.candidates])


def same_places(one, other):
    """How many places of one are also in the other, but for the jitter of both."""
    apart_m = np.abs(one[:, None] - other[None]).max(axis=2)
    return int((apart_m.min(axis=1) <= STRIDE_M + 0.02).sum())


def test_candidates_are_as_many_and_the_same_but_for_what_the_stress_does_to_them(drawn):
    made, _, drafts = drawn("alias")
    for pair in by_site(drafts):
        found = {truth.kind: (places_of(query), truth) for query, truth in pair}
        assert set(found) == {"no copies", "R1 truth removed", "R2 neighbours", "R4 identical blocks"}
        plain, truth = found["no copies"]
        assert LEAST_CANDIDATES <= len(plain) <= max(CANDIDATES)
        twins = len(made.scene.twins[0])
        for kind, same in (("R1 truth removed", len(plain) - twins), ("R4 identical blocks", len(plain) - twins)):
            places, _ = found[kind]
            assert len(places) == len(plain)
            assert same_places(places, plain) == same
            assert not np.isin(places, plain).any()  # another jitter for every query, lest the shared one be the truth
        assert found["R1 truth removed"][1].candidate == -1
        here = np.array([truth.pose.easting_m, truth.pose.northing_m])
        for kind in ("no copies", "R4 identical blocks"):
            places, truth = found[kind]
            assert np.abs(places[truth.candidate] - here).max() <= STRIDE_M / 2 + 0.01
        places, truth = found["R2 neighbours"]
        assert places[truth.candidate] == pytest.approx(here, abs=0.01)
        assert (np.hypot(*(places - here).T) < 11).sum() == 5


@pytest.mark.parametrize("name", ["alias", "topology-twins", "stable-not-distinctive"])
def test_the_truth_is_no_lonelier_than_any_other_candidate(drawn, name):
    _, _, drafts = drawn(name)
    loneliest = []
    for query, truth in drafts:
        if not query.candidates or truth.kind.startswith("R2"):
            continue
        apart_m = np.hypot(*(places_of(query)[:, None] - places_of(query)[None]).transpose(2, 0, 1))
        apart_m[np.eye(len(apart_m), dtype=bool)] = np.inf
        least_m = apart_m.min(axis=1)
        # Both ends are jittered by half a stride at most, either way.
        assert least_m.min() >= min_distance_m(96.0) - np.sqrt(2) * STRIDE_M - 0.1
        if truth.candidate >= 0:
            loneliest.append((int(np.argmax(least_m)) == truth.candidate) - 1 / len(least_m))
    assert loneliest
    assert np.mean(loneliest) < 0.35


def test_a_query_with_too_few_decoys_cannot_be_drawn(drawn):
    made, drawer, _ = drawn("alias")
    job = next(job for job in drawer.jobs(made.sites) if job.track == "retrieval")
    decoys = drawer.mined[made.scene.map.region, 192.0, job.site.index]
    for count, can in ((LEAST_CANDIDATES - 1, False), (LEAST_CANDIDATES, True)):
        far = np.array([(10_000.0 * at, 0.0) for at in range(count)])
        few = replace(decoys, points_m=far, scorer=decoys.scorer[:1] * count)
        mined = {(made.scene.map.region, 192.0, job.site.index): few}
        assert (replace(drawer, mined=mined).why_not(job) is None) == can


def test_a_query_at_a_place_of_which_the_map_shows_next_to_nothing_is_not_asked(drawn):
    made, drawer, drafts = drawn("occlusion")
    grid, shown = made.scene.map.grid, ("road_major", "green", "water")
    jobs = [job for job in drawer.jobs(made.sites[:1]) if job.track == "localization"]
    site, wide, narrow = made.sites[0], *(next(job for job in jobs if job.variant.view_cells == n) for n in (192, 96))
    row, col = grid.to_cells(np.array([[site.pose.easting_m, site.pose.northing_m]]))[0].tolist()

    def blank(name, cells):
        """The map with nothing on it but one class, in a square of so many cells at the site."""
        bits = np.zeros(grid.shape, dtype=np.uint32)
        bits[row : row + cells, col : col + cells] = 1 << shown.index(name)
        state = replace(made.scene.map, classes=shown, bits=LayerBits(bits=bits, count=len(shown)))
        return replace(drawer, scene=replace(made.scene, map=state, world=state))

    reason = "less than 1% of the map is drawn there"
    assert blank("road_major", 9).why_not(narrow) == reason
    assert blank("road_major", 12).why_not(narrow) is None
    assert blank("green", 90).why_not(narrow) == reason  # ground cover is nothing to hold on to
    assert blank("water", 90).why_not(narrow) is None
    assert blank("green", 90).why_not(wide) is None  # a site was chosen by what is drawn in the main view
    assert not any(UNANSWERABLE in truth.measured for _, truth in drafts)


def test_a_query_that_asks_for_a_blank_place_is_marked_and_stays(drawn):
    _, _, drafts = drawn("absent")
    poor = [truth for _, truth in drafts if truth.measured.get("is_real_place") == 1.0]
    assert poor
    assert all(truth.measured[UNANSWERABLE] == 1.0 for truth in poor)


def test_a_truth_says_where_the_twin_of_its_place_lies(drawn):
    made, _, drafts = drawn("topology-twins")
    assert drafts
    for _, truth in drafts:
        site = next(site for site in made.sites if site.pose == truth.pose)
        east_m, north_m = made.scene.twins[site.index][0]
        twin = (
            truth.pose.easting_m + truth.measured[TWIN_EAST],
            truth.pose.northing_m + truth.measured[TWIN_NORTH],
        )
        np.testing.assert_allclose(twin, (east_m, north_m), atol=0.01)


@pytest.mark.parametrize("name", ["topology-twins", "volatile-lure"])
def test_the_disc_of_a_query_holds_the_twin_and_its_truth_says_whether_a_search_lists_both(drawn, name):
    made, _, drafts = drawn(name)
    for query, truth in drafts:
        if query.track == "retrieval":  # the twin is a candidate there
            assert "rivals" not in truth.measured
            continue
        site = next(site for site in made.sites if site.pose == truth.pose)
        for place in (site.en_m, *made.scene.twins[site.index]):
            assert np.hypot(*np.subtract(place, query.prior.center_m)) <= query.prior.radius_m
        measured = truth.measured
        assert (measured["rivals"], measured["rivals_in_disc"]) == (1, 1)
        if truth.role == "stress":
            is_listed = (measured["rivals_listed"], measured["truth_listed"]) == (1, 1)
            assert truth.kind.startswith("unrivalled ") != is_listed


def test_a_control_of_a_board_has_a_twin_outside_its_disc_and_no_rival(drawn):
    _, _, drafts = drawn("controls")
    assert any(query.track == "localization" for query, _ in drafts)
    assert not any("rivals" in truth.measured for _, truth in drafts)


# Priors


def test_the_disc_of_a_view_outside_is_on_the_map_and_far_from_the_view(drawn):
    made, drawer, drafts = drawn("absent")
    share_of = drawer._share_of_disc(made.scene.map)
    for pair in by_site(drafts):
        prior, at = next((query.prior, truth.pose) for query, truth in pair if truth.kind == "outside")
        assert share_of(prior.center_m, prior.radius_m) > 0
        off_m = np.hypot(prior.center_m[0] - at.easting_m, prior.center_m[1] - at.northing_m)
        assert 2 * 192 - 0.2 <= off_m - 500 <= 3 * 192 + 0.2


def test_a_truth_says_how_far_outside_of_the_disc_its_view_lies(drawn):
    _, _, drafts = drawn("absent")
    outside = [(query.prior, truth) for query, truth in drafts if truth.kind == "outside"]
    assert outside
    for prior, truth in outside:
        off_m = np.hypot(prior.center_m[0] - truth.pose.easting_m, prior.center_m[1] - truth.pose.northing_m)
        assert truth.measured["away_m"] == pytest.approx(off_m - 500, abs=0.1)


def test_density_is_of_the_place_that_is_seen_and_likeness_of_the_site_alone(drawn):
    _, _, drafts = drawn("absent")
    for pair in by_site(drafts):
        values = {truth.kind: truth for _, truth in pair}
        site = values["control"].feature_density
        assert values["feature-poor"].feature_density <= 0.003 < site
        assert values["wrong place"].feature_density == values["wrong place"].measured["density"] != site
        assert {values[kind].feature_density for kind in ("outside", "corrupted view")} == {site}
        at_site = {kind for kind, truth in values.items() if truth.alias_index is not None}
        moved = values["feature-poor"].measured["is_real_place"] == 1
        assert at_site == set(values) - {"wrong place"} - ({"feature-poor"} if moved else set())


def test_a_disc_counts_as_much_as_of_it_is_mapped(drawn):
    made, drawer, _ = drawn("absent")
    share_of = drawer._share_of_disc(made.scene.map)
    west, south, east, north = made.scene.map.grid.bounds_m
    middle = (north + south) / 2
    assert share_of(((west + east) / 2, middle), 400.0) == 1
    assert share_of((west, middle), 400.0) == pytest.approx(0.5, abs=0.02)
    assert share_of((west - 500.0, middle), 400.0) == 0


@pytest.mark.parametrize("room_bytes", [0, 10_000, 2**26])
def test_queries_drawn_together_are_those_drawn_one_by_one_whatever_room_there_is(drawn, room_bytes, monkeypatch):
    monkeypatch.setattr(sampling, "KEPT_BYTES", room_bytes)
    made, drawer, _ = drawn("occlusion")
    jobs = drawer.jobs(made.sites[:1])
    assert len({(job.site.index, job.variant) for job in jobs}) == len(jobs) / 2  # two tracks
    for job, (query, truth) in zip(jobs, drawer.drawn(jobs), strict=True):
        alone, its_truth = drawer.draw(job)
        np.testing.assert_array_equal(query.evidence.cells, alone.evidence.cells)
        assert query_row(query) == query_row(alone)
        assert truth == its_truth


def test_a_draft_is_drawn_once_while_there_is_room_and_its_room_is_free_again_after_the_last_who_asks():
    cells, times = np.zeros((2, 8, 8), dtype=np.uint8), []

    def draw():
        times.append(1)
        return QueryDraft(evidence=Evidence(classes=("water", "green"), cells=cells + len(times) % 2, cell_size_m=1.0))

    drafts = Drafts(asked=Counter({"one": 3, "two": 2}), room_bytes=30)
    first = drafts.of("one", 0, draw)
    assert np.array_equal(drafts.of("one", 0, draw).evidence.cells, first.evidence.cells)
    assert len(times) == 1
    assert drafts.room_bytes == 30 - cells.size / 4
    drafts.of("two", 0, draw)
    drafts.of("two", 0, draw)  # there was no room for it
    assert len(times) == 3
    for _ in range(3):
        drafts.leave("one")
    assert drafts.room_bytes == 30
