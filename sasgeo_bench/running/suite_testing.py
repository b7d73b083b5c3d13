# SPDX-License-Identifier: Apache-2.0
"""The conformance kit of suites: what every suite promises, checked on a small town."""

from collections.abc import Iterator
from contextlib import nullcontext
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Final

import numpy as np

from sasgeo_bench.core.errors import ConfigError, SasgeoError
from sasgeo_bench.core.folders import scratch_folder
from sasgeo_bench.core.progress import reporting, silent
from sasgeo_bench.core.texts import message_of
from sasgeo_bench.running.testing import Check, check_of, tried
from sasgeo_bench.tasks.build import check_task, make_tasks, plan_draw
from sasgeo_bench.tasks.query import CEILING, Query, Truth
from sasgeo_bench.tasks.sampling import Drawer
from sasgeo_bench.tasks.suites.all_suites import find_suite
from sasgeo_bench.tasks.suites.base import QueryDraft, Site, Suite, Variant, ViewRequest
from sasgeo_bench.tasks.task_plan import Request, TaskRequest, plan_requests

TOWN: Final = "town-agricultural"  # a square kilometre, built in a second
_SENTENCES: Final = ("title", "what", "separates", "falsifier")  # of a card: what a reader needs


def check_suite(spec: str, *, out: Path | None = None) -> Iterator[Check]:
    """Try a suite, by name or "module:NAME", on a small town; yield a row for each rule.

    It runs in this process, as it does when it draws queries: name only code that you trust. `out` is where the town
    is kept from one suite to the next; by default a scratch folder.

    Examples
    --------
    >>> {check.outcome for check in check_suite("false-unknown")}
    {'pass'}
    """
    try:
        suite = find_suite(spec)
    except ConfigError as error:
        yield Check(name="loads, and has a card", outcome="fail", found=str(error))
        return
    yield Check(name="loads, and has a card", outcome="pass", found=f"{suite.card.name} {suite.card.version}")
    yield check_of("the card says what differs", _silence(suite), suite.card.separates)
    yield check_of("has a control, a stress and a falsifier", _lost_role(suite), f"{len(suite.variants)} variants")
    with nullcontext(out) if out else scratch_folder("check") as folder:
        yield from _drawn_checks(spec, folder)


def _silence(suite: Suite) -> str | None:
    empty = [name for name in _SENTENCES if not str(getattr(suite.card, name)).strip()]
    return f"{', '.join(empty)} of its card is empty" if empty else None


def _lost_role(suite: Suite) -> str | None:
    there = {variant.role for variant in suite.variants}
    lost = [role for role in ("control", "stress", "falsifier") if role not in there]
    return f"no variant is a {' or a '.join(lost)}" if lost else None


def _drawn_checks(spec: str, folder: Path) -> Iterator[Check]:
    # 2 sites
    wanted = TaskRequest(
        suites=(spec,), regions=(TOWN,), split="crossfit", count=2, seed=1, out=folder, may_be_fewer=True
    )
    with reporting(silent):
        (request,) = plan_requests(wanted)
    name = f"draws queries on {TOWN}"
    try:
        with reporting(silent):
            made = make_tasks(request)
        faults = [fault for task in made for fault in check_task(task)]
        drawer, sites = plan_draw(request)
    except SasgeoError as error:
        yield Check(name=name, outcome="not applicable", found=f"{error}: try it on a place that can")
        return
    except Exception as error:  # whatever a suite of somebody's own raises  # noqa: BLE001
        yield Check(name=name, outcome="fail", found=message_of(error))
        return
    found = f"{sum(task.manifest.queries for task in made)} queries at {len(sites)} sites"
    yield check_of(name, faults[0] if faults else None, found)
    if not isinstance(drawer, Drawer):
        yield Check(name="single views", outcome="not applicable", found="queries are views of flights")
        return
    kit = _Kit(request=request, drawer=drawer, sites=tuple(sites))
    found = f"{len(kit.pairs)} queries"
    yield from tried(
        (
            ("the same seed, the same queries", kit.repeats, found),
            ("another seed, other queries", kit.depends_on_seed, found),
            ("views as their variant says", kit.keeps_size, found),
            ("a falsifier sees what its control sees", kit.falsifiers_are_controls, found),
            ("a stress changes something", kit.stresses, found),
            ("the searched disc holds the truth", kit.priors_hold, found),
        )
    )


class _AsControl(ViewRequest):
    @property
    def draw(self) -> tuple[str, ...]:
        return self.variant.others


@dataclass(frozen=True, kw_only=True)
class _Kit:
    """Checks of drawn queries; each returns a fault in words, or None."""

    request: Request
    drawer: Drawer
    sites: tuple[Site, ...]

    @cached_property
    def pairs(self) -> list[tuple[Query, Truth]]:
        return self._draw(self.drawer)

    def _draw(self, drawer: Drawer) -> list[tuple[Query, Truth]]:
        jobs = [job for job in drawer.jobs(self.sites) if drawer.why_not(job) is None]
        return list(drawer.drawn(jobs))

    def _draft(self, site: Site, variant: Variant, shot: type[ViewRequest] = ViewRequest) -> QueryDraft:
        seeds = self.drawer.seeds.under("site", site.index)
        return self.drawer.suite.draw(shot(scene=self.drawer.scene, site=site, variant=variant, seeds=seeds))

    def _control(self, variant: Variant) -> Variant | None:
        controls = (one for one in self.drawer.suite.variants if one.role == "control")
        return next((one for one in controls if one.side_m == variant.side_m), None)

    def repeats(self) -> str | None:
        for (query, truth), (again, other) in zip(self.pairs, self._draw(self.drawer), strict=True):
            if not _is_same(query, again) or truth != other:
                return f"query {query.query_id[:8]} ({truth.kind}) is another one when it is drawn again"
        return None

    def depends_on_seed(self) -> str | None:
        others = self._draw(replace(self.drawer, seeds=replace(self.drawer.seeds, root=2)))
        first = {query.query_id for query, _ in self.pairs}
        same = any(query.query_id in first for query, _ in others)
        return "queries of two seeds have one id" if same else None

    def keeps_size(self) -> str | None:
        for job in self.drawer.jobs(self.sites):
            seen, variant = self._draft(job.site, job.variant).evidence, job.variant
            if seen.shape != (variant.view_cells, variant.view_cells) or seen.cell_size_m != variant.cell_size_m:
                return f"{variant.name}: a view of {seen.shape} cells of {seen.cell_size_m:g} m"
            if seen.classes != self.drawer.scene.map.classes:
                return f"{variant.name}: its classes are {', '.join(seen.classes)}, not those of the map"
        return None

    def falsifiers_are_controls(self) -> str | None:
        for variant in (one for one in self.drawer.suite.variants if one.role == "falsifier"):
            control = self._control(variant)
            if control is None:
                return f"{variant.name} has no control with a view of its size"
            for site in self.sites:
                one, two = self._draft(site, variant, _AsControl), self._draft(site, control)
                if CEILING in one.measured and one.evidence.unknown_share > two.evidence.unknown_share:
                    continue  # what could be told by is hidden, as its ceiling says
                if (one.evidence.cells != two.evidence.cells).any() and one.evidence.unknown_share != 1:
                    return f"{variant.name} shows something else than the control, so that a method may gain on it"
        return None

    def stresses(self) -> str | None:
        """Compare each stress with its control: the view, or what else a query holds."""
        controls = {
            (truth.pair_id, query.evidence.shape): query for query, truth in self.pairs if truth.role == "control"
        }
        for query, truth in self.pairs:
            if truth.role != "stress":
                continue
            control = controls.get((truth.pair_id, query.evidence.shape))
            if control is None or not _is_same(control, query) or not truth.is_present:
                return None
        return "no stress differs from its control at any site"

    def priors_hold(self) -> str | None:
        """Compare true places with the discs that are searched."""
        for query, truth in self.pairs:
            prior, pose = query.prior, truth.pose
            if not truth.is_present or pose is None or prior.center_m is None or prior.radius_m is None:
                continue
            away_m = np.hypot(pose.easting_m - prior.center_m[0], pose.northing_m - prior.center_m[1])
            if away_m > prior.radius_m:
                return f"query {query.query_id[:8]} ({truth.kind}) lies {away_m:.0f} m from the middle of its disc"
        return None


def _is_same(one: Query, other: Query) -> bool:
    """Return whether two queries ask the same: view, pictures, map, prior, candidates and vectors."""
    if (one.vectors is None) != (other.vectors is None):
        return False
    vectors = one.vectors is None or (
        one.vectors.geometry.to_wkb().tolist() == other.vectors.geometry.to_wkb().tolist()  # type: ignore[union-attr]
    )
    same = (one.region, one.prior, one.candidates) == (other.region, other.prior, other.candidates)
    return (
        same
        and one.frames == other.frames
        and vectors
        and bool(np.array_equal(one.evidence.cells, other.evidence.cells))
    )
