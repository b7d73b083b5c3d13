# SPDX-License-Identifier: Apache-2.0
"""A matcher on a public and on a private seed: both figures, their difference, and whether its row is reproduced.

With a public seed anybody can draw the queries of a board and their truths, a matcher too. With a private one nobody
can, so that only figures on it vouch for a row.
"""

import hashlib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
import pandas as pd

from sasgeo_bench.errors import counted
from sasgeo_bench.leaderboard.archive_record import SeedRecord
from sasgeo_bench.scoring.base import Bools
from sasgeo_bench.scoring.compare import LEAST_BLOCKS
from sasgeo_bench.scoring.draws import ClusterDraws
from sasgeo_bench.scoring.intervals import (
    LEVEL,
    Interval,
    bootstrap_means,
    difference_interval,
    effective_count,
    percentile_interval,
    wilson,
)
from sasgeo_bench.scoring.metrics import FALSE_ABSENT, MeanMetric, primary_of
from sasgeo_bench.scoring.rows import ALL_SUITES, NOT_REPRODUCED, REPRODUCED, RUN_HERE
from sasgeo_bench.scoring.score import NOT_APPLICABLE

_GROUP: Final = ("suite", "track", "prior_group")
_ALL_PRIORS: Final = "all"
SEEDS_NOTE: Final = (
    "The same matchers, by version and hash, on the same pipeline drawn by a private seed. The sites differ, so no "
    "query pairs with another: draws resample blocks of ground with the queries of both seeds that lie in them. All "
    "intervals of a matcher hold at once (95 %). Shown are the figures over all suites, and whatever is worse on the "
    "private seed."
)

_IS_PRIVATE: Final = (
    "Seeds: this board is of a private seed. Its figures may be told; publish none of its files, for they hold "
    "queries, truths and answers."
)
_IS_PUBLIC: Final = (
    "Seeds: the queries of this board are drawn by a public seed, which code can draw again, truths and all. No row "
    "was held against a private one, so none is reproduced."
)


class SeedFigure(SeedRecord):
    """One figure of one matcher on both seeds, and what it tells."""

    @property
    def is_decided(self) -> bool:
        """Return whether there are enough blocks to decide."""
        return min(self.blocks_public, self.blocks_private) >= LEAST_BLOCKS

    def to_text(self) -> str:
        """Both figures and their difference in a line."""
        return (
            f"{self.suite}, {self.track}, {self.metric}: private {self.private:.3f} against public {self.public:.3f}, "
            f"difference {self.difference:.3f} [{self.lo:.3f}, {self.hi:.3f}]"
        )


@dataclass(frozen=True, slots=True, kw_only=True)
class _Pair:
    """Scored rows of one matcher on both seeds that one figure is of."""

    key: tuple[str, str, str]
    measure: MeanMetric
    public: pd.DataFrame
    private: pd.DataFrame


def compare_seeds(public: pd.DataFrame, private: pd.DataFrame, *, draws: int) -> tuple[SeedFigure, ...]:
    """Figures of a matcher on both seeds: of all suites on a track first, then suite by suite.

    Parameters
    ----------
    public, private : pandas.DataFrame
        Its scored rows (`score.score_task`) on the tasks that both seeds have.
    draws : int
        Of the bootstrap.

    Returns
    -------
    tuple of SeedFigure
        None of what was asked on one seed alone, or what the matcher's card says that it cannot.

    Notes
    -----
    The seeds have different sites, so that no query pairs with another. A draw resamples blocks of ground with all
    queries in them, those of both seeds at once where a block holds both, else of the one it holds. No interval is
    narrower than that of two independent shares of as many trials as there are sites (`difference_interval`).
    """
    pairs = list(_pairs(public, private))
    level = 1 - (1 - LEVEL) / max(len(pairs), 1)
    return tuple(_figure(pair, draws=draws, level=level) for pair in pairs)


def _pairs(public: pd.DataFrame, private: pd.DataFrame) -> Iterator[_Pair]:
    frames = [frame[frame["status"] != NOT_APPLICABLE] for frame in (public, private)]
    for track in sorted(set(frames[0]["track"])):
        sides = [frame[frame["track"] == track] for frame in frames]
        yield from _measured((ALL_SUITES, str(track), _ALL_PRIORS), *sides)
    for key in sorted(set(frames[0][list(_GROUP)].itertuples(index=False, name=None))):
        sides = [frame[(frame[list(_GROUP)] == list(key)).all(axis=1)] for frame in frames]
        yield from _measured(key, *sides)


def _measured(key: tuple[str, str, str], public: pd.DataFrame, private: pd.DataFrame) -> Iterator[_Pair]:
    """The primary figure, under stress where there is any on both seeds, and false fixes at absent places."""
    primary = primary_of(key[1])
    sides = [frame[_counted(primary, frame)] for frame in (public, private)]
    stressed = [frame[(frame["role"] == "stress").to_numpy(bool)] for frame in sides]
    sides = stressed if all(map(len, stressed)) else sides
    absent = [frame[_counted(FALSE_ABSENT, frame)] for frame in (public, private)]
    for measure, (ours, theirs) in ((primary, sides), (FALSE_ABSENT, absent)):
        if len(ours) and len(theirs):
            yield _Pair(key=key, measure=measure, public=ours, private=theirs)


def _counted(measure: MeanMetric, frame: pd.DataFrame) -> Bools:
    return np.asarray(measure.counts(frame)) & (frame["role"] != "falsifier").to_numpy(bool)


def _figure(pair: _Pair, *, draws: int, level: float) -> SeedFigure:
    sides = (pair.public, pair.private)
    values = [np.asarray(pair.measure.values(frame), dtype=float) for frame in sides]
    blocks = [set(frame["block"]) for frame in sides]
    is_private = np.repeat([0.0, 1.0], [len(frame) for frame in sides])
    drawn = ClusterDraws(
        blocks=[block for frame in sides for block in frame["block"]],
        seed=_seed(pair),
        draws=draws,
        draws_within=False,
    )
    both = np.concatenate(values)
    # The same draws for both: a block that holds queries of both seeds is drawn for both.
    means = [bootstrap_means(both, drawn, weights) for weights in (1 - is_private, is_private)]
    public, private = (float(side.mean()) for side in values)
    found = percentile_interval(private - public, means[1] - means[0], level=level)
    wide = difference_interval(*(_wilson(values[at], sides[at], level) for at in (1, 0)))
    lo, hi = float(np.fmin(found.lo, wide.lo)), float(np.fmax(found.hi, wide.hi))
    suite, track, prior_group = pair.key
    return SeedFigure(
        suite=suite,
        track=track,
        prior_group=prior_group,
        metric=pair.measure.name,
        public=public,
        private=private,
        difference=private - public,
        lo=lo,
        hi=hi,
        n_public=len(values[0]),
        n_private=len(values[1]),
        blocks_public=len(blocks[0]),
        blocks_private=len(blocks[1]),
        blocks_shared=len(blocks[0] & blocks[1]),
        is_worse=hi < 0 if pair.measure.better == "higher" else lo > 0,
    )


def _wilson(values: "np.ndarray[Any, np.dtype[np.float64]]", frame: pd.DataFrame, level: float) -> Interval:
    trials = effective_count(frame["pair_id"].tolist())
    return wilson(min(float(values.mean()) * trials, trials), trials, level=level)


def _seed(pair: _Pair) -> int:
    text = "/".join(("public and private", *pair.key, pair.measure.name))
    return int.from_bytes(hashlib.sha256(text.encode()).digest()[:8], "big")


def verdict_of(figures: Sequence[SeedFigure]) -> tuple[str, str]:
    """Return the label of a row by its figures on both seeds, and the reason.

    Parameters
    ----------
    figures : sequence of SeedFigure
        Of `compare_seeds`.

    Returns
    -------
    str, str
        `not reproduced` where a figure is shown to be worse on the private seed, `reproduced` where none is, `run here`
        where the blocks are too few to say the latter; and the reason in a line.

    Examples
    --------
    >>> verdict_of([])
    ('run here', 'nothing was asked on both seeds')
    """
    worse = [item for item in figures if item.is_worse]
    if worse:
        return NOT_REPRODUCED, max(worse, key=lambda item: abs(item.difference)).to_text()
    whole = [item for item in figures if item.suite == ALL_SUITES]
    if not whole:
        return RUN_HERE, "nothing was asked on both seeds"
    few = next((item for item in whole if not item.is_decided), None)
    if few is not None:
        blocks = counted(min(few.blocks_public, few.blocks_private), "block")
        return RUN_HERE, f"{few.track} is asked in {blocks} of a seed, at least {LEAST_BLOCKS} are needed to decide"
    return REPRODUCED, whole[0].to_text()


def said_of(verdict: str, why: str, figures: Sequence[SeedFigure] = ()) -> dict[str, Any]:
    """Return the entry of `board.json` on both seeds of one matcher."""
    return {"verdict": verdict, "why": why, "figures": [item.model_dump() for item in figures]}


def seed_lines(about: Mapping[str, Any]) -> list[str]:
    """Return whether the rows of a board were compared with a private seed, and the result of each.

    Examples
    --------
    >>> seed_lines({"entries": [{"name": "mine", "how": "run here"}]})[0][:40]
    'Seeds: the queries of this board are dra'
    """
    if about.get("private_seed"):
        return [_IS_PRIVATE]
    seed = about.get("private")
    if not seed:
        return [_IS_PUBLIC]
    words = f"a private seed of {seed['bits']} bits, commitment {seed['commitment'][:12]}"
    said = [(entry["name"], entry.get("private")) for entry in about.get("entries", ())]
    return [
        f"Seeds: rows were held against the same pipeline on {words}.",
        *(f"{name}: {row['verdict']} ({row['why']})." for name, row in said if row),
    ]
