# SPDX-License-Identifier: Apache-2.0
"""Reference pages made from the code: public names, commands, metrics and columns, files, suites, methods."""

import ast
import inspect
import re
from collections.abc import Iterable, Iterator, Mapping
from functools import cache
from importlib import resources
from typing import Any, Final

import pyarrow as pa
import typer
from pydantic import BaseModel

from sasgeo_bench.boards.board_files import SCHEMAS
from sasgeo_bench.boards.pipeline_spec import (
    ContrastSpec,
    LearningSpec,
    PaperSpec,
    PipelineFile,
    TaskSpec,
)
from sasgeo_bench.boards.tables import MARKS, MEANINGS, TERMS
from sasgeo_bench.cli import program
from sasgeo_bench.core.plugins import MATCHERS, REJECTORS, SEGMENTERS, list_entry_points
from sasgeo_bench.geometry.pose import Prior
from sasgeo_bench.matching.matcher import Prediction
from sasgeo_bench.matching.submission import Card, Submission
from sasgeo_bench.osm.features import DTYPES
from sasgeo_bench.osm.locate import Extract, TownEntry
from sasgeo_bench.osm.taxonomy import load_taxonomy
from sasgeo_bench.regions.evidence import Evidence
from sasgeo_bench.regions.graph import EDGE_DTYPES, NODE_DTYPES
from sasgeo_bench.regions.region import Manifest, Provenance
from sasgeo_bench.regions.region_spec import RegionFile
from sasgeo_bench.running.prediction_files import PART_SCHEMA
from sasgeo_bench.scoring.metric import CostMetric, MeanMetric, Metric, QuantileMetric, RejectionMetric, ThresholdMetric
from sasgeo_bench.scoring.metrics import METRICS, TRACKS
from sasgeo_bench.tasks.query import Query, Truth
from sasgeo_bench.tasks.split import Place, SplitFile
from sasgeo_bench.tasks.suites.all_suites import EVERY_SUITE
from sasgeo_bench.tasks.task_files import FILE_SCHEMA, TRUTH_SCHEMA, TaskManifest

# Headings of the API pages, by the folder that a public name comes from.
STAGES: Final = {
    "cli": "Stages as functions",
    "core": "Errors, and bounds of an answer",
    "geometry": "Poses and grids",
    "osm": "OpenStreetMap features",
    "regions": "Regions and evidence",
    "search": "Dense pose search",
    "sensing": "Aerial images and segmentation",
    "tasks": "Queries and truths",
    "matching": "Matchers, rejectors and segmenters",
    "running": "Predictions and conformance",
    "boards": "Boards and queries in a notebook",
}
_MODELS: Final[dict[str, tuple[str, Mapping[str, type[BaseModel]]]]] = {
    "Region file": (
        "`regions/*.toml`",
        {"": RegionFile, "[[extract]]": Extract, "town": TownEntry, "[provenance]": Provenance},
    ),
    "Split file": ("`splits/*.toml`", {"": SplitFile, "[[place]]": Place}),
    "Pipeline file": (
        "`pipelines/*.toml`",
        {
            "": PipelineFile,
            "[[task]]": TaskSpec,
            "[[contrast]]": ContrastSpec,
            "[learning]": LearningSpec,
            "[paper]": PaperSpec,
        },
    ),
    "Submission card": ("`card.toml`", {"": Card}),
    "Submission": ("`submission.json`", {"": Submission}),
    "Region manifest": ("`region.json`", {"": Manifest}),
    "Task manifest": ("`task.json`", {"": TaskManifest}),
}
_TABLES: Final[dict[str, tuple[str, pa.Schema, tuple[type, ...]]]] = {
    "Queries": ("`out/tasks/<suite>/<region>/queries.parquet`", FILE_SCHEMA, (Query, Evidence, Prior)),
    "Truths": ("`out/truth/<suite>/<region>/truth.parquet`", TRUTH_SCHEMA, (Truth,)),
    "Predictions": ("`part-*.parquet` of a run, or a file of predictions", PART_SCHEMA, (Prediction,)),
}
_KINDS: Final = {  # of columns of a board's tables
    str: "text",
    bool: "bool",
    int: "int",
    float: "float",
    int | None: "int or missing",
    float | None: "float",
    str | None: "text or missing",
}
_PARAMETER: Final = re.compile(r"^    ([a-z_][\w, ]*?) : .*\n((?: {8}.*\n?|\n(?= {8}))+)", re.MULTILINE)


@cache
def pages() -> dict[str, str]:
    """Return every reference page by its path in the site."""
    return {
        **dict(_api()),
        "reference/cli.md": "\n".join(_cli()),
        "reference/metrics.md": "\n".join(_metrics()),
        "reference/files.md": "\n".join(_files()),
        "reference/suites.md": "\n".join(_suites()),
        "reference/methods.md": "\n".join(_methods()),
        "reference/classes.md": "\n".join(_classes()),
    }


def public_names() -> dict[str, tuple[str, ...]]:
    """Return the public names of `sasgeo_bench` by the module that they come from."""
    stub = ast.parse(resources.files("sasgeo_bench").joinpath("__init__.pyi").read_text(encoding="utf-8"))
    found: dict[str, tuple[str, ...]] = {}
    for node in stub.body:
        if isinstance(node, ast.ImportFrom):
            found[str(node.module)] = (*found.get(str(node.module), ()), *(alias.name for alias in node.names))
    return found


def table(head: Iterable[str], rows: Iterable[Iterable[object]]) -> list[str]:
    """Return the lines of a Markdown table; line breaks and bars in a cell are escaped."""
    names = list(head)
    cells = ([re.sub(r"\s+", " ", str(cell)).replace("|", r"\|").strip() for cell in row] for row in rows)
    return ["", _line(names), _line(["---"] * len(names)), *map(_line, cells), ""]


def meanings(kinds: Iterable[type]) -> dict[str, str]:
    """Return what numpydoc docstrings say of each parameter, the first line of classes first.

    Examples
    --------
    >>> meanings([Prior])["radius_m"].startswith("Radius")
    True
    """
    found: dict[str, str] = {}
    for kind in kinds:
        for names, text in _PARAMETER.findall(inspect.cleandoc(kind.__doc__ or "").replace("\n", "\n    ") + "\n"):
            for name in re.split(r",\s*", names):
                found.setdefault(name, re.sub(r"\s+", " ", text).strip())
    return found


def _line(cells: Iterable[str]) -> str:
    return f"| {' | '.join(cells)} |"


def _api() -> Iterator[tuple[str, str]]:
    """Yield a page for each stage that has public names, and the pages' index."""
    by_stage: dict[str, list[str]] = {}
    for module, names in public_names().items():
        by_stage.setdefault(module.split(".")[0], []).extend(f"sasgeo_bench.{module}.{name}" for name in names)
    index = [
        "# API",
        "",
        "`import sasgeo_bench as sgb` gives every public name, each imported when first used. Plugins need no other.",
    ]
    index += table(
        ("Name", "What it is"),
        (
            (f"[`sgb.{path.rsplit('.', 1)[1]}`][{path}]", _summary(path))
            for paths in by_stage.values()
            for path in paths
        ),
    )
    yield "reference/api/index.md", "\n".join(index)
    for stage, paths in by_stage.items():
        blocks = [f"# {STAGES.get(stage, stage.capitalize())}", ""]
        for path in paths:
            blocks += [f"::: {path}", ""]
        yield f"reference/api/{stage}.md", "\n".join(blocks)


def _summary(path: str) -> str:
    """Return the first line of a public name's docstring, or its value if it is a constant."""
    import sasgeo_bench as sgb  # noqa: PLC0415 - beside the one use

    value = getattr(sgb, path.rsplit(".", 1)[1])
    if inspect.isclass(value) or inspect.isfunction(value):
        return (inspect.getdoc(value) or "").split("\n\n")[0].split("\n")[0]
    return f"A constant, `{value}`" if isinstance(value, int | str) else f"A constant, {type(value).__name__}"


def _cli() -> Iterator[str]:
    yield "# Command line"
    yield ""
    yield f"`sasgeo-bench COMMAND`. {program.HELP}"
    yield ""
    yield "Exit status: 0 done; 1 a fault of the program; 2 a fault of the input, on one line; 3 a control of a board "
    yield "failed; 4 a matcher or file failed, and the board was written without it."
    with typer.Context(typer.main.get_command(program.app), info_name="sasgeo-bench") as parent:
        for group, commands in program.COMMANDS.items():
            yield f"\n## {group}"
            for name in commands:
                yield from _command(name, parent)


def _command(name: str, parent: typer.Context) -> Iterator[str]:
    """Yield the section of one command."""
    command = program.load(name)
    context = typer.Context(command, info_name=name, parent=parent)
    yield f"\n### {name}\n"
    yield f"```text\nsasgeo-bench {name} {' '.join(command.collect_usage_pieces(context))}\n```\n"
    yield _escaped(program.help_of(_file_of(name), name))
    rows = []
    for parameter in command.get_params(context):
        record = parameter.get_help_record(context)
        if record and parameter.name != "help":
            rows.append((f"`{record[0].strip()}`", _escaped(record[1])))
    if rows:
        yield from table(("Argument or option", "What it does"), rows)


def _file_of(name: str) -> str:
    return next(group[name] for group in program.COMMANDS.values() if name in group)


def _escaped(text: str) -> str:
    """Return text of a help page as Markdown that shows it as it is."""
    plain = re.sub(r"\[/?(?:dim|red|bold|yellow|green)[^\]]*\]", "", text)
    return re.sub(r"([*_\[])", r"\\\1", re.sub(r"(?m)^ +", "", plain)).replace("<", "&lt;")


def _metrics() -> Iterator[str]:
    """Yield the page of the one table of metrics, and of the columns and words next to them."""
    yield "# Metrics and columns"
    yield ""
    yield "Every metric of a board, as `leaderboard.parquet` names it. [How a board is made](../concepts/board.md) has"
    yield "the rules that all of them share. Matchers are ranked by the metric in bold."
    for track in TRACKS:
        yield f"\n## {track.capitalize()}"
        yield from _metric_rows(item for item in METRICS if isinstance(item, MeanMetric) and track in item.tracks)
    for title, kind in (
        ("Quantiles of errors", QuantileMetric),
        ("Rejection", RejectionMetric),
        ("Rejection at a threshold", ThresholdMetric),
        ("Costs", CostMetric),
    ):
        yield f"\n## {title}"
        yield from _metric_rows(item for item in METRICS if isinstance(item, kind))
    others = {name: text for name, text in MEANINGS.items() if name not in {item.name for item in METRICS}}
    for title, words in (("Other columns of tables", others), ("Terms", TERMS), ("Marks next to names", MARKS)):
        yield f"\n## {title}"
        yield from table(("Word", "Meaning"), ((f"`{name}`", text) for name, text in words.items()))
    for name, schema in SCHEMAS.items():
        yield f"## `{name}.parquet`"
        rows = ((f"`{one.name}`", f"`{_KINDS[one.kind]}`", one.meaning) for one in schema.columns)
        yield from table(("Column", "Type", "What it holds"), rows)


def _metric_rows(metrics: Iterable[Metric]) -> list[str]:
    return table(
        ("Metric", "Unit", "Better", "Bounds", "What it says", "Source"),
        (
            (
                f"**`{item.name}`**" if getattr(item, "is_primary", False) else f"`{item.name}`",
                item.unit,
                item.better,
                f"{item.bounds[0]:g} to {item.bounds[1]:g}",
                item.meaning,
                item.source,
            )
            for item in metrics
        ),
    )


def _files() -> Iterator[str]:
    yield "# File schemas"
    yield ""
    yield "Tables are Parquet, vectors GeoParquet 1.1, rasters cloud-optimized GeoTIFF. TOML files are read strictly: "
    yield "an unknown key is refused."
    for title, (place, schema, kinds) in _TABLES.items():
        said = meanings(kinds)
        yield f"\n## {title}\n\n{place}"
        rows = ((f"`{field.name}`", f"`{_type_of(field.type)}`", _meaning(field.name, said)) for field in schema)
        yield from table(("Column", "Type", "What it holds"), rows)
    for name, dtypes in (("features", DTYPES), ("nodes", NODE_DTYPES), ("edges", EDGE_DTYPES)):
        yield f"\n## {name.capitalize()} of a region\n\n`out/regions/<region>/{name}.parquet`"
        yield from table(("Column", "Type"), ((f"`{column}`", f"`{kind}`") for column, kind in dtypes.items()))
    for title, (place, models) in _MODELS.items():
        yield f"\n## {title}\n\n{place}"
        for part, model in models.items():
            if part:
                yield f"\n### `{part}` of a {title.lower()}"
            yield from _model(model)


def _meaning(column: str, said: Mapping[str, str]) -> str:
    """Return what the docstrings say of a column; `prior_radius_m` is `radius_m` of a prior."""
    return said.get(column) or said.get(column.removeprefix("prior_"), "")


def _type_of(kind: pa.DataType) -> str:
    return re.sub(r"\s+", " ", str(kind)).replace("element: ", "").replace("item: ", "")


def _model(model: type[BaseModel]) -> Iterator[str]:
    """Yield a table of the keys of a document."""
    schema = model.model_json_schema()
    said, needed = meanings([model]), schema.get("required", ())
    rows = (
        (
            f"`{name}`",
            _kind(about),
            "required" if name in needed else f"`{about.get('default')!r}`",
            said.get(name) or about.get("description", ""),
        )
        for name, about in schema["properties"].items()
    )
    head = ("Key", "Value", "Default", "What it is")
    lines = list(rows)
    yield from table(head, lines) if any(row[3] for row in lines) else table(head[:3], (row[:3] for row in lines))


def _kind(about: Mapping[str, Any]) -> str:
    """Return the type of a key in words, with its limits."""
    if "anyOf" in about:
        return " or ".join(_kind(item) for item in about["anyOf"] if item.get("type") != "null")
    if "enum" in about or "const" in about:
        return ", ".join(f"`{item}`" for item in about.get("enum", [about.get("const")]))
    if "$ref" in about:
        return f"table `{about['$ref'].rsplit('/', 1)[1]}`"
    if about.get("type") == "array":
        return f"list of {_kind(about.get('items', {}))}" if "items" in about else "list"
    limits = {"minimum": ">=", "exclusiveMinimum": ">", "maximum": "<=", "exclusiveMaximum": "<"}
    said = [f"{sign} {about[name]:g}" for name, sign in limits.items() if name in about]
    if "maxLength" in about:
        said.append(f"at most {about['maxLength']} characters")
    return ", ".join((str(about.get("format", about.get("type", "table"))), *said))


def _suites() -> Iterator[str]:
    yield "# Suites"
    yield ""
    yield "Every suite, from its card. [Suite](../concepts/suite.md) says how queries are made of them."
    for name, suite in EVERY_SUITE.items():
        card, kinds = suite.card, dict.fromkeys(item.kind for item in suite.variants if item.role == "stress")
        yield f"\n## {name}\n\n**{card.title}.** {card.what}\n"
        rows = {
            "Separates": card.separates,
            "Falsifier": card.falsifier,
            "Stresses": ", ".join(kinds),
            "Strength": card.strength_unit,
            "Tracks": ", ".join(card.tracks),
            "Version": card.version,
        }
        yield from table(("", ""), (item for item in rows.items() if item[1]))


def _methods() -> Iterator[str]:
    yield "# Matchers, rejectors and segmenters"
    yield ""
    yield "Every method that comes with the program, from its card."
    for title, group in (("Matchers", MATCHERS), ("Rejectors", REJECTORS), ("Segmenters", SEGMENTERS)):
        yield f"\n## {title}"
        for name, point in sorted(list_entry_points(group).items()):
            if point.dist is not None and not point.dist.name.startswith("sasgeo-"):
                continue
            card = point.load().card
            yield f"\n### {name}\n\n**{card.title}.** Version {card.version}, {card.licence}; `{point.value}`\n"
            rows = [(item.capitalize(), getattr(card, item, "")) for item in ("source", "ours", "needs", "limits")]
            said = ((item, text if isinstance(text, str) else ", ".join(text)) for item, text in rows)
            yield from table(("", ""), (row for row in said if row[1]))


def _classes() -> Iterator[str]:
    yield "# Semantic classes"
    yield ""
    yield "The classes of `osm/taxonomy.toml`, in the order of the bands of `layers.tif`. Priors and rates are by hand"
    yield "(Eq. 5 of the SASGeo paper)."
    yield from table(
        ("Id", "Name", "Title", "Kind", "Keys of OSM", "Prior", "Vanish per year", "Appear per year"),
        (
            (
                item.id,
                f"`{item.name}`",
                item.title,
                item.kind,
                ", ".join(dict.fromkeys(f"`{rule.key}`" for rule in item.rules)),
                item.persistence.prior,
                item.persistence.vanish_per_year,
                item.persistence.appear_per_year,
            )
            for item in load_taxonomy().classes
        ),
    )
