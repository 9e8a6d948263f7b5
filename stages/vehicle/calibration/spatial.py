"""Calibration of all three axes: the ellipsoid, and the 12 parameters with known attitude."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from magtiles.schemas.errors import CoverageError
from magtiles.stages.vehicle.calibration.fit import (
    Fit,
    check_observed,
    check_solid,
    parameter_names,
)
from magtiles.stages.vehicle.calibration.roots import Distortion
from magtiles.stages.vehicle.calibration.surface import (
    NORMAL_MAD,
    fit_surface,
    matrix_and_covariance,
)

if TYPE_CHECKING:
    from scipy.spatial.transform import Rotation

Real = NDArray[np.float64]

_ROUNDING = 1e-9
_ROUNDS = 30
_FEWEST = 50
_STARTERS = 3000
"""Samples, evenly thinned, for a first estimate."""


def ellipsoid(
    raw: Real, core: Real, *, outlier_sigma: float, distortion: Distortion = "symmetric"
) -> Fit:
    """Nine parameters from the ellipsoid of the readings (Shockley 2012, eq. 2.15-2.22).

    Parameters
    ----------
    raw : (n, 3) readings, nT.
    core : (n, 3) core field at each, nT: its magnitude sets the scale.

    How the sensor sits in the body is not observed by magnitudes: `distortion` says which
    axes are taken for true. Raises CoverageError for rotation about a single axis, and naming
    what else the motion does not observe.
    """
    total = np.linalg.norm(core, axis=1)
    check_solid(raw / total.mean(), raw=raw, core=core)
    surface = fit_surface(raw, total, outlier_sigma=outlier_sigma)
    check_solid(raw[surface.kept] / total.mean(), raw=raw, core=core)
    lower = [f"matrix_{'xyz'[i]}{'xyz'[j]}" for i in range(3) for j in range(i + 1)]
    condition = check_observed(
        surface.sensitivity, [*lower, "bias_x", "bias_y", "bias_z"], surface.deviation(),
        raw=raw, core=core,
    )  # fmt: skip
    matrix, covariance = matrix_and_covariance(surface, distortion)
    turned = {
        "symmetric": "the sensor's axes are those of the body on average",
        "triangular": "x points forward and y lies in the body's forward-right plane",
    }
    return Fit(
        matrix, surface.bias, parameter_names("xyz"), covariance, surface.residual_rms,
        condition, surface.kept, turned[distortion],
    )  # fmt: skip


def from_attitude(raw: Real, core: Real, attitude: Real, *, outlier_sigma: float) -> Fit:
    """Twelve parameters, where the field in body axes is known: raw = C field + b (eq. 2.14).

    Parameters
    ----------
    raw : (n, 3) readings, nT.
    core : (n, 3) core field, north, east, down, nT.
    attitude : (n, 4) quaternion w, x, y, z, body to north, east, down; NaN where unknown.

    Linear least squares for C and b, most likely where noise is the same in all axes; then
    matrix = C^-1, with the sensor's misalignment in it. Samples whose residual is longer than
    `outlier_sigma` times the robust standard deviation of one axis, and sqrt(3), are left out.

    Raises CoverageError without attitude, or naming what the motion does not observe.
    """
    known = np.isfinite(attitude).all(axis=1)
    if known.sum() < _FEWEST:
        raise CoverageError(
            f"{int(known.sum())} of {len(raw)} samples have an attitude",
            where="attitude",
            expected=f"at least {_FEWEST}: quaternions w, x, y, z from body to north, east, down",
            remedy='ingest the log\'s attitude, or use method = "ellipsoid"',
        )
    unit = float(np.linalg.norm(core, axis=1).mean())
    field = body_core(core[known], attitude[known]) / unit
    check_solid(field, raw=raw, core=core)
    design = np.column_stack([field, np.ones(len(field))])
    kept, solution, residual = _trimmed(design, raw[known] / unit, outlier_sigma)
    deviation = float(np.sqrt(np.sum(residual[kept] ** 2) / (3.0 * (kept.sum() - 4))))
    condition = check_observed(
        design[kept], [*(f"the column of C for {a}" for a in ("forward", "right", "down")), "bias"],
        deviation, raw=raw, core=core,
    )  # fmt: skip
    matrix = np.asarray(np.linalg.inv(solution[:3].T), np.float64)
    every: NDArray[np.bool_] = np.array(known)
    every[known] = kept
    return Fit(
        matrix, unit * solution[3], parameter_names("xyz"),
        _mapped(design[kept], matrix, deviation, unit),
        unit * float(np.sqrt(np.mean(residual[kept] ** 2))), condition, every,
        "the attitude is exact",
    )  # fmt: skip


def body_core(core: Real, attitude: Real) -> Real:
    """The core field (n, 3) in body axes."""
    return np.asarray(_rotation(attitude).inv().apply(core))


def to_ned(body: Real, attitude: Real) -> Real:
    """Vectors (n, 3) of body axes in north, east, down."""
    return np.asarray(_rotation(attitude).apply(body))


def _rotation(attitude: Real) -> Rotation:
    from scipy.spatial.transform import Rotation

    return Rotation.from_quat(attitude, scalar_first=True)


def _trimmed(design: Real, raw: Real, outlier_sigma: float) -> tuple[NDArray[np.bool_], Real, Real]:
    """Samples kept, solution (4, 3) and residuals (n, 3) of design @ solution = raw."""
    solution = _robust_start(design, raw)
    kept = np.zeros(len(raw), dtype=np.bool_)
    for _ in range(_ROUNDS):
        residual = raw - design @ solution
        sigma = max(NORMAL_MAD * float(np.median(np.abs(residual))), _ROUNDING)
        near = np.linalg.norm(residual, axis=1) <= outlier_sigma * np.sqrt(3.0) * sigma
        if np.array_equal(near, kept):
            break
        kept = near
        solution = np.linalg.lstsq(design[kept], raw[kept], rcond=None)[0]
    return kept, solution, residual


def _robust_start(design: Real, raw: Real) -> Real:
    from scipy.optimize import least_squares

    thinned = slice(None, None, -(-len(raw) // _STARTERS))
    design, raw = design[thinned], raw[thinned]
    start = np.linalg.lstsq(design, raw, rcond=None)[0]
    scale = max(NORMAL_MAD * float(np.median(np.abs(raw - design @ start))), _ROUNDING)
    slopes = np.kron(design, np.eye(3))

    def residual(flat: Real) -> Real:
        return np.asarray((design @ flat.reshape(4, 3) - raw).ravel())

    # A loss that forgets far samples: outliers then hardly bend the first estimate.
    found = least_squares(residual, start.ravel(), lambda _: slopes, loss="cauchy", f_scale=scale)
    return np.asarray(found.x.reshape(4, 3))


def _mapped(design: Real, matrix: Real, deviation: float, unit: float) -> Real:
    """Covariance (12, 12) of the entries of A = C^-1 by rows, then of b: dA = -A dC A."""
    base = deviation**2 * np.linalg.inv(design.T @ design)
    # Each row of C, with its bias, is a regression of its own.
    slope = np.zeros((12, 12))
    for sensor in range(3):
        for body in range(3):
            change = -np.outer(matrix[:, sensor], matrix[body])
            slope[:9, 4 * sensor + body] = change.ravel()
        slope[9 + sensor, 4 * sensor + 3] = unit
    return np.asarray(slope @ np.kron(np.eye(3), base) @ slope.T)
