# SPDX-License-Identifier: Apache-2.0
"""Suites of maps and views of different times: real-age, growth, synthetic-age and volatile-lure."""

from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from typing import Final

import numpy as np
import shapely
from numpy.typing import NDArray

from sasgeo_bench.ageing.ratebook import PooledRates
from sasgeo_bench.osm.taxonomy import load_taxonomy
from sasgeo_bench.regions.evidence import PRESENT
from sasgeo_bench.tasks.perturbations.ageing import Ageing, Rates
from sasgeo_bench.tasks.state import State
from sasgeo_bench.tasks.suites.base import (
    Edit,
    QueryDraft,
    Scene,
    Seeds,
    Site,
    Suite,
    SuiteCard,
    Variant,
    ViewRequest,
    controls,
    ladder,
    pair,
)
from sasgeo_bench.tasks.suites.twins import TWIN_GROUP, TwinSuite, nodes_of, places_of
from sasgeo_bench.tasks.twin import mirror

AGES_YEARS: Final = (2.0, 5.0, 10.0)
DAYS_PER_YEAR: Final = 365.25
_MOST_OF_AGE: Final = 5 / 3


class RealAgeSuite(Suite):
    """One view of today's world, searched for in maps of several ages; the control searches today's map.

    `strength` is the age that a map stands for; the truth of each query says its age in years, `age_years`.
    """

    def lack(self, scene: Scene) -> str | None:
        """Refuse a region without an older extract."""
        if not scene.others:
            return "one date only, real ageing needs an older extract of the same place"
        if not any(has_age(scene, years) for years in AGES_YEARS):
            return f"no older extract of about {', '.join(f'{years:g}' for years in AGES_YEARS)} years"
        return None

    def usable(self, scene: Scene) -> tuple[Variant, ...]:
        """Return the ages for which there is a map."""
        return tuple(item for item in self.variants if item.role != "stress" or has_age(scene, item.strength))

    def map_region(self, scene: Scene, variant: Variant) -> str:
        """Return the older map for a stress, today's for its control."""
        return map_of_age(scene, variant.strength).region if variant.role == "stress" else scene.map.region

    def draw(self, shot: ViewRequest) -> QueryDraft:
        """Perceive today's world; measure the age of the map and its changes."""
        if shot.variant.role != "stress":
            return QueryDraft(evidence=shot.perceived(), changed_share=0.0, measured={"age_years": 0.0})
        old = map_of_age(shot.scene, shot.variant.strength)
        draft = QueryDraft.of_change(shot.perceived(), shot.clean(), shot.clean(old))
        return replace(draft, measured={"age_years": age_years(old, shot.scene.world), **draft.measured})


def age_years(old: State, new: State) -> float:
    """Return the years between two states."""
    return (new.date - old.date).days / DAYS_PER_YEAR


def map_of_age(scene: Scene, years: float) -> State:
    """Return the older state whose age is nearest to the given one by ratio."""
    return min(
        scene.others, key=lambda state: (abs(np.log(max(age_years(state, scene.world), 0.01) / years)), state.date)
    )


def has_age(scene: Scene, years: float) -> bool:
    """Return whether there is a state of about that age: not much younger, and less than twice as old."""
    if not scene.others:
        return False
    # 0.8 of the age of a variant, so that none of "10 years" is less than 8
    return 0.8 <= age_years(map_of_age(scene, years), scene.world) / years <= _MOST_OF_AGE


REAL_AGE: Final = RealAgeSuite(
    card=SuiteCard(
        name="real-age",
        version=2,
        title="Real ageing (S1)",
        what="The map is that of an extract about 2, 5 or 10 years older than the world that is seen: the nearest date "
        "there is, 1.6 to 3.3, 4 to 8.3 or 8 to 16.7 years. Most of what differs was mapped since, not built.",
        separates="Stability from uniform weights: stable classes should carry what volatile ones lost.",
        falsifier="The same views against the map of the same day.",
        strength_unit="years between map and world, about: age_years is what they are",
        needs=("older maps",),
    ),
    variants=(*controls(), *ladder("S1", AGES_YEARS, small=AGES_YEARS, large=(10.0,))),
)


ERROR_FACTOR: Final = 2.0  # the detector across domains: in its own, new houses alone mislead no matcher
NEW_PER_OLD: Final = (0.5, 1.0, 2.0, 4.0)


class GrowthSuite(Suite):
    """Buildings appear near existing ones; nothing vanishes."""

    def lack(self, scene: Scene) -> str | None:
        """Refuse a region without buildings."""
        return None if len(self.anchors(scene)) else "no building to grow from"

    def anchors(self, scene: Scene) -> NDArray[np.float64]:
        """Return the buildings."""
        return places_of(nodes_of(scene, ("building", "building_cluster")))

    def draw(self, shot: ViewRequest) -> QueryDraft:
        """Add buildings, then perceive; a control sees the place as mapped."""
        if shot.variant.strength == 0:
            return QueryDraft(evidence=shot.perceived(error_factor=ERROR_FACTOR), changed_share=0.0)
        clean = shot.clean()
        grown = growth(shot.variant.strength)(clean, shot.rng("growth"))
        seen = shot.perceived(grown, error_factor=ERROR_FACTOR)
        old, new = (int((item.layer("building") == PRESENT).sum()) for item in (clean, grown))
        return QueryDraft.of_change(seen, clean, grown, new_per_old_area=(new - old) / old if old else 0.0)


def growth(new_per_old: float) -> Ageing:
    """Return ageing in which so many buildings appear for each existing one, and nothing else happens."""
    building = Rates(vanish_per_year=0.0, appear_per_year=float(np.log1p(new_per_old)))
    return Ageing(years=1.0, rates={"building": building}, place="-")


GROWTH: Final = GrowthSuite(
    card=SuiteCard(
        name="growth",
        version=1,
        title="Growth (S3)",
        what="For each building on the map 0.5 to 4 others have appeared nearby, on free ground; all is seen with "
        "twice the detector's error.",
        separates="Matchers that weigh what is seen and not mapped by its class from those that punish it alike.",
        falsifier="Nothing has appeared: scores as in the control.",
        strength_unit="new buildings for each on the map",
        min_density=0.05,
    ),
    variants=(
        *controls(),
        *ladder("S3", NEW_PER_OLD, small=NEW_PER_OLD, large=(2.0,)),
        Variant(role="falsifier", kind="no growth"),
    ),
)


YEARS: Final = (2.0, 5.0, 10.0, 20.0, 40.0)
_MOST_NEW_PER_OLD: Final = 1.0


class SyntheticAgeSuite(Suite):
    """Years pass between map and view; for places with one date only."""

    def lack(self, scene: Scene) -> str | None:
        """Refuse a region without rates of other places."""
        return "no rates of ageing from another place" if scene.ageing is None else super().lack(scene)

    def draw(self, shot: ViewRequest) -> QueryDraft:
        """Let the years pass, then perceive; a control sees the map's own day."""
        if shot.variant.strength == 0 or shot.scene.ageing is None:
            return QueryDraft(evidence=shot.perceived(), changed_share=0.0)
        clean = shot.clean()
        grown = after(shot.scene.ageing, shot.variant.strength)(clean, shot.rng("ageing"))
        return QueryDraft.of_change(shot.perceived(grown), clean, grown)


def ageing_of(pooled: PooledRates, *, place: str) -> Ageing:
    """Return ageing by the rates at which the world changed in other countries, with no year passed yet."""
    rates = {
        name: Rates(vanish_per_year=item.vanish_per_year, appear_per_year=item.appear_per_year)
        for name, item in pooled.classes.items()
    }
    return Ageing(years=0.0, rates=rates, measured_in=pooled.countries, place=place)


def after(ageing: Ageing, years: float) -> Ageing:
    """Return ageing by so many years.

    A class at most doubles: of woods, fields and hedges hardly any change can be told, and much of what is untold is a
    map that was being completed.
    """
    most = float(np.log1p(_MOST_NEW_PER_OLD)) / years if years > 0 else np.inf
    rates = {
        name: replace(item, appear_per_year=min(item.appear_per_year, most)) for name, item in ageing.rates.items()
    }
    return replace(ageing, years=years, rates=rates)


SYNTHETIC_AGE: Final = SyntheticAgeSuite(
    card=SuiteCard(
        name="synthetic-age",
        version=3,
        title="Synthetic ageing",
        what="Things vanish and appear for 2 to 40 years at the rates at which the world changed in other countries: "
        "the most that there is evidence for, without late mapping, redrawing and retagging.",
        separates="Stability from uniform weights where no second date is there; to be read beside real-age.",
        falsifier="No year has passed: scores as in the control.",
        strength_unit="years between map and world",
        needs=("rates of ageing",),
    ),
    variants=(
        *controls(),
        *ladder("aged", YEARS, small=(5.0, 10.0, 20.0, 40.0), large=(10.0, 40.0)),
        Variant(role="falsifier", kind="no year"),
    ),
)


VOLATILE: Final = tuple(item.name for item in load_taxonomy().classes if item.volatile)
STABLE: Final = tuple(item.name for item in load_taxonomy().classes if not item.volatile)


_NEAR_M: Final = 40.0


def _mixed(scene: Scene) -> NDArray[np.float64]:
    """Return centres of buildings near something stable: a lure needs both."""
    features = scene.map.features[scene.map.features["is_visible"].to_numpy()]
    shapes = features.geometry.to_numpy()
    centres = shapely.centroid(shapes[(features["class"] == "building").to_numpy()])
    stable = shapely.STRtree(shapes[features["class"].isin(STABLE).to_numpy()])
    near = np.unique(stable.query(centres, predicate="dwithin", distance=_NEAR_M)[0])
    return np.asarray(shapely.get_coordinates(centres[near])).reshape(-1, 2)


CHANGED_M: Final = 60.0  # radius of what differs: a third of a view; the rest is the same at both places


class VolatileLure(TwinSuite):
    """The world is the map with its volatile classes mirrored at each site; in a lure all classes are mirrored.

    So the view agrees with the true place on all stable classes and no volatile one, and with the lure the other way
    round; amounts are the same at both. Only the middle of each place is mirrored: without anything in common with the
    view, neither place would be in the list of a search, and there would be nothing to decide.
    """

    def edit(self, scene: Scene, sites: Sequence[Site], seeds: Seeds) -> Edit:
        """Paste the lures into the map, and change the world at the true places.

        If the lure is the true place, by lot, the original is the lure: the world then has the lure's roads, and
        everything else as at the original.
        """
        plain = super().edit(scene, sites, seeds)
        middle = partial(mirror, within_m=CHANGED_M)
        lures = [
            replace(item, change=partial(middle, classes=(*VOLATILE, *STABLE), center_m=item.source_m))
            for item in plain.map_pastes
        ]
        world = []
        for site, item in zip(plain.sites, plain.map_pastes, strict=True):
            changed = STABLE if site.is_copy else VOLATILE
            target_m = item.target_m if site.is_copy else item.source_m
            change = partial(middle, classes=changed, center_m=item.source_m)
            world.append(replace(item, target_m=target_m, change=change))
        return replace(plain, map_pastes=tuple(lures), world_pastes=tuple(world))

    def draw(self, shot: ViewRequest) -> QueryDraft:
        """Perceive the changed world for the stress, and the map for control and falsifier."""
        mapped = shot.clean(shot.scene.map)
        if shot.variant.role != "stress":
            return QueryDraft(evidence=shot.perceived(mapped), changed_share=0.0)
        return QueryDraft.of_change(shot.perceived(), shot.clean(), mapped)


VOLATILE_LURE: Final = VolatileLure(
    card=SuiteCard(
        name="volatile-lure",
        version=2,
        title="Volatile lure (S2)",
        what="In the middle of the true place, 60 m around, fields, parking, green and buildings have changed; a lure "
        "at most 800 m away agrees on them and on no road or water there. Around the middle both agree with the view.",
        separates="Stability weights from uniform ones, which count a field like a road.",
        falsifier="The same places without the change: in its middle the lure agrees on nothing.",
        strength_unit="1 where all that is volatile has changed",
        tracks=("retrieval", "localization"),
        group=TWIN_GROUP,
        min_density=0.18,
    ),
    variants=pair("unchanged", "S2", "unchanged again"),
    find=_mixed,
    needs="no building near a road, a railway or water",
    is_swapped=False,
)
