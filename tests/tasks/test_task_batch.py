# SPDX-License-Identifier: Apache-2.0
"""Many requests: no query hangs on how many processes draw, nor on which variants are left out."""

from collections import Counter
from dataclasses import replace

import pytest

from sasgeo_bench.core.errors import ConfigError
from sasgeo_bench.tasks import task_files
from sasgeo_bench.tasks.build import carry_out
from sasgeo_bench.tasks.query import CONTROLS
from sasgeo_bench.tasks.suites.all_suites import EVERY_SUITE, find_suite
from sasgeo_bench.tasks.suites.base import EVERYTHING, Choice, Variant
from sasgeo_bench.tasks.task_plan import TaskRequest, plan_requests

TOWNS = ("town-suburb", "town-agricultural")


def wanted(out, *suites, regions=TOWNS, **changes):
    return plan_requests(
        TaskRequest(
            suites=suites, regions=regions, split="crossfit", count=1, seed=3, out=out, may_be_fewer=True, **changes
        ),
    )


def queries_of(drawn):
    return {
        query.query_id: query for item in drawn for folder in item.folders for query in task_files.read_queries(folder)
    }


@pytest.mark.slow
def test_two_processes_draw_the_queries_that_one_draws_and_tell_what_a_region_lacks(tmp_path, lay_towns):
    found, few = {}, Choice(views_cells=(96,))
    for name, jobs in (("one", 1), ("two", 2)):
        lay_towns(tmp_path / name, *TOWNS)
        lacking = wanted(tmp_path / name, "grade-separation", regions=TOWNS[:1])
        found[name] = list(carry_out([*lacking, *wanted(tmp_path / name, "clean", choice=few)], jobs=jobs))
        refused = found[name].pop(0)
        assert refused.folders == ()
        assert "town-suburb cannot carry suite 'grade-separation': no bridge" in refused.lack
        assert all(item.folders and item.lack is None for item in found[name])
    one, two = found["one"], found["two"]
    assert [item.lines[-1].partition(" in ")[0] for item in one] == [
        item.lines[-1].partition(" in ")[0] for item in two
    ]
    hashes = [
        [task_files.read_task(folder)["files"] for item in drawn for folder in item.folders] for drawn in (one, two)
    ]
    assert len(hashes[0]) == 2
    assert hashes[0] == hashes[1]
    again = list(carry_out(wanted(tmp_path / "two", "clean", choice=few)))
    assert [item.folders for item in again] == [item.folders for item in two]
    assert not any(item.lines for item in again)


@pytest.mark.parametrize("suite", ["clean", "occlusion"])
def test_a_region_that_allows_no_view_of_the_asked_size_is_left_out(suite, tmp_path, lay_towns):
    lay_towns(tmp_path, TOWNS[0])
    large = max(find_suite(suite).variants, key=lambda variant: variant.view_cells)
    (request,) = wanted(tmp_path, suite, regions=TOWNS[:1], choice=Choice(views_cells=(large.view_cells,)))
    small = replace(request, region=request.region.model_copy(update={"largest_view_m": large.side_m - 1.0}))
    (found,) = carry_out([small])
    assert found.folders == ()
    assert found.lack.startswith("town-suburb has nothing of suite")


def test_what_is_left_out_changes_no_other_query(tmp_path, lay_towns):
    for name in ("all", "some"):
        lay_towns(tmp_path / name, TOWNS[0])
    all_of_it = queries_of(carry_out(wanted(tmp_path / "all", "occlusion", regions=TOWNS[:1])))
    choice = Choice(views_cells=(192,), kinds=("U2", "U3"), tracks=("localization",))
    some = queries_of(carry_out(wanted(tmp_path / "some", "occlusion", regions=TOWNS[:1], choice=choice)))
    assert 0 < len(some) < len(all_of_it)
    assert {name: query.prior for name, query in some.items()} == {name: all_of_it[name].prior for name in some}
    assert {query.track for query in some.values()} == {"localization"}
    assert {query.evidence.shape for query in some.values()} == {(192, 192)}


def test_each_detector_sees_every_place_and_the_published_one_as_without_the_other(tmp_path, lay_towns):
    found = {}
    for name, detectors in (("one", ("published",)), ("both", ("published", "measured"))):
        lay_towns(tmp_path / name, TOWNS[0])
        choice = Choice(views_cells=(96,), kinds=("G1 tilt",), detectors=detectors)
        drawn = list(carry_out(wanted(tmp_path / name, "local-warp", regions=TOWNS[:1], choice=choice)))
        truths = {
            truth.query_id: truth
            for item in drawn
            for folder in item.folders
            for truth in task_files.read_truths(
                tmp_path / name / "truth" / folder.relative_to(tmp_path / name / "tasks")
            )
        }
        found[name] = (queries_of(drawn), truths)
    (one, _), (both, truths) = found["one"], found["both"]
    assert {name for name, truth in truths.items() if truth.detector == "published"} == set(one)
    assert all((both[name].evidence.cells == query.evidence.cells).all() for name, query in one.items())
    assert all(both[name].vectors.to_wkt().equals(query.vectors.to_wkt()) for name, query in one.items())
    pairs = Counter((truth.pair_id, truth.role, truth.kind, truth.pose) for truth in truths.values())
    assert set(pairs.values()) == {2}


def test_controls_and_falsifiers_are_drawn_whatever_the_kinds():
    choice = Choice(kinds=("U2",))
    assert choice.takes(Variant(role="control", kind="control"), "localization")
    assert choice.takes(Variant(role="falsifier", kind="none"), "retrieval")
    assert EVERYTHING.takes(Variant(role="stress", kind="U1"), "retrieval")
    assert all(EVERYTHING.lack(find_suite(name)) is None for name in (*EVERY_SUITE, CONTROLS))


@pytest.mark.parametrize(
    ("choice", "words"),
    [
        (Choice(views_cells=(100,)), "nothing of views_cells 100: it has 96, 192, 384"),
        (Choice(kinds=("U9",)), "nothing of kinds 'U9': it has U1 rectangles, U2 border, "),
        (Choice(tracks=("localization",), kinds=("U1",), views_cells=(384, 96)), None),
        (Choice(kinds=("U2",), views_cells=(384,)), "has no stress of all that is chosen"),
    ],
)
def test_a_choice_of_nothing_is_refused_before_anything_is_drawn(tmp_path, choice, words):
    assert (choice.lack(find_suite("occlusion")) is None) == (words is None)
    if words is not None:
        with pytest.raises(ConfigError, match=f"suite 'occlusion' .*{words}"):
            wanted(tmp_path, "occlusion", choice=choice)
    with pytest.raises(ConfigError, match="suite 'growth' has nothing of tracks 'retrieval': it has localization"):
        wanted(tmp_path, "growth", choice=Choice(tracks=("retrieval",)))
