"""Likelihood of a measured section along a road map, and the place that it tells.

A section is K successive samples at the map's own spacing; a hypothesis is the map point that its
first sample lies on. Its likelihood is Gaussian with independent errors (Shockley 2012, eq.
2.49-2.52, P diagonal). Three forms of the samples are compared:

- ``measured``: as they are;
- ``demeaned``: each axis less a constant of the section, whatever it is. That is eq. 2.49 with an
  unknown bias of flat prior on each axis, and with equal variances the section less its mean;
- ``differenced``: from sample to sample, of variance v[i] + v[i+1], taken as independent.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]

Form = Literal["measured", "demeaned", "differenced"]
FORMS: tuple[Form, ...] = get_args(Form)
Method = Literal["ml", "mlr", "abl"]
METHODS: tuple[Method, ...] = get_args(Method)

LEAST_RATIO = 2.0
"""Of the MLR: the paper's example."""
MINIMUM_DISTANCE_M = 20.0
"""Of the MLR: the paper's example."""
BIN_M = 10.0
"""Of the ABL."""
LEAST_PEAK = 0.2
"""Of the ABL: the least normalised likelihood of the highest point."""

CHOICE_BLOCK = 256
"""Points that are passed over together where none is likely."""

_LOG_2PI = float(np.log(2.0 * np.pi))


def least_samples(form: Form) -> int:
    """The shortest section that a form can be told of."""
    return 1 if form == "measured" else 2


@dataclass(frozen=True)
class SectionMap:
    """One stretch of map points, prepared for a form.

    Attributes
    ----------
    form : of the samples.
    field : (3, n) nT, or (3, n - 1) differences.
    weight : one over the variance of each, nT-2.
    log_variance : (n + 1,) or (n,): logarithms of the variances, added up along the road and
        over the axes, from 0.
    """

    form: Form
    field: Floats
    weight: Floats
    log_variance: Floats

    def log_likelihood(
        self, section: Floats, start: int, stop: int, out: Floats | None = None
    ) -> Floats:
        """Log-likelihood of a section's first sample at each of the points start ... stop - 1.

        Parameters
        ----------
        section : (K, 3) nT at the map's spacing.
        start, stop : 0 <= start < stop <= points - K + 1.
        out : (stop - start,) to fill, contiguous; new where not given.
        """
        from magtiles.catalog.kernels import road_match_compiled as kernels

        rows = np.ascontiguousarray(section.T, np.float64)
        if self.form == "differenced":
            rows = np.ascontiguousarray(np.diff(rows, axis=1))
        answer = np.empty(stop - start) if out is None else out
        terms = rows.size - 3 * (self.form == "demeaned")
        kernel = kernels.demeaned if self.form == "demeaned" else kernels.measured
        kernel(self.field, self.weight, self.log_variance, rows, start, terms * _LOG_2PI, answer)
        return answer


def prepare(field: Floats, variance: Floats, form: Form) -> SectionMap:
    """A map of points (n, 3), nT, and variances of the difference to a measurement, nT2."""
    rows, spread = np.ascontiguousarray(field.T, np.float64), variance.T
    if form == "differenced":
        rows = np.ascontiguousarray(np.diff(rows, axis=1))
        spread = spread[:, 1:] + spread[:, :-1]
    log_variance = np.concatenate([[0.0], np.cumsum(np.log(spread).sum(axis=0))])
    return SectionMap(form, rows, np.ascontiguousarray(1.0 / spread), log_variance)


@dataclass(frozen=True)
class Choice:
    """What the likelihoods of all points say (Shockley 2012, 4.3).

    Attributes
    ----------
    best : index of the most likely point (ML).
    ratio : its likelihood over the highest at least the minimum distance away (MLR); infinite
        where there is none.
    bin : index of the likelihood's centre in the bin that holds most of it (ABL).
    peak : share of the most likely point in the sum of all (ABL).
    """

    best: int
    ratio: float
    bin: int
    peak: float

    def index(self, method: Method, *, least_ratio: float, least_peak: float) -> int:
        """The point that a method tells; -1 where it tells none."""
        if method == "mlr":
            return self.best if self.ratio >= least_ratio else -1
        if method == "abl":
            return self.bin if self.peak >= least_peak else -1
        return self.best


def choose(
    log_likelihood: Floats,
    position: Floats,
    run: NDArray[np.int64],
    *,
    minimum_distance_m: float,
    bin_points: int,
) -> Choice:
    """Find the most likely point, how unique it is, and the most likely bin.

    Parameters
    ----------
    log_likelihood : (n,) of each point.
    position : (n, 2) metres in a plane.
    run : (n,) number of the stretch that each point belongs to, ascending: no bin holds two.
    bin_points : points of a bin.
    """
    from magtiles.catalog.kernels import road_match_compiled as kernels

    best = int(log_likelihood.argmax())
    whole = log_likelihood.size // CHOICE_BLOCK * CHOICE_BLOCK
    greatest = log_likelihood[:whole].reshape(-1, CHOICE_BLOCK).max(axis=1)
    greatest = np.append(greatest, log_likelihood[whole:].max(initial=-np.inf))
    second, centre, total = kernels.choose(
        log_likelihood, greatest, best, position, run, minimum_distance_m**2, bin_points
    )
    gap = log_likelihood[best] - second
    ratio = float(np.exp(gap)) if gap < 700.0 else np.inf
    return Choice(best, ratio, int(centre), 1.0 / float(total))


def root_mean_square(difference: Floats, form: Form) -> float:
    """Root-sum-square of two aligned features' difference (K, 3), over the root of its size.

    The paper's RSS; divided so that features of different lengths compare.
    """
    if form == "demeaned":
        difference = difference - difference.mean(axis=0)
    elif form == "differenced":
        difference = np.diff(difference, axis=0)
    return float(np.sqrt(np.mean(difference**2)))
