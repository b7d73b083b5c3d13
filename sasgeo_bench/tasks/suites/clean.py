# SPDX-License-Identifier: Apache-2.0
"""Suite `clean`: rotation, scale and crop under perception of several qualities, nothing else."""

from typing import Final

from sasgeo_bench.tasks.perturbations.base import share_changed
from sasgeo_bench.tasks.suites.base import Draft, Shot, Suite, SuiteCard, Variant, controls, ladder


class CleanSuite(Suite):
    """Perception from half to four times its error in domain; controls and falsifiers have no error."""

    def draw(self, shot: Shot) -> Draft:
        """Perceive the world with the error factor of the variant."""
        perfect = shot.clean()
        seen = shot.perceived(perfect, error_factor=shot.variant.strength)
        return Draft(evidence=seen, measured={"cells_changed": share_changed(perfect, seen)})


SUITE: Final = CleanSuite(
    card=SuiteCard(
        name="clean",
        version=1,
        title="Rotation, scale and crop",
        what="Views at any heading, with the residual scale and the perception errors that the strength says.",
        separates="Nothing: the variants of one scorer must not differ by more than a point.",
        falsifier="A view without perception errors must be found nearly always.",
        strength_unit="times the error of perception in its own domain",
        tracks=("localization", "retrieval"),
    ),
    variants=(
        *controls(),
        Variant(role="falsifier", kind="no error"),
        *ladder("perception", (0.5, 1.0, 2.0, 3.0, 4.0), small=(1.0, 2.0, 3.0), large=(1.0, 3.0)),
    ),
)
