# SPDX-License-Identifier: Apache-2.0
"""The board of segmenters as files: scores, reliability, error over coverage, costs, and perception profiles."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, Self

import pandas as pd

from sasgeo_bench.errors import StoreError
from sasgeo_bench.files.parquet import read_frame, write_frame
from sasgeo_bench.scoring.perception_profile import measure_profile
from sasgeo_bench.scoring.segmentation import DRAWS, GROUPS, error_over_coverage, reliability, segmentation_scores
from sasgeo_bench.scoring.segmentation_counts import PixelCounts
from sasgeo_bench.tasks.perturbations.perception_profile import PerceptionProfile, read_profile, write_profile

PLAIN: Final = "plain"  # probabilities as the segmenter gives them
NOTHING: Final = "-"  # learned from
TRIAL: Final = ("segmenter", "learned_from", "tested_on")
TABLES: Final = ("scores", "reliability", "coverage", "runs")
PROFILES: Final = "profiles"
_DIGITS: Final = 5  # small files, and far finer than any interval
_MEND: Final = "run benchmarks/segmenters.py --results again"


@dataclass(frozen=True, slots=True, kw_only=True)
class SegmenterTrial:
    """Counts and costs of one segmenter, which learned from one set of pictures and was tested on another.

    Parameters
    ----------
    segmenter, learned_from, tested_on : str
        Its name and those of the sets; `learned_from` is "-" for a segmenter that does not learn.
    counts : mapping of str to sequence of PixelCounts
        By how shares of classes were used: "plain" without them; further keys, such as "picture" and "flight", after
        `Segmentation.with_shares`.
    learn_s, learned_mb, segment_s : float
        Processor time of learning, s; size of what was learned, MB; mean processor time of a picture, s.
    """

    segmenter: str
    learned_from: str
    tested_on: str
    counts: Mapping[str, Sequence[PixelCounts]]
    learn_s: float
    learned_mb: float
    segment_s: float

    @property
    def about(self) -> dict[str, str]:
        """Return the columns that name the trial."""
        return {name: getattr(self, name) for name in TRIAL}

    @property
    def profile_name(self) -> str:
        """Return the file name of its perception profile.

        >>> trial = SegmenterTrial(
        ...     segmenter="pixel_forest", learned_from="rendered", tested_on="shifted", counts={},
        ...     learn_s=50.0, learned_mb=4.0, segment_s=1.0,
        ... )
        >>> trial.profile_name
        'pixel_forest-rendered-shifted.toml'
        """
        learned = () if self.learned_from == NOTHING else (self.learned_from,)
        return "-".join((self.segmenter, *learned, self.tested_on)) + ".toml"


@dataclass(frozen=True, kw_only=True)
class SegmenterBoard:
    """What a stored board holds; `profiles` by file name.

    `scores` has the columns of `segmentation_scores` behind those of the trial and `shares`; `reliability` and
    `coverage` those of `reliability` and `error_over_coverage`; `runs` the costs and the numbers of pictures.
    """

    scores: pd.DataFrame
    reliability: pd.DataFrame
    coverage: pd.DataFrame
    runs: pd.DataFrame
    profiles: Mapping[str, PerceptionProfile]

    @classmethod
    def read(cls, folder: Path) -> Self:
        """Read the output of `write_board`; raise `StoreError` if a table is missing or damaged."""
        frames = {name: read_frame(folder / f"{name}.parquet", mend=_MEND) for name in TABLES}
        for name, frame in frames.items():
            if not {*TRIAL} <= {*frame.columns}:
                raise StoreError(f"{folder / name}.parquet is no table of a board of segmenters: {_MEND}")
        files = sorted((folder / PROFILES).glob("*.toml"))
        return cls(**frames, profiles={path.name: read_profile(path) for path in files})


def write_board(
    folder: Path, trials: Sequence[SegmenterTrial], *, draws: int = DRAWS, attrs: Mapping[str, Any] | None = None
) -> None:
    """Score trials and write their tables and perception profiles into a folder.

    Places and seasons are scored for plain probabilities alone. `attrs` say how the pictures were made and go into
    `runs.parquet`.
    """
    (folder / PROFILES).mkdir(parents=True, exist_ok=True)
    for old in (folder / PROFILES).glob("*.toml"):  # of trials that are no longer made
        old.unlink()
    frames: dict[str, list[pd.DataFrame]] = {name: [] for name in TABLES}
    for trial in trials:
        plain = trial.counts[PLAIN]
        frames["scores"] += [_scores(trial, kind, draws) for kind in trial.counts]
        frames["reliability"].append(reliability(plain, **trial.about))
        frames["coverage"].append(error_over_coverage(plain, **trial.about))
        frames["runs"].append(pd.DataFrame([_run(trial)]))
        profile = measure_profile(plain, segmenter=trial.segmenter, learned_from=_learned(trial))
        write_profile(profile, folder / PROFILES / trial.profile_name)
    for name, some in frames.items():
        table = pd.concat(some, ignore_index=True).round(_DIGITS)
        write_frame(table, folder / f"{name}.parquet", attrs=dict(attrs or {}) if name == "runs" else {})


def _scores(trial: SegmenterTrial, kind: str, draws: int) -> pd.DataFrame:
    """Return scores of one use of shares: of all groups if plain, else over all pictures."""
    groups = GROUPS if kind == PLAIN else GROUPS[:1]
    return segmentation_scores(trial.counts[kind], draws=draws, groups=groups, **trial.about, shares=kind)


def _run(trial: SegmenterTrial) -> dict[str, object]:
    """Return the row of costs."""
    plain = trial.counts[PLAIN]
    counted = {"images": len(plain), "places": len({one.place for one in plain})}
    return {
        **trial.about,
        **counted,
        "learn_s": trial.learn_s,
        "learned_mb": trial.learned_mb,
        "segment_s": trial.segment_s,
    }


def _learned(trial: SegmenterTrial) -> str:
    """Return what a profile says of the pictures that were learned from."""
    if trial.learned_from == NOTHING:
        return "nothing"
    is_crossfit = trial.learned_from == trial.tested_on
    return f"{trial.learned_from}, without the block that is tested" if is_crossfit else trial.learned_from
