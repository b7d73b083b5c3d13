# SPDX-License-Identifier: Apache-2.0
"""Embedded towns and what each suite draws of one of them: made once, in memory where a map is edited."""

import datetime as dt
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import cache

import geopandas as gpd
import pytest
import shapely

from sasgeo_bench.regions.build import build_region, plan_build
from sasgeo_bench.regions.evidence import LayerBits
from sasgeo_bench.regions.graph import build_graph
from sasgeo_bench.regions.layers import burn_layers, make_paint
from sasgeo_bench.regions.region import Region
from sasgeo_bench.regions.region_files import read_region
from sasgeo_bench.regions.region_spec import find_region_file, read_region_file
from sasgeo_bench.tasks import flight_sampling
from sasgeo_bench.tasks.flight_sampling import Airspace, Flight, FlightDrawer, rows
from sasgeo_bench.tasks.perturbations.ageing import Ageing, rates_by_hand
from sasgeo_bench.tasks.query import Query, Truth
from sasgeo_bench.tasks.split import blocks_of, find_split
from sasgeo_bench.tasks.state import State
from sasgeo_bench.tasks.suites.all_suites import EVERY_SUITE, FLIGHT_SUITES
from sasgeo_bench.tasks.suites.base import Edit, QueryDraft, Scene, Seeds, Site, Suite, Variant, ViewRequest
from sasgeo_bench.tasks.suites.flights import ChangedMapSuite, FlightImageSuite, changed, changes_of
from sasgeo_bench.tasks.suites.natural import NATURAL_TWINS
from sasgeo_bench.tasks.suites.sites import choose_sites, largest_scale
from sasgeo_bench.tasks.twin import paste

# Sides of the region and of the town behind its name: "large" has room for the copies of several sites, "huge" for
# three of each, and the map of a "short" one ends short of its grid.
SIDES_M = {"medium": (1024.0, 1280.0), "large": (1792.0, 2048.0), "huge": (2560.0, 2816.0), "short": (1536.0, 1280.0)}
DATED = ("town-suburb",)  # towns that are built at older dates too
OLDER = (dt.date(2014, 1, 1), dt.date(2019, 1, 1))  # of a town of 2025
# Where each suite finds what it needs; what is not named here is drawn of the suburb.
TOWN_OF = {
    "occlusion": "town-riverside",
    "false-unknown": "town-riverside",
    "season": "town-riverside",
    "stable-not-distinctive": "town-industrial large",
    "topology-twins": "town-grid large",
    "instance-twins": "town-old-town large",
    "grade-separation": "town-industrial large",
    "volatile-lure": "town-old-town large",
    "alias": "town-agricultural huge",
    "controls": "town-suburb large",
    "telemetry": "town-grid",
    "natural-twins": "town-grid large",
    "natural-absent": "town-grid large",
    "flight-real-age": "town-suburb",
    **dict.fromkeys(("flight-clean", "flight-start", "flight-gap", "flight-kidnap"), "town-grid"),
    "flight-overconfident": "town-grid",
    **dict.fromkeys(("flight-off-map", "flight-alias", "flight-image"), "town-suburb"),
}
# One overpass, little room for wide views; the others get as many as are asked for.
SITES = {"grade-separation": 1, "no-priors": 3}
MOST_SITES = 4
SITES_OF_OTHERS = 2  # than the first root seed
PICTURES = 2  # of a flight: its first views
FLOWN_CELLS = 96  # side of the views of other flights, but where maps change
ROOTS = (1, 2, 5)  # root seeds: what a suite promises holds for each of them
MAIN_REACH_M = 144.0  # half a diagonal of a view of 192 m at its largest scale

TownOf = Callable[..., Region]


@dataclass(frozen=True, kw_only=True)
class Carried:
    """A suite on a town: what it draws from, after its edit, and where; `plain` is the scene before, if it edits."""

    suite: Suite
    scene: Scene
    plain: Scene
    sites: tuple[Site, ...]
    seeds: Seeds
    edit: Edit | None
    drafts: dict[tuple[int, Variant], QueryDraft] = field(init=False, default_factory=dict)

    def draw(self, site: Site, variant: Variant) -> QueryDraft:
        """One draft, as `draw.Drawer` asks for it."""
        seeds = self.seeds.under("site", site.index)
        return self.suite.draw(ViewRequest(scene=self.scene, site=site, variant=variant, seeds=seeds))

    def drawn(self, site: Site, variant: Variant) -> QueryDraft:
        """The same, drawn once for all tests."""
        key = (site.index, variant)
        if key not in self.drafts:
            self.drafts[key] = self.draw(site, variant)
        return self.drafts[key]

    def control(self, variant: Variant) -> Variant:
        """The control whose view has the same size."""
        return next(
            item for item in self.suite.variants if item.role == "control" and item.view_cells == variant.view_cells
        )


def _view_reach_m(suite: Suite) -> float:
    """How far from its centre a view of a suite may show anything."""
    return max(item.side_m for item in suite.variants) / 2 * 2**0.5 * largest_scale(suite.card.group)


@pytest.fixture(
    params=[ROOTS[0], *(pytest.param(other, marks=pytest.mark.slow) for other in ROOTS[1:])], ids="root {}".format
)
def root(request) -> int:
    """Each of several root seeds: a check of what a suite promises takes all of them."""
    return request.param


@pytest.fixture(scope="session")
def town(tmp_path_factory, lay_towns, made_once) -> TownOf:
    """A town by its name, one of `SIDES_M` behind it for another size; each is built once for all processes."""
    out = tmp_path_factory.mktemp("towns")

    @cache
    def built(name: str, date: dt.date | None = None) -> Region:
        plain_name, _, size = name.partition(" ")
        if not size and date is None:
            return read_region(lay_towns(out, name) / "regions" / name)
        spec = read_region_file(find_region_file(plain_name))
        if size:
            side_m, town_m = SIDES_M[size]
            extracts = [
                item.model_copy(update={"town": item.town.model_copy(update={"size_m": town_m})})
                for item in spec.extract
                if item.town
            ]
            spec = spec.model_copy(update={"id": f"{spec.id}-{size}", "size_m": (side_m, side_m), "extract": extracts})
        once = made_once(
            f"{spec.id}-of-{date}",
            lambda root: build_region(plan_build(spec, out=root, date=date)),
        )
        return read_region(plan_build(spec, out=once, date=date).folder)

    return built


@pytest.fixture(scope="session")
def scene(town) -> Callable[..., Scene]:
    """All that a town can offer to a suite; with the reach of a suite's views, or of those of 192 m."""

    @cache
    def of_town(name: str, suite: str = "") -> Scene:
        if suite:
            return replace(of_town(name), view_reach_m=_view_reach_m(EVERY_SUITE[suite]))
        state = State.of(town(name))
        return Scene(
            map=state,
            world=state,
            blocks=blocks_of(state.region, state.grid),
            view_reach_m=MAIN_REACH_M,
            scenes=town(name).manifest.scenes,
            others=tuple(State.of(town(name, on), name=f"{name}@{on}") for on in OLDER) if name in DATED else (),
            elsewhere=State.of(town("town-riverside")),
            ageing=Ageing(years=0.0, rates=rates_by_hand(), place="here"),
            looks={block.id: "train" for block in blocks_of(state.region, state.grid)},
        )

    return of_town


@pytest.fixture(scope="session")
def edited(town) -> Callable[..., State]:
    """A town's state with other features, perhaps on less ground, made in memory."""

    def of_features(name: str, features: gpd.GeoDataFrame, coverage: shapely.Geometry | None = None) -> State:
        base = town(name)
        mapped = base.coverage if coverage is None else coverage
        layers = burn_layers(make_paint(features, base.classes, mapped), base.grid)
        graph = build_graph(features, bounds_m=base.grid.bounds_m)
        return replace(State.of(base), bits=LayerBits.of(layers), features=features, graph=graph, coverage=mapped)

    return of_features


@pytest.fixture(scope="session")
def alike(scene) -> Callable[[str], Scene]:
    """A scene with the pairs of its places that look alike, mined once for both suites that ask them."""

    @cache
    def of_town(where: str) -> Scene:
        of = scene(where, NATURAL_TWINS.card.name)
        return replace(of, natural=NATURAL_TWINS.mine(of, None, Seeds(root=1, names=(of.map.region,))))

    return of_town


@pytest.fixture(scope="session")
def carried(scene, alike, edited) -> Callable[..., Carried]:
    """A suite on the town that can carry it, its edits carried out; at fewer sites for other seeds than the first."""

    @cache
    def of_suite(name: str, root: int = 1) -> Carried:
        suite, where = EVERY_SUITE[name], TOWN_OF.get(name, "town-suburb")
        plain = alike(where) if "natural twins" in suite.card.needs else scene(where, name)
        assert suite.lack(plain) is None
        suite = replace(suite, variants=suite.usable(plain))
        seeds = Seeds(root=root, names=(plain.map.region, name))
        count = min(SITES.get(name, MOST_SITES), MOST_SITES if root == 1 else SITES_OF_OTHERS)
        sites = choose_sites(plain, suite, count=count, seeds=seeds, group=suite.card.group)
        edit, after = suite.edit(plain, sites, seeds), plain
        if edit is not None and edit.map_pastes:
            changed = edited(where, paste(plain.map.features, edit.map_pastes))
            world = changed
            if edit.world_pastes is not None:
                world = edited(where, paste(plain.map.features, edit.world_pastes))
            after = replace(plain, map=changed, world=world)
        if edit is not None:
            after, sites = replace(after, twins=edit.twins, look_alikes=edit.elsewhere), edit.sites
        assert len(sites) == count
        return Carried(suite=suite, scene=after, plain=plain, sites=sites, seeds=seeds, edit=edit)

    return of_suite


def _low(suite: FlightImageSuite) -> FlightImageSuite:
    """A suite of small pictures from low above, which are painted at once."""
    views = tuple(replace(item, view_cells=48) for item in suite.variants)
    return replace(suite, variants=views, flight=lambda item: replace(suite.flight(item), height_m=40.0))


@dataclass(frozen=True, kw_only=True)
class Flown:
    """A suite's flights at one site: where they may go, the control's path, and the views of each variant in order."""

    airspace: Airspace
    flight: Flight
    views: dict[Variant, list[tuple[Query, Truth]]]

    def of(self, role: str, kind: str = "", strength: float | None = None) -> list[tuple[Query, Truth]]:
        """The one flight of a role whose kind begins so, of a strength where there are several."""
        (found,) = (
            pairs
            for variant, pairs in self.views.items()
            if variant.role == role and variant.kind.startswith(kind) and strength in (None, variant.strength)
        )
        return found


@pytest.fixture(scope="session")
def flown(scene, town, edited) -> Callable[..., Flown]:
    """The flights of a suite over the town that can carry it, at its first site, its maps changed in memory."""
    split = find_split("crossfit")

    @cache
    def of_suite(name: str, root: int = 1) -> Flown:
        suite, where = FLIGHT_SUITES[name], TOWN_OF[name]
        over = scene(where, name)
        assert suite.lack(over) is None
        suite = replace(suite, variants=suite.usable(over))
        if suite.is_pictured:
            suite = _low(suite)
        elif not isinstance(suite, ChangedMapSuite):  # its maps change as far as views of full size reach
            suite = replace(suite, variants=tuple(replace(item, view_cells=FLOWN_CELLS) for item in suite.variants))
        seeds = Seeds(root=root, names=(over.map.region, name))
        airspace = Airspace(
            region=town(where), scene=over, suite=suite, split=split, seeds=seeds, group=suite.card.group
        )
        lengths_m = flight_sampling.LENGTHS_M if name == "flight-gap" else (1000.0,)  # gaps of every length need room
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(flight_sampling, "LENGTHS_M", lengths_m)
            flights = airspace.choose(count=1, may_be_fewer=False)
        if suite.is_pictured:
            flights = {0: replace(flights[0], views=rows(flights[0].views, slice(0, PICTURES)))}
        if flights[0].plot is not None:
            parts = [
                changed(over.map.features, over.map.coverage, changes_of([(0, flights[0].plot)], at)) for at in (0, 1)
            ]
            maps = tuple(replace(edited(where, *part), region=f"{where}+{at}") for at, part in enumerate(parts))
            airspace = replace(airspace, scene=replace(over, others=maps))
        drawer = FlightDrawer(airspace=airspace, flights=flights)
        jobs = drawer.jobs([flight.site for flight in flights.values()])
        views = {job.variant: list(drawer.drawn([job])) for job in jobs if drawer.why_not(job) is None}
        return Flown(airspace=airspace, flight=flights[0], views=views)

    return of_suite
