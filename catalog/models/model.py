"""One representation for all models: Gauss coefficients at epochs, with straight lines between."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from magtiles.catalog.kernels.harmonics import MAX_DEGREE, count
from magtiles.catalog.models.dates import Date, decimal_year
from magtiles.schemas.errors import QueryError

Floats = NDArray[np.float64]

REFERENCE_RADIUS_KM = 6371.2
"""Radius that the coefficients of geomagnetic models refer to, unless the file says another."""


@dataclass(frozen=True, eq=False)
class FieldModel:
    """A spherical-harmonic model of the internal field, V = a sum (a/r)^(n+1) (g cos + h sin) P.

    Attributes
    ----------
    name : as its file says, or the file's own.
    n_min, n_max : degrees with coefficients.
    reference_radius_km : a.
    epochs : (e,) decimal years, ascending; one for a static model.
    coefficients : (e, k) nT, Schmidt semi-normalised, g10 g11 h11 g20 g21 h21 ... from degree
        1 to n_max (zero below n_min).
    secular_variation : (k,) nT/yr after the last epoch.
    valid : first and last decimal year; infinite for a static model.

    Between epochs each coefficient is linear in the decimal year. That is how the IGRF is
    defined, and differs from linear in elapsed days where a leap year lies between epochs: by
    at most 0.8 day of secular variation.
    """

    name: str
    n_min: int
    n_max: int
    reference_radius_km: float
    epochs: Floats
    coefficients: Floats
    secular_variation: Floats | None
    valid: tuple[float, float]

    def __post_init__(self) -> None:
        if not 1 <= self.n_min <= self.n_max <= MAX_DEGREE:
            raise QueryError(
                f"degrees {self.n_min} to {self.n_max}",
                where=self.name,
                expected=f"degrees within 1 to {MAX_DEGREE}, ascending",
            )
        shapes = [self.coefficients.shape]
        if self.secular_variation is not None:
            shapes.append((len(self.epochs), *self.secular_variation.shape))
        if set(shapes) != {(len(self.epochs), count(self.n_max))}:
            raise QueryError(
                f"coefficients of shape {shapes[-1]}",
                where=self.name,
                expected=f"({len(self.epochs)}, {count(self.n_max)}) for degree {self.n_max}",
            )

    def covers(self, date: Date) -> NDArray[np.bool_]:
        """Whether dates (...) lie within the model's validity."""
        year = decimal_year(date)
        return np.asarray((year >= self.valid[0]) & (year <= self.valid[1]))

    def at(self, date: Date, *, allow_extrapolated: bool = False) -> Floats:
        """Coefficients (k,) at one date, nT.

        Beyond the validity, with `allow_extrapolated`, the nearest straight line goes on.

        Raises QueryError for a date outside the validity.
        """
        year = self.years(date, allow_extrapolated=allow_extrapolated)
        if year.ndim:
            raise QueryError("several dates", where=self.name, expected="one")
        segment = int(self.segments(year))
        base, rate = self.line(segment)
        return np.asarray(base + (float(year) - self.epochs[segment]) * rate)

    def degrees(self, low: int, high: int) -> FieldModel:
        """The model of the degrees `low` to `high` alone, those that it has."""
        n_min, n_max = max(low, self.n_min), min(high, self.n_max)
        if n_min > n_max:
            raise QueryError(
                f"no degrees {low} to {high}",
                where=self.name,
                expected=f"some of {self.n_min} to {self.n_max}",
            )

        def cut(values: Floats) -> Floats:
            kept = values[..., : count(n_max)].copy()
            kept[..., : count(n_min - 1)] = 0.0
            return kept

        sv = self.secular_variation
        return replace(
            self,
            n_min=n_min,
            n_max=n_max,
            coefficients=cut(self.coefficients),
            secular_variation=None if sv is None else cut(sv),
        )

    def years(self, date: Date, *, allow_extrapolated: bool) -> Floats:
        """Decimal years (...) of dates; QueryError names the first outside the validity."""
        year = decimal_year(date)
        outside = (year < self.valid[0]) | (year > self.valid[1])
        if allow_extrapolated or not outside.any():
            return year
        index = int(np.flatnonzero(outside.ravel())[0])
        raise QueryError(
            f"date {year.ravel()[index]:.4f} is outside the validity of {self.name}",
            where=f"date[{index}]" if year.ndim else "date",
            expected=f"{self.valid[0]:g} to {self.valid[1]:g}",
            remedy="choose another model, or permit it with allow_extrapolated "
            "(--allow-extrapolated)",
        )

    def segments(self, year: Floats) -> NDArray[np.intp]:
        """Index of the epoch from which the line through each decimal year starts."""
        last = len(self.epochs) - 1
        if self.secular_variation is None:
            last = max(last - 1, 0)
        return np.clip(np.searchsorted(self.epochs, year, side="right") - 1, 0, last)

    def line(self, segment: int) -> tuple[Floats, Floats]:
        """Coefficients at an epoch, nT, and their rate from there on, nT/yr; (k,) each."""
        base = self.coefficients[segment]
        if segment + 1 < len(self.epochs):
            span = self.epochs[segment + 1] - self.epochs[segment]
            return base, (self.coefficients[segment + 1] - base) / span
        return base, np.zeros_like(base) if self.secular_variation is None else (
            self.secular_variation
        )
