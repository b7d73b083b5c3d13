# SPDX-License-Identifier: Apache-2.0
"""Rates come back from views that were made with them, within their intervals."""

import numpy as np
import pytest

from sasgeo_bench.errors import ConfigError
from sasgeo_bench.sasgeo.rates import ClassRates, Tally, fit_rates, hand_rates, tally

TRUE = ClassRates(hit=0.88, false_alarm=0.015, missing=0.04, vanish_per_year=0.02, appear_per_year=0.006, mapped=0.12)


def made_up(rates, *, ages_years=(0.0, 2.0, 5.0, 10.0), blocks=24, cells=36_000, seed=10):
    """Views whose cells come in clumps of 100 that stand, vanish or appear together."""
    rng = np.random.default_rng(seed)
    made = []
    for block in range(blocks):
        for age in ages_years:
            mapped = rng.binomial(cells // 100, rates.mapped) * 100
            standing = rng.binomial(mapped // 100, rates.survival(age)) * 100
            came = rng.binomial((cells - mapped) // 100, rates.unmapped(age) if age else 0.0) * 100

            def seen(there, gone):
                return rng.binomial(there, rates.hit) + rng.binomial(gone, rates.false_alarm)

            on, off = seen(standing, mapped - standing), seen(came, cells - mapped - came)
            counts = (np.array([count]) for count in (on, mapped - on, off, cells - mapped - off))
            names = ("seen_mapped", "missed_mapped", "seen_empty", "missed_empty")
            made.append(
                Tally(classes=("building",), age_years=age, block=str(block), **dict(zip(names, counts, strict=True)))
            )
    return made


def test_intervals_hold_the_true_rates_as_often_as_they_say():
    worlds = [fit_rates(made_up(TRUE, blocks=16, seed=seed))["building"] for seed in range(40)]
    assert all(fitted.blocks == 16 for fitted in worlds)
    for name in ("hit", "false_alarm", "missing", "vanish_per_year", "appear_per_year"):
        assert all(getattr(one.lo, name) <= getattr(one.best, name) <= getattr(one.hi, name) for one in worlds)
        held = np.mean([getattr(one.lo, name) <= getattr(TRUE, name) <= getattr(one.hi, name) for one in worlds])
        assert held >= 0.85, name  # of 0.95: 34 of 40 or fewer have a chance of 1 in 100


def test_more_blocks_make_intervals_narrower():
    few, many = (fit_rates(made_up(TRUE, blocks=blocks))["building"] for blocks in (6, 48))
    assert many.hi.vanish_per_year - many.lo.vanish_per_year < few.hi.vanish_per_year - few.lo.vanish_per_year


def test_where_nothing_was_seen_the_hand_decides():
    empty = {name: np.array([0]) for name in ("seen_mapped", "missed_mapped", "seen_empty", "missed_empty")}
    fitted = fit_rates([Tally(classes=("railway",), age_years=5.0, block="a", **empty)])["railway"]
    assert fitted.best.vanish_per_year == pytest.approx(hand_rates("railway").vanish_per_year, rel=1e-3)
    assert fitted.views == 0


def test_a_map_of_one_age_tells_the_detector_and_leaves_ageing_to_the_hand():
    fitted = fit_rates(made_up(TRUE, ages_years=(0.0,)))["building"].best
    assert fitted.hit == pytest.approx(TRUE.hit, abs=0.01)
    assert fitted.false_alarm == pytest.approx(TRUE.false_alarm, rel=0.1)
    assert fitted.vanish_per_year == pytest.approx(hand_rates("building").vanish_per_year, rel=1e-2)


def test_an_empty_train_part_is_refused():
    with pytest.raises(ConfigError, match="train part is empty"):
        fit_rates([])


def test_classes_that_differ_are_refused():
    one = np.ones((1, 2, 2), dtype=np.uint8)
    tallies = [tally((name,), one, one, age_years=0.0, block="a") for name in ("building", "railway")]
    with pytest.raises(ConfigError, match="different classes"):
        fit_rates(tallies)


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"hit": 1.2}, "hit is a share"),
        ({"vanish_per_year": -0.1}, "at least 0 a year"),
        ({"appear_per_year": float("nan")}, "at least 0 a year"),
        ({"hit": 0.01, "false_alarm": 0.5}, "rarer than a false alarm"),
    ],
)
def test_what_is_no_rate_is_refused(wrong, message):
    values = {name: getattr(TRUE, name) for name in TRUE.__slots__}
    with pytest.raises(ConfigError, match=message):
        ClassRates(**{**values, **wrong})
