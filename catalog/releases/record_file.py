"""Files of a release that are read whole: opened from verified bytes, checked by a table."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import netCDF4
import numpy as np
from numpy.typing import NDArray

from magtiles.catalog.releases.hdf5 import LOCK
from magtiles.schemas.errors import IntegrityError

NANOSECONDS = "nanoseconds since 1970-01-01"
SECONDS = "seconds since 1970-01-01"
DAYS = "days since 1970-01-01"

_MOST_EXPANSION = 1032
"""The most that zlib can expand: a file that declares more holds none of it."""


@dataclass(frozen=True)
class RecordVariable:
    """Dimensions, dtypes as stored ("str": text), unit (None: has none) and description."""

    dims: tuple[str, ...]
    dtypes: tuple[str, ...]
    units: str | None
    long_name: str


@dataclass(frozen=True)
class RecordTable:
    """What a kind of file may hold.

    Attributes
    ----------
    name, file : of the kind, and of a file of it, as messages call them.
    contract : of the attribute `contract`.
    variables : all that may be there, by name.
    least, most : size of each dimension; at least 1 where `least` is silent.
    max_bytes : of the arrays together.
    """

    name: str
    file: str
    contract: str
    variables: Mapping[str, RecordVariable]
    most: Mapping[str, int]
    max_bytes: int
    least: Mapping[str, int] = field(default_factory=dict)


@dataclass(frozen=True)
class Record:
    """A whole verified file: its arrays by name (read-only), its attributes.

    Text is of dtype str; times are as stored.
    """

    variables: Mapping[str, NDArray[Any]]
    attributes: Mapping[str, Any] = field(default_factory=dict)


def read_record(
    data: bytes, where: object, table: RecordTable, wanted: Callable[[set[str]], Sequence[str]]
) -> Record:
    """Parse the verified bytes of a file by its table; every breach raises IntegrityError.

    `wanted` gives the variables that belong with those that are present.
    """
    try:
        with LOCK, netCDF4.Dataset(table.file, memory=data) as file:
            file.set_auto_maskandscale(False)
            _check_structure(file, where, table, wanted, len(data))
            variables = {name: _read(variable) for name, variable in file.variables.items()}
            attributes = {name: file.getncattr(name) for name in file.ncattrs()}
    except (OSError, RuntimeError, AttributeError, ValueError, MemoryError) as caught:
        raise problem(where, f"is no readable {table.name}: {caught}", "netCDF-4") from None
    for values in variables.values():
        values.flags.writeable = False
    return Record(variables, attributes)


def check_range(
    where: object, name: str, values: NDArray[Any], low: float, high: float, missing: bool
) -> None:
    """Refuse values outside low to high; NaN passes where it may be missing."""
    good = (values >= low) & (values <= high)
    if missing:
        good |= np.isnan(values)
    if not good.all():
        bad = values[~good].ravel()[0]
        raise problem(where, f"{name} holds {bad:g}", f"{low:g} to {high:g}")


def problem(where: object, what: str, expected: str) -> IntegrityError:
    """The error of a file that is not what it must be."""
    return IntegrityError(
        what, where=where, expected=expected, remedy="fetch or build the release again"
    )


def _check_structure(
    file: Any, where: object, table: RecordTable, wanted: Callable[[set[str]], Sequence[str]],
    size: int,
) -> None:  # fmt: skip
    """Contract, dimensions and variables, without reading any array."""
    found = file.getncattr("contract") if "contract" in file.ncattrs() else None
    if found != table.contract:
        raise problem(where, f"attribute contract is {found!r}", f"{table.contract!r}")
    present = set(file.variables)
    unknown = sorted(present - set(table.variables)) or sorted(file.groups)
    if unknown:
        raise problem(where, f"holds {unknown[0]}", f"only the variables of a {table.name}")
    missing = [name for name in wanted(present) if name not in present]
    if missing:
        raise problem(where, f"has no variable {missing[0]}", "all that belong with it")
    for name, dimension in file.dimensions.items():
        low, most = table.least.get(name, 1), table.most.get(name, 0)
        if not low <= dimension.size <= most:
            raise problem(where, f"dimension {name} is {dimension.size}", f"{low} to {most}")
    declared = sum(
        _check_variable(where, name, file.variables[name], table.variables[name])
        for name in present
    )
    if declared > min(table.max_bytes, _MOST_EXPANSION * size):
        raise problem(where, f"declares {declared} bytes of arrays", f"at most {table.max_bytes}")


def _check_variable(where: object, name: str, variable: Any, rule: RecordVariable) -> int:
    """Check one variable's declaration; the bytes that it declares."""
    dtype = "str" if variable.dtype is str else np.dtype(variable.dtype).name
    if variable.dimensions != rule.dims or dtype not in rule.dtypes:
        raise problem(
            where,
            f"{name} has dims and dtype {variable.dimensions, dtype}",
            f"{rule.dims} and {' or '.join(rule.dtypes)}",
        )
    units = variable.getncattr("units") if "units" in variable.ncattrs() else None
    if units != rule.units:
        raise problem(where, f"{name} has units {units!r}", f"{rule.units!r}")
    # Values of HDF5 data that is not chunked may lie in another file of the machine.
    if not isinstance(variable.chunking(), list):
        raise problem(where, f"{name} is stored contiguously", "chunked data")
    return int(variable.size) * (8 if dtype == "str" else np.dtype(dtype).itemsize)


def _read(variable: Any) -> NDArray[Any]:
    """A variable's values; text as str."""
    values = np.asarray(variable[...])
    return values.astype(str) if values.dtype == object else values
