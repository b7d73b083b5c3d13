# SPDX-License-Identifier: Apache-2.0
"""What the paper leaves open about decoys and descriptor, crossed: the first variant's figures under each reading.

The paper says that decoys have the nearest global descriptors. It does not say of how many windows they are the
nearest, nearest to what, or what a descriptor holds.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import product
from typing import Any, Final, Literal

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from sasgeo_bench.boards.text import markdown_table
from sasgeo_bench.regions.evidence import PRESENT, UNKNOWN, Evidence, cell_offsets_m
from sasgeo_bench.regions.region import Region
from sasgeo_bench.scoring.intervals import (
    DRAWS,
    ClusterDraws,
    bootstrap_means,
    percentile_interval,
    seed_of_text,
    wilson_mean,
)
from sasgeo_bench.scoring.pose import Ranks, hits, reciprocal_ranks
from sasgeo_bench.tasks.suites.base import Seeds
from sasgeo_paper.tables import METRICS, PUBLISHED
from sasgeo_paper.task import SUITE, VERSION, PaperDrawer
from sasgeo_paper.tiles import CANDIDATES, CELL_M, CLASSES, TILES, WINDOW_CELLS, Windows
from sasgeo_paper.trials import Around, draw_crops, draw_transformation, draw_view

Chosen = Literal["counts", "unit", "rings"]
Ranked = Literal["counts", "shares", "unit", "rings"]
Floats = NDArray[np.float64]

CHOSEN: Final[tuple[Chosen, ...]] = ("counts", "unit", "rings")
RANKED: Final[tuple[Ranked, ...]] = ("counts", "shares", "unit", "rings")
AROUND: Final[tuple[Around, ...]] = ("anchor", "truth")
EACH_TILE: Final = (1, 2, 5, 10, 20, 49)
RING_M: Final = (16.0, 32.0, 48.0)  # radii between the rings; the corners are a fourth one
_CELLS: Final = WINDOW_CELLS**2
_FIGURES: Final = tuple(METRICS)


@dataclass(frozen=True, slots=True, kw_only=True)
class Decoys:
    """A reading of the paper's decoys: nearest by `chosen` to the `around`, of `each_tile` windows in each tile.

    "anchor" is a random window, and a random one of the ten is the true place; with "truth" the window itself is.
    Descriptors, of windows of the map:

    - "counts" holds the number of cells of each class;
    - "unit" holds the same, scaled to length 1;
    - "rings" holds the number of cells of each class in each of four rings around the middle.
    """

    chosen: Chosen
    each_tile: int
    around: Around


def every_reading() -> Iterator[Decoys]:
    """Yield all combinations, in the order of the table.

    >>> next(every_reading())
    Decoys(chosen='counts', each_tile=1, around='anchor')
    """
    for chosen, around, each_tile in product(CHOSEN, AROUND, EACH_TILE):
        yield Decoys(chosen=chosen, each_tile=each_tile, around=around)


def ring_of(shape: tuple[int, int]) -> NDArray[np.int64]:
    """Return the ring of each cell of a view, counted from the middle, shape (rows, cols).

    >>> ring_of((96, 96))[48, 48:96:16].tolist(), int(ring_of((96, 96))[0, 0])
    ([0, 1, 2], 3)
    """
    away_m = np.hypot(*cell_offsets_m(shape, CELL_M).T).reshape(shape)
    return np.asarray(np.digitize(away_m, RING_M))


def count_rings(present: NDArray[np.bool_]) -> NDArray[np.int64]:
    """Return the present cells of each class and ring, shape (C, 4), of layers of shape (C, rows, cols)."""
    ring = ring_of(present.shape[1:]).ravel()
    counts = [np.bincount(ring[layer.ravel()], minlength=len(RING_M) + 1) for layer in present]
    return np.stack(counts).astype(np.int64)


@dataclass(frozen=True, kw_only=True)
class Described:
    """All windows, and the descriptors that decoys are chosen by, shape (N, D) each."""

    windows: Windows
    by: dict[Chosen, Floats]

    @classmethod
    def of(cls, region: Region, windows: Windows) -> "Described":
        """Describe every window of a region."""
        half = WINDOW_CELLS // 2
        layers = np.stack([region.layer(name) == PRESENT for name in CLASSES])
        rows, cols = np.rint(region.grid.to_uv(windows.points_m)[:, ::-1]).astype(np.int64).T
        rings = np.stack(
            [
                count_rings(layers[:, row - half : row + half, col - half : col + half]).ravel()
                for row, col in zip(rows, cols, strict=True)
            ]
        )
        counts = windows.counts.astype(np.float64)
        return cls(windows=windows, by={"counts": counts, "unit": unit(counts), "rings": rings.astype(np.float64)})

    def pool(self, decoys: Decoys, rng: np.random.Generator) -> tuple[Windows, NDArray[np.int64]]:
        """Return the windows that decoys are taken from, described as they are chosen, and their numbers."""
        tile = self.windows.tile
        kept = np.arange(len(tile))
        if decoys.each_tile < len(tile) // TILES:
            lot = rng.random(len(tile))
            order = np.lexsort((lot, tile))  # within each tile by lot
            kept = np.sort(order.reshape(TILES, -1)[:, : decoys.each_tile].ravel())
        features = self.by[decoys.chosen]
        windows = replace(self.windows, points_m=self.windows.points_m[kept], tile=tile[kept], counts=features[kept])
        return windows, kept


def unit(vectors: Floats) -> Floats:
    """Scale vectors, shape (N, D), to length 1; zeros stay zeros.

    >>> unit(np.array([[3.0, 4.0], [0.0, 0.0]])).tolist()
    [[0.6, 0.8], [0.0, 0.0]]
    """
    length = np.linalg.norm(vectors, axis=1, keepdims=True)
    return np.asarray(np.divide(vectors, length, out=np.zeros_like(vectors), where=length > 0))


def describe_view(view: Evidence) -> dict[Ranked, Floats]:
    """Describe a view, each shape (D,); a value that cannot be known is NaN.

    "counts" and "unit" count the cells that are seen to be present, so that an unknown cell is as good as absent.
    "shares", which is what `global_descriptor` compares, and "rings" divide by the known cells (of the ring) and are
    scaled back to the cells of a whole view.
    """
    present, known = view.cells == PRESENT, view.cells != UNKNOWN
    counts = present.sum(axis=(1, 2)).astype(np.float64)
    whole = np.bincount(ring_of(view.shape).ravel(), minlength=len(RING_M) + 1)
    in_rings, known_in_rings = count_rings(present), count_rings(known)
    with np.errstate(invalid="ignore", divide="ignore"):
        shares = counts / known.sum(axis=(1, 2)) * _CELLS
        rings = in_rings / known_in_rings * whole
    return {"counts": counts, "shares": shares, "unit": unit(counts[None])[0], "rings": rings.ravel()}


def rank_of(view: Floats, candidates: Floats, true: int) -> tuple[int, int]:
    """Return how many candidates, shape (N, D), are nearer to a view, shape (D,), than the true one, and how many tie.

    >>> rank_of(np.array([1.0, np.nan]), np.array([[1.0, 5.0], [3.0, 0.0], [3.0, 9.0]]), true=1)
    (1, 2)
    """
    squared = np.nansum((candidates - view) ** 2, axis=1)
    is_level = np.isclose(squared, squared[true], rtol=1e-12, atol=0.0)
    return int((~is_level & (squared < squared[true])).sum()), int(is_level.sum())


@dataclass(frozen=True, kw_only=True)
class DecoyTrials:
    """Trials under one reading: places nearer than the true one and level with it, (N, `RANKED`) each; tiles, (N,)."""

    above: NDArray[np.int64]
    tied: NDArray[np.int64]
    tile: NDArray[np.int64]

    def figures(self, ranked: Ranked) -> Floats:
        """Return Recall@1, Recall@5 and reciprocal rank of each trial, shape (N, 3)."""
        at = RANKED.index(ranked)
        ranks = Ranks(above=self.above[:, at], tied=self.tied[:, at], right=np.ones(len(self.tile), dtype=np.int64))
        return np.column_stack((hits(ranks, 1), hits(ranks, 5), reciprocal_ranks(ranks)))


def draw_trials(drawer: PaperDrawer, described: Described, decoys: Decoys, trials: int) -> DecoyTrials:
    """Draw trials under a reading and rank their candidates by every descriptor.

    A trial has the transformation of the same number in the experiment; with `Decoys(chosen="counts", each_tile=49,
    around="anchor")` it is that trial. Smaller pools are drawn anew for each trial, so that no one set decides.
    """
    rows = []
    for index in range(trials):
        seeds = drawer.seeds.under("trial", index)
        pool, numbers = described.pool(decoys, seeds.rng("pool", decoys.each_tile))
        crops = draw_crops(pool, seeds.rng("crops"), around=decoys.around)
        shown = numbers[crops.windows]
        center_m = described.windows.points_m[shown[crops.true]]
        done = draw_transformation(seeds.rng("transformation"))
        seen = describe_view(draw_view(drawer.state, (float(center_m[0]), float(center_m[1])), done, seeds).evidence)
        mapped: dict[Ranked, Floats] = {name: described.by["counts" if name == "shares" else name] for name in RANKED}
        ranks = [rank_of(seen[name], mapped[name][shown], crops.true) for name in RANKED]
        rows.append((*zip(*ranks, strict=True), described.windows.tile[shown[crops.true]]))
    above, tied, tile = zip(*rows, strict=True)
    return DecoyTrials(above=np.array(above), tied=np.array(tied), tile=np.array(tile))


def decoys_frame(region: Region, *, seed: int, trials: int, readings: Sequence[Decoys]) -> pd.DataFrame:
    """Return a row for each reading and descriptor that ranks: three figures with intervals beside the paper's.

    `<figure>_lo` and `<figure>_hi` are 95 % by resampling tiles, then trials within, never narrower than Wilson's,
    which are `<figure>_wilson_lo` and `<figure>_wilson_hi`. `inside` counts the paper's figures within the first,
    `inside_wilson` those within the second.
    """
    drawer = PaperDrawer.of(region, Seeds(root=seed, names=(SUITE, str(VERSION))))
    described = Described.of(region, drawer.windows)
    rows = []
    for decoys in readings:
        drawn = draw_trials(drawer, described, decoys, trials)
        for ranked in RANKED:
            head = {"chosen_by": decoys.chosen, "nearest_to": decoys.around, "windows": decoys.each_tile * TILES}
            rows.append(head | {"ranked_by": ranked, "n": trials} | _figures(drawn, ranked))
    return pd.DataFrame(rows)


def _figures(drawn: DecoyTrials, ranked: Ranked) -> dict[str, float]:
    """Return figures with intervals, and how many of the paper's lie inside."""
    values = drawn.figures(ranked)
    resampled = ClusterDraws(blocks=drawn.tile, seed=seed_of_text("paper decoys"), draws=DRAWS)
    means = bootstrap_means(values, resampled)
    row: dict[str, float] = {}
    inside = inside_wilson = 0
    for at, name in enumerate(_FIGURES):
        wilson = wilson_mean(values[:, at])
        by_tiles = percentile_interval(wilson.value, means[:, at])
        lo, hi = min(by_tiles.lo, wilson.lo), max(by_tiles.hi, wilson.hi)
        paper = getattr(PUBLISHED[0], name)
        row |= {name: wilson.value, f"{name}_lo": lo, f"{name}_hi": hi}
        row |= {f"{name}_wilson_lo": wilson.lo, f"{name}_wilson_hi": wilson.hi}
        inside += lo <= paper <= hi
        inside_wilson += wilson.lo <= paper <= wilson.hi
    return row | {"inside": inside, "inside_wilson": inside_wilson}


def decoys_markdown(table: pd.DataFrame) -> str:
    """Return the table of `decoys_frame` as Markdown, and what it shows in sentences."""
    titles = ["Decoys chosen by", "nearest to the", "of windows", "ranked by", *METRICS.values(), "paper's inside"]
    rows = [
        [row["chosen_by"], row["nearest_to"], str(row["windows"]), row["ranked_by"]]
        + [f"{row[name]:.3f} [{row[f'{name}_lo']:.3f}, {row[f'{name}_hi']:.3f}]" for name in _FIGURES]
        + [f"{row['inside']} of 3"]
        for row in table.to_dict("records")
    ]
    paper = ", ".join(f"{title} {getattr(PUBLISHED[0], name):.3f}" for name, title in METRICS.items())
    lines = [
        "# The global descriptor under other decoys and descriptors",
        "",
        f"{table['n'].iloc[0]} trials of {CANDIDATES} candidates each. The paper: {paper}. Brackets: 95 % by tiles.",
        "",
        *markdown_table(titles, rows),
        "",
        *finding_lines(table),
    ]
    return "\n".join([*lines, ""])


def finding_lines(table: pd.DataFrame) -> Iterator[str]:
    """Yield what the table shows: how many readings hold all three of the paper's figures, and which."""
    for column, how in (("inside", "by tiles"), ("inside_wilson", "Wilson's")):
        held = table[table[column] == len(_FIGURES)]
        yield f"- Intervals {how}: {len(held)} of {len(table)} readings hold all three of the paper's figures" + (
            "." if held.empty else ": " + "; ".join(map(reading_name, held.to_dict("records"))) + "."
        )
    held = table[table["inside"] == len(_FIGURES)]
    verdict = {0: "None holds them: the paper's reading is none of these.", 1: "One holds them."}
    yield "- " + verdict.get(len(held), "Several hold them: which of these the paper's is, is not decided.")


def reading_name(row: dict[Any, Any]) -> str:
    """Return a reading in a few words.

    >>> reading_name({"chosen_by": "unit", "nearest_to": "truth", "windows": 30, "ranked_by": "counts"})
    'by unit, the truth, 30 windows, ranked by counts'
    """
    return f"by {row['chosen_by']}, the {row['nearest_to']}, {row['windows']} windows, ranked by {row['ranked_by']}"
