"""From grid axes to true north, east and down."""

from __future__ import annotations

import numpy as np
from numba import njit, prange
from numpy.typing import NDArray

Real = NDArray[np.float64]
Single = NDArray[np.float32]


@njit(parallel=True, cache=True, nogil=True)
def rotate_to_ned(products: Single, north: Single, ambient: Single, mean_direction: Real) -> None:
    """Turn products (9, m, n), in place, from axes y, x, d to north, east, down.

    In: the total along `mean_direction` f0 (y, x, d), the vector y, x, d, and the tensor
    yy, yx, yd, xx, xd. Out: the total along the ambient direction f of each node,
    f0.B + (f - f0).B; north, east, down; nn, ne, nd, ee, ed.
    `north` (2, m, n): (a, b), the unit vector of true north along y and x, so that
    n = a y + b x and e = a x - b y. `ambient` (3, m, n): f in north, east, down.
    """
    for i in prange(products.shape[1]):
        for j in range(products.shape[2]):
            a, b = float(north[0, i, j]), float(north[1, i, j])
            y, x = float(products[1, i, j]), float(products[2, i, j])
            fn, fe = float(ambient[0, i, j]), float(ambient[1, i, j])
            products[0, i, j] += (
                (a * fn - b * fe - mean_direction[0]) * y
                + (b * fn + a * fe - mean_direction[1]) * x
                + (ambient[2, i, j] - mean_direction[2]) * products[3, i, j]
            )
            products[1, i, j], products[2, i, j] = a * y + b * x, a * x - b * y
            yy, yx = float(products[4, i, j]), float(products[5, i, j])
            yd, xx = float(products[6, i, j]), float(products[7, i, j])
            xd = float(products[8, i, j])
            products[4, i, j] = a * a * yy + 2.0 * a * b * yx + b * b * xx
            products[5, i, j] = a * b * (xx - yy) + (a * a - b * b) * yx
            products[6, i, j] = a * yd + b * xd
            products[7, i, j] = b * b * yy - 2.0 * a * b * yx + a * a * xx
            products[8, i, j] = a * xd - b * yd
