# SPDX-License-Identifier: Apache-2.0
"""Write a new plugin package into an empty folder: complete, small, and passing the conformance kit."""

import keyword
import re
import sys
from collections.abc import Collection, Mapping
from contextlib import suppress
from pathlib import Path
from typing import Final, NamedTuple

from sasgeo_bench.core.errors import ConfigError, StoreError
from sasgeo_bench.core.plugins import (
    CARD_FILE,
    KINDS,
    MATCHERS,
    NAME,
    PERTURBATIONS,
    SEGMENTERS,
    SUITES,
    TRACKERS,
    shipped_names,
)
from sasgeo_bench.matching.submission import EXAMPLE
from sasgeo_bench.tasks.perturbations.all_perturbations import SHIPPED
from sasgeo_bench.tasks.suites.all_suites import EVERY_SUITE

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
        *("pooch", "psutil", "pyarrow", "pydantic", "pymavlink", "pyogrio", "pyproj", "pyulog", "rasterio", "rich"),
        *("rosbags", "scipy", "shapely", "tifffile", "torch", "tqdm", "typer", "click"),
        *("dask", "distributed", "fsspec", "sasgeo_baselines", "sasgeo_bench", "skimage", "sklearn", "statsmodels"),
        *(
            "hatchling",
            "huggingface_hub",
            "hypothesis",
            "jinja2",
            "mlcroissant",
            "pip",
            "pystac",
            "pytest",
            "rio_cogeo",
            "setuptools",
        ),
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

_SEGMENTER: Final = '''\
"""The segmenter {name}: here is where your method goes."""

import json
from functools import lru_cache

import numpy as np
from sasgeo_bench import ABSENT, PRESENT, AerialImage, ImageTraining, Segmentation, SegmenterCard

SOFTNESS = 40.0  # of a colour, in steps of 255


class {cls}:
    """Compares single pixels with mean colours. A place to start from, no method to win with."""

    card = SegmenterCard(
        name="{name}",
        version="0.1.0",
        title="{title}",
        source="original",
        ours="all of it",
        licence="MIT",
        limits="looks at the colour of one pixel at a time; silent before it has learned",
    )

    def learn(self, training: ImageTraining) -> str:
        """Mean colours of each class, where it is and where it is not; the text goes to every call of `segment`."""
        sums = {{name: np.zeros((2, 4)) for name in training.classes}}
        for labelled in training.images:
            for name, labels in zip(labelled.classes, labelled.labels, strict=True):
                for row, state in enumerate((ABSENT, PRESENT)):
                    pixels = labelled.image.rgb[labels == state]
                    sums[name][row] += [*pixels.sum(axis=0, dtype=np.float64), len(pixels)]
        found = {{name: rows for name, rows in sums.items() if rows[:, 3].all()}}
        return json.dumps({{name: (rows[:, :3] / rows[:, 3:]).round(2).tolist() for name, rows in found.items()}})

    def segment(self, image: AerialImage, *, learned: str | None) -> Segmentation:
        """Probability of each class at each pixel; NaN, as everywhere before it has learned, says nothing."""
        colours = colours_of(learned) if learned else {{}}
        if not colours:
            silent = np.full((1, *image.shape), np.nan)
            return Segmentation.of_probabilities(("building",), silent)
        pixels = image.rgb.astype(np.float64)
        planes = []
        for absent, present in colours.values():
            nearer = ((pixels - absent) ** 2).sum(axis=2) - ((pixels - present) ** 2).sum(axis=2)
            planes.append(1 / (1 + np.exp(-np.clip(nearer / SOFTNESS**2, -30, 30))))
        return Segmentation.of_probabilities(tuple(colours), np.stack(planes))


@lru_cache(maxsize=1)  # every image comes with the same text
def colours_of(learned: str) -> dict[str, np.ndarray]:
    return {{name: np.array(rows) for name, rows in json.loads(learned).items()}}
'''

_SUITE: Final = '''\
"""The suite {name}: here is where your stress goes."""

from dataclasses import dataclass

import numpy as np
from sasgeo_bench import VIEW_CELLS, Evidence, PlainSuite, SuiteCard, Variant, controls, hide, ladder


@dataclass(frozen=True)
class {cls}:
    """Hides whole rows of the view. At strength 0 it changes no cell, and all chance comes from `rng`."""

    share: float

    def __call__(self, evidence: Evidence, rng: np.random.Generator) -> Evidence:
        """Return the view with some rows unknown."""
        rows, cols = evidence.shape
        hidden = rng.permutation(rows) < round(self.share * rows)
        return hide(evidence, np.broadcast_to(hidden[:, None], (rows, cols)))
'''
_CHANGE: Final = '''\


def change(variant: Variant, evidence: Evidence, rng: np.random.Generator) -> Evidence:
    """Return what is left of a view under a variant; a control is not changed."""
    return {cls}(share=variant.strength)(evidence, rng)


SUITE = PlainSuite(
    card=SuiteCard(
        name="{name}",
        version=1,  # raise it whenever the same seed gives another query
        title="{title}",
        what="Rows of the view are unknown.",
        separates="Matchers that leave unknown cells out from those that take them for absent.",
        falsifier="No row is hidden: scores as in the control.",
        strength_unit="share of the view that is hidden",
    ),
    variants=(
        *controls(views=VIEW_CELLS),
        *ladder("rows", (0.2, 0.4, 0.6)),
        Variant(role="falsifier", kind="none"),
    ),
    change=change,
)
'''

_PERTURBATION: Final = '''\
"""The perturbation {name}: here is where your stress goes."""

from dataclasses import dataclass

import numpy as np
from sasgeo_bench import Evidence, check_ranges, hide


@dataclass(frozen=True)
class {cls}:
    """Hides whole rows of the view. At strength 0 it changes no cell, and all chance comes from `rng`."""

    share: float

    def __post_init__(self) -> None:
        """Refuse a share out of range."""
        check_ranges(self, share=(0.0, 1.0))

    def __call__(self, evidence: Evidence, rng: np.random.Generator) -> Evidence:
        """Return the view with some rows unknown."""
        rows, cols = evidence.shape
        hidden = rng.permutation(rows) < round(self.share * rows)
        return hide(evidence, np.broadcast_to(hidden[:, None], (rows, cols)))
'''

_STRESS: Final = '''\
"""The suite {name}: the perturbation {cls} at a ladder of strengths."""

import numpy as np
from sasgeo_bench import VIEW_CELLS, Evidence, PlainSuite, SuiteCard, Variant, controls, ladder

from {module}.perturbation import {cls}
'''

_STRESS_TEST: Final = '''\
"""The suite keeps to what every suite keeps to."""

from sasgeo_bench import check_suite


def test_it_conforms():
    faults = [check for check in check_suite("{module}.suite:SUITE") if check.outcome == "fail"]
    assert not faults, faults
'''

_SUITE_POINT: Final = """
[project.entry-points."sasgeo_bench.suites"]
{name} = "{module}.suite:SUITE"
"""

_TRACKER: Final = '''\
"""The tracker {name}: here is where your method goes."""

from dataclasses import replace

import numpy as np
from sasgeo_bench import Fix, Pose, Prior, Query, Region, advance, load_matcher, read_card, start_of, wrap_deg

FOUND = np.diag([5.0, 5.0, 3.0]) ** 2  # covariance of a pose that the search finds: m2, m2, deg2
GATE = 3.4  # largest Mahalanobis distance of a pose that is taken: 99 of 100 right ones are nearer
NEAR_M = 25.0  # an estimate is accepted while 95 % of its belief lies within
LEAST_M = 80.0  # radius that is searched at least
STREAK = 3  # poses taken in a row before the first estimate is accepted
PATIENCE = 5  # poses refused in a row before no more is believed than at the start


class {cls}:
    """Odometry corrected by a search, in a Kalman filter. A place to start from, no method to win with."""

    card = read_card(__file__)  # card.toml, beside this file

    def __init__(self) -> None:
        self.matcher = load_matcher("fft_vote")  # a search that ships; put your own here

    def prepare(self, region: Region, learned: str | None) -> None:
        """Index the map; called once for each one."""
        self.matcher.prepare(region, learned)
        self.grid = region.grid

    def start(self, prior: Prior) -> None:
        """Begin a flight with what is known of its first view; forget the one before."""
        self.pose, self.covariance = start_of(prior, self.grid)
        self.begun = self.covariance
        west_m, south_m, east_m, north_m = self.grid.bounds_m
        self.most_m = prior.radius_m or np.hypot(east_m - west_m, north_m - south_m) / 2
        self.taken = self.refused = 0

    def step(self, query: Query) -> Fix:
        """Add the odometry up, search around the estimate, and correct it by what is found."""
        self.pose, self.covariance = advance(self.pose, self.covariance, query.step)
        asked = replace(query, track="localization", prior=self.prior(query), step=None)
        found = self.matcher.match(asked, top_k=1)
        if found.poses:
            self.correct(found.poses[0])
        spread_m = np.sqrt(5.99 * np.linalg.eigvalsh(self.covariance[:2, :2])[-1])
        is_accepted = bool(self.taken >= STREAK and spread_m <= NEAR_M)
        return Fix(pose=self.pose, covariance=self.covariance, is_accepted=is_accepted)

    def prior(self, query: Query) -> Prior:
        """Three standard deviations of the belief, as the prior of a single view."""
        radius_m = 3 * np.sqrt(np.linalg.eigvalsh(self.covariance[:2, :2])[-1])
        return Prior(
            center_m=(self.pose.easting_m, self.pose.northing_m),
            radius_m=float(np.clip(radius_m, LEAST_M, max(LEAST_M, self.most_m))),
            yaw_deg=self.pose.yaw_deg,
            yaw_sigma_deg=float(np.sqrt(self.covariance[2, 2])),
            scale_sigma=query.prior.scale_sigma,
        )

    def correct(self, found: Pose) -> None:
        """Take a pose that fits the belief; after many that do not, believe no more than at the start."""
        gap = np.array(
            [
                found.easting_m - self.pose.easting_m,
                found.northing_m - self.pose.northing_m,
                float(wrap_deg(found.yaw_deg - self.pose.yaw_deg)),
            ]
        )
        joint = self.covariance + FOUND
        if gap @ np.linalg.solve(joint, gap) > GATE**2:
            self.taken, self.refused = 0, self.refused + 1
            if self.refused > PATIENCE:
                self.covariance, self.refused = self.begun, 0
            return
        gain = self.covariance @ np.linalg.inv(joint)
        east_m, north_m, turn_deg = (gain @ gap).tolist()
        self.pose = Pose(
            easting_m=self.pose.easting_m + east_m,
            northing_m=self.pose.northing_m + north_m,
            yaw_deg=self.pose.yaw_deg + turn_deg,
            scale=found.scale,
        )
        left = np.eye(3) - gain
        self.covariance = left @ self.covariance @ left.T + gain @ FOUND @ gain.T
        self.taken, self.refused = self.taken + 1, 0
'''

_TRACKER_CARD: Final = (
    EXAMPLE.replace('["retrieval", "localization"]', '["sequence"]')
    .replace(
        "looks at a coarse lattice of places, with the heading of the prior alone",
        "one hypothesis at a time: where a map repeats itself it may follow the wrong copy",
    )
    .replace('needs = ["position"]', "needs = []")
)

_TEST: Final = '''\
"""The {kind} keeps to what every {kind} keeps to."""

from sasgeo_bench import check_{kind}


def test_it_conforms():
    faults = [check for check in check_{kind}("{module}.{kind}:{attribute}") if check.outcome == "fail"]
    assert not faults, faults
'''

_README: Final = """\
# {title}

A {kind} for sasgeo-bench%(about)s.

```bash
pip install -e .
sasgeo-bench check {name}
%(commands)s```

Say in the card (`src/{module}/%(place)s`) %(words)s
"""
_WORDS: Final = """\
where the method comes from and what of it is yours; raise its version
whenever answers change."""


def _readme(place: str, *, words: str = _WORDS, commands: str = "", about: str = "") -> str:
    return _README % {"place": place, "words": words, "commands": commands, "about": about}


_PERTURBATION_README: Final = """\
# {title}

A perturbation for sasgeo-bench, and a suite that draws queries under it.

```bash
pip install -e .
sasgeo-bench check {name}
sasgeo-bench make-queries --suite {name} --regions town-riverside --n 2
sasgeo-bench inspect {name}/town-riverside --rows 6
```

The stress is in `src/{module}/perturbation.py`; say in the card of the suite (`src/{module}/suite.py`) what should
differ before you run anything.
"""


class Package(NamedTuple):
    """Templates of a new package of one kind."""

    group: str  # of its entry point
    code: str
    readme: str
    card: str | None = None  # beside the code, where it is not in it
    attribute: str = "{cls}"  # what the entry point names
    others: Mapping[str, str] = {}  # more files, or others in their place
    taken: Mapping[str, Collection[str]] = {}  # names of ours that are no entry points, by kind


_PACKAGES: Final = {
    "matcher": Package(
        MATCHERS,
        _MATCHER,
        _readme(
            CARD_FILE,
            words="""\
where the method comes from, what of it is yours, and what a query must
tell for it to work; raise its version whenever answers change. Then enter a published board:

```bash
sasgeo-bench enter docs/results/systems-objects --matcher {name}
```""",
            commands="sasgeo-bench run --matcher {name} --tasks out/tasks/clean/town-riverside\n",
        ),
        EXAMPLE,
    ),
    "tracker": Package(
        TRACKERS,
        _TRACKER,
        _readme(
            CARD_FILE,
            commands="""\
sasgeo-bench make-queries --suite flight-clean --regions town-grid --n 1 --up-to
sasgeo-bench run --matcher {name} --tasks out/tasks/flight-clean/town-grid
""",
        ),
        _TRACKER_CARD,
    ),
    "segmenter": Package(SEGMENTERS, _SEGMENTER, _readme("segmenter.py")),
    "suite": Package(
        SUITES,
        _SUITE + _CHANGE,
        _readme(
            "suite.py",
            words="""\
what should differ before you run anything. A pipeline file names the suite in
a `[[task]]` as it does those of sasgeo-bench.""",
            commands="""\
sasgeo-bench make-queries --suite {name} --regions town-riverside --n 2
sasgeo-bench inspect {name}/town-riverside --rows 6
""",
            about=": queries under a stress of your own",
        ),
        attribute="SUITE",
        taken={"suite": EVERY_SUITE},
    ),
    "perturbation": Package(
        PERTURBATIONS,
        _PERTURBATION,
        _PERTURBATION_README,
        others={
            "pyproject.toml": _PYPROJECT.replace("\n[tool.", f"{_SUITE_POINT}\n[tool."),
            "src/{module}/suite.py": _STRESS + _CHANGE,
            "tests/test_suite.py": _STRESS_TEST,
        },
        taken={"perturbation": SHIPPED, "suite": EVERY_SUITE},
    ),
}


def package_files(kind: str, name: str) -> dict[str, str]:
    """Return the text of every file of a new package with a plugin of a kind, as in "matcher", by its path.

    `name` is that of the plugin; raise `ConfigError` if it is not allowed, or taken.

    >>> sorted(package_files("tracker", "my-tracker"))[-2:]
    ['src/my_tracker/tracker.py', 'tests/test_conforms.py']
    """
    return files_of(_PACKAGES[kind], name)


def files_of(package: Package, name: str) -> dict[str, str]:
    """Return the text of every file of a package of some templates, as `package_files` does."""
    kind = KINDS[package.group]
    _check_name(kind, name, package)
    parts = re.split(r"[-_]", name)
    own = "".join(part.capitalize() for part in parts)
    # Words of the import lines of the module, which its own class must not be called
    imported = re.findall(r"\w+", " ".join(re.findall(r"^(?:from|import) .*$", package.code, re.MULTILINE)))
    words = {
        "kind": kind,
        "group": package.group,
        "name": name,
        "distribution": name.replace("_", "-"),
        "module": name.replace("-", "_"),
        "cls": f"{own}{kind.capitalize()}" if own in imported or keyword.iskeyword(own) else own,
        "title": " ".join(parts).capitalize(),
    }
    words["attribute"] = package.attribute.format(**words)
    files = {
        "pyproject.toml": _PYPROJECT,
        "README.md": package.readme,
        "src/{module}/__init__.py": '"""The package of the {kind} {name}."""\n',
        "src/{module}/{kind}.py": package.code,
        "tests/test_conforms.py": _TEST,
        **({} if package.card is None else {f"src/{{module}}/{CARD_FILE}": package.card}),
        **package.others,
    }
    return {path.format(**words): text.format(**words) for path, text in files.items()}


def _check_name(kind: str, name: str, package: Package) -> None:
    """Raise `ConfigError` if a new plugin cannot have a name."""
    module = name.replace("-", "_")
    if not NAME.fullmatch(name):
        raise ConfigError(
            f"a {kind}'s name has lower-case letters, digits, hyphens and underscores, a letter first, as in "
            f"my-{kind}; got {name!r}"
        )
    if keyword.iskeyword(module) or module in _TAKEN or len(name) > _LONGEST:
        raise ConfigError(f"{name!r} cannot be a package: it is taken, a keyword, or too long; choose another name")
    ours = ((kind, shipped_names(package.group)), *package.taken.items())
    whose = next((one for one, names in ours if name in names), None)
    if whose is not None:
        raise ConfigError(
            f"{name!r} is a {whose} of sasgeo-bench itself, which would be used instead of yours; choose another"
        )
    if package.group == TRACKERS and name in shipped_names(MATCHERS):
        raise ConfigError(f"{name!r} is a matcher of sasgeo-bench itself, which run would take instead; choose another")


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
