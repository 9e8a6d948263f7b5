"""First-order Gauss-Markov statistics of an observatory's record: ``fit-fogm``.

The record less its level and quiet-day curve is close to a first-order Gauss-Markov process over
segments of three hours (Canciani and Raquet 2016, "Temporal Variation Parameterization").
"""

from __future__ import annotations

import itertools
import logging
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from magtiles.catalog.kernels import activity_classes
from magtiles.catalog.kernels.local_time import solar_minute
from magtiles.schemas.errors import ContractError
from magtiles.stages.declare import OptionalInput, Params, Stage, quantity
from magtiles.stages.temporal.fogm import (
    Fit,
    fit_autocorrelation,
    fit_pooled,
    fit_segments,
)
from magtiles.stages.temporal.persistence import persistence
from magtiles.stages.temporal.record import ELEMENTS
from magtiles.stages.temporal.residual import Segments, cut, own_baseline, residual

_LOG = logging.getLogger(__name__)

Floats = NDArray[np.float64]
Columns = dict[str, NDArray[Any]]

PLACE = ("iaga_code", "latitude", "longitude", "elevation", "dip_latitude")
PREDICTED = ("level", "sigma", "tau", "sigma_autocorrelation", "tau_autocorrelation")

LEAST_SAMPLES = 12
"""Samples that a segment must hold where none is missing."""

CLASSES = np.array(
    list(itertools.product(*(range(-1, len(names)) for names in (
        activity_classes.KP_CLASSES, activity_classes.SEASONS, activity_classes.LOCAL_TIMES
    )))), np.int8,
)  # fmt: skip
"""Every combination of activity, season and local time, `ANY` included: (class, 3)."""


class FitFogmParams(Params):
    """Parameters of fit-fogm."""

    segment_s: float = quantity(
        "s", default=10800.0, gt=0.0, le=86400.0, doc="Length of a segment, from 00 UTC."
    )
    least_valid_fraction: float = quantity(
        "1", default=0.5, gt=0.0, le=1.0, doc="Share of a segment's samples that must be valid."
    )


def fit_fogm(
    series: xr.Dataset,
    baseline: xr.Dataset,
    *,
    params: FitFogmParams,
    index: xr.Dataset | None = None,
) -> xr.Dataset:
    """Sigma (nT) and tau (s) of each segment and class of a record less its quiet-day curve.

    For north, east, down and total: exact maximum likelihood about zero (`sigma`, `tau`, with
    95 % profile bounds `_low` and `_high`, and `tau_unidentified` where tau is longer than the
    segment or has no upper bound) and about the segment's mean (`_about_mean`); the fit to the
    sample autocorrelation about zero (`_autocorrelation`); and joint fits about zero over all
    segments of a class (`class_`). NaN where fewer samples are valid than
    `least_valid_fraction`. Without an index Kp is NaN, and the classes that tell it are empty.

    Parameters
    ----------
    series : observatory-series/1.
    baseline : temporal-model/1 with quiet-day curves of that observatory.
    index : activity-index/1 with Kp.

    Raises
    ------
    ContractError
        The baseline is of another observatory or of other months; the index has no Kp for the
        record; the record is too coarse for the segments or not at equal steps.
    """
    curves = own_baseline(baseline, series)
    step_s = float(series.attrs["cadence_s"])
    if params.segment_s < LEAST_SAMPLES * step_s:
        raise ContractError(
            f"samples every {step_s:g} s leave {params.segment_s / step_s:g} in a segment",
            where="series",
            expected=f"at least {LEAST_SAMPLES}",
            remedy="use a record of finer cadence, or set segment_s",
        )
    left = residual(series, curves)
    segments = cut(left, series["time"].values, step_s, params.segment_s)
    kp = segment_kp(segments.middle, index)
    members = class_members(segments.middle, kp, series)
    variables = _fitted(segments, members, params)
    variables |= {
        "segment_start": ("segment", segments.start, {"long_name": "when the segment begins"}),
        "kp": ("segment", kp.astype(np.float32), {"units": "1", "long_name": "Kp"}),
        "class_kp": ("class", CLASSES[:, 0], {"long_name": _meanings("KP_CLASSES")}),
        "class_season": ("class", CLASSES[:, 1], {"long_name": _meanings("SEASONS")}),
        "class_local_time": ("class", CLASSES[:, 2], {"long_name": _meanings("LOCAL_TIMES")}),
    }
    return xr.Dataset(
        {name: curves[name] for name in PLACE} | variables,
        coords={"element": ("element", list(ELEMENTS)), "predicted": list(PREDICTED)},
        attrs={
            "source": str(series.attrs["source"]),
            "segment_s": params.segment_s,
            "cadence_s": step_s,
        },
    )


def segment_kp(middle: NDArray[np.datetime64], index: xr.Dataset | None) -> Floats:
    """Kp (segment,) of the interval that holds the middle of each segment, NaN where unknown.

    Raises ContractError where an index is given that has Kp for none of them.
    """
    kp = np.full(middle.shape, np.nan)
    if index is None or "kp" not in index:
        _LOG.warning("no index has Kp: nothing is told of quiet and stormy segments")
        return kp
    begin: NDArray[np.datetime64] = index["time"].values
    known = index["kp"].values
    interval = np.timedelta64(round(float(index.attrs["cadence_s"]) * 1e9), "ns")
    at = np.searchsorted(begin, middle, side="right") - 1
    end = begin + interval
    inside = (at >= 0) & (middle < end[at])
    kp[inside] = known[at[inside]]
    if np.isnan(kp).all():
        raise ContractError(
            f"has no Kp from {str(middle[0])[:10]} to {str(middle[-1])[:10]}",
            where="index",
            expected="Kp of the time of the series",
            remedy="ingest the index of those months, or leave it out",
        )
    if unknown := np.count_nonzero(np.isnan(kp)):
        _LOG.warning("%d of %d segments have no Kp", unknown, kp.size)
    return kp


def class_members(
    middle: NDArray[np.datetime64], kp: Floats, series: xr.Dataset
) -> NDArray[np.bool_]:
    """Which segments (class, segment) belong to which of `CLASSES`."""
    minute = solar_minute(middle, float(series.attrs["longitude"]))
    own = np.stack([
        activity_classes.kp_class(kp),
        activity_classes.season(middle, float(series.attrs["latitude"])),
        activity_classes.local_time(minute),
    ])  # fmt: skip
    wanted = CLASSES[:, :, None]
    return np.asarray(((wanted == activity_classes.ANY) | (wanted == own)).all(axis=1))


def _fitted(
    segments: Segments, members: NDArray[np.bool_], params: FitFogmParams
) -> dict[str, tuple[object, ...]]:
    """All fitted variables; elements side by side, since the compiled fits release the lock."""
    follows = np.diff(segments.start) == np.timedelta64(round(params.segment_s * 1e9), "ns")

    def one(values: Floats) -> Columns:
        least = params.least_valid_fraction
        return _fit_element(values, segments.step_s, members, follows, least)

    with ThreadPoolExecutor(len(ELEMENTS)) as pool:
        columns = list(pool.map(one, segments.values))
    dims = {"class": "class", "persistence": "predicted"}
    variables: dict[str, tuple[object, ...]] = {}
    for name, (dtype, units, meaning) in VARIABLES.items():
        values = np.stack([column[name] for column in columns])[None].astype(dtype)
        along = dims.get(name.partition("_")[0], "segment")
        attributes = {"long_name": meaning} | ({"units": units} if units else {})
        variables[name] = (("observatory", "element", along), values, attributes)
    return variables


def _fit_element(
    values: Floats,
    step_s: float,
    members: NDArray[np.bool_],
    follows: NDArray[np.bool_],
    least_valid_fraction: float,
) -> Columns:
    """The columns of `VARIABLES` for one element, values (segment, sample)."""
    duration_s = values.shape[1] * step_s
    fraction = np.isfinite(values).mean(axis=1)
    fit_for = fraction >= least_valid_fraction
    used = np.where(fit_for[:, None], values, np.nan)
    fit, sigma_about_mean, tau_about_mean = fit_segments(used, step_s)
    sigma_of_lags, tau_of_lags = fit_autocorrelation(used, step_s)
    members = members & fit_for
    pooled, count = fit_pooled(used, step_s, members), members.sum(axis=1)
    columns = _named(fit, "") | _named(pooled, "class_")
    columns |= {
        "tau_unidentified": fit.unidentified(duration_s),
        "class_tau_unidentified": pooled.unidentified(count * duration_s),
        "class_segments": count,
        "valid_fraction": fraction,
        "sigma_about_mean": sigma_about_mean,
        "tau_about_mean": tau_about_mean,
        "sigma_autocorrelation": sigma_of_lags,
        "tau_autocorrelation": tau_of_lags,
    }
    level = np.full(len(used), np.nan)
    level[fit_for] = np.nanmean(used[fit_for], axis=1)
    predicted = [level, *(_logarithm(columns[name]) for name in PREDICTED[1:])]
    columns["persistence"] = np.array([persistence(p, follows) for p in predicted])
    return columns


def _named(fit: Fit, prefix: str) -> Columns:
    return {
        f"{prefix}{name}{bound}": getattr(fit, f"{name}{bound}")
        for name in ("sigma", "tau")
        for bound in ("", "_low", "_high")
    }


def _logarithm(values: Floats) -> Floats:
    """Natural logarithm, NaN where a value is zero, infinite or NaN."""
    proper = np.isfinite(values) & (values > 0.0)
    return np.log(values, out=np.full(values.shape, np.nan), where=proper)


def _meanings(names: str) -> str:
    listed = enumerate(getattr(activity_classes, names))
    return ", ".join(["-1 any", *(f"{number} {name}" for number, name in listed)])


def _variables() -> dict[str, tuple[type[np.generic], str | None, str]]:
    """Type, unit and meaning of each fitted variable."""
    table: dict[str, tuple[type[np.generic], str | None, str]] = {}
    of = {"": "of the segment", "class_": "of all segments of the class together"}
    bounds = {"": "", "_low": ", lower 95 % bound", "_high": ", upper 95 % bound"}
    for prefix, whose in of.items():
        for bound, which in bounds.items():
            for name, units in (("sigma", "nT"), ("tau", "s")):
                meaning = f"{name} about zero {whose}, maximum likelihood{which}"
                table[f"{prefix}{name}{bound}"] = (np.float32, units, meaning)
        meaning = f"1 where tau {whose} is longer than the record behind it, or unbounded"
        table[f"{prefix}tau_unidentified"] = (np.uint8, None, meaning)
    for name, units in (("sigma", "nT"), ("tau", "s")):
        about_mean = f"{name} about the segment's mean, maximum likelihood"
        of_lags = f"{name} of the segment, fitted to its autocorrelation about zero"
        table[f"{name}_about_mean"] = (np.float32, units, about_mean)
        table[f"{name}_autocorrelation"] = (np.float32, units, of_lags)
    table["valid_fraction"] = (np.float32, "1", "share of the segment's samples that are valid")
    table["class_segments"] = (np.int32, None, "segments in the class")
    table["persistence"] = (
        np.float32, "1", "rms error of the last segment as prediction, over that of the average"
    )  # fmt: skip
    return table


VARIABLES = _variables()

STAGE = Stage(
    name="fit-fogm",
    version=1,
    params=FitFogmParams,
    inputs={
        "series": "observatory-series/1",
        "baseline": "temporal-model/1",
        "index": OptionalInput("activity-index/1"),
    },
    output="temporal-model/1",
    run=fit_fogm,
)
