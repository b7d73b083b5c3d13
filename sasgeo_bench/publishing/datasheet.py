# SPDX-License-Identifier: Apache-2.0
"""`datasheet.md`: the questions of Gebru et al. (Datasheets for Datasets), answered for one release."""

from collections import Counter
from typing import Final

from sasgeo_bench.errors import counted
from sasgeo_bench.publishing.release_files import COPYRIGHT_URL, LICENCE_URL, Release
from sasgeo_bench.regions.region import ATTRIBUTION
from sasgeo_bench.texts import markdown, markdown_code

DATASHEET: Final = "datasheet.md"
_M2_PER_KM2: Final = 1e6


def datasheet_text(release: Release) -> str:
    """Write the datasheet, its numbers counted from the release itself.

    Parameters
    ----------
    release : Release
        What is in the release.

    Returns
    -------
    str
        Markdown.
    """
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
        _distribution(),
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
    objects, parts = _objects(release), _parts(release)
    made_up = [name for name in release.regions if name.startswith("town-")]
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
Whole places are kept apart, by {release.split.buffer_m:g} m at least.

**Are there errors, noise or redundancy?** The errors of the detector are put in on purpose, as many for each class as
published detectors make. The maps have the errors and gaps of OpenStreetMap. All queries of one site show one place:
they are not independent, and figures are to be resampled by place and block.

**Does it rely on other data?** No; every file is in the release. `region.json` of each map names its extract by
SHA-256.

**Does it hold anything confidential, offensive, or about people?** No. Ids, versions and times of map objects are
kept; names and ids of the accounts that edited them are not."""


def _area_km2(release: Release) -> float:
    """Ground of all regions, each counted once whatever the number of its maps."""
    areas = {
        item.region: item.manifest.rows * item.manifest.cols * item.manifest.cell_size_m**2 / _M2_PER_KM2
        for item in release.maps
    }
    return sum(areas.values())


def _objects(release: Release) -> Counter[str]:
    found: Counter[str] = Counter()
    for item in release.maps:
        found.update(item.manifest.counts)
    return found


def _parts(release: Release) -> Counter[str]:
    found: Counter[str] = Counter()
    for task in release.tasks:
        found.update(task.parts)
    return found


def _class_table(objects: Counter[str]) -> str:
    lines = [
        "| Class | Objects in all maps |",
        "|---|---|",
        *(f"| {markdown_code(name)} | {count:,} |" for name, count in objects.items()),
    ]
    return "\n".join(lines)


def _mapped_line(release: Release) -> str:
    least = min(release.maps, key=lambda item: item.manifest.coverage.share)
    share = least.manifest.coverage.share
    if share == 1:
        return "Every map is mapped whole."
    return f"The least mapped map is `{least.name}`: {share:.1%} of it."


def _left_out_line(release: Release) -> str:
    hidden = sum(sum(item.manifest.hidden.values()) for item in release.maps)
    dropped = sum(sum(item.manifest.drops.values()) for item in release.maps)
    said = f"{hidden:,} objects in and around the maps are not visible, {dropped:,} were dropped"
    return f"{said}, with reasons in `region.json`"


def _collection(release: Release) -> str:
    files = {item.manifest.extract.file: item.manifest.extract.sha256 for item in release.maps}
    lines = [f"| {markdown_code(name)} | {markdown_code(files[name])} |" for name in sorted(files)]
    table = "\n".join(("| Extract | SHA-256 |", "|---|---|", *lines))
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


def _distribution() -> str:
    return f"""\
## Distribution

**How is it distributed?** As a folder of files: cloud-optimized GeoTIFF, GeoParquet 1.1 and Parquet, with a STAC
catalog, Croissant metadata and a card that the `datasets` library reads.

**Under which licence?** Open Database License 1.0, {LICENCE_URL}. {ATTRIBUTION}. Every file says so in its own
metadata or text.

**Is there anything else in it?** No imagery; the folder `imagery/` is where it would be, apart and with its own
licence."""


def _maintenance(release: Release) -> str:
    return f"""\
## Maintenance

**Who keeps it?** The authors of sasgeo-bench.

**Will it be updated?** A release does not change. Its version, {release.version}, says how its maps are made (first
number) and how its queries are (second): figures of two versions are never put on one board. Two releases of one
version may hold other regions and queries; `release.json` says which, and `SHA256SUMS` whether two are the same.

**How can others add to it?** A region is one TOML file, a suite one module: sasgeo-bench says how. What is derived
from the data is offered under the ODbL."""
