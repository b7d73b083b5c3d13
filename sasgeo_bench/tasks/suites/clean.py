# SPDX-License-Identifier: Apache-2.0
"""Suite `clean`: rotation, scale and crop under perception of several qualities, nothing else."""

from typing import Final

from sasgeo_bench.tasks.suites.base import (
    VIEW_CELLS,
    Draft,
    PlainSuite,
    Scene,
    Seeds,
    Site,
    SuiteCard,
    Variant,
    controls,
    ladder,
    perceived,
)

ERROR_FACTORS: Final = (0.5, 1.0, 2.0, 3.0, 4.0)
SMALL_FACTORS: Final = (1.0, 2.0, 3.0)


class CleanSuite(PlainSuite):
    """Perception from twice as good as in its own domain to four times as bad; the control is free of noise."""

    def draw(self, scene: Scene, site: Site, variant: Variant, seeds: Seeds) -> Draft:
        """See the world with as much error as the variant says; controls and falsifiers without any."""
        perfect = scene.world.view(site.pose, size_cells=variant.view_cells, cell_size_m=variant.cell_size_m)
        seen = perceived(scene.world, site, variant, seeds, error_factor=variant.strength, clean=perfect)
        changed = float((seen.cells != perfect.cells).mean())
        return Draft(evidence=seen, measured={"cells_changed": changed})


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
        *controls(views=VIEW_CELLS),
        Variant(role="falsifier", kind="no error"),
        *ladder("perception", ERROR_FACTORS, small=SMALL_FACTORS, large=(1.0, 3.0)),
    ),
    change=lambda variant, evidence, rng: evidence,  # noqa: ARG005 - `draw` does it all
)
