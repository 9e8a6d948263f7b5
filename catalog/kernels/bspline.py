"""Interpolating cubic B-splines on uniform lattices (Unser 1999, IEEE Signal Proc. Mag. 16(6)).

A spline is f(y, x) = sum_ij c_ij b(y - i) b(x - j) with b the cubic B-spline; `prefilter`
turns node values into the coefficients c for which f passes through the nodes. The ends are
natural (no curvature), which for the smooth field of a tile disturbs less than mirrored ends:
either disturbance shrinks by 2 - sqrt(3) a node, but the natural one starts from the
curvature of the field, the mirrored one from its slope.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]

HALO = 12
"""Nodes beyond the cells a spline serves, so that its ends do not matter there."""

EDGE = 1e-9
"""Cells by which rounding may carry a position on the edge of a lattice outside it."""

NODE = 1e-9
"""Cells within which a position is on a node row and the next row does not contribute."""

_POINTS_AT_ONCE = 8192
"""Points evaluated together; bounds the memory of the gathered 4 x 4 neighbourhoods."""


def prefilter(values: NDArray[np.floating], axes: tuple[int, ...] = (0, 1)) -> Floats:
    """Coefficients of the cubic spline through `values`, along `axes`; same shape, float64."""
    coefficients = np.array(values, dtype=np.float64, order="C")
    for axis in axes:
        # Rows of a contiguous array keep each step of the recursion in the cache.
        rows = np.ascontiguousarray(np.moveaxis(coefficients, axis, 0))
        _solve(rows.reshape(len(rows), -1))
        coefficients = np.moveaxis(rows, 0, axis)
    return np.ascontiguousarray(coefficients)


def _solve(rows: Floats) -> None:
    """Solve (c[i-1] + 4 c[i] + c[i+1]) / 6 = f[i] in place; the end nodes keep their values."""
    last = len(rows) - 1
    if last < 2:
        return
    rows[1:last] *= 6.0
    pivots = np.zeros(last)
    work = np.empty(rows.shape[1])
    for i in range(1, last):
        pivots[i] = 1.0 / (4.0 - pivots[i - 1])
        np.subtract(rows[i], rows[i - 1], out=rows[i])
        np.multiply(rows[i], pivots[i], out=rows[i])
    for i in range(last - 1, 0, -1):
        np.multiply(rows[i + 1], pivots[i], out=work)
        np.subtract(rows[i], work, out=rows[i])


def weights(t: Floats) -> tuple[Floats, Floats]:
    """Weights, and their derivatives, of the four nodes around the fraction `t`; (n, 4) each."""
    s = 1.0 - t
    value = np.stack(
        [s**3, (3.0 * t - 6.0) * t * t + 4.0, (3.0 * s - 6.0) * s * s + 4.0, t**3], axis=-1
    )
    slope = np.stack([-s * s, (3.0 * t - 4.0) * t, (4.0 - 3.0 * s) * s, t * t], axis=-1)
    return value / 6.0, slope / 2.0


def evaluate(coefficients: Floats, y: Floats, x: Floats, *, slopes: bool = True) -> Floats:
    """Value and, with `slopes`, both derivatives of several splines at the same points.

    Parameters
    ----------
    coefficients : (rows, columns, channels), from `prefilter`.
    y, x : (n,) positions in node spacings from the first node, at least one node inside.

    Returns
    -------
    (3 or 1, n, channels): value, derivative along y and along x per node spacing.
    """
    out = np.empty((3 if slopes else 1, len(y), coefficients.shape[2]))
    for start in range(0, len(y), _POINTS_AT_ONCE):
        part = slice(start, start + _POINTS_AT_ONCE)
        _evaluate(coefficients, y[part], x[part], out[:, part])
    return out


def _evaluate(coefficients: Floats, y: Floats, x: Floats, out: Floats) -> None:
    i, j = np.floor(y).astype(np.intp), np.floor(x).astype(np.intp)
    wy, dy = weights(y - i)
    wx, dx = weights(x - j)
    four = np.arange(-1, 3)
    nodes = coefficients[(i[:, None] + four)[:, :, None], (j[:, None] + four)[:, None, :]]
    along_x = np.einsum("nabc,nb->nac", nodes, wx)
    np.einsum("nac,na->nc", along_x, wy, out=out[0])
    if len(out) == 3:
        np.einsum("nac,na->nc", along_x, dy, out=out[1])
        np.einsum("nac,na->nc", np.einsum("nabc,nb->nac", nodes, dx), wy, out=out[2])
