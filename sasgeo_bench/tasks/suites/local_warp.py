# SPDX-License-Identifier: Apache-2.0
"""Suite `local-warp`: the view is bent, so that cells miss the map while roads keep their order."""

from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Final

import numpy as np
import shapely
from numpy.typing import NDArray

from sasgeo_bench.tasks.perturbations.base import share_changed
from sasgeo_bench.tasks.perturbations.local_warp import LocalWarp, RowJitter, Tilt, Warp, folded_share, moved, warped
from sasgeo_bench.tasks.suites.base import Draft, Shot, Suite, SuiteCard, Variant, controls, ladder
from sasgeo_bench.tasks.suites.vectors import round_vectors, site_vectors

if TYPE_CHECKING:
    import geopandas as gpd

RMS_M: Final = (5.0, 10.0, 15.0)
WAVES, ROWS, TILT = "G1", "G1 rows", "G1 tilt"  # the first kept its name, and with it its queries
_WARPS: Final[Mapping[str, Callable[[float], Warp]]] = {
    WAVES: lambda rms_m: LocalWarp(rms_m=rms_m),
    ROWS: lambda rms_m: RowJitter(rms_m=rms_m),
    TILT: lambda rms_m: Tilt(rms_m=rms_m),
}


class LocalWarpSuite(Suite):
    """One displacement field of each kind for a site, of growing strength; vectors move with the cells."""

    def draw(self, shot: Shot) -> Draft:
        """Perceive, then bend."""
        seen, vectors, kind = shot.perceived(), site_vectors(shot), shot.variant.kind
        if shot.variant.strength == 0:
            return Draft(evidence=seen, vectors=vectors)
        rng = shot.rng("warp") if kind == WAVES else shot.rng("warp", kind)
        field_m = _WARPS[kind](shot.variant.strength).field(seen.shape, seen.cell_size_m, rng)
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
    # 8 m: step between vertices before a line is bent: an eighth of the shortest wave
    dense = shapely.segmentize(vectors.geometry.to_numpy(), 8.0)
    shapes = shapely.transform(dense, lambda at: moved(at, field_m, cell_size_m))
    # 0.3 m: tolerance of simplification after bending: finer than the noise of the vectors
    return round_vectors(vectors, shapely.simplify(shapes, 0.3))


SUITE: Final = LocalWarpSuite(
    card=SuiteCard(
        name="local-warp",
        version=2,
        title="Local warp (G1)",
        what="A field of shifts of 5, 10 or 15 m rms bends the view and its vectors: waves of 70 to 110 m (G1), rows "
        "that shake (G1 rows), or a tilt that was not removed (G1 tilt).",
        separates="The graph, whose order of roads survives, from rasters, whose cells no longer overlap.",
        falsifier="A field of 0 m: scores as in the control.",
        strength_unit="m rms of the shift",
    ),
    variants=(
        *controls(),
        *ladder(WAVES, RMS_M, small=RMS_M, large=(15.0,)),
        *(variant for kind in (ROWS, TILT) for variant in ladder(kind, RMS_M, small=(10.0,), large=(15.0,))),
        Variant(role="falsifier", kind="no warp"),
    ),
)
