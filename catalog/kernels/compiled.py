"""The spline kernels of a patch, compiled by numba: import this only when a patch is made.

Fast-math leaves out ``nnan`` and ``ninf``: NaN positions must give NaN answers.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, TypeVar, cast

import numba
import numpy as np
from numpy.typing import NDArray

from magtiles.catalog.kernels.bspline import EDGE, HALO, NODE, Floats

_Function = TypeVar("_Function", bound=Callable[..., Any])


def _compile(function: _Function) -> _Function:
    options = {"contract", "reassoc", "nsz", "arcp"}
    jit: Any = numba.njit(cache=True, nogil=True, error_model="numpy", fastmath=options)
    return cast(_Function, jit(function))


_SIXTH = 1.0 / 6.0


@_compile
def _weights(t: float) -> Any:
    s = 1.0 - t
    w1 = ((3.0 * t - 6.0) * t * t + 4.0) * _SIXTH
    w2 = ((3.0 * s - 6.0) * s * s + 4.0) * _SIXTH
    return s * s * s * _SIXTH, w1, w2, t * t * t * _SIXTH


@_compile
def _slopes(t: float) -> Any:
    s = 1.0 - t
    return -0.5 * s * s, (1.5 * t - 2.0) * t, (2.0 - 1.5 * s) * s, 0.5 * t * t


@_compile
def spline(coefficients: Floats, y: Floats, x: Floats, out: Floats) -> None:
    """Fill `out` (3 or 1, n, channels) as `bspline.evaluate` would."""
    channels = coefficients.shape[2]
    for k in range(y.size):
        i, j = math.floor(y[k]), math.floor(x[k])
        wy, dy = _weights(y[k] - i), _slopes(y[k] - i)
        wx, dx = _weights(x[k] - j), _slopes(x[k] - j)
        out[:, k, :] = 0.0
        for a in range(4):
            for b in range(4):
                node = coefficients[i - 1 + a, j - 1 + b]
                w = wy[a] * wx[b]
                for c in range(channels):
                    out[0, k, c] += w * node[c]
                if out.shape[0] == 3:
                    north, east = dy[a] * wx[b], wy[a] * dx[b]
                    for c in range(channels):
                        out[1, k, c] += north * node[c]
                        out[2, k, c] += east * node[c]


@_compile
def total(
    nodes: Floats,
    scale: Floats,
    hidden: NDArray[np.bool_],
    corner: Floats,
    latitude: Floats,
    longitude: Floats,
    value: Floats,
    gradient: Floats,
) -> int:
    """Total-field anomaly and gradient at one height, of the whole hot loop of a filter.

    Parameters
    ----------
    nodes : (rows, columns, 2) coefficients of the value and of its derivative upward, per km.
    scale : (rows, 2) spline coefficients over latitude of cells per km northward and eastward.
    hidden : (rows, columns) nodes whose neighbourhood answers NaN.
    corner : south, west, latitude spacing, longitude spacing of the patch's lattice.
    latitude, longitude : (n,) degrees.
    value, gradient : (n,) and (n, 3), filled: nT and nT/km; (0, 3) leaves the gradient out.

    Returns
    -------
    The index of the first position that is none, or -1.
    """
    south, west, dlat, dlon = corner[0], corner[1], corner[2], corner[3]
    rows, columns = nodes.shape[0] - 2 * HALO - 1, nodes.shape[1] - 2 * HALO - 1
    for k in range(latitude.size):
        if abs(latitude[k]) > 90.0 or math.isinf(longitude[k]):
            return k
        y = (latitude[k] - south) / dlat
        x = longitude[k] - west
        if x < 0.0 or x >= 360.0:
            x -= 360.0 * math.floor(x / 360.0)
        x = 0.0 if x >= 360.0 - EDGE * dlon else x / dlon
        y = _onto(y, rows)
        x = _onto(x, columns)
        # Written so that NaN fails it.
        covered = y >= 0.0 and y <= rows and x >= 0.0 and x <= columns
        if covered:
            south_row, north_row = int(y + NODE) + HALO, math.ceil(y - NODE) + HALO
            west_column, east_column = int(x + NODE) + HALO, math.ceil(x - NODE) + HALO
            covered = not (
                hidden[south_row, west_column]
                or hidden[south_row, east_column]
                or hidden[north_row, west_column]
                or hidden[north_row, east_column]
            )
        if not covered:
            value[k] = np.nan
            if gradient.shape[0]:
                gradient[k, 0] = gradient[k, 1] = gradient[k, 2] = np.nan
            continue
        i, j = int(y), int(x)
        wy, wx, dx = _weights(y - i), _weights(x - j), _slopes(x - j)
        dy = _slopes(y - i)
        i += HALO - 1
        j += HALO - 1
        level = upward = north = east = cells_north = cells_east = 0.0
        for a in range(4):
            c0, c1, c2, c3 = (
                nodes[i + a, j],
                nodes[i + a, j + 1],
                nodes[i + a, j + 2],
                nodes[i + a, j + 3],
            )
            line = wx[0] * c0[0] + wx[1] * c1[0] + wx[2] * c2[0] + wx[3] * c3[0]
            level += wy[a] * line
            if gradient.shape[0]:
                north += dy[a] * line
                up = wx[0] * c0[1] + wx[1] * c1[1] + wx[2] * c2[1] + wx[3] * c3[1]
                upward += wy[a] * up
                slope = dx[0] * c0[0] + dx[1] * c1[0] + dx[2] * c2[0] + dx[3] * c3[0]
                east += wy[a] * slope
                cells_north += wy[a] * scale[i + a, 0]
                cells_east += wy[a] * scale[i + a, 1]
        value[k] = level
        if gradient.shape[0]:
            gradient[k, 0] = north * cells_north
            gradient[k, 1] = east * cells_east
            gradient[k, 2] = -upward
    return -1


@_compile
def _onto(cells: float, last: int) -> float:
    """Bring a position that rounding carried over the edge back onto it."""
    if -EDGE <= cells < 0.0:
        return 0.0
    if last < cells <= last + EDGE:
        return float(last)
    return cells
