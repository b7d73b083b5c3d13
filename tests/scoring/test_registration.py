# SPDX-License-Identifier: Apache-2.0
"""Registrations: what cannot be reached is refused before anybody is asked, and power is counted by places."""

import math
from dataclasses import replace

import numpy as np
import pytest

from sasgeo_bench.core.errors import ConfigError
from sasgeo_bench.core.progress import reporting
from sasgeo_bench.scoring.compare import detectable_difference
from sasgeo_bench.scoring.contrasts import Contrast, Pilot, check_contrasts, registered
from tests.scoring.test_tables import scores

ABSENT = Contrast(name="rejection", first="a x b", second="a x c", suites=("occlusion",), metric="aurc", min_effect=0.2)
GRAPH = Contrast(name="graph", first="with", second="without", suites=("occlusion",))


def design(count=100, **columns):
    return scores(np.full(count, np.inf), blocks=20, **columns)


def test_a_least_difference_beyond_what_a_perfect_order_gains_is_refused():
    # 78 % of the answers are false, so a perfect order has 0.447 of the margin's 0.496, and a fifth of that is 0.099.
    lines = []
    pilots = {"rejection": Pilot(second=0.496, false_share=0.78)}
    refused = r"'rejection' cannot be reached: at most 0\.049 .* and 0\.099 is to matter"
    with reporting(lines.append), pytest.raises(ConfigError, match=refused):
        check_contrasts([ABSENT], pilots, design())
    assert len(lines) == 1
    excess = replace(ABSENT, metric="e_aurc")
    with reporting(lines.append):
        (found,) = check_contrasts([excess], {"rejection": Pilot(second=0.05)}, design())
    assert (found.best, found.attainable, found.least) == (0.0, 0.05, pytest.approx(0.01))


def test_identical_places_lower_what_can_be_gained():
    twins = design(ceiling=0.5)
    with pytest.raises(ConfigError, match=r"at most 0\.020 can be gained"):
        check_contrasts([GRAPH], {"graph": Pilot(second=0.48)}, twins)
    assert registered(GRAPH, Pilot(second=0.3), twins).attainable == pytest.approx(0.2)
    assert registered(replace(GRAPH, suites=("alias",)), Pilot(), twins).queries == 0


def test_an_interaction_can_gain_what_its_control_leaves_and_no_more():
    stability = replace(GRAPH, metric="interaction", min_effect=0.05)
    assert "what can be gained is not known" in registered(stability, Pilot(), design()).to_text()
    pilot = Pilot(second=-0.3, control=0.9)
    assert registered(stability, pilot, design()).attainable == pytest.approx(0.4)
    with pytest.raises(ConfigError, match=r"at most 0\.030 can be gained"):
        check_contrasts([stability], {"graph": replace(pilot, second=0.07)}, design())
    assert registered(stability, replace(pilot, second=0.2), design()).attainable == 0.0


def test_power_is_told_for_both_ends_of_the_order_of_holm():
    def apart(count):
        names = [f"p{at}" for at in range(count)]
        return design(count, place=names, block=names)

    lines = []
    others = [replace(GRAPH, name=f"other-{at}") for at in range(12)]
    pilot = Pilot(discordant=0.25, correlation=0.0)
    with reporting(lines.append):
        found = check_contrasts([GRAPH, *others], {"graph": pilot}, apart(80))[0]
    assert found.detectable == pytest.approx(detectable_difference(80, 0.25))
    assert found.detectable < found.detectable_first < np.inf
    both = f"can show is {found.detectable:.3f}, or {found.detectable_first:.3f} if it comes first in Holm's order"
    assert lines[0].endswith(both)
    # 30 places have 7.5 discordant ones, and 2 / 2^7.5 exceeds 0.05 / 13: the test cannot show anything.
    few = registered(GRAPH, pilot, apart(30), contrasts=13).to_text()
    assert few.endswith("or none if it comes first in Holm's order")


def test_power_counts_places_not_blocks():
    pilot = Pilot(discordant=0.2)
    many, few = (
        registered(
            GRAPH,
            pilot,
            design(400, place=[f"p{at % count}" for at in range(400)], block=[f"b{at % count}" for at in range(400)]),
        )
        for count in (40, 8)
    )
    assert (many.places, few.places) == (40, 8)
    assert many.detectable < few.detectable
    assert math.isnan(registered(replace(ABSENT, metric="auroc"), pilot, design()).detectable)
    assert "too few to decide anything" in replace(few, places=5).to_text()
