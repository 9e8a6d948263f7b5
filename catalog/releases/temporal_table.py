"""The variables of a release's temporal.nc (temporal-model/1): one table for writer and reader.

Times are stored as whole seconds since 1970 (`segment_start`, `month`) or, where they may be
missing, as days since then with NaN (`quiet_day`); missing values of floats are NaN.
"""

from __future__ import annotations

from magtiles.catalog.releases.record_file import DAYS, SECONDS, RecordTable, RecordVariable

CONTRACT = "temporal-model/1.0.0"
PATH = "temporal.nc"

ELEMENTS = ("north", "east", "down", "total")

_FLOATS = ("float32", "float64")
_OF_MINUTE = ("observatory", "element", "month", "minute")
_OF_SEGMENT = ("observatory", "element", "segment")
_OF_CLASS = ("observatory", "element", "class")

_MOST = {
    "observatory": 1000,
    "element": len(ELEMENTS),
    "month": 10_000,
    "minute": 1440,
    "rank": 31,
    "segment": 10_000_000,
    "class": 1000,
    "predicted": 16,
}
"""Largest size of each dimension."""


def _place(units: str, long_name: str) -> RecordVariable:
    return RecordVariable(("observatory",), ("float64",), units, long_name)


def _fitted(dims: tuple[str, ...], units: str, long_name: str) -> RecordVariable:
    return RecordVariable(dims, _FLOATS, units, long_name)


def _code(long_name: str) -> RecordVariable:
    return RecordVariable(("class",), ("int8",), None, long_name)


TEMPORAL_VARIABLES: dict[str, RecordVariable] = {
    "iaga_code": RecordVariable(("observatory",), ("str",), None, "IAGA code"),
    "latitude": _place("degrees_north", "geodetic latitude"),
    "longitude": _place("degrees_east", "geodetic longitude"),
    "elevation": _place("m", "height above mean sea level"),
    "dip_latitude": _place("degree", "dip latitude, atan(tan(inclination) / 2)"),
    "element": RecordVariable(("element",), ("str",), None, "element of the field"),
    "month": RecordVariable(("month",), ("int64",), SECONDS, "start of the month"),
    "minute": RecordVariable(("minute",), _FLOATS, "min", "local mean solar time"),
    "baseline": _fitted(_OF_MINUTE, "nT", "quiet-day variation from local midnight"),
    "baseline_standard_error": _fitted(_OF_MINUTE, "nT", "standard error of the baseline"),
    "level": _fitted(
        ("observatory", "element", "month"), "nT", "local-midnight level of the quiet days"
    ),
    "quiet_day": RecordVariable(
        ("observatory", "month", "rank"), ("float64",), DAYS, "quiet days that were averaged"
    ),
    "quiet_day_choice": RecordVariable(
        ("observatory", "month"), ("uint8",), None, "how the quiet days were chosen"
    ),
    "segment_start": RecordVariable(("segment",), ("int64",), SECONDS, "start of the segment"),
    "kp": RecordVariable(("segment",), _FLOATS, "1", "Kp of the segment"),
    "sigma": _fitted(_OF_SEGMENT, "nT", "FOGM standard deviation, maximum likelihood about zero"),
    "sigma_low": _fitted(_OF_SEGMENT, "nT", "lower profile-likelihood bound of sigma"),
    "sigma_high": _fitted(_OF_SEGMENT, "nT", "upper profile-likelihood bound of sigma"),
    "tau": _fitted(_OF_SEGMENT, "s", "FOGM time constant, maximum likelihood about zero"),
    "tau_low": _fitted(_OF_SEGMENT, "s", "lower profile-likelihood bound of tau"),
    "tau_high": _fitted(_OF_SEGMENT, "s", "upper profile-likelihood bound of tau"),
    "tau_unidentified": RecordVariable(
        _OF_SEGMENT, ("uint8",), None, "1 where the segment does not bound tau"
    ),
    "sigma_autocorrelation": _fitted(_OF_SEGMENT, "nT", "sigma of the autocorrelation's fit"),
    "tau_autocorrelation": _fitted(_OF_SEGMENT, "s", "tau of the autocorrelation's fit"),
    "sigma_about_mean": _fitted(_OF_SEGMENT, "nT", "sigma about the segment's mean"),
    "tau_about_mean": _fitted(_OF_SEGMENT, "s", "tau about the segment's mean"),
    "valid_fraction": _fitted(_OF_SEGMENT, "1", "share of the segment's samples that are there"),
    "predicted": RecordVariable(("predicted",), ("str",), None, "what persistence is of"),
    "persistence": _fitted(
        ("observatory", "element", "predicted"),
        "1",
        "rms error of the last segment as prediction, over that of the average",
    ),
    "class_kp": _code("activity: 0 quiet, 1 stormy (Kp >= 3), -1 any"),
    "class_season": _code("season of the hemisphere: 0 winter, 1 equinox, 2 summer, -1 any"),
    "class_local_time": _code("quarter of the local day from midnight: 0 to 3, -1 any"),
    "class_segments": RecordVariable(_OF_CLASS, ("int32",), None, "segments pooled"),
    "class_sigma": _fitted(_OF_CLASS, "nT", "pooled FOGM standard deviation"),
    "class_sigma_low": _fitted(_OF_CLASS, "nT", "lower bound of the pooled sigma"),
    "class_sigma_high": _fitted(_OF_CLASS, "nT", "upper bound of the pooled sigma"),
    "class_tau": _fitted(_OF_CLASS, "s", "pooled FOGM time constant"),
    "class_tau_low": _fitted(_OF_CLASS, "s", "lower bound of the pooled tau"),
    "class_tau_high": _fitted(_OF_CLASS, "s", "upper bound of the pooled tau"),
    "class_tau_unidentified": RecordVariable(
        _OF_CLASS, ("uint8",), None, "1 where the pooled segments do not bound tau"
    ),
}

ALWAYS = (
    "iaga_code", "latitude", "longitude", "elevation", "dip_latitude", "element",
)  # fmt: skip
BASELINE = (
    "month", "minute", "baseline", "baseline_standard_error", "quiet_day", "quiet_day_choice",
)  # fmt: skip
FOGM = (
    "segment_start", "sigma", "sigma_low", "sigma_high", "tau", "tau_low", "tau_high",
    "tau_unidentified", "sigma_autocorrelation", "tau_autocorrelation", "kp",
    "class_kp", "class_season", "class_local_time", "class_segments", "class_sigma", "class_tau",
)  # fmt: skip
"""Variables that stand together: those of baselines, those of Gauss-Markov statistics, or both."""

TABLE = RecordTable("temporal model", "temporal.nc", CONTRACT, TEMPORAL_VARIABLES, _MOST, 1 << 30)
