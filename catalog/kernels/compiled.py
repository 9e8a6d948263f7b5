"""The spline kernels of a patch, compiled by numba: import this only when a patch is made."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from magtiles.catalog.kernels.bspline import EDGE, HALO, NODE, Floats
from magtiles.catalog.kernels.jit import compiled as _compile

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
def _dot(w: Any, a: float, b: float, c: float, d: float) -> float:
    return float(w[0] * a + w[1] * b + w[2] * c + w[3] * d)


@_compile
def _along(nodes: Floats, i: int, j: int, channel: int, w: Any) -> float:
    """Four neighbours in a row, weighted."""
    return _dot(
        w,
        nodes[i, j, channel],
        nodes[i, j + 1, channel],
        nodes[i, j + 2, channel],
        nodes[i, j + 3, channel],
    )


@_compile
def _is_hidden(hidden: NDArray[np.bool_], y: float, x: float) -> bool:
    """Whether a node that contributes at a position is hidden."""
    south, north = int(y + NODE), math.ceil(y - NODE)
    west, east = int(x + NODE), math.ceil(x - NODE)
    return bool(
        hidden[south, west] or hidden[south, east] or hidden[north, west] or hidden[north, east]
    )


@_compile
def total(
    nodes: Floats,
    scale: Floats,
    hidden: NDArray[np.bool_],
    hidden_cells: NDArray[np.bool_],
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
    hidden : nodes beyond coverage, from the corner on without halo, and one row and column
        more; next to them the answer is NaN.
    hidden_cells : cells that have a hidden node, likewise.
    corner : south, west, latitude spacing, longitude spacing of the patch's lattice.
    latitude, longitude : (n,) degrees.
    value, gradient : (n,) and (n, 3), filled: nT and nT/km; (0, 3) leaves the gradient out.

    Returns
    -------
    The index of the first position that is none, or -1.
    """
    south, west, dlat, dlon = corner[0], corner[1], corner[2], corner[3]
    rows, columns = float(hidden.shape[0] - 2), float(hidden.shape[1] - 2)
    slopes = gradient.shape[0] > 0
    for k in range(latitude.size):
        if abs(latitude[k]) > 90.0 or math.isinf(longitude[k]):
            return k
        y = (latitude[k] - south) / dlat
        x = longitude[k] - west
        if x < 0.0 or x >= 360.0:
            x -= 360.0 * math.floor(x / 360.0)
        x = 0.0 if x >= 360.0 - EDGE * dlon else x / dlon
        on_y, on_x = min(max(y, 0.0), rows), min(max(x, 0.0), columns)
        # Written so that NaN is not covered.
        covered = abs(y - on_y) <= EDGE and abs(x - on_x) <= EDGE
        if covered:
            i, j = int(on_y), int(on_x)
            covered = not (hidden_cells[i, j] and _is_hidden(hidden, on_y, on_x))
        if not covered:
            value[k] = np.nan
            if slopes:
                gradient[k, 0] = gradient[k, 1] = gradient[k, 2] = np.nan
            continue
        wy, dy = _weights(on_y - i), _slopes(on_y - i)
        wx, dx = _weights(on_x - j), _slopes(on_x - j)
        i += HALO - 1
        j += HALO - 1
        v0, v1 = _along(nodes, i, j, 0, wx), _along(nodes, i + 1, j, 0, wx)
        v2, v3 = _along(nodes, i + 2, j, 0, wx), _along(nodes, i + 3, j, 0, wx)
        value[k] = _dot(wy, v0, v1, v2, v3)
        if not slopes:
            continue
        e0, e1 = _along(nodes, i, j, 0, dx), _along(nodes, i + 1, j, 0, dx)
        e2, e3 = _along(nodes, i + 2, j, 0, dx), _along(nodes, i + 3, j, 0, dx)
        u0, u1 = _along(nodes, i, j, 1, wx), _along(nodes, i + 1, j, 1, wx)
        u2, u3 = _along(nodes, i + 2, j, 1, wx), _along(nodes, i + 3, j, 1, wx)
        north = _dot(wy, scale[i, 0], scale[i + 1, 0], scale[i + 2, 0], scale[i + 3, 0])
        east = _dot(wy, scale[i, 1], scale[i + 1, 1], scale[i + 2, 1], scale[i + 3, 1])
        gradient[k, 0] = _dot(dy, v0, v1, v2, v3) * north
        gradient[k, 1] = _dot(wy, e0, e1, e2, e3) * east
        gradient[k, 2] = -_dot(wy, u0, u1, u2, u3)
    return -1
