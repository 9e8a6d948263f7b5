"""Square roots A of a form Q = A^T A, and how they change with it.

The field's magnitude tells Q only: any rotation of A fits as well. A convention chooses one.
"""

from __future__ import annotations

from typing import Literal

import numpy as np
from numpy.typing import NDArray

Real = NDArray[np.float64]

Distortion = Literal["symmetric", "triangular"]
"""`symmetric`: the axes, on average, point where they should (Shockley 2012, after eq. 2.21).
`triangular`: x points exactly where it should, and y lies in the true x-y plane."""


def root(form: Real, distortion: Distortion) -> Real:
    """The root A (..., d, d) of positive definite forms Q = A^T A (..., d, d), diagonal > 0."""
    if distortion == "symmetric":
        values, vectors = np.linalg.eigh(form)
        return np.asarray((vectors * np.sqrt(values)[..., None, :]) @ vectors.swapaxes(-1, -2))
    # Cholesky of the form with its axes reversed: lower triangular A with A^T A, not A A^T.
    factor = np.linalg.cholesky(form[..., ::-1, ::-1])
    return np.asarray(factor.swapaxes(-1, -2)[..., ::-1, ::-1])


def root_change(matrix: Real, form_changes: Real, distortion: Distortion) -> Real:
    """Changes dA (..., d, d) of a root for small changes dQ (..., d, d): A^T dA + dA^T A = dQ."""
    if distortion == "symmetric":
        values, vectors = np.linalg.eigh(matrix)
        turned = vectors.T @ form_changes @ vectors
        return np.asarray(vectors @ (turned / (values[:, None] + values)) @ vectors.T)
    inverse = np.linalg.inv(matrix)
    # dA A^-1 is lower triangular, and its symmetric part is half of A^-T dQ A^-1.
    symmetric = inverse.T @ form_changes @ inverse
    lower = np.tril(symmetric, -1) + 0.5 * symmetric * np.eye(len(matrix))
    return np.asarray(lower @ matrix)
