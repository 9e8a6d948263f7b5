"""Writing roads/*.nc: netCDF-4 with CF-1.11 metadata, the same bytes for the same dataset."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import netCDF4
import numpy as np
import xarray as xr
from numpy.typing import NDArray

from magtiles.catalog.releases.digest import array_digest, sha256
from magtiles.catalog.releases.road_file import RoadData, read_road
from magtiles.catalog.releases.road_table import (
    CONTRACT,
    MOST,
    NANOSECONDS,
    ROAD_VARIABLES,
    RoadVariable,
    road_name,
)
from magtiles.schemas import contracts
from magtiles.schemas.errors import ContractError
from magtiles.stages.release.atomic import atomic_path

_CHUNK = 65_536
"""Most points of a chunk."""
_DEFLATE = 4
_HISTORY = "merged by magtiles from passes of vehicles; how is in provenance.json"


def road_path(dataset: xr.Dataset) -> str:
    """Where a road map lies in a release, by the name of its road and its direction."""
    name = road_name(str(dataset.attrs["road"]), str(dataset.attrs["direction"]))
    return f"roads/{name}.nc"


def write_road(dataset: xr.Dataset, path: Path) -> None:
    """Write a dataset of contract road-map/1, which appears whole or not at all.

    Raises ContractError for a dataset that is none, or with variables that a release has no
    place for.
    """
    contracts.check(dataset, CONTRACT, where=path)
    names = sorted(map(str, dataset.variables))
    for name in names:
        if name not in ROAD_VARIABLES:
            raise ContractError(
                f"variable {name} has no place in a release",
                where=path,
                expected=f"only variables of {CONTRACT}",
            )
    with atomic_path(path) as temporary, netCDF4.Dataset(temporary, "w", format="NETCDF4") as file:
        kept = {k: v for k, v in dataset.attrs.items() if k not in ("Conventions", "contract")}
        told = {"title": f"magnetic map of road {dataset.attrs['road']}", "history": _HISTORY}
        _set_attributes(file, {**told, **kept, "Conventions": "CF-1.11", "contract": CONTRACT})
        for dimension in (d for d in MOST if d in dataset.sizes):
            file.createDimension(dimension, dataset.sizes[dimension])
        for name in names:
            _write_variable(file, name, dataset[name])


def measure_road(path: Path, place: str) -> dict[str, Any]:
    """The manifest's record of a road's file at `place`, read back as a reader would.

    Raises IntegrityError for a file that a reader would refuse.
    """
    data = path.read_bytes()
    road = read_road(data, path)
    return {
        "path": place,
        "role": "road",
        "contract": CONTRACT,
        "size": len(data),
        "sha256": sha256(data),
        "array_digest": array_digest(road.variables),
        "bounds": _bounds(road),
        "length_m": float(np.ptp(road.variables["distance"])),
        "spacing_m": float(road.attributes["spacing_m"]),
    }


def _bounds(road: RoadData) -> dict[str, list[float]]:
    """South and north, west and east; a road over the date line has east beyond 180."""
    latitude, longitude = road.variables["latitude"], road.variables["longitude"]
    east = np.unwrap(longitude, period=360.0)
    west = float(east.min())
    shift = 360.0 * np.floor((west + 180.0) / 360.0)
    return {
        "latitude": [float(latitude.min()), float(latitude.max())],
        "longitude": [west - shift, float(east.max()) - shift],
    }


def _write_variable(file: Any, name: str, array: xr.DataArray) -> None:
    rule, sizes = ROAD_VARIABLES[name], array.sizes
    text = rule.dtypes == ("str",)
    chunks = [min(sizes[d], _CHUNK) if d != "vehicle" else 1 for d in rule.dims]
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
    if name in ("latitude", "longitude"):
        own["standard_name"] = name
    if rule.units == NANOSECONDS:
        own["calendar"] = "proleptic_gregorian"
    _set_attributes(variable, {**kept, "long_name": rule.long_name, **own})
    variable[...] = values.astype(object) if text else values


def _stored(rule: RoadVariable, values: NDArray[Any]) -> NDArray[Any]:
    """Values as the file has them: times counted, text as str."""
    if rule.dtypes == ("str",):
        return values.astype(str)
    if rule.units == NANOSECONDS:
        return values.astype("datetime64[ns]").astype(np.int64)
    return values


def _set_attributes(target: Any, attributes: dict[Any, Any]) -> None:
    for key in sorted(attributes, key=str):
        target.setncattr(str(key), attributes[key])
