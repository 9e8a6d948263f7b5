"""A map laid on its plane once, for windows of it to be read from as often as they are wanted."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
import xarray as xr

from magtiles.catalog.flags import QualityFlag
from magtiles.stages.field.prepare import PlaneMap
from magtiles.stages.field.windows import MapWindows, spans
from magtiles.stages.rows import strips

_ROWS, _COLUMNS = 1024, 2048
"""Nodes that are resampled at a time: of whole chunks of the file they go to."""


def lay_on_plane(windows: MapWindows) -> Iterator[xr.Dataset]:
    """Strips of a map on the plane it is transformed in, from south to north.

    Anomaly (nT), its sigma and flags on (y, x) in plane metres, named as in the grid.
    """
    for rows in strips(windows.shape, _ROWS * windows.shape[1]):
        yield _strip([windows.read(rows, c) for c in spans(windows.shape[1], _COLUMNS)])


def _strip(pieces: Sequence[PlaneMap]) -> xr.Dataset:
    """Pieces that lie beside each other, as one."""
    flags = [
        np.where(p.void, QualityFlag.VOID_FILLED, 0).astype(np.uint8)
        | np.where(p.beyond, QualityFlag.BEYOND_COVERAGE, 0).astype(np.uint8)
        for p in pieces
    ]
    first, dims = pieces[0], ("y", "x")
    sigma = (dims, np.hstack([p.sigma for p in pieces])) if first.sigma.ndim else ((), first.sigma)
    return xr.Dataset(
        {
            "magnetic_anomaly": (dims, np.hstack([p.values for p in pieces])),
            "magnetic_anomaly_uncertainty": sigma,
            "quality_flag": (dims, np.hstack(flags)),
        },
        coords={"y": first.y, "x": np.concatenate([p.x for p in pieces])},
    )
