# SPDX-License-Identifier: Apache-2.0
"""Content of a site as values: a board's tables and pictures, and what ships with the package."""

import html
import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final, Self

import pandas as pd

from sasgeo_bench.ageing.ratebook import RateBook
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
class Picture:
    """A picture of a region or suite (`of`), made elsewhere; a strip is of a suite, too."""

    of: str
    file: str
    alt: str


@dataclass(frozen=True, slots=True, kw_only=True)
class RegionMap(Picture):
    """A map that fills its picture: its edges (west, south, east, north), and those of its blocks by name, metres."""

    bounds_m: tuple[float, float, float, float] | None = None
    blocks_m: Mapping[str, tuple[float, float, float, float]] = field(default_factory=dict)


_OF_REJECTOR: Final = {"p_false_": "P(false)", "order_": "order"}
_VERDICT: Final = "accepted_"
_LEFT_OUT: Final = (_VERDICT, "told_hpl_")


@dataclass(frozen=True, slots=True, kw_only=True)
class Case:
    """One query that a matcher failed on, with facts about it by name."""

    query_id: str
    matcher: str
    failure: str
    file: str
    alt: str
    suite: str = ""
    region: str = ""
    kind: str = ""
    facts: Mapping[str, str] = field(default_factory=dict)

    def lines(self) -> dict[str, str]:
        """Return the facts of a case for a page: a line for each rejector, without protection levels.

        >>> facts = {"error_m": "9", "p_false_own": "0.9", "accepted_own": "no", "told_hpl_gauss_0.01_m": "4"}
        >>> Case(query_id="q", matcher="m", failure="aged", file="a.webp", alt="", facts=facts).lines()
        {'error_m': '9', 'own': 'P(false) 0.9, withheld'}
        """
        found: dict[str, str] = {}
        for name, value in self.facts.items():
            kind = next((kind for kind in _OF_REJECTOR if name.startswith(kind)), "")
            if kind:
                rejector = name.removeprefix(kind)
                verdict = {"yes": ", accepted", "no": ", withheld"}.get(self.facts.get(f"{_VERDICT}{rejector}", ""), "")
                found[rejector] = f"{_OF_REJECTOR[kind]} {value}{verdict}"
            elif not name.startswith(_LEFT_OUT):
                found[name] = value
        return found


@dataclass(frozen=True, kw_only=True)
class Pictures:
    """Pictures in a board's folder `pictures/`; empty if there is none."""

    regions: tuple[RegionMap, ...] = ()
    suites: tuple[Picture, ...] = ()
    strips: tuple[Picture, ...] = ()
    flights: tuple[Picture, ...] = ()
    cases: tuple[Case, ...] = ()


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
    """Content of all pages of a site; a table that the board lacks is empty.

    `title` is that of the board's pipeline where it is known, `about` the content of `board.json`. `reasons` states why
    each contrast was registered. `spots` are positions of regions, as far as they are known; `parts` holds place, and
    half or part of the split, of each region; `rates` is measured ageing. `scenes` is success by kind of place
    (`scenes.scene_frame`).
    """

    name: str
    title: str
    about: Mapping[str, Any]
    board: pd.DataFrame
    rates: RateBook
    contrasts: pd.DataFrame = field(default_factory=pd.DataFrame)
    falsifiers: pd.DataFrame = field(default_factory=pd.DataFrame)
    controls: pd.DataFrame = field(default_factory=pd.DataFrame)
    scores: pd.DataFrame = field(default_factory=pd.DataFrame)
    protection: pd.DataFrame = field(default_factory=pd.DataFrame)
    acceptance: pd.DataFrame = field(default_factory=pd.DataFrame)
    answers: pd.DataFrame = field(default_factory=pd.DataFrame)
    scenes: pd.DataFrame = field(default_factory=pd.DataFrame)
    registered: tuple[Contrast, ...] = ()
    reasons: Mapping[str, str] = field(default_factory=dict)
    figures: tuple[SiteFigure, ...] = ()
    downloads: tuple[Download, ...] = ()
    pictures: Pictures = field(default_factory=Pictures)
    spots: Mapping[str, Spot] = field(default_factory=dict)
    parts: Mapping[str, tuple[str, str]] = field(default_factory=dict)
    rates_figure: SiteFigure | None = None
    map_figure: SiteFigure | None = None
