# SPDX-License-Identifier: Apache-2.0
"""The manifest of a board from what was scored."""

import platform
from collections.abc import Mapping, Sequence
from contextlib import suppress
from functools import cache
from importlib.metadata import PackageNotFoundError, version
from typing import Final

from sasgeo_bench.leaderboard.manifests import BoardEntry, BoardManifest, BoardTask, Learned, RejectorRecord, SeedRecord
from sasgeo_bench.leaderboard.private_board import OnPrivate, seed_of
from sasgeo_bench.leaderboard.scored import ScoreRequest
from sasgeo_bench.matching.matcher import RejectorCard
from sasgeo_bench.regions.region import DATA_VERSION
from sasgeo_bench.running.run_manifest import CardRecord
from sasgeo_bench.running.sandbox import joined
from sasgeo_bench.scoring.controls import Verdict, failed_controls
from sasgeo_bench.scoring.entries import Entry
from sasgeo_bench.scoring.score import SCORER_VERSION
from sasgeo_bench.tasks.query import TASK_VERSION
from sasgeo_bench.tasks.task_files import TaskManifest

_LIBRARIES: Final = ("numpy", "scipy", "pandas", "pyarrow", "statsmodels", "scikit-learn")


def record_of(
    request: ScoreRequest,
    tasks: Sequence[TaskManifest],
    entries: Sequence[BoardEntry],
    *,
    private: SeedRecord | None,
    cards: Sequence[RejectorCard],
    remarks: Sequence[str],
    failed: Mapping[str, str],
) -> BoardManifest:
    """Return the manifest of a board; `private` is the seed that its rows were held against, `remarks` are on fits."""
    return BoardManifest(
        scorer_version=SCORER_VERSION,
        task_version=max((item.task_version for item in tasks), default=TASK_VERSION),
        data_version=request.kept.data_version or DATA_VERSION,
        made_by=f"sasgeo-bench {version('sasgeo-bench')}",
        libraries=dict(_libraries()),
        pipeline=request.pipeline,
        title=request.title or request.kept.title,
        private_seed=seed_of(tasks),
        private=private,
        sealed=dict(request.sealed or request.kept.sealed),
        split=None if request.split is None else request.split.spec.id,
        draws=request.draws,
        contrasts=list(request.contrasts),
        by_region=sorted(request.by_region),
        by_block=sorted(request.by_block),
        without=sorted(set(request.without)),
        rejectors=[
            RejectorRecord(
                name=card.name,
                version=card.version,
                title=card.title,
                source=card.source,
                licence=card.licence,
                is_calibrated=card.is_calibrated,
            )
            for card in cards
        ],
        remarks=list(remarks),
        elsewhere=list(request.elsewhere),
        failed=dict(failed),
        entries=list(entries),
        tasks=[
            BoardTask(
                suite=item.suite,
                suite_version=item.suite_version,
                region=item.region,
                map_date=item.map_date,
                queries_sha256=item.queries_sha256,
                map_fingerprint=item.map_fingerprint,
                failed_pictures=item.failed_pictures,
            )
            for item in tasks
        ],
    )


def entry_of(entry: Entry, set_apart: str | None, on_private: OnPrivate, controls: Sequence[Verdict]) -> BoardEntry:
    """Return what a board says of an entry: why it is set apart, if it is, and how it fared on a private seed."""
    return BoardEntry(
        name=entry.name,
        version=entry.version,
        hash=entry.hash,
        how=on_private.how(entry),
        card=None if entry.card is None else CardRecord.model_validate(entry.card),
        trained_on=entry.declared,
        set_apart=set_apart,
        isolation=joined(run.isolation or {} for run in entry.runs) if entry.runs else None,
        learned=[Learned.model_validate(one) for one in entry.learned()],
        private=on_private.rows.get(entry.name),
        failed_controls=[item.to_text() for item in failed_controls(controls, entry.name)],
    )


@cache
def _libraries() -> Mapping[str, str]:
    """Return the versions of Python and of installed libraries that affect results, looked up once."""
    found = {"python": platform.python_version()}
    for name in _LIBRARIES:
        with suppress(PackageNotFoundError):
            found[name] = version(name)
    return found
