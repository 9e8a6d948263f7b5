"""Checking datasets against their contracts.

A contract is a JSON Schema (2020-12) over a *descriptor*: a plain dictionary that says of
a dataset its dimensions, each variable's dims, dtype, units, attributes and value range,
and the global attributes. One schema file, ``<name>-<major.minor.patch>.schema.json``, is
one version; ``name/major`` names the newest of that major.
"""

from __future__ import annotations

import functools
import json
import re
from collections.abc import Iterator
from importlib import resources
from typing import TYPE_CHECKING, Any

import numpy as np

from magtiles.schemas.errors import ContractError

if TYPE_CHECKING:
    import jsonschema
    import xarray as xr

_SCHEMA_FILE = re.compile(r"(?P<name>[a-z-]+)-(?P<version>\d+\.\d+\.\d+)\.schema\.json")


def available() -> dict[str, list[str]]:
    """Every contract name with its versions, oldest first."""
    found: dict[str, list[str]] = {}
    for entry in resources.files("magtiles.schemas").iterdir():
        if match := _SCHEMA_FILE.fullmatch(entry.name):
            found.setdefault(match["name"], []).append(match["version"])
    for versions in found.values():
        versions.sort(key=_numbers)
    return dict(sorted(found.items()))


def resolve(contract: str) -> str:
    """Full name of a contract: ``anomaly-grid/1`` becomes ``anomaly-grid/1.0.0``.

    Raises ContractError when no such contract or version exists.
    """
    name, _, version = contract.partition("/")
    wanted = version.split(".")
    matching = [v for v in available().get(name, []) if v.split(".")[: len(wanted)] == wanted]
    if not matching:
        known = ", ".join(f"{n}/{v[-1].split('.')[0]}" for n, v in available().items())
        raise ContractError(f"no contract named '{contract}'", expected=f"one of {known}")
    return f"{name}/{matching[-1]}"


@functools.cache
def load_schema(contract: str) -> dict[str, Any]:
    """The JSON Schema of a contract, by full or major name."""
    name, _, version = resolve(contract).partition("/")
    text = resources.files("magtiles.schemas").joinpath(f"{name}-{version}.schema.json")
    schema: dict[str, Any] = json.loads(text.read_text(encoding="utf-8"))
    return schema


def describe(dataset: xr.Dataset) -> dict[str, Any]:
    """The descriptor of a dataset that the schemas are written over.

    Ranges ignore NaN; ``minimum`` and ``maximum`` are None where nothing is finite.
    """
    return {
        "dims": {str(k): int(v) for k, v in dataset.sizes.items()},
        "variables": {str(k): _describe_variable(v) for k, v in dataset.variables.items()},
        "attrs": {str(k): _plain(v) for k, v in dataset.attrs.items()},
    }


def check(dataset: xr.Dataset, contract: str, *, where: object = None) -> None:
    """Raise ContractError, naming the first breach, unless `dataset` keeps `contract`."""
    check_document(describe(dataset), contract, where=where)


def check_document(document: dict[str, Any], contract: str, *, where: object = None) -> None:
    """Raise ContractError unless a JSON document (descriptor, manifest) keeps `contract`."""
    problems = sorted(_validator(resolve(contract)).iter_errors(document), key=_severity)
    if problems:
        raise _breach(problems[0], document, resolve(contract), where)


_BOUNDS = {"minimum": "at least", "exclusiveMinimum": "more than", "maximum": "at most"}


def _breach(
    problem: jsonschema.ValidationError, document: dict[str, Any], contract: str, where: object
) -> ContractError:
    path = ".".join(str(part) for part in problem.absolute_path)
    place = " ".join(part for part in (str(where or ""), path) if part) or None
    what, expected = problem.message, None
    if problem.validator == "required":
        missing = [k for k in problem.validator_value if k not in problem.instance]
        what = f"'{missing[0]}' is missing"
        expected = f"all of {', '.join(problem.validator_value)}"
    elif problem.validator == "const":
        what, expected = f"found {problem.instance!r}", f"{problem.validator_value!r}"
    elif problem.validator == "enum":
        what = f"found {problem.instance!r}"
        expected = " or ".join(repr(value) for value in problem.validator_value)
    elif problem.validator == "anyOf" and path.endswith(("minimum", "maximum")):
        bounds = problem.validator_value[-1].items()
        what = f"found {problem.instance:g}"
        expected = " and ".join(f"{_BOUNDS[name]} {bound:g}" for name, bound in bounds)
    elif problem.validator == "anyOf" and not path:
        what, expected = f"dims are {document.get('dims')}", "(y, x) or (latitude, longitude)"
    elif problem.validator == "anyOf" and all("required" in c for c in problem.validator_value):
        names = [name for choice in problem.validator_value for name in choice["required"]]
        what, expected = f"has none of {', '.join(names)}", "at least one of them"
    return ContractError(what, where=place, expected=expected, remedy=f"see contract {contract}")


@functools.cache
def _validator(contract: str) -> jsonschema.protocols.Validator:
    import jsonschema

    return jsonschema.Draft202012Validator(load_schema(contract))


def _severity(problem: jsonschema.ValidationError) -> tuple[int, str]:
    # A missing variable explains more than what follows from it.
    order = {"required": 0, "anyOf": 2}
    return order.get(str(problem.validator), 1), str(list(problem.absolute_path))


def _describe_variable(variable: xr.Variable) -> dict[str, Any]:
    described: dict[str, Any] = {
        "dims": [str(d) for d in variable.dims],
        "dtype": str(variable.dtype),
        "attrs": {str(k): _plain(v) for k, v in variable.attrs.items()},
    }
    if "units" in variable.attrs:
        described["units"] = str(variable.attrs["units"])
    if variable.dtype.kind in "fiu":
        described |= _describe_values(variable)
    elif variable.dtype.kind == "M":
        described["finite"] = not bool(np.isnat(variable.values).any())
    return described


def _describe_values(variable: xr.Variable) -> dict[str, Any]:
    """What is finite, and the range; strip by strip, for the array may be larger than memory."""
    finite, lows, highs = True, [], []
    for values in _strips(variable):
        if values.size == 0:
            continue
        low, high = values.min(), values.max()
        # min and max carry a NaN through, so a clean array needs no further pass.
        if not (np.isfinite(low) and np.isfinite(high)):
            finite = False
            kept = values[~np.isnan(values)]
            if kept.size == 0:
                continue
            low, high = kept.min(), kept.max()
        lows.append(float(low))
        highs.append(float(high))
    described: dict[str, Any] = {
        "finite": finite,
        "minimum": min(lows, default=None),
        "maximum": max(highs, default=None),
    }
    if variable.ndim == 1 and variable.size:
        described["ascending"] = bool(np.all(np.diff(variable.values) > 0))
    return described


_STRIP_NODES = 1 << 20


def _strips(variable: xr.Variable) -> Iterator[np.ndarray[Any, Any]]:
    """The values in strips along the first of several dimensions; of one or none, all at once."""
    if variable.ndim < 2 or variable.size <= _STRIP_NODES:
        yield variable.values
        return
    rows = max(1, _STRIP_NODES * variable.shape[0] // variable.size)
    for first in range(0, variable.shape[0], rows):
        yield variable[first : first + rows].values


def _plain(value: Any) -> Any:
    if isinstance(value, np.ndarray):
        return value.tolist()
    if isinstance(value, np.generic):
        return value.item()
    return value


def _numbers(version: str) -> tuple[int, ...]:
    return tuple(int(part) for part in version.split("."))
