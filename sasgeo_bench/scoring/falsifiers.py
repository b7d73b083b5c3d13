# SPDX-License-Identifier: Apache-2.0
"""Falsifiers of registered contrasts: the same two methods on queries without the stress that separates them."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Final

import pandas as pd

from sasgeo_bench.errors import counted
from sasgeo_bench.scoring.compare import LEAST_BLOCKS
from sasgeo_bench.scoring.contrasts import Contrast, Finding, both_on, mean_finding
from sasgeo_bench.scoring.intervals import DRAWS

EVERY: Final = "all"  # suites, or kinds


@dataclass(frozen=True, slots=True, kw_only=True)
class Falsifier:
    """Result of a contrast on queries where its methods should not differ.

    Parameters
    ----------
    contrast, suite, kind : str
        "all" suites together, or one suite with a kind of falsifier, or "control" for the same places without stress.
    finding : Finding
        Result there; its p-values are not adjusted, since this is not part of the registered test.
    """

    contrast: str
    suite: str
    kind: str
    finding: Finding

    @property
    def verdict(self) -> str:
        """Return in words whether the first method gains where it should not."""
        found = self.finding
        if found.blocks < LEAST_BLOCKS:
            return f"not decided: {counted(found.blocks, 'block')}"
        if found.lo > 0:
            return "GAIN without the stress"
        return "loss without the stress" if found.hi < 0 else "no gain shown"


def hold_falsifiers(
    contrasts: Sequence[Contrast], scores: Mapping[str, pd.DataFrame], *, draws: int = DRAWS
) -> tuple[Falsifier, ...]:
    """Compare the methods of each contrast by success or recall on controls and falsifiers of its suites.

    The order is by contrast: all suites together, then suite by suite. Raise ConfigError if a contrast names a method
    that is not on the board.
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
    """Yield suite, kind and row mask of each part; if there are several, all of them together come first."""
    parts = sorted(set(zip(frame["suite"], frame["kind"], strict=True)))
    if len(parts) > 1:
        yield EVERY, EVERY, frame["suite"].notna()
    for suite, kind in parts:
        yield str(suite), str(kind), (frame["suite"] == suite) & (frame["kind"] == kind)


def _unstressed(frame: pd.DataFrame) -> "pd.Series[bool]":
    """Return a mask of present places without stress; a view that is all unknown cannot be found."""
    return frame["is_present"].astype(bool) & (frame["role"] != "stress") & (frame["unknown_share"] < 1)


_TOLD: Final = ("first_value", "second_value", "difference", "lo", "hi", "n", "blocks", "first_only", "second_only")
COLUMNS: Final = ("contrast", "suite", "kind", "first", "second", *_TOLD, "verdict")


def falsifier_frame(found: Sequence[Falsifier]) -> pd.DataFrame:
    """Return falsifiers as a table with the columns `COLUMNS`."""
    rows = [
        {name: getattr(item.finding, name) for name in ("first", "second", *_TOLD)}
        | {"contrast": item.contrast, "suite": item.suite, "kind": item.kind, "verdict": item.verdict}
        for item in found
    ]
    return pd.DataFrame(rows, columns=list(COLUMNS))
