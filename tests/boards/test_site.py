# SPDX-License-Identifier: Apache-2.0
"""Tables of a site: every page has its own name, ties are told, what is registered is said in words."""

import json
import math
import re
from dataclasses import replace
from pathlib import Path

import pandas as pd
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sasgeo_bench.ageing.ratebook import load_ratebook
from sasgeo_bench.boards import site_maps as pages
from sasgeo_bench.boards.board import Board
from sasgeo_bench.boards.board_files import TABLES
from sasgeo_bench.boards.board_tables import (
    SHOWN_COSTS,
    Book,
    cost_table,
    rejection_tables,
    risk_tables,
    risk_tables_by_suite,
    sections_of,
    suite_table,
)
from sasgeo_bench.boards.manifests import (
    BoardTask,
    Elsewhere,
    ElsewhereRow,
    FailedCase,
    PicturesManifest,
    RegionMap,
)
from sasgeo_bench.boards.overview import overviews_of
from sasgeo_bench.boards.site import site_pages
from sasgeo_bench.boards.site_files import SiteSource, Spot
from sasgeo_bench.boards.site_maps import draw_places, draw_rates, place_maps, places_on_map, regions_of
from sasgeo_bench.boards.site_pages import contrasts_of, matchers_of
from sasgeo_bench.boards.tables import MEANINGS, file_stem, page_names, text_of, ties_of
from sasgeo_bench.core.errors import StoreError
from sasgeo_bench.scoring.compare import CONTRAST_SCHEMA, Finding
from sasgeo_bench.scoring.controls import FALSIFIER_SCHEMA, Falsifier
from sasgeo_bench.scoring.rows import ALL_SUITES, FIGURE_SCHEMA, Row
from tests.handmade import BOUNDS_M, HOSTILE, MARKUP, about_of, answers_of, card_of, entry_of, many_rows

FINDING = Finding(
    name="age",
    first="graph",
    second="raster",
    metric="primary",
    n=120,
    blocks=40,
    places=18,
    best=1.0,
    first_value=0.7,
    second_value=0.6,
    difference=0.1,
    lo=0.04,
    hi=0.16,
    first_only=20,
    second_only=8,
    p_exact=0.01,
    p_clustered=0.01,
    p_holm=0.02,
    detectable=0.05,
    least=0.03,
)
KEY = ("real-age", "localization", "r500-weak-s3")


def source(table=None, findings=(), entries=(), **changes):
    board = many_rows(6) if table is None else table
    about = about_of([entry_of(name, **each) for name, each in dict(entries).items()])
    tables = {name: changes.pop(name) for name in TABLES if name in changes}
    made = Board(
        folder=Path("mine"), about=about, leaderboard=board, **{"contrasts": CONTRAST_SCHEMA.frame(findings), **tables}
    )
    return SiteSource(name="mine", title="Mine", board=made, rates=load_ratebook(), **changes)


def book_of(given):
    return Book.of(given.board.leaderboard, given.board.about.entries, given.board.scores)


@given(st.lists(st.text(max_size=80), unique=True, max_size=12))
def test_every_name_has_a_page_of_its_own_that_any_file_system_takes(names):
    pages = page_names("matcher", names)
    assert list(pages) == names
    assert len({page.lower() for page in pages.values()}) == len(names)
    for page in pages.values():
        assert re.fullmatch(r"[a-z0-9-]{1,90}\.html", page)


@given(st.lists(st.tuples(st.integers(1, 8), st.integers(0, 3)), max_size=8))
def test_ties_hold_all_whose_ranks_overlap_and_nobody_else(ranks):
    rows = [
        {"matcher": f"m{at}", "rank_best": best, "rank_worst": best + more} for at, (best, more) in enumerate(ranks)
    ]
    tie_of = {name: number for number, tie in enumerate(ties_of(rows)) for name in tie.names}
    for one in rows:
        others = [other for other in rows if other is not one]
        shares = [
            other
            for other in others
            if one["rank_best"] <= other["rank_worst"] and other["rank_best"] <= one["rank_worst"]
        ]
        assert (one["matcher"] in tie_of) == bool(shares)
        assert all(tie_of[other["matcher"]] == tie_of[one["matcher"]] for other in shares)


def test_controls_and_those_without_a_rank_are_in_no_tie():
    rows = [
        {"matcher": "random", "rank_best": 1, "rank_worst": 2},
        {"matcher": "a", "rank_best": pd.NA, "rank_worst": pd.NA},
        {"matcher": "b", "rank_best": 1, "rank_worst": 2},
    ]
    assert ties_of(rows) == ()


def test_rows_of_another_board_with_the_same_queries_stand_on_the_first_page():
    row = ElsewhereRow(matcher="dense", n=7, value=0.9, lo=0.8, hi=1.0)
    given = source()
    (key,) = {(item.suite, item.track, item.prior_group) for item in sections_of(book_of(given))}
    where = dict(zip(("suite", "track", "prior_group"), key, strict=True))
    other = Elsewhere(board="systems", **where, metric="success_25m", rows=[row])
    board = replace(given.board, about=given.board.about.model_copy(update={"elsewhere": [other]}))
    page = site_pages(replace(given, board=board))["index.html"]
    assert "The same 7 queries on the board systems: its best rows, not ranked here" in page


def test_a_table_is_sorted_by_its_figure_and_says_who_is_tied():
    book = book_of(source())
    (section,) = sections_of(book)
    texts = [[cell.text for cell in row.cells] for row in section.table.rows]
    assert [row[0] for row in texts] == [HOSTILE, MARKUP, *(f"matcher-{at:03d}" for at in range(4))]
    assert texts[0][1:3] == ["1.000 [0.900, 1.000]", "1-4"]
    assert section.table.rows[0].cells[2].marks[0].text == "tie"
    assert section.table.notes[0].startswith(f"Tied: {HOSTILE}, {MARKUP}, matcher-000")
    assert section.table.notes[0].endswith("share ranks 1 to 6.")
    assert {column.term for column in section.table.columns} <= MEANINGS.keys()


def test_who_may_be_first_leads_in_the_overview_which_is_sorted_by_its_first_figure():
    first = many_rows(6)
    first.loc[first["matcher"] == "matcher-003", ["rank_best", "rank_worst"]] = [5, 6]
    fewer = first[first["matcher"] != HOSTILE].assign(suite="occlusion")
    (table,) = (item.shown for item in overviews_of(book_of(source(pd.concat([first, fewer], ignore_index=True)))))
    heads = [[cell.text for cell in row.cells] for row in table.rows if row.tone == "head"]
    assert heads == [["queries", "80", "80"]]
    names = [row.cells[0].text for row in table.rows if row.tone != "head"]
    assert names[:2] == [HOSTILE, MARKUP]
    assert [(column.name, column.order) for column in table.columns[1:]] == [
        ("real-age", "descending"),
        ("occlusion", "none"),
    ]
    assert table.rows[1].cells[-1].text == "-"
    assert {row.tone for row in table.rows[1:]} == {"tied"}
    tones = {row.cells[0].text: row.cells[1].tone for row in table.rows}
    assert [tones[name] for name in (MARKUP, HOSTILE, "matcher-003")] == ["leading", "leading", "plain"]


def test_who_has_no_rival_does_not_lead():
    (table,) = (item.shown for item in overviews_of(book_of(source(many_rows(1)))))
    assert [row.cells[1].tone for row in table.rows] == ["plain", "plain"]  # the first says how many queries count


def test_tables_of_one_contestant_come_last():
    alone = many_rows(1).assign(suite="absent")
    sections = sections_of(book_of(source(pd.concat([many_rows(6), alone], ignore_index=True))))
    assert [item.suite for item in sections][-1] == "absent"


def test_prior_groups_and_tracks_are_never_in_one_table():
    other = many_rows(6).assign(prior_group="rnone-unknown-s15")
    table = pd.concat([many_rows(6), other], ignore_index=True)
    sections = sections_of(book_of(source(table)))
    assert [item.prior_group for item in sections] == ["r500-weak-s3", "rnone-unknown-s15"]
    assert [len(item.table.rows) for item in sections] == [6, 6]
    assert len({item.table.name for item in sections}) == 2


def test_who_is_set_apart_stands_in_a_table_below_with_the_reason():
    values = {"matcher-000": {"set_apart": "trained on the test place vaduz"}, "matcher-001": {}, "elsewhere": {}}
    (section,) = sections_of(book_of(source(entries=values)))
    assert "matcher-000" not in [row.cells[0].text for row in section.table.rows]
    assert [row.cells[0].text for row in section.apart.rows] == ["matcher-000"]
    assert section.apart.notes == ("matcher-000: trained on the test place vaduz.",)
    assert section.table.notes[-1] == "Not asked here: elsewhere."


def test_a_matcher_that_cannot_has_words_and_no_figure():
    table = many_rows(3)
    table.loc[0, "is_applicable"] = False
    table.loc[0, ["value", "lo", "hi"]] = float("nan")
    table.loc[0, ["rank_best", "rank_worst"]] = pd.NA
    shown = suite_table(book_of(source(table)), KEY, [HOSTILE, MARKUP])
    assert [[cell.text for cell in row.cells[1:3]] for row in shown.rows] == [
        ["0.667 [0.567, 0.767]", "1-3"],
        ["not applicable", "-"],
    ]


@pytest.mark.parametrize(
    ("changes", "outcome", "headline", "because"),
    [
        ({}, "decided", "graph is better than raster, by as much as matters", ""),
        (
            {"gains_without_stress": True},
            "cause open",
            "graph is better than raster, by as much as matters; cause open: it gains without the stress, too",
            "",
        ),
        ({"least": 0.2}, "decided, small", "graph is better than raster, by less than would matter", ""),
        (
            {"least": 0.2, "p_holm": 1.0},
            "equal",
            "graph and raster are equal (within 0.2)",
            "any difference is smaller than would matter",
        ),
        ({"places": 2}, "not decided", "graph against raster", "2 places, at least 6 are needed"),
        ({"n": 0}, "not tested", "graph against raster", "no query"),
    ],
)
def test_a_contrast_is_reported_in_words_with_figure_interval_p_and_counts(changes, outcome, headline, because):
    (result,) = contrasts_of(source(findings=[replace(FINDING, **changes)]))
    assert (result.outcome, result.headline, result.because) == (outcome, headline, because)
    if result.outcome == "equal":
        assert result.facts[0] == "adjusted p 1.000 (Holm, 1 contrast)"
    elif "n" not in changes:
        assert result.sentence.startswith("Difference 0.100 [0.040, 0.160] in the share of queries that are right")
        assert result.facts[:3] == ("adjusted p 0.020 (Holm, 1 contrast)", "n = 120 queries", "40 blocks")
    else:
        assert result.sentence == "No query of this board counts for it."


def test_what_is_decided_stands_first():
    changes = ({"places": 2}, {"lo": -0.01, "hi": 0.02, "p_holm": 1.0}, {"least": 0.2}, {})
    findings = [replace(FINDING, name=f"c{at}", **each) for at, each in enumerate(changes)]
    assert [entry.name for entry in contrasts_of(source(findings=findings))] == ["c3", "c2", "c1", "c0"]


def test_places_lie_in_the_middle_of_their_regions_and_unknown_ones_nowhere():
    spots = {
        name: Spot(region=name, title=name, longitude_deg=lon, latitude_deg=47.0, scenes=("urban",))
        for name, lon in (("vaduz", 9.0), ("eschen", 10.0), ("unasked", 50.0))
    }
    parts = {"vaduz": ("liechtenstein", "a"), "eschen": ("liechtenstein", "a")}
    tasks = [BoardTask(suite="clean", region=name) for name in ("vaduz@2015-07-27", "eschen+alias", "mine")]
    (place,) = places_on_map(tasks, spots, parts)
    assert (place.number, place.name, place.part, place.longitude_deg) == (1, "liechtenstein", "a", 9.5)
    assert list(regions_of(tasks)) == ["eschen", "mine", "vaduz"]


def test_the_drawings_of_a_site_say_what_they_show_and_whose_data_it_is(tmp_path):
    spots = {
        name: Spot(region=name, title=name, longitude_deg=lon, latitude_deg=lat, scenes=(), is_made_up=name == "town")
        for name, lon, lat in (("vaduz", 9.5, 47.1), ("town", 11.0, 48.0), ("oakland", -122.0, 37.8))
    }
    parts = {"vaduz": ("liechtenstein", "a"), "oakland": ("oakland", "b")}
    places = places_on_map([BoardTask(suite="clean", region=name) for name in spots], spots, parts)
    draw_places(tmp_path / "places.svg", places)
    draw_rates(tmp_path / "rates.svg", load_ratebook())
    texts = {
        name: re.findall(r"<text[^>]*>([^<]*)", (tmp_path / name).read_text()) for name in ("places.svg", "rates.svg")
    }
    assert {"1", "2", "3", "half a", "half b", "no part", "all places (n = 3)", "those in Europe (n = 2)"} <= {
        *texts["places.svg"]
    }
    assert {"liechtenstein", "building", "vanishes, of the older map", "0.1"} <= {*texts["rates.svg"]}
    for found in texts.values():
        assert "Data: (c) OpenStreetMap contributors, ODbL" in found


def test_rejectors_of_controls_come_last_however_good_their_order_is():
    facts = {"suite": "all suites", "track": "localization", "prior_group": "r500-weak-s3", "stratum": "as drawn"}
    facts |= {"n": 9, "answered": 9, "missing": 0, "blocks": 2, "places": 2, "unit": "1", "better": "lower"}
    areas = {("oracle_pose", "own"): 0.0, ("raster", "margin"): 0.3, ("graph", "own"): 0.2, ("random", "own"): 0.9}
    rows = [
        Row(matcher=name[0], rejector=name[1], metric="aurc", value=value, **facts) for name, value in areas.items()
    ]
    (table,) = rejection_tables(FIGURE_SCHEMA.frame(rows))
    assert [(row.cells[0].text, row.tone) for row in table.rows] == [
        ("graph", "plain"),
        ("raster", "plain"),
        ("oracle_pose", "control"),
        ("random", "control"),
    ]


def test_of_each_ranked_matcher_the_rejector_with_the_best_order_says_what_is_answered_at_a_risk():
    facts = {"suite": "all suites", "track": "localization", "prior_group": "r500-weak-s3", "stratum": "as drawn"}
    facts |= {"n": 9, "answered": 9, "missing": 0, "blocks": 2, "places": 2, "unit": "1", "better": "lower"}
    figures = {
        ("oracle_pose", "own"): (0.0, 1.0, 0.0),
        ("raster", "margin"): (0.3, 0.5, 0.06),
        ("raster", "own"): (0.4, 0.7, 0.0),
        ("graph", "own"): (0.2, 0.8, 0.04),
    }
    metrics = ("aurc", "coverage_at_risk_0.05", "risk_reached_at_0.05")
    rows = [
        Row(matcher=name[0], rejector=name[1], metric=metric, value=value, **facts)
        for name, values in figures.items()
        for metric, value in zip(metrics, values, strict=True)
    ]
    (table,) = risk_tables(FIGURE_SCHEMA.frame(rows))
    assert [[cell.text for cell in row.cells][:2] for row in table.rows] == [["graph", "own"], ["raster", "margin"]]
    assert [[text_of(cell) for cell in row.cells][2:] for row in table.rows] == [
        ["0.800", "0.040", "-", "9"],
        ["0.500", "0.060", "-", "9"],
    ]


def test_whether_the_risk_was_kept_is_said_by_its_interval_and_where_it_was_not_by_suite():
    facts = {"matcher": "m", "rejector": "own", "track": "localization", "prior_group": "r500-weak-s3", "unit": "1"}
    facts |= {"n": 9, "answered": 9, "missing": 0, "blocks": 2, "places": 2, "better": "lower"}
    whole = {"suite": "all suites", "stratum": "as drawn"}
    rows = [
        Row(metric="aurc", value=0.1, **facts, **whole),
        Row(metric="risk_reached_at_0.05", value=0.04, lo=0.02, hi=0.07, **facts, **whole),
        Row(metric="risk_reached_at_0.05", value=0.2, suite="all suites", stratum="present 0.5", **facts),
        Row(metric="risk_reached_at_0.05", value=0.3, suite="twins", stratum="as drawn", **facts),
    ]
    (table,) = risk_tables(FIGURE_SCHEMA.frame(rows))
    assert table.rows[0].cells[4].text == "open"
    (table,) = risk_tables_by_suite(FIGURE_SCHEMA.frame(rows))
    values = {one.name: text_of(cell) for one, cell in zip(table.columns, table.rows[0].cells, strict=True)}
    assert values | {"50 % of places absent": "0.200", "30 % of places absent": "-", "twins": "0.300"} == values


def test_words_of_files_are_plain():
    assert file_stem("board", *KEY) == "board-real-age-localization-r500-weak-s3"
    assert file_stem("../..", "..") == "page"


def test_a_contrast_says_how_both_fare_where_they_should_not_differ():
    rows = [
        Falsifier(contrast=FINDING.name, suite="all", kind="all", finding=replace(FINDING, n=80, blocks=9)),
        Falsifier(contrast="other", suite="all", kind="all", finding=FINDING),
    ]
    gained = replace(FINDING, gains_without_stress=True)
    (result,) = contrasts_of(source(findings=[gained], falsifiers=FALSIFIER_SCHEMA.frame(rows)))
    assert result.unstressed.startswith("Without the stress, where they should not differ: ")
    assert "(n = 80, 9 blocks). What it gains there is not owed" in result.unstressed
    assert result.outcome == "cause open"
    (silent,) = contrasts_of(source(findings=[FINDING]))
    assert silent.unstressed == ""
    none = replace(rows[0], finding=replace(FINDING, lo=-0.1))
    (result,) = contrasts_of(source(findings=[FINDING], falsifiers=FALSIFIER_SCHEMA.frame([none])))
    assert "no gain shown" in result.unstressed
    assert "not owed" not in result.unstressed
    assert result.outcome == "decided"


@pytest.mark.parametrize(
    ("expected", "words"),
    [
        ("none", "no place that its card names"),
        ([], "no place that its card names"),
        (["porto", "monaco"], "porto, monaco"),
        ({"a": ["munich"], "b": "none"}, "half a: munich; half b: no place that its card names"),
    ],
)
def test_places_that_a_card_names_are_words_and_not_letters(expected, words):
    card = card_of("graph", trained_on=expected)
    given = source(table=many_rows(1).assign(matcher="graph"), entries={"graph": {"card": card}})
    (page,) = matchers_of(given, book_of(given))
    assert page.trained == words


@pytest.mark.parametrize(
    ("places", "words"),
    [
        ("none", "by the runner, in 2 trainings listed below"),
        (["porto"], "porto; by the runner, in 2 trainings listed below"),
    ],
)
def test_a_card_that_names_no_place_does_not_deny_what_the_runner_trained(places, words):
    one = {"file": "a.json", "trained_on": ["munich"], "pairs": 24, "asked": ["clean/vaduz"]}
    learner = {"card": card_of("graph", trained_on=places), "learned": [one, one | {"trained_on": ["prague"]}]}
    given = source(table=many_rows(1).assign(matcher="graph"), entries={"graph": learner})
    (page,) = matchers_of(given, book_of(given))
    assert page.trained == words
    assert [line.partition(";")[0] for line in page.training] == [
        "Trained on 24 queries of munich",
        "Trained on 24 queries of prague",
    ]


def test_a_table_says_which_stress_it_counts_and_who_gave_no_sound_answer():
    rows = {"suite": KEY[0], "track": KEY[1], "prior_group": KEY[2], "matcher": "graph", "status": "ok"}
    rows |= {
        "role": ["control", "stress", "stress"],
        "kind": ["control", "S1", "S2"],
        "is_present": [True, True, False],
    }
    scores = pd.DataFrame(rows)
    scores.loc[2, "status"] = "timeout"
    given = source(table=many_rows(1).assign(matcher="graph"), entries={"graph": {}}, scores=scores)
    (section,) = sections_of(book_of(given))
    assert section.context.startswith("Stress that is counted: S1.")
    assert section.table.notes == (
        "One alone is ranked.",
        "Without a sound answer, which is a miss: graph 1 (timeout).",
    )


def test_the_training_of_a_matcher_is_listed_by_region_because_tasks_are_hundreds():
    learned = {"file": "a.json", "trained_on": ["porto"], "pairs": 24}
    learned["asked"] = ["alias/vaduz+alias", "clean/vaduz", "real-age/eschen@2015-07-27"]
    given = source(table=many_rows(1).assign(matcher="graph"), entries={"graph": {"learned": [learned]}})
    (page,) = matchers_of(given, book_of(given))
    assert page.training == ("Trained on 24 queries of porto; then tested in 3 tasks on eschen, vaduz.",)


def test_a_place_has_its_answers_in_metres_from_the_corner_of_its_map():
    item = RegionMap(region="vaduz", file="vaduz.png", bounds_m=BOUNDS_M)
    unknown = RegionMap(region="balzers", file="balzers.png")
    cases = [FailedCase(query_id="q1", matcher="graph", failure="aliased", file="a.png")]
    pictures = PicturesManifest(regions=[unknown, item], cases=cases)
    whole = source(answers=answers_of([MARKUP]), pictures=pictures)
    ((place, script),) = place_maps(whole).items()
    assert (place.region, place.queries) == ("vaduz", 3)
    record = json.loads(script.partition(", ")[2].removesuffix(");\n"))
    assert record["queries"][0] == ["q0", "real-age", "vaduz@2015-07-27", "S1", 1, 128.0, 100.0, 200.0, 90.0]
    assert record["answers"] == [[MARKUP, [[0, 0, 100.0, 200.0, 90.0], [1, 1, 400.0, 200.0, 90.0], [2, -1]]]]
    assert record["cases"] == {"1": 1}
    assert script.isascii()
    assert place_maps(source(pictures=pictures)) == {}


def test_what_was_not_asked_is_no_failure_on_a_map():
    item = RegionMap(region="vaduz", file="vaduz.png", bounds_m=BOUNDS_M)
    answers = answers_of(["graph"]).assign(status="not applicable", failure="")
    ((_, script),) = place_maps(source(answers=answers, pictures=PicturesManifest(regions=[item]))).items()
    record = json.loads(script.partition(", ")[2].removesuffix(");\n"))
    number = list(pages.OUTCOMES).index("not applicable")
    assert {row[1] for row in record["answers"][0][1]} == {number}
    script = (Path(pages.__file__).parent / "templates" / "map.js").read_text(encoding="utf-8")
    assert f"const NOT_ASKED = {number};" in script
    assert len(re.search(r"COLOURS = \[(.*)\]", script)[1].split(",")) == len(pages.OUTCOMES)


def test_costs_are_sorted_by_the_first_of_them():
    metrics = SHOWN_COSTS[:2]
    values = {"slow": (2.0, 1.0), "quick": (0.1, 9.0), "no answer": (math.nan, 5.0)}
    figures = {
        (ALL_SUITES, "all", "all", name, "all", metric): {"value": value, "unit": "s"}
        for name, found in values.items()
        for metric, value in zip(metrics, found, strict=True)
    }
    names = ("matchers", "strata", "entries", "matcher_pages", "suite_pages", "counted", "lost")
    nothing = {name: {} for name in names}
    table = cost_table(Book(figures=figures, controls=frozenset(), **nothing))
    assert [row.cells[0].text for row in table.rows] == ["quick", "slow", "no answer"]
    assert [column.order for column in table.columns] == ["none", "ascending", "none"]


def test_of_many_answers_a_share_is_drawn_those_with_a_picture_first_and_the_page_says_so(monkeypatch):
    item = RegionMap(region="vaduz", file="vaduz.png", bounds_m=BOUNDS_M)
    some = answers_of(["graph", "raster"])
    many = pd.concat([some.assign(query_id=some["query_id"] + f"-{at}") for at in range(100)], ignore_index=True)
    cases = [FailedCase(query_id="q1-42", matcher="graph", failure="aliased", file="a.png")]
    given = source(answers=many, pictures=PicturesManifest(regions=[item], cases=cases))
    ((place, whole),) = place_maps(given).items()
    assert (place.queries, place.drawn) == (300, 300)
    assert "Every query of a place" in site_pages(given)["map.html"]
    monkeypatch.setattr(pages, "MOST_BYTES", len(whole) // 4)
    ((place, script),) = place_maps(given).items()
    assert place.queries == 300
    assert 40 < place.drawn < 90
    assert len(script) < len(whole) // 3
    record = json.loads(script.partition(", ")[2].removesuffix(");\n"))
    assert len(record["queries"]) == place.drawn
    assert [len(rows) for _, rows in record["answers"]] == [place.drawn, place.drawn]
    assert record["queries"][int(next(iter(record["cases"])))][0] == "q1-42"
    page = site_pages(given)["map.html"]
    assert f"Drawn are {place.drawn} of 300 queries" in page
    assert f"({place.drawn} of 300)" in page


@pytest.mark.parametrize(
    ("column", "value"),
    [("true_northing_m", math.nan), ("fix_easting_m", math.inf), ("view_m", 0.0), ("view_m", 1e308)],
)
def test_answers_that_lie_nowhere_are_refused_by_row(column, value):
    item = RegionMap(region="vaduz", file="vaduz.png", bounds_m=BOUNDS_M)
    answers = answers_of(["mine"])
    answers.loc[1, column] = value
    with pytest.raises(
        StoreError, match=r"^answers\.parquet holds a view or a pose that lies nowhere, in row 1: score"
    ):
        place_maps(source(answers=answers, pictures=PicturesManifest(regions=[item])))


def test_false_fixes_stand_beside_the_success_of_a_suite_with_absent_places():
    absent = many_rows(3).assign(metric="answered_absent", stratum="all", n=30, rank_best=pd.NA, rank_worst=pd.NA)
    (table,) = (
        item.shown for item in overviews_of(book_of(source(pd.concat([many_rows(3), absent], ignore_index=True))))
    )
    assert [column.name for column in table.columns] == ["matcher", "real-age: on the map", "real-age: false fixes"]
    heads, first, *_ = table.rows
    assert [cell.text for cell in heads.cells] == ["queries", "80", "30"]
    assert (first.cells[2].details, first.cells[2].tone) == (("[0.90, 1.00]",), "plain")  # no rank, and nobody leads
    assert "Lower is better" in table.columns[2].meaning
    assert any(
        note.startswith("false fixes, without a rejector: Share of absent places that were answered")
        for note in table.notes
    )


def test_a_ceiling_below_one_is_explained_with_the_oracle_that_passes_it():
    most = many_rows(3).assign(metric="ceiling", value=0.625)
    (table,) = (
        item.shown for item in overviews_of(book_of(source(pd.concat([many_rows(3), most], ignore_index=True))))
    )
    assert [cell.text for cell in table.rows[1].cells] == ["at most", "0.625"]
    assert table.notes[-1].endswith("An oracle gets the answer and passes it.")
    (plain,) = (item.shown for item in overviews_of(book_of(source())))
    assert not any(note.startswith("at most") for note in plain.notes)


def test_the_column_of_a_suite_says_what_is_done_and_which_steps_its_figure_pools():
    rows = {"suite": KEY[0], "track": KEY[1], "prior_group": KEY[2], "matcher": "graph", "status": "ok"}
    rows |= {"role": ["control", *["stress"] * 3], "kind": ["control", "S1", "S1", "S2"], "is_present": True}
    rows |= {"strength": [0.0, 10.0, 2.0, 5.0], "strength_unit": "years, about: age_years is what they are"}
    given = source(table=many_rows(2), scores=pd.DataFrame(rows))
    (table,) = (item.shown for item in overviews_of(book_of(given)))
    assert table.columns[1].meaning.startswith("Real ageing (S1). The map is that of an extract")
    assert table.columns[1].meaning.endswith("Counted, each query alike: S1 at 2, 10; S2 (years, about)")
    (section,) = sections_of(book_of(given))
    assert section.context.startswith("Stress that is counted: S1 at 2, 10; S2 (years, about).")


@pytest.mark.parametrize(
    ("metric", "difference", "side", "sentence"),
    [
        (
            "primary",
            0.1,
            "above 0: graph ahead",
            "in the share of queries that are right: 0.700 against 0.600; more is",
        ),
        (
            "e_aurc",
            0.1,
            "above 0: raster ahead",
            "in the e_aurc (AURC less that of the best order of the same answers)",
        ),
        ("e_aurc", -0.1, "below 0: graph ahead", "less is better. Above 0 raster is ahead, below 0 graph."),
    ],
)
def test_a_contrast_says_who_is_ahead_and_what_its_metric_is(metric, difference, side, sentence):
    finding = replace(FINDING, metric=metric, difference=difference, is_lower_better=metric != "primary")
    (result,) = contrasts_of(source(findings=[finding]))
    assert result.side == side
    assert sentence in result.sentence
