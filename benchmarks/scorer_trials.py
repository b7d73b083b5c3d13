# SPDX-License-Identifier: Apache-2.0
"""Try each switch and number of the scorer again on train places: what stands against each other value, one at a time.

    .venv/bin/python benchmarks/scorer_trials.py --out out/scorer-trials
    .venv/bin/python benchmarks/scorer_trials.py --table docs/results/scorer-trials.csv

The first command draws views of the train places of `open_numbers.py`: clean ones with two and four times the error of
perception, one of which a mask hides 60 % (U4), and a bent one with vectors (G1, 15 m), a site each. It asks the scorer
with each setting, untaught but for `learns`, writes each answer, then `trials.csv`, into the folder, and prints the
table that the second command prints of stored trials; it resumes. The rule is that of `open_numbers.py`.
"""

import argparse
import json
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Final
from unittest.mock import patch

from sasgeo_baselines.tunable import Tunable

import sasgeo_bench as sgb
from benchmarks.open_numbers import (
    Answer,
    Trial,
    ask_all,
    drawn,
    lines,
    read_answers,
    read_trials,
    trials_of,
    write_trials,
)
from sasgeo_bench.core.errors import SasgeoError
from sasgeo_bench.sasgeo import raster
from sasgeo_bench.sasgeo.ablations import Switches
from sasgeo_bench.sasgeo.variants import Sasgeo
from sasgeo_bench.search.plan import Plan

ASKED: Final = {
    "clean": ("perception", (2.0, 4.0)),
    "occlusion": ("U4 adversarial", (0.6,)),
    "local-warp": ("G1", (15.0,)),
}
BEAM: Final = Plan().beam
STANDS: Final[Mapping[str, float]] = {
    "learns": 1.0,
    "is_fitted": 1.0,
    "has_graph": float(Switches().has_graph),
    "is_unknown_silent": float(Switches().is_unknown_silent),
    "correlates": float(Switches().correlates == "always"),
    "is_distinctive": float(Switches().is_distinctive),
    "level_m": raster.LEVEL_M,
    "repeated": raster.REPEATED,
    "beam": float(BEAM[0]),
}
OTHERS: Final[Mapping[str, Sequence[float]]] = {
    **{name: (1.0 - STANDS[name],) for name in list(STANDS)[:6]},
    "level_m": (12.0, 48.0),
    "repeated": (1e3, 1e4),
    "beam": (40.0, 160.0),
}


class TriedSasgeo(Tunable, Sasgeo):
    """The scorer with one switch or number set otherwise; it learns where the number `learns` is asked about."""

    open_numbers = {name: (STANDS[name], *others) for name, others in OTHERS.items()}

    def __init__(self, **numbers: float) -> None:
        super().__init__(**numbers)
        at = {**STANDS, **numbers}
        Sasgeo.__init__(self, Plan(beam=tuple(max(1, round(width * at["beam"] / BEAM[0])) for width in BEAM)))
        self.switches = replace(
            self.switches,
            weights="fitted" if at["is_fitted"] else "even",
            has_graph=bool(at["has_graph"]),
            is_unknown_silent=bool(at["is_unknown_silent"]),
            correlates="always" if at["correlates"] else "never",
            is_distinctive=bool(at["is_distinctive"]),
        )
        self._level_m, self._repeated = at["level_m"], at["repeated"]
        self._is_taught = bool(numbers.get("learns"))

    @classmethod
    def settings(cls) -> list[dict[str, float]]:
        """Return what stands, the same taught, and each other value alone."""
        alone = [{name: value} for name, others in OTHERS.items() if name != "learns" for value in others]
        return [{}, {"learns": 1.0}, *alone]

    def prepare(self, region: sgb.Region, learned: str | None) -> None:
        """Prepare with what was learned where that is asked about, else untaught."""
        super().prepare(region, learned if self._is_taught else None)

    def learn(self, training: sgb.Training) -> str:
        """Learn only where that is asked about."""
        return super().learn(training) if self._is_taught else ""

    def match(self, query: sgb.Query, *, top_k: int) -> sgb.Match:
        """Answer with the numbers of this setting."""
        with self._set():
            return super().match(query, top_k=top_k)

    @contextmanager
    def _set(self) -> Iterator[None]:
        with patch.object(raster, "LEVEL_M", self._level_m), patch.object(raster, "REPEATED", self._repeated):
            yield


def by_number(found: Sequence[Answer], wanted: Sequence[str]) -> list[Trial]:
    """Return the trials of each number, what stands among them: as a system of its own."""
    trials: list[Trial] = []
    for name in STANDS:
        renamed = [replace(one, system=name, setting=_setting(name, one)) for one in found if _is_of(name, one)]
        kind = type(name, (Tunable,), {"open_numbers": {name: (STANDS[name], *OTHERS[name])}})
        kind.chosen = {name: STANDS[name]}  # type: ignore[attr-defined]
        trials.extend(trials_of(renamed, {name: kind}, wanted))
    return trials


def _is_of(name: str, one: Answer) -> bool:
    return set(json.loads(one.setting)) <= {name}


def _setting(name: str, one: Answer) -> str:
    """Return the value of one number; the untaught scorer, which stands else, is the other value of `learns`."""
    value = json.loads(one.setting).get(name, 0.0 if name == "learns" else STANDS[name])
    return json.dumps({name: value})


def main() -> None:
    """Draw, ask and store; or print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("out/scorer-trials"), help="folder of maps, views and trials")
    parser.add_argument("--jobs", type=int, default=1, help="processes")
    parser.add_argument("--table", type=Path, help="print the table of stored trials, and stop")
    options = parser.parse_args()
    try:
        if options.table is not None:
            print(*lines(read_trials(options.table)), sep="\n")
            return
        there = read_answers(options.out / "answers.csv")
        views = drawn(options.out, ASKED)
        trials = by_number(ask_all(views, {"sasgeo": TriedSasgeo}, there, jobs=options.jobs), list(views.asked))
        write_trials(options.out / "trials.csv", trials)
        print(*lines(trials), sep="\n")
    except SasgeoError as error:
        parser.error(str(error))


if __name__ == "__main__":
    main()
