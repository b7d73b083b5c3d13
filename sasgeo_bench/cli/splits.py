# SPDX-License-Identifier: Apache-2.0
"""Propose a split: the function and its command."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import typer

from sasgeo_bench.cli.console import say
from sasgeo_bench.cli.options import Options, RegionFolders, takes
from sasgeo_bench.core.errors import ConfigError
from sasgeo_bench.core.folders import check_free, fresh_file
from sasgeo_bench.core.progress import tell
from sasgeo_bench.regions.region_spec import find_region_file, read_region_file
from sasgeo_bench.tasks.split import make_split
from sasgeo_bench.tasks.split_proposal import propose_split, split_text


@dataclass(frozen=True, kw_only=True)
class SplitOptions(Options):
    """Flags of new-split."""

    name: Annotated[str, typer.Argument(help="id of the split, such as my-split")] = field(kw_only=False)
    region: Annotated[list[str], typer.Argument(help="ids from list regions, or files of your own (*.toml)")] = field(
        kw_only=False
    )
    region_files: RegionFolders = None
    into: Annotated[Path, typer.Option(help="folder to write the split file into")] = Path("my-splits")


@takes(SplitOptions)
def new_split(options: SplitOptions) -> Path:
    """Propose a split of regions: what lies near each other, and what is of one country, stands in one part.

    Half of the ground tests, a quarter trains and a quarter calibrates, as far as places and countries allow; a single
    place is all test. A file that is there already stays as it is.

    Returns
    -------
    Path
        The split file, `into/name.toml`.

    Raises
    ------
    ConfigError
        If there is no such region, one is named twice, or the name is none.
    StoreError
        If the file cannot be written, or is there and says something else.

    Examples
    --------
    >>> import sasgeo_bench as sgb
    >>> sgb.new_split("mine", ["vadus", "monaco"])
    Traceback (most recent call last):
        ...
    sasgeo_bench.core.errors.ConfigError: there is no region 'vadus', did you mean 'vaduz'? (list regions or new-region)
    """
    specs = [read_region_file(find_region_file(name, folders=options.region_files or ())) for name in options.region]
    grids = {spec.id: spec.grid() for spec in specs}
    if len(grids) < len(specs) or not specs:
        raise ConfigError("name each region once, and one at least: list regions shows them")
    spec = propose_split(options.name, specs)
    split, text = make_split(spec, grids), split_text(spec)
    path = options.into / f"{options.name}.toml"
    if check_free(path, text):
        with fresh_file(path, mend="name another folder by --into, or check your rights") as scratch:
            scratch.write_text(text, encoding="utf-8")
    options.say(path)
    tell(split.to_text())
    return path


def new_split_command(options: SplitOptions) -> None:
    """Propose a split of regions, by places and countries: INTO/NAME.toml."""
    new_split(**vars(options) | {"say": say})
