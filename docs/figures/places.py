# SPDX-License-Identifier: Apache-2.0
"""The tables and the contact sheet of all real places: .venv/bin/python docs/figures/places.py --out out.

`build-region --every` built them before. Views are those of the suite `clean` that overlap no other, of the newest map.
With --scenes it measures the scenes of every real region instead, and writes them into `regions/*.toml`.
"""

import argparse
import re
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cache
from itertools import combinations_with_replacement
from pathlib import Path
from typing import get_args

import cv2
import numpy as np
from numpy.typing import NDArray

from sasgeo_bench.core.errors import ConfigError
from sasgeo_bench.osm.locate import find_extract
from sasgeo_bench.regions import region_files
from sasgeo_bench.regions.layers import read_layers, read_overview
from sasgeo_bench.regions.painting import paint_overview
from sasgeo_bench.regions.proposing import STEP_M
from sasgeo_bench.regions.region import ATTRIBUTION
from sasgeo_bench.regions.region_spec import RegionFile, Scene, list_region_files, read_region_file
from sasgeo_bench.regions.scenes import measure_ground
from sasgeo_bench.tasks.build import read_scene
from sasgeo_bench.tasks.duplicates import ALIKE_M, BLOCK, Arrangements, find_alike
from sasgeo_bench.tasks.split import Part, Place, Split, find_split_file, make_split, read_split_file
from sasgeo_bench.tasks.suites.base import Seeds
from sasgeo_bench.tasks.suites.sites import choose_sites
from sasgeo_bench.tasks.task_plan import Request

SPLIT = "world"
DOCS = Path(__file__).parents[1]
SIDE_PX, TEXT_PX, ACROSS, QUALITY = 112, 14, 14, 62
MOST_VIEWS = 1000  # more than any place here has
HEAD = f"""# Places

Every real place that ships, by part of the split [`{SPLIT}`](../splits/README.md) and country. *km2*: mapped ground.
*Built*: mapped ground in steps of {STEP_M:.0f} m with a building. *Drawn*: mapped ground under any class. *Views*: of
192 m, drawn by the suite `clean`, none of which overlaps another of its region; a place counts with two. A few regions
of one city share up to 1 km2, Runavik and Toftir 2 km2: they are one place, so that no draw of places counts that
ground as two; ground of a place that is a region again under a picture (`-ortho`) counts once. *Sealed* places are
asked by a seed that is given at run time. *Maps*: the dates of all regions of a place. `python docs/figures/places.py
--out out` writes this page and the sheet anew, of what `build-region --every` built.

![A small map of every region, by place](figures/places.webp)

(c) OpenStreetMap contributors, ODbL. Where a file comes from stands in `regions/*.toml`.

| place | country | part | what | maps | km2 | built | drawn | views |
|---|---|---|---|---|---|---|---|---|
"""


@dataclass(frozen=True, kw_only=True)
class Measured:
    """A region as it was built."""

    name: str
    title: str
    country: str
    dates: tuple[str, ...]
    picture: NDArray[np.uint8]
    mapped_km2: float
    built_km2: float
    drawn_share: float
    views: int


def measured(region: str, out: Path) -> Measured:
    """Read a built region, and count its views."""
    spec = read_region_file(list_region_files()[region])
    folder = out / "regions" / region
    manifest = region_files.read_manifest(folder)
    overview = read_overview(folder / region_files.LAYERS, longest_cells=1024)
    layers = read_layers(folder / region_files.LAYERS)
    is_mapped = (layers != 255).all(axis=0)  # beyond the map
    houses = (layers[manifest.classes.index("building")] == 1) & is_mapped
    cells = round(STEP_M / manifest.cell_size_m)  # of a step
    built_cells = (steps(houses, cells) > 0) * steps(is_mapped, cells)
    colours = np.ascontiguousarray(paint_overview(manifest, overview)[..., ::-1])
    scale = SIDE_PX / max(colours.shape[:2])
    west, south, east, north = manifest.bounds_m
    return Measured(
        name=region,
        title=spec.title,
        country=spec.provenance.country or "",
        dates=tuple(extract.date.isoformat() for extract in spec.extract),
        picture=cv2.resize(colours, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA),
        mapped_km2=manifest.coverage.share * (east - west) * (north - south) / 1e6,
        built_km2=float(built_cells.sum() * manifest.cell_size_m**2 / 1e6),
        drawn_share=float(((layers == 1).any(axis=0) & is_mapped).sum() / max(is_mapped.sum(), 1)),
        views=views_of(spec, out),
    )


def steps(mask: NDArray[np.bool_], cells: int) -> NDArray[np.int64]:
    """Return how many cells of a mask each square of so many cells holds."""
    rows, cols = (np.arange(0, length, cells) for length in mask.shape)
    return np.add.reduceat(np.add.reduceat(mask.astype(np.int64), rows), cols, axis=1)


@cache
def split() -> Split:
    """Return the split, on the lattices of its regions."""
    spec = read_split_file(find_split_file(SPLIT))
    files = list_region_files()
    return make_split(spec, {name: read_region_file(files[name]).grid() for name in spec.region_ids})


def views_of(spec: RegionFile, out: Path) -> int:
    """Return how many views the suite `clean` finds that overlap no other."""
    name = "clean"
    request = Request(suite=name, suite_spec=name, region=spec, split=split(), elsewhere=None, count=2, seed=0, out=out)
    suite = request.found
    scene, _ = read_scene(request, suite)
    seeds = Seeds(root=0, names=(spec.id, name, str(suite.card.version)))
    group = suite.card.group
    try:
        return len(choose_sites(scene, suite, count=MOST_VIEWS, seeds=seeds, group=group, may_be_fewer=True))
    except ConfigError:  # none
        return 0


def row_of(place: Place, regions: list[Measured]) -> str:
    """Return the row of a place."""
    first = regions[0]
    what = first.title.partition(": ")[2] or first.title
    days = sorted({date for one in regions for date in one.dates})
    maps = days[0] if len(days) == 1 else f"{len(days)}, {days[0][:4]} to {days[-1][:4]}"
    mapped = sum(one.mapped_km2 for one in regions)
    drawn = sum(one.drawn_share * one.mapped_km2 for one in regions) / mapped
    cells = (
        place.name + (f" ({len(regions)})" if len(regions) > 1 else ""),
        first.country or (place.country or "").replace("-", " ").title(),
        f"{place.part}, sealed" if place.sealed else str(place.part),
        what.replace("|", "/"),
        maps,
        f"{mapped:.1f}",
        f"{sum(one.built_km2 for one in regions):.1f}",
        f"{drawn:.0%}",
        str(sum(one.views for one in regions)),
    )
    return f"| {' | '.join(cells)} |"


def sheet_of(regions: list[Measured]) -> NDArray[np.uint8]:
    """Return the small maps in rows, each above its name."""
    rows = -(-len(regions) // ACROSS)
    sheet = np.full((rows * (SIDE_PX + TEXT_PX) + TEXT_PX, ACROSS * SIDE_PX, 3), 255, dtype=np.uint8)
    for number, one in enumerate(regions):
        top, left = number // ACROSS * (SIDE_PX + TEXT_PX), number % ACROSS * SIDE_PX
        height, width = one.picture.shape[:2]
        sheet[top : top + height, left : left + width] = one.picture
        write(sheet, one.name[:18], (left, top + SIDE_PX + TEXT_PX - 4))
    write(sheet, ATTRIBUTION, (2, sheet.shape[0] - 3))
    return sheet


def write(sheet: NDArray[np.uint8], text: str, place: tuple[int, int]) -> None:
    """Write a line of text."""
    cv2.putText(sheet, text, place, cv2.FONT_HERSHEY_SIMPLEX, 0.33, (40, 40, 40), 1, cv2.LINE_AA)


def own_ground(regions: Sequence[str]) -> list[str]:
    """Return the regions of a place without those that are ground of another under a picture; at least one."""
    files = list_region_files()
    return [one for one in regions if not read_region_file(files[one]).imagery] or [regions[0]]


def rows_and_maps(out: Path) -> Iterator[tuple[str, list[Measured]]]:
    """Yield the row and the regions of each place of the split."""
    for place in split().spec.place:
        regions = [measured(region, out) for region in own_ground(place.region_ids)]
        yield row_of(place, regions), regions


def left_out() -> list[str]:
    """Return the regions with a country that the split does not have."""
    specs = [read_region_file(path) for path in list_region_files().values()]
    return sorted(spec.id for spec in specs if spec.provenance.country and spec.id not in split().spec.region_ids)


def scenes_table() -> str:
    """Return how many regions of each part have each scene."""
    files, parts = list_region_files(), get_args(Part)
    counts = Counter(
        (scene, place.part)
        for place in split().spec.place
        for region in own_ground(place.region_ids)
        for scene in read_region_file(files[region]).scenes
    )
    rows = [[scene, *(str(counts[scene, part]) for part in parts)] for scene in get_args(Scene)]
    return "\n".join(f"| {' | '.join(row)} |" for row in [["scene", *parts], ["---"] * (1 + len(parts)), *rows])


def look_alikes(out: Path, *, as_drawn: bool) -> str:
    """Return the row of a table: blocks of ten, pairs that are alike across parts and within, and the nearest pair."""
    maps: dict[str, list[tuple[str, Arrangements]]] = {}
    for place in split().spec.place:
        for region in place.region_ids:
            features = region_files.read_features(out / "regions" / region)
            found = Arrangements.of(features, as_drawn=as_drawn)
            maps.setdefault(str(place.part), []).append((place.name, found))
    joined = {part: Arrangements.joined([one for _, one in rows]) for part, rows in maps.items()}
    places = {part: np.repeat([name for name, _ in rows], [len(one) for _, one in rows]) for part, rows in maps.items()}
    pairs: Counter[str] = Counter()
    for one, two in combinations_with_replacement(joined, 2):
        if one == two and as_drawn:
            continue  # rows of garages: too many pairs
        alike = find_alike(joined[one], joined[two])
        if one != two:
            pairs["parts"] += len(alike.first)
            continue
        is_inside = places[one][alike.first] == places[two][alike.second]
        pairs["place"] += int(is_inside.sum()) // 2  # a pair is found from either side
        pairs["part"] += int((~is_inside).sum()) // 2
    inside = ["not counted"] * 2 if as_drawn else [str(pairs["place"]), str(pairs["part"])]
    label = "as they are drawn" if as_drawn else "touching ones as one"
    return f"| {label} | {sum(map(len, joined.values())):,} | {' | '.join(inside)} | {pairs['parts']} |"


def more_sections(out: Path) -> str:
    """Return the sections below the table of places."""
    return f"""## Scenes

Regions by [scene](howto/region.md#many-places-at-once) and part; a region may have several.

{scenes_table()}

No region is `desert`: no map has 15 % of bare ground (the whole of Andorra, in no part, has 14 %), for deserts are
hardly mapped, and what is not mapped cannot be told from what is empty. `alpine` needs heights, which a map lacks, and
is no longer told.

## Look-alike buildings

Each building with its nine nearest ones is a block of ten. Two blocks are alike if, once one is moved and rotated, no
outline is farther than {ALIKE_M:g} m from the other's (Hausdorff distance); pairs that share a building do not count.
Pairs of blocks of {BLOCK}:

| buildings | blocks | alike in one place | in two places of one part | in two parts |
|---|---|---|---|---|
{look_alikes(out, as_drawn=False)}
{look_alikes(out, as_drawn=True)}

As they are drawn, rows of garages and of terraced houses are blocks of ten, and rows of equal width stand in many
countries. Of the pairs across parts one was looked at for each of the 15 pairs of places of train and test that have
any: all are of units that touch one another. On a map of cells such a row is one shape, so touching buildings count as
one; that rule was made after the look. With it no block of ten stands in two parts. `sasgeo-bench verify world` says
so.
"""


def measure_scenes() -> None:
    """Write the measured scenes into the file of every region of an OSM extract."""
    for path in list_region_files().values():
        spec = read_region_file(path)
        extract = spec.pick(None)
        if extract.town is None and extract.format != "geojson":
            write_scenes(path, measure_ground(find_extract(extract), spec.grid(), at=extract.date).scenes())


def write_scenes(path: Path, scenes: list[Scene]) -> None:
    """Replace the line of scenes of a region file."""
    listed = ", ".join(f'"{scene}"' for scene in scenes)
    text = re.sub(r"(?m)^scenes = \[.*\]$", f"scenes = [{listed}]", path.read_text(encoding="utf-8"))
    path.write_text(text, encoding="utf-8")


def main() -> None:
    """Write docs/places.md and docs/figures/places.webp, or scenes."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, default=Path("out"))
    parser.add_argument("--scenes", action="store_true")
    given = parser.parse_args()
    if given.scenes:
        measure_scenes()
        return
    found = list(rows_and_maps(given.out))
    sheet = sheet_of([one for _, regions in found for one in regions])
    cv2.imwrite(str(DOCS / "figures" / "places.webp"), sheet, [cv2.IMWRITE_WEBP_QUALITY, QUALITY])
    text = (
        HEAD
        + "\n".join(row for row, _ in found)
        + f"\n\nIn no part, for want of two views: {', '.join(left_out())}.\n\n"
        + more_sections(given.out)
    )
    (DOCS / "places.md").write_text(text, encoding="utf-8")


if __name__ == "__main__":
    main()
