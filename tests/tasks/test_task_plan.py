# SPDX-License-Identifier: Apache-2.0
"""Requests: what a user asks for becomes one request for each region and suite, or one line that names the mend."""

import datetime as dt
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from sasgeo_bench.core.config import shipped_dir
from sasgeo_bench.core.errors import ConfigError
from sasgeo_bench.core.progress import reporting
from sasgeo_bench.regions.region_spec import find_region_file, list_region_files, read_region_file
from sasgeo_bench.tasks.split import find_split_file, make_split, read_split_file
from sasgeo_bench.tasks.suites.ages import AGES_YEARS, DAYS_PER_YEAR
from sasgeo_bench.tasks.task_plan import (
    TaskRequest,
    aged_dates,
    check_count,
    check_roots,
    older_dates,
    plan_requests,
    wrong_place,
)

RIVERSIDE = "town-riverside"


@pytest.fixture(autouse=True)
def _no_extracts(monkeypatch, tmp_path):
    """What is planned does not depend on what lies on this machine."""
    for name in ("SASGEO_EXTRACTS", "SASGEO_IMAGERY"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))


@pytest.fixture(scope="module")
def known():
    return {name: read_region_file(path) for name, path in list_region_files().items()}


def plan(tmp_path, **changes):
    base = {"suites": ("clean",), "regions": (RIVERSIDE,), "split": "crossfit", "count": 2, "seed": 0}
    return plan_requests(TaskRequest(**base | {"out": tmp_path / "out"} | changes))


def own_region(folder: Path, *, name: str = "mine", source: str = RIVERSIDE, **changes: str) -> Path:
    text = (shipped_dir("regions") / f"{source}.toml").read_text()
    for old, new in {f'id = "{source}"': f'id = "{name}"', **changes}.items():
        assert old in text
        text = text.replace(old, new)
    path = folder / f"{name}.toml"
    path.write_text(text)
    return path


def own_split(folder: Path, *names: str, reach_m: float = 360.0, buffer_m: float = 0.0) -> Path:
    parts = ["train", "test"] * len(names)
    lines = [f'id = "mine"\ntitle = "Mine"\nkind = "holdout"\nbuffer_m = {buffer_m:.1f}\nreach_m = {reach_m:.1f}']
    for name, part in zip(names, parts, strict=False):
        lines.append(f'[[place]]\nname = "{name}"\nregions = ["{name}"]')
        lines.append(f'part = "{part}"')
    path = folder / "split.toml"
    path.write_text("\n".join(lines) + "\n")
    return path


def test_there_is_one_request_for_each_region_and_suite_whatever_is_named_twice(tmp_path):
    found = plan(tmp_path, suites=("clean", "alias", "clean"), regions=(RIVERSIDE, "town-grid", RIVERSIDE))
    assert [(item.region.id, item.suite) for item in found] == [
        (RIVERSIDE, "clean"),
        (RIVERSIDE, "alias"),
        ("town-grid", "clean"),
        ("town-grid", "alias"),
    ]


def test_without_regions_all_that_can_be_built_are_taken_and_the_others_told(tmp_path):
    lines = []
    with reporting(lines.append):
        found = plan(tmp_path, regions=())
    assert {item.region.id for item in found} == {name for name in list_region_files() if name.startswith("town-")}
    assert len(lines) == 1
    assert "vaduz" in lines[0]
    assert "have no extract on this machine" in lines[0]


@pytest.mark.real
def test_without_regions_those_with_an_extract_are_taken_too(tmp_path, real_extracts):
    found = plan(tmp_path, regions=(), extract_folders=(real_extracts,))
    assert any(not item.region.id.startswith("town-") for item in found)


def test_a_region_file_of_ones_own_goes_with_a_split_of_ones_own(tmp_path):
    own = own_region(tmp_path)
    split = own_split(tmp_path, "mine", "town-suburb", "town-grid")  # train, test, train
    (item,) = plan(tmp_path, regions=(str(own),), split=str(split))
    assert item.region.id == "mine"
    assert item.elsewhere.id == "town-grid"
    folder = tmp_path / "more"
    folder.mkdir()
    own.rename(folder / "mine.toml")
    (again,) = plan(tmp_path, regions=("mine",), split=str(split), region_folders=(folder,))
    assert again.region == item.region


@pytest.mark.parametrize(
    ("changes", "expected"),
    [
        (
            {"suites": ("claen",)},
            "there is no suite 'claen', did you mean 'clean'? (list suites shows all; or module:NAME)",
        ),
        ({"suites": ("clean", "zzz")}, "there is no suite 'zzz' (list suites shows all; or module:NAME)"),
        ({"regions": ("town-rivercide",)}, "did you mean 'town-riverside'"),
        ({"split": "crosfit"}, "there is no split 'crosfit', did you mean 'crossfit'"),
        ({"split": "none.toml"}, "there is no split file none.toml"),
        ({"count": 0}, "--n must be at least 1, got 0"),
        ({"count": -3}, "--n must be at least 1, got -3"),
    ],
)
def test_what_cannot_be_is_refused_with_a_hint(changes, expected, tmp_path):
    with pytest.raises(ConfigError) as caught:
        plan(tmp_path, **changes)
    assert expected in str(caught.value)
    assert list(tmp_path.iterdir()) == []


def test_a_split_that_names_an_unknown_region_is_refused(tmp_path):
    split = own_split(tmp_path, RIVERSIDE, "atlantis")
    with pytest.raises(ConfigError, match="split 'mine' names the unknown region 'atlantis': list regions shows all"):
        plan(tmp_path, split=str(split))


def test_a_region_that_the_split_does_not_speak_of_is_refused(tmp_path):
    split = own_split(tmp_path, "town-grid", "town-suburb")
    with pytest.raises(ConfigError, match="'mine' does not speak of region 'town-riverside': new-split makes a split"):
        plan(tmp_path, split=str(split))


def test_truths_among_the_tasks_are_refused(tmp_path):
    out = tmp_path / "out"
    (out / "tasks" / "hidden").mkdir(parents=True)
    check_roots(out)
    (out / "truth").symlink_to(out / "tasks" / "hidden")
    with pytest.raises(ConfigError, match="choose another --out"):
        check_roots(out)


@pytest.mark.parametrize("below", ["", "deep", "deep/er"])
def test_an_out_inside_a_task_is_refused(below, tmp_path):
    task = tmp_path / "tasks" / "clean" / "here"
    task.mkdir(parents=True)
    (task / "task.json").write_text("{}")
    with pytest.raises(ConfigError, match=r"lies inside .*/tasks/clean/here, where the queries are: choose another"):
        check_roots(task / below)


@given(st.integers(max_value=0))
def test_no_count_below_one_is_taken(count):
    with pytest.raises(ConfigError, match=str(count)):
        check_count(count)


def test_a_wrong_place_is_another_place_of_the_split_and_a_town_for_a_town(known):
    for name in ("crossfit", "holdout", "places"):
        split = make_split(read_split_file(find_split_file(name)), {key: item.grid() for key, item in known.items()})
        place = {region: place.name for place in split.spec.place for region in place.region_ids}
        for region, own in place.items():
            spec = known[region]
            other = wrong_place(split, spec, known)
            assert place[other.id] != own
            assert split.spec.kind == "crossfit" or split.part_of(place[other.id]) == split.part_of(own)
            assert (other.pick(None).town is None) == (spec.pick(None).town is None)


def test_a_wrong_place_does_not_depend_on_what_else_is_asked_for(tmp_path):
    alone = plan(tmp_path)[0].elsewhere
    among = {item.region.id: item.elsewhere for item in plan(tmp_path, regions=("town-grid", RIVERSIDE, "town-suburb"))}
    assert among[RIVERSIDE] == alone


def test_without_a_second_place_of_its_kind_a_region_has_no_wrong_place(tmp_path):
    split = own_split(tmp_path, RIVERSIDE, "vaduz")
    assert plan(tmp_path, split=str(split))[0].elsewhere is None


def pictured(known, *names):
    """Region files of which the named ones have imagery."""
    entry = next(item.imagery[0] for item in known.values() if item.imagery).model_copy(update={"publish": True})
    return {name: item.model_copy(update={"imagery": [entry] if name in names else []}) for name, item in known.items()}


@pytest.mark.parametrize(
    ("region", "with_pictures", "expected"),
    [
        ("vaduz", ("porto", "munich"), "munich"),  # of the same part
        ("vaduz", ("porto",), "porto"),  # or of a train place, from whose pictures anybody learns
        ("porto", ("munich",), None),  # but none learns from a test place
        ("munich", ("lauf", "porto"), "porto"),  # nor is a place of the same country another one
        ("vaduz", (), None),
    ],
)
def test_a_wrong_picture_is_of_the_same_part_or_a_train_place(region, with_pictures, expected, known, tmp_path):
    places = (("vaduz", "test", "li"), ("munich", "test", "de"), ("lauf", "test", "de"), ("porto", "train", "pt"))
    lines = ['id = "mine"\ntitle = "Mine"\nkind = "holdout"\nbuffer_m = 0.0']
    lines += [
        f'[[place]]\nname = "{name}"\nregions = ["{name}"]\npart = "{part}"\ncountry = "{country}"'
        for name, part, country in places
    ]
    (tmp_path / "mine.toml").write_text("\n".join(lines) + "\n")
    split = make_split(read_split_file(tmp_path / "mine.toml"), {name: item.grid() for name, item in known.items()})
    files = pictured(known, *with_pictures)
    other = wrong_place(split, files[region], files, is_pictured=True)
    assert (other and other.id) == expected


def lending(tmp_path, known, *lends: str):
    lines = ['id = "mine"\ntitle = "Mine"\nkind = "crossfit"\nbuffer_m = 0.0', f"lends = {list(lends)}"]
    for name, half in (("vaduz", "a"), ("porto", "b"), ("munich", "a"), ("lauf", "b")):
        lines.append(f'[[place]]\nname = "{name}"\nregions = ["{name}"]\nhalf = "{half}"')
    (tmp_path / "mine.toml").write_text("\n".join(lines) + "\n")
    return make_split(read_split_file(tmp_path / "mine.toml"), {name: item.grid() for name, item in known.items()})


def test_a_region_beside_the_split_lends_its_picture_where_no_place_has_one(known, tmp_path):
    split = lending(tmp_path, known, "krems")
    for there, expected in (("porto", "krems"), "porto"), (("krems",), "krems"), (("helsinki",), None):
        found = wrong_place(split, known["vaduz"], pictured(known, *there), is_pictured=True)
        assert (found and found.id) == expected
    assert wrong_place(split, known["vaduz"], known).id == "porto"  # views of maps stay among the places
    assert "krems" not in split.spec.region_ids


def test_a_lender_is_a_known_region_beside_the_places(known, tmp_path):
    with pytest.raises(ConfigError, match="region 'porto' stands under 'lends' and in a place: take it out of one"):
        lending(tmp_path, known, "porto")
    with pytest.raises(ConfigError, match="names the unknown region 'atlantis'"):
        lending(tmp_path, known, "atlantis")


def test_a_picture_over_a_map_of_fewer_classes_is_lent_where_there_is_no_other(known, tmp_path):
    split = lending(tmp_path, known)
    few = {name: item.model_copy(update={"classes": ["building"]}) for name, item in known.items() if name == "porto"}
    for there, expected in (("porto",), "porto"), (("porto", "munich"), "munich"):
        found = wrong_place(split, known["vaduz"], pictured(known | few, *there), is_pictured=True)
        assert found.id == expected


def test_a_picture_that_is_not_on_this_machine_is_not_asked_for_and_that_is_told(tmp_path):
    lines: list[str] = []
    with reporting(lines.append):
        (request,) = plan(tmp_path, suites=("real-image",), regions=("chateaugiron-ortho",), split="world")
    assert request.elsewhere is None
    assert lines == [
        "real-image on chateaugiron-ortho: pardubice-ortho is not on this machine, so no view is of another town"
    ]


def test_a_picture_that_must_not_be_passed_on_is_not_lent_to_one_that_may(known, tmp_path):
    path = own_split(tmp_path, "vaduz", "munich", "porto", "lauf")  # train and test in turn
    split = make_split(read_split_file(path), {name: item.grid() for name, item in known.items()})
    files = pictured(known, "vaduz", "porto")
    closed, lent = [], []
    for own, other in ((True, True), (True, False), (False, False), (False, True)):
        for name, publish in (("vaduz", own), ("porto", other)):
            entry = files[name].imagery[0].model_copy(update={"publish": publish})
            files[name] = files[name].model_copy(update={"imagery": [entry]})
        found = wrong_place(split, files["vaduz"], files, is_pictured=True)
        (closed if found is None else lent).append((own, other))
    assert closed == [(True, False)]
    assert len(lent) == 3


def test_a_suite_searches_the_older_maps_of_fitting_age_or_every_one():
    vaduz = read_region_file(find_region_file("vaduz"))
    newest = max(extract.date for extract in vaduz.extract)
    every = older_dates(vaduz, ("imagery", "every older map"))
    assert every == tuple(sorted(extract.date for extract in vaduz.extract if extract.date != newest))
    assert older_dates(vaduz, ("older maps",)) == aged_dates(vaduz) != every
    assert older_dates(vaduz, ("imagery",)) == ()


@given(st.lists(st.dates(dt.date(2005, 1, 1), dt.date(2026, 1, 1)), min_size=1, max_size=12, unique=True))
def test_maps_of_each_age_are_those_nearest_by_ratio(dates):
    shipped = read_region_file(find_region_file(RIVERSIDE))
    extracts = [shipped.extract[0].model_copy(update={"date": date}) for date in dates]
    found = aged_dates(shipped.model_copy(update={"extract": extracts}))
    newest = max(dates)
    assert found == tuple(sorted(set(found)))
    assert set(found) <= set(dates) - {newest}
    assert len(found) <= len(AGES_YEARS)
    assert bool(found) == (len(dates) > 1)

    def off(date, years):
        ratio = (newest - date).days / DAYS_PER_YEAR / years
        return max(ratio, 1 / ratio)

    older = [date for date in dates if date < newest]
    for years in AGES_YEARS if older else ():
        assert min(off(date, years) for date in found) == pytest.approx(min(off(date, years) for date in older))


def test_a_request_needs_the_extract_of_its_region_and_the_map_of_ones_own_beside_it(tmp_path):
    (request,) = plan(tmp_path, regions=("koeln-ortho",), split="world")
    needed = {extract.file: extract.format for extract in request.extracts}
    assert needed == {"koeln-2026-08-06.osm.pbf": "osm", "koeln-messe-lod2-footprints.geojson": "own_map"}
