"""A first estimate of an ellipse or ellipsoid by linear algebra, which outliers do not bend."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from magtiles.stages.vehicle.calibration.roots import root

Real = NDArray[np.float64]

_DRAWS = {2: 50, 3: 150}
"""Draws of as few points as define an ellipse or ellipsoid. With three readings in ten wrong,
one draw in 6 (5 points) or 25 (9 points) is clean, and six clean ones or more are expected."""
_JUDGES = 200
"""Readings, evenly thinned, by which the draws are judged."""


def quadric(x: Real) -> tuple[Real, Real] | None:
    """Correction A (d, d) and bias (d,) of the quadric |A (x - b)| = 1 through x (n, d).

    About a point inside the quadric x^T Q x - 2 p^T x = 1 has a solution whatever the bias;
    with b = Q^-1 p the true form is Q / (1 + b^T Q b). That is to solve for the k of Shockley
    2012, eq. 2.16, which his eq. 2.19 takes for zero. None where it is no ellipse or ellipsoid.
    """
    design = _design(x)
    solution = np.asarray(np.linalg.lstsq(design, np.ones(len(x)), rcond=None)[0], np.float64)
    forms, ends = _unpack(solution[None], x.shape[1])
    found = _corrections(forms, ends)
    return (found[0][0], found[1][0]) if len(found[0]) else None


def robust_start(x: Real) -> tuple[Real, Real]:
    """The quadric of all points or of one of many small draws: the one nearest to most points.

    Nearest is by the median distance, so that wrong readings do not count while they are fewer
    than half. Where no draw is an ellipsoid, the sphere of all points.
    """
    d = x.shape[1]
    rng = np.random.default_rng(0)  # the same readings give the same calibration
    least = d * (d + 3) // 2
    draws = rng.integers(0, len(x), (_DRAWS[d], least))
    design = _design(x)
    usable = np.abs(np.linalg.det(design[draws])) > 1e-12
    solutions = np.linalg.solve(design[draws[usable]], np.ones((usable.sum(), least, 1)))
    everything = np.linalg.lstsq(design, np.ones(len(x)), rcond=None)[0]
    matrices, biases = _corrections(*_unpack(np.vstack([everything, solutions[..., 0]]), d))
    if not len(matrices):
        return _sphere(x)
    judges = x[:: -(-len(x) // _JUDGES)]
    calibrated = (judges - biases[:, None]) @ matrices.swapaxes(1, 2)
    length = np.linalg.norm(calibrated, axis=-1)
    slope = np.linalg.norm(calibrated @ matrices, axis=-1) / length
    best = int(np.argmin(np.median(np.abs(length - 1.0) / slope, axis=1)))
    return matrices[best], biases[best]


def _design(x: Real) -> Real:
    """Rows of eq. 2.19 and 2.25: squares and products of the axes, then -2 x."""
    rows, columns = np.triu_indices(x.shape[1])
    products = x[:, rows] * x[:, columns] * np.where(rows == columns, 1.0, 2.0)
    return np.column_stack([products, -2.0 * x])


def _unpack(solutions: Real, d: int) -> tuple[Real, Real]:
    rows, columns = np.triu_indices(d)
    forms = np.empty((len(solutions), d, d))
    forms[:, rows, columns] = forms[:, columns, rows] = solutions[:, : len(rows)]
    return forms, solutions[:, len(rows) :]


def _corrections(forms: Real, ends: Real) -> tuple[Real, Real]:
    """Corrections and biases of those forms that are ellipsoids."""
    definite = np.linalg.eigvalsh(forms)[:, 0] > 0.0
    forms, ends = forms[definite], ends[definite]
    biases = np.asarray(np.linalg.solve(forms, ends[..., None])[..., 0], np.float64)
    scale = 1.0 + np.einsum("ki,ki->k", biases, ends)
    return root(forms / scale[:, None, None], "triangular"), biases


def _sphere(x: Real) -> tuple[Real, Real]:
    design = np.column_stack([2.0 * x, np.ones(len(x))])
    *centre, _ = np.linalg.lstsq(design, np.sum(x**2, axis=1), rcond=None)[0]
    bias = np.array(centre)
    return np.eye(x.shape[1]) / np.sqrt(np.mean(np.sum((x - bias) ** 2, axis=1))), bias
