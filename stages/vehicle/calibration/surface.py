"""The ellipse or ellipsoid on which the raw readings of a field of constant magnitude lie.

A reading x of a sensor with correction A and bias b has |A (x - b)| = F (Shockley 2012,
eq. 2.15). The first estimate is algebraic (eq. 2.16-2.21 and 2.23-2.27, with the constant k
solved for); the last is the most likely one where the noise is the same in all axes.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from magtiles.stages.vehicle.calibration.algebraic import quadric, robust_start
from magtiles.stages.vehicle.calibration.roots import Distortion, root, root_change

Real = NDArray[np.float64]
Mask = NDArray[np.bool_]

NORMAL_MAD = 1.4826
"""Standard deviation of a normal distribution over its median absolute deviation."""
_ROUNDING = 1e-9
"""Share of the field below which a residual is rounding, not noise."""
_CONVERGED = {"xtol": 1e-14, "ftol": 1e-14, "gtol": 1e-14}
_ROUNDS = 30


@dataclass(frozen=True)
class Surface:
    """A fitted surface: |matrix @ (x - bias)| = F.

    Attributes
    ----------
    matrix : (d, d), lower triangular; the surface tells it up to a rotation.
    bias : (d,), nT.
    kept : (n,), samples that are not outliers.
    distance : (n,) of each sample from the surface, nT, to first order.
    sensitivity : (kept, p) change of distance over F with each parameter: the lower triangle
        of `matrix` by rows, then `bias` over F. Without units.
    magnitude : the mean F of the samples kept, nT.
    """

    matrix: Real
    bias: Real
    kept: Mask
    distance: Real
    sensitivity: Real
    magnitude: float

    @property
    def residual_rms(self) -> float:
        """Root mean square distance of the samples kept, nT."""
        return float(np.sqrt(np.mean(self.distance[self.kept] ** 2)))

    def deviation(self) -> float:
        """Standard deviation of the noise in one axis, as a share of F."""
        rows, columns = self.sensitivity.shape
        return self.residual_rms / self.magnitude * float(np.sqrt(rows / (rows - columns)))


def fit_surface(
    points: Real, magnitude: Real, *, outlier_sigma: float, refine: bool = True
) -> Surface:
    """Fit the ellipse (d = 2) or ellipsoid (d = 3) of readings (n, d), nT.

    Parameters
    ----------
    magnitude : (n,) true field magnitude at each sample, nT.
    outlier_sigma : samples farther from the surface than this many robust standard
        deviations (1.4826 times the median absolute distance) are left out, and the fit
        repeated until the same samples are kept.
    refine : go on from the algebraic to the most likely estimate: the least squares of the
        distances from the surface (to first order: Sampson's).

    Readings that define no surface get one all the same: ask `check_observed`.
    """
    unit = float(np.mean(magnitude))
    centre = np.median(points, axis=0)
    x, target = (points - centre) / unit, magnitude / unit
    matrix, bias = robust_start(x)
    kept = _near(matrix, bias, x, target, outlier_sigma)
    for _ in range(_ROUNDS):
        matrix, bias = (
            _refined(matrix, bias, x[kept], target[kept])
            if refine
            else quadric(x[kept]) or (matrix, bias)
        )
        previous, kept = kept, _near(matrix, bias, x, target, outlier_sigma)
        if np.array_equal(previous, kept):
            break
    distance = _distance(matrix, bias, x, target)
    return Surface(
        matrix, centre + unit * bias, kept, unit * distance,
        _sensitivity(matrix, bias, x[kept]), unit,
    )  # fmt: skip


def matrix_and_covariance(surface: Surface, distortion: Distortion) -> tuple[Real, Real]:
    """The correction matrix by convention, and the covariance of its entries and the bias.

    Returns matrix (d, d) and covariance (d * d + d, d * d + d): the entries of the matrix by
    rows (no unit), then the bias (nT). The sensitivity must have full rank.
    """
    d = len(surface.bias)
    _, values, rows = np.linalg.svd(np.linalg.qr(surface.sensitivity, mode="r"))
    factor = (
        surface.deviation() * rows.T / values
    )  # covariance of the parameters: factor @ factor.T
    directions = np.zeros((factor.shape[1], d, d))
    directions[:, *np.tril_indices(d)] = factor[:-d].T
    product = surface.matrix.T @ directions
    form = surface.matrix.T @ surface.matrix
    matrix = root(form, distortion)
    changes = root_change(matrix, product + product.transpose(0, 2, 1), distortion)
    mapped = np.vstack([changes.reshape(-1, d * d).T, surface.magnitude * factor[-d:]])
    return matrix, mapped @ mapped.T


def _near(matrix: Real, bias: Real, x: Real, target: Real, outlier_sigma: float) -> Mask:
    distance = np.abs(_distance(matrix, bias, x, target))
    sigma = max(NORMAL_MAD * float(np.median(distance)), _ROUNDING)
    return np.asarray(distance <= outlier_sigma * sigma)


def _refined(matrix: Real, bias: Real, x: Real, target: Real) -> tuple[Real, Real]:
    """The surface with the least squares of distances from x (n, d)."""
    from scipy.optimize import least_squares

    d = x.shape[1]
    lower = np.tril_indices(d)

    def unpack(parameters: Real) -> tuple[Real, Real]:
        full = np.zeros((d, d))
        full[lower] = parameters[:-d]
        return full, parameters[-d:]

    found = least_squares(
        lambda parameters: _distance(*unpack(parameters), x, target),
        np.concatenate([matrix[lower], bias]),
        jac=lambda parameters: _slopes(*unpack(parameters), x, target),
        method="lm",
        **_CONVERGED,
    )
    return unpack(found.x)


def _distance(matrix: Real, bias: Real, x: Real, target: Real) -> Real:
    """Distances (n,) from the surface to first order: (m - F) / |grad m|, m = |A (x - b)|."""
    calibrated = (x - bias) @ matrix.T
    length = np.linalg.norm(calibrated, axis=1)
    return np.asarray((length - target) * length / np.linalg.norm(calibrated @ matrix, axis=1))


def _slopes(matrix: Real, bias: Real, x: Real, target: Real) -> Real:
    """Derivatives (n, p) of the distances by the lower triangle of A and b.

    With y = A (x - b), m = |y|, v = A^T y the distance is r = m (m - F) / |v|, and
    dr = ((2 m - F) dm - r d|v|) / |v|.
    """
    rows, columns = np.tril_indices(x.shape[1])
    offset = x - bias
    y = offset @ matrix.T
    v = y @ matrix
    m, length = np.linalg.norm(y, axis=1), np.linalg.norm(v, axis=1)
    u, e = y / m[:, None], v / length[:, None]
    turned = e @ matrix.T
    dm = np.column_stack([u[:, rows] * offset[:, columns], -u @ matrix])
    dv = np.column_stack(
        [e[:, columns] * y[:, rows] + turned[:, rows] * offset[:, columns], -turned @ matrix]
    )
    r = (m - target) * m / length
    return np.asarray(((2.0 * m - target)[:, None] * dm - r[:, None] * dv) / length[:, None])


def _sensitivity(matrix: Real, bias: Real, x: Real) -> Real:
    """The slopes (n, p) where every sample lies on the surface: what the noise does not bend."""
    on_surface = np.linalg.norm((x - bias) @ matrix.T, axis=1)
    return _slopes(matrix, bias, x, on_surface)
