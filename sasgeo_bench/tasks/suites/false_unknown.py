# SPDX-License-Identifier: Apache-2.0
"""Suite `false-unknown`: perception reports unknown where it was right."""

from typing import Final

from sasgeo_bench.tasks.perturbations.occlusion import FalseUnknown
from sasgeo_bench.tasks.suites.base import PlainSuite, SuiteCard, Variant, controls, ladder

SUITE: Final = PlainSuite(
    card=SuiteCard(
        name="false-unknown",
        version=1,
        title="False unknown (U5)",
        what="Blobs in which perception claims to know nothing although what it saw was right.",
        separates="Matchers that lean on unknown too much.",
        falsifier="A share of nothing: scores as in the control.",
        strength_unit="share of the cells",
    ),
    variants=(
        *controls(),
        *ladder("U5", (0.15, 0.3, 0.6, 0.8, 0.9), small=(0.3, 0.6, 0.8), large=(0.6, 0.9)),
        Variant(role="falsifier", kind="none"),
    ),
    change=lambda variant, evidence, rng: FalseUnknown(share=variant.strength)(evidence, rng),
)
