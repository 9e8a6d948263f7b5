"""Where on the Earth a grid has data."""

from __future__ import annotations

import numpy as np
import xarray as xr

from magtiles.stages.field.geometry import axes
from magtiles.stages.field.plane import choose_plane
from magtiles.stages.rows import rows_of, strips


def data_bounds(grid: xr.Dataset) -> tuple[float, float, float, float]:
    """South, north, west, east (WGS84 degrees) of the nodes that have data.

    West is within -180 to 180; east counts on from it, past 180 across the date line.
    """
    rows, columns = axes(grid)
    # Along each row its first and last datum suffice: the outline of what there is.
    first, last, used = [], [], []
    for start, end in strips(grid["magnetic_anomaly"].shape):
        data = np.isfinite(rows_of(grid, start, end)["magnetic_anomaly"].values)
        some = np.flatnonzero(data.any(axis=1))
        first.append(columns[data[some].argmax(axis=1)])
        last.append(columns[::-1][data[some, ::-1].argmax(axis=1)])
        used.append(rows[start + some])
    x, y = np.concatenate([*first, *last]), np.concatenate([*used, *used])
    lon, lat = choose_plane(grid).source.transform(x, y)
    middle = float(lon[lon.size // 2])
    unwrapped = middle + (np.asarray(lon) - middle + 180.0) % 360.0 - 180.0
    west = (float(unwrapped.min()) + 180.0) % 360.0 - 180.0
    return float(np.min(lat)), float(np.max(lat)), west, west + float(np.ptp(unwrapped))
