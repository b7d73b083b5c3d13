# SPDX-License-Identifier: Apache-2.0
"""The door of an experiment that draws trials of its own: the paper's, from a package beside this one."""

from collections.abc import Mapping
from pathlib import Path
from typing import Protocol

from sasgeo_bench.boards.board_files import AdditionalFiles
from sasgeo_bench.boards.pipeline_spec import PaperSpec, PipelineFile
from sasgeo_bench.boards.scored import Scored
from sasgeo_bench.core.errors import ConfigError
from sasgeo_bench.core.plugins import EXPERIMENTS, find_plugin, list_entry_points
from sasgeo_bench.tasks.private_seed import PrivateSeed

_PAPER = "paper"  # entry point, and table of a pipeline file


class Experiment(Protocol):
    """A module that an entry point names; suite and region name a task."""

    def drawn(
        self, spec: PaperSpec, *, out: Path, private: PrivateSeed | None
    ) -> Mapping[tuple[str, str], Path | None]:
        """Return the folder of each task, None where it has to be drawn; nothing is drawn to find out."""

    def draw(self, spec: PaperSpec, *, out: Path, private: PrivateSeed | None) -> list[Path]:
        """Draw what is not up to date, and return the folders of all tasks."""

    def extra(self, board: Scored, *, root: Path) -> AdditionalFiles:
        """Return more tables, texts and figures of a board; `root` holds tasks/, truth/ and regions/."""


def find_experiment(spec: PipelineFile) -> Experiment | None:
    """Return what draws the trials of a file, None for one without; `ConfigError` if that is not installed."""
    if spec.paper is None:
        return None
    if _PAPER not in list_entry_points(EXPERIMENTS):
        raise ConfigError(
            f"pipeline {spec.id!r} draws the paper's experiment, and its package, sasgeo-paper, is not installed: "
            "install the folder paper/ of the repository, as make install does"
        )
    found: Experiment = find_plugin(_PAPER, EXPERIMENTS)
    return found
