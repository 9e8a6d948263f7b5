"""What passes of several vehicles say of the field at each point of a road, and how surely."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Real = NDArray[np.float64]
Counts = NDArray[np.int32]

_NEAR_M = 10.0
"""Points this near share what is known of the variation of passes."""
_LOCAL = 4.0
"""Degrees of freedom that the whole road's variation weighs against a point's own."""


@dataclass
class Statistics:
    """Sums that passes are added to, one at a time and in any order (Welford 1962).

    Attributes
    ----------
    names : of the vehicles.
    number : (vehicle, point) passes.
    mean : (vehicle, point, 3) mean field, nT; 0 where a vehicle has no pass.
    square_sum : (vehicle, point, 3) sum of squared deviations from the mean, nT2.
    """

    names: list[str]
    number: Counts
    mean: Real
    square_sum: Real

    def index(self, name: str) -> int:
        """The row of a vehicle, which is made if need be."""
        if name not in self.names:
            self.names.append(name)
            for key in ("number", "mean", "square_sum"):
                values = getattr(self, key)
                empty = np.zeros((1, *values.shape[1:]), values.dtype)
                setattr(self, key, np.concatenate([values, empty]))
        return self.names.index(name)

    def add(self, vehicle: int, field: Real, where: NDArray[np.bool_]) -> None:
        """Add a pass (point, 3) at the points `where` it has a field."""
        number = self.number[vehicle, where] + 1
        change = field[where] - self.mean[vehicle, where]
        mean = self.mean[vehicle, where] + change / number[:, None]
        self.square_sum[vehicle, where] += change * (field[where] - mean)
        self.mean[vehicle, where] = mean
        self.number[vehicle, where] = number

    def keep_one(self, vehicle: int, field: Real, where: NDArray[np.bool_]) -> None:
        """Leave one of a vehicle's passes, with this `field` (point, 3), at the points `where`."""
        self.number[vehicle, where] = 1
        self.mean[vehicle, where] = field[where]
        self.square_sum[vehicle, where] = 0.0

    def forget(self, vehicle: int, where: NDArray[np.bool_]) -> None:
        """Drop all passes of a vehicle at the points `where`."""
        for values in (self.number, self.mean, self.square_sum):
            values[vehicle, where] = 0

    @property
    def passes(self) -> Counts:
        """Of all vehicles at each point (point,)."""
        return np.asarray(self.number.sum(axis=0), dtype=np.int32)

    @property
    def plain_mean(self) -> Real:
        """Mean (point, 3) of the means of the vehicles, nT."""
        there = (self.number > 0)[..., None]
        return np.asarray((self.mean * there).sum(axis=0) / np.maximum(there.sum(axis=0), 1))


@dataclass(frozen=True)
class Estimate:
    """The field (point, 3), its standard deviation, and the variation of passes, nT.

    `same_vehicle` and `cross_vehicle` are NaN where no vehicle has two passes, or there are
    no two vehicles.
    """

    field: Real
    sigma: Real
    same_vehicle: Real
    cross_vehicle: Real


def estimate(
    statistics: Statistics, *, same_nt: Real, between_nt: Real, spacing_m: float
) -> Estimate:
    """The field as a random-effects mean: vehicles differ, and so do passes of one vehicle.

    A vehicle's mean of n passes has the variance b + w / n about the field, with b that
    between vehicles and w that between passes of one; means weigh by its inverse (Searle,
    Casella and McCulloch 1992, Variance Components, ch. 3). w and b at a point are those of its
    surroundings drawn toward the whole road's, and these toward what is stated.

    Parameters
    ----------
    same_nt, between_nt : (3,) standard deviations of passes of one vehicle, and of vehicles
        about the field, before anything was measured.
    spacing_m : of the points.
    """
    within, same = _within(statistics, same_nt, spacing_m)
    between, cross = _between(statistics, within, between_nt, spacing_m)
    number = statistics.number[..., None].astype(np.float64)
    there = number > 0
    variance = between + within / np.maximum(number, 1.0)
    weight = np.where(there, 1.0 / np.maximum(variance, 1e-12), 0.0)
    total = weight.sum(axis=0)
    field = (weight * statistics.mean).sum(axis=0) / total
    sigma = _student(there[..., 0]) * np.sqrt(1.0 / total)
    return Estimate(field, sigma, same, cross)


def _student(there: NDArray[np.bool_]) -> Real:
    """Factor (point, 1) by which a standard deviation found from few vehicles is too small.

    That of Student's distribution at 68 %, its degrees of freedom those of the vehicles and
    one of what was stated; 1 where there is one vehicle, and all is stated.
    """
    from scipy.stats import norm, t

    vehicles = there.sum(axis=0)
    factor = t.ppf(norm.cdf(1.0), np.maximum(vehicles, 1))
    return np.asarray(np.where(vehicles > 1, factor, 1.0))[:, None]


def _around(values: Real, spacing_m: float) -> Real:
    """Mean over the points near each."""
    from scipy.ndimage import uniform_filter1d

    size = max(int(2 * _NEAR_M / spacing_m) | 1, 1)
    return np.asarray(uniform_filter1d(values, min(size, len(values)), axis=0, mode="nearest"))


def _within(statistics: Statistics, stated: Real, spacing_m: float) -> tuple[Real, Real]:
    """Variance of passes of one vehicle (point, 3), and its plain standard deviation."""
    freedom = np.maximum(statistics.number - 1, 0).sum(axis=0)[:, None].astype(np.float64)
    square = statistics.square_sum.sum(axis=0)
    plain = np.sqrt(np.divide(square, freedom, out=np.full_like(square, np.nan), where=freedom > 0))
    if not freedom.any():
        return np.tile(stated**2, (len(square), 1)), plain
    road = square.sum(axis=0) / freedom.sum()
    local_square, local_freedom = _around(square, spacing_m), _around(freedom, spacing_m)
    return (_LOCAL * road + local_square) / (_LOCAL + local_freedom), plain


def _between(
    statistics: Statistics, within: Real, stated: Real, spacing_m: float
) -> tuple[Real, Real]:
    """Variance between vehicles (point, 3), and of passes of different vehicles, plain.

    The mean square of vehicle means about their mean holds within / n as well, n the harmonic
    mean of their passes.
    """
    there = statistics.number > 0
    vehicles = there.sum(axis=0).astype(np.float64)[:, None]
    inverse = np.where(there, 1.0 / np.maximum(statistics.number, 1), 0.0).sum(axis=0)[:, None]
    share = inverse / np.maximum(vehicles, 1.0)
    away = np.where(there[..., None], statistics.mean - statistics.plain_mean, 0.0)
    square = (away**2).sum(axis=0)
    freedom = np.maximum(vehicles - 1.0, 0.0)
    spread = np.divide(square, freedom, out=np.full_like(square, np.nan), where=freedom > 0)
    plain = np.sqrt(spread + (1.0 - share) * within)
    if not freedom.any():
        return np.tile(stated**2, (len(square), 1)), plain
    excess = np.maximum(square - freedom * share * within, 0.0)
    # Calibrations are wrong by much the same all along a road: its points are no more witnesses
    # than there are vehicles.
    most = freedom.max()
    road = (stated**2 + most * excess.sum(axis=0) / freedom.sum()) / (1.0 + most)
    local, local_freedom = _around(excess, spacing_m), _around(freedom, spacing_m)
    return (_LOCAL * road + local) / (_LOCAL + local_freedom), plain
