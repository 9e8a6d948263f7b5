"""How a stage is declared: a pure function with its inputs, output and parameters as data.

>>> class ScaleParams(Params):
...     factor: float = quantity("1", gt=0, doc="What to multiply the anomaly by.")
>>> ScaleParams(factor=2.0).factor
2.0
"""

from __future__ import annotations

import datetime
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Annotated, Any, get_args

import pydantic
import xarray as xr
from pydantic.fields import FieldInfo
from pydantic_core import ErrorDetails, PydanticUndefined

from magtiles.schemas.errors import MagtilesError, ParameterError

FILES = "files"
"""Input kind of an ingest stage: foreign files or source TOMLs, one or more."""

OPTIONAL_FILE = "optional-file"
"""Input kind of a foreign file that `run` takes as a path where it is given, none where not."""


class Params(pydantic.BaseModel):
    """Base of every stage's parameters: frozen, strict, finite, no unknown keys."""

    model_config = pydantic.ConfigDict(
        frozen=True, extra="forbid", strict=True, allow_inf_nan=False
    )


def _iso_date(value: object) -> object:
    # TOML has dates of its own; JSON and the command line have only text.
    if isinstance(value, datetime.date) and not isinstance(value, datetime.datetime):
        return value.isoformat()
    if isinstance(value, str):
        try:
            if re.fullmatch(r"\d{4}-\d{2}-\d{2}", value):
                datetime.date.fromisoformat(value)
                return value
        except ValueError:
            pass
        raise ValueError("an ISO date such as 1975-07-01")
    return value


IsoDate = Annotated[str, pydantic.BeforeValidator(_iso_date)]
"""A parameter that is a date, kept as ISO text; TOML may write its own."""


def quantity(unit: str, *, doc: str, default: Any = PydanticUndefined, **limits: Any) -> Any:
    """A parameter field with its unit ("1" for none), description and limits (gt, ge, lt, le)."""
    return pydantic.Field(default, description=doc, json_schema_extra={"unit": unit}, **limits)


@dataclass(frozen=True)
class Many:
    """An input role that takes one or more datasets of a contract."""

    contract: str


@dataclass(frozen=True)
class OptionalInput:
    """An input role that takes a dataset of a contract where it is given, none where not."""

    contract: str


@dataclass(frozen=True)
class Stage:
    """A step of the pipeline, declared.

    Attributes
    ----------
    name : the name on the command line and in receipts.
    version : raised whenever the same inputs would give other output.
    params : the class of its parameters.
    inputs : role to contract; `Many(contract)` for several, `OptionalInput(contract)` for one
        that may be left out, `FILES` for foreign files, `OPTIONAL_FILE` for one that may be
        left out. Stages of one name differ in their roles.
    output : contract of what `run` returns.
    run : called with one keyword per role and ``params``; does no I/O outside ``ingest``.
    """

    name: str
    version: int
    params: type[Params]
    inputs: Mapping[str, str | Many | OptionalInput]
    output: str
    run: Callable[..., xr.Dataset]


def parse_params(
    kind: type[Params],
    values: Mapping[str, Any],
    *,
    where: object,
    error: type[MagtilesError] = ParameterError,
) -> Any:
    """Build `kind` from plain values; the error names the key, what was found and the remedy.

    Lists become tuples, as TOML and JSON have no tuples. Raises `error`.
    """
    try:
        return kind.model_validate({k: _tuples(v) for k, v in values.items()})
    except pydantic.ValidationError as caught:
        raise _first_problem(kind, caught, where, error) from None


def _first_problem(
    kind: type[Params],
    caught: pydantic.ValidationError,
    where: object,
    error: type[MagtilesError],
) -> MagtilesError:
    # A misspelt key also makes its true name missing: name the misspelling first.
    problem = min(caught.errors(), key=lambda e: e["type"] != "extra_forbidden")
    location = problem["loc"]
    absent = problem["type"] == "missing"
    if absent and isinstance(location[-1], int):  # a short list, not a missing key
        absent, location = False, location[:-1]
    key, table, field = _place(kind, location)
    if problem["type"] == "extra_forbidden":
        known = ", ".join(sorted(table.model_fields)) or "none"
        return error(
            f"unknown key '{key}'",
            where=where,
            expected=f"one of {known}",
            remedy="correct or remove it",
        )
    meaning = f" ({field.description})" if field is not None and field.description else ""
    if absent:
        return error(f"key '{key}' is missing{meaning}", where=where, remedy=f"add {key} = ...")
    return error(
        f"key '{key}' is {_plain(problem['input'])!r}",
        where=where,
        expected=_expectation(problem, meaning),
    )


def _place(
    kind: type[Params], location: tuple[int | str, ...]
) -> tuple[str, type[Params], FieldInfo | None]:
    """A key as TOML writes it, the innermost table that holds it, and its field if known."""
    key, table, field = "", kind, None
    inner: type[Params] | None = kind
    for part in location:
        if isinstance(part, int):
            key += f"[{part}]"
            continue
        key = f"{key}.{part}" if key else part
        if inner is not None:
            table, field = inner, inner.model_fields.get(part)
            inner = None if field is None else _table(field.annotation)
    return key, table, field


def _table(annotation: Any) -> type[Params] | None:
    """The table that a field holds, if it is one (or none)."""
    for kind in (annotation, *get_args(annotation)):
        if isinstance(kind, type) and issubclass(kind, Params):
            return kind
    return None


_WORDS = {
    "tuple_type": "a list",
    "model_type": "a table",
    "dict_type": "a table",
    "bool_type": "true or false",
}
"""What pydantic expects, in the words of TOML where its own are of Python."""


def _expectation(problem: ErrorDetails, meaning: str) -> str:
    if problem["type"] == "string_pattern_mismatch":
        return f"text that matches {problem['ctx']['pattern']}{meaning}"
    if problem["type"] in ("missing", "too_long"):
        return f"a list of another length{meaning}"
    said = problem["msg"].removeprefix("Input should be ").removeprefix("Value error, ")
    return _WORDS.get(problem["type"], said)


def _plain(value: Any) -> Any:
    """A value as TOML has it: tuples are lists again."""
    if isinstance(value, tuple):
        return [_plain(v) for v in value]
    return value


def _tuples(value: Any) -> Any:
    if isinstance(value, list):
        return tuple(_tuples(v) for v in value)
    if isinstance(value, dict):
        return {k: _tuples(v) for k, v in value.items()}
    return value
