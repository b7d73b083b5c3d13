# SPDX-License-Identifier: Apache-2.0
"""What a board says first: sentences from tables, made from small ones; suites of few queries apart; what was added."""

from dataclasses import replace
from pathlib import Path

import pandas as pd
import pytest

from sasgeo_bench.boards.board import Board
from sasgeo_bench.boards.board_tables import Book
from sasgeo_bench.boards.manifests import BoardManifest
from sasgeo_bench.boards.overview import Headline, overview_lines, overviews_of, times_frame
from sasgeo_bench.boards.publish import publish
from sasgeo_bench.boards.text import contrast_lines
from sasgeo_bench.cli.boards import show_board
from sasgeo_bench.scoring.compare import Finding
from sasgeo_bench.scoring.intervals import BoardInterval
from sasgeo_bench.scoring.rejection import ACCEPTANCE_SCHEMA, Accepted
from sasgeo_bench.scoring.rejection_rows import AS_DRAWN
from sasgeo_bench.scoring.rows import FIGURE_SCHEMA, Row
from tests.handmade import HOSTILE, SHARES, about_of, entry_of, full_board

PRIOR = "r500-weak-s3"


def row(matcher, value, ranks=None, **changes):
    """The first figure of a matcher; `ranks` are the best and the worst that it can have."""
    best, worst = ranks or (None, None)
    values = {"suite": "clean", "track": "localization", "prior_group": PRIOR, "stratum": "all", "rejector": ""}
    values |= {"metric": "success_25m", "unit": "1", "better": "higher", "lo": max(0.0, value - 0.1)}
    values |= {"n": 40, "answered": 40, "missing": 0, "blocks": 12, "places": 12, "hi": min(1.0, value + 0.1)}
    return Row(matcher=matcher, value=value, rank_best=best, rank_worst=worst, **(values | changes))


def book_of(*rows, **changes):
    return Book.of(FIGURE_SCHEMA.frame(list(rows)), **changes)


def said(*rows, **changes):
    (item,) = overviews_of(book_of(*rows, **changes))
    return list(overview_lines(item))


@pytest.mark.parametrize(
    ("rows", "line"),
    [
        (
            {"a": (0.7, (1, 2)), "b": (0.6, (1, 2)), "c": (0.1, (3, 3))},
            "clean: 2 share the first rank (0.600 to 0.700): a and b; behind at least one: c.",
        ),
        (
            {"a": (0.7, (1, 1)), "b": (0.6, (2, 3)), "c": (0.5, (2, 3))},
            "clean: a (0.700) has the first rank alone; b and c are behind.",
        ),
        ({"a": (0.7, (1, 2)), "b": (0.7, (1, 2))}, "clean: both share the first rank (0.700): a and b."),
        (
            {name: (0.9 - at / 10, (1, 5)) for at, name in enumerate("abcde")},
            "clean: all 5 share the first rank (0.500 to 0.900): a, b, c and 2 more.",
        ),
        # Ranks of pairs need not be transitive: nobody else may be first, yet a third is not shown to be worse.
        ({"a": (0.7, (1, 2)), "b": (0.6, (2, 2))}, "clean: a (0.700) alone may be first; b is behind."),
        ({"a": (0.7, (1, 1))}, "clean: a (0.700) is ranked without a rival."),
        ({"a": (0.7, None), "b": (0.6, None)}, "clean: nobody is ranked."),
        ({"random": (0.1, None)}, "clean: asked of controls alone."),
    ],
)
def test_a_sentence_says_who_shares_the_first_rank_and_who_is_behind(rows, line):
    assert said(*(row(name, value, ranks) for name, (value, ranks) in rows.items())) == [line]


def test_where_nobody_is_ranked_the_number_of_places_says_why():
    lines = said(row("a", 0.7, places=4), row("b", 0.6, places=4))
    assert lines == ["clean: nobody is ranked: 4 places, 6 are needed."]


def test_controls_have_no_place_in_a_sentence_however_high_they_are():
    lines = said(row("a", 0.7, (1, 2)), row("b", 0.6, (1, 2)), row("oracle_pose", 1.0))
    assert lines == ["clean: both share the first rank (0.600 to 0.700): a and b."]


def test_suites_that_differ_in_the_segmenter_alone_are_one_family_and_one_sentence():
    rows = [
        row(name, value, (1, 2), suite=suite)
        for suite in ("aerial+one", "aerial+two")
        for name, value in (("a", 0.7), ("b", 0.6))
    ]
    (item,) = overviews_of(book_of(*rows))
    tie = "both share the first rank (0.600 to 0.700): a and b"
    assert item.headlines == (
        Headline(family="aerial", text=f"with one, {tie}; with two, {tie}", page="suite-aerial-one.html"),
    )


@pytest.mark.parametrize(("n", "places", "is_few"), [(9, 9, True), (10, 3, False), (40, 2, True), (10, 2, True)])
def test_suites_of_few_queries_or_places_stand_apart_without_ranks(n, places, is_few):
    small = {"suite": "small", "n": n, "places": places}
    rows = [row(name, 0.5, (1, 2), **more) for more in ({}, small) for name in "ab"]
    (item,) = overviews_of(book_of(*rows))
    lines = list(overview_lines(item))
    assert [one.name for one in item.table.columns[1:]] == (["clean"] if is_few else ["clean", "small"])
    assert any(line.startswith("small: ") for line in lines) != is_few
    assert (f"Too few to rank: small ({n} queries in {places} places)." in lines) == is_few
    if is_few:
        assert [cell.details for cell in item.few_table.rows[1].cells[1:]] == [("[0.40, 0.60]",)]
        assert {one.tone for line in item.few_table.rows for one in line.cells} == {"plain"}


def test_a_board_of_few_queries_alone_shows_them_all_the_same():
    (item,) = overviews_of(book_of(row("a", 0.5, n=4, places=1), row("random", 0.0, n=4, places=1)))
    assert (item.headlines, item.table.rows, item.unsolved) == ((), (), "")
    assert item.shown.title.startswith("Too few to rank (fewer than 10 queries or 3 places)")
    assert [line.cells[0].text for line in item.shown.rows] == ["queries", "a", "random"]


def test_the_table_is_sorted_by_its_first_figure_with_ties_marked_and_controls_below():
    ranks = {"a": (0.2, (3, 4)), "b": (0.3, (3, 4)), "c": (0.9, (1, 2)), "d": (0.8, (1, 2)), "oracle_pose": (1.0, None)}
    rows = [row(name, *found) for name, found in ranks.items()]
    rows += [row("elsewhere", 0.99, (1, 2), suite="season"), row("c", 0.5, (1, 2), suite="season")]
    (item,) = overviews_of(book_of(*rows))
    assert [(line.cells[0].text, line.tone) for line in item.table.rows] == [
        ("queries", "head"),
        ("c", "tied"),
        ("d", "tied"),
        ("b", "other-tie"),
        ("a", "other-tie"),
        ("elsewhere", "plain"),
        ("oracle_pose", "foot"),
    ]


@pytest.mark.parametrize(
    ("ranks", "end"),
    [
        (((1, 2), (1, 2)), "they share ranks, so neither is shown to be better."),
        (((2, 2), (1, 1)), "their ranks do not meet."),
    ],
)
def test_who_was_added_is_marked_and_compared_with_the_highest_figure(ranks, end):
    book = book_of(row("mine", 0.4, ranks[0]), row("a", 0.7, ranks[1]), added=["mine"])
    (item,) = overviews_of(book)
    shown = ["-".join(map(str, dict.fromkeys(one))) for one in ranks]
    assert item.added == (
        f"Added here: mine on clean (0.400, rank {shown[0]}) against a (0.700, rank {shown[1]}): {end}",
    )
    marks = {line.cells[0].text: [mark.text for mark in line.cells[0].marks] for line in item.table.rows}
    assert "added" in marks["mine"]
    assert "added" not in marks["a"]


def test_who_was_added_without_a_rank_or_a_rival_is_not_compared():
    for rows in ([row("mine", 0.4), row("a", 0.7)], [row("mine", 0.4, (1, 1))]):
        (item,) = overviews_of(book_of(*rows, added=["mine", "unknown"]))
        assert item.added == ()


def test_what_is_unsolved_is_what_the_highest_figure_leaves_of_the_ceiling():
    rows = [row("a", value, (1, 1), suite=suite) for suite, value in (("x", 0.9), ("y", 0.5), ("z", 1.0))]
    rows += [row("a", 0.5, suite="y", metric="ceiling")]
    (item,) = overviews_of(book_of(*rows))
    assert item.unsolved == "Highest figures are furthest from what is attainable on x (0.900 of 1.000)."
    (item,) = overviews_of(book_of(row("a", 1.0, (1, 1))))
    assert item.unsolved == "Nothing is left on clean."


def test_what_may_be_trusted_is_said_of_who_was_asked_most_and_of_absent_places():
    figures = {"aurc": 0.1, "coverage_at_risk_0.05": 0.6, "risk_reached_at_0.05": 0.04}
    more = {"suite": "all suites", "rejector": "own", "stratum": "as drawn"}
    rows = [
        row(name, value / times, metric=metric, n=n, **more)
        for name, n, times in (("a", 90, 1), ("easy", 9, 2))
        for metric, value in figures.items()
    ]
    rows += [row("a", 0.5, (1, 2)), row("easy", 0.4, (1, 2))]
    table = FIGURE_SCHEMA.frame(rows)
    (item,) = overviews_of(Book.of(table))
    trusted = (
        "Where 5 % of its answers may be false, a with the rejector own, which orders its answers best, answers 0.600 "
        "[0.500, 0.700] of 90 queries; of these 0.040 [0.000, 0.140] are false: the risk may be kept or not."
    )
    assert item.trust(table, ACCEPTANCE_SCHEMA.empty()) == trusted
    assert item.trust(table[table["rejector"] == ""], ACCEPTANCE_SCHEMA.empty()) == ""

    # All suites together hide the one on which most are false.
    shares = [("clean", 0.01), ("absent", 0.2)]
    by_suite = [row("a", share, metric="risk_reached_at_0.05", **(more | {"suite": suite})) for suite, share in shares]
    (wider,) = overviews_of(Book.of(FIGURE_SCHEMA.frame([*rows, *by_suite, row("a", 0.5, (1, 2), suite="absent")])))
    assert "are false, on absent 0.200: the risk" in wider.trust(
        FIGURE_SCHEMA.frame([*rows, *by_suite]), ACCEPTANCE_SCHEMA.empty()
    )

    accepted = [
        refusal("a", "own", 0.25),
        *(refusal("a", "own", 0.9, **{name: other}) for name, other in OF_ANOTHER.items()),
        refusal("easy", "own", 0.9),
        refusal("a", "margin", 0.9),
    ]
    assert item.trust(table, ACCEPTANCE_SCHEMA.frame(accepted)) == (
        f"{trusted} Where a false fix costs 20 times as much as no fix, it refuses 0.750 [0.650, 0.850] of 8 absent "
        "places, and answers 0.500 of the others, and rightly."
    )
    assert item.trust(table, ACCEPTANCE_SCHEMA.frame(accepted[1:])) == trusted


OF_ANOTHER = {
    "absence": "absent: outside",
    "mixture": "half present",
    "cost_ratio": 5.0,
    "track": "retrieval",
    "prior_group": "r250-weak-s3",
}


def refusal(matcher, rejector, share, **changes):
    """What Eq. 14 accepts of absent places."""
    values = {"track": "localization", "prior_group": PRIOR, "mixture": AS_DRAWN, "absence": "all", "cost_ratio": 20.0}
    values |= {
        "n": 90,
        "absent": 8,
        "places": 12,
        "coverage": BoardInterval(value=0.6),
        "risk": BoardInterval(value=0.1),
    }
    values |= {"right_present": BoardInterval(value=0.5)}
    values |= {"absent_accepted": BoardInterval(value=share, lo=share - 0.1, hi=share + 0.1)}
    return Accepted(matcher=matcher, rejector=rejector, **(values | changes))


def test_groups_of_more_ranked_suites_come_first_and_each_has_its_own_table():
    other = [row("a", 0.5, (1, 1), prior_group="r250-weak-s3")]
    rows = [row("a", 0.5, (1, 1), suite=suite) for suite in ("x", "y")]
    assert [item.group[1] for item in overviews_of(book_of(*other, *rows))] == [PRIOR, "r250-weak-s3"]


def test_the_plot_has_the_figures_of_the_table_and_who_has_a_latency():
    cost = {"metric": "latency_p50", "unit": "s", "suite": "all suites"}
    rows = [row("a", 0.5, (1, 2)), row("b", 0.6, (1, 2)), row("c", 0.7, (1, 3)), row("random", 0.1)]
    (item,) = overviews_of(book_of(*rows, *(row(name, 0.25, **cost) for name in ("a", "b", "random"))))
    frame = times_frame(item)
    assert frame[["matcher", "value", "latency_s"]].to_numpy().tolist() == [["b", 0.6, 0.25], ["a", 0.5, 0.25]]


def test_contrasts_are_sentences_and_a_null_is_an_equality():
    found = Finding(
        name="age", first="with", second="without", metric="primary", n=90, blocks=30, places=18, best=1.0,
        second_value=0.6, difference=0.0, lo=-0.02, hi=0.02, p_holm=1.0, least=0.1,
    )  # fmt: skip
    won = replace(found, difference=0.2, lo=0.12, hi=0.3, p_holm=0.001)
    open_line = "age: with against without: not decided: no difference shown after Holm's adjustment: difference 0.200"
    assert contrast_lines([found, won, replace(won, p_holm=0.5)]) == [
        "age: with and without are equal (within 0.1): difference 0.000 [-0.020, 0.020]",
        "age: with is better than without, by as much as matters: difference 0.200 [0.120, 0.300]",
        f"{open_line} [0.120, 0.300]",
    ]


def test_a_manifest_without_added_entries_is_as_before_and_names_them_where_there_are_some():
    about = about_of([entry_of("a")])
    assert "added" not in about.model_dump()
    assert BoardManifest.model_validate(about.model_copy(update={"added": ["a"]}).model_dump()).added == ["a"]


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    shares = {**SHARES, HOSTILE: 0.5}
    return full_board(tmp_path_factory.mktemp("first") / "mine", shares=shares, added=[HOSTILE])


def test_the_first_page_marks_and_compares_what_was_added_and_shows_names_as_text(folder, tmp_path):
    text = (publish(folder, tmp_path / "site").folder / "index.html").read_text(encoding="utf-8")
    first = text[text.index('class="first') : text.index('id="what"')]
    assert "<script>alert" not in text
    assert 'class="mark added"' in first
    assert '<li class="added">Added here: &lt;script&gt;alert(1)&lt;/script&gt; on ' in first
    assert first.index('class="says"') < first.index('class="plot"') < first.index('class="matrix"')
    assert "figures/first-times.svg" in first
    assert (tmp_path / "site" / "figures" / "first-times.svg").is_file()
    assert text.index('id="first-1"') < text.index('id="what"') < text.index('id="real"')


def test_the_terminal_says_the_same_in_fewer_lines_than_a_screen(folder, capsys):
    show_board(Board.open(Path(folder)))
    lines = capsys.readouterr().out.splitlines()
    assert any(line.startswith("real-age: 2 share the first rank") for line in lines)
    assert any(line.startswith("Added here: <script>alert(1)</script> on ") for line in lines)
    assert any(line.startswith("real: graph is better than weak, by as much as matters") for line in lines)
    assert pd.Series(lines).str.len().gt(0).sum() < 60  # of three groups; the demo has one
