"""The polynomial surface of least reduced chi-squared (Cuenca 2020, eq. 3.2 and table 4.1).

His eq. 3.2 lacks the square of the residual, and calls the surface poly23 that goes to x^2 and y^3.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.polynomial import legendre
from numpy.typing import NDArray

from magtiles.schemas.errors import CoverageError
from magtiles.stages.field.survey.samples import Blocks, Places, Real

_DEGENERATE = 1e-7
"""Smallest ratio of singular values; of places spread over an area it is above 1e-3."""


@dataclass(frozen=True)
class Degrees:
    """The terms x^i y^j with i <= `x`, j <= `y`, i + j <= the greater of both."""

    x: int
    y: int

    @property
    def powers(self) -> NDArray[np.int64]:
        """The powers i and j (terms, 2)."""
        i, j = np.meshgrid(np.arange(self.x + 1), np.arange(self.y + 1), indexing="ij")
        kept = i + j <= max(self.x, self.y)
        return np.stack([i[kept], j[kept]], axis=1)

    @property
    def terms(self) -> int:
        """How many coefficients there are."""
        return len(self.powers)


@dataclass(frozen=True)
class Goodness:
    """Reduced chi-squared of a fit with so many degrees of freedom."""

    degrees: Degrees
    reduced_chi_squared: float
    freedom: int


@dataclass(frozen=True)
class Polynomial:
    """A fitted surface.

    Attributes
    ----------
    goodness : of this fit; `table` : of all that were tried.
    coefficient : (terms,) nT, of products of Legendre polynomials over the survey's extent.
    root : (terms, terms) with root @ root.T the covariance of the coefficients, nT^2.
    misfit : nT, one sigma of what the surface leaves of the field beyond the noise.
    residual : (blocks,) nT, of each block predicted by the others.
    """

    goodness: Goodness
    table: tuple[Goodness, ...]
    coefficient: Real
    root: Real
    misfit: float
    residual: Real
    frame: tuple[Real, Real]

    def __call__(self, x: Real, y: Real) -> Real:
        """Values (n,) nT at places (n,) m."""
        return np.asarray(self._rows(x, y) @ self.coefficient)

    def sigma(self, x: Real, y: Real) -> Real:
        """One sigma (n,) nT: of the coefficients, and what the surface leaves of the field."""
        variance = ((self._rows(x, y) @ self.root) ** 2).sum(axis=1)
        return np.asarray(np.sqrt(variance + self.misfit**2))

    def _rows(self, x: Real, y: Real) -> Real:
        return _rows((x, y), self.goodness.degrees, self.frame)


def fit_polynomial(blocks: Blocks, noise_nt: float, max_degree: int) -> Polynomial:
    """The surface of least reduced chi-squared of degrees 1 to `max_degree` in x and in y.

    Blocks weigh as their samples do under `noise_nt`, one sigma of a sample. The terms are
    averaged over each block's samples, so that a block's mean is fitted by a mean.

    Raises CoverageError for fewer blocks than terms, or places that do not determine them.
    """
    _check_count(blocks.value.size, max_degree)
    middle, half = _frame(blocks)
    sigma = noise_nt / np.sqrt(blocks.weight)
    place = blocks.samples.x, blocks.samples.y

    def fit(degrees: Degrees) -> _Fit:
        return _Fit.of(blocks.mean(_rows(place, degrees, (middle, half))), blocks.value, sigma)

    span = range(1, max_degree + 1)
    candidates = sorted((Degrees(x, y) for x in span for y in span), key=lambda d: d.terms)
    table = tuple(fit(degrees).goodness(degrees) for degrees in candidates)
    best = least_reduced(table)
    chosen = fit(best.degrees)
    chi = best.reduced_chi_squared
    excess = max(chi - 1.0, 0.0) / float(np.mean(sigma**-2))
    return Polynomial(
        best,
        table,
        chosen.coefficient,
        chosen.root * np.sqrt(max(chi, 1.0)),
        float(np.sqrt(excess)),
        chosen.left_out,
        (middle, half),
    )


def least_reduced(table: Sequence[Goodness]) -> Goodness:
    """The fit of fewest terms among those that are as good as the one of least chi-squared.

    Reduced chi-squared varies by sqrt(2 / freedom) from chance, and one below 1 fits noise:
    neither is a reason for more terms.
    """
    least = max(1.0, min(g.reduced_chi_squared for g in table))
    good = (
        g
        for g in sorted(table, key=lambda g: (g.degrees.terms, g.reduced_chi_squared))
        if g.reduced_chi_squared <= least * (1.0 + np.sqrt(2.0 / g.freedom))
    )
    return next(good)


@dataclass(frozen=True)
class _Fit:
    """Weighted least squares by singular values."""

    coefficient: Real
    root: Real
    chi_squared: float
    freedom: int
    left_out: Real

    @classmethod
    def of(cls, rows: Real, values: Real, sigma: Real) -> _Fit:
        left, singular, right = np.linalg.svd(rows / sigma[:, None], full_matrices=False)
        if singular[-1] < _DEGENERATE * singular[0]:
            raise CoverageError(
                f"the places of {values.size} blocks do not determine {rows.shape[1]} terms",
                where="method 'polynomial'",
                expected="samples spread over the area in both directions",
                remedy="lower max_degree",
            )
        coefficient = right.T @ (left.T @ (values / sigma) / singular)
        residual = values - rows @ coefficient
        leverage = (left**2).sum(axis=1)
        return cls(
            coefficient,
            right.T / singular,
            float(((residual / sigma) ** 2).sum()),
            values.size - rows.shape[1],
            residual / np.maximum(1.0 - leverage, _DEGENERATE),
        )

    def goodness(self, degrees: Degrees) -> Goodness:
        return Goodness(degrees, self.chi_squared / self.freedom, self.freedom)


def _frame(blocks: Blocks) -> tuple[Real, Real]:
    """Middle and half extent of the samples, (2,) each, so that both axes run from -1 to 1."""
    place = np.stack([blocks.samples.x, blocks.samples.y])
    low, high = place.min(axis=1), place.max(axis=1)
    return (low + high) / 2.0, (high - low) / 2.0


def _rows(place: Places, degrees: Degrees, frame: tuple[Real, Real]) -> Real:
    """Products of Legendre polynomials (n, terms): the same surfaces as powers, better posed."""
    x, y = ((a - m) / h for a, m, h in zip(place, *frame, strict=True))
    i, j = degrees.powers.T
    rows: Real = legendre.legvander(x, degrees.x)[:, i] * legendre.legvander(y, degrees.y)[:, j]
    return rows


def goodness_attributes(table: Sequence[Goodness]) -> dict[str, Any]:
    """The table of fits as attributes: arrays in the order of their terms."""
    return {
        "polynomial_degree_x": np.array([g.degrees.x for g in table], np.int32),
        "polynomial_degree_y": np.array([g.degrees.y for g in table], np.int32),
        "polynomial_terms": np.array([g.degrees.terms for g in table], np.int32),
        "reduced_chi_squared": np.array([g.reduced_chi_squared for g in table]),
    }


def _check_count(count: int, max_degree: int) -> None:
    terms = Degrees(max_degree, max_degree).terms
    if count <= terms:
        raise CoverageError(
            f"the samples fill {count} blocks, and a surface of degree {max_degree} has "
            f"{terms} terms",
            where="method 'polynomial'",
            expected="more blocks than terms",
            remedy="lower max_degree or spacing_m, or measure more",
        )
