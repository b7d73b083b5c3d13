# SPDX-License-Identifier: Apache-2.0
"""What `locate` leaves behind: a table, files for maps and flights, and one page to look at."""

import base64
import csv
import datetime as dt
import html
import math
from collections.abc import Sequence
from dataclasses import asdict
from io import BytesIO, StringIO
from pathlib import Path
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray
from PIL import Image

from sasgeo_bench.core.errors import counted
from sasgeo_bench.core.folders import fresh_file
from sasgeo_bench.core.texts import csv_cell, plain
from sasgeo_bench.geometry.projection import to_grid
from sasgeo_bench.observing.fix_files import PlacedFix, geojson_text, gpx_text, kml_text, tum_text
from sasgeo_bench.observing.fixes import COLUMNS, Fix, Located, Seen, Watch
from sasgeo_bench.osm.taxonomy import load_taxonomy
from sasgeo_bench.regions.evidence import Evidence, LayerBits, observe
from sasgeo_bench.regions.layers import read_layers, read_overview
from sasgeo_bench.regions.painting import HIDDEN, paint_evidence, paint_overview, pooled
from sasgeo_bench.regions.region_files import LAYERS, read_manifest
from sasgeo_bench.sensing.birdseye import rectify
from sasgeo_bench.sensing.ground import Plane
from sasgeo_bench.tasks.segmented import Segmented

TABLE: Final = "locate.csv"
PAGE: Final = "index.html"
STRIPS: Final = "pictures"
PANELS: Final = ("picture", "what the segmenter saw", "evidence", "map there")
MOST_SHOWN: Final = 300  # pictures on a page
_PANEL_PX: Final = 240
_MAP_PX: Final = 1000
_MOST_CELLS: Final = 3000  # of the map along a side that are read at full resolution
_MEND: Final = "name another folder by --into, or check your rights and the free space"


class Strips(Watch):
    """Draws each picture beside its evidence and the map at its fix, into files of a page."""

    def __init__(self, folder: Path, region: Path) -> None:
        self._folder, self._map = folder / STRIPS, _Map(region)

    def is_shown(self, number: int, fix: Fix) -> bool:
        """Return whether the strip of a picture is there, or none is wanted."""
        return number >= MOST_SHOWN or strip_file(self._folder, fix).is_file()

    def seen(self, number: int, seen: Seen) -> None:
        """Draw the strip of a picture."""
        if number >= MOST_SHOWN:
            return
        panels = strip(seen, self._map.at(seen))
        path = strip_file(self._folder, seen.fix)
        with fresh_file(path, mend=_MEND) as scratch:
            Image.fromarray(panels).save(scratch, format="WEBP", quality=80)


def strip_file(folder: Path, fix: Fix) -> Path:
    """Return the file of a strip: named by what the answer follows from, so that none shows another picture."""
    return folder / f"{fix.key or 'none'}.webp"


def strip(seen: Seen, there: Evidence | None) -> NDArray[np.uint8]:
    """Return the picture, what the segmenter saw, the evidence and the map at the fix, side by side, heading up."""
    sight = seen.sight
    over = Segmented.of(seen.segmentation).over(sight.image.rgb)
    panels = [
        rectify(
            picture,
            sight.image.camera,
            Plane(),
            size_cells=sight.size_cells,
            cell_size_m=sight.cell_size_m,
            pose=sight.pose,
        )
        for picture in (sight.image.rgb, over)
    ]
    panels.append(_bytes(paint_evidence(seen.evidence)))
    panels.append(np.full_like(panels[0], 235) if there is None else _bytes(paint_evidence(there)))
    gap = np.full((_PANEL_PX, 6, 3), 255, dtype=np.uint8)
    fitted = [cv2.resize(one, (_PANEL_PX, _PANEL_PX), interpolation=cv2.INTER_AREA) for one in panels]
    return np.concatenate([part for one in fitted for part in (one, gap)][:-1], axis=1)


class _Map:
    """The layers of a region, of which parts are read: a country's do not fit into memory."""

    def __init__(self, folder: Path) -> None:
        self._file, self.manifest = folder / LAYERS, read_manifest(folder)

    def at(self, seen: Seen) -> Evidence | None:
        """Return the map at the fix of a picture, as a view of its size and classes; None without a fix."""
        pose, sight, evidence = seen.fix.view_pose, seen.sight, seen.evidence
        if pose is None:
            return None
        half_m = sight.side_m * pose.scale
        east_m, north_m = pose.easting_m, pose.northing_m
        window = self._window(np.array([(east_m - half_m, north_m + half_m), (east_m + half_m, north_m - half_m)]))
        layers = LayerBits.of(read_layers(self._file, window=window))
        grid = self.manifest.grid.window(*window)
        cells = observe(layers, grid, pose, size_cells=sight.size_cells, cell_size_m=sight.cell_size_m)
        return evidence.replace(cells[[self.manifest.classes.index(name) for name in evidence.classes]])

    def painted(self, corners_m: NDArray[np.float64]) -> tuple[NDArray[np.uint8], tuple[float, float, float, float]]:
        """Return the colours of a part, by its north-western and south-eastern corners, and its bounds."""
        row, col, rows, cols = self._window(corners_m)
        grid = self.manifest.grid
        part = grid.window(row, col, rows, cols)
        if max(rows, cols) <= _MOST_CELLS:
            layers = read_layers(self._file, window=(row, col, rows, cols))
        else:
            overview = read_overview(self._file, longest_cells=max(_MAP_PX, _MAP_PX * grid.rows // rows))
            step = grid.rows / overview.shape[1]
            ends = (math.floor(row / step), math.floor(col / step), math.ceil(rows / step), math.ceil(cols / step))
            layers = overview[:, ends[0] : ends[0] + ends[2], ends[1] : ends[1] + ends[3]]
        return paint_overview(self.manifest, pooled(layers, most_cells=_MAP_PX)), part.bounds_m

    def _window(self, corners_m: NDArray[np.float64]) -> tuple[int, int, int, int]:
        grid = self.manifest.grid
        cells = np.clip(grid.to_cells(corners_m), 0, [grid.rows - 1, grid.cols - 1])
        (top, left), (bottom, right) = cells.tolist()
        return top, left, bottom - top + 1, right - left + 1


def _bytes(colours: NDArray[np.float64]) -> NDArray[np.uint8]:
    return np.asarray(np.rint(255 * colours), dtype=np.uint8)


def write_results(located: Located) -> list[Path]:
    """Write table, GeoJSON, GPX, KML, TUM and page into the folder of the request; return their paths.

    GPX, KML and TUM hold accepted fixes alone, the others all. Raise `StoreError` if one cannot be written.
    """
    folder, fixes = located.request.into, located.fixes
    credit = located.manifest.attribution
    accepted = [one for one in map(placed, fixes) if one is not None and one.is_accepted]
    properties = [name for name in COLUMNS if name not in ("lon", "lat")]
    points = [
        (fix.lon, fix.lat, {name: getattr(fix, name) for name in properties})
        for fix in fixes
        if fix.lon is not None and fix.lat is not None
    ]
    texts = {
        TABLE: csv_text(fixes),
        "locate.geojson": geojson_text(points, credit),
        "locate.gpx": gpx_text(accepted, credit),
        "locate.kml": kml_text(accepted, credit),
        "locate.tum": tum_text(accepted),
        PAGE: page_text(located),
    }
    for name, text in texts.items():
        with fresh_file(folder / name, mend=_MEND) as scratch:
            scratch.write_text(text, encoding="utf-8")
    return [folder / name for name in texts]


def csv_text(fixes: Sequence[Fix]) -> str:
    """Return the table; columns as `Fix` describes them, empty where nothing is known.

    >>> print(csv_text([Fix(file="a.jpg", status="failed", reason="=1+1")]).splitlines()[1])
    a.jpg,failed,,,,,,,false,'=1+1,,,,,0.0
    """
    rows: list[tuple[object, ...]] = [COLUMNS]
    for fix in fixes:
        values = asdict(fix) | {"is_accepted": str(fix.is_accepted).lower()}
        rows.append(tuple("" if values[name] is None else csv_cell(values[name]) for name in COLUMNS))
    text = StringIO()
    csv.writer(text, lineterminator="\n").writerows(rows)
    return text.getvalue()


def placed(fix: Fix) -> PlacedFix | None:
    """Return a fix as files for maps and flights have it; None where nothing was found.

    Its time is that of the camera's clock, as if it were UTC.
    """
    numbers = (fix.lon, fix.lat, fix.x_m, fix.y_m, fix.heading_deg)
    known = [value for value in numbers if value is not None]
    if len(known) < len(numbers):
        return None
    lon, lat, east_m, north_m, heading_deg = known
    time_ns, comment = None, ""
    if fix.taken_at is not None:
        moment = dt.datetime.fromisoformat(fix.taken_at).replace(tzinfo=dt.UTC)
        time_ns = round(moment.timestamp() * 1e6) * 1000
        # GPX asks for UTC; the camera's clock says no zone, so the time stands in a comment.
        comment = f"taken at {fix.taken_at} by the camera's clock"
    return PlacedFix(
        name=fix.file,
        lon_deg=lon,
        lat_deg=lat,
        east_m=east_m,
        north_m=north_m,
        heading_deg=heading_deg,
        yaw_deg=heading_deg if fix.view is None else fix.view[2],
        is_accepted=fix.is_accepted,
        p_false=fix.p_false,
        time_ns=time_ns,
        delay_s=fix.seconds,
        height_m=fix.height_m,
        comment=comment,
    )


_COLOURS: Final = {"found": "#0a7d33", "withheld": "#b36b00", "not on this map": "#a3142a", "failed": "#666666"}
_STYLE: Final = """
:root{color-scheme:light}
body{font:15px/1.45 system-ui,sans-serif;margin:0 auto;max-width:1060px;padding:16px;color:#222}
h1{font-size:1.45em;margin:.2em 0}p{margin:.4em 0}.facts{color:#555}.map{position:relative;max-width:100%;margin:12px 0}
.map img{width:100%;display:block;border:1px solid #bbb}.map svg{position:absolute;inset:0;width:100%;height:100%}
article{border-top:1px solid #ddd;padding:10px 0}h2{font-size:1.05em;margin:.2em 0;overflow-wrap:anywhere}
.panels{display:flex;flex-wrap:wrap;gap:6px;margin-top:6px}figure{margin:0;flex:1 1 150px;max-width:240px}
figure i{display:block;aspect-ratio:1;background-size:407.5% auto;background-repeat:no-repeat}
figcaption{color:#555;font-size:.85em}.keys{color:#555;font-size:.85em;display:flex;flex-wrap:wrap;gap:2px 12px}
.keys b{display:inline-block;width:.9em;height:.9em;margin-right:4px;border:1px solid #888;vertical-align:-.1em}
b.state{color:#fff;border-radius:3px;padding:1px 7px;font-weight:600}
.note{color:#8a4b00}footer{border-top:1px solid #ddd;margin-top:16px;color:#555;font-size:.85em}
"""


def page_text(located: Located) -> str:
    """Return the page: all fixes on the map, then each picture, what was seen in it, and the map at its fix."""
    fixes = located.fixes
    counts = [(name, sum(fix.status == name for fix in fixes)) for name in _COLOURS]
    total = counted(len(fixes), "picture")
    summary = ", ".join(f"{count} {name}" for name, count in counts if count)
    request = located.request
    shown = fixes[:MOST_SHOWN]
    more = f"<p>The first {MOST_SHOWN} pictures are shown; all are in {TABLE}.</p>" if len(fixes) > len(shown) else ""
    made = f"{_text(request.matcher)} with {_text(request.segmenter)}. {_text(located.calibration)}"
    files = f"Files beside this page: {TABLE}, GeoJSON, GPX, KML, TUM."
    parts = [
        "<!doctype html>",
        '<html lang="en"><head><meta charset="utf-8"><meta name="viewport" content="width=device-width">',
        f"<title>{_text(total)} located</title><style>{_STYLE}</style></head><body>",
        f"<h1>{_text(total)} on the map of {_text(located.manifest.title)}</h1>",
        f"<p>{_text(summary)}. Accepted are fixes with P(false fix) of at most {request.most_false:g}.</p>",
        f'<p class="facts">Map of {located.manifest.extract.date}; {made}.</p>',
        _map_html(located),
        _keys_html(located),
        more,
        *(_article(number, fix, request.into) for number, fix in enumerate(shown)),
        f"<footer>Map data {_text(located.manifest.attribution)}. {files}</footer></body></html>",
    ]
    return "\n".join(parts) + "\n"


def _text(value: object) -> str:
    return html.escape(plain(str(value)))


def _article(number: int, fix: Fix, folder: Path) -> str:
    lines = [f"<article id=p{number}><h2>{number + 1}. {_text(fix.file)}</h2>"]
    facts = [f'<b class="state" style="background:{_COLOURS[fix.status]}">{_text(fix.status)}</b>']
    if fix.p_false is not None:
        facts.append(f"P(false fix) {fix.p_false:.3f}")
    if fix.lon is not None and fix.lat is not None and fix.heading_deg is not None:
        word = "at" if fix.is_accepted else "best guess, not accepted:"
        facts.append(f"{word} {fix.lat:.6f}, {fix.lon:.6f} (latitude, longitude), heading {fix.heading_deg:.0f} deg")
    if fix.file_distance_m is not None:
        facts.append(f"{fix.file_distance_m:.0f} m from the position in the file")
    lines.append(f"<p>{facts[0]} {_text('; '.join(facts[1:]))}</p>")
    if fix.reason:
        lines.append(f"<p>{_text(fix.reason)}.</p>")
    if fix.note:
        lines.append(f'<p class="note">{_text(fix.note)}.</p>')
    if strip_file(folder / STRIPS, fix).is_file():
        url = f"{STRIPS}/{strip_file(Path(), fix)}"
        shown = [
            f'<figure><i role="img" aria-label="{one}" style="background-image:url({url});'
            f'background-position:{100 * at / 3:.3f}% 0"></i><figcaption>{one}</figcaption></figure>'
            for at, one in enumerate(PANELS)
        ]
        lines.append(f'<div class="panels">{"".join(shown)}</div>')
    return "\n".join([*lines, "</article>"])


def _keys_html(located: Located) -> str:
    """Return what the colours mean, and what the panels show."""
    keys = [
        f'<span><b style="background:{item.colour}"></b>{_text(item.title)}</span>'
        for item in load_taxonomy().classes
        if item.name in located.manifest.classes
    ]
    keys += [f'<span><b style="background:{HIDDEN}"></b>unknown</span>', "<span>hatched: not mapped</span>"]
    return (
        f'<div class="keys">{"".join(keys)}</div><p class="facts">Panels show the square of ground that was read, the '
        "picture's up upwards; what a photo shows beside it is not used. Evidence is what the matcher gets of what the "
        "segmenter saw: a colour where a class is likelier than not. A place can be right and yet be withheld, where "
        "others fit nearly as well.</p>"
    )


def _map_html(located: Located) -> str:
    """Return the part of the map around the fixes and the discs that were searched, with a mark for each picture."""
    fixes = [fix for fix in located.fixes if fix.x_m is not None and fix.y_m is not None]
    if not fixes:
        return ""
    to_grid = _discs(located, fixes)
    xs = np.array([fix.x_m for fix in fixes] + [disc[0] for disc in to_grid], dtype=float)
    ys = np.array([fix.y_m for fix in fixes] + [disc[1] for disc in to_grid], dtype=float)
    reach = max([disc[2] for disc in to_grid], default=300.0)
    corners = np.array([(xs.min() - reach, ys.max() + reach), (xs.max() + reach, ys.min() - reach)])
    picture, (west, south, east, north) = _Map(located.region).painted(corners)
    encoded = BytesIO()
    Image.fromarray(picture).save(encoded, format="WEBP", quality=82)
    data = base64.b64encode(encoded.getvalue()).decode()
    marks = []
    for x, y, radius in to_grid[:1]:
        marks.append(
            f'<circle cx="{x - west:.1f}" cy="{north - y:.1f}" r="{radius:.1f}" fill="none" stroke="#333" '
            f'stroke-dasharray="12 8" vector-effect="non-scaling-stroke"><title>searched disc of the first picture'
            "</title></circle>"
        )
    size = max(east - west, north - south)
    for number, fix in enumerate(located.fixes):
        if fix.x_m is None or fix.y_m is None or fix.view is None:
            continue
        x, y = fix.x_m - west, north - fix.y_m
        angle = fix.view[2]
        arrow = size / 70
        colour = _COLOURS[fix.status]
        fill = colour if fix.is_accepted else "#fff"
        marks.append(
            f'<a href="#p{number}"><g transform="translate({x:.1f} {y:.1f}) rotate({angle:.1f})"><title>'
            f"{number + 1}. {_text(fix.file)}: {_text(fix.status)}</title>"
            f'<path d="M0 {-arrow:.1f}L{0.62 * arrow:.1f} {0.8 * arrow:.1f}L0 {0.35 * arrow:.1f}L{-0.62 * arrow:.1f} '
            f'{0.8 * arrow:.1f}Z" fill="{fill}" stroke="{colour}" stroke-width="2" '
            'vector-effect="non-scaling-stroke"/></g>'
            f'<text x="{x + arrow:.1f}" y="{y - 0.6 * arrow:.1f}" font-size="{1.3 * arrow:.1f}" fill="#111" '
            f'stroke="#fff" stroke-width="{0.25 * arrow:.2f}" paint-order="stroke">{number + 1}</text></a>'
        )
    bar_m = next(step for step in (5000, 2000, 1000, 500, 200, 100, 50) if step < 0.3 * (east - west) or step == 50)
    at_y = north - south - size / 40
    marks.append(
        f'<path d="M{size / 40:.1f} {at_y:.1f}h{bar_m}" stroke="#111" stroke-width="3" '
        'vector-effect="non-scaling-stroke"/>'
        f'<text x="{size / 40:.1f}" y="{at_y - size / 120:.1f}" font-size="{size / 45:.1f}" stroke="#fff" '
        f'stroke-width="{size / 250:.2f}" paint-order="stroke">{bar_m} m, north is up</text>'
    )
    box = f"0 0 {east - west:.1f} {north - south:.1f}"
    return (
        f'<div class="map"><img alt="the map around the fixes" src="data:image/webp;base64,{data}">'
        f'<svg viewBox="{box}" preserveAspectRatio="none">{"".join(marks)}</svg></div>'
        '<p class="facts">Arrows point where the picture\'s up points, the middle of each is the place of the camera; '
        "filled ones are accepted. Broken line: the disc that was searched for the first picture.</p>"
    )


def _discs(located: Located, fixes: Sequence[Fix]) -> list[tuple[float, float, float]]:
    found = []
    for fix in fixes:
        if fix.prior_lon is not None and fix.prior_lat is not None and fix.prior_radius_m is not None:
            east_m, north_m, _ = to_grid(fix.prior_lon, fix.prior_lat, located.manifest.epsg)
            found.append((east_m, north_m, fix.prior_radius_m))
    return found
