"""Artifacts: datasets that keep a contract, as netCDF-4 files that are never half written."""

from __future__ import annotations

import secrets
from pathlib import Path
from typing import Any

import netCDF4
import numpy as np
import xarray as xr

from magtiles.schemas import contracts
from magtiles.schemas.errors import ContractError, FormatError, MagtilesError
from magtiles.stages.ingest.hdf5_checks import check_hdf5
from magtiles.stages.release.atomic import atomic_path
from magtiles.stages.release.tile_file import write_tile

_CHUNK, _CHUNK_CACHE = (512, 256), 1 << 20
"""Rows and columns of a chunk in files of which windows are read, and bytes kept of them.

Of rows that are not in chunks, the library reads 64 kB each, however few are wanted.
"""

_HDF5_SIGNATURE = b"\x89HDF\r\n\x1a\n"


def write_artifact(dataset: xr.Dataset, path: Path, contract: str) -> None:
    """Write a dataset, uncompressed, with its contract's full name in attribute `contract`.

    Tiles are packed as a release holds them. The caller has checked a dataset in memory. Of one
    that is not (`magtiles.stages.rows`), strips are made, written and let go, and the file is
    checked before it gets its name: ContractError. Raises MagtilesError when it cannot be written.
    """
    try:
        if contract.startswith("anomaly-tile/"):
            write_tile(dataset, path, checked=True)
        else:
            _write_plain(dataset, path, contract)
    except (OSError, RuntimeError) as caught:  # netCDF4 says RuntimeError for a full disk
        raise MagtilesError(
            f"cannot be written ({caught})", where=path, remedy="check space and permissions"
        ) from caught


def _write_plain(dataset: xr.Dataset, path: Path, contract: str) -> None:
    plain = dataset.drop_encoding()
    if plain.chunks:  # what is in another file, then, strip by strip too
        plain = plain.chunk(plain.chunks, token=secrets.token_hex(8))
    plain.attrs |= {"Conventions": "CF-1.11", "contract": contracts.resolve(contract)}
    encoding: dict[Any, Any] = {}
    for name in plain.variables:
        plain[name].attrs = _flags_like(plain[name])
        encoding[name] = {"_FillValue": None}  # missing is NaN; a fill mark would turn u1 to float
    late = [name for name, variable in plain.variables.items() if variable.chunks]
    with atomic_path(path) as temporary:
        plain.drop_vars(late).to_netcdf(
            temporary,
            engine="netcdf4",
            format="NETCDF4",
            encoding={name: encoding[name] for name in encoding.keys() - set(late)},
        )
        if late:
            _add_strips(plain[late], temporary)
            with open_artifact(temporary, cache=False) as written:
                contracts.check(written, contract, where=path)


def _add_strips(dataset: xr.Dataset, path: Path) -> None:
    """Add variables whose values are not made yet, strip by strip."""
    import dask.config

    with (
        netCDF4.Dataset(path, "r+") as opened,
        dask.config.set(scheduler="synchronous"),  # one strip at a time, and here
    ):
        file: Any = opened
        for name, variable in dataset.data_vars.items():
            made = file.createVariable(name, variable.dtype, variable.dims, fill_value=False)
            made.setncatts(variable.attrs)
            first = 0
            for rows in (variable.chunks or ((),))[0]:
                made[first : first + rows] = variable[first : first + rows].values
                first += rows


def create_variable(file: Any, name: str, like: xr.Variable) -> Any:
    """A variable of a netCDF4.Dataset, to be written in strips of whole chunks: all of it will be.

    With the type, dimensions and attributes of another; in chunks where it has two dimensions.
    """
    kept: dict[str, Any] = {}
    if len(like.dims) == 2:
        sizes = (file.dimensions[dim].size for dim in like.dims)
        chunks = [min(pair) for pair in zip(sizes, _CHUNK, strict=True)]
        kept = {"chunksizes": chunks, "chunk_cache": _CHUNK_CACHE}
    made = file.createVariable(name, like.dtype, like.dims, fill_value=False, **kept)
    made.setncatts(like.attrs)
    return made


def open_artifact(path: Path, *, cache: bool = True) -> xr.Dataset:
    """Open an artifact, its arrays loaded when first touched and kept in their stored dtype.

    Without `cache` every touch reads again and keeps nothing in memory. Raises FormatError
    for a file that is missing, truncated, damaged, of another format, or that `check_hdf5`
    refuses: anybody may have made it.
    """
    _check_signature(path)
    check_hdf5(path, kind="netCDF-4")
    try:
        dataset = xr.open_dataset(
            path, engine="netcdf4", mask_and_scale=False, decode_timedelta=False, cache=cache
        )
    except (OSError, RuntimeError, ValueError, AttributeError) as caught:
        raise _damaged(path, caught) from caught
    for variable in dataset.variables.values():
        variable.attrs |= _flags_like(variable)
    return dataset


def check_artifact(path: Path, contract: str, *, role: str) -> None:
    """Check an artifact against a contract, reading every array once and keeping none.

    Raises ContractError naming file and role, FormatError when the arrays cannot be read.
    """
    where = f"{path} (role {role})"
    with open_artifact(path, cache=False) as dataset:
        claimed = str(dataset.attrs.get("contract", contract))
        if claimed.partition("/")[0] != contract.partition("/")[0]:
            raise ContractError(f"the file holds a {claimed}", where=where, expected=contract)
        try:
            contracts.check(dataset, contract, where=where)
        except (OSError, RuntimeError) as caught:
            raise _damaged(path, caught) from caught


def _check_signature(path: Path) -> None:
    if not path.is_file():
        raise FormatError("no such file", where=path, remedy="check the path")
    with path.open("rb") as file:
        start = file.read(len(_HDF5_SIGNATURE))
    if not start:
        raise FormatError("the file is empty", where=path, remedy="build or fetch it again")
    if start != _HDF5_SIGNATURE:
        raise FormatError(
            f"the file starts with {start!r}",
            where=path,
            expected="a netCDF-4 file",
            remedy="bring foreign formats in with stage ingest-grid",
        )


def _damaged(path: Path, caught: Exception) -> FormatError:
    return FormatError(
        f"the file is truncated or damaged ({caught})",
        where=path,
        expected="a netCDF-4 file",
        remedy="build or fetch it again",
    )


def _flags_like(variable: xr.Variable | xr.DataArray) -> dict[str, Any]:
    # CF wants masks in the dtype of the flag; netCDF gives an array of one back as a scalar.
    attrs = dict(variable.attrs)
    for key in ("flag_masks", "flag_values"):
        if key in attrs:
            attrs[key] = np.atleast_1d(np.asarray(attrs[key], dtype=variable.dtype))
    return attrs
