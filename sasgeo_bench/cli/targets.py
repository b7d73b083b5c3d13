# SPDX-License-Identifier: Apache-2.0
"""Targets of `inspect` and `verify`: find what a name or folder means, and where a picture of it goes."""

import re
import tomllib
from pathlib import Path
from typing import Final

from sasgeo_bench.core.paths import plain_file
from sasgeo_bench.tasks.split import list_split_files
from sasgeo_bench.tasks.task_files import TASK

_NOT_IN_NAMES: Final = re.compile(r"[^A-Za-z0-9.@+_-]+")


def find_task(target: str, out: Path) -> Path | None:
    """Return the folder of a task, given as it is or as SUITE/REGION; None if it is no task."""
    return next((folder for folder in (Path(target), out / "tasks" / target) if (folder / TASK).is_file()), None)


def is_split(target: str) -> bool:
    """Return True for the id of a shipped split, and for any .toml file but that of a region."""
    return (target.endswith(".toml") and not is_region_file(Path(target))) or target in list_split_files()


def is_region_file(path: Path) -> bool:
    """Return whether a file has what every region file has, and no split."""
    try:
        return path.suffix == ".toml" and "extract" in tomllib.loads(plain_file(path).read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return False


def sheet_path(out: Path, *names: str) -> Path:
    """Return where a picture is written; names of tasks and queries may come from elsewhere, and lead nowhere else.

    >>> sheet_path(Path("out"), "mine 2", "../../x").as_posix()
    'out/sheets/mine-2-..-..-x.png'
    """
    return out / "sheets" / f"{_NOT_IN_NAMES.sub('-', '-'.join(names))}.png"
