"""GMT's old netCDF grids: one flat variable ``z``, its ranges and steps beside it.

The layout is that of GMT up to version 4 (format ``cf``'s predecessor): values run from the
north-west, west to east; ``node_offset`` 1 means that ranges are the edges of cells.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from magtiles.schemas.errors import FormatError
from magtiles.stages.ingest.raw import Converted, RawGrid, mark_voids
from magtiles.stages.ingest.source import GridFileParams

_VARIABLES = {"x_range", "y_range", "spacing", "dimension", "z"}


def is_old_gmt(dataset: xr.Dataset) -> bool:
    """Whether a netCDF dataset, its values still packed, has GMT's old layout."""
    return set(dataset.variables) >= _VARIABLES and dataset["z"].ndim == 1


def read_old_gmt(dataset: xr.Dataset, path: Path, params: GridFileParams) -> RawGrid:
    """The grid of an old GMT file, north row first. Such files state neither CRS nor unit.

    Raises FormatError where the declared shape is not that of the values.
    """
    columns, rows = (int(n) for n in dataset["dimension"].values)
    stored = dataset["z"]
    if min(rows, columns) < 2 or rows * columns != stored.size:
        raise FormatError(
            f"z holds {stored.size} values",
            where=path,
            expected=f"dimension {columns} x {rows} = {columns * rows}",
            remedy="fetch it again",
        )
    # GMT's own mark is NaN; grids resampled from others may still hold theirs.
    own = float(stored.attrs.get("_FillValue", np.nan))
    mark = params.no_data if np.isnan(own) else own
    scale = float(stored.attrs.get("scale_factor", 1.0))
    offset = float(stored.attrs.get("add_offset", 0.0))
    cells = int(stored.attrs.get("node_offset", 0)) == 1
    return RawGrid(
        values=Converted(
            stored.values.reshape(rows, columns),
            lambda part: mark_voids(part, mark) * scale + offset,
        ),
        x=_nodes(dataset["x_range"].values, columns, cells),
        y=_nodes(dataset["y_range"].values, rows, cells)[::-1],
        crs=None,
        says={"registration": "pixel" if cells else "point"},
    )


def _nodes(limits: NDArray[np.float64], count: int, cells: bool) -> NDArray[np.float64]:
    low, high = (float(v) for v in limits)
    if not cells:
        return np.linspace(low, high, count)
    half = (high - low) / count / 2
    return np.linspace(low + half, high - half, count)
