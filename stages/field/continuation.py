"""Upward continuation of a total-field anomaly grid."""

from __future__ import annotations

import xarray as xr

from magtiles.stages.declare import Params, Stage, quantity
from magtiles.stages.field.components import DeriveComponentsParams, derive_components


class UpwardContinueParams(Params):
    """Parameters of upward-continue."""

    height_m: float = quantity("m", gt=0, doc="Height gain above the input surface.")


def upward_continue(grid: xr.Dataset, *, params: UpwardContinueParams) -> xr.Dataset:
    """The total-field anomaly `height_m` above a filled grid, on the same nodes.

    Multiplies the spectrum by exp(-k h) (Blakely 1995, eq. 12.8). Flags and uncertainty are
    those of the new surface. Raises ContractError when the grid has voids.
    """
    lifted = derive_components(grid, params=DeriveComponentsParams(height_m=params.height_m))
    kept = ["magnetic_anomaly", "magnetic_anomaly_uncertainty", "height", "crs", "quality_flag"]
    out = lifted[kept].assign_attrs(grid.attrs)
    if "reference_surface_height" in grid:
        out["reference_surface_height"] = grid["reference_surface_height"]
    return out


STAGE = Stage(
    name="upward-continue",
    version=1,
    params=UpwardContinueParams,
    inputs={"grid": "anomaly-grid/1"},
    output="anomaly-grid/1",
    run=upward_continue,
)
