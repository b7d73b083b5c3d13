# SPDX-License-Identifier: Apache-2.0
"""Planning: a user's wishes become one request for each region and suite; errors are found before anything is read."""

import datetime as dt
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Final

import numpy as np

from sasgeo_bench.core.errors import ConfigError, ExtractError, ImageryError
from sasgeo_bench.core.progress import tell
from sasgeo_bench.flights.logs import FlownPath
from sasgeo_bench.osm.locate import Extract
from sasgeo_bench.regions.build import plan_build
from sasgeo_bench.regions.region_spec import RegionFile, find_region_file, list_region_files, read_region_file
from sasgeo_bench.tasks import task_files
from sasgeo_bench.tasks.private_seed import PrivateSeed, Seed
from sasgeo_bench.tasks.query import PriorGroup
from sasgeo_bench.tasks.split import Split, find_split_file, list_split_files, make_split, read_split_file
from sasgeo_bench.tasks.split_proposal import propose_split
from sasgeo_bench.tasks.suites.ages import AGES_YEARS, DAYS_PER_YEAR
from sasgeo_bench.tasks.suites.all_suites import find_suite
from sasgeo_bench.tasks.suites.base import EVERYTHING, Choice, Need, Suite
from sasgeo_bench.tasks.suites.flights import FlightSuite

SPLIT: Final = "crossfit"
PRIVATE_ROOT: Final = "private"  # below the root of public queries, so that no folder holds both


@dataclass(frozen=True, kw_only=True)
class Settings:
    """Settings of all requests of a user.

    `count` is the number of sites, each with all variants of a suite; with `may_be_fewer`, fewer will do if the region
    holds no more. Priors are those of the suite unless `group` is given. `choice` selects variants and does not change
    their queries. With `flown`, suites of flights draw the views of that flight, which is their one site.
    """

    count: int
    seed: Seed
    out: Path
    group: PriorGroup | None = None
    extract_folders: tuple[Path, ...] = ()
    may_be_fewer: bool = False
    choice: Choice = EVERYTHING
    flown: FlownPath | None = None


@dataclass(frozen=True, kw_only=True)
class Request(Settings):
    """One suite on one region, with the split and the region for views of a wrong place.

    `suite` is its name, which folders have; `suite_spec` is what it is found by, if that is not the name.
    """

    suite: str
    suite_spec: str = ""
    region: RegionFile
    split: Split
    elsewhere: RegionFile | None = None

    @property
    def found(self) -> Suite:
        """Return the suite."""
        return find_suite(self.suite_spec or self.suite)

    @property
    def most(self) -> int:
        """Return how many queries, or flights, are drawn at most: a region may hold fewer sites."""
        suite = self.found
        older = len(older_dates(self.region, suite.card.needs))
        taken = [
            suite.drawn_of(variant, older) * self.choice.takes(variant, track)
            for variant in suite.variants
            for track in suite.tracks(variant)
        ]
        return self.count * sum(taken) * len(suite.drawn_by(self.choice.detectors))

    @property
    def extracts(self) -> tuple[Extract, ...]:
        """Return the extracts of all maps that the queries are drawn from, and maps of one's own beside them."""
        needs = self.found.card.needs
        dates = older_dates(self.region, needs)
        is_asked = "another region" in needs or "another picture" in needs
        others = [self.elsewhere.pick(None)] if is_asked and self.elsewhere is not None else []
        own = [one.beside(self.region.pick(None)) for one in self.region.own_map]
        return (*map(self.region.pick, (None, *dates)), *own, *others)


@dataclass(frozen=True, kw_only=True)
class TaskRequest(Settings):
    """Suites, a split, and regions as ids or files; without regions, all of the split that can be built.

    Without a split it is `SPLIT`, or, of a single place that this does not speak of, one in which all of it is test.
    `sealed_seed` draws the sealed places of the split; without it they are left out. Without regions, `each` bounds
    those of a place: the first of the split that can be built.
    """

    suites: tuple[str, ...]
    regions: tuple[str, ...]
    each: int | None = None
    split: str | None = None
    region_folders: tuple[Path, ...] = ()
    sealed_seed: PrivateSeed | None = None


def plan_requests(wanted: TaskRequest) -> tuple[Request, ...]:
    """Plan one request for each region and suite; read nothing but settings.

    Raises
    ------
    ConfigError
        If a suite, region or split is unknown, the split is not sound or lacks a region, the count is not positive, the
        truths would be among the tasks, or all regions are sealed.
    """
    suites = {spec: find_suite(spec) for spec in wanted.suites}
    fault = next(filter(None, map(wanted.choice.lack, suites.values())), None)
    if fault is not None:
        raise ConfigError(fault)
    check_count(wanted.count)
    check_roots(wanted.out)
    other = next((name for name, suite in suites.items() if not isinstance(suite, FlightSuite)), None)
    if wanted.flown is not None and other is not None:
        raise ConfigError(f"--flight is for suites of flights, such as flight-clean, and {other} is none")
    files = list_region_files(folders=wanted.region_folders)
    known = {name: read_region_file(path) for name, path in files.items()}
    named = [
        known.get(name) or read_region_file(find_region_file(name, folders=wanted.region_folders))
        for name in wanted.regions
    ]
    known |= {spec.id: spec for spec in named}
    split = _split(wanted, named, known)
    if not named:
        listed = [known[name] for name in split.spec.region_ids]
        named = [item for item in listed if is_reachable(item, wanted.extract_folders, wanted.out)]
        left = [item.id for item in listed if item not in named]
        if left:
            tell(f"{len(left)} regions have no extract on this machine and are left out: {', '.join(left)}")
        named = _few_of_each(named, split, wanted.each)
    stranger = next((item.id for item in named if item.id not in split.spec.region_ids), None)
    if stranger is not None:
        raise ConfigError(f"split {split.spec.id!r} does not speak of region {stranger!r}: {_other_split(stranger)}")
    settings = {item.name: getattr(wanted, item.name) for item in fields(Settings)}
    return tuple(
        Request(
            suite=suite.card.name,
            suite_spec=spec,
            region=item,
            split=split,
            elsewhere=_elsewhere(wanted, suite, split, item, known),
            **settings | ({"seed": wanted.sealed_seed} if split.sealed_place(item.id) else {}),
        )
        for item in _without_sealed({item.id: item for item in named}, split, wanted)
        for spec, suite in suites.items()
    )


def _few_of_each(regions: list[RegionFile], split: Split, most: int | None) -> list[RegionFile]:
    """Return the first regions of each place, at most so many; one of several places counts for the first of them."""
    if most is None:
        return regions
    places = Counter[str]()
    kept = []
    for item in regions:
        place = next(iter(split.places_in(item.id)), item.id)
        places[place] += 1
        if places[place] <= most:
            kept.append(item)
    return kept


def _split(wanted: TaskRequest, named: Sequence[RegionFile], known: Mapping[str, RegionFile]) -> Split:
    grids = {name: item.grid() for name, item in known.items()}
    spec = read_split_file(find_split_file(wanted.split or SPLIT))
    if wanted.split is None and named and not set(spec.region_ids) & {item.id for item in named}:
        own = propose_split(named[0].id, named)
        if len(own.place) == 1:
            tell(f"split: {own.id} is one place, all of it test")
            return make_split(own, grids)
    return make_split(spec, grids)


def _elsewhere(
    wanted: TaskRequest, suite: Suite, split: Split, region: RegionFile, known: Mapping[str, RegionFile]
) -> RegionFile | None:
    """Return the region for views of a wrong place; None for want of its picture on this machine, and tell so."""
    is_pictured = "another picture" in suite.card.needs
    found = wrong_place(split, region, known, is_pictured=is_pictured)
    if found is None or not (is_pictured and region.imagery) or is_reachable(found, wanted.extract_folders, wanted.out):
        return found
    tell(f"{suite.card.name} on {region.id}: {found.id} is not on this machine, so no view is of another town")
    return None


def _other_split(region: str) -> str:
    """Say which shipped split holds a region, or what to do if none does."""
    found = next(
        (name for name, path in list_split_files().items() if region in read_split_file(path).region_ids), None
    )
    return "new-split makes a split of your own" + (f", or use --split {found}" if found else "")


def _without_sealed(named: Mapping[str, RegionFile], split: Split, wanted: TaskRequest) -> tuple[RegionFile, ...]:
    """Leave out regions of sealed places unless their seed is given, and tell so in one line."""
    closed = [] if wanted.sealed_seed is not None else [name for name in named if split.sealed_place(name)]
    if not closed:
        return tuple(named.values())
    places = ", ".join(dict.fromkeys(filter(None, map(split.sealed_place, closed))))
    message = (
        f"sealed places of split {split.spec.id!r} are left out: {places} (leaderboard --sealed-seed-file opens them)"
    )
    if len(closed) == len(named):
        raise ConfigError(message)
    tell(message)
    return tuple(item for name, item in named.items() if name not in closed)


def root_of(out: Path, seed: PrivateSeed | None) -> Path:
    """Return the root of what a seed draws: `out` for public queries, the folder `private` in it for a private seed."""
    return out if seed is None else out / PRIVATE_ROOT


def check_count(count: int) -> None:
    """Refuse a count below one."""
    if count < 1:
        raise ConfigError(f"--n must be at least 1, got {count}")


def check_roots(out: Path) -> None:
    """Refuse to write truths where processes that may see the tasks would find them."""
    check_separate(out / "tasks", out / "truth")
    above = next((folder for folder in (out, *out.resolve().parents) if (folder / task_files.TASK).is_file()), None)
    if above is not None:
        raise ConfigError(f"{out / 'truth'} lies inside {above}, where the queries are: choose another --out")


def check_separate(tasks: Path, truth: Path) -> None:
    """Refuse folders of tasks and truths of which one is inside the other, links followed."""
    one, two = tasks.resolve(), truth.resolve()
    if two.is_relative_to(one) or one.is_relative_to(two):
        raise ConfigError(f"{truth} lies inside {tasks}, where the queries are: choose another --out")


def is_reachable(spec: RegionFile, request_folders: Sequence[Path], out: Path) -> bool:
    """Return whether a region is synthetic, or its newest extract and its pictures are on this machine."""
    offline = spec.model_copy(update={"extract": [item.model_copy(update={"urls": ()}) for item in spec.extract]})
    try:
        plan_build(offline, out=out, extract_folders=request_folders)
    except (ExtractError, ImageryError):
        return False
    return True


def wrong_place(
    split: Split, region: RegionFile, known: Mapping[str, RegionFile], *, is_pictured: bool = False
) -> RegionFile | None:
    """Return the region for views of a wrong place: the next place of the split of the same kind, synthetic or real.

    Its map knows of all classes that the region's knows of; beside a region that knows of few, a town will do where no
    real place does.
    It depends on the split alone, so that asking for more regions changes no query. In a hold-out it is of the same
    part, so that none learns from views of a test place; and of another country, whose places calibrate others. No
    view is of a sealed place.

    With `is_pictured` it is a region with imagery, which may be passed on if the region's own may. Few places have
    some: in a hold-out where no other of the same part has, it is of a train place, from whose pictures anybody may
    learn; then one that the split names to lend its imagery; and then one whose map knows of fewer classes, for a
    segmenter sees all of them on any picture.
    """
    places = split.spec.place
    at = next((index for index, place in enumerate(places) if region.id in place.region_ids), None)
    if at is None:
        return None
    own = split.spec.place[at]
    others = [split.spec.place[(at + step) % len(places)] for step in range(1, len(places))]
    allowed = [item for item in others if not item.sealed and not (own.country and item.country == own.country)]
    parts = (own.part, "train") if is_pictured else (own.part,)
    names = [
        name for part in dict.fromkeys(parts) for place in allowed if place.part == part for name in place.region_ids
    ]
    if is_pictured:
        there = [known[name] for name in (*names, *split.spec.lends) if name in known]
        lent = [one for one in there if _lends_picture(one, region)]
        return next((one for one in lent if _knows_all_of(region, one)), lent[0] if lent else None)
    fitting = [known[name] for name in names if name in known and _knows_all_of(region, known[name])]
    alike = [one for one in fitting if _is_town(one) == _is_town(region)]
    if not alike and region.classes is not None:
        alike = fitting
    return alike[0] if alike else None


def _knows_all_of(region: RegionFile, other: RegionFile) -> bool:
    return set(region.class_names) <= set(other.class_names)


def _lends_picture(other: RegionFile, region: RegionFile) -> bool:
    """Return whether pictures of another region may be among those of a region: what may be passed on stays so."""
    may_pass = all(entry.publish for entry in other.imagery)
    return bool(other.imagery) and (may_pass or not all(entry.publish for entry in region.imagery))


def _is_town(region: RegionFile) -> bool:
    return region.pick(None).town is not None


def older_dates(spec: RegionFile, needs: Sequence[Need]) -> tuple[dt.date, ...]:
    """Return the dates of the older maps of a region that a suite with these needs searches, oldest first."""
    if "every older map" in needs:
        newest = spec.pick(None).date
        return tuple(sorted(extract.date for extract in spec.extract if extract.date < newest))
    return aged_dates(spec) if "older maps" in needs else ()


def aged_dates(spec: RegionFile) -> tuple[dt.date, ...]:
    """Return the dates of older maps for real ageing: the nearest one for each age, oldest first."""
    newest = spec.pick(None).date
    older = sorted(extract.date for extract in spec.extract if extract.date < newest)
    if not older:
        return ()
    ages_years = np.array([(newest - date).days / DAYS_PER_YEAR for date in older])
    return tuple(sorted({older[int(np.argmin(np.abs(np.log(ages_years / years))))] for years in AGES_YEARS}))
