# SPDX-License-Identifier: Apache-2.0
"""A request for a board, and a board with what it was made of."""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import pandas as pd

from sasgeo_bench.boards.board import Board
from sasgeo_bench.boards.manifests import BoardManifest, Elsewhere, PipelineRecord
from sasgeo_bench.running.failures import Failures
from sasgeo_bench.running.prediction_files import StoredAnswers
from sasgeo_bench.scoring.contrasts import Contrast
from sasgeo_bench.scoring.controls import Falsifier
from sasgeo_bench.scoring.entries import Entry
from sasgeo_bench.scoring.intervals import DRAWS
from sasgeo_bench.scoring.score import SCORER_VERSION
from sasgeo_bench.tasks.private_seed import SealedPlace
from sasgeo_bench.tasks.query import Truth
from sasgeo_bench.tasks.split import Split
from sasgeo_bench.tasks.task_files import TaskManifest


@dataclass(frozen=True, kw_only=True)
class ScoreRequest:
    """A request for a board, written to the folder `board`.

    `predictions` are folders of runs, with runs at any depth, and files of predictions; `submissions` are folders that
    are scored as files are, with more checks (`submission_files.submission_faults`). `tasks` are task folders; without
    any, those that the runs and files answer. A matcher that was asked nothing of one of them has no figures on its
    suite. `root` holds tasks/ and truth/, `truth` is the folder of the truths where it is another one.

    `split` assigns blocks to places, and names those that calibrate; rejectors (names, or module:Class) need it.
    `metrics` of other packages (names, or module:NAME) get rows and columns beside ours, and so do limits in `within`
    (as "5m,2deg"); `require` states requirements (`requirements.parse_requirements`).
    `contrasts` are the registered ones. `draws` counts those of the bootstrap; suites in `by_region` are resampled by
    region, not by block; in suites of `by_block` each block is a place. `without` are regions to leave out, with all of
    their maps. `jobs` processes fit rejectors, or workers of the cluster at `dask`.

    `pipeline` is name and hash of the pipeline that requests the board, if one does, `title` its title. `private` is a
    board of a private seed of the same pipeline to compare rows with. `added` are entries that the pipeline does not
    name. `kept` is the manifest of stored results: it keeps the version of their maps, their title and their sealed
    places, and their results on a private seed where no private board is named.
    `sealed` are the sealed places (`private_seed.sealed_record`). `failed` names entries that
    failed before scoring, and why. `stored` is a board whose entries are not fitted again, `elsewhere` rows of other
    boards that asked the same queries. What rejectors make of the answers is kept for the next time in the folder
    `kept_fits`, if there is one (`archive.fits_folder`).
    """

    predictions: Sequence[Path]
    root: Path
    board: Path
    tasks: Sequence[Path] = ()
    truth: Path | None = None
    split: Split | None = None
    contrasts: Sequence[Contrast] = ()
    rejectors: Sequence[str] = ()
    metrics: Sequence[str] = ()
    within: Sequence[str] = ()
    require: Sequence[str] = ()
    draws: int = DRAWS
    by_region: Collection[str] = ()
    by_block: Collection[str] = ()
    pipeline: PipelineRecord | None = None
    title: str = ""
    added: Collection[str] = ()
    without: Collection[str] = ()
    submissions: Sequence[Path] = ()
    jobs: int = 1
    dask: str | None = None
    private: Path | None = None
    kept: BoardManifest = field(
        default_factory=lambda: BoardManifest(scorer_version=SCORER_VERSION, entries=[], tasks=[])
    )
    sealed: Mapping[str, SealedPlace] = field(default_factory=dict)
    failed: Mapping[str, str] = field(default_factory=dict)
    stored: Board | None = None
    elsewhere: Sequence[Elsewhere] = ()
    kept_fits: Path | None = None


@dataclass(frozen=True, kw_only=True)
class Scored:
    """A board and what it was made of, as figures, pictures and stored results need it.

    `entries` are all that were asked something, controls alone included, `predictions` their answers by name, `tasks`
    and `truths` (by query id) what they were asked. `scores` are the scored rows that count, by entry, and
    `with_calibration` also those of the calibration places of a hold-out split; `views` are the rows of the views of
    flights (`flights.view_frame`). `judged` are the results of rejectors by entry and rejector, `measured` the
    measurements of truths by query id, of flights those of their first view. `failures` are what failed, and why.
    """

    board: Board
    entries: tuple[Entry, ...] = ()
    tasks: tuple[TaskManifest, ...] = ()
    predictions: Mapping[str, StoredAnswers]
    scores: dict[str, pd.DataFrame]
    with_calibration: Mapping[str, pd.DataFrame] = field(default_factory=dict)
    views: Mapping[str, pd.DataFrame] = field(default_factory=dict)
    judged: Mapping[tuple[str, str], pd.DataFrame] = field(default_factory=dict)
    falsifiers: tuple[Falsifier, ...] = ()
    truths: Mapping[str, Truth] = field(default_factory=dict)
    measured: Mapping[str, Mapping[str, float]] = field(default_factory=dict)
    failures: Failures
