# SPDX-License-Identifier: Apache-2.0
"""Dated states of one place: their order and dates, the area they share, the hints of their tags, and a real trap."""

import datetime as dt
from pathlib import Path

import numpy as np
import pytest
import shapely

from sasgeo_bench.ageing.measure import measure_ageing
from sasgeo_bench.core.errors import ConfigError, CoverageError, ExtractError
from sasgeo_bench.osm.history import DatedExtract, ObjectKey, date_extracts, parse_start, read_history, read_lifecycle
from sasgeo_bench.osm.synthetic.town import BULK_REDRAW, TownPlan, _things, write_town

DAYS = (dt.date(2014, 1, 1), dt.date(2019, 1, 1), dt.date(2025, 1, 1))
# Paths all over, so that the whole box is seen to be mapped.
FRAME = [(50 + y, {"highway": "path"}, [(x, y) for x in range(11)]) for y in range(11)]
BOX = '<bounds minlat="47.0" minlon="9.0" maxlat="47.01" maxlon="9.01"/>'


def plan(kind: str = "suburb", center=(11.0, 48.0)) -> TownPlan:
    return TownPlan(morphology=kind, seed=1, size_m=900.0, center_lonlat=center)


def town(folder: Path, day: dt.date, **more) -> DatedExtract:
    path = folder / f"town-{day}.osm.pbf"
    write_town(plan(**more), path, on=day)
    return DatedExtract(path=path, on=day)


@pytest.fixture(scope="module")
def towns(tmp_path_factory):
    return [town(tmp_path_factory.mktemp("towns"), day) for day in DAYS]


def osm(path: Path, *ways: tuple) -> Path:
    """An .osm file of ways: each an id, tags and (lon, lat) corners in units of 0.001 degrees from (9, 47)."""
    corners, lines = [], []
    for identifier, tags, points in ways:
        refs = {point: 100 * identifier + number for number, point in enumerate(dict.fromkeys(points))}
        corners += [
            f'<node id="{ref}" version="1" lon="{9 + x / 1000:.7f}" lat="{47 + y / 1000:.7f}"/>'
            for (x, y), ref in refs.items()
        ]
        nds = "".join(f'<nd ref="{refs[point]}"/>' for point in points)
        texts = "".join(f'<tag k="{key}" v="{value}"/>' for key, value in tags.items())
        lines.append(f'<way id="{identifier}" version="1">{nds}{texts}</way>')
    text = "".join((*corners, *lines))
    path.write_text(f'<osm version="0.6">{BOX}{text}</osm>')
    return path


def square(x, y, size=0.2):
    return [(x, y), (x + size, y), (x + size, y + size), (x, y + size), (x, y)]


def found(history, name="building", span="whole"):
    table = measure_ageing(history, place="here").table
    return table[(table["class"] == name) & (table["span"] == span)].iloc[0]


# Dates and order


def test_states_come_in_the_order_of_their_dates_or_have_the_dates_given_in_the_order_of_the_files(towns):
    paths = [item.path for item in towns]
    assert date_extracts(paths) == date_extracts(paths[::-1]) == tuple(towns)
    days = [dt.date(2021, 1, 1), dt.date(2020, 1, 1), dt.date(2019, 1, 1)]
    dated = date_extracts([item.path for item in towns], at=days)
    assert [item.path for item in dated] == [item.path for item in towns[::-1]]


def test_a_file_is_dated_by_its_name_and_one_without_a_date_there_by_its_newest_element(tmp_path):
    named = osm(tmp_path / "a-2016-01-01.osm", (1, {"building": "yes"}, square(1, 1)))
    (tmp_path / "b.osm.pbf").symlink_to(town(tmp_path, DAYS[0]).path)
    newest, by_name = date_extracts([named, tmp_path / "b.osm.pbf"])
    assert by_name.on == dt.date(2016, 1, 1)
    assert newest.on <= DAYS[0]


@pytest.mark.real
def test_a_header_dates_a_file_whatever_its_name(real_extracts, tmp_path):
    copy = tmp_path / "a-1999-01-01.osm.pbf"
    copy.symlink_to(real_extracts / "monaco-2020-07-19.osm.pbf")
    dated = date_extracts([copy, real_extracts / "monaco-2025-02-15.osm.pbf"])
    assert dated[0].on == dt.date(2020, 7, 19)


def test_a_full_history_is_cut_at_each_date(tmp_path):
    path = osm(
        tmp_path / "x.osh", *FRAME, (1, {"building": "yes"}, square(2, 2)), (2, {"building": "yes"}, square(4, 2))
    )
    text = path.read_text().replace('version="1"', 'version="1" visible="true" timestamp="2010-01-01T00:00:00Z"')
    gone = '<way id="2" version="2" visible="false" timestamp="2016-01-01T00:00:00Z"/>'
    path.write_text(text.replace("</osm>", f"{gone}</osm>"))
    with pytest.raises(ConfigError, match="is a full history: give the dates"):
        date_extracts([path])
    with pytest.raises(ConfigError, match="two states have the date 2014-01-01"):
        date_extracts([path], at=[DAYS[0], DAYS[0]])
    dated = date_extracts([path], at=[dt.date(2018, 1, 1), dt.date(2014, 1, 1)])
    assert [item.on.year for item in dated] == [2014, 2018]
    row = found(read_history(dated))
    assert (row["n_from"], row["n_to"]) == (2, 1)
    assert row["vanished_share"] == pytest.approx(0.5, abs=1e-3)


@pytest.mark.parametrize(
    ("names", "at", "expected"),
    [
        (["a-2014-01-01.osm"], [], "at least 2 dated states, got 1"),
        (["a-2014-01-01.osm", "b-2014-01-01.osm"], [], "two states have the date 2014-01-01"),
        (["a-2014-01-01.osm", "b-2015-01-01.osm"], [DAYS[0]], "got 1 for 2 extracts"),
        (["a-2014-01-01.osm", "b.osm"], [], "b.osm does not say what day it is of"),
        (["a-2014-01-01.osm", "b-2014-13-45.osm"], [], "does not say what day it is of"),
        (["a-2014-01-01.osh"], [], "at least 2 dated states, got 1"),  # named like a history, and none
        (["none-2014-01-01.osm.pbf", "a-2014-01-01.osm"], [], "no extract at"),
        (["a.txt", "b-2014-01-01.osm"], [], "of no known format"),
    ],
)
def test_what_cannot_be_put_in_order_is_reported_in_one_line(names, at, expected, tmp_path):
    for name in names:
        if not name.startswith("none"):
            osm(tmp_path / name, (1, {"building": "yes"}, square(1, 1)))
    with pytest.raises((ConfigError, ExtractError), match=expected) as caught:
        date_extracts([tmp_path / name for name in names], at=at)
    assert "\n" not in str(caught.value)


# The common area


def test_places_and_bounds_elsewhere_are_refused_and_bounds_within_are_kept_to(tmp_path, towns):
    with pytest.raises(CoverageError, match="nothing in common"):
        read_history([*towns, town(tmp_path, dt.date(2016, 1, 1), center=(12.0, 48.0))])
    with pytest.raises(CoverageError, match="nothing in common with"):
        read_history(towns, bounds=(9.0, 47.0, 9.1, 47.1))
    history = read_history(towns, bounds=(11.0, 48.0, 11.002, 48.002))
    wide_m, high_m = 0.002 * 111_320 * np.cos(np.radians(48)), 0.002 * 111_180
    assert shapely.area(history.area) == pytest.approx(wide_m * high_m, rel=0.01)


def test_a_file_without_a_header_box_is_framed_by_its_nodes(tmp_path):
    paths = [osm(tmp_path / f"a-{day}.osm", (1, {"building": "yes"}, square(4, 4, 2))) for day in DAYS]
    for path in paths:
        path.write_text(path.read_text().replace(BOX, ""))
    with pytest.raises(CoverageError, match="300 m within their estimated edges"):
        read_history(date_extracts(paths))
    history = read_history(date_extracts(paths), margin_m=0.0)
    assert found(history)["vanished_share"] == 0.0


def test_what_lies_near_an_estimated_edge_is_left_out_unless_all_states_are_of_one_file(tmp_path):
    wide = [(50 + y, {"highway": "path"}, [(x, y) for x in range(31)]) for y in range(31)]
    path = osm(tmp_path / "a-2014-01-01.osm", *wide)
    path.write_text(path.read_text().replace(BOX, '<bounds minlat="46.9" minlon="8.9" maxlat="47.1" maxlon="9.1"/>'))
    other = tmp_path / "b-2016-01-01.osm"
    other.write_text(path.read_text())
    areas = [
        shapely.area(read_history(date_extracts([path, other]), margin_m=margin_m).area)
        for margin_m in (0.0, 100.0, 300.0)
    ]
    side_m = np.sqrt(areas)
    assert side_m[0] - side_m[1] == pytest.approx(200, rel=0.2)
    assert side_m[0] - side_m[2] == pytest.approx(600, rel=0.2)


# The embedded towns, whose lives the generator knows


def truth(day_from, day_to, kind):
    """Shares of the buildings' ground that the generator says died and was born between two days."""
    things = [thing for thing in _things(plan(kind)) if "building" in thing.tags]

    def ground(chosen):
        return sum(shapely.Polygon(item.rings[0], item.rings[1:]).area for item in chosen)

    old, new = ([thing for thing in things if thing.alive(day)] for day in (day_from, day_to))
    died, born = [item for item in old if item not in new], [item for item in new if item not in old]
    return ground(died) / ground(old), ground(born) / ground(new)


@pytest.mark.parametrize("kind", ["suburb", "grid"])
def test_what_is_measured_of_a_town_is_what_its_generator_made(kind, tmp_path):
    dated = [town(tmp_path, day, kind=kind) for day in DAYS]
    vanished, appeared = truth(DAYS[0], DAYS[-1], kind)
    row = found(read_history(dated, margin_m=0.0))
    assert vanished > 0.01
    assert appeared > 0.1
    assert row["vanished_share"] == pytest.approx(vanished, abs=0.006)
    assert row["appeared_share"] == pytest.approx(appeared, abs=0.006)
    assert row["shift_median_m"] <= 3.0  # no house of the towns moves farther


def test_the_bulk_redraw_of_a_town_is_no_demolition(tmp_path):
    dated = [town(tmp_path, day) for day in (BULK_REDRAW - dt.timedelta(days=1), BULK_REDRAW)]
    row = found(read_history(dated))
    assert row["id_vanished_share"] > 0.2
    assert row["vanished_share"] < 0.005
    assert row["redrawn_share"] < 0.01


# Hints


def test_lifecycle_tags_are_found_on_ways_and_areas(tmp_path):
    path = osm(
        tmp_path / "a.osm",
        (1, {"demolished:building": "yes"}, square(1, 1)),
        (2, {"landuse": "construction"}, square(2, 1)),
        (3, {"highway": "construction", "construction": "primary"}, [(3, 1), (3, 2)]),
        (4, {"building": "yes", "start_date": "1998"}, square(4, 1)),
        (5, {"building": "yes", "start_date": "long ago"}, square(5, 1)),
        (6, {"razed:highway": "service"}, [(6, 1), (6, 2)]),
        (7, {"building": "construction"}, square(7, 1)),
        (8, {"building": "yes"}, square(8, 1)),
    )
    hints = read_lifecycle(path, epsg=32632)
    assert sorted(shapely.get_type_id(hints.gone).tolist()) == [1, 6]
    assert set(shapely.get_type_id(hints.rising).tolist()) == {1, 6}
    assert len({shapely.centroid(shape).wkb for shape in hints.rising}) == 3
    assert list(hints.started) == [ObjectKey("way", 4)]
    razed = hints.gone[shapely.get_type_id(hints.gone) == 1][0]
    assert shapely.get_x(razed.centroid) == pytest.approx(500_000 + 0.006 * 111_320 * np.cos(np.radians(47)), abs=2)


def test_a_house_replaced_by_a_site_and_a_site_replaced_by_a_house_are_the_worlds_change(tmp_path):
    stays = (9, {"building": "yes"}, square(8, 8))
    old = osm(
        tmp_path / "a-2015-01-01.osm",
        *FRAME,
        (1, {"building": "yes"}, square(2, 2)),
        (2, {"landuse": "construction"}, square(4, 4, 1)),
        stays,
    )
    new = osm(
        tmp_path / "a-2018-01-01.osm",
        *FRAME,
        (1, {"demolished:building": "yes"}, square(2, 2)),
        (3, {"building": "yes"}, square(4.2, 4.2)),
        (4, {"building": "yes", "start_date": "C19"}, square(6, 6)),
        stays,
    )
    row = found(read_history(date_extracts([new, old])))
    assert (row["vanished_share"], row["vanished_world_share"]) == (pytest.approx(0.5, abs=1e-3), 1.0)
    assert row["appeared_world_share"] == pytest.approx(0.5, abs=1e-3)
    assert row["appeared_mapping_share"] == pytest.approx(0.5, abs=1e-3)
    assert row["appeared_untold_share"] == pytest.approx(0.0, abs=1e-6)


@pytest.mark.parametrize(
    ("text", "first", "last"),
    [
        ("1987", "1987-01-01", "1987-12-31"),
        ("2016-12", "2016-12-01", "2016-12-31"),
        ("2016-02-29", "2016-02-29", "2016-02-29"),
        ("1920s", "1920-01-01", "1929-12-31"),
        ("C18", "1701-01-01", "1800-12-31"),
        ("~2000", "1998-01-01", "2002-12-28"),
        ("before 1900-05-06", "0001-01-01", "1900-05-06"),
    ],
)
def test_start_dates_mean_a_span_of_days(text, first, last):
    assert tuple(map(str, parse_start(text))) == (first, last)


@pytest.mark.parametrize("text", [None, "", "yes", "2016-13", "2015-02-30", "C0", "0000", "99999"])
def test_start_dates_that_say_nothing_are_left_out(text):
    assert parse_start(text) is None


# Real data


@pytest.mark.slow
@pytest.mark.real
def test_the_redraw_of_2021_in_liechtenstein_changed_ids_but_hardly_any_house(real_extracts):
    paths = [real_extracts / f"liechtenstein-{day}.osm.pbf" for day in ("2021-05-05", "2021-10-28")]
    row = found(read_history(date_extracts(paths), bounds=(9.47, 47.20, 9.60, 47.27)))
    assert row["n_from"] > 1000
    assert row["id_vanished_share"] > 0.2
    assert row["vanished_share"] < 0.05


@pytest.mark.real
@pytest.mark.slow
def test_the_history_of_andorra_grows_from_year_to_year(real_extracts):
    path = real_extracts / "andorra-2017-02-19.osh.pbf"
    history = read_history(date_extracts([path], at=[dt.date(2012, 1, 1), dt.date(2017, 1, 1)]))
    row = found(history, "road_minor")
    assert row["n_to"] > row["n_from"] > 100
    assert row["vanished_share"] < 0.3
