# SPDX-License-Identifier: Apache-2.0
"""Commands that show the weights of classes and places in the SASGeo scorer."""

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Final

import pandas as pd
import typer
from rich.table import Table

from sasgeo_bench.cli.built_regions import built_region
from sasgeo_bench.cli.console import print_table, say
from sasgeo_bench.cli.options import Out
from sasgeo_bench.core.errors import ConfigError
from sasgeo_bench.matching.cards import WHERE, read_learned
from sasgeo_bench.osm.taxonomy import load_taxonomy
from sasgeo_bench.regions.region import Region
from sasgeo_bench.regions.region_files import read_region
from sasgeo_bench.sasgeo.class_weights import (
    AGES_YEARS,
    check_age,
    check_classes,
    check_season,
    class_weight_table,
    class_weights_of,
    rarity_map,
    side_by_side,
    weight_map,
)
from sasgeo_bench.sasgeo.scorer_model import ScorerModel
from sasgeo_bench.sasgeo.weight_plot import WeightSheet, draw_weights, top_of

# Column of the table, what it says, what it is multiplied with, digits.
WEIGHT: Final = ("weight", "weight of 100 m2 that are mapped and seen, after the exponent: nats", 1, 2)
INFORMATION: Final = ("information", "information between map and view: thousandths of a nat a cell", 1000, 1)
GAINS: Final = (
    ("agree", "gain where mapped and seen (Eq. 7): nats a cell", 1, 2),
    ("extra", "gain where seen and not mapped: nats a cell", 1, 2),
    ("missed", "gain where mapped and seen to be absent: nats a cell", 1, 2),
    ("quiet", "gain where neither mapped nor seen: nats a cell", 1, 2),
)
Learned = Annotated[
    Path | None, typer.Option(help="the text that a matcher learned: out/runs/<matcher>/<hash>/learned/<sha>.json")
]


def weights_command(
    region: Annotated[
        str | None, typer.Argument(help="a built region or its folder: draws a map of the weights")
    ] = None,
    learned: Learned = None,
    age: Annotated[
        list[float] | None,
        typer.Option(metavar="YEARS", help="of the map; may be repeated; default: 0 2 5 10 20, and 0 for the picture"),
    ] = None,
    season: Annotated[str, typer.Option(help="of the view: leaf_on, snow, low_water or harvest; default: none")] = "",
    out: Out = Path("out"),
) -> None:
    """Print the weight of each class as the map ages; draw the weight of each cell of a region."""
    ages = sorted({check_age(one) for one in age or ()})
    check_season(season)
    model = read_model(learned)
    place = None if region is None else find_region(region, out=out)
    classes = load_taxonomy().names if place is None else place.classes
    models = {"hand": ScorerModel.by_hand(classes)}
    if model is not None:
        models["fitted"] = check_classes(model, () if place is None else place.classes)
    tables = {
        name: class_weight_table(known, ages_years=ages or AGES_YEARS, season=season) for name, known in models.items()
    }
    for column, title, factor, digits in (WEIGHT, *(GAINS if model else ()), INFORMATION):
        say(title)
        print_table(_table(side_by_side(tables, column) * factor, digits))
    if place is not None:
        for path in _drawn(place, list(models.values())[-1], ages=ages or [0.0], season=season, out=out):
            say(f"map of weights: {path}")


def read_model(path: Path | None) -> ScorerModel | None:
    """Read a fitted model whose classes this program knows; None if no file is named."""
    if path is None:
        return None
    text = read_learned(path)
    if text is None:
        raise ConfigError(f"there is no file {path}: {WHERE}")
    try:
        return check_classes(ScorerModel.from_text(text))
    except ConfigError as error:
        raise ConfigError(f"{path} is no learned text of a sasgeo matcher, {WHERE}: {error}") from error


def find_region(name: str, *, out: Path) -> Region:
    """Read a built region by its name or folder; a refusal suggests the nearest name."""
    folder = built_region(name, out)
    region = read_region(folder)
    strange = [item for item in region.classes if item not in load_taxonomy().names]
    if strange:
        raise ConfigError(
            f"{folder} has a class {strange[0]!r} that this version does not know: build the region again"
        )
    return region


def _table(wide: pd.DataFrame, digits: int) -> Table:
    columns = [f"{column[0]}\n{column[1]:g} y" for column in wide.columns]
    table = Table("class", *columns, box=None, pad_edge=False, padding=(0, 1, 0, 0))
    for column in table.columns[1:]:
        column.justify = "right"
    for name, row in zip(wide.index, wide.to_numpy(), strict=True):
        table.add_row(name, *(f"{value:.{digits}f}" for value in row))
    return table


def _drawn(region: Region, model: ScorerModel, *, ages: Sequence[float], season: str, out: Path) -> list[Path]:
    """Draw a map of weights for each age, all by one scale of colours."""
    rarity = rarity_map(region)
    by_class = {age: class_weights_of(model, age_years=age, season=season) for age in ages}
    maps = {age: weight_map(region.layers, by_class[age], rarity) for age in ages}
    top = top_of(list(maps.values()))
    source = "weights fitted" if model.views else "weights by hand"
    (out / "sheets").mkdir(parents=True, exist_ok=True)
    paths = []
    for age in ages:
        sheet = WeightSheet(
            manifest=region.manifest,
            layers=region.layers,
            weights=maps[age],
            class_weights=dict(zip(region.classes, by_class[age].tolist(), strict=True)),
            top=top,
            facts=f"taken to be {age:g} years old  |  season: {season or 'unknown'}  |  {source}",
        )
        name = f"{region.manifest.id}-{region.manifest.extract.date}-{age:g}y{f'-{season}' if season else ''}"
        paths.append(out / "sheets" / f"weights-{name}{'-fitted' if model.views else ''}.png")
        draw_weights(paths[-1], sheet)
    return paths
