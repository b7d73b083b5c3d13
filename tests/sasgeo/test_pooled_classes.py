# SPDX-License-Identifier: Apache-2.0
"""Training on maps of different classes: each class learns from the views on maps that know of it."""

from dataclasses import replace

import pytest

from sasgeo_bench.matching.matcher import Training
from sasgeo_bench.regions.evidence import Evidence
from sasgeo_bench.sasgeo.ablations import Switches
from sasgeo_bench.sasgeo.learning import learn

HOUSES = ("building",)


def with_houses_alone(region, query):
    """A map and a view of it that know of buildings alone."""
    at = region.classes.index("building")
    manifest = region.manifest.model_copy(update={"classes": HOUSES, "id": "houses"})
    features = region.features[(region.features["class"] == "building").to_numpy()].reset_index(drop=True)
    few = replace(region, manifest=manifest, layers=region.layers[[at]], features=features)
    seen = query.evidence
    view = Evidence(classes=HOUSES, cells=seen.cells[[at]].copy(), cell_size_m=seen.cell_size_m)
    return few, replace(query, region="houses", evidence=view, vectors=None)


@pytest.fixture(scope="module")
def models(tiny):
    """Models learned from views with all classes, and from these and one of buildings alone."""
    pairs = [
        (replace(query, prior=replace(query.prior, radius_m=60.0, center_m=(pose.easting_m, pose.northing_m))), truth)
        for query, truth in zip(tiny.queries, tiny.truths, strict=True)
        if query.track == "localization" and query.evidence.shape[0] == 96 and not query.season
        for pose in [truth.pose]
    ][:2]
    few, view = with_houses_alone(tiny.region, pairs[0][0])
    switches = Switches(has_graph=False)
    whole = {tiny.region.manifest.id: tiny.region}
    plain = learn(Training(regions=whole, pairs=pairs), switches)
    mixed = learn(Training(regions=whole | {"houses": few}, pairs=[*pairs, (view, pairs[0][1])]), switches)
    return plain, mixed


@pytest.mark.slow
def test_all_classes_of_any_map_are_learned_in_their_order(tiny, models):
    assert models[1].classes == tiny.region.classes


def test_views_of_buildings_change_nothing_that_is_learned_of_other_classes(models):
    plain, mixed = (dict(zip(one.classes, one.rates, strict=True)) for one in models)
    assert {name: plain[name] for name in plain if name != "building"} == {
        name: mixed[name] for name in mixed if name != "building"
    }
    assert plain["building"] != mixed["building"]
    assert models[1].views == models[0].views + 1
