"""roads/*.nc: opened from verified bytes, checked field by field, and read whole."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import netCDF4
import numpy as np
from numpy.typing import NDArray

from magtiles.catalog.releases.road_table import (
    ALWAYS,
    CONTRACT,
    FEATURES,
    MOST,
    ROAD_VARIABLES,
)
from magtiles.schemas.errors import IntegrityError

MAX_BYTES = 1 << 31
"""Of the arrays together."""

_DIGEST = r"[0-9a-f]{64}"
_ATTRIBUTES: dict[str, str] = {
    "road": r"[A-Za-z0-9][A-Za-z0-9._-]*",
    "frame": "body: forward, right, down",
    "calibrated": "true|false",
    "direction": "forward|backward",
    "height_reference": "ellipsoid|mean_sea_level|terrain",
}
_RANGES: dict[str, tuple[float, float, bool]] = {
    "distance": (0.0, 1e9, False),
    "latitude": (-90.0, 90.0, False),
    "longitude": (-180.0, 180.0, False),
    "height": (-12_000.0, 1e6, True),
    "heading": (0.0, 360.0, True),
    "speed": (0.0, 1e3, True),
    "field_body": (-1e6, 1e6, False),
    "field_body_uncertainty": (1e-6, 1e6, False),
    "passes": (1, 2**31, False),
    "samples": (0, 2**31, False),
    "matchability": (0.0, 1.0, True),
    "feature_start": (0.0, 1e9, False),
    "feature_end": (0.0, 1e9, False),
    "feature_peak": (0.0, 1e9, False),
    "feature_axis": (0, 2, False),
}
"""What a query relies on: least, most, and whether NaN passes."""
_SPACING_TOLERANCE = 1e-6
"""Of the spacing, by which points may miss equal distances."""


@dataclass(frozen=True)
class RoadData:
    """A whole verified road file: its arrays by name (read-only), its attributes.

    Text is of dtype str; times are as stored (see `road_table`).
    """

    variables: Mapping[str, NDArray[Any]]
    attributes: Mapping[str, Any] = field(default_factory=dict)


def read_road(data: bytes, where: object) -> RoadData:
    """Parse the verified bytes of a road file; every breach raises IntegrityError."""
    try:
        with netCDF4.Dataset("road.nc", memory=data) as file:
            file.set_auto_maskandscale(False)
            check = _Checks(file, where)
            check.structure(len(data))
            variables = {name: check.read(name) for name in file.variables}
            attributes = {name: file.getncattr(name) for name in file.ncattrs()}
    except (OSError, RuntimeError, AttributeError, ValueError, MemoryError) as caught:
        raise _problem(where, f"is no readable road map: {caught}", "netCDF-4") from None
    check.attributes(attributes)
    check.values(variables, float(attributes["spacing_m"]))
    for values in variables.values():
        values.flags.writeable = False
    return RoadData(variables, attributes)


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
        unknown = sorted(present - set(ROAD_VARIABLES)) or sorted(self._file.groups)
        if unknown:
            raise self._problem(f"holds {unknown[0]}", "only the variables of a road map")
        wanted = (*ALWAYS, *(FEATURES if present & set(FEATURES) else ()))
        missing = [name for name in wanted if name not in present]
        if missing:
            raise self._problem(f"has no variable {missing[0]}", "all that belong with it")
        self._dimensions()
        declared = 0
        for name in present:
            declared += self._variable(name)
        # The most that zlib can expand: a file that declares more holds none of it.
        if declared > min(MAX_BYTES, 1032 * size):
            raise self._problem(f"declares {declared} bytes of arrays", f"at most {MAX_BYTES}")

    def _dimensions(self) -> None:
        least = {"point": 2, "axis": 3}
        for name, dimension in self._file.dimensions.items():
            low, most = least.get(name, 1), MOST.get(name, 0)
            if not low <= dimension.size <= most:
                raise self._problem(f"dimension {name} is {dimension.size}", f"{low} to {most}")

    def _variable(self, name: str) -> int:
        """Check one variable's declaration; the bytes that it declares."""
        rule, variable = ROAD_VARIABLES[name], self._file.variables[name]
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

    def attributes(self, attributes: Mapping[str, Any]) -> None:
        """Those that queries rely on."""
        for name, pattern in _ATTRIBUTES.items():
            value = attributes.get(name)
            if not (isinstance(value, str) and re.fullmatch(pattern, value)):
                raise self._problem(f"attribute {name} is {value!r}", pattern)
        for name, low, high in (("spacing_m", 1e-3, 1e6), ("matchability", 0.0, 1.0)):
            value = attributes.get(name, high if name == "matchability" else None)
            number = isinstance(value, (int, float, np.number))
            if not (number and low <= float(value) <= high):
                raise self._problem(f"attribute {name} is {value!r}", f"{low:g} to {high:g}")

    def values(self, variables: Mapping[str, NDArray[Any]], spacing: float) -> None:
        """What queries rely on: ranges, equal distances, digests."""
        for name, (low, high, missing) in _RANGES.items():
            if name in variables:
                self._range(name, variables[name], low, high, missing)
        distance = variables["distance"]
        even = distance[0] + spacing * np.arange(distance.size)
        if not (np.abs(distance - even) <= _SPACING_TOLERANCE * spacing).all():
            raise self._problem("distance is uneven", f"steps of spacing_m = {spacing:g}")
        for digest in variables["pass_digest"].tolist():
            if not re.fullmatch(_DIGEST, digest):
                raise self._problem(f"pass_digest holds {digest!r}", "SHA-256 digests")
        if len(set(variables["pass_digest"].tolist())) < variables["pass_digest"].size:
            raise self._problem("pass_digest holds a pass twice", "each pass once")

    def _range(
        self, name: str, values: NDArray[Any], low: float, high: float, missing: bool
    ) -> None:
        good = (values >= low) & (values <= high)
        if missing:
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
