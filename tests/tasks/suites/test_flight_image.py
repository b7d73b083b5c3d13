# SPDX-License-Identifier: Apache-2.0
"""Flights in pictures: the weather lasts, each view shows its own place, and a place is painted once for all."""

from dataclasses import replace

import numpy as np
import pytest

from sasgeo_bench.regions.evidence import PRESENT, UNKNOWN
from sasgeo_bench.sensing.segmentation import Segmentation
from sasgeo_bench.tasks.flight_sampling import FlightDrawer
from sasgeo_bench.tasks.frame_evidence import evidence_of
from sasgeo_bench.tasks.suites import pictures
from sasgeo_bench.tasks.suites.base import Choice
from sasgeo_bench.tasks.suites.pictures import ATTITUDE_SIGMA_DEG

NAME = "flight-image"
NOTHING = (np.zeros((8, 8, 3), dtype=np.uint8), np.zeros((13, 8, 8), dtype=np.uint8))  # seen, with its labels


def rgb(query):
    return query.frames[0].image().rgb.astype(float)


@pytest.mark.slow
def test_the_evidence_of_each_view_is_unknown_until_its_labels_show_the_map_at_its_place(flown):
    made = flown(NAME)
    for variant, pairs in made.views.items():
        for query, truth in pairs:
            assert (query.evidence.cells == UNKNOWN).all()
            found = truth.labels[0]
            planes = np.where(found.labels == UNKNOWN, 255, found.labels * 254).astype(np.uint8)
            given = Segmentation(classes=found.classes, probability_bytes=planes)
            seen = evidence_of(query.frames, [given], size_cells=variant.view_cells, cell_size_m=variant.cell_size_m)
            mapped = variant.view(made.airspace.scene.map, truth.pose)
            at, own = seen.classes.index("road_minor"), mapped.classes.index("road_minor")
            known = seen.cells[at] != UNKNOWN
            same = (seen.cells[at] == PRESENT) == (mapped.cells[own] == PRESENT)
            assert known.mean() > 0.5
            assert same[known].mean() > 0.85


@pytest.mark.slow
def test_light_and_season_last_for_a_flight_and_a_falsifier_has_other_noise_alone(flown):
    made = flown(NAME)
    control, falsifier, snow = made.of("control"), made.of("falsifier"), made.of("stress", "F9 snow")
    for (one, _), (other, _) in zip(control, falsifier, strict=True):
        assert one.frames[0].camera == other.frames[0].camera
        assert 0 < np.abs(rgb(one) - rgb(other)).mean() < 8
    assert all(rgb(white).mean() > rgb(green).mean() + 20 for (white, _), (green, _) in zip(snow, control, strict=True))
    assert {query.season for pairs in made.views.values() for query, _ in pairs} == {""}  # nobody tells


def test_weather_is_drawn_once_for_a_flight(flown, monkeypatch):
    made = flown(NAME)
    seen = []
    monkeypatch.setattr(pictures, "render_labelled", lambda *args: seen.append(args[2]) or NOTHING)
    monkeypatch.setattr(pictures, "_painted", lambda *_: None)
    monkeypatch.setattr(pictures.FrameLabels, "of", lambda *_: None)
    drawer = FlightDrawer(airspace=made.airspace, flights={0: made.flight}, choice=Choice(kinds=("F9 snow",)))
    list(drawer.drawn(drawer.jobs([made.flight.site])))
    assert len(seen) == 3 * len(made.flight.views)
    assert len({replace(item, season="summer") for item in seen}) == 1
    assert {item.season for item in seen} == {"summer", "snow"}


def test_cameras_look_straight_down_where_they_are_believed_to_and_nearly_so_in_truth(flown):
    for pairs in flown(NAME).views.values():
        for query, truth in pairs:
            (frame,) = query.frames
            assert frame.camera.tilt_deg == pytest.approx(0.0, abs=1e-6)
            assert 0 < truth.measured["tilt_deg"] < 6 * ATTITUDE_SIGMA_DEG


def test_a_place_is_painted_once_for_all_variants(flown, monkeypatch):
    made, painted = flown(NAME), []
    anything = next(iter(made.airspace.scene.painted.values()))
    monkeypatch.setattr(pictures, "make_scene", lambda *_, window, **__: painted.append(window) or anything)
    monkeypatch.setattr(pictures, "render_labelled", lambda *_: NOTHING)
    scene = replace(made.airspace.scene, painted={})
    drawer = FlightDrawer(airspace=replace(made.airspace, scene=scene), flights={0: made.flight})
    ids = [query.query_id for query, _ in drawer.drawn(drawer.jobs([made.flight.site]))]
    assert len(painted) == len(set(painted)) == len(made.flight.views)
    assert ids == sorted(ids)
    assert len(ids) == 4 * len(made.flight.views)
