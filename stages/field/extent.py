"""Where on the Earth a grid has data."""

from __future__ import annotations

import numpy as np
import xarray as xr

from magtiles.stages.field.geometry import axes
from magtiles.stages.field.plane import choose_plane


def data_bounds(grid: xr.Dataset) -> tuple[float, float, float, float]:
    """South, north, west, east (WGS84 degrees) of the nodes that have data.

    West is within -180 to 180; east counts on from it, past 180 across the date line.
    """
    rows, columns = axes(grid)
    i, j = np.nonzero(np.isfinite(grid["magnetic_anomaly"].values))
    # Along each row its first and last datum suffice: the outline of what there is.
    first = np.full(rows.size, columns.size)
    last = np.full(rows.size, -1)
    np.minimum.at(first, i, j)
    np.maximum.at(last, i, j)
    used = np.flatnonzero(last >= 0)
    x = columns[np.concatenate([first[used], last[used]])]
    y = rows[np.concatenate([used, used])]
    lon, lat = choose_plane(grid).source.transform(x, y)
    middle = float(lon[lon.size // 2])
    unwrapped = middle + (np.asarray(lon) - middle + 180.0) % 360.0 - 180.0
    west = (float(unwrapped.min()) + 180.0) % 360.0 - 180.0
    return float(np.min(lat)), float(np.max(lat)), west, west + float(np.ptp(unwrapped))
