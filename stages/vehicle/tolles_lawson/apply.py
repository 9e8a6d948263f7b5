"""Taking an aircraft's own field off what its scalar magnetometer measured."""

from __future__ import annotations

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from magtiles.catalog.flags import TrackFlag, flag_attributes
from magtiles.schemas.errors import ContractError
from magtiles.stages.declare import Params, Stage, quantity
from magtiles.stages.vehicle.tolles_lawson.manoeuvres import find_manoeuvres, mark
from magtiles.stages.vehicle.tolles_lawson.runs import find_runs
from magtiles.stages.vehicle.tolles_lawson.terms import (
    EDDY,
    INDUCED,
    PERMANENT,
    SHORTEST,
    direction_cosines,
    term_columns,
)

Floats = NDArray[np.float64]

_BEYOND = 0.05  # of a direction cosine: 3 degrees


class ApplyTollesLawsonParams(Params):
    """Parameters of apply-tolles-lawson."""

    least_swing_deg: float = quantity(
        "degree", default=1.5, gt=0, doc="Amplitude from which an oscillation is a manoeuvre."
    )


def apply_tolles_lawson(
    track: xr.Dataset, calibration: xr.Dataset, *, params: ApplyTollesLawsonParams
) -> xr.Dataset:
    """The track with its `field_total` (nT) compensated; as measured in `field_total_raw`.

    compensated = measured - (A @ coefficient - level), A from the track's `field_body` as in the
    fit (Nielsen 2023). NaN, with FIELD_GAP, where either field is missing or stands in fewer than
    five samples without a gap. Flags say where there are manoeuvres, and where the attitude lies
    more than 3 degrees beyond those of the calibration (EXTRAPOLATED_CALIBRATION).

    Raises ContractError for a calibration without Tolles-Lawson terms, or a track without the
    fields, or compensated already.
    """
    names = _check(track, calibration)
    body = np.asarray(track["field_body"].values, np.float64)
    measured = np.asarray(track["field_total"].values, np.float64)
    usable = np.isfinite(measured) & np.isfinite(direction_cosines(body)).all(axis=1)
    runs = find_runs(track, usable, SHORTEST)
    own = np.full(measured.shape, np.nan)
    of, span_s = (calibration.attrs[f"derivative_{key}"] for key in ("of", "span_s"))
    for run in runs:
        columns = term_columns(body[run.rows], run.step_s, names, of, span_s)
        own[run.rows] = columns @ calibration["coefficient"].values
    compensated = measured - (own - float(calibration["level"]))
    swings = mark(find_manoeuvres(track, runs, params.least_swing_deg), measured.size)
    flags = _flags(track)
    flags[swings] |= np.uint16(TrackFlag.MANOEUVRE)
    flags[np.isnan(compensated)] |= np.uint16(TrackFlag.FIELD_GAP)
    flags[_beyond(body, calibration)] |= np.uint16(TrackFlag.EXTRAPOLATED_CALIBRATION)
    nt = {"units": "nT"}
    return track.assign(
        field_total=("time", compensated, nt | {"long_name": "total field, compensated"}),
        field_total_raw=("time", measured, nt | {"long_name": "total field as measured"}),
        quality_flag=("time", flags, flag_attributes(TrackFlag, np.uint16)),
    ).assign_attrs(compensation=str(calibration.attrs["method"]))


def _check(track: xr.Dataset, calibration: xr.Dataset) -> list[str]:
    """The names of the calibration's terms."""
    if "coefficient" not in calibration or "level" not in calibration:
        raise ContractError(
            "has no Tolles-Lawson coefficients",
            where=f"calibration '{calibration.attrs.get('method')}'",
            expected="what fit-tolles-lawson makes",
            remedy="for a vector magnetometer run apply-calibration",
        )
    names = [str(name) for name in calibration["term"].values]
    for unknown in sorted(set(names) - {*PERMANENT, *INDUCED, *EDDY}):
        raise ContractError(f"unknown term '{unknown}'", where="calibration term")
    where = track.attrs.get("source")
    for name in ("field_total", "field_body"):
        if name not in track:
            raise ContractError(
                f"'{name}' is missing", where=where, expected="field_total and field_body, nT"
            )
    if "compensation" in track.attrs:
        raise ContractError(
            f"is compensated already ({track.attrs['compensation']})",
            where=where,
            expected="the field as it was measured",
        )
    return names


def _flags(track: xr.Dataset) -> NDArray[np.uint16]:
    if "quality_flag" in track:
        return np.array(track["quality_flag"].values, np.uint16)
    return np.zeros(track.sizes["time"], np.uint16)


def _beyond(body: Floats, calibration: xr.Dataset) -> NDArray[np.bool_]:
    """Where a direction cosine lies outside what the calibration saw, (time,)."""
    cosines = direction_cosines(body)
    low, high = calibration["cosine_range"].values.T
    outside = (cosines < low - _BEYOND) | (cosines > high + _BEYOND)
    return np.asarray(outside.any(axis=1))


STAGE = Stage(
    name="apply-tolles-lawson",
    version=1,
    params=ApplyTollesLawsonParams,
    inputs={"track": "track/1", "calibration": "sensor-calibration/1"},
    output="track/1",
    run=apply_tolles_lawson,
)
