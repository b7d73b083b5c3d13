# SPDX-License-Identifier: Apache-2.0
"""Suite `local-warp`: the view is bent smoothly, so that cells miss the map while roads keep their order."""

from typing import TYPE_CHECKING, Final

import numpy as np
import shapely
from numpy.typing import NDArray

from sasgeo_bench.tasks.perturbations.base import share_changed
from sasgeo_bench.tasks.perturbations.local_warp import LocalWarp, folded_share, moved, warped
from sasgeo_bench.tasks.suites.base import Draft, Shot, Suite, SuiteCard, Variant, controls, ladder
from sasgeo_bench.tasks.suites.vectors import round_vectors, site_vectors

if TYPE_CHECKING:
    import geopandas as gpd

RMS_M: Final = (5.0, 10.0, 15.0)
_STEP_M: Final = 8.0  # between vertices before a line is bent: an eighth of the shortest wave
_STRAIGHT_M: Final = 0.3  # tolerance of simplification after bending: finer than the noise of the vectors


class LocalWarpSuite(Suite):
    """One displacement field for a site, of growing strength; vectors move with the cells, as one camera sees both."""

    def draw(self, shot: Shot) -> Draft:
        """Perceive, then bend."""
        seen, vectors = shot.perceived(), site_vectors(shot)
        if shot.variant.strength == 0:
            return Draft(evidence=seen, vectors=vectors)
        field_m = LocalWarp(rms_m=shot.variant.strength).field(seen.shape, seen.cell_size_m, shot.rng("warp"))
        after = warped(seen, field_m)
        return Draft(
            evidence=after,
            vectors=bent(vectors, field_m, seen.cell_size_m),
            measured={
                "rms_m": float(np.sqrt((field_m**2).sum(axis=0).mean())),
                "folded": folded_share(field_m, seen.cell_size_m),
                "cells_changed": share_changed(seen, after),
            },
        )


def bent(vectors: "gpd.GeoDataFrame", field_m: NDArray[np.float64], cell_size_m: float) -> "gpd.GeoDataFrame":
    """Move the vectors of a view as a warp moves its cells."""
    dense = shapely.segmentize(vectors.geometry.to_numpy(), _STEP_M)
    shapes = shapely.transform(dense, lambda at: moved(at, field_m, cell_size_m))
    return round_vectors(vectors, shapely.simplify(shapes, _STRAIGHT_M))


SUITE: Final = LocalWarpSuite(
    card=SuiteCard(
        name="local-warp",
        version=1,
        title="Local warp (G1)",
        what="A smooth field of shifts of 5, 10 or 15 m rms and waves of 70 to 110 m bends the view and its vectors.",
        separates="The graph, whose order of roads survives, from rasters, whose cells no longer overlap.",
        falsifier="A field of 0 m: scores as in the control.",
        strength_unit="m rms of the shift",
    ),
    variants=(*controls(), *ladder("G1", RMS_M, small=RMS_M, large=(15.0,)), Variant(role="falsifier", kind="no warp")),
)
