# SPDX-License-Identifier: Apache-2.0
"""Write `places.md`: how far apart the maps of each place of split `places` are, and what they hold."""

import argparse
import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import shapely

from sasgeo_bench.core.progress import reporting
from sasgeo_bench.regions.build import build_region, plan_build
from sasgeo_bench.regions.region import ATTRIBUTION
from sasgeo_bench.regions.region_files import read_region
from sasgeo_bench.regions.region_spec import RegionFile, list_region_files, read_region_file
from sasgeo_bench.tasks.split import Block, Split, find_split
from sasgeo_bench.tasks.suites.ages import DAYS_PER_YEAR

SPLIT: Final = "places"
LEAST_YEARS: Final = (8.0, 5.0, 2.0)
HEAD: Final = f"""\
# Places with maps of several dates

Made by `.venv/bin/python docs/ageing/places.py`, which reads SASGEO_EXTRACTS and takes ten minutes if no region is
built.

Places of the split `{SPLIT}` whose region has more than one date. Buildings and kilometres of road (major and minor)
are those within the blocks of the place, on its first and on its last map. A first map without buildings is one of
roads.

| place | country | half | dates | first | last | years | buildings | roads, km |
| --- | --- | --- | --- | --- | --- | --- | --- | --- |"""


@dataclass(frozen=True, kw_only=True)
class Stock:
    """What a map holds within some blocks: number of buildings, and the length of its roads."""

    buildings: int
    roads_km: float


def stock_of(spec: RegionFile, blocks: Sequence[Block], *, is_newest: bool, out: Path) -> Stock:
    """Count on the first or the newest map of a region, built if it is not there."""
    dates = [item.date for item in spec.extract]
    plan = plan_build(spec, out=out, date=max(dates) if is_newest else min(dates))
    if not plan.is_current:
        with reporting(_tell):
            build_region(plan)
    features = read_region(plan.folder).features
    seen = features[features["is_visible"]]
    area = shapely.union_all([block.polygon() for block in blocks])
    houses = seen.geometry[seen["class"] == "building"].centroid
    roads = seen.geometry[seen["class"].isin(["road_major", "road_minor"]) & (seen.geometry.geom_type != "Polygon")]
    return Stock(buildings=int(houses.within(area).sum()), roads_km=float(roads.intersection(area).length.sum()) / 1000)


def dated_places(split: Split) -> Iterator[tuple[str, RegionFile]]:
    """Yield the real places of one region with several dates, in the order of the split."""
    files = {name: read_region_file(path) for name, path in list_region_files().items()}
    for place in split.spec.place:
        (first, *others) = (files[name] for name in place.region_ids)
        if not others and len(first.extract) > 1 and first.extract[0].town is None:
            yield place.name, first


def years_of(spec: RegionFile) -> float:
    """Years between the first and the last map of a region."""
    dates = [item.date for item in spec.extract]
    return (max(dates) - min(dates)).days / DAYS_PER_YEAR


def facts_of(split: Split, place: str, spec: RegionFile) -> list[str]:
    """Cells of a place's row that need no map: name, country, half, dates, first, last, years."""
    dates = sorted(item.date for item in spec.extract)
    ends = [dates[0].isoformat(), dates[-1].isoformat()]
    return [place, split.country_of[place], split.half_of[place], str(len(dates)), *ends, f"{years_of(spec):.1f}"]


def summary(split: Split) -> str:
    """Count the places, and their countries, whose maps lie so many years apart."""
    rows = ["| maps apart by at least | places | countries |", "| --- | --- | --- |"]
    for least in LEAST_YEARS:
        found = [place for place, spec in dated_places(split) if years_of(spec) >= least]
        rows.append(f"| {least:g} years | {len(found)} | {len({split.country_of[place] for place in found})} |")
    return "\n".join(rows)


def _tell(line: str) -> None:
    sys.stderr.write(f"{line}\n")


def main() -> None:
    """Write the page beside this file."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, default=Path("out"), help="root of what is built (default: out)")
    out = parser.parse_args().out
    split = find_split(SPLIT)
    lines = [HEAD]
    for place, spec in dated_places(split):
        blocks = split.blocks[place]
        old, new = (stock_of(spec, blocks, is_newest=is_newest, out=out) for is_newest in (False, True))
        counts = [f"{old.buildings:,} to {new.buildings:,}", f"{old.roads_km:.0f} to {new.roads_km:.0f}"]
        lines.append(f"| {' | '.join(facts_of(split, place, spec) + counts)} |")
        _tell(lines[-1])
    text = "\n".join([*lines, "", summary(split), "", ATTRIBUTION, ""])
    Path(__file__).with_name("places.md").write_text(text, encoding="utf-8")


if __name__ == "__main__":
    main()
