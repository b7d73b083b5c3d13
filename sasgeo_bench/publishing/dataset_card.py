# SPDX-License-Identifier: Apache-2.0
"""`README.md` and `datasheet.md` of a release: dataset card, and the questions of Gebru et al. answered."""

from collections import Counter
from collections.abc import Iterable, Iterator, Mapping
from typing import Final

from sasgeo_bench.errors import counted
from sasgeo_bench.publishing.release_files import (
    COPYRIGHT_URL,
    LICENCE_URL,
    TRUTHS,
    Release,
    ReleaseMap,
    ReleaseTask,
    places_of,
)
from sasgeo_bench.publishing.release_metadata import QUERY_TEXTS, TRUTH_TEXTS, cite_as
from sasgeo_bench.regions.region import ATTRIBUTION, MADE_UP
from sasgeo_bench.texts import markdown, markdown_code, quoted

CARD: Final = "README.md"
_FIRST_SUITE: Final = "clean"  # what is loaded where no configuration is named
# The size classes of the Hub.
_SIZES: Final = ((1_000, "n<1K"), (10_000, "1K<n<10K"), (100_000, "10K<n<100K"), (1_000_000, "100K<n<1M"))


def card_text(release: Release) -> str:
    """Return the card: Markdown after a YAML head."""
    sections = (_opening, _suites, _regions, _loading, _meaning, _ending)
    head = "\n".join(("---", *_head(release), "---"))
    return "\n\n".join((head, *(section(release) for section in sections))) + "\n"


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
| `imagery/` | {_imagery_line(release)} |
| `SHA256SUMS` | `sha256sum -c SHA256SUMS` checks every file |"""


def _imagery_line(release: Release) -> str:
    """Say where imagery is, which is under other licences."""
    shown = {item.name: item.manifest.imagery for item in release.maps if item.manifest.imagery is not None}
    if not shown:
        return "imagery, apart from what is derived from OpenStreetMap: none in this release"
    text = f"licences and authors of the imagery, `ortho.tif` of {', '.join(shown)}, which is not under the ODbL"
    rendered = [name for name, record in shown.items() if record.is_rendered]
    return f"{text}, but for what is rendered from the map ({', '.join(rendered)})" if rendered else text


def _truth_line(release: Release) -> str:
    if release.board is not None:
        return f"none here; they are {release.truths_said}"
    if release.with_truth:
        return "all are in this release"
    released = sorted({part for task in release.tasks for part in task.released})
    if release.split.kind == "crossfit":
        return "none here; in a cross-fit every place is a test place once, so all of them are kept back"
    return f"those of {' and '.join(released)} are here, those of test are kept back" if released else "kept back"


def _table(head: str, rows: Iterable[str]) -> str:
    """Join the lines of a Markdown table."""
    return "\n".join((head, "|" + "---|" * (head.count("|") - 1), *rows))


def _suites(release: Release) -> str:
    rows = []
    for suite in release.suites:
        tasks = release.tasks_of(suite)
        for part in release.tables_of(suite):
            own = [task for task in tasks if part in task.parts]
            released = f"`{suite}-{TRUTHS}`" if any(part in task.released for task in own) else "kept back"
            count = sum(task.parts[part] for task in own)
            title = markdown(tasks[0].source.manifest.title)
            rows.append(f"| `{suite}` | {title} | `{part}` | {count} | {len(own)} | {released} |")
    return "## Suites\n\n" + _table("| Configuration | What is asked | Split | Queries | Maps | Truths |", rows)


def _regions(release: Release) -> str:
    split = release.split
    places = (
        f"| {place.name} | {place.part or f'half {place.half}'} | {', '.join((*place.regions, *place.blocks))} |"
        for place in places_of(release)
    )
    crossfit = (
        "Each place is tested once. Training for a place comes from the other half; the rest of its own half "
        "calibrates."
    )
    buffer = (
        f"Split `{split.id}` ({markdown(split.title)}): places that are used for different purposes keep at least "
        f"{split.buffer_m:g} m apart."
    )
    parts = (
        "## Maps and places",
        buffer,
        _table("| Place | Part or half | Regions |", places),
        *((crossfit,) if split.kind == "crossfit" else ()),
        _table("| Map | What | Date | Size | CRS |", map(_map_row, release.maps)),
        "`name@date` is an older map of a place, `name+suite` one that a suite has edited.",
    )
    return "\n\n".join(parts)


def _map_row(item: ReleaseMap) -> str:
    about = item.manifest
    size = f"{about.cols} x {about.rows} cells of {about.cell_size_m:g} m"
    return f"| `{item.name}` | {markdown(about.title)} | {about.extract.date} | {size} | EPSG:{about.epsg} |"


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

with rasterio.open("regions/{name}/layers.tif", driver="GTiff") as source:
    layers = source.read()  # 0 absent, 1 present, 255 outside the mapped area
    print(source.descriptions, source.crs, source.tags()["attribution"])
features = gpd.read_parquet("regions/{name}/features.parquet")
nodes = gpd.read_parquet("regions/{name}/nodes.parquet")
edges = pd.read_parquet("regions/{name}/edges.parquet")
print(len(features), len(nodes), len(edges))
```

With sasgeo-bench itself, `sasgeo-bench run --tasks tasks/{suite}/{name}` runs a matcher on it: the folder is laid out
as the program's own."""


def _columns(texts: Mapping[str, str]) -> str:
    return _table("| Column | What |", (f"| `{name}` | {text} |" for name, text in texts.items()))


def _meaning(release: Release) -> str:
    truths = ""
    if any(task.released for task in release.tasks):
        head = "\n\n## Columns of the truths\n\nA row for each query, to be joined by `query_id`.\n\n"
        truths = head + _columns(TRUTH_TEXTS)
    return f"""\
## Columns of the queries

{_columns(QUERY_TEXTS)}

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


DATASHEET: Final = "datasheet.md"
_M2_PER_KM2: Final = 1e6


def datasheet_text(release: Release) -> str:
    """Return the datasheet in Markdown, its numbers counted from the release itself."""
    opening = f"""\
# Datasheet of sasgeo-bench, dataset release {release.version}

After Gebru et al., *Datasheets for Datasets*, Communications of the ACM 64(12), 2021. {ATTRIBUTION}."""
    parts = (
        opening,
        _motivation(release),
        _composition(release),
        _collection(release),
        _preprocessing(release),
        _uses(),
        _distribution(release),
        _maintenance(release),
    )
    return "\n\n".join(parts) + "\n"


def _motivation(release: Release) -> str:
    return f"""\
## Motivation

**For what purpose was it made?** To measure how well a UAV without GNSS finds its place on a semantic map, where the
map is old, the view is partly hidden or wrong, places look alike, or the place is not on the map at all; and to tell
a right fix from a false one.

**Who made it?** The authors of sasgeo-bench, by {release.made_by}.

**Who paid for it?** No funding is declared. The maps are the work of OpenStreetMap's contributors."""


def _composition(release: Release) -> str:
    area_km2, dates = _area_km2(release), sorted(item.manifest.extract.date for item in release.maps)
    objects = _sum(item.manifest.counts for item in release.maps)
    parts = _sum(task.parts for task in release.tasks)
    made_up = [name for name in release.regions if name.startswith(MADE_UP)]
    towns = f", {len(made_up)} of them made up by a program" if made_up else ""
    queries = ", ".join(f"{part} {count}" for part, count in parts.items())
    kept = "All truths are in the release." if release.with_truth else "Truths of test queries are kept back."
    return f"""\
## Composition

**What are the instances?** Maps and queries. A map is a region with a raster for each semantic class, the classified
geometry, and a graph of junctions, crossings, bridges and buildings. A query is a view of a place: for each class and
cell present, absent or unknown, with what is known of place, heading and scale before.

**How many are there?** {counted(len(release.regions), "region")} ({area_km2:,.1f} km2{towns}) in
{counted(len(release.maps), "map")} of {dates[0]} to {dates[-1]}; {counted(release.queries, "query", "queries")} of
{counted(len(release.suites), "suite")} ({queries}); {counted(len(release.files), "file")} with
{release.bytes / 1e6:,.1f} MB of data.

{_class_table(objects)}

**Is it a sample?** Yes. Regions were chosen for variety and for having dated extracts. Places within them are
drawn at random among those that are mapped and not empty.

**Is there a label?** The pose of the view, and whether the place is on the map. {kept}

**Is anything missing?** {_mapped_line(release)} Outside the mapped area cells are 255, never absent. What is not
visible from above is left out and counted, as is every object that could not be used: {_left_out_line(release)}.

**Are there recommended splits?** Split `{release.split.id}`: {markdown(release.split.title)}.
Whole places are separated by {release.split.buffer_m:g} m at least.

**Are there errors, noise or redundancy?** The errors of the detector are put in on purpose, as many for each class as
published detectors make. The maps have the errors and gaps of OpenStreetMap. All queries of one site show one place:
they are not independent, and figures are to be resampled by place and block.

**Does it rely on other data?** No; every file is in the release. `region.json` of each map names its extract by
SHA-256.

**Does it hold anything confidential, offensive, or about people?** No. Ids, versions and times of map objects are
kept; names and ids of the accounts that edited them are not."""


def _area_km2(release: Release) -> float:
    """Return the ground of all regions, each counted once whatever the number of its maps."""
    areas = {
        item.region: item.manifest.rows * item.manifest.cols * item.manifest.cell_size_m**2 / _M2_PER_KM2
        for item in release.maps
    }
    return sum(areas.values())


def _sum(counts: Iterable[Mapping[str, int]]) -> Counter[str]:
    """Add counts by name, names that count 0 included."""
    found: Counter[str] = Counter()
    for one in counts:
        found.update(one)
    return found


def _class_table(objects: Counter[str]) -> str:
    lines = (f"| {markdown_code(name)} | {count:,} |" for name, count in objects.items())
    return _table("| Class | Objects in all maps |", lines)


def _mapped_line(release: Release) -> str:
    least = min(release.maps, key=lambda item: item.manifest.coverage.share)
    share = least.manifest.coverage.share
    if share == 1:
        return "Every map is mapped whole."
    return f"The least mapped map is `{least.name}`: {share:.1%} of it."


def _left_out_line(release: Release) -> str:
    hidden = sum(sum(item.manifest.hidden.values()) for item in release.maps)
    dropped = sum(sum(item.manifest.drops.values()) for item in release.maps)
    counts = f"{hidden:,} objects in and around the maps are not visible, {dropped:,} were dropped"
    return f"{counts}, with reasons in `region.json`"


def _collection(release: Release) -> str:
    files = {item.manifest.extract.file: item.manifest.extract.sha256 for item in release.maps}
    lines = (f"| {markdown_code(name)} | {markdown_code(files[name])} |" for name in sorted(files))
    table = _table("| Extract | SHA-256 |", lines)
    return f"""\
## Collection

**How was the data acquired?** Maps: from dated extracts of OpenStreetMap, drawn by its contributors from surveys,
imagery and open data ([source]({COPYRIGHT_URL})). Queries: computed from the maps; no aircraft was flown.

**Over what time?** The dates of the maps are those of the extracts.

{table}

**Were people involved or asked?** No people are in the data. Contributors of OpenStreetMap have agreed to its
licence."""


def _preprocessing(release: Release) -> str:
    classes = len(release.maps[0].manifest.classes)
    return f"""\
## Preprocessing

**What was done?** Objects are put into {classes} classes by exact tags, projected to the UTM zone of the region,
mended where their geometry is broken, burnt into a raster for each class, and linked into a graph. Views are cut from
the layers at random poses; errors of perception, hidden parts, age or seasons are put in as the suite says, and each
has a control that differs in nothing else.

**Is the raw data kept?** Not in the release. An extract can be found by its name and SHA-256, and
`sasgeo-bench build-region` builds the map from it again.

**Is the software available?** Yes, under the Apache License 2.0: {release.made_by}."""


def _uses() -> str:
    return """\
## Uses

**What is it for?** Comparing methods of map localization and of rejecting false fixes.

**What else could it be used for?** Studies of how maps age, of places that look alike, or of graphs of maps.

**What should it not be used for?** Navigation of any real vehicle. Figures found here say how methods compare on
semantic views that a program made, not how often a real flight would find its place. The maps are not to be used as
maps: they are simplified, and some (`name+suite`) are edited so that places look alike.

**What could make it unfair?** OpenStreetMap is denser in some countries than in others; methods that do well here may
do worse where little is mapped."""


def _distribution(release: Release) -> str:
    has_imagery = any(item.manifest.imagery is not None for item in release.maps)
    more = (
        "Aerial imagery (`ortho.tif`), under the licences that `imagery/README.md` lists."
        if has_imagery
        else "No imagery; the folder `imagery/` is where it would be, apart and with its own\nlicence."
    )
    return f"""\
## Distribution

**How is it distributed?** As a folder of files: cloud-optimized GeoTIFF, GeoParquet 1.1 and Parquet, with a STAC
catalog, Croissant metadata and a card that the `datasets` library reads.

**Under which licence?** Open Database License 1.0, {LICENCE_URL}. {ATTRIBUTION}. Every file says so in its own
metadata or text.

**Is there anything else in it?** {more}"""


def _maintenance(release: Release) -> str:
    return f"""\
## Maintenance

**Who keeps it?** The authors of sasgeo-bench.

**Will it be updated?** A release does not change. Its version, {release.version}, says how its maps are made (first
number) and how its queries are (second): figures of two versions are never put on one board. Two releases of one
version may hold other regions and queries; `release.json` says which, and `SHA256SUMS` whether two are the same.

**How can others add to it?** A region is one TOML file, a suite one module: sasgeo-bench says how. What is derived
from the data is offered under the ODbL."""
