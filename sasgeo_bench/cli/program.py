# SPDX-License-Identifier: Apache-2.0
"""The program `sasgeo-bench`: parses, calls, prints."""

import ast
import gc
import inspect
import re
import sys
import traceback
import warnings
from collections.abc import Callable, Sequence
from functools import cache, wraps
from importlib import import_module, metadata, resources
from pathlib import Path
from typing import Annotated, Any, Final, TextIO

import typer
from typer.core import TyperGroup

from sasgeo_bench.cli.console import EXIT_USER, LOG, complain, heartbeat, note, open_outlets, outlets, say
from sasgeo_bench.cli.interrupts import EXIT_INTERRUPTED, exit_interrupted, is_interrupt
from sasgeo_bench.cli.options import with_flags
from sasgeo_bench.core.errors import SasgeoError
from sasgeo_bench.core.progress import QUIET, tell
from sasgeo_bench.core.texts import one_line

HELP: Final = (
    "Build regions from OpenStreetMap extracts, draw queries, run matchers, score them, publish boards. Results go to "
    "stdout, everything else to stderr."
)

# Group -> command -> its file here, in the order of the work; the function behind `run` is `run_command`. The file is
# imported, with all that it needs, when the command runs: `--help` answers at once.
COMMANDS: Final[dict[str, dict[str, str]]] = {
    "Set-up": {
        "doctor": "doctor",
    },
    "Regions": {
        "new-region": "regions",
        "build-region": "regions",
        "render-imagery": "regions",
        "measure-ageing": "ageing",
        "pack-map": "regions",
    },
    "Your own pictures": {
        "locate": "observing",
        "import-photos": "importing_photos",
        "import-masks": "importing_photos",
    },
    "Queries": {
        "new-split": "splits",
        "make-queries": "queries",
        "segment": "segmenters",
        "inspect": "looking",
        "verify": "verifying",
    },
    "Methods": {
        "list": "doors",
        "new": "doors",
        "check": "doors",
        "weights": "weights",
    },
    "Runs": {
        "run": "runs",
        "merge": "runs",
        "profile": "profiling",
        "submit": "entering",
        "enter": "entering",
    },
    "Boards": {
        "score": "boards",
        "leaderboard": "boards",
        "publish": "publishing",
        "release": "publishing",
    },
    "Storage": {
        "send": "publishing",
        "fetch": "publishing",
    },
    "Flights": {
        "import-flight": "flights",
        "measure-drift": "flights",
        "check-gnss": "flights",
        "replay": "replaying",
    },
    "Datasets of others": {
        "import-dataset": "importing",
    },
}

# Names that commands had before -> what they are now. They are in no help.
ALIASES: Final = {
    **{
        f"list-{kind}": ("list", kind)
        for kind in ("regions", "suites", "matchers", "trackers", "segmenters", "rejectors")
    },
    **{f"new-{kind}": ("new", kind) for kind in ("matcher", "tracker", "segmenter")},
    **{f"check-{kind}": ("check", "--kind", kind) for kind in ("matcher", "tracker", "segmenter")},
    "validate": ("verify",),
    "read-flight": ("import-flight",),
    "compare-ageing": ("measure-ageing", "--compare"),
    "propose-regions": ("new-region", "--manifest"),
    "locate-dataset": ("import-dataset", "--where"),
}

# Command -> what is kept of it when it is interrupted, and how to go on; the others write all or nothing.
KEPT: Final = {
    "new-region": "what was downloaded and written is kept; the same command goes on from there",
    "build-region": "regions that were built are kept; the same command builds the others",
    "render-imagery": "images that were rendered are kept; the same command renders the others",
    "make-queries": "tasks that were drawn are kept; the same command draws them again, with the same queries",
    "locate": "fixes so far are kept; the same command goes on with the other pictures",
    "segment": "tasks that were segmented are kept; the same command goes on with the others",
    "run": "answers so far are kept; the same command asks the other queries",
    "enter": "queries and answers so far are kept; the same command goes on from there",
    "leaderboard": "queries and answers so far are kept; the same command goes on from there",
    "replay": "fixes so far were sent, and no file is half-written; the same command begins the flight anew",
    "send": "files that were sent are kept; the same command sends the others",
    "fetch": "files that were fetched are kept beside the folder; the same command fetches the others",
}
_HELP_WORDS: Final = {"help_option_names": ["-h", "--help"]}
_NOTHING: Final = "nothing is half-written, and what was there before is kept; run it again"


class _Group(TyperGroup):
    """Commands whose code is read when they run; help about all of them reads none."""

    def resolve_command(self, ctx: Any, args: list[str]) -> tuple[str | None, Any, list[str]]:  # noqa: ANN401 - as below
        """Name, command and the words that are left; the command is imported now."""
        name, command, rest = super().resolve_command(ctx, [*ALIASES.get(args[0], args[:1]), *args[1:]])
        command = command and load(name or "")
        return name, command, spelled_out(rest, command.params) if command else rest

    def format_commands(self, ctx: Any, formatter: Any) -> None:  # noqa: ANN401, ARG002 - as above
        """Write the commands in the groups of the work."""
        for group, names in COMMANDS.items():
            with formatter.section(group):
                formatter.write_dl([(name, help_of(file, name).partition("\n\n")[0]) for name, file in names.items()])


def spelled_out(words: Sequence[str], params: Sequence[Any]) -> list[str]:
    """Repeat an option before each of several values that follow it, as a shell leaves them of a pattern.

    `--tasks out/tasks/clean/*` names every folder there. Nothing is repeated for a command with arguments: a value
    might be one of these.
    """
    several = {flag for one in params if getattr(one, "multiple", False) for flag in one.opts}
    if any(one.param_type_name == "argument" for one in params):
        return list(words)
    found: list[str] = []
    flag, count = "", 0
    for at, word in enumerate(words):
        if word == "--":
            return [*found, *words[at:]]
        if word.startswith("-"):
            name, is_joined, _ = word.partition("=")
            flag, count = name if name in several else "", len(is_joined)
        else:
            count += 1
            found += [flag] if flag and count > 1 else []
        found.append(word)
    return found


def load(name: str) -> Any:  # noqa: ANN401 - typer makes its commands of a class that it does not name
    """The command of a name, as typer makes it of the function behind it."""
    file = next(group[name] for group in COMMANDS.values() if name in group)
    alone = typer.Typer(add_completion=False, context_settings=_HELP_WORDS)
    function = getattr(import_module(f"sasgeo_bench.cli.{file}"), _function_of(name))
    alone.command(name)(_with_outlets(with_flags(function)))
    if not gc.isenabled():  # the program has put it off until all is imported, which stays
        gc.freeze()
        gc.enable()
    return typer.main.get_command(alone)


def _with_outlets(command: Callable[..., None]) -> Callable[..., None]:
    """Give a command the flags that every command has, and let it show that it is at work."""

    def flags(
        *,
        quiet: Annotated[
            bool, typer.Option("--quiet", envvar=QUIET, help="print errors and the last line of the result alone")
        ] = False,
        log: Annotated[
            Path | None,
            typer.Option(envvar=LOG, help="file to append every line to, with its time, those of --quiet too"),
        ] = None,
    ) -> None:
        """Open the outlets as the flags say."""
        open_outlets(quiet=quiet, log=log)

    @wraps(command)
    def called(*, quiet: bool, log: Path | None, **words: Any) -> None:  # noqa: ANN401 - whatever the flags hold
        """Read the flags of every command, and carry out this one."""
        flags(quiet=quiet, log=log)
        with heartbeat():
            command(**words)

    own, more = (list(inspect.signature(item).parameters.values()) for item in (command, flags))
    called.__signature__ = inspect.Signature([*own, *more])  # type: ignore[attr-defined]
    return called


def help_of(file: str, name: str) -> str:
    """The docstring of the function behind a command, out of the source, so that nothing is imported for it."""
    return _docstrings(file)[_function_of(name)]


@cache
def _docstrings(file: str) -> dict[str, str]:
    source = resources.files("sasgeo_bench.cli").joinpath(f"{file}.py").read_text(encoding="utf-8")
    functions = (item for item in ast.parse(source).body if isinstance(item, ast.FunctionDef))
    return {item.name: ast.get_docstring(item) or "" for item in functions}


def _function_of(name: str) -> str:
    return f"{name.replace('-', '_')}_command"


def _print_version(*, is_asked: bool) -> None:
    if is_asked:
        say(f"sasgeo-bench {metadata.version('sasgeo-bench')}")
        raise typer.Exit


# Plain help: what draws boxes around it takes longer to load than all else.
app = typer.Typer(
    cls=_Group,
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    help=HELP,
    rich_markup_mode=None,
    context_settings=_HELP_WORDS,
)


@app.callback()
def _program(
    *,
    version: Annotated[
        bool, typer.Option("--version", callback=_print_version, is_eager=True, help="print the version and stop")
    ] = False,
) -> None:
    """Options of the program itself; each is carried out by its callback."""


for _commands in COMMANDS.values():
    for _name in _commands:
        app.command(_name)(lambda: None)


def _warn(
    message: Warning | str,
    category: type[Warning],
    filename: str,
    lineno: int,
    file: TextIO | None = None,
    line: str | None = None,
) -> None:
    """Print a warning as one line, without where it came from."""
    del category, filename, lineno, file, line
    tell(f"sasgeo-bench: warning: {one_line(str(message))}")


# Base of a wrong word on the command line: of click, or of the copy of it that newer versions of typer bring along.
_UsageError: Any = typer.BadParameter.__base__


def _tell_usage(error: Any) -> None:  # noqa: ANN401 - see _UsageError
    """Print a wrong word on the command line as one line."""
    text = error.format_message().strip().removesuffix(".")
    text = re.sub(r"(Input should be|'[^']*' is not) a valid (number|float).*", "give the number alone, no unit", text)
    command = error.ctx.command_path if error.ctx is not None else "sasgeo-bench"
    complain(f"sasgeo-bench: {one_line(f'{text[:1].lower()}{text[1:]}')} (see '{command} --help')")


def main() -> None:
    """Run the program: 0 done, 2 the user's mistake or the disk's refusal on one line, 1 our bug with a traceback."""
    warnings.showwarning = _warn
    with outlets():
        status = _status()
        note(f"ended with status {status}")
    sys.exit(status)


def _status() -> int:
    """Run the command that the words name, and return its status; say in one line what went wrong."""
    try:
        status = int(app(prog_name="sasgeo-bench", standalone_mode=False) or 0)
    except _UsageError as error:
        if len(sys.argv) == 1:
            say(error.ctx.get_help())
            return 0
        _tell_usage(error)
        return EXIT_USER
    except SasgeoError as error:
        complain(f"sasgeo-bench: {error}")
        return EXIT_USER
    except OSError as error:  # any fault without a message of its own, such as a name that is too long
        line = f"{error.strerror or error}; check the path, your rights and the free space: {error.filename or ''}"
        complain(f"sasgeo-bench: {one_line(line)}")
        return EXIT_USER
    except BaseException as error:
        if not is_interrupt(error):
            note(traceback.format_exc())
            raise
        status = EXIT_INTERRUPTED
    if status == EXIT_INTERRUPTED:  # typer turns an interrupt into this status without a word
        status = exit_interrupted()
        complain(f"sasgeo-bench: interrupted; {KEPT.get(' '.join(sys.argv[1:2]), _NOTHING)}")
    return status
