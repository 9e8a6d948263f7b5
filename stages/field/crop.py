"""Cutting a grid to a region, with a margin for the transforms that follow."""

from __future__ import annotations

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from magtiles.schemas.errors import CoverageError, ParameterError
from magtiles.stages.declare import Params, Stage, quantity
from magtiles.stages.field.geometry import axes, is_geographic, is_whole_circle, true_spacing
from magtiles.stages.field.plane import Plane, choose_plane, grid_index
from magtiles.stages.rows import by_rows, rows_of, strips

Real = NDArray[np.float64]

_PROBES = 65


class CropGridParams(Params):
    """Parameters of crop-grid."""

    latitude: tuple[float, float] = quantity("degrees_north", doc="South and north limits, WGS84.")
    longitude: tuple[float, float] = quantity(
        "degrees_east", doc="West and east limits, WGS84; west > east crosses the date line."
    )
    margin_m: float = quantity("m", default=0.0, ge=0, doc="Kept around the region on each side.")


def crop_grid(grid: xr.Dataset, *, params: CropGridParams) -> xr.Dataset:
    """The smallest part of `grid` (rows, columns) that covers a region and its margin.

    Raises ParameterError for limits out of order, CoverageError when no data lie in the region.
    """
    south, north = params.latitude
    west, east = params.longitude
    if not -90 <= south < north <= 90:
        raise ParameterError(
            f"latitude = [{south}, {north}]",
            where="region",
            expected="south < north, both within -90 to 90",
        )
    grid = _cut_opposite(grid, west + ((east - west) % 360.0 or 360.0) / 2)
    plane = choose_plane(grid)
    row, column = grid_index(grid, plane, *_region_points(params, filled=False))
    span = []
    for index, size, step in zip(
        (row, column), grid["magnetic_anomaly"].shape, true_spacing(grid), strict=True
    ):
        margin = params.margin_m / step + 1.0
        first = max(0, int(np.floor(index.min() - margin)))
        last = min(size, int(np.ceil(index.max() + margin)) + 1)
        span.append(slice(first, last))
    if not _has_data(grid, plane, params):
        raise CoverageError(
            f"the region latitude {south:g} to {north:g}, longitude {west:g} to {east:g} "
            "has no data",
            where=grid.attrs.get("source"),
            expected=_extent(grid, plane),
            remedy="choose a region that overlaps the survey",
        )
    first_dim, second_dim = grid["magnetic_anomaly"].dims
    cut = grid.isel({first_dim: span[0], second_dim: span[1]})
    anomaly = cut["magnetic_anomaly"]
    values = by_rows(anomaly.shape, anomaly.dtype, lambda a, b: anomaly[a:b].values)
    return cut.assign(magnetic_anomaly=anomaly.copy(data=values))


def _cut_opposite(grid: xr.Dataset, longitude: float) -> xr.Dataset:
    """A grid all around the globe, cut open opposite a longitude; any other as it is."""
    if not is_geographic(grid) or not is_whole_circle(grid["longitude"].values):
        return grid
    own = grid["longitude"]
    step = float(own[1] - own[0])
    first = int(np.rint((longitude - 180.0 - float(own[0])) / step))
    start = float(own[0]) + step * first
    start = (start + 180.0) % 360.0 - 180.0
    turned = grid.roll(longitude=-first)
    return turned.assign_coords(
        longitude=("longitude", start + step * np.arange(own.size), own.attrs)
    )


def _region_points(params: CropGridParams, filled: bool) -> tuple[Real, Real]:
    """Latitude and longitude of points along a region's border, or over all of it."""
    (south, north), (west, east) = params.latitude, params.longitude
    width = (east - west) % 360.0 or 360.0
    t = np.linspace(0.0, 1.0, _PROBES)
    if filled:
        v, u = (a.ravel() for a in np.meshgrid(t, t))
    else:
        v = np.concatenate([t, t, t * 0, t * 0 + 1])
        u = np.concatenate([t * 0, t * 0 + 1, t, t])
    return south + (north - south) * v, west + width * u


def _has_data(grid: xr.Dataset, plane: Plane, params: CropGridParams) -> bool:
    """Whether a value was measured at any of a net of points over the region."""
    shape = grid["magnetic_anomaly"].shape
    row, column = grid_index(grid, plane, *_region_points(params, filled=True))
    r, c = np.rint(row).astype(int), np.rint(column).astype(int)
    within = (c >= 0) & (c < shape[1])
    for first, last in strips(shape):
        here = within & (r >= first) & (r < last)
        if here.any():
            values = rows_of(grid, first, last)["magnetic_anomaly"].values
            if np.isfinite(values[r[here] - first, c[here]]).any():
                return True
    return False


def _extent(grid: xr.Dataset, plane: Plane) -> str:
    """The grid's extent in WGS84, as a person would write it."""
    rows, columns = axes(grid)
    x, y = np.meshgrid(columns[[0, -1]], rows[[0, -1]])
    lon, lat = plane.source.transform(x, y)
    return (
        f"a region within about latitude {np.min(lat):.4g} to {np.max(lat):.4g}, "
        f"longitude {np.min(lon):.4g} to {np.max(lon):.4g}"
    )


STAGE = Stage(
    name="crop-grid",
    version=2,
    params=CropGridParams,
    inputs={"grid": "anomaly-grid/1"},
    output="anomaly-grid/1",
    run=crop_grid,
)
