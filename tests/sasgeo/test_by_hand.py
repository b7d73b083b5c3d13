# SPDX-License-Identifier: Apache-2.0
"""Map and view by hand: what a view says follows its classes, its unknown cells and the age of the map."""

import datetime as dt
from dataclasses import replace

import numpy as np
import pytest

from sasgeo_bench.regions.evidence import UNKNOWN, Evidence
from sasgeo_bench.sasgeo.variants import map_by_hand, view_by_hand
from sasgeo_bench.search.find import score_at


@pytest.fixture(scope="module")
def asked(tiny):
    query, truth = next(pair for pair in zip(tiny.queries, tiny.truths, strict=True) if pair[1].pose is not None)
    return query, truth


def test_the_right_place_leads_and_an_older_map_says_less(tiny, asked):
    query, truth = asked
    field, classes = map_by_hand(tiny.region), tiny.region.classes
    aside = replace(truth.pose, easting_m=truth.pose.easting_m + 60.0)
    leads = []
    for years in (0, 10, 40):
        made = query.observed_on - dt.timedelta(days=365 * years)
        view = view_by_hand(query, classes, map_date=made)
        leads.append(score_at(field, view, truth.pose) - score_at(field, view, aside))
    assert leads[0] > leads[1] > leads[2] > 0


def test_what_is_unknown_counts_nothing_and_cells_are_a_whole_number_of_those_of_the_map(tiny, asked):
    query, _ = asked
    seen = query.evidence
    blind = Evidence(classes=seen.classes, cells=np.full_like(seen.cells, UNKNOWN), cell_size_m=seen.cell_size_m)
    day = tiny.region.manifest.extract.date
    assert not view_by_hand(replace(query, evidence=blind), tiny.region.classes, map_date=day).bands.any()
    assert not view_by_hand(query, (), map_date=day).bands.any()
    assert map_by_hand(tiny.region, cell_size_m=4.3).grid == tiny.region.grid.coarsen(4)
