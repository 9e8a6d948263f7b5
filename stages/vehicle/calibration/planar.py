"""Calibration from level circles: swinging, the strict ellipse, the modified ellipsoid.

Circles on level ground show the sensor's two horizontal axes. Of the vertical one they show a
single number, its mean reading; with the core field's vertical component that is a bias, if
the scale factor is taken for one (Shockley 2012, eq. 2.12).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from magtiles.stages.vehicle.calibration.fit import Fit, check_observed, parameter_names
from magtiles.stages.vehicle.calibration.roots import Distortion
from magtiles.stages.vehicle.calibration.surface import (
    NORMAL_MAD,
    Surface,
    fit_surface,
    matrix_and_covariance,
)

Real = NDArray[np.float64]

_VERTICAL = "vertical scale factor 1, no distortion with the vertical axis"
_TURNED = {
    "symmetric": "the horizontal axes point forward and right on average",
    "triangular": "the x axis points forward",
}


def swinging(raw: Real, core: Real, *, outlier_sigma: float) -> Fit:
    """Biases and scale factors from the extremes of each axis (Shockley 2012, eq. 2.12, 2.13).

    Parameters
    ----------
    raw : (n, 3) readings over whole revolutions, nT.
    core : (3,) core field north, east, down, nT.
    outlier_sigma : robust standard deviations from the fitted ellipse beyond which a sample
        is left out: one spike would be the extreme.

    The bias is the middle of the extremes: eq. 2.10 has it with the opposite sign. The largest
    horizontal reading is that of the whole horizontal field. Extremes grow with the noise and
    with the number of samples, so scale factors come out too small, and have no covariance.
    """
    kept = _ellipse(raw, core, outlier_sigma, refine=False).kept
    low, high = raw[kept].min(axis=0), raw[kept].max(axis=0)
    bias = 0.5 * (high + low)
    bias[2] -= core[2]
    horizontal = float(np.hypot(core[0], core[1]))
    matrix = np.diag([*(horizontal / (high - 0.5 * (high + low))[:2]), 1.0])
    length = np.linalg.norm((raw[kept, :2] - bias[:2]) @ matrix[:2, :2], axis=1)
    names = ("matrix_xx", "matrix_yy", "bias_x", "bias_y", "bias_z")
    return Fit(
        matrix, bias, names, np.full((5, 5), np.nan),
        float(np.sqrt(np.mean((length - horizontal) ** 2))), float("nan"), kept,
        f"no distortion, {_VERTICAL}",
    )  # fmt: skip


def strict_ellipse(
    raw: Real, core: Real, *, outlier_sigma: float, distortion: Distortion = "symmetric"
) -> Fit:
    """The horizontal axes from the algebraic ellipse, k solved for (eq. 2.23-2.28).

    The vertical axis stays as it is read. The covariance is that of the most likely ellipse.
    """
    surface = _ellipse(raw, core, outlier_sigma, refine=False)
    matrix, covariance, condition = _horizontal(surface, distortion, raw, core)
    whole = np.eye(3)
    whole[:2, :2] = matrix
    return Fit(
        whole, np.append(surface.bias, 0.0), parameter_names("xy"), covariance,
        surface.residual_rms, condition, surface.kept,
        f"{_TURNED[distortion]}; the vertical axis is not calibrated",
    )  # fmt: skip


def modified_ellipsoid(
    raw: Real, core: Real, *, outlier_sigma: float, distortion: Distortion = "symmetric"
) -> Fit:
    """The horizontal axes from the most likely ellipse, scaled by alpha; the vertical bias.

    Shockley 2012, eq. 3.1-3.8. Alpha (eq. 3.2) is the ratio of magnitudes, not of their squares:
    only so does the calibrated field keep the horizontal magnitude (eq. 3.7). Eq. 2.13 finds
    a vertical scale factor from the one number that eq. 2.12 explained as a bias already; it
    is 1 once that bias is removed.
    """
    surface = _ellipse(raw, core, outlier_sigma, refine=True)
    matrix, covariance, condition = _horizontal(surface, distortion, raw, core)
    kept = raw[surface.kept]
    length = np.linalg.norm((kept[:, :2] - surface.bias) @ matrix.T, axis=1)
    alpha = float(np.hypot(core[0], core[1]) / length.mean())
    whole = np.eye(3)
    whole[:2, :2] = alpha * matrix
    down, deviation = _mean_reading(kept[:, 2], outlier_sigma)
    with_vertical = np.zeros((7, 7))
    with_vertical[:6, :6] = covariance
    with_vertical[6, 6] = deviation**2
    return Fit(
        whole, np.append(surface.bias, down - core[2]), (*parameter_names("xy"), "bias_z"),
        with_vertical, surface.residual_rms, condition, surface.kept,
        f"{_TURNED[distortion]}; {_VERTICAL}", {"alpha": alpha},
    )  # fmt: skip


def _ellipse(raw: Real, core: Real, outlier_sigma: float, *, refine: bool) -> Surface:
    horizontal = np.full(len(raw), np.hypot(core[0], core[1]))
    return fit_surface(raw[:, :2], horizontal, outlier_sigma=outlier_sigma, refine=refine)


def _horizontal(
    surface: Surface, distortion: Distortion, raw: Real, core: Real
) -> tuple[Real, Real, float]:
    names = ("matrix_xx", "matrix_yx", "matrix_yy", "bias_x", "bias_y")
    condition = check_observed(surface.sensitivity, names, surface.deviation(), raw=raw, core=core)
    return *matrix_and_covariance(surface, distortion), condition


def _mean_reading(values: Real, outlier_sigma: float) -> tuple[float, float]:
    """Mean of readings (n,) without outliers, and its standard error, nT."""
    offset = values - np.median(values)
    limit = outlier_sigma * NORMAL_MAD * np.median(np.abs(offset))
    kept = values[np.abs(offset) <= limit]
    return float(kept.mean()), float(kept.std() / np.sqrt(len(kept)))
