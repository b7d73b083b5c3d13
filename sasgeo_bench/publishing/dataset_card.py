# SPDX-License-Identifier: Apache-2.0
"""`README.md` of a release: the dataset card, whose head tells the `datasets` library where each suite lies."""

from collections.abc import Iterator
from typing import Final

from sasgeo_bench.errors import counted
from sasgeo_bench.publishing.column_texts import QUERY_TEXTS, TRUTH_TEXTS, shown
from sasgeo_bench.publishing.croissant import cite_as
from sasgeo_bench.publishing.release_files import COPYRIGHT_URL, LICENCE_URL, TRUTHS, Release, ReleaseTask, places_of
from sasgeo_bench.regions.region import ATTRIBUTION
from sasgeo_bench.texts import markdown, quoted

CARD: Final = "README.md"
_FIRST_SUITE: Final = "clean"  # what is loaded where no configuration is named
# The size classes of the Hub.
_SIZES: Final = ((1_000, "n<1K"), (10_000, "1K<n<10K"), (100_000, "10K<n<100K"), (1_000_000, "100K<n<1M"))


def card_text(release: Release) -> str:
    """Write the card.

    Parameters
    ----------
    release : Release
        What is in the release.

    Returns
    -------
    str
        Markdown after a YAML head.
    """
    parts = (
        "\n".join(("---", *_head(release), "---")),
        _opening(release),
        _suites(release),
        _regions(release),
        _loading(release),
        _meaning(release),
        _ending(release),
    )
    return "\n\n".join(parts) + "\n"


def _head(release: Release) -> Iterator[str]:
    """Yield YAML for the Hub and for `datasets.load_dataset(folder, configuration)`."""
    size = next((name for most, name in _SIZES if release.queries < most), "n>1M")
    yield "license: odbl"
    yield "pretty_name: sasgeo-bench"
    yield f"attribution: {quoted(ATTRIBUTION)}"
    yield "tags: [geospatial, OpenStreetMap, UAV, map-localization]"
    yield f"size_categories: [{quoted(size)}]"
    yield "configs:"
    first = _FIRST_SUITE if _FIRST_SUITE in release.suites else release.suites[0]
    for suite in release.suites:
        for kind, name in (("queries", suite), ("truth", f"{suite}-{TRUTHS}")):
            tables = release.tables_of(suite, kind=kind)
            if tables:
                yield f"- config_name: {quoted(name)}"
                if name == first:
                    yield "  default: true"
                yield "  data_files:"
                for part, paths in tables.items():
                    yield f"  - split: {quoted(part)}"
                    yield "    path:"
                    yield from (f"    - {quoted(path)}" for path in paths)


def _opening(release: Release) -> str:
    regions, maps = counted(len(release.regions), "region"), counted(len(release.maps), "map")
    files = (
        "`layers.tif` (cloud-optimized GeoTIFF, a band for each class), `features.parquet` and `nodes.parquet` "
        "(GeoParquet 1.1), `edges.parquet`, `region.json`"
    )
    return f"""\
# sasgeo-bench, dataset release {release.version}

Semantic maps of {regions} and {counted(release.queries, "query", "queries")} for map localization of UAVs without
GNSS: each query is a view of a place by a detector that makes errors, and asks where on a map it was taken.
Everything is made from dated OpenStreetMap extracts by {release.made_by}; published {release.published}.

**{ATTRIBUTION}.** The data is under the Open Database License 1.0 ([notice](LICENSE-ODbL.txt), [text]({LICENCE_URL}),
[source]({COPYRIGHT_URL})).

| In this release | What |
|---|---|
| `regions/<map>/` | {maps}: {files} |
| `tasks/<suite>/<map>/` | queries: what a matcher may see |
| `truth/<suite>/<map>/` | answers: {_truth_line(release)} |
| `stac/catalog.json` | the maps as a static STAC catalog |
| `croissant.json` | Croissant 1.1 metadata |
| `datasheet.md` | how the data came to be, what it is for, and what not |
| `imagery/` | imagery, apart from what is derived from OpenStreetMap: none in this release |
| `SHA256SUMS` | `sha256sum -c SHA256SUMS` checks every file |"""


def _truth_line(release: Release) -> str:
    if release.with_truth:
        return "all are in this release"
    told = sorted({part for task in release.tasks for part in task.told})
    if release.split.kind == "crossfit":
        return "none here; in a cross-fit every place is a test place once, so all of them are kept back"
    return f"those of {' and '.join(told)} are here, those of test are kept back" if told else "kept back"


def _suites(release: Release) -> str:
    lines = [
        "## Suites",
        "",
        "| Configuration | What is asked | Split | Queries | Maps | Truths |",
        "|---|---|---|---|---|---|",
    ]
    for suite in release.suites:
        tasks = release.tasks_of(suite)
        for part in release.tables_of(suite):
            own = [task for task in tasks if part in task.parts]
            told = f"`{suite}-{TRUTHS}`" if any(part in task.told for task in own) else "kept back"
            count = sum(task.parts[part] for task in own)
            title = markdown(tasks[0].about["title"])
            lines.append(f"| `{suite}` | {title} | `{part}` | {count} | {len(own)} | {told} |")
    return "\n".join(lines)


def _regions(release: Release) -> str:
    split = release.split
    lines = [
        "## Maps and places",
        "",
        (
            f"Split `{split.id}` ({markdown(split.title)}): places that are used for different purposes keep at least "
            f"{split.buffer_m:g} m apart."
        ),
        "",
        "| Place | Part or half | Regions |",
        "|---|---|---|",
    ]
    for place in places_of(release):
        regions = ", ".join((*place.regions, *place.blocks))
        lines.append(f"| {place.name} | {place.part or f'half {place.half}'} | {regions} |")
    if split.kind == "crossfit":
        lines += [
            "",
            (
                "Each place is tested once. What is learnt for a place comes from the other half; the rest of its own "
                "half calibrates."
            ),
        ]
    lines += ["", "| Map | What | Date | Size | CRS |", "|---|---|---|---|---|"]
    for item in release.maps:
        about = item.manifest
        size = f"{about.cols} x {about.rows} cells of {about.cell_size_m:g} m"
        lines.append(f"| `{item.name}` | {markdown(about.title)} | {about.extract.date} | {size} | EPSG:{about.epsg} |")
    lines += ["", "`name@date` is an older map of a place, `name+suite` one that a suite has edited."]
    return "\n".join(lines)


def _loading(release: Release) -> str:
    suite = _FIRST_SUITE if _FIRST_SUITE in release.suites else release.suites[0]
    task: ReleaseTask = release.tasks_of(suite)[0]
    part = next(iter(task.parts))
    table, name = task.file_of(part), task.map_name
    return f"""\
## Load it

In this folder, with public libraries alone. Queries by [datasets](https://huggingface.co/docs/datasets):

```python
from pathlib import Path

from datasets import load_dataset

folder = str(Path.cwd())  # or where the release was put, or its name on the Hub
queries = load_dataset(folder, "{suite}", split="{part}")
print(len(queries), queries[0]["query_id"], queries[0]["region"])
```

By pandas, with what was seen as an array of class, row and column, 0 absent, 1 present, 2 unknown:

```python
import numpy as np
import pandas as pd

queries = pd.read_parquet("{table}")
row = queries.iloc[0]
packed = np.frombuffer(row["evidence"], dtype=np.uint8)
states = (packed[:, None] >> np.array([0, 2, 4, 6], dtype=np.uint8)) & 3
shape = (len(row["classes"]), row["rows"], row["cols"])
cells = states.ravel()[: np.prod(shape)].reshape(shape)
building = cells[list(row["classes"]).index("building")]
print(cells.shape, (building == 1).sum(), "cells with a building")
```

The map that is searched:

```python
import geopandas as gpd
import pandas as pd
import rasterio

with rasterio.open("regions/{name}/layers.tif") as source:
    layers = source.read()  # 0 absent, 1 present, 255 outside the mapped area
    print(source.descriptions, source.crs, source.tags()["attribution"])
features = gpd.read_parquet("regions/{name}/features.parquet")
nodes = gpd.read_parquet("regions/{name}/nodes.parquet")
edges = pd.read_parquet("regions/{name}/edges.parquet")
print(len(features), len(nodes), len(edges))
```

With sasgeo-bench itself, `sasgeo-bench run --tasks tasks/{suite}/{name}` runs a matcher on it: the folder is laid out
as the program's own."""


def _meaning(release: Release) -> str:
    truths = ""
    if any(task.told for task in release.tasks):
        truths = (
            f"\n\n## Columns of the truths\n\nA row for each query, to be joined by `query_id`.\n\n{shown(TRUTH_TEXTS)}"
        )
    return f"""\
## Columns of the queries

{shown(QUERY_TEXTS)}

Easting and northing are metres in the CRS of the map (`epsg` in its `region.json`); a yaw is a heading, clockwise
from grid north. Outside the mapped area nothing is known, which is not the same as absent.

## What counts as an answer

A matcher searches the map that `region` names and no other: another date of the place, or the map that a suite
edited, would give the world away. An answer depends on its own query alone, never on other queries. Results of
different `prior_group` are not ranked together, and are resampled by place and block, not by single
queries.{truths}"""


def _ending(release: Release) -> str:
    return f"""\
## Licence and citation

{ATTRIBUTION}. Name OpenStreetMap and its contributors where a reader sees it, and offer what is derived from this
data under the ODbL as well ([LICENSE-ODbL.txt](LICENSE-ODbL.txt)). Maps whose name begins with `town-` are made up by
a program; the notice stands on them too.

```bibtex
{cite_as(release)}
```"""
