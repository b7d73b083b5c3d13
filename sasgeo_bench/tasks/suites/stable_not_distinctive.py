# SPDX-License-Identifier: Apache-2.0
"""Suite `stable-not-distinctive`: a straight road among changing fields, stable but uniform for kilometres."""

from collections.abc import Sequence
from typing import Final

import numpy as np
import shapely
from numpy.typing import NDArray

from sasgeo_bench.geometry.pose import bearing_deg, wrap_deg
from sasgeo_bench.osm.taxonomy import load_taxonomy
from sasgeo_bench.regions.evidence import Evidence
from sasgeo_bench.regions.network import LAYERS
from sasgeo_bench.tasks.perturbations.base import share_changed
from sasgeo_bench.tasks.suites.base import Draft, Edit, Scene, Seeds, Shot, Site, Suite, SuiteCard, Variant
from sasgeo_bench.tasks.suites.mining import min_distance_m
from sasgeo_bench.tasks.suites.sites import ANCHOR_SPREAD

STABLE: Final = tuple(name for name in LAYERS if name in load_taxonomy().having("through"))
VOLATILE: Final = {item.name: item.volatile for item in load_taxonomy().classes if item.volatile}  # and when it changes
MOST_ALIASES: Final = 8

_STEP_M: Final = 40.0
_REACH_M: Final = 90.0  # along the line in both directions: most of a view of 192 m
_SAME_DEG: Final = 12.0
_MOST_BUILT: Final = 0.03


class StableNotDistinctive(Suite):
    """Sites along straight lines of a stable class; the candidates are other places on parallel lines."""

    def lack(self, scene: Scene) -> str | None:
        """Refuse a region without straight stretches in open land."""
        return None if len(straight_places(scene)) else "no straight major road, railway or waterway in open land"

    def anchors(self, scene: Scene) -> NDArray[np.float64] | None:
        """Return places on the lines."""
        return straight_places(scene)[:, :2]

    def edit(self, scene: Scene, sites: Sequence[Site], seeds: Seeds) -> Edit | None:
        """Find existing twins, with the same distances from a line and from each other as sites; change no map."""
        places = straight_places(scene)
        spacing_m = min_distance_m(self.main_side_m / 2)
        spread_m = ANCHOR_SPREAD * self.main_side_m
        twins = {}
        for site in sites:
            rng = seeds.rng("alias", site.index)
            here = np.array(site.en_m)
            own = places[int(np.argmin(np.hypot(*(places[:, :2] - here).T))), 2]
            turned = np.abs(wrap_deg(2 * (places[:, 2] - own)) / 2)  # a line has no direction: modulo 180
            like = rng.permutation(places[turned <= _SAME_DEG, :2])
            like = like + rng.uniform(-spread_m, spread_m, like.shape)
            is_whole = [scene.map.is_mapped(place, self.clear_m(scene)) for place in like]
            # First few places that keep their distance from here and from each other
            taken = [here]
            for point in like[is_whole]:
                if len(taken) <= MOST_ALIASES and np.hypot(*(np.array(taken) - point).T).min() >= spacing_m:
                    taken.append(point)
            twins[site.index] = tuple((float(x), float(y)) for x, y in taken[1:])
        return Edit(
            map_pastes=(), world_pastes=None, sites=tuple(site for site in sites if twins[site.index]), twins=twins
        )

    def draw(self, shot: Shot) -> Draft:
        """Mirror the layers of some volatile classes within the view: all of them at strength 1."""
        seen = shot.perceived()
        # 6 steps of the change: so many however many classes there are
        after = mirrored(seen, round(shot.variant.strength * 6))
        return Draft(evidence=after, measured={"cells_changed": share_changed(seen, after)})


def mirrored(evidence: Evidence, count: int) -> Evidence:
    """Mirror the first `count` volatile classes from left to right, which keeps their area."""
    cells = evidence.cells.copy()
    for index, name in enumerate(evidence.classes):
        if 0 < VOLATILE.get(name, 0) <= count:
            cells[index] = cells[index][:, ::-1]
    return evidence.replace(cells)


def straight_places(scene: Scene) -> NDArray[np.float64]:
    """Return easting, northing and bearing of points on straight stable lines in open land, shape (N, 3)."""
    features = scene.map.features
    chosen = features["class"].isin(STABLE).to_numpy() & features["is_visible"].to_numpy()
    lines = shapely.line_merge(shapely.union_all(features.geometry.to_numpy()[chosen])) if chosen.any() else None
    if lines is None:
        return np.zeros((0, 3))
    found = [_along(line) for line in shapely.get_parts(lines) if line.length > 2 * _REACH_M]
    places = np.concatenate(found) if found else np.zeros((0, 3))
    return np.asarray(places[_is_open(scene, places[:, :2])])


def _along(line: shapely.Geometry) -> NDArray[np.float64]:
    at = np.arange(_REACH_M, line.length - _REACH_M, _STEP_M)
    before, here, after = (
        shapely.get_coordinates(shapely.line_interpolate_point(line, at + shift)).reshape(-1, 2)
        for shift in (-_REACH_M, 0.0, _REACH_M)
    )
    chord = after - before
    is_straight = np.hypot(*chord.T) >= 0.995 * 2 * _REACH_M  # 0.995: least ratio of chord and line
    bearings = bearing_deg(chord[:, 0], chord[:, 1])
    return np.asarray(np.column_stack((here, bearings))[is_straight])


def _is_open(scene: Scene, places: NDArray[np.float64]) -> NDArray[np.bool_]:
    built, grid = scene.map.has("building"), scene.map.grid
    half = round(_REACH_M / grid.cell_size_m)
    found = []
    for row, col in grid.to_cells(places).tolist():
        window = built[max(0, row - half) : row + half, max(0, col - half) : col + half]
        found.append(window.size > 0 and float(window.mean()) <= _MOST_BUILT)
    return np.array(found, dtype=bool)


SUITE: Final = StableNotDistinctive(
    card=SuiteCard(
        name="stable-not-distinctive",
        version=1,
        title="Stable, not distinctive (S5)",
        what="A straight road, railway or canal in open land whose fields have changed; others are candidates.",
        separates="Stability times distinctiveness from stability alone, which trusts what is the same everywhere.",
        falsifier="The same places with the fields as mapped.",
        strength_unit="share of the volatile classes that have changed",
        tracks=("retrieval", "localization"),
        min_density=0.005,
    ),
    variants=(
        Variant(role="control", kind="unchanged"),
        Variant(role="stress", kind="S5", strength=0.4),
        Variant(role="stress", kind="S5", strength=1.0),
        Variant(role="falsifier", kind="unchanged again"),
    ),
)
