# SPDX-License-Identifier: Apache-2.0
"""Training groups: the tasks that a matcher is asked together, and the tasks that it learns from before."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from sasgeo_bench.errors import ConfigError, named
from sasgeo_bench.leaderboard.pipeline_spec import LearningSpec
from sasgeo_bench.tasks.query import CONTROLS, base_of
from sasgeo_bench.tasks.split import HALVES, Split
from sasgeo_bench.tasks.task_plan import Request

HELD_OUT: Final = "held out"
_NOT_TRAINED: Final = ("calibration", "test")


@dataclass(frozen=True, slots=True, kw_only=True)
class TrainingGroup:
    """Task folders that a matcher is asked in one run, and those it learns from before; none if it stays untaught.

    `name` is the half in a cross-fit, "held out" in a hold-out.
    """

    name: str
    asked: tuple[Path, ...]
    train: tuple[Path, ...]


@dataclass(frozen=True, slots=True, kw_only=True)
class TrainingGroups:
    """Training groups of a pipeline: the split of a pipeline, that of its controls, and its table `[learning]`."""

    split: Split
    controls: Split
    learning: LearningSpec

    def of(self, asked: Sequence[Path], tasks: Sequence[Path], *, is_oracle: bool) -> list[TrainingGroup]:
        """Return the groups of a matcher that is asked some of all `tasks`; an oracle learns from what it is asked.

        In a cross-fit each half is asked after learning from the other. In a hold-out all that is not for training is
        asked after learning from the train places. Tasks of no place, as the paper's, are asked untaught. A sealed
        place never trains.
        """
        groups = {task: self._group_of(task) for task in tasks}
        names = [HELD_OUT] if is_holdout(self.split) else [f"half {half}" for half in HALVES]
        none = f"no {'part' if is_holdout(self.split) else 'half'}"
        found = [
            TrainingGroup(
                name=name or none,
                asked=tuple(task for task in asked if groups[task] == name),
                train=tuple(task for task in tasks if name and self._teaches(task, groups[task], name, is_oracle)),
            )
            for name in (*names, None)
        ]
        return [group for group in found if group.asked]

    def _teaches(self, task: Path, group: str | None, name: str, is_oracle: bool) -> bool:  # noqa: FBT001
        """Return whether a task trains for a group of places."""
        is_fit = task.parent.name in self.learning.suites and group is not None
        return is_fit and (group == name) == is_oracle and self.split.sealed_place(base_of(task.name)) is None

    def _group_of(self, task: Path) -> str | None:
        """Return the group of places that a task belongs to: "half a", "held out", "train"; None for the paper's."""
        region = base_of(task.name)
        for split in (self.split, self.controls):
            for place in split.places_in(region):
                if not is_holdout(self.split):
                    half = split.half_of.get(place)
                    return None if half is None else f"half {half}"
                if split is self.split:
                    return HELD_OUT if split.part_of(place) in _NOT_TRAINED else "train"
        return HELD_OUT if task.parent.name == CONTROLS else None

    def lines(self, requests: Sequence[Request]) -> list[str]:
        """Report what is learned from where; `requests` are those of the pipeline."""
        suites, most = ", ".join(self.learning.suites), self.learning.most
        if not is_holdout(self.split):
            how, own = "each half is asked after learning from the other", "the half itself"
        else:
            how = "calibration and test places are asked after learning from train places"
            own = "calibration and test places themselves"
        lines = [f"  learning: {how} ({suites}, at most {most} queries)"]
        for part in ("train", *_NOT_TRAINED) if is_holdout(self.split) else ():
            places = _places_of(part, requests, self.split)
            lines.append(f"    {part}: {named(places, 'place') if places else 'no place'}")
        there = {place for item in requests for place in self.split.places_in(item.region.id)}
        for half, other in () if is_holdout(self.split) else (HALVES, HALVES[::-1]):
            if not any(self.split.half_of.get(place) == half for place in there):
                lines.append(f"    half {half} has no place here: nobody learns for half {other}")
        if self.learning.oracles:
            lines.append(f"    {', '.join(self.learning.oracles)}: from {own}, never ranked")
        return lines


def is_holdout(split: Split) -> bool:
    """Return whether whole places are held out."""
    return split.spec.kind == "holdout"


def trains(split: Split, region: str) -> bool:
    """Return whether all of a region is for training in a hold-out, so that no matcher is asked there."""
    parts = {split.part_of(place) for place in split.places_in(region)}
    return is_holdout(split) and parts == {"train"}


def needed(requests: Sequence[Request], learning: LearningSpec | None) -> tuple[Request, ...]:
    """Return the requests that are learned from or asked: on train places of a hold-out only suites to learn from.

    Raise `ConfigError` if learning from a hold-out has no train or no test place, or a region of several parts.
    """
    taught = frozenset[str]() if learning is None else frozenset(learning.suites)
    found = tuple(item for item in requests if not trains(item.split, item.region.id) or item.suite in taught)
    split = requests[0].split
    if not is_holdout(split):
        return found
    if learning is not None:
        _check_parts(requests, split)
    if not split.sealed and not _places_of("test", requests, split):
        raise ConfigError(
            f"no region is of a test place of the hold-out {split.spec.id!r}, and a board ranks these alone: add one"
        )
    return found


def _check_parts(requests: Sequence[Request], split: Split) -> None:
    """Refuse learning from a hold-out without a train place, or with a region that is trained on and asked."""
    if not _places_of("train", requests, split):
        raise ConfigError(
            f"[learning] has no region of a train place of the hold-out {split.spec.id!r}: add one, or leave it out"
        )
    for region in dict.fromkeys(item.region.id for item in requests):
        parts = sorted({split.part_of(place) for place in split.places_in(region)})
        if "train" in parts and len(parts) > 1:
            raise ConfigError(
                f"region {region!r} has blocks of the parts {' and '.join(parts)} of split {split.spec.id!r}, and is "
                "learned from: [learning] needs regions of one part each"
            )


def _places_of(part: str, requests: Sequence[Request], split: Split) -> tuple[str, ...]:
    """Return the places of a part that some requests are on."""
    there = {place for item in requests for place in split.places_in(item.region.id)}
    return tuple(place for place in split.blocks if place in there and split.part_of(place) == part)
