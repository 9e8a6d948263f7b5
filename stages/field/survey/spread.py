"""How far a gridded survey may be off between its samples: one sigma at any place.

What is left of the field after a plane is taken as a Gaussian process with the covariance of
white sources at a depth L/2 (an upward-continued white field), and a nugget of noise::

    C(r) = s^2 [(1 + r^2 / L^2)^(-3/2) + eta (r = 0)]

Its L, eta and s^2 are those under which each block is likeliest, given its neighbours (Vecchia's
pseudo-likelihood, by leaving one out). The sigma of simple kriging from the nearest blocks then
knows how the samples lie. Neither the field nor the gridder need be like this, so that sigma is
multiplied by what cross-validation of the gridder itself shows near each place.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize
from scipy.spatial import cKDTree

from magtiles.stages.field.survey.samples import Blocks, Real
from magtiles.stages.field.survey.surface import Scatter

_NEIGHBOURS = 20
_FITTED = 1500
"""Blocks that the parameters are estimated from, at most."""
_AT_ONCE = 4000
_LENGTHS = 0.3, 30.0
_NUGGETS = 1e-9, 10.0
_LOCAL, _PRIOR = 10, 6
"""Residuals near a place that its factor is of, and how many the survey's own stands for."""


@dataclass(frozen=True)
class Covariance:
    """Length L m, nugget eta and variance s^2 nT^2 of a field's covariance."""

    length: float
    nugget: float
    variance: float


def node_sigma(blocks: Blocks, surface: Scatter, x: Real, y: Real) -> Real:
    """One sigma (n,), nT, of a fitted surface at places x, y (n,) m."""
    import verde  # heavy, and few commands grid

    places = np.stack([blocks.x, blocks.y], axis=1)
    centred = tuple((places - places.mean(axis=0)).T)
    rest = blocks.value - verde.Trend(degree=1).fit(centred, blocks.value).predict(centred)
    field = fit_covariance(places, rest)
    expected = _held_out_variance(places, surface, field)
    known = np.isfinite(surface.residual)
    square, expected = surface.residual[known] ** 2, expected[known]
    nodes = np.stack([x, y], axis=1)
    near = cKDTree(places[known]).query(nodes, min(_LOCAL, square.size))[1]
    # Sums before their ratio: where the blocks leave little open, small misfits tell little.
    prior = _PRIOR / square.size
    factor = (square[near].sum(axis=1) + prior * square.sum()) / (
        expected[near].sum(axis=1) + prior * expected.sum()
    )
    variance = _kriging_variance(places, nodes, field)
    return np.asarray(np.sqrt(variance * np.maximum(factor, np.finfo(np.float64).tiny)))


def fit_covariance(places: Real, values: Real) -> Covariance:
    """The covariance under which each of values (n,) nT at places (n, 2) m is likeliest."""
    tree = cKDTree(places)
    count = min(_NEIGHBOURS, len(places) - 1)
    chosen = np.arange(len(places))
    if chosen.size > _FITTED:
        chosen = np.random.default_rng(0).choice(chosen, _FITTED, replace=False)
    distance, index = tree.query(places[chosen], count + 1)
    step, index = float(np.median(distance[:, 1])), index[:, 1:]
    systems = _Systems(places[chosen], places[index])

    def variance(length: float, nugget: float) -> tuple[float, Real]:
        weight, share = systems.solve(length, nugget)
        share = share + nugget
        off = values[chosen] - (weight * values[index]).sum(axis=1)
        return float(np.mean(off**2 / share)), share

    def surprise(logs: NDArray[np.float64]) -> float:
        scale, share = variance(step * np.exp(logs[0]), np.exp(logs[1]))
        return float(np.log(max(scale, np.finfo(np.float64).tiny)) + np.log(share).mean())

    starts = [np.log([a, b]) for a in (1.0, 3.0, 9.0) for b in (1e-7, 1e-4, 0.1)]
    best = minimize(
        surprise,
        min(starts, key=surprise),
        method="Nelder-Mead",
        bounds=[tuple(np.log(_LENGTHS)), tuple(np.log(_NUGGETS))],
        options={"maxiter": 60, "xatol": 0.05, "fatol": 1e-3},
    ).x
    length, nugget = step * float(np.exp(best[0])), float(np.exp(best[1]))
    return Covariance(length, nugget, variance(length, nugget)[0])


class _Systems:
    """Kriging of each target (m, 2) from its own neighbours (m, k, 2)."""

    def __init__(self, targets: Real, neighbours: Real) -> None:
        apart = neighbours[:, :, None] - neighbours[:, None, :]
        self._within = np.einsum("mijc,mijc->mij", apart, apart)
        away = targets[:, None] - neighbours
        self._to = np.einsum("mic,mic->mi", away, away)

    def solve(self, length: float, nugget: float) -> tuple[Real, Real]:
        """Weights (m, k), and the variance (m,) they leave, as a share of s^2, without noise."""
        matrix = (1.0 + self._within / length**2) ** -1.5
        diagonal = np.arange(matrix.shape[1])
        matrix[:, diagonal, diagonal] += nugget
        to = (1.0 + self._to / length**2) ** -1.5
        weight = np.linalg.solve(matrix, to[..., None])[..., 0]
        # Rounding of a nearly singular system may leave less than nothing.
        return weight, np.maximum(1.0 - (weight * to).sum(axis=1), 0.1 * nugget)


def _kriging_variance(known: Real, targets: Real, field: Covariance) -> Real:
    """Variance (m,), nT^2, of the field at targets (m, 2) given its values at `known` (n, 2)."""
    index = cKDTree(known).query(targets, min(_NEIGHBOURS, len(known)))[1]
    share = np.empty(len(targets))
    for start in range(0, len(targets), _AT_ONCE):
        part = slice(start, start + _AT_ONCE)
        share[part] = _Systems(targets[part], known[index[part]]).solve(field.length, field.nugget)[
            1
        ]
    tiny = np.finfo(np.float64).tiny  # a survey of one value still has a sigma above zero
    return np.asarray(np.maximum(share * field.variance, tiny**0.5))


def _held_out_variance(places: Real, surface: Scatter, field: Covariance) -> Real:
    """Expected square (blocks,), nT^2, of what cross-validation left: of field and noise."""
    variance = np.empty(len(places))
    for fold in surface.folds:
        variance[fold.out] = _kriging_variance(places[fold.rest], places[fold.out], field)
    return variance + field.nugget * field.variance
