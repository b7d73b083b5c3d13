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
from sasgeo_bench.scoring.controls import Verdict
from sasgeo_bench.scoring.entries import Entry
from sasgeo_bench.scoring.falsifiers import Falsifier
from sasgeo_bench.scoring.intervals import DRAWS
from sasgeo_bench.tasks.query import Truth
from sasgeo_bench.tasks.split import Split


@dataclass(frozen=True, kw_only=True)
class ScoreRequest:
    """A request for a board.

    Parameters
    ----------
    predictions : sequence of Path
        Folders of runs (any folder with runs in it), and files of predictions.
    tasks : sequence of Path
        Task folders; without any, those that the runs and files answer. A matcher that was asked nothing of one of them
        has no figures on its suite.
    root : Path
        Where tasks/ and truth/ are.
    truth : Path, optional
        Folder of the truths, where it is another one.
    split : Split, optional
        Says which blocks are one place, and which calibrate; needed for rejectors.
    contrasts : sequence of Contrast
        Those that were registered.
    rejectors : sequence of str
        Names, or module:Class.
    board : Path
        Folder to write.
    draws : int
        Of the bootstrap.
    by_region : collection of str
        Suites whose regions are resampled, not their blocks: those of which each region is a draw of its own.
    pipeline : mapping of str to str
        Name and hash of the pipeline that asks for it; none for a board of `score`.
    extras : sequence of callable
        Each makes, of the finished board, files that are written with it.
    without : collection of str
        Regions that are left out, on each of their maps.
    submissions : sequence of Path
        Folders of submissions, scored as files are, but held to more (`validate.submission_faults`).
    jobs : int
        Processes that fit rejectors.
    private : Path, optional
        A board of a private seed of the same pipeline, which the rows are held against.
    kept : mapping, optional
        What `board.json` of stored results says: the version of their maps is kept, and what came of a private seed
        where no other board is named.
    failed : mapping of str to str
        Contestants that failed before anything was scored, and why.
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

    `remarks` are what rejectors said of their fits; `protection` has no row where no answer tells a protection level.
    `judged` is what rejectors say of answers, by matcher and rejector, `measured` what was done to each query, by id,
    `truths` all that is known of it, controls among them. `everyone` are the entries with those who were asked nothing
    but controls; so are the predictions. `apart` says of contestants whose rows are set apart why they are,
    `on_private` what came of the rows on a private seed, `failures` who failed and why.
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
