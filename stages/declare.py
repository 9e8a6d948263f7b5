"""How a stage is declared: a pure function with its inputs, output and parameters as data.

>>> class ScaleParams(Params):
...     factor: float = quantity("1", gt=0, doc="What to multiply the anomaly by.")
>>> ScaleParams(factor=2.0).factor
2.0
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import pydantic
import xarray as xr
from pydantic_core import PydanticUndefined

from magtiles.schemas.errors import MagtilesError, ParameterError

FILES = "files"
"""Input kind of an ingest stage: foreign files or source TOMLs, one or more."""


class Params(pydantic.BaseModel):
    """Base of every stage's parameters: frozen, strict, finite, no unknown keys."""

    model_config = pydantic.ConfigDict(
        frozen=True, extra="forbid", strict=True, allow_inf_nan=False
    )


def quantity(unit: str, *, doc: str, default: Any = PydanticUndefined, **limits: Any) -> Any:
    """A parameter field with its unit ("1" for none), description and limits (gt, ge, lt, le)."""
    return pydantic.Field(default, description=doc, json_schema_extra={"unit": unit}, **limits)


@dataclass(frozen=True)
class Many:
    """An input role that takes one or more datasets of a contract."""

    contract: str


@dataclass(frozen=True)
class Stage:
    """A step of the pipeline, declared.

    Attributes
    ----------
    name : the name on the command line and in receipts.
    version : raised whenever the same inputs would give other output.
    params : the class of its parameters.
    inputs : role to contract; `Many(contract)` for several, `FILES` for foreign files.
    output : contract of what `run` returns.
    run : called with one keyword per role and ``params``; does no I/O outside ``ingest``.
    """

    name: str
    version: int
    params: type[Params]
    inputs: Mapping[str, str | Many]
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
    key = ".".join(str(part) for part in problem["loc"])
    if problem["type"] == "extra_forbidden":
        known = ", ".join(sorted(kind.model_fields)) or "none"
        return error(
            f"unknown key '{key}'",
            where=where,
            expected=f"one of {known}",
            remedy="correct or remove it",
        )
    if problem["type"] == "missing":
        field = kind.model_fields.get(key)
        meaning = f" ({field.description})" if field is not None and field.description else ""
        return error(f"key '{key}' is missing{meaning}", where=where, remedy=f"add {key} = ...")
    return error(
        f"key '{key}' is {problem['input']!r}",
        where=where,
        expected=problem["msg"].removeprefix("Input should be ").removeprefix("Value error, "),
    )


def _tuples(value: Any) -> Any:
    if isinstance(value, list):
        return tuple(_tuples(v) for v in value)
    if isinstance(value, dict):
        return {k: _tuples(v) for k, v in value.items()}
    return value
