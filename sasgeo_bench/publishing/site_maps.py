# SPDX-License-Identifier: Apache-2.0
"""The maps of a site that can be moved: the queries and answers of each place, as scripts that a page loads one by one.

A script instead of a JSON file: a page that is opened from a disk may load no other kind of data.
"""

import json
import math
from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
import pandas as pd

from sasgeo_bench.errors import StoreError
from sasgeo_bench.leaderboard.cases import FAILURES, MEANINGS
from sasgeo_bench.leaderboard.manifests import RegionMap
from sasgeo_bench.leaderboard.tables import file_stem
from sasgeo_bench.publishing.site_source import SiteSource
from sasgeo_bench.scoring.draws import seed_of_text
from sasgeo_bench.tasks.query import base_of
from sasgeo_bench.texts import plain

MAPS: Final = "maps"
_POSE: Final = ("easting_m", "northing_m", "yaw_deg")
_MOST_M: Final = 1e8  # of any coordinate on Earth
MOST_BYTES: Final = 1_000_000  # of all scripts, nearly
_QUERY_BYTES: Final = 95  # as of the board `modules`
_ANSWER_BYTES: Final = 27
SOUND: Final = "as it should be"  # neither a failure nor a crash
NOT_ASKED: Final = "not applicable"
OUTCOMES: Final = {
    SOUND: "right, or rightly none",
    **{name: MEANINGS[name] for name in FAILURES},
    NOT_ASKED: "not asked: the card of the matcher excludes the query",
}
_NUMBERS: Final = {name: at for at, name in enumerate(OUTCOMES)}


@dataclass(frozen=True, slots=True, kw_only=True)
class PlaceMap:
    """A place with a map and answers: its script in `maps/`, its title, and its queries, of which some are drawn."""

    region: str
    file: str
    title: str
    queries: int
    drawn: int


def place_maps(source: SiteSource) -> dict[PlaceMap, str]:
    """Return the places of a board that have a map and answers, with the text of the script of each.

    Coordinates in a script are metres from the south-western corner of its map. Where all scripts together would be
    larger than `MOST_BYTES`, the same share of each place's queries is drawn: those with a picture, then others by a
    hash of their ids.
    """
    if not len(source.board.answers):
        return {}
    _check(source.board.answers)
    answers = source.board.answers.assign(base=source.board.answers["region"].map(base_of))
    pictures = {plain(case.query_id): at for at, case in enumerate(source.pictures.cases, start=1)}
    share = MOST_BYTES / (_QUERY_BYTES * answers["query_id"].nunique() + _ANSWER_BYTES * len(answers))
    found = {}
    for at, item in enumerate(one for one in source.pictures.regions if one.bounds_m is not None):
        whole = answers[answers["base"] == item.region]
        if not len(whole):
            continue
        part = _sampled(whole, share, pictures)
        spot = source.spots.get(item.region)
        title = item.region if spot is None else spot.title
        place = PlaceMap(
            region=item.region,
            file=f"{MAPS}/{file_stem(item.region)}-{at}.js",
            title=plain(title),
            queries=int(whole["query_id"].nunique()),
            drawn=int(part["query_id"].nunique()),
        )
        found[place] = _script(place, item, part, pictures)
    return found


def _sampled(answers: pd.DataFrame, share: float, first: Collection[str]) -> pd.DataFrame:
    """Return the answers to a share of the queries: the `first`, then others by a hash of their ids; one at least."""
    if share >= 1:
        return answers
    ids = sorted(set(answers["query_id"]), key=lambda name: (name not in first, seed_of_text(name)))
    return answers[answers["query_id"].isin(ids[: max(1, int(share * len(ids)))])]


def _check(answers: pd.DataFrame) -> None:
    """Refuse poses that lie nowhere on Earth or lack a part, and views without a side."""
    poses = [answers[[f"{what}_{name}" for name in _POSE]].to_numpy(float) for what in ("true", "fix")]
    view_m = answers["view_m"].to_numpy(float)
    is_sound = (view_m > 0) & (view_m < _MOST_M)
    for pose in poses:
        is_sound &= np.isnan(pose).all(axis=1) | (np.abs(pose) < _MOST_M).all(axis=1)
    if not is_sound.all():
        row = int(np.argmin(is_sound))
        raise StoreError(f"answers.parquet holds a view or a pose that lies nowhere, in row {row}: score it again")


def _script(place: PlaceMap, item: RegionMap, answers: pd.DataFrame, cases: Mapping[str, int]) -> str:
    west_m, south_m, east_m, north_m = item.bounds_m or (0.0,) * 4
    queries = answers.drop_duplicates("query_id").sort_values("query_id", ignore_index=True)
    number = {query_id: at for at, query_id in enumerate(queries["query_id"])}
    content: dict[str, Any] = {
        "picture": f"pictures/{item.file}",
        "size_m": [east_m - west_m, north_m - south_m],
        "corner_m": [west_m, south_m],
        "blocks": [
            [plain(name), left - west_m, low - south_m, right - west_m, high - south_m]
            for name, (left, low, right, high) in {block.name: block.bounds_m for block in item.blocks}.items()
        ],
        "queries": list(_queries(queries, west_m, south_m)),
        "cases": {str(number[name]): at for name, at in cases.items() if name in number},
        "answers": [  # pairs: no name of a matcher means anything to the language of the script
            [
                plain(str(name)),
                [
                    [number[row["query_id"]], _outcome(row), *_point(row, "fix", west_m, south_m)]
                    for row in part.to_dict("records")
                ],
            ]
            for name, part in answers.groupby("matcher", sort=True)
        ],
    }
    text = json.dumps(content, separators=(",", ":"), allow_nan=False)  # ASCII alone
    return f"showPlace({json.dumps(place.file)}, {text});\n"


def _queries(rows: pd.DataFrame, west_m: float, south_m: float) -> Iterator[list[Any]]:
    """Yield id, suite, map, what was done to it, whether its place is on the map, side of its view, and true pose."""
    for row in rows.to_dict("records"):
        words = [plain(str(row[name])) for name in ("query_id", "suite", "region", "kind")]
        yield [*words, int(row["is_present"]), round(float(row["view_m"]), 1), *_point(row, "true", west_m, south_m)]


def _outcome(row: Mapping[Any, Any]) -> int:
    """Return the number of an outcome in `OUTCOMES`, -1 for a class that this version does not know."""
    is_asked = row["status"] != NOT_ASKED
    return _NUMBERS.get(row["failure"] or SOUND, -1) if is_asked else _NUMBERS[NOT_ASKED]


def _point(row: Mapping[Any, Any], what: str, west_m: float, south_m: float) -> list[float | None]:
    """Return easting, northing and yaw in metres and degrees from the corner; nothing where there is no pose."""
    easting_m, northing_m, yaw_deg = (float(row[f"{what}_{name}"]) for name in _POSE)
    if math.isnan(easting_m):
        return []
    return [round(easting_m - west_m, 1), round(northing_m - south_m, 1), round(yaw_deg, 1)]
