# SPDX-License-Identifier: Apache-2.0
"""A part of a region is what lies there of the whole, and no more of the files is read than that takes."""

import math

import numpy as np
import pandas as pd
import pyarrow.parquet as pq
import pytest
import shapely

from sasgeo_bench.core.errors import GridError
from sasgeo_bench.regions import region_files
from sasgeo_bench.regions.region_files import read_region, write_manifest, write_tables

TOWN = "town-riverside"
ROWS = 64  # of a row group


@pytest.fixture(scope="module")
def folder(lay_towns, tmp_path_factory):
    """A town whose tables have many row groups, as those of a country."""
    folder = lay_towns(tmp_path_factory.mktemp("part") / "out", TOWN) / "regions" / TOWN
    whole = read_region(folder)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(region_files, "GROUP_ROWS", ROWS)
        write_tables(folder, whole.features, whole.graph)
    files = {name: region_files.file_record(folder / name) for name in whole.manifest.files}
    write_manifest(folder, whole.manifest.model_copy(update={"files": files}))
    return folder


@pytest.fixture(scope="module")
def whole(folder):
    return read_region(folder)


def box_of(whole, west, south, east, north):
    """Bounds by shares of the map."""
    left, bottom, right, top = whole.grid.bounds_m
    across, up = right - left, top - bottom
    return left + west * across, bottom + south * up, left + east * across, bottom + north * up


SHARES = {"within": (0.3, 0.3, 0.5, 0.55), "over-the-edge": (-1.0, 0.7, 0.25, 4.0), "all": (-1.0, -1.0, 2.0, 2.0)}


@pytest.fixture(params=SHARES.values(), ids=SHARES)
def bounds_m(request, whole):
    return box_of(whole, *request.param)


def keys(features):
    return features[["osm_type", "osm_id", "class"]].apply(tuple, axis=1).tolist()


def test_a_part_has_the_cells_that_its_bounds_touch(folder, whole, bounds_m):
    part = read_region(folder, bounds_m=bounds_m)
    west, south, east, north = part.grid.bounds_m
    least = np.maximum(bounds_m[:2], whole.grid.bounds_m[:2]), np.minimum(bounds_m[2:], whole.grid.bounds_m[2:])
    assert np.all(np.abs(np.array([[west, south], [east, north]]) - least) < whole.grid.cell_size_m)
    assert np.all((west, south) <= least[0])
    assert np.all((east, north) >= least[1])
    row, col = (round(whole.grid.bounds_m[3] - north), round(west - whole.grid.bounds_m[0]))
    there = np.s_[:, row : row + part.grid.rows, col : col + part.grid.cols]
    np.testing.assert_array_equal(part.layers, whole.layers[there])
    np.testing.assert_array_equal(part.layer("building"), part.layers[part.classes.index("building")])
    np.testing.assert_array_equal(part.known(), whole.known()[there[1:]])
    assert part.coverage.equals(shapely.intersection(whole.coverage, shapely.box(*part.grid.bounds_m)))


def test_a_part_has_the_whole_features_that_meet_it(folder, whole, bounds_m):
    part = read_region(folder, bounds_m=bounds_m)
    meets = whole.features.intersects(shapely.box(*part.grid.bounds_m)).to_numpy()
    expected = whole.features[meets].reset_index(drop=True)
    pd.testing.assert_frame_equal(pd.DataFrame(part.features), pd.DataFrame(expected))
    assert part.features.crs == whole.features.crs
    assert part.features.attrs == whole.features.attrs


def test_a_part_leaves_out_a_feature_of_which_the_envelope_alone_meets_it(folder, whole):
    shapes = whole.features.geometry.to_numpy()
    west, south, east, north = shapely.bounds(shapes).T
    sides = shapely.box(west, south, west + 2.0, south + 2.0)
    within = shapely.contains(shapely.box(*whole.grid.bounds_m), shapely.box(west, south, east, north))
    bent = np.flatnonzero(within & (shapely.distance(shapes, sides) > 20.0))  # its south-western corner lies beside it
    assert len(bent) > 0
    corner = shapely.bounds(sides[bent[0]])
    part = read_region(folder, bounds_m=tuple(corner))
    assert keys(whole.features.iloc[bent[:1]])[0] not in keys(part.features)


def test_a_part_has_the_nodes_in_it_and_the_edges_between_them(folder, whole, bounds_m):
    part = read_region(folder, bounds_m=bounds_m)
    nodes, edges = whole.graph.nodes, whole.graph.edges
    meets = nodes.intersects(shapely.box(*part.grid.bounds_m)).to_numpy()
    assert 1 < meets.sum() <= len(nodes)
    old = nodes["id"].to_numpy()[meets]
    found = part.graph.nodes
    assert found["id"].tolist() == list(range(len(found)))
    pd.testing.assert_frame_equal(
        pd.DataFrame(found.drop(columns="id")), pd.DataFrame(nodes[meets].drop(columns="id").reset_index(drop=True))
    )
    kept = edges[edges["source"].isin(old) & edges["target"].isin(old)].reset_index(drop=True)
    again = part.graph.edges.assign(source=old[part.graph.edges["source"]], target=old[part.graph.edges["target"]])
    pd.testing.assert_frame_equal(again, kept)
    assert part.graph.edges.dtypes.equals(edges.dtypes)


def test_of_a_small_part_few_row_groups_are_read(folder, whole, monkeypatch):
    read = []

    class Counted(pq.ParquetFile):
        def read_row_group(self, at, **options):
            read.append(at)
            return super().read_row_group(at, **options)

    monkeypatch.setattr("pyarrow.parquet.ParquetFile", Counted)
    part = read_region(folder, bounds_m=box_of(whole, 0.4, 0.4, 0.45, 0.45))
    assert 0 < len(part.features) < ROWS
    groups = pq.read_metadata(folder / region_files.FEATURES).num_row_groups
    assert groups > 8
    assert 0 < len(read) < groups / 3


def test_where_nothing_is_mapped_a_part_is_empty(folder, whole, monkeypatch):
    monkeypatch.setattr(region_files, "_window", lambda *_: (0, 0, 1, 1))
    monkeypatch.setattr(
        type(whole.manifest), "of_part", lambda self, _: self.model_copy(update={"bounds_m": (0.0, 0.0, 1.0, 1.0)})
    )
    part = read_region(folder, bounds_m=(0.0, 0.0, 1.0, 1.0))
    assert len(part.features) == len(part.graph.nodes) == len(part.graph.edges) == 0
    assert part.features.dtypes.equals(whole.features.dtypes)
    assert part.graph.edges.dtypes.equals(whole.graph.edges.dtypes)


@pytest.mark.parametrize(
    ("bounds", "words"),
    [
        ((0.0, 0.0, 10.0, 10.0), r"beyond the map: it has .* metres in EPSG:\d+"),
        ((1.0, 0.0, 0.0, 1.0), "must grow from west to east"),
        *(
            (one, "bounds_m are west, south, east, north")
            for one in ((1, 2, 3), 5, "west", (math.inf,) * 4, (None,) * 4)
        ),
    ],
)
def test_bounds_that_are_none_or_elsewhere_are_refused(folder, bounds, words):
    with pytest.raises(GridError, match=words):
        read_region(folder, bounds_m=bounds)


def test_a_map_of_few_features_keeps_their_order(whole, tmp_path, lay_towns):
    folder = lay_towns(tmp_path / "out", TOWN) / "regions" / TOWN
    usual = read_region(folder).features
    assert keys(usual) != keys(whole.features)
    assert sorted(keys(usual)) == sorted(keys(whole.features))
    write_tables(tmp_path, usual, whole.graph)
    assert (tmp_path / region_files.FEATURES).read_bytes() == (folder / region_files.FEATURES).read_bytes()
