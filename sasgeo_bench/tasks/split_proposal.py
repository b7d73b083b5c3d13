# SPDX-License-Identifier: Apache-2.0
"""Propose a split of regions: what lies near each other, and what is of one country, stands in one part."""

import re
import unicodedata
from collections.abc import Sequence
from itertools import combinations
from typing import Final

import numpy as np
from scipy.sparse.csgraph import connected_components  # type: ignore[import-untyped, unused-ignore]

from sasgeo_bench.core.config import check_document, toml_value
from sasgeo_bench.core.errors import counted
from sasgeo_bench.regions.region_spec import RegionFile
from sasgeo_bench.tasks.split import Part, SplitFile, blocks_of, nearest_blocks

BUFFER_M: Final = 2000.0  # between parts, beyond what views reach
BLOCK_M: Final = 1000.0
REACH_M: Final = 360.0  # of a view beyond its block
SHARES: Final[dict[Part, float]] = {"test": 0.5, "train": 0.25, "calibration": 0.25}  # of the blocks


def propose_split(name: str, regions: Sequence[RegionFile]) -> SplitFile:
    """Return a hold-out of regions, whose grids and countries (`[provenance]`) alone count.

    Regions nearer than `BUFFER_M` and twice the reach of views are one place. Places of a country, and those that a
    place on a border joins, stand in one part. The largest go first, each to the part that lacks most of its share; of
    a single country or place everything is test, and of two the smaller one calibrates. Raise `ConfigError` if the
    name is none.

    >>> from sasgeo_bench.regions.region_spec import find_region_file, read_region_file
    >>> towns = [read_region_file(find_region_file(name)) for name in ("vaduz", "triesen", "monaco", "gibraltar")]
    >>> [(place.part, place.regions) for place in propose_split("mine", towns).place]
    [('test', ['vaduz', 'triesen']), ('train', ['monaco']), ('calibration', ['gibraltar'])]
    """
    blocks = [blocks_of(spec.id, spec.grid(), block_m=BLOCK_M) for spec in regions]
    countries = [_slug(spec.provenance.country) for spec in regions]
    is_near, is_joined = np.eye(len(regions), dtype=bool), np.eye(len(regions), dtype=bool)
    for one, other in combinations(range(len(regions)), 2):
        pair = {str(at): blocks[at] for at in (one, other)}
        is_near[one, other] = nearest_blocks(pair, within_m=BUFFER_M + 2 * REACH_M) is not None
        has_same = countries[one] is not None and countries[one] == countries[other]
        is_joined[one, other] = is_near[one, other] or has_same
    place_of, group_of = (connected_components(which, directed=False)[1] for which in (is_near, is_joined))
    parts = _parts(np.bincount(group_of, weights=[len(one) for one in blocks]).tolist())
    places = []
    for label in dict.fromkeys(place_of.tolist()):
        members = np.flatnonzero(place_of == label).tolist()
        shared = {countries[at] for at in members}
        place = {"name": regions[members[0]].id, "part": parts[group_of[members[0]]]}
        place |= {"country": shared.pop()} if len(shared) == 1 and None not in shared else {}
        places.append(place | {"regions": [regions[at].id for at in members]})
    groups = counted(len(parts), "group")
    fields = {
        "id": name,
        "title": f"{counted(len(places), 'place')}, in {groups} that share neither ground nor country",
        "kind": "holdout",
        "buffer_m": BUFFER_M,
        "block_m": BLOCK_M,
        "reach_m": REACH_M,
        "place": places,
    }
    return check_document(fields, SplitFile, source=f"split {name!r}")


def _parts(sizes: Sequence[float]) -> list[Part]:
    """Return the part of each group, by its number of blocks."""
    order = sorted(range(len(sizes)), key=lambda group: -sizes[group])
    if len(sizes) <= 2:
        names: list[Part] = ["test", "calibration"]
        return [names[order.index(group)] for group in range(len(sizes))]
    lacks = {part: share * sum(sizes) for part, share in SHARES.items()}
    found: dict[int, Part] = {}
    for group in order:
        found[group] = max(lacks, key=lambda part: lacks[part])
        lacks[found[group]] -= sizes[group]
    return [found[group] for group in range(len(sizes))]


def _slug(country: str | None) -> str | None:
    """Return a country as a split names it.

    >>> _slug("Côte d'Ivoire")
    'cote-d-ivoire'
    """
    plain = unicodedata.normalize("NFKD", country or "").encode("ascii", "ignore").decode().lower()
    return re.sub(r"[^a-z0-9]+", "-", plain).strip("-") or None


def split_text(spec: SplitFile) -> str:
    """Return the text of a split file."""
    keys = ("id", "title", "kind", "buffer_m", "block_m", "reach_m")
    lines = [f"{key} = {toml_value(getattr(spec, key))}" for key in keys]
    for place in spec.place:
        fields = {key: getattr(place, key) for key in ("name", "part", "country", "regions")}
        lines += ["", "[[place]]", *(f"{key} = {toml_value(value)}" for key, value in fields.items() if value)]
    return "\n".join(lines) + "\n"
