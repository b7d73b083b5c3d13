# SPDX-License-Identifier: Apache-2.0
"""TOML text into a frozen pydantic model, with every fault told in one line."""

import difflib
import json
import tomllib
from typing import Annotated, Any, Final, TypeVar

from pydantic import AfterValidator, BaseModel, ConfigDict, Field, ValidationError

from sasgeo_bench.errors import ConfigError

Model = TypeVar("Model", bound=BaseModel)

_SHORT: Final = 60  # characters
_LONGEST: Final = 300


def _printable(text: str) -> str:
    """Refuse what could not be shown as one line of text: breaks, controls, marks that turn the writing round."""
    if not text.isprintable():
        message = "must be one line of printable characters"
        raise ValueError(message)
    return text


def _said(text: str) -> str:
    if not text.strip():
        message = "must be one line of printable characters"
        raise ValueError(message)
    return text


Prose = Annotated[str, Field(max_length=2000), AfterValidator(_printable)]  # which may be empty
Line = Annotated[str, Field(max_length=_LONGEST), AfterValidator(_printable), AfterValidator(_said)]
Short = Annotated[str, Field(max_length=_SHORT), AfterValidator(_printable), AfterValidator(_said)]


class Document(BaseModel):
    """Base of every model read from TOML: frozen, unknown keys refused, no silent conversion.

    Examples
    --------
    >>> class Town(Document):
    ...     seed: int
    >>> parse_toml("seed = 3", Town, source="town.toml")
    Town(seed=3)
    """

    model_config = ConfigDict(frozen=True, extra="forbid", strict=True)


def parse_toml(text: str, model: type[Model], *, source: str) -> Model:
    """Parse and validate one TOML document.

    Parameters
    ----------
    text : str
        The TOML text.
    model : type
        A `Document`.
    source : str
        What to call the file in an error.

    Returns
    -------
    Model
        The validated document.

    Raises
    ------
    ConfigError
        If the text is no TOML, a key is unknown, a type is wrong or a value out of range; all faults on one line.

    Examples
    --------
    >>> class Town(Document):
    ...     seed: int
    >>> parse_toml("sead = 3", Town, source="town.toml")
    Traceback (most recent call last):
        ...
    sasgeo_bench.errors.ConfigError: town.toml: unknown key 'sead', did you mean 'seed'?; 'seed' is missing
    """
    try:
        content = tomllib.loads(text)
    except (ValueError, RecursionError) as error:  # too many digits or brackets are no error of TOML's own
        message = f"{source}: not valid TOML: {error}"
        raise ConfigError(message) from error
    return check_document(content, model, source=source)


def check_document(content: object, model: type[Model], *, source: str) -> Model:
    """Hold what a file says, whatever its format, to a model.

    Raises
    ------
    ConfigError
        As `parse_toml` does; all faults on one line.

    Examples
    --------
    >>> class Town(Document):
    ...     seed: int
    >>> check_document({"seed": 3}, Town, source="town.json")
    Town(seed=3)
    """
    try:
        return model.model_validate(content)
    except ValidationError as error:
        faults = sorted((_fault(item, model) for item in error.errors()), key=lambda fault: "is missing" in fault)
        message = f"{source}: " + "; ".join(dict.fromkeys(faults))
        raise ConfigError(message) from error


def _fault(item: Any, model: type[BaseModel]) -> str:  # noqa: ANN401 - pydantic's own error record
    """One pydantic error as a clause; unknown keys get the nearest known one."""
    where = ".".join(str(part) for part in item["loc"])
    if item["type"] == "extra_forbidden":
        known = _keys_beside(item["loc"], model)
        near = difflib.get_close_matches(str(item["loc"][-1]), known, n=1, cutoff=0.5)
        hint = f"did you mean {near[0]!r}?" if near else f"known keys: {', '.join(known)}"
        return f"unknown key {where!r}, {hint}"
    if item["type"] == "missing":
        return f"{where!r} is missing"
    if item["type"] == "list_type" and not isinstance(item["input"], dict):
        return f"{where!r} is a list: write [{json.dumps(item['input'], default=str)}]"
    text = str(item["msg"]).removeprefix("Value error, ")
    return f"{where!r}: {text}, got {_short(item['input'])}" if where and "got " not in text else text


def _short(value: object) -> str:
    """A value as it is quoted: a table or text may be as long as the file."""
    text = repr(value)
    return text if len(text) <= _LONGEST else f"{text[: _LONGEST - 3]}..."


def _keys_beside(location: tuple[int | str, ...], model: type[BaseModel]) -> list[str]:
    """The keys a model knows at the level where an unknown key was met."""
    current: Any = model
    for part in location[:-1]:
        if isinstance(part, int):
            continue
        field = current.model_fields.get(part) or next(
            (known for known in current.model_fields.values() if known.alias == part), None
        )
        if field is None:
            return []
        current = _model_inside(field.annotation)
        if current is None:
            return []
    return [field.alias or name for name, field in current.model_fields.items()]


def _model_inside(annotation: Any) -> type[BaseModel] | None:  # noqa: ANN401 - any type annotation
    """The model within `list[M]`, `M | None` or `M` itself."""
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return annotation
    inner = (_model_inside(part) for part in getattr(annotation, "__args__", ()))
    return next((part for part in inner if part is not None), None)
