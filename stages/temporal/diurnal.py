"""The time variation along a track, from a record or from quiet-day curves: ``subtract-diurnal``.

What a survey or a filter calls diurnal is how far the total field at a place is from its quiet
level. The measured `field_total` stays as it is: the variation stands beside it and comes off
where the anomaly is made, |F| - |F_core| - diurnal.
"""

from __future__ import annotations

import logging

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from magtiles.catalog.flags import TrackFlag, flag_attributes
from magtiles.catalog.kernels.geodesy import wrap_longitude
from magtiles.catalog.releases.record_file import SECONDS
from magtiles.catalog.releases.temporal import TemporalModel
from magtiles.catalog.releases.temporal_file import TemporalData
from magtiles.catalog.releases.temporal_table import TEMPORAL_VARIABLES
from magtiles.schemas.errors import ContractError, CoverageError
from magtiles.stages.declare import Params, Stage, quantity
from magtiles.stages.field.core_field import total_anomaly
from magtiles.stages.ingest.field_model import igrf
from magtiles.stages.temporal.record import TOTAL, check_ascending, fit_elements

_LOG = logging.getLogger(__name__)

Real = NDArray[np.float64]

_SECONDS_PER_DEGREE = 240.0
_HOUR = 3600.0

_FARTHEST_DAYS = 31.0
"""Beyond the middle of its last month by more than this, a model has no curve for a date."""


class SubtractRecordParams(Params):
    """Parameters of subtract-diurnal with a record."""

    lag_s: float = quantity(
        "s", default=0.0, ge=-86400, le=86400, doc="How much later the track sees a variation."
    )
    local_time: bool = quantity(
        "1", default=False, doc="Read the record at the track's local solar time, not its UTC."
    )
    datum_nt: float | None = quantity(
        "nT", default=None, gt=0, doc="Quiet level of the record's total; default its median."
    )
    longest_gap_s: float | None = quantity(
        "s", default=None, gt=0, doc="Longest gap to interpolate over; default two cadences."
    )
    uncertainty_nt: float = quantity(
        "nT", default=0.0, ge=0, doc="1 sigma of how the variation differs between both places."
    )


class SubtractBaselineParams(Params):
    """Parameters of subtract-diurnal with quiet-day curves: none."""


def subtract_record(
    series: xr.Dataset, track: xr.Dataset, *, params: SubtractRecordParams
) -> xr.Dataset:
    """The track with the variation that a base station or observatory recorded, nT.

    `diurnal` (time,) is the record's total field less its datum, linear between samples, read
    at the track's time less `lag_s`; with `local_time` also earlier by four minutes for each
    degree that the track lies west of the record, so that the sun stands alike. Its
    uncertainty joins `uncertainty_nt` with that of interpolating: between samples a variation
    strays like a Brownian bridge with the steps that the record makes there. NaN and flagged
    `no_diurnal` where samples lie farther apart than `longest_gap_s`, or there are none.

    Raises CoverageError where the record says nothing of the track, ContractError for times
    that do not ascend.
    """
    check_ascending(series)
    total = fit_elements(series)[TOTAL]
    known = np.isfinite(total)
    seconds, wanted = _common_clock(series, track, params)
    limit = params.longest_gap_s or 2.0 * float(series.attrs["cadence_s"])
    values, spread, there = _interpolate(seconds[known], total[known], wanted, limit)
    if not there.any():
        raise CoverageError(
            "no sample of the track has a value of the record",
            where=f"record from {_span(series)}",
            expected=f"the time of the track, {_span(track)}"
            + (" (moved by lag and local time)" if params.lag_s or params.local_time else ""),
            remedy="give the record of those days, or allow a longest_gap_s",
        )
    datum = float(np.median(total[known])) if params.datum_nt is None else params.datum_nt
    code = series.attrs["iaga_code"]
    return _with_diurnal(
        track,
        np.where(there, values - datum, np.nan),
        np.where(there, np.hypot(spread, params.uncertainty_nt), np.nan),
        f"total field of {code} less {datum:.2f} nT",
    )


def subtract_baseline(
    baseline: xr.Dataset, track: xr.Dataset, *, params: SubtractBaselineParams
) -> xr.Dataset:
    """The track with the quiet-day variation that is expected where and when it was, nT.

    `diurnal` (time,) is what the reader of a release answers: the curves of the model's
    observatories by local solar time, weighted in dip latitude, their vector along the core
    field of the IGRF. Its uncertainty joins the curves' own with the pooled sigma of what
    they leave, where the model has it. NaN and flagged `no_diurnal` where the track has no
    place, or where the season is a month or more from any of the model's.

    Raises ContractError for a model without curves, CoverageError where they say nothing of
    the track.
    """
    if "baseline" not in baseline:
        raise ContractError(
            "'baseline' is missing",
            where=baseline.attrs["source"],
            expected="a temporal-model/1 with quiet-day curves",
            remedy="run quiet-day-baseline, or give a record instead",
        )
    model = _model(baseline)
    time = track["time"].values
    place = track["latitude"].values, wrap_longitude(track["longitude"].values)
    quiet = model.baseline(*place, time)
    near = quiet.days_outside <= _FARTHEST_DAYS
    values = np.where(near, quiet.values[:, TOTAL], np.nan)
    spread = quiet.standard_error[:, TOTAL]
    if "class_sigma" in baseline:
        spread = np.hypot(spread, model.fogm(*place, time).sigma[:, TOTAL])
    if not np.isfinite(values).any():
        months = " to ".join(str(m) for m in (model.months[0], model.months[-1]))
        raise CoverageError(
            f"no sample of the track, {_span(track)}, has a quiet-day curve",
            where=baseline.attrs["source"],
            expected=f"places, and a season within a month of {months}",
            remedy="assemble a model of the track's months",
        )
    spread = np.where(np.isfinite(values), spread, np.nan)
    return _with_diurnal(track, values, spread, f"quiet days at {', '.join(quiet.observatories)}")


def _common_clock(
    series: xr.Dataset, track: xr.Dataset, params: SubtractRecordParams
) -> tuple[Real, Real]:
    """Seconds after the record's first sample: of its samples, and of when to read it (time,)."""
    start = series["time"].values[0]
    seconds, wanted = ((d["time"].values - start) / np.timedelta64(1, "s") for d in (series, track))
    wanted = wanted - params.lag_s
    if params.local_time:
        east = wrap_longitude(track["longitude"].values - float(series.attrs["longitude"]))
        wanted = wanted + _SECONDS_PER_DEGREE * east
    return seconds, wanted


def _interpolate(
    at: Real, values: Real, wanted: Real, limit: float
) -> tuple[Real, Real, NDArray[np.bool_]]:
    """Values (n,), their 1 sigma, and where samples (m,) no more than `limit` s apart hold them.

    A Brownian bridge over a gap T has the variance q T u (1 - u) at the share u of it, q being
    the mean squared step of the record there, by time.
    """
    if at.size < 2:
        nothing = np.full(wanted.shape, np.nan)
        return nothing, nothing, np.zeros(wanted.shape, bool)
    with np.errstate(invalid="ignore"):
        right = np.clip(np.searchsorted(at, wanted), 1, at.size - 1)
        left, gap = right - 1, at[right] - at[right - 1]
        share = (wanted - at[left]) / gap
        there = (share >= 0.0) & (share <= 1.0) & (gap <= limit)
    found = (1.0 - share) * values[left] + share * values[right]
    used = np.zeros(at.size - 1, bool)
    if there.any():
        low, high = wanted[there].min() - _HOUR, wanted[there].max() + _HOUR
        used = (at[1:] >= low) & (at[:-1] <= high) & (np.diff(at) <= limit)
    steps = np.diff(values)[used] ** 2 / np.diff(at)[used]
    rate = steps.mean() if steps.size else 0.0
    bridge = np.sqrt(np.where(there, rate * gap * share * (1.0 - share), 0.0).clip(0.0))
    return found, bridge, there


def _model(baseline: xr.Dataset) -> TemporalModel:
    """The reader's view of a temporal-model/1."""
    variables = {}
    for name in map(str, baseline.variables):
        rule, values = TEMPORAL_VARIABLES.get(name), baseline[name].values
        if rule is not None:
            whole_seconds = rule.units == SECONDS
            variables[name] = values.astype("M8[s]").astype(np.int64) if whole_seconds else values
    return TemporalModel(TemporalData(variables), igrf, str(baseline.attrs["source"]))


def _with_diurnal(track: xr.Dataset, values: Real, spread: Real, source: str) -> xr.Dataset:
    """The track with `diurnal`, its uncertainty and flag, and its anomaly, if any, made anew."""
    missing = int(np.isnan(values).sum())
    if missing:
        _LOG.warning("%d of %d samples of the track have no diurnal", missing, values.size)
    units = {"units": "nT"}
    made = track.assign(
        diurnal=("time", values, units | {"long_name": f"time variation: {source}"}),
        diurnal_uncertainty=(
            "time", spread, units | {"long_name": "1 sigma of the time variation"}
        ),
        quality_flag=_flagged(track, np.isnan(values)),
    )  # fmt: skip
    return total_anomaly(made) if "magnetic_anomaly" in made else made


def _flagged(track: xr.Dataset, missing: NDArray[np.bool_]) -> xr.DataArray:
    flag = np.zeros(missing.size, np.uint16)
    if "quality_flag" in track:
        flag = track["quality_flag"].values.astype(np.uint16)
    flag = np.where(missing, flag | TrackFlag.NO_DIURNAL, flag & ~np.uint16(TrackFlag.NO_DIURNAL))
    return xr.DataArray(
        flag.astype(np.uint16), dims="time", attrs=flag_attributes(TrackFlag, np.uint16)
    )


def _span(dataset: xr.Dataset) -> str:
    time = dataset["time"].values
    return f"{str(time.min())[:16]} to {str(time.max())[:16]}"


RECORD_STAGE = Stage(
    name="subtract-diurnal",
    version=1,
    params=SubtractRecordParams,
    inputs={"series": "observatory-series/1", "track": "track/1"},
    output="track/1",
    run=subtract_record,
)

BASELINE_STAGE = Stage(
    name="subtract-diurnal",
    version=1,
    params=SubtractBaselineParams,
    inputs={"baseline": "temporal-model/1", "track": "track/1"},
    output="track/1",
    run=subtract_baseline,
)
