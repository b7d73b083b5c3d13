# SPDX-License-Identifier: Apache-2.0
"""Generator and scorer share no parameter: no constant with a unit has one value in both, and no comment quotes one.

A number without a name is not seen here, so every length, angle and share of either side has one. That neither imports
the other is held by `tests/test_architecture.py`.
"""

import ast
import io
import re
import tokenize
from collections.abc import Iterator, Mapping
from pathlib import Path

import pytest

import sasgeo_bench

PACKAGE = Path(sasgeo_bench.__file__).parent
GENERATOR = ("perturbations/*.py", "suites/*.py")
UNIT = re.compile(r"_(m|m2|deg|share|years|cells)$", re.IGNORECASE)
QUOTES = re.compile(r"\b(warp|wave|wavelength|gap|twin|lure|generator|perturbation|suite)s?\b", re.IGNORECASE)

# Constants of the scorer that happen to have a value of the generator, and where they come from. A value that changes
# must be argued anew.
ARGUED: Mapping[str, str] = {
    "raster.py:LEVEL_M = 24": "tried on train places: record 40",
    "class_weights.py:CELL_M = 4": "two cells of the search: fine enough for eight sectors of the inner ring",
    "class_weights.py:RINGS_M = 16": "a junction and the ends of its roads",
    "temporal.py:CELL_M = 4": "two cells of the search of a single view: the layers of a country take 0.3 GB then",
    "class_weights.py:AGES_YEARS = 2": "rows of a printed table; no weight depends on them",
    "class_weights.py:AGES_YEARS = 5": "rows of a printed table; no weight depends on them",
    "class_weights.py:AGES_YEARS = 10": "rows of a printed table; no weight depends on them",
    "graph.py:_SLACK_M = 1": "rounds a search radius up; changes no score",
    "graph.py:gate_m = 12": "starting value: two of place_sigma_m; replaced on train places",
    "graph.py:place_sigma_m = 6": "starting value: how far roads of OSM are off; replaced on train places",
    "graph.py:shift_m = 20": "starting value: three of place_sigma_m, rounded; replaced on train places",
    "graph.py:stretch_m = 35": "starting value: nodes farther apart share no shift; replaced on train places",
    "graph.py:edge_sigma_m = 2": "starting value: a cell of the search; replaced on train places",
    "graph.py:arm_sigma_deg = 15": "starting value of the angle of a road; the other is the tilt of a camera",
    "observed.py:NEAR_M = 80": "reach of a node's surroundings; the other is the height of a flight",
    "observed.py:_FACING_DEG = 30": "between a road and a border; the other is the tilt of a camera",
    "integrity.py:APART_M = 25": "the widest tolerance of the benchmark's success",
    "learning.py:WRONG_M = 25": "the widest tolerance of the benchmark's success",
    "mapped.py:_APART_M = 10000": "farther than two nodes that are compared; the other is the length of a flight",
    "mapped.py:CROWD_M = 150": "about a view's width, over which the density of nodes is counted",
    "mapped.py:PAIRED_M = 20": "the least distance of reading.APART_M, less what scale and slack take",
    "nodes.py:ARM_M = 12": "past the curbs of a junction, where a road has its direction",
    "nodes.py:BLUR_M = 8": "the width of a major road in the taxonomy",
    "observed.py:LEAST_M2 = 12": "three cells of the search: smaller patches are noise",
    "observed.py:SPUR_M = 8": "the width of a major road in the taxonomy: shorter branches are its corners",
    "observed.py:MARGIN_M = 8": "the width of a major road in the taxonomy: nearer the border it may be cut",
    "nodes.py:TOUCH_M = 0.5": "half a cell of a map: outlines of neighbours drawn by hand meet no better",
    "observed.py:BRIDGED_M = 7": "the width of a street with its verges; by hand, and not estimated yet",
    "raster.py:REACH_M = 4": "tau of the paper's Eq. 8, by hand",
    "raster.py:DOUBT_M = 8": "two of REACH_M",
    "raster.py:CELL_M = 2": "cells of the search",
    "rates.py:RINGS_M = 4": "rings of equal width, two cells of the search",
    "rates.py:RINGS_M = 8": "rings of equal width, two cells of the search",
    "rates.py:RINGS_M = 12": "rings of equal width, two cells of the search",
    "reading.py:APART_M = 30": "nearer junctions give no heading: nodes are off by place_sigma_m",
    "reading.py:SLACK_M = 4": "two cells of the search",
    "reading.py:LEAST_SIGMA_M = 1": "half a cell of the search",
    "reading.py:MOST_SIGMA_M = 25": "the widest tolerance of the benchmark's success",
    "reading.py:_STEP_M = 4": "two cells of the search",
    "rule_fitting.py:_LEAST_SHARE = 0.01": "keeps logarithms finite",
}


def numbers(node: ast.expr | None) -> list[float]:
    """The numbers of a literal, those of a tuple or of values by name among them; none of anything else."""
    try:
        value = ast.literal_eval(node) if node is not None else None
    except ValueError:
        return []
    values = value.values() if isinstance(value, dict) else value if isinstance(value, tuple) else (value,)
    return [float(one) for one in values if isinstance(one, int | float) and not isinstance(one, bool) and one]


def parameters(text: str) -> Iterator[tuple[str, str, float]]:
    """Name, unit and value of each constant of a module and default of a field or parameter whose name has a unit."""
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, ast.AnnAssign):
            named = [(node.target, node.value)]
        elif isinstance(node, ast.Assign):
            named = [(target, node.value) for target in node.targets]
        else:
            continue
        for target, value in named:
            unit = UNIT.search(target.id) if isinstance(target, ast.Name) else None
            if unit:
                yield from ((target.id, unit[1].lower(), one) for one in numbers(value))


def shared(scorer: Mapping[str, str], generator: Mapping[str, str]) -> dict[str, list[str]]:
    """Constants of a scorer by "file:NAME = value", each with those of a generator of the same unit and value."""
    drawn: dict[tuple[str, float], list[str]] = {}
    for path, text in generator.items():
        for name, unit, value in parameters(text):
            drawn.setdefault((unit, value), []).append(f"{path}:{name}")
    return {
        f"{path}:{name} = {value:g}": drawn[unit, value]
        for path, text in scorer.items()
        for name, unit, value in parameters(text)
        if (unit, value) in drawn
    }


def prose(text: str) -> Iterator[tuple[int, str]]:
    """Line and text of every comment and docstring."""
    for token in tokenize.generate_tokens(io.StringIO(text).readline):
        if token.type == tokenize.COMMENT:
            yield token.start[0], token.string
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef) and ast.get_docstring(node):
            yield node.body[0].lineno, str(ast.get_docstring(node))


def quotes(sources: Mapping[str, str]) -> list[str]:
    """One line for each comment or docstring of a scorer that speaks of what a generator does."""
    return [
        f"{path}:{line} speaks of {found[0]!r}, which belongs to the generator"
        for path, text in sources.items()
        for line, each in prose(text)
        if (found := QUOTES.search(each))
    ]


def read(folder: str, *patterns: str) -> dict[str, str]:
    """Sources by their path in a folder of the package."""
    root = PACKAGE / folder
    return {
        path.relative_to(root).as_posix(): path.read_text(encoding="utf-8")
        for pattern in patterns
        for path in sorted(root.glob(pattern))
    }


@pytest.fixture(scope="module")
def scorer() -> dict[str, str]:
    return read("sasgeo", "*.py")


def test_neither_a_constant_nor_a_comment_of_the_scorer_has_or_quotes_one_of_the_generator(scorer):
    found = shared(scorer, read("tasks", *GENERATOR))
    news = {name: those for name, those in found.items() if name not in ARGUED}
    assert not news, f"say in ARGUED where they come from, or choose other values: {news}"
    ours = {f"{path}:{name} = {value:g}" for path, text in scorer.items() for name, _, value in parameters(text)}
    assert set(ARGUED) <= ours, f"no longer there, so not to be argued: {set(ARGUED) - ours}"
    assert quotes(scorer) == []


def test_a_made_up_shared_parameter_or_quote_is_found_and_others_are_not():
    theirs = "_WAVELENGTH_M: Final = 90.0\n@dataclass\nclass Noise:\n    shift_m: float = 1.5\nSPANS_M = (60.0, 150.0)"
    ours = "REACH_M: Final = 90\n@dataclass\nclass Rules:\n    gate_m: float = 1.5\nFAR_M = 150.0"
    assert len(shared({"sasgeo/a.py": ours}, {"tasks/suites/b.py": theirs})) == 3
    ours = "A_M: Final = 5.0\nB_DEG: Final = 7.0\nC_M: Final = 0.0\ncount: int = 7"
    assert shared({"a.py": ours}, {"b.py": "A_DEG: Final = 5.0\nB_M: Final = 7.0\nC_M: Final = 0.0"}) == {}
    files = {"a.py": 'x = warped  # 15 m of a warp\n\n\ndef f():\n    """Close gaps."""\n    return gap\n'}
    assert len(quotes(files)) == 2  # code is not read
