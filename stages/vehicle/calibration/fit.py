"""What a calibration method finds, and the refusal of what the motion does not show."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from magtiles.schemas.errors import CoverageError
from magtiles.stages.vehicle.calibration.samples import magnitudes

Real = NDArray[np.float64]

_LARGEST_ERROR = 0.05
"""Standard error of a matrix entry, or of a bias over F, above which it is not observed."""
_LEAST_NOISE = 1e-4
"""Noise over F that is reckoned with even where the samples show less."""
_FEW = 0.01
"""Share of the samples on which alone no parameter may rest."""
_FLAT = 0.02
"""Thickness of the readings, over F, below which they lie in a plane."""


@dataclass(frozen=True)
class Fit:
    """Found by a method: calibrated = matrix @ (raw - bias).

    Attributes
    ----------
    matrix : (3, 3); bias : (3,), nT.
    parameters : names of what was estimated, such as ``matrix_xy`` and ``bias_x``.
    covariance : of these, (p, p); NaN where the method has none.
    residual_rms : nT, of the samples kept.
    condition : of the least-squares problem, without units; NaN where there is none.
    kept : (n,), the samples that are not outliers.
    assumed : what the motion does not show and the method takes for granted.
    notes : further numbers worth keeping.
    """

    matrix: Real
    bias: Real
    parameters: tuple[str, ...]
    covariance: Real
    residual_rms: float
    condition: float
    kept: NDArray[np.bool_]
    assumed: str
    notes: dict[str, float] = field(default_factory=dict)


def parameter_names(axes: str) -> tuple[str, ...]:
    """``matrix_xx``, ``matrix_xy``, ... by rows, then ``bias_x``, ..."""
    return (*(f"matrix_{i}{j}" for i in axes for j in axes), *(f"bias_{i}" for i in axes))


def check_observed(
    sensitivity: Real, names: Sequence[str], deviation: float, *, raw: Real, core: Real
) -> float:
    """The condition of a least-squares problem whose every parameter is observed.

    Parameters
    ----------
    sensitivity : (n, p), residual over F by parameter, each without units.
    deviation : standard deviation of the noise over F.

    Raises CoverageError naming the parameters whose standard error would exceed 5 % (of one,
    or of F) with the observed noise or 0.01 % of F, whichever is more, when the hundredth
    of the samples that tell most is left out: no calibration rests on a handful of samples.
    """
    orthogonal, triangle = np.linalg.qr(sensitivity)
    leverage = np.sum(orthogonal**2, axis=1)
    few = max(2 * len(names), int(_FEW * len(sensitivity)))
    rest = sensitivity[np.argsort(leverage)[:-few]]
    _, values, rows = np.linalg.svd(np.linalg.qr(rest, mode="r"))
    noise = max(deviation, _LEAST_NOISE)
    errors = np.sqrt(np.sum((noise * rows.T / np.maximum(values, 1e-300)) ** 2, axis=1))
    if (errors > _LARGEST_ERROR).any():
        weak = [
            name if error > 1.0 else f"{name} (to {error:.0%})"
            for name, error in zip(names, errors, strict=True)
            if error > _LARGEST_ERROR
        ]
        raise not_observed(
            ", ".join(weak), "the motion and the noise leave it open", raw=raw, core=core,
            expected=f"each known to {_LARGEST_ERROR:.0%}, a bias to that share of the field",
        )  # fmt: skip
    values = np.linalg.svd(triangle, compute_uv=False)
    return float(values[0] / values[-1])


def check_solid(points: Real, *, raw: Real, core: Real) -> None:
    """Refuse vectors (n, 3), over F, that lie in a plane or nearer: a single-axis rotation."""
    centred = points - points.mean(axis=0)
    far = np.argsort(np.linalg.norm(centred, axis=1))[: -max(9, int(_FEW * len(points)))]
    spread, normal = _spread(points[far])
    if spread[2] >= _FLAT:
        return
    axis = "xyz"[int(np.argmax(np.abs(normal)))]
    if spread[1] < _FLAT:
        raise not_observed(
            "biases, scale factors and distortion",
            "the field hardly moves in the sensor's axes", raw=raw, core=core,
            expected="rotation about two axes at least",
        )  # fmt: skip
    raise not_observed(
        f"bias and scale factor along axis {axis}, and distortion with it",
        "the readings lie in a plane, as in a rotation about a single axis", raw=raw, core=core,
        expected="rotation about two axes at least",
        remedy="for level circles use method = \"modified-ellipsoid\"",
    )  # fmt: skip


def not_observed(
    what: str,
    why: str,
    *,
    raw: Real,
    core: Real,
    expected: str,
    remedy: str = "record a calibration away from steel that turns the sensor further",
) -> CoverageError:
    """The refusal of parameters that the motion does not show, with both magnitudes."""
    return CoverageError(
        f"{what}: not observed, as {why} ({magnitudes(raw, core)})",
        where="field_body", expected=expected, remedy=remedy,
    )  # fmt: skip


def _spread(points: Real) -> tuple[Real, Real]:
    """Standard deviations along the principal axes, largest first, and the last axis."""
    values, vectors = np.linalg.eigh(np.cov(points.T))
    return np.sqrt(np.maximum(values[::-1], 0.0)), vectors[:, 0]
