# SPDX-License-Identifier: Apache-2.0
"""The page of natural twins: .venv/bin/python docs/figures/natural_twins.py --out out.

`build-region --every` built the regions before. Pairs are mined once for each region, into OUT/natural-twins, so that a
run goes on where it was cut off. Forty pairs of train places are drawn and asked; answers stay in OUT/answers.
"""

import argparse
import json
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from functools import cache
from pathlib import Path
from textwrap import fill
from typing import Final

import cv2
import numpy as np
import pandas as pd
import scipy
from numpy.typing import NDArray
from places import split, write

from sasgeo_bench.core.errors import ConfigError
from sasgeo_bench.geometry.pose import Pose
from sasgeo_bench.matching.matcher import Prediction
from sasgeo_bench.regions.evidence import PRESENT
from sasgeo_bench.regions.region import ATTRIBUTION
from sasgeo_bench.regions.region_spec import list_region_files, read_region_file
from sasgeo_bench.running.prediction_files import read_predictions
from sasgeo_bench.scoring.score import score_task
from sasgeo_bench.tasks import task_files
from sasgeo_bench.tasks.build import read_scene
from sasgeo_bench.tasks.query import TWIN_EAST, TWIN_NORTH, UNRIVALLED, Truth
from sasgeo_bench.tasks.sheet import paint
from sasgeo_bench.tasks.split import Place
from sasgeo_bench.tasks.state import State
from sasgeo_bench.tasks.suites.base import NaturalTwin, Seeds
from sasgeo_bench.tasks.suites.natural import NATURAL_TWINS, STEP, VIEW_CELLS, WITH_VECTORS, pair_of
from sasgeo_bench.tasks.suites.sites import choose_sites
from sasgeo_bench.tasks.task_plan import Request

MATCHERS: Final = ("sasgeo", "schmidt_segcorr", "raster_soft", "fft_vote")
DOCS: Final = Path(__file__).parents[1]
FIGURES: Final = DOCS / "figures"
MOST: Final = 1000  # more sites than any place here has
MINED, MOST_OF_PLACE = 200, 3  # pairs on the first sheet, the likest of each place
SHOWN: Final = 40  # pairs on the second
TOLD: Final = 10  # of these, found by fewest
LEAST_RANKED: Final = 10  # pairs of a region whose order is measured
WITHIN_M: Final = 25.0
MAGENTA: Final = (200, 0, 200)
TEXT_PX, GAP_PX = 14, 8
WEBP: Final = (cv2.IMWRITE_WEBP_QUALITY, 55)
PARTS: Final = (
    ("twin omitted", "control: the disc omits the twin"),
    ("N1", "the disc holds both"),
    (WITH_VECTORS, "the same, with vectors"),
    ("difference removed", "falsifier: what differs is unknown"),
)
ABSENT: Final = (
    ("twin alone", "the disc holds the twin alone"),
    ("difference removed", "falsifier: the twin alone, what differs is unknown"),
)
PAGE: Final = """# Natural twins

Places that look alike and were found on the map, not made; what they are, and how they are asked, stands with the
[suites](concepts/suite.md#natural-twins). Here are those of the open places of the split
[`world`](../splits/README.md): **{pairs} pairs in {places} places of {countries} countries** whose views of 96 m do not
overlap; {without} of the {all} open places have none. Made by

```text
sasgeo-bench build-region --every --out out
python docs/figures/natural_twins.py --out out --mine
sasgeo-bench make-queries --suite natural-twins --split world --seed 0 --n 3 --up-to --skip \\
  --regions duitama --out out      # and the others; natural-absent with --n 2
sasgeo-bench run --matcher sasgeo --tasks out/tasks/natural-twins/* --tasks out/tasks/natural-absent/* --out out
python docs/figures/natural_twins.py --out out
```

with `run` for each of the matchers named below. Queries were drawn at train places alone, on the first region of each
that has eight pairs or more: {sites} sites of

{names}.

(c) OpenStreetMap contributors, ODbL.

## The likest {mined}

At most {most} of a place, from {mined_places} places; margins up to {worst:.2f} (number below each pair). Left the
place, right its twin, turned as they agree best; magenta is what the other does not show within 4 m.

The likest are crossings, bends and tanks on ground where no building is mapped; then come perimeter blocks, slabs, rows
of equal houses and grids.

![Pairs of places that look alike](figures/twins-mined.webp)

**Manipulation check.** Margins grow with the rank that the four scorers gave, which do not know the margin: means by
third of the rank {thirds}; median rank correlation {rank:.2f} over {ranked} regions with {least} pairs or more.

## Are they told apart?

Share of views found within 25 m, and share answered within 25 m of the twin; views have twice the detector's error.

| part | n | {matchers} |
{rule}
{results}

By margin, where the disc holds both:

| margin | n | {matchers} |
{rule}
{steps}

A plain search lists both the place and its twin in {both} of {n} of these views (the others are `unrivalled`, and no
contrast counts them): a view of 96 m with twice the usual error is often missed without its twin's doing.

Where the place is not in the disc every answer is false; the share of them within 25 m of the twin:

| part | n | {matchers} |
{rule}
{absent}

A view may also be of the look-alike in another country, while the disc holds the place: over the same {away_n} sites
the likest place of the next country of the split has a median margin of {away:.2f}, the twin {near:.2f}.

## Forty to judge by eye

Drawn by the suite at train places, over all margins. Below each pair: number, region, margin, and how many of the four
matchers found the place.

![Forty pairs with what differs marked](figures/twins-asked.webp)

{lost} of the {shown} were found by no matcher. The {told} found by fewest:

| pair | region | margin | found by | taken for its twin by |
|---|---|---|---|---|
{hard}

## By place

| place | country | part | pairs | least margin | median margin |
|---|---|---|---|---|---|
{rows}
"""


def mined(region: str, out: Path) -> list[NaturalTwin]:
    """Return the pairs of a region whose places do not overlap, as the suite asks them; mine them once."""
    path = out / "natural-twins" / f"{region}.json"
    if not path.exists():
        path.parent.mkdir(parents=True, exist_ok=True)
        scratch = path.with_suffix(".part")
        scratch.write_text(json.dumps([asdict(twin) for twin in _mine(region, out)]), encoding="utf-8")
        scratch.replace(path)
    rows = json.loads(path.read_text(encoding="utf-8"))
    return [NaturalTwin(**row | {name: tuple(row[name]) for name in ("place_m", "twin_m")}) for row in rows]


def _mine(region: str, out: Path) -> list[NaturalTwin]:
    spec, suite = read_region_file(list_region_files()[region]), NATURAL_TWINS
    name = suite.card.name
    request = Request(suite=name, suite_spec=name, region=spec, split=split(), elsewhere=None, count=2, seed=0, out=out)
    scene, _ = read_scene(request, suite)
    if suite.lack(scene):
        return []
    seeds = Seeds(root=0, names=(spec.id, name, str(suite.card.version)))
    try:
        sites = choose_sites(scene, suite, count=MOST, seeds=seeds, group=suite.card.group, may_be_fewer=True)
    except ConfigError:  # none in a block
        return []
    return [pair_of(scene, site) for site in sites]


@dataclass(frozen=True, kw_only=True)
class Pair:
    """A pair of one region of a place."""

    place: Place
    region: str
    twin: NaturalTwin

    @property
    def margin(self) -> float:
        """Return how much tells the two places apart."""
        return 1 - self.twin.likeness


def pairs_of(place: Place, out: Path) -> list[Pair]:
    """Return the pairs of a place."""
    return [Pair(place=place, region=region, twin=twin) for region in place.region_ids for twin in mined(region, out)]


def row_of(place: Place, pairs: Sequence[Pair]) -> str:
    """Return the row of a place."""
    margins = [pair.margin for pair in pairs]
    cells = (
        place.name,
        (place.country or "").replace("-", " ").title(),
        str(place.part),
        str(len(pairs)),
        f"{min(margins):.2f}",
        f"{np.median(margins):.2f}",
    )
    return f"| {' | '.join(cells)} |"


def ranks_of(pairs: Sequence[Pair]) -> tuple[str, float, int]:
    """Return the margins by third of the rank in a region, the median rank correlation, and of how many regions."""
    regions = pd.DataFrame(
        [(pair.region, pair.twin.rank, pair.margin) for pair in pairs], columns=["r", "rank", "margin"]
    )
    large = regions.groupby("r").filter(lambda rows: len(rows) >= LEAST_RANKED)
    thirds = large.groupby("r")["rank"].transform(lambda ranks: np.ceil(3 * ranks.rank(method="first") / len(ranks)))
    means = large.groupby(thirds)["margin"].mean()
    each = [scipy.stats.spearmanr(rows["rank"], rows["margin"]).statistic for _, rows in large.groupby("r")]
    return " / ".join(f"{value:.3f}" for value in means), float(np.median(each)), len(each)


@cache
def state_of(region: str, out: Path) -> State:
    """Return the map of a region."""
    return State.read(out / "regions" / region)


def pictures(pair: Pair, out: Path) -> tuple[NDArray[np.uint8], NDArray[np.uint8]]:
    """Return both places, side by side as they look alike; what the other does not show within 4 m is magenta."""
    state = state_of(pair.region, out)
    easting_m, northing_m = pair.twin.place_m
    seen = Pose(easting_m=easting_m, northing_m=northing_m, yaw_deg=0.0, scale=1.0)
    views = [state.view(pose, size_cells=VIEW_CELLS, cell_size_m=1.0) for pose in (seen, pair.twin.pose(seen))]
    drawn = [(view.cells == PRESENT).astype(np.uint8) for view in views]
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (9, 9))  # 4 m
    found: list[NDArray[np.uint8]] = []
    for own, other, view in zip(drawn, drawn[::-1], views, strict=True):
        near = np.stack([cv2.dilate(layer, disc) for layer in other])
        picture = (paint(view) * 255).astype(np.uint8)[..., ::-1].copy()
        picture[((own == 1) & (near == 0)).any(axis=0)] = MAGENTA
        found.append(picture)
    return found[0], found[1]


def sheet_of(pairs: Sequence[Pair], names: Sequence[str], out: Path, *, side: int, across: int) -> NDArray[np.uint8]:
    """Return the pairs in rows, each above its name."""
    high, wide = side + TEXT_PX + GAP_PX, 2 * side + 2 + GAP_PX
    rows = -(-len(pairs) // across)
    sheet = np.full((rows * high + TEXT_PX, across * wide, 3), 255, dtype=np.uint8)
    for number, (pair, name) in enumerate(zip(pairs, names, strict=True)):
        top, left = number // across * high, number % across * wide
        for at, picture in enumerate(pictures(pair, out)):
            start = left + at * (side + 2)
            small = cv2.resize(
                picture, (side, side), interpolation=cv2.INTER_AREA if side < VIEW_CELLS else cv2.INTER_NEAREST
            )
            sheet[top : top + side, start : start + side] = small
        write(sheet, name, (left, top + side + TEXT_PX - 4))
    write(sheet, ATTRIBUTION, (2, sheet.shape[0] - 4))
    return sheet


def likest(pairs: Sequence[Pair], *, count: int, most: int) -> list[Pair]:
    """Return the likest pairs, at most so many of a place."""
    taken: dict[str, int] = {}
    found: list[Pair] = []
    for pair in sorted(pairs, key=lambda pair: (pair.margin, pair.region, pair.twin.place_m)):
        if taken.get(pair.place.name, 0) < most and len(found) < count:
            taken[pair.place.name] = taken.get(pair.place.name, 0) + 1
            found.append(pair)
    return found


def asked(suite: str, out: Path) -> pd.DataFrame:
    """Return the scored answers of all matchers to a suite on train places: a row for each query and matcher."""
    tables = []
    for folder in sorted((out / "tasks" / suite).glob("*")):
        task = task_files.Task.open(folder, out)
        truths = list(task_files.read_truths(task.truth))
        about = {truth.query_id: truth.measured for truth in truths}
        for matcher in MATCHERS:
            (run,) = (out / "runs" / matcher).glob(f"*/{suite}/{folder.name}")
            answers = {item.query_id: item for item in read_predictions(run) if item.query_id in about}
            rows = score_task(task.heads(), truths, answers).assign(matcher=matcher, region=folder.name)
            rows["margin"] = [about[query].get("margin", np.nan) for query in rows["query_id"]]
            rows["spot"] = [_spot(truth.pose) for truth in truths]
            rows["found"] = rows["position_error_m"] <= WITHIN_M
            rows["at_twin"] = [_is_at_twin(truth, answers.get(truth.query_id)) for truth in truths]
            tables.append(rows)
    return pd.concat(tables, ignore_index=True)


def _spot(pose: Pose | None) -> str:
    return "" if pose is None else f"{pose.easting_m:.1f} {pose.northing_m:.1f}"


def _is_at_twin(truth: Truth, answer: Prediction | None) -> bool:
    """Return whether an answer takes the twin for the place."""
    if answer is None or not answer.candidates or truth.pose is None or TWIN_EAST not in truth.measured:
        return False
    first = answer.candidates[0][0]
    east_m = first.easting_m - truth.pose.easting_m - truth.measured[TWIN_EAST]
    north_m = first.northing_m - truth.pose.northing_m - truth.measured[TWIN_NORTH]
    return bool(np.hypot(east_m, north_m) <= WITHIN_M)


def _of_kind(rows: pd.DataFrame, kind: str) -> pd.DataFrame:
    """Return the rows of a kind, whether or not a plain search lists the twin."""
    return rows[rows["kind"].str.removeprefix(f"{UNRIVALLED} ") == kind]


def _line(title: str, rows: pd.DataFrame, cell: Callable[[pd.DataFrame], str]) -> str:
    """Return a line of a table with a column for each matcher."""
    cells = [cell(rows[rows["matcher"] == matcher]) for matcher in MATCHERS]
    return f"| {title} | {rows['query_id'].nunique()} | {' | '.join(cells)} |"


def _found_and_twin(rows: pd.DataFrame) -> str:
    return f"{rows['found'].mean():.2f}, {rows['at_twin'].mean():.2f}"


def results(rows: pd.DataFrame) -> str:
    """Return the table of what the matchers answered, by part of the suite."""
    return "\n".join(_line(title, _of_kind(rows, kind), _found_and_twin) for kind, title in PARTS)


def by_margin(rows: pd.DataFrame) -> str:
    """Return the same by margin, where the disc holds both."""
    stress = _of_kind(rows, "N1")
    steps = np.maximum(1, np.ceil(stress["margin"] / STEP - 1e-6)) * STEP
    return "\n".join(_line(f"to {high:.2f}", mine, _found_and_twin) for high, mine in stress.groupby(steps))


def absent(rows: pd.DataFrame) -> str:
    """Return the table of what was answered where the place is not in the disc."""
    return "\n".join(
        _line(title, _of_kind(rows, kind), lambda own: f"{own['at_twin'].mean():.2f}") for kind, title in ABSENT
    )


def shown_pairs(pairs: Sequence[Pair], rows: pd.DataFrame) -> list[tuple[Pair, int, int]]:
    """Return forty asked pairs over all margins, with how many matchers found each place and took the twin for it."""
    by_spot = {f"{pair.region} {pair.twin.place_m[0]:.1f} {pair.twin.place_m[1]:.1f}": pair for pair in pairs}
    found = [
        (by_spot[f"{region} {spot}"], int(own["found"].sum()), int(own["at_twin"].sum()))
        for (region, spot), own in _of_kind(rows, "N1").groupby(["region", "spot"], sort=True)
    ]
    found.sort(key=lambda one: (one[0].margin, one[0].region))
    chosen = np.unique(np.linspace(0, len(found) - 1, SHOWN).round().astype(int))
    return [found[at] for at in chosen]


def hardest(shown: Sequence[tuple[Pair, int, int]]) -> str:
    """Return the rows of the pairs that fewest matchers found."""
    order = sorted(enumerate(shown, start=1), key=lambda one: (one[1][1], one[1][0].margin))[:TOLD]
    return "\n".join(
        f"| {number} | {pair.region} | {pair.margin:.2f} | {right} | {wrong} |"
        for number, (pair, right, wrong) in order
    )


def main() -> None:
    """Write docs/twins.md and its two sheets, or mine alone."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--mine", action="store_true", help="mine alone, before queries are drawn")
    options = parser.parse_args()
    out: Path = options.out
    mine: dict[str, list[Pair]] = {}
    places = {place.name: place for place in split().spec.place if not place.sealed}
    for place in places.values():
        mine[place.name] = pairs_of(place, out)
    if options.mine:
        return
    pairs = [pair for found in mine.values() for pair in found]
    alike = likest(pairs, count=MINED, most=MOST_OF_PLACE)
    rows, away = asked("natural-twins", out), asked("natural-absent", out)
    shown = shown_pairs(pairs, rows)
    names = [f"{pair.region[:14]} {pair.margin:.2f}" for pair in alike]
    cv2.imwrite(str(FIGURES / "twins-mined.webp"), sheet_of(alike, names, out, side=64, across=10), WEBP)
    names = [
        f"{at}: {pair.region[:20]} {pair.margin:.2f}, {right} of {len(MATCHERS)}"
        for at, (pair, right, _) in enumerate(shown, 1)
    ]
    sheet = sheet_of([pair for pair, _, _ in shown], names, out, side=128, across=5)
    cv2.imwrite(str(FIGURES / "twins-asked.webp"), sheet, WEBP)
    thirds, rank, ranked = ranks_of(pairs)
    having = {name: found for name, found in mine.items() if found}
    text = PAGE.format(
        pairs=len(pairs),
        places=len(having),
        countries=len({places[name].country for name in having}),
        without=len(mine) - len(having),
        all=len(mine),
        mined=len(alike),
        most=MOST_OF_PLACE,
        mined_places=len({pair.place.name for pair in alike}),
        worst=max(pair.margin for pair in alike),
        thirds=thirds,
        rank=rank,
        ranked=ranked,
        least=LEAST_RANKED,
        matchers=" | ".join(f"`{name}`" for name in MATCHERS),
        rule="|---" * (2 + len(MATCHERS)) + "|",
        results=results(rows),
        absent=absent(away),
        away_n=_of_kind(away, "elsewhere")["query_id"].nunique(),
        away=_of_kind(away, "elsewhere")["margin"].median(),
        near=_of_kind(away, "twin alone")["margin"].median(),
        steps=by_margin(rows),
        both=rows.loc[rows["kind"] == "N1", "query_id"].nunique(),
        n=_of_kind(rows, "N1")["query_id"].nunique(),
        sites=len(rows[["region", "spot"]].drop_duplicates()),
        names=fill(", ".join(sorted(rows["region"].unique())), 120),
        shown=len(shown),
        lost=sum(right == 0 for _, right, _ in shown),
        told=TOLD,
        hard=hardest(shown),
        rows="\n".join(row_of(places[name], found) for name, found in having.items()),
    )
    (DOCS / "twins.md").write_text(text, encoding="utf-8")


if __name__ == "__main__":
    main()
