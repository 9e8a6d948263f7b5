"""temporal.nc: opened from verified bytes, checked field by field, and read whole."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import netCDF4
import numpy as np
from numpy.typing import NDArray

from magtiles.catalog.releases.temporal_table import (
    ALWAYS,
    BASELINE,
    CONTRACT,
    ELEMENTS,
    FOGM,
    MOST,
    SECONDS,
    TEMPORAL_VARIABLES,
)
from magtiles.schemas.errors import IntegrityError

MAX_BYTES = 1 << 30
"""Of the arrays together."""

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


@dataclass(frozen=True)
class TemporalData:
    """A whole verified temporal.nc: its arrays by name (read-only), its attributes.

    Text is of dtype str; times are as stored (see `temporal_table`).
    """

    variables: Mapping[str, NDArray[Any]]
    attributes: Mapping[str, Any] = field(default_factory=dict)

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
    try:
        with netCDF4.Dataset("temporal.nc", memory=data) as file:
            file.set_auto_maskandscale(False)
            check = _Checks(file, where)
            check.structure(len(data))
            variables = {name: check.read(name) for name in file.variables}
            attributes = {name: file.getncattr(name) for name in file.ncattrs()}
    except (OSError, RuntimeError, AttributeError, ValueError, MemoryError) as caught:
        raise _problem(where, f"is no readable temporal model: {caught}", "netCDF-4") from None
    check.values(variables)
    for values in variables.values():
        values.flags.writeable = False
    return TemporalData(variables, attributes)


class _Checks:
    """What a file must be before and after its arrays are read."""

    def __init__(self, file: Any, where: object) -> None:
        self._file, self._where = file, where

    def structure(self, size: int) -> None:
        """Contract, dimensions and variables, without reading any array."""
        found = self._file.getncattr("contract") if "contract" in self._file.ncattrs() else None
        if found != CONTRACT:
            raise self._problem(f"attribute contract is {found!r}", f"{CONTRACT!r}")
        present = set(self._file.variables)
        unknown = sorted(present - set(TEMPORAL_VARIABLES)) or sorted(self._file.groups)
        if unknown:
            raise self._problem(f"holds {unknown[0]}", "only the variables of a temporal model")
        groups = [g for g in (BASELINE, FOGM) if present & set(g)] or [BASELINE]
        missing = [name for group in (ALWAYS, *groups) for name in group if name not in present]
        if missing:
            raise self._problem(f"has no variable {missing[0]}", "all that belong with it")
        for name, dimension in self._file.dimensions.items():
            if not 1 <= dimension.size <= MOST.get(name, 0):
                raise self._problem(
                    f"dimension {name} is {dimension.size}", f"1 to {MOST.get(name, 0)}"
                )
        if self._file.dimensions["element"].size != len(ELEMENTS):
            raise self._problem("has other elements", ", ".join(ELEMENTS))
        declared = 0
        for name in present:
            declared += self._variable(name)
        # The most that zlib can expand: a file that declares more holds none of it.
        if declared > min(MAX_BYTES, 1032 * size):
            raise self._problem(f"declares {declared} bytes of arrays", f"at most {MAX_BYTES}")

    def _variable(self, name: str) -> int:
        """Check one variable's declaration; the bytes that it declares."""
        rule, variable = TEMPORAL_VARIABLES[name], self._file.variables[name]
        dtype = "str" if variable.dtype is str else np.dtype(variable.dtype).name
        if variable.dimensions != rule.dims or dtype not in rule.dtypes:
            raise self._problem(
                f"{name} has dims and dtype {variable.dimensions, dtype}",
                f"{rule.dims} and {' or '.join(rule.dtypes)}",
            )
        units = variable.getncattr("units") if "units" in variable.ncattrs() else None
        if units != rule.units:
            raise self._problem(f"{name} has units {units!r}", f"{rule.units!r}")
        # Values of HDF5 data that is not chunked may lie in another file of the machine.
        if not isinstance(variable.chunking(), list):
            raise self._problem(f"{name} is stored contiguously", "chunked data")
        return int(variable.size) * (8 if dtype == "str" else np.dtype(dtype).itemsize)

    def read(self, name: str) -> NDArray[Any]:
        """A variable's values; text as str."""
        values = np.asarray(self._file.variables[name][...])
        return values.astype(str) if values.dtype == object else values

    def values(self, variables: Mapping[str, NDArray[Any]]) -> None:
        """What queries rely on: names, order, ranges."""
        if tuple(variables["element"].tolist()) != ELEMENTS:
            raise self._problem("has other elements", ", ".join(ELEMENTS))
        codes = variables["iaga_code"].tolist()
        if len(set(codes)) < len(codes) or not all(re.fullmatch(_CODE, c) for c in codes):
            raise self._problem(f"iaga_code is {codes}", "IAGA codes, each once")
        for name, (low, high) in _RANGES.items():
            if name in variables:
                self._range(name, variables[name], low, high)
        for name in (n for n, rule in TEMPORAL_VARIABLES.items() if rule.units == SECONDS):
            if name in variables and not (np.diff(variables[name]) > 0).all():
                raise self._problem(f"{name} does not ascend", "ascending times")
        if "minute" in variables:
            count = variables["minute"].size
            steps = np.arange(count) * (1440.0 / count)
            if not (np.abs(variables["minute"] - steps) <= _MINUTE_TOLERANCE).all():
                raise self._problem("minute is no day", "equal steps of 1440 minutes, from 0")

    def _range(self, name: str, values: NDArray[Any], low: float, high: float) -> None:
        of_place = TEMPORAL_VARIABLES[name].dims == ("observatory",)
        good = (values >= low) & (values <= high)
        if not of_place:
            good |= np.isnan(values)
        if not good.all():
            bad = values[~good].ravel()[0]
            raise self._problem(f"{name} holds {bad:g}", f"{low:g} to {high:g}")

    def _problem(self, what: str, expected: str) -> IntegrityError:
        return _problem(self._where, what, expected)


def _problem(where: object, what: str, expected: str) -> IntegrityError:
    return IntegrityError(
        what, where=where, expected=expected, remedy="fetch or build the release again"
    )
