"""From seconds to minutes to hours, as INTERMAGNET defines minute and hourly values.

A minute value is the output of a Gaussian filter over 91 one-second samples centred on the full
minute; an hourly value is the mean of the minutes 00 to 59, so its time is 29:30. Either is
given where at least 90 % of its input, by weight, is there (INTERMAGNET Technical Manual,
"Standards for calculating hourly, daily and annual means").
"""

from __future__ import annotations

from typing import Any, Literal

import numpy as np
import xarray as xr
from numpy.typing import NDArray
from scipy.signal import windows

from magtiles.catalog.flags import RecordFlag
from magtiles.schemas.errors import ParameterError

Real = NDArray[np.float64]
Flags = NDArray[np.uint8]
Cadence = Literal["minute", "hour"]
MinuteFilter = Literal["intermagnet", "usgs"]

SECONDS = {"minute": 60, "hour": 3600}

_TAPS = 91
_GAUSSIAN_S = 15.8734
"""Standard deviation of the filter: half its power passes at a period of 120 s."""

_COMPLETE = 0.9
_BLOCK = 4096  # outputs filtered at once
_ELEMENTS = ("field_north", "field_east", "field_down", "field_total")


def reduce_cadence(
    series: xr.Dataset, cadence: Cadence, minute_filter: MinuteFilter = "intermagnet"
) -> xr.Dataset:
    """An observatory-series/1 at one minute or one hour, from a finer one; else as it is.

    A value made of less than all its samples carries INCOMPLETE_AVERAGE, and is NaN below 90 %.
    Flags of the samples that went in are kept. Raises ParameterError for a coarser series, or
    one that is neither of seconds nor of minutes.
    """
    wanted, found = SECONDS[cadence], float(series.attrs["cadence_s"])
    if found == wanted:
        return series
    if found not in (1.0, 60.0) or found > wanted:
        raise ParameterError(
            f"key 'cadence' is '{cadence}', but the record's samples are {found:g} s apart",
            where=series.attrs.get("source"),
            expected="a record of one-second or one-minute values",
        )
    if found == 1.0:
        series = _filtered(series, gaussian_filter(minute_filter), every=60, phase=0)
    if cadence == "hour":
        series = _filtered(series, np.full(60, 1.0 / 60.0), every=60, phase=30)
    return series


def gaussian_filter(kind: MinuteFilter = "intermagnet") -> Real:
    """Weights (91,) of the one-minute filter, of sum 1.

    INTERMAGNET's is centred on the minute. The USGS's values since 2020 are of the first 91 of
    92 points (SciPy's `get_window` makes periodic windows), centred half a second later.
    """
    weights: Real = windows.gaussian(_TAPS, _GAUSSIAN_S, sym=kind == "intermagnet")
    weights /= weights.sum()
    return weights


def weighted_means(values: Real, weights: Real, begin: NDArray[np.int64]) -> tuple[Real, Real]:
    """Means of (rows,) values under (taps,) weights that begin at `begin` (outputs,).

    Returns the means (outputs,), NaN where less than 90 % of the weight is there, and the share
    of the weight that is. Samples beyond either end are missing.
    """
    taps = weights.size
    padded = np.concatenate([np.full(taps, np.nan), values, np.full(taps, np.nan)])
    view = np.lib.stride_tricks.sliding_window_view(padded, taps)
    means, shares = np.empty(begin.size), np.empty(begin.size)
    for start in range(0, begin.size, _BLOCK):
        part = slice(start, start + _BLOCK)
        samples = view[begin[part] + taps]
        known = np.isfinite(samples)
        shares[part] = known @ weights
        with np.errstate(invalid="ignore"):
            means[part] = np.where(known, samples, 0.0) @ weights / shares[part]
    means[shares < _COMPLETE - 1e-9] = np.nan
    return means, np.minimum(shares, 1.0)


def _filtered(series: xr.Dataset, weights: Real, *, every: int, phase: int) -> xr.Dataset:
    """Each `every` samples one: centred on full intervals (phase 0) or spanning them."""
    time = series["time"].values.astype("datetime64[ns]")
    step = np.timedelta64(round(float(series.attrs["cadence_s"]) * 1e9), "ns")
    whole = step * every
    first = time[0] - (time[0] - np.datetime64(0, "ns")) % whole
    if phase == 0 and first < time[0]:
        first += whole
    count = int((time[-1] - first) // whole) + 1
    if count < 1:
        raise ParameterError(
            f"the record of {time.size} samples reaches no full interval of {every} samples",
            where=series.attrs.get("source"),
            expected="a longer record",
        )
    # Minutes of a record that are not stamped at the full minute keep their offset.
    offset = (time[0] - first) % step
    at = np.round((first + offset - time[0]) / step).astype(np.int64) + every * np.arange(count)
    begin = at - (weights.size // 2 if phase == 0 else 0)
    centre = first + whole * np.arange(count)
    if phase:
        centre = centre + offset + step * (every - 1) // 2
    data, share = {}, np.full(count, np.inf)
    for name in _ELEMENTS:
        data[name], part = weighted_means(series[name].values, weights, begin)
        if part.any():  # an element that is never recorded makes no average incomplete
            share = np.minimum(share, part)
    flags = _flags(series["quality_flag"].values, begin, weights.size)
    flags[share < 1.0 - 1e-9] |= np.uint8(RecordFlag.INCOMPLETE_AVERAGE)
    return _rebuilt(series, centre, data, flags).assign_attrs(
        cadence_s=float(series.attrs["cadence_s"]) * every
    )


def _flags(flags: Flags, begin: NDArray[np.int64], taps: int) -> Flags:
    """The flags (outputs,) of all samples that each output is made of."""
    ends = np.clip(np.stack([begin, begin + taps]), 0, flags.size)
    out = np.zeros(begin.size, np.uint8)
    for flag in RecordFlag:
        counted = np.concatenate([[0], np.cumsum((flags & flag.value) != 0)])
        out[counted[ends[1]] > counted[ends[0]]] |= np.uint8(flag.value)
    return out


def _rebuilt(
    series: xr.Dataset, time: NDArray[np.datetime64], data: dict[str, Real], flags: Flags
) -> xr.Dataset:
    variables: dict[str, Any] = {k: ("time", v, series[k].attrs) for k, v in data.items()}
    variables["quality_flag"] = ("time", flags, series["quality_flag"].attrs)
    return xr.Dataset(
        variables, coords={"time": ("time", time, series["time"].attrs)}, attrs=series.attrs
    )
