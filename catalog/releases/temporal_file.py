"""temporal.nc: opened from verified bytes, checked field by field, and read whole."""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from magtiles.catalog.releases.record_file import (
    SECONDS,
    Record,
    check_range,
    problem,
    read_record,
)
from magtiles.catalog.releases.temporal_table import (
    ALWAYS,
    BASELINE,
    ELEMENTS,
    FOGM,
    TABLE,
    TEMPORAL_VARIABLES,
)

_CODE = r"[A-Z0-9]{3,4}"
_MINUTE_TOLERANCE = 1e-3
_SECONDS_1700_TO_2200 = -8_520_336_000, 7_258_118_400
_RANGES: dict[str, tuple[float, float]] = {
    "month": _SECONDS_1700_TO_2200,
    "segment_start": _SECONDS_1700_TO_2200,
    "latitude": (-90.0, 90.0),
    "longitude": (-180.0, 180.0),
    "elevation": (-500.0, 9000.0),
    "dip_latitude": (-90.0, 90.0),
    "baseline": (-1e4, 1e4),
    "baseline_standard_error": (0.0, 1e4),
    "class_segments": (0, np.inf),
    "class_sigma": (0.0, 1e5),
    "class_tau": (0.0, np.inf),
    "class_tau_unidentified": (0, 1),
    "class_kp": (-1, 1),
    "class_season": (-1, 2),
    "class_local_time": (-1, 3),
}
"""What a query relies on; NaN, where a float may be missing, passes but at a place."""


class TemporalData(Record):
    """A whole verified temporal.nc; times are as stored (see `temporal_table`)."""

    @property
    def has_baseline(self) -> bool:
        """Whether there are quiet-day baselines."""
        return "baseline" in self.variables

    @property
    def has_fogm(self) -> bool:
        """Whether there are Gauss-Markov statistics."""
        return "class_sigma" in self.variables


def read_temporal(data: bytes, where: object) -> TemporalData:
    """Parse the verified bytes of a temporal.nc; every breach raises IntegrityError."""
    record = read_record(data, where, TABLE, _wanted)
    _check_values(record.variables, where)
    return TemporalData(record.variables, record.attributes)


def _wanted(present: set[str]) -> list[str]:
    groups = [g for g in (BASELINE, FOGM) if present & set(g)] or [BASELINE]
    return [name for group in (ALWAYS, *groups) for name in group]


def _check_values(variables: Mapping[str, NDArray[Any]], where: object) -> None:
    """What queries rely on: names, order, ranges."""
    if tuple(variables["element"].tolist()) != ELEMENTS:
        raise problem(where, "has other elements", ", ".join(ELEMENTS))
    codes = variables["iaga_code"].tolist()
    if len(set(codes)) < len(codes) or not all(re.fullmatch(_CODE, c) for c in codes):
        raise problem(where, f"iaga_code is {codes}", "IAGA codes, each once")
    for name, (low, high) in _RANGES.items():
        if name in variables:
            of_place = TEMPORAL_VARIABLES[name].dims == ("observatory",)
            check_range(where, name, variables[name], low, high, missing=not of_place)
    for name in (n for n, rule in TEMPORAL_VARIABLES.items() if rule.units == SECONDS):
        if name in variables and not (np.diff(variables[name]) > 0).all():
            raise problem(where, f"{name} does not ascend", "ascending times")
    if "minute" in variables:
        count = variables["minute"].size
        steps = np.arange(count) * (1440.0 / count)
        if not (np.abs(variables["minute"] - steps) <= _MINUTE_TOLERANCE).all():
            raise problem(where, "minute is no day", "equal steps of 1440 minutes, from 0")
