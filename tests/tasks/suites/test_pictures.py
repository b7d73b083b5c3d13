# SPDX-License-Identifier: Apache-2.0
"""Suites of pictures: flights are those of their cards, and a drawn query shows the place that its truth names."""

from dataclasses import replace
from itertools import product

import numpy as np
import pytest

from sasgeo_bench.geometry.pose import Pose
from sasgeo_bench.regions.evidence import PRESENT, UNKNOWN
from sasgeo_bench.sensing.rendering.conditions import Conditions
from sasgeo_bench.sensing.segmentation import Segmentation
from sasgeo_bench.tasks.frame_evidence import evidence_of
from sasgeo_bench.tasks.suites import pictures
from sasgeo_bench.tasks.suites.all_suites import PICTURE_SUITES, SUITES, find_suite
from sasgeo_bench.tasks.suites.base import EVERYTHING, Choice, Seeds, Site, Variant, ViewRequest
from sasgeo_bench.tasks.suites.pictures import STOPS_M, Flight, PictureSuite, camera_beliefs

ALIKE = ("corrupted", "real-image", "corrupted-real")  # all pictures of these are taken alike
SMALL = Variant(role="control", kind="control", view_cells=48, detector="rendered")


def suite_of(**flight):
    """A suite of small pictures from low above, which are painted at once."""
    made = PICTURE_SUITES["aerial"]
    return replace(made, flight=lambda _: Flight(**{"height_m": 40.0} | flight))


@pytest.fixture(scope="module")
def place(scene):
    town = scene("town-grid")
    middle = town.map.grid.bounds_m
    pose = Pose(easting_m=middle[0] + 480.0, northing_m=middle[1] + 520.0, yaw_deg=60.0)
    block = next(block for block in town.blocks if block.holds((pose.easting_m, pose.northing_m)))
    return replace(town, painted={}), Site(index=0, pose=pose, block=block.id, density=0.2)


def shot_of(place, variant=SMALL, **site):
    scene, where = place
    return ViewRequest(scene=scene, site=replace(where, **site), variant=variant, seeds=Seeds(root=1, names=("here",)))


def test_no_suite_of_pictures_is_drawn_unless_it_is_named():
    assert not set(PICTURE_SUITES) & set(SUITES)


@pytest.mark.parametrize("name", [name for name in PICTURE_SUITES if name not in ALIKE])
def test_every_suite_has_a_control_a_ladder_and_a_falsifier_that_flies_as_the_control(name):
    suite = PICTURE_SUITES[name]
    assert isinstance(suite, PictureSuite)
    roles = [variant.role for variant in suite.variants]
    assert (roles.count("control"), roles.count("falsifier")) == (1, 1)
    assert roles.count("stress") >= 3
    control, falsifier = (
        next(item for item in suite.variants if item.role == role) for role in ("control", "falsifier")
    )
    one, other = suite.flight(control), suite.flight(falsifier)
    ordinary = Conditions()
    assert one.conditions(ordinary) == other.conditions(ordinary)
    assert (one.height_m, one.tilt_deg, one.is_fixed, one.relief, one.overlap) == (
        other.height_m,
        other.tilt_deg,
        other.is_fixed,
        other.relief,
        other.overlap,
    )
    assert set(other.stops_m) == set(one.stops_m)
    flights = [suite.flight(item) for item in suite.variants if item.role == "stress"]
    values = {
        (
            item.height_m,
            item.tilt_deg,
            item.is_fixed,
            item.relief,
            item.overlap,
            item.stops_m,
            item.odometry,
            item.conditions(ordinary),
        )
        for item in flights
    }
    assert len(values) == len(flights)


def test_overlap_scale_and_tilt_are_asked_each_with_each_and_the_control_has_none_of_them():
    suite = pictures.OVERLAP_SCALE_TILT
    flights = {item: suite.flight(item) for item in suite.variants}
    asked = [
        (flight.overlap, flight.height_m / 160, flight.tilt_deg)
        for item, flight in flights.items()
        if item.role != "falsifier"
    ]
    assert sorted(asked) == sorted(product((1.0, 0.7, 0.4), (1.0, 1.5, 2.0), (0.0, 20.0, 40.0)))
    (control,) = (flight for item, flight in flights.items() if item.role == "control")
    assert (control.overlap, control.height_m, control.tilt_deg) == (1.0, 160.0, 0.0)
    assert {item.strength for item in flights if item.role == "stress"} == {1.0, 1.5, 2.0}


@pytest.mark.slow
@pytest.mark.parametrize("share", [0.7, 0.4])
@pytest.mark.parametrize("height_m", [40.0, 80.0])
def test_beside_its_overlap_a_view_shows_nothing_that_the_map_has_there(place, share, height_m):
    whole, part = (suite_of(height_m=height_m, overlap=overlap) for overlap in (1.0, share))
    lost_sides = set()
    for seed in range(6):
        shot = replace(shot_of(place), seeds=Seeds(root=seed, names=("here",)))
        control, draft = whole.draw(shot), part.draw(shot)
        one, other = (item.labels[0].labels for item in (control, draft))
        cols = one.shape[2]
        across_m = (np.arange(cols) + 0.5) / cols * height_m * 1.25 - height_m * 0.625  # of the optical axis
        same = (one == other).all(axis=(0, 1))
        edge_m = (share - 0.5) * 48
        kept_left, kept_right = across_m < edge_m - 0.1, across_m > 0.1 - edge_m
        is_left = bool(same[kept_left].all())
        assert is_left or same[kept_right].all()
        lost_sides.add(is_left)
        lost = ~kept_left & (across_m > edge_m + 0.1) if is_left else ~kept_right & (across_m < -edge_m - 0.1)
        np.testing.assert_array_equal(other[:, :, lost], one[:, :, ::-1][:, :, lost])
        taken, shown = (item.frames[0].image().rgb.astype(float) for item in (control, draft))
        wanted = np.where(lost[None, :, None], taken[:, ::-1], taken)
        assert np.abs(shown - wanted)[:, np.abs(np.abs(across_m) - abs(edge_m)) > 1].mean() < 4  # WebP
        assert control.frames[0].camera == draft.frames[0].camera
    assert lost_sides == {True, False}


def test_a_model_of_perception_sees_no_more_of_the_map_than_the_overlap(place):
    suite, shot = suite_of(overlap=0.4), shot_of(place, replace(SMALL, detector="published"))
    mirrored = shot.clean().cells.copy()
    lost = slice(round(0.4 * 48), None)
    mirrored[:, :, lost] = mirrored[:, :, ::-1][:, :, lost]
    turned = shot.clean().cells.copy()
    turned[:, :, : 48 - round(0.4 * 48)] = turned[:, :, ::-1][:, :, : 48 - round(0.4 * 48)]
    expected = [shot.perceived(shot.clean().replace(cells)).cells for cells in (mirrored, turned)]
    assert any((suite.draw(shot).evidence.cells == cells).all() for cells in expected)


def test_the_highest_camera_of_the_grid_looks_at_mapped_ground_alone(place):
    wide = pictures.OVERLAP_SCALE_TILT.clear_m(place[0])
    assert wide == pytest.approx(np.hypot(200.0, 200.0), rel=0.01)


def test_the_sun_sinks_and_the_air_thickens_along_the_ladder():
    def of(kind, share):
        variant = Variant(role="stress", kind=kind, strength=share)
        return pictures.LIGHT.flight(variant).conditions(Conditions())

    suns = [of(pictures.SUN, share).sun.elevation_deg for share in pictures.STRENGTHS]
    assert suns == sorted(suns, reverse=True)
    assert suns[-1] == 5.0
    assert of(pictures.DUSK, 1.0).sun.elevation_deg == -8.0
    assert of(pictures.HAZE, 1.0).visibility_m == pytest.approx(500.0)


def test_a_camera_fixed_to_the_body_tilts_as_was_measured(place):
    variant = next(item for item in pictures.OBLIQUE.variants if item.kind == pictures.BODY)
    tilts = []
    for index in range(400):
        shot = replace(shot_of(place, variant), seeds=Seeds(root=1, names=("here", str(index))))
        tilts.append(camera_beliefs(shot, pictures.OBLIQUE.flight(variant))[0].believed.tilt_deg)
    median, high = np.quantile(tilts, (0.5, 0.95))
    assert abs(median - 9.6) < 1.0
    assert abs(high - 20.5) < 2.5


def test_a_true_camera_is_off_by_what_is_declared_and_flies_at_the_scale_of_its_view(place):
    pose = replace(place[1].pose, scale=1.05)
    off = []
    for index in range(300):
        shot = replace(shot_of(place, pose=pose), seeds=Seeds(root=1, names=("here", str(index))))
        stand = camera_beliefs(shot, Flight(height_m=100.0))[0]
        off.append(stand.true.tilt_deg)
        assert stand.true.height_m == pytest.approx(105.0)
        assert stand.believed.tilt_deg == pytest.approx(0.0)
    assert np.sqrt(np.mean(np.square(off)) / 2) == pytest.approx(1.0, rel=0.15)


def test_nine_stops_end_where_the_query_is_and_drift_by_what_they_declare(place):
    stands = camera_beliefs(shot_of(place), Flight(stops_m=STOPS_M))
    assert (stands[-1].believed.east_m, stands[-1].believed.north_m) == pytest.approx((0.0, 0.0))
    assert stands[-1].position_sigma_m == 0.0
    for stop, stand in zip(STOPS_M, stands, strict=True):
        assert np.hypot(stand.believed.east_m - stop[0], stand.believed.north_m - stop[1]) < 12.0
    assert stands[0].position_sigma_m == pytest.approx(0.01 * np.hypot(*STOPS_M[0]), abs=1e-3)


def test_what_is_on_a_picture_is_what_the_map_shows_there_and_its_evidence_lies_where_the_truth_says(place):
    shot = shot_of(place)
    suite = suite_of()
    draft = suite.draw(shot)
    assert (draft.evidence.cells == UNKNOWN).all()
    assert draft.evidence.confidence is None
    labels = draft.labels[0].labels
    planes = np.where(labels == UNKNOWN, np.nan, labels == PRESENT)
    oracle = Segmentation.of_probabilities(draft.labels[0].classes, planes)
    found = evidence_of(draft.frames, [oracle], size_cells=48, cell_size_m=1.0)
    clean = shot.clean()
    for name in ("building", "road_minor"):
        seen, mapped = found.layer(name), clean.layer(name)
        known = seen != UNKNOWN
        both = ((seen == PRESENT) & (mapped == PRESENT) & known).sum()
        either = (((seen == PRESENT) | (mapped == PRESENT)) & known).sum()
        if either > 100:
            assert both / either > 0.6, name
    assert known.mean() > 0.5


def test_pictures_of_one_site_differ_by_the_stress_alone_and_a_falsifier_is_another_picture_of_the_same(place):
    suite = suite_of()
    control = suite.draw(shot_of(place))
    again = suite.draw(shot_of(place, replace(SMALL, role="falsifier", kind="same height")))
    assert control.frames[0].camera == again.frames[0].camera
    np.testing.assert_array_equal(control.labels[0].labels, again.labels[0].labels)
    assert control.frames[0].picture != again.frames[0].picture
    assert suite.draw(shot_of(place)).frames == control.frames
    shifted = suite.draw(shot_of(place, replace(SMALL, detector="shifted")))
    assert shifted.frames[0].picture != control.frames[0].picture


def test_a_suite_of_pictures_draws_looks_and_the_others_draw_detectors():
    aerial, real, clean = PICTURE_SUITES["aerial"], PICTURE_SUITES["real-image"], SUITES["clean"]
    assert aerial.drawn_by(EVERYTHING.detectors) == ("rendered",)
    assert aerial.drawn_by(("rendered", "shifted")) == ("rendered", "shifted")
    assert real.drawn_by(EVERYTHING.detectors) == ("real",)
    assert clean.drawn_by(("published", "rendered")) == ("published",)


@pytest.mark.parametrize(
    ("name", "detectors", "words"),
    [
        ("aerial", ("real",), "is not drawn by 'real': it has rendered, shifted, published, measured"),
        ("real-image", ("rendered",), "is not drawn by 'rendered': it has real"),
        ("clean", ("rendered", "shifted"), "is not drawn by 'rendered', 'shifted': it has published, measured"),
        ("aerial", ("measured", "shifted"), None),
    ],
)
def test_detectors_that_a_suite_does_not_have_are_refused(name, detectors, words):
    found = Choice(detectors=detectors).lack(find_suite(name))
    assert (found is None) if words is None else (words in found)


def test_a_model_of_perception_sees_the_same_view_without_a_picture(place):
    shot = shot_of(place, replace(SMALL, detector="published"))
    draft = suite_of().draw(shot)
    assert draft.frames == ()
    assert (draft.evidence.cells == shot.perceived().cells).all()
