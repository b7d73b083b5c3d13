# SPDX-License-Identifier: Apache-2.0
"""Locate pictures of a user's own on a map: where the camera stood, and how far to trust it."""

import hashlib
import json
import math
import time
from collections.abc import Callable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import asdict, replace
from pathlib import Path
from typing import Final, Self

import numpy as np

from sasgeo_bench.core import progress
from sasgeo_bench.core.errors import ConfigError, MatchError, SasgeoError, StoreError
from sasgeo_bench.core.folders import locked, sha256_of
from sasgeo_bench.core.paths import plain_file
from sasgeo_bench.core.progress import tell
from sasgeo_bench.core.texts import one_line
from sasgeo_bench.geometry.pose import Pose, Prior
from sasgeo_bench.geometry.projection import to_grid, to_lonlat
from sasgeo_bench.matching.matcher import MatcherCard, Prediction, lacks
from sasgeo_bench.matching.segmenter import SegmenterCard
from sasgeo_bench.observing.chances import Answers, Chances, answers_for, stored_sha256
from sasgeo_bench.observing.fixes import SEGMENTER, Fix, Located, LocateRequest, Seen, Watch, verdict
from sasgeo_bench.observing.pictures import (
    OwnPicture,
    Sight,
    Told,
    list_pictures,
    names_of,
    open_picture,
    see,
)
from sasgeo_bench.regions.evidence import Evidence
from sasgeo_bench.regions.packed_map import UNPACKED
from sasgeo_bench.regions.region import Manifest
from sasgeo_bench.regions.region_files import read_manifest
from sasgeo_bench.running.plugin_code import matcher_code, segmenter_code
from sasgeo_bench.running.segmenter_process import SegmenterProcess
from sasgeo_bench.running.worker import Reach, Worker, guarded, hidden_below
from sasgeo_bench.sensing.birdseye import to_evidence
from sasgeo_bench.sensing.ground import Plane
from sasgeo_bench.sensing.photos import MOST_BYTES
from sasgeo_bench.sensing.segmentation import Segmentation
from sasgeo_bench.tasks.frame_evidence import for_classes, unseen
from sasgeo_bench.tasks.frames import Frame, encode_webp
from sasgeo_bench.tasks.query import Query
from sasgeo_bench.tasks.task_files import query_bytes

ANSWERS: Final = "answers.jsonl"
_GIMBAL_SIGMA_DEG: Final = 10.0  # of a drone's compass
_TOP_K: Final = 25
_VERSION: Final = 1  # raised when the same question gets another answer by this file


def locate(request: LocateRequest, watching: Callable[[Path], Watch] | None = None) -> Located:
    """Locate pictures; goes on where an earlier call with the same words was cut off.

    `watching` makes, for the folder of the map, what gets each picture when it is done.

    Raises
    ------
    ConfigError
        If a number is out of range, or no region holds the first picture.
    ImageError
        If there is no picture.
    MatchError
        If the matcher or the segmenter cannot be loaded, or needs what pictures do not give. One picture that cannot be
        read costs itself alone: its row says why.
    StoreError
        If the region is missing or damaged.
    """
    paths = list_pictures(request.pictures)
    names = names_of(paths, request.pictures)
    region = request.region or map_of(request, paths)
    manifest = read_manifest(region)
    watch = None if watching is None else watching(region)
    request.into.mkdir(parents=True, exist_ok=True)
    with locked(request.into), _Asker(request, region, manifest) as asker:
        kept = read_answers(request.into / ANSWERS)
        fixes: list[Fix] = []
        label = "pictures located"
        progress.begin(label, len(paths))
        with (request.into / ANSWERS).open("a", encoding="utf-8") as file:
            file.write("\n")  # a line that was cut off ends here
            for number, (path, name) in enumerate(zip(paths, names, strict=True)):
                key = asker.key(path, name)
                fix = kept.get(key)
                if fix is None or (watch is not None and not watch.is_shown(number, fix) and fix.view is not None):
                    fix = _watched(asker.ask(path, name, key), number, watch)
                    if fix.status != "failed":
                        file.write(json.dumps({"key": key, "fix": asdict(fix)}) + "\n")
                        file.flush()
                fixes.append(fix)
                progress.advance(label, 1)
        return Located(
            request=request,
            region=region,
            manifest=manifest,
            fixes=tuple(fixes),
            calibration=asker.calibration,
        )


def _watched(seen: Seen | Fix, number: int, watch: Watch | None) -> Fix:
    """Show a picture to a watch, and return its fix; nothing else of it is kept while the next one is asked."""
    if isinstance(seen, Fix):
        return seen
    if watch is not None:
        watch.seen(number, seen)
    return seen.fix


def read_answers(path: Path) -> dict[str, Fix]:
    """Return the fixes of earlier calls by key; a last line that was cut off counts as none."""
    if not path.is_file():
        return {}
    found = {}
    for line in plain_file(path).read_text(encoding="utf-8", errors="replace").splitlines():
        try:
            row = json.loads(line)
            view = row["fix"].pop("view")
            found[str(row["key"])] = Fix(**row["fix"], view=None if view is None else tuple(view))
        except (ValueError, TypeError, KeyError, AttributeError):
            continue
    return found


def map_of(request: LocateRequest, paths: Sequence[Path]) -> Path:
    """Return the newest built region that holds the place of the search, and say which."""
    place, of = _place_of(request, paths)
    found, is_swapped = [], False
    for file in sorted((request.out / "regions").glob("*/region.json")):
        try:
            manifest = read_manifest(file.parent)
        except StoreError:
            continue
        if "+" not in file.parent.name and _holds(manifest, place):
            found.append((manifest.extract.date, -math.prod(manifest.grid.shape), file.parent))
        is_swapped = is_swapped or _holds(manifest, place[::-1])
    if not found:
        where = f"{place[0]:.5f},{place[1]:.5f} ({of})"
        if is_swapped:
            raise ConfigError(
                f"no built region holds {where}, one holds it with the two swapped: longitude comes first"
            )
        raise ConfigError(
            f"no built region in {request.out / 'regions'} holds {where}: make one with new-region NAME --center "
            f"{place[0]:.5f},{place[1]:.5f} --size 2km (or --photos FOLDER) --extracts FOLDER, and build it"
        )
    folder = max(found)[2]
    tell(f"map: {folder.name}, the newest that holds {of}")
    return folder


def _place_of(request: LocateRequest, paths: Sequence[Path]) -> tuple[tuple[float, float], str]:
    """Return longitude and latitude by which a map is chosen, and whose they are."""
    if request.near is not None:
        return request.near, "--near"
    fault = ""
    for path in paths if request.uses_position else ():
        try:
            lonlat = open_picture(path, request.told).lonlat
        except SasgeoError as error:
            fault = fault or str(error)
            continue
        if lonlat is not None:
            return lonlat, path.name
    raise ConfigError(
        fault or "no picture says where it was taken: name a region with --region, or a place with --near"
    )


def _holds(manifest: Manifest, place: tuple[float, float]) -> bool:
    try:
        east_m, north_m, _ = to_grid(*place, manifest.epsg)
    except SasgeoError:
        return False
    west, south, east, north = manifest.bounds_m
    return west <= east_m <= east and south <= north_m <= north


class _Asker:
    """The processes of a segmenter and a matcher, and all that a picture is asked with."""

    def __init__(self, request: LocateRequest, region: Path, manifest: Manifest) -> None:
        self._request, self._region, self._manifest = request, region, manifest
        hidden = hidden_below([request.out.resolve()])
        reach = Reach(
            readable=(),
            hidden=[*hidden, *(request.out.resolve() / name for name in ("regions", UNPACKED))],
            is_sandboxed=request.is_sandboxed,
        )
        self._segmenter = SegmenterProcess(spec=request.segmenter, reach=reach, limits=request.limits, is_lean=True)
        reach = Reach(readable=[region.resolve()], hidden=hidden, is_sandboxed=request.is_sandboxed)
        self._worker = Worker(spec=request.matcher, reach=reach, limits=request.limits, is_lean=True)
        self._threads = ThreadPoolExecutor(3)
        self._codes: Future[tuple[str, str]] = self._threads.submit(
            lambda: (matcher_code(request.matcher), segmenter_code(request.segmenter))
        )
        self._matcher_card: Future[MatcherCard] = self._threads.submit(self._prepared)
        self._segmenter_card: Future[SegmenterCard] = self._threads.submit(self._loaded)
        self._chances: Chances | None = None
        self._has_chances = False

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._threads.shutdown(wait=True, cancel_futures=True)
        self._segmenter.end()
        self._worker.end()

    def _prepared(self) -> MatcherCard:
        """Load the matcher and let it prepare the map."""
        reply = self._worker.load()
        if reply.card is None:
            raise MatchError(f"{self._request.matcher}: cannot be loaded ({reply.message})")
        if "training" in reply.card.needs:
            raise MatchError(f"{reply.card.name} needs training, and nothing was learned here: name another --matcher")
        ready = self._worker.prepare(self._region, None)
        if ready.status != "ok":
            raise MatchError(f"{reply.card.name} cannot prepare {self._region.name}: {ready.status}: {ready.message}")
        return reply.card

    def _loaded(self) -> SegmenterCard:
        reply = self._segmenter.load()
        if reply.card is None:
            raise MatchError(f"{self._request.segmenter}: cannot be loaded ({reply.message})")
        if "training" in reply.card.needs:
            raise MatchError(f"{reply.card.name} needs training: name a --segmenter with weights, such as {SEGMENTER}")
        return reply.card

    @property
    def chances(self) -> Chances | None:
        """Return what P(false fix) is read off; None where nothing ships for this matcher and segmenter."""
        if not self._has_chances:
            answers = self._answers()
            self._chances = None if answers is None else Chances.of(answers)
            self._has_chances = True
        return self._chances

    def _answers(self) -> Answers | None:
        card = self._matcher_card.result()
        return answers_for(card.name, card.version, self._segmenter_card.result().name)

    @property
    def calibration(self) -> str:
        """Return on which pictures P(false fix) was calibrated, in a line."""
        answers = self._answers()
        if answers is not None:
            here = any(self._region.name.startswith(place) for place in answers.places)
            return f"P(false fix) is {answers.text}" + ("; this place is among them" if here else "")
        return (
            f"P(false fix) is not calibrated for {self._request.matcher} with {self._request.segmenter}: nothing is "
            "accepted"
        )

    def key(self, path: Path, name: str) -> str:
        """Return the hash of all that an answer follows from."""
        return answer_key(self._request, self._manifest, self._codes.result(), path, name)

    def ask(self, path: Path, name: str, key: str) -> Seen | Fix:
        """Locate one picture; a fault of the picture is a row."""
        begun = time.perf_counter()
        try:
            picture = open_picture(path, self._request.told)
            prior, centre = self._prior(picture, name)
            sight = see(picture, self._request.told)
        except SasgeoError as error:
            why = str(error).removeprefix(f"{path.name} ").removeprefix(f"{path} ")
            return Fix(file=name, status="failed", reason=one_line(why), seconds=_since(begun))
        card = self._segmenter_card.result()
        classes = card.classes
        reply = guarded(lambda: self._segmenter.segment(sight.image, classes=classes), self._request.out, card.name)
        if reply.found is None:
            why = f"{card.name}: {reply.status}: {reply.message}"
            return Fix(file=name, status="failed", reason=one_line(why), seconds=_since(begun))
        query = self._query(picture, sight, reply.found, prior, name)
        answer = self._answer(query)
        fix = self._fix(picture, sight, prior, answer, name, centre)
        return Seen(
            fix=replace(fix, key=key, seconds=_since(begun)),
            sight=sight,
            segmentation=reply.found,
            evidence=query.evidence,
        )

    def _prior(self, picture: OwnPicture, name: str) -> tuple[Prior, tuple[float, float] | None]:
        """Return what is known before, and longitude and latitude of the disc's middle."""
        request, manifest = self._request, self._manifest
        place = request.near or (picture.lonlat if request.uses_position else None)
        centre_m = None
        where = place or _middle(manifest)
        east_m, north_m, convergence_deg = to_grid(*where, manifest.epsg)
        if place is not None:
            west, south, east, north = manifest.bounds_m
            off_m = math.hypot(max(west - east_m, 0.0, east_m - east), max(south - north_m, 0.0, north_m - north))
            if off_m > request.radius_m:
                raise ConfigError(
                    f"{name} was taken {off_m / 1000:.1f} km beside the map {self._region.name}: name another --region"
                )
            centre_m = (east_m, north_m)
            if request.near is None:
                # The position in the file is in the disc, and nowhere special: its middle would be the answer.
                centre_m = _off_middle(centre_m, request.radius_m, name)
        heading = request.heading
        if heading is None and picture.heading_deg is not None and not request.is_turned:
            sigma_deg = 5.0 if picture.heading_by == "georeference" else _GIMBAL_SIGMA_DEG
            heading = (picture.heading_deg, sigma_deg)
        prior = Prior(
            center_m=centre_m,
            radius_m=None if centre_m is None else request.radius_m,
            yaw_deg=None if heading is None else round((heading[0] + convergence_deg) % 360.0, 1),
            yaw_sigma_deg=None if heading is None else heading[1],
            scale_sigma=picture.scale_sigma,
        )
        return prior, None if centre_m is None else self._lonlat(*centre_m)

    def _lonlat(self, east_m: float, north_m: float) -> tuple[float, float]:
        lon, lat = to_lonlat(self._manifest.epsg).transform(east_m, north_m)
        return (float(lon), float(lat))

    def _query(self, picture: OwnPicture, sight: Sight, seen: Segmentation, prior: Prior, name: str) -> Query:
        frames: tuple[Frame, ...] = ()
        if "image" in self._matcher_card.result().needs:
            # The matcher finds the middle of the square, so the camera stands beside it in the frame of the view.
            east_m, north_m = sight.middle_m
            camera = sight.image.camera.moved(east_m=-east_m, north_m=-north_m)
            frames = (Frame(picture=encode_webp(sight.image.rgb), camera=camera),)
        empty = unseen(self._manifest.classes, sight.size_cells, sight.cell_size_m)
        evidence = _evidence_of(sight, seen)
        when = picture.taken_at.date() if picture.taken_at else self._manifest.extract.date
        return Query(
            query_id=hashlib.sha256(name.encode()).hexdigest()[:24],
            track="localization",
            suite="locate",
            suite_version=1,
            part="test",
            region=self._region.name,
            prior_group="own",
            evidence=for_classes(evidence, empty),
            observed_on=when,
            season="",
            prior=prior_of_view(prior, sight.middle_m),
            frames=frames,
        )

    def _answer(self, query: Query) -> Prediction:
        card = self._matcher_card.result()
        reason = lacks(card, query)
        if reason is not None:
            return Prediction(query_id=query.query_id, status="not applicable", message=reason)
        blob = query_bytes(query)
        reply = guarded(lambda: self._worker.match(blob, top_k=_TOP_K), self._request.out, card.name)
        if reply.found is None:
            return Prediction(query_id=query.query_id, status=reply.status, message=reply.message)
        return reply.found

    def _fix(
        self,
        picture: OwnPicture,
        sight: Sight,
        prior: Prior,
        answer: Prediction,
        name: str,
        centre: tuple[float, float] | None,
    ) -> Fix:
        unlike = "" if self.chances is None else self.chances.answers.unlike(picture, sight, prior)
        known = Fix(
            file=name,
            status="withheld",
            prior_lon=None if centre is None else round(centre[0], 7),
            prior_lat=None if centre is None else round(centre[1], 7),
            prior_radius_m=prior.radius_m,
            side_m=round(sight.side_m, 1),
            height_m=picture.height_m,
            taken_at=picture.taken_at.isoformat() if picture.taken_at else None,
            note="; ".join(filter(None, [picture.note, unlike])),
        )
        if answer.status != "ok":
            return replace(known, status="failed", reason=fault_of(self._request.matcher, answer))
        if not answer.candidates:
            return replace(known, reason="nothing that the map knows is seen", p_false=1.0)
        view = answer.candidates[0][0]
        stood = sight.camera_pose(view)
        lon, lat = self._lonlat(stood.easting_m, stood.northing_m)
        _, _, convergence_deg = to_grid(lon, lat, self._manifest.epsg)
        away_m = None
        if picture.lonlat is not None:
            east_m, north_m, _ = to_grid(*picture.lonlat, self._manifest.epsg)
            away_m = round(math.hypot(stood.easting_m - east_m, stood.northing_m - north_m), 2)
        p_false = None if self.chances is None else round(self.chances.p_false(answer), 4)
        status, reason = verdict(answer, p_false, prior, side_m=sight.side_m, most_false=self._request.most_false)
        return replace(
            known,
            status=status,
            lon=round(lon, 7),
            lat=round(lat, 7),
            x_m=round(stood.easting_m, 2),
            y_m=round(stood.northing_m, 2),
            heading_deg=round((stood.yaw_deg - convergence_deg) % 360.0, 2),
            p_false=p_false,
            is_accepted=status == "found",
            reason=reason,
            file_distance_m=away_m,
            view=(round(view.easting_m, 3), round(view.northing_m, 3), round(view.yaw_deg, 3), round(view.scale, 5)),
        )


def answer_key(request: LocateRequest, manifest: Manifest, codes: tuple[str, str], path: Path, name: str) -> str:
    """Return the hash of all that an answer follows from; `codes` are hashes of the matcher's and segmenter's code."""
    asked = [
        _VERSION,
        name,
        _content(path),
        request.matcher,  # several share a file, and so a hash of their code
        request.segmenter,
        *codes,
        stored_sha256(),
        {item: record.sha256 for item, record in manifest.files.items()},
        request.near,
        request.radius_m,
        request.heading,
        request.is_turned,
        _told(request.told),
        request.uses_position,
        request.most_false,
    ]
    return hashlib.sha256(json.dumps(asked, sort_keys=True).encode()).hexdigest()[:32]


def _told(told: Told) -> dict[str, float | str]:
    """Return what a user says of pictures; keys are as before without a file of heights."""
    said = asdict(replace(told, dem=None))
    del said["dem"]
    return said | ({} if told.dem is None else {"dem": _content(told.dem)})


def fault_of(matcher: str, answer: Prediction) -> str:
    """Return why a matcher gave no answer, in a line, and the mend of a search that took too long.

    >>> fault_of("sasgeo", Prediction(query_id="a", status="timeout", message="no answer within 30 s"))
    'sasgeo: timeout: no answer within 30 s: search less, by --near and --radius or by --heading'
    """
    mend = ": search less, by --near and --radius or by --heading" if answer.status == "timeout" else ""
    return one_line(f"{matcher}: {answer.status}: {answer.message}") + mend


def prior_of_view(prior: Prior, middle_m: tuple[float, float]) -> Prior:
    """Return the prior of a view whose middle lies beside its camera, (right, up), by that of the camera.

    The disc moves as far as the heading tells, and grows by what the heading leaves open: it holds the middle of the
    view wherever the camera stood in its own.

    >>> camera = Prior(center_m=(0.0, 0.0), radius_m=500.0, yaw_deg=90.0, yaw_sigma_deg=10.0, scale_sigma=0.1)
    >>> view = prior_of_view(camera, (0.0, 100.0))
    >>> [round(value) for value in view.center_m], round(view.radius_m)
    ([100, 0], 552)
    """
    beside_m = math.hypot(*middle_m)
    if prior.center_m is None or prior.radius_m is None or not beside_m:
        return prior
    if prior.yaw_deg is None or prior.yaw_sigma_deg is None:
        return replace(prior, radius_m=prior.radius_m + beside_m)
    here = Pose(easting_m=prior.center_m[0], northing_m=prior.center_m[1], yaw_deg=prior.yaw_deg)
    east_m, north_m = here.to_map(np.array([middle_m]))[0].tolist()
    turned = min(2 * math.sin(math.radians(min(3 * prior.yaw_sigma_deg, 180.0)) / 2), 2.0)  # chord of three deviations
    return replace(prior, center_m=(east_m, north_m), radius_m=prior.radius_m + turned * beside_m)


def _evidence_of(sight: Sight, seen: Segmentation) -> Evidence:
    return to_evidence(
        seen,
        sight.image.camera,
        Plane(),
        size_cells=sight.size_cells,
        cell_size_m=sight.cell_size_m,
        pose=sight.pose,
    )


def _content(path: Path) -> str:
    """Return what tells the content of a file: its hash, of a mosaic its size and when it last changed."""
    about = path.stat()
    if about.st_size <= MOST_BYTES:
        return sha256_of(path)
    return f"{about.st_size} {about.st_mtime_ns} {about.st_ctime_ns}"


def _middle(manifest: Manifest) -> tuple[float, float]:
    west, south, east, north = manifest.bounds_m
    lon, lat = to_lonlat(manifest.epsg).transform((west + east) / 2, (south + north) / 2)
    return (float(lon), float(lat))


def _off_middle(at_m: tuple[float, float], radius_m: float, name: str) -> tuple[float, float]:
    """Return the middle of a disc that holds a place anywhere; the same for the same name."""
    seed = int.from_bytes(hashlib.sha256(f"{name} {radius_m:g}".encode()).digest()[:8], "big")
    rng = np.random.default_rng(seed)
    turn, far_m = rng.uniform(0, 2 * math.pi), (radius_m - 1.0) * math.sqrt(rng.random())
    return (round(at_m[0] + far_m * math.cos(turn), 1), round(at_m[1] + far_m * math.sin(turn), 1))


def _since(begun: float) -> float:
    return round(time.perf_counter() - begun, 2)
