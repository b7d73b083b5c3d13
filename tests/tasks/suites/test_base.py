# SPDX-License-Identifier: Apache-2.0
"""Seeds stay put and streams do not disturb each other; shares of change are counted as said."""

import hashlib

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from sasgeo_bench.core.errors import ConfigError
from sasgeo_bench.regions.evidence import PRESENT, UNKNOWN, Evidence
from sasgeo_bench.tasks.suites.all_suites import SUITES, find_suite
from sasgeo_bench.tasks.suites.base import Seeds, changed_share, controls, ladder

SEEDS = Seeds(root=7, names=("vaduz", "clean", "1"))
words = st.text(alphabet="abcdefgh0123456789-", min_size=1, max_size=6)
masks = hnp.arrays(np.uint8, (2, 4, 5), elements=st.integers(0, 2))


def seen(cells):
    return Evidence(classes=("a", "b"), cells=cells, cell_size_m=1.0)


def test_the_digest_of_a_purpose_never_changes():
    # Written down, not computed: a change of how seeds are made changes every query that was ever drawn.
    digest = SEEDS.under("site", 3).digest("query", "a")
    assert digest.hex() == "cb6a94d76fcb3fe3ff5663ae4244a8860f8850ea9d492ac2a99de019eab7c909"
    assert SEEDS.rng("yaw").integers(0, 1_000_000, 4).tolist() == [389480, 265920, 424428, 248984]


def test_the_digest_is_sha_256_of_what_a_person_can_write_down():
    assert SEEDS.digest("yaw", 3) == hashlib.sha256(b"7/vaduz/clean/1/yaw/3").digest()


@given(st.lists(words, min_size=2, max_size=6, unique=True), st.randoms(use_true_random=False))
def test_streams_do_not_depend_on_the_order_in_which_they_are_asked_for(purposes, random):
    first = {purpose: SEEDS.rng(purpose).random() for purpose in purposes}
    random.shuffle(purposes)
    assert {purpose: SEEDS.rng(purpose).random() for purpose in purposes} == first
    assert len(set(first.values())) == len(purposes)


@given(words, words)
def test_seeds_differ_by_root_name_and_purpose(name, other):
    drawn = {
        (root, names, purpose): Seeds(root=root, names=names).rng(purpose).random()
        for root in (1, 2)
        for names in {("vaduz", name), ("vaduz", other)}
        for purpose in {name, other}
    }
    assert len(set(drawn.values())) == len(drawn)
    assert Seeds(root=1, names=()).under("vaduz", name).digest("x") == Seeds(root=1, names=("vaduz", name)).digest("x")


@given(masks, masks)
def test_a_changed_share_is_symmetric_and_counts_what_both_know(first, second):
    share = changed_share(seen(first), seen(second))
    assert share == changed_share(seen(second), seen(first))
    assert 0 <= share <= 1
    assert changed_share(seen(first), seen(first)) == 0
    hidden = first.copy()
    hidden[second == UNKNOWN] = UNKNOWN
    assert changed_share(seen(hidden), seen(second)) == share


def test_a_changed_share_counts_cells_that_one_of_them_shows():
    one, two = np.zeros((2, 2, 4, 5), dtype=np.uint8)
    one[0, 0, :4] = two[0, 0, 1:5] = PRESENT  # three of five
    two[1, 2, 2] = PRESENT
    assert changed_share(seen(one), seen(two)) == pytest.approx(3 / 6)


def test_a_ladder_has_the_strengths_asked_for_at_each_view_and_controls_have_every_view():
    rungs = ladder("U1", (0.1, 0.2, 0.3), small=(0.1, 0.2), large=(0.3,))
    assert [(item.strength, item.view_cells) for item in rungs] == [
        *((strength, 192) for strength in (0.1, 0.2, 0.3)),
        *((strength, 96) for strength in (0.1, 0.2)),
        (0.3, 384),
    ]
    assert {(item.role, item.kind) for item in rungs} == {("stress", "U1")}
    assert [item.view_cells for item in ladder("U1", (0.1,))] == [192]
    assert [item.view_cells for item in controls(views=(96, 192))] == [96, 192]


@pytest.mark.parametrize("name", SUITES)
def test_variants_of_a_suite_have_names_of_their_own_and_each_stress_a_control_of_its_view(name):
    suite = SUITES[name]
    names = [variant.name for variant in suite.variants]
    assert len(set(names)) == len(names)
    own = {variant.view_cells for variant in suite.variants if variant.role == "control"}
    assert {variant.view_cells for variant in suite.variants} <= own
    assert suite.card.name == name
    assert {variant.role for variant in suite.variants} >= {"control", "stress"}


def test_an_unknown_suite_is_answered_with_the_nearest_name():
    with pytest.raises(ConfigError, match="did you mean 'topology-twins'"):
        find_suite("topologie-twins")
