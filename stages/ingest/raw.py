"""What every grid reader hands over: values and axes as the file has them, and what it says."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import pyproj
from numpy.typing import NDArray

from magtiles.schemas.errors import FormatError, SourceError
from magtiles.stages.rows import Rows, in_strips


@dataclass(frozen=True)
class RawGrid:
    """A grid as read from a file, before the conventions of magtiles.

    Attributes
    ----------
    values : (rows, columns) in the file's unit; NaN where the file marks a void. An array, or
        rows that are read when they are wanted.
    x, y : coordinates of the nodes (cell centres), in units of the CRS, in the file's order.
    x_ulp, y_ulp : rounding of the stored coordinates, that regularity is judged by.
    crs : None where the file does not say.
    says : the [grid] keys the file itself states.
    uncertainty : (rows, columns), or one number, in the file's unit, where the file has it.
    """

    values: Rows
    x: NDArray[np.float64]
    y: NDArray[np.float64]
    crs: pyproj.CRS | None
    x_ulp: float = 0.0
    y_ulp: float = 0.0
    says: Mapping[str, Any] = field(default_factory=dict)
    uncertainty: Rows | float | None = None

    def in_memory(self) -> RawGrid:
        """The same, read whole: for a file that will not be there for long."""
        sigma = self.uncertainty
        if sigma is not None and not isinstance(sigma, float):
            sigma = sigma[:]
        return replace(self, values=self.values[:], uncertainty=sigma)


@dataclass(frozen=True)
class Converted:
    """Values as they are stored, converted when rows of them are wanted."""

    stored: Any
    convert: Callable[[Any], NDArray[np.float64]]

    @property
    def shape(self) -> tuple[int, ...]:
        """Rows and columns."""
        return tuple(self.stored.shape)

    def __getitem__(self, rows: slice, /) -> NDArray[np.float64]:
        return self.convert(self.stored[rows])


@dataclass(frozen=True)
class Quantity:
    """What the values of a grid are.

    Attributes
    ----------
    name : for messages, with its article.
    unit : ours.
    units : how many of ours one of another unit is, by its name in lower case.
    largest : beyond which, in our unit, a value is a void mark or in another unit.
    """

    name: str
    unit: str
    units: Mapping[str, float]
    largest: float

    def knows(self, unit: str) -> bool:
        """Whether `per` takes a unit."""
        return unit.strip().lower() in self.units

    def per(self, unit: str, *, where: object) -> float:
        """How many of our unit one `unit` is. SourceError, naming the key, for any other unit."""
        if not self.knows(unit):
            raise SourceError(
                f"the unit '{unit}' is not {self.name}, or ambiguous",
                where=where,
                expected=f"one of {', '.join(self.units)}",
                remedy="state it with the key 'units' if the file does not, or convert the file",
            )
        return self.units[unit.strip().lower()]


METRES = {"m": 1.0, "metre": 1.0, "meter": 1.0, "metres": 1.0, "meters": 1.0}
METRES |= {"km": 1000.0, "kilometre": 1000.0, "kilometer": 1000.0}
METRES |= {"us_survey_foot": 1200.0 / 3937.0, "us survey foot": 1200.0 / 3937.0}
METRES |= {"ft": 0.3048, "foot": 0.3048, "feet": 0.3048}

# No surface lies higher above the sea or deeper below it; DEMs mark voids with -32768, 32767 ...
ELEVATION = Quantity("a length", "m", METRES, 12_000.0)

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


# No crustal anomaly is larger; the whole field is about 25-65 thousand nT.
FLUX_DENSITY = Quantity("a magnetic flux density", "nT", _NANOTESLA, 1e5)


def nanotesla_per(unit: str, *, where: object) -> float:
    """How many nT one `unit` is. Raises SourceError, naming the key, for any other unit."""
    return FLUX_DENSITY.per(unit, where=where)


def mark_voids(values: NDArray[Any], mark: float | None) -> NDArray[np.float64]:
    """Values as float64 with `mark`, compared in the values' own type, turned to NaN."""
    out = values.astype(np.float64)
    if mark is not None and not np.isnan(mark):
        own = np.float32(mark) if values.dtype == np.float32 else mark
        out[values == own] = np.nan
    return out


def refuse_infinite(values: Rows, *, where: object) -> None:
    """Raise FormatError naming the first infinite value."""
    for first, part in in_strips(values):
        infinite = np.isinf(part)
        if infinite.any():
            row, column = np.unravel_index(int(np.argmax(infinite)), part.shape)
            raise FormatError(
                f"the value at row {first + row}, column {column} is infinite",
                where=where,
                expected="finite values or the file's void mark",
            )
