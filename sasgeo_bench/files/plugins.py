# SPDX-License-Identifier: Apache-2.0
"""Find plugins by the name of an entry point, or by module:Class; built-in ones win a clash of names."""

import difflib
import importlib
import sys
import warnings
from collections.abc import Callable, Collection, Sequence
from functools import lru_cache
from importlib.metadata import Distribution, EntryPoint
from typing import Any, Final

from sasgeo_bench.errors import MatchError, SasgeoError
from sasgeo_bench.files.plugin_files import (
    import_paths,
    is_ours,
    is_shipped,
    read_entry_points,
    strange_file,
)
from sasgeo_bench.texts import message_of, one_line

MATCHERS: Final = "sasgeo_bench.matchers"
TRACKERS: Final = "sasgeo_bench.trackers"
REJECTORS: Final = "sasgeo_bench.rejectors"
SEGMENTERS: Final = "sasgeo_bench.segmenters"
SUITES: Final = "sasgeo_bench.suites"
EXPERIMENTS: Final = "sasgeo_bench.experiments"
CARD_FILE: Final = "card.toml"  # beside a plugin: the one description of a method
YARDSTICK: Final = "oracle_"  # prefix of oracles, which use the truth and are never ranked
# The runner's own controls, which are given the truth: no plugin can have their names.
ORACLE: Final = "oracle_pose"
ORACLE_SEGMENTER: Final = "oracle_segmenter"
_RESERVED: Final = {MATCHERS: ORACLE, TRACKERS: ORACLE, SEGMENTERS: ORACLE_SEGMENTER}
_WHAT: Final = {SUITES: "NAME"}  # is named behind a module, where that is no class
KINDS: Final = {
    MATCHERS: "matcher",
    TRACKERS: "tracker",
    REJECTORS: "rejector",
    SEGMENTERS: "segmenter",
    SUITES: "suite",
    EXPERIMENTS: "experiment",
}


def list_entry_points(group: str = MATCHERS) -> dict[str, EntryPoint]:
    """Return the entry points of a group by name; of two with one name the built-in one, else the first listed.

    Warn of a name that occurs twice, or is that of the runner's own control. Raise `MatchError` if an installed package
    has entry points that cannot be read.
    """
    found: dict[str, EntryPoint] = {}
    for point in _installed(group):
        if point.name == _RESERVED.get(group):
            message = (
                f"{_home(point)} ({point.value}) is not used: {point.name!r} is the name of a control of the runner"
            )
            warnings.warn(message, stacklevel=2)
        elif point.name not in found:
            found[point.name] = point
        elif found[point.name].value != point.value:
            message = _clash(found[point.name], point)
            warnings.warn(message, stacklevel=2)
    return dict(sorted(found.items()))


def _installed(group: str) -> tuple[EntryPoint, ...]:
    try:
        return _read(group, tuple(sys.path))
    except Exception as error:
        raise MatchError(
            f"an installed package has entry points that cannot be read ({message_of(error)}): reinstall or remove it"
        ) from error


@lru_cache(maxsize=8)
def _read(group: str, _: tuple[str, ...]) -> tuple[EntryPoint, ...]:
    """Read the entry points of a group once for each list of places that packages are imported from."""
    return tuple(sorted(read_entry_points(group), key=lambda point: (not is_ours(point), _home(point), point.value)))


def _clash(first: EntryPoint, other: EntryPoint) -> str:
    """Name two plugins with the same name, and say which is used: ours, otherwise neither."""
    lost = f"{_home(other)} ({other.value})"
    if is_ours(first):
        return f"two plugins are named {first.name!r}: {_home(first)} is used, {lost} is not"
    return (
        f"two plugins are named {first.name!r}: {_home(first)} ({first.value}) and {lost}, so neither is used: "
        "uninstall one, or name module:Class"
    )


def shipped_names(group: str = MATCHERS) -> frozenset[str]:
    """Return the names of shipped plugins of a group, which no other plugin may use."""
    shipped = {point.name for point in _installed(group) if is_ours(point)}
    return frozenset(shipped | {_RESERVED[group]} if group in _RESERVED else shipped)


def check_card_name(spec: str, name: str, *, is_oracle: bool = False, group: str = MATCHERS) -> None:
    """Raise `MatchError` for a card name that would imitate a shipped plugin or an oracle.

    `spec` is the name of the plugin, or module:Class; `is_oracle` states that a pipeline lists it as an oracle.

    >>> check_card_name("mine:Matcher", "oracle_pose")
    Traceback (most recent call last):
        ...
    sasgeo_bench.errors.MatchError: mine:Matcher: its card is named 'oracle_pose', as a matcher that ships: rename it
    """
    shipped = shipped_names(group)
    module, is_class, _ = spec.partition(":")
    ships = is_shipped(module, import_paths(spec)) if is_class else spec in shipped
    if not ships and name in shipped:
        raise MatchError(f"{one_line(spec)}: its card is named {name!r}, as a {KINDS[group]} that ships: rename it")
    if name.startswith(YARDSTICK) and not (ships or is_oracle):
        raise MatchError(
            f"{one_line(spec)}: its card is named {name!r}, and names that begin with {YARDSTICK} are of oracles, "
            "which use the truth: rename it"
        )


def _home(point: EntryPoint) -> str:
    return "" if point.dist is None else _name_of(point.dist)


@lru_cache(maxsize=16)  # its entry points share a distribution, which reads its metadata anew at every access
def _name_of(distribution: Distribution) -> str:
    return distribution.name


def is_tracker(name: str) -> bool:
    """Return whether a name is registered for a tracker and for no matcher; nothing is imported.

    >>> is_tracker("dead_reckoning"), is_tracker("random")
    (True, False)
    """
    return name in list_entry_points(TRACKERS) and name not in list_entry_points()


def made(spec: str, target: Callable[[], Any]) -> Any:  # noqa: ANN401 - any plugin
    """Make a plugin; a failure is reported in one line."""
    try:
        return target()
    except (Exception, SystemExit) as error:  # a plugin that ends the program must not look like a good end
        raise _failed(spec, "cannot be made", error) from error


def find_plugin(spec: str, group: str) -> Any:  # noqa: ANN401 - any plugin
    """Return the class behind a name or module:Class, or the instance where it is one."""
    if not isinstance(spec, str):
        raise MatchError(f"{one_line(repr(spec))} is no name of a {KINDS[group]}: name one as a text, or module:Class")
    if ":" not in spec:
        return _from_entry_point(spec, group)
    module, _, name = spec.partition(":")
    try:
        return getattr(importlib.import_module(module), name)
    except (Exception, SystemExit) as error:
        raise _failed(one_line(spec), "cannot be imported", error) from error


def _known(name: str, group: str) -> EntryPoint:
    points = list_entry_points(group)
    if name not in points:
        raise unknown(name, group)
    others = {point.value: point for point in _installed(group) if point.name == name and point != points[name]}
    rival = next((point for value, point in others.items() if value != points[name].value), None)
    if rival is not None and not is_ours(points[name]):
        raise MatchError(_clash(points[name], rival))
    _check_place(points[name])
    return points[name]


def _check_place(point: EntryPoint) -> None:
    """Refuse a plugin that ships where other code of its name would be imported: its rows would not be its own."""
    strange = strange_file(point.module, import_paths(point.name)) if is_ours(point) else None
    if strange is not None:
        raise MatchError(
            f"{point.name}: {point.module} would be imported from {one_line(str(strange))}, and not from where "
            f"{_home(point)} is installed: take that folder off PYTHONPATH"
        )


def code_of(spec: str, *groups: str) -> tuple[str, str]:
    """Return module and name of the class behind a name of one of the groups, or behind module:Class.

    Nothing is imported. Raise `MatchError` if there is none of that name.

    >>> code_of("random", MATCHERS, TRACKERS)
    ('sasgeo_bench.matching.controls.blind', 'RandomPlaces')
    """
    if ":" in spec:
        module, _, name = spec.partition(":")
        return module, name
    group = next((one for one in groups if spec in list_entry_points(one)), None)
    if group is None:
        raise unknown(spec, *groups)
    point = _known(spec, group)
    return point.module, point.attr


def unknown(name: str, *groups: str, others: Collection[str] = ()) -> MatchError:
    """Return the error for a name that no group has, with the nearest one; `others` are names without entry points."""
    known = [*others, *(each for group in groups for each in list_entry_points(group))]
    near = difflib.get_close_matches(name, known, n=1)
    hint = f", did you mean {near[0]!r}?" if near else ""
    kinds = [KINDS[group] for group in groups]
    kind = " or ".join(filter(None, (", ".join(kinds[:-1]), kinds[-1])))
    lists = " and ".join(f"list {one}s" for one in kinds) if len(kinds) <= 2 else "list"  # to be read
    shown = f"{lists} show{'s' if ' and ' not in lists else ''} all"
    return MatchError(f"there is no {kind} {name!r}{hint} ({shown}; or module:{_WHAT.get(groups[0], 'Class')})")


def check_names(*, matchers: Sequence[str] = (), rejectors: Sequence[str] = (), segmenters: Sequence[str] = ()) -> None:
    """Raise `MatchError` for names that no installed package registers; import nothing, accept any module:Class.

    `matchers` may name trackers, too.
    """
    for listed, group in ((matchers, MATCHERS), (rejectors, REJECTORS), (segmenters, SEGMENTERS)):
        for name in listed:
            if ":" not in name and name != _RESERVED.get(group):
                _known(name, TRACKERS if group == MATCHERS and is_tracker(name) else group)


def check_registered(rejectors: Sequence[str], *, source: str) -> None:
    """Raise `MatchError` if a data file, `source`, names a rejector that no installed package registers.

    Importing a module:Class from data would run any code. Nothing is imported here.
    """
    known = list_entry_points(REJECTORS) if rejectors else {}
    stray = next((name for name in rejectors if name not in known), None)
    if stray is not None:
        raise MatchError(
            f"{source} names the rejector {one_line(stray)!r}, and data may name registered ones only (list rejectors "
            "shows all): name each that is to judge with --rejector, and code only if you trust it"
        )


def _from_entry_point(name: str, group: str) -> Callable[[], Any]:
    point = _known(name, group)
    try:
        return point.load()  # type: ignore[no-any-return]
    except (Exception, SystemExit) as error:
        raise _failed(name, f"{point.value} of {_home(point)} cannot be imported", error) from error


def _failed(spec: str, what: str, error: BaseException) -> MatchError:
    """Return the error for a plugin whose code fails; one of ours, as of its card, says all there is to say."""
    return MatchError(f"{spec}: {error}" if isinstance(error, SasgeoError) else f"{spec}: {what} ({message_of(error)})")
