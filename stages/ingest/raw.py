"""What every grid reader hands over: values and axes as the file has them, and what it says."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import pyproj
from numpy.typing import NDArray

from magtiles.schemas.errors import FormatError, SourceError


@dataclass(frozen=True)
class RawGrid:
    """A grid as read from a file, before the conventions of magtiles.

    Attributes
    ----------
    values : (rows, columns) in the file's unit; NaN where the file marks a void.
    x, y : coordinates of the nodes (cell centres), in units of the CRS, in the file's order.
    x_ulp, y_ulp : rounding of the stored coordinates, that regularity is judged by.
    crs : None where the file does not say.
    says : the [grid] keys the file itself states.
    uncertainty : (rows, columns) or (), in the file's unit, where the file has one.
    """

    values: NDArray[np.float64]
    x: NDArray[np.float64]
    y: NDArray[np.float64]
    crs: pyproj.CRS | None
    x_ulp: float = 0.0
    y_ulp: float = 0.0
    says: Mapping[str, Any] = field(default_factory=dict)
    uncertainty: NDArray[np.float64] | None = None


_NANOTESLA = {
    "nt": 1.0,
    "nanotesla": 1.0,
    "nanoteslas": 1.0,
    "gamma": 1.0,
    "gammas": 1.0,
    "t": 1e9,
    "tesla": 1e9,
    "ut": 1e3,
    "µt": 1e3,
    "μt": 1e3,
    "microtesla": 1e3,
    "mt": 1e6,
    "millitesla": 1e6,
    "gauss": 1e5,
    "milligauss": 1e2,
}


def nanotesla_per(unit: str, *, where: object) -> float:
    """How many nT one `unit` is. Raises SourceError, naming the key, for any other unit."""
    try:
        return _NANOTESLA[unit.strip().lower()]
    except KeyError:
        raise SourceError(
            f"the unit '{unit}' is not a magnetic flux density, or ambiguous",
            where=where,
            expected=f"one of {', '.join(_NANOTESLA)}",
            remedy="state it with the key 'units' if the file does not, or convert the file",
        ) from None


def is_magnetic(unit: str) -> bool:
    """Whether a unit is one that `nanotesla_per` knows."""
    return unit.strip().lower() in _NANOTESLA


def mark_voids(values: NDArray[Any], mark: float | None) -> NDArray[np.float64]:
    """Values as float64 with `mark`, compared in the values' own type, turned to NaN."""
    out = values.astype(np.float64)
    if mark is not None and not np.isnan(mark):
        own = np.float32(mark) if values.dtype == np.float32 else mark
        out[values == own] = np.nan
    return out


def refuse_infinite(values: NDArray[np.float64], *, where: object) -> None:
    """Raise FormatError naming the first infinite value."""
    infinite = np.isinf(values)
    if infinite.any():
        row, column = np.unravel_index(int(np.argmax(infinite)), values.shape)
        raise FormatError(
            f"the value at row {row}, column {column} is infinite",
            where=where,
            expected="finite values or the file's void mark",
        )
