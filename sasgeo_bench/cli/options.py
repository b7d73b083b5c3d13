# SPDX-License-Identifier: Apache-2.0
"""Options objects: the flags of a command as a frozen dataclass, which a function takes as keywords.

A field whose type is `Annotated[..., typer.Option(...)]` or `Annotated[..., typer.Argument(...)]` is a flag; any other
field is a keyword of the function alone.
"""

import inspect
from collections.abc import Callable, Iterable
from dataclasses import dataclass, fields, is_dataclass
from functools import wraps
from pathlib import Path
from typing import Annotated, Any, Final, ParamSpec, TypeVar, cast, get_args, get_origin, get_type_hints

import typer
from typer.models import ParameterInfo

from sasgeo_bench.core.errors import ConfigError, check_given
from sasgeo_bench.core.paths import given_path
from sasgeo_bench.core.progress import Progress, Tell, reporting, silent
from sasgeo_bench.core.texts import one_line

Words = ParamSpec("Words")
Result = TypeVar("Result")

Out = Annotated[Path, typer.Option(envvar="SASGEO_OUT", help="root of what is built")]
RegionFolders = Annotated[
    list[Path] | None,
    typer.Option("--region-files", "--regions", help="folder with region files of your own; may be repeated"),
]
OwnRegionFolders = Annotated[  # of commands whose --regions are ids
    list[Path] | None, typer.Option("--region-files", help="folder with region files of your own; may be repeated")
]
Dask = Annotated[
    str | None, typer.Option(help="address of a dask scheduler, or local:N for N processes; instead of --jobs")
]
ExtractFolders = Annotated[
    list[Path] | None,
    typer.Option(
        "--extracts",
        exists=True,
        file_okay=False,
        help="folder to search for extracts, before SASGEO_EXTRACTS and the user's cache",
    ),
]
ImageryFolders = Annotated[
    list[Path] | None,
    typer.Option(
        "--imagery",
        exists=True,
        file_okay=False,
        help="folder to search for aerial pictures, before SASGEO_IMAGERY and 'imagery' beside extracts",
    ),
]


_OTHERS: Final = """say, tell : callable
    Get each line of the result, and each note on the way; print nothing unless given.
progress : Progress, optional
    Counts what is done; notes now and then unless given."""


@dataclass(frozen=True, kw_only=True)
class Options:
    """Base of the options objects: reads what a caller gives as the flags would be read.

    Parameters
    ----------
    say, tell : callable
        Get each line of the result, and each note on the way; a program sends them to stdout and stderr.
    progress : Progress, optional
        Counts what is done; notes now and then unless given.

    Raises
    ------
    ConfigError
        If a number is smaller than its flag allows.
    """

    say: Callable[[object], None] = silent
    tell: Tell | None = None
    progress: Progress | None = None

    def __post_init__(self) -> None:
        """Turn texts into paths and single values into lists where the flag has these, and check numbers."""
        for name, kind in flags_of(type(self)).items():
            object.__setattr__(self, name, _read(getattr(self, name), name, kind))


def flags_of(options: type) -> dict[str, object]:
    """Names and annotations of the flags of an options object, in their order."""
    hints = get_type_hints(options, include_extras=True)
    return {item.name: hints[item.name] for item in fields(options) if get_origin(hints[item.name]) is Annotated}


Object = TypeVar("Object", bound=Options)


def takes(options: Callable[Words, Object]) -> Callable[[Callable[[Object], Result]], Callable[Words, Result]]:
    """Let a function of an options object be called with the fields of the object as keywords.

    The keywords are listed, with the help of their flags, in the function's signature and docstring.

    Examples
    --------
    >>> @dataclass(frozen=True, kw_only=True)
    ... class Walk(Options):
    ...     tasks: Annotated[list[Path], typer.Option(help="task folders")]
    ...     jobs: Annotated[int, typer.Option(min=1, help="processes")] = 1
    >>> @takes(Walk)
    ... def walk(options):
    ...     return options.tasks, options.jobs
    >>> walk(tasks="out/tasks/clean/vaduz", jobs=2)
    ([PosixPath('out/tasks/clean/vaduz')], 2)
    >>> walk(tasks=[], jobs=0)
    Traceback (most recent call last):
        ...
    sasgeo_bench.core.errors.ConfigError: jobs must be at least 1, got 0
    """

    def decorate(function: Callable[[Object], Result]) -> Callable[Words, Result]:
        """Return the function with the words of the options object as its keywords."""

        @wraps(function)
        def called(*args: Words.args, **words: Words.kwargs) -> Result:
            """Build the options object, and call the function with it."""
            found = options(*args, **words)
            with reporting(found.tell, found.progress):
                return function(found)

        kinds = flags_of(cast("type", options))
        words = inspect.signature(options).parameters
        plain = [words[name].replace(annotation=get_args(kind)[0]) for name, kind in kinds.items()]
        others = [item for name, item in words.items() if name not in kinds]
        # What is positional stands first, also where an object adds it to the flags of its base.
        parameters = sorted([*plain, *others], key=lambda item: item.kind)
        signature = inspect.signature(function).replace(parameters=parameters)
        called.__signature__ = signature  # type: ignore[attr-defined]
        lines = [f"{item.name} : {_shown(item.annotation)}\n    {get_args(kinds[item.name])[1].help}" for item in plain]
        summary, rule, rest = inspect.cleandoc(function.__doc__ or "").partition("\n\nReturns\n")
        called.__doc__ = f"{summary}\n\nParameters\n----------\n" + "\n".join((*lines, _OTHERS)) + rule + rest
        return called

    return decorate


def with_flags(command: Callable[..., None]) -> Callable[..., None]:
    """Expand the options objects among a command's parameters into their flags, as typer reads them."""
    hints = get_type_hints(command, include_extras=True)
    objects = {name: cast("type", kind) for name, kind in hints.items() if is_dataclass(kind)}
    flags: list[inspect.Parameter] = []
    for name, item in inspect.signature(command).parameters.items():
        found = inspect.signature(objects[name]).parameters if name in objects else {name: item}
        kinds = flags_of(objects[name]) if name in objects else {name: hints[name]}
        keyword = inspect.Parameter.KEYWORD_ONLY
        flags += [found[flag].replace(kind=keyword, annotation=kind) for flag, kind in kinds.items()]

    @wraps(command)
    def called(**words: Any) -> None:  # noqa: ANN401 - whatever the flags hold
        """Build the options objects from the flags, and call the command with them."""
        made = {name: kind(**{flag: words.pop(flag) for flag in flags_of(kind)}) for name, kind in objects.items()}
        command(**made, **words)

    called.__signature__ = inspect.Signature(flags)  # type: ignore[attr-defined]
    return called


def _read(value: Any, name: str, kind: Any) -> Any:  # noqa: ANN401 - whatever the flag holds
    """Read a value as its flag would."""
    inner, info = get_args(kind)[:2]
    kinds = (inner, *get_args(inner), *(part for one in get_args(inner) for part in get_args(one)))
    is_list = any(get_origin(one) is list for one in kinds)
    if value is None and type(None) in kinds:
        return None
    if value is None:
        raise ConfigError(f"{name} is None, and must be given")
    if is_list and isinstance(value, str | Path):
        value = [value]
    if is_list and not isinstance(value, Iterable):
        raise ConfigError(f"{name} must be a list, got {one_line(repr(value))}")
    if Path in kinds:
        value = [given_path(one) for one in value] if is_list else given_path(value)
    elif str in kinds:
        for one in value if is_list else [value]:
            check_given(one, str, f"{name} is made of texts")
    if isinstance(info, ParameterInfo) and info.min is not None and value < info.min:
        raise ConfigError(f"{name} must be at least {info.min:g}, got {value:g}")
    return list(value) if is_list else value


def _shown(kind: Any) -> str:  # noqa: ANN401 - an annotation
    """Name a type as docstrings do."""
    return inspect.formatannotation(kind).replace("pathlib.", "").replace(" | None", ", optional")
