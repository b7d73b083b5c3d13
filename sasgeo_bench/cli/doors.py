# SPDX-License-Identifier: Apache-2.0
"""Commands about plugins of every kind: list them, write a new one, check one."""

import shlex
import shutil
import sys
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import fields, is_dataclass
from enum import StrEnum
from importlib import import_module
from pathlib import Path
from typing import Annotated, Any, Final, NamedTuple

import typer
from rich.table import Table

from sasgeo_bench.cli.console import EXIT_USER, complain, print_table, say
from sasgeo_bench.cli.options import RegionFolders
from sasgeo_bench.core.errors import ConfigError, MatchError, counted
from sasgeo_bench.core.plugins import (
    MATCHERS,
    METRICS,
    ORACLE,
    ORACLE_SEGMENTER,
    PERTURBATIONS,
    REJECTORS,
    SEGMENTERS,
    SUITES,
    TRACKERS,
    list_entry_points,
    unknown,
)
from sasgeo_bench.core.progress import tell
from sasgeo_bench.core.texts import one_line, plain

_OF_DEMO: Final = "demo-"  # too many made-up towns to list


class _Door(NamedTuple):
    """What the commands do for one kind of plugin; functions are imported when they are called."""

    group: str
    load: str
    check: str | None = None
    control: str | None = None  # the runner's own, which is no plugin


_DOORS: Final = {
    "matcher": _Door(
        MATCHERS,
        "matching.plugins:load_matcher",
        "running.testing:check_matcher",
        ORACLE,
    ),
    "tracker": _Door(
        TRACKERS,
        "matching.plugins:load_tracker",
        "running.tracker_testing:check_tracker",
        ORACLE,
    ),
    "segmenter": _Door(
        SEGMENTERS,
        "matching.plugins:load_segmenter",
        "running.segmenter_testing:check_segmenter",
        ORACLE_SEGMENTER,
    ),
    "rejector": _Door(REJECTORS, "matching.plugins:load_rejector"),
    "suite": _Door(
        SUITES,
        "tasks.suites.all_suites:find_suite",
        "running.suite_testing:check_suite",
    ),
    "metric": _Door(
        METRICS,
        "scoring.metric_plugins:find_metric",
        "scoring.metric_testing:check_metric",
    ),
    "perturbation": _Door(
        PERTURBATIONS,
        "tasks.perturbations.all_perturbations:find_perturbation",
        "running.perturbation_testing:check_perturbation",
    ),
}
_IN_PROCESS: Final = ("suite", "metric", "perturbation")  # which run inside the program, without a sandbox


class Listed(StrEnum):
    """What can be listed."""

    REGIONS = "regions"
    SUITES = "suites"
    MATCHERS = "matchers"
    TRACKERS = "trackers"
    SEGMENTERS = "segmenters"
    REJECTORS = "rejectors"
    METRICS = "metrics"
    PERTURBATIONS = "perturbations"


class New(StrEnum):
    """What a package can be written of."""

    MATCHER = "matcher"
    TRACKER = "tracker"
    SEGMENTER = "segmenter"
    SUITE = "suite"
    METRIC = "metric"
    PERTURBATION = "perturbation"


def list_command(
    kind: Annotated[Listed, typer.Argument(help="what to list")],
    name: Annotated[
        str | None, typer.Argument(help="show the card of one: a name of the list, or module:Class")
    ] = None,
    regions: RegionFolders = None,
) -> None:
    """List regions, suites, metrics or installed plugins, and where each comes from; or show the card of one."""
    if kind is Listed.REGIONS:
        if name is not None:
            raise ConfigError(f"a region has no card: sasgeo-bench inspect {one_line(name)} shows a built one")
        _list_regions(regions)
        return
    door = _DOORS[kind.removesuffix("s")]
    if name is not None and name == door.control:
        say(f"{name}: a control, given the truth, and has no card")
    elif name is not None:
        found = _function(door.load)(name)
        _show(getattr(found, "card", found))
    elif kind is Listed.SUITES:
        _list_suites()
    elif kind is Listed.METRICS:
        _list_metrics()
    else:
        _list(kind.removesuffix("s"), door)


def _function(place: str) -> Callable[..., Any]:
    module, _, name = place.partition(":")
    return getattr(import_module(f"sasgeo_bench.{module}"), name)  # type: ignore[no-any-return]


def _list(kind: str, door: _Door) -> None:
    rows = {
        name: (point.dist.name if point.dist is not None else "", point.value)
        for name, point in list_entry_points(door.group).items()
    }
    if kind == "perturbation":
        from sasgeo_bench.tasks.perturbations.all_perturbations import SHIPPED  # noqa: PLC0415

        ours = {name: type(one) for name, one in SHIPPED.items()}
        rows |= {name: ("sasgeo-bench", f"{one.__module__}:{one.__name__}") for name, one in ours.items()}
    if door.control:
        rows[door.control] = ("sasgeo-bench", "a control, given the truth")
    table = Table(kind, "package", "class", box=None, pad_edge=False)
    for name, cells in sorted(rows.items()):
        table.add_row(name, *cells)
    print_table(table)


def _list_regions(folders: Iterable[Path] | None) -> None:
    from sasgeo_bench.core.config import shipped_dir  # noqa: PLC0415
    from sasgeo_bench.regions.region_spec import OWN_FOLDER, list_region_files, read_region_file  # noqa: PLC0415

    table = Table("id", "title", "km2", "cell", "dates", "scenes", box=None, pad_edge=False)
    own = (OWN_FOLDER,) if OWN_FOLDER.is_dir() else ()
    files = list_region_files(folders=(*(folders or ()), *own))
    shipped = shipped_dir("regions")
    of_demo = sorted(name for name, path in files.items() if name.startswith(_OF_DEMO) and path.parent == shipped)
    for name in sorted(files.keys() - set(of_demo)):
        spec = read_region_file(files[name])
        grid = spec.grid()
        area_km2 = grid.rows * grid.cols * grid.cell_size_m**2 / 1e6
        dates = [extract.date.isoformat() for extract in spec.extract]
        shown = dates[0] if len(dates) == 1 else f"{dates[0]} .. {dates[-1]} ({len(dates)})"
        table.add_row(name, spec.title, f"{area_km2:.1f}", f"{grid.cell_size_m:g} m", shown, ", ".join(spec.scenes))
    print_table(table)
    tell(f"and {len(of_demo)} small towns of `leaderboard demo`, {_OF_DEMO}...: regions/README.md")


def _list_suites() -> None:
    """Print the suites in the order of docs/unsolved.md: what is open first, most headroom first."""
    from sasgeo_bench.boards.headroom import OPEN, headroom_of, read_headroom  # noqa: PLC0415
    from sasgeo_bench.tasks.suites.all_suites import find_suite, list_suites  # noqa: PLC0415

    def row(name: str) -> tuple[str, ...]:
        suite, best = find_suite(name), headroom_of(name)
        per_site = str(sum(len(suite.tracks(variant)) for variant in suite.variants))
        left = "-" if best is None else f"{best.headroom:.2f}" if best.state == OPEN else best.state
        return suite.card.title, ", ".join(suite.card.tracks), per_site, left, suite.card.separates

    asked = list(dict.fromkeys(one.suite for one in read_headroom()))
    names = sorted(list_suites(), key=lambda name: asked.index(name) if name in asked else len(asked))
    _list_rows(("suite", "title", "tracks", "per site", "headroom", "separates"), names, row)
    tell("headroom: the most that could be gained over today's best on published boards (docs/unsolved.md)")


def _list_metrics() -> None:
    from sasgeo_bench.scoring.metric_plugins import find_metric, list_metrics  # noqa: PLC0415

    def row(name: str) -> tuple[str, ...]:
        one = find_metric(name)
        return one.unit, one.better, "{:g} to {:g}".format(*one.bounds), one.meaning

    _list_rows(("metric", "unit", "better", "bounds", "what it says"), list_metrics(), row)


def _list_rows(heads: Sequence[str], names: Iterable[str], row: Callable[[str], tuple[str, ...]]) -> None:
    """Print a row for each name; what another package lacks is reported, and the others are listed all the same."""
    table = Table(*heads, box=None, pad_edge=False)
    for name in names:
        try:
            table.add_row(name, *row(name))
        except (ConfigError, MatchError) as error:
            tell(f"left out: {error}")
    print_table(table)


def _show(card: object) -> None:
    """Print what a card says, a field after the other; what it leaves empty is left out."""
    if not is_dataclass(card) or isinstance(card, type):  # a class, or a function, of a strength
        name = f"{getattr(card, '__module__', '')}:{getattr(card, '__qualname__', card)}"
        say(plain(f"{name}: {(getattr(card, '__doc__', '') or '').strip().partition(chr(10))[0]}"))
        return
    for field in fields(card):
        value = getattr(card, field.name)
        if callable(value):
            continue
        text = ", ".join(map(str, value)) if isinstance(value, tuple) else str(value)
        if text:
            say(f"{field.name.replace('_', ' ')}: {plain(text)}")


def new_command(
    kind: Annotated[New, typer.Argument(help="what to write")],
    name: Annotated[str, typer.Argument(help="of it, as in my-matcher")],
    folder: Annotated[Path | None, typer.Option("--into", help="an empty folder; default: one of that name")] = None,
) -> None:
    """Write a plugin package that passes `check` at once, for you to put your method into."""
    if kind is New.METRIC:
        files = _function("scoring.metric_testing:metric_files")(name)
    else:
        files = _function("matching.scaffold:package_files")(kind, name)
    lay_package(name, folder, files)
    if kind is New.MATCHER:
        entry = f"sasgeo-bench enter docs/results/systems-objects --matcher {name}"
        tell(f"later: {entry} (docs/howto/matcher.md walks the path)")


def lay_package(name: str, folder: Path | None, files: Mapping[str, str]) -> None:
    """Write the files of a package, and say how to go on."""
    from sasgeo_bench.matching.scaffold import write_plugin  # noqa: PLC0415

    target = folder or Path(name)
    write_plugin(target, files)
    install = f"{_pip()} install -e {shlex.quote(str(target))}"
    say(f"{target}: {len(files)} files; next: {install} && sasgeo-bench check {name}")


def _pip() -> str:
    """The pip of this environment: another one, first on the user's path, would install where nothing finds it."""
    mine = Path(sys.executable).with_name("pip")
    if shutil.which("pip") == str(mine):
        return "pip"
    here = Path.cwd()
    return shlex.quote(str(mine.relative_to(here) if mine.is_relative_to(here) else mine))


def check_command(
    name: Annotated[str, typer.Argument(help="name of a list, or module:Class")],
    *,
    kind: Annotated[
        New | None, typer.Option(help="of what it is; needed for module:Class of another kind than a matcher")
    ] = None,
    trusted: Annotated[bool, typer.Option("--trusted", help="run without the sandbox")] = False,
) -> None:
    """Try a plugin of any kind but a rejector on a tiny town, and print a row for each rule that its kind keeps."""
    failed, kinds = 0, [str(kind)] if kind else _kinds_of(name)
    for found in kinds:
        check = _function(str(_DOORS[found].check))
        rows: Iterator[Any] = check(name) if found in _IN_PROCESS else check(name, is_sandboxed=not trusted)
        table = Table(
            "check" if len(kinds) == 1 else f"check of a {found}", "outcome", "found", box=None, pad_edge=False
        )
        for row in rows:
            failed += row.outcome == "fail"
            table.add_row(row.name, row.outcome, row.found)
        print_table(table)
    if failed:
        complain(f"{name}: {counted(failed, 'check')} failed")
        raise typer.Exit(EXIT_USER)


def _kinds_of(name: str) -> list[str]:
    """Return the kind of a name, or all kinds of what runs inside the program; a class of one's own is a matcher."""
    if ":" in name:
        return ["matcher"]
    from sasgeo_bench.scoring.metric_plugins import SHIPPED as METRICS_OF_OURS  # noqa: PLC0415
    from sasgeo_bench.tasks.perturbations.all_perturbations import SHIPPED  # noqa: PLC0415
    from sasgeo_bench.tasks.suites.all_suites import EVERY_SUITE  # noqa: PLC0415

    ours = {"suite": EVERY_SUITE, "metric": METRICS_OF_OURS, "perturbation": SHIPPED}
    checked = [kind for kind, door in _DOORS.items() if door.check]
    found = [kind for kind in checked if name in ours.get(kind, ()) or name in list_entry_points(_DOORS[kind].group)]
    if found and found[0] not in _IN_PROCESS:
        return found[:1]
    if not found:
        others = [each for names in ours.values() for each in names]
        raise unknown(name, *(_DOORS[kind].group for kind in checked), others=others)
    return found
