"""The power of a field by degree."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]


def power_spectrum(gauss: Floats) -> Floats:
    """Mean square of the field over the reference sphere, nT^2, of the degrees 1 and up.

    Lowes (1966, J. Geophys. Res. 71:2179) and Mauersberger: R_n = (n + 1) sum_m (g_nm^2 + h_nm^2)
    of Schmidt semi-normalised Gauss coefficients (k,), nT. At another radius r it is R_n
    (a/r)^(2n + 4).
    """
    n_max = math.isqrt(len(gauss) + 1) - 1
    n = np.arange(1, n_max + 1)
    sums: Floats = np.add.reduceat(np.square(gauss), n * n - 1)
    return np.asarray((n + 1) * sums)
