"""Filling what a survey did not measure, flagged, so that a transform can be taken."""

from __future__ import annotations

import numpy as np
import xarray as xr
from numba import njit
from numpy.typing import NDArray
from scipy import ndimage

from magtiles.catalog.flags import QualityFlag, flag_attributes
from magtiles.schemas.errors import SourceError
from magtiles.stages.declare import Params, Stage
from magtiles.stages.field.geometry import true_spacing

Real = NDArray[np.float64]
Mask = NDArray[np.bool_]

_COARSEST = 8
_SWEEPS = 40, 2000
_WORK = 4e6
"""Fewest and most sweeps of a level, and how many nodes they should visit in all."""
_TAPER_CELLS = 20


class FillVoidsParams(Params):
    """fill-voids has no parameters."""


def fill_voids(grid: xr.Dataset, *, params: FillVoidsParams) -> xr.Dataset:
    """Give every node a value, and say in `quality_flag` and `distance_to_data` which are made up.

    A gap the survey surrounds is a void (flag 1), bridged by minimum curvature (Briggs 1974).
    A gap connected to the border is beyond coverage (flag 2): the same surface, faded to
    the survey's mean over some cells so that it carries no false long wavelengths.

    Input and output (rows, columns) nT. Raises SourceError when nothing was measured.
    """
    values = grid["magnetic_anomaly"].values.astype(float)
    void, beyond = classify_gaps(np.isnan(values))
    missing = void | beyond
    if missing.all():
        raise SourceError(
            "every node of the grid is void",
            where=grid.attrs.get("source"),
            expected="at least one value",
            remedy="check no_data in the source's TOML",
        )
    spacing = true_spacing(grid)
    distance = distance_to(~missing, spacing)
    filled = extend(values, beyond, distance, exterior_taper(spacing))
    flags = np.where(void, QualityFlag.VOID_FILLED, 0) | np.where(
        beyond, QualityFlag.BEYOND_COVERAGE, 0
    )
    dims = grid["magnetic_anomaly"].dims
    return grid.assign(
        magnetic_anomaly=(dims, filled, grid["magnetic_anomaly"].attrs),
        distance_to_data=(dims, distance, {"units": "m", "long_name": "distance to nearest data"}),
        quality_flag=(dims, flags.astype(np.uint8), flag_attributes()),
    )


def classify_gaps(missing: Mask) -> tuple[Mask, Mask]:
    """Split missing nodes into those the data surround (voids) and those open to the border."""
    labels, _ = ndimage.label(np.pad(missing, 1, constant_values=True))
    outside = labels == labels[0, 0]
    beyond = outside[1:-1, 1:-1]
    return missing & ~beyond, beyond


def distance_to(target: Mask, spacing: tuple[float, float]) -> Real:
    """Distance (m) of every node to the nearest true one of `target`; infinite if there is none."""
    if not target.any():
        return np.full(target.shape, np.inf)
    return np.asarray(ndimage.distance_transform_edt(~target, sampling=spacing), dtype=float)


def exterior_taper(spacing: tuple[float, float]) -> float:
    """Distance (m) over which the fill beyond a survey's outline fades to the mean."""
    return float(_TAPER_CELLS * np.hypot(*spacing) / np.sqrt(2.0))


def extend(values: Real, beyond: Mask, distance: Real, taper_m: float) -> Real:
    """Minimum-curvature fill of NaN, faded to the mean where `beyond`; shape kept."""
    missing = np.isnan(values)
    if not missing.any():
        return values
    mean = values[~missing].mean()
    filled = minimum_curvature(values - mean, missing)
    fade = 0.5 + 0.5 * np.cos(np.pi * np.clip(distance / taper_m, 0.0, 1.0))
    return np.asarray(np.where(beyond, filled * fade, filled) + mean)


def minimum_curvature(values: Real, missing: Mask) -> Real:
    """Fill `missing` nodes with the smoothest surface through the rest, coarse to fine.

    Each level starts from the next coarser one (half the resolution) and is relaxed toward
    the biharmonic equation, its known nodes held; outside the array the surface goes on flat.
    """
    filled = np.where(missing, 0.0, values)
    if not missing.any():
        return filled
    filled[missing] = _start(filled, missing)
    nodes = np.argwhere(missing)
    _relax(filled, nodes, int(np.clip(_WORK / len(nodes), *_SWEEPS)))
    return filled


def _start(values: Real, missing: Mask) -> Real:
    """A first guess for the missing nodes, from the same problem on every second node."""
    coarse_missing = missing[::2, ::2]
    if coarse_missing.all() or min(values.shape) <= _COARSEST:
        return np.full(np.count_nonzero(missing), values[~missing].mean())
    coarse = minimum_curvature(values[::2, ::2], coarse_missing)
    places = np.argwhere(missing).T / 2.0
    return np.asarray(ndimage.map_coordinates(coarse, places, order=3, mode="nearest"))


@njit(cache=True, nogil=True)
def _relax(u: Real, nodes: NDArray[np.int64], sweeps: int) -> None:
    """Gauss-Seidel sweeps of the biharmonic stencil over `nodes`, forth and back, in place."""
    ny, nx = u.shape
    for sweep in range(sweeps):
        for n in range(nodes.shape[0]):
            at = n if sweep % 2 == 0 else nodes.shape[0] - 1 - n
            i, j = nodes[at, 0], nodes[at, 1]
            n1, s1 = min(i + 1, ny - 1), max(i - 1, 0)
            n2, s2 = min(i + 2, ny - 1), max(i - 2, 0)
            e1, w1 = min(j + 1, nx - 1), max(j - 1, 0)
            e2, w2 = min(j + 2, nx - 1), max(j - 2, 0)
            u[i, j] = (
                8.0 * (u[n1, j] + u[s1, j] + u[i, e1] + u[i, w1])
                - 2.0 * (u[n1, e1] + u[n1, w1] + u[s1, e1] + u[s1, w1])
                - (u[n2, j] + u[s2, j] + u[i, e2] + u[i, w2])
            ) / 20.0


STAGE = Stage(
    name="fill-voids",
    version=1,
    params=FillVoidsParams,
    inputs={"grid": "anomaly-grid/1"},
    output="anomaly-grid/1",
    run=fill_voids,
)
