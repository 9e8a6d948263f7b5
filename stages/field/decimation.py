"""Cubic B-splines on a periodic axis as sparse matrices: to sample a field, and to thin it.

Thinned by B-spline weights, wavelengths that the thin samples cannot carry are suppressed by
the fourth power of a sinc, which is also known for those they can, and divided out.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from magtiles.stages.field.windows import Reflection

Real = NDArray[np.float64]


def spline_matrix(places: Real, count: int) -> sparse.csr_array:
    """From `count` periodic B-spline coefficients to values at fractional places (its rows)."""
    first = np.floor(places).astype(np.int64)
    t = places - first
    s = 1.0 - t
    weights = np.stack(
        [
            s**3 / 6.0,
            (4.0 - 6.0 * t**2 + 3.0 * t**3) / 6.0,
            (4.0 - 6.0 * s**2 + 3.0 * s**3) / 6.0,
            t**3 / 6.0,
        ],
        axis=1,
    )
    columns = (first[:, None] + np.arange(-1, 3)) % count
    starts = 4 * np.arange(places.size + 1)
    return sparse.csr_array((weights.ravel(), columns.ravel(), starts), shape=(places.size, count))


def thinning_matrix(axis: Reflection, count: int) -> sparse.csr_array:
    """From a map's nodes to `count` periodic samples of the map extended by an axis's padding.

    Shape (count, nodes of the map). The first sample lies on the first node of the padding.
    """
    size = axis.before + axis.count + axis.after
    nodes, weights = axis.at((-axis.before, size - axis.before))
    ratio = size / count
    spread = spline_matrix(np.arange(size) / ratio, count).T / ratio
    pick = sparse.csr_array((weights, (np.arange(size), nodes)), shape=(size, axis.count))
    return sparse.csr_array(spread @ pick)


def passed(k: Real, spacing: float) -> Real:
    """What B-spline weights `spacing` (m) wide leave of wavenumbers k (rad/m)."""
    return np.asarray(np.sinc(k * spacing / (2.0 * np.pi)) ** 4)
