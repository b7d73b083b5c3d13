# SPDX-License-Identifier: Apache-2.0
"""A board in memory, and the request for one."""

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import pandas as pd

from sasgeo_bench.leaderboard.board_files import Extra
from sasgeo_bench.leaderboard.private_board import OnPrivate
from sasgeo_bench.matching.results import Prediction
from sasgeo_bench.running.failures import LOG, Failures
from sasgeo_bench.scoring.contrasts import Contrast, Finding
from sasgeo_bench.scoring.controls import Falsifier, Verdict
from sasgeo_bench.scoring.entries import Entry
from sasgeo_bench.scoring.intervals import DRAWS
from sasgeo_bench.tasks.query import Truth
from sasgeo_bench.tasks.split import Split


@dataclass(frozen=True, kw_only=True)
class ScoreRequest:
    """A request for a board, written to the folder `board`.

    `predictions` are folders of runs, with runs at any depth, and files of predictions; `submissions` are folders that
    are scored as files are, with more checks (`validate.submission_faults`). `tasks` are task folders; without any,
    those that the runs and files answer. A matcher that was asked nothing of one of them has no figures on its suite.
    `root` holds tasks/ and truth/, `truth` is the folder of the truths where it is another one.

    `split` assigns blocks to places, and names those that calibrate; rejectors (names, or module:Class) need it.
    `contrasts` are the registered ones. `draws` counts those of the bootstrap; suites in `by_region` are resampled by
    region, not by block. `without` are regions to leave out, with all of their maps. `jobs` processes fit rejectors.
    `extras` make, from the finished board, files that are written with it.

    `pipeline` is name and hash of the pipeline that requests the board, if one does. `private` is a board of a private
    seed of the same pipeline to compare rows with. `kept` is the `board.json` of stored results: it keeps the version
    of their maps, and their results on a private seed where no private board is named. `failed` names entries that
    failed before scoring, and why.
    """

    predictions: Sequence[Path]
    root: Path
    board: Path
    tasks: Sequence[Path] = ()
    truth: Path | None = None
    split: Split | None = None
    contrasts: Sequence[Contrast] = ()
    rejectors: Sequence[str] = ()
    draws: int = DRAWS
    by_region: Collection[str] = ()
    pipeline: Mapping[str, str] = field(default_factory=dict)
    extras: Sequence[Callable[["Board"], Extra]] = ()
    without: Collection[str] = ()
    submissions: Sequence[Path] = ()
    jobs: int = 1
    private: Path | None = None
    kept: Mapping[str, Any] = field(default_factory=dict)
    failed: Mapping[str, str] = field(default_factory=dict)


@dataclass(frozen=True, kw_only=True)
class Board:
    """A board in memory: scored rows by matcher, without those of the controls, and the leaderboard.

    `remarks` are those of rejectors on their fits; `protection` has no row where no answer has a protection level.
    `judged` are the results of rejectors by matcher and rejector, `measured` the measurements of truths by query id,
    and `truths` all truths, those of controls included. `everyone` also holds entries that were asked only controls; so
    does `predictions`. `apart` are the reasons for excluding entries from ranks, `on_private` the results on a private
    seed, `failures` the entries that failed, and why.
    """

    entries: tuple[Entry, ...]
    scores: dict[str, pd.DataFrame]
    predictions: dict[str, dict[str, Prediction]]
    table: pd.DataFrame
    findings: tuple[Finding, ...] = ()
    falsifiers: tuple[Falsifier, ...] = ()
    verdicts: tuple[Verdict, ...] = ()
    tasks: tuple[dict[str, Any], ...] = field(default=())
    remarks: tuple[str, ...] = ()
    protection: pd.DataFrame = field(default_factory=pd.DataFrame)
    judged: Mapping[tuple[str, str], pd.DataFrame] = field(default_factory=dict)
    measured: Mapping[str, Mapping[str, float]] = field(default_factory=dict)
    truths: Mapping[str, Truth] = field(default_factory=dict)
    everyone: tuple[Entry, ...] = ()
    apart: Mapping[str, str] = field(default_factory=dict)
    on_private: OnPrivate = field(default_factory=OnPrivate)
    failures: Failures = field(default_factory=lambda: Failures(Path(LOG), tell=lambda _: None))
