"""A filled anomaly grid made ready for a transform: values on a plane, and where they are data."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import xarray as xr
from numpy.typing import NDArray
from scipy import ndimage

from magtiles.catalog.flags import QualityFlag
from magtiles.schemas.errors import ContractError
from magtiles.stages.field.geometry import axes, true_spacing
from magtiles.stages.field.interpolate import evaluate_spline
from magtiles.stages.field.padding import pad, plan_padding
from magtiles.stages.field.plane import STEP_M, Plane, choose_plane, index_of, on_lattice
from magtiles.stages.field.product import Level
from magtiles.stages.field.spectral import Inversion, Wavenumbers, forward

Real = NDArray[np.float64]
Mask = NDArray[np.bool_]

_OVERSAMPLING = 2
_EDGE_PROBES = 65


@dataclass(frozen=True)
class PlaneMap:
    """A map on its plane, every node finite.

    Attributes
    ----------
    plane : the projection.
    y, x : plane coordinates of the nodes, shapes (ny,) and (nx,), m.
    values : total-field anomaly (ny, nx), nT.
    void, beyond : (ny, nx), nodes filled inside the survey's outline and outside it.
    sigma : standard deviation of the survey's own values (ny, nx) or scalar, nT.
    """

    plane: Plane
    y: Real
    x: Real
    values: Real
    void: Mask
    beyond: Mask
    sigma: Real

    @property
    def step(self) -> tuple[float, float]:
        """Node spacing (y, x) in plane metres."""
        return (
            float(self.y[-1] - self.y[0]) / (self.y.size - 1),
            float(self.x[-1] - self.x[0]) / (self.x.size - 1),
        )

    @property
    def spacing(self) -> tuple[float, float]:
        """Node spacing (y, x) in true metres."""
        return self.step[0] / self.plane.scale, self.step[1] / self.plane.scale

    def distance(self, gaps: Mask, outside: bool) -> Real:
        """True distance (m) of each node to the nearest of `gaps` (or the array's outside)."""
        ringed = np.pad(gaps, 1, constant_values=outside)
        rows, columns = ringed.all(axis=1), ringed.all(axis=0)
        if np.array_equal(np.logical_or.outer(rows, columns), ringed):
            # Whole rows and columns: the nearest node of those is straight ahead.
            down, across = (
                _to_nearest(np.asarray(lines)) * d
                for lines, d in zip((rows, columns), self.spacing, strict=True)
            )
            found = np.minimum.outer(down, across)
        else:
            found = ndimage.distance_transform_edt(~ringed, sampling=self.spacing)
        return np.asarray(found[1:-1, 1:-1])


def _to_nearest(chosen: Mask) -> Real:
    """How many places each is from the nearest that is chosen; infinity where none is."""
    if not chosen.any():
        return np.full(chosen.size, np.inf)
    return np.asarray(ndimage.distance_transform_edt(~chosen))


def prepare(grid: xr.Dataset) -> PlaneMap:
    """Lay a filled grid on the plane of near-true scale that `choose_plane` finds.

    Raises ContractError when the grid still has voids.
    """
    values = grid["magnetic_anomaly"].values.astype(float)
    if not np.isfinite(values).all():
        row, column = np.argwhere(~np.isfinite(values))[0]
        raise ContractError(
            "the grid has voids",
            where=f"magnetic_anomaly[{row}, {column}]",
            expected="a value at every node",
            remedy="run fill-voids first",
        )
    plane = choose_plane(grid)
    void, beyond = gaps_of(grid)
    sigma = sigma_of(grid)
    if plane.is_source:
        y, x = axes(grid)
        return PlaneMap(plane, y, x, values, void, beyond, sigma)
    return _reproject(grid, plane, void, beyond, sigma)


def gaps_of(grid: xr.Dataset) -> tuple[Mask, Mask]:
    """Nodes filled inside the survey's outline, and nodes outside it."""
    if "quality_flag" not in grid:
        none = np.zeros(grid["magnetic_anomaly"].shape, dtype=bool)
        return none, none
    flags = grid["quality_flag"].values
    return (flags & QualityFlag.VOID_FILLED) > 0, (flags & QualityFlag.BEYOND_COVERAGE) > 0


def sigma_of(grid: xr.Dataset, otherwise: float | None = None) -> Real:
    """The survey's own sigma; where a gridded one is void, its median or what is given."""
    sigma = np.asarray(grid["magnetic_anomaly_uncertainty"].values, dtype=float)
    if otherwise is None and not np.isfinite(sigma).any():
        raise ContractError(
            "no finite value",
            where="magnetic_anomaly_uncertainty",
            expected="sigma in nT > 0",
            remedy="set uncertainty_nt in the source's TOML",
        )
    if otherwise is None:
        otherwise = float(np.nanmedian(sigma))
    return np.where(np.isfinite(sigma), sigma, otherwise)


def _reproject(grid: xr.Dataset, plane: Plane, void: Mask, beyond: Mask, sigma: Real) -> PlaneMap:
    """Resample onto a lattice of the plane, by Fourier oversampling and a cubic spline.

    A cubic spline through the samples themselves would cost 0.3 %; through samples twice as
    dense it costs less than the transform's own error.
    """
    y, x = plane_axes(grid, plane)
    row, column = on_lattice(lambda yy, xx: index_of(grid, *plane.to_source(xx, yy)), y, x, STEP_M)
    values = resample(grid["magnetic_anomaly"].values.astype(float), row, column)
    return PlaneMap(plane, y, x, values, *nearest_node(void, beyond, sigma, row, column))


def nearest_node(
    void: Mask, beyond: Mask, sigma: Real, row: Real, column: Real
) -> tuple[Mask, Mask, Real]:
    """`void`, `beyond` and `sigma` of the nodes nearest to a place; beyond where there are none."""
    nearest = [np.rint(row), np.rint(column)]
    inside = np.ones(row.shape, dtype=bool)
    for index, size in zip(nearest, void.shape, strict=True):
        inside &= (index >= 0) & (index <= size - 1)
    at = tuple(np.clip(i, 0, n - 1).astype(int) for i, n in zip(nearest, void.shape, strict=True))
    return void[at] & inside, beyond[at] | ~inside, sigma[at] if sigma.ndim else sigma


def plane_axes(grid: xr.Dataset, plane: Plane) -> tuple[Real, Real]:
    """Coordinates of a lattice that covers the grid's outline, at the grid's own density."""
    rows, columns = axes(grid)
    v = np.linspace(rows[0], rows[-1], _EDGE_PROBES)
    u = np.linspace(columns[0], columns[-1], _EDGE_PROBES)
    edge_rows = np.concatenate([v, v, np.full(u.size, v[0]), np.full(u.size, v[-1])])
    edge_columns = np.concatenate([np.full(v.size, u[0]), np.full(v.size, u[-1]), u, u])
    x, y = plane.from_source(edge_columns, edge_rows)
    axis = []
    for values, step in zip((y, x), true_spacing(grid), strict=True):
        spacing = step * plane.scale
        count = int(np.ceil((values.max() - values.min()) / spacing)) + 1
        middle = (values.max() + values.min()) / 2
        axis.append(middle + spacing * (np.arange(count) - (count - 1) / 2))
    return axis[0], axis[1]


def resample(values: Real, row: Real, column: Real) -> Real:
    """Values at fractional rows and columns, by Fourier oversampling and a cubic spline."""
    padding = plan_padding((values.shape[0], values.shape[1]), (1.0, 1.0), 0.0)
    inversion = Inversion(Wavenumbers(padding.shape, (1.0, 1.0)), (0.0, 0.0, 1.0))
    total = forward(pad(values, padding))
    level = Level(total, inversion, 0.0, density=_OVERSAMPLING)
    coefficients = level.values("total", slice(None), slice(None))
    out = np.empty(row.shape)
    shift = np.array(padding.offset, dtype=float) * _OVERSAMPLING
    evaluate_spline(coefficients, row, column, float(_OVERSAMPLING), shift, out)
    return out
