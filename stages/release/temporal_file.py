"""Writing temporal.nc: netCDF-4 with CF-1.11 metadata, the same bytes for the same dataset."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import netCDF4
import numpy as np
import xarray as xr
from numpy.typing import NDArray

from magtiles.catalog.releases.digest import array_digest, sha256
from magtiles.catalog.releases.temporal_file import read_temporal
from magtiles.catalog.releases.temporal_table import (
    CONTRACT,
    DAYS,
    MOST,
    PATH,
    SECONDS,
    TEMPORAL_VARIABLES,
    TemporalVariable,
)
from magtiles.schemas import contracts
from magtiles.schemas.errors import ContractError
from magtiles.stages.release.atomic import atomic_path

_CHUNK = 4096
"""Most values of a chunk along its last dimension."""
_DEFLATE = 4
_TOLD = {
    "title": "quiet-day variations of the magnetic field, and statistics of what they leave",
    "history": "fitted by magtiles to observatory records; how is in provenance.json",
}
_STANDARD_NAMES = ("latitude", "longitude")
_SECOND, _DAY = np.timedelta64(1, "s"), np.timedelta64(1, "D")


def write_temporal(dataset: xr.Dataset, path: Path) -> None:
    """Write a dataset of contract temporal-model/1, which appears whole or not at all.

    Raises ContractError for a dataset that is none, or with variables that a release has no
    place for.
    """
    contracts.check(dataset, CONTRACT, where=path)
    names = sorted(map(str, dataset.variables))
    for name in names:
        if name not in TEMPORAL_VARIABLES:
            raise ContractError(
                f"variable {name} has no place in a release",
                where=path,
                expected=f"only variables of {CONTRACT}",
            )
    with atomic_path(path) as temporary, netCDF4.Dataset(temporary, "w", format="NETCDF4") as file:
        kept = {k: v for k, v in dataset.attrs.items() if k not in ("Conventions", "contract")}
        _set_attributes(file, {**_TOLD, **kept, "Conventions": "CF-1.11", "contract": CONTRACT})
        for dimension in (d for d in MOST if d in dataset.sizes):
            file.createDimension(dimension, dataset.sizes[dimension])
        for name in names:
            _write_variable(file, name, dataset[name])


def measure_temporal(path: Path) -> dict[str, Any]:
    """The manifest's record of a temporal.nc, which is read back as a reader would.

    Raises IntegrityError for a file that a reader would refuse.
    """
    data = path.read_bytes()
    return {
        "path": PATH,
        "role": "temporal",
        "contract": CONTRACT,
        "size": len(data),
        "sha256": sha256(data),
        "array_digest": array_digest(read_temporal(data, path).variables),
    }


def _write_variable(file: Any, name: str, array: xr.DataArray) -> None:
    rule, sizes = TEMPORAL_VARIABLES[name], array.sizes
    text = rule.dtypes == ("str",)
    chunks = [min(sizes[d], _CHUNK) if d == rule.dims[-1] else 1 for d in rule.dims]
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
    if rule.units in (SECONDS, DAYS):
        own["calendar"] = "proleptic_gregorian"
    _set_attributes(variable, {**kept, "long_name": rule.long_name, **own})
    variable[...] = values.astype(object) if text else values


def _stored(rule: TemporalVariable, values: NDArray[Any]) -> NDArray[Any]:
    """Values as the file has them: times counted, text as str, numbers little-endian."""
    if rule.dtypes == ("str",):
        return values.astype(str)
    if rule.units == SECONDS:
        whole: NDArray[Any] = (values - np.datetime64(0, "ns")) // _SECOND
        return whole.astype(np.int64)
    if rule.units == DAYS:
        missing = np.isnat(values)
        days: NDArray[Any] = (np.where(missing, np.datetime64(0, "ns"), values)
                              - np.datetime64(0, "ns")) / _DAY  # fmt: skip
        return np.where(missing, np.nan, days)
    return values


def _set_attributes(target: Any, attributes: dict[Any, Any]) -> None:
    for key in sorted(attributes, key=str):
        target.setncattr(str(key), attributes[key])
