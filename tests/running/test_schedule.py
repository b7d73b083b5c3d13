# SPDX-License-Identifier: Apache-2.0
"""Maps are shared out first, then help goes where it pays; every query is given once, and nobody waits for ever."""

from concurrent.futures import ThreadPoolExecutor
from itertools import chain

import pytest

from sasgeo_bench.running.answers import LEAST_ITEMS, Schedule, is_worth_starting


class Clock:
    """Seconds that pass only where a test says so."""

    def __init__(self):
        self.now = 0.0

    def __call__(self):
        return self.now


def schedule_of(*counts, clock=None):
    lines = [(iter([[(number, at)] for at in range(count)]), count) for number, count in enumerate(counts)]
    return Schedule(lines, clock=clock or Clock())


def test_each_thread_gets_a_map_of_its_own_first():
    schedule = schedule_of(100, 1, 1)
    assert [schedule.take() for _ in range(3)] == [0, 1, 2]
    assert list(schedule.groups(1)) == [[(1, 0)]]


def test_help_goes_to_the_map_with_most_left_for_each_who_works_on_it():
    schedule = schedule_of(20, 60, 50)
    for _ in range(3):
        schedule.take()
    assert [schedule.take() for _ in range(3)] == [1, 2, 1]


def test_two_that_ask_about_one_map_get_each_query_once():
    schedule = schedule_of(5)
    first, second = schedule.groups(0), schedule.groups(0)
    found = [next(first), next(second), next(second), *first, *second]
    assert found == [[(0, at)] for at in range(5)]
    assert [schedule.take(), schedule.take()] == [0, None]


@pytest.mark.parametrize(
    ("left", "askers", "start_s", "pace_s", "expected"),
    [
        (2 * LEAST_ITEMS, 1, 0.0, None, True),  # nobody knows yet: by number
        (2 * LEAST_ITEMS - 1, 1, 0.0, None, False),
        (2 * LEAST_ITEMS, 2, 0.0, None, False),
        (200, 1, 2.0, 0.01, False),  # 1 s of work for a start of 2 s
        (200, 1, 2.0, 0.02, True),
        (1, 3, 2.0, 8.0, True),
        (400, 3, 200.0, 1.0, False),  # a map that takes minutes to prepare
    ],
)
def test_help_pays_where_its_share_takes_as_long_as_its_start(left, askers, start_s, pace_s, expected):
    assert is_worth_starting(left=left, askers=askers, start_s=start_s, pace_s=pace_s) is expected


@pytest.mark.parametrize(("pace_s", "is_helped"), [(1.0, True), (0.1, False)])
def test_a_thread_waits_until_it_is_known_whether_help_pays(pace_s, is_helped):
    clock = Clock()
    schedule = schedule_of(LEAST_ITEMS, clock=clock)
    assert schedule.take() == 0
    with ThreadPoolExecutor(max_workers=1) as pool:
        helper = pool.submit(schedule.take)
        asked = schedule.groups(0)
        next(asked)
        clock.now += 2.5  # the start, and one query
        next(asked)
        assert not helper.done()
        clock.now += pace_s
        next(asked)  # six are left
        if is_helped:
            assert helper.result(timeout=600) == 0
        else:
            assert not helper.done()
            assert len(list(asked)) == LEAST_ITEMS - 3
            assert helper.result(timeout=600) is None


def test_whoever_waits_is_let_go_when_a_map_holds_less_than_it_said():
    schedule = Schedule([(iter("a"), 5)])
    assert schedule.take() == 0
    with ThreadPoolExecutor(max_workers=1) as pool:
        helper = pool.submit(schedule.take)
        assert list(schedule.groups(0)) == ["a"]
        assert helper.result(timeout=600) is None


def test_after_a_stop_nothing_is_given_and_nobody_waits():
    schedule = schedule_of(4, 4)
    assert schedule.take() == 0
    asked = schedule.groups(0)
    next(asked)
    assert not schedule.wait_for_stop(0.0)
    assert schedule.take() == 1
    with ThreadPoolExecutor(max_workers=1) as pool:
        helper = pool.submit(schedule.take)
        schedule.stop()
        assert helper.result(timeout=600) is None
    assert list(asked) == []
    assert list(schedule.groups(1)) == []
    assert schedule.is_stopped
    assert schedule.wait_for_stop(0.0)


def test_a_group_goes_to_one_thread_and_counts_by_its_queries():
    clock = Clock()
    schedule = Schedule([(iter(["abcd", "efgh"]), 8)], clock=clock)
    assert schedule.take() == 0
    asked = schedule.groups(0)
    assert next(asked) == "abcd"
    clock.now += 1.0  # the start
    assert next(asked) == "efgh"
    assert schedule.take() is None  # nothing is left, though the last group is not answered yet
    assert list(asked) == []


def test_many_threads_share_out_everything_once():
    counts = (50, 3, 1, 17)
    schedule = schedule_of(*counts)

    def ask():
        found = []
        while (number := schedule.take()) is not None:
            found += chain.from_iterable(schedule.groups(number))
        return found

    with ThreadPoolExecutor(max_workers=6) as pool:
        found = [item for asking in [pool.submit(ask) for _ in range(6)] for item in asking.result(timeout=600)]
    assert sorted(found) == [(number, at) for number, count in enumerate(counts) for at in range(count)]
