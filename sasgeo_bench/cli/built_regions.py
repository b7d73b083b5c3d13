# SPDX-License-Identifier: Apache-2.0
"""Built regions by their names. Commands that need no more of what lies in a folder start without boards and suites."""

import difflib
from pathlib import Path
from typing import Final

from sasgeo_bench.core.errors import ConfigError, named
from sasgeo_bench.regions.packed_map import is_packed_map, unpack_map
from sasgeo_bench.regions.region_files import MANIFEST

MOST_NAMED: Final = 8


def find_built(target: str, out: Path) -> Path | None:
    """Return the folder of a built region, given as it is, by its name or as a packed map; None if it is no region."""
    if is_packed_map(Path(target)):
        return unpack_map(target, out).folder
    return next((folder for folder in (Path(target), out / "regions" / target) if (folder / MANIFEST).is_file()), None)


def built_region(name: str, out: Path) -> Path:
    """Return the folder of a built region as `find_built` does; a refusal suggests the nearest, or lists all."""
    found = find_built(name, out)
    if found is not None:
        return found
    built = sorted(path.parent.name for path in (out / "regions").glob(f"*/{MANIFEST}"))
    near = difflib.get_close_matches(name, built, n=1)
    there = f"; built are {named(built, 'region', most=MOST_NAMED)}" if built else ""
    hint = f"did you mean {near[0]!r}?" if near else f"build-region it first{there}"
    raise ConfigError(f"{out / 'regions'} holds no region {name!r}: {hint}")
