# SPDX-License-Identifier: Apache-2.0
"""The board of segmenters as files: scores, reliability, error over coverage, costs, and perception profiles."""

import math
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, Self

import pandas as pd

from sasgeo_bench.core.errors import MetricError, StoreError
from sasgeo_bench.core.parquet import read_frame, write_frame
from sasgeo_bench.scoring.compare import LEAST_PLACES
from sasgeo_bench.scoring.perception_profile import measure_profile
from sasgeo_bench.scoring.segmentation import (
    DRAWS,
    GROUPS,
    PixelCounts,
    error_over_coverage,
    reliability,
    segmentation_scores,
)
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
    folder: Path, trials: Sequence[SegmenterTrial], *, draws: int = DRAWS, attrs: Mapping[str, object] | None = None
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


SHOWN: Final = ("building", "road_minor", "water", "green")  # classes of the tables by season and place
MAIN: Final = "building"  # the one class that all real pictures have labels of
QUALITY: Final = ("iou", "recall", "precision", "auc", "ece")
SILENCE: Final = ("silent", "recall", "recall_where_known", "error", "error_80", "aurc")
KEPT: Final = (0.95, 0.9, 0.8, 0.6)  # coverages
NARROW: Final = "†"  # an interval that draws pictures alone
NONE: Final = "-"
_TITLES: Final = {
    "segmenter": "segmenter",
    "learned_from": "learned from",
    "tested_on": "tested on",
    "images": "n",
    "places": "places",
    "iou": "IoU",
    "auc": "AUC",
    "ece": "ECE",
    "aurc": "AURC",
    "recall_where_known": "recall, answered",
    "error_80": "error, surest 80 %",
}

Line = Mapping[str, str]


def page_tables(board: SegmenterBoard) -> str:
    """Return all tables of a board as Markdown, each below its heading.

    Examples
    --------
    >>> import tempfile
    >>> from pathlib import Path
    >>> import sasgeo_bench as sgb
    >>> from sasgeo_bench.scoring.segmentation import PixelCounts
    >>> from sasgeo_bench.scoring.segmenter_board import SegmenterTrial, write_board
    >>> floor = sgb.load_segmenter("colour_thresholds")
    >>> counts = [
    ...     PixelCounts.of(one, floor.segment(one.image, learned=None), image=str(at))
    ...     for at, one in enumerate(sgb.tiny_images())
    ... ]
    >>> trial = SegmenterTrial(
    ...     segmenter="colour_thresholds", learned_from="-", tested_on="tiny", counts={"plain": counts},
    ...     learn_s=0.0, learned_mb=0.0, segment_s=0.01,
    ... )
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     write_board(Path(folder), [trial], draws=20)
    ...     text = page_tables(SegmenterBoard.read(Path(folder)))
    >>> text.splitlines()[0]
    '## From set to set: buildings'
    """
    return "\n\n".join(f"## {title}\n\n{table}" for title, table in _tables(board).items())


def with_tables(page: str, board: SegmenterBoard) -> str:
    """Return a page whose tables are those of a board: the first table below each heading of the same name.

    Raise `MetricError` if the page has no such heading, or no table below it.
    """
    for title, table in _tables(board).items():
        found = re.search(rf"^## {re.escape(title)}\n(?:(?!##? |\|).*\n)*((?:\|.*\n)+)", page, re.MULTILINE)
        if found is None:
            raise MetricError(f"the page has no heading '## {title}' with a table below it: add them")
        page = page[: found.start(1)] + table + "\n" + page[found.end(1) :]
    return page


def _tables(board: SegmenterBoard) -> dict[str, str]:
    """Return the tables of a board by heading; those without rows are left out."""
    sections = {
        f"From set to set: {MAIN}s": _transfer(board),
        "Classes": _classes(board),
        "Seasons": _groups(board, "season"),
        "Places": _groups(board, "place"),
        "Silence": _silence(board),
        f"Unknown: {MAIN}s": _coverage(board),
        f"Reliability: {MAIN}s": _reliability(board),
        f"Shares: {MAIN}s": _shares(board),
        "Costs": _costs(board),
        "Perception profiles": _profiles(board),
    }
    tables = ((title, list(lines)) for title, lines in sections.items())
    return {title: as_markdown(lines) for title, lines in tables if lines}


def as_markdown(lines: Sequence[Line]) -> str:
    """Return rows with the same keys as a Markdown table, whose columns of figures are aligned right.

    >>> print(as_markdown([{"class": "water", "n": "12"}]))
    | class | n |
    |---|---:|
    | water | 12 |
    """
    head = list(lines[0])
    is_text = [all(not _is_figure(line[name]) for line in lines) for name in head]
    rule = "|".join("---" if text else "---:" for text in is_text)
    rows = (f"| {' | '.join(line.values())} |" for line in lines)
    return "\n".join((f"| {' | '.join(head)} |", f"|{rule}|", *rows))


def _is_figure(text: str) -> bool:
    return text[:1].isdigit() or (text[:1] == "-" and text[1:2].isdigit())


def _title(name: str) -> str:
    return _TITLES.get(name, name)


def _trials(frame: pd.DataFrame) -> Iterator[tuple[Line, pd.DataFrame]]:
    """Yield the cells that name each trial, and its rows, in the order of the table."""
    for key, part in frame.groupby(list(TRIAL), sort=False):
        yield {_title(name): str(value) for name, value in zip(TRIAL, key, strict=True)}, part


def _cell(rows: pd.DataFrame, metric: str) -> str:
    """Return a figure and its interval: by places if these are enough, else by pictures, with a mark."""
    found = rows[rows["metric"] == metric]
    if found.empty or math.isnan(found["value"].iloc[0]):
        return NONE
    row = found.iloc[0]
    has_places = row["places"] >= LEAST_PLACES
    lo, hi = (row["lo"], row["hi"]) if has_places else (row["lo_images"], row["hi_images"])
    shown = f"{row['value']:.3f}"
    return shown if math.isnan(lo) else f"{shown} [{lo:.3f}, {hi:.3f}]{'' if has_places else NARROW}"


def _cells(rows: pd.DataFrame, metrics: Sequence[str]) -> dict[str, str]:
    return {_title(metric): _cell(rows, metric) for metric in metrics}


def _plain(board: SegmenterBoard, group: str, shares: str = PLAIN) -> pd.DataFrame:
    scores = board.scores
    return scores[(scores["group"] == group) & (scores["shares"] == shares)]


def _counted(rows: pd.DataFrame) -> dict[str, str]:
    return {_title(name): f"{rows[name].iloc[0]}" for name in ("images", "places")}


def _present(board: SegmenterBoard) -> dict[tuple[str, ...], float]:
    """Return the fraction of the labelled pixels that a class covers, by trial and class, where predicted."""
    table = board.reliability
    hits = (table["pixels"] * table["present"]).groupby([table[name] for name in (*TRIAL, "class")]).sum()
    pixels = table.groupby([*TRIAL, "class"])["pixels"].sum()
    shares = (hits / pixels).reset_index(name="share")
    keys = shares[[*TRIAL, "class"]].itertuples(index=False, name=None)
    return dict(zip(keys, shares["share"].tolist(), strict=True))


def _transfer(board: SegmenterBoard) -> Iterator[Line]:
    """Yield a row for each trial, of the main class."""
    for name, part in _trials(_plain(board, "all")):
        rows = part[part["class"] == MAIN]
        if len(rows):
            yield {**name, **_counted(rows), **_cells(rows, QUALITY)}


def _classes(board: SegmenterBoard) -> Iterator[Line]:
    """Yield a row for each class of the trials with several classes."""
    present = _present(board)
    for name, part in _trials(_plain(board, "all")):
        if set(part["class"]) == {MAIN}:  # stands in the table of transfer
            continue
        for class_name, rows in part.groupby("class", sort=False):
            share = present.get((*name.values(), str(class_name)), math.nan)
            yield {**name, "class": str(class_name), "share": f"{100 * share:.2f} %", **_cells(rows, QUALITY)}


def _groups(board: SegmenterBoard, group: str) -> Iterator[Line]:
    """Yield a row for each season or place of each trial: IoU of some classes, calibration of the main one."""
    for name, part in _trials(_plain(board, group)):
        for value, rows in part.groupby("name", sort=False):
            of_class = {shown: rows[rows["class"] == shown] for shown in SHOWN}
            shown = {f"IoU {title}": _cell(some, "iou") for title, some in of_class.items()}
            counted = {"n": f"{rows['images'].max()}"}
            yield {**name, group: str(value), **counted, **shown, f"ECE {MAIN}": _cell(of_class[MAIN], "ece")}


def _silence(board: SegmenterBoard) -> Iterator[Line]:
    """Yield a row for each trial and shown class: what silence and unknown cost and save."""
    for name, part in _trials(_plain(board, "all")):
        for class_name in SHOWN:
            rows = part[part["class"] == class_name]
            if len(rows):
                yield {**name, "class": class_name, **_cells(rows, SILENCE)}


def _coverage(board: SegmenterBoard) -> Iterator[Line]:
    """Yield a row for each trial: error and recall of the main class when the least sure pixels become unknown."""
    for name, part in _trials(board.coverage[board.coverage["class"] == MAIN]):
        line = {**name, "all": _kept(part.iloc[-1])}
        for kept in KEPT:
            enough = part[part["coverage"] >= kept]
            line[f"surest {100 * kept:.0f} %"] = NONE if enough.empty else _kept(enough.iloc[0])
        yield line


def _kept(row: "pd.Series[Any]") -> str:
    """Return error and recall of what is kept."""
    return f"{row['error']:.3f} / {row['recall']:.3f}"


def _reliability(board: SegmenterBoard) -> Iterator[Line]:
    """Yield a row for each trial: the fraction present by bin of probability, of the main class."""
    table = board.reliability
    for name, part in _trials(table[table["class"] == MAIN]):
        bins = {round(float(row["from"]), 1): row["present"] for _, row in part.iterrows()}
        shown = {f"{at / 10:.1f}-{(at + 1) / 10:.1f}": bins.get(at / 10) for at in range(10)}
        yield {**name, **{key: NONE if value is None else f"{value:.3f}" for key, value in shown.items()}}


def _shares(board: SegmenterBoard) -> Iterator[Line]:
    """Yield a row for each trial: the main class as the segmenter gives it, and with the shares of the place."""
    for name, part in _trials(board.scores[board.scores["group"] == "all"]):
        line = dict(name)
        for metric in ("iou", "ece"):
            for kind in part["shares"].unique():
                rows = part[(part["shares"] == kind) & (part["class"] == MAIN)]
                line[_title(metric) + ("" if kind == PLAIN else f", by {kind}")] = _cell(rows, metric)
        yield line


def _costs(board: SegmenterBoard) -> Iterator[Line]:
    """Yield a row for each trial: time and size."""
    for name, part in _trials(board.runs):
        row = part.iloc[0]
        costs = {"learning, CPU s": f"{row['learn_s']:.0f}", "learned, MB": f"{row['learned_mb']:.1f}"}
        yield {**name, **_counted(part), **costs, "a picture, CPU s": f"{row['segment_s']:.2f}"}


def _profiles(board: SegmenterBoard) -> Iterator[Line]:
    """Yield a row for each perception profile: its rates of the main class."""
    for file, profile in board.profiles.items():
        found = profile.classes.get(MAIN)
        rates = ("recall", "precision", "of_ground")
        values = {rate: NONE if found is None else f"{getattr(found, rate):.3f}" for rate in rates}
        yield {"profile": f"`{file}`", "classes": f"{len(profile.classes)}", **values}
