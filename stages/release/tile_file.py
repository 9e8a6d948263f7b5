"""Writing a tile: netCDF-4 with CF-1.11 metadata, the same bytes for the same dataset."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import netCDF4
import numpy as np
import xarray as xr

from magtiles.catalog.flags import flag_attributes
from magtiles.catalog.releases.tile_table import CONTRACT, LEVELS, TILE_VARIABLES, TileVariable
from magtiles.schemas import contracts
from magtiles.stages.release.atomic import atomic_path

_CHUNK = 128
"""Most nodes of a chunk each way, of one level: a query unpacks little more than it needs."""

_DEFLATE = 1
"""Levels 2 to 4 made the tiles of a synthetic map 0.9 % smaller and took up to 8 % longer."""

_AXES = {"height": "Z", "latitude": "Y", "longitude": "X"}
_HEIGHT_NAMES = {
    "ellipsoid": "height_above_reference_ellipsoid",
    "mean_sea_level": "altitude",
    "terrain": "height",
}
"""Height reference to the standard name that the CF table has for it."""

_HISTORY = "cut by magtiles from maps of each level; how those were made is in provenance.json"


def write_tile(dataset: xr.Dataset, path: Path, *, checked: bool = False) -> None:
    """Write a dataset of contract anomaly-tile/1 to `path`, which appears whole or not at all.

    Descriptions and packing come from the tile table, the mapping and the global attributes
    from the dataset. Nothing of the time or place of writing enters the file.

    Raises ContractError when the dataset is no tile, unless the caller has `checked` that.
    """
    if not checked:
        contracts.check(dataset, CONTRACT, where=path)
    with atomic_path(path) as temporary, netCDF4.Dataset(temporary, "w", format="NETCDF4") as file:
        place = f"row {dataset.attrs['tile_row']}, column {dataset.attrs['tile_column']}"
        told = {"title": f"magnetic anomaly tile, {place}", "history": _HISTORY}
        _set_attributes(file, told | dict(dataset.attrs))
        for name in LEVELS:
            file.createDimension(name, dataset.sizes[name])
        for name in sorted(set(TILE_VARIABLES) & set(map(str, dataset.variables))):
            _write_variable(file, name, dataset)


def _write_variable(file: Any, name: str, dataset: xr.Dataset) -> None:
    rule, values = TILE_VARIABLES[name], dataset[name]
    packing: dict[str, Any] = {}
    if rule.dims:
        sizes = [dataset.sizes[dim] for dim in rule.dims]
        packing = {
            "compression": "zlib",
            "complevel": _DEFLATE,
            "shuffle": True,
            "fletcher32": True,
            "chunksizes": [
                1 if dim == "height" and len(sizes) == 3 else min(size, _CHUNK)
                for dim, size in zip(rule.dims, sizes, strict=True)
            ],
        }
    # No pre-filling: every value is written, and a tile has no missing ones.
    variable = file.createVariable(name, rule.dtype, rule.dims, fill_value=False, **packing)
    _set_attributes(variable, _attributes(name, rule, dataset))
    variable[...] = np.asarray(values.values, dtype=rule.dtype) if rule.dims else 0


def _attributes(name: str, rule: TileVariable, dataset: xr.Dataset) -> dict[str, Any]:
    if name == "crs":
        return {str(key): value for key, value in dataset[name].attrs.items()}
    attributes: dict[str, Any] = {"long_name": rule.long_name}
    if rule.units is not None:
        attributes["units"] = rule.units
    if name in _AXES:
        attributes |= {"axis": _AXES[name], "standard_name": name}
    else:
        attributes["grid_mapping"] = "crs"
    if name == "height":
        attributes["positive"] = "up"
        attributes["standard_name"] = _HEIGHT_NAMES[dataset.attrs["height_reference"]]
    if name == "quality_flag":
        attributes |= flag_attributes()
    return attributes


def _set_attributes(target: Any, attributes: dict[Any, Any]) -> None:
    for key in sorted(attributes, key=str):
        target.setncattr(str(key), attributes[key])
