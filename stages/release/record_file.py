"""Writing files of a release that are read whole: CF-1.11, the same bytes for the same dataset."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import netCDF4
import numpy as np
import xarray as xr
from numpy.typing import NDArray

from magtiles.catalog.releases.record_file import (
    DAYS,
    NANOSECONDS,
    SECONDS,
    RecordTable,
    RecordVariable,
)
from magtiles.schemas import contracts
from magtiles.schemas.errors import ContractError
from magtiles.stages.release.atomic import atomic_path

Chunks = Callable[[tuple[str, ...], Mapping[Any, int]], list[int]]
"""Sizes of chunks, for the dimensions of a variable and the sizes of a dataset."""

_DEFLATE = 4
_STANDARD_NAMES = ("latitude", "longitude")
_EPOCH = np.datetime64(0, "ns")
_SECOND, _DAY = np.timedelta64(1, "s"), np.timedelta64(1, "D")


def write_record(
    dataset: xr.Dataset, path: Path, table: RecordTable, told: Mapping[str, str], chunks: Chunks
) -> None:
    """Write a dataset of the table's contract, which appears whole or not at all.

    `told` are attributes that the dataset may have in words of its own.

    Raises ContractError for a dataset that is none, or with variables that a release has no
    place for.
    """
    contracts.check(dataset, table.contract, where=path)
    names = sorted(map(str, dataset.variables))
    for name in names:
        if name not in table.variables:
            raise ContractError(
                f"variable {name} has no place in a release",
                where=path,
                expected=f"only variables of {table.contract}",
            )
    kept = {k: v for k, v in dataset.attrs.items() if k not in ("Conventions", "contract")}
    own = {"Conventions": "CF-1.11", "contract": table.contract}
    with atomic_path(path) as temporary, netCDF4.Dataset(temporary, "w", format="NETCDF4") as file:
        _set_attributes(file, {**told, **kept, **own})
        for dimension in (d for d in table.most if d in dataset.sizes):
            file.createDimension(dimension, dataset.sizes[dimension])
        for name in names:
            rule = table.variables[name]
            _write_variable(file, name, rule, dataset[name], chunks(rule.dims, dataset.sizes))


def _write_variable(
    file: Any, name: str, rule: RecordVariable, array: xr.DataArray, chunks: list[int]
) -> None:
    text = rule.dtypes == ("str",)
    packing: dict[str, Any] = {} if text else {
        "compression": "zlib", "complevel": _DEFLATE, "shuffle": True, "fletcher32": True,
    }  # fmt: skip
    values = _stored(rule, array.transpose(*rule.dims).values)
    dtype = str if text else values.dtype
    variable = file.createVariable(
        name, dtype, rule.dims, fill_value=None if text else False, chunksizes=chunks, **packing
    )
    kept = {k: v for k, v in array.attrs.items() if str(k).startswith("flag_")}
    own = {} if rule.units is None else {"units": rule.units}
    if name in _STANDARD_NAMES:
        own["standard_name"] = name
    if rule.units in (NANOSECONDS, SECONDS, DAYS):
        own["calendar"] = "proleptic_gregorian"
    _set_attributes(variable, {**kept, "long_name": rule.long_name, **own})
    variable[...] = values.astype(object) if text else values


def _stored(rule: RecordVariable, values: NDArray[Any]) -> NDArray[Any]:
    """Values as the file has them: times counted, text as str."""
    if rule.dtypes == ("str",):
        return values.astype(str)
    if rule.units == NANOSECONDS:
        return values.astype("datetime64[ns]").astype(np.int64)
    if rule.units == SECONDS:
        whole: NDArray[Any] = (values - _EPOCH) // _SECOND
        return whole.astype(np.int64)
    if rule.units == DAYS:
        missing = np.isnat(values)
        days: NDArray[Any] = (np.where(missing, _EPOCH, values) - _EPOCH) / _DAY
        return np.where(missing, np.nan, days)
    return values


def _set_attributes(target: Any, attributes: dict[Any, Any]) -> None:
    for key in sorted(attributes, key=str):
        target.setncattr(str(key), attributes[key])
