"""Axes of a grid and true distances along them."""

from __future__ import annotations

from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from magtiles.stages.crs import dataset_crs

Real = NDArray[np.float64]


def axes(grid: xr.Dataset) -> tuple[Real, Real]:
    """Row and column coordinates: (y, x) in metres or (latitude, longitude) in degrees."""
    first, second = grid["magnetic_anomaly"].dims
    return grid[first].values, grid[second].values


def is_geographic(grid: xr.Dataset) -> bool:
    """Whether the grid's axes are latitude and longitude."""
    return grid["magnetic_anomaly"].dims[0] == "latitude"


def is_whole_circle(longitude: Real) -> bool:
    """Whether ascending longitudes (degrees) go all around the globe, each meridian once."""
    step = float(longitude[1] - longitude[0])
    return bool(abs(longitude[-1] - longitude[0] + step - 360.0) < 0.5 * step)


def steps(grid: xr.Dataset) -> tuple[float, float]:
    """Mean node spacing along rows and columns, in the axes' own units."""
    return tuple((a[-1] - a[0]) / max(a.size - 1, 1) for a in axes(grid))


def true_spacing(grid: xr.Dataset) -> tuple[float, float]:
    """Node spacing (m) along rows and columns, at the middle of the grid.

    Projected grids count plane metres; a projection's scale is a matter for the plane.
    """
    dy, dx = steps(grid)
    if not is_geographic(grid):
        return dy, dx
    rows, columns = axes(grid)
    ellipsoid = dataset_crs(grid).get_geod()
    assert ellipsoid is not None
    lat, lon = float(rows[rows.size // 2]), float(columns[columns.size // 2])
    return (
        ellipsoid.line_length([lon, lon], [lat - dy / 2, lat + dy / 2]),
        ellipsoid.line_length([lon - dx / 2, lon + dx / 2], [lat, lat]),
    )


def variable(
    grid: xr.Dataset, values: Any, units: str, long_name: str
) -> tuple[tuple[Any, ...], Any, dict[str, str]]:
    """A gridded variable of `grid`, as xarray takes it, tied to its crs."""
    attributes = {"units": units, "long_name": long_name, "grid_mapping": "crs"}
    return grid["magnetic_anomaly"].dims, values, attributes
