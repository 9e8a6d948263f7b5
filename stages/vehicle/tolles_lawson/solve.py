"""Least squares by singular values: what motion observes, and what it leaves open.

Normal equations would square the condition number; the singular value decomposition of the columns
does not.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Regularisation:
    """How directions are treated that the motion hardly or never excites.

    Attributes
    ----------
    least_excitation : a direction of unit size (in scaled coefficients) that moves the signal by
        less than this (rms, nT) is unobserved: it is left at zero.
    ridge : damps directions of less than this excitation, s^2 / (s^2 + ridge^2); 0 for none.
    """

    least_excitation: float
    ridge: float


@dataclass(frozen=True)
class Solution:
    """A fit of p coefficients to n samples.

    Attributes
    ----------
    coefficient, covariance : (p,), (p, p). The covariance is zero along null and unobserved
        directions, where nothing was estimated.
    residual : (n,) nT.
    condition : of the observed directions, in scaled coefficients.
    unobserved : (k, p) unit directions in scaled coefficients, beyond the stated null directions.
    """

    coefficient: Floats
    covariance: Floats
    residual: Floats
    condition: float
    unobserved: Floats


def solve(
    columns: Floats,
    response: Floats,
    scale: Floats,
    null: Floats,
    regularisation: Regularisation,
    noise_gain: float,
) -> Solution:
    """Fit `columns` (n, p) @ coefficient to `response` (n,), nT.

    Parameters
    ----------
    scale : (p,) size of a column per unit of its coefficient; singular values are of
        columns / scale.
    null : (k, p) directions known to be undetermined; the answer has no part along them.
    noise_gain : share of white noise that a filter left in the response. Columns lie in the
        filter's band, so that noise of variance v before it gives coefficients the covariance
        v (A^T A)^-1, while the residual's variance is v times the gain.
    """
    free = _complement(null * scale)
    u, s, vt = np.linalg.svd((columns / scale) @ free, full_matrices=False)
    directions = free @ vt.T
    excitation = s / np.sqrt(len(columns))
    seen = excitation >= regularisation.least_excitation
    damped = excitation**2 + regularisation.ridge**2
    inverse = np.where(seen, excitation / np.where(seen, damped, 1.0), 0.0) / np.sqrt(len(columns))
    scaled = directions @ (inverse * (u.T @ response))
    residual = response - (columns / scale) @ scaled
    left = max(len(columns) * noise_gain - np.count_nonzero(seen), 1.0)
    variance = float(residual @ residual) / left
    spread = directions * inverse / scale[:, None]
    return Solution(
        scaled / scale,
        variance * spread @ spread.T,
        residual,
        float(s[0] / s[seen][-1]) if seen.any() else np.inf,
        directions[:, ~seen].T,
    )


def _complement(directions: Floats) -> Floats:
    """Orthonormal basis (p, p - k) of what is orthogonal to k directions (k, p)."""
    basis = np.linalg.qr(directions.T, mode="complete")[0]
    return np.asarray(basis[:, len(directions) :])
