"""Evaluating lattice values and spline coefficients at many scattered positions."""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import njit, prange
from numpy.typing import NDArray

Real = NDArray[np.float64]
Single = NDArray[np.float32]
Floats = NDArray[np.floating[Any]]


@njit(inline="always")
def _weights(t: float) -> tuple[float, float, float, float]:
    """Cubic B-spline weights of the four coefficients around a fractional position t."""
    s = 1.0 - t
    return (
        s * s * s / 6.0,
        (4.0 - 6.0 * t * t + 3.0 * t * t * t) / 6.0,
        (4.0 - 6.0 * s * s + 3.0 * s * s * s) / 6.0,
        t * t * t / 6.0,
    )


@njit(parallel=True, cache=True, nogil=True)
def evaluate_spline(
    coefficients: Floats, row: Real, column: Real, scale: float, shift: Real, out: Floats
) -> None:
    """Cubic B-spline values at scale * (row, column) + shift, each of `out`'s shape (m, n).

    Positions beyond the coefficients are moved to the nearest one that four by four
    coefficients surround.
    """
    last_row, last_column = coefficients.shape[0] - 2, coefficients.shape[1] - 2
    for i in prange(out.shape[0]):
        for j in range(out.shape[1]):
            r = min(max(row[i, j] * scale + shift[0], 1.0), last_row - 1e-9)
            c = min(max(column[i, j] * scale + shift[1], 1.0), last_column - 1e-9)
            r0, c0 = int(r), int(c)
            a = _weights(r - r0)
            b = _weights(c - c0)
            total = 0.0
            for m in range(4):
                line = coefficients[r0 - 1 + m]
                total += a[m] * (
                    b[0] * line[c0 - 1]
                    + b[1] * line[c0]
                    + b[2] * line[c0 + 1]
                    + b[3] * line[c0 + 2]
                )
            out[i, j] = total


@njit(parallel=True, cache=True, nogil=True)
def add_splines(coefficients: Single, row: Real, column: Real, out: Single) -> None:
    """Add to each of `out` (k, m, n) its cubic B-spline's values at (row, column).

    `coefficients` (rows, columns, k): those of all splines side by side, so that their sums are
    vectors. Positions beyond them are moved as by `evaluate_spline`.
    """
    last_row, last_column = coefficients.shape[0] - 2, coefficients.shape[1] - 2
    for i in prange(out.shape[1]):
        total = np.empty(coefficients.shape[2], np.float32)
        for j in range(out.shape[2]):
            r = min(max(row[i, j], 1.0), last_row - 1e-9)
            c = min(max(column[i, j], 1.0), last_column - 1e-9)
            r0, c0 = int(r), int(c)
            a = _weights(r - r0)
            b = _weights(c - c0)
            total[:] = 0.0
            for m in range(4):
                for n in range(4):
                    weight = np.float32(a[m] * b[n])
                    here = coefficients[r0 - 1 + m, c0 - 1 + n]
                    for k in range(total.size):
                        total[k] += weight * here[k]
            for k in range(total.size):
                out[k, i, j] += total[k]


@njit(parallel=True, cache=True, nogil=True)
def evaluate_linear(
    values: Real, row: Real, column: Real, scale: float, shift: float, out: Floats
) -> None:
    """Bilinear values at scale * (row, column) + shift; the edge holds beyond the array."""
    last_row, last_column = values.shape[0] - 1, values.shape[1] - 1
    for i in prange(out.shape[0]):
        for j in range(out.shape[1]):
            r = min(max(row[i, j] * scale + shift, 0.0), last_row)
            c = min(max(column[i, j] * scale + shift, 0.0), last_column)
            r0, c0 = int(r), int(c)
            r1, c1 = min(r0 + 1, last_row), min(c0 + 1, last_column)
            t, u = r - r0, c - c0
            out[i, j] = (1.0 - t) * ((1.0 - u) * values[r0, c0] + u * values[r0, c1]) + t * (
                (1.0 - u) * values[r1, c0] + u * values[r1, c1]
            )
