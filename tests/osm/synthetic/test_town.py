# SPDX-License-Identifier: Apache-2.0
"""The embedded towns, read back with plain osmium handlers."""

import datetime as dt
from collections import Counter
from pathlib import Path
from typing import get_args

import numpy as np
import osmium
import pytest
import shapely

from sasgeo_bench.core.errors import ExtractError
from sasgeo_bench.osm.synthetic.morphology import Morphology
from sasgeo_bench.osm.synthetic.sketch import Way, join_streets
from sasgeo_bench.osm.synthetic.town import BULK_REDRAW, TownPlan, write_town

KINDS = get_args(Morphology)
OLD, NEW = dt.date(2014, 1, 1), dt.date(2025, 1, 1)
KNOWN_FOR = {
    "grid": {"highway", "building", "bridge", "railway", "tunnel", "leisure", "amenity"},
    "old_town": {"highway", "building", "barrier", "leisure", "waterway"},
    "suburb": {"highway", "building", "barrier", "leisure", "natural"},
    "industrial": {"highway", "building", "railway", "waterway", "bridge", "amenity", "barrier"},
    "riverside": {"highway", "building", "waterway", "natural", "bridge", "railway", "tunnel", "barrier"},
    "agricultural": {"highway", "building", "landuse", "barrier", "waterway", "natural", "tunnel"},
}


def plan(kind: str = "riverside", *, seed: int = 1, size_m: float = 900.0) -> TownPlan:
    return TownPlan(morphology=kind, seed=seed, size_m=size_m, center_lonlat=(11.0, 48.0))


def state(path: Path, kind: str = "riverside", *, on: dt.date = NEW) -> dict:
    """(type, id) -> version, tags, refs, timestamp, place; of one dated state."""
    write_town(plan(kind), path, on=on)
    found = {}
    for item in osmium.FileProcessor(str(path)):
        refs = ()
        if item.is_way():
            refs = tuple(node.ref for node in item.nodes)
        elif item.is_relation():
            refs = tuple((member.ref, member.role) for member in item.members)
        place = (item.lon, item.lat) if item.is_node() else None
        found[item.type_str(), item.id] = (item.version, dict(item.tags), refs, item.timestamp, place)
    return found


@pytest.mark.parametrize("kind", KINDS)
def test_same_plan_same_bytes_and_another_seed_other_bytes(kind, tmp_path):
    for name in ("a", "b"):
        write_town(plan(kind, size_m=600.0), tmp_path / name)
    write_town(plan(kind, seed=2, size_m=600.0), tmp_path / "c")
    assert (tmp_path / "a").read_bytes() == (tmp_path / "b").read_bytes()
    assert (tmp_path / "a").read_bytes() != (tmp_path / "c").read_bytes()


@pytest.mark.parametrize("kind", KINDS)
def test_a_town_is_sound_within_its_box_and_has_what_its_kind_is_known_for(kind, tmp_path):
    path = tmp_path / "town.osm.pbf"
    found = state(path, kind)
    keys = [("nwr".index(item.type_str()), item.id) for item in osmium.FileProcessor(str(path))]
    assert keys == sorted(set(keys))
    for (name, _), (_, _, refs, _, _) in found.items():
        for ref in refs:
            assert (("n", ref) if name == "w" else ("w", ref[0])) in found
    box = osmium.io.Reader(str(path), osmium.osm.NOTHING).header().box()
    places = np.array([place for *_, place in found.values() if place])
    slack_deg = 1e-4  # the box of the header has straight sides in degrees, the town in metres
    assert (places >= (box.bottom_left.lon - slack_deg, box.bottom_left.lat - slack_deg)).all()
    assert (places <= (box.top_right.lon + slack_deg, box.top_right.lat + slack_deg)).all()
    uses = Counter(ref for _, tags, refs, *_ in found.values() if "highway" in tags for ref in set(refs))
    assert sum(count > 1 for count in uses.values()) >= 3  # streets share nodes where they meet
    assert KNOWN_FOR[kind] <= {key for _, tags, *_ in found.values() for key in tags}
    if kind == "riverside":
        (_, _, river, *_) = next(each for each in found.values() if each[1].get("natural") == "water")
        assert [role for _, role in river] == ["outer", "inner"]
        assert [tags["layer"] for _, tags, *_ in found.values() if "bridge" in tags][:2] == ["1", "1"]
    if kind == "suburb":
        schools = [tags for (name, _), (_, tags, *_) in found.items() if name == "r" and tags["type"] == "building"]
        assert schools == [{"type": "building", "building": "school"}]


def test_two_streets_that_cross_get_one_point_and_a_bridge_gets_none():
    street, other = np.array([(0.0, 0.0), (10.0, 0.0)]), np.array([(4.0, -5.0), (4.0, 5.0)])
    plain = {"highway": "residential"}
    joined = join_streets([Way(line=street, tags=plain), Way(line=other, tags=plain)])
    assert [4.0, 0.0] in joined[0].line.tolist()
    assert [4.0, 0.0] in joined[1].line.tolist()
    apart = join_streets([Way(line=street, tags=plain), Way(line=other, tags=plain | {"layer": "1"})])
    assert [way.line.tolist() for way in apart] == [street.tolist(), other.tolist()]


def test_between_two_dates_things_appear_vanish_and_change_their_version(tmp_path):
    old, new = state(tmp_path / "a.osm.pbf", on=OLD), state(tmp_path / "b.osm.pbf", on=NEW)
    ways_old, ways_new = ({key for key in found if key[0] == "w"} for found in (old, new))
    assert ways_new - ways_old
    assert ways_old - ways_new
    assert max(timestamp.date() for *_, timestamp, _ in old.values()) <= OLD
    changed = [key for key in ways_old & ways_new if new[key][0] > old[key][0]]
    assert changed
    assert all(new[key][3] > old[key][3] for key in changed)


def test_the_bulk_redraw_changes_ids_but_not_the_ground(tmp_path):
    before = state(tmp_path / "a.osm.pbf", on=BULK_REDRAW - dt.timedelta(days=1))
    after = state(tmp_path / "b.osm.pbf", on=BULK_REDRAW)

    def footprints(found):
        rings = {}
        for (name, identifier), (_, tags, refs, *_) in found.items():
            if name == "w" and "building" in tags:
                rings[identifier] = shapely.Polygon([found["n", ref][4] for ref in refs])
        return rings

    old, new = footprints(before), footprints(after)
    assert len(set(old) - set(new)) > 0.2 * len(old)
    ground_old, ground_new = (shapely.union_all(list(shapes.values())) for shapes in (old, new))
    assert ground_old.symmetric_difference(ground_new).area < 1e-3 * ground_old.area


def test_a_date_outside_the_history_and_a_folder_that_is_not_there_are_refused(tmp_path):
    with pytest.raises(ExtractError, match="history from 2012-01-01"):
        write_town(plan(), tmp_path / "t.osm.pbf", on=dt.date(2011, 1, 1))
    with pytest.raises(ExtractError, match="cannot be written"):
        write_town(plan(), tmp_path / "none" / "t.osm.pbf")
    assert list(tmp_path.iterdir()) == []
