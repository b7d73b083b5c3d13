# SPDX-License-Identifier: Apache-2.0
"""Say which part of its lessons teaches `osm_unet` what, on real pictures that taught nothing; one table of ablations.

    .venv/bin/pip install torch onnx
    .venv/bin/python benchmarks/ablate_segmenter.py --out out --steps 2000 > out/ablations.md

`--out` holds the built regions that `train_segmenter.py` needs, and those of `--places`. Each arm is a network that is
taught from nothing, by the same recipe and number of steps, then asked at `--places` as `real_pictures.py` asks it:

- `both`: a drawn share of 0.3; `drawn`, `real`: one of the two alone; `drawn-again`: as `drawn`, by another seed
- `real-pardubice`: no Banepa; `real-1km2`, `real-2km2`, `real-4km2`: boxes of such an area around the middle of that
- `drawn-without-NAME`: a switch of `Ingredients` off

A result lies in `--out`/segmenters/ablations and is not made again; an arm that was cut off goes on from its last part
of steps. `--table` prints what lies there, without PyTorch. In brackets is the difference to the arm's base; a second
table has those of the drawn world alone, for the places in their order. A network
of another seed differs too: what is not far above the row of `drawn-again` says nothing.
"""

import argparse
import math
import sys
import time
from collections.abc import Mapping, Sequence
from contextlib import redirect_stdout
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import Final

import shapely
from pydantic import ValidationError
from sasgeo_baselines.segmenters.osm_unet import OsmUNet

import sasgeo_bench as sgb
from benchmarks.real_pictures import GSD_M, SIDE_PX, Area, areas_of, counted, part_of, views_of
from benchmarks.segmenter_lessons import DRAWN, HELD, PART, REAL, Part, Source, region_of, sources_of, trainer
from sasgeo_bench.core.config import JsonDocument
from sasgeo_bench.core.errors import SasgeoError, StoreError
from sasgeo_bench.core.folders import fresh_file
from sasgeo_bench.core.json import read_json
from sasgeo_bench.core.texts import json_text
from sasgeo_bench.sensing.rendering.wild import Ingredients

SHOWN: Final = ("building", "road", "water", "green", "farmland")
PLACES: Final = (Part("chateaugiron-ortho"), Part("andorra-la-vella-ortho"), HELD)
DRAWN_SHARE: Final = 0.3  # of what ships
FOLDER: Final = Path("segmenters", "ablations")


@dataclass(frozen=True, kw_only=True)
class Arm:
    """What teaches one network; `km2` cuts a box out of the middle of its picture, `base` is compared with it."""

    base: str | None = None
    drawn: tuple[str, ...] = ()
    real: tuple[Part, ...] = ()
    km2: float | None = None
    look: Ingredients = field(default_factory=Ingredients)
    seed: int = 0

    def sources(self, out: Path) -> list[Source]:
        """Return where its crops come from."""
        real = self.real if self.km2 is None else [middle_of(part, self.km2, out) for part in self.real]
        return sources_of(self.drawn, real, DRAWN_SHARE, out, look=self.look)


def without(name: str) -> Ingredients:
    """Return all ingredients but one."""
    return replace(Ingredients(), **{name: getattr(Ingredients.none(), name)})


ARMS: Final[Mapping[str, Arm]] = {
    "both": Arm(drawn=DRAWN, real=REAL),
    "drawn": Arm(base="both", drawn=DRAWN),
    "drawn-again": Arm(base="drawn", drawn=DRAWN, seed=1),
    "real": Arm(base="both", real=REAL),
    "real-pardubice": Arm(base="real", real=REAL[:1]),
    **{f"real-{km2}km2": Arm(base="real-pardubice", real=REAL[:1], km2=km2) for km2 in (1, 2, 4)},
    **{
        f"drawn-without-{each.name}": Arm(base="drawn", drawn=DRAWN, look=without(each.name))
        for each in fields(Ingredients)
    },
}


def middle_of(part: Part, km2: float, out: Path) -> Part:
    """Return the box of an area around the middle of a part, in its proportions; end with one line if it is smaller."""
    west, east, north, south = part.box
    all_km2 = shapely.box(*part_of(region_of(part.region, out), part.box)).area / 1e6
    if km2 > all_km2:
        raise SystemExit(f"{part} has {all_km2:.2f} km2, {km2:g} are asked for: take a smaller box")
    across, along = (math.sqrt(km2 / all_km2) * side / 2 for side in (east - west, south - north))
    u, v = (west + east) / 2, (north + south) / 2
    return Part(part.region, (u - across, u + across, v - along, v + along))


class PlaceResult(JsonDocument):
    """What an arm sees at one place: number of views, and areas under the curve by class."""

    views: int
    areas: dict[str, Area]


class Result(JsonDocument):
    """What an arm of some steps sees, by place; of at most `views` views of each."""

    arm: str
    steps: int
    views: int
    places: dict[str, PlaceResult]


@dataclass(frozen=True, kw_only=True)
class Plan:
    """What is asked for; `steps` are whole parts, or fewer than one."""

    out: Path = Path("out")
    steps: int
    arms: tuple[str, ...] = tuple(ARMS)
    places: tuple[Part, ...] = PLACES
    views: int = 200

    def path(self, arm: str, ending: str) -> Path:
        """Return where something of an arm is kept."""
        return self.out / FOLDER / f"{arm}-{self.steps}{ending}"

    def result(self, arm: str) -> Result | None:
        """Read what an arm sees; None if it is not done. Raise `StoreError` if it is of another plan, or damaged."""
        path, mend = self.path(arm, ".json"), "remove it, or take another --out"
        if not path.exists():
            return None
        try:
            result = Result.model_validate(read_json(path, mend=mend))
        except ValidationError as error:
            raise StoreError(f"{path} is no result of an arm: {mend}") from error
        if (result.arm, result.steps) != (arm, self.steps):
            raise StoreError(f"{path} is of {result.arm} and {result.steps} steps: {mend}")
        if (result.views, set(result.places)) != (self.views, set(map(str, self.places))):
            given = f"--views {result.views} --places {' '.join(result.places)}"
            raise StoreError(f"{path} was made with {given}: give the same, {mend}")
        return result


def stride_of(region: sgb.Region, part: Part, most: int) -> int:
    """Return which views to ask, so that a part has at most `most`: every second, every third ..."""
    west, south, east, north = part_of(region, part.box)
    side_m = GSD_M * SIDE_PX
    return math.ceil(math.ceil((east - west) / side_m) * math.ceil((north - south) / side_m) / most)


def check_untaught(sources: Sequence[Source], places: Sequence[Part], out: Path) -> None:
    """End with one line if a picture is asked that taught."""
    for part in places:
        region = region_of(part.region, out)
        asked = shapely.box(*part_of(region, part.box))
        for one in sources:
            taught = one.regions[0]
            if one.box is None or taught.grid.epsg != region.grid.epsg:
                continue
            if shapely.box(*part_of(taught, one.box)).intersection(asked).area > 1:  # m2
                raise SystemExit(f"{part} shows ground whose picture teaches ({taught.manifest.id}): ask another part")


def carry_out(arm: str, plan: Plan) -> None:
    """Teach an arm, ask it, and keep what it sees."""
    teach = trainer()
    sources, state, weights = ARMS[arm].sources(plan.out), plan.path(arm, ".pt"), plan.path(arm, ".onnx")
    check_untaught(sources, plan.places, plan.out)
    state.parent.mkdir(parents=True, exist_ok=True)
    began = time.perf_counter()
    print(f"{arm} {'goes on' if state.exists() else 'begins'}", flush=True)
    recipe = teach.Recipe(steps=plan.steps, part=min(PART, plan.steps), seed=ARMS[arm].seed)
    teach.export(teach.train(sources, state, recipe), weights)
    segmenter, places = OsmUNet(weights), {}
    for part in plan.places:
        region = region_of(part.region, plan.out)
        counts = list(counted(segmenter, views_of(region, part.box, stride_of(region, part, plan.views))))
        places[str(part)] = PlaceResult(views=len(counts), areas=areas_of(counts))
    result = Result(arm=arm, steps=plan.steps, views=plan.views, places=places)
    with fresh_file(plan.path(arm, ".json"), mend="check your rights and the free space") as scratch:
        scratch.write_text(json_text(result.model_dump(mode="json")), encoding="utf-8")
    state.unlink()
    print(f"{arm} is done in {time.perf_counter() - began:.0f} s", flush=True)


def table(results: Mapping[str, Result]) -> str:
    """Return results as Markdown: the area under the curve by class, and how much the base has less of it."""
    lines = [f"| arm | place | n | {' | '.join(SHOWN)} |", f"|---|---|{'---:|' * (1 + len(SHOWN))}"]
    for arm, result in results.items():
        base = results.get(ARMS[arm].base or "")
        for place, found in result.places.items():
            cells = []
            for name in SHOWN:
                area, other = found.areas.get(name), base and base.places[place].areas.get(name)
                cells.append("-" if area is None else f"{area.auc:.3f}")
                if area and other:
                    cells[-1] += f" ({area.auc - other.auc:+.3f})"
            lines.append(f"| {arm} | {place} | {found.views} | {' | '.join(cells)} |")
    return "\n".join(lines)


def differences(results: Mapping[str, Result]) -> str:
    """Return how much less the drawn world teaches without an ingredient, by class, a place after the other."""
    lines = [f"| arm | {' | '.join(SHOWN)} |", f"|---|{'---|' * len(SHOWN)}"]
    for arm, result in results.items():
        base = results.get(ARMS[arm].base or "")
        if base is None or ARMS[arm].base != "drawn":
            continue
        cells = []
        for name in SHOWN:
            pairs = [
                (found.areas.get(name), base.places[place].areas.get(name)) for place, found in result.places.items()
            ]
            cells.append(", ".join(f"{area.auc - other.auc:+.2f}" for area, other in pairs if area and other) or "-")
        lines.append(f"| {arm} | {' | '.join(cells)} |")
    return "\n".join(lines)


def planned(arguments: Sequence[str] | None = None) -> tuple[Plan, bool]:
    """Parse the command line: what is asked for, and whether the table alone is."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Plan.out)
    parser.add_argument("--steps", type=int, default=2000, help=f"rounded up to parts of {PART}, or fewer than one")
    parser.add_argument("--arms", default=",".join(ARMS), help="names with commas between them; all by default")
    parser.add_argument(
        "--places", nargs="+", type=Part.parse, default=PLACES, help="NAME or NAME:WEST,EAST,NORTH,SOUTH"
    )
    parser.add_argument("--views", type=int, default=Plan.views, help="of a place, at most: every second, third ...")
    parser.add_argument("--table", action="store_true", help="teach nothing, print what is done")
    given = parser.parse_args(arguments)
    arms = tuple(given.arms.split(","))
    if strange := [name for name in arms if name not in ARMS]:
        parser.error(f"there is no arm {strange[0]!r}: choose among {', '.join(ARMS)}")
    if min(given.steps, given.views) < 1:
        parser.error(f"--steps and --views are at least 1, got {given.steps} and {given.views}")
    steps = given.steps if given.steps < PART else math.ceil(given.steps / PART) * PART
    return Plan(out=given.out, steps=steps, arms=arms, places=tuple(given.places), views=given.views), given.table


def main() -> None:
    """Teach the arms that are not done, and print the table of those that are."""
    plan, is_table = planned()
    try:
        for arm in plan.arms if not is_table else ():
            if plan.result(arm) is None:
                with redirect_stdout(sys.stderr):
                    carry_out(arm, plan)
        results = {arm: result for arm in ARMS if (result := plan.result(arm))}
        if is_table and not results:
            raise SystemExit(f"no arm of {plan.steps} steps is done in {plan.out / FOLDER}: leave --table out, once")
        print(table(results), differences(results), sep="\n\n")
    except SasgeoError as error:
        raise SystemExit(str(error)) from error


if __name__ == "__main__":
    main()
