# SPDX-License-Identifier: Apache-2.0
"""Regional extracts of a provider: which hold a place, and download one."""

import hashlib
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache
from http.client import HTTPException, HTTPResponse
from importlib import resources
from pathlib import Path
from typing import Annotated, Final
from urllib.error import HTTPError
from urllib.request import Request, urlopen

import shapely
from pydantic import Field

from sasgeo_bench.core.config import Document, Line, parse_toml
from sasgeo_bench.core.errors import ExtractError
from sasgeo_bench.core.folders import locked
from sasgeo_bench.core.progress import advance, begin, tell
from sasgeo_bench.core.texts import one_line
from sasgeo_bench.osm.locate import answers, cache_folder
from sasgeo_bench.osm.snapshot import read_header

SERVER: Final = "https://download.geofabrik.de"
_FILE: Final = "regional_extracts.toml"
_SILENCE_S: Final = 30.0  # between two parts of a download
_MOST_OUTLINE_BYTES: Final = 5_000_000
_MB: Final = 1_000_000
_PARTIAL: Final = 206  # status of an answer that begins where it was asked to


class RegionalExtract(Document):
    """A regional extract by its name at the provider; the box (west, south, east, north, degrees) is rounded up."""

    name: Line
    box: Annotated[tuple[float, float, float, float], Field(strict=False)]


def address_of(name: str) -> str:
    """Return the address of the newest file of a regional extract.

    >>> address_of("europe/andorra")
    'https://download.geofabrik.de/europe/andorra-latest.osm.pbf'
    """
    return f"{SERVER}/{name}-latest.osm.pbf"


class _RegionalExtracts(Document):
    extract: list[RegionalExtract]


@cache
def regional_extracts() -> tuple[RegionalExtract, ...]:
    """Return the regional extracts that are known here, once for each of their boxes.

    Countries, states of the US and of Germany, provinces of China, and continents.
    """
    text = resources.files("sasgeo_bench.osm").joinpath(_FILE).read_text(encoding="utf-8")
    return tuple(parse_toml(text, _RegionalExtracts, source=_FILE).extract)


def regional_extracts_of(area_lonlat: shapely.Geometry) -> tuple[RegionalExtract, ...]:
    """Return the regional extracts whose boxes hold an area (degrees), the smallest first: it may be a neighbour's.

    >>> [item.name for item in regional_extracts_of(shapely.Point(1.52, 42.51))]
    ['europe/andorra', 'europe/spain', 'europe/france', 'europe']
    """
    boxes = [(shapely.box(*item.box), item) for item in regional_extracts()]
    holding = [(box.area, item) for box, item in boxes if box.covers(area_lonlat)]
    return tuple(item for _, item in sorted(holding, key=lambda pair: pair[0]))


def download_regional(area_lonlat: shapely.Geometry, *, most_mb: float) -> Path:
    """Download the smallest regional extract whose outline holds an area into the user's cache, named by its day.

    What was loaded of a file before it broke off is kept, and is not loaded again. Raise `ExtractError` if the server
    cannot be reached, no outline holds the area, the file has more than `most_mb` megabytes (10^6 bytes), or does not
    come whole.
    """
    if not answers(SERVER):
        raise ExtractError(f"{SERVER} cannot be reached")
    found = next((item for item in regional_extracts_of(area_lonlat) if _outline(item).covers(area_lonlat)), None)
    if found is None:
        raise ExtractError(f"no regional extract of {SERVER} holds the place whole: make it smaller")
    folder = cache_folder()
    with locked(folder / found.name.replace("/", "-")):
        loaded = _load(address_of(found.name), folder, most_mb=most_mb)
        header = read_header(loaded)
        day = header.replicated_at.date().isoformat() if header.replicated_at else "undated"
        return loaded.replace(folder / f"{found.name.rpartition('/')[2]}-{day}.osm.pbf")


def _outline(item: RegionalExtract) -> shapely.Geometry:
    """Return the outline of an extract, degrees; its box if the server has none."""
    try:
        with _opened(f"{SERVER}/{item.name}.poly") as answer:
            return read_outline(answer.read(_MOST_OUTLINE_BYTES).decode("utf-8"))
    except (ExtractError, UnicodeDecodeError):
        return shapely.box(*item.box)


def read_outline(text: str) -> shapely.Geometry:
    r"""Return the area of an osmosis polygon file (`.poly`), longitude and latitude; a ring named `!...` is a hole.

    Raise `ExtractError` if the text is none.

    >>> read_outline("x\n1\n 0 0\n 4 0\n 4 4\n 0 4\nEND\n!2\n 1 1\n 2 1\n 2 2\nEND\nEND\n").area
    15.5
    """
    area: shapely.Geometry = shapely.Polygon()
    name, corners = "", list[tuple[float, float]]()
    try:
        for words in filter(None, (line.split() for line in text.splitlines()[1:])):
            if words == ["END"] and name:
                ring = shapely.make_valid(shapely.Polygon(corners))
                area = area.difference(ring) if name.startswith("!") else area.union(ring)
                name, corners = "", []
            elif name:
                corners.append((float(words[0]), float(words[1])))
            else:
                name = words[0]
    except (ValueError, IndexError) as error:
        raise ExtractError(f"the outline has a line that is no corner ({one_line(str(error))})") from error
    if area.is_empty:
        raise ExtractError("the outline has no ring: it is another kind of file")
    return area


def _load(url: str, folder: Path, *, most_mb: float) -> Path:
    """Load a file into a folder, from where an earlier try broke off; its parts are of one version of the file."""
    with _opened(url, method="HEAD") as answer:
        total = int(answer.headers.get("Content-Length") or 0)
        version = answer.headers.get("ETag") or answer.headers.get("Last-Modified") or ""
    if not 0 < total <= most_mb * _MB:
        size = f"has {total / _MB:,.0f} MB" if total else "does not say its size"
        raise ExtractError(f"{url} {size}, and at most {most_mb:,.0f} MB are downloaded (--most-mb)")
    target = folder / url.rpartition("/")[2]
    part = folder / f"{target.name}.{hashlib.sha256(f'{url} {version} {total}'.encode()).hexdigest()[:12]}.part"
    begun = part.stat().st_size if part.is_file() else 0
    if begun < total:
        tell(f"downloading {url}, {(total - begun) / _MB:,.0f} of {total / _MB:,.0f} MB")
        begin("MB downloaded", -(-(total - begun) // _MB))
        with (
            _opened(url, Range=f"bytes={begun}-") as answer,
            part.open("ab" if answer.status == _PARTIAL else "wb") as file,
        ):
            while file.tell() < total and (data := answer.read(min(_MB, total - file.tell()))):
                file.write(data)
                advance("MB downloaded", 1)
    if part.stat().st_size != total:
        got_mb = part.stat().st_size / _MB
        raise ExtractError(
            f"{url} broke off after {got_mb:,.1f} of {total / _MB:,.1f} MB: the same command goes on from there"
        )
    return part.replace(target)


@contextmanager
def _opened(url: str, *, method: str = "GET", **headers: str) -> Iterator[HTTPResponse]:
    """Open an address of the server; raise `ExtractError` if it does not answer, or breaks off."""
    request = Request(url, method=method, headers={"User-Agent": "sasgeo-bench", **headers})  # noqa: S310 - of `SERVER`
    try:
        with urlopen(request, timeout=_SILENCE_S) as answer:  # noqa: S310 - as above
            yield answer
    except ExtractError:
        raise
    except HTTPError as error:
        raise ExtractError(f"{url} could not be downloaded: the server answered with status {error.code}") from error
    except (OSError, HTTPException) as error:
        why = getattr(error, "strerror", None) or "the connection broke off"
        raise ExtractError(f"{url} could not be downloaded: {why}; the same command goes on from there") from error
