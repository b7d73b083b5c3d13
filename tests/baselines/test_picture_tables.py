# SPDX-License-Identifier: Apache-2.0
"""Tables of the experiment on pictures, of rows that are counted by hand; and whose weights are adapted."""

import argparse

import numpy as np
import pandas as pd
import pytest
from sasgeo_baselines.segmenters.osm_unet import HELD_OUT_WEIGHTS, WEIGHTS

import sasgeo_bench as sgb
from benchmarks.pictures import (
    ADAPTED,
    AFTER,
    BEFORE,
    PERFECT,
    adapted,
    by_place,
    chances,
    check_names,
    read_answers,
    spoilt,
)
from benchmarks.real_pictures import SCALES, Scaled, box_of, weights_of
from sasgeo_bench.sensing.camera import Camera, Intrinsics


def views(way, hits, *, kind="R1 built", region="hamlet-ortho"):
    """Rows of single views of 256 m in a disc of 250 m, a site each."""
    return pd.DataFrame(
        {
            "segmenter": way.segmenter,
            "matcher": way.matcher,
            "region": region,
            "kind": kind,
            "side_m": 256.0,
            "radius_m": 250.0,
            "pair_id": [f"{kind} {number}" for number in range(len(hits))],
            "hit": [float(hit) for hit in hits],
        }
    )


def cells(line):
    return [cell.strip() for cell in line.strip("|").split("|")]


def test_places_have_a_row_for_the_town_and_one_for_all_ground_with_every_way():
    rows = [
        views(AFTER, [1, 1, 1, 0]),
        views(AFTER, [0], kind="R1 open"),
        views(AFTER, [1], kind="R5 frames"),  # no single view
        views(BEFORE, [1, 0, 0, 0]),
        views(PERFECT, [1, 1, 1, 1]),
    ]
    _, _, town, every = map(cells, by_place(pd.concat(rows, ignore_index=True)))
    assert town[:5] == ["hamlet-ortho", "built, mixed", "256", "250", "4"]
    assert town[5] == "75"
    assert town[7:] == ["25", "-", "-", "-", "100"]
    assert every[1:5] == ["all", "256", "250", "5"]
    assert every[5] == "60"
    assert town[6] == "30 to 95"  # Wilson's of 3 in 4


def test_what_shares_gain_and_lose_is_counted_view_by_view():
    after, by_shares = views(AFTER, [1, 1, 0, 0]), views(ADAPTED, [1, 0, 1, 1])
    lines = list(map(cells, adapted(pd.concat([after, by_shares], ignore_index=True))))
    assert lines[2:] == [["hamlet-ortho", "256", "250", "4", "50", "75", "2", "1"]]


def test_faults_are_counted_by_family():
    rows = [
        views(AFTER, [1, 0], kind=kind).assign(suite="corrupted-real", strength=2.0, role="stress")
        for kind in ("weather fog", "weather rain", "compound fog + jpeg")
    ]
    lines = list(map(cells, spoilt(pd.concat(rows, ignore_index=True))))
    assert lines[2:] == [["compound", "2", "2", "50"], ["weather", "2", "4", "50"]]


def test_chances_are_counted_in_bins_and_by_what_half_of_the_right_answers_cost():
    rows = [  # p_right, is_right, is_present
        *[(0.99, True, True)] * 3,
        (0.9, False, True),
        (0.3, True, True),
        (0.1, False, True),
        (0.2, False, False),
        (0.995, False, False),
    ]
    frame = pd.DataFrame(rows, columns=["p_right", "is_right", "is_present"])
    frame = frame.assign(
        is_answered=True, region="hamlet-ortho", role="stress", pair_id=[f"s{number}" for number in range(len(rows))]
    )
    lines = [cells(line) for line in chances(frame)]
    bins = {line[0]: line[1:4] for line in lines if " to " in line[0]}
    assert bins["0 to 0.05"] == ["4", "1", "25"]  # one of an absent place is false
    assert bins["0.05 to 0.2"] == ["1", "10", "100"]
    assert bins["0.5 to 0.8"] == ["1", "70", "0"]
    assert bins["0.8 to 1"] == ["2", "85", "100"]
    # Half of the four right ones have 0.99 or more: three answers, none of them false; one absent place is accepted.
    assert lines[-1] == ["hamlet-ortho", "6", "67", "0 % of 3", "50", "2"]


def test_what_is_adapted_are_the_weights_of_the_segmenter_that_is_named():
    assert weights_of("osm_unet") == WEIGHTS
    assert weights_of("osm_unet_held_out") == HELD_OUT_WEIGHTS
    with pytest.raises(SystemExit, match="got pixel_forest: leave it out, or name one of them"):
        weights_of("pixel_forest")


class SeesWidth:
    """A stand-in that says how wide a pixel is on the ground, as a probability."""

    card = sgb.load_segmenter("osm_unet").card

    def segment(self, image, *, learned):
        del learned
        width_m = float(image.camera.height_m / image.camera.intrinsics.focal_px[0])
        return sgb.Segmentation.of_probabilities(("building",), np.full((1, *image.shape), width_m))


def test_several_sizes_are_seen_as_from_several_heights():
    lens = Intrinsics(width_px=4, height_px=4, focal_px=(200.0, 200.0), centre_px=(2.0, 2.0))
    camera = Camera.pointed(intrinsics=lens, east_m=0.0, north_m=0.0, height_m=100.0, yaw_deg=0.0)
    image = sgb.AerialImage(rgb=np.zeros((4, 4, 3), dtype=np.uint8), camera=camera)
    found = Scaled(SeesWidth()).segment(image, learned=None).probabilities()
    np.testing.assert_allclose(found, np.full((1, 4, 4), 0.5 * np.mean(SCALES)), atol=1 / 255)


@pytest.mark.parametrize("text", ["0,1,0.8", "0,1,0.5,0.5", "0,2,0,1", "west,1,0,1"])
def test_what_is_no_part_of_a_picture_is_refused(text):
    with pytest.raises(argparse.ArgumentTypeError, match=r"is no part of a picture: give WEST,EAST,NORTH,SOUTH"):
        box_of(text)


def test_a_folder_without_answers_is_named_with_the_command_that_makes_them(tmp_path):
    with pytest.raises(SystemExit, match=r"holds no answers of `pictures`: sasgeo-bench leaderboard pictures --out "):
        read_answers(tmp_path)


def test_answers_of_two_versions_are_not_taken_for_none(tmp_path):
    check_names(["sasgeo"], ["sasgeo"], tmp_path)
    with pytest.raises(SystemExit, match=r"runs holds answers of sasgeo 4, sasgeo 5: move all but one version"):
        check_names(["sasgeo 4", "sasgeo 5"], ["sasgeo"], tmp_path)
