# SPDX-License-Identifier: Apache-2.0
"""Pictures of a user's own as tasks: single views, and flights of those that were taken one after the other."""

import math
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from importlib.metadata import version
from pathlib import Path
from types import MappingProxyType
from typing import Final

import numpy as np

from sasgeo_bench.core.errors import ConfigError, SasgeoError, StoreError, counted, named
from sasgeo_bench.core.progress import tell
from sasgeo_bench.core.texts import NAME, plain
from sasgeo_bench.geometry.pose import Prior
from sasgeo_bench.observing.logged_photos import poses_by_log
from sasgeo_bench.observing.photo_flights import GAP_S, ODOMETERS, Odometer, OdometerName, flights_of, trajectory_of
from sasgeo_bench.observing.picture_poses import PoseFacts, PoseTable
from sasgeo_bench.observing.pictures import Sight, averaged, fitted, list_pictures, names_of, see_whole
from sasgeo_bench.observing.pose_tables import read_pose_table
from sasgeo_bench.observing.posed_pictures import (
    Heights,
    PosedPicture,
    PosedPictures,
    lenses_of,
    pose_pictures,
    reason_of,
)
from sasgeo_bench.regions.evidence import PRESENT, UNKNOWN, Evidence
from sasgeo_bench.regions.region import Manifest
from sasgeo_bench.regions.region_files import read_manifest
from sasgeo_bench.sensing.image import AerialImage
from sasgeo_bench.tasks.build import put_task
from sasgeo_bench.tasks.frame_evidence import unseen
from sasgeo_bench.tasks.frames import Frame, FrameLabels, encode_webp
from sasgeo_bench.tasks.private_seed import seed_record
from sasgeo_bench.tasks.query import (
    REAL,
    SEQUENCE_DIGITS,
    TRUTH_SIGMA,
    PriorGroup,
    Query,
    Step,
    Truth,
    view_id,
)
from sasgeo_bench.tasks.sampling import LEAST_DRAWN, UNANSWERABLE, make_prior
from sasgeo_bench.tasks.state import DRAWN_CLASSES, State
from sasgeo_bench.tasks.suites.all_suites import EVERY_SUITE
from sasgeo_bench.tasks.suites.base import Seeds
from sasgeo_bench.tasks.task_files import Task, TaskOrigin, TruthManifest

SUITE: Final = "photos"
FLIGHTS: Final = "-flights"  # after the name of a suite: the same pictures as flights
GROUP: Final = PriorGroup(radius_m=500.0, yaw="weak", scale_sigma=0.10)
_VERSION: Final = 1
_MOST_PX: Final = 768  # of a side of a picture in a task, as in the suites
_BLOCK_M: Final = 1000.0
_SHOWN: Final = 3
_CELLS: Final = 16  # of which the side of a view is a multiple, so that a board has few kinds of views
_STEPS_M: Final = (0.5, 1.0, 2.0, 5.0, 10.0, 20.0, 50.0)  # of standard deviations, which are rounded up for scoring


@dataclass(frozen=True, kw_only=True)
class ImportRequest:
    """Pictures that become tasks of a region.

    Parameters
    ----------
    pictures : Path
        Folder of photos (JPEG, TIFF), georeferenced pictures, or PNG and WebP with a table that tells their poses.
    region : Path
        Folder of a built region.
    out : Path
        Root of tasks and truths.
    name : str
        Suite of the task; that of flights ends in "-flights".
    poses : Path, optional
        Table that replaces what photos say of themselves (`pose_tables.read_pose_table`).
    log : Path, optional
        Of the flight, in place of a table (`logged_photos.poses_by_log`).
    offset_s : float, optional
        Seconds of the log at the first photo; without it the clocks of both must be known.
    facts : PoseFacts
        What the table leaves open.
    heights : Heights
        Where heights above the ground come from, in place of those that photos state above take-off.
    sigma_m : float, optional
        Standard deviation of places, of pictures whose file or row does not state it; by default that of GPS.
    group : PriorGroup
        How much is known before.
    odometry : {"drawn", "visual"}
        Of flights: the truth with drawn errors, or what `sensing.visual_odometry` makes of the pictures.
    seed : int
        Of priors and of the odometer's errors.

    Raises
    ------
    ConfigError
        If the name is none, or that of a suite that ships.
    """

    pictures: Path
    region: Path
    out: Path
    name: str = SUITE
    poses: Path | None = None
    log: Path | None = None
    offset_s: float | None = None
    facts: PoseFacts = field(default_factory=PoseFacts)
    heights: Heights = field(default_factory=Heights)
    sigma_m: float | None = None
    group: PriorGroup = GROUP
    odometry: OdometerName = "drawn"
    seed: int = 0

    def __post_init__(self) -> None:
        if not re.fullmatch(NAME, self.name) or self.name in EVERY_SUITE:
            raise ConfigError(
                f"--name {self.name!r} is no name for a suite of your own: take small letters, digits, - and _, and "
                "none of `list suites`"
            )
        if self.sigma_m is not None and not 0 < self.sigma_m <= 100:
            raise ConfigError(f"--sigma lies above 0 and within 100 m, got {self.sigma_m!r}")
        if self.group.is_gnss:
            raise ConfigError(
                f"--prior {self.group.name} is of drawn flights: for pictures take r50 or r100, as in r50-weak-s3"
            )
        if self.log is not None and self.poses is not None:
            raise ConfigError("poses come from one source: give --poses or --track alone")
        if self.seed < 0:
            raise ConfigError(f"--seed is 0 or more, got {self.seed!r}")


@dataclass(frozen=True, kw_only=True)
class Perceived:
    """What a query holds of a picture: evidence, and the picture itself with labels, unless others looked at it.

    `sight` is the whole picture, for an odometer.
    """

    evidence: Evidence
    sight: Sight | None = None
    frames: tuple[Frame, ...] = ()
    labels: tuple[FrameLabels, ...] = ()


def import_photos(request: ImportRequest) -> tuple[Task, ...]:
    """Write the tasks of some pictures: single views, and flights where pictures follow each other.

    The truth is the middle of the ground that a picture shows, a square as `locate` sees it. It is as good as the
    position in the file or table: its standard deviation is stored with it (`measured["truth_sigma_m"]`). Rounded up to
    0.5, 1, 2, 5, 10 m, it is the strength of the query: success within less than two of these is not scored. Evidence
    is unknown until `segment` has made it. Priors are drawn as in the suites: the truth lies anywhere in the disc.

    Raises
    ------
    ConfigError
        If no picture is left, or the heights of the ground do not cover them.
    ImageError
        If there is no picture.
    PoseError
        If the table cannot be read.
    StoreError
        If the region is missing, or a folder cannot be written; nothing is half-written.
    """
    manifest = read_manifest(request.region)
    return write_tasks(request, manifest, _posed(request, manifest.epsg))


def write_tasks(
    request: ImportRequest,
    manifest: Manifest,
    found: PosedPictures,
    perceive: Callable[[PosedPicture], Perceived] | None = None,
) -> tuple[Task, ...]:
    """Write the tasks of pictures with poses, as `import_photos` does; `perceive` as in `TaskWriter`."""
    state = State.read(request.region)
    off_m: dict[str, float] = {}  # of pictures that the map does not hold: how far beside it
    for one in found.pictures:
        if not state.is_mapped(np.array([one.pose.easting_m, one.pose.northing_m]), one.side_m / math.sqrt(2)):
            off_m[one.name] = _off_m(one, manifest)  # for any heading
    near_m = min((value for value in off_m.values() if value > 0), default=0.0)
    nearest = f"{near_m / 1000:.1f} km" if near_m >= 1000 else f"{near_m:.0f} m"

    def away(one: PosedPicture) -> str:
        if one.name not in off_m:
            return ""
        if off_m[one.name] == 0:
            return f"whose view is not wholly on the map {state.region}"
        return f"that were taken {nearest} or more beside the map {state.region} (name another --region)"

    hint = next((hint for one in found.pictures if one.name in off_m and (hint := _hint(one, manifest))), "")
    found.leave_out(away)
    _tell(found)
    if not found.pictures:
        raise _nothing(request.pictures, found.left_out, hint)
    writer = TaskWriter(request=request, manifest=manifest, state=state, perceive=perceive)
    tasks = [writer.put(request.name, partial(writer.views, found.pictures), found.pictures)]
    flights = flights_of([one for one in found.pictures if one.name not in writer.failed])
    if flights:
        flown = [one for flight in flights for one in flight]
        odometer = ODOMETERS[request.odometry]()
        tell(
            f"{counted(len(flights), 'flight')} of {counted(len(flown), 'picture')}: a gap of {GAP_S:g} s ends one. "
            f"{odometer.words}"
        )
        pairs = partial(writer.flights, flights, odometer)
        tasks.append(writer.put(f"{request.name}{FLIGHTS}", pairs, flown, odometer.words))
        if odometer.report():
            tell(odometer.report())
    writer.tell_failed()
    return tuple(tasks)


def _nothing(pictures: Path, left_out: Mapping[str, Sequence[str]], hint: str = "") -> ConfigError:
    """Return the error of pictures none of which can be asked, by the most frequent reason: all have been told."""
    why = max(left_out, key=lambda why: len(left_out[why]))
    more = ", the others for the reasons above" if len(left_out) > 1 else ""
    return ConfigError(f"no picture of {pictures} can be asked: {named(left_out[why], 'picture')} {why}{more}{hint}")


def _off_m(one: PosedPicture, manifest: Manifest) -> float:
    """Return how far beside the map the middle of a view lies, metres; 0 on it."""
    west, south, east, north = manifest.bounds_m
    x, y = one.pose.easting_m, one.pose.northing_m
    return math.hypot(max(west - x, x - east, 0.0), max(south - y, y - north, 0.0))


def _posed(request: ImportRequest, epsg: int) -> PosedPictures:
    table = table_of(request)
    return pose_pictures(request.pictures, table, epsg=epsg, heights=request.heights, sigma_m=request.sigma_m)


def table_of(request: ImportRequest) -> PoseTable | None:
    """Read the table of poses of a request, and tell what it holds; None without one."""
    table = None
    if request.log is not None:
        paths = list_pictures(request.pictures, is_told=False)
        photos = dict(zip(names_of(paths, request.pictures), paths, strict=True))
        table = poses_by_log(request.log, photos, offset_s=request.offset_s)
        for line in table.lines():
            tell(line)
    if request.poses is not None:
        facts = request.facts
        if not facts.names and not facts.times_s:  # a TUM file's pictures: those of the folder, in their order
            facts = replace(
                facts, names=tuple(names_of(list_pictures(request.pictures, is_told=False), request.pictures))
            )
        table = read_pose_table(request.poses, facts)
        given = facts.names
        if table.kind == "TUM" and not request.facts.names and list(given) != sorted(given, key=_by_number):
            raise ConfigError(
                f"{request.poses.name} is for pictures in order, and their names sort another way as text than by "
                "number (frame_10 before frame_2): pad the numbers of the names with zeros"
            )
        for line in table.lines():
            tell(line)
    return table


def _by_number(name: str) -> list[list[tuple[str, int]]]:
    parts = (re.findall(r"([^0-9]*)([0-9]*)", part) for part in name.split("/"))
    return [[(text, int(digits or -1)) for text, digits in part] for part in parts]


def _hint(one: PosedPicture, manifest: Manifest) -> str:
    """Return what a picture off the map may have wrong, if it lies on the map otherwise."""
    west, south, east, north = manifest.bounds_lonlat
    lon_deg, lat_deg = one.picture.lonlat or (math.nan, math.nan)
    if west <= lat_deg <= east and south <= lon_deg <= north:
        return "; longitude and latitude seem to be swapped"
    if west <= math.degrees(lon_deg) <= east and south <= math.degrees(lat_deg) <= north:
        return "; places seem to be in radians: call the columns lat_rad and lon_rad"
    return ""


def _tell(found: PosedPictures) -> None:
    for note in found.notes:
        tell(note)
    for why, names in found.left_out.items():
        tell(f"left out: {named([plain(name) for name in names], 'picture', most=_SHOWN)} {why}")
    lenses = lenses_of(found.pictures)
    if len(lenses) > 1:
        tell(f"{len(lenses)} cameras: {', '.join(f'{plain(lens)} ({count})' for lens, count in lenses.items())}")


Pairs = Iterator[tuple[Query, Truth]]


@dataclass(frozen=True, slots=True)
class _Asked:
    """How one picture is asked: its id, what is known before, its seeds, and where it stands in a flight."""

    query_id: str
    prior: Prior
    seeds: Seeds
    step: Step | None = None
    told: Mapping[str, float] = field(default_factory=lambda: MappingProxyType({}))


@dataclass(kw_only=True)
class TaskWriter:
    """Writes tasks of pictures with poses; pictures that cannot be decoded are left out and counted.

    `perceive` makes of a picture what its query holds; by default the picture, of which nothing is seen yet.
    """

    request: ImportRequest
    manifest: Manifest
    state: State
    perceive: Callable[[PosedPicture], Perceived] | None = None
    failed_by: "dict[str, list[str]]" = field(default_factory=dict)
    labels: "dict[tuple[int, ...], FrameLabels]" = field(default_factory=dict)

    @property
    def failed(self) -> set[str]:
        """Return the names of pictures that could not be decoded."""
        return {name for names in self.failed_by.values() for name in names}

    def tell_failed(self) -> None:
        """Tell which pictures could not be decoded, and why."""
        for why, names in self.failed_by.items():
            tell(f"left out: {named(names, 'picture')} {why}")

    def put(self, suite: str, pairs: Callable[[str], Pairs], of: Sequence[PosedPicture], more: str = "") -> Task:
        """Write one task; `more` is a sentence on what it is."""
        before = self._queries_sha256(suite)
        made = put_task(pairs(suite), self._origin(suite, of, more), self._hidden(len(of)), out=self.request.out)
        if before not in (None, made.manifest.queries_sha256):
            tell(f"{made.folder} held the queries of another import, which are replaced (another --name keeps both)")
        tell(f"{suite} on {self.state.region}: {counted(made.manifest.queries, 'query', 'queries')} in {made.folder}")
        return made

    def _queries_sha256(self, suite: str) -> str | None:
        """Return the hash of the queries of that name that are there already; None without sound ones."""
        try:
            return Task.open(self.request.out / "tasks" / suite / self.state.region).manifest.queries_sha256
        except StoreError:
            return None

    def _hidden(self, count: int) -> TruthManifest:
        return TruthManifest.model_validate(seed_record(self.request.seed) | {"count": count})

    def _origin(self, suite: str, pictures: Sequence[PosedPicture], more: str) -> TaskOrigin:
        sigmas_m = [one.sigma_m for one in pictures]
        table = self.request.poses or self.request.log
        by = "their files" if table is None else table.name
        searched = self.request.group.words.removeprefix("searched: ")
        return TaskOrigin(
            suite=suite,
            suite_version=_VERSION,
            title=f"Pictures of one's own ({suite})",
            what=f"{counted(len(pictures), 'picture')} with poses by {plain(by)}, searched: {searched}. Truths have a "
            f"standard deviation of {min(sigmas_m):.1f} to {max(sigmas_m):.1f} m: success within less than two of "
            f"them, rounded up, is not scored. {more}".rstrip(),
            separates="What a method does on one's own pictures from what it does on others.",
            falsifier="none",
            strength_unit=TRUTH_SIGMA,
            region=self.state.region,
            map_date=self.state.date.isoformat(),
            map_fingerprint=self.manifest.fingerprint,
            map_inputs_sha256=self.manifest.inputs_sha256,
            licence=self.manifest.licence,
            attribution=self.manifest.attribution,
            provenance=self.manifest.provenance,
            sites=len(pictures),
            epsg=self.manifest.epsg,
            made_by=f"sasgeo-bench {version('sasgeo-bench')}",
        )

    def _seeds(self, suite: str) -> Seeds:
        return Seeds(root=self.request.seed, names=(self.state.region, suite, str(_VERSION)))

    def views(self, pictures: Sequence[PosedPicture], suite: str) -> Pairs:
        """Yield each picture as a query of its own, in the order of the ids."""
        seeds = {one.name: self._seeds(suite).under("picture", one.name) for one in pictures}
        count = 0
        for one in sorted(pictures, key=lambda one: seeds[one.name].digest("query")):
            own = seeds[one.name]
            prior = make_prior(one.pose, self.request.group, rng=own.rng("prior"))
            seen = self._perceived(one)
            if seen is not None:
                count += 1
                yield self._pair(one, suite, _Asked(own.digest("query").hex()[:24], prior, own), seen)
        # the most frequent reason first, with names in order: pictures were read in the order of their ids
        by_count = sorted(self.failed_by.items(), key=lambda item: (-len(item[1]), item[0]))
        self.failed_by = {why: sorted(names) for why, names in by_count}
        if not count:
            self.tell_failed()
            raise _nothing(self.request.pictures, self.failed_by)

    def flights(self, flights: Sequence[Sequence[PosedPicture]], odometer: Odometer, suite: str) -> Pairs:
        """Yield the pictures of flights in the order of the ids, with what an odometer says of the way to each."""
        group = self.request.group
        blank = Prior(center_m=None, radius_m=None, yaw_deg=None, yaw_sigma_deg=None, scale_sigma=group.scale_sigma)
        by_id = {self._seeds(suite).digest("flight", one[0].name).hex()[:SEQUENCE_DIGITS]: one for one in flights}
        for flight, pictures in sorted(by_id.items()):
            seeds = self._seeds(suite).under("flight", pictures[0].name)
            flown = trajectory_of(pictures)
            odometer.begin(pictures, seeds.rng("odometry"))
            before: Sight | None = None
            for frame, one in enumerate(pictures):
                seen = self._perceived(one)
                after = None if seen is None else seen.sight
                prior, step = blank, Step(sequence_id=flight, frame=frame)
                if frame == 0:
                    prior = make_prior(one.pose, group, rng=seeds.rng("prior"))
                elif (moved := odometer.increment(frame, before, after)) is not None:
                    step = replace(step, increment=moved.increment, covariance=moved.covariance)
                told = {
                    "distance_m": round(float(flown.distance_m[frame]), 1),
                    "time_s": round(float(flown.time_s[frame]), 2),
                    "is_seen": 1.0,
                }
                if seen is not None:
                    yield self._pair(one, suite, _Asked(view_id(flight, frame), prior, seeds, step, told), seen)
                before = after

    def _perceived(self, one: PosedPicture) -> Perceived | None:
        """Return what a query holds of a picture; None, and the reason kept, if it cannot be decoded."""
        try:
            return self._pictured(one) if self.perceive is None else self.perceive(one)
        except SasgeoError as error:
            why = f"that cannot be decoded ({reason_of(error, one.picture.path)})"
            self.failed_by.setdefault(why, []).append(one.name)
            return None

    def _pair(self, one: PosedPicture, suite: str, asked: _Asked, seen: Perceived) -> tuple[Query, Truth]:
        """Return the query and truth of a picture."""
        taken = one.picture.taken_at
        query = Query(
            query_id=asked.query_id,
            track="localization" if asked.step is None else "sequence",
            suite=suite,
            suite_version=_VERSION,
            part="test",
            region=self.state.region,
            prior_group=self.request.group.name,
            evidence=seen.evidence,
            observed_on=self.state.date if taken is None else taken.date(),
            season="",
            prior=asked.prior,
            frames=seen.frames,
            step=asked.step,
        )
        return query, self._truth(one, asked, seen)

    def _truth(self, one: PosedPicture, asked: _Asked, seen: Perceived) -> Truth:
        """Return where a picture was taken, and how well that is known."""
        height_m = 0.0 if one.picture.camera is None else one.position_m[2]
        density = self._density(one, seen.evidence)
        block = "-".join(str(math.floor(value / _BLOCK_M)) for value in (one.pose.easting_m, one.pose.northing_m))
        return Truth(
            query_id=asked.query_id,
            is_present=True,
            pose=one.pose,
            candidate=-1,
            pair_id=asked.seeds.digest("pair", one.name).hex()[:16],
            role="control",
            kind="own picture",
            strength=next((step for step in _STEPS_M if step >= one.sigma_m), one.sigma_m),
            strength_unit=TRUTH_SIGMA,
            unknown_share=seen.evidence.of_known_classes().unknown_share,  # what no one looks for is not hidden
            changed_share=0.0,
            feature_density=density,
            alias_index=None,
            block=f"{self.state.region}-{block}",
            scene=",".join(self.manifest.scenes),
            measured={
                "truth_sigma_m": one.sigma_m,
                "height_m": round(height_m, 1),
                "tilt_deg": round(one.picture.tilt_deg, 1),
                **asked.told,
                **({UNANSWERABLE: 1.0} if density < LEAST_DRAWN else {}),
            },
            detector=REAL,
            labels=seen.labels,
        )

    def _pictured(self, one: PosedPicture) -> Perceived:
        """Return a picture of which nothing is seen yet."""
        whole = see_whole(one.picture)
        height_m = 0.0 if one.picture.camera is None else one.position_m[2]
        believed = replace(
            whole.image,
            height_sigma_m=round(height_m * one.picture.scale_sigma, 2),
            attitude_sigma_deg=1.0 if one.picture.camera is not None else 0.0,
        )
        sight = fitted(replace(whole, image=believed))
        factor = math.ceil(max(sight.image.shape) / _MOST_PX)
        image = sight.image if factor < 2 else averaged(sight.image, factor)
        east_m, north_m = sight.middle_m
        frame = Frame(
            picture=encode_webp(image.rgb),
            camera=image.camera.moved(east_m=-east_m, north_m=-north_m),
            height_sigma_m=image.height_sigma_m,
            attitude_sigma_deg=image.attitude_sigma_deg,
        )
        size_cells = view_cells(sight.size_cells)
        evidence = unseen(self.state.classes, size_cells, sight.cell_size_m)
        return Perceived(
            evidence=evidence, sight=replace(whole, image=believed), frames=(frame,), labels=(self._labels(image),)
        )

    def _density(self, one: PosedPicture, evidence: Evidence) -> float:
        """Return the share of a view's cells in which the map shows a road, building, water or other drawn feature."""
        view = self.state.view(one.pose, size_cells=evidence.shape[0], cell_size_m=evidence.cell_size_m)
        layers = [view.classes.index(name) for name in (*DRAWN_CLASSES, "water") if name in view.classes]
        return float((view.cells[layers] == PRESENT).any(axis=0).mean())

    def _labels(self, image: AerialImage) -> FrameLabels:
        """Return labels that say nothing: what is on one's own pictures no one has drawn."""
        shape = (len(self.state.classes), *image.rgb.shape[:2])
        if shape not in self.labels:
            self.labels[shape] = FrameLabels.of(self.state.classes, np.full(shape, UNKNOWN, dtype=np.uint8))
        return self.labels[shape]


def view_cells(most: int) -> int:
    """Return the cells along a side of a view that has at most so many: a multiple of a few, 16 at least."""
    return max(_CELLS, most // _CELLS * _CELLS)
