# SPDX-License-Identifier: Apache-2.0
"""Compare a public board with one of a private seed of the same pipeline: which rows are reproduced."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

import numpy as np
import pandas as pd

from sasgeo_bench.boards.board_files import read_board_manifest, read_scores
from sasgeo_bench.boards.manifests import (
    BoardEntry,
    BoardManifest,
    PipelineRecord,
    SeedFigure,
    SeedRecord,
    SeedResult,
    SeedVerdict,
)
from sasgeo_bench.boards.scored import ScoreRequest
from sasgeo_bench.core.errors import ConfigError, counted
from sasgeo_bench.core.progress import tell
from sasgeo_bench.regions.region import DATA_VERSION
from sasgeo_bench.running.sandbox import keeps_truth
from sasgeo_bench.scoring.base import Bools
from sasgeo_bench.scoring.compare import LEAST_BLOCKS
from sasgeo_bench.scoring.entries import Entry
from sasgeo_bench.scoring.intervals import (
    LEVEL,
    ClusterDraws,
    Interval,
    bootstrap_means,
    difference_interval,
    effective_count,
    percentile_interval,
    seed_of_text,
    wilson_share,
)
from sasgeo_bench.scoring.metric import MeanMetric
from sasgeo_bench.scoring.metrics import FALSE_ABSENT, primary_of
from sasgeo_bench.scoring.rows import ALL_SUITES, NOT_REPRODUCED, PACKED, REPRODUCED, RUN_HERE, base_name
from sasgeo_bench.scoring.score import NOT_APPLICABLE, SCORER_VERSION
from sasgeo_bench.scoring.strata import GROUP
from sasgeo_bench.tasks.private_seed import REPRODUCING_BITS
from sasgeo_bench.tasks.query import TASK_VERSION
from sasgeo_bench.tasks.task_files import TaskManifest

_ALL_PRIORS: Final = "all"


@dataclass(frozen=True, slots=True, kw_only=True)
class _Pair:
    """Scored rows of one matcher on both seeds that one figure is of."""

    key: tuple[str, str, str]
    measure: MeanMetric
    public: pd.DataFrame
    private: pd.DataFrame


def compare_seeds(public: pd.DataFrame, private: pd.DataFrame, *, draws: int) -> tuple[SeedFigure, ...]:
    """Return figures of a matcher on both seeds: of all suites on a track first, then suite by suite.

    `public` and `private` are its scored rows (`score.score_task`) on the tasks that both seeds have. No figure is of
    queries that were asked on one seed alone, or that the matcher's card excludes.

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
    for key in sorted(set(frames[0][list(GROUP)].itertuples(index=False, name=None))):
        sides = [frame[(frame[list(GROUP)] == list(key)).all(axis=1)] for frame in frames]
        yield from _measured(key, *sides)


def _measured(key: tuple[str, str, str], public: pd.DataFrame, private: pd.DataFrame) -> Iterator[_Pair]:
    """Yield the primary figure, under stress where there is any on both seeds, and false fixes at absent places."""
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
        seed=seed_of_text("/".join(("public and private", *pair.key, pair.measure.name))),
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
    return wilson_share(float(values.mean()), effective_count(frame["pair_id"].tolist()), level=level)


def result_of(figures: Sequence[SeedFigure]) -> SeedResult:
    """Return the label of a row by its figures on both seeds (`compare_seeds`), with the reason in a line.

    `not reproduced` means that a figure is shown to be worse on the private seed, `reproduced` that none is, and `run
    here` that the blocks are too few to decide.
    """
    worse = [item for item in figures if item.is_worse]
    if worse:
        return _result(NOT_REPRODUCED, max(worse, key=lambda item: abs(item.difference)).to_text(), figures)
    whole = [item for item in figures if item.suite == ALL_SUITES]
    if not whole:
        return _result(RUN_HERE, "nothing was asked on both seeds", figures)
    few = next((item for item in whole if not item.is_decided), None)
    if few is not None:
        blocks = counted(min(few.blocks_public, few.blocks_private), "block")
        why = f"{few.track} is asked in {blocks} of a seed, at least {LEAST_BLOCKS} are needed to decide"
        return _result(RUN_HERE, why, figures)
    return _result(REPRODUCED, whole[0].to_text(), figures)


def _result(verdict: SeedVerdict, why: str, figures: Sequence[SeedFigure] = ()) -> SeedResult:
    return SeedResult(verdict=verdict, why=why, figures=list(figures))


_VERSIONS: Final = {"scorer_version": SCORER_VERSION, "task_version": TASK_VERSION, "data_version": DATA_VERSION}


@dataclass(frozen=True, kw_only=True)
class OnPrivate:
    """Results of a private board for the rows of a public one; empty if the public one was not compared with it.

    `rows` are the results by name of entry.
    """

    seed: SeedRecord | None = None
    rows: Mapping[str, SeedResult] = field(default_factory=dict)

    def how(self, entry: Entry) -> str:
        """Return how an entry's answers were made, and how they fared on the private seed, but of packed ones."""
        if entry.how == PACKED:
            return PACKED
        return self.rows[entry.name].verdict if entry.name in self.rows else entry.how


def seed_of(tasks: Sequence[TaskManifest]) -> SeedRecord | None:
    """Return the commitment and bits of the private seed that tasks were drawn by; None for public tasks.

    Raise ConfigError if they are of several seeds, or some are public.
    """
    seeds = [task.private_seed for task in tasks]
    if any(seed != seeds[0] for seed in seeds):
        raise ConfigError(
            "these tasks are drawn by several seeds, and one is private: draw them by one, and score those alone"
        )
    return SeedRecord.model_validate(seeds[0]) if seeds and seeds[0] else None


def check_public(seed: SeedRecord | None, what: str) -> None:
    """Refuse to publish results of a private seed: once its queries or truths are known, it proves nothing.

    Raise ConfigError that names `what`.
    """
    if seed is not None:
        raise ConfigError(
            f"{what} is of a private seed, and holds queries, truths and answers: nothing of it is published but "
            "figures (score --private puts them on the public board)"
        )


def score_private(
    request: ScoreRequest,
    *,
    entries: Sequence[Entry],
    scores: Mapping[str, pd.DataFrame],
    tasks: Sequence[TaskManifest],
) -> OnPrivate:
    """Compare the rows of a public board with the board of a private seed that is named, and tell how they fared.

    `entries`, `scores` and `tasks` are those of the public board. Without such a board, stored results keep theirs.
    Report which tasks the two boards do not share. Raise ConfigError if the folder holds no board of a private seed, or
    one of another pipeline or version, or the public one is itself of a private seed. Raise StoreError if it holds no
    sound board.
    """
    if request.private is None:
        return OnPrivate() if request.without else _kept_private(request.kept, entries, request.root)
    folder = request.private
    about, seed = read_private(folder, request.pipeline)
    if seed_of(tasks) is not None:
        raise ConfigError(
            "the rows to be held against a private seed are of a private seed themselves: name a public board"
        )
    asked = {(task.suite, task.region, task.map_date) for task in tasks}
    both = asked & {(item.suite, item.region, item.map_date) for item in about.tasks}
    alone = len(tasks) - len(both)
    if alone:
        tell(f"{folder}: {counted(alone, 'task')} of this board {'is' if alone == 1 else 'are'} not on the private one")
    named = {item[:2] for item in both}
    theirs = read_scores(folder)
    theirs = theirs[_is_of(theirs, named)]
    known = {_whose(entry): entry for entry in about.entries}
    rows = {}
    for entry in entries:
        if not entry.runs or entry.how == PACKED:
            continue
        other = known.get(_whose(entry))
        why = _lack(other, seed)
        if other is None or why:
            rows[entry.name] = _result(RUN_HERE, why)
            continue
        mine, frame = scores[entry.name], theirs[theirs["matcher"] == other.name]
        rows[entry.name] = result_of(compare_seeds(mine[_is_of(mine, named)], frame, draws=request.draws))
    for name, row in rows.items():
        tell(f"{name}: {row.verdict} ({row.why})")
    return OnPrivate(seed=seed, rows=rows)


def read_private(folder: Path, pipeline: PipelineRecord | None) -> tuple[BoardManifest, SeedRecord]:
    """Read the manifest of a private board that rows of a pipeline are compared with, and the seed that drew it."""
    about = read_board_manifest(folder)
    if about.private_seed is None:
        raise ConfigError(f"{folder} is a board of a public seed: name one that 'leaderboard --seed-file' has made")
    if pipeline is None or about.pipeline != pipeline:
        raise ConfigError(
            f"{folder} is of another pipeline file, or of other --matcher, than this board: run both with the same"
        )
    stale = next((name for name, number in _VERSIONS.items() if getattr(about, name) != number), None)
    if stale is not None:
        raise ConfigError(
            f"{folder} has {stale} {getattr(about, stale)}, this program {_VERSIONS[stale]}: run the seed again"
        )
    return about, about.private_seed


def _is_of(scores: pd.DataFrame, named: set[tuple[str, str]]) -> "pd.Series[bool]":
    keys = zip(scores["suite"], scores["region"], strict=True)
    return pd.Series([key in named for key in keys], index=scores.index, dtype=bool)


def _whose(entry: Entry | BoardEntry) -> tuple[str, str | None, str | None]:
    """Return name, version, and hash of code and settings, which identify an entry on both boards."""
    return (base_name(entry.name), entry.version, entry.hash)


def _lack(entry: BoardEntry | None, seed: SeedRecord) -> str:
    """Return why a private board cannot confirm any row, or not this one; empty where it can."""
    if seed.bits < REPRODUCING_BITS:
        return f"the private seed has {seed.bits} bits, {REPRODUCING_BITS} are needed"
    if entry is None:
        return "this version, code and settings are not on the private board"
    isolation = entry.isolation or {}
    if keeps_truth(isolation):
        return ""
    return f"on the private seed its truths were not kept from it ({isolation.get('truth', 'not protected')})"


def _kept_private(about: BoardManifest, entries: Sequence[Entry], root: Path) -> OnPrivate:
    """Return the results on a private seed that stored results keep, for entries whose answers all come from them.

    `about` is the manifest of the stored results, `root` the folder that they are unpacked to.
    """
    if about.private is None:
        return OnPrivate()
    known = {_whose(entry): entry.private for entry in about.entries}
    rows = {}
    for entry in entries:
        row = known.get(_whose(entry))
        if entry.runs and row is not None and all(source.is_relative_to(root) for source in entry.sources):
            rows[entry.name] = row
    return OnPrivate(seed=about.private, rows=rows)
