# SPDX-License-Identifier: Apache-2.0
"""Features by their own age: strata of a map, what is counted by them, and how far each is trusted."""

import datetime as dt
from dataclasses import replace

import numpy as np
import pandas as pd

from sasgeo_bench.regions.evidence import PRESENT
from sasgeo_bench.sasgeo.raster import likeness_by_hand, read_field
from sasgeo_bench.sasgeo.weights import NEVER, STRATA, StampTally, fit_trust, idle_years, strata


def dated(region, years):
    """The region, its features last edited so many years before its date, in turn."""
    date = pd.Timestamp(region.manifest.extract.date, tz="UTC")
    edited = [date - pd.Timedelta(days=365.25 * years[at % len(years)]) for at in range(len(region.features))]
    return replace(region, features=region.features.assign(timestamp=edited))


def test_a_stratum_is_where_its_class_is_and_what_was_touched_last_counts(tiny):
    region = dated(tiny.region, [0.5, 2.0, 4.0, 9.0])
    found = strata(region)
    assert ((found == NEVER) == (region.layers != PRESENT)).all()
    assert set(np.unique(found[found != NEVER]).tolist()) == set(range(STRATA))
    old, new = (strata(dated(tiny.region, years)) for years in ([9.0], [9.0, 0.5]))
    there = old != NEVER
    assert (old[there] == STRATA - 1).all()
    assert (new[there] <= old[there]).all()
    assert (new[there] == 0).any()


def test_full_trust_changes_no_map_and_none_takes_the_class_away(tiny):
    region = dated(tiny.region, [0.5, 9.0])
    near = likeness_by_hand(region.classes)
    plain = read_field(region, near)
    trusted = read_field(region, near, trust=np.ones((len(near), STRATA))).layers.astype(int)
    assert np.abs(trusted - plain.layers).max() <= STRATA  # shares of a cell are whole numbers of 255, each rounded
    fresh_only = np.zeros((len(near), STRATA))
    fresh_only[:, 0] = 1.0
    some = read_field(region, near, trust=fresh_only)
    assert (some.layers <= plain.layers).all()
    assert (some.layers < plain.layers).any()
    assert (some.known == plain.known).all()


def test_strata_without_cells_are_as_their_class_and_a_map_edited_after_its_date_is_fresh():
    none = np.zeros((1, STRATA), dtype=np.int64)
    far = np.zeros(1, dtype=np.int64)
    assert fit_trust([StampTally(seen=none, missed=none, far_seen=far, far_missed=far)]).tolist() == [[1.0] * STRATA]
    assert idle_years(pd.Series(["2021-01-01"]), dt.date(2020, 1, 1)).tolist() == [0.0]
