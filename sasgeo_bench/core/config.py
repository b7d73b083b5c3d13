# SPDX-License-Identifier: Apache-2.0
"""Parse TOML into a frozen pydantic model, with every fault on one line."""

import difflib
import errno
import json
import stat
import tomllib
from collections.abc import Callable, Mapping, Sequence
from functools import lru_cache
from pathlib import Path
from typing import Annotated, Any, ClassVar, Final, Literal, Self, TypeVar, get_origin

from pydantic import (
    AfterValidator,
    BaseModel,
    ConfigDict,
    Field,
    ModelWrapValidatorHandler,
    PrivateAttr,
    SerializerFunctionWrapHandler,
    ValidationError,
    model_serializer,
    model_validator,
)

from sasgeo_bench.core.errors import ConfigError

Model = TypeVar("Model", bound=BaseModel)

_SHORT: Final = 60  # characters
_FEW: Final = 8  # faults that an error lists in full
_LISTED: Final = 12  # known names that it does
_MOST_BYTES: Final = 10_000_000  # of a file that somebody writes by hand
LONGEST_LINE: Final = 300


def _printable(text: str) -> str:
    """Refuse text that cannot be shown on one line: breaks, controls, bidirectional marks."""
    if not text.isprintable():
        raise ValueError("must be one line of printable characters")
    return text


def _not_blank(text: str) -> str:
    if not text.strip():
        raise ValueError("must be one line of printable characters")
    return text


Prose = Annotated[str, Field(max_length=2000), AfterValidator(_printable)]  # which may be empty
Line = Annotated[str, Field(max_length=LONGEST_LINE), AfterValidator(_printable), AfterValidator(_not_blank)]
Short = Annotated[str, Field(max_length=_SHORT), AfterValidator(_printable), AfterValidator(_not_blank)]


Kind = Literal["regions", "splits", "pipelines"]


class Document(BaseModel):
    """Base of every model read from TOML: frozen, unknown keys refused, no silent conversion.

    Keys of `without_empty` came after the first edition: they are left out where they are empty, so that older files
    keep their bytes and their hashes.
    """

    model_config = ConfigDict(frozen=True, extra="forbid", strict=True)
    without_empty: ClassVar[frozenset[str]] = frozenset()

    @model_serializer(mode="wrap")
    def _as_written(self, handler: SerializerFunctionWrapHandler) -> dict[str, object]:
        return {name: value for name, value in handler(self).items() if value or name not in self.without_empty}


class JsonDocument(Document):
    """Base of strict JSON records: JSON has no tuples and no dates, so ordinary conversion is allowed."""

    model_config = ConfigDict(strict=False)


class Record(BaseModel):
    """Base of the models of what a program writes as JSON: frozen, no silent conversion.

    What a later version says besides is kept. It is written with the keys that it was made of, in their order; those of
    `without_empty` are left out where they are empty.

    >>> Record.model_validate({"later": 1}).model_dump()
    {'later': 1}
    """

    model_config = ConfigDict(frozen=True, extra="allow", strict=True, allow_inf_nan=False)
    without_empty: ClassVar[frozenset[str]] = frozenset()
    _keys: tuple[str, ...] = PrivateAttr(default=())

    @model_validator(mode="wrap")
    @classmethod
    def _keep_keys(cls, data: Any, handler: ModelWrapValidatorHandler[Self]) -> Self:  # noqa: ANN401 - any input
        made = handler(data)
        if isinstance(data, dict):
            made._keys = tuple(data)  # noqa: SLF001 - its own
        return made

    @model_serializer(mode="wrap")
    def _as_made(self, handler: SerializerFunctionWrapHandler) -> dict[str, object]:
        found = handler(self)
        keys = dict.fromkeys((*self._keys, *(name for name in found if name in self.model_fields_set)))
        return {name: found[name] for name in keys if name in found and (found[name] or name not in self.without_empty)}


class NamedDocument(Document):
    """Base of the models of shipped files, which are named by their id."""

    id: str


def parse_toml(text: str, model: type[Model], *, source: str) -> Model:
    """Parse and validate one TOML document; `source` names it in an error.

    Raise `ConfigError`, with the faults on one line, if the text is no TOML, a key is unknown, a type is wrong or a
    value out of range.

    >>> class Town(Document):
    ...     seed: int
    >>> parse_toml("sead = 3", Town, source="town.toml")
    Traceback (most recent call last):
        ...
    sasgeo_bench.core.errors.ConfigError: town.toml: unknown key 'sead', did you mean 'seed'?; 'seed' is missing
    """
    try:
        content = tomllib.loads(text)
    except (ValueError, RecursionError) as error:  # too many digits or brackets raise other errors
        raise ConfigError(f"{source}: not valid TOML: {error}") from error
    return check_document(content, model, source=source)


def toml_value(value: object) -> str:
    """Return a text, a number, a truth value, or a list of them, as TOML writes it: as JSON does.

    >>> toml_value(["Köln", 1.0, True])
    '["Köln", 1.0, true]'
    """
    return json.dumps(value, ensure_ascii=False)


def check_document(content: object, model: type[Model], *, source: str) -> Model:
    """Validate the content of a file, whatever its format; raise `ConfigError` as `parse_toml` does."""
    try:
        return model.model_validate(content)
    except ValidationError as error:
        faults = sorted((_fault(item, model) for item in error.errors()), key=lambda fault: "is missing" in fault)
        found = list(dict.fromkeys(faults))
        more = [f"and {len(found) - _FEW} more"] if len(found) > _FEW else []
        raise ConfigError(f"{source}: " + "; ".join([*found[:_FEW], *more])) from error


def _fault(item: Any, model: type[BaseModel]) -> str:  # noqa: ANN401 - pydantic's own error record
    """Describe one pydantic error as a clause; suggest the nearest known key for an unknown one."""
    where = ".".join(str(part) for part in item["loc"])
    if item["type"] == "extra_forbidden":
        known = _known_keys(item["loc"], model)
        near = difflib.get_close_matches(str(item["loc"][-1]), known, n=1, cutoff=0.5)
        hint = f"did you mean {near[0]!r}?" if near else f"known keys: {', '.join(known)}"
        if len(item["loc"]) > 1 and not near and item["loc"][-1] in model.model_fields:
            hint = "which belongs to the file itself: move it above the first [table]"
        return f"unknown key {where!r}, {hint}"
    shape = _wrong_shape(item, where)
    if shape is not None:
        return shape
    text = str(item["msg"]).removeprefix("Value error, ").replace(" after validation", "")
    text = text.replace("Input should be ", "must be ").replace("must be a valid ", "must be a ")
    if not where or "got " in text:
        return text
    # A whole table says nothing of what is wrong in it.
    return f"{where!r}: {text}" + ("" if isinstance(item["input"], dict) else f", got {_short(item['input'])}")


def _wrong_shape(item: Any, where: str) -> str | None:  # noqa: ANN401 - pydantic's own error record
    """Describe what is missing, or no list or table where one is wanted; None of any other fault."""
    kind, given = item["type"], item["input"]
    if kind == "missing" and isinstance(item["loc"][-1], int):
        return f"{where.rpartition('.')[0]!r} has too few values, got {_short(given)}"
    if kind == "missing":
        return f"{where!r} is missing"
    if kind == "tuple_type":
        return f"{where!r} must be a list in brackets, [...], got {_short(given)}"
    if kind == "list_type":
        written = f"for a list of tables write [[{where}]]" if isinstance(given, dict) else f"write [{_json(given)}]"
        return f"{where!r} is a list: {written}"
    return f"{where!r} is a table of keys, got {_short(given)}" if kind == "model_type" else None


def _json(value: object) -> str:
    return json.dumps(value, default=str)


def _short(value: object) -> str:
    """Quote a value, cut to a bounded length: a table or text may be as long as the file."""
    text = repr(value)
    return text if len(text) <= LONGEST_LINE else f"{text[: LONGEST_LINE - 3]}..."


def _known_keys(location: tuple[int | str, ...], model: type[BaseModel]) -> list[str]:
    """Return the keys that a model knows at the level of an unknown key."""
    current: Any = model
    is_name = False  # of an entry of a mapping, which is no field
    for part in location[:-1]:
        if isinstance(part, int) or is_name:
            is_name = False
            continue
        field = current.model_fields.get(part) or next(
            (known for known in current.model_fields.values() if known.alias == part), None
        )
        if field is None:
            return []
        current = _model_inside(field.annotation)
        if current is None:
            return []
        is_name = get_origin(field.annotation) in (dict, Mapping)
    return [field.alias or name for name, field in current.model_fields.items()]


def _model_inside(annotation: Any) -> type[BaseModel] | None:  # noqa: ANN401 - any type annotation
    """Return the model within `list[M]`, `M | None` or `M` itself."""
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return annotation
    inner = (_model_inside(part) for part in getattr(annotation, "__args__", ()))
    return next((part for part in inner if part is not None), None)


def shipped_dir(kind: Kind) -> Path:
    """Return the folder of the shipped files: inside an installed package, at the top of a checkout otherwise."""
    package = Path(__file__).parents[1]
    installed = package / "shipped" / kind
    return installed if installed.is_dir() else package.parent / kind


def read_document(path: Path, model: type[Model], kind: Kind) -> Model:
    """Read a file of a kind that ships; raise `ConfigError`, with all faults on one line, if it is wrong."""
    try:
        text = _text_of(path)
    except (OSError, UnicodeDecodeError) as error:
        noun = kind.removesuffix("s")
        raise ConfigError(
            f"{path} cannot be read as a {noun} file ({error}): name a .toml file, or the id of one that ships"
        ) from error
    parsed: Model = _parsed(text, model, str(path))
    return parsed


def _text_of(path: Path) -> str:
    """Read a file; raise `OSError` for a pipe, which would be waited for, and for what is not written by hand."""
    about = path.stat()
    if not stat.S_ISREG(about.st_mode):
        raise OSError(errno.EINVAL, "it is no plain file", str(path))
    if about.st_size > _MOST_BYTES:
        raise OSError(errno.EFBIG, f"it has more than {_MOST_BYTES} bytes", str(path))
    return path.read_text(encoding="utf-8-sig")  # some editors write a byte order mark


@lru_cache(maxsize=512)  # every lookup of an id reads all files of its kind
def _parsed(text: str, model: type[Model], source: str) -> Model:
    return parse_toml(text, model, source=source)


def list_documents(kind: Kind, model: type[NamedDocument], folders: Sequence[Path]) -> dict[str, Path]:
    """Return id -> file of a kind, from the given folders and the shipped ones.

    Raise `ConfigError` if a folder is missing, a file is wrong, or two files have one id.
    """
    noun = kind.removesuffix("s")
    found: dict[str, Path] = {}
    for folder in (*folders, shipped_dir(kind)):
        if not folder.is_dir():
            raise ConfigError(f"there is no folder {folder} with {noun} files")
        for path in sorted(folder.glob("*.toml")):
            identifier = read_document(path, model, kind).id
            if identifier in found and not found[identifier].samefile(path):
                raise ConfigError(
                    f"two {noun} files have the id {identifier!r}: {found[identifier]} and {path}; rename one"
                )
            found.setdefault(identifier, path)
    return found


def find_document(id_or_path: str, noun: str, mend: str, list_known: Callable[[], dict[str, Path]]) -> Path:
    """Find a file by its id, or return the path of one; raise `ConfigError`, which suggests an id, if there is none."""
    if id_or_path.endswith(".toml"):
        path = Path(id_or_path)
        if not path.is_file():
            known = {name: name for name in list_known()} | {
                other.stem: str(other) for other in sorted(path.parent.glob("*.toml")) if other.is_file()
            }
            raise ConfigError(f"there is no {noun} file {id_or_path}{_hint(path.stem, known)}: check the path")
        return path
    files = list_known()
    if id_or_path not in files and Path(id_or_path).is_dir():
        raise ConfigError(
            f"{id_or_path} is a folder: name a {noun} file in it ({Path(id_or_path) / 'NAME.toml'}), or an id"
        )
    if id_or_path not in files:
        raise ConfigError(
            f"there is no {noun} {id_or_path!r}{_hint(id_or_path, dict(zip(files, files, strict=True)))} ({mend})"
        )
    return files[id_or_path]


def _hint(name: str, known: Mapping[str, str]) -> str:
    """Suggest the value of the name that is most like one, or else list all values if they are few."""
    near = difflib.get_close_matches(name, known, n=1)
    if near:
        return f", did you mean {known[near[0]]!r}?"
    return f": there are {', '.join(sorted(known.values()))}" if 0 < len(known) <= _LISTED else ""
