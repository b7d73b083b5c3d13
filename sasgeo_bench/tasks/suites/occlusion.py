# SPDX-License-Identifier: Apache-2.0
"""Suite `occlusion`: parts of the view are unknown: rectangles, geometry, cover, or an adversary's mask."""

from typing import Final

import numpy as np

from sasgeo_bench.regions.evidence import UNKNOWN, Evidence
from sasgeo_bench.tasks.perturbations.base import Occlusion
from sasgeo_bench.tasks.perturbations.occlusion import (
    AdversarialMask,
    Border,
    CanopyAndShadow,
    Glare,
    Rectangles,
    TiltWedge,
)
from sasgeo_bench.tasks.suites.base import PlainSuite, SuiteCard, Variant, controls, ladder

SHARES: Final = (0.15, 0.3, 0.45, 0.6)
SMALL_SHARES: Final = (0.3, 0.6)
ALL_UNKNOWN: Final = "all unknown"
HIDERS: Final[dict[str, type[Occlusion]]] = {
    "none": Rectangles,
    "U1 rectangles": Rectangles,
    "U2 border": Border,
    "U2 wedge": TiltWedge,
    "U2 glare": Glare,
    "U3 canopy and shadow": CanopyAndShadow,
    "U4 adversarial": AdversarialMask,
}


def _hide(variant: Variant, evidence: Evidence, rng: np.random.Generator) -> Evidence:
    if variant.kind == ALL_UNKNOWN:
        return evidence.replace(np.full_like(evidence.cells, UNKNOWN))
    return HIDERS[variant.kind](share=variant.strength)(evidence, rng)


SUITE: Final = PlainSuite(
    card=SuiteCard(
        name="occlusion",
        version=1,
        title="Occlusion (U1-U4)",
        what="Rectangles (U1), border, tilt wedge and glare (U2), canopy and shadow over thin classes (U3), and the "
        "mask of a fixed library that hides most of what is there (U4), over 15 to 60 % of the view.",
        separates="Matchers that leave unknown cells out from those that take them for absent.",
        falsifier="Nothing hidden: scores as in the control. Everything hidden: must be withheld.",
        strength_unit="share of the view that is hidden; in U3 of where trees and shadows hide thin classes",
        tracks=("localization", "retrieval"),
    ),
    variants=(
        *controls(),
        *ladder("U1 rectangles", SHARES, small=SMALL_SHARES, large=(0.6,)),
        *ladder("U2 border", (0.3, 0.6), small=SMALL_SHARES),
        *ladder("U2 wedge", (0.3, 0.6), small=SMALL_SHARES),
        *ladder("U2 glare", (0.3, 0.6), small=SMALL_SHARES),
        *ladder("U3 canopy and shadow", (0.5, 1.0), small=(0.5, 1.0)),
        *ladder("U4 adversarial", (0.3, 0.6), small=SMALL_SHARES),
        Variant(role="falsifier", kind="none"),
        Variant(role="falsifier", kind=ALL_UNKNOWN, strength=1.0),
    ),
    change=_hide,
)
