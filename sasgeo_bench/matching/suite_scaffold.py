# SPDX-License-Identifier: Apache-2.0
"""Files of a new package with a suite: complete, small, and passing the conformance kit."""

from typing import Final

from sasgeo_bench.errors import ConfigError
from sasgeo_bench.files.plugins import SUITES
from sasgeo_bench.matching.scaffold import package_files
from sasgeo_bench.tasks.suites.all_suites import EVERY_SUITE

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

_README: Final = """\
# {title}

A suite for sasgeo-bench: queries under a stress of your own.

```bash
pip install -e .
sasgeo-bench check {name}
sasgeo-bench make-queries --suite {name} --regions town-riverside --n 2
sasgeo-bench inspect {name}/town-riverside --rows 6
```

Say in the card (`src/{module}/suite.py`) what should differ before you run anything. A pipeline file names the suite in
a `[[task]]` as it does those of sasgeo-bench.
"""


def suite_files(name: str) -> dict[str, str]:
    """Return the text of every file of a new package with a suite, by its path.

    `name` is that of the suite; raise `ConfigError` if it is not allowed, or taken.

    >>> sorted(suite_files("my-suite"))[-1]
    'tests/test_conforms.py'
    """
    if name in EVERY_SUITE:
        raise ConfigError(
            f"{name!r} is a suite of sasgeo-bench itself, which would be used instead of yours; choose another"
        )
    return package_files(name, group=SUITES, code=_SUITE, readme=_README, attribute="SUITE")
