# SPDX-License-Identifier: Apache-2.0
"""Write a new plugin package into an empty folder: complete, small, and passing the conformance kit."""

import keyword
import re
import sys
from collections.abc import Collection, Mapping
from contextlib import suppress
from pathlib import Path
from typing import Final

from sasgeo_bench.errors import ConfigError, StoreError
from sasgeo_bench.files.plugins import CARD_FILE, KINDS, MATCHERS, shipped_names
from sasgeo_bench.matching.submission import EXAMPLE

_NAME: Final = re.compile(r"[a-z][a-z0-9]*(?:[-_][a-z0-9]+)*")
_LONGEST: Final = 60
# Modules that a package of this name would hide: of Python, of this package and its imports, and of common tools.
_TAKEN: Final = frozenset(
    {
        *sys.stdlib_module_names,
        *(
            "affine",
            "cv2",
            "defusedxml",
            "filelock",
            "geopandas",
            "lazy_loader",
            "matplotlib",
            "numpy",
            "osmium",
            "pandas",
        ),
        *("pooch", "psutil", "pyarrow", "pydantic", "pyproj", "rasterio", "rich"),
        *("scipy", "shapely", "tifffile", "torch", "tqdm", "typer", "click"),
        *("dask", "distributed", "fsspec", "sasgeo_baselines", "sasgeo_bench", "skimage", "sklearn", "statsmodels"),
        *("hatchling", "hypothesis", "jinja2", "mlcroissant", "pip", "pystac", "pytest", "rio_cogeo", "setuptools"),
        *("src", "test", "tests", "con", "nul", "aux", "prn"),
    }
)

_PYPROJECT: Final = """\
[build-system]
requires = ["hatchling>=1.27"]
build-backend = "hatchling.build"

[project]
name = "{distribution}"
version = "0.1.0"
description = "A {kind} for sasgeo-bench"
requires-python = ">=3.11"
dependencies = ["numpy>=2", "sasgeo-bench>=0.1"]

[project.entry-points."{group}"]
{name} = "{module}.{kind}:{attribute}"

[tool.hatch.build.targets.wheel]
packages = ["src/{module}"]
"""

_MATCHER: Final = '''\
"""The matcher {name}: here is where your method goes."""

import numpy as np
from sasgeo_bench import PRESENT, UNKNOWN, WITHHELD, LayerBits, Match, Pose, Query, Region, observe, read_card

STEPS = 9  # places a side of the lattice that is searched when no candidates are given


class {cls}:
    """Ranks places by how many seen cells the map has there too. A place to start from, no method to win with."""

    card = read_card(__file__)  # card.toml, beside this file

    def prepare(self, region: Region, learned: str | None) -> None:
        """Keep the map; called once for each one. `learned` is the text that its own `learn` returned."""
        self.region = region
        self.layers = LayerBits.of(region.layers)

    def match(self, query: Query, *, top_k: int) -> Match:
        """Score the candidates, or the places of a lattice over the prior's disc; best first."""
        if (query.evidence.cells == UNKNOWN).all():
            return WITHHELD
        places = query.candidates or self.lattice(query)
        scored = sorted(((self.score(query, pose), -at, pose) for at, pose in enumerate(places)), reverse=True)[:top_k]
        return Match(poses=[pose for _, _, pose in scored], scores=[score for score, _, _ in scored])

    def lattice(self, query: Query) -> list[Pose]:
        """Places spread over the prior's disc."""
        x, y = query.prior.center_m
        yaw_deg = query.prior.yaw_deg or 0.0
        steps = np.linspace(-1, 1, STEPS) * query.prior.radius_m
        return [
            Pose(easting_m=x + right, northing_m=y + up, yaw_deg=yaw_deg)
            for right in steps
            for up in steps
            if np.hypot(right, up) <= query.prior.radius_m
        ]

    def score(self, query: Query, pose: Pose) -> float:
        """Share of what is seen, class by class, that the map shows at a pose; unknown cells are left out."""
        seen = query.evidence
        there = observe(
            self.layers, self.region.grid, pose, size_cells=seen.shape[0], cell_size_m=seen.cell_size_m
        )
        order = [self.region.classes.index(name) for name in seen.classes]
        both_known = (seen.cells != UNKNOWN) & (there[order] != UNKNOWN)
        agree = both_known & (seen.cells == PRESENT) & (there[order] == PRESENT)
        either = both_known & ((seen.cells == PRESENT) | (there[order] == PRESENT))
        return float(agree.sum() / max(1, either.sum()))
'''

_TEST: Final = '''\
"""The {kind} keeps to what every {kind} keeps to."""

from sasgeo_bench import check_{kind}


def test_it_conforms():
    faults = [check for check in check_{kind}("{module}.{kind}:{attribute}") if check.outcome == "fail"]
    assert not faults, faults
'''

_README: Final = """\
# {title}

A matcher for sasgeo-bench.

```bash
pip install -e .
sasgeo-bench check {name}
sasgeo-bench run --matcher {name} --tasks out/tasks/clean/town-riverside
```

Say in the card (`src/{module}/card.toml`) where the method comes from, what of it is yours, and what a query must
tell for it to work; raise its version whenever answers change. Then enter a published board:

```bash
sasgeo-bench enter docs/results/systems-objects --matcher {name}
```
"""


def plugin_files(name: str) -> dict[str, str]:
    """Return the text of every file of a new package with a matcher, by its path.

    `name` is that of the matcher; raise `ConfigError` if it is not allowed, or taken.
    """
    return package_files(name, group=MATCHERS, code=_MATCHER, readme=_README, card=EXAMPLE)


def package_files(
    name: str, *, group: str, code: str, readme: str, card: str | None = None, attribute: str | None = None
) -> dict[str, str]:
    """Return the text of every file of a new package with a plugin, by its path.

    `group` is that of its entry point; `code`, `readme` and `card`, where it has one, are templates. `attribute` is
    what the entry point names, if that is not the class. Raise `ConfigError` if the name is not allowed, or taken.
    """
    # Words of the import lines of a module, which its own class must not be called
    imported_names = frozenset(re.findall(r"\w+", " ".join(re.findall(r"^(?:from|import) .*$", code, re.MULTILINE))))
    words = _words_of(name, group=group, imported=imported_names)
    words["attribute"] = attribute or words["cls"]
    files = {
        "pyproject.toml": _PYPROJECT,
        "README.md": readme,
        "src/{module}/__init__.py": '"""The package of the {kind} {name}."""\n',
        "src/{module}/{kind}.py": code,
        "tests/test_conforms.py": _TEST,
    } | ({} if card is None else {f"src/{{module}}/{CARD_FILE}": card})
    return {path.format(**words): text.format(**words) for path, text in files.items()}


def _words_of(name: str, *, group: str, imported: Collection[str]) -> dict[str, str]:
    """Return the words of a new package: its kind, group, name, distribution, module, class and title."""
    # The class is called as none of the `imported` names is. Raise `ConfigError` if the name is not allowed, or taken.
    kind = KINDS[group]
    module = name.replace("-", "_")
    if _NAME.fullmatch(name) and (keyword.iskeyword(module) or module in _TAKEN or len(name) > _LONGEST):
        raise ConfigError(f"{name!r} cannot be a package: it is taken, a keyword, or too long; choose another name")
    if not _NAME.fullmatch(name):
        raise ConfigError(
            f"a {kind}'s name has lower-case letters, digits, hyphens and underscores, a letter first, as in "
            f"my-{kind}; got {name!r}"
        )
    if name in shipped_names(group):
        raise ConfigError(
            f"{name!r} is a {kind} of sasgeo-bench itself, which would be used instead of yours; choose another"
        )
    words = re.split(r"[-_]", name)
    own = "".join(word.capitalize() for word in words)
    return {
        "kind": kind,
        "group": group,
        "name": name,
        "distribution": name.replace("_", "-"),
        "module": module,
        "cls": f"{own}{kind.capitalize()}" if own in imported or keyword.iskeyword(own) else own,
        "title": " ".join(words).capitalize(),
    }


def write_plugin(folder: Path, files: Mapping[str, str]) -> None:
    """Write all files of a package, or none; raise `StoreError` if the folder is not empty or cannot be written."""
    if not _is_free(folder):
        raise StoreError(f"{folder} is there already and not empty: name another folder")
    made: list[Path] = []
    try:
        for name, text in files.items():
            target = folder / name
            missing = [parent for parent in target.parents if not parent.exists()]
            for parent in reversed(missing):
                parent.mkdir()
                made.append(parent)
            made.append(target)
            target.write_text(text, encoding="utf-8")
    except OSError as error:
        for path in reversed(made):
            with suppress(OSError):
                path.rmdir() if path.is_dir() else path.unlink(missing_ok=True)
        raise StoreError(
            f"{folder} cannot be written ({error.strerror or error}): check your rights and the free space"
        ) from error


def _is_free(folder: Path) -> bool:
    try:
        return not folder.exists() or (folder.is_dir() and not any(folder.iterdir()))
    except OSError as error:
        raise StoreError(
            f"{folder} cannot be read ({error.strerror or error}): check your rights, or name another folder"
        ) from error
