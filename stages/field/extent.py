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
    x, y = [], []
    for start, end in strips(grid["magnetic_anomaly"].shape):
        data = np.isfinite(rows_of(grid, start, end)["magnetic_anomaly"].values)
        used = np.flatnonzero(data.any(axis=1))
        first, behind = data[used].argmax(axis=1), data[used, ::-1].argmax(axis=1)
        x += [columns[first], columns[columns.size - 1 - behind]]
        y += [rows[start + used]] * 2
    lon, lat = choose_plane(grid).source.transform(np.concatenate(x), np.concatenate(y))
    middle = float(lon[lon.size // 2])
    unwrapped = middle + (np.asarray(lon) - middle + 180.0) % 360.0 - 180.0
    west = (float(unwrapped.min()) + 180.0) % 360.0 - 180.0
    return float(np.min(lat)), float(np.max(lat)), west, west + float(np.ptp(unwrapped))
