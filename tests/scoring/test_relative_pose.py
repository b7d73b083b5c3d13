# SPDX-License-Identifier: Apache-2.0
"""The relative pose error, held against homogeneous matrices pair by pair."""

import numpy as np
import pandas as pd
import pytest

from sasgeo_bench.scoring.relative_pose import relative_errors

NAMES = ("east_m", "north_m", "yaw_deg")


def flight(seed=0, count=60):
    """Views of a winding flight, 30 to 50 m apart, and estimates that are off by a few metres and degrees."""
    rng = np.random.default_rng(seed)
    steps_m = rng.uniform(30, 50, count)
    yaw_deg = np.cumsum(rng.normal(0, 20, count))
    heading = np.radians(yaw_deg)
    true = np.column_stack([np.cumsum(steps_m * np.sin(heading)), np.cumsum(steps_m * np.cos(heading)), yaw_deg])
    found = true + rng.normal(0, (5, 5, 3), (count, 3))
    found[:, 2] %= 360  # headings as they are stored
    table = {f"true_{name}": true[:, at] for at, name in enumerate(NAMES)}
    table |= {name: found[:, at] for at, name in enumerate(NAMES)}
    return pd.DataFrame(table | {"distance_m": np.cumsum(steps_m) - steps_m[0]})


def matrix(east_m, north_m, yaw_deg):
    """From right and up of a pose to east and north."""
    turn = np.radians(yaw_deg)
    return np.array([[np.cos(turn), np.sin(turn), east_m], [-np.sin(turn), np.cos(turn), north_m], [0.0, 0.0, 1.0]])


def by_matrices(views, length_m):
    """Errors of the pairs of one length, as the paper has them: the inverse of the true step times that found."""
    found = []
    for first in range(len(views)):
        later = [at for at in range(len(views)) if views["distance_m"][at] >= views["distance_m"][first] + length_m]
        if not later:
            continue
        true, believed = (
            np.linalg.inv(matrix(*views.loc[first, names])) @ matrix(*views.loc[later[0], names])
            for names in ([f"true_{name}" for name in NAMES], list(NAMES))
        )
        off = np.linalg.inv(true) @ believed
        found.append((np.hypot(off[0, 2], off[1, 2]), np.degrees(np.arctan2(off[0, 1], off[0, 0]))))
    return np.array(found)


@pytest.mark.parametrize("length_m", [100.0, 500.0])
def test_the_error_is_that_of_the_steps_matrices(length_m):
    views = flight()
    (one,) = relative_errors(views, (length_m,))
    expected = by_matrices(views, length_m)
    assert one.pairs == len(expected)
    assert one.position_m == pytest.approx(np.sqrt(np.mean(expected[:, 0] ** 2)))
    assert one.yaw_deg == pytest.approx(np.sqrt(np.mean(expected[:, 1] ** 2)))


def test_where_the_flight_lies_and_heads_does_not_matter_but_a_stretch_without_an_estimate_or_carried_counts_none():
    views = flight()
    moved = views.copy()
    turn = np.radians(70.0)
    moved["east_m"] = views["east_m"] * np.cos(turn) + views["north_m"] * np.sin(turn) + 900
    moved["north_m"] = -views["east_m"] * np.sin(turn) + views["north_m"] * np.cos(turn)
    moved["yaw_deg"] = views["yaw_deg"] + 70.0
    for one, other in zip(relative_errors(views), relative_errors(moved), strict=True):
        assert tuple(one) == pytest.approx(tuple(other))
    lost = views.copy()
    lost.loc[30, list(NAMES)] = np.nan
    assert relative_errors(lost, (100.0,))[0].pairs == relative_errors(views, (100.0,))[0].pairs - 2
    carried = views.assign(is_carried=np.arange(len(views)) == 30)
    assert relative_errors(carried, (100.0,))[0].pairs < relative_errors(views, (100.0,))[0].pairs
    assert relative_errors(views, (1e6,)) == ()
