"""Stage ``calibrate-vector``: from a track of a vector magnetometer to its calibration."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from magtiles.schemas.errors import ContractError, CoverageError
from magtiles.stages.declare import OPTIONAL_FILE, Params, Stage, quantity
from magtiles.stages.vehicle.calibration.fit import Fit, not_observed
from magtiles.stages.vehicle.calibration.motion import find_circles, revolutions_of, tangent_angle
from magtiles.stages.vehicle.calibration.planar import (
    modified_ellipsoid,
    strict_ellipse,
    swinging,
)
from magtiles.stages.vehicle.calibration.samples import (
    AXES,
    Samples,
    UtcTime,
    magnitudes,
    select_samples,
)
from magtiles.stages.vehicle.calibration.spatial import ellipsoid, from_attitude

Real = NDArray[np.float64]

RAW_AXES = ("x", "y", "z")
PLANAR = ("swinging", "strict-ellipse", "modified-ellipsoid")
"""Methods for level circles."""

_FIELD_CHORD = 0.3
"""Chord over the core field's horizontal part by which the field's own turning is followed."""
_LOST = 0.2
"""Part of a revolution that following the field by chords may lose at the ends."""
_PATH_CHORD_M = 3.0
"""Chord by which the course of a vehicle is followed: beyond the scatter of its fixes."""
_MOST_OUTLIERS = 0.3
_LARGEST_MISFIT = 0.05


class CalibrateVectorParams(Params):
    """Parameters of calibrate-vector."""

    method: Literal["swinging", "strict-ellipse", "modified-ellipsoid", "ellipsoid", "attitude"] = (
        quantity(
            "1",
            default="modified-ellipsoid",
            doc="The first three for level circles, the others for motion about all axes.",
        )
    )
    distortion: Literal["symmetric", "triangular"] = quantity(
        "1", default="symmetric", doc="Axes taken for true: all on average, or x exactly."
    )
    start: UtcTime | None = quantity("1", default=None, doc="First time to use, UTC.")
    end: UtcTime | None = quantity("1", default=None, doc="Last time to use, UTC.")
    revolutions: float = quantity(
        "1", default=2.0, ge=1.0, doc="Revolutions that a method for level circles needs."
    )
    slowest_revolution_s: float = quantity(
        "s", default=120.0, gt=0, doc="Turning by a revolution within this time is a circle."
    )
    outlier_sigma: float = quantity(
        "1", default=5.0, ge=3.0, doc="Robust standard deviations that make an outlier."
    )
    reference_field: str = quantity(
        "1", default="IGRF-14", min_length=1, doc="Core field model that sets the scale."
    )
    core_field_nt: tuple[float, float, float] | None = quantity(
        "nT", default=None, doc="Core field north, east, down, in place of a model's."
    )
    allow_extrapolated: bool = quantity(
        "1", default=False, doc="Permit dates outside the span that the model is valid for."
    )


def calibrate_vector(
    track: xr.Dataset, *, params: CalibrateVectorParams, model: Path | None = None
) -> xr.Dataset:
    """Matrix and bias of a vector magnetometer: calibrated = matrix @ (raw - bias).

    The methods for level circles use the stretch of the track with the most turning, or what
    lies between `start` and `end`; the others use everything there. The scale is that of the
    core field at each sample's place and date.

    Raises CoverageError naming what the motion does not observe, ContractError for a track
    without a vector field, in another unit, already calibrated, or with mirrored axes.
    """
    check_raw(track)
    samples = select_samples(
        track, start=params.start, end=params.end, core_field_nt=params.core_field_nt,
        reference_field=params.reference_field, allow_extrapolated=params.allow_extrapolated,
        model=model,
    )  # fmt: skip
    driven = 0.0
    if params.method in PLANAR:
        samples, driven = _circles(samples, params)
        _check_handedness(samples)
    fit = _fit(samples, params)
    _check_misfit(fit, samples)
    return _dataset(fit, samples, params, driven).assign_attrs(source=track.attrs["source"])


def check_raw(track: xr.Dataset) -> None:
    """Raise ContractError for a track that was calibrated before."""
    if "calibration" in track.attrs:
        raise ContractError(
            f"field_body was calibrated already ({track.attrs['calibration']})",
            where=track.attrs.get("source"),
            expected="the sensor's own readings",
            remedy="start from the track as it was ingested",
        )


def _check_misfit(fit: Fit, samples: Samples) -> None:
    """Refuse samples that no calibration makes right."""
    lost = 1.0 - float(fit.kept.mean())
    misfit = fit.residual_rms / float(samples.core_total.mean())
    if lost > _MOST_OUTLIERS or misfit > _LARGEST_MISFIT:
        raise CoverageError(
            f"{lost:.0%} of the samples do not fit the calibration, and the others miss it by "
            f"{fit.residual_rms:.0f} nT rms ({magnitudes(samples.raw, samples.core)})",
            where="field_body",
            expected=f"at most {_MOST_OUTLIERS:.0%}, and {_LARGEST_MISFIT:.0%} of the field",
            remedy="calibrate away from steel, or choose start and end",
        )


def _fit(samples: Samples, params: CalibrateVectorParams) -> Fit:
    raw, mean, sigma = samples.raw, samples.core_mean, params.outlier_sigma
    if params.method == "swinging":
        return swinging(raw, mean, outlier_sigma=sigma)
    if params.method == "attitude":
        return from_attitude(raw, samples.core, samples.attitude, outlier_sigma=sigma)
    if params.method == "ellipsoid":
        return ellipsoid(raw, samples.core, outlier_sigma=sigma, distortion=params.distortion)
    method = strict_ellipse if params.method == "strict-ellipse" else modified_ellipsoid
    return method(raw, mean, outlier_sigma=sigma, distortion=params.distortion)


def _circles(samples: Samples, params: CalibrateVectorParams) -> tuple[Samples, float]:
    """The samples on circles, and the revolutions driven in them."""
    angle = heading(samples)
    if angle is None:
        chord = _FIELD_CHORD * float(np.hypot(*samples.core_mean[:2]))
        angle = tangent_angle(_without_spikes(samples.raw[:, :2]), chord)
    if params.start is not None and params.end is not None:
        stretch, driven = slice(None), revolutions_of(angle)
    else:
        stretch, driven = find_circles(samples.seconds, angle, params.slowest_revolution_s)
    if driven < params.revolutions - _LOST:
        raise not_observed(
            "biases, scale factors and distortion",
            f"the vehicle turns by {360.0 * driven:.1f} degrees in all"
            if driven < 1.0
            else f"the vehicle drives {driven:.1f} revolutions at most in one place",
            raw=samples.raw, core=samples.core,
            expected=f"{params.revolutions:g} revolutions on level ground, each within "
            f"{params.slowest_revolution_s:g} s",
            remedy="drive circles away from steel and buildings, or lower revolutions",
        )  # fmt: skip
    return samples.take(stretch), driven


def heading(samples: Samples) -> Real | None:
    """Heading (n,) from attitude, radians, unwrapped; None where most samples have none."""
    known = np.flatnonzero(np.isfinite(samples.attitude).all(axis=1))
    if 2 * known.size < len(samples.raw):
        return None
    w, x, y, z = samples.attitude[known].T
    yaw = np.arctan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y**2 + z**2))
    return np.asarray(np.interp(np.arange(len(samples.raw)), known, np.unwrap(yaw)))


def _check_handedness(samples: Samples) -> None:
    """Refuse a field that turns with the vehicle: it must turn against it."""
    turn = heading(samples)
    if turn is None and np.isfinite(samples.place).all():
        turn = tangent_angle(samples.place, _PATH_CHORD_M)
    if turn is None or revolutions_of(turn) < 1.0:
        return
    chord = _FIELD_CHORD * float(np.hypot(*samples.core_mean[:2]))
    field = tangent_angle(_without_spikes(samples.raw[:, :2]), chord)
    if float(np.cov(field, turn)[0, 1]) > 0.0:
        raise ContractError(
            "the horizontal field turns with the vehicle, not against it",
            where="field_body",
            expected="axes forward, right, down",
            remedy="set the sensor's rotation in the log's TOML (ROS axes are forward, left, up)",
        )


def _without_spikes(points: Real) -> Real:
    from scipy.ndimage import median_filter

    return np.asarray(median_filter(points, size=(5, 1), mode="nearest"))


def _dataset(
    fit: Fit, samples: Samples, params: CalibrateVectorParams, driven: float
) -> xr.Dataset:
    kept = samples.raw[fit.kept]
    scalar = {"residual_rms": ("nT", fit.residual_rms), "condition": ("1", fit.condition)}
    modelled = params.core_field_nt is None
    return xr.Dataset(
        {
            "matrix": (("axis", "raw_axis"), fit.matrix, {"units": "1"}),
            "bias": ("raw_axis", fit.bias, {"units": "nT"}),
            "covariance": (
                ("parameter", "parameter_other"), fit.covariance,
                {"long_name": "of the parameters: matrix entries (1) and biases (nT)"},
            ),
            **{name: ((), value, {"units": unit}) for name, (unit, value) in scalar.items()},
            "raw_minimum": ("raw_axis", kept.min(axis=0), {"units": "nT"}),
            "raw_maximum": ("raw_axis", kept.max(axis=0), {"units": "nT"}),
        },
        coords={
            "axis": list(AXES), "raw_axis": list(RAW_AXES),
            "parameter": list(fit.parameters), "parameter_other": list(fit.parameters),
        },
        attrs={
            "method": params.method,
            "assumed": fit.assumed,
            "reference_field": params.reference_field if modelled else "given",
            "core_field_nt": samples.core_mean,
            "start": str(samples.time[0]), "end": str(samples.time[-1]),
            "samples": len(fit.kept), "outliers": int(np.sum(~fit.kept)),
            **({"revolutions": round(driven, 2)} if params.method in PLANAR else {}),
            **fit.notes,
        },
    )  # fmt: skip


STAGE = Stage(
    name="calibrate-vector",
    version=1,
    params=CalibrateVectorParams,
    inputs={"track": "track/1", "model": OPTIONAL_FILE},
    output="sensor-calibration/1",
    run=calibrate_vector,
)
