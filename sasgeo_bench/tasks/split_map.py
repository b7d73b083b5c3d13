# SPDX-License-Identifier: Apache-2.0
"""Map of a split: every place with its blocks, coloured by part."""

from pathlib import Path
from typing import Final

import numpy as np
import shapely
from matplotlib.patches import Patch, Polygon
from numpy.typing import NDArray

from sasgeo_bench.core.canvas import Page, page, panels, without_ticks
from sasgeo_bench.geometry.projection import between
from sasgeo_bench.regions.region import ATTRIBUTION
from sasgeo_bench.tasks.split import HALVES, Block, Split

# Blue, orange and green of Okabe and Ito, which colour-blind readers can distinguish.
COLOURS: Final = {"train": "#0072b2", "calibration": "#e69f00", "test": "#009e73", "a": "#0072b2", "b": "#e69f00"}
_COLUMNS: Final = 6


def write_split_map(path: Path, split: Split) -> None:
    """Write a PNG with a panel for each place: its blocks in true shape, and a scale bar of one kilometre."""
    parts = sorted({colour_of(split, place) for place in split.blocks}, key=list(COLOURS).index)
    names: dict[str, str] = {half: f"half {half}: test, calibration; train for the other" for half in HALVES}
    about = Page(
        title=f"{split.spec.id}: {split.spec.title}",
        facts="blocks of about 1 km; the bar is 1 km; panels are not to one scale",
        data=ATTRIBUTION,
        rows=-(-len(split.blocks) // _COLUMNS),
        columns=_COLUMNS,
        panel_inches=(2.0, 2.0),
        keys=[Patch(facecolor=COLOURS[part], label=names.get(part, part)) for part in parts],
    )
    places = list(split.blocks)
    with page(path, about) as charts:
        for at, chart in panels(charts, len(places)):
            blocks = split.blocks[places[at]]
            colour = COLOURS[colour_of(split, places[at])]
            outlines = [_outline_m(block, blocks[0]) for block in blocks]
            for outline in outlines:
                chart.add_patch(Polygon(outline, closed=True, facecolor=colour, edgecolor="white", lw=0.5))
            west, south, east, north = shapely.total_bounds([shapely.Polygon(outline) for outline in outlines])
            half_m = max(east - west, north - south) / 2 * 1.12
            x_m, y_m = (west + east) / 2, (south + north) / 2
            chart.set(xlim=(x_m - half_m, x_m + half_m), ylim=(y_m - half_m, y_m + half_m))
            without_ticks(chart)
            left_m, bottom_m = x_m - half_m * 0.95, y_m - half_m * 0.95
            chart.plot([left_m, left_m + 1000], [bottom_m, bottom_m], color="black", lw=2)
            chart.set_title(f"{places[at]} ({len(blocks)})")


def colour_of(split: Split, place: str) -> str:
    """Return the key of a place's colour: its half in a cross-fit, else its part."""
    return split.half_of.get(place) or split.part_of(place)


def _outline_m(block: Block, origin: Block) -> NDArray[np.float64]:
    """Return the corners of a block in metres around the first block of the place, accurate enough for a picture."""
    corners = np.array(block.polygon().exterior.coords)[:-1]
    if block.epsg == origin.epsg:
        return corners
    change = between(block.epsg, origin.epsg)
    return np.column_stack(change.transform(*corners.T))
