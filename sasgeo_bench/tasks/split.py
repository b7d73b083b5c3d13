# SPDX-License-Identifier: Apache-2.0
"""Splits of blocks into train, calibration and test; parts that come too near each other are refused."""

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import combinations
from pathlib import Path
from typing import Annotated, ClassVar, Final, Literal, Self

import numpy as np
import pyproj
import shapely
from pydantic import Field, model_validator

from sasgeo_bench.core.config import Document, Line, NamedDocument, find_document, list_documents, read_document
from sasgeo_bench.core.errors import ConfigError
from sasgeo_bench.geometry.grid import Grid
from sasgeo_bench.geometry.projection import between, to_lonlat
from sasgeo_bench.regions.region_spec import list_region_files, read_region_file

Part = Literal["train", "calibration", "test"]
Half = Literal["a", "b"]
HALVES: Final[tuple[Half, ...]] = ("a", "b")

_GEOD: Final = pyproj.Geod(ellps="WGS84")


class Place(Document):
    """Regions or blocks that always stay together; a hold-out gives each a `part`, a cross-fit a `half`.

    A `sealed` place is a test place whose queries are drawn only with a seed that is given at run time. Nothing is ever
    learned from it or calibrated on it.
    Places of one `country` have the same mappers: they all stand in one part or half, and cluster together.
    """

    without_empty: ClassVar = frozenset({"sealed", "country"})

    name: Annotated[str, Field(pattern=r"^[a-z0-9][a-z0-9-]*$")]
    regions: list[str] = []
    blocks: list[str] = []
    part: Part | None = None
    half: Half | None = None
    sealed: bool = False
    country: Annotated[str, Field(pattern=r"^[a-z0-9][a-z0-9-]*$")] | None = None

    @model_validator(mode="after")
    def _holds_something(self) -> Self:
        if not self.regions and not self.blocks:
            raise ValueError(f"place {self.name!r} needs regions or blocks")
        if self.sealed and self.blocks:
            raise ValueError(
                f"place {self.name!r} is sealed, and names single blocks: a sealed place needs whole regions"
            )
        if self.sealed and self.part not in {None, "test"}:
            raise ValueError(
                f"place {self.name!r} is sealed, and its part is {self.part!r}: a sealed place can only test"
            )
        return self

    @property
    def region_ids(self) -> tuple[str, ...]:
        """Return the regions that the place has blocks of, in the order of the file."""
        return tuple(dict.fromkeys((*self.regions, *(name.split("/")[0] for name in self.blocks))))


class SplitFile(NamedDocument):
    """Contents of a file in `splits/`.

    `lends` are regions beside its places whose imagery serves for views of another town where no place has any:
    nothing is drawn on their maps, learned from them or calibrated on them.
    """

    without_empty: ClassVar = frozenset({"lends"})

    id: Annotated[str, Field(pattern=r"^[a-z0-9][a-z0-9-]*$")]
    title: Line
    kind: Literal["holdout", "crossfit"]
    buffer_m: Annotated[float, Field(ge=0, le=1e6)]
    block_m: Annotated[float, Field(ge=100, le=20_000)] = 1000.0
    reach_m: Annotated[float, Field(ge=0, le=5000)] = 360.0
    place: Annotated[list[Place], Field(min_length=1)]
    lends: list[str] = []

    @model_validator(mode="after")
    def _lends_beside_its_places(self) -> Self:
        asked = next((region for region in self.lends if region in self.region_ids), None)
        if asked is not None:
            raise ValueError(f"region {asked!r} stands under 'lends' and in a place: take it out of one of them")
        return self

    @model_validator(mode="after")
    def _is_consistent(self) -> Self:
        names = [place.name for place in self.place]
        regions = [region for place in self.place for region in place.regions]
        for what, listed in (("place", names), ("region", regions)):
            twice = sorted({name for name in listed if listed.count(name) > 1})
            if twice:
                raise ValueError(f"{what} {twice[0]!r} is listed twice")
        for name, kind in (("part", "holdout"), ("half", "crossfit")):
            is_needed = self.kind == kind
            wrong = next((place.name for place in self.place if (getattr(place, name) is not None) != is_needed), None)
            if wrong is not None:
                kinds = {"part": "a cross-fit", "half": "a hold-out"}
                needed = "part: train, calibration or test" if name == "part" else "half: a or b"
                fault = f"needs a {needed}" if is_needed else f"must not have a {name} in {kinds[name]}: leave it out"
                raise ValueError(f"place {wrong!r} {fault}")
        sides: dict[str, str] = {}
        for place in self.place:
            side = place.part or f"half {place.half}"
            if place.country and sides.setdefault(place.country, side) != side:
                raise ValueError(
                    f"country {place.country!r} is in {sides[place.country]} and, with {place.name!r}, in {side}: put "
                    "all its places on one side"
                )
        for half in HALVES if self.kind == "crossfit" else ():
            own = [place for place in self.place if place.half == half]
            # Two places of a half: one is tested, and another one calibrates
            if sum(not place.sealed for place in own) < 2:
                open_ones = "two places that are not sealed" if any(place.sealed for place in own) else "two places"
                raise ValueError(f"half {half!r} needs {open_ones} at least: one is tested, and another one calibrates")
            if len({place.country or place.name for place in own if not place.sealed}) == 1:
                raise ValueError(
                    f"half {half!r} needs places of two countries: those of one do not calibrate each other"
                )
        return self

    @property
    def region_ids(self) -> tuple[str, ...]:
        """Return every region of the split, in the order of the file."""
        return tuple(dict.fromkeys(region for place in self.place for region in place.region_ids))


@dataclass(frozen=True, slots=True, kw_only=True)
class Block:
    """One evaluation block: a rectangle of about `block_m` within a region; queries are centred in it."""

    region: str
    row: int
    col: int
    epsg: int
    bounds_m: tuple[float, float, float, float]

    @property
    def id(self) -> str:
        """Return region, row and column, as in "vaduz/0-3"."""
        return f"{self.region}/{self.row}-{self.col}"

    def holds(self, en_m: tuple[float, float]) -> bool:
        """Return whether a place is inside; a shared edge belongs to the block north or east of it."""
        west, south, east, north = self.bounds_m
        return west <= en_m[0] < east and south <= en_m[1] < north

    def polygon(self) -> shapely.Polygon:
        """Return the rectangle in the region's CRS."""
        return shapely.box(*self.bounds_m)


def blocks_of(region: str, grid: Grid, *, block_m: float = 1000.0) -> tuple[Block, ...]:
    """Tile a region, from the north-west, by equal blocks with sides as near to `block_m` as possible.

    Examples
    --------
    >>> grid = Grid(epsg=32632, west_m=0.0, north_m=4096.0, cell_size_m=1.0, rows=4096, cols=3072)
    >>> blocks = blocks_of("vaduz", grid)
    >>> len(blocks), blocks[-1].id, blocks[0].bounds_m
    (12, 'vaduz/3-2', (0.0, 3072.0, 1024.0, 4096.0))
    """
    west, south, east, north = grid.bounds_m
    rows, cols = max(1, round((north - south) / block_m)), max(1, round((east - west) / block_m))
    easts, norths = np.linspace(west, east, cols + 1).tolist(), np.linspace(north, south, rows + 1).tolist()
    return tuple(
        Block(
            region=region,
            row=row,
            col=col,
            epsg=grid.epsg,
            bounds_m=(easts[col], norths[row + 1], easts[col + 1], norths[row]),
        )
        for row in range(rows)
        for col in range(cols)
    )


@dataclass(frozen=True, kw_only=True)
class Fold:
    """One use of a split: every place in one part; sealed places are in none but the test part.

    `held_out` is the test place of a cross-fit fold. The rest of its half calibrates, but for its country, and the
    other half trains, so that one training serves a whole half, on places that neither test nor calibrate it.
    """

    held_out: str | None
    part_of: Mapping[str, Part]


@dataclass(frozen=True, kw_only=True)
class Split:
    """A checked split: place -> blocks, and the folds that use them."""

    spec: SplitFile
    blocks: Mapping[str, tuple[Block, ...]]

    @cached_property
    def folds(self) -> tuple[Fold, ...]:
        """Return one fold of a hold-out; one for each place of a cross-fit."""
        if self.spec.kind == "holdout":
            return (Fold(held_out=None, part_of={place.name: place.part or "test" for place in self.spec.place}),)
        return tuple(_fold(self.spec, place.name) for place in self.spec.place)

    @cached_property
    def place_of(self) -> Mapping[str, str]:
        """Return block id -> place."""
        return {block.id: place for place, blocks in self.blocks.items() for block in blocks}

    @cached_property
    def half_of(self) -> Mapping[str, Half]:
        """Return place -> half of a cross-fit; empty for a hold-out."""
        return {place.name: place.half for place in self.spec.place if place.half is not None}

    @cached_property
    def sealed(self) -> tuple[str, ...]:
        """Return the names of the sealed places, in the order of the file."""
        return tuple(place.name for place in self.spec.place if place.sealed)

    def sealed_place(self, region: str) -> str | None:
        """Return the sealed place that a region lies in; None if it lies in none."""
        return next((place for place in self.places_in(region) if place in self.sealed), None)

    @cached_property
    def country_of(self) -> Mapping[str, str]:
        """Return place -> country, the second level of clustering; the place itself where no country is given."""
        return {place.name: place.country or place.name for place in self.spec.place}

    def places_in(self, region: str) -> tuple[str, ...]:
        """Return the places that hold blocks of a region."""
        return self._places_by_region.get(region, ())

    @cached_property
    def _places_by_region(self) -> Mapping[str, tuple[str, ...]]:
        found: dict[str, dict[str, None]] = {}
        for place, blocks in self.blocks.items():
            for block in blocks:
                found.setdefault(block.region, {})[place] = None
        return {region: tuple(places) for region, places in found.items()}

    def blocks_in(self, region: str) -> tuple[Block, ...]:
        """Return the blocks of one region, by rows."""
        found = [block for blocks in self.blocks.values() for block in blocks if block.region == region]
        return tuple(sorted(found, key=lambda block: (block.row, block.col)))

    def part_of(self, place: str) -> str:
        """Return the group that must keep away from others: the part in a hold-out, the place in a cross-fit."""
        return place if self.spec.kind == "crossfit" else self.folds[0].part_of[place]

    def part_in_task(self, block: Block) -> str:
        """Return the part of a block's queries; "crossfit" if every place is tested in its fold."""
        return "crossfit" if self.spec.kind == "crossfit" else self.folds[0].part_of[self.place_of[block.id]]

    def to_text(self) -> str:
        """Return a line for each place and its part, and the nearest distance between parts."""
        lines = [
            f"{self.spec.id}: {self.spec.title} ({self.spec.kind}, at least {self.spec.buffer_m:g} m between parts)"
        ]
        for place in self.spec.place:
            count, part = len(self.blocks[place.name]), place.part or f"half {place.half}"
            regions = ", ".join(dict.fromkeys(block.region for block in self.blocks[place.name]))
            blocks = f"{count:4d} {'block' if count == 1 else 'blocks':6s}"
            mark = " (sealed)" if place.sealed else ""
            lines.append(f"  {part:12s} {place.name:18s} {blocks}  {regions}{mark}")
        near = nearest_pair(self)
        if self.half_of:
            lines.append(
                "  each place is tested in its own fold: the rest of its half calibrates, the other half trains"
            )
        if near is not None:
            lines.append(f"  nearest blocks of two parts: {near.first} and {near.second}, {near.gap_m:,.0f} m")
        return "\n".join(lines)


def _fold(spec: SplitFile, held_out: str) -> Fold:
    """Hold one place out: the rest of its half calibrates, the other half trains."""
    # Sealed places do neither, nor do other places of its country, whose mappers it shares.
    own = next(place for place in spec.place if place.name == held_out)
    others = [place for place in spec.place if not place.sealed and (not own.country or place.country != own.country)]
    parts: dict[str, Part] = {place.name: "calibration" if place.half == own.half else "train" for place in others}
    return Fold(held_out=held_out, part_of=parts | {held_out: "test"})


def make_split(spec: SplitFile, grids: Mapping[str, Grid]) -> Split:
    """Lay out the blocks of a split on the grids of all regions, and check that no two parts meet.

    Raises
    ------
    ConfigError
        If a region or block is unknown, a block is in two places, or blocks of two parts are nearer than the buffer and
        the reach of the queries' footprints allow.
    """
    unknown = [region for region in (*spec.region_ids, *spec.lends) if region not in grids]
    if unknown:
        own = "list regions shows all that ship; --region-files names a folder of your own"
        mend = "a block stands under 'blocks'" if "/" in unknown[0] else own
        raise ConfigError(f"split {spec.id!r} names the unknown region {unknown[0]!r}: {mend}")
    blocks = {place.name: _blocks_of_place(spec, place, grids) for place in spec.place}
    split = Split(spec=spec, blocks=blocks)
    seen: dict[str, str] = {}
    for place, listed in blocks.items():
        for block in listed:
            if seen.setdefault(block.id, place) != place:
                raise ConfigError(f"split {spec.id!r}: block {block.id} stands in {seen[block.id]!r} and in {place!r}")
    near = nearest_pair(split, within_m=spec.buffer_m + 2 * spec.reach_m)
    if near is not None and near.gap_m - 2 * spec.reach_m < spec.buffer_m:
        raise ConfigError(
            f"split {spec.id!r}: blocks {near.first} and {near.second} of different parts are {near.gap_m:.0f} m "
            f"apart; footprints reach {spec.reach_m:g} m beyond each, and {spec.buffer_m:g} m must stay between them"
        )
    return split


def _blocks_of_place(spec: SplitFile, place: Place, grids: Mapping[str, Grid]) -> tuple[Block, ...]:
    found = [block for region in place.regions for block in blocks_of(region, grids[region], block_m=spec.block_m)]
    for name in place.blocks:
        region = name.split("/")[0]
        known = {block.id: block for block in blocks_of(region, grids[region], block_m=spec.block_m)}
        if name not in known:
            raise ConfigError(f"split {spec.id!r} names the unknown block {name!r}; {region} has {', '.join(known)}")
        found.append(known[name])
    return tuple(found)


@dataclass(frozen=True, slots=True, kw_only=True)
class Pair:
    """Two blocks of different parts and the metres between them."""

    first: str
    second: str
    gap_m: float


def nearest_pair(split: Split, *, within_m: float = math.inf) -> Pair | None:
    """Return the nearest two blocks of different parts (places in a cross-fit), or None if all are farther apart."""
    parts: dict[str, list[Block]] = {}
    for place, blocks in split.blocks.items():
        parts.setdefault(split.part_of(place), []).extend(blocks)
    return nearest_blocks(parts, within_m=within_m)


def nearest_blocks(parts: Mapping[str, Sequence[Block]], *, within_m: float = math.inf) -> Pair | None:
    """Return the nearest two blocks of different groups, or None if all are farther apart.

    Distances are between the outlines: in the CRS of the first block, after a lower bound on the ellipsoid.
    """
    groups: dict[tuple[str, str], list[Block]] = {}
    for part, blocks in parts.items():
        for block in blocks:
            groups.setdefault((part, block.region), []).append(block)
    pairs = sorted(_group_pairs(groups), key=lambda item: item[0])
    best: Pair | None = None
    for least_m, first, second in pairs:
        if least_m > min(within_m, best.gap_m if best else math.inf):
            break
        found = min(_gaps(first, second), key=lambda pair: pair.gap_m)
        if found.gap_m <= within_m and (best is None or found.gap_m < best.gap_m):
            best = found
    return best


def _group_pairs(groups: Mapping[tuple[str, str], list[Block]]) -> Iterator[tuple[float, list[Block], list[Block]]]:
    """Yield pairs of groups of different parts with a lower bound of their distance, metres."""
    pairs = [(first, second) for first, second in combinations(groups, 2) if first[0] != second[0]]
    if not pairs:
        return
    discs = {key: _disc(blocks) for key, blocks in groups.items()}
    both = np.array([(discs[first], discs[second]) for first, second in pairs])
    (lon_a, lat_a, radius_a), (lon_b, lat_b, radius_b) = np.moveaxis(both, 0, -1)
    apart_m = _GEOD.inv(lon_a, lat_a, lon_b, lat_b)[2] - 1.01 * (radius_a + radius_b)
    for (first, second), least_m in zip(pairs, np.maximum(apart_m, 0.0).tolist(), strict=True):
        yield least_m, groups[first], groups[second]


def _disc(blocks: list[Block]) -> tuple[float, float, float]:
    """Return longitude and latitude of a centre, and a radius in metres that holds all blocks of one region."""
    west, south, east, north = shapely.total_bounds([block.polygon() for block in blocks])
    lon_deg, lat_deg = to_lonlat(blocks[0].epsg).transform((west + east) / 2, (south + north) / 2)
    return (lon_deg, lat_deg, math.hypot(east - west, north - south) / 2)


def _gaps(first: Iterable[Block], second: Iterable[Block]) -> Iterator[Pair]:
    for a in first:
        for b in second:
            outline = b.polygon()
            if a.epsg != b.epsg:
                change = between(b.epsg, a.epsg)
                fine = shapely.segmentize(outline, 100.0)
                outline = shapely.transform(fine, lambda at, to=change: np.column_stack(to.transform(*at.T)))
            yield Pair(first=a.id, second=b.id, gap_m=float(shapely.distance(a.polygon(), outline)))


def read_split_file(path: Path) -> SplitFile:
    """Read one split file; raise as `read_document` does."""
    return read_document(path, SplitFile, "splits")


def list_split_files(*, folders: Sequence[Path] = ()) -> dict[str, Path]:
    """Return split id -> file, of the given and the shipped folders."""
    return list_documents("splits", SplitFile, folders)


def find_split_file(id_or_path: str) -> Path:
    """Find a split file by its id or path; raise as `find_document` does."""
    return find_document(id_or_path, "split", "or name a .toml file", list_split_files)


def find_split(id_or_path: str, *, folders: Sequence[Path] = ()) -> Split:
    """Return the checked split of an id or file, laid out on all known regions; raise as `make_split` does."""
    grids = {item: read_region_file(path).grid() for item, path in list_region_files(folders=folders).items()}
    return make_split(read_split_file(find_split_file(id_or_path)), grids)
