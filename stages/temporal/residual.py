"""What is left of an observatory's record without its level and quiet-day curve, in segments."""

from __future__ import annotations

import logging
from dataclasses import dataclass

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from magtiles.catalog.kernels.local_time import level_at, mid_month
from magtiles.schemas.errors import ContractError
from magtiles.stages.temporal.record import check_ascending, fit_elements

Floats = NDArray[np.float64]
Times = NDArray[np.datetime64]

_LOG = logging.getLogger(__name__)


@dataclass(frozen=True)
class Segments:
    """A record cut into segments of equal length, counted from 1970-01-01 in UTC.

    Attributes
    ----------
    start : (segment,) when each begins.
    values : (element, segment, sample), nT, NaN where missing.
    step_s : seconds between samples.
    """

    start: Times
    values: Floats
    step_s: float

    @property
    def middle(self) -> Times:
        """When half of each is over."""
        half = np.timedelta64(round(0.5e9 * self.values.shape[2] * self.step_s), "ns")
        return self.start + half


def own_baseline(baseline: xr.Dataset, series: xr.Dataset) -> xr.Dataset:
    """The observatory (1) of a temporal-model/1 that recorded `series`, or ContractError."""
    code = str(series.attrs["iaga_code"])
    codes = [str(c) for c in baseline["iaga_code"].values]
    if code not in codes:
        raise ContractError(
            f"has no observatory {code}",
            where="baseline",
            expected=f"the observatory of the series; found {', '.join(codes)}",
            remedy="run quiet-day-baseline on this series",
        )
    for name in ("baseline", "level"):
        if name not in baseline:
            raise ContractError(
                f"'{name}' is missing",
                where="baseline",
                expected="a temporal-model/1 with quiet-day curves and the level they count from",
                remedy="run quiet-day-baseline on this series",
            )
    return baseline.isel(observatory=[codes.index(code)])


def residual(series: xr.Dataset, baseline: xr.Dataset) -> Floats:
    """Record less level less quiet-day curve (element, time), nT.

    The level is that of the midnights of the month's quiet days, from which the curve counts;
    between mid-months both are interpolated (`local_time.baseline_at` and `level_at`). NaN
    outside the months of `baseline`, a temporal-model/1 of this observatory alone.

    Raises ContractError where that leaves nothing of the record.
    """
    from magtiles.stages.temporal import curves_compiled

    months, time = baseline["month"].values, series["time"].values
    check_ascending(series)
    middles = mid_month(months)
    curves = _between(middles, baseline["baseline"].values[0].astype(np.float64))
    curves += level_at(months, baseline["level"].values[0], middles)[:, :, None]
    left = fit_elements(series)
    minutes_east = curves.shape[2] * float(series.attrs["longitude"]) / 360.0
    at, known = (t.astype("datetime64[ns]").astype(np.int64) for t in (time, middles))
    curves_compiled.subtract(left, at, known, curves, minutes_east)
    left[:, ~_covered(months, time)] = np.nan
    if not np.isfinite(left).any():
        raise ContractError(
            "no sample of the record has a quiet-day curve",
            where=f"series of {series.attrs['iaga_code']}",
            expected=f"valid samples from {str(months[0])[:7]} to {str(months[-1])[:7]}",
            remedy="run quiet-day-baseline on this series",
        )
    return left


def _between(middles: Times, curves: Floats) -> Floats:
    """The curves (element, month, minute) with months that are wholly NaN interpolated in time."""
    at = (middles - middles[0]) / np.timedelta64(1, "D")
    filled = curves.copy()
    for curve, rows in zip(filled, curves, strict=True):
        kept = ~np.isnan(rows).all(axis=1)
        if kept.any() and not kept.all():
            position = np.interp(at, at[kept], np.arange(np.count_nonzero(kept)))
            before, after = (r(position).astype(np.intp) for r in (np.floor, np.ceil))
            weight = (position - before)[:, None]
            curve[:] = (1.0 - weight) * rows[kept][before] + weight * rows[kept][after]
    return filled


def _covered(months: Times, time: Times) -> NDArray[np.bool_]:
    """Which instants lie within the months from the first to the last."""
    end = months[-1].astype("datetime64[M]") + 1
    inside = (time >= months[0]) & (time < end.astype("datetime64[ns]"))
    if not inside.all():
        _LOG.warning(
            "%d of %d samples lie outside the months of the baseline and are left out",
            np.count_nonzero(~inside),
            inside.size,
        )
    return np.asarray(inside)


def cut(values: Floats, time: Times, step_s: float, segment_s: float) -> Segments:
    """Cut a record (element, time) into segments of `segment_s` seconds.

    Samples may be missing, as rows or as NaN; segments without a valid sample are left out.

    Raises ContractError where times are not ascending at whole steps from the first, or where
    a segment is no whole number of steps.
    """
    step, length = round(step_s * 1e9), round(segment_s * 1e9)
    if length % step:
        raise ContractError(
            f"segments of {segment_s:g} s are no whole number of steps of {step_s:g} s",
            where="series",
            remedy="choose another segment_s",
        )
    at = time.astype("datetime64[ns]").astype(np.int64)
    _check_steps(at, step)
    segment = at // length
    begins = np.flatnonzero(np.diff(segment, prepend=segment[0] - 1))
    number = segment[begins]
    row = np.repeat(np.arange(begins.size), np.diff(begins, append=at.size))
    column = row * (length // step) + (at - segment * length) // step
    filled = np.full((len(values), begins.size * (length // step)), np.nan)
    for place, record in zip(filled, values, strict=True):
        place[column] = record
    parts = filled.reshape(len(values), begins.size, -1)
    kept = np.isfinite(parts).any(axis=(0, 2))
    return Segments((number[kept] * length).astype("datetime64[ns]"), parts[:, kept], step_s)


def _check_steps(at: NDArray[np.int64], step: int) -> None:
    gaps = np.diff(at)
    wrong = np.flatnonzero(gaps != step)
    wrong = wrong[(gaps[wrong] <= 0) | (gaps[wrong] % step != 0)]
    if wrong.size:
        i = int(wrong[0])
        raise ContractError(
            f"{gaps[i] / 1e9:g} s after the sample before",
            where=f"series, time[{i + 1}]",
            expected=f"a whole number of steps of {step / 1e9:g} s",
            remedy="ingest records of one cadence only",
        )
