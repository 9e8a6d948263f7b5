"""Stage ``apply-calibration``: a track's vector readings calibrated, its total field set."""

from __future__ import annotations

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from magtiles.catalog.flags import TrackFlag, flag_attributes
from magtiles.schemas.errors import ContractError
from magtiles.stages.declare import Params, Stage
from magtiles.stages.vehicle.calibration.calibrate import check_raw
from magtiles.stages.vehicle.calibration.samples import body_field

Real = NDArray[np.float64]

_MARGIN = 0.05
"""Share of the core field by which a reading may lie beyond those that were calibrated."""
_SAME_NT = 1.0


class ApplyCalibrationParams(Params):
    """apply-calibration has no parameters."""


def apply_calibration(
    track: xr.Dataset, calibration: xr.Dataset, *, params: ApplyCalibrationParams
) -> xr.Dataset:
    """The track with `field_body` calibrated: matrix @ (raw - bias), nT.

    `field_total` becomes its length, unless another sensor measured it. Samples with a reading
    more than 5 % of the core field beyond those of the calibration are flagged
    EXTRAPOLATED_CALIBRATION: an attitude, or a field, that it has not seen.

    Raises ContractError for a track without a vector field or calibrated already, and for
    coefficients of Tolles-Lawson.
    """
    check_raw(track)
    if "matrix" not in calibration:
        raise ContractError(
            "'matrix' is missing: these are coefficients of Tolles-Lawson",
            where="calibration",
            expected="matrix and bias of a vector magnetometer",
            remedy="run apply-tolles-lawson",
        )
    raw = body_field(track)
    calibrated = (raw - calibration["bias"].values) @ calibration["matrix"].values.T
    dims = track["field_body"].dims
    out = track.assign(
        field_body=(dims, calibrated, {"units": "nT", "long_name": "calibrated field"})
    )
    if _is_length(track, raw):
        length = np.linalg.norm(calibrated, axis=1)
        out = out.assign(
            field_total=("time", length, {"units": "nT", "long_name": "length of field_body"})
        )
    return _flagged(out, _beyond(raw, calibration)).assign_attrs(
        calibration=f"{calibration.attrs['method']} from {calibration.attrs['source']}, residual "
        f"{float(calibration['residual_rms']):.1f} nT rms"
    )


def _is_length(track: xr.Dataset, raw: Real) -> bool:
    """Whether the track's total field is none, or no more than the length of its vector."""
    if "field_total" not in track:
        return True
    difference = np.abs(track["field_total"].values - np.linalg.norm(raw, axis=1))
    finite = difference[np.isfinite(difference)]
    return bool(finite.size == 0 or np.median(finite) < _SAME_NT)


def _beyond(raw: Real, calibration: xr.Dataset) -> NDArray[np.bool_]:
    if "raw_minimum" not in calibration:
        return np.zeros(len(raw), dtype=np.bool_)
    margin = _MARGIN * float(np.linalg.norm(calibration.attrs["core_field_nt"]))
    low, high = (calibration[f"raw_{end}"].values for end in ("minimum", "maximum"))
    return np.asarray(((raw < low - margin) | (raw > high + margin)).any(axis=1))


def _flagged(track: xr.Dataset, beyond: NDArray[np.bool_]) -> xr.Dataset:
    flags = np.zeros(track.sizes["time"], np.uint16)
    if "quality_flag" in track:
        flags |= track["quality_flag"].values
    flags[beyond] |= np.uint16(TrackFlag.EXTRAPOLATED_CALIBRATION)
    return track.assign(quality_flag=("time", flags, flag_attributes(TrackFlag, np.uint16)))


STAGE = Stage(
    name="apply-calibration",
    version=1,
    params=ApplyCalibrationParams,
    inputs={"track": "track/1", "calibration": "sensor-calibration/1"},
    output="track/1",
    run=apply_calibration,
)
