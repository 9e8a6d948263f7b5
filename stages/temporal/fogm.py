"""Sigma and tau of first-order Gauss-Markov processes from segments of samples.

A process with autocorrelation sigma^2 exp(-|dt| / tau), fitted to each segment by exact maximum
likelihood and to its sample autocorrelation, and to many segments jointly.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]

SHORTEST_STEPS, LONGEST_SEGMENTS = 0.1, 1e8
"""Limits of the search for tau: below, samples are white noise; above, tau is infinite."""

_BLOCK = 50_000
"""Samples taken at once by the autocorrelation, so that their lags stay in the cache."""

_SHORT = 500
"""Rows up to this long are multiplied out; longer ones are faster by Fourier transform."""


@dataclass(frozen=True)
class Fit:
    """Maximum-likelihood sigma (nT) and tau (s) about zero, each with its 95 % bounds.

    Bounds are those of the profile likelihood: where -2 log L, at its least over the other
    parameter, exceeds the minimum by 3.84. tau is 0 for white noise (or less correlated still);
    tau_low may be 0, tau_high infinite. All are NaN where fewer than two samples are valid or
    all valid ones are equal.
    """

    sigma: Floats
    sigma_low: Floats
    sigma_high: Floats
    tau: Floats
    tau_low: Floats
    tau_high: Floats

    def unidentified(self, duration_s: float | Floats) -> NDArray[np.bool_]:
        """Where tau is longer than the record it comes from, has no upper bound, or is NaN."""
        return ~((self.tau <= duration_s) & np.isfinite(self.tau_high))


def fit_segments(segments: Floats, step_s: float) -> tuple[Fit, Floats, Floats]:
    """Exact maximum likelihood of each segment, about zero and about its own mean.

    Parameters
    ----------
    segments : (segment, sample) at equal steps of `step_s` seconds, NaN where missing.

    Returns
    -------
    The fit about zero (segment,), and sigma and tau about the segment's mean. Subtracting the
    mean takes a part of the variance with it: both are then biased low, the more so the longer
    tau (docs/fogm.md).
    """
    from magtiles.stages.temporal import fogm_compiled

    x = np.ascontiguousarray(segments, np.float64)
    found = np.full((len(x), 8), np.nan)
    fogm_compiled.fit_each(x, _span(x.shape[1]), found)
    found[:, 3:6] *= step_s
    return Fit(*found[:, :6].T), found[:, 6], found[:, 7] * step_s


def fit_pooled(segments: Floats, step_s: float, members: NDArray[np.bool_]) -> Fit:
    """One sigma and tau about zero for all segments of a class, by their joint likelihood.

    Segments count as independent of each other.

    Parameters
    ----------
    segments : (segment, sample), NaN where missing.
    members : (class, segment), which segments are in which class.

    Returns
    -------
    The fits (class,).
    """
    from magtiles.stages.temporal import fogm_compiled

    x = np.ascontiguousarray(segments, np.float64)
    found = np.full((len(members), 6), np.nan)
    fogm_compiled.fit_classes(x, np.ascontiguousarray(members), _span(x.shape[1]), found)
    found[:, 3:] *= step_s
    return Fit(*found.T)


def autocorrelation(segments: Floats) -> tuple[Floats, Floats]:
    """Sample autocorrelation of each segment about zero, nT^2, at lags of 0 to n - 1 steps.

    The sum of the products of samples k steps apart over n, as for a full segment; in one with
    gaps, their mean times (n - k) / n.

    Parameters
    ----------
    segments : (segment, sample), NaN where missing.

    Returns
    -------
    The autocorrelation (segment, lag), zero at a lag that no two samples have, and whether
    there are such samples, 1 or 0.
    """
    n = segments.shape[1]
    valid = np.isfinite(segments)
    broken = ~valid.all(axis=1)
    values = _lagged_products(np.where(valid, segments, 0.0)) / n
    present = np.ones(values.shape)
    pairs = np.round(_lagged_products(valid[broken].astype(np.float64)))
    present[broken] = pairs > 0
    values[broken] *= np.where(pairs > 0, np.arange(n, 0, -1) / np.maximum(pairs, 1.0), 0.0)
    return values, present


def _lagged_products(x: Floats) -> Floats:
    """Sums of x_i x_(i+k) over i, for k = 0 ... n - 1, of each row (row, n)."""
    from scipy import fft

    from magtiles.stages.temporal import decay_compiled

    n = x.shape[1]
    if n <= _SHORT:
        products = np.empty(x.shape)
        decay_compiled.lagged_products(x, products)
        return products
    size = fft.next_fast_len(2 * n - 1, real=True)
    spectrum = fft.rfft(x, size, axis=1)
    power = spectrum.real**2 + spectrum.imag**2
    return np.asarray(fft.irfft(power, size, axis=1, overwrite_x=True)[:, :n])


def fit_autocorrelation(segments: Floats, step_s: float) -> tuple[Floats, Floats]:
    """Sigma and tau (segment,) of sigma^2 exp(-|dt| / tau) fitted to the autocorrelation.

    Least squares over all lags of the sample autocorrelation about zero, the method of Canciani
    and Raquet (2016, figure 10c; they leave the normalisation and the range of lags open).
    tau seldom exceeds half a segment, however slow the process is: docs/fogm.md tells the bias.
    NaN where fewer than two samples are valid or all are zero.
    """
    from magtiles.stages.temporal import decay_compiled

    x = np.ascontiguousarray(segments, np.float64)
    low, high = math.log(SHORTEST_STEPS), math.log(100.0 * x.shape[1])
    nodes = np.linspace(low, high, math.ceil(2.0 * (high - low)))
    powers = np.exp(-np.arange(x.shape[1])[:, None] * np.exp(-nodes))
    found = np.full((len(x), 2), np.nan)
    rows = max(1, _BLOCK // x.shape[1])
    for block in (slice(i, i + rows) for i in range(0, len(x), rows)):
        values, weights = autocorrelation(x[block])
        decay_compiled.fit_rows(nodes, powers, weights, values, found[block])
    return found[:, 0], found[:, 1] * step_s


def _span(samples: int) -> tuple[float, float]:
    """Limits of the search for log(tau / step)."""
    return math.log(SHORTEST_STEPS), math.log(LONGEST_SEGMENTS * samples)
