"""CF netCDF grids through xarray (CF-1.11 sections 2.5, 4, 5.6, 7.1 and 8.1)."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import netCDF4
import numpy as np
import pyproj
import xarray as xr
from numpy.typing import NDArray
from pyproj.exceptions import CRSError

from magtiles.schemas.errors import FormatError, SourceError
from magtiles.stages.ingest.foreign import read_foreign
from magtiles.stages.ingest.gmt_netcdf import is_old_gmt, read_old_gmt
from magtiles.stages.ingest.raw import METRES, Converted, RawGrid
from magtiles.stages.ingest.source import GridFileParams

_NORTH = ("degrees_north", "degree_north", "degrees_n", "degree_n")
_EAST = ("degrees_east", "degree_east", "degrees_e", "degree_e")

_STATED = (
    "reference_field",
    "reference_epoch",
    "anomaly_definition",
    "height_reference",
    "surface",
    "line_spacing_m",
    "source_distance_m",
    "wavelength_band_km",
)


def read_cf(path: Path, params: GridFileParams) -> RawGrid:
    """The variable of a CF netCDF file, its nodes, CRS and what its attributes state.

    Raises FormatError for a damaged file, missing or curvilinear coordinates; SourceError
    where the variable is not clear.
    """
    dataset = _load(path)
    return (read_old_gmt if is_old_gmt(dataset) else _read)(dataset, path, params)


def _load(path: Path) -> xr.Dataset:
    found = read_foreign(path)
    arrays = {name: (v.dims, v.values, v.attrs) for name, v in found.variables.items()}
    try:
        # xarray unpacks into float32, so packed integers are unpacked here in float64.
        return xr.decode_cf(
            xr.Dataset(arrays, attrs=found.attrs), mask_and_scale=False, decode_times=False
        )
    except (ValueError, TypeError, LookupError) as caught:
        raise FormatError(
            f"its variables do not fit together: {caught}", where=path, remedy="fetch it again"
        ) from None


def _read(dataset: xr.Dataset, path: Path, params: GridFileParams) -> RawGrid:
    name = _choose_variable(dataset, path, params)
    where = f"{path} variable '{name}'"
    variable = dataset[name]
    y_dim, x_dim = _axes(dataset, variable, where)
    flat = variable.squeeze([d for d in variable.dims if d not in (y_dim, x_dim)], drop=True)
    crs = _crs(dataset, variable, where)
    says = _stated(dataset, variable, x_dim)
    x, x_ulp = _nodes(dataset, x_dim, crs, where)
    y, y_ulp = _nodes(dataset, y_dim, crs, where)
    mark = None if "no_data" in says else params.no_data
    return RawGrid(
        values=Converted(flat.transpose(y_dim, x_dim), lambda part: _unpacked(part, mark)),
        x=x,
        y=y,
        x_ulp=x_ulp,
        y_ulp=y_ulp,
        crs=crs,
        says=says,
        uncertainty=_uncertainty(dataset, f"{name}_uncertainty", (y_dim, x_dim)),
    )


def _choose_variable(dataset: xr.Dataset, path: Path, params: GridFileParams) -> str:
    grids = [str(n) for n, v in dataset.data_vars.items() if v.squeeze().ndim == 2]
    if params.variable is not None:
        if params.variable not in grids:
            raise SourceError(
                f"no two-dimensional variable '{params.variable}'",
                where=f"{path} key 'variable'",
                expected=f"one of {', '.join(grids) or 'none'}",
            )
        return params.variable
    measures = params.measures
    right = [n for n in grids if measures.knows(str(dataset[n].attrs.get("units", "")))]
    found = [n for n in right if n.removesuffix("_uncertainty") not in set(right) - {n}]
    if not found:
        found = [n for n in grids if not str(dataset[n].attrs.get("units", "")).strip()]
    if len(found) != 1:
        raise SourceError(
            f"{len(found)} variables could be the grid's: {', '.join(found) or 'none'}",
            where=path,
            expected=f"one two-dimensional variable with the unit of {measures.name}, "
            f"such as {measures.unit}",
            remedy=f"choose one with the key 'variable' (grids: {', '.join(grids) or 'none'})",
        )
    return found[0]


def _axes(dataset: xr.Dataset, variable: xr.DataArray, where: str) -> tuple[str, str]:
    """Dimensions along y (or latitude) and x (or longitude)."""
    long = [str(d) for d, n in variable.sizes.items() if n > 1]
    if len(long) != 2:
        raise SourceError(f"has dimensions {dict(variable.sizes)}", where=where, expected="two")
    missing = [d for d in long if d not in dataset.variables or dataset[d].dims != (d,)]
    if missing:
        raise FormatError(
            f"dimension '{missing[0]}' has no coordinate of its own",
            where=where,
            expected="a coordinate variable per axis (a curvilinear grid is not supported)",
            remedy="resample it to a regular grid",
        )
    kinds = [_axis_kind(dataset[d]) for d in long]
    if set(kinds) == {"x", "y"}:
        return (long[0], long[1]) if kinds[0] == "y" else (long[1], long[0])
    raise FormatError(
        f"which of {long[0]} and {long[1]} is the eastward axis is not stated",
        where=where,
        expected="coordinates with units degrees_north and degrees_east, or the standard names "
        "projection_x_coordinate and projection_y_coordinate",
    )


def _axis_kind(coordinate: xr.DataArray) -> str | None:
    unit = str(coordinate.attrs.get("units", "")).lower()
    standard = coordinate.attrs.get("standard_name", "")
    axis = str(coordinate.attrs.get("axis", "")).lower()
    name = str(coordinate.name).lower()
    if unit in _EAST or standard in ("projection_x_coordinate", "longitude"):
        return "x"
    if unit in _NORTH or standard in ("projection_y_coordinate", "latitude"):
        return "y"
    if axis in ("x", "y"):
        return axis
    return {"x": "x", "easting": "x", "y": "y", "northing": "y"}.get(name)


def _nodes(
    dataset: xr.Dataset, dim: str, crs: pyproj.CRS | None, where: str
) -> tuple[NDArray[np.float64], float]:
    """Nodes along an axis in units of the CRS, and the rounding they were stored with."""
    coordinate = dataset[dim]
    stored = coordinate.values
    rounding = float(np.spacing(np.abs(stored).max())) if stored.dtype.kind == "f" else 0.0
    nodes = _unpacked(coordinate, None)
    bounds = coordinate.attrs.get("bounds")
    if bounds in dataset.variables and dataset[bounds].shape == (nodes.size, 2):
        # A coordinate may stand anywhere in its cell (CF 7.1); the value is the cell's.
        nodes = _unpacked(dataset[bounds], None).mean(axis=1)
    unit = str(coordinate.attrs.get("units", "")).lower()
    factor = METRES.get(unit, 1.0)
    if crs is not None and crs.is_projected and unit in METRES:
        factor /= crs.axis_info[0].unit_conversion_factor
    elif crs is not None and crs.is_projected and unit:
        raise FormatError(
            f"coordinate '{dim}' is in '{unit}', but the CRS is projected",
            where=where,
            expected=f"one of {', '.join(METRES)}",
        )
    return nodes * factor, rounding * factor


def _crs(dataset: xr.Dataset, variable: xr.DataArray, where: str) -> pyproj.CRS | None:
    mapping = variable.attrs.get("grid_mapping") or variable.encoding.get("grid_mapping")
    if mapping is None:
        return None
    name = str(mapping).split(":")[0].split()[0]
    if name not in dataset.variables:
        raise FormatError(f"its grid mapping '{name}' is missing", where=where)
    try:
        return pyproj.CRS.from_cf(dataset[name].attrs)
    except (CRSError, KeyError) as caught:
        raise FormatError(
            f"its grid mapping '{name}' is not understood: {caught}", where=where
        ) from None


def _stated(dataset: xr.Dataset, variable: xr.DataArray, x_dim: str) -> dict[str, Any]:
    says: dict[str, Any] = {k: dataset.attrs[k] for k in _STATED if k in dataset.attrs}
    for key, value in says.items():
        says[key] = value.item() if isinstance(value, np.generic) else value
    if "wavelength_band_km" in says:
        says["wavelength_band_km"] = tuple(float(v) for v in says["wavelength_band_km"])
    if str(variable.attrs.get("units", "")).strip():
        says["units"] = str(variable.attrs["units"])
    for name in ("_FillValue", "missing_value"):
        mark = _numbers(variable, name)
        if mark.size == 1 and np.isfinite(mark[0]):
            says["no_data"] = float(mark[0])
    if "bounds" in dataset[x_dim].attrs:
        says["registration"] = "pixel"
    height = dataset.variables.get("height")
    if height is not None and height.ndim == 0 and height.attrs.get("units") == "m":
        says["height_m"] = float(height)
    return says


def _uncertainty(dataset: xr.Dataset, name: str, dims: tuple[str, str]) -> Converted | float | None:
    if name not in dataset.variables:
        return None
    found = dataset[name]
    if found.ndim == 0:
        return float(_unpacked(found, None))
    return Converted(found.squeeze().transpose(*dims), lambda part: _unpacked(part, None))


def _unpacked(variable: xr.DataArray, extra_mark: float | None) -> NDArray[np.float64]:
    """Values as float64, unpacked (CF 8.1), with what the attributes mark missing (2.5.1) NaN."""
    stored = np.asarray(variable.values)
    attrs = variable.attrs
    if str(attrs.get("_Unsigned", "false")).lower() == "true" and stored.dtype.kind == "i":
        stored = stored.view(f"u{stored.dtype.itemsize}")
    marks = np.concatenate([_numbers(variable, n) for n in ("_FillValue", "missing_value")])
    if extra_mark is not None:
        marks = np.append(marks, extra_mark)
    if attrs.get("_FillValue") is None and stored.dtype.itemsize > 1:  # a byte may be any value
        marks = np.append(marks, netCDF4.default_fillvals[stored.dtype.str[1:]])
    void = np.zeros(stored.shape, dtype=bool)
    for mark in marks:
        void |= _equal(stored, mark)
    limits = _numbers(variable, "valid_range")
    low, high = _numbers(variable, "valid_min"), _numbers(variable, "valid_max")
    if limits.size == 2:
        low, high = limits[:1], limits[1:]
    if low.size:
        void |= stored < low[0]
    if high.size:
        void |= stored > high[0]
    scale, offset = _numbers(variable, "scale_factor"), _numbers(variable, "add_offset")
    values = stored * np.float64(scale[0] if scale.size else 1.0)
    values = values + np.float64(offset[0] if offset.size else 0.0)
    return np.where(void, np.nan, values)


def _numbers(variable: xr.DataArray, name: str) -> NDArray[np.float64]:
    """The numbers in an attribute, some write them as text; none where it is missing.

    Raises FormatError for other text.
    """
    said = variable.attrs.get(name)
    if said is None:
        return np.empty(0)
    words = said.replace(",", " ").split() if isinstance(said, str) else said
    try:
        return np.atleast_1d(np.asarray(words, dtype=np.float64))
    except (ValueError, TypeError):
        raise FormatError(
            f"attribute '{name}' is '{said}'",
            where=f"variable '{variable.name}'",
            expected="a number",
        ) from None


def _equal(stored: NDArray[Any], mark: float) -> NDArray[np.bool_]:
    """Where values are a mark, in their own precision; nowhere where their type cannot hold it."""
    if stored.dtype.kind == "f":
        with np.errstate(over="ignore"):
            return np.asarray(stored == stored.dtype.type(mark))
    return np.asarray(stored == mark)
