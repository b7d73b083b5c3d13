# SPDX-License-Identifier: Apache-2.0
"""Corrupted pictures: the ground, the camera and the labels of their control, behind a fault that grows."""

from collections import Counter
from dataclasses import replace

import numpy as np
import pytest

from sasgeo_bench.geometry.pose import Pose
from sasgeo_bench.regions.build import build_region, plan_build
from sasgeo_bench.sensing.corruptions import COMPOUNDS, CORRUPTIONS, corrupt
from sasgeo_bench.tasks.build import make_tasks
from sasgeo_bench.tasks.frame_files import read_labels
from sasgeo_bench.tasks.frames import encode_webp
from sasgeo_bench.tasks.suites.base import Choice, Seeds, Site, Variant, ViewRequest
from sasgeo_bench.tasks.suites.corrupted import CORRUPTED, CORRUPTED_REAL, KINDS, corrupted
from sasgeo_bench.tasks.suites.pictures import Flight
from sasgeo_bench.tasks.suites.real_image import TURNED
from sasgeo_bench.tasks.task_files import read_queries, read_truths
from tests.regions.imagery_place import make_hamlet
from tests.slow import rest_slow
from tests.tasks.suites.test_real_image import request_of

SMALL = Variant(role="control", kind="control", view_cells=48, detector="rendered")
SEEDS = Seeds(root=1, names=("here",))


@pytest.fixture(scope="module")
def place(scene):
    town = scene("town-grid")
    west, south, _, _ = town.map.grid.bounds_m
    pose = Pose(easting_m=west + 480.0, northing_m=south + 520.0, yaw_deg=60.0)
    block = next(block for block in town.blocks if block.holds((pose.easting_m, pose.northing_m)))
    return replace(town, painted={}), Site(index=0, pose=pose, block=block.id, density=0.2)


def shot_of(place, kind: str = "control", severity: int = 0, *, seeds: Seeds = SEEDS) -> ViewRequest:
    scene, site = place
    role = "stress" if severity else "control"
    variant = replace(SMALL, role=role, kind=kind, strength=float(severity))
    return ViewRequest(scene=scene, site=site, variant=variant, seeds=seeds)


@pytest.mark.parametrize("suite", [CORRUPTED, CORRUPTED_REAL], ids=lambda suite: suite.card.name)
def test_every_corruption_is_asked_at_three_severities_beside_a_control_and_a_falsifier(suite):
    roles = Counter(item.role for item in suite.variants)
    assert roles == {"control": 1, "stress": 27 * 3, "falsifier": 1}
    assert {item.view_cells for item in suite.variants} == {192}
    ladders = {kind: [item.strength for item in suite.variants if item.kind == kind] for kind in KINDS}
    assert set(map(tuple, ladders.values())) == {(1.0, 2.0, 3.0)}
    assert sorted(KINDS.values()) == sorted((*CORRUPTIONS, *COMPOUNDS))
    assert len({item.name for item in suite.variants}) == len(suite.variants)


@pytest.mark.parametrize(
    ("family", "kinds"), [("weather", 4), ("motion", 4), ("sensor", 7), ("compression", 4), ("compound", 8)]
)
def test_a_family_is_chosen_by_its_name(family, kinds):
    chosen = Choice(kinds=(family,))
    assert chosen.lack(CORRUPTED) is None
    some = [item for item in CORRUPTED.variants if item.role == "stress" and chosen.takes(item, "localization")]
    assert len(some) == 3 * kinds


@pytest.mark.parametrize("kind", rest_slow(list(KINDS)[::3], but=3))
def test_the_picture_of_a_query_is_that_of_the_camera_corrupted_and_all_else_is_that_of_its_control(place, kind):
    taken = []

    def keep(shot, picture):
        taken.append(picture)
        return corrupted(shot, picture)

    suite = replace(CORRUPTED, flight=lambda _: Flight(height_m=40.0), change=keep)
    shot, control = shot_of(place, kind, 2), suite.draw(shot_of(place))
    draft = suite.draw(shot)
    wanted = corrupt(taken[1], KINDS[kind], severity=2, rng=SEEDS.rng("corruption", kind))
    assert draft.frames[0].picture == encode_webp(wanted) != encode_webp(taken[1])
    assert control.frames[0].picture == encode_webp(taken[0])
    assert replace(draft.frames[0], picture=b"") == replace(control.frames[0], picture=b"")
    np.testing.assert_array_equal(draft.labels[0].labels, control.labels[0].labels)
    assert (draft.evidence.cells == control.evidence.cells).all()
    assert (draft.pose, draft.is_present) == (control.pose, control.is_present)


def test_a_higher_severity_has_the_same_faults_and_more_and_another_site_has_others(place):
    picture = np.random.default_rng(1).integers(60, 200, (160, 160, 3), dtype=np.uint8)
    for kind in ("sensor dead lines", "sensor impulse noise", "compression packet loss"):
        hit = [(corrupted(shot_of(place, kind, severity), picture) != picture).any(axis=2) for severity in (1, 2, 3)]
        assert 0 < hit[0].sum() < hit[1].sum() < hit[2].sum()
        assert not (hit[0] & ~hit[1]).any()
        assert not (hit[1] & ~hit[2]).any()
        elsewhere = corrupted(shot_of(place, kind, 2, seeds=SEEDS.under("site", 3)), picture)
        assert ((elsewhere != picture).any(axis=2) != hit[1]).any()
    for variant in (item for item in CORRUPTED.variants if item.role != "stress"):
        assert corrupted(replace(shot_of(place), variant=variant), picture) is picture


# --- real pictures


@pytest.fixture(scope="module")
def hamlet(tmp_path_factory):
    """A root with the queries of a hamlet with imagery, and its region file."""
    folder, out = tmp_path_factory.mktemp("hamlet"), tmp_path_factory.mktemp("out")
    spec = make_hamlet(folder).spec()
    build_region(plan_build(spec, out=out, extract_folders=[folder], imagery_folders=[folder]))
    make_tasks(request_of(spec, out, folder, suite=CORRUPTED_REAL.card.name, count=1))
    return out


@pytest.mark.slow
def test_real_pictures_of_a_site_show_one_place_and_one_ground_and_lose_more_at_each_severity(hamlet):
    name = CORRUPTED_REAL.card.name
    truths = {item.query_id: item for item in read_truths(hamlet / "truth" / name / "hamlet")}
    labels = {query: item.labels for query, _, item in read_labels(hamlet / "truth" / name / "hamlet")}
    queries = {item.query_id: item for item in read_queries(hamlet / "tasks" / name / "hamlet")}
    found = {(truth.role, truth.kind, truth.strength): query_id for query_id, truth in truths.items()}
    assert len(found) == len(truths) == len(CORRUPTED_REAL.variants)
    control = found["control", "control", 0.0]
    seen = {key: queries[at].frames[0].image().rgb.astype(float) for key, at in found.items()}
    for key, at in found.items():
        assert queries[at].evidence.shape == (96, 96)  # the largest view that the hamlet allows
        assert queries[at].frames[0].camera == queries[control].frames[0].camera
        if key[0] == "stress":
            assert truths[at].pose == truths[control].pose
            np.testing.assert_array_equal(labels[at], labels[control])
    turned = found["falsifier", TURNED, 0.0]
    assert (labels[turned] != labels[control]).any()
    assert truths[turned].pose.yaw_deg != truths[control].pose.yaw_deg
    for kind in KINDS:
        clean = seen["control", "control", 0.0]
        steps = [np.abs(seen["stress", kind, severity] - clean).mean() for severity in (1.0, 2.0, 3.0)]
        assert steps == sorted(steps), kind
        assert steps[0] < 0.95 * steps[-1], kind


def test_a_prior_may_be_chosen_and_views_fit_what_a_region_allows():
    assert CORRUPTED_REAL.refusal(CORRUPTED_REAL.card.group) is None
    for largest_m, side_m in ((None, 192.0), (300.0, 192.0), (150.0, 128.0), (96.0, 96.0), (60.0, 96.0)):
        fitting = CORRUPTED_REAL.fitting(largest_m)
        assert {item.side_m for item in fitting} == {side_m}
        assert [item.strength for item in fitting] == [item.strength for item in CORRUPTED_REAL.variants]
