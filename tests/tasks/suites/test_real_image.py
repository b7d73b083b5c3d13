# SPDX-License-Identifier: Apache-2.0
"""Real pictures: they are cut where the truth says, and the degraded map is another one."""

from pathlib import Path

import numpy as np
import pytest

from sasgeo_bench.core.errors import ConfigError
from sasgeo_bench.regions.build import build_region, plan_build
from sasgeo_bench.regions.evidence import PRESENT, UNKNOWN, observe
from sasgeo_bench.regions.region_files import read_region
from sasgeo_bench.regions.region_spec import list_region_files, read_region_file
from sasgeo_bench.sensing.segmentation import Segmentation
from sasgeo_bench.tasks.build import make_tasks
from sasgeo_bench.tasks.frame_evidence import evidence_of
from sasgeo_bench.tasks.frames import read_labels
from sasgeo_bench.tasks.split import SplitFile, make_split
from sasgeo_bench.tasks.state import State
from sasgeo_bench.tasks.suites.pictures import DEGRADED, REAL_IMAGE
from sasgeo_bench.tasks.task_files import read_queries, read_truths
from sasgeo_bench.tasks.task_plan import Request
from tests.regions.imagery_place import make_hamlet

DEGRADED_MAP = "hamlet+real-image"


def request_of(spec, out: Path, folder: Path | None = None) -> Request:
    places = [{"name": spec.id, "half": "a", "regions": [spec.id]}]
    places += [{"name": "other", "half": "a", "regions": ["town-grid"]}]
    places += [{"name": name, "half": "b", "regions": [name]} for name in ("town-suburb", "town-riverside")]
    split = SplitFile(id="own", title="own", kind="crossfit", buffer_m=100.0, place=places)
    known = {name: read_region_file(path) for name, path in list_region_files().items()} | {spec.id: spec}
    return Request(
        suite=REAL_IMAGE.card.name,
        region=spec,
        split=make_split(split, {name: item.grid() for name, item in known.items()}),
        count=2,
        seed=5,
        out=out,
        may_be_fewer=True,
        extract_folders=() if folder is None else (folder,),
    )


@pytest.fixture(scope="module")
def drawn(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Root with the queries of a hamlet with imagery, on its map and on the degraded one."""
    folder, out = tmp_path_factory.mktemp("hamlet"), tmp_path_factory.mktemp("out")
    spec = make_hamlet(folder).spec()
    plan = plan_build(spec, out=out, extract_folders=[folder], imagery_folders=[folder])
    build_region(plan)
    make_tasks(request_of(spec, out, folder))
    return out


def pairs(out: Path, region: str = "hamlet"):
    truths = {item.query_id: item for item in read_truths(out / "truth" / "real-image" / region)}
    return [(query, truths[query.query_id]) for query in read_queries(out / "tasks" / "real-image" / region)]


def test_pictures_show_the_place_that_the_truth_names(drawn):
    found = {(name, at): item for name, at, item in read_labels(drawn / "truth" / "real-image" / "hamlet")}
    state = State.of(read_region(drawn / "regions" / "hamlet"))
    for query, truth in pairs(drawn):
        rows, cols = query.evidence.shape
        assert (query.evidence.cells == UNKNOWN).all()
        labels = found[query.query_id, 0]
        planes = np.where(labels.labels == UNKNOWN, np.nan, labels.labels == PRESENT)
        oracle = Segmentation.of_probabilities(labels.classes, planes)
        seen = evidence_of(query.frames, [oracle], size_cells=rows, cell_size_m=query.evidence.cell_size_m)
        mapped = observe(state.bits, state.grid, truth.pose, size_cells=cols, cell_size_m=query.evidence.cell_size_m)
        known = (seen.cells != UNKNOWN) & (mapped != UNKNOWN)
        both, either = (
            op(seen.cells == PRESENT, mapped == PRESENT)[known].sum() for op in (np.logical_and, np.logical_or)
        )
        assert either > 100
        assert both / either > 0.85
        # Houses of the mosaic are of another brightness than the ground: the picture shows what its labels say.
        grey = query.frames[0].image().rgb.mean(axis=2)
        house = labels.labels[0] == PRESENT
        assert abs(grey[house].mean() - grey[~house].mean()) > 10


def test_variants_are_told_by_the_side_of_their_views_each_once(drawn):
    kinds = [(truth.role, truth.kind, truth.strength) for _, truth in pairs(drawn)]
    sites = len({truth.pair_id for _, truth in pairs(drawn)})
    assert set(kinds) == {
        ("control", "control", 0.0),
        ("falsifier", "turned picture", 0.0),
        ("stress", "R1 view", 64.0),
    }
    assert len(kinds) == 3 * sites
    assert {truth.detector for _, truth in pairs(drawn)} == {"real"}
    worse = [(truth.kind, truth.strength) for _, truth in pairs(drawn, DEGRADED_MAP)]
    assert set(worse) == {(DEGRADED, 96.0), (DEGRADED, 64.0)}


def test_the_degraded_map_lacks_houses_and_views_of_two_sites_share_no_ground(drawn):
    houses = [len(read_region(drawn / "regions" / name).features) for name in ("hamlet", DEGRADED_MAP)]
    assert houses[1] == round(0.8 * houses[0])
    assert all(truth.changed_share > 0.1 for _, truth in pairs(drawn, DEGRADED_MAP))
    places = {truth.pair_id: (truth.pose.easting_m, truth.pose.northing_m) for _, truth in pairs(drawn)}
    one, two = places.values()
    assert np.hypot(one[0] - two[0], one[1] - two[1]) >= 96 * np.sqrt(2)


def test_a_region_without_imagery_is_refused_in_one_line(tmp_path):
    town = read_region_file(list_region_files()["town-old-town"])
    with pytest.raises(ConfigError, match=r"town-old-town cannot carry suite 'real-image': no real imagery"):
        make_tasks(request_of(town, tmp_path))
