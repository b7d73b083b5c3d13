# SPDX-License-Identifier: Apache-2.0
"""A board's folder -> its site: the order of the steps."""

import os
import shutil
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Final

import pandas as pd

from sasgeo_bench.ageing.ratebook import load_ratebook
from sasgeo_bench.boards.archive import request_of, score_all
from sasgeo_bench.boards.archive_file import is_pack
from sasgeo_bench.boards.board import Board, by_entry
from sasgeo_bench.boards.board_files import (
    BOARD_FILES,
    FIGURES,
    csv_text,
    read_leaderboard,
)
from sasgeo_bench.boards.board_tables import Book
from sasgeo_bench.boards.manifests import PicturesManifest, PipelineRecord
from sasgeo_bench.boards.overview import overviews_of, times_frame
from sasgeo_bench.boards.pipeline_spec import PipelineFile, find_pipeline_file, read_pipeline_file
from sasgeo_bench.boards.pooled_plots import draw_tradeoff
from sasgeo_bench.boards.private_board import check_public
from sasgeo_bench.boards.site import site_pages
from sasgeo_bench.boards.site_files import (
    MOST_BYTES,
    BoardFiles,
    Download,
    SiteFigure,
    SiteSource,
    Spot,
    Written,
    draw_text,
    held,
    read_board_files,
    site_lock,
    write_site,
)
from sasgeo_bench.boards.site_maps import draw_places, draw_rates, places_on_map, regions_of
from sasgeo_bench.core.errors import ConfigError, StoreError
from sasgeo_bench.core.folders import SITE, absolute, resolve_link, scratch_folder
from sasgeo_bench.core.progress import tell
from sasgeo_bench.core.texts import one_line
from sasgeo_bench.regions.region import MADE_UP
from sasgeo_bench.regions.region_files import read_manifest
from sasgeo_bench.regions.region_spec import list_region_files, read_region_file
from sasgeo_bench.scoring.contrasts import Contrast
from sasgeo_bench.scoring.flights import FLIGHT_COLUMNS
from sasgeo_bench.scoring.intervals import DRAWS
from sasgeo_bench.scoring.score import COLUMNS as SCORED
from sasgeo_bench.scoring.strata import GROUP
from sasgeo_bench.scoring.tables import scene_frame
from sasgeo_bench.tasks.split import find_split_file, read_split_file

_MAP: Final = "places.svg"
_RATES: Final = "ageing-rates.svg"
_TIMES: Final = "first-times.svg"
MOST_TIMES: Final = 5  # matchers with a look of their own on the first page
_OF_SCENES: Final = (
    *(*GROUP, "kind_of_place", "matcher", "metric", "n", "blocks", "places"),
    *("value", "lo", "hi", "lo_blocks", "hi_blocks", "interval", "rank_best", "rank_worst"),
)


def publish(
    board: Path, into: Path | None = None, *, root: Path = Path("out"), jobs: int = 1, tables_only: bool = False
) -> Written:
    """Make the site of a board from its folder; stored results are scored again for their figures and pictures.

    `into` is the folder to write, by default `site` in the board's own. Pictures of stored results, which hold no
    views, come from regions/, tasks/ and truth/ below `root`. `jobs` counts the processes that score; with
    `tables_only` nothing is scored, and the site is of the tables as they are: no pictures, files, or figures that take
    answers. Raise `StoreError` if there is no sound board or the site cannot be written, and an older site then stays
    as it was; `ConfigError` if the board is of a private seed.
    """
    if into is None and (board / SITE).is_symlink():
        raise StoreError(f"{board / SITE} is a link: name where it leads with --into")
    target = board / SITE if into is None else resolve_link(into)
    place, whole = Path(os.path.realpath(absolute(target).parent)) / absolute(target).name, board.resolve()
    if place == whole or (place.is_relative_to(whole) and place != whole / SITE):
        raise StoreError(
            f"{target} is the board itself, or would be a strange folder in it: name another one with --into"
        )
    with held(board, target, root=root), _with_figures(board, root, jobs, tables_only=tables_only) as folder:
        with _sound(board):
            files = read_board_files(folder)
            if tables_only:
                files = replace(files, figures=(), downloads=(), pictures=PicturesManifest())
        check_public(files.board.about.private_seed, str(board))
        with _sound(board):
            scenes = _scenes(files.board)
            files = replace(files, downloads=(*files.downloads, *_scenes_file(scenes)))
            source = replace(_source(files, root), scenes=scenes)
            pages = site_pages(source)
        with site_lock(board, target):
            written = write_site(
                target,
                files,
                pages=pages,
                figures=filter(None, (*source.figures, source.rates_figure, source.map_figure, source.times_figure)),
                name=source.name,
            )
    if written.site_bytes > MOST_BYTES:
        tell(f"the site is larger than {MOST_BYTES / 1e6:g} MB without pictures and downloads: slow to open from afar")
    return written


@contextmanager
def _with_figures(board: Path, root: Path, jobs: int, *, tables_only: bool) -> Iterator[Path]:
    """Yield the folder of a board with figures: stored results are scored into one that goes when the block ends."""
    if tables_only or not is_pack(board) or (board / FIGURES).is_dir():  # results of a former layout hold their figures
        yield board
        return
    tell(f"{board}: scoring stored results again, for their figures")
    with scratch_folder("answers") as scratch:
        folder = scratch / board.resolve().name
        request = replace(request_of([board], board=folder, root=root), jobs=jobs)
        score_all(request)
        if not read_leaderboard(folder).equals(read_leaderboard(board)):
            tell(f"the site shows the tables of this version, which differ from those in {board}: store them anew")
        for name in BOARD_FILES:  # those of the paper's experiment are made where it is run
            if (board / name).is_file() and not (folder / name).exists():
                shutil.copyfile(board / name, folder / name)
        yield folder


@contextmanager
def _sound(board: Path) -> Iterator[None]:
    """Turn errors in tables or values of a board, which anybody may have made, into a `StoreError` that names it."""
    try:
        yield
    except StoreError as error:
        raise StoreError(
            str(error) if str(board) in str(error) else f"{board} holds a damaged board: {error}"
        ) from error
    except (LookupError, ValueError, TypeError, AttributeError, ArithmeticError, RecursionError) as error:
        text = one_line(repr(error))
        raise StoreError(f"{board} holds a board that no page can be made of ({text}): score it again") from error


def _source(files: BoardFiles, root: Path) -> SiteSource:
    """Return the content of all pages, with figures of places and rates drawn for them; `root` holds built regions."""
    about, name = files.board.about, _name_of(files.board)
    spec = _pipeline_of(about.pipeline)
    spots, parts = _spots(regions_of(about.tasks), root), _parts(about.split)
    lost = [region for region in regions_of(about.tasks) if region not in spots]
    if lost:
        tell(f"not on the map of places, for no region of that name ships or is built in {root}: {', '.join(lost)}")
    places = places_on_map(about.tasks, spots, parts)
    rates = load_ratebook()
    drawing: dict[str, Callable[[Path], object]] = {_RATES: partial(draw_rates, book=rates)}
    if places:
        drawing[_MAP] = partial(draw_places, places=places)
    book = Book.of(files.board.leaderboard, about.entries, added=about.added)
    times = next(map(times_frame, overviews_of(book)), pd.DataFrame())
    if len(times):
        first = dict.fromkeys((*times["matcher"][:MOST_TIMES], *sorted(book.added.intersection(times["matcher"]))))
        drawing[_TIMES] = partial(draw_tradeoff, rows=times, shown=tuple(first), is_short=True)
    with scratch_folder("figures") as folder:
        drawn = {file: SiteFigure.of(file, draw_text(draw, folder)) for file, draw in drawing.items()}
    return SiteSource(
        name=name,
        title=_title_of(files.board, about.title or (name if spec is None else spec.title)),
        board=files.board,
        rates=rates,
        registered=_registered(files, spec),
        reasons={} if spec is None else {item.name: " ".join(item.why.split()) for item in spec.contrast},
        figures=files.figures,
        downloads=files.downloads,
        pictures=files.pictures,
        spots=spots,
        parts=parts,
        rates_figure=drawn[_RATES],
        map_figure=drawn.get(_MAP),
        times_figure=drawn.get(_TIMES),
    )


def _scenes(board: Board) -> pd.DataFrame:
    """Return success by kind of place from the board's own scored rows; empty where these do not tell.

    Rows that an older version scored may lack columns of today's figures of flights.
    """
    scores = board.scores
    of_flights = FLIGHT_COLUMNS if set(FLIGHT_COLUMNS).intersection(scores) else ()
    if not {*SCORED, *of_flights} <= set(scores):
        return pd.DataFrame()
    apart = {entry.name for entry in board.about.entries if entry.set_apart}
    return scene_frame(by_entry(scores), draws=board.about.draws or DRAWS, excluded=apart)


def _scenes_file(scenes: pd.DataFrame) -> Iterator[Download]:
    if len(scenes):
        table = scenes.rename(columns={"stratum": "kind_of_place"})[list(_OF_SCENES)]
        what = "success by kind of place, with intervals by places and by blocks"
        yield Download(file="kinds-of-place.csv", data=csv_text(table).encode(), what=what)


def _name_of(board: Board) -> str:
    pipeline = board.about.pipeline
    return pipeline.id if pipeline is not None else board.folder.resolve().name


def _title_of(board: Board, title: str) -> str:
    """Return a title after the board's own name, where that is not its pipeline's: it is another board."""
    pipeline, own = board.about.pipeline, board.folder.resolve().name
    return title if pipeline is None or own == pipeline.id else f"{own}: {title}"


def _pipeline_of(pipeline: PipelineRecord | None) -> PipelineFile | None:
    """Return the shipped pipeline that a board was made by; None for any other, even of the same name."""
    if pipeline is None:
        return None
    try:
        spec = read_pipeline_file(find_pipeline_file(pipeline.id))
    except ConfigError:
        return None
    return spec if spec.sha256 == pipeline.sha256 else None


def _registered(files: BoardFiles, spec: PipelineFile | None) -> tuple[Contrast, ...]:
    """Return contrasts as registered: from the board, its stored settings, or its pipeline."""
    if files.board.about.contrasts:
        return tuple(files.board.about.contrasts)
    if files.settings is not None:
        return tuple(files.settings.contrasts)
    return () if spec is None else tuple(item.registered for item in spec.contrast)


def _spots(regions: Iterable[str], root: Path) -> dict[str, Spot]:
    """Return the places of the shipped regions, and of others in `regions` that are built below `root`."""
    found = {}
    for name, path in list_region_files().items():
        spec = read_region_file(path)
        west, south, east, north = spec.lonlat_box()
        found[name] = Spot(
            region=name,
            title=spec.title,
            longitude_deg=(west + east) / 2,
            latitude_deg=(south + north) / 2,
            scenes=tuple(spec.scenes),
            is_made_up=any(item.town is not None for item in spec.extract),
        )
    for name in regions:
        folder = root / "regions" / Path(name).name
        if name in found or name.startswith(MADE_UP):
            continue
        try:
            manifest = read_manifest(folder)
        except StoreError:  # not built here, or damaged: the board does not need it
            continue
        west, south, east, north = manifest.bounds_lonlat
        found[name] = Spot(
            region=name,
            title=manifest.title,
            longitude_deg=(west + east) / 2,
            latitude_deg=(south + north) / 2,
            scenes=tuple(manifest.scenes),
        )
    return found


def _parts(split: str | None) -> dict[str, tuple[str, str]]:
    """Return, by region of a shipped split, its place and its half or part; nothing for another split."""
    try:
        spec = read_split_file(find_split_file(split or ""))
    except ConfigError:
        return {}
    return {region: (place.name, place.half or place.part or "") for place in spec.place for region in place.region_ids}
