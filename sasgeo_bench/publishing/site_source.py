# SPDX-License-Identifier: Apache-2.0
"""Content of a site as values: a board's tables and pictures, and what ships with the package."""

import html
import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final, Self

import pandas as pd

from sasgeo_bench.ageing.ratebook import RateBook
from sasgeo_bench.leaderboard.board import Board
from sasgeo_bench.leaderboard.manifests import PicturesManifest
from sasgeo_bench.scoring.contrasts import Contrast

_MOST_POINTS: Final = 100_000.0  # of a figure, either way
_TITLE: Final = re.compile(r"<dc:title>(.*?)</dc:title>", re.DOTALL)
_WIDTH: Final = re.compile(r'<svg[^>]*?\swidth="([\d.]+)(?:pt|px)?"', re.DOTALL)
_HEIGHT: Final = re.compile(r'<svg[^>]*?\sheight="([\d.]+)(?:pt|px)?"', re.DOTALL)


@dataclass(frozen=True, slots=True, kw_only=True)
class SiteFigure:
    """A figure: name of its file, text of the SVG, title, and width and height in points."""

    file: str
    text: str
    title: str
    width: float
    height: float

    @classmethod
    def of(cls, file: str, text: str) -> Self:
        """Read title and size of an SVG; one without a title has the name of its file.

        >>> figure = SiteFigure.of("own.svg", '<svg width="90pt" height="45pt"><dc:title>A &amp; B</dc:title></svg>')
        >>> figure.title, figure.width, figure.height
        ('A & B', 90.0, 45.0)
        """
        title, *sizes = (pattern.search(text) for pattern in (_TITLE, _WIDTH, _HEIGHT))
        found = (float(size[1]) if size else 0.0 for size in sizes)
        width, height = (size if 0 < size < _MOST_POINTS else 480.0 for size in found)
        shown = html.unescape(title[1]).strip() if title else Path(file).stem
        return cls(file=file, text=text, title=" ".join(shown.split()), width=width, height=height)


@dataclass(frozen=True, slots=True, kw_only=True)
class Spot:
    """Place of a region, from its shipped file."""

    region: str
    title: str
    longitude_deg: float
    latitude_deg: float
    scenes: tuple[str, ...]
    is_made_up: bool = False


@dataclass(frozen=True, slots=True, kw_only=True)
class Download:
    """A file that the site offers: name, bytes as downloaded, and a description."""

    file: str
    data: bytes
    what: str


@dataclass(frozen=True, kw_only=True)
class SiteSource:
    """Content of all pages of a site.

    `title` is that of the board's pipeline where it is known. `reasons` states why
    each contrast was registered. `spots` are positions of regions, as far as they are known; `parts` holds place, and
    half or part of the split, of each region; `rates` is measured ageing. `scenes` is success by kind of place
    (`tables.scene_frame`).
    """

    name: str
    title: str
    board: Board
    rates: RateBook
    scenes: pd.DataFrame = field(default_factory=pd.DataFrame)
    registered: tuple[Contrast, ...] = ()
    reasons: Mapping[str, str] = field(default_factory=dict)
    figures: tuple[SiteFigure, ...] = ()
    downloads: tuple[Download, ...] = ()
    pictures: PicturesManifest = field(default_factory=PicturesManifest)
    spots: Mapping[str, Spot] = field(default_factory=dict)
    parts: Mapping[str, tuple[str, str]] = field(default_factory=dict)
    rates_figure: SiteFigure | None = None
    map_figure: SiteFigure | None = None
