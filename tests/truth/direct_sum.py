"""The field of Gauss coefficients by direct summation, and the total anomaly: truth for model maps.

Legendre functions are SciPy's, positions pyproj's: nothing is shared with what is tested.
"""

from __future__ import annotations

import math

import numpy as np
import pyproj
from numpy.typing import ArrayLike, NDArray
from scipy.special import gammaln, lpmv

Floats = NDArray[np.float64]

RADIUS_KM = 6371.2
_TO_ECEF = pyproj.Transformer.from_crs("EPSG:4979", "EPSG:4978", always_xy=True)


def direct_field(
    gauss: Floats, latitude: ArrayLike, longitude: ArrayLike, height: ArrayLike
) -> Floats:
    """North, east, down, nT (n, 3), at geodetic places (n,); no place at a pole, degree < 100."""
    places = np.broadcast_arrays(*np.atleast_1d(latitude, longitude, height))
    return np.array([_at(gauss, *map(float, place)) for place in zip(*places, strict=True)])


def _at(gauss: Floats, latitude: float, longitude: float, height: float) -> Floats:
    x, y, z = _TO_ECEF.transform(longitude, latitude, height)
    r, rho = math.hypot(x, y, z), math.hypot(x, y)
    t, u, lam = z / r, rho / r, math.radians(longitude)
    n, m, g, h = _orders(gauss)
    # SciPy's P has the phase (-1)^m, which Schmidt's has not.
    norm = (-1.0) ** m * np.sqrt(
        np.where(m == 0, 1.0, 2.0) * np.exp(gammaln(n - m + 1) - gammaln(n + m + 1))
    )
    value = lpmv(m, n, t)
    below = np.where(n > m, lpmv(m, n - 1, t), 0.0)
    slope = (n * t * value - (n + m) * below) / u  # dP/d(colatitude)
    q = norm * (RADIUS_KM * 1000.0 / r) ** (n + 2)
    along = g * np.cos(m * lam) + h * np.sin(m * lam)
    across = g * np.sin(m * lam) - h * np.cos(m * lam)
    north, east, down = (
        float(np.sum(q * slope * along)),
        float(np.sum(q * m * value / u * across)),
        -float(np.sum(q * (n + 1) * value * along)),
    )
    tilt = math.radians(latitude) - math.atan2(z, rho)  # from geocentric to geodetic axes
    return np.array(
        [
            north * math.cos(tilt) + down * math.sin(tilt),
            east,
            down * math.cos(tilt) - north * math.sin(tilt),
        ]
    )


def _orders(gauss: Floats) -> tuple[Floats, Floats, Floats, Floats]:
    """Degree, order, g and h of every pair."""
    rows = []
    for n in range(1, math.isqrt(len(gauss) + 1)):
        row = gauss[n * n - 1 : n * n + 2 * n]
        rows.append((n, 0, row[0], 0.0))
        rows += [(n, m, row[2 * m - 1], row[2 * m]) for m in range(1, n + 1)]
    n, m, g, h = np.array(rows).T
    return n, m, g, h


def split_gauss(gauss: Floats, core_degree: int) -> tuple[Floats, Floats]:
    """Coefficients up to a degree, and those above."""
    core = np.where(np.arange(len(gauss)) < core_degree * (core_degree + 2), gauss, 0.0)
    return core, gauss - core


def total_anomaly(core: Floats, crust: Floats) -> Floats:
    """|core + crust| - |core| of vectors (n, 3)."""
    return np.linalg.norm(core + crust, axis=-1) - np.linalg.norm(core, axis=-1)
