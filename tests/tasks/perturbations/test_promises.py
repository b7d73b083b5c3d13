# SPDX-License-Identifier: Apache-2.0
"""Every perturbation that ships keeps what the kit holds any to, and refuses parameters out of range in one line."""

import numpy as np
import pytest

from sasgeo_bench.core.errors import PerturbError
from sasgeo_bench.running.perturbation_testing import NO_STRENGTHS, promises
from sasgeo_bench.tasks.perturbations.all_perturbations import SHIPPED, ladder_of
from sasgeo_bench.tasks.perturbations.base import share_changed

DETERMINISTIC = ("adversarial-mask", "central-crop")
every = pytest.mark.parametrize("name", SHIPPED)


@every
def test_another_seed_gives_another_view(name, view):
    first, other = (SHIPPED[name](view, np.random.default_rng(seed)).cells for seed in (1, 2))
    assert (first != other).any() == (name not in DETERMINISTIC)


@every
def test_it_keeps_its_promises_on_every_view(name, views, view, half_known):
    checks = list(promises(ladder_of(SHIPPED[name], name), (view, *views[::3], half_known)))
    assert [check for check in checks if check.outcome != "pass"] == []
    assert len(checks) == 9


@every
def test_it_does_something_and_no_more_than_half_of_the_view(name, views, view):
    changed = [share_changed(item, SHIPPED[name](item, np.random.default_rng(4))) for item in (*views[::2], view, view)]
    assert 0.0001 < np.mean(changed) < 0.5


@every
@pytest.mark.parametrize("value", NO_STRENGTHS)
def test_a_strength_that_is_none_is_refused_in_one_line(name, value):
    ladder, kind = ladder_of(SHIPPED[name], name), type(SHIPPED[name]).__name__
    with pytest.raises(PerturbError, match=f"{kind}: {ladder.knob} lies between") as caught:
        ladder.at(value)
    assert "\n" not in str(caught.value)
