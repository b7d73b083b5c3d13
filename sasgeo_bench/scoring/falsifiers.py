# SPDX-License-Identifier: Apache-2.0
"""Falsifiers of registered contrasts: the same two methods where what separates them is taken away."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Final

import pandas as pd

from sasgeo_bench.errors import counted
from sasgeo_bench.scoring.compare import LEAST_BLOCKS
from sasgeo_bench.scoring.contrasts import Contrast, Finding, both_on, mean_finding
from sasgeo_bench.scoring.draws import DRAWS

EVERY: Final = "all"  # suites, or kinds of one


@dataclass(frozen=True, slots=True, kw_only=True)
class Falsifier:
    """What came of a contrast where its arms should not differ.

    Parameters
    ----------
    contrast, suite, kind : str
        "all" suites together, or one; there each kind of falsifier, and "control" for the same places without stress.
    finding : Finding
        Of the two arms there; of its p none is adjusted, for this is no part of what was registered.
    """

    contrast: str
    suite: str
    kind: str
    finding: Finding

    @property
    def verdict(self) -> str:
        """In words: whether the first arm gains where it should not."""
        found = self.finding
        if found.blocks < LEAST_BLOCKS:
            return f"not decided: {counted(found.blocks, 'block')}"
        if found.lo > 0:
            return "GAIN without the stress"
        return "loss without the stress" if found.hi < 0 else "no gain shown"


def hold_falsifiers(
    contrasts: Sequence[Contrast], scores: Mapping[str, pd.DataFrame], *, draws: int = DRAWS
) -> tuple[Falsifier, ...]:
    """Compare the arms of each contrast on controls and falsifiers of its suites.

    Parameters
    ----------
    contrasts : sequence of Contrast
        Those by success or recall; one by "aurc" has none.
    scores : mapping of str to pandas.DataFrame
        Scored rows by matcher.
    draws : int
        Of the bootstrap.

    Returns
    -------
    tuple of Falsifier
        By contrast: all suites together, then suite by suite.

    Raises
    ------
    ConfigError
        If a contrast names a method that is not on the board.

    Examples
    --------
    >>> hold_falsifiers((), {})
    ()
    """
    means = (contrast for contrast in contrasts if contrast.metric == "primary")
    return tuple(item for contrast in means for item in _of(contrast, scores, draws))


def _of(contrast: Contrast, scores: Mapping[str, pd.DataFrame], draws: int) -> Iterator[Falsifier]:
    first, second = both_on(contrast, scores, _unstressed)
    for suite, kind, rows in _parts(first):
        yield Falsifier(
            contrast=contrast.name,
            suite=suite,
            kind=kind,
            finding=mean_finding(contrast, first[rows], second[rows], draws),
        )


def _parts(frame: pd.DataFrame) -> Iterator[tuple[str, str, "pd.Series[bool]"]]:
    """Suite, kind and rows of each part; all of them come first, unless they are one."""
    parts = sorted(set(zip(frame["suite"], frame["kind"], strict=True)))
    if len(parts) > 1:
        yield EVERY, EVERY, frame["suite"].notna()
    for suite, kind in parts:
        yield str(suite), str(kind), (frame["suite"] == suite) & (frame["kind"] == kind)


def _unstressed(frame: pd.DataFrame) -> "pd.Series[bool]":
    """Present places without stress; a view that is all unknown has nothing to be found by."""
    return frame["is_present"].astype(bool) & (frame["role"] != "stress") & (frame["unknown_share"] < 1)


_TOLD: Final = ("first_value", "second_value", "difference", "lo", "hi", "n", "blocks", "first_only", "second_only")
COLUMNS: Final = ("contrast", "suite", "kind", "first", "second", *_TOLD, "verdict")


def falsifier_frame(found: Sequence[Falsifier]) -> pd.DataFrame:
    """Falsifiers as a table.

    Examples
    --------
    >>> list(falsifier_frame([]).columns)[:3]
    ['contrast', 'suite', 'kind']
    """
    rows = [
        {name: getattr(item.finding, name) for name in ("first", "second", *_TOLD)}
        | {"contrast": item.contrast, "suite": item.suite, "kind": item.kind, "verdict": item.verdict}
        for item in found
    ]
    return pd.DataFrame(rows, columns=list(COLUMNS))
