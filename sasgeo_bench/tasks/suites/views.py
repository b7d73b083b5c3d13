# SPDX-License-Identifier: Apache-2.0
"""Suites of single views: absent, clean, false-unknown, local-warp, no-priors, occlusion, season and telemetry."""

from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import TYPE_CHECKING, Final, get_args

import numpy as np
import shapely
from numpy.typing import NDArray

from sasgeo_bench.core.errors import ConfigError
from sasgeo_bench.osm.taxonomy import Season as Kind
from sasgeo_bench.osm.taxonomy import load_taxonomy
from sasgeo_bench.regions.evidence import UNKNOWN, Evidence
from sasgeo_bench.tasks.perturbations.base import Occlusion, share_changed, share_hidden
from sasgeo_bench.tasks.perturbations.local_warp import LocalWarp, RowJitter, Tilt, Warp, folded_share, moved, warped
from sasgeo_bench.tasks.perturbations.occlusion import (
    AdversarialMask,
    Border,
    CanopyAndShadow,
    FalseUnknown,
    Glare,
    Rectangles,
    TiltWedge,
)
from sasgeo_bench.tasks.perturbations.season import CHANGED, Season
from sasgeo_bench.tasks.perturbations.telemetry import Sent, junctions, outlines, regions_of_interest, run_length, whole
from sasgeo_bench.tasks.query import PriorGroup
from sasgeo_bench.tasks.state import State
from sasgeo_bench.tasks.suites.base import (
    MAIN_VIEW_CELLS,
    PlainSuite,
    QueryDraft,
    Scene,
    Site,
    Suite,
    SuiteCard,
    Variant,
    ViewRequest,
    controls,
    ladder,
)
from sasgeo_bench.tasks.suites.vectors import round_vectors, site_vectors

if TYPE_CHECKING:
    import geopandas as gpd

PATCH_CELLS: Final = 24
_TURNS: Final = 4
_TRIES: Final = 256


class AbsentSuite(Suite):
    """Outside the searched map, feature-poor, another town, or a corrupted view; the control is as everywhere."""

    def lack(self, scene: Scene) -> str | None:
        """Refuse a scene without another region for wrong views."""
        if scene.elsewhere is None:
            return "no other region: name a second one, views of a wrong place are taken there"
        return None

    def draw(self, shot: ViewRequest) -> QueryDraft:
        """Draw one kind of absence."""
        kind, elsewhere = shot.variant.kind, shot.scene.elsewhere
        if kind == "outside":
            # The searched disc is so far away that it excludes the footprint of the view.
            return QueryDraft(evidence=shot.perceived(), is_present=False, away_m=2 * shot.variant.side_m)
        if kind == "feature-poor":
            return _feature_poor(shot)
        if kind == "wrong place" and elsewhere is not None:
            other = replace(shot, site=_same_place_elsewhere(shot, elsewhere))
            return QueryDraft(
                evidence=other.perceived(other.clean(elsewhere)),
                is_present=False,
                has_pose=False,
                density=other.site.density,
                measured={"density": other.site.density},
            )
        seen = shot.perceived()
        if kind == "corrupted view":
            broken = shuffle_patches(seen, shot.seeds.rng("patches"))
            return QueryDraft(
                evidence=broken, is_present=False, measured={"cells_changed": share_changed(seen, broken)}
            )
        return QueryDraft(evidence=seen)


def _feature_poor(shot: ViewRequest) -> QueryDraft:
    """Draw a place of the same block with hardly any feature, or the site's own view without its features."""
    # The place is on the map, so an answer may be right; but hardly anything distinguishes it.
    poor = _poor_place(shot)
    if poor is None:
        return QueryDraft(evidence=strip(shot.perceived()), density=0.0, measured={"is_real_place": 0.0})
    seen = replace(shot, site=poor).perceived()
    return QueryDraft(evidence=seen, pose=poor.pose, density=poor.density, measured={"is_real_place": 1.0})


def _poor_place(shot: ViewRequest) -> Site | None:
    """Return a place in the site's block whose square is mapped and holds hardly any feature."""
    state, rng = shot.scene.map, shot.seeds.rng("feature-poor")
    west, south, east, north = next(item for item in shot.scene.blocks if item.id == shot.site.block).bounds_m
    for _ in range(_TRIES):
        point = rng.uniform((west, south), (east, north))
        if state.is_mapped(point, shot.scene.view_reach_m):
            density = _density(state, point, shot.variant)
            if density <= 0.003:  # of the cells of a feature-poor view
                return _moved(shot.site, point, density)
    return None


def _moved(site: Site, point: NDArray[np.float64], density: float) -> Site:
    pose = replace(site.pose, easting_m=float(point[0]), northing_m=float(point[1]))
    return replace(site, pose=pose, density=density)


def _density(state: State, point: NDArray[np.float64], variant: Variant) -> float:
    half = round(variant.side_m / 2 / state.grid.cell_size_m)
    row, col = state.grid.to_cells(point[None, :])[0].tolist()
    return float(state.drawn[row - half : row + half, col - half : col + half].mean())


def strip(evidence: Evidence) -> Evidence:
    """Keep only ground cover, as over open land, forest or water."""
    cells = evidence.cells.copy()
    for index, name in enumerate(evidence.classes):
        if name not in load_taxonomy().covering("land", "water"):
            cells[index][cells[index] == 1] = 0
    return evidence.replace(cells)


def shuffle_patches(evidence: Evidence, rng: np.random.Generator) -> Evidence:
    """Shuffle and rotate square patches of the view: local statistics stay, the place is gone."""
    cells = evidence.cells.copy()
    starts = (range(0, size - PATCH_CELLS + 1, PATCH_CELLS) for size in evidence.shape)
    rows, cols = ([slice(at, at + PATCH_CELLS) for at in listed] for listed in starts)
    patches = [(row, col) for row in rows for col in cols]
    order, turns = rng.permutation(len(patches)), rng.integers(0, _TURNS, len(patches))
    for target, source, turn in zip(patches, order.tolist(), turns.tolist(), strict=True):
        cells[(slice(None), *target)] = np.rot90(evidence.cells[(slice(None), *patches[source])], turn, axes=(1, 2))
    return evidence.replace(cells)


def _same_place_elsewhere(shot: ViewRequest, other: State) -> Site:
    """Return the place of the other region whose density is nearest to the site's, so that it gives nothing away."""
    rng = shot.seeds.rng("elsewhere")
    west, south, east, north = other.grid.bounds_m
    points = [
        point
        for point in rng.uniform((west, south), (east, north), (_TRIES, 2))
        if other.is_mapped(point, shot.scene.view_reach_m)
    ]
    if not points:
        raise ConfigError(f"{other.region} is too small to take a view of a wrong place from: choose another split")
    densities = [_density(other, point, shot.variant) for point in points]
    best = int(np.argmin(np.abs(np.array(densities) - shot.site.density)))
    return _moved(shot.site, points[best], densities[best])


ABSENT: Final = AbsentSuite(
    card=SuiteCard(
        name="absent",
        version=1,
        title="Absent places",
        what="The true place is not in the searched map, it has next to nothing to tell it by, the view is of another "
        "town, or it is corrupted.",
        separates="Rejection: a matcher that answers here makes a false fix.",
        falsifier="The control of each site is present and must not be withheld more often than elsewhere.",
        strength_unit="1 where it cannot be found",
        needs=("another region",),
    ),
    variants=(
        *controls(views=(MAIN_VIEW_CELLS,)),
        *(
            Variant(role="stress", kind=kind, strength=1.0)
            for kind in ("outside", "feature-poor", "wrong place", "corrupted view")
        ),
    ),
)


class CleanSuite(Suite):
    """Perception from half to four times its error in domain; controls and falsifiers have no error."""

    def draw(self, shot: ViewRequest) -> QueryDraft:
        """Perceive the world with the error factor of the variant."""
        perfect = shot.clean()
        seen = shot.perceived(perfect, error_factor=shot.variant.strength)
        return QueryDraft(evidence=seen, measured={"cells_changed": share_changed(perfect, seen)})


CLEAN: Final = CleanSuite(
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


FALSE_UNKNOWN: Final = PlainSuite(
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


RMS_M: Final = (5.0, 10.0, 15.0)
WAVES, ROWS, TILT = "G1", "G1 rows", "G1 tilt"  # the first kept its name, and with it its queries
_WARPS: Final[Mapping[str, Callable[[float], Warp]]] = {
    WAVES: lambda rms_m: LocalWarp(rms_m=rms_m),
    ROWS: lambda rms_m: RowJitter(rms_m=rms_m),
    TILT: lambda rms_m: Tilt(rms_m=rms_m),
}


class LocalWarpSuite(Suite):
    """One displacement field of each kind for a site, of growing strength; vectors move with the cells."""

    def draw(self, shot: ViewRequest) -> QueryDraft:
        """Perceive, then bend."""
        seen, vectors, kind = shot.perceived(), site_vectors(shot), shot.variant.kind
        if shot.variant.strength == 0:
            return QueryDraft(evidence=seen, vectors=vectors)
        rng = shot.rng("warp") if kind == WAVES else shot.rng("warp", kind)
        field_m = _WARPS[kind](shot.variant.strength).field(seen.shape, seen.cell_size_m, rng)
        after = warped(seen, field_m)
        return QueryDraft(
            evidence=after,
            vectors=bent(vectors, field_m, seen.cell_size_m),
            measured={
                "rms_m": float(np.sqrt((field_m**2).sum(axis=0).mean())),
                "folded": folded_share(field_m, seen.cell_size_m),
                "cells_changed": share_changed(seen, after),
            },
        )


_STRAIGHT_M: Final = 0.3  # tolerance of simplification after bending: finer than the noise of the vectors


_STEP_M: Final = 8.0  # between vertices before a line is bent: an eighth of the shortest wave


def bent(vectors: "gpd.GeoDataFrame", field_m: NDArray[np.float64], cell_size_m: float) -> "gpd.GeoDataFrame":
    """Move the vectors of a view as a warp moves its cells."""
    dense = shapely.segmentize(vectors.geometry.to_numpy(), _STEP_M)
    shapes = shapely.transform(dense, lambda at: moved(at, field_m, cell_size_m))
    return round_vectors(vectors, shapely.simplify(shapes, _STRAIGHT_M))


LOCAL_WARP: Final = LocalWarpSuite(
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


SCALE_SIGMA: Final = 0.15
# The views, and so their scales, are the same as without priors: a sigma of 0.03 would be false.
GIVEN: Final = PriorGroup(radius_m=500.0, yaw="known", scale_sigma=SCALE_SIGMA)
LEAST_KM2: Final = 0.5


class NoPriorsSuite(Suite):
    """The same view twice: without any prior and, as falsifier, with priors."""

    def lack(self, scene: Scene) -> str | None:
        """Refuse a map so small that searching it needs no prior."""
        area_km2 = float(scene.map.known.sum()) * scene.map.grid.cell_size_m**2 / 1e6
        return None if area_km2 >= LEAST_KM2 else f"{area_km2:.2f} km2 mapped, at least {LEAST_KM2:g} are needed"

    def draw(self, shot: ViewRequest) -> QueryDraft:
        """Perceive layers and vectors; the variant determines the priors."""
        group = None if shot.variant.role == "stress" else GIVEN
        return QueryDraft(evidence=shot.perceived(), vectors=site_vectors(shot), group=group)


NO_PRIORS: Final = NoPriorsSuite(
    card=SuiteCard(
        name="no-priors",
        version=1,
        title="No priors (G5)",
        what="Place and heading are unknown over the whole region, the scale to 15 %; perceived vectors are given.",
        separates="Invariant proposals of the graph from searches that enumerate headings and scales.",
        falsifier="With priors given the same views must show no gain of the graph's proposals.",
        strength_unit="1 where nothing is known",
        has_own_priors=True,
        group=PriorGroup(radius_m=None, yaw="unknown", scale_sigma=SCALE_SIGMA),
    ),
    variants=(
        Variant(role="control", kind="priors given"),
        Variant(role="stress", kind="G5", strength=1.0),
        Variant(role="control", kind="priors given", view_cells=384),
        Variant(role="stress", kind="G5", strength=1.0, view_cells=384),
        Variant(role="falsifier", kind="priors given again"),
    ),
)


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


OCCLUSION: Final = PlainSuite(
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


STRENGTHS: Final = (0.3, 0.6, 0.9)
NEEDS: Final[dict[Kind, tuple[str, ...]]] = {
    "leaf_on": ("green",),
    "snow": (),
    "low_water": CHANGED["low_water"],
    "harvest": ("farmland",),
}


_LEAST_SHARE: Final = 0.003  # of the mapped cells that the classes of a season cover


class SeasonSuite(Suite):
    """The query gives the season; in the falsifier it does so without any change."""

    def lack(self, scene: Scene) -> str | None:
        """Refuse a map that knows of no class that a season changes."""
        known = set(scene.map.classes)
        if not any(known.intersection(changed) for changed in CHANGED.values()):
            return "no season changes any class that its map knows of"
        return super().lack(scene)

    def usable(self, scene: Scene) -> tuple[Variant, ...]:
        """Return the seasons whose classes the map has."""
        cells = float(scene.map.known.sum())
        shares = {name: float(scene.map.has(name).sum()) / max(1.0, cells) for name in scene.map.classes}
        # 0.003 of the mapped cells that the classes of a season cover
        able = {
            kind
            for kind, names in NEEDS.items()
            if shares.keys() & CHANGED[kind]
            and (not names or sum(shares.get(name, 0.0) for name in names) > _LEAST_SHARE)
        }
        return tuple(item for item in self.variants if item.role == "control" or item.kind in able)

    def draw(self, shot: ViewRequest) -> QueryDraft:
        """Change the view by the season, then perceive it."""
        if shot.variant.role == "control":
            return QueryDraft(evidence=shot.perceived())
        kind = next(kind for kind in get_args(Kind) if kind == shot.variant.kind)
        clean = shot.clean()
        changed = Season(kind=kind, strength=shot.variant.strength)(clean, shot.rng("season", kind))
        measured = {"cells_changed": share_changed(clean, changed)}
        return QueryDraft(evidence=shot.perceived(changed), season=kind, measured=measured)


SEASON: Final = SeasonSuite(
    card=SuiteCard(
        name="season",
        version=1,
        title="Season (S4)",
        what="Leaves over roads and paths, snow over ground and roads, low water, harvest; the query says which.",
        separates="Weights by season from weights for all the year.",
        falsifier="The query says the season, and nothing has changed.",
        strength_unit="how far the season has come",
    ),
    variants=(
        *controls(),
        *(variant for kind in NEEDS for variant in ladder(kind, STRENGTHS, small=(0.6, 0.9))),
        *(Variant(role="falsifier", kind=kind) for kind in NEEDS),
    ),
)


OUTLINES, REGIONS, JUNCTIONS = "outlines", "regions of interest", "junctions"
RUNS: Final = "runs"


def budget_bytes(strength: float) -> int:
    """Return the longest message of a strength.

    >>> [budget_bytes(strength) for strength in (1, 2, 5)]
    [2048, 1024, 128]
    """
    return round(4096 / 2**strength)  # 4096 bytes: a budget of strength 0; each step halves it


class TelemetrySuite(Suite):
    """The same perceived view, sent in several ways."""

    def draw(self, shot: ViewRequest) -> QueryDraft:
        """Perceive, send, and show what arrives."""
        seen = shot.perceived()
        sent = _sent(shot, seen)
        return QueryDraft(
            evidence=sent.evidence,
            vectors=sent.vectors,
            measured={
                "bytes": float(sent.bytes),  # of the message
                "cells_changed": share_changed(seen, sent.evidence),
                "unknown_added": share_hidden(seen, sent.evidence),
            },
        )


def _sent(shot: ViewRequest, seen: Evidence) -> Sent:
    kind, budget = shot.variant.kind, budget_bytes(shot.variant.strength)
    if kind == OUTLINES:
        return outlines(seen, budget_bytes=budget)
    if kind == REGIONS:
        return regions_of_interest(seen, shot.scene.map.shares, budget_bytes=budget)
    if kind == JUNCTIONS:
        return junctions(seen, site_vectors(shot), budget_bytes=budget)
    return run_length(seen) if kind == RUNS else whole(seen)


TELEMETRY: Final = TelemetrySuite(
    card=SuiteCard(
        name="telemetry",
        version=1,
        title="Telemetry: a view over a narrow link",
        what="The view is sent whole or as runs (nothing is lost), as outlines that are simplified, as the squares "
        "that say most for their bytes, or as junctions alone, in a message of at most so many bytes.",
        separates="Matchers that need few bytes from those that need the whole view: success against bytes for a fix.",
        falsifier="Runs: shorter, and nothing is lost: scores as in the control.",
        strength_unit="halvings of a message of 4096 bytes",
    ),
    variants=(
        *controls(views=(192,)),
        *ladder(OUTLINES, (2.0, 3.0, 4.0, 5.0)),
        *ladder(REGIONS, (2.0, 3.0, 4.0, 5.0)),
        *ladder(JUNCTIONS, (7.0, 8.0, 9.0)),
        Variant(role="falsifier", kind=RUNS),
    ),
)
